"""Further time courses of a load, attribution of lags, dependence on the amplitude."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad, solve_ivp

from shaker.model_notices import AMPLITUDE_DEPENDENT, LAG_NOT_ATTRIBUTED
from shaker.release.amplitude_dependence import amplitude_dependence
from shaker.release.load_response import ReleaseLoad, Stages, every_sample, reduce_to_blocks, responses
from shaker.release.output_error import OutputErrorProblem, PoleStructure, columns, slopes
from shaker.release.record import StepRecord
from shaker.release.step_fit import StepFit, fit_step

FloatArray = NDArray[np.float64]
RATE_HZ, ONSET_S, MODE_HZ, ZETA, CHAIN_HZ = 50e3, 0.0100037, 1700.0, 0.015, 6000.0
POLES = np.array([2 * np.pi * MODE_HZ * (-0.015 + 1j), 2 * np.pi * 2900 * (-0.03 + 1j), -2 * np.pi * CHAIN_HZ])
TIME = np.arange(1500) / 1e5
CHAIN_S = 1.0 / (2 * np.pi * CHAIN_HZ)


@pytest.mark.parametrize("lag_s", [5e-5, CHAIN_S * (1.0 + 1e-4)])
def test_responses_to_an_exponential_load_are_integrals(lag_s: float) -> None:
    """The second lag is almost that of the real pole."""
    middle_s = 0.004123
    value = responses(ReleaseLoad("exponential", 5.0), POLES, every_sample(0 * TIME, TIME, 1e-5), middle_s, 2 * lag_s)
    for index in (420, 600):
        tau = TIME[index] - (middle_s - lag_s)
        for column, pole in enumerate(POLES):

            def part(s: float, turn: complex, pole: complex = pole, tau: float = tau) -> float:
                return float(np.real(turn * 5.0 * np.exp(pole * (tau - s)) * (1.0 - np.exp(-s / lag_s))))

            true = sum(turn.conjugate() * quad(part, 0, tau, (turn,), limit=400)[0] for turn in (1 + 0j, 1j))
            assert value[index, column] == pytest.approx(true, rel=1e-7)


def test_a_load_in_two_stages_is_two_ramps() -> None:
    samples = every_sample(0 * TIME, TIME, 1e-5)
    whole = responses(ReleaseLoad("stages", 5.0), POLES, samples, 0.004, 3e-4, Stages(0.7, 1e-4))
    ramps = [responses(ReleaseLoad("ramp", 5.0), POLES, samples, middle_s, 1e-4) for middle_s in (0.0039, 0.0041)]
    np.testing.assert_allclose(whole, 0.7 * ramps[0] + 0.3 * ramps[1], atol=1e-15)


@pytest.mark.parametrize(("shape", "tail"), [("exponential", [2e-4]), ("stages", [2.4e-4, 0.6, 5e-5])])
def test_derivatives_of_further_shapes_are_those_of_differences(shape: str, tail: list[float]) -> None:
    structure, samples = (
        PoleStructure(2, 1, 4, 2e4),
        reduce_to_blocks(every_sample(0 * TIME, TIME, 1e-5), 0.0035, 0.006, 7),
    )
    lengths = [np.log(one) if index != 1 else one for index, one in enumerate(tail)]
    vector = np.concatenate([structure.vector(POLES), [0.004123], lengths])
    problem = OutputErrorProblem(structure, ReleaseLoad(shape, 5.0), samples, vector, vector)  # type: ignore[arg-type]
    linear = np.array([0.1, 1.0, 0.3, -0.2, 0.05])
    found = slopes(problem, vector, linear, columns(problem, vector, samples)[1])
    for index in range(len(vector)):
        change = np.zeros(len(vector))
        change[index] = 1e-9 if index == 5 else 1e-6
        high, low = (columns(problem, vector + sign * change, samples)[0] @ linear for sign in (1, -1))
        slope = (high - low) / (2 * change[index])
        np.testing.assert_allclose(found[:, index], slope, atol=1e-6 * np.abs(slope).max())


def output_of(lags_s: tuple[float, ...]) -> FloatArray:
    """Return the step response of the mode behind lags, from partial fractions."""
    omega = 2 * np.pi * MODE_HZ
    upper = omega * complex(-ZETA, np.sqrt(1 - ZETA**2))
    poles = np.array([upper, upper.conjugate(), *(-1.0 / lag for lag in lags_s)])
    gain = omega**2 / np.prod(lags_s)
    weights = [gain / np.prod(pole - np.delete(poles, index)) / pole for index, pole in enumerate(poles)]
    tau = np.arange(2000) / RATE_HZ - ONSET_S
    ring = np.real(np.exp(np.maximum(tau, 0.0)[:, None] * poles) @ np.array(weights))
    return np.where(tau > 0.0, 1.0 + ring, 0.0)


def record_of(output: FloatArray, noise: float, lag_s: float | None = None, seed: int = 3) -> StepRecord:
    samples = output + noise * np.random.default_rng(seed).standard_normal(len(output))
    return StepRecord(
        "simulated", ("Fz",), "mV", samples[None], RATE_HZ, "Fz", 1.0, lag_s=lag_s, u_lag_s=0.01 * CHAIN_S
    )


def lag(fit: StepFit) -> tuple[float, float]:
    """Return the lag of the chain in s with U."""
    assert fit.model is not None
    assert fit.model.covariance is not None
    u = np.sqrt(np.diag(fit.model.covariance))[4 * len(fit.model.frequency_hz)]
    hertz = fit.model.real_hz[0]
    return 1.0 / (2 * np.pi * hertz), 1.96 * u / (2 * np.pi * hertz**2)


def test_a_lag_of_chain_or_release_is_in_the_uncertainty() -> None:
    """An exponential release is a lag: U holds both attributions, with a warning."""
    fit = fit_step(record_of(output_of((CHAIN_S, 1e-4)), 2e-3), "Fz")
    found, expanded = lag(fit)
    assert LAG_NOT_ATTRIBUTED.code in {notice.code for notice in fit.notices}
    assert abs(found - CHAIN_S) < expanded
    assert abs(found - 1e-4) < expanded


def test_a_stated_chain_attributes_the_lag() -> None:
    fit = fit_step(record_of(output_of((CHAIN_S, 1e-4)), 2e-3, CHAIN_S), "Fz")
    assert fit.shape == "exponential"
    assert lag(fit) == pytest.approx((CHAIN_S, 0.02 * CHAIN_S), rel=0.15)
    assert fit.release_s == pytest.approx(2e-4, rel=0.05)
    assert LAG_NOT_ATTRIBUTED.code not in {notice.code for notice in fit.notices}


def softening_output(relative: float) -> FloatArray:
    """Output of a cubic spring x - εx³, which lowers the frequency by 3ε/8·a², after a step."""
    omega, soft = 2 * np.pi * MODE_HZ, relative * 8 / 3

    def motion(_: float, state: FloatArray) -> list[float]:
        x, v = state
        return [v, -2 * ZETA * omega * v - omega**2 * (x - soft * x**3)]

    tau = np.maximum(np.arange(2000) / RATE_HZ - ONSET_S, 0.0)
    end = solve_ivp(motion, (0.0, tau[-1]), [1.0, 0.0], t_eval=np.unique(tau), rtol=1e-8, atol=1e-10)
    return np.asarray(1.0 - np.interp(tau, end.t, end.y[0]))


def test_a_softening_spring_is_stated_and_in_the_uncertainty() -> None:
    fit = fit_step(record_of(softening_output(0.004), 0.01), "Fz")
    assert fit.model is not None
    assert fit.model.covariance is not None
    (notice,) = (notice for notice in fit.notices if notice.code == AMPLITUDE_DEPENDENT.code)
    assert notice.values["frequency_percent"] == pytest.approx(-0.4, rel=0.15)
    expanded = 1.96 * np.sqrt(fit.model.covariance[0, 0])
    for true in (MODE_HZ, 0.996 * MODE_HZ):
        assert abs(fit.model.frequency_hz[0] - true) < expanded


def test_several_records_show_a_softening_that_hides_in_each() -> None:
    output = softening_output(0.0012)
    fits = [fit_step(record_of(output, 0.01, seed=seed), "Fz").solution for seed in range(6)]
    solutions = [fit for fit in fits if fit is not None]
    single = [amplitude_dependence([fit], 0.0) for fit in solutions]
    together = amplitude_dependence(solutions)
    assert together is not None
    assert together.chi_squared > 2.0 * np.median([one.chi_squared for one in single if one is not None])
    assert together.frequency_change == pytest.approx(-0.0012, rel=0.35)


def test_noise_that_rings_with_the_mode_is_no_dependence_on_the_amplitude() -> None:
    """Floor motion excites the mode all the time; its swing adds to that of the release with any phase."""
    rng, clean = np.random.default_rng(5), output_of((CHAIN_S,))
    omega, decay = 2 * np.pi * MODE_HZ * np.sqrt(1 - ZETA**2), 2 * np.pi * MODE_HZ * ZETA
    tau = np.arange(2000) / RATE_HZ
    answer = np.exp(-decay * tau) * np.sin(omega * tau)
    found = []
    for _ in range(8):
        ringing = np.convolve(rng.standard_normal(4000), answer)[2000:4000]
        record = record_of(clean + 0.03 * ringing / np.std(ringing), 1e-3)
        found.append(amplitude_dependence([fit] if (fit := fit_step(record, "Fz").solution) else []))
    assert sum(one is not None for one in found) <= 1
