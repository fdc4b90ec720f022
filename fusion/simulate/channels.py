"""Simulated channels, and manifests as text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.preset import ChannelSpec, DaqSpec, PartSpec, Preset, StereoSetup, left_camera
from fusion.simulate.world import Draws, TrueStereo, World, acceleration_at, harmonic, velocity_at
from photogram.geometry import RigidTransform
from shaker.arrays import ComplexArray, FloatArray
from shaker.labels import LOAD_COMPONENTS

# Write nested dictionaries as TOML text.


def to_toml(table: Mapping[str, Any], path: str = "") -> str:
    """Return TOML text: plain keys first, then sub-tables, then arrays of tables (lists of dictionaries)."""
    lines = [f"{key} = {_value(value)}" for key, value in table.items() if not _is_table(value)]
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            header = "" if all(isinstance(v, Mapping) for v in value.values()) else f"\n[{name}]\n"
            lines.append(header + to_toml(value, name).rstrip("\n"))
        elif _is_table(value):
            lines += [f"\n[[{name}]]\n" + to_toml(item, name).rstrip("\n") for item in value]
    return "\n".join(lines) + "\n"


def _is_table(value: Any) -> bool:
    """Say whether a value needs a header of its own."""
    return isinstance(value, Mapping) or (isinstance(value, list) and bool(value) and isinstance(value[0], Mapping))


def _value(value: Any) -> str:
    """Return a plain value in TOML's syntax."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return repr(value)


# DAQ records: what each channel's file holds, on its recorder's own clock.


_PULSE_S = 2e-3
_HIGH_V = 5.0
RESPONSE_HZ = np.array([0.0, 20.0, 50.0, *np.arange(100.0, 3001.0, 100.0)])
_RESPONSE_U = (1e-4, 1e-4)  # relative magnitude, phase in rad


@dataclass(frozen=True, eq=False)
class Record:
    """A recorder's file: its nominal rate and one array of samples per channel."""

    sample_rate_hz: float
    samples: dict[str, NDArray[np.float32]]
    units: dict[str, str]


def clock(daq: DaqSpec, draws: Draws) -> tuple[float, float]:
    """Return a recorder's true start (s) and the true seconds that pass in one second of its clock."""
    return daq.start_s, 1 + float(draws.normal(f"{daq.name}.clock", daq.clock_uncertainty))


def record(world: World, daq: DaqSpec, draws: Draws, noise: bool) -> Record:
    """Return what one recorder stores, rounded to its converter's steps."""
    start, rate = clock(daq, draws)
    count = np.arange(round(daq.duration_s * daq.sample_rate_hz), dtype=np.float64)
    time: FloatArray = start + rate * count / daq.sample_rate_hz
    samples, units = {}, {}
    for spec in daq.channels:
        if spec.quantity == "trigger":
            values = _trigger(world, time)
        else:
            phasors = recorded_phasors(world, daq, spec, draws)
            values = harmonic(time, world.preset.frequencies_hz, phasors[:, None])[:, 0]
        if noise:
            values = values + spec.noise * draws.stream(f"{daq.name}.{spec.name}.noise").standard_normal(len(time))
        samples[spec.name] = (np.rint(values / spec.lsb) * spec.lsb).astype(np.float32)
        units[spec.name] = spec.unit
    return Record(daq.sample_rate_hz, samples, units)


def _trigger(world: World, time_s: FloatArray) -> FloatArray:
    """Return rectangular pulses of 2 ms that rise at the trigger instants."""
    last = np.searchsorted(world.trigger_s, time_s, side="right") - 1
    since = time_s - world.trigger_s[np.maximum(last, 0)]
    return np.where((last >= 0) & (since < _PULSE_S), _HIGH_V, 0.0)


def recorded_phasors(world: World, daq: DaqSpec, spec: ChannelSpec, draws: Draws) -> ComplexArray:
    """Return the phasors (K,) in the file: true value · response · exp(−jω·delay) / true scale."""
    shared = spec.common or spec.name
    scale = float(draws.normal(f"{shared}.scale", spec.stated.get("scale_uncertainty", 0.0)))
    own = float(draws.normal(f"{spec.name}.individual", spec.stated.get("individual_uncertainty", 0.0)))
    delay = float(draws.normal(f"{shared}.delay", spec.stated.get("delay_uncertainty", 0.0)))
    value = _true_phasors(world, spec, draws) * np.exp(-2j * np.pi * world.preset.frequencies_hz * delay)
    if daq.response:
        value = value * true_response(shared, world.preset.frequencies_hz, draws)
    return np.asarray(value / (spec.scale * (1 + scale) * (1 + own)))


