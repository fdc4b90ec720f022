"""DAQ records of a recording, read from its files; the points of a scan."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from fusion.errors import ComputeError, InputError, as_input_error
from fusion.recording.excitation import KINDS
from fusion.recording.manifest import SCAN, ChannelEntry, Daq, Frames
from fusion.recording.placement import aim_contradiction
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
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.units import in_stated_units
from shaker.io import read_channels
from shaker.io.channel import RawChannel, Stacked
from shaker.io.condition import Defect, examine_samples
from shaker.timebase.edges import find_edges
from shaker.timebase.trigger import PulseWidth, TriggerFit, fit_trigger, pulse_width
from shakercal._common.arrays import FloatArray

if TYPE_CHECKING:
    from fusion.recording.load import Manifest
    from photogram.images.sequence import ImageSequence
    from shaker.io.text import VibrometerScan

# DAQ blocks as read from their files, one set-up after another, checked.


def check_uniform(file: Path, name: str, raw: RawChannel) -> None:
    """Raise `InputError` with the first gap if the samples of a channel are not uniform."""
    gap = raw.gap
    if gap is not None:
        raise InputError(NONUNIFORM_SAMPLES, file, name, found=gap, expected="uniform sampling")


@dataclass(frozen=True)
class DaqRecord:
    """One DAQ block: manifest entry, channels by name, start time (s) of the earliest sample.

    `slowest_hz`: the lowest driven frequency of a periodic motion. It distinguishes lost samples from a rest.
    """

    entry: Daq
    raw: dict[str, RawChannel]
    start_s: float
    slowest_hz: float | None = field(default=None, kw_only=True)
    _defects: dict[str, tuple[Defect, ...]] = field(default_factory=dict, init=False, repr=False, compare=False)
    _triggers: dict[str, TriggerFit] = field(default_factory=dict, init=False, repr=False, compare=False)
    _pulses: dict[str, PulseWidth | ValueError] = field(default_factory=dict, init=False, repr=False, compare=False)

    def lag_s(self, name: str) -> float:
        """Return the time of a channel's first sample, s from the block's earliest sample."""
        return self.raw[name].start_s - self.start_s

    def time_s(self, name: str) -> FloatArray:
        """Return the times (S,) of a channel's samples, s from the block's earliest sample."""
        return np.asarray(self.lag_s(name) + self.raw[name].time_s)

    def values(self, channel: ChannelEntry) -> FloatArray:
        """Return the samples (S,) of a channel times its scale, in SI units."""
        return np.asarray(self.raw[channel.name].samples * channel.scale)

    def check_uniform(self, channels: Iterable[ChannelEntry]) -> None:
        """Raise `InputError` with the first gap if the samples of a channel are not uniform."""
        for channel in channels:
            check_uniform(self.entry.file, channel.stored_name, self.raw[channel.name])

    @property
    def gaps(self) -> tuple[str, ...]:
        """Sentences on channels that are not sampled uniformly, grouped by their gaps."""
        channels_of: dict[str, list[str]] = {}
        for name, raw in self.raw.items():
            if raw.gap is not None:
                channels_of.setdefault(raw.gap, []).append(name)
        return tuple(f"{', '.join(names)}: samples are not uniform, {gap}" for gap, names in channels_of.items())

    def stacked(self, channels: Sequence[ChannelEntry]) -> Stacked:
        """Return channels with the same sampling as (S, C), in SI units."""
        columns = tuple(self.raw[channel.name].samples for channel in channels)
        return Stacked(columns, tuple(channel.scale for channel in channels))

    def defects(self, channel: ChannelEntry) -> tuple[Defect, ...]:
        """Return the lost or clipped samples of a channel, examined once; none of a trigger."""
        if channel.quantity == "trigger":
            return ()
        if channel.name not in self._defects:
            raw = self.raw[channel.name]
            found = examine_samples(raw.samples, raw.sample_rate_hz, frequency_hz=self.slowest_hz)
            self._defects[channel.name] = tuple(found)
        return self._defects[channel.name]

    def usable_samples(self, channels: Sequence[ChannelEntry]) -> Stacked:
        """Return channels as `stacked`, with NaN for lost or clipped samples."""
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
        """Measure the pulse width of a trigger channel, once; `ValueError` if it is impossible."""
        if trigger not in self._pulses:
            channel = next((channel for channel in self.entry.channel if channel.name == trigger), None)
            if channel is None:
                raise ValueError(f"{trigger}: expected a recorded trigger, found a frame rate")
            signal = self.values(channel), self.raw[trigger].sample_rate_hz, channel.threshold, channel.edge
            try:
                self._pulses[trigger] = pulse_width(*signal, self.fit_trigger(channel))
            except ValueError as error:
                self._pulses[trigger] = error
        found = self._pulses[trigger]
        if isinstance(found, ValueError):
            raise found
        return found


# The text file of a scanning vibrometer: every scan point is a separate set-up.


AnyFrames = TypeVar("AnyFrames", bound=Frames)


@dataclass(frozen=True)
class ScannedPoint(DaqRecord):
    """One point of a scan: its DAQ block, with channels named by their block only.

    `number`: of the point in channel names, from "1".
    """

    number: str


def scanned_points(manifest: Manifest, daq: Daq) -> tuple[ScannedPoint, ...] | None:
    """Return the points of a scan in their order; None for other files.

    A channel that names only its block was recorded at every point. If it is a velocity or displacement and not the
    reference, it measured at the points. Its `point` is then the origin of the file's coordinates in the sensor frame,
    with the same axes. All other channels have a fixed point.
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
            found = f"{block} as well, which is recorded at every point"
            raise InputError(
                REPEATED_NAME,
                manifest.path,
                f"daq.{daq.name}.channel.{entry.name}",
                found=found,
                expected="each data set once",
            )
        if point not in ("", *present) or block not in scan.channels_at(0):
            expected = f"block/point of {len(scan.samples)} blocks and {len(present)} points, or a block"
            raise InputError(UNKNOWN_DATA_SET, daq.file, entry.name, found="no such data set", expected=expected)
    named = {point for _, point in sets}
    points = tuple(_point(daq, scan, index) for index, point in enumerate(present) if named & {"", point})
    for entry, number in ((entry, point.number) for point in points for entry in point.entry.channel):
        contradiction = aim_contradiction(entry)
        if contradiction is not None:
            key = f"daq.{daq.name}.channel.{entry.name}.direction"
            raise InputError(
                CONTRADICTING_DIRECTION,
                manifest.path,
                key,
                found=f"at point {number} {contradiction[1]}",
                expected=contradiction[0],
            )
    return points


