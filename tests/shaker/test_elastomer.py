"""Beam statics, frame and platform of a cross-beam element against analysis and published numbers."""

from dataclasses import replace

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.optimize import brentq

from shaker.elastomer.frame import (
    MODE_NAMES,
    BeamFrame,
    RigidPart,
    block,
    cross_frame,
    dense_modes,
    fit_platform,
    join_bodies,
    named_modes,
    pillar,
    platform_stiffness,
    rigid_motion,
    sensitivities,
    solve_frame,
)
from shaker.elastomer.geometry import CrossBeams, ElasticMaterial, Section, beam_matrices, beam_stiffness, lump_mass
from shaker.model_notices import PLATFORM_MISFIT, PLATFORM_NOT_VALIDATED
from shakercal._common.arrays import FloatArray

ALUMINIUM = ElasticMaterial(72e9, 0.3, 2820.0)
ELEMENT = CrossBeams(ALUMINIUM, 0.064, 0.0038, 0.0038, 0.001, 0.032, 0.0038)
SHEAR, THICK = 5.0 / 6.0, Section(0.012, 0.020)
PUBLISHED_HZ = {"Tx": 1660.0, "Ty": 1661.0, "Tz": 2025.0, "Rx": 3577.0, "Ry": 3578.0, "Rz": 5094.0}


def _bar(length: float, pieces: int, both: bool) -> BeamFrame:
    """A straight thick bar along x, its first end clamped, or both."""
    nodes = np.zeros((pieces + 1, 3))
    nodes[:, 0] = np.linspace(0.0, length, pieces + 1)
    return BeamFrame(
        node_m=nodes,
        beam=np.stack([np.arange(pieces), np.arange(1, pieces + 1)], axis=1),
        section=(THICK,) * pieces,
        material=ALUMINIUM,
        shear_factor=SHEAR,
        rigid=np.zeros(0, dtype=np.int64),
        clamped=np.array([0, pieces] if both else [0]),
    )


def _timoshenko_hz(length: float, both: bool) -> FloatArray:
    """Three frequencies of the bar that bends in the plane, by the transfer matrix of its differential equations."""
    second_moment, area = THICK.bending_in_plane_m4, THICK.area_m2
    bending, shear = ALUMINIUM.youngs_modulus_pa * second_moment, SHEAR * ALUMINIUM.shear_modulus_pa * area
    mass, turning = ALUMINIUM.density_kgm3 * area, ALUMINIUM.density_kgm3 * second_moment

    def ends(frequency: float) -> float:
        squared = (2.0 * np.pi * frequency) ** 2
        change = np.zeros((4, 4))  # w' = psi + Q/KGA, psi' = M/EI, M' = -Q - rho I w^2 psi, Q' = -rho A w^2 w
        change[0, 1], change[0, 3], change[1, 2] = 1.0, 1.0 / shear, 1.0 / bending
        change[2, 3], change[2, 1], change[3, 0] = -1.0, -turning * squared, -mass * squared
        size = np.array([1.0, 1.0 / length, bending / length**2, bending / length**3])
        transfer = expm(change * length) * size[None, :] / size[:, None]
        block_of = transfer[:2, 2:] if both else transfer[2:, 2:]
        return float(np.linalg.det(block_of))

    grid = np.linspace(50.0, 60e3, 4000)
    values = np.array([ends(f) for f in grid])
    crossed = np.flatnonzero(values[:-1] * values[1:] < 0.0)[:3]
    return np.array([brentq(ends, grid[i], grid[i + 1], xtol=1e-9) for i in crossed])


def _load(frame: BeamFrame, node: int, load: FloatArray) -> FloatArray:
    """Displacements and turns of a node under a load on it."""
    stiffness, _ = frame.matrices
    column = frame.reduction[6 * node : 6 * node + 6]
    return np.asarray(column @ np.linalg.solve(stiffness, column.T @ load))


@pytest.mark.parametrize("pieces", [1, 3])
def test_statics_of_a_cantilever_is_exact(pieces):
    length, frame = 0.1, _bar(0.1, pieces, both=False)
    modulus, shear = 72e9, SHEAR * ALUMINIUM.shear_modulus_pa * THICK.area_m2
    for axis, second_moment in ((1, THICK.bending_in_plane_m4), (2, THICK.bending_across_m4)):
        moved = _load(frame, pieces, np.eye(6)[axis])
        assert moved[axis] == pytest.approx(length**3 / (3 * modulus * second_moment) + length / shear, rel=1e-9)
        slope = moved[5] if axis == 1 else -moved[4]
        assert slope == pytest.approx(length**2 / (2 * modulus * second_moment), rel=1e-9)
    assert _load(frame, pieces, np.eye(6)[0])[0] == pytest.approx(length / (modulus * THICK.area_m2), rel=1e-9)
    twist = length / (ALUMINIUM.shear_modulus_pa * THICK.torsion_m4)
    assert _load(frame, pieces, np.eye(6)[3])[3] == pytest.approx(twist, rel=1e-9)


