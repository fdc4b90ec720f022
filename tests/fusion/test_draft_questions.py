"""Questions of `shakercal init`: typed on a terminal or answered by a file, and counted."""

from __future__ import annotations

import os
import pty
import re
import shutil
import subprocess
import sys
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support import refusals, write_daq

from fusion.cli import main
from fusion.planning.check import check
from fusion.planning.draft.init import run_init
from fusion.planning.draft.questions import parse_answer, questions_of
from fusion.planning.planning_notices import UNUSED_ANSWER
from fusion.recording.load import load_manifest

TRUTH: dict[str, str] = {
    # what the laboratory knows, as it is typed
    "direction": "0 0 1",
    "sensor.channels": '["Fz"]',
    "sensor.unit": "V",
    "sensor.sense": "on_load",
    "sensor.internal_mass": "0.12",
    "load.mass": "2.4 ± 0.1 % (k = 2)",
    "load.mass_uncertainty": "0.001",
    "load.centre_of_mass": "0 0 0.03",
    "load.inertia": "2e-3 2e-3 1e-3",
    "rotation": "1 0 0; 0 -1 0; 0 0 -1",
    "translation": "0 0 0,4",
    "calibration": "pair.json",
    "exposure": "pulse",
    "first_edge": "0",
    "scale_uncertainty": "1e-3",
    "scale": "0.1 ± 0.0001",
    "point": "0.01 0 0.05",
    "ai0.quantity": "velocity",
    "ai1.quantity": "output",
    "channel": "Fz",
}


@pytest.fixture
def refused(capsys):
    return refusals(capsys)


def one_laser_and_one_pair(folder: Path, demo: Path, units: bool) -> Path:
    """A recorder's file with or without units, and a pair of cameras called by their makers' numbers."""
    place = folder / "run 12"
    time_s = np.arange(20_000) / 10e3
    sine = np.sin(2 * np.pi * 50.0 * time_s)
    trigger = 5.0 * ((time_s - 0.0123) % (1 / 13.7) < 2e-3)
    noise = np.random.default_rng(1).normal(size=(2, len(time_s))) * 1e-3
    for side, serial in (("left", 22790), ("right", 31417)):
        shutil.copytree(demo / "Fz-0080" / f"top-{side}", place / f"{serial}")
    shutil.copy(demo / "calibration" / "top.json", place / "pair.json")
    names = ("laser", "Fz", "trigger") if units else ("ai0", "ai1", "ai2")
    write_daq(place / "a.h5", 10e3, dict(zip(names, (sine + noise[0], sine + noise[1], trigger), strict=True)))
    with h5py.File(place / "a.h5", "a") as file:
        for name, unit in zip(names, ("m/s", "mV/V", "V"), strict=True):
            if units:
                file[name].attrs["unit"] = unit
    return place


def typed(question: str) -> str:
    """What the laboratory types in reply to a question."""
    key = re.findall(r"^\d+ left\. (.*?): ", question, re.MULTILINE)[-1]
    fitting = [end for end in TRUTH if key == end or key.endswith("." + end)]
    return TRUTH[max(fitting, key=len)]


@pytest.mark.parametrize(("units", "most"), [(True, 15), (False, 25)])
def test_few_values_are_typed_for_one_laser_and_one_pair(tmp_path, demo_recording, units, most):
    """One round: what is typed makes a recording that `check` accepts."""
    place = one_laser_and_one_pair(tmp_path, demo_recording, units)
    asked: list[str] = []

    def reply(question: str) -> str:
        asked.append(question)
        return typed(question)

    drafted = run_init(place, reply=reply)
    assert len(asked) <= most
    assert drafted.unfilled == 0
    assert check(load_manifest(place)).problems == ()
    manifest = load_manifest(place)
    if units:
        assert manifest.rig.load is not None
        assert manifest.rig.load.mass_uncertainty == pytest.approx(2.4e-3 / 2)


