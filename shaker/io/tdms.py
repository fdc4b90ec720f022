"""TDMS files of LabVIEW, read in one pass, block by block.

npTDMS, whose scales are used, reads a whole chunk of a file at once, and a file of one segment is one chunk. It also
reads truncated files without an error, and scales single precision in single precision. Measured with 128 MB of 16
channels, int16 (`benchmarks/signals_readers.py`; speed, memory relative to the result):

- interleaved, all channels: 104 MB/s, 1.00 with this module; 121 MB/s, 1.33 with npTDMS
- interleaved, one channel: 2900 MB/s, 1.06 with this module; 140 MB/s, 8.3 with npTDMS
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from shaker.io.channel import (
    BLOCK,
    RawChannel,
    SampleTimes,
    Segment,
    agreed_rate,
    is_time,
    select_by_either_name,
    times_of_segments,
    times_of_stamps,
)
from shakercal._common.arrays import FloatArray

# Position of the values of every channel in a TDMS file (NI, "TDMS file format internal structure", version 2.0).

_LEAD = 28  # bytes before every segment's metadata
_METADATA, _NEW_LIST, _RAW, _INTERLEAVED, _BIG_ENDIAN = 1 << 1, 1 << 2, 1 << 3, 1 << 5, 1 << 6
_NO_DATA, _AS_BEFORE, _FORMAT_CHANGING, _DIGITAL_LINE = 0xFFFFFFFF, 0, 0x1269, 0x126A
_MOST_CHUNKS = 1_000_000  # of a segment of several cards, which have thousands of rows in each
_UNENDING = 0xFFFFFFFFFFFFFFFF  # length of a segment whose writer never closed it
_STRING, _BOOLEAN, _STAMP = 0x20, 0x21, 0x44
_NUMBERS = {1: "i1", 2: "i2", 3: "i4", 4: "i8", 5: "u1", 6: "u2", 7: "u4", 8: "u8", 9: "f4", 10: "f8"}
_NUMBERS |= {0x19: "f4", 0x1A: "f8", _BOOLEAN: "u1", 0x08000C: "c8", 0x10000D: "c16"}
_CARD_NUMBERS = {0: "u1", 1: "i1", 2: "u2", 3: "i2", 4: "u4", 5: "i4", 6: "u8", 7: "i8", 8: "f4", 9: "f8"}
DAQMX = -1  # no scale: the stored value
_Key = tuple[str, int]  # a channel's path and the number of its raw scale


@dataclass(frozen=True)
class Field:
    """Values of one channel in a record: `count` of type `dtype` from byte `offset`.

    `scale` distinguishes the raw scales of a card (`DAQMX` where the channel has none). `bit` is that of a digital
    line.
    """

    path: str
    offset: int
    count: int
    dtype: np.dtype[Any]
    scale: int = DAQMX
    bit: int | None = None


@dataclass(frozen=True)
class TdmsRegion:
    """Records of `stride` bytes, `repeats` of them, from byte `position` of the file."""

    position: int
    stride: int
    repeats: int
    fields: tuple[Field, ...]


@dataclass(frozen=True)
class TimeStatement:
    """Statement of a channel's properties about its time, valid from value number `first`.

    `start` is `wf_start_time` in seconds since 1904, None where it is not set (0). `interval_s` is `wf_increment`, 0
    where it is not set.
    """

    first: int
    start: Fraction | None
    offset_s: float
    interval_s: float

    @staticmethod
    def of(first: int, properties: Mapping[str, Any]) -> TimeStatement:
        """Return the statement of these properties."""
        start = properties.get("wf_start_time")
        set_start = Fraction(start) if isinstance(start, Fraction | int) and start > 0 else None  # 0 is 1904: not set
        numbers = (float(properties.get(key) or 0.0) for key in ("wf_start_offset", "wf_increment"))
        return TimeStatement(first, set_start, *numbers)

    def completed_by(self, other: TimeStatement) -> TimeStatement:
        """Return this statement, with a missing start or interval taken from a later one."""
        start = other.start if self.start is None else self.start
        return TimeStatement(self.first, start, self.offset_s or other.offset_s, self.interval_s or other.interval_s)

    def contradicts(self, other: TimeStatement) -> bool:
        """Return whether two statements contain different values of the same property."""
        starts = None not in (self.start, other.start) and self.start != other.start
        intervals = 0.0 not in (self.interval_s, other.interval_s) and self.interval_s != other.interval_s
        return starts or intervals or self.offset_s != other.offset_s


@dataclass(frozen=True)
class _Raw:
    """A channel's part of one chunk: number of values, type (None: texts), bytes, card scales."""

    count: int
    dtype: np.dtype[Any] | None
    size: int
    scales: tuple[tuple[int, Field], ...] = ()  # buffer and field in its records
    widths: tuple[int, ...] = ()


