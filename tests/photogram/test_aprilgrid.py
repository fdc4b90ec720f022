"""AprilGrids and ChArUco boards with other first numbers: corners of boards drawn tag by tag, and what is refused."""

from __future__ import annotations

import dataclasses
from functools import cache

import cv2
import numpy as np
import pytest
from board_images import SENSOR, camera_of, pose_of
from contracts import refused, slow

from photogram.calibration.session import calibrate_pair
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.board import random_poses, random_rig, render_board, simulate_session
from photogram.synthetic.patterns import Board
from photogram.targets.find_target import find_target
from photogram.targets.target_view import Target, TargetNotFound

TAG_M, GAP = 0.02, 0.3
TARGET = Target("aprilgrid", TAG_M, (6, 4), tag_spacing=GAP)
FACING = np.diag([1.0, -1.0, -1.0])  # of a board with z towards the viewer and y up
CAMERA = camera_of(1100.0, (800, 600))


def corner_m(index: np.ndarray, tag_m: float = TAG_M, gap: float = GAP) -> np.ndarray:
    """Kalibr's aprilgrid: tags of `tag_m`, `gap`·`tag_m` apart, four corners each, from the lower left."""
    return np.array(
        [[i // 2 * tag_m * (1 + gap) + i % 2 * tag_m, j // 2 * tag_m * (1 + gap) + j % 2 * tag_m, 0] for i, j in index]
    )


def canvas(columns: int, rows: int, bits: int, downward: bool = False, turns: int = 0, squares: bool = True):
    """A board drawn at 10 px a bit, its upper left corner and px per tag: Kalibr's tags begin at the lower left."""
    dictionary, side = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 10 * (6 + 2 * bits)
    gap = round(GAP * side)
    height, width = (count * (side + gap) + gap + 2 * side for count in (rows, columns))
    image = np.full((height, width), 230, np.uint8)
    for number in range(columns * rows):
        row, column = divmod(number, columns)
        row = row if downward else rows - 1 - row
        y, x = side + gap + row * (side + gap), side + gap + column * (side + gap)
        tag = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=bits)
        image[y : y + side, x : x + side] = np.where(np.rot90(tag, turns) > 0, 230, 20)
        for dy in (-gap, side) if squares else ():
            for dx in (-gap, side):
                image[y + dy : y + dy + gap, x + dx : x + dx + gap] = 20
    return image, float(side + gap), float(side), height - 2 * (side + gap)


def warped(camera: Camera, pose: RigidTransform, drawn, downward: bool = False) -> np.ndarray:
    """What the camera sees of a blurred drawing whose first corner is the target's origin: 2 x 2 rays a pixel."""
    image, start, side, high = drawn
    soft = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.8)
    width, height = camera.size_px
    fine = np.array([-0.25, 0.25])
    x, y = np.meshgrid((np.arange(width)[:, None] + fine).ravel(), (np.arange(height)[:, None] + fine).ravel())
    pixels = np.column_stack([x.ravel(), y.ravel()])
    ray = cv2.undistortPoints(pixels[:, None], camera.matrix, camera.distortion[:5])[:, 0]
    ray = np.column_stack([ray, np.ones(len(ray))])
    normal, origin = pose.rotation[:, 2], pose.translation_m
    point = (ray * ((normal @ origin) / (ray @ normal))[:, None] - origin) @ pose.rotation
    across, up = point[:, 0] / TAG_M * side, point[:, 1] / TAG_M * side
    u, v = start - 0.5 + across, start - 0.5 + (up if downward else high - up)
    maps = (each.reshape(x.shape).astype(np.float32) for each in (u, v))
    seen = cv2.remap(soft, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=90)
    grey = seen.reshape(height, 2, width, 2).mean(axis=(1, 3), dtype=np.float64)
    return SENSOR.digitise(np.clip(grey, 0, 255) / 255 * 0.9, np.random.default_rng(1))


def placed(turn: tuple[float, float, float], tag_px: float, facing: np.ndarray = FACING, shift: float = 0.0):
    rotation = facing @ rotation_from_vector(np.array(turn))
    middle = corner_m(np.array([[0, 0], [11, 7]])).mean(axis=0)
    depth = CAMERA.matrix[0, 0] * TAG_M / tag_px
    return RigidTransform(rotation, np.array([shift * depth, 0.0, depth]) - rotation @ middle)


