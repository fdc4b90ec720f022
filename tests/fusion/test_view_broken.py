"""`shakercal view` of broken recordings: what can be read is shown, the rest marked with code and sentence."""

from __future__ import annotations

import json
import re
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from fusion.planning.view.extremes import Extremes
from fusion.planning.view.shown_images import numbers_of_frames, paired_frames
from fusion.planning.view.view_requests import api_handlers
from fusion.planning.view.view_sources import find_sources
from fusion.planning.view.viewed_recording import ViewSession
from fusion.recording.recording_notices import FRAMES_DO_NOT_MATCH, INVALID_SYNTAX, MISSING_FILE, UNKNOWN_NAME
from photogram.images.image_files import open_sequence
from tests.fusion.test_wrong_input import NAME, WRONG
from tests.fusion.test_wrong_manifest import CASES

WHOLE = {"top": [24, 24], "base": [24, 24]}


def head(body: bytes) -> Any:
    (length,) = struct.unpack("<Q", body[:8])
    return json.loads(body[8 : 8 + length])


class Asked:
    """A recording that was opened, and what the page gets of it."""

    def __init__(self, path: Path) -> None:
        self.handlers = api_handlers(ViewSession(find_sources(path)))
        self.told: Any = self.ask("recording")
        self.errors = [*self.told["errors"], *self.ask("refusals")["errors"]]

    def ask(self, what: str, **asked: object) -> Any:
        found = self.handlers[what]({name: str(value) for name, value in asked.items()})
        return head(found) if isinstance(found, bytes) else found

    @property
    def images(self) -> dict[str, list[int]]:
        """Number of readable images of each camera by pair."""
        return {
            pair["name"]: [
                sum("width" in self.frame(number, side, frame) for frame in range(pair["frames"]))
                for side in range(len(pair["cameras"]))
            ]
            for number, pair in enumerate(self.told["pairs"])
        }

    def frame(self, pair: int, side: int, frame: int) -> Any:
        return self.ask("frame", pair=pair, side=side, frame=frame)

    @property
    def signals(self) -> Any:
        return self.ask("signal", channels=",".join(map(str, range(len(self.told["channels"])))), columns=20)


@pytest.fixture
def campaign(tmp_path: Path, demo_recording: Path) -> Path:
    return Path(shutil.copytree(demo_recording, tmp_path / "campaign"))


@pytest.mark.parametrize(("file", "case"), [(file, case) for file, cases in WRONG.items() for case in cases])
def test_a_broken_recording_opens_and_names_what_is_wrong(file, case, campaign):
    break_it, *parts = WRONG[file][case]
    break_it(campaign)
    opened = Asked(campaign / NAME)
    lines = [f"{one['code']} {one['where']}: {one['text']} " for one in opened.errors]
    assert lines
    assert all(re.match(r"SC-\d{3} \S", line) for line in lines)
    if case != "excitation of another command":  # the viewer asks the command of the recording's kind
        parts = [part.strip().strip(":") for part in parts if re.fullmatch(r"SC-\d{3}|.*\.(tif|h5|tdms): ", part)]
        assert all(any(part in line for line in lines) for part in parts), lines
    # At most the one image or file that was damaged is missing.
    images = opened.images
    frames = {"two frames": [2, 2], "more edges than frames": [23, 23]}.get(case, [24, 24])
    assert set(images) == set(WHOLE)
    assert sum(frames) - sum(images["top"]) <= 1
    assert 48 - sum(images["base"]) <= 1
    signals = opened.signals
    assert len(signals["channels"]) + len(signals["refused"]) == len(opened.told["channels"])
    unreadable = {"corrupt HDF5": 7, "truncated HDF5": 7, "corrupt TDMS": 7, "channel absent from the file": 1}
    assert len(signals["refused"]) == unreadable.get(case, 0)


@pytest.mark.parametrize(("file", "old", "new"), [case[:3] for case in CASES])
def test_a_wrong_manifest_opens_and_names_its_errors(file, old, new, make_campaign):
    opened = Asked(make_campaign(replace=((file, old, new),)))
    assert opened.told["errors"]
    assert all(re.fullmatch(r"SC-\d{3}", one["code"]) for one in opened.told["errors"])
    assert any(one["where"].startswith((file, "recording.toml")) for one in opened.told["errors"])
    json.dumps(opened.told, allow_nan=False)


def test_an_image_that_is_missing_on_one_side_leaves_the_others_in_pairs(campaign):
    (campaign / NAME / "top-right" / "0007.tif").unlink()
    opened = Asked(campaign / NAME)
    assert FRAMES_DO_NOT_MATCH.code in [one["code"] for one in opened.told["errors"]]
    (top,) = (pair for pair in opened.told["pairs"] if pair["name"] == "top")
    left, right = (camera["files"] for camera in top["cameras"])
    assert left == [f"{n:04d}.tif" for n in range(24)]
    assert right == [name if name != "0007.tif" else "" for name in left]
    assert opened.images["top"] == [24, 23]
    assert "no image" in opened.frame(0, 1, 7)["refused"]["text"]


