"""Spline values along straight lines of points, eight points at a time: the inner loop of every registration.

Neighbouring points of a line read neighbouring coefficients as long as the line does not pass into another row or drift
by a column. Such runs are computed with vectors of eight points. Compilers do not find this by themselves (they cannot
know that the grey values written are no coefficients), so the few vector operations are written out here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from photogram._checks import FloatArray, check_shape
from photogram._kernel import njit
from photogram.interpolate import PADDING_PX, Spline, basis, weights_cubic, weights_quintic, weights_septic
from photogram.lanes import INDEX, REAL, counted, in_blocks, load, spread, store

SMALLEST_DRIFT = 1e-30


def sample_squares(spline: Spline, centre_px: FloatArray, radius_px: int) -> FloatArray:
    """Values and gradients (N,3,P) [f, f_x, f_y] on P = (2·radius+1)² points, a pixel apart, around centre_px (N,2).

    NaN for squares that are not wholly in the image. Points of a square have the same weights, applied along x, then y.
    """
    check_shape("centre_px", centre_px, (None, 2))
    squares = np.full((len(centre_px), 3, (2 * radius_px + 1) ** 2), np.nan)
    _sample_squares(spline.coefficients, spline.degree, np.ascontiguousarray(centre_px), radius_px, squares)
    return squares


@njit()
def sample_line(c, degree, x, y, step_x, step_y, grey):  # type: ignore[no-untyped-def]
    """Fill grey (n,) with values of a spline of degree 3, 5 or 7 at (x, y) + i·(step_x, step_y), all within the image.

    c (H+8,W+8): `Spline.coefficients`. Runs in which int(x)−i and int(y) stay the same are computed eight points at a
    time; the polynomials of two runs agree where they meet, so that it does not matter to which run a point is given.
    """
    start = 0
    while start < grey.size:
        at_x, at_y = x + start * step_x, y + start * step_y
        stop = _end_of_run(start, grey.size, at_x - int(at_x), at_y - int(at_y), step_x - 1.0, step_y)
        _run(c, degree, at_x, at_y, step_x - 1.0, step_y, grey, start, stop)
        start = stop


@njit()
def sample_points(c, degree, x, y, grey):  # type: ignore[no-untyped-def]
    """Fill grey (n,) with spline values of degree 3, 5 or 7 at any points x (n,), y (n,) within the image."""
    for i in range(grey.size):
        _run(c, degree, x[i], y[i], 0.0, 0.0, grey, i, i + 1)


@njit(inline="always")
def _run(c, degree, x, y, drift_x, drift_y, grey, start, stop):  # type: ignore[no-untyped-def]
    """Points start … stop of one run, the first of them at (x, y)."""
    column, row = int(x), int(y)
    s, t = x - column, y - row
    row, column = row + PADDING_PX - degree // 2, column + PADDING_PX - degree // 2
    if degree == 7:
        _run_septic(c, row, column, s, t, drift_x, drift_y, grey, start, stop)
    elif degree == 5:
        _run_quintic(c, row, column, s, t, drift_x, drift_y, grey, start, stop)
    else:
        _run_cubic(c, row, column, s, t, drift_x, drift_y, grey, start, stop)


@njit(inline="always")
def box_inside(coefficients, x, y, reach_x, reach_y):  # type: ignore[no-untyped-def]
    """Whether the rectangle about (x, y) lies within the image; False for NaN."""
    right, bottom = coefficients.shape[1] - 2.0 * PADDING_PX - 1.0, coefficients.shape[0] - 2.0 * PADDING_PX - 1.0
    return x - reach_x >= 0.0 and x + reach_x <= right and y - reach_y >= 0.0 and y + reach_y <= bottom


@njit(inline="always")
def _end_of_run(start, count, s, t, drift_x, drift_y):  # type: ignore[no-untyped-def]
    """First point after `start` at which s + i·drift_x or t + i·drift_y has left [0, 1)."""
    steps = float(count - start)
    if drift_x > SMALLEST_DRIFT:
        steps = min(steps, (1.0 - s) / drift_x)
    elif drift_x < -SMALLEST_DRIFT:
        steps = min(steps, -s / drift_x)
    if drift_y > SMALLEST_DRIFT:
        steps = min(steps, (1.0 - t) / drift_y)
    elif drift_y < -SMALLEST_DRIFT:
        steps = min(steps, -t / drift_y)
    return min(count, start + 1 + int(steps))


@njit(parallel=True)
def _sample_squares(c, degree, centres, radius, squares):  # type: ignore[no-untyped-def]
    """Every square that lies in the image."""
    right, bottom = c.shape[1] - 2 * PADDING_PX - 1, c.shape[0] - 2 * PADDING_PX - 1
    for n in prange(centres.shape[0]):
        x, y = centres[n, 0] - radius, centres[n, 1] - radius
        if x >= 0.0 and y >= 0.0 and x + 2 * radius <= right and y + 2 * radius <= bottom:
            _sample_square(c, degree, x, y, 2 * radius + 1, squares[n])


@njit()
def _sample_square(c, degree, x, y, side, square):  # type: ignore[no-untyped-def]
    """One square with its first point at (x, y)."""
    column, row = min(int(x), c.shape[1] - 2 * PADDING_PX - side), min(int(y), c.shape[0] - 2 * PADDING_PX - side)
    wx, sx, wy, sy = np.empty(8), np.empty(8), np.empty(8), np.empty(8)
    basis(x - column, degree, wx, sx)
    basis(y - row, degree, wy, sy)
    left, top = column + PADDING_PX - degree // 2, row + PADDING_PX - degree // 2
    smooth, slope = np.empty(side), np.empty(side)
    square[:] = 0.0
    for r in range(side + degree):
        smooth[:] = 0.0
        slope[:] = 0.0
        for j in range(degree + 1):
            line = c[top + r, left + j : left + j + side]
            for i in range(side):
                smooth[i] += wx[j] * line[i]
                slope[i] += sx[j] * line[i]
        for k in range(max(0, r - side + 1), min(degree, r) + 1):
            first = (r - k) * side
            value, along = square[0, first : first + side], square[1, first : first + side]
            down = square[2, first : first + side]
            for i in range(side):
                value[i] += wy[k] * smooth[i]
                along[i] += wy[k] * slope[i]
                down[i] += sy[k] * smooth[i]


def _fill_block(builder: Any, weights: Callable[..., Any], image: Any, offsets: Any, grey: Any, mask: Any) -> None:
    """Code for eight points, or those of a mask: grey = Σ_k b_k(t) Σ_j a_j(s) c[k, j + i].

    image: pointer to the first coefficient and the row's length. offsets: s and t of the points.
    """
    (first, width), (a, b) = image, (weights(offset) for offset in offsets)
    lines = []
    for k in range(len(b)):
        row = builder.gep(first, [builder.mul(ir.Constant(INDEX, k), width)])
        taps = [along * load(builder, builder.gep(row, [ir.Constant(INDEX, j)]), mask) for j, along in enumerate(a)]
        lines.append(reduce(add, taps))
    store(builder, reduce(add, (down * line for down, line in zip(b, lines, strict=True))), grey, mask)


def _run_code(weights: Callable[..., Any]) -> Callable[..., Any]:
    """Generator of the code of one run for the B-spline weights of one degree: whole blocks, then a masked one."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        c, row, column, s, t, drift_x, drift_y, grey, start, stop = arguments
        table = context.make_array(signature.args[0])(context, builder, c)
        line = context.make_array(signature.args[7])(context, builder, grey)
        width = cgutils.unpack_tuple(builder, table.shape)[1]
        corner = builder.gep(table.data, [builder.add(builder.mul(row, width), column)])

        def block(index: Any, mask: Any) -> None:
            image = builder.gep(corner, [index]), width
            points = counted(builder, builder.sitofp(index, REAL))
            offsets = [points * spread(builder, drift) + spread(builder, begin) for begin, drift in along]
            _fill_block(builder, weights, image, offsets, builder.gep(line.data, [builder.add(start, index)]), mask)

        along = (s, drift_x), (t, drift_y)
        in_blocks(builder, builder.sub(stop, start), block)
        return context.get_dummy_value()

    return generate


