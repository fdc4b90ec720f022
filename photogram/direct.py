"""Rigid motion fitted to the grey values of all pixels in all cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photogram.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape
from photogram.bspline import Spline, evaluate, mean_noise_gain, sample_line, slope_noise_gain, warp_inside
from photogram.geometry import RigidTransform, pose_rate
from photogram.images.noise import QUANTISATION, NoiseModel, fit_noise_model
from photogram.kernels import njit
from photogram.motion import MEDIAN_CHI2_OF_TWO, Patches, PlacedCamera, body_patches, patch_rates, patch_warps
from photogram.subsets.reference import RUN_SUMS, run_sums

SMALLEST_GAIN = 0.1  # of the reference's contrast, below which a cell shows nothing
LEAST_FILLED = 0.1  # of a cell, below which it is left out


@dataclass(frozen=True, eq=False, repr=False)
class Cells(
    Arrays,
    shapes="centre_px C 2; runs R 4; pixels 4 P; mean C; weight C; energy C; count C; removed C 2 6; hessian C 6 6; "
    "hessian_noise C 6 6",
):
    """The pixels of one reference image in C cells of side `side_px`, prepared once for a whole series.

    centre_px (C, 2); runs (R, 4): row, first column, length and place in `pixels` of every piece of a row; first
    (C + 1,): the cells' first runs. pixels (4, P): w, w·f̃, w·f_x, w·f_y with w = 1/noise variance and the grey value f̃
    without its weighted mean. mean (C,), weight (C,) = Σw, energy (C,) = Σw·f̃², count (C,) pixels. removed (C, 2, 6):
    weighted mean of each steepest-descent image of the affine warp and its regression on f̃. hessian (C, 6, 6): of what
    remains of them, gain and offset being free; hessian_noise (C, 6, 6): the part of it that is noise of the gradients.
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
        """Where the pixels are, for kernels: centres, runs, first runs, half the side less half a pixel."""
        return self.centre_px, self.runs, self.first, (self.side_px - 1) / 2

    @property
    def of_pixels(self) -> IntArray:
        """The cell of every pixel (P,)."""
        return np.repeat(np.repeat(np.arange(len(self.centre_px)), np.diff(self.first)), self.runs[:, 2])


@dataclass(frozen=True, eq=False)
class CellSums:
    """What another image says at given warps: gain (C,), misfit (C,) = Σw·r² of what gain and offset leave.

    slope (C, 6): Σw·SD·g over the projected steepest-descent images SD; misfit_noise (C,): expected misfit per unit of
    noise variance ratio. A cell that leaves the image, or has less than a tenth of its contrast there, is NaN.
    """

    gain: FloatArray
    misfit: FloatArray
    slope: FloatArray
    misfit_noise: FloatArray


def lay_cells(area: BoolArray, side_px: int) -> tuple[FloatArray, IntArray, IntArray]:
    """Return centres (C, 2), runs (R, 4) and first runs (C + 1,) of the squares that cover `area` (H, W).

    Squares stand side by side from the area's bounding box on; those less than a tenth filled are left out.
    """
    check_shape("area", area, (None, None))
    if side_px < 3:
        raise ValueError(f"side_px: expected at least 3, found {side_px}")
    rows, columns = np.flatnonzero(area.any(axis=1)), np.flatnonzero(area.any(axis=0))
    centres, runs, first, place = [], [], [0], 0
    for top in range(rows[0], rows[-1] + 1, side_px) if len(rows) else ():
        for left in range(columns[0], columns[-1] + 1, side_px):
            tile = area[top : top + side_px, left : left + side_px]
            if np.count_nonzero(tile) < LEAST_FILLED * side_px**2:
                continue
            edges = np.diff(tile.astype(np.int8), axis=1, prepend=0, append=0)
            (rows_in_tile, starts), stops = np.nonzero(edges == 1), np.nonzero(edges == -1)[1]
            for row, start, length in zip(rows_in_tile, starts, stops - starts, strict=True):
                runs.append((top + row, left + start, length, place))
                place += length
            centres.append((left + (side_px - 1) / 2, top + (side_px - 1) / 2))
            first.append(len(runs))
    return (
        np.array(centres, dtype=np.float64).reshape(-1, 2),
        np.array(runs, dtype=np.int64).reshape(-1, 4),
        np.array(first, dtype=np.int64),
    )


