"""A model of a sensor from the record of one release."""

from __future__ import annotations

import time
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.modal import ModalModel
from shaker.models.step.basis import pole_responses
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_release
from shaker.models.step_fit.result import StepFit

Release = Literal["step", "ramp", "measured"]


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
    measured force and else chosen by rule where None; `method`: what the start comes from.
    """
    from scipy.optimize import least_squares

    began = time.perf_counter()
    found = reading or read_release(record, channel)
    y, t = record.samples[record.channels.index(channel)], record.time_s
    count, reals = modes or 1, 1 if real_poles is None else real_poles

    def parts(q: FloatArray) -> tuple[FloatArray, ComplexArray]:
        w, z, hz = q[:count], q[count : 2 * count], np.exp(q[2 * count : 2 * count + reals])
        poles = np.concatenate([w * (-z + 1j * np.sqrt(1 - z**2)), -2 * np.pi * hz + 0j])
        psi = pole_responses(poles, t, float(q[-1]), 0.0)
        return np.column_stack(
            [np.ones(len(t)), 2 * psi[:, :count].real, -2 * psi[:, :count].imag, psi[:, count:].real]
        ), poles

    def residual(q: FloatArray) -> FloatArray:
        design = parts(q)[0]
        return np.asarray(y - design @ np.linalg.lstsq(design, y, rcond=None)[0])

    first = _peaks(y, found, record, count)
    start = np.concatenate(
        [2 * np.pi * first, np.full(count, 0.02), np.log(3 * first.max() * np.ones(reals)), [found.onset_s]]
    )
    solved = least_squares(residual, start, x_scale=np.abs(start) * 1e-3 + 1e-9, method="lm")
    q = solved.x
    design, poles = parts(q)
    c = np.linalg.lstsq(design, y, rcond=None)[0]
    a = record.amplitude
    re, im, rr = c[1 : 1 + count] / a, c[1 + count : 1 + 2 * count] / a, c[1 + 2 * count :] / a
    model = ModalModel(
        q[:count] / (2 * np.pi),
        q[count : 2 * count],
        re + 1j * im,
        np.exp(q[2 * count : -1]),
        rr,
        np.eye(4 * count + 2 * reals) * 1e-12,
    )
    rest = np.asarray(y - design @ c)
    return StepFit(
        method,
        channel,
        record.component,
        record.unit,
        model,
        model.system,
        t,
        y - rest,
        rest,
        record.sample_rate_hz,
        1,
        2 * count + reals,
        1 - float(rest @ rest / np.sum((y - y.mean()) ** 2)),
        np.array([solved.cost]),
        time.perf_counter() - began,
        float(q[-1]),
        1e-6,
        0.0,
        0.0,
    )


def _peaks(y: FloatArray, reading: Reading, record: StepRecord, count: int) -> FloatArray:
    """Return the frequencies (M,) in Hz of the highest peaks of the spectrum after the onset."""
    after = y[record.time_s > reading.onset_s] - reading.steady
    size = np.abs(np.fft.rfft(after * np.hanning(len(after)), 4 * len(after)))
    top = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] > size[2:])) + 1
    best = top[np.argsort(size[top])[::-1][:count]]
    return np.sort(best) * record.sample_rate_hz / (4 * len(after))
