"""Where a camera sees the body's surface, and how small patches of it move in the image when the body moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray, check_shape
from photogram.camera import Camera
from photogram.rigid import RigidTransform

NEIGHBOURS = 24
OUTLIER = 4.0  # robust standard deviations from the local plane
RATE_STEP = 1e-6  # m and rad, of the derivative by the six components


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera and where the body's frame is at rest: x_camera = camera_from_body · x_body."""

    camera: Camera
    camera_from_body: RigidTransform

    def project(self, points_m: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of points (..., 3) in the body's frame."""
        return self.camera.project(self.camera_from_body.apply(points_m))


@dataclass(frozen=True, eq=False)
class Patches:
    """Small plane patches of a body as one camera sees them at rest.

    centre_px (C, 2); arm_px: half the length over which derivatives are taken; points_m (C, 5, 3): the surface, in the
    body's frame, at the centre and `arm_px` to its right, left, below and above; NaN where the surface is unknown.
    """

    centre_px: FloatArray
    arm_px: float
    points_m: FloatArray

    def __post_init__(self) -> None:
        check_shape("centre_px", self.centre_px, (None, 2))
        check_shape("points_m", self.points_m, (len(self.centre_px), 5, 3))


def body_patches(
    camera: PlacedCamera, known_m: FloatArray, centre_px: FloatArray, arm_px: float, reach_px: float
) -> Patches:
    """Return the surface at centre_px (C, 2) from known points (N, 3) of the body.

    A plane has an inverse depth that is linear in the normalised coordinates, 1/Z = w + w_x·x + w_y·y. It is fitted
    to the 24 points nearest in the image, those more than four robust standard deviations off left out. Where no
    known point lies within `reach_px`, the surface is unknown.
    """
    from scipy.spatial import cKDTree

    check_shape("known_m", known_m, (None, 3))
    check_shape("centre_px", centre_px, (None, 2))
    known = camera.camera_from_body.apply(known_m[np.isfinite(known_m).all(axis=1)])
    if len(known) < 3:
        raise ValueError(f"known_m: expected at least 3 finite points, found {len(known)}")
    tree = cKDTree(camera.camera.project(known))
    distance, nearest = tree.query(centre_px, k=min(NEIGHBOURS, len(known)))
    centre = camera.camera.undistort(centre_px)
    plane = _inverse_depth(known[:, :2] / known[:, 2:], 1.0 / known[:, 2], nearest, centre)
    arms = arm_px * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    rays = camera.camera.undistort(centre_px[:, None] + arms)
    from_centre = rays - centre[:, None]
    depth = 1.0 / (plane[:, None, 0] + np.einsum("cki,ci->ck", from_centre, plane[:, 1:]))
    depth[(distance[:, 0] > reach_px)[:, None] | (depth <= 0.0)] = np.nan
    seen = np.concatenate([rays * depth[..., None], depth[..., None]], axis=2)
    return Patches(centre_px, arm_px, camera.camera_from_body.inverse().apply(seen))


def patch_warps(camera: PlacedCamera, patches: Patches, moved: RigidTransform) -> FloatArray:
    """Return the affine warps (C, 6) [u u_x u_y v v_x v_y] of the patches when the body moves by `moved`, in px."""
    rest = camera.project(patches.points_m)
    shift = camera.project(moved.apply(patches.points_m)) - rest
    warp = np.empty((len(shift), 6))
    warp[:, [0, 3]] = shift[:, 0]
    warp[:, [1, 4]] = (shift[:, 1] - shift[:, 2]) / (2 * patches.arm_px)
    warp[:, [2, 5]] = (shift[:, 3] - shift[:, 4]) / (2 * patches.arm_px)
    return warp


def patch_rates(camera: PlacedCamera, patches: Patches) -> FloatArray:
    """Return the derivatives (C, 6, 6) of the patches' affine warps by x y z (m) and rx ry rz (rad) at rest."""
    rates = np.empty((len(patches.centre_px), 6, 6))
    for component in range(6):
        step = np.zeros(6)
        step[component] = RATE_STEP
        ahead = patch_warps(camera, patches, RigidTransform.from_pose(step))
        behind = patch_warps(camera, patches, RigidTransform.from_pose(-step))
        rates[:, :, component] = (ahead - behind) / (2 * RATE_STEP)
    return rates


def _inverse_depth(ray: FloatArray, inverse: FloatArray, nearest: FloatArray, centre: FloatArray) -> FloatArray:
    """Return w, w_x, w_y (C, 3) about each centre (C, 2) through its nearest points (C, k), outliers left out."""
    offset = ray[nearest] - centre[:, None]
    scale = np.sqrt(np.mean(offset**2)) + 1e-300
    design = np.concatenate([np.ones((*nearest.shape, 1)), offset / scale], axis=2)
    value = inverse[nearest]
    weight = np.ones(nearest.shape)
    ridge = 1e-9 * np.diag([0.0, 1.0, 1.0])
    for _ in range(3):
        normal = np.einsum("ck,cki,ckj->cij", weight, design, design) + ridge
        slope = np.einsum("ck,cki,ck->ci", weight, design, value)
        plane = np.linalg.solve(normal, slope[..., None])[..., 0]
        error = np.abs(value - np.einsum("cki,ci->ck", design, plane))
        spread = 1.4826 * np.median(error, axis=1, keepdims=True)
        weight = (error <= OUTLIER * spread + 1e-15).astype(np.float64)
    plane[:, 1:] /= scale
    return np.asarray(plane)
