"""Uncertainties that the planner foretells, against the scatter of sines fitted to simulated frames.

Usage: python benchmarks/signals_plan.py [--trials 4000]

Every frame is the mean of the motion over its exposure, plus white noise and 1/f noise (cut from a record 16 times as
long, so that it has power below the record's own resolution); the phases of the lines are drawn anew for every trial.
Amplitude and phase of every line are fitted, corrected for the exposure, and their standard deviations over all trials
divided by what the planner says. Some 1 minute on one core.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shaker.lines.rate_planner import PlannedLines, RatePlan, Sampling, lines_of, plan_at
from shaker.sine.aliasing import nearest_clear_rate
from shaker.sine.sine_fit import fit_sines

FloatArray = NDArray[np.float64]
LONGER = 16  # length of the records of 1/f noise, in lengths of the frames cut from them
CHANNELS = 20  # trials fitted at a time, as channels of one fit
AMPLITUDE = 100.0  # of every line, in units of the noise of a frame


@dataclass(frozen=True)
class Case:
    """One plan to be checked."""

    name: str
    fundamentals_hz: tuple[float, ...]
    rate_hz: float
    sampling: Sampling


CASES = (
    Case("published: 106.25 Hz at 52.874 Hz", (106.25,), 52.874, Sampling(211, 40e-6)),
    Case("the same, white noise", (106.25,), 52.874, Sampling(211, 40e-6, corner_hz=0.0)),
    Case("the same, best rate", (106.25,), 57.565, Sampling(211, 40e-6)),
    Case("53.7 Hz, best rate", (53.7,), 63.491, Sampling(211, 40e-6)),
    Case("1020.3 Hz, rate for all twelve", (1020.3,), 43.901, Sampling(211, 40e-6)),
    Case("1020.3 Hz, exposure 400 µs", (1020.3,), 79.427, Sampling(211, 400e-6, harmonics=2)),
    Case("375.9 Hz, corner 50 Hz", (375.9,), 61.3, Sampling(211, 40e-6, corner_hz=50.0)),
    Case("120, 175, 210 Hz together", (120.0, 175.0, 210.0), 71.77, Sampling(300, 40e-6, harmonics=2)),
    Case("harmonics 1.25 bins apart", (106.25,), 0.0, Sampling(211, 40e-6)),
    Case("0.8 bins from zero", (106.25,), 53.0244, Sampling(211, 40e-6, harmonics=1)),
    Case("0.5 bins from Nyquist", (106.25,), 70.7548, Sampling(211, 40e-6, harmonics=1)),
    Case("24 frames", (106.25,), 66.0, Sampling(24, 40e-6, harmonics=2)),
)


def main(trials: int = 4000) -> None:
    """Print a Markdown row per case: the range, over its lines, of simulated over predicted uncertainty."""
    print("| case | condition | u fundamental / noise | amplitude: simulated / planned | phase |")
    print("|---|---|---|---|---|")
    for seed, case in enumerate(CASES):
        plan = plan_at(lines_of(case.fundamentals_hz, case.sampling.harmonics), _rate(case), case.sampling)
        amplitude, phase = scatter(plan, case.sampling, trials, np.random.default_rng(seed))
        share, turned = amplitude / plan.u_amplitude, phase * AMPLITUDE / plan.u_amplitude
        print(
            f"| {case.name} | {plan.condition:.2f} | {plan.u_amplitude[0]:.3f} | "
            f"{share.min():.3f} to {share.max():.3f} | {turned.min():.3f} to {turned.max():.3f} |",
            flush=True,
        )


def scatter(plan: RatePlan, sampling: Sampling, trials: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations (K,) of amplitude and phase of fitted lines over simulated series."""
    lines, frames = plan.lines, plan.frames
    middle = np.arange(frames) / plan.rate_hz
    names, units = [str(i) for i in range(CHANNELS)], ["m"] * CHANNELS
    size, turn = [], []
    for _ in range(-(-trials // CHANNELS)):
        phase = rng.uniform(-np.pi, np.pi, (len(lines.frequency_hz), CHANNELS))
        values = exposed(lines, middle, sampling.exposure_s, phase)
        values += coloured_noise(frames, plan.rate_hz, sampling.corner_hz, rng)
        fitted = fit_sines(middle, values, lines.frequency_hz, names, units).phasors.value / plan.gain[:, None]
        size.append(np.abs(fitted))
        turn.append(np.angle(fitted * np.exp(-1j * phase)))
    return np.std(np.hstack(size), axis=1), np.sqrt(np.mean(np.hstack(turn) ** 2, axis=1))


def exposed(lines: PlannedLines, middle_s: FloatArray, exposure_s: float, phase: FloatArray) -> FloatArray:
    """Return frames (S, C) of lines with phases (K, C): means over the exposure, by Gauss's quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    values = np.zeros((len(middle_s), phase.shape[1]))
    for node, weight in zip(nodes, weights, strict=True):
        time = middle_s + node * exposure_s / 2.0
        for frequency, start in zip(lines.frequency_hz, phase, strict=True):
            values += AMPLITUDE * weight / 2.0 * np.cos(2.0 * np.pi * frequency * time[:, None] + start)
    return values


def coloured_noise(frames: int, rate_hz: float, corner_hz: float, rng: np.random.Generator) -> FloatArray:
    """Return series (S, C) of white noise of unit variance plus 1/f noise that equals it at the corner."""
    length = LONGER * frames
    spectrum = np.fft.rfft(rng.normal(size=(length, CHANNELS)), axis=0)
    frequency = np.fft.rfftfreq(length, 1.0 / rate_hz)
    frequency[0] = np.inf
    pink = np.fft.irfft(spectrum * np.sqrt(corner_hz / frequency)[:, None], n=length, axis=0)
    return np.asarray(rng.normal(size=(frames, CHANNELS)) + pink[length // 2 : length // 2 + frames])


def _rate(case: Case) -> float:
    """Return the rate of a case; none given: the nearest to 53.125 Hz, where all harmonics meet, that is clear."""
    if case.rate_hz:
        return case.rate_hz
    lines = lines_of(case.fundamentals_hz, case.sampling.harmonics)
    rate = nearest_clear_rate(lines.frequency_hz, 53.125, case.sampling.frames)
    assert rate is not None
    return rate


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=4000)
    main(parser.parse_args().trials)
