"""Stereo pixels to points in space, by maximum likelihood, with covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from photogram import _pinhole
from photogram._checks import FloatArray, check_shape
from photogram._inverse import invert
from photogram._kernel import njit
from photogram.camera import StereoRig
from photogram.rigid import RigidTransform

_STEPS = 20  # Gauss-Newton steps allowed; two or three are the rule
_CONVERGED = 1e-12  # a step this small relative to the depth ends the iteration


@dataclass(frozen=True, eq=False)
class Points:
    """Points in space: position_m (F, N, 3), covariance_m2 (F, N, 3, 3), reprojection_px (F, N); NaN = missing."""

    position_m: FloatArray
    covariance_m2: FloatArray
    reprojection_px: FloatArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        check_shape("position_m", self.position_m, (None, None, 3))
        check_shape("covariance_m2", self.covariance_m2, (*self.position_m.shape, 3))
        check_shape("reprojection_px", self.reprojection_px, self.position_m.shape[:2])

    def transformed(self, transform: RigidTransform) -> Points:
        """Return the points in another frame: R·x + t with covariance R·C·Rᵀ."""
        rotation = transform.rotation
        return replace(
            self,
            position_m=transform.apply(self.position_m),
            covariance_m2=rotation @ self.covariance_m2 @ rotation.T,
        )


def triangulate(
    rig: StereoRig,
    left_px: FloatArray,
    right_px: FloatArray,
    covariance_left_px2: FloatArray | None = None,
    covariance_right_px2: FloatArray | None = None,
) -> Points:
    """Return the most likely points (F, N), in the left camera's frame, for pixels (F, N, 2) seen by both cameras.

    Minimises Σ rᵀ·C⁻¹·r over both cameras, r the reprojection error in distorted pixels and C its covariance,
    broadcast to (F, N, 2, 2); `None` stands for 1 px² in each coordinate, so that the covariance of the point is then
    that of 1 px. Gauss-Newton from the midpoint of the two rays (Hartley and Sturm 1997, Computer Vision and Image
    Understanding 68, 146, whose optimum it is); covariance (Jᵀ·C⁻¹·J)⁻¹; `reprojection_px` is the rms of the four
    residuals, of which one degree of freedom remains. A point with NaN, without an inverse of the distortion, with
    parallel rays or behind a camera is NaN throughout.
    """
    left, right = np.asarray(left_px, dtype=np.float64), np.asarray(right_px, dtype=np.float64)
    check_shape("left_px", left, (None, None, 2))
    check_shape("right_px", right, left.shape)
    transform = rig.right_from_left
    position, covariance, reprojection = _triangulate_all(
        np.ascontiguousarray(left.reshape(-1, 2)),
        np.ascontiguousarray(right.reshape(-1, 2)),
        _precision("covariance_left_px2", covariance_left_px2, left.shape),
        _precision("covariance_right_px2", covariance_right_px2, left.shape),
        np.stack([rig.left.parameters, rig.right.parameters]),
        np.stack([np.eye(3), transform.rotation]),
        np.stack([np.zeros(3), transform.translation_m]),
    )
    frames, points = left.shape[:2]
    return Points(
        position.reshape(frames, points, 3),
        covariance.reshape(frames, points, 3, 3),
        reprojection.reshape(frames, points),
    )


def _precision(name: str, covariance: FloatArray | None, shape: tuple[int, ...]) -> FloatArray:
    """Return the inverse covariances (F·N, 3) as xx, xy, yy; NaN where the covariance is not positive definite."""
    if covariance is None:
        return np.broadcast_to(np.array([1.0, 0.0, 1.0]), (shape[0] * shape[1], 3)).copy()
    try:
        full = np.broadcast_to(np.asarray(covariance, dtype=np.float64), (*shape, 2)).reshape(-1, 2, 2)
    except ValueError as error:
        raise ValueError(f"{name}: expected shape {(*shape, 2)}, found {np.shape(covariance)}") from error
    xx, xy, yy = full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]
    determinant = xx * yy - xy * xy
    determinant = np.where((xx > 0) & (determinant > 0), determinant, np.nan)
    return np.stack([yy / determinant, -xy / determinant, xx / determinant], axis=1)


@njit()
def _triangulate_all(
    left: FloatArray,
    right: FloatArray,
    weight_left: FloatArray,
    weight_right: FloatArray,
    cameras: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Triangulate every point: position (M, 3), covariance (M, 3, 3), rms residual (M,); left camera first."""
    count = left.shape[0]
    position = np.full((count, 3), np.nan)
    covariance = np.full((count, 3, 3), np.nan)
    reprojection = np.full(count, np.nan)
    point, normal, gradient, inverse = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(count):
        _midpoint(left[i], right[i], cameras, rotations[1], translations[1], point)
        for _ in range(_STEPS):
            normal.fill(0.0)
            gradient.fill(0.0)
            squares = 0.0
            for side, pixel, weight in ((0, left[i], weight_left[i]), (1, right[i], weight_right[i])):
                rotation, translation = rotations[side], translations[side]
                squares += _add_camera(point, pixel, weight, cameras[side], rotation, translation, normal, gradient)
            if not invert(normal, inverse):
                break
            largest = 0.0
            for a in range(3):
                step = inverse[a, 0] * gradient[0] + inverse[a, 1] * gradient[1] + inverse[a, 2] * gradient[2]
                point[a] += step
                largest = max(largest, abs(step))
            if largest <= _CONVERGED * abs(point[2]):
                reprojection[i] = 0.5 * math.sqrt(squares)
                for a in range(3):
                    position[i, a] = point[a]
                    for b in range(3):
                        covariance[i, a, b] = inverse[a, b]
                break
    return position, covariance, reprojection


