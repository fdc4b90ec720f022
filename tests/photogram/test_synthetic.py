"""The renderer against the camera model, closed forms and its own statistics; no part of the tracker is used."""

from __future__ import annotations

import numpy as np
import pytest
from board_images import SPACING_M, camera_of, charuco, chessboard, pose_of
from contracts import refused

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.board import random_poses, random_rig, render_board
from photogram.synthetic.patterns import Board
from photogram.synthetic.scene import (
    Face,
    ImageSensor,
    Texture,
    View,
    motion_bound,
    render,
    render_exposure,
    session_covariance,
    speckle_texture,
    texture_from_samples,
    view_of,
)
from photogram.targets.target_view import Target

PIXEL_M = 0.2e-3
DOWN = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 0.3]))  # a pixel sees PIXEL_M
FOCAL_PX = 1500.0
CAMERA = Camera.from_parameters(
    np.array([FOCAL_PX, FOCAL_PX * 1.001, 61.0, 46.5, -0.3, 0.4, 1e-3, -2e-3, 0.0]), np.array([128, 96])
)
POSE = RigidTransform.from_pose(np.array([0.001, -0.002, 0.30, np.pi - 0.3, 0.05, 0.02]))
SQUARE = Camera.from_parameters(np.array([FOCAL_PX, FOCAL_PX, 31, 31, 0, 0, 0, 0, 0]), np.array([64, 64]))
IDEAL = view_of(SQUARE, DOWN, falloff=0.0)


def _wave(length_m: float) -> Texture:
    """Stripes across u, from 0 to 1."""
    u = np.arange(-400, 401) * PIXEL_M / 8
    return texture_from_samples(np.tile(0.5 + 0.5 * np.cos(2 * np.pi * u / length_m), (801, 1)), PIXEL_M / 8)


def _face(texture: Texture, half: tuple[float, float] = (0.05, 0.05), round_: bool = False) -> Face:
    return Face(np.zeros(3), np.eye(3)[0], np.eye(3)[1], np.array(half), round_, texture, 0.6 * PIXEL_M)


def _gaussian_dot(centre: tuple[float, float], sigma_m: float) -> Texture:
    step = PIXEL_M / 4
    axis = np.arange(-300, 301) * step
    x, y = np.meshgrid(axis, axis)
    dot = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * sigma_m**2))
    return texture_from_samples(dot, step)


def _still(view: View, face: Face, pose: np.ndarray | None = None) -> np.ndarray:
    return render(view, face, np.zeros((1, 6)) if pose is None else pose[None], np.ones(1))


@pytest.mark.parametrize("pose", [np.zeros(6), np.array([4e-4, -3e-4, 6e-4, 0.01, -0.02, 0.03])])
def test_a_dot_appears_where_the_camera_projects_it(pose):
    centre = (2.1e-3, -1.3e-3)
    image = _still(view_of(CAMERA, POSE, falloff=0.0), _face(_gaussian_dot(centre, 2 * PIXEL_M)), pose)
    weight = np.clip(image - 0.1601, 0, None)
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    found = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
    expected = CAMERA.project(POSE.apply(RigidTransform.from_pose(pose).apply(np.array([*centre, 0.0]))))
    # The projected centre of a dot of finite size is not the centroid of its image; perspective gives some 0.01 px.
    np.testing.assert_allclose(found, expected, atol=0.012)


def test_pixels_follow_the_texture_through_an_ideal_camera():
    wave = 9.3 * PIXEL_M
    image = _still(IDEAL, _face(_wave(wave)))
    x = (np.arange(64) - 31.0) * PIXEL_M
    aperture = np.sinc(PIXEL_M / wave)
    expected = 0.16 + 0.64 * (0.5 + 0.5 * aperture * np.cos(2 * np.pi * x / wave))
    # Two Gauss points instead of the whole aperture: 1e-5 of the amplitude at this wavelength.
    np.testing.assert_allclose(image[30], expected, atol=3e-5)


def test_exposure_blurs_a_moving_wave_by_the_integral_over_its_path():
    wave, speed, exposure = 8 * PIXEL_M, 0.5, 200e-6
    face = _face(_wave(wave))
    still = _still(IDEAL, face)
    moved = render_exposure(IDEAL, face, lambda t: np.array([speed * t, 0, 0, 0, 0, 0]), 0.0, exposure)
    middle = 0.16 + 0.32
    gain = np.sinc(speed * exposure / wave)
    np.testing.assert_allclose(moved - middle, gain * (still - middle), atol=2e-6)


