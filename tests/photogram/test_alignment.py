"""The camera frame from points, faces and target poses: simulated rigs with every stated error drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from alignment_factory import (
    BODY_M,
    NOISE,
    TARGET,
    World,
    between,
    displaced,
    face,
    make_world,
    off,
    rig_error,
    shaken,
    target_pose,
    turned,
)
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from photogram.alignment.alignment_evidence import (
    SENSOR_FRAME,
    KnownFace,
    KnownPixels,
    KnownPoints,
    KnownPoses,
    PoseEvidence,
    StatedFrame,
    calibration_steps,
    measure_target_pose,
    parameter_derivatives,
    perpendicular_directions,
    triangulate_points,
)
from photogram.alignment.pose_estimation import Alignment, UndeterminedPose, align, fit_axis, linear_motion
from photogram.calibration.calibration_notices import CONTRADICTORY_EVIDENCE
from photogram.calibration.initial_bundle import estimate_target_pose as find_pose
from photogram.camera import LEFT, StereoRig
from photogram.geometry import RigidTransform, displacement_jacobian, rotation_from_vector, skew, vector_from_rotation
from photogram.motion import RigidMotion
from photogram.targets.target_view import TargetView

U_PX = 0.02


def fiducials(world: World, count: int) -> np.ndarray:
    """Places on and around the body."""
    return BODY_M + world.rng.uniform(-0.05, 0.05, (count, 3)) * np.array([1.0, 1.0, 0.4])


def measured(world: World, true: np.ndarray, u_m: float, frame: StatedFrame) -> np.ndarray:
    """Where places are measured to be."""
    wrong = displaced(RigidTransform.identity(), frame.u * world.rng.normal(size=6))
    return wrong.apply(true) + u_m * world.rng.normal(size=true.shape)


def points(world: World, count: int = 16, u_m: float = 5e-6, frame: StatedFrame = SENSOR_FRAME) -> KnownPoints:
    """Fiducials seen by both cameras, measured to u."""
    true = fiducials(world, count)
    seen = triangulate_points(world.rig, calibration_steps(world.rig), *world.see(true, U_PX), U_PX)
    stated = measured(world, true, u_m, frame)
    covariance = np.broadcast_to(u_m**2 * np.eye(3), (count, 3, 3))
    names = tuple(f"point {number}" for number in range(count))
    return KnownPoints(names, seen[0], seen[1], stated, covariance, seen[2], frame)


def pixels(world: World, count: int = 16, u_m: float = 5e-6, frame: StatedFrame = SENSOR_FRAME) -> KnownPixels:
    """Fiducials seen by the left camera alone, measured to u."""
    true = fiducials(world, count)
    seen_px, stated = world.see(true, U_PX)[0], measured(world, true, u_m, frame)
    noise, spread = U_PX**2 * np.eye(2), u_m**2 * np.eye(3)
    return KnownPixels(
        tuple(f"point {number}" for number in range(count)),
        world.rig.left,
        seen_px,
        np.broadcast_to(noise, (count, 2, 2)),
        stated,
        np.broadcast_to(spread, (count, 3, 3)),
        calibration_steps(world.rig)[:, LEFT],
        frame,
    )


def faces(world: World) -> list[PoseEvidence]:
    """Four faces of a body, turned towards the cameras, each known to 3 um and 0.05 mrad."""
    rng, steps, evidence = world.rng, calibration_steps(world.rig), list[PoseEvidence]()
    for number in range(4):
        centre, normal, true = face(world, 0.3 + number * np.pi / 2, 60)
        seen = triangulate_points(world.rig, steps, *world.see(true, U_PX), U_PX)
        place = centre + 3e-6 * rng.normal() * normal
        evidence.append(KnownFace(f"face {number}", *seen[:2], place, off(normal, 5e-5, rng), seen[2], 3e-6, 5e-5))
    return evidence


def poses(world: World) -> list[PoseEvidence]:
    """Two mountings of the target, each known to 10 um and 0.1 mrad, one of them pictured twice."""
    rng, steps, evidence = world.rng, calibration_steps(world.rig), list[PoseEvidence]()
    u = np.array([1e-5] * 3 + [1e-4] * 3)
    for name, count in (("view a", 1), ("view b", 2)):
        true = world.sensor_from_camera @ target_pose(rng, 0.3)
        stated = displaced_pose(true.rotation, true.translation_m, u * rng.normal(size=6))
        views = [measure_target_pose(world.rig, steps, TARGET, *world.view(true, U_PX)) for _ in range(count)]
        seen, covariances, effects = zip(*views, strict=True)
        common = {name: np.repeat(np.diag(u)[:, None], count, axis=1)}
        known = (stated,) * count, np.zeros((count, 6, 6)), np.stack(effects, axis=1), common
        evidence.append(KnownPoses((name,) * count, seen, np.array(covariances), *known))
    return evidence


def displaced_pose(turn: np.ndarray, shift: np.ndarray, step: np.ndarray) -> RigidTransform:
    """A pose moved by a step (6,), turned about the body's own origin."""
    return RigidTransform(rotation_from_vector(step[3:]) @ turn, shift + step[:3])


