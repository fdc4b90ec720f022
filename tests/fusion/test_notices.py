"""Notices of users: explained, acknowledged, stored with their values; results as table, figure and headline."""

from __future__ import annotations

import csv
import json
import math
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import pandas
import pytest

import fusion
import photogram
import shaker
import shakercal
from fusion.cli import main
from fusion.commands.options import EXIT_DONE, EXIT_INPUT
from fusion.errors import ComputeError, InputError, declared_notices
from fusion.instruments.instrument_notices import PARALLEL_BEAMS_WITHOUT_HEAD
from fusion.report.h5 import read_notices
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES
from shakercal._common.notices import DeclaredNotice, Notice, gather, warnings_first

LOST = DeclaredNotice("SC-999", "warning", "{lost:.0%} of {total} subsets are lost", remedy="Move {direction}.")
ACKNOWLEDGED = '\n[[acknowledged]]\ncode = "{code}"\nreason = "one head"\nby = "A. Person"\ndate = 2026-11-28\n'


def test_a_notice_has_texts_values_and_a_row_that_restores_it() -> None:
    notice = Notice(LOST, "camera left", lost=0.25, total=40, direction="slower")
    assert (notice.text, notice.remedy) == ("25 % of 40 subsets are lost", "Move slower.")
    assert Notice.from_row(notice.as_row()) == notice == pickle.loads(pickle.dumps(notice))
    assert json.loads(Notice(LOST, lost=math.nan, total=1, direction="").as_row()["values"])["lost"] is None
    with pytest.raises(KeyError):
        Notice(LOST, lost=0.25)


def test_a_percentage_has_a_space_and_names_stay_as_they_are() -> None:
    notice = Notice(DeclaredNotice("SC-998", "note", "{share:.1%} of {file}"), share=0.25, file="a 50%25.csv")
    assert notice.text == "25.0 % of a 50%25.csv"


def test_one_notice_of_several_places_and_recordings_names_them_all() -> None:
    first, second = (Notice(LOST, "left", lost=lost, total=40, direction="") for lost in (0.25, 0.5))
    (once,) = warnings_first([first, first.at("right"), first])
    assert once.where == "left, right"
    (gathered,) = gather([("a", [first]), ("b", [second]), ("c", [])])
    assert (gathered.recordings, gathered.everywhere, gathered.code) == (("a", "b"), False, LOST.code)
    assert "25 to 50" in gathered.text


def test_errors_keep_code_key_and_values_through_a_process() -> None:
    error = InputError(LOST, "rig.toml", "load.mass", lost=0.1, total=2, direction="")
    again = pickle.loads(pickle.dumps(InputError.together([error, error.at("load.inertia")])))
    assert [one.key for one in again.each] == ["load.mass", "load.inertia"]
    assert (again.code, again.file, again.values) == (LOST.code, Path("rig.toml"), error.values)
    failure = pickle.loads(pickle.dumps(ComputeError(LOST, lost=0.1, total=2, direction="").at("take 2")))
    assert (failure.code, failure.where, str(failure)[:6]) == (LOST.code, "take 2", LOST.code)


def test_explain_prints_every_part_and_refuses_other_codes(capsys) -> None:
    assert main(["explain", NO_RESULT_AT_LINES.code.lower()]) == EXIT_DONE
    text = capsys.readouterr().out
    assert all(part in text for part in (NO_RESULT_AT_LINES.code, NO_RESULT_AT_LINES.remedy))
    assert main(["explain", "SC-464"]) == EXIT_DONE
    text = capsys.readouterr().out
    assert "<chi2>" in text
    assert "{" not in text
    assert main(["explain"]) == EXIT_DONE
    assert len(capsys.readouterr().out.splitlines()) == len(declared_notices())
    assert main(["explain", "SC-1"]) == EXIT_INPUT


@pytest.fixture(scope="module")
def acknowledged(tmp_path_factory: pytest.TempPathFactory, demo_recording: Path, demo_evaluation: Evaluation) -> Path:
    """Results of the demo whose rig acknowledges its only note."""
    folder = tmp_path_factory.mktemp("acknowledged")
    shutil.copytree(demo_recording, folder / "demo")
    rig = folder / "demo" / "rig.toml"
    rig.write_text(
        rig.read_text(encoding="utf-8") + ACKNOWLEDGED.format(code=PARALLEL_BEAMS_WITHOUT_HEAD.code), encoding="utf-8"
    )
    stages = "prepare_set_ups", "measure_set_ups", "evaluate_set_ups"
    with pytest.MonkeyPatch.context() as patch:
        for stage in stages:
            made = f"fusion.sensitivity.recording_evaluation.{stage}"
            patch.setattr(made, lambda manifest, *_: replace(demo_evaluation, manifest=manifest))
        assert main(["run", str(folder / "demo"), "-o", str(folder / "out"), "-q"]) == EXIT_DONE
    return folder / "out"


