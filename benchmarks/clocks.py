"""Clocks whose edges fall nearly on the same places between samples: what edges leave open, and what the motion tells.

    python benchmarks/clocks.py [--draws 200] [--only NAME] [--write docs/clocks.md]

A camera of 96 frames sees a line of 106.25 Hz that a laser sees, too; its trigger is recorded by the laser's block and
by a bridge's block, each on a clock of its own. Frames come every 500 samples and a little more or less, which moves
the edges by so much of a sample over the record. Every draw has other starts, clocks, noise; from edges, samples and
poses on it is the program's own path. Truth is what was drawn.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from marked import markdown_table, write_marked
from numpy.typing import NDArray
from signals_clock import Rise, charging, ideal, ramp, sampled, step

from fusion.phasors.channels import line_clock, refine_ties
from fusion.phasors.clocks import tied_by_motion
from fusion.phasors.stereo_motion import StereoMotion
from fusion.phasors.stereo_phasors import stereo_phasors
from fusion.phasors.timing import TimeBase, see
from fusion.recording.files import DaqRecord
from fusion.recording.manifest import ChannelEntry
from fusion.recording.rig import Stereo
from photogram.motion import Deformation, RigidMotion
from shaker.io.channel import RawChannel
from shaker.lines.frequencies import Lines
from shaker.sine.fit import fit_sines
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
    of their triggers on the bridge's clock, and phasors (6,) of the motion there."""

    manifest: Any
    base: TimeBase
    motion: StereoMotion
    lines: Lines
    middle_s: FloatArray
    bridge_s: FloatArray
    first_s: FloatArray
    truth: NDArray[np.complex128]


def _trigger(rise: Rise, instants: FloatArray, rate_hz: float, rng: np.random.Generator) -> TriggerFit:
    length = int((instants[-1] + 0.1) * rate_hz)
    signal = sampled(rise, instants, rate_hz, length / rate_hz, 0.002 * rng.normal(size=length))
    return fit_trigger(find_edges(signal, rate_hz, threshold=0.5))


def _record(name: str, time_s: FloatArray, rate_hz: float, rng: np.random.Generator) -> DaqRecord:
    """Return a block with one channel that sees the line at these true times."""
    entry = ChannelEntry.model_validate(
        {"name": f"velocity {name}", "quantity": "velocity", "body": "load", "point": [0, 0, 0], "direction": [0, 0, 1]}
    )
    value = np.cos(2.0 * np.pi * LINE_HZ * time_s + 0.3) + LASER_NOISE * rng.normal(size=len(time_s))
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
    records = (
        _record("vibrometer", own[0], rates[0], rng),
        _record("bridge", own[1] / (1.0 + ppm) + begin, rates[1], rng),
    )
    triggers = {("vibrometer", "camera"): fits[0], ("bridge", "camera"): fits[1]}
    base = TimeBase(records, triggers, {"vibrometer": None, "bridge": tie_clocks(fits[0], fits[1], 0)})
    free = fit_sines(own[0], records[0].stacked(records[0].entry.channel), np.array([LINE_HZ]), ["v"], ["m/s"],
                     model=SineModel(free=(0,)))  # fmt: skip
    one = np.ones(1, dtype=np.int64)
    lines = Lines(free.phasors.frequency_hz, free.u_frequency_hz, np.array([LINE_HZ]), one, ("",), ())
    truth = SIZE * np.exp(2j * np.pi * rng.uniform(size=6))
    middle = instants + EXPOSURE_S / 2.0
    turn = np.exp(2j * np.pi * LINE_HZ * middle)[:, None] * np.sinc(LINE_HZ * EXPOSURE_S)
    poses = (turn * truth).real + NOISE * rng.normal(size=(FRAMES, 6))
    entry = SimpleNamespace(
        stereo="top", trigger="camera", first_edge=0, exposure=EXPOSURE_S, delay=0.0, delay_uncertainty=0.0
    )
    pair = Stereo.model_validate(
        {"body": "load", "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.3], "exposure": EXPOSURE_S}
    )
    rig = SimpleNamespace(stereo={"top": pair})
    manifest: Any = SimpleNamespace(rig=rig, path=Path("recording.toml"), images=(), points=(entry,))
    nothing, eye = np.zeros((FRAMES, 1, 3)), np.tile(np.eye(6), (FRAMES, 1, 1))
    motion = RigidMotion(poses - poses[0], eye, np.zeros(FRAMES), np.ones(FRAMES, dtype=np.int64), np.zeros(3))
    beside = Deformation(nothing[0], nothing, np.zeros((FRAMES, 1, 3, 3)))
    sight: Any = entry
    seen = StereoMotion(see(manifest, base, sight, FRAMES), motion, (beside,), 0.0, None, ())
    return Simulated(manifest, base, seen, lines, middle, bridge, instants, truth)


@dataclass(frozen=True)
class Found:
    """Errors and their standard uncertainties (5, 2): exposures in the middle (s) and their rate, the phase along z
    (rad), the tie in the middle (s), exposures as the bridge's clock has them; `told`: whether a period is said to
    contradict its edges."""

    errors: FloatArray
    told: bool


def found(one: Simulated, base: TimeBase, motion: StereoMotion, lines: Lines) -> Found:
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
        (float(np.angle(value / one.truth[2])), u_phase),
        (float(tie.to_base_s(np.array(there))) - here, float(np.linalg.norm(list(behind.values())))),
        (float(np.mean(late)) - float(tie.to_base_s(np.array(there))) + here, float(np.linalg.norm(apart))),
    )
    told = any("its period is" in n.text for fit in base.triggers.values() for n in fit.notices)
    return Found(np.array(pairs), told)


