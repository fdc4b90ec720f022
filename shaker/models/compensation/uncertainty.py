"""How well a compensated signal is known: by frequency and sample by sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.models.compensation.discrete import Discretisation, parameter_sections, sampled
from shaker.models.compensation.filter import Compensation
from shaker.models.compensation.noise import white_noise_gain
from shaker.models.compensation.stream import CompensationFilter


@dataclass(frozen=True)
class GainBand:
    """Standard uncertainties over `frequency_hz` (K,) of a compensated sensor: `u_gain` relative, `u_phase_rad`."""

    frequency_hz: FloatArray
    u_gain: FloatArray
    u_phase_rad: FloatArray


@dataclass(frozen=True)
class CompensatedSignal:
    """Compensated samples `value` (C, N) with standard uncertainty `u` (C, N).

    `u_model` (C, N): what the sensor's model contributes, 0 where its covariance is not known; `u_noise`: the noise
    after the filter, the same for all samples.
    """

    value: FloatArray
    u_model: FloatArray
    u_noise: float

    def __post_init__(self) -> None:
        check_shape("u_model", self.u_model, self.value.shape)

    @property
    def u(self) -> FloatArray:
        """Standard uncertainty (C, N): both together."""
        return np.asarray(np.hypot(self.u_model, self.u_noise))


def gain_band(compensation: Compensation, frequency_hz: FloatArray) -> GainBand:
    """Return u of the compensated sensor by the model's covariance V, to first order: δT/T = Σ (∂ ln G_c/∂θ) δθ.

    First order holds while u of a cancelled frequency is small against half the width ζ·fn of its resonance.
    """
    covariance = compensation.sensor.covariance
    if covariance is None:
        raise ValueError("sensor: expected a model with covariance, found none")
    slopes = compensation.sensitivities(frequency_hz)
    spreads = (np.sqrt(np.einsum("kp,pq,kq->k", part, covariance, part)) for part in (slopes.real, slopes.imag))
    return GainBand(np.asarray(frequency_hz), *spreads)


class CompensationWithUncertainty:
    """A `CompensationFilter` that also runs the filters of ∂y/∂θ along, so that every sample has its uncertainty.

    u² = gᵀVg + (noise·√Σh²)², g (P,) the derivatives at the sample, V the covariance of the sensor's parameters,
    `noise` the standard deviation of the input, white at the sampling rate. What the parameters contribute is common to
    all samples, what noise contributes is not.
    """

    def __init__(
        self,
        compensation: Compensation,
        sample_rate_hz: float,
        method: Discretisation = "matched",
        *,
        channels: int = 1,
        level: FloatArray | float | None = 0.0,
        noise: float = 0.0,
    ) -> None:
        sections = sampled(compensation, sample_rate_hz, method)
        covariance = compensation.sensor.covariance
        size = len(compensation.sensor.vector)
        self._covariance = np.zeros((size, size)) if covariance is None else covariance
        known = np.any(self._covariance != 0.0, axis=0)
        self._known = np.flatnonzero(known)
        self._filter = CompensationFilter(sections, channels, level)
        every = parameter_sections(compensation, sample_rate_hz, method)
        self._slopes = [CompensationFilter(every[place], channels, level) for place in self._known]
        self._noise = noise * white_noise_gain(sections)

    def __call__(self, block: FloatArray) -> CompensatedSignal:
        """Return the compensated block (C, N) with its uncertainty."""
        value = self._filter(block)
        if not self._slopes:
            return CompensatedSignal(value, np.zeros_like(value), self._noise)
        slopes = np.stack([run(block) for run in self._slopes])
        known = self._covariance[np.ix_(self._known, self._known)]
        variance = np.einsum("pcn,pq,qcn->cn", slopes, known, slopes)
        return CompensatedSignal(value, np.sqrt(np.maximum(variance, 0.0)), self._noise)
