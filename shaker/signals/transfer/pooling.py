"""Noise of neighbouring lines taken together, where the lines are alike."""

from __future__ import annotations

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray

_NEIGHBOURS = 4  # lines on either side that share one estimate of the noise
_ALIKE = 1.12  # factor between |H| of lines that share one estimate of the noise
_STANDS_OUT = 1e-5  # probability below which a line counts as noisier than its neighbours


def pooled_scatter(scatter: ComplexArray, ratio: ComplexArray, dof: float) -> tuple[ComplexArray, FloatArray]:
    """Return the noise (K, C, C) averaged over up to 9 neighbouring lines, and how many lines (K,) each average has.

    Lines share where |H| (K, C) is alike in all channels, so that noise which passes through the structure, or noise of
    the reference seen through H, may follow a resonance. A line that is noisier than `dof` degrees of freedom allow
    (mains, a spur) keeps its own noise to itself.
    """
    lines = len(scatter)
    index = np.arange(lines)
    alone = _stands_out(np.einsum("kcc->kc", scatter).real, dof)
    magnitude = np.maximum(np.abs(ratio), np.finfo(np.float64).tiny)
    total, number = scatter.copy(), np.ones(lines)
    for offset in (*range(-_NEIGHBOURS, 0), *range(1, _NEIGHBOURS + 1)):
        other = np.clip(index + offset, 0, lines - 1)
        quotient = magnitude[other] / magnitude
        alike = (other == index + offset) & np.all((quotient < _ALIKE) & (quotient > 1.0 / _ALIKE), axis=1)
        alike &= ~alone & ~alone[other]
        total[alike] += scatter[other[alike]]
        number += alike
    return total / number[:, None, None], number


def _stands_out(level: FloatArray, dof: float) -> BoolArray:
    """Tell which lines are noisier than a common noise lets a line be in any channel of `level` (K, C)."""
    from scipy.ndimage import median_filter
    from scipy.special import chdtri

    around = median_filter(level, size=(min(4 * _NEIGHBOURS + 1, len(level)), 1), mode="nearest")
    return np.asarray(np.any(level > chdtri(dof, _STANDS_OUT) / chdtri(dof, 0.5) * around, axis=1))
