"""A simulated rotation test: a sensor on an indexing head, read over a turn and back, without and with its load."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion.load import LOAD_COMPONENTS
from fusion.simulate.draws import Draws
from fusion.simulate.toml_text import to_toml
from photogram.rigid import rotation_from_vector
from shaker._checks import FloatArray
from shaker.models.weights.gravity import air_density_at, gravity_at

TRUTH_FILE, TABLE_FILE = "truth.json", "readings.csv"
BARE, LOADED = "without-load", "with-load"


@dataclass(frozen=True)
class RotationRig:
    """Truth and nominal values: masses in kg, places in m, angles in rad; outputs in mV/V as amplifiers show them."""

    internal_mass_kg: float = 0.7690
    internal_centre_m: tuple[float, float, float] = (0.0002, -0.0003, 0.0120)
    load_mass_kg: float = 6.9605
    load_centre_m: tuple[float, float, float] = (0.0001, 0.0002, 0.0450)
    load_density_kgm3: float = 7900.0
    u_load_mass_kg: float = 1e-4
    u_load_centre_m: float = 2e-4
    sensitivity: tuple[float, ...] = (5.1e-7, 5.1e-7, 2.0e-7, 9.1e-6, 9.1e-6, 8.2e-6)
    u_sensitivity: float = 5e-4
    noise: tuple[float, ...] = (2e-9, 2e-9, 2e-9, 2e-9, 2e-9, 2e-9)
    resolution: float = 1e-9
    step_rad: float = np.pi / 8.0
    u_angle_rad: float = 1e-4
    zero_rad: float = 0.004
    u_tilt_rad: float = 1e-3
    hysteresis: float = 1e-4
    latitude_deg: float = 52.296
    height_m: float = 79.0
    temperature_c: float = 22.0


def write_rotation(folder: Path, seed: int, rig: RotationRig | None = None) -> tuple[Path, Path]:
    """Write `rig.toml` and the recordings without and with load into an empty folder and return their folders.

    Everything stated as an uncertainty is drawn, gravity and air density among them. Hysteresis shifts the first
    harmonic by an angle of its own sign for either sense of turning.
    """
    rig = rig or RotationRig()
    draws = Draws(seed, True)
    (folder / "rig.toml").write_text(to_toml(_rig(rig)), encoding="utf-8", newline="\n")
    for name in (BARE, LOADED):
        recording = folder / name
        recording.mkdir()
        texts = {
            "recording.toml": to_toml(_recording(rig, name)),
            TABLE_FILE: _table(rig, name, draws),
            TRUTH_FILE: json.dumps(_truth(rig, name, seed, draws)),
        }
        for file, text in texts.items():
            (recording / file).write_text(text, encoding="utf-8", newline="\n")
    return folder / BARE, folder / LOADED


def true_outputs(rig: RotationRig, name: str, angle_rad: FloatArray, sense: FloatArray, draws: Draws) -> FloatArray:
    """Return the outputs (N, 6) without noise at angles (N,) come to in a sense (N,) of +1 or -1."""
    gravity, air = (_drawn(known, key, draws) for known, key in _surroundings(rig))
    shares = {BARE: [(rig.internal_mass_kg, 1.0 / 5000.0, np.array(rig.internal_centre_m))]}
    mass = rig.load_mass_kg + float(draws.normal("load.mass", rig.u_load_mass_kg))
    centre = np.array(rig.load_centre_m) + draws.normal("load.centre", rig.u_load_centre_m, 3)
    shares[LOADED] = [*shares[BARE], (mass, 1.0 / rig.load_density_kgm3, centre)]
    weights = [(m * gravity * (1.0 - air * volume), c) for m, volume, c in shares[name]]
    twice = draws.normal("head.twice per turn", rig.u_angle_rad, 2)
    true = angle_rad + rig.zero_rad + twice[0] * np.sin(2.0 * angle_rad) + twice[1] * np.cos(2.0 * angle_rad)
    true = true - rig.hysteresis * sense
    tilt = rotation_from_vector(np.append(draws.normal(f"{name}.tilt", rig.u_tilt_rad, 2), 0.0))
    down = np.stack([-np.sin(true), -np.cos(true), np.zeros_like(true)], axis=1) @ tilt.T
    force = sum(weight for weight, _ in weights) * down
    moment = np.cross(sum((weight * c for weight, c in weights), np.zeros(3)), down)
    errors = draws.normal("sensor.sensitivity", rig.u_sensitivity, 6)
    return np.asarray(np.hstack([force, moment]) * np.array(rig.sensitivity) * (1.0 + errors))


def _surroundings(rig: RotationRig) -> list[tuple[Any, str]]:
    """Gravity and air as the program will take them, by name."""
    gravity = gravity_at(float(np.radians(rig.latitude_deg)), rig.height_m)
    return [(gravity, "gravity"), (air_density_at(rig.height_m, None, rig.temperature_c, None), "air density")]


def _drawn(known: Any, key: str, draws: Draws) -> float:
    """True value of what is only known with an uncertainty."""
    return float(known.value + draws.normal(key, known.u))


def _table(rig: RotationRig, name: str, draws: Draws) -> str:
    """CSV text: a turn forward and back, every output in mV/V with noise, offset and the display's last digit."""
    steps = round(2.0 * np.pi / rig.step_rad)
    forward = np.arange(steps + 1) * rig.step_rad
    angle = np.concatenate([forward, forward[::-1]])
    sense = np.repeat([1.0, -1.0], steps + 1)
    outputs = true_outputs(rig, name, angle, sense, draws)
    offset = 200.0 * rig.resolution * draws.stream(f"{name}.offset").standard_normal(6)
    noise = np.array(rig.noise) * draws.stream(f"{name}.noise").standard_normal(outputs.shape)
    shown = np.round((outputs + offset + noise) / rig.resolution) * rig.resolution * 1e3
    head = "angle [deg]," + ",".join(f"{component} [mV/V]" for component in LOAD_COMPONENTS)
    rows = [f"{np.degrees(a):g}," + ",".join(f"{v:.6f}" for v in row) for a, row in zip(angle, shown, strict=True)]
    return "\n".join([head, *rows]) + "\n"


