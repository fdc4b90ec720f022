"""Cubic spline interpolation."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from shakercal._common.arrays import ComplexArray, FloatArray

Numbers = TypeVar("Numbers", FloatArray, ComplexArray)


def cubic_spline(knots: FloatArray, values: Numbers, position: FloatArray) -> Numbers:
    """Return the not-a-knot cubic spline through values (N,) at positions; a constant for one knot.

    The digits are those of `scipy.interpolate.CubicSpline`, whose package takes as long to import as a check of a whole
    recording.
    """
    if len(knots) == 1:
        return np.full(len(position), values[0])
    step = np.diff(knots)
    rise = np.diff(values) / step
    slope = _slopes(knots, step, rise)
    bend = (slope[:-1] + slope[1:] - 2.0 * rise) / step
    curve = (rise - slope[:-1]) / step - bend
    piece = np.clip(np.searchsorted(knots, position, side="right") - 1, 0, len(step) - 1)
    x = position - knots[piece]
    return np.asarray(values[piece] + slope[piece] * x + curve[piece] * (x * x) + (bend / step)[piece] * (x * x * x))


def _slopes(knots: FloatArray, step: FloatArray, rise: Numbers) -> Numbers:
    """Return the spline's slopes (N,) at the knots.

    They make its second derivative continuous there, and the third one at the second and the last but one (de Boor
    2001, A Practical Guide to Splines, chapter IV).
    """
    if len(knots) == 2:
        return np.repeat(rise, 2)
    inner: FloatArray = 2.0 * (step[:-1] + step[1:])
    right = np.empty(len(knots), dtype=rise.dtype)
    right[1:-1] = 3.0 * (step[1:] * rise[:-1] + step[:-1] * rise[1:])
    if len(knots) == 3:  # both ends state the same: a parabola
        right[0], right[2] = 2.0 * rise
        return np.asarray(np.linalg.solve([[1.0, 1.0, 0.0], [step[1], inner[0], step[0]], [0.0, 1.0, 1.0]], right))
    first, last = knots[2] - knots[0], knots[-1] - knots[-3]
    right[0] = ((step[0] + 2.0 * first) * step[1] * rise[0] + step[0] ** 2 * rise[1]) / first
    right[-1] = (step[-1] ** 2 * rise[-2] + (2.0 * last + step[-1]) * step[-2] * rise[-1]) / last
    # Three diagonals by elimination; as steps are positive, no middle one becomes zero.
    above, middle, below = [first, *step[:-1]], [step[1], *inner, step[-2]], [*step[1:], last]
    for i, element in enumerate(below):
        share = element / middle[i]
        middle[i + 1] -= share * above[i]
        right[i + 1] -= share * right[i]
    right[-1] /= middle[-1]
    for i in range(len(below) - 1, -1, -1):
        right[i] = (right[i] - above[i] * right[i + 1]) / middle[i]
    return right