def _true_phasors(world: World, spec: ChannelSpec, draws: Draws) -> ComplexArray:
    """Return the phasors (K,) of the quantity in SI, at the point and along the axis where the channel really sits."""
    if spec.quantity == "output":
        return np.asarray(world.outputs[:, LOAD_COMPONENTS.index(spec.name)])
    motion = world.motion[spec.body]
    point = np.array(spec.point) + draws.normal(f"{spec.name}.point", spec.stated.get("point_uncertainty", 0.0), 3)
    nominal = np.array(spec.direction)
    tilt = draws.normal(f"{spec.name}.direction", spec.stated.get("direction_uncertainty", 0.0), 3)
    direction = nominal + np.cross(tilt, nominal)
    direction = direction / np.linalg.norm(direction)
    if spec.quantity == "velocity":
        return velocity_at(motion, point, direction)
    transverse = draws.normal(f"{spec.name}.transverse", spec.stated.get("transverse_sensitivity", 0.0) / np.sqrt(2), 3)
    axis = direction + transverse - nominal * (transverse @ nominal)
    return acceleration_at(motion, point, axis, world.gravity)


def nominal_response(frequency_hz: FloatArray) -> ComplexArray:
    """Return the stated response of the bridge amplifier, a second-order low-pass at 9 kHz with damping 0.7."""
    ratio = np.asarray(frequency_hz) / 9000.0
    return np.asarray(1 / (1 - ratio**2 + 1.4j * ratio))


def true_response(name: str, frequency_hz: FloatArray, draws: Draws) -> ComplexArray:
    """Return the response with one magnitude and one phase error for all frequencies."""
    magnitude, phase = (float(draws.normal(f"{name}.response.{k}", u)) for k, u in zip("mp", _RESPONSE_U, strict=True))
    table = nominal_response(RESPONSE_HZ)
    size = np.interp(frequency_hz, RESPONSE_HZ, np.abs(table))
    angle = np.interp(frequency_hz, RESPONSE_HZ, np.unwrap(np.angle(table)))
    return np.asarray(size * (1 + magnitude) * np.exp(1j * (angle + phase)))


def response_table() -> str:
    """Return the stated response as text: frequency_hz, magnitude, phase_rad and their uncertainties."""
    value = nominal_response(RESPONSE_HZ)
    lines = ["frequency_hz,magnitude,phase_rad,u_magnitude,u_phase_rad"]
    for frequency, entry in zip(RESPONSE_HZ, value, strict=True):
        u_magnitude = abs(entry) * _RESPONSE_U[0]
        lines.append(f"{frequency!r},{abs(entry):.9f},{np.angle(entry):.9f},{u_magnitude:.3e},{_RESPONSE_U[1]!r}")
    return "\n".join(lines).replace("np.float64(", "").replace(")", "") + "\n"


# The manifests and the truth file of a simulated campaign.


def rig_tables(world: World) -> dict[str, Any]:
    """Return rig.toml as nested dictionaries."""
    preset = world.preset
    tables: dict[str, Any] = {
        "format": 1,
        "name": preset.rig_name,
        "sensor": sensor_keys(preset, world.static_stated),
        "load": part_keys(preset.load),
    }
    if preset.parts:
        tables["part"] = [part_table(part) for part in preset.parts]
    tables["environment"] = {"gravity": preset.gravity_mps2.tolist(), "temperature": 23.0, "air_density": 1.19}
    pairs = {stereo.setup.name: _stereo(stereo, preset) for stereo in world.stereo}
    tables["stereo"] = pairs | {setup.name: _points_pair(setup, preset) for setup in preset.points}
    return tables


def sensor_keys(preset: Preset, static: NDArray[np.float64]) -> dict[str, Any]:
    """Return the block of the sensor under test, with its static sensitivity (6, 6) as it is stated."""
    internal = {f"internal_{key}": value for key, value in part_keys(preset.internal).items()}
    return {
        "name": preset.sensor_name,
        "serial": preset.serial,
        "channels": list(LOAD_COMPONENTS),
        "unit": "V/V",
        "sense": preset.sense,
        "capacity": list(preset.capacity),
        "static_sensitivity": [[float(f"{v:.6e}") for v in row] for row in static],
        **internal,
    }


def part_table(spec: PartSpec) -> dict[str, Any]:
    """Return the block of a further part of the load."""
    return {"name": spec.name, "body": "load", **part_keys(spec)}


def part_keys(spec: PartSpec) -> dict[str, Any]:
    """Return the keys of a rigid part."""
    return {
        "mass": spec.mass,
        "mass_uncertainty": spec.mass_uncertainty,
        "centre_of_mass": list(spec.centre_of_mass),
        "centre_of_mass_uncertainty": spec.centre_of_mass_uncertainty,
        "inertia": np.diag(spec.inertia).tolist(),
        "inertia_uncertainty": spec.inertia_uncertainty,
    }


def _stereo(stereo: TrueStereo, preset: Preset) -> dict[str, Any]:
    """Return the block of one stereo pair."""
    setup = stereo.setup
    file, placed = f"calibration/{setup.name}.json", _placed(setup, stereo.sensor_from_left)
    return {"body": setup.body, "calibration": file, **placed, "bit_depth": setup.bit_depth, **_exposed(setup, preset)}


