"""Ellipses of dots against rendered ones: centres without bias, covariance that holds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from photogram.targets.ellipse import Ellipses, fit_ellipses

OVERSAMPLING = 8
BACKGROUND, CONTRAST = 180.0, -150.0


def ellipse_shape(radius: float, rng: np.random.Generator) -> np.ndarray:
    """S (2, 2) of an ellipse of this mean radius, turned and flattened at random as up to 45° of tilt do."""
    angle, flat = rng.uniform(0, np.pi), rng.uniform(0.7, 1.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ np.diag([radius**2 / flat, radius**2 * flat]) @ turn.T


def render_dot(centre: np.ndarray, shape: np.ndarray, sigma: float, size: int, slope: float = 0.0) -> np.ndarray:
    """Picture (size, size) of one dark ellipse, blurred and averaged over the pixels, by oversampling."""
    fine = (np.arange(size * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    offset = np.stack(np.meshgrid(fine, fine), axis=-1) - centre
    normal = offset @ np.linalg.inv(shape)
    square = np.maximum((normal * offset).sum(axis=-1), 1e-9)
    outside = (square - np.sqrt(square)) / np.linalg.norm(normal, axis=-1)
    covered = np.clip(0.5 - outside * OVERSAMPLING, 0, 1)
    blurred = gaussian_filter(covered, sigma * OVERSAMPLING)
    pixels = blurred.reshape(size, OVERSAMPLING, size, OVERSAMPLING).mean(axis=(1, 3))
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    light = 1 + slope * (x - centre[0]) - 0.5 * slope * (y - centre[1])
    return (BACKGROUND + CONTRAST * pixels) * light


def fit(image: np.ndarray, start: np.ndarray, shape: np.ndarray, ring: bool = False) -> Ellipses:
    return fit_ellipses(image, start[None], 1.1 * shape[None], np.array([30.0]), np.array([ring]))


def dot(radius: float, sigma: float, slope: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    size = int(2.6 * radius + 8 * sigma + 12)
    centre = size / 2 + rng.uniform(-0.5, 0.5, 2)
    shape = ellipse_shape(radius, rng)
    return centre, shape, render_dot(centre, shape, sigma, size, slope)


@pytest.mark.parametrize(
    ("radius", "sigma", "slope"), [(3, 0.7, 0), (5, 1, 0.004), (10, 0.6, 0.005), (30, 2, 0.002), (20, 5, 0)]
)
def test_centre_has_no_bias_at_any_size_and_blur(radius: float, sigma: float, slope: float) -> None:
    for seed in range(6):
        centre, shape, image = dot(radius, sigma, slope, seed)
        found = fit(image, centre + 0.2, shape)
        assert np.abs(found.centre_px[0] - centre).max() < 0.005
        assert found.radius_px[0] == pytest.approx(radius, rel=0.004)
        assert found.blur_px[0] == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.05)
        assert found.contrast[0] == pytest.approx(CONTRAST, rel=0.04)


@pytest.mark.parametrize(("radius", "sigma", "noise"), [(4, 0.8, 1.0), (8, 0.8, 2.0), (20, 2.0, 3.0)])
def test_covariance_is_the_scatter(radius: float, sigma: float, noise: float) -> None:
    rng = np.random.default_rng(1)
    normalised = []
    for seed in range(4):
        centre, shape, image = dot(radius, sigma, 0.0, seed)
        middle = fit(image, centre, shape).centre_px[0]
        for _ in range(100):
            found = fit(image + rng.normal(0, noise, image.shape), centre, shape)
            lower = np.linalg.cholesky(found.covariance_px2[0])
            normalised.append(np.linalg.solve(lower, found.centre_px[0] - middle))
    assert 0.95 < np.std(normalised) < 1.1


def test_covariance_holds_for_shot_noise() -> None:
    rng = np.random.default_rng(2)
    centre, shape, image = dot(9.0, 1.0, 0.0, 3)
    normalised = []
    for _ in range(400):
        found = fit(image + rng.normal(0, 0.25 * np.sqrt(image)), centre, shape)
        normalised.append(np.linalg.solve(np.linalg.cholesky(found.covariance_px2[0]), found.centre_px[0] - centre))
    assert 0.95 < np.std(normalised) < 1.1


def test_ring_is_placed_by_its_outer_edge() -> None:
    centre, shape, image = dot(20.0, 1.2, 0.0, 5)
    hole = render_dot(centre + np.array([1.5, -1.0]), 0.3**2 * shape, 1.2, len(image))
    found = fit(image + (BACKGROUND - hole), centre + 0.3, shape, ring=True)
    assert np.abs(found.centre_px[0] - centre).max() < 0.005


def test_roughness_tells_a_square_from_a_disc() -> None:
    centre, shape, image = dot(15.0, 1.0, 0.0, 7)
    y, x = np.indices(image.shape)
    square = gaussian_filter(
        np.where(np.maximum(abs(x - centre[0]), abs(y - centre[1])) < 13.3, BACKGROUND + CONTRAST, BACKGROUND), 1.0
    )
    round_one, square_one = fit(image, centre, shape), fit(square, centre, 15.0**2 * np.eye(2))
    assert round_one.roughness_px[0] < 0.02
    assert not square_one.roughness_px[0] < 1.0


def test_what_is_no_dot_gives_nan() -> None:
    flat = np.full((40, 40), 100.0)
    found = fit(flat, np.array([20.0, 20.0]), 36.0 * np.eye(2))
    assert np.isnan(found.centre_px).all()
    assert np.isnan(found.covariance_px2).all()


def test_a_start_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="reach_px: expected an array of shape"):
        fit_ellipses(np.zeros((9, 9)), np.zeros((2, 2)), np.ones((2, 2, 2)), np.ones(3), np.zeros(2, dtype=bool))
