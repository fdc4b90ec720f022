"""Simultaneous identification of order and parameters, as the published work does it."""

from __future__ import annotations

import time
from typing import Literal

import numpy as np

from shaker._checks import FloatArray
from shaker.models.indices.remarks import remarks
from shaker.models.linear_system import LinearSystem
from shaker.models.modal import ModalModel
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_release
from shaker.models.step_fit.every_order import every_order
from shaker.models.step_fit.result import StepFit
from shaker.notice import Notice


def fit_sim(
    record: StepRecord,
    channel: str,
    *,
    reading: Reading | None = None,
    order: int | None = None,
    conversion: Literal["tustin", "zoh"] = "tustin",
    decimation: int = 1,
    most: int = 9,
) -> StepFit:
    """Return the difference equation of one output, made continuous, without covariance.

    `order`: number of poles, by the bend of the loss over order 1 … `most` where None; `conversion` to continuous
    time: "tustin", as the published model of 100 kHz samples, or "zoh", exact for a load that holds between samples;
    `decimation`: samples to a mean before anything else. `system.sampled(sample_rate_hz, conversion)` is the
    difference equation. Least squares of the equation error is biased by output noise, the more the faster the
    sampling: at 100 kHz and 40 dB a mode of ζ = 0.015 comes out with a multiple of its damping.
    """
    began = time.perf_counter()
    found = reading or read_release(record, channel)
    load, output, time_s = constructed(record, found, decimation)
    rate = record.sample_rate_hz / decimation
    orders = every_order(load, output, rate, most)
    direct = conversion == "tustin"
    chosen = order or orders.bend(direct)
    sampled = orders.system(chosen, direct)
    system, notices = _continuous(sampled, conversion)
    fitted = simulated(sampled, load)
    notices += remarks(system, rate)
    if not np.all(np.isfinite(fitted)):
        where = f"{record.name}, {channel}"
        notices += (Notice("warning", "the model's output grows without bound: shown is the output's mean", where),)
        fitted = np.full_like(output, output.mean())
    return StepFit(
        method="sim" if direct else "sim_zoh",
        channel=channel,
        component=record.component,
        unit=record.unit,
        model=modal_form(system),
        system=system,
        time_s=time_s,
        fitted=fitted + found.baseline,
        residual=output - fitted,
        sample_rate_hz=rate,
        decimation=decimation,
        order=chosen,
        variance_accounted=accounted(output, fitted),
        convergence=orders.loss(direct),
        duration_s=time.perf_counter() - began,
        onset_s=found.onset_s,
        u_onset_s=found.u_onset_s,
        release_s=0.0,
        u_release_s=0.0,
        notices=notices,
    )


def constructed(record: StepRecord, reading: Reading, decimation: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return load, output above its baseline and time (N,): the load measured, or a step at the onset that was read."""
    value = record.samples[record.channels.index(reading.channel)] - reading.baseline
    load = record.amplitude * (record.time_s >= reading.onset_s) if record.force is None else record.force
    if record.force is not None:
        load = load - np.mean(load[record.time_s < reading.onset_s])
    size = len(value) // decimation
    parts = (part[: size * decimation].reshape(size, decimation).mean(axis=1) for part in (load, value, record.time_s))
    first, second, third = parts
    return first, second, third


def simulated(system: LinearSystem, load: FloatArray) -> FloatArray:
    """Return what a sampled system answers to a load (N,)."""
    from scipy.signal import sosfilt

    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(sosfilt(system.sections(), load))


def accounted(output: FloatArray, fitted: FloatArray) -> float:
    """Return 1 - |residual|²/|output - mean|²."""
    with np.errstate(over="ignore"):
        return 1.0 - float(np.sum((output - fitted) ** 2) / np.sum((output - output.mean()) ** 2))


def modal_form(system: LinearSystem) -> ModalModel | None:
    """Return a continuous system as a sum of modes, None where it has a direct term, double poles or is sampled."""
    if system.sample_rate_hz is not None or len(system.zeros) == len(system.poles):
        return None
    gaps = np.abs(system.poles[:, None] - system.poles) + np.diag(np.full(len(system.poles), np.inf))
    if np.min(gaps, initial=np.inf) < 1e-6 * np.max(np.abs(system.poles)) or np.any(system.poles == 0):
        return None
    residues = system.residues()
    upper, real = system.poles.imag > 0, system.poles.imag == 0
    omega = np.abs(system.poles[upper])
    return ModalModel(
        omega / (2 * np.pi),
        -system.poles[upper].real / omega,
        residues[upper],
        -system.poles[real].real / (2 * np.pi),
        residues[real].real,
    )


def _continuous(sampled: LinearSystem, conversion: Literal["tustin", "zoh"]) -> tuple[LinearSystem, tuple[Notice, ...]]:
    """Return the continuous system, or the sampled one with a notice where a pole has no continuous counterpart."""
    try:
        return sampled.continuous(conversion), ()
    except ValueError as error:
        return sampled, (Notice("warning", f"no continuous model: {error}", "difference equation"),)
