"""Readings of one resonance: exact on an oscillator at any line spacing, and as uncertain as they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from shaker.identification.measured import MeasuredCurve
from shaker.identification.oscillator import fit_resonance
from shaker.identification.readings import (
    PeakReadings,
    fit_circle,
    peak_readings,
    transmissibility_levels,
)

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
F0 = 1477.35
SPACING = 0.78125
GAIN = 1.02 * np.exp(0.3j)
METHODS = ("maximum_bin", "maximum", "half_power", "half_amplitude", "circle")


def transmissibility(frequency_hz: FloatArray, f0: float, zeta: float) -> ComplexArray:
    """(1 + 2jζr)/(1 - r² + 2jζr)."""
    r = frequency_hz / f0
    return np.asarray((1.0 + 2j * zeta * r) / (1.0 - r * r + 2j * zeta * r))


def flat(value: ComplexArray, share: float) -> FloatArray:
    """Covariance of circular noise, in each part a share of the largest |H|."""
    return np.asarray((share * np.abs(value).max()) ** 2 * np.eye(2) * np.ones((len(value), 1, 1)))


def read(frequency: FloatArray, value: ComplexArray, share: float) -> PeakReadings:
    """Readings of a curve with circular noise of a share of its largest |H|."""
    return peak_readings(MeasuredCurve(frequency, value, flat(value, share)))


def lines(f0: float, zeta: float, spacing: float, shift: float = 0.0) -> FloatArray:
    """A grid that holds the width at half amplitude and more."""
    reach = max(12.0 * spacing, 5.0 * zeta * f0)
    first = np.ceil((f0 - reach) / spacing) + shift
    return np.asarray(spacing * (first + np.arange(int(2.0 * reach / spacing))))


def by_search(zeta: float, level: float) -> tuple[float, float, float]:
    """Maximum and crossings of |T|² found by numerical search."""

    def power(r: float) -> float:
        return float(np.abs(transmissibility(np.array([r]), 1.0, zeta)[0]) ** 2)

    top = float(minimize_scalar(lambda r: -power(r), bounds=(0.5, 1.2), method="bounded", options={"xatol": 1e-12}).x)
    goal = power(top) / level
    return top, brentq(lambda r: power(r) - goal, 1e-3, top), brentq(lambda r: power(r) - goal, top, 3.0)


@pytest.mark.parametrize("zeta", [1e-3, 0.0075, 0.05, 0.15])
@pytest.mark.parametrize("level", [2.0, 4.0])
def test_levels_of_the_transmissibility_are_where_a_search_finds_them(zeta: float, level: float) -> None:
    if level * 1.01 >= 1.0 / (4.0 * zeta**2):
        pytest.skip("|T| does not fall so far below its maximum on the low side")
    expected = by_search(zeta, level)
    found = transmissibility_levels(zeta, level)
    assert found[0] == pytest.approx(expected[0], abs=1e-7)  # a flat top is found to the root of the precision
    assert found[1:] == pytest.approx(expected[1:], rel=1e-9)
    assert found[0] == pytest.approx(1.0 - zeta**2, abs=4.0 * zeta**4)


@settings(max_examples=30, deadline=None)
@given(
    quality=st.floats(20.0, 800.0),
    shift=st.floats(0.0, 1.0),
    spacing=st.floats(0.1, 1.0),
    magnitude=st.floats(1e-6, 1e3),
    phase=st.floats(-3.0, 3.0),
)
def test_without_noise_only_the_bin_maximum_depends_on_the_lines(
    quality: float, shift: float, spacing: float, magnitude: float, phase: float
) -> None:
    zeta = 0.5 / quality
    frequency = lines(F0, zeta, spacing, shift)
    value = transmissibility(frequency, F0, zeta) * magnitude * np.exp(1j * phase)
    found = read(frequency, value, 1e-6)
    top, low, high = transmissibility_levels(zeta)
    assert found.circle.frequency_hz == pytest.approx(F0, rel=1e-9)
    assert found.circle.damping_ratio == pytest.approx(zeta, rel=1e-7)
    assert found.half_power.frequency_hz == pytest.approx(F0, rel=1e-7)
    assert found.half_power.damping_ratio == pytest.approx(zeta, rel=1e-7 + 0.05 * zeta**2)
    assert found.half_power.width_hz == pytest.approx((high - low) * F0, rel=1e-7 + 0.05 * zeta**2)
    assert found.maximum.frequency_hz == pytest.approx(top * F0, rel=1e-8 + 5.0 * zeta**4)
    assert found.half_amplitude.damping_ratio == pytest.approx(np.sqrt(3.0) * zeta, rel=1e-6 + 5.0 * zeta**2)
    assert abs(found.maximum_bin.frequency_hz - top * F0) <= 0.5 * spacing * (1.0 + 1e-6)
    assert found.lines_in_width == pytest.approx(found.half_power.width_hz / spacing)


def log_parabola(frequency: FloatArray, value: ComplexArray) -> float:
    """The usual interpolation: vertex of the parabola through ln|H| of the largest line and its two neighbours."""
    at = int(np.argmax(np.abs(value)))
    below, middle, above = np.log(np.abs(value[at - 1 : at + 2]))
    return float(frequency[at] + 0.5 * SPACING * (below - above) / (below - 2.0 * middle + above))


@pytest.mark.parametrize(
    ("quality", "bias_hz"), [(40.0, 3.0e-4), (66.0, 5.2e-4), (150.0, 2.0e-3), (400.0, 1.2e-2), (800.0, 3.6e-2)]
)
def test_the_parabola_of_the_reciprocal_has_no_bias_where_that_of_the_logarithm_has_some(
    quality: float, bias_hz: float
) -> None:
    """At 0.78125 Hz and 1477.35 Hz: the largest bias over all places of the maximum between two lines."""
    zeta = 0.5 / quality
    by_logarithm, by_reciprocal = [], []
    for shift in np.linspace(0.0, 1.0, 21):
        frequency = lines(F0, zeta, SPACING, float(shift))
        value = transmissibility(frequency, F0, zeta)
        true = transmissibility_levels(zeta)[0] * F0
        by_logarithm.append(log_parabola(frequency, value) - true)
        by_reciprocal.append(read(frequency, value, 1e-3).maximum.frequency_hz - true)
    assert np.abs(by_logarithm).max() == pytest.approx(bias_hz, rel=0.05)
    assert np.abs(by_reciprocal).max() < 1e-7 * F0


@pytest.mark.parametrize(
    ("quality", "noise", "spacing"),
    [(66.0, 1e-3, SPACING), (66.0, 2e-2, 0.2), (40.0, 5e-3, SPACING), (400.0, 3e-3, SPACING), (800.0, 3e-3, SPACING)],
)
def test_readings_scatter_as_their_uncertainties_say(quality: float, noise: float, spacing: float) -> None:
    zeta, trials = 0.5 / quality, 100
    rng = np.random.default_rng(3)
    frequency = lines(F0, zeta, spacing)
    clean = transmissibility(frequency, F0, zeta) * GAIN
    covariance = flat(clean, noise)
    u = np.sqrt(covariance[0, 0, 0])
    top = transmissibility_levels(zeta)[0] * F0
    truths = {"maximum": top, "half_amplitude": top}
    scores = []
    for _ in range(trials):
        drawn = clean + u * (rng.standard_normal(len(clean)) + 1j * rng.standard_normal(len(clean)))
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


def test_the_line_of_the_maximum_wanders_as_much_as_it_says() -> None:
    """A flat top in noise: far more than half a spacing."""
    zeta, noise, trials = 0.5 / 40.0, 1e-2, 120
    rng = np.random.default_rng(8)
    frequency = lines(F0, zeta, SPACING)
    clean = transmissibility(frequency, F0, zeta)
    covariance = flat(clean, noise)
    u = np.sqrt(covariance[0, 0, 0])
    readings = []
    for _ in range(trials):
        drawn = clean + u * (rng.standard_normal(len(clean)) + 1j * rng.standard_normal(len(clean)))
        readings.append(peak_readings(MeasuredCurve(frequency, drawn, covariance)).maximum_bin)
    error = np.array([reading.frequency_hz for reading in readings]) - transmissibility_levels(zeta)[0] * F0
    stated = np.sqrt(np.mean([reading.u_frequency_hz**2 for reading in readings]))
    assert stated > 3.0 * SPACING / np.sqrt(12.0)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(stated, rel=0.2)


def test_in_little_noise_the_line_of_the_maximum_is_uncertain_by_half_a_spacing() -> None:
    value = transmissibility(frequency := lines(F0, 1e-3, SPACING), F0, 1e-3)
    found = read(frequency, value, 1e-6)
    assert found.maximum_bin.u_frequency_hz == pytest.approx(SPACING / np.sqrt(12.0), rel=1e-6)
    assert np.isnan(found.maximum_bin.damping_ratio)


def test_correlated_lines_are_less_certain() -> None:
    """Errors of neighbouring lines that go together, as a Hann window makes them (Monte Carlo of windowed noise)."""
    zeta, trials = 0.5 / 66.0, 120
    rng = np.random.default_rng(4)
    frequency = lines(F0, zeta, SPACING)
    clean = transmissibility(frequency, F0, zeta)
    covariance = flat(clean, 2e-3)
    u = np.sqrt(covariance[0, 0, 0])
    correlation = np.array([1.0, -2.0 / 3.0, 1.0 / 6.0], dtype=np.complex128)
    told, found = [], []
    for _ in range(trials):
        white = rng.standard_normal((2, len(clean) + 2)) / np.sqrt(1.5)
        smeared = white[:, 1:-1] - 0.5 * (white[:, :-2] + white[:, 2:])
        drawn = clean + u * (smeared[0] + 1j * smeared[1])
        told.append(peak_readings(MeasuredCurve(frequency, drawn, covariance, line_correlation=correlation)).circle)
        found.append(told[-1].damping_ratio / zeta - 1.0)
    plain = peak_readings(MeasuredCurve(frequency, drawn, covariance)).circle.u_damping_ratio
    stated = np.sqrt(np.mean([reading.u_damping_ratio**2 for reading in told])) / zeta
    assert np.std(found) == pytest.approx(stated, rel=0.2)
    assert abs(plain / zeta / stated - 1.0) > 0.3


def test_the_circle_loses_little_to_a_fit_of_the_curve_and_other_modes_do_not_turn_it() -> None:
    zeta = 0.5 / 66.0
    frequency = lines(F0, zeta, SPACING)
    clean = transmissibility(frequency, F0, zeta) * GAIN
    covariance = flat(clean, 1e-3)
    alone = peak_readings(MeasuredCurve(frequency, clean, covariance))
    fit = fit_resonance(MeasuredCurve(frequency, clean, covariance), "transmissibility")
    assert alone.circle.u_frequency_hz < 2.5 * fit.u("frequency_hz")
    assert alone.circle.u_damping_ratio < 2.5 * fit.u("damping_ratio")
    added = 3.0 * np.exp(1j) / (1j * frequency / F0)  # nearly a constant in the plane of the circle
    moved = peak_readings(MeasuredCurve(frequency, clean + added, covariance))
    assert moved.circle.frequency_hz == pytest.approx(F0, rel=2e-7)
    assert moved.circle.damping_ratio == pytest.approx(zeta, rel=3e-5)
    assert abs(moved.half_power.damping_ratio / zeta - 1.0) > 1e-3


def test_the_circle_itself() -> None:
    """Diameter |G|/(2ζ), through the origin."""
    zeta = 0.5 / 66.0
    value = transmissibility(frequency := lines(F0, zeta, SPACING), F0, zeta) * GAIN
    fit = fit_circle(MeasuredCurve(frequency, value, flat(value, 1e-3)), F0 * 1.0005, 1.1 * zeta)
    assert fit is not None
    assert fit.radius == pytest.approx(0.5 * 1.02 / (2.0 * zeta), rel=1e-9)
    assert abs(fit.centre) == pytest.approx(fit.radius, rel=1e-9)
    assert np.angle(fit.centre) == pytest.approx(0.3, abs=1e-9)


def test_what_the_lines_do_not_resolve_is_noted() -> None:
    narrow, wide = (
        read(grid, transmissibility(grid, F0, zeta), 1e-3)
        for zeta in (0.5 / 800.0, 0.5 / 66.0)
        for grid in [lines(F0, zeta, SPACING)]
    )
    assert narrow.half_power.note.startswith("2.4 lines in the half-power width, fewer than 4")
    assert "damping overstated by √3; 2.4 lines" in narrow.half_amplitude.note
    assert not wide.half_power.note
    assert wide.half_amplitude.note == "damping overstated by √3"


def test_a_band_that_ends_in_the_peak_leaves_widths_unread() -> None:
    zeta = 0.5 / 66.0
    frequency = np.arange(F0 - 6.0, F0 + 6.0, SPACING)
    value = transmissibility(frequency, F0, zeta)
    found = read(frequency, value, 1e-4)
    assert found.maximum.frequency_hz == pytest.approx(transmissibility_levels(zeta)[0] * F0, rel=1e-6)
    assert np.isnan(found.half_power.damping_ratio)
    assert "does not fall to 1/√2" in found.half_power.note
    assert found.circle.note


def test_of_two_peaks_the_higher_is_read() -> None:
    frequency = np.arange(900.0, 1700.0, SPACING)
    value = transmissibility(frequency, F0, 0.004) + 0.3 * transmissibility(frequency, 1092.97, 0.004)
    found = read(frequency, value, 1e-3)
    for name in METHODS[1:]:
        assert getattr(found, name).frequency_hz == pytest.approx(F0, abs=0.3)
    assert [reading.method for reading in found.all] == list(METHODS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frequency": np.arange(3.0) + 1.0}, "at least 5 lines, found 3"),
        ({"frequency": np.arange(10.0)}, "ascending positive"),
        ({"covariance": np.ones((10, 2))}, "covariance: expected an array of shape"),
        ({"value": np.full(10, np.nan)}, "value: expected finite"),
        ({"covariance": np.zeros((10, 2, 2))}, "covariance: expected positive definite"),
    ],
)
def test_wrong_calls_are_named(change: dict[str, FloatArray], message: str) -> None:
    frequency = change.get("frequency", np.arange(10.0) + 1.0)
    value = np.asarray(change.get("value", np.arange(len(frequency)) + 1.0), dtype=np.complex128)
    covariance = change.get("covariance", flat(np.ones(len(frequency), dtype=np.complex128), 0.1))
    with pytest.raises(ValueError, match=message):
        peak_readings(MeasuredCurve(frequency, value, covariance))
