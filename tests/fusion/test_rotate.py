"""`shakercal rotate`: simulated tests against their truth, published amplitudes, files, and wrong input."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
from page_outline import self_contained
from support import DOCS, documented_columns, edit, rows

from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.sensor import bench_notices as raised
from fusion.sensor.rotate.rotation_evaluation import evaluate_rotation
from fusion.sensor.rotate.rotation_readings import JOINT, RotationEvaluation
from fusion.simulate.statics import BARE, LOADED, write_rotation
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.notices import DeclaredNotice, Notice

ANGLES = np.arange(0.0, 360.0, 22.5)
BODIES = ("internal", "load")
PAPER_RIG = """
format = 1
name = "indexing head"
[sensor]
name = "six-component transducer"
channels = ["Fx", "Fy"]
unit = "N"
sense = "on_sensor"
internal_mass = 0.0
[load]
mass = 6.9605
density = 1e9
centre_of_mass = [0.0, 0.0, 0.0]
inertia = [[0.036, 0.0, 0.0], [0.0, 0.036, 0.0], [0.0, 0.0, 0.031]]
[environment]
gravity = [0.0, 0.0, -9.8125]
air_density = 0.01
"""
PAPER_RECORDING = """
format = 1
name = "{name}"
rig = "../rig.toml"
[excitation]
kind = "rotation"
file = "readings.csv"
angle_unit = "deg"
axis = [0.0, 0.0, 1.0]
zero_gravity = [0.0, -1.0, 0.0]
with_load = {with_load}
"""


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated rotation test with its truth."""
    folder = tmp_path_factory.mktemp("rotation")
    write_rotation(folder, 4)
    return folder


@pytest.fixture(scope="module")
def once(simulated: Path) -> RotationEvaluation:
    return _evaluated(simulated)


@pytest.fixture
def campaign(simulated: Path, tmp_path: Path) -> Path:
    """A copy of the test that may be spoilt."""
    shutil.copytree(simulated, tmp_path / "campaign")
    return tmp_path / "campaign"


def _evaluated(folder: Path, *names: str) -> RotationEvaluation:
    return evaluate_rotation("test", [load_manifest(folder / name) for name in names or (BARE, LOADED)], {})


def _notices(evaluation: RotationEvaluation, declared: DeclaredNotice) -> list[Notice]:
    return [notice for notice in evaluation.notices if notice.code == declared.code]


def _paper(folder: Path) -> Path:
    """Write the rotation test of the publication: forces in N of the amplitudes that it states, without noise."""
    (folder / "rig.toml").write_text(PAPER_RIG)
    for name, x, y in ((BARE, 7.558, 7.532), (LOADED, 75.877, 75.736)):
        (folder / name).mkdir()
        text = PAPER_RECORDING.format(name=name, with_load=str(name == LOADED).lower())
        (folder / name / "recording.toml").write_text(text)
        angle = np.radians(ANGLES)
        rows = zip(ANGLES, 0.1 - x * np.sin(angle), -0.2 - y * np.cos(angle), strict=True)
        table = "angle;Fx [N];Fy [N]\n" + "".join(f"{a:g};{p:.6f};{q:.6f}\n" for a, p, q in rows)
        (folder / name / "readings.csv").write_text(table.replace(".", ","))
    return folder


def test_simulated_masses_come_back_within_u(simulated, once):
    truth = json.loads((simulated / LOADED / "truth.json").read_text())
    true = {(f"{body}_mass", part): truth[f"{body}_mass_kg"] for body in BODIES for part in (JOINT, "Fx", "Fy")}
    for body in BODIES:
        true |= {(f"{body}_centre_of_mass", axis): truth[f"{body}_centre_m"][i] for i, axis in enumerate("xyz")}
    for key, value in true.items():
        found = once.find(*key)
        assert abs(found.value - value) < 1.5 * found.expanded, key
    joint = once.find("load_mass")
    loop = 2.0 * 1e-4 / np.sqrt(3.0)  # of a hysteresis of 0.1 mrad to either side
    assert joint.u / joint.value == pytest.approx(np.hypot(5e-4 / np.sqrt(2.0), loop), rel=0.05)
    assert max(joint.budget, key=lambda name: joint.budget[name]) == "calibration matrix"
    assert joint.u == pytest.approx(np.linalg.norm(list(joint.budget.values())))
    assert set(joint.budget) >= {"local gravity", "air density", f"noise of {BARE}", f"noise of {LOADED}"}


