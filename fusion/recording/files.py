"""What was recorded, read from its files: DAQ records, the points of a scan, the responses of measuring chains."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from fusion.base import ARGUMENT, ComputeError, InputError
from fusion.instruments import TRANSDUCERS
from fusion.recording.load import Manifest, read_toml, validate
from fusion.recording.manifest import ChannelEntry, Daq, Frames, Images
from fusion.recording.values import (
    PULSE,
    Block,
    NotNegative,
    Number,
    Positive,
    Text,
    array_of_tables,
    refusal,
    rows_of,
)
from shaker.arrays import FloatArray
from shaker.frf.chain import (
    ChainResponse,
    FilterKind,
    PassBand,
    PoleModel,
    ResponseTable,
    filter_poles,
    pole_response,
    product,
    table_response,
)
from shaker.io.channel import RawChannel
from shaker.io.read import read_channels
from shaker.io.text import Scan, read_scan_asc
from shaker.timebase.trigger import PulseWidth, pulse_width

# A scanning vibrometer's text in a recording: every scan point is a take of its own.


SUFFIX = ".asc"
SCANNING = tuple(name for name, transducer in TRANSDUCERS.items() if transducer.kind == "vibrometer")
AnyFrames = TypeVar("AnyFrames", bound=Frames)


@dataclass(frozen=True)
class ScannedPoint:
    """One point of a scan: the DAQ block as it was there, its channels named by their block alone, their samples.

    `number`: as channels name the point, counted from "1".
    """

    number: str
    daq: Daq
    raw: dict[str, RawChannel]


def scanned_points(manifest: Manifest, daq: Daq) -> tuple[ScannedPoint, ...] | None:
    """Return the points that a block of a scan holds, in the order of the scan; None for any other file.

    A channel that names its block alone was recorded at every point. A velocity or displacement that does so, and is
    not the reference, is what looked at the points: its `point` is where the origin of the file's coordinates lies in
    the sensor frame, whose axes they share. All others stand at their own.
    """
    if daq.file.suffix.lower() != SUFFIX:
        return None
    try:
        scan = read_scan_asc(daq.file)
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, manifest.path, f"daq.{daq.name}.file") from error
    if len(scan.point_m) == 1:
        return None
    present = [str(number + 1) for number in range(len(scan.point_m))]
    sets = [daq.data_set(entry) for entry in daq.channel]
    for entry, (block, point) in zip(daq.channel, sets, strict=True):
        if point and (block, "") in sets:
            found = f"{block} beside it, which is recorded at every point"
            raise InputError(manifest.path, f"daq.{daq.name}.channel.{entry.name}", found, "each data set once")
        if point not in ("", *present) or block not in scan.take(0):
            expected = f"block/point of {len(scan.samples)} blocks and {len(present)} points, or a block alone"
            raise InputError(daq.file, entry.name, found="no such data set", expected=expected)
    named = {point for _, point in sets}
    return tuple(_point(daq, scan, place) for place, point in enumerate(present) if named & {"", point})


def split_scan(manifest: Manifest) -> Iterator[tuple[Manifest, ScannedPoint | None]]:
    """Yield what was recorded at once of a block of a manifest: itself, or one part for each point of its scan.

    What was recorded beside a scan belongs to its first point, images and points whose trigger names a point to that.
    """
    scans = {daq.name: points for daq in manifest.daq if (points := scanned_points(manifest, daq)) is not None}
    if len(scans) > 1:
        found, expected = f"{len(scans)}: {', '.join(scans)}", "one scan of several points at a time"
        raise InputError(manifest.path, "daq", found=found, expected=expected)
    if not scans:
        yield manifest, None
    for name, points in scans.items():
        for point in points:
            first = point is points[0]
            daq = tuple(
                point.daq if block.name == name else block for block in manifest.daq if first or block.name == name
            )
            images = tuple(_of_point(manifest.images, point, first))
            yield (
                replace(manifest, daq=daq, images=images, points=tuple(_of_point(manifest.points, point, first))),
                point,
            )


def _of_point(frames: Sequence[AnyFrames], point: ScannedPoint, first: bool) -> Iterator[AnyFrames]:
    """Yield the images or points of a scan point, their trigger named as its channels are."""
    for entry in frames:
        block, slash, number = entry.trigger.partition("/")
        if slash and block in point.raw and number.isdecimal():
            if number == point.number:
                yield entry.model_copy(update={"trigger": block})
        elif first:
            yield entry


def _point(daq: Daq, scan: Scan, place: int) -> ScannedPoint:
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
    samples = scan.take(place)
    raw = {entry.name: samples[entry.name] for entry in entries}
    return ScannedPoint(str(place + 1), daq.model_copy(update={"channel": tuple(entries)}), raw)


# DAQ blocks as read from their files, one set-up after another, checked for what a user can get wrong.


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

    def pulse_width(self, trigger: str) -> PulseWidth:
        """Measure the width of the pulses of a trigger channel; a `ValueError` says why it cannot be."""
        channel = next(channel for channel in self.entry.channel if channel.name == trigger)
        rate_hz = self.raw[trigger].sample_rate_hz
        return pulse_width(self.values(channel), rate_hz, channel.threshold, channel.edge)


@dataclass(frozen=True)
class SetUpRecords:
    """What was recorded at once: its share of the manifest, its DAQ blocks, and its place in recording.toml."""

    manifest: Manifest
    records: tuple[DaqRecord, ...]
    where: str


def read_daqs(manifest: Manifest) -> tuple[DaqRecord, ...]:
    """Read every DAQ block of what was recorded at once; raises `InputError` naming file and channel."""
    return tuple(_read_daq(manifest, daq) for daq in manifest.daq)


def read_set_ups(manifest: Manifest) -> tuple[SetUpRecords, ...]:
    """Read a recording set-up by set-up: its top level, then every `[[take]]`, of a scan point by point."""
    found = []
    for where, block in manifest.set_ups:
        with told_in(manifest.path, where):
            for part, point in split_scan(block):
                records = tuple(_read_daq(part, daq, point) for daq in part.daq)
                found.append(SetUpRecords(part, records, where))
    return tuple(found)


@contextmanager
def told_in(path: Path, where: str, name: str = "") -> Iterator[None]:
    """Say in which set-up of the recording `path` something went wrong: its place there, its name elsewhere."""
    try:
        yield
    except InputError as error:
        inside = error.file == path and error.key.split(".")[0] in ("daq", "images", "points")
        key = where + error.key if inside else error.key
        raise InputError(error.file, key, error.found, error.expected, error.more) from error
    except ComputeError as error:
        raise ComputeError(f"{name}: {error}" if name else str(error)) from error


def _read_daq(manifest: Manifest, daq: Daq, point: ScannedPoint | None = None) -> DaqRecord:
    """Read and check a block; the point of a scan has been read and is checked only."""
    if point is not None and point.daq is daq:
        for entry in daq.channel:
            _check_samples(daq, entry, point.raw[entry.name])
        return DaqRecord(daq, point.raw, 0.0)
    names = [channel.name for channel in daq.channel]
    try:
        raw = read_channels(daq.file, names, daq.sample_rate)
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, manifest.path, f"daq.{daq.name}.file") from error
    for entry in daq.channel:
        _check_samples(daq, entry, raw[entry.name])
    return DaqRecord(daq, raw, min(channel.start_s for channel in raw.values()))


def no_pulse_width(manifest: Manifest, daq: str, entry: Frames, error: ValueError) -> InputError:
    """Say at the key that asked for it why the width of a trigger's pulses cannot be measured."""
    file, key = manifest.path, f"{'images' if isinstance(entry, Images) else 'points'}.{entry.stereo}.exposure"
    if manifest.rig.stereo[entry.stereo].exposure == PULSE:
        file, key = manifest.rig_path, f"stereo.{entry.stereo}.exposure"
    reason = ARGUMENT.sub("", str(error), count=1)
    found = f'"{PULSE}", but the width of the pulses of {entry.trigger} in {daq} cannot be told ({reason})'
    return InputError(file, key, found=found, expected="the exposure in s")


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


