"""Six-component motion of rendered stereo pairs: scatter over the Cramér-Rao bound, and stated over true scatter.

Usage: python benchmarks/motion.py [--seeds 1 2 … 10] [--frames 96] [--keep FOLDER]

Renders the published set-up (106.25 Hz, rocking, three harmonics) without errors of calibration and clocks, measures
both stereo pairs, and takes the residual about the true lines. Rows: the motion fitted to the grey values, and that of
the tracked points alone. Ratios are pooled over recordings and frames. Rendering takes about a minute per seed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.base import Settings
from fusion.phasors.stereo_motion import prepare_images, sensor_from_camera
from fusion.phasors.timing import tie_daqs
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import find_recordings, load_manifest
from fusion.simulate import simulate
from fusion.simulate.world import frame_bounds
from photogram.measure.body import measure_body
from photogram.motion import RigidMotion
from photogram.subsets.icgn import TrackSettings
from shaker.sine.sine_fit import fit_sines

FloatArray = NDArray[np.float64]
COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
UNITS = ("m", "m", "m", "rad", "rad", "rad")
PRESET = "nitsche2018"


def measure(folder: Path, seed: int, frames: int) -> dict[tuple[str, str], FloatArray]:
    """Return per pair and method (3, 6): variance over bound², variance over stated variance, frames that count."""
    if not folder.exists():
        simulate(folder, PRESET, seed, frames=frames, systematic_errors=False, trigger_jitter=False)
    (recording,) = find_recordings(folder)
    manifest, bounds = load_manifest(recording), frame_bounds(PRESET, seed)
    truth = json.loads((recording.parent / "truth.json").read_text(encoding="utf-8"))
    time_s, lines = np.array(truth["exposure_middle_s"]), np.array(truth["frequencies"])
    base, settings = tie_daqs(manifest, read_daqs(manifest)), TrackSettings(degree=Settings().spline_degree)
    found = {}
    for entry in manifest.images:
        seen = prepare_images(manifest, base, entry)
        body = measure_body(seen.cameras, seen.rig, sensor_from_camera(seen.sight.pair), settings)
        exact = np.array(truth["motion"][entry.stereo])
        for method, motion in (("grey values", body.motion), ("points", body.motion_of_points)):
            found[entry.stereo, method] = _ratios(motion, exact, time_s, lines, bounds[entry.stereo])
    return found


def _ratios(
    motion: RigidMotion, exact: FloatArray, time_s: FloatArray, lines: FloatArray, bound: FloatArray
) -> FloatArray:
    """Return (3, 6): variance about the lines over bound², over the mean stated variance, and degrees of freedom."""
    error = (motion.pose - exact)[1:]  # the first frame is the reference and exact by definition
    fit = fit_sines(time_s[1:], error, lines, COMPONENTS, UNITS)
    freedom = len(error) - 2 * len(lines) - 1
    variance = fit.residual_rms**2 * len(error) / freedom
    stated = np.diagonal(motion.covariance[1:], axis1=1, axis2=2).mean(axis=0)
    return np.stack([variance / bound**2, variance / stated, np.full(6, float(freedom))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1, 11)))
    parser.add_argument("--frames", type=int, default=96)
    parser.add_argument("--keep", type=Path, help="folder for the recordings, kept and used again")
    options = parser.parse_args()
    pooled: dict[tuple[str, str], list[FloatArray]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for seed in options.seeds:
            folder = (options.keep or Path(scratch)) / f"motion-{seed}"
            for key, ratios in measure(folder, seed, options.frames).items():
                pooled.setdefault(key, []).append(ratios)
    print(f"| pair | motion fitted to | scatter / bound ({' '.join(COMPONENTS)}) | scatter / stated u | frames |")
    print("|---|---|---|---|---|")
    for (pair, method), values in pooled.items():
        stack = np.stack(values)
        weight = stack[:, 2] / stack[:, 2].sum(axis=0)
        scatter, stated = (np.sqrt(np.sum(weight * stack[:, row], axis=0)) for row in (0, 1))
        cells = [" ".join(f"{value:.3f}" for value in row) for row in (scatter, stated)]
        print(f"| {pair} | {method} | {cells[0]} | {cells[1]} | {len(values) * (options.frames - 1)} |")


if __name__ == "__main__":
    main()
