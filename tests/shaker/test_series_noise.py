"""Fits of series with white noise and random walks: explicit least squares, and drawn series."""

import numpy as np
import pytest

from shaker.static_rotation.harmonics import fit_angles
from shaker.static_rotation.series_noise import DriftingFit, coefficient_covariance, find_walks, walk_covariance

TIME = np.linspace(0.0, 1.0, 30)
DESIGN = np.column_stack([np.ones(30), np.cos(7.0 * TIME), TIME])
STEPS = np.concatenate([np.arange(17), np.arange(17)[::-1]]) * np.pi / 8.0


def test_the_fit_is_generalised_least_squares():
    rng, walk = np.random.default_rng(1), np.array([0.0, 40.0])
    reading, covariance = rng.standard_normal((30, 2)), walk_covariance(TIME)
    fit = DriftingFit.of(DESIGN, reading, walk, covariance)
    for c, each in enumerate(walk):
        inverse = np.linalg.inv(np.eye(30) + each * covariance)
        normal = np.linalg.inv(DESIGN.T @ inverse @ DESIGN)
        np.testing.assert_allclose(fit.coefficient[:, c], normal @ DESIGN.T @ inverse @ reading[:, c], atol=1e-9)
        found = coefficient_covariance(fit.spread, np.eye(2)).reshape(3, 2, 3, 2)[:, c, :, c]
        np.testing.assert_allclose(found, normal, atol=1e-9)
        left = reading[:, c] - DESIGN @ fit.coefficient[:, c]
        assert fit.noise[c, c] == pytest.approx(left @ inverse @ left / 27.0)


def test_random_walks_are_found_where_they_are():
    rng, covariance = np.random.default_rng(2), walk_covariance(TIME)
    none, white, walking = np.zeros(6), [], []
    for _ in range(100):
        noise = rng.standard_normal((30, 6))
        walk = np.cumsum(rng.standard_normal((30, 6)), axis=0)
        white.append(find_walks(DESIGN, noise, covariance, none) > 0.0)
        walking.append(find_walks(DESIGN, noise + walk, covariance, none) > 0.0)
    assert np.mean(white) < 0.03
    assert np.mean(np.any(white, axis=1)) < 0.12
    assert np.mean(walking) > 0.75
    assert not find_walks(DESIGN, np.zeros((30, 1)), covariance, np.zeros(1)).any()
    assert not find_walks(DESIGN[:8], walk[:8], covariance[:8, :8], none).any()


def test_the_walk_of_a_head_widens_the_first_harmonic_to_its_scatter():
    rng, square, stated, found = np.random.default_rng(3), [], [], 0
    for _ in range(60):
        walk = np.cumsum(3e-3 * rng.standard_normal((34, 2)), axis=0)
        values = np.stack([np.cos(STEPS), np.sin(STEPS)], axis=1) + walk + 1e-3 * rng.standard_normal((34, 2))
        fit = fit_angles(("Fx", "Fy"), STEPS, values)
        square.append(abs(fit.amplitude() - [1.0, -1.0j]) ** 2)
        stated.append(np.diag(fit.covariance()).reshape(2, 2).sum(axis=0))
        found += bool(fit.walk.any())
    assert found > 40
    assert np.sqrt(np.mean(stated) / np.mean(square)) == pytest.approx(1.0, abs=0.3)