def test_a_late_camera_is_paired_by_its_edges(campaign):
    file = campaign / NAME / "recording.toml"
    text = file.read_text(encoding="utf-8")
    stated = 'stereo = "top"\nfirst_edge = { left = 2, right = 0 }\n'
    file.write_text(re.sub(r'stereo = "top"\n(.*\n)*?first_edge.*\n', stated, text), encoding="utf-8")
    if "first_edge = { left" not in file.read_text(encoding="utf-8"):
        file.write_text(text.replace('stereo = "top"\n', stated, 1), encoding="utf-8")
    top = Asked(campaign / NAME).told["pairs"][0]
    left, right = (camera["files"] for camera in top["cameras"])
    assert top["frames"] == 26
    assert (left[:3], right[:3]) == (["", "", "0000.tif"], ["0000.tif", "0001.tif", "0002.tif"])


def test_frames_are_paired_by_key():
    assert paired_frames([[5, 6, 8], [6, 7, 8]]) == [[0, None], [1, 0], [None, 1], [2, 2]]


def test_series_of_equal_length_are_paired_in_order(campaign):
    cameras = [open_sequence(sorted((campaign / NAME / f"top-{side}").iterdir())) for side in ("left", "right")]
    assert numbers_of_frames(cameras) == [list(range(24))] * 2  # type: ignore[arg-type]


def test_every_other_image_of_a_camera_may_be_damaged(campaign):
    files = sorted((campaign / NAME / "top-left").iterdir())
    for file in files[::2]:
        file.write_bytes(file.read_bytes()[:500])
    opened = Asked(campaign / NAME)
    assert opened.images["top"] == [12, 24]
    assert opened.told["pairs"][0]["cameras"][0]["refused"] == list(range(0, 24, 2))
    grey = tifffile.imread(files[1])
    body = opened.handlers["frame"]({"pair": "0", "side": "0", "frame": "1"})
    assert isinstance(body, bytes)
    np.testing.assert_array_equal(np.frombuffer(body[-grey.nbytes :], "<u2").reshape(grey.shape), grey)


def test_a_line_that_is_no_toml_costs_that_line(campaign):
    file = campaign / NAME / "recording.toml"
    file.write_text(file.read_text(encoding="utf-8").replace('operator = "', 'operator = = "', 1), encoding="utf-8")
    if "= =" not in file.read_text(encoding="utf-8"):
        file.write_text("date = = 1\n" + file.read_text(encoding="utf-8"), encoding="utf-8")
    opened = Asked(campaign / NAME)
    assert [one["code"] for one in opened.told["errors"]][:1] == [INVALID_SYNTAX.code]
    assert opened.images == WHOLE
    assert opened.signals["refused"] == {}


def test_without_rig_images_and_channels_are_shown(campaign):
    (campaign / "rig.toml").unlink()
    opened = Asked(campaign / NAME)
    assert MISSING_FILE.code in [one["code"] for one in opened.told["errors"]]
    assert opened.images == WHOLE
    assert opened.signals["refused"] == {}


def test_a_channel_keeps_its_scale_beside_an_error_elsewhere(campaign):
    whole = Asked(campaign / NAME)
    names = [channel["name"] for channel in whole.told["channels"]]
    asked = {"channel": str(names.index("velocity_1"))}
    before = whole.handlers["spectrum"](asked)
    file = campaign / NAME / "recording.toml"
    file.write_text(file.read_text(encoding="utf-8").replace('stereo = "base"', 'stereo = "bass"', 1), encoding="utf-8")
    opened = Asked(campaign / NAME)
    assert UNKNOWN_NAME.code in [one["code"] for one in opened.told["errors"]]
    assert opened.handlers["spectrum"](asked) == before


def test_files_outside_the_campaign_are_not_shown(campaign):
    file = campaign / NAME / "recording.toml"
    text = file.read_text(encoding="utf-8")
    (campaign.parent / "secret").mkdir()
    shutil.copy(campaign / NAME / "top-left" / "0000.tif", campaign.parent / "secret")
    file.write_text(text.replace('left = "top-left/*.tif"', 'left = "../../secret/*.tif"', 1), encoding="utf-8")
    opened = Asked(campaign / NAME)
    assert [camera["side"] for camera in opened.told["pairs"][0]["cameras"]] == ["right"]


def test_lost_samples_hide_no_others():
    samples = np.sin(np.arange(10_000.0))
    samples[100:164] = np.nan
    found = Extremes(samples).columns(0, 10_000, 20)
    assert np.isfinite(found.low).all()
    assert found.high.max() == np.nanmax(samples)
