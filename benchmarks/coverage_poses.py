"""What campaigns know of poses and scales, whether U after that still covers, and what it gains.

    python benchmarks/coverage_poses.py [--trials 100] [--seed 1] [--write]

The eight recordings of the preset `matrix` at 80, 170 and 310 Hz after the phasors, seen by nine laser beams, a
triaxial accelerometer and, with a pose, a stereo pair: loads (those across the drive by themselves) and 6 x 6 matrix at
the first line, by what each recording says of its unknowns and by what all say together. Every error is drawn as the
rig states it: those of the rig once for a campaign, those of a mounting for each. `--write` puts the table into
docs/campaigns.md. Some ten minutes on one core.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from coverage_matrix import MAIN, Tallies, uniaxial_setup, uniaxial_truth
from coverage_statistics import Tally
from marked import markdown_table, write_marked
from numpy.typing import NDArray
from scipy.stats import binom
from simulated_phasors import Pair, PhasorSetup, simulate_phasors

from fusion.campaign.excited_line import Knowledge, excited_lines
from fusion.campaign.matrix import fit_matrix
from fusion.campaign.recording_results import RecordingResults
from fusion.campaign.unknowns import JointUnknown, apply_joint_estimate
from fusion.estimation.fuse import fuse
from fusion.estimation.uncertainty import polar_elements
from fusion.instruments.stereo import StereoReading
from fusion.recording.rig import Stereo
from fusion.report.folder import Provenance
from fusion.sensitivity.load_phasors import load_phasors
from fusion.simulate.sines import runs
from fusion.simulate.world import Draws
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors

ComplexArray = NDArray[np.complex128]
PAGE = Path(__file__).parent.parent / "docs" / "campaigns.md"
RUNS = tuple(runs("matrix"))
OF_RIG = ("pose", "scale", "delay", "response magnitude", "response phase", "individual scale", "mass", "inertia")
CASES: tuple[tuple[str, float | None, bool], ...] = (
    ("lasers, accelerometer", None, True),
    ("the same, only loads moved", None, False),
    ("with a pair, pose 0.5 mrad", 5e-4, True),
    ("with a pair, pose 5 mrad", 5e-3, True),
    ("with a pair, pose 5 mrad, only loads moved", 5e-3, False),
)
"""What stands on the rig, the u of the pair's rotation, and whether every recording was mounted anew."""
HEAD = (
    "| instruments | U after / before: loads across | cross elements | loads covered after | elements covered after "
    "| smallest u / u stated |"
)


@dataclass(frozen=True)
class Named(Draws):
    """Errors by name: what is the rig's once, noise for each recording, the rest for each mounting."""

    def stream(self, name: str) -> np.random.Generator:
        """Return the generator of a name."""
        what = name.rpartition(": ")[2]
        own = "" if what in OF_RIG or name == "clock rate" else self.recording if what == "noise" else self.mounting
        return np.random.default_rng([self.seed, zlib.crc32(f"{name} [{own}]".encode())])


def stereo_pair(setup: PhasorSetup, rotation: float) -> Pair:
    """Return a stereo pair that sees the load, its frame turned by `rotation` (rad) about each axis."""
    entry = Stereo.model_validate(
        {
            "body": "load", "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.3], "exposure": 4e-5,
            "scale_uncertainty": 1e-3, "pose_uncertainty": [2e-4] * 3 + [rotation] * 3, "delay_uncertainty": 1e-6,
        }
    )  # fmt: skip
    hertz = setup.lines.frequency_hz
    displacement = -setup.acceleration / (2.0 * np.pi * hertz[:, None]) ** 2
    spread = np.diag(np.tile([8e-9, 8e-9, 2.5e-8, 3e-7, 3e-7, 1.2e-7], 2) ** 2)
    covariance = np.repeat(spread[None], len(hertz), axis=0)
    dof = np.full(len(hertz), 40.0)
    phasors = Phasors(hertz, displacement, covariance, MOTION_COMPONENTS, component_units(0), dof)
    return Pair(StereoReading("top", entry, phasors, {}, 0.0), 40.0)


