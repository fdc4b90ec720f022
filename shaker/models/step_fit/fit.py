"""A model of a sensor from the record of one release."""

from __future__ import annotations

import time
from typing import Literal

import numpy as np

from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_release
from shaker.models.step_fit.load import Load
from shaker.models.step_fit.order import Search, searched
from shaker.models.step_fit.outcome import outcome
from shaker.models.step_fit.result import StepFit
from shaker.models.step_fit.samples import every_sample

Release = Literal["step", "ramp", "smooth", "measured"]


def fit_step(
    record: StepRecord,
    channel: str,
    *,
    reading: Reading | None = None,
    modes: int | None = None,
    real_poles: int | None = None,
    method: Literal["pencil", "arx"] = "pencil",
    release: Release | None = None,
) -> StepFit:
    """Return the model of one output with covariance, by output-error least squares.

    `reading`: what `read_release` says of this channel, read here where it is None; `modes`, `real_poles`: numbers of
    oscillating modes and of real poles, chosen by rule where None; `release`: how the load goes, "measured" with a
    measured force and else chosen by rule where None; `method`: what the start comes from. The covariance holds the
    record's noise, coloured or not, the baseline, the release and the load's amplitude.
    """
    began = time.perf_counter()
    found = reading or read_release(record, channel)
    whole = every_sample(record.samples[record.channels.index(channel)], record.time_s, 1.0 / record.sample_rate_hz)
    search = Search(whole, found, loads(record, found, release), method, modes, real_poles)
    return outcome(record, found, searched(search), method, began)


def loads(record: StepRecord, reading: Reading, release: Release | None) -> tuple[Load, ...]:
    """Return the loads that come into question, the likeliest first."""
    if release == "measured" or (release is None and record.force is not None):
        if record.force is None:
            raise ValueError(
                'release: expected "step", "ramp" or "smooth" for a record without force, found "measured"'
            )
        rest = record.time_s < reading.onset_s - 3.0 * reading.u_onset_s
        level = float(np.mean(record.force[rest])) if np.any(rest) else float(record.force[0])
        return (Load("measured", record.amplitude, record.force - level, record.start_s),)
    if release is not None:
        return (Load(release, record.amplitude),)
    return tuple(Load(shape, record.amplitude) for shape in ("ramp", "smooth"))
