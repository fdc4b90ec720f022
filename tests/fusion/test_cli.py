"""The command line: output, exit status, and no partial files after a failure."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from support import RefusedCommand, folder_contents

from fusion import simulate as simulation
from fusion.cli import _parser, commands, main
from fusion.commands.options import EXIT_DONE, EXIT_FAILED, EXIT_INPUT, EXIT_INTERRUPTED
from fusion.errors import INTERNAL_ERROR, OUTPUT_EXISTS, SYSTEM_REFUSED, ComputeError
from fusion.recording.recording_notices import INVALID_VALUE
from fusion.report import terminal
from fusion.report.terminal import MOST_NOTES, log_notices, print_table, progress_bar, wrapped
from fusion.simulate.simulation_notices import SIMULATION_FOLDER_IN_USE
from shakercal._common.notices import DeclaredNotice, Notice

NO_FIT = DeclaredNotice("SC-997", "error", "{reason}")
LIGHT = DeclaredNotice("SC-995", "note", "load: {number}")
WARNING = DeclaredNotice("SC-994", "warning", "{text}")
HEAVY = ("torch", "kornia", "cv2", "numba", "matplotlib", "scipy", "skimage", "h5py", "rich", "pydantic", "numpy")


@pytest.mark.parametrize("arguments", ["run --help", "--version", "run"])
def test_help_and_version_import_no_heavy_module(arguments):
    """Their time is that of the interpreter, which is what keeps them far below a second."""
    program = (
        "import sys\n"
        "from fusion.cli import main\n"
        "try:\n    main(sys.argv[1:])\n"
        "except SystemExit:\n    pass\n"
        f"print('heavy:', [name for name in {HEAVY} if name in sys.modules])"
    )
    command = [sys.executable, "-c", program, *arguments.split()]
    output = subprocess.run(command, capture_output=True, text=True, check=True)
    assert output.stdout.endswith("heavy: []\n")
    if arguments == "--version":
        assert (output.stdout.splitlines()[0], output.stderr) == (f"shakercal {version('shakercal')}", "")


@pytest.mark.parametrize(
    "line",
    ["evaluate", "run", "run a b", "run a -q -v", "run a --subset-radius 3", "run a --subset-radius ten",
     "run a --device gpu", "simulate a --seed -1", "simulate a --preset nitsche"],
)  # fmt: skip
def test_wrong_usage_is_status_2(line, capsys):
    with pytest.raises(SystemExit) as left:
        main(line.split())
    output = capsys.readouterr()
    assert (left.value.code, output.out) == (EXIT_INPUT, "")
    assert output.err.startswith("usage: shakercal")


def test_no_command_lists_them_and_a_mistyped_one_is_recognised(capsys):
    assert main([]) == EXIT_INPUT
    listed = capsys.readouterr().err
    assert all(f"    {made.name}" in listed for made in commands())
    for typed, near in (("runn", "; did you mean run?"), ("simulat", "; did you mean simulate?"), ("zzz", "")):
        with pytest.raises(SystemExit):
            main([typed])
        assert capsys.readouterr().err.splitlines()[-1].endswith(f"expected a command, found {typed}{near}")


@pytest.mark.parametrize("made", commands(), ids=lambda made: made.name)
def test_the_example_of_every_command_is_one(made, capsys):
    program, *words = made.example.split()
    assert program == "shakercal"
    assert _parser().parse_args(words).act is made.act
    with pytest.raises(SystemExit):
        main([made.name, "--help"])
    assert f"example: {made.example}" in " ".join(capsys.readouterr().out.split())


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_commands_and_options(tmp_path):
    program = tmp_path / "shakercal"
    program.write_text(f"#!{sys.executable}\nfrom fusion.cli import main\n\nraise SystemExit(main())\n")
    program.chmod(0o755)
    for words, expected in (("shakercal ru", "run"), ("shakercal run --jso", "--json")):
        typed = words.split()
        script = (
            'eval "$(shakercal --completion bash)"; '
            f"COMP_WORDS=({words}); COMP_CWORD={len(typed) - 1}; COMP_LINE='{words}'; COMP_POINT={len(words)}; "
            "COMP_TYPE=9; _python_argcomplete shakercal; echo ${COMPREPLY[@]}"
        )
        path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
        place = {**os.environ, "PATH": path, "PYTHONPATH": str(Path(__file__).parents[2])}
        shell = subprocess.run(["bash", "-c", script], env=place, capture_output=True, text=True, check=True)
        assert shell.stdout.split() == [expected]


def test_run_prints_the_sensitivity_and_where_the_report_lies(make_campaign, evaluated, capsys):
    folder = make_campaign()
    assert main(["run", str(folder)]) == EXIT_DONE
    output = capsys.readouterr()
    assert re.search(r"106\.2503.*ratio Fz output / Fz load.*±.*V/V", output.out)
    assert output.out.endswith(f"report (written): {folder / 'results' / 'report.html'}\n")
    assert evaluated == [folder.name]


@pytest.mark.usefixtures("evaluated")
@pytest.mark.parametrize(
    ("flags", "warned", "informed"), [(["-q"], True, False), ([], True, True), (["-v"], True, True)]
)
def test_quiet_and_verbose(flags, warned, informed, make_campaign, capsys):
    folder = make_campaign()
    assert main(["run", str(folder), *flags]) == EXIT_DONE
    output = capsys.readouterr().err
    assert ("shakercal: SC-999 top: " in output) is warned
    assert ("shakercal: SC-998 camera_trigger: " in output) is informed
    assert main(["run", str(folder), *flags]) == EXIT_DONE
    again = capsys.readouterr()
    assert ("shakercal: SC-999 top: " in again.err) is warned  # what is to be known of results stays so
    assert "report (unchanged since the last run)" in again.out


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ("plan --frequencies 80 --max-rate 50 --frames 48 --json", "rows"),
        ("lines sample_images/demo/Fz-0080/bridge.h5 --channel Fz --json", "rows"),
        ("check sample_images/demo --json", "recordings"),
    ],
)
def test_answers_for_programs_are_one_document(words, key, capsys, monkeypatch):
    monkeypatch.chdir(Path(__file__).resolve().parents[2])
    assert main(words.split()) == EXIT_DONE
    output = json.loads(capsys.readouterr().out)
    assert output["command"] == words.split()[0]
    first = output[key][0]
    if key == "rows":
        assert any(isinstance(value, float) for value in first.values())
    else:
        assert {"body": "load", "instrument": "stereo top", "components": ["x", "y", "z", "rx", "ry", "rz"]} in first[
            "observed"
        ]


@pytest.mark.parametrize("level", [logging.INFO, logging.DEBUG])
@pytest.mark.parametrize("notes", [1, MOST_NOTES + 1])
def test_a_warning_is_whole_and_many_notes_are_counted_without_v(level, notes, caplog):
    long = "word " * 200
    many = [(Notice(LIGHT, "load", number=n), "") for n in range(notes)]
    with caplog.at_level(level, "shakercal"):
        log_notices([(Notice(WARNING, "laser", text=long), " (2 recordings)"), *many])
    warning, *rest = caplog.messages
    assert warning == f"{WARNING.code} laser: {long.strip()} (2 recordings)"
    shown = [message for message in rest if " load: " in message]
    counted = level == logging.INFO and notes > MOST_NOTES
    assert [message.strip() for message in shown] == (
        [] if counted else [f"{LIGHT.code} load: 0", *(f"load: {number}" for number in range(1, notes))]
    )
    assert any(message.startswith(f"{notes} ") for message in rest) is counted


def test_one_sentence_of_several_places_is_printed_once(caplog):
    with caplog.at_level(logging.INFO, "shakercal"):
        log_notices([(Notice(WARNING, place, text="too late"), "") for place in ("top", "base", "top")])
    assert caplog.messages[0] == f"{WARNING.code} top, base: too late"
    assert len(caplog.messages) == 2


@pytest.mark.parametrize("width", [200, 80, 60, 40])
def test_a_table_breaks_and_shortens_no_number(width, capsys, monkeypatch):
    monkeypatch.setattr(terminal, "PIPE_WIDTH", width)
    head = ["line / Hz", *(f"u of channel {n} / nm" for n in range(6)), "what and why"]
    rows = [[f"{n}.123456", *(f"{n}.{k}87654321" for k in range(6)), "a harmonic of the excitation"] for n in range(4)]
    print_table("Lines", head, "r" * 7 + "l", [rows[:1], rows[1:]])
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= width or "│" not in shown, "rows are sentences, which a terminal wraps"
    words = re.split(r"[\s│;]+", shown)
    assert all(cell in words for row in rows for cell in row[:-1])
    assert "Lines" in shown


class Screen(io.StringIO):
    """A terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("screen", [False, True])
