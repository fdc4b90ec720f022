"""A rigid load on springs: pitching, three axes, rotation and base motion against state space and textbook formulas."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from identification_factory import (
    ALONG_X,
    ALONG_Z,
    FREE,
    ComplexArray,
    FloatArray,
    X,
    Z,
    oscillator,
    recording,
    rigid_mass,
)
from identification_factory import pitching as shifted
from scipy.spatial.transform import Rotation

from shaker.identification.identification_problem import build_problem
from shaker.identification.measured_curves import Bending, InertiaError, Placement
from shaker.identification.structure_fit import Identification, identify
from shaker.identification.structures import SpringSuspension
from shaker.mechanics import respond

LINES_HZ = np.arange(300.0, 3000.0, 3.125)
K_X, B_X, K_RY, B_RY, M_I, J_I = 7.0e8, 600.0, 1.1e6, 1.2, 0.9, 1.5e-3
PITCHING = SpringSuspension((0, 4))
TOPS = (Placement(0.03 * Z, X), Placement(-0.02 * Z, X))
BASE = Placement(-0.05 * Z, X)


def pitching(load, springs=(K_X, K_RY, B_X, B_RY), frequency_hz=LINES_HZ, *, noise=0.003, rng=None, z_load=0.0):
    """Horizontal drive of a load stated to 0.3 g, measured at two heights."""
    change = InertiaError(f"mass of {load[0]} kg", rigid_mass(3e-4, load[1]))
    words = {"noise": noise, "rng": rng, "tops": TOPS, "base": BASE, "inertia_errors": [change]}
    return shifted(load, springs, (M_I, J_I), frequency_hz, TOPS, off_kg=3e-4 * z_load, **words)


def textbook_poles(mass: FloatArray, damping: FloatArray, stiffness: FloatArray) -> ComplexArray:
    """Eigenvalues of the state matrix with positive imaginary parts, by size."""
    size = len(mass)
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    root = np.linalg.eigvals(np.vstack([np.eye(size, 2 * size, size), lower]))
    root = root[root.imag > 0.0]
    return np.asarray(root[np.argsort(np.abs(root))])


def assert_within(found: Identification, truth: Sequence[float], reach: float = 4.0) -> None:
    """Every parameter lies within some standard uncertainties of the truth."""
    for name, true in zip(found.names, truth, strict=True):
        assert abs(found.value(name) - true) < reach * found.u(name), (name, found[name])


@pytest.mark.parametrize(
    ("height", "k_ry", "b_x", "b_ry"),
    [
        (0.035, 1.1e6, B_X, B_RY),
        (0.02, 3.3e6, B_X, B_RY),  # one mode of the light load above the band
        (0.004, 2.05e6, 2.0e4, 60.0),  # peaks 8 % apart, each a third wide
        (0.0, 1.9e6, 3.0e3, 8.0),  # peaks 1.6 % apart, each 5 % wide; no coupling
        (0.035, 1.0e8, B_X, B_RY),  # rotation far above the band
    ],
)
def test_two_modes_give_the_translational_stiffness(height, k_ry, b_x, b_ry):
    rng = np.random.default_rng(2)
    loads = ((4.236, height, 0.012), (8.798, height + 0.01, 0.035))
    draws = rng.standard_normal(2)
    recordings = [
        pitching(load, (K_X, k_ry, b_x, b_ry), rng=rng, z_load=z) for load, z in zip(loads, draws, strict=True)
    ]
    found = identify(recordings, PITCHING)
    assert found.value("stiffness_x") == pytest.approx(K_X, rel=2e-3)
    assert_within(found, [K_X, k_ry, b_x, b_ry, M_I, J_I])
    assert found.chi_squared / found.dof == pytest.approx(1.0, abs=0.1)
    mass, height, inertia = loads[0]
    whole = rigid_mass(mass + 3e-4 * draws[0], height, inertia) + rigid_mass(M_I, 0.0, J_I)
    root = textbook_poles(whole[np.ix_(FREE, FREE)], np.diag([b_x, b_ry]), np.diag([K_X, k_ry]))
    for mode, pole in zip(found.modes, root, strict=False):
        assert abs(mode.frequency_hz - abs(pole) / (2.0 * np.pi)) < 5.0 * mode.u_frequency_hz
        assert abs(mode.damping_ratio + pole.real / abs(pole)) < 5.0 * mode.u_damping_ratio


def test_a_rotation_that_the_band_does_not_show_is_named():
    rng, frequency = np.random.default_rng(5), np.arange(900.0, 2200.0, 3.125)
    loads = ((4.236, 0.002, 0.012), (8.798, 0.002, 0.035))
    recordings = [pitching(load, (K_X, 1e10, B_X, B_RY), frequency, rng=rng, noise=0.02) for load in loads]
    found = identify(recordings, PITCHING, stated_values={"internal_inertia_ry": (J_I, 0.0)})
    assert "stiffness_ry" in {notice.where for notice in found.notices}
    assert found.u("stiffness_ry") > found.value("stiffness_ry") / 3.0
    assert found.value("stiffness_x") == pytest.approx(K_X, rel=2e-3)


def test_pitching_without_pitching_in_the_model_is_distinguished():
    rng = np.random.default_rng(5)
    recordings = [pitching(load, rng=rng) for load in ((4.236, 0.035, 0.012), (8.798, 0.045, 0.035))]
    found = identify(recordings, SpringSuspension((0,)))
    assert {"identification"} <= {notice.where for notice in found.notices if notice.severity == "warning"}


def test_poles_of_overlapping_peaks_are_found_without_a_model():
    record = pitching((4.236, 0.01, 0.012), (K_X, 3.0e6, B_X, B_RY), rng=np.random.default_rng(1))
    mechanics = PITCHING.mechanics(record)
    (mass, damping, stiffness), _ = mechanics.at(np.array([1.0, K_X, 3.0e6, B_X, B_RY, M_I, J_I, 0.0]))
    np.testing.assert_allclose(record.poles(2), textbook_poles(mass, damping, stiffness), rtol=1e-3)


def test_three_axes_at_once_are_three_oscillators():
    rng = np.random.default_rng(7)
    k, b = np.array([7.0e8, 7.1e8, 4.7e8]), np.array([600.0, 500.0, 900.0])
    frequency = np.arange(900.0, 2600.0, 3.125)
    s = 2j * np.pi * frequency
    drive = np.concatenate([np.full(3, 1.0 / np.sqrt(3.0)), np.zeros(3)])
    tops = tuple(Placement(np.zeros(3), axis) for axis in np.eye(3))
    recordings = []
    for load in (4.236, 6.0):
        value = np.stack([oscillator(s, load + M_I, *pair) for pair in zip(k, b, strict=True)], axis=1) / np.sqrt(3.0)
        base = Placement(np.zeros(3), drive[:3])
        recordings.append(
            recording(f"{load}", frequency, value, rigid_mass(load), drive, noise=1e-3, rng=rng, tops=tops, base=base)
        )
    found = identify(recordings, SpringSuspension((0, 1, 2)))
    assert_within(found, [*k, *b, M_I])
    assert len(found.modes) == 6


def test_rotation_is_inertia_against_a_torsion_spring():
    # Torsion: base and load turn about z, tangential transducers; J and k take the place of m and k.
    rng = np.random.default_rng(8)
    k, b, internal = 2.0e6, 2.5, 4e-3
    turning = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    tangential = Placement(np.array([0.1, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    recordings = []
    for inertia in (0.03, 0.07):
        f0 = np.sqrt(k / (inertia + internal)) / (2.0 * np.pi)
        frequency = np.linspace(0.8 * f0, 1.2 * f0, 300)
        value = oscillator(2j * np.pi * frequency, inertia + internal, k, b)
        matrix = rigid_mass(5.0, 0.02, inertia)
        seen = {"tops": [tangential], "base": tangential}
        recordings.append(recording(f"{inertia}", frequency, value, matrix, turning, noise=1e-2, rng=rng, **seen))
    found = identify(recordings, SpringSuspension((5,)))
    assert found.names == ("stiffness_rz", "damping_rz", "internal_inertia_rz")
    assert [estimate.unit for estimate in found.estimates] == ["N.m/rad", "N.m.s/rad", "kg.m^2"]
    assert_within(found, [k, b, internal])


def test_a_base_that_shifts_turns_a_load_that_can_only_turn():
    # (J + k_ry/s² …) φ = -m h ẍ: rotation about the origin, forced by the inertia of the centre of mass.
    mass, height, inertia, k, b = 5.0, 0.04, 0.02, 4.0e5, 3.0
    frequency = np.linspace(300.0, 1200.0, 40)
    s, whole = 2j * np.pi * frequency, inertia + mass * height**2
    turn = -s * s * mass * height / (whole * s * s + b * s + k)
    matrix, seen = rigid_mass(mass, height, inertia), {"tops": [Placement(0.03 * Z, X)], "base": BASE}
    record = recording("a", frequency, 1.0 + 0.03 * turn, matrix, ALONG_X, noise=1e-6, **seen)
    found = respond(SpringSuspension((4,)).mechanics(record), np.array([1.0, k, b, 0.0]), s)
    np.testing.assert_allclose(found.value[:, 0], record.ratio.value[:, 0], rtol=1e-12)
    fitted = identify([record], SpringSuspension((4,)), stated_values={"internal_inertia_ry": (0.0, 0.0)})
    assert fitted.value("stiffness_ry") == pytest.approx(k, rel=1e-6)


@settings(max_examples=8, deadline=None)
@given(angle=st.floats(-3.0, 3.0))
def test_a_round_sensor_is_invariant_to_rotation_about_z(angle):
    turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    both, sensor = np.kron(np.eye(2), turn), SpringSuspension((0, 1, 3, 4))
    weights = np.array([1.0, K_X, K_X, K_RY, K_RY, B_X, B_X, B_RY, B_RY, M_I, J_I, J_I, 0.0])
    first = pitching((4.236, 0.035, 0.012), frequency_hz=np.arange(300.0, 3000.0, 100.0))
    tops = [Placement(turn @ sight.point_m, turn @ sight.direction) for sight in TOPS]
    rotated = replace(
        first,
        mass_matrix=both @ first.mass_matrix @ both.T,
        drive=both @ first.drive,
        tops=tuple(tops),
        base=Placement(turn @ BASE.point_m, turn @ BASE.direction),
        inertia_errors=(InertiaError("mass", both @ first.inertia_errors[0].change @ both.T),),
    )
    values = [respond(sensor.mechanics(record), weights, record.s) for record in (first, rotated)]
    np.testing.assert_allclose(values[1].value, values[0].value, rtol=1e-7)
    np.testing.assert_allclose(values[0].value, first.ratio.value, rtol=1e-7)
    np.testing.assert_allclose(values[1].by_term[:, :, -1], values[0].by_term[:, :, -1], rtol=1e-6, atol=1e-12)


def test_damping_may_differ_from_load_to_load():
    rng, truth = np.random.default_rng(3), {4.236: 150.0, 8.798: 1000.0}
    recordings = []
    for load, b in truth.items():
        f0 = np.sqrt(K_X / (load + M_I)) / (2.0 * np.pi)
        frequency = np.linspace(0.9 * f0, 1.1 * f0, 300)
        value = oscillator(2j * np.pi * frequency, load + M_I, K_X, b)
        recordings.append(recording(f"{load} kg", frequency, value, rigid_mass(load), ALONG_Z, noise=0.02, rng=rng))
    found = identify(recordings, SpringSuspension((2,)), each_recording=["damping_z"])
    assert found.names == ("stiffness_z", "damping_z: 4.236 kg", "damping_z: 8.798 kg", "internal_mass")
    assert_within(found, [K_X, *truth.values(), M_I])
    assert found.value("lag_z: 8.798 kg") == pytest.approx(1000.0 / K_X, rel=0.01)
    common = identify(recordings, SpringSuspension((2,)))
    assert common.chi_squared > 2.0 * common.dof


def test_components_that_do_not_exist_are_refused():
    for components in ((), (6,), (0, 0)):
        refused("^components: ", SpringSuspension, components)


def test_derivatives_of_an_elastic_load_are_those_of_differences():
    rng = np.random.default_rng(6)
    record = pitching((4.236, 0.035, 0.012), frequency_hz=np.arange(900.0, 1500.0, 100.0))
    lines, responses = record.ratio.value.shape

    def some(*shape: int) -> ComplexArray:
        return np.asarray(rng.standard_normal(shape) + 1j * rng.standard_normal(shape))

    bending = Bending(("modulus", "length"), 1e-2 * some(3, lines, 6, 6), 1e-2 * some(3, lines, responses, 6))
    problem = build_problem([replace(record, bending=bending)], PITCHING, {}, ())
    (curve,) = problem.curves
    start = np.array([K_X, K_RY, B_X, B_RY, M_I, J_I, *rng.standard_normal(len(problem.names) - 6)])
    found = curve.modelled(start)
    value, slopes = found.value, found.derivatives
    assert problem.names[-2:] == ("error: modulus", "error: length")
    for column, index in enumerate(curve.unknown_indices.tolist()):
        step = np.eye(len(start))[index] * 1e-5 * max(abs(start[index]), 1.0)
        ahead, behind = (curve.modelled(start + sign * step).value for sign in (1.0, -1.0))
        slope = (ahead - behind) / (2.0 * step[index])
        np.testing.assert_allclose(slopes[:, :, column], slope, rtol=1e-4, atol=1e-6 * np.abs(slope).max())
    # By its definition: the load's wrench and readings with what is not rigid, solved line by line.
    weights, size = np.array([1.0, *start[-2:]]), np.eye(6)[:, [0, 4]]
    inside = np.diag([M_I, M_I, M_I, 0.0, J_I, 0.0])
    for k, s in enumerate(record.s):
        more, read = (np.tensordot(weights, part[:, k], 1) for part in (bending.inertia, bending.stretch))
        mass = record.mass_matrix + start[6] * record.inertia_errors[0].change + inside + more
        stiff = np.diag([K_X + s * B_X, K_RY + s * B_RY])
        moved = np.linalg.solve(s**2 * size.T @ mass @ size + stiff, -(s**2) * size.T @ mass @ record.drive)
        whole = record.drive + size @ moved
        rows = np.stack([top.row for top in record.tops]) + read
        np.testing.assert_allclose(value[k], rows @ whole / (record.base.row @ record.drive), rtol=1e-9)
