"""Sine approximation: complex amplitudes at given lines from samples at arbitrary times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.notice import Notice
from shaker.signals.folding import (
    alias_frequency,
    beat_phase,
    condition_number,
    drift_length,
    exposure_gain,
    folded_harmonics,
    sampling_grid,
    sine_columns,
)
from shaker.signals.noise import LineNoise, line_noise
from shaker.signals.phasor import Phasors

__all__ = [
    "SineFit",
    "alias_frequency",
    "beat_phase",
    "exposure_gain",
    "fit_sines",
    "folded_harmonics",
    "sine_amplitudes",
    "solve_sines",
]

_DEPENDENT = 1e-12  # smallest eigenvalue of a correlation matrix that counts, for channels that depend on others
_SINGULAR = 1e6  # condition above which the normal equations carry no information about some line


@dataclass(frozen=True)
class SineFit:
    """Sine approximation of C channels over S times.

    `phasors` (K lines, C channels); `offset` (C,), the value at mean phase zero, with `offset_covariance` (C, C);
    `drift_per_s` (C,), zero where no drift was fitted, counted from `middle_s`; `residual` (S, C), NaN where a sample
    was missing; `condition` of the design matrix with columns of unit length.
    """

    phasors: Phasors
    offset: FloatArray
    offset_covariance: FloatArray
    drift_per_s: FloatArray
    middle_s: float
    residual: FloatArray
    condition: float
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        channels = len(self.phasors.channels)
        check_shape("offset", self.offset, (channels,))
        check_shape("offset_covariance", self.offset_covariance, (channels, channels))
        check_shape("drift_per_s", self.drift_per_s, (channels,))
        check_shape("residual", self.residual, (None, channels))

    def model(self, time_s: FloatArray) -> FloatArray:
        """Return the fitted curve (T, C) at times (T,): offset + drift + Σ Re{X exp(jωt)}."""
        turns = np.exp(2j * np.pi * np.multiply.outer(time_s, self.phasors.frequency_hz))
        drift = np.multiply.outer(time_s - self.middle_s, self.drift_per_s)
        return np.asarray(self.offset + drift + (turns @ self.phasors.value).real)


@dataclass(frozen=True)
class SineSolution:
    """Least-squares solution of a design matrix: `coefficients` (P, C), `inverse` (P, P) of XᵀX, `residual` (S, C)."""

    coefficients: FloatArray
    inverse: FloatArray
    residual: FloatArray
    condition: float


def solve_sines(columns: FloatArray, data: FloatArray) -> SineSolution:
    """Solve columns (S, P) · coefficients = data (S, C) by normal equations with one step of refinement.

    The columns have about unit length and a condition number below 10⁶ is demanded, so the refined solution has the
    accuracy of an orthogonal factorisation at a fraction of its time.
    """
    samples, parameters = columns.shape
    if samples <= parameters:
        raise ValueError(f"time_s: expected more than {parameters} complete samples, found {samples}")
    gram = columns.T @ columns
    condition = condition_number(gram)
    if not condition < _SINGULAR:
        raise ValueError(
            f"frequency_hz: expected lines that the sampling times can tell apart, found condition number "
            f"{condition:.2g}; drop those that usable_lines names"
        )
    inverse = np.linalg.inv(gram)
    coefficients = inverse @ (columns.T @ data)
    coefficients += inverse @ (columns.T @ (data - columns @ coefficients))
    return SineSolution(coefficients, np.asarray(inverse), data - columns @ coefficients, condition)


def fit_sines(
    time_s: FloatArray,
    values: FloatArray,
    frequency_hz: FloatArray,
    channels: Sequence[str],
    unit: Sequence[str],
    *,
    drift: bool = False,
) -> SineFit:
    """Fit offset, lines (K,) and optionally a linear drift to `values` (S, C) at `time_s` (S,) by least squares.

    The three-parameter fit of IEEE 1057 and method 3 of ISO 16063-11 for any number of lines and channels at once,
    above or below the Nyquist rate alike. Rows with a NaN in any channel are dropped. The covariance of a line is
    (XᵀX)⁻¹ ⊗ Σ with the residuals' covariance Σ = F·Fᵀ (C, C). Where the times lie on a grid and the record is long
    enough, Σ = F·diag(S)·Fᵀ instead, S the spectral density around the line's alias of the series F⁻¹·residual: noise
    counts where it acts, and combinations of channels that are known better than each channel keep their own.
    """
    _check_arguments(time_s, values, frequency_hz, channels, unit)
    present = np.isfinite(values).all(axis=1)
    whole = bool(present.all())  # long records are not copied without need
    time = time_s if whole else time_s[present]
    solution = solve_sines(sine_columns(time, frequency_hz, drift), values if whole else values[present])
    residual = solution.residual
    if not whole:
        residual = np.full(values.shape, np.nan)
        residual[present] = solution.residual
    phasors, offset_covariance = _phasors(time, solution, frequency_hz, channels, unit)
    lines, samples = len(frequency_hz), len(time)
    offset = solution.coefficients[2 * lines] / np.sqrt(samples)
    slope = solution.coefficients[2 * lines + 1] / drift_length(time) if drift else np.zeros(len(channels))
    lost = len(time_s) - samples
    notices = (Notice("info", f"{lost} of {len(time_s)} samples are missing", ", ".join(channels)),) if lost else ()
    middle = float(np.mean(time))
    return SineFit(phasors, offset, offset_covariance, slope, middle, residual, solution.condition, notices)


def sine_amplitudes(
    time_s: FloatArray, values: FloatArray, frequency_hz: FloatArray
) -> tuple[FloatArray, ComplexArray]:
    """Return offset (C,) and phasors (K, C) of `values` (S, C) at `time_s` (S,) as `fit_sines`, without covariance.

    For many channels, whose covariance matrix would be large.
    """
    check_shape("values", values, (len(time_s), None))
    lines, samples = len(frequency_hz), len(time_s)
    solution = solve_sines(sine_columns(time_s, frequency_hz), values)
    offset = solution.coefficients[2 * lines] / np.sqrt(samples)
    return offset, _amplitudes(solution, samples, lines)


def _check_arguments(
    time_s: FloatArray, values: FloatArray, frequency_hz: FloatArray, channels: Sequence[str], unit: Sequence[str]
) -> None:
    """Refuse arrays that do not belong together."""
    check_shape("time_s", time_s, (None,))
    check_shape("values", values, (len(time_s), len(channels)))
    check_shape("frequency_hz", frequency_hz, (None,))
    if len(unit) != len(channels):
        raise ValueError(f"unit: expected {len(channels)} units, one per channel, found {len(unit)}")
    if not np.all(np.isfinite(time_s)):
        raise ValueError(f"time_s: expected finite times, found {int(np.sum(~np.isfinite(time_s)))} that are not")


def _phasors(
    time: FloatArray,
    solution: SineSolution,
    frequency_hz: FloatArray,
    channels: Sequence[str],
    unit: Sequence[str],
) -> tuple[Phasors, FloatArray]:
    """Turn coefficients into phasors with covariance, and give the offset's covariance."""
    lines, samples = len(frequency_hz), len(time)
    free = samples - len(solution.coefficients)
    factor, whitening = _factor(solution.residual.T @ solution.residual / free)
    noise = _noise(time, np.asarray(solution.residual @ whitening.T), frequency_hz, free)
    sign = np.sqrt(2.0 / samples) * np.array([1.0, -1.0])
    covariance = np.empty((lines, 2 * len(channels), 2 * len(channels)))
    for k in range(lines):
        block = solution.inverse[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] * np.multiply.outer(sign, sign)
        covariance[k] = np.kron(block, factor * noise.variance[k] @ factor.T)
    last = solution.inverse[2 * lines, 2 * lines] / samples
    offset_covariance = last * (factor * noise.variance[lines] @ factor.T)
    value = _amplitudes(solution, samples, lines)
    return Phasors(frequency_hz, value, covariance, tuple(channels), tuple(unit), noise.dof[:lines]), offset_covariance


