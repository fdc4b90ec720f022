"""Errors over stated uncertainties in rendered recordings, evaluated from their files as a user would.

    python benchmarks/coverage_rendered.py [--recordings 20]

One stereo pair of 320 x 256 pixels, 48 frames, three laser points, six outputs; every systematic error drawn.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.base import Settings
from fusion.recording.load import load_manifest
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import rendered_run, write_run
from fusion.simulate.world import Draws, make_world

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
TRIGGER_JITTER_S = 30e-9
DRIVEN = 2
HEAD = (
    "| seed | acceleration, 12 parts / u | load, 12 parts / u | sensitivity, 12 parts / u | largest |\n"
    "|---|---|---|---|---|"
)


@dataclass(frozen=True)
class Normalised:
    """Errors of Re and Im at the fundamental over their standard uncertainties, NaN where nothing is given."""

    seed: int
    acceleration: FloatArray
    load: FloatArray
    sensitivity: FloatArray

    @property
    def all(self) -> FloatArray:
        """Return everything that was given."""
        values = np.concatenate([self.acceleration, self.load, self.sensitivity])
        return np.asarray(values[np.isfinite(values)])


def evaluate_seed(seed: int, folder: Path) -> Normalised:
    """Render one recording into an empty folder, evaluate it and compare with its truth."""
    whole = read_preset(Preset, "nitsche2018")
    daqs = [replace(daq, duration_s=1.5) for daq in whole.daqs]
    preset = replace(whole, multiples=(1,), acceleration=whole.acceleration[:1], stereo=whole.stereo[:1])
    preset = replace(preset, first_frame_s=0.4, daqs=tuple(daqs)).reduced(48, 0.5)
    draws = Draws(seed, True)
    world = make_world(preset, draws, TRIGGER_JITTER_S)
    recording = write_run(folder, rendered_run(preset), world, draws)
    found = evaluate_recording(load_manifest(recording), Settings(), {})
    line = int(np.argmin(found.lines.multiple))
    fused = next(a for a in found.accelerations if (a.body, a.source) == ("load", "fused"))
    if found.load is None or found.sensitivity is None:
        raise SystemExit("the recording gave no sensitivity")
    load, ratio = found.load.phasors, world.outputs[0] / world.load_wrench[0, DRIVEN]
    spread = found.sensitivity.covariance[line, :, DRIVEN]
    error = found.sensitivity.value[line, :, DRIVEN] - ratio
    parts = np.stack([error.real, error.imag], axis=1) / np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    motion = world.motion["load"].acceleration[0]
    return Normalised(
        seed,
        _normalised(fused.phasors.value[line] - motion, fused.phasors.covariance[line]),
        _normalised(load.value[line] - world.load_wrench[0], load.covariance[line]),
        parts.ravel(),
    )


def _normalised(error: ComplexArray, covariance: FloatArray) -> FloatArray:
    """Return errors of Re and Im (12,) over their standard uncertainties."""
    return np.asarray(np.concatenate([error.real, error.imag]) / np.sqrt(np.diagonal(covariance)))


def row(found: Normalised) -> str:
    """Return one recording as a row of the table: rms of each quantity and the largest of all."""
    sizes = [np.sqrt(np.nanmean(part**2)) for part in (found.acceleration, found.load, found.sensitivity)]
    cells = [f"{found.seed}", *(f"rms {size:.2f}" for size in sizes), f"{np.max(np.abs(found.all)):.2f}"]
    return "| " + " | ".join(cells) + " |"


def main(recordings: int = 20) -> None:
    """Run all seeds and print the table."""
    print(HEAD)
    everything = []
    for seed in range(1, recordings + 1):
        with tempfile.TemporaryDirectory() as scratch:
            found = evaluate_seed(seed, Path(scratch) / "campaign")
        everything.append(found.all)
        print(row(found), flush=True)
    sizes = np.abs(np.concatenate(everything))
    below = 100.0 * np.mean(sizes < 2.0)
    print(f"\n{len(sizes)} values: {below:.1f} % below 2 u, the largest {sizes.max():.2f} u")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=20)
    main(parser.parse_args().recordings)
