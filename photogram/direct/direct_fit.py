"""Six components of a body's motion fitted to the grey values in all cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photogram.bspline import Spline
from photogram.direct.cells import (
    Cells,
    CellSums,
    compare_cells,
    pixel_coordinates,
    pixel_residuals,
    prepare_cells,
    reweight_cells,
    select_cells,
)
from photogram.direct.surface import (
    AT_REST,
    Patches,
    PlacedCamera,
    Shapes,
    body_patches,
    patch_rates,
    patch_warps,
    warps_of_points,
)
from photogram.frame_statistics import spread_choice
from photogram.geometry import RigidTransform, rotation_vector_rate
from photogram.images.noise import QUANTISATION, NoiseModel, fit_noise_model, noise_notices
from photogram.motion import MEDIAN_CHI2_OF_TWO
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import Notice

REACH_CELLS = 4.0  # distance from the nearest triangulated point within which a cell's surface is extrapolated
MAX_STEPS = 12  # Gauss-Newton steps; usually two or three are needed
UNCORRECTED_SHARE = 0.3  # share of the shortening of a step by noise that may remain after its correction
DECIMATION, MIN_DECIMATED = 3, 24  # a coarse fit uses one cell of this many; cells that every view needs then
COARSE_STEPS, MAX_COARSE_STEP = 4, 100.0  # steps of a coarse fit; length of its last step in standard uncertainties
MAX_REMAINING_STEP = 0.02  # standard uncertainties between the result and the converged motion, at most
MAX_FINAL_STEP = 20.0  # length of the last step in standard uncertainties, at most
MAX_MISFIT_RATIO = 3.0  # times the median misfit per expected misfit, above which a cell is rejected
REJECT_CHI2 = 25.0  # squared remaining shift over its variance above which a cell is rejected
MIN_CELLS = 4  # three determine six components, without a check
MIN_EIGENVALUE = 1e-12  # smallest eigenvalue of solvable information, scaled to a unit diagonal
MIN_EIGENVALUE_SHARE = 1e-2  # share of the smallest eigenvalue that remains without the noise part, at least
MAX_TURN = 0.05
"""Rotation, or displacement over the distance, of a body from the motion of its rates, up to which these are used. A
step along the line of sight then errs by half of its square, 0.12 %."""
MIN_MISFIT_RATIO = 1e-12  # misfit over the expected one, for images without noise


@dataclass(frozen=True, eq=False, repr=False)
class BodyView(Arrays, shapes="rates C 6 p; information C p p; information_noise C p p; inverse_shift_hessian C 2 2"):
    """A body at rest in one camera: cells, their surface, and their derivatives.

    Attributes
    ----------
    rates : (C, 6, p) derivatives of the affine warps with respect to the p parameters: six components of motion and
        p - 6 amplitudes of shapes. They are those near the motion `rates_at`.
    information : (C, p, p) information of each cell about the parameters, for unit gain.
    information_noise : (C, p, p) contribution of the reference's noise to `information`.
    inverse_shift_hessian : (C, 2, 2) inverse Hessian of the cell's shift, NaN if singular.
    added_motion : rotations (C, 5, 3, 3) and shifts (C, 5, 3) of the patches' points in one frame, applied after the
        motion of the body; None if the points only move with the body.
    shapes : of the body's deformation, None for none.
    """

    camera: PlacedCamera
    cells: Cells
    patches: Patches
    rates: FloatArray
    information: FloatArray
    information_noise: FloatArray
    inverse_shift_hessian: FloatArray
    added_motion: tuple[FloatArray, FloatArray] | None = None
    shapes: Shapes | None = None
    rates_at: RigidTransform = AT_REST

    @cached_property
    def middle(self) -> tuple[FloatArray, float]:
        """The middle (3,) of the patches at rest, and its depth in the camera."""
        middle = np.nanmean(self.patches.points_m[:, 0], axis=0)
        return middle, float(self.camera.camera_from_body.apply(middle)[2])

    def is_near(self, moved: RigidTransform) -> bool:
        """Return whether the rates apply to a motion."""
        turn = 3.0 - float(np.sum(moved.rotation * self.rates_at.rotation))  # 2 - 2·cos of the angle
        middle, depth = self.middle
        shift = moved.apply(middle) - self.rates_at.apply(middle)
        return turn < MAX_TURN**2 and float(shift @ shift) < (MAX_TURN * depth) ** 2

    def near(self, moved: RigidTransform) -> BodyView:
        """Return the view with rates that apply near a motion.

        A point that leaves the surface is displaced in the image by its parallax, which turns with the body.
        """
        if self.is_near(moved):
            return self
        rates = patch_rates(self.camera, self.patches, self.shapes, moved)
        view = with_jacobians(self.camera, self.cells, self.patches, rates, self.shapes)
        return replace(view, added_motion=self.added_motion, rates_at=moved)

    @cached_property
    def rounding(self) -> FloatArray:
        """Misfit by rounding (C,) over that by noise."""
        return QUANTISATION * self.cells.weight / self.cells.count

    @cached_property
    def shift_rates(self) -> FloatArray:
        """Slopes (2·C, 6) of the cells' shifts by the motion, for unit gain."""
        return np.asarray(self.cells.hessian[:, ::3] @ self.rates[:, :, :6]).reshape(-1, 6)

    @cached_property
    def steady(self) -> BoolArray:
        """Which cells (C,) can determine a motion."""
        return np.isfinite(self.inverse_shift_hessian[:, 0, 0]) & self.rates[:, :, :6].any(axis=(1, 2))

    def warps(self, moved: RigidTransform) -> FloatArray:
        """Return the affine warps (C,6) of the cells after the motion `moved` of the body."""
        if self.added_motion is None:
            return patch_warps(self.camera, self.patches, moved)
        moved_points = np.einsum("ckij,ckj->cki", self.added_motion[0], moved.apply(self.patches.points_m))
        return warps_of_points(self.camera, self.patches, moved_points + self.added_motion[1])


