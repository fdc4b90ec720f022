"""What a compensation filter makes of the sensor's noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.models.compensation.discrete import Sections


@dataclass(frozen=True)
class FilteredNoise:
    """Noise after a filter: `density` (K,) in output unit/√Hz at `frequency_hz` (K,), and `std` over that range."""

    frequency_hz: FloatArray
    density: FloatArray
    std: float


def white_noise_gain(sections: Sections) -> float:
    """Return standard deviation out over in of white noise of the sampling: √Σh², h the impulse response.

    By the covariance P = APAᵀ + BBᵀ of the state, Σh² = CPCᵀ + D².
    """
    from scipy.linalg import solve_discrete_lyapunov

    a, b, c, d = state_space(sections)
    spread = solve_discrete_lyapunov(a, np.outer(b, b), method="direct")
    return float(np.sqrt(c @ spread @ c + d**2))


def filtered_noise(sections: Sections, frequency_hz: FloatArray, density: FloatArray) -> FilteredNoise:
    """Return what a measured noise density (K,), in unit/√Hz at rising frequencies (K,), becomes; std by trapezoids."""
    check_shape("density", density, frequency_hz.shape)
    if len(frequency_hz) < 2 or np.any(np.diff(frequency_hz) <= 0) or np.any(density < 0):
        raise ValueError("frequency_hz, density: expected rising frequencies and densities of at least 0, found others")
    after = np.abs(sections.response(frequency_hz)) * density
    return FilteredNoise(frequency_hz, after, float(np.sqrt(np.trapezoid(after**2, frequency_hz))))


def state_space(sections: Sections) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return A (2S, 2S), B, C (2S,), D of the sections in a row, x[n+1] = A x[n] + B u[n], y = C x + D u.

    The states are those of the second transposed direct form, section after section, as the streaming filter has them.
    """
    size = 2 * len(sections.sos)
    a, b, c, d = np.zeros((size, size)), np.zeros(size), np.zeros(size), 1.0
    for place, (b0, b1, b2, _, a1, a2) in enumerate(sections.sos):
        own = slice(2 * place, 2 * place + 2)
        through = np.array([b1 - a1 * b0, b2 - a2 * b0])
        a[own] += np.outer(through, c)
        a[own, own] += np.array([[-a1, 1.0], [-a2, 0.0]])
        b[own] = through * d
        c, d = b0 * c, b0 * d
        c[2 * place] += 1.0
    return a, b, sections.gain * c, float(sections.gain * d)
