"""One time base for a recording: trigger edges tie the clocks and say when each frame was exposed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fusion.base import ARGUMENT, InputError
from fusion.phasors.results import ClockResult
from fusion.recording.files import DaqRecord
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry, Frames, Images, PointFiles
from fusion.recording.values import PULSE
from shaker.arrays import FloatArray
from shaker.timebase.edges import find_edges
from shaker.timebase.tie import ClockTie, edge_instants, tie_clocks
from shaker.timebase.trigger import PulseWidth, TriggerFit, fit_trigger, pulse_width


@dataclass(frozen=True)
class Exposure:
    """Length of the exposures of a stereo pair and its standard uncertainty, 0 where the manifest states the length."""

    length_s: float
    u_length_s: float = 0.0


@dataclass(frozen=True)
class TimeBase:
    """The clocks of a recording. Time is counted on the first block's clock from its earliest sample.

    `triggers`: per block and trigger channel, in seconds from the block's earliest sample. `ties`: per block, None for
    the first.
    """

    records: tuple[DaqRecord, ...]
    triggers: dict[tuple[str, str], TriggerFit]
    ties: dict[str, ClockTie | None]

    def to_base_s(self, daq: str, time_s: FloatArray) -> FloatArray:
        """Return times of a block's own clock on the first block's clock."""
        tie = self.ties[daq]
        return time_s if tie is None else tie.to_base_s(time_s)

    def u_trigger_s(self, trigger: str) -> float:
        """Return the standard uncertainty of a trigger's fitted instants in the middle of the burst."""
        fit = next(fit for (_, name), fit in self.triggers.items() if name == trigger)
        return float(fit.u_time_s(np.asarray(fit.edges // 2)))

    def u_trigger_rate(self, trigger: str) -> float:
        """Return the relative standard uncertainty of a trigger's fitted period."""
        fit = next(fit for (_, name), fit in self.triggers.items() if name == trigger)
        return float(np.sqrt(fit.covariance[1, 1])) / fit.period_s

    @cached_property
    def pulses(self) -> dict[tuple[str, str], PulseWidth]:
        """Width of the pulses per block and trigger channel, where both flanks can be told."""
        found = {}
        for daq, name in self.triggers:
            try:
                found[daq, name] = self.pulse_width(daq, name)
            except ValueError:
                continue
        return found

    def pulse_width(self, daq: str, trigger: str) -> PulseWidth:
        """Measure the width of a trigger's pulses in a block; a `ValueError` says why it cannot be."""
        record = next(record for record in self.records if record.entry.name == daq)
        return channel_pulse_width(record, trigger)

    def results(self) -> tuple[ClockResult, ...]:
        """Return one entry per block for the result tree."""
        found = []
        for record in self.records:
            name = record.entry.name
            own = [key for key in self.triggers if key[0] == name]
            pulse = self.pulses.get(own[0]) if own else None
            width = (None, None) if pulse is None else (pulse.width_s, pulse.u_width_s)
            trigger = self.triggers[own[0]] if own else None
            found.append(ClockResult(name, record.entry.file, trigger, self.ties[name], *width))
        return tuple(found)


def tie_daqs(manifest: Manifest, records: Sequence[DaqRecord]) -> TimeBase:
    """Find the trigger edges of all blocks and tie every block's clock to the first one's."""
    triggers: dict[tuple[str, str], TriggerFit] = {}
    for record in records:
        for channel in record.entry.channel:
            if channel.quantity == "trigger":
                triggers[record.entry.name, channel.name] = _fit_trigger(record, channel)
    ties: dict[str, ClockTie | None] = {}
    for number, record in enumerate(records):
        ties[record.entry.name] = _tie(manifest, records[0], record, triggers) if number else None
    return TimeBase(tuple(records), triggers, ties)


def channel_pulse_width(record: DaqRecord, trigger: str) -> PulseWidth:
    """Measure the width of the pulses of a trigger channel; a `ValueError` says why it cannot be."""
    channel = next(channel for channel in record.entry.channel if channel.name == trigger)
    rate_hz = record.raw[trigger].sample_rate_hz
    return pulse_width(record.values(channel), rate_hz, channel.threshold, channel.edge)


def _fit_trigger(record: DaqRecord, channel: ChannelEntry) -> TriggerFit:
    """Fit the periodic model to a trigger channel's edges, in seconds from the block's earliest sample."""
    raw = record.raw[channel.name]
    try:
        edges = find_edges(record.values(channel), raw.sample_rate_hz, channel.threshold, channel.edge)
        fit = fit_trigger(edges)
    except ValueError as error:
        raise InputError.told_by(error, record.entry.file, channel.name) from error
    lag = record.lag_s(channel.name) - channel.delay
    return fit.later_by(lag)


def _tie(
    manifest: Manifest, base: DaqRecord, other: DaqRecord, triggers: dict[tuple[str, str], TriggerFit]
) -> ClockTie:
    """Tie a block to the first one by the trigger they share."""
    key = f"daq.{other.entry.name}.channel"
    shared = _shared_triggers(triggers, base.entry.name, other.entry.name)
    if not shared:
        wanted = f"a trigger channel of the same name as in block {base.entry.name}, which ties the two clocks"
        raise InputError(manifest.path, key, found="none", expected=wanted)
    first, second = triggers[base.entry.name, shared[0]], triggers[other.entry.name, shared[0]]
    later_s = _start_difference_s(base, other)
    try:
        return tie_clocks(first, second, other.entry.first_edge, start_difference_s=later_s)
    except ValueError as error:
        raise InputError.told_by(error, manifest.path, f"{key}.{shared[0]}") from error


def _shared_triggers(triggers: dict[tuple[str, str], TriggerFit], first: str, second: str) -> list[str]:
    """Return the triggers that two blocks record; the first of them ties their clocks."""
    return [name for daq, name in triggers if daq == first and (second, name) in triggers]


def _start_difference_s(base: DaqRecord, other: DaqRecord) -> float | None:
    """Return how much later the other record started, None where one of the two states no start time."""
    return other.start_s - base.start_s if base.start_s and other.start_s else None


def exposure_of(manifest: Manifest, base: TimeBase, entry: Images | PointFiles) -> Exposure:
    """Return how long each frame was exposed: as stated, or as long as the first block saw the trigger's pulses."""
    if entry.exposure != PULSE:
        return Exposure(entry.exposure)
    daq, _ = _trigger_of(manifest, base, entry)
    try:
        pulse = base.pulses.get((daq, entry.trigger)) or base.pulse_width(daq, entry.trigger)
    except ValueError as error:
        raise no_pulse_width(manifest, daq, entry, error) from error
    return Exposure(pulse.width_s, pulse.u_width_s)


def no_pulse_width(manifest: Manifest, daq: str, entry: Frames, error: ValueError) -> InputError:
    """Say at the key that asked for it why the width of a trigger's pulses cannot be measured."""
    file, key = manifest.path, f"{'images' if isinstance(entry, Images) else 'points'}.{entry.stereo}.exposure"
    if manifest.rig.stereo[entry.stereo].exposure == PULSE:
        file, key = manifest.rig_path, f"stereo.{entry.stereo}.exposure"
    reason = ARGUMENT.sub("", str(error), count=1)
    found = f'"{PULSE}", but the width of the pulses of {entry.trigger} in {daq} cannot be told ({reason})'
    return InputError(file, key, found=found, expected="the exposure in s")


def exposure_middles(manifest: Manifest, base: TimeBase, entry: Images | PointFiles, frames: int) -> FloatArray:
    """Return the middle of each frame's exposure (F,) on the first block's clock: edge + delay + exposure / 2.

    The edge is the periodic model's where the trigger has no jitter, and follows what was seen of it where it has.
    """
    daq, trigger = _trigger_of(manifest, base, entry)
    key = f"{'images' if isinstance(entry, Images) else 'points'}.{entry.stereo}.first_edge"
    if entry.first_edge is None and trigger.edges > frames:
        wanted = f"the number of the edge that belongs to the first of {frames} frames"
        found = f"none, and {trigger.edges} edges in {entry.trigger}"
        raise InputError(manifest.path, key, found=found, expected=wanted)
    first = entry.first_edge or 0
    if first + frames > trigger.edges:
        wanted = f"at least {first + frames} edges in {entry.trigger} for {frames} frames"
        raise InputError(
            manifest.path, key.removesuffix("first_edge") + "trigger", found=str(trigger.edges), expected=wanted
        )
    edges = edge_instants(trigger, first + np.arange(frames), _seen_elsewhere(base, daq, entry.trigger))
    exposure = exposure_of(manifest, base, entry)
    return np.asarray(base.to_base_s(daq, edges.time_s) + entry.delay + exposure.length_s / 2.0)


def _seen_elsewhere(base: TimeBase, daq: str, trigger: str) -> list[tuple[TriggerFit, ClockTie]]:
    """Return what other blocks saw of the edges of a block's trigger, where these edges tie them to it."""
    if daq != base.records[0].entry.name:
        return []
    found = []
    for other, tie in base.ties.items():
        if tie is not None and _shared_triggers(base.triggers, daq, other)[:1] == [trigger]:
            found.append((base.triggers[other, trigger], tie))
    return found


def _trigger_of(manifest: Manifest, base: TimeBase, entry: Images | PointFiles) -> tuple[str, TriggerFit]:
    """Return the first block that records the trigger named, and its fit."""
    for (daq, name), fit in base.triggers.items():
        if name == entry.trigger:
            return daq, fit
    expected = "a trigger channel of a daq block"
    raise InputError(manifest.path, f"images.{entry.stereo}.trigger", found=entry.trigger, expected=expected)