def prepare_cells(spline: Spline, area: BoolArray, side_px: int, noise: NoiseModel, full_scale: float) -> Cells:
    """Return the cells of `area` (H, W) (`lay_cells`) in the image `spline`; pixels at full scale have no weight.

    Steepest-descent images as in `reference.prepare_reference`, weighted by 1/noise variance of the pixel's grey value.
    White noise of the reference also makes gradients: with the slope's noise gain γ it adds γ·diag(n, Σdx², Σdy²)
    to the Hessian in each direction.
    """
    centre, runs, first = lay_cells(area, side_px)
    length = runs[:, 2]
    along = np.arange(int(length.sum())) - np.repeat(runs[:, 3], length)
    where = np.column_stack([np.repeat(runs[:, 1], length) + along, np.repeat(runs[:, 0], length)]).astype(np.float64)
    value, gradient = evaluate(spline, where)
    known = (value < full_scale - 0.5) & np.isfinite(value)
    pixels = np.stack([known, value, gradient[:, 0], gradient[:, 1]]).astype(np.float64)
    return _weighted((side_px, centre, runs, first), pixels, noise, spline.degree)


def reweighted(cells: Cells, noise: NoiseModel, degree: int) -> Cells:
    """Return the cells, of a spline of that degree, with the weights of another noise model."""
    weight = np.where(cells.pixels[0] > 0.0, cells.pixels[0], 1.0)
    pixels = np.concatenate([cells.pixels[:1] > 0.0, cells.pixels[1:] / weight])
    pixels[1] += cells.mean[cells.of_pixels]
    return _weighted((cells.side_px, cells.centre_px, cells.runs, cells.first), pixels, noise, degree)


def _weighted(
    layout: tuple[int, FloatArray, IntArray, IntArray], pixels: FloatArray, noise: NoiseModel, degree: int
) -> Cells:
    """Return cells whose pixels (4, P) are 1 or 0 for those without weight, grey value and gradient; overwrites them.

    layout: side, centres, runs and first runs.
    """
    _, centre, runs, first = layout
    pixels[0] = np.where(pixels[0] > 0.0, 1.0 / noise.variance(pixels[1]), 0.0)
    scalars, moments = np.zeros((len(centre), 4)), np.zeros((len(centre), 8, 8))
    extent = np.zeros((len(centre), 3))
    _prepare(centre, runs, first, pixels, scalars, moments, extent)
    mean, total, energy, count = np.ascontiguousarray(scalars.T)  # copied or not, kernels see them alike
    solid = energy > 0.0
    safe_total, safe_energy = np.where(solid, total, 1.0), np.where(solid, energy, 1.0)
    removed = np.stack([moments[:, 0, 2:] / safe_total[:, None], moments[:, 1, 2:] / safe_energy[:, None]], axis=1)
    hessian = moments[:, 2:, 2:] - np.einsum("c,ci,cj->cij", safe_total, removed[:, 0], removed[:, 0])
    hessian -= np.einsum("c,ci,cj->cij", safe_energy, removed[:, 1], removed[:, 1])
    gradient_noise = slope_noise_gain(degree) * np.concatenate([extent, extent], axis=1)[:, :, None] * np.eye(6)
    hessian[~solid], energy[~solid] = 0.0, np.nan
    return Cells(
        *layout, pixels, mean, total, energy, count.astype(np.int64), removed, hessian,
        np.where(solid[:, None, None], gradient_noise, 0.0),
    )  # fmt: skip


