"""Linear systems and their indices: responses, conversions, closed forms, dense curves, uncertainties."""

from dataclasses import replace

import numpy as np
import pytest
from contracts import refused, slow
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal
from scipy.optimize import brentq

from shaker.lti.indices import LABELS, indices, moving_figures, pole_notices, settling_interval
from shaker.lti.responses import gain_curve, transient
from shaker.lti.system import LinearSystem, ModalModel
from shaker.model_notices import ALTERNATING_POLE, POLE_ABOVE_NYQUIST, UNSTABLE_POLES

RATE = 1e5


def lti(poles, gain=1.0, zeros=(), rate=None) -> LinearSystem:
    """A system by its poles, with zeros or without."""
    return LinearSystem(np.array(zeros, complex), np.array(poles, complex), gain, rate)


def oscillator(hertz: float, damping: float, gain: float = 1.0) -> LinearSystem:
    """One mode."""
    omega = 2 * np.pi * hertz
    pole = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    return lti([pole, np.conj(pole)], gain * omega**2)


def third_order(hertz: float = 1700.0, damping: float = 0.015, real_hz: float = 6000.0) -> LinearSystem:
    """A mode and a real pole, static gain 1."""
    return oscillator(hertz, damping).times(lti([-2 * np.pi * real_hz + 0j], 2 * np.pi * real_hz))


def with_zeros() -> LinearSystem:
    """Two modes with a pair of zeros between them, and a real zero."""
    poles = [-160 + 10680j, -160 - 10680j, -500 + 26000j, -500 - 26000j]
    return lti(poles, 3.0, [-200 + 18000j, -200 - 18000j, -9e4])


@pytest.mark.parametrize("system", [third_order(), with_zeros(), third_order(3.0, 0.004, 8.0)])
def test_zoh_gives_the_step_response_at_every_sample(system):
    time = np.arange(3000) / RATE
    found = system.sampled(RATE, "zoh").step(time)
    assert np.abs(found - system.step(time)).max() < 1e-7 * np.abs(system.step(time)).max()


@settings(max_examples=20, deadline=None)
@given(
    hertz=st.floats(20.0, 8000.0),
    damping=st.floats(1e-4, 0.9),
    real=st.floats(50.0, 9000.0),
    method=st.sampled_from(["zoh", "tustin"]),
)
def test_conversions_are_inverse(hertz, damping, real, method):
    system = third_order(hertz, damping, real)
    if np.min(np.abs(system.poles[:2] - system.poles[2])) < 0.02 * np.abs(system.poles[2]):
        return
    back = system.sampled(RATE, method).continuous(method)  # type: ignore[arg-type]
    grid = np.geomspace(1.0, 20e3, 60)
    assert np.allclose(np.sort_complex(back.poles), np.sort_complex(system.poles), rtol=1e-9)
    assert np.abs(back.response(grid) / system.response(grid) - 1).max() < 1e-4


def test_wrong_conversions_are_refused():
    turning = LinearSystem.from_coefficients(np.array([1.0, 0.0]), np.array([1.0, -0.3, -0.5]), RATE)
    refused("^system: .*z = 0", turning.continuous, "zoh")  # a pole that turns its sign with every sample
    assert turning.continuous("tustin").poles.real.max() < 0
    system = third_order()
    samples = system.sampled(RATE)
    refused("^system: ", samples.sampled, RATE)
    refused("^sample_rate_hz: ", system.continuous)
    refused("rate_hz", system.sampled, 0.0)
    refused("^poles: ", lti([-5.0, -5.0], 25.0).sampled, RATE, "zoh")
    refused("z = -1", lti([-1.0], rate=RATE).continuous)


def test_an_integrator_is_converted_by_zoh():
    system = lti([0j, -100 + 0j], 100.0)
    time = np.arange(200) / 1000.0
    expected = time - (1 - np.exp(-100 * time)) / 100
    assert np.allclose(system.step(time), expected, atol=1e-12)
    assert np.allclose(system.sampled(1000.0, "zoh").step(time), expected, atol=1e-12)
    assert np.allclose(system.sampled(1000.0, "zoh").continuous("zoh").step(time), expected, atol=1e-10)


