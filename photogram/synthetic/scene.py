"""What a camera looks at: a flat textured face of a rigid body, and the view of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray, check_shape
from photogram.camera import Camera
from photogram.rigid import RigidTransform
from photogram.synthetic.texture import Texture


@dataclass(frozen=True, eq=False)
class Face:
    """A flat face of a body at rest: points origin + u·axis_u + v·axis_v in the world (the sensor) frame, in m.

    `half_size_m` (2,): half width and half height of the rectangle; of a `round` face the first is its radius.
    `edge_blur_m`: σ of the lens blur at the rim. `bright`, `dark`: grey levels (fractions of full scale) of
    reflectance 1 and 0; `background`: the grey level around the face.
    """

    origin_m: FloatArray
    axis_u: FloatArray
    axis_v: FloatArray
    half_size_m: FloatArray
    round: bool
    texture: Texture
    edge_blur_m: float
    bright: float = 0.80
    dark: float = 0.16
    background: float = 0.06

    def __post_init__(self) -> None:
        """Refuse wrong shapes and axes that are not orthonormal."""
        for name in ("origin_m", "axis_u", "axis_v"):
            check_shape(name, getattr(self, name), (3,))
        check_shape("half_size_m", self.half_size_m, (2,))
        axes = np.stack([self.axis_u, self.axis_v])
        if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-9):
            raise ValueError("axis_u, axis_v: expected two orthogonal unit vectors")

    @property
    def plane(self) -> FloatArray:
        """The matrix (3, 3) [axis_u axis_v origin] that takes (u, v, 1) to a point in the world frame."""
        return np.column_stack([self.axis_u, self.axis_v, self.origin_m])


@dataclass(frozen=True, eq=False)
class View:
    """A camera in the world: its rays, made once, and the light that falls off towards its corners.

    `ray` (H, W, 2): normalised coordinates x = X/Z, y = Y/Z of the pixel centres; `ray_x`, `ray_y` (H, W, 2): their
    change from one pixel to the next, along columns and rows. `light` (H, W): brightness, 1 at the image centre.
    """

    camera: Camera
    camera_from_world: RigidTransform
    ray: FloatArray
    ray_x: FloatArray
    ray_y: FloatArray
    light: FloatArray

    def homography(self, face: Face, pose: FloatArray) -> FloatArray:
        """Return the matrix (3, 3) that takes a ray (x, y, 1) to w·(u, v, 1) on the face of a body in `pose` (6,).

        A face point is R·(plane·(u, v, 1)) + t in the world, so the ray is camera_from_world · that · (u, v, 1).
        """
        camera_from_body = self.camera_from_world @ RigidTransform.from_pose(pose)
        face_to_ray = camera_from_body.rotation @ face.plane
        face_to_ray[:, 2] += camera_from_body.translation_m
        return np.asarray(np.linalg.inv(face_to_ray))


def view_of(camera: Camera, camera_from_world: RigidTransform, falloff: float = 0.12) -> View:
    """Return the view through `camera`; `falloff` is the loss of light at the image corners."""
    width, height = (int(n) for n in camera.size_px)
    x, y = np.meshgrid(np.arange(-1.0, width + 1), np.arange(-1.0, height + 1))
    ray = camera.undistort(np.stack([x, y], axis=-1))
    radius = np.hypot(2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1)[1:-1, 1:-1] / np.sqrt(2)
    return View(
        camera,
        camera_from_world,
        np.ascontiguousarray(ray[1:-1, 1:-1]),
        np.ascontiguousarray(ray[1:-1, 2:] - ray[1:-1, :-2]) / 2,
        np.ascontiguousarray(ray[2:, 1:-1] - ray[:-2, 1:-1]) / 2,
        1 - falloff * radius**2,
    )
