"""Magnitude and phase against Monte Carlo and exact cases; rounding against the rules of the GUM."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.estimation.uncertainty import UNIFORM_PHASE_U, Rounded, element_covariance, polar, prefix, rounded, typeset

COVARIANCE = np.array([[4e-4, 1.5e-4], [1.5e-4, 2.5e-4]])
finite = st.floats(-1e3, 1e3)


def test_uncertainties_of_magnitude_and_phase_agree_with_monte_carlo() -> None:
    value = 1.3 * np.exp(2.2j)
    draws = np.random.default_rng(3).multivariate_normal([value.real, value.imag], COVARIANCE, 200_000)
    sample = draws[:, 0] + 1j * draws[:, 1]
    result = polar(complex(value), COVARIANCE)
    # 200 000 draws fix a standard deviation to 0.16 %; the expansion itself is good to (u/|X|)² ≈ 2e-4.
    assert result.u_magnitude == pytest.approx(np.abs(sample).std(), rel=0.01)
    assert result.u_phase_rad == pytest.approx(np.angle(sample / value).std(), rel=0.01)
    assert result.r == pytest.approx(1.5 / np.sqrt(10.0))


def test_phase_of_an_unknown_number_is_uniform_on_the_circle() -> None:
    uniform = np.random.default_rng(1).uniform(-np.pi, np.pi, 400_000)
    result = polar(1e-9 + 0j, COVARIANCE)
    assert result.u_phase_rad == UNIFORM_PHASE_U == pytest.approx(uniform.std(), rel=0.005)
    assert polar(0j, COVARIANCE).u_phase_rad == UNIFORM_PHASE_U
    assert polar(0j, COVARIANCE).u_magnitude == pytest.approx(np.sqrt(3.25e-4))


@pytest.mark.parametrize("value", [complex(-1.0, 0.0), complex(-1.0, -0.0)])
def test_phase_lies_in_the_half_open_interval(value: complex) -> None:
    assert polar(value, COVARIANCE).phase_rad == np.pi


@given(finite, finite, st.floats(-3.1, 3.1))
def test_turning_a_number_turns_the_phase_and_keeps_the_uncertainties(re: float, im: float, angle: float) -> None:
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


def test_unknown_uncertainty_stays_unknown() -> None:
    result = polar(1.0 + 1.0j, np.full((2, 2), np.nan))
    assert result.magnitude == pytest.approx(np.sqrt(2.0))
    assert np.isnan([result.u_magnitude, result.u_phase_rad, result.u_re]).all()


def test_element_of_a_stacked_covariance() -> None:
    stacked = np.arange(36.0).reshape(6, 6)
    assert element_covariance(stacked, 1).tolist() == [[7.0, 10.0], [25.0, 28.0]]


@pytest.mark.parametrize(
    ("value", "expanded", "text"),
    [
        (189.32174, 0.3449, Rounded("189.32", "0.34", 0)),
        (1.9719871e-7, 2.04e-10, Rounded("1.9720", "0.0020", -7)),
        (-0.03372, 0.00101, Rounded("−0.0337", "0.0010", 0)),
        (0.5, 0.0996, Rounded("0.50", "0.10", 0)),
        (0.00001, 0.3, Rounded("0.00", "0.30", 0)),
        (-0.001, 0.3, Rounded("0.00", "0.30", 0)),
        (1234.0, 470.0, Rounded("1230", "470", 0)),
        (2.5, 0.0, Rounded("2.5", "–", 0)),
        (float("nan"), 1.0, Rounded("–", "–", 0)),
        (0.0, 0.0, Rounded("0", "–", 0)),
    ],
)
def test_rounding_to_the_second_digit_of_the_uncertainty(value: float, expanded: float, text: Rounded) -> None:
    assert rounded(value, expanded) == text


def test_rounding_with_a_given_power_of_ten() -> None:
    assert rounded(2.1e-10, 6.1e-11, -7) == Rounded("0.00210", "0.00061", -7)


@given(st.floats(1e-12, 1e12), st.floats(1e-5, 0.5))
def test_rounded_value_lies_within_half_a_unit_of_the_last_place(value: float, share: float) -> None:
    text = rounded(value, share * value)
    back = float(text.value) * 10.0**text.exponent
    assert abs(back - value) <= 0.051 * share * value


def test_prefix_and_units() -> None:
    assert prefix(np.array([3e-4, np.nan])) == (1e-6, "µ")
    assert prefix(np.array([6e-4])) == (1e-3, "m")
    assert prefix(np.array([])) == (1.0, "")
    assert prefix(np.array([0.0])) == (1e-9, "n")
    assert typeset("rad/s^2") == "rad/s²"
    assert typeset("(V/V)/(N.m)") == "(V/V)/(N·m)"
