"""Points through time to rigid motion, with covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from photogram._checks import BoolArray, FloatArray, IntArray, check_shape
from photogram._inverse import invert
from photogram._kernel import njit
from photogram.rigid import (
    fixes_rotation,
    nearest_rotation,
    rotation_from_vector,
    rotation_vector_rate,
    skew,
    vector_from_rotation,
)
from photogram.triangulate import Points

if TYPE_CHECKING:
    from scipy.sparse import sparray

_START_ROUNDS = 8  # rounds of the robust start
_CHOICE_ROUNDS = 8  # rounds in which points may be rejected and come back
_ROUNDS = 16  # rounds altogether; two or three are the rule
_REJECTED = 25.0  # squared distance, in scaled standard deviations, beyond which a point is an outlier
_MEDIAN_CHI2 = 2.3659738843753377  # median of χ² with three degrees of freedom
_BENT = 25.0  # reduced χ² beyond which points depart from a rigid motion by more than their noise
_FEWEST = 6  # with fewer points nobody is rejected
_ROUNDING = 1e-12  # of the coordinates: errors below it are rounding, never outliers
_SINGULAR = 1e-13  # smallest eigenvalue of a solvable system, scaled to a unit diagonal
_CONVERGED = 1e-13  # a step (m, rad) this small ends the iteration


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """Rigid motion of a body through time: x' = R(r)·(x − o) + o + t of frame k against the reference.

    pose (F, 6) = [t (m), r (rad, rotation vector)], covariance (F, 6, 6) of it, residual_m (F,) rms per coordinate,
    points (F,) used, origin_m (3,) = o. A frame that could not be fitted has NaN and 0 points.
    """

    pose: FloatArray
    covariance: FloatArray
    residual_m: FloatArray
    points: IntArray
    origin_m: FloatArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        check_shape("pose", self.pose, (None, 6))
        frames = len(self.pose)
        check_shape("covariance", self.covariance, (frames, 6, 6))
        check_shape("residual_m", self.residual_m, (frames,))
        check_shape("points", self.points, (frames,))
        check_shape("origin_m", self.origin_m, (3,))


def fit_motion(
    points: Points, reference_m: FloatArray | None, origin_m: FloatArray, correlation: sparray | None = None
) -> RigidMotion:
    """Return the rigid motion of every frame's points against reference (N, 3), by default the points of frame 0.

    Minimises Σ dᵢ², dᵢ² = eᵢᵀ·Cᵢ⁻¹·eᵢ, eᵢ = x'ᵢ − R·(xᵢ − o) − o − t, with the points' own covariances Cᵢ by
    Gauss-Newton. The start is Arun's fit (`rigid.nearest_rotation`) with Cauchy weights 1/(1 + eᵢ²/median e²),
    reweighted eight times, so that up to a third of outliers do not carry it away. In each round the frame's scale is
    s² = (1 + 5/(n − 2))²·median(dᵢ²)/2.366, the median of χ² with 3 degrees of freedom and the correction for few
    points of Rousseeuw and Leroy (1987, Robust Regression and Outlier Detection, p. 202; two points are used up by
    the six components); points with dᵢ² > 25·s² (1.5·10⁻⁵ of normal ones) are left out, and may come back during the
    first eight rounds. Fewer than six points reject nobody.

    The covariance is (Σ Jᵀ·C⁻¹·J)⁻¹ over the points used: the noise of this single frame as the points state it, not
    enlarged or reduced by the residuals. The noise of the reference is left out: it moves all frames of a series
    alike. Frame 0, whose pose against itself is exactly zero, gets a covariance of the same kind. A frame with fewer
    than three usable points, or with all on one line, is NaN.

    Points that depart from a rigid motion by more than five times their noise (median(dᵢ²)/2.366 > 25 at the start)
    belong to a body that bends. Their noise then says nothing about the misfit, and weights by it would turn the body
    to where it is known worst; such a frame is fitted with Cᵢ = I·median(eᵢ²)/2.366.

    Points of overlapping subsets have noise in common: with their `correlation` ρ (N, N) (`overlap_correlation`) and
    C = L·Lᵀ the covariance of two points is ρ·Lₙ·Lₘᵀ, and that of the pose N⁻¹·(Σₙₘ ρₙₘ·Bₙᵀ·Bₘ)·N⁻¹ with B = L⁻¹·J and
    N = Σ Bᵀ·B. Without it the points count as independent.
    """
    origin = np.asarray(origin_m, dtype=np.float64)
    check_shape("origin_m", origin, (3,))
    reference = points.position_m[0] if reference_m is None else np.asarray(reference_m, dtype=np.float64)
    check_shape("reference_m", reference, (points.position_m.shape[1], 3))
    if np.count_nonzero(np.isfinite(reference).all(axis=1)) < 3:
        raise ValueError("reference_m: expected at least 3 finite points; give a reference when frame 0 has none")
    source, target = reference - origin, points.position_m - origin
    precision = _precisions(np.ascontiguousarray(points.covariance_m2, dtype=np.float64))
    known = np.isfinite(precision).all(axis=(2, 3)) & np.isfinite(target).all(axis=2)
    if correlation is not None and correlation.shape != (len(reference), len(reference)):
        raise ValueError(f"correlation: expected a matrix of {len(reference)} points, found {correlation.shape}")
    return _fit(source, target, precision, known & np.isfinite(source).all(axis=1), origin, correlation)


def relative_to(motion: RigidMotion, mean_pose: FloatArray) -> RigidMotion:
    """Return the motion T_k·T_mean⁻¹ against another pose (6,), such as the mean, about the same origin.

    The origin then is the material point that is there in that pose. The pose is taken as exact: with T_k changed by
    a small left rotation δ and shift τ, t changes by τ − δ × (R_rel·t_mean). Residuals and points stay.
    """
    mean = np.asarray(mean_pose, dtype=np.float64)
    check_shape("mean_pose", mean, (6,))
    rotation = rotation_from_vector(motion.pose[:, 3:])
    relative = rotation @ rotation_from_vector(mean[3:]).T
    carried = relative @ mean[:3]
    vector = vector_from_rotation(relative)
    jacobian = np.zeros((len(rotation), 6, 6))
    jacobian[:, :3, :3] = np.eye(3)
    rotations = np.linalg.inv(rotation_vector_rate(motion.pose[:, 3:]))
    jacobian[:, :3, 3:] = skew(carried) @ rotations
    jacobian[:, 3:, 3:] = rotation_vector_rate(vector) @ rotations
    return replace(
        motion,
        pose=np.concatenate([motion.pose[:, :3] - carried, vector], axis=1),
        covariance=jacobian @ motion.covariance @ np.swapaxes(jacobian, 1, 2),
    )


def points_with_estimated_noise(position_m: FloatArray, reference_m: FloatArray | None = None) -> Points:
    """Return points (F, N, 3) of unknown covariance with the covariance that their own rigid fit shows.

    One 3×3 covariance for all: the residuals of an unweighted rigid fit of every frame, about each point's mean over
    time (which takes out the noise of the reference), pooled over points and frames, divided by the degrees of freedom
    (F' − 1)·(N − 2) left of F' frames with a fit; outliers are left out as in `fit_motion`. `reprojection_px` is NaN.
    """
    position = np.asarray(position_m, dtype=np.float64)
    check_shape("position_m", position, (None, None, 3))
    unit = Points(position, np.broadcast_to(np.eye(3), (*position.shape, 3)), np.full(position.shape[:2], np.nan))
    start = 1 if reference_m is None else 0
    motion = fit_motion(unit, reference_m, np.zeros(3))
    reference = position[0] if reference_m is None else np.asarray(reference_m, dtype=np.float64)
    moved = reference @ np.swapaxes(rotation_from_vector(motion.pose[:, 3:]), 1, 2) + motion.pose[:, None, :3]
    error = (position - moved)[start:]
    covariance = _pooled(error, motion.residual_m[start:])
    known = np.asarray(np.isfinite(position).all(axis=2))[..., None, None]
    return replace(unit, covariance_m2=np.where(known, covariance, np.nan))


def _pooled(error: FloatArray, residual: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) over time of errors (F, N, 3) without those beyond five of their frame's rms."""
    inside = np.less_equal((error**2).sum(axis=2), _REJECTED * residual[:, None] ** 2)
    count = np.asarray(inside.sum(axis=0))
    kept = np.asarray(inside & (count >= 2), dtype=np.bool_)
    error = np.where(kept[..., None], error, 0.0)
    deviation = np.where(kept[..., None], error - error.sum(axis=0) / np.maximum(count, 1)[:, None], 0.0)
    tracks = int(np.count_nonzero(count >= 2))
    freedom = (int(kept.sum()) - tracks) * (1 - 2 / max(tracks, 3))
    if tracks < 3:
        raise ValueError("position_m: expected at least 3 points in 2 frames besides the reference to estimate noise")
    return np.asarray(np.einsum("fni,fnj->ij", deviation, deviation) / freedom)


def _fit(
    source: FloatArray,
    target: FloatArray,
    precision: FloatArray,
    usable: BoolArray,
    origin: FloatArray,
    correlation: sparray | None,
) -> RigidMotion:
    """Fit the frames that can be fitted and leave the others NaN."""
    source, target = np.where(np.isfinite(source), source, 0.0), np.where(usable[..., None], target, 0.0)
    rotation, translation, fixed = _robust_start(source, target, usable)
    fixed &= usable.sum(axis=1) >= 3
    used = usable = usable & fixed[:, None]
    precision = _without_noise_weights(
        precision, target - source @ np.swapaxes(rotation, 1, 2) - translation[:, None], usable
    )
    size = np.where(usable, np.trace(precision, axis1=2, axis2=3) * (target**2).sum(axis=2), 0.0)
    smallest = _ROUNDING**2 * size.max(axis=1, initial=0.0)
    for number in range(_ROUNDS):
        before = used
        arm = source @ np.swapaxes(rotation, 1, 2)
        error = target - arm - translation[:, None]
        if number < _CHOICE_ROUNDS:
            used = _choose(np.einsum("fni,fnij,fnj->fn", error, precision, error), smallest, usable)
        normal, gradient = _normal_equations(arm, error, precision, used)
        fixed &= _solvable(normal)
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
    return RigidMotion(
        pose=np.where(fixed[:, None], pose, np.nan),
        covariance=np.where(fixed[:, None, None], _pose_covariance(step_covariance, pose), np.nan),
        residual_m=np.where(fixed, np.sqrt(squares / (3 * np.maximum(used.sum(axis=1), 1))), np.nan),
        points=used.sum(axis=1).astype(np.int64),
        origin_m=origin,
    )


def _without_noise_weights(precision: FloatArray, error: FloatArray, usable: BoolArray) -> FloatArray:
    """Return precisions (F, N, 3, 3), in frames whose errors are far above the points' noise those of the errors."""
    squares = np.einsum("fni,fnij,fnj->fn", error, np.where(usable[..., None, None], precision, 0.0), error)
    bent = _median(squares, usable) > _BENT * _MEDIAN_CHI2
    bent &= usable.sum(axis=1) >= _FEWEST
    variance = np.where(bent, _median((error**2).sum(axis=2), usable) / _MEDIAN_CHI2, 1.0)
    same = np.eye(3) / variance[:, None, None, None]
    return np.where(bent[:, None, None, None], same, precision)


def _pose_covariance(step_covariance: FloatArray, pose: FloatArray) -> FloatArray:
    """Return the covariance (F, 6, 6) of shift and rotation vector from that of shift and small left rotation."""
    rate = np.broadcast_to(np.eye(6), step_covariance.shape).copy()
    rate[:, 3:, 3:] = rotation_vector_rate(pose[:, 3:])
    return np.asarray(rate @ step_covariance @ np.swapaxes(rate, 1, 2))


def _correlated_normal(arm: FloatArray, precision: FloatArray, used: BoolArray, correlation: sparray) -> FloatArray:
    """Return Σₙₘ ρₙₘ·Bₙᵀ·Bₘ (F, 6, 6) over the points used, B = Gᵀ·[I, −[a]×] with precisions G·Gᵀ."""
    count = used.shape[1]
    total = np.empty((len(used), 6, 6))
    for f, here in enumerate(used):
        whitened = np.zeros((count, 3, 6))
        root = np.swapaxes(np.linalg.cholesky(precision[f, here]), 1, 2)
        whitened[here] = np.concatenate([root, -root @ skew(arm[f, here])], axis=2)
        shared = np.asarray(correlation @ whitened.reshape(count, 18)).reshape(count, 3, 6)
        total[f] = np.einsum("nki,nkj->ij", whitened, shared)
    return total


def _robust_start(
    source: FloatArray, target: FloatArray, usable: BoolArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return rotations, translations and whether each frame's points fix them: Arun's fit with Cauchy weights."""
    weight = usable.astype(np.float64)
    rotation, translation = np.empty((len(target), 3, 3)), np.empty((len(target), 3))
    fixed = np.ones(len(target), dtype=np.bool_)
    for _ in range(_START_ROUNDS):
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
    """Return the inverses of covariances (F, N, 3, 3), NaN where one is not positive definite."""
    frames, count = covariance.shape[:2]
    precision = np.full((frames, count, 3, 3), np.nan)
    inverse = np.empty((3, 3))
    for f in range(frames):
        for i in range(count):
            one = covariance[f, i]
            if one[0, 0] > 0.0 and one[1, 1] > 0.0 and one[2, 2] > 0.0 and invert(one, inverse):
                precision[f, i] = inverse
    return precision


def _median(values: FloatArray, usable: BoolArray) -> FloatArray:
    """Return each frame's median of the usable values (F, N), infinite where there is none."""
    ordered = np.sort(np.where(usable, values, np.inf), axis=1)
    count, frame = np.maximum(usable.sum(axis=1), 1), np.arange(len(values))
    return np.asarray(0.5 * (ordered[frame, (count - 1) // 2] + ordered[frame, count // 2]))


def _choose(squares: FloatArray, smallest: FloatArray, usable: BoolArray) -> BoolArray:
    """Return the usable points (F, N) whose squared Mahalanobis distance is no outlier among those of their frame."""
    count = usable.sum(axis=1)
    few = count < _FEWEST
    correction = (1 + 5 / np.maximum(count - 2, 1)) ** 2
    scale = np.maximum(correction * _median(squares, usable) / _MEDIAN_CHI2, smallest)
    return np.asarray(usable & (few[:, None] | (squares <= _REJECTED * scale[:, None])))


@njit()
def _normal_equations(
    arm: FloatArray, error: FloatArray, precision: FloatArray, used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return Σ Jᵀ·W·J (F, 6, 6) and Σ Jᵀ·W·e (F, 6), J = [I, −[a]×], for a shift and a small left rotation.

    Arms a = R·x and errors e are (F, N, 3); Jᵀ·v = [v, a × v].
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


def _solvable(normal: FloatArray) -> BoolArray:
    """Return which normal matrices (F, 6, 6) fix all six components."""
    diagonal = np.diagonal(normal, axis1=1, axis2=2)
    positive = (diagonal > 0).all(axis=1)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    lowest = np.linalg.eigvalsh(normal / (scale[:, :, None] * scale[:, None, :]))[:, 0]
    return np.asarray(positive & (lowest > _SINGULAR))
