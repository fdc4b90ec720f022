"""What poles answer to the shapes of a release: against integration of the equation of motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.signal import lsim

from shaker.release.onset import force_responses, load_share, pole_responses, shape_responses
from shaker.release.record import Shape

POLES = np.array([-160.0 + 10680.0j, -2 * np.pi * 6000.0 + 0j])


@pytest.mark.parametrize("shape", ["ramp", "smooth"])
def test_responses_solve_the_equation(shape: Shape) -> None:
    time = np.linspace(0.0, 1.5e-3, 16)
    found = shape_responses(shape, POLES, time, 0.2e-3, 0.7e-3)
    for place, pole in enumerate(POLES):
        rate = lambda t, x, p=pole: p * x + load_share(shape, np.array([t]), 0.2e-3, 0.7e-3)  # noqa: E731
        true = solve_ivp(rate, (0.0, 1.5e-3), [0j], t_eval=time, rtol=1e-9, atol=1e-13, max_step=1e-5).y[0]
        assert found[:, place] == pytest.approx(true, rel=1e-6, abs=1e-6 * np.abs(true).max())


def test_a_release_in_no_time_is_a_step() -> None:
    time = np.linspace(-1e-3, 2e-3, 301)
    step = shape_responses("step", POLES, time, 0.1e-3, 0.4e-3)
    for shape in ("ramp", "smooth"):
        assert np.array_equal(shape_responses(shape, POLES, time, 0.1e-3, 0.0), step)
        assert shape_responses(shape, POLES, time, 0.1e-3, 1e-9) == pytest.approx(step, abs=1e-4 * np.abs(step).max())
    late = time > 0.1e-3
    assert step[late, 1] == pytest.approx((np.exp(POLES[1] * (time[late] - 0.1e-3)) - 1) / POLES[1])


@given(st.floats(1e3, 1e8), st.floats(1e-6, 1e-1))
def test_fast_poles_follow_a_ramp(rate: float, release_s: float) -> None:
    """However far a real pole decays within the release, its response stays between 0 and its end value."""
    found = pole_responses(np.array([-rate + 0j]), np.linspace(0.0, 3.0 * release_s, 50), 0.0, release_s).real * rate
    assert np.all(np.isfinite(found))
    assert np.all(np.diff(found) >= -1e-9)
    assert found[0] == 0.0
    assert found[-1] <= 1.0 + 1e-9


def test_a_measured_force_is_a_line_between_samples() -> None:
    rate = 20e3
    time = np.arange(200) / rate
    force = np.random.default_rng(1).normal(size=200).cumsum()
    force[0] = 0.0
    found = force_responses(POLES, force, rate)
    omega, zeta = abs(POLES[0]), -POLES[0].real / abs(POLES[0])
    _, true, _ = lsim(([omega**2], [1.0, 2 * zeta * omega, omega**2]), force, time)
    oscillator = 2 * np.real(found[:, 0] * omega**2 / (2j * POLES[0].imag))
    assert oscillator == pytest.approx(true, abs=1e-9 * np.abs(true).max())
    _, true, _ = lsim(([-POLES[1].real], [1.0, -POLES[1].real]), force, time)
    assert -POLES[1].real * found[:, 1].real == pytest.approx(true, abs=1e-9 * np.abs(true).max())


def test_measured_shapes_need_the_force() -> None:
    with pytest.raises(ValueError, match='shape: expected "step", "ramp" or "smooth"'):
        shape_responses("measured", POLES, np.zeros(3), 0.0, 1.0)
