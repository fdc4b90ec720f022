"""Poles that many decaying records share, from the signal space of their windows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shaker._checks import ComplexArray, FloatArray

_WINDOW = 128
_STANDS_OUT = 12.0
_ABOVE_NOISE = 2.5
_MOST = 40
_CALMEST, _QUICKEST = -0.02, 0.4


def highest_frequency(parts: Sequence[FloatArray], rate_hz: float) -> float:
    """Return the highest frequency in Hz at which records (C, N) of unit noise swing clearly above their noise."""
    size = min(part.shape[1] for part in parts)
    density = np.zeros(size // 2 + 1)
    for part in parts:
        window = np.hanning(size)
        lines = np.fft.rfft((part[:, :size] - part[:, :size].mean(axis=1, keepdims=True)) * window, axis=1)
        density += np.sum(np.abs(lines) ** 2, axis=0) / np.sum(window**2)
    density /= sum(len(part) for part in parts)
    floor = max(1.0, float(np.median(density[len(density) // 2 :])))
    smooth = np.convolve(density, np.ones(3) / 3.0, mode="same")
    peaks = np.flatnonzero((smooth[1:-1] >= smooth[:-2]) & (smooth[1:-1] >= smooth[2:])) + 1
    high = peaks[smooth[peaks] > _STANDS_OUT * floor]
    return float((high[-1] if high.size else 1) * rate_hz / size)


def averaged(samples: FloatArray, size: int) -> FloatArray:
    """Return means (…, A) over blocks of `size` samples (…, N); samples that fill no block are left out."""
    count = samples.shape[-1] // size
    return np.asarray(samples[..., : count * size].reshape(*samples.shape[:-1], count, size).mean(axis=-1))


def shared_poles(parts: Sequence[FloatArray], rate_hz: float) -> ComplexArray:
    """Return the upper poles in rad/s of decaying records (C, N) of equal white noise that share a sampling rate.

    All windows of L samples of Σ a·exp(p t) lie in the span of the vectors exp(p n/f), n = 0 … L - 1, whatever a is:
    the eigenvectors of the sum of their products above the noise span it, and a shift by one sample turns it by
    exp(p/f) (Hua and Sarkar, matrix pencil, IEEE Trans. ASSP 38 (1990) 814; Roy and Kailath, ESPRIT, 1989).
    """
    length = min(_WINDOW, min(part.shape[1] for part in parts) // 2)
    gram = np.zeros((length, length))
    windows = 0
    for part in parts:
        for row in part:
            table = np.lib.stride_tricks.sliding_window_view(row, length)
            gram += table.T @ table
            windows += len(table)
    value, vector = np.linalg.eigh(gram / windows)
    noise = float(np.median(value[: length // 2]))
    count = int(np.clip(np.count_nonzero(value > _ABOVE_NOISE * noise), 3, min(_MOST, length // 2)))
    space = vector[:, -count:]
    turns = np.linalg.eigvals(np.linalg.lstsq(space[:-1], space[1:], rcond=None)[0])
    poles = np.log(turns[np.abs(turns) > 1e-6] + 0j) * rate_hz
    ratio = -poles.real / np.abs(poles)
    kept = (poles.imag > 2e-3 * rate_hz) & (poles.imag < 0.9 * np.pi * rate_hz)
    return np.asarray(poles[kept & (ratio > _CALMEST) & (ratio < _QUICKEST)])
