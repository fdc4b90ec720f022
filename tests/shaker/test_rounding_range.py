"""What rounded coefficients may stand for: against random systems of the box, and in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from published_formulas import rounding_range

RATE = 1e5


@pytest.mark.parametrize(
    ("denominator", "digit"),
    [
        ([1, -2.841, 2.702, -0.8597], [0, 1e-3, 1e-3, 1e-4]),
        ([1, -1.009, -0.9739, 0.9831], [0, 1e-3, 1e-4, 1e-4]),
        ([1, -1.053, -0.8864, 0.941], [0, 1e-3, 1e-4, 1e-3]),
    ],
)
def test_random_systems_lie_inside_and_come_close(denominator: list[float], digit: list[float]) -> None:
    centre, last = np.array(denominator), np.array(digit)
    found = rounding_range(centre, last, RATE)
    rng, hertz, radius = np.random.default_rng(5), [], []
    for _ in range(4000):
        z = np.roots(centre + (rng.random(4) - 0.5) * last)
        radius.append(np.abs(z).max())
        upper = z[z.imag > 0]
        if len(upper):
            hertz.append(np.abs(np.log(upper)).min() * RATE / (2 * np.pi))
    low, high = found.natural_hz
    assert low <= min(hertz) * (1 + 1e-3)
    assert max(hertz) <= high * (1 + 1e-9)
    assert min(hertz) - low < 0.1 * (high - low)
    assert high - max(hertz) < 0.1 * (high - low)
    assert max(radius) <= found.radius < max(radius) + 2e-3
    assert found.always_oscillates == (len(hertz) == len(radius))


def test_an_exact_denominator_has_one_frequency() -> None:
    pole = np.exp((-0.02 + 1j * np.sqrt(1 - 0.02**2)) * 2 * np.pi * 1700 / RATE)
    found = rounding_range(np.real(np.poly([pole, np.conj(pole)])), np.zeros(3), RATE)
    assert found.natural_hz == pytest.approx([1700, 1700], rel=1e-9)
    assert found.radius == pytest.approx(abs(pole), rel=1e-12)


def test_one_free_coefficient_in_closed_form() -> None:
    """z² - 2c z + 1 with |c - 0.9| ≤ 0.05 has z = exp(±j·arccos c)."""
    found = rounding_range(np.array([1, -1.8, 1.0]), np.array([0, 0.2, 0]), 2 * np.pi)
    assert found.natural_hz == pytest.approx([np.arccos(0.95), np.arccos(0.85)], rel=1e-12)


def test_a_first_order_never_oscillates() -> None:
    found = rounding_range(np.array([1, -0.9]), np.array([0, 0.1]), RATE)
    assert np.all(np.isnan(found.natural_hz))
    assert found.radius == pytest.approx(0.95)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="last_digit"):
        rounding_range(np.ones(3), np.ones(2), RATE)
    with pytest.raises(ValueError, match="denominator"):
        rounding_range(np.ones(1), np.ones(1), RATE)
    with pytest.raises(ValueError, match="sample_rate_hz"):
        rounding_range(np.ones(3), np.ones(3), 0.0)
