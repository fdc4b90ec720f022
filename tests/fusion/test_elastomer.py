"""`shakercal elastomer` end to end: a simulated element against its truth, files, and wrong input."""

from __future__ import annotations

import json
import re
import shutil
import sys
import tomllib
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import h5py
import numpy as np
import pytest
from page_outline import self_contained
from support import DOCS, documented_columns, rows

from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.toml import models_in, to_toml
from fusion.sensor import bench_notices as raised
from fusion.sensor.elastomer.element_definition import ElementFile, read_definition
from fusion.sensor.elastomer.element_evaluation import (
    ComparedColumn,
    ElementEvaluation,
    dominant,
    evaluate_element,
    frame_shapes,
    measured_column,
    solid_shapes,
    spread,
)
from fusion.sensor.elastomer.element_report import element_scene
from fusion.simulate.statics import write_element
from shaker.elastomer.frame import MODE_NAMES
from shaker.lti.system import ModalModel


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An element with measured models and their truth, and two platforms to fit."""
    folder = tmp_path_factory.mktemp("element")
    write_element(folder, 3)
    _edit(folder, fit={"half_sizes": [0.008, 0.01]})
    return folder


@pytest.fixture(scope="module")
def evaluated(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The command's folder of results, and what it printed."""
    out, printed = tmp_path_factory.mktemp("evaluated") / "results", StringIO()
    with redirect_stdout(printed):
        assert main(["elastomer", str(simulated), "-q", "-o", str(out)]) == 0
    return out, printed.getvalue()


@pytest.fixture
def element(simulated: Path, tmp_path: Path) -> Path:
    """A copy that may be spoilt, without the fit that takes long."""
    folder = tmp_path / "element"
    shutil.copytree(simulated, folder)
    _edit(folder, fit=None)
    return folder


def _edit(folder: Path, **changes: object) -> None:
    """Replace top-level keys of elastomer.toml; None removes one, a table is merged."""
    file = folder / "elastomer.toml"
    text = tomllib.loads(file.read_text(encoding="utf-8"))
    for key, value in changes.items():
        if value is None:
            text.pop(key, None)
        elif isinstance(value, dict) and isinstance(text.get(key), dict):
            text[key] = {name: item for name, item in {**text[key], **value}.items() if item is not None}
        else:
            text[key] = value
    file.write_text(to_toml(text), encoding="utf-8")


def _evaluate(folder: Path, *, solid: bool = False, **changes: object) -> ElementEvaluation:
    _edit(folder, **changes)
    return evaluate_element(read_definition(folder / "elastomer.toml"), {}, solid=solid)


def test_command_writes_the_results_that_it_prints(simulated, evaluated):
    out, printed = evaluated
    names = {"comparison.csv", "modes.csv", "stiffness.csv", "statics.csv", "platform.csv", "elastomer.h5"}
    assert {file.name for file in out.iterdir()} == names | {"elastomer.html", "shapes-frame.png"}
    assert (out / "shapes-frame.png").read_bytes().startswith(b"\x89PNG")
    compared = rows(out / "comparison.csv")
    assert list(compared[0]) == documented_columns("elastomer.md", "comparison.csv")
    comparison = {(row["column"], row["mode"]): float(row["frequency_hz"]) for row in compared}
    truth = json.loads((simulated / "truth.json").read_text(encoding="utf-8"))["frequency_hz"]
    for name in MODE_NAMES:
        assert comparison["measured", name] == pytest.approx(truth[name], rel=4e-4)
        assert comparison["frame", name] == pytest.approx(truth[name], rel=0.05)
        columns = [value for (column, mode), value in comparison.items() if mode == name and column != "spread"]
        assert comparison["spread", name] == pytest.approx((max(columns) - min(columns)) / max(columns), rel=1e-12)
    statics = {row["name"]: row for row in rows(out / "statics.csv")}
    assert float(statics["stiffness_point"]["printed"]) == pytest.approx(2.848e5, rel=1e-3)
    family = rows(out / "platform.csv")
    assert float(family[1]["mass_kg"]) == pytest.approx(5.34e-3, rel=0.01)
    assert max(float(row["largest_misfit"]) for row in family) < 1e-6
    assert f"{comparison['frame', 'Rz']:.1f}" in printed
    with h5py.File(out / "elastomer.h5") as file:
        assert file["frame/modes/frequency_hz"][()].tolist() == [comparison["frame", name] for name in MODE_NAMES]
        assert file["frame/node_motion"].shape[1] == 6
        assert "provenance" in file
    page = (out / "elastomer.html").read_text(encoding="utf-8")
    self_contained(page)
    assert page.count("<h2>") >= 4


