"""Deformation in shapes: is there any, how many, and what measured modes make of a load; by Monte Carlo."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from contracts import refused

from fusion.errors import InputError
from fusion.phasors.deformation import ShapePhasors, shape_phasors
from fusion.phasors.phasor_notices import PAIR_BODY_DEFORMS
from fusion.planning.check import _measured_modes
from fusion.recording.load import load_manifest
from fusion.recording.rig import Elastic
from fusion.sensitivity.mode_shapes import elastic_part, mode_shapes, stated_modes
from fusion.sensitivity.moving_body import Body, with_measured_modes
from fusion.sensitivity.sensitivity_notices import MODES_CONTRADICT
from photogram.direct.surface import PlainShapes, ShapeAmplitudes
from shaker.sine.phasor import Phasors

SHAPES = PlainShapes(np.zeros(3), np.eye(3), 0.05)
TIME_S = 0.3 + np.arange(90) / 52.61
LINES_HZ = np.array([106.25, 212.5])
NO_EFFECT = np.zeros((0, 2, 6), np.complex128)
ROOT = np.tril(np.random.default_rng(5).normal(size=(6, 6))) * 1e-8 + 2e-8 * np.eye(6)


def shapes_of(rng: np.random.Generator, moved: np.ndarray, noise: np.ndarray | None = None) -> ShapePhasors:
    """Amplitudes of noise with the lines `moved` (K, 6) in them."""
    series = rng.standard_normal((len(TIME_S), 6)) @ ROOT.T if noise is None else noise
    turn = np.exp(2j * np.pi * np.multiply.outer(TIME_S, LINES_HZ))
    series = series + (turn @ moved).real
    series[0] = np.nan  # the first frame is the reference
    amplitudes = ShapeAmplitudes(SHAPES, series, np.broadcast_to(np.eye(6), (len(series), 6, 6)), np.zeros((6, 6)))
    found = shape_phasors(TIME_S, LINES_HZ, amplitudes, 0.0, NO_EFFECT)
    assert found is not None
    return found


def test_a_rigid_body_seldom_seems_to_deform():
    rng, draws = np.random.default_rng(1), 100
    found = [shapes_of(rng, np.zeros((2, 6))) for _ in range(draws)]
    assert sum(bool(each.deforms.any()) for each in found) <= 5  # of 100 at 1 %: more once in 1000 tries
    assert sum(each.modes > 0 for each in found) <= 5


def test_noise_that_is_louder_around_a_line_alarms_no_more():
    """Air and lamps: slow noise, whose density around the alias of 212.5 Hz is above that of all frames."""
    rng, draws, alarms = np.random.default_rng(2), 60, 0
    for _ in range(draws):
        slow = np.cumsum(rng.standard_normal((len(TIME_S), 6)), axis=0) * 0.2
        alarms += bool(shapes_of(rng, np.zeros((2, 6)), (slow - slow.mean(axis=0)) @ ROOT.T).deforms.any())
    assert alarms <= 0.05 * draws


def test_deformation_is_found_with_its_amplitude_phase_and_number_of_shapes():
    rng = np.random.default_rng(3)
    one, two = np.zeros((2, 6), np.complex128), np.zeros((2, 6), np.complex128)
    one[0] = 4e-8 * np.exp(0.7j) * np.array([1.0, 0.5, 0, 0, 0, 0])
    two[0], two[1, 4] = one[0], 5e-8j
    for moved, count in ((one, 1), (two, 2)):
        found = [shapes_of(rng, moved) for _ in range(16)]
        assert sum(each.modes == count for each in found) >= 14
        assert all(each.deforms[0] for each in found)
        value = np.array([each.phasors.value[0, 0] for each in found])
        u = np.mean([each.u_size[0, 0] for each in found])
        assert abs(value.mean() - moved[0, 0]) < 4 * u * np.sqrt(2.0 / len(value))
        assert np.sqrt(np.mean(np.abs(value - moved[0, 0]) ** 2) / 2) == pytest.approx(u, rel=0.25)
        (notice, *_) = found[0].notices()
        assert (notice.code, notice.values["shape"]) == (PAIR_BODY_DEFORMS.code, "bowl")
        expected = 1e9 * abs(found[0].phasors.value[0, found[0].phasors.channels.index("bowl")])
        assert notice.values["amplitude_nm"] == pytest.approx(expected)


def test_what_all_frames_share_is_no_deformation():
    """An unknown of the calibration that explains the amplitude takes the alarm off."""
    rng, moved = np.random.default_rng(4), np.zeros((2, 6), np.complex128)
    moved[0, 0] = 4e-8
    found = shapes_of(rng, moved)
    assert found.deforms[0]
    effect = np.zeros((2, 2, 6), np.complex128)
    effect[0, 0, 0], effect[1, 0, 0] = 4e-8, 4e-8j
    turn = np.exp(2j * np.pi * np.multiply.outer(TIME_S, LINES_HZ))
    series = rng.standard_normal((len(TIME_S), 6)) @ ROOT.T + (turn @ moved).real
    amplitudes = ShapeAmplitudes(SHAPES, series, np.broadcast_to(np.eye(6), (len(series), 6, 6)), np.zeros((6, 6)))
    shared = shape_phasors(TIME_S, LINES_HZ, amplitudes, 0.0, effect)
    assert shared is not None
    assert not shared.deforms.any()


# A plate on the load whose natural frequency is not the stated one, seen by a pair of cameras.

PLATE = Elastic(
    name="plate",
    shape="plate",
    foot=(0.0, 0.0, 0.09),
    axis=(0.0, 0.0, 1.0),
    thickness=0.012,
    diameter=0.11,
    clamped_diameter=0.02,
    young_modulus=7e10,
    density=2700.0,
    frequencies_uncertainty=0.08,
    measured_by=("top",),
)
HERTZ = np.array([1020.3])
FOOT = np.array([[0.4, -0.3j, 200.0, 2.0, 1.0j, 0.5]]) * np.exp(0.4j)
SHARE = np.array([[0.0], [0.09], [0.45], [0.9], [0.0], [0.0]])


def seen_plate(rng: np.random.Generator, off: float, u_m: float) -> tuple[SimpleNamespace, np.ndarray]:
    """What a pair sees of the plate with natural frequencies `off` by so much, and what the plate pulls, (6,)."""
    true, shapes = (
        stated_modes(PLATE, {"frequencies": 1.0 + off}),
        mode_shapes(SimpleNamespace(elastic=(PLATE,)), "top"),
    )
    assert shapes is not None
    (part,) = shapes.parts
    r = HERTZ[:, None] / true.frequency_hz
    moved = r**2 / (1.0 - r**2) * (FOOT @ true.participation.T)  # (K, N), no damping
    size, square = part.size, -((2.0 * np.pi * HERTZ[:, None]) ** 2)
    amplitude = moved[:, list(part.which)] * size / square
    share = np.concatenate([SHARE, np.zeros((6, 2))], axis=1)
    rigid = FOOT / square + amplitude @ share.T
    noise = u_m * (rng.standard_normal((1, 3)) + 1j * rng.standard_normal((1, 3)))
    value = amplitude + noise
    phasors = Phasors(HERTZ, value, u_m**2 * np.eye(6)[None], shapes.names, ("m",) * 3, np.array([200.0]))
    found = ShapePhasors(phasors, np.zeros((0, 1, 3), np.complex128), share, np.ones(1), np.ones(1), 1)
    face = SimpleNamespace(reference_m=np.array([[0.0, 0.0, 0.09]]))
    seen = SimpleNamespace(frequency_hz=HERTZ, value=rigid)
    pair = SimpleNamespace(
        name="top", body="load", usable=np.array([True]), phasors=seen, surface=(face,), shapes=found
    )
    return pair, np.asarray((moved @ true.participation)[0])


def pulled(body: Body) -> tuple[complex, float]:
    """Force along z of the plate at the foot's motion, and its standard uncertainty, of real and imaginary part."""
    part = body.elastic[0]
    force = (part.act(lambda modes: modes.wrench(HERTZ)) @ FOOT[0])[0, 2]
    changes = [(change.effect @ FOOT[0])[0, 2] for change in part.changes(lambda modes: modes.wrench(HERTZ))]
    turn = np.conj(force) / abs(force)
    return force, float(np.sqrt(sum((change * turn).real ** 2 for change in changes)))