def test_published_amplitudes_give_the_published_table(tmp_path):
    evaluation = _evaluated(_paper(tmp_path))
    value = {(q.name, q.component): q.value for q in evaluation.quantities}
    assert [round(value["weight", part], 3) for part in ("Fx", "Fy")] == [75.877, 75.736]
    share = 1.0 - 0.01 * 2.5e-4  # buoyancy of next to nothing
    assert [round(share * value["internal_mass", part], 3) for part in ("Fx", "Fy")] == [0.770, 0.768]
    assert [round(value["load_mass", part], 3) for part in ("Fx", "Fy")] == [6.962, 6.951]
    assert value["load_mass_relative_deviation", "Fx"] == pytest.approx(0.028, abs=5e-4)
    assert value["load_mass_relative_deviation", "Fy"] == pytest.approx(-0.139, abs=2e-3)
    assert value["internal_mass_relative_difference", "Fx-Fy"] == pytest.approx(0.345, abs=1e-3)
    (notice,) = _notices(evaluation, raised.WEIGHT_NOT_EXPLAINED)
    assert notice.values["departure_percent"] == pytest.approx(100.0 * evaluation.weights.departure)
    assert _notices(evaluation, raised.MATRIX_UNCERTAINTY_NOT_STATED)
    assert evaluation.find("internal_centre_of_mass", "x") is None
    assert evaluation.find("weight", JOINT, BARE).value == pytest.approx(np.mean([7.558, 7.532]), abs=1e-3)
    assert 1e-3 < evaluation.weights.departure < 2e-3  # 0.35 % and 0.19 % between the axes


def test_buoyancy_adds_the_air_that_is_displaced(tmp_path):
    folder = _paper(tmp_path)
    before = _evaluated(folder)
    edit(folder / "rig.toml", "density = 1e9", "density = 2700.0")
    edit(folder / "rig.toml", "air_density = 0.01", "air_density = 1.2")
    after = _evaluated(folder)
    for name, share, little in (
        ("load_mass", 1.2 / 2700.0, 0.01 / 1e9),
        ("internal_mass", 0.6 * (1.0 / 8000.0 + 1.0 / 2700.0), 0.005 * (1.0 / 8000.0 + 1.0 / 2700.0)),
    ):
        ratio = after.find(name).value / before.find(name).value
        assert ratio == pytest.approx((1.0 - little) / (1.0 - share), rel=1e-6)


def test_a_head_that_was_set_anew_does_not_matter(tmp_path):
    folder = _paper(tmp_path)
    before, table = _evaluated(folder).find("load_mass"), folder / LOADED / "readings.csv"
    head, *read = table.read_text().splitlines()
    cells = [row.partition(";") for row in read]
    moved = [f"{float(angle.replace(',', '.')) + 33.0:g};{rest}" for angle, _, rest in cells]
    table.write_text("\n".join([head, *moved]))
    after = _evaluated(folder)
    assert after.find("load_mass").value == pytest.approx(before.value, rel=1e-7)
    (notice,) = _notices(after, raised.GRAVITY_OFFSET)
    assert notice.values["offset_deg"] == pytest.approx(-33.0, abs=0.05)


def test_one_recording_determines_one_mass(simulated):
    bare, loaded = _evaluated(simulated, BARE), _evaluated(simulated, LOADED)
    assert bare.find("internal_mass") is not None
    assert bare.find("load_mass") is None
    assert _notices(bare, raised.NO_LOADED_RECORDING)
    assert _notices(loaded, raised.NO_UNLOADED_RECORDING)
    difference, direct = loaded.find("internal_mass"), bare.find("internal_mass")
    assert difference.u > 5.0 * direct.u  # the calibration's scale acts on the whole weight
    assert abs(difference.value - direct.value) < 2.0 * difference.expanded


def test_part_of_one_recording_is_subtracted_from_it(campaign, once):
    part = (
        '\n[[part]]\nname = "plate"\nbody = "load"\nmass = 0.1\ndensity = 7900.0\ncentre_of_mass = [0.0, 0.0, 0.02]\n'
    )
    path = campaign / BARE / "recording.toml"
    path.write_text(path.read_text() + part)
    after = _evaluated(campaign)
    assert once.find("internal_mass").value - after.find("internal_mass").value == pytest.approx(0.1, rel=1e-3)
    assert after.find("load_mass").value == pytest.approx(6.96 + 0.1, abs=0.01)


