"""Metrics of the DIC Challenge on fields whose metrics are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from dic_metrics import (
    Field,
    centre_row,
    first_rise,
    lasting_resolution_px,
    noise_px,
    period_px,
    pixel_bias_px,
    predicted_resolution_px,
    projected_amplitude,
    resample,
    resolution_px,
    true_shift,
)

SIDE_PX, NOISE_PX, BIAS_PX = 19, 0.01, 0.006


@pytest.fixture(scope="module")
def field() -> Field:
    """The star averaged over 19 px, Dirichlet's kernel of the period, with noise and an error periodic in the pixel."""
    points = np.stack(np.meshgrid(np.arange(26.0, 3975.0, 4.0), np.arange(170.0, 331.0, 8.0)), -1).reshape(-1, 2)
    period, shifts = period_px(points[:, 0]), true_shift(points)
    bias = BIAS_PX * np.sin(2.0 * np.pi * shifts)
    shifts *= (np.sin(np.pi * SIDE_PX / period) / (SIDE_PX * np.sin(np.pi / period)))[:, None]
    return Field(points, shifts + bias + NOISE_PX * np.random.default_rng(1).standard_normal(shifts.shape))


def test_least_squares_average_a_wave_as_the_challenge_publishes():
    """67.8 px for affine subsets of 17 px (Reu et al. 2022, appendix); translation and affine average alike."""
    assert predicted_resolution_px(17, 1) == pytest.approx(67.8, abs=0.05)
    assert predicted_resolution_px(17, 0) == pytest.approx(predicted_resolution_px(17, 1), abs=1e-6)
    period = np.array([20.0, 60.0])
    kernel = np.sin(np.pi * 17 / period) / (17 * np.sin(np.pi / period))
    np.testing.assert_allclose(projected_amplitude(17, 1, period), kernel, atol=1e-12)
    assert 0.3 < predicted_resolution_px(17, 2) / predicted_resolution_px(17, 1) < 0.35


def test_metrics_of_a_known_field_lie_within_their_uncertainty(field):
    """A polynomial of degree 12 departs from the kernel's period of 90 % by up to 5 %."""
    resamples = resample(field, 60.0)
    for value, true, samples, departure in (
        (resolution_px(field), predicted_resolution_px(SIDE_PX, 1), resamples.resolution, 0.05),
        (noise_px(field), NOISE_PX, resamples.noise, 0.0),
        (pixel_bias_px(field), BIAS_PX, resamples.bias, 0.0),
    ):
        assert abs(value - true) < 3.0 * np.std(samples) + departure * true
        assert np.std(samples) < 0.05 * true
    assert 0.0 < lasting_resolution_px(field) - predicted_resolution_px(SIDE_PX, 1) < 5.0  # the last crossing in noise


def test_resamples_of_equal_noise_cancel_in_the_ratio_of_programs(field):
    louder = Field(field.points, true_shift(field.points) + 1.1 * (field.shifts - true_shift(field.points)))
    ratio = resample(louder, 60.0).noise / resample(field, 60.0).noise
    assert np.mean(ratio) == pytest.approx(1.1, abs=1e-3)
    assert np.std(ratio) < 1e-3


def test_missing_points_are_left_out_by_the_polynomial_and_unresolved_by_the_running_mean(field):
    shifts = field.shifts.copy()
    shifts[(field.period > 95.0) & (field.period < 96.0)] = np.nan
    gaps = Field(field.points, shifts)
    assert resolution_px(gaps) == pytest.approx(resolution_px(field), abs=1.0)
    assert lasting_resolution_px(gaps) > 95.0
    assert np.isfinite(resample(gaps, 60.0).mei).all()


def test_a_ratio_that_never_rises_has_no_resolution_and_a_grid_beside_the_centre_row_is_refused(field):
    assert np.isnan(first_rise(np.array([10.0, 20.0]), np.array([0.95, 0.99])))
    with pytest.raises(ValueError, match="250"):
        centre_row(Field(field.points + 1.0, field.shifts))
