"""Clocks tied by a camera trigger: errors and stated uncertainties over random cases with known truth.

Usage: python benchmarks/signals_clock.py [--cases 200] [--only NAME]

A trigger of 211 edges near 52.874 Hz is recorded at 51.2 kHz and at 50 kHz by clocks that differ by 17 ppm, the second
record beginning later. Every case draws start and sub-sample places anew. Printed, per kind of input and damage: the
error of the tie in the middle of the burst (rms, mean, largest, us), of the rate (rms, largest, ppm), what the program
states for the former (rms) and how often twice that holds, both errors over their stated uncertainties (rms), and the
time of one tie with both fits. "Thresholded": how late the first samples above the threshold are.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import sici

from shaker.timebase.edges import Edges, find_edges
from shaker.timebase.tie import tie_clocks
from shaker.timebase.trigger import fit_trigger, pulse_width

FloatArray = NDArray[np.float64]
PERIOD_S = 1.0 / 52.874
EDGES = 211
PPM = 17e-6
RATES_HZ = (51_200.0, 50_000.0)
WIDTH_S = 2e-3
PAD = 60  # samples on either side of a rise in which its shape differs from a step

Rise = Callable[[FloatArray], FloatArray]  # level after a distance, in samples, from the middle of the rise


def step(x: FloatArray) -> FloatArray:
    """A latched or multiplexed input: no sample on the rise."""
    return np.asarray(np.where(x >= 0.0, 1.0, 0.0))


def ideal(x: FloatArray) -> FloatArray:
    """An ideal low-pass at 0.45 of the sampling rate."""
    return np.asarray(0.5 + sici(2.0 * np.pi * 0.45 * x)[0] / np.pi)


def ramp(samples: float) -> Rise:
    """A linear rise over so many samples."""
    return lambda x: np.clip(x / samples + 0.5, 0.0, 1.0)


def charging(samples: float) -> Rise:
    """An RC input with that time constant; 0 is where it crosses half of the step."""
    return lambda x: np.asarray(1.0 - np.exp(-np.maximum(x / samples + np.log(2.0), 0.0)))


def decimated(cutoff: float = 0.5, half_width: int = 24, fine: int = 64) -> Rise:
    """The decimation filter of a delta-sigma converter: linear phase, half amplitude at `cutoff` of the rate."""
    place = np.arange(-half_width * fine, half_width * fine + 1) / fine
    taps = 2.0 * cutoff * np.sinc(2.0 * cutoff * place) * np.kaiser(len(place), 8.0)
    level = np.cumsum(taps) / taps.sum()
    return lambda x: np.asarray(np.interp(x - 0.5 / fine, place, level, left=0.0, right=1.0))


@dataclass(frozen=True)
class Case:
    """What is simulated: the rise, noise in steps, jitter, damage (share of edges), edges lost at ends and inside."""

    rises: tuple[Rise, Rise] = (step, step)
    noise: float = 0.002
    jitter_s: float = 0.0
    damage: float = 0.0
    lost: bool = False
    rates_hz: tuple[float, float] = RATES_HZ
    period_s: float = PERIOD_S
    spread: float = 0.0  # relative range of periods drawn
    barred: bool = False  # all cases, where others take an eighth of them


def sampled(rise: Rise, instants: FloatArray, rate: float, length_s: float, noise: FloatArray) -> FloatArray:
    """Return pulses of 2 ms with rises at the instants, and noise as given (S,)."""
    signal = noise.copy()
    count = len(signal)
    near = np.arange(-PAD, int(WIDTH_S * rate) + PAD)
    for instant in instants:
        index = int(np.floor(instant * rate)) + near
        inside = (index >= 0) & (index < count)
        place = index[inside] - instant * rate
        signal[index[inside]] += rise(place) - rise(place - WIDTH_S * rate)
    return signal


def damaged(instants: FloatArray, share: float, rng: np.random.Generator) -> FloatArray:
    """Return the instants with a share of them missing, doubled or joined by stray ones, a third each."""
    kept = rng.uniform(size=len(instants)) >= share / 3.0
    kept[[0, -1]] = True
    doubled = instants[rng.uniform(size=len(instants)) < share / 3.0] + rng.uniform(4e-3, 6e-3)
    stray = rng.uniform(instants[0] + 8e-3, instants[-1], rng.poisson(share / 3.0 * len(instants)))
    merged = np.sort(np.concatenate([instants[kept], doubled, stray]))
    # Two pulses in one are one edge.
    return np.asarray(merged[np.append(True, np.diff(merged) > 1.5 * WIDTH_S)])


@dataclass(frozen=True)
class Truth:
    """Instants on both clocks, the middle of the burst on both, and the true rate."""

    first_s: FloatArray
    second_s: FloatArray
    rate: float

    @property
    def middle_s(self) -> tuple[float, float]:
        """Middle of the burst on the first and on the second clock."""
        return float(self.first_s.mean()), float(self.second_s.mean())


@dataclass(frozen=True)
class Outcome:
    """Error and stated uncertainty of the tie in the middle (s) and of the rate, of thresholded edges, and the time."""

    offset_s: float
    u_offset_s: float
    rate: float
    u_rate: float
    thresholded_s: float
    seconds: float


def simulate(case: Case, rng: np.random.Generator) -> tuple[Edges, Edges, Truth, float]:
    """Return the edges of both records, the truth, and how much later the second record began."""
    period = case.period_s * (1.0 + case.spread * rng.uniform(-1.0, 1.0))
    first = 0.1 + rng.uniform(0.0, period)
    later = rng.uniform(0.0, 0.05) + (11.0 * period if case.lost else 0.0)
    instants = first + period * np.arange(EDGES) + case.jitter_s * rng.normal(size=EDGES)
    found = []
    for record, (rate, rise) in enumerate(zip(case.rates_hz, case.rises, strict=True)):
        seen = damaged(instants, case.damage, rng)
        length = instants[-1] + 0.2
        if case.lost:
            seen = np.delete(seen, rng.choice(np.arange(30, len(seen) - 30), 4, replace=False))
            length = instants[-10] + 0.7 * period if record == 0 else length
        own = (seen - later) * (1.0 + PPM) if record else seen
        noise = case.noise * rng.normal(size=int((length - later * record) * rate))
        found.append(find_edges(sampled(rise, own, rate, length, noise), rate, threshold=0.5))
    ideal_s = first + period * np.arange(EDGES, dtype=np.float64)
    truth = Truth(np.asarray(ideal_s), np.asarray((ideal_s - later) * (1.0 + PPM)), 1.0 / (1.0 + PPM))
    return found[0], found[1], truth, later


def trial(case: Case, rng: np.random.Generator) -> Outcome:
    """Tie the clocks of one random case."""
    first, second, truth, later = simulate(case, rng)
    begin = time.process_time()
    tie = tie_clocks(fit_trigger(first), fit_trigger(second), start_difference_s=later)
    seconds = time.process_time() - begin
    base_s, other_s = truth.middle_s
    error = float(tie.to_base_s(np.asarray(other_s))) - base_s
    u_rate = float(np.sqrt(tie.covariance[1, 1]))
    naive = thresholded(first, truth.first_s)
    u_offset = float(tie.u_to_base_s(np.asarray(other_s)))
    return Outcome(error, u_offset, tie.rate - truth.rate, u_rate, naive, seconds)


def thresholded(edges: Edges, truth_s: FloatArray) -> float:
    """Return how late the first samples above the threshold are, on average."""
    nearest = truth_s[np.argmin(np.abs(edges.upper_s[:, None] - truth_s), axis=1)]
    return float(np.median(edges.upper_s - nearest))


LATCHED = Case()
FILTERED = Case(rises=(ideal, ideal))
CONVERTER = Case(rises=(decimated(), decimated(0.47)))
CASES = {
    "sampled edges": replace(LATCHED, barred=True),
    "the same, periods drawn within 3 %": replace(LATCHED, spread=0.03),
    "10 % of the edges missing, doubled or spurious": replace(LATCHED, damage=0.1, barred=True),
    "jitter 30 ns": replace(LATCHED, jitter_s=30e-9),
    "jitter 2 us": replace(LATCHED, jitter_s=2e-6),
    "jitter 2 us and 10 % damaged": replace(LATCHED, jitter_s=2e-6, damage=0.1),
    "jitter 20 us": replace(LATCHED, jitter_s=20e-6),
    "edges lost at the ends and in the middle": replace(LATCHED, lost=True),
    "locked: period 968 and 945.3 samples": replace(LATCHED, period_s=968.0 / 51_200.0),
    "rise of 0.5 samples": Case(rises=(ramp(0.5), ramp(0.5))),
    "rise of 1 sample": Case(rises=(ramp(1.0), ramp(1.0))),
    "rise of 3 samples": Case(rises=(ramp(3.0), ramp(3.0))),
    "RC input, time constant 0.5 samples": Case(rises=(charging(0.5), charging(0.5))),
    "RC input, time constant 2 samples": Case(rises=(charging(2.0), charging(2.0))),
    "band-limited, ideal low-pass": replace(FILTERED, barred=True),
    "ideal low-pass, 10 % damaged": replace(FILTERED, damage=0.1),
    "ideal low-pass, jitter 2 us": replace(FILTERED, jitter_s=2e-6),
    "ideal low-pass, jitter 20 us": replace(FILTERED, jitter_s=20e-6),
    "ideal low-pass, edges lost at the ends and in the middle": replace(FILTERED, lost=True),
    "ideal low-pass, noise of 2 % of the step": replace(FILTERED, noise=0.02),
    "delta-sigma decimation filters": CONVERTER,
    "delta-sigma, jitter 2 us and 10 % damaged": replace(CONVERTER, jitter_s=2e-6, damage=0.1),
    "one latched, one delta-sigma": Case(rises=(step, decimated())),
    "one latched, one delta-sigma, jitter 20 us": Case(rises=(step, decimated()), jitter_s=20e-6),
}


def row(name: str, case: Case, cases: int) -> str:
    """Return one row of the table."""
    rng = np.random.default_rng(5)
    found = [trial(case, rng) for _ in range(cases)]
    offset, u, rate, u_rate, naive, seconds = np.array([list(vars(one).values()) for one in found]).T
    inside = 100.0 * np.mean(np.abs(offset) <= 2.0 * u)
    cells = (
        f"{1e6 * rms(offset):.3f}",
        f"{1e6 * offset.mean():+.3f}",
        f"{1e6 * np.abs(offset).max():.2f}",
        f"{1e6 * rms(rate):.3f}",
        f"{1e6 * np.abs(rate).max():.2f}",
        f"{1e6 * rms(u):.3f}",
        f"{inside:.0f} %",
        f"{rms(offset / u):.2f}",
        f"{rms(rate / u_rate):.2f}",
        f"{1e6 * naive.mean():.1f}",
        f"{seconds.mean():.2f}",
    )
    return f"| {name} | " + " | ".join(cells) + " |"


def rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def width_row(name: str, rise: Rise, noise: float, cases: int) -> str:
    """Return one row of the table of pulse widths at 51.2 kHz."""
    rng = np.random.default_rng(6)
    rate, found = RATES_HZ[0], []
    for _ in range(cases):
        instants = np.asarray(0.1 + rng.uniform(0.0, PERIOD_S) + PERIOD_S * np.arange(EDGES, dtype=np.float64))
        length = float(instants[-1]) + 0.1
        signal = sampled(rise, instants, rate, length, noise * rng.normal(size=int(length * rate)))
        width = pulse_width(signal, rate, threshold=0.5)
        found.append((width.width_s - WIDTH_S, width.u_width_s))
    error, u = np.array(found).T
    cells = (rms(error), error.mean(), np.abs(error).max(), rms(u))
    inside = 100.0 * np.mean(np.abs(error) <= 2.0 * u)
    numbers = " | ".join(f"{1e6 * cell:.3f}" for cell in cells)
    return f"| {name} | {numbers} | {inside:.0f} % | {rms(error / u):.2f} |"


def main(cases: int = 200, only: str = "") -> None:
    """Print the tables."""
    head = "| input | offset rms/us | mean/us | max/us | rate rms/ppm | max/ppm | stated u/us | within 2u | error/u "
    print(head + "| rate error/u | thresholded late/us | s |\n|---|" + "---|" * 11)
    for name, case in CASES.items():
        if only in name:
            print(row(name, case, cases if case.barred else cases // 8), flush=True)
    if not only:
        print("\n| width of pulses of 2 ms, input | rms/us | mean/us | max/us | stated u/us | within 2u | error/u |")
        print("|---|" + "---|" * 6)
        print(width_row("latched", step, 0.002, cases // 4), flush=True)
        print(width_row("delta-sigma", decimated(), 0.002, cases // 4), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--only", default="", help="rows whose name contains this")
    options = parser.parse_args()
    main(options.cases, options.only)
