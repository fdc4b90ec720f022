"""A body's surface in a camera, image motion of its patches, shapes of its deformation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from photogram.camera import Camera, project_one
from photogram.geometry import RigidTransform
from photogram.motion import FEWEST, MEDIAN_CHI2_OF_TWO, REJECTED, SINGULAR, START_ROUNDS
from shakercal._common.arrays import Arrays, FloatArray, check_shape
from shakercal._common.kernels import njit
from shakercal._common.propagation import derivatives

NEIGHBOURS = 24  # points of a local plane: two rings of a square grid
OUTLIER = 4.0  # robust standard deviations from the local plane
RATE_STEP = 1e-6  # m and rad, of the derivative by the six components
MIN_TRACE = 2.99  # of a rotation by 0.1 rad, up to which derivatives at rest suffice for a start value
NEAR_PX = 0.02  # by which the last step of a start value may move a point
AT_REST = RigidTransform.identity()


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera and the body's frame at rest: x_camera = camera_from_body · x_body."""

    camera: Camera
    camera_from_body: RigidTransform

    def project(self, points_m: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of points (..., 3) in the body's frame."""
        return self.camera.project(self.camera_from_body.apply(points_m))


@dataclass(frozen=True, eq=False, repr=False)
class Patches(Arrays, shapes="centre_px C 2; points_m C 5 3; rest_px C 5 2"):
    """Small plane patches of a body in one camera, at rest.

    NaN where the surface is unknown.

    Attributes
    ----------
    centre_px : (C, 2).
    arm_px : half the length over which derivatives are computed.
    points_m : (C, 5, 3) the surface, in the body's frame, at the centre and `arm_px` to its right, left, below and
        above.
    rest_px : (C, 5, 2) pixels of these.
    """

    centre_px: FloatArray
    arm_px: float
    points_m: FloatArray
    rest_px: FloatArray


def body_patches(
    camera: PlacedCamera, surface_m: FloatArray, centre_px: FloatArray, arm_px: float, reach_px: float
) -> Patches:
    """Return the surface at centre_px (C, 2) from points (N, 3) of the body.

    A plane has an inverse depth that is linear in the normalised coordinates, 1/Z = w + w_x·x + w_y·y. It is fitted to
    the 24 points nearest in the image, without those more than four robust standard deviations off. The surface is
    unknown where no point lies within `reach_px`.
    """
    from scipy.spatial import cKDTree

    check_shape("surface_m", surface_m, (None, 3))
    check_shape("centre_px", centre_px, (None, 2))
    surface = camera.camera_from_body.apply(surface_m[np.isfinite(surface_m).all(axis=1)])
    if len(surface) < 3:
        raise ValueError(f"surface_m: expected at least 3 finite points, found {len(surface)}")
    tree = cKDTree(camera.camera.project(surface))
    distance, nearest = tree.query(centre_px, k=min(NEIGHBOURS, len(surface)))
    centre = camera.camera.undistort(centre_px)
    plane = _inverse_depth(surface[:, :2] / surface[:, 2:], 1.0 / surface[:, 2], nearest, centre)
    arms = arm_px * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    rays = camera.camera.undistort(centre_px[:, None] + arms)
    from_centre = rays - centre[:, None]
    depth = 1.0 / (plane[:, None, 0] + np.einsum("cki,ci->ck", from_centre, plane[:, 1:]))
    depth[(distance[:, 0] > reach_px)[:, None] | (depth <= 0.0)] = np.nan
    seen = np.concatenate([rays * depth[..., None], depth[..., None]], axis=2)
    points = camera.camera_from_body.inverse().apply(seen)
    return Patches(centre_px, arm_px, points, camera.project(points))


def patch_warps(camera: PlacedCamera, patches: Patches, moved: RigidTransform) -> FloatArray:
    """Return the affine warps (C, 6) of the patches in px after the motion `moved`.

    [u u_x u_y v v_x v_y].
    """
    return warps_of_points(camera, patches, patches.points_m, moved)


def warps_of_points(
    camera: PlacedCamera, patches: Patches, points_m: FloatArray, by: RigidTransform = AT_REST
) -> FloatArray:
    """Return the affine warps (C,6) of the patches from positions (C,5,3) moved `by` a motion."""
    pose, rest, warp = camera.camera_from_body, (patches.rest_px, patches.arm_px), np.empty((len(points_m), 6))
    into = pose.rotation @ by.rotation, pose.apply(by.translation_m)
    _warps(np.ascontiguousarray(points_m), into, camera.camera.parameters, rest, warp)
    return warp


@njit()
def _warps(points, pose, camera, rest, warps):  # type: ignore[no-untyped-def]
    """Fill `warps` with shifts of the patches' centres, and differences of their arms.

    NaN behind the camera.
    """
    (rotation, translation), (rest_px, arm_px), shift = pose, rest, np.empty((5, 2))
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


def patch_rates(
    camera: PlacedCamera, patches: Patches, shapes: Shapes | None = None, moved: RigidTransform = AT_REST
) -> FloatArray:
    """Return the derivatives (C, 6, 6 + S) of the patches' warps.

    They are by x y z (m) and rx ry rz (rad) of a motion δ that precedes `moved`, and by S amplitudes of shapes. The
    warp of both is that of `moved` after the one that the derivatives describe, W(moved·δ) = W(moved)∘(1 + rates·δ), so
    that they compare at any motion with the derivatives of the reference image. With A, the linear part of W(moved),
    they are A⁻¹·∂W(moved·δ)/∂δ.
    """
    rates = derivatives(
        lambda pose: patch_warps(camera, patches, moved @ RigidTransform.from_pose(pose)), np.full(6, RATE_STEP)
    )
    if shapes is not None:
        shape = shapes(patches.points_m.reshape(-1, 3))
        shape_m = shape.reshape(len(shape), *patches.points_m.shape)

        def warps(amplitude: FloatArray) -> FloatArray:
            return warps_of_points(camera, patches, patches.points_m + np.tensordot(amplitude, shape_m, 1), moved)

        rates = np.concatenate([rates, derivatives(warps, np.full(len(shape), RATE_STEP))], axis=2)
    if moved is AT_REST:
        return rates
    warp = patch_warps(camera, patches, moved).reshape(-1, 2, 3)
    known = np.array(np.isfinite(warp).all(axis=(1, 2)))
    linear = np.where(known[:, None, None], np.eye(2) + warp[:, :, 1:], np.eye(2))
    both = np.linalg.solve(linear, rates.reshape(len(warp), 2, -1))
    return np.asarray(both.reshape(rates.shape))


@dataclass(frozen=True, eq=False, repr=False)
class SeenPoints(Arrays, shapes="points_m N 3; rates N 2 6"):
    """Points of a body at rest (N,3), and their pixels' derivatives (N,2,6) in one camera."""

    camera: PlacedCamera
    points_m: FloatArray
    rates: FloatArray

    @cached_property
    def rest_px(self) -> FloatArray:
        """Pixels (N, 2) of the points at rest."""
        return self.camera.project(self.points_m)


def project_body_points(camera: PlacedCamera, points_m: FloatArray, moved: RigidTransform = AT_REST) -> SeenPoints:
    """Return points (N,3) of a body at rest with their pixels' derivatives in a camera.

    They are those of a motion that precedes `moved`. NaN for a missing point.
    """
    rates = derivatives(
        lambda pose: camera.project((moved @ RigidTransform.from_pose(pose)).apply(points_m)), np.full(6, RATE_STEP)
    )
    return SeenPoints(camera, points_m, rates)


def motion_from_positions(seen: Sequence[SeenPoints], positions_px: Sequence[FloatArray]) -> RigidTransform | None:
    """Return the motion from rest that brings points to positions (N, 2) in each camera.

    Gauss-Newton, as in `direct_fit.fit_direct`, of distances in px with Cauchy weights 1/(1 +
    d²/median d²), which tolerate a third of wrong positions. A last step weights those within five robust standard
    deviations equally. A start value, without a covariance. None where fewer than six positions are finite, or they do
    not determine all six components.
    """
    rates, positions = np.concatenate([one.rates for one in seen]), np.concatenate(positions_px)
    finite = np.isfinite(positions).all(axis=1) & np.isfinite(rates[:, 0, 0])
    if np.count_nonzero(finite) < FEWEST:
        return None
    rates, positions = rates[finite], positions[finite]
    weight, moved = np.ones(len(rates)), RigidTransform.identity()
    for _ in range(START_ROUNDS):
        if moved.rotation.trace() < MIN_TRACE:
            rates = np.concatenate([project_body_points(one.camera, one.points_m, moved).rates for one in seen])[finite]
        found = np.concatenate([one.camera.project(moved.apply(one.points_m)) for one in seen])[finite]
        step = _weighted_step(rates, positions - found, weight)
        if step is None:
            return None
        moved = moved @ RigidTransform.from_pose(step)
        change = rates @ step
        left = positions - found - change
        squares = (left**2).sum(axis=1)
        median = max(float(np.median(squares)), 1e-300)
        weight = 1.0 / (1.0 + squares / median)
        if np.abs(change).max() < NEAR_PX:
            break
    step = _weighted_step(rates, left, (squares <= REJECTED * median / MEDIAN_CHI2_OF_TWO).astype(np.float64))
    return None if step is None else moved @ RigidTransform.from_pose(step)


def _weighted_step(rates: FloatArray, error_px: FloatArray, weight: FloatArray) -> FloatArray | None:
    """Return the pose (6,) that explains errors (N,2) by rates (N,2,6), None if undetermined."""
    design = rates.reshape(-1, 6)
    weighted = np.repeat(weight, 2)[:, None] * design
    normal = weighted.T @ design
    scale = np.sqrt(np.diagonal(normal))
    if not (scale > 0.0).all() or np.linalg.eigvalsh(normal / np.outer(scale, scale))[0] <= SINGULAR:
        return None
    return np.asarray(np.linalg.solve(normal, weighted.T @ error_px.ravel()))


def _inverse_depth(ray: FloatArray, inverse: FloatArray, nearest: FloatArray, centre: FloatArray) -> FloatArray:
    """Return w, w_x, w_y (C, 3) about each centre through its nearest points, without outliers."""
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


# Shapes of a body's deformation, and their amplitudes.


class Shapes(Protocol):
    """Shapes in which a body may deform, by their names, in the body's frame."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the S shapes."""

    def __call__(self, points_m: FloatArray) -> FloatArray:
        """Return the displacement (S,N,3) of points (N,3) at rest in shapes of amplitude 1.

        It is finite everywhere.
        """


PLAIN = ("bowl", "saddle", "twist", "breathing", "stretch", "shear")


@dataclass(frozen=True, eq=False, repr=False)
class PlainShapes(Arrays, shapes="middle_m 3; axes 3 3"):
    """Six general shapes of a face: second order across it, first order along it.

    axes (3, 3): rows u and v along the face, n across it; reach_m: from its middle to its rim. With u, v in units of it
    the face moves across by u² + v² (bowl), u² − v² (saddle) or 2uv (twist). Along it, it moves by (u, v) (breathing),
    (u, −v) (stretch) or (v, u) (shear). An amplitude is the displacement of the rim against the middle, in m.
    """

    middle_m: FloatArray
    axes: FloatArray
    reach_m: float

    @classmethod
    def of(cls, points_m: FloatArray) -> PlainShapes:
        """Return the shapes of a face by points (N, 3) of it.

        u is the axis of the frame that lies most along the face.
        """
        finite = points_m[np.isfinite(points_m).all(axis=1)]
        middle = finite.mean(axis=0)
        normal = np.linalg.svd(finite - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
        along = np.eye(3)[np.argmin(np.abs(normal))]
        along = along - (along @ normal) * normal
        along /= np.linalg.norm(along)
        reach = np.linalg.norm(finite - middle, axis=1).max()
        return cls(middle, np.stack([along, np.cross(normal, along), normal]), float(reach))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shapes."""
        return PLAIN

    def __call__(self, points_m: FloatArray) -> FloatArray:
        """Return the displacement (6, N, 3) of points (N, 3)."""
        u, v = ((points_m - self.middle_m) @ self.axes[:2].T / self.reach_m).T
        across, along = np.stack([u * u + v * v, u * u - v * v, 2.0 * u * v]), np.array([[u, v], [u, -v], [v, u]])
        return np.concatenate([across[..., None] * self.axes[2], np.einsum("skn,kc->snc", along, self.axes[:2])])


@dataclass(frozen=True, eq=False, repr=False)
class ShapeAmplitudes(Arrays, shapes="amplitude F S; covariance F S S; share 6 S"):
    """Amplitudes of a body's S `shapes` in F frames, fitted to the grey values.

    amplitude (F, S) and covariance (F, S, S) of the frame's noise, NaN where the motion was not fitted to the grey
    values. The first frame is the reference of the deformation. The amplitudes are uncorrelated with the motion, which
    explains the frame as rigid: for an amplitude q it contains share (6, S)·q, and the remainder is the motion of the
    body without the shape.
    """

    shapes: Shapes
    amplitude: FloatArray
    covariance: FloatArray
    share: FloatArray
