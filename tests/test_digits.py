"""The rule for printed numbers: U with two digits, the value to its place, powers of ten, signs."""

from __future__ import annotations

import math
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shakercal._common.digits import (
    exponent_of,
    number_text,
    python_number,
    quantity_text,
    round_to_uncertainty,
    scaled_text,
    signed_text,
    tick_texts,
)
from shakercal._common.notices import DeclaredNotice, Notice, gather

SIZES = st.floats(-12.0, 12.0).map(lambda power: 10.0**power)
VALUES = st.builds(lambda size, sign: sign * size, SIZES, st.sampled_from([-1.0, 1.0]))


def _decimal(text: str) -> Decimal:
    return Decimal(text.replace("\N{MINUS SIGN}", "-"))


@given(VALUES, SIZES)
def test_value_and_u_end_at_the_same_place_of_which_u_has_two_digits(value: float, expanded: float) -> None:
    text = round_to_uncertainty(value, expanded)
    if expanded < 1e-10 * abs(value):  # beyond the digits of a double
        return
    shown, u = _decimal(text.value), _decimal(text.expanded)
    assert shown.as_tuple().exponent == u.as_tuple().exponent
    exact_u, exact = Decimal(expanded).scaleb(-text.exponent), Decimal(value).scaleb(-text.exponent)
    place = Decimal(1).scaleb(exact_u.adjusted() - 1)  # of the second digit of U
    assert abs(u - exact_u) <= place * Decimal("0.5001")
    assert abs(shown - exact) <= place * 10  # the next place if U is rounded up to it
    digits = f"{u.normalize():f}".replace(".", "").strip("0")
    assert len(digits) <= 2


@given(VALUES)
def test_powers_of_ten_are_named_outside_a_range_and_mantissas_have_one_digit_before_the_point(value: float) -> None:
    exponent = exponent_of(value)
    assert (exponent == 0) == (1e-3 <= abs(value) < 1e6) or exponent in (-3, 0)
    assert exponent == 0 or 0.999999 <= abs(value) / 10.0**exponent < 10.000001


@given(VALUES, st.integers(1, 7))
def test_numbers_are_read_back_within_half_of_their_last_digit(value: float, digits: int) -> None:
    text = number_text(value, digits)
    assert not {"e", "-"} & set(text)
    assert python_number(text) == pytest.approx(value, rel=0.501 * 10.0 ** (1 - digits))


@pytest.mark.parametrize(
    ("value", "expanded", "unit", "text"),
    [
        (0.5, 0.0996, "", "0.50 ± 0.10"),
        (0.0, 0.0996, "", "0.00 ± 0.10"),
        (-0.004, 0.1, "", "0.00 ± 0.10"),
        (1234.0, 120.0, "N", "(1230 ± 120) N"),
        (2.0012e-7, 1.3e-10, "(V/V)/N", "(2.0012 ± 0.0013) × 10⁻⁷ (V/V)/N"),
        (2.912e6, 4.3e3, "N.m/rad", "(2.9120 ± 0.0043) × 10⁶ N·m/rad"),
        (-3.0e-9, 5.0e-8, "m/s^2", "(−0.3 ± 5.0) × 10⁻⁸ m/s²"),
        (40.50, 0.12, "°", "(40.50 ± 0.12)°"),
        (2.5, 0.0, "m/s^2", "2.5 m/s²"),
        (2.5, math.inf, "N", "2.5 N"),
        (2.5, math.nan, "", "2.5"),
        (math.nan, 1.0, "", "–"),
        (math.inf, 1.0, "", "–"),
    ],
)
def test_quantities(value: float, expanded: float, unit: str, text: str) -> None:
    assert quantity_text(value, expanded, unit) == text


def test_a_complex_value_has_no_order_and_is_refused() -> None:
    with pytest.raises(TypeError):
        quantity_text(1.0 + 1.0j, 0.1)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (9.97e-5, 2, "1 × 10⁻⁴"),
        (-502.0, 2, "−500"),
        (99_999.9, 3, "100000"),
        (999_999.9, 3, "1 × 10⁶"),
        (0.0, 3, "0"),
        (1470.0, 3, "1470"),
    ],
)
def test_numbers_without_u(value: float, digits: int, text: str) -> None:
    assert number_text(value, digits) == text
    assert number_text(math.nan) == number_text(None) == "–"


def test_columns_name_the_power_in_their_head() -> None:
    assert scaled_text(2.1e-10, 6.1e-11, -7) == "0.00210 ± 0.00061"
    assert [signed_text(value, "+.2f") for value in (-0.5, -0.001, 0.5)] == ["−0.50", "0.00", "+0.50"]


def test_ticks_have_as_many_decimals_as_distinguish_them() -> None:
    assert tick_texts([-0.5, 0.0, 0.5]) == ["−0.5", "0.0", "0.5"]
    assert tick_texts([0.0, 0.25, 0.5]) == ["0.00", "0.25", "0.50"]


def test_notices_print_numbers_by_the_same_rule() -> None:
    template = "{a:.4g} ± {b:.1g} Hz, {a:.3g} Hz, {b:.2g}, {c:.2g} rad, {share:.2%}, {n}."
    declared = DeclaredNotice("SC-999", "note", template)
    notice = Notice(declared, "", a=9187.3, b=4960.0, c=-3.2e-7, share=0.051, n=3)
    assert notice.text == "(9200 ± 5000) Hz, 9190 Hz, 5000, −3.2 × 10⁻⁷ rad, 5.10 %, 3."
    gathered = gather([("x", [notice]), ("y", [Notice(declared, "", a=20_000.0, b=50.0, c=-3.2e-8, share=0.051, n=3)])])
    assert "−3.2 × 10⁻⁷ to −3.2 × 10⁻⁸ rad" in gathered[0].text
