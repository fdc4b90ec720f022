"""Transducers: what kind of motion they read, in which unit, where and along which direction.

A new kind is an entry of `TRANSDUCERS`: manifest, model, Monte Carlo run, identification, `check` and units follow. The
simulator does not: it is what all these are tested against.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

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


TRANSDUCERS: dict[str, Transducer] = {
    transducer.quantity: transducer
    for transducer in (
        Transducer("displacement", "m", "vibrometer", order=-2),
        Transducer("velocity", "m/s", "vibrometer", order=-1),
        # Uni- and triaxial: the axes of a triaxial one are channels with the same `common` name, which share a chain.
        Transducer("acceleration", "m/s^2", "accelerometer", order=0, weighs=True),
        # Gyroscopes: what rides on the body and senses its motion against inertia, as accelerometers do.
        Transducer("angular_velocity", "rad/s", "accelerometer", order=-1, turning=True),
    )
}
"""What reads one component of a body's motion, by the `quantity` of its channel in recording.toml."""


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
