"""Simulated rigs whose pose in the sensor frame is known, and what their cameras see with all errors drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from photogram.alignment.alignment_evidence import (
    KnownAxis,
    KnownDirection,
    calibration_steps,
    perpendicular_directions,
)
from photogram.alignment.pose_estimation import Alignment, fit_axis, linear_motion
from photogram.camera import ROTATION, Camera, StereoRig, triangulate
from photogram.geometry import RigidTransform, nearest_rotation, rotation_from_vector, vector_from_rotation
from photogram.motion import RigidMotion
from photogram.synthetic.scene import session_covariance
from photogram.targets.target_view import Target, TargetView
from shakercal._common.arrays import ComplexArray, FloatArray

SIZE_PX = np.array([1280, 1024])
WORKING_M = 0.45
BODY_M = np.array([0.0, 0.0, 0.07])
TARGET = Target("chessboard", 8e-3, (9, 6))
INDEX = np.array([(i, j) for j in range(6) for i in range(9)])


@cache
def calibrated_rig() -> StereoRig:
    """Return a rig with the covariance that 30 views of a dot target leave, and a target known to 3e-5."""
    size = SIZE_PX
    left = Camera(
        np.array([[3200, 0, 640.0], [0, 3190, 512], [0, 0, 1]]), np.array([-0.2, 0.4, 1e-3, -2e-3, 0.0]), size
    )
    right = Camera(np.array([[3250, 0, 650.0], [0, 3245, 500], [0, 0, 1]]), np.array([-0.1, 0.2, -1e-3, 1e-3, 0]), size)
    centre, turn = np.array([0.15, 0.004, 0.03]), rotation_from_vector(np.array([0.01, 0.34, -0.005]))
    rig = StereoRig(left, right, RigidTransform(turn, -turn @ centre))
    middle = np.array([0.0, 0.0, WORKING_M])
    covariance = session_covariance(rig, middle, 0.16, 0.01, 30, np.random.default_rng(5))
    scale = np.concatenate([np.zeros(21), rig.right_from_left.translation_m * 3e-5])
    return replace(rig, covariance=covariance + np.outer(scale, scale))


def displaced(pose: RigidTransform, step: FloatArray) -> RigidTransform:
    """Return the pose after a displacement (6,), shift and rotation about its own frame's origin, from the left."""
    turn = rotation_from_vector(step[3:])
    return RigidTransform(turn @ pose.rotation, turn @ pose.translation_m + step[:3])


def between(start: RigidTransform, end: RigidTransform) -> FloatArray:
    """Return the displacement (6,) that leads from one pose to another."""
    turn = end.rotation @ start.rotation.T
    return np.concatenate([end.translation_m - turn @ start.translation_m, vector_from_rotation(turn)])


def rig_error(rig: StereoRig, truth: StereoRig) -> FloatArray:
    """Return the errors (32,) of a rig's parameters."""
    error = rig.values - truth.values
    error[ROTATION] = vector_from_rotation(rig.right_from_left.rotation @ truth.right_from_left.rotation.T)
    return error


def target_pose(rng: np.random.Generator, tilt: float) -> RigidTransform:
    """Return a pose of the target in view of both cameras."""
    turn = rotation_from_vector(rng.uniform(-tilt, tilt, 3))
    centre = np.array([*rng.uniform(-0.02, 0.02, 2), WORKING_M + rng.uniform(-0.03, 0.03)])
    return RigidTransform(turn, centre - turn @ np.array([0.032, 0.020, 0.0]))