def test_a_measured_mode_has_the_force_that_it_has_and_the_uncertainty_that_it_needs():
    rng, draws, load = np.random.default_rng(7), 20, SimpleNamespace(elastic=(PLATE,))
    stated = Body((), elastic=(elastic_part(PLATE),))
    u_stated = pulled(stated)[1]
    for u_m in (4e-9, 40e-9):
        errors = []
        for _ in range(draws):
            pair, force = seen_plate(rng, 0.08 * rng.standard_normal(), u_m)
            measured, _ = with_measured_modes(stated, load, (pair,))
            value, u = pulled(measured)
            errors.append(((value - force[2]) / value * abs(value)).real / u)
            assert u < u_stated
        inside = np.count_nonzero(np.abs(errors) < 1.96)
        assert inside >= 15  # 95 % of 20: fewer once in 1000 tries
        assert 0.6 < np.std(errors) < 1.5


def test_a_response_that_contradicts_what_is_stated_stands_alone():
    pair, force = seen_plate(np.random.default_rng(8), -0.4, 4e-9)
    stated = Body((), elastic=(elastic_part(PLATE),))
    measured, (notice,) = with_measured_modes(stated, SimpleNamespace(elastic=(PLATE,)), (pair,))
    value, u = pulled(measured)
    assert abs(value - force[2]) < 4 * u < 0.2 * abs(value)
    assert notice.code == MODES_CONTRADICT.code
    assert notice.values["frequency_hz"] == pytest.approx(1020.3)


