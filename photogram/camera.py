"""Cameras, single and in pairs: projection with distortion, its inverse, triangulation.

To the compiled kernels a camera is the vector [fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 s]. The model is OpenCV's rational
one with skew (Brown 1971, Photogrammetric Engineering 37, 855; Claus and Fitzgibbon 2005, CVPR, 213). With r² = x² + y²
the radial factor is `g = (1 + k1·r² + k2·r⁴ + k3·r⁶)/(1 + k4·r² + k5·r⁴ + k6·r⁶)`. Distorted coordinates are `x_d = x·g
+ 2·p1·x·y + p2·(r² + 2·x²)` and `y_d = y·g + p1·(r² + 2·y²) + 2·p2·x·y`. Pixels are `u = fx·x_d + s·y_d + cx` and `v =
fy·y_d + cy`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from photogram.geometry import RigidTransform, invert, rotation_from_vector, skew
from shakercal._common.arrays import Arrays, FloatArray, IntArray, check_shape
from shakercal._common.kernels import njit
from shakercal._common.propagation import derivatives

_NEWTON_STEPS = 60  # damped Newton steps of the inverse; usually five are needed
_RESIDUAL = 1e-13  # largest residual, in normalised units, of a converged inverse


@njit()
def distort(x: float, y: float, camera: FloatArray) -> tuple[float, float, float, float, float]:
    """Return x_d, y_d and ∂x_d/∂x, ∂x_d/∂y = ∂y_d/∂x, ∂y_d/∂y; NaN beyond a pole."""
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    r2 = x * x + y * y
    gain = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    k4, k5, k6 = camera[9], camera[10], camera[11]
    if k4 != 0.0 or k5 != 0.0 or k6 != 0.0:
        under = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        under = under if under > 0.0 else math.nan
        gain /= under
        slope = (slope - gain * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / under
    slope *= 2.0
    xd = x * gain + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * gain + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    dxx = gain + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = gain + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, dxx, dxy, dyy


@njit()
def undistort(u: float, v: float, camera: FloatArray) -> tuple[float, float]:
    """Return the normalised x, y of a pixel, NaN where the distortion is not invertible.

    Newton's method from the distorted point, each step halved until the residual falls, to the last digit.
    """
    target_y = (v - camera[3]) / camera[1]
    target_x = (u - camera[2] - camera[12] * target_y) / camera[0]
    x, y = target_x, target_y
    xd, yd, dxx, dxy, dyy = distort(x, y, camera)
    for _halving in range(12):  # where the distorted point itself lies beyond a pole or a turning point
        if dxx * dyy - dxy * dxy > 0.0 and dxx > 0.0:
            break
        x, y = 0.5 * x, 0.5 * y
        xd, yd, dxx, dxy, dyy = distort(x, y, camera)
    residual = math.hypot(target_x - xd, target_y - yd)
    for _ in range(_NEWTON_STEPS):
        determinant = dxx * dyy - dxy * dxy
        if not determinant > 0.0:
            return math.nan, math.nan
        step_x = (dyy * (target_x - xd) - dxy * (target_y - yd)) / determinant
        step_y = (dxx * (target_y - yd) - dxy * (target_x - xd)) / determinant
        scale, smaller = 1.0, False
        for _halving in range(12):
            xd, yd, dxx, dxy, dyy = distort(x + scale * step_x, y + scale * step_y, camera)
            tried = math.hypot(target_x - xd, target_y - yd)
            smaller = tried < residual and dxx * dyy - dxy * dxy > 0.0
            if smaller:
                break
            scale *= 0.5
        if not smaller:
            break
        x, y, residual = x + scale * step_x, y + scale * step_y, tried
    if not residual <= _RESIDUAL * (1.0 + math.hypot(target_x, target_y)):
        return math.nan, math.nan
    return x, y


@njit()
def project_one(x: float, y: float, z: float, camera: FloatArray) -> tuple[float, float]:
    """Return the pixel of a point in the camera frame; NaN behind the camera."""
    if not z > 0.0:
        return math.nan, math.nan
    xd, yd, _, _, _ = distort(x / z, y / z, camera)
    return camera[0] * xd + camera[12] * yd + camera[2], camera[1] * yd + camera[3]


@njit()
def project_all(points: FloatArray, camera: FloatArray) -> FloatArray:
    """Return the pixels (N,2) of points (N,3) in the camera frame; NaN behind it."""
    pixels = np.empty((points.shape[0], 2))
    for i in range(points.shape[0]):
        pixels[i, 0], pixels[i, 1] = project_one(points[i, 0], points[i, 1], points[i, 2], camera)
    return pixels


@njit()
def undistort_all(pixels: FloatArray, camera: FloatArray) -> FloatArray:
    """Return the normalised coordinates (N, 2) of pixels (N, 2)."""
    normalised = np.empty((pixels.shape[0], 2))
    for i in range(pixels.shape[0]):
        normalised[i, 0], normalised[i, 1] = undistort(pixels[i, 0], pixels[i, 1], camera)
    return normalised


# The pinhole camera with lens distortion, and the stereo pair.

CAMERA_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "skew")
_PLAIN = 9  # parameters of a camera whose further ones are zero
RIG_PARAMETERS = (
    *(f"{side}.{name}" for side in ("left", "right") for name in CAMERA_PARAMETERS[:_PLAIN]),
    *(f"{part}.{axis}" for part in ("rotation", "translation") for axis in "xyz"),
    *(f"{side}.{name}" for side in ("left", "right") for name in CAMERA_PARAMETERS[_PLAIN:]),
)
_PLAIN_RIG = 24  # 2 x 9 of the cameras, 6 of the pose
ROTATION, TRANSLATION = slice(18, 21), slice(21, 24)
LEFT, RIGHT = (np.array([RIG_PARAMETERS.index(f"{s}.{n}") for n in CAMERA_PARAMETERS]) for s in ("left", "right"))
"""Indices of the two cameras' parameters among those of the rig."""


