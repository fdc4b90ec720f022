"""Noise of neighbouring lines taken together."""

from __future__ import annotations

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray

_NEIGHBOURS = 8  # lines on either side that share one estimate of the noise
_BLOCK = 64  # lines over which the shares of the noise are steady
_SHAPE_STEPS = 60
_STANDS_OUT = 1e-5  # probability below which a line counts as noisier than its neighbours


def pooled_scatter(scatter: ComplexArray, ratio: ComplexArray, dof: float) -> tuple[ComplexArray, FloatArray]:
    """Return the noise (K, C, C) averaged over up to 17 neighbouring lines, and how many lines (K,) each average has.

    Across a resonance the noise of y - Hx is not level: that of the response is, that of the reference arrives times
    |H|², and so does what shakes the base. So every line's scatter is first divided by a shape A + B|H|², A, B ≥ 0
    steady over 64 lines, then averaged, then multiplied by the shape again. A line that is noisier than `dof` degrees
    of freedom allow (mains, a spur) keeps its own noise to itself; where its scatter has too few degrees of freedom for
    the correlation of C responses, that of the neighbours, enlarged.
    """
    lines = len(scatter)
    level = np.einsum("kcc->kc", scatter).real
    shape = np.sqrt(np.sum(_shape(level, np.abs(ratio) ** 2), axis=0))
    product = shape[:, :, None] * shape[:, None, :]
    even = scatter / product
    alone = _stands_out(level / shape**2, dof)
    counted = np.where(alone[:, None, None], 0.0, even)
    total, number = np.zeros_like(counted), np.zeros(lines)
    for offset in range(-min(_NEIGHBOURS, lines - 1), min(_NEIGHBOURS, lines - 1) + 1):
        first, last = max(0, -offset), min(lines, lines - offset)
        total[first:last] += counted[first + offset : last + offset]
        number[first:last] += ~alone[first + offset : last + offset]
    mean = np.asarray(total / np.maximum(number, 1.0)[:, None, None], dtype=np.complex128)
    own = even if dof >= 2.0 * level.shape[1] else _enlarged(mean, even)
    mean = np.where(alone[:, None, None], own, mean)
    return np.asarray(mean * product), np.where(alone, 1.0, number)


def _enlarged(mean: ComplexArray, even: ComplexArray) -> ComplexArray:
    """Return the neighbours' noise (K, C, C) times what the line's own exceeds it by in the channel where most so."""
    around, level = (np.einsum("kcc->kc", part).real for part in (mean, even))
    tiny = np.finfo(np.float64).tiny
    factor = np.max(level / np.maximum(around, tiny), axis=1)
    return np.asarray(np.where(np.any(around > 0.0, axis=1)[:, None, None], mean * factor[:, None, None], even))


def share_of_reference(scatter: ComplexArray, ratio: ComplexArray) -> FloatArray:
    """Return the share (K, C) that arrives times |H|² in the noise (K, C, C) of y - Hx, as `pooled_scatter` sees it."""
    level, gain = np.einsum("kcc->kc", scatter).real, np.abs(ratio) ** 2
    flat, through = _shape(level, gain)
    return np.asarray(through / (flat + through))


def _shape(level: FloatArray, gain: FloatArray) -> FloatArray:
    """Return A and B·gain (2, K, C) of noise levels with an exponential-like scatter, by maximum Whittle likelihood.

    The multiplicative steps are those of Févotte, Bertin and Durrieu, Neural Computation 21 (2009).
    """
    tiny = np.finfo(np.float64).tiny ** 0.25
    lines = len(level)
    size = min(_BLOCK, lines)
    blocks = max(1, lines // size)
    edges = np.linspace(0, lines, blocks + 1).astype(np.int64)[:-1]
    count = np.diff(np.append(edges, lines))
    basis = np.stack([np.ones_like(gain), gain], axis=-1)
    white = np.add.reduceat(level, edges, axis=0) / count[:, None] + tiny
    steady = np.add.reduceat(basis, edges, axis=0) / count[:, None, None] + tiny
    coefficients = 0.5 * white[:, :, None] / steady
    for _ in range(_SHAPE_STEPS):
        model = np.sum(basis * np.repeat(coefficients, count, axis=0), axis=-1)
        up = np.add.reduceat(basis * (level / model**2)[:, :, None], edges, axis=0)
        down = np.add.reduceat(basis / model[:, :, None], edges, axis=0)
        coefficients = coefficients * np.sqrt(up / down) + tiny**2
    return np.asarray(np.moveaxis(basis * np.repeat(coefficients, count, axis=0), -1, 0) + 0.5 * tiny)


def _stands_out(level: FloatArray, dof: float) -> BoolArray:
    """Tell which lines are noisier than a common noise lets a line be in any channel of `level` (K, C)."""
    from scipy.ndimage import median_filter
    from scipy.special import chdtri

    around = median_filter(level, size=(min(2 * _NEIGHBOURS + 1, len(level)), 1), mode="nearest")
    return np.asarray(np.any(level > chdtri(dof, _STANDS_OUT) / chdtri(dof, 0.5) * around, axis=1))
