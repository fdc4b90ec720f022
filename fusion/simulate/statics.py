"""Simulated rotation tests, target pictures and elastic elements."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import ProgressCallback
from fusion.sensor.models_file import MODELS_FILE, ModelEntry, ModelsFile, models_text
from fusion.simulate.channels import to_toml
from fusion.simulate.world import Draws
from photogram.calibration.file import write_calibration
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.board import Board, random_poses, random_rig, render_board
from photogram.synthetic.scene import ImageSensor
from photogram.targets.view import Target
from shaker.arrays import FloatArray
from shaker.elastomer.element import solve_frame
from shaker.elastomer.frame import NAMES, block
from shaker.elastomer.geometry import CrossBeams, Material
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.modal import ModalModel
from shaker.static_rotation.harmonics import air_density_at, gravity_at

# A simulated rotation test: a sensor on an indexing head, read over a turn and back, without and with its load.


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


# A simulated calibration session: pictures of a target from both cameras of a stereo pair, and the true pair.


TARGETS_TRUTH_FILE = "truth.json"
SIDES = ("left", "right")
BOARD = Board(Target("charuco", 9e-3, (11, 8), "DICT_4X4_100"))
_SIZE_PX = np.array([800, 640])
_FIELD_M = 0.15
_VIEWS = 10
_SENSOR = ImageSensor(bit_depth=8, electrons_per_grey=40.0, read_noise_grey=0.6)
_BLUR_PX = 0.8


def write_session(folder: Path, seed: int, progress: ProgressCallback) -> None:
    """Write `left/00.png` …, `right/00.png` … and the true calibration `truth.json` of a random pair into a folder."""
    import cv2

    rng = np.random.default_rng(seed)
    rig = random_rig(rng, _SIZE_PX, _FIELD_M)
    poses = random_poses(rng, rig, BOARD, _VIEWS)
    relatives = (RigidTransform.identity(), rig.right_from_left)
    for side, camera, relative in zip(SIDES, (rig.left, rig.right), relatives, strict=True):
        (folder / side).mkdir()
        for number, pose in enumerate(poses):
            picture = _SENSOR.digitise(render_board(camera, relative @ pose, BOARD, _BLUR_PX, slant=0.1), rng)
            _, text = cv2.imencode(".png", picture.astype(np.uint8))
            (folder / side / picture_name(number)).write_bytes(text.tobytes())
            progress("render", SIDES.index(side) * _VIEWS + number + 1, 2 * _VIEWS)
    write_calibration(folder / TARGETS_TRUTH_FILE, rig)


def picture_name(number: int) -> str:
    """Return the name of a picture within its camera's folder."""
    return f"{number:02d}.png"


def written_files(folder: Path) -> set[Path]:
    """Return the files that a simulated session in this folder consists of, none where there is no such session."""
    truth = folder / TARGETS_TRUTH_FILE
    if not truth.is_file() or "left" not in json.loads(truth.read_text(encoding="utf-8")):
        return set()
    pictures = {folder / side / picture_name(number) for side in SIDES for number in range(_VIEWS)}
    return {path.resolve() for path in (truth, *pictures)}


# A cross-beam element as it is drawn, and the sensor made of it, whose dimensions are off by their tolerances.


GEOMETRY_FILE, ELASTOMER_TRUTH_FILE = "elastomer.toml", "truth.json"
WRITTEN = (GEOMETRY_FILE, MODELS_FILE, ELASTOMER_TRUTH_FILE)
HALF_SIZE_M, THICKNESS_M = 0.0179, 0.0059
"""The platform, which the publication leaves out: the solid block that comes nearest to its frequencies."""
DRAWN = CrossBeams(
    material=Material(72e9, 0.3, 2820.0),
    span_m=0.064,
    beam_width_m=0.0038,
    beam_height_m=0.0038,
    compliant_thickness_m=0.001,
    compliant_length_m=0.032,
    compliant_height_m=0.0038,
)
"""Table 1 of J. Sensors 2018, 6216979."""
TOLERANCE_M = {"beam_width_m": 1e-5, "beam_height_m": 1e-5, "compliant_thickness_m": 1e-5, "span_m": 3e-5}
"""Standard deviations of what was milled."""
PUBLISHED = {
    "published formulas": (1642.0, 1642.0, 1973.0, 3376.0, 3376.0, 4892.0),
    "published finite elements": (1660.0, 1661.0, 2025.0, 3577.0, 3578.0, 5094.0),
}
FIT_HALF_SIZES_M = [0.005, 0.008, 0.010, 0.012, 0.014, 0.016, 0.018, 0.020]
DAMPING_RATIO, U_DAMPING_RATIO, U_FREQUENCY = 0.015, 1e-4, 1e-4
SAMPLE_RATE_HZ, NOISE = 1e5, 1e-9