def test_an_acknowledged_notice_is_listed_with_its_reason_and_not_repeated(acknowledged, capsys) -> None:
    (folder,) = acknowledged.glob("Fz-*")
    with h5py.File(folder / "result.h5") as file:
        notices = read_notices(file)
    (known,) = [notice for notice in notices if notice.code == PARALLEL_BEAMS_WITHOUT_HEAD.code]
    assert known.acknowledged == "one head (A. Person, 2026-11-28)"
    assert len([notice for notice in notices if not notice.possible_size and not notice.acknowledged]) <= 3
    assert known.acknowledged in (folder / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["run", str(acknowledged.parent / "demo"), "-o", str(acknowledged)]) == EXIT_DONE
    assert PARALLEL_BEAMS_WITHOUT_HEAD.code not in capsys.readouterr().err
    assert main(["run", str(acknowledged.parent / "demo"), "-o", str(acknowledged), "--json"]) == EXIT_DONE
    told = json.loads(capsys.readouterr().out)["notices"]
    assert {"code", "severity", "where", "text", "effect", "remedy", "possible_size", "acknowledged", "values",
            "recordings"} == set(told[0])  # fmt: skip
    assert {one["code"] for one in told} >= {PARALLEL_BEAMS_WITHOUT_HEAD.code}


@pytest.mark.parametrize("code", ["SC-1", NO_RESULT_AT_LINES.code, "SC-953"])
def test_only_notices_that_leave_a_result_can_be_acknowledged(code, tmp_path, demo_recording, capsys) -> None:
    shutil.copytree(demo_recording, tmp_path / "demo")
    rig = tmp_path / "demo" / "rig.toml"
    rig.write_text(rig.read_text(encoding="utf-8") + ACKNOWLEDGED.format(code=code), encoding="utf-8")
    assert main(["run", str(tmp_path / "demo"), "-o", str(tmp_path / "out")]) == EXIT_INPUT
    assert "rig.toml: acknowledged[1].code: " in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_result_is_a_table_a_figure_and_a_headline(demo_evaluation, acknowledged) -> None:
    (folder,) = acknowledged.glob("Fz-*")
    with (folder / "sensitivity.csv").open(encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["kind"] != "element"]
    table = demo_evaluation.sensitivity.table()
    assert isinstance(table, pandas.DataFrame)
    assert set(table.columns) == set(rows[0]) - {"recording"}
    assert table["magnitude"].tolist() == pytest.approx([float(row["magnitude"]) for row in rows], rel=1e-12)
    assert table["region_re"].tolist() == pytest.approx([float(row["region_re"]) for row in rows], rel=1e-12)
    for result in (demo_evaluation, demo_evaluation.element, demo_evaluation.load, demo_evaluation.accelerations[0]):
        magnitude, phase = result.plot().axes
        assert (len(magnitude.containers) > 0, phase.get_ylabel()) == (True, "phase / rad")
        assert "±" in repr(result)
        assert "\n" not in repr(result)
    (value,) = [row for row in rows if row["kind"] == "ratio" and row["channel"] == "Fz"]
    assert f"{1e7 * float(value['magnitude']):.4f}" in repr(demo_evaluation.sensitivity)


def test_one_import_has_every_public_name() -> None:
    names = {name for package in (photogram, shaker, fusion) for name in package.__all__}
    assert set(shakercal.__all__) == names | {"Notice", "evaluate"}
    assert all(getattr(shakercal, name) is not None for name in shakercal.__all__)
    assert shakercal.evaluate is fusion.evaluate_recording
    with pytest.raises(AttributeError):
        _ = shakercal.nothing
    loaded = subprocess.run(
        [sys.executable, "-c", "import shakercal, sys; print(*sys.modules)"], capture_output=True, text=True, check=True
    )
    assert not {"numpy", "fusion", "photogram", "shaker"} & set(loaded.stdout.split())
    shown = subprocess.run([sys.executable, "-m", "shakercal", "--version"], capture_output=True, text=True, check=True)
    assert shown.stdout == f"shakercal {shakercal.__version__}\n"


@pytest.mark.parametrize(
    "changed", [{"severity": "grave"}, {"values": "{not json"}, {"values": "[1]"}, {"values": '{"u": [1]}'}]
)
def test_a_row_that_is_no_notice_is_refused(changed):
    row = Notice(LOST, "camera left", lost=0.25, total=40, direction="slower").as_row()
    assert Notice.from_row(row).as_row() == row
    with pytest.raises(ValueError, match=r"expected|Expecting"):
        Notice.from_row({**row, **changed})
