"""Which harmonics a periodic reference excites."""

from __future__ import annotations

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray

_SIGNAL = 10.0  # mean over its standard uncertainty from which a line is a signal
_STRONG = 0.1  # share of the largest line nearby from which a line is excited for sure
_NEARBY = 12  # lines on either side that are nearby
_WEAKEST = 1e-3  # share of the largest line of all below which a line is a distortion or a spur
_DENSE = 0.7  # share of strong lines from which every line of a band is excited (a chirp)


def excited_lines(reference: ComplexArray) -> BoolArray:
    """Tell which lines (K,) the phasors (M, K) of M periods of a reference excite.

    A line is excited that stands ten times above its own standard uncertainty and, where only some lines are excited
    (multisine with unexcited lines that show distortions), above a tenth of the largest line nearby.
    """
    from scipy.ndimage import maximum_filter1d

    lines = reference.shape[1]
    magnitude = np.abs(reference.mean(axis=0))
    signal = magnitude > _SIGNAL * _u_mean(reference)
    nearby = maximum_filter1d(magnitude, size=min(2 * _NEARBY + 1, lines), mode="nearest")
    strong = signal & (magnitude > _STRONG * nearby) & (magnitude > _WEAKEST * magnitude.max(initial=0.0))
    if not strong.any():
        return np.asarray(strong)
    place = np.flatnonzero(strong)
    inside = np.zeros(lines, dtype=np.bool_)
    inside[place[0] : place[-1] + 1] = True
    dense = np.count_nonzero(strong) > _DENSE * np.count_nonzero(inside)
    return np.asarray(inside & signal if dense else strong)


def _u_mean(reference: ComplexArray) -> FloatArray:
    """Return the standard uncertainty of the mean over periods, of both quadratures together, from lines nearby."""
    from scipy.ndimage import uniform_filter1d

    count, lines = reference.shape
    scatter = np.sum(np.abs(reference - reference.mean(axis=0)) ** 2, axis=0) / (count - 1)
    smooth = uniform_filter1d(scatter, size=min(2 * _NEARBY + 1, lines), mode="nearest")
    return np.asarray(np.sqrt(np.maximum(smooth, scatter) / count))