def compare_cells(cells: Cells, target: Spline, warp: FloatArray) -> CellSums:
    """Return what the image `target` says about the cells when each is sought at its affine warp (C, 6).

    misfit_noise is Σ over the cell's pixels of κ_g + gain², reduced by the two fitted parameters: κ_g, the noise that
    interpolation leaves (`noise_gain`), varies with the sub-pixel position and is averaged over nine points.
    """
    check_shape("warp", warp, (len(cells.centre_px), 6))
    sums = np.full((len(warp), 9), np.nan)
    _sum_cells(
        cells.layout, cells.pixels, cells.mean, (target.coefficients, target.degree), np.ascontiguousarray(warp), sums
    )
    gain = sums[:, 2] / cells.energy
    misfit = np.maximum(0.0, sums[:, 1] - sums[:, 0] ** 2 / cells.weight - gain**2 * cells.energy)
    slope = sums[:, 3:] - cells.removed[:, 0] * sums[:, :1] - cells.removed[:, 1] * sums[:, 2:3]
    known = gain > SMALLEST_GAIN
    slope[~known] = np.nan
    kept = _interpolated_noise(cells, warp, target.degree)
    return CellSums(np.where(known, gain, np.nan), misfit, slope, (cells.count - 2) * (kept + gain**2))


