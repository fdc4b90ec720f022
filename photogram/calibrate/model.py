"""Where the points of a target are seen in a picture, and how that answers camera, poses and target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray
from photogram.camera import Camera
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


def see(
    camera: Camera,
    camera_from_left: RigidTransform,
    left_from_target: RigidTransform,
    point_m: FloatArray,
    radius_m: float,
) -> Seen:
    """Return where a camera sees points (N, 3) of the target; dots of `radius_m` > 0 by the centre of their ellipse.

    The derivatives leave out that the ellipse's centre is off the dot's: it changes by less than 10⁻³ of it.
    """
    turned = point_m @ left_from_target.rotation.T
    in_left = turned + left_from_target.translation_m
    in_camera_turned = in_left @ camera_from_left.rotation.T
    in_camera = in_camera_turned + camera_from_left.translation_m
    by_place, by_camera, pixel = _project(camera, in_camera)
    by_left = by_place @ camera_from_left.rotation
    if radius_m > 0:
        target = (camera_from_left @ left_from_target).rotation
        pixel = camera_pixels(camera, ellipse_centres(camera, in_camera, target, radius_m))
    return Seen(
        pixel,
        by_camera,
        np.concatenate([by_place, -by_place @ skew(in_camera_turned)], axis=-1),
        np.concatenate([by_left, -by_left @ skew(turned)], axis=-1),
        by_left @ left_from_target.rotation,
    )


def camera_pixels(camera: Camera, distorted: FloatArray) -> FloatArray:
    """Return the pixels (N, 2) of distorted normalised coordinates (N, 2)."""
    k = camera.matrix
    return np.asarray(distorted * [k[0, 0], k[1, 1]] + [k[0, 2], k[1, 2]])


def ellipse_centres(camera: Camera, centre_m: FloatArray, rotation: FloatArray, radius_m: float) -> FloatArray:
    """Return the centres (N, 2), distorted normalised, of the ellipses seen of dots around (N, 3) in a plane.

    Without distortion the centre is the pole of the line at infinity: with the plane's axes a, b (columns of
    `rotation`) and the dual conic ρ²·(a·aᵀ + b·bᵀ) − c·cᵀ of a dot around c (Heikkilä 2000, IEEE PAMI 22, 1066, eq.
    16), it is the last column of that. A lens bends the rim e beyond a linear map by q; the ellipse that fits
    the bent rim best along its normals n lies (Σ n·nᵀ)⁻¹·Σ n·nᵀ·q further.
    """
    a, b, c, square = rotation[:, 0], rotation[:, 1], centre_m, radius_m**2
    dual = square * (np.outer(a, a) + np.outer(b, b)) - c[:, :, None] * c[:, None, :]
    centre = dual[:, :2, 2] / dual[:, 2:, 2]
    angle = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    rim_m = c[:, None] + radius_m * (np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * b)
    rim = rim_m[..., :2] / rim_m[..., 2:]
    placed, by_place = distorted(camera, centre)
    offset = np.einsum("nij,nkj->nki", by_place, rim - centre[:, None])
    bent = distorted(camera, rim)[0] - placed[:, None] - offset
    tangent = np.roll(offset, -1, axis=1) - np.roll(offset, 1, axis=1)
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    along = np.einsum("nki,nki->nk", normal, bent)
    matrix = np.einsum("nki,nkj->nij", normal, normal)
    shift = np.linalg.solve(matrix, np.einsum("nki,nk->ni", normal, along)[..., None])[..., 0]
    return np.asarray(placed + shift)


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


def _project(camera: Camera, place_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ∂pixel/∂place (N, 2, 3), ∂pixel/∂parameters (N, 2, 9) and the pixels (N, 2) of points in the camera."""
    focal = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
    depth = place_m[:, 2]
    flat = place_m[:, :2] / depth[:, None]
    placed, by_flat = distorted(camera, flat)
    to_flat = np.zeros((len(place_m), 2, 3))
    to_flat[:, 0, 0] = to_flat[:, 1, 1] = 1 / depth
    to_flat[:, :, 2] = -flat / depth[:, None]
    by_place = focal[:, None] * (by_flat @ to_flat)
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
    by_camera = np.zeros((len(place_m), 2, 9))
    by_camera[:, 0, 0], by_camera[:, 1, 1] = placed.T
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    by_camera[:, :, 4:] = focal[:, None] * by_distortion
    return by_place, by_camera, camera_pixels(camera, placed)
