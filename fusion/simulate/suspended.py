"""Simulated loads on the sensor's springs, driven by a chirp of the base: what identifies stiffness, damping, mass."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.simulate.chirp import (
    RECORDING,
    TRUTH_FILE,
    Chirp,
    chirp_channels,
    chirp_samples,
    chirp_tables,
    write_chirp_files,
)
from fusion.simulate.draws import Draws
from fusion.simulate.manifest_text import complex_table, part_keys, sensor_keys
from fusion.simulate.mechanics import TruePart
from fusion.simulate.preset import PartSpec, Preset
from fusion.simulate.toml_text import to_toml
from fusion.simulate.world import STATIC_UNCERTAINTY, static_sensitivity, true_part
from shaker._checks import ComplexArray, FloatArray

Place = tuple[float, float, float]

COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
STIFFNESS_UNITS = ("N/m", "N/m", "N/m", "N.m/rad", "N.m/rad", "N.m/rad")


@dataclass(frozen=True)
class Suspension:
    """A sensor of which the `free` components of the load move on springs and dampers, and what is mounted on it.

    `stiffness` in N/m and N·m/rad, `damping` in N·s/m and N·m·s/rad, about the sensor origin. `sensor`: set-up whose
    sensor, sensitivity and surroundings the rigs state. `loads` by the name of their rig and recording. The base moves
    along `direction`, as do the accelerometers on base and load (`tops`) measure.
    """

    sensor: Preset
    internal: PartSpec
    free: tuple[int, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    loads: dict[str, PartSpec]
    direction: Place
    base: Place
    tops: dict[str, Place]
    chirp: Chirp

    def transfer(self, load: TruePart, internal: TruePart, point: Place, frequency_hz: FloatArray) -> ComplexArray:
        """Return the acceleration of a point of the load over that of the base, both along the direction.

        (M s² + b s + k) q = (b s + k) q_base for the free components q, all others move as the base does.
        """
        s = 2j * np.pi * np.asarray(frequency_hz)[:, None, None]
        spring = np.diag(self.stiffness) + s * np.diag(self.damping)
        free = np.array(self.free)
        matrix = mass_matrix(load) + mass_matrix(internal)
        drive = np.array([*self.direction, 0.0, 0.0, 0.0])
        held = np.setdiff1d(np.arange(6), free)
        inertia = matrix[np.ix_(free, free)]
        pull = spring @ drive[free] - s[:, :, 0] ** 2 * (matrix[np.ix_(free, held)] @ drive[held])
        moved = np.linalg.solve(s**2 * inertia + spring, pull[:, :, None])[:, :, 0]
        row = np.array([*self.direction, *np.cross(point, self.direction)])
        return np.asarray(moved @ row[free] + drive[held] @ row[held])

    def resonances_hz(self, load: TruePart, internal: TruePart) -> FloatArray:
        """Return the undamped natural frequencies, ascending."""
        matrix = (mass_matrix(load) + mass_matrix(internal))[np.ix_(self.free, self.free)]
        squared = np.linalg.eigvals(np.linalg.solve(matrix, np.diag(self.stiffness)))
        return np.sort(np.sqrt(squared.real)) / (2.0 * np.pi)


def mass_matrix(part: TruePart) -> FloatArray:
    """Return the mass matrix (6, 6) of a rigid part about the origin: force and moment of its accelerations."""
    m, (x, y, z) = part.mass_kg, part.centre_of_mass_m
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[m * np.eye(3), -m * cross], [m * cross, part.inertia_kgm2 - m * cross @ cross]])


def write_chirps(folder: Path, stand: Suspension, draws: Draws) -> None:
    """Write the rigs into a campaign folder, and a chirp recording of each load.

    The accelerometers, their amplifiers and the clock are the same in all recordings, and so are their errors.
    """
    internal = true_part(stand.internal, draws)
    for name, load in stand.loads.items():
        file = rig_file(name)
        (folder / file).write_text(to_toml(rig_tables(stand, load, draws)), encoding="utf-8", newline="\n")
        true = true_part(load, draws)
        ratios = {top: _ratio(stand, true, internal, point) for top, point in stand.tops.items()}
        samples = chirp_samples(stand.chirp, draws, ratios, f"{name}.")
        channels = chirp_channels(stand.chirp, stand.base, stand.tops, stand.direction)
        tables = chirp_tables(stand.chirp, f"chirp, load mass {load.mass:g} kg, simulated", f"../{file}", channels)
        truth = _truth(stand, true, internal, draws)
        write_chirp_files(folder / f"{RECORDING}-{name}", stand.chirp, samples, tables, truth)


def rig_file(name: str) -> str:
    """Return the name of the file that describes the rig with a load."""
    return f"rig-{name}.toml"


def rig_tables(stand: Suspension, load: PartSpec, draws: Draws) -> dict[str, Any]:
    """Return rig.toml with one of the loads as nested dictionaries; the sensor is the same in all."""
    preset = replace(stand.sensor, internal=stand.internal)
    return {
        "format": 1,
        "name": f"{preset.rig_name}, {load.name}",
        "sensor": sensor_keys(preset, static_sensitivity(preset, draws)[0])
        | {"static_sensitivity_uncertainty": STATIC_UNCERTAINTY},
        "load": part_keys(load),
        "environment": {"gravity": preset.gravity_mps2.tolist(), "temperature": 23.0, "air_density": 1.19},
    }


def write_truth(folder: Path, preset: str, stand: Suspension, draws: Draws, others: dict[str, Any]) -> None:
    """Write what all recordings of the campaign share into its folder, and what each load does."""
    internal = true_part(stand.internal, draws)
    loads = {name: true_part(load, draws) for name, load in stand.loads.items()}
    truth = {
        "format": 1,
        "preset": preset,
        "seed": draws.seed,
        **_springs(stand),
        "internal_mass_kg": internal.mass_kg,
        "load_mass_kg": {name: load.mass_kg for name, load in loads.items()},
        "resonances_hz": {name: stand.resonances_hz(load, internal).tolist() for name, load in loads.items()},
        **others,
        "drawn": draws.values,
    }
    (folder / TRUTH_FILE).write_text(json.dumps(truth), encoding="utf-8", newline="\n")


def _ratio(stand: Suspension, load: TruePart, internal: TruePart, point: Place) -> Callable[[FloatArray], ComplexArray]:
    """Return the ratio that an accelerometer at a point sees, over frequency."""
    return lambda frequency_hz: stand.transfer(load, internal, point, frequency_hz)


def _springs(stand: Suspension) -> dict[str, Any]:
    """Return stiffness and damping by component."""
    names = [COMPONENTS[place] for place in stand.free]
    return {
        "stiffness": dict(zip(names, stand.stiffness, strict=True)),
        "damping": dict(zip(names, stand.damping, strict=True)),
    }


def _truth(stand: Suspension, load: TruePart, internal: TruePart, draws: Draws) -> dict[str, Any]:
    """Return truth.json of one recording: masses, springs, the curves at every line, and every error drawn so far."""
    frequency = stand.chirp.lines_hz
    curves = {top: complex_table(stand.transfer(load, internal, point, frequency)) for top, point in stand.tops.items()}
    return {
        "format": 1,
        "seed": draws.seed,
        **_springs(stand),
        "mass_matrix": mass_matrix(load).tolist(),
        "internal_mass_kg": internal.mass_kg,
        "resonances_hz": stand.resonances_hz(load, internal).tolist(),
        "frequency_hz": frequency.tolist(),
        "transfer": curves,
        "drawn": dict(draws.values),
    }
