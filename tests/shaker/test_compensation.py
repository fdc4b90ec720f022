"""Compensation filters against published figures, scipy, and what the algebra of poles says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from shaker.compensation.effects import (
    KEPT_SHARE,
    residual_ringing,
    target_for_bandwidth,
    target_for_frequency,
    white_noise_gain,
)
from shaker.compensation.filter import (
    Compensation,
    Schedule,
    SensorDynamics,
    Target,
    band_ratio,
    best_damping,
    discretisation_error,
    loaded_dynamics,
    modal_dynamics,
    sampled,
    single_mode,
)
from shaker.lti.indices import indices
from shaker.lti.system import ModalModel
from shaker.release.load_model import LoadModel

PUBLISHED = Compensation(single_mode(500.0, 0.004), Target(1000.0, 0.5))
TWO_MASSES = LoadModel("Fy", "Fy", "V", 0.240, 2.36e6, 6.0)
THREE_MASSES = LoadModel("Fy", "Fy", "V", 0.240, 2.36e6, 6.0, 1.89e6, 4.0)


def _chain(fn: float, zeta: float, real_hz: float, covariance: np.ndarray | None = None) -> ModalModel:
    """ω²a/[(s² + 2ζωs + ω²)(s + a)] as residues."""
    omega, a = 2 * np.pi * fn, 2 * np.pi * real_hz
    poles = np.roots(np.polymul([1, 2 * zeta * omega, omega**2], [1, a]))
    upper = poles[poles.imag > 0][0]
    top = omega**2 * a
    residue = top / ((upper - upper.conj()) * (upper + a))
    real = (top / np.abs(-a - upper) ** 2).real
    return ModalModel(
        np.array([fn]), np.array([zeta]), np.array([residue]), np.array([real_hz]), np.array([real]), covariance
    )


def test_the_published_case() -> None:
    """2.36e6/(0.240 s² + 6 s + 2.36e6), which is 500 Hz and ζ = 0.004 in round numbers."""
    filtered = Compensation(loaded_dynamics(TWO_MASSES, 0.0), PUBLISHED.target)
    before, after = indices(filtered.sensor.system), indices(filtered.compensated)
    assert before.overshoot == pytest.approx(0.988, abs=5e-4)
    assert after.overshoot == pytest.approx(0.163, abs=5e-4)
    assert before.settling_2_s == pytest.approx(312.6e-3, abs=5e-4)
    assert after.settling_2_s == pytest.approx(1.29e-3, abs=5e-6)
    assert before.band_10_hz == pytest.approx(150.5, abs=0.06)
    assert after.band_10_hz == pytest.approx(472.8, abs=0.05)


def test_the_published_factor_is_the_ratio_of_the_denominators_at_rest() -> None:
    stated = Compensation(loaded_dynamics(TWO_MASSES, 0.0), Target(6280 / (2 * np.pi), 0.5))
    mass = TWO_MASSES.moving_mass
    assert stated.system.gain / mass == pytest.approx(6280**2 / 2.36e6, rel=1e-12)
    assert stated.system.gain / mass == pytest.approx(16.7, abs=0.02)


def test_the_filter_is_proper_and_has_the_static_gain_one() -> None:
    assert len(PUBLISHED.system.zeros) == len(PUBLISHED.system.poles) == 2
    assert PUBLISHED.system.static_gain == pytest.approx(1.0, rel=1e-14)


def test_calibrated_filter_turns_the_output_into_the_load() -> None:
    sensor = single_mode(500.0, 0.004, static_gain=2.5e-3)
    filtered = Compensation(sensor, Target(1000.0, 0.5), calibrated=True)
    assert filtered.compensated.static_gain == pytest.approx(1.0, rel=1e-13)


@pytest.mark.parametrize(("damping", "band_10_hz"), [(0.5, 472.5), (0.6, 915.7)])
def test_bands_of_the_published_frequency(damping: float, band_10_hz: float) -> None:
    """At ω = 6280 rad/s the damping 0.6 keeps ±10 % to twice the frequency that 0.5 does."""
    fn = 6280 / (2 * np.pi)
    assert fn * band_ratio(damping, 0.1) == pytest.approx(band_10_hz, abs=0.1)
    b, a = [1.0], [1.0, 2 * damping, 1.0]
    edge = np.abs(signal.freqs(b, a, [0.999 * band_ratio(damping, 0.1), 1.001 * band_ratio(damping, 0.1)])[1])
    assert abs(edge[0] - 1) < 0.1 < abs(edge[1] - 1)


@pytest.mark.parametrize("error", [0.01, 0.05, 0.1, 0.3])
def test_best_damping_is_where_a_search_finds_the_widest_band(error: float) -> None:
    grid = np.linspace(0.3, 0.9, 6001)
    found = grid[np.argmax([band_ratio(damping, error) for damping in grid])]
    assert best_damping(error) == pytest.approx(found, abs=1.1e-4)


def test_bandwidth_target_is_that_of_the_closed_form_for_one_mode() -> None:
    found = target_for_bandwidth(single_mode(500.0, 0.004), 900.0, 0.1)
    kept = (1 - KEPT_SHARE) * 0.1
    assert found.damping_ratio == pytest.approx(best_damping(kept), abs=2e-5)
    assert found.frequency_hz == pytest.approx(900.0 / band_ratio(best_damping(kept) + 1e-9, kept), rel=1e-4)


def test_bandwidth_target_counts_the_poles_that_stay() -> None:
    sensor = modal_dynamics(_chain(1700.0, 0.015, 6000.0))
    found = target_for_bandwidth(sensor, 2000.0, 0.1)
    reached = indices(Compensation(sensor, found).compensated).band_10_hz
    assert reached is not None
    assert reached > 2000.0
    with pytest.raises(ValueError, match="compensate more modes or the real poles"):
        target_for_bandwidth(sensor, 8000.0, 0.01)


def test_damping_is_chosen_for_the_whole_sensor() -> None:
    """One mode: the closed form. Two: the mode above raises the gain, and more damping is needed to keep 10 %."""
    one = target_for_frequency(single_mode(500.0, 0.004), 1000.0, 0.1)
    assert one.damping_ratio == best_damping((1 - KEPT_SHARE) * 0.1)
    sensor = loaded_dynamics(THREE_MASSES, 0.098, modes=2)
    two = target_for_frequency(sensor, 1000.0, 0.1)
    bands = [
        indices(Compensation(sensor, Target(1000.0, damping)).compensated).band_10_hz or 0.0
        for damping in (two.damping_ratio - 0.03, two.damping_ratio, two.damping_ratio + 0.03)
    ]
    assert two.damping_ratio > one.damping_ratio
    assert bands[1] > 1.2 * bands[0]
    assert bands[1] > bands[2]


def test_a_low_pass_takes_the_noise_away_and_nothing_else() -> None:
    """The filter is that without it times a Butterworth low-pass of scipy, and the search for a damping knows it."""
    sensor = loaded_dynamics(THREE_MASSES, 0.198, modes=2)
    plain, quiet = (Compensation(sensor, Target(1000.0, 0.55, None, corner)) for corner in (None, 4000.0))
    band = np.array([1.0, 200.0, 900.0, 3000.0])
    b, a = signal.butter(2, 2 * np.pi * 4000.0, analog=True)
    expected = plain.system.response(band) * signal.freqs(b, a, 2 * np.pi * band)[1]
    np.testing.assert_allclose(quiet.system.response(band), expected, rtol=1e-9)
    found = sampled(quiet, 200e3)
    assert len(found.sos) == 3
    assert np.max(np.abs(discretisation_error(quiet, found, band))) < 0.01
    assert white_noise_gain(found) < 0.4 * white_noise_gain(sampled(plain, 200e3))
    wide = target_for_frequency(single_mode(500.0, 0.004), 1000.0, 0.1, None, 1500.0)
    reached = indices(Compensation(single_mode(500.0, 0.004), wide).compensated).band_10_hz or 0.0
    same = Target(1000.0, best_damping(0.09), None, 1500.0)
    assert reached > (indices(Compensation(single_mode(500.0, 0.004), same).compensated).band_10_hz or 0.0)
    assert wide.damping_ratio < same.damping_ratio


def test_real_poles_move_with_the_mode() -> None:
    sensor = modal_dynamics(_chain(1700.0, 0.015, 6000.0), real_poles=True)
    found = Compensation(sensor, Target(3000.0, 0.6, 30e3)).compensated
    np.testing.assert_allclose(found.poles[-1], -2 * np.pi * 30e3, rtol=1e-9)
    assert len(found.poles) == 3
    with pytest.raises(ValueError, match="real_hz"):
        Compensation(sensor, Target(3000.0, 0.6))


@pytest.mark.parametrize("load", [0.008, 0.098])
def test_further_modes_are_damped_and_kept_well_above_the_target(load: float) -> None:
    """With 8 g the second mode is at 2490 Hz and stays there, with 98 g it is at 884 Hz and goes to 2000 Hz."""
    sensor = loaded_dynamics(THREE_MASSES, load, modes=2)
    found = indices(Compensation(sensor, Target(1000.0, 0.5)).compensated)
    assert [mode.damping_ratio for mode in found.modes] == pytest.approx([0.5, 0.5], rel=1e-9)
    assert [mode.natural_hz for mode in found.modes] == pytest.approx([1000.0, max(2000.0, sensor.frequency_hz[1])])


@pytest.mark.parametrize(("load", "share"), [(0.008, 0.035), (0.048, 0.18), (0.098, 0.31), (0.198, 0.47)])
def test_ringing_of_a_filter_for_no_load(load: float, share: float) -> None:
    """The published sensor with the filter for no load: what is left from 2 ms on, by the step response of scipy."""
    filtered = Schedule(TWO_MASSES, Target(6280 / (2 * np.pi), 0.5)).at(0.0)
    found = residual_ringing(filtered, TWO_MASSES.system(load), 2e-3)
    assert found == pytest.approx(share, abs=5e-3)
    top = np.polymul([2.36e6], [0.24, 6.0, 2.36e6])
    below = np.polymul([0.24 + load, 6.0, 2.36e6], [1.0, 6280.0, 6280.0**2])
    time = np.linspace(0.0, 0.02, 40_001)
    response = signal.step((top, below), T=time)[1] / (top[-1] / below[-1])
    assert found == pytest.approx(np.max(np.abs(response[time >= 2e-3] - 1)), rel=2e-4)


def test_a_filter_for_the_load_leaves_only_the_decay_of_the_target() -> None:
    filtered = Schedule(TWO_MASSES, Target(1000.0, 0.5)).at(0.198)
    left = residual_ringing(filtered, TWO_MASSES.system(0.198), 2e-3)
    assert left < 1.16 * np.exp(-0.5 * 2 * np.pi * 1000.0 * 2e-3)


def test_matched_sections_cancel_the_sampled_sensor_at_every_rate() -> None:
    for rate in (5e3, 1e4, 1e5):
        sensor = PUBLISHED.sensor.system.sampled(rate)
        zeros = np.roots(sampled(PUBLISHED, rate).sos[0, :3])
        np.testing.assert_allclose(np.sort_complex(zeros), np.sort_complex(sensor.poles), rtol=1e-10)


def test_tustin_keeps_the_frequency_of_the_mode_and_is_scipys() -> None:
    rate = 20e3
    found = sampled(PUBLISHED, rate, "tustin")
    assert abs(discretisation_error(PUBLISHED, found, np.array([500.0]))[0]) < 1e-11
    omega = 2 * np.pi * 500.0
    top, below = PUBLISHED.system.coefficients()
    b, a = signal.bilinear(top, below, 0.5 * omega / np.tan(0.5 * omega / rate))
    np.testing.assert_allclose(found.sos[0], np.concatenate([b, a]), rtol=1e-9)


@pytest.mark.parametrize("method", ["matched", "tustin"])
def test_discretisation_error_falls_with_the_rate_and_is_that_of_scipy(method: str) -> None:
    band = np.linspace(1.0, 1000.0, 64)
    errors = []
    for rate in (10e3, 20e3, 40e3):
        found = sampled(PUBLISHED, rate, method)  # type: ignore[arg-type]
        other = signal.sosfreqz(found.sos, worN=band, fs=rate)[1]
        np.testing.assert_allclose(found.response(band), other, rtol=1e-9)
        errors.append(np.max(np.abs(discretisation_error(PUBLISHED, found, band))))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.1)


def test_sampled_step_has_the_published_overshoot() -> None:
    rate = 100e3
    time = np.arange(4000) / rate
    response = signal.sosfilt(sampled(PUBLISHED, rate).sos, PUBLISHED.sensor.system.step(time))
    assert np.max(response) - 1 == pytest.approx(0.163, abs=1e-3)
    outside = np.flatnonzero(np.abs(response - 1) > 0.02)[-1]
    assert time[outside] == pytest.approx(1.29e-3, abs=2e-5)


def test_modal_covariance_reaches_frequency_damping_and_gain() -> None:
    spread = np.diag([0.3, 2e-5, 0.5, 0.5, 10.0, 5.0]) ** 2
    sensor = modal_dynamics(_chain(1700.0, 0.015, 6000.0, spread), real_poles=True)
    assert sensor.covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(sensor.covariance))[:3], [0.3, 2e-5, 10.0], rtol=1e-6)
    assert sensor.covariance[0, 3] != 0.0


def test_load_covariance_follows_the_formula_of_a_rigid_load() -> None:
    uncertain = LoadModel("Fy", "Fy", "V", 0.24, 2.36e6, 6.0, u_moving_mass=1e-3, covariance=np.diag([1e3, 0.1]) ** 2)
    found = loaded_dynamics(uncertain, 0.1, u_load_mass=2e-3)
    relative = 0.5 * np.sqrt((1e3 / 2.36e6) ** 2 + (1e-3 / 0.34) ** 2 + (2e-3 / 0.34) ** 2)
    assert found.u[0] / found.frequency_hz[0] == pytest.approx(relative, rel=1e-4)


def test_wrong_calls_name_the_argument() -> None:
    with pytest.raises(ValueError, match="damping_ratio: expected 0 or more"):
        single_mode(500.0, -0.01)
    with pytest.raises(ValueError, match="frequency_hz: expected a positive number"):
        Target(0.0, 0.5)
    with pytest.raises(ValueError, match="sample_rate_hz: expected at least"):
        sampled(PUBLISHED, 2000.0)
    with pytest.raises(ValueError, match="method"):
        sampled(PUBLISHED, 2e4, "zoh")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="permitted_error"):
        best_damping(1.5)
    with pytest.raises(ValueError, match="modes: expected 0 to 1"):
        modal_dynamics(_chain(1700.0, 0.015, 6000.0), modes=2)
    with pytest.raises(ValueError, match="a mode or a real pole"):
        SensorDynamics(np.zeros(0), np.zeros(0), np.zeros(0), 1.0, PUBLISHED.system)
