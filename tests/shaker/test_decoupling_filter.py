"""The filter: blocks of any length, its response, its noise, and its design for sensors that have no stable inverse."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import StateSpace, cont2discrete, dlsim

from shaker.decoupling.filter import DecouplingFilter, Recorded, Target, design_decoupling
from shaker.decoupling.model import MultiModel, check_separable, in_order, missing_loads, sampled_modes

RATE_HZ = 10e3
TARGET = Target(np.array([300.0, 250.0]), np.array([0.6, 0.7]))
RECORDED = Recorded(RATE_HZ, np.array([0.01, 0.01]), np.ones(2))


def _model(second: float = 0.3) -> MultiModel:
    """Two modes; `second` is how much the second output shows of the first load's mode, against its static share."""
    frequency, damping = np.array([400.0, 650.0]), np.array([0.02, 0.03])
    omega = 2.0 * np.pi * frequency
    swing = omega**2 / (2j * omega * np.sqrt(1.0 - damping**2))
    show, drive = np.array([[1.0, 0.1], [second, 1.0]]), np.array([[1.0, 0.2], [0.1, 1.0]])
    residue = np.einsum("cm,m,md->mcd", show, swing, drive)
    return MultiModel(("Fx", "Fy"), ("Fx", "Fy"), "V", frequency, damping, residue, np.zeros(0), np.zeros((0, 2, 2)))


@pytest.fixture(scope="module")
def decoupler() -> DecouplingFilter:
    return design_decoupling(_model(), TARGET, RECORDED)


@given(st.lists(st.integers(0, 300), max_size=6))
@settings(max_examples=20, deadline=None)
def test_blocks_give_the_bits_of_one_record(cuts: list[int]) -> None:
    filtered = design_decoupling(_model(), TARGET, RECORDED, 4)
    outputs = np.random.default_rng(2).standard_normal((300, 2))
    state, parts = filtered.rest(outputs[0]), []
    for block in np.split(outputs, sorted(cuts)):
        part, state = filtered.process(block, state)
        parts.append(part)
    assert np.array_equal(np.concatenate(parts), filtered.apply(outputs))


def test_response_is_the_transform_of_the_impulse_response(decoupler: DecouplingFilter) -> None:
    count = 4000
    for c in range(2):
        outputs = np.zeros((count, 2))
        outputs[0, c] = 1.0
        answer = decoupler.process(outputs, decoupler.rest())[0]
        lines = np.fft.rfft(answer, axis=0)
        frequency_hz = np.asarray(np.fft.rfftfreq(count, 1.0 / RATE_HZ), dtype=np.float64)
        difference = decoupler.response(frequency_hz)[:, :, c] - lines
        assert np.abs(difference).max() < 1e-9 * np.abs(lines).max()
        power = np.sqrt(np.sum(answer**2, axis=0)) * 0.3
        noise = np.zeros(2)
        noise[c] = 0.3
        np.testing.assert_allclose(decoupler.noise(noise), power, rtol=1e-9)


def test_constant_outputs_give_constant_loads(decoupler: DecouplingFilter) -> None:
    load = np.array([2.0, -3.0])
    outputs = np.tile(_model().static_gain @ load, (50, 1))
    np.testing.assert_allclose(decoupler.apply(outputs), np.tile(load, (50, 1)), rtol=1e-10)


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_filter_times_sensor_is_the_target(delay: int) -> None:
    clear = Recorded(RATE_HZ, np.array([1e-5, 1e-5]), np.ones(2))
    decoupler = design_decoupling(_model(), TARGET, clear, delay)
    assert decoupler.delay == delay
    frequency_hz = np.linspace(0.0, 1000.0, 41)
    product = decoupler.response(frequency_hz) @ _model().response(frequency_hz)
    wanted = decoupler.target(frequency_hz)[:, :, None] * np.eye(2)
    assert np.abs(product - wanted).max() < 2e-3
    assert np.abs(product[0] - np.eye(2)).max() < 1e-12


