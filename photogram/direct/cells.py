"""Pixels of a body's textured area in square cells, compared with another image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from photogram.bspline import (
    Spline,
    grey_gradients,
    grey_values,
    mean_noise_gain,
    noise_gain_table,
    sample_line,
    slope_noise_gain,
    warp_inside,
)
from photogram.images.noise import NoiseModel
from photogram.lanes import RUN_SUMS, run_sums
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.kernels import njit

SMALLEST_GAIN = 0.1  # of the reference's contrast, below which a cell does not show the body
MIN_FILLED_SHARE = 0.1  # of a cell, below which it is excluded


@dataclass(frozen=True, eq=False, repr=False)
class Cells(
    Arrays,
    shapes="centre_px C 2; runs R 4; pixels 4 P; mean C; weight C; energy C; count C; removed C 2 6; hessian C 6 6; "
    "hessian_noise C 6 6",
):
    """The pixels of one reference image in C square cells, prepared once for a series.

    Attributes
    ----------
    side_px : side of a cell.
    centre_px : (C, 2).
    runs : (R, 4) row, first column, length and first position in `pixels` of every piece of a row.
    first : (C + 1,) the cells' first runs.
    pixels : (4, P) w, w·f̃, w·f_x, w·f_y with w = 1/noise variance and the grey value f̃ without its weighted mean.
    mean : (C,) weighted mean of the grey values.
    weight : (C,) Σw.
    energy : (C,) Σw·f̃².
    count : (C,) pixels.
    removed : (C, 2, 6) weighted mean of each steepest-descent image of the affine warp, and its regression on f̃.
    hessian : (C, 6, 6) of the steepest-descent images after this removal, so that gain and offset are free.
    hessian_noise : (C, 6, 6) contribution of the gradients' noise to it.
    """

    side_px: int
    centre_px: FloatArray
    runs: IntArray
    first: IntArray
    pixels: FloatArray
    mean: FloatArray
    weight: FloatArray
    energy: FloatArray
    count: IntArray
    removed: FloatArray
    hessian: FloatArray
    hessian_noise: FloatArray

    @property
    def layout(self) -> tuple[FloatArray, IntArray, IntArray, float]:
        """For kernels: centres, runs, first runs, half the side less half a pixel."""
        return self.centre_px, self.runs, self.first, (self.side_px - 1) / 2

    @property
    def of_pixels(self) -> IntArray:
        """The cell of every pixel (P,)."""
        return np.repeat(np.repeat(np.arange(len(self.centre_px)), np.diff(self.first)), self.runs[:, 2])


class CellSums(NamedTuple):
    """Comparison of C cells with A other images at given warps, as arrays or tensors.

    NaN for a cell that leaves the image, or has less than a tenth of its contrast there.

    Attributes
    ----------
    gain : (A, C) contrast relative to the reference.
    misfit : (A, C) Σw·r² of the residuals after gain and offset.
    slope : (A, C, 6) Σw·SD·g over the projected steepest-descent images SD.
    misfit_noise : (A, C) expected misfit per unit of the noise variance ratio.
    """

    gain: Any
    misfit: Any
    slope: Any
    misfit_noise: Any


def lay_cells(area: BoolArray, side_px: int) -> tuple[FloatArray, IntArray, IntArray]:
    """Return centres (C,2), runs (R,4) and first runs of squares that cover `area`.

    The squares lie next to each other from the bounding box of `area` (H, W) on. Those less than a tenth filled are
    excluded.
    """
    check_shape("area", area, (None, None))
    if side_px < 3:
        raise ValueError(f"side_px: expected at least 3, found {side_px}")
    if not area.any():
        return np.empty((0, 2)), np.empty((0, 4), np.int64), np.zeros(1, np.int64)
    top, left = (int(np.argmax(area.any(axis=axis))) for axis in (1, 0))
    box = np.pad(area[top:, left:], ((0, 0), (1, 1)))
    inside, across = box[:, 1:-1], (np.arange(box.shape[1] - 2) % side_px)
    row, start = np.nonzero(inside & (~box[:, :-2] | (across == 0)))
    stop = np.nonzero(inside & (~box[:, 2:] | (across == side_px - 1)))[1]
    tile, length = row // side_px * box.shape[1] + start // side_px, stop - start + 1
    filled = np.bincount(tile, length) >= MIN_FILLED_SHARE * side_px**2
    order = np.argsort(tile, kind="stable")
    order = order[filled[tile[order]]]
    length, (cells, first) = length[order], np.unique(tile[order], return_index=True)
    corner = np.column_stack([left + side_px * (cells % box.shape[1]), top + side_px * (cells // box.shape[1])])
    runs = np.column_stack([top + row[order], left + start[order], length, np.cumsum(length) - length])
    return corner + (side_px - 1) / 2, runs, np.append(first, len(runs))


def pixel_coordinates(runs: IntArray) -> FloatArray:
    """Return column and row (P, 2) of every pixel of runs (R, 4) (`Cells`)."""
    length = runs[:, 2]
    along = np.arange(int(length.sum())) - np.repeat(runs[:, 3], length)
    coordinates = np.column_stack([np.repeat(runs[:, 1], length) + along, np.repeat(runs[:, 0], length)])
    return coordinates.astype(np.float64)


def prepare_cells(spline: Spline, area: BoolArray, side_px: int, noise: NoiseModel, full_scale: float) -> Cells:
    """Return the cells of `area` (H, W) (`lay_cells`) in the image `spline`.

    Pixels at full scale have no weight. Steepest-descent images as in `reference.prepare_reference`, weighted by
    1/noise variance of the pixel's grey value. White noise of the reference also makes gradients: with the slope's
    noise gain γ it adds γ·diag(n, Σdx², Σdy²) to the Hessian in each direction.
    """
    centre, runs, first = lay_cells(area, side_px)
    column, row = pixel_coordinates(runs).T.astype(np.intp)
    value, *gradient = (part[row, column] for part in (grey_values(spline), *grey_gradients(spline)))
    pixels = np.stack([value < full_scale - 0.5, value, *gradient]).astype(np.float64)
    return _weighted((side_px, centre, runs, first), pixels, noise, spline.degree)


def reweight_cells(cells: Cells, noise: NoiseModel, degree: int) -> Cells:
    """Return the cells with the weights of another noise model.

    `degree`: of the spline.
    """
    weight = np.where(cells.pixels[0] > 0.0, cells.pixels[0], 1.0)
    pixels = np.concatenate([cells.pixels[:1] > 0.0, cells.pixels[1:] / weight])
    pixels[1] += cells.mean[cells.of_pixels]
    return _weighted((cells.side_px, cells.centre_px, cells.runs, cells.first), pixels, noise, degree)


def select_cells(cells: Cells, which: IntArray) -> Cells:
    """Return some of the cells, in the order of `which`."""
    runs = [cells.runs[cells.first[cell] : cells.first[cell + 1]] for cell in which.tolist()]
    selected = np.concatenate(runs)
    pixels = np.concatenate([np.arange(start, start + length) for start, length in selected[:, [3, 2]].tolist()])
    selected[:, 3] = np.cumsum(selected[:, 2]) - selected[:, 2]
    first = np.cumsum([0, *map(len, runs)])
    names = ("centre_px", "mean", "weight", "energy", "count", "removed", "hessian", "hessian_noise")
    parts = {name: getattr(cells, name)[which] for name in names}
    return replace(cells, runs=selected, first=first, pixels=np.ascontiguousarray(cells.pixels[:, pixels]), **parts)


def _weighted(
    layout: tuple[int, FloatArray, IntArray, IntArray], pixels: FloatArray, noise: NoiseModel, degree: int
) -> Cells:
    """Return weighted cells from pixels (4, P).

    Rows of pixels: 1, or 0 for those without weight; grey value; gradient. layout: side, centres, runs and first runs.
    """
    side_px, centre, runs, first = layout
    weight = np.where(pixels[0] > 0.0, 1.0 / noise.variance(pixels[1]), 0.0)
    used, (_, grey, along, down) = weight > 0.0, np.where(weight > 0.0, pixels, 0.0)
    cell = np.repeat(np.repeat(np.arange(len(centre)), np.diff(first)), runs[:, 2])
    begin = runs[first[:-1], 3]
    dx, dy = (pixel_coordinates(runs) - centre[cell]).T
    total = np.add.reduceat(weight, begin)
    mean = np.add.reduceat(weight * grey, begin) / np.where(total > 0.0, total, 1.0)
    grey = np.where(used, grey - mean[cell], 0.0)
    rows = np.stack([used, grey, along, along * dx, along * dy, down, down * dx, down * dy])
    moments = np.stack([np.add.reduceat(weight * row * rows, begin, axis=1) for row in rows]).transpose(2, 0, 1)
    energy = moments[:, 1, 1].copy()
    count, *spread = np.add.reduceat(used * np.stack([np.ones_like(dx), dx * dx, dy * dy]), begin, axis=1)
    extent = np.stack([count, *spread], axis=1)
    pixels = np.stack([weight, weight * grey, weight * along, weight * down])
    solid = energy > 0.0
    safe_total, safe_energy = np.where(solid, total, 1.0), np.where(solid, energy, 1.0)
    removed = np.stack([moments[:, 0, 2:] / safe_total[:, None], moments[:, 1, 2:] / safe_energy[:, None]], axis=1)
    hessian = moments[:, 2:, 2:] - np.einsum("c,ci,cj->cij", safe_total, removed[:, 0], removed[:, 0])
    hessian -= np.einsum("c,ci,cj->cij", safe_energy, removed[:, 1], removed[:, 1])
    gradient_noise = slope_noise_gain(degree) * np.concatenate([extent, extent], axis=1)[:, :, None] * np.eye(6)
    hessian[~solid], energy[~solid] = 0.0, np.nan
    return Cells(
        side_px, centre, runs, first, pixels, mean, total, energy, count.astype(np.int64), removed, hessian,
        np.where(solid[:, None, None], gradient_noise, 0.0),
    )  # fmt: skip


def compare_cells(cells: Cells, target: Spline, warp: FloatArray) -> CellSums:
    """Compare the cells with the one image `target`, each at its affine warp (C, 6).

    misfit_noise is Σ over the cell's pixels of κ_g + gain², reduced by the two fitted parameters. κ_g, the variance of
    interpolated noise (`noise_gain`), varies with the sub-pixel position and is averaged over nine points.
    """
    check_shape("warp", warp, (len(cells.centre_px), 6))
    gain, misfit, slope = np.full(len(warp), np.nan), np.full(len(warp), np.nan), np.full((len(warp), 6), np.nan)
    reference = cells.pixels, cells.mean, cells.weight, cells.energy, cells.removed
    image = target.coefficients, target.degree
    _compare(cells.layout, reference, image, np.ascontiguousarray(warp), (gain, misfit, slope))
    interpolated = _interpolated_noise(cells, warp, target.degree)
    return CellSums(gain[None], misfit[None], slope[None], ((cells.count - 2) * (interpolated + gain**2))[None])


def pixel_residuals(cells: Cells, target: Spline, warp: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return grey value f and normalised residual (P,) of every pixel.

    (g − a − b·f)/√(κ_g + b²). a and b are fitted per cell.
    """
    grey = np.full(cells.pixels.shape[1], np.nan, np.float32)
    _sample_cells(cells.layout, (target.coefficients, target.degree), np.ascontiguousarray(warp), grey)
    count = len(cells.centre_px)
    cell = cells.of_pixels
    weight = cells.pixels[0]
    centred = np.where(weight > 0.0, cells.pixels[1] / np.where(weight > 0.0, weight, 1.0), 0.0)
    valid = np.isfinite(grey) & (weight > 0.0)
    filled, used = np.where(valid, grey, 0.0), np.where(valid, weight, 0.0)
    total = np.bincount(cell, used, count)
    offset = np.bincount(cell, used * filled, count) / np.where(total > 0.0, total, 1.0)
    gain = np.bincount(cell, used * filled * centred, count) / np.where(cells.energy > 0, cells.energy, 1.0)
    share = _interpolated_noise(cells, warp, target.degree) + gain**2
    residual = filled - offset[cell] - gain[cell] * centred
    scale = np.sqrt(cells.count / np.maximum(cells.count - 2, 1) / share)
    return centred + cells.mean[cell], np.where(valid, residual * scale[cell], np.nan)


