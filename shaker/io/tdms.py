"""TDMS files of LabVIEW, read in one pass, block by block.

npTDMS (whose scales are used here) reads a chunk of the file whole, and a file of one segment is one chunk. On 128 MB
of 16 channels, int16 (`benchmarks/signals_readers.py`; speed, memory over that of the result): interleaved, all
channels 104 MB/s, 1.00 here and 121 MB/s, 1.33 with npTDMS; one channel 2900 MB/s, 1.06 here and 140 MB/s, 8.3 with
npTDMS. It also reads cut-off files without a word, and scales single precision in single precision.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from shaker.arrays import FloatArray
from shaker.io.channel import BLOCK, RawChannel, is_time, select_by_either_name
from shaker.io.times import SampleTimes, Segment, agreed_rate, times_of_segments, times_of_stamps

# Where the values of every channel stand in a TDMS file (NI, "TDMS file format internal structure", version 2.0).

_LEAD = 28  # bytes before every segment's metadata
_METADATA, _NEW_LIST, _RAW, _INTERLEAVED, _BIG_ENDIAN = 1 << 1, 1 << 2, 1 << 3, 1 << 5, 1 << 6
_NO_DATA, _AS_BEFORE, _FORMAT_CHANGING, _DIGITAL_LINE = 0xFFFFFFFF, 0, 0x1269, 0x126A
_MOST_CHUNKS = 1_000_000  # of a segment of several cards, which have thousands of rows in each
_UNENDING = 0xFFFFFFFFFFFFFFFF  # length of a segment whose writer never closed it
_STRING, _BOOLEAN, _STAMP = 0x20, 0x21, 0x44
_NUMBERS = {1: "i1", 2: "i2", 3: "i4", 4: "i8", 5: "u1", 6: "u2", 7: "u4", 8: "u8", 9: "f4", 10: "f8"}
_NUMBERS |= {0x19: "f4", 0x1A: "f8", _BOOLEAN: "u1", 0x08000C: "c8", 0x10000D: "c16"}
_CARD_NUMBERS = {0: "u1", 1: "i1", 2: "u2", 3: "i2", 4: "u4", 5: "i4", 6: "u8", 7: "i8", 8: "f4", 9: "f8"}
DAQMX = -1  # no scale: the value itself
_Key = tuple[str, int]  # a channel's path and the number of its raw scale


@dataclass(frozen=True)
class Field:
    """The values of one channel in a record: `count` of type `dtype` from byte `offset` on.

    `scale` tells the raw scales of a card apart (`DAQMX` where the channel has none); `bit` is that of a digital line.
    """

    path: str
    offset: int
    count: int
    dtype: np.dtype[Any]
    scale: int = DAQMX
    bit: int | None = None


@dataclass(frozen=True)
class TdmsRegion:
    """Records of `stride` bytes, `repeats` of them, from byte `position` of the file on."""

    position: int
    stride: int
    repeats: int
    fields: tuple[Field, ...]


@dataclass(frozen=True)
class Dated:
    """What a channel's properties state of its time when the values from number `first` on were written.

    `start`: `wf_start_time` in seconds since 1904, None where it is not set (0). `interval_s`: `wf_increment`, 0 where
    it is not set.
    """

    first: int
    start: Fraction | None
    offset_s: float
    interval_s: float

    @staticmethod
    def of(first: int, properties: Mapping[str, Any]) -> Dated:
        """Return what properties state."""
        start = properties.get("wf_start_time")
        known = Fraction(start) if isinstance(start, Fraction | int) and start > 0 else None  # 0 is 1904: not set
        numbers = (float(properties.get(key) or 0.0) for key in ("wf_start_offset", "wf_increment"))
        return Dated(first, known, *numbers)

    def later(self, other: Dated) -> Dated:
        """Return this statement, completed by a later one where it lacks start or interval."""
        start = other.start if self.start is None else self.start
        return Dated(self.first, start, self.offset_s or other.offset_s, self.interval_s or other.interval_s)

    def contradicts(self, other: Dated) -> bool:
        """Whether two statements differ where both state something."""
        starts = None not in (self.start, other.start) and self.start != other.start
        intervals = 0.0 not in (self.interval_s, other.interval_s) and self.interval_s != other.interval_s
        return starts or intervals or self.offset_s != other.offset_s


@dataclass(frozen=True)
class TdmsIndex:
    """Properties of every object by its path (`/'group'/'channel'`), and the regions of raw values in their order.

    `dated`: what every channel states of its time, once for each change with which values were written.
    """

    properties: dict[str, dict[str, Any]]
    regions: tuple[TdmsRegion, ...]
    dated: dict[str, tuple[Dated, ...]]

    @cached_property
    def types(self) -> dict[str, np.dtype[Any]]:
        """Type of the raw values of every channel by its path."""
        return {own.path: own.dtype for region in self.regions for own in region.fields}

    @cached_property
    def lengths(self) -> dict[_Key, int]:
        """Number of values of every channel and raw scale."""
        lengths: dict[_Key, int] = {}
        for region in self.regions:
            for own in region.fields:
                key = own.path, own.scale
                lengths[key] = lengths.get(key, 0) + own.count * region.repeats
        return lengths


@dataclass(frozen=True)
class _Raw:
    """A channel's part of one chunk: number of values, their type (None: texts), bytes, scales of a card."""

    count: int
    dtype: np.dtype[Any] | None
    size: int
    scales: tuple[tuple[int, Field], ...] = ()  # buffer and place in its records
    widths: tuple[int, ...] = ()