@dataclass(frozen=True, eq=False, repr=False)
class DirectFit(Arrays, shapes="covariance 6 6; amplitude S; amplitude_covariance S S; misfit V 2; scores C 6"):
    """Fit of one frame to its grey values.

    Attributes
    ----------
    moved : motion of the body from rest.
    covariance : (6, 6) of x y z (m) and the rotation vector (rad).
    noise_ratio : variance of the grey values over that of the noise models.
    cells : number of cells used.
    amplitude : (S,) of the body's shapes in addition to that motion (`shapes.ShapeAmplitudes`).
    amplitude_covariance : (S, S).
    misfit : (V, 2) of each view, Σw·r² and the value expected of noise.
    scores : (C, 6) of the cells of all views (`ViewResiduals`), float32.
    """

    moved: RigidTransform
    covariance: FloatArray
    noise_ratio: float
    cells: int
    amplitude: FloatArray
    amplitude_covariance: FloatArray
    misfit: FloatArray
    scores: NDArray[np.float32]


def view_body(
    camera: PlacedCamera,
    image: tuple[Spline, BoolArray, float],
    surface_m: FloatArray,
    side_px: int,
    noise: NoiseModel,
    shapes: Shapes | None = None,
) -> BodyView:
    """Return the body at rest in one camera.

    `image`: its spline, its textured area (H, W), and full scale. surface_m (N, 3): points of its surface in the body's
    frame, from which the surface of all cells is interpolated. `shapes`: possible deformations.
    """
    spline, area, full_scale = image
    cells = prepare_cells(spline, area, side_px, noise, full_scale)
    patches = body_patches(camera, surface_m, cells.centre_px, side_px / 4, REACH_CELLS * side_px)
    return with_jacobians(camera, cells, patches, patch_rates(camera, patches, shapes), shapes)


def reweight_view(view: BodyView, noise: NoiseModel, degree: int) -> BodyView:
    """Return the view, its pixels weighted by another noise model.

    `degree`: degree of the spline of its image.
    """
    return with_cells(view, reweight_cells(view.cells, noise, degree))


def with_cells(view: BodyView, cells: Cells) -> BodyView:
    """Return the view with other pixels in the same cells."""
    return with_jacobians(view.camera, cells, view.patches, view.rates, view.shapes)


