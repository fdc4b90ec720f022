"""Dot grids in rendered pictures: every dot at its place, and a clear answer where there is no grid to use."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from photogram.camera import Camera
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.board import Board, render_board
from photogram.targets.dots import find_dots
from photogram.targets.view import Target, TargetNotFound, TargetView

SIZE = (800, 640)
CAMERA = Camera.from_parameters(np.array([1500.0, 1500, 402, 317, -0.15, 0.1, 0, 0, 0]), np.array(SIZE))
SPACING_M = 4e-3
RINGS = Board(Target("dots", SPACING_M), radius=0.22, rings=(5, 3), hole=0.09, lattice=(-3, 8, -3, 6))
PLAIN = Board(Target("dots", SPACING_M, (9, 6)), radius=0.25)
ASYMMETRIC = Board(Target("asymmetric-dots", SPACING_M, (4, 11)), radius=0.35)
FACING_UP = np.diag([1.0, -1, -1])


def pose(board: Board, turn: float = 0.0, tilt: float = 0.0, distance_m: float = 0.16) -> RigidTransform:
    """Camera-from-target with the board's middle on the axis, tilted about its y axis, then turned in the picture."""
    upright = FACING_UP if board.rings else np.eye(3)
    rotation = rotation_from_vector(np.array([0, 0, turn])) @ rotation_from_vector(np.array([0, tilt, 0])) @ upright
    middle = (board.points_m.min(axis=0) + board.points_m.max(axis=0)) / 2
    return RigidTransform(rotation, np.array([0, 0, distance_m]) - rotation @ middle)


def picture(board: Board, where: RigidTransform, noise: float = 1.0, blur_px: float = 0.8) -> np.ndarray:
    grey = 255 * render_board(CAMERA, where, board, blur_px=blur_px)
    return np.clip(np.rint(grey + np.random.default_rng(0).normal(0, noise, grey.shape)), 0, 255).astype(np.uint8)


def find(image: np.ndarray, board: Board) -> TargetView:
    return find_dots(image, board.target, "a", 255)


def off_px(view: TargetView, where: RigidTransform) -> np.ndarray:
    """How far (N,) the seen centres lie off the images of the dots' centres, which perspective hardly moves here."""
    points = np.column_stack([view.index, np.zeros(len(view.index))]) * SPACING_M
    return np.linalg.norm(CAMERA.project(where.apply(points)) - view.position_px, axis=1)


@pytest.mark.parametrize("board", [RINGS, PLAIN, ASYMMETRIC])
@pytest.mark.parametrize("tilt", [0.0, 0.5, -0.87])
def test_every_dot_is_found_at_its_place(board: Board, tilt: float) -> None:
    where = pose(board, turn=0.2, tilt=tilt, distance_m=0.19)
    view = find(picture(board, where), board)
    assert set(map(tuple, view.index.tolist())) >= set(map(tuple, board.index.astype(int).tolist())) or board.rings
    assert len(view.index) >= (0.95 * len(board.index) if tilt > -0.8 else 50 if board.rings else len(board.index))
    assert off_px(view, where).max() < 0.35
    assert view.radius == pytest.approx(board.radius, rel=0.02)
    assert view.blur_px == pytest.approx(np.hypot(0.8, np.sqrt(1 / 12)), rel=0.25)


def test_centres_are_right_to_a_hundredth_of_a_pixel_where_perspective_is_absent() -> None:
    where = pose(RINGS, turn=0.3)
    view = find(picture(RINGS, where, noise=0.5), RINGS)
    assert off_px(view, where).max() < 0.03
    assert np.sqrt((off_px(view, where) ** 2).mean()) < 0.015


@settings(deadline=None, max_examples=6)
@given(turn=st.floats(-np.pi, np.pi), tilt=st.floats(-0.6, 0.6))
def test_rings_name_the_dots_at_any_turn(turn: float, tilt: float) -> None:
    where = pose(RINGS, turn, tilt)
    view = find(picture(RINGS, where), RINGS)
    assert len(view.index) > 60
    assert off_px(view, where).max() < 0.35


def test_arms_of_equal_length_are_told_apart_by_handedness() -> None:
    board = Board(Target("dots", SPACING_M), radius=0.22, rings=(4, 4), hole=0.09, lattice=(-2, 6, -2, 6))
    for turn in (0.0, 2.0):
        where = pose(board, turn, 0.3, 0.2)
        assert off_px(find(picture(board, where), board), where).max() < 0.35


def test_plain_grid_runs_to_the_right() -> None:
    for turn in (0.4, np.pi - 0.4):
        view = find(picture(PLAIN, pose(PLAIN, turn)), PLAIN)
        along = view.position_px[view.index[:, 0] == 8].mean(axis=0) - view.position_px[view.index[:, 0] == 0].mean(
            axis=0
        )
        down = view.position_px[view.index[:, 1] == 5].mean(axis=0) - view.position_px[view.index[:, 1] == 0].mean(
            axis=0
        )
        assert along[0] > 0
        assert along[0] * down[1] - along[1] * down[0] > 0


