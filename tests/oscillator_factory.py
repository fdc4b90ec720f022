"""Exact signals of an oscillator: every response is its frequency response times the excitation's spectrum."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shaker.frf.result import TransferRecord

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
F0_HZ, Q = 1477.35, 66.0
ZETA = 0.5 / Q


def transmissibility(frequency_hz: FloatArray) -> ComplexArray:
    """Motion of the mass over that of its base."""
    r = np.asarray(frequency_hz) / F0_HZ
    return np.asarray((1.0 + 2j * ZETA * r) / (1.0 - r**2 + 2j * ZETA * r))


def accelerance(s: ComplexArray) -> ComplexArray:
    """Acceleration over force at s = a + jω, stiffness 1e8 N/m."""
    p = s / (2.0 * np.pi * F0_HZ)
    return np.asarray(1e-8 * s**2 / (1.0 + 2.0 * ZETA * p + p * p))


def chirp(period: float, rate_hz: float, band_hz: tuple[float, float]) -> tuple[FloatArray, ComplexArray]:
    """Harmonics inside a band and their phasors, all of one size, quadratic phases (Schroeder 1970)."""
    first, last = (int(edge * period / rate_hz) for edge in band_hz)
    harmonic = np.arange(first + 1.0, last + 1.0)
    count = len(harmonic)
    return harmonic, np.sqrt(2.0 / count) * np.exp(-1j * np.pi * (harmonic - harmonic[0]) ** 2 / count)


def periodic(harmonic: FloatArray, phasor: ComplexArray, period: float, samples: int) -> FloatArray:
    """Samples of Σ Re{X exp(2πjkn/P)}, X (K,) or (K, C), P any number of samples, by direct summation."""
    if period == round(period) < samples:
        once = periodic(harmonic, phasor, period, round(period))
        return np.resize(once, (samples, *phasor.shape[1:]))
    signal = np.zeros((samples, *phasor.shape[1:]))
    for start in range(0, samples, 2048):
        n = np.arange(start, min(samples, start + 2048))
        signal[n] = (np.exp(2j * np.pi / period * np.multiply.outer(n, harmonic)) @ phasor).real
    return signal


def record(
    reference: FloatArray, response: FloatArray, rate_hz: float, noise: float = 0.0, seed: int = 0
) -> TransferRecord:
    """Reference and one response, both with white noise of a share of their rms (a blow's: of its peak)."""
    rng = np.random.default_rng(seed)
    noisy = [
        signal + noise * (signal.std() if unit == "m/s^2" else np.abs(signal).max()) * rng.standard_normal(len(signal))
        for signal, unit in ((reference, "m/s^2"), (response, "m/s^2"))
    ]
    return TransferRecord(noisy[0], noisy[1][:, None], rate_hz, "base", "m/s^2", ("top",), ("m/s^2",))


def deviations(error: ComplexArray, covariance: FloatArray) -> FloatArray:
    """Half the squared Mahalanobis length of complex errors (K,): distributed as F(2, dof)."""
    both = np.stack([error.real, error.imag], axis=1)
    return np.asarray(np.einsum("ki,kij,kj->k", both, np.linalg.inv(covariance), both) / 2.0)


def random_pair(samples: int, rate_hz: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Base and mass in noise from 50 Hz to a third of the rate: a piece of a periodic record three times as long."""
    rng = np.random.default_rng(seed)
    frequency = np.asarray(np.fft.rfftfreq(3 * samples, 1.0 / rate_hz), dtype=np.float64)
    spectrum = rng.standard_normal(len(frequency)) + 1j * rng.standard_normal(len(frequency))
    spectrum *= np.sqrt(samples) * ((frequency > 50.0) & (frequency < rate_hz / 3.0))
    pair = [
        np.fft.irfft(part, 3 * samples)[samples : 2 * samples]
        for part in (spectrum, spectrum * transmissibility(frequency))
    ]
    return pair[0], pair[1]


def blow(
    samples: int, rate_hz: float, before: int, height_n: float, width_s: float = 8e-5
) -> tuple[FloatArray, FloatArray]:
    """A Gaussian blow and the acceleration after it, the record long enough for it to die away."""
    time = (np.arange(samples) - before) / rate_hz
    force = height_n * np.exp(-0.5 * (time / width_s - 3.5) ** 2)
    s = np.asarray(2j * np.pi * np.fft.rfftfreq(samples, 1.0 / rate_hz), dtype=np.complex128)
    return force, np.fft.irfft(np.fft.rfft(force) * accelerance(s), samples)
