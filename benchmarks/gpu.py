"""Tracking by the batched engine on a GPU: points per second, and the time of a recording of full size.

Usage: python benchmarks/gpu.py [--device auto|cpu|cuda] [--precision float64|float32] [--batch-frames 32]
                                [--frames 211] [--cameras 4] [--subsets 1000] [--size-px 1280 1024]

Renders 20 poses of a speckled plane per camera (12 bit with noise, a sine of 3 px with 2 mrad), which repeat, stores
them as TIFF files, and tracks them twice: from memory, for the points per second, and from the files, for the whole
time with reading and preparing. Prints one row of a table. On a CPU, try --frames 5 --cameras 1 --subsets 100
--size-px 320 256. Asked of a data-centre GPU: 10⁶ points/s, and less than the 4 s that the recording took.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, sqrt
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from speckle_plane import Motion, render, speckled_plane

from photogram.bspline import spline_of_image
from photogram.images.files import open_sequence
from photogram.images.sequence import ImageSequence
from photogram.subsets.icgn import Registration, TrackSettings
from photogram.subsets.icgn_stream import follow_frames
from photogram.subsets.reference import Reference, TrackStatus, prepare_reference
from photogram.subsets.track import resolve_device

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint16]
FULL_SCALE, NOISE_GREY = 4095, 16.0
POSES, AMPLITUDE_PX, AMPLITUDE_RAD = 20, 3.0, 2e-3
DOT_PX, BORDER_PX = 4.0, 20.0
SETTINGS = TrackSettings()


@dataclass(frozen=True)
class Engine:
    """Where and how the subsets are followed."""

    device: str
    precision: str
    batch_frames: int

    def follow(self, reference: Reference, first: Image, images: Iterable[Image]) -> list[Registration]:
        """Every frame after the first."""
        series = follow_frames(reference, first, images, SETTINGS, self.device, self.batch_frames, self.precision)
        return [found for _, found in series]

    def describe(self) -> str:
        """Name of the device."""
        import torch

        name = torch.cuda.get_device_name() if self.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
        return f"{name}, {self.precision}"


def main() -> None:
    """Render, track, print one row."""
    options = arguments()
    engine = Engine(resolve_device(options.device), options.precision, options.batch_frames)
    motion = one_period(options.size_px)
    centres = grid(options.size_px, options.subsets)
    with tempfile.TemporaryDirectory() as scratch:
        cameras = [write_camera(Path(scratch), camera, motion, options) for camera in range(options.cameras)]
        track_files(engine, cameras[:1], centres, min(options.frames, 1 + 2 * options.batch_frames))
        points_per_s = speed_without_reading(engine, cameras, centres, options.frames)
        started = time.perf_counter()
        found = track_files(engine, cameras, centres, options.frames)
        whole_s = time.perf_counter() - started
    lost = np.mean([here.status != TrackStatus.OK for camera in found for here in camera])
    error = 1e3 * rms_error_px(found, centres, motion)
    print("| device | images | subsets per camera | points/s without reading | whole time | lost | rms error |")
    print("|---|---|---|---|---|---|---|")
    print(
        f"| {engine.describe()} | {options.cameras} x {options.frames}, {options.size_px[0]} x {options.size_px[1]} px "
        f"| {len(centres)} | {points_per_s:.3g} | {whole_s:.2f} s | {100 * lost:.2f} % | {error:.2f} mpx |"
    )


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--precision", default="float64")
    parser.add_argument("--batch-frames", type=int, default=32)
    parser.add_argument("--frames", type=int, default=211)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--subsets", type=int, default=1000)
    parser.add_argument("--size-px", type=int, nargs=2, default=(1280, 1024))
    return parser.parse_args()


def one_period(size_px: tuple[int, int]) -> Motion:
    """One sine of shift and turn, at rest in the first frame."""
    phase = 2.0 * np.pi * np.arange(POSES) / POSES
    shift = AMPLITUDE_PX * np.sin(phase)[:, None] * np.array([1.0, 0.6])
    return Motion(shift, AMPLITUDE_RAD * np.sin(phase), 0.5 * np.array(size_px, dtype=np.float64))


def grid(size_px: tuple[int, int], subsets: int) -> FloatArray:
    """About as many centres (N,2) as asked for, evenly over the image."""
    width, height = size_px
    columns = ceil(sqrt(subsets * width / height))
    rows = round(subsets / columns)
    x, y = (np.linspace(BORDER_PX, length - 1 - BORDER_PX, n) for length, n in ((width, columns), (height, rows)))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def write_camera(folder: Path, camera: int, motion: Motion, options: argparse.Namespace) -> ImageSequence:
    """Files of one camera's poses, repeated up to the number of frames."""
    rng = np.random.default_rng(camera)
    plane = speckled_plane(tuple(options.size_px), DOT_PX, 2.0 * AMPLITUDE_PX, rng)
    paths = []
    for pose in range(min(POSES, options.frames)):
        grey = FULL_SCALE * render(plane, motion, pose) + rng.normal(0.0, NOISE_GREY, options.size_px[::-1])
        paths.append(folder / f"{camera}-{pose:02d}.tif")
        tifffile.imwrite(paths[-1], np.clip(np.rint(grey), 0, FULL_SCALE).astype(np.uint16), photometric="minisblack")
    return open_sequence([paths[frame % POSES] for frame in range(options.frames)], 12)


def track_files(
    engine: Engine, cameras: Sequence[ImageSequence], centres: FloatArray, frames: int
) -> list[list[Registration]]:
    """Prepare the reference of every camera and follow its first frames, reading included."""
    found = []
    for sequence in cameras:
        first = sequence.read(0)
        images = (sequence.read(frame) for frame in range(1, frames))
        found.append(engine.follow(prepared(first, centres), first, images))
    return found


def speed_without_reading(engine: Engine, cameras: Sequence[ImageSequence], centres: FloatArray, frames: int) -> float:
    """Points per second: subsets found in frames that are in memory already, references prepared."""
    seconds = 0.0
    for sequence in cameras:
        poses = [sequence.read(pose) for pose in range(min(POSES, frames))]
        reference = prepared(poses[0], centres)
        started = time.perf_counter()
        engine.follow(reference, poses[0], (poses[frame % POSES] for frame in range(1, frames)))
        seconds += time.perf_counter() - started
    return len(cameras) * (frames - 1) * len(centres) / seconds


def prepared(first: Image, centres: FloatArray) -> Reference:
    """The reference of one camera."""
    return prepare_reference(spline_of_image(first, SETTINGS.degree), centres, SETTINGS.radius_px)


def rms_error_px(found: Sequence[Sequence[Registration]], centres: FloatArray, motion: Motion) -> float:
    """Root mean square distance in x and y of all positions found from the truth."""
    squares = []
    for camera in found:
        for frame, here in enumerate(camera, start=1):
            truth = motion.positions(centres, frame % POSES) - centres
            squares.append(np.nanmean((here.warp[:, [0, 3]] - truth) ** 2))
    return float(np.sqrt(np.mean(squares)))


if __name__ == "__main__":
    main()
