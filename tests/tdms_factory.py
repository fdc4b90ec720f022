"""TDMS files byte by byte, from NI's description of the format: segments, properties, raw data of cards."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

NO_DATA, AS_BEFORE = struct.pack("<L", 0xFFFFFFFF), struct.pack("<L", 0)
METADATA, NEW_LIST, RAW, INTERLEAVED, BIG_ENDIAN, DAQMX = 0x02, 0x04, 0x08, 0x20, 0x40, 0x80
KINDS = {"i1": 1, "i2": 2, "i4": 3, "i8": 4, "u1": 5, "u2": 6, "u4": 7, "u8": 8, "f4": 9, "f8": 10}
KINDS |= {"c16": 0x10000D, "stamp": 0x44}
CARD_KINDS = {"u1": 0, "i1": 1, "u2": 2, "i2": 3, "u4": 4, "i4": 5}
Property = str | float | int | bool | Fraction


def text(value: str, order: str = "<") -> bytes:
    """A text with its length before it."""
    raw = value.encode()
    return struct.pack(f"{order}L", len(raw)) + raw


def value(item: Property, order: str = "<") -> bytes:
    """A property's type and value; a `Fraction` is a time stamp in seconds since 1904."""
    if isinstance(item, bool):
        return struct.pack(f"{order}LB", 0x21, item)
    if isinstance(item, Fraction):
        parts = [("q", item.__floor__()), ("Q", int((item - item.__floor__()) * 2**64))]
        parts = parts if order == ">" else parts[::-1]
        return struct.pack(f"{order}L{''.join(code for code, _ in parts)}", 0x44, *(number for _, number in parts))
    if isinstance(item, str):
        return struct.pack(f"{order}L", 0x20) + text(item, order)
    return struct.pack(f"{order}Ld", 10, item) if isinstance(item, float) else struct.pack(f"{order}Li", 3, item)


def plain(kind: str, count: int, order: str = "<") -> bytes:
    """The raw data index of a channel of numbers or time stamps."""
    return struct.pack(f"{order}LLLQ", 20, KINDS[kind], 1, count)


def texts(count: int, size: int) -> bytes:
    """The raw data index of a channel of texts."""
    return struct.pack("<LLLQQ", 28, 0x20, 1, count, size)


def card(
    count: int, scales: Sequence[tuple[str, int, int, int]], widths: Sequence[int], digital: bool = False
) -> bytes:
    """The raw data index of a channel of cards: (type, buffer, place, number) of every raw scale, widths of buffers."""
    index = struct.pack("<LLLQL", 0x126A if digital else 0x1269, 0xFFFFFFFF, 1, count, len(scales))
    for kind, buffer, first_byte, number in scales:
        codes = "LLLBL" if digital else "LLLLL"
        index += struct.pack("<" + codes, CARD_KINDS[kind], buffer, first_byte, 0, number)
    return index + struct.pack(f"<L{len(widths)}L", len(widths), *widths)


def entry(path: str, index: bytes, properties: Mapping[str, Property] | None = None, order: str = "<") -> bytes:
    """One object of a segment's metadata."""
    entries = properties or {}
    listed = b"".join(text(name, order) + value(item, order) for name, item in entries.items())
    return text(path, order) + index + struct.pack(f"{order}L", len(entries)) + listed


def segment(entries: Sequence[bytes], raw: bytes, flags: int = METADATA | NEW_LIST | RAW) -> bytes:
    """A segment: lead-in, metadata, raw data."""
    order = ">" if flags & BIG_ENDIAN else "<"
    metadata = struct.pack(f"{order}L", len(entries)) + b"".join(entries) if flags & METADATA else b""
    lead = (
        b"TDSm" + struct.pack("<L", flags) + struct.pack(f"{order}LQQ", 4713, len(metadata) + len(raw), len(metadata))
    )
    return lead + metadata + raw


def linear(slope: float, offset: float) -> dict[str, Property]:
    """The properties of a linear scale."""
    return {
        "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Scale_Type": "Linear",
        "NI_Scale[0]_Linear_Slope": slope,
        "NI_Scale[0]_Linear_Y_Intercept": offset,
    }


def interleaved(*columns: np.ndarray) -> bytes:
    """Rows of one value per channel, each of its own type."""
    rows = np.empty(len(columns[0]), np.dtype([(str(i), column.dtype) for i, column in enumerate(columns)]))
    for i, column in enumerate(columns):
        rows[str(i)] = column
    return rows.tobytes()
