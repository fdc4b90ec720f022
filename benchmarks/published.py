"""The published comparison: Table 1 and Figs 6 to 9 and 14 of Nitsche et al. (2018), redone on the simulated twin.

Usage: python benchmarks/published.py [--seed N] [--keep FOLDER] [--docs FOLDER]

Simulates the presets `nitsche2018` (one rendered recording) and `sweep` (48 recordings), evaluates them, and prints the
tables of docs/nitsche2018.md. With --docs the page's tables and pictures are replaced; with --keep, simulations that
are there are used again. Takes about five minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import published_figures as figures
import published_paper as paper
from marked import existing_folder, markdown_row, markdown_table, write_marked
from numpy.typing import NDArray
from published_figures import SweepPoint
from scipy.optimize import least_squares

from fusion.base import Settings
from fusion.campaign.curve import ratio_curves
from fusion.campaign.excited_line import ExcitedLine, excited_lines_of, with_starts
from fusion.estimation.coverage import Polar, polar
from fusion.estimation.uncertainty import element_covariance
from fusion.instruments.vibrometer import PointRatios
from fusion.phasors.stereo_phasors import StereoResult
from fusion.recording.load import load_manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate import simulate
from shaker.sine.phasor import derivative_factor
from shaker.sine.sine_fit import fit_sines
from shakercal._common.digits import round_to_uncertainty

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Z = 2
LINES = (0, 3)  # the fundamental and its 4th harmonic, the publication's two sines
COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
UNITS = ("m", "m", "m", "rad", "rad", "rad")
MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True)
class Twin:
    """The rendered recording: its evaluation, the truth beside it, the pair that sees the load."""

    evaluation: Evaluation
    truth: dict[str, Any]
    top: StereoResult

    @property
    def clock_rate(self) -> float:
        """True seconds in a second of the first recorder's clock, which all results count in."""
        return 1.0 + float(self.truth["drawn"]["vibrometer.clock"][0])

    def true_acceleration(self) -> ComplexArray:
        """Return the load's true acceleration along z (K,)."""
        return complex_of(self.truth["acceleration"]["load"])[:, Z]


def complex_of(entry: dict[str, Any]) -> ComplexArray:
    """Return a complex array from its real and imaginary parts."""
    return np.asarray(entry["re"]) + 1j * np.asarray(entry["im"])


def evaluated_twin(folder: Path, seed: int) -> Twin:
    """Simulate the rendered recording unless it is there, and evaluate it."""
    if not folder.exists():
        simulate(folder, "nitsche2018", seed)
    recording = folder / "Fz-0106.25"
    evaluation = evaluate_recording(load_manifest(recording), Settings(), {})
    truth = json.loads((recording / "truth.json").read_text(encoding="utf-8"))
    return Twin(evaluation, truth, next(pair for pair in evaluation.stereo if pair.body == "load"))


def source(evaluation: Evaluation, name: str, line: int) -> Polar:
    """Return the load's acceleration along z from one kind of instrument."""
    found = next(a for a in evaluation.accelerations if (a.body, a.source) == ("load", name))
    covariance = element_covariance(found.phasors.covariance[line], Z)
    return polar(complex(found.phasors.value[line, Z]), covariance, float(found.uncertainty.dof()[line, Z]))


