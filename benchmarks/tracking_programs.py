"""Programs that track subsets, all called alike: TIFF frames in, positions and the time that they took out.

Usage: python tracking_programs.py PROGRAM FOLDER RESULT.npz --first 52 --step 10 --count 93 --radius 15

Called by tracking.py, one process per program, with the interpreter that has it; needs numpy and that program only.
Before the clock starts, the program tracks the first four frames, so that nothing is imported or compiled on it.
Exit status 3, the reason on stderr: the program is not installed there.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

NOT_INSTALLED = 3
WARM_UP_FRAMES = 4
Array = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Grid:
    """count × count square subsets of (2·radius+1)² px, step apart, the first centred at (first, first)."""

    first: int
    step: int
    count: int
    radius: int

    @property
    def last(self) -> int:
        """Column and row of the last centre."""
        return self.first + self.step * (self.count - 1)

    @property
    def centres(self) -> Array:
        """Centres (N,2) in px, row by row."""
        line = np.linspace(self.first, self.last, self.count)
        return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Found:
    """Positions (F,N,2) in px of the subsets centred at centres (N,2) in frame 0; NaN where one was lost."""

    centres: Array
    positions: Array


def shakercal(frames: list[Path], grid: Grid, degree: int) -> Found:
    """Ours, with splines of `degree` 3 or 5."""
    from photogram.images.image_files import open_sequence
    from photogram.subsets.icgn import TrackSettings
    from photogram.subsets.track import track_sequence

    settings = TrackSettings(radius_px=grid.radius, step_px=grid.step, degree=degree)
    return Found(grid.centres, track_sequence(open_sequence(frames), grid.centres, settings).position_px)


def pyvale(frames: list[Path], grid: Grid, filter_px: int) -> Found:
    """The subset correlation of pyvale: affine, cubic B-spline; `filter_px`: kernel of its image filter, 1 for none."""
    from pyvale import dic

    mask = np.zeros(read_frame(frames[0]).shape, dtype=bool)
    inside = slice(grid.first - grid.radius, grid.last + grid.radius + 1)
    mask[inside, inside] = True
    with tempfile.TemporaryDirectory() as folder:
        dic.calculate_2d(
            reference=frames[0],
            deformed=frames[1:],
            roi_mask=mask,
            seed=[(grid.first + grid.last) // 2] * 2,
            subset_size=2 * grid.radius + 1,
            subset_step=grid.step,
            max_displacement=8,
            image_filter_kernel=filter_px,
            num_threads=int(os.environ["OMP_NUM_THREADS"]),
            output_basepath=folder,
            output_binary=True,
            print_level=0,
        )
        found = dic.import_2d(Path(folder) / "*.dic2d", delimiter=",", binary=True, layout="column", print_level=0)
    centres = np.column_stack([found.ss_x, found.ss_y]).astype(np.float64)
    moved = np.stack([found.u_px, found.v_px], axis=-1)
    return Found(centres, _with_first(centres, moved))


def pyidi(frames: list[Path], grid: Grid) -> Found:
    """The Lucas–Kanade method of pyidi: translation only."""
    return Found(grid.centres, grid.centres + lucas_kanade(frames, grid.centres, grid.radius))


def lucas_kanade(frames: Sequence[Path], centres: Array, radius: int) -> Array:
    """Return pyidi's displacements (F,N,2) in px; a margin of 4 px, since a frame moves by up to 2 px."""
    from pyidi import LucasKanade, VideoReader

    with tempfile.TemporaryDirectory() as folder:
        video = VideoReader(np.stack([read_frame(frame) for frame in frames]), root=folder)
        method = LucasKanade(video)
        method.configure(roi_size=(2 * radius + 1,) * 2, pad=4, verbose=0, show_pbar=False)
        method.set_points(centres[:, ::-1].astype(np.int64))
        moved = method.get_displacements(autosave=False)
    return np.asarray(np.swapaxes(moved[:, :, ::-1], 0, 1), dtype=np.float64)


def al_dic(frames: list[Path], grid: Grid) -> Found:
    """The local part of al-dic (no global step); its grid has steps of powers of 2, here the next below."""
    from al_dic import dicpara_default, run_aldic
    from al_dic.core.data_structures import GridxyROIRange

    images = [read_frame(frame) / 255.0 for frame in frames]
    edge = (grid.first, grid.last)
    settings = dicpara_default(
        winsize=2 * grid.radius,
        winstepsize=2 ** int(np.log2(grid.step)),
        winsize_min=2 ** int(np.log2(grid.step)),
        img_size=images[0].shape,
        gridxy_roi_range=GridxyROIRange(gridx=edge, gridy=edge),
        use_global_step=False,
        reference_mode="accumulative",
        show_plots=False,
    )
    masks = [np.ones(images[0].shape)] * len(images)
    result = run_aldic(settings, images, masks, progress_fn=lambda *_: None, compute_strain=False)
    centres = np.asarray(result.dic_mesh.coordinates_fem, dtype=np.float64)
    moved = np.stack([frame.U_accum.reshape(-1, 2) for frame in result.result_disp])
    return Found(centres, _with_first(centres, moved))


PROGRAMS: dict[str, tuple[str, Callable[[list[Path], Grid], Found]]] = {
    "shakercal cubic": ("shakercal", partial(shakercal, degree=3)),
    "shakercal quintic": ("shakercal", partial(shakercal, degree=5)),
    "shakercal septic": ("shakercal", partial(shakercal, degree=7)),
    "pyvale, no filter": ("pyvale", partial(pyvale, filter_px=1)),
    "pyvale, default": ("pyvale", partial(pyvale, filter_px=5)),
    "pyidi Lucas–Kanade": ("pyidi", pyidi),
    "al-dic local": ("al-dic", al_dic),
}


def read_frame(frame: Path) -> np.ndarray[Any, Any]:
    """Return one image as it is stored."""
    import cv2

    image = cv2.imread(str(frame), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{frame}: not a readable image")
    return image


def _with_first(centres: Array, moved: Array) -> Array:
    """Return positions (F,N,2) from the displacements (F−1,N,2) of all frames but the first."""
    displacements: Array = np.concatenate([np.zeros((1, *centres.shape)), moved])
    return centres + displacements


def user_s() -> float:
    """Return the user CPU time of this process and its finished children, in s."""
    return sum(resource.getrusage(who).ru_utime for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def installed_version(package: str) -> str:
    """Return the version of a package, or exit with the status `NOT_INSTALLED`."""
    try:
        return version(package)
    except PackageNotFoundError as error:
        print(error, file=sys.stderr)
        sys.exit(NOT_INSTALLED)


def main() -> None:
    """Track one folder of frames with one program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", choices=PROGRAMS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("result", type=Path)
    for name in ("first", "step", "count", "radius"):
        parser.add_argument(f"--{name}", type=int, required=True)
    options = parser.parse_args()
    grid = Grid(options.first, options.step, options.count, options.radius)
    frames = sorted(options.folder.glob("*.tif"))
    package, track = PROGRAMS[options.program]
    found_version = installed_version(package)
    track(frames[:WARM_UP_FRAMES], grid)
    wall_s, cpu_s = time.perf_counter(), user_s()
    found = track(frames, grid)
    wall_s, cpu_s = time.perf_counter() - wall_s, user_s() - cpu_s
    np.savez(
        options.result,
        centres=found.centres,
        positions=found.positions,
        wall_s=wall_s,
        user_s=cpu_s,
        version=found_version,
    )


if __name__ == "__main__":
    main()
