"""Chains of masses and of responses: against state space, tables, closed forms and integration."""

from dataclasses import replace

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from identification_factory import recording
from scipy import linalg, signal
from scipy.interpolate import CubicSpline

from shaker.frf.chain import (
    PoleModel,
    ResponseTable,
    cascade_responses,
    common_covariance,
    filter_poles,
    pole_response,
    ratio_unit,
    split_ratio,
    table_response,
)
from shaker.identification.measured_curves import InertiaError, MeasuredTransfer, Placement
from shaker.identification.structure_fit import Identification, identify
from shaker.identification.structures import ChainStructure, Stage
from shaker.mechanics import MassChain, oscillator_hz, required_stiffness, shared_spring
from shakercal._common.arrays import ComplexArray, FloatArray

FREQUENCY = np.geomspace(5.0, 5000.0, 60)
TRIPLE = MassChain(
    ("adapter", "sensor", "load"),
    np.array([2.5, 1.1, 6.96]),
    np.array([1.9e9, 4.7e8, 9.0e9]),
    np.array([900.0, 700.0, 2500.0]),
)
TWO_LOADS = np.array([4.236, 8.798])
TWO_RESONANCES = np.array([1477.35, 1092.97])


def state_space(chain: MassChain) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A, B and C of displacements [x, v] for the base's [displacement, velocity], written out from Newton's law."""
    count = len(chain.stages)
    a, b = np.zeros((2 * count, 2 * count)), np.zeros((2 * count, 2))
    a[:count, count:] = np.eye(count)
    for i in range(count):
        for shift, factor in ((0, chain.stiffness), (count, chain.damping)):
            a[count + i, shift + i] -= factor[i] / chain.mass[i]
            if i > 0:
                a[count + i, shift + i - 1] += factor[i] / chain.mass[i]
            else:
                b[count, int(shift > 0)] += factor[0] / chain.mass[0]
            if i + 1 < count:
                a[count + i, shift + i] -= factor[i + 1] / chain.mass[i]
                a[count + i, shift + i + 1] += factor[i + 1] / chain.mass[i]
    return a, b, np.hstack([np.eye(count), np.zeros((count, count))])


DECADE = st.floats(-1.0, 1.0)


def chain_of(parts: list[tuple[float, float, float]]) -> MassChain:
    """Masses, springs and dampers over two decades, lightly to heavily damped."""
    logs = np.array(parts)
    names = tuple(f"stage {i}" for i in range(len(parts)))
    return MassChain(names, 5.0 * 10 ** logs[:, 0], 3e8 * 10 ** logs[:, 1], 800.0 * 10 ** logs[:, 2])


@settings(max_examples=12, deadline=None)
@given(chain=st.lists(st.tuples(DECADE, DECADE, DECADE), min_size=1, max_size=5).map(chain_of))
def test_a_chain_agrees_with_state_space_and_is_rigid_at_low_frequency(chain):
    a, b, c = state_space(chain)
    s = 2j * np.pi * FREQUENCY
    driven = b @ np.stack([np.ones(len(s)), s])
    expected = np.linalg.solve(s[:, None, None] * np.eye(len(a)) - a, driven.T[:, :, None])[:, :, 0] @ c.T
    for index, stage in enumerate(chain.stages):
        found = chain.transfer(FREQUENCY, stage).value[:, 0]
        np.testing.assert_allclose(found, expected[:, index], rtol=1e-8, atol=1e-13)
        over = chain.transfer(FREQUENCY, chain.stages[-1], stage).value[:, 0]
        np.testing.assert_allclose(over * expected[:, index], expected[:, -1], rtol=1e-6, atol=1e-13)
    roots = linalg.eigvals(state_space(chain)[0])
    frequency, damping = chain.modes()
    size = 2.0 * np.pi * frequency
    assert np.all(np.diff(frequency) >= 0.0)
    rings = damping < 1.0 - 1e-6
    for value, ratio in zip(size[rings], damping[rings], strict=True):
        root = value * (-ratio + 1j * np.sqrt(1.0 - ratio**2))
        assert np.abs(roots - root).min() < 1e-6 * value
    slow = np.array([1e-3])
    for stage in chain.stages:
        assert chain.transfer(slow, stage).value[0, 0] == pytest.approx(1.0, abs=1e-8)


def test_derivatives_are_those_of_differences():
    frequency = np.array([100.0, 900.0, 1500.0, 3000.0])
    found = TRIPLE.transfer(frequency, "load", "adapter").by_term[:, 0]
    theta = np.concatenate([TRIPLE.mass, TRIPLE.stiffness, TRIPLE.damping])

    def at(moved: FloatArray) -> ComplexArray:
        return MassChain(TRIPLE.stages, *np.split(moved, 3)).transfer(frequency, "load", "adapter").value[:, 0]

    for index, value in enumerate(theta):
        step = 1e-5 * value * np.eye(9)[index]
        by_difference = (at(theta + step) - at(theta - step)) / 2e-5
        np.testing.assert_allclose(found[:, index] * value, by_difference, rtol=1e-5, atol=1e-8)


FINE = np.geomspace(20.0, 40000.0, 40000)


def peaks(magnitude: FloatArray) -> FloatArray:
    """Frequencies of the local maxima that stand out by 1 %."""
    return np.asarray(FINE[signal.find_peaks(np.log(magnitude), prominence=0.01)[0]])


@pytest.mark.parametrize("mount_mass", [0.3, 3.0, 12.0])
@pytest.mark.parametrize("mount_stiffness", [2e7, 4e8, 5e9])
def test_load_over_adapter_has_one_peak_whatever_the_mount_and_load_over_base_two(mount_mass, mount_stiffness):
    mass, stiffness = np.array([mount_mass, 7.73]), np.array([mount_stiffness, 4.75e8])
    chain = MassChain(("adapter", "sensor"), mass, stiffness, np.array([150.0, 700.0]))
    above = peaks(np.abs(chain.transfer(FINE, "sensor", "adapter").value[:, 0]))
    assert above == pytest.approx([np.sqrt(4.75e8 / 7.73) / (2.0 * np.pi)], rel=1e-3)
    modes = chain.modes()[0]
    assert peaks(np.abs(chain.transfer(FINE, "sensor").value[:, 0])) == pytest.approx(modes, rel=0.01)


def test_one_spring_and_internal_mass_of_several_resonances():
    """Nitsche et al. (2018): 1477.35 and 1092.97 Hz with 4.236 and 8.798 kg, exactly; of more loads their line."""
    stiffness, internal = shared_spring(TWO_RESONANCES, TWO_LOADS)
    assert (stiffness, internal) == (pytest.approx(4.753e8, rel=2e-4), pytest.approx(1.280, abs=1e-3))
    np.testing.assert_allclose((2.0 * np.pi * TWO_RESONANCES) ** 2 * (TWO_LOADS + internal), stiffness, rtol=1e-12)
    loads = np.array([0.5, 2.0, 4.236, 7.0, 8.798])
    resonances = np.sqrt(4.75e8 / (loads + 1.28)) / (2.0 * np.pi)
    assert shared_spring(resonances, loads) == pytest.approx((4.75e8, 1.28), rel=1e-9)
    refused("^mass: ", shared_spring, TWO_RESONANCES, np.array([4.0, 4.0]))


TRUE = {"k": 4.753e8, "b_adapter": 2600.0, "b": 699.0, "m_adapter": 2.4, "m_i": 0.769}


def recorded(component: int, load: float, k_adapter: float, rng: np.random.Generator) -> MeasuredTransfer:
    """Load over the base below the mount, in closed form, with circular noise of 3e-4 of the largest |H|."""
    frequency = np.arange(300.0, 4500.0, 6.25)
    s = 2j * np.pi * frequency
    lower, spring = k_adapter + TRUE["b_adapter"] * s, TRUE["k"] + TRUE["b"] * s
    upper = (load + TRUE["m_i"]) * s**2 + spring
    value = lower * spring / ((TRUE["m_adapter"] * s**2 + lower + spring) * upper - spring**2)
    sight = Placement(np.array([0.1, 0.0, 0.02]), np.array([0.0, 1.0, 0.0]))  # sees y, and turns about z by 0.1 m
    words = {"tops": [sight], "base": sight, "noise": 3e-4 * np.abs(value).max(), "rng": rng, "u_clock": 1e-7}
    change = InertiaError(f"load {load:g}", 1e-5 * load * np.eye(6))
    drive, matrix = np.eye(6)[component], load * np.eye(6)
    return recording(f"load {load:g}", frequency, value, matrix, drive, inertia_errors=[change], **words)


def fitted(component: int, k_adapter: float) -> tuple[Identification, FloatArray]:
    """Two loads along an axis or about it fitted together, and the true values."""
    rng = np.random.default_rng(5)
    found = identify([recorded(component, load, k_adapter, rng) for load in TWO_LOADS], ChainStructure(component))
    assert not found.notices
    assert found.chi_squared / found.dof == pytest.approx(1.0, abs=0.1)
    return found, np.array([k_adapter, *(TRUE[name] for name in ("k", "b_adapter", "b", "m_adapter", "m_i"))])


@pytest.mark.parametrize("component", [1, 5])
def test_a_yielding_mount_is_found_from_the_base_below_it(component):
    found, true = fitted(component, 6e8)
    values = np.array([estimate.value for estimate in found.estimates])
    scaled = found.covariance / np.multiply.outer(true, true)
    z = np.linalg.solve(np.linalg.cholesky(scaled), values / true - 1.0)
    assert z @ z < 22.5  # 99.9 % of six values
    stiffness = found["stiffness_y" if component == 1 else "stiffness_rz"]
    assert stiffness.u < 2e-3 * stiffness.value


def test_a_mount_with_its_resonance_above_the_band_is_found_with_its_uncertainty():
    """A narrow curved valley: mount and sensor may share stiffness and mass in many ways that hardly differ."""
    found, true = fitted(1, 1.6e9)
    assert found.modes[1].frequency_hz > 4600.0  # of lines up to 4500 Hz
    for estimate, value in zip(found.estimates, true, strict=True):
        assert abs(estimate.value - value) < 3.3 * estimate.u
    assert 0.03 < found.u("stiffness_y_adapter") / found.value("stiffness_y_adapter") < 0.15


def test_stages_without_a_mass_and_the_names_of_all():
    joint = ChainStructure(2, (Stage("sensor"), Stage("joint", has_mass=False)))
    names = [parameter.name for parameter in joint.parameters]
    assert names == ["stiffness_z", "stiffness_z_joint", "damping_z", "damping_z_joint", "internal_mass"]
    turning = ChainStructure(4)
    assert [p.name for p in turning.parameters][-2:] == ["inertia_ry_adapter", "internal_inertia_ry"]
    assert {p.unit for p in turning.parameters} == {"N.m/rad", "N.m.s/rad", "kg.m^2"}


def test_dampers_act_between_neighbours_and_a_hand_lowers_the_resonance_of_an_oscillator():
    """Pedestal, sensor and hand: a common motion of all three is damped by the damper to the ground alone."""
    stages = ("pedestal", "sensor", "hand")
    damping = MassChain(stages, np.ones(3), np.ones(3), np.array([5.0, 3.0, 2.0])).matrices[1]
    np.testing.assert_allclose(damping, [[8.0, -3.0, 0.0], [-3.0, 5.0, -2.0], [0.0, -2.0, 2.0]])
    np.testing.assert_allclose(damping @ np.ones(3), [5.0, 0.0, 0.0])
    for hand in (0.02, 0.1, 0.5):
        chain = MassChain(stages, np.array([50.0, 0.05, hand]), np.array([1e12, 1.3e6, 1e10]), np.zeros(3))
        assert chain.modes()[0][0] == pytest.approx(oscillator_hz(1.3e6, 0.05 + hand), rel=1e-3)
    assert oscillator_hz(1.824e5, 0.049) == pytest.approx(307.07, abs=0.01)
    assert required_stiffness(oscillator_hz(3.0, 0.7), 0.7) == pytest.approx(3.0)
    refused("^stiffness, mass: ", oscillator_hz, 1.0, 0.0)


def test_stages_need_different_names_and_wrong_ones_are_refused():
    for stages in ((), ("a", "a"), ("base",)):
        refused("^stages: ", MassChain, stages, *np.ones((3, len(stages))))
    refused("^stage: .*top", TRIPLE.transfer, FREQUENCY, "top")
    refused("^damping: ", MassChain, ("a",), np.ones(1), np.ones(1), -np.ones(1))
    refused("^stiffness: ", MassChain, ("a",), np.ones(1), np.ones(2), np.ones(1))
    refused("^component: .*6", ChainStructure, 6)


DECADES_HZ = np.geomspace(10.0, 5000.0, 400)
LOWPASS = filter_poles("butterworth", 4, 10e3)
HIGHPASS = filter_poles("butterworth", 2, 2.0, "highpass")
OCTAVES = np.array([10.0, 20, 40, 80, 160, 315, 630, 1250, 2500, 5000])


def _table(frequency: np.ndarray, value: np.ndarray, u: float = 1e-4) -> ResponseTable:
    return ResponseTable(frequency, np.abs(value), np.angle(value), u * np.abs(value), np.full(len(frequency), u))


@pytest.mark.parametrize("kind", ["butterworth", "bessel"])
@pytest.mark.parametrize("band", ["lowpass", "highpass"])
@pytest.mark.parametrize("order", [1, 4, 8])
def test_standard_filters_are_those_of_scipy(kind, band, order):
    design = signal.butter if kind == "butterworth" else lambda *a, **k: signal.bessel(*a, **k, norm="mag")
    b, a = design(order, 2.0 * np.pi * 800.0, band, analog=True)
    _, expected = signal.freqs(b, a, 2.0 * np.pi * DECADES_HZ)
    found = pole_response(DECADES_HZ, filter_poles(kind, order, 800.0, band)).value
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    corner = pole_response(np.array([800.0]), filter_poles(kind, order, 800.0, band)).value
    assert np.abs(corner[0]) == pytest.approx(np.sqrt(0.5), rel=1e-9)


def test_a_resonance_is_an_oscillator_and_gain_and_delay_are_factors():
    ratio = DECADES_HZ / 3000.0
    found = pole_response(DECADES_HZ, filter_poles("resonance", 2, 3000.0, damping=0.02)).value
    np.testing.assert_allclose(found, 1.0 / (1.0 - ratio**2 + 0.04j * ratio), rtol=1e-12)
    model = PoleModel(np.zeros(1, complex), np.array([-6.0, -6e5], complex), 3.0, 160.0, 2e-5)
    found = pole_response(np.array([160.0, 1000.0]), model).value
    assert np.abs(found[0]) == pytest.approx(3.0)
    late = pole_response(np.array([1000.0]), replace(model, delay_s=0.0)).value[0]
    assert found[1] == pytest.approx(late * np.exp(-2j * np.pi * 1000.0 * 2e-5))


@pytest.mark.parametrize(
    "model", [LOWPASS, HIGHPASS, PoleModel(np.zeros(1, complex), np.array([-6.0, -6e5], complex), 2.0, 160.0)]
)
def test_errors_are_what_a_small_change_makes(model):
    step = 1e-6
    response = pole_response(DECADES_HZ, model, u_gain=step, u_frequency=step, u_delay_s=step * 1e-6)
    larger = replace(model, zeros=model.zeros * (1 + step), poles=model.poles * (1 + step))
    louder, later = replace(model, gain=model.gain * (1 + step)), replace(model, delay_s=model.delay_s + step * 1e-6)
    for error, other in zip(response.errors, (louder, larger, later), strict=True):
        change = pole_response(DECADES_HZ, other).value / response.value - 1.0
        np.testing.assert_allclose(error, change, atol=2e-3 * np.abs(error).max() + 1e-14)
    np.testing.assert_allclose(response.u_magnitude**2, np.sum(response.errors.real**2, axis=0))


def test_a_table_is_met_at_its_points_a_delay_exact_between_them_and_scatter_an_error_between_them():
    """Points that scatter by the table's own u: between them the curve is as wrong, and its U covers that."""
    knots = np.array([0.0, 300.0, 700.0, 1500.0])
    late = np.exp(-2j * np.pi * knots * 2e-4)
    np.testing.assert_allclose(table_response(_table(knots, late), knots).value, late, rtol=1e-12)
    between = np.array([11.0, 444.4, 1100.0])
    np.testing.assert_allclose(table_response(_table(knots, late), between).value, np.exp(-2j * np.pi * between * 2e-4))
    rng, knots = np.random.default_rng(4), np.linspace(10.0, 5000.0, 40)
    scatter = 1e-3 * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
    found = table_response(_table(knots, 1.0 + scatter, 1e-3), DECADES_HZ)
    error = np.abs(found.value - 1.0)
    assert np.mean(error > 2.0 * np.hypot(found.u_magnitude, found.u_phase_rad)) < 0.15
    middle = np.abs(table_response(_table(knots, 1.0 + scatter), (knots[1:] + knots[:-1]) / 2.0).errors[-1])
    assert 0.5e-3 < np.median(middle) < 4e-3