def test_a_terminal_wraps_between_words_and_a_pipe_has_one_line_for_each_notice(screen, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = f"  laser: {'word ' * 100}/a/path/that/is/longer/than/the/{'terminal/' * 10} end"
    shown = wrapped(text, Screen() if screen else io.StringIO())
    lines = shown.split("\n")
    assert len(lines) == 1 or screen
    assert shown.split() == text.split(), "no word is cut or left out"
    assert all(len(line) <= 80 or line.strip().startswith("/a/path") for line in lines) or not screen
    assert all(line.startswith("    ") for line in lines[1:])


def test_the_log_has_how_long_a_stage_took(caplog):
    with caplog.at_level(logging.DEBUG, "shakercal"), progress_bar(enabled=False) as progress:
        for done in range(4):
            progress("follow", done, 3)
    assert re.fullmatch(r"follow: \d+\.\d s", caplog.messages[-1])


def test_libraries_are_heard_with_v_only(make_campaign, evaluated, monkeypatch, capsys):
    monkeypatch.setattr(logging, "_warnings_showwarning", None)  # else an earlier test's capture counts as this one

    def warn(*_: Any) -> None:
        logging.getLogger("nptdms.reader").warning("a remark of a library")
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn("a warning of a library", stacklevel=2)
        raise ComputeError(NO_FIT, reason="no line")

    monkeypatch.setattr("fusion.campaign.run.evaluate_recording", warn)
    folder = make_campaign()
    assert main(["run", str(folder)]) == EXIT_FAILED
    assert capsys.readouterr().err.startswith(f"shakercal: {NO_FIT.code} no line ")
    assert main(["run", str(folder), "-v"]) == EXIT_FAILED
    output = capsys.readouterr().err
    assert "a remark of a library" in output
    assert "a warning of a library" in output
    assert not evaluated


def _raise(error: BaseException, cause: BaseException | None = None) -> Callable[..., None]:
    def fail(*_: object, **__: object) -> None:
        raise error from cause

    return fail


@pytest.mark.usefixtures("evaluated")
@pytest.mark.parametrize("place", ["fusion.campaign.run.evaluate_recording", "fusion.report.recording_report.write_h5"])
@pytest.mark.parametrize(
    ("error", "status", "begin"),
    [
        (KeyboardInterrupt(), EXIT_INTERRUPTED, "interrupted"),
        (ComputeError(NO_FIT, reason="a\n b"), EXIT_FAILED, f"{NO_FIT.code} a b"),
        (OSError(28, "disk full"), EXIT_FAILED, f"{SYSTEM_REFUSED.code} "),
        (RuntimeError("a\n b"), EXIT_FAILED, f"{INTERNAL_ERROR.code} "),
    ],
)
def test_failures_are_one_sentence_and_leave_no_files(place, error, status, begin, make_campaign, monkeypatch, capsys):
    folder = make_campaign()
    before = sorted(folder.parent.rglob("*"))
    monkeypatch.setattr(place, _raise(error))
    assert main(["run", str(folder), "-q"]) == status
    output = capsys.readouterr()
    lines = output.err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("shakercal: ")
    if isinstance(error, OSError) and place.endswith("write_h5"):
        assert str(folder / "results") in lines[0]
        assert "disk full" in lines[0]
    else:
        assert lines[0].startswith(f"shakercal: {begin}")
        assert not isinstance(error, RuntimeError) or "RuntimeError: a b" in lines[0]
    assert output.out == ""
    assert sorted(folder.parent.rglob("*")) == before


@pytest.mark.usefixtures("evaluated")
def test_failures_of_compiled_code_and_internal_errors(make_campaign, monkeypatch, refused, capsys):
    folder, place = make_campaign(), "fusion.campaign.run.evaluate_recording"
    monkeypatch.setattr(place, _raise(SystemError("returned a result with an exception set"), KeyboardInterrupt()))
    assert refused("run", folder, status=EXIT_INTERRUPTED).startswith("shakercal: interrupted")
    monkeypatch.setattr(place, _raise(RuntimeError("a")))
    assert main(["run", str(folder), "-v"]) == EXIT_FAILED
    assert "Traceback" in capsys.readouterr().err


def test_check_reports_errors_and_goes_on_after_a_recording_that_cannot_be_read(make_campaign, capsys):
    folder = make_campaign()
    before = sorted(folder.parent.rglob("*"))
    assert main(["check", str(folder)]) == EXIT_INPUT
    output = capsys.readouterr().out
    assert "wrong" in output
    assert "vibrometer.h5" in output
    assert sorted(folder.parent.rglob("*")) == before
    (folder.parent / "Aa").mkdir()
    (folder.parent / "Aa" / "recording.toml").write_text("format = 3\n")
    assert main(["check", str(folder.parent)]) == EXIT_INPUT
    both = capsys.readouterr()
    unread = folder.parent / "Aa" / "recording.toml"
    assert both.err.startswith(f"shakercal: {INVALID_VALUE.code} {unread}: rig: ")
    assert both.out == output


@pytest.mark.parametrize(
    ("stream", "enabled", "drawn"), [(Screen, True, True), (Screen, False, False), (io.StringIO, True, False)]
)
def test_progress_on_a_terminal_only(stream, enabled, drawn, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    screen = stream()
    monkeypatch.setattr(sys, "stderr", screen)
    with progress_bar(enabled=enabled) as progress:
        for done in range(3):
            progress("track top", done + 1, 3)
    assert ("track top" in screen.getvalue()) is drawn
    assert ("3/3" in screen.getvalue()) is drawn
    if not drawn:
        assert screen.getvalue() == ""


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make simulations of three frames of a few pixels."""
    full = simulation.simulate
    monkeypatch.setattr(simulation, "simulate", lambda *arguments: full(*arguments, frames=3, image_scale=0.3))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny simulation, made once."""
    out = tmp_path_factory.mktemp("made") / "sim"
    simulation.simulate(out, "demo", 1, frames=3, image_scale=0.3)
    return out


@pytest.fixture
def simulated(made: Path, tmp_path: Path) -> Path:
    """A copy of the tiny simulation for one test."""
    return Path(shutil.copytree(made, tmp_path / "sim", copy_function=os.link))


def _refused(arguments: list[object], folder: Path, refused: RefusedCommand) -> str:
    before = folder_contents(folder)
    output = refused("simulate", *arguments)
    assert folder_contents(folder) == before
    return output


def _recording_of_his_own(folder: Path) -> None:
    shutil.copytree(folder / "Fz-0080", folder / "Fz-0100", ignore=shutil.ignore_patterns("truth.json"))


@pytest.mark.parametrize("own", [
    "Fz-0080/results/result.h5", "results/sensitivity.csv", "Fz-0080/notes.txt", "rig.toml", _recording_of_his_own,
    lambda folder: (folder / "Fz-0080" / "empty").mkdir(), lambda folder: (folder / "Fz-0080" / "truth.json").unlink(),
])  # fmt: skip
def test_force_never_deletes_files_of_the_user(own, simulated, refused):
    if isinstance(own, str):
        (simulated / own).parent.mkdir(exist_ok=True)
        (simulated / own).unlink(missing_ok=True)
        (simulated / own).write_text("work of a day")
    else:
        own(simulated)
    output = _refused([simulated, "--force"], simulated.parent, refused)
    assert output.startswith(f"shakercal: {SIMULATION_FOLDER_IN_USE.code} {simulated}: ")


def test_simulate_refuses_existing_files(simulated, tmp_path, refused):
    error = _refused([simulated], simulated.parent, refused)
    assert error.startswith(f"shakercal: {OUTPUT_EXISTS.code} {simulated}: ")
    (tmp_path / "file").write_text("mine")
    error = _refused([tmp_path / "file", "--force"], tmp_path, refused)
    assert error.startswith(f"shakercal: {SIMULATION_FOLDER_IN_USE.code} {tmp_path / 'file'}: ")
    assert "file/below" in _refused([tmp_path / "file" / "below"], tmp_path, refused)


@pytest.mark.usefixtures("tiny")
def test_force_replaces_an_earlier_simulation(simulated, capsys):
    before = folder_contents(simulated)
    assert main(["simulate", str(simulated), "--force", "--seed", "2"]) == EXIT_DONE
    output = capsys.readouterr()
    assert output.out == f"simulated recording: {simulated / 'Fz-0080'}\n"
    assert output.err == ""
    after = folder_contents(simulated)
    assert list(after) == list(before)
    assert json.loads(after["Fz-0080/truth.json"]) != json.loads(before["Fz-0080/truth.json"])
    assert [path.name for path in simulated.parent.iterdir()] == ["sim"]


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), EXIT_INTERRUPTED), (OSError(28, "full"), 1)])
def test_a_stopped_simulation_leaves_no_files(error, status, simulated, monkeypatch, capsys):
    def write(out: Path, *_: object) -> None:
        (out / "rig.toml").write_text("half")
        raise error

    monkeypatch.setattr("fusion.simulate.sines.write_runs", write)
    before = folder_contents(simulated.parent)
    for arguments in ([str(simulated.parent / "new")], [str(simulated), "--force"]):
        assert main(["simulate", *arguments]) == status
        assert capsys.readouterr().err.count("\n") == 1
    assert folder_contents(simulated.parent) == before
    assert [path.name for path in simulated.parent.iterdir()] == ["sim"]
