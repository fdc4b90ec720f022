"""`shakercal load` from simulated releases with several loads, and from published resonances."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from page_outline import self_contained
from release_factory import two_masses
from scipy.signal import StateSpace, lsim
from support import edit, rows

from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.load import load_manifest
from fusion.report.h5 import read_notices
from fusion.sensor import model_notices as raised
from fusion.sensor.load.load_evaluation import MOVING_MASS_LABEL, LoadSettings, evaluate_loads, read_series, read_table
from fusion.sensor.load.load_models_report import parameter_rows
from fusion.sensor.model_files import LOAD_MODEL_FILE, UncertaintyBasis, model_text, read_load_models, read_loads
from fusion.simulate.preset import read_preset
from fusion.simulate.releases import SeriesRig, true_modes, write_loads
from shaker.release.load_model import LoadModel
from shaker.release.load_response import pole_responses

PUBLISHED = ((0.0, 500.0), (0.008, 486.0), (0.048, 450.0), (0.098, 393.0), (0.198, 320.0))
PARAMETERS = ("stiffness", "damping", "coupling_stiffness", "coupling_damping")


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five loads, evaluated with two predictions."""
    folder = tmp_path_factory.mktemp("loads") / "series"
    assert main(["simulate", str(folder), "--preset", "loads", "--seed", "3"]) == 0
    options = ["--load-mass", "0.13", "0.3", "--wanted", "400"]
    assert main(["load", str(folder), *options, "-q"]) == 0
    return folder


def test_parameters_meet_the_truth(campaign):
    truth = json.loads((campaign / "truth.json").read_text(encoding="utf-8"))
    table = {row["name"].partition(":")[0]: row for row in rows(campaign / "load" / "parameters.csv")}
    for name, bar in zip(PARAMETERS, (1e-3, 1e-2, 1e-3, 2e-2), strict=True):
        value, u = float(table[name]["value"]), float(table[name]["u"])
        assert value == pytest.approx(truth[name], rel=bar)
        assert abs(value - truth[name]) < 3.5 * u
        assert float(table[name]["u_given_masses"]) <= u
    mass = table["moving_mass"]
    assert abs(float(mass["value"]) - truth["moving_mass_kg"]) < 3.5 * float(mass["u"])
    assert float(mass["u"]) < 5e-5
    assert float(table["sensitivity"]["value"]) == pytest.approx(truth["sensitivity"], rel=2e-3)
    assert float(table["formula_limit"]["value"]) == pytest.approx(0.0817, abs=2e-4)
    assert float(table["frequency_limit"]["value"]) == pytest.approx(0.0924, abs=2e-4)


def test_resonances_over_the_load(campaign):
    table = rows(campaign / "load" / "load.csv")
    recorded = [row for row in table if row["kind"] == "recorded"]
    assert [row["recording"] for row in recorded] == [f"step-{grams:03d}g" for grams in (0, 8, 48, 98, 198)]
    for row in recorded:
        truth = json.loads((campaign / row["recording"] / "truth.json").read_text(encoding="utf-8"))
        first, *second = truth["frequency_hz"]
        assert abs(float(row["first_hz"]) - first) < 2.0 * float(row["U_first_hz"])
        assert float(row["measured_first_hz"]) == pytest.approx(first, rel=2e-5)
        band, expanded = float(row["band_10_hz"]), float(row["U_band_10_hz"])
        assert 1e-7 < expanded / band < 1e-3
        assert not second or float(row["second_hz"]) == pytest.approx(second[0], rel=1e-3)
        assert float(row["damping_first"]) == pytest.approx(truth["damping_ratio"][0], rel=5e-3)
    heaviest = recorded[-1]
    assert float(heaviest["formula_hz"]) / float(heaviest["measured_first_hz"]) == pytest.approx(1.154, abs=2e-3)
    assert [float(row["load_mass"]) for row in table if row["kind"] == "predicted"] == [0.13, 0.3]


