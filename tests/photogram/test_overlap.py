"""Noise that overlapping subsets share, by registration of noisy images and by Monte Carlo of the rigid fit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from photogram.bspline import spline_of_image
from photogram.camera import Points
from photogram.motion import fit_motion, overlap_correlation
from photogram.subsets.icgn import register
from photogram.subsets.reference import prepare_reference


def test_correlation_of_registered_subsets_is_their_shared_area(make_texture) -> None:  # type: ignore[no-untyped-def]
    """Subsets 7 px apart, 21 px wide: pairs by displacement, pooled over places and 120 noisy images."""
    rng, radius, step = np.random.default_rng(1), 10, 7
    image = 2000 + 500 * make_texture(seed=1, s=1.3, waves=80).image((110, 96))
    centres = np.array([(x, y) for y in range(14, 83, step) for x in range(14, 97, step)], dtype=float)
    reference = prepare_reference(spline_of_image(image), centres, radius)
    found = [
        register(
            reference,
            spline_of_image(image + rng.normal(0, 12, image.shape)),
            np.zeros((len(centres), 6)),
            30,
            1e-5,
            0.75,
        )
        for _ in range(120)
    ]
    moved = np.array([here.warp[:, [0, 3]] for here in found])
    expected = overlap_correlation(centres, radius).toarray()
    apart = np.abs(centres[:, None] - centres[None])
    correlation = np.mean([np.corrcoef(moved[:, :, i].T) for i in range(2)], axis=0)
    for across, down in ((step, 0), (0, step), (step, step), (2 * step, 0), (2 * step, step), (3 * step, 0)):
        pairs = (apart[..., 0] == across) & (apart[..., 1] == down)
        assert correlation[pairs].mean() == pytest.approx(expected[pairs].mean(), abs=0.06)
        assert np.ptp(expected[pairs]) < 1e-12


def test_scatter_of_a_rigid_fit_is_stated_with_the_correlation_and_not_without() -> None:
    """White noise of the pixels averaged over the subsets moves the points; three times overlap in both directions."""
    rng, radius, step, pixel = np.random.default_rng(2), 10, 7, 1e-4
    side = 2 * radius + 1
    rows, columns = np.mgrid[10:100:step, 10:120:step]
    centres = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    reference = np.column_stack([centres * pixel, 1e-3 * np.sin(centres[:, 0])])
    root = np.array([[1.0, 0, 0], [0.2, 0.9, 0], [0.3, -0.4, 3.0]]) * 1e-7
    frames = 300
    noise = np.empty((frames, len(centres), 3))
    for k in range(frames):
        field = [ndimage.uniform_filter(rng.normal(size=(110, 130)), side) * side for _ in range(3)]
        noise[k] = np.stack([part[rows, columns].ravel() for part in field], axis=1) @ root.T
    covariance = np.broadcast_to(root @ root.T, (frames, len(centres), 3, 3))
    points = Points(reference + noise, covariance, np.zeros((frames, len(centres))))
    origin = reference.mean(axis=0)
    plain = fit_motion(points, reference, origin)
    aware = fit_motion(points, reference, origin, overlap_correlation(centres, radius))
    np.testing.assert_array_equal(plain.pose, aware.pose)
    scatter = np.std(plain.pose, axis=0)
    stated = [np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2).mean(axis=0)) for motion in (plain, aware)]
    np.testing.assert_allclose(scatter / stated[1], 1.0, atol=0.1)
    assert np.all(scatter / stated[0] > 2.4)


def test_side_by_side_nothing_is_shared() -> None:
    centres = np.array([(x, y) for y in range(10, 80, 21) for x in range(10, 90, 21)], dtype=float)
    np.testing.assert_array_equal(overlap_correlation(centres, 10).toarray(), np.eye(len(centres)))


def test_correlation_is_one_of_noise() -> None:
    """Symmetric, unit diagonal, positive semidefinite, and blind to missing subsets."""
    centres = np.random.default_rng(3).uniform(20, 90, (60, 2))
    centres[7] = np.nan
    matrix = overlap_correlation(centres, 8).toarray()
    np.testing.assert_array_equal(matrix, matrix.T)
    np.testing.assert_array_equal(np.diag(matrix), 1.0)
    assert np.linalg.eigvalsh(matrix).min() > -1e-12
    assert np.count_nonzero(matrix[7]) == 1


def test_independent_points_are_those_of_the_identity() -> None:
    rng = np.random.default_rng(4)
    reference = rng.normal(size=(12, 3))
    covariance = np.broadcast_to(1e-6 * np.diag([1.0, 2.0, 9.0]), (3, 12, 3, 3))
    position = reference + 1e-3 * rng.normal(size=(3, 12, 3))
    position[1, 4] = np.nan
    points = Points(position, covariance, np.zeros((3, 12)))
    plain = fit_motion(points, reference, np.zeros(3))
    apart = fit_motion(points, reference, np.zeros(3), overlap_correlation(100.0 * reference[:, :2], 1))
    np.testing.assert_allclose(apart.covariance, plain.covariance, rtol=1e-9)


def test_wrong_calls_are_named() -> None:
    with pytest.raises(ValueError, match="radius_px: expected at least 1, found 0"):
        overlap_correlation(np.zeros((3, 2)), 0)
    points = Points(np.eye(3)[None], np.eye(3) * np.ones((1, 3, 1, 1)), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="correlation: expected a matrix of 3 points"):
        fit_motion(points, None, np.zeros(3), overlap_correlation(np.zeros((2, 2)), 3))
