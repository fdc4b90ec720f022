"""The camera frame from motion: simulated rigs, directions of excitation and rotation axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from alignment_factory import NOISE, World, displaced, make_world, shaken, turned
from scipy.optimize import least_squares

from photogram.alignment.evidence import Evidence, KnownPoses, across, displacement_jacobian
from photogram.alignment.seen import fit_axis, linear_motion
from photogram.alignment.solve import OpenPose, align
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.motion import RigidMotion

X, Y, Z = np.eye(3)
U_DIRECTION = 5e-5
U_POINT = 1e-5
CASES = 100


def near(world: World) -> RigidTransform:
    """A provisional pose, 10 mm and 0.1 rad off."""
    return displaced(world.sensor_from_camera, world.rng.normal(size=6) * np.repeat([1e-2, 1e-1], 3))


def directions(world: World) -> list[Evidence]:
    """Two directions of excitation."""
    return [shaken(world, Z, U_DIRECTION, "along z"), shaken(world, X, U_DIRECTION, "along x")]


def axes(world: World) -> list[Evidence]:
    """Two axes."""
    known = (U_POINT, U_DIRECTION)
    return [
        turned(world, np.array([0.0, 0, 0.03]), X, known, 0.06, "about x"),
        turned(world, np.array([0.01, 0, 0.05]), Y, known, 0.06, "about y"),
    ]


def everything(world: World) -> list[Evidence]:
    """Two directions of excitation and two axes."""
    return [*directions(world), *axes(world)]


def rough(world: World, u: np.ndarray) -> KnownPoses:
    """A pose known before, wrong by what it states."""
    stated = displaced(world.sensor_from_camera, -u * world.rng.normal(size=6))
    moved = np.eye(6)
    moved[:3] = displacement_jacobian(stated.translation_m)
    covariance = (moved @ np.diag(u**2) @ moved.T)[None]
    own = (RigidTransform.identity(),)
    return KnownPoses(("before",), own, np.zeros((1, 6, 6)), (stated,), covariance, np.zeros((0, 1, 6)))


KINDS: dict[str, Callable[[World], list[Evidence]]] = {
    "all": everything,
    "axes": axes,
    "directions, and a position known before": lambda world: [
        *directions(world),
        rough(world, np.array([1e-3] * 3 + [5e-3] * 3)),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(KINDS))
def test_a_hundred_rigs_are_covered_by_their_uncertainty(kind: str) -> None:
    errors, normalised, whitened = [], [], []
    for seed in range(CASES):
        world = make_world(seed)
        found = align(KINDS[kind](world), near(world))
        error, white = world.error(found)
        errors.append(error)
        normalised.append(error / found.u)
        whitened.append(white)
    assert 0.9 < np.std(whitened) < 1.1
    assert np.abs(normalised).max() < 4.5
    assert np.quantile(np.linalg.norm(np.array(errors)[:, 3:], axis=1), 0.9) < 2e-4


def test_each_motion_leaves_open_what_it_cannot_say() -> None:
    world = make_world(2)
    along_z, along_x, about_x, about_y = everything(world)
    truth = world.sensor_from_camera
    expected = {
        "rotation about z|position along x, y and z": [along_z],
        "position along x, y and z": [along_z, along_x],
        "rotation about x|position along x": [about_x],
        "position along x": [along_z, about_x],
    }
    for components, evidence in expected.items():
        with pytest.raises(OpenPose) as caught:
            align(evidence, truth)
        assert caught.value.components == tuple(components.split("|"))
        assert ("a motion in another direction" in str(caught.value)) == ("rotation" in components)
    assert align([about_x, about_y], truth).u[:3].max() < 1e-4


def test_motion_alone_does_not_start_the_search() -> None:
    with pytest.raises(ValueError, match="start: expected a first pose"):
        align(everything(make_world(2)))


def test_a_direction_that_is_wrong_is_named() -> None:
    world = make_world(3)
    evidence = everything(world)
    elsewhere = shaken(world, rotation_from_vector(np.array([0, 0, 4e-3])) @ X, U_DIRECTION, "along x")
    evidence[1] = replace(elsewhere, direction=X)
    found = align(evidence, near(world))
    assert found.notices[0].where == "along x"
    assert found.enlargement > 2


def test_the_major_axis_of_an_ellipse_is_the_motion() -> None:
    direction, minor = np.array([0.6, 0.0, 0.8]), np.array([0.8, 0.0, -0.6])
    phasor = np.concatenate([(2e-4 * direction + 3e-7j * minor) * np.exp(0.7j), np.zeros(3)])
    covariance = np.kron(np.eye(2), np.diag([1e-16] * 3 + [1e-14] * 3))
    motion, spread, effects, ellipse = linear_motion(phasor, covariance, np.zeros((2, 6), dtype=np.complex128))
    np.testing.assert_allclose(np.abs(motion[:3]), 2e-4 * np.abs(direction), atol=1e-12)
    np.testing.assert_allclose(spread, covariance[:6, :6], atol=1e-22)
    assert effects.shape == (2, 6)
    assert ellipse == pytest.approx(1.5e-3)


def spun(rng: np.random.Generator, reach_rad: float, frames: int) -> tuple[RigidMotion, np.ndarray, np.ndarray]:
    """A body turning about a random axis, in noisy frames against a noisy first one; the axis' point and direction."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    point = 0.1 * rng.normal(size=3) @ (np.eye(3) - np.outer(direction, direction))
    turns = rotation_from_vector(rng.uniform(-0.8, 1, frames)[:, None] * reach_rad * direction)
    root = np.linalg.cholesky(NOISE)
    first = displaced(RigidTransform.identity(), root @ rng.normal(size=6))
    noisy = [displaced_pose(turn, point, root @ rng.normal(size=6)) @ first for turn in turns]
    covariance = np.broadcast_to(NOISE, (frames, 6, 6))
    pose = np.array([frame.pose for frame in noisy])
    return RigidMotion(pose, covariance, np.zeros(frames), np.full(frames, 9), np.zeros(3)), point, direction