def test_models_come_back_to_the_last_bit_and_the_page_is_complete(campaign):
    ((model, rests),) = read_loads(campaign / "load")
    assert rests.scope == "for these 5 releases in one mounting"
    with h5py.File(campaign / "load" / "load.h5") as file:
        group = file["components/Fy/solution_1/model"]
        assert model.stiffness == group.attrs["stiffness"]
        for name in ("covariance", "covariance_with_mass"):
            np.testing.assert_array_equal(getattr(model, name), group[name][()])
        assert file["components/Fy"].attrs["from_records"]
        assert raised.EXTRAPOLATED_LOAD.code in {notice.code for notice in read_notices(file)}
    page = (campaign / "load" / "load.html").read_text(encoding="utf-8")
    self_contained(page)
    assert all(word in page for word in ("±10 %", "N/m"))
    assert model.component == "Fy"
    assert model.load_masses == pytest.approx((0.0, 0.008, 0.048, 0.098, 0.198))
    written = model_text([(model, rests)], "c", "s", "p")
    assert json.loads(written)["models"] == json.loads((campaign / "load" / LOAD_MODEL_FILE).read_text())["models"]


@pytest.mark.usefixtures("no_pages")
def test_one_load_gives_two_solutions(campaign, tmp_path, capsys):
    assert main(["load", str(campaign / "step-048g"), "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert all(f"solution {number} of 2" in printed for number in (1, 2))
    first, second = read_load_models(tmp_path / "out" / LOAD_MODEL_FILE)
    assert (first.solutions, first.solution, second.solution) == (2, 1, 2)
    assert first.stiffness == pytest.approx(2.36e6, rel=2e-3)
    assert second.stiffness == pytest.approx(1.134e7, rel=2e-3)
    assert second.coupling_stiffness == pytest.approx(3.933e5, rel=2e-3)


@pytest.fixture
def table(tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that writes a table of resonances."""

    def write(text: str) -> Path:
        (tmp_path / "table.csv").write_text(text, encoding="utf-8")
        return tmp_path / "table.csv"

    return write


@pytest.mark.usefixtures("no_pages")
def test_published_table(table, tmp_path):
    lines = "\n".join(f"{mass};{hertz}" for mass, hertz in reversed(PUBLISHED))
    path = table(f"# Fig. 4\nload_mass_kg;frequency_hz\n{lines}\n")
    assert main(["load", "--frequencies", str(path), "--moving-mass", "0.24"]) == 0
    (model,) = read_load_models(tmp_path / "load")
    assert model.stiffness == pytest.approx(2.355e6, rel=1e-3)
    assert model.coupling_stiffness == pytest.approx(1.892e6, rel=1e-3)
    for row in rows(tmp_path / "load" / "load.csv")[:5]:
        assert abs(float(row["first_hz"]) / float(row["measured_first_hz"]) - 1.0) < 0.01
        assert row["damping_first"] == ""


def test_second_resonances_and_uncertainties_of_a_table(table):
    head = "load_mass_kg,frequency_hz,u_frequency_hz,second_hz,u_load_mass_kg"
    series = read_table(table(f"{head}\n0.048,446.43,0.05,1116.45,1e-5\n0,499.08,,,\n"), 0.24, 1e-4)
    assert series.names == ("row 2", "row 1")
    np.testing.assert_array_equal(series.measured.frequency_hz, [[499.08, np.nan], [446.43, 1116.45]])
    np.testing.assert_allclose(series.masses.u_load, [0.0, 1e-5])
    assert series.masses.names[0] == "moving mass"


@pytest.mark.parametrize(
    ("text", "declared", "key", "values"),
    [
        ("mass,frequency_hz\n1,2\n", raised.LOAD_COLUMN_MISSING, "load_mass_kg", {}),
        ("load_mass_kg,frequency_hz,colour\n1,2,3\n", raised.UNKNOWN_LOAD_COLUMN, "colour", {}),
        ("load_mass_kg,frequency_hz\n0.1,\n", raised.WRONG_LOAD_NUMBER, "frequency_hz, row 1", {"found": "no value"}),
        ("load_mass_kg,frequency_hz\n" + "0.1,80\n" * 101, raised.TOO_MANY_LOADS, "", {"found": 101, "limit": 100}),
        ("load_mass_kg,frequency_hz\n" + "1" * 200_000 + ",5\n", raised.LOAD_TABLE_NOT_READABLE, "", {}),
        ("load_mass_kg,frequency_hz\n0.1,x\n", raised.WRONG_LOAD_NUMBER, "frequency_hz, row 1", {"found": "x"}),
        ("load_mass_kg,frequency_hz\n-1,4\n", raised.WRONG_LOAD_NUMBER, "load_mass_kg, row 1", {"found": "-1"}),
        ("", raised.LOAD_COLUMN_MISSING, "load_mass_kg", {}),
    ],
)
def test_wrong_tables(table, text, declared, key, values):
    with pytest.raises(InputError) as caught:
        read_table(table(text), 0.24, 0.0)
    assert (caught.value.code, caught.value.key) == (declared.code, key)
    assert caught.value.values.items() >= values.items()


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["load"], "--frequencies"),
        (["load", "--frequencies", "t.csv"], "--moving-mass"),
        (["load", "folder", "--moving-mass", "0.1"], "--moving-mass"),
        (["load", "folder", "--permitted", "120"], "100 %"),
    ],
)
def test_wrong_arguments(arguments, option, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert option in capsys.readouterr().err


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """Two loads, 0.2 s each, whose files a test may change."""
    write_loads(tmp_path, 5, read_preset(SeriesRig, "loads", loads_g=(0, 48), duration_s=0.2))
    return tmp_path


def read(folder: Path, *grams: int):
    """The series of the recordings with some loads, and their notices."""
    return read_series([load_manifest(folder / f"step-{load:03d}g") for load in grams])


COVER = '\n[[part]]\nname = "cover"\nbody = "load"\nmass = 0.1\ncentre_of_mass = [0.0, 0.0, 0.0]\n'


@pytest.mark.parametrize(
    ("old", "new", "grams", "declared", "key", "values"),
    [
        (
            "internal_mass = 0.24",
            "internal_mass = 0.25",
            (0, 48),
            raised.CONTRADICTORY_MOVING_MASS,
            "sensor.internal_mass",
            {"expected": 0.25, "file": "rig-000g.toml", "found": 0.24},
        ),
        (
            "internal_mass = 0.24",
            "internal_mass = 0.0",
            (0,),
            raised.NO_MOVING_MASS,
            "sensor.internal_mass",
            {"found": 0.0},
        ),
        ("\n[sensor]", f"{COVER}[sensor]", (0,), raised.PART_WITHOUT_LOAD, "load", {"part": "cover"}),
    ],
)
def test_wrong_rigs(short, old, new, grams, declared, key, values):
    edit(short / "rig-000g.toml", old, new)
    with pytest.raises(InputError) as caught:
        read(short, *grams)
    assert (caught.value.code, caught.value.key, caught.value.values) == (declared.code, key, values)


def test_influences_stated_by_one_rig_are_included_in_every_u(short):
    (plain,), _ = read(short, 0, 48)
    rigs = [short / f"rig-{grams:03d}g.toml" for grams in (0, 48)]
    stated = "\n[model.mounting]\nfrequency_uncertainty = {}\n\n[model.temperature]\ndifference_uncertainty = 5.0\n"
    rigs[1].write_text(rigs[1].read_text(encoding="utf-8") + stated.format(1e-3), encoding="utf-8")
    (series,), _ = read(short, 0, 48)
    narrow, wide = (evaluate_loads("loads", (one,), (), LoadSettings(), {}) for one in (plain, series))
    scope = "for these 2 releases in one mounting, with mounting anew and another temperature as stated"
    assert series.influences.scope == scope
    assert series.influences.outside == "a model of another structure"
    for before, after in zip(narrow.components, wide.components, strict=True):
        small, large = (one.solutions[0].recorded for one in (before, after))
        expected = np.hypot(small.u_frequency_hz[:, 0], 1e-3 * small.frequency_hz[:, 0])
        np.testing.assert_allclose(large.u_frequency_hz[:, 0], expected, rtol=1e-3)
        bands = [one.solutions[0].u_bands for one in (before, after)]
        expected = np.hypot(bands[0], 1e-3 * before.solutions[0].bands)
        np.testing.assert_allclose(bands[1], expected, rtol=1e-2)
    rigs[0].write_text(rigs[0].read_text(encoding="utf-8") + stated.format(2e-3), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read(short, 0, 48)
    assert (caught.value.code, caught.value.key) == (raised.CONTRADICTORY_MODEL_STATEMENT.code, "model")
    assert caught.value.values == {"file": "rig-000g.toml"}


def test_components_without_moving_inertia_are_left_out(short):
    edit(short / "rig-000g.toml", 'channels = ["Fy"]', 'channels = ["bridge"]')
    edit(short / "step-000g" / "recording.toml", 'component = "Fy"', 'component = "Mz"')
    edit(short / "step-000g" / "recording.toml", 'channel = "Fy"', 'channel = "bridge"')
    series, notices = read(short, 0, 48)
    assert [one.output.component for one in series] == ["Fy"]
    (notice,) = (notice for notice in notices if notice.code == raised.COMPONENT_WITHOUT_MOVING_MASS.code)
    assert (notice.where, notice.values) == ("Mz", {"key": "sensor.internal_inertia"})


def test_moments_have_inertias_instead_of_masses(short):
    for grams, inertia in ((0, 0.0), (48, 0.048)):
        rig, recording = short / f"rig-{grams:03d}g.toml", short / f"step-{grams:03d}g"
        edit(recording / "recording.toml", 'component = "Fy"', 'component = "Mx"')
        internal = "internal_inertia = [[0.24, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.2]]"
        edit(rig, "internal_mass_uncertainty = 5e-05", f"{internal}\ninternal_inertia_uncertainty = 1e-4")
        edit(rig, 'channels = ["Fy"]', 'channels = ["bridge"]')
        edit(recording / "recording.toml", 'channel = "Fy"', 'channel = "bridge"')
        if inertia:
            old, new = "[[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]", (inertia * np.eye(3)).tolist()
            edit(rig, f"inertia = {old}", f"inertia = {new}")
    (series,), _ = read(short, 0, 48)
    assert (series.output.component, series.output.mass_unit) == ("Mx", "kg·m²")
    np.testing.assert_allclose(series.masses.load, [0.0, 0.048])
    assert series.masses.moving == 0.24
    assert series.masses.names[0] == MOVING_MASS_LABEL
    evaluation = evaluate_loads("moments", (series,), (), LoadSettings(), {})
    assert evaluation.models[0].stiffness == pytest.approx(2.36e6, rel=3e-3)
    assert {row[8] for row in parameter_rows(evaluation)} >= {"N.m/rad", "N.m.s/rad", "kg.m^2", "V/(N.m)"}


@pytest.mark.parametrize("load", [0.0, 0.048])
def test_simulated_output_is_that_of_the_equations_of_motion(load):
    rig = read_preset(SeriesRig, "loads")
    moving, numbers = rig.moving_mass_kg, (rig.stiffness, rig.damping, rig.coupling_stiffness, rig.coupling_damping)
    a, t = two_masses(moving, load, np.array(numbers)), np.arange(4000) / 1e5
    push, row = np.zeros((len(a), 1)), np.eye(1, len(a)) * rig.sensitivity * rig.stiffness
    push[-1] = 1.0 / (load or moving)
    force = np.clip((t - 5e-3) / 4e-4, 0.0, 1.0)
    poles, residues = true_modes(rig, moving, load)
    change = (pole_responses(poles, t, 5e-3, 4e-4) @ residues).real
    np.testing.assert_allclose(change, lsim(StateSpace(a, push, row, np.zeros((1, 1))), force, t)[1], atol=1e-6)


def test_model_without_uncertainty_is_read_back(tmp_path):
    model = LoadModel("F", "", "", 0.24, 2.36e6, 0.0)
    (tmp_path / LOAD_MODEL_FILE).write_text(
        model_text([(model, UncertaintyBasis())], "table", "", ""), encoding="utf-8"
    )
    assert read_load_models(tmp_path) == (model,)