# The frequency response of a measuring chain: a table, or a text of gain, poles and standard filters.


COLUMNS = ("frequency_hz", "magnitude", "phase_rad", "u_magnitude", "u_phase_rad")
ELEMENTS = ".toml"


Roots = Annotated[
    tuple[tuple[float, float], ...],
    BeforeValidator(lambda value: rows_of(len(value) if isinstance(value, list | tuple) else 0, 2)(value)),
]
"""A list of [real, imaginary] pairs."""


def _complex(roots: tuple[tuple[float, float], ...]) -> NDArray[np.complex128]:
    """Return pairs of real and imaginary part as complex numbers."""
    return np.array([complex(*root) for root in roots], dtype=np.complex128)


class Element(Block):
    """One element of a chain: gain and delay of its own, and poles and zeros in rad/s or a standard filter."""

    name: Text = "element"
    gain: Number = 1.0
    gain_uncertainty: NotNegative = 0.0
    gain_at: NotNegative | None = None
    zeros: Roots = ()
    poles: Roots = ()
    filter: FilterKind | None = None
    band: PassBand = "lowpass"
    order: Annotated[int, Field(ge=1, le=12)] | None = None
    corner: Positive | None = None
    damping: Positive | None = None
    frequency_uncertainty: NotNegative = 0.0
    delay: Number = 0.0
    delay_uncertainty: NotNegative = 0.0

    OF_FILTER: ClassVar[tuple[str, ...]] = ("band", "order", "corner", "damping")
    OF_POLES: ClassVar[tuple[str, ...]] = ("zeros", "poles", "gain_at")

    @model_validator(mode="after")
    def _keys_belong_together(self) -> Self:
        foreign = self.OF_FILTER if self.filter is None else self.OF_POLES
        if self.filter != "resonance":
            foreign = (*foreign, "damping")
        for key in foreign:
            if key in self.model_fields_set:
                kind = "an element without filter" if self.filter is None else f'filter = "{self.filter}"'
                raise refusal(f"no such key for {kind}", "one", key=key)
        needed = {None: (), "resonance": ("corner", "damping")}.get(self.filter, ("order", "corner"))
        for key in needed:
            if getattr(self, key) is None:
                raise refusal(f'this key, required for filter = "{self.filter}"', "nothing", key=key)
        if self.filter == "resonance" and self.order not in (None, 2):
            raise refusal("order 2 of a resonance", f"{self.order}", key="order")
        try:
            self.model()
        except ValueError as error:
            key, _, text = str(error).partition(": expected ")
            expected, _, found = text.partition(", found ")
            raise refusal(expected, found, key=key) from error
        return self

    def model(self) -> PoleModel:
        """Return the poles of the element, its gain and its delay."""
        if self.filter is None:
            return PoleModel(_complex(self.zeros), _complex(self.poles), self.gain, self.gain_at, self.delay)
        damping = {} if self.damping is None else {"damping": self.damping}
        own = filter_poles(self.filter, self.order or 2, self.corner or 0.0, self.band, **damping)
        return PoleModel(own.zeros, own.poles, self.gain * own.gain, own.gain_hz, self.delay)

    def response(self, frequency_hz: FloatArray) -> ChainResponse:
        """Return the element's response at frequencies (K,) in Hz, its causes of error named by the element."""
        found = pole_response(
            frequency_hz,
            self.model(),
            u_gain=self.gain_uncertainty,
            u_frequency=self.frequency_uncertainty,
            u_delay_s=self.delay_uncertainty,
        )
        return ChainResponse(found.value, found.errors, tuple(f"{cause} of {self.name}" for cause in found.causes))