def found(image, target=TARGET):
    return find_target(image, target, "a", SENSOR.full_scale)


@pytest.mark.parametrize(
    ("bits", "turns", "downward", "tag_px"),
    [(2, 2, False, 40), (1, 0, True, 30), *slow((2, 0, False, 60), (1, 1, False, 50))],
)
def test_the_corners_of_tags_are_where_kalibr_says(bits, turns, downward, tag_px):
    """Tags drawn by OpenCV at known places, of either border and any turn, numbered upward or downward."""
    pose = placed((0.35, -0.3, 0.2), tag_px, np.eye(3) if downward else FACING)
    view = found(warped(CAMERA, pose, canvas(6, 4, bits, downward, turns), downward))
    error = view.position_px - CAMERA.project(pose.apply(corner_m(view.index)))
    assert len(view.index) >= 0.95 * 96
    assert np.abs(error.mean(axis=0)).max() < 0.005
    assert np.abs(error).max() < 0.04


def test_a_part_of_an_aprilgrid_is_enough():
    pose = placed((0.2, -0.2, 0.1), 70, shift=0.3)
    view = found(warped(CAMERA, pose, canvas(6, 4, 2)))
    assert 20 < len(view.index) < 80
    error = view.position_px - CAMERA.project(pose.apply(corner_m(view.index)))
    assert np.abs(error).max() < 0.05


@cache
def _upright() -> np.ndarray:
    return warped(CAMERA, placed((0.2, -0.2, 0.1), 60), canvas(6, 4, 2))


@pytest.mark.parametrize(
    ("words", "image", "change"),
    [
        ("^mirrored", lambda: _upright()[:, ::-1], {}),
        ("^another", _upright, {"size": (5, 4)}),
        ("^no markers of an AprilGrid of 6 x 4 tags in DICT_APRILTAG_36h11", lambda: np.full((600, 800), 300), {}),
        ("^no markers", _upright, {"first_id": 100}),
        ("no crossing", lambda: warped(CAMERA, placed((0.2, -0.2, 0.1), 60), canvas(6, 4, 2, squares=False)), {}),
    ],
)
def test_what_is_no_such_aprilgrid_is_refused_with_the_reason(words, image, change):
    seen = np.ascontiguousarray(image()).astype(np.uint16)
    seen[0, 0] = SENSOR.full_scale  # contrast of the blank one
    if seen.max() == SENSOR.full_scale and seen[100].std() == 0:
        seen[::2] += 900
    refused(words, found, seen, dataclasses.replace(TARGET, **change), error=TargetNotFound)


@pytest.mark.parametrize(
    ("words", "stated"),
    [
        ("tag_spacing: .*found none", {"kind": "aprilgrid", "size": (6, 4)}),
        ("tag_spacing: .*found 0.02", {"kind": "aprilgrid", "size": (6, 4), "tag_spacing": 0.02}),
        ("tag_spacing: .*charuco", {"kind": "charuco", "size": (6, 4), "tag_spacing": 0.3}),
        ("size: ", {"kind": "aprilgrid", "tag_spacing": 0.3}),
        ("size: .*20000 points", {"kind": "aprilgrid", "size": (100, 60), "tag_spacing": 0.3}),
        ("dictionary: ", {"kind": "aprilgrid", "size": (6, 4), "tag_spacing": 0.3, "dictionary": "DICT_4X4_50"}),
        ("first_id: ", {"kind": "chessboard", "size": (6, 4), "first_id": 3}),
        ("first_id: ", {"kind": "charuco", "size": (6, 4), "first_id": -1}),
    ],
)
def test_a_target_that_cannot_be_is_a_wrong_call(words, stated):
    refused(words, Target, spacing_m=0.02, **stated)