def other_pair(world: World) -> list[PoseEvidence]:
    """Common views with a second pair, whose pose in the sensor frame is known to 10 um and 0.05 mrad."""
    other = make_world(int(world.rng.integers(1 << 30)))
    rng, steps = world.rng, calibration_steps(world.rig)
    u = np.array([1e-5] * 3 + [5e-5] * 3)
    placed = displaced(other.sensor_from_camera, u * rng.normal(size=6))
    turn, frame = np.kron(np.eye(2), placed.rotation), StatedFrame("pose of the other", u)
    evidence = list[PoseEvidence]()
    for number in range(3):
        held = world.sensor_from_camera @ target_pose(rng, 0.2)
        pose, covariance, effects = measure_target_pose(world.rig, steps, TARGET, *world.view(held, U_PX))
        try:
            theirs, spread, their_effects = measure_target_pose(other.rig, steps, TARGET, *other.view(held, U_PX))
        except (AssertionError, ValueError):
            continue  # not in their view
        common = {"calibration of the other": (their_effects @ turn.T)[:, None]}
        known = (placed @ theirs,), (turn @ spread @ turn.T)[None], effects[:, None], common, frame
        evidence.append(KnownPoses((f"common view {number}",), (pose,), covariance[None], *known))
    return evidence or other_pair(world)


DATUM = StatedFrame("datum", np.repeat([1e-5, 1e-4], 3))
KINDS: dict[str, Callable[[World], list[PoseEvidence]]] = {
    "points": lambda world: [points(world)],
    "points with datum": lambda world: [points(world, frame=DATUM)],
    "one camera": lambda world: [pixels(world)],
    "one camera with datum": lambda world: [pixels(world, frame=DATUM)],
    "faces": faces,
    "target views": poses,
    "common views": other_pair,
    "points and target views": lambda world: [points(world, 4), *poses(world)],
}


def test_without_errors_the_pose_is_exact():
    world = make_world(3)
    seen = world.sensor_from_camera.inverse()
    true = BODY_M + np.random.default_rng(0).uniform(-0.05, 0.05, (5, 3))
    noise = np.broadcast_to(1e-10 * np.eye(3), (5, 3, 3))
    found = align([KnownPoints(tuple("abcde"), seen.apply(true), noise, true, noise, np.zeros((0, 5, 3)))])
    np.testing.assert_allclose(found.sensor_from_camera.pose, world.sensor_from_camera.pose, atol=1e-12)
    assert found.chi2 < 1e-9
    assert (found.dof, found.enlargement, found.notices) == (9, 1.0, ())


