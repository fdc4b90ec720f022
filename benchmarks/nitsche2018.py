"""The published set-up, simulated and evaluated: errors against the truth, stated uncertainty, scatter over the bound.

Usage: python benchmarks/nitsche2018.py [--seeds 1 2 3 4 5] [--keep FOLDER]

Prints one table per seed and a summary in the layout of docs/performance.md. Rendering one seed takes about two minutes
and evaluating it about one on two cores; with --keep, recordings that are already there are used again.
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

from fusion.evaluate import evaluate_recording
from fusion.evaluation import Evaluation
from fusion.manifest import find_recordings, load_manifest
from fusion.settings import Settings
from fusion.simulate import simulate

FloatArray = NDArray[np.float64]
COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
DRIVEN = 2  # z
FUNDAMENTAL_HZ = 106.25


@dataclass(frozen=True)
class Figures:
    """What one seed gave. `normalised` (12,): errors of Re and Im of six components over their standard uncertainty."""

    seed: int
    amplitude_error: float
    phase_error_rad: float
    u_relative: float
    sensitivity_error: float
    normalised: FloatArray
    scatter: dict[str, FloatArray]
    simulate_s: float
    evaluate_s: float


def evaluate_seed(seed: int, folder: Path) -> Figures:
    """Simulate one seed (unless it is there), evaluate it and compare with its truth."""
    started = time.perf_counter()
    if not folder.exists():
        simulate(folder, "nitsche2018", seed)
    simulated = time.perf_counter()
    (recording,) = find_recordings(folder)
    evaluation = evaluate_recording(load_manifest(recording), Settings(), {})
    done = time.perf_counter()
    truth = json.loads((recording.parent / "truth.json").read_text(encoding="utf-8"))
    return compare(seed, evaluation, truth, simulated - started, done - simulated)


def compare(seed: int, evaluation: Evaluation, truth: dict[str, Any], simulate_s: float, evaluate_s: float) -> Figures:
    """Compare photogrammetry of the load at the fundamental, and the sensitivity, with the truth."""
    line = int(np.argmin(np.abs(evaluation.lines.frequency_hz - FUNDAMENTAL_HZ)))
    true_line = int(np.argmin(np.abs(np.array(truth["frequencies"]) - FUNDAMENTAL_HZ)))
    (seen,) = (a for a in evaluation.accelerations if a.body == "load" and a.source == "photogrammetry")
    exact = _complex(truth["acceleration"]["load"])[true_line]
    found, covariance = seen.phasors.value[line], seen.phasors.covariance[line]
    error = found - exact
    ratio = found[DRIVEN] / exact[DRIVEN]
    sensitivity = evaluation.sensitivity
    if sensitivity is None:
        raise SystemExit("the recording gave no sensitivity")
    channel = sensitivity.channels.index("Fz")
    true_ratio = _complex(truth["ratio"])[true_line][channel]
    return Figures(
        seed=seed,
        amplitude_error=float(abs(ratio) - 1.0),
        phase_error_rad=float(np.angle(ratio)),
        u_relative=float(np.sqrt(np.trace(covariance[[2, 8]][:, [2, 8]]) / 2.0) / abs(exact[DRIVEN])),
        sensitivity_error=float(abs(sensitivity.value[line, channel, DRIVEN] / true_ratio) - 1.0),
        normalised=np.concatenate([error.real, error.imag]) / np.sqrt(np.diagonal(covariance)),
        scatter={
            stereo.name: np.sqrt(np.nanvar(stereo.fit.residual, axis=0)) / np.array(truth["bound"][stereo.name])
            for stereo in evaluation.stereo
        },
        simulate_s=simulate_s,
        evaluate_s=evaluate_s,
    )


def _complex(entry: dict[str, Any]) -> NDArray[np.complex128]:
    """Return a complex array from its real and imaginary parts."""
    return np.asarray(entry["re"]) + 1j * np.asarray(entry["im"])


def print_figures(figures: Figures) -> None:
    """Print one seed."""
    print(
        f"| {figures.seed} | {100 * figures.amplitude_error:+.4f} % | {1e3 * figures.phase_error_rad:+.3f} mrad "
        f"| {100 * figures.u_relative:.4f} % | {100 * figures.sensitivity_error:+.4f} % "
        f"| {np.max(np.abs(figures.normalised)):.2f} | "
        + " ".join(f"{value:.2f}" for value in figures.scatter["top"])
        + f" | {figures.simulate_s:.0f} | {figures.evaluate_s:.0f} |",
        flush=True,
    )


def main() -> None:
    """Run the seeds asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--keep", type=Path, help="folder for the recordings, kept and used again")
    options = parser.parse_args()
    print("| seed | amplitude | phase | stated u | sensitivity | worst of 12 / u | scatter / bound x y z rx ry rz | s | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        for seed in options.seeds:
            print_figures(evaluate_seed(seed, (options.keep or Path(scratch)) / f"seed-{seed}"))


if __name__ == "__main__":
    main()
