"""The published set-up, simulated and evaluated: errors against the truth, stated uncertainty, scatter over the bound.

Usage: python benchmarks/nitsche2018.py [--seeds 1 2 3 4 5] [--keep FOLDER]

Prints one row per seed, which docs/performance.md summarises. Rendering one seed takes about two minutes and evaluating
it about one on two cores; with --keep, recordings that are already there are used again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.base import Settings
from fusion.recording.load import find_recordings, load_manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate import simulate
from fusion.simulate.world import frame_bounds
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import fit_sines

FloatArray = NDArray[np.float64]
DRIVEN = 2  # z
PRESET = "nitsche2018"
FUNDAMENTAL_HZ = 106.25
HARMONIC = 4
ABSENT = (5, 6, 7, 8, 9, 10)  # multiples of the fundamental that the body does not perform
COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
UNITS = ("m", "m", "m", "rad", "rad", "rad")
HEADS = (
    *("seed", "amplitude", "phase", "stated u", "sensitivity", "worst of 24 / u"),
    *("top", "base", "425 Hz", "false lines", "evaluation s"),
)
CHI2_95, CHI2_99 = 5.991464547107979, 9.21034037197618  # quantiles of χ² with two degrees of freedom


@dataclass(frozen=True)
class Figures:
    """What one seed gave.

    `normalised` (24,): errors of Re and Im of the six components of load and base at the fundamental, photogrammetry
    alone, over their standard uncertainty. `scatter`: per stereo pair, six components' scatter over the bound.
    `harmonic_error`, `harmonic_covered`: relative error of the 4th harmonic along z, photogrammetry alone, and whether
    its 95 % region holds the truth. `false_lines` (2,): tests of lines that are not there, at 1 %, and how many failed.
    """

    seed: int
    amplitude_error: float
    phase_error_rad: float
    u_relative: float
    sensitivity_error: float
    normalised: FloatArray
    scatter: dict[str, FloatArray]
    harmonic_error: float
    harmonic_covered: bool
    false_lines: tuple[int, int]
    evaluate_s: float


def evaluate_seed(seed: int, folder: Path) -> Figures:
    """Simulate one seed (unless it is there), evaluate it and compare with its truth."""
    if not folder.exists():
        simulate(folder, PRESET, seed)
    (recording,) = find_recordings(folder)
    started = time.perf_counter()
    evaluation = evaluate_recording(load_manifest(recording), Settings(), {})
    seconds = time.perf_counter() - started
    truth = json.loads((recording.parent / "truth.json").read_text(encoding="utf-8"))
    line = int(np.argmin(np.abs(evaluation.lines.frequency_hz - FUNDAMENTAL_HZ)))
    true_line = int(np.argmin(np.abs(np.array(truth["frequencies"]) - FUNDAMENTAL_HZ)))
    seen = {a.body: a.phasors for a in evaluation.accelerations if a.source == "photogrammetry"}
    exact = {body: _complex(truth["acceleration"][body])[true_line] for body in seen}
    ratio = seen["load"].value[line, DRIVEN] / exact["load"][DRIVEN]
    harmonic_error, harmonic_covered = _harmonic(evaluation, seen["load"], _complex(truth["acceleration"]["load"]))
    sensitivity = evaluation.sensitivity
    if sensitivity is None:
        raise SystemExit("the recording gave no sensitivity")
    channel = sensitivity.channels.index("Fz")
    true_sensitivity = _complex(truth["ratio"])[true_line][channel]
    u_main = [np.sqrt(seen[b].covariance[line, DRIVEN, DRIVEN]) / abs(exact[b][DRIVEN]) for b in seen]
    return Figures(
        seed=seed,
        amplitude_error=float(abs(ratio) - 1.0),
        phase_error_rad=float(np.angle(ratio)),
        u_relative=float(max(u_main)),
        sensitivity_error=float(abs(sensitivity.value[line, channel, DRIVEN] / true_sensitivity) - 1.0),
        normalised=np.concatenate([_normalised(seen[body], exact[body], line) for body in seen]),
        scatter=_scatter(evaluation, seed),
        harmonic_error=harmonic_error,
        harmonic_covered=harmonic_covered,
        false_lines=_false_lines(evaluation),
        evaluate_s=seconds,
    )


def _normalised(found: Phasors, exact: NDArray[np.complex128], line: int) -> FloatArray:
    """Return the errors of Re and Im (12,) over their standard uncertainties."""
    error = found.value[line] - exact
    return np.asarray(np.concatenate([error.real, error.imag]) / np.sqrt(np.diagonal(found.covariance[line])))


def _scatter(evaluation: Evaluation, seed: int) -> dict[str, FloatArray]:
    """Return per stereo pair the motion's scatter about the fit over the Cramér-Rao bound of its images, (6,)."""
    bounds = frame_bounds(PRESET, seed)
    ratios = {}
    for stereo in evaluation.stereo:
        parameters = 2 * len(stereo.fit.phasors.frequency_hz) + 1
        ratios[stereo.name] = np.std(stereo.residual, axis=0, ddof=parameters) / bounds[stereo.name]
    return ratios


