"""External faults: full disks, changing inputs, killed runs, terminals without some characters."""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any

import faults
import pytest
from cluster_factory import environment, wait_until
from contracts import slow
from support import without_pages

from fusion.cli import main
from fusion.commands.options import EXIT_CLOSED, EXIT_DONE, EXIT_FAILED, EXIT_INPUT
from fusion.errors import ADDRESS_SPACE_TOO_SMALL, PATH_NOT_UTF8, ComputeError, InputError
from fusion.report import atomic_files
from fusion.report.atomic_files import file_lock, remove_abandoned, write_atomically, write_files, write_together
from fusion.report.folder import hash_files, hashing, sha256
from fusion.report.report_notices import CHANGED_INPUT, NOT_WRITTEN, PATH_TOO_LONG, UNREADABLE_INPUT
from fusion.report.table import TableColumn, csv_text, read_rows
from fusion.report.terminal import Terminal, printable

REFUSALS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.ESTALE)


class Disk:
    """The one place that writes, on a disk that refuses the write of some number after half of its bytes."""

    def __init__(self, refused: int, code: int) -> None:
        self.refused, self.code, self.count = refused, code, 0

    def __call__(self, path: Path, content: str | bytes | Iterable[str]) -> None:
        self.count += 1
        data = content if isinstance(content, bytes) else "".join(content).encode()
        if self.count == self.refused:
            path.write_bytes(data[: len(data) // 2])
            raise OSError(self.code, os.strerror(self.code), str(path))
        path.write_bytes(data)

    @classmethod
    def put(cls, patch: pytest.MonkeyPatch, refused: int, code: int) -> Disk:
        """Put it in place of the function, wherever that has been imported."""
        disk = cls(refused, code)
        for module in list(sys.modules.values()):
            if getattr(module, "__name__", "").startswith("fusion.") and hasattr(module, "write_file"):
                patch.setattr(module, "write_file", disk)
        return disk


def _tree(folder: Path) -> dict[str, bytes | None]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")
    }


# Disks that refuse.


@pytest.mark.usefixtures("evaluated")
@pytest.mark.parametrize("there", [False, True])
def test_a_disk_that_refuses_any_write_leaves_everything_as_it_was(there, make_campaign, monkeypatch, capsys):
    without_pages(monkeypatch)
    folder = make_campaign()
    command = ["run", str(folder), "-q", "--force"]
    if there:
        assert main(command) == EXIT_DONE
    before, number = _tree(folder.parent), 0
    while True:
        number += 1
        code = REFUSALS[number % len(REFUSALS)]
        with monkeypatch.context() as patch:
            disk = Disk.put(patch, number, code)
            capsys.readouterr()
            status = main(command)
        if disk.count < number:
            break
        assert status == EXIT_FAILED
        output = capsys.readouterr()
        assert output.out == ""
        assert f"{folder / 'results'}: " in output.err.splitlines()[-1]
        assert os.strerror(code).lower() in output.err.splitlines()[-1]
        assert _tree(folder.parent) == before
    assert number > 5
    assert status == EXIT_DONE


@pytest.mark.parametrize("preset", ["rotation", *slow("loads", "elastomer")])
def test_a_simulation_on_a_full_disk_leaves_no_files(preset, tmp_path, monkeypatch, capsys):
    number, refused = 1, 1
    while refused:
        with monkeypatch.context() as patch:
            disk = Disk.put(patch, number, errno.ENOSPC)
            status = main(["simulate", str(tmp_path / "new" / "out"), "--preset", preset, "-q"])
        refused = status != EXIT_DONE
        if refused:
            assert status == EXIT_FAILED
            assert os.strerror(errno.ENOSPC).lower() in capsys.readouterr().err
            assert list(tmp_path.iterdir()) == []
        number += max(1, disk.count // 3)
    assert len(list((tmp_path / "new" / "out").iterdir())) >= 3


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A small file system."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = shutil.which("mount")
    made = mount and subprocess.run(
        [mount, "-t", "tmpfs", "-o", "size=40m", "tmpfs", place], capture_output=True, check=False
    )
    if not made or made.returncode:
        pytest.skip("this user may not mount a small file system")
    yield place
    subprocess.run(["umount", place], check=True)


@pytest.mark.usefixtures("evaluated")
def test_a_full_disk_is_reported_in_one_sentence(small_disk, make_campaign, capsys):
    folder = make_campaign()
    subprocess.run(["mount", "-o", "remount,size=100k", small_disk], check=True)
    assert main(["run", str(folder), "-o", str(small_disk / "results"), "-q"]) == EXIT_FAILED
    sentence = capsys.readouterr().err.splitlines()[-1]
    assert "results: " in sentence
    assert os.strerror(errno.ENOSPC).lower() in sentence
    assert list(small_disk.iterdir()) == []
    # The mounted folder itself as the place of the results.
    assert main(["run", str(folder), "-o", str(small_disk), "-q"]) == EXIT_FAILED
    assert list(small_disk.iterdir()) == []


@pytest.mark.usefixtures("evaluated")
def test_results_in_a_mounted_folder_are_replaced_file_by_file(small_disk, make_campaign, monkeypatch):
    without_pages(monkeypatch)
    folder = make_campaign()
    command = ["run", str(folder), "-o", str(small_disk), "-q", "--force"]
    assert main(command) == EXIT_DONE
    first = _tree(small_disk)
    assert {"result.h5", "report.html", "sensitivity.csv"} <= set(first)
    assert main(command) == EXIT_DONE
    assert set(_tree(small_disk)) == set(first)


# A table that another program holds open, as Windows refuses to replace it.


@pytest.mark.usefixtures("evaluated")
@pytest.mark.parametrize(("notes", "table"), [(False, "sensitivity.csv"), (True, "load.csv"), (True, "result.h5")])
def test_a_table_that_is_open_elsewhere_keeps_the_old_results_whole(notes, table, make_campaign, monkeypatch, capsys):
    without_pages(monkeypatch)
    folder = make_campaign()
    assert main(["run", str(folder), "-q"]) == EXIT_DONE
    results = folder / "results"
    if notes:
        (results / "notes.txt").write_text("mine")
    before, replace = _tree(folder.parent), os.replace

    def refuse(source: Any, target: Any) -> None:
        inside = Path(source) == results or results in (Path(source), *Path(source).parents)
        if inside and Path(source).name in ("results", table) and ".part" not in str(source):
            raise PermissionError(errno.EACCES, "Permission denied", str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    capsys.readouterr()
    assert main(["run", str(folder), "-q", "--force"]) == EXIT_FAILED
    sentence = capsys.readouterr().err.splitlines()[-1]
    assert f"{results}: " in sentence
    assert os.strerror(errno.EACCES).lower() in sentence
    assert f"({table})" in sentence
    assert _tree(folder.parent) == before


def _fill(contents: dict[str, str | bytes]) -> Callable[[Path], list[str]]:
    return lambda folder: write_files(folder, contents)


def test_every_failing_move_is_taken_back(tmp_path, monkeypatch):
    """Whatever move fails, at first or again while it is taken back, no old file is lost."""
    old = {"a.csv": "old a", "points/0.vtp": "old 0", "points/1.vtp": "old 1", "all.h5": "old"}
    new = {"a.csv": "new a", "b.csv": "new b", "points/0.vtp": "new 0", "all.h5": "new"}
    folder, replace = tmp_path / "results", os.replace
    write_together(folder, _fill(old), list)
    (folder / "points" / "mine.txt").write_text("mine")
    before, moves = _tree(folder), 0
    for refused in range(100):
        moves = 0

        def moved(source: Any, target: Any, refused: int = refused) -> None:
            nonlocal moves
            moves += 1
            if moves == refused + 1:
                raise PermissionError(errno.EACCES, "Permission denied", str(source))
            replace(source, target)

        monkeypatch.setattr(os, "replace", moved)
        with suppress(ComputeError):
            write_together(folder, _fill(new), lambda: list(old))
            break
        assert _tree(folder) == before
        assert [path.name for path in tmp_path.iterdir()] == ["results"]
    assert moves > 6
    monkeypatch.setattr(os, "replace", replace)
    found = {name: text for name, text in _tree(folder).items() if text is not None}
    assert found == {name: text.encode() for name, text in {**new, "points/mine.txt": "mine"}.items()}


def test_a_path_too_long_for_windows_is_reported(tmp_path, monkeypatch):
    """Windows reports a missing file, as a folder does that another run has just removed."""
    place = tmp_path.joinpath(*["folder of a recording" * 3] * 5) / "results"
    tried: list[str] = []

    def no_file(path: Any, *_: Any) -> int:
        tried.append(str(path))
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(atomic_files.os, "open", no_file)
        for path, declared in ((place, PATH_TOO_LONG), (Path("/tmp/a"), NOT_WRITTEN)):
            with pytest.raises(ComputeError) as error, file_lock(path):
                pass
            assert (error.value.code, error.value.where) == (declared.code, str(path.resolve()))
            assert str(path.resolve().parent) in error.value.values["reason"]
            characters = {"characters": len(tried[-1])} if declared is PATH_TOO_LONG else {}
            assert error.value.values == {"reason": error.value.values["reason"], **characters}
    assert not place.exists()
    assert not list(tmp_path.iterdir())
    name = "x" * 250  # too long for temporary names
    with pytest.raises(ComputeError, match=os.strerror(errno.ENAMETOOLONG).lower()):
        write_atomically(tmp_path / name, "text")


def test_folders_below_results_come_and_go_with_them(tmp_path):
    folder = tmp_path / "results"
    first = {"points-top/0000.vtp": "0", "points-top/0001.vtp": "1", "result.h5": b"h5"}
    write_together(folder, _fill(first), list)
    assert set(_tree(folder)) == {*first, "points-top"}
    write_together(folder, _fill({"result.h5": b"new"}), lambda: list(first))
    assert _tree(folder) == {"result.h5": b"new"}


# Inputs that change.


def _changed(path: Path, call: Callable[..., object], *arguments: Any) -> None:
    """Assert that a call refuses a file that changed, or that is gone if it is not there."""
    with pytest.raises(InputError) as error:
        call(*arguments)
    assert (error.value.code, error.value.file) == (CHANGED_INPUT.code, path)
    assert error.value.values == {"change": "changed" if path.exists() else "disappeared"}


def test_a_change_of_a_file_is_noticed(tmp_path):
    path, far = tmp_path / "a.h5", time.time_ns() - 10**12

    def hashed() -> Any:
        path.write_bytes(b"first")
        os.utime(path, ns=(far, far))
        return hash_files([path], tmp_path)

    inputs = hashed()
    inputs.check()
    for change in (
        lambda: path.write_bytes(b"second one"),
        lambda: path.write_bytes(b"other"),
        path.unlink,
        lambda: os.utime(path),
    ):
        inputs = hashed()
        change()
        _changed(path, inputs.check)
    # Another file of the same size and time is recognised by its content.
    for content, refused in ((b"first", False), (b"other", True)):
        inputs = hashed()
        (tmp_path / "new").write_bytes(content)
        os.utime(tmp_path / "new", ns=(far, far))
        os.replace(tmp_path / "new", path)
        if refused:
            _changed(path, inputs.check)
        else:
            inputs.check()
    # So is a file that changes within the resolution of its time.
    path.write_bytes(b"first")
    when = path.stat().st_mtime_ns
    inputs = hash_files([path], tmp_path)
    path.write_bytes(b"other")
    os.utime(path, ns=(when, when))
    _changed(path, inputs.check)


def test_a_file_that_changes_while_it_is_hashed_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    path.write_bytes(b"first")

    def grown(file: Path) -> str:
        with file.open("ab") as stream:
            stream.write(b"more")
        return "digest"

    monkeypatch.setattr("fusion.report.folder.sha256", grown)
    _changed(path, hash_files, [path], tmp_path)


@pytest.mark.parametrize("change", ["rewritten", "deleted", "unreadable"])
def test_a_change_of_a_file_during_hashing_is_reported_before_errors_of_its_content(
    change, make_campaign, monkeypatch, capsys
):
    """Files older than the resolution of file times are read while they are hashed."""
    folder, far, begun = make_campaign(), time.time_ns() - 10**12, Event()
    for path in filter(Path.is_file, folder.parent.rglob("*")):
        os.utime(path, ns=(far, far))
    file = folder / "vibrometer.h5"

    def late(path: Path) -> str:
        assert begun.wait(20.0)
        return sha256(path)

    def evaluate(*_: Any, **__: Any) -> Any:
        {"rewritten": lambda: file.write_bytes(b"other"), "deleted": file.unlink, "unreadable": unread}[change]()
        begun.set()
        raise ComputeError(UNREADABLE_INPUT, reason="its data")

    def unread() -> None:
        monkeypatch.setattr("fusion.report.folder.hashlib.file_digest", refuse)

    def refuse(*_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("fusion.report.folder.sha256", late)
    monkeypatch.setattr("fusion.campaign.run.evaluate_recording", evaluate)
    assert main(["run", str(folder), "-q"]) == EXIT_INPUT
    sentence = capsys.readouterr().err.splitlines()[-1]
    verb = {"rewritten": " changed ", "deleted": " disappeared ", "unreadable": "Permission denied"}
    assert verb[change] in sentence
    assert "vibrometer.h5" in sentence or change == "unreadable"
    assert not (folder / "results").exists()


def test_files_that_have_just_changed_are_hashed_before_they_are_read(tmp_path):
    path, far = tmp_path / "a.h5", time.time_ns() - 10**12
    path.write_bytes(b"first")
    begun = hashing([path], tmp_path)
    path.write_bytes(b"later")
    assert begun["a.h5"] == hashlib.sha256(b"first").hexdigest()
    os.utime(path, ns=(far, far))
    assert dict(hashing([path], tmp_path)) == {"a.h5": hashlib.sha256(b"later").hexdigest()}


@pytest.mark.parametrize("change", ["rewritten", "deleted"])
def test_a_run_on_a_changing_file_writes_no_results(change, make_campaign, ready_evaluation, monkeypatch, capsys):
    folder = make_campaign()
    file = folder / "vibrometer.h5"

    def evaluate(*_: Any, **__: Any) -> Any:
        if change == "deleted":
            file.unlink()
        else:
            file.write_bytes(b"of another copy")
        return ready_evaluation

    monkeypatch.setattr("fusion.campaign.run.evaluate_recording", evaluate)
    without_pages(monkeypatch)
    assert main(["run", str(folder), "-q"]) == EXIT_INPUT
    verb = "disappeared" if change == "deleted" else "changed"
    assert f"{file}: {verb} " in capsys.readouterr().err.splitlines()[-1]
    assert not (folder / "results").exists()


def test_a_manifest_that_changes_between_reading_and_hashing_is_refused(make_campaign, evaluated, monkeypatch, capsys):
    folder = make_campaign()

    def late(*arguments: Any) -> Any:
        with (folder / "recording.toml").open("a") as stream:
            stream.write("# another sentence\n")
        return hashing(*arguments)

    monkeypatch.setattr("fusion.campaign.run.hashing", late)
    assert main(["run", str(folder), "-q"]) == EXIT_INPUT
    assert "recording.toml: changed " in capsys.readouterr().err
    assert not evaluated


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no folder that takes no files")
def test_an_output_is_named_where_the_system_takes_no_file(capsys):
    assert main(["simulate", "/proc/results", "--preset", "elastomer", "-q"]) == EXIT_FAILED
    sentence = capsys.readouterr().err
    assert "/proc/results: " in sentence
    assert atomic_files.LOCK not in sentence


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_a_limited_address_space_ends_in_a_sentence(tmp_path):
    program = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (900_000_000,) * 2)\n"
        "from fusion.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, "simulate", str(tmp_path / "out"), "--preset", "elastomer"]
    run = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    assert run.returncode == EXIT_FAILED
    assert re.fullmatch(rf"shakercal: {ADDRESS_SPACE_TOO_SMALL.code} [^\n]*900 MB[^\n]*\n", run.stderr)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="names there are text")
def test_a_folder_whose_name_is_no_text_is_refused(make_campaign, evaluated, capsys):
    folder = make_campaign()
    folder.rename(os.fsdecode(os.fsencode(folder) + b"\xff"))
    for command in ("check", "run"):
        assert main([command, str(folder.parent), "-q"]) == EXIT_INPUT
        output = capsys.readouterr()
        assert PATH_NOT_UTF8.code in output.err + output.out
    assert not evaluated


# One run at a time, and what is left of one that was killed.

HOLD = """
import sys, time
from pathlib import Path
from fusion.report.atomic_files import file_lock, temporary_path
place = Path(sys.argv[1])
with file_lock(place), temporary_path(place) as made:
    made.mkdir()
    (made / "half").write_text("")
    Path(sys.argv[2]).write_text("held")
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[Callable[[Path], subprocess.Popen[bytes]]]:
    """Start processes that hold a place and make something for it."""
    started: list[subprocess.Popen[bytes]] = []

    def hold(place: Path) -> subprocess.Popen[bytes]:
        ready = tmp_path / f"held-{len(started)}"
        started.append(subprocess.Popen([sys.executable, "-c", HOLD, place, ready], env=environment()))
        wait_until(lambda: ready.exists() and bool(ready.read_text()))
        ready.unlink()
        return started[-1]

    yield hold
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.usefixtures("evaluated")
def test_two_runs_on_one_folder_and_the_files_of_a_killed_one(holder, make_campaign, monkeypatch, capsys):
    without_pages(monkeypatch)
    folder = make_campaign()
    before = set(_tree(folder.parent))
    first = holder(folder / "results")
    assert main(["run", str(folder), "-q"]) == EXIT_FAILED
    error = capsys.readouterr().err
    assert f"{folder / 'results'}: " in error
    assert error.count("\n") == 1
    assert len([path for path in folder.iterdir() if path.suffix == ".part"]) == 1
    first.kill()
    first.wait()
    assert main(["run", str(folder), "-q"]) == EXIT_DONE
    assert not list(folder.rglob(".*"))
    assert before < set(_tree(folder.parent))


def test_only_files_of_ended_processes_are_removed(holder, tmp_path):
    living, gone = holder(tmp_path / "Fz-0100"), holder(tmp_path / "Fz-0200")
    gone.kill()
    gone.wait()
    for name in (".DS_Store", ".hidden-123", ".poetry.lock", ".x-0123456789.part"):
        (tmp_path / name).write_text("")
    removed = {path.name.partition("-0200")[2].rpartition(".")[2] for path in remove_abandoned(tmp_path)}
    assert removed == {"part", atomic_files.LOCK}
    left = sorted(path.name for path in tmp_path.iterdir())
    assert len(left) == 6
    assert sum("Fz-0100" in name for name in left) == 2
    assert remove_abandoned(tmp_path / "none") == []
    assert living.poll() is None


def test_results_whose_replacement_was_killed_in_between_are_put_back(tmp_path):
    token = "0123456789ab"
    for kind, below in (("old", ""), ("aside", "points")):
        place = tmp_path / kind
        hidden = tmp_path / f".{kind}-{token}.{kind}" / below
        hidden.mkdir(parents=True)
        (hidden / "result.h5").write_text("old results")
        if kind == "aside":
            place.mkdir()
            (place / "notes.txt").write_text("mine")
    remove_abandoned(tmp_path)
    assert set(_tree(tmp_path)) == {
        "old", "old/result.h5", "aside", "aside/notes.txt", "aside/points", "aside/points/result.h5",
    }  # fmt: skip


def test_without_locks_only_files_older_than_a_day_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic_files, "_lock", lambda _: (_ for _ in ()).throw(OSError(errno.ENOLCK, "no locks")))
    for name, age in ((".a-0123456789ab.part", 0.0), (".b-0123456789ab.part", 2.0 * atomic_files.ABANDONED_AGE_S)):
        (tmp_path / name).write_text("")
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    assert [path.name for path in remove_abandoned(tmp_path)] == [".b-0123456789ab.part"]
    write_atomically(tmp_path / "a", "text")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".a-0123456789ab.part", "a"]


def test_a_failed_output_leaves_no_folder(tmp_path):
    with suppress(ZeroDivisionError), file_lock(tmp_path / "a" / "b" / "results"):
        assert (tmp_path / "a" / "b").is_dir()
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


# Signals and kills, sampled; benchmarks/faults.py has the statistics.


@pytest.mark.skipif(sys.platform == "win32", reason="signals of another process")
@pytest.mark.parametrize(("number", "after_s"), [(signal.SIGINT, 0.02), (signal.SIGTERM, 0.3), (signal.SIGINT, 1.0)])
def test_a_signal_during_the_start_ends_the_process_in_one_line(number, after_s, tmp_path):
    """Whether modules are being imported or not."""
    end = faults.signalled(["simulate", str(tmp_path / "out"), "--preset", "demo"], number, after_s)
    assert end.status == 128 + number
    assert len(end.told) == 1
    assert end.told[0].startswith("shakercal: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of another process")
def test_whoever_is_killed_when_the_next_run_gives_the_same_results(tmp_path):
    rng = random.Random(5)
    campaign = faults.make_campaign(tmp_path)
    for workers in (1, 2):
        found = faults.kills(campaign, tmp_path, 1, rng, workers)
        assert found.good == found.tried == 1, found


@pytest.mark.slow
def test_inputs_that_change_during_a_run_are_noticed(tmp_path):
    found = faults.changes(faults.make_campaign(tmp_path), tmp_path, 2, random.Random(7))
    assert found.good == found.tried == 2, found


# What is printed.


@pytest.mark.parametrize(
    ("encoding", "text", "printed"),
    [
        ("cp1252", "(\N{MINUS SIGN}2.0 ± 0.1) µm², √Hz → Ω", "(-2.0 ± 0.1) µm², sqrtHz -> Ohm"),
        ("ascii", "(\N{MINUS SIGN}2.0 ± 0.1) µm², ω = 3°, café, 漢", "(-2.0 +- 0.1) um^2, omega = 3 deg, cafe, ?"),
        ("utf-8", "a\udce9b − ±", "a?b − ±"),
    ],
)
def test_signs_that_an_encoding_lacks_are_spelled(encoding, text, printed):
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding, newline="\n")
    terminal: Any = Terminal(stream)
    print(text, file=terminal)
    terminal.flush()
    assert raw.getvalue() == f"{printed}\n".encode(encoding)


def test_no_name_controls_the_terminal(make_campaign, evaluated, capsys):
    assert printable("a\x1b]0;title\x07b\r\x9bc\u202ed\te\n") == "a\\x1b]0;title\\x07b\\r\\x9bc\\u202ed\te\n"
    folder = make_campaign()
    named = folder.with_name("\x1b[31mFz")
    folder.rename(named)
    assert main(["run", str(named.parent)]) == EXIT_DONE
    assert main(["run", str(named.parent), "-v"]) == EXIT_DONE  # tells whose results are there
    output = capsys.readouterr()
    assert "\x1b" not in output.out + output.err
    assert "\\x1b[31mFz" in output.err
    assert evaluated


PLAN = ["plan", "--frequencies", "80", "--max-rate", "50", "--exposure", "40e-6", "--frames", "48"]


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_a_table_survives_every_encoding(encoding):
    command = [sys.executable, "-m", "fusion.cli", *PLAN]
    run = subprocess.run(command, env={**environment(), "PYTHONIOENCODING": encoding}, capture_output=True, check=False)
    assert (run.returncode, run.stderr) == (EXIT_DONE, b"")
    assert "Hz" in run.stdout.decode(encoding)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
def test_an_output_that_nobody_reads_or_that_is_full_is_no_traceback():
    command = [sys.executable, "-m", "fusion.cli", *PLAN]
    reading, writing = os.pipe()
    os.close(reading)
    run = subprocess.run(command, env=environment(), stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert (run.returncode, run.stderr) == (EXIT_CLOSED, b"")
    closed = subprocess.run(
        ["sh", "-c", '"$@" >&-', "sh", *command], env=environment(), capture_output=True, check=False
    )
    assert (closed.returncode, closed.stderr) == (EXIT_DONE, b"")
    if Path("/dev/full").exists():
        with Path("/dev/full").open("wb") as full:
            run = subprocess.run(command, env=environment(), stdout=full, stderr=subprocess.PIPE, check=False)
        assert run.returncode == EXIT_FAILED
        assert re.fullmatch(rb"shakercal: [^\n]*No space left on device[^\n]*\n", run.stderr)


def test_no_name_is_a_formula_in_a_spreadsheet_and_every_name_is_read_back(tmp_path):
    names = ["=1+1", "+z", "-Fz", "@x", "'=1", "''-a", "'quoted'", "plain", "-1.5e-3", "\tx", "a=b", ""]
    rows = [{"name": name, "number": -1.5} for name in names]
    columns = [TableColumn("name", lambda row: row["name"]), TableColumn("n", lambda row: row["number"])]
    text = csv_text(columns, rows)
    cells = list(csv.reader(io.StringIO(text)))[1:]
    assert all(cell[:1] not in "=+@\t" or not cell for cell, _ in cells)
    assert [cell for cell, _ in cells if cell.startswith("-")] == ["-1.5e-3"]
    assert all(number == "-1.5" for _, number in cells)
    (tmp_path / "a.csv").write_bytes(text.encode())
    assert [row["name"] for row in read_rows(tmp_path / "a.csv")] == names