def _sideways_hz(length: float, pieces: int, both: bool) -> FloatArray:
    """The three lowest frequencies of a bar whose modes bend in the plane."""
    frame = _bar(length, pieces, both)
    found, shape = dense_modes(*frame.matrices, count=30)
    moved = [np.sum((frame.reduction @ shape)[axis::6] ** 2, axis=0) for axis in range(3)]
    return found[moved[1] > 1e3 * (moved[0] + moved[2])][:3]


@pytest.mark.parametrize("both", [False, True])
@pytest.mark.parametrize("length", [0.06, 0.3])
def test_frequencies_of_a_bar_are_timoshenkos(length, both):
    exact = _timoshenko_hz(length, both)
    rough, fine = (_sideways_hz(length, pieces, both) for pieces in (12, 24))
    assert np.all(fine >= exact * (1.0 - 1e-9))  # from above, with the square of the element's length
    assert fine == pytest.approx(exact, rel=4e-3)
    assert (4.0 * fine - rough) / 3.0 == pytest.approx(exact, rel=2e-4)


def test_torsion_and_axial_frequencies_of_a_bar_and_the_torsion_constant_of_saint_venant():
    found, _ = dense_modes(*_bar(0.2, 40, both=False).matrices, count=40)
    polar = THICK.bending_in_plane_m4 + THICK.bending_across_m4
    twist = np.sqrt(ALUMINIUM.shear_modulus_pa * THICK.torsion_m4 / (ALUMINIUM.density_kgm3 * polar))
    for speed in (twist, np.sqrt(72e9 / ALUMINIUM.density_kgm3)):
        assert np.min(np.abs(found - speed / 0.8)) < 1e-3 * speed / 0.8
    for a, b, exact in ((1.0, 1.0, 0.1406), (2.0, 1.0, 0.229), (1.0, 10.0, 0.312)):
        assert Section(a, b).torsion_m4 == pytest.approx(exact * max(a, b) * min(a, b) ** 3, rel=6e-3)


@settings(max_examples=12, deadline=None)
@given(length=st.floats(1e-3, 1.0), width=st.floats(1e-3, 0.1), height=st.floats(1e-3, 0.1), motion=st.integers(0, 5))
def test_a_beam_moved_rigidly_has_no_force_and_its_mass(length, width, height, motion):
    section = Section(width, height)
    stiffness, mass = beam_matrices(ALUMINIUM, section, length, SHEAR)
    ends = np.concatenate([rigid_motion(np.array([x, 0.0, 0.0])) for x in (0.0, length)])[:, motion]
    assert np.abs(stiffness @ ends).max() <= 1e-9 * np.abs(stiffness).max() * np.abs(ends).max()
    assert np.linalg.eigvalsh(mass).min() > 0.0
    total = ALUMINIUM.density_kgm3 * section.area_m2 * length
    if motion < 3:
        assert (ends @ mass @ ends, ends @ lump_mass(mass) @ ends) == pytest.approx((total, total), rel=1e-9)
    if motion == 5:
        turning = ALUMINIUM.density_kgm3 * section.bending_in_plane_m4 * length
        assert ends @ mass @ ends == pytest.approx(total * length**2 / 3.0 + turning, rel=1e-9)


@settings(max_examples=10, deadline=None)
@given(
    span=st.floats(0.03, 0.2),
    sizes=st.tuples(*[st.floats(5e-4, 6e-3)] * 4),
    compliant=st.floats(0.01, 0.1),
    share=st.floats(0.0, 0.8),
)
def test_closed_form_is_the_frame_with_any_dimensions(span, sizes, compliant, share):
    beams = CrossBeams(ALUMINIUM, span, sizes[0], sizes[1], sizes[2], compliant, sizes[3])
    half_size = 0.5 * share * span
    closed = beam_stiffness(beams, half_size)
    frame = platform_stiffness(cross_frame(beams, half_size, pieces=1))
    assert (closed.x, closed.x, closed.z) == pytest.approx(tuple(frame[:3]), rel=1e-6)


