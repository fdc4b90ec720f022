"""Where a camera sees a body's surface, and how small patches of it move in the image when the body moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from photogram.arrays import Arrays, FloatArray, check_shape, derivatives
from photogram.camera import Camera, project_one
from photogram.geometry import RigidTransform
from photogram.kernels import njit
from photogram.motion import FEWEST, MEDIAN_CHI2_OF_TWO, REJECTED, SINGULAR, START_ROUNDS

NEIGHBOURS = 24
OUTLIER = 4.0  # robust standard deviations from the local plane
RATE_STEP = 1e-6  # m and rad, of the derivative by the six components
NEAR_PX = 0.02  # by which the last step of a motion that is only a start may move a point
AT_REST = RigidTransform.identity()


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera and where the body's frame is at rest: x_camera = camera_from_body · x_body."""

    camera: Camera
    camera_from_body: RigidTransform

    def project(self, points_m: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of points (..., 3) in the body's frame."""
        return self.camera.project(self.camera_from_body.apply(points_m))


@dataclass(frozen=True, eq=False, repr=False)
class Patches(Arrays, shapes="centre_px C 2; points_m C 5 3; rest_px C 5 2"):
    """Small plane patches of a body as one camera sees them at rest.

    centre_px (C, 2); arm_px: half the length over which derivatives are taken; points_m (C, 5, 3): the surface, in the
    body's frame, at the centre and `arm_px` to its right, left, below and above, and rest_px (C, 5, 2) where it is;
    NaN where the surface is unknown.
    """

    centre_px: FloatArray
    arm_px: float
    points_m: FloatArray
    rest_px: FloatArray


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
    points = camera.camera_from_body.inverse().apply(seen)
    return Patches(centre_px, arm_px, points, camera.project(points))


def patch_warps(camera: PlacedCamera, patches: Patches, moved: RigidTransform) -> FloatArray:
    """Return the affine warps (C, 6) [u u_x u_y v v_x v_y] of the patches when the body moves by `moved`, in px."""
    return warps_of_points(camera, patches, patches.points_m, moved)


def warps_of_points(
    camera: PlacedCamera, patches: Patches, points_m: FloatArray, by: RigidTransform = AT_REST
) -> FloatArray:
    """Return the affine warps (C, 6) of the patches when their points, at places (C, 5, 3), move `by` a motion."""
    place, rest, warp = camera.camera_from_body, (patches.rest_px, patches.arm_px), np.empty((len(points_m), 6))
    into = place.rotation @ by.rotation, place.apply(by.translation_m)
    _warps(np.ascontiguousarray(points_m), into, camera.camera.parameters, rest, warp)
    return warp


@njit()
def _warps(points, place, camera, rest, warps):  # type: ignore[no-untyped-def]
    """Shifts of the patches' centres, and differences of their arms, into `warps`; NaN behind the camera."""
    (rotation, translation), (rest_px, arm_px), shift = place, rest, np.empty((5, 2))
    for c in range(points.shape[0]):
        for k in range(5):
            x, y, z = translation[0], translation[1], translation[2]
            for i in range(3):
                x += rotation[0, i] * points[c, k, i]
                y += rotation[1, i] * points[c, k, i]
                z += rotation[2, i] * points[c, k, i]
            u, v = project_one(x, y, z, camera)
            shift[k, 0], shift[k, 1] = u - rest_px[c, k, 0], v - rest_px[c, k, 1]
        for i in range(2):
            warps[c, 3 * i] = shift[0, i]
            warps[c, 3 * i + 1] = (shift[1, i] - shift[2, i]) / (2 * arm_px)
            warps[c, 3 * i + 2] = (shift[3, i] - shift[4, i]) / (2 * arm_px)


def patch_rates(camera: PlacedCamera, patches: Patches) -> FloatArray:
    """Return the derivatives (C, 6, 6) of the patches' affine warps by x y z (m) and rx ry rz (rad) at rest."""
    return derivatives(lambda pose: patch_warps(camera, patches, RigidTransform.from_pose(pose)), np.full(6, RATE_STEP))


@dataclass(frozen=True, eq=False, repr=False)
class SeenPoints(Arrays, shapes="points_m N 3; rates N 2 6"):
    """Points of a body at rest (N, 3), and how their pixels in one camera answer to its six components, (N, 2, 6)."""

    camera: PlacedCamera
    points_m: FloatArray
    rates: FloatArray

    @cached_property
    def rest_px(self) -> FloatArray:
        """Where the camera shows them at rest, (N, 2)."""
        return self.camera.project(self.points_m)


def project_body_points(camera: PlacedCamera, points_m: FloatArray) -> SeenPoints:
    """Return points (N, 3) of a body at rest, in its frame, as a camera sees them; NaN for one that is not known."""
    rates = derivatives(
        lambda pose: camera.project(RigidTransform.from_pose(pose).apply(points_m)), np.full(6, RATE_STEP)
    )
    return SeenPoints(camera, points_m, rates)


def motion_from_positions(seen: Sequence[SeenPoints], positions_px: Sequence[FloatArray]) -> RigidTransform | None:
    """Return the motion from rest that brings points to the places (N, 2) where each camera shows them in one frame.

    Gauss-Newton with the rates at rest, as in `direct.fit.fit_direct`, of distances in px with Cauchy weights
    1/(1 + d²/median d²), which a third of wrong places does not carry away; a last step weighs those within five robust
    standard deviations alike. A start, without a covariance. None where fewer than six places are known, or they do not
    fix all six components.
    """
    rates, places = np.concatenate([one.rates for one in seen]), np.concatenate(positions_px)
    known = np.isfinite(places).all(axis=1) & np.isfinite(rates[:, 0, 0])
    if np.count_nonzero(known) < FEWEST:
        return None
    rates, places = rates[known], places[known]
    weight, moved = np.ones(len(rates)), RigidTransform.identity()
    for _ in range(START_ROUNDS):
        found = np.concatenate([one.camera.project(moved.apply(one.points_m)) for one in seen])[known]
        step = _weighted_step(rates, places - found, weight)
        if step is None:
            return None
        moved = moved @ RigidTransform.from_pose(step)
        answer = rates @ step
        left = places - found - answer
        squares = (left**2).sum(axis=1)
        median = max(float(np.median(squares)), 1e-300)
        weight = 1.0 / (1.0 + squares / median)
        if np.abs(answer).max() < NEAR_PX:
            break
    step = _weighted_step(rates, left, (squares <= REJECTED * median / MEDIAN_CHI2_OF_TWO).astype(np.float64))
    return None if step is None else moved @ RigidTransform.from_pose(step)


def _weighted_step(rates: FloatArray, error_px: FloatArray, weight: FloatArray) -> FloatArray | None:
    """Return the pose (6,) that explains errors (N, 2) by rates (N, 2, 6); None where these do not fix it."""
    design = rates.reshape(-1, 6)
    weighted = np.repeat(weight, 2)[:, None] * design
    normal = weighted.T @ design
    scale = np.sqrt(np.diagonal(normal))
    if not (scale > 0.0).all() or np.linalg.eigvalsh(normal / np.outer(scale, scale))[0] <= SINGULAR:
        return None
    return np.asarray(np.linalg.solve(normal, weighted.T @ error_px.ravel()))


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
