"""The camera frame from points, faces and target poses: simulated rigs with every stated error drawn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from alignment_factory import BODY_M, TARGET, World, displaced, make_world, off, target_pose
from hypothesis import given, settings
from hypothesis import strategies as st

from photogram.alignment.evidence import Evidence, KnownFace, KnownPoints, KnownPoses, StatedFrame, across
from photogram.alignment.seen import calibration_steps, seen_points, seen_target
from photogram.alignment.solve import OpenPose, align
from photogram.calibration.start import target_pose as find_pose
from photogram.geometry import RigidTransform, rotation_from_vector, vector_from_rotation

U_PX = 0.02
CASES = 100


def points(world: World, count: int = 16, u_m: float = 5e-6, datum: StatedFrame | None = None) -> KnownPoints:
    """Fiducials on and around the body, measured to u."""
    rng, steps = world.rng, calibration_steps(world.rig)
    true = BODY_M + rng.uniform(-0.05, 0.05, (count, 3)) * np.array([1.0, 1.0, 0.4])
    seen = seen_points(world.rig, steps, *world.see(true, U_PX), U_PX)
    frame = StatedFrame("", np.zeros(6)) if datum is None else datum
    wrong = displaced(RigidTransform.identity(), frame.u * rng.normal(size=6))
    stated = wrong.apply(true) + u_m * rng.normal(size=true.shape)
    covariance = np.broadcast_to(u_m**2 * np.eye(3), (count, 3, 3))
    names = tuple(f"point {number}" for number in range(count))
    return KnownPoints(names, seen[0], seen[1], stated, covariance, seen[2], frame)


def faces(world: World) -> list[Evidence]:
    """Four faces of a body, turned towards the cameras, each known to 3 um and 0.05 mrad."""
    rng, steps, found = world.rng, calibration_steps(world.rig), list[Evidence]()
    towards = -world.sensor_from_camera.rotation[:, 2]
    sideways = across(towards)
    for number in range(4):
        angle = 0.3 + number * np.pi / 2
        normal = towards + 0.8 * np.array([np.cos(angle), np.sin(angle)]) @ sideways
        normal /= np.linalg.norm(normal)
        centre = BODY_M + 0.02 * normal
        true = centre + rng.uniform(-0.03, 0.03, (60, 2)) @ across(normal)
        seen = seen_points(world.rig, steps, *world.see(true, U_PX), U_PX)
        place = centre + 3e-6 * rng.normal() * normal
        found.append(KnownFace(f"face {number}", *seen[:2], place, off(normal, 5e-5, rng), seen[2], 3e-6, 5e-5))
    return found


def poses(world: World) -> list[Evidence]:
    """Two mountings of the target, each known to 10 um and 0.1 mrad, one of them pictured twice."""
    rng, steps, found = world.rng, calibration_steps(world.rig), list[Evidence]()
    u = np.array([1e-5] * 3 + [1e-4] * 3)
    for name, count in (("view a", 1), ("view b", 2)):
        true = world.sensor_from_camera @ target_pose(rng, 0.3)
        seen = [seen_target(world.rig, steps, TARGET, *world.view(true, U_PX)) for _ in range(count)]
        found.append(
            KnownPoses(
                (name,) * count,
                tuple(pose for pose, _, _ in seen),
                np.array([covariance for _, covariance, _ in seen]),
                (displaced_in_place(true, u * rng.normal(size=6)),) * count,
                np.zeros((count, 6, 6)),
                np.stack([effects for _, _, effects in seen], axis=1),
                {name: np.repeat(np.diag(u)[:, None], count, axis=1)},
            )
        )
    return found


def displaced_in_place(pose: RigidTransform, step: np.ndarray) -> RigidTransform:
    """A pose moved by a step, turned about the body's own origin."""
    return RigidTransform(rotation_from_vector(step[3:]) @ pose.rotation, pose.translation_m + step[:3])


def datum_points(world: World) -> list[Evidence]:
    """Fiducials of a body that is mounted on the sensor to 10 um and 0.1 mrad."""
    return [points(world, datum=StatedFrame("datum", np.array([1e-5] * 3 + [1e-4] * 3)))]


