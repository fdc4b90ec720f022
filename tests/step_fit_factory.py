"""Simulated releases of known sensors for the tests of identifications."""

from __future__ import annotations

import numpy as np
from scipy.signal import lsim

from shaker.arrays import FloatArray
from shaker.lti.system import LinearSystem, ModalModel
from shaker.release.record import Reading, StepRecord
from shaker.release.sim import StepFit

RATE_HZ, AMPLITUDE = 100e3, 50.0
SENSOR = ((1700.0, 0.015),), (6000.0,)
"""The published case: (natural frequency, damping ratio) of the mode, low-pass filter."""


def sensor(modes: tuple[tuple[float, float], ...], low_pass_hz: tuple[float, ...] = ()) -> LinearSystem:
    """Return an all-pole sensor of static gain 1."""
    omega = [2 * np.pi * hz for hz, _ in modes]
    upper = [w * (-zeta + 1j * np.sqrt(1 - zeta**2)) for w, (_, zeta) in zip(omega, modes, strict=True)]
    poles = np.array([*upper, *np.conj(upper), *(-2 * np.pi * hz for hz in low_pass_hz)], dtype=np.complex128)
    return LinearSystem(np.zeros(0, complex), poles, float(np.real(np.prod(-poles))))


def answered(system: LinearSystem, load: FloatArray, step_s: float) -> FloatArray:
    """Return the exact answer to a load that is linear between samples, by scipy's matrix exponential."""
    scale = float(np.abs(system.poles).max())
    zeros, poles = system.zeros / scale, system.poles / scale
    gain = system.gain * scale ** (len(zeros) - len(poles))
    _, output, _ = lsim((zeros, poles, gain), load, np.arange(len(load)) * step_s * scale, interp=True)
    return np.asarray(output)


def released(
    system: LinearSystem, *, onset_s: float, length_s: float = 0.0, count: int = 4000, fine: int = 5
) -> FloatArray:
    """Return the answer (count,) to a load that goes from 0 to 1 along a line, on a grid `fine` times as fine."""
    time_s = np.arange((count - 1) * fine + 1) / (RATE_HZ * fine)
    load = np.clip((time_s - onset_s) / max(length_s, 1e-12), 0.0, 1.0)
    return answered(system, load, 1.0 / (RATE_HZ * fine))[::fine]


def record_of(output: FloatArray, noise: float, seed: int, force: FloatArray | None = None) -> StepRecord:
    """Return a record of an output for a unit load, scaled to `AMPLITUDE`, with an offset and white noise."""
    drawn = np.random.default_rng(seed).standard_normal(len(output))
    samples = 0.1 + AMPLITUDE * (output + noise * drawn)
    return StepRecord("simulated", ("Fz",), "mV", samples[None], RATE_HZ, "Fz", AMPLITUDE, force=force)


def rough(record: StepRecord, onset_s: float, release_s: float = 0.0, rise_s: float = 1e-4) -> Reading:
    """Return a reading that is off by 10 µs in the onset, as a start."""
    samples = record.samples[0]
    before = samples[: int(onset_s * RATE_HZ) - 10]
    steady = float(np.mean(samples[-len(samples) // 5 :]))
    return Reading(
        record=record.name,
        channel="Fz",
        component="Fz",
        unit="mV",
        release="",
        onset_s=onset_s + 1e-5,
        u_onset_s=1e-5,
        sign=1,
        baseline=float(np.mean(before)),
        u_baseline=0.01,
        steady=steady,
        u_steady=0.01,
        rise_s=rise_s + release_s,
        u_rise_s=1e-5,
        shape="ramp" if release_s else "step",
        release_s=release_s,
        u_release_s=0.1 * release_s + 1e-6,
        static_gain=(steady - float(np.mean(before))) / AMPLITUDE,
        u_static_gain=1e-3,
        noise=float(np.std(before)),
        clipped=False,
    )


def ring_rms(output: FloatArray, onset_s: float) -> float:
    """Return the rms of what rings about the new level of a unit load."""
    return float(np.sqrt(np.mean((output[int(onset_s * RATE_HZ) + 1 :] - 1.0) ** 2)))


def model_of(fit: StepFit) -> tuple[ModalModel, FloatArray]:
    """Return the model of a fit, and the standard uncertainties of its vector."""
    assert fit.model is not None
    assert fit.model.covariance is not None
    return fit.model, np.sqrt(np.diag(fit.model.covariance))