def write_element(folder: Path, seed: int) -> Path:
    """Write `elastomer.toml`, the measured `models.json` and `truth.json` into an empty folder and return the first."""
    draws = Draws(seed, True)
    milled: dict[str, Any] = {name: _made(draws, name, spread) for name, spread in TOLERANCE_M.items()}
    made = replace(DRAWN, **milled)
    platform = block(made.material.density_kgm3, HALF_SIZE_M, THICKNESS_M)
    frequency = solve_frame(made, HALF_SIZE_M, platform).modes.frequency_hz
    truth = {
        "seed": seed,
        "dimensions_m": {name: getattr(made, name) for name in TOLERANCE_M},
        "frequency_hz": dict(zip(NAMES, frequency.tolist(), strict=True)),
    }
    entries = tuple(
        _entry(component, float(value), draws) for component, value in zip(LOAD_COMPONENTS, frequency, strict=True)
    )
    models = ModelsFile("cross-beam element, simulated", "six-axis wrist sensor", "simulated", entries)
    texts = {
        GEOMETRY_FILE: to_toml(_tables()),
        MODELS_FILE: models_text(models),
        ELASTOMER_TRUTH_FILE: json.dumps(truth),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    return folder / GEOMETRY_FILE


def _made(draws: Draws, name: str, spread: float) -> float:
    """A dimension as it was milled."""
    return float(getattr(DRAWN, name) + draws.normal(f"element.{name}", spread))


def _entry(component: str, frequency_hz: float, draws: Draws) -> ModelEntry:
    """The model of one channel as a step response would tell it, with a frequency that is off by its uncertainty."""
    measured = frequency_hz * (1.0 + float(draws.normal(f"{component}.frequency", U_FREQUENCY)))
    omega, gain = 2.0 * np.pi * measured, 1e-6
    residue = gain * omega / (2j * np.sqrt(1.0 - DAMPING_RATIO**2))
    u = np.array([U_FREQUENCY * frequency_hz, U_DAMPING_RATIO, 1e-4 * abs(residue), 1e-4 * abs(residue)])
    model = ModalModel(
        frequency_hz=np.array([measured]),
        damping_ratio=np.array([DAMPING_RATIO]),
        residue=np.array([residue]),
        real_hz=np.zeros(0),
        real_residue=np.zeros(0),
        covariance=np.diag(u**2),
    )
    return ModelEntry(component, component, "V/V", "pencil", model, SAMPLE_RATE_HZ, NOISE, f"{component}-1")


def _tables() -> dict[str, Any]:
    """Return elastomer.toml as nested dictionaries."""
    return {
        "format": 1,
        "name": "cross-beam element of a wrist sensor",
        "measured": MODELS_FILE,
        "material": {"youngs_modulus": 72e9, "poisson_ratio": 0.3, "density": 2820.0},
        "beams": {"span": DRAWN.span_m, "width": DRAWN.beam_width_m, "height": DRAWN.beam_height_m},
        "compliant_beams": {"thickness": DRAWN.compliant_thickness_m, "length": DRAWN.compliant_length_m},
        "platform": {"half_size": HALF_SIZE_M, "thickness": THICKNESS_M},
        "fit": {
            "half_sizes": FIT_HALF_SIZES_M,
            "frequencies": dict(zip(NAMES, PUBLISHED["published finite elements"], strict=True)),
        },
        "mounting": {
            "direction": "Tx",
            "hand_mass": 0.1,
            "hand_stiffness": 5e7,
            "sensor_damping": 8.0,
            "pedestal_mass": 0.3,
            "pedestal_stiffness": 2e8,
        },
        "stated": [{"name": name, **dict(zip(NAMES, values, strict=True))} for name, values in PUBLISHED.items()],
    }
