"""Many lines in one recording: coverage, and U against recordings of one line each.

    python benchmarks/many_lines.py [--draws 27] [--fits 400] [--only fits recordings] [--write PAGE]

Recordings: the preset `multisine` with every stated error drawn, evaluated by `evaluate_recording`, against the true
sensitivity; in addition recordings of one line with the same rig, of the same length or a fortieth of it, with the peak
or with the amplitude of the multisine's line. Fits: known phasors and white noise, sampled by a slow camera: 40 lines
in few frames, and two of them with aliases closer than the resolution.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from coverage_statistics import Tally
from marked import existing_file, markdown_table, write_marked

from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate.multisine import BAND_HZ, LINES, PEAK_MPS2, many_lines, rocking_motion
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import TRIGGER_JITTER_S, Run, driven, multisine_run, write_run
from fusion.simulate.violations import violations
from fusion.simulate.world import Draws, make_world
from shaker.lines.multisine import place_lines
from shaker.sine.aliasing import usable_lines
from shaker.sine.sine_fit import fit_sines
from shakercal._common.arrays import FloatArray

FZ = 2
RATE_HZ = 52.874
SINGLES = (0, 13, 26, 39)
"""Lines that are recorded alone, too."""
FRAMES = (640, 200, 128, 98)
DISTANCES = (2.0, 1.0, 0.7, 0.5, 0.4, 0.3, 0.1)
"""Of two aliases, in bins."""
FIT_HEADS = "covered | errors / u (rms) | u over that of one line"
NOISE = 1e-3  # of the amplitude of a line, per frame


@dataclass
class Recorded:
    """U of magnitude (relative) and phase, u of the cameras alone, and errors, of recordings."""

    expanded: list[list[tuple[float, float]]] = field(default_factory=list)
    camera: list[FloatArray] = field(default_factory=list)
    sensitivity: Tally = field(default_factory=Tally)
    motion: Tally = field(default_factory=Tally)

    def add(self, run: Run, seed: int) -> None:
        """Simulate and evaluate a recording."""
        with TemporaryDirectory() as folder:
            draws = Draws(seed, True, violations=violations((), run.preset))
            world = make_world(run.preset, draws, TRIGGER_JITTER_S)
            evaluation = evaluate_recording(write_run(Path(folder), run, world, draws))
        true, found = world.sensitivity[:, FZ, FZ], evaluation.element
        if found is None or len(found.frequency_hz) != len(true):
            raise ValueError(f"lines: expected {len(true)} elements of the sensitivity, found {found}")
        place = found.elements.index((FZ, FZ))
        elements = [line[place] for line in found.polar]
        for value, truth, one in zip(found.value[:, FZ, FZ], true, elements, strict=True):
            self.sensitivity.add(complex(value - truth), one)
        self.expanded.append([(e.expanded_magnitude / e.magnitude, e.expanded_phase_rad) for e in elements if e])
        seen = next(a for a in evaluation.accelerations if (a.body, a.source) == ("load", "photogrammetry"))
        moved = world.motion["load"].acceleration[:, FZ]
        points = [line[FZ] for line in seen.polar]
        for value, truth, one in zip(seen.phasors.value[:, FZ], moved, points, strict=True):
            self.motion.add(complex(value - truth), one)
        self.camera.append(np.array([one.u_magnitude if one else np.nan for one in points]) / np.abs(moved))


def single_run(many: Run, line: int, frames: int, amplitude: float) -> Run:
    """Return a recording of one line of the multisine alone."""
    preset = replace(many.preset, frames=frames)
    frequency_hz = float(many.preset.frequencies_hz[line])
    motion = rocking_motion(np.array([frequency_hz]), np.array([amplitude + 0j]))
    alone = driven(preset, f"single-{line}", frequency_hz, motion, (1,))
    return Run(f"one line, {frequency_hz:.1f} Hz", alone, (many.nominal_hz[line],))


def recordings(draws: int, seed: int) -> Iterator[tuple[str, str]]:
    """Yield the tables of recordings with their names."""
    preset = read_preset(Preset, "multisine")
    many = multisine_run(preset)
    amplitude = float(np.abs(many_lines(preset.camera_rate_hz, preset.frames)[1][0, 2]))
    whole = Recorded()
    whole.add(many, seed)
    heads = "same length and amplitude | same length and peak | same total time and peak"
    table = []
    for line in SINGLES:
        u, phase = whole.expanded[0][line]
        camera = float(whole.camera[0][line])
        cells = [f"{many.nominal_hz[line]:.1f}", f"{100 * u:.3f} %, {1e3 * phase:.2f} mrad; {100 * camera:.2g} %"]
        frames = preset.frames
        for size, count in ((amplitude, frames), (PEAK_MPS2, frames), (PEAK_MPS2, frames // LINES)):
            alone = Recorded()
            alone.add(single_run(many, line, count, size), seed)
            ((u_alone, phase_alone),) = alone.expanded[0]
            cells.append(f"{u / u_alone:.2f}, {phase / phase_alone:.2f}; {camera / alone.camera[0][0]:.2f}")
        table.append("| " + " | ".join(cells) + " |")
    yield (
        "single lines",
        markdown_table(f"| line / Hz | 40 lines: U; u of the cameras alone | over one line: {heads} |", table),
    )
    for number in range(seed + 1, seed + draws):
        whole.add(many, number)
        print(f"draw {number}: {[t.covered.mean().round(4) for t in (whole.sensitivity, whole.motion)]}", flush=True)
    table = []
    for name, tally in (("sensitivity Fz", whole.sensitivity), ("acceleration z, cameras alone", whole.motion)):
        errors = tally.normalised
        table.append(
            f"| {name} | {LINES} × {draws} | {100 * tally.covered.mean():.1f} % | {np.sqrt(np.mean(errors**2)):.2f} | "
            f"{np.abs(errors).max():.1f} |"
        )
    head = (
        "| quantity | lines × draws | covered | errors / u (rms) | largest error / u | U / half-width of the errors |"
    )
    yield "coverage", markdown_table(head, table)


def fitted(frequency_hz: FloatArray, frames: int, fits: int, seed: int, look: slice) -> tuple[float, float, float]:
    """Return coverage, u over that of one line, and errors over u."""
    rng = np.random.default_rng([seed, frames])
    time_s = np.arange(frames) / RATE_HZ
    covered, errors, sizes = [], [], []
    for _ in range(fits):
        true = np.exp(2j * np.pi * rng.uniform(size=len(frequency_hz)))
        values = (np.exp(2j * np.pi * np.multiply.outer(time_s, frequency_hz)) @ true).real
        values += NOISE * rng.standard_normal(frames)
        phasors = fit_sines(time_s, values[:, None], frequency_hz, ["z"], ["1"]).phasors
        error = (phasors.value[:, 0] - true)[look]
        parts = np.stack([error.real, error.imag], axis=1)
        covariance, dof = phasors.covariance[look], phasors.dof[look]
        squares = np.einsum("ki,ki->k", parts, np.linalg.solve(covariance, parts[..., None])[..., 0])
        covered += list(_chance(squares, dof) <= 0.95)
        u = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2.0)
        errors += list(np.sqrt(np.sum(parts**2, axis=1) / 2.0) / u)
        sizes += list(u / (NOISE * np.sqrt(2.0 / frames)))
    return float(np.mean(covered)), float(np.mean(sizes)), float(np.sqrt(np.mean(np.square(errors))))


def _chance(squares: FloatArray, dof: FloatArray) -> FloatArray:
    """Return the probability of a smaller error in the plane: Hotelling's T² with estimated noise."""
    from scipy.stats import f

    return np.asarray(f.cdf(squares * (dof - 1.0) / (2.0 * dof), 2, dof - 1.0))


