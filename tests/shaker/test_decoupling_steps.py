"""Models from releases of all loads, and the filter made of them, against a sensor of known poles and residues."""

from dataclasses import replace

import numpy as np
import pytest
from decoupling_factory import SENSOR

from shaker.decoupling.filter import Recorded, Target, crosstalks, design_decoupling, static_inverse
from shaker.decoupling.fit import MultiFit, fit_steps

RELATIVE = SENSOR.size / SENSOR.size[:, None]
TARGET = Target(np.full(3, 300.0), np.full(3, 0.6))


@pytest.fixture(scope="module")
def fit() -> MultiFit:
    return fit_steps(SENSOR.releases(3))


def test_poles_are_those_of_the_sensor_within_their_uncertainty(fit: MultiFit) -> None:
    order = np.argsort(fit.model.frequency_hz)
    assert len(order) == 3
    assert len(fit.model.real_hz) == 1
    u = fit.model.u
    assert np.all(np.abs(fit.model.frequency_hz[order] - SENSOR.frequency_hz) < 3.5 * u.frequency_hz[order])
    assert np.all(np.abs(fit.model.damping_ratio[order] - SENSOR.damping) < 3.5 * u.damping_ratio[order])
    assert np.all(u.frequency_hz[order] < 2e-4 * SENSOR.frequency_hz)
    assert abs(fit.model.real_hz[0] - SENSOR.lag_hz) < 3.5 * u.real_hz[0]
    assert [fit.ranks[i].rank for i in order] == [1, 1, 1]


def test_residues_lie_in_their_intervals(fit: MultiFit) -> None:
    order = np.argsort(fit.model.frequency_hz)
    u, difference = fit.model.u.residue[order], fit.model.residue[order] - SENSOR.residues
    score = np.concatenate([(difference.real / u.real).ravel(), (difference.imag / u.imag).ravel()])
    assert np.mean(np.abs(score) < 1.96) > 0.8
    assert np.abs(score).max() < 5.0


def test_noise_and_explained_share_are_found(fit: MultiFit) -> None:
    expected = 0.01 * SENSOR.size * np.diag(SENSOR.response(np.zeros(1))[0].real)
    np.testing.assert_allclose(fit.noise, expected, rtol=0.05)
    assert np.all(fit.variance_accounted > 0.997)
    assert len(fit.releases) == 6
    assert fit.notices == ()


def test_filter_takes_the_true_sensors_crosstalk_away(fit: MultiFit) -> None:
    decoupler = design_decoupling(fit.model, TARGET, Recorded(SENSOR.rate_hz, fit.noise, fit.amplitude))
    frequency_hz = np.array([5.0, 50.0, 150.0, 250.0, 310.0, 335.0])
    truth = SENSOR.response(frequency_hz)
    wanted = decoupler.target(frequency_hz)[:, :, None] * np.eye(3)
    left = np.abs(decoupler.response(frequency_hz) @ truth - wanted) * RELATIVE
    static = np.abs(static_inverse(fit.model, fit.noise) @ truth - np.eye(3)) * RELATIVE
    off = ~np.eye(3, dtype=np.bool_)
    assert left[:2, off].max() < 0.003
    assert left[:, off].max() < 0.05
    assert left[4:, off].max() < 0.05 * static[4:, off].max()


def test_filter_takes_the_crosstalk_of_a_release_away(fit: MultiFit) -> None:
    decoupler = design_decoupling(fit.model, TARGET, Recorded(SENSOR.rate_hz, fit.noise, fit.amplitude))
    load = np.clip((np.arange(1000 * 20) / 20.0 - 100.0) / 5.0, 0.0, 1.0)
    for d in range(3):
        outputs = SENSOR.outputs(load, d).T
        filtered, static = decoupler.apply(outputs), outputs @ static_inverse(fit.model, fit.noise).T
        others = [i for i in range(3) if i != d]
        after = np.abs(filtered[:, others] * RELATIVE[others, d]).max()
        before = np.abs(static[:, others] * RELATIVE[others, d]).max()
        assert after < 0.012
        assert after < 0.2 * before
        assert filtered[-1, d] == pytest.approx(1.0, abs=0.003)
        assert filtered[:, d].max() < 1.13


def test_uncertainty_of_the_response_covers_the_truth(fit: MultiFit) -> None:
    decoupler = design_decoupling(fit.model, TARGET, Recorded(SENSOR.rate_hz, fit.noise, fit.amplitude))
    frequency_hz = np.geomspace(10.0, 600.0, 12)
    stages = crosstalks(fit.model, decoupler, fit.noise, frequency_hz, np.random.default_rng(1), 12)
    assert [stage.stage for stage in stages] == ["raw", "static", "filtered"]
    truth = decoupler.response(frequency_hz) @ SENSOR.response(frequency_hz)
    score = np.abs(truth - stages[-1].value) / stages[-1].u
    assert 0.5 < np.sqrt(np.mean(score**2) / 2.0) < 2.0
    assert np.all(stages[-1].u_peak >= 0.0)


def test_a_lag_that_slower_releases_hide_is_in_the_uncertainty() -> None:
    sensor, lines_hz = replace(SENSOR, lag_hz=4000.0), np.array([100.0, 250.0, 450.0])
    model, truth = fit_steps(sensor.releases(1)).model, sensor.response(lines_hz)
    assert len(model.real_hz) == 1
    for d in range(3):
        slope, covariance = model.column_sensitivity(d, lines_hz)
        off = (model.response(lines_hz)[:, d, d] - truth[:, d, d]).imag
        u = np.sqrt(np.einsum("kp,pq,kq->k", slope[:, d].imag, covariance, slope[:, d].imag))
        assert np.all(np.abs(off) < 3.0 * u)
        assert np.all(u < 0.4 * np.abs(truth[:, d, d]))  # a lag of at most the releases' standard deviation in time


@pytest.mark.slow
def test_amplitudes_uncertainty_is_in_the_static_gains() -> None:
    records = [replace(record, u_amplitude=0.01) for record in SENSOR.releases(5, each=1)]
    found = fit_steps(records)
    element = found.model.element("Fx", "Fx")
    value, covariance = element.propagate(lambda model: np.array([model.static_gain]))
    assert np.sqrt(covariance[0, 0]) / value[0] == pytest.approx(0.01, rel=0.1)
    assert {notice.where for notice in found.notices} >= set(SENSOR.loads)


@pytest.mark.slow
def test_releases_of_other_size_than_stated_are_told() -> None:
    records = SENSOR.releases(4)
    found = fit_steps([*records[1:], replace(records[0], amplitude=1.03 * records[0].amplitude)])
    assert 0.01 < found.u_amplitude[0] < 0.02
    assert any(notice.where == "Fx" and "scatter" in notice.text for notice in found.notices)


def test_loads_that_act_alike_are_refused_by_name() -> None:
    records = [record for record in SENSOR.releases(6, each=1) if record.component != "Mz"]
    twin = replace(records[0], component="Fz", name="Fz-0")
    with pytest.raises(ValueError, match="Fx and Fz alike"):
        fit_steps([*records, twin])


def test_records_of_different_outputs_are_refused() -> None:
    records = SENSOR.releases(6, each=1)
    with pytest.raises(ValueError, match="expected channels"):
        fit_steps([records[0], replace(records[1], channels=("Fx", "Fy", "Fz"))])
    with pytest.raises(ValueError, match="found none"):
        fit_steps([])