def told(value: float, expanded: float, unit: str = "") -> str:
    """Return value ± U, rounded to two digits of U."""
    text = round_to_uncertainty(value, expanded)
    body = f"{text.value} ± {text.expanded}"
    power = f"({body})·10^{text.exponent}" if text.exponent else body
    return f"{power} {unit}".strip()


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Return a Markdown table with typographic minus signs before numbers."""
    text = markdown_table(markdown_row(*head), [markdown_row(*row) for row in rows])
    return re.sub(r"(?<![\w.)|-])-(?=\d)", MINUS, text)


def table_1(twin: Twin) -> str:
    """Return Table 1: frequencies, amplitudes and phases of two sines from the vibrometer and from the cameras."""
    alone = frequencies_alone(twin)
    rows = [row for place in range(len(LINES)) for row in _sine_rows(twin, place, alone[place])]
    mean = 1e3 * float(np.nanmean(twin.top.motion.pose[:, Z]))
    rows.append(("mean of the displacements, cameras", f"{1e3 * paper.CAMERA_MEAN_M:.4f} mm", "", f"{mean:.4f} mm"))
    return table(("quantity", "published", "twin, truth", "program, with U"), rows)


def _sine_rows(twin: Twin, place: int, alone: str) -> list[tuple[str, ...]]:
    """Return the rows of one sine: published, true, and as the program finds it."""
    line, lines = LINES[place], twin.evaluation.lines
    true, true_hz = twin.true_acceleration()[line], float(twin.truth["frequencies"][line]) * twin.clock_rate
    omega2 = (2 * np.pi * true_hz) ** 2
    laser, camera = (source(twin.evaluation, kind, line) for kind in ("vibrometer", "photogrammetry"))
    hertz = told(float(lines.frequency_hz[line]), 2 * float(lines.u_frequency_hz[line]), "Hz")
    size = told(laser.magnitude, laser.expanded_magnitude, "m/s²")
    moved = told(1e6 * camera.magnitude / omega2, 1e6 * camera.expanded_magnitude / omega2, "µm")
    seen = told(camera.magnitude, camera.expanded_magnitude, "m/s²")
    turned = [told(found.phase_rad, found.expanded_phase_rad, "rad") for found in (laser, camera)]
    stated_hz, stated_m = paper.CAMERA_HZ[place], paper.CAMERA_M[place]
    stated = f"{abs(derivative_factor(np.array([stated_hz]), 2)[0]) * stated_m:.4f} m/s²"
    rows = [
        ("frequency, vibrometer", f"{paper.VIBROMETER_HZ[place]:.4f} Hz", f"{true_hz:.7f} Hz", hertz),
        ("frequency, cameras alone", f"{stated_hz:.4f} Hz", f"{true_hz:.7f} Hz", alone),
        ("amplitude, vibrometer", f"{paper.VIBROMETER_MPS2[place]:.4f} m/s²", f"{abs(true):.4f} m/s²", size),
        ("amplitude, cameras", f"{1e6 * stated_m:.1f} µm", f"{1e6 * abs(true) / omega2:.4f} µm", moved),
        ("ω²·s, cameras", stated, f"{abs(true):.4f} m/s²", seen),
        ("phase, vibrometer", f"{paper.VIBROMETER_RAD[place]:.3f} rad", f"{np.angle(true):.4f} rad", turned[0]),
        ("phase, cameras", f"{paper.CAMERA_RAD[place]:.3f} rad", f"{np.angle(true):.4f} rad", turned[1]),
    ]
    return [(f"sine {place + 1}, {what}", *cells) for what, *cells in rows]


def frequencies_alone(twin: Twin) -> tuple[str, str]:
    """Return both frequencies, with U, as the frames tell them without any channel: free, as they were published.

    Amplitudes are solved for at every pair of frequencies; the 2nd and 3rd harmonic follow the first. What the trigger
    leaves open of its period is part of U.
    """
    pair = twin.top
    trigger = next(clock.trigger for clock in twin.evaluation.clocks if clock.trigger is not None)

    def left(frequencies: FloatArray) -> FloatArray:
        first, last = frequencies
        turn = 2 * np.pi * np.multiply.outer(pair.time_s, np.array([first, 2 * first, 3 * first, last]))
        columns = np.column_stack([np.cos(turn), np.sin(turn), np.ones(len(turn))])
        seen = 1e6 * pair.motion_from_mean.pose[:, Z]
        return np.asarray(seen - columns @ np.linalg.lstsq(columns, seen, rcond=None)[0])

    found = least_squares(left, (106.25, 425.0), x_scale=(1e-5, 1e-3), diff_step=1e-9, xtol=1e-14, ftol=1e-14)
    noise = 2 * found.cost / (len(pair.time_s) - 11)
    dated = found.x * np.sqrt(trigger.covariance[1, 1]) / trigger.period_s
    expanded = 2 * np.hypot(np.sqrt(noise * np.diagonal(np.linalg.inv(found.jac.T @ found.jac))), dated)
    return told(found.x[0], expanded[0], "Hz"), told(found.x[1], expanded[1], "Hz")


def agreement(twin: Twin) -> str:
    """Return how the cameras agree with the vibrometer, and what sines leave of the displacement."""
    laser, camera = (source(twin.evaluation, kind, 0) for kind in ("vibrometer", "photogrammetry"))
    fused, truth = source(twin.evaluation, "fused", 0), abs(twin.true_acceleration()[0])
    apart = 100 * (camera.magnitude / laser.magnitude - 1)
    expanded = 100 * float(np.hypot(camera.expanded_magnitude, laser.expanded_magnitude)) / laser.magnitude
    rows = [("cameras to vibrometer", "0.68 %", told(apart, expanded, "%"))]
    for name, found in (("cameras", camera), ("all instruments fused", fused)):
        off = told(100 * (found.magnitude / truth - 1), 100 * found.expanded_magnitude / truth, "%")
        rows.append((f"{name}, to the truth", "", off))
    rows += [
        (f"residual of z after {name}", was, f"{1e6 * residual(twin.top, lines):.3f} µm") for name, was, lines in SINES
    ]
    return table(("quantity", "published", "program, with U"), rows)


SINES = (
    ("one sine, 106.25 Hz", "3.6 µm", (0,)),
    ("two sines, 106.25 and 425 Hz", "2.3 µm", LINES),
    ("all four sines", "no better", (0, 1, 2, 3)),
)


def residual(pair: StereoResult, lines: tuple[int, ...]) -> float:
    """Return the standard deviation (m) of what some of the sines leave of the displacement along z."""
    frequency = pair.fit.phasors.frequency_hz[list(lines)]
    fit = fit_sines(pair.time_s, pair.motion_from_mean.pose, frequency, COMPONENTS, UNITS)
    return float(np.std(fit.residual_of(pair.time_s, pair.motion_from_mean.pose)[:, Z], ddof=2 * len(lines) + 1))


def evaluated_sweep(folder: Path, seed: int) -> tuple[list[SweepPoint], float]:
    """Simulate the sweep unless it is there and evaluate it: one point per frequency, and the static sensitivity."""
    if not folder.exists():
        simulate(folder, "sweep", seed)
    drives: list[ExcitedLine] = []
    ratios: dict[float, tuple[PointRatios, complex]] = {}
    static = 0.0
    for truth_file in sorted(folder.glob("*/truth.json")):
        evaluation = evaluate_recording(load_manifest(truth_file.parent), Settings(), {})
        truth = json.loads(truth_file.read_text(encoding="utf-8"))
        drives += excited_lines_of(evaluation)
        own = next(spread.ratios for spread in evaluation.points if spread.ratios is not None)
        ratios.setdefault(round(truth["frequencies"][0], 1), (own, complex(complex_of(truth["sensitivity"])[0, Z, Z])))
        sensor = evaluation.manifest.rig.sensor
        static = 0.0 if sensor is None or sensor.static_sensitivity is None else sensor.static_sensitivity[Z][Z]
    (curve,) = ratio_curves(with_starts(drives))
    element = curve.elements.index((curve.channels.index("Fz"), Z))
    covariance, dof = curve.uncertainty.covariance, curve.uncertainty.dof()
    points = []
    for line, frequency in enumerate(curve.frequency_hz):
        fused = polar(
            complex(curve.value[line, element]),
            element_covariance(covariance[line], element),
            float(dof[line, element]),
        )
        points.append(_sweep_point(float(frequency), fused, *ratios[round(float(frequency), 1)]))
    return points, float(static)


def _sweep_point(frequency_hz: float, fused: Polar, ratios: PointRatios, true: complex) -> SweepPoint:
    """Return one frequency: the points of its first recording at the driven line, all recordings fused."""
    return SweepPoint(
        frequency_hz=frequency_hz,
        mean=float(ratios.mean_magnitude[0]),
        spread=float(ratios.magnitude_spread[0]),
        phase_rad=float(ratios.mean_phase_rad[0]),
        phase_spread_rad=float(ratios.phase_spread_rad[0]),
        fused=complex(fused.re, fused.im),
        expanded=fused.expanded_magnitude,
        expanded_phase_rad=fused.expanded_phase_rad,
        true=true,
    )


def figure_14(points: list[SweepPoint], static: float) -> str:
    """Return the numbers of Fig. 14: eight points as published, fused with U, the truth."""
    rows = [
        (
            f"{p.frequency_hz:.1f}",
            f"{1e7 * p.mean:.4f}",
            f"{100 * p.spread / p.mean:.2f}",
            f"{p.phase_rad:.4f}",
            f"{1e3 * p.phase_spread_rad:.1f}",
            told(1e7 * abs(p.fused), 1e7 * p.expanded),
            told(float(np.angle(p.fused)), p.expanded_phase_rad),
            f"{1e7 * abs(p.true):.4f}",
            f"{np.angle(p.true):.4f}",
            f"{100 * abs(p.fused) / static:.2f}",
        )
        for p in points
    ]
    head = (
        *("f / Hz", "eight points: mean / 10⁻⁷", "std. dev. / %", "phase / rad", "std. dev. / mrad"),
        *("fused, with U / 10⁻⁷", "phase, with U / rad", "truth / 10⁻⁷", "truth / rad", "fused / static / %"),
    )
    return table(head, rows)


def write_page(docs: Path, tables: dict[str, str], pictures: dict[str, bytes]) -> None:
    """Replace the tables between their marks in nitsche2018.md, and the pictures."""
    write_marked(docs / "nitsche2018.md", tables)
    for name, picture in pictures.items():
        (docs / "images" / f"nitsche2018-{name}.png").write_bytes(picture)


def main() -> None:
    """Simulate, evaluate, print, and write where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for the simulations, kept and used again")
    parser.add_argument(
        "--docs", type=existing_folder, help="folder of nitsche2018.md, whose tables and pictures are replaced"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        keep = options.keep or Path(scratch)
        twin = evaluated_twin(keep / f"seed-{options.seed}", options.seed)
        points, static = evaluated_sweep(keep / f"sweep-{options.seed}", options.seed)
        pictures = {
            "fig06": figures.draw_trigger(twin.evaluation),
            "fig07": figures.draw_spectrum(twin.evaluation),
            "fig08": figures.draw_displacement(twin.top),
            "fig09": figures.draw_axis(twin.top),
            "fig14": figures.draw_sweep(points, static),
        }
    tables = {
        "table 1": table_1(twin),
        "agreement": agreement(twin),
        "figure 14": figure_14(points, static),
    }
    print("\n\n".join(f"{name}\n\n{content}" for name, content in tables.items()))
    if options.docs is not None:
        write_page(options.docs, tables, pictures)


if __name__ == "__main__":
    main()
