"""Result of a sine approximation, with the covariance that frequencies and decay rates share with the phasors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape
from shaker.notice import Notice
from shaker.signals.phasor import Phasors
from shaker.signals.sine.normal import Tones, as_complex
from shaker.signals.sine.solve import Step, System

_CHUNK = 1 << 16  # samples for which the curve is worked out at a time


@dataclass(frozen=True)
class SineFit:
    """Sine approximation of C channels over S times.

    `phasors` (K lines, C channels), at time zero also where lines decay; `offset` (C,), the value at mean phase zero,
    with `offset_covariance` (C, C); `drift_per_s` (C,), zero where no drift was fitted, counted from `middle_s`;
    `u_frequency_hz` (K,), zero where the frequency was known; `decay_per_s`, `u_decay_per_s` (K,), δ of exp(-δt), zero
    where none was fitted; `residual_rms` (C,) over the samples used; `spikes`, the rows left out for standing out;
    `condition` of the design matrix with columns of unit length.
    """

    phasors: Phasors
    offset: FloatArray
    offset_covariance: FloatArray
    drift_per_s: FloatArray
    middle_s: float
    u_frequency_hz: FloatArray
    decay_per_s: FloatArray
    u_decay_per_s: FloatArray
    residual_rms: FloatArray
    spikes: IntArray
    condition: float
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        lines, channels = self.phasors.value.shape
        for name in ("offset", "drift_per_s", "residual_rms"):
            check_shape(name, getattr(self, name), (channels,))
        for name in ("u_frequency_hz", "decay_per_s", "u_decay_per_s"):
            check_shape(name, getattr(self, name), (lines,))
        check_shape("offset_covariance", self.offset_covariance, (channels, channels))
        check_shape("spikes", self.spikes, (None,))

    def model(self, time_s: FloatArray) -> FloatArray:
        """Return the fitted curve (T, C) at times (T,): offset + drift + Σ Re{X exp((jω - δ)t)}."""
        curve = np.empty((len(time_s), len(self.offset)))
        exponent = 2j * np.pi * self.phasors.frequency_hz - self.decay_per_s
        for first in range(0, len(time_s), _CHUNK):
            time = time_s[first : first + _CHUNK]
            turns = np.exp(np.multiply.outer(time, exponent))
            drift = np.multiply.outer(time - self.middle_s, self.drift_per_s)
            curve[first : first + _CHUNK] = self.offset + drift + (turns @ self.phasors.value).real
        return curve

    def residual_of(self, time_s: FloatArray, values: FloatArray) -> FloatArray:
        """Return values (T, C) at times (T,) less the fitted curve; rows with a NaN in any channel are NaN."""
        residual = values - self.model(time_s)
        residual[~np.isfinite(values).all(axis=1)] = np.nan
        return np.asarray(residual)


@dataclass(frozen=True)
class Estimate:
    """A solved fit about the middle of its record: what covariances are made of.

    `coefficients` (P, C); `system`; `factor` (C, C) with F·Fᵀ the residuals' covariance and `noise` (K + 1, C), the
    density of F⁻¹·residual around each line and zero over its mean; `exponents` (K, Q) derivative of each line's
    exponent by the Q unknown frequencies and decay rates, `step` the last one, None where there are none.
    """

    tones: Tones
    coefficients: FloatArray
    system: System
    factor: FloatArray
    noise: FloatArray
    exponents: ComplexArray
    step: Step | None

    @property
    def lines(self) -> int:
        """Number of lines."""
        return len(self.tones.frequency_hz)

    def noise_between(self, first: int, second: int) -> FloatArray:
        """Return the noise covariance (C, C) between what two lines see; equal ones for that of a line."""
        level = np.sqrt(self.noise[first] * self.noise[second])
        return np.asarray(self.factor * level @ self.factor.T)

    def exponent_covariance(self) -> FloatArray:
        """Return the covariance (Q, Q) of the unknown frequencies and decay rates, with the noise of each line."""
        if self.step is None:
            return np.zeros((0, 0))
        seen = np.repeat(self.factor[:, None, :] * np.sqrt(self.noise[: self.lines]), 2, axis=1)
        noise = np.tensordot(seen, seen, axes=(2, 2))  # channel and slope, channel and slope
        both = noise * self.system.information().transpose(0, 2, 1, 3)
        pull = self.step.pull.reshape(-1, self.step.pull.shape[2])
        middle = pull.T @ both.reshape(len(pull), len(pull)) @ pull
        return np.asarray(self.step.inverse @ middle @ self.step.inverse)

    def linear_change(self) -> FloatArray:
        """Return the derivative (P, C, Q) of the linear parameters by the unknown frequencies and decay rates."""
        if self.step is None:
            return np.zeros((*self.coefficients.shape, 0))
        carried = self.system.project[:, : self.system.linear] @ self.step.derivative
        return np.asarray(carried.transpose(1, 0, 2))


def phasors_at_zero(
    found: Estimate,
    exponent_covariance: FloatArray,
    factor: ComplexArray,
    middle_s: float,
    dof: FloatArray,
    names: tuple[tuple[str, ...], tuple[str, ...]],
) -> Phasors:
    """Return the phasors at time zero from those about the middle, `factor` (K,) = exp(-s·middle) apart.

    Error of frequency and decay turns and scales a phasor from the middle to time zero: dX = exp(-s·t)·(dX' - X'·t·ds),
    which with the covariance of s adds to the (XᵀX)⁻¹ ⊗ Σ of a fit at known frequencies.
    """
    lines, channels = found.lines, found.coefficients.shape[1]
    value = as_complex(found.coefficients, lines)
    spread = found.system.spread()
    change = as_complex(found.linear_change(), lines) - middle_s * value[:, :, None] * found.exponents[:, None, :]
    covariance = np.empty((lines, 2 * channels, 2 * channels))
    for k in range(lines):
        own = slice(2 * k, 2 * k + 2)
        block = spread[:, :, own, own] * found.noise_between(k, k)[:, :, None, None]
        stacked = np.concatenate([change[k].real, change[k].imag])
        covariance[k] = block.transpose(2, 0, 3, 1).reshape(2 * channels, 2 * channels)
        covariance[k] += stacked @ exponent_covariance @ stacked.T
    middle = Phasors(found.tones.frequency_hz, value, covariance, *names, dof)
    return middle.scaled(factor[:, None])
