"""Rigid transforms, named `b_from_a`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from operator import mul

import numpy as np

from shakercal._common.arrays import Arrays, BoolArray, FloatArray, check_shape
from shakercal._common.kernels import njit

_ORTHONORMAL = 1e-6  # largest departure of RᵀR from the identity for a rotation
_COLLINEAR = 1e-6  # smallest ratio of width to length of a point set that fixes a rotation


@dataclass(frozen=True, eq=False, repr=False)
class RigidTransform(Arrays, shapes="rotation 3 3; translation_m 3"):
    """The motion x_b = R·x_a + t, named `b_from_a`.

    Attributes
    ----------
    rotation : (3, 3) R.
    translation_m : (3,) t.

    Examples
    --------
    >>> quarter_turn = RigidTransform.from_pose(np.array([0.1, 0.0, 0.0, 0.0, 0.0, np.pi / 2]))
    >>> quarter_turn.apply(np.array([0.2, 0.0, 0.0])).round(3)
    array([0.1, 0.2, 0. ])
    >>> (quarter_turn @ quarter_turn.inverse()).pose.round(12).any()
    np.False_
    """

    rotation: FloatArray
    translation_m: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = self.rotation.tolist()  # plain numbers: arrays take longer for so few
        pairs = combinations_with_replacement(rows, 2)
        if not all(abs(sum(map(mul, one, other)) - (one is other)) <= _ORTHONORMAL for one, other in pairs):
            departure = float(np.abs(self.rotation.T @ self.rotation - np.eye(3)).max())
            raise ValueError(f"rotation: expected an orthonormal matrix, found a departure of {departure:.1e}")
        (a, b, c), (d, e, f), across = rows
        if sum(map(mul, (b * f - c * e, c * d - a * f, a * e - b * d), across)) < 0.0:
            raise ValueError("rotation: expected determinant +1, found -1 (a reflection)")

    @staticmethod
    def identity() -> RigidTransform:
        """Return the identity transform."""
        return RigidTransform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_pose(pose: FloatArray) -> RigidTransform:
        """Return the transform of pose (6,): translation (m), then rotation vector (rad)."""
        check_shape("pose", np.asarray(pose), (6,))
        pose = np.asarray(pose, dtype=np.float64)
        return RigidTransform(rotation_from_vector(pose[3:]), pose[:3].copy())

    @cached_property
    def pose(self) -> FloatArray:
        """The pose (6,): translation (m), then rotation vector (rad)."""
        return np.concatenate([self.translation_m, vector_from_rotation(self.rotation)])

    def apply(self, points_m: FloatArray) -> FloatArray:
        """Return R·x + t of points (..., 3)."""
        points = np.asarray(points_m)
        flat = points.reshape(-1, 3) @ self.rotation.T  # one product instead of one for each of the first axes
        return (flat + self.translation_m).reshape(points.shape)

    def inverse(self) -> RigidTransform:
        """Return `a_from_b` of `b_from_a`: x_a = Rᵀ·(x_b − t)."""
        return RigidTransform(self.rotation.T.copy(), -self.rotation.T @ self.translation_m)

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """Return the composition `c_from_b @ b_from_a` = `c_from_a`."""
        return RigidTransform(self.rotation @ other.rotation, self.apply(other.translation_m))


def skew(vector: FloatArray) -> FloatArray:
    """Return the cross-product matrices (...,3,3) of vectors (...,3): [v]×·x = v × x."""
    v = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return matrix


def displacement_jacobian(points_m: FloatArray) -> FloatArray:
    """Return [I, −[y]×] (..., 3, 6), the displacement of points by a small motion.

    Of points (..., 3) by a shift and a rotation about the origin.
    """
    points = np.asarray(points_m, dtype=np.float64)
    return np.concatenate([np.broadcast_to(np.eye(3), (*points.shape, 3)), -skew(points)], axis=-1)


def rotation_from_vector(vector_rad: FloatArray) -> FloatArray:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad.

    Rodrigues' formula R = I + sin φ/φ·[v]× + (1 − cos φ)/φ²·[v]×², φ = |v|, with the second coefficient written as
    ½·(sin(φ/2)/(φ/2))², which loses no digits at small angles.
    """
    v = np.asarray(vector_rad, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    cross = skew(v)
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def vector_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return the rotation vectors (...,3) in rad, |v| ≤ π, of matrices (...,3,3).

    By the unit quaternion's largest component (Shepperd 1978, J. Guidance and Control 1, 223): precise from 0 to π.
    """
    r = np.asarray(rotation, dtype=np.float64)
    candidates = np.empty((*r.shape[:-2], 4, 4))
    trace = np.trace(r, axis1=-2, axis2=-1)
    candidates[..., 0, 0] = 1 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        candidates[..., i + 1, i + 1] = 1 + 2 * r[..., i, i] - trace
        candidates[..., 0, i + 1] = candidates[..., i + 1, 0] = r[..., k, j] - r[..., j, k]
        candidates[..., j + 1, k + 1] = candidates[..., k + 1, j + 1] = r[..., k, j] + r[..., j, k]
    largest = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    chosen = np.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    chosen = np.where(chosen[..., :1] < 0, -chosen, chosen)
    quaternion = np.asarray(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True))
    real, imaginary = quaternion[..., :1], quaternion[..., 1:]
    sine = np.linalg.norm(imaginary, axis=-1, keepdims=True)
    half = np.arctan2(sine, real)
    ratio = np.where(sine > 0, 2 * half / np.where(sine > 0, sine, 1.0), 2.0)
    return np.asarray(ratio * imaginary)


def rotation_vector_rate(vector_rad: FloatArray) -> FloatArray:
    """Return d v / d δ (...,3,3) of rotation vectors by a left-multiplied δ.

    exp(δ)·exp(v) = exp(v + J⁻¹·δ), J⁻¹ = I − ½·[v]× + (1 − (φ/2)·cot(φ/2))/φ²·[v]×², the inverse left Jacobian of SO(3)
    (Chirikjian 2012, Stochastic Models, Information Theory, and Lie Groups 2, section 10.7).
    """
    v = np.asarray(vector_rad, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    small = angle < 1e-2
    half = np.where(small, 1.0, angle) / 2
    exact = (1 - half / np.tan(half)) / (4 * half**2)
    coefficient = np.where(small, 1 / 12 + angle**2 / 720 + angle**4 / 30240, exact)
    cross = skew(v)
    return np.asarray(np.eye(3) - 0.5 * cross + coefficient * (cross @ cross))


def pose_rate(pose: FloatArray) -> FloatArray:
    """Return d pose / d (shift, left-multiplied rotation) (..., 6, 6) of poses (..., 6)."""
    rate = np.broadcast_to(np.eye(6), (*pose.shape, 6)).copy()
    rate[..., 3:, 3:] = rotation_vector_rate(pose[..., 3:])
    return rate


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the rotations R (..., 3, 3), determinant +1, that maximise trace(Rᵀ·M).

    For matrices M (..., 3, 3). R = U·diag(1, 1, det(U·Vᵀ))·Vᵀ with M = U·S·Vᵀ (Arun, Huang, Blostein 1987, IEEE PAMI 9,
    698; the determinant from Umeyama 1991, IEEE PAMI 13, 376, eq. 43, which excludes the reflection).
    """
    u, _, vt = np.linalg.svd(matrix)
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    u = np.concatenate([u[..., :2], u[..., 2:] * sign[..., None, None]], axis=-1)
    return np.asarray(u @ vt)


def fixes_rotation(cross_scatter: FloatArray) -> BoolArray:
    """Return whether centred point sets determine a rotation.

    Their scatter Σ w·y·xᵀ (..., 3, 3) must have rank ≥ 2. Rejected are coincident points and those on one line: a width
    below 10⁻⁶ of their length.
    """
    singular = np.linalg.svd(cross_scatter, compute_uv=False)
    return np.asarray((singular[..., 0] > 0) & (singular[..., 1] > _COLLINEAR**2 * singular[..., 0]))


def fit_rigid(source_m: FloatArray, target_m: FloatArray) -> RigidTransform:
    """Fit the rigid transform that moves source (N,3) onto target (N,3) by least squares.

    Minimises Σ |y − R·x − t|²: centred on the means, rotation by `nearest_rotation` (Arun et al. 1987). Planar sets are
    allowed; points on one line, or fewer than three, do not determine the rotation and raise `ValueError`.
    """
    source, target = np.asarray(source_m, dtype=np.float64), np.asarray(target_m, dtype=np.float64)
    check_shape("source_m", source, (None, 3))
    check_shape("target_m", target, source.shape)
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError("source_m, target_m: expected finite points, found NaN or infinity; drop failed points first")
    if len(source) < 3:
        raise ValueError(f"source_m: expected at least 3 points, found {len(source)}")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    scatter = (target - target_mean).T @ (source - source_mean)
    if not fixes_rotation(scatter):
        raise ValueError("source_m: expected points that determine a rotation, found all on one line")
    rotation = nearest_rotation(scatter)
    return RigidTransform(rotation, target_mean - rotation @ source_mean)


@njit()
def invert(matrix: FloatArray, inverse: FloatArray) -> bool:
    """Invert a symmetric positive definite (3, 3) by its cofactors; return whether it is one."""
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            inverse[j, i] = matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]
    determinant = matrix[0, 0] * inverse[0, 0] + matrix[0, 1] * inverse[1, 0] + matrix[0, 2] * inverse[2, 0]
    if not determinant > 0.0:
        return False
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant
    return True