def _amplitudes(solution: SineSolution, samples: int, lines: int) -> ComplexArray:
    """Return the phasors (K, C) of coefficients of scaled columns."""
    cosine, sine = solution.coefficients[0 : 2 * lines : 2], solution.coefficients[1 : 2 * lines : 2]
    return np.asarray(np.sqrt(2.0 / samples) * (cosine - 1j * sine))


def _noise(time: FloatArray, whitened: FloatArray, frequency_hz: FloatArray, free: int) -> LineNoise:
    """Return the noise of unit-variance series at each line and, last, at the lowest bin for the offset."""
    grid = sampling_grid(time)
    if grid is not None:
        filled = grid.filled(whitened)
        line_bin = alias_frequency(frequency_hz, grid.rate_hz) * grid.length / grid.rate_hz
        noise = line_noise(filled, len(time), np.append(line_bin, 0.5))
        if noise is not None:
            return LineNoise(noise.variance, np.minimum(noise.dof, float(free)))
    lines = len(frequency_hz) + 1
    return LineNoise(np.ones((lines, whitened.shape[1])), np.full(lines, float(free)))


def _factor(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return F (C, C) with F·Fᵀ = covariance, and F⁻¹, zero for channels without noise.

    F = D·√R with the symmetric root of the correlation matrix: of all roots the one that mixes the channels least, and
    the same in whatever order they stand.
    """
    sigma = np.sqrt(covariance.diagonal())
    inverse_sigma = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    correlation = covariance * np.multiply.outer(inverse_sigma, inverse_sigma)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    root = np.sqrt(np.maximum(eigenvalues, _DEPENDENT))
    factor = sigma[:, None] * ((vectors * root) @ vectors.T)
    inverse = ((vectors / root) @ vectors.T) * inverse_sigma
    return np.asarray(factor), np.asarray(inverse)
