"""Amplitude spectra of records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import FloatArray, check_shape

Window = Literal["rectangular", "hann", "flattop"]

_COSINES: dict[str, tuple[float, ...]] = {
    "rectangular": (1.0,),
    "hann": (0.5, -0.5),
    "flattop": (0.21557895, -0.41663158, 0.277263158, -0.083578947, 0.006947368),  # ISO 18431-2
}


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
