"""Equations 1 and 2: exact and as series, solved for b, and where the series ends; what k and b say of b/k."""

from __future__ import annotations

import numpy as np
import pytest
from published_formulas import (
    damping_from_phase,
    damping_from_sensitivity,
    relative_sensitivity,
    sensitivity_phase_rad,
    series_limits_hz,
)
from scipy import signal

from shaker.identification.sensitivity import SpringPrior

K1, B1 = 4.3125e8, 699.18
K2, B2 = 4.5118e8, 1566.01
FREQUENCY = np.array([10.0, 800.0, 1000.0, 5000.0, 60000.0])


def test_exact_form_is_a_first_order_lag() -> None:
    _, response = signal.freqs([K1], [B1, K1], 2.0 * np.pi * FREQUENCY)
    assert np.allclose(relative_sensitivity(FREQUENCY, K1, B1), np.abs(response), rtol=1e-14)
    assert np.allclose(sensitivity_phase_rad(FREQUENCY, K1, B1), np.angle(response), rtol=1e-13)


@pytest.mark.parametrize(("k", "b", "percent", "phase"), [(K1, B1, 99.995, -0.0081), (K2, B2, 99.976, -0.0174)])
@pytest.mark.parametrize("form", ["exact", "series"])
def test_paper_spring_explains_neither_its_drop_nor_its_phase(
    k: float, b: float, percent: float, phase: float, form: str
) -> None:
    at = np.array([800.0, 1000.0])
    assert round(100.0 * relative_sensitivity(at, k, b, form)[1], 3) == percent
    assert sensitivity_phase_rad(at, k, b, form)[0] == pytest.approx(phase, abs=1e-4)


def test_damping_that_the_paper_would_need() -> None:
    assert damping_from_sensitivity(0.953, 1000.0, K1) == pytest.approx(21800.0, rel=2e-3)
    assert damping_from_phase(-0.25, 800.0, K1, "series") == pytest.approx(21450.0, rel=1e-3)
    assert damping_from_sensitivity(0.953, 1000.0, K1) / B1 == pytest.approx(31.0, abs=0.3)


@pytest.mark.parametrize("form", ["exact", "series"])
def test_solved_for_b(form: str) -> None:
    at = np.array([900.0])
    assert damping_from_sensitivity(relative_sensitivity(at, K1, 2e4, form)[0], 900.0, K1, form) == pytest.approx(2e4)
    assert damping_from_phase(sensitivity_phase_rad(at, K1, 2e4, form)[0], 900.0, K1, form) == pytest.approx(2e4)


def test_series_departs_where_it_is_said_to() -> None:
    magnitude, phase = series_limits_hz(K1, 21800.0)
    exact, series = (relative_sensitivity(np.array([magnitude]), K1, 21800.0, form)[0] for form in ("exact", "series"))
    assert series / exact == pytest.approx(0.99, abs=1e-9)
    exact, series = (sensitivity_phase_rad(np.array([phase]), K1, 21800.0, form)[0] for form in ("exact", "series"))
    assert series / exact == pytest.approx(1.01, abs=1e-9)
    assert 2.0 * np.pi * np.array([magnitude, phase]) * 21800.0 / K1 == pytest.approx([0.409, 0.174], abs=1e-3)
    assert series_limits_hz(K1, 0.0) == (np.inf, np.inf)


def test_uncertainty_of_the_time_constant_is_that_of_draws() -> None:
    spring = SpringPrior(K1, 2e-3 * K1, B1, 0.02 * B1, 0.6)
    draws = np.random.default_rng(1).multivariate_normal([K1, B1], spring.covariance, 200000)
    assert spring.time_s == pytest.approx(B1 / K1)
    assert np.std(draws[:, 1] / draws[:, 0]) == pytest.approx(spring.u_time_s, rel=0.01)


def test_wrong_calls_are_refused() -> None:
    with pytest.raises(ValueError, match="k: expected a stiffness above 0, found 0"):
        relative_sensitivity(FREQUENCY, 0.0, 1.0)
    with pytest.raises(ValueError, match="relative: expected more than 0 and at most 1"):
        damping_from_sensitivity(1.2, 1000.0, K1)
    with pytest.raises(ValueError, match="phase_rad: expected a phase between"):
        damping_from_phase(-2.0, 800.0, K1)
    with pytest.raises(ValueError, match="departure"):
        series_limits_hz(K1, B1, 0.0)
    with pytest.raises(ValueError, match="r_kb"):
        SpringPrior(K1, 1.0, B1, 1.0, 1.5)
    with pytest.raises(ValueError, match="k, u_k, u_b"):
        SpringPrior(-1.0, 1.0, B1, 1.0)