def other_pair(world: World) -> list[Evidence]:
    """Common views with a second pair, whose pose in the sensor frame is known to 10 um and 0.05 mrad."""
    other = make_world(int(world.rng.integers(1 << 30)))
    rng, steps = world.rng, calibration_steps(world.rig)
    truth = other.sensor_from_camera
    u = np.array([1e-5] * 3 + [5e-5] * 3)
    placed = displaced(truth, u * rng.normal(size=6))
    turn = np.kron(np.eye(2), placed.rotation)
    own, known = [], []
    for _ in range(3):
        held = world.sensor_from_camera @ target_pose(rng, 0.2)
        own.append(seen_target(world.rig, steps, TARGET, *world.view(held, U_PX)))
        try:
            known.append(seen_target(other.rig, steps, TARGET, *other.view(held, U_PX)))
        except (AssertionError, ValueError):
            own.pop()
    if not own:
        return other_pair(world)
    names = tuple(f"common view {number}" for number in range(len(own)))
    return [
        KnownPoses(
            names,
            tuple(pose for pose, _, _ in own),
            np.array([covariance for _, covariance, _ in own]),
            tuple(placed @ pose for pose, _, _ in known),
            np.array([turn @ covariance @ turn.T for _, covariance, _ in known]),
            np.stack([effects for _, _, effects in own], axis=1),
            {"calibration of the other": np.stack([effects @ turn.T for _, _, effects in known], axis=1)},
            StatedFrame("pose of the other", u),
        )
    ]


KINDS: dict[str, Callable[[World], list[Evidence]]] = {
    "points": lambda world: [points(world)],
    "points with datum": datum_points,
    "faces": faces,
    "target views": poses,
    "common views": other_pair,
    "points and target views": lambda world: [points(world, 4), *poses(world)],
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(KINDS))
def test_a_hundred_rigs_are_covered_by_their_uncertainty(kind: str) -> None:
    errors, normalised, whitened = [], [], []
    for seed in range(CASES):
        world = make_world(seed)
        found = align(KINDS[kind](world))
        error, white = world.error(found)
        errors.append(error)
        normalised.append(error / found.u)
        whitened.append(white)
    assert 0.9 < np.std(whitened) < 1.1
    assert np.abs(normalised).max() < 4.5
    turns = np.linalg.norm(np.array(errors)[:, 3:], axis=1)
    assert np.quantile(turns, 0.5) < 2e-4
    if kind != "common views":
        assert np.sqrt(np.mean(np.array(errors)[:, 3:] ** 2)) < 1.3e-4


def test_without_errors_the_pose_is_exact() -> None:
    world = make_world(3)
    seen = world.sensor_from_camera.inverse()
    true = BODY_M + np.random.default_rng(0).uniform(-0.05, 0.05, (5, 3))
    noise = np.broadcast_to(1e-10 * np.eye(3), (5, 3, 3))
    found = align([KnownPoints(tuple("abcde"), seen.apply(true), noise, true, noise, np.zeros((0, 5, 3)))])
    np.testing.assert_allclose(found.sensor_from_camera.pose, world.sensor_from_camera.pose, atol=1e-12)
    assert found.chi2 < 1e-9
    assert (found.dof, found.enlargement, found.notices) == (9, 1.0, ())


def test_effects_on_a_target_pose_are_those_of_the_perturbed_rig() -> None:
    world = make_world(4)
    steps = calibration_steps(world.rig)
    views = world.view(world.sensor_from_camera @ target_pose(world.rng, 0.3), U_PX)
    pose, _, effects = seen_target(world.rig, steps, TARGET, *views)
    for step, effect in zip(steps, effects, strict=True):
        other, _ = find_pose(world.rig.perturbed(step), TARGET, *views)
        turn = vector_from_rotation(other.rotation @ pose.rotation.T)
        change = np.concatenate([other.translation_m - pose.translation_m, turn])
        np.testing.assert_allclose(effect, change, rtol=1e-2, atol=2e-8)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6))