def test_each_row_of_a_rolling_shutter_is_that_of_a_picture_at_its_time():
    face, speed = _face(_wave(8 * PIXEL_M)), np.array([0.4, 0.0, 0.1, 0.0, 0.3, 0.0])
    middle = 1e-3 + 20e-6 * np.arange(64)
    rolled = render_exposure(IDEAL, face, lambda t: speed * t, middle, 50e-6)
    for row in (0, 31, 63):
        whole = render_exposure(IDEAL, face, lambda t: speed * t, float(middle[row]), 50e-6)
        np.testing.assert_array_equal(rolled[row], whole[row])


def test_rim_of_a_face_is_an_error_function():
    plain = texture_from_samples(np.ones((40, 40)), 1e-3)
    image = _still(IDEAL, _face(plain, (20.3 * PIXEL_M, 0.05)))
    row = image[31]
    area = ((row - 0.06) / (0.80 - 0.06)).sum()
    assert area == pytest.approx(2 * 20.3, abs=2e-3)  # the blurred rectangle keeps its width
    assert row[0] == pytest.approx(0.06)
    assert row[31] == pytest.approx(0.80)


def test_noise_has_the_stated_variance_and_depth():
    sensor = ImageSensor()
    rng = np.random.default_rng(4)
    for level in (0.1, 0.5, 0.8):
        stored = sensor.digitise(np.full((400, 400), level), rng)
        grey = level * 4095
        assert stored.mean() == pytest.approx(grey, abs=5 * np.sqrt(sensor.variance(np.array(grey)) / 160000))
        assert stored.var() == pytest.approx(grey / 8 + 36 + 1 / 12, rel=5 * np.sqrt(2 / 160000))
    assert sensor.digitise(np.full((9, 9), 1.2), rng).max() == 4095
    assert sensor.digitise(np.full((1, 1), 0.5), None)[0, 0] == round(0.5 * 4095)


def _high_share(image: np.ndarray) -> float:
    """Share of the spectrum's energy above 0.4 cycles per pixel."""
    part = image[:96, :96] - image[:96, :96].mean()
    window = np.hanning(96)
    power = np.abs(np.fft.fft2(part * window * window[:, None])) ** 2
    frequency = np.hypot(np.fft.fftfreq(96), np.fft.fftfreq(96)[:, None])
    return float(power[frequency > 0.4].sum() / power.sum())


