"""Bundle adjustment of cameras, relative pose, target poses and target geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from photogram.calibration.bundle import (
    DRIFT_SPREAD,
    Bundle,
    ImageObservations,
    ModelledPixels,
    model_view_pixels,
    scale_focal_lengths,
)
from photogram.camera import LEFT, RIG_PARAMETERS, RIGHT
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
    found: list[FloatArray] = [np.empty((0, 2))] * len(images)
    for side in _sides(images):
        difference = side.position_px - side.see(bundle).pixel
        for number, rows in zip(side.number, side.rows, strict=True):
            found[number] = difference[rows]
    return found


@dataclass(frozen=True, eq=False)
class _Side:
    """All images of one camera with their points (N,) in one array."""

    side: int
    number: tuple[int, ...]
    rows: tuple[slice, ...]
    view: IntArray
    point: IntArray
    position_px: FloatArray
    precision: FloatArray
    radius_m: float

    def see(self, bundle: Bundle) -> ModelledPixels:
        """Return the expected pixels of all points."""
        rig = bundle.rig
        camera, relative = (rig.right, rig.right_from_left) if self.side else (rig.left, RigidTransform.identity())
        points = bundle.shape.points_m[self.point]
        seen = model_view_pixels(camera, relative, bundle.poses, self.view, points, self.radius_m)
        if bundle.drift is None:
            return seen
        return scale_focal_lengths(seen, camera, bundle.drift.growth(self.side, self.view))

    def by_drift(self, bundle: Bundle, seen: ModelledPixels) -> FloatArray:
        """Return the derivatives (N, 2, D) of the pixels by the focal drift."""
        if bundle.drift is None:
            return np.empty((*seen.pixel.shape, 0))
        camera = bundle.rig.right if self.side else bundle.rig.left
        by_growth = bundle.drift.relative_time[self.view, None] * (seen.pixel - camera.matrix[:2, 2])
        slope = np.zeros((*seen.pixel.shape, 2))
        slope[..., self.side] = by_growth / (1 + bundle.drift.growth(self.side, self.view))[:, None]
        return slope


def _sides(images: Sequence[ImageObservations]) -> list[_Side]:
    """Return the images by camera."""
    sides = []
    for side in sorted({image.side for image in images}):
        number = tuple(n for n, image in enumerate(images) if image.side == side)
        mine = [images[n] for n in number]
        ends = np.cumsum([0, *(len(image.point) for image in mine)]).tolist()
        view = np.concatenate([np.full(len(image.point), image.view) for image in mine])
        position, precision = (
            np.concatenate([getattr(p, name) for p in mine]) for name in ("position_px", "precision")
        )
        rows = tuple(slice(*pair) for pair in pairwise(ends))
        point = np.concatenate([image.point for image in mine])
        sides.append(_Side(side, number, rows, view, point, position, precision, mine[0].radius_m))
    return sides


def _evaluate(bundle: Bundle, sides: Sequence[_Side], prior: RigPrior) -> tuple[float, list[ModelledPixels]]:
    """Return the sum of squares, infinite for a point behind a camera, and the pixels."""
    seen = [side.see(bundle) for side in sides]
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
    common, pose, point : (V, K, K), (V, 6, 6) and (V, P, 3, 3); P = 0 if the target's points are not free.
    common_pose, point_common, point_pose : Couplings (V, K, 6), (V, P, K, 3) and (V, P, 6, 3).
    common_side, pose_side, point_side : Right-hand sides.
    prior, prior_side, point_prior, point_prior_side : Prior information (K, K), (K,) and (P, 3).
    """

    parameter_index: IntArray
    drifts: int
    common: FloatArray
    pose: FloatArray
    point: FloatArray
    common_pose: FloatArray
    point_common: FloatArray
    point_pose: FloatArray
    common_side: FloatArray
    pose_side: FloatArray
    point_side: FloatArray
    prior: FloatArray
    prior_side: FloatArray
    point_prior: FloatArray
    point_prior_side: FloatArray

    def step(self, damping: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the damped steps of rig, geometry, drift and poses and the predicted decrease."""
        reduced = self.reduced(damping)
        side = np.concatenate([self.common_side.sum(axis=0) + self.prior_side, self.pose_side.ravel()])
        point_side = self.point_side.sum(axis=0) + self.point_prior_side
        step, point_step = reduced.solve(side, point_side)
        decrease = float(side @ step + (point_side * point_step).sum())
        return *self.spread(step, point_step), decrease

    def spread(self, step: FloatArray, point_step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the steps of rig, geometry and drift, and of the poses.

        The first (32 + S + D,) is that of rig, geometry and drift, the second (V, 6).
        """
        rig, common = np.zeros(_RIG), len(self.prior)
        rig[self.parameter_index] = step[: len(self.parameter_index)]
        return np.concatenate([rig, point_step.ravel(), step[len(self.parameter_index) : common]]), step[
            common:
        ].reshape(-1, 6)

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

    def reduced(self, damping: float = 0.0, without: int | None = None) -> ReducedEquations:
        """Return the equations after elimination of the points, of all views except `without`."""
        views, common, points = len(self.pose), len(self.prior), len(self.point_prior)
        remaining = [view for view in range(views) if view != without]
        size = common + 6 * len(remaining)
        matrix, coupling = np.zeros((size, size)), np.zeros((points, size, 3))
        matrix[:common, :common] = self.common[remaining].sum(axis=0) + self.prior
        coupling[:, :common] = self.point_common[remaining].sum(axis=0)
        for row, view in zip(range(common, size, 6), remaining, strict=True):
            matrix[row : row + 6, row : row + 6] = self.pose[view]
            matrix[:common, row : row + 6] = self.common_pose[view]
            matrix[row : row + 6, :common] = self.common_pose[view].T
            coupling[:, row : row + 6] = self.point_pose[view]
        point = self.point[remaining].sum(axis=0) + self.point_prior[:, :, None] * np.eye(3)
        raised = 1.0 + damping
        matrix[np.diag_indices(size)] *= raised
        point[:, range(3), range(3)] *= raised
        inverse = np.linalg.inv(point)
        answer = coupling @ inverse
        flat = (array.transpose(1, 0, 2).reshape(size, -1) for array in (answer, coupling))
        return ReducedEquations(matrix - next(flat) @ next(flat).T, np.diagonal(matrix).copy(), answer, inverse)


@dataclass(frozen=True, eq=False)
class ReducedEquations:
    """Equations (R, R) of rig, modes and poses after elimination of the points.

    Attributes
    ----------
    matrix : (R, R).
    diagonal : (R,), before the elimination.
    answer : (P, R, 3), minus the change of a point per change of the other unknowns.
    point : (P, 3, 3), covariance of a point if the other unknowns were exact.
    """

    matrix: FloatArray
    diagonal: FloatArray
    answer: FloatArray
    point: FloatArray

    def solve(self, side: FloatArray, point_side: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the solution (R,) and that of the points (P, 3) for right-hand sides."""
        scale = 1 / np.sqrt(self.diagonal)
        less = side - np.einsum("pri,pi->r", self.answer, point_side)
        step = np.linalg.solve(self.matrix * np.outer(scale, scale), less * scale) * scale
        by_side = np.einsum("pij,pj->pi", self.point, point_side)
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
    prior_side = np.concatenate([-prior.slope.T @ prior.deviations(bundle.rig.values), side[ranged]])

    def zeros(*size: int) -> FloatArray:
        return np.zeros((views, *size))

    normal = BundleNormalEquations(
        parameter_index=free,
        drifts=len(drift),
        common=zeros(common, common),
        pose=zeros(6, 6),
        point=zeros(points, 3, 3),
        common_pose=zeros(common, 6),
        point_common=zeros(points, common, 3),
        point_pose=zeros(points, 6, 3),
        common_side=zeros(common),
        pose_side=zeros(6),
        point_side=zeros(points, 3),
        prior=prior_matrix,
        prior_side=prior_side,
        point_prior=precision[single].reshape(-1, 3),
        point_prior_side=side[single].reshape(-1, 3),
    )
    for one, modelled in zip(sides, seen, strict=True):
        _add_side(normal, bundle, one, modelled)
    return normal


def _add_side(normal: BundleNormalEquations, bundle: Bundle, side: _Side, seen: ModelledPixels) -> None:
    """Add the images of one camera to the normal equations."""
    by_modes = np.einsum("nki,nim->nkm", seen.by_point, bundle.shape.modes[side.point])
    by_common = [seen.by_rig(side.side)[..., normal.parameter_index], by_modes, side.by_drift(bundle, seen)]
    slope = np.concatenate(by_common, axis=-1)
    weighted, weighted_pose = side.precision @ slope, side.precision @ seen.by_pose
    residual = side.position_px - seen.pixel
    for rows in side.rows:
        view, many = side.view[rows.start], 2 * (rows.stop - rows.start)
        image_slope, image_pose = slope[rows].reshape(many, -1), seen.by_pose[rows].reshape(many, 6)
        image_weighted, pose_weighted = weighted[rows].reshape(many, -1), weighted_pose[rows].reshape(many, 6)
        image_residual = residual[rows].ravel()
        normal.common[view] += image_slope.T @ image_weighted
        normal.pose[view] += image_pose.T @ pose_weighted
        normal.common_pose[view] += image_slope.T @ pose_weighted
        normal.common_side[view] += image_residual @ image_weighted
        normal.pose_side[view] += image_residual @ pose_weighted
    if len(normal.point_prior):
        at = (side.view, side.point)
        weighted_point = side.precision @ seen.by_point
        normal.point[at] += np.einsum("nki,nkj->nij", seen.by_point, weighted_point)
        normal.point_common[at] += weighted.transpose(0, 2, 1) @ seen.by_point
        normal.point_pose[at] += weighted_pose.transpose(0, 2, 1) @ seen.by_point
        normal.point_side[at] += np.einsum("nki,nk->ni", weighted_point, residual)