def with_jacobians(
    camera: PlacedCamera, cells: Cells, patches: Patches, rates: FloatArray, shapes: Shapes | None = None
) -> BodyView:
    """Return a view with the information of its cells, rates zero where undefined."""
    finite = np.isfinite(rates).all(axis=(1, 2)) & np.isfinite(cells.energy)
    rates = np.where(finite[:, None, None], rates, 0.0)
    transposed = np.swapaxes(rates, 1, 2)
    shift = cells.hessian[:, [[0, 0], [3, 3]], [[0, 3], [0, 3]]]
    solvable = finite & (np.linalg.det(shift) > 0.0)
    shift = np.where(solvable[:, None, None], shift, np.eye(2))
    return BodyView(
        camera, cells, patches, rates, transposed @ cells.hessian @ rates, transposed @ cells.hessian_noise @ rates,
        np.where(solvable[:, None, None], np.linalg.inv(shift), np.nan), shapes=shapes,
    )  # fmt: skip


def image_noise(
    view: BodyView, target: Spline, moved: RigidTransform, where: str
) -> tuple[NoiseModel, tuple[Notice, ...]]:
    """Return the noise model that explains the residuals of one frame after the motion `moved`.

    With it, the notices of noise that contradicts it in the camera `where`.
    """
    grey, residual = pixel_residuals(view.cells, target, view.warps(moved))
    finite = np.isfinite(residual)
    grey, residual, row = grey[finite], residual[finite], pixel_coordinates(view.cells.runs)[finite, 1]
    return fit_noise_model(grey, residual**2), tuple(noise_notices(grey, residual, row.astype(np.int64), where))


def fit_direct(views: Sequence[BodyView], targets: Sequence[Spline], start: RigidTransform) -> DirectFit | None:
    """Fit the motion that explains the images `targets`, one per view, from `start`.

    None if the fit does not converge or the components are not determined. It minimises Σ w·(g(W(p)) − a − b·f)² over
    all pixels of all cells. W(p) are the cells' warps by the motion p, and w = 1/noise variance. Offset a and gain b of
    each cell are eliminated.

    The method is inverse-compositional Gauss-Newton (Baker, Matthews 2004) on the rigid motions: T ← T·δ⁻¹ with
    H′·δ = Σ b·Bᵀ·slope, B the rates of the warps, renewed where the body turns (`BodyView.near`). The reference's noise
    makes H = Σ b²·Bᵀ·H·B too large by a computable share, which H′ excludes. A third of that share of a step may
    remain, and iteration ends when this is below 0.02 standard uncertainties. Cells with more than three times the
    median misfit are rejected. So are cells whose remaining shift exceeds five scaled standard deviations.

    The covariance is s²·H′⁻¹·H·H′⁻¹ with H′ = H less the contribution of the reference's noise, and s² the misfit per
    expected misfit of the pixels used, at least that of rounding: a frame equal to the reference has no misfit. It is
    the covariance due to the frame's noise; the reference's noise shifts all frames equally.

    Shapes do not affect the motion: the same sums determine their amplitudes in addition to it
    (`estimate_shape_amplitudes`).
    """
    moved = start
    for _ in range(MAX_STEPS):
        views = views_near(views, moved)
        step = _step(views, targets, moved)
        if step is None:
            return None
        moved = moved @ RigidTransform.from_pose(step.pose).inverse()
        if step.final:
            return direct_fit(moved, step)
    return None


def views_near(views: Sequence[BodyView], moved: RigidTransform) -> tuple[BodyView, ...]:
    """Return the views with rates that apply near a motion."""
    return tuple(view.near(moved) for view in views)


def direct_fit(moved: RigidTransform, step: FitStep) -> DirectFit:
    """Return the fit of one frame after its final step to the motion `moved`."""
    ratio, information, noise_part = float(step.noise_ratio), step.sums.information, step.sums.noise_part
    size = slice(6)
    covariance = ratio * pose_covariance(
        information[size, size], ratio * noise_part[size, size], moved.rotation, moved.pose[3:]
    )
    shapes = estimate_shape_amplitudes(step.pose, step.sums.slope, (information, noise_part), ratio)
    misfit = np.array([one.misfit for one in step.residuals])
    scores = np.concatenate([one.scores for one in step.residuals]).astype(np.float32)
    return DirectFit(moved, covariance, ratio, int(step.sums.cells), *shapes, misfit, scores)


def coarse_fit(views: Sequence[BodyView], targets: Sequence[Spline], start: RigidTransform) -> RigidTransform | None:
    """Return an approximate motion, fitted to decimated views (`decimate`), from which to start `fit_direct`.

    None if the fit does not converge. From this start, `fit_direct` with all cells usually needs only one step.
    """
    moved = start
    for _ in range(COARSE_STEPS):
        views = views_near(views, moved)
        step = _step(views, targets, moved)
        if step is None:
            return None
        moved = moved @ RigidTransform.from_pose(step.pose).inverse()
        if step.length < MAX_COARSE_STEP:
            return moved
    return None