@njit()
def _midpoint(
    left: FloatArray,
    right: FloatArray,
    cameras: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    point: FloatArray,
) -> None:
    """Set point (3,) to the middle of the shortest line between the rays, in the left frame; NaN if parallel."""
    xl, yl = _pinhole.undistort(left[0], left[1], cameras[0])
    xr, yr = _pinhole.undistort(right[0], right[1], cameras[1])
    a, b, centre = np.ones(3), np.empty(3), np.empty(3)
    a[0], a[1] = xl, yl
    for i in range(3):
        b[i] = rotation[0, i] * xr + rotation[1, i] * yr + rotation[2, i]
        centre[i] = -(
            rotation[0, i] * translation[0] + rotation[1, i] * translation[1] + rotation[2, i] * translation[2]
        )
    aa, ab, bb, ac, bc = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        aa += a[i] * a[i]
        ab += a[i] * b[i]
        bb += b[i] * b[i]
        ac += a[i] * centre[i]
        bc += b[i] * centre[i]
    determinant = aa * bb - ab * ab
    met = determinant > 1e-14 * aa * bb
    along_a = (bb * ac - ab * bc) / determinant if met else math.nan
    along_b = (ab * ac - aa * bc) / determinant if met else math.nan
    for i in range(3):
        point[i] = 0.5 * (along_a * a[i] + centre[i] + along_b * b[i])


@njit()
def _add_camera(
    point: FloatArray,
    pixel: FloatArray,
    weight: FloatArray,
    camera: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
) -> float:
    """Add one camera's share to JᵀWJ (3, 3) and JᵀWr (3,); return its squared residual, NaN behind the camera."""
    p = np.empty(3)
    for i in range(3):
        p[i] = rotation[i, 0] * point[0] + rotation[i, 1] * point[1] + rotation[i, 2] * point[2] + translation[i]
    if not p[2] > 0.0:
        normal.fill(math.nan)
        return math.nan
    x, y = p[0] / p[2], p[1] / p[2]
    xd, yd, dxx, dxy, dyy = _pinhole.distort(x, y, camera)
    ru, rv = pixel[0] - (camera[0] * xd + camera[2]), pixel[1] - (camera[1] * yd + camera[3])
    ux, uy, vx, vy = camera[0] * dxx / p[2], camera[0] * dxy / p[2], camera[1] * dxy / p[2], camera[1] * dyy / p[2]
    jacobian = np.empty((2, 3))
    for i in range(3):
        dx, dy = rotation[0, i] - x * rotation[2, i], rotation[1, i] - y * rotation[2, i]
        jacobian[0, i], jacobian[1, i] = ux * dx + uy * dy, vx * dx + vy * dy
    for i in range(3):
        wu = jacobian[0, i] * weight[0] + jacobian[1, i] * weight[1]
        wv = jacobian[0, i] * weight[1] + jacobian[1, i] * weight[2]
        gradient[i] += wu * ru + wv * rv
        for j in range(3):
            normal[i, j] += wu * jacobian[0, j] + wv * jacobian[1, j]
    return float(ru * ru + rv * rv)
