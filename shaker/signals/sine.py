"""Sine approximation: complex amplitudes at given lines from samples at arbitrary times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.notice import Notice
from shaker.signals.phasor import Phasors


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