def decimate(views: Sequence[BodyView]) -> tuple[BodyView, ...]:
    """Return the views with a third of their cells, () for too few."""
    some = []
    for view in views:
        which = np.flatnonzero(spread_choice(np.arange(len(view.rates)), 1.0 / DECIMATION))
        if len(which) < MIN_DECIMATED:
            return ()
        chosen = {name: getattr(view.patches, name)[which] for name in ("centre_px", "points_m", "rest_px")}
        per_cell = ("rates", "information", "information_noise", "inverse_shift_hessian")
        parts = {name: getattr(view, name)[which] for name in per_cell}
        cells = select_cells(view.cells, which)
        some.append(replace(view, cells=cells, patches=replace(view.patches, **chosen), **parts))
    return tuple(some)


class CellTotals(NamedTuple):
    """Sums over the cells that show the body, for A frames, as arrays or tensors.

    Attributes
    ----------
    information, noise_part, slope : (A, p, p), (A, p, p), (A, p).
    misfit : (A,).
    expected, rounding : (A,) misfits expected of noise and of rounding.
    cells : (A,) their number.
    """

    information: Any
    noise_part: Any
    slope: Any
    misfit: Any
    expected: Any
    rounding: Any
    cells: Any


class ViewResiduals(NamedTuple):
    """Residuals of A frames in one view after a step, as arrays or tensors.

    Attributes
    ----------
    misfit : (A, 2) Σw·r² over the cells used, and the value expected of noise.
    scores : (A, C, 6) derivatives of half the misfit of each cell by the motion, 0 for a rejected cell. Their sum over
        all views is 0.
    """

    misfit: Any
    scores: Any


class FitStep(NamedTuple):
    """Gauss-Newton steps of A frames, as arrays or tensors.

    Attributes
    ----------
    pose : (A, 6) the step δ, shift and rotation vector.
    length : (A,) length of the step in standard uncertainties.
    solvable : (A,) whether the components are determined.
    final : (A,) whether the motion after the step is the converged one.
    noise_ratio : (A,) variance of the grey values over that of the noise models.
    sums : over all cells.
    residuals : of each view after the step; () for a step in memory that is not final.
    """

    pose: Any
    length: Any
    solvable: Any
    final: Any
    noise_ratio: Any
    sums: CellTotals
    residuals: tuple[ViewResiduals, ...]


def _step(views: Sequence[BodyView], targets: Sequence[Spline], moved: RigidTransform) -> FitStep | None:
    """Return the Gauss-Newton step from a motion, None if the components are not determined."""
    both = zip(views, targets, strict=True)
    compared = [compare_cells(view.cells, target, view.warps(moved)) for view, target in both]
    with np.errstate(divide="ignore", invalid="ignore"):
        *parts, sums, residuals = solve_step(np, views, compared)
    of_views = tuple(ViewResiduals(one.misfit[0], one.scores[0]) for one in residuals)
    step = FitStep._make((*(part[0] for part in parts), CellTotals._make(part[0] for part in sums), of_views))
    return step if step.solvable else None


