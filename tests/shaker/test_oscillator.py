"""A resonance fitted: derivatives, exact parameters, Cramér-Rao bound, coverage, correlated lines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shaker.identification.measured import MeasuredCurve
from shaker.identification.oscillator import Kind, Resonance, fit_resonance

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
KINDS: tuple[Kind, ...] = ("transmissibility", "receptance", "mobility", "accelerance")
FREQUENCY = np.arange(1300.0, 1650.0, 1.0)


def curve(kind: Kind, f0: float, zeta: float, gain: complex, s: ComplexArray) -> ComplexArray:
    """The textbook formulas, written out."""
    w0 = 2.0 * np.pi * f0
    pole = s**2 + 2.0 * zeta * w0 * s + w0**2
    top = {"transmissibility": 2.0 * zeta * w0 * s + w0**2, "receptance": w0**2, "mobility": s * w0**2}
    return np.asarray(gain * top.get(kind, s**2 * w0**2) / pole)


def even(value: ComplexArray, share: float) -> FloatArray:
    """Covariance of circular noise, a share of the largest value."""
    return np.asarray((share * np.abs(value).max()) ** 2 * np.eye(2) * np.ones((len(value), 1, 1)))


def noise(covariance: FloatArray, rng: np.random.Generator) -> ComplexArray:
    draws = np.einsum("kij,kj->ki", np.linalg.cholesky(covariance), rng.standard_normal((len(covariance), 2)))
    return np.asarray(draws[:, 0] + 1j * draws[:, 1])


def fitted(value: ComplexArray, covariance: FloatArray, kind: Kind = "receptance", **words: Any) -> Resonance:
    """A resonance fitted to values at `FREQUENCY`; words of the curve."""
    return fit_resonance(MeasuredCurve(FREQUENCY, value, covariance, **words), kind)


@settings(max_examples=40, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    f0=st.floats(1350.0, 1600.0),
    zeta=st.floats(1e-3, 0.1),
    magnitude=st.floats(1e-9, 1e3),
    phase=st.floats(-3.0, 3.0),
    decay=st.sampled_from([0.0, 20.0]),
)
def test_parameters_come_back_from_a_curve_without_noise(
    kind: Kind, f0: float, zeta: float, magnitude: float, phase: float, decay: float
) -> None:
    gain = complex(magnitude * np.exp(1j * phase))
    value = curve(kind, f0, zeta, gain, decay + 2j * np.pi * FREQUENCY)
    fit = fit_resonance(MeasuredCurve(FREQUENCY, value, even(value, 1e-6), added_decay_per_s=decay), kind)
    assert fit.frequency_hz == pytest.approx(f0, rel=1e-8)
    assert fit.damping_ratio == pytest.approx(zeta, rel=1e-6)
    assert fit.gain == pytest.approx(gain, rel=1e-6)
    np.testing.assert_allclose(fit.model(FREQUENCY, decay), value, rtol=1e-6)
    assert fit.quality == pytest.approx(0.5 / zeta, rel=1e-6)


def test_delay_and_the_rest_of_the_structure_come_back() -> None:
    s = 2j * np.pi * FREQUENCY
    value = (curve("accelerance", 1477.35, 0.0076, 1e-8, s) + s**2 * (0.04 / s**2 + 3e-9)) * np.exp(-s * 2e-5)
    fit = fit_resonance(
        MeasuredCurve(FREQUENCY, value, even(value, 1e-6)), "accelerance", delay=True, residual_terms=True
    )
    assert fit.frequency_hz == pytest.approx(1477.35, rel=1e-7)
    assert fit.damping_ratio == pytest.approx(0.0076, rel=1e-5)
    np.testing.assert_allclose(fit.model(FREQUENCY), value, rtol=1e-6)
    assert len(fit.parameters) == 9
    assert fit.u("delay_s") > 0.0
    with pytest.raises(ValueError, match="expected one of frequency_hz"):
        fit.u("mass_kg")


def test_half_power_frequencies_are_where_the_receptance_has_lost_three_decibels() -> None:
    fit = Resonance(
        "receptance", 100.0, 0.05, 1.0, 0.0, np.zeros(2, dtype=np.complex128), (), np.zeros((0, 0)), 0.0, 1.0
    )
    fine = np.linspace(80.0, 120.0, 400001)
    peak = np.max(np.abs(fit.model(fine)))
    np.testing.assert_allclose(np.abs(fit.model(np.array(fit.half_power_hz))), peak / np.sqrt(2.0), rtol=1e-8)


def test_errors_are_those_of_the_bound_and_intervals_hold() -> None:
    # Bound: the covariance at the truth, from derivatives by differences, independent of the fit's own.
    truth = np.array([1477.35, 0.5 / 66.0, 1.0, 0.0])
    s = 2j * np.pi * FREQUENCY

    def at(p: FloatArray) -> ComplexArray:
        return curve("transmissibility", p[0], p[1], complex(p[2], p[3]), s)

    value = at(truth)
    covariance = (1e-3 * (0.2 + np.abs(value)))[:, None, None] ** 2 * np.array([[1.0, 0.3], [0.3, 0.5]])
    steps = np.diag([1e-3, 1e-7, 1e-6, 1e-6])
    slopes = np.stack([(at(truth + h) - at(truth - h)) / (2.0 * h.sum()) for h in steps], axis=1)
    both = np.stack([slopes.real, slopes.imag], axis=1)
    bound = np.linalg.inv(np.einsum("kia,kij,kjb->ab", both, np.linalg.inv(covariance), both))
    rng = np.random.default_rng(11)
    lengths, chi = [], []
    for _ in range(200):
        fit = fitted(value + noise(covariance, rng), covariance, "transmissibility")
        error = np.array([fit.frequency_hz, fit.damping_ratio, fit.gain.real, fit.gain.imag]) - truth
        lengths.append(error @ np.linalg.solve(bound, error))
        chi.append(fit.chi_squared)
    # χ² of 4 degrees of freedom: 200 trials put its mean within 4 ± 0.2.
    assert np.mean(lengths) == pytest.approx(4.0, abs=0.6)
    assert np.mean(np.array(lengths) < 9.488) == pytest.approx(0.95, abs=0.045)
    assert np.mean(chi) == pytest.approx(2 * len(FREQUENCY) - 4, rel=0.01)
    unit = np.sqrt(bound.diagonal())
    np.testing.assert_allclose(fit.covariance / np.outer(unit, unit), bound / np.outer(unit, unit), atol=0.2)


def test_correlated_lines_widen_the_uncertainty_as_they_widen_the_scatter() -> None:
    value = curve("receptance", 1477.35, 0.0076, 1.0, 2j * np.pi * FREQUENCY)
    kernel = np.array([1.0, 4 / 9, 1 / 36])
    matrix = sum(np.diag(np.full(len(FREQUENCY) - abs(d), kernel[abs(d)]), d) for d in range(-2, 3))
    root = np.linalg.cholesky(np.asarray(matrix))
    rng = np.random.default_rng(3)
    covariance = even(value, 1e-3)
    size = np.sqrt(covariance[0, 0, 0])
    error, u = [], 0.0
    for _ in range(150):
        draw = root @ (rng.standard_normal(len(value)) + 1j * rng.standard_normal(len(value)))
        fit = fitted(value + size * draw, covariance, line_correlation=kernel + 0j)
        error.append(fit.frequency_hz - 1477.35)
        u = fit.u("frequency_hz")
    assert np.std(error) == pytest.approx(u, rel=0.2)


def test_a_misfit_enlarges_the_uncertainty() -> None:
    value = curve("receptance", 1477.35, 0.0076, 1.0, 2j * np.pi * FREQUENCY)
    two = value + curve("receptance", 1560.0, 0.01, 0.1, 2j * np.pi * FREQUENCY)
    good = fitted(value, even(value, 1e-4))
    bad = fitted(two, even(value, 1e-4))
    assert bad.chi_squared > 100.0 * bad.dof
    assert bad.u("frequency_hz") > 10.0 * good.u("frequency_hz")


def test_what_cannot_be_fitted_is_refused_with_a_reason() -> None:
    value = curve("receptance", 1477.35, 0.0076, 1.0, 2j * np.pi * FREQUENCY)
    with pytest.raises(ValueError, match="more than 2 lines"):
        fit_resonance(MeasuredCurve(FREQUENCY[:2], value[:2], even(value[:2], 1e-3)), "receptance")
    with pytest.raises(ValueError, match="covariance: expected positive definite"):
        fitted(value, 0.0 * even(value, 1e-3))
    with pytest.raises(ValueError, match="covariance"):
        fit_resonance(MeasuredCurve(FREQUENCY, value, np.zeros((3, 2, 2))), "receptance")


@pytest.mark.slow
@pytest.mark.parametrize("periods", [3, 5, 9, 21])
def test_intervals_hold_also_where_covariances_come_from_few_periods(periods: int) -> None:
    # U (k = 2) of frequency and damping; weights 1/s² alone leave 83 % instead of 95 % at three periods and 60 lines.
    rng = np.random.default_rng(periods)
    dof = np.full(40, 2.0 * (periods - 1))
    held, chi = [], []
    for quality in np.repeat([20.0, 50.0, 100.0], 60):
        zeta = 0.5 / quality
        frequency = 1477.35 * (1.0 + 8.0 * zeta * np.linspace(-1.0, 1.02, len(dof)))
        value = curve("transmissibility", 1477.35, zeta, 1.0, 2j * np.pi * frequency)
        true = (0.02 * (0.3 * np.abs(value).max() + np.abs(value)))[:, None, None] ** 2 * np.eye(2)
        seen = true * (rng.chisquare(dof) / dof)[:, None, None]
        fit = fit_resonance(MeasuredCurve(frequency, value + noise(true, rng), seen, dof=dof), "transmissibility")
        held.append(abs(fit.frequency_hz - 1477.35) < 2.0 * fit.u("frequency_hz"))
        held.append(abs(fit.damping_ratio - zeta) < 2.0 * fit.u("damping_ratio"))
        chi.append(fit.chi_squared / fit.dof)
    # 360 nearly independent values: standard deviation of the share 0.011.
    assert 0.915 < np.mean(held) < 0.985
    assert np.median(chi) == pytest.approx(1.0, abs=0.25)


def test_degrees_of_freedom_of_many_periods_change_nothing() -> None:
    value = curve("receptance", 1477.35, 0.0076, 1.0, 2j * np.pi * FREQUENCY)
    covariance = even(value, 1e-2)
    value = value + noise(covariance, np.random.default_rng(2))
    exact = fitted(value, covariance)
    many = fit_resonance(MeasuredCurve(FREQUENCY, value, covariance, dof=np.full(len(value), 1e6)), "receptance")
    assert many.frequency_hz == pytest.approx(exact.frequency_hz, abs=1e-3 * exact.u("frequency_hz"))
    assert many.chi_squared == pytest.approx(exact.chi_squared, rel=1e-4)
    np.testing.assert_allclose(many.covariance, exact.covariance, rtol=1e-3, atol=1e-3 * exact.covariance.max())
    with pytest.raises(ValueError, match="dof"):
        fitted(value, covariance, dof=np.ones(3))
