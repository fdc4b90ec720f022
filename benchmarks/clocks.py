"""Clocks whose edges fall nearly on the same places between samples: what edges leave open, and what the motion tells.

    python benchmarks/clocks.py [--draws 200] [--only NAME] [--write docs/clocks.md]

A camera of 96 frames sees a line of 106.25 Hz that a laser sees, too; its trigger is recorded by the laser's block and
by a bridge's block, each on a clock of its own. Frames come every 500 samples and a little more or less, which moves
the edges by so much of a sample over the record. Every draw has other starts, clocks, noise; from edges, samples and
poses on it is the program's own path, down to what a bridge's output lags the motion that laser and camera see. Truth
is what was drawn. The least u is that of the exact posterior (`least_u`), which has no formula of the program in it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from marked import existing_file, markdown_table, write_marked
from numpy.typing import NDArray
from signals_clock import Rise, charging, ideal, ramp, sampled, step

from fusion.estimation.fuse import fuse
from fusion.estimation.uncertainty import Uncertainty, added_up, merge_contributions
from fusion.instruments.channel import observe_channels, sensor_outputs
from fusion.instruments.stereo import StereoReading
from fusion.phasors.channel_phasors import channel_phasors, line_clock
from fusion.phasors.clocks import refine_ties, tie_clocks_by_motion
from fusion.phasors.stereo_motion import StereoMotion
from fusion.phasors.stereo_phasors import stereo_phasors
from fusion.phasors.timing import TimeBase, frame_sight
from fusion.recording.daq_records import DaqRecord
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import Stereo
from fusion.sensitivity.analyse import with_estimates
from photogram.motion import Deformation, RigidMotion
from shaker.io.channel import RawChannel
from shaker.lines.frequencies import LineFrequencies
from shaker.signal_notices import CONTRADICTORY_PERIOD
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineModel
from shaker.timebase.edges import find_edges
from shaker.timebase.tie import tie_clocks
from shaker.timebase.trigger import TriggerFit, fit_trigger

FloatArray = NDArray[np.float64]
LINE_HZ, RATE_HZ, FRAMES, WHOLE = 106.25, 25_600.0, 96, 500
SIZE = np.array([3e-7, 1e-7, 4.25e-4, 2e-7, 1e-7, 5e-8])  # m, rad: 189 m/s² along z
NOISE = np.array([1e-7, 1e-7, 3e-7, 3e-6, 3e-6, 1e-6])  # m, rad, of one frame
LASER_NOISE = 1e-4  # of the velocity, in one sample
EXPOSURE_S, JITTER_S, PPM = 4e-5, 1e-9, 1e-6
DELAYS_S = 2e-8, 5e-8  # u of what laser and camera state of their delays
OUTPUT = ("Fz",)


@dataclass(frozen=True)
class Case:
    """By how much of a sample edges move over the record, the rises of both inputs, and the bridge's rate.

    `free`: the period is no multiple of the sampling interval.
    """

    drift: float
    rises: tuple[Rise, Rise] = (step, step)
    bridge_hz: float = RATE_HZ
    free: bool = False


CASES = {
    "0": Case(0.0),
    "0.3": Case(0.3),
    "0.6": Case(0.6),
    "0.9": Case(0.9),
    "1.5": Case(1.5),
    "0.6, bridge at 20 kHz": Case(0.6, bridge_hz=20_000.0),
    "0.6, ideal low-pass": Case(0.6, (ideal, ideal)),
    "0.6, rise of one sample": Case(0.6, (ramp(1.0), ramp(1.0))),
    "0.6, RC of half a sample": Case(0.6, (charging(0.5), charging(0.5))),
    "no lock: 500.382 samples": Case(0.0, free=True),
}


@dataclass(frozen=True)
class Simulated:
    """One recording, as far as the clocks go, and the truth: `instants` (F,) of the frames' middles on the first clock,
    of their triggers on the bridge's clock, and phasors (6,) of the motion there; `late_s`: delays of laser and camera
    beyond what they state; `ppm`: by how much the bridge's clock runs fast."""

    manifest: Any
    base: TimeBase
    motion: StereoMotion
    lines: LineFrequencies
    middle_s: FloatArray
    bridge_s: FloatArray
    first_s: FloatArray
    truth: NDArray[np.complex128]
    late_s: FloatArray
    ppm: float


