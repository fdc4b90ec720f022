"""Rendered pictures of targets with known truth, for the tests of their detectors."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.camera import Camera
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.board import render_board
from photogram.synthetic.patterns import Board
from photogram.synthetic.scene import ImageSensor
from photogram.targets.target_view import Target, TargetView
from shakercal._common.arrays import FloatArray

SENSOR = ImageSensor()
SPACING_M = 3.5e-3


def camera_of(focal_px: float = 1500.0, size_px: tuple[int, int] = (640, 480)) -> Camera:
    centre = [size_px[0] / 2 + 3.3, size_px[1] / 2 - 2.1]
    return Camera.from_parameters(
        np.array([focal_px, focal_px, *centre, -0.15, 0.1, 3e-4, -3e-4, 0.02]), np.array(size_px)
    )


def chessboard(size: tuple[int, int] = (9, 6)) -> Board:
    return Board(Target("chessboard", SPACING_M, size))


def charuco(size: tuple[int, int] = (9, 6), dictionary: str = "DICT_4X4_50", legacy: bool = False) -> Board:
    return Board(Target("charuco", SPACING_M, size, dictionary), legacy=legacy)


def pose_of(
    board: Board, camera: Camera, square_px: float, rotation: tuple[float, float, float], shift_px: float = 0.0
) -> RigidTransform:
    """Pose camera_from_target with the board's middle on the axis (or `shift_px` beside it), squares of `square_px`."""
    x0, x1, y0, y1 = board.extent_m
    turned = rotation_from_vector(np.array(rotation))
    depth = camera.matrix[0, 0] * SPACING_M / square_px
    place = np.array([shift_px / camera.matrix[0, 0] * depth, 0.0, depth])
    return RigidTransform(turned, place - turned @ np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0]))


@lru_cache(maxsize=16)
def _rendered(camera: Camera, pose: RigidTransform, board: Board, blur_px: float) -> FloatArray:
    return render_board(camera, pose, board, blur_px, slant=0.3)


def picture(camera: Camera, pose: RigidTransform, board: Board, blur_px: float = 0.7) -> NDArray[Any]:
    return SENSOR.digitise(_rendered(camera, pose, board, blur_px), np.random.default_rng(0))


def truth_px(camera: Camera, pose: RigidTransform, board: Board, index: NDArray[Any]) -> FloatArray:
    points = np.column_stack([index, np.zeros(len(index))]) * board.target.spacing_m
    return camera.project(pose.apply(points))


def errors(camera: Camera, pose: RigidTransform, board: Board, view: TargetView) -> tuple[FloatArray, FloatArray]:
    """Errors (N, 2) in px, and in units of the stated covariance."""
    error = view.position_px - truth_px(camera, pose, board, view.index)
    whitened = np.linalg.solve(np.linalg.cholesky(view.covariance_px2), error[..., None])[..., 0]
    return error, whitened
