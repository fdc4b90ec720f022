"""Roles of channels, drafted from their signals and names: triggers, outputs, sensitivities, direction, bodies."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from recorder_layouts import EDGES, LAYOUTS, write_layout
from support import write_daq

from fusion import InputError, draft
from fusion.planning.draft.channel_guess import component_of, guess_channel
from fusion.planning.draft.inventory import FoundChannel, survey_folder

RATE = 10e3
TIME = np.arange(20_000) / RATE


def recording(folder: Path) -> Any:
    """The only recording.toml that is drafted in a folder."""
    (text,) = (text for path, text in draft(folder).files.items() if path.name == "recording.toml")
    return tomllib.loads(text)


def write(path: Path, signals: dict[str, np.ndarray], units: dict[str, str]) -> None:
    """Write a file with units."""
    write_daq(path, RATE, signals)
    with h5py.File(path, "a") as file:
        for name, unit in units.items():
            file[name].attrs["unit"] = unit


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_recorder_layout_is_drafted_with_its_trigger_and_its_laser(tmp_path, layout):
    write_layout(tmp_path, layout)
    (block,) = recording(tmp_path)["daq"]
    entries = {entry["quantity"]: entry for entry in block["channel"]}
    assert "trigger" in entries
    (found,) = survey_folder(tmp_path).daqs
    (pulses,) = (channel.pulses for channel in found.channels if channel.pulses)
    assert (pulses.edges, pulses.rate_hz) == (EDGES, pytest.approx(20.0, rel=1e-3))
    if len(block["channel"]) > 1:  # others are asked for
        assert set(entries) <= {"trigger", "velocity", "?"}
        if "velocity" in entries and "[V]" not in layout:
            assert entries["velocity"]["scale"] in (1.0, "?")


@pytest.mark.parametrize("shape", ["ring", "step"])
@pytest.mark.parametrize("frequency_hz", [30.0, 120.0, 900.0])
@pytest.mark.parametrize("damping", [0.002, 0.012, 0.06])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_release_that_rings_is_no_trigger(tmp_path, shape, frequency_hz, damping, sign):
    since = np.clip(TIME - 0.08, 0.0, None)
    omega = 2 * np.pi * frequency_hz
    ringing = np.exp(-damping * omega * since) * np.cos(omega * np.sqrt(1 - damping**2) * since)
    signal = sign * (ringing * (TIME > 0.08) if shape == "ring" else 1.0 - ringing)
    write(tmp_path / "a.h5", {"Fz": signal + 1e-3 * np.random.default_rng(1).normal(size=len(TIME))}, {"Fz": "mV/V"})
    assert [channel.pulses for channel in survey_folder(tmp_path).daqs[0].channels] == [None]


@pytest.mark.parametrize("duty", [0.01, 0.5, 0.95])
@pytest.mark.parametrize("inverted", [True, False])
def test_pulses_are_a_trigger_with_noise_and_either_level(tmp_path, duty, inverted):
    high = (0.047 * duty > (TIME - 0.1234) % 0.047) & (TIME > 0.12) & (TIME < 1.8)
    noise = 0.1 * np.random.default_rng(2).normal(size=len(TIME))
    write_daq(tmp_path / "a.h5", RATE, {"ai7": 5.0 * (high != inverted) + noise})
    (channel,) = survey_folder(tmp_path).daqs[0].channels
    assert channel.pulses is not None
    assert channel.pulses.rate_hz == pytest.approx(1 / 0.047, rel=1e-3)


def test_channels_with_the_same_pulses_are_one_trigger(tmp_path):
    def pulses(delay_s: float, period_s: float = 0.05) -> np.ndarray:
        return 5.0 * ((TIME - 0.02 - delay_s) % period_s < 5e-3)

    signals = {"ai1": pulses(0.0), "exposure out": pulses(40e-6), "camera trigger": pulses(0.0), "ai2": pulses(0, 0.03)}
    write_daq(tmp_path / "a.h5", RATE, {**signals, "laser": np.sin(2 * np.pi * 80.0 * TIME)})
    text = next(text for path, text in draft(tmp_path).files.items() if path.name == "recording.toml")
    channels = tomllib.loads(text)["daq"][0]["channel"]
    assert [entry["name"] for entry in channels] == ["laser", "ai2", "camera trigger"]
    assert '# "ai1" has the same pulses as camera trigger' in text


def test_numbers_of_rows_and_empty_columns_are_no_channels(tmp_path):
    rows = "".join(f"{i + 1};{t:.4f};{np.sin(503 * t):.5f};\n" for i, t in enumerate(TIME[:4000]))
    (tmp_path / "a.csv").write_text("Nr.;Zeit [s];Laser [m/s];Reserve\n" + rows)
    (found,) = survey_folder(tmp_path).daqs
    assert [channel.name for channel in found.channels] == ["Laser [m/s]"]


SENSITIVITIES = [
    ("VIB 25 mm/s/V", "velocity", 0.025),
    ("Laser (125 mm/s / V)", "velocity", 0.125),
    ("OFV-5000 0,1 m/s/V", "velocity", 0.1),
    ("ICP 100 mV/g", "acceleration", 9.80665 / 0.1),
    ("Acc 10.2 mV/(m/s²)", "acceleration", 1.0 / 10.2e-3),
    ("ai3 4 mV/N", "force", 250.0),
    ("D 500 µm/V", "displacement", 5e-4),
]


@pytest.mark.parametrize(("name", "quantity", "scale"), SENSITIVITIES)
def test_a_sensitivity_in_a_name_is_the_scale(name, quantity, scale):
    made = guess_channel(FoundChannel(name, "V", 1e3, 100, -1.0, 1.0, None))
    assert (made.quantity, made.scale) == (quantity, pytest.approx(scale))
    assert guess_channel(FoundChannel(name, "m/s", 1e3, 100, -1.0, 1.0, None)).scale != pytest.approx(scale)


def test_volts_per_unit_in_the_name_of_a_column_are_no_unit_of_its_numbers(tmp_path):
    names = ("VIB 25 mm/s/V", "ICP 100 mV/g", "Acc 10.2 mV/(m/s²)", "ai3 4 mV/N", "bridge mV/V")
    rows = "".join(f"{t:.4f}{5 * f';{np.sin(503 * t):.5f}'}\n" for t in TIME[:400])
    (tmp_path / "a.csv").write_text(f"Zeit;{';'.join(names)}\n" + rows)
    (found,) = survey_folder(tmp_path).daqs
    units = [found.raw[name].unit for name in names]
    assert units == ["V", "", "", "", "mV/V"]
    made = [guess_channel(channel).scale for channel in found.channels if channel.name in names[:4]]
    assert made == [pytest.approx(scale) for scale in (0.025, 9.80665 / 0.1, 1.0 / 10.2e-3, 250.0)]


@pytest.mark.parametrize(
    ("name", "component"),
    [
        ("Fx", "Fx"), ("F_z", "Fz"), ("Kraft Z", "Fz"), ("force-y [N]", "Fy"), ("Mx1", "Mx"), ("Moment X", "Mx"),
        ("Torque_z", "Mz"), ("bridge/Fz", "Fz"), ("X-Kraft", "Fx"), ("max", ""), ("offset", ""), ("Fmax", ""),
    ],
)  # fmt: skip
def test_components_by_their_names(name, component):
    assert component_of(name) == component


def test_six_loads_without_names_are_the_outputs_of_a_sensor_in_their_order(tmp_path):
    names = [f"CH{k}" for k in range(1, 7)]
    signals = {name: np.sin(2 * np.pi * 80.0 * TIME) for name in names}
    write(tmp_path / "a.h5", signals, {name: "N" if k < 3 else "N m" for k, name in enumerate(names)})
    channels = recording(tmp_path)["daq"][0]["channel"]
    assert [(entry["quantity"], entry["channel"]) for entry in channels] == [
        ("output", component) for component in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    ]


@pytest.mark.parametrize(("sizes", "direction"), [((0.1, 0.2, 3.0), [0, 0, 1]), ((1.0, 0.9, 2.0), "?")])
def test_the_direction_is_that_of_the_force_with_the_largest_line(tmp_path, sizes, direction):
    sine = np.sin(2 * np.pi * 80.0 * TIME)
    signals = {name: size * sine for name, size in zip(("Fx", "Fy", "Fz"), sizes, strict=True)}
    write(tmp_path / "a.h5", signals, dict.fromkeys(signals, "N"))
    assert recording(tmp_path)["excitation"]["direction"] == direction


def test_of_two_channels_without_names_that_with_less_motion_is_guessed_as_the_base(tmp_path):
    sine = np.sin(2 * np.pi * 80.0 * TIME)
    write(tmp_path / "a.h5", {"ai0": 1.3 * sine, "ai1": sine}, {"ai0": "m/s²", "ai1": "m/s²"})
    channels = recording(tmp_path)["daq"][0]["channel"]
    assert [(entry["name"], entry["body"]) for entry in channels] == [("ai0", "load"), ("ai1", "base")]


@pytest.mark.parametrize(
    ("sizes", "base"), [((1.0, 1.01, 1.25), "ai0 ai1"), ((1.0, 1.25, 1.26, 0.02), "ai0"), ((1.0, 1.01, 1.02), "")]
)
def test_of_more_channels_a_clear_step_between_their_sizes_separates_base_and_load(tmp_path, sizes, base):
    sine = np.sin(2 * np.pi * 80.0 * TIME)
    signals = {f"ai{k}": size * sine for k, size in enumerate(sizes)}
    write(tmp_path / "a.h5", signals, dict.fromkeys(signals, "m/s²"))
    channels = recording(tmp_path)["daq"][0]["channel"]
    assert " ".join(entry["name"] for entry in channels if entry["body"] == "base") == base


def test_a_rate_that_no_file_states_is_asked_for(tmp_path):
    (tmp_path / "a.csv").write_text("Laser [m/s]\n" + "".join(f"{np.sin(503 * t):.5f}\n" for t in TIME[:500]))
    (block,) = recording(tmp_path)["daq"]
    assert (block["sample_rate"], block["channel"][0]["quantity"]) == ("?", "velocity")


def test_recordings_two_levels_below_are_named(tmp_path):
    for day in ("Monday", "Tuesday"):
        (tmp_path / day / "run1").mkdir(parents=True)
        write(tmp_path / day / "run1" / "a.h5", {"laser": np.sin(503 * TIME)}, {"laser": "m/s"})
    with pytest.raises(InputError, match="Monday, Tuesday"):
        draft(tmp_path)


def test_a_table_of_another_suffix_is_listed(tmp_path):
    for name in ("log.prn", "log.asc"):
        (tmp_path / name).write_text(
            "Zeit [s]\tLaser [m/s]\n" + "".join(f"{t:.4f}\t{t % 0.1:.5f}\n" for t in TIME[:500])
        )
    assert [text.partition(":")[0] for text in survey_folder(tmp_path).unreadable] == ["log.asc", "log.prn"]
    assert all(".txt" in text for text in survey_folder(tmp_path).unreadable)


def test_a_folder_of_the_recorder_next_to_folders_of_images_is_one_recording(tmp_path, demo_recording):
    (tmp_path / "daq").mkdir()
    (stated,) = demo_recording.rglob("recording.toml")
    for path in stated.parent.iterdir():
        if path.suffix == ".h5":
            shutil.copy(path, tmp_path / "daq")
        elif path.is_dir():
            shutil.copytree(path, tmp_path / "cams" / path.name)
    manifest = recording(tmp_path)
    assert {block["file"] for block in manifest["daq"]} == {"daq/bridge.h5", "daq/vibrometer.h5"}
    assert {block["left"].split("/")[1] for block in manifest["images"]} == {"base-left", "top-left"}


def test_recordings_without_images_next_to_a_folder_of_images_are_recordings(tmp_path):
    for name in ("Fz-0080", "Fz-0106"):
        (tmp_path / name).mkdir()
        write(tmp_path / name / "a.h5", {"laser": np.sin(503 * TIME)}, {"laser": "m/s"})
    (tmp_path / "photographs").mkdir()
    cv2.imwrite(str(tmp_path / "photographs" / "rig.png"), np.zeros((40, 60), np.uint8))
    assert {path.parent.name for path in draft(tmp_path).files} >= {"Fz-0080", "Fz-0106"}
