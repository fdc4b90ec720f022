"""Recordings in takes without images: a laser that looks at one point after another, a reference, an output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from support import block, channel, recording_head, write_daq

from photogram.geometry import rotation_from_vector

FREQUENCY_HZ = 106.2507
RATE_HZ, SAMPLES = 4000.0, 6000
# Acceleration of the load at the sensor origin, m/s^2 and rad/s^2; that of the base's reference point along z.
LOAD = np.array([0.4 - 0.2j, 0.3j, 106.0 * np.exp(0.7j), 2.0 + 1.0j, -3.0 + 0.5j, 0.0])
BASE_Z = 95.0 * np.exp(0.75j)
MASS_KG, SENSITIVITY = 6.9605 + 0.769, 2.0e-7 * np.exp(-0.02j)
LASER_V, ACCELEROMETER_V, BRIDGE_V = 0.125, 98.1, 1e-3  # SI per file value
SCALE_U = 2.5e-4
POINTS = tuple((float(0.04 * np.cos(angle)), float(0.04 * np.sin(angle)), 0.05) for angle in np.arange(8) * np.pi / 4.0)

SENSOR = {"channels": ["Fz"], "unit": "V/V", "sense": "on_load"}
RIG = block(format=1, name="laser that looks at one point after another")
RIG += block("sensor", name="transducer", **SENSOR, internal_mass=0.769, internal_mass_uncertainty=0.002)
INERTIA = np.diag([0.036, 0.036, 0.031]).tolist()
RIG += block("load", mass=6.9605, mass_uncertainty=0.001, centre_of_mass=[0.0] * 3, inertia=INERTIA)


def head(harmonics: Any = (1,)) -> str:
    """The beginning of a recording.toml."""
    return recording_head("takes", harmonics=harmonics).partition("[[daq]]")[0]


def laser(name: str, point: Sequence[float], at: str = "") -> str:
    place = {"body": "load", "point": list(point), "direction": [0.0, 0.0, 1.0]}
    return channel(name, "velocity", at, **place, scale=LASER_V, scale_uncertainty=SCALE_U, common="laser")


def reference(name: str, at: str = "") -> str:
    place = {"body": "base", "point": [0.0, 0.0, -0.1], "direction": [0.0, 0.0, 1.0]}
    return channel(name, "acceleration", at, **place, scale=ACCELEROMETER_V, scale_uncertainty=5e-3, reference=True)


def output(name: str, at: str = "") -> str:
    return channel(name, "output", at, channel="Fz", scale=BRIDGE_V, scale_uncertainty=1e-4)


@dataclass(frozen=True)
class Shot:
    """One take: complex `level` against the first, exact frequency, points looked at; shares of harmonics; noise."""

    points: Sequence[Sequence[float]]
    level: complex = 1.0
    frequency_hz: float = FREQUENCY_HZ
    harmonics: Mapping[int, float] = field(default_factory=dict)
    noise: float = 1e-5
    reference: complex = BASE_Z
    samples: int = SAMPLES
    rate_hz: float = RATE_HZ


def at_point(point: Sequence[float]) -> complex:
    """Acceleration along z of a point of the load."""
    return complex(LOAD[2] + LOAD[3] * point[1] - LOAD[4] * point[0])


def signals(shot: Shot, rng: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    """Samples of a take as its file has them: `velocity_1` …, `drive`, `Fz`."""
    time_s = np.arange(shot.samples) / shot.rate_hz
    omega = 2.0 * np.pi * shot.frequency_hz
    values = {}
    lasers = {f"velocity_{n}": (at_point(p), LASER_V, 1) for n, p in enumerate(shot.points, 1)}
    channels = {
        **lasers,
        "drive": (shot.reference, ACCELEROMETER_V, 0),
        "Fz": (SENSITIVITY * MASS_KG * LOAD[2], BRIDGE_V, 0),
    }
    for name, (acceleration, scale, integrals) in channels.items():
        signal = np.zeros(shot.samples)
        for multiple, share in {1: 1.0, **shot.harmonics}.items():
            phasor = shot.level**multiple * share * acceleration / (1j * multiple * omega) ** integrals / scale
            signal += (phasor * np.exp(1j * multiple * omega * time_s)).real
        size = abs(acceleration / (1j * omega) ** integrals / scale)
        values[name] = signal + shot.noise * max(size, 1e-9) * rng.normal(size=shot.samples)
    return values


FRAME_RATE_HZ, FIRST_EDGE_S, EXPOSURE_S = 49.7, 0.02131, 40e-6


def camera_trigger(time_s: NDArray[np.float64], frames: int) -> NDArray[np.float64]:
    """Pulses of 5 V that start the exposures."""
    period = (time_s - FIRST_EDGE_S) * FRAME_RATE_HZ
    number = np.floor(period)
    return np.asarray(5.0 * ((number >= 0) & (number < frames) & (period - number < 0.25)))


def moving_plate(
    displacement: NDArray[np.complex128], frames: int, nodes: tuple[int, int], z: float, delay_s: float = 0.0
) -> NDArray[np.float64]:
    """Points (F, N, 3) of a plate in m, in the mean over each exposure, by displacement phasors (6,) in m and rad."""
    middle_s = FIRST_EDGE_S + np.arange(frames) / FRAME_RATE_HZ + delay_s + EXPOSURE_S / 2.0
    turned = np.exp(2j * np.pi * FREQUENCY_HZ * middle_s)[:, None]
    pose = np.sinc(FREQUENCY_HZ * EXPOSURE_S) * (displacement * turned).real
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, nodes[0]), np.linspace(-0.04, 0.04, nodes[1]))
    rest = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    return np.einsum("fij,nj->fni", rotation_from_vector(pose[:, 3:]), rest) + pose[:, None, :3]


def take(file: str, points: Sequence[Sequence[float]], at: str = "take.") -> str:
    """The DAQ block of one take."""
    text = (block("[take]") if at else "") + block(f"[{at}daq]", name="daq", file=file)
    text += reference("drive", at) + output("Fz", at)
    return text + "".join(laser(f"velocity_{n}", point, at) for n, point in enumerate(points, 1))


def write_takes(
    folder: Path, shots: Sequence[Shot], rng: np.random.Generator, harmonics: Any = "auto", top: bool = False
) -> Path:
    """Write a recording of several takes, the first at the top level where `top`; return its folder."""
    recording = folder / "takes"
    recording.mkdir(parents=True)
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    text = head(harmonics)
    for number, shot in enumerate(shots, 1):
        write_daq(recording / f"{number}.h5", shot.rate_hz, signals(shot, rng))
        text += take(f"{number}.h5", shot.points, "" if top and number == 1 else "take.")
    (recording / "recording.toml").write_text(text, encoding="utf-8")
    return recording
