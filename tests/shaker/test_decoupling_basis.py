"""What poles answer to releases, against an integrator of differential equations and difference quotients."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from shaker.decoupling.steps import SampleBlocks, Shape, release_basis

POLES = np.array([-160.0 + 10000.0j, -2.0 * np.pi * 6000.0 + 0.0j, -40.0 + 900.0j])
MIDDLE_S, DURATION_S = 0.31e-3, 0.43e-3


def _load(t: float, shape: Shape) -> float:
    share = min(max((t - MIDDLE_S) / DURATION_S + 0.5, 0.0), 1.0)
    return share if shape == "ramp" else (1.0 - np.cos(np.pi * share)) / 2.0


@pytest.mark.parametrize("shape", ["ramp", "smooth"])
def test_answers_are_those_of_the_differential_equation(shape: Shape) -> None:
    time_s = np.arange(300) * 1e-5
    solved = solve_ivp(
        lambda t, y: POLES * y + _load(t, shape),
        (0.0, time_s[-1]),
        np.zeros(3, complex),
        t_eval=time_s,
        rtol=1e-9,
        atol=1e-13,
        max_step=4e-6,
    )
    found = release_basis(POLES, SampleBlocks(0.0, 1e5, 300, 1), MIDDLE_S, DURATION_S, shape).value
    size = np.abs(found).max(axis=0)
    np.testing.assert_allclose(found / size, solved.y.T / size, atol=3e-6)
    thrice = release_basis(POLES, SampleBlocks(0.0, 1e5, 100, 3), MIDDLE_S, DURATION_S, shape).value
    np.testing.assert_allclose(thrice, found.reshape(100, 3, 3).mean(axis=1), atol=1e-13 * size.max())


@pytest.mark.parametrize("shape", ["ramp", "smooth"])
@pytest.mark.parametrize("size", [1, 4])
def test_slopes_are_difference_quotients(shape: Shape, size: int) -> None:
    blocks = SampleBlocks(-0.2e-3, 1e5, 240 // size, size)

    def value(poles: np.ndarray, middle_s: float, duration_s: float) -> np.ndarray:
        return release_basis(poles, blocks, middle_s, duration_s, shape).value

    found = release_basis(POLES, blocks, MIDDLE_S, DURATION_S, shape)
    for k, pole in enumerate(POLES):
        step = np.zeros(3, complex)
        step[k] = 1e-4 * abs(pole)
        quotient = value(POLES + step, MIDDLE_S, DURATION_S) - value(POLES - step, MIDDLE_S, DURATION_S)
        quotient = quotient[:, k] / (2.0 * step[k])
        np.testing.assert_allclose(found.by_pole[:, k], quotient, atol=1e-5 * np.abs(quotient).max())
    step_s = 1e-8
    middle = (value(POLES, MIDDLE_S + step_s, DURATION_S) - value(POLES, MIDDLE_S - step_s, DURATION_S)) / (2 * step_s)
    np.testing.assert_allclose(found.by_middle, middle, atol=1e-4 * np.abs(middle).max())
    longer = (value(POLES, MIDDLE_S, DURATION_S + step_s) - value(POLES, MIDDLE_S, DURATION_S - step_s)) / (2 * step_s)
    np.testing.assert_allclose(found.by_duration, longer, atol=1e-3 * np.abs(longer).max())


def test_step_is_the_limit_of_short_releases() -> None:
    blocks = SampleBlocks(-1e-3, 1e5, 400, 1)
    at_once = release_basis(POLES, blocks, 0.003e-3, 0.0, "ramp").value
    quick = release_basis(POLES, blocks, 0.003e-3, 2e-8, "smooth").value
    np.testing.assert_allclose(at_once, quick, atol=2e-6 * np.abs(at_once).max())