@dataclass(frozen=True, eq=False)
class World:
    """One rig: as stated (`rig`), as it is (`true`), and where its left camera really is."""

    rig: StereoRig
    true: StereoRig
    sensor_from_camera: RigidTransform
    rng: np.random.Generator

    def see(self, points_m: FloatArray, u_px: float) -> tuple[FloatArray, FloatArray]:
        """Return left and right pixels (N, 2), with noise, of points (N, 3) in the sensor frame."""
        left, right = self.true.project(self.sensor_from_camera.inverse().apply(points_m))
        assert np.isfinite(left).all()
        return left + u_px * self.rng.normal(size=left.shape), right + u_px * self.rng.normal(size=right.shape)

    def view(self, sensor_from_target: RigidTransform, u_px: float) -> tuple[TargetView, TargetView]:
        """Return left and right view of the target at a pose."""
        lattice = np.column_stack([TARGET.spacing_m * INDEX, np.zeros(54)])
        left, right = self.see(sensor_from_target.apply(lattice), u_px)
        rest = (np.broadcast_to(u_px**2 * np.eye(2), (54, 2, 2)), 0.0, 0.7, SIZE_PX)
        return TargetView("l", INDEX, left, *rest), TargetView("r", INDEX, right, *rest)

    def error(self, found: Alignment) -> tuple[FloatArray, FloatArray]:
        """Return the displacement (6,) from the pose found to the true one, and it in independent units of its u."""
        error = between(found.sensor_from_camera, self.sensor_from_camera)
        scale = found.u
        root = np.linalg.cholesky(found.covariance / np.outer(scale, scale))
        return error, np.linalg.solve(root, error / scale)


def make_world(seed: int) -> World:
    """Return a rig that looks at the body from somewhere above, its calibration's errors drawn."""
    rng = np.random.default_rng([seed, 99])
    rig = calibrated_rig()
    assert rig.covariance is not None
    covariance = rig.covariance[:24, :24]  # of a pair without k4 k5 k6 and skew
    scale = np.sqrt(np.diagonal(covariance))
    draw = scale * (np.linalg.cholesky(covariance / np.outer(scale, scale)) @ rng.normal(size=24))
    view = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-3, 3)])) @ rotation_from_vector(
        np.array([np.pi + rng.uniform(-0.5, 0.5), 0.0, 0.0])
    )
    aimed = np.array([0.0, 0.0, WORKING_M]) + rng.uniform(-0.005, 0.005, 3)
    return World(rig, rig.perturbed(draw), RigidTransform(view, BODY_M - view @ aimed), rng)


