"""Sweeps, bursts and pulses from rest to rest, simulated without the program: exact exponentials of the equations.

The structure is a sum of modes, acceleration over force; its equations of motion are discretised exactly for a force
that is linear between the steps of a grid 16 times finer than the record. Both channels pass one anti-alias filter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import bessel, chirp, cont2discrete, lfilter, sosfilt, ss2tf, tf2ss

from shaker.frf.result import TransferRecord

FloatArray = NDArray[np.float64]
Mode = tuple[float, float, float]
"""Natural frequency in Hz, damping ratio, participation in (m/s²)/N."""
MODES: tuple[Mode, ...] = ((150.0, 0.008, 1.0), (310.0, 0.01, -0.7), (430.0, 0.006, 0.5))
RATE_HZ, SAMPLES, FINER = 8192.0, 16384, 16
BAND_HZ = (110.0, 490.0)


def accelerance(frequency_hz: FloatArray, modes: Sequence[Mode] = MODES) -> NDArray[np.complex128]:
    """Acceleration over force."""
    s = 2j * np.pi * np.asarray(frequency_hz)
    turns = [(2.0 * np.pi * f, zeta, share) for f, zeta, share in modes]
    return np.sum([share * s**2 / (s**2 + 2.0 * zeta * w * s + w**2) for w, zeta, share in turns], axis=0)


def through(numerator: Sequence[float], denominator: Sequence[float], signal: FloatArray, step_s: float) -> FloatArray:
    """Response of a linear system at rest to a signal that is linear between its samples."""
    a, b, c, d, _ = cont2discrete(tf2ss(numerator, denominator), step_s, "foh")
    top, bottom = ss2tf(a, b, c, d)
    return np.asarray(lfilter(top[0], bottom, signal))


def sweep(
    time_s: FloatArray, level: float = 1.0, lead_s: float = 0.1, length_s: float = 1.6, **changes: object
) -> FloatArray:
    """A sweep with cosine flanks of 20 ms, from 100 to 500 Hz unless `from_hz`, `to_hz`, `method` say otherwise."""
    keys = {"from_hz": 100.0, "to_hz": 500.0, "method": "linear"} | changes
    local = time_s - lead_s
    flank = np.clip(np.minimum(local, length_s - local) / 0.02, 0.0, 1.0)
    wave = chirp(local, keys["from_hz"], length_s, keys["to_hz"], method=keys["method"])
    return np.asarray(level * wave * (0.5 - 0.5 * np.cos(np.pi * flank)))


def recorded(signals: Sequence[FloatArray]) -> list[FloatArray]:
    """Signals on the fine grid through one anti-alias filter, at the times of the record."""
    low_pass = bessel(6, 0.8 / FINER, output="sos")
    return [sosfilt(low_pass, signal)[::FINER] for signal in signals]


def simulate(
    force: Callable[[FloatArray], FloatArray],
    modes: Sequence[Mode] = MODES,
    samples: int = SAMPLES,
    rate_hz: float = RATE_HZ,
) -> tuple[FloatArray, FloatArray]:
    """Force and acceleration (samples,) without noise."""
    step_s = 1.0 / (FINER * rate_hz)
    drive = force(np.arange(FINER * samples) * step_s)
    turns = [(2.0 * np.pi * f, zeta, share) for f, zeta, share in modes]
    motion = [through([share, 0.0, 0.0], [1.0, 2.0 * zeta * w, w**2], drive, step_s) for w, zeta, share in turns]
    found = recorded([drive, np.sum(motion, axis=0)])
    return found[0], found[1]


def record(
    clean: tuple[FloatArray, FloatArray],
    rng: np.random.Generator | None = None,
    noise: tuple[float, float] = (0.01, 0.02),
    rate_hz: float = RATE_HZ,
) -> TransferRecord:
    """A record with white noise and an offset on both channels; exact without `rng`."""
    force, motion = clean
    if rng is not None:
        force = 0.3 + force + noise[0] * rng.standard_normal(len(force))
        motion = -0.2 + motion + noise[1] * rng.standard_normal(len(motion))
    return TransferRecord(force, motion[:, None], rate_hz, "force", "N", ("top",), ("m/s^2",))