def read_index(path: Path, stream: BinaryIO) -> TdmsIndex:
    """Read the metadata of all segments, and nothing else; `ValueError` where the file is cut off."""
    size = stream.seek(0, 2)
    properties: dict[str, dict[str, Any]] = {}
    known: dict[str, _Raw] = {}
    active: dict[str, bool] = {}
    regions: list[TdmsRegion] = []
    dated: dict[str, list[Dated]] = {}
    counts: dict[str, int] = {}
    position = 0
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
            _read_objects(_Cursor(stream.read(metadata), order), bool(flags & _NEW_LIST), active, known, properties)
        if flags & _RAW:
            chunk = {name: known[name] for name, has_data in active.items() if has_data}
            if flags & _METADATA:
                _date(chunk, properties, dated, counts)
            added = _regions(path, chunk, bool(flags & _INTERLEAVED), start, end - start)
            for region in added:
                for own in region.fields:
                    counts[own.path] = counts.get(own.path, 0) + own.count * region.repeats
            regions += added
        position = end
    _date(dated, properties, dated, counts)
    return TdmsIndex(properties, tuple(regions), {name: tuple(own) for name, own in dated.items()})


def _date(
    names: Iterable[str],
    properties: Mapping[str, dict[str, Any]],
    dated: dict[str, list[Dated]],
    counts: Mapping[str, int],
) -> None:
    """Add what channels state of their time where that has changed since values were last written."""
    for name in names:
        stated = Dated.of(counts.get(name, 0), properties.get(name, {}))
        own = dated.setdefault(name, [])
        if not own or own[-1].contradicts(stated):
            own.append(stated)
        else:
            own[-1] = own[-1].later(stated)


def path_parts(path: str) -> tuple[str, ...]:
    """Return group and channel of an object's path; quotes inside a name are doubled."""
    return tuple(part.replace("''", "'") for part in path[2:-1].split("'/'")) if len(path) > 1 else ()


def _cut_off(path: Path) -> ValueError:
    return ValueError(f"{path}: expected a complete TDMS file, found its last segment cut off")


class _Cursor:
    """Reads one value after another from a segment's metadata."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.place = data, order, 0

    def take(self, codes: str) -> tuple[Any, ...]:
        """Return numbers by their codes of `struct`."""
        codes = self.order + codes
        values = struct.unpack_from(codes, self.data, self.place)
        self.place += struct.calcsize(codes)
        return values

    def text(self) -> str:
        """Return a text with its length before it."""
        (length,) = self.take("L")
        raw = self.take(f"{length}s")[0]
        return bytes(raw).decode("utf-8", "replace")

    def value(self, kind: int) -> Any:
        """Return a property's value; time stamps in seconds since 1904, exactly."""
        if kind == _STRING:
            return self.text()
        if kind == _STAMP:
            parts = self.take("qQ" if self.order == ">" else "Qq")
            seconds, fraction = parts if self.order == ">" else parts[::-1]
            return seconds + Fraction(fraction, 1 << 64)
        dtype = _number_type(kind, self.order)
        value = np.frombuffer(self.data, dtype, 1, self.place)[0].item()
        self.place += dtype.itemsize
        return bool(value) if kind == _BOOLEAN else value


