"""The simulators of `benchmarks/other_physics.py` against other solutions of the same equations."""

from pathlib import Path

import numpy as np
import other_physics
import pytest
from other_physics_files import evaluate
from other_physics_sensor import Spring, frequency_truths, lag, modes, release, respond, ring, step_truths
from other_physics_turned import with_play
from scipy.signal import lsim

PLANT = modes([(1700.0, 0.015, 1.0)]).into(lag(6e3))
TIMES_S = np.arange(2000) / 50e3 - 0.004


def test_a_release_agrees_with_an_integration_by_fine_steps() -> None:
    """Ramps are exact for `lsim` too, whose steps lie at the breaks."""
    found, gone = respond(PLANT, np.array([1.0]), release("ramp", 0.3e-3), TIMES_S)
    fine_s = np.arange(0.0, 0.036, 1e-6)
    expected = lsim((PLANT.a, PLANT.b, PLANT.c, [[0.0]]), np.clip(fine_s / 0.3e-3, 0.0, 1.0), fine_s)[1]
    after = TIMES_S >= 0.0
    np.testing.assert_allclose(found[0][after], np.interp(TIMES_S[after], fine_s, expected), atol=1e-10)
    assert not np.any(gone[~after])


@pytest.mark.parametrize("shape", ["ramp", "cosine", "exponential", "two stages"])
def test_every_release_ends_with_the_whole_load(shape: str) -> None:
    """The output comes to the static gain."""
    times_s = np.arange(6000) / 50e3 - 0.004
    found, gone = respond(PLANT, np.array([-2.0]), release(shape, 1e-4), times_s)
    assert gone[-1] == pytest.approx(1.0)
    assert found[0, -1] == pytest.approx(-2.0, rel=1e-6)


def test_springs_without_friction_or_softening_are_linear() -> None:
    """Both nonlinear solutions come to the linear one."""
    linear = 1.0 - respond(PLANT, np.array([1.0]), release("ramp", 0.3e-3), TIMES_S)[0][0]
    np.testing.assert_allclose(ring(Spring(1700.0, 0.015), 0.3e-3, 6e3, TIMES_S), linear, atol=1e-7)
    np.testing.assert_allclose(ring(Spring(1700.0, 0.015, friction=1e-9), 0.3e-3, 6e3, TIMES_S), linear, atol=1e-4)


def test_friction_takes_a_fixed_amount_off_every_half_period() -> None:
    """Without a damper the amplitude falls by twice the friction's share from turn to turn."""
    times_s = np.arange(8000) / 1e6
    course = ring(Spring(1000.0, 0.0, friction=0.02), 1e-6, 1e6, times_s)
    turns = np.abs(course[[500, 1000, 1500, 2000]])
    np.testing.assert_allclose(turns, 1.0 - 0.04 * np.arange(1, 5), atol=2e-3)


def test_truths_of_one_mode_are_the_closed_forms() -> None:
    """Band and overshoot of a light oscillator, with an amplifier that is far away."""
    plant, z = modes([(1000.0, 0.01, 1.0)]).into(lag(1e7)), 0.01
    found = frequency_truths(plant) | step_truths(plant)
    r2 = (1 - 2 * z**2) - np.sqrt((1 - 2 * z**2) ** 2 - (1 - 1 / 1.05**2))
    assert found["band_5_hz"] == pytest.approx(1000.0 * np.sqrt(r2), rel=1e-4)
    assert found["overshoot"] == pytest.approx(np.exp(-np.pi * z / np.sqrt(1 - z**2)), rel=1e-3)
    assert found["natural_hz"] == pytest.approx(1000.0, rel=1e-9)


def test_a_loop_of_play_elements_has_the_stated_width() -> None:
    """At the middle of the loop the ways up and down differ by that share of the largest value."""
    phase = np.linspace(0.0, 4.0 * np.pi, 4001)
    loop = with_play(np.cos(phase), 0.01)[2000:]
    up, down = (loop[np.argmin(np.abs(phase[2000:] - 2.0 * np.pi - at))] for at in (1.5 * np.pi, 0.5 * np.pi))
    assert abs(down - up) == pytest.approx(0.01, rel=0.05)


def test_a_case_is_written_evaluated_and_read(tmp_path: Path) -> None:
    """The natural frequency of ramps is within three times its U."""
    outcome = evaluate(other_physics.CASES["one_release"], tmp_path, np.random.default_rng(3))
    value, u = outcome.readings["natural_hz"]
    assert outcome.status == 0
    assert abs(value - outcome.truth["natural_hz"]) < 3.0 * u
