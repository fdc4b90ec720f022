"""Budgets: parts make the whole, coefficients are derivatives, what two results share is added before it is squared."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.sensitivity.load import budget

finite = st.floats(-1.0, 1.0)
VALUE = np.array([[2.0 * np.exp(0.4j), -0.3 + 0.1j], [1.0j, 5.0 + 0.0j]])


def influence(name: str, label: str, u: float, effect: np.ndarray) -> Influence:
    return Influence(name, label, u, "kg", np.concatenate([effect.real, effect.imag], axis=1))


def noise(seed: int) -> Contribution:
    root = np.random.default_rng(seed).standard_normal((2, 4, 4)) * 1e-3
    return Contribution("noise", "A", root @ root.swapaxes(1, 2), np.array([5.0, 9.0]))


@given(st.lists(st.tuples(finite, finite), min_size=1, max_size=5), st.integers(0, 1000))
def test_contributions_make_the_variance_of_magnitude_and_phase(parts: list[tuple[float, float]], seed: int) -> None:
    names = [influence(f"{i}", f"label {i % 2}", 0.1, VALUE * complex(*part) * 1e-3) for i, part in enumerate(parts)]
    total = Uncertainty((noise(seed),), tuple(names))
    entries = budget(total, VALUE)
    for line, place in np.ndindex(VALUE.shape):
        covariance = total.covariance[line][np.ix_([place, place + 2], [place, place + 2])]
        value = VALUE[line, place]
        along = np.array([value.real, value.imag]) / abs(value)
        across = np.array([-value.imag, value.real]) / abs(value)
        magnitude = sum(entry.u_relative[line, place] ** 2 for entry in entries)
        phase = sum(entry.u_phase_rad[line, place] ** 2 for entry in entries)
        assert magnitude == pytest.approx(along @ covariance @ along / abs(value) ** 2, rel=1e-9)
        assert phase == pytest.approx(across @ covariance @ across / abs(value) ** 2, rel=1e-9)


def test_a_coefficient_is_the_change_per_unit_with_its_sign() -> None:
    mass = influence("load: mass", "load: mass", 0.02, VALUE * (-0.02 / 7.0))
    late = influence("clock: time", "clock: time", 0.02, VALUE * (-0.02j * 50.0))
    _, first, second = budget(Uncertainty((noise(1),), (mass, late)), VALUE)
    np.testing.assert_allclose(first.coefficient[0], -1.0 / 7.0)
    np.testing.assert_allclose(first.coefficient[1], 0.0, atol=1e-15)
    np.testing.assert_allclose(second.coefficient[1], -50.0)
    assert (first.count, first.u, first.unit) == (1, 0.02, "kg")
    assert np.isinf(first.dof).all()


def test_unknowns_of_one_label_stand_together() -> None:
    axes = [
        influence(f"centre {axis}", "centre of mass", 1e-3, VALUE * slope)
        for axis, slope in zip("xyz", (3e-4, 4e-4, 0), strict=True)
    ]
    other = influence("other", "scales", 1e-3, VALUE * 1e-4), influence("another", "scales", 2e-3, VALUE * 1e-4)
    scatter, centre, scales = budget(Uncertainty((noise(2),), (*axes, *other)), VALUE)
    np.testing.assert_allclose(centre.coefficient[0], 0.5)
    assert (centre.count, scales.count, scatter.count) == (3, 2, 0)
    assert np.isnan(scales.u)
    assert np.isnan(scales.coefficient).all()
    assert np.isnan(scatter.coefficient).all()
    assert scatter.dof.tolist() == [5.0, 9.0]


def test_what_two_results_share_is_added_before_it_is_squared() -> None:
    one = Uncertainty((noise(3),), (influence("clock", "clock", 1e-6, 1e-3j * VALUE),))
    other = Uncertainty((noise(4),), (influence("clock", "clock", 1e-6, -1e-3j * VALUE),))
    entry = budget(one.plus(other), VALUE)[1]
    np.testing.assert_allclose(entry.u_phase_rad, 0.0, atol=1e-18)


def test_values_that_are_not_known_have_no_budget() -> None:
    value = VALUE.copy()
    value[0, 1], value[1, 0] = np.nan, 0.0
    for entry in budget(Uncertainty((noise(5),), (influence("a", "a", 1.0, VALUE),)), value):
        assert np.isnan(entry.u_relative[0, 1])
        assert np.isnan(entry.u_relative[1, 0])
        assert np.isfinite(entry.u_relative[1, 1])
