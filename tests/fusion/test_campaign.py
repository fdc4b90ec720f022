"""A campaign of recordings: one folder each, merged tables, resumed runs, failures that stop nobody else."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import h5py
import pytest

from fusion.base import ComputeError, InputError, Settings
from fusion.campaign import cluster as under_test
from fusion.campaign.cluster import Outcome
from fusion.campaign.run import exit_status, run_path
from fusion.campaign.workers import Answer, call
from fusion.cli import main
from fusion.commands.options import EXIT_DONE, EXIT_FAILED, EXIT_INPUT
from fusion.report.recording import CAMPAIGN_FILES

Campaign = Callable[..., Path]
Capture = pytest.CaptureFixture[str]
NAMES = ["Fz-0106.25", "Fz-0375.90"]
TABLES = {"sensitivity.csv", "acceleration.csv", "load.csv"}
JOINT = set(CAMPAIGN_FILES)


@pytest.fixture
def campaign(make_campaign: Campaign) -> Path:
    """Two recordings of one rig."""
    first = make_campaign()
    second = first.with_name(NAMES[1])
    shutil.copytree(first, second)
    _change(second / "recording.toml", 'name = "Fz 106.25 Hz"', 'name = "Fz 375.90 Hz"')
    return first.parent


def _change(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def _state(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Content and time of every file."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def _recordings(path: Path) -> list[str]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(dict.fromkeys(row["recording"] for row in csv.DictReader(stream)))


def test_one_folder_each_and_merged_tables_at_the_top(campaign, evaluated, capsys):
    assert main(["run", str(campaign)]) == EXIT_DONE
    top = campaign / "results"
    assert evaluated == NAMES
    assert {path.name for path in top.iterdir()} == {*NAMES, *JOINT}
    for name in NAMES:
        assert {path.name for path in (top / name).iterdir()} == {*TABLES, "result.h5", "report.html"}
    for table in TABLES:
        assert _recordings(top / table) == ["Fz 106.25 Hz", "Fz 375.90 Hz"]
        parts = [(top / name / table).read_text().splitlines() for name in NAMES]
        assert (top / table).read_text().splitlines() == [*parts[0], *parts[1][1:]]
    assert capsys.readouterr().out.count("report (written)") == 2


def test_results_of_another_place(campaign, evaluated, tmp_path):
    before = _state(campaign)
    outcomes = run_path(campaign, tmp_path / "elsewhere", Settings())
    assert [outcome.folder for outcome in outcomes] == [tmp_path / "elsewhere" / name for name in NAMES]
    assert _state(campaign) == before
    assert len(evaluated) == 2


@pytest.mark.parametrize("named", ["folder", "file", "here"])
def test_a_single_recording_writes_into_its_own_folder(named, campaign, evaluated, monkeypatch):
    folder = campaign / NAMES[0]
    monkeypatch.chdir(folder)
    path = {"folder": folder, "file": folder / "recording.toml", "here": Path(".")}[named]
    (outcome,) = run_path(path, None, Settings())
    assert outcome.folder.resolve() == folder / "results"
    assert {path.name for path in (folder / "results").iterdir()} == {*TABLES, "result.h5", "report.html"}
    assert evaluated == [NAMES[0]]


def test_a_campaign_of_one_recording_is_a_campaign(make_campaign, evaluated):
    top = make_campaign().parent
    (outcome,) = run_path(top, None, Settings())
    assert outcome.folder == top / "results" / NAMES[0]
    assert (top / "results" / "sensitivity.csv").is_file()
    assert len(evaluated) == 1


@pytest.mark.parametrize(
    ("error", "status"), [(InputError("a.h5", "Fz", "b", "c"), EXIT_INPUT), (ComputeError("no motion"), EXIT_FAILED)]
)
@pytest.mark.parametrize("failing", NAMES)
def test_a_recording_that_fails_does_not_stop_the_other(
    failing, error, status, campaign, evaluated, monkeypatch, capsys
):
    good = under_test.evaluate_recording

    def evaluate(manifest, *others):
        if manifest.folder.name == failing:
            raise error
        return good(manifest, *others)

    monkeypatch.setattr(under_test, "evaluate_recording", evaluate)
    assert main(["run", str(campaign), "-q"]) == status
    (other,) = set(NAMES) - {failing}
    assert evaluated == [other]
    assert {path.name for path in (campaign / "results").iterdir()} == {other, *JOINT}
    told = capsys.readouterr()
    assert f"shakercal: {error}\n" in told.err
    assert f"{failing}: failed, {error}" in told.out
    assert told.out.count("report (written)") == 1


def test_a_broken_manifest_does_not_stop_the_other(campaign, evaluated, capsys):
    _change(campaign / NAMES[0] / "recording.toml", "scale =", "scal =")
    assert main(["run", str(campaign)]) == EXIT_INPUT
    assert evaluated == [NAMES[1]]
    assert f"shakercal: {campaign / NAMES[0] / 'recording.toml'}: daq.vibrometer" in capsys.readouterr().err


def test_when_all_fail_there_is_no_results_folder(campaign, evaluated, monkeypatch):
    def fail(*_: object) -> None:
        raise ComputeError("no motion")

    monkeypatch.setattr(under_test, "evaluate_recording", fail)
    before = _state(campaign)
    assert main(["run", str(campaign)]) == EXIT_FAILED
    assert _state(campaign) == before
    assert not (campaign / "results").exists()
    assert not evaluated


def test_wrong_input_weighs_more_than_what_could_not_be_computed():
    def outcome(error: InputError | ComputeError | None) -> Outcome:
        return Outcome(Path("a"), Path("b"), error=error)

    wrong, failed = InputError("a", "b", "c", "d"), ComputeError("e")
    assert exit_status([outcome(None)]) == 0
    assert exit_status([outcome(None), outcome(failed)]) == 1
    assert exit_status([outcome(failed), outcome(wrong)]) == 2


def test_the_second_run_computes_nothing_and_changes_no_byte(campaign, evaluated, capsys):
    assert main(["run", str(campaign)]) == EXIT_DONE
    first = _state(campaign / "results")
    assert main(["run", str(campaign)]) == EXIT_DONE
    second = _state(campaign / "results")
    assert evaluated == NAMES
    assert {name: content for name, (content, _) in first.items()} == {n: c for n, (c, _) in second.items()}
    assert all(first[name] == second[name] for name in first if "/" in name)  # not even written again
    assert capsys.readouterr().out.count("report (unchanged since the last run)") == 2


def test_an_interrupted_campaign_goes_on_where_it_stopped(campaign, evaluated, monkeypatch):
    good = under_test.evaluate_recording

    def evaluate(manifest, *others):
        if manifest.folder.name == NAMES[1]:
            raise KeyboardInterrupt
        return good(manifest, *others)

    with monkeypatch.context() as patch:
        patch.setattr(under_test, "evaluate_recording", evaluate)
        assert main(["run", str(campaign)]) == 130
    assert {path.name for path in (campaign / "results").iterdir()} == {NAMES[0]}
    assert main(["run", str(campaign)]) == EXIT_DONE
    assert evaluated == NAMES
    assert {path.name for path in (campaign / "results").iterdir()} == {*NAMES, *JOINT}


def test_results_of_changed_input_are_refused_and_force_replaces_them(campaign, evaluated, capsys):
    assert main(["run", str(campaign)]) == EXIT_DONE
    with h5py.File(campaign / NAMES[1] / "vibrometer.h5", "w") as file:
        file["velocity"] = [1.0]
    before = _state(campaign / "results" / NAMES[1])
    capsys.readouterr()
    assert main(["run", str(campaign), "-q"]) == EXIT_INPUT
    told = capsys.readouterr().err
    assert told.startswith(f"shakercal: {campaign / 'results' / NAMES[1]}: expected an empty folder")
    assert told.endswith("found results of other input files\n")
    assert evaluated == NAMES
    assert _state(campaign / "results" / NAMES[1]) == before
    assert main(["run", str(campaign), "--force"]) == EXIT_DONE
    assert evaluated == [*NAMES, *NAMES]
    assert _recordings(campaign / "results" / "load.csv") == ["Fz 106.25 Hz", "Fz 375.90 Hz"]


def test_other_settings_compute_again(campaign, evaluated):
    assert main(["run", str(campaign)]) == EXIT_DONE
    assert main(["run", str(campaign), "--subset-radius", "12"]) == EXIT_DONE
    assert evaluated == [*NAMES, *NAMES]


def test_damaged_results_are_computed_again(campaign, evaluated):
    assert main(["run", str(campaign)]) == EXIT_DONE
    (campaign / "results" / NAMES[0] / "report.html").unlink()
    assert main(["run", str(campaign)]) == EXIT_DONE
    assert evaluated == [*NAMES, NAMES[0]]
    assert (campaign / "results" / NAMES[0] / "report.html").is_file()


@pytest.mark.parametrize("name", ["thesis.txt", "sensitivity.csv", "Fz-0800.00/notes.txt"])
def test_merged_tables_never_go_among_other_files(name, campaign, evaluated, tmp_path, capsys):
    top = tmp_path / "mine"
    (top / name).parent.mkdir(parents=True)
    (top / name).write_text("mine")
    assert main(["run", str(campaign), "-o", str(top)]) == EXIT_INPUT
    assert f"shakercal: {top}: expected results of this campaign only (--force" in capsys.readouterr().err
    assert [path.name for path in top.iterdir()] == [name.split("/", maxsplit=1)[0]]
    assert not evaluated
    if name != "sensitivity.csv":
        assert main(["run", str(campaign), "-o", str(top), "--force"]) == EXIT_DONE
        assert (top / name).read_text() == "mine"


def test_results_of_a_recording_that_is_gone_do_not_disturb(campaign, evaluated):
    assert main(["run", str(campaign)]) == EXIT_DONE
    shutil.rmtree(campaign / NAMES[0])
    (campaign / "results" / ".DS_Store").write_text("of the system")
    assert main(["run", str(campaign)]) == EXIT_DONE
    assert evaluated == NAMES
    assert _recordings(campaign / "results" / "sensitivity.csv") == ["Fz 375.90 Hz"]


@pytest.mark.parametrize("kept", [False, True])
def test_new_results_take_the_place_of_old_ones_as_a_whole(kept, campaign, evaluated, monkeypatch):
    assert main(["run", str(campaign)]) == EXIT_DONE
    before = _state(campaign / "results" / NAMES[0])
    replaced = os.replace

    def killed_after_the_first_step(source: Path, target: Path) -> None:
        replaced(source, target)
        if ".old-" in str(target):
            raise SystemExit

    def refused(source: Path, target: Path) -> None:
        if ".old-" in str(target):
            raise PermissionError(13, "a mounted folder")
        replaced(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("fusion.report.recording.os.replace", refused if kept else killed_after_the_first_step)
        if kept:
            assert main(["run", str(campaign), "--subset-radius", "12"]) == EXIT_DONE
        else:
            with pytest.raises(SystemExit):
                run_path(campaign, None, Settings(subset_radius_px=12))
    assert main(["run", str(campaign), "--subset-radius", "12"]) == EXIT_DONE
    after = _state(campaign / "results" / NAMES[0])
    assert set(after) == set(before)
    assert after["result.h5"] != before["result.h5"]
    assert evaluated == ([*NAMES, *NAMES] if kept else [*NAMES, NAMES[0], *NAMES])


class Inline:
    """Workers that are this process and answer in the opposite order."""

    def __init__(self, size: int) -> None:
        self.waiting: list[tuple[Future[Answer], Callable[..., object], tuple[object, ...]]] = []
        self.size = size

    def __enter__(self) -> Inline:
        return self

    def __exit__(self, *_: object) -> None:
        assert not self.waiting

    def submit(self, rank: int, function: Callable[..., object], *arguments: object) -> Future[Answer]:
        future: Future[Answer] = Future()
        self.waiting.append((future, function, arguments))
        if len(self.waiting) == self.size:
            while self.waiting:
                late, work, given = self.waiting.pop()
                late.set_result(call(work, *given))
        return future


def test_outcomes_are_in_the_order_of_the_recordings_whoever_was_first(campaign, evaluated, monkeypatch, capsys):
    monkeypatch.setattr("fusion.campaign.run.Workers", Inline)
    assert main(["run", str(campaign), "--workers", "2"]) == EXIT_DONE
    told = capsys.readouterr()
    assert evaluated == NAMES[::-1]
    lines = told.out.splitlines()
    assert [line.split(":")[0] for line in lines] == [*NAMES, "2 recordings", "report of all"]
    assert lines[2] == "2 recordings: 2 evaluated"
    assert [f"shakercal: {name}: 318.75 Hz" in told.err for name in NAMES] == [True, True]
    assert main(["run", str(campaign), "--workers", "2"]) == EXIT_DONE
    assert "2 recordings: 2 unchanged since the last run" in capsys.readouterr().out
    assert _recordings(campaign / "results" / "load.csv") == ["Fz 106.25 Hz", "Fz 375.90 Hz"]


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (InputError("a.h5", "Fz", "b", "c"), EXIT_INPUT, "a.h5: Fz: expected c, found b"),
        (OSError(28, "disk full"), EXIT_FAILED, "the system refused to read or write ([Errno 28] disk full)"),
        (KeyError("x"), EXIT_FAILED, "internal error (KeyError: 'x'); please report it, -v shows where"),
    ],
)
@pytest.mark.parametrize("workers", ["1", "2"])
def test_any_failure_of_a_recording_is_its_own(
    workers, error, status, sentence, campaign, evaluated, monkeypatch, capsys
):
    good = under_test.evaluate_recording

    def evaluate(manifest, *others):
        if manifest.folder.name == NAMES[0]:
            raise error
        return good(manifest, *others)

    monkeypatch.setattr("fusion.campaign.run.Workers", Inline)
    monkeypatch.setattr(under_test, "evaluate_recording", evaluate)
    assert main(["run", str(campaign), "-q", "--workers", workers]) == status
    told = capsys.readouterr()
    assert f"shakercal: {sentence}\n" in told.err
    assert f"{NAMES[0]}: failed, {sentence}\n" in told.out
    assert "2 recordings: 1 evaluated, 1 failed" in told.out
    assert evaluated == [NAMES[1]]


def test_the_failure_of_a_single_recording_is_told_once(campaign, monkeypatch, capsys):
    def fail(*_: object) -> None:
        raise ComputeError("no motion")

    monkeypatch.setattr("fusion.campaign.run.Workers", lambda _: Inline(1))
    monkeypatch.setattr(under_test, "evaluate_recording", fail)
    assert main(["run", str(campaign / NAMES[0]), "--workers", "2"]) == EXIT_FAILED
    assert capsys.readouterr().err == "shakercal: no motion\n"