class TdmsIndex:
    """Content of a TDMS file without its values; `ValueError` for a truncated file.

    Attributes
    ----------
    properties : those of every object by its path (`/'group'/'channel'`).
    regions : where raw values are.
    dated : statements of every channel about its time, one for each change during writing.
    types, lengths : type of the raw values of every channel, and their number of every channel and raw scale.
    """

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.properties: dict[str, dict[str, Any]] = {}
        self.regions: list[TdmsRegion] = []
        self.dated: dict[str, list[TimeStatement]] = {}
        self.types: dict[str, np.dtype[Any]] = {}
        self.lengths: dict[_Key, int] = {}
        self._layouts: dict[str, _Raw] = {}
        self._active: dict[str, bool] = {}
        self._counts: dict[str, int] = {}
        position, size = 0, stream.seek(0, 2)
        while position < size:
            stream.seek(position)
            lead = stream.read(_LEAD)
            if lead[:4] != b"TDSm":
                raise ValueError(f"{path}: expected a TDMS segment at byte {position}, found {lead[:4]!r}")
            if len(lead) < _LEAD:
                raise _cut_off(path)
            flags = struct.unpack_from("<L", lead, 4)[0]
            order = ">" if flags & _BIG_ENDIAN else "<"
            length, metadata = struct.unpack_from(f"{order}QQ", lead, 12)
            end, start = position + _LEAD + length, position + _LEAD + metadata
            if length == _UNENDING or end > size or start > end:
                raise _cut_off(path)
            if flags & _METADATA:
                self._read_objects(_Cursor(stream.read(metadata), order), bool(flags & _NEW_LIST))
            if flags & _RAW:
                chunk = {name: self._layouts[name] for name, has_data in self._active.items() if has_data}
                if flags & _METADATA:
                    self._add_statements(chunk)
                self._add_regions(_regions(path, chunk, bool(flags & _INTERLEAVED), start, end - start))
            position = end
        self._add_statements(list(self.dated))

    def _read_objects(self, cursor: _Cursor, new_list: bool) -> None:
        """Store the objects, raw data and properties of a segment's metadata."""
        if new_list:
            self._active.clear()
        (objects,) = cursor.take("L")
        for _ in range(objects):
            path = cursor.text()
            (kind,) = cursor.take("L")
            if kind in (_FORMAT_CHANGING, _DIGITAL_LINE):
                self._layouts[path] = _card_raw(cursor, path, kind)
            elif kind not in (_NO_DATA, _AS_BEFORE):
                self._layouts[path] = _raw(cursor)
            elif kind == _AS_BEFORE and path not in self._layouts:
                raise ValueError(f"expected the layout of {path}, found none before its first data")
            self._active[path] = kind != _NO_DATA
            object_properties = self.properties.setdefault(path, {})
            for _ in range(cursor.take("L")[0]):
                name = cursor.text()
                object_properties[name] = cursor.value(cursor.take("L")[0])

    def _add_statements(self, names: Iterable[str]) -> None:
        """Add the time statements of channels that have changed since values were last written."""
        for name in names:
            stated = TimeStatement.of(self._counts.get(name, 0), self.properties.get(name, {}))
            statements = self.dated.setdefault(name, [])
            if not statements or statements[-1].contradicts(stated):
                statements.append(stated)
            else:
                statements[-1] = statements[-1].completed_by(stated)

    def _add_regions(self, regions: Sequence[TdmsRegion]) -> None:
        """Add regions of raw values, and count these."""
        self.regions += regions
        for region in regions:
            for entry in region.fields:
                key, count = (entry.path, entry.scale), entry.count * region.repeats
                self.types[entry.path] = entry.dtype
                self.lengths[key] = self.lengths.get(key, 0) + count
                self._counts[entry.path] = self._counts.get(entry.path, 0) + count


