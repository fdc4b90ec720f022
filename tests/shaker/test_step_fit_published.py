"""The published identifications: every order from one factorisation, differential evolution, and how they fare."""

from __future__ import annotations

import numpy as np
import pytest
from step_fit_factory import RATE_HZ, SENSOR, answered, record_of, rough, sensor

from shaker.arrays import FloatArray
from shaker.release.fit import compare, fit_evolution
from shaker.release.sim import every_order, fit_sim

ONSET = 0.01


def held(count: int = 4000) -> FloatArray:
    """Return the answer of the published case to a load that holds between samples and steps at one of them."""
    system = sensor(*SENSOR)
    tau = np.arange(count) / RATE_HZ - ONSET
    s = system.poles
    residues = np.array([system.gain / np.prod([p - q for q in s if q != p]) / p for p in s])
    ring = np.real(np.exp(np.maximum(tau, 0.0)[:, None] * s) @ residues)
    return np.where(tau > 1e-9, 1.0 + ring, 0.0)


def test_one_factorisation_holds_every_order() -> None:
    """Loss and parameters of each order are those of its own least-squares problem over the same instants."""
    rng = np.random.default_rng(4)
    load = rng.standard_normal(300)
    output = answered(sensor(((9000.0, 0.2),)), load, 1e-5) + 0.05 * rng.standard_normal(300)
    found = every_order(load, output, 1e5, most=6)
    for order in (1, 2, 4, 6):
        k = np.arange(order, len(load) - (6 - order))
        past = [part[k - i] for i in range(order, 0, -1) for part in (load, output)]
        rows = np.stack([*past, load[k]], axis=1)
        own, rest, *_ = np.linalg.lstsq(rows, output[k], rcond=None)
        np.testing.assert_allclose(found.parameters(order), own, rtol=1e-8, atol=1e-9)
        assert found.loss()[order - 1] == pytest.approx(rest[0], rel=1e-9)
        short, rest, *_ = np.linalg.lstsq(rows[:, :-1], output[k], rcond=None)
        np.testing.assert_allclose(found.parameters(order, direct=False), short, rtol=1e-8, atol=1e-9)
        assert found.loss(direct=False)[order - 1] == pytest.approx(rest[0], rel=1e-9)


def test_without_noise_the_difference_equation_is_exact() -> None:
    record = record_of(held(), 0.0, 0)
    reading = rough(record, ONSET - 1.5e-5)
    fit = fit_sim(record, "Fz", reading=reading, conversion="zoh")
    assert fit.order == 3
    assert fit.model is not None
    np.testing.assert_allclose(fit.model.vector[[0, 1, 4]], [1700.0, 0.015, 6000.0], rtol=1e-4)
    tustin = fit_sim(record, "Fz", reading=reading, order=3)
    np.testing.assert_allclose(
        np.sort(tustin.system.sampled(RATE_HZ, "tustin").poles), np.sort(np.exp(fit.system.poles / RATE_HZ)), rtol=1e-4
    )
    assert tustin.variance_accounted > 0.999


def test_noise_biases_the_difference_equation_and_the_user_is_told() -> None:
    """At 100 kHz and 40 dB the equation error more than doubles the damping and puts a pole beyond the sampling."""
    record = record_of(held(), 2e-3, 1)
    fit = fit_sim(record, "Fz", reading=rough(record, ONSET - 1.5e-5), order=3)
    upper = fit.system.poles[fit.system.poles.imag > 0]
    assert not len(upper) or -upper[0].real / abs(upper[0]) > 2 * 0.015
    assert any("beyond half the sampling rate" in notice.text for notice in fit.notices)


def test_loss_falls_with_the_order() -> None:
    record = record_of(held(), 2e-3, 1)
    fit = fit_sim(record, "Fz", reading=rough(record, ONSET - 1.5e-5))
    assert len(fit.convergence) == 9
    assert np.all(np.diff(fit.convergence) < 1e-3 * fit.convergence[0])


def test_too_short_a_record_and_an_order_beyond_are_refused() -> None:
    with pytest.raises(ValueError, match="load: expected at least"):
        every_order(np.zeros(20), np.zeros(20), 1e5)
    with pytest.raises(ValueError, match="order: expected 1 to 2"):
        every_order(np.arange(40.0), np.arange(40.0) ** 2, 1e5, most=2).parameters(3)


def test_evolution_of_modes_reaches_the_default_s_optimum() -> None:
    record = record_of(held(1800), 2e-3, 1)
    both = compare(
        record,
        "Fz",
        rng=np.random.default_rng(1),
        reading=rough(record, ONSET),
        methods=("pencil", "evolution"),
        modes=1,
        real_poles=1,
    )
    assert [fit.method for fit in both] == ["pencil", "evolution"]
    default, evolved = (fit.model for fit in both)
    assert default is not None
    assert evolved is not None
    np.testing.assert_allclose(evolved.vector[:2], default.vector[:2], rtol=1e-3)
    np.testing.assert_allclose(evolved.real_hz, default.real_hz, rtol=0.02)  # the default fits the release's length too
    assert np.all(np.diff(both[1].convergence) <= 0)


@pytest.mark.slow
def test_published_evolution_is_far_from_the_truth() -> None:
    """500 generations of 100 members in coefficients within ±5 do not find the mode that the default finds."""
    record = record_of(held(2500), 2e-3, 1)
    fit = fit_evolution(
        record, "Fz", rng=np.random.default_rng(1), reading=rough(record, ONSET), parametrisation="coefficients"
    )
    assert len(fit.convergence) == 500
    assert np.all(np.diff(fit.convergence) <= 0)
    poles = fit.system.poles[fit.system.poles.imag > 0]
    if fit.system.sample_rate_hz is not None:
        poles = np.log(poles) * RATE_HZ
    truth = 2 * np.pi * 1700 * (-0.015 + 1j * np.sqrt(1 - 0.015**2))
    assert not len(poles) or np.min(np.abs(poles - truth)) > 0.01 * abs(truth)
