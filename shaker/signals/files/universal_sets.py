"""Data sets of universal files, and the functions of data set 58 in them (SDRC/UC-SDRL, "Universal file formats").

The binary form 58b (UC-SDRL, "The binary 58 universal file format") holds the same eleven text records and then the
numbers of record 12 one after another without field widths or line ends, as many bytes as its first line says. Byte
order and floating point format stand in that line. For unevenly spaced values of double precision the description
leaves open whether the abscissa, single precision in the text form, is; the number of bytes tells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from shaker._checks import FloatArray
from shaker.signals.files.common import BLOCK
from shaker.signals.files.text import plain_rows

_MARK = b"-1"
_HEADER = 11  # text records before the numbers of data set 58
_DIRECTIONS = {0: "", 1: "+X", 2: "+Y", 3: "+Z", 4: "+RX", 5: "+RY", 6: "+RZ"}
_DIRECTIONS |= {-key: "-" + text[1:] for key, text in _DIRECTIONS.items() if key}
_NOTHING = ("", "NONE")
_ORDERS = {1: "<", 2: ">"}
_IEEE = 2
_FLOATS = {1: "DEC VMS", 3: "IBM 5/370"}


@dataclass(frozen=True)
class DataSet:
    """One data set: its number, the rest of its first line, and its bytes `start` to `stop` in the file."""

    kind: int
    more: bytes
    line: int
    start: int
    stop: int


@dataclass(frozen=True)
class Axis:
    """What an axis of a function shows: the number of its quantity, its label and unit (empty where not stated)."""

    quantity: int
    label: str
    unit: str


@dataclass(frozen=True)
class FunctionHeader:
    """The text records of a function: its kind, points (`12+Z`), form of the numbers and axes."""

    titles: tuple[str, ...]
    kind: int
    response_name: str
    response_point: str
    reference_name: str
    reference_point: str
    ordinate_type: int
    count: int
    even: bool
    start: float
    step: float
    abscissa: Axis
    ordinate: Axis
    denominator: Axis

    @property
    def is_complex(self) -> bool:
        """Whether every value is two numbers."""
        return self.ordinate_type in (5, 6)

    @property
    def is_double(self) -> bool:
        """Whether the values have double precision."""
        return self.ordinate_type in (4, 6)


def data_sets(path: Path, stream: BinaryIO) -> Iterator[DataSet]:
    """Yield the data sets of a file in their order; `ValueError` where an end mark is missing."""
    line = 0
    while text := stream.readline():
        line += 1
        if not text.strip():
            continue
        if text.strip() != _MARK:
            raise ValueError(f"{path}: line {line}: expected the mark -1 before a data set, found {_shown(text)}")
        first, place = stream.readline(), line
        kind = first[:6].strip()
        if not kind.isdigit():
            raise ValueError(f"{path}: line {line + 1}: expected the number of a data set, found {_shown(first)}")
        start, more = stream.tell(), first[6:]
        if int(kind) == 58 and more[:1].lower() == b"b":
            lines, stop = _HEADER, _skip_binary(path, stream, more, line + 1)
        else:
            lines, stop = _skip_text(path, stream, line + 1)
        line += lines + 2
        yield DataSet(int(kind), more, place + 1, start, stop)


def _skip_text(path: Path, stream: BinaryIO, line: int) -> tuple[int, int]:
    """Move behind the end mark of a text data set; return its number of lines and its end."""
    stop, lines = stream.tell(), 0
    while text := stream.readline():
        if text.strip() == _MARK:
            return lines, stop
        stop, lines = stop + len(text), lines + 1
    raise ValueError(f"{path}: line {line + lines}: expected the end mark -1 of the last data set, found the end")


def _skip_binary(path: Path, stream: BinaryIO, more: bytes, line: int) -> int:
    """Move behind the end mark of a binary data set; return the end of its numbers."""
    records = [stream.readline() for _ in range(_HEADER)]
    head, place = function_header(path, records, line), stream.tell()
    stated = _integer(more[25:37])
    sizes = [size for size in _sizes(head) if size == stated] + [size for size in _sizes(head) if size != stated]
    for size in sizes:
        stream.seek(place + size)
        tail = stream.readline()
        if not tail.strip():
            tail = stream.readline()
        if tail.strip() == _MARK:
            return place + size
    raise ValueError(
        f"{path}: line {line}: expected the end mark -1 after {sizes[0]} bytes of {head.count} values, found none"
    )


def _sizes(head: FunctionHeader) -> list[int]:
    """Return how many bytes the numbers of a binary function may take."""
    value = (8 if head.is_double else 4) * (2 if head.is_complex else 1)
    return [head.count * (value + abscissa) for abscissa in ((0,) if head.even else (4, 8))]


def function_header(path: Path, records: Sequence[bytes], line: int) -> FunctionHeader:
    """Return what the eleven text records of data set 58 say; `line` is that of the data set's number."""
    if len(records) < _HEADER or not records[-1]:
        raise ValueError(f"{path}: line {line}: expected {_HEADER} records of data set 58, found fewer")
    texts = [_decoded(record) for record in records]
    point, form = texts[5].ljust(80), texts[6].ljust(69)
    numbers = _integer(form[:10]), _integer(form[10:20]), _integer(form[20:30])
    if numbers[0] not in (2, 4, 5, 6) or numbers[1] < 0:
        raise ValueError(f"{path}: line {line + 7}: expected type and number of values, found {_shown(records[6])}")
    return FunctionHeader(
        tuple("" if text.strip() in _NOTHING else text.strip() for text in texts[:5]),
        _integer(point[:5]),
        _name(point[31:41]),
        _point(point[41:51], point[51:55]),
        _name(point[56:66]),
        _point(point[66:76], point[76:80]),
        numbers[0],
        numbers[1],
        numbers[2] == 1,
        _real(form[30:43]),
        _real(form[43:56]),
        *(Axis(_integer(text[:10]), _name(text[26:46]), _name(text[47:67])) for text in texts[7:10]),
    )


