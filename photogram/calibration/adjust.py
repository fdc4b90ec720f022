"""Bundle adjustment of a stereo pair: cameras, relative pose, target poses and target shape in one least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photogram.arrays import FloatArray, IntArray
from photogram.calibration.model import Seen, Shape, see
from photogram.camera import RIG_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector

_RIG = len(RIG_PARAMETERS)
_STEPS = 100  # steps allowed; five to ten are the rule, more with long focal lengths and large residuals
_CONVERGED = 1e-3  # expected decrease of χ² that ends the iteration: parameters to 0.03 of their uncertainty
_IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Picture:
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
class Bundle:
    """All unknowns: the rig, the target's pose `left_from_target` in each view, and its shape."""

    rig: StereoRig
    poses: tuple[RigidTransform, ...]
    shape: Shape

    def moved(self, step: FloatArray, pose_steps: FloatArray) -> Bundle:
        """Return the bundle after a step of rig and shape (24 + S,) and of the poses (V, 6).

        To first order the step is added; beyond it the path follows what the pictures hold on to: the targets' middles
        move linearly in either picture and in the logarithm of their depth, focal lengths by factors. Long focal
        lengths trade depth for focal length, and the principal point for a turn, along a bent valley, in which
        straight steps would have to be tiny.
        """
        middle = self.shape.flat_m.mean(axis=0)
        growth = step[:2] / self.rig.left.parameters[:2]
        moves = zip(self.poses, pose_steps, strict=True)
        poses = tuple(moved_pose(middle, pose, change, growth) for pose, change in moves)
        before, after = (np.mean([pose.apply(middle) for pose in every], axis=0) for every in (self.poses, poses))
        turns = np.cross(pose_steps[:, 3:], [pose.rotation @ middle for pose in self.poses])
        shift = np.mean(pose_steps[:, :3] + turns, axis=0)
        rig = StereoRig(
            _camera_moved(self.rig.left, step[:9]),
            _camera_moved(self.rig.right, step[9:18]),
            self._relative_moved(step, before, after, shift),
        )
        return Bundle(rig, poses, self.shape.moved(step[_RIG:]))

    def _relative_moved(
        self, step: FloatArray, before: FloatArray, after: FloatArray, shift: FloatArray
    ) -> RigidTransform:
        """Return `right_from_left` after a step, the targets' common middle going from `before` to `after` on the left.

        `shift` (3,): its step there to first order.
        """
        relative, growth = self.rig.right_from_left, step[9:11] / self.rig.right.parameters[:2]
        turned = relative.rotation @ before
        change = np.cross(step[18:21], turned) + step[21:24] + relative.rotation @ shift
        place = _place_moved(turned + relative.translation_m, change, growth)
        rotation = rotation_from_vector(step[18:21]) @ relative.rotation
        return RigidTransform(rotation, place - rotation @ after)

    def see(self, picture: Picture) -> Seen:
        """Return where the picture's points are expected, with derivatives."""
        camera = self.rig.right if picture.side else self.rig.left
        relative = self.rig.right_from_left if picture.side else _IDENTITY
        points = self.shape.points_m[picture.point]
        return see(camera, relative, self.poses[picture.view], points, picture.radius_m)


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the rig before the pictures: expected parameters (24,) and standard deviations, inf for none.

    The three of the rotation are no parameters with a value, so they have no prior. `aspect_px` (left, right): standard
    deviation of fx − fy around zero.
    """

    value: FloatArray
    sigma: FloatArray
    aspect_px: tuple[float, float]

    def away(self, parameters: FloatArray) -> FloatArray:
        """Return how far (26,) parameters are from what is expected, in standard deviations."""
        aspect = (parameters[[0, 9]] - parameters[[1, 10]]) / self.aspect_px
        return np.concatenate([(parameters - self.value) / self.sigma, aspect])

    @property
    def slope(self) -> FloatArray:
        """The derivative (26, 24) of `away`."""
        aspect = np.zeros((2, _RIG))
        aspect[[0, 1], [0, 9]], aspect[[0, 1], [1, 10]] = 1 / np.array(self.aspect_px), -1 / np.array(self.aspect_px)
        return np.concatenate([np.diag(1 / self.sigma), aspect])


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The most likely bundle, the covariance of rig and shape (24 + S, 24 + S) and of each pose (V, 6, 6)."""

    bundle: Bundle
    covariance: FloatArray
    pose_covariance: FloatArray