def solve_step(xp: Any, views: Sequence[Any], compared: Sequence[CellSums]) -> FitStep:
    """Return the Gauss-Newton steps of A frames from the comparison of each view's cells.

    `xp`: numpy, or torch for views on its device. Cells are first judged at the start, then after the step of the
    accepted cells, so that the choice depends little on the start.
    """
    pose = xp.zeros_like(compared[0].slope[:, 0])
    identity = xp.eye(6, dtype=pose.dtype, device=pose.device)
    used = list[Any]()
    for _ in range(2):
        before, used = used, [rigid_cells(xp, view, cells, pose) for view, cells in zip(views, compared, strict=True)]
        if xp is np and before and all(map(np.array_equal, used, before)):
            break  # as usual; on a GPU to ask costs more than to compute again
        totals = [_sum_cells(xp, *each) for each in zip(views, compared, used, strict=True)]
        sums = CellTotals(*(sum(parts) for parts in zip(*totals, strict=True)))
        of_motion, noise_part = sums.information[:, :6, :6], sums.noise_part[:, :6, :6]
        lowest = xp.linalg.eigvalsh(_scaled(of_motion, xp))[:, 0]
        solvable = (sums.cells >= MIN_CELLS) & (lowest > MIN_EIGENVALUE)
        information = xp.where(solvable[:, None, None], of_motion, identity)
        ratio = xp.where(solvable, xp.maximum(sums.misfit, sums.rounding) / sums.expected, 1.0)
        clean = information - xp.where(solvable, ratio, 0.0)[:, None, None] * noise_part
        enough = solvable & (xp.linalg.eigvalsh(_scaled(clean, xp))[:, 0] > MIN_EIGENVALUE_SHARE * lowest)
        system = xp.where(enough[:, None, None], clean, information)
        pose = xp.linalg.solve(system, sums.slope[:, :6, None])[..., 0]
    length = xp.sqrt((pose[:, None] @ information @ pose[..., None])[:, 0, 0] / ratio)
    shortening = xp.einsum("aii->a", xp.linalg.solve(information, noise_part))
    left = ratio * shortening / 6.0 * xp.where(enough, UNCORRECTED_SHARE, 1.0)
    final = solvable & (length < MAX_FINAL_STEP) & (left * length < MAX_REMAINING_STEP)
    parts = zip(views, compared, used, totals, strict=True)
    skipped = xp is np and not final.any()  # as above: a GPU is not asked
    residuals = () if skipped else tuple(_view_residuals(xp, *each, (pose, ratio)) for each in parts)
    return FitStep(pose, length, solvable, final, ratio, sums, residuals)


def _view_residuals(
    xp: Any, view: Any, cells: CellSums, used: Any, totals: CellTotals, step: tuple[Any, Any]
) -> ViewResiduals:
    """Return the residuals of a view after a step (A, 6) and noise ratio (A,)."""
    pose, ratio = step
    gain = xp.where(used, cells.gain, 0.0)
    slope = gain[..., None] * xp.where(used[..., None], cells.slope, 0.0)
    information = view.information[:, :6, :6] - ratio[:, None, None, None] * view.information_noise[:, :6, :6]
    scores = xp.einsum("ack,ckp->acp", slope, view.rates[:, :, :6])
    scores = scores - gain[..., None] ** 2 * xp.einsum("acpq,aq->acp", information, pose)
    of_motion = xp.einsum("apq,aq->ap", totals.information[:, :6, :6], pose)
    misfit = totals.misfit + ((of_motion - 2.0 * totals.slope[:, :6]) * pose).sum(-1)
    return ViewResiduals(xp.stack([misfit, totals.expected], -1), scores)


def _sum_cells(xp: Any, view: Any, cells: CellSums, used: Any) -> CellTotals:
    """Return the sums over the `used` (A, C) cells of a view."""
    size = view.rates.shape[2]
    gain, misfit, expected = (xp.where(used, part, 0.0) for part in (cells.gain, cells.misfit, cells.misfit_noise))
    slope = gain[..., None] * xp.where(used[..., None], cells.slope, 0.0)
    information, noise_part = (
        (gain**2 @ part.reshape(-1, size * size)).reshape(-1, size, size)
        for part in (view.information, view.information_noise)
    )
    sums = misfit.sum(-1), expected.sum(-1), (expected * view.rounding).sum(-1), used.sum(-1)
    return CellTotals(information, noise_part, slope.reshape(len(gain), -1) @ view.rates.reshape(-1, size), *sums)


def phase_rotated_pose(
    views: Sequence[BodyView],
    targets: Sequence[Spline],
    fit: DirectFit,
    phase_factors: Sequence[ComplexArray],
    departure: FloatArray,
) -> ComplexArray:
    """Return the pose (K,p) of a fitted frame, its cells weighted by complex phase factors.

    `phase_factors`: for each view, K factors of its cells (K, C). `departure` (6,): fitted motion from the motion to
    which the result is relative. The sums over the cells are Σ factor·(H_c·departure − Bᵀ·slope), with the slopes that
    remain after the fit. E (`estimator_matrix`) converts them into motion and shapes. The result is Σ factor·H_c·ξ_c
    over Σ H_c, where ξ_c is the small motion of a cell.
    """
    size = views[0].rates.shape[2]
    sums, whole = np.zeros((len(phase_factors[0]), size), np.complex128), np.zeros((size, size))
    for view, target, turn in zip(views, targets, phase_factors, strict=True):
        compared = compare_cells(view.cells, target, view.warps(fit.moved))
        used = rigid_cells(np, view, compared, np.zeros((1, 6)))[0]
        gain = np.where(used, compared.gain[0], 0.0)
        information = gain[:, None, None] ** 2 * (view.information - fit.noise_ratio * view.information_noise)
        slope = np.where(used[:, None], compared.slope[0], 0.0) * gain[:, None]
        sums += turn @ (information[:, :, :6] @ departure - np.einsum("ckp,ck->cp", view.rates, slope))
        whole += information.sum(axis=0)
    return np.asarray(sums @ estimator_matrix(whole).T)


