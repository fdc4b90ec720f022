"""The comparison of results: formulas against closed forms and simulated laboratories, files and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.sensor.compare.consistency import drift, normalised_error, reference_value


def test_reference_of_independent_results_is_that_of_the_closed_form() -> None:
    value, u = np.array([10.0, 10.3, 9.8]), np.array([0.2, 0.3, 0.4])
    found = reference_value(value, np.diag(u**2))
    weights = u**-2 / np.sum(u**-2)
    assert found.value == pytest.approx(weights @ value)
    assert found.u == pytest.approx(np.sum(u**-2) ** -0.5)
    assert found.expanded == pytest.approx(2.0 * np.sqrt(u**2 - found.u**2)), "Cox 2002, equation 9"
    assert found.chi_squared == pytest.approx(np.sum(((value - found.value) / u) ** 2))
    assert found.used.all()


def test_an_outlier_leaves_the_largest_consistent_subset() -> None:
    u = np.full(4, 0.1)
    found = reference_value(np.array([1.0, 1.05, 3.0, 0.97]), np.diag(u**2))
    assert found.used.tolist() == [True, True, False, True]
    assert found.expanded[2] == pytest.approx(2.0 * np.sqrt(0.1**2 + found.u**2)), "one left out is independent of it"
    assert abs(found.normalised[2]) > 1.0


@pytest.mark.parametrize("shared", [0.0, 0.8])
def test_honest_laboratories_agree_in_95_percent(shared: float) -> None:
    rng, u, draws = np.random.default_rng(1), np.array([0.1, 0.2]), 2000
    common = shared * 0.1
    covariance = np.diag(u**2 - common**2) + common**2
    values = 5.0 + common * rng.standard_normal((draws, 1))
    values = values + np.sqrt(u**2 - common**2) * rng.standard_normal((draws, 2))
    share = np.mean([abs(normalised_error(row, covariance)[0, 1]) <= 1.0 for row in values])
    assert 0.93 < share < 0.97
    if shared:
        alone = np.mean([abs(normalised_error(row, np.diag(u**2))[0, 1]) <= 1.0 for row in values])
        assert alone > share, "what is shared cancels in the difference; without that E_n is too small"


def test_a_deviation_of_three_u_is_found() -> None:
    expanded = 0.2 * 2**0.5
    assert abs(normalised_error(np.array([1.0, 1.0 + 3 * expanded]), 0.01 * np.eye(2))[0, 1]) == pytest.approx(3.0)


def test_drift_is_that_of_many_draws() -> None:
    year, u = np.array([2020.0, 2021.0, 2024.0, 2025.0]), np.array([0.1, 0.2, 0.1, 0.3])
    rng = np.random.default_rng(2)
    covariance = np.diag(u**2)
    found = [drift(year, 3.0 + 0.05 * (year - 2020.0) + u * rng.standard_normal(4), covariance) for _ in range(4000)]
    slopes = np.array([slope for slope, _ in found])
    assert slopes.mean() == pytest.approx(0.05, abs=4 * slopes.std() / 4000**0.5)
    assert slopes.std() == pytest.approx(found[0][1], rel=0.05)