@pytest.mark.parametrize("poles", [[-50, -50], [-50, -50, -50], [-20 + 90j, -20 - 90j] * 2, [-50, -50.001]])
def test_responses_with_coinciding_poles_agree_with_scipy(poles):
    system = lti(poles, 7.0, [-30.0])
    time = np.linspace(0, 0.3, 301)
    above, below = np.array([7.0, 210.0]), system.coefficients()[1]
    expected = signal.step((above, below), T=time)[1]
    assert np.allclose(system.step(time), expected, atol=1e-8 * np.abs(expected).max())
    pulse = signal.impulse((above, below), T=time)[1]
    assert np.allclose(system.impulse(time), pulse, atol=1e-8 * np.abs(pulse).max())


def test_the_response_begins_at_zero_time_with_the_direct_feedthrough():
    for response in (with_zeros().step, with_zeros().impulse):
        assert np.all(response(np.array([-1.0, -1e-9])) == 0)
        assert len(response(np.zeros(0))) == 0
    system = lti([-5.0], 2.0, [-10.0])
    assert (system.direct, system.step(np.zeros(1))[0]) == (2.0, pytest.approx(2.0))
    assert system.step(np.array([20.0]))[0] == pytest.approx(4.0)
    assert np.allclose(system.impulse(np.array([0.0, 0.1])), 10.0 * np.exp(-5.0 * np.array([0.0, 0.1])))


def test_residues_reproduce_the_system():
    system = with_zeros()
    rebuilt = LinearSystem.from_residues(system.poles, system.residues(), system.direct)
    hertz = np.linspace(0, 20e3, 200)
    assert np.allclose(rebuilt.response(hertz), system.response(hertz), rtol=1e-10)
    assert rebuilt.gain == pytest.approx(system.gain, rel=1e-9)
    expected, poles, _ = signal.residue(*system.coefficients())
    order = [int(np.argmin(np.abs(poles - pole))) for pole in system.poles]
    assert np.allclose(system.residues(), expected[order], rtol=1e-8)
    system = third_order()  # rounding leaves no zeros far away
    rebuilt = LinearSystem.from_residues(system.poles, system.residues())
    assert (len(rebuilt.zeros), rebuilt.static_gain) == (0, pytest.approx(1.0, rel=1e-10))
    refused("residues", LinearSystem.from_residues, system.poles, np.zeros(3, complex))


def test_modal_form_and_its_system_are_one():
    oscillating = np.array([1700.0, 4200.0]), np.array([0.015, -0.02]), np.array([-1e2 - 5e3j, 3e1 - 2e2j])
    model = ModalModel(*oscillating, np.array([6000.0, 40.0]), np.array([500.0, 3.0]))
    poles, residues = model.terms
    order, model_order = np.argsort(poles), np.argsort(model.system.poles)
    np.testing.assert_allclose(model.system.poles[model_order], poles[order], rtol=1e-12)
    np.testing.assert_allclose(model.system.residues()[model_order], residues[order], rtol=1e-8)
    time = np.linspace(-1e-4, 2e-3, 300)
    assert np.allclose(model.step(time), model.system.step(time), atol=1e-9)
    assert np.allclose(model.impulse(time), model.system.impulse(time), atol=1e-9 * np.abs(model.impulse(time)).max())


def test_variances_below_zero_by_rounding_have_no_effect():
    residues = third_order().residues()
    variance = np.diag([1e-4, 1e-12, 1e-6, 1e-6, 1.0, -1e-27])
    model = ModalModel(
        np.array([1700.0]), np.array([0.015]), residues[:1], np.array([6000.0]), residues[2:].real, covariance=variance
    )
    value, slope = model.jacobian(lambda moved: moved.frequency_hz)
    assert value == pytest.approx([1700.0])
    assert slope == pytest.approx(np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))


DAMPINGS = [1e-5, 0.004, 0.02, 0.2, 0.5, 0.65, 0.9]


def ratio_at(level: float, damping: float, upper: bool) -> float:
    """Frequency ratio at which 1/√((1 - r²)² + 4ζ²r²) is a level: r² = 1 - 2ζ² ± √((1 - 2ζ²)² - 1 + level⁻²)."""
    middle = 1 - 2 * damping**2
    inner = np.sqrt(middle**2 - 1 + level**-2)
    return float(np.sqrt(middle + inner if upper else middle - inner))