def pixel_residuals(cells: Cells, target: Spline, warp: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return grey value f and squared residual (g − a − b·f)²/(κ_g + b²) (P,) of every pixel, a, b fitted per cell."""
    grey = np.full(cells.pixels.shape[1], np.nan)
    _sample_cells(cells.layout, (target.coefficients, target.degree), np.ascontiguousarray(warp), grey)
    count = len(cells.centre_px)
    cell = cells.of_pixels
    weight = cells.pixels[0]
    centred = np.where(weight > 0.0, cells.pixels[1] / np.where(weight > 0.0, weight, 1.0), 0.0)
    known = np.isfinite(grey) & (weight > 0.0)
    filled, used = np.where(known, grey, 0.0), np.where(known, weight, 0.0)
    total = np.bincount(cell, used, count)
    offset = np.bincount(cell, used * filled, count) / np.where(total > 0.0, total, 1.0)
    gain = np.bincount(cell, used * filled * centred, count) / np.where(cells.energy > 0, cells.energy, 1.0)
    share = _interpolated_noise(cells, warp, target.degree) + gain**2
    residual = filled - offset[cell] - gain[cell] * centred
    squares = residual**2 / share[cell] * (cells.count / np.maximum(cells.count - 2, 1))[cell]
    return centred + cells.mean[cell], np.where(known, squares, np.nan)


def _interpolated_noise(cells: Cells, warp: FloatArray, degree: int) -> FloatArray:
    """Return the variance (C,) of interpolated white noise, averaged over nine points of each cell."""
    third = cells.side_px / 3.0
    line = np.array([-third, 0.0, third])
    dx, dy = (grid.ravel() for grid in np.meshgrid(line, line))
    return mean_noise_gain(cells.centre_px, warp, np.column_stack([dx, dy]), degree)


@njit()
def _prepare(centre, runs, first, pixels, scalars, moments, extent):  # type: ignore[no-untyped-def]
    """Weight the pixels in place; mean, Σw, Σw·f̃² and count, moments of [1 f̃ SD…], Σ(w·variance)·(1, dx², dy²)."""
    for c in range(centre.shape[0]):
        total, level = 0.0, 0.0
        for r in range(first[c], first[c + 1]):
            for p in range(runs[r, 3], runs[r, 3] + runs[r, 2]):
                total += pixels[0, p]
                level += pixels[0, p] * pixels[1, p] if pixels[0, p] > 0.0 else 0.0
        mean = level / total if total > 0.0 else 0.0
        row = np.empty(8)
        for r in range(first[c], first[c + 1]):
            dy = runs[r, 0] - centre[c, 1]
            for i in range(runs[r, 2]):
                p, dx = runs[r, 3] + i, runs[r, 1] + i - centre[c, 0]
                w = pixels[0, p]
                if w > 0.0:
                    f, fx, fy = pixels[1, p] - mean, pixels[2, p], pixels[3, p]
                    row[0], row[1], row[2], row[3], row[4] = 1.0, f, fx, fx * dx, fx * dy
                    row[5], row[6], row[7] = fy, fy * dx, fy * dy
                    for j in range(8):
                        for k in range(8):
                            moments[c, j, k] += w * row[j] * row[k]
                    extent[c, 0] += 1.0
                    extent[c, 1] += dx * dx
                    extent[c, 2] += dy * dy
                    scalars[c, 3] += 1.0
                    pixels[1, p], pixels[2, p], pixels[3, p] = w * f, w * fx, w * fy
                else:
                    pixels[1, p], pixels[2, p], pixels[3, p] = 0.0, 0.0, 0.0
        scalars[c, 0], scalars[c, 1], scalars[c, 2] = mean, total, moments[c, 1, 1]


@njit(inline="always")
def _sample_run(run, centre_x, centre_y, target, warp, grey):  # type: ignore[no-untyped-def]
    """Grey values of the target along one warped run."""
    coefficients, degree = target
    dx, dy = run[1] - centre_x, run[0] - centre_y
    x = run[1] + warp[0] + warp[1] * dx + warp[2] * dy
    y = run[0] + warp[3] + warp[4] * dx + warp[5] * dy
    sample_line(coefficients, degree, x, y, 1.0 + warp[1], warp[4], grey)


@njit()
def _sum_cells(shape, pixels, means, target, warps, sums):  # type: ignore[no-untyped-def]
    """Per cell Σw·g, Σw·g², Σw·f̃·g and the six Σw·SD·g, g without the mean of f; NaN where a cell leaves the image."""
    centres, runs, first, reach = shape
    for c in range(centres.shape[0]):
        centre_x, centre_y, warp = centres[c, 0], centres[c, 1], warps[c]
        if not warp_inside(target[0], centre_x, centre_y, reach, warp):
            continue
        line, row = np.empty(int(2 * reach) + 1), np.empty(RUN_SUMS)
        found, mean = np.zeros(9), means[c]
        for r in range(first[c], first[c + 1]):
            length, start = runs[r, 2], runs[r, 3]
            grey = line[:length]
            _sample_run(runs[r], centre_x, centre_y, target, warp, grey)
            dy = runs[r, 0] - centre_y
            run_sums(grey, mean, pixels, start, runs[r, 1] - centre_x, row)
            for k in range(5):
                found[k] += row[k]
            found[5] += row[3] * dy
            found[6] += row[5]
            found[7] += row[6]
            found[8] += row[5] * dy
        sums[c] = found


@njit()
def _sample_cells(shape, target, warps, grey):  # type: ignore[no-untyped-def]
    """Grey values of the target at all warped pixels."""
    centres, runs, first, reach = shape
    for c in range(centres.shape[0]):
        if warp_inside(target[0], centres[c, 0], centres[c, 1], reach, warps[c]):
            for r in range(first[c], first[c + 1]):
                piece = grey[runs[r, 3] : runs[r, 3] + runs[r, 2]]
                _sample_run(runs[r], centres[c, 0], centres[c, 1], target, warps[c], piece)


# The six components of a body's motion fitted to the grey values of all its pixels in all cameras at once.

REACH_CELLS = 4.0  # how far from the nearest known point a cell's surface may lie
EVALUATIONS = 12
LEFT_OVER = 0.02  # standard uncertainties that may remain between the motion and the converged one
LARGEST_STEP = 10.0  # standard uncertainties of a step that may be the last one
MISFIT = 3.0  # times the median misfit per pixel, beyond which a cell shows something else than the body
REJECTED = 25.0  # squared standard deviations by which a cell may move unlike the body
FEWEST_CELLS = 4
SINGULAR = 1e-12  # smallest eigenvalue of solvable information, scaled to a unit diagonal
SMALLEST_EXCESS = 1e-2
SMALLEST_MISFIT = 1e-12  # of the expected one: images without noise


@dataclass(frozen=True, eq=False, repr=False)
class BodyView(Arrays, shapes="rates C 6 6; information C 6 6; information_noise C 6 6; translation C 2 2"):
    """A body at rest as one camera sees it: cells of its image, their surface, and how both answer to a motion.

    rates (C, 6, 6): change of the affine warps by the six components; information (C, 6, 6): of each cell about them,
    per unit of gain², and information_noise (C, 6, 6) the part of it that is noise; translation (C, 2, 2): inverse
    Hessian of the cell's own shift.
    """

    camera: PlacedCamera
    cells: Cells
    patches: Patches
    rates: FloatArray
    information: FloatArray
    information_noise: FloatArray
    translation: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class DirectFit(Arrays, shapes="covariance 6 6"):
    """One frame: moved = body's motion from rest, covariance (6, 6) of x y z (m) and the rotation vector (rad).

    noise: variance of the grey values over the one that the noise models state; cells: used of all that are seen.
    """

    moved: RigidTransform
    covariance: FloatArray
    noise: float
    cells: int


def view_body(
    camera: PlacedCamera, image: tuple[Spline, BoolArray, float], known_m: FloatArray, side_px: int, noise: NoiseModel
) -> BodyView:
    """Return the body at rest in one camera: `image` = its spline, its textured area (H, W), and full scale.

    known_m (N, 3): points of its surface in the body's frame, from which that of all cells is interpolated.
    """
    spline, area, full_scale = image
    cells = prepare_cells(spline, area, side_px, noise, full_scale)
    patches = body_patches(camera, known_m, cells.centre_px, side_px / 4, REACH_CELLS * side_px)
    return _answering(camera, cells, patches, patch_rates(camera, patches))


def reweighted_view(view: BodyView, noise: NoiseModel, degree: int) -> BodyView:
    """Return the body at rest, seen as a spline of that degree, with the weights of another noise model."""
    return _answering(view.camera, reweighted(view.cells, noise, degree), view.patches, view.rates)


def _answering(camera: PlacedCamera, cells: Cells, patches: Patches, rates: FloatArray) -> BodyView:
    """Return a view whose rates are zero where they or the cell are not known, with what these tell."""
    known = np.isfinite(rates).all(axis=(1, 2)) & np.isfinite(cells.energy)
    rates = np.where(known[:, None, None], rates, 0.0)
    turned = np.swapaxes(rates, 1, 2)
    shift = cells.hessian[:, [[0, 0], [3, 3]], [[0, 3], [0, 3]]]
    solvable = known & (np.linalg.det(shift) > 0.0)
    shift = np.where(solvable[:, None, None], shift, np.eye(2))
    return BodyView(
        camera, cells, patches, rates, turned @ cells.hessian @ rates, turned @ cells.hessian_noise @ rates,
        np.where(solvable[:, None, None], np.linalg.inv(shift), np.nan),
    )  # fmt: skip


def image_noise(view: BodyView, target: Spline, moved: RigidTransform) -> NoiseModel:
    """Return the noise model that explains what is left over in one frame, the body having moved by `moved`."""
    grey, squares = pixel_residuals(view.cells, target, patch_warps(view.camera, view.patches, moved))
    known = np.isfinite(squares)
    return fit_noise_model(grey[known], squares[known])


def fit_direct(views: Sequence[BodyView], targets: Sequence[Spline], start: RigidTransform) -> DirectFit | None:
    """Return the motion that explains the images `targets`, one per view, beginning at `start`; None if there is none.

    Minimises Σ w·(g(W(p)) − a − b·f)² over all pixels of all cells, W(p) the cells' warps by the motion p, w = 1/noise
    variance, with an offset a and a gain b of each cell eliminated. Inverse-compositional Gauss-Newton (Baker, Matthews
    2004) on the rigid motions: T ← T·δ⁻¹ with (Σ b²·Bᵀ·H·B)·δ = Σ b·Bᵀ·slope, B the rates of the warps. The
    reference's noise makes Σ b²·Bᵀ·H·B too large by a known share, and every step too short by that share: iteration
    ends when the share of the step is below 0.02 standard uncertainties. Cells with more than three times the median
    misfit, and cells whose own remaining shift is beyond five scaled standard deviations, are left out.

    The covariance is s²·H′⁻¹·H·H′⁻¹ with H′ = H less what the reference's noise adds to it, and s² the misfit per
    expected misfit of the pixels used, at least that of rounding: a frame like the reference to the last bit has none.
    It is that of the frame's own noise; the reference's moves all frames alike.
    """
    moved = start
    for _ in range(EVALUATIONS):
        information, noise_part, slope = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
        misfit = expected = rounding = 0.0
        count = 0
        for view, target in zip(views, targets, strict=True):
            sums = compare_cells(view.cells, target, patch_warps(view.camera, view.patches, moved))
            used = _rigid_cells(view, sums)
            gain = sums.gain[used]
            information += np.einsum("c,cij->ij", gain**2, view.information[used])
            noise_part += np.einsum("c,cij->ij", gain**2, view.information_noise[used])
            slope += np.einsum("c,cij,ci->j", gain, view.rates[used], sums.slope[used])
            misfit += float(sums.misfit[used].sum())
            expected += float(sums.misfit_noise[used].sum())
            rounding += float(np.sum((QUANTISATION * sums.misfit_noise * view.cells.weight / view.cells.count)[used]))
            count += int(np.count_nonzero(used))
        if count < FEWEST_CELLS or not np.linalg.eigvalsh(_scaled(information))[0] > SINGULAR:
            return None
        scale = max(misfit, rounding) / expected
        step = np.asarray(np.linalg.solve(information, slope), dtype=np.float64)
        moved = moved @ RigidTransform.from_pose(step).inverse()
        size = float(np.sqrt(step @ information @ step / scale))
        share = scale * float(np.trace(np.linalg.solve(information, noise_part))) / 6.0
        if size < LARGEST_STEP and share * size < LEFT_OVER:
            covariance = scale * pose_covariance(information, scale * noise_part, moved)
            return DirectFit(moved, covariance, scale, count)
    return None


def rest_covariance(views: Sequence[BodyView], noise: float) -> FloatArray:
    """Return the covariance (6, 6) of a frame like the reference with `noise` times the models' noise variance."""
    information = np.sum([view.information.sum(axis=0) for view in views], axis=0)
    noise_part = np.sum([view.information_noise.sum(axis=0) for view in views], axis=0)
    return noise * pose_covariance(information, noise * noise_part, RigidTransform.identity())


def _rigid_cells(view: BodyView, sums: CellSums) -> BoolArray:
    """Return which cells (C,) show the body: their misfit and their own remaining shift are like the others'."""
    ratio = sums.misfit / sums.misfit_noise
    known = np.isfinite(ratio) & np.isfinite(sums.slope).all(axis=1) & np.isfinite(view.translation[:, 0, 0])
    known &= view.rates.any(axis=(1, 2))
    if not known.any():
        return known
    typical = max(float(np.median(ratio[known])), SMALLEST_MISFIT)
    known &= np.where(known, ratio, np.inf) <= MISFIT * typical
    slope = sums.slope[:, [0, 3]]
    squares = np.einsum("ci,cij,cj->c", slope, view.translation, slope) / typical
    limit = REJECTED * max(1.0, float(np.median(squares[known])) / MEDIAN_CHI2_OF_TWO)
    return np.asarray(known & (np.where(known, squares, np.inf) <= limit))


def _scaled(matrix: FloatArray) -> FloatArray:
    """Return a symmetric matrix scaled to a unit diagonal; zeros where the diagonal is not positive."""
    diagonal = np.diagonal(matrix)
    scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 0.0)
    return np.asarray(matrix * np.outer(scale, scale))


def pose_covariance(information: FloatArray, noise_part: FloatArray, moved: RigidTransform) -> FloatArray:
    """Return H′⁻¹·H·H′⁻¹ of a right-multiplied δ as that (6, 6) of translation and rotation vector of `moved`."""
    clean = information - noise_part
    if not np.linalg.eigvalsh(_scaled(clean))[0] > SMALLEST_EXCESS * np.linalg.eigvalsh(_scaled(information))[0]:
        clean = information
    inverse = np.linalg.inv(clean)
    turn = pose_rate(moved.pose) @ np.kron(np.eye(2), moved.rotation)
    return np.asarray(turn @ inverse @ information @ inverse @ turn.T)
