"""Model of a target's pixels with derivatives by camera, poses and target geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photogram.camera import LEFT, RIG_PARAMETERS, RIGHT, ROTATION, TRANSLATION, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector, skew
from photogram.targets.target_view import Target
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray

_OVER, _UNDER = [4, 5, 8], [9, 10, 11]  # indices of k1 k2 k3 and of k4 k5 k6 among a camera's parameters
_RADII2 = np.array([0.25, 0.6, 1.0])  # squared radii over that of the image corner, spread over the image
_ANGLE = 2 * np.pi * np.arange(12) / 12
_RIM = np.column_stack([np.cos(_ANGLE), np.sin(_ANGLE)])  # points on a dot's rim at which the distortion is evaluated


@dataclass(frozen=True, eq=False)
class ModelledPixels:
    """Modelled pixels (N, 2) of one image with derivatives.

    The derivatives are by the camera's parameters (N, 2, 13), by its pose relative to the left camera (N, 2, 6), by the
    target's pose (N, 2, 6) and by the point in the target's frame (N, 2, 3). Poses are translation, then
    left-multiplied rotation.
    """

    pixel: FloatArray
    by_camera: FloatArray
    by_relative: FloatArray
    by_pose: FloatArray
    by_point: FloatArray

    def by_rig(self, side: int) -> FloatArray:
        """Return the derivatives (N, 2, 32) by a pair's parameters.

        `side` is 0 (left) or 1 (right).
        """
        slope = np.zeros((len(self.pixel), 2, len(RIG_PARAMETERS)))
        slope[..., RIGHT if side else LEFT] = self.by_camera
        if side:
            slope[..., ROTATION], slope[..., TRANSLATION] = self.by_relative[..., 3:], self.by_relative[..., :3]
        return slope

    def scaled(self, camera: Camera, growth: FloatArray) -> ModelledPixels:
        """Return the pixels for focal lengths that are larger by `growth` (N,), relative."""
        factor, centre = 1 + growth[:, None], camera.matrix[:2, 2]
        others = (self.by_camera, self.by_relative, self.by_pose, self.by_point)
        by_camera, *rest = (slope * factor[..., None] for slope in others)
        by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
        return ModelledPixels(centre + (self.pixel - centre) * factor, by_camera, *rest)


def model_pixels(
    camera: Camera,
    camera_from_left: RigidTransform,
    left_from_target: RigidTransform,
    point_m: FloatArray,
    radius_m: float,
) -> ModelledPixels:
    """Return the modelled pixels of target points (N, 3); dots by their ellipse's centre.

    `radius_m` > 0 is that of dots. The derivatives omit the change of the distortion over a dot's rim, about 10⁻⁵ of
    them.
    """
    one = np.zeros(len(point_m), np.int64)
    return model_view_pixels(camera, camera_from_left, (left_from_target,), one, point_m, radius_m)


def model_view_pixels(
    camera: Camera,
    camera_from_left: RigidTransform,
    left_from_target: Sequence[RigidTransform],
    view: IntArray,
    point_m: FloatArray,
    radius_m: float,
) -> ModelledPixels:
    """Return the modelled pixels of points (N, 3), each in the view (N,) of it."""
    rotations = np.stack([pose.rotation for pose in left_from_target])
    rotation, translation = rotations[view], np.stack([pose.translation_m for pose in left_from_target])[view]
    normal_left = rotation[:, :, 2]
    normal = normal_left @ camera_from_left.rotation.T
    rotated = np.einsum("nij,nj->ni", rotation, point_m)
    in_camera_rotated = (rotated + translation) @ camera_from_left.rotation.T
    in_camera = in_camera_rotated + camera_from_left.translation_m
    flat, flat_by_position, flat_by_normal = ellipse_centres(in_camera, normal, radius_m)
    placed, by_flat = distort_points(camera, flat)
    if radius_m > 0:
        disc = radius_m * (camera_from_left.rotation @ rotations[:, :, :2])[view]
        rim = in_camera[:, None] + _RIM @ disc.transpose(0, 2, 1)
        placed = placed + _bent(camera, rim[..., :2] / rim[..., 2:], flat, placed, by_flat)
    by_flat = camera.matrix[:2, :2] @ by_flat
    by_position = by_flat @ flat_by_position
    by_left = by_position @ camera_from_left.rotation
    by_turn, by_left_turn = -by_position @ skew(in_camera_rotated), -by_left @ skew(rotated)  # r·[v]× = r × v
    if radius_m > 0:
        by_normal = by_flat @ flat_by_normal
        by_turn -= by_normal @ skew(normal)
        by_left_turn -= by_normal @ camera_from_left.rotation @ skew(normal_left)
    return ModelledPixels(
        placed @ camera.matrix[:2, :2].T + camera.matrix[:2, 2],
        _by_camera(camera, flat, placed),
        np.concatenate([by_position, by_turn], axis=-1),
        np.concatenate([by_left, by_left_turn], axis=-1),
        by_left @ rotation,
    )


def ellipse_centres(
    centre_m: FloatArray, normal: FloatArray, radius_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the centres (N, 2) of projected dots with derivatives by centre and normal.

    The dots are around c (N, 3), with normal n, (3,) or (N, 3); the camera is ideal and the derivatives are (N, 2, 3).
    The cone through a dot of radius ρ has the dual conic ρ²·(I − n·nᵀ) − c·cᵀ. The ellipse's centre is the pole of the
    line at infinity, its last column (Heikkilä 2000, IEEE PAMI 22, 1066, eq. 16, written for n): e = (c_xy·c_z +
    ρ²·n_xy·n_z)/(c_z² − ρ²·|n_xy|²).
    """
    across, depth = centre_m[:, :2], centre_m[:, 2:]
    normal, square = np.broadcast_to(normal, centre_m.shape), radius_m**2
    over = depth**2 - square * (normal[:, :2] ** 2).sum(axis=1, keepdims=True)
    centre = (across * depth + square * normal[:, :2] * normal[:, 2:]) / over
    by_position = np.zeros((len(centre_m), 2, 3))
    by_position[:, 0, 0] = by_position[:, 1, 1] = (depth / over)[:, 0]
    by_position[:, :, 2] = (across - 2 * centre * depth) / over
    by_normal = np.empty((len(centre_m), 2, 3))
    by_normal[:, :, :2] = 2 * square * centre[:, :, None] * normal[:, None, :2] / over[:, :, None]
    by_normal[:, :, :2] += square * normal[:, 2, None, None] * np.eye(2) / over[:, :, None]
    by_normal[:, :, 2] = square * normal[:, :2] / over
    return centre, by_position, by_normal


