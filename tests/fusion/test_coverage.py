"""Coverage factors and regions against tables of the GUM, scipy's distributions and drawn errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from fusion.estimation.uncertainty import coverage_factor, region, region_factor


@pytest.mark.parametrize(
    ("dof", "factor"),
    [(1, 12.71), (2, 4.30), (3, 3.18), (4, 2.78), (8, 2.31), (20, 2.09), (50, 2.01), (100, 1.984), (np.inf, 1.960)],
)
def test_factors_of_the_table_of_the_gum(dof: float, factor: float) -> None:
    # JCGM 100:2008, table G.2, column 95 %.
    assert coverage_factor(dof) == pytest.approx(factor, abs=0.006)


@given(st.floats(1.2, 1e4))
def test_region_factor_is_hotellings(dof: float) -> None:
    expected = np.sqrt(2.0 * dof / (dof - 1.0) * stats.f.ppf(0.95, 2, dof - 1.0))
    assert region_factor(dof) == pytest.approx(expected, rel=1e-6)


def test_region_factor_at_the_ends() -> None:
    assert region_factor(np.inf) == pytest.approx(np.sqrt(stats.chi2.ppf(0.95, 2)), rel=1e-12)
    assert region_factor(1e9) == pytest.approx(region_factor(np.inf), rel=1e-8)
    assert region_factor(1.0) == np.inf
    assert region_factor(0.5) == np.inf
    assert coverage_factor(0.0) == np.inf


@pytest.mark.parametrize("count", [4, 8, 30])
def test_region_of_a_mean_of_complex_readings_holds_the_truth(count: int) -> None:
    # The case of Willink & Hall: mean of n complex readings, ν = n - 1. 20 000 means fix 95 % to 0.15 %.
    rng = np.random.default_rng(count)
    truth, trials = 0.4 - 0.2j, 20_000
    root = np.array([[1.0, 0.0], [0.7, 0.4]])
    readings = np.array([truth.real, truth.imag]) + rng.standard_normal((trials, count, 2)) @ root.T
    means = readings.mean(axis=1)
    spreads = np.einsum("tni,tnj->tij", readings - means[:, None], readings - means[:, None]) / (count - 1) / count
    error = means - np.array([truth.real, truth.imag])
    distance = np.einsum("ti,tij,tj->t", error, np.linalg.inv(spreads), error)
    assert np.mean(distance <= region_factor(count - 1) ** 2) == pytest.approx(0.95, abs=0.005)


def test_axes_of_a_region() -> None:
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    found = region(5.0 + 1.0j, turn @ np.diag([4.0, 0.25]) @ turn.T)
    k = region_factor(np.inf)
    assert found.half_axes == pytest.approx((2.0 * k, 0.5 * k))
    assert found.angle_rad == pytest.approx(0.3)
    assert region(5.0 + 1.0j, turn @ np.diag([4.0, 0.25]) @ turn.T, 5.0).half_axes[0] == pytest.approx(
        2.0 * region_factor(5.0)
    )
    assert region(1.0j, np.diag([1.0, 9.0])).angle_rad == pytest.approx(np.pi / 2.0)


@given(st.floats(-np.pi, np.pi), st.floats(0.5, 1.5))
def test_a_region_holds_zero_as_its_ellipse_does(angle: float, share: float) -> None:
    covariance = np.array([[4e-4, 1.5e-4], [1.5e-4, 2.5e-4]])
    edge = np.linalg.cholesky(covariance) @ [np.cos(angle), np.sin(angle)] * region_factor(40.0)
    assert abs(share - 1.0) < 1e-6 or region(share * complex(*edge), covariance, 40.0).holds_zero == (share < 1.0)


def test_values_without_uncertainty_or_without_region() -> None:
    assert not region(1e-300 + 0j, np.zeros((2, 2))).holds_zero
    assert region(0j, np.zeros((2, 2))).holds_zero
    assert region(1.0 + 1.0j, np.full((2, 2), np.nan)).holds_zero
    assert region(1e9 + 0j, np.eye(2), 1.0).holds_zero
    flat = region(1.0 + 0j, np.diag([0.0, 1.0]))
    assert not flat.holds_zero
    assert flat.half_axes[1] == 0.0
