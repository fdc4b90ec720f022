"""Self-check of a stereo pair: residuals against OpenCV and analytic values, alarms where due and nowhere else."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from photogram.calibration.calibration_file import read_calibration
from photogram.camera import RIG_PARAMETERS, Camera, StereoRig, epipolar_residual
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.measure.epipolar import MOVED_PX, EpipolarCheck, check_epipolar
from photogram.measure.epipolar_notices import CAMERA_DRIFTS, CAMERA_MOVED, CAMERA_ROTATED, PAIR_CHANGED
from photogram.subsets.track import StereoTracks, Tracks
from shakercal._common.notices import Notice

SIZE = np.array([1280, 1024])
NOISE_PX = 0.01
FRAMES = 40


def _rig(u_px: float | None = 0.03) -> StereoRig:
    """Two cameras 0.15 m apart, converging on a point 0.8 m away; `u_px` scales the covariance, None leaves it out."""
    matrix = np.array([[3200.0, 0, 640], [0, 3210, 512], [0, 0, 1]])
    turn = rotation_from_vector(np.array([0.002, 0.186, -0.001]))
    centre = np.array([0.0, 0, 0.8])
    transform = RigidTransform(turn, centre - turn @ (centre + np.array([0.15, 0.001, 0.0])))
    camera = Camera(matrix, np.array([-0.08, 0.05, 1e-4, -2e-4, 0.0]), SIZE)
    if u_px is None:
        return StereoRig(camera, camera, transform)
    sigma = dict.fromkeys(RIG_PARAMETERS, 0.0)
    for side in ("left", "right"):
        sigma |= {f"{side}.fx": 20 * u_px, f"{side}.fy": 20 * u_px, f"{side}.cx": u_px, f"{side}.cy": u_px}
    sigma |= {f"rotation.{axis}": u_px / 3200 for axis in "xyz"} | {f"translation.{axis}": 1e-5 for axis in "xyz"}
    return StereoRig(camera, camera, transform, np.diag(np.array([sigma[name] for name in RIG_PARAMETERS]) ** 2))


ACROSS, DOWN = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.1, 0.1, 12), np.linspace(-0.08, 0.08, 9)))
POINTS_M = np.column_stack([ACROSS, DOWN, 0.8 + 0.2 * ACROSS])
"""A plane body in the left camera's frame."""


def _side(position: np.ndarray, rng: np.random.Generator, noise_px: float, registration_px: float) -> Tracks:
    """Tracks with the noise of their own frames, of the reference (from frame 1 on) and of the match across cameras."""
    noise = noise_px * rng.standard_normal(position.shape)
    noise[1:] -= noise[0]
    noise[0] = 0.0
    return _found(position + noise + registration_px * rng.standard_normal(position.shape[1:]), noise_px)


def _found(position: np.ndarray, noise_px: float) -> Tracks:
    frames, points = position.shape[:2]
    covariance = np.broadcast_to(noise_px**2 * np.eye(2), (frames, points, 2, 2))
    ones = np.ones((frames, points))
    return Tracks(position, covariance, ones, np.zeros((frames, points), dtype=np.int8), ones[0])


def _tracks(
    rigs: list[StereoRig],
    seed: int = 0,
    noise_px: float = NOISE_PX,
    points_m: np.ndarray = POINTS_M,
    moved_m: np.ndarray | None = None,
) -> StereoTracks:
    """What both cameras see of the body, the rig of every frame given; it swings where it is not moved (F, 3)."""
    rng, phase = np.random.default_rng(seed), 2 * np.pi * 0.137 * np.arange(len(rigs))
    if moved_m is None:
        moved_m = 1e-4 * np.column_stack([np.cos(phase), np.sin(phase), 0.3 * np.cos(phase)])
    seen = [rig.project(points_m + shift) for rig, shift in zip(rigs, moved_m, strict=True)]
    left, right = (np.array([frame[side] for frame in seen]) for side in (0, 1))
    sides = _side(left, rng, noise_px, 0.0), _side(right, rng, noise_px, 1.5 * noise_px)
    return StereoTracks((sides[0], sides[1]), (), np.full(2, 4.0), np.full(2, 5.0), np.full(2, 0.0))


def _turned(rig: StereoRig, axis: int, angle_rad: float) -> StereoRig:
    """The rig with its right camera turned about one of its own axes, its centre where it was."""
    turn = rotation_from_vector(angle_rad * np.eye(3)[axis])
    between = rig.right_from_left
    return replace(rig, right_from_left=RigidTransform(turn @ between.rotation, turn @ between.translation_m))


def _notice(check: EpipolarCheck) -> Notice:
    (notice,) = check.notices
    assert notice.severity == "warning"
    return notice


