"""The DAQ blocks of a recording as read from their files, checked for what a user can get wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.errors import InputError
from fusion.manifest import ChannelEntry, Daq, Manifest
from shaker.signals.files import read_channels
from shaker.signals.recording import RawChannel

FloatArray = NDArray[np.float64]


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


def read_daqs(manifest: Manifest) -> tuple[DaqRecord, ...]:
    """Read every DAQ block of a recording; raises `InputError` naming file and channel."""
    return tuple(_read_daq(manifest, daq) for daq in manifest.daq)


def _read_daq(manifest: Manifest, daq: Daq) -> DaqRecord:
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
