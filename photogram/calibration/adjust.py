"""Bundle adjustment of cameras, poses and target geometry, and the influence of single views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from photogram.calibration.bundle import DRIFT_SPREAD, Bundle, ImageObservations, ModelledPixels, step_poses
from photogram.camera import LEFT, RIG_PARAMETERS, RIGHT, StereoRig
from photogram.geometry import RigidTransform
from shakercal._common.arrays import FloatArray, IntArray

_RIG = len(RIG_PARAMETERS)
_STEPS = 100  # usually 5 to 10 are sufficient; more with long focal lengths and large residuals
_DAMPING, _DAMPING_NEAR = 1e-3, 1e-9  # of the first step
_CONVERGED = 1e-3  # expected decrease of χ² that ends the iteration: parameters to 0.03 of their uncertainty


@dataclass(frozen=True, eq=False)
class RigPrior:
    """Prior of the rig's parameters (32,): expected values and standard deviations.

    `sigma` is infinite without prior information and zero for fixed parameters. The three of the rotation have no value
    and therefore no prior. `aspect_px` (left, right): standard deviation of fx − fy around the expected difference.
    """

    value: FloatArray
    sigma: FloatArray
    aspect_px: tuple[float, float]

    def deviations(self, parameters: FloatArray) -> FloatArray:
        """Return the deviations (Q + 2,) of parameters and fx − fy in standard deviations."""
        return np.asarray(self.slope @ (parameters - self.value)[self.free])

    @property
    def free(self) -> IntArray:
        """Indices (Q,) of the estimated parameters."""
        return np.flatnonzero(self.sigma > 0)

    @property
    def slope(self) -> FloatArray:
        """Derivative (Q + 2, Q) of `deviations` by the estimated parameters."""
        aspect = np.zeros((2, _RIG))
        for row, (camera, sigma) in enumerate(zip((LEFT, RIGHT), self.aspect_px, strict=True)):
            aspect[row, camera[:2]] = 1 / sigma, -1 / sigma
        return np.concatenate([np.diag(1 / self.sigma[self.free]), aspect[:, self.free]])


@dataclass(frozen=True, eq=False)
class AdjustedBundle:
    """The most likely bundle with covariances and normal equations.

    Attributes
    ----------
    bundle : The adjusted values.
    covariance : (32, 32), of the rig.
    shape_variance : (S,), of the target geometry's values.
    drift_variance : (D,), of the focal drift.
    pose_covariance : (V, 6, 6), of each target pose.
    normal : Normal equations at the minimum.
    """

    bundle: Bundle
    covariance: FloatArray
    shape_variance: FloatArray
    drift_variance: FloatArray
    pose_covariance: FloatArray
    normal: BundleNormalEquations


def adjust(start: Bundle, images: Sequence[ImageObservations], prior: RigPrior, near: bool = False) -> AdjustedBundle:
    """Minimise Σ rᵀ·C⁻¹·r over all points plus the squares of the priors.

    Levenberg–Marquardt. A start that is `near` the minimum, such as one adjusted with other weights, is almost
    undamped: damping would need many steps along poorly determined directions. All images have one radius of dots.
    Raises `ValueError` if the sum of squares does not converge.
    """
    bundle, damping, sides = start, _DAMPING_NEAR if near else _DAMPING, _sides(images)
    cost, seen = _evaluate(start, sides, prior)
    normal = _normal(start, sides, seen, prior)
    for _ in range(_STEPS):
        step, pose_steps, decrease = normal.step(damping)
        tried = bundle.with_step(step, pose_steps)
        found, seen = _evaluate(tried, sides, prior)
        if found <= cost * (1 + 1e-12):
            bundle, cost, damping = tried, min(found, cost), max(damping / 10, 1e-12)
            normal = _normal(bundle, sides, seen, prior)
            if decrease < _CONVERGED:
                return AdjustedBundle(bundle, *normal.covariance(), normal)
        else:
            damping = max(10 * damping, 1e-6)
    raise ValueError("the bundle adjustment did not converge; add views or remove doubtful images")


def residuals(bundle: Bundle, images: Sequence[ImageObservations]) -> list[FloatArray]:
    """Return the residuals found − modelled (N, 2) of each image."""
    return [image.position_px - image.model(bundle).pixel for image in images]


@dataclass(frozen=True, eq=False)
class _Side:
    """All images of one camera, with their points (N,) in one array."""

    side: int
    rows: tuple[slice, ...]
    view: IntArray
    point: IntArray
    position_px: FloatArray
    precision: FloatArray
    radius_m: float

    def by_drift(self, bundle: Bundle, seen: ModelledPixels) -> FloatArray:
        """Return the derivatives (N, 2, D) of the pixels by the focal drift."""
        if bundle.drift is None:
            return np.empty((*seen.pixel.shape, 0))
        centre = (bundle.rig.right if self.side else bundle.rig.left).matrix[:2, 2]
        by_growth = bundle.drift.relative_time[self.view, None] * (seen.pixel - centre)
        slope = np.zeros((*seen.pixel.shape, 2))
        slope[..., self.side] = by_growth / (1 + bundle.drift.growth(self.side, self.view))[:, None]
        return slope


def _sides(images: Sequence[ImageObservations]) -> list[_Side]:
    """Return the images by camera."""
    sides = []
    for side in sorted({image.side for image in images}):
        mine = [image for image in images if image.side == side]
        ends = np.cumsum([0, *(len(image.point) for image in mine)]).tolist()
        view = np.repeat([image.view for image in mine], np.diff(ends))
        point = np.concatenate([image.point for image in mine])
        position, precision = (
            np.concatenate([getattr(p, name) for p in mine]) for name in ("position_px", "precision")
        )
        rows = tuple(slice(*pair) for pair in pairwise(ends))
        sides.append(_Side(side, rows, view, point, position, precision, mine[0].radius_m))
    return sides


def _evaluate(bundle: Bundle, sides: Sequence[_Side], prior: RigPrior) -> tuple[float, list[ModelledPixels]]:
    """Return the sum of squares, infinite for a point behind a camera, and the pixels."""
    seen = [bundle.model_pixels(side.side, side.view, side.point, side.radius_m) for side in sides]
    deviation, shape = prior.deviations(bundle.rig.values), bundle.shape.value_m / bundle.shape.prior_m
    total = float(deviation @ deviation) + float(shape @ shape)
    if bundle.drift is not None:
        total += float(bundle.drift.value @ bundle.drift.value) / DRIFT_SPREAD**2
    for side, modelled in zip(sides, seen, strict=True):
        residual = side.position_px - modelled.pixel
        total += float(np.einsum("ni,nij,nj->", residual, side.precision, residual))
    return (total if np.isfinite(total) else np.inf), seen


@dataclass(frozen=True, eq=False)
class BundleNormalEquations:
    """Normal equations, view by view, of rig, geometry modes and drift (K,), pose and points.

    Attributes
    ----------
    parameter_index : (Q,), the rig's parameters, which are first among K.
    drifts : Number of drift parameters, which are last among K.
    matrix, side : (V, K + 6, K + 6) and (V, K + 6), of K and the pose.
    point, coupling, point_side : (V, P, 3, 3), (V, P, K + 6, 3), (V, P, 3); P = 0 if the target's points are not free.
    prior, prior_side, point_prior, point_prior_side : Prior information (K, K), (K,) and (P, 3).
    """

    parameter_index: IntArray
    drifts: int
    matrix: FloatArray
    side: FloatArray
    point: FloatArray
    coupling: FloatArray
    point_side: FloatArray
    prior: FloatArray
    prior_side: FloatArray
    point_prior: FloatArray
    point_prior_side: FloatArray

    def step(self, damping: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the damped steps of rig, geometry, drift and poses and the predicted decrease."""
        reduced = self.reduced(damping)
        step, point_step = reduced.solve()
        decrease = float(reduced.side @ step + (reduced.point_side * point_step).sum())
        return *self.spread(step, point_step), decrease

    def spread(self, step: FloatArray, point_step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the steps of rig, geometry and drift, and those of the poses (V, 6)."""
        rig, common, free = np.zeros(_RIG), len(self.prior), len(self.parameter_index)
        rig[self.parameter_index] = step[:free]
        return np.concatenate([rig, point_step.ravel(), step[free:common]]), step[common:].reshape(-1, 6)

    def covariance(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the covariance of rig (32, 32) and poses and variances of geometry and drift."""
        reduced, common, free = self.reduced(), len(self.prior), len(self.parameter_index)
        every = reduced.covariance()
        rig = np.zeros((_RIG, _RIG))
        rig[np.ix_(self.parameter_index, self.parameter_index)] = every[:free, :free]
        answer = reduced.answer  # (P, R, 3)
        points = np.einsum("pii->pi", reduced.point) + np.einsum("pri,rs,psi->pi", answer, every, answer, optimize=True)
        pose = [every[n : n + 6, n : n + 6] for n in range(common, len(every), 6)]
        modes, drift = np.split(np.diagonal(every)[free:common], [common - free - self.drifts])
        return rig, np.concatenate([points.ravel(), modes]), drift, np.array(pose)

    def reduced(self, damping: float = 0.0, without: Sequence[int] = ()) -> ReducedEquations:
        """Return the equations after elimination of the points, of all views except `without`."""
        common, points = len(self.prior), len(self.point_prior)
        remaining = [view for view in range(len(self.matrix)) if view not in without]
        size = common + 6 * len(remaining)
        matrix, coupling = np.zeros((size, size)), np.zeros((points, size, 3))
        matrix[:common, :common] = self.matrix[remaining, :common, :common].sum(axis=0) + self.prior
        coupling[:, :common] = self.coupling[remaining, :, :common].sum(axis=0)
        for row, view in zip(range(common, size, 6), remaining, strict=True):
            pose = slice(row, row + 6)
            matrix[pose, pose] = self.matrix[view, common:, common:]
            matrix[:common, pose] = self.matrix[view, :common, common:]
            matrix[pose, :common] = matrix[:common, pose].T
            coupling[:, pose] = self.coupling[view, :, common:]
        point = self.point[remaining].sum(axis=0) + self.point_prior[:, :, None] * np.eye(3)
        raised = 1.0 + damping
        matrix[np.diag_indices(size)] *= raised
        point[:, range(3), range(3)] *= raised
        inverse = np.linalg.inv(point)
        answer = coupling @ inverse
        flat = (array.transpose(1, 0, 2).reshape(size, -1) for array in (answer, coupling))
        side = self.side[remaining, :common].sum(axis=0) + self.prior_side
        return ReducedEquations(
            matrix - next(flat) @ next(flat).T,
            np.diagonal(matrix).copy(),
            answer,
            inverse,
            np.concatenate([side, self.side[remaining, common:].ravel()]),
            self.point_side[remaining].sum(axis=0) + self.point_prior_side,
        )


@dataclass(frozen=True, eq=False)
class ReducedEquations:
    """Equations (R, R) of rig, modes and poses after elimination of the points.

    Attributes
    ----------
    matrix : (R, R).
    diagonal : (R,), before the elimination.
    answer : (P, R, 3), minus the change of a point per change of the other unknowns.
    point : (P, 3, 3), covariance of a point if the other unknowns were exact.
    side, point_side : (R,) and (P, 3), right-hand sides before the elimination.
    """

    matrix: FloatArray
    diagonal: FloatArray
    answer: FloatArray
    point: FloatArray
    side: FloatArray
    point_side: FloatArray

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Return the solution (R,) and that of the points (P, 3)."""
        scale = 1 / np.sqrt(self.diagonal)
        less = self.side - np.einsum("pri,pi->r", self.answer, self.point_side)
        step = np.linalg.solve(self.matrix * np.outer(scale, scale), less * scale) * scale
        by_side = np.einsum("pij,pj->pi", self.point, self.point_side)
        return step, by_side - np.einsum("pri,r->pi", self.answer, step)

    def covariance(self) -> FloatArray:
        """Return the inverse (R, R)."""
        scale = 1 / np.sqrt(self.diagonal)
        inverse = np.linalg.inv(self.matrix * np.outer(scale, scale)) * np.outer(scale, scale)
        return np.asarray((inverse + inverse.T) / 2)


def _normal(
    bundle: Bundle, sides: Sequence[_Side], seen: Sequence[ModelledPixels], prior: RigPrior
) -> BundleNormalEquations:
    """Return the normal equations at the bundle."""
    shape, free, views = bundle.shape, prior.free, len(bundle.poses)
    drift = np.empty(0) if bundle.drift is None else bundle.drift.value
    points = len(shape.flat_m) if shape.free else 0
    common = len(free) + shape.modes.shape[2] + len(drift)
    single, ranged = slice(0, 3 * points), slice(3 * points, None)
    precision = np.concatenate([shape.prior_m**-2.0, np.full(len(drift), DRIFT_SPREAD**-2.0)])
    side = -precision * np.concatenate([shape.value_m, drift])
    prior_matrix = np.zeros((common, common))
    prior_matrix[: len(free), : len(free)] = prior.slope.T @ prior.slope
    prior_matrix[range(len(free), common), range(len(free), common)] = precision[ranged]
    normal = BundleNormalEquations(
        parameter_index=free,
        drifts=len(drift),
        matrix=np.zeros((views, common + 6, common + 6)),
        side=np.zeros((views, common + 6)),
        point=np.zeros((views, points, 3, 3)),
        coupling=np.zeros((views, points, common + 6, 3)),
        point_side=np.zeros((views, points, 3)),
        prior=prior_matrix,
        prior_side=np.concatenate([-prior.slope.T @ prior.deviations(bundle.rig.values), side[ranged]]),
        point_prior=precision[single].reshape(-1, 3),
        point_prior_side=side[single].reshape(-1, 3),
    )
    for one, modelled in zip(sides, seen, strict=True):
        _add_side(normal, bundle, one, modelled)
    return normal


def _add_side(normal: BundleNormalEquations, bundle: Bundle, side: _Side, seen: ModelledPixels) -> None:
    """Add the images of one camera to the normal equations."""
    by_modes = np.einsum("nki,nim->nkm", seen.by_point, bundle.shape.modes[side.point])
    by_rig = seen.by_rig(side.side)[..., normal.parameter_index]
    slope = np.concatenate([by_rig, by_modes, side.by_drift(bundle, seen), seen.by_pose], axis=-1)
    weighted, residual = side.precision @ slope, side.position_px - seen.pixel
    for rows in side.rows:
        view, image_weighted = side.view[rows.start], weighted[rows].reshape(-1, slope.shape[-1])
        normal.matrix[view] += slope[rows].reshape(image_weighted.shape).T @ image_weighted
        normal.side[view] += residual[rows].ravel() @ image_weighted
    if len(normal.point_prior):
        at = (side.view, side.point)
        weighted_point = side.precision @ seen.by_point
        normal.point[at] += np.einsum("nki,nkj->nij", seen.by_point, weighted_point)
        normal.coupling[at] += weighted.transpose(0, 2, 1) @ seen.by_point
        normal.point_side[at] += np.einsum("nki,nk->ni", weighted_point, residual)


# Pose of a target alone, by Gauss–Newton steps.

_POSE_STEPS = 30  # limit of the steps; some five are usual
_POSE_CONVERGED = 1e-9  # expected decrease of the sum of squares, of a sum above 1 its share, that ends the iteration


def refine_pose(bundle: Bundle, images: list[ImageObservations]) -> tuple[RigidTransform, FloatArray, float]:
    """Return the pose, its covariance and the sum of squares, infinite if the iteration diverges."""
    for _ in range(_POSE_STEPS):
        normal, side, squares = np.zeros((6, 6)), np.zeros(6), 0.0
        for image in images:
            seen = image.model(bundle)
            residual = image.position_px - seen.pixel
            weighted = image.precision @ seen.by_pose
            normal += np.einsum("nki,nkj->ij", seen.by_pose, weighted)
            side += np.einsum("nki,nk->i", weighted, residual)
            squares += float(np.einsum("ni,nij,nj->", residual, image.precision, residual))
        if not np.isfinite(squares):
            break
        step = np.asarray(np.linalg.solve(normal, side), dtype=np.float64)
        middle = bundle.shape.flat_m.mean(axis=0)
        bundle = replace(bundle, poses=step_poses(middle, bundle.poses, step[None], np.zeros(2)))
        if side @ step < _POSE_CONVERGED * max(squares, 1.0):
            return bundle.poses[0], np.asarray(np.linalg.inv(normal), dtype=np.float64), squares
    return bundle.poses[0], np.full((6, 6), np.nan), np.inf


# Influence of single views: calibration without each view, and its prediction.

_LEAST = 1e-9  # of the largest variance: smaller ones are rounding


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Changes of a calibration when each view, or each pose, is left out.

    Attributes
    ----------
    steps : (V, 32), change of the rig's parameters, by one Gauss–Newton step from the normal equations of the whole
        fit.
    drift_steps : (V, D), change of the focal drift.
    expected : (32, 32), covariance of the sum of these changes by point noise alone: Σ (Hᵥ)⁻¹ − H⁻¹ of the normal
        equations without and with the view.
    prediction_residuals : Residuals (N, 2) of each image, in the order of the fit, predicted by the other views with
        only the target's pose fitted.
    """

    steps: FloatArray
    drift_steps: FloatArray
    expected: FloatArray
    prediction_residuals: tuple[FloatArray, ...]


def leave_views_out(
    adjusted: AdjustedBundle,
    images: Sequence[ImageObservations] = (),
    cluster: IntArray | None = None,
    prior: RigPrior | None = None,
) -> LeaveOneOut:
    """Return the fit without each view in turn, or each cluster (V,) of views.

    `images` are predicted, with the weights of the fit. A step of a wide lens may lead to where the lens has no image;
    with a `prior`, the prediction is then that of an adjustment without the view. A point that has no image there
    either has a residual as large as the image.
    """
    normal, bundle = adjusted.normal, adjusted.bundle
    free, views = len(normal.parameter_index), len(bundle.poses)
    cluster = np.arange(views) if cluster is None else cluster
    block = np.ix_(normal.parameter_index, normal.parameter_index)
    steps, drifts, expected = [], [], np.zeros_like(adjusted.covariance)
    prediction: list[FloatArray] = [np.empty((0, 2))] * len(images)
    for group in np.unique(cluster):
        without = np.flatnonzero(cluster == group).tolist()
        reduced = normal.reduced(without=without)
        step, pose_steps = normal.spread(*reduced.solve())
        steps.append(step[: len(expected)])
        drifts.append(step[len(step) - normal.drifts :])
        expected[block] += reduced.covariance()[:free, :free] - adjusted.covariance[block]
        members = [n for n, image in enumerate(images) if image.view in without]
        if members:
            every = np.zeros((views, 6))
            every[np.setdiff1d(np.arange(views), without)] = pose_steps
            left_out = [images[n] for n in members]
            predicted = _predict(bundle.with_step(step, every), left_out)
            if prior is not None and not all(np.isfinite(residual).all() for residual in predicted):
                predicted = _predict(_adjusted_without(bundle, images, without, prior), left_out)
            for n, residual in zip(members, predicted, strict=True):
                size_px = (bundle.rig.right if images[n].side else bundle.rig.left).size_px
                prediction[n] = np.where(np.isfinite(residual), residual, size_px)
    return LeaveOneOut(np.array(steps), np.array(drifts), expected, tuple(prediction))


def _predict(bundle: Bundle, images: Sequence[ImageObservations]) -> list[FloatArray]:
    """Return the residuals (N, 2) of some views' images with only the poses fitted."""
    predicted: dict[int, FloatArray] = {}
    for view in {image.view for image in images}:
        mine = [n for n, image in enumerate(images) if image.view == view]
        predicted.update(zip(mine, predict_view(bundle, [images[n] for n in mine]), strict=True))
    return [predicted[n] for n in range(len(images))]


def _adjusted_without(
    bundle: Bundle, images: Sequence[ImageObservations], without: Sequence[int], prior: RigPrior
) -> Bundle:
    """Return the bundle adjusted to the other views; itself if this does not converge."""
    number = {view: row for row, view in enumerate(view for view in range(len(bundle.poses)) if view not in without)}
    others = [replace(image, view=number[image.view]) for image in images if image.view in number]
    try:
        found = adjust(bundle.of_views(list(number)), others, prior, near=True).bundle
    except ValueError:
        return bundle
    drift = None if bundle.drift is None or found.drift is None else replace(bundle.drift, value=found.drift.value)
    return replace(bundle, rig=found.rig, shape=found.shape, drift=drift)


def drift_uncertainty(adjusted: AdjustedBundle, left_out: LeaveOneOut, factor: float) -> FloatArray:
    """Return the standard uncertainties (D,) of a drift.

    The larger one of that by residuals and that by the jackknife over the views.
    """
    views = len(left_out.drift_steps)
    by_views = (views - 1) / views * (left_out.drift_steps**2).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(adjusted.drift_variance * factor, by_views)))


