"""Where the values of every channel stand in a TDMS file (NI, "TDMS file format internal structure", version 2.0)."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_LEAD = 28  # bytes before every segment's metadata
_METADATA, _NEW_LIST, _RAW, _INTERLEAVED, _BIG_ENDIAN = 1 << 1, 1 << 2, 1 << 3, 1 << 5, 1 << 6
_NO_DATA, _AS_BEFORE, _FORMAT_CHANGING, _DIGITAL_LINE = 0xFFFFFFFF, 0, 0x1269, 0x126A
_UNENDING = 0xFFFFFFFFFFFFFFFF  # length of a segment whose writer never closed it
_STRING, _BOOLEAN, _STAMP = 0x20, 0x21, 0x44
_NUMBERS = {1: "i1", 2: "i2", 3: "i4", 4: "i8", 5: "u1", 6: "u2", 7: "u4", 8: "u8", 9: "f4", 10: "f8"}
_NUMBERS |= {0x19: "f4", 0x1A: "f8", _BOOLEAN: "u1", 0x08000C: "c8", 0x10000D: "c16"}
_CARD_NUMBERS = {0: "u1", 1: "i1", 2: "u2", 3: "i2", 4: "u4", 5: "i4", 6: "u8", 7: "i8", 8: "f4", 9: "f8"}
DAQMX = -1  # no scale: the value itself


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
class Region:
    """Records of `stride` bytes, `repeats` of them, from byte `position` of the file on."""

    position: int
    stride: int
    repeats: int
    fields: tuple[Field, ...]


@dataclass(frozen=True)
class TdmsIndex:
    """Properties of every object by its path (`/'group'/'channel'`), and the regions of raw values in their order."""

    properties: dict[str, dict[str, Any]]
    regions: tuple[Region, ...]


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
    regions: list[Region] = []
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
            regions += _regions(path, chunk, bool(flags & _INTERLEAVED), start, end - start)
        position = end
    return TdmsIndex(properties, tuple(regions))


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
    """Read the index of plain raw data."""
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


def _regions(path: Path, chunk: Mapping[str, _Raw], interleaved: bool, position: int, size: int) -> list[Region]:
    """Return the regions of one segment's raw data."""
    if any(raw.widths for raw in chunk.values()):
        return _card_regions(path, chunk, position, size)
    length = sum(raw.size for raw in chunk.values())
    if not length or not size:
        return []
    offsets = np.cumsum([0] + [raw.size for raw in chunk.values()]).tolist()
    if interleaved and not any(raw.dtype is None for raw in chunk.values()):
        if len({raw.count for raw in chunk.values()}) > 1:
            raise ValueError(f"{path}: expected equally many values of all interleaved channels, found different ones")
        count = next(iter(chunk.values())).count
        offsets, length, chunk = (
            [o // count for o in offsets],
            length // count,
            {name: _Raw(1, raw.dtype, raw.size // count) for name, raw in chunk.items()},
        )
    if size % length:
        raise _cut_off(path)
    fields = tuple(
        Field(name, offset, raw.count, raw.dtype)
        for (name, raw), offset in zip(chunk.items(), offsets, strict=False)
        if raw.dtype is not None
    )
    return [Region(position, length, size // length, fields)]


def _card_regions(path: Path, chunk: Mapping[str, _Raw], position: int, size: int) -> list[Region]:
    """Return the regions of a segment of cards: in every chunk one buffer of rows after another."""
    widths = next(iter(chunk.values())).widths
    if any(raw.widths != widths for raw in chunk.values()):
        raise ValueError(f"{path}: expected one layout of all channels of the cards, found several")
    places = [(raw.count, buffer, field) for raw in chunk.values() for buffer, field in raw.scales]
    rows = [max((count for count, at, _ in places if at == buffer), default=0) for buffer in range(len(widths))]
    fields = [tuple(field for _, at, field in places if at == buffer) for buffer in range(len(widths))]
    if len(widths) == 1:
        if size % widths[0]:
            raise _cut_off(path)
        return [Region(position, widths[0], size // widths[0], fields[0])]
    length = sum(row * width for row, width in zip(rows, widths, strict=True))
    if not length or size % length:
        raise _cut_off(path)
    regions = []
    for start in range(position, position + size, length):
        place = start
        for row, width, own in zip(rows, widths, fields, strict=True):
            regions.append(Region(place, width, row, own))
            place += row * width
    return regions
