"""Targets in rendered and real pictures: corners, chessboards, ChArUco boards, dot grids, and why one is refused."""

from __future__ import annotations

import dataclasses
import re
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from board_images import SENSOR, camera_of, charuco, chessboard, errors, picture, pose_of, truth_px
from board_images import SPACING_M as SPACING
from contracts import coverage_contract, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from photogram.calibration.bundle import model_pixels
from photogram.camera import Camera
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.images.noise import NoiseModel
from photogram.synthetic.board import render_board
from photogram.synthetic.patterns import Board
from photogram.targets.chessboard import corner_view, lattice_bend
from photogram.targets.crossing import NO_CROSSING, OUTSIDE, REASONS, SATURATED, CameraResponse, refine_corners
from photogram.targets.dots import find_dots
from photogram.targets.ellipse import FittedEllipses, fit_ellipses
from photogram.targets.find_target import find_target
from photogram.targets.target_view import Target, TargetNotFound, TargetView, estimate_image_noise
from shakercal._common.arrays import FloatArray

slow = partial(pytest.param, marks=pytest.mark.slow)
NOISE = NoiseModel(36.0, 0.125)
RESPONSE = CameraResponse(NOISE, SENSOR.full_scale)


def _expected(pose: RigidTransform, board: Board, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where the corners are, their squares' sides, and the bend of the edges."""
    index, half = board.index.astype(int), 0.5 * np.eye(2)
    place = partial(truth_px, camera, pose, board)
    truth = place(index)
    return truth, np.stack([place(index + h) - place(index - h) for h in half], axis=1), lattice_bend(index, truth)


@pytest.mark.parametrize(
    ("blur_px", "square_px"), [(0.5, 16.0), *(slow(*case) for case in ((2.0, 40.0), (1.0, 16.0), (0.5, 40.0)))]
)
def test_bias_is_below_a_hundredth_of_a_pixel(blur_px, square_px):
    board, camera = chessboard(), camera_of(900.0)
    pose = pose_of(board, camera, square_px, (0.5, -0.4, 0.3))
    image = render_board(camera, pose, board, blur_px, slant=0.3) * SENSOR.full_scale
    truth, axes, bend = _expected(pose, board, camera)
    start = truth + np.random.default_rng(1).uniform(-1, 1, truth.shape)
    corners = refine_corners(image, start, axes, RESPONSE, bend)
    assert (corners.status == 0).all()
    error = corners.position_px - truth
    assert np.abs(error.mean(axis=0)).max() < 0.002
    assert np.abs(error).max() < 0.01
    np.testing.assert_allclose(np.median(corners.blur_px), blur_px, rtol=0.05)


def test_noise_of_the_image_is_found():
    board, camera = chessboard(), camera_of()
    noise = estimate_image_noise(picture(camera, pose_of(board, camera, 40.0, (0.3, 0.2, 0.1)), board))
    grey = np.array([400.0, 3000.0])
    np.testing.assert_allclose(noise.variance(grey), SENSOR.variance(grey), rtol=0.1)


def test_failed_corners_have_a_reason():
    board, camera = chessboard(), camera_of()
    pose = pose_of(board, camera, 40.0, (0.0, 0.0, 0.0))
    image = picture(camera, pose, board).astype(np.float64)
    truth = truth_px(camera, pose, board, np.array([[4, 2], [4, 3]]))
    axes = np.tile(40.0 * np.eye(2), (4, 1, 1))
    bright = np.minimum(16 * image, SENSOR.full_scale)
    start = np.concatenate([truth[:1], truth[:1] + 20.0, [[1.0, 1.0]], truth[1:]])
    corners = refine_corners(image, start, axes, RESPONSE)
    assert list(corners.status) == [0, NO_CROSSING, OUTSIDE, 0]
    assert np.isnan(corners.position_px[1:3]).all()
    over = refine_corners(bright, truth, axes[:2], RESPONSE)
    assert (over.status == SATURATED).all()


# Chessboards: truth from rendered pictures, orientation, and every reason for which a picture is refused.

CAMERA = camera_of()
BOARD = chessboard()
POSE = pose_of(BOARD, CAMERA, 36.0, (0.4, -0.3, 0.2))
CHARUCO = charuco()
CHARUCO_POSE = pose_of(CHARUCO, CAMERA, 40.0, (0.4, -0.3, 0.2))


UNNAMED = {"dictionary": None}
OBLIQUE, TWISTED = ((0.4, -0.3, 0.2), 40.0, 0.0), ((0.4, -0.3, 2.5), 32.0, 0.0)
SYMMETRIC, PARTLY = ((0.3, 0.3, -0.3), 34.0, 0.0), ((0.2, -0.2, 0.1), 44.0, 220.0)


@pytest.mark.parametrize(
    ("board", "placed", "blur_px", "target", "corners", "largest_px"),
    [
        (BOARD, TWISTED, 2.0, {}, 54, 0.025),
        (chessboard((6, 6)), SYMMETRIC, 0.7, {}, 36, 0.02),
        (chessboard((8, 6)), SYMMETRIC, 0.7, {}, 48, 0.02),
        slow(chessboard((7, 7)), SYMMETRIC, 0.7, {}, 49, 0.02),
        (CHARUCO, OBLIQUE, 0.7, UNNAMED, 40, 0.015),
        (charuco(legacy=True), OBLIQUE, 0.7, UNNAMED, 40, 0.015),
        slow(charuco(dictionary="DICT_APRILTAG_36h11"), OBLIQUE, 0.7, UNNAMED, 40, 0.015),
        (dataclasses.replace(CHARUCO, marker_share=0.5), OBLIQUE, 0.7, {}, 40, 0.02),
        (charuco(legacy=True), PARTLY, 0.7, {}, None, 0.02),
    ],
)
def test_corners_are_where_they_are(board, placed, blur_px, target, corners, largest_px):
    """At any turn, symmetric boards upright, both patterns, with the dictionary unnamed, and of a part of a board."""
    turn, square_px, shift_px = placed
    pose = pose_of(board, CAMERA, square_px, turn, shift_px)
    image = picture(CAMERA, pose, board, blur_px=blur_px)
    view = find_target(image, dataclasses.replace(board.target, **target), "a", SENSOR.full_scale)
    error, whitened = errors(CAMERA, pose, board, view)
    assert len(view.index) == corners or (corners is None and 10 < len(view.index) < 40)
    assert np.abs(error).max() < largest_px
    assert corners is None or 0.75 < whitened.std() < 1.35
    assert abs(view.blur_px - blur_px) < 0.05 * blur_px + 0.02


BLANK = np.tile(np.arange(640.0) % 7 * 300, (480, 1))
HALF_OUTSIDE = pose_of(BOARD, CAMERA, 36.0, (0.2, -0.2, 0.1), shift_px=260.0)


@pytest.mark.parametrize(
    ("board", "reason", "change"),
    [
        (BOARD, "overexposed", lambda image: np.minimum(image * 16.0, SENSOR.full_scale)),
        slow(CHARUCO, "overexposed", lambda image: np.minimum(image * 16.0, SENSOR.full_scale)),
        (BOARD, "underexposed", lambda image: image * 0.02),
        slow(CHARUCO, "underexposed", lambda image: image * 0.02),
        (BOARD, "blurred", lambda image: gaussian_filter(image.astype(float), 6.0)),
        slow(CHARUCO, "blurred", lambda image: gaussian_filter(image.astype(float), 5.0)),
        (CHARUCO, "mirrored", lambda image: image[:, ::-1]),
        (BOARD, "^no chessboard", lambda _: BLANK),
        (BOARD, "^extends .*edge", lambda _: picture(CAMERA, HALF_OUTSIDE, BOARD)),
        (BOARD, ".", lambda _: picture(CAMERA, POSE, charuco((10, 7)))),
        (BOARD, "^another", {"size": (8, 5)}),
        *(slow(BOARD, "^another", {"size": size}) for size in ((11, 6), (10, 7))),
        (CHARUCO, "^another", {"size": (7, 5)}),
        slow(CHARUCO, "^another", {"size": (9, 4)}),
        (CHARUCO, "markers .*DICT_6X6_50", {"dictionary": "DICT_6X6_50"}),
    ],
)
def test_bad_images_and_other_boards_are_refused_with_the_reason(board, reason, change):
    image, target = picture(CAMERA, POSE if board is BOARD else CHARUCO_POSE, board), board.target
    if isinstance(change, dict):
        target = dataclasses.replace(target, **change)
    else:
        image = change(image).astype(np.uint16)
    refused(reason, find_target, image, target, "a", SENSOR.full_scale, error=TargetNotFound)


def test_an_unknown_dictionary_is_a_wrong_call():
    target = dataclasses.replace(CHARUCO.target, dictionary="4X4")
    refused("DICT_4X4_50", find_target, picture(CAMERA, CHARUCO_POSE, CHARUCO), target, "a", SENSOR.full_scale)


# Pictures that a camera has sharpened, and overexposed ones: truth rendered, then noise, unsharp mask and clipping.


def unsharp(grey: FloatArray, amount: float, radius_px: float, gain: float, seed: int) -> FloatArray:
    """A picture (H, W) in whole grey values: photon and read noise, unsharp mask, limits of the range."""
    grey = grey * gain * SENSOR.full_scale
    noisy = grey + np.random.default_rng(seed).normal(size=grey.shape) * np.sqrt(SENSOR.variance(grey))
    mask = amount * (noisy - gaussian_filter(noisy, radius_px)) if amount else 0.0
    return np.clip(np.rint(noisy + mask), 0, SENSOR.full_scale).astype(np.uint16)


@pytest.mark.parametrize("kind", ["chessboard", "charuco"])
@pytest.mark.parametrize(
    ("blur_px", "amount", "radius_px"),
    [(0.5, 2.0, 1.0), *(slow(*case) for case in ((0.7, 1.0, 1.5), (1.0, 2.0, 0.7), (0.7, 0.0, 1.0)))],
)
def test_sharpened_boards_lose_no_corner(kind, blur_px, amount, radius_px):
    board = chessboard((11, 7)) if kind == "chessboard" else charuco((12, 8))
    pose = pose_of(board, CAMERA, 38.0, (0.3, -0.2, 0.1))
    image = unsharp(render_board(CAMERA, pose, board, blur_px, slant=0.3), amount, radius_px, 0.65, 1)
    view = find_target(image, board.target, "a", SENSOR.full_scale)
    error, whitened = errors(CAMERA, pose, board, view)
    assert len(view.index) >= 0.95 * 77
    assert np.abs(error.mean(axis=0)).max() < 0.005
    assert np.abs(error).max() < 0.03
    assert abs(view.blur_px - blur_px) < 0.1
    assert (0.8 if kind == "chessboard" else 0.65) < whitened.std() < 1.3  # the halo of markers counts as noise


@pytest.mark.parametrize(("gain", "amount"), [(1.35, 0.0), slow(1.35, 1.0), slow(3.0, 1.0)])
def test_saturated_pixels_cost_no_corner(gain, amount):
    board = chessboard((11, 7))
    pose = pose_of(board, CAMERA, 38.0, (0.2, -0.2, 0.1))
    image = unsharp(render_board(CAMERA, pose, board, 0.7, slant=0.3), amount, 1.0, gain, 1)
    assert (image == SENSOR.full_scale).mean() > 0.1
    view = find_target(image, board.target, "a", SENSOR.full_scale)
    error, whitened = errors(CAMERA, pose, board, view)
    assert len(view.index) >= 0.98 * 77
    assert np.abs(error.mean(axis=0)).max() < 0.002
    assert 0.8 < whitened.std() < 1.3


def test_lost_corners_are_counted_and_reported():
    board, rng = chessboard((11, 7)), np.random.default_rng(3)
    pose = pose_of(board, CAMERA, 38.0, (0.2, -0.2, 0.1))
    image = unsharp(render_board(CAMERA, pose, board, 0.7), 0.0, 1.0, 0.65, 1)
    index, start, axes = board.index.astype(int), truth_px(CAMERA, pose, board, board.index), np.eye(2) * 38.0
    start[:9] += 19.0  # into the middle of squares
    view = corner_view(image, board.target, index, start, np.tile(axes, (77, 1, 1)), "a", SENSOR.full_scale)
    assert (len(view.index), view.lost) == (68, 9)
    assert re.findall(r"\d+", view.loss_reasons) == ["68", "77", "9"]
    assert REASONS[NO_CROSSING] in view.loss_reasons
    start += rng.choice([-19.0, 19.0], start.shape) * (np.arange(77) > 12)[:, None]
    words = rf"^\d of 77 .* 7\d {REASONS[NO_CROSSING]}"
    arguments = board.target, index, start, np.tile(axes, (77, 1, 1)), "a", SENSOR.full_scale
    refused(words, corner_view, image, *arguments, error=TargetNotFound)


def side_by_side(boards: tuple[Board, Board], px: float, turn: tuple[float, float, float]) -> tuple[np.ndarray, list]:
    """A picture of two boards, and their poses."""
    places = [pose_of(board, CAMERA, px, turn, 300 * k - 150) for k, board in enumerate(boards)]
    left, right = (picture(CAMERA, place, board) for place, board in zip(places, boards, strict=True))
    return np.concatenate([left[:, :330], right[:, 330:]], axis=1), places


@pytest.mark.parametrize("make", [chessboard, slow(charuco)])
def test_of_two_boards_in_an_image_the_specified_one_is_used(make):
    boards = make((9, 6)), make((7, 5))
    image, places = side_by_side(boards, 23.0, (0.1, 0.1, 0.05))
    for board, place in zip(boards, places, strict=True):
        view = find_target(image, board.target, "a", SENSOR.full_scale)
        assert len(view.index) == len(board.index)
        assert np.abs(errors(CAMERA, place, board, view)[0]).max() < 0.03


@pytest.mark.parametrize(
    ("board", "px", "turn_x"),
    [
        (BOARD, 23.0, 0.1),
        (CHARUCO, 23.0, 0.1),
        (Board(Target("dots", SPACING, (7, 6))), 32.0, 0.1),
        slow(Board(Target("dots", SPACING), rings=(4, 2), lattice=(-1, 5, -1, 4)), 32.0, np.pi),
    ],
)
def test_two_equal_boards_in_an_image_are_refused(board, px, turn_x):
    """Where either of two may be the one in the other camera's picture, none is taken; a part of one is no second."""
    image, _ = side_by_side((board, board), px, (turn_x, 0.1 if turn_x < 1 else 0.0, 0.05))
    refused("^two targets: ", find_target, image, board.target, "a", 4095)
    image[:, 330:] = np.where(np.arange(330, 640) < 360, image[:, 330:], image[5, 5])
    assert len(find_target(image, board.target, "a", 4095).index) >= 0.9 * len(board.index)


@pytest.mark.parametrize(("gain", "amount"), [(1.6, 0.0), slow(1.6, 2.0), slow(3.0, 1.0)])
def test_dots_on_a_sheet_at_full_scale_stay_where_they_are(gain, amount):
    """The sheet's share of pixels is saturated (truth by the conic of the disc seen, not by the fit's own model)."""
    board = Board(Target("dots", SPACING, (11, 8)))
    place = pose_of(board, CAMERA, 36.0, (0.3, -0.2, 0.1))
    image = unsharp(render_board(CAMERA, place, board, 0.7, slant=0.2), amount, 1.0, gain, 1)
    assert (image == SENSOR.full_scale).mean() > 0.2
    view = find_target(image, board.target, "a", SENSOR.full_scale)
    points = np.column_stack([view.index, np.zeros(len(view.index))]) * SPACING
    truth = model_pixels(CAMERA, RigidTransform.identity(), place, points, board.radius * SPACING).pixel
    error = view.position_px - truth
    whitened = np.linalg.solve(np.linalg.cholesky(view.covariance_px2), error[..., None])
    assert len(view.index) == 88
    assert np.abs(error.mean(axis=0)).max() < 0.008
    assert np.abs(error).max() < 0.04
    assert 0.5 < whitened.std() < 1.6


# Dot grids in rendered pictures: every dot at its place, and a clear answer where there is no grid to use.

SIZE = (800, 640)
WIDE = Camera.from_parameters(np.array([1500.0, 1500, 402, 317, -0.15, 0.1, 0, 0, 0]), np.array(SIZE))
SPACING_M = 4e-3
RINGS = Board(Target("dots", SPACING_M), radius=0.22, rings=(5, 3), hole=0.09, lattice=(-3, 8, -3, 6))
EQUAL_ARMS = Board(Target("dots", SPACING_M), radius=0.22, rings=(4, 4), hole=0.09, lattice=(-2, 6, -2, 6))
PLAIN = Board(Target("dots", SPACING_M, (9, 6)), radius=0.25)
ASYMMETRIC = Board(Target("asymmetric-dots", SPACING_M, (4, 11)), radius=0.35)
FACING_UP = np.diag([1.0, -1, -1])


def pose(board: Board, turn: float = 0.0, tilt: float = 0.0, distance_m: float = 0.16) -> RigidTransform:
    """Camera-from-target with the board's middle on the axis, tilted about its y axis, then turned in the picture."""
    upright = FACING_UP if board.rings else np.eye(3)
    rotation = rotation_from_vector(np.array([0, 0, turn])) @ rotation_from_vector(np.array([0, tilt, 0])) @ upright
    middle = (board.points_m.min(axis=0) + board.points_m.max(axis=0)) / 2
    return RigidTransform(rotation, np.array([0, 0, distance_m]) - rotation @ middle)


@cache
def clean(board: Board, pose: tuple[float, ...], blur_px: float) -> np.ndarray:
    return render_board(WIDE, RigidTransform.from_pose(np.array(pose)), board, blur_px=blur_px)


def shown(board: Board, where: RigidTransform, noise: float = 1.0, blur_px: float = 0.8) -> np.ndarray:
    grey = 255 * clean(board, tuple(where.pose), blur_px)
    return np.clip(np.rint(grey + np.random.default_rng(0).normal(0, noise, grey.shape)), 0, 255).astype(np.uint8)


def find(image: np.ndarray, board: Board) -> TargetView:
    return find_dots(image, board.target, "a", 255)


def by_index(view: TargetView) -> dict[tuple[int, ...], np.ndarray]:
    return {tuple(index): position for index, position in zip(view.index.tolist(), view.position_px, strict=True)}


def off_px(view: TargetView, where: RigidTransform) -> np.ndarray:
    """How far (N,) the seen centres lie off the images of the dots' centres, which perspective hardly moves here."""
    points = np.column_stack([view.index, np.zeros(len(view.index))]) * SPACING_M
    return np.linalg.norm(WIDE.project(where.apply(points)) - view.position_px, axis=1)


def test_speckle_is_not_reported_as_a_board_beyond_the_edge():
    speckle = gaussian_filter(np.random.default_rng(3).normal(size=(480, 640)), 4.0) > 0
    image = (300 + 2000 * gaussian_filter(speckle.astype(float), 0.8)).astype(np.uint16)
    refused("^no chessboard .*9 x 6", find_target, image, BOARD.target, "a", 4095, error=TargetNotFound)


@pytest.mark.parametrize("board", [RINGS, PLAIN, ASYMMETRIC])
@pytest.mark.parametrize("tilt", [slow(0.0), 0.5, slow(-0.87)])
def test_every_dot_is_found_at_its_position(board, tilt):
    where = pose(board, turn=0.2, tilt=tilt, distance_m=0.19)
    view = find(shown(board, where), board)
    assert set(map(tuple, view.index.tolist())) >= set(map(tuple, board.index.astype(int).tolist())) or board.rings
    assert len(view.index) >= (0.95 * len(board.index) if tilt > -0.8 else 50 if board.rings else len(board.index))
    assert off_px(view, where).max() < 0.35
    assert view.radius == pytest.approx(board.radius, rel=0.02)
    assert view.blur_px == pytest.approx(np.hypot(0.8, np.sqrt(1 / 12)), rel=0.25)


def test_centres_are_right_to_a_hundredth_of_a_pixel_where_perspective_is_absent():
    where = pose(RINGS, turn=0.3)
    off = off_px(find(shown(RINGS, where, noise=0.5), RINGS), where)
    assert off.max() < 0.03
    assert np.sqrt((off**2).mean()) < 0.015


@pytest.mark.parametrize("board", [slow(RINGS), EQUAL_ARMS])
@settings(deadline=None, max_examples=2)
@given(turn=st.floats(-np.pi, np.pi), tilt=st.floats(-0.6, 0.6))
def test_rings_name_the_dots_at_any_turn_by_handedness_where_their_arms_are_equal(board, turn, tilt):
    where = pose(board, turn, tilt, 0.2 if board is EQUAL_ARMS else 0.16)
    view = find(shown(board, where), board)
    assert len(view.index) > 60
    assert off_px(view, where).max() < 0.35


def test_plain_grid_runs_to_the_right():
    for turn in (0.4, np.pi - 0.4):
        view = find(shown(PLAIN, pose(PLAIN, turn)), PLAIN)
        (x, y), seen = view.index.T, view.position_px
        along = seen[x == 8].mean(axis=0) - seen[x == 0].mean(axis=0)
        down = seen[y == 5].mean(axis=0) - seen[y == 0].mean(axis=0)
        assert along[0] > 0
        assert along[0] * down[1] - along[1] * down[0] > 0


def test_asymmetric_grid_agrees_with_opencv():
    import cv2

    image = shown(ASYMMETRIC, pose(ASYMMETRIC, 0.1, 0.2))
    found, centres = cv2.findCirclesGrid(image, (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    place = by_index(find(image, ASYMMETRIC))
    ours = np.array([place[(2 * i + j % 2, j)] for j in range(11) for i in range(4)])
    assert np.linalg.norm(ours - centres.reshape(-1, 2), axis=1).max() < 0.5


def test_bright_dots_and_twelve_bits_and_odd_rows_are_found_too():
    where = pose(RINGS, 1.0)
    assert off_px(find(255 - shown(RINGS, where), RINGS), where).max() < 0.1
    fine = (16 * render_board(WIDE, where, RINGS) * 255).astype(np.uint16)
    assert off_px(find_dots(fine, RINGS.target, "a", 4095), where).max() < 0.03
    turned = pose(ASYMMETRIC, 2.5)
    assert off_px(find(shown(ASYMMETRIC, turned), ASYMMETRIC), turned).max() < 0.1


def test_missing_dots_dirt_and_falling_light_do_no_harm():
    where = pose(RINGS, 0.1, 0.3)
    image = shown(RINGS, where).astype(float)
    y, x = np.indices(image.shape)
    rng = np.random.default_rng(4)
    for centre in WIDE.project(where.apply(SPACING_M * np.array([[1.0, 1, 0], [2, -1, 0], [-1, 3, 0], [3, 2, 0]]))):
        image[np.hypot(x - centre[0], y - centre[1]) < 16] = 200
    for centre in rng.uniform(50, 600, (60, 2)):
        image[np.hypot(x - centre[0], y - centre[1]) < rng.uniform(1, 3)] *= 0.5
    image *= 0.3 + 0.7 * x / SIZE[0]
    view = find(np.clip(image, 0, 255).astype(np.uint8), RINGS)
    assert not {(1, 1), (2, -1), (-1, 3), (3, 2)} & set(map(tuple, view.index.tolist()))
    assert len(view.index) > 60
    assert np.quantile(off_px(view, where), 0.8) < 0.2


WHITE = np.random.default_rng(0).normal(size=SIZE[::-1])
CHESS = Board(Target("chessboard", SPACING_M, (9, 6)))
MARKED = Board(Target("charuco", SPACING_M, (9, 7), "DICT_4X4_50"))
EVEN_ROWS = Board(Target("asymmetric-dots", SPACING_M, (5, 8)), radius=0.3)


@pytest.mark.parametrize(
    ("reason", "target", "image"),
    [
        ("mirrored", RINGS.target, lambda: shown(RINGS, pose(RINGS, 1.0))[:, ::-1]),
        ("mirrored", EVEN_ROWS.target, lambda: shown(EVEN_ROWS, pose(EVEN_ROWS))[:, ::-1]),
        ("^[012] of .* ring", RINGS.target, lambda: shown(RINGS, pose(RINGS))[:, 380:]),
        ("^no ring", Target("dots", SPACING_M), lambda: shown(PLAIN, pose(PLAIN))),
        ("^extends .*edge", PLAIN.target, lambda: shown(PLAIN, pose(PLAIN, distance_m=0.12))[:, :420]),
        ("^extends .*edge", ASYMMETRIC.target, lambda: shown(ASYMMETRIC, pose(ASYMMETRIC, 0, 0, 0.12))[:, :420]),
        ("7 x 5", Target("dots", SPACING_M, (7, 5)), lambda: shown(PLAIN, pose(PLAIN))),
        slow(".", RINGS.target, lambda: 120 + 3 * WHITE),
        (".", RINGS.target, lambda: np.full(SIZE[::-1], 120)),
        (".", RINGS.target, lambda: np.where(gaussian_filter(WHITE, 3.0) > 0, 200, 30)),
        slow(".", RINGS.target, lambda: shown(CHESS, pose(CHESS, 0.1))),
        (".", PLAIN.target, lambda: shown(MARKED, pose(MARKED, 0.1))),
        ("blurred", RINGS.target, lambda: shown(RINGS, pose(RINGS), blur_px=6.0)),
        ("overexposed", RINGS.target, lambda: np.minimum(90.0 * shown(RINGS, pose(RINGS)), 255)),
    ],
)
def test_what_is_no_usable_grid_is_refused_with_the_reason(reason, target, image):
    refused(reason, find_dots, image().astype(np.uint8), target, "a", 255, error=TargetNotFound)


# The dot grid with ring markers as two real cameras saw it, 14 times.

RING_GRID = Target("dots", 3.5e-3)


def view_of(folder: Path, number: int, camera: int) -> TargetView:
    import cv2

    path = folder / "dotgrid_stereo" / f"CalB-sys2-{number:04d}_{camera}.jpeg"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return find_dots(image, RING_GRID, path.name, 255)


def common(first: TargetView, second: TargetView) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the dots that both views show, in the same order."""
    here, there = by_index(first), by_index(second)
    both = [index for index in here if index in there]
    return np.array([here[index] for index in both]), np.array([there[index] for index in both])


def plane_residual_px(from_px: np.ndarray, to_px: np.ndarray) -> float:
    """Rms distance per axis from the best homography between two views."""
    import cv2

    matrix, _ = cv2.findHomography(from_px, to_px, 0)
    seen = cv2.perspectiveTransform(from_px.reshape(-1, 1, 2), matrix).reshape(-1, 2)
    return float(np.sqrt(np.mean((seen - to_px) ** 2)))


@pytest.mark.parametrize("number", [1, *map(slow, range(2, 15))])
def test_all_dots_of_a_stereo_pair(data_dir, number):
    """76 dots, the rings where the target's description has them, and both cameras see one plane."""
    left, right = (view_of(data_dir, number, camera) for camera in (0, 1))
    for view in (left, right):
        assert len(view.index) >= 76
        place = by_index(view)
        origin, x_ring, y_ring = place[0, 0], place[5, 0], place[0, 3]
        assert x_ring[0] - origin[0] > 1000
        assert y_ring[1] - origin[1] < -600
        assert origin[0] < 800
        assert origin[1] > 1000
        assert view.radius == pytest.approx(0.2025, abs=0.001)
    here, there = common(left, right)
    assert len(here) >= 72
    assert plane_residual_px(here, there) < 0.15


@pytest.mark.slow
def test_centres_repeat_to_two_hundredths_of_a_pixel(data_dir):
    first, second = (view_of(data_dir, number, 1) for number in (12, 13))
    here, there = common(first, second)
    assert plane_residual_px(here, there) < 0.02 * np.sqrt(2)


# Ellipses of dots against rendered ones: centres without bias, covariance that holds.

OVERSAMPLING = 8
BACKGROUND, CONTRAST = 180.0, -150.0


def render_dot(centre: np.ndarray, shape: np.ndarray, sigma: float, size: int, slope: float = 0.0) -> np.ndarray:
    """Picture (size, size) of one dark ellipse, blurred and averaged over the pixels, by oversampling."""
    fine = (np.arange(size * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    offset = np.stack(np.meshgrid(fine, fine), axis=-1) - centre
    normal = offset @ np.linalg.inv(shape)
    square = np.maximum((normal * offset).sum(axis=-1), 1e-9)
    outside = (square - np.sqrt(square)) / np.linalg.norm(normal, axis=-1)
    covered = np.clip(0.5 - outside * OVERSAMPLING, 0, 1)
    blurred = gaussian_filter(covered, sigma * OVERSAMPLING)
    pixels = blurred.reshape(size, OVERSAMPLING, size, OVERSAMPLING).mean(axis=(1, 3))
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    light = 1 + slope * (x - centre[0]) - 0.5 * slope * (y - centre[1])
    return (BACKGROUND + CONTRAST * pixels) * light


def fit(image: np.ndarray, start: np.ndarray, shape: np.ndarray, ring: bool = False) -> FittedEllipses:
    return fit_ellipses(image, start[None], 1.1 * shape[None], np.array([30.0]), np.array([ring]))


def dot(radius: float, sigma: float, slope: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre, shape S (2, 2) and picture of an ellipse, turned and flattened at random as up to 45° of tilt do."""
    rng = np.random.default_rng(seed)
    size = int(2.6 * radius + 8 * sigma + 12)
    centre = size / 2 + rng.uniform(-0.5, 0.5, 2)
    angle, flat = rng.uniform(0, np.pi), rng.uniform(0.7, 1.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shape = turn @ np.diag([radius**2 / flat, radius**2 * flat]) @ turn.T
    return centre, shape, render_dot(centre, shape, sigma, size, slope)


@pytest.mark.parametrize(
    ("radius", "sigma", "slope"), [(3, 0.7, 0), (5, 1, 0.004), (10, 0.6, 0.005), (30, 2, 0.002), (20, 5, 0)]
)
def test_centre_has_no_bias_at_any_size_and_blur(radius, sigma, slope):
    for seed in range(2):
        centre, shape, image = dot(radius, sigma, slope, seed)
        found = fit(image, centre + 0.2, shape)
        assert np.abs(found.centre_px[0] - centre).max() < 0.005
        assert found.radius_px[0] == pytest.approx(radius, rel=0.004)
        assert found.blur_px[0] == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.05)


def test_the_truth_is_covered():
    rng = np.random.default_rng(4)
    centre, shape, image = dot(8.0, 0.8, 0.0, 0)

    def estimate(_: int) -> tuple[np.ndarray, np.ndarray]:
        found = fit(image + rng.normal(0, 1.0 + 0.1 * np.sqrt(image)), centre, shape)
        return found.centre_px[0], found.covariance_px2[0]

    coverage_contract(estimate, fit(image, centre, shape).centre_px[0], 60)


def test_ring_is_placed_by_its_outer_edge():
    centre, shape, image = dot(20.0, 1.2, 0.0, 5)
    hole = render_dot(centre + np.array([1.5, -1.0]), 0.3**2 * shape, 1.2, len(image))
    found = fit(image + (BACKGROUND - hole), centre + 0.3, shape, ring=True)
    assert np.abs(found.centre_px[0] - centre).max() < 0.005


def test_roughness_distinguishes_a_square_from_a_disc():
    centre, shape, image = dot(15.0, 1.0, 0.0, 7)
    y, x = np.indices(image.shape)
    inside = np.maximum(abs(x - centre[0]), abs(y - centre[1])) < 13.3
    square = gaussian_filter(np.where(inside, BACKGROUND + CONTRAST, BACKGROUND), 1.0)
    round_one, square_one = fit(image, centre, shape), fit(square, centre, 15.0**2 * np.eye(2))
    assert round_one.roughness_px[0] < 0.02
    assert not square_one.roughness_px[0] < 1.0


def test_what_is_no_dot_gives_nan():
    flat = np.full((40, 40), 100.0)
    found = fit(flat, np.array([20.0, 20.0]), 36.0 * np.eye(2))
    assert np.isnan(found.centre_px).all()
    assert np.isnan(found.covariance_px2).all()
    starts = np.zeros((2, 2)), np.ones((2, 2, 2)), np.ones(3), np.zeros(2, dtype=bool)
    refused("^reach_px: ", fit_ellipses, np.zeros((9, 9)), *starts)


@pytest.mark.parametrize(
    ("kind", "size", "wrong"),
    [
        ("chessboard", (100_000, 100_000), "20000 points, .* 100000 x 100000"),
        ("dots", (1001, 2), "^size: .*1000 columns, 1000 rows"),
        ("charuco", (150, 150), "20000 points, .* 150 x 150"),
        ("chessboard", (2, 9), " 3 columns .*chessboard .* 2 x 9"),
    ],
)
def test_sizes_that_no_target_has_are_refused(kind, size, wrong):
    refused(wrong, Target, kind, 0.005, size)