def function_values(
    path: Path, stream: BinaryIO, data: DataSet, head: FunctionHeader
) -> tuple[FloatArray, NDArray[np.float64] | NDArray[np.complex128]]:
    """Return abscissa (N,) and values (N,) of a function, real or complex as it is stored."""
    stream.seek(data.start)
    for _ in range(_HEADER):
        stream.readline()
    read = _binary if data.more[:1].lower() == b"b" else _text
    columns = read(path, stream, data, head)
    abscissa: FloatArray = head.start + head.step * np.arange(head.count, dtype=np.float64)
    if not head.even:
        abscissa = columns[0]
    first = 0 if head.even else 1
    return abscissa, columns[first] + 1j * columns[first + 1] if head.is_complex else columns[first]


def _binary(path: Path, stream: BinaryIO, data: DataSet, head: FunctionHeader) -> FloatArray:
    """Return the numbers of a binary function (columns, N), read block by block."""
    order, floats = _integer(data.more[1:7]), _integer(data.more[7:13])
    if order not in _ORDERS or floats != _IEEE:
        found = f"byte order {order}, number format {_FLOATS.get(floats, floats)}"
        raise ValueError(f"{path}: line {data.line}: expected byte order 1 or 2 and IEEE 754 numbers, found {found}")
    value = ("f8" if head.is_double else "f4",) * (2 if head.is_complex else 1)
    width = (data.stop - stream.tell()) // max(head.count, 1)
    types = value if head.even else (f"f{width - sum(int(code[1]) for code in value)}", *value)
    record = np.dtype([(str(i), _ORDERS[order] + code) for i, code in enumerate(types)])
    columns = np.empty((len(types), head.count))
    rows = BLOCK // record.itemsize
    for first in range(0, head.count, rows):
        block = np.frombuffer(stream.read(record.itemsize * min(rows, head.count - first)), record)
        for column, name in zip(columns, block.dtype.names or (), strict=True):
            column[first : first + len(block)] = block[name]
    return columns