def estimator_matrix(information: FloatArray) -> FloatArray:
    """Return E (p,p), which converts slopes summed over cells into motion and shapes."""
    estimate = np.linalg.inv(information)
    estimate[:6] = 0.0
    estimate[:6, :6] = np.linalg.inv(information[:6, :6])
    return np.asarray(estimate)


def row_information(view: BodyView) -> FloatArray:
    """Return the information (side, p, p) of each pixel row of a view's cells.

    N = Σ w·ã·aᵀ over the pixels of this row in all cells. The change of the grey value by motion and shapes is a, and ã
    is a with the gain and offset of the cell eliminated. The sums for motions x_r that differ from row to row are Σ
    N_r·x_r.
    """
    cells, size = view.cells, view.rates.shape[2]
    column, row = pixel_coordinates(cells.runs).T
    cell = cells.of_pixels
    along, down = column - cells.centre_px[cell, 0], row - cells.centre_px[cell, 1]
    cell_row = np.rint(down + (cells.side_px - 1) / 2).astype(np.int64)
    order = np.argsort(cell_row, kind="stable")
    parts = np.searchsorted(cell_row[order], np.arange(cells.side_px + 1))
    removed, information = cells.removed @ view.rates, np.zeros((cells.side_px, size, size))
    for k, (start, stop) in enumerate(pairwise(parts.tolist())):
        selected = order[start:stop]
        rates, (w, w_f, w_x, w_y) = view.rates[cell[selected]], cells.pixels[:, selected]
        offset = np.stack([np.ones(len(selected)), along[selected], down[selected]])
        u, v = (np.einsum("kn,nkp->np", offset, part) for part in (rates[:, :3], rates[:, 3:]))
        change = w_x[:, None] * u + w_y[:, None] * v
        projected = change - np.einsum("kn,nkp->np", np.stack([w, w_f]), removed[cell[selected]])
        information[k] = projected.T @ (change / np.where(w > 0.0, w, 1.0)[:, None])
    return information


def rest_covariance(views: Sequence[BodyView], noise_ratio: float) -> FloatArray:
    """Return the covariance (6,6) of a frame equal to the reference, for a noise ratio.

    `noise_ratio`: variance of the grey values over that of the noise models.
    """
    information, noise_part = (part[:6, :6] for part in rest_information(views))
    return noise_ratio * pose_covariance(information, noise_ratio * noise_part, np.eye(3), np.zeros(3))


def rest_information(views: Sequence[BodyView]) -> tuple[FloatArray, FloatArray]:
    """Return the information (p,p) of a frame equal to the reference, and its noise part."""
    information = np.sum([view.information.sum(axis=0) for view in views], axis=0)
    return information, np.sum([view.information_noise.sum(axis=0) for view in views], axis=0)


