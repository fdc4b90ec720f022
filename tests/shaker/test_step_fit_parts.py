"""Parts of the identification from a release: answers of poles, derivatives, starts, blocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from step_fit_factory import sensor

from shaker.release.output_error import Problem, Structure, columns, slopes
from shaker.release.poles import instruments, peaks_hz, pencil
from shaker.release.response import Load, every_sample, in_blocks

POLES = np.array([2 * np.pi * 1700 * (-0.015 + 1j), 2 * np.pi * 2900 * (-0.03 + 1j), -3e4])
TIME = np.arange(1500) / 1e5
FORCE = np.cumsum(np.random.default_rng(0).standard_normal(1500))
LOADS = (Load("step", 5.0), Load("ramp", 5.0), Load("smooth", 5.0), Load("measured", 5.0, FORCE, 0.0))


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