def _trigger(rise: Rise, instants: FloatArray, rate_hz: float, rng: np.random.Generator) -> TriggerFit:
    length = int((instants[-1] + 0.1) * rate_hz)
    signal = sampled(rise, instants, rate_hz, length / rate_hz, 0.002 * rng.normal(size=length))
    return fit_trigger(find_edges(signal, rate_hz, threshold=0.5))


LASER = {
    "name": "laser", "quantity": "velocity", "body": "load", "point": [0, 0, 0], "direction": [0, 0, 1],
    "delay_uncertainty": DELAYS_S[0], "scale_uncertainty": 1e-3,
}  # fmt: skip


def _record(name: str, times: tuple[FloatArray, float], phasor: complex, rng: np.random.Generator) -> DaqRecord:
    """Return a block with one channel, a laser or the sensor's output, that sees a phasor at these true times."""
    (time_s, rate_hz), output = times, {"name": OUTPUT[0], "quantity": "output", "channel": OUTPUT[0]}
    entry = ChannelEntry.model_validate(output if name == "bridge" else LASER)
    value = (phasor * np.exp(2j * np.pi * LINE_HZ * time_s)).real
    value += LASER_NOISE * abs(phasor) * rng.normal(size=len(time_s))
    block: Any = SimpleNamespace(name=name, channel=(entry,), clock_uncertainty=0.0, file=Path(name))
    return DaqRecord(block, {entry.name: RawChannel(value, rate_hz)}, 0.0)


def simulate(case: Case, rng: np.random.Generator) -> Simulated:
    """Draw one recording."""
    period = (WHOLE + (0.381966 if case.free else rng.choice([-1.0, 1.0]) * case.drift / (FRAMES - 1))) / RATE_HZ
    instants = 0.1 + rng.uniform(0.0, 1.0) / RATE_HZ + period * np.arange(FRAMES) + JITTER_S * rng.normal(size=FRAMES)
    begin, ppm = 0.03 + rng.uniform(0.0, 1.0) / RATE_HZ, PPM * rng.normal()
    bridge = (instants - begin) * (1.0 + ppm)
    rates = RATE_HZ, case.bridge_hz
    fits = [_trigger(*one, rng) for one in zip(case.rises, (instants, bridge), rates, strict=True)]
    length = int((instants[-1] + 0.1) * RATE_HZ)
    own = np.arange(length) / RATE_HZ, np.arange(int(length * rates[1] / RATE_HZ)) / rates[1]
    truth = SIZE * np.exp(2j * np.pi * rng.uniform(size=6))
    late, omega = np.array(DELAYS_S) * rng.normal(size=2), 2.0 * np.pi * LINE_HZ
    velocity, force = 1j * omega * truth[2] * np.exp(-1j * omega * late[0]), -(omega**2) * truth[2]
    records = (
        _record("vibrometer", (own[0], rates[0]), velocity, rng),
        _record("bridge", (own[1] / (1.0 + ppm) + begin, rates[1]), force, rng),
    )
    triggers = {("vibrometer", "camera"): fits[0], ("bridge", "camera"): fits[1]}
    base = TimeBase(records, triggers, {"vibrometer": None, "bridge": tie_clocks(fits[0], fits[1], 0)})
    free = fit_sines(own[0], records[0].stacked(records[0].entry.channel), np.array([LINE_HZ]), ["v"], ["m/s"],
                     model=SineModel(free=(0,)))  # fmt: skip
    one = np.ones(1, dtype=np.int64)
    lines = LineFrequencies(free.phasors.frequency_hz, free.u_frequency_hz, np.array([LINE_HZ]), one, ("",), ())
    middle = instants + EXPOSURE_S / 2.0
    turn = np.exp(2j * np.pi * LINE_HZ * (middle - late[1]))[:, None] * np.sinc(LINE_HZ * EXPOSURE_S)
    poses = (turn * truth).real + NOISE * rng.normal(size=(FRAMES, 6))
    entry = SimpleNamespace(
        stereo="top", trigger="camera", first_edge=0, exposure=EXPOSURE_S, delay=0.0, delay_uncertainty=DELAYS_S[1]
    )
    pair = Stereo.model_validate(
        {
            "body": "load", "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.3], "exposure": EXPOSURE_S,
            "scale_uncertainty": 1e-3,
        }
    )  # fmt: skip
    rig = SimpleNamespace(stereo={"top": pair}, unit_of=lambda quantity: "V/V" if quantity == "output" else "m/s")
    manifest: Any = SimpleNamespace(rig=rig, path=Path("recording.toml"), images=(), points=(entry,))
    nothing, eye = np.zeros((FRAMES, 1, 3)), np.tile(np.eye(6), (FRAMES, 1, 1))
    motion = RigidMotion(poses - poses[0], eye, np.zeros(FRAMES), np.ones(FRAMES, dtype=np.int64), np.zeros(3))
    beside = Deformation(nothing[0], nothing, np.zeros((FRAMES, 1, 3, 3)))
    sight: Any = entry
    seen = StereoMotion(frame_sight(manifest, base, sight, FRAMES), motion, (beside,), 0.0, None, ())
    return Simulated(manifest, base, seen, lines, middle, bridge, instants, truth, late, ppm)


