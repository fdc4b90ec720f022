"""Phasors: units, covariance and selection against independent arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.sine.phasor import Phasors, derivative_factor, stack_phasors


def _random_phasors(rng: np.random.Generator, lines: int = 2, channels: int = 3) -> Phasors:
    root = rng.normal(size=(lines, 2 * channels, 2 * channels))
    return Phasors(
        frequency_hz=np.array([106.25, 425.0])[:lines],
        value=rng.normal(size=(lines, channels)) + 1j * rng.normal(size=(lines, channels)),
        covariance=root @ root.swapaxes(1, 2),
        channels=tuple("abc"[:channels]),
        unit=("m",) * channels,
        dof=np.full(lines, 10.0),
    )


def test_second_derivative_of_a_displacement_is_its_acceleration() -> None:
    # The published load mass: 0.4277 mm at 106.2495 Hz is 190.6131 m/s^2.
    factor = derivative_factor(np.array([106.2495]), 2)
    assert factor[0] * 0.4277e-3 == pytest.approx(-190.6131, rel=1e-6)
    assert factor[0].imag == 0.0


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 5e4), st.integers(-3, 3), st.integers(-3, 3))
def test_derivatives_add_up(frequency: float, first: int, second: int) -> None:
    f = np.array([frequency])
    both = derivative_factor(f, first) * derivative_factor(f, second)
    np.testing.assert_allclose(both, derivative_factor(f, first + second), rtol=1e-12)


def test_covariance_of_scaled_phasors_agrees_with_drawn_samples() -> None:
    rng = np.random.default_rng(4)
    phasors = _random_phasors(rng, lines=1)
    factor = np.array([[0.5 - 2.0j, 3.0 + 0.0j, 1.0j]])
    draws = rng.multivariate_normal(np.zeros(6), phasors.covariance[0], size=40_000)
    scaled = (draws[:, :3] + 1j * draws[:, 3:]) * factor
    expected = np.cov(np.concatenate([scaled.real, scaled.imag], axis=1).T)
    got = phasors.scaled(factor).covariance[0]
    np.testing.assert_allclose(got, expected, atol=0.03 * np.abs(expected).max())


def test_selection_keeps_values_and_covariances_together() -> None:
    phasors = _random_phasors(np.random.default_rng(1))
    picked = phasors.select(["c", "a"])
    np.testing.assert_array_equal(picked.value, phasors.value[:, [2, 0]])
    np.testing.assert_array_equal(picked.covariance[:, 1, 2], phasors.covariance[:, 0, 5])
    np.testing.assert_array_equal(picked.u_im[:, 0] ** 2, phasors.covariance[:, 5, 5])
    with pytest.raises(ValueError, match=r"channels: expected some of a, b, c, found d"):
        phasors.select(["d"])


def test_stacking_undoes_selection_for_independent_channels() -> None:
    phasors = _random_phasors(np.random.default_rng(2))
    joined = stack_phasors([phasors.select(["a", "b"]), phasors.select(["c"])])
    assert joined.channels == phasors.channels
    np.testing.assert_array_equal(joined.value, phasors.value)
    np.testing.assert_array_equal(joined.select(["a", "b"]).covariance, phasors.select(["a", "b"]).covariance)
    np.testing.assert_array_equal(joined.covariance[:, 0, 2], 0.0)


def test_lines_can_be_picked() -> None:
    phasors = _random_phasors(np.random.default_rng(3))
    picked = phasors.at_lines(np.array([False, True]))
    assert picked.frequency_hz.tolist() == [425.0]
    np.testing.assert_array_equal(picked.value[0], phasors.value[1])


def test_wrong_shapes_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"covariance: expected an array of shape \(1, 2, 2\), found \(1, 1, 1\)"):
        Phasors(np.ones(1), np.ones((1, 1), complex), np.ones((1, 1, 1)), ("a",), ("m",), np.ones(1))
    with pytest.raises(ValueError, match="unit: expected 1 units"):
        Phasors(np.ones(1), np.ones((1, 1), complex), np.ones((1, 2, 2)), ("a",), (), np.ones(1))
