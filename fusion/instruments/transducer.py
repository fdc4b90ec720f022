"""Transducers: what kind of motion they read, in which unit, where and along which direction.

A new kind is an entry of `TRANSDUCERS`: manifest, model, Monte Carlo run, identification, `check` and units follow. The
simulator does not: it is what all these are tested against.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from shaker.arrays import ComplexArray, FloatArray
from shaker.sine.phasor import derivative_factor

if TYPE_CHECKING:
    from fusion.recording.manifest import ChannelEntry

STATIONARY, HEAD = "room", "head"
"""What instruments see beside the bodies: what stands still in the room, and the head that other channels leave."""
TRANSVERSE = "transverse sensitivity"
CLOSE_TO_AXIS_RAD = 0.5
"""Beams of a head that differ less from a sensor axis observe what a beam along that axis does."""
AIM_TOLERANCE_RAD = 1e-3


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
    rotational: bool = False
    senses_gravity: bool = False

    def geometry(self, point: FloatArray, direction: FloatArray) -> FloatArray:
        """Return [d, r × d] (..., 6) for places r and directions d (..., 3), of a turning one [0, d].

        It tells what the channel can observe, whatever the frequency.
        """
        none = np.zeros_like(direction)
        parts = (none, direction) if self.rotational else (direction, np.cross(point, direction))
        return np.concatenate(parts, axis=-1)

    def rows(self, geometry: FloatArray, frequency_hz: FloatArray, gravity_mps2: FloatArray | None) -> ComplexArray:
        """Return rows (..., K, 6) of the model from geometries, or changes of them, (..., 6).

        What weighs tilts with the body, which adds (d × g)/ω² to its rotations.
        """
        rows = np.repeat(geometry[..., None, :], len(frequency_hz), axis=-2)
        if self.senses_gravity and gravity_mps2 is not None:
            tilt = np.cross(geometry[..., :3], gravity_mps2)
            rows[..., 3:] += tilt[..., None, :] / (2.0 * np.pi * frequency_hz[:, None]) ** 2
        return np.asarray(derivative_factor(frequency_hz, self.order)[:, None] * rows)


TRANSDUCERS: dict[str, Transducer] = {
    transducer.quantity: transducer
    for transducer in (
        Transducer("displacement", "m", "vibrometer", order=-2),
        Transducer("velocity", "m/s", "vibrometer", order=-1),
        # Uni- and triaxial: the axes of a triaxial one are channels with the same `common` name, which share a chain.
        Transducer("acceleration", "m/s^2", "accelerometer", order=0, senses_gravity=True),
        # Gyroscopes: what rides on the body and senses its motion against inertia, as accelerometers do.
        Transducer("angular_velocity", "rad/s", "accelerometer", order=-1, rotational=True),
    )
}
"""What reads one component of a body's motion, by the `quantity` of its channel in recording.toml."""


def chain_name(entry: ChannelEntry) -> str:
    """Return the name of the instrument that a channel belongs to: its `common`, or its own name."""
    return entry.common or entry.name


def unit_direction(entry: ChannelEntry) -> FloatArray:
    """Return the direction of a channel, normalised; one that states none looks from its point to its head's mirror."""
    direction = (
        mirror_of(entry) - measuring_point(entry)
        if is_aimed_at_mirror(entry)
        else np.asarray(entry.direction, dtype=np.float64)
    )
    return np.asarray(direction / np.linalg.norm(direction))


def carrier(entry: ChannelEntry) -> str | None:
    """Return what carries a laser beam, or an accelerometer that tells of it: the head that it names."""
    optical = entry.quantity in TRANSDUCERS and TRANSDUCERS[entry.quantity].kind == "vibrometer"
    return f"head {entry.head.name}" if entry.head is not None and (optical or entry.body == HEAD) else None


def is_aimed_at_mirror(entry: ChannelEntry) -> bool:
    """Whether the direction of a channel is that from its point to the mirror of its head."""
    return entry.direction is None and entry.head is not None and entry.head.stated.mirror is not None


def mirror_of(entry: ChannelEntry) -> FloatArray:
    """Return about which point the head of a channel turns: its mirror, else the channel's own point."""
    mirror = None if entry.head is None else entry.head.stated.mirror
    return measuring_point(entry) if mirror is None else np.asarray(mirror, dtype=np.float64)


def main_direction(entry: ChannelEntry) -> FloatArray:
    """Return the direction that decides what a channel observes: its own, or the axis that a beam nearly follows.

    Beams that leave one mirror tell three motions only, those of the body at the mirror. What they are meant for, the
    motion along the axis and rocking about the others, is told apart from motion across by what is assumed of that.
    """
    direction = unit_direction(entry)
    axis = int(np.argmax(np.abs(direction)))
    if not is_aimed_at_mirror(entry) or abs(direction[axis]) < np.cos(CLOSE_TO_AXIS_RAD):
        return direction
    return np.asarray(np.sign(direction[axis]) * np.eye(3)[axis])


