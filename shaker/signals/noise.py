"""The noise that disturbs a line: spectral density of the residual around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import BoolArray, FloatArray, IntArray

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

    `samples` is the number of samples present. None where the record has too few bins.
    """
    bins = neighbour_bins(len(residual), line_bin)
    if bins is None:
        return None
    # The transposed copy makes every channel's transform contiguous, several times faster for long records.
    transform = np.fft.rfft(np.ascontiguousarray(residual.T), axis=1)
    power = np.abs(transform[:, bins]) ** 2 / samples
    return level_at_lines(np.moveaxis(power, 0, -1), bins.astype(np.float64), line_bin)


def neighbour_bins(length: int, line_bin: FloatArray) -> IntArray | None:
    """Return the bins (K, M) of a record of `length` samples from which `level_at_lines` reads the noise of lines (K,).

    The nearest to each line, ascending, without those that a fitted line or the mean has emptied; None where there are
    too few.
    """
    # Bin 0 is the offset's and the Nyquist bin of an even length has one quadrature only.
    bins = np.arange(1, (length + 1) // 2)
    candidates = bins[_free_bins(bins.astype(np.float64), line_bin)]
    if len(candidates) < _MIN_NEIGHBOURS:
        return None
    count = min(_NEIGHBOURS, len(candidates))
    return np.stack([np.sort(candidates[_nearest(candidates, j, count)]) for j in line_bin])


def level_at_lines(power: FloatArray, bins: FloatArray, line_bin: FloatArray) -> LineNoise:
    """Return the noise of lines at fractional bins (K,) from periodogram ordinates (K, M, C) at bins (K, M) near each.

    Ordinates are |DFT|² over the number of samples, so that white noise of variance σ² has mean σ². They are fitted by
    S(j) = A + B/j with A, B ≥ 0 by maximum Whittle likelihood, and read at the line; drift and 1/f noise thus count
    where they act, and white noise at the lowest bins is overstated somewhat. The multiplicative iteration is that of
    Févotte, Bertin and Durrieu, Neural Computation 21 (2009), for the Itakura-Saito divergence.
    """
    variance, coloured = _whittle_level(power, bins, np.maximum(line_bin, 0.5))
    count = power.shape[1]
    return LineNoise(variance, np.where(coloured.any(axis=1), min(_COLOURED_DOF, count), float(count)))


def _free_bins(bins: FloatArray, line_bin: FloatArray) -> BoolArray:
    """Tell which bins no fitted line has emptied."""
    free = np.ones(len(bins), dtype=np.bool_)
    for j in line_bin:
        low, high = np.searchsorted(bins, [j - _CLEARANCE, j + _CLEARANCE])
        free[low:high] = False
    return free


def _nearest(candidates: IntArray, j: float, count: int) -> IntArray:
    """Return the indices of the `count` candidates nearest to bin j."""
    place = int(np.searchsorted(candidates, j))
    low = max(0, min(place - count, len(candidates) - 2 * count))
    window = np.arange(low, min(len(candidates), low + 2 * count))
    order = np.argsort(np.abs(candidates[window] - j), kind="stable")
    return np.asarray(window[order[:count]], dtype=np.int64)


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
