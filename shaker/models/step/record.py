"""The record of one release."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape


@dataclass(frozen=True)
class StepRecord:
    """Outputs of a sensor while a load is put on or taken off at once.

    `samples` (C, N) of the outputs `channels` (C,) in `unit`, at `sample_rate_hz`; sample n is at `start_s` + n/rate.
    `component` (Fx … Mz) changes by `amplitude`, signed, in N or N·m, with relative standard uncertainty `u_amplitude`.
    `force` (N,): the load measured along, in N or N·m, None where it was not. `onset_s`: when the release begins, where
    it is stated. `release`: what let go, such as "fishing line", or "". `name` is for messages.
    """

    name: str
    channels: tuple[str, ...]
    unit: str
    samples: FloatArray
    sample_rate_hz: float
    component: str
    amplitude: float
    u_amplitude: float = 0.0
    start_s: float = 0.0
    force: FloatArray | None = None
    onset_s: float | None = None
    release: str = ""

    def __post_init__(self) -> None:
        check_shape("samples", self.samples, (len(self.channels), None))
        if self.force is not None:
            check_shape("force", self.force, self.samples.shape[1:])
        if not self.sample_rate_hz > 0:
            raise ValueError(f"sample_rate_hz: expected a positive number, found {self.sample_rate_hz}")
        if self.amplitude == 0 or not np.isfinite(self.amplitude):
            raise ValueError(f"amplitude: expected a number other than 0, found {self.amplitude}")

    @property
    def time_s(self) -> FloatArray:
        """Time of every sample (N,) in s."""
        return np.asarray(self.start_s + np.arange(self.samples.shape[1]) / self.sample_rate_hz)