def test_a_rendered_aprilgrid_is_the_drawn_one():
    """The renderer of the simulations against the drawing: the same pixels are bright."""
    board, pose = Board(TARGET, bright=230 / 255 * 0.9, dark=20 / 255 * 0.9), placed((0.35, -0.3, 0.2), 60)
    rendered = SENSOR.digitise(render_board(CAMERA, pose, board, 0.6, falloff=0.0), None)
    drawn = warped(CAMERA, pose, canvas(6, 4, 2))
    points = CAMERA.project(pose.apply(corner_m(np.array([[0, 0], [11, 0], [11, 7], [0, 7]]))))
    inside = cv2.fillConvexPoly(np.zeros(drawn.shape, np.uint8), points.round().astype(np.int32), 1) > 0
    bright = [image[inside] > 0.45 * SENSOR.full_scale for image in (rendered, drawn)]
    assert (bright[0] != bright[1]).mean() < 0.01


@pytest.mark.parametrize("border", [1, *slow(2)])
def test_the_stated_uncertainty_of_a_tags_corners_is_their_error(border):
    board, pose = Board(TARGET, border=border), placed((0.35, -0.3, 0.2), 50)
    image = SENSOR.digitise(render_board(CAMERA, pose, board, 0.7, slant=0.3), np.random.default_rng(2))
    view = found(image)
    error = view.position_px - CAMERA.project(pose.apply(corner_m(view.index)))
    whitened = np.einsum("nij,nj->ni", np.linalg.inv(np.linalg.cholesky(view.covariance_px2)), error)
    assert len(view.index) == 96
    assert np.abs(error).max() < 0.02
    assert 0.8 < whitened.std() < 1.25


def test_a_pair_is_calibrated_from_an_aprilgrid():
    rng, board = np.random.default_rng(2), Board(TARGET)
    rig = random_rig(rng, np.array([1280, 1024]), field_m=0.2)
    pairs = simulate_session(rng, rig, random_poses(rng, rig, board, 10), board, noise_px=0.02)
    calibration = calibrate_pair(pairs, TARGET)
    assert calibration.rms_px < 0.03
    assert_within(calibration.rig, rig)


def assert_within(rig: StereoRig, truth: StereoRig) -> None:
    off = rig.values - truth.values
    turn = rig.right_from_left.rotation @ truth.right_from_left.rotation.T
    off[18:21] = cv2.Rodrigues(turn)[0].ravel()
    assert rig.covariance is not None
    sigma = np.sqrt(np.diagonal(rig.covariance))
    assert (np.abs(off) <= 4.5 * sigma + 1e-12).all()


# ChArUco boards with other first numbers, several in one image.


@cache
def _boards(firsts: tuple[int, int], size=(7, 5)) -> tuple[np.ndarray, list[RigidTransform], list[Board]]:
    """An image with two boards of different numbers, whose lattices continue each other."""
    boards = [Board(Target("charuco", 3.5e-3, size, "DICT_4X4_100", first_id=first)) for first in firsts]
    camera = camera_of()
    places = [pose_of(board, camera, 24.0, (0.1, 0.1, 0.05), 300 * k - 150) for k, board in enumerate(boards)]
    images = [
        SENSOR.digitise(render_board(camera, *each), np.random.default_rng(0))
        for each in zip(places, boards, strict=True)
    ]
    return np.concatenate([images[0][:, :330], images[1][:, 330:]], axis=1), places, boards


@pytest.mark.parametrize("dictionary", ["DICT_4X4_100", None])
def test_each_of_two_charuco_boards_is_found_by_its_first_number(dictionary):
    image, places, boards = _boards((0, 40))
    camera = camera_of()
    for place, board in zip(places, boards, strict=True):
        view = found(image, dataclasses.replace(board.target, dictionary=dictionary))
        error = view.position_px - camera.project(place.apply(board.target.points_m(view.index)))
        assert len(view.index) == 24
        assert np.abs(error).max() < 0.03
    unstated = dataclasses.replace(boards[0].target, first_id=None)
    assert len(found(image, unstated).index) == 24
    missing = dataclasses.replace(boards[0].target, first_id=70, dictionary="DICT_4X4_100")
    refused("^no markers", found, image, missing, error=TargetNotFound)


def test_two_boards_of_the_same_numbers_stay_refused():
    image, _, boards = _boards((40, 40))
    refused("^two targets", found, image, boards[0].target, error=TargetNotFound)
