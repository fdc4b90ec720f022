"""Rendered targets: against OpenCV's own drawing, a brute-force aperture, and the geometry they promise."""

from __future__ import annotations

import numpy as np
import pytest
from board_pictures import SPACING_M, camera_of, charuco, chessboard, pose_of, truth_px

from photogram.camera import Camera
from photogram.geometry import RigidTransform
from photogram.synthetic.board import Board, random_poses, random_rig, render_board
from photogram.targets.view import Target


@pytest.mark.parametrize(("rows", "legacy"), [(6, False), (6, True), (5, True)])
def test_charuco_is_the_one_of_opencv(rows: int, legacy: bool) -> None:
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
def test_aperture_is_the_mean_over_the_pixel(kind: str) -> None:
    camera, fine = camera_of(300.0, (80, 60)), 5
    board = chessboard((3, 2)) if kind == "chessboard" else Board(Target("dots", SPACING_M, (4, 3)))
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


def test_chessboard_is_point_symmetric_about_a_corner() -> None:
    size = np.array([41, 41])
    camera = Camera.from_parameters(np.array([1000.0, 1000, 20, 20, 0, 0, 0, 0, 0]), size)
    pose = RigidTransform(np.eye(3), np.array([-4 * SPACING_M, -3 * SPACING_M, 1000 * SPACING_M / 18]))
    image = render_board(camera, pose, chessboard(), 1.0, falloff=0.0)
    np.testing.assert_allclose(image, image[::-1, ::-1], atol=1e-12)


def test_rings_stand_where_they_should() -> None:
    board = Board(Target("dots", SPACING_M), rings=(5, 3))
    camera = camera_of()
    pose = pose_of(board, camera, 28.0, (np.pi, 0.0, 0.0))
    image = render_board(camera, pose, board, 0.7)
    index = np.array([[0, 0], [5, 0], [0, 3], [1, 0], [0, 1]])
    x, y = np.rint(truth_px(camera, pose, board, index)).astype(int).T
    assert (image[y[:3], x[:3]] > 0.5).all()
    assert (image[y[3:], x[3:]] < 0.2).all()
    assert x[1] > x[0]
    assert y[2] < y[0]


def test_random_sessions_show_the_whole_board() -> None:
    rng = np.random.default_rng(3)
    board = chessboard()
    for _ in range(5):
        rig = random_rig(rng, np.array([640, 480]), 0.055)
        for pose in random_poses(rng, rig, board, 6):
            left, right = rig.project(pose.apply(board.points_m))
            for pixels in (left, right):
                assert ((pixels > 0) & (pixels < [639, 479])).all()


def test_a_board_that_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(ValueError, match="dictionary"):
        Board(Target("charuco", SPACING_M, (9, 6)))
    with pytest.raises(ValueError, match="rings"):
        Board(Target("dots", SPACING_M))
    with pytest.raises(ValueError, match="blur_px"):
        render_board(camera_of(), pose_of(chessboard(), camera_of(), 30.0, (0.0, 0.0, 0.0)), chessboard(), 0.1)
    rig = random_rig(np.random.default_rng(0), np.array([640, 480]), 0.02)
    with pytest.raises(ValueError, match="fits into both"):
        random_poses(np.random.default_rng(0), rig, chessboard(), 1)
