"""Responses of chains: tables and poles against scipy and closed forms, their errors against finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from shaker.frf.chain import (
    FilterKind,
    PassBand,
    PoleModel,
    ResponseTable,
    common_covariance,
    filter_poles,
    pole_response,
    product,
    ratio_unit,
    split_ratio,
    table_response,
)
from shaker.sine.phasor import Phasors

FREQUENCY = np.geomspace(10.0, 5000.0, 400)
LOWPASS = filter_poles("butterworth", 4, 10e3)
HIGHPASS = filter_poles("butterworth", 2, 2.0, "highpass")
OCTAVES = np.array([10.0, 20, 40, 80, 160, 315, 630, 1250, 2500, 5000])


def _table(frequency: np.ndarray, value: np.ndarray, u: float = 1e-4) -> ResponseTable:
    return ResponseTable(frequency, np.abs(value), np.angle(value), u * np.abs(value), np.full(len(frequency), u))


def _phasors(value: np.ndarray, unit: tuple[str, ...] = ("m/s", "V")) -> Phasors:
    lines, channels = value.shape
    covariance = np.tile(np.eye(2 * channels) * 1e-4, (lines, 1, 1))
    names = tuple("abcdef"[:channels])
    return Phasors(np.linspace(10.0, 1000.0, lines), value, covariance, names, unit, np.full(lines, 9.0))


@pytest.mark.parametrize("kind", ["butterworth", "bessel"])
@pytest.mark.parametrize("band", ["lowpass", "highpass"])
@pytest.mark.parametrize("order", [1, 4, 8])
def test_standard_filters_are_those_of_scipy(kind: FilterKind, band: PassBand, order: int) -> None:
    design = signal.butter if kind == "butterworth" else lambda *a, **k: signal.bessel(*a, **k, norm="mag")
    b, a = design(order, 2.0 * np.pi * 800.0, band, analog=True)
    _, expected = signal.freqs(b, a, 2.0 * np.pi * FREQUENCY)
    found = pole_response(FREQUENCY, filter_poles(kind, order, 800.0, band)).value
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    corner = pole_response(np.array([800.0]), filter_poles(kind, order, 800.0, band)).value
    assert np.abs(corner[0]) == pytest.approx(np.sqrt(0.5), rel=1e-9)


def test_a_resonance_is_an_oscillator() -> None:
    ratio = FREQUENCY / 3000.0
    found = pole_response(FREQUENCY, filter_poles("resonance", 2, 3000.0, damping=0.02)).value
    np.testing.assert_allclose(found, 1.0 / (1.0 - ratio**2 + 0.04j * ratio), rtol=1e-12)


def test_gain_and_delay_stand_before_the_poles() -> None:
    model = PoleModel(np.zeros(1, complex), np.array([-6.0, -6e5], complex), 3.0, 160.0, 2e-5)
    found = pole_response(np.array([160.0, 1000.0]), model).value
    assert np.abs(found[0]) == pytest.approx(3.0)
    late = pole_response(np.array([1000.0]), replace(model, delay_s=0.0)).value[0]
    assert found[1] == pytest.approx(late * np.exp(-2j * np.pi * 1000.0 * 2e-5))


@pytest.mark.parametrize(
    "model", [LOWPASS, HIGHPASS, PoleModel(np.zeros(1, complex), np.array([-6.0, -6e5], complex), 2.0, 160.0)]
)
def test_errors_are_what_a_small_change_makes(model: PoleModel) -> None:
    step = 1e-6
    response = pole_response(FREQUENCY, model, u_gain=step, u_frequency=step, u_delay_s=step * 1e-6)
    larger = replace(model, zeros=model.zeros * (1 + step), poles=model.poles * (1 + step))
    changed = (
        replace(model, gain=model.gain * (1 + step)),
        larger,
        replace(model, delay_s=model.delay_s + step * 1e-6),
    )
    for error, other in zip(response.errors, changed, strict=True):
        change = pole_response(FREQUENCY, other).value / response.value - 1.0
        np.testing.assert_allclose(error, change, atol=2e-3 * np.abs(error).max() + 1e-14)
    np.testing.assert_allclose(response.u_magnitude**2, np.sum(response.errors.real**2, axis=0))


@pytest.mark.parametrize("model", [LOWPASS, HIGHPASS, replace(LOWPASS, delay_s=5e-5)])
@pytest.mark.parametrize("knots", [OCTAVES, np.geomspace(10, 5000, 28), np.linspace(10, 5000, 101)])
def test_an_interpolated_table_errs_no_more_than_it_says(model: PoleModel, knots: np.ndarray) -> None:
    found = table_response(_table(knots, pole_response(knots, model).value, 0.0), FREQUENCY)
    error = np.abs(found.value / pole_response(FREQUENCY, model).value - 1.0)
    said = np.hypot(found.u_magnitude, found.u_phase_rad)
    assert np.mean(error > 2.0 * said + 1e-7) < 0.02
    true, given = pole_response(FREQUENCY, model).value, pole_response(knots, model).value
    phase = np.interp(FREQUENCY, knots, np.unwrap(np.angle(given)))
    linear = np.interp(FREQUENCY, knots, np.abs(given)) * np.exp(1j * phase)
    assert error.max() < 0.5 * np.abs(linear / true - 1.0).max()


def test_a_table_is_met_at_its_points_and_a_delay_is_exact_between_them() -> None:
    knots = np.array([0.0, 300.0, 700.0, 1500.0])
    late = np.exp(-2j * np.pi * knots * 2e-4)
    np.testing.assert_allclose(table_response(_table(knots, late), knots).value, late, rtol=1e-12)
    between = np.array([11.0, 444.4, 1100.0])
    np.testing.assert_allclose(table_response(_table(knots, late), between).value, np.exp(-2j * np.pi * between * 2e-4))


def test_scattered_points_are_an_error_of_the_interpolation() -> None:
    rng = np.random.default_rng(4)
    knots = np.linspace(10.0, 5000.0, 40)
    scatter = 1e-3 * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
    said = table_response(_table(knots, 1.0 + scatter, 0.0), FREQUENCY)
    error = np.abs(said.value - 1.0)
    assert np.mean(error > 2.0 * np.hypot(said.u_magnitude, said.u_phase_rad)) < 0.15
    assert 0.5e-3 < np.median(said.u_magnitude) < 4e-3


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_short_tables(count: int) -> None:
    knots = np.linspace(100.0, 400.0, count) if count > 1 else np.array([100.0])
    wanted = knots if count == 1 else np.array([100.0, 250.0, 400.0])
    found = table_response(_table(knots, np.full(count, 2.0 + 0j)), wanted)
    np.testing.assert_allclose(found.value, 2.0)
    np.testing.assert_allclose(found.u_magnitude, 1e-4)


def test_elements_multiply_and_their_errors_add_in_squares() -> None:
    parts = [pole_response(FREQUENCY, model, u_gain=u) for model, u in ((LOWPASS, 3e-3), (HIGHPASS, 4e-3))]
    both = product(parts)
    np.testing.assert_allclose(both.value, parts[0].value * parts[1].value)
    np.testing.assert_allclose(both.u_magnitude, 5e-3)
    assert len(both.causes) == 6


def test_common_errors_add_a_covariance_that_cancels_in_what_is_shared() -> None:
    value = np.array([[1.0 + 1.0j, 2.0 - 1.0j]])
    errors = np.array([[[0.01, 0.01]], [[0.02j, 0.02j]]])
    rng = np.random.default_rng(5)
    draws = rng.standard_normal((200_000, 2))
    drawn = value * (1.0 + draws @ errors[:, 0, :])
    stacked = np.concatenate([drawn.real, drawn.imag], axis=1)
    np.testing.assert_allclose(common_covariance(value, errors)[0], np.cov(stacked.T), atol=2e-5)


def test_units_of_ratios() -> None:
    assert ratio_unit("m/s^2", "N") == "(m/s^2)/N"
    assert ratio_unit("V/V", "m/s^2") == "(V/V)/(m/s^2)"
    assert ratio_unit("m", "m") == "1"
    for above, below in (("m/s^2", "N"), ("V/V", "m/s^2"), ("m", "N"), ("m/s", "N.m")):
        assert split_ratio(ratio_unit(above, below)) == (above, below)
    assert split_ratio("m/s^2") == ("m/s^2", "")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: PoleModel(poles=np.array([-1 + 2j])), "poles: expected each complex root with its conjugate"),
        (lambda: PoleModel(poles=np.array([1 + 0j])), "poles: expected real parts of at most 0, found 1"),
        (lambda: PoleModel(gain=0.0), "gain: expected a number other than 0"),
        (lambda: filter_poles("bessel", 0, 1.0), "order: expected 1 to 12, found 0"),
        (lambda: filter_poles("resonance", 3, 1.0), "order: expected 2"),
        (lambda: filter_poles("butterworth", 2, 0.0), "corner_hz: expected a frequency above 0"),
        (lambda: pole_response(np.zeros(1), HIGHPASS), "frequency_hz: expected frequencies other than a zero"),
        (lambda: table_response(_table(OCTAVES, OCTAVES + 0j), np.array([5e3, 6e3])), "found 6000"),
        (lambda: _table(OCTAVES[::-1], OCTAVES + 0j), "ascending"),
        (lambda: _table(OCTAVES, 0j * OCTAVES), "magnitude: expected positive values"),
    ],
)
def test_wrong_calls_are_refused_by_name(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        call()  # type: ignore[operator]