RIG = _rig()


def _checked(rigs: list[StereoRig], **options: Any) -> EpipolarCheck:
    """The check of the moving body, by the rig as calibrated, of what the rigs of every frame see."""
    return check_epipolar(_tracks(rigs, **options), RIG)


def test_residual_is_the_distance_from_opencvs_epipolar_line():
    rng = np.random.default_rng(3)
    left, right = RIG.project(rng.uniform([-0.1, -0.1, 0.7], [0.1, 0.1, 0.9], (50, 3)))
    right = right + rng.normal(0.0, 2.0, right.shape)
    ideal = [
        cv2.undistortPoints(pixel, camera.matrix, camera.distortion, P=camera.matrix).reshape(-1, 2)
        for pixel, camera in ((left, RIG.left), (right, RIG.right))
    ]
    lines = cv2.computeCorrespondEpilines(ideal[0].reshape(-1, 1, 2), 1, RIG.fundamental()).reshape(-1, 3)
    expected = (lines * np.column_stack([ideal[1], np.ones(50)])).sum(axis=1)
    found, _, _ = epipolar_residual(RIG, left, right)
    np.testing.assert_allclose(np.abs(found), np.abs(expected), atol=1e-4)


def test_derivatives_are_those_of_the_residual():
    rig = replace(_rig(None), left=replace(_rig().left, distortion=np.zeros(5)))
    rig = replace(rig, right=replace(rig.right, distortion=np.zeros(5)))
    left, right = rig.project(np.random.default_rng(1).uniform([-0.1, -0.1, 0.7], [0.1, 0.1, 0.9], (20, 3)))
    _, by_left, by_right = epipolar_residual(rig, left, right)
    for axis, step in enumerate(1e-3 * np.eye(2)):
        for by, a, b in ((by_left, step, 0.0), (by_right, 0.0, step)):
            numeric = epipolar_residual(rig, left + a, right + b)[0] - epipolar_residual(rig, left - a, right - b)[0]
            np.testing.assert_allclose(by[:, axis], numeric / 2e-3, atol=1e-6)


def test_residuals_of_frames_have_the_stated_noise():
    check = _checked([RIG] * 200)
    scatter = check.residual_trend_px[1:].std(axis=0, ddof=1)
    np.testing.assert_allclose(scatter, np.median(check.u_residual_trend_px, axis=0), rtol=0.15)
    assert check.notices == ()


def test_no_alarm_without_cause():
    """30 recordings, each with a rig drawn from the calibration's covariance: mean residuals of 0.05 px are normal."""
    sigma = np.sqrt(np.diagonal(RIG.covariance))
    squares, sizes = [], []
    for seed in range(30):
        true = RIG.perturbed(sigma * np.random.default_rng(1000 + seed).standard_normal(32))
        check = _checked([true] * 24, seed=seed)
        assert check.notices == ()
        squares.append(check.pattern_px @ np.linalg.solve(check.pattern_covariance, check.pattern_px))
        sizes.append(np.linalg.norm(check.pattern_px))
    assert np.mean(squares) == pytest.approx(3.0, abs=4 * np.sqrt(6 / 30))  # chi-square with 3 degrees of freedom
    assert np.median(sizes) > 0.03


@pytest.mark.parametrize(("axis", "name"), [(0, "about_x_mrad"), (2, "about_z_mrad")])
@pytest.mark.parametrize("angle_rad", [5e-4, -1e-3])
def test_a_rotated_camera_is_reported_with_its_angle(axis, name, angle_rad):
    notice = _notice(_checked([_turned(RIG, axis, angle_rad)] * FRAMES))
    assert notice.code == CAMERA_ROTATED.code
    assert 0.0 < notice.values["explained_px"] < 1.0
    assert notice.values[name] == pytest.approx(1e3 * angle_rad, abs=0.03)


def test_a_turn_across_the_plane_of_sight_and_a_few_millipixels_are_not_reported():
    """The turn shifts points along their epipolar lines, which nothing in the pictures reveals: no feature, a limit."""
    assert _checked([_turned(RIG, 1, 5e-4)] * FRAMES).notices == ()
    assert _checked([RIG] * 20 + [_turned(RIG, 0, 0.003 / 3200)] * 20, noise_px=1e-3).notices == ()


def test_without_a_covariance_a_tenth_of_a_pixel_is_trusted():
    rig = _rig(None)
    small = _tracks([_turned(rig, 0, 0.08 / 3200)] * FRAMES)
    large = _tracks([_turned(rig, 0, 0.12 / 3200)] * FRAMES)
    assert check_epipolar(small, rig).notices == ()
    assert check_epipolar(small, rig).pattern_covariance is None
    notice = _notice(check_epipolar(large, rig))
    assert notice.code == CAMERA_ROTATED.code
    assert notice.values["explained_px"] == 0.1


