"""The response over frequency that a release shows by itself, without a model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion.step.result import Release
from shaker._checks import ComplexArray, FloatArray

LAST = 20
"""Share 1/LAST of a force's record, its end, that gives its last level."""
WEAK = 0.2
"""Share of a step's spectrum below which a release drives too little."""


class Measured(NamedTuple):
    """Output over load (K,) at frequencies (K,) in Hz; `u` (K,): r.m.s. size of what white noise adds to each."""

    frequency_hz: FloatArray
    value: ComplexArray
    u: FloatArray


def measured_response(release: Release) -> Measured:
    """Return output over load of one release from the spectra of their derivatives.

    H(f) = Y'(f)/X'(f) with Y' = jω·Y from the differences of the samples, exact for what lies below half the sampling
    rate, and X' = A·s(f)·exp(-jωt), t the middle of the release and s = sin(πfT)/(πfT) of a load that changes evenly
    for T, cos(πfT)/(1 - (2fT)²) of one that changes along half a cosine; where the load was measured, X' likewise from
    its samples. Frequencies at which the release drives less than a fifth of what a step would are left out. From the
    onset on; before it nothing happens.
    """
    record = release.input.record
    step = 1.0 / record.sample_rate_hz
    onset = release.reading.onset_s if release.fit is None else release.fit.onset_s
    first = max(0, int((onset - record.start_s) / step) - 3)
    samples = record.samples[record.channels.index(release.driven), first:]
    start_s = record.start_s + first * step
    ends = release.reading.baseline, release.reading.steady
    frequency, moved = _derivative(samples, ends, start_s, step)
    if record.force is not None:
        force = record.force[first:]
        ends = float(record.force[: max(first, 1)].mean()), float(force[-max(1, len(force) // LAST) :].mean())
        driven = _derivative(force, ends, start_s, step)[1]
    else:
        middle = np.exp(-2j * np.pi * frequency * (onset + 0.5 * release.release_s))
        driven = record.amplitude * _share(release, frequency) * middle
    kept = (np.abs(driven) >= WEAK * abs(record.amplitude)) & (frequency > 0.0)
    noise = 2.0 * np.pi * frequency * release.reading.noise * step * np.sqrt(len(samples))
    return Measured(frequency[kept], moved[kept] / driven[kept], noise[kept] / np.abs(driven[kept]))


def _derivative(
    samples: FloatArray, ends: tuple[float, float], start_s: float, step_s: float
) -> tuple[FloatArray, ComplexArray]:
    """Spectrum of the derivative of samples (N,) between two levels: frequencies (K,) and values (K,).

    The sum of the differences' exp(-jωt) times ωΔ/(2 sin(ωΔ/2)), what a derivative has over a difference.
    """
    change = np.diff(samples, prepend=ends[0], append=ends[1])
    frequency = np.fft.rfftfreq(len(change), step_s)[:-1]
    turn = np.pi * frequency * step_s
    wide = np.divide(turn, np.sin(turn), out=np.ones_like(turn), where=turn > 0.0)
    spectrum = np.fft.rfft(change)[:-1] * wide
    return np.asarray(frequency), np.asarray(spectrum * np.exp(-2j * np.pi * frequency * (start_s - 0.5 * step_s)))


def _share(release: Release, frequency: FloatArray) -> FloatArray:
    """What a release drives over what a step would (K,)."""
    turn = frequency * release.release_s
    even = np.asarray(np.sinc(turn))
    if release.reading.shape != "smooth":
        return even
    near = np.abs(1.0 - (2.0 * turn) ** 2) < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(near, np.pi / 4.0, np.cos(np.pi * turn) / (1.0 - (2.0 * turn) ** 2))