@pytest.mark.parametrize("damping", DAMPINGS)
def test_frequencies_and_step_of_an_oscillator(damping):
    found = indices(oscillator(500.0, damping, -3.0), nominal_gain=3.1)
    assert (found.natural_hz, found.damped_hz) == pytest.approx((500.0, 500.0 * np.sqrt(1 - damping**2)), rel=1e-12)
    assert (found.damping_ratio, found.static_gain) == (pytest.approx(damping, rel=1e-10), pytest.approx(-3.0))
    assert found.quadrature_hz == pytest.approx(500.0, rel=1e-9)
    assert found.half_power_hz == pytest.approx(500.0 * ratio_at(0.5**0.5, damping, True), rel=1e-12)
    if damping < 0.5**0.5:
        assert found.peak_hz == pytest.approx(500.0 * np.sqrt(1 - 2 * damping**2), rel=1e-9)
        assert found.peak_gain == pytest.approx(0.5 / damping / np.sqrt(1 - damping**2), rel=1e-9)
    else:
        assert (found.peak_hz, found.peak_gain) == (None, None)
    for part in (0.05, 0.10):
        rises = (found.peak_gain or 0.0) > 1 + part
        band = 500.0 * (ratio_at(1 + part, damping, False) if rises else ratio_at(1 - part, damping, True))
        name = f"band_{round(100 * part)}_hz"
        assert getattr(found, name) == pytest.approx(band, rel=1e-10)
        nominal = indices(oscillator(500.0, damping, 2.0), nominal_gain=2.0)
        assert getattr(nominal, name.replace("_hz", "_nominal_hz")) == pytest.approx(band, rel=1e-10)
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


@pytest.mark.parametrize("count", [1, 2, 3])
def test_equal_lags(count):
    """1 - exp(-at)·Σ(at)^k/k! of `count` of them."""
    found, within = indices(lti([-100] * count, 100.0**count)), 1e-10 if count == 1 else 1e-8
    assert (found.dominant, found.natural_hz) == (None, None)
    assert found.real_poles_hz == pytest.approx((100 / (2 * np.pi),) * count)
    assert found.band_10_hz == pytest.approx(100 / (2 * np.pi) * np.sqrt(0.9 ** (-2 / count) - 1), rel=1e-10)

    def rest(t: float) -> float:
        return float(np.exp(-100 * t) * np.sum((100 * t) ** np.arange(count) / np.array([1, 1, 2])[:count]))

    settled, *passing = (
        brentq(lambda t, level=level: rest(t) - level, 0, 1.0, xtol=1e-18) for level in (0.02, 0.9, 0.1)
    )
    assert found.settling_2_s == pytest.approx(settled, rel=within)
    assert (found.rise_s, found.overshoot) == (pytest.approx(passing[1] - passing[0], rel=within), 0.0)
    assert found.half_power_hz == pytest.approx(100 / (2 * np.pi) * np.sqrt(2 ** (1 / count) - 1), rel=1e-10)


def test_direct_feedthrough_is_immediate():
    """(s/2 + a)/(s + a) begins at one half: 10 % are there from the start, 90 % at ln 5/a, 2 % are left at ln 25/a."""
    found = indices(lti([-200.0], 0.5, [-400.0]))
    assert found.rise_s == pytest.approx(np.log(5.0) / 200.0, rel=1e-12)
    assert found.settling_2_s == pytest.approx(np.log(25.0) / 200.0, rel=1e-12)
    assert found.overshoot == 0.0


def test_a_band_left_and_reentered():
    """A peak of 15 % and what comes behind it: two more ranges within ±10 %, one of them behind the peak."""
    system = oscillator(1000.0, 0.5)
    curve = gain_curve(system)
    ranges = curve.inside(0.9, 1.1)
    ends = [1000 * ratio_at(level, 0.5, upper) for level, upper in ((1.1, False), (1.1, True), (0.9, True))]
    assert np.allclose(np.ravel(ranges)[1:], ends, rtol=1e-10)
    assert ranges[0][0] == 0.0
    assert indices(system).band_10_hz == pytest.approx(ends[0])
    assert curve.crossings(2.0) == []


def test_a_narrow_resonance_far_above_ends_the_band():
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


