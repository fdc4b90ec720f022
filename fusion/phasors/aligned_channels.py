"""Channels of several clocks and rates at common, uniform times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.errors import InputError
from fusion.phasors.phasor_notices import (
    CHANNELS_NOT_SIMULTANEOUS,
    CHANNELS_RESAMPLED,
    COARSE_CONVERTER_STEPS,
    DEFECTIVE_SAMPLES,
)
from fusion.phasors.timing import TimeBase, tie_daqs
from fusion.recording.daq_records import DaqRecord
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.units import unit_notices
from shaker.io.condition import examine_samples
from shaker.timebase.edges import PASS_BAND, kernel_reach, resample
from shaker.timebase.tie import ClockTie
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

LASTING = ("noise", "multisine")
"""Kinds of excitation that never rest."""
ENDS, QUIET = 100, 0.1
"""Parts of a record of which the first and the last one are at rest; their range over that of the record."""
SLOWEST, DITHERED = 100.0, 10.0
"""Samples of a period where no band is stated; how many times fewer steps suffice for a signal that dithers itself."""


@dataclass(frozen=True)
class LocatedChannel:
    """A channel, the block that recorded it, and the clocks if they were tied."""

    entry: ChannelEntry
    record: DaqRecord
    base: TimeBase | None

    @property
    def tie(self) -> ClockTie | None:
        """The tie of the block to the first clock, None if it uses that clock."""
        return None if self.base is None else self.base.ties[self.record.entry.name]

    @property
    def u_clock_s(self) -> float:
        """Standard uncertainty of the tie in the middle of the record."""
        middle_s = np.asarray(self.record.time_s(self.entry.name).mean())
        return 0.0 if self.tie is None else float(self.tie.u_to_base_s(middle_s))

    @property
    def rate_hz(self) -> float:
        """Sampling rate on the clock of the block."""
        return self.record.raw[self.entry.name].sample_rate_hz

    @property
    def length(self) -> int:
        """Number of samples."""
        return len(self.record.raw[self.entry.name].samples)

    def position(self, time_s: FloatArray) -> FloatArray:
        """Return the positions of times of the first clock in the channel's record, in samples."""
        in_block_s = time_s if self.tie is None else (time_s - self.tie.offset_s) / self.tie.rate
        return np.asarray((in_block_s - self.record.lag_s(self.entry.name)) * self.rate_hz)


@dataclass(frozen=True)
class AlignedChannels:
    """Channels with samples (N,) at common times, from `start_s` of the first clock at `rate_hz`.

    `highest_hz`: limit of their use after resampling, None without resampling. `base`: the clocks if they were tied.
    """

    channels: tuple[LocatedChannel, ...]
    values: tuple[FloatArray, ...]
    rate_hz: float
    start_s: float
    highest_hz: float | None
    base: TimeBase | None
    notices: tuple[Notice, ...]


