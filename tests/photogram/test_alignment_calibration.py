"""What a calibration's errors do to a pose: the derivatives by its parameters against errors that are known."""

from __future__ import annotations

import numpy as np
from alignment_factory import TARGET, World, displaced, make_world, target_pose

from photogram.alignment.evidence import KnownPoses
from photogram.alignment.seen import by_parameters, calibration_steps, seen_target
from photogram.alignment.solve import Alignment, align
from photogram.camera import StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from photogram.targets.view import TargetView

Views = tuple[TargetView, TargetView]
U_PLACE_M, U_ROTATION_RAD = 1e-6, 1e-5


def _aligned(rig: StereoRig, steps: np.ndarray, views: Views, placed: RigidTransform) -> Alignment:
    """Align by one view of the target at a known pose."""
    pose, covariance, effects = seen_target(rig, steps, TARGET, *views)
    known = np.diag([U_PLACE_M] * 3 + [U_ROTATION_RAD] * 3) ** 2
    evidence = KnownPoses(("view",), (pose,), covariance[None], (placed,), known[None], effects[:, None])
    return align([evidence])


def _seen(world: World, u_px: float) -> tuple[Views, RigidTransform]:
    """Views of the target at a pose, and that pose as it is stated."""
    placed = world.sensor_from_camera @ target_pose(world.rng, 0.3)
    turn = rotation_from_vector(U_ROTATION_RAD * world.rng.normal(size=3))
    shift = U_PLACE_M * world.rng.normal(size=3)
    return world.view(placed, u_px), RigidTransform(turn @ placed.rotation, placed.translation_m + shift)


def _between(start: RigidTransform, end: RigidTransform) -> np.ndarray:
    """The displacement (6,) that leads from one pose to another."""
    turn = end.rotation @ start.rotation.T
    return np.concatenate([end.translation_m - turn @ start.translation_m, vector_from_rotation(turn)])


def test_another_calibration_moves_the_pose_as_its_derivatives_say() -> None:
    world = make_world(3)
    steps = calibration_steps(world.rig)
    views, placed = _seen(world, 0.01)
    found = _aligned(world.rig, steps, views, placed)
    change = by_parameters(found.by_calibration, steps)
    assert np.allclose(change @ steps.T, found.by_calibration, rtol=1e-5, atol=1e-9)
    for _ in range(5):
        error = world.rng.normal(size=len(steps)) @ steps
        moved = _aligned(world.rig.perturbed(error), steps, views, placed).sensor_from_camera
        expected = displaced(found.sensor_from_camera, change @ error)
        size = np.abs(_between(found.sensor_from_camera, moved))
        assert (np.abs(_between(expected, moved)) < 0.02 * size.max()).all()


def test_a_pose_moved_with_the_true_calibration_scatters_as_with_an_exact_one() -> None:
    """Pooled over 80 rigs: 480 values, whose standard deviation is known to 3 % by chance."""
    whitened = []
    for seed in range(80):
        world = make_world(seed)
        steps = calibration_steps(world.rig)
        found = _aligned(world.rig, steps, *_seen(world, 0.01))
        turn = vector_from_rotation(world.true.right_from_left.rotation @ world.rig.right_from_left.rotation.T)
        shift = world.true.right_from_left.translation_m - world.rig.right_from_left.translation_m
        lens = [
            getattr(world.true, side).parameters - getattr(world.rig, side).parameters for side in ("left", "right")
        ]
        moved = by_parameters(found.by_calibration, steps) @ np.concatenate([*lens, turn, shift])
        error = _between(displaced(found.sensor_from_camera, moved), world.sensor_from_camera)
        u = np.sqrt(np.diagonal(found.held_covariance))
        root = np.linalg.cholesky(found.held_covariance / np.outer(u, u))
        whitened.append(np.linalg.solve(root, error / u))
        assert (u < 0.5 * found.u).any()
    assert 0.9 < np.sqrt(np.mean(np.square(whitened))) < 1.1
    assert np.abs(whitened).max() < 4.5