@settings(max_examples=12, deadline=None)
@given(
    hertz=st.lists(st.floats(100.0, 5000.0), min_size=2, max_size=2),
    damping=st.lists(st.floats(0.003, 0.8), min_size=2, max_size=2),
    share=st.floats(-0.5, 0.5),
    real=st.floats(300.0, 20000.0),
)
def test_figures_agree_with_dense_curves(hertz, damping, share, real):
    if abs(hertz[0] / hertz[1] - 1) < 0.01:
        return
    omega, zeta = 2 * np.pi * np.array(hertz), np.array(damping)
    residue = -0.5j * np.array([1.0, share]) * omega / np.sqrt(1 - zeta**2)
    lag = lti([-2 * np.pi * real + 0j], 2 * np.pi * real)
    system = ModalModel(np.array(hertz), zeta, residue, np.zeros(0), np.zeros(0)).system.times(lag)
    found, static = indices(system), system.static_gain
    grid = np.linspace(0, 8000, 40001)
    gain = np.abs(system.response(grid)) / abs(static)
    for part, end in ((0.05, found.band_5_hz), (0.10, found.band_10_hz)):
        assert end is not None
        assert np.abs(gain[grid < 0.9999 * end] - 1).max() <= part
        assert abs(abs(abs(system.response(np.array([end]))[0] / static) - 1) - part) < 1e-9
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


def test_samples_agree_with_the_continuous_system():
    system = oscillator(500.0, 0.05).times(lti([-2e4 + 0j], 2e4))
    rate = 1e6
    true, found = indices(system).figures(), indices(system.sampled(rate)).figures()
    for name, value in true.items():
        assert value is not None
        within = {"hz": 2e-3 * value, "s": 1.01 / rate}.get(name.rsplit("_", 1)[-1], 1e-4 * value)
        assert found[name] == pytest.approx(value, abs=within), name
    assert true["natural_hz"] == pytest.approx(found["natural_hz"], rel=1e-9)


def test_bands_without_an_end_and_bands_that_do_not_begin():
    lead = lti([-102], 1.02, [-100])
    assert (indices(lead).band_5_hz, indices(lead).half_power_hz) == (np.inf, None)
    assert indices(lead.sampled(1e4, "tustin")).band_5_hz == pytest.approx(5e3)
    off_nominal = indices(oscillator(500.0, 0.1, 1.13))
    assert off_nominal.band_5_nominal_hz is off_nominal.band_10_nominal_hz is None
    assert off_nominal.band_5_hz is not None


def test_a_system_that_loses_its_level_has_no_figures_of_it_nor_an_unstable_one_times():
    found = indices(lti([-10 + 100j, -10 - 100j], zeros=[0]))
    assert (found.static_gain, found.peak_hz) == (0.0, pytest.approx(np.sqrt(1e4 + 100) / (2 * np.pi)))
    for name in set(LABELS) - {"static_gain", "natural_hz", "damped_hz", "damping_ratio", "peak_hz"}:
        assert found.figures()[name] is None, name
    found = indices(lti([1 + 50j, 1 - 50j, -9.0], 1.0))
    assert not found.stable
    assert (found.settling_2_s, found.overshoot) == (None, None)
    assert found.notices[0].code == UNSTABLE_POLES.code
    assert found.notices[0].values == {"unstable": 2, "poles": 3}
    assert found.notices[0].severity == "warning"


def test_poles_and_zeros_on_the_axis():
    """Without damping: infinite gain at the pole, none at the zero, and the bands that r² = 1 ± … gives."""
    system = lti([1000j, -1000j], 1e6)
    found = indices(system)
    assert (found.peak_hz, found.peak_gain) == (pytest.approx(1000 / (2 * np.pi)), None)
    assert found.band_5_hz == pytest.approx(1000 / (2 * np.pi) * np.sqrt(1 - 1 / 1.05), rel=1e-12)
    assert found.settling_2_s is None
    assert system.response(np.array([found.peak_hz or 0.0, 0.0]))[1] == pytest.approx(1.0)
    notch = lti([-10 + 1000j, -10 - 1000j], 1e6 / 9e6, [3000j, -3000j])
    assert indices(notch).settling_2_s is not None
    assert gain_curve(notch).gain.min() < 1e-9


def test_an_integrator_has_no_static_gain():
    for system in (lti([0j], 2.0), lti([1 + 0j], 2.0, rate=1e3)):
        found = indices(system)
        assert (found.static_gain, found.band_5_hz, found.settling_2_s) == (np.inf, None, None)
        assert not found.stable