def parameters_of(rig: StereoRig) -> FloatArray:
    """Return the values (24,) of the rig's parameters, zero for the rotation's."""
    translation = rig.right_from_left.translation_m
    return np.concatenate([rig.left.parameters, rig.right.parameters, np.zeros(3), translation])


def adjust(start: Bundle, pictures: Sequence[Picture], prior: Prior) -> Adjusted:
    """Return the bundle that minimises Σ rᵀ·C⁻¹·r over all points plus the priors' squares.

    Levenberg–Marquardt; the poses are eliminated view by view (Triggs et al. 2000, Bundle Adjustment, section 6.1).
    Raises `ValueError` when the sum of squares cannot be brought to a minimum.
    """
    bundle, damping, cost = start, 1e-3, _cost(start, pictures, prior)
    for _ in range(_STEPS):
        normal = _normal(bundle, pictures, prior)
        step, pose_steps, decrease = normal.step(damping)
        tried = bundle.moved(step, pose_steps)
        found = _cost(tried, pictures, prior)
        if found <= cost * (1 + 1e-12):
            bundle, cost, damping = tried, min(found, cost), max(damping / 10, 1e-12)
            if decrease < _CONVERGED:
                normal = _normal(bundle, pictures, prior)
                return Adjusted(bundle, *normal.covariance())
        else:
            damping = max(10 * damping, 1e-6)
    raise ValueError("the bundle adjustment did not converge; add views or leave out doubtful pictures")


def whitened_squares(bundle: Bundle, picture: Picture) -> tuple[FloatArray, FloatArray]:
    """Return residuals found − modelled (N, 2) and rᵀ·C⁻¹·r (N,) of one picture."""
    residual = picture.position_px - bundle.see(picture).pixel
    return residual, np.einsum("ni,nij,nj->n", residual, picture.precision, residual)


def moved_pose(middle_m: FloatArray, pose: RigidTransform, step: FloatArray, growth: FloatArray) -> RigidTransform:
    """Return a target's pose after a step (6,), its middle moving linearly in the picture and in logarithmic depth.

    `growth` (2,): steps of the focal lengths over their values.
    """
    turned = pose.rotation @ middle_m
    place = _place_moved(turned + pose.translation_m, np.cross(step[3:], turned) + step[:3], growth)
    rotation = rotation_from_vector(step[3:]) @ pose.rotation
    return RigidTransform(rotation, place - rotation @ middle_m)


def _place_moved(place: FloatArray, step: FloatArray, growth: FloatArray) -> FloatArray:
    """Return a place (3,) after a step (3,) that is linear in its picture and in the logarithm of its depth.

    `growth` (2,): steps of the focal lengths over their values, so that f·x/z, not x/z, goes straight.
    """
    depth, bearing = place[2], place[:2] / place[2]
    moved = bearing + (step[:2] - bearing * step[2]) / depth + bearing * growth
    return np.asarray(np.append(moved * np.exp(-growth), 1.0) * depth * np.exp(step[2] / depth))


def _camera_moved(camera: Camera, step: FloatArray) -> Camera:
    """Return the camera after a step (9,), focal lengths by factors."""
    parameters = camera.parameters + step
    parameters[:2] = camera.parameters[:2] * np.exp(step[:2] / camera.parameters[:2])
    return Camera.from_parameters(parameters, camera.size_px)