def _text(path: Path, stream: BinaryIO, data: DataSet, head: FunctionHeader) -> FloatArray:
    """Return the numbers of a text function (columns, N), by the field widths of its case or else by blanks."""
    columns = (2 if head.is_complex else 1) + (0 if head.even else 1)
    start = stream.tell()
    if columns * head.count > data.stop - start:
        raise ValueError(f"{path}: line {data.line}: expected {columns * head.count} numbers, found far fewer")
    numbers, filled = np.empty(columns * head.count), 0
    while (left := data.stop - stream.tell()) > 0:
        block = fixed_width(stream.readlines(min(BLOCK, max(left - 1, 1))), _widths(head))
        if block is None or filled + len(block) > len(numbers):
            filled = -1
            break
        numbers[filled : filled + len(block)] = block
        filled += len(block)
    if filled != len(numbers):
        stream.seek(start)
        free = free_width(stream.read(data.stop - start))
        if free is None or len(free) != len(numbers):
            found = "others" if free is None else f"{len(free)}"
            raise ValueError(f"{path}: line {data.line}: expected {len(numbers)} numbers, found {found}")
        numbers = free
    return np.ascontiguousarray(numbers.reshape(-1, columns).T)


def _widths(head: FunctionHeader) -> tuple[int, ...]:
    """Return the field widths of a line of numbers: cases 1 to 8 of record 12."""
    if not head.is_double:
        return (13,) * 6
    if head.even:
        return (20,) * 4
    return (13, 20, 20) if head.is_complex else (13, 20, 13, 20)


def fixed_width(lines: Sequence[bytes], widths: Sequence[int]) -> FloatArray | None:
    """Return the numbers in lines of fixed fields, None where one is no number; the last line may end early."""
    total = sum(widths)
    padded = b"".join(line.rstrip(b"\r\n").ljust(total)[:total] for line in lines)
    table = np.frombuffer(padded.translate(_EXPONENT), np.uint8).reshape(-1, total)
    spaced = np.full((len(table), total + len(widths)), ord(" "), np.uint8)
    spaced[:, -1] = ord("\n")
    place = 0
    for i, width in enumerate(widths):
        spaced[:, place + i : place + i + width] = table[:, place : place + width]
        place += width
    last = free_width(spaced[-1:].tobytes())
    if len(spaced) < 2 or last is None:
        return last
    rows = plain_rows(spaced[:-1].tobytes(), "")
    return None if rows is None or rows.shape[1] != len(widths) else np.append(rows, last)


def free_width(raw: bytes) -> FloatArray | None:
    """Return the numbers between blanks, None where anything else stands there; Fortran's D is an exponent too."""
    try:
        return np.array(raw.translate(_EXPONENT).split(), dtype=np.float64)
    except ValueError:
        return None


_EXPONENT = bytes.maketrans(b"Dd", b"EE")


def _decoded(record: bytes) -> str:
    """Return a record's text."""
    try:
        return record.decode("utf-8").rstrip("\r\n")
    except UnicodeDecodeError:
        return record.decode("latin-1").rstrip("\r\n")


def _integer(text: str | bytes) -> int:
    """Return a field's whole number, 0 where it is blank."""
    return int(text) if text.strip() else 0


def _real(text: str) -> float:
    """Return a field's number, 0 where it is blank."""
    return float(text.upper().replace("D", "E")) if text.strip() else 0.0


def _name(text: str) -> str:
    """Return a field's text, empty for NONE."""
    return "" if text.strip().upper() in _NOTHING else text.strip()


def _point(node: str, direction: str) -> str:
    """Return node and direction, as 12+Z."""
    return f"{_integer(node)}{_DIRECTIONS.get(_integer(direction), '')}"


def _shown(text: bytes) -> str:
    """Return the beginning of a line for a message."""
    return repr(_decoded(text).strip()[:40])
