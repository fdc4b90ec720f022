"""ChArUco boards: truth from rendered pictures, both patterns, partial views, reasons of refusal."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from board_pictures import SENSOR, camera_of, charuco, errors, picture, pose_of
from scipy.ndimage import gaussian_filter

from photogram.targets.charuco import find_charuco
from photogram.targets.view import Target, TargetNotFound

CAMERA = camera_of()
BOARD = charuco()
POSE = pose_of(BOARD, CAMERA, 40.0, (0.4, -0.3, 0.2))


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_6X6_250", "DICT_APRILTAG_36h11"])
@pytest.mark.parametrize("legacy", [False, True])
def test_corners_of_both_patterns_without_naming_the_dictionary(dictionary: str, legacy: bool) -> None:
    board = charuco(dictionary=dictionary, legacy=legacy)
    target = dataclasses.replace(board.target, dictionary=None)
    view = find_charuco(picture(CAMERA, POSE, board), target, "a", SENSOR.full_scale)
    error, whitened = errors(CAMERA, POSE, board, view)
    assert len(view.index) == 40
    assert np.abs(error).max() < 0.015
    assert 0.75 < whitened.std() < 1.3


@pytest.mark.parametrize(("share", "blur_px"), [(0.5, 0.7), (0.75, 1.2)])
def test_the_size_of_the_markers_plays_no_part(share: float, blur_px: float) -> None:
    board = dataclasses.replace(BOARD, marker_share=share)
    view = find_charuco(picture(CAMERA, POSE, board, blur_px=blur_px), BOARD.target, "a", SENSOR.full_scale)
    error, whitened = errors(CAMERA, POSE, board, view)
    assert np.abs(error.mean(axis=0)).max() < 0.003
    assert whitened.std() < 1.35


@pytest.mark.parametrize("legacy", [False, True])
def test_a_part_of_the_board_is_enough(legacy: bool) -> None:
    board = charuco(legacy=legacy)
    pose = pose_of(board, CAMERA, 44.0, (0.2, -0.2, 0.1), shift_px=220.0)
    view = find_charuco(picture(CAMERA, pose, board), board.target, "a", SENSOR.full_scale)
    assert 10 < len(view.index) < 40
    assert np.abs(errors(CAMERA, pose, board, view)[0]).max() < 0.02


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("mirrored", lambda image: image[:, ::-1]),
        ("overexposed", lambda image: np.minimum(image * 2.0, SENSOR.full_scale)),
        ("underexposed", lambda image: image * 0.02),
        ("blurred", lambda image: gaussian_filter(image.astype(float), 5.0)),
    ],
)
def test_bad_pictures_are_refused_with_the_reason(reason: str, change) -> None:  # type: ignore[no-untyped-def]
    image = change(picture(CAMERA, POSE, BOARD)).astype(np.uint16)
    with pytest.raises(TargetNotFound, match=reason):
        find_charuco(image, BOARD.target, "a", SENSOR.full_scale)


@pytest.mark.parametrize("size", [(7, 5), (11, 8), (9, 4)])
def test_another_board_is_told(size: tuple[int, int]) -> None:
    target = Target("charuco", BOARD.target.spacing_m, size, BOARD.target.dictionary)
    with pytest.raises(TargetNotFound, match="another target"):
        find_charuco(picture(CAMERA, POSE, BOARD), target, "a", SENSOR.full_scale)


def test_another_dictionary_is_told() -> None:
    target = dataclasses.replace(BOARD.target, dictionary="DICT_6X6_50")
    with pytest.raises(TargetNotFound, match="no markers"):
        find_charuco(picture(CAMERA, POSE, BOARD), target, "a", SENSOR.full_scale)


def test_an_unknown_dictionary_is_a_wrong_call() -> None:
    target = dataclasses.replace(BOARD.target, dictionary="4X4")
    with pytest.raises(ValueError, match="DICT_4X4_50"):
        find_charuco(picture(CAMERA, POSE, BOARD), target, "a", SENSOR.full_scale)
