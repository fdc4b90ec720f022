"""`shakercal look --live`: folders that fill while they are evaluated, with half-written, lost and late files."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import make_once
from support import complex_of, edit, truth_of

from fusion.cli import main
from fusion.errors import InputError
from fusion.planning.look import live_folder
from fusion.planning.look.live import LiveEvaluation, LiveFrame, LiveState, LiveValue, live
from fusion.planning.look.live_command import describe_state
from fusion.planning.look.live_folder import FolderFrames, FrameCounts
from fusion.planning.look.look_notices import LIVE_NOT_POSSIBLE
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import rendered_run, write_run
from fusion.simulate.world import Draws, make_world
from photogram.images.image_files import read_image

RATE_HZ, FRAMES, LOST = 38.345, 64, 40


@pytest.fixture(scope="session")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pair on the demo's load through six beats, with its channels."""

    def write(folder: Path) -> Path:
        preset = read_preset(Preset, "demo")
        daqs = tuple(replace(daq, duration_s=daq.duration_s + 1.5) for daq in preset.daqs)
        preset = replace(preset, stereo=preset.stereo[:1], daqs=daqs, frames=FRAMES)
        draws = Draws(1, True)
        return write_run(folder, rendered_run(preset), make_world(preset, draws, 0.0), draws)

    return make_once(tmp_path_factory, "live", write)


@pytest.fixture
def arriving(long_recording: Path, tmp_path: Path) -> Path:
    """A recording with its manifests only."""
    for item in long_recording.parent.iterdir():
        if item != long_recording:
            (shutil.copytree if item.is_dir() else shutil.copy)(item, tmp_path / item.name)
    (tmp_path / "live").mkdir()
    shutil.copy(long_recording / "recording.toml", tmp_path / "live")
    return tmp_path / "live"


