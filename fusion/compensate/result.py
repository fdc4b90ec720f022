"""What a compensation consists of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.compensate.sources import Subject
from shaker._checks import FloatArray
from shaker.models.compensation.discrete import Sections
from shaker.models.compensation.filter import Compensation
from shaker.models.indices.result import Indices


@dataclass(frozen=True)
class Figures:
    """Indices of a system with their standard uncertainties by name, None where they are not known."""

    indices: Indices
    u: dict[str, float | None]


@dataclass(frozen=True)
class LoadFilter:
    """The filter of a subject with one load: continuous, for samples, and what it does.

    `load_mass` in kg, None where the load is not modelled. `noise_gain`: of white noise at the sampling rate;
    `noise`: standard deviation after the filter in the filter's output unit, None where that of the output is not
    known. `discretisation_error`: largest |G_d/G_c - 1| up to `band_hz`. `off_frequency` (K,) relative, `off_ringing`
    (K,): residual ringing where the sensor's frequency is off by so much; `off_load` (L,) kg and `load_ringing` (L,)
    likewise with other loads, empty where the load is not modelled. Ringing from `after_s` on.
    """

    load_mass: float | None
    compensation: Compensation
    sections: Sections
    before: Figures
    after: Figures
    noise_gain: float
    noise: float | None
    band_hz: float
    discretisation_error: float
    after_s: float
    off_frequency: FloatArray
    off_ringing: FloatArray
    off_load: FloatArray
    load_ringing: FloatArray


@dataclass(frozen=True)
class SubjectResult:
    """The filters of one channel, one per load."""

    subject: Subject
    filters: tuple[LoadFilter, ...]

    @property
    def output_unit(self) -> str:
        """Unit of what the filter puts out: that of the load where it is calibrated."""
        return self.subject.load_unit if self.filters[0].compensation.calibrated else self.subject.unit


@dataclass(frozen=True)
class CompensatedChannel:
    """A channel of a recording after its filter: `value`, standard uncertainty `u` (N,), and `u_noise` in it.

    `raw` (N,): before it, times the static gain of the filter.
    """

    channel: str
    unit: str
    raw: FloatArray
    value: FloatArray
    u: FloatArray
    u_noise: float


@dataclass(frozen=True)
class CompensatedRecording:
    """The compensated channels of a recording at `start_s` + n/`sample_rate_hz`."""

    name: str
    sample_rate_hz: float
    start_s: float
    channels: tuple[CompensatedChannel, ...]

    @property
    def time_s(self) -> FloatArray:
        """Time of every sample (N,) in s."""
        return np.asarray(self.start_s + np.arange(len(self.channels[0].value)) / self.sample_rate_hz)
