"""Turned sensors of `other_physics.py`: campaigns for `rotate`, with their truths.

Gravity pulls at masses on a sensor that a head turns; the sensor has hysteresis by Prandtl's play elements, drifts, and
its readings are printed with few digits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from other_physics_files import Case, FloatArray, Numbers, Readings, number, rows_of, write_toml

CHANNELS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
SENSITIVITY = np.diag([5.1e-4, 5.1e-4, 2.0e-4, 9.1e-3, 9.1e-3, 8.2e-3])
"""mV/V per N and N·m."""


@dataclass(frozen=True)
class TurnedPlan:
    """What is read: digits (mV/V), noise, hysteresis, tilt of the axis, drift, repeats; how well it is calibrated."""

    decimals: int = 6
    noise: float = 2e-6
    hysteresis: float = 0.0
    tilt_rad: float = 0.0
    drift: float = 0.0
    repeats: int = 1
    calibration: float = 5e-4
    poses: int = 0


def turned(axis: FloatArray, angle: float) -> FloatArray:
    """Return the rotation matrix about an axis (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def with_play(course: FloatArray, share: float) -> FloatArray:
    """Return a course (N,) behind play elements whose loops are `share` of its largest value wide."""
    largest = float(np.max(np.abs(course))) or 1.0
    out = course.copy()
    for radius in (0.25, 0.5):
        weight, held = 0.25 * share / radius, float(course[0])
        for index, value in enumerate(course):
            held = min(max(held, value - radius * largest), value + radius * largest)
            out[index] += weight * (held - value)
    return out


def build_rotation(plan: TurnedPlan, folder: Path, rng: np.random.Generator) -> Numbers:
    """Write readings without and with load, and return both masses and their centres."""
    internal = 0.769 * rng.uniform(0.95, 1.05)
    inside = np.array([0.2e-3, -0.3e-3, 12e-3]) + 1e-4 * rng.standard_normal(3)
    load = 6.9605 + 1e-4 * rng.standard_normal()
    centre = np.array([0.3e-3, 0.2e-3, 45e-3]) + 2e-4 * rng.standard_normal(3)
    sensitivity = SENSITIVITY * (1.0 + plan.calibration * rng.standard_normal((6, 6)))
    gravity, air = 9.8125 + 5e-4 * rng.standard_normal(), 1.19 * (1.0 + 0.005 * rng.standard_normal())
    own_density = rng.uniform(2700.0, 7900.0)
    twice = 1e-4 * rng.standard_normal(2)
    sensor = {
        "name": "six-component sensor",
        "channels": list(CHANNELS),
        "unit": "V/V",
        "sense": "on_sensor",
        "static_sensitivity": 1e-3 * SENSITIVITY,
        "static_sensitivity_uncertainty": plan.calibration,
        "internal_mass": 0.0,
    }
    stated_load = {
        "mass": 6.9605,
        "mass_uncertainty": 1e-4,
        "density": 7900.0,
        "centre_of_mass": [0.3e-3, 0.2e-3, 45e-3],
        "centre_of_mass_uncertainty": 2e-4,
        "inertia": np.diag([0.036, 0.036, 0.031]),
    }
    stated_gravity = [0.0, 0.0, -9.8125] if plan.poses else [0.0, -9.8125, 0.0]
    place = {"gravity": stated_gravity, "gravity_uncertainty": 5e-4, "air_density": 1.19, "temperature": 23.0}
    write_toml(folder / "rig.toml", {"name": "head", "sensor": sensor, "load": stated_load, "environment": place})
    bodies = [(internal * (1.0 - air / own_density), inside)]
    for loaded in (False, True):
        if loaded:
            bodies.append((load * (1.0 - air / 7900.0), centre))
        for repeat in range(plan.repeats):
            name = f"{'with' if loaded else 'without'}-load-{repeat + 1}"
            columns, downs = _poses(plan.poses, rng) if plan.poses else _head(twice, plan, rng)
            readings = _printed(plan, _wrenches(bodies, gravity, downs, plan) @ sensitivity.T, rng)
            _write_readings(folder / name, loaded, columns, readings)
    both = {"internal": (internal, inside), "load": (load, centre)}
    truth = {f"{name}_mass[{axis}]": mass for name, (mass, _) in both.items() for axis in ("joint", "Fx", "Fy", "Fz")}
    return truth | {
        f"{name}_centre_of_mass[{axis}]": float(point[index])
        for name, (_, point) in both.items()
        for index, axis in enumerate("xyz")
    }


ANGLES_DEG = np.concatenate([np.arange(0.0, 361.0, 22.5), np.arange(360.0, -1.0, -22.5)])


def _head(twice: FloatArray, plan: TurnedPlan, rng: np.random.Generator) -> tuple[dict[str, FloatArray], FloatArray]:
    """Return the angles that a head shows, and where down is in the sensor's axes (N, 3)."""
    angles = np.radians(ANGLES_DEG)
    angles = angles + twice[0] * np.cos(2.0 * angles) + twice[1] * np.sin(2.0 * angles) + 3e-3 * rng.standard_normal()
    tipped = turned(np.array([1.0, 0.0, 0.0]), plan.tilt_rad + 3e-4 * rng.standard_normal())
    tipped = tipped @ turned(np.array([0.0, 1.0, 0.0]), 3e-4 * rng.standard_normal())
    down = tipped @ np.array([0.0, -1.0, 0.0])
    return {"angle [deg]": ANGLES_DEG}, np.array([turned(np.array([0.0, 0.0, 1.0]), -one) @ down for one in angles])


def _poses(count: int, rng: np.random.Generator) -> tuple[dict[str, FloatArray], FloatArray]:
    """Return quaternions of the sensor in the world, and where down is in the sensor's axes (N, 3)."""
    quaternions = rng.standard_normal((count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    x, y, z, w = quaternions.T
    third_row = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x**2 + y**2)]).T
    return dict(zip(("qx", "qy", "qz", "qw"), quaternions.T, strict=True)), -third_row


