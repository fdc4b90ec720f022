"""First guesses: features and affine starts, templates, fields through few points, epipolar distances."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.subsets.search import (
    affine_field,
    affine_starts,
    agreeing,
    epipolar_distance,
    match_features,
    neighbour_starts,
    template_shifts,
    warp_of_affine,
)

MATRIX = np.array([[0.87, 0.02], [-0.05, 1.01]])
SHIFT = np.array([14.0, -6.0])


def warp_at(points: np.ndarray) -> np.ndarray:
    """The warp of x → MATRIX x + SHIFT at each point."""
    warps = np.tile(warp_of_affine(np.column_stack([MATRIX, SHIFT])), (len(points), 1))
    warps[:, [0, 3]] = points @ MATRIX.T + SHIFT - points
    return warps


def test_features_of_speckle_give_affine_starts(make_texture) -> None:  # type: ignore[no-untyped-def]
    texture = make_texture(seed=41, s=1.4, waves=80)
    inverse = np.linalg.inv(MATRIX)
    left = 2000 + 400 * texture.image((240, 200))
    right = 900 + 250 * texture.image((240, 200), lambda p: (p - SHIFT) @ inverse.T)
    noise = np.random.default_rng(41).normal(0, 10, (2, 200, 240))
    source, target = match_features(left + noise[0], right + noise[1])
    assert len(source) > 50
    points = np.array([[100.0, 100.0], [60.0, 120.0], [150.0, 80.0]])
    starts = affine_starts(points, source, target)
    np.testing.assert_allclose(starts[:, [0, 3]], warp_at(points)[:, [0, 3]], atol=0.5)
    np.testing.assert_allclose(starts[:, [1, 2, 4, 5]], warp_at(points)[:, [1, 2, 4, 5]], atol=0.06)


def test_without_features_there_is_no_start() -> None:
    source, target = match_features(np.full((60, 60), 7.0), np.full((60, 60), 7.0))
    assert len(source) == len(target) == 0
    assert np.isnan(affine_starts(np.array([[30.0, 30.0]]), source, target)).all()


def test_neighbours_hand_on_their_affine_map() -> None:
    points = np.array([[10.0, 10.0], [31.0, 10.0], [52.0, 31.0], [np.nan, 3.0]])
    known = warp_at(points)
    known[[1, 2]] = np.nan
    starts = neighbour_starts(points, known)
    np.testing.assert_allclose(starts[:3], warp_at(points[:3]), atol=1e-9)
    assert np.isnan(starts[3]).all()
    assert np.isnan(neighbour_starts(points, np.full((4, 6), np.nan))).all()


def test_templates_are_found_around_the_guess() -> None:
    image = np.random.default_rng(42).normal(size=(120, 140))
    moved = np.roll(image, (7, -11), axis=(0, 1))
    points = np.array([[50.2, 60.0], [90.0, 40.4], [2.0, 2.0]])
    shifts = template_shifts(image, moved, points, 8, 15, np.zeros((3, 2)))
    np.testing.assert_array_equal(shifts[:2], [[-11, 7]] * 2)
    assert np.isnan(shifts[2]).all()


def test_one_affine_motion_passes_through_good_points_only() -> None:
    points = np.random.default_rng(43).uniform(0, 200, (12, 2))
    displacement = points @ MATRIX.T + SHIFT - points
    displacement[3] += 40.0
    displacement[5] = np.nan
    targets = np.array([[10.0, 20.0], [150.0, 170.0]])
    np.testing.assert_allclose(affine_field(points, displacement, targets), warp_at(targets), atol=1e-6)
    few = affine_field(points[:2], displacement[:2], targets)
    np.testing.assert_allclose(few[:, [0, 3]], np.tile(displacement[:2].mean(axis=0), (2, 1)))
    assert np.isnan(affine_field(points, np.full_like(displacement, np.nan), targets)).all()


def test_epipolar_distances_of_shifted_cameras_are_row_differences() -> None:
    """Parallel cameras side by side: F = [t]× with t along x, epipolar lines are rows."""
    fundamental = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    left = np.array([[10.0, 20.0], [30.0, 40.0]])
    distance = epipolar_distance(fundamental, left, left + np.array([5.0, 2.0]))
    np.testing.assert_allclose(np.abs(distance), 2.0)
    assert agreeing(np.array([1.0, 1.5, 9.0, np.nan]), 2.0).tolist() == [True, True, False, False]
    assert not agreeing(np.array([np.nan]), 2.0).any()
    with pytest.raises(ValueError, match="fundamental: expected an array of shape"):
        epipolar_distance(np.eye(2), left, left)