def test_repeats_are_averaged(campaign, once):
    shutil.copytree(campaign / BARE, campaign / "without-again")
    repeated, first = (
        _evaluated(campaign, BARE, "without-again", LOADED).find("internal_mass"),
        once.find("internal_mass"),
    )
    assert repeated.value == pytest.approx(first.value, rel=1e-4)
    assert repeated.budget[f"noise of {BARE}"] < 0.6 * first.budget[f"noise of {BARE}"]
    assert repeated.budget["calibration matrix"] == pytest.approx(first.budget["calibration matrix"], rel=0.01)


def test_reversed_sense_of_the_sensor_is_reported_without_effect(campaign, once):
    edit(campaign / "rig.toml", 'sense = "on_sensor"', 'sense = "on_load"')
    after = _evaluated(campaign)
    assert [notice.where for notice in _notices(after, raised.GRAVITY_REVERSED)] == [BARE, LOADED]
    for key in (("load_mass", JOINT), ("load_centre_of_mass", "z")):
        assert after.find(*key).value == pytest.approx(once.find(*key).value, rel=1e-6)


def test_a_load_of_another_weight_is_reported(campaign):
    edit(campaign / "rig.toml", "mass = 6.9605", "mass = 6.9405")
    evaluation = _evaluated(campaign)
    found = {
        notice.values["component"]: notice.values["ratio"] for notice in _notices(evaluation, raised.LOAD_MASS_DEVIATES)
    }
    for component, ratio in found.items():
        assert ratio == pytest.approx(abs(evaluation.find("load_mass_normalised_deviation", component).value))
        assert ratio > 1.0
    assert JOINT in found


def test_scale_replaces_the_unit_of_a_column(campaign, once):
    for name in (BARE, LOADED):
        table = campaign / name / "readings.csv"
        table.write_text(table.read_text().replace(" [mV/V]", ""))
        edit(campaign / name / "recording.toml", "with_load", "scale = 1e-3\nwith_load")
    assert _evaluated(campaign).find("load_mass").value == once.find("load_mass").value


def test_files_of_a_run(campaign, capsys):
    assert main(["rotate", str(campaign)]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"^internal mass: joint \(0\.76\d* ± 0\.000\d+\) kg", printed, re.MULTILINE)
    folder = campaign / "rotate"
    assert sorted(path.name for path in folder.iterdir()) == ["rotation.csv", "rotation.h5", "rotation.html"]
    found = rows(folder / "rotation.csv")
    assert list(found[0]) == documented_columns("rotation.md", "rotation.csv")
    assert all(all(cell for cell in row.values()) for row in found)
    assert all(float(row["U"]) == pytest.approx(float(row["u"]) * float(row["k"])) for row in found)
    names = {row["name"] for row in found}
    assert {"internal_mass", "load_mass", "weighed_mass", "gravity", "offset", "harmonic_1", "axis_tilt"} <= names
    with h5py.File(folder / "rotation.h5") as file:
        assert set(file["provenance/files"].asstr()) == {"rotation.csv", "rotation.html", "rotation.h5"}
        assert len(file["provenance/input_file"]) == 5
        assert file[f"recordings/{LOADED}/load"].shape == (34, 6)
        mass = next(row for row in found if (row["name"], row["component"]) == ("load_mass", JOINT))
        assert file["quantities/load_mass joint"].attrs["value"] == float(mass["value"])
        assert file["weights/covariance"][0, 0] > 0.0
    page = (folder / "rotation.html").read_text(encoding="utf-8")
    self_contained(page)
    assert page.count("<figure") == 7