def _harmonic(evaluation: Evaluation, found: Phasors, exact: NDArray[np.complex128]) -> tuple[float, bool]:
    """Return the relative error of the 4th harmonic along z, and whether its 95 % region holds the truth."""
    line = int(np.argmin(np.abs(evaluation.lines.frequency_hz - HARMONIC * FUNDAMENTAL_HZ)))
    error = found.value[line, DRIVEN] - exact[HARMONIC - 1, DRIVEN]
    covariance = found.covariance[line][np.ix_([DRIVEN, 6 + DRIVEN], [DRIVEN, 6 + DRIVEN])]
    parts = np.array([error.real, error.imag])
    squares = float(parts @ np.linalg.solve(covariance, parts))
    return float(abs(found.value[line, DRIVEN]) / abs(exact[HARMONIC - 1, DRIVEN]) - 1.0), squares < CHI2_95


def _false_lines(evaluation: Evaluation) -> tuple[int, int]:
    """Return the number of tests, at 1 %, of multiples that the body does not perform, and of those that failed."""
    main = float(evaluation.lines.frequency_hz[np.argmin(evaluation.lines.multiple)])
    failed = tests = 0
    for stereo in evaluation.stereo:
        present = stereo.fit.phasors.frequency_hz
        lines = np.concatenate([present, main * np.array(ABSENT)])
        fit = fit_sines(stereo.time_s, stereo.motion_from_mean.pose, lines, COMPONENTS, UNITS)
        for line in range(len(present), len(lines)):
            for component in range(6):
                both = np.ix_([component, 6 + component], [component, 6 + component])
                value = fit.phasors.value[line, component]
                parts = np.array([value.real, value.imag])
                failed += bool(parts @ np.linalg.solve(fit.phasors.covariance[line][both], parts) > CHI2_99)
                tests += 1
    return tests, failed


def _complex(entry: dict[str, Any]) -> NDArray[np.complex128]:
    """Return a complex array from its real and imaginary parts."""
    return np.asarray(entry["re"]) + 1j * np.asarray(entry["im"])


def print_figures(figures: Figures) -> None:
    """Print one seed as a row of the table."""
    cells = [
        f"{figures.seed}",
        f"{100 * figures.amplitude_error:+.4f} %",
        f"{1e3 * figures.phase_error_rad:+.3f} mrad",
        f"{100 * figures.u_relative:.4f} %",
        f"{100 * figures.sensitivity_error:+.4f} %",
        f"{np.max(np.abs(figures.normalised)):.2f}",
        *(" ".join(f"{value:.2f}" for value in figures.scatter[name]) for name in ("top", "base")),
        f"{100 * figures.harmonic_error:+.1f} %{'' if figures.harmonic_covered else ' not covered'}",
        f"{figures.false_lines[1]} of {figures.false_lines[0]}",
        f"{figures.evaluate_s:.0f}",
    ]
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Run the seeds asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--keep", type=Path, help="folder for the recordings, kept and used again")
    options = parser.parse_args()
    heads = (
        "seed, amplitude, phase, stated u, sensitivity, worst of 24 / u, top, base, 425 Hz, false lines, evaluation s"
    )
    print(f"| {heads.replace(', ', ' | ')} |\n|{'---|' * len(heads.split(','))}")
    with tempfile.TemporaryDirectory() as scratch:
        for seed in options.seeds:
            print_figures(evaluate_seed(seed, (options.keep or Path(scratch)) / f"seed-{seed}"))


if __name__ == "__main__":
    main()
