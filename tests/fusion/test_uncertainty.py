"""Uncertainties: magnitude and phase, coverage, rounding, budgets and their files, against the GUM and Monte Carlo."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields

import h5py
import numpy as np
import pytest
from contracts import refused
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from fusion.base import prefix
from fusion.estimation.coverage import UNIFORM_PHASE_U, coverage_factor, polar, region, region_factor, region_matrix
from fusion.estimation.measurement_model import Deviates
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty, element_covariance, polar_elements
from fusion.report.h5 import Group, read_uncertainty, write_tree, write_uncertainty
from fusion.sensitivity.load_phasors import budget
from shakercal._common.digits import RoundedValue, round_to_uncertainty, typeset

COVARIANCE = np.array([[4e-4, 1.5e-4], [1.5e-4, 2.5e-4]])
finite = st.floats(-1e3, 1e3)


def test_uncertainties_of_magnitude_and_phase_agree_with_monte_carlo():
    value = 1.3 * np.exp(2.2j)
    draws = np.random.default_rng(3).multivariate_normal([value.real, value.imag], COVARIANCE, 200_000)
    sample = draws[:, 0] + 1j * draws[:, 1]
    result = polar(complex(value), COVARIANCE)
    # 200 000 draws fix a standard deviation to 0.16 %; the expansion itself is good to (u/|X|)² ≈ 2e-4.
    assert result.u_magnitude == pytest.approx(np.abs(sample).std(), rel=0.01)
    assert result.u_phase_rad == pytest.approx(np.angle(sample / value).std(), rel=0.01)
    assert result.r == pytest.approx(1.5 / np.sqrt(10.0))


def test_phase_of_an_unknown_number_is_uniform_on_the_half_open_circle():
    uniform = np.random.default_rng(1).uniform(-np.pi, np.pi, 400_000)
    result = polar(1e-9 + 0j, COVARIANCE)
    assert result.u_phase_rad == UNIFORM_PHASE_U == pytest.approx(uniform.std(), rel=0.005)
    assert polar(0j, COVARIANCE).u_phase_rad == UNIFORM_PHASE_U
    assert polar(0j, COVARIANCE).u_magnitude == pytest.approx(np.sqrt(3.25e-4))
    for zero in (0.0, -0.0):
        assert polar(complex(-1.0, zero), COVARIANCE).phase_rad == np.pi


@given(finite, finite, st.floats(-3.1, 3.1))
def test_turning_a_number_turns_the_phase_and_keeps_the_uncertainties(re, im, angle):
    value = complex(re, im)
    if abs(value) < 1e-3:
        return
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    before = polar(value, COVARIANCE)
    after = polar(value * np.exp(1j * angle), rotation @ COVARIANCE @ rotation.T)
    assert after.magnitude == pytest.approx(before.magnitude)
    assert after.u_magnitude == pytest.approx(before.u_magnitude)
    assert after.u_phase_rad == pytest.approx(before.u_phase_rad)
    assert np.exp(1j * (after.phase_rad - before.phase_rad)) == pytest.approx(np.exp(1j * angle))


def test_unknown_uncertainty_stays_unknown():
    result = polar(1.0 + 1.0j, np.full((2, 2), np.nan))
    assert result.magnitude == pytest.approx(np.sqrt(2.0))
    assert np.isnan([result.u_magnitude, result.u_phase_rad, result.u_re]).all()
    assert element_covariance(np.arange(36.0).reshape(6, 6), 1).tolist() == [[7.0, 10.0], [25.0, 28.0]]


@pytest.mark.parametrize(
    ("value", "expanded", "text"),
    [
        (189.32174, 0.3449, RoundedValue("189.32", "0.34", 0)),
        (1.9719871e-7, 2.04e-10, RoundedValue("1.9720", "0.0020", -7)),
        (-0.03372, 0.00101, RoundedValue("−0.0337", "0.0010", 0)),
        (0.5, 0.0996, RoundedValue("0.50", "0.10", 0)),
        (0.00001, 0.3, RoundedValue("0.00", "0.30", 0)),
        (-0.001, 0.3, RoundedValue("0.00", "0.30", 0)),
        (1234.0, 470.0, RoundedValue("1230", "470", 0)),
        (2.5, 0.0, RoundedValue("2.5", "–", 0)),
        (float("nan"), 1.0, RoundedValue("–", "–", 0)),
        (0.0, 0.0, RoundedValue("0", "–", 0)),
    ],
)
def test_rounding_to_the_second_digit_of_the_uncertainty(value, expanded, text):
    assert round_to_uncertainty(value, expanded) == text
    assert round_to_uncertainty(2.1e-10, 6.1e-11, -7) == RoundedValue(
        "0.00210", "0.00061", -7
    )  # with a given power of ten


@given(st.floats(1e-12, 1e12), st.floats(1e-5, 0.5))
def test_rounded_value_lies_within_half_a_unit_of_the_last_place(value, share):
    text = round_to_uncertainty(value, share * value)
    back = float(text.value) * 10.0**text.exponent
    assert abs(back - value) <= 0.051 * share * value


def test_prefix_and_units():
    assert prefix(np.array([3e-4, np.nan])) == (1e-6, "µ")
    assert prefix(np.array([6e-4])) == (1e-3, "m")
    assert prefix(np.array([])) == (1.0, "")
    assert prefix(np.array([0.0])) == (1e-9, "n")
    assert typeset("rad/s^2") == "rad/s²"
    assert typeset("(V/V)/(N.m)") == "(V/V)/(N·m)"
    assert [typeset(unit) for unit in ("N.m.s/rad", "kg.m^2", "0.1 V")] == ["N·m·s/rad", "kg·m²", "0.1 V"]


@pytest.mark.parametrize(
    ("dof", "factor"),
    [(1, 12.71), (2, 4.30), (3, 3.18), (4, 2.78), (8, 2.31), (20, 2.09), (50, 2.01), (100, 1.984), (np.inf, 1.960)],
)
def test_factors_of_the_table_of_the_gum(dof, factor):
    # JCGM 100:2008, table G.2, column 95 %.
    assert coverage_factor(dof) == pytest.approx(factor, abs=0.006)


@given(st.floats(0.5, 1e4))
def test_region_factor_is_that_of_two_parts_with_one_variance(dof):
    assert region_factor(dof) == pytest.approx(np.sqrt(2.0 * stats.f.ppf(0.95, 2, dof)), rel=1e-6)


def test_factors_at_the_ends():
    assert region_factor(np.inf) == pytest.approx(np.sqrt(stats.chi2.ppf(0.95, 2)), rel=1e-12)
    assert region_factor(1e9) == pytest.approx(region_factor(np.inf), rel=1e-8)
    assert region_factor(1e-3) == np.inf
    assert np.isnan(region_factor(np.nan))
    assert coverage_factor(0.0) == np.inf


@pytest.mark.parametrize("correlation", [0.0, 0.9, 0.99])
@pytest.mark.parametrize("dof", [1, 2, 5, 20])
@pytest.mark.parametrize("known", [0.0, 1.0])
def test_regions_hold_whatever_is_estimated_and_along_which_direction(correlation, dof, known):
    # A mean of dof + 1 complex readings whose parts may be correlated, and a stated u of the phase, `known` times as
    # large. 20 000 regions fix 95 % to 0.15 %.
    rng, trials = np.random.default_rng([int(10 * correlation), dof, int(known)]), 20_000
    root = np.array([[1.0, 0.0], [correlation, np.sqrt(1.0 - correlation**2)]])
    sample = rng.standard_normal((trials, dof, 2)) @ root.T
    error = rng.standard_normal((trials, 2)) @ root.T
    error[:, 1] += known * rng.standard_normal(trials)
    spread = np.einsum("tni,tnj->tij", sample, sample) / dof
    regions = known_phase(trials, known, float(dof), spread).regions(np.ones((trials, 1), np.complex128))[:, 0]
    squares = np.einsum("ti,ti->t", error, np.linalg.solve(regions, error[..., None])[..., 0])
    # At worst: two degrees of freedom and a correlation of 0.9; five and one of nearly 1.
    assert 0.925 < np.mean(squares <= 1.0) < 0.972


@pytest.mark.parametrize("truth", [0.0, 1.0])
@pytest.mark.parametrize("dof", [1, 5])
def test_regions_hold_where_noise_decides_the_direction_of_a_value(truth, dof):
    rng, trials = np.random.default_rng([dof, int(truth)]), 20_000
    sample, error = rng.standard_normal((trials, dof, 2)), rng.standard_normal((trials, 2))
    noise = Contribution("noise", "A", np.einsum("tni,tnj->tij", sample, sample) / dof, np.full(trials, float(dof)))
    regions = Uncertainty((noise,)).regions((truth + error @ [1.0, 1.0j])[:, None])[:, 0]
    squares = np.einsum("ti,ti->t", error, np.linalg.solve(regions, error[..., None])[..., 0])
    assert 0.925 < np.mean(squares <= 1.0) < 0.965


def test_axes_of_a_region():
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    covariance = turn @ np.diag([4.0, 0.25]) @ turn.T
    value, k = 5.0 * np.exp(0.3j), region_factor(np.inf)
    known = region(value, region_matrix(value, covariance))
    assert known.half_axes == pytest.approx((2.0 * k, 0.5 * k))
    assert known.angle_rad == pytest.approx(0.3)
    # Each part with its own factor: 5 degrees of freedom along the value, 2 across it.
    estimated = region(value, region_matrix(value, covariance, (5.0, 2.0)))
    assert estimated.half_axes == pytest.approx((2.0 * region_factor(5.0), 0.5 * region_factor(2.0)))
    assert region(1.0j, np.diag([1.0, 9.0])).angle_rad == pytest.approx(np.pi / 2.0)
    one = polar(value, covariance, 5.0)
    assert one.region_factor == pytest.approx(region_factor(5.0))
    assert polar(value, np.zeros((2, 2)), 5.0).region_factor == pytest.approx(region_factor(5.0))


def test_what_a_region_counts_of_a_correlation():
    value = np.array([[1.0 + 0.0j]])

    def correlation(dof: float, r: float) -> float:
        noise = Contribution("noise", "A", np.array([[[1.0, r], [r, 4.0]]]) * [[1.0, 2.0], [2.0, 1.0]], np.array([dof]))
        ((one,),) = polar_elements(value, Uncertainty((noise,)))
        return one.region_r

    assert correlation(np.inf, 0.6) == pytest.approx(0.6)
    assert 0.0 < correlation(20.0, 0.6) < 0.6
    assert -0.9 < correlation(20.0, -0.9) < 0.0
    assert correlation(5.0, 0.6) == correlation(2.0, 0.6) == correlation(1.0, 0.9) == 0.0
    # Two parts that one unknown moves are correlated, however few degrees of freedom its size has.
    tie = Influence("tilt", "tilt", 1.0, "rad", np.array([[0.6, 0.6]]), dof=2.0)
    nothing = Contribution("noise", "A", np.zeros((1, 2, 2)))
    ((one,),) = polar_elements(value, Uncertainty((nothing,), (tie,)))
    assert one.region_r == pytest.approx(1.0)


@given(st.floats(-np.pi, np.pi), st.floats(0.5, 1.5))
def test_a_region_holds_zero_as_its_ellipse_does(angle, share):
    edge = np.linalg.cholesky(COVARIANCE) @ [np.cos(angle), np.sin(angle)]
    assert abs(share - 1.0) < 1e-6 or region(share * complex(*edge), COVARIANCE).holds_zero == (share < 1.0)


@pytest.mark.parametrize("u_phase", [0.001, 0.07, 0.3])
@pytest.mark.parametrize("u_magnitude", [1e-5, 5e-3])
def test_regions_of_turned_values_hold_and_magnitude_and_phase_stay(u_phase, u_magnitude):
    # Readings are true values, stretched and turned; 40 000 fix 95 % to 0.11 %.
    rng, count, truth = np.random.default_rng(5), 40_000, 2.0 * np.exp(0.7j)
    read = truth * (1.0 + u_magnitude * rng.standard_normal(count)) * np.exp(1j * u_phase * rng.standard_normal(count))
    nothing = Contribution("noise", "A", np.zeros((count, 2, 2)))
    parts = (("laser: scale", u_magnitude, "1", read * u_magnitude), ("clock: time", 1e-6, "s", 1j * read * u_phase))
    told = Uncertainty(
        (nothing,), tuple(Influence(n, n, u, unit, np.stack([e.real, e.imag], axis=1)) for n, u, unit, e in parts)
    )
    error = np.stack([(truth - read).real, (truth - read).imag], axis=-1)[..., None]

    def held(matrix: np.ndarray) -> float:
        return float(np.mean((error.swapaxes(1, 2) @ np.linalg.solve(matrix, error))[:, 0, 0] <= 1.0))

    stated = told.regions(read[:, None])[:, 0]
    assert 0.945 < held(stated) < 0.965
    if u_phase >= 0.07 and u_magnitude < 5e-3:
        assert held(told.covariance * stats.chi2.ppf(0.95, 2)) < 0.94
    ((one,),) = polar_elements(read[:1, None], told.at_lines([0]))
    assert (one.u_magnitude, one.u_phase_rad) == pytest.approx((u_magnitude * abs(read[0]), u_phase), rel=1e-9)
    assert one.region.half_axes == pytest.approx(tuple(np.sqrt(np.linalg.eigvalsh(stated[0])[::-1])), rel=1e-4)


def test_only_times_turn_a_value():
    value, effect = np.array([[2.0j]]), np.array([[1.0, -0.2]])
    nothing, square = Contribution("noise", "A", np.zeros((1, 2, 2))), stats.chi2.ppf(0.95, 2)

    def beyond(unit: str, at: np.ndarray = value) -> np.ndarray:
        told = Uncertainty((nothing,), (Influence("one", "one", 1.0, unit, effect),))
        return np.asarray(told.regions(at)[0, 0] / square - told.covariance[0])

    # (1 - 0.2j)/2j = -0.1 - 0.5j: a delay turns by half a radian, which takes more of the imaginary part.
    np.testing.assert_allclose(beyond("s"), np.diag([0.0, 1.716 * 0.5**4 * 2.0**2]), atol=1e-12)
    for unit, at in (("rad", value), ("1", value), ("s", np.zeros((1, 1), np.complex128))):
        np.testing.assert_allclose(beyond(unit, at), 0.0, atol=1e-12)
    # Never longer along the value than a circle would be.
    far = region_matrix(2.0 + 0.0j, np.zeros((2, 2)), u_turn=3.0)
    np.testing.assert_allclose(far, np.diag([36.0 * square, 0.0]), rtol=1e-9)


@pytest.mark.parametrize("widths", [(1.0,), (1.0, 0.3, 0.1)])
@pytest.mark.parametrize("rest", [0.0, 0.3, 2.0])
def test_bounds_have_the_factor_of_their_distribution(widths, rest):
    # A magnitude off by numbers uniform within bounds, and by noise; the phase knows nothing of them.
    rng, count = np.random.default_rng(9), 200_000
    error = rng.uniform(-1.0, 1.0, (count, len(widths))) @ np.array(widths) + rest * rng.standard_normal(count)
    value = np.array([[100.0 * np.exp(0.3j)]])
    way = np.array([[np.cos(0.3), np.sin(0.3)]])
    noise = Contribution("noise", "A", rest**2 * np.eye(2)[None])
    bounds = tuple(
        Influence(f"bound {n}", "bounds", w / np.sqrt(3.0), "1", w / np.sqrt(3.0) * way, distribution="uniform")
        for n, w in enumerate(widths)
    )
    ((found,),) = polar_elements(value, Uncertainty((noise,), bounds))
    needed = np.quantile(np.abs(error), 0.95)
    assert found.expanded_magnitude == pytest.approx(needed, rel=0.01)
    assert found.expanded_magnitude <= np.sum(widths) + 1.96 * rest
    assert not rest or found.k_phase == pytest.approx(1.96, abs=1e-3)
    assert found.u_magnitude == pytest.approx(np.hypot(np.linalg.norm(widths) / np.sqrt(3.0), rest))


def known_phase(lines: int, u_rad: float, dof: float, spread: np.ndarray) -> Uncertainty:
    """Uncertainty of the value 1 at many lines: a covariance of `dof` degrees of freedom, and a phase as stated."""
    turned = Influence("clock: time", "clock", 1.0, "rad", np.tile([0.0, u_rad], (lines, 1)))
    return Uncertainty((Contribution("noise", "A", spread, np.full(lines, dof)),), (turned,))


def test_magnitude_and_phase_have_their_own_degrees_of_freedom():
    spread = np.tile(1e-8 * np.eye(2), (3, 1, 1))
    total = known_phase(3, 1e-2, 3.0, spread)
    ((first,), *_) = polar_elements(np.ones((3, 1), np.complex128), total)
    assert first.dof_magnitude == pytest.approx(3.0)
    assert first.dof_phase > 1e6
    assert first.k == pytest.approx(stats.t.ppf(0.975, 3.0))
    assert first.k_phase == pytest.approx(1.96, abs=1e-3)
    # Turned by a quarter, what was the magnitude's is the phase's.
    np.testing.assert_allclose(total.dof_polar(np.full((3, 1), 1j))[1], 3.0)
    # Nothing has a direction of its own at zero.
    np.testing.assert_allclose(total.dof_along(np.zeros((3, 1), np.complex128)), total.dof())
    # A contribution far above all others keeps its own number, and many degrees of freedom add up as JCGM 100 has it.
    other = Contribution("other", "A", 3.0 * spread, np.full(3, 200.0))
    both = Uncertainty((Contribution("noise", "A", spread, np.full(3, 100.0)), other))
    np.testing.assert_allclose(both.dof_along(np.ones(1, np.complex128)), 16.0 / (1.0 / 100 + 9.0 / 200), rtol=1e-3)


def test_an_unknown_of_type_a_counts_with_its_own_degrees_of_freedom():
    nothing = Contribution("noise", "A", np.zeros((1, 2, 2)), np.array([50.0]))
    tie = Influence("clock: time", "clock", 1e-6, "s", np.array([[0.0, 1e-3]]), "recording", "A", 6.0)
    total = Uncertainty((nothing,), (tie,))
    value = np.ones((1, 1), np.complex128)
    assert total.dof_polar(value)[1, 0, 0] == pytest.approx(6.0)
    assert total.dof()[0, 0] == pytest.approx(6.0)
    (noise_entry, tie_entry) = budget(total, value)
    assert (noise_entry.dof[0], tie_entry.dof[0], tie_entry.type) == (50.0, 6.0, "A")
    for mapped in (total.scaled(2.0 * value), total.plus(total), total.at([0]), total.at_lines([0])):
        assert mapped.influences[0].dof == 6.0
    # Draws of it are Student's, those of what is known normal.
    drawn = Deviates(1, 0, 200_000)
    assert np.quantile(np.abs(drawn.unknown("tie", 6.0)), 0.95) == pytest.approx(stats.t.ppf(0.975, 6.0), rel=0.02)
    assert np.quantile(np.abs(drawn.unknown("tie")), 0.95) == pytest.approx(1.96, rel=0.02)


@pytest.mark.parametrize("dof", [1, 2, 5])
@pytest.mark.parametrize("known", [0.0, 0.3, 1.0, 5.0])
def test_intervals_hold_whatever_the_share_of_what_is_estimated(dof, known):
    # A magnitude of which one part has few degrees of freedom and another, `known` times as large, is stated.
    rng, trials = np.random.default_rng([dof, int(10.0 * known)]), 20_000
    sample = rng.standard_normal((trials, dof))
    spread = np.zeros((trials, 2, 2))
    spread[:, 0, 0] = np.mean(sample**2, axis=1)
    stated = Influence("scale", "scale", 1.0, "1", np.tile([known, 0.0], (trials, 1)))
    total = Uncertainty((Contribution("noise", "A", spread, np.full(trials, float(dof))),), (stated,))
    k = stats.t.ppf(0.975, total.dof_along(np.ones(1, np.complex128))[:, 0])
    error = np.hypot(1.0, known) * rng.standard_normal(trials)
    held = np.mean(np.abs(error) <= k * np.sqrt(spread[:, 0, 0] + known**2))
    assert 0.926 < held < 0.970  # 20 000 intervals fix 95 % to 0.15 %


def test_two_readings_have_a_region_though_a_wide_one():
    (near,), (far,) = (
        polar_elements(np.array([[value]]), known_phase(1, 0.0, 1.0, np.diag([1.0, 4.0])[None]))[0]
        for value in (19.0 + 0j, 21.0 + 0j)
    )
    # 2·F of 2 and 1 degrees of freedom: 19.97².
    assert near.region.half_axes == pytest.approx((2.0 * 19.97, 19.97), rel=1e-3)
    assert near.region.holds_zero
    assert not far.region.holds_zero


def test_values_without_uncertainty_or_without_region():
    assert not region(1e-300 + 0j, np.zeros((2, 2))).holds_zero
    assert region(0j, np.zeros((2, 2))).holds_zero
    assert region(1.0 + 1.0j, np.full((2, 2), np.nan)).holds_zero
    assert region(1e9 + 0j, np.full((2, 2), np.inf)).holds_zero
    flat = region(1.0 + 0j, np.diag([0.0, 1.0]))
    assert not flat.holds_zero
    assert flat.half_axes[1] == 0.0


share = st.floats(-1.0, 1.0)
VALUES = np.array([[2.0 * np.exp(0.4j), -0.3 + 0.1j], [1.0j, 5.0 + 0.0j]])


def influence(name: str, label: str, u: float, effect: np.ndarray) -> Influence:
    return Influence(name, label, u, "kg", np.concatenate([effect.real, effect.imag], axis=1))


def noise(seed: int) -> Contribution:
    root = np.random.default_rng(seed).standard_normal((2, 4, 4)) * 1e-3
    return Contribution("noise", "A", root @ root.swapaxes(1, 2), np.array([5.0, 9.0]))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(share, share), min_size=1, max_size=5), st.integers(0, 1000))
def test_contributions_make_the_variance_of_magnitude_and_phase(parts, seed):
    names = [influence(f"{i}", f"label {i % 2}", 0.1, VALUES * complex(*part) * 1e-3) for i, part in enumerate(parts)]
    total = Uncertainty((noise(seed),), tuple(names))
    entries = budget(total, VALUES)
    for line, place in np.ndindex(VALUES.shape):
        covariance = total.covariance[line][np.ix_([place, place + 2], [place, place + 2])]
        value = VALUES[line, place]
        along = np.array([value.real, value.imag]) / abs(value)
        across = np.array([-value.imag, value.real]) / abs(value)
        magnitude = sum(entry.u_relative[line, place] ** 2 for entry in entries)
        phase = sum(entry.u_phase_rad[line, place] ** 2 for entry in entries)
        assert magnitude == pytest.approx(along @ covariance @ along / abs(value) ** 2, rel=1e-9)
        assert phase == pytest.approx(across @ covariance @ across / abs(value) ** 2, rel=1e-9)


def test_a_coefficient_is_the_change_per_unit_with_its_sign():
    mass = influence("load: mass", "load: mass", 0.02, VALUES * (-0.02 / 7.0))
    late = influence("clock: time", "clock: time", 0.02, VALUES * (-0.02j * 50.0))
    _, first, second = budget(Uncertainty((noise(1),), (mass, late)), VALUES)
    np.testing.assert_allclose(first.coefficient[0], -1.0 / 7.0)
    np.testing.assert_allclose(first.coefficient[1], 0.0, atol=1e-15)
    np.testing.assert_allclose(second.coefficient[1], -50.0)
    assert (first.count, first.u, first.unit) == (1, 0.02, "kg")
    assert np.isinf(first.dof).all()


def test_unknowns_of_one_label_stand_together():
    axes = [
        influence(f"centre {axis}", "centre of mass", 1e-3, VALUES * slope)
        for axis, slope in zip("xyz", (3e-4, 4e-4, 0), strict=True)
    ]
    other = influence("other", "scales", 1e-3, VALUES * 1e-4), influence("another", "scales", 2e-3, VALUES * 1e-4)
    scatter, centre, scales = budget(Uncertainty((noise(2),), (*axes, *other)), VALUES)
    np.testing.assert_allclose(centre.coefficient[0], 0.5)
    assert (centre.count, scales.count, scatter.count) == (3, 2, 0)
    assert np.isnan(scales.u)
    assert np.isnan(scales.coefficient).all()
    assert np.isnan(scatter.coefficient).all()
    assert scatter.dof.tolist() == [5.0, 9.0]


def test_what_two_results_share_is_added_before_it_is_squared():
    one = Uncertainty((noise(3),), (influence("clock", "clock", 1e-6, 1e-3j * VALUES),))
    other = Uncertainty((noise(4),), (influence("clock", "clock", 1e-6, -1e-3j * VALUES),))
    entry = budget(one.plus(other), VALUES)[1]
    np.testing.assert_allclose(entry.u_phase_rad, 0.0, atol=1e-18)


def test_values_that_are_not_known_have_no_budget():
    value = VALUES.copy()
    value[0, 1], value[1, 0] = np.nan, 0.0
    for entry in budget(Uncertainty((noise(5),), (influence("a", "a", 1.0, VALUES),)), value):
        assert np.isnan(entry.u_relative[0, 1])
        assert np.isnan(entry.u_relative[1, 0])
        assert np.isfinite(entry.u_relative[1, 1])


NAME = st.text(st.characters(codec="utf-8", exclude_characters="\0", exclude_categories=["Cs"]), min_size=1, max_size=8)
NUMBER = st.floats(allow_subnormal=True, width=64)


def stored(uncertainty: Uncertainty) -> Uncertainty:
    """Return an uncertainty as it comes back from a file that exists in memory only."""
    with written(uncertainty) as group:
        return read_uncertainty(group)


@contextmanager
def written(uncertainty: Uncertainty) -> Iterator[h5py.Group]:
    """Yield an uncertainty as a group of a file that exists in memory only."""
    top = Group()
    write_uncertainty(top.create_group("u"), uncertainty)
    with h5py.File("any.h5", "w", driver="core", backing_store=False) as file:
        write_tree(file, top)
        yield file["u"]


def assert_same(first: Uncertainty, second: Uncertainty) -> None:
    """Compare two uncertainties byte by byte, not-a-numbers and signs of zero included."""
    for one, other in zip((*first.random, *first.influences), (*second.random, *second.influences), strict=True):
        for field in fields(one):
            a, b = getattr(one, field.name), getattr(other, field.name)
            assert (a.shape, a.tobytes()) == (b.shape, b.tobytes()) if isinstance(a, np.ndarray) else a == b


@st.composite
def uncertainties(draw: st.DrawFn) -> Uncertainty:
    """Uncertainties of any size, with equal labels, empty lists of influences, infinities and not-a-numbers."""
    lines, size = draw(st.integers(1, 3)), 2 * draw(st.integers(1, 3))
    covariance = arrays(np.float64, (lines, size, size), elements=NUMBER)
    freedom = st.none() | arrays(np.float64, lines, elements=NUMBER)
    kind = st.sampled_from(["A", "B"])
    random = draw(st.lists(st.builds(Contribution, NAME, kind, covariance, freedom), min_size=1, max_size=4))
    effect = arrays(np.float64, (lines, size), elements=NUMBER)
    scope = st.sampled_from(["recording", "mounting", "rig"])
    known = st.floats(1.0, np.inf)
    influence = st.builds(Influence, NAME, NAME, st.floats(0.0, 1.0), NAME, effect, scope, kind, known)
    influences = draw(st.lists(influence, max_size=4, unique_by=lambda i: i.name))
    return Uncertainty(tuple(random), tuple(influences))


LABELS = ("z", "a", "stereo top/left: noise", "stereo top_left: noise", "a")


@settings(max_examples=12, deadline=None)
@given(uncertainties())
@example(Uncertainty(tuple(Contribution(label, "A", np.eye(2)[None] * k) for k, label in enumerate(LABELS))))
@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")
def test_what_is_read_is_what_was_written(uncertainty):
    assert_same(uncertainty, stored(uncertainty))


def test_the_covariance_of_everything_stands_beside():
    rng = np.random.default_rng(1)
    noise = Contribution("noise", "A", np.tile(np.eye(4), (2, 1, 1)), np.array([7.0, np.inf]))
    clock = Influence("clock", "time", 1e-6, "s", rng.standard_normal((2, 4)), "recording")
    whole = Uncertainty((noise,), (clock,))
    with written(whole) as group:
        assert np.array_equal(group["covariance"][()], whole.covariance)
        effect = group["effect"][()]
        total = group["random/noise/covariance"][()] + np.einsum("eki,ekj->kij", effect, effect)
        assert np.allclose(total, whole.covariance)
        assert group["scope"].asstr()[()].tolist() == ["recording"]


@pytest.mark.parametrize(("field", "found"), [("scope", "planet"), ("type", "C")])
def test_a_text_that_means_nothing_is_refused(field, found):
    influence = Influence("a", "a", 1.0, "m", np.zeros((1, 2)))
    with written(Uncertainty((Contribution("n", "A", np.eye(2)[None]),), (influence,))) as group:
        group[field][0] = found
        refused(f"{field}: expected one of", read_uncertainty, group)


def test_an_unknown_time_hides_the_phase_but_not_the_magnitude():
    """A turn by any angle, u = π/√3 across and 1 % along; noise of the same size along it hides both."""
    value, across = 2.0 * np.exp(0.7j), np.pi / np.sqrt(3.0) * 2.0
    axes = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    for along, hidden in ((0.02, False), (across, True)):
        found = polar(value, axes @ np.diag([along**2, (1.001 * across) ** 2]) @ axes.T)
        assert found.expanded_phase_rad > np.pi
        assert found.region.holds_zero == hidden
    assert found.magnitude == pytest.approx(2.0)
