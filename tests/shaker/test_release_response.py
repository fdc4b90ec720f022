"""What poles answer to a release, in samples and blocks: against integrations of the equation and differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.signal import lsim

from shaker.arrays import ComplexArray
from shaker.release.record import Shape
from shaker.release.response import (
    Load,
    Samples,
    answers,
    every_sample,
    in_blocks,
    load_rate,
    load_share,
    pole_responses,
    responses,
)

POLES = np.array([2 * np.pi * 1700 * (-0.015 + 1j), 2 * np.pi * 2900 * (-0.03 + 1j), -2 * np.pi * 6000.0])
TIME, STEP_S = np.arange(1500) / 1e5, 1e-5
MIDDLE_S, LENGTH_S = 0.004123, 4.3e-4
FORCE = np.cumsum(np.random.default_rng(0).standard_normal(1500))
LOADS = (Load("step", 5.0), Load("ramp", 5.0), Load("smooth", 5.0), Load("measured", 5.0, FORCE, 0.0))
BLOCKS = (
    every_sample(0 * TIME, TIME, STEP_S),
    in_blocks(every_sample(0 * TIME, TIME, STEP_S), 0.0035, 0.006, 7),
    Samples(TIME[::4], np.full(375, 4), 0 * TIME[::4], STEP_S),
)


@pytest.mark.parametrize("shape", ["ramp", "smooth"])
def test_responses_solve_the_equation(shape: Shape) -> None:
    time = np.linspace(0.0, 1.5e-3, 16)
    value = pole_responses(POLES, time, 0.2e-3, 0.7e-3, shape)
    for place, pole in enumerate(POLES):
        rate = lambda t, x, p=pole: p * x + load_share(shape, np.array([t]), 0.2e-3, 0.7e-3)  # noqa: E731
        true = solve_ivp(rate, (0.0, 1.5e-3), [0j], t_eval=time, rtol=1e-9, atol=1e-13, max_step=1e-5).y[0]
        assert value[:, place] == pytest.approx(true, rel=1e-6, abs=1e-6 * np.abs(true).max())
    quotient = np.diff(load_share(shape, time[4:8], 0.2e-3, 0.7e-3)) / np.diff(time[4:8])
    middle = 0.5 * (time[4:7] + time[5:8])
    assert load_rate(shape, middle, 0.2e-3, 0.7e-3) == pytest.approx(quotient, rel=0.01)


def test_a_release_in_no_time_is_a_step() -> None:
    time = np.linspace(-1e-3, 2e-3, 301)
    step = pole_responses(POLES, time, 0.1e-3, 0.4e-3, "step")
    for shape in ("ramp", "smooth"):
        assert np.array_equal(pole_responses(POLES, time, 0.1e-3, 0.0, shape), step)
        at_once = pole_responses(POLES, time, 0.1e-3, 1e-9, shape)
        assert at_once == pytest.approx(step, abs=1e-4 * np.abs(step).max())
    late = time > 0.1e-3
    assert step[late, 2] == pytest.approx((np.exp(POLES[2] * (time[late] - 0.1e-3)) - 1) / POLES[2])


@given(st.floats(1e3, 1e8), st.floats(1e-6, 1e-1))
def test_fast_poles_follow_a_ramp(rate: float, release_s: float) -> None:
    """However far a real pole decays within the release, its response stays between 0 and its end value."""
    value = pole_responses(np.array([-rate + 0j]), np.linspace(0.0, 3.0 * release_s, 50), 0.0, release_s).real * rate
    assert np.all(np.isfinite(value))
    assert np.all(np.diff(value) >= -1e-9)
    assert value[0] == 0.0
    assert value[-1] <= 1.0 + 1e-9


def test_measured_shapes_need_the_force() -> None:
    with pytest.raises(ValueError, match='shape: expected "step", "ramp" or "smooth"'):
        pole_responses(POLES, np.zeros(3), 0.0, 1.0, "measured")


def test_answers_to_a_measured_force_are_those_of_an_integration() -> None:
    """By scipy: real and imaginary part of an answer as the states of a real system."""
    value = answers(LOADS[3], POLES, BLOCKS[0], 0.0, 0.0).value
    for place, pole in enumerate(POLES):
        a = np.array([[pole.real, -pole.imag], [pole.imag, pole.real]])
        _, output, _ = lsim((a, [[1.0], [0.0]], np.eye(2), np.zeros((2, 1))), FORCE, TIME)
        true = output[:, 0] + 1j * output[:, 1]
        np.testing.assert_allclose(value[:, place], true, atol=1e-9 * np.abs(true).max())


@pytest.mark.parametrize("blocks", BLOCKS, ids=["samples", "mixed", "fours"])
@pytest.mark.parametrize("load", LOADS, ids=lambda load: load.shape)
def test_blocks_are_means_of_samples_and_derivatives_those_of_differences(load: Load, blocks: Samples) -> None:
    def value(poles: ComplexArray = POLES, middle_s: float = MIDDLE_S, length_s: float = LENGTH_S) -> ComplexArray:
        return answers(load, poles, blocks, middle_s, length_s).value

    whole = answers(load, POLES, blocks, MIDDLE_S, LENGTH_S)
    if load.timed:
        onset_s = MIDDLE_S - 0.5 * LENGTH_S * load.lasting
        single = 5.0 * pole_responses(POLES, TIME, onset_s, LENGTH_S, load.shape)
    else:
        single = answers(load, POLES, BLOCKS[0], 0.0, 0.0).value
    starts = np.concatenate([[0], np.cumsum(blocks.length)[:-1]])
    means = np.add.reduceat(single, starts, axis=0) / blocks.length[:, None]
    np.testing.assert_allclose(whole.value, means, atol=1e-12 * np.abs(means).max())
    np.testing.assert_allclose(responses(load, POLES, blocks, MIDDLE_S, LENGTH_S), whole.value, atol=1e-14)
    for place, pole in enumerate(POLES):
        change = 1e-5 * abs(pole) * np.eye(3)[place]
        slope = (value(POLES + change) - value(POLES - change))[:, place] / (2 * change[place])
        np.testing.assert_allclose(whole.by_pole[:, place], slope, atol=2e-6 * np.abs(slope).max())
    if load.timed:
        slope = (value(middle_s=MIDDLE_S + 1e-9) - value(middle_s=MIDDLE_S - 1e-9)) / 2e-9
        np.testing.assert_allclose(whole.by_onset, slope, atol=1e-4 * np.abs(slope).max())
    if load.lasting:
        slope = (value(length_s=LENGTH_S + 1e-9) - value(length_s=LENGTH_S - 1e-9)) / 2e-9
        np.testing.assert_allclose(whole.by_length, slope, atol=1e-3 * np.abs(slope).max())
