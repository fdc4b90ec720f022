"""Chirps, noise and blows with cameras: coverage, agreement with sines on the same rig, and matrices of six sweeps.

    python benchmarks/nonsinusoidal.py [--draws 10] [--kinds chirp noise impact train] [--write PAGE]
        [--only coverage sines matrix]

Recordings and their truth are those of `nonsinusoidal_truth.py`, with every stated error sampled and the points of
another program in place of images. The accelerations of the load, and the output Fz per load Fz, are compared with the
closed form at ten frequencies. Sines: ten recordings of the same rig, of 4 s each, with the same sampled errors.
Matrices: campaigns in six directions, each a mounting of its own; 36 elements against the closed form.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
from coverage_statistics import Tally
from marked import existing_file, markdown_row, markdown_table, write_marked
from nonsinusoidal_rig import CAPACITY, DIRECTIONS
from nonsinusoidal_truth import SINES_HZ, Order, write

from fusion import Settings, run_path
from fusion.estimation.coverage import Polar, coverage_factor
from fusion.estimation.uncertainty import Uncertainty, polar_elements
from fusion.report.h5 import read_uncertainty
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording
from shakercal._common.arrays import ComplexArray

Matrix = tuple[float, ComplexArray, Uncertainty]
FZ, REFERENCE = 2, "velocity_1"
NAMES = {"chirp": "sweep, 20 s", "noise": "noise, 20 s", "impact": "blows, 20 s", "train": "rapid blows, 20 s"}
PARTS_OF_PAGE = ("coverage", "sines", "matrix")
PARTS = {"translations": (0, 1, 2), "rotations": (3, 4, 5)}
SWEEP, SINE = "six sweeps of 12 s", "sixty sines of 4 s"
CAMPAIGNS = ((SWEEP, "above the band", (1, 3)), (SWEEP, "within the band", (0, 2)), (SINE, "above the band", (1,)))
"""Campaigns of matrices, the place of the bending resonance, and draws."""
SOURCES, ELEMENT = {"photogrammetry": "cameras alone", "fused": "fused"}, "output Fz per load Fz"


def written(order: Order, folder: Path) -> dict[str, Any]:
    """Write a simulated recording, with the frequencies of its results, and return its truth."""
    truth = write(order, folder)
    if order.kind != "sine":
        manifest = folder / "recording.toml"
        stated = f"[excitation]\nfrequencies = {json.dumps(list(SINES_HZ))}\n"
        manifest.write_text(manifest.read_text("utf-8").replace("[excitation]\n", stated, 1), encoding="utf-8")
    return truth


def recorded(order: Order) -> tuple[Evaluation, dict[str, Any]]:
    """Return a simulated recording as evaluated, and its truth."""
    with TemporaryDirectory() as top:
        truth = written(order, Path(top) / "recording")
        return evaluate_recording(Path(top) / "recording"), truth


def closed_form(truth: dict[str, Any], name: str, evaluation: Evaluation) -> ComplexArray:
    """Return a quantity of the truth at the lines of an evaluation."""
    hertz = np.array(truth["frequencies"])
    near = np.abs(np.subtract.outer(evaluation.lines.nominal_hz, hertz)).argmin(axis=1)
    return np.asarray(np.array(truth[name]["re"])[near] + 1j * np.array(truth[name]["im"])[near])


def motion_of(evaluation: Evaluation, truth: dict[str, Any]) -> ComplexArray:
    """Return the true accelerations (K, 6) that belong to the recorded phasors of the first laser."""
    seen = next(channel for channel in evaluation.channels if channel.name == REFERENCE).phasors
    errors = truth["sampled_errors"][REFERENCE]
    chain = errors["factor"] * np.exp(-2j * np.pi * seen.frequency_hz * errors["delay_s"])
    return np.asarray(closed_form(truth, "acceleration_per_velocity", evaluation) * (seen.value / chain[:, None]))


def element_of(evaluation: Evaluation) -> tuple[ComplexArray, list[Polar | None]]:
    """Return the element Fz per Fz at the lines, and its uncertainty."""
    found = evaluation.element
    assert found is not None
    place = found.elements.index((FZ, FZ))
    return np.asarray(found.value[:, FZ, FZ]), [line[place] for line in found.polar]


def coverage(kinds: Sequence[str], draws: int) -> Iterator[str]:
    """Yield the rows of each kind of excitation."""
    for kind in kinds:
        parts = {f"{part}, {of}": Tally() for of in SOURCES.values() for part in PARTS} | {ELEMENT: Tally()}
        expanded = list[float]()
        for draw in range(draws):
            evaluation, truth = recorded(Order(kind=kind, draw=draw, poses=True))
            true_motion = motion_of(evaluation, truth)
            for found in evaluation.accelerations:
                if found.body != "load" or found.source not in SOURCES:
                    continue
                for line, stated in zip(found.phasors.value - true_motion, found.polar, strict=True):
                    for name, components in PARTS.items():
                        for c in components:
                            parts[f"{name}, {SOURCES[found.source]}"].add(complex(line[c]), stated[c])
            value, polar = element_of(evaluation)
            for one, true, stated_one in zip(
                value, closed_form(truth, "sensitivity", evaluation)[:, FZ, FZ], polar, strict=True
            ):
                parts[ELEMENT].add(complex(one - true), stated_one)
            expanded += [one.expanded_magnitude / one.magnitude for one in polar if one]
            print(kind, draw, {name: float(tally.covered.mean().round(3)) for name, tally in parts.items()}, flush=True)
        for name, tally in parts.items():
            shown = f"{100 * np.median(expanded):.2g} %" if name == ELEMENT else ""
            size = float(np.sqrt(np.mean(tally.normalised**2)))
            cells = [NAMES[kind], name, f"{len(tally.errors)}", f"{100 * tally.covered.mean():.1f} %", f"{size:.2f}"]
            yield "| " + " | ".join([*cells, shown]) + " |"


def against_sines() -> Iterator[str]:
    """Yield a row for each frequency: U of both and their difference."""
    swept, _ = recorded(Order(kind="chirp", poses=True))
    value, polar = element_of(swept)
    for k, hertz in enumerate(SINES_HZ):
        single, _ = recorded(Order(kind="sine", hertz=hertz, poses=True, duration_s=4.0))
        at = int(np.argmin(np.abs(single.lines.frequency_hz - hertz)))
        of_sine, stated = element_of(single)
        one, other = polar[k], stated[at]
        assert one is not None
        assert other is not None
        change, u = value[k] / of_sine[at] - 1.0, (one.expanded_magnitude / one.magnitude, one.expanded_phase_rad)
        cells = [
            f"{hertz:g}",
            f"{100 * u[0]:.3f} %, {1e3 * u[1]:.2f} mrad",
            f"{100 * other.expanded_magnitude / other.magnitude:.3f} %, {1e3 * other.expanded_phase_rad:.2f} mrad",
            f"{100 * change.real:+.3f} %, {1e3 * change.imag:+.2f} mrad",
            f"{abs(change.real) / u[0]:.2f}, {abs(change.imag) / u[1]:.2f}",
        ]
        print(cells, flush=True)
        yield "| " + " | ".join(cells) + " |"


def matrices_of(orders: Sequence[Order], top: Path) -> tuple[list[Matrix], dict[str, Any]]:
    """Return the matrices of a campaign in six directions in an empty folder, and the truth of a recording."""
    for number, order in enumerate(orders):
        for direction in DIRECTIONS:
            truth = written(replace(order, direction=direction), top / f"{direction}-{number}")
    run_path(top, None, Settings())
    with h5py.File(top / "results/campaign.h5") as file:
        groups = [(one["uncertainty"], one["value"][()]) for one in file["matrices"].values()]
        fits = [(float(of["frequency_hz"][0]), value, read_uncertainty(of)) for of, value in groups]
    return fits, truth


def true_matrix(hertz: float, truth: dict[str, Any]) -> ComplexArray:
    """Return the true matrix at a frequency."""
    at, parts = int(np.abs(np.array(truth["frequencies"]) - hertz).argmin()), truth["sensitivity"]
    return np.asarray(np.array(parts["re"][at]) + 1j * np.array(parts["im"][at]))


def matrix() -> Iterator[str]:
    """Yield rows of the elements for each campaign."""
    main = np.eye(6, dtype=np.bool_)
    for what, where, draws in CAMPAIGNS:
        parts = {
            "main, forces": main & (np.arange(6) < 3),
            "main, moments": main & (np.arange(6) > 2),
            "cross-talk": ~main,
        }
        tallies, shares, count = {name: Tally() for name in parts}, {name: list[float]() for name in parts}, 0
        for draw in draws:
            sweep = Order("chirp", draw, poses=True, duration_s=12.0)
            sines = [replace(sweep, kind="sine", hertz=hertz, duration_s=4.0) for hertz in SINES_HZ]
            with TemporaryDirectory() as top:
                fits, truth = matrices_of([sweep] if what == SWEEP else sines, Path(top))
            count += len(fits)
            for hertz, value, uncertainty in fits:
                true = true_matrix(hertz, truth)
                polar = polar_elements(value.reshape(1, -1), uncertainty)[0]
                rated = np.abs(np.diag(true)) * CAPACITY
                for name, mask in parts.items():
                    for i, j in np.argwhere(mask):
                        stated = polar[6 * i + j]
                        tallies[name].add(complex(value[i, j] - true[i, j]), stated)
                        expanded = coverage_factor(stated.dof) * max(stated.u_re, stated.u_im)
                        shares[name].append(expanded * CAPACITY[j] / rated[i])
            print(what, where, draw, [round(fit[0], 1) for fit in fits], flush=True)
        for name, tally in tallies.items():
            errors = np.abs(tally.normalised)
            cells = [what, where, f"{count} of {len(draws) * len(SINES_HZ)}", name, f"{len(tally.errors)}"]
            cells += [f"{100 * tally.covered.mean():.1f} %", f"{np.sqrt(np.mean(errors**2)):.2f}"]
            yield markdown_row(*cells, f"{errors.max():.1f}", f"{100 * np.median(shares[name]):.2g} %")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--kinds", nargs="+", choices=tuple(NAMES), default=tuple(NAMES))
    parser.add_argument("--only", nargs="+", choices=PARTS_OF_PAGE, default=PARTS_OF_PAGE)
    parser.add_argument("--write", type=existing_file)
    options = parser.parse_args()
    parts = {}
    if "sines" in options.only:
        head = "| f / Hz | U of the sweep | U of a sine | sweep against sine | over U of the sweep |"
        parts["against sines"] = markdown_table(head, list(against_sines()))
    if "matrix" in options.only:
        head = "| campaign | bending | matrices | elements | values | covered | errors / u (rms) | largest | median U |"
        parts["matrix"] = markdown_table(head, list(matrix()))
    if "coverage" in options.only:
        head = "| excitation | quantity | values | covered | errors / u (rms) | median U of the magnitude |"
        parts["coverage"] = markdown_table(head, list(coverage(options.kinds, options.draws)))
    for name, table in parts.items():
        print(f"\n{name}\n{table}")
    if options.write:
        write_marked(options.write, parts)


if __name__ == "__main__":
    main()