@dataclass(frozen=True)
class Found:
    """Errors and their standard uncertainties (6, 2): exposures in the middle (s) and their rate, the phase along z
    (rad), the tie in the middle (s), exposures as the bridge's clock has them, how far the output lags the motion of
    all instruments (s); `contradicted`: whether a notice states that a period contradicts its edges."""

    errors: FloatArray
    contradicted: bool


def found(one: Simulated, base: TimeBase, motion: StereoMotion, lines: LineFrequencies) -> Found:
    """Compare what is said of clocks and motion with the truth."""
    place = np.arange(FRAMES) - (FRAMES - 1) / 2.0
    late = motion.sight.time_s - one.middle_s
    period_s = float(np.mean(np.diff(one.middle_s)))
    slope = float(place @ late / (place @ place)) / period_s
    at_s, errors = float(np.mean(motion.sight.time_s)), base.sight_errors(motion.sight)
    u_time = float(np.linalg.norm([e.offset_s + e.rate * at_s for e in errors]))
    seen = stereo_phasors(base, motion, lines, base.line_errors(lines, line_clock(base)))
    value = seen.reading.phasors.value[0, 2]
    own = [e.effect[0, 0] + getattr(e, "rest", np.zeros((1, 6)))[0, 2] / value for e in seen.reading.errors]
    noise = float(np.hypot(seen.reading.phasors.u_re[0, 2], seen.reading.phasors.u_im[0, 2])) / np.sqrt(2.0)
    u_phase = float(np.linalg.norm([noise / abs(value), *(e.imag for e in own)]))
    tie = base.ties["bridge"]
    assert tie is not None
    there, here = float(np.mean(one.bridge_s)), float(np.mean(one.first_s))
    behind = {e.name: e.offset_s + e.rate * here for e in base.tie_errors("bridge")}
    ahead = {e.name: e.offset_s + e.rate * here for e in errors}
    apart = [ahead.get(name, 0.0) - behind.get(name, 0.0) for name in ahead | behind]
    pairs = (
        (float(np.mean(late)), u_time),
        (slope, float(np.linalg.norm([e.rate for e in errors]))),
        (float(np.angle(value / one.truth[2])) + 2.0 * np.pi * LINE_HZ * one.late_s[1], u_phase),
        (float(tie.to_base_s(np.array(there))) - here, float(np.linalg.norm(list(behind.values())))),
        (float(np.mean(late)) - float(tie.to_base_s(np.array(there))) + here, float(np.linalg.norm(apart))),
        output_lag(one, base, seen.reading, lines),
    )
    notices = (notice for fit in base.triggers.values() for notice in fit.notices)
    return Found(np.array(pairs), any(notice.code == CONTRADICTORY_PERIOD.code for notice in notices))