def test_modes_move_in_space_as_the_frame_does(element):
    """The platform of Tz moves along z alone and whole; Rz turns it about z; clamped ends stay."""
    evaluation = _evaluate(element)
    scene = element_scene("frame", frame_shapes(evaluation.definition, evaluation.frame))
    assert [motion.name.partition(":")[0] for motion in scene.motions] == list(MODE_NAMES)
    (shape,) = scene.shapes
    half = evaluation.definition.file.platform.half_size
    on_platform = (np.abs(shape.points_m[:, :2]) <= 1.001 * half).all(axis=1)
    moved = {motion.name.partition(":")[0]: motion.deflection["frame"].real for motion in scene.motions}
    for motion in moved.values():
        assert np.linalg.norm(motion, axis=1).max() == pytest.approx(1e-6)
    lifted = moved["Tz"][on_platform]
    assert np.abs(np.abs(lifted[:, 2]) - np.abs(lifted[:, 2]).max()).max() < 0.25e-6
    turned, arm = moved["Rz"][on_platform], shape.points_m[on_platform]
    along = np.abs(np.sum(turned[:, :2] * arm[:, :2], axis=1))
    assert np.all(along < 0.05 * np.linalg.norm(turned, axis=1).max() * np.linalg.norm(arm[:, :2], axis=1).max())
    assert max(max(face) for face in shape.faces) == len(shape.points_m) - 1


@pytest.mark.slow
def test_solid_agrees_with_the_frame(element):
    pytest.importorskip("skfem")
    _edit(element, solid={"refinements": [1, 2]}, platform={"half_size": 0.008, "thickness": 0.006})
    evaluation = _evaluate(element, solid=True, beams={"span": 0.04}, compliant_beams={"length": 0.016})
    finest = evaluation.solid.finest
    assert finest.unknowns > 2 * evaluation.solid.meshes[0].unknowns
    assert evaluation.frame.modes.frequency_hz == pytest.approx(finest.frequency_hz, rel=0.15)
    assert [column.kind for column in evaluation.columns][:4] == ["formula", "frame", "solid", "measured"]
    shapes = frame_shapes(evaluation.definition, evaluation.frame), solid_shapes(evaluation.solid.meshes[0], finest)
    corner = [0.008, 0.008, 0.003]
    for both in zip(*shapes, strict=True):
        assert both[0].name == both[1].name
        near = [np.argmin(np.linalg.norm(shape.rest_m.reshape(-1, 3) - corner, axis=1)) for shape in both]
        one, other = (shape.motion.reshape(-1, 3)[i] for shape, i in zip(both, near, strict=True))
        assert one @ other > 0.95 * np.linalg.norm(one) * np.linalg.norm(other), both[0].name


def test_platform_as_data_is_its_block(element):
    first = _evaluate(element)
    block = first.definition.platform
    data = {"mass": block.mass_kg, "inertia": block.inertia_kgm2.tolist(), "thickness": None}
    as_data = _evaluate(element, platform=data)
    assert as_data.frame.modes.frequency_hz == pytest.approx(first.frame.modes.frequency_hz, rel=1e-12)
    assert raised.PLATFORM_AS_STATED.code in {notice.code for notice in as_data.notices}
    with pytest.raises(InputError) as caught:
        _evaluate(element, solid=True)
    assert (caught.value.code, caught.value.key) == (raised.BLOCK_THICKNESS_MISSING.code, "platform.thickness")


def test_error_of_a_solid_that_cannot_be_computed_has_a_remedy(element, monkeypatch):
    pytest.importorskip("skfem")
    with pytest.raises(InputError) as caught:
        _evaluate(element, solid=True, platform={"height": 0.02})
    assert (caught.value.code, caught.value.key) == (raised.SOLID_REFUSED.code, "platform.height")
    monkeypatch.setitem(sys.modules, "skfem", None)
    with pytest.raises(InputError) as caught:
        _evaluate(element, solid=True, platform={"height": 0.0})
    assert (caught.value.code, str(caught.value.file)) == (raised.SOLID_PACKAGE_MISSING.code, "--solid")


