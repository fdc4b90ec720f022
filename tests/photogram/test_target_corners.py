"""Sub-pixel corners: bias without noise, scatter against the stated covariance, OpenCV's refinement as a peer."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from board_pictures import SENSOR, camera_of, charuco, chessboard, errors, picture, pose_of, truth_px
from scipy.ndimage import gaussian_filter

from photogram.arrays import FloatArray
from photogram.geometry import RigidTransform
from photogram.images import NoiseModel
from photogram.synthetic.board import Board, render_board
from photogram.targets.charuco import find_charuco
from photogram.targets.chessboard import find_chessboard, lattice_bend
from photogram.targets.crossing import NO_CROSSING, OUTSIDE, SATURATED, refine_corners
from photogram.targets.view import TargetNotFound, find_target, picture_noise

slow = partial(pytest.param, marks=pytest.mark.slow)
NOISE = NoiseModel(36.0, 0.125)


def _axes(camera: object, pose: object, board: object, index: FloatArray) -> FloatArray:
    half = 0.5 * np.eye(2)
    return np.stack(
        [truth_px(camera, pose, board, index + h) - truth_px(camera, pose, board, index - h) for h in half], axis=1
    )


@pytest.mark.parametrize(("blur_px", "square_px"), [(0.5, 16.0), (2.0, 40.0), slow(1.0, 16.0), slow(0.5, 40.0)])
def test_bias_is_below_a_hundredth_of_a_pixel(blur_px: float, square_px: float) -> None:
    board, camera = chessboard(), camera_of(900.0)
    pose = pose_of(board, camera, square_px, (0.5, -0.4, 0.3))
    index = board.index.astype(int)
    image = render_board(camera, pose, board, blur_px, slant=0.3) * SENSOR.full_scale
    truth, axes = truth_px(camera, pose, board, index), _axes(camera, pose, board, index)
    start = truth + np.random.default_rng(1).uniform(-1, 1, truth.shape)
    corners = refine_corners(image, start, axes, NOISE, SENSOR.full_scale, lattice_bend(index, truth))
    assert (corners.status == 0).all()
    error = corners.position_px - truth
    assert np.abs(error.mean(axis=0)).max() < 0.002
    assert np.abs(error).max() < 0.01
    np.testing.assert_allclose(np.median(corners.blur_px), blur_px, rtol=0.05)


@pytest.mark.slow
def test_covariance_is_the_scatter_and_the_peer_scatters_more() -> None:
    import cv2

    board, camera = chessboard(), camera_of()
    pose = pose_of(board, camera, 30.0, (0.4, -0.3, 0.2))
    index = board.index.astype(int)
    truth, axes = truth_px(camera, pose, board, index), _axes(camera, pose, board, index)
    bend = lattice_bend(index, truth)
    whitened, error, peer = [], [], []
    clean = render_board(camera, pose, board, slant=0.3)
    for seed in range(12):
        image = SENSOR.digitise(clean, np.random.default_rng(seed))
        corners = refine_corners(image, truth + 0.3, axes, picture_noise(image), SENSOR.full_scale, bend)
        error.append(corners.position_px - truth)
        whitened.append(np.linalg.solve(np.linalg.cholesky(corners.covariance_px2), error[-1][..., None]))
        found = truth.astype(np.float32).reshape(-1, 1, 2)
        cv2.cornerSubPix((image / 16).astype(np.uint8), found, (9, 9), (-1, -1), (3, 100, 1e-4))
        peer.append(found.reshape(-1, 2) - truth)
    assert 0.93 < np.std(whitened) < 1.07
    assert np.std(error) < 0.3 * np.std(peer)


def test_noise_of_the_picture_is_found() -> None:
    board, camera = chessboard(), camera_of()
    noise = picture_noise(picture(camera, pose_of(board, camera, 40.0, (0.3, 0.2, 0.1)), board))
    grey = np.array([400.0, 3000.0])
    np.testing.assert_allclose(noise.variance(grey), SENSOR.variance(grey), rtol=0.1)


def test_failed_corners_say_why() -> None:
    board, camera = chessboard(), camera_of()
    pose = pose_of(board, camera, 40.0, (0.0, 0.0, 0.0))
    image = picture(camera, pose, board).astype(np.float64)
    truth = truth_px(camera, pose, board, np.array([[4, 2], [4, 3]]))
    axes = np.tile(40.0 * np.eye(2), (4, 1, 1))
    bright = np.where(image > 1500, SENSOR.full_scale, image)
    start = np.concatenate([truth[:1], truth[:1] + 20.0, [[1.0, 1.0]], truth[1:]])
    corners = refine_corners(image, start, axes, NOISE, SENSOR.full_scale)
    assert list(corners.status) == [0, NO_CROSSING, OUTSIDE, 0]
    assert np.isnan(corners.position_px[1:3]).all()
    over = refine_corners(bright, truth, axes[:2], NOISE, SENSOR.full_scale)
    assert (over.status == SATURATED).all()


# Chessboards: truth from rendered pictures, orientation, and every reason for which a picture is refused.

CAMERA = camera_of()
BOARD = chessboard()
POSE = pose_of(BOARD, CAMERA, 36.0, (0.4, -0.3, 0.2))


@pytest.mark.parametrize(("turn", "blur_px"), [(0.0, 0.7), (2.5, 2.0), *map(slow, (1.2, -1.5, 0.0), (0.7, 0.7, 2.0))])
def test_corners_are_where_they_are_in_any_orientation(turn: float, blur_px: float) -> None:
    pose = pose_of(BOARD, CAMERA, 32.0, (0.0, 0.0, turn))
    pose = RigidTransform(POSE.rotation @ pose.rotation, pose.translation_m)
    middle = pose.rotation @ np.array([BOARD.extent_m[:2].mean(), BOARD.extent_m[2:].mean(), 0.0])
    pose = RigidTransform(pose.rotation, np.array([0.0, 0.0, pose.translation_m[2]]) - middle)
    view = find_chessboard(picture(CAMERA, pose, BOARD, blur_px=blur_px), BOARD.target, "a", SENSOR.full_scale)
    error, whitened = errors(CAMERA, pose, BOARD, view)
    assert len(view.index) == 54
    assert np.abs(error).max() < 0.025
    assert 0.75 < whitened.std() < 1.3
    assert abs(view.blur_px - blur_px) < 0.05 * blur_px + 0.02


@pytest.mark.parametrize("size", [(8, 6), (6, 6), (7, 7)])
def test_symmetric_boards_are_taken_upright(size: tuple[int, int]) -> None:
    board = chessboard(size)
    pose = pose_of(board, CAMERA, 34.0, (0.3, 0.3, -0.3))
    view = find_chessboard(picture(CAMERA, pose, board), board.target, "a", SENSOR.full_scale)
    assert np.abs(errors(CAMERA, pose, board, view)[0]).max() < 0.02


# ChArUco boards: truth from rendered pictures, both patterns, partial views, reasons of refusal.

CHARUCO = charuco()
CHARUCO_POSE = pose_of(CHARUCO, CAMERA, 40.0, (0.4, -0.3, 0.2))


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", slow("DICT_6X6_250"), slow("DICT_APRILTAG_36h11")])
@pytest.mark.parametrize("legacy", [False, True])
def test_corners_of_both_patterns_without_naming_the_dictionary(dictionary: str, legacy: bool) -> None:
    board = charuco(dictionary=dictionary, legacy=legacy)
    target = dataclasses.replace(board.target, dictionary=None)
    view = find_charuco(picture(CAMERA, CHARUCO_POSE, board), target, "a", SENSOR.full_scale)
    error, whitened = errors(CAMERA, CHARUCO_POSE, board, view)
    assert len(view.index) == 40
    assert np.abs(error).max() < 0.015
    assert 0.75 < whitened.std() < 1.3


@pytest.mark.parametrize(("share", "blur_px"), [(0.5, 0.7), (0.75, 1.2)])
def test_the_size_of_the_markers_plays_no_part(share: float, blur_px: float) -> None:
    board = dataclasses.replace(CHARUCO, marker_share=share)
    view = find_charuco(picture(CAMERA, CHARUCO_POSE, board, blur_px=blur_px), CHARUCO.target, "a", SENSOR.full_scale)
    error, whitened = errors(CAMERA, CHARUCO_POSE, board, view)
    assert np.abs(error.mean(axis=0)).max() < 0.003
    assert whitened.std() < 1.35


@pytest.mark.parametrize("legacy", [False, True])
def test_a_part_of_the_board_is_enough(legacy: bool) -> None:
    board = charuco(legacy=legacy)
    pose = pose_of(board, CAMERA, 44.0, (0.2, -0.2, 0.1), shift_px=220.0)
    view = find_charuco(picture(CAMERA, pose, board), board.target, "a", SENSOR.full_scale)
    assert 10 < len(view.index) < 40
    assert np.abs(errors(CAMERA, pose, board, view)[0]).max() < 0.02


BLANK = np.tile(np.arange(640.0) % 7 * 300, (480, 1))
HALF_OUTSIDE = pose_of(BOARD, CAMERA, 36.0, (0.2, -0.2, 0.1), shift_px=260.0)


@pytest.mark.parametrize(
    ("board", "reason", "change"),
    [
        (BOARD, "overexposed", lambda image: np.minimum(image * 2.0, SENSOR.full_scale)),
        (CHARUCO, "overexposed", lambda image: np.minimum(image * 2.0, SENSOR.full_scale)),
        (BOARD, "underexposed", lambda image: image * 0.02),
        (CHARUCO, "underexposed", lambda image: image * 0.02),
        (BOARD, "blurred", lambda image: gaussian_filter(image.astype(float), 6.0)),
        (CHARUCO, "blurred", lambda image: gaussian_filter(image.astype(float), 5.0)),
        (CHARUCO, "mirrored", lambda image: image[:, ::-1]),
        (BOARD, "no chessboard", lambda _: BLANK),
        (BOARD, "runs over the edge", lambda _: picture(CAMERA, HALF_OUTSIDE, BOARD)),
        (BOARD, ".", lambda _: picture(CAMERA, POSE, charuco((10, 7)))),
    ],
)
def test_bad_pictures_are_refused_with_the_reason(board: Board, reason: str, change) -> None:
    image = change(picture(CAMERA, POSE if board is BOARD else CHARUCO_POSE, board)).astype(np.uint16)
    with pytest.raises(TargetNotFound, match=reason):
        find_target(image, board.target, "a", SENSOR.full_scale)


@pytest.mark.parametrize(
    ("board", "reason", "change"),
    [
        *((BOARD, "another target", {"size": size}) for size in ((8, 5), (11, 6))),
        *(slow(BOARD, "another target", {"size": size}) for size in ((10, 7), (9, 5), (7, 5))),
        *((CHARUCO, "another target", {"size": size}) for size in ((7, 5), (11, 8), (9, 4))),
        (CHARUCO, "no markers", {"dictionary": "DICT_6X6_50"}),
    ],
)
def test_another_board_is_told(board: Board, reason: str, change: dict[str, object]) -> None:
    image = picture(CAMERA, POSE if board is BOARD else CHARUCO_POSE, board)
    with pytest.raises(TargetNotFound, match=reason):
        find_target(image, dataclasses.replace(board.target, **change), "a", SENSOR.full_scale)


def test_an_unknown_dictionary_is_a_wrong_call() -> None:
    target = dataclasses.replace(CHARUCO.target, dictionary="4X4")
    with pytest.raises(ValueError, match="DICT_4X4_50"):
        find_charuco(picture(CAMERA, CHARUCO_POSE, CHARUCO), target, "a", SENSOR.full_scale)
