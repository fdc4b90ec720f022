"""Indices of systems: against closed forms, against dense curves, and their uncertainties against Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import brentq

from shaker.lti.indices import LABELS, SETTLING, indices, moving_figures, pole_notices, settling_u, unit_of
from shaker.lti.responses import gain_curve, roots_between, settling_points, transient
from shaker.lti.system import LinearSystem, ModalModel

FloatArray = NDArray[np.float64]
DAMPINGS = [1e-5, 0.004, 0.02, 0.2, 0.5, 0.65, 0.9]


def oscillator(hertz: float, damping: float, gain: float = 1.0) -> LinearSystem:
    """One mode."""
    omega = 2 * np.pi * hertz
    pole = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    return LinearSystem(np.zeros(0, complex), np.array([pole, np.conj(pole)]), gain * omega**2)


def ratio_at(level: float, damping: float, upper: bool) -> float:
    """Frequency ratio at which 1/√((1 - r²)² + 4ζ²r²) is a level: r² = 1 - 2ζ² ± √((1 - 2ζ²)² - 1 + level⁻²)."""
    middle = 1 - 2 * damping**2
    inner = np.sqrt(middle**2 - 1 + level**-2)
    return float(np.sqrt(middle + inner if upper else middle - inner))


@pytest.mark.parametrize("damping", DAMPINGS)
def test_frequencies_of_an_oscillator(damping: float) -> None:
    found = indices(oscillator(500.0, damping, -3.0), nominal_gain=3.1)
    assert found.natural_hz == pytest.approx(500.0, rel=1e-12)
    assert found.damped_hz == pytest.approx(500.0 * np.sqrt(1 - damping**2), rel=1e-12)
    assert found.damping_ratio == pytest.approx(damping, rel=1e-10)
    assert found.static_gain == pytest.approx(-3.0)
    assert found.quadrature_hz == pytest.approx(500.0, rel=1e-9)
    assert found.half_power_hz == pytest.approx(500.0 * ratio_at(0.5**0.5, damping, True), rel=1e-12)
    if damping < 0.5**0.5:
        assert found.peak_hz == pytest.approx(500.0 * np.sqrt(1 - 2 * damping**2), rel=1e-9)
        assert found.peak_gain == pytest.approx(0.5 / damping / np.sqrt(1 - damping**2), rel=1e-9)
    else:
        assert found.peak_hz is None
        assert found.peak_gain is None
    for part in (0.05, 0.10):
        rises = (found.peak_gain or 0.0) > 1 + part
        band = 500.0 * (ratio_at(1 + part, damping, False) if rises else ratio_at(1 - part, damping, True))
        name = f"band_{round(100 * part)}_hz"
        assert getattr(found, name) == pytest.approx(band, rel=1e-10)
        nominal = indices(oscillator(500.0, damping, 2.0), nominal_gain=2.0)
        assert getattr(nominal, name.replace("_hz", "_nominal_hz")) == pytest.approx(band, rel=1e-10)


@pytest.mark.parametrize("damping", DAMPINGS)
def test_step_of_an_oscillator(damping: float) -> None:
    hertz, omega = 500.0, 1000 * np.pi
    found = indices(oscillator(hertz, damping))
    decay, swing = damping * omega, omega * np.sqrt(1 - damping**2)
    assert found.overshoot == pytest.approx(np.exp(-np.pi * decay / swing), rel=1e-10)

    def step(t: float) -> float:
        return float(1 - np.exp(-decay * t) * (np.cos(swing * t) + decay / swing * np.sin(swing * t)))

    top = np.pi / swing
    passing = [brentq(lambda t, level=level: step(t) - level, 0, top, xtol=1e-18) for level in (0.1, 0.9)]
    assert found.rise_s == pytest.approx(passing[1] - passing[0], rel=1e-10)
    for tolerance, value in ((0.02, found.settling_2_s), (0.05, found.settling_5_s)):
        # extremes at kπ/ω_d are exp(-kπζ/√(1-ζ²)) off: the last one outside, and the crossing behind it
        last = int(np.floor(-np.log(tolerance) * swing / (np.pi * decay)))
        level = 1 + tolerance * (1 if last % 2 else -1)
        expected = brentq(lambda t, level=level: step(t) - level, last * top, (last + 1) * top, xtol=1e-18)
        assert value == pytest.approx(expected, rel=1e-9)


def test_a_single_lag() -> None:
    found = indices(LinearSystem(np.zeros(0, complex), np.array([-100 + 0j]), 100.0))
    assert found.overshoot == 0.0
    assert found.dominant is None
    assert found.natural_hz is None
    assert found.real_poles_hz == pytest.approx((100 / (2 * np.pi),))
    assert found.rise_s == pytest.approx(np.log(9) / 100, rel=1e-10)
    assert found.settling_2_s == pytest.approx(np.log(50) / 100, rel=1e-10)
    assert found.half_power_hz == pytest.approx(100 / (2 * np.pi), rel=1e-10)
    assert found.band_10_hz == pytest.approx(100 / (2 * np.pi) * np.sqrt(0.9**-2 - 1), rel=1e-10)


@pytest.mark.parametrize("count", [2, 3])
def test_coinciding_poles(count: int) -> None:
    """1 - exp(-at)·Σ(at)^k/k! of `count` equal lags."""
    found = indices(LinearSystem(np.zeros(0, complex), np.full(count, -100 + 0j), 100.0**count))

    def rest(t: float) -> float:
        return float(np.exp(-100 * t) * np.sum((100 * t) ** np.arange(count) / np.array([1, 1, 2])[:count]))

    assert found.settling_2_s == pytest.approx(brentq(lambda t: rest(t) - 0.02, 0.01, 1.0), rel=1e-8)
    passing = [brentq(lambda t, level=level: rest(t) - level, 0, 1.0) for level in (0.9, 0.1)]
    assert found.rise_s == pytest.approx(passing[1] - passing[0], rel=1e-8)
    assert found.overshoot == 0.0
    assert found.half_power_hz == pytest.approx(100 / (2 * np.pi) * np.sqrt(2 ** (1 / count) - 1), rel=1e-10)


def test_a_band_left_and_entered_again() -> None:
    """A peak of 15 % and what comes behind it: two more ranges within ±10 %, one of them behind the peak."""
    system = oscillator(1000.0, 0.5)
    curve = gain_curve(system)
    ranges = curve.inside(0.9, 1.1)
    ends = [1000 * ratio_at(level, 0.5, upper) for level, upper in ((1.1, False), (1.1, True), (0.9, True))]
    assert np.allclose(np.ravel(ranges)[1:], ends, rtol=1e-10)
    assert ranges[0][0] == 0.0
    assert indices(system).band_10_hz == pytest.approx(ends[0])
    assert curve.crossings(2.0) == []


def test_a_narrow_resonance_far_above_ends_the_band() -> None:
    """A second mode of ζ = 10⁻⁴ with a share of 10⁻⁴ lifts the gain by less than 1 at 3 kHz: no grid may step over."""
    omega = 2 * np.pi * np.array([5000.0, 3000.0])
    damping = np.array([0.7, 1e-4])
    residue = -0.5j * np.array([1.0, 1e-4]) * omega / np.sqrt(1 - damping**2)
    model = ModalModel(omega / (2 * np.pi), damping, residue, np.zeros(0), np.zeros(0))
    found = indices(model.system)
    dense = 3000.0 * (1 + 1e-4 * np.linspace(-40, 40, 400001))
    gain = np.abs(model.response(dense)) / model.static_gain
    assert gain.max() > 1.05
    assert found.band_5_hz == pytest.approx(dense[np.argmax(np.abs(gain - 1) > 0.05)], rel=1e-7)
    assert found.dominant is not None
    assert found.dominant.natural_hz == pytest.approx(5000.0)
    assert [mode.natural_hz for mode in found.modes] == pytest.approx([3000.0, 5000.0])
    assert found.modes[0].step_share == pytest.approx(1e-4, rel=1e-3)


@settings(max_examples=25, deadline=None)
@given(
    hertz=st.lists(st.floats(100.0, 5000.0), min_size=2, max_size=2),
    damping=st.lists(st.floats(0.003, 0.8), min_size=2, max_size=2),
    share=st.floats(-0.5, 0.5),
    real=st.floats(300.0, 20000.0),
)
def test_figures_hold_on_dense_curves(hertz: list[float], damping: list[float], share: float, real: float) -> None:
    if abs(hertz[0] / hertz[1] - 1) < 0.01:
        return
    omega, zeta = 2 * np.pi * np.array(hertz), np.array(damping)
    residue = -0.5j * np.array([1.0, share]) * omega / np.sqrt(1 - zeta**2)
    lag = LinearSystem(np.zeros(0, complex), np.array([-2 * np.pi * real + 0j]), 2 * np.pi * real)
    system = ModalModel(np.array(hertz), zeta, residue, np.zeros(0), np.zeros(0)).system.times(lag)
    found, static = indices(system), system.static_gain
    grid = np.linspace(0, 8000, 40001)
    gain = np.abs(system.response(grid)) / abs(static)
    for part, end in ((0.05, found.band_5_hz), (0.10, found.band_10_hz)):
        assert end is not None
        assert np.abs(gain[grid < 0.9999 * end] - 1).max() <= part
        at = abs(system.response(np.array([end]))[0] / static)
        assert abs(abs(at - 1) - part) < 1e-9
    if found.peak_gain is not None:
        assert gain.max() <= found.peak_gain * (1 + 1e-9)
    assert found.settling_2_s is not None
    time = np.linspace(0, 1.5 * found.settling_2_s, 60001)
    value = system.step(time) / static
    assert found.overshoot is not None
    assert value.max() - 1 <= found.overshoot + 1e-9
    if found.overshoot > 0:
        highest = transient(system).highest_s
        assert highest is not None
        assert system.step(np.array([highest]))[0] / static - 1 == pytest.approx(found.overshoot, abs=1e-9)
    for tolerance, settled in ((0.02, found.settling_2_s), (0.05, found.settling_5_s)):
        assert settled is not None
        assert np.abs(value[time > settled * (1 + 1e-9)] - 1).max() <= tolerance * (1 + 1e-9)
        assert abs(abs(system.step(np.array([settled]))[0] / static - 1) - tolerance) < 1e-8


def test_samples_tell_the_same_as_the_continuous_system() -> None:
    system = oscillator(500.0, 0.05).times(LinearSystem(np.zeros(0, complex), np.array([-2e4 + 0j]), 2e4))
    rate = 1e6
    true, found = indices(system).figures(), indices(system.sampled(rate)).figures()
    for name, value in true.items():
        assert value is not None
        within = {"hz": 2e-3 * value, "s": 1.01 / rate}.get(name.rsplit("_", 1)[-1], 1e-4 * value)
        assert found[name] == pytest.approx(value, abs=within), name
    assert true["natural_hz"] == pytest.approx(found["natural_hz"], rel=1e-9)


def test_bands_without_an_end_and_bands_that_do_not_begin() -> None:
    lead = LinearSystem(np.array([-100 + 0j]), np.array([-102 + 0j]), 1.02)
    assert indices(lead).band_5_hz == np.inf
    assert indices(lead).half_power_hz is None
    assert indices(lead.sampled(1e4, "matched")).band_5_hz == pytest.approx(5e3)
    off_nominal = indices(oscillator(500.0, 0.1, 1.13))
    assert off_nominal.band_5_nominal_hz is off_nominal.band_10_nominal_hz is None
    assert off_nominal.band_5_hz is not None


def test_a_system_that_loses_its_level_has_no_figures_of_it() -> None:
    rate = LinearSystem(np.zeros(1, complex), np.array([-10 + 100j, -10 - 100j]), 1.0)
    found = indices(rate)
    assert found.static_gain == 0.0
    assert found.peak_hz == pytest.approx(np.sqrt(1e4 + 100) / (2 * np.pi))
    for name in set(LABELS) - {"static_gain", "natural_hz", "damped_hz", "damping_ratio", "peak_hz"}:
        assert found.figures()[name] is None, name


def test_an_unstable_system_is_told_and_has_no_times() -> None:
    found = indices(LinearSystem(np.zeros(0, complex), np.array([1 + 50j, 1 - 50j, -9.0]), 1.0))
    assert not found.stable
    assert found.settling_2_s is None
    assert found.overshoot is None
    assert "2 of 3 poles do not decay" in found.notices[0].text
    assert found.notices[0].severity == "warning"


def test_poles_and_zeros_on_the_axis() -> None:
    """Without damping: infinite gain at the pole, none at the zero, and the bands that r² = 1 ± … gives."""
    system = LinearSystem(np.zeros(0, complex), np.array([1000j, -1000j]), 1e6)
    found = indices(system)
    assert found.peak_hz == pytest.approx(1000 / (2 * np.pi))
    assert found.peak_gain is None
    assert found.band_5_hz == pytest.approx(1000 / (2 * np.pi) * np.sqrt(1 - 1 / 1.05), rel=1e-12)
    assert found.settling_2_s is None
    assert system.response(np.array([found.peak_hz or 0.0, 0.0]))[1] == pytest.approx(1.0)
    notch = indices(LinearSystem(np.array([3000j, -3000j]), np.array([-10 + 1000j, -10 - 1000j]), 1e6 / 9e6))
    assert notch.settling_2_s is not None
    curve = gain_curve(LinearSystem(np.array([3000j, -3000j]), np.array([-10 + 1000j, -10 - 1000j]), 1e6 / 9e6))
    assert curve.gain.min() < 1e-9


def test_an_integrator_has_no_static_gain() -> None:
    for system in (
        LinearSystem(np.zeros(0, complex), np.array([0j]), 2.0),
        LinearSystem(np.zeros(0, complex), np.array([1 + 0j]), 2.0, 1e3),
    ):
        found = indices(system)
        assert found.static_gain == np.inf
        assert found.band_5_hz is None
        assert found.settling_2_s is None
        assert not found.stable


def test_an_average_of_samples() -> None:
    """Zeros on the unit circle, all poles at z = 0: the response climbs by a fifth with each of five samples."""
    found = indices(LinearSystem.from_coefficients(np.full(5, 0.2), np.array([1.0, 0, 0, 0, 0]), 1e3))
    assert found.notices == ()
    assert found.overshoot == pytest.approx(0.0, abs=1e-12)
    assert found.settling_2_s == pytest.approx(4e-3)

    def gain(f: float) -> float:
        return float(np.sin(np.pi * f / 200) / (5 * np.sin(np.pi * f / 1000)))

    assert gain(found.half_power_hz or 0.0) == pytest.approx(0.5**0.5, rel=1e-9)
    assert gain(found.band_5_hz or 0.0) == pytest.approx(0.95, rel=1e-9)


def test_false_poles_are_told() -> None:
    samples = LinearSystem(np.zeros(0, complex), np.array([0.9 + 0.2j, 0.9 - 0.2j, -0.62]), 1.0, 1e5)
    assert [n.where for n in pole_notices(samples) if "turns its sign" in n.text] == ["pole -0.62"]
    far = LinearSystem(np.zeros(0, complex), np.array([-3e3 + 1e4j, -3e3 - 1e4j, -8.6e5]), 1.0)
    assert pole_notices(far) == ()
    assert "half the sampling rate" in pole_notices(far, 1e5)[0].text
    near = LinearSystem(np.array([-10.05 + 0j]), np.array([-10 + 0j, -3e3 + 1e4j, -3e3 - 1e4j]), 1.0)
    assert [n.severity for n in pole_notices(near)] == ["info"]


def test_roots_are_found_to_the_last_digits_whatever_the_curve() -> None:
    """Steep, flat and bent curves at once, one with its root at an end; against numbers known beforehand."""
    root = np.array([1e-9, 0.3, 2.0, 1.0, 4.0])
    power = np.array([1.0, 9.0, 3.0, 1.0, 1.0])

    def bent(x: FloatArray) -> FloatArray:
        steep = np.array([1.0, 1.0, 1.0, 60.0, 1.0])
        return np.asarray(np.sign(x - root) * np.abs(np.expm1(steep * (x - root))) ** power)

    found = roots_between(bent, np.zeros(5), np.array([3.0, 1.0, 9.0, 9.0, 4.0]))
    assert np.all(np.abs(found - root) <= 4e-16 * np.maximum(root, 1e-9))


def test_names_and_units() -> None:
    assert unit_of("band_5_hz") == "Hz"
    assert unit_of("settling_2_s") == "s"
    assert unit_of("overshoot") == ""
    assert list(indices(oscillator(10.0, 0.1)).figures()) == list(LABELS)


def uncertain_model(relative: float) -> ModalModel:
    """Two modes and a real pole, correlated errors."""
    model = ModalModel(
        np.array([1700.0, 4200.0]),
        np.array([0.015, 0.02]),
        np.array([-100 - 5000j, -30 - 200j]),
        np.array([6000.0]),
        np.array([500.0]),
    )
    mix = 0.3 * np.random.default_rng(1).normal(size=(10, 10)) + np.eye(10)
    covariance = mix @ mix.T
    scale = relative * np.abs(model.vector) / np.sqrt(np.diag(covariance))
    return replace(model, covariance=covariance * np.outer(scale, scale))


def uncertainties(model: ModalModel) -> dict[str, float]:
    """Standard uncertainty of every figure that a model has."""
    names, moving = moving_figures(model, indices(model.system))
    u = dict(zip(names, np.sqrt(np.diag(model.propagate(moving)[1])).tolist(), strict=True))
    return u | {name: settling_u(model, tolerance) for name, tolerance in SETTLING.items()}


def test_uncertainties_agree_with_monte_carlo() -> None:
    model = uncertain_model(2e-3)
    assert model.covariance is not None
    draws = np.random.default_rng(2).multivariate_normal(model.vector, model.covariance, size=60)
    figures = [indices(model.with_vector(draw).system).figures() for draw in draws]
    for name, u in uncertainties(model).items():
        spread = np.std(np.array([row[name] for row in figures if row[name] is not None], float))
        assert u == pytest.approx(spread, rel=0.35 if "settling" in name else 0.28), name  # 3 u of 60 draws


def test_settling_time_jumps_by_half_periods() -> None:
    """The damping at which an extreme just comes to be inside: half of the draws settle half a period earlier."""
    omega = 2 * np.pi * 500.0
    edge = 40  # exp(-40πζ/√(1-ζ²)) = 0.02
    decay = -np.log(0.02) / (edge * np.pi)
    damping = decay / np.sqrt(1 + decay**2)
    frequency, residue = np.array([500.0]), np.array([-0.5j * omega / np.sqrt(1 - damping**2)])
    covariance = np.diag([0.0, (1e-4 * damping) ** 2, 0.0, 0.0])
    model = ModalModel(frequency, np.array([damping]), residue, np.zeros(0), np.zeros(0), covariance)
    draws = damping * (1 + 1e-4 * np.random.default_rng(3).normal(size=150))
    moved = [model.with_vector(np.array([500.0, z, 0.0, residue[0].imag])) for z in draws]
    points = [settling_points(one.system, 0.02) for one in moved]
    times = [found[0] for found in points if found is not None]
    assert len(times) == len(draws)
    assert settling_u(model, 0.02) == pytest.approx(np.std(times), rel=0.25)


def test_figures_without_value_have_no_uncertainty() -> None:
    model = ModalModel(np.zeros(0), np.zeros(0), np.zeros(0, complex), np.array([20.0]), np.array([50.0]), np.eye(2))
    u = uncertainties(model)
    assert not {"natural_hz", "peak_hz"} & set(u)
    assert u["static_gain"] > 0.0
    unstable = replace(uncertain_model(1e-3), damping_ratio=np.array([-0.01, 0.02]))
    assert np.isnan(uncertainties(unstable)["settling_2_s"])
    with pytest.raises(ValueError, match="covariance"):
        uncertainties(replace(model, covariance=None))