def split_scan(manifest: Manifest) -> Iterator[tuple[Manifest, ScannedPoint | None]]:
    """Yield the set-ups of a manifest: itself, or one for each point of its scan.

    Other blocks belong to the first point. Images and points whose trigger names a scan point belong to that.
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
    """Yield the images or points of a scan point, with its trigger name."""
    for entry in frames:
        block, slash, number = entry.trigger.partition("/")
        if slash and block in point.raw and number.isdecimal():
            if number == point.number:
                yield entry.model_copy(update={"trigger": block})
        elif first:
            yield entry


def _point(daq: Daq, scan: VibrometerScan, index: int) -> ScannedPoint:
    """Return the DAQ block of a scan point, with channels named by their block only."""
    entries = []
    for entry in daq.channel:
        block, point = daq.data_set(entry)
        if point not in ("", str(index + 1)):
            continue
        changes: dict[str, object] = {"name": block}
        measured_at_points = (
            not point
            and not entry.reference
            and entry.quantity in TRANSDUCERS
            and TRANSDUCERS[entry.quantity].kind == "vibrometer"
        )
        if entry.point is not None and measured_at_points:
            changes["point"] = tuple((np.asarray(entry.point, dtype=np.float64) + scan.point_m[index]).tolist())
        entries.append(entry.model_copy(update=changes))
    samples = scan.channels_at(index)
    raw = {entry.name: samples[entry.name] for entry in entries}
    return ScannedPoint(daq.model_copy(update={"channel": tuple(entries)}), raw, 0.0, str(index + 1))


# The set-ups of a recording.


@dataclass(frozen=True)
class FileCache:
    """Cached channels by set-up and block, and images by paths and bit depth."""

    channels: dict[tuple[str, str], dict[str, RawChannel]] = field(default_factory=dict)
    images: dict[tuple[tuple[Path, ...], int | None], ImageSequence] = field(default_factory=dict)


@dataclass(frozen=True)
class SetUpRecords:
    """One set-up: its part of the manifest, its DAQ blocks, and its key in recording.toml."""

    manifest: Manifest
    records: tuple[DaqRecord, ...]
    where: str


def read_daqs(manifest: Manifest) -> tuple[DaqRecord, ...]:
    """Read every DAQ block of a set-up; `InputError` with file and channel."""
    return tuple(_read_daq(manifest, daq) for daq in manifest.daq)


def read_set_ups(manifest: Manifest, cache: FileCache | None = None) -> tuple[SetUpRecords, ...]:
    """Read the set-ups of a recording: top level, every `[[take]]`, every scan point."""
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
    """Add the set-up to errors: its key prefix to those of recording.toml, else its name."""
    try:
        yield
    except InputError as error:
        inside = error.file == path and error.key.split(".")[0] in ("daq", "images", "points")
        key = where + error.key if inside else error.key
        raise error.at(key) from error
    except ComputeError as error:
        if not name:
            raise
        raise error.at(name) from error


def recorded_channels(manifest: Manifest, daq: Daq) -> dict[str, RawChannel]:
    """Read the channels of a block by their names in the recording (`in_stated_units`)."""
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
    """Read and check a block; a scan point, or `raw` channels, are checked only.

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
        check_samples(daq.file, entry.stored_name, record.raw[entry.name], entry.quantity, gaps=gaps)
    every = KINDS[manifest.excitation.kind].needs_uniform_samples
    record.check_uniform(entry for entry in daq.channel if every or entry.quantity == "trigger")
    return record


def check_samples(file: Path, name: str, channel: RawChannel, quantity: str, *, gaps: bool) -> None:
    """Refuse empty and constant channels, and non-finite samples unless `gaps` are allowed."""
    samples = channel.samples
    if len(samples) < 2:
        raise InputError(TOO_FEW_SAMPLES, file, name, found=str(len(samples)), expected="at least 2 samples")
    bad = np.flatnonzero(~np.isfinite(samples))
    if len(bad) and gaps and len(samples) - len(bad) > 1:
        samples = np.delete(samples, bad)
    elif len(bad):
        found = f"{len(bad)} of {len(channel.samples)} not finite, the first at sample {bad[0]}"
        raise InputError(NON_FINITE_SAMPLES, file, name, found=found, expected="finite samples")
    if quantity != "trigger" and np.ptp(samples) == 0.0:
        raise InputError(
            CONSTANT_CHANNEL, file, name, found=f"{samples[0]:g} throughout", expected="samples that change"
        )
