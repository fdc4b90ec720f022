"""The six components of a body's motion fitted to the grey values of all its pixels in all cameras at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photogram.arrays import Arrays, BoolArray, FloatArray
from photogram.bspline import Spline
from photogram.direct.cells import Cells, CellSums, compare_cells, pixel_residuals, prepare_cells, reweighted
from photogram.geometry import RigidTransform, pose_rate
from photogram.images.noise import QUANTISATION, NoiseModel, fit_noise_model
from photogram.motion import MEDIAN_CHI2_OF_TWO, Patches, PlacedCamera, body_patches, patch_rates, patch_warps

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
