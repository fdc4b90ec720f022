"""Parts of chessboards: their place on the board by the other camera's view of the whole one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from photogram.calibration.initial_bundle import number_partial
from photogram.camera import StereoRig
from photogram.synthetic.board import random_poses, random_rig, simulate_session
from photogram.synthetic.patterns import Board
from photogram.targets.target_view import Target, TargetView


def part_of(view: TargetView, rng: np.random.Generator, size: tuple[int, int]) -> TargetView:
    """A random rectangle of at least 3 x 3 corners, counted from its first corner in one of four directions.

    As the search does it, the square beyond a corner whose numbers have an even sum is black.
    """
    low = [rng.integers(0, n - 2) for n in size]
    high = [rng.integers(a + 3, n + 1) for a, n in zip(low, size, strict=True)]
    inside = ((view.index >= low) & (view.index < high)).all(axis=1)
    index = view.index[inside] - low
    quarters = int(rng.integers(4))
    for _ in range(quarters):
        index = np.column_stack([index[:, 1].max() - index[:, 1], index[:, 0]])
    if (int(index[0].sum()) - int(view.index[inside][0].sum()) - quarters) % 2:
        index[:, 0] += 1
    covariance = view.covariance_px2[inside]
    return replace(view, index=index, position_px=view.position_px[inside], covariance_px2=covariance, is_partial=True)


@pytest.mark.parametrize("size", [(9, 6), (8, 6), (6, 6), (7, 7)])
def test_a_part_gets_its_numbers_back_or_none(size):
    """Of eight random parts of each board none is numbered wrongly, up to the board's own symmetry, and most are."""
    rng, board = np.random.default_rng(sum(size)), Board(Target("chessboard", 9e-3, size))
    right_ones = 0
    rig = random_rig(rng, np.array([1280, 1024]), field_m=0.15)
    for left, right in simulate_session(rng, rig, random_poses(rng, rig, board, 8), board, noise_px=0.05):
        is_left = bool(rng.integers(2))
        part = part_of(left if is_left else right, rng, size)
        found = number_partial(rig, board.target, *((part, right) if is_left else (left, part)))
        numbered, truth = (found[0], left) if is_left else (found[1], right)
        if numbered is None:
            continue
        where = {tuple(place): position for place, position in zip(truth.index, truth.position_px, strict=True)}
        assert all(
            np.array_equal(where[tuple(i)], p) for i, p in zip(numbered.index, numbered.position_px, strict=True)
        )
        assert not numbered.is_partial
        right_ones += 1
    assert right_ones >= 7


def test_parts_in_both_images_or_in_one_alone_stay_without_numbers():
    rng, board = np.random.default_rng(1), Board(Target("chessboard", 9e-3, (9, 6)))
    rig: StereoRig = random_rig(rng, np.array([1280, 1024]), field_m=0.15)
    ((left, right),) = simulate_session(rng, rig, random_poses(rng, rig, board, 1), board, noise_px=0.05)
    one, other = part_of(left, rng, (9, 6)), part_of(right, rng, (9, 6))
    assert number_partial(rig, board.target, one, other) == (None, None)
    assert number_partial(rig, board.target, one, None) == (None, None)
    assert number_partial(rig, board.target, None, other) == (None, None)
    assert number_partial(rig, board.target, left, right) == (left, right)