def test_speckle_is_properly_sampled_unless_asked_not_to_be_depends_on_its_seed_and_covers_half():
    view = view_of(CAMERA, POSE)
    proper = speckle_texture((0.04, 0.04), 4.5 * PIXEL_M, PIXEL_M / 4, 0.6 * PIXEL_M, np.random.default_rng(1))
    sharp = speckle_texture((0.04, 0.04), 2.0 * PIXEL_M, PIXEL_M / 5, 0.0, np.random.default_rng(1))
    assert _high_share(_still(view, _face(proper))) < 8e-3
    assert _high_share(render(view, _face(sharp), np.zeros((1, 6)), np.ones(1), nodes=4)) > 0.05
    first, again, other = (
        speckle_texture((0.02, 0.01), 8e-4, 5e-5, 1e-4, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.coefficients, again.coefficients)
    assert not np.array_equal(first.coefficients, other.coefficients)
    assert 0.35 < first.coefficients.mean() < 0.65


@pytest.mark.slow
def test_bound_of_the_motion_agrees_with_monte_carlo():
    texture = speckle_texture((0.04, 0.04), 4.5 * PIXEL_M, PIXEL_M / 4, 0.6 * PIXEL_M, np.random.default_rng(1))
    face, sensor = _face(texture), ImageSensor()
    turned = RigidTransform(rotation_from_vector(np.array([0, 0.5, 0])), np.array([-0.14, 0, 0.04]))
    views = (view_of(CAMERA, POSE), view_of(CAMERA, turned @ POSE))
    bound = motion_bound(views, face, sensor)
    # One Gauss-Newton step from the truth on noisy images, with derivatives of its own step width.
    steps = np.array([1e-6] * 3 + [1e-5] * 3)
    means = [_still(view, face).ravel() * 4095 for view in views]
    ahead, behind = (
        [[_still(view, face, step).ravel() * 4095 for step in np.diag(sign * steps)] for view in views]
        for sign in (1.0, -1.0)
    )
    slope = (np.concatenate(ahead, axis=1) - np.concatenate(behind, axis=1)).T / (2 * steps)
    mean = np.concatenate(means)
    weighted = slope / sensor.variance(mean)[:, None]
    rng = np.random.default_rng(2)
    noisy = [np.concatenate([sensor.digitise((m / 4095)[None], rng)[0] for m in means]) - mean for _ in range(300)]
    found = np.array(noisy) @ weighted @ np.linalg.inv(slope.T @ weighted)
    ratio = found.std(axis=0) / np.sqrt(np.diagonal(bound))
    np.testing.assert_allclose(ratio, 1.0, atol=4.5 / np.sqrt(2 * 300))


def test_session_covariance_predicts_the_scatter_of_calibrations():
    between = RigidTransform(rotation_from_vector(np.array([0, 0.4, 0])), np.array([-0.12, 0, 0.02]))
    rig = StereoRig(CAMERA, CAMERA, between)
    few, many = (
        session_covariance(rig, np.array([0, 0, 0.3]), 0.025, 0.02, views, np.random.default_rng(1))
        for views in (5, 40)
    )
    assert np.linalg.eigvalsh(few / np.sqrt(np.outer(np.diag(few), np.diag(few))))[0] > 0
    assert (np.diag(many) <= np.diag(few) * 1.0001).all()
    baseline = np.sqrt(np.diag(many)[21:]) / 0.12
    assert (baseline < 5e-3).all()


# Rendered targets: against OpenCV's own drawing, a brute-force aperture, and the geometry they promise.


@pytest.mark.parametrize(("rows", "legacy"), [(6, False), (6, True), (5, True)])
def test_charuco_is_the_one_of_opencv(rows, legacy):
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawn = cv2.aruco.CharucoBoard((7, rows), 1.0, 0.75, dictionary)
    drawn.setLegacyPattern(legacy)
    expected = drawn.generateImage((7 * 48, rows * 48)) > 127
    size = np.array([7 * 48, rows * 48])
    camera = Camera.from_parameters(np.array([4800.0, 4800, 48 - 0.5, 48 - 0.5, 0, 0, 0, 0, 0]), size)
    pose = RigidTransform(np.eye(3), np.array([0, 0, 100 * SPACING_M]))
    rendered = render_board(camera, pose, charuco((7, rows), legacy=legacy), 0.3, falloff=0.0)
    assert ((rendered > 0.44) != expected).mean() < 0.002


@pytest.mark.parametrize("kind", ["chessboard", "dots"])
def test_aperture_is_the_mean_over_the_pixel(kind):
    camera, fine = camera_of(300.0, (80, 60)), 5
    board = chessboard((3, 3)) if kind == "chessboard" else Board(Target("dots", SPACING_M, (4, 3)))
    pose = pose_of(board, camera, 12.0, (0.4, -0.3, 0.2))
    k = camera.parameters.copy()
    k[:2] *= fine
    k[2:4] = (k[2:4] + 0.5) * fine - 0.5
    dense = render_board(Camera.from_parameters(k, camera.size_px * fine), pose, board, 0.7 * fine, falloff=0.0)
    expected = dense.reshape(60, fine, 80, fine).mean(axis=(1, 3))
    inside = (slice(4, -4), slice(4, -4))
    difference = (render_board(camera, pose, board, 0.7, falloff=0.0) - expected)[inside]
    assert np.sqrt((difference**2).mean()) < 1.5e-3
    assert abs(difference.mean()) < 6e-4  # softened dots cover π·(r² + σ²)


def test_random_sessions_show_the_whole_board():
    rng = np.random.default_rng(3)
    board = chessboard()
    for _ in range(5):
        rig = random_rig(rng, np.array([640, 480]), 0.055)
        for pose in random_poses(rng, rig, board, 6):
            left, right = rig.project(pose.apply(board.points_m))
            for pixels in (left, right):
                assert ((pixels > 0) & (pixels < [639, 479])).all()


def test_what_cannot_be_drawn_is_refused():
    refused("coefficients", Texture, np.zeros((2, 9), np.float32), np.zeros(2), 1e-4)
    skewed = (np.zeros(3), np.ones(3), np.eye(3)[1], np.ones(2), False, _gaussian_dot((0, 0), 1e-3), 1e-4)
    refused("axis_u, axis_v", Face, *skewed)
    refused("dictionary", Board, Target("charuco", SPACING_M, (9, 6)))
    refused("rings", Board, Target("dots", SPACING_M))
    level = pose_of(chessboard(), camera_of(), 30.0, (0.0, 0.0, 0.0))
    refused("blur_px", render_board, camera_of(), level, chessboard(), 0.1)
    rig = random_rig(np.random.default_rng(0), np.array([640, 480]), 0.02)
    refused("^board: ", random_poses, np.random.default_rng(0), rig, chessboard(), 1)