def test_a_hand_as_a_part_lowers_every_frequency(element):
    hand = {"name": "hand", "mass": 0.1, "centre_of_mass": 0.01, "inertia": [1e-5, 1e-5, 1e-5]}
    bare, with_hand = _evaluate(element), _evaluate(element, part=[hand])
    assert np.all(with_hand.frame.modes.frequency_hz < bare.frame.modes.frequency_hz)
    assert with_hand.frame.stiffness == pytest.approx(bare.frame.stiffness, rel=1e-12)


def test_spread_is_that_of_the_published_table():
    table = np.full((4, 6), np.nan)
    table[:, [0, 2, 4, 5]] = [  # Fx, Fz, My, Mz
        (1642.0, 1973.0, 3376.0, 4892.0),  # formulas
        (1660.0, 2025.0, 3578.0, 5094.0),  # finite elements
        (1720.0, 2020.0, 3530.0, 5060.0),  # order and parameters
        (1680.0, 1986.0, 3460.0, 4910.0),  # differential evolution
    ]
    found = 100.0 * spread([ComparedColumn("", "stated", values, np.zeros(6)) for values in table])
    assert found[[0, 2, 4, 5]] == pytest.approx([4.53, 2.57, 5.65, 3.97], abs=0.006)
    assert np.isnan(found[[1, 3]]).all()


def test_dominant_mode_is_the_one_that_swings_most():
    residue, none = np.array([10.0j, 500.0j]), np.zeros(0)
    covariance = np.diag(np.arange(1.0, 9.0))
    model = ModalModel(np.array([900.0, 1700.0]), np.array([0.01, 0.02]), residue, none, none, covariance)
    assert dominant(model) == (1700.0, pytest.approx(np.sqrt(2.0)))


def test_models_that_are_missing_leave_a_gap(element):
    content = json.loads((element / "models.json").read_text(encoding="utf-8"))
    content["models"] = [item for item in content["models"] if item["component"] in ("Fx", "Mz")]
    (element / "models.json").write_text(json.dumps(content), encoding="utf-8")
    column, _ = measured_column(read_definition(element / "elastomer.toml"))
    assert np.isfinite(column.frequency_hz).tolist() == [True, False, False, False, False, True]


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"beams": {"widht": 0.004}}, "beams.widht"),
        ({"beam": {"width": 0.004}}, "beam"),
        ({"beams": {"span": -1.0}}, "beams.span"),
        ({"material": {"poisson_ratio": 0.5}}, "material.poisson_ratio"),
        ({"platform": {"half_size": 0.04}}, "platform"),
        ({"platform": {"mass": 0.01}}, "platform.inertia"),
        ({"platform": {"thickness": None}}, "platform.thickness"),
        ({"platform": {"mass": 0.01, "inertia": [1.0, 1.0, 5.0]}}, "platform.inertia"),
        ({"solid": {"refinements": [2, 1]}}, "solid.refinements"),
        ({"fit": {"half_sizes": [0.01], "frequencies": {"Tx": 1.0}}}, "fit.frequencies"),
        ({"fit": {"half_sizes": [], "frequencies": {"Tx": 1.0}}}, "fit.half_sizes"),
        ({"mounting": {"direction": "x"}}, "mounting.direction"),
        ({"measured": "missing.json"}, "measured"),
        ({"stated": [{"name": "a"}, {"name": "a"}]}, "stated"),
    ],
)
def test_wrong_input_is_refused_in_one_sentence(element, changes, key, refused):
    _edit(element, **changes)
    assert f"elastomer.toml: {key}: " in refused("elastomer", element, "-q")
    assert not (element / "elastomer").exists()


def test_every_key_is_documented():
    text = (DOCS / "elastomer.md").read_text(encoding="utf-8")
    table = text[text.index("### Every key") : text.index("## Options")]
    named = set(re.findall(r"\w+", table))
    for name, field in ElementFile.model_fields.items():
        assert name in named, name
        for model in models_in(field.annotation):
            missing = set(model.model_fields) - named - set(MODE_NAMES)
            assert not missing, f"{name}: {missing}"
