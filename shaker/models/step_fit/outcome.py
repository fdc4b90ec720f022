"""A solution as what an identification returns."""

from __future__ import annotations

import time

import numpy as np

from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step_fit.order import Found
from shaker.models.step_fit.remarks import remarks
from shaker.models.step_fit.result import Method, StepFit
from shaker.models.step_fit.samples import every_sample
from shaker.models.step_fit.uncertainty import modal_model, spread


def outcome(
    record: StepRecord,
    reading: Reading,
    found: Found,
    method: Method,
    began: float,
) -> StepFit:
    """Return what was found with its covariance from every sample; `began`: when the identification did."""
    solution = found.solution
    value = record.samples[record.channels.index(reading.channel)]
    whole = every_sample(value, record.time_s, 1.0 / record.sample_rate_hz)
    known = spread(solution, whole)
    model = modal_model(solution, known.covariance, record.u_amplitude)
    middle, length = solution.problem.release(solution.vector)
    timed = solution.problem.load.timed
    decimation = int(solution.problem.samples.length[-1])
    return StepFit(
        method=method,
        channel=reading.channel,
        component=record.component,
        unit=record.unit,
        model=model,
        system=model.system,
        time_s=whole.time_s,
        fitted=known.fitted,
        residual=known.residual,
        sample_rate_hz=record.sample_rate_hz / decimation,
        decimation=decimation,
        order=solution.problem.structure.order,
        variance_accounted=1.0 - float(np.sum(known.residual**2) / np.sum((value - value.mean()) ** 2)),
        convergence=np.array(found.path),
        duration_s=time.perf_counter() - began,
        onset_s=middle - 0.5 * length if timed else reading.onset_s,
        u_onset_s=known.u_onset_s if timed else reading.u_onset_s,
        release_s=length,
        u_release_s=known.u_release_s,
        shape=solution.problem.load.shape,
        notices=remarks(record, reading, found, model, known),
    )