class Chain(Block):
    """A chain's file: elements one behind the other."""

    format: Literal[1] = 1
    element: Annotated[tuple[Element, ...], BeforeValidator(array_of_tables), Field(min_length=1)]


def read_response(path: Path, frequency_hz: FloatArray) -> ChainResponse:
    """Return the response that a file states at frequencies (K,) in Hz.

    `.toml`: `[[element]]` blocks, which multiply. Any other file is a table with the columns frequency_hz, magnitude,
    phase_rad, u_magnitude, u_phase_rad (u_: standard uncertainty in the unit of the column it belongs to). Raises
    `InputError` naming file and key or column.
    """
    if path.suffix.lower() == ELEMENTS:
        try:
            return product([element.response(frequency_hz) for element in read_chain(path).element])
        except ValueError as error:
            raise InputError.told_by(error, path, "element") from error
    table = read_table(path)
    outside = [f for f in frequency_hz if not table.frequency_hz[0] <= f <= table.frequency_hz[-1]]
    if outside:
        found = f"{table.frequency_hz[0]:g} to {table.frequency_hz[-1]:g} Hz"
        raise InputError(path, "frequency_hz", found=found, expected=f"a range that contains {outside[0]:g} Hz")
    return table_response(table, frequency_hz)


def check_response(path: Path) -> None:
    """Raise `InputError` unless a response file can be read."""
    _ = read_chain(path) if path.suffix.lower() == ELEMENTS else read_table(path)


def read_chain(path: Path) -> Chain:
    """Read the elements of a chain; raises `InputError`."""
    return validate(Chain, read_toml(path), path)


def read_table(path: Path) -> ResponseTable:
    """Read a response table; raises `InputError` for a missing column and a cell that is no number."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            names, rows = tuple(reader.fieldnames or ()), list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, "", found=str(error), expected="a table in UTF-8 text") from error
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        found = f"columns {', '.join(str(name) for name in names) or 'none'}"
        raise InputError(path, missing[0], found=found, expected="this column")
    columns = {name: np.full(len(rows), np.nan) for name in COLUMNS}
    for name, values in columns.items():
        for line, row in enumerate(rows):
            with suppress(TypeError, ValueError):
                values[line] = float(row[name])
            if not np.isfinite(values[line]):
                found = f'"{row[name] or ""}" in line {line + 2}'
                raise InputError(path, name, found=found, expected="one finite number per row")
    frequency_hz, magnitude = columns["frequency_hz"], columns["magnitude"]
    if len(rows) == 0 or np.any(np.diff(frequency_hz) <= 0.0):
        raise InputError(path, "frequency_hz", found="values that do not ascend", expected="ascending frequencies")
    if np.any(magnitude <= 0.0):
        raise InputError(path, "magnitude", found=f"{magnitude.min():g}", expected="positive values")
    for name in ("u_magnitude", "u_phase_rad"):
        if np.any(columns[name] < 0.0):
            raise InputError(path, name, found=f"{columns[name].min():g}", expected="no negative values")
    return ResponseTable(**columns)