def test_the_example_of_the_documentation_is_the_simulated_recording(simulated):
    text = (DOCS / "rotation.md").read_text(encoding="utf-8")
    example, _ = re.findall(r"^```toml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    written = tomllib.loads((simulated / LOADED / "recording.toml").read_text(encoding="utf-8"))
    assert tomllib.loads(example)["excitation"] == written["excitation"]


def test_check_names_the_table_and_its_columns(campaign, capsys):
    assert main(["check", str(campaign / BARE)]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("readings.csv", "angle [deg]", "Fx [mV/V]", "shakercal rotate"))


@pytest.mark.usefixtures("no_pages")
def test_folders_of_results(campaign, tmp_path):
    for paths, folder in (((BARE,), BARE), ((LOADED, BARE), ""), ((f"{LOADED}/recording.toml",), LOADED)):
        assert main(["rotate", *(str(campaign / path) for path in paths)]) == 0
        assert (campaign / folder / "rotate" / "rotation.csv").is_file()


RIG, RECORDING, TABLE = "rig.toml", f"{BARE}/recording.toml", f"{BARE}/readings.csv"
TABLE_CODE = raised.WRONG_ROTATION_TABLE.code
CASES = [  # file, its old and new text, the key of the refusal, its code where this command declares it
    (RIG, "latitude = 52.296\n", "", "environment.gravity", raised.GRAVITY_NOT_DETERMINED.code),
    (RIG, "height = 79.0\n", "", "environment.height", ""),
    (RIG, "latitude = 52.296", "latitude = 152.0", "environment.latitude", ""),
    (RIG, "height = 79.0", "height = 79.0\nhumidity = 45.0", "environment.humidity", ""),
    (RIG, "height = 79.0", "height = 79.0\npressure = 1013.25", "environment.pressure", ""),
    (RECORDING, 'angle_unit = "deg"', 'angle_unit = "rad"', "excitation.angle_unit", TABLE_CODE),
    (RECORDING, "axis = [0.0, 0.0, 1.0]", "axis = [0.0, 0.0, -1.0]", "excitation.axis", ""),
    (RECORDING, "axis = [0.0, 0.0, 1.0]", "axis = [0.0, 1.0, 0.0]", "excitation.axis", ""),
    (RECORDING, "with_load = false\n", "", "excitation.with_load", ""),
    (RECORDING, "with_load = false", "with_load = false\nscale = 0", "excitation.scale", ""),
    (RECORDING, 'file = "readings.csv"', 'file = "no.csv"', "excitation.file", ""),
    (TABLE, "angle [deg]", "theta", "angle", TABLE_CODE),
    (TABLE, "Fx [mV/V]", "Fx [kN]", "Fx", TABLE_CODE),
    (TABLE, "Fx [mV/V]", "Fx [N]", "Fy", TABLE_CODE),
    (TABLE, ",".join(f"{name} [mV/V]" for name in LOAD_COMPONENTS), "a,b,c,d,e,f", None, TABLE_CODE),
    (TABLE, "\n22.5,", "\n22.5,nan,0,0,0,0,0\n22.5,", "Fx", TABLE_CODE),
    (TABLE, "\n22.5,", "\ntwenty,", None, ""),
    (TABLE, "Mz [mV/V]", "remark", None, raised.DIFFERENT_ROTATION_CHANNELS.code),
]


@pytest.mark.parametrize(("file", "old", "new", "key", "code"), CASES)
def test_a_mistake_is_one_sentence(campaign, file, old, new, key, code, refused):
    edit(campaign / file, old, new)
    refusal = refused("rotate", "-q", campaign)
    assert Path(file).name in refusal
    assert f"{code} " in refusal
    assert key is None or f"{key}: " in refusal
    assert not (campaign / "rotate").exists()


def test_other_recordings_are_refused(campaign, tmp_path, refused):
    (tmp_path / "other").mkdir()
    write_rotation(tmp_path / "other", 2)
    assert LOADED in refused("rotate", campaign / BARE, tmp_path / "other" / LOADED)
    edit(campaign / RECORDING, "../rig.toml", "rig.toml")
    bare = 'format = 1\nname = "no sensor"\n'
    (campaign / BARE / "rig.toml").write_text(bare)
    assert "environment.gravity" in refused("rotate", campaign / BARE)
    (campaign / BARE / "rig.toml").write_text(bare + "[environment]\ngravity = [0, 0, -9.81]\n")
    refusal = refused("rotate", campaign / BARE)
    assert f"{raised.MISSING_ROTATION_ENTRY.code} " in refusal
    assert "rig.toml: sensor: " in refusal


def test_outputs_without_a_matrix_are_refused(campaign, refused):
    lines = (campaign / RIG).read_text(encoding="utf-8").splitlines()
    (campaign / RIG).write_text("\n".join(line for line in lines if not line.startswith("static_sensitivity ")))
    refusal = refused("rotate", campaign)
    assert f"{raised.MISSING_ROTATION_ENTRY.code} " in refusal
    assert "sensor.static_sensitivity: " in refusal


def test_a_channel_that_is_constant_or_missing_is_left_out(campaign):
    for name in (BARE, LOADED):
        table = campaign / name / "readings.csv"
        lines = table.read_text().replace("Fz [mV/V]", "remark").splitlines()
        table.write_text("\n".join(re.sub(r",[^,]*$", ",0", row) if i else row for i, row in enumerate(lines)))
    evaluation = _evaluated(campaign)
    for declared, values in (
        (raised.CONSTANT_CHANNELS, {"channels": "Mz"}),
        (raised.MISSING_CHANNEL_COLUMNS, {"file": "readings.csv", "channels": "Fz"}),
    ):
        found = _notices(evaluation, declared)
        assert [(notice.where, notice.values) for notice in found] == [(BARE, values), (LOADED, values)]


def _rounded(folder: Path, digit: float, *names: str) -> None:
    """Round the outputs of recordings to a digit in V/V."""
    for name in names:
        head, *lines = (folder / name / "readings.csv").read_text().splitlines()
        cells = [line.split(",") for line in lines]
        shown = [[c[0], *(f"{1e3 * digit * np.round(float(v) / 1e3 / digit):.7f}" for v in c[1:])] for c in cells]
        (folder / name / "readings.csv").write_text("\n".join([head, *map(",".join, shown)]) + "\n")


def test_a_channel_constant_in_one_state_bounds_the_load_and_is_kept(campaign, once):
    _rounded(campaign, 2e-7, BARE, LOADED)  # Mz of the internal mass is a tenth of this
    evaluation = _evaluated(campaign)
    dead = {name for notice in _notices(evaluation, raised.CONSTANT_CHANNELS) for name in [notice.values["channels"]]}
    assert dead <= {"Mz"}
    for key in (("internal_mass", JOINT), ("load_mass", JOINT), ("load_centre_of_mass", "z")):
        coarse, fine = evaluation.find(*key), once.find(*key)
        assert abs(coarse.value - fine.value) < 1.5 * coarse.expanded, key
        assert "rounding" in coarse.budget


def test_rounding_does_not_average_over_the_way_back(campaign):
    _rounded(campaign, 2e-7, BARE, LOADED)
    both = _evaluated(campaign).find("internal_mass").budget["rounding"]
    table = (campaign / BARE / "readings.csv").read_text().splitlines()
    (campaign / BARE / "readings.csv").write_text("\n".join(table[:18]) + "\n")
    assert both == pytest.approx(_evaluated(campaign).find("internal_mass").budget["rounding"], rel=0.25)


def test_cross_talk_of_the_matrix_enters(campaign, once):
    edit(campaign / RIG, "internal_mass = 0.0", "internal_mass = 0.0\ncross_talk_uncertainty = 1e-3")
    after = _evaluated(campaign)
    lever = 1e-3 * 0.1  # of the rated outputs at 1 N and 0.1 N m, where no capacity is stated
    budget = after.find("load_centre_of_mass", "z").budget["calibration matrix"]
    assert budget == pytest.approx(lever, rel=0.5)
    assert budget > 2.0 * once.find("load_centre_of_mass", "z").budget["calibration matrix"]


def test_inclination_of_the_axis_enters_with_its_mean(campaign, once):
    for name in (BARE, LOADED):
        edit(campaign / name / "recording.toml", "with_load", f"axis_uncertainty = {np.radians(1.0)}\nwith_load")
    after, before = _evaluated(campaign).find("load_mass"), once.find("load_mass")
    assert after.value / before.value - 1.0 == pytest.approx(np.radians(1.0) ** 2 / 2.0, rel=1e-3)
    share = after.budget["inclination of the axis"] / after.value
    assert share == pytest.approx(np.radians(1.0) ** 2 / np.sqrt(2.0), rel=0.01)
    assert _notices(once, raised.AXIS_INCLINATION_NOT_STATED)


def test_the_difference_of_the_senses_is_in_u(campaign):
    for name in (BARE, LOADED):
        head, *lines = (campaign / name / "readings.csv").read_text().splitlines()
        table = np.array([line.split(",") for line in lines], np.float64)
        sense = np.repeat([1.0, -1.0], len(table) // 2)[:, None]
        moved = (
            7e-4 * np.abs(table[:, 1:]).max(axis=0) * sense * np.cos(np.radians(table[:, :1]) + np.arange(6) % 2 * 1.57)
        )
        table[:, 1:] += moved
        (campaign / name / "readings.csv").write_text(
            "\n".join([head, *(",".join(f"{v:.9g}" for v in row) for row in table)]) + "\n"
        )
    evaluation = _evaluated(campaign)
    assert evaluation.find("load_mass").budget["hysteresis"] / 6.96 > 7e-4 / np.sqrt(3.0)
    assert _notices(evaluation, raised.HYSTERESIS_FOUND)
    one_way = campaign / BARE / "readings.csv"
    one_way.write_text("\n".join(one_way.read_text().splitlines()[:18]) + "\n")
    assert [n.where for n in _notices(_evaluated(campaign), raised.ONE_SENSE_OF_ROTATION)] == [BARE]
