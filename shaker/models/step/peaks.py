"""The spectrum of a response: its first and second peak."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.step.reading import SpectrumPeak
from shaker.signals.spectrum import Spectrum

_LEVEL = 5.0  # noise levels that a peak must stand above
_PADDED = 4  # length of the transform over that of the record
_DIP = 7.0  # noise levels that the spectrum dips by between two peaks
_SHARE = 1e-3  # of the highest peak below which others are the window's
_REFINED = 40


def response_spectrum(ringing: FloatArray, sample_rate_hz: float) -> Spectrum:
    """Return the one-sided amplitude spectrum of what rings (N,) about its level, in its unit.

    Weighted with half a Hann window, cos²(πn/2N), which begins with the ringing and ends it softly; a lasting sine
    shows its amplitude.
    """
    window = _window(len(ringing))
    amplitude = 2.0 * np.abs(np.fft.rfft(ringing * window, _PADDED * len(ringing))) / window.sum()
    frequency = np.fft.rfftfreq(_PADDED * len(ringing), 1.0 / sample_rate_hz)
    return Spectrum(np.asarray(frequency, dtype=np.float64), np.asarray(amplitude, dtype=np.float64))


def spectrum_peaks(ringing: FloatArray, sample_rate_hz: float, noise: float, most: int = 2) -> tuple[SpectrumPeak, ...]:
    """Return the `most` highest peaks of `response_spectrum`, in order of frequency, found between its lines.

    At a maximum of |X|², X(f) = Σ w·y·exp(-j2πft), white noise of standard deviation `noise` moves the frequency by
    -Σ n·c/(|X|²)'' with c = d(|X|²)'/dy, and the amplitude by Re(X* N)/|X|.
    """
    spectrum = response_spectrum(ringing, sample_rate_hz)
    window = _window(len(ringing))
    size, floor = spectrum.amplitude, 2.0 * noise * float(np.sqrt(np.sum(window**2))) / window.sum()
    inner = size[1:-1]
    tops = np.flatnonzero((inner > size[:-2]) & (inner >= size[2:])) + 1
    tops = tops[(tops >= 2 * _PADDED) & (size[tops] > max(_LEVEL * floor, _SHARE * size.max()))]
    order: list[int] = []
    for top in tops[np.argsort(-size[tops], kind="stable")]:
        if all(_apart(size, top, other, _DIP * floor) for other in order) and len(order) < most:
            order.append(int(top))
    found = [
        _refined(ringing * window, window, sample_rate_hz, float(spectrum.frequency_hz[top]), noise) for top in order
    ]
    if not found:
        return ()
    _, _, highest, u_highest = found[0]
    peaks = [
        SpectrumPeak(
            f, u_f, float(a / highest), float(np.hypot(u_a / highest, a / highest * u_highest / highest)) if n else 0.0
        )
        for n, (f, u_f, a, u_a) in enumerate(found)
    ]
    return tuple(sorted(peaks, key=lambda peak: peak.frequency_hz))


def _apart(size: FloatArray, top: int, other: int, ripple: float) -> bool:
    """Tell whether the spectrum dips between two maxima, `top` the lower one, by a third and by more than ripple."""
    low, high = sorted((int(top), other))
    return bool(np.min(size[low : high + 1]) < min(size[top] / 1.5, size[top] - ripple))


def _refined(
    weighted: FloatArray, window: FloatArray, sample_rate_hz: float, near_hz: float, noise: float
) -> tuple[float, float, float, float]:
    """Return frequency, its standard uncertainty, amplitude and its standard uncertainty of the maximum near a line."""
    time_s = (np.arange(len(weighted)) - 0.5 * len(weighted)) / sample_rate_hz
    omega = 2 * np.pi * near_hz
    limit = np.pi * sample_rate_hz / (_PADDED * len(weighted))
    for _ in range(_REFINED):
        turned = np.exp(-1j * omega * time_s)
        x0, x1, x2 = (np.sum(weighted * turned * (-1j * time_s) ** k) for k in range(3))
        slope = 2.0 * float(np.real(np.conj(x0) * x1))
        curvature = 2.0 * float(np.abs(x1) ** 2 + np.real(np.conj(x0) * x2))
        move = float(np.clip(-slope / curvature, -limit, limit)) if curvature < 0 else float(np.sign(slope)) * limit
        omega += move
        if abs(move) < 1e-9 * omega:
            break
    by_sample = 2.0 * np.real(window * turned * (np.conj(x0) * (-1j * time_s) + np.conj(x1)))
    by_size = np.real(np.conj(x0) * window * turned) / abs(x0)
    scale = 2.0 / window.sum()
    u_omega = noise * float(np.linalg.norm(by_sample)) / abs(curvature)
    u_size = noise * float(np.linalg.norm(by_size)) * scale
    return omega / (2 * np.pi), u_omega / (2 * np.pi), float(abs(x0)) * scale, u_size


def _window(count: int) -> FloatArray:
    """Return half a Hann window (N,) that begins at 1."""
    return np.asarray(np.cos(0.5 * np.pi * np.arange(count) / count) ** 2)