def test_one_camera_finds_its_pose_from_four_points_and_names_one_that_is_mixed_up():
    world = make_world(8)
    found = align([pixels(world, 4)])
    assert np.abs(world.error(found)[0] / found.u).max() < 4.5
    with pytest.raises(ValueError, match=r"^start: "):
        align([pixels(world, 3)])
    seen = pixels(world, 12)
    on_a_line = BODY_M + np.linspace(-0.04, 0.04, 12)[:, None] * np.array([1.0, 0.0, 0.0])
    for place in (on_a_line, np.tile(BODY_M, (12, 1))):
        with pytest.raises(ValueError, match=r"^start: "):
            align([replace(seen, sensor_m=place, pixel_px=world.see(place, U_PX)[0])])
    place = seen.sensor_m.copy()
    place[5] += [2e-4, 0.0, 0.0]
    enlarged = align([replace(seen, sensor_m=place)])
    assert enlarged.enlargement > 1.0
    assert enlarged.notices[0].code == CONTRADICTORY_EVIDENCE.code
    assert enlarged.notices[0].values["piece"] == "point 5"


def test_effects_on_a_target_pose_are_those_of_the_perturbed_rig():
    world = make_world(4)
    steps = calibration_steps(world.rig)
    views = world.view(world.sensor_from_camera @ target_pose(world.rng, 0.3), U_PX)
    pose, _, effects = measure_target_pose(world.rig, steps, TARGET, *views)
    for step, effect in zip(steps, effects, strict=True):
        other, _ = find_pose(world.rig.perturbed(step), TARGET, *views)
        turn = vector_from_rotation(other.rotation @ pose.rotation.T)
        change = np.concatenate([other.translation_m - pose.translation_m, turn])
        np.testing.assert_allclose(effect, change, rtol=1e-2, atol=2e-8)


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 1000), st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6))
def test_another_sensor_frame_moves_the_pose_and_turns_its_covariance(seed, moved):
    world = make_world(5)
    known = points(world)
    other_from_sensor = RigidTransform.from_pose(np.array(moved))
    first, second = align([known]), align([replace(known, sensor_m=other_from_sensor.apply(known.sensor_m))])
    expected = other_from_sensor @ first.sensor_from_camera
    np.testing.assert_allclose(second.sensor_from_camera.pose, expected.pose, atol=1e-9)
    # A displacement D about the old origin is T·D·T⁻¹ about the new one: the adjoint of the change of frame.
    adjoint = np.kron(np.eye(2), other_from_sensor.rotation)
    adjoint[:3, 3:] = skew(other_from_sensor.translation_m) @ other_from_sensor.rotation
    expected_covariance = adjoint @ first.covariance @ adjoint.T
    scale = np.sqrt(np.diagonal(expected_covariance))
    np.testing.assert_allclose(
        second.covariance / np.outer(scale, scale), expected_covariance / np.outer(scale, scale), atol=1e-6
    )
    assert second.chi2 == pytest.approx(first.chi2, rel=1e-6)


def test_two_points_leave_the_turn_about_their_line_open_and_a_face_three_components():
    world = make_world(6)
    known = points(world, 3)
    points_of = (known.camera_m, known.camera_covariance_m2, known.sensor_m, known.sensor_covariance_m2)
    first = KnownPoints(known.names[:2], *(array[:2] for array in points_of), known.calibration_effects[:, :2])
    with pytest.raises(UndeterminedPose, match=r"^rotation "):
        align([first], world.sensor_from_camera)
    refused("^start: ", align, [first])

    with pytest.raises(UndeterminedPose) as caught:
        align(faces(world)[:1], world.sensor_from_camera)
    assert [name.split()[0] for name in caught.value.components] == ["rotation", "position"]


