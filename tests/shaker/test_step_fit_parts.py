"""Parts of the identification from a release: answers of poles, derivatives, starts, blocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lsim
from step_fit_factory import sensor

from shaker.arrays import FloatArray
from shaker.release.onset import pole_responses
from shaker.release.output_error import Problem, columns, slopes
from shaker.release.problem import Load, Structure, answers, every_sample, in_blocks, instruments, peaks_hz, pencil

POLES = np.array([2 * np.pi * 1700 * (-0.015 + 1j), 2 * np.pi * 2900 * (-0.03 + 1j), -3e4])
TIME = np.arange(1500) / 1e5
FORCE = np.cumsum(np.random.default_rng(0).standard_normal(1500))
LOADS = (Load("step", 5.0), Load("ramp", 5.0), Load("smooth", 5.0), Load("measured", 5.0, FORCE, 0.0))


def response_of(pole: complex, load: FloatArray, step_s: float) -> np.ndarray:
    """Return the answer of 1/(s - p) by scipy: real and imaginary part as states of a real system."""
    a = np.array([[pole.real, -pole.imag], [pole.imag, pole.real]])
    _, output, _ = lsim((a, [[1.0], [0.0]], np.eye(2), np.zeros((2, 1))), load, np.arange(len(load)) * step_s)
    return output[:, 0] + 1j * output[:, 1]


@pytest.mark.parametrize("length", [3e-5, 4.3e-4])
def test_answers_to_a_ramp_are_those_of_the_formula(length: float) -> None:
    found = answers(Load("ramp", 2.0), POLES, every_sample(0 * TIME, TIME, 1e-5), 0.004, length)
    np.testing.assert_allclose(found.value, 2.0 * pole_responses(POLES, TIME, 0.004 - length / 2, length), atol=1e-15)


def test_answers_to_half_a_cosine_are_those_of_an_integration() -> None:
    fine = np.arange(60001) / 1e7
    share = np.clip((fine - 0.002) / 8e-4, 0, 1)
    load = 0.5 * (1 - np.cos(np.pi * share))
    times = every_sample(0 * fine[::100], fine[::100], 1e-5)
    found = answers(Load("smooth", 1.0), POLES[[0, 2]], times, 0.0024, 8e-4).value
    for place, pole in enumerate(POLES[[0, 2]]):
        np.testing.assert_allclose(found[:, place], response_of(pole, load, 1e-7)[::100], atol=1e-10)


def test_answers_to_a_measured_force_are_those_of_an_integration() -> None:
    found = answers(LOADS[3], POLES, every_sample(0 * TIME, TIME, 1e-5), 0.0, 0.0).value
    for place, pole in enumerate(POLES):
        from_rest = response_of(pole, FORCE, 1e-5)
        np.testing.assert_allclose(found[:, place], from_rest, atol=1e-9 * np.abs(from_rest).max())


@pytest.mark.parametrize("load", LOADS, ids=lambda load: load.shape)
def test_blocks_are_means_of_samples(load: Load) -> None:
    whole = every_sample(0 * TIME, TIME, 1e-5)
    blocks = in_blocks(whole, 0.0035, 0.006, 7)
    single = answers(load, POLES, whole, 0.004, 4e-4).value
    starts = np.concatenate([[0], np.cumsum(blocks.length)[:-1]])
    means = np.add.reduceat(single, starts, axis=0) / blocks.length[:, None]
    assert blocks.length.sum() == len(TIME)
    assert blocks.length.max() > 7
    found = answers(load, POLES, blocks, 0.004, 4e-4).value
    np.testing.assert_allclose(found, means, atol=1e-12 * np.abs(means).max())


@pytest.mark.parametrize("load", LOADS, ids=lambda load: load.shape)
def test_derivatives_are_those_of_differences(load: Load) -> None:
    structure = Structure(2, 1, 4, 2e4)
    samples = in_blocks(every_sample(0 * TIME, TIME, 1e-5), 0.0035, 0.006, 7)
    tail = [0.004123] * load.timed + [np.log(4.3e-4)] * load.lasting
    vector = np.concatenate([structure.vector(POLES), tail])
    problem = Problem(structure, load, samples, vector, vector)
    linear = np.array([0.1, 1.0, 0.3, -0.2, 0.05])
    found = slopes(problem, vector, linear, columns(problem, vector, samples)[1])
    for place in range(len(vector)):
        change = np.zeros(len(vector))
        change[place] = 1e-10 if place == 5 else 1e-6
        high, low = (columns(problem, vector + sign * change, samples)[0] @ linear for sign in (1, -1))
        slope = (high - low) / (2 * change[place])
        np.testing.assert_allclose(found[:, place], slope, atol=2e-6 * np.abs(slope).max())


@given(
    modes=st.lists(st.tuples(st.floats(100, 5000), st.floats(1e-3, 0.5)), min_size=1, max_size=3, unique=True),
    low_pass=st.lists(st.floats(6000, 20000), max_size=1),
)
@settings(max_examples=40, deadline=None)
def test_numerator_terms_are_partial_fractions(modes: list[tuple[float, float]], low_pass: list[float]) -> None:
    """The first term alone is the all-pole system, whatever its poles, unless two nearly coincide."""
    system = sensor(tuple(modes), tuple(low_pass))
    gaps = np.abs(system.poles[:, None] - system.poles) + np.diag(np.full(len(system.poles), np.inf))
    if gaps.min() < 1e-2 * np.abs(system.poles).max():
        return
    structure = Structure(len(modes), len(low_pass), 1, 1e4)
    upper = system.poles[system.poles.imag > 0]
    poles = np.concatenate([upper, system.poles[system.poles.imag == 0]])
    shares, _ = structure.shares(structure.vector(poles))
    s = 2j * np.pi * np.array([0.0, 700.0, 3000.0])[:, None]
    both = np.sum(shares[:, 0] / (s - poles), axis=1) + np.sum(
        shares[: len(upper), 0].conj() / (s - upper.conj()), axis=1
    )
    np.testing.assert_allclose(both / both[0], system.at(s[:, 0]), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("find", [pencil, instruments])
def test_starts_find_the_poles_of_a_clean_decay(find: type) -> None:
    step = 5e-5
    k = np.arange(240) * step
    decay = 0.3 + np.real(np.exp(POLES[0] * k)) + 0.4 * np.imag(np.exp(POLES[1] * k))
    found = find(decay, step, 5)
    for pole in POLES[:2]:
        assert np.min(np.abs(found - pole)) < 1e-4 * abs(pole)


def test_instruments_do_not_mind_noise_as_least_squares_do() -> None:
    """Mean over draws: without bias beyond its scatter where the least-squares autoregression more than doubles ζ."""
    step, pole = 6e-5, POLES[0]
    found = []
    for seed in range(60):
        k = np.arange(240) * step
        decay = np.real(np.exp(pole * k)) + 0.05 * np.random.default_rng(seed).standard_normal(240)
        poles = instruments(decay, step, 3)
        found.append(poles[np.argmin(np.abs(poles - pole))])
    assert abs(np.mean(found).imag / pole.imag - 1.0) < 2e-3
    assert abs(np.mean(found).real / pole.real - 1.0) < 0.25


def test_peaks_are_those_of_the_ring_and_noise_has_none() -> None:
    k = np.arange(3000) / 1e5
    noise = 0.02 * np.random.default_rng(1).standard_normal(3000)
    ring = np.real(np.exp(POLES[0] * k)) + 0.2 * np.real(np.exp(POLES[1] * k)) + noise
    np.testing.assert_allclose(peaks_hz(ring, 1e-5, 2), [1700, 2900], rtol=0.02)
    assert peaks_hz(noise, 1e-5, 3).size == 0
