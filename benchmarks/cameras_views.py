"""How many cameras see a body: what further ones add, and whether the uncertainty of one alone holds.

    python benchmarks/cameras_views.py [--frames 60] [--seeds 12] [--only arrangements coverage] [--write PAGE]

*Arrangements*: one body rendered before a pair, a second pair, a further camera alone, with exact calibrations and the
noise of the pictures. The motion fitted to the grey values of all cameras at once against the motions of pairs and
single cameras combined by their covariances, as a run combines instruments, and both against the Cramér–Rao bound of
all pixels. *Coverage*: rendered recordings with everything drawn that their files state as uncertain, evaluated from
the files, with three laser points beside the cameras; truth from the simulator, which shares no formula with the
evaluation.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from marked import existing_file, markdown_table, write_marked
from numpy.typing import NDArray

from fusion.estimation.coverage import coverage_factor
from fusion.estimation.estimation_notices import INSTRUMENTS_DISAGREE
from fusion.recording.load import load_manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.simulate.preset import Preset, StereoSetup, face_of, nominal_rig, read_preset
from fusion.simulate.sines import TRIGGER_JITTER_S, rendered_run, write_run
from fusion.simulate.world import Draws, make_world
from photogram.bspline import spline_of_image
from photogram.camera import FaceCamera
from photogram.direct.direct_fit import DirectFit, fit_direct
from photogram.geometry import RigidTransform
from photogram.images.sequence import ImageSequence
from photogram.measure.follow import BodyScene, prepare_body
from photogram.subsets.icgn import TrackSettings
from photogram.synthetic.scene import Face, View, motion_bound, render, view_of
from shaker.sine.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
AMPLITUDE = np.array([5e-6, 5e-6, 1e-4, 2e-5, 2e-5, 2e-5])
BACK = {"face_up": (0.0, -1.0, 0.0)}  # looks from the other side
ASIDE = {"face_up": (1.0, 0.0, 0.0), "surface_uncertainty": (0.0, 0.0)}


@dataclass(frozen=True)
class Instrument:
    """A pair or a camera alone before the body: what it follows, and its views for the bound."""

    scene: BodyScene
    views: tuple[View, ...]


def instrument(setup: StereoSetup, face: Face, poses: FloatArray, rng: np.random.Generator) -> Instrument:
    """Return a pair or a camera alone with rendered pictures of every pose."""
    rig, placed = nominal_rig(setup)
    cameras = zip(setup.sides, rig.camera_poses, strict=False)
    views = tuple(view_of(camera, from_left @ placed.inverse()) for _, (camera, from_left) in cameras)
    series = []
    for view in views:
        pictures = [setup.sensor.digitise(render(view, face, pose[None], np.ones(1)), rng) for pose in poses]
        names = tuple(map(str, range(len(poses))))
        series.append(ImageSequence(names, setup.size_px, setup.sensor.full_scale, pictures.__getitem__))
    place = placed.inverse()
    alone = FaceCamera(rig.left, place.apply(face.origin_m), place.rotation @ np.array(setup.face_normal))
    scene = prepare_body(tuple(series), alone if len(views) == 1 else rig, placed, TrackSettings())
    return Instrument(scene, views)


def together(instruments: Sequence[Instrument], frame: int, start: RigidTransform) -> DirectFit:
    """Return the motion of a frame fitted to the grey values of all cameras at once."""
    views = [view for one in instruments for view in one.scene.views]
    images = [images.read(frame) for one in instruments for images in one.scene.images]
    fit = fit_direct(views, [spline_of_image(image, instruments[0].scene.settings.degree) for image in images], start)
    assert fit is not None
    return fit


def combined(fits: Sequence[DirectFit]) -> tuple[FloatArray, FloatArray]:
    """Return the mean (6,) of motions weighted by their covariances, and its covariance."""
    weights = [np.linalg.inv(fit.covariance) for fit in fits]
    covariance = np.linalg.inv(np.sum(weights, axis=0))
    return covariance @ np.sum([w @ fit.moved.pose for w, fit in zip(weights, fits, strict=True)], axis=0), covariance


def arrangement(name: str, instruments: Sequence[Instrument], face: Face, poses: FloatArray) -> str:
    """Return the row of an arrangement: bounds, standard deviations over them, and what a joint fit would change."""
    views = [view for one in instruments for view in one.views]
    sensor = read_preset(Preset, "demo").stereo[0].sensor
    bound = np.sqrt(np.diagonal(motion_bound(views, face, sensor)))
    apart, joint, u = [], [], []
    for frame in range(1, len(poses)):
        start = RigidTransform.from_pose(poses[frame])
        motion, covariance = combined([together([one], frame, start) for one in instruments])
        apart.append(motion - poses[frame])
        joint.append(together(instruments, frame, start).moved.pose - poses[frame])
        u.append(np.sqrt(np.diagonal(covariance)))
    spread = [np.std(errors, axis=0, ddof=1) for errors in (apart, joint)]  # the reference's noise is in all frames
    mean_u, between = np.mean(u, axis=0), np.std(np.array(apart) - joint, axis=0, ddof=1)
    ratios = np.array([spread[0] / bound, spread[1] / bound, mean_u / bound])
    sizes = [f"{float(f'{size:.3g}'):g}" for size in [*(1e9 * bound[:3]), *(1e6 * bound[3:])]]
    cells = [name, *sizes, *(f"{np.mean(ratio):.3f}" for ratio in ratios), f"{np.max(between / mean_u):.3f}"]
    return "| " + " | ".join(cells) + " |"


def arrangements(frames: int) -> list[str]:
    """Return the rows of all arrangements."""
    rng, time = np.random.default_rng(1), np.arange(frames)
    poses = AMPLITUDE * np.sin(2.0 * np.pi * 0.137 * time[:, None] + np.arange(6))
    poses[0] = 0.0
    top = read_preset(Preset, "demo").stereo[0]
    face = face_of(top, False, np.random.default_rng(2))
    pair, back, aside = (instrument(replace(top, **changes), face, poses, rng) for changes in ({}, BACK, ASIDE))
    rows = []
    for name, chosen in (
        ("one camera", [aside]),
        ("a pair", [pair]),
        ("a pair and one camera", [pair, aside]),
        ("two pairs", [pair, back]),
        ("two pairs and one camera", [pair, back, aside]),
    ):
        rows.append(arrangement(name, chosen, face, poses))
        print(rows[-1], flush=True)
    return rows


def evaluated(preset: Preset, seed: int) -> tuple[Evaluation, dict[str, list[list[float]]]]:
    """Return what a run makes of a simulated recording, and the true acceleration of the load."""
    with tempfile.TemporaryDirectory() as folder:
        draws = Draws(seed, systematic=True)
        recording = write_run(Path(folder), rendered_run(preset), make_world(preset, draws, TRIGGER_JITTER_S), draws)
        truth = json.loads((recording / "truth.json").read_text(encoding="utf-8"))
        return evaluate_recording(load_manifest(recording)), truth["acceleration"]["load"]


def coverage(seeds: int) -> list[str]:
    """Return a row for each group of instruments, with the load's components at the driven line."""
    single, demo = (read_preset(Preset, name) for name in ("single", "demo"))
    beside = replace(single.stereo[0], name="side", face_up=(1.0, 0.0, 0.0))
    cases = {
        "one camera": replace(single, stereo=single.stereo[:1]),
        "a pair and one camera": replace(demo, stereo=(demo.stereo[0], beside)),
    }
    rows = []
    for name, preset in cases.items():
        errors: dict[tuple[str, int], list[tuple[float, float, bool]]] = {}
        disagree = 0
        for seed in range(1, seeds + 1):
            evaluation, truth = evaluated(preset, seed)
            for found in evaluation.accelerations:
                if found.body == "load" and found.source in SOURCES:
                    for c, told in _errors(found.phasors, np.array(truth["re"][0]) + 1j * np.array(truth["im"][0])):
                        errors.setdefault((found.source, c), []).extend(told)
            disagree += any(notice.code == INSTRUMENTS_DISAGREE.code for notice in evaluation.notices)
            print(f"{name}: seed {seed} done", flush=True)
        for source, by in SOURCES.items():
            seen = {c: np.array(parts).T for (of, c), parts in sorted(errors.items()) if of == source}
            sizes = {c: f"{np.median(u):.2g}" for c, (_, u, _) in seen.items()}
            words = [", ".join(sizes.get(c, "–") for c in range(start, start + 3)) for start in (0, 3)]
            over = np.concatenate([error / u for error, u, _ in seen.values()])
            covered = np.concatenate([inside for _, _, inside in seen.values()])
            cells = [name, by, *words, f"{np.sqrt(np.mean(over**2)):.2f}", f"{int(covered.sum())} of {len(covered)}"]
            rows.append("| " + " | ".join(cells) + " |")
        print(f"{name}: instruments disagree in {disagree} of {seeds} recordings", flush=True)
    print("\n".join(rows))
    return rows