def test_the_most_important_question_comes_first_and_an_end_of_input_leaves_the_rest(tmp_path, demo_recording):
    place = one_laser_and_one_pair(tmp_path, demo_recording, True)
    asked: list[str] = []

    def reply(question: str) -> str:
        asked.append(question)
        if len(asked) == 3:
            raise EOFError
        return "" if len(asked) == 1 else typed(question)

    drafted = run_init(place, reply=reply)
    assert "recorder file with 3 channels" in asked[0]
    keys = [question.name for question in questions_of(drafted.files)]
    assert keys[-1].endswith("uncertainty")
    assert not any(name.endswith("uncertainty") for name in keys[: len(keys) // 2])


def test_equal_questions_of_a_campaign_are_asked_once(tmp_path, demo_recording):
    first = one_laser_and_one_pair(tmp_path, demo_recording, True)
    second = tmp_path / "run 13"
    shutil.copytree(first, second)
    (second / "a.h5").rename(second / "b.h5")
    asked: list[str] = []

    def reply(question: str) -> str:
        asked.append(question)
        return typed(question)

    drafted = run_init(tmp_path, reply=reply)
    assert len(asked) <= 15
    assert drafted.unfilled == 0
    assert len(drafted.files) == 3


def test_a_file_answers_replaces_guesses_and_uncomments_keys(tmp_path, demo_recording, refused):
    place = one_laser_and_one_pair(tmp_path, demo_recording, True)
    (tmp_path / "answers.toml").write_text(
        'gravity = [0.0, 0.0, -9.81]\n[load]\nmass = { value = 2.4, U = 0.001, k = 2 }\n[laser]\nbody = "base"\n'
        '["run 12"]\nexposure = 2e-4\n'
    )
    assert main(["init", str(place), "--answers", str(tmp_path / "answers.toml")]) == 0
    recording = tomllib.loads((place / "recording.toml").read_text())
    rig = tomllib.loads((place / "rig.toml").read_text())
    assert rig["load"]["mass"] == {"value": 2.4, "U": 0.001, "k": 2}
    assert "mass_uncertainty" not in rig["load"]
    assert rig["environment"] == {"gravity": [0.0, 0.0, -9.81]}
    assert rig["stereo"]["pair"]["exposure"] == 2e-4
    assert recording["daq"][0]["channel"][0]["body"] == "base"
    for path in (place / "rig.toml", place / "recording.toml"):
        path.unlink()
    (tmp_path / "answers.toml").write_text("[load]\nmas = 2.4\n")
    told = refused("init", place, "--answers", tmp_path / "answers.toml")
    assert UNUSED_ANSWER.code in told
    assert "load.mas: " in told
    assert not (place / "rig.toml").exists()


def test_outputs_without_names_have_the_stated_ones_in_their_order(tmp_path, demo_recording):
    place = one_laser_and_one_pair(tmp_path, demo_recording, False)
    (tmp_path / "answers.toml").write_text(
        'channels = ["Fz", "Mz"]\nai0.quantity = "output"\nai1.quantity = "output"\n'
    )
    files = run_init(place, answers=tmp_path / "answers.toml").files
    (block,) = tomllib.loads(files[place / "recording.toml"])["daq"]
    assert [(entry["name"], entry.get("channel")) for entry in block["channel"][:2]] == [("ai0", "Fz"), ("ai1", "Mz")]


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("2.4", "mass", 2.4),
        ("2,4", "mass", 2.4),
        ("on_load", "sense", "on_load"),
        ("Fx, Fy Fz", "channels", ["Fx", "Fy", "Fz"]),
        ('"pulse"', "exposure", "pulse"),
        ("0 0 1", "direction", [0.0, 0.0, 1.0]),
        ("(0,5; 0; 1)", "direction", [0.5, 0.0, 1.0]),
        ("[0, 0, 1]", "direction", [0, 0, 1]),
        ("1 0 0 0 1 0 0 0 1", "rotation", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        ("1e-3 2e-3 3e-3", "inertia", [[1e-3, 0.0, 0.0], [0.0, 2e-3, 0.0], [0.0, 0.0, 3e-3]]),
        ("2.4 ± 0.001", "mass", {"value": 2.4, "U": 0.001, "k": 1.0}),
        ("2.4 +- 0.1 % (k=2)", "mass", {"value": 2.4, "U_relative": 0.001, "k": 2.0}),
    ],
)
def test_typed_values(text: str, key: str, value: Any):
    assert parse_answer(text, key) == value


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_init_asks_on_a_terminal_only(tmp_path, demo_recording):
    place = one_laser_and_one_pair(tmp_path, demo_recording, True)
    ours, theirs = pty.openpty()
    os.write(ours, b"\x04" * 4)
    command = [sys.executable, "-m", "shakercal", "init", str(place)]
    asked = subprocess.run(command, stdin=theirs, stdout=theirs, stderr=subprocess.PIPE, timeout=120, check=False)
    os.set_blocking(ours, False)
    shown = ""
    with suppress(BlockingIOError):
        while True:
            shown += os.read(ours, 1 << 16).decode()
    os.close(theirs)
    os.close(ours)
    assert asked.returncode == 0
    assert re.search(r"\d+ left\. ", shown)
    assert (place / "recording.toml").exists()
