"""Subset tracking against the limit of the noise, and beside the programs that others wrote.

Usage: python benchmarks/tracking.py [--programs NAME ...] [--peer-python PATH] [--threads 1]
       [--recordings 3] [--docs docs]
       python benchmarks/tracking.py --rounding docs/tracking.md

Renders 21 frames of 1024 x 1024 px exactly (no interpolation; see speckle_plane.py), with dots 4.5 px wide at half
height: a sine of 3 px along x and 2 px along y with 2 mrad of rotation, noise of 1 grey level of 255, 8 bit. 8649
subsets of 31 x 31 px, 10 px apart, are tracked by every program that is installed; peers may have an environment of
their own (`pip install pyvale pyidi al-dic`), named by --peer-python. Prints both tables, with --docs also into
performance.md of that folder; with all programs a quarter of an hour.

- CPU time: of the user, per subset and tracked frame, reading included, imports and compilation excluded.
- bound: standard deviation that white noise leaves to any unbiased program, σ = σ_n/√Σ(∂f/∂x)² with the exact gradient
  of the subset's pixels and σ_n² = 1 + 1/12 (rounding) at 8 bit; a pair of frames has the noise of both, √2·σ.
- pair: scatter of the errors against the known motion about their mean over the frame, over √2·σ, pooled.
- series: scatter over time of each subset's errors about their own mean, over σ: the reference's noise is constant.
- bias: mean error of a frame over all subsets, largest of all frames and of x and y. Noise alone moves the mean of one
  frame by 0.1 mpx (one σ), so recordings with noise of their own are averaged first.

The second table shows the error of interpolation without noise, stored in 16 bit, for dots of several sizes: mean error
of all positions in one tenth of a pixel, largest of the ten, since a rotation spreads a frame over several tenths.

--rounding writes the table of what float32 grey values do instead: pairs of frames shifted by tenths of a pixel,
registered by the compiled engine and by the batched one in float64 (references are float32 in both). bias: mean error
of a shift over all subsets, largest of ten shifts and of x and y; bound as above; a subset: largest difference of one
subset's places.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tifffile
from marked import existing_file, existing_folder, markdown_row, markdown_table, short_table, write_marked
from numpy.typing import NDArray
from speckle_plane import Motion, Plane, gradients, render, speckled_plane
from tracking_programs import NOT_INSTALLED, PROGRAMS, Grid

from photogram.bspline import Spline, spline_of_image
from photogram.subsets.icgn import TrackSettings, register
from photogram.subsets.icgn_torch import register_frames, splines_of, torch_reference, upload_images
from photogram.subsets.reference import prepare_reference
from photogram.subsets.texture import subset_mean

FloatArray = NDArray[np.float64]
SIZE_PX, FRAMES, MARGIN_PX = 1024, 21, 24.0
DOT_PX, DOTS_PX = 4.5, (4.5, 3.8, 3.2)
GRID = Grid(first=52, step=10, count=93, radius=15)
PEAK_PX, PEAK_RAD, CYCLES_PER_FRAME = (3.0, -2.0), 2e-3, 0.0977
NOISE_GREY = 1.0
NOISY_HEAD = "| program | CPU time per subset / µs | scatter over bound, pair | series | bias / mpx |"
ADAPTERS = Path(__file__).with_name("tracking_programs.py")
OWN = "shakercal"
SHIFTS_PX, STEP = np.stack([np.arange(10) / 10, np.roll(np.arange(10) / 10, 3)], axis=1), 2 * GRID.radius + 1
MPX = 1e-3


@dataclass(frozen=True)
class Recording:
    """Frames of a plane, one folder for each draw of the noise: grey levels up to full_scale, noise before rounding."""

    plane: Plane
    folders: tuple[Path, ...]
    full_scale: int
    noise_grey: float

    @property
    def noise(self) -> float:
        """Standard deviation of a stored pixel in full scales, rounding included."""
        return float(np.sqrt(self.noise_grey**2 + 1.0 / 12.0)) / self.full_scale


@dataclass(frozen=True)
class Result:
    """What a program found in R recordings of F frames but the first, and its time in s for all of them.

    centres (N,2): in frame 0; positions (R,F−1,N,2) in px; error (R,F−1,N,2): positions against the known motion.
    """

    centres: FloatArray
    positions: FloatArray
    error: FloatArray
    user_s: float
    wall_s: float
    version: str


def main() -> None:
    """Render, run the programs asked for, print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", nargs="+", default=list(PROGRAMS), choices=PROGRAMS, metavar="NAME")
    parser.add_argument(
        "--peer-python", type=existing_file, default=Path(sys.executable), help="interpreter with the peers"
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--recordings", type=int, default=3)
    parser.add_argument(
        "--docs", type=existing_folder, metavar="FOLDER", help="folder of performance.md, which gets the tables"
    )
    parser.add_argument(
        "--rounding", type=existing_file, metavar="PAGE", help="write the table of float32 there, and end"
    )
    options = parser.parse_args()
    if options.rounding:
        head = "| noise | degree | bias in mpx, float64 | float32 | a subset, mpx | std/bound, float64 | float32 |"
        rows = rounding_rows(np.random.default_rng(3))
        table = short_table(head, rows, range(7), lambda cells: cells[1] == "7")
        write_marked(options.rounding, {"rounding": table})
        return
    own = [name for name in options.programs if name.startswith(OWN)]
    pythons = {name: Path(sys.executable) if name in own else options.peer_python for name in options.programs}
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as scratch:
        plane = speckled_plane((SIZE_PX, SIZE_PX), DOT_PX, MARGIN_PX, rng)
        noisy = record(plane, Path(scratch) / "8bit", options.recordings, 255, NOISE_GREY, rng)
        rows = [told(noisy_row(name, noisy, pythons[name], options.threads)) for name in options.programs]
        exact = {name: [name] for name in own}
        for dot_px in DOTS_PX:
            other = speckled_plane((SIZE_PX, SIZE_PX), dot_px, MARGIN_PX, rng)
            clean = record(other, Path(scratch) / f"{dot_px}px", 1, 65535, 0.0, rng)
            for name in own:
                exact[name].append(told(clean_cell(name, clean, pythons[name], options.threads)))
    head = markdown_row("bias without noise / mpx", *(f"dots of {dot_px} px" for dot_px in DOTS_PX))
    tables = {
        "tracking": markdown_table(NOISY_HEAD, list(filter(None, rows))),
        "interpolation": markdown_table(head, [markdown_row(*cells) for cells in exact.values()]),
    }
    print("\n\n".join(tables.values()))
    if options.docs:
        write_marked(options.docs / "performance.md", tables)


def sine_motion() -> Motion:
    """Translation and rotation in phase, about the middle of the image; frame 0 is at rest."""
    swing = np.sin(2.0 * np.pi * CYCLES_PER_FRAME * np.arange(FRAMES))
    return Motion(np.outer(swing, PEAK_PX), PEAK_RAD * swing, np.full(2, (SIZE_PX - 1) / 2.0))


def record(
    plane: Plane, folder: Path, count: int, full_scale: int, noise_grey: float, rng: np.random.Generator
) -> Recording:
    """Store `count` series with noise; a pixel at either end of the scale would no longer be exact and is refused."""
    folders = tuple(folder / f"{number}" for number in range(count))
    for target in folders:
        target.mkdir(parents=True)
    for frame in range(FRAMES):
        image = full_scale * render(plane, sine_motion(), frame)
        for target in folders:
            grey = np.rint(image + noise_grey * rng.standard_normal(image.shape))
            if grey.min() < 0 or grey.max() > full_scale:
                raise ValueError(f"plane: expected grey levels of 0 to {full_scale}, found {grey.min()} {grey.max()}")
            tifffile.imwrite(target / f"{frame:04d}.tif", grey.astype(np.uint8 if full_scale == 255 else np.uint16))
    return Recording(plane, folders, full_scale, noise_grey)


def run_program(name: str, recording: Recording, python: Path, threads: int) -> Result | None:
    """Track all series of a recording with one program; None, and the reason printed, where it is not installed."""
    series = []
    for folder in recording.folders:
        done = run_once(name, folder, python, threads)
        if done.returncode == NOT_INSTALLED:
            print(f"{name} skipped: {done.stderr.strip()}", file=sys.stderr)
            return None
        if done.returncode != 0:
            raise RuntimeError(f"{name}: {done.stderr[-2000:]}")
        with np.load(result_file(folder)) as file:
            series.append(dict(file))
    centres = series[0]["centres"]
    positions = np.stack([one["positions"][1:] for one in series])
    user_s, wall_s = (sum(float(one[key]) for one in series) for key in ("user_s", "wall_s"))
    error = positions - true_positions(centres)[1:]
    return Result(centres, positions, error, user_s, wall_s, str(series[0]["version"]))


def run_once(name: str, folder: Path, python: Path, threads: int) -> subprocess.CompletedProcess[str]:
    """Track one series with one program in a process of its own, which leaves the `result_file`."""
    grid = [f"--{key}={getattr(GRID, key)}" for key in ("first", "step", "count", "radius")]
    limits = {key: str(threads) for key in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    return subprocess.run(
        [python.absolute(), ADAPTERS, name, folder, result_file(folder), *grid],
        cwd=folder,  # where a program may leave what it likes
        env={**os.environ, **limits, "OMP_WAIT_POLICY": "passive"},
        capture_output=True,
        text=True,
        check=False,
    )


def result_file(folder: Path) -> Path:
    """Where a program leaves what it found in one series."""
    return folder / "result.npz"


def noisy_row(name: str, recording: Recording, python: Path, threads: int) -> str:
    """Return what one program makes of frames with noise, nothing where it is not installed."""
    result = run_program(name, recording, python, threads)
    if result is None:
        return ""
    points = result.error[..., 0].size
    relative = result.error / bound(recording, result.centres)
    return markdown_row(
        f"{name} ({result.version})",
        f"{1e6 * result.user_s / points:.3g}",
        f"{pair_scatter(relative):.3f}",
        f"{series_scatter(relative):.3f}",
        f"{frame_bias(result.error) / MPX:.2f}",
    )


def clean_cell(name: str, recording: Recording, python: Path, threads: int) -> str:
    """Return the bias within a pixel of one program without noise, empty if it is not installed."""
    result = run_program(name, recording, python, threads)
    return "" if result is None else f"{pixel_bias(result) / MPX:.3f}"


def rounding_rows(rng: np.random.Generator) -> list[str]:
    """Rows of the table of float32, for noise as that of the first table and none, not even rounding."""
    plane = speckled_plane((SIZE_PX, SIZE_PX), DOT_PX, MARGIN_PX, rng)
    shifted = Motion(np.concatenate([np.zeros((1, 2)), SHIFTS_PX]), np.zeros(1 + len(SHIFTS_PX)), np.zeros(2))
    exact = [render(plane, shifted, frame) for frame in range(len(shifted))]
    line = np.arange(GRID.first, GRID.last, STEP, dtype=np.float64)
    centres = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    rows = []
    for name, full_scale in (("none", 65535), ("12 bit", 4095), ("8 bit", 255)):
        sigma = NOISE_GREY * full_scale / 255
        images = [image * full_scale for image in exact]
        if name != "none":
            images = [np.rint(image + sigma * rng.standard_normal(image.shape)) for image in images]
        limit = np.sqrt(2.0) * bound(Recording(plane, (), full_scale, sigma), centres)
        for degree in (5, 7):
            errors = [found - SHIFTS_PX[:, None] for found in both_engines(images, centres, degree)]
            bias = [f"{np.abs(np.nanmean(error, axis=1)).max() / MPX:.4f}" for error in errors]
            scatter = [f"{np.sqrt(np.nanmean(np.nanvar(error / limit, axis=1))):.5f}" for error in errors]
            apart = np.nanmax(np.abs(errors[1] - errors[0])) / MPX
            cells = [name, f"{degree}", *bias, f"{apart:.4f}", *(["–", "–"] if name == "none" else scatter)]
            rows.append(markdown_row(*cells))
    return rows


def both_engines(images: list[FloatArray], centres: FloatArray, degree: int) -> list[FloatArray]:
    """Shifts (F,N,2) of the subsets in all images but the first: batched in float64, compiled with float32 values."""
    settings = TrackSettings(radius_px=GRID.radius, degree=degree)
    frames = splines_of(upload_images(images, "cpu")[1], degree, "float64")
    first, later = frames.coefficients[0].numpy(), replace(frames, coefficients=frames.coefficients[1:])
    start = np.zeros((len(images) - 1, len(centres), 6))
    precise = torch_reference(prepare_reference(Spline(first, degree), centres, GRID.radius), "cpu", "float64")
    batched = register_frames(precise, later, start, settings)
    reference = prepare_reference(spline_of_image(images[0], degree), centres, GRID.radius)
    compiled = [
        register(reference, spline_of_image(image, degree), rest, settings)
        for image, rest in zip(images[1:], start, strict=True)
    ]
    return [np.stack([one.warp[:, [0, 3]] for one in found]) for found in (batched, compiled)]


def true_positions(centres: FloatArray) -> FloatArray:
    """Positions (F,N,2) where the subsets' centres truly are."""
    motion = sine_motion()
    return np.stack([motion.positions(centres, frame) for frame in range(len(motion))])


def bound(recording: Recording, centres: FloatArray) -> FloatArray:
    """Smallest standard deviations (N,2) of x and y that the noise of one frame allows: σ_n/√Σ(∂f/∂x)²."""
    pixels = (2 * GRID.radius + 1) ** 2
    power = [pixels * subset_mean(slope**2, centres, GRID.radius) for slope in gradients(recording.plane)]
    return recording.noise / np.sqrt(np.stack(power, axis=-1))


def pair_scatter(relative: FloatArray) -> float:
    """Standard deviation of the errors (R,F−1,N,2), in bounds, about each frame's mean, over √2."""
    return float(np.sqrt(np.nanmean(np.nanvar(relative, axis=2)) / 2.0))


def series_scatter(relative: FloatArray) -> float:
    """Standard deviation over time of the errors (R,F−1,N,2), in bounds, about each subset's mean."""
    return float(np.sqrt(np.nanmean(np.nanvar(relative, axis=1, ddof=1))))


def frame_bias(error: FloatArray) -> float:
    """Largest mean error in px of a frame, all recordings averaged."""
    return float(np.max(np.abs(np.nanmean(error, axis=(0, 2)))))


def pixel_bias(result: Result) -> float:
    """Largest mean error in px of the positions that lie in one tenth of a pixel."""
    tenth = np.floor(10.0 * np.mod(result.positions, 1.0))
    means = [
        np.mean(result.error[..., axis][tenth[..., axis] == part])
        for axis in range(2)
        for part in range(10)
        if np.any(tenth[..., axis] == part)
    ]
    return float(np.max(np.abs(means)))


def told(line: str) -> str:
    """Return a row, shown as soon as it is there: all take a quarter of an hour."""
    print(line, file=sys.stderr, flush=True)
    return line


if __name__ == "__main__":
    main()