def _bent(camera: Camera, rim: FloatArray, centre: FloatArray, placed: FloatArray, by_centre: FloatArray) -> FloatArray:
    """Return the shift (N, 2), normalised, of an ellipse by distortion of the dot's rim.

    The lens moves the rim (N, 12, 2) by q relative to a linear map. The map takes the centre (N, 2) to `placed` with
    the derivative `by_centre` (N, 2, 2). The ellipse that fits the distorted rim best along its normals n is shifted by
    (Σ n·nᵀ)⁻¹·Σ n·nᵀ·q.
    """
    offset = np.einsum("nij,nkj->nki", by_centre, rim - centre[:, None])
    bent = distort_points(camera, rim)[0] - placed[:, None] - offset
    tangent = np.roll(offset, -1, axis=1) - np.roll(offset, 1, axis=1)
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    along = np.einsum("nki,nki->nk", normal, bent)
    matrix = np.einsum("nki,nkj->nij", normal, normal)
    return np.asarray(np.linalg.solve(matrix, np.einsum("nki,nk->ni", normal, along)[..., None])[..., 0])


def distort_points(camera: Camera, undistorted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distorted normalised coordinates (..., 2) and their derivative (..., 2, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = camera.distortion
    x, y = undistorted[..., 0], undistorted[..., 1]
    r2 = x * x + y * y
    under = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    gain = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / np.where(under > 0, under, np.nan)
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2) - gain * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / under
    placed = [x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by_x = gain + slope * x * x + 2 * p1 * y + 6 * p2 * x
    by_y = gain + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return np.stack(placed, axis=-1), np.stack(
        [np.stack([by_x, mixed], axis=-1), np.stack([mixed, by_y], axis=-1)], axis=-2
    )


def _by_camera(camera: Camera, flat: FloatArray, placed: FloatArray) -> FloatArray:
    """Return ∂pixel/∂parameters (N, 2, 13) at undistorted and distorted coordinates (N, 2)."""
    k1, k2, _, _, k3, k4, k5, k6 = camera.distortion
    x, y = flat.T
    r2 = x * x + y * y
    under = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    gain = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / under
    radial = flat[:, :, None] * (r2[:, None] ** [1, 2, 3] / under[:, None])[:, None]  # by k1, k2, k3
    by_distortion = np.empty((len(flat), 2, 8))
    by_distortion[..., [0, 1, 4]] = radial
    by_distortion[..., 2] = np.stack([2 * x * y, r2 + 2 * y * y], axis=-1)
    by_distortion[..., 3] = np.stack([r2 + 2 * x * x, 2 * x * y], axis=-1)
    by_distortion[..., 5:] = -gain[:, None, None] * radial
    by_camera = np.zeros((len(flat), 2, 13))
    by_camera[:, 0, 0], by_camera[:, 1, 1] = placed.T
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    by_camera[:, :, 4:12] = camera.matrix[:2, :2] @ by_distortion
    by_camera[:, 0, 12] = placed[:, 1]
    return by_camera


# Geometry of the target: flat, bowed, or with free points.

ShapeKind = Literal["flat", "bowed", "free"]

_BOW = 0.01  # prior of a bow: height over the target's half diagonal; printed plates are bent less
_FREE = 0.01  # initial prior of single points: displacement over the spacing
_DETERMINED = 0.1  # least number of determined values, against rounding without information
_STRETCH = 3.0  # rms displacement by stretch of one axis and by shear, over that of single points


@dataclass(frozen=True, eq=False, repr=False)
class TargetGeometry(Arrays, shapes="index P 2; value_m S; flat_m P 3; modes P 3 M; prior_m S"):
    """Points of a target with modes of deformation and their prior.

    They are flat_m (P, 3) + modes (P, 3, M)·value_m.

    Attributes
    ----------
    index : (P, 2), lattice indices.
    flat_m : (P, 3), flat lattice.
    modes : (P, 3, M).
    value_m : (S,), values of the modes; for `free` points preceded by an offset of each point, x y z point by point.
    prior_m : (S,), standard deviations of the values around zero; of free points they are estimated together with the
        values.
    group : (S,), group of each value with one prior: within the plane, across it, and modes (`_STRETCH` times that
        within the plane).
    free : Whether every point has an offset.
    """

    index: IntArray
    flat_m: FloatArray
    modes: FloatArray
    value_m: FloatArray
    prior_m: FloatArray
    group: IntArray
    free: bool

    @property
    def points_m(self) -> FloatArray:
        """Estimated points (P, 3)."""
        modes = self.modes.shape[2]
        offset = self.modes @ self.value_m[len(self.value_m) - modes :]
        return np.asarray(self.flat_m + offset + (self.value_m[:-modes].reshape(-1, 3) if self.free else 0.0))

    def with_step(self, step_m: FloatArray) -> TargetGeometry:
        """Return the geometry with its values changed by a step (S,)."""
        return replace(self, value_m=self.value_m + step_m)

    def with_prior_from(self, variance_m2: FloatArray) -> TargetGeometry:
        """Return the geometry with each group's prior estimated from its values.

        `variance_m2` (S,) is that of the values. The step is towards the most likely σ with log σ added to the
        log-likelihood, which is never 0 (Chung, Rabe-Hesketh, Dorie, Gelman, Liu 2013, Psychometrika 78, 685): Σ value²
        + σ² = σ²·γ. Here γ = Σ (1 − variance/σ²) is the number of values that the images determine (MacKay 1992, Neural
        Computation 4, 415). For small σ, γ grows as σ²; for large σ it is constant. In both cases σ² = (Σ value² +
        σ²)/γ converges in few steps.
        """
        if not self.free:
            return self

        def spread(members: BoolArray) -> float:
            prior2 = float(self.prior_m[members][0]) ** 2
            determined = max(float((1 - variance_m2[members] / prior2).sum()), _DETERMINED)
            return float(np.sqrt(((self.value_m[members] ** 2).sum() + prior2) / determined))

        inside, across = spread(self.group == 0), spread(self.group == 1)
        return replace(self, prior_m=np.array([inside, across, _STRETCH * inside])[self.group])


def make_shape(kind: ShapeKind, index: IntArray, target: Target) -> TargetGeometry:
    """Return the initial geometry of the lattice points `index` (P, 2).

    `bowed`: height as a quadratic form of the position on the target. `free`: every point has an offset, with one
    spread within the plane and one across it. Scale, position and rotation of all points together stay those of the
    lattice within that spread (Strobl and Hirzinger 2011, ICCV Workshops, 1068). Printers stretch one axis and shear,
    so these two modes have a separate rms displacement, three times that of single points.
    """
    flat = target.points_m(index)
    points = len(index)
    if kind == "flat":
        return TargetGeometry(
            index, flat, np.zeros((points, 3, 0)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64), False
        )
    if kind == "bowed":
        middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
        half = np.linalg.norm(flat - middle, axis=1).max()
        x, y = ((flat - middle)[:, :2] / half).T
        modes = np.zeros((points, 3, 3))
        modes[:, 2] = np.column_stack([x * x, x * y, y * y])
        return TargetGeometry(index, flat, modes, np.zeros(3), np.full(3, _BOW * half), np.zeros(3, np.int64), False)
    lattice = (flat - flat.mean(axis=0))[:, :2]
    modes = np.zeros((points, 3, 2))
    modes[:, :2, 0], modes[:, :2, 1] = lattice * [1, -1], lattice[:, ::-1]  # stretch, shear
    group = np.array([*np.tile([0, 0, 1], points), 2, 2])
    prior = np.array([1.0, 1.0, _STRETCH])[group] * _FREE * target.spacing_m
    return TargetGeometry(
        index, flat, modes / np.sqrt((lattice**2).sum(axis=1).mean()), np.zeros(len(group)), prior, group, True
    )


_RIG = len(RIG_PARAMETERS)


@dataclass(frozen=True, eq=False)
class ImageObservations:
    """Observed points of one image: its view, side (0 left, 1 right) and pixels.

    `point` (N,): rows of the target's points. `position_px` (N, 2). `precision` (N, 2, 2): inverse covariance, zero for
    rejected points.
    """

    view: int
    side: int
    point: IntArray
    position_px: FloatArray
    precision: FloatArray
    radius_m: float

    def model(self, bundle: Bundle) -> ModelledPixels:
        """Return the modelled pixels of the points."""
        return bundle.model_pixels(self.side, np.full(len(self.point), self.view), self.point, self.radius_m)


@dataclass(frozen=True, eq=False)
class FocalDrift:
    """Linear relative change of the focal lengths over a session.

    Causes are a lens that warms up or a loose mount. `value` (2,): relative change, left and right, from the first view
    to the last; the rig has the values of the middle. `relative_time` (V,): time of each view, from −½ to ½.
    """

    value: FloatArray
    relative_time: FloatArray

    @staticmethod
    def initial(views: int) -> FocalDrift:
        """Return zero drift over a number of views."""
        return FocalDrift(np.zeros(2), np.linspace(-0.5, 0.5, views))

    def growth(self, side: int, view: IntArray) -> FloatArray:
        """Return the relative increase (N,) of the focal lengths of a side in views (N,)."""
        return np.asarray(self.value[side] * self.relative_time[view])


DRIFT_SPREAD = 5e-3  # prior standard deviation of a relative drift; warming lenses change by some 10⁻³


@dataclass(frozen=True, eq=False)
class Bundle:
    """All unknowns: rig, target pose `left_from_target` in each view, target geometry, drift."""

    rig: StereoRig
    poses: tuple[RigidTransform, ...]
    shape: TargetGeometry
    drift: FocalDrift | None = None

    def of_views(self, views: Sequence[int]) -> Bundle:
        """Return the bundle of some views."""
        drift = self.drift and replace(self.drift, relative_time=self.drift.relative_time[list(views)])
        return replace(self, poses=tuple(self.poses[view] for view in views), drift=drift)

    def with_step(self, step: FloatArray, pose_steps: FloatArray) -> Bundle:
        """Return the bundle after a step of all unknowns.

        `step` (32 + S + D,) is that of rig, geometry and drift, `pose_steps` (V, 6) that of the poses. To first order
        they are added. Beyond it, the target centres move linearly in both images and in the logarithm of their depth,
        and focal lengths change by factors. Long focal lengths correlate with depth, and the principal point with
        rotation. The minimum lies in a curved valley, in which straight steps would have to be tiny.
        """
        middle = self.shape.flat_m.mean(axis=0)
        growth = step[LEFT[:2]] / self.rig.left.parameters[:2]
        poses = step_poses(middle, self.poses, pose_steps, growth)
        before, after = (np.mean([pose.apply(middle) for pose in every], axis=0) for every in (self.poses, poses))
        turns = np.cross(pose_steps[:, 3:], [pose.rotation @ middle for pose in self.poses])
        shift = np.mean(pose_steps[:, :3] + turns, axis=0)
        rig = StereoRig(
            _step_camera(self.rig.left, step[LEFT]),
            _step_camera(self.rig.right, step[RIGHT]),
            self._step_relative(step, before, after, shift),
        )
        ends = _RIG + len(self.shape.value_m)
        drift = self.drift and replace(self.drift, value=self.drift.value + step[ends:])
        return Bundle(rig, poses, self.shape.with_step(step[_RIG:ends]), drift)

    def _step_relative(
        self, step: FloatArray, before: FloatArray, after: FloatArray, shift: FloatArray
    ) -> RigidTransform:
        """Return `right_from_left` after a step.

        The targets' common centre moves from `before` to `after` in the left camera; `shift` (3,) is its step to first
        order.
        """
        relative, growth = self.rig.right_from_left, step[RIGHT[:2]] / self.rig.right.parameters[:2]
        rotated = relative.rotation @ before
        change = np.cross(step[ROTATION], rotated) + step[TRANSLATION] + relative.rotation @ shift
        centre = _step_positions(rotated + relative.translation_m, change, growth)
        rotation = rotation_from_vector(step[ROTATION]) @ relative.rotation
        return RigidTransform(rotation, centre - rotation @ after)

    def model_pixels(self, side: int, view: IntArray, point: IntArray, radius_m: float) -> ModelledPixels:
        """Return the modelled pixels (N, 2) of points (N,) in views (N,) with derivatives."""
        rig = self.rig
        camera, relative = (rig.right, rig.right_from_left) if side else (rig.left, RigidTransform.identity())
        seen = model_view_pixels(camera, relative, self.poses, view, self.shape.points_m[point], radius_m)
        return seen if self.drift is None else seen.scaled(camera, self.drift.growth(side, view))


def step_poses(
    middle_m: FloatArray, poses: Sequence[RigidTransform], steps: FloatArray, growth: FloatArray
) -> tuple[RigidTransform, ...]:
    """Return a target's poses after steps (V, 6).

    The target centre moves linearly in the image and in logarithmic depth. `growth` (2,): steps of the focal lengths
    over their values.
    """
    rotation = np.stack([pose.rotation for pose in poses])
    rotated, centre = rotation @ middle_m, np.stack([pose.translation_m for pose in poses])
    centre = _step_positions(rotated + centre, np.cross(steps[:, 3:], rotated) + steps[:, :3], growth)
    rotation = rotation_from_vector(steps[:, 3:]) @ rotation
    return tuple(RigidTransform(*pose) for pose in zip(rotation, centre - rotation @ middle_m, strict=True))


def _step_positions(position: FloatArray, step: FloatArray, growth: FloatArray) -> FloatArray:
    """Return positions (..., 3) after steps (..., 3), linear in the image and log depth.

    `growth` (2,): steps of the focal lengths over their values, so that f·x/z changes linearly.
    """
    depth, depth_step = position[..., 2:], step[..., 2:]
    bearing = position[..., :2] / depth
    moved = bearing + (step[..., :2] - bearing * depth_step) / depth + bearing * growth
    return np.concatenate([moved * np.exp(-growth), np.ones_like(depth)], axis=-1) * depth * np.exp(depth_step / depth)


def _step_camera(camera: Camera, step: FloatArray) -> Camera:
    """Return the camera after a step (13,), focal lengths by factors.

    For a rational lens the radial factor at three radii changes linearly, not k1, k2 and k3.
    """
    parameters = camera.parameters + step
    parameters[:2] = camera.parameters[:2] * np.exp(step[:2] / camera.parameters[:2])
    if parameters[9:12].any():
        corner2 = float((camera.size_px**2).sum()) / 4 / float(camera.parameters[:2].mean()) ** 2
        powers = (corner2 * _RADII2)[:, None] ** np.arange(1, 4)
        over, under = (1 + powers @ camera.parameters[indices] for indices in (_OVER, _UNDER))
        change = (powers @ step[_OVER] - over / under * (powers @ step[_UNDER])) / under
        after = (over / under + change) * (1 + powers @ parameters[_UNDER])
        parameters[_OVER] = np.linalg.solve(powers, after - 1)
    return Camera.from_parameters(parameters, camera.size_px)