def test_sensor_without_stable_inverse_has_a_stable_filter() -> None:
    frequency, damping, share = np.array([400.0, 650.0]), np.array([0.02, 0.03]), np.array([1.0, -0.5])
    omega = 2.0 * np.pi * frequency
    residue = (share * omega**2 / (2j * omega * np.sqrt(1.0 - damping**2)))[:, None, None]
    numerator = np.polyadd(
        share[0] * omega[0] ** 2 * np.array([1.0, 2.0 * damping[1] * omega[1], omega[1] ** 2]),
        share[1] * omega[1] ** 2 * np.array([1.0, 2.0 * damping[0] * omega[0], omega[0] ** 2]),
    )
    assert np.any(np.roots(numerator).real > 0.0)
    model = MultiModel(("a",), ("Fx",), "V", frequency, damping, residue, np.zeros(0), np.zeros((0, 1, 1)))
    target, recorded = Target(np.array([150.0]), np.array([0.6])), Recorded(RATE_HZ, np.array([1e-3]), np.ones(1))
    decoupler = design_decoupling(model, target, recorded)
    assert np.abs(decoupler.poles).max() < 1.0
    frequency_hz = np.array([0.0, 20.0, 60.0, 150.0])
    product = (decoupler.response(frequency_hz) @ model.response(frequency_hz))[:, 0, 0]
    assert abs(product[0] - 1.0) < 1e-10
    assert np.abs(product - decoupler.target(frequency_hz)[:, 0]).max() < 0.05


def test_sampled_modes_follow_loads_along_lines_exactly() -> None:
    model = _model()
    system = sampled_modes(model.poles, list(model.residue), RATE_HZ)
    fine, count = 40, 120
    knots = np.concatenate([[0.0], np.random.default_rng(1).standard_normal(count - 1)])
    load = np.interp(np.arange((count - 1) * fine + 1) / fine, np.arange(count), knots)
    a, b, c = _continuous(model)
    discrete = cont2discrete((a, b[:, :1], c, np.zeros((2, 1))), 1.0 / (RATE_HZ * fine), "foh")
    _, reference, _ = dlsim((*discrete[:4], 1.0 / (RATE_HZ * fine)), load[:, None])
    found = dlsim(StateSpace(system.a, system.b[:, :1], system.c, system.d[:, :1], dt=1.0), knots[:, None])[1]
    np.testing.assert_allclose(found, reference[::fine], atol=1e-9 * np.abs(reference).max())


def _continuous(model: MultiModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State space of the modes with complex states written as pairs."""
    size = 4 * len(model.poles)
    a, b, c = np.zeros((size, size)), np.zeros((size, 2)), np.zeros((2, size))
    for m, (pole, residue) in enumerate(zip(model.poles, model.residue, strict=True)):
        for d in range(2):
            i = 4 * m + 2 * d
            a[i : i + 2, i : i + 2] = [[pole.real, -pole.imag], [pole.imag, pole.real]]
            b[i, d] = 1.0
            c[:, i], c[:, i + 1] = 2 * residue[:, d].real, -2 * residue[:, d].imag
    return a, b, c


def test_growing_models_and_impossible_targets_are_refused() -> None:
    model = _model()
    grows = MultiModel(
        model.channels, model.components, "V", model.frequency_hz, -model.damping_ratio, model.residue,
        model.real_hz, model.real_residue,
    )  # fmt: skip
    with pytest.raises(ValueError, match="decay"):
        design_decoupling(grows, TARGET, RECORDED)
    with pytest.raises(ValueError, match="between 0 and 1"):
        Target(np.array([300.0]), np.array([1.2]))
    with pytest.raises(ValueError, match="above 0"):
        Target(np.array([-300.0]), np.array([0.5]))


def test_missing_and_inseparable_loads_are_named() -> None:
    assert missing_loads(("Fx", "Fy", "Fz"), ("Fx", "Fz")) == ("Fy",)
    static = np.zeros((2, 6))
    static[0, 0] = static[1, 5] = 1.0
    assert missing_loads(("a", "b"), ("Fx",), static) == ("Mz",)
    assert in_order(("Mz", "Fy", "Mz", "Fx")) == ("Fx", "Fy", "Mz")
    with pytest.raises(ValueError, match="Fx and My alike"):
        check_separable(np.array([[1.0, 2.0], [0.5, 1.0]]), ("a", "b"), ("Fx", "My"))
    with pytest.raises(ValueError, match="at least as many as loads"):
        check_separable(np.ones((1, 2)), ("a",), ("Fx", "My"))
    with pytest.raises(ValueError, match="none for My"):
        check_separable(np.array([[1.0, 0.0], [0.5, 0.0]]), ("a", "b"), ("Fx", "My"))