def predict_view(bundle: Bundle, images: Sequence[ImageObservations]) -> list[FloatArray]:
    """Return the residuals (N, 2) of one view's images with only the target's pose fitted."""
    single = [replace(image, view=0) for image in images]
    one = bundle.of_views([images[0].view])
    pose, _, _ = refine_pose(one, single)
    return residuals(replace(one, poses=(pose,)), single)


def stated_covariance(covariance: FloatArray, left_out: LeaveOneOut, factor: float) -> FloatArray:
    """Return the covariance (32, 32) of the rig, including the scatter of its views.

    `covariance` of the fit times the reduced χ² `factor` is the contribution of the residuals. The delete-one-view
    jackknife (Efron and Stein 1981, Annals of Statistics 9, 586; clusters: Cameron and Miller 2015, Journal of Human
    Resources 50, 317) gives that of the views, whatever their errors have in common. Its principal variances are
    expressed in units of the covariance by point noise alone. V samples of N parameters reach (1 + √(N/V))² by chance
    (Marčenko and Pastur 1967, Mathematics of the USSR-Sbornik 1, 457). Larger variances replace the noise. They are
    reduced by the contribution of the others to the largest of few samples (Baik and Silverstein 2006, Journal of
    Multivariate Analysis 97, 1382). The factor (V − 1)/(V − 3) covers the few views (JCGM 101:2008, 6.4.9), so that k =
    2 covers 95 %.
    """
    free = np.flatnonzero(np.diagonal(covariance) > 0)
    views, block = len(left_out.steps), np.ix_(free, free)
    fit = covariance[block] * factor
    expected = left_out.expected[block] * factor * (views - 1) / views
    scale = np.sqrt(np.maximum(np.diagonal(expected), _LEAST * np.diagonal(fit)))
    size, axes = np.linalg.eigh(expected / np.outer(scale, scale))
    size = np.sqrt(np.maximum(size, _LEAST * size[-1]))
    white = (left_out.steps[:, free] / scale) @ axes / size * np.sqrt(views - 1)  # unit variances by noise alone
    variance, turn = np.linalg.eigh(white.T @ white / views)
    few, ratio = (views - 1) / max(views - 3, 1), len(free) / views
    sum_ = variance + 1 - ratio  # a variance v among unit variances is estimated as v + v·ratio/(v − 1)
    true = (sum_ + np.sqrt(np.maximum(sum_**2 - 4 * variance, 0.0))) / 2
    more = np.where(variance > (1 + np.sqrt(ratio)) ** 2, few * true - 1, 0.0)
    root = scale[:, None] * (axes * size) @ turn * np.sqrt(more)
    stated = covariance * factor
    stated[block] += root @ root.T
    return stated


def split_half(
    adjusted: AdjustedBundle, images: Sequence[ImageObservations], prior: RigPrior, cluster: IntArray
) -> tuple[StereoRig, StereoRig]:
    """Return the rigs of every second cluster of views and of the others."""
    rigs = []
    for first in (0, 1):
        number = {view: row for row, view in enumerate(np.flatnonzero(cluster % 2 == first).tolist())}
        half = [replace(image, view=number[image.view]) for image in images if image.view in number]
        rigs.append(adjust(adjusted.bundle.of_views(list(number)), half, prior, near=True).bundle.rig)
    return rigs[0], rigs[1]
