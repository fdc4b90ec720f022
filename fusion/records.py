"""The DAQ blocks of a recording as read from their files, take by take, checked for what a user can get wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.errors import ComputeError, InputError
from fusion.manifest import ChannelEntry, Daq, Manifest
from fusion.scans import split_scan
from shaker._checks import FloatArray
from shaker.signals.files import read_channels
from shaker.signals.recording import RawChannel


@dataclass(frozen=True)
class DaqRecord:
    """One DAQ block: its manifest entry, its channels by name, and the file's start time (s) of the earliest sample."""

    entry: Daq
    raw: dict[str, RawChannel]
    start_s: float

    def lag_s(self, name: str) -> float:
        """Return the time of a channel's first sample, seconds from the block's earliest sample."""
        return self.raw[name].start_s - self.start_s

    def time_s(self, name: str) -> FloatArray:
        """Return the times (S,) of a channel's samples, seconds from the block's earliest sample on its own clock."""
        raw = self.raw[name]
        return np.asarray(self.lag_s(name) + np.arange(len(raw.samples)) / raw.sample_rate_hz)

    def values(self, channel: ChannelEntry) -> FloatArray:
        """Return the samples (S,) of a channel times its scale: SI of its quantity."""
        return np.asarray(self.raw[channel.name].samples * channel.scale)


@dataclass(frozen=True)
class TakeRecords:
    """What was recorded at once: its share of the manifest, its DAQ blocks, and its place in recording.toml."""

    manifest: Manifest
    records: tuple[DaqRecord, ...]
    where: str


def read_daqs(manifest: Manifest) -> tuple[DaqRecord, ...]:
    """Read every DAQ block of what was recorded at once; raises `InputError` naming file and channel."""
    return tuple(_read_daq(manifest, daq) for daq in manifest.daq)


def read_takes(manifest: Manifest) -> tuple[TakeRecords, ...]:
    """Read a recording take by take: its top level, then every `[[take]]`, a scan of several points point by point."""
    return tuple(found for where, part in take_blocks(manifest) for found in _read_block(where, part))


def take_blocks(manifest: Manifest) -> list[tuple[str, Manifest]]:
    """Return the top level of a recording, where it holds anything, and every `[[take]]`, each with its key prefix."""
    blocks = [("", replace(manifest, take=()))] if manifest.daq or not manifest.take else []
    for number, take in enumerate(manifest.take, 1):
        part = replace(manifest, daq=take.daq, images=take.images, points=take.points, take=())
        blocks.append((f"take[{number}].", part))
    return blocks


@contextmanager
def told_in(path: Path, where: str, name: str = "") -> Iterator[None]:
    """Say in which take of the recording `path` something went wrong: its place there, its name elsewhere."""
    try:
        yield
    except InputError as error:
        inside = error.file == path and error.key.split(".")[0] in ("daq", "images", "points")
        key = where + error.key if inside else error.key
        raise InputError(error.file, key, error.found, error.expected, error.more) from error
    except ComputeError as error:
        raise ComputeError(f"{name}: {error}" if name else str(error)) from error


def _read_block(where: str, part: Manifest) -> list[TakeRecords]:
    """Read a block of a manifest: one take, or one for each point of its scan."""
    found = []
    with told_in(part.path, where):
        for manifest, point in split_scan(part):
            scanned = None if point is None else DaqRecord(point.daq, point.raw, 0.0)
            records = tuple(_read_daq(manifest, daq, scanned) for daq in manifest.daq)
            found.append(TakeRecords(manifest, records, where))
    return found


def _read_daq(manifest: Manifest, daq: Daq, scanned: DaqRecord | None = None) -> DaqRecord:
    """Read and check a block; the point of a scan has been read and is checked only."""
    if scanned is not None and scanned.entry is daq:
        for entry in daq.channel:
            _check_samples(daq, entry, scanned.raw[entry.name])
        return scanned
    names = [channel.name for channel in daq.channel]
    try:
        raw = read_channels(daq.file, names, daq.sample_rate)
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, manifest.path, f"daq.{daq.name}.file") from error
    for entry in daq.channel:
        _check_samples(daq, entry, raw[entry.name])
    return DaqRecord(daq, raw, min(channel.start_s for channel in raw.values()))


def _check_samples(daq: Daq, entry: ChannelEntry, channel: RawChannel) -> None:
    """Refuse an empty channel, samples that are not numbers, and a channel that has measured nothing."""
    name = entry.name
    if len(channel.samples) < 2:
        raise InputError(daq.file, name, found=str(len(channel.samples)), expected="at least 2 samples")
    bad = np.flatnonzero(~np.isfinite(channel.samples))
    if len(bad):
        found = f"{len(bad)} of {len(channel.samples)} not finite, the first at sample {bad[0]}"
        raise InputError(daq.file, name, found=found, expected="finite samples")
    if entry.quantity != "trigger" and np.ptp(channel.samples) == 0.0:
        raise InputError(daq.file, name, found=f"{channel.samples[0]:g} throughout", expected="samples that change")