def _number_type(kind: int, order: str) -> np.dtype[Any]:
    """Return numpy's type of TDMS's type number."""
    if kind not in _NUMBERS:
        raise ValueError(f"expected numbers of a known type, found type 0x{kind:X}")
    return np.dtype(order + _NUMBERS[kind])


def _read_objects(
    cursor: _Cursor,
    new_list: bool,
    active: dict[str, bool],
    known: dict[str, _Raw],
    properties: dict[str, dict[str, Any]],
) -> None:
    """Take over what a segment's metadata says about objects, their raw data and properties."""
    if new_list:
        active.clear()
    (objects,) = cursor.take("L")
    for _ in range(objects):
        path = cursor.text()
        (kind,) = cursor.take("L")
        if kind not in (_NO_DATA, _AS_BEFORE):
            known[path] = _card_raw(cursor, path, kind) if kind in (_FORMAT_CHANGING, _DIGITAL_LINE) else _raw(cursor)
        elif kind == _AS_BEFORE and path not in known:
            raise ValueError(f"expected the layout of {path}, found none before its first data")
        active[path] = kind != _NO_DATA
        own = properties.setdefault(path, {})
        for _ in range(cursor.take("L")[0]):
            name = cursor.text()
            own[name] = cursor.value(cursor.take("L")[0])


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
    places = []
    for _ in range(scales):
        code, buffer, offset, *_, scale = cursor.take("LLLLL" if kind == _FORMAT_CHANGING else "LLLBL")
        bit = offset % 8 if kind == _DIGITAL_LINE else None
        place = offset if bit is None else offset // 8
        dtype = np.dtype(cursor.order + _CARD_NUMBERS[code])
        number = scale if channel_kind == _NO_DATA else DAQMX
        places.append((buffer, Field(path, place, 1, dtype, number, bit)))
    widths = cursor.take(f"{cursor.take('L')[0]}L")
    return _Raw(count, np.dtype("f8"), 0, tuple(places), widths)


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
    """Return the regions of a segment of cards: in every chunk one buffer of rows after another."""
    widths = next(iter(chunk.values())).widths
    if any(raw.widths != widths for raw in chunk.values()):
        raise ValueError(f"{path}: expected one layout of all channels of the cards, found several")
    places = [(raw.count, buffer, field) for raw in chunk.values() for buffer, field in raw.scales]
    rows = [max((count for count, at, _ in places if at == buffer), default=0) for buffer in range(len(widths))]
    fields = [tuple(field for _, at, field in places if at == buffer) for buffer in range(len(widths))]
    if len(widths) == 1:
        if not widths[0] or size % widths[0]:
            raise _cut_off(path)
        return [TdmsRegion(position, widths[0], size // widths[0], fields[0])]
    length = sum(row * width for row, width in zip(rows, widths, strict=True))
    if not length or size % length or size // length > _MOST_CHUNKS:
        raise _cut_off(path)
    regions = []
    for start in range(position, position + size, length):
        place = start
        for row, width, own in zip(rows, widths, fields, strict=True):
            regions.append(TdmsRegion(place, width, row, own))
            place += row * width
    return regions


# Channels `group/channel` with their scales.

_SCALES = ("Polynomial", "Linear", "RTD", "Strain", "Table", "Thermistor", "Thermocouple", "Add", "Subtract")
_SCALE_KEY = re.compile(r"NI_Scale\[(\d+)\]_Scale_Type")
_MOST_SCALES = 1000
_SOURCES = ("input_source", "left_input_source", "right_input_source")
_SCALE_BLOCK = 1 << 14  # samples scaled at a time: their intermediate results stay in the cache


@dataclass
class _Sink:
    """Values (S,) of a channel, how many are in, and the scale that each block gets at once (None: none, or later).

    `base_s`: the first second of time stamps, which are counted from it.
    """

    values: FloatArray
    scale: Any = None
    filled: int = 0
    base_s: int | None = None

    def take(self, own: Field, block: bytes, stride: int) -> None:
        """Take the channel's values from a block of records."""
        repeats = len(block) // stride if stride else 1
        raw: NDArray[Any] = np.ndarray((repeats, own.count), own.dtype, block, own.offset, (stride, own.dtype.itemsize))
        if own.bit is not None:
            raw = raw >> own.bit & 1
        elif own.dtype.names:
            self.base_s = int(raw["seconds"][0, 0]) if self.base_s is None else self.base_s
            raw = (raw["seconds"] - self.base_s) + raw["fraction"] * 2.0**-64
        target = self.values[self.filled : self.filled + repeats * own.count]
        target.reshape(repeats, own.count)[...] = raw
        self.filled += len(target)
        if self.scale is not None:
            _apply(self.scale, {own.scale: target})


@dataclass(frozen=True)
class _RawValues:
    """What the library's scales take: values, or values by the number of the raw scale."""

    data: FloatArray | None
    scaler_data: dict[int, FloatArray] = field(default_factory=dict)


def read_tdms(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read channels by `group/channel`, or by the channel's name alone where only one group has it.

    The interval is `wf_increment`, the start `wf_start_time` plus `wf_start_offset`, counted from the earliest of the
    channels asked for. Where these change from write to write, each write keeps its own: pauses stay pauses, two rates
    are refused. A channel `time` (numbers in s or as its `unit_string` says, or time stamps) of the same group and
    length dates channels without interval; others must agree with it. Without either, `sample_rate_hz` counts. Scales
    of the hardware (`NI_Scale`) are applied. Texts and complex numbers are passed over. Memory: the result and one
    block.
    """
    with path.open("rb") as stream:
        index = read_index(path, stream)
        filled = {name for (name, _), length in index.lengths.items() if length}
        series = [name for name, dtype in index.types.items() if dtype.kind in "biuf" and name in filled]
        present = {"/".join(path_parts(name)): name for name in series}
        paths = select_by_either_name(path, names, present, [path_parts(name)[-1] for name in present.values()])
        times = {name: _time_of(name, index) for name in paths.values()}
        wanted = {*paths.values(), *(time for time in times.values() if time)}
        values = _values(path, stream, index, wanted)
        starts = _starts(stream, index, {times[own] or own for own in paths.values()})
    result = {}
    for name, own in paths.items():
        time, where = times[own], f'channel "{name}"'
        unit = str(index.properties.get(own, {}).get("unit_string", ""))
        sampled = _sampled(path, where, index.dated[own], len(values[own]), sample_rate_hz)
        if time is not None:
            at = f'{where}: time channel "{path_parts(time)[-1]}"'
            time_unit = str(index.properties.get(time, {}).get("unit_string", ""))
            stamps = values[time].astype(index.types[time]) if index.types[time].kind in "iu" else values[time]
            given = sample_rate_hz if sampled is None else sampled.rate_hz
            stamped = times_of_stamps(path, at, stamps, time_unit, given_hz=given)
            sampled = stamped if sampled is None or sampled.stamp_s is None else sampled
        assert sampled is not None
        result[name] = RawChannel.from_times(
            replace(sampled, start_s=sampled.start_s + starts.get(time or own, 0.0)), values[own], unit
        )
    return result


def _sampled(path: Path, where: str, dated: Sequence[Dated], count: int, given_hz: float | None) -> SampleTimes | None:
    """Return when a channel's values were taken by its properties, from the first start; None without an interval."""
    first = dated[0]
    if not first.interval_s:
        return None if given_hz is None else SampleTimes(agreed_rate(path, where, None, given_hz))
    agreed_rate(path, where, 1.0 / first.interval_s, given_hz)
    segments = []
    for own, last in zip(dated, (*(after.first for after in dated[1:]), count), strict=True):
        if own.first == last:
            raise ValueError(f"{path}: {where}: expected its time with its values, found it changed after the last one")
        since = 0.0 if own.start is None or first.start is None else float(own.start - first.start)
        segments.append(Segment(since + own.offset_s, last - own.first, own.interval_s or first.interval_s))
    return times_of_segments(path, where, segments)


def _time_of(name: str, index: TdmsIndex) -> str | None:
    """Return the time channel of a channel's group and length."""
    group, *_ = path_parts(name)
    for other in index.types:
        own_group, *tail = path_parts(other)
        fits = index.lengths.get((other, DAQMX)) == index.lengths.get((name, DAQMX))
        if other != name and own_group == group and tail and is_time(tail[0]) and fits:
            return other
    return None


def _values(path: Path, stream: BinaryIO, index: TdmsIndex, wanted: set[str]) -> dict[str, FloatArray]:
    """Return the values of the channels wanted, scaled; time stamps in seconds from their first second.

    A card's channel without scale is its first raw scale.
    """
    size = path.stat().st_size
    for (name, _), length in index.lengths.items():
        if length > 8 * size:  # a sample takes at least a bit
            raise ValueError(f"{path}: channel {name}: expected at most {8 * size} samples, found {length} declared")
    sinks = {key: _Sink(np.empty(length)) for key, length in index.lengths.items() if key[0] in wanted}
    keys = {name: [key for key in sinks if key[0] == name] for name in wanted}
    scales = {name: _scale(path, name, index) for name in wanted}
    for name, own in keys.items():
        if len(own) == 1:
            sinks[own[0]].scale = scales[name]
    for region in index.regions:
        fields = [own for own in region.fields if own.path in wanted]
        if fields:
            _read_region(path, stream, region, fields, sinks)
    for name, own in keys.items():
        if len(own) > 1 and scales[name] is not None:
            _apply(scales[name], {key[1]: sinks[key].values for key in own})
    return {name: sinks[own[0]].values for name, own in keys.items()}


def _read_region(
    path: Path, stream: BinaryIO, region: TdmsRegion, fields: Sequence[Field], sinks: Mapping[_Key, _Sink]
) -> None:
    """Read a region block by block into the channels' arrays."""
    if region.stride > BLOCK:  # a record larger than a block: its channels one by one, in pieces
        for start, own in ((region.position + i * region.stride, own) for i in range(region.repeats) for own in fields):
            most = BLOCK // own.dtype.itemsize
            for first in range(0, own.count, most):
                part = replace(own, offset=0, count=min(most, own.count - first))
                size = part.count * part.dtype.itemsize
                position = start + own.offset + first * own.dtype.itemsize
                sinks[own.path, own.scale].take(part, _read(path, stream, position, size), 0)
        return
    rows = max(1, BLOCK // max(1, region.stride))
    for first in range(0, region.repeats, rows):
        count = min(rows, region.repeats - first)
        block = _read(path, stream, region.position + first * region.stride, count * region.stride)
        for own in fields:
            sinks[own.path, own.scale].take(own, block, region.stride)


def _read(path: Path, stream: BinaryIO, position: int, size: int) -> bytes:
    stream.seek(position)
    block = stream.read(size)
    if len(block) < size:
        raise ValueError(f"{path}: expected a complete TDMS file, found its end at byte {position + len(block)}")
    return block


def _apply(scale: Any, raw: Mapping[int, FloatArray]) -> None:
    """Put scaled values in the place of the first raw ones, some thousand at a time: they stay in the cache."""
    target = next(iter(raw.values()))
    for first in range(0, len(target), _SCALE_BLOCK):
        numbers = {number: values[first : first + _SCALE_BLOCK] for number, values in raw.items()}
        target[first : first + _SCALE_BLOCK] = scale.scale(_RawValues(numbers.get(DAQMX), numbers))


def _scale(path: Path, name: str, index: TdmsIndex) -> Any:
    """Return the library's scale of a channel, None where it has none, or raise `ValueError` for an unknown one."""
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
        place = left.pop()
        own = steps[place] if 0 <= place < len(steps) else None
        left += [getattr(own, source) for source in _SOURCES if hasattr(own, source)]
    raise ValueError(f"{where}: expected scales that build on one another, found more than {_MOST_SCALES} steps")


def _starts(stream: BinaryIO, index: TdmsIndex, wanted: Iterable[str]) -> dict[str, float]:
    """Return by how many seconds every channel begins after the earliest of those wanted, from their time stamps."""
    stamps: dict[str, Fraction] = {}
    for name in wanted:
        stamp = index.dated[name][0].start
        if (dtype := index.types[name]).names:
            fields = ((region, own) for region in index.regions if region.repeats for own in region.fields if own.count)
            stream.seek(next(region.position + own.offset for region, own in fields if own.path == name))
            stamps[name] = Fraction(int(np.frombuffer(stream.read(dtype.itemsize), dtype)["seconds"][0]))
        elif stamp is not None:
            stamps[name] = stamp
    earliest = min(stamps.values(), default=Fraction(0))
    return {name: round(float(stamp - earliest), 12) for name, stamp in stamps.items()}
