"""The pinhole camera with lens distortion, and the stereo pair."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from photogram import _pinhole
from photogram._checks import FloatArray, IntArray, check_shape
from photogram.rigid import RigidTransform, rotation_from_vector, skew

CAMERA_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
RIG_PARAMETERS = (
    *(f"left.{name}" for name in CAMERA_PARAMETERS),
    *(f"right.{name}" for name in CAMERA_PARAMETERS),
    *(f"{part}.{axis}" for part in ("rotation", "translation") for axis in "xyz"),
)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: matrix (3, 3) in px, distortion (5,) k1 k2 p1 p2 k3, size_px (2,) width and height.

    OpenCV's model and pixels: u = fx·x_d + cx with the distorted x_d of x = X/Z; an integer pixel is a pixel centre.
    """

    matrix: FloatArray
    distortion: FloatArray
    size_px: IntArray

    def __post_init__(self) -> None:
        """Refuse wrong shapes and a matrix with entries beside fx, fy, cx, cy."""
        check_shape("matrix", self.matrix, (3, 3))
        check_shape("distortion", self.distortion, (5,))
        check_shape("size_px", self.size_px, (2,))
        if not (np.isfinite(self.matrix).all() and np.isfinite(self.distortion).all()):
            raise ValueError("matrix, distortion: expected finite numbers, found NaN or infinity")
        k = self.matrix
        if k[0, 1] != 0 or k[1, 0] != 0 or not np.array_equal(k[2], [0, 0, 1]) or k[0, 0] <= 0 or k[1, 1] <= 0:
            raise ValueError(f"matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], fx, fy > 0, found {k.tolist()}")

    @staticmethod
    def from_parameters(parameters: FloatArray, size_px: IntArray) -> Camera:
        """Return the camera of parameters (9,): fx fy cx cy k1 k2 p1 p2 k3."""
        check_shape("parameters", parameters, (9,))
        fx, fy, cx, cy = parameters[:4]
        return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(parameters[4:], float), size_px)

    @property
    def parameters(self) -> FloatArray:
        """The vector (9,) fx fy cx cy k1 k2 p1 p2 k3."""
        k = self.matrix
        return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *self.distortion], dtype=np.float64)

    def project(self, points_m: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of points (..., 3) in the camera frame, NaN for points not in front of it."""
        points = np.asarray(points_m, dtype=np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        return np.asarray(_pinhole.project_all(flat, self.parameters)).reshape(*points.shape[:-1], 2)

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Return the normalised coordinates (..., 2), x = X/Z and y = Y/Z, of pixels (..., 2).

        The inverse of `project`, converged to the last digits by damped Newton steps; NaN where the distortion
        polynomial reaches no such pixel.
        """
        flat = np.ascontiguousarray(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
        return np.asarray(_pinhole.undistort_all(flat, self.parameters)).reshape(np.shape(pixels))


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two cameras and x_right = R·x_left + t, with the covariance (24, 24) of `RIG_PARAMETERS` or None.

    The three rotation parameters are a small rotation vector δ (rad) multiplied from the left: exp(δ)·R.
    """

    left: Camera
    right: Camera
    right_from_left: RigidTransform
    covariance: FloatArray | None = None

    parameters: ClassVar[tuple[str, ...]] = RIG_PARAMETERS

    def __post_init__(self) -> None:
        """Refuse a covariance of another shape or that is none: NaN, not symmetric, a negative variance."""
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (len(RIG_PARAMETERS), len(RIG_PARAMETERS)))
            _check_covariance(self.covariance)

    def perturbed(self, delta: FloatArray) -> StereoRig:
        """Return the rig with its parameters changed by delta (24,), in the order of `RIG_PARAMETERS`."""
        check_shape("delta", delta, (len(RIG_PARAMETERS),))
        return replace(
            self,
            left=Camera.from_parameters(self.left.parameters + delta[:9], self.left.size_px),
            right=Camera.from_parameters(self.right.parameters + delta[9:18], self.right.size_px),
            right_from_left=RigidTransform(
                rotation_from_vector(delta[18:21]) @ self.right_from_left.rotation,
                self.right_from_left.translation_m + delta[21:],
            ),
        )

    def project(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the left and right pixels (..., 2) of points (..., 3) in the left camera's frame."""
        return self.left.project(points_m), self.right.project(self.right_from_left.apply(points_m))

    def fundamental(self) -> FloatArray:
        """Return F (3, 3) with (u', v', 1)·F·(u, v, 1)ᵀ = 0 for left (u, v) and right (u', v') pixels.

        F = K_right⁻ᵀ·[t]×·R·K_left⁻¹ (Hartley and Zisserman 2004, eq. 9.12), scaled to norm 1. Distortion is left
        out: it holds for ideal pixels, and for real ones within the lenses' distortion there.
        """
        essential = skew(self.right_from_left.translation_m) @ self.right_from_left.rotation
        matrix = np.linalg.inv(self.right.matrix).T @ essential @ np.linalg.inv(self.left.matrix)
        return np.asarray(matrix / np.linalg.norm(matrix))


def principal_components(covariance: FloatArray) -> FloatArray:
    """Return steps (P, N), one standard deviation along each principal component of a covariance (N, N).

    Components of the correlation matrix, so that parameters of different units count alike: Σ sᵀ·s is the covariance.
    """
    sigma = np.sqrt(np.diagonal(covariance))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = eigenvalues > 1e-9 * eigenvalues[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(eigenvalues[kept])).T * sigma)


def _check_covariance(covariance: FloatArray) -> None:
    """Raise `ValueError` unless the matrix is symmetric and its correlations are positive semidefinite."""
    sigma = np.sqrt(np.abs(np.diagonal(covariance)))
    scale = np.outer(sigma, sigma)
    if not (np.abs(covariance - covariance.T) <= 1e-9 * scale).all():
        raise ValueError("covariance: expected a symmetric matrix of finite numbers, zero where a variance is zero")
    correlation = covariance / np.where(scale > 0, scale, 1.0)
    lowest = float(np.linalg.eigvalsh(correlation)[0])
    if lowest < -1e-9:
        raise ValueError(
            f"covariance: expected no negative variance in any direction, found {lowest:.1e} (correlation)"
        )