def both(one: Simulated) -> tuple[Found, Found]:
    """Return what edges and channels say by themselves, and what they say with the motion."""
    base, lines = refine_ties(one.base, one.lines)
    tied, (motion,), again = tied_by_motion(one.manifest, base, [one.motion], lines)
    return found(one, base, one.motion, lines), found(one, tied, motion, again)


def bound() -> float:
    """Return the Cramér–Rao bound of the period, relative: √(24/F)·σ/(A·ω·T) of F frames in T seconds, along z.

    Rife and Boorstyn (IEEE Trans. Inf. Theory 20, 1974, 591), for one real line in white noise.
    """
    length_s = FRAMES * WHOLE / RATE_HZ
    return float(np.sqrt(24.0 / FRAMES) * NOISE[2] / (SIZE[2] * 2.0 * np.pi * LINE_HZ * length_s))


HEAD = (
    "| edges move by, in samples | by | exposures: median, rms, u / µs | rate: rms, u / 10⁻⁶ "
    "| tie: median, rms, u / µs | camera to bridge: rms, u / µs | phase: rms, u / mrad "
    "| within 2 u: exposures, rate, tie, camera to bridge, phase | told |"
)


def cells(case: str, by: str, draws: list[Found]) -> str:
    """Return one row: errors of all draws, the rms of what is stated, and how often twice that holds them."""
    error, u = np.array([one.errors for one in draws]).transpose(2, 1, 0)
    size, stated = (np.sqrt(np.mean(values**2, axis=1)) for values in (error, u))
    median, inside = np.median(np.abs(error), axis=1), 100.0 * np.mean(np.abs(error) <= 2.0 * u, axis=1)
    micro = [f"{1e6 * median[k]:.3f}, {1e6 * size[k]:.3f}, {1e6 * stated[k]:.3f}" for k in (0, 3)]
    columns = (
        case, by, micro[0], f"{1e6 * size[1]:.3f}, {1e6 * stated[1]:.3f}", micro[1],
        f"{1e6 * size[4]:.3f}, {1e6 * stated[4]:.3f}", f"{1e3 * size[2]:.3f}, {1e3 * stated[2]:.3f}",
        ", ".join(f"{inside[k]:.0f}" for k in (0, 1, 3, 4, 2)) + " %",
        f"{sum(one.told for one in draws)}",
    )  # fmt: skip
    return "| " + " | ".join(columns) + " |"


def rows(name: str, draws: int, tell: Callable[[str], None]) -> list[str]:
    """Return both rows of a case."""
    rng = np.random.default_rng(7)
    pairs = [both(simulate(CASES[name], rng)) for _ in range(draws)]
    lines = [cells(name, by, list(one)) for by, one in zip(("edges", "motion"), zip(*pairs, strict=True), strict=True)]
    for line in lines:
        tell(line)
    return lines


def main() -> None:
    """Print the table, and write it into a page where one is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--only", default="")
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    print(HEAD)
    table = [line for name in CASES if options.only in name for line in rows(name, options.draws, print)]
    reach = f"Cramér–Rao bound of the rate by the motion: {1e6 * bound():.3f}·10⁻⁶; {options.draws} draws of each case."
    print(reach)
    if options.write:
        write_marked(options.write, {"clocks": f"{markdown_table(HEAD, table)}\n\n{reach}"})


if __name__ == "__main__":
    main()