def _interpolated_noise(cells: Cells, warp: FloatArray, degree: int) -> FloatArray:
    """Return the variance (C,) of interpolated white noise, averaged over nine points of each cell."""
    return np.asarray(mean_noise_gain(np, cells.centre_px, warp, nine_points(cells.side_px), noise_gain_table(degree)))


@cache
def nine_points(side_px: int) -> FloatArray:
    """Return offsets (9, 2) from a cell's centre to the pixels of its noise.

    Interpolated noise depends on the sub-pixel position, which pixels share.
    """
    last = side_px - 1
    near = round(side_px / 6 - 0.5)
    line = np.array([near, last // 2, last - near]) - last / 2.0
    dx, dy = (grid.ravel() for grid in np.meshgrid(line, line))
    return np.column_stack([dx, dy])


@njit()
def _compare(shape, reference, target, warps, found):  # type: ignore[no-untyped-def]
    """Fill gain, misfit and slope of every cell with contrast in the image."""
    (centres, runs, first, reach), (coefficients, degree) = shape, target
    (pixels, means, weights, energies, removed), (gains, misfits, slopes) = reference, found
    line, row, sums = np.empty(int(2 * reach) + 1, np.float32), np.empty(RUN_SUMS), np.empty(9)
    for c in range(centres.shape[0]):
        warp, mean, energy = warps[c], means[c], energies[c]
        inside = warp_inside(coefficients, centres[c, 0], centres[c, 1], reach, warp)
        if not (inside and energy > 0.0):
            continue
        # Σw·g, Σw·g², Σw·f̃·g and the six Σw·SD·g, g without the mean of f
        sums[:] = 0.0
        for r in range(first[c], first[c + 1]):
            dx, dy, length = runs[r, 1] - centres[c, 0], runs[r, 0] - centres[c, 1], runs[r, 2]
            start = _warped(runs[r, 1], runs[r, 0], centres[c, 0], centres[c, 1], warp)
            sample_line(coefficients, degree, start, (1.0 + warp[1], warp[4]), line, (0, length))
            run_sums(line, mean, pixels, (runs[r, 3], length), dx, row)
            for k in range(5):
                sums[k] += row[k]
            sums[5] += row[3] * dy
            sums[6] += row[5]
            sums[7] += row[6]
            sums[8] += row[5] * dy
        gain = sums[2] / energy
        misfits[c] = max(0.0, sums[1] - sums[0] ** 2 / weights[c] - gain**2 * energy)
        if gain > SMALLEST_GAIN:
            gains[c] = gain
            for k in range(6):
                slopes[c, k] = sums[3 + k] - removed[c, 0, k] * sums[0] - removed[c, 1, k] * sums[2]


@njit()
def _sample_cells(shape, target, warps, grey):  # type: ignore[no-untyped-def]
    """Sample the target at all warped pixels."""
    (centres, runs, first, reach), (coefficients, degree) = shape, target
    for c in range(centres.shape[0]):
        warp = warps[c]
        if warp_inside(coefficients, centres[c, 0], centres[c, 1], reach, warp):
            for r in range(first[c], first[c + 1]):
                start = _warped(runs[r, 1], runs[r, 0], centres[c, 0], centres[c, 1], warp)
                span = runs[r, 3], runs[r, 3] + runs[r, 2]
                sample_line(coefficients, degree, start, (1.0 + warp[1], warp[4]), grey, span)


@njit()
def _warped(x, y, centre_x, centre_y, warp):  # type: ignore[no-untyped-def]
    """Return the position of a pixel of a cell in the target."""
    dx, dy = x - centre_x, y - centre_y
    return x + warp[0] + warp[1] * dx + warp[2] * dy, y + warp[3] + warp[4] * dx + warp[5] * dy