def aim_contradiction(entry: ChannelEntry) -> tuple[str, str] | None:
    """Return what was expected and found where a channel's direction contradicts the line to its head's mirror.

    Beyond three combined standard uncertainties, and a milliradian; either sense of the direction counts.
    """
    if entry.head is None or entry.body == HEAD or entry.head.stated.mirror is None or entry.direction is None:
        return None
    stated, line = entry.head.stated, mirror_of(entry) - measuring_point(entry)
    distance = float(np.linalg.norm(line))
    aside = float(np.linalg.norm(np.cross(unit_direction(entry), line / distance)))
    moved = np.array([stated.mirror_uncertainty, stated.point_uncertainty, entry.point_uncertainty]).max(axis=1)
    angles = [entry.direction_uncertainty, max(stated.rotation_uncertainty), *(moved / distance)]
    u = float(np.linalg.norm(angles))
    if aside <= 3.0 * u + AIM_TOLERANCE_RAD:
        return None
    expected = f"the direction from the point to the mirror of head {entry.head.name}, or no direction to mean that"
    return expected, f"a direction {1e3 * np.arcsin(min(aside, 1.0)):.3g} mrad from it (u = {1e3 * u:.2g} mrad)"


@dataclass(frozen=True)
class LaserBeams:
    """What the channels of a recording have in common by where their beams come from.

    `centres`: mean of the points of each head of which only the stand-off is known; `alike`: how many vibrometer points
    of an instrument, or of a head that states neither mirror nor stand-off, state exactly one direction, if several do.
    """

    centres: dict[str, FloatArray]
    parallel: dict[tuple[str, tuple[float, ...]], int]

    @classmethod
    def of(cls, entries: Iterable[ChannelEntry]) -> LaserBeams:
        """Find the heads and the parallel beams among channels; others than vibrometers have none."""
        lasers = [e for e in entries if e.quantity in ("displacement", "velocity") and e.body != STATIONARY]
        points: dict[str, dict[tuple[float, ...], None]] = {}
        parallel: dict[tuple[str, tuple[float, ...]], dict[tuple[float, ...], None]] = {}
        for entry in lasers:
            at = tuple(measuring_point(entry).tolist())
            if entry.head is not None and entry.head.stated.standoff is not None:
                points.setdefault(entry.head.name, {})[at] = None
            elif not is_aimed_at_mirror(entry):
                title = chain_name(entry) if entry.head is None else f"head {entry.head.name}"
                parallel.setdefault((title, tuple(unit_direction(entry).tolist())), {})[at] = None
        centres = {name: np.mean(list(own), axis=0) for name, own in points.items()}
        return cls(centres, {key: len(own) for key, own in parallel.items() if len(own) > 1})

    def shares_tilt(self, entry: ChannelEntry) -> bool:
        """Whether a channel is one of several whose beams may err together."""
        return entry.head is None and (chain_name(entry), tuple(unit_direction(entry).tolist())) in self.parallel

    def fan(self, entry: ChannelEntry) -> FloatArray | None:
        """Return by how much (3,) the beam of a channel leans where it leaves one mirror with those of its head."""
        if entry.head is None or entry.head.stated.standoff is None or entry.head.name not in self.centres:
            return None
        direction, offset = unit_direction(entry), self.centres[entry.head.name] - measuring_point(entry)
        return np.asarray((offset - direction * (direction @ offset)) / entry.head.stated.standoff)


def measuring_point(entry: ChannelEntry) -> FloatArray:
    """Return the point of a channel; the origin where it has none, for what turns is the same everywhere."""
    return np.zeros(3) if entry.point is None else np.asarray(entry.point, dtype=np.float64)


def perpendicular_axes(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) at right angles to a direction and to each other."""
    return np.asarray(np.linalg.svd(direction[None])[2][1:])


def placement_name(entry: ChannelEntry, kind: str, axis: str) -> str:
    """Return the name of an unknown of a channel's placement: with the stated place, and its direction where that errs.

    `kind`: "point" (axis x, y, z), "direction" or "transverse sensitivity" (axis 0, 1 of `across`).
    """
    at = "" if entry.point is None else f" at ({', '.join(f'{x:.9g}' for x in entry.point)})"
    along = "" if kind == "point" else f" along ({', '.join(f'{x:.9g}' for x in entry.direction or ())})"
    return f"{chain_name(entry)}: {kind} {entry.name}{at}{along} {axis}"
