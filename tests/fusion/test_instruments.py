"""Values that channels share: `[daq.defaults]` and the instruments of a library."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import example_with, refusals, write_daq

from fusion import draft
from fusion.recording.load import load_manifest
from fusion.recording.toml import to_toml

LIBRARY = """\
[instrument.vibrometer]
quantity = "velocity"
serial = "0042"
certificate = "17-0815"
scale = { value = 0.125, U_relative = 5e-4, k = 2 }
delay = 1.2e-6
delay_uncertainty = 1e-7
names = ["velocity"]
"""


@pytest.fixture
def refused(capsys):
    return refusals(capsys)


@pytest.fixture
def demo(tmp_path, demo_recording) -> Path:
    """A copy of the demo recording."""
    ignore = shutil.ignore_patterns("results")
    return Path(shutil.copytree(demo_recording, tmp_path / "laboratory" / "demo", ignore=ignore))


def changed(demo: Path, change: Any) -> Path:
    """Change the recording of the demo."""
    path = demo / "Fz-0080" / "recording.toml"
    text = tomllib.loads(path.read_text(encoding="utf-8"))
    change(text)
    path.write_text(to_toml(text), encoding="utf-8")
    return path.parent


def test_defaults_are_what_every_channel_would_state(demo):
    before = load_manifest(demo / "Fz-0080")

    def move(text: Any) -> None:
        for block in text["daq"]:
            measuring = [entry for entry in block["channel"] if entry["quantity"] != "trigger"]
            common = {k: v for k, v in measuring[0].items() if all(entry.get(k) == v for entry in measuring)}
            block["defaults"] = {k: v for k, v in common.items() if k not in ("quantity", "point", "direction")}
            for entry in measuring:
                for key in block["defaults"]:
                    del entry[key]
        assert any(block["defaults"] for block in text["daq"])

    after = load_manifest(changed(demo, move))
    assert [block.channel for block in after.daq] == [block.channel for block in before.daq]
    assert after.inputs == before.inputs


def test_a_channel_comes_before_its_instrument_and_that_before_the_defaults(demo):
    (demo.parent / "instruments.toml").write_text(LIBRARY)

    def use(text: Any) -> None:
        block = text["daq"][0]
        block["defaults"] = {"delay": 5e-6, "transverse_sensitivity": 0.02}
        first, second, third = block["channel"][:3]
        for entry in (first, second, third):
            for key in ("scale", "scale_uncertainty", "delay", "delay_uncertainty", "common", "transverse_sensitivity"):
                entry.pop(key, None)
        first["instrument"] = second["instrument"] = "vibrometer"
        second["scale"] = 0.2
        third |= {"scale": 0.3}
        del first["quantity"]

    recording = changed(demo, use)
    manifest = load_manifest(recording)
    first, second, third = manifest.daq[0].channel[:3]
    assert (first.quantity, first.scale, first.scale_uncertainty, first.delay) == ("velocity", 0.125, 2.5e-4, 1.2e-6)
    assert (second.scale, second.delay, third.scale, third.delay) == (0.2, 1.2e-6, 0.3, 5e-6)
    assert [entry.common for entry in (first, second, third)] == ["vibrometer", "vibrometer", None]
    assert {entry.transverse_sensitivity for entry in (first, second, third)} == {0.02}
    assert demo.parent / "instruments.toml" in manifest.files
    assert all(entry.delay == 0.0 for entry in manifest.daq[0].channel if entry.quantity == "trigger")


def test_an_unknown_instrument_and_a_wrong_library_are_named(demo, refused):
    recording = changed(demo, lambda text: text["daq"][0]["channel"][0].update(instrument="laser 9"))
    place = "recording.toml: daq.vibrometer.channel.velocity_1.instrument: "
    assert place in (told := refused("check", recording))
    assert '"laser 9"' in told
    (demo / "instruments.toml").write_text(LIBRARY.replace("delay =", "dealy ="))
    told = refused("check", recording)
    assert "instruments.toml: instrument.vibrometer.dealy: " in told
    assert '"delay"' in told


def test_the_example_of_the_document_is_a_library(demo):
    text = example_with("recording-format.md", "[instrument.")
    (demo / "instruments.toml").write_text(text)
    name = next(iter(tomllib.loads(text)["instrument"]))

    def use(recording: Any) -> None:
        entry = recording["daq"][0]["channel"][0]
        entry["instrument"] = name
        del entry["scale"], entry["scale_uncertainty"]

    assert load_manifest(changed(demo, use)).daq[0].channel[0].scale == 0.125


@pytest.mark.parametrize(("unit", "scale"), [("V", None), ("m/s", 1.0)])
def test_init_finds_the_instrument_of_a_channel_by_its_name(tmp_path, unit, scale):
    (tmp_path / "instruments.toml").write_text(LIBRARY)
    place = tmp_path / "run"
    place.mkdir()
    time_s = np.arange(4000) / 2000.0
    (place / "a.csv").write_text(
        f"time [s],velocity [{unit}]\n" + "".join(f"{t:.4f},{np.sin(503 * t):.5f}\n" for t in time_s)
    )
    text = next(text for path, text in draft(place).files.items() if path.name == "recording.toml")
    (entry,) = tomllib.loads(text)["daq"][0]["channel"]
    assert entry["instrument"] == "vibrometer"
    assert entry.get("scale") == scale
    assert entry.get("scale_uncertainty") == (None if unit == "V" else "?")


def test_channels_of_one_kind_are_drafted_with_their_scale_once(tmp_path):
    time_s = np.arange(4000) / 2000.0
    write_daq(tmp_path / "a.h5", 2000.0, {f"laser {k}": k * np.sin(503 * time_s) for k in (1, 2, 3)})
    text = next(text for path, text in draft(tmp_path).files.items() if path.name == "recording.toml")
    block = tomllib.loads(text)["daq"][0]
    assert block["defaults"] == {"scale": "?", "scale_uncertainty": "?"}
    assert not any("scale" in entry for entry in block["channel"])
