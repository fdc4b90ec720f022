"""Models from frequency responses against a sensor of known poles and residues."""

import numpy as np
import pytest
from decoupling_factory import SENSOR

from shaker.decoupling.responses import ResponseFit, Responses, fit_responses

LINES_HZ = np.linspace(20.0, 900.0, 220)


def _measured(seed: int, share: float = 0.01) -> Responses:
    """Responses with noise of a share of the largest static gain of each output, correlated between Re and Im."""
    rng = np.random.default_rng(seed)
    value = SENSOR.response(LINES_HZ)
    spread = share * np.abs(SENSOR.response(np.zeros(1))[0]).max(axis=1)[None, :, None] * np.ones(value.shape)
    form = np.array([[1.0, 0.5], [0.5, 0.7]])
    pairs = rng.standard_normal((*value.shape, 2)) @ np.linalg.cholesky(form).T * spread[..., None]
    covariance = spread[..., None, None] ** 2 * form
    return Responses(SENSOR.loads, SENSOR.loads, "V", LINES_HZ, value + pairs[..., 0] + 1j * pairs[..., 1], covariance)


@pytest.fixture(scope="module")
def fit() -> ResponseFit:
    return fit_responses(_measured(1), 5)


def test_poles_are_those_of_the_sensor_within_their_uncertainty(fit: ResponseFit) -> None:
    order, u = np.argsort(fit.model.frequency_hz), fit.model.u
    assert len(order) == 3
    assert np.all(np.abs(fit.model.frequency_hz[order] - SENSOR.frequency_hz) < 3.5 * u.frequency_hz[order])
    assert np.all(np.abs(fit.model.damping_ratio[order] - SENSOR.damping) < 3.5 * u.damping_ratio[order])
    assert np.min(np.abs(fit.model.real_hz - SENSOR.lag_hz) / u.real_hz) < 3.5
    assert fit.chi_squared / fit.dof == pytest.approx(1.0, abs=0.08)
    assert fit.notices == ()


def test_residues_lie_in_their_intervals(fit: ResponseFit) -> None:
    order, u = np.argsort(fit.model.frequency_hz), fit.model.u.residue
    difference = fit.model.residue[order] - SENSOR.residues
    score = np.concatenate([(difference.real / u[order].real).ravel(), (difference.imag / u[order].imag).ravel()])
    assert 0.7 < np.sqrt(np.mean(score**2)) < 1.4


def test_slopes_of_the_response_are_difference_quotients(fit: ResponseFit) -> None:
    model, frequency_hz = fit.model, np.array([0.0, 200.0, 330.0, 600.0])
    slope, _ = model.column_sensitivity(1, frequency_hz)
    n, outputs = model.shared, len(model.channels)
    own = n + n * outputs * 1 + np.arange(n * outputs)
    for k, place in enumerate([*range(n), *own]):
        step = np.zeros(len(model.vector))
        step[place] = 1e-5 * max(abs(model.vector[place]), 1e-3)
        up, down = (model.with_vector(model.vector + sign * step).response(frequency_hz)[:, :, 1] for sign in (1, -1))
        quotient = (up - down) / (2.0 * step[place])
        np.testing.assert_allclose(slope[:, :, k], quotient, atol=1e-5 * np.abs(quotient).max() + 1e-12)


def test_responses_that_no_sum_of_modes_explains_are_told() -> None:
    measured = _measured(2)
    late = measured.value * np.exp(-2j * np.pi * LINES_HZ[:, None, None] * np.array([0.0, 3e-3, 7e-3]))
    found = fit_responses(Responses(SENSOR.loads, SENSOR.loads, "V", LINES_HZ, late, measured.covariance), 4)
    assert found.chi_squared > 2.0 * found.dof
    assert "times what the covariance" in found.notices[0].text