def face(world: World, angle_rad: float, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centre and normal of a face of the body that is turned towards the cameras, and points (N, 3) on it."""
    towards = -world.sensor_from_camera.rotation[:, 2]
    normal = towards + 0.8 * np.array([np.cos(angle_rad), np.sin(angle_rad)]) @ perpendicular_directions(towards)
    normal /= np.linalg.norm(normal)
    centre = BODY_M + 0.02 * normal
    return centre, normal, centre + world.rng.uniform(-0.03, 0.03, (count, 2)) @ perpendicular_directions(normal)


NOISE = np.diag([1e-7] * 3 + [1e-6] * 3) ** 2
"""Covariance (6, 6) of a frame's pose about a point near the body."""


def watch(world: World, moves: list[RigidTransform]) -> tuple[RigidMotion, list[FloatArray], FloatArray]:
    """Return what the cameras see of a body that makes these motions (sensor frame) from its place at rest.

    The motion about a point near the sensor origin, in camera axes, with noise of every frame and of the first; the
    poses (F, 6) without noise of the rig as stated and of each of its steps; the point (3,).
    """
    rng, count = world.rng, len(moves)
    body = BODY_M + rng.uniform(-0.04, 0.04, (12, 3)) * np.array([1.0, 1.0, 0.3])
    to_camera = world.sensor_from_camera.inverse()
    left, right = world.true.project(to_camera.apply(np.stack([move.apply(body) for move in moves])))
    assert np.isfinite(left).all()
    point = to_camera.translation_m + 1e-3 * rng.normal(size=3)

    def seen(rig: StereoRig) -> FloatArray:
        placed = triangulate(rig, left, right).position_m - point
        mean = placed.mean(axis=1, keepdims=True)
        turn = nearest_rotation(np.swapaxes(placed - mean, 1, 2) @ (placed[0] - mean[0]))
        shift = mean[:, 0] - (turn @ mean[0, 0][:, None])[..., 0]
        return np.concatenate([shift, vector_from_rotation(turn)], axis=1)

    nominal = seen(world.rig)
    root = np.linalg.cholesky(NOISE)
    noisy = [displaced(RigidTransform.from_pose(pose), root @ rng.normal(size=6)) for pose in nominal]
    first = displaced(RigidTransform.identity(), root @ rng.normal(size=6))
    pose = np.array([(frame @ first).pose for frame in noisy])
    noise = np.broadcast_to(NOISE, (count, 6, 6))
    motion = RigidMotion(pose, noise, np.zeros(count), np.full(count, 12), np.zeros(3))
    return motion, [nominal, *(seen(world.rig.perturbed(step)) for step in calibration_steps(world.rig))], point


def phasor_of(pose: FloatArray, time_s: FloatArray, frequency_hz: float) -> ComplexArray:
    """Return the displacement phasors (6,) of poses (F, 6) at one line, by linear least squares."""
    turn = 2 * np.pi * frequency_hz * time_s
    design = np.column_stack([np.cos(turn), np.sin(turn), np.ones(len(turn))])
    cosine, sine, _ = np.linalg.lstsq(design, pose, rcond=None)[0]
    return np.asarray(cosine - 1j * sine)


def off(direction: FloatArray, u_rad: float, rng: np.random.Generator) -> FloatArray:
    """Return a direction as somebody states it who is wrong by about u in either direction across it."""
    stated = direction + u_rad * rng.normal(size=2) @ perpendicular_directions(direction)
    return np.asarray(stated / np.linalg.norm(stated))


def shaken(world: World, direction: FloatArray, u_rad: float, name: str) -> KnownDirection:
    """Return the evidence of a body that is shaken along a direction, 285 um at 106.25 Hz, and rocks a little."""
    rng, frequency = world.rng, 106.25
    time_s = np.arange(100) / 52.874
    phase = rng.uniform(-3, 3, 4)
    rock = 0.02 * 285e-6 * rng.normal(size=3)
    turn = 2 * np.pi * frequency * time_s
    moves = np.column_stack(
        [285e-6 * np.cos(turn + phase[0])[:, None] * direction, np.cos(turn[:, None] + phase[1:]) * rock]
    )
    motion, exact, point = watch(world, [RigidTransform.from_pose(move) for move in moves])
    nominal, *others = (phasor_of(pose, time_s, frequency) for pose in exact)
    effects = np.array([other - nominal for other in others])
    covariance = np.kron(np.eye(2), NOISE) * 2 / len(time_s)
    moved, covariance, changes, _ = linear_motion(phasor_of(motion.pose, time_s, frequency), covariance, effects)
    stated = off(direction, u_rad, rng)
    return KnownDirection(name, moved[None], covariance[None], point[None], stated, changes[:, None], u_rad)


def turned(
    world: World, point_m: FloatArray, direction: FloatArray, u: tuple[float, float], reach_rad: float, name: str
) -> KnownAxis:
    """Return the evidence of a body that turns about an axis, known to u (m, rad), in 40 frames up to an angle."""
    angles = np.concatenate([[0.0], world.rng.uniform(-reach_rad, reach_rad, 39)])
    turns = rotation_from_vector(angles[:, None] * direction)
    motion, exact, seen_about = watch(world, [RigidTransform(turn, point_m - turn @ point_m) for turn in turns])
    axis = fit_axis(motion)
    nominal, *others = (fit_axis(replace(motion, pose=pose)).line for pose in exact)

    def alike(line: FloatArray) -> FloatArray:
        return line * np.repeat([1.0, np.sign(line[3:] @ axis.line[3:])], 3)

    effects = np.array([alike(other) - alike(nominal) for other in others])
    stated = off(direction, u[1], world.rng)
    place = point_m + u[0] * world.rng.normal(size=3)
    line = axis.line + np.concatenate([seen_about, np.zeros(3)])
    return KnownAxis(name, line[None], axis.covariance[None], place, stated, effects[:, None], np.full(3, u[0]), u[1])
