"""The manifests and the truth file of a simulated campaign."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.channels import clock
from fusion.simulate.draws import Draws
from fusion.simulate.preset import ChannelSpec, DaqSpec, PartSpec, Preset
from fusion.simulate.scenery import StereoSetup, left_camera
from fusion.simulate.world import TrueStereo, World
from photogram.rigid import RigidTransform


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
        "channels": ["Fx", "Fy", "Fz", "Mx", "My", "Mz"],
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
