"""Programs that track one pair of images on one grid: two image files in, displacements and CPU time out.

Usage: python dic_programs.py PROGRAM REFERENCE DEFORMED RESULT.npz --columns 26 3974 --rows 170 330 --step 4 --radius 9

Called by dic_challenge.py, one process per program, with the interpreter that has it; needs numpy and that program
only. The program first tracks the last columns of the grid, so that no import or compilation is timed.
Exit status 3, the reason on stderr: the program is not installed there.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tracking_programs import installed_version, lucas_kanade, read_frame, user_s

WARM_UP_COLUMNS = 10
LARGEST_PX = 8  # displacement that a program has to search
Array = NDArray[np.float64]
Pair = tuple[Path, Path]


@dataclass(frozen=True)
class Grid:
    """Square subsets of (2·radius+1)² px; centres from the first to the last column and row, step apart."""

    columns: tuple[int, int]
    rows: tuple[int, int]
    step: int
    radius: int

    @property
    def centres(self) -> Array:
        """Centres (N,2) in px, row by row."""
        x, y = (np.arange(first, last + 1, self.step, dtype=np.float64) for first, last in (self.columns, self.rows))
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    @property
    def last_columns(self) -> Grid:
        """The grid of the last columns."""
        return replace(self, columns=(self.columns[1] - (WARM_UP_COLUMNS - 1) * self.step, self.columns[1]))


@dataclass(frozen=True)
class Found:
    """Centres (N,2), displacements (N,2) in px, NaN where there is none, and their stated standard uncertainties."""

    centres: Array
    shifts: Array
    u_px: Array | None = None


def shakercal(pair: Pair, grid: Grid, order: int) -> Found:
    """Ours, with quintic splines."""
    from photogram.bspline import spline_of_image
    from photogram.subsets.find import find_without_prediction
    from photogram.subsets.icgn import TrackSettings, noise_of_residual, position_covariance
    from photogram.subsets.reference import TrackStatus, prepare_reference

    first, second = (read_frame(path) for path in pair)
    settings = TrackSettings(radius_px=grid.radius, shape_order=order, reach_px=LARGEST_PX)
    reference = prepare_reference(spline_of_image(first), grid.centres, grid.radius, order)
    found = find_without_prediction(reference, first, (second, spline_of_image(second)), settings)
    noise = noise_of_residual(reference, found, settings.degree)
    covariance = position_covariance(reference, found, noise)[:, [0, 1], [0, 1]]
    place = [0, reference.removed.shape[2] // (4 if order == 2 else 2)]
    # That is the noise of the second image. The first one's adds the inverse of its gradients without their noise
    covariance += reference.inverse_hessian[:, place, place] * noise[:, None] ** 2
    shifts = np.where((found.status == TrackStatus.OK)[:, None], found.warp[:, [0, 3]], np.nan)
    return Found(grid.centres, shifts, np.sqrt(covariance))


def pyvale(pair: Pair, grid: Grid, shape: str, filter_px: int) -> Found:
    """The subset correlation of pyvale; `filter_px`: kernel of its image filter, 1 for none, 5 by default.

    Its subsets begin at multiples of the step. Cutting off up to step − 1 columns and rows makes them the grid's.
    """
    from pyvale import dic

    cut_x, cut_y = ((ends[0] - grid.radius) % grid.step for ends in (grid.columns, grid.rows))
    first, second = (np.ascontiguousarray(read_frame(path)[cut_y:, cut_x:]) for path in pair)
    mask = np.zeros(first.shape, dtype=bool)
    (left, right), (top, bottom) = grid.columns, grid.rows
    reach = grid.radius + 1
    mask[top - cut_y - reach + 1 : bottom - cut_y + reach, left - cut_x - reach + 1 : right - cut_x + reach] = True
    with tempfile.TemporaryDirectory() as folder:
        dic.calculate_2d(
            reference=first,
            deformed=second[None],
            roi_mask=mask,
            seed=[right - cut_x - grid.step * WARM_UP_COLUMNS // 2, (top + bottom) // 2 - cut_y],
            subset_size=2 * grid.radius + 1,
            subset_step=grid.step,
            shape_function=shape,
            max_displacement=LARGEST_PX,
            image_filter_kernel=filter_px,
            num_threads=int(os.environ["OMP_NUM_THREADS"]),
            output_basepath=folder,
            output_binary=True,
            print_level=0,
        )
        found = dic.import_2d(Path(folder) / "*.dic2d", delimiter=",", binary=True, layout="column", print_level=0)
    centres = np.column_stack([found.ss_x + cut_x, found.ss_y + cut_y]).astype(np.float64)
    return Found(centres, np.stack([found.u_px[0], found.v_px[0]], axis=-1))


def pyidi(pair: Pair, grid: Grid) -> Found:
    """The Lucas–Kanade method of pyidi: translation only."""
    return Found(grid.centres, lucas_kanade(pair, grid.centres, grid.radius)[1])


def al_dic(pair: Pair, grid: Grid, whole: bool) -> Found:
    """The local part of al-dic, or with `whole` its augmented Lagrangian, which makes the field compatible."""
    from al_dic import dicpara_default, run_aldic
    from al_dic.core.data_structures import GridxyROIRange

    images = [read_frame(frame) / 255.0 for frame in pair]
    settings = dicpara_default(
        winsize=2 * grid.radius,
        winstepsize=grid.step,
        winsize_min=grid.step,
        img_size=images[0].shape,
        gridxy_roi_range=GridxyROIRange(gridx=grid.columns, gridy=grid.rows),
        size_of_fft_search_region=LARGEST_PX,
        use_global_step=whole,
        reference_mode="accumulative",
        show_plots=False,
    )
    masks = [np.ones(images[0].shape)] * 2
    result = run_aldic(settings, images, masks, progress_fn=lambda *_: None, compute_strain=False)
    centres = np.asarray(result.dic_mesh.coordinates_fem, dtype=np.float64)
    return Found(centres, np.asarray(result.result_disp[0].U_accum, dtype=np.float64).reshape(-1, 2))


Run = Callable[[Pair, Grid], Found]
PROGRAMS: dict[str, tuple[str, Run]] = {
    "shakercal, translation": ("shakercal", partial(shakercal, order=0)),
    "shakercal, affine": ("shakercal", partial(shakercal, order=1)),
    "shakercal, quadratic": ("shakercal", partial(shakercal, order=2)),
    "pyvale, affine": ("pyvale", partial(pyvale, shape="AFFINE", filter_px=1)),
    "pyvale, affine, filtered": ("pyvale", partial(pyvale, shape="AFFINE", filter_px=5)),
    "pyvale, quadratic": ("pyvale", partial(pyvale, shape="QUAD", filter_px=1)),
    "pyvale, quadratic, filtered": ("pyvale", partial(pyvale, shape="QUAD", filter_px=5)),
    "pyidi, translation": ("pyidi", pyidi),
    "al-dic, affine": ("al-dic", partial(al_dic, whole=False)),
    "al-dic, affine, global": ("al-dic", partial(al_dic, whole=True)),
}


def main() -> None:
    """Track one pair with one program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", choices=PROGRAMS)
    for name in ("reference", "deformed", "result"):
        parser.add_argument(name, type=Path)
    for name in ("columns", "rows"):
        parser.add_argument(f"--{name}", type=int, nargs=2, required=True)
    for name in ("step", "radius"):
        parser.add_argument(f"--{name}", type=int, required=True)
    options = parser.parse_args()
    grid = Grid(tuple(options.columns), tuple(options.rows), options.step, options.radius)
    package, track = PROGRAMS[options.program]
    found_version = installed_version(package)
    pair = (options.reference, options.deformed)
    track(pair, grid.last_columns)
    cpu_s = user_s()
    found = track(pair, grid)
    cpu_s = user_s() - cpu_s
    u_px = np.full_like(found.shifts, np.nan) if found.u_px is None else found.u_px
    np.savez(
        options.result,
        points=found.centres,
        shifts=found.shifts,
        u_px=u_px,
        user_s=cpu_s,
        version=found_version,
    )


if __name__ == "__main__":
    main()
