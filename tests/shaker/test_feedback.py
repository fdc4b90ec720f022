"""The force-feedback loop against its continuous equations, and what knowing the load is worth in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from shaker.compensation.filter import Schedule, Target
from shaker.compensation.force_feedback import HapticLoop, is_stable, largest_stable_gain, push, simulate_feedback
from shaker.release.load_model import LoadModel

SENSOR = LoadModel("Fy", "Fy", "V", 0.240, 2.36e6, 6.0)
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
SCHEDULE = Schedule(SENSOR, Target(1000.0, 0.55))
TIME = np.arange(12_000) / LOOP.sample_rate_hz
HAND = push(TIME, 0.03, 1.0)


def test_fast_sampling_follows_the_continuous_equations() -> None:
    """Handle, sensor and control integrated by scipy, the ball always touched."""
    loop = replace(LOOP, force_gain=1.0, sample_rate_hz=200e3)
    time = np.arange(20_000) / loop.sample_rate_hz
    hand = push(time, 0.01, 0.1)
    found = simulate_feedback(loop, SENSOR.system(LOAD), None, hand, wall_m=-1e-3)
    omega2, damping = 2.36e6 / (0.240 + LOAD), 6.0 / (0.240 + LOAD)

    def slopes(t: float, z: np.ndarray) -> list[float]:
        x, v, told, rate = z
        x_h = 0.005 * (1 - np.cos(20 * np.pi * t))
        v_h = 0.1 * np.pi * np.sin(20 * np.pi * t)
        applied = 500.0 * (x_h - x) + 5.0 * (v_h - v)
        ball = 1000.0 * max(0.0, x + 1e-3)
        actuator = ball + (ball - told)
        return [v, (applied - actuator - 2.0 * v) / 0.8, rate, omega2 * (applied - told) - damping * rate]

    exact = solve_ivp(slopes, (0.0, time[-1]), np.zeros(4), "DOP853", time, rtol=1e-9, atol=1e-12).y
    np.testing.assert_allclose(found.told, exact[2], atol=3e-3 * np.max(np.abs(exact[2])))


def test_the_limit_of_the_bare_sensor_is_that_of_the_characteristic_polynomial() -> None:
    """(M s² + (B + b) s + k_h) (s² + c s + ω²) + K ω² (b s + k_h) = 0 away from the ball, a slow delay aside."""
    omega2, damping = 2.36e6 / (0.240 + LOAD), 6.0 / (0.240 + LOAD)
    free = np.polymul([0.8, 7.0, 500.0], [1.0, damping, omega2])

    def stable(gain: float) -> bool:
        return bool(np.all(np.roots(np.polyadd(free, gain * omega2 * np.array([5.0, 500.0]))).real < 0))

    found = largest_stable_gain(replace(LOOP, ball_stiffness=0.0, sample_rate_hz=2e6), SENSOR.system(LOAD), None)
    assert stable(0.98 * found)
    assert not stable(1.02 * found)


def test_knowing_the_load_lets_the_loop_be_stiffer() -> None:
    sensor, rate = SENSOR.system(LOAD), LOOP.sample_rate_hz
    none, without, aware = (
        largest_stable_gain(LOOP, sensor, sections)
        for sections in (None, SCHEDULE.sections(0.0, rate), SCHEDULE.sections(LOAD, rate))
    )
    assert none < without < 10.0
    assert aware > 20.0 * without


def test_the_force_fed_back_follows_the_applied_force_when_the_load_is_known() -> None:
    """At a gain of 20 the loops that do not know the load have run away."""
    sensor, rate = SENSOR.system(LOAD), LOOP.sample_rate_hz
    loop = replace(LOOP, force_gain=20.0)
    for sections in (None, SCHEDULE.sections(0.0, rate)):
        lost = simulate_feedback(loop, sensor, sections, HAND, wall_m=0.005)
        assert not lost.stable
        assert lost.tracking_error > 0.1
    aware = simulate_feedback(loop, sensor, SCHEDULE.sections(LOAD, rate), HAND, wall_m=0.005)
    assert aware.stable
    assert aware.tracking_error < 0.01
    softer = simulate_feedback(replace(LOOP, force_gain=1.0), sensor, SCHEDULE.sections(LOAD, rate), HAND, wall_m=0.005)
    assert softer.tracking_error / aware.tracking_error == pytest.approx(21.0 / 2.0, rel=0.15)


def test_a_hand_at_rest_in_the_ball_is_in_balance() -> None:
    still = np.full(30_000, 0.02)
    found = simulate_feedback(LOOP, SENSOR.system(0.0), SCHEDULE.sections(0.0, 10e3), still)
    balance = 0.02 * 500.0 * 1000.0 / 1500.0
    assert found.applied[-1] == pytest.approx(balance, rel=1e-6)
    assert found.told[-1] == pytest.approx(found.fed_back[-1], rel=1e-6)


def test_noise_of_the_sensor_reaches_the_hand() -> None:
    quiet, loud = (
        simulate_feedback(LOOP, SENSOR.system(0.0), SCHEDULE.sections(0.0, 10e3), HAND, noise=noise)
        for noise in (None, np.random.default_rng(3).normal(scale=0.01, size=len(HAND)))
    )
    assert 0.0 < np.std(loud.applied - quiet.applied) < 0.01


def test_a_run_that_runs_away_ends_in_gaps() -> None:
    loop = replace(LOOP, force_gain=200.0)
    found = simulate_feedback(loop, SENSOR.system(LOAD), None, HAND, wall_m=0.005)
    assert np.isnan(found.applied[-1])
    assert np.isinf(found.tracking_error)


def test_three_masses_and_wrong_calls() -> None:
    chained = replace(SENSOR, coupling_stiffness=1.89e6, coupling_damping=4.0)
    assert is_stable(replace(LOOP, force_gain=0.1), chained.system(LOAD), None)
    with pytest.raises(ValueError, match="mass: expected a positive number"):
        replace(LOOP, mass=0.0)
    with pytest.raises(ValueError, match="force_gain: expected 0 or more"):
        replace(LOOP, force_gain=-1.0)
    with pytest.raises(ValueError, match="sensor: expected more poles"):
        is_stable(LOOP, SCHEDULE.at(0.0).system, None)