def test_a_wrong_point_or_face_is_named_and_enlarges_the_uncertainty():
    world = make_world(8)
    known = points(world)
    wrong = known.sensor_m.copy()
    wrong[5, 0] += 300e-6
    good, bad = align([known]), align([replace(known, sensor_m=wrong)])
    assert good.notices == ()
    by_calibration = good.covariance - good.conditional_covariance
    assert np.linalg.eigvalsh(by_calibration).min() > -1e-9 * np.trace(by_calibration)
    assert np.trace(by_calibration) > 0
    assert bad.enlargement > 3
    (notice,) = bad.notices
    assert notice.where == "point 5"
    assert notice.code == CONTRADICTORY_EVIDENCE.code
    assert notice.values["enlargement"] == pytest.approx(bad.enlargement)
    assert (bad.u > 2 * good.u).all()

    lifted = faces(world)
    lifted[1] = replace(lifted[1], point_m=lifted[1].point_m + 2e-4 * lifted[1].normal)
    assert align([known, *lifted]).notices[0].where == "face 1"


def test_wrong_calls_say_what_was_expected():
    refused("^u: ", StatedFrame, "datum", np.zeros(3))
    with pytest.raises(ValueError, match=r"^normal: "):
        KnownFace("f", np.zeros((3, 3)), np.zeros((3, 3, 3)), np.zeros(3), np.ones(3), np.zeros((0, 3, 3)))
    camera = np.array([[0.0, 0, 1], [np.nan, 0, 1]])
    with pytest.raises(ValueError, match=r"^camera_m: .* b$"):
        KnownPoints(("a", "b"), camera, np.zeros((2, 3, 3)), camera, np.zeros((2, 3, 3)), np.zeros((0, 2, 3)))


# The camera frame from motion: simulated rigs, directions of excitation and rotation axes.

X, Y, Z = np.eye(3)
U_DIRECTION = 5e-5


def near(world: World) -> RigidTransform:
    """A provisional pose, 10 mm and 0.1 rad off."""
    return displaced(world.sensor_from_camera, world.rng.normal(size=6) * np.repeat([1e-2, 1e-1], 3))


def directions(world: World) -> list[PoseEvidence]:
    return [shaken(world, Z, U_DIRECTION, "along z"), shaken(world, X, U_DIRECTION, "along x")]


def axes(world: World) -> list[PoseEvidence]:
    places = {"about x": (np.array([0.0, 0, 0.03]), X), "about y": (np.array([0.01, 0, 0.05]), Y)}
    return [turned(world, *place, (1e-5, U_DIRECTION), 0.06, name) for name, place in places.items()]


def everything(world: World) -> list[PoseEvidence]:
    return [*directions(world), *axes(world)]


def rough(world: World) -> KnownPoses:
    """A pose known before, wrong by what it states."""
    u = np.repeat([1e-3, 5e-3], 3)
    stated = displaced(world.sensor_from_camera, -u * world.rng.normal(size=6))
    moved = np.eye(6)
    moved[:3] = displacement_jacobian(stated.translation_m)
    covariance = (moved @ np.diag(u**2) @ moved.T)[None]
    own = (RigidTransform.identity(),)
    return KnownPoses(("before",), own, np.zeros((1, 6, 6)), (stated,), covariance, np.zeros((0, 1, 6)))


MOTION_KINDS: dict[str, Callable[[World], list[PoseEvidence]]] = {
    "all": everything,
    "axes": axes,
    "directions, and a position known before": lambda world: [*directions(world), rough(world)],
}


