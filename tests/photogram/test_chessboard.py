"""Chessboards: truth from rendered pictures, orientation, and every reason for which a picture is refused."""

from __future__ import annotations

import numpy as np
import pytest
from board_pictures import SENSOR, camera_of, charuco, chessboard, errors, picture, pose_of
from scipy.ndimage import gaussian_filter

from photogram.geometry import RigidTransform
from photogram.targets.chessboard import find_chessboard
from photogram.targets.view import Target, TargetNotFound

CAMERA = camera_of()
BOARD = chessboard()
POSE = pose_of(BOARD, CAMERA, 36.0, (0.4, -0.3, 0.2))


@pytest.mark.parametrize("turn", [0.0, 1.2, 2.5, -1.5])
@pytest.mark.parametrize("blur_px", [0.7, 2.0])
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


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("overexposed", lambda image: np.minimum(image * 2.0, SENSOR.full_scale)),
        ("underexposed", lambda image: image * 0.02),
        ("blurred", lambda image: gaussian_filter(image.astype(float), 6.0)),
        ("no chessboard", lambda image: np.roll(image, 3, axis=1) * 0 + np.arange(640.0) % 7 * 300),
    ],
)
def test_bad_pictures_are_refused_with_the_reason(reason: str, change) -> None:  # type: ignore[no-untyped-def]
    image = change(picture(CAMERA, POSE, BOARD)).astype(np.uint16)
    with pytest.raises(TargetNotFound, match=reason):
        find_chessboard(image, BOARD.target, "a", SENSOR.full_scale)


def test_half_outside_is_told() -> None:
    pose = pose_of(BOARD, CAMERA, 36.0, (0.2, -0.2, 0.1), shift_px=260.0)
    with pytest.raises(TargetNotFound, match="runs over the edge"):
        find_chessboard(picture(CAMERA, pose, BOARD), BOARD.target, "a", SENSOR.full_scale)


@pytest.mark.parametrize("size", [(8, 5), (10, 7), (9, 5), (7, 5), (11, 6)])
def test_another_board_is_told(size: tuple[int, int]) -> None:
    target = Target("chessboard", BOARD.target.spacing_m, size)
    with pytest.raises(TargetNotFound, match="another target"):
        find_chessboard(picture(CAMERA, POSE, BOARD), target, "a", SENSOR.full_scale)


def test_a_charuco_board_is_no_chessboard() -> None:
    board = charuco((10, 7))
    with pytest.raises(TargetNotFound):
        find_chessboard(picture(CAMERA, POSE, board), BOARD.target, "a", SENSOR.full_scale)