SMOOTH = [
    filter_poles("resonance", 2, 28e3, damping=0.015),
    filter_poles("butterworth", 4, 20e3),
    replace(filter_poles("bessel", 4, 9e3), delay_s=2e-4),
]


@pytest.mark.parametrize("model", SMOOTH)
@pytest.mark.parametrize("knots", [np.geomspace(10, 5000, 28), np.linspace(50, 5000, 100), np.geomspace(40, 320, 4)])
def test_interpolation_is_exact_at_the_points_of_a_table_and_accurate_between_them(model, knots):
    """An accelerometer, an amplifier, a filter: u is zero at the points, and covers the error between them, nearly."""
    table = _table(knots, pole_response(knots, model).value)
    assert np.abs(table_response(table, knots).errors[-1]).max() < 1e-15
    between = np.sqrt(knots[1:] * knots[:-1])
    found, true = table_response(table, between), pole_response(between, model).value
    error, u = np.abs(found.value / true - 1.0), np.abs(found.errors[-1])
    assert np.all(error <= 2.0 * u + 1e-12)
    assert np.median(u) < 1e-5, "a tenth of the certificate's"
    assert len(knots) < 6 or np.median(u) < 60.0 * np.median(error) + 1e-9


@pytest.mark.parametrize(("correlated", "beyond"), [(1.0, 0.05), (2.0, 0.02)])
def test_what_a_table_does_not_resolve_is_an_error_between_its_points(correlated, beyond):
    """Curves drawn at random, correlated over one or two steps: the middles of the intervals lie within 2 u."""
    rng, steps = np.random.default_rng(3), np.arange(0.0, 25.5, 0.5)
    distance = (steps[:, None] - steps[None, :]) / correlated
    root = np.linalg.cholesky(1e-6 * np.exp(-0.5 * distance**2) + 1e-16 * np.eye(len(steps)))
    frequency, missed = 10.0 * 10.0 ** (steps / 10.0), []
    for _ in range(60):
        level = root @ rng.standard_normal(len(steps))
        table = _table(frequency[::2], np.exp(level[::2]) + 0j, 1e-9)
        found = table_response(table, frequency[1:-1:2])
        error = np.abs(np.log(np.abs(found.value)) - level[1:-1:2])
        missed.append(np.mean(error > 2.0 * np.abs(found.errors[-1])))
    assert np.mean(missed) < beyond


