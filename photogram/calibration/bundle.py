"""What cameras see of a target: pixels with derivatives by camera, relative pose, target pose and target shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photogram.arrays import Arrays, BoolArray, FloatArray, IntArray
from photogram.camera import LEFT, RIG_PARAMETERS, RIGHT, ROTATION, TRANSLATION, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector

_OVER, _UNDER = [4, 5, 8], [9, 10, 11]  # places of k1 k2 k3 and of k4 k5 k6 among a camera's parameters
_RADII2 = np.array([0.25, 0.6, 1.0])  # squared, in units of the picture's corner's
_ANGLE = 2 * np.pi * np.arange(12) / 12
_RIM = np.column_stack([np.cos(_ANGLE), np.sin(_ANGLE)])  # where on a dot's rim the lens's distortion is looked at


@dataclass(frozen=True, eq=False)
class ModelledPixels:
    """Modelled pixels (N, 2) of one picture with derivatives by the camera's parameters (N, 2, 13), by its pose after
    the left camera (N, 2, 6), by the target's pose (N, 2, 6) and by the point in the target's frame (N, 2, 3).

    Poses: translation, then left-multiplied rotation.
    """

    pixel: FloatArray
    by_camera: FloatArray
    by_relative: FloatArray
    by_pose: FloatArray
    by_point: FloatArray

    def by_rig(self, side: int) -> FloatArray:
        """Return the derivatives (N, 2, 32) by the parameters of a pair, this being its left (0) or right (1) side."""
        slope = np.zeros((len(self.pixel), 2, len(RIG_PARAMETERS)))
        slope[..., RIGHT if side else LEFT] = self.by_camera
        if side:
            slope[..., ROTATION], slope[..., TRANSLATION] = self.by_relative[..., 3:], self.by_relative[..., :3]
        return slope


def model_pixels(
    camera: Camera,
    camera_from_left: RigidTransform,
    left_from_target: RigidTransform,
    point_m: FloatArray,
    radius_m: float,
) -> ModelledPixels:
    """Return where a camera sees points (N, 3) of the target; dots of `radius_m` > 0 by the centre of their ellipse.

    The derivatives leave out how the lens's bending of a dot's rim changes, some 10⁻⁵ of them.
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
    """Return where a camera sees points (N, 3) of the target, each in the view (N,) of it; otherwise as `see`."""
    rotations = np.stack([pose.rotation for pose in left_from_target])
    rotation, translation = rotations[view], np.stack([pose.translation_m for pose in left_from_target])[view]
    normal_left = rotation[:, :, 2]
    normal = normal_left @ camera_from_left.rotation.T
    turned = np.einsum("nij,nj->ni", rotation, point_m)
    in_camera_turned = (turned + translation) @ camera_from_left.rotation.T
    in_camera = in_camera_turned + camera_from_left.translation_m
    flat, flat_by_place, flat_by_normal = ellipse_centres(in_camera, normal, radius_m)
    placed, by_flat = distort_points(camera, flat)
    if radius_m > 0:
        disc = radius_m * (camera_from_left.rotation @ rotations[:, :, :2])[view]
        rim = in_camera[:, None] + _RIM @ disc.transpose(0, 2, 1)
        placed = placed + _bent(camera, rim[..., :2] / rim[..., 2:], flat, placed, by_flat)
    by_flat = camera.matrix[:2, :2] @ by_flat
    by_place = by_flat @ flat_by_place
    by_left = by_place @ camera_from_left.rotation
    by_turn, by_left_turn = -_crossed(by_place, in_camera_turned), -_crossed(by_left, turned)
    if radius_m > 0:
        by_normal = by_flat @ flat_by_normal
        by_turn -= _crossed(by_normal, normal)
        by_left_turn -= _crossed(by_normal @ camera_from_left.rotation, normal_left)
    return ModelledPixels(
        placed @ camera.matrix[:2, :2].T + camera.matrix[:2, 2],
        _by_camera(camera, flat, placed),
        np.concatenate([by_place, by_turn], axis=-1),
        np.concatenate([by_left, by_left_turn], axis=-1),
        by_left @ rotation,
    )


def _crossed(rows: FloatArray, vector: FloatArray) -> FloatArray:
    """Return rows (N, 2, 3) times the matrices [v]× of vectors (N, 3): r·[v]× = r × v."""
    return np.cross(rows, vector[:, None])


