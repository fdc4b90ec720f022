"""Zeros, poles and gain: responses, conversions between continuous systems and samples, partial fractions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import signal

from shaker.lti.system import LinearSystem, ModalModel

FloatArray = NDArray[np.float64]
RATE = 1e5
METHODS = ("zoh", "tustin", "matched")


def third_order(hertz: float = 1700.0, damping: float = 0.015, real_hz: float = 6000.0) -> LinearSystem:
    """A mode and a real pole, static gain 1."""
    omega = 2 * np.pi * hertz
    upper = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    poles = np.array([upper, np.conj(upper), -2 * np.pi * real_hz + 0j])
    return LinearSystem(np.zeros(0, complex), poles, float(np.prod(-poles).real))


def with_zeros() -> LinearSystem:
    """Two modes with a pair of zeros between them, and a real zero."""
    zeros = np.array([-200 + 18000j, -200 - 18000j, -9e4 + 0j])
    poles = np.array([-160 + 10680j, -160 - 10680j, -500 + 26000j, -500 - 26000j])
    return LinearSystem(zeros, poles, 3.0)


@pytest.mark.parametrize("method", ["zoh", "tustin"])
@pytest.mark.parametrize("system", [third_order(), with_zeros()])
def test_conversion_agrees_with_scipy(method: str, system: LinearSystem) -> None:
    hertz = np.linspace(0, 0.45 * RATE, 400)
    if method == "tustin":
        expected = signal.freqz_zpk(
            *signal.bilinear_zpk(system.zeros, system.poles, system.gain, RATE), hertz, fs=RATE
        )[1]
    else:  # over a state space with time in samples: polynomials in rad/s would lose their digits
        numbers = np.trim_zeros(LinearSystem(system.zeros / RATE, system.poles / RATE, 1.0).coefficients()[0], "f")
        below = np.poly(system.poles / RATE).real
        scaled = system.gain * RATE ** (len(system.zeros) - len(system.poles))
        state = signal.cont2discrete(signal.tf2ss(numbers, below), 1.0, "zoh")
        z = np.exp(2j * np.pi * hertz / RATE)[:, None, None]
        inner = np.linalg.solve(
            z * np.eye(len(below) - 1) - state[0], np.broadcast_to(state[1], (400, *state[1].shape))
        )
        expected = scaled * (state[2] @ inner + state[3])[:, 0, 0]
    found = system.sampled(RATE, method).response(hertz)  # type: ignore[arg-type]
    assert np.abs(found / expected - 1).max() < 1e-9


@pytest.mark.parametrize("system", [third_order(), with_zeros(), third_order(3.0, 0.004, 8.0)])
def test_zoh_gives_the_step_response_at_every_sample(system: LinearSystem) -> None:
    time = np.arange(3000) / RATE
    found = system.sampled(RATE, "zoh").step(time)
    assert np.abs(found - system.step(time)).max() < 1e-7 * np.abs(system.step(time)).max()


def test_tustin_with_prewarp_keeps_one_frequency() -> None:
    system, hertz = third_order(), np.array([1700.0, 4000.0])
    warped = system.sampled(20e3, "tustin", prewarp_hz=1700.0).response(hertz)
    true = system.response(hertz)
    assert abs(warped[0] / true[0] - 1) < 1e-10
    assert abs(warped[1] / true[1] - 1) > 1e-2
    back = system.sampled(20e3, "tustin", prewarp_hz=1700.0).continuous("tustin", prewarp_hz=1700.0)
    assert np.allclose(back.response(hertz), true, rtol=1e-10)


def test_matched_has_the_poles_and_the_static_gain() -> None:
    system = with_zeros()
    found = system.sampled(RATE, "matched")
    assert np.allclose(np.sort_complex(found.poles), np.sort_complex(np.exp(system.poles / RATE)), rtol=1e-14)
    assert found.static_gain == pytest.approx(system.static_gain, rel=1e-12)
    differentiating = LinearSystem(np.zeros(1, complex), system.poles, 1.0)
    near = np.array([RATE / 100])
    gains = abs(differentiating.sampled(RATE, "matched").response(near)), abs(differentiating.response(near))
    assert gains[0] == pytest.approx(gains[1], rel=1e-12)


@settings(max_examples=40, deadline=None)
@given(
    hertz=st.floats(20.0, 8000.0),
    damping=st.floats(1e-4, 0.9),
    real=st.floats(50.0, 9000.0),
    method=st.sampled_from(METHODS),
)
def test_there_and_back(hertz: float, damping: float, real: float, method: str) -> None:
    system = third_order(hertz, damping, real)
    if np.min(np.abs(system.poles[:2] - system.poles[2])) < 0.02 * np.abs(system.poles[2]):
        return
    back = system.sampled(RATE, method).continuous(method)  # type: ignore[arg-type]
    grid = np.geomspace(1.0, 20e3, 60)
    assert np.allclose(np.sort_complex(back.poles), np.sort_complex(system.poles), rtol=1e-9)
    assert np.abs(back.response(grid) / system.response(grid) - 1).max() < 1e-4


def test_a_pole_that_turns_its_sign_is_refused_but_by_tustin() -> None:
    system = LinearSystem.from_coefficients(np.array([1.0, 0.0]), np.array([1.0, -0.3, -0.5]), RATE)
    for method in ("zoh", "matched"):
        with pytest.raises(ValueError, match="at or below z = 0"):
            system.continuous(method)  # type: ignore[arg-type]
    assert system.continuous("tustin").poles.real.max() < 0


def test_wrong_conversions_are_refused() -> None:
    system = third_order()
    samples = system.sampled(RATE)
    with pytest.raises(ValueError, match="expected a continuous one"):
        samples.sampled(RATE)
    with pytest.raises(ValueError, match="expected that of a sampled system"):
        system.continuous()
    with pytest.raises(ValueError, match="prewarp_hz"):
        system.sampled(RATE, "zoh", prewarp_hz=100.0)
    with pytest.raises(ValueError, match="prewarp_hz"):
        samples.continuous("zoh", prewarp_hz=100.0)
    with pytest.raises(ValueError, match="prewarp_hz"):
        system.sampled(RATE, "tustin", prewarp_hz=RATE)
    with pytest.raises(ValueError, match="rate_hz"):
        system.sampled(0.0)
    with pytest.raises(ValueError, match="coincide"):
        LinearSystem(np.zeros(0, complex), np.full(2, -5.0 + 0j), 25.0).sampled(RATE, "zoh")
    with pytest.raises(ValueError, match="z = -1"):
        LinearSystem(np.zeros(0, complex), np.full(1, -1.0 + 0j), 1.0, RATE).continuous()


def test_an_integrator_survives_the_hold() -> None:
    system = LinearSystem(np.zeros(0, complex), np.array([0j, -100 + 0j]), 100.0)
    time = np.arange(200) / 1000.0
    expected = time - (1 - np.exp(-100 * time)) / 100
    assert np.allclose(system.step(time), expected, atol=1e-12)
    assert np.allclose(system.sampled(1000.0, "zoh").step(time), expected, atol=1e-12)
    assert np.allclose(system.sampled(1000.0, "zoh").continuous("zoh").step(time), expected, atol=1e-10)


@pytest.mark.parametrize("poles", [[-50, -50], [-50, -50, -50], [-20 + 90j, -20 - 90j] * 2, [-50, -50.001]])
def test_responses_with_coinciding_poles_agree_with_scipy(poles: list[complex]) -> None:
    system = LinearSystem(np.array([-30.0 + 0j]), np.array(poles, complex), 7.0)
    time = np.linspace(0, 0.3, 301)
    above, below = np.array([7.0, 210.0]), system.coefficients()[1]
    expected = signal.step((above, below), T=time)[1]
    assert np.allclose(system.step(time), expected, atol=1e-8 * np.abs(expected).max())
    pulse = signal.impulse((above, below), T=time)[1]
    assert np.allclose(system.impulse(time), pulse, atol=1e-8 * np.abs(pulse).max())


def test_the_response_begins_at_zero_time() -> None:
    system = with_zeros()
    assert np.all(system.step(np.array([-1.0, -1e-9])) == 0)
    assert np.all(system.impulse(np.array([-1.0, -1e-9])) == 0)
    assert len(system.step(np.zeros(0))) == 0


def test_what_passes_at_once_is_in_the_step() -> None:
    system = LinearSystem(np.array([-10.0 + 0j]), np.array([-5.0 + 0j]), 2.0)
    assert system.direct == 2.0
    assert system.step(np.zeros(1))[0] == pytest.approx(2.0)
    assert system.step(np.array([20.0]))[0] == pytest.approx(4.0)
    assert np.allclose(system.impulse(np.array([0.0, 0.1])), 10.0 * np.exp(-5.0 * np.array([0.0, 0.1])))


def test_residues_give_the_system_again() -> None:
    system = with_zeros()
    again = LinearSystem.from_residues(system.poles, system.residues(), system.direct)
    hertz = np.linspace(0, 20e3, 200)
    assert np.allclose(again.response(hertz), system.response(hertz), rtol=1e-10)
    assert again.gain == pytest.approx(system.gain, rel=1e-9)
    expected, poles, _ = signal.residue(*system.coefficients())
    order = [int(np.argmin(np.abs(poles - pole))) for pole in system.poles]
    assert np.allclose(system.residues(), expected[order], rtol=1e-8)


def test_rounding_leaves_no_zeros_far_away() -> None:
    system = third_order()
    again = LinearSystem.from_residues(system.poles, system.residues())
    assert len(again.zeros) == 0
    assert again.static_gain == pytest.approx(1.0, rel=1e-10)
    with pytest.raises(ValueError, match="residues"):
        LinearSystem.from_residues(system.poles, np.zeros(3, complex))


def test_modal_form_there_and_back() -> None:
    frequency, damping, residue = (
        np.array([1700.0, 4200.0]),
        np.array([0.015, -0.02]),
        np.array([-1e2 - 5e3j, 3e1 - 2e2j]),
    )
    model = ModalModel(frequency, damping, residue, np.array([6000.0, 40.0]), np.array([500.0, 3.0]))
    again = ModalModel.from_system(model.system)
    order = np.argsort(again.real_hz)[::-1]
    assert np.allclose(again.frequency_hz, frequency, rtol=1e-12)
    assert np.allclose(again.damping_ratio, damping, rtol=1e-10)
    assert np.allclose(again.residue, residue, rtol=1e-8)
    assert np.allclose(again.real_hz[order], model.real_hz, rtol=1e-10)
    assert np.allclose(again.real_residue[order], model.real_residue, rtol=1e-8)
    time = np.linspace(-1e-4, 2e-3, 300)
    assert np.allclose(model.step(time), model.system.step(time), atol=1e-9)
    assert np.allclose(model.impulse(time), model.system.impulse(time), atol=1e-9 * np.abs(model.impulse(time)).max())


def test_impulse_is_the_derivative_of_the_step() -> None:
    model = ModalModel.from_system(third_order())
    time, step = np.linspace(1e-5, 2e-3, 50), 1e-8
    slope = (model.step(time + step) - model.step(time - step)) / (2 * step)
    assert np.allclose(slope, model.impulse(time), rtol=1e-5, atol=1e-3 * np.abs(slope).max() * 1e-3)


def test_systems_without_modal_form_are_refused() -> None:
    with pytest.raises(ValueError, match="continuous"):
        ModalModel.from_system(third_order().sampled(RATE))
    with pytest.raises(ValueError, match="fewer than poles"):
        ModalModel.from_system(LinearSystem(np.array([-1 + 0j]), np.array([-2 + 0j]), 1.0))
    with pytest.raises(ValueError, match="different ones"):
        ModalModel.from_system(LinearSystem(np.zeros(0, complex), np.full(2, -2 + 0j), 1.0))