def output_lag(one: Simulated, base: TimeBase, pair: StereoReading, lines: LineFrequencies) -> tuple[float, float]:
    """Return by how much the output seems later than the motion than it is, and the standard uncertainty of that."""
    readings = channel_phasors(one.manifest, base, lines)[1]
    fused = fuse((pair.observation(), *observe_channels(readings)))
    outputs = sensor_outputs(readings, OUTPUT)
    assert outputs is not None
    known = with_estimates(outputs, fused)
    motion, force = fused.phasors.value[:, [2]], known.phasors.value
    parts = known.uncertainty.scaled(1.0 / force), fused.uncertainty.at([2]).scaled(-1.0 / motion)
    influences = added_up([i for part in parts for i in part.influences])
    relative = Uncertainty(merge_contributions([c for part in parts for c in part.random]), influences)
    u = float(np.sqrt(relative.covariance[0, 1, 1]))
    omega = 2.0 * np.pi * LINE_HZ
    return -float(np.angle(force[0, 0] / motion[0, 0])) / omega, u / omega


def least_u(one: Simulated, rng: np.random.Generator, phase: bool, less: float = 1.0, shared: int = 1) -> FloatArray:
    """Return the standard deviations (2,) of the exact posterior of the frames' instants and of the bridge's tie, s.

    Of the middle of the burst, on the first clock. Edges in both blocks lie in their intervals; the motion tells the
    period, normal about the truth with the u of its `bound`, and, if the `phase` of laser and camera is compared, the
    middle, with that of their noise and delays. On average no estimate has a smaller mean square of its error. With
    frames of `less` times the noise, and a period that so many recordings have in common.
    """
    u_period = less * bound() * WHOLE / RATE_HZ / np.sqrt(shared)
    u_noise = less * np.sqrt(2.0 / FRAMES) * NOISE[2] / (SIZE[2] * 2.0 * np.pi * LINE_HZ)
    u_middle = np.hypot(np.linalg.norm(DELAYS_S), u_noise)
    number = np.arange(FRAMES) - (FRAMES - 1) / 2.0
    period = float(np.polyfit(number, one.first_s, 1)[0]) + u_period * (rng.normal() + np.linspace(-6.0, 6.0, 201))
    log_weight = -0.5 * ((period - period.mean()) / u_period) ** 2
    ends = []
    for block, rate in (("vibrometer", 1.0), ("bridge", 1.0 + one.ppm)):
        fit = one.base.triggers[block, "camera"]
        late = rate * period[:, None] * number[fit.number]
        ends.append((np.max(fit.lower_s - late, axis=1) - JITTER_S, np.min(fit.upper_s - late, axis=1) + JITTER_S))
    (low, high), (first, last) = ends
    possible = (high > low) & (last > first)
    place = (np.arange(200) + 0.5) / 200.0
    middle = low[:, None] + (high - low)[:, None] * place
    share = np.ones_like(middle)
    if phase:
        told = float(np.mean(one.first_s)) + u_middle * rng.normal()
        share = np.exp(-0.5 * ((middle - told) / u_middle) ** 2)
    weight = np.where(possible, np.exp(log_weight) * (high - low) * (last - first), 0.0)[:, None] * share
    weight /= weight.sum()
    mean = float(np.sum(weight * middle))
    apart = middle - ((first + last) / 2.0)[:, None]
    offset = float(np.sum(weight * apart))
    tie = np.sum(weight * (apart - offset) ** 2) + np.sum(weight.sum(axis=1) * (last - first) ** 2) / 12.0
    return np.sqrt([np.sum(weight * (middle - mean) ** 2), tie])


def both(one: Simulated) -> tuple[Found, Found]:
    """Return what edges and channels say by themselves, and what they say with the motion."""
    base, lines = refine_ties(one.base, one.lines)
    tied, (motion,), again = tie_clocks_by_motion(one.manifest, base, [one.motion], lines)
    return found(one, base, one.motion, lines), found(one, tied, motion, again)