@pytest.mark.parametrize(
    ("kind", "cases"),
    [
        *((kind, 2) for kind in (*KINDS, *MOTION_KINDS)),
        *(pytest.param(kind, 60, marks=pytest.mark.slow) for kind in KINDS),
        *(pytest.param(kind, 20, marks=pytest.mark.slow) for kind in MOTION_KINDS),  # up to 0.6 s each
    ],
)
def test_rigs_are_covered_by_their_uncertainty(kind, cases):
    """Errors of rigs with every stated error drawn, against their stated uncertainty."""
    errors, normalised, whitened = [], [], []
    for seed in range(cases):
        world = make_world(seed)
        start = near(world) if kind in MOTION_KINDS else None
        found = align({**KINDS, **MOTION_KINDS}[kind](world), start)
        error, white = world.error(found)
        errors.append(np.linalg.norm(error[3:]))
        normalised.append(error / found.u)
        whitened.append(white)
    few = cases == 2
    assert abs(np.std(whitened) - 1.0) < 4 / np.sqrt(2 * 6 * cases)
    assert np.abs(normalised).max() < 4.5
    turns = np.array(errors)
    if kind.startswith("one camera"):  # whose principal point, known to 1.5 px of 3200, is a turn
        assert np.sqrt(np.mean(turns**2) / 3) < 6e-4
        return
    assert np.quantile(turns, 0.5 if kind in KINDS or few else 0.9) < 2e-4
    if kind in KINDS and kind != "common views" and not few:
        assert np.sqrt(np.mean(turns**2) / 3) < 1.3e-4


def test_each_motion_leaves_open_what_it_cannot_say_and_needs_a_first_pose():
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
        with pytest.raises(UndeterminedPose) as caught:
            align(evidence, truth)
        assert caught.value.components == tuple(components.split("|"))
        assert ("direction" in str(caught.value)) == ("rotation" in components)
    assert align([about_x, about_y], truth).u[:3].max() < 1e-4
    refused("^start: ", align, [along_z, along_x, about_x, about_y])


def test_a_direction_that_is_wrong_is_named():
    world = make_world(3)
    evidence = everything(world)
    elsewhere = shaken(world, rotation_from_vector(np.array([0, 0, 4e-3])) @ X, U_DIRECTION, "along x")
    evidence[1] = replace(elsewhere, direction=X)
    found = align(evidence, near(world))
    assert found.notices[0].where == "along x"
    assert found.enlargement > 2


def test_the_major_axis_of_an_ellipse_is_the_motion():
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
    noisy = [displaced_pose(turn, point - turn @ point, root @ rng.normal(size=6)) @ first for turn in turns]
    covariance = np.broadcast_to(NOISE, (frames, 6, 6))
    pose = np.array([frame.pose for frame in noisy])
    return RigidMotion(pose, covariance, np.zeros(frames), np.full(frames, 9), np.zeros(3)), point, direction


@pytest.mark.slow
@pytest.mark.parametrize("reach_rad", [2e-3, 0.08])
def test_an_axis_is_covered_by_its_covariance(reach_rad):
    rng = np.random.default_rng(1)
    whitened, reduced = [], []
    for _ in range(150):
        motion, point, direction = spun(rng, reach_rad, 20)
        axis = fit_axis(motion)
        true = np.concatenate([point, direction * np.sign(direction @ axis.line[3:])])
        rows = np.kron(np.eye(2), perpendicular_directions(direction))
        root = np.linalg.cholesky(rows @ axis.covariance @ rows.T)
        whitened.append(np.linalg.solve(root, rows @ (axis.line - true)))
        reduced.append(axis.chi2 / axis.dof)
    assert 0.9 < np.std(whitened) < 1.06
    assert np.mean(reduced) == pytest.approx(1.0, abs=0.06)


def test_an_axis_agrees_with_a_general_optimiser_at_any_angle():
    rng = np.random.default_rng(4)
    motion, point, direction = spun(rng, 2.5, 30)
    axis = fit_axis(motion)
    assert abs(axis.line[3:] @ direction) == pytest.approx(1.0, abs=1e-10)
    turns = rotation_from_vector(motion.pose[:, 3:])

    def misfit(unknown: np.ndarray) -> np.ndarray:
        return ((turns @ unknown + motion.pose[:, :3] - unknown) @ perpendicular_directions(axis.line[3:]).T).ravel()

    free = least_squares(misfit, np.zeros(3)).x
    np.testing.assert_allclose(perpendicular_directions(direction) @ (axis.line[:3] - free), 0, atol=2e-6)
    np.testing.assert_allclose(perpendicular_directions(direction) @ (axis.line[:3] - point), 0, atol=2e-6)