def _wrenches(
    bodies: list[tuple[float, FloatArray]], gravity: float, downs: FloatArray, plan: TurnedPlan
) -> FloatArray:
    """Return forces and moments on the sensor at every reading (N, 6), behind its hysteresis."""
    found = np.zeros((len(downs), 6))
    for weight, point in bodies:
        force = weight * gravity * downs
        found += np.hstack([force, np.cross(point, force)])
    return np.asarray([with_play(course, plan.hysteresis) for course in found.T]).T if plan.hysteresis else found


def _printed(plan: TurnedPlan, outputs: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return readings with offset, drift and noise, as the table prints them."""
    size = np.diag(SENSITIVITY) * np.array([1.0, 1.0, 1.0, 0.05, 0.05, 0.05])
    course = np.linspace(0.0, 1.0, len(outputs))[:, None]
    slow = course * rng.uniform(-1.0, 1.0, 6) + np.cumsum(0.15 * rng.standard_normal(outputs.shape), axis=0)
    values = outputs + 0.1 * size * rng.standard_normal(6) + plan.drift * size * slow
    return np.asarray(np.round(values + plan.noise * rng.standard_normal(outputs.shape), plan.decimals))


def _write_readings(place: Path, loaded: bool, columns: dict[str, FloatArray], readings: FloatArray) -> None:
    excitation: dict[str, Any] = {"kind": "rotation", "file": "readings.csv", "with_load": loaded}
    if "qx" in columns:
        excitation["orientation"] = "sensor_in_world"
    else:
        excitation |= {"angle_unit": "deg", "angle_uncertainty": 1e-4, "axis": [0.0, 0.0, 1.0]}
        excitation["zero_gravity"] = [0.0, -1.0, 0.0]
    write_toml(place / "recording.toml", {"name": place.name, "rig": "../rig.toml", "excitation": excitation})
    head = ",".join([*columns, *(f"{channel} [mV/V]" for channel in CHANNELS)])
    stated = np.column_stack(list(columns.values()))
    rows = [
        ",".join([*(f"{value:.9g}" for value in left), *(f"{value:.6g}" for value in right)])
        for left, right in zip(stated, readings, strict=True)
    ]
    (place / "readings.csv").write_text("\n".join([head, *rows, ""]), encoding="utf-8")


def read_rotation(results: Path) -> Readings:
    """Return masses and centres."""
    wanted = {"internal_mass", "load_mass", "internal_centre_of_mass", "load_centre_of_mass"}
    rows = [row for row in rows_of(results / "rotation.csv") if row["name"] in wanted and row["recording"] == "all"]
    return {f"{row['name']}[{row['component']}]": (number(row["value"]), number(row["U"])) for row in rows}


def _turned(name: str, about: str, plan: TurnedPlan, **more: Any) -> Case:
    return Case(name, about, ("rotate",), lambda folder, rng: build_rotation(plan, folder, rng), read_rotation, **more)


TURNED = TurnedPlan()
CASES: tuple[Case, ...] = (
    _turned("rotation", "one reading series of each state", TURNED, within=True),
    _turned("rotation_repeats", "three of each state", replace(TURNED, repeats=3), within=True),
    _turned("rotation_5_digits", "printed to 1e-5 mV/V", replace(TURNED, decimals=5, noise=1e-6)),
    _turned("rotation_4_digits", "printed to 1e-4 mV/V", replace(TURNED, decimals=4, noise=1e-6)),
    _turned("rotation_hysteresis", "loops of 0.14 %", replace(TURNED, hysteresis=0.0014)),
    _turned(
        "rotation_hysteresis_calibrated",
        "loops of 0.14 %, calibrated to 0.01 %",
        replace(TURNED, hysteresis=0.0014, calibration=1e-4),
    ),
    _turned(
        "rotation_tilted",
        "axis 1° off horizontal, calibrated to 0.005 %",
        replace(TURNED, tilt_rad=np.radians(1.0), calibration=5e-5),
    ),
    _turned("poses_24", "24 orientations as quaternions", replace(TURNED, poses=24), within=True),
    _turned("poses_6", "six orientations", replace(TURNED, poses=6), within=True),
    _turned("poses_drift", "24 orientations, drift of 0.05 N", replace(TURNED, poses=24, drift=0.05)),
    _turned(
        "poses_4_digits", "24 orientations, printed to 1e-4 mV/V", replace(TURNED, poses=24, decimals=4, noise=1e-6)
    ),
    _turned("poses_hysteresis", "24 orientations, loops of 0.14 %", replace(TURNED, poses=24, hysteresis=0.0014)),
    _turned("rotation_drift", "drift of 0.05 N over the series", replace(TURNED, drift=0.05)),
)
