"""Rigid motion of tracked points with covariance, and their deformation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from photogram.camera import Points3D
from photogram.frame_statistics import RunningMean
from photogram.geometry import (
    displacement_jacobian,
    fixes_rotation,
    invert,
    nearest_rotation,
    pose_rate,
    rotation_from_vector,
    skew,
    vector_from_rotation,
)
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.kernels import njit

if TYPE_CHECKING:
    from scipy.sparse import csr_array, sparray


def overlap_correlation(points_px: FloatArray, radius_px: int) -> csr_array:
    """Return the correlation (N, N) of the position noise of subsets that overlap.

    The subsets around points_px (N, 2) have sides w = 2·radius + 1. ρ = (1 − |Δx|/w)(1 − |Δy|/w), the share of common
    pixels, and 0 without any. A subset's error is H⁻¹ Σ f′ε over its pixels (f′: steepest-descent images, ε: white
    noise), so two subsets have the covariance σ² Hₙ⁻¹ (Σ f′f′ᵀ over the common pixels) Hₘ⁻¹. In a homogeneous texture
    that sum is the share times H, and translation is orthogonal to the affine terms (Σ f′² d = 0 about the centre), so
    that only the share remains. A subset with a NaN centre is uncorrelated.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    check_shape("points_px", points_px, (None, 2))
    if radius_px < 1:
        raise ValueError(f"radius_px: expected at least 1, found {radius_px}")
    count, side = len(points_px), 2 * radius_px + 1
    finite = np.flatnonzero(np.isfinite(points_px).all(axis=1))
    pairs = finite[cKDTree(points_px[finite]).query_pairs(side, p=np.inf, output_type="ndarray")]
    distance = np.abs(points_px[pairs[:, 0]] - points_px[pairs[:, 1]])
    shared = np.prod(np.maximum(1.0 - distance / side, 0.0), axis=1)
    index = np.arange(count)
    rows = np.concatenate([index, pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([index, pairs[:, 1], pairs[:, 0]])
    values = np.concatenate([np.ones(count), shared, shared])
    return csr_array((values, (rows, columns)), shape=(count, count))


# Points through time to rigid motion, with covariance.

START_ROUNDS = 8  # rounds of the robust start
_START_POINTS = 200  # of a frame that are enough to begin with
_CHOICE_ROUNDS = 8  # rounds in which points may be rejected and return
_ROUNDS = 16  # rounds in total; usually two or three are needed
REJECTED = 25.0  # squared distance, in scaled standard deviations, beyond which a point is an outlier
_MEDIAN_CHI2 = 2.3659738843753377  # median of χ² with three degrees of freedom
MEDIAN_CHI2_OF_TWO = 1.3862943611198906  # with two degrees of freedom
_BENT = 25.0  # reduced χ² beyond which points depart from a rigid motion by more than their noise
FEWEST = 6  # with fewer points none is rejected
_ROUNDING = 1e-12  # of the coordinates: errors below it are rounding, never outliers
SINGULAR = 1e-13  # smallest eigenvalue of a solvable system, scaled to a unit diagonal
_CONVERGED = 1e-13  # a step (m, rad) this small ends the iteration


@dataclass(frozen=True, eq=False, repr=False)
class RigidMotion(Arrays, shapes="pose F 6; covariance F 6 6; residual_m F; points F; origin_m 3"):
    """Rigid motion of a body through time: x' = R·(x−o) + o + t.

    R = R(r), against the reference. A frame that could not be fitted has NaN and 0 points.

    Attributes
    ----------
    pose : (F, 6) = [t (m), r (rad, rotation vector)].
    covariance : (F, 6, 6).
    residual_m : (F,) rms per coordinate.
    points : (F,) number used.
    origin_m : (3,) o.
    """

    pose: FloatArray
    covariance: FloatArray
    residual_m: FloatArray
    points: IntArray
    origin_m: FloatArray

    def about(self, origin_m: FloatArray) -> RigidMotion:
        """Return the same motion about another origin (3,).

        t' = t + (R - 1)·(o' - o). Far from the body a small error of the rotation is a large error of the translation.
        About the body's centroid the two hardly correlate, and the translation has its smallest uncertainty.
        """
        origin = np.asarray(origin_m, dtype=np.float64)
        check_shape("origin_m", origin, (3,))
        arm = rotation_from_vector(self.pose[:, 3:]) @ (origin - self.origin_m)
        pose = self.pose.copy()
        pose[:, :3] += arm - (origin - self.origin_m)
        rate = pose_rate(self.pose)
        moved = rate.copy()
        moved[:, :3, 3:] = -skew(arm)
        jacobian = moved @ np.linalg.inv(rate)
        covariance = jacobian @ self.covariance @ np.swapaxes(jacobian, 1, 2)
        return replace(self, pose=pose, covariance=covariance, origin_m=origin)


def fit_motion(
    points: Points3D, reference_m: FloatArray | None, origin_m: FloatArray, correlation: sparray | None = None
) -> RigidMotion:
    """Fit the rigid motion of every frame's points against a reference.

    Parameters
    ----------
    points
        (F, N) with covariances.
    reference_m
        (N, 3); None for the points of frame 0.
    origin_m
        (3,) about which the body rotates.
    correlation
        (N, N) of the noise of overlapping subsets (`overlap_correlation`); None (default) for independent points.

    Returns
    -------
    RigidMotion
        Poses with covariance; NaN for a frame with fewer than three usable points, or all on one line.

    Raises
    ------
    ValueError
        For a reference with fewer than 3 finite points.

    Notes
    -----
    Minimises Σ dᵢ², dᵢ² = eᵢᵀ·Cᵢ⁻¹·eᵢ, eᵢ = x'ᵢ − R·(xᵢ − o) − o − t, with the points' covariances Cᵢ by Gauss-Newton.
    The start is Arun's fit (`geometry.nearest_rotation`) with Cauchy weights 1/(1 + eᵢ²/median e²), reweighted eight
    times, which tolerates up to a third of outliers. Of 400 points or more every second, third … is used for the start,
    at least 200. In each round the frame's scale is s² = (1 + 5/(n − 2))²·median(dᵢ²)/2.366, the median of χ² with 3
    degrees of freedom and the correction for few points of Rousseeuw and Leroy (1987, Robust Regression and Outlier
    Detection, p. 202; the six components use up two points). Points with dᵢ² > 25·s² (1.5·10⁻⁵ of normal ones) are
    rejected, and may return during the first eight rounds. With fewer than six points none is rejected.

    The covariance is (Σ Jᵀ·C⁻¹·J)⁻¹ over the points used: the noise of this single frame according to the points'
    covariances, also of frame 0, whose pose is exactly zero. The noise of the reference is excluded: it shifts all
    frames of a series equally.

    Points that depart from a rigid motion by more than five times their noise (median(dᵢ²)/2.366 > 25 at the start)
    belong to a body that bends. Weights by noise would turn it to its least certain points, so such a frame is fitted
    with Cᵢ = I·median(eᵢ²)/2.366.

    With the `correlation` ρ and C = L·Lᵀ the covariance of two points is ρ·Lₙ·Lₘᵀ, and that of the pose N⁻¹·(Σₙₘ
    ρₙₘ·Bₙᵀ·Bₘ)·N⁻¹ with B = L⁻¹·J and N = Σ Bᵀ·B.

    Examples
    --------
    >>> from photogram.camera import Points3D
    >>> body = np.random.default_rng(1).uniform(-0.01, 0.01, (20, 3))
    >>> moved = np.stack([body, body + [1e-3, 0, 0]])
    >>> noise = np.broadcast_to(1e-12 * np.eye(3), (2, 20, 3, 3))
    >>> fit_motion(Points3D(moved, noise, np.zeros((2, 20))), None, np.zeros(3)).pose[1].round(9) + 0.0
    array([0.001, 0.   , 0.   , 0.   , 0.   , 0.   ])
    """
    origin = np.asarray(origin_m, dtype=np.float64)
    check_shape("origin_m", origin, (3,))
    reference = points.position_m[0] if reference_m is None else np.asarray(reference_m, dtype=np.float64)
    check_shape("reference_m", reference, (points.position_m.shape[1], 3))
    if np.count_nonzero(np.isfinite(reference).all(axis=1)) < 3:
        raise ValueError("reference_m: expected at least 3 finite points; give a reference when frame 0 has none")
    source, target = reference - origin, points.position_m - origin
    precision = _precisions(np.ascontiguousarray(points.covariance_m2, dtype=np.float64))
    finite = np.isfinite(precision).all(axis=(2, 3)) & np.isfinite(target).all(axis=2)
    if correlation is not None and correlation.shape != (len(reference), len(reference)):
        raise ValueError(f"correlation: expected a matrix of {len(reference)} points, found {correlation.shape}")
    return _fit(source, target, precision, finite & np.isfinite(source).all(axis=1), origin, correlation)


def relative_to(motion: RigidMotion, mean_pose: FloatArray) -> RigidMotion:
    """Return the motion T_k·T_mean⁻¹ against another pose (6,), about the same origin.

    The other pose may be the mean. The origin is then the material point that is at the origin in that pose. The pose
    is treated as exact: with T_k changed by a small left rotation δ and shift τ, t changes by τ − δ × (R_rel·t_mean).
    Residuals and points are unchanged.
    """
    mean = np.asarray(mean_pose, dtype=np.float64)
    check_shape("mean_pose", mean, (6,))
    rotation = rotation_from_vector(motion.pose[:, 3:])
    relative = rotation @ rotation_from_vector(mean[3:]).T
    carried = relative @ mean[:3]
    vector = vector_from_rotation(relative)
    pose = np.concatenate([motion.pose[:, :3] - carried, vector], axis=1)
    rate = pose_rate(pose)
    rate[:, :3, 3:] = skew(carried)
    jacobian = rate @ np.linalg.inv(pose_rate(motion.pose))
    return replace(motion, pose=pose, covariance=jacobian @ motion.covariance @ np.swapaxes(jacobian, 1, 2))


def points_with_estimated_noise(position_m: FloatArray, reference_m: FloatArray | None = None) -> Points3D:
    """Return points (F, N, 3) with a covariance estimated from their rigid fit.

    One 3×3 covariance for all: the residuals of an unweighted rigid fit of every frame, about each point's mean over
    time (which removes the noise of the reference), pooled over points and frames. They are divided by the remaining
    degrees of freedom (F' − 1)·(N − 2) of F' frames with a fit. Outliers are rejected as in `fit_motion`.
    `reprojection_px` is NaN.
    """
    position = np.asarray(position_m, dtype=np.float64)
    check_shape("position_m", position, (None, None, 3))
    unit = Points3D(position, np.broadcast_to(np.eye(3), (*position.shape, 3)), np.full(position.shape[:2], np.nan))
    start = 1 if reference_m is None else 0
    motion = fit_motion(unit, reference_m, np.zeros(3))
    reference = position[0] if reference_m is None else np.asarray(reference_m, dtype=np.float64)
    moved = reference @ np.swapaxes(rotation_from_vector(motion.pose[:, 3:]), 1, 2) + motion.pose[:, None, :3]
    error = (position - moved)[start:]
    # over time, without errors beyond five of their frame's rms
    inside = np.less_equal((error**2).sum(axis=2), REJECTED * motion.residual_m[start:, None] ** 2)
    count = inside.sum(axis=0)
    accepted = (inside & (count >= 2))[..., None]
    tracks = int(np.count_nonzero(count >= 2))
    if tracks < 3:
        raise ValueError("position_m: expected at least 3 points in 2 frames after the reference to estimate noise")
    error = np.where(accepted, error, 0.0)
    deviation = np.where(accepted, error - error.sum(axis=0) / np.maximum(count, 1)[:, None], 0.0)
    freedom = (int(accepted.sum()) - tracks) * (1 - 2 / tracks)
    covariance = np.einsum("fni,fnj->ij", deviation, deviation) / freedom
    finite = np.asarray(np.isfinite(position).all(axis=2))[..., None, None]
    return replace(unit, covariance_m2=np.where(finite, covariance, np.nan))


def _fit(
    source: FloatArray,
    target: FloatArray,
    precision: FloatArray,
    usable: BoolArray,
    origin: FloatArray,
    correlation: sparray | None,
) -> RigidMotion:
    """Fit the frames that can be fitted; the others are NaN."""
    source, target = np.where(np.isfinite(source), source, 0.0), np.where(usable[..., None], target, 0.0)
    some = slice(None, None, max(1, usable.shape[1] // _START_POINTS))  # if enough of them are finite
    if usable[:, some].sum(axis=1).min(initial=_START_POINTS) < _START_POINTS // 2:
        some = slice(None)
    rotation, translation, fixed = _robust_start(source[some], target[:, some], usable[:, some])
    fixed &= usable.sum(axis=1) >= 3
    used = usable = usable & fixed[:, None]
    precision = _without_noise_weights(
        precision, target - source @ np.swapaxes(rotation, 1, 2) - translation[:, None], usable
    )
    size = np.where(usable, np.trace(precision, axis1=2, axis2=3) * (target**2).sum(axis=2), 0.0)
    smallest = _ROUNDING**2 * size.max(axis=1, initial=0.0)
    count = usable.sum(axis=1)
    correction = (1 + 5 / np.maximum(count - 2, 1)) ** 2
    for number in range(_ROUNDS):
        before = used
        arm = source @ np.swapaxes(rotation, 1, 2)
        error = target - arm - translation[:, None]
        if number < _CHOICE_ROUNDS:
            squares = np.einsum("fni,fnij,fnj->fn", error, precision, error)
            limit = REJECTED * np.maximum(correction * _median(squares, usable) / _MEDIAN_CHI2, smallest)
            used = usable & ((count < FEWEST)[:, None] | (squares <= limit[:, None]))
        normal, gradient = _normal_equations(arm, error, precision, used)
        # which normal matrices (F, 6, 6) determine all six components
        diagonal = np.diagonal(normal, axis1=1, axis2=2)
        positive = (diagonal > 0).all(axis=1)
        scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        lowest = np.linalg.eigvalsh(normal / (scale[:, :, None] * scale[:, None, :]))[:, 0]
        fixed &= np.asarray(positive & (lowest > SINGULAR))
        normal = np.where(fixed[:, None, None], normal, np.eye(6))
        step = np.where(fixed[:, None], np.linalg.solve(normal, gradient[..., None])[..., 0], 0.0)
        rotation, translation = rotation_from_vector(step[:, 3:]) @ rotation, translation + step[:, :3]
        if np.abs(step).max(initial=0.0) <= _CONVERGED and np.array_equal(used, before):
            break
    used &= fixed[:, None]
    squares = np.where(used, (error**2).sum(axis=2), 0.0).sum(axis=1)
    pose = np.concatenate([translation, vector_from_rotation(rotation)], axis=1)
    step_covariance = np.linalg.inv(normal)
    if correlation is not None:
        step_covariance = step_covariance @ _correlated_normal(arm, precision, used, correlation) @ step_covariance
    rate = pose_rate(pose)
    return RigidMotion(
        pose=np.where(fixed[:, None], pose, np.nan),
        covariance=np.where(fixed[:, None, None], np.asarray(rate @ step_covariance @ np.swapaxes(rate, 1, 2)), np.nan),
        residual_m=np.where(fixed, np.sqrt(squares / (3 * np.maximum(used.sum(axis=1), 1))), np.nan),
        points=used.sum(axis=1).astype(np.int64),
        origin_m=origin,
    )


def _without_noise_weights(precision: FloatArray, error: FloatArray, usable: BoolArray) -> FloatArray:
    """Return precisions (F,N,3,3), equal ones in frames with errors far above the points' noise."""
    squares = np.einsum("fni,fnij,fnj->fn", error, np.where(usable[..., None, None], precision, 0.0), error)
    bent = _median(squares, usable) > _BENT * _MEDIAN_CHI2
    bent &= usable.sum(axis=1) >= FEWEST
    variance = np.where(bent, _median((error**2).sum(axis=2), usable) / _MEDIAN_CHI2, 1.0)
    same = np.eye(3) / variance[:, None, None, None]
    return np.where(bent[:, None, None, None], same, precision)


def _correlated_normal(arm: FloatArray, precision: FloatArray, used: BoolArray, correlation: sparray) -> FloatArray:
    """Return Σₙₘ ρₙₘ·Bₙᵀ·Bₘ (F, 6, 6), B = Gᵀ·[I, −[a]×] with precisions G·Gᵀ."""
    count = used.shape[1]
    total = np.empty((len(used), 6, 6))
    for f, points in enumerate(used):
        whitened = np.zeros((count, 3, 6))
        root = np.swapaxes(np.linalg.cholesky(precision[f, points]), 1, 2)
        whitened[points] = np.concatenate([root, -root @ skew(arm[f, points])], axis=2)
        shared = np.asarray(correlation @ whitened.reshape(count, 18)).reshape(count, 3, 6)
        total[f] = np.einsum("nki,nkj->ij", whitened, shared)
    return total


def _robust_start(
    source: FloatArray, target: FloatArray, usable: BoolArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return rotations, translations and whether each frame's points determine them. Arun's fit with Cauchy weights."""
    weight = usable.astype(np.float64)
    rotation, translation = np.empty((len(target), 3, 3)), np.empty((len(target), 3))
    fixed = np.ones(len(target), dtype=np.bool_)
    for _ in range(START_ROUNDS):
        share = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
        source_mean, target_mean = share @ source, (share[:, None] @ target)[:, 0]
        spread = np.swapaxes((target - target_mean[:, None]) * share[..., None], 1, 2)
        scatter = spread @ (source - source_mean[:, None])
        fixed = fixes_rotation(scatter)
        rotation = nearest_rotation(scatter)
        translation = target_mean - (rotation @ source_mean[..., None])[..., 0]
        error = target - source @ np.swapaxes(rotation, 1, 2) - translation[:, None]
        squares = (error**2).sum(axis=2)
        median = np.maximum(_median(squares, usable), 1e-300)
        weight = np.where(usable, 1 / (1 + squares / median[:, None]), 0.0)
    return rotation, translation, fixed


@njit()
def _precisions(covariance: FloatArray) -> FloatArray:
    """Return the inverses of covariances (F, N, 3, 3), NaN if not positive definite."""
    frames, count = covariance.shape[:2]
    precision = np.empty((frames, count, 3, 3))
    for f in range(frames):
        for i in range(count):
            one, inverse = covariance[f, i], precision[f, i]
            if not (one[0, 0] > 0.0 and one[1, 1] > 0.0 and one[2, 2] > 0.0 and invert(one, inverse)):
                inverse[:] = np.nan
    return precision


def _median(values: FloatArray, usable: BoolArray) -> FloatArray:
    """Return each frame's median of the usable values (F, N), infinite without any."""
    ordered = np.sort(np.where(usable, values, np.inf), axis=1)
    count, frame = np.maximum(usable.sum(axis=1), 1), np.arange(len(values))
    return np.asarray(0.5 * (ordered[frame, (count - 1) // 2] + ordered[frame, count // 2]))


@njit()
def _normal_equations(arm, error, precision, used):  # type: ignore[no-untyped-def]
    """Return Σ Jᵀ·W·J (F,6,6) and Σ Jᵀ·W·e (F,6) of a small motion.

    A shift and a left rotation. J = [I, −[a]×]. Arms a = R·x and errors e are (F, N, 3); Jᵀ·v = [v, a × v].
    """
    frames, count = used.shape
    normal, gradient = np.zeros((frames, 6, 6)), np.zeros((frames, 6))
    row = np.empty((3, 6))
    for f in range(frames):
        for i in range(count):
            if used[f, i]:
                a, w, e = arm[f, i], precision[f, i], error[f, i]
                for k in range(3):
                    row[k, 0], row[k, 1], row[k, 2] = w[k, 0], w[k, 1], w[k, 2]
                    row[k, 3] = a[1] * w[k, 2] - a[2] * w[k, 1]
                    row[k, 4] = a[2] * w[k, 0] - a[0] * w[k, 2]
                    row[k, 5] = a[0] * w[k, 1] - a[1] * w[k, 0]
                for j in range(6):
                    normal[f, 0, j] += row[0, j]
                    normal[f, 1, j] += row[1, j]
                    normal[f, 2, j] += row[2, j]
                    normal[f, 3, j] += a[1] * row[2, j] - a[2] * row[1, j]
                    normal[f, 4, j] += a[2] * row[0, j] - a[0] * row[2, j]
                    normal[f, 5, j] += a[0] * row[1, j] - a[1] * row[0, j]
                    gradient[f, j] += row[0, j] * e[0] + row[1, j] * e[1] + row[2, j] * e[2]
    return normal, gradient


# Deformation of a body: residual of every point from the rigid motion, with covariance.


@dataclass(frozen=True, eq=False, repr=False)
class Deformation(Arrays, shapes="reference_m N 3; residual_m F N 3; covariance_m2 F N 3 3"):
    """Displacement of N points against the rigidly moving body, in its axes; NaN = missing.

    Attributes
    ----------
    reference_m : (N, 3) the points at rest.
    residual_m : (F, N, 3) about each point's mean over time.
    covariance_m2 : (F, N, 3, 3).
    """

    reference_m: FloatArray
    residual_m: FloatArray
    covariance_m2: FloatArray


class DeformationMean:
    """Mean residuals of the points in the axes of the body, the zero of deformation.

    reference_m (N, 3): the points at rest.
    """

    def __init__(self, reference_m: FloatArray) -> None:
        check_shape("reference_m", reference_m, (None, 3))
        self.reference_m = reference_m
        self._residual, self._covariance = RunningMean(), RunningMean()

    def add(self, points: Points3D, motion: RigidMotion) -> None:
        """Add the points (F, N) of further frames with their motion."""
        residual, covariance = self._residuals(points, motion)
        self._residual.add(residual)
        self._covariance.add(covariance)

    def _residuals(self, points: Points3D, motion: RigidMotion) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (F,N,3) from the rigid motion, and their covariance, NaN = missing."""
        frames, count, _ = points.position_m.shape
        check_shape("reference_m", self.reference_m, (count, 3))
        check_shape("motion.pose", motion.pose, (frames, 6))
        rotation = rotation_from_vector(motion.pose[:, 3:])
        rest = self.reference_m - motion.origin_m
        carried = points.position_m - motion.origin_m - motion.pose[:, None, :3]
        residual = carried @ rotation - rest
        arm = rest @ np.swapaxes(rotation, 1, 2)
        step_of_pose = np.linalg.inv(pose_rate(motion.pose))
        step_covariance = step_of_pose @ motion.covariance @ np.swapaxes(step_of_pose, 1, 2)
        covariance = np.empty((*arm.shape, 3))
        for frame, slope in enumerate(map(displacement_jacobian, arm)):
            left = points.covariance_m2[frame] - slope @ step_covariance[frame] @ np.swapaxes(slope, 1, 2)
            covariance[frame] = rotation[frame].T @ left @ rotation[frame]
        seen = np.asarray(np.isfinite(residual).all(axis=2) & np.isfinite(covariance).all(axis=(2, 3)))
        return np.where(seen[..., None], residual, np.nan), np.where(seen[..., None, None], covariance, np.nan)

    def of(self, points: Points3D, motion: RigidMotion) -> Deformation:
        """Return the deformation of frames that were added, all or some of them."""
        residual, individual = self._residuals(points, motion)
        number = np.maximum(self._residual.count[:, :1], 1)
        shared = np.nan_to_num(self._covariance.mean) / number[..., None]
        covariance = (1.0 - 2.0 / number)[..., None] * individual + shared
        return Deformation(self.reference_m, residual - self._residual.mean, covariance)


def deformation(points: Points3D, motion: RigidMotion, reference_m: FloatArray | None = None) -> Deformation:
    """Return the residuals of points (F, N) after their body's `motion` against a reference.

    reference (N, 3): by default frame 0. e = Rᵀ·(x' − o − t) − (x − o) without each point's mean over the F frames in
    which it is seen. This removes the noise of the reference, which is constant in the axes of the body. Bending
    appears reduced by its best rigid fit.

    Vₖ = Rᵀ·(Cₖ − J·Pₖ·Jᵀ)·R, J = [I, −[R·(x − o)]×], with the point's covariance Cₖ and that of the pose Pₖ (as shift
    and small left rotation). For points that the fit used it is the covariance of a least-squares residual, C − J·(Σ
    Jᵀ·C⁻¹·J)⁻¹·Jᵀ. The same applies to a motion from more than these points (an efficient estimate is uncorrelated with
    its difference from another one: Hausman 1978, Econometrica 46, 1251). The mean leaves (1 − 2/F)·Vₖ + Σ V/F².
    """
    reference = points.position_m[0] if reference_m is None else np.asarray(reference_m, dtype=np.float64)
    mean = DeformationMean(reference)
    mean.add(points, motion)
    return mean.of(points, motion)
