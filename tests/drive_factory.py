"""A small recording without images: points of a base that moves along z, their trigger, and a laser on it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from fusion.base import Settings
from fusion.recording.load import load_manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.evaluate import evaluate_recording

DRIVEN_HZ, DAQ_HZ, SAMPLES, FRAMES = 106.25, 10_000.0, 14_000, 64
FOLDING_HZ, CLEAR_HZ = 53.125, 49.7
AMPLITUDE_M = 2.4e-4

RIG = """
format = 1
name = "points and a laser"
[stereo.base]
body = "base"
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
translation = [0.0, 0.0, 0.0]
scale_uncertainty = 2e-4
exposure = 40e-6
"""
RECORDING = """
format = 1
name = "folded"
rig = "../rig.toml"
[excitation]
kind = "sine"
direction = [0.0, 0.0, 1.0]
frequencies = [106.25]
harmonics = {harmonics}
[[daq]]
name = "daq"
file = "daq.h5"
[[daq.channel]]
name = "camera_trigger"
quantity = "trigger"
[[points]]
stereo = "base"
files = "points/frame_*.txt"
columns = ["x0", "y0", "z0", "x", "y", "z"]
trigger = "camera_trigger"
"""
LASER = """
[[daq.channel]]
name = "laser"
quantity = "velocity"
body = "base"
point = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
scale = 1.0
scale_uncertainty = 5e-4
"""


def recording(
    folder: Path, frame_hz: float, *, laser: bool, harmonics: str = "[]", overtone: float = 0.0, growth: float = 0.0
) -> Path:
    """Write a recording of a base that moves along z, and return its folder.

    `overtone`: third harmonic over the driven line; `growth`: relative change of the amplitude per second.
    """
    rng = np.random.default_rng(1)
    place = folder / "campaign" / "drive"
    (place / "points").mkdir(parents=True)
    (place.parent / "rig.toml").write_text(RIG, encoding="utf-8")
    text = RECORDING.format(harmonics=harmonics)
    head, tail = text.split("[[points]]")
    (place / "recording.toml").write_text(head + (LASER if laser else "") + "[[points]]" + tail, encoding="utf-8")
    first_s = 0.0213
    middle_s = first_s + np.arange(FRAMES) / frame_hz + 20e-6
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 5), np.linspace(-0.04, 0.04, 4))
    rest = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    angle = 2.0 * np.pi * DRIVEN_HZ * middle_s
    height = AMPLITUDE_M * (1.0 + growth * middle_s) * (np.cos(angle) + overtone * np.cos(3.0 * angle))
    for frame, z in enumerate(height):
        seen = rest + [0.0, 0.0, z] + 1e-6 * rng.normal(size=rest.shape)
        np.savetxt(place / "points" / f"frame_{frame:03d}.txt", np.column_stack([rest, seen]), fmt="%.9f")
    time_s = np.arange(SAMPLES) / DAQ_HZ
    turns = (time_s - first_s) * frame_hz
    with h5py.File(place / "daq.h5", "w") as file:
        file.attrs["sample_rate"] = DAQ_HZ
        file["camera_trigger"] = 5.0 * ((turns >= 0) & (turns < FRAMES) & (np.mod(turns, 1.0) < 0.25))
        if laser:
            omega = 2.0 * np.pi * DRIVEN_HZ
            velocity = -omega * AMPLITUDE_M * (np.sin(omega * time_s) + 3 * overtone * np.sin(3 * omega * time_s))
            file["laser"] = velocity * (1.0 + growth * time_s) + 1e-5 * rng.normal(size=SAMPLES)
    return place


def evaluate(folder: Path) -> Evaluation:
    return evaluate_recording(load_manifest(folder), Settings(), {})