def test_asymmetric_grid_agrees_with_opencv() -> None:
    import cv2

    image = picture(ASYMMETRIC, pose(ASYMMETRIC, 0.1, 0.2))
    found, centres = cv2.findCirclesGrid(image, (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    view = find(image, ASYMMETRIC)
    place = {tuple(index): position for index, position in zip(view.index.tolist(), view.position_px, strict=True)}
    ours = np.array([place[(2 * i + j % 2, j)] for j in range(11) for i in range(4)])
    assert np.linalg.norm(ours - centres.reshape(-1, 2), axis=1).max() < 0.5


def test_asymmetric_grid_of_odd_rows_has_one_labelling() -> None:
    where = pose(ASYMMETRIC, 2.5)
    assert off_px(find(picture(ASYMMETRIC, where), ASYMMETRIC), where).max() < 0.1


def test_bright_dots_on_a_dark_plate() -> None:
    where = pose(RINGS, 1.0)
    assert off_px(find(255 - picture(RINGS, where), RINGS), where).max() < 0.1


def test_missing_dots_dirt_and_falling_light_do_no_harm() -> None:
    where = pose(RINGS, 0.1, 0.3)
    image = picture(RINGS, where).astype(float)
    y, x = np.indices(image.shape)
    rng = np.random.default_rng(4)
    for centre in CAMERA.project(where.apply(SPACING_M * np.array([[1.0, 1, 0], [2, -1, 0], [-1, 3, 0], [3, 2, 0]]))):
        image[np.hypot(x - centre[0], y - centre[1]) < 16] = 200
    for centre in rng.uniform(50, 600, (60, 2)):
        image[np.hypot(x - centre[0], y - centre[1]) < rng.uniform(1, 3)] *= 0.5
    image *= 0.3 + 0.7 * x / SIZE[0]
    view = find(np.clip(image, 0, 255).astype(np.uint8), RINGS)
    assert not {(1, 1), (2, -1), (-1, 3), (3, 2)} & set(map(tuple, view.index.tolist()))
    assert len(view.index) > 60
    assert np.quantile(off_px(view, where), 0.8) < 0.2


def test_twelve_bits_are_used() -> None:
    where = pose(RINGS, 0.1)
    image = (16 * render_board(CAMERA, where, RINGS) * 255).astype(np.uint16)
    assert off_px(find_dots(image, RINGS.target, "a", 4095), where).max() < 0.03


def refusal(image: np.ndarray, target: Target) -> str:
    with pytest.raises(TargetNotFound) as caught:
        find_dots(image, target, "a", 255)
    return str(caught.value)


@pytest.mark.parametrize("turn", [0.0, 1.0, 3.0])
def test_mirrored_rings_are_refused(turn: float) -> None:
    assert "mirrored" in refusal(picture(RINGS, pose(RINGS, turn))[:, ::-1], RINGS.target)


def test_mirrored_asymmetric_grid_of_even_rows_is_refused() -> None:
    board = Board(Target("asymmetric-dots", SPACING_M, (5, 8)), radius=0.3)
    assert "mirrored" in refusal(picture(board, pose(board))[:, ::-1], board.target)


def test_rings_without_an_origin_are_refused() -> None:
    image = picture(RINGS, pose(RINGS))
    assert "ring markers, expected three" in refusal(image[:, 380:], RINGS.target)


def test_grid_without_rings_asks_for_its_size() -> None:
    assert "give the number of dots" in refusal(picture(PLAIN, pose(PLAIN)), Target("dots", SPACING_M))


@pytest.mark.parametrize("board", [PLAIN, ASYMMETRIC])
def test_half_a_grid_is_refused(board: Board) -> None:
    image = picture(board, pose(board, distance_m=0.12))
    assert "runs over the edge of the picture" in refusal(image[:, :420], board.target)


def test_another_size_is_refused() -> None:
    assert "expected 7 x 5" in refusal(picture(PLAIN, pose(PLAIN)), Target("dots", SPACING_M, (7, 5)))


def test_an_empty_picture_is_refused() -> None:
    noise = np.random.default_rng(0).normal(120, 3, SIZE[::-1]).astype(np.uint8)
    assert refusal(noise, RINGS.target)
    assert refusal(np.full(SIZE[::-1], 120, dtype=np.uint8), RINGS.target)


def test_a_blurred_picture_is_refused() -> None:
    assert "blurred" in refusal(picture(RINGS, pose(RINGS), blur_px=6.0), RINGS.target)


def test_an_overexposed_picture_is_refused() -> None:
    image = np.clip(1.6 * picture(RINGS, pose(RINGS)).astype(float), 0, 255).astype(np.uint8)
    assert "overexposed" in refusal(image, RINGS.target)


@pytest.mark.parametrize(
    "board",
    [
        Board(Target("chessboard", SPACING_M, (9, 6))),
        Board(Target("charuco", SPACING_M, (9, 7), "DICT_4X4_50")),
    ],
)
def test_another_target_is_refused(board: Board) -> None:
    image = picture(board, pose(board, 0.1))
    for target in (RINGS.target, PLAIN.target):
        assert refusal(image, target)


def test_speckle_is_refused() -> None:
    field = gaussian_filter(np.random.default_rng(1).normal(size=SIZE[::-1]), 3.0)
    assert refusal(np.where(field > 0, 200, 30).astype(np.uint8), RINGS.target)