def test_another_sensor_frame_moves_the_pose_and_turns_its_covariance(seed: int, moved: list[float]) -> None:
    world = make_world(5)
    known = points(world)
    other_from_sensor = RigidTransform.from_pose(np.array(moved))
    moved_points = KnownPoints(
        known.names,
        known.camera_m,
        known.camera_covariance_m2,
        other_from_sensor.apply(known.sensor_m),
        known.sensor_covariance_m2,
        known.calibration,
    )
    first, second = align([known]), align([moved_points])
    expected = other_from_sensor @ first.sensor_from_camera
    np.testing.assert_allclose(second.sensor_from_camera.pose, expected.pose, atol=1e-9)
    # A displacement D about the old origin is T·D·T⁻¹ about the new one: the adjoint of the change of frame.
    adjoint = np.kron(np.eye(2), other_from_sensor.rotation)
    t = other_from_sensor.translation_m
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    adjoint[:3, 3:] = cross @ other_from_sensor.rotation
    expected_covariance = adjoint @ first.covariance @ adjoint.T
    scale = np.sqrt(np.diagonal(expected_covariance))
    np.testing.assert_allclose(
        second.covariance / np.outer(scale, scale), expected_covariance / np.outer(scale, scale), atol=1e-6
    )
    assert second.chi2 == pytest.approx(first.chi2, rel=1e-6)


def test_two_points_leave_the_turn_about_their_line_open() -> None:
    world = make_world(6)
    known = points(world, 3)
    first = KnownPoints(
        known.names[:2],
        known.camera_m[:2],
        known.camera_covariance_m2[:2],
        known.sensor_m[:2],
        known.sensor_covariance_m2[:2],
        known.calibration[:, :2],
    )
    with pytest.raises(OpenPose, match=r"^rotation about .* is open: add three points or faces"):
        align([first], world.sensor_from_camera)
    with pytest.raises(ValueError, match="expected a first pose"):
        align([first])


def test_parallel_faces_leave_three_components_open() -> None:
    world = make_world(7)
    first = faces(world)[0]
    assert isinstance(first, KnownFace)
    along = rotation_from_vector(np.cross(first.normal, [0.0, 0, 1])) @ first.normal
    assert np.isfinite(along).all()
    with pytest.raises(OpenPose) as caught:
        align([first], world.sensor_from_camera)
    assert [name.split()[0] for name in caught.value.components] == ["rotation", "position"]


def test_one_wrong_point_is_named_and_enlarges_the_uncertainty() -> None:
    world = make_world(8)
    known = points(world)
    wrong = known.sensor_m.copy()
    wrong[5, 0] += 300e-6
    spoiled = KnownPoints(
        known.names, known.camera_m, known.camera_covariance_m2, wrong, known.sensor_covariance_m2, known.calibration
    )
    good, bad = align([known]), align([spoiled])
    assert good.notices == ()
    assert bad.enlargement > 3
    (notice,) = bad.notices
    assert notice.where == "point 5"
    assert "point 5 fits least" in notice.text
    assert (bad.u > 2 * good.u).all()


def test_a_face_stated_at_the_wrong_height_is_named() -> None:
    world = make_world(9)
    known = [points(world), *faces(world)]
    wrong = known[2]
    assert isinstance(wrong, KnownFace)
    known[2] = KnownFace(
        wrong.name,
        wrong.camera_m,
        wrong.camera_covariance_m2,
        wrong.point_m + 2e-4 * wrong.normal,
        wrong.normal,
        wrong.calibration,
        wrong.u_offset_m,
        wrong.u_normal_rad,
    )
    assert align(known).notices[0].where == "face 1"


def test_a_calibration_taken_for_exact_is_less_uncertain() -> None:
    found = align([points(make_world(10))])
    difference = found.covariance - found.held_covariance
    assert np.linalg.eigvalsh(difference).min() > -1e-9 * np.trace(difference)
    assert np.trace(difference) > 0


def test_wrong_calls_say_what_was_expected() -> None:
    with pytest.raises(ValueError, match="u: expected an array of shape"):
        StatedFrame("datum", np.zeros(3))
    with pytest.raises(ValueError, match="normal: expected a unit vector"):
        KnownFace("f", np.zeros((3, 3)), np.zeros((3, 3, 3)), np.zeros(3), np.ones(3), np.zeros((0, 3, 3)))
    camera = np.array([[0.0, 0, 1], [np.nan, 0, 1]])
    with pytest.raises(ValueError, match="expected finite points, found none for b"):
        KnownPoints(("a", "b"), camera, np.zeros((2, 3, 3)), camera, np.zeros((2, 3, 3)), np.zeros((0, 2, 3)))