def test_where_a_pair_tells_nothing_what_is_stated_stays():
    pair, _ = seen_plate(np.random.default_rng(9), 0.05, 4e-9)
    stated = Body((), elastic=(elastic_part(PLATE),))
    for other in (SimpleNamespace(**{**vars(pair), "body": "base"}), SimpleNamespace(**{**vars(pair), "shapes": None})):
        same, reported = with_measured_modes(stated, SimpleNamespace(elastic=(PLATE,)), (other,))
        assert reported == ()
        assert pulled(same) == pulled(stated)


def test_modes_of_a_table_lie_on_its_surface_and_those_of_a_drawing_on_it(tmp_path):
    """Between the points of a table a mode is smooth; a plate's shapes are those of its own formula."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    x, y = (np.outer(np.linspace(0.1, 1.0, 10), turn(angle)).ravel() * 0.05 for turn in (np.cos, np.sin))
    up = 3.0 * (x**2 + y**2) / 0.05**2
    table = np.column_stack([x, y, np.full_like(x, 0.09), 0.0 * x, 0.0 * x, up])
    rows = "\n".join(",".join(f"{number:.9g}" for number in row) for row in table)
    (tmp_path / "mode.csv").write_text(f"x,y,z,ux,uy,uz\n{rows}\n", encoding="utf-8")
    mode = SimpleNamespace(surface=tmp_path / "mode.csv")
    tabled = SimpleNamespace(
        name="face", shape="modes", mode=(SimpleNamespace(surface=None), mode), measured_by=("top",)
    )
    shapes = mode_shapes(SimpleNamespace(elastic=(tabled, PLATE)), "top")
    assert shapes is not None
    assert shapes.names == ("face: mode 2", "plate: axial", "plate: bending 1", "plate: bending 2")
    points = np.array([[0.013, 0.021, 0.09], [-0.04, 0.002, 0.09], [np.nan, 0.0, 0.09]])
    moved = shapes(points)
    expected = np.sum(points[:2, :2] ** 2, axis=1) / 0.05**2
    np.testing.assert_allclose(moved[0, :2, 2], expected, atol=0.01)
    assert np.abs(moved[0, :2, :2]).max() < 1e-9
    assert np.isnan(moved[0, 2]).all()
    rim = shapes(np.array([[0.055, 0.0, 0.09], [0.0, 0.055, 0.09]]))
    np.testing.assert_allclose(np.abs(rim[1, :, 2]), 1.0, rtol=1e-9)  # the umbrella, alike all around
    assert sorted(np.abs(rim[2:, 0, 2]).round(6)) == [0.0, 1.0]  # one bends about x, one about y
    assert mode_shapes(SimpleNamespace(elastic=(tabled, PLATE)), "other") is None
    mode.surface.write_text("x,y,z,ux,uy\n1,2,3,4,5\n", encoding="utf-8")
    refused("mode.csv", mode_shapes(SimpleNamespace(elastic=(tabled,)), "top"), points, error=InputError)


def test_check_tells_of_a_table_that_tells_no_surface(make_campaign):
    block = (
        '[[load.elastic]]\nname = "plate"\nshape = "modes"\nfrequencies_uncertainty = 0.1\nmeasured_by = ["top"]\n'
        '[[load.elastic.mode]]\nfrequency = 900.0\nparticipation = [0, 0, 1, 0, 0, 0]\nsurface = "mode.csv"\n'
        "displacement = { top = [0, 0, 1] }\n\n[[part]]"
    )
    folder = make_campaign(replace=(("rig.toml", "[[part]]", block),))
    (folder.parent / "mode.csv").write_text("x,y,z,ux,uy\n1,2,3,4,5\n", encoding="utf-8")
    reported = _measured_modes(load_manifest(folder), (load_manifest(folder),))
    assert len(reported[0]) == 1
    assert "plate: mode 1" in reported[0][0]
    assert "mode.csv" in reported[1][0]
