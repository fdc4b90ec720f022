"""The noise that disturbs a line: spectral density of the residual around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import BoolArray, FloatArray

_NEIGHBOURS = 48  # bins from which the noise around a line is estimated
_MIN_NEIGHBOURS = 12
_CLEARANCE = 0.75  # bins beside a line that its own fit has emptied
_WHITTLE_STEPS = 200
_COLOURED_DOF = 10.0  # of a level read off A + B/j, from the scatter of that level in trials (corner 5 Hz, 4 s)


@dataclass(frozen=True)
class LineNoise:
    """Variance that a white series would need to disturb each line as the actual noise does.

    `variance` (K, C) in the squared unit of the samples, `dof` (K,) of the estimate.
    """

    variance: FloatArray
    dof: FloatArray


def line_noise(residual: FloatArray, samples: int, line_bin: FloatArray) -> LineNoise | None:
    """Return the noise of lines at fractional bins (K,) from the residual (L, C) of their fit, zero-filled in gaps.

    `samples` is the number of samples present. The periodogram of the bins nearest to a line (those that a fitted line
    or the mean has emptied left out) is fitted by S(j) = A + B/j with A, B ≥ 0 by maximum Whittle likelihood, and
    read at the line; drift and 1/f noise thus count where they act, and white noise at the lowest bins is overstated
    somewhat. The multiplicative iteration is that of Févotte, Bertin and Durrieu, Neural
    Computation 21 (2009), for the Itakura-Saito divergence. None where the record has too few bins.
    """
    length = len(residual)
    # Bin 0 is the offset's and the Nyquist bin of an even length has one quadrature only.
    bins = np.arange(1.0, (length + 1) // 2)
    free = _free_bins(bins, line_bin)
    if np.count_nonzero(free) < _MIN_NEIGHBOURS:
        return None
    transform = np.fft.rfft(np.ascontiguousarray(residual.T), axis=1)[:, 1 : len(bins) + 1]
    power = (np.abs(transform[:, free]) ** 2 / samples).T
    candidates = bins[free]
    count = min(_NEIGHBOURS, len(candidates))
    chosen = np.stack([_nearest(candidates, j, count) for j in line_bin])
    variance, coloured = _whittle_level(power[chosen], candidates[chosen], np.maximum(line_bin, 0.5))
    return LineNoise(variance, np.where(coloured.any(axis=1), min(_COLOURED_DOF, count), float(count)))


def _free_bins(bins: FloatArray, line_bin: FloatArray) -> BoolArray:
    """Tell which bins no fitted line has emptied."""
    free = np.ones(len(bins), dtype=np.bool_)
    for j in line_bin:
        low, high = np.searchsorted(bins, [j - _CLEARANCE, j + _CLEARANCE])
        free[low:high] = False
    return free


def _nearest(candidates: FloatArray, j: float, count: int) -> FloatArray:
    """Return the indices of the `count` candidates nearest to bin j."""
    place = int(np.searchsorted(candidates, j))
    low = max(0, min(place - count, len(candidates) - 2 * count))
    window = np.arange(low, min(len(candidates), low + 2 * count))
    order = np.argsort(np.abs(candidates[window] - j), kind="stable")
    return np.asarray(window[order[:count]])


def _whittle_level(power: FloatArray, bins: FloatArray, line_bin: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Fit A + B·(line/j) to periodograms (K, M, C) at bins (K, M); return A + B (K, C) and where B matters.

    It matters where it raises the log-likelihood by more than 1 (Akaike's criterion).
    """
    basis = np.stack([np.ones_like(bins), line_bin[:, None] / bins], axis=-1)
    tiny = np.finfo(np.float64).tiny ** 0.25
    white = power.mean(axis=1) + tiny
    level = np.repeat((white / 2.0)[:, None, :], 2, axis=1)
    for _ in range(_WHITTLE_STEPS):
        model = basis @ level
        up = basis.swapaxes(1, 2) @ (power / model**2)
        down = basis.swapaxes(1, 2) @ (1.0 / model)
        level = level * up / down + tiny
    model = basis @ level
    gain = power.shape[1] * (np.log(white) + 1.0) - np.sum(np.log(model) + power / model, axis=1)
    coloured = gain > 1.0
    return level.sum(axis=1), coloured