def path_parts(path: str) -> tuple[str, ...]:
    """Return group and channel of an object's path; quotes inside a name are doubled."""
    return tuple(part.replace("''", "'") for part in path[2:-1].split("'/'")) if len(path) > 1 else ()


def _cut_off(path: Path) -> ValueError:
    return ValueError(f"{path}: expected a complete TDMS file, found its last segment cut off")


class _Cursor:
    """Sequential reader of values in a segment's metadata."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.position = data, order, 0

    def take(self, codes: str) -> tuple[Any, ...]:
        """Return numbers by their codes of `struct`."""
        codes = self.order + codes
        values = struct.unpack_from(codes, self.data, self.position)
        self.position += struct.calcsize(codes)
        return values

    def text(self) -> str:
        """Return a text with its length before it."""
        (length,) = self.take("L")
        raw = self.take(f"{length}s")[0]
        return bytes(raw).decode("utf-8", "replace")

    def value(self, kind: int) -> Any:
        """Return a property's value; time stamps are exact seconds since 1904."""
        if kind == _STRING:
            return self.text()
        if kind == _STAMP:
            parts = self.take("qQ" if self.order == ">" else "Qq")
            seconds, fraction = parts if self.order == ">" else parts[::-1]
            return seconds + Fraction(fraction, 1 << 64)
        dtype = _number_type(kind, self.order)
        value = np.frombuffer(self.data, dtype, 1, self.position)[0].item()
        self.position += dtype.itemsize
        return bool(value) if kind == _BOOLEAN else value


def _number_type(kind: int, order: str) -> np.dtype[Any]:
    """Return numpy's type for a type number of TDMS."""
    if kind not in _NUMBERS:
        raise ValueError(f"expected numbers of a known type, found type 0x{kind:X}")
    return np.dtype(order + _NUMBERS[kind])


def _raw(cursor: _Cursor) -> _Raw:
    kind, _, count = cursor.take("LLQ")
    if kind == _STRING:
        return _Raw(count, None, cursor.take("Q")[0])
    if kind == _STAMP:
        names = ["seconds", "fraction"] if cursor.order == ">" else ["fraction", "seconds"]
        codes = {"seconds": f"{cursor.order}i8", "fraction": f"{cursor.order}u8"}
        dtype = np.dtype([(name, codes[name]) for name in names])
    else:
        dtype = _number_type(kind, cursor.order)
    return _Raw(count, dtype, count * dtype.itemsize)


def _card_raw(cursor: _Cursor, path: str, kind: int) -> _Raw:
    """Read the index of a card's raw data (DAQmx): interleaved buffers, one per card."""
    channel_kind, _, count, scales = cursor.take("LLQL")
    card_fields = []
    for _ in range(scales):
        code, buffer, offset, *_, scale = cursor.take("LLLLL" if kind == _FORMAT_CHANGING else "LLLBL")
        bit = offset % 8 if kind == _DIGITAL_LINE else None
        first_byte = offset if bit is None else offset // 8
        dtype = np.dtype(cursor.order + _CARD_NUMBERS[code])
        number = scale if channel_kind == _NO_DATA else DAQMX
        card_fields.append((buffer, Field(path, first_byte, 1, dtype, number, bit)))
    widths = cursor.take(f"{cursor.take('L')[0]}L")
    return _Raw(count, np.dtype("f8"), 0, tuple(card_fields), widths)


