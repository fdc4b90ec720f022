"""Bodies against clouds of point masses, chains of two masses, perturbed inputs; their areas in rendered images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contracts import refused
from instrument_factory import TRUTH, moving
from scipy import ndimage
from scipy.spatial.transform import Rotation

from fusion.errors import InputError
from fusion.recording.load import load_manifest
from fusion.sensitivity.load_phasors import LoadResult, load_phasors
from fusion.sensitivity.moving_body import Body, MovingPart, load_body, make_joint, make_moving_part
from fusion.sensitivity.sensitivity_notices import ELASTIC_CORRECTED, ELASTIC_ONLY_NAMED
from fusion.simulate.preset import Preset, face_of, nominal_rig, read_preset
from fusion.simulate.world import Draws
from photogram.subsets.texture import textured_area
from photogram.synthetic.scene import render, view_of

GRAVITY = np.array([0.3, -0.2, -9.8125])


def cloud(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 1.0, 12), rng.uniform(-0.1, 0.1, (12, 3)) + np.array([0.01, -0.02, 0.05])


def part_of(mass: np.ndarray, place: np.ndarray, name: str = "cloud", u: tuple = (0.0, 0.0, 0.0)) -> MovingPart:
    centre = mass @ place / mass.sum()
    arm = place - centre
    inertia = np.einsum(
        "n,nij->ij", mass, np.sum(arm**2, 1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None]
    )
    return make_moving_part(name, mass.sum(), centre, inertia, u)


def test_kinetic_energy_of_point_masses_and_of_parts():
    # 2 T = q' M q' with v_n = v + w × r_n.
    mass, place = cloud(1)
    velocity = np.array([0.3, -1.0, 0.2, 2.0, -0.7, 1.1])
    speeds = velocity[:3] + np.cross(velocity[3:], place)
    matrix = Body((part_of(mass, place),)).mass_matrix
    assert velocity @ matrix @ velocity == pytest.approx(mass @ np.sum(speeds**2, axis=1), rel=1e-12)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-14)
    # Parts add up like their points.
    (m1, r1), (m2, r2) = cloud(2), cloud(3)
    whole = Body((part_of(np.concatenate([m1, m2]), np.concatenate([r1, r2])),)).mass_matrix
    np.testing.assert_allclose(Body((part_of(m1, r1), part_of(m2, r2))).mass_matrix, whole, atol=1e-13)


def test_wrench_by_newton_and_euler_on_a_really_moving_cloud():
    # Sum over points of m (r'' - g), and of its moment, turned into body axes: first harmonic of one period.
    mass, place = cloud(4)
    frequency = 20.0
    omega = 2 * np.pi * frequency
    shift, turn = np.array([2.0, -1.0, 3.0]) * 1e-6, np.array([1.0, 2.0, -1.5]) * 1e-5
    phase = 0.4
    period, step = 1 / frequency, 1e-5
    times = np.arange(64) * period / 64

    def position(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, Rotation]:
        rotation = Rotation.from_rotvec(turn * np.cos(omega * t + phase)[:, None])
        origin = shift * np.cos(omega * t)[:, None]
        points = origin[:, None] + np.einsum("tij,nj->tni", rotation.as_matrix(), place)
        return points, origin, rotation

    here, origin, rotation = position(times)
    acceleration = (position(times + step)[0] - 2 * here + position(times - step)[0]) / step**2
    force = mass[:, None] * (acceleration - GRAVITY)
    total = force.sum(axis=1)
    moment = np.cross(here - origin[:, None], force).sum(axis=1)
    wrench = np.hstack([rotation.inv().apply(total), rotation.inv().apply(moment)])
    measured = 2 / 64 * np.exp(-1j * omega * times) @ wrench
    motion = -(omega**2) * np.concatenate([shift, turn * np.exp(1j * phase)])
    matrix = Body((part_of(mass, place),), gravity_mps2=GRAVITY).load_matrix(np.array([frequency]))[0]
    np.testing.assert_allclose(matrix @ motion, measured, rtol=0, atol=2e-6 * np.abs(measured).max())
    bare = Body((part_of(mass, place),)).mass_matrix
    assert np.abs(bare @ motion - measured).max() > 1e-4 * np.abs(measured).max()


@pytest.mark.parametrize("gravity", [None, GRAVITY])
@pytest.mark.parametrize("air_share", [0.0, 0.2])
def test_parameter_changes_are_derivatives(gravity, air_share):
    part = replace(part_of(*cloud(5), u=(1e-5, [1e-6, 2e-6, 3e-6], 1e-7)), air_share=air_share)
    frequency = np.array([30.0])
    whole = Body((part,), gravity_mps2=gravity)
    base, parameters = whole.load_matrix(frequency), whole.matrix_changes(frequency)
    assert len(parameters) == 1 + 3 + 6 + (air_share > 0.0)
    shifted = replace(part, mass_kg=part.mass_kg + 1e-5)
    expected = replace(whole, parts=(shifted,)).load_matrix(frequency) - base
    np.testing.assert_allclose(parameters[0].effect, expected, atol=1e-12)
    for axis in range(3):
        shifted = replace(part, centre_of_mass_m=part.centre_of_mass_m + np.eye(3)[axis] * part.u_centre_of_mass_m)
        expected = replace(whole, parts=(shifted,)).load_matrix(frequency) - base
        np.testing.assert_allclose(parameters[1 + axis].effect, expected, atol=1e-9)
    assert np.count_nonzero(parameters[4].effect) == 1
    assert np.count_nonzero(parameters[7].effect) == 2


def test_refusals_name_the_argument():
    told = r"centre_of_mass_m: expected an array of shape \(3\), found \(2,\)"
    refused(told, make_moving_part, "p", 1.0, [0.0, 0.0], np.zeros((3, 3)))
    refused("symmetric", make_moving_part, "p", 1.0, np.zeros(3), [[0, 1e-3, 0], [0, 0, 0], [0, 0, 0]])


FREQUENCY = np.array([106.25, 1000.0])
MOVING = moving(frequency=FREQUENCY)
PULL = np.array([0.3, 0.1, -9.8125])
UPPER = ("load", 6.96, [1e-3, 2e-3, 0.05], np.diag([0.036, 0.036, 0.031]))
LOWER = ("internal mass", 0.77, [0.0, 1e-3, -0.01], np.diag([1e-4, 1e-4, 2e-4]))


def load_on(frequency: float, u: float = 0.0, damping: float = 0.0) -> LoadResult:
    parts = make_moving_part(*UPPER), make_moving_part(*LOWER, below_joint=True)
    return load_phasors(MOVING, Body(parts, make_joint(frequency, u, damping), PULL))


def test_force_below_an_elastic_joint_is_that_of_a_chain_of_two_masses():
    # Sensor spring under m, joint (k, b) between m and M: the sensor's force is what moves both, F = M a_M + m a_m.
    upper, lower, resonance, damping = 6.96, 0.77, 3500.0, 0.02
    stiffness = upper * (2.0 * np.pi * resonance) ** 2
    damper = 2.0 * damping * upper * 2.0 * np.pi * resonance
    omega = 2.0 * np.pi * FREQUENCY
    coupling = stiffness + 1j * omega * damper
    force = np.empty(2, complex)
    for line, w in enumerate(omega):
        # Unknown displacements of both masses for a unit force at the bottom of the lower one.
        chain = np.array(
            [[coupling[line] - w**2 * lower, -coupling[line]], [-coupling[line], coupling[line] - w**2 * upper]]
        )
        _, above = np.linalg.solve(chain, [1.0, 0.0])
        force[line] = 1.0 / (-(w**2) * above) * TRUTH[line, 2]
    parts = (
        make_moving_part("load", upper, [0, 0, 0], np.zeros((3, 3))),
        make_moving_part("m", lower, [0, 0, 0], np.zeros((3, 3)), below_joint=True),
    )
    found = load_phasors(MOVING, Body(parts, make_joint(resonance, 10.0, damping)))
    np.testing.assert_allclose(found.value[:, 2], force, rtol=1e-12)
    assert abs(found.value[1, 2] / (7.73 * TRUTH[1, 2])) == pytest.approx(1.0 - 0.0081, abs=2e-4)
    notice = found.notices[0]
    assert (notice.code, notice.values["load"]) == (ELASTIC_CORRECTED.code, "Fz")
    assert "3500 Hz" in notice.values["parts"]
    assert notice.values["change_percent"] == pytest.approx(-0.81, abs=0.005)
    assert notice.values["frequency_hz"] == 1000.0
    assert notice.values["moving"] == "the part above the joint"


def test_a_joint_is_one_unknown_per_component_and_mounting():
    base, step = load_on(3500.0, 50.0, 0.01), load_on(3500.1, 50.0, 0.01)
    unknowns = [i for i in base.uncertainty.influences if i.label == "joint of the load"]
    assert [(i.u, i.unit, i.scope) for i in unknowns] == [(50.0, "Hz", "mounting")] * 6
    assert len({i.name for i in unknowns}) == 6
    change = (step.value - base.value) / 0.1 * 50.0
    total = np.sum([i.effect for i in unknowns], axis=0)
    np.testing.assert_allclose(total[:, :6] + 1j * total[:, 6:], change, rtol=2e-4, atol=1e-9)


def test_a_joint_that_is_only_named_corrects_nothing_and_is_uncertain_as_a_whole():
    named, stated, rigid = load_on(3500.0), load_on(3500.0, 1e-9), load_on(1e9, 1.0)
    np.testing.assert_allclose(named.value, rigid.value, rtol=1e-9)
    assert named.notices[0].code == ELASTIC_ONLY_NAMED.code
    assert named.notices[0].values["frequency_hz"] == 3500.0
    total = np.sum([i.effect for i in named.uncertainty.influences], axis=0)
    np.testing.assert_allclose(total[:, :6] + 1j * total[:, 6:], (stated.value - rigid.value) / np.sqrt(3.0), rtol=1e-5)


def test_weight_in_air_and_the_air_moved_along():
    # A cube of 1 kg/dm³ in air of 1.2 kg/m³: tilted, it is carried by 0.9988 of its weight; moved, it takes air along.
    share = 1.2 / 1000.0
    cube = "load", 2.0, [0.0, 0.0, 0.04], np.zeros((3, 3))
    body, bare = (Body((make_moving_part(*cube, air_share=s),), gravity_mps2=PULL) for s in (share, 0.0))
    tilt, expected = (b.load_matrix(FREQUENCY) - b.weightless.load_matrix(FREQUENCY) for b in (body, bare))
    np.testing.assert_allclose(tilt, (1.0 - share) * expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(body.mass_matrix, bare.mass_matrix * (1.0 + 0.5 * share), rtol=1e-12)
    (air,) = body.matrix_changes(FREQUENCY)
    assert air.label == "load: air moved along"
    assert air.u == pytest.approx(2.0 * share * 0.5 / np.sqrt(3.0))
    np.testing.assert_allclose(air.effect, bare.weightless.load_matrix(FREQUENCY) * air.u / 2.0)


def test_uncertain_gravity_acts_through_the_tilt_only():
    parts = make_moving_part(*UPPER), make_moving_part(*LOWER, below_joint=True)
    for joint in (None, make_joint(3500.0, 50.0)):
        body = Body(parts, joint, PULL, (0.02, 0.0, 0.01))
        base = load_phasors(MOVING, body)
        found = {i.name: i for i in base.uncertainty.influences if i.label == "gravity"}
        assert set(found) == {"gravity x", "gravity z"}
        shifted = load_phasors(MOVING, replace(body, gravity_mps2=PULL + np.array([0.02, 0.0, 0.0])))
        change, effect = shifted.value - base.value, found["gravity x"].effect
        np.testing.assert_allclose(effect[:, :6] + 1j * effect[:, 6:], change, rtol=1e-6, atol=1e-12)
        assert found["gravity z"].scope == "rig"


def test_names_tell_another_load_and_another_place_from_the_same():
    def names(mass: float, height: float) -> set[str]:
        part = make_moving_part("load", mass, [0.0, 0.0, height], np.eye(3), (1e-3, 1e-4, 1e-5))
        return {change.name for change in Body((part,)).matrix_changes(FREQUENCY)}

    assert names(7.0, 0.05) == names(7.0, 0.05)
    assert not names(7.0, 0.05) & names(3.0, 0.05)
    moved = names(7.0, 0.05) & names(7.0, 0.06)
    assert len(moved) == 7  # the mass and six elements of the inertia
    scopes = {c.label: c.scope for c in Body((make_moving_part(*UPPER, (1e-3, 1e-4, 1e-5)),)).matrix_changes(FREQUENCY)}
    assert scopes == {"load: mass": "rig", "load: centre of mass": "mounting", "load: inertia": "rig"}


def test_manifest_states_joint_air_and_parts_below(make_campaign):
    folder = make_campaign(
        replace=(
            ("rig.toml", "mass = 6.9605 ", 'mass_kind = "conventional"\ndensity = 2700.0\nelastic_frequency = 3500.0\n'
             "elastic_frequency_uncertainty = [0, 0, 100, 0, 0, 0]\nelastic_damping = 0.01\nmass = 6.9605 "),
            ("rig.toml", "mass = 0.412", "below_joint = true\nmass = 0.412"),
        )
    )  # fmt: skip
    manifest = load_manifest(folder / "recording.toml")
    body = load_body(manifest.rig, manifest.part)
    assert [part.below_joint for part in body.parts] == [False, True, True]
    assert body.parts[0].mass_kg == pytest.approx(6.9605 * (1.0 - 1.2 / 8000.0) / (1.0 - 1.2 / 2700.0), rel=1e-12)
    assert [part.air_share for part in body.parts] == pytest.approx([1.19 / 2700.0, 0.0, 0.0])
    assert body.joint.u_frequency_hz.tolist() == [0, 0, 100, 0, 0, 0]
    assert body.joint.damping == 0.01
    manifest = load_manifest(make_campaign() / "recording.toml")
    assert load_body(manifest.rig, manifest.part).joint is None


@pytest.mark.parametrize("value", ["0.0", "[1.0, 2.0, 3.0]", "[1, 2, 3, 4, 5, -6]"])
def test_a_resonance_is_above_zero(make_campaign, value):
    folder = make_campaign(replace=(("rig.toml", "mass = 6.9605 ", f"elastic_frequency = {value}\nmass = 6.9605 "),))
    refused("elastic_frequency", load_manifest, folder / "recording.toml", error=InputError)


BORDER_PX = 5  # beside the image's border nothing is tracked: the body would move out of the image


@pytest.mark.parametrize(("preset", "pair"), [("nitsche2018", 0), ("demo", 1)])
def test_the_body_is_covered_and_its_rim_left_out(preset, pair):
    """At least 98 % of what lies more than 2 px inside the rim, and nothing outside of that."""
    setup = read_preset(Preset, preset).stereo[pair]
    rig, sensor_from_left = nominal_rig(setup)
    view = view_of(rig.left, sensor_from_left.inverse())
    face = face_of(setup, False, Draws(1, True).stream("speckle"))
    rest, once = np.zeros((1, 6)), np.ones(1)
    image = setup.sensor.digitise(render(view, face, rest, once), np.random.default_rng(2))
    plain = replace(face, dark=1.0, bright=1.0, background=0.0)
    body = render(replace(view, light=np.ones_like(view.light)), plain, rest, once, 1) > 0.5
    inside = ndimage.distance_transform_edt(np.pad(body, 9, mode="edge"))[9:-9, 9:-9] > 2.5
    area = textured_area(image)
    assert area[inside].mean() > 0.98
    middle = (slice(BORDER_PX, -BORDER_PX), slice(BORDER_PX, -BORDER_PX))
    assert not np.any(area[middle] & ~inside[middle])