def fill(source: Path, target: Path, interval_s: float) -> None:
    """Write frames as cameras would, right ahead of left, some in two parts, one lost; then the recorders' files."""
    for side in ("left", "right"):
        (target / f"top-{side}").mkdir(exist_ok=True)
    for number in range(FRAMES + 2):
        for side, frame in (("right", number), ("left", number - 2)):
            if not 0 <= frame < FRAMES or frame == LOST:
                continue
            content = (source / f"top-{side}" / f"{frame:04d}.tif").read_bytes()
            with (target / f"top-{side}" / f"{frame:04d}.tif").open("wb") as file:
                file.write(content[: len(content) // 2])
                if frame % 7 == 3:
                    file.flush()
                    time.sleep(4 * interval_s)
                file.write(content[len(content) // 2 :])
        time.sleep(interval_s)
    for file in source.iterdir():
        if file.suffix in (".h5", ".csv"):
            shutil.copy(file, target)


def frames_of(recording: Path, count: int) -> Iterator[LiveFrame]:
    for number in range(count):
        images = [read_image(recording / f"top-{side}" / f"{number:04d}.tif")[0] for side in ("left", "right")]
        yield LiveFrame("top", number, tuple(images))


def test_a_filling_folder_converges_to_the_truth_and_is_evaluated_at_the_end(long_recording, arriving, capsys):
    writer = threading.Thread(target=fill, args=(long_recording, arriving, 0.05))
    writer.start()
    page = arriving.parent / "light.html"
    assert main(["look", "--live", str(arriving), "--rate", str(RATE_HZ), "--json", "--page", str(page)]) == 0
    writer.join()
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    states = [event for event in events if event["event"] == "live"]
    driven = [value for state in states for value in state["values"] if value["driven"]]
    true = abs(complex_of(truth_of(long_recording)["acceleration"]["load"])[0, 2])
    assert len(driven) >= 2
    assert all(state["values"] or state["reason"] for state in states)
    assert all(abs(value["amplitude"] - true) < value["U"] for value in driven), driven
    assert driven[-1]["U"] < driven[0]["U"]
    assert states[-1]["frames"] == {"top": FRAMES - 1}
    assert (states[-1]["missing"], states[-1]["damaged"], states[-1]["skipped"]) == (1, 0, 0)
    final, sensitivity = (event for event in events if event["event"] == "result")
    assert final["name"].startswith("load z at 80.000")
    assert abs(final["value"] - true) < final["U"] < driven[-1]["U"]
    assert abs(final["value"] - driven[-1]["amplitude"]) < driven[-1]["U"]
    assert sensitivity["name"].startswith("sensitivity Fz per Fz")
    assert "U 0.0" in page.read_text(encoding="utf-8")


def test_the_number_of_frames_to_an_aim_is_predicted(long_recording):
    """Too high after few frames, whose noise is not yet known well."""
    with LiveEvaluation(long_recording, RATE_HZ) as evaluation:
        states = []
        for count, frame in enumerate(frames_of(long_recording, FRAMES), 1):
            evaluation.add(frame)
            if count in (20, FRAMES):
                states.append(evaluation.state())
    middle, last = states
    assert last.frames == {"top": FRAMES}
    assert last.driven.U_percent < 0.1 < middle.driven.U_percent
    assert 20 < middle.frames_to(0.1) < 300
    assert last.frames_to(0.1) < FRAMES


def test_the_command_stops_when_the_aim_is_reached(long_recording, arriving, capsys):
    for side in ("left", "right"):
        shutil.copytree(long_recording / f"top-{side}", arriving / f"top-{side}")
    assert main(["look", "--live", str(arriving), "--rate", str(RATE_HZ), "--until", "0.5"]) == 0
    assert capsys.readouterr().out.rstrip().endswith("reached: stop recording.")


def test_a_signal_ends_it_without_a_trace(long_recording, arriving):
    shutil.copytree(long_recording / "top-left", arriving / "top-left")
    command = [sys.executable, "-m", "shakercal", "look", "--live", str(arriving), "--rate", str(RATE_HZ)]
    before = sorted(arriving.rglob("*"))
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        first = process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=30)
    assert first == "top 0 frames · no frames yet\n"
    assert process.returncode == 128 + signal.SIGTERM
    assert "Traceback" not in errors
    assert sorted(arriving.rglob("*")) == before


# A rate that does not resolve the line, and what cannot be evaluated live.


def test_a_rate_without_a_beat_is_named_with_a_better_one(long_recording):
    *_, last = live(long_recording, frames_of(long_recording, 24), 40.0)
    assert last.driven is None
    assert re.search(r"\d+\.\d+ frames/s would$", last.reason)


def test_what_noise_does_not_limit_is_not_predicted():
    value = LiveValue("load", "z", "m/s^2", 80.0, 80.0, 0.16, 2.0, u_noise=8e-4, u_rest=6e-4, driven=True)
    state = LiveState({"top": 100}, 5.0, (value,))
    assert state.frames_to(0.2) == 100
    assert state.frames_to(0.144) == pytest.approx(100 * 64 / (72**2 / 100 - 36), abs=1)
    assert state.frames_to(0.1) == np.inf
    text = describe_state(state, 0.001, FrameCounts(skipped=3), 2.0)
    assert text.endswith("0.1 % not within reach: 0.12 % remain without noise · 3 skipped, 2.0 s behind")


@pytest.mark.parametrize(
    ("file", "old", "new", "key"),
    [
        ("live/recording.toml", 'left = "top-left/*.tif"', 'left = "top.cine"', "images.left"),
        ("rig.toml", "delay = 0.0\n", "delay = 0.0\nrow_time = 1e-6\n", "stereo.top.row_time"),
        ("live/recording.toml", "[[images]]", "[[points]]", "images"),
    ],
)
def test_recordings_that_need_a_complete_file_are_refused(arriving, file, old, new, key):
    edit(arriving.parent / file, old, new)
    with pytest.raises(InputError) as refused:
        _ = FolderFrames(arriving / "recording.toml"), LiveEvaluation(arriving, RATE_HZ)
    assert (refused.value.code, refused.value.key) == (LIVE_NOT_POSSIBLE.code, key)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("[[daq]]\n", "[[daq]]\nfile = 3\n", "daq.file: expected .*, found 3"),
        ('trigger = "camera_trigger"', 'trigger = ["camera_trigger"]', r"images\.top\.trigger: .* found a list"),
        ('trigger = "camera_trigger"', "", r"images\.top\.trigger: .* required"),
        ('left = "top-left/*.tif"', "left = 5", r"images\.left: .* found 5"),
        ("[[images]]", "[[alien]]\n[[images]]", "alien: .*unknown key"),
    ],
)
def test_a_wrong_key_is_refused_before_a_page_is_written(arriving, old, new, told, refused):
    manifest, page = arriving / "recording.toml", arriving.parent / "light.html"
    if "file" in new:
        manifest.write_text(re.sub("^file = .*\n", "", manifest.read_text("utf-8"), flags=re.M), encoding="utf-8")
    edit(manifest, old, new)
    assert re.search(f"recording.toml: {told}", refused("look", "--live", arriving, "--rate", "38", "--page", page))
    assert not page.exists()


@pytest.mark.parametrize("key", ["images", "daq"])
def test_a_value_in_place_of_blocks_is_refused(arriving, key, refused):
    manifest = arriving / "recording.toml"
    others = re.sub(rf"(?ms)^\[\[{key}\b.*?(?=^\[\[(?!{key}\b)|\Z)", "", manifest.read_text("utf-8"))
    manifest.write_text(others.replace("rig =", f"{key} = 3\nrig =", 1), encoding="utf-8")
    assert f"recording.toml: {key}: expected blocks" in refused("look", "--live", arriving, "--rate", "38")


@pytest.mark.parametrize("options", [["--live"], ["--until", "0.1"], ["--rate", "50"], ["--live", "--watch"]])
def test_options_belong_together(arriving, options):
    with pytest.raises(SystemExit):
        main(["look", str(arriving), *options])


def test_a_first_frame_that_shows_no_body_is_refused_and_the_next_ones_are_used(long_recording):
    dark = [LiveFrame("top", k, tuple(np.full((240, 304), 20 + k, np.uint16) for _ in range(2))) for k in range(8)]
    with LiveEvaluation(long_recording, RATE_HZ) as evaluation:
        for frame in dark[:-1]:
            evaluation.add(frame)
        with pytest.raises(InputError):
            evaluation.add(dark[-1])
        for frame in frames_of(long_recording, 24):
            evaluation.add(replace(frame, number=frame.number + 8))
        assert evaluation.state().driven is not None
        with pytest.raises(ValueError, match=r"frame\.number"):
            evaluation.add(replace(frame, number=5))


# Files: partial, lost, repeated, damaged, too many, removed.


@pytest.fixture
def cameras(arriving: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two empty camera folders, with short waiting times."""
    monkeypatch.setattr(live_folder, "LATE_S", 0.0)
    monkeypatch.setattr(live_folder, "UNREADABLE_S", 0.0)
    for side in ("left", "right"):
        (arriving / f"top-{side}").mkdir()
    return arriving


def write(folder: Path, numbers: range | list[int], sides: tuple[str, ...] = ("left", "right")) -> None:
    for side in sides:
        for number in numbers:
            cv2.imwrite(str(folder / f"top-{side}" / f"img{number:05d}.tif"), np.full((6, 8), number % 251, np.uint8))


def taken(frames: FolderFrames, most: int = 1000, polls: int = 4) -> list[int]:
    return [frame.number for _ in range(polls) for frame in frames.take(most)]


def test_files_are_used_when_both_cameras_have_them_completely(cameras):
    frames = FolderFrames(cameras / "recording.toml")
    write(cameras, range(100, 105), ("left",))
    assert taken(frames) == []
    write(cameras, range(100, 103), ("right",))
    assert frames.take(10) == []  # their size may still change
    assert taken(frames) == [0, 1, 2]
    path = cameras / "top-right" / "img00103.tif"
    write(cameras, [103], ("right",))
    whole = path.read_bytes()
    path.write_bytes(whole[:20])
    frames.take(10)
    path.write_bytes(whole)
    assert taken(frames) == [3]
    assert frames.counts == FrameCounts()


def test_lost_repeated_and_damaged_frames_are_counted(cameras):
    frames = FolderFrames(cameras / "recording.toml")
    write(cameras, [0, 1, 2, 5, 6, 7])
    for side in ("left", "right"):
        folder = cameras / f"top-{side}"
        shutil.copy(folder / "img00005.tif", folder / "img00006.tif")
    (cameras / "top-left" / "img00007.tif").write_bytes(b"II*\0 cut off")
    write(cameras, [8])
    assert taken(frames, polls=8) == [0, 1, 2, 5, 8]
    assert frames.counts == FrameCounts(missing=2, repeated=1, damaged=1)


def test_it_keeps_up_by_skipping_frames_without_a_period(cameras):
    frames = FolderFrames(cameras / "recording.toml")
    write(cameras, range(4))
    assert taken(frames) == [0, 1, 2, 3]
    write(cameras, range(4, 304))
    frames.take(1)
    numbers = taken(frames)
    assert len(numbers) == pytest.approx(live_folder.MOST_BEHIND / 2, abs=2)
    assert frames.counts.skipped == 300 - len(numbers)
    assert len(set(np.diff(numbers).tolist())) > 1
    assert frames.counts.missing == 0
    write(cameras, range(304, 310))
    assert taken(frames) == list(range(304, 310))


def test_an_emptied_folder_begins_anew(cameras):
    frames = FolderFrames(cameras / "recording.toml")
    write(cameras, range(4))
    assert taken(frames) == [0, 1, 2, 3]
    shutil.rmtree(cameras / "top-left")
    taken(frames)
    assert frames.emptied


def test_names_without_a_counter_are_taken_in_their_order(cameras):
    frames = FolderFrames(cameras / "recording.toml")
    stamps = ["120000.013", "120000.032", "120000.052", "120000.070"]
    for side in ("left", "right"):
        for number, stamp in enumerate(stamps):
            path = cameras / f"top-{side}" / f"{stamp}.tif"
            cv2.imwrite(str(path), np.full((6, 8), number, np.uint8))
            os.utime(path)
    assert taken(frames) == [0, 1, 2, 3]