def _run_type(c: Any, grey: Any) -> Any:
    """Types of a run's arguments; the arrays must be contiguous doubles."""
    if (c.layout, c.dtype, grey.layout, grey.dtype) != ("C", types.float64, "C", types.float64):
        raise TypeError(f"c, grey: expected contiguous float64 arrays, found {c} and {grey}")
    whole, real = types.int64, types.float64
    return types.void(c, whole, whole, real, real, real, real, grey, whole, whole)


@intrinsic
def _run_septic(typing, c, row, column, s, t, drift_x, drift_y, grey, start, stop):  # type: ignore[no-untyped-def]
    """Septic values of the points start … stop of one run, whose coefficients begin at c[row, column]."""
    return _run_type(c, grey), _run_code(weights_septic.py_func)


@intrinsic
def _run_quintic(typing, c, row, column, s, t, drift_x, drift_y, grey, start, stop):  # type: ignore[no-untyped-def]
    """Quintic values of the points start … stop of one run, whose coefficients begin at c[row, column]."""
    return _run_type(c, grey), _run_code(weights_quintic.py_func)


@intrinsic
def _run_cubic(typing, c, row, column, s, t, drift_x, drift_y, grey, start, stop):  # type: ignore[no-untyped-def]
    """Cubic values of the points start … stop of one run, whose coefficients begin at c[row, column]."""
    return _run_type(c, grey), _run_code(weights_cubic.py_func)
