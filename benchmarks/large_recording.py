"""A recording of full size: two stereo pairs of 1280 x 1024 px, 4 x 211 frames of 12 bit, tracked from its files.

Usage: python benchmarks/large_recording.py [--frames 211] [--keep FOLDER]

Renders 20 poses of a round face in each camera, which repeat, each frame with noise of its own, and stores every frame
as a TIFF file (2.6 MB each). Then both pairs are tracked with the default settings, reading included: about 1000
subsets of 21 x 21 px per camera. Prints wall and user CPU time, the peak memory of this process (another one renders),
and how well the subsets' motion agrees with the truth. With --keep, a recording that is already there is used again.

With --growth, the memory of a series of any length instead: 24 frames of the sample recording are followed, their
results repeated, and the motion of so many frames computed from them. Images are read one at a time and no part of it.
"""

from __future__ import annotations

import argparse
import os
import pickle
import resource
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from fusion.base import Settings
from fusion.phasors.setup import open_set_ups
from fusion.phasors.stereo_motion import body_inputs
from fusion.recording.load import load_manifest
from fusion.simulate.preset import Preset, StereoSetup, face_of, nominal_rig, read_preset
from photogram.camera import StereoRig
from photogram.geometry import RigidTransform
from photogram.images.files import open_sequence
from photogram.images.sequence import ImageSequence
from photogram.measure import body_motion, follow_block, prepare_body
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import StereoTracks, track_stereo
from photogram.synthetic.scene import render, view_of

FloatArray = NDArray[np.float64]
SIZE_PX, PIXEL_M, FOCAL_PX, RADIUS_M = (1280, 1024), 83e-6, 5420.0, 0.0335
POSES = 20
PEAK = np.array([6e-5, 4e-5, 2.4e-4, 3e-4, 2e-4, 1e-4])  # m and rad: 3 px at most
SIDES = ("left", "right")
SAMPLE = Path(__file__).parents[1] / "sample_images" / "demo"


@dataclass(frozen=True)
class Cost:
    """Time in s of tracking both pairs, the tracker's peak memory in bytes."""

    wall_s: float
    user_s: float
    peak_bytes: int


def main() -> None:
    """Write the recording, track it, print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=211)
    parser.add_argument("--keep", type=Path, help="folder for the recording, kept and used again")
    parser.add_argument("--growth", action="store_true", help="measure the memory of each frame, images left out")
    options = parser.parse_args()
    if options.growth:
        print_growth()
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        if not all((folder / camera_folder(setup, side)).is_dir() for setup in setups() for side in SIDES):
            with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
                pool.submit(write_recording, folder, options.frames).result()
        track(folder, 2)
        tracks, cost = track(folder, options.frames)
    frames = options.frames * len(SIDES) * len(tracks)
    print("| figure | here | asked for |\n|---|---|---|")
    print(f"| images, subsets per camera | {frames}, {' and '.join(f'{count(pair)}' for pair in tracks)} | 844, 1000 |")
    print(f"| wall time, reading included, {os.cpu_count()} cores | {cost.wall_s:.1f} s | ≤ 60 s |")
    print(f"| user CPU | {cost.user_s:.1f} s, {1e3 * cost.user_s / frames:.0f} ms per image | |")
    print(f"| peak memory | {cost.peak_bytes / 1e9:.2f} GB | < 1.5 GB |")
    for setup, pair in zip(setups(), tracks, strict=True):
        lost, worst = lost_share(pair), 1e3 * error_px(setup, pair)
        print(f"| {setup.name}: positions lost, mean error of a frame | {100 * lost:.2f} %, {worst:.2f} mpx | |")


def print_growth() -> None:
    """Print what a frame takes of memory for each subset, from series of several lengths."""
    manifest = load_manifest(next(SAMPLE.glob("*/recording.toml")))
    (opened,) = open_set_ups(manifest)
    (left, right), rig, placed, settings = body_inputs(opened.images[0], Settings())
    scene = prepare_body((left, right), rig, placed, settings)
    block = follow_block(scene, range(2, len(left)))
    subsets = len(scene.references[0].centre_px)
    print("| frames | subsets | peak memory / MB | per frame and subset / byte |")
    print("|---|---|---|---|")
    for repeated in (20, 100, 400):
        tracemalloc.start()
        blocks = [pickle.loads(pickle.dumps(block)) for _ in range(repeated)]
        body_motion(scene, blocks)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        frames = 1 + len(scene.lead) + repeated * len(block)
        print(f"| {frames} | {subsets} | {peak / 1e6:.0f} | {peak / frames / subsets:.0f} |", flush=True)


def setups() -> Iterator[StereoSetup]:
    """Yield the two pairs: those of the published set-up with twice the resolution, on a round face of 810 px."""
    for setup in read_preset(Preset, "nitsche2018").stereo:
        half = (RADIUS_M, RADIUS_M)
        yield replace(setup, size_px=SIZE_PX, pixel_m=PIXEL_M, focal_px=FOCAL_PX, half_size=half, round=True)


def camera_folder(setup: StereoSetup, side: str) -> str:
    """Name of one camera's folder."""
    return f"{setup.name}-{side}"


