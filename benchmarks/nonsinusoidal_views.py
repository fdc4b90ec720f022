"""Exact views of a speckled face by a stereo pair, without the program: the images of `nonsinusoidal_truth.py`.

The texture is a quintic spline on the moving plane. Every pixel is the value where its distorted ray meets the plane,
so displacements of a nanometre are rendered as exactly as those of a millimetre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]

IMAGE_PX, FOCAL_PX, DISTANCE_M = (640, 480), 3550.0, 0.5
DISC_M, TOP_M, TEXTURE_M = 0.035, 0.070, 0.12e-3
"""Radius and height of the face, spacing of the spline."""
ELECTRONS_PER_GREY, READ_NOISE_ELECTRONS = 40.0, 8.0


@dataclass(frozen=True)
class Camera:
    """Pose in the sensor frame (columns: axes) and OpenCV distortion k1 k2 p1 p2 k3."""

    axes: FloatArray
    place_m: FloatArray
    distortion: tuple[float, ...]

    @property
    def matrix(self) -> FloatArray:
        """Return the camera matrix."""
        return np.array([[FOCAL_PX, 0.0, 318.7], [0.0, FOCAL_PX * 1.0004, 241.3], [0.0, 0.0, 1.0]])

    def distorted(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distorted normalised coordinates."""
        k1, k2, p1, p2, k3 = self.distortion
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        return x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x), y * radial + p1 * (
            square + 2 * y * y
        ) + 2 * p2 * x * y

    def pixels(self, points_m: FloatArray) -> FloatArray:
        """Project points of the sensor frame, (N, 3) to (N, 2)."""
        x, y, z = ((points_m - self.place_m) @ self.axes).T
        u, v = self.distorted(x / z, y / z)
        return np.stack([u, v, np.ones(u.size)], 1) @ self.matrix[:2].T

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Return directions in the sensor frame of pixels (N, 2), as (N, 3)."""
        target = (pixels - self.matrix[:2, 2]) / np.diag(self.matrix)[:2]
        x, y = target.T
        for _ in range(20):
            u, v = self.distorted(x, y)
            x, y = x + target[:, 0] - u, y + target[:, 1] - v
        return np.asarray(np.stack([x, y, np.ones(x.size)], 1) @ self.axes.T)


def make_cameras() -> tuple[Camera, Camera]:
    """Return a pair 15 degrees to each side, 30 degrees from the normal of the face, that converges on its middle."""
    middle, cameras = np.array([0.0, 0.0, TOP_M]), []
    for side, distortion in ((-1.0, (-0.09, 0.12, 2e-4, -1.5e-4, 0.0)), (1.0, (-0.085, 0.1, -1e-4, 2e-4, 0.0))):
        turn = Rotation.from_euler("xy", [30.0, 15.0 * side], degrees=True).as_matrix()
        axes = turn @ np.diag([1.0, -1.0, -1.0])
        cameras.append(Camera(axes, middle - DISTANCE_M * axes[:, 2], distortion))
    return cameras[0], cameras[1]


@dataclass(frozen=True)
class View:
    """Renders the speckled face of the moving load in one camera; an integer pixel coordinate is its middle."""

    camera: Camera
    coefficients: FloatArray
    near: NDArray[np.bool_]
    directions: FloatArray

    @classmethod
    def of(cls, camera: Camera, coefficients: FloatArray) -> View:
        """Prepare the rays of the pixels that can see the face."""
        grid = np.stack(np.meshgrid(*map(np.arange, IMAGE_PX)), -1).reshape(-1, 2).astype(float)
        rays = camera.rays(grid)
        place = camera.place_m + rays * ((TOP_M - camera.place_m[2]) / rays[:, 2])[:, None]
        near = np.hypot(place[:, 0], place[:, 1]) < DISC_M + 1.5e-3
        return cls(camera, coefficients, near, rays[near])

    def image(self, pose: FloatArray) -> FloatArray:
        """Return noise-free grey values (height, width) at a pose: translation in m of the origin, rotation vector."""
        turn = Rotation.from_rotvec(pose[3:]).as_matrix()
        origin, rays = (self.camera.place_m - pose[:3]) @ turn, self.directions @ turn
        x, y = (origin[:2] + rays[:, :2] * ((TOP_M - origin[2]) / rays[:, 2])[:, None]).T
        places = np.stack([x, y]) / TEXTURE_M + (len(self.coefficients) - 1) / 2.0
        texture = map_coordinates(self.coefficients, places, order=5, prefilter=False, mode="nearest")
        inside = 0.5 - 0.5 * np.tanh((np.hypot(x, y) - DISC_M) / 0.2e-3)
        grey = np.full(self.near.size, 30.0)
        grey[self.near] += inside * (255.0 * texture - 30.0)
        return grey.reshape(IMAGE_PX[1], IMAGE_PX[0])


def make_texture(rng: np.random.Generator) -> FloatArray:
    """Return coefficients of a quintic spline with speckles of about 0.7 mm, as shares of full scale."""
    field = gaussian_filter(rng.normal(size=(640, 640)), 1.7)
    return np.asarray(gaussian_filter(0.5 + 0.32 * np.tanh(1.3 * field / np.std(field)), 1.0))


def photograph(grey: FloatArray, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return an image of 8 bit with photon and read noise."""
    scatter = np.sqrt(grey / ELECTRONS_PER_GREY + (READ_NOISE_ELECTRONS / ELECTRONS_PER_GREY) ** 2)
    noise = rng.standard_normal(grey.shape, dtype=np.float32)
    return np.clip(np.rint(grey + scatter * noise), 0, 255).astype(np.uint8)
