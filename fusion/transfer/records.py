"""Reference and responses of a recording on one clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.channels import channel_unit
from fusion.errors import InputError
from fusion.manifest import ChannelEntry, Manifest
from fusion.records import DaqRecord, read_daqs
from shaker.signals.transfer import TransferRecord


@dataclass(frozen=True)
class Located:
    """A channel, the block that recorded it, and the uncertainty of that block's tie to the reference's clock."""

    entry: ChannelEntry
    record: DaqRecord
    u_clock_s: float


@dataclass(frozen=True)
class Together:
    """One reference and its responses with their samples; `base` where clocks had to be tied."""

    reference: Located
    responses: tuple[Located, ...]
    samples: TransferRecord
    base: None


def read_together(manifest: Manifest) -> tuple[Together, ...]:
    """Read the channels that the excitation names; one entry per reference.

    Without `response` every other channel but triggers is one. Raises `InputError`.
    """
    excitation = manifest.excitation
    if not excitation.reference:
        expected = "the name of the channel over which the others are taken, such as the force or the base acceleration"
        raise InputError(manifest.path, "excitation.reference", found="nothing", expected=expected)
    places = _places(manifest)
    named = excitation.response or [name for name in places if name not in excitation.reference]
    if not named:
        expected = "a channel beside the reference"
        raise InputError(manifest.path, "excitation.response", found="none", expected=expected)
    for key, names in (("reference", excitation.reference), ("response", named)):
        for name in names:
            _check_named(manifest, key, name, places)
    records = {record.entry.name: record for record in read_daqs(manifest)}
    return tuple(_together(manifest, records, places, name, named) for name in excitation.reference)


def _places(manifest: Manifest) -> dict[str, list[tuple[str, ChannelEntry]]]:
    """Return where a name is found: blocks and entries of the channels that are no triggers."""
    found: dict[str, list[tuple[str, ChannelEntry]]] = {}
    for daq in manifest.daq:
        for entry in daq.channel:
            if entry.quantity != "trigger":
                found.setdefault(entry.name, []).append((daq.name, entry))
    return found


def _check_named(manifest: Manifest, key: str, name: str, places: dict[str, list[tuple[str, ChannelEntry]]]) -> None:
    """Refuse a name that is a trigger's, that two blocks have, or that is reference and response at once."""
    where = places.get(name, [])
    if len(where) != 1:
        blocks = " and ".join(block for block, _ in where)
        found = f'"{name}", which is in the blocks {blocks}' if where else f'"{name}", a trigger'
        raise InputError(manifest.path, f"excitation.{key}", found=found, expected="a name that one channel has")
    if key == "response" and name in manifest.excitation.reference:
        expected = "other channels than the references"
        raise InputError(manifest.path, "excitation.response", found=f'"{name}"', expected=expected)


def _together(
    manifest: Manifest,
    records: dict[str, DaqRecord],
    places: dict[str, list[tuple[str, ChannelEntry]]],
    reference: str,
    responses: Sequence[str],
) -> Together:
    """Return a reference and its responses, all of which one block has recorded alike."""
    block, entry = places[reference][0]
    record = records[block]
    model = record.raw[reference]
    for name in responses:
        other, _ = places[name][0]
        raw = records[other].raw[name]
        same = (raw.sample_rate_hz, raw.start_s, len(raw.samples)) == (
            model.sample_rate_hz,
            model.start_s,
            len(model.samples),
        )
        if other != block or not same:
            expected = f"channels recorded in one block at one rate with the reference {reference}"
            found = f'"{name}" of block {other}'
            raise InputError(manifest.path, "excitation.response", found=found, expected=expected)
    located = tuple(Located(places[name][0][1], record, 0.0) for name in responses)
    samples = TransferRecord(
        reference=record.values(entry),
        responses=np.stack([record.values(item.entry) for item in located], axis=1),
        sample_rate_hz=model.sample_rate_hz,
        reference_name=reference,
        reference_unit=channel_unit(manifest, entry),
        channels=tuple(responses),
        unit=tuple(channel_unit(manifest, item.entry) for item in located),
    )
    return Together(Located(entry, record, 0.0), located, samples, None)
