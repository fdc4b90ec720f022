"""One time base for a recording: trigger edges tie the clocks and say when each frame was exposed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import ARGUMENT, InputError, as_input_error
from fusion.instruments.stereo import Exposure
from fusion.recording.manifest import Frames, Images, PointFiles
from fusion.recording.rig import Stereo
from fusion.recording.values import PULSE
from shaker.arrays import FloatArray
from shaker.timebase.edges import find_edges
from shaker.timebase.tie import ClockTie, edge_instants, tie_clocks
from shaker.timebase.trigger import PulseWidth, TriggerFit, fit_trigger

if TYPE_CHECKING:
    from fusion.recording.files import DaqRecord
    from fusion.recording.load import Manifest


@dataclass(frozen=True)
class Sight:
    """One stereo pair over one recording: how it is placed, how long and when its frames were exposed.

    `pair`: as the rig has it, with what the recording overrides. `time_s` (F,): exposure middles on the first block's
    clock. `where`: file and key at which mistakes of its frames are told.
    """

    name: str
    pair: Stereo
    exposure: Exposure
    time_s: FloatArray
    where: tuple[Path, str]


@dataclass(frozen=True)
class ClockResult:
    """One DAQ block: its file, the trigger found in it and its tie to the first block's clock (None for the first).

    `pulse_width_s`, `u_pulse_width_s`: of the trigger's pulses, None where their ends cannot be told.
    """

    daq: str
    file: Path
    trigger: TriggerFit | None
    tie: ClockTie | None
    pulse_width_s: float | None = None
    u_pulse_width_s: float | None = None


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

    def first_with(self, trigger: str) -> tuple[str, TriggerFit]:
        """Return the first block that records a trigger, and its fit."""
        return next((daq, fit) for (daq, name), fit in self.triggers.items() if name == trigger)

    def u_trigger_s(self, trigger: str) -> float:
        """Return the standard uncertainty of a trigger's fitted instants in the middle of the burst."""
        _, fit = self.first_with(trigger)
        return float(fit.u_time_s(np.asarray(fit.edges // 2)))

    def trigger_dof(self, trigger: str) -> float:
        """Return the degrees of freedom of a trigger's fitted instants: its edges less two, one at least."""
        return float(max(len(self.first_with(trigger)[1].number) - 2, 1))

    def u_trigger_rate(self, trigger: str) -> float:
        """Return the relative standard uncertainty of a trigger's fitted period."""
        _, fit = self.first_with(trigger)
        return float(np.sqrt(fit.covariance[1, 1])) / fit.period_s

    def shared_triggers(self, first: str, second: str) -> list[str]:
        """Return the triggers that two blocks record; the first of them ties their clocks."""
        return [name for daq, name in self.triggers if daq == first and (second, name) in self.triggers]

    @cached_property
    def pulses(self) -> dict[tuple[str, str], PulseWidth]:
        """Width of the pulses per block and trigger channel, where both flanks can be told."""
        widths = {}
        for daq, name in self.triggers:
            with suppress(ValueError):
                widths[daq, name] = self.record(daq).pulse_width(name)
        return widths

    def record(self, daq: str) -> DaqRecord:
        """Return a block by its name."""
        return next(record for record in self.records if record.entry.name == daq)

    def results(self) -> tuple[ClockResult, ...]:
        """Return one entry per block for the result tree."""
        clocks = []
        for record in self.records:
            name = record.entry.name
            key = next((key for key in self.triggers if key[0] == name), ("", ""))
            pulse = self.pulses.get(key)
            width = (None, None) if pulse is None else (pulse.width_s, pulse.u_width_s)
            clocks.append(ClockResult(name, record.entry.file, self.triggers.get(key), self.ties[name], *width))
        return tuple(clocks)


def tie_daqs(manifest: Manifest, records: Sequence[DaqRecord]) -> TimeBase:
    """Find the trigger edges of all blocks and tie every block's clock to the first one's by a trigger they share."""
    base, *others = records
    first = base.entry.name
    triggers: dict[tuple[str, str], TriggerFit] = {}
    for record in records:
        for channel in (channel for channel in record.entry.channel if channel.quantity == "trigger"):
            rate_hz = record.raw[channel.name].sample_rate_hz
            with as_input_error(record.entry.file, channel.name):
                fit = fit_trigger(find_edges(record.values(channel), rate_hz, channel.threshold, channel.edge))
            triggers[record.entry.name, channel.name] = fit.later_by(record.lag_s(channel.name) - channel.delay)
    ties: dict[str, ClockTie | None] = {first: None}
    time_base = TimeBase(tuple(records), triggers, ties)
    for other in others:
        name = other.entry.name
        key = f"daq.{name}.channel"
        shared = time_base.shared_triggers(first, name)
        if not shared:
            wanted = f"a trigger channel of the same name as in block {first}, which ties the two clocks"
            raise InputError(manifest.path, key, found="none", expected=wanted)
        later_s = other.start_s - base.start_s if base.start_s and other.start_s else None
        pair = triggers[first, shared[0]], triggers[name, shared[0]]
        with as_input_error(manifest.path, f"{key}.{shared[0]}"):
            ties[name] = tie_clocks(*pair, other.entry.first_edge, start_difference_s=later_s)
    return time_base


def see(manifest: Manifest, base: TimeBase, entry: Images | PointFiles, frames: int) -> Sight:
    """Return how long and when each of some frames was exposed: its middle is edge + delay + exposure / 2.

    The edge is the periodic model's where the trigger has no jitter, and follows what was seen of it where it has: also
    what other blocks saw of it, where these edges tie them to the trigger's block. The exposure is as stated, or as
    long as the first block saw the trigger's pulses.
    """
    daq, trigger = base.first_with(entry.trigger)
    key = f"{'images' if isinstance(entry, Images) else 'points'}.{entry.stereo}"
    if entry.first_edge is None and trigger.edges > frames:
        wanted = f"the number of the edge that belongs to the first of {frames} frames"
        found = f"none, and {trigger.edges} edges in {entry.trigger}"
        raise InputError(manifest.path, f"{key}.first_edge", found=found, expected=wanted)
    first = entry.first_edge or 0
    if first + frames > trigger.edges:
        wanted = f"at least {first + frames} edges in {entry.trigger} for {frames} frames"
        raise InputError(manifest.path, f"{key}.trigger", found=str(trigger.edges), expected=wanted)
    elsewhere = []
    if daq == base.records[0].entry.name:
        for other, tie in base.ties.items():
            if tie is not None and base.shared_triggers(daq, other)[:1] == [entry.trigger]:
                elsewhere.append((base.triggers[other, entry.trigger], tie))
    edges = edge_instants(trigger, first + np.arange(frames), elsewhere)
    if entry.exposure == PULSE:
        try:
            pulse = base.pulses.get((daq, entry.trigger)) or base.record(daq).pulse_width(entry.trigger)
        except ValueError as error:
            raise no_pulse_width(manifest, daq, entry, error) from error
        dof = float(max(pulse.pulses - 2, 1))
        exposure = Exposure(entry.trigger, pulse.width_s, pulse.u_width_s, dof)
    else:
        exposure = Exposure(entry.trigger, entry.exposure)
    middle_s = base.to_base_s(daq, edges.time_s) + entry.delay + exposure.length_s / 2.0
    pair = manifest.rig.stereo[entry.stereo].model_copy(update={"delay_uncertainty": entry.delay_uncertainty})
    return Sight(entry.stereo, pair, exposure, np.asarray(middle_s), (manifest.path, key))


def no_pulse_width(manifest: Manifest, daq: str, entry: Frames, error: ValueError) -> InputError:
    """Say at the key that asked for it why the width of a trigger's pulses cannot be measured."""
    file, key = manifest.path, f"{'images' if isinstance(entry, Images) else 'points'}.{entry.stereo}.exposure"
    if manifest.rig.stereo[entry.stereo].exposure == PULSE:
        file, key = manifest.rig_path, f"stereo.{entry.stereo}.exposure"
    reason = ARGUMENT.sub("", str(error), count=1)
    found = f'"{PULSE}", but the width of the pulses of {entry.trigger} in {daq} cannot be told ({reason})'
    return InputError(file, key, found=found, expected="the exposure in s")