def test_an_average_of_samples():
    """Zeros on the unit circle, all poles at z = 0: the response climbs by a fifth with each of five samples."""
    found = indices(LinearSystem.from_coefficients(np.full(5, 0.2), np.array([1.0, 0, 0, 0, 0]), 1e3))
    assert found.notices == ()
    assert (found.overshoot, found.settling_2_s) == (pytest.approx(0.0, abs=1e-12), pytest.approx(4e-3))

    def gain(f: float) -> float:
        return float(np.sin(np.pi * f / 200) / (5 * np.sin(np.pi * f / 1000)))

    assert gain(found.half_power_hz or 0.0) == pytest.approx(0.5**0.5, rel=1e-9)
    assert gain(found.band_5_hz or 0.0) == pytest.approx(0.95, rel=1e-9)


def test_false_poles_are_reported():
    samples = lti([0.9 + 0.2j, 0.9 - 0.2j, -0.62], rate=1e5)
    assert [n.where for n in pole_notices(samples) if n.code == ALTERNATING_POLE.code] == ["pole -0.62"]
    far = lti([-3e3 + 1e4j, -3e3 - 1e4j, -8.6e5], 1.0)
    assert pole_notices(far) == ()
    assert pole_notices(far, 1e5)[0].code == POLE_ABOVE_NYQUIST.code
    near = lti([-10, -3e3 + 1e4j, -3e3 - 1e4j], zeros=[-10.05])
    assert [n.severity for n in pole_notices(near)] == ["note"]


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
    return dict(zip(names, np.sqrt(np.diag(model.propagate(moving)[1])).tolist(), strict=True))


def test_uncertainties_are_the_changes_of_figures_by_every_cause():
    model = uncertain_model(2e-3)
    assert model.covariance is not None
    first, causes = indices(model.system).figures(), 1e-3 * np.linalg.cholesky(model.covariance).T
    moved = [indices(model.with_vector(model.vector + cause).system).figures() for cause in causes]
    for name, u in uncertainties(model).items():
        change = np.linalg.norm([row[name] - first[name] for row in moved]) / 1e-3
        assert u == pytest.approx(change, rel=1e-2), name


@pytest.mark.parametrize("off", [-3.0, 0.0, *slow(-1.0, 1.0, 3.0)])
def test_settling_time_has_an_interval_of_half_periods(off):
    """An extreme lies `off` standard uncertainties of the damping beyond the limit: draws jump by half a period."""
    omega = 2 * np.pi * 500.0
    edge = 40  # exp(-40πζ/√(1-ζ²)) = 0.02
    decay = -np.log(0.02) / (edge * np.pi)
    damping = decay / np.sqrt(1 + decay**2) * (1.0 - 1e-4 * off)
    frequency, residue = np.array([500.0]), np.array([-0.5j * omega / np.sqrt(1 - damping**2)])
    covariance = np.diag([0.0, (1e-4 * damping) ** 2, 0.0, 0.0])
    model = ModalModel(frequency, np.array([damping]), residue, np.zeros(0), np.zeros(0), covariance)
    draws = damping * (1 + 1e-4 * np.random.default_rng(3).normal(size=200))
    moved = [model.with_vector(np.array([500.0, z, 0.0, residue[0].imag])) for z in draws]
    times = np.array([indices(one.system).settling_2_s for one in moved], dtype=np.float64)
    low, high = settling_interval(model, 0.02, 1.96)
    share = np.mean((times >= low) & (times <= high))
    assert 0.91 <= share <= (1.0 if abs(off) < 2.0 else 0.98)
    half = 0.5 / 500.0
    assert high - low == pytest.approx(half if abs(off) < 2.0 else 0.0, abs=0.2 * half)


def test_figures_without_value_have_no_uncertainty():
    model = ModalModel(np.zeros(0), np.zeros(0), np.zeros(0, complex), np.array([20.0]), np.array([50.0]), np.eye(2))
    u = uncertainties(model)
    assert not {"natural_hz", "peak_hz"} & set(u)
    assert u["static_gain"] > 0.0
    unstable = replace(uncertain_model(1e-3), damping_ratio=np.array([-0.01, 0.02]))
    assert settling_interval(unstable, 0.02, 1.96) is None
    refused("covariance", uncertainties, replace(model, covariance=None))
