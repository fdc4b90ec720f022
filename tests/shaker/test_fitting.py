"""The fitting core against scipy, closed forms and difference quotients."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from shaker.arrays import FloatArray, IntArray
from shaker.fitting import Block, Prior, Residuals, Rules, Separable, eliminate, levenberg_marquardt

TIME = np.linspace(0.0, 4.0, 60)
RULES = Rules(foretold_share=1e-14)


def _decays(rates: FloatArray, data: FloatArray) -> Separable:
    """A level and two decays with free amplitudes, in two outputs (60, 2)."""
    waves = np.exp(-TIME[:, None] * rates)

    def changes(own: FloatArray) -> tuple[IntArray, FloatArray]:
        return np.arange(2), (-TIME[:, None] * waves)[:, :, None] * own[1:]

    return Separable(rates, (Block(np.hstack([np.ones((60, 1)), waves]), data, changes),))


def _data() -> FloatArray:
    waves = np.exp(-TIME[:, None] * np.array([0.7, 3.0])) @ np.array([[1.0, -0.4], [0.5, 2.0]])
    return np.asarray(waves + 0.3 + 1e-2 * np.random.default_rng(1).standard_normal((60, 2)))


def test_a_narrow_valley_is_followed_to_its_end() -> None:
    def at(x: FloatArray) -> Residuals | None:
        residual = np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
        return Residuals(x, residual, np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])) if x[0] < 1.5 else None

    begin = at(np.array([-1.2, 1.0]))
    assert begin is not None
    end = levenberg_marquardt(at, begin, RULES)
    assert end.converged
    assert end.point.parameters == pytest.approx([1.0, 1.0], abs=1e-6)
    assert np.all(np.diff(end.losses) < 0)


def test_projected_coefficients_give_the_joint_minimum() -> None:
    data = _data()
    end = levenberg_marquardt(lambda x: _decays(x, data), _decays(np.array([0.5, 5.0]), data), RULES).point

    def joint(x: FloatArray) -> FloatArray:
        design = np.hstack([np.ones((60, 1)), np.exp(-TIME[:, None] * x[:2])])
        return np.asarray((data - design @ x[2:].reshape(3, 2)).ravel())

    whole = np.concatenate([end.parameters, end.coefficients[0].ravel()])
    reference = least_squares(joint, whole * 1.05, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(whole, reference.x, rtol=1e-6)
    assert end.loss == pytest.approx(2.0 * reference.cost, rel=1e-10)
    assert end.freedom == 120 - 6 - 2
    covariance = np.linalg.inv(reference.jac.T @ reference.jac)[:2, :2]
    np.testing.assert_allclose(np.linalg.inv(end.normal[0]), covariance, rtol=2e-3)


def test_the_gradient_is_that_of_the_projected_loss() -> None:
    data, rates = _data(), np.array([0.5, 5.0])
    downhill = _decays(rates, data).normal[1]
    for place in range(2):
        step = 1e-6 * np.eye(2)[place]
        slope = (_decays(rates + step, data).loss - _decays(rates - step, data).loss) / 2e-6
        assert downhill[place] == pytest.approx(-0.5 * slope, rel=1e-5)


def test_what_is_known_beforehand_weighs_by_its_variance() -> None:
    """Of a mean x of n data and a prior (m, u): (n x/s² + m/u²)/(n/s² + 1/u²), s² of the residual there."""
    data = np.random.default_rng(2).standard_normal(50) + 3.0

    def at(x: FloatArray) -> Residuals:
        return Residuals(x, x[0] - data, np.ones((50, 1)))

    end = levenberg_marquardt(at, at(np.zeros(1)), RULES, prior=Prior(np.array([0.0]), np.array([0.1]))).point
    variance = end.loss / 49
    expected = np.sum(data) / variance / (50 / variance + 100.0)
    assert end.parameters[0] == pytest.approx(expected, rel=1e-6)


def test_dependent_columns_share_and_the_root_is_that_of_the_covariance() -> None:
    design = np.stack([np.ones(60), TIME, TIME**2], axis=1)
    part = eliminate(design, _data())
    np.testing.assert_allclose(part.root @ part.root.T, np.linalg.inv(design.T @ design), rtol=1e-9)
    assert np.abs(design.T @ part.residual).max() < 1e-10
    twice = eliminate(np.hstack([design, 1e6 * design[:, :1]]), _data())
    np.testing.assert_allclose(twice.residual, part.residual, atol=1e-12)
    np.testing.assert_allclose(twice.coefficients[0], 1e6 * twice.coefficients[3], rtol=1e-6)


def test_a_start_without_a_loss_is_refused() -> None:
    with pytest.raises(ValueError, match="start: expected parameters"):
        levenberg_marquardt(lambda x: None, Residuals(np.zeros(1), np.array([np.inf]), np.ones((1, 1))), RULES)