def test_a_wobbling_axis_is_less_certain_and_a_body_at_rest_has_none():
    rng = np.random.default_rng(5)
    steady, _, _ = spun(rng, 0.05, 40)
    wobbling = replace(steady, pose=steady.pose + 3e-6 * rng.normal(size=steady.pose.shape))
    first, second = fit_axis(steady), fit_axis(wobbling)
    assert second.chi2 / second.dof > 4
    assert np.trace(second.covariance) > 4 * np.trace(first.covariance)
    motion, _, _ = spun(rng, 1e-9, 20)
    refused("^motion: .* rad", fit_axis, motion)
    refused("^motion: .* 3 frames.* 0$", fit_axis, replace(motion, pose=np.full((20, 6), np.nan)))


# What a calibration's errors do to a pose: the derivatives by its parameters against errors that are known.

Views = tuple[TargetView, TargetView]
U_PLACE_M, U_ROTATION_RAD = 1e-6, 1e-5


def _aligned(rig: StereoRig, steps: np.ndarray, views: Views, placed: RigidTransform) -> Alignment:
    """Align by one view of the target at a known pose."""
    pose, covariance, effects = measure_target_pose(rig, steps, TARGET, *views)
    known = np.diag([U_PLACE_M] * 3 + [U_ROTATION_RAD] * 3) ** 2
    evidence = KnownPoses(("view",), (pose,), covariance[None], (placed,), known[None], effects[:, None])
    return align([evidence])


def _seen(world: World, u_px: float) -> tuple[Views, RigidTransform]:
    """Views of the target at a pose, and that pose as it is stated."""
    placed = world.sensor_from_camera @ target_pose(world.rng, 0.3)
    step = np.repeat([U_PLACE_M, U_ROTATION_RAD], 3) * world.rng.normal(size=6)
    return world.view(placed, u_px), displaced_pose(placed.rotation, placed.translation_m, step)


def test_another_calibration_moves_the_pose_as_its_derivatives_say():
    world = make_world(3)
    steps = calibration_steps(world.rig)
    views, placed = _seen(world, 0.01)
    found = _aligned(world.rig, steps, views, placed)
    change = parameter_derivatives(found.by_calibration, steps)
    assert np.allclose(change @ steps.T, found.by_calibration, rtol=1e-5, atol=1e-9)
    for _ in range(5):
        error = world.rng.normal(size=len(steps)) @ steps
        moved = _aligned(world.rig.perturbed(error), steps, views, placed).sensor_from_camera
        expected = displaced(found.sensor_from_camera, change @ error)
        size = np.abs(between(found.sensor_from_camera, moved))
        assert (np.abs(between(expected, moved)) < 0.02 * size.max()).all()


@pytest.mark.slow
def test_a_pose_moved_with_the_true_calibration_scatters_as_with_an_exact_one():
    whitened = []
    for seed in range(80):
        world = make_world(seed)
        steps = calibration_steps(world.rig)
        found = _aligned(world.rig, steps, *_seen(world, 0.01))
        moved = parameter_derivatives(found.by_calibration, steps) @ rig_error(world.true, world.rig)
        error = between(displaced(found.sensor_from_camera, moved), world.sensor_from_camera)
        u = np.sqrt(np.diagonal(found.conditional_covariance))
        root = np.linalg.cholesky(found.conditional_covariance / np.outer(u, u))
        whitened.append(np.linalg.solve(root, error / u))
        assert (u < 0.5 * found.u).any()
    assert 0.9 < np.sqrt(np.mean(np.square(whitened))) < 1.1
    assert np.abs(whitened).max() < 4.5
