"""What goes into the estimate of a transfer function, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.notice import Notice
from shaker.signals.chain import ratio_unit
from shaker.signals.phasor import Phasors

Estimator = Literal["H1", "H2", "Hv", "periodic", "local"]


@dataclass(frozen=True)
class TransferRecord:
    """Samples of a reference and of C responses on one clock.

    `reference` (S,), `responses` (S, C), both at `start + i / sample_rate_hz`; `reference_name` and `reference_unit`,
    `channels` and `unit` (C names of the responses and their units).
    """

    reference: FloatArray
    responses: FloatArray
    sample_rate_hz: float
    reference_name: str
    reference_unit: str
    channels: tuple[str, ...]
    unit: tuple[str, ...]

    def __post_init__(self) -> None:
        check_shape("reference", self.reference, (None,))
        check_shape("responses", self.responses, (len(self.reference), len(self.channels)))
        if not self.sample_rate_hz > 0.0:
            raise ValueError(f"sample_rate_hz: expected a positive number, found {self.sample_rate_hz}")
        if len(self.unit) != len(self.channels):
            raise ValueError(f"unit: expected {len(self.channels)} units, one per response, found {len(self.unit)}")
        named = {self.reference_name: self.reference} | dict(zip(self.channels, self.responses.T, strict=True))
        if len(named) != 1 + len(self.channels):
            raise ValueError(f"channels: expected names that differ, found {self.reference_name}, {self.channels}")
        gaps = [name for name, samples in named.items() if not np.isfinite(samples).all()]
        if gaps:
            raise ValueError(f"responses: expected samples without gaps, found NaN in {', '.join(gaps)}")

    @property
    def ratio_unit(self) -> tuple[str, ...]:
        """Units of response over reference, "1" where they are the same."""
        return tuple(ratio_unit(unit, self.reference_unit) for unit in self.unit)


@dataclass(frozen=True)
class TransferFunction:
    """Responses over a reference at K lines, H = Y/X.

    `ratio`: the C responses over the reference with covariance; `coherence` (K, C), as estimated (see
    `coherence_bias`); `averages` (K,): independent averages behind it; `added_decay_per_s`: the decay a that an
    exponential window has added, so that `ratio` is H(s) at s = a + jω; `line_correlation` (D,): correlation of the
    errors of lines that are 0, 1, 2 … lines of the grid `line_spacing_hz` apart, [1] where they are independent.
    """

    ratio: Phasors
    coherence: FloatArray
    estimator: Estimator
    reference: str
    averages: FloatArray
    line_spacing_hz: float
    line_correlation: ComplexArray
    notices: tuple[Notice, ...] = ()
    added_decay_per_s: float = 0.0

    def __post_init__(self) -> None:
        lines, channels = self.ratio.value.shape
        check_shape("coherence", self.coherence, (lines, channels))
        check_shape("averages", self.averages, (lines,))
        check_shape("line_correlation", self.line_correlation, (None,))

    @property
    def coherence_bias(self) -> FloatArray:
        """Bias (1 - γ²)²/n of the estimated coherence, (K, C); Bendat and Piersol, Random Data, 4th ed., eq. 9.76."""
        return np.asarray((1.0 - self.coherence) ** 2 / self.averages[:, None])

    def at_lines(self, lines: NDArray[Any]) -> TransferFunction:
        """Return the lines chosen by a mask (K,) or by indices."""
        return replace(
            self,
            ratio=self.ratio.at_lines(lines),
            coherence=self.coherence[lines],
            averages=self.averages[lines],
        )

    def between(self, band_hz: tuple[float, float]) -> TransferFunction:
        """Return the lines inside a band."""
        frequency = self.ratio.frequency_hz
        return self.at_lines((frequency >= band_hz[0]) & (frequency <= band_hz[1]))

    def channel_covariance(self, channel: str) -> FloatArray:
        """Return the covariance (K, 2, 2) of [Re, Im] of one response."""
        return self.ratio.select([channel]).covariance


def circular_covariance(complex_covariance: ComplexArray) -> FloatArray:
    """Return the covariance (K, 2C, 2C) of [all Re, all Im] of circular noise with E[e eᴴ] given as (K, C, C)."""
    half = 0.5 * complex_covariance
    return np.asarray(np.block([[half.real, -half.imag], [half.imag, half.real]]))
