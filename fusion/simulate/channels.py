"""Recordings of sines: what each recorder's file holds, on its own clock, and what manifests and truth say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.preset import ChannelSpec, DaqSpec, PartSpec, Preset, StereoSetup, camera_pose
from fusion.simulate.world import Draws, TrueStereo, World, acceleration_at, harmonic, velocity_at
from fusion.simulate.write import COLUMNS, POINTS_SCALE, RIG_FILE, Record, complex_table
from photogram.geometry import RigidTransform
from shaker.arrays import ComplexArray, FloatArray
from shaker.labels import LOAD_COMPONENTS

RESPONSE_HZ = np.array([0.0, 20.0, 50.0, *np.arange(100.0, 3001.0, 100.0)])
_RESPONSE_U = (1e-4, 1e-4)  # relative magnitude, phase in rad
_PULSE_S = 2e-3
_HIGH_V = 5.0


@dataclass(frozen=True)
class Run:
    """One recording: its `preset` (with the whole load), and what the first lines of its manifest say.

    `rig_file`: the rig that it stands on; `mounting`: empty where it is not stated. `direction`: 3 or 6 numbers;
    `driven`: the place of the component that is driven. `parts`: those of the load that this recording's own manifest
    states.
    """

    name: str
    preset: Preset
    nominal_hz: tuple[float, ...]
    rig_file: str = RIG_FILE
    mounting: str = ""
    kind: str = "sine"
    direction: tuple[float, ...] = (0.0, 0.0, 1.0)
    driven: int = 2
    parts: tuple[PartSpec, ...] = ()


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
            last = np.searchsorted(world.trigger_s, time, side="right") - 1
            since = time - world.trigger_s[np.maximum(last, 0)]
            values = np.where((last >= 0) & (since < _PULSE_S), _HIGH_V, 0.0)
        else:
            phasors = recorded_phasors(world, daq, spec, draws)
            values = harmonic(time, world.preset.frequencies_hz, phasors[:, None])[:, 0]
        if noise:
            values = values + spec.noise * draws.stream(f"{daq.name}.{spec.name}.noise").standard_normal(len(time))
        step = spec.range / 2**spec.bits
        samples[spec.name] = (np.rint(values / step) * step).astype(np.float32)
        units[spec.name] = spec.unit
    return Record(daq.sample_rate_hz, samples, units, gzip=6)


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
    # Written anew, not by `fusion.instruments`: what the program makes of these recordings is tested against them.
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


def rig_tables(world: World, own: tuple[PartSpec, ...] = ()) -> dict[str, Any]:
    """Return rig.toml as nested dictionaries, without the parts that a recording's `own` manifest states."""
    preset = world.preset
    tables: dict[str, Any] = {
        "format": 1,
        "name": preset.rig_name,
        "sensor": sensor_keys(preset, world.static_stated),
        "load": part_keys(preset.load),
    }
    parts = [_part_table(part) for part in preset.parts if part not in own]
    if parts:
        tables["part"] = parts
    tables["environment"] = environment_keys(preset)
    return tables | {"stereo": {setup.name: _stereo_keys(setup, preset) for setup in preset.stereo}}


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


def environment_keys(preset: Preset) -> dict[str, Any]:
    """Return the block of what surrounds a rig."""
    return {"gravity": preset.gravity_mps2.tolist(), "temperature": 23.0, "air_density": 1.19}


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


def _part_table(spec: PartSpec) -> dict[str, Any]:
    """Return the block of a further part of the load."""
    return {"name": spec.name, "body": "load", **part_keys(spec)}


def _stereo_keys(setup: StereoSetup, preset: Preset) -> dict[str, Any]:
    """Return the block of a stereo pair, or of one whose points another program computed."""
    placed, images = camera_pose(setup), not preset.as_points
    return {
        "body": setup.body,
        **({"calibration": calibration_file(setup)} if images else {}),
        "rotation": placed.rotation.tolist(),
        "translation": placed.translation_m.tolist(),
        "pose_uncertainty": list(setup.pose_uncertainty),
        "scale_uncertainty": setup.scale_uncertainty,
        **({"bit_depth": setup.bit_depth} if images else {}),
        "exposure": preset.exposure_s,
        "delay": 0.0,
        "delay_uncertainty": setup.delay_uncertainty,
    }