def fit_tables(fits: int, seed: int) -> Iterator[tuple[str, str]]:
    """Yield the tables of fits with their names."""
    table = []
    target = np.geomspace(*BAND_HZ, LINES)
    for frames in FRAMES:
        grid = place_lines(target, RATE_HZ, frames)
        covered, size, errors = fitted(grid.frequency_hz, grid.frames, max(fits // 10, 10), seed, slice(None))
        table.append(f"| {grid.frames} | {2 * LINES + 1} | {100 * covered:.1f} % | {errors:.2f} | {size:.2f} |")
    yield "few frames", markdown_table(f"| frames | unknowns | {FIT_HEADS} |", table)
    table = []
    frames = FRAMES[0]
    grid = place_lines(target, RATE_HZ, frames)
    for distance in DISTANCES:
        frequency_hz = grid.frequency_hz.copy()
        alias_hz = grid.spacing_hz * grid.alias_numbers[0] + distance * RATE_HZ / grid.frames
        turns = np.floor(frequency_hz[20] / RATE_HZ)
        frequency_hz[20] = turns * RATE_HZ + alias_hz  # now seen next to the first line
        order = np.concatenate([[0, 20], np.delete(np.arange(LINES), [0, 20])])
        usable, _ = usable_lines(np.arange(grid.frames) / RATE_HZ, frequency_hz[order])
        if not usable.all():
            table.append(f"| {distance:g} | one line dropped and named | | | |")
            continue
        covered, size, errors = fitted(frequency_hz[order], grid.frames, fits, seed, slice(0, 2))
        table.append(f"| {distance:g} | both lines | {100 * covered:.1f} % | {errors:.2f} | {size:.2f} |")
    yield "close aliases", markdown_table(f"| distance of aliases / bins | result of a run | {FIT_HEADS} |", table)


def main(draws: int, fits: int, seed: int, only: list[str], page: Path | None) -> None:
    """Print the tables, and write them into a page."""
    made = [fit_tables(fits, seed)] if "fits" in only else []
    made += [recordings(draws, seed)] if "recordings" in only else []
    for name, table in chain.from_iterable(made):
        print(f"{name}\n\n{table}\n", flush=True)
        if page is not None:
            write_marked(page, {name: table})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=27)
    parser.add_argument("--fits", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=["fits", "recordings"], choices=["fits", "recordings"])
    parser.add_argument("--write", type=existing_file, metavar="PAGE", help="replace the tables in a page")
    options = parser.parse_args()
    main(options.draws, options.fits, options.seed, options.only, options.write)