def recorded(
    place: int, rotation: float | None, draws: Named, change: Callable[[PhasorSetup], PhasorSetup] = lambda setup: setup
) -> tuple[RecordingResults, ComplexArray, ComplexArray]:
    """Return one recording as a campaign reads it, its true loads (K, 6) and the true matrix (K, 6, 6).

    `change`: of the set-up before it is simulated.
    """
    run = RUNS[place]
    driven = run.driven
    setup = uniaxial_setup(run, driven, {})
    if rotation is not None:
        setup = replace(setup, pairs=(stereo_pair(setup, rotation),))
    matrix = uniaxial_truth(run, np.random.default_rng([18, draws.seed]))
    inputs, truth = simulate_phasors(change(replace(setup, sensitivity=matrix)), draws)
    assert inputs.body is not None
    assert inputs.outputs is not None
    fused = fuse(inputs.observations)
    load = load_phasors(fused, inputs.body)
    name, mounting = str(draws.recording), str(draws.mounting)
    driving = setup.direction, inputs.lines.nominal_hz, np.ones(len(inputs.lines.frequency_hz), np.int64)
    drives = excited_lines(name, mounting, *driving, load, inputs.outputs)[:1]
    known = None
    if fused.posterior is not None and fused.products is not None:
        estimate = np.array([unknown.estimate for unknown in fused.unknowns])
        known = Knowledge.of(fused.uncertainty.influences, load.both or (), estimate, fused.posterior, fused.products)
    entry = RecordingResults(name, name, mounting, "", "sine", (), (), None, drives, (), Provenance({}, {}, {}, ()))
    return replace(entry, knowledge=None if known is None else partial(_given, known)), truth.load, matrix


def _given(known: Knowledge) -> Knowledge:
    return known


class Side:
    """Errors of loads and of matrices, by one way to estimate them."""

    def __init__(self) -> None:
        self.across, self.loads, self.elements = Tally(), Tally(), Tallies()

    def add(self, entries: Sequence[RecordingResults], loads: Sequence[ComplexArray], matrix: ComplexArray) -> None:
        """Take in one campaign: true loads (K, 6) of every recording and the true matrix (6, 6)."""
        for entry, true, run in zip(entries, loads, RUNS, strict=True):
            for drive in entry.excited_lines:
                stated = polar_elements(drive.load[None], drive.load_uncertainty)[0]
                for j, one in enumerate(stated):
                    own = [self.loads, *([self.across] if j < 3 and j != run.driven else [])]
                    for tally in own:
                        tally.add(complex(drive.load[j] - true[0, j]), one)
        fit = fit_matrix([drive for entry in entries for drive in entry.excited_lines], LOAD_COMPONENTS)
        self.elements.add(fit.value, matrix, fit.uncertainty)


def _size(tallies: Sequence[Tally]) -> NDArray[np.float64]:
    """Standard uncertainties of all values."""
    return np.concatenate([np.linalg.norm(tally.u, axis=1) for tally in tallies])


def _covered(tallies: Sequence[Tally]) -> str:
    return f"{100.0 * float(np.concatenate([tally.covered for tally in tallies]).mean()):.1f} %"


def case_row(name: str, rotation: float | None, anew: bool, seeds: range) -> tuple[str, int]:
    """Return the row of one case, and how many campaigns were reported as contradictory."""
    before, after, least, contradictory = Side(), Side(), list[JointUnknown](), 0
    for seed in seeds:
        found = []
        for place in range(len(RUNS)):
            draws = Named(seed, True, mounting=str(place) if anew else "1", recording=str(place))
            found.append(recorded(place, rotation, draws))
        entries = [entry for entry, _, _ in found]
        carried, unknowns, _ = apply_joint_estimate("c", entries, lambda drive: drive)
        contradictory += not unknowns
        least += [unknown for unknown in unknowns if rotation is None or "rotation" in unknown.name]
        for side, own in ((before, entries), (after, carried)):
            side.add(own, [load for _, load, _ in found], found[0][2][0])
    pairs = [
        ([before.across], [after.across]), (before.elements.chosen(~MAIN), after.elements.chosen(~MAIN)),
    ]  # fmt: skip
    cells = [f"{np.median(_size(new) / _size(old)):.2f}" for old, new in pairs]
    best = min(least, key=lambda unknown: unknown.remaining, default=None)
    cells += [_covered([after.loads]), _covered(after.elements.elements)]
    cells += ["–" if best is None else f"{best.remaining:.2f} ({best.name})"]
    return "| " + " | ".join([name, *cells]) + " |", contradictory


def main(arguments: Sequence[str] = ()) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args(arguments)
    rows, contradictory = list[str](), 0
    for case in CASES:
        row, count = case_row(*case, range(options.seed, options.seed + options.trials))
        rows, contradictory = [*rows, row], contradictory + count
        print(row, flush=True)
    low, high = (100.0 * binom.ppf(p, options.trials, 0.95) / options.trials for p in (0.025, 0.975))
    text = markdown_table(HEAD, rows)
    text += f"\n\n{options.trials} campaigns each, {contradictory} reported as contradictory; "
    text += f"a single element is covered in {low:.0f} to {high:.0f} % if U is correct."
    print(text)
    if options.write:
        write_marked(PAGE, {"poses": text})


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
