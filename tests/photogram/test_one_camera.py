"""A camera alone before a face that is known: places by projection, motion by rendering, against exact truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from speckle import SENSOR, camera, face, sequence, two_poses

from photogram.calibration.calibration_file import read_camera, write_calibration
from photogram.camera import FaceCamera, StereoRig, locate
from photogram.geometry import RigidTransform
from photogram.measure.body import measure_body
from photogram.motion import fit_motion
from photogram.subsets.icgn import TrackSettings
from photogram.synthetic.scene import motion_bound, render, view_of

LENS = camera((100, 80), (-0.09, 0.1, 1e-4, -1e-4, 0))
AWAY = two_poses(0.35)[0]
RIG = FaceCamera(LENS, AWAY.apply(np.zeros(3)), AWAY.rotation[:, 2])
POINTS = np.stack(np.meshgrid(np.linspace(-0.014, 0.014, 12), np.linspace(-0.011, 0.011, 9), [0.0]), -1).reshape(-1, 3)
MOTION = np.array([2e-5, -3e-5, 1.5e-4, 2e-3, -3e-3, 4e-3])


def seen(pose: np.ndarray) -> np.ndarray:
    """Where the camera sees the points of the body, (1, N, 2)."""
    return LENS.project(AWAY.apply(RigidTransform.from_pose(pose).apply(POINTS)))[None]


def test_points_lie_on_the_face_where_their_rays_meet_it_at_rest_and_moved():
    body = AWAY.inverse()
    at_rest = locate(RIG, [seen(np.zeros(6))]).transformed(body)
    np.testing.assert_allclose(at_rest.position_m[0], POINTS, atol=1e-12)
    in_camera = AWAY @ RigidTransform.from_pose(MOTION) @ body
    moved = locate(RIG, [seen(MOTION)], None, in_camera.pose[None]).transformed(body)
    np.testing.assert_allclose(moved.position_m[0], RigidTransform.from_pose(MOTION).apply(POINTS), atol=1e-12)
    gone = seen(np.zeros(6))
    gone[0, 3] = np.nan
    assert np.isnan(locate(RIG, [gone]).covariance_m2[0, 3]).all()


def test_a_fit_of_the_points_takes_the_distances_of_rays_and_states_its_scatter():
    """Points found on the face at rest lie up to 0.15 mm beside the moved body: only across the rays that counts."""
    rng, rest = np.random.default_rng(1), locate(RIG, [seen(np.zeros(6))]).transformed(AWAY.inverse()).position_m[0]
    noise = np.broadcast_to(0.01**2 * np.eye(2), (1, len(POINTS), 2, 2))
    errors = []
    for draw in range(40):
        pixels = seen(MOTION) + (0.01 * rng.standard_normal((1, len(POINTS), 2)) if draw else 0.0)
        fit = fit_motion(locate(RIG, [pixels], [noise]).transformed(AWAY.inverse()), rest, np.zeros(3))
        errors.append((fit.pose[0] - MOTION) / np.sqrt(np.diagonal(fit.covariance[0])))
    assert np.abs(errors[0]).max() < 0.05
    np.testing.assert_allclose(np.std(errors[1:], axis=0), 1.0, atol=0.4)


def test_the_motion_of_a_rendered_body_by_one_camera_has_the_stated_errors():
    rng, body, view = np.random.default_rng(3), face((0.015, 0.012), 1), view_of(LENS, AWAY)
    time = np.arange(16)
    poses = 0.1 * MOTION * np.cos(2 * np.pi * 0.137 * time[:, None] + np.arange(6))
    poses[0] = 0.0
    pictures = [SENSOR.digitise(render(view, body, pose[None], np.ones(1)), rng) for pose in poses]
    found = measure_body((sequence(pictures),), RIG, AWAY.inverse(), TrackSettings())
    error = (found.motion.pose - poses)[1:]
    error -= error.mean(axis=0)  # the reference's noise is in all frames
    u = np.sqrt(np.diagonal(found.motion.covariance[1:], axis1=1, axis2=2))
    assert 0.7 < np.sqrt(np.mean((error / u) ** 2)) < 1.25
    bound = np.sqrt(np.diagonal(motion_bound([view], body, SENSOR)))
    assert (u.mean(axis=0) < 1.6 * bound).all()
    assert u[:, 2].mean() > 2.0 * u[:, :2].mean()  # along the view it sees less
    assert found.notices == ()
    assert np.isnan(found.reprojection_px)
    further = FaceCamera(LENS, 1.01 * RIG.point_m, RIG.normal)  # a distance off by 1 % is a scale off by 1 %
    place = RigidTransform(AWAY.rotation, 1.01 * AWAY.translation_m)
    longer = measure_body((sequence(pictures),), further, place.inverse(), TrackSettings())
    np.testing.assert_allclose(longer.motion.pose[1:, :3], 1.01 * found.motion.pose[1:, :3], rtol=1e-3, atol=2e-8)


def test_errors_of_the_face_are_its_position_along_the_normal_and_two_tilts():
    step = np.zeros(16)
    step[13:] = 1e-3, 2e-3, -1e-3
    other = RIG.perturbed(step)
    np.testing.assert_allclose((other.point_m - RIG.point_m) @ RIG.normal, 1e-3, rtol=1e-12)
    angle = np.arccos(min(1.0, float(other.normal @ RIG.normal)))
    assert angle == pytest.approx(np.hypot(2e-3, 1e-3), rel=1e-5)
    step[:] = 0.0
    step[0] = 15.0
    assert RIG.perturbed(step).camera.parameters[0] == LENS.parameters[0] + 15.0


def test_the_file_of_a_pair_gives_its_left_camera(tmp_path):
    covariance = np.diag(np.arange(1.0, 33.0))
    right = replace(LENS, distortion=np.zeros(5))
    rig = StereoRig(LENS, right, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])), covariance)
    write_calibration(tmp_path / "top.json", rig)
    one, own = read_camera(tmp_path / "top.json")
    np.testing.assert_array_equal(one.parameters, LENS.parameters)
    np.testing.assert_array_equal(np.diagonal(own), [*range(1, 10), 25, 26, 27, 28])