@pytest.mark.parametrize("u_px", [0.03, None])
def test_a_pair_beyond_any_calibration_error_is_rejected_and_a_smaller_error_is_a_warning(u_px):
    """16 px is another arrangement; 0.5 px, or 3 px of a calibration known to 1 px, is what a warning is for."""
    rig = _rig(u_px)
    apart = check_epipolar(_tracks([_turned(rig, 0, 16.0 / 3200)] * FRAMES), rig).rejection_reason
    size = float(re.findall(r"[\d.]+(?= px)", apart)[0])
    assert size == pytest.approx(16.0, abs=0.7)
    assert check_epipolar(_tracks([rig] * FRAMES), rig).rejection_reason == ""
    assert check_epipolar(_tracks([_turned(rig, 0, 0.5 / 3200)] * FRAMES), rig).rejection_reason == ""
    vague = _rig(1.0)
    assert check_epipolar(_tracks([_turned(vague, 0, 3.0 / 3200)] * FRAMES), vague).rejection_reason == ""


@pytest.mark.parametrize("frame", [2, 17, 38])
def test_a_jump_is_reported_with_its_frame_and_size(frame):
    moved = _turned(RIG, 0, 0.02 / 3200)
    notice = _notice(_checked([RIG] * frame + [moved] * (FRAMES - frame)))
    assert (notice.code, notice.values["frame"]) == (CAMERA_MOVED.code, frame)
    assert notice.values["change_px"] == pytest.approx(0.02, abs=0.005)


def test_a_turn_with_the_same_mean_is_found_by_its_slope_and_a_drift_is_distinguished():
    about = _turned(RIG, 2, 1e-4)
    check = _checked([RIG] * 20 + [about] * 20)
    step = check.residual_trend_px[20:].mean(axis=0) - check.residual_trend_px[:20].mean(axis=0)
    assert abs(step[1]) > MOVED_PX
    assert [notice.values["frame"] for notice in check.notices if notice.code == CAMERA_MOVED.code] == [20]
    rigs = [_turned(RIG, 0, 0.03 / 3200 * frame / FRAMES) for frame in range(FRAMES)]
    notice = _notice(_checked(rigs))
    assert notice.code == CAMERA_DRIFTS.code
    assert notice.values["change_px"] == pytest.approx(0.03, abs=0.005)


def test_a_body_that_goes_far_shows_the_lens_and_no_moving_camera():
    far = np.linspace(-0.04, 0.04, FRAMES)[:, None] * np.array([1.0, 0.3, 0.0])
    bent = np.zeros(24)
    bent[4], bent[13] = 0.007, -0.007  # k1 of both lenses: 0.1 px at the edge of the picture
    check = check_epipolar(_tracks([RIG.perturbed(bent)] * FRAMES, moved_m=far), _rig(None))
    assert np.ptp(check.residual_trend_px[:, 0]) > 2 * MOVED_PX
    assert check.notices == ()


def test_missing_points_and_outliers_do_not_disturb_and_too_few_give_no_result():
    tracks = _tracks([RIG] * FRAMES)
    position = tracks.right.position_px.copy()
    position[:, 3] += 1.5  # a wrong match, constant in time
    position[10:, 20:60] = np.nan
    position[25] = np.nan
    check = check_epipolar(replace(tracks, cameras=(tracks.left, replace(tracks.right, position_px=position))), RIG)
    assert check.notices == ()
    assert np.isnan(check.residual_px[3])
    assert np.isnan(check.residual_trend_px[25]).all()
    assert np.isfinite(np.delete(check.residual_trend_px, 25, axis=0)).all()
    few = check_epipolar(_tracks([RIG] * FRAMES, points_m=POINTS_M[:5]), RIG)
    assert few.notices == ()
    assert np.isnan(few.mean_px).all()


def test_a_real_pair_at_fifteen_places_of_a_stage(data_dir):
    """The published calibration has no uncertainties and is 0.12 px off; the cameras stood still meanwhile."""
    folder = data_dir / "duodic_rigid"
    points = np.load(folder / "matched_points.npz")
    left, right = (_found(points[side], 0.02) for side in ("left", "right"))
    tracks = StereoTracks((left, right), (), np.full(2, np.nan), np.full(2, np.nan), np.full(2, np.nan))
    (notice,) = check_epipolar(tracks, read_calibration(folder / "calibration.json")).notices
    assert notice.code == PAIR_CHANGED.code  # no turn explains it: the lenses are not described to the last
    assert notice.values["residual_px"] == pytest.approx(0.125, abs=5e-4)
