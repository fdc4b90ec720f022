"""What was recorded, read from its files: DAQ records, the points of a scan."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from fusion.errors import ComputeError, InputError, as_input_error
from fusion.instruments.transducer import TRANSDUCERS, aim_contradiction
from fusion.recording.excitation import KINDS
from fusion.recording.manifest import SCAN, ChannelEntry, Daq, Frames
from fusion.recording.recording_notices import (
    CONSTANT_CHANNEL,
    CONTRADICTING_DIRECTION,
    NON_FINITE_SAMPLES,
    NONUNIFORM_SAMPLES,
    ONE_SCAN_EXPECTED,
    REPEATED_NAME,
    TOO_FEW_SAMPLES,
    UNKNOWN_DATA_SET,
    UNREADABLE_DAQ_FILE,
)
from fusion.recording.units import in_stated_units
from shaker.arrays import FloatArray, Stacked
from shaker.io import read_channels
from shaker.io.channel import RawChannel
from shaker.io.condition import Defect, examine_samples
from shaker.timebase.edges import find_edges
from shaker.timebase.trigger import PulseWidth, TriggerFit, fit_trigger, pulse_width

if TYPE_CHECKING:
    from fusion.recording.load import Manifest
    from photogram.images.sequence import ImageSequence
    from shaker.io.text import VibrometerScan

# DAQ blocks as read from their files, one set-up after another, checked for what a user can get wrong.


def check_uniform(file: Path, name: str, raw: RawChannel) -> None:
    """Raise `InputError` for a channel of a file whose samples are not uniform, naming its first gap."""
    gap = raw.gap
    if gap is not None:
        raise InputError(NONUNIFORM_SAMPLES, file, name, found=gap, expected="uniform sampling")


@dataclass(frozen=True)
class DaqRecord:
    """One DAQ block: its manifest entry, its channels by name, and the file's start time (s) of the earliest sample.

    `slowest_hz`: the lowest driven frequency of a periodic motion, which tells a stretch without signal from a rest.
    """

    entry: Daq
    raw: dict[str, RawChannel]
    start_s: float
    slowest_hz: float | None = field(default=None, kw_only=True)
    _defects: dict[str, tuple[Defect, ...]] = field(default_factory=dict, init=False, repr=False, compare=False)
    _triggers: dict[str, TriggerFit] = field(default_factory=dict, init=False, repr=False, compare=False)
    _pulses: dict[str, PulseWidth | ValueError] = field(default_factory=dict, init=False, repr=False, compare=False)

    def lag_s(self, name: str) -> float:
        """Return the time of a channel's first sample, seconds from the block's earliest sample."""
        return self.raw[name].start_s - self.start_s

    def time_s(self, name: str) -> FloatArray:
        """Return the times (S,) of a channel's samples, seconds from the block's earliest sample on its own clock."""
        return np.asarray(self.lag_s(name) + self.raw[name].time_s)

    def values(self, channel: ChannelEntry) -> FloatArray:
        """Return the samples (S,) of a channel times its scale: SI of its quantity."""
        return np.asarray(self.raw[channel.name].samples * channel.scale)

    def check_uniform(self, channels: Iterable[ChannelEntry]) -> None:
        """Raise `InputError` for a channel whose samples are not uniform, naming its first gap."""
        for channel in channels:
            check_uniform(self.entry.file, channel.stored_name, self.raw[channel.name])

    @property
    def gaps(self) -> tuple[str, ...]:
        """Return a sentence for channels that are not sampled uniformly, those with the same times together."""
        alike: dict[str, list[str]] = {}
        for name, raw in self.raw.items():
            if raw.gap is not None:
                alike.setdefault(raw.gap, []).append(name)
        return tuple(f"{', '.join(names)}: samples are not uniform, {gap}" for gap, names in alike.items())

    def stacked(self, channels: Sequence[ChannelEntry]) -> Stacked:
        """Return channels sampled alike side by side, (S, C), in SI of their quantities."""
        columns = tuple(self.raw[channel.name].samples for channel in channels)
        return Stacked(columns, tuple(channel.scale for channel in channels))

    def defects(self, channel: ChannelEntry) -> tuple[Defect, ...]:
        """Return which samples of a channel are lost or clipped, examined once; none of a trigger."""
        if channel.quantity == "trigger":
            return ()
        if channel.name not in self._defects:
            raw = self.raw[channel.name]
            found = examine_samples(raw.samples, raw.sample_rate_hz, frequency_hz=self.slowest_hz)
            self._defects[channel.name] = tuple(found)
        return self._defects[channel.name]

    def usable_samples(self, channels: Sequence[ChannelEntry]) -> Stacked:
        """Return channels as `stacked`, NaN where samples are lost or clipped."""
        stacked = self.stacked(channels)
        columns = list(stacked.columns)
        for c, channel in enumerate(channels):
            for defect in self.defects(channel):
                columns[c] = np.where(defect.mask(len(columns[c])), np.nan, columns[c])
        return replace(stacked, columns=tuple(columns))

    def fit_trigger(self, channel: ChannelEntry) -> TriggerFit:
        """Fit the edges of a trigger channel, once, in seconds from its first sample."""
        if channel.name not in self._triggers:
            rate_hz = self.raw[channel.name].sample_rate_hz
            edges = find_edges(self.values(channel), rate_hz, channel.threshold, channel.edge)
            self._triggers[channel.name] = fit_trigger(edges)
        return self._triggers[channel.name]

    def pulse_width(self, trigger: str) -> PulseWidth:
        """Measure the width of the pulses of a trigger channel, once; a `ValueError` says why it cannot be."""
        if trigger not in self._pulses:
            channel = next(channel for channel in self.entry.channel if channel.name == trigger)
            given = self.values(channel), self.raw[trigger].sample_rate_hz, channel.threshold, channel.edge
            try:
                self._pulses[trigger] = pulse_width(*given, self.fit_trigger(channel))
            except ValueError as error:
                self._pulses[trigger] = error
        found = self._pulses[trigger]
        if isinstance(found, ValueError):
            raise found
        return found


# A scanning vibrometer's text in a recording: every scan point is a take of its own.


AnyFrames = TypeVar("AnyFrames", bound=Frames)


@dataclass(frozen=True)
class ScannedPoint(DaqRecord):
    """One point of a scan: the DAQ block as it was there, its channels named by their block alone.

    `number`: as channels name the point, counted from "1".
    """

    number: str


def scanned_points(manifest: Manifest, daq: Daq) -> tuple[ScannedPoint, ...] | None:
    """Return the points that a block of a scan holds, in the order of the scan; None for any other file.

    A channel that names its block alone was recorded at every point. A velocity or displacement that does so, and is
    not the reference, is what looked at the points: its `point` is where the origin of the file's coordinates lies in
    the sensor frame, whose axes they share. All others stand at their own.
    """
    if daq.file.suffix.lower() != SCAN:
        return None
    from shaker.io.text import read_scan_asc

    with as_input_error(manifest.path, f"daq.{daq.name}.file", UNREADABLE_DAQ_FILE):
        scan = read_scan_asc(daq.file)
    if len(scan.point_m) == 1:
        return None
    present = [str(number + 1) for number in range(len(scan.point_m))]
    sets = [daq.data_set(entry) for entry in daq.channel]
    for entry, (block, point) in zip(daq.channel, sets, strict=True):
        if point and (block, "") in sets:
            found = f"{block} beside it, which is recorded at every point"
            raise InputError(
                REPEATED_NAME,
                manifest.path,
                f"daq.{daq.name}.channel.{entry.name}",
                found=found,
                expected="each data set once",
            )
        if point not in ("", *present) or block not in scan.channels_at(0):
            expected = f"block/point of {len(scan.samples)} blocks and {len(present)} points, or a block alone"
            raise InputError(UNKNOWN_DATA_SET, daq.file, entry.name, found="no such data set", expected=expected)
    named = {point for _, point in sets}
    points = tuple(_point(daq, scan, place) for place, point in enumerate(present) if named & {"", point})
    for entry, number in ((entry, point.number) for point in points for entry in point.entry.channel):
        wrong = aim_contradiction(entry)
        if wrong is not None:
            key = f"daq.{daq.name}.channel.{entry.name}.direction"
            raise InputError(
                CONTRADICTING_DIRECTION, manifest.path, key, found=f"at point {number} {wrong[1]}", expected=wrong[0]
            )
    return points


def split_scan(manifest: Manifest) -> Iterator[tuple[Manifest, ScannedPoint | None]]:
    """Yield what was recorded at once of a block of a manifest: itself, or one part for each point of its scan.

    What was recorded beside a scan belongs to its first point, images and points whose trigger names a point to that.
    """
    scans = {daq.name: points for daq in manifest.daq if (points := scanned_points(manifest, daq)) is not None}
    if len(scans) > 1:
        found, expected = f"{len(scans)}: {', '.join(scans)}", "one scan of several points at a time"
        raise InputError(ONE_SCAN_EXPECTED, manifest.path, "daq", found=found, expected=expected)
    if not scans:
        yield manifest, None
    for name, points in scans.items():
        for point in points:
            first = point is points[0]
            daq = tuple(
                point.entry if block.name == name else block for block in manifest.daq if first or block.name == name
            )
            images = tuple(_of_point(manifest.images, point, first))
            tables = tuple(_of_point(manifest.points, point, first))
            yield replace(manifest, daq=daq, images=images, points=tables), point


def _of_point(frames: Sequence[AnyFrames], point: ScannedPoint, first: bool) -> Iterator[AnyFrames]:
    """Yield the images or points of a scan point, their trigger named as its channels are."""
    for entry in frames:
        block, slash, number = entry.trigger.partition("/")
        if slash and block in point.raw and number.isdecimal():
            if number == point.number:
                yield entry.model_copy(update={"trigger": block})
        elif first:
            yield entry


def _point(daq: Daq, scan: VibrometerScan, place: int) -> ScannedPoint:
    """Return what a block holds at a scan point, by its place, its channels named by their block alone."""
    entries = []
    for entry in daq.channel:
        block, point = daq.data_set(entry)
        if point not in ("", str(place + 1)):
            continue
        changes: dict[str, object] = {"name": block}
        looked_at_points = (
            not point
            and not entry.reference
            and entry.quantity in TRANSDUCERS
            and TRANSDUCERS[entry.quantity].kind == "vibrometer"
        )
        if entry.point is not None and looked_at_points:
            changes["point"] = tuple((np.asarray(entry.point, dtype=np.float64) + scan.point_m[place]).tolist())
        entries.append(entry.model_copy(update=changes))
    samples = scan.channels_at(place)
    raw = {entry.name: samples[entry.name] for entry in entries}
    return ScannedPoint(daq.model_copy(update={"channel": tuple(entries)}), raw, 0.0, str(place + 1))


# What was recorded, one set-up after another.


@dataclass(frozen=True)
class FileCache:
    """What was read of a recording's files, to be used again where they are read on: channels by set-up and block,
    images of a camera by their paths and the bit depth that is stated."""

    channels: dict[tuple[str, str], dict[str, RawChannel]] = field(default_factory=dict)
    images: dict[tuple[tuple[Path, ...], int | None], ImageSequence] = field(default_factory=dict)


@dataclass(frozen=True)
class SetUpRecords:
    """What was recorded at once: its share of the manifest, its DAQ blocks, and its place in recording.toml."""

    manifest: Manifest
    records: tuple[DaqRecord, ...]
    where: str


def read_daqs(manifest: Manifest) -> tuple[DaqRecord, ...]:
    """Read every DAQ block of what was recorded at once; raises `InputError` naming file and channel."""
    return tuple(_read_daq(manifest, daq) for daq in manifest.daq)


def read_set_ups(manifest: Manifest, cache: FileCache | None = None) -> tuple[SetUpRecords, ...]:
    """Read a recording set-up by set-up: its top level, then every `[[take]]`, of a scan point by point."""
    set_ups, read = [], {} if cache is None else cache.channels
    for where, block in manifest.set_ups:
        with errors_in_set_up(manifest.path, where):
            for part, point in split_scan(block):
                records = tuple(
                    _read_daq(part, daq, point, read.get((where, daq.name)), part.excitation.slowest_hz)
                    for daq in part.daq
                )
                set_ups.append(SetUpRecords(part, records, where))
    return tuple(set_ups)


@contextmanager
def errors_in_set_up(path: Path, where: str, name: str = "") -> Iterator[None]:
    """Say in which set-up of the recording `path` something went wrong: its place there, its name elsewhere."""
    try:
        yield
    except InputError as error:
        inside = error.file == path and error.key.split(".")[0] in ("daq", "images", "points")
        key = where + error.key if inside else error.key
        raise error.at(key) from error
    except ComputeError as error:
        raise (error.at(name) if name else error) from error


def recorded_channels(manifest: Manifest, daq: Daq) -> dict[str, RawChannel]:
    """Read the channels of a block from its file, each by the name that the recording gives it (`in_stated_units`)."""
    stored = read_channels(daq.file, [entry.stored_name for entry in daq.channel], daq.sample_rate)
    named = {entry.name: stored[entry.stored_name] for entry in daq.channel}
    return in_stated_units(manifest, daq, named)


def _read_daq(
    manifest: Manifest,
    daq: Daq,
    point: ScannedPoint | None = None,
    raw: dict[str, RawChannel] | None = None,
    slowest_hz: float | None = None,
) -> DaqRecord:
    """Read and check a block; what has been read, the point of a scan or `raw` channels, is checked only.

    With the frequency of a periodic motion, samples may be missing.
    """
    if point is not None and point.entry is daq:
        record: DaqRecord = replace(point, slowest_hz=slowest_hz)
    else:
        with as_input_error(manifest.path, f"daq.{daq.name}.file", UNREADABLE_DAQ_FILE):
            raw = recorded_channels(manifest, daq) if raw is None else raw
        start_s = min(channel.start_s for channel in raw.values())
        record = DaqRecord(daq, raw, start_s, slowest_hz=slowest_hz)
    for entry in daq.channel:
        gaps = slowest_hz is not None and entry.quantity != "trigger"
        _check_samples(daq, entry, record.raw[entry.name], gaps=gaps)
    every = KINDS[manifest.excitation.kind].needs_uniform_samples
    record.check_uniform(entry for entry in daq.channel if every or entry.quantity == "trigger")
    return record


def _check_samples(daq: Daq, entry: ChannelEntry, channel: RawChannel, *, gaps: bool) -> None:
    """Refuse an empty channel, samples that are not numbers unless there may be `gaps`, and a dead channel."""
    name, samples = entry.stored_name, channel.samples
    if len(samples) < 2:
        raise InputError(TOO_FEW_SAMPLES, daq.file, name, found=str(len(samples)), expected="at least 2 samples")
    bad = np.flatnonzero(~np.isfinite(samples))
    if len(bad) and gaps and len(samples) - len(bad) > 1:
        samples = np.delete(samples, bad)
    elif len(bad):
        found = f"{len(bad)} of {len(channel.samples)} not finite, the first at sample {bad[0]}"
        raise InputError(NON_FINITE_SAMPLES, daq.file, name, found=found, expected="finite samples")
    if entry.quantity != "trigger" and np.ptp(samples) == 0.0:
        raise InputError(
            CONSTANT_CHANNEL, daq.file, name, found=f"{samples[0]:g} throughout", expected="samples that change"
        )
