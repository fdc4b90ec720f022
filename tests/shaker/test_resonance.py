"""One resonance, fitted and read: derivatives, exact parameters, bounds, coverage at any spacing; the fitting core."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg
from scipy.optimize import brentq, least_squares, minimize_scalar

from shaker.identification.measured_curves import MeasuredCurve, fit_circle
from shaker.identification.oscillator import (
    PeakReadings,
    Resonance,
    ResonanceKind,
    fit_resonance,
    peak_readings,
    transmissibility_levels,
)
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.fitting import (
    BlockJacobian,
    LinearBlock,
    LMOptions,
    Minimum,
    ParameterPrior,
    SeparablePoint,
    WhitenedResiduals,
    eliminate,
    levenberg_marquardt,
)

KINDS: tuple[ResonanceKind, ...] = ("transmissibility", "receptance", "mobility", "accelerance")
FREQUENCY = np.arange(1300.0, 1650.0, 1.0)


def curve(kind: ResonanceKind, f0: float, zeta: float, gain: complex, s: ComplexArray) -> ComplexArray:
    """The textbook formulas, written out."""
    w0 = 2.0 * np.pi * f0
    pole = s**2 + 2.0 * zeta * w0 * s + w0**2
    top = {"transmissibility": 2.0 * zeta * w0 * s + w0**2, "receptance": w0**2, "mobility": s * w0**2}
    return np.asarray(gain * top.get(kind, s**2 * w0**2) / pole)


def even(value: ComplexArray, share: float) -> FloatArray:
    """Covariance of circular noise, in each part a share of the largest value."""
    return np.asarray((share * np.abs(value).max()) ** 2 * np.eye(2) * np.ones((len(value), 1, 1)))


def noise(covariance: FloatArray, rng: np.random.Generator) -> ComplexArray:
    draws = np.einsum("kij,kj->ki", np.linalg.cholesky(covariance), rng.standard_normal((len(covariance), 2)))
    return np.asarray(draws[:, 0] + 1j * draws[:, 1])


def fitted(value: ComplexArray, covariance: FloatArray, kind: ResonanceKind = "receptance", **words: Any) -> Resonance:
    """A resonance fitted to values at `FREQUENCY`; words of the curve."""
    return fit_resonance(MeasuredCurve(FREQUENCY, value, covariance, **words), kind)


ONE = curve("receptance", 1477.35, 0.0076, 1.0, 2j * np.pi * FREQUENCY)


@settings(max_examples=20, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    f0=st.floats(1350.0, 1600.0),
    zeta=st.floats(1e-3, 0.1),
    magnitude=st.floats(1e-9, 1e3),
    phase=st.floats(-3.0, 3.0),
    decay=st.sampled_from([0.0, 20.0]),
)
def test_parameters_come_back_from_a_curve_without_noise(kind, f0, zeta, magnitude, phase, decay):
    gain = complex(magnitude * np.exp(1j * phase))
    value = curve(kind, f0, zeta, gain, decay + 2j * np.pi * FREQUENCY)
    fit = fit_resonance(MeasuredCurve(FREQUENCY, value, even(value, 1e-6), added_decay_per_s=decay), kind)
    assert (fit.frequency_hz, fit.damping_ratio) == (pytest.approx(f0, rel=1e-8), pytest.approx(zeta, rel=1e-6))
    assert fit.gain == pytest.approx(gain, rel=1e-6)
    np.testing.assert_allclose(fit.model(FREQUENCY, decay), value, rtol=1e-6)
    assert fit.quality == pytest.approx(0.5 / zeta, rel=1e-6)


def test_delay_and_the_rest_of_the_structure_come_back():
    s = 2j * np.pi * FREQUENCY
    value = (curve("accelerance", 1477.35, 0.0076, 1e-8, s) + s**2 * (0.04 / s**2 + 3e-9)) * np.exp(-s * 2e-5)
    fit = fit_resonance(
        MeasuredCurve(FREQUENCY, value, even(value, 1e-6)), "accelerance", delay=True, residual_terms=True
    )
    assert (fit.frequency_hz, fit.damping_ratio) == (pytest.approx(1477.35, rel=1e-7), pytest.approx(0.0076, rel=1e-5))
    np.testing.assert_allclose(fit.model(FREQUENCY), value, rtol=1e-6)
    assert len(fit.parameters) == 9
    assert fit.u("delay_s") > 0.0
    refused("^parameter: .*mass_kg", fit.u, "mass_kg")


def test_the_covariance_is_that_of_the_bound():
    # Bound: the covariance at the truth, from derivatives by differences, independent of the fit's own.
    truth, s = np.array([1477.35, 0.5 / 66.0, 1.0, 0.0]), 2j * np.pi * FREQUENCY

    def at(p: FloatArray) -> ComplexArray:
        return curve("transmissibility", p[0], p[1], complex(p[2], p[3]), s)

    value = at(truth)
    covariance = (1e-3 * (0.2 + np.abs(value)))[:, None, None] ** 2 * np.array([[1.0, 0.3], [0.3, 0.5]])
    steps = np.diag([1e-3, 1e-7, 1e-6, 1e-6])
    slopes = np.stack([(at(truth + h) - at(truth - h)) / (2.0 * h.sum()) for h in steps], axis=1)
    both = np.stack([slopes.real, slopes.imag], axis=1)
    bound = np.linalg.inv(np.einsum("kia,kij,kjb->ab", both, np.linalg.inv(covariance), both))
    unit = np.sqrt(np.outer(bound.diagonal(), bound.diagonal()))
    np.testing.assert_allclose(fitted(value, covariance, "transmissibility").covariance / unit, bound / unit, atol=1e-3)


def test_correlated_lines_enter_the_uncertainty():
    """Against the whole covariance matrix of all lines, with derivatives by differences."""
    truth, s = np.array([1477.35, 0.0076, 1.0, 0.0]), 2j * np.pi * FREQUENCY
    kernel, sigma, steps = np.array([1.0, 4 / 9, 1 / 36]), 1e-3 * np.abs(ONE).max(), np.diag([1e-3, 1e-7, 1e-6, 1e-6])
    between = linalg.toeplitz(np.pad(kernel, (0, len(ONE) - 3)))
    ends = [[curve("receptance", p[0], p[1], complex(p[2], p[3]), s) for p in (truth - h, truth + h)] for h in steps]
    slopes = np.stack([(high - low) / (2.0 * h.sum()) for (low, high), h in zip(ends, steps, strict=True)]) / sigma
    inner = np.linalg.inv((slopes.conj() @ slopes.T).real)
    expected = inner @ (slopes.conj() @ between @ slopes.T).real @ inner
    fit = fitted(ONE, even(ONE, 1e-3), line_correlation=kernel + 0j)
    np.testing.assert_allclose(fit.covariance, expected, rtol=1e-4, atol=1e-4 * np.sqrt(expected.max()) * 1e-6)
    seen = MeasuredCurve(FREQUENCY, ONE, even(ONE, 1e-3), kernel + 0j)
    expected = sigma**2 * (slopes.conj() @ between @ slopes.T).real
    unit = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(seen.propagated(slopes) / unit, expected / unit, atol=1e-9)


def test_a_misfit_enlarges_the_uncertainty():
    two = ONE + curve("receptance", 1560.0, 0.01, 0.1, 2j * np.pi * FREQUENCY)
    good, bad = fitted(ONE, even(ONE, 1e-4)), fitted(two, even(ONE, 1e-4))
    assert bad.chi_squared > 100.0 * bad.dof
    assert bad.u("frequency_hz") > 10.0 * good.u("frequency_hz")


def test_what_cannot_be_fitted_is_refused_with_a_reason():
    few = MeasuredCurve(FREQUENCY[:2], ONE[:2], even(ONE[:2], 1e-3))
    refused("^frequency_hz: .* 2 ", fit_resonance, few, "receptance")
    refused("^covariance: ", fitted, ONE, 0.0 * even(ONE, 1e-3))
    refused("covariance", MeasuredCurve, FREQUENCY, ONE, np.zeros((3, 2, 2)))
    refused("dof", fitted, ONE, even(ONE, 1e-3), dof=np.ones(3))


@pytest.mark.slow
@pytest.mark.parametrize("periods", [3, 5, 9, 21])
def test_intervals_cover_the_truth_with_covariances_from_few_periods(periods):
    # U (k = 2) of frequency and damping; weights 1/s² alone leave 83 % instead of 95 % at three periods and 60 lines.
    rng, dof = np.random.default_rng(periods), np.full(40, 2.0 * (periods - 1))
    inside, chi = [], []
    for quality in np.repeat([20.0, 50.0, 100.0], 60):
        zeta = 0.5 / quality
        frequency = 1477.35 * (1.0 + 8.0 * zeta * np.linspace(-1.0, 1.02, len(dof)))
        value = curve("transmissibility", 1477.35, zeta, 1.0, 2j * np.pi * frequency)
        true = (0.02 * (0.3 * np.abs(value).max() + np.abs(value)))[:, None, None] ** 2 * np.eye(2)
        seen = true * (rng.chisquare(dof) / dof)[:, None, None]
        fit = fit_resonance(MeasuredCurve(frequency, value + noise(true, rng), seen, dof=dof), "transmissibility")
        inside.append(abs(fit.frequency_hz - 1477.35) < 2.0 * fit.u("frequency_hz"))
        inside.append(abs(fit.damping_ratio - zeta) < 2.0 * fit.u("damping_ratio"))
        chi.append(fit.chi_squared / fit.dof)
    # 360 nearly independent values: standard deviation of the share 0.011.
    assert 0.915 < np.mean(inside) < 0.985
    assert np.median(chi) == pytest.approx(1.0, abs=0.25)


def test_degrees_of_freedom_of_many_periods_have_no_effect():
    covariance = even(ONE, 1e-2)
    value = ONE + noise(covariance, np.random.default_rng(2))
    exact, many = fitted(value, covariance), fitted(value, covariance, dof=np.full(len(value), 1e6))
    assert many.frequency_hz == pytest.approx(exact.frequency_hz, abs=1e-3 * exact.u("frequency_hz"))
    assert many.chi_squared == pytest.approx(exact.chi_squared, rel=1e-4)
    np.testing.assert_allclose(many.covariance, exact.covariance, rtol=1e-3, atol=1e-3 * exact.covariance.max())


F0, SPACING = 1477.35, 0.78125
GAIN = 1.02 * np.exp(0.3j)
METHODS = ("maximum_bin", "maximum", "half_power", "half_amplitude", "circle")


def transmissibility(frequency_hz: FloatArray, f0: float, zeta: float) -> ComplexArray:
    """(1 + 2jζr)/(1 - r² + 2jζr)."""
    return curve("transmissibility", f0, zeta, 1.0, 2j * np.pi * frequency_hz)


def measured(frequency: FloatArray, value: ComplexArray, share: float, **words: Any) -> MeasuredCurve:
    """A curve with circular noise of a share of its largest |H|."""
    return MeasuredCurve(frequency, value, even(value, share), **words)


def read(frequency: FloatArray, value: ComplexArray, share: float) -> PeakReadings:
    return peak_readings(measured(frequency, value, share))


def draws(clean: ComplexArray, share: float, trials: int, seed: int) -> list[tuple[ComplexArray, FloatArray]]:
    """Values with noise of a share of the largest |H|, and the covariance of that."""
    rng, covariance = np.random.default_rng(seed), even(clean, share)
    return [(clean + noise(covariance, rng), covariance) for _ in range(trials)]


def lines(f0: float, zeta: float, spacing: float, shift: float = 0.0) -> FloatArray:
    """A grid that holds the width at half amplitude and more."""
    reach = max(12.0 * spacing, 5.0 * zeta * f0)
    first = np.ceil((f0 - reach) / spacing) + shift
    return np.asarray(spacing * (first + np.arange(int(2.0 * reach / spacing))))


def by_search(zeta: float) -> tuple[float, float, float]:
    """Maximum and half-power points of |T|² found by numerical search."""

    def power(r: float) -> float:
        return float(np.abs(transmissibility(np.array([r]), 1.0, zeta)[0]) ** 2)

    top = float(minimize_scalar(lambda r: -power(r), bounds=(0.5, 1.2), method="bounded", options={"xatol": 1e-12}).x)
    goal = 0.5 * power(top)
    return top, brentq(lambda r: power(r) - goal, 1e-3, top), brentq(lambda r: power(r) - goal, top, 3.0)


@pytest.mark.parametrize("zeta", [1e-3, 0.0075, 0.05, 0.15])
def test_levels_of_the_transmissibility_are_where_a_search_finds_them(zeta):
    expected, found = by_search(zeta), transmissibility_levels(zeta)
    assert found[0] == pytest.approx(expected[0], abs=1e-7)  # a flat top is found to the root of the precision
    assert found[1:] == pytest.approx(expected[1:], rel=1e-9)
    assert found[0] == pytest.approx(1.0 - zeta**2, abs=4.0 * zeta**4)


@settings(max_examples=15, deadline=None)
@given(
    quality=st.floats(20.0, 800.0),
    shift=st.floats(0.0, 1.0),
    spacing=st.floats(0.1, 1.0),
    magnitude=st.floats(1e-6, 1e3),
    phase=st.floats(-3.0, 3.0),
)
def test_without_noise_only_the_bin_maximum_depends_on_the_lines(quality, shift, spacing, magnitude, phase):
    zeta = 0.5 / quality
    frequency = lines(F0, zeta, spacing, shift)
    value = transmissibility(frequency, F0, zeta) * magnitude * np.exp(1j * phase)
    found = read(frequency, value, 1e-6)
    top, low, high = transmissibility_levels(zeta)
    assert found.circle.frequency_hz == pytest.approx(F0, rel=1e-9)
    assert (found.circle.damping_ratio, found.half_power.frequency_hz) == pytest.approx((zeta, F0), rel=1e-7)
    assert found.half_power.damping_ratio == pytest.approx(zeta, rel=1e-7 + 0.05 * zeta**2)
    assert found.half_power.width_hz == pytest.approx((high - low) * F0, rel=1e-7 + 0.05 * zeta**2)
    assert found.maximum.frequency_hz == pytest.approx(top * F0, rel=1e-8 + 5.0 * zeta**4)
    assert found.half_amplitude.damping_ratio == pytest.approx(np.sqrt(3.0) * zeta, rel=1e-6 + 5.0 * zeta**2)
    assert abs(found.maximum_bin.frequency_hz - top * F0) <= 0.5 * spacing * (1.0 + 1e-6)
    assert found.lines_in_width == pytest.approx(found.half_power.width_hz / spacing)


@pytest.mark.parametrize(
    ("quality", "share", "spacing"),
    [
        (66.0, 1e-3, SPACING),
        (800.0, 3e-3, SPACING),
        pytest.param(66.0, 2e-2, 0.2, marks=pytest.mark.slow),
        pytest.param(40.0, 5e-3, SPACING, marks=pytest.mark.slow),
        pytest.param(400.0, 3e-3, SPACING, marks=pytest.mark.slow),
    ],
)
def test_readings_scatter_as_their_uncertainties(quality, share, spacing):
    zeta, trials = 0.5 / quality, 50
    frequency, top = lines(F0, zeta, spacing), transmissibility_levels(zeta)[0] * F0
    truths = {"maximum": top, "half_amplitude": top}
    scores = []
    for drawn, covariance in draws(transmissibility(frequency, F0, zeta) * GAIN, share, trials, 3):
        row: list[float] = []
        for reading in peak_readings(MeasuredCurve(frequency, drawn, covariance)).all[1:]:
            damping = zeta * (np.sqrt(3.0) if reading.method == "half_amplitude" else 1.0)
            row.append((reading.frequency_hz - truths.get(reading.method, F0)) / reading.u_frequency_hz)
            row.append((reading.damping_ratio - damping) / reading.u_damping_ratio)
        scores.append(row)
    scored = np.array(scores)[:, [0, 2, 3, 4, 5, 6, 7]]
    assert np.all(np.isfinite(scored))
    scatter = np.sqrt(np.mean(scored**2, axis=0))
    np.testing.assert_allclose(scatter, 1.0, atol=4.0 / np.sqrt(2.0 * trials))


def test_the_line_of_the_maximum_scatters_as_stated():
    """A flat top in noise: far more than half a spacing."""
    zeta, frequency = 0.5 / 40.0, lines(F0, 0.5 / 40.0, SPACING)
    drawn = draws(transmissibility(frequency, F0, zeta), 1e-2, 60, 8)
    readings = [peak_readings(MeasuredCurve(frequency, *parts)).maximum_bin for parts in drawn]
    error = np.array([reading.frequency_hz for reading in readings]) - transmissibility_levels(zeta)[0] * F0
    stated = np.sqrt(np.mean([reading.u_frequency_hz**2 for reading in readings]))
    assert stated > 3.0 * SPACING / np.sqrt(12.0)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(stated, rel=0.3)
    frequency = lines(F0, 1e-3, SPACING)  # in little noise it is uncertain by half a spacing
    found = read(frequency, transmissibility(frequency, F0, 1e-3), 1e-6)
    assert found.maximum_bin.u_frequency_hz == pytest.approx(SPACING / np.sqrt(12.0), rel=1e-6)
    assert np.isnan(found.maximum_bin.damping_ratio)


def test_the_circle_loses_little_to_a_fit_of_the_curve_and_other_modes_do_not_turn_it():
    zeta = 0.5 / 66.0
    frequency = lines(F0, zeta, SPACING)
    clean = transmissibility(frequency, F0, zeta) * GAIN
    one = measured(frequency, clean, 1e-3)
    alone, fit = peak_readings(one), fit_resonance(one, "transmissibility")
    assert alone.circle.u_frequency_hz < 2.5 * fit.u("frequency_hz")
    assert alone.circle.u_damping_ratio < 2.5 * fit.u("damping_ratio")
    added = 3.0 * np.exp(1j) / (1j * frequency / F0)  # nearly a constant in the plane of the circle
    moved = peak_readings(MeasuredCurve(frequency, clean + added, one.covariance))
    assert moved.circle.frequency_hz == pytest.approx(F0, rel=2e-7)
    assert moved.circle.damping_ratio == pytest.approx(zeta, rel=3e-5)
    assert abs(moved.half_power.damping_ratio / zeta - 1.0) > 1e-3
    circle = fit_circle(one, F0 * 1.0005, 1.1 * zeta)  # diameter |G|/(2ζ), through the origin
    assert circle is not None
    assert (circle.radius, abs(circle.centre)) == pytest.approx((0.5 * 1.02 / (2.0 * zeta), circle.radius), rel=1e-9)
    assert np.angle(circle.centre) == pytest.approx(0.3, abs=1e-9)


def test_unresolved_lines_and_a_short_band_are_noted():
    grids = {zeta: lines(F0, zeta, SPACING) for zeta in (0.5 / 800.0, 0.5 / 66.0)}
    narrow, wide = (read(grid, transmissibility(grid, F0, zeta), 1e-3) for zeta, grid in grids.items())
    assert re.findall(r"[\d.]+", narrow.half_power.note) == ["2.4", "4"]
    assert re.findall(r"√?[\d.]+", narrow.half_amplitude.note) == ["√3", "2.4", "4"]
    assert not wide.half_power.note
    assert re.findall(r"√?[\d.]+", wide.half_amplitude.note) == ["√3"]
    zeta, frequency = 0.5 / 66.0, np.arange(F0 - 6.0, F0 + 6.0, SPACING)
    found = read(frequency, transmissibility(frequency, F0, zeta), 1e-4)
    assert found.maximum.frequency_hz == pytest.approx(transmissibility_levels(zeta)[0] * F0, rel=1e-6)
    assert np.isnan(found.half_power.damping_ratio)
    assert "1/√2" in found.half_power.note
    assert found.circle.note


def test_of_two_peaks_the_higher_is_read():
    frequency = np.arange(900.0, 1700.0, SPACING)
    value = transmissibility(frequency, F0, 0.004) + 0.3 * transmissibility(frequency, 1092.97, 0.004)
    found = read(frequency, value, 1e-3)
    for name in METHODS[1:]:
        assert getattr(found, name).frequency_hz == pytest.approx(F0, abs=0.3)
    assert [reading.method for reading in found.all] == list(METHODS)


def test_wrong_curves_are_refused_by_name():
    frequency, ones = np.arange(10.0) + 1.0, np.ones(10, dtype=np.complex128)
    refused("^frequency_hz: .* 5 .* 3$", read, frequency[:3], frequency[:3] + 0j, 0.1)
    refused("^frequency_hz: ", read, np.arange(10.0), frequency + 0j, 0.1)

    def reading(value: ComplexArray, covariance: FloatArray) -> PeakReadings:
        return peak_readings(MeasuredCurve(frequency, value, covariance))

    refused("^value: ", reading, np.nan * ones, even(ones, 0.1))
    refused("^covariance: ", reading, frequency + 0j, np.ones((10, 2)))
    refused("^covariance: ", reading, frequency + 0j, np.zeros((10, 2, 2)))


TIME, RULES = np.linspace(0.0, 4.0, 60), LMOptions(predicted_decrease_share=1e-14)


def _decays(rates: FloatArray, data: FloatArray) -> SeparablePoint:
    """A level and two decays with free amplitudes, in two outputs (60, 2)."""
    waves = np.exp(-TIME[:, None] * rates)

    def changes(coefficients: FloatArray) -> BlockJacobian:
        return BlockJacobian(np.arange(2), (-TIME[:, None] * waves)[:, :, None] * coefficients[1:])

    return SeparablePoint(rates, (LinearBlock(np.hstack([np.ones((60, 1)), waves]), data, changes),))


def _data() -> FloatArray:
    waves = np.exp(-TIME[:, None] * np.array([0.7, 3.0])) @ np.array([[1.0, -0.4], [0.5, 2.0]])
    return np.asarray(waves + 0.3 + 1e-2 * np.random.default_rng(1).standard_normal((60, 2)))


def test_a_narrow_valley_is_followed_to_its_end():
    def at(x: FloatArray) -> WhitenedResiduals | None:
        residual = np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
        return WhitenedResiduals(x, residual, np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])) if x[0] < 1.5 else None

    begin = at(np.array([-1.2, 1.0]))
    assert begin is not None
    end = levenberg_marquardt(at, begin, RULES)
    assert end.converged
    assert end.point.parameters == pytest.approx([1.0, 1.0], abs=1e-6)
    assert np.all(np.diff(end.losses) < 0)


def test_a_search_that_cannot_reach_its_tolerance_ends():
    data = _data()

    def search(tolerance: float) -> Minimum[SeparablePoint]:
        start = _decays(np.array([0.5, 5.0]), data)
        return levenberg_marquardt(lambda x: _decays(x, data), start, replace(RULES, tolerance=tolerance))

    end = search(np.inf)
    reached, missed = search(1.01 * end.point.loss), search(0.5 * end.point.loss)
    np.testing.assert_array_equal(reached.point.parameters, end.point.parameters)
    assert reached.converged
    assert not missed.converged
    assert len(missed.losses) < len(end.losses)


def test_projected_coefficients_give_the_joint_minimum():
    data = _data()
    end = levenberg_marquardt(lambda x: _decays(x, data), _decays(np.array([0.5, 5.0]), data), RULES).point

    def joint(x: FloatArray) -> FloatArray:
        design = np.hstack([np.ones((60, 1)), np.exp(-TIME[:, None] * x[:2])])
        return np.asarray((data - design @ x[2:].reshape(3, 2)).ravel())

    whole = np.concatenate([end.parameters, end.coefficients[0].ravel()])
    reference = least_squares(joint, whole * 1.05, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(whole, reference.x, rtol=1e-6)
    assert (end.loss, end.freedom) == (pytest.approx(2.0 * reference.cost, rel=1e-10), 120 - 6 - 2)
    covariance = np.linalg.inv(reference.jac.T @ reference.jac)[:2, :2]
    np.testing.assert_allclose(np.linalg.inv(end.normal[0]), covariance, rtol=2e-3)


def test_the_gradient_is_that_of_the_projected_loss():
    data, rates = _data(), np.array([0.5, 5.0])
    downhill = _decays(rates, data).normal[1]
    for index in range(2):
        step = 1e-6 * np.eye(2)[index]
        slope = (_decays(rates + step, data).loss - _decays(rates - step, data).loss) / 2e-6
        assert downhill[index] == pytest.approx(-0.5 * slope, rel=1e-5)


def test_a_prior_has_the_weight_of_its_variance():
    """Of a mean x of n data and a prior (m, u): (n x/s² + m/u²)/(n/s² + 1/u²), s² of the residual there."""
    data = np.random.default_rng(2).standard_normal(50) + 3.0

    def at(x: FloatArray) -> WhitenedResiduals:
        return WhitenedResiduals(x, x[0] - data, np.ones((50, 1)))

    end = levenberg_marquardt(at, at(np.zeros(1)), RULES, prior=ParameterPrior(np.array([0.0]), np.array([0.1]))).point
    variance = end.loss / 49
    expected = np.sum(data) / variance / (50 / variance + 100.0)
    assert end.parameters[0] == pytest.approx(expected, rel=1e-6)


def test_dependent_columns_share_and_the_root_is_that_of_the_covariance():
    design = np.stack([np.ones(60), TIME, TIME**2], axis=1)
    part = eliminate(design, _data())
    np.testing.assert_allclose(part.root @ part.root.T, np.linalg.inv(design.T @ design), rtol=1e-9)
    assert np.abs(design.T @ part.residual).max() < 1e-10
    twice = eliminate(np.hstack([design, 1e6 * design[:, :1]]), _data())
    np.testing.assert_allclose(twice.residual, part.residual, atol=1e-12)
    np.testing.assert_allclose(twice.coefficients[0], 1e6 * twice.coefficients[3], rtol=1e-6)


def test_a_start_without_a_loss_is_refused():
    with pytest.raises(ValueError, match=r"^start: "):
        levenberg_marquardt(lambda x: None, WhitenedResiduals(np.zeros(1), np.array([np.inf]), np.ones((1, 1))), RULES)
