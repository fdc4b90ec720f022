"""A sensor with known poles and residues, its outputs to releases by scipy's discretisation at a finer step."""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from shaker.release.record import StepRecord

LOADS = ("Fx", "Fy", "Mz")
FREQUENCY_HZ, DAMPING = np.array([310.0, 335.0, 560.0]), np.array([0.02, 0.015, 0.018])
LAG_HZ = 700.0
DRIVE = np.array([[1.0, 0.06, -0.03], [-0.05, 1.0, 0.04], [0.02, -0.06, 1.0]])
SHOW = np.array([[2.0, 0.1, 0.05], [-0.08, 2.0, -0.06], [0.02, 0.03, 0.5]])
SIZE = np.array([10.0, 12.0, 9.0])
RATE_HZ, FINER = 10e3, 20
FloatArray = NDArray[np.float64]


def true_response(frequency_hz: FloatArray) -> NDArray[np.complex128]:
    """H (K, 3, 3): mode by mode, drive and show, then the lag of the amplifier."""
    s = 2j * np.pi * np.asarray(frequency_hz)[:, None]
    omega = 2.0 * np.pi * FREQUENCY_HZ
    swing = omega**2 / (s**2 + 2.0 * DAMPING * omega * s + omega**2) / (1.0 + s / (2.0 * np.pi * LAG_HZ))
    return np.asarray(np.einsum("cm,km,md->kcd", SHOW, swing, DRIVE))


def true_residues() -> tuple[NDArray[np.complex128], FloatArray]:
    """Residues (3, 3, 3) of the modes and (1, 3, 3) of the lag, by partial fractions."""
    omega, corner = 2.0 * np.pi * FREQUENCY_HZ, 2.0 * np.pi * LAG_HZ
    pole = omega * (-DAMPING + 1j * np.sqrt(1.0 - DAMPING**2))
    swing = omega**2 * corner / ((pole - pole.conj()) * (pole + corner))
    lag = omega**2 * corner / (corner**2 - 2.0 * DAMPING * omega * corner + omega**2)
    return np.einsum("cm,m,md->mcd", SHOW, swing, DRIVE), np.einsum("cm,m,md->cd", SHOW, lag, DRIVE)[None]


def true_outputs(load: FloatArray, component: int, step_s: float) -> FloatArray:
    """Outputs (3, N) to a load (N,) in equal steps, which is taken to go straight between them."""
    states = []
    for omega, zeta in zip(2.0 * np.pi * FREQUENCY_HZ, DAMPING, strict=True):
        below = np.polymul([1.0, 2.0 * zeta * omega, omega**2], [1.0 / (2.0 * np.pi * LAG_HZ), 1.0])
        top, bottom, _ = cont2discrete(([omega**2], below), step_s, "foh")
        states.append(lfilter(top.ravel(), bottom, load))
    return np.asarray((SHOW * DRIVE[:, component]) @ np.array(states))


def release(rng: np.random.Generator, component: int, noise: FloatArray, name: str, count: int = 1400) -> StepRecord:
    """A record of a load taken off along a line of about 0.8 ms, 20 ms after its beginning."""
    time_s = np.arange(count * FINER) / (RATE_HZ * FINER)
    duration_s, onset_s = 0.8e-3 * rng.uniform(0.8, 1.2), 20e-3 + rng.uniform(0.0, 1e-4)
    load = np.clip((time_s - onset_s) / duration_s, 0.0, 1.0)
    amplitude = -float(SIZE[component]) * rng.uniform(0.9, 1.0)
    clean = amplitude * true_outputs(load, component, 1.0 / (RATE_HZ * FINER))[:, ::FINER]
    level = rng.standard_normal(3)[:, None] - amplitude * true_response(np.zeros(1))[0].real[:, component, None]
    samples = level + clean + noise[:, None] * rng.standard_normal(clean.shape)
    return StepRecord(name, LOADS, "V", samples, RATE_HZ, LOADS[component], amplitude)


def releases(seed: int, share: float = 0.01, each: int = 2) -> list[StepRecord]:
    """Releases of every load; noise is a share of every output's own step."""
    rng = np.random.default_rng(seed)
    noise = share * SIZE * np.diag(SHOW @ DRIVE)
    return [release(rng, d, noise, f"{name}-{k}") for d, name in enumerate(LOADS) for k in range(each)]
