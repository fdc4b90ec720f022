"""Hann spectra whose lines can be fitted and taken out bin by bin.

Time is counted from the middle of the record, so that the spectrum of a sine is its phasor times a real kernel that
falls as the cube of the distance: a line touches the bins around it only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from shaker._checks import ComplexArray, FloatArray

_SPAN = 3  # bins on either side from which a line is fitted
_STEPS = 10
_CONVERGED = 1e-6  # of the variance of the place: the square of the last step
_BIN_CORRELATION = (1.0, 2.0 / 3.0, 1.0 / 6.0)  # of white noise in Hann bins 0, 1, 2 apart
_DRIFT_FROM = 1e4  # power over noise from which a line's own slow change of amplitude is taken out with it
_NEGLIGIBLE = 0.05  # of the noise amplitude: what a line leaves beyond the bins it is taken out of
_WIDEST = 20_000
_RAMP_BINS = 256
_SERIES_BELOW = 1e-5  # bins: nearer to its centre the kernel is taken from its series


@dataclass(frozen=True)
class BinLine:
    """One line: `place` in bins, `value` its phasor at the middle of the record, `slope` its change, uncertainties."""

    place: float
    value: complex
    slope: complex
    u_place: float
    u_value: float


def centred_spectrum(samples: FloatArray) -> ComplexArray:
    """Return the Hann spectrum (B,) of samples (S,), their mean removed: the phasor of a sine that lies on a bin.

    The window is symmetric about the middle of the record, to which the phases refer.
    """
    count = len(samples)
    flat = (samples - samples.mean()) * (1.0 + np.cos(2.0 * np.pi / count * (np.arange(count) - (count - 1) / 2.0)))
    spectrum = np.fft.rfft(flat)
    turn = np.exp(np.arange(len(spectrum)) * (-1j * np.pi / count))
    turn[1::2] *= -1.0
    spectrum *= turn * (2.0 / count)
    return np.asarray(spectrum)


def take_out_ramp(spectrum: ComplexArray, samples: int) -> None:
    """Take the straight line that the lowest bins show out of a spectrum, in place."""
    _, ramp = kernel(0.0, 0, min(len(spectrum), _RAMP_BINS), samples)
    size = float(ramp @ spectrum.imag[: len(ramp)]) / float(ramp @ ramp)
    spectrum.imag[: len(ramp)] -= size * ramp


def kernel(place: float, low: int, high: int, samples: int) -> tuple[FloatArray, FloatArray]:
    """Return what a unit line at `place` leaves in the bins from `low` to below `high`, and its derivative by `place`.

    K(δ) = D(δ) + ½D(δ - 1) + ½D(δ + 1) with Dirichlet's kernel D(δ) = sin(πδ) / (N sin(πδ/N)).
    """
    distance = place - np.arange(low - 1, high + 1)
    near = np.abs(distance) < _SERIES_BELOW
    series = distance[near]
    distance[near] = _SERIES_BELOW
    below = samples * np.sin(np.pi / samples * distance)
    dirichlet = np.sin(np.pi * distance) / below
    slope = np.pi * (np.cos(np.pi * distance) - dirichlet * np.cos(np.pi / samples * distance)) / below
    curvature = -(np.pi**2) / 3.0 * (1.0 - 1.0 / samples**2)
    dirichlet[near], slope[near] = 1.0 + curvature / 2.0 * series**2, curvature * series
    return (
        dirichlet[1:-1] + 0.5 * (dirichlet[:-2] + dirichlet[2:]),
        slope[1:-1] + 0.5 * (slope[:-2] + slope[2:]),
    )


def fit_line(spectrum: ComplexArray, samples: int, start: float, noise: float) -> BinLine:
    """Fit a line to the bins around `start` by least squares, weighted with the correlation of Hann bins.

    Y = A·K(δ) + B·K'(δ): the part of B in phase with A is a shift of the line, Gauss-Newton takes it off; the other
    part is a linear change of the amplitude. `noise` is the noise power of a bin.
    """
    low, high = max(1, round(start) - _SPAN), min(len(spectrum), round(start) + _SPAN + 1)
    weight = _weight(high - low)
    place, value = start, 0j
    for _ in range(_STEPS):
        data = spectrum[low:high] - np.conj(value) * kernel(-place, low, high, samples)[0]
        design = np.stack(kernel(place, low, high, samples))
        weighted = design @ weight
        covariance = np.linalg.inv(weighted @ design.T)
        value, slope = (complex(c) for c in covariance @ (weighted @ data))
        step = (slope / value).real if value else 0.0
        place += min(max(step, -0.5), 0.5)
        if abs(place - start) > 1.0:
            place = start
            break
        if abs(step * value) ** 2 < _CONVERGED * covariance[1, 1] * noise:
            break
    quadrature = noise / 2.0 * covariance.diagonal()
    change = 1j * value * (slope / value).imag if value else 0j
    tame = abs(value) ** 2 > _DRIFT_FROM * noise and abs(change) < 0.3 * abs(value)
    u_place = float(np.sqrt(quadrature[1])) / max(abs(value), np.finfo(np.float64).tiny)
    return BinLine(place, value, change if tame else 0j, u_place, float(np.sqrt(quadrature[0])))


def add_line(spectrum: ComplexArray, samples: int, line: BinLine, noise: float, sign: float) -> None:
    """Add a line times `sign` to the bins of a spectrum in which it can be told from a noise power, in place."""
    reach = (abs(line.value) / (_NEGLIGIBLE * np.sqrt(noise) * np.pi)) ** (1.0 / 3.0)
    width = int(min(max(reach, 4.0), _WIDEST)) + 2
    low, high = max(0, round(line.place) - width), min(len(spectrum), round(line.place) + width + 1)
    shape, slope = kernel(line.place, low, high, samples)
    part = line.value * shape + np.conj(line.value) * kernel(-line.place, low, high, samples)[0]
    spectrum[low:high] += sign * (part + line.slope * slope)


@lru_cache(maxsize=8)
def _weight(count: int) -> FloatArray:
    """Return the inverse of the correlation matrix of white noise in neighbouring Hann bins."""
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(np.linalg.inv(np.array([*_BIN_CORRELATION, *[0.0] * count])[apart]))