def _points_pair(setup: StereoSetup, preset: Preset) -> dict[str, Any]:
    """Return the block of a stereo pair whose points another program computed."""
    return {"body": setup.body, **_placed(setup, left_camera(setup)), **_exposed(setup, preset)}


def _placed(setup: StereoSetup, sensor_from_left: RigidTransform) -> dict[str, Any]:
    """Return the keys of where a stereo pair stands and what that is worth."""
    return {
        "rotation": sensor_from_left.rotation.tolist(),
        "translation": sensor_from_left.translation_m.tolist(),
        "pose_uncertainty": list(setup.pose_uncertainty),
        "scale_uncertainty": setup.scale_uncertainty,
    }


def _exposed(setup: StereoSetup, preset: Preset) -> dict[str, Any]:
    """Return the keys of when a stereo pair exposes."""
    return {"exposure": preset.exposure_s, "delay": 0.0, "delay_uncertainty": setup.delay_uncertainty}


def recording_tables(preset: Preset) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries."""
    return {
        "format": 1,
        "name": f"Fz {round(preset.fundamental_hz, 2)} Hz, simulated",
        "rig": "../rig.toml",
        "excitation": {
            "kind": "sine",
            "direction": [0.0, 0.0, 1.0],
            "frequencies": [round(preset.fundamental_hz, 2)],
            "harmonics": "auto",
        },
        "daq": [daq_table(daq) for daq in preset.daqs],
        "images": [
            {
                "stereo": setup.name,
                "left": f"{setup.name}-left/*.tif",
                "right": f"{setup.name}-right/*.tif",
                "trigger": "camera_trigger",
            }
            for setup in preset.stereo
        ],
    }


def daq_table(daq: DaqSpec) -> dict[str, Any]:
    """Return the block of one recorder."""
    channels = [_channel(spec, daq.response) for spec in daq.channels]
    return {"name": daq.name, "file": daq.file, "clock_uncertainty": daq.clock_uncertainty, "channel": channels}


def _channel(spec: ChannelSpec, response: str) -> dict[str, Any]:
    """Return the block of one channel."""
    if spec.quantity == "trigger":
        return {"name": spec.name, "quantity": "trigger", "threshold": 2.5, "edge": "rising"}
    keys: dict[str, Any] = {"name": spec.name, "quantity": spec.quantity}
    if spec.quantity == "output":
        keys["channel"] = spec.name
        if response:
            keys["response"] = response
    else:
        keys |= {"body": spec.body, "point": list(spec.point), "direction": list(spec.direction)}
    keys["scale"] = spec.scale
    if spec.common:
        keys["common"] = spec.common
    return keys | spec.stated


def truth_tables(world: World, draws: Draws, seed: int) -> dict[str, Any]:
    """Return truth.json: phasors, sensitivity, motion of every frame, clocks, and every error drawn."""
    preset = world.preset
    driven = world.load_wrench[:, 2]
    ratio = world.outputs / driven[:, None]
    middle = world.trigger_s + preset.exposure_s / 2
    motion = {stereo.setup.name: true_motion(world, stereo).tolist() for stereo in world.stereo}
    return {
        "format": 1,
        "preset": preset.name,
        "seed": seed,
        "frequencies": preset.frequencies_hz.tolist(),
        "acceleration": {body: complex_table(motion_.acceleration) for body, motion_ in world.motion.items()},
        "load": complex_table(world.load_wrench),
        "outputs": complex_table(world.outputs),
        "sensitivity": complex_table(world.sensitivity),
        "ratio": complex_table(ratio),
        "motion": motion,
        "exposure_middle_s": (middle / clock(preset.daqs[0], draws)[1]).tolist(),
        "clock": clock_tie(preset, draws),
        "drawn": draws.values,
    }


def true_motion(world: World, stereo: TrueStereo) -> NDArray[np.float64]:
    """Return the motions T_k·T_0⁻¹ (F, 6) of the body seen, at the true middles of the exposures."""
    middle = world.trigger_s + stereo.delay_s + world.preset.exposure_s / 2
    poses = [RigidTransform.from_pose(pose) for pose in world.motion[stereo.setup.body].pose(middle)]
    start = poses[0].inverse()
    return np.stack([(pose @ start).pose for pose in poses])


def clock_tie(preset: Preset, draws: Draws) -> dict[str, float]:
    """Return t_first = offset_s + rate · t_second of the two recorders' clocks, nothing where there is only one."""
    if len(preset.daqs) == 1:
        return {}
    (start, rate), (other_start, other_rate) = (clock(daq, draws) for daq in preset.daqs)
    return {"offset_s": (other_start - start) / rate, "rate": other_rate / rate}


def complex_table(value: NDArray[np.complex128]) -> dict[str, Any]:
    """Return real and imaginary part as nested lists."""
    return {"re": value.real.tolist(), "im": value.imag.tolist()}
