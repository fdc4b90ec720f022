"""The noise model against the simulated sensor, whose noise is written down in its class."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.images import NoiseModel, fit_noise_model, noise_model_of_pair
from photogram.synthetic.scene import ImageSensor

SENSOR = ImageSensor(bit_depth=12, electrons_per_grey=8.0, read_noise_grey=6.0)


def residuals(seed: int, low: float = 0.03, high: float = 0.85, count: int = 200_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(low, high, count)
    stored = SENSOR.digitise(truth, rng).astype(float)
    return truth * SENSOR.full_scale, (stored - truth * SENSOR.full_scale) ** 2


def test_read_and_shot_noise_come_back() -> None:
    model = fit_noise_model(*residuals(1))
    assert model.read_variance_grey2 == pytest.approx(36.0 + 1 / 12, rel=0.05)
    assert model.variance_per_grey == pytest.approx(1 / 8, rel=0.02)
    grey = np.array([[100.0, 1000.0], [2000.0, 3500.0]])
    np.testing.assert_allclose(model.variance(grey), SENSOR.variance(grey), rtol=0.02)


def test_the_fit_is_unbiased() -> None:
    """Mean over 60 small samples; relative weights taken from the scattering bins would pull it down by 2·2/125."""
    grey = np.array([300.0, 3000.0])
    ratio = [fit_noise_model(*residuals(seed, count=4000)).variance(grey) / SENSOR.variance(grey) for seed in range(60)]
    np.testing.assert_allclose(np.mean(ratio, axis=0), 1.0, atol=0.02)


def test_outliers_are_not_noise() -> None:
    grey, squares = residuals(2)
    wrong = np.random.default_rng(3).random(len(squares)) < 0.02
    model = fit_noise_model(grey, np.where(wrong, 300.0**2, squares))
    np.testing.assert_allclose(
        model.variance(np.array([200.0, 3000.0])), SENSOR.variance(np.array([200.0, 3000.0])), rtol=0.06
    )


def test_equal_brightness_gives_a_constant() -> None:
    model = fit_noise_model(*residuals(4, 0.50, 0.52))
    assert model.variance_per_grey == 0.0
    assert model.read_variance_grey2 == pytest.approx(float(SENSOR.variance(np.array(0.51 * 4095))), rel=0.02)


def test_noise_free_images_keep_their_rounding() -> None:
    grey, _ = residuals(5)
    np.testing.assert_array_equal(fit_noise_model(grey, np.zeros_like(grey)).variance(grey[:3]), 1 / 12)
    np.testing.assert_array_equal(NoiseModel(4.0, 0.0).variance(np.array([-5.0, 5.0])), 4.0)


def test_two_images_at_rest_under_a_flickering_lamp() -> None:
    rng = np.random.default_rng(6)
    truth = rng.uniform(0.05, 1.1, (400, 500))
    first, second = SENSOR.digitise(truth, rng), SENSOR.digitise(1.02 * truth, rng)
    model = noise_model_of_pair(first, second, SENSOR.full_scale)
    grey = np.array([300.0, 3000.0])
    np.testing.assert_allclose(model.variance(grey), SENSOR.variance(grey), rtol=0.03)


def test_wrong_calls_are_named() -> None:
    with pytest.raises(ValueError, match="residual_grey2: expected an array of shape"):
        fit_noise_model(np.zeros(100), np.zeros(99))
    with pytest.raises(ValueError, match="grey: expected at least 50 finite pixels, found 0"):
        fit_noise_model(np.full(100, np.nan), np.zeros(100))
    with pytest.raises(ValueError, match="variance_per_grey: expected a finite variance"):
        NoiseModel(1.0, -1.0)
    with pytest.raises(ValueError, match="found none"):
        noise_model_of_pair(np.zeros((9, 9)), np.zeros((9, 9)), 255)
