"""Sub-pixel corners: bias without noise, scatter against the stated covariance, OpenCV's refinement as a peer."""

from __future__ import annotations

import numpy as np
import pytest
from board_pictures import SENSOR, camera_of, chessboard, picture, pose_of, truth_px

from photogram.arrays import FloatArray
from photogram.images import NoiseModel
from photogram.synthetic.board import render_board
from photogram.targets.chessboard import lattice_bend
from photogram.targets.crossing import NO_CROSSING, OUTSIDE, SATURATED, refine_corners
from photogram.targets.view import picture_noise

NOISE = NoiseModel(36.0, 0.125)


def _axes(camera: object, pose: object, board: object, index: FloatArray) -> FloatArray:
    half = 0.5 * np.eye(2)
    return np.stack(
        [truth_px(camera, pose, board, index + h) - truth_px(camera, pose, board, index - h) for h in half], axis=1
    )  # type: ignore[arg-type]


@pytest.mark.parametrize("blur_px", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("square_px", [16.0, 40.0])
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
