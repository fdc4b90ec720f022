"""Transducers: what kind of motion they read, where and along which direction, and what is uncertain of that.

Model, Monte Carlo run, identification and `check` take rows [d, r × d] · (jω)^n and their errors by name from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from fusion.estimation.measurement_model import Deviates, Geometry
from fusion.estimation.uncertainty import Unknown
from photogram.geometry import rotation_from_vector
from shaker.arrays import ComplexArray, FloatArray
from shaker.sine.phasor import derivative_factor

if TYPE_CHECKING:
    from fusion.recording.manifest import ChannelEntry

TRANSVERSE = "transverse sensitivity"


@dataclass(frozen=True)
class Transducer:
    """A kind of channel that reads one component of a body's motion; `quantity` is its name in the manifest.

    It reads (jω)^`order` times an acceleration, in `unit`, along its direction, or, `turning`, about it; one that
    `weighs` reads d·(a - g) in body axes. `kind`: of instrument, among which a source of the fusion is chosen.
    """

    quantity: str
    unit: str
    kind: Literal["vibrometer", "accelerometer"]
    order: int
    turning: bool = False
    weighs: bool = False

    def geometry(self, point: FloatArray, direction: FloatArray) -> FloatArray:
        """Return [d, r × d] (..., 6) for places r and directions d (..., 3), of a turning one [0, d].

        It tells what the channel can observe, whatever the frequency.
        """
        none = np.zeros_like(direction)
        parts = (none, direction) if self.turning else (direction, np.cross(point, direction))
        return np.concatenate(parts, axis=-1)

    def rows(self, geometry: FloatArray, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> ComplexArray:
        """Return rows (..., K, 6) of the model from geometries, or changes of them, (..., 6).

        What weighs tilts with the body, which adds (d × g)/ω² to its rotations.
        """
        rows = np.repeat(geometry[..., None, :], len(frequency_hz), axis=-2)
        if self.weighs and gravity_mps2 is not None:
            tilt = np.cross(geometry[..., :3], gravity_mps2)
            rows[..., 3:] += tilt[..., None, :] / (2.0 * np.pi * frequency_hz[:, None]) ** 2
        return np.asarray(derivative_factor(frequency_hz, self.order)[:, None] * rows)


ACCELERATION = Transducer("acceleration", "m/s^2", "accelerometer", order=0, weighs=True)
"""Uni- and triaxial: the axes of a triaxial one are channels with the same `common` name, which share a chain."""
ANGULAR_VELOCITY = Transducer("angular_velocity", "rad/s", "accelerometer", order=-1, turning=True)
"""Gyroscopes: what rides on the body and senses its motion against inertia, as accelerometers do."""


def chain_name(entry: ChannelEntry) -> str:
    """Return the name of the instrument that a channel belongs to: its `common`, or its own name."""
    return entry.common or entry.name


def unit_direction(entry: ChannelEntry) -> FloatArray:
    """Return the direction of a channel, normalised."""
    direction = np.asarray(entry.direction, dtype=np.float64)
    return np.asarray(direction / np.linalg.norm(direction))


def placed_at(entry: ChannelEntry) -> FloatArray:
    """Return the point of a channel; the origin where it has none, for what turns is the same everywhere."""
    return np.zeros(3) if entry.point is None else np.asarray(entry.point, dtype=np.float64)


def across(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) at right angles to a direction and to each other."""
    return np.asarray(np.linalg.svd(direction[None])[2][1:])


def placement_name(entry: ChannelEntry, kind: str, axis: str) -> str:
    """Return the name of an unknown of a channel's placement: with the stated place, and its direction where that errs.

    `kind`: "point" (axis x, y, z), "direction" or "transverse sensitivity" (axis 0, 1 of `across`).
    """
    at = "" if entry.point is None else f" at ({', '.join(f'{x:.9g}' for x in entry.point)})"
    along = "" if kind == "point" else f" along ({', '.join(f'{x:.9g}' for x in entry.direction or ())})"
    return f"{chain_name(entry)}: {kind} {entry.name}{at}{along} {axis}"


def geometry_errors(transducer: Transducer, entry: ChannelEntry) -> tuple[Unknown[FloatArray], ...]:
    """Return what is uncertain of a channel's place and direction, by names that hold in every recording.

    Effects (6,) on its geometry, as long as things are mounted as they are.

    A point has three coordinates; a direction errs by two small rotations; a transverse sensitivity t of unknown
    direction is two components of t/√2 across the axis.
    """
    point, direction, chain = placed_at(entry), unit_direction(entry), chain_name(entry)
    found = []
    if not transducer.turning:
        for axis, unit, u in zip("xyz", np.eye(3), np.broadcast_to(entry.point_uncertainty, 3).tolist(), strict=True):
            lever = np.concatenate([np.zeros(3), np.cross(unit, direction) * u])
            found.append(Unknown(placement_name(entry, "point", axis), f"{chain}: point", u, "m", lever, "mounting"))
    leaks = (
        ("direction", "rad", entry.direction_uncertainty),
        (TRANSVERSE, "1", entry.transverse_sensitivity / np.sqrt(2.0)),
    )
    for number, tangent in enumerate(across(direction)):
        for kind, of_kind, u in leaks:
            name = placement_name(entry, kind, str(number))
            turned = u * transducer.geometry(point, tangent)
            found.append(Unknown(name, f"{chain}: {kind}", float(u), of_kind, turned, "mounting"))
    return tuple(error for error in found if np.any(error.effect != 0.0))


@dataclass(frozen=True)
class ChannelGeometry(Geometry):
    """Places and directions of the channels of one instrument, for the Monte Carlo run."""

    transducer: Transducer
    entries: tuple[ChannelEntry, ...]
    frequency_hz: FloatArray
    gravity_mps2: FloatArray | None

    @property
    def unknowns(self) -> frozenset[str]:
        """Return the names of the unknowns that `rows` draws."""
        return frozenset(error.name for entry in self.entries for error in geometry_errors(self.transducer, entry))

    def rows(self, design: ComplexArray, deviates: Deviates) -> ComplexArray:
        """Return the rows (N, K, M, 6) at points moved and along axes turned by finite angles, with a leak across them.

        The size of a transverse sensitivity is known and its direction is not, so its angle is uniform.
        """
        drawn = []
        for entry in self.entries:
            u = np.broadcast_to(np.asarray(entry.point_uncertainty, dtype=np.float64), (3,))
            shift = np.stack([deviates.normal(placement_name(entry, "point", axis)) for axis in "xyz"], axis=1)
            stated = unit_direction(entry)
            sides = across(stated)
            tilt = np.stack([deviates.normal(placement_name(entry, "direction", axis)) for axis in "01"], axis=1)
            spin = np.cross(stated, entry.direction_uncertainty * tilt @ sides)
            turned = np.einsum("nij,j->ni", rotation_from_vector(spin), stated)
            angle = deviates.angle(placement_name(entry, TRANSVERSE, "0"))
            leak = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ sides
            geometry = self.transducer.geometry(
                placed_at(entry) + u * shift, np.asarray(turned + entry.transverse_sensitivity * leak)
            )
            drawn.append(self.transducer.rows(geometry, self.frequency_hz, self.gravity_mps2))
        return np.stack(drawn, axis=2)