def estimate_shape_amplitudes(
    pose: FloatArray, slope: FloatArray, information: tuple[FloatArray, FloatArray], noise_ratio: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return amplitudes (...,S) of shapes in addition to the motion, with covariance (...,S,S).

    `pose` (..., 6) and `slope` (..., p) are those of the last step. `information` (..., p, p) comes with its noise
    part, which is multiplied by `noise_ratio` (...). The remaining slopes of the shapes after the motion, g − H·δ, are
    divided by their remaining information: the amplitudes of a joint fit. The motion is the one without shapes, with
    which they are therefore uncorrelated (Frisch and Waugh 1933, Econometrica 1, 387). NaN where motion and shapes
    cannot be separated.
    """
    shapes, each = slope.shape[-1] - 6, np.asarray(noise_ratio)[..., None, None]
    if not shapes:
        return np.zeros((*slope.shape[:-1], 0)), np.zeros((*slope.shape[:-1], 0, 0))
    clean = without_noise(information[0], each * information[1])
    separable = (np.linalg.eigvalsh(_scaled(clean))[..., 0] > MIN_EIGENVALUE)[..., None, None]
    clean = np.where(separable, clean, np.eye(6 + shapes))
    mixed = clean[..., 6:, :6]
    inverse = np.linalg.inv(clean[..., 6:, 6:] - mixed @ np.linalg.solve(clean[..., :6, :6], mixed.mT))
    amplitude = -inverse @ (slope[..., 6:] - (mixed @ pose[..., None])[..., 0])[..., None]
    covariance = each * (inverse + inverse.mT) / 2.0
    return np.where(separable, amplitude, np.nan)[..., 0], np.where(separable, covariance, np.nan)


def rigid_share(views: Sequence[BodyView]) -> FloatArray:
    """Return the motion (6,S) that best explains a unit of each shape."""
    information, _ = rest_information(views)
    return np.asarray(np.linalg.solve(information[:6, :6], information[:6, 6:]))


def rigid_cells(xp: Any, view: Any, cells: CellSums, step: Any) -> Any:
    """Return which cells (A, C) show the body, by their misfit and remaining shift.

    `step` (A, 6): motion of the body that is subtracted from the shifts. `xp`: numpy or torch.
    """
    ratio = cells.misfit / cells.misfit_noise
    finite = xp.isfinite(ratio) & xp.isfinite(cells.slope).all(-1) & view.steady
    typical = xp.clip(_median(xp, ratio, finite), MIN_MISFIT_RATIO, None)[:, None]
    finite &= ratio <= MAX_MISFIT_RATIO * typical
    carried = (step @ view.shift_rates.T).reshape(*ratio.shape, 2)
    shift = cells.slope[..., ::3] - cells.gain[..., None] * carried
    squares = (shift[..., None] * shift[..., None, :] * view.inverse_shift_hessian).sum((-2, -1)) / typical
    limit = REJECT_CHI2 * xp.clip(_median(xp, squares, finite) / MEDIAN_CHI2_OF_TWO, 1.0, None)
    return finite & (squares <= limit[:, None])


def _median(xp: Any, values: Any, finite: Any) -> Any:
    """Return the median (A,) of the finite values (A, C), infinite for none."""
    ordered = xp.sort(xp.where(finite, values, xp.inf), -1)
    ordered = ordered if xp is np else ordered.values
    count, row = xp.clip(finite.sum(-1), 1, None), xp.arange(len(ordered), device=ordered.device)
    return 0.5 * (ordered[row, (count - 1) // 2] + ordered[row, count // 2])


def _scaled(matrix: Any, xp: Any = np) -> Any:
    """Return symmetric matrices (...,p,p) scaled to a unit diagonal, zero where not positive."""
    diagonal = xp.einsum("...ii->...i", matrix)
    scale = xp.where(diagonal > 0.0, 1.0 / xp.sqrt(xp.where(diagonal > 0.0, diagonal, 1.0)), 0.0)
    return matrix * (scale[..., :, None] * scale[..., None, :])


def without_noise(information: FloatArray, noise_part: FloatArray) -> FloatArray:
    """Return `information` (..., p, p) without its noise part, unchanged if that were nearly singular."""
    clean = information - noise_part
    enough = MIN_EIGENVALUE_SHARE * np.linalg.eigvalsh(_scaled(information))[..., 0]
    positive = np.linalg.eigvalsh(_scaled(clean))[..., 0] > enough
    return np.where(positive[..., None, None], clean, information)


def pose_covariance(
    information: FloatArray, noise_part: FloatArray, rotation: FloatArray, vector_rad: FloatArray
) -> FloatArray:
    """Return the covariance (..., 6, 6) of shift and rotation vector, per noise ratio.

    It is H′⁻¹·H·H′⁻¹ of the right-multiplied step δ (`fit_direct`), converted to shift and rotation vector.
    `information` and `noise_part` are (..., 6, 6); rotation (..., 3, 3) of the motion and its vector (..., 3).
    """
    inverse = np.linalg.inv(without_noise(information, noise_part))
    turn = np.zeros((*rotation.shape[:-2], 6, 6))
    turn[..., :3, :3] = rotation
    turn[..., 3:, 3:] = rotation_vector_rate(vector_rad) @ rotation
    return np.asarray(turn @ inverse @ information @ inverse @ turn.mT)
