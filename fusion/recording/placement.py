"""Placement of channels: measuring points, directions, mirrors, beams of one head."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fusion.recording.manifest import ChannelEntry
from fusion.recording.transducer import HEAD, STATIONARY, TRANSDUCERS
from shakercal._common.arrays import FloatArray

CLOSE_TO_AXIS_RAD = 0.5
"""Beams of a head at a smaller angle to a sensor axis observe the same as a beam along it."""
AIM_TOLERANCE_RAD = 1e-3  # rounding of stated directions and points


def chain_name(entry: ChannelEntry) -> str:
    """Return the name of a channel's instrument: its `common`, or its name."""
    return entry.common or entry.name


def unit_direction(entry: ChannelEntry) -> FloatArray:
    """Return the unit vector of a channel's direction, by default to its mirror."""
    direction = (
        mirror_of(entry) - measuring_point(entry)
        if is_aimed_at_mirror(entry)
        else np.asarray(entry.direction, dtype=np.float64)
    )
    return np.asarray(direction / np.linalg.norm(direction))


def carrier(entry: ChannelEntry) -> str | None:
    """Return the head of a laser beam, or of an accelerometer on the head."""
    optical = entry.quantity in TRANSDUCERS and TRANSDUCERS[entry.quantity].kind == "vibrometer"
    return f"head {entry.head.name}" if entry.head is not None and (optical or entry.body == HEAD) else None


def is_aimed_at_mirror(entry: ChannelEntry) -> bool:
    """Whether the direction of a channel follows from the mirror of its head."""
    return entry.direction is None and entry.head is not None and entry.head.stated.mirror is not None


def mirror_of(entry: ChannelEntry) -> FloatArray:
    """Return the centre of rotation of a channel's head: its mirror, else the channel's point."""
    mirror = None if entry.head is None else entry.head.stated.mirror
    return measuring_point(entry) if mirror is None else np.asarray(mirror, dtype=np.float64)


def main_direction(entry: ChannelEntry) -> FloatArray:
    """Return the direction that determines the components observed by a channel.

    It is the direction of the channel, or the axis nearly parallel to a beam from a mirror. Beams from one mirror
    measure three motions only, those of the body at the mirror. The assumed limits of transverse motion separate it
    from the motion along the axis and the rocking about the others.
    """
    direction = unit_direction(entry)
    axis = int(np.argmax(np.abs(direction)))
    if not is_aimed_at_mirror(entry) or abs(direction[axis]) < np.cos(CLOSE_TO_AXIS_RAD):
        return direction
    return np.asarray(np.sign(direction[axis]) * np.eye(3)[axis])


def aim_contradiction(entry: ChannelEntry) -> tuple[str, str] | None:
    """Return the expected and the found direction if a channel's direction contradicts its mirror.

    The limit is three combined standard uncertainties plus a milliradian. Either sense of the direction passes.
    """
    if entry.head is None or entry.body == HEAD or entry.head.stated.mirror is None or entry.direction is None:
        return None
    stated, line = entry.head.stated, mirror_of(entry) - measuring_point(entry)
    distance = float(np.linalg.norm(line))
    sine = float(np.linalg.norm(np.cross(unit_direction(entry), line / distance)))
    moved = np.array([stated.mirror_uncertainty, stated.point_uncertainty, entry.point_uncertainty]).max(axis=1)
    angles = [entry.direction_uncertainty, max(stated.rotation_uncertainty), *(moved / distance)]
    u = float(np.linalg.norm(angles))
    if sine <= 3.0 * u + AIM_TOLERANCE_RAD:
        return None
    expected = f"the direction from the point to the mirror of head {entry.head.name}, or no direction"
    return expected, f"a direction {1e3 * np.arcsin(min(sine, 1.0)):.3g} mrad from it (u = {1e3 * u:.2g} mrad)"


@dataclass(frozen=True)
class LaserBeams:
    """Common properties of the laser beams of a recording.

    `centres`: mean of the points of each head with a stand-off only. `parallel`: number of vibrometer points, if
    several, with exactly one direction, by instrument, or head without mirror and stand-off, and direction.
    """

    centres: dict[str, FloatArray]
    parallel: dict[tuple[str, tuple[float, ...]], int]

    @classmethod
    def of(cls, entries: Iterable[ChannelEntry]) -> LaserBeams:
        """Return the heads and the parallel beams among the vibrometers of some channels."""
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
        centres = {name: np.mean(list(members), axis=0) for name, members in points.items()}
        return cls(centres, {key: len(members) for key, members in parallel.items() if len(members) > 1})

    def shares_tilt(self, entry: ChannelEntry) -> bool:
        """Whether the beam of a channel may have a common tilt with others."""
        return entry.head is None and (chain_name(entry), tuple(unit_direction(entry).tolist())) in self.parallel

    def fan(self, entry: ChannelEntry) -> FloatArray | None:
        """Return the inclination (3,) of a channel's beam in a fan."""
        if entry.head is None or entry.head.stated.standoff is None or entry.head.name not in self.centres:
            return None
        direction, offset = unit_direction(entry), self.centres[entry.head.name] - measuring_point(entry)
        return np.asarray((offset - direction * (direction @ offset)) / entry.head.stated.standoff)


def measuring_point(entry: ChannelEntry) -> FloatArray:
    """Return the point of a channel, by default the origin: rotations are independent of it."""
    return np.zeros(3) if entry.point is None else np.asarray(entry.point, dtype=np.float64)


def perpendicular_axes(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) perpendicular to a direction and to each other."""
    return np.asarray(np.linalg.svd(direction[None])[2][1:])


def placement_name(entry: ChannelEntry, kind: str, axis: str) -> str:
    """Return the name of an unknown of a channel's placement, with stated point and direction.

    `kind`: "point" (axis x, y, z), "direction" or "transverse sensitivity" (axis 0, 1 of `perpendicular_axes`).
    """
    at = "" if entry.point is None else f" at ({', '.join(f'{x:.9g}' for x in entry.point)})"
    along = "" if kind == "point" else f" along ({', '.join(f'{x:.9g}' for x in entry.direction or ())})"
    return f"{chain_name(entry)}: {kind} {entry.name}{at}{along} {axis}"
