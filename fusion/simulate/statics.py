"""Simulations without time series: a rotation test, images of a target, an elastic element.

`rotation`: a sensor on an indexing head, read over a turn and back, without and with its load. `orientations`: the same
sensor on a robot, in poses of the flange. `targets`: a calibration
session with images from both cameras of a stereo pair, and the true pair. `elastomer`: the drawing of a cross-beam
element, and the sensor made of it, whose dimensions deviate within their tolerances.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic.dataclasses import dataclass

from fusion.base import ProgressCallback
from fusion.recording.toml import to_toml
from fusion.report.atomic_files import write_file, write_files
from fusion.sensor.model_files import MODELS_FILE, ModelEntry, ModelsFile, models_text
from fusion.simulate.preset import CHECKED, Vector, read_preset
from fusion.simulate.world import Draws
from fusion.simulate.write import RIG_FILE, TRUTH_FILE, write_recording
from photogram.calibration.calibration_file import write_calibration
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.board import random_poses, random_rig, render_board
from photogram.synthetic.patterns import Board
from photogram.synthetic.scene import ImageSensor
from photogram.targets.target_view import Target
from shaker.elastomer.frame import MODE_NAMES, block, solve_frame
from shaker.elastomer.geometry import CrossBeams, ElasticMaterial
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.system import ModalModel
from shaker.static_rotation.harmonics import air_density_at, gravity_at
from shakercal._common.arrays import FloatArray

TABLE_FILE = "readings.csv"
BARE, LOADED = "without-load", "with-load"
SIDES = ("left", "right")
GEOMETRY_FILE = "elastomer.toml"
AXES_DOWN = np.array([[0, 0, 0, 1], [1, 0, 0, 0], [1, 0, 0, 1], [-1, 0, 0, 1], [0, 1, 0, 1], [0, -1, 0, 1]], np.float64)
"""Quaternions of poses with every axis of the sensor down and up, of any length."""
FURTHER_POSES, POSE_SEED = 14, 11  # beyond those, in any orientation


@dataclass(frozen=True, config=CHECKED)
class RotationRig:
    """Truth and nominal values: kg, m, rad, outputs in mV/V."""

    internal_mass_kg: float
    internal_centre_m: Vector
    load_mass_kg: float
    load_centre_m: Vector
    load_density_kgm3: float
    u_load_mass_kg: float
    u_load_centre_m: float
    sensitivity: tuple[float, ...]
    u_sensitivity: float
    noise: tuple[float, ...]
    resolution: float
    step_rad: float
    u_angle_rad: float
    zero_rad: float
    u_tilt_rad: float
    hysteresis: float
    latitude_deg: float
    height_m: float
    temperature_c: float


def write_rotation(
    folder: Path, seed: int, rig: RotationRig | None = None, *, posed: bool = False
) -> tuple[Path, Path]:
    """Write `rig.toml` and the recordings without and with load, and return their folders.

    All stated uncertainties are sampled, including gravity and air density. Hysteresis shifts the first harmonic by an
    angle whose sign depends on the sense of rotation. `posed`: by a robot, without hysteresis, instead of on a head.
    """
    rig = rig or read_preset(RotationRig, "rotation")
    draws = Draws(seed, True)
    tables = {
        "format": 1,
        "name": f"six-component sensor on {'a robot' if posed else 'an indexing head'}, simulated",
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
    write_files(folder, {RIG_FILE: to_toml(tables)})
    head = {
        "angle_unit": "deg",
        "angle_uncertainty": rig.u_angle_rad,
        "axis": [0.0, 0.0, 1.0],
        "zero_gravity": [0.0, -1.0, 0.0],
    }
    robot = {"orientation": "sensor_in_world", "orientation_uncertainty": rig.u_angle_rad}
    for name in (BARE, LOADED):
        manifest = {
            "format": 1,
            "name": f"rotation {name.replace('-', ' ')}, simulated",
            "rig": f"../{RIG_FILE}",
            "excitation": {
                "kind": "rotation",
                "file": TABLE_FILE,
                **(robot if posed else head),
                "with_load": name == LOADED,
            },
        }
        table = (_pose_readings if posed else _readings)(rig, name, draws)
        write_recording(folder / name, manifest, _rotation_truth(rig, name, draws), texts={TABLE_FILE: table})
    return folder / BARE, folder / LOADED


def true_outputs(rig: RotationRig, name: str, angle_rad: FloatArray, sense: FloatArray, draws: Draws) -> FloatArray:
    """Return outputs (N, 6) without noise at angles (N,) with senses (N,)."""
    twice = draws.normal("head.twice per turn", rig.u_angle_rad, 2)
    true = angle_rad + rig.zero_rad + twice[0] * np.sin(2.0 * angle_rad) + twice[1] * np.cos(2.0 * angle_rad)
    true = true - rig.hysteresis * sense
    tilt = rotation_from_vector(np.append(draws.normal(f"{name}.tilt", rig.u_tilt_rad, 2), 0.0))
    down = np.stack([-np.sin(true), -np.cos(true), np.zeros_like(true)], axis=1) @ tilt.T
    return _outputs_along(rig, name, down, draws)


def _outputs_along(rig: RotationRig, name: str, down: FloatArray, draws: Draws) -> FloatArray:
    """Return outputs (N, 6) without noise for directions (N, 3) of gravity."""
    gravity, air = (float(stated.value + draws.normal(key, stated.u)) for stated, key in _surroundings(rig))
    shares = {BARE: [(rig.internal_mass_kg, 1.0 / 5000.0, np.array(rig.internal_centre_m))]}
    mass = rig.load_mass_kg + float(draws.normal("load.mass", rig.u_load_mass_kg))
    centre = np.array(rig.load_centre_m) + draws.normal("load.centre", rig.u_load_centre_m, 3)
    shares[LOADED] = [*shares[BARE], (mass, 1.0 / rig.load_density_kgm3, centre)]
    weights = [(m * gravity * (1.0 - air * volume), c) for m, volume, c in shares[name]]
    force = sum(weight for weight, _ in weights) * down
    moment = np.cross(sum((weight * c for weight, c in weights), np.zeros(3)), down)
    errors = draws.normal("sensor.sensitivity", rig.u_sensitivity, 6)
    return np.asarray(np.hstack([force, moment]) * np.array(rig.sensitivity) * (1.0 + errors))


def _surroundings(rig: RotationRig) -> list[tuple[Any, str]]:
    """Return gravity and air as in the program, by name."""
    gravity = gravity_at(float(np.radians(rig.latitude_deg)), rig.height_m)
    return [(gravity, "gravity"), (air_density_at(rig.height_m, None, rig.temperature_c, None), "air density")]


def _readings(rig: RotationRig, name: str, draws: Draws) -> str:
    """Return CSV text: a turn forward and back, every output in mV/V."""
    steps = round(2.0 * np.pi / rig.step_rad)
    forward = np.arange(steps + 1) * rig.step_rad
    angle = np.concatenate([forward, forward[::-1]])
    sense = np.repeat([1.0, -1.0], steps + 1)
    outputs = true_outputs(rig, name, angle, sense, draws)
    return _table("angle [deg]", [f"{np.degrees(a):g}" for a in angle], outputs, rig, name, draws)


def _pose_readings(rig: RotationRig, name: str, draws: Draws) -> str:
    """Return CSV text of poses: every axis down and up, then any; mV/V."""
    rng = np.random.default_rng(POSE_SEED)
    quaternion = np.vstack([AXES_DOWN, rng.standard_normal((FURTHER_POSES, 4))])
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    x, y, z, w = quaternion.T
    down = -np.stack([2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)], axis=1)
    down = down + np.cross(draws.normal(f"{name}.poses", rig.u_angle_rad, down.size).reshape(down.shape), down)
    cells = [",".join(f"{number:.9f}" for number in row) for row in quaternion]
    return _table("qx,qy,qz,qw", cells, _outputs_along(rig, name, down, draws), rig, name, draws)


def _table(head: str, cells: list[str], outputs: FloatArray, rig: RotationRig, name: str, draws: Draws) -> str:
    """Return CSV text of outputs (N, 6) with noise, offset and resolution."""
    offset = 200.0 * rig.resolution * draws.stream(f"{name}.offset").standard_normal(6)
    noise = np.array(rig.noise) * draws.stream(f"{name}.noise").standard_normal(outputs.shape)
    shown = np.round((outputs + offset + noise) / rig.resolution) * rig.resolution * 1e3
    rows = [cell + "," + ",".join(f"{v:.6f}" for v in row) for cell, row in zip(cells, shown, strict=True)]
    return "\n".join([f"{head}," + ",".join(f"{c} [mV/V]" for c in LOAD_COMPONENTS), *rows]) + "\n"


def _rotation_truth(rig: RotationRig, name: str, draws: Draws) -> dict[str, Any]:
    """Return truth.json: masses, centres, gravity and all sampled errors."""
    drawn = draws.values
    return {
        "format": 1,
        "preset": "rotation",
        "seed": draws.seed,
        "with_load": name == LOADED,
        "internal_mass_kg": rig.internal_mass_kg,
        "internal_centre_m": list(rig.internal_centre_m),
        "load_mass_kg": rig.load_mass_kg + drawn["load.mass"][0],
        "load_centre_m": (np.array(rig.load_centre_m) + drawn["load.centre"]).tolist(),
        "gravity_mps2": _surroundings(rig)[0][0].value + drawn["gravity"][0],
        "drawn": dict(drawn),
    }


@dataclass(frozen=True, config=CHECKED)
class SessionPreset:
    """A target, images of `size_px` that show about `field_m` of it, and their image sensor."""

    kind: Literal["charuco"]
    spacing_m: float
    size: tuple[int, int]
    dictionary: str
    size_px: tuple[int, int]
    field_m: float
    views: int
    bit_depth: int
    electrons_per_grey: float
    read_noise_grey: float
    blur_px: float

    @property
    def board(self) -> Board:
        """The target as printed."""
        return Board(Target(self.kind, self.spacing_m, self.size, self.dictionary))


def write_session(folder: Path, seed: int, progress: ProgressCallback) -> None:
    """Write `left/00.png` …, `right/00.png` … and `truth.json` of a random pair."""
    import cv2

    preset, rng = read_preset(SessionPreset, "targets"), np.random.default_rng(seed)
    sensor = ImageSensor(preset.bit_depth, preset.electrons_per_grey, preset.read_noise_grey)
    rig = random_rig(rng, np.array(preset.size_px), preset.field_m)
    poses = random_poses(rng, rig, preset.board, preset.views)
    relatives = (RigidTransform.identity(), rig.right_from_left)
    for side, camera, relative in zip(SIDES, (rig.left, rig.right), relatives, strict=True):
        (folder / side).mkdir()
        for number, pose in enumerate(poses):
            seen = render_board(camera, relative @ pose, preset.board, preset.blur_px, slant=0.1)
            image = sensor.digitise(seen, rng)
            _, text = cv2.imencode(".png", image.astype(np.uint8))
            write_file(folder / side / f"{number:02d}.png", text.tobytes())
            progress("render", SIDES.index(side) * preset.views + number + 1, 2 * preset.views)
    write_calibration(folder / TRUTH_FILE, rig)


@dataclass(frozen=True, config=CHECKED)
class ElementPreset:
    """An element as in `elastomer.toml` (`drawing`), and properties of its sensor.

    `tolerance_m`: standard deviations of machined dimensions. `damping_ratio` with its standard uncertainty.
    `u_frequency`: relative. `noise` in V/V.
    """

    drawing: dict[str, Any]
    tolerance_m: dict[str, float]
    damping_ratio: float
    u_damping_ratio: float
    u_frequency: float
    sample_rate_hz: float
    noise: float


def write_element(folder: Path, seed: int) -> Path:
    """Write `elastomer.toml`, the measured `models.json` and `truth.json`, and return the first."""
    preset, draws = read_preset(ElementPreset, "elastomer"), Draws(seed, True)
    drawing = preset.drawing
    blocks = ("material", "beams", "compliant_beams", "platform")
    material, beams, compliant, platform = (drawing[key] for key in blocks)
    size: dict[str, float] = {
        "span_m": beams["span"],
        "beam_width_m": beams["width"],
        "beam_height_m": beams["height"],
        "compliant_thickness_m": compliant["thickness"],
        "compliant_length_m": compliant["length"],
        "compliant_height_m": beams["height"],
    }
    milled = {name: float(size[name] + draws.normal(f"element.{name}", u)) for name, u in preset.tolerance_m.items()}
    stuff = ElasticMaterial(material["youngs_modulus"], material["poisson_ratio"], material["density"])
    made = CrossBeams(stuff, **(size | milled))
    solid = block(made.material.density_kgm3, platform["half_size"], platform["thickness"])
    frequency = solve_frame(made, platform["half_size"], solid).modes.frequency_hz
    named = dict(zip(MODE_NAMES, frequency.tolist(), strict=True))
    truth = {"seed": seed, "dimensions_m": milled, "frequency_hz": named}
    entries = tuple(_entry(preset, *pair, draws) for pair in zip(LOAD_COMPONENTS, frequency.tolist(), strict=True))
    models = ModelsFile("cross-beam element, simulated", "six-axis wrist sensor", "simulated", entries)
    texts = {GEOMETRY_FILE: to_toml(drawing), MODELS_FILE: models_text(models), TRUTH_FILE: json.dumps(truth)}
    write_files(folder, texts)
    return folder / GEOMETRY_FILE


def _entry(preset: ElementPreset, component: str, frequency_hz: float, draws: Draws) -> ModelEntry:
    """Return the model of one channel with an error of its frequency."""
    zeta = preset.damping_ratio
    measured = frequency_hz * (1.0 + float(draws.normal(f"{component}.frequency", preset.u_frequency)))
    omega, gain = 2.0 * np.pi * measured, 1e-6
    residue = gain * omega / (2j * np.sqrt(1.0 - zeta**2))
    u = [preset.u_frequency * frequency_hz, preset.u_damping_ratio, 1e-4 * abs(residue), 1e-4 * abs(residue)]
    mode, none = (np.array([measured]), np.array([zeta]), np.array([residue])), np.zeros(0)
    model = ModalModel(*mode, none, none, covariance=np.diag(np.array(u) ** 2))
    recorder = preset.sample_rate_hz, preset.noise
    return ModelEntry(component, component, "V/V", "pencil", model, *recorder, f"{component}-1")