def test_two_points_of_a_table_do_not_determine_the_curve_between_them():
    table = _table(np.array([100.0, 300.0]), np.array([1.0, 1.1]))
    middle, at = (table_response(table, np.array([hertz])).errors[-1] for hertz in (200.0, 300.0))
    assert middle[0] == pytest.approx(np.log(1.1) / 2.0 / np.sqrt(3.0))
    assert at[0] == 0.0


@pytest.mark.parametrize("count", [2, 3, 4, 5, 40])
def test_the_spline_of_a_table_is_that_of_scipy(count):
    rng = np.random.default_rng(count)
    knots = 25.0 * np.arange(count) + np.append(0.0, rng.uniform(0.0, 10.0, count - 1))  # from 0 Hz: no logarithm of f
    level, frequency = rng.normal(size=count), np.append(knots, rng.uniform(0.0, knots[-1], 100))
    found = np.log(table_response(_table(knots, np.exp(level) + 0j), frequency).value)
    np.testing.assert_allclose(found, CubicSpline(knots, level)(frequency), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_short_tables(count):
    knots = np.linspace(100.0, 400.0, count) if count > 1 else np.array([100.0])
    frequency = knots if count == 1 else np.array([100.0, 250.0, 400.0])
    found = table_response(_table(knots, np.full(count, 2.0 + 0j)), frequency)
    np.testing.assert_allclose(found.value, 2.0)
    np.testing.assert_allclose(found.u_magnitude, 1e-4)


def test_elements_multiply_and_their_errors_add_in_squares():
    parts = [pole_response(DECADES_HZ, model, u_gain=u) for model, u in ((LOWPASS, 3e-3), (HIGHPASS, 4e-3))]
    both = cascade_responses(parts)
    np.testing.assert_allclose(both.value, parts[0].value * parts[1].value)
    np.testing.assert_allclose(both.u_magnitude, 5e-3)
    assert len(both.causes) == 6


def test_common_errors_add_a_covariance_that_cancels_in_what_is_shared():
    value = np.array([[1.0 + 1.0j, 2.0 - 1.0j]])
    errors = np.array([[[0.01, 0.01]], [[0.02j, 0.02j]]])
    off = value * errors[:, 0]
    both = np.concatenate([off.real, off.imag], axis=1)
    np.testing.assert_allclose(common_covariance(value, errors)[0], both.T @ both, atol=1e-15)


def test_units_of_ratios():
    assert ratio_unit("m/s^2", "N") == "(m/s^2)/N"
    assert ratio_unit("V/V", "m/s^2") == "(V/V)/(m/s^2)"
    assert ratio_unit("m", "m") == "1"
    for above, below in (("m/s^2", "N"), ("V/V", "m/s^2"), ("m", "N"), ("m/s", "N.m")):
        assert split_ratio(ratio_unit(above, below)) == (above, below)
    assert split_ratio("m/s^2") == ("m/s^2", "")


def test_wrong_calls_are_refused_by_name():
    refused("^poles: ", PoleModel, poles=np.array([-1 + 2j]))
    refused("^poles: .*1", PoleModel, poles=np.array([1 + 0j]))
    refused("^gain: ", PoleModel, gain=0.0)
    refused("^order: .*0", filter_poles, "bessel", 0, 1.0)
    refused("^order: ", filter_poles, "resonance", 3, 1.0)
    refused("^corner_hz: ", filter_poles, "butterworth", 2, 0.0)
    refused("^frequency_hz: ", pole_response, np.zeros(1), HIGHPASS)
    refused("^frequency_hz: .*6000", table_response, _table(OCTAVES, OCTAVES + 0j), np.array([5e3, 6e3]))
    refused("^frequency_hz: ", _table, OCTAVES[::-1], OCTAVES + 0j)
    refused("^magnitude: ", _table, OCTAVES, 0j * OCTAVES)
