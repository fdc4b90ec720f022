"""Gravity, air and what is mounted, as the rig states them or as they follow from its place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.errors import InputError
from fusion.manifest import Load, Manifest, Part
from shaker._checks import FloatArray
from shaker.models.weights.gravity import Known, air_density_at, gravity_at

LIGHTEST_KGM3, HEAVIEST_KGM3 = 2700.0, 8000.0
"""Densities of aluminium and steel: anything between them may be what nobody has stated."""
U_STATED_AIR = 0.01
"""Relative standard uncertainty of an air density that is stated."""


@dataclass(frozen=True)
class Weighed:
    """A body whose mass is stated: true mass kg, volume per mass m³/kg, centre of mass m (3,), with uncertainties."""

    name: str
    mass_kg: float
    u_mass_kg: float
    volume_m3kg: float
    u_volume_m3kg: float
    centre_m: FloatArray
    u_centre_m: FloatArray


def local_gravity(manifest: Manifest) -> Known:
    """Return the rig's gravity, else that of its latitude and height; refuses a rig that states neither."""
    environment = manifest.rig.environment
    if environment is not None and environment.gravity is not None:
        vector, u = np.array(environment.gravity), np.array(environment.gravity_uncertainty)
        size = float(np.linalg.norm(vector))
        return Known(size, float(np.linalg.norm(vector / size * u)), "stated in rig.toml")
    if environment is None or environment.latitude is None:
        expected = "local gravity, or latitude and height from which it follows"
        raise InputError(manifest.rig_path, "environment.gravity", found="nothing", expected=expected)
    if environment.height is None:
        expected = "the height above the sea in m that belongs to latitude"
        raise InputError(manifest.rig_path, "environment.height", found="nothing", expected=expected)
    return gravity_at(float(np.radians(environment.latitude)), environment.height)


def air_density(manifest: Manifest) -> Known:
    """Return the rig's air density, else that of its pressure, temperature and humidity as far as they are stated."""
    environment = manifest.rig.environment
    if environment is None:
        return air_density_at(None, None, None, None)
    if environment.air_density is not None:
        return Known(environment.air_density, U_STATED_AIR * environment.air_density, "stated in rig.toml")
    return air_density_at(environment.height, environment.pressure, environment.temperature, environment.humidity)


def unknown_volume() -> tuple[float, float]:
    """Return volume per mass, m³/kg, of something between aluminium and steel, and its standard uncertainty."""
    low, high = 1.0 / HEAVIEST_KGM3, 1.0 / LIGHTEST_KGM3
    return 0.5 * (low + high), (high - low) / np.sqrt(12.0)


def load_bodies(manifest: Manifest) -> tuple[Weighed, ...]:
    """Return what is taken off for a recording without load: the load and the rig's parts on it."""
    rig = manifest.rig
    found = [] if rig.load is None else [_weighed("load", rig.load)]
    return (*found, *(_weighed(part.name, part) for part in rig.part if part.body == "load"))


def own_bodies(manifest: Manifest) -> tuple[Weighed, ...]:
    """Return what one recording carries beside that: the parts that stand in its own recording.toml."""
    own = manifest.part[len(manifest.rig.part) :]
    return tuple(_weighed(part.name, part) for part in own if part.body == "load")


def _weighed(name: str, entry: Load | Part) -> Weighed:
    """One table of the manifests."""
    volume, u_volume = unknown_volume() if entry.density is None else (1.0 / entry.density, 0.0)
    centre, u_centre = np.array(entry.centre_of_mass), np.array(entry.centre_of_mass_uncertainty)
    return Weighed(name, entry.true_mass, entry.mass_uncertainty, volume, u_volume, centre, u_centre)