@pytest.mark.parametrize(
    ("half_size", "thickness", "expected"),
    [
        (0.012, 0.0038, (1911.0, 2157.0, 5720.0, 6990.0)),
        (0.014, 0.008, (1424.0, 1554.0, 3987.0, 4903.0)),
        (0.0179, 0.0059, (1781.0, 1794.0, 3760.0, 5117.0)),
    ],
)
def test_frame_of_the_published_geometry(half_size, thickness, expected):
    model = solve_frame(ELEMENT, half_size, block(2820.0, half_size, thickness))
    found = model.modes.frequency_hz
    assert found[[0, 2, 3, 5]] == pytest.approx(expected, rel=0.01)
    assert found[[0, 3]] == pytest.approx(found[[1, 4]], rel=1e-9)
    assert np.argmax(model.modes.participation, axis=1).tolist() == list(range(6))


@pytest.mark.parametrize(
    ("half_size", "mass", "height", "gyration"),
    [
        (0.010, 5.34e-3, 0.0133, (0.0130, 0.0141)),
        (0.014, 9.70e-3, 0.0127, (0.0135, 0.0148)),
        (0.018, 16.6e-3, 0.0146, (0.0150, 0.0168)),
    ],
)
def test_platform_data_of_a_given_half_size(half_size, mass, height, gyration):
    radii = np.array([gyration[0], gyration[0], gyration[1]])
    model = solve_frame(ELEMENT, half_size, RigidPart(mass, height, mass * radii**2))
    assert model.modes.frequency_hz == pytest.approx(list(PUBLISHED_HZ.values()), rel=0.01)
    fit = fit_platform(ELEMENT, half_size, PUBLISHED_HZ)
    assert fit.misfit < 1e-6
    assert (fit.platform.mass_kg, fit.platform.height_m) == pytest.approx((mass, height), rel=0.01)
    assert fit.platform.gyration_m == pytest.approx(radii, rel=0.01)
    assert [notice.code for notice in fit.notices] == [PLATFORM_NOT_VALIDATED.code]


def test_fit_finds_a_true_platform_and_gives_a_notice_without_one():
    stiff = {**PUBLISHED_HZ, "Tx": 2600.0, "Ty": 2600.0}  # above what a centred platform allows beside this Tz
    fit = fit_platform(ELEMENT, 0.012, stiff)
    assert fit.misfit > 0.01
    (misfit,) = (notice for notice in fit.notices if notice.code == PLATFORM_MISFIT.code)
    assert misfit.values["misfit_percent"] == pytest.approx(100.0 * fit.misfit)
    platform = join_bodies([block(2820.0, 0.013, 0.006), pillar(7850.0, 0.004, 0.02, 0.003)])
    hertz = solve_frame(ELEMENT, 0.013, platform, pieces=3).modes.frequency_hz
    found = fit_platform(ELEMENT, 0.013, dict(zip(MODE_NAMES, hertz.tolist(), strict=True))).platform
    assert (found.mass_kg, found.height_m) == pytest.approx((platform.mass_kg, platform.height_m), rel=1e-5)
    assert found.inertia_kgm2 == pytest.approx(platform.inertia_kgm2, rel=1e-5)


def test_a_heavy_platform_is_an_oscillator_on_the_static_stiffness():
    heavy = RigidPart(10.0, 0.0, np.array([1e-2, 1e-2, 2e-2]))
    model = solve_frame(ELEMENT, 0.012, heavy)
    inertia = np.array([10.0, 10.0, 10.0, *heavy.inertia_kgm2])
    expected = np.sqrt(model.stiffness / inertia) / (2.0 * np.pi)
    assert model.modes.frequency_hz == pytest.approx(expected, rel=3e-4)


def test_no_mode_is_higher_with_more_mass_or_lower_with_more_pieces():
    light, platform = block(2820.0, 0.012, 0.004), block(2820.0, 0.012, 0.005)
    first = solve_frame(ELEMENT, 0.012, light, pieces=2).modes.frequency_hz
    finer = solve_frame(ELEMENT, 0.012, light, pieces=8).modes.frequency_hz
    assert np.all(finer <= first * (1.0 + 1e-12))
    assert finer == pytest.approx(first, rel=2e-3)
    assert np.all(solve_frame(ELEMENT, 0.012, platform, pieces=2).modes.frequency_hz < first)
    rough = solve_frame(ELEMENT, 0.012, light, pieces=16, consistent=False).modes.frequency_hz
    assert rough == pytest.approx(finer, rel=3e-3)


