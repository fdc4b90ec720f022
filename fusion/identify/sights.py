"""Where the channels of a transfer recording measure, and what is uncertain of it, by names that hold everywhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fusion.manifest import ChannelEntry
from fusion.observe import across, placement_name
from shaker._checks import FloatArray
from shaker.models.measured import AT_THE_BASE, Sight, SightError


def sight(entry: ChannelEntry) -> Sight:
    """Return where and along what a channel measures, of an angular velocity about what."""
    turning = entry.quantity == "angular_velocity"
    point = np.zeros(3) if turning else np.asarray(entry.point, dtype=np.float64)
    return Sight(point, np.asarray(entry.direction, dtype=np.float64), turning)


def sight_errors(base: ChannelEntry, tops: Sequence[ChannelEntry], mounting: str) -> tuple[SightError, ...]:
    """Return what is uncertain of the places and directions of reference and responses.

    An unknown keeps its value as long as nothing is mounted anew: until then it is one in all recordings and, under its
    name, in the results of sines.
    """
    placed = [(base, AT_THE_BASE), *((entry, place) for place, entry in enumerate(tops))]
    return tuple(
        SightError(f"{name} [{mounting}]", place, change)
        for entry, place in placed
        for name, change in _changes(entry)
        if np.any(change != 0.0)
    )


def _changes(entry: ChannelEntry) -> Iterator[tuple[str, FloatArray]]:
    """Yield name and change (6,) of a channel's row: three coordinates, two tilts, two leaks of what lies across."""
    seen = sight(entry)
    for axis, unit, u in zip("xyz", np.eye(3), np.broadcast_to(entry.point_uncertainty, 3), strict=True):
        lever = np.cross(unit, seen.direction) * (0.0 if seen.turning else u)
        yield placement_name(entry, "point", axis), np.concatenate([np.zeros(3), lever])
    leaks = (
        ("direction", entry.direction_uncertainty),
        ("transverse sensitivity", entry.transverse_sensitivity / np.sqrt(2.0)),
    )
    for number, tangent in enumerate(across(seen.direction)):
        for kind, u in leaks:
            yield placement_name(entry, kind, str(number)), u * replace(seen, direction=tangent).row
