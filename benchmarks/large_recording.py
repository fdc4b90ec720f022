"""A recording of full size: two stereo pairs of 1280 x 1024 px, 4 x 211 frames of 12 bit, tracked from its files.

Usage: python benchmarks/large_recording.py [--frames 211] [--keep FOLDER] [--growth]

Renders 20 poses of a round face in each camera, which repeat, each frame with noise of its own, and stores every frame
as a TIFF file (2.6 MB each). Then both pairs are tracked with the default settings, reading included: about 1000
subsets of 21 x 21 px per camera. Prints wall and user CPU time, the peak memory of this process (another one renders),
and how well the subsets' motion agrees with the truth. With --keep, a recording that is already there is used again.

With --growth, a series of any length instead: the first pair is followed through so many frames (34 pictures of each
camera, which repeat) as a run does, blocks of what is found lie on a disk, again and again, until they are those of 100
GB of pictures, and motion, check of the cameras, phasors and deformation of so many frames are computed from there. A
process of its own for each length prints its peak memory.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from fusion.base import Settings
from fusion.phasors.set_up import PreparedSetUp, prepare_set_ups
from fusion.phasors.stereo_motion import PreparedImages, motion_from_tracks
from fusion.phasors.stereo_phasors import stereo_phasors
from fusion.phasors.tracked_blocks import TrackedBlocks, body_inputs
from fusion.recording.load import load_manifest
from fusion.report.atomic_files import Checkpoint
from fusion.simulate.preset import Preset, StereoSetup, face_of, nominal_rig, read_preset
from photogram.camera import StereoRig
from photogram.geometry import RigidTransform
from photogram.images.image_files import open_sequence
from photogram.images.sequence import ImageSequence
from photogram.measure.body import body_motion, follow_block
from photogram.measure.follow import BLOCK_FRAMES, BodyScene, prepare_body
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import StereoTracks, track_stereo
from photogram.synthetic.scene import render, view_of

FloatArray = NDArray[np.float64]
SIZE_PX, PIXEL_M, FOCAL_PX, RADIUS_M = (1280, 1024), 83e-6, 5420.0, 0.0335
POSES, PICTURES = 20, 34
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
    parser.add_argument("--frames", type=int, help="of each camera, by default 211, with --growth 2000")
    parser.add_argument("--keep", type=Path, help="folder for the recording, kept and used again")
    parser.add_argument("--growth", action="store_true", help="measure how memory grows with the frames")
    options = parser.parse_args()
    options.frames = options.frames or (2000 if options.growth else 211)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        if not all((folder / camera_folder(setup, side)).is_dir() for setup in setups() for side in SIDES):
            with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
                pool.submit(write_recording, folder, PICTURES if options.growth else options.frames).result()
        if options.growth:
            print_growth(folder, options.frames)
            return
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


def print_growth(folder: Path, frames: int) -> None:
    """Print what series of several lengths take of memory, disk and time, in a process each."""
    print("| frames of a pair | images / GB | step | peak memory / GB | disk / GB | CPU time of a frame / ms |")
    print("|---|---|---|---|---|---|")
    for repeated in (0, 1, 4, 10):
        with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
            print(pool.submit(growth, folder, frames, repeated).result(), flush=True)


def growth(folder: Path, frames: int, repeated: int) -> str:
    """Return a row: blocks of some frames followed and kept, or the frames of all blocks, repeated, evaluated."""
    (opened,) = prepare_set_ups(load_manifest(next(SAMPLE.glob("*/recording.toml"))))  # for its channels and lines
    images, scene = large_pair(folder, opened.images[0], frames)
    kept, (name, own) = Checkpoint(folder / "results", lambda: "growth"), ("tracked", len(scene.blocks))
    starts = range(scene.blocks[0].start, 1 + max(1, repeated) * own * BLOCK_FRAMES, BLOCK_FRAMES)
    scene = replace(scene, blocks=tuple(range(start, start + BLOCK_FRAMES) for start in starts))
    followed, begun = TrackedBlocks(images, scene, "cpu", kept), time.process_time()
    if not repeated:
        for block in scene.blocks:
            followed.add(block, follow_block(scene, block))
    else:
        name = "evaluated"
        for number, found in enumerate(islice(followed, own)):
            for block in scene.blocks[own + number :: own]:
                followed.add(block, found)
        begun = time.process_time()
        evaluate(opened, images, followed)
    count, took = scene.blocks[-1].stop, time.process_time() - begun
    pictures = 2 * count * SIZE_PX[0] * SIZE_PX[1] * 2
    disk = sum(file.stat().st_size for file in folder.rglob("*.growth"))
    each = f"{disk / 1e9:.2f} | {1e3 * took / count:.0f}"
    return f"| {count} | {pictures / 1e9:.1f} | {name} | {peak_bytes() / 1e9:.2f} | {each} |"


def large_pair(folder: Path, sample: PreparedImages, frames: int) -> tuple[PreparedImages, BodyScene]:
    """The first pair with so many frames, in whole blocks, its pictures repeated, in place of that of the sample."""
    setup = next(setups())
    rig, placed = nominal_rig(setup)
    frames = 2 + max(1, (frames - 2) // BLOCK_FRAMES) * BLOCK_FRAMES
    files = [sorted((folder / camera_folder(setup, side)).glob("*.tif")) for side in SIDES]
    left, right = (open_sequence([own[k % len(own)] for k in range(frames)], setup.bit_depth) for own in files)
    where = {"rotation": placed.rotation.tolist(), "translation": placed.translation_m.tolist()}
    sight = replace(sample.sight, pair=sample.sight.pair.model_copy(update=where))
    images = replace(sample, sight=sight, cameras=(left, right), rig=rig, first=left.read(0), depth_m=None)
    return images, prepare_body(*body_inputs(images, Settings()))


def evaluate(opened: PreparedSetUp, images: PreparedImages, followed: TrackedBlocks) -> None:
    """Compute what a run does of the frames of a pair that are followed, taken at equal distances in time."""
    assert opened.lines is not None
    measured = motion_from_tracks(images, body_motion(followed.scene, followed))
    known_s = measured.sight.time_s
    time_s = known_s[0] + np.mean(np.diff(known_s)) * np.arange(len(measured.motion.pose))
    stereo_phasors(opened.base, replace(measured, sight=replace(measured.sight, time_s=time_s)), opened.lines)


def peak_bytes() -> int:
    """Peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


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
        left, right = (sequence_of(folder / camera_folder(setup, side), setup, frames) for side in SIDES)
        tracks.append(track_stereo(left, right, cameras_from_world(setup)[0], TrackSettings()))
    user_s = resource.getrusage(resource.RUSAGE_SELF).ru_utime - user_s
    return tracks, Cost(time.perf_counter() - wall_s, user_s, peak_bytes())


def sequence_of(folder: Path, setup: StereoSetup, frames: int) -> ImageSequence:
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