def _cost(bundle: Bundle, pictures: Sequence[Picture], prior: Prior) -> float:
    """Return the sum of squares; infinite when a point falls behind a camera."""
    squares = sum(float(whitened_squares(bundle, picture)[1].sum()) for picture in pictures)
    away = prior.away(parameters_of(bundle.rig))
    shape = bundle.shape.value_m / bundle.shape.prior_m
    total = squares + float(away @ away) + float(shape @ shape)
    return total if np.isfinite(total) else np.inf


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: rig and shape (G, G), each pose (V, 6, 6), what couples them (V, G, 6), right-hand sides."""

    common: FloatArray
    pose: FloatArray
    coupling: FloatArray
    common_side: FloatArray
    pose_side: FloatArray

    def step(self, damping: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the damped step of rig and shape, that of the poses, and the decrease that it promises."""
        raised = np.einsum("vii->vi", self.pose)[:, :, None] * np.eye(6)
        pose = self.pose + damping * raised
        common = self.common + damping * np.diag(np.diagonal(self.common))
        solved = np.linalg.solve(pose, self.pose_side[..., None])[..., 0]
        reduced, scale = self._reduced(common, pose)
        side = self.common_side - np.einsum("vgi,vi->g", self.coupling, solved)
        step = np.linalg.solve(reduced, side * scale) * scale
        back = np.linalg.solve(pose, np.einsum("vgi,g->vi", self.coupling, step)[..., None])[..., 0]
        pose_steps = solved - back
        return step, pose_steps, float(self.common_side @ step + (self.pose_side * pose_steps).sum())

    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """Return the covariances of rig and shape (G, G) and of each pose (V, 6, 6)."""
        reduced, scale = self._reduced(self.common, self.pose)
        common = np.linalg.inv(reduced) * np.outer(scale, scale)
        common = (common + common.T) / 2
        answer = np.linalg.solve(self.pose, self.coupling.transpose(0, 2, 1))
        pose = np.linalg.inv(self.pose) + answer @ common @ answer.transpose(0, 2, 1)
        return common, (pose + pose.transpose(0, 2, 1)) / 2

    def _reduced(self, common: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the Schur complement of the poses, scaled to a diagonal near one, and the scale (G,)."""
        turned = np.linalg.solve(pose, self.coupling.transpose(0, 2, 1))
        reduced = common - np.einsum("vgi,vih->gh", self.coupling, turned)
        scale = 1 / np.sqrt(np.diagonal(common))
        return reduced * np.outer(scale, scale), scale


def _normal(bundle: Bundle, pictures: Sequence[Picture], prior: Prior) -> _Normal:
    """Return the normal equations at the bundle."""
    shape = bundle.shape
    size, views = _RIG + len(shape.value_m), len(bundle.poses)
    common = np.diag(np.concatenate([np.zeros(_RIG), shape.prior_m**-2.0]))
    common[:_RIG, :_RIG] = prior.slope.T @ prior.slope
    common_side = np.concatenate(
        [-prior.slope.T @ prior.away(parameters_of(bundle.rig)), -shape.value_m / shape.prior_m**2]
    )
    pose, coupling, pose_side = np.zeros((views, 6, 6)), np.zeros((views, size, 6)), np.zeros((views, 6))
    for picture in pictures:
        seen, view = bundle.see(picture), picture.view
        slope = _common_slope(seen, picture, shape).reshape(-1, size)
        pose_slope = seen.by_pose.reshape(-1, 6)
        weighted = (picture.precision @ seen.by_pose).reshape(-1, 6)
        weighted_common = (picture.precision @ slope.reshape(-1, 2, size)).reshape(-1, size)
        residual = (picture.position_px - seen.pixel).ravel()
        common += slope.T @ weighted_common
        common_side += weighted_common.T @ residual
        pose[view] += pose_slope.T @ weighted
        coupling[view] += slope.T @ weighted
        pose_side[view] += weighted.T @ residual
    return _Normal(common, pose, coupling, common_side, pose_side)


def _common_slope(seen: Seen, picture: Picture, shape: Shape) -> FloatArray:
    """Return the derivatives (N, 2, 24 + S) of a picture's pixels by rig and shape."""
    return np.concatenate([seen.by_rig(picture.side), seen.by_point @ shape.basis[picture.point]], axis=-1)
