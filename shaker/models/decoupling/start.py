"""Poles that many decaying records share, from the signal space of their windows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shaker._checks import ComplexArray, FloatArray

_WINDOW = 128
_STANDS_OUT = 30.0
"""Noise alone reaches this density, over its mean, once in exp(30) lines."""
_ABOVE_NOISE = 1.5
_MOST = 40
_CALMEST, _QUICKEST = 0.0, 0.4


def highest_frequency(parts: Sequence[FloatArray], rate_hz: float) -> float:
    """Return the highest frequency in Hz at which a record (C, N) of unit noise swings clearly above its noise."""
    highest = 0.0
    for part in parts:
        window = np.hanning(part.shape[1])
        lines = np.fft.rfft((part - part.mean(axis=1, keepdims=True)) * window, axis=1)
        density = np.abs(lines) ** 2 / np.sum(window**2)
        floor = np.maximum(1.0, np.median(density[:, density.shape[1] // 2 :], axis=1, keepdims=True) / np.log(2.0))
        clear = np.flatnonzero(np.any(density > _STANDS_OUT * floor, axis=0))
        highest = max(highest, float(clear[-1] if clear.size else 1) * rate_hz / part.shape[1])
    return highest


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