def displaced_pose(turn: np.ndarray, point: np.ndarray, step: np.ndarray) -> RigidTransform:
    """The pose of a frame, with noise of its translation and its rotation."""
    return RigidTransform(rotation_from_vector(step[3:]) @ turn, point - turn @ point + step[:3])


@pytest.mark.parametrize("reach_rad", [2e-3, 0.08])
def test_an_axis_is_covered_by_its_covariance(reach_rad: float) -> None:
    rng = np.random.default_rng(1)
    whitened, reduced = [], []
    for _ in range(150):
        motion, point, direction = spun(rng, reach_rad, 20)
        axis = fit_axis(motion)
        true = np.concatenate([point, direction * np.sign(direction @ axis.line[3:])])
        rows = np.kron(np.eye(2), across(direction))
        root = np.linalg.cholesky(rows @ axis.covariance @ rows.T)
        whitened.append(np.linalg.solve(root, rows @ (axis.line - true)))
        reduced.append(axis.chi2 / axis.dof)
    assert 0.9 < np.std(whitened) < 1.06
    assert np.mean(reduced) == pytest.approx(1.0, abs=0.06)


def test_an_axis_agrees_with_a_general_optimiser_at_any_angle() -> None:
    rng = np.random.default_rng(4)
    motion, point, direction = spun(rng, 2.5, 30)
    axis = fit_axis(motion)
    assert abs(axis.line[3:] @ direction) == pytest.approx(1.0, abs=1e-10)
    turns = rotation_from_vector(motion.pose[:, 3:])

    def misfit(unknown: np.ndarray) -> np.ndarray:
        return ((turns @ unknown + motion.pose[:, :3] - unknown) @ across(axis.line[3:]).T).ravel()

    free = least_squares(misfit, np.zeros(3)).x
    np.testing.assert_allclose(across(direction) @ (axis.line[:3] - free), 0, atol=2e-6)
    np.testing.assert_allclose(across(direction) @ (axis.line[:3] - point), 0, atol=2e-6)


def test_a_wobbling_axis_is_less_certain() -> None:
    rng = np.random.default_rng(5)
    steady, _, _ = spun(rng, 0.05, 40)
    wobbling = replace(steady, pose=steady.pose + 3e-6 * rng.normal(size=steady.pose.shape))
    first, second = fit_axis(steady), fit_axis(wobbling)
    assert second.chi2 / second.dof > 4
    assert np.trace(second.covariance) > 4 * np.trace(first.covariance)


def test_a_body_at_rest_has_no_axis() -> None:
    motion, _, _ = spun(np.random.default_rng(6), 1e-9, 20)
    with pytest.raises(ValueError, match="expected a body that turns"):
        fit_axis(motion)
    with pytest.raises(ValueError, match="expected at least 3 frames"):
        fit_axis(replace(motion, pose=np.full((20, 6), np.nan)))