def ellipse_centres(
    centre_m: FloatArray, normal: FloatArray, radius_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the centres (N, 2), x/z and y/z, of the ellipses that an ideal camera sees of dots around c (N, 3), and
    their derivatives (N, 2, 3) by c and by the normal n, (3,) or (N, 3), of the dots' plane.

    The cone through a dot of radius ρ has the dual conic ρ²·(I − n·nᵀ) − c·cᵀ, and the ellipse's centre is the pole
    of the line at infinity, its last column (Heikkilä 2000, IEEE PAMI 22, 1066, eq. 16, written for n):
    e = (c_xy·c_z + ρ²·n_xy·n_z)/(c_z² − ρ²·|n_xy|²).
    """
    across, depth = centre_m[:, :2], centre_m[:, 2:]
    normal, square = np.broadcast_to(normal, centre_m.shape), radius_m**2
    over = depth**2 - square * (normal[:, :2] ** 2).sum(axis=1, keepdims=True)
    centre = (across * depth + square * normal[:, :2] * normal[:, 2:]) / over
    by_place = np.zeros((len(centre_m), 2, 3))
    by_place[:, 0, 0] = by_place[:, 1, 1] = (depth / over)[:, 0]
    by_place[:, :, 2] = (across - 2 * centre * depth) / over
    by_normal = np.empty((len(centre_m), 2, 3))
    by_normal[:, :, :2] = 2 * square * centre[:, :, None] * normal[:, None, :2] / over[:, :, None]
    by_normal[:, :, :2] += square * normal[:, 2, None, None] * np.eye(2) / over[:, :, None]
    by_normal[:, :, 2] = square * normal[:, :2] / over
    return centre, by_place, by_normal


def _bent(camera: Camera, rim: FloatArray, centre: FloatArray, placed: FloatArray, by_centre: FloatArray) -> FloatArray:
    """Return how far (N, 2), normalised, a lens moves an ellipse beyond its centre, by bending the dot's rim.

    It bends the rim (N, 12, 2) by q beyond a linear map, which takes the centre (N, 2) to `placed` with the derivative
    `by_centre` (N, 2, 2); the ellipse that fits the bent rim best along its normals n lies (Σ n·nᵀ)⁻¹·Σ n·nᵀ·q further.
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
    """Return distorted normalised coordinates (..., 2) and their derivative (..., 2, 2) by the undistorted ones."""
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


# The target's shape: flat, bowed, or every point where it is.

ShapeKind = Literal["flat", "bowed", "free"]

_BOW = 0.01  # what is known of a bow beforehand: its height over the target's half diagonal
_FREE = 0.01  # and of single points: their displacement over the spacing
_DETERMINED = 0.1  # least number of values by which a spread is told, against rounding where they tell nothing
_STRETCH = 3.0  # rms displacement by stretch of one axis and by shear, over that of single points


@dataclass(frozen=True, eq=False, repr=False)
class TargetGeometry(Arrays, shapes="index P 2; value_m S; flat_m P 3; modes P 3 M; prior_m S"):
    """Points of a target, flat_m (P, 3) + modes (P, 3, M)·value_m, with what is known of the values beforehand.

    `index` (P, 2): lattice indices. Where the points are `free`, an offset of each, x y z point by point, comes first
    among the values (S,), then those of the modes. `prior_m` (S,): standard deviations of the values around zero;
    of free points they are estimated together with them, by `group` (S,): within the plane, across it, and of the modes
    `_STRETCH` times that within the plane.
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
        """The points (P, 3) as they are estimated."""
        modes = self.modes.shape[2]
        offset = self.modes @ self.value_m[len(self.value_m) - modes :]
        return np.asarray(self.flat_m + offset + (self.value_m[:-modes].reshape(-1, 3) if self.free else 0.0))

    def with_step(self, step_m: FloatArray) -> TargetGeometry:
        """Return the shape with its values changed by a step (S,)."""
        return replace(self, value_m=self.value_m + step_m)

    def with_prior_from(self, variance_m2: FloatArray) -> TargetGeometry:
        """Return the shape with each group's prior set to the spread of its values, known to `variance_m2` (S,).

        A step towards the σ that is most likely with log σ added to the logarithm of the likelihood, which is never 0
        (Chung, Rabe-Hesketh, Dorie, Gelman, Liu 2013, Psychometrika 78, 685): Σ value² + σ² = σ²·γ with the number
        γ = Σ (1 − variance/σ²) of values that the pictures determine (MacKay 1992, Neural Computation 4, 415). Where σ
        is small γ grows as σ², where it is large γ is constant; either way σ² = (Σ value² + σ²)/γ takes few steps.
        """
        if not self.free:
            return self

        def spread(own: BoolArray) -> float:
            prior2 = float(self.prior_m[own][0]) ** 2
            determined = max(float((1 - variance_m2[own] / prior2).sum()), _DETERMINED)
            return float(np.sqrt(((self.value_m[own] ** 2).sum() + prior2) / determined))

        inside, across = spread(self.group == 0), spread(self.group == 1)
        return replace(self, prior_m=np.array([inside, across, _STRETCH * inside])[self.group])


def make_shape(kind: ShapeKind, index: IntArray, spacing_m: float) -> TargetGeometry:
    """Return the shape of the lattice points `index` (P, 2) before anything is known of it.

    `bowed`: height as a quadratic form of the place on the target. `free`: every point has an offset of its own, with
    one spread within the plane and one across; scale, place and turn of all points together stay those of the lattice
    to within what the spread allows (Strobl and Hirzinger 2011, ICCV Workshops, 1068). Since printers stretch one axis
    and shear, these two have an rms displacement of their own, three times that of the single points.
    """
    flat = np.column_stack([index * spacing_m, np.zeros(len(index))])
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
    place = (flat - flat.mean(axis=0))[:, :2]
    modes = np.zeros((points, 3, 2))
    modes[:, :2, 0], modes[:, :2, 1] = place * [1, -1], place[:, ::-1]  # stretch, shear
    group = np.array([*np.tile([0, 0, 1], points), 2, 2])
    prior = np.array([1.0, 1.0, _STRETCH])[group] * _FREE * spacing_m
    return TargetGeometry(
        index, flat, modes / np.sqrt((place**2).sum(axis=1).mean()), np.zeros(len(group)), prior, group, True
    )


_RIG = len(RIG_PARAMETERS)


@dataclass(frozen=True, eq=False)
class ImageObservations:
    """One picture in the adjustment: which view, which side (0 left, 1 right), and its points.

    `point` (N,): rows of the target's points. `position_px` (N, 2); `precision` (N, 2, 2): inverse covariance, zero
    for points that take no part.
    """

    view: int
    side: int
    point: IntArray
    position_px: FloatArray
    precision: FloatArray
    radius_m: float


@dataclass(frozen=True, eq=False)
class FocalDrift:
    """How focal lengths change over a session (a lens that warms up, or gives way): evenly from view to view.

    `value` (2,): relative change, left and right, from the first view to the last; the rig's are those of the middle.
    `place` (V,): when each view was taken, −½ the first … ½ the last.
    """

    value: FloatArray
    relative_time: FloatArray

    @staticmethod
    def initial(views: int) -> FocalDrift:
        """Return that of so many views before anything is known of it."""
        return FocalDrift(np.zeros(2), np.linspace(-0.5, 0.5, views))

    def growth(self, side: int, view: IntArray) -> FloatArray:
        """Return how much larger (N,), relative, the focal lengths of a side are in views (N,)."""
        return np.asarray(self.value[side] * self.relative_time[view])


DRIFT_SPREAD = 5e-3  # standard deviation of what is known of a drift beforehand


def scale_focal_lengths(seen: ModelledPixels, camera: Camera, growth: FloatArray) -> ModelledPixels:
    """Return what a camera sees whose focal lengths are larger than its own, relative, by `growth` (N,)."""
    factor, centre = 1 + growth[:, None], camera.matrix[:2, 2]
    others = (seen.by_camera, seen.by_relative, seen.by_pose, seen.by_point)
    by_camera, *rest = (slope * factor[..., None] for slope in others)
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    return ModelledPixels(centre + (seen.pixel - centre) * factor, by_camera, *rest)


@dataclass(frozen=True, eq=False)
class Bundle:
    """All unknowns: the rig, the target's pose `left_from_target` in each view, its shape; a drift, or None."""

    rig: StereoRig
    poses: tuple[RigidTransform, ...]
    shape: TargetGeometry
    drift: FocalDrift | None = None

    def of_views(self, views: Sequence[int]) -> Bundle:
        """Return the bundle of some of the views."""
        drift = self.drift and replace(self.drift, relative_time=self.drift.relative_time[list(views)])
        return replace(self, poses=tuple(self.poses[view] for view in views), drift=drift)

    def with_step(self, step: FloatArray, pose_steps: FloatArray) -> Bundle:
        """Return the bundle after a step of rig, shape and drift (32 + S + D,) and of the poses (V, 6).

        To first order the step is added; beyond it the path follows what the pictures hold on to: the targets' middles
        move linearly in either picture and in the logarithm of their depth, focal lengths by factors. Long focal
        lengths trade depth for focal length, and the principal point for a turn, along a bent valley, in which
        straight steps would have to be tiny.
        """
        middle = self.shape.flat_m.mean(axis=0)
        growth = step[LEFT[:2]] / self.rig.left.parameters[:2]
        poses = step_poses(middle, self.poses, pose_steps, growth)
        before, after = (np.mean([pose.apply(middle) for pose in every], axis=0) for every in (self.poses, poses))
        turns = np.cross(pose_steps[:, 3:], [pose.rotation @ middle for pose in self.poses])
        shift = np.mean(pose_steps[:, :3] + turns, axis=0)
        rig = StereoRig(
            _camera_moved(self.rig.left, step[LEFT]),
            _camera_moved(self.rig.right, step[RIGHT]),
            self._relative_moved(step, before, after, shift),
        )
        ends = _RIG + len(self.shape.value_m)
        drift = self.drift and replace(self.drift, value=self.drift.value + step[ends:])
        return Bundle(rig, poses, self.shape.with_step(step[_RIG:ends]), drift)

    def _relative_moved(
        self, step: FloatArray, before: FloatArray, after: FloatArray, shift: FloatArray
    ) -> RigidTransform:
        """Return `right_from_left` after a step, the targets' common middle going from `before` to `after` on the left.

        `shift` (3,): its step there to first order.
        """
        relative, growth = self.rig.right_from_left, step[RIGHT[:2]] / self.rig.right.parameters[:2]
        turned = relative.rotation @ before
        change = np.cross(step[ROTATION], turned) + step[TRANSLATION] + relative.rotation @ shift
        place = _places_moved(turned + relative.translation_m, change, growth)
        rotation = rotation_from_vector(step[ROTATION]) @ relative.rotation
        return RigidTransform(rotation, place - rotation @ after)

    def model_pixels(self, image: ImageObservations) -> ModelledPixels:
        """Return where the picture's points are expected, with derivatives."""
        camera = self.rig.right if image.side else self.rig.left
        relative = self.rig.right_from_left if image.side else RigidTransform.identity()
        points = self.shape.points_m[image.point]
        seen = model_pixels(camera, relative, self.poses[image.view], points, image.radius_m)
        if self.drift is None:
            return seen
        return scale_focal_lengths(seen, camera, self.drift.growth(image.side, np.full(len(points), image.view)))


def step_poses(
    middle_m: FloatArray, poses: Sequence[RigidTransform], steps: FloatArray, growth: FloatArray
) -> tuple[RigidTransform, ...]:
    """Return a target's poses after steps (V, 6), its middle moving linearly in the picture and in logarithmic depth.

    `growth` (2,): steps of the focal lengths over their values.
    """
    rotation = np.stack([pose.rotation for pose in poses])
    turned, place = rotation @ middle_m, np.stack([pose.translation_m for pose in poses])
    place = _places_moved(turned + place, np.cross(steps[:, 3:], turned) + steps[:, :3], growth)
    rotation = rotation_from_vector(steps[:, 3:]) @ rotation
    return tuple(RigidTransform(*pose) for pose in zip(rotation, place - rotation @ middle_m, strict=True))


def _places_moved(place: FloatArray, step: FloatArray, growth: FloatArray) -> FloatArray:
    """Return places (..., 3) after steps (..., 3) that are linear in their picture and in the logarithm of their depth.

    `growth` (2,): steps of the focal lengths over their values, so that f·x/z, not x/z, goes straight.
    """
    depth, away = place[..., 2:], step[..., 2:]
    bearing = place[..., :2] / depth
    moved = bearing + (step[..., :2] - bearing * away) / depth + bearing * growth
    return np.concatenate([moved * np.exp(-growth), np.ones_like(depth)], axis=-1) * depth * np.exp(away / depth)


def _camera_moved(camera: Camera, step: FloatArray) -> Camera:
    """Return the camera after a step (13,), focal lengths by factors.

    Of a rational lens it is the radial factor at three radii, not k1, k2 and k3, that goes straight.
    """
    parameters = camera.parameters + step
    parameters[:2] = camera.parameters[:2] * np.exp(step[:2] / camera.parameters[:2])
    if parameters[9:12].any():
        corner2 = float((camera.size_px**2).sum()) / 4 / float(camera.parameters[:2].mean()) ** 2
        powers = (corner2 * _RADII2)[:, None] ** np.arange(1, 4)
        over, under = (1 + powers @ camera.parameters[places] for places in (_OVER, _UNDER))
        change = (powers @ step[_OVER] - over / under * (powers @ step[_UNDER])) / under
        after = (over / under + change) * (1 + powers @ parameters[_UNDER])
        parameters[_OVER] = np.linalg.solve(powers, after - 1)
    return Camera.from_parameters(parameters, camera.size_px)