def bound() -> float:
    """Return the Cramér–Rao bound of the period, relative: √(24/F)·σ/(A·ω·T) of F frames in T seconds, along z.

    Rife and Boorstyn (IEEE Trans. Inf. Theory 20, 1974, 591), for one real line in white noise.
    """
    length_s = FRAMES * WHOLE / RATE_HZ
    return float(np.sqrt(24.0 / FRAMES) * NOISE[2] / (SIZE[2] * 2.0 * np.pi * LINE_HZ * length_s))


HEAD = (
    "| edges move by / samples | by | exposures: rms / µs | u / µs | rate: rms / 10⁻⁶ | u / 10⁻⁶ "
    "| output: median / µs | rms / µs | u / µs | least rms / µs "
    "| exposures within 2 u / % | rate within 2 u / % | output within 2 u / % |"
)
LEAST = (
    "| edges move by / samples | exposures by edges and rate | with phases | output | noise / 3 | noise / 10 "
    "| eight recordings of one period |"
)
WAYS = (
    (False, 1.0, 1, 0),
    (True, 1.0, 1, 0),
    (True, 1.0, 1, 1),
    (True, 1 / 3, 1, 1),
    (True, 0.1, 1, 1),
    (True, 1.0, 8, 1),
)
"""Columns of that: whether phases are compared, noise, recordings of one period, and whether of exposures or output."""


def cells(case: str, by: str, draws: list[Found], least: str) -> str:
    """Return one row: errors of all draws, the rms of what is stated, and how often twice that holds them."""
    error, u = np.array([one.errors for one in draws]).transpose(2, 1, 0)
    size, stated = (np.sqrt(np.mean(values**2, axis=1)) for values in (error, u))
    median, inside = np.median(np.abs(error), axis=1), 100.0 * np.mean(np.abs(error) <= 2.0 * u, axis=1)
    both_ends = [1e6 * values[k] for k in (0, 1) for values in (size, stated)]
    sizes = [f"{value:.3g}" for value in (*both_ends, 1e6 * median[5], 1e6 * size[5], 1e6 * stated[5])]
    return "| " + " | ".join([case, by, *sizes, least, *(f"{inside[k]:.0f}" for k in (0, 1, 5))]) + " |"


def rows(name: str, draws: int, tell: Callable[[str], None]) -> tuple[list[str], list[str]]:
    """Return both rows of a case, and one of what its edges allow for, where these are sampled."""
    rng, beside = np.random.default_rng(7), np.random.default_rng(8)
    all_drawn = [simulate(CASES[name], rng) for _ in range(draws)]
    pairs = [both(one) for one in all_drawn]
    least, told = "–", list[str]()
    if CASES[name].rises == (step, step):
        found = np.array([[least_u(one, beside, *way[:3])[way[3]] for way in WAYS] for one in all_drawn])
        least = f"{1e6 * np.sqrt(np.mean(found[:, 2] ** 2)):.3g}"
        told = ["| " + " | ".join([name, *(f"{1e6 * u:.3f}" for u in np.median(found, axis=0))]) + " |"]
    both_ways = zip(("edges", "motion"), ("–", least), zip(*pairs, strict=True), strict=True)
    lines = [cells(name, by, list(one), bound_u) for by, bound_u, one in both_ways]
    for line in lines + told:
        tell(line)
    return lines, told


def main() -> None:
    """Print the table, and write it into a page where one is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--only", default="")
    parser.add_argument("--write", type=existing_file)
    options = parser.parse_args()
    print(HEAD)
    found = [rows(name, options.draws, print) for name in CASES if options.only in name]
    table, least = ([line for lines in part for line in lines] for part in zip(*found, strict=True))
    reach = f"Cramér–Rao bound of the rate by the motion: {1e6 * bound():.3f}·10⁻⁶; {options.draws} draws of each case."
    print(reach)
    if options.write:
        tables = {"clocks": f"{markdown_table(HEAD, table)}\n\n{reach}", "least": markdown_table(LEAST, least)}
        write_marked(options.write, tables)


if __name__ == "__main__":
    main()
