"""Compensation filters, their streams and bands against published figures, scipy, the algebra of poles, Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
from contracts import refused
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import signal
from scipy.integrate import solve_ivp

from shaker.compensation.effects import (
    MODEL_ERROR_SHARE,
    CompensationWithUncertainty,
    FeedbackRun,
    HapticLoop,
    filtered_noise,
    gain_band,
    is_stable,
    largest_stable_gain,
    push,
    residual_ringing,
    simulate_feedback,
    target_for_bandwidth,
    target_for_frequency,
    white_noise_gain,
)
from shaker.compensation.filter import (
    Compensation,
    CompensationFilter,
    CompensationTarget,
    Sections,
    SensorDynamics,
    band_ratio,
    best_damping,
    discretisation_error,
    discretise,
    loaded_dynamics,
    modal_dynamics,
    pad_sections,
    parameter_sections,
    single_mode,
)
from shaker.lti.indices import indices
from shaker.lti.system import ModalModel
from shaker.release.load_model import LoadModel

SINGLE = single_mode(500.0, 0.004)
PUBLISHED = Compensation(SINGLE, CompensationTarget(1000.0, 0.5))
OMEGA = 6280.0
TWO_MASSES = LoadModel("Fy", "Fy", "V", 0.240, 2.36e6, 6.0)
THREE_MASSES = LoadModel("Fy", "Fy", "V", 0.240, 2.36e6, 6.0, 1.89e6, 4.0)


def _for_load(load: float, target: CompensationTarget, model: LoadModel = TWO_MASSES, modes: int = 1) -> Compensation:
    """The filter of a sensor that carries a load."""
    return Compensation(loaded_dynamics(model, load, modes=modes), target)


def _chain(fn: float, zeta: float, real_hz: float, covariance: np.ndarray | None = None) -> ModalModel:
    """ω²a/[(s² + 2ζωs + ω²)(s + a)] as residues."""
    omega, a = 2 * np.pi * fn, 2 * np.pi * real_hz
    poles = np.roots(np.polymul([1, 2 * zeta * omega, omega**2], [1, a]))
    upper, top = poles[poles.imag > 0][0], omega**2 * a
    residue = top / ((upper - upper.conj()) * (upper + a))
    real = (top / np.abs(-a - upper) ** 2).real
    return ModalModel(
        np.array([fn]), np.array([zeta]), np.array([residue]), np.array([real_hz]), np.array([real]), covariance
    )


def test_the_published_case():
    """2.36e6/(0.240 s² + 6 s + 2.36e6), which is 500 Hz and ζ = 0.004 in round numbers."""
    filtered = _for_load(0.0, PUBLISHED.target)
    before, after = indices(filtered.sensor.system), indices(filtered.compensated)
    assert (before.overshoot, after.overshoot, before.settling_2_s) == pytest.approx((0.988, 0.163, 312.6e-3), abs=5e-4)
    assert after.settling_2_s == pytest.approx(1.29e-3, abs=5e-6)
    assert (before.band_10_hz, after.band_10_hz) == (pytest.approx(150.5, abs=0.06), pytest.approx(472.8, abs=0.05))


def test_the_filter_is_proper_and_its_factor_the_ratio_of_the_denominators_at_rest():
    factor = _for_load(0.0, CompensationTarget(OMEGA / (2 * np.pi), 0.5)).system.gain / TWO_MASSES.moving_mass
    assert factor == pytest.approx(OMEGA**2 / 2.36e6, rel=1e-12)
    assert factor == pytest.approx(16.7, abs=0.02)
    assert len(PUBLISHED.system.zeros) == len(PUBLISHED.system.poles) == 2
    assert PUBLISHED.system.static_gain == pytest.approx(1.0, rel=1e-14)
    calibrated = Compensation(single_mode(500.0, 0.004, 2.5e-3), CompensationTarget(1000.0, 0.5), calibrated=True)
    assert calibrated.compensated.static_gain == pytest.approx(1.0, rel=1e-13)


@pytest.mark.parametrize(("damping", "band_10_hz"), [(0.5, 472.5), (0.6, 915.7)])
def test_bands_of_the_published_frequency(damping, band_10_hz):
    """At ω = 6280 rad/s the damping 0.6 keeps ±10 % to twice the frequency that 0.5 does."""
    assert OMEGA / (2 * np.pi) * band_ratio(damping, 0.1) == pytest.approx(band_10_hz, abs=0.1)
    b, a = [1.0], [1.0, 2 * damping, 1.0]
    edge = np.abs(signal.freqs(b, a, [0.999 * band_ratio(damping, 0.1), 1.001 * band_ratio(damping, 0.1)])[1])
    assert abs(edge[0] - 1) < 0.1 < abs(edge[1] - 1)


@pytest.mark.parametrize("error", [0.01, 0.05, 0.1, 0.3])
def test_best_damping_is_where_a_search_finds_the_widest_band(error):
    grid = np.linspace(0.3, 0.9, 6001)
    found = grid[np.argmax([band_ratio(damping, error) for damping in grid])]
    assert best_damping(error) == pytest.approx(found, abs=1.1e-4)


def test_bandwidth_target_is_that_of_the_closed_form_for_one_mode_and_counts_the_poles_that_stay():
    found = target_for_bandwidth(SINGLE, 900.0, 0.1)
    share = (1 - MODEL_ERROR_SHARE) * 0.1
    assert found.damping_ratio == pytest.approx(best_damping(share), abs=2e-5)
    assert found.frequency_hz == pytest.approx(900.0 / band_ratio(best_damping(share) + 1e-9, share), rel=1e-4)
    sensor = modal_dynamics(_chain(1700.0, 0.015, 6000.0))
    found = target_for_bandwidth(sensor, 2000.0, 0.1)
    assert _band_hz(sensor, found) > 2000.0
    refused("^bandwidth_hz: .*8000", target_for_bandwidth, sensor, 8000.0, 0.01)


def _band_hz(sensor: SensorDynamics, target: CompensationTarget) -> float:
    """Where the compensated sensor leaves ±10 %."""
    return indices(Compensation(sensor, target).compensated).band_10_hz or 0.0


def test_damping_is_chosen_for_the_whole_sensor():
    """One mode: the closed form. Two: the mode above raises the gain, and more damping is needed to keep 10 %."""
    one = target_for_frequency(SINGLE, 1000.0, 0.1)
    assert one.damping_ratio == best_damping((1 - MODEL_ERROR_SHARE) * 0.1)
    sensor = loaded_dynamics(THREE_MASSES, 0.098, modes=2)
    two = target_for_frequency(sensor, 1000.0, 0.1)
    bands = [_band_hz(sensor, CompensationTarget(1000.0, two.damping_ratio + by)) for by in (-0.03, 0.0, 0.03)]
    assert two.damping_ratio > one.damping_ratio
    assert bands[1] > 1.2 * bands[0]
    assert bands[1] > bands[2]


def test_a_low_pass_reduces_the_noise_only():
    """The filter is that without it times a Butterworth low-pass of scipy, and the search for a damping knows it."""
    sensor = loaded_dynamics(THREE_MASSES, 0.198, modes=2)
    plain, quiet = (Compensation(sensor, CompensationTarget(1000.0, 0.55, None, corner)) for corner in (None, 4000.0))
    band = np.array([1.0, 200.0, 900.0, 3000.0])
    b, a = signal.butter(2, 2 * np.pi * 4000.0, analog=True)
    expected = plain.system.response(band) * signal.freqs(b, a, 2 * np.pi * band)[1]
    np.testing.assert_allclose(quiet.system.response(band), expected, rtol=1e-9)
    found = discretise(quiet, 200e3)
    assert len(found.sos) == 3
    assert np.max(np.abs(discretisation_error(quiet, found, band))) < 0.01
    assert white_noise_gain(found) < 0.4 * white_noise_gain(discretise(plain, 200e3))
    wide = target_for_frequency(SINGLE, 1000.0, 0.1, None, 1500.0)
    same = CompensationTarget(1000.0, best_damping(0.09), None, 1500.0)
    assert _band_hz(SINGLE, wide) > _band_hz(SINGLE, same)
    assert wide.damping_ratio < same.damping_ratio


def test_real_poles_move_with_the_mode():
    sensor = modal_dynamics(_chain(1700.0, 0.015, 6000.0), real_poles=True)
    found = Compensation(sensor, CompensationTarget(3000.0, 0.6, 30e3)).compensated
    np.testing.assert_allclose(found.poles[-1], -2 * np.pi * 30e3, rtol=1e-9)
    assert len(found.poles) == 3
    refused("real_hz", Compensation, sensor, CompensationTarget(3000.0, 0.6))


@pytest.mark.parametrize("load", [0.008, 0.098])
def test_further_modes_are_damped_and_stay_above_the_target(load):
    """With 8 g the second mode is at 2490 Hz and stays there, with 98 g it is at 884 Hz and goes to 2000 Hz."""
    sensor = loaded_dynamics(THREE_MASSES, load, modes=2)
    found = indices(Compensation(sensor, CompensationTarget(1000.0, 0.5)).compensated)
    assert [mode.damping_ratio for mode in found.modes] == pytest.approx([0.5, 0.5], rel=1e-9)
    assert [mode.natural_hz for mode in found.modes] == pytest.approx([1000.0, max(2000.0, sensor.frequency_hz[1])])


@pytest.mark.parametrize(("load", "share"), [(0.008, 0.035), (0.048, 0.18), (0.098, 0.31), (0.198, 0.47)])
def test_ringing_of_a_filter_for_no_load(load, share):
    """The published sensor with the filter for no load: what is left from 2 ms on, by the step response of scipy."""
    filtered = _for_load(0.0, CompensationTarget(OMEGA / (2 * np.pi), 0.5))
    found = residual_ringing(filtered, TWO_MASSES.system(load), 2e-3)
    assert found == pytest.approx(share, abs=5e-3)
    top = np.polymul([2.36e6], [0.24, 6.0, 2.36e6])
    below = np.polymul([0.24 + load, 6.0, 2.36e6], [1.0, OMEGA, OMEGA**2])
    time = np.linspace(0.0, 0.02, 40_001)
    response = signal.step((top, below), T=time)[1] / (top[-1] / below[-1])
    assert found == pytest.approx(np.max(np.abs(response[time >= 2e-3] - 1)), rel=2e-4)


def test_a_filter_for_the_load_leaves_only_the_decay_of_the_target():
    left = residual_ringing(_for_load(0.198, PUBLISHED.target), TWO_MASSES.system(0.198), 2e-3)
    assert left < 1.16 * np.exp(-0.5 * 2 * np.pi * 1000.0 * 2e-3)


def test_matched_sections_cancel_the_sampled_sensor_at_every_rate():
    for rate in (5e3, 1e4, 1e5):
        sensor = PUBLISHED.sensor.system.sampled(rate)
        zeros = np.roots(discretise(PUBLISHED, rate).sos[0, :3])
        np.testing.assert_allclose(np.sort_complex(zeros), np.sort_complex(sensor.poles), rtol=1e-10)


def test_tustin_keeps_the_frequency_of_the_mode_and_is_scipys():
    rate = 20e3
    found = discretise(PUBLISHED, rate, "tustin")
    assert abs(discretisation_error(PUBLISHED, found, np.array([500.0]))[0]) < 1e-11
    omega = 2 * np.pi * 500.0
    top, below = PUBLISHED.system.coefficients()
    b, a = signal.bilinear(top, below, 0.5 * omega / np.tan(0.5 * omega / rate))
    np.testing.assert_allclose(found.sos[0], np.concatenate([b, a]), rtol=1e-9)


@pytest.mark.parametrize("method", ["matched", "tustin"])
def test_discretisation_error_falls_with_the_rate_and_is_that_of_scipy(method):
    band = np.linspace(1.0, 1000.0, 64)
    errors = []
    for rate in (10e3, 20e3, 40e3):
        found = discretise(PUBLISHED, rate, method)  # type: ignore[arg-type]
        other = signal.sosfreqz(found.sos, worN=band, fs=rate)[1]
        np.testing.assert_allclose(found.response(band), other, rtol=1e-9)
        errors.append(np.max(np.abs(discretisation_error(PUBLISHED, found, band))))
    assert (errors[0] / errors[1], errors[1] / errors[2]) == pytest.approx((4.0, 4.0), rel=0.1)


def test_covariance_of_modes_reaches_the_sensor_and_that_of_a_load_follows_the_rigid_formula():
    spread = np.diag([0.3, 2e-5, 0.5, 0.5, 10.0, 5.0]) ** 2
    sensor = modal_dynamics(_chain(1700.0, 0.015, 6000.0, spread), real_poles=True)
    assert sensor.covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(sensor.covariance))[:3], [0.3, 2e-5, 10.0], rtol=1e-6)
    assert sensor.covariance[0, 3] != 0.0
    uncertain = LoadModel("Fy", "Fy", "V", 0.24, 2.36e6, 6.0, u_moving_mass=1e-3, covariance=np.diag([1e3, 0.1]) ** 2)
    found = loaded_dynamics(uncertain, 0.1)
    relative = 0.5 * np.sqrt((1e3 / 2.36e6) ** 2 + (1e-3 / 0.34) ** 2)
    assert found.u[0] / found.frequency_hz[0] == pytest.approx(relative, rel=1e-4)


def test_wrong_calls_name_the_argument():
    refused("^damping_ratio: ", single_mode, 500.0, -0.01)
    refused("^frequency_hz: ", CompensationTarget, 0.0, 0.5)
    refused("^sample_rate_hz: ", discretise, PUBLISHED, 2000.0)
    with pytest.raises(ValueError, match="method"):
        discretise(PUBLISHED, 2e4, "zoh")  # type: ignore[arg-type]
    refused("permitted_error", best_damping, 1.5)
    refused("^modes: ", modal_dynamics, _chain(1700.0, 0.015, 6000.0), modes=2)
    refused("^modes: ", loaded_dynamics, TWO_MASSES, 0.0, modes=-1)
    refused("^frequency_hz: ", SensorDynamics, np.zeros(0), np.zeros(0), np.zeros(0), 1.0, PUBLISHED.system)


RATE = 50e3


def _sections(load: float) -> Sections:
    """Low-pass and two modes, always three sections, of which the last lets all pass where the load is none."""
    return pad_sections(
        discretise(_for_load(load, CompensationTarget(1000.0, 0.5, None, 6000.0), THREE_MASSES, 2), RATE), 3
    )


def _uncertain(calibrated: bool = False, corner: float | None = None) -> Compensation:
    sensor = replace(single_mode(500.0, 0.004, 2.0), covariance=np.diag([0.05, 1e-4, 0.0]) ** 2)
    return Compensation(sensor, CompensationTarget(1000.0, 0.5, None, corner), calibrated)


def _run(data: np.ndarray, level: float | None, switch: int, cuts: list[int]) -> np.ndarray:
    """Data (C, N) in blocks through a filter that is switched from one load to another after some samples."""
    stream, parts, start = CompensationFilter(_sections(0.0), len(data), level), [], 0
    for stop in sorted([*cuts, switch, data.shape[1]]):
        if start == switch:
            stream.switch(_sections(0.198))
        parts.append(stream(data[:, start:stop]))
        start = stop
    return np.concatenate(parts, axis=1)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    cuts=st.lists(st.integers(0, 400), max_size=8),
    switch=st.integers(1, 400),
    channels=st.integers(1, 3),
    level=st.sampled_from([None, 0.25]),
)
@example(seed=0, cuts=[100, 100, 250], switch=400, channels=2, level=None)
def test_any_split_into_blocks_gives_the_same_bits_with_a_switch_or_without(seed, cuts, switch, channels, level):
    data = np.random.default_rng(seed).normal(size=(channels, 400)).cumsum(axis=1)
    assert np.array_equal(_run(data, level, switch, cuts), _run(data, level, switch, []))


def test_one_channel_of_many_is_that_channel_alone():
    data = np.random.default_rng(5).normal(size=(3, 500))
    sections = _sections(0.048)
    together = CompensationFilter(sections, 3)(data)
    for row, alone in zip(together, data, strict=True):
        assert np.array_equal(row, CompensationFilter(sections)(alone[None])[0])
        np.testing.assert_array_equal(row, signal.sosfilt(sections.sos, alone))


def test_it_starts_settled_and_a_switch_leaves_a_constant_alone():
    for level in (None, 3.5):
        np.testing.assert_allclose(_run(np.full((2, 550), 3.5), level, 50, []), 3.5, rtol=1e-9)


def test_a_switch_is_continuous_and_converges_to_the_filter_of_the_new_load():
    """A slow sine: no step is larger than those of the signal itself; the bare old state would jump by far more."""
    time = np.arange(6000) / RATE
    data = 1.0 + np.sin(2 * np.pi * 40.0 * time)[None]
    old, new = _sections(0.0), _sections(0.198)
    out = _run(data, 1.0, 3000, [])[0]
    usual = np.max(np.abs(np.diff(out[100:2990])))
    assert np.max(np.abs(np.diff(out[2995:]))) < 1.2 * usual
    naive, state = signal.sosfilt(old.sos, data[0, :3000] - 1.0, zi=np.zeros((3, 2)))
    carried = signal.sosfilt(new.sos, data[0, 3000:] - 1.0, zi=state)[0]
    assert abs(carried[0] - naive[-1]) > 50 * usual
    always = CompensationFilter(new, level=1.0)(data)[0]
    np.testing.assert_allclose(out[3000 + 300 :], always[3300:], atol=1e-6)


def test_white_noise_gain_is_the_energy_of_the_impulse_response_and_that_of_a_density():
    for sections in (_sections(0.0), _sections(0.198)):
        energy = np.sum((sections.gain * signal.sosfilt(sections.sos, np.eye(1, 20_000)[0])) ** 2)
        assert white_noise_gain(sections) == pytest.approx(np.sqrt(energy), rel=1e-9)
    sections, frequency = discretise(_uncertain(), RATE), np.linspace(0.0, RATE / 2, 20_001)
    density = np.full(frequency.shape, 1.0 / np.sqrt(RATE / 2))
    assert filtered_noise(sections, frequency, density)[1] == pytest.approx(white_noise_gain(sections), rel=1e-6)


def test_band_of_the_gain_is_its_change_by_frequency_and_damping():
    frequency = np.array([50.0, 300.0, 450.0, 700.0, 1000.0])
    pairs = ((500.0, 0.004), (500.0005, 0.004), (500.0, 0.004001))  # a hundredth of u of each
    exact, *moved = (1 - (frequency / a) ** 2 + 2j * b * frequency / a for a, b in pairs)
    changes, band = 1e2 * np.log(np.array(moved) / exact), gain_band(_uncertain(), frequency)
    np.testing.assert_allclose(band.u_gain, np.linalg.norm(changes.real, axis=0), rtol=1e-2)
    np.testing.assert_allclose(band.u_phase_rad, np.linalg.norm(changes.imag, axis=0), rtol=1e-2)


@pytest.mark.parametrize(("method", "corner"), [("matched", None), ("tustin", None), ("matched", 5000.0)])
def test_parameter_sections_are_the_derivatives(method, corner):
    compensation = _uncertain(calibrated=True, corner=corner)
    frequency = np.array([100.0, 480.0, 900.0])
    slopes = compensation.sensitivities(frequency)
    base = discretise(compensation, 1e6, method).response(frequency)  # type: ignore[arg-type]
    for index, one in enumerate(parameter_sections(compensation, 1e6, method)):  # type: ignore[arg-type]
        np.testing.assert_allclose(one.response(frequency), base * slopes[:, index], rtol=2e-3, atol=1e-9)


def test_the_uncertainty_of_every_sample_is_its_change_by_frequency_damping_and_noise():
    compensation, time, noise = _uncertain(calibrated=True), np.arange(400) / RATE, 2e-3
    sections = discretise(compensation, RATE)

    def indicated(frequency_hz: float, damping: float) -> np.ndarray:
        seen = single_mode(frequency_hz, damping, 2.0).system.step(time)
        return CompensationFilter(sections)(seen[None])[0]

    first = indicated(500.0, 0.004)
    changes = [1e2 * (indicated(*other) - first) for other in ((500.0005, 0.004), (500.0, 0.004001))]  # 0.01 u of each
    run = CompensationWithUncertainty(compensation, RATE, noise=noise)(compensation.sensor.system.step(time)[None])
    np.testing.assert_allclose(run.value[0], first, rtol=1e-12)
    np.testing.assert_allclose(
        run.u_model[0], np.linalg.norm(changes, axis=0), rtol=2e-2, atol=1e-2 * run.u_model.max()
    )
    assert run.u_noise == pytest.approx(noise * white_noise_gain(sections))
    np.testing.assert_allclose(run.u, np.hypot(run.u_model, run.u_noise))


def test_a_block_of_gaps_is_refused():
    stream = CompensationFilter(discretise(_uncertain(), RATE), 2)
    refused("^block: ", stream, np.array([[1.0, np.nan], [0.0, 0.0]]))
    refused("^block: ", stream, np.zeros((3, 5)))
    assert stream(np.zeros((2, 0))).shape == (2, 0)
    refused("^sections: .*3", stream.switch, _sections(0.1))
    refused("^sections: ", stream.switch, discretise(_uncertain(), 2 * RATE))
    refused("^sos: ", Sections, np.ones((1, 6)) * 2.0, 1.0, RATE)


LOAD = 0.198
LOOP = HapticLoop(
    hand_stiffness=500.0,
    hand_damping=5.0,
    mass=0.8,
    damping=2.0,
    ball_stiffness=1000.0,
    force_gain=5.0,
    sample_rate_hz=10e3,
)
UNAWARE, AWARE = (
    discretise(_for_load(load, CompensationTarget(1000.0, 0.55)), LOOP.sample_rate_hz) for load in (0.0, LOAD)
)
HAND = push(np.arange(12_000) / LOOP.sample_rate_hz, 0.03, 1.0)


def test_fast_sampling_follows_the_continuous_equations():
    """Handle, sensor and control integrated by scipy, the ball always touched."""
    loop = replace(LOOP, force_gain=1.0, sample_rate_hz=200e3)
    time = np.arange(10_000) / loop.sample_rate_hz
    hand = push(time, 0.01, 0.1)
    found = simulate_feedback(loop, TWO_MASSES.system(LOAD), None, hand, wall_m=-1e-3)
    omega2, damping = 2.36e6 / (0.240 + LOAD), 6.0 / (0.240 + LOAD)

    def slopes(t: float, z: np.ndarray) -> list[float]:
        x, v, run, rate = z
        x_h = 0.005 * (1 - np.cos(20 * np.pi * t))
        v_h = 0.1 * np.pi * np.sin(20 * np.pi * t)
        applied = 500.0 * (x_h - x) + 5.0 * (v_h - v)
        ball = 1000.0 * max(0.0, x + 1e-3)
        actuator = ball + (ball - run)
        return [v, (applied - actuator - 2.0 * v) / 0.8, rate, omega2 * (applied - run) - damping * rate]

    exact = solve_ivp(slopes, (0.0, time[-1]), np.zeros(4), "DOP853", time, rtol=1e-9, atol=1e-12).y
    np.testing.assert_allclose(found.indicated, exact[2], atol=3e-3 * np.max(np.abs(exact[2])))


def test_the_limit_of_the_bare_sensor_is_that_of_the_characteristic_polynomial():
    """(M s² + (B + b) s + k_h) (s² + c s + ω²) + K ω² (b s + k_h) = 0 away from the ball, a slow delay aside."""
    omega2, damping = 2.36e6 / (0.240 + LOAD), 6.0 / (0.240 + LOAD)
    free = np.polymul([0.8, 7.0, 500.0], [1.0, damping, omega2])

    def stable(gain: float) -> bool:
        return bool(np.all(np.roots(np.polyadd(free, gain * omega2 * np.array([5.0, 500.0]))).real < 0))

    found = largest_stable_gain(replace(LOOP, ball_stiffness=0.0, sample_rate_hz=2e6), TWO_MASSES.system(LOAD), None)
    assert stable(0.98 * found)
    assert not stable(1.02 * found)


def _fed_back(gain: float, sections: Sections | None) -> FeedbackRun:
    """The hand pushed into the ball."""
    loop = replace(LOOP, force_gain=gain)
    return simulate_feedback(loop, TWO_MASSES.system(LOAD), sections, HAND, wall_m=0.005)


def test_knowing_the_load_lets_the_loop_be_stiffer_and_the_ball_follow_the_hand():
    """At a gain of 20 the loops that do not know the load have run away, at 200 they end in gaps."""
    sensor = TWO_MASSES.system(LOAD)
    none, without, aware = (largest_stable_gain(LOOP, sensor, sections) for sections in (None, UNAWARE, AWARE))
    assert none < without < 10.0
    assert aware > 20.0 * without
    lost = _fed_back(20.0, UNAWARE)
    assert not lost.stable
    assert lost.tracking_error > 0.1
    unstable = _fed_back(200.0, None)
    assert np.isnan(unstable.applied[-1])
    assert np.isinf(unstable.tracking_error)
    stiff, soft = _fed_back(20.0, AWARE), _fed_back(1.0, AWARE)
    assert stiff.stable
    assert stiff.tracking_error < 0.01
    assert soft.tracking_error / stiff.tracking_error == pytest.approx(21.0 / 2.0, rel=0.15)


def test_a_hand_at_rest_in_the_ball_is_in_balance():
    constant = np.full(20_000, 0.02)
    found = simulate_feedback(LOOP, TWO_MASSES.system(0.0), UNAWARE, constant)
    balance = 0.02 * 500.0 * 1000.0 / 1500.0
    assert (found.applied[-1], found.indicated[-1]) == pytest.approx((balance, found.fed_back[-1]), rel=1e-6)


def test_three_masses_and_wrong_calls():
    assert is_stable(replace(LOOP, force_gain=0.1), THREE_MASSES.system(LOAD), None)
    refused("^mass: ", replace, LOOP, mass=0.0)
    refused("^force_gain: ", replace, LOOP, force_gain=-1.0)
    refused("^sensor: ", is_stable, LOOP, PUBLISHED.system, None)