def _regions(path: Path, chunk: Mapping[str, _Raw], interleaved: bool, position: int, size: int) -> list[TdmsRegion]:
    if any(raw.widths for raw in chunk.values()):
        return _card_regions(path, chunk, position, size)
    if not size or not any(raw.size for raw in chunk.values()):
        return []
    if interleaved and not any(raw.dtype is None for raw in chunk.values()):
        if len({raw.count for raw in chunk.values()}) > 1:
            raise ValueError(f"{path}: expected equally many values of all interleaved channels, found different ones")
        chunk = {name: _Raw(1, raw.dtype, raw.size // raw.count) for name, raw in chunk.items()}
    fields, length = [], 0
    for name, raw in chunk.items():
        if raw.dtype is not None:
            fields.append(Field(name, length, raw.count, raw.dtype))
        length += raw.size
    if size % length:
        raise _cut_off(path)
    return [TdmsRegion(position, length, size // length, tuple(fields))]


def _card_regions(path: Path, chunk: Mapping[str, _Raw], position: int, size: int) -> list[TdmsRegion]:
    """Return the regions of a segment of cards, one buffer of rows after another."""
    widths = next(iter(chunk.values())).widths
    if any(raw.widths != widths for raw in chunk.values()):
        raise ValueError(f"{path}: expected one layout of all channels of the cards, found several")
    card_fields = [(raw.count, buffer, field) for raw in chunk.values() for buffer, field in raw.scales]
    rows = [max((count for count, at, _ in card_fields if at == buffer), default=0) for buffer in range(len(widths))]
    fields = [tuple(field for _, at, field in card_fields if at == buffer) for buffer in range(len(widths))]
    if len(widths) == 1:
        if not widths[0] or size % widths[0]:
            raise _cut_off(path)
        return [TdmsRegion(position, widths[0], size // widths[0], fields[0])]
    length = sum(row * width for row, width in zip(rows, widths, strict=True))
    if not length or size % length or size // length > _MOST_CHUNKS:
        raise _cut_off(path)
    regions = []
    for start in range(position, position + size, length):
        region_start = start
        for row, width, buffer_fields in zip(rows, widths, fields, strict=True):
            regions.append(TdmsRegion(region_start, width, row, buffer_fields))
            region_start += row * width
    return regions


# Channels `group/channel` with their scales.

_SCALES = ("Polynomial", "Linear", "RTD", "Strain", "Table", "Thermistor", "Thermocouple", "Add", "Subtract")
_SCALE_KEY = re.compile(r"NI_Scale\[(\d+)\]_Scale_Type")
_MOST_SCALES = 1000  # of a channel: more are treated as damage
_SOURCES = ("input_source", "left_input_source", "right_input_source")
_SCALE_BLOCK = 1 << 14  # samples scaled at a time: their intermediate results stay in the cache


@dataclass
class _Sink:
    """Destination of a channel's values (S,), the number filled, and the scale for each block.

    `scale` is None for no scale, or one applied later. `base_s` is the first second of time stamps, from which they
    count.
    """

    values: FloatArray
    scale: Any = None
    filled: int = 0
    base_s: int | None = None

    def take(self, entry: Field, block: bytes, stride: int) -> None:
        """Copy the channel's values from a block of records."""
        repeats = len(block) // stride if stride else 1
        raw: NDArray[Any] = np.ndarray(
            (repeats, entry.count), entry.dtype, block, entry.offset, (stride, entry.dtype.itemsize)
        )
        if entry.bit is not None:
            raw = raw >> entry.bit & 1
        elif entry.dtype.names:
            self.base_s = int(raw["seconds"][0, 0]) if self.base_s is None else self.base_s
            raw = (raw["seconds"] - self.base_s) + raw["fraction"] * 2.0**-64
        target = self.values[self.filled : self.filled + repeats * entry.count]
        target.reshape(repeats, entry.count)[...] = raw
        self.filled += len(target)
        if self.scale is not None:
            _apply(self.scale, {entry.scale: target})


@dataclass(frozen=True)
class _RawValues:
    """Input of npTDMS's scales: values, or values by the number of the raw scale."""

    data: FloatArray | None
    scaler_data: dict[int, FloatArray] = field(default_factory=dict)


def read_tdms(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read channels by `group/channel`, or by a channel name that only one group has.

    The interval is `wf_increment`, the start `wf_start_time` plus `wf_start_offset`, counted from the earliest channel.
    Where these change between writes, pauses are preserved, and two rates are refused. A channel `time` (numbers in s
    or its `unit_string`, or stamps) of the same group and length gives the times, or must agree with the interval.
    Scales of the hardware (`NI_Scale`) are applied. Texts and complex numbers are skipped. Memory: the result and one
    block.
    """
    with path.open("rb") as stream:
        index = TdmsIndex(path, stream)
        filled = {name for (name, _), length in index.lengths.items() if length}
        series = [name for name, dtype in index.types.items() if dtype.kind in "biuf" and name in filled]
        present = {"/".join(path_parts(name)): name for name in series}
        paths = select_by_either_name(path, names, present, [path_parts(name)[-1] for name in present.values()])
        times = {name: _find_time_channel(name, index) for name in paths.values()}
        requested = {*paths.values(), *(time for time in times.values() if time)}
        values = _values(path, stream, index, requested)
        starts = _starts(stream, index, {times[channel_path] or channel_path for channel_path in paths.values()})
    result = {}
    for name, channel_path in paths.items():
        time, where = times[channel_path], f'channel "{name}"'
        unit = str(index.properties.get(channel_path, {}).get("unit_string", ""))
        sampled = _sample_times(path, where, index.dated[channel_path], len(values[channel_path]), sample_rate_hz)
        if time is not None:
            at = f'{where}: time channel "{path_parts(time)[-1]}"'
            time_unit = str(index.properties.get(time, {}).get("unit_string", ""))
            stamps = values[time].astype(index.types[time]) if index.types[time].kind in "iu" else values[time]
            given = sample_rate_hz if sampled is None else sampled.rate_hz
            stamped = times_of_stamps(path, at, stamps, time_unit, given_hz=given)
            sampled = stamped if sampled is None or sampled.stamp_s is None else sampled
        assert sampled is not None
        result[name] = RawChannel.from_times(
            replace(sampled, start_s=sampled.start_s + starts.get(time or channel_path, 0.0)),
            values[channel_path],
            unit,
        )
    return result


def _sample_times(
    path: Path, where: str, dated: Sequence[TimeStatement], count: int, given_hz: float | None
) -> SampleTimes | None:
    """Return the times of values by a channel's properties; None without an interval."""
    first = dated[0]
    if not first.interval_s:
        return None if given_hz is None else SampleTimes(agreed_rate(path, where, None, given_hz))
    agreed_rate(path, where, 1.0 / first.interval_s, given_hz)
    segments = []
    for statement, last in zip(dated, (*(after.first for after in dated[1:]), count), strict=True):
        if statement.first == last:
            raise ValueError(
                f"{path}: {where}: expected time properties with the values, found them changed after the last value"
            )
        since = 0.0 if statement.start is None or first.start is None else float(statement.start - first.start)
        segments.append(
            Segment(since + statement.offset_s, last - statement.first, statement.interval_s or first.interval_s)
        )
    return times_of_segments(path, where, segments)


def _find_time_channel(name: str, index: TdmsIndex) -> str | None:
    """Return the time channel of a channel's group and length."""
    group, *_ = path_parts(name)
    for other in index.types:
        other_group, *tail = path_parts(other)
        fits = index.lengths.get((other, DAQMX)) == index.lengths.get((name, DAQMX))
        if other != name and other_group == group and tail and is_time(tail[0]) and fits:
            return other
    return None


def _values(path: Path, stream: BinaryIO, index: TdmsIndex, requested: set[str]) -> dict[str, FloatArray]:
    """Return the scaled values of channels; time stamps count in seconds from their first second."""
    size = path.stat().st_size
    for (name, _), length in index.lengths.items():
        if length > 8 * size:  # a sample takes at least a bit
            raise ValueError(f"{path}: channel {name}: expected at most {8 * size} samples, found {length} declared")
    sinks = {key: _Sink(np.empty(length)) for key, length in index.lengths.items() if key[0] in requested}
    keys = {name: [key for key in sinks if key[0] == name] for name in requested}
    scales = {name: _scale(path, name, index) for name in requested}
    for name, channel_keys in keys.items():
        if len(channel_keys) == 1:
            sinks[channel_keys[0]].scale = scales[name]
    for region in index.regions:
        fields = [entry for entry in region.fields if entry.path in requested]
        if fields:
            _read_region(path, stream, region, fields, sinks)
    for name, channel_keys in keys.items():
        if len(channel_keys) > 1 and scales[name] is not None:
            _apply(scales[name], {key[1]: sinks[key].values for key in channel_keys})
    return {name: sinks[channel_keys[0]].values for name, channel_keys in keys.items()}


def _read_region(
    path: Path, stream: BinaryIO, region: TdmsRegion, fields: Sequence[Field], sinks: Mapping[_Key, _Sink]
) -> None:
    """Read a region block by block into the channels' arrays."""
    if region.stride > BLOCK:  # a record larger than a block: its channels one by one, in pieces
        for start, entry in (
            (region.position + i * region.stride, entry) for i in range(region.repeats) for entry in fields
        ):
            most = BLOCK // entry.dtype.itemsize
            for first in range(0, entry.count, most):
                part = replace(entry, offset=0, count=min(most, entry.count - first))
                size = part.count * part.dtype.itemsize
                position = start + entry.offset + first * entry.dtype.itemsize
                sinks[entry.path, entry.scale].take(part, _read(path, stream, position, size), 0)
        return
    rows = max(1, BLOCK // max(1, region.stride))
    for first in range(0, region.repeats, rows):
        count = min(rows, region.repeats - first)
        block = _read(path, stream, region.position + first * region.stride, count * region.stride)
        for entry in fields:
            sinks[entry.path, entry.scale].take(entry, block, region.stride)


def _read(path: Path, stream: BinaryIO, position: int, size: int) -> bytes:
    stream.seek(position)
    block = stream.read(size)
    if len(block) < size:
        raise ValueError(f"{path}: expected a complete TDMS file, found its end at byte {position + len(block)}")
    return block


def _apply(scale: Any, raw: Mapping[int, FloatArray]) -> None:
    """Replace the first raw values by scaled ones, in blocks that fit into the cache."""
    target = next(iter(raw.values()))
    for first in range(0, len(target), _SCALE_BLOCK):
        numbers = {number: values[first : first + _SCALE_BLOCK] for number, values in raw.items()}
        target[first : first + _SCALE_BLOCK] = scale.scale(_RawValues(numbers.get(DAQMX), numbers))


def _scale(path: Path, name: str, index: TdmsIndex) -> Any:
    """Return npTDMS's scale of a channel, None without one; `ValueError` for an unknown one."""
    parts = path_parts(name)
    layers = [index.properties.get(key, {}) for key in (name, "/'" + parts[0].replace("'", "''") + "'", "/")]
    scales = {
        match[1]: str(value) for layer in layers for key, value in layer.items() if (match := _SCALE_KEY.fullmatch(key))
    }
    numbers = [int(layer["NI_Number_Of_Scales"]) for layer in layers if "NI_Number_Of_Scales" in layer]
    if not scales and not numbers:
        return None
    where = f'{path}: channel "{"/".join(parts)}"'
    for kind in scales.values():
        if kind not in (*_SCALES, "AdvancedAPI"):
            raise ValueError(f"{where}: expected a known scale, found {kind!r}")
    most = max([*map(int, scales), *numbers])
    if most > _MOST_SCALES:
        raise ValueError(f"{where}: expected at most {_MOST_SCALES} scales, found {most}")
    from nptdms.scaling import get_scaling

    scale = get_scaling(*layers)
    steps, left = getattr(scale, "scalings", []), [len(getattr(scale, "scalings", [])) - 1]
    for _ in range(_MOST_SCALES):  # sums of sums of the same scale would be taken 2ⁿ times
        if not left:
            return scale
        step_number = left.pop()
        step = steps[step_number] if 0 <= step_number < len(steps) else None
        left += [getattr(step, source) for source in _SOURCES if hasattr(step, source)]
    raise ValueError(f"{where}: expected scales that build on one another, found more than {_MOST_SCALES} steps")


def _starts(stream: BinaryIO, index: TdmsIndex, requested: Iterable[str]) -> dict[str, float]:
    """Return the delay in s of every channel after the earliest, from time stamps."""
    stamps: dict[str, Fraction] = {}
    for name in requested:
        stamp = index.dated[name][0].start
        if (dtype := index.types[name]).names:
            fields = (
                (region, entry) for region in index.regions if region.repeats for entry in region.fields if entry.count
            )
            stream.seek(next(region.position + entry.offset for region, entry in fields if entry.path == name))
            stamps[name] = Fraction(int(np.frombuffer(stream.read(dtype.itemsize), dtype)["seconds"][0]))
        elif stamp is not None:
            stamps[name] = stamp
    earliest = min(stamps.values(), default=Fraction(0))
    return {name: round(float(stamp - earliest), 12) for name, stamp in stamps.items()}
