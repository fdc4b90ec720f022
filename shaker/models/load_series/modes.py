"""The modes that one record shows after its release, by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.load_series.decay import FreeDecay, coloured, projected
from shaker.models.load_series.least_squares import minimum
from shaker.models.load_series.resonances import Resonances

PARTS = (1, 3, 9, 27)
"""The record and ever shorter beginnings of it in which modes of any damping stand out."""
NEAREST = 2
"""Number of starts that are followed, those that leave least."""
SEPARATE = 1.15
"""Ratio to the first resonance from which another one counts as second mode."""
CLEAR = 8.0
"""Height of a line over the median of the spectrum from which it may be a mode."""
SURE = 1e-6
"""Chance of a second mode in noise above which none is taken to be seen."""
HEAVIEST, VAGUEST = 0.3, 0.05
"""Damping ratio and relative uncertainty of the frequency up to which a second mode is used."""


@dataclass(frozen=True)
class RecordModes:
    """One or two modes of a record: upper poles (M,) in rad/s, covariance (2M, 2M) of [Re p, Im p] of each mode.

    `noise`: standard deviation of what the modes leave, in output units.
    """

    name: str
    poles: ComplexArray
    covariance: FloatArray
    noise: float

    @property
    def frequency_hz(self) -> FloatArray:
        """Natural frequencies (M,)."""
        return np.asarray(np.abs(self.poles) / (2.0 * np.pi))

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratios (M,)."""
        return np.asarray(-self.poles.real / np.abs(self.poles))

    @property
    def u(self) -> tuple[FloatArray, FloatArray]:
        """Standard uncertainties of frequencies and damping ratios (M,)."""
        found = []
        for m, p in enumerate(self.poles):
            own, size = self.covariance[2 * m : 2 * m + 2, 2 * m : 2 * m + 2], abs(p)
            f = np.array([p.real, p.imag]) / size
            z = np.array([-(p.imag**2), p.real * p.imag]) / size**3
            found.append((np.sqrt(f @ own @ f) / (2.0 * np.pi), np.sqrt(z @ own @ z)))
        both = np.array(found)
        return both[:, 0], both[:, 1]


def record_modes(decay: FreeDecay) -> RecordModes:
    """Return the first mode of a record, and a second above it where one stands out of the noise."""
    from scipy.special import fdtrc

    one = _fitted(decay, _starts(decay, decay.value - np.mean(decay.value), 0.0), np.zeros(0, dtype=np.complex128))
    left, _ = projected(decay, one.poles)
    floor_hz = SEPARATE * float(one.frequency_hz[0])
    starts = _starts(decay, left, floor_hz)
    if not starts:
        return one
    two = _fitted(decay, starts, one.poles)
    free = len(decay.value) - 9
    gain = (one.noise**2 * (free + 4) - two.noise**2 * free) / 4.0 / two.noise**2
    seen = fdtrc(4, free, max(gain, 0.0)) < SURE and _usable(two, floor_hz)
    return two if seen else one


def as_resonances(found: list[RecordModes]) -> Resonances:
    """Return the modes of all records as one table."""
    table = np.full((4, len(found), 2), np.nan)
    for r, modes in enumerate(found):
        count = len(modes.poles)
        for place, values in enumerate((modes.frequency_hz, modes.u[0], modes.damping_ratio, modes.u[1])):
            table[place, r, :count] = values
    return Resonances(tuple(modes.name for modes in found), *table)


def _usable(two: RecordModes, floor_hz: float) -> bool:
    """Whether the second of two modes decays, lies above the first and is known well enough."""
    f, z = float(two.frequency_hz[1]), float(two.damping_ratio[1])
    return 0.0 < z < HEAVIEST and f > floor_hz and float(two.u[0][1]) < VAGUEST * f


def _starts(decay: FreeDecay, value: FloatArray, above_hz: float) -> list[complex]:
    """Poles at the highest line of each beginning of a record that stands out of its spectrum."""
    found = []
    for part in PARTS:
        count = len(value) // part
        if count < 32:
            break
        size = np.abs(np.fft.rfft((value[:count] - np.mean(value[:count])) * np.hanning(count), 4 * count))
        hertz = np.fft.rfftfreq(4 * count, 1.0 / decay.rate_hz)
        size[(hertz <= above_hz) | (hertz < 2.0 * decay.rate_hz / count)] = 0.0
        place = int(np.argmax(size))
        if size[place] > CLEAR * np.median(size[size > 0.0]) or above_hz == 0.0:
            omega = 2.0 * np.pi * float(hertz[place])
            found.append(complex(-_decay_rate(value[:count], omega, decay.rate_hz), omega))
    return found


def _decay_rate(value: FloatArray, omega: float, rate_hz: float) -> float:
    """Decay rate in 1/s of one line by its amplitudes in the first and in the second half."""
    half = len(value) // 2
    wave = np.hanning(half) * np.exp(-1j * omega * np.arange(half) / rate_hz)
    early, late = abs(wave @ value[:half]), abs(wave @ value[half : 2 * half])
    return float(max(np.log(early / max(late, 1e-300)), 0.1) * rate_hz / half)


def _fitted(decay: FreeDecay, starts: list[complex], known: ComplexArray) -> RecordModes:
    """The best of the fits that begin at known poles and a further one."""
    best: tuple[FloatArray, float] | None = None
    tried = [np.append(known, start) for start in starts]
    tried.sort(key=lambda poles: float(np.sum(projected(decay, poles)[0] ** 2)))
    for poles in tried[:NEAREST]:
        x = np.stack([poles.real, poles.imag], axis=1).ravel()
        found = minimum(lambda x: projected(decay, x[::2] + 1j * x[1::2]), x)
        if best is None or found[1] < best[1]:
            best = found
    if best is None:
        raise ValueError(f"decay: expected an oscillation after the release of {decay.name}, found none")
    poles = np.asarray(best[0][::2] + 1j * best[0][1::2])
    residual, slope = projected(decay, poles)
    inner = np.linalg.inv(slope.T @ slope)
    free = len(residual) - 1 - 2 * len(best[0])
    covariance = inner @ coloured(slope, residual) @ inner * len(residual) / free
    return RecordModes(decay.name, poles, covariance, float(np.sqrt(residual @ residual / free)))