def cameras_from_world(setup: StereoSetup) -> tuple[StereoRig, tuple[RigidTransform, RigidTransform]]:
    """The pair and where its left and right cameras stand."""
    rig, world_from_left = nominal_rig(setup)
    left = world_from_left.inverse()
    return rig, (left, rig.right_from_left @ left)


def pose(frame: int) -> FloatArray:
    """Pose (6,) of the body in a frame: one sine in all components, at rest in frame 0."""
    swing: FloatArray = PEAK * np.sin(2.0 * np.pi * (frame % POSES) / POSES)
    return swing


def write_recording(folder: Path, frames: int) -> None:
    """Render the poses of every camera and write its frames."""
    for number, setup in enumerate(setups()):
        rng = np.random.default_rng(number)
        face = face_of(setup, False, rng)
        rig, places = cameras_from_world(setup)
        for side, camera, place in zip(SIDES, (rig.left, rig.right), places, strict=True):
            view = view_of(camera, place)
            images = [render(view, face, pose(k)[None], np.ones(1)) for k in range(min(POSES, frames))]
            target = folder / camera_folder(setup, side)
            target.mkdir(parents=True)
            for frame in range(frames):
                grey = setup.sensor.digitise(images[frame % POSES], rng)
                tifffile.imwrite(target / f"{frame:04d}.tif", grey, photometric="minisblack", metadata=None)


def track(folder: Path, frames: int) -> tuple[list[StereoTracks], Cost]:
    """Track the first frames of both pairs from their files."""
    wall_s, user_s = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_utime
    tracks = []
    for setup in setups():
        left, right = (_sequence(folder / camera_folder(setup, side), setup, frames) for side in SIDES)
        tracks.append(track_stereo(left, right, cameras_from_world(setup)[0], TrackSettings()))
    usage = resource.getrusage(resource.RUSAGE_SELF)
    peak = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return tracks, Cost(time.perf_counter() - wall_s, usage.ru_utime - user_s, peak)


def _sequence(folder: Path, setup: StereoSetup, frames: int) -> ImageSequence:
    """The first frames of one camera."""
    return open_sequence(sorted(folder.glob("*.tif"))[:frames], setup.bit_depth)


def count(pair: StereoTracks) -> int:
    """Number of subsets in each camera."""
    return len(pair.left.noise_grey)


def lost_share(pair: StereoTracks) -> float:
    """Share of the positions of both cameras that were not found."""
    return float(np.mean([tracks.status != TrackStatus.OK for tracks in (pair.left, pair.right)]))


def error_px(setup: StereoSetup, pair: StereoTracks) -> float:
    """Largest mean error of a frame in x or y, in px, against the true motion of the subsets' centres on the face."""
    rig, places = cameras_from_world(setup)
    errors = []
    for camera, place, tracks in zip((rig.left, rig.right), places, (pair.left, pair.right), strict=True):
        face = on_face(setup, place, camera.undistort(tracks.position_px[0]))
        for frame, found in enumerate(tracks.position_px):
            seen = camera.project(place.apply(RigidTransform.from_pose(pose(frame)).apply(face)))
            errors.append(np.abs(np.nanmean(found - seen, axis=0)))
    return float(np.max(errors))


def on_face(setup: StereoSetup, camera_from_world: RigidTransform, rays: FloatArray) -> FloatArray:
    """Points (N,3) in the world where the rays (N,2) of a camera meet the face at rest."""
    world_from_camera = camera_from_world.inverse()
    normal, centre = np.array(setup.face_normal), np.array(setup.face_centre)
    direction = np.column_stack([rays, np.ones(len(rays))]) @ world_from_camera.rotation.T
    origin = world_from_camera.translation_m
    points: FloatArray = origin + direction * ((centre - origin) @ normal / (direction @ normal))[:, None]
    return points


if __name__ == "__main__":
    main()