def calibration_file(setup: StereoSetup) -> str:
    """Return the place of a pair's calibration in its campaign."""
    return f"calibration/{setup.name}.json"


def points_file(setup: StereoSetup) -> str:
    """Return the name of the table of a stereo pair's points."""
    return f"points-{setup.name}.csv"


def recording_tables(run: Run) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries."""
    preset = run.preset
    tables: dict[str, Any] = {"format": 1, "name": run.name, "rig": f"../{run.rig_file}"}
    if run.mounting:
        tables["mounting"] = run.mounting
    tables["excitation"] = {
        "kind": run.kind,
        "direction": list(run.direction),
        "frequencies": list(run.nominal_hz),
        "harmonics": "auto" if run.kind == "sine" else [],
    }
    if run.parts:
        tables["part"] = [_part_table(part) for part in run.parts]
    tables["daq"] = [
        {
            "name": daq.name,
            "file": daq.file,
            "clock_uncertainty": daq.clock_uncertainty,
            "channel": [_channel(spec, daq.response) for spec in daq.channels],
        }
        for daq in preset.daqs
    ]
    if preset.as_points:
        columns = {"columns": list(COLUMNS), "scale": POINTS_SCALE}
        tables["points"] = [{"stereo": setup.name, "files": points_file(setup), **columns} for setup in preset.stereo]
    elif preset.stereo:
        tables["images"] = [
            {"stereo": setup.name, **{side: f"{setup.name}-{side}/*.tif" for side in ("left", "right")}}
            for setup in preset.stereo
        ]
    for block in (*tables.get("points", ()), *tables.get("images", ())):
        block["trigger"] = "camera_trigger"
    return tables


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


def truth_tables(run: Run, world: World, draws: Draws) -> dict[str, Any]:
    """Return truth.json: phasors, sensitivity, ratio of the driven component, clocks, and every error drawn.

    Where there are images also the motion of every frame and the middles of the exposures on the first clock.
    """
    preset = world.preset
    images: dict[str, Any] = {}
    if world.stereo:
        middle = world.trigger_s + preset.exposure_s / 2
        images["motion"] = {stereo.setup.name: _true_motion(world, stereo).tolist() for stereo in world.stereo}
        images["exposure_middle_s"] = (middle / clock(preset.daqs[0], draws)[1]).tolist()
    tie = {}  # t_first = offset_s + rate · t_second of the two recorders' clocks
    if len(preset.daqs) > 1:
        (start, rate), (other_start, other_rate) = (clock(daq, draws) for daq in preset.daqs)
        tie = {"offset_s": (other_start - start) / rate, "rate": other_rate / rate}
    return {
        "format": 1,
        "preset": preset.name,
        "seed": draws.seed,
        **({"mounting": run.mounting} if run.mounting else {}),
        "frequencies": preset.frequencies_hz.tolist(),
        "acceleration": {body: complex_table(motion.acceleration) for body, motion in world.motion.items()},
        "load": complex_table(world.load_wrench),
        "outputs": complex_table(world.outputs),
        "sensitivity": complex_table(world.sensitivity),
        **({} if images else {"driven": run.driven}),
        "ratio": complex_table(world.outputs / world.load_wrench[:, run.driven, None]),
        **images,
        "clock": tie,
        "drawn": draws.values,
    }


def _true_motion(world: World, stereo: TrueStereo) -> NDArray[np.float64]:
    """Return the motions T_k·T_0⁻¹ (F, 6) of the body seen, at the true middles of the exposures."""
    middle = world.trigger_s + stereo.delay_s + world.preset.exposure_s / 2
    poses = [RigidTransform.from_pose(pose) for pose in world.motion[stereo.setup.body].pose(middle)]
    start = poses[0].inverse()
    return np.stack([(pose @ start).pose for pose in poses])
