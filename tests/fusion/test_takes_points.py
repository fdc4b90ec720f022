"""Cameras in takes: load and base one after another, clocks tied anew in every take."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from take_factory import (
    FREQUENCY_HZ,
    HEAD,
    LOAD,
    MASS_KG,
    OUTPUT,
    RATE_HZ,
    REFERENCE,
    RIG,
    SENSITIVITY,
    write_shot,
)

from fusion.base import Settings
from fusion.recording.load import load_manifest
from fusion.report.csv_files import result_tables
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.evaluate import evaluate_recording
from photogram.geometry import rotation_from_vector

OMEGA = 2.0 * np.pi * FREQUENCY_HZ
BASE = np.array([0.1, -0.2j, 98.0 * np.exp(0.72j), 1.0, 0.5j, 0.0])
SAMPLES, BRIDGE_RATE_HZ = 8000, 9600.0
FRAME_RATE_HZ, FRAMES, FIRST_EDGE_S, EXPOSURE_S = 49.7, 80, 0.0213, 40e-6
PAIR = """
[stereo.{name}]
body = "{body}"
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
translation = [0.0, 0.0, 0.0]
scale_uncertainty = 2e-4
exposure = 40e-6
"""
TRIGGER = '[[take.daq.channel]]\nname = "camera"\nquantity = "trigger"\n'
POINTS = """[[take.points]]
stereo = "{name}"
files = "{number}.csv"
columns = ["frame", "id", "x", "y", "z"]
trigger = "camera"
"""


@dataclass(frozen=True)
class Look:
    """One take: which pair looked at which motion (m/s^2, rad/s^2), and its complex level against the first take."""

    pair: str
    motion: np.ndarray
    level: complex


LOOKS = (Look("top", LOAD, 1.0), Look("base", BASE, 1.003 * np.exp(1.9j)), Look("top", LOAD, 0.998 * np.exp(-2.4j)))


def _sine(phasor: complex, time_s: np.ndarray) -> np.ndarray:
    return np.asarray((phasor * np.exp(1j * OMEGA * time_s)).real)


def _trigger(time_s: np.ndarray) -> np.ndarray:
    period = (time_s - FIRST_EDGE_S) * FRAME_RATE_HZ
    number = np.floor(period)
    return np.asarray(5.0 * ((number >= 0) & (number < FRAMES) & (period - number < 0.25)))


def _write_points(path: Path, look: Look, rng: np.random.Generator) -> None:
    """Points of a plate, in m, as they stand in the middle of each exposure."""
    middle_s = FIRST_EDGE_S + np.arange(FRAMES) / FRAME_RATE_HZ + EXPOSURE_S / 2.0
    displacement = np.sinc(FREQUENCY_HZ * EXPOSURE_S) * look.level * look.motion / -(OMEGA**2)
    pose = np.array([_sine(complex(part), middle_s) for part in displacement]).T
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 6), np.linspace(-0.04, 0.04, 5))
    rest = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    moved = np.einsum("fij,nj->fni", rotation_from_vector(pose[:, 3:]), rest) + pose[:, None, :3]
    moved += 2e-7 * rng.normal(size=moved.shape)
    frames, points = np.indices(moved.shape[:2])
    table = np.column_stack([frames.ravel(), points.ravel(), moved.reshape(-1, 3)])
    np.savetxt(path, table, fmt=["%d", "%d", "%.10f", "%.10f", "%.10f"], delimiter=",")


def _write(folder: Path) -> Path:
    """Three takes: two blocks each, the second sampled by a clock that started at another time."""
    rng = np.random.default_rng(17)
    recording = folder / "takes"
    recording.mkdir()
    pairs = PAIR.format(name="top", body="load") + PAIR.format(name="base", body="base")
    (folder / "rig.toml").write_text(RIG + pairs)
    text = HEAD.format(harmonics="[1]")
    for number, look in enumerate(LOOKS, 1):
        time_s = np.arange(SAMPLES) / RATE_HZ
        drive = _sine(look.level * BASE[2] / 98.1, time_s) + 1e-5 * rng.normal(size=SAMPLES)
        write_shot(recording / f"{number}.h5", {"camera": _trigger(time_s), "drive": drive}, RATE_HZ)
        bridge_s = np.arange(int(SAMPLES / RATE_HZ * BRIDGE_RATE_HZ) - 300) / BRIDGE_RATE_HZ + 0.0031 * number
        force = _sine(look.level * SENSITIVITY * MASS_KG * LOAD[2] / 1e-3, bridge_s)
        force += 1e-8 * rng.normal(size=len(bridge_s))
        write_shot(recording / f"{number}b.h5", {"camera": _trigger(bridge_s), "Fz": force}, BRIDGE_RATE_HZ)
        _write_points(recording / f"{number}.csv", look, rng)
        text += f'[[take]]\n[[take.daq]]\nname = "daq"\nfile = "{number}.h5"\n{TRIGGER}'
        text += REFERENCE.format(at="take.", name="drive", mark="true")
        text += f'[[take.daq]]\nname = "bridge"\nfile = "{number}b.h5"\n{TRIGGER}'
        text += OUTPUT.format(at="take.", name="Fz") + POINTS.format(name=look.pair, number=number)
    (recording / "recording.toml").write_text(text)
    return recording


@pytest.fixture(scope="module")
def looked(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return evaluate_recording(load_manifest(_write(tmp_path_factory.mktemp("looked"))), Settings(), {})


def test_load_and_base_are_on_one_time_base(looked: Evaluation) -> None:
    for body, truth in (("load", LOAD), ("base", BASE)):
        found = next(a for a in looked.accelerations if a.body == body and a.source == "fused")
        error = found.phasors.value[0] - truth
        u = np.sqrt(found.phasors.covariance[0].diagonal())
        assert np.all(np.abs(np.concatenate([error.real, error.imag])) < 4.0 * u)
        assert abs(found.phasors.value[0, 2] / truth[2]) == pytest.approx(1.0, abs=3e-4)
        assert np.hypot(u[2], u[8]) / abs(truth[2]) < 6e-3  # edges of a trigger between samples 250 µs apart


def test_what_takes_share_is_one_unknown_and_what_they_do_not_is_not(looked: Evaluation) -> None:
    load = next(a for a in looked.accelerations if a.body == "load" and a.source == "fused")
    names = [influence.name for influence in load.uncertainty.influences]
    assert names.count("stereo top: scale") == 1
    assert {"take 1: camera: time", "take 3: camera: time"} <= set(names)
    assert looked.outputs is not None
    clocks = {i.name for i in looked.outputs.uncertainty.influences if i.name.startswith("clock ")}
    assert clocks == {f"clock take {number}: bridge: time" for number in (1, 2, 3)}


def test_sensitivity_from_cameras_in_takes(looked: Evaluation) -> None:
    found = looked.sensitivity
    assert found is not None
    error = found.value[0, 0, 2] - SENSITIVITY
    vector = np.array([error.real, error.imag])
    assert vector @ np.linalg.solve(found.covariance[0, 0, 2], vector) < 14.0
    assert abs(error / SENSITIVITY) < 5e-4


def test_a_pair_that_saw_two_takes_has_two_motions(looked: Evaluation) -> None:
    assert [pair.name for pair in looked.stereo] == ["top", "base", "top-take3"]
    assert {"motion-top.csv", "motion-base.csv", "motion-top-take3.csv"} <= set(result_tables(looked))
    assert [clock.daq for clock in looked.clocks[:2]] == ["take 1: daq", "take 1: bridge"]