def align(
    manifest: Manifest,
    records: Sequence[DaqRecord],
    selected: Sequence[tuple[str, ChannelEntry]],
    key: str,
    tied: TimeBase | None = None,
) -> AlignedChannels:
    """Return channels as sampled simultaneously, or on a common grid.

    `selected`: each with the name of its block. `tied`: the clocks, None to tie those of several blocks.

    Raises `InputError` at `key` for records that do not overlap, and for a channel with clipped or lost samples.
    """
    blocks = {record.entry.name: record for record in records}
    for block, entry in selected:
        blocks[block].check_uniform([entry])
    used = dict.fromkeys(block for block, _ in selected)
    base = tied if len(used) > 1 else None
    if len(used) > 1 and base is None:
        base = tie_daqs(manifest, [record for record in records if record is records[0] or record.entry.name in used])
    channels = tuple(LocatedChannel(entry, blocks[name], base) for name, entry in selected)
    coarse = [notice for channel in channels for notice in _condition(manifest, channel)]
    coarse += [notice for name in used for notice in unit_notices(manifest, blocks[name].entry, blocks[name].raw)]
    samplings = {(c.record.entry.name, c.rate_hz, c.record.lag_s(c.entry.name), c.length) for c in channels}
    recorded = tuple(c.record.values(c.entry) for c in channels)
    if len(samplings) == 1:
        start_s = channels[0].record.lag_s(channels[0].entry.name)
        return AlignedChannels(channels, recorded, channels[0].rate_hz, start_s, None, base, tuple(coarse))
    slowest = min(channels, key=lambda channel: channel.rate_hz)
    time_s, rate_hz = _common_times(channels, slowest)
    if len(time_s) < 2 * len(channels):
        raise InputError(CHANNELS_NOT_SIMULTANEOUS, manifest.path, key)
    values = tuple(
        resample(samples, c.position(time_s), min(1.0, rate_hz / c.rate_hz))
        for c, samples in zip(channels, recorded, strict=True)
    )
    name, highest_hz = slowest.entry.name, PASS_BAND * rate_hz
    resampled = Notice(CHANNELS_RESAMPLED, name, channel=name, rate_hz=rate_hz, highest_hz=highest_hz)
    notices = resampled, *coarse
    return AlignedChannels(channels, values, rate_hz, float(time_s[0]), highest_hz, base, notices)


def _condition(manifest: Manifest, channel: LocatedChannel) -> Iterator[Notice]:
    """Refuse a channel with clipped or lost samples; yield a notice of coarse converter steps."""
    entry, raw, excitation = channel.entry, channel.record.raw[channel.entry.name], manifest.excitation
    # Constant samples are a defect only of signals that never rest.
    bursts = channel.record.entry.repeats or (excitation.kind == "noise" and _rests(raw.samples))
    lasting = excitation.kind in LASTING and not bursts
    slowest_hz = (excitation.band or (0.0,))[0] or channel.rate_hz / SLOWEST if lasting else None
    size = DITHERED * float(np.std(raw.samples)) if lasting else float(np.ptp(raw.samples)) / 2.0
    for defect in examine_samples(raw.samples, raw.sample_rate_hz, size, slowest_hz):
        if defect.kind == "clipped" and excitation.kind in ("step", "impact"):
            continue  # outputs of a release and single blows are rejected by their evaluation
        if defect.kind != "steps":
            text = defect.text(channel.record.time_s(entry.name), raw.unit)
            raise InputError(DEFECTIVE_SAMPLES, channel.record.entry.file, entry.stored_name, defect=text)
        yield Notice(
            COARSE_CONVERTER_STEPS,
            entry.name,
            measure="standard deviation" if lasting else "range",
            size=size / (DITHERED if lasting else 0.5),
            unit=f" {raw.unit}" if raw.unit else "",
            step=defect.step,
        )


def _rests(samples: FloatArray) -> bool:
    """Return whether a signal begins and ends at rest, as a burst does."""
    ends = max(2, len(samples) // ENDS)
    largest = QUIET * float(np.ptp(samples))
    return bool(np.ptp(samples[:ends]) < largest and np.ptp(samples[-ends:]) < largest)


def _common_times(channels: Sequence[LocatedChannel], slowest: LocatedChannel) -> tuple[FloatArray, float]:
    """Return times (T,) of the slowest channel within all records, and their rate."""
    time_s, rate_hz, tie = slowest.record.time_s(slowest.entry.name), slowest.rate_hz, slowest.tie
    if tie is not None:
        time_s, rate_hz = tie.to_base_s(time_s), rate_hz / tie.rate
    inside = np.ones(len(time_s), dtype=np.bool_)
    for channel in channels:
        position = channel.position(time_s)
        reach = kernel_reach(min(1.0, rate_hz / channel.rate_hz))
        inside &= (position >= reach) & (position <= channel.length - 1 - reach)
    return time_s[inside], rate_hz
