"""Harmonics of readings over the angle of a head: against numpy's least squares, drawn noise and made-up terms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from shaker.static_rotation.harmonics import AngleFit, fit_angles, turning_sense

STEPS = np.arange(16) * np.pi / 8.0
BOTH_WAYS = np.concatenate([STEPS, [2.0 * np.pi, 2.0 * np.pi], STEPS[::-1]])
CHANNELS = ("Fx", "Fy")


def _readings(angle: np.ndarray, rng: np.random.Generator, noise: float = 1e-3) -> np.ndarray:
    clean = np.stack([0.3 + 7.558 * np.cos(angle - 0.4), -0.2 - 7.532 * np.sin(angle - 0.4)], axis=1)
    return np.asarray(clean + noise * rng.standard_normal(clean.shape))


def test_a_sine_fit_is_that_of_least_squares() -> None:
    values = _readings(STEPS, np.random.default_rng(1))
    fit = fit_angles(CHANNELS, STEPS, values)
    design = np.stack([np.ones(16), np.cos(STEPS), np.sin(STEPS)], axis=1)
    expected, rss, *_ = np.linalg.lstsq(design, values, rcond=None)
    assert fit.terms == ("offset", "cos 1", "sin 1")
    np.testing.assert_allclose(fit.coefficient, expected, atol=1e-12)
    np.testing.assert_allclose(np.diag(fit.noise), rss / 13.0, rtol=1e-9)
    np.testing.assert_allclose(np.abs(fit.amplitude()), [7.558, 7.532], atol=2e-3)
    np.testing.assert_allclose(np.angle(fit.amplitude()[0]), -0.4, atol=1e-3)
    np.testing.assert_allclose(fit.offset, [0.3, -0.2], atol=2e-3)
    np.testing.assert_allclose(fit.curve(STEPS) + fit.residual, values, atol=1e-12)


def test_amplitudes_scatter_as_their_covariance() -> None:
    rng = np.random.default_rng(2)
    mixing = np.array([[1e-3, 0.0], [0.8e-3, 1e-3]])
    angle = np.linspace(0.0, 5.5, 12)  # not a whole turn: cosine and sine correlate
    clean = _readings(angle, rng, 0.0)
    found, covariance = [], np.zeros((4, 4))
    for _ in range(600):
        fit = fit_angles(CHANNELS, angle, clean + rng.standard_normal(clean.shape) @ mixing.T)
        found.append(np.concatenate([fit.amplitude().real, fit.amplitude().imag]))
        covariance += fit.covariance() / 600.0
    seen = np.cov(np.array(found).T)
    scale = np.sqrt(np.outer(np.diag(seen), np.diag(seen)))
    np.testing.assert_allclose(covariance / scale, seen / scale, atol=0.15)


@pytest.mark.parametrize("angle", [STEPS, BOTH_WAYS], ids=["one way", "both ways"])
def test_what_is_not_there_seldom_enters(angle: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    plain = sum(len(fit_angles(CHANNELS, angle, _readings(angle, rng)).terms) == 3 for _ in range(300))
    assert plain >= 294  # some nine tests of one in a thousand each


@pytest.mark.parametrize("order", [2, 3, 5])
def test_a_harmonic_enters_where_one_channel_shows_it(order: int) -> None:
    rng = np.random.default_rng(order)
    values = _readings(STEPS, rng)
    values[:, 1] += 0.01 * np.sin(order * STEPS + 0.3)
    fit = fit_angles(CHANNELS, STEPS, values)
    assert fit.orders == (1, order)
    assert abs(fit.amplitude(order)[1]) == pytest.approx(0.01, abs=1.5e-3)
    assert fit.dof == 11.0


def test_drift_enters_and_leaves_the_sine_alone() -> None:
    values = _readings(BOTH_WAYS, np.random.default_rng(4)) + 0.02 * np.linspace(-1.0, 1.0, len(BOTH_WAYS))[:, None]
    fit = fit_angles(CHANNELS, BOTH_WAYS, values)
    assert fit.terms[3:] == ("drift",)
    np.testing.assert_allclose(fit.coefficient[3], 0.02, atol=2e-3)
    np.testing.assert_allclose(np.abs(fit.amplitude()), [7.558, 7.532], atol=2e-3)


def test_hysteresis_enters_and_is_shown() -> None:
    sense = turning_sense(BOTH_WAYS)
    values = _readings(BOTH_WAYS, np.random.default_rng(5)) + 0.01 * sense[:, None] * np.array([1.0, -1.0])
    fit = fit_angles(CHANNELS, BOTH_WAYS, values)
    assert fit.terms[3:] == ("sense", "sense cos 1", "sense sin 1")
    reversal = fit.reversal()
    assert len(reversal.angle_rad) == 16
    np.testing.assert_allclose(reversal.difference.mean(axis=0), [0.02, -0.02], atol=2e-3)


def test_the_sense_of_turning_goes_the_shorter_way() -> None:
    degrees = np.radians([315.0, 337.5, 0.0, 22.5, 22.5, 0.0, 337.5])
    assert turning_sense(degrees).tolist() == [1, 1, 1, 1, 1, -1, -1]
    assert turning_sense(np.zeros(3)).tolist() == [0, 0, 0]


def test_coarse_readings_are_as_uncertain_as_their_last_digit() -> None:
    values = np.round(np.stack([10.0 * np.cos(STEPS), 0.4 + 0.0 * STEPS], axis=1), 0)
    values[0, 1] = 1.0
    fit = fit_angles(CHANNELS, STEPS, values)
    assert np.all(np.diag(fit.noise) >= 1.0 / 12.0 - 1e-12)


@pytest.mark.parametrize("digit", [1e-6, 5e-4, 2e-9])
def test_rounded_readings_are_no_harmonics(digit: float) -> None:
    values = digit * np.round(_readings(STEPS, np.random.default_rng(8), 0.0) / digit)
    fit = fit_angles(CHANNELS, STEPS, values)
    assert fit.orders == (1,)
    assert np.all(np.diag(fit.noise) >= 0.99 * digit**2 / 12.0)


def test_readings_without_noise_are_exact() -> None:
    values = np.stack([np.cos(STEPS), np.sin(STEPS) + 0.1 * np.cos(2.0 * STEPS)], axis=1)
    fit = fit_angles(CHANNELS, STEPS, values)
    assert fit.orders == (1, 2)
    np.testing.assert_allclose(fit.amplitude(), [1.0, -1.0j], atol=1e-12)


@settings(deadline=None, max_examples=30)
@given(
    st.lists(st.floats(0.0, 6.283), min_size=8, max_size=20, unique_by=lambda x: round(x, 1)),
    st.floats(0.1, 100.0),
    st.floats(-3.0, 3.0),
)
def test_angles_in_any_order_give_one_answer(angles: list[float], size: float, turn: float) -> None:
    angle = np.array(angles)
    values = (1.0 + size * np.cos(angle + turn))[:, None]
    design = np.stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)], axis=1)
    assume(np.linalg.cond(design) < 29.0)
    fit = fit_angles(("F",), angle, values)
    again = fit_angles(("F",), angle[::-1] + 2.0 * np.pi, values[::-1])
    for found in (fit, again):
        assert found.amplitude()[0] == pytest.approx(size * np.exp(1j * turn), rel=1e-6)


@pytest.mark.parametrize(
    ("angle", "values", "match"),
    [
        (
            np.zeros(5),
            np.zeros((5, 1)),
            "at least four angles spread over most of a turn, found 5 readings at 1 angles",
        ),
        (np.arange(3.0), np.zeros((3, 1)), "found 3 readings"),
        (np.linspace(0.0, 0.5, 20), np.zeros((20, 1)), "spread over most of a turn"),
        (np.arange(6.0), np.zeros((5, 1)), r"reading: expected an array of shape \(6, 1\)"),
        (np.arange(6.0), np.full((6, 1), np.nan), "finite"),
    ],
)
def test_readings_that_tell_no_sine_are_refused(angle: np.ndarray, values: np.ndarray, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        fit_angles(("F",), angle, values)


def test_an_order_that_was_not_fitted_is_refused() -> None:
    fit: AngleFit = fit_angles(("F",), STEPS, np.cos(STEPS)[:, None])
    with pytest.raises(ValueError, match="order: expected one of"):
        fit.amplitude(4)


def test_readings_next_to_nothing_have_no_last_digit() -> None:
    angle = np.arange(16) * np.pi / 8.0
    fit = fit_angles(("a",), angle, 4e-318 * np.sin(angle)[:, None])
    assert abs(fit.amplitude()[0]) < 1e-317