def _errors(phasors: Phasors, true: ComplexArray) -> Iterator[tuple[int, list[tuple[float, float, bool]]]]:
    """Yield each component that is known with error, u and whether U holds it, of both parts at the first line."""
    k = coverage_factor(float(phasors.dof[0]))
    for c in np.flatnonzero(np.isfinite(phasors.value[0])):
        error = phasors.value[0, c] - true[c]
        parts = (float(error.real), float(phasors.u_re[0, c])), (float(error.imag), float(phasors.u_im[0, c]))
        yield int(c), [(off, u, abs(off) <= k * u) for off, u in parts]


SOURCES = {"photogrammetry": "cameras", "vibrometer": "lasers", "fused": "all"}
ARRANGED = (
    "| cameras | x / nm | y / nm | z / nm | rx / µrad | ry / µrad | rz / µrad | combined | joint | stated | Δ / u |"
)
COVERED = "| cameras | result of | u of x, y, z / (m/s²) | u of rx, ry, rz / (rad/s²) | error over u, rms | within ±U |"


def main() -> None:
    """Print the tables, and write them into a page where one is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--only", nargs="*", default=["arrangements", "coverage"])
    parser.add_argument("--write", type=existing_file)
    options = parser.parse_args()
    parts = {}
    if "arrangements" in options.only:
        parts["arrangements"] = markdown_table(ARRANGED, arrangements(options.frames))
    if "coverage" in options.only:
        parts["one camera"] = markdown_table(COVERED, coverage(options.seeds))
    if options.write is not None:
        write_marked(options.write, parts)


if __name__ == "__main__":
    main()
