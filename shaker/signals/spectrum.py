"""Spectra of records, and the noise density around a line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import BoolArray, FloatArray, check_shape

Window = Literal["rectangular", "hann", "flattop"]

_COSINES: dict[str, tuple[float, ...]] = {
    "rectangular": (1.0,),
    "hann": (0.5, -0.5),
    "flattop": (0.21557895, -0.41663158, 0.277263158, -0.083578947, 0.006947368),  # ISO 18431-2
}
_NEIGHBOURS = 48  # bins from which the noise around a line is estimated
_MIN_NEIGHBOURS = 12
_CLEARANCE = 0.75  # bins beside a line that its own fit has emptied
_WHITTLE_STEPS = 200
_COLOURED_DOF = 10.0  # of a level read off A + B/j, from the scatter of that level in trials (corner 5 Hz, 4 s)


@dataclass(frozen=True)
class Spectrum:
    """One-sided amplitude spectrum: `frequency_hz` (B,), `amplitude` (B,) or (B, C), peak amplitude of a sine."""

    frequency_hz: FloatArray
    amplitude: FloatArray

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (None,))
        if self.amplitude.shape[:1] != self.frequency_hz.shape:
            raise ValueError(
                f"amplitude: expected {len(self.frequency_hz)} bins, found an array of shape {self.amplitude.shape}"
            )


@dataclass(frozen=True)
class LineNoise:
    """Variance that a white series would need to disturb each line as the actual noise does.

    `variance` (K, C) in the squared unit of the samples, `dof` (K,) of the estimate.
    """

    variance: FloatArray
    dof: FloatArray


def window_samples(window: Window, samples: int) -> FloatArray:
    """Return a periodic window (S,) with mean 1, so that a sine keeps its amplitude."""
    coefficients = _COSINES[window]
    angle = 2.0 * np.pi * np.arange(samples) / samples
    total = sum(c * np.cos(i * angle) for i, c in enumerate(coefficients))
    return np.asarray(total / coefficients[0], dtype=np.float64)


def amplitude_spectrum(samples: FloatArray, sample_rate_hz: float, window: Window = "hann") -> Spectrum:
    """Return the one-sided amplitude spectrum of samples (S,) or (S, C), their mean removed.

    A sine on a bin shows its peak amplitude; between bins the window's scallop loss applies (Hann 15 %, flat top
    0.1 %).
    """
    count = len(samples)
    if count < 2:
        raise ValueError(f"samples: expected at least 2 samples, found {count}")
    centred = samples - samples.mean(axis=0)
    shape = window_samples(window, count).reshape((count,) + (1,) * (samples.ndim - 1))
    amplitude = np.abs(np.fft.rfft(centred * shape, axis=0)) * (2.0 / count)
    amplitude[0] /= 2.0
    if count % 2 == 0:
        amplitude[-1] /= 2.0
    return Spectrum(np.asarray(np.fft.rfftfreq(count, 1.0 / sample_rate_hz), dtype=np.float64), np.asarray(amplitude))


def noise_floor(spectrum: Spectrum, half_width: int = 32) -> FloatArray:
    """Return the local noise floor of an amplitude spectrum: the median over ±`half_width` bins, as an rms amplitude.

    For Gaussian noise a bin's amplitude has a Rayleigh distribution, median/rms = √ln 2; the median passes over lines.
    """
    from scipy.ndimage import median_filter

    size = min(2 * half_width + 1, len(spectrum.frequency_hz))
    footprint = (size,) + (1,) * (spectrum.amplitude.ndim - 1)
    return np.asarray(median_filter(spectrum.amplitude, size=footprint, mode="nearest") / np.sqrt(np.log(2.0)))


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