def _rig(rig: RotationRig) -> dict[str, Any]:
    """Return rig.toml as nested dictionaries."""
    return {
        "format": 1,
        "name": "six-component sensor on an indexing head, simulated",
        "sensor": {
            "name": "six-component sensor",
            "channels": list(LOAD_COMPONENTS),
            "unit": "V/V",
            "sense": "on_sensor",
            "static_sensitivity": [row.tolist() for row in np.diag(rig.sensitivity)],
            "static_sensitivity_uncertainty": rig.u_sensitivity,
            "internal_mass": 0.0,
        },
        "load": {
            "mass": rig.load_mass_kg,
            "mass_uncertainty": rig.u_load_mass_kg,
            "density": rig.load_density_kgm3,
            "centre_of_mass": list(rig.load_centre_m),
            "centre_of_mass_uncertainty": rig.u_load_centre_m,
            "inertia": [[0.036, 0.0, 0.0], [0.0, 0.036, 0.0], [0.0, 0.0, 0.031]],
        },
        "environment": {"latitude": rig.latitude_deg, "height": rig.height_m, "temperature": rig.temperature_c},
    }


def _recording(rig: RotationRig, name: str) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries."""
    return {
        "format": 1,
        "name": f"rotation {name.replace('-', ' ')}, simulated",
        "rig": "../rig.toml",
        "excitation": {
            "kind": "rotation",
            "file": TABLE_FILE,
            "angle_unit": "deg",
            "angle_uncertainty": rig.u_angle_rad,
            "axis": [0.0, 0.0, 1.0],
            "zero_gravity": [0.0, -1.0, 0.0],
            "with_load": name == LOADED,
        },
    }


def _truth(rig: RotationRig, name: str, seed: int, draws: Draws) -> dict[str, Any]:
    """Return truth.json: masses, centres, gravity and every error drawn."""
    drawn = draws.values
    gravity = _surroundings(rig)[0][0].value + drawn["gravity"][0]
    centre = np.array(rig.load_centre_m) + drawn["load.centre"]
    return {
        "format": 1,
        "preset": "rotation",
        "seed": seed,
        "with_load": name == LOADED,
        "internal_mass_kg": rig.internal_mass_kg,
        "internal_centre_m": list(rig.internal_centre_m),
        "load_mass_kg": rig.load_mass_kg + drawn["load.mass"][0],
        "load_centre_m": centre.tolist(),
        "gravity_mps2": gravity,
        "drawn": dict(drawn),
    }
