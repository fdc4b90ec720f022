"""Where the points of a target are seen in a picture, and how that answers camera, poses and target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray
from photogram.camera import RIG_PARAMETERS, Camera
from photogram.rigid import RigidTransform, skew

_RIM_POINTS = 12  # points on the rim of a dot at which the lens's distortion is looked at


@dataclass(frozen=True, eq=False)
class Seen:
    """Modelled pixels (N, 2) of one picture with derivatives by the camera's parameters (N, 2, 9), by its pose after
    the left camera (N, 2, 6), by the target's pose (N, 2, 6) and by the point in the target's frame (N, 2, 3).

    Poses: translation, then left-multiplied rotation.
    """

    pixel: FloatArray
    by_camera: FloatArray
    by_relative: FloatArray
    by_pose: FloatArray
    by_point: FloatArray

    def by_rig(self, side: int) -> FloatArray:
        """Return the derivatives (N, 2, 24) by the parameters of a pair, this being its left (0) or right (1) side."""
        slope = np.zeros((len(self.pixel), 2, len(RIG_PARAMETERS)))
        slope[..., 9 * side : 9 * side + 9] = self.by_camera
        if side:
            slope[..., 18:21], slope[..., 21:24] = self.by_relative[..., 3:], self.by_relative[..., :3]
        return slope


def see(
    camera: Camera,
    camera_from_left: RigidTransform,
    left_from_target: RigidTransform,
    point_m: FloatArray,
    radius_m: float,
) -> Seen:
    """Return where a camera sees points (N, 3) of the target; dots of `radius_m` > 0 by the centre of their ellipse.

    The derivatives leave out how the lens's bending of a dot's rim changes, some 10⁻⁵ of them.
    """
    normal_left = left_from_target.rotation[:, 2]
    normal = camera_from_left.rotation @ normal_left
    turned = point_m @ left_from_target.rotation.T
    in_camera_turned = (turned + left_from_target.translation_m) @ camera_from_left.rotation.T
    in_camera = in_camera_turned + camera_from_left.translation_m
    flat, flat_by_place, flat_by_normal = ellipse_centres(in_camera, normal, radius_m)
    placed, by_flat = distorted(camera, flat)
    by_flat = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])[:, None] * by_flat
    by_place, by_normal = by_flat @ flat_by_place, by_flat @ flat_by_normal
    by_left, by_left_normal = by_place @ camera_from_left.rotation, by_normal @ camera_from_left.rotation
    if radius_m > 0:
        placed = placed + _bent(camera, in_camera, camera_from_left.rotation @ left_from_target.rotation, radius_m)
    return Seen(
        camera_pixels(camera, placed),
        _by_camera(camera, flat, placed),
        np.concatenate([by_place, -by_place @ skew(in_camera_turned) - by_normal @ skew(normal)], axis=-1),
        np.concatenate([by_left, -by_left @ skew(turned) - by_left_normal @ skew(normal_left)], axis=-1),
        by_left @ left_from_target.rotation,
    )


def camera_pixels(camera: Camera, distorted: FloatArray) -> FloatArray:
    """Return the pixels (N, 2) of distorted normalised coordinates (N, 2)."""
    k = camera.matrix
    return np.asarray(distorted * [k[0, 0], k[1, 1]] + [k[0, 2], k[1, 2]])


def ellipse_centres(
    centre_m: FloatArray, normal: FloatArray, radius_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the centres (N, 2), x/z and y/z, of the ellipses that an ideal camera sees of dots around c (N, 3), and
    their derivatives (N, 2, 3) by c and by the normal n (3,) of the dots' plane.

    The cone through a dot of radius ρ has the dual conic ρ²·(I − n·nᵀ) − c·cᵀ, and the ellipse's centre is the pole
    of the line at infinity, its last column (Heikkilä 2000, IEEE PAMI 22, 1066, eq. 16, written for n):
    e = (c_xy·c_z + ρ²·n_xy·n_z)/(c_z² − ρ²·|n_xy|²).
    """
    across, depth = centre_m[:, :2], centre_m[:, 2:]
    square = radius_m**2
    over = depth**2 - square * float(normal[:2] @ normal[:2])
    centre = (across * depth + square * normal[:2] * normal[2]) / over
    by_place = np.zeros((len(centre_m), 2, 3))
    by_place[:, 0, 0] = by_place[:, 1, 1] = (depth / over)[:, 0]
    by_place[:, :, 2] = (across - 2 * centre * depth) / over
    by_normal = np.empty((len(centre_m), 2, 3))
    by_normal[:, :, :2] = 2 * square * centre[:, :, None] * normal[:2] / over[:, :, None]
    by_normal[:, :, :2] += square * normal[2] * np.eye(2) / over[:, :, None]
    by_normal[:, :, 2] = square * normal[:2] / over
    return centre, by_place, by_normal


def _bent(camera: Camera, centre_m: FloatArray, rotation: FloatArray, radius_m: float) -> FloatArray:
    """Return how far (N, 2), normalised, a lens moves the ellipse beyond its centre, by bending the dot's rim.

    It bends the rim e by q beyond a linear map; the ellipse that fits the bent rim best along its normals n lies
    (Σ n·nᵀ)⁻¹·Σ n·nᵀ·q further.
    """
    centre = ellipse_centres(centre_m, rotation[:, 2], radius_m)[0]
    angle = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    rim_m = centre_m[:, None] + radius_m * (
        np.cos(angle)[:, None] * rotation[:, 0] + np.sin(angle)[:, None] * rotation[:, 1]
    )
    rim = rim_m[..., :2] / rim_m[..., 2:]
    placed, by_place = distorted(camera, centre)
    offset = np.einsum("nij,nkj->nki", by_place, rim - centre[:, None])
    bent = distorted(camera, rim)[0] - placed[:, None] - offset
    tangent = np.roll(offset, -1, axis=1) - np.roll(offset, 1, axis=1)
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    along = np.einsum("nki,nki->nk", normal, bent)
    matrix = np.einsum("nki,nkj->nij", normal, normal)
    return np.asarray(np.linalg.solve(matrix, np.einsum("nki,nk->ni", normal, along)[..., None])[..., 0])


def distorted(camera: Camera, undistorted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distorted normalised coordinates (..., 2) and their derivative (..., 2, 2) by the undistorted ones."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = undistorted[..., 0], undistorted[..., 1]
    r2 = x * x + y * y
    gain = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    placed = [x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by_x = gain + slope * x * x + 2 * p1 * y + 6 * p2 * x
    by_y = gain + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return np.stack(placed, axis=-1), np.stack(
        [np.stack([by_x, mixed], axis=-1), np.stack([mixed, by_y], axis=-1)], axis=-2
    )


def _by_camera(camera: Camera, flat: FloatArray, placed: FloatArray) -> FloatArray:
    """Return ∂pixel/∂parameters (N, 2, 9) at undistorted and distorted coordinates (N, 2)."""
    focal = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
    x, y = flat.T
    r2 = x * x + y * y
    by_distortion = np.stack(
        [
            flat * r2[:, None],
            flat * r2[:, None] ** 2,
            np.stack([2 * x * y, r2 + 2 * y * y], axis=-1),
            np.stack([r2 + 2 * x * x, 2 * x * y], axis=-1),
            flat * r2[:, None] ** 3,
        ],
        axis=-1,
    )
    by_camera = np.zeros((len(flat), 2, 9))
    by_camera[:, 0, 0], by_camera[:, 1, 1] = placed.T
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    by_camera[:, :, 4:] = focal[:, None] * by_distortion
    return by_camera
