"""A campaign of recordings: one folder each, merged tables, resumed runs, failures that stop nobody else."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import h5py
import pytest
from cluster_factory import InlineExecutor
from evaluation_factory import make_evaluation
from rich.console import Console
from support import edit, folder_contents, rows

from fusion.base import Settings
from fusion.campaign import run as under_test
from fusion.campaign.campaign_notices import WORKER_ENDED
from fusion.campaign.run import Outcome, exit_status, run_path
from fusion.campaign.run_summary import main_curve, notices_of, print_outcomes, sensitivity_table
from fusion.cli import main
from fusion.commands.options import EXIT_DONE, EXIT_FAILED, EXIT_INPUT
from fusion.errors import INTERNAL_ERROR, REFUSED_BY_READER, SYSTEM_REFUSED, ComputeError, InputError
from fusion.estimation.coverage import coverage_factor
from fusion.report.folder import CURVE_FILE, SENSITIVITY_FILE
from fusion.report.h5 import write_value
from fusion.report.recording_report import CAMPAIGN_FILES, result_tables, row_element
from fusion.report.report_notices import OTHER_CAMPAIGN_CONTENT, OTHER_CONTENT
from fusion.report.tables import sensitivity_element
from shakercal._common.notices import DeclaredNotice, Notice

NAMES = ["Fz-0106.25", "Fz-0375.90"]
TITLES = ["Fz 106.25 Hz", "Fz 375.90 Hz"]
TABLES = {"sensitivity.csv", "acceleration.csv", "load.csv"}
JOINT = set(CAMPAIGN_FILES)


@pytest.fixture
def campaign(make_campaign: Callable[..., Path]) -> Path:
    """Two recordings of one rig."""
    first = make_campaign()
    second = first.with_name(NAMES[1])
    shutil.copytree(first, second)
    edit(second / "recording.toml", f'name = "{TITLES[0]}"', f'name = "{TITLES[1]}"')
    return first.parent


def _times(folder: Path) -> dict[str, int]:
    """Time of every file."""
    return {path.relative_to(folder).as_posix(): path.stat().st_mtime_ns for path in folder.rglob("*.*")}


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _recordings(path: Path) -> list[str]:
    return list(dict.fromkeys(row["recording"] for row in rows(path)))


def _fail(patch: pytest.MonkeyPatch, error: BaseException, *failing: str) -> None:
    """Let the evaluation of some recordings, or of all, fail."""
    good = under_test.evaluate_recording

    def evaluate(manifest, *others):
        if not failing or manifest.folder.name in failing:
            raise error
        return good(manifest, *others)

    patch.setattr(under_test, "evaluate_recording", evaluate)


def test_one_folder_each_and_merged_tables_at_the_top(campaign, evaluated, tmp_path, capsys):
    before = folder_contents(campaign)
    outcomes = run_path(campaign, tmp_path / "elsewhere", Settings())
    assert [outcome.folder for outcome in outcomes] == [tmp_path / "elsewhere" / name for name in NAMES]
    assert folder_contents(campaign) == before
    assert main(["run", str(campaign)]) == EXIT_DONE
    top = campaign / "results"
    assert evaluated == [*NAMES, *NAMES]
    assert names_in(top) == {*NAMES, *JOINT}
    for name in NAMES:
        assert names_in(top / name) == {*TABLES, "result.h5", "report.html"}
    for table in TABLES:
        assert _recordings(top / table) == TITLES
        parts = [(top / name / table).read_text().splitlines() for name in NAMES]
        assert (top / table).read_text().splitlines() == [*parts[0], *parts[1][1:]]
    assert re.search(r"^2 recordings: 2 ", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize("named", ["folder", "file", "here"])
def test_a_single_recording_writes_into_its_folder(named, campaign, evaluated, monkeypatch):
    folder = campaign / NAMES[0]
    monkeypatch.chdir(folder)
    path = {"folder": folder, "file": folder / "recording.toml", "here": Path(".")}[named]
    (outcome,) = run_path(path, None, Settings())
    assert outcome.folder.resolve() == folder / "results"
    assert names_in(folder / "results") == {*TABLES, "result.h5", "report.html"}
    assert evaluated == [NAMES[0]]


def test_a_campaign_of_one_recording_is_a_campaign_and_prints_its_sensitivity(make_campaign, evaluated, capsys):
    top = make_campaign().parent
    assert main(["run", str(top)]) == EXIT_DONE
    assert names_in(top / "results") == {NAMES[0], *JOINT}
    assert len(evaluated) == 1
    lines = capsys.readouterr().out.splitlines()
    assert "(ratio), Fz 106.25 Hz (U = k·u, 95 %)" in lines[0]  # the result first
    assert lines[-2].startswith("1 recording: 1 ")
    assert lines[-1].endswith(f": {top / 'results' / 'report.html'}")


@pytest.mark.parametrize(
    ("error", "status", "declared", "workers", "failing"),
    [
        (InputError(REFUSED_BY_READER, "a.h5", "Fz", reason="b"), EXIT_INPUT, REFUSED_BY_READER, "1", NAMES[0]),
        (ComputeError(WORKER_ENDED, attempts=3), EXIT_FAILED, WORKER_ENDED, "2", NAMES[0]),
        (OSError(28, "disk full"), EXIT_FAILED, SYSTEM_REFUSED, "1", NAMES[1]),
        (KeyError("x"), EXIT_FAILED, INTERNAL_ERROR, "1", NAMES[0]),
    ],
)
def test_a_recording_that_fails_does_not_stop_the_other(
    workers, failing, error, status, declared, campaign, evaluated, monkeypatch, capsys
):
    monkeypatch.setattr("fusion.campaign.run.Workers", lambda size: InlineExecutor(size, waits=True))
    _fail(monkeypatch, error, failing)
    assert main(["run", str(campaign), "-q", "--workers", workers]) == status
    (other,) = set(NAMES) - {failing}
    assert evaluated == [other]
    assert names_in(campaign / "results") == {other, *JOINT}
    printed = capsys.readouterr()
    assert f"shakercal: {declared.code} " in printed.err
    assert f"{failing}: failed, {declared.code} " in printed.out
    assert re.search(r"^2 recordings: 1 .*, 1 ", printed.out, re.MULTILINE)


@pytest.mark.usefixtures("evaluated")
def test_if_all_fail_there_is_no_results_folder_and_one_message(campaign, monkeypatch, refused):
    monkeypatch.setattr("fusion.campaign.run.Workers", lambda _: InlineExecutor())
    _fail(monkeypatch, ComputeError(WORKER_ENDED, attempts=3))
    before = folder_contents(campaign)
    assert main(["run", str(campaign)]) == EXIT_FAILED
    assert folder_contents(campaign) == before
    assert not (campaign / "results").exists()
    sentence = refused("run", campaign / NAMES[0], "--workers", 2, status=EXIT_FAILED)
    assert sentence.startswith(f"shakercal: {WORKER_ENDED.code} ")


def test_wrong_input_has_priority_over_a_failed_computation():
    wrong, failed = InputError(REFUSED_BY_READER, "a", reason="b"), ComputeError(WORKER_ENDED, attempts=3)
    for errors, status in (([None], 0), ([None, failed], 1), ([failed, wrong], 2)):
        assert exit_status([Outcome(Path("a"), Path("b"), error=error) for error in errors]) == status


def test_a_second_run_computes_only_damaged_results_and_other_settings(campaign, evaluated, capsys):
    assert main(["run", str(campaign)]) == EXIT_DONE
    first, times = folder_contents(campaign / "results"), _times(campaign / "results")
    assert main(["run", str(campaign)]) == EXIT_DONE
    assert evaluated == NAMES
    assert folder_contents(campaign / "results") == first
    again = _times(campaign / "results")
    assert all(again[name] == times[name] for name in first if "/" in name)  # not even written again
    assert re.search(r"^2 recordings: 2 ", capsys.readouterr().out, re.MULTILINE)
    (campaign / "results" / NAMES[0] / "report.html").unlink()
    assert main(["run", str(campaign)]) == EXIT_DONE
    assert evaluated == [*NAMES, NAMES[0]]
    assert (campaign / "results" / NAMES[0] / "report.html").is_file()
    assert main(["run", str(campaign), "--subset-radius", "12"]) == EXIT_DONE
    assert evaluated == [*NAMES, NAMES[0], *NAMES]


def test_an_interrupted_campaign_goes_on_where_it_stopped(campaign, evaluated, monkeypatch):
    with monkeypatch.context() as patch:
        _fail(patch, KeyboardInterrupt(), NAMES[1])
        assert main(["run", str(campaign)]) == 130
    assert names_in(campaign / "results") == {NAMES[0]}
    assert main(["run", str(campaign)]) == EXIT_DONE
    assert evaluated == NAMES
    assert names_in(campaign / "results") == {*NAMES, *JOINT}


def test_results_of_edited_manifests_are_replaced_of_a_campaign_as_of_a_recording(campaign, evaluated):
    alone = campaign / NAMES[0]
    for path, done in ((campaign, NAMES), (alone, NAMES[:1])):
        assert main(["run", str(path), "-q"]) == EXIT_DONE
        assert evaluated == done
        for edited in (campaign / "rig.toml", alone / "recording.toml"):
            evaluated.clear()
            with edited.open("a", encoding="utf-8") as stream:
                stream.write("# edited\n")
            assert main(["run", str(path), "-q"]) == EXIT_DONE
            assert evaluated == (done if edited.name == "rig.toml" else NAMES[:1])
        evaluated.clear()
    assert main(["run", str(campaign / NAMES[1]), "-o", str(alone / "results"), "-q"]) == EXIT_INPUT


def test_results_of_changed_input_are_refused_and_force_replaces_them(campaign, evaluated, capsys):
    assert main(["run", str(campaign)]) == EXIT_DONE
    with h5py.File(campaign / NAMES[1] / "vibrometer.h5", "w") as file:
        file["velocity"] = [1.0]
    before = folder_contents(campaign / "results" / NAMES[1])
    capsys.readouterr()
    assert main(["run", str(campaign), "-q"]) == EXIT_INPUT
    assert capsys.readouterr().err.startswith(f"shakercal: {OTHER_CONTENT.code} {campaign / 'results' / NAMES[1]}: ")
    assert evaluated == NAMES
    assert folder_contents(campaign / "results" / NAMES[1]) == before
    assert main(["run", str(campaign), "--force"]) == EXIT_DONE
    assert evaluated == [*NAMES, *NAMES]
    assert _recordings(campaign / "results" / "load.csv") == TITLES


@pytest.mark.parametrize("name", ["thesis.txt", "sensitivity.csv", "Fz-0800.00/notes.txt"])
def test_merged_tables_never_go_among_other_files(name, campaign, evaluated, tmp_path, refused):
    top = tmp_path / "mine"
    (top / name).parent.mkdir(parents=True)
    (top / name).write_text("mine")
    assert refused("run", campaign, "-o", top).startswith(f"shakercal: {OTHER_CAMPAIGN_CONTENT.code} {top}: ")
    assert names_in(top) == {name.split("/", maxsplit=1)[0]}
    assert not evaluated
    if name != "sensitivity.csv":
        assert main(["run", str(campaign), "-o", str(top), "--force"]) == EXIT_DONE
        assert (top / name).read_text() == "mine"


@pytest.mark.parametrize(("options", "again"), [([], []), (["--force"], [NAMES[1]])])
def test_a_recording_that_is_broken_or_gone_does_not_disturb_the_other(options, again, campaign, evaluated, capsys):
    assert main(["run", str(campaign)]) == EXIT_DONE
    edit(campaign / NAMES[0] / "recording.toml", "scale = 0.125", "scal = 0.125")
    assert main(["run", str(campaign), *options]) == EXIT_INPUT
    assert evaluated == [*NAMES, *again]
    assert f"{campaign / NAMES[0] / 'recording.toml'}: daq.vibrometer" in capsys.readouterr().err
    shutil.rmtree(campaign / NAMES[0])
    (campaign / "results" / ".DS_Store").write_text("of the system")
    assert main(["run", str(campaign)]) == EXIT_DONE
    assert evaluated == [*NAMES, *again]
    assert _recordings(campaign / "results" / "sensitivity.csv") == TITLES[1:]


@pytest.mark.parametrize("kept", [False, True])
def test_new_results_take_the_place_of_old_ones_as_a_whole(kept, campaign, evaluated, monkeypatch):
    assert main(["run", str(campaign)]) == EXIT_DONE
    before = folder_contents(campaign / "results" / NAMES[0])
    replaced = os.replace

    def killed_after_the_first_step(source: Path, target: Path) -> None:
        replaced(source, target)
        if str(target).endswith(".old"):
            raise SystemExit

    def refused(source: Path, target: Path) -> None:
        if str(target).endswith(".old"):
            raise PermissionError(13, "a mounted folder")
        replaced(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("fusion.report.folder.os.replace", refused if kept else killed_after_the_first_step)
        if kept:
            assert main(["run", str(campaign), "--subset-radius", "12"]) == EXIT_DONE
        else:
            with pytest.raises(SystemExit):
                run_path(campaign, None, Settings(subset_radius_px=12))
    assert main(["run", str(campaign), "--subset-radius", "12"]) == EXIT_DONE
    after = folder_contents(campaign / "results" / NAMES[0])
    assert set(after) == set(before)
    assert after["result.h5"] != before["result.h5"]
    assert evaluated == ([*NAMES, *NAMES] if kept else [*NAMES, NAMES[0], *NAMES])


def test_outcomes_are_in_the_order_of_the_recordings_whoever_was_first(campaign, evaluated, monkeypatch, capsys):
    monkeypatch.setattr("fusion.campaign.run.Workers", lambda size: InlineExecutor(size, waits=True))
    assert main(["run", str(campaign), "--workers", "2"]) == EXIT_DONE
    printed = capsys.readouterr()
    assert evaluated == NAMES[::-1]
    lines = printed.out.splitlines()
    assert "(ratio)" in lines[0]
    assert any("ratio Fz" in line and "2 (" in line for line in lines)  # one mean of both
    assert lines[-2].startswith("2 recordings: 2 ")
    assert lines[-1].endswith("report.html")
    assert printed.err.count("SC-999 top: ") == 1
    assert re.search(r"SC-999 top: .*\(all 2 ", printed.err)
    assert main(["run", str(campaign), "--workers", "2"]) == EXIT_DONE
    assert re.search(r"^2 recordings: 2 ", capsys.readouterr().out, re.MULTILINE)
    assert _recordings(campaign / "results" / "load.csv") == TITLES


def test_a_notice_of_many_recordings_is_listed_once_warnings_first(tmp_path):
    outcomes = []
    varying = DeclaredNotice("SC-999", "warning", "{percent:g} % at {frequency_hz:g} Hz ({channel})")
    constant = DeclaredNotice("SC-998", "note", "equal in all recordings")
    cases = ((2.1, 80.0, "velocity_1"), (3.0, -160.0, "velocity_1"), (3.0, 7.0, "velocity_2"))
    for number, (percent, frequency_hz, channel) in enumerate(cases):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        outcomes.append(Outcome(folder / "recording.toml", folder))
        values = {"percent": percent, "frequency_hz": frequency_hz, "channel": channel}
        notices = (Notice(constant, "load"), Notice(varying, "laser", **values))
        with h5py.File(folder / "result.h5", "w") as file:
            write_value(file, "notices", notices)
    found = notices_of(outcomes, campaign=False)
    assert [(re.findall(r"−?[\d.]+", one.text), one.recordings) for one in found] == [
        (["2.1", "3", "−160", "80", "1"], ("0", "1")),
        (["3", "7", "2"], ("2",)),
        ([], ("0", "1", "2")),
    ]
    assert [one.everywhere for one in found] == [False, False, True]
    assert [(one.values["frequency_hz"], names) for one, names in found[0].each] == [(80.0, ("0",)), (-160.0, ("1",))]


def test_the_answer_for_programs(campaign, evaluated, capsys):
    assert main(["run", str(campaign), "--json", "-q"]) == EXIT_DONE
    answer = json.loads(capsys.readouterr().out)
    row = next(row for row in rows(campaign / "results" / CURVE_FILE) if row["channel"] == row["component"] == "Fz")
    (entry,) = (e for e in answer["sensitivity"] if e["frequency_hz"] == float(row["frequency_hz"]))
    assert entry["magnitude"] == float(row["magnitude"])
    assert entry["U_magnitude"] == pytest.approx(float(row["u_magnitude"]) * float(row["k_magnitude"]))
    assert [one["state"] for one in answer["recordings"]] == ["evaluated"] * 2
    assert all(Path(file).is_file() for file in answer["files"])
    assert {*(field.name for field in fields(Notice)), "recordings"} == set(answer["notices"][0])
    assert len(evaluated) == 2


def test_printed_values_have_u_by_their_factor_and_no_phase_near_zero(tmp_path):
    evaluation = make_evaluation(tmp_path)
    (tmp_path / SENSITIVITY_FILE).write_text(result_tables(evaluation)[SENSITIVITY_FILE], encoding="utf-8")
    found = rows(tmp_path / SENSITIVITY_FILE)
    assert row_element(found[2]) == sensitivity_element(evaluation.sensitivity, 0, 2, 2)
    few = found[2] | {"dof": "4.0", "k_magnitude": "2.776445", "k_phase": "2.776445"}
    weak = found[0] | {"re": "1e-11", "im": "0.0", "u_re": "2e-11", "u_im": "1e-11", "r": "0.0"}
    weak |= {"region_re": "4.895e-11", "region_im": "2.448e-11", "region_r": "0.0"}
    console = Console(width=160, file=io.StringIO(), record=True)
    # A region that is thin beside the origin: the magnitude may be next to nothing, and the phase anything.
    thin = {"u_re": "1.5e-9", "u_im": "1e-12", "r": "0.0", "u_magnitude": "1.5e-9", "u_phase_rad": "0.03"}
    thin = found[1] | thin | {"re": "2.9e-9", "im": "-1e-11", "magnitude": "2.9e-9"}
    thin |= {"k_magnitude": "1.96", "k_phase": "1.96"}
    thin |= {"region_re": "3.67e-9", "region_im": "2.448e-12", "region_r": "0.0"}
    console.print(sensitivity_table([found[2], few, weak, thin]))
    text = console.export_text()
    expanded = coverage_factor(4.0) * float(few["u_magnitude"]) * 1e7
    for words in ("(1.9720 ± 0.0019) × 10⁻⁷", f"(1.9720 ± {expanded:.4f}) × 10⁻⁷", "2.78",
                  "(region ± 4.9, ± 2.4) × 10⁻¹¹", "2.45"):  # fmt: skip
        assert words in text
    (row,) = (line for line in text.splitlines() if "(2.9 ± 2.9) × 10⁻⁹" in line)
    assert "\N{EN DASH}" in row


def test_a_campaign_prints_its_curve_and_its_failures(tmp_path, capsys):
    table = result_tables(make_evaluation(tmp_path))[SENSITIVITY_FILE]
    (tmp_path / SENSITIVITY_FILE).write_text(table, encoding="utf-8")
    one = rows(tmp_path / SENSITIVITY_FILE)[2] | {"recordings": "4", "mountings": "2"}
    # Two ratios and two elements along z, one element of a matrix along x, and outputs that are not the load's own.
    curve_rows = [
        one | {"kind": kind, "component": component, "channel": channel, "frequency_hz": frequency, "magnitude": size}
        for kind, component, channel, frequency, size in (
            ("ratio", "Fz", "Fz", "80.0", "1.97e-7"), ("ratio", "Fz", "Fz", "160.0", "1.96e-7"),
            ("element", "Fz", "Fz", "80.0", "1.98e-7"), ("element", "Fz", "Fz", "160.0", "1.99e-7"),
            ("matrix", "Fz", "Fz", "80.0", "1.95e-7"), ("element", "Fz", "Fx", "80.0", "1e-9"),
            ("matrix", "Fx", "bridge 1", "80.0", "5.1e-7"), ("matrix", "Fx", "bridge 2", "80.0", "1.2e-9"),
        )
    ]  # fmt: skip
    lines = [",".join(one), *(",".join(row.values()) for row in curve_rows)]
    (tmp_path / CURVE_FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")
    outcomes = [Outcome(tmp_path / f"{k}" / "recording.toml", tmp_path / f"{k}") for k in range(9)]
    outcomes[7] = replace(outcomes[7], error=ComputeError(WORKER_ENDED, attempts=3))
    print_outcomes(outcomes, campaign=True)
    said = capsys.readouterr().out
    console = Console(width=160, file=io.StringIO(), record=True)
    console.print(sensitivity_table(main_curve(curve_rows)))
    narrow = Console(width=80, file=io.StringIO(), record=True)
    narrow.print(sensitivity_table(main_curve(curve_rows), 80))
    text = narrow.export_text()
    assert text.startswith("Sensitivity in (V/V)/N, ")
    assert max(map(len, text.splitlines())) <= 80
    assert all(
        re.search(rf"│ +{value} │ Fz per Fz +│ +\(1\.9[89].* ± .*\) × 10⁻⁷ │", text)
        for value in ("80.0000", "160.0000")
    )
    lines = [line for line in console.export_text().splitlines() if line.startswith("│")]
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines]
    assert [(row[0], row[1], row[2][:5], row[6], row[7]) for row in cells] == [
        ("80.0000", "bridge 1 per Fx", "(5.10", "matrix", "4 (2)"),
        ("80.0000", "Fz per Fz", "(1.98", "element", "4 (2)"),
        ("160.0000", "Fz per Fz", "(1.99", "element", "4 (2)"),
    ]
    assert f"7: failed, {WORKER_ENDED.code} " in said
    assert "8: " not in said
    assert re.search(r"^9 recordings: 8 .*, 1 ", said, re.MULTILINE)
