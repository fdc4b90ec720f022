"""Inputs of a sensitivity that count as exact, without a stated uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import list_names
from fusion.recording.transducer import TRANSDUCERS
from fusion.sensitivity.disturbances import SURROUNDINGS
from fusion.sensitivity.moving_body import moving_parts
from fusion.sensitivity.sensitivity_notices import EXACT_INPUTS
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.recording.load import Manifest
    from fusion.recording.manifest import ChannelEntry

MOST_NAMES = 8
"""Largest number of names of one quantity in the list (chosen)."""
QUANTITIES = ("scale", "mass", "pose", "point", "direction", "centre of mass", "inertia", "delay")
"""In the order of the list."""


def exact_inputs(manifest: Manifest, entries: Sequence[ChannelEntry]) -> str:
    """Return the inputs without an uncertainty as text, grouped by quantity.

    `entries`: recorded channels. Channels of the base and inputs that the result does not use are left out.
    """
    found: dict[str, dict[str, None]] = {quantity: {} for quantity in QUANTITIES}
    for quantity, name in (*_of_channels(entries), *_of_pairs(manifest), *_of_parts(manifest)):
        found[quantity][name] = None
    groups = ((quantity, list_names(tuple(names), MOST_NAMES)) for quantity, names in found.items() if names)
    return "; ".join(f"{quantity} of {names}" for quantity, names in groups)


def exact_inputs_notice(manifest: Manifest, entries: Sequence[ChannelEntry]) -> Iterator[Notice]:
    """Yield the note of the inputs that count as exact, if a sensitivity uses them."""
    inputs = exact_inputs(manifest, entries) if manifest.rig.sensor is not None else ""
    if inputs:
        yield Notice(EXACT_INPUTS, SURROUNDINGS, inputs=inputs)


def _of_channels(entries: Sequence[ChannelEntry]) -> Iterator[tuple[str, str]]:
    """Yield quantity and name of outputs and of motion channels of the load."""
    for entry in entries:
        moved = entry.quantity in TRANSDUCERS and entry.body == "load"
        if not (moved or entry.quantity == "output"):
            continue
        name = entry.channel or entry.name
        if entry.response is None:  # a table states its uncertainties
            if not entry.scale_uncertainty and not entry.individual_uncertainty:
                yield "scale", name
            if not entry.delay_uncertainty:
                yield "delay", name
        if not moved:
            continue
        head = None if entry.head is None else entry.head.stated
        if entry.point is not None and not any(entry.point_uncertainty) and not (head and any(head.point_uncertainty)):
            yield "point", name
        if not entry.direction_uncertainty and not (head and any(head.rotation_uncertainty)):
            yield "direction", name


def _of_pairs(manifest: Manifest) -> Iterator[tuple[str, str]]:
    """Yield quantity and name of the stereo pairs that observe the load."""
    for name in dict.fromkeys(one.stereo for _, block in manifest.set_ups for one in (*block.images, *block.points)):
        pair = manifest.rig.stereo[name]
        if pair.body != "load":
            continue
        if pair.pose_by_calibration is None and not any(pair.pose_uncertainty):
            yield "pose", name
        if pair.surface is None and not pair.scale_uncertainty:
            yield "scale", name
        if not pair.delay_uncertainty:
            yield "delay", name


def _of_parts(manifest: Manifest) -> Iterator[tuple[str, str]]:
    """Yield quantity and name of the moving masses."""
    for part in moving_parts(manifest.rig, manifest.part):
        if part.mass_kg > 0.0 and not part.u_mass_kg:
            yield "mass", part.name
        if part.mass_kg > 0.0 and not part.u_centre_of_mass_m.any():
            yield "centre of mass", part.name
        if part.inertia_kgm2.any() and not np.any(part.u_inertia_kgm2):
            yield "inertia", part.name