def _padded(name: str, array: FloatArray, plain: int, full: int) -> FloatArray:
    array = np.asarray(array, dtype=np.float64)
    if array.shape == (plain,) * array.ndim:
        return np.pad(array, (0, full - plain))
    check_shape(name, array, (full,) * array.ndim)
    return array


@dataclass(frozen=True, eq=False, repr=False)
class Camera(Arrays, shapes="matrix 3 3; distortion 8; size_px 2"):
    """A pinhole camera with lens distortion: OpenCV's model and pixels, with a skew.

    u = fx·x_d + s·y_d + cx with the distorted x_d of x = X/Z, s = matrix[0, 1]; an integer pixel is a pixel centre.

    Attributes
    ----------
    matrix : (3, 3) in px.
    distortion : (8,) k1 k2 p1 p2 k3 k4 k5 k6; one of five coefficients has zeros for k4 k5 k6.
    size_px : (2,) width and height.

    Examples
    --------
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, -0.1, 0, 0, 0, 0]), np.array([640, 480]))
    >>> camera.project(np.array([0.05, 0.0, 0.5])).round(3)
    array([419.9, 240. ])
    >>> camera.undistort(np.array([419.9, 240.0])).round(6)
    array([0.1, 0. ])
    """

    matrix: FloatArray
    distortion: FloatArray
    size_px: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", _padded("distortion", self.distortion, 5, 8))
        super().__post_init__()
        if not (np.isfinite(self.matrix).all() and np.isfinite(self.distortion).all()):
            raise ValueError("matrix, distortion: expected finite numbers, found NaN or infinity")
        k = self.matrix
        if k[1, 0] != 0 or not np.array_equal(k[2], [0, 0, 1]) or k[0, 0] <= 0 or k[1, 1] <= 0:
            raise ValueError(f"matrix: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]], fx, fy > 0, found {k.tolist()}")

    @staticmethod
    def from_parameters(parameters: FloatArray, size_px: IntArray) -> Camera:
        """Return the camera of `CAMERA_PARAMETERS` (13,), or of the first (9,), others zero."""
        full = _padded("parameters", parameters, _PLAIN, len(CAMERA_PARAMETERS))
        (fx, fy, cx, cy), skew_px = full[:4], full[12]
        return Camera(np.array([[fx, skew_px, cx], [0, fy, cy], [0, 0, 1.0]]), full[4:12], size_px)

    @property
    def parameters(self) -> FloatArray:
        """The vector (13,) of `CAMERA_PARAMETERS`."""
        k = self.matrix
        return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *self.distortion, k[0, 1]], dtype=np.float64)

    def project(self, points_m: FloatArray) -> FloatArray:
        """Return the pixels (...,2) of points (...,3) in the camera frame; NaN behind it."""
        points = np.asarray(points_m, dtype=np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        return np.asarray(project_all(flat, self.parameters)).reshape(*points.shape[:-1], 2)

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Return the normalised coordinates (...,2), x = X/Z and y = Y/Z, of pixels (...,2).

        The inverse of `project`; NaN where the distortion reaches no such pixel.
        """
        flat = np.ascontiguousarray(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
        return np.asarray(undistort_all(flat, self.parameters)).reshape(np.shape(pixels))


@dataclass(frozen=True, eq=False, repr=False)
class StereoRig(Arrays, shapes="covariance 32 32"):
    """Two calibrated cameras with x_right = R·x_left + t.

    Attributes
    ----------
    left, right, right_from_left : the cameras, and R and t in m.
    covariance : (32, 32) of `RIG_PARAMETERS`, or None. One of the first (24, 24), without the cameras' k4 k5 k6 and
        skew, has zeros for these. The three rotation parameters are a small rotation vector δ (rad) multiplied from the
        left: exp(δ)·R.

    Examples
    --------
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    >>> rig.project(np.array([0.0, 0.0, 0.5]))
    (array([320., 240.]), array([120., 240.]))
    """

    left: Camera
    right: Camera
    right_from_left: RigidTransform
    covariance: FloatArray | None = None

    parameters: ClassVar[tuple[str, ...]] = RIG_PARAMETERS

    def __post_init__(self) -> None:
        if self.covariance is not None:
            full = _padded("covariance", self.covariance, _PLAIN_RIG, len(RIG_PARAMETERS))
            object.__setattr__(self, "covariance", full)
            sigma = np.sqrt(np.abs(np.diagonal(self.covariance)))
            scale = np.outer(sigma, sigma)
            if not (np.abs(self.covariance - self.covariance.T) <= 1e-9 * scale).all():
                raise ValueError(
                    "covariance: expected a symmetric matrix of finite numbers, zero where a variance is zero"
                )
            correlation = self.covariance / np.where(scale > 0, scale, 1.0)
            lowest = float(np.linalg.eigvalsh(correlation)[0])
            if lowest < -1e-9:
                raise ValueError(
                    f"covariance: expected no negative variance in any direction, found {lowest:.1e} (correlation)"
                )

    @property
    def camera_poses(self) -> tuple[tuple[Camera, RigidTransform], ...]:
        """Both cameras, each with camera_from_left."""
        return (self.left, RigidTransform.identity()), (self.right, self.right_from_left)

    @property
    def values(self) -> FloatArray:
        """The values (32,) of `RIG_PARAMETERS`, zero for those of the rotation."""
        values = np.zeros(len(RIG_PARAMETERS))
        values[LEFT], values[RIGHT] = self.left.parameters, self.right.parameters
        values[TRANSLATION] = self.right_from_left.translation_m
        return values

    def perturbed(self, delta: FloatArray) -> StereoRig:
        """Return the rig with `RIG_PARAMETERS` changed by delta, (32,) or the first (24,)."""
        delta = _padded("delta", delta, _PLAIN_RIG, len(RIG_PARAMETERS))
        return replace(
            self,
            left=Camera.from_parameters(self.left.parameters + delta[LEFT], self.left.size_px),
            right=Camera.from_parameters(self.right.parameters + delta[RIGHT], self.right.size_px),
            right_from_left=RigidTransform(
                rotation_from_vector(delta[ROTATION]) @ self.right_from_left.rotation,
                self.right_from_left.translation_m + delta[TRANSLATION],
            ),
        )

    def project(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the left and right pixels (...,2) of points (...,3) in the left camera's frame."""
        return self.left.project(points_m), self.right.project(self.right_from_left.apply(points_m))

    @property
    def essential(self) -> FloatArray:
        """E = [t]×·R (3, 3): (x', y', 1)·E·(x, y, 1)ᵀ = 0 in normalised coordinates."""
        return skew(self.right_from_left.translation_m) @ self.right_from_left.rotation

    def fundamental(self) -> FloatArray:
        """Return F (3,3) with (u',v',1)·F·(u,v,1)ᵀ = 0 for left (u,v) and right (u',v').

        F = K_right⁻ᵀ·E·K_left⁻¹ (Hartley and Zisserman 2004, eq. 9.12), scaled to norm 1. Distortion is excluded: the
        equation is valid for ideal pixels, and for real ones within the lenses' distortion.
        """
        matrix = np.linalg.inv(self.right.matrix).T @ self.essential @ np.linalg.inv(self.left.matrix)
        return np.asarray(matrix / np.linalg.norm(matrix))


def epipolar_residual(
    rig: StereoRig, left_px: FloatArray, right_px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return epipolar residuals (...) in px of matches (..., 2), and their derivatives.

    e = x'ᵀ·F·x / |(F·x)₁₂| is the signed distance of the right point from the epipolar line of the left one (Hartley
    and Zisserman 2004, sections 9.2 and 11.4.3). It refers to the undistorted image: F acts on pixels without
    distortion. The derivatives (..., 2) by the left and right pixels treat the distortion as constant over a point's
    noise. A NaN stays one.
    """
    rays = rig.left.undistort(left_px), rig.right.undistort(right_px)
    left, right = (np.concatenate([ray, np.ones((*ray.shape[:-1], 1))], axis=-1) for ray in rays)
    by_right, by_left = left @ rig.essential.T, right @ rig.essential
    slope_right = by_right[..., :2] @ np.linalg.inv(rig.right.matrix[:2, :2])
    slope_left = by_left[..., :2] @ np.linalg.inv(rig.left.matrix[:2, :2])
    length = np.linalg.norm(slope_right, axis=-1)
    residual = (by_right * right).sum(axis=-1) / length
    return residual, slope_left / length[..., None], slope_right / length[..., None]


def principal_components(covariance: FloatArray) -> FloatArray:
    """Return steps (P, N), one standard deviation along each principal component of a covariance.

    Components of the correlation matrix of the covariance (N, N), so that parameters of different units count equally:
    Σ sᵀ·s is the covariance.
    """
    sigma = np.sqrt(np.diagonal(covariance))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    significant = eigenvalues > 1e-9 * eigenvalues[-1]
    return np.asarray((vectors[:, significant] * np.sqrt(eigenvalues[significant])).T * sigma)


# Stereo pixels to points in space, by maximum likelihood, with covariance.

_GAUSS_NEWTON_STEPS = 20  # Gauss-Newton steps allowed; usually two or three are needed
_CONVERGED = 1e-12  # a step this small relative to the depth ends the iteration


@dataclass(frozen=True, eq=False, repr=False)
class Points3D(Arrays, shapes="position_m F N 3; covariance_m2 F N 3 3; reprojection_px F N"):
    """Points in space with covariances and reprojection residuals, NaN = missing."""

    position_m: FloatArray
    covariance_m2: FloatArray
    reprojection_px: FloatArray

    def transformed(self, transform: RigidTransform) -> Points3D:
        """Return the points in another frame: R·x + t with covariance R·C·Rᵀ."""
        rotation = transform.rotation
        return replace(
            self, position_m=transform.apply(self.position_m), covariance_m2=rotation @ self.covariance_m2 @ rotation.T
        )


def triangulate(
    rig: StereoRig,
    left_px: FloatArray,
    right_px: FloatArray,
    covariance_left_px2: FloatArray | None = None,
    covariance_right_px2: FloatArray | None = None,
) -> Points3D:
    """Return the most likely points (F,N), in the left camera's frame, of a stereo pair.

    Parameters
    ----------
    rig
        The pair.
    left_px, right_px
        (F, N, 2) pixels of the same points in both cameras.
    covariance_left_px2, covariance_right_px2
        Broadcast to (F, N, 2, 2); None (default) is 1 px² in each coordinate.

    Returns
    -------
    Points3D
        Positions in m with covariance (Jᵀ·C⁻¹·J)⁻¹; `reprojection_px` is the rms of the four residuals, of which one
        degree of freedom remains. NaN for a point with NaN, without an inverse of the distortion, with parallel rays or
        behind a camera.

    Notes
    -----
    Minimises Σ rᵀ·C⁻¹·r over both cameras, r the reprojection error in distorted pixels and C its covariance.
    Gauss-Newton from the midpoint of the two rays (Hartley and Sturm 1997, Computer Vision and Image Understanding 68,
    146, whose optimum it is).

    Examples
    --------
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    >>> triangulate(rig, np.array([[[320.0, 240.0]]]), np.array([[[120.0, 240.0]]])).position_m.round(6)
    array([[[0. , 0. , 0.5]]])
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
    return Points3D(
        position.reshape(frames, points, 3),
        covariance.reshape(frames, points, 3, 3),
        reprojection.reshape(frames, points),
    )


# A single camera: its points lie on a face of stated position.

FACE_PARAMETERS = (*CAMERA_PARAMETERS, "face.distance", "face.tilt_1", "face.tilt_2")
ALONG = 1e4  # standard deviation along a ray over that across it: undetermined depth, invertible matrices
_FACE_STEP_M = 1e-6  # of the derivative of a pixel by its point


@dataclass(frozen=True, eq=False, repr=False)
class FaceCamera(Arrays, shapes="point_m 3; normal 3; covariance 16 16"):
    """A single camera, and the plane of a body's face at rest.

    The plane in the camera's frame contains point_m (3,) and has the unit normal (3,). The covariance (16, 16) is that
    of `FACE_PARAMETERS` or None. These are the camera's, the plane's position along its normal (m), and its turns (rad)
    about two axes across the normal.

    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    >>> rig = FaceCamera(camera, np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, -1.0]))
    >>> locate(rig, [np.array([[[520.0, 240.0]]])]).position_m.round(6)
    array([[[0.1, 0. , 0.5]]])
    """

    camera: Camera
    point_m: FloatArray
    normal: FloatArray
    covariance: FloatArray | None = None

    parameters: ClassVar[tuple[str, ...]] = FACE_PARAMETERS

    @property
    def camera_poses(self) -> tuple[tuple[Camera, RigidTransform], ...]:
        """The camera, in its frame."""
        return ((self.camera, RigidTransform.identity()),)

    def move_face(self, by: RigidTransform) -> FaceCamera:
        """Return the camera with the face displaced by a rigid motion in the camera's frame."""
        return replace(self, point_m=by.apply(self.point_m), normal=by.rotation @ self.normal)

    def perturbed(self, delta: FloatArray) -> FaceCamera:
        """Return camera and face with `FACE_PARAMETERS` changed by delta (16,)."""
        first_of_face = len(CAMERA_PARAMETERS)
        across_axis = np.cross(self.normal, np.eye(3)[int(np.argmin(np.abs(self.normal)))])
        across_axis /= np.linalg.norm(across_axis)
        turn = rotation_from_vector(
            delta[first_of_face + 1] * across_axis + delta[first_of_face + 2] * np.cross(self.normal, across_axis)
        )
        return replace(
            self,
            camera=Camera.from_parameters(self.camera.parameters + delta[:first_of_face], self.camera.size_px),
            point_m=self.point_m + delta[first_of_face] * self.normal,
            normal=turn @ self.normal,
        )


Rig = StereoRig | FaceCamera


def locate(
    rig: Rig,
    positions_px: Sequence[FloatArray],
    covariances_px2: Sequence[FloatArray] | None = None,
    face_motion: FloatArray | None = None,
) -> Points3D:
    """Return points (F,N) in the first camera's frame from pixels (F,N,2).

    A pair triangulates. For a single camera the points are the intersections of their rays with the face. In each frame
    the face has the motion `face_motion` (F, 6) about the camera's centre. The undetermined direction along a ray has
    10⁴ times the uncertainty of the directions across it. A fit of the points by their covariances therefore uses the
    distances of the rays. No residual remains (`reprojection_px` NaN).
    """
    if isinstance(rig, StereoRig):
        return triangulate(rig, *positions_px, *(covariances_px2 or ()))
    (pixels,) = positions_px
    check_shape("places_px", pixels, (None, None, 2))
    poses = np.zeros((len(pixels), 6)) if face_motion is None else face_motion
    faces = [rig.move_face(RigidTransform.from_pose(pose)) for pose in poses]
    rays = np.concatenate([rig.camera.undistort(pixels), np.ones((*pixels.shape[:2], 1))], axis=2)
    normal = np.array([face.normal for face in faces])
    height = np.array([face.normal @ face.point_m for face in faces])
    position = rays * (height[:, None] / np.einsum("fni,fi->fn", rays, normal))[..., None]
    position[~(position[..., 2] > 0.0)] = np.nan
    slope = derivatives(lambda step: rig.camera.project(position + step), np.full(3, _FACE_STEP_M))
    weight = np.eye(2) if covariances_px2 is None else covariances_px2[0]
    finite = np.asarray(np.isfinite(slope).all(axis=(2, 3)) & np.isfinite(weight).all(axis=(-2, -1)))
    weight = np.linalg.inv(np.where(finite[..., None, None], weight, np.eye(2)))
    across = np.swapaxes(slope, 2, 3) @ weight @ slope
    undetermined = np.einsum("fni,fnj->fnij", rays, rays) / np.sum(rays**2, axis=2)[..., None, None]
    precision = across + undetermined * (np.trace(across, axis1=2, axis2=3) / (2.0 * ALONG**2))[..., None, None]
    covariance = np.linalg.inv(np.where(finite[..., None, None], precision, np.eye(3)))
    return Points3D(
        np.where(finite[..., None], position, np.nan),
        np.where(finite[..., None, None], covariance, np.nan),
        np.full(finite.shape, np.nan),
    )


def _precision(name: str, covariance: FloatArray | None, shape: tuple[int, ...]) -> FloatArray:
    """Return the inverse covariances (F·N, 3) as xx, xy, yy, NaN if not positive definite."""
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
def _triangulate_all(left, right, weight_left, weight_right, cameras, rotations, translations):  # type: ignore[no-untyped-def]
    """Return position (M, 3), covariance (M, 3, 3), rms residual (M,) of every point."""
    count = left.shape[0]
    position = np.full((count, 3), np.nan)
    covariance = np.full((count, 3, 3), np.nan)
    reprojection = np.full(count, np.nan)
    point, normal, gradient, inverse = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(count):
        _midpoint(left[i], right[i], cameras, rotations[1], translations[1], point)
        for _ in range(_GAUSS_NEWTON_STEPS):
            normal.fill(0.0)
            gradient.fill(0.0)
            squares = 0.0
            for side, pixel, weight in ((0, left[i], weight_left[i]), (1, right[i], weight_right[i])):
                placed = cameras[side], rotations[side], translations[side]
                squares += _add_camera(point, pixel, weight, placed, normal, gradient)
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
def _midpoint(left, right, cameras, rotation, translation, point):  # type: ignore[no-untyped-def]
    """Set point (3,) in the left frame to the middle between rays, NaN if parallel."""
    xl, yl = undistort(left[0], left[1], cameras[0])
    xr, yr = undistort(right[0], right[1], cameras[1])
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
def _add_camera(point, pixel, weight, placed, normal, gradient):  # type: ignore[no-untyped-def]
    """Add one camera to JᵀWJ (3,3) and JᵀWr (3,); return its squared residual or NaN."""
    camera, rotation, translation = placed
    p = np.empty(3)
    for i in range(3):
        p[i] = rotation[i, 0] * point[0] + rotation[i, 1] * point[1] + rotation[i, 2] * point[2] + translation[i]
    if not p[2] > 0.0:
        normal.fill(math.nan)
        return math.nan
    x, y = p[0] / p[2], p[1] / p[2]
    xd, yd, dxx, dxy, dyy = distort(x, y, camera)
    ru = pixel[0] - (camera[0] * xd + camera[12] * yd + camera[2])
    rv = pixel[1] - (camera[1] * yd + camera[3])
    fx, fy, shear = camera[0] / p[2], camera[1] / p[2], camera[12] / p[2]
    ux, uy, vx, vy = fx * dxx + shear * dxy, fx * dxy + shear * dyy, fy * dxy, fy * dyy
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