def test_modes_of_one_frequency_are_rotated_into_the_axes():
    platform = RigidPart(0.0097, 0.0127, 0.0097 * np.array([0.0135, 0.0135, 0.0148]) ** 2)
    model = solve_frame(ELEMENT, 0.014, platform)
    shape = model.modes.shape.copy()
    for (one, other), turn in (((0, 1), 0.5), ((3, 4), 1.1)):
        c, s = np.cos(turn), np.sin(turn)
        shape[:, [one, other]] = shape[:, [one, other]] @ np.array([[c, -s], [s, c]])
    mass = model.frame.matrices[1].copy()
    mass[:6, :6] += platform.mass_matrix
    centre = np.array([0.0, 0.0, 0.0127 * 0.0097 / 0.0107])
    renamed = named_modes(model.modes.frequency_hz, shape, lambda x: mass @ x, model.frame.rigid_motions(centre))
    for mode, other in {0: 1, 1: 0, 3: 4, 4: 3, 2: None, 5: None}.items():
        motion = np.abs(renamed.shape[:6, mode])
        assert motion[mode] > 0.0, MODE_NAMES[mode]
        assert other is None or motion[other] < 1e-6 * motion[mode], MODE_NAMES[mode]


def test_inertia_of_block_and_pillar_by_summation():
    grid = (np.arange(60) + 0.5) / 60.0 - 0.5
    x, y, z = np.meshgrid(0.03 * grid, 0.03 * grid, 0.01 * grid, indexing="ij")
    found = block(2700.0, 0.015, 0.01, 0.002)
    weight = found.mass_kg / x.size
    assert found.mass_kg == pytest.approx(2700.0 * 0.03 * 0.03 * 0.01)
    assert found.inertia_kgm2[0] == pytest.approx(weight * np.sum(y**2 + z**2), rel=1e-3)
    assert found.inertia_kgm2[2] == pytest.approx(weight * np.sum(x**2 + y**2), rel=1e-3)
    column, inside = pillar(7850.0, 0.015, 0.01, 0.005), np.hypot(x, y) < 0.015
    share = column.mass_kg / inside.sum()
    assert column.height_m == pytest.approx(0.01)
    assert column.inertia_kgm2[1] == pytest.approx(share * np.sum((x**2 + z**2)[inside]), rel=3e-3)
    assert column.inertia_kgm2[2] == pytest.approx(share * np.sum((x**2 + y**2)[inside]), rel=3e-3)


@settings(max_examples=15, deadline=None)
@given(motion=st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6), heights=st.tuples(*[st.floats(-0.05, 0.05)] * 2))
def test_kinetic_energy_of_joined_parts_is_that_of_the_parts(motion, heights):
    parts = [
        RigidPart(0.02, heights[0], np.array([1e-6, 2e-6, 2.5e-6])),
        RigidPart(0.05, heights[1], np.array([4e-6, 3e-6, 5e-6])),
    ]
    velocity, turn = np.array(motion[:3]), np.array(motion[3:])
    energy = 0.0
    for part in parts:
        centre_velocity = velocity + np.cross(turn, [0.0, 0.0, part.height_m])
        energy += part.mass_kg * centre_velocity @ centre_velocity + turn @ (part.inertia_kgm2 * turn)
    whole = np.array(motion) @ join_bodies(parts).mass_matrix @ np.array(motion)
    assert whole == pytest.approx(energy, rel=1e-9, abs=1e-15)


def test_sensitivities_scale_as_dimensions_do():
    found = sensitivities(ELEMENT, 0.012, block(2820.0, 0.012, 0.006, 0.003))
    lengths = [name for name in found if name.endswith("_m")]
    total = np.sum([found[name] for name in lengths], axis=0)  # similar elements: f ~ 1/length
    total += 3.0 * found["mass_kg"] + 2.0 * found["inertia_kgm2"]
    assert total == pytest.approx(-np.ones(6), abs=2e-3)


def test_wrong_numbers_are_refused_by_name():
    for half_size in (-0.001, 0.032, 0.05):  # that leave no arm
        refused("^half_size_m: ", cross_frame, ELEMENT, half_size)
    refused("^compliant_thickness_m: ", replace, ELEMENT, compliant_thickness_m=0.0)
    refused("^poisson_ratio: ", ElasticMaterial, 72e9, 0.5, 2820.0)
    refused("^inertia_kgm2: ", RigidPart, 0.01, 0.0, np.zeros(2))
    refused("^target_hz: ", fit_platform, ELEMENT, 0.01, {"Tx": 1660.0})
