"""Universal files: data sets 55, 58 and 58b (SDRC/UC-SDRL, "Universal file formats").

The binary form 58b (UC-SDRL, "The binary 58 universal file format") has the same eleven text records. Then follow the
numbers of record 12 without field widths or line ends. The first line states their number of bytes, byte order and
floating-point format. For unevenly spaced values of double precision the description does not define the precision of
the abscissa, which is single in the text form. The number of bytes determines it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from shaker.io.channel import (
    BLOCK,
    LONGEST_LINE,
    RawChannel,
    SampleTimes,
    agreed_rate,
    as_sample_array,
    convert_read_errors,
    seconds_of,
    select_names,
    times_of_stamps,
)
from shaker.io.text import plain_rows
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, IntArray

# Data sets, and the functions of data set 58 in them.

_MARK = b"-1"
_HEADER = 11  # text records before the numbers of data set 58
_DIRECTIONS = {0: "", 1: "+X", 2: "+Y", 3: "+Z", 4: "+RX", 5: "+RY", 6: "+RZ"}
_DIRECTIONS |= {-key: "-" + text[1:] for key, text in _DIRECTIONS.items() if key}
_UNSTATED = ("", "NONE")
_ORDERS = {1: "<", 2: ">"}
_IEEE = 2
_FLOATS = {1: "DEC VMS", 3: "IBM 5/370"}


@dataclass(frozen=True)
class DataSet:
    """One data set: number, rest of its first line, and byte range."""

    kind: int
    more: bytes
    line: int
    start: int
    stop: int


@dataclass(frozen=True)
class FunctionHeader:
    """Text records of a function: kind, points (`12+Z`), form of the numbers, and axes."""

    titles: tuple[str, ...]
    kind: int
    response_name: str
    response_point: str
    reference_point: str
    ordinate_type: int
    count: int
    even: bool
    start: float
    step: float
    ordinate_label: str
    abscissa_unit: str
    ordinate_unit: str
    denominator_unit: str

    @property
    def is_complex(self) -> bool:
        """Whether every value is two numbers."""
        return self.ordinate_type in (5, 6)

    @property
    def is_double(self) -> bool:
        """Whether the values have double precision."""
        return self.ordinate_type in (4, 6)


def data_sets(path: Path, stream: BinaryIO) -> Iterator[DataSet]:
    """Yield the data sets of a file in order; `ValueError` without an end mark."""
    line = 0
    while text := stream.readline(LONGEST_LINE):
        line += 1
        if not text.strip():
            continue
        if text.strip() != _MARK:
            raise ValueError(f"{path}: line {line}: expected the mark -1 before a data set, found {_show(text)}")
        first, line_number = stream.readline(), line
        kind = first[:6].strip()
        if not kind.isdigit():
            raise ValueError(f"{path}: line {line + 1}: expected the number of a data set, found {_show(first)}")
        start, more = stream.tell(), first[6:]
        if int(kind) == 58 and more[:1].lower() == b"b":
            lines, stop = _HEADER, _skip_binary(path, stream, more, line + 1)
        else:
            lines, stop = 0, stream.tell()
            while (text := stream.readline(LONGEST_LINE)).strip() != _MARK:
                if not text:
                    end = "the end mark -1 of the last data set, found the end"
                    raise ValueError(f"{path}: line {line + 1 + lines}: expected {end}")
                stop, lines = stop + len(text), lines + 1
        line += lines + 2
        yield DataSet(int(kind), more, line_number + 1, start, stop)


def _skip_binary(path: Path, stream: BinaryIO, more: bytes, line: int) -> int:
    """Skip a binary data set and its end mark; return its last byte."""
    records = [stream.readline() for _ in range(_HEADER)]
    head, position = function_header(path, records, line), stream.tell()
    stated = _integer(more[25:37])
    value = (8 if head.is_double else 4) * (2 if head.is_complex else 1)
    sizes = [head.count * (value + abscissa) for abscissa in ((0,) if head.even else (4, 8))]
    sizes.sort(key=lambda size: size != stated)
    for size in sizes:
        stream.seek(position + size)
        tail = stream.readline()
        if not tail.strip():
            tail = stream.readline()
        if tail.strip() == _MARK:
            return position + size
    raise ValueError(
        f"{path}: line {line}: expected the end mark -1 after {sizes[0]} bytes of {head.count} values, found none"
    )


def function_header(path: Path, records: Sequence[bytes], line: int) -> FunctionHeader:
    """Return the content of the eleven text records after the number of data set 58."""
    if len(records) < _HEADER or not records[-1]:
        raise ValueError(f"{path}: line {line}: expected {_HEADER} records of data set 58, found fewer")
    texts = [_decode(record) for record in records]
    point, form = texts[5].ljust(80), texts[6].ljust(69)
    numbers = _integer(form[:10]), _integer(form[10:20]), _integer(form[20:30])
    if numbers[0] not in (2, 4, 5, 6) or numbers[1] < 0:
        raise ValueError(f"{path}: line {line + 7}: expected type and number of values, found {_show(records[6])}")
    return FunctionHeader(
        tuple(map(_name, texts[:5])),
        _integer(point[:5]),
        _name(point[31:41]),
        _point(point[41:51], point[51:55]),
        _point(point[66:76], point[76:80]),
        numbers[0],
        numbers[1],
        numbers[2] == 1,
        _real(form[30:43]),
        _real(form[43:56]),
        _name(texts[8][26:46]),
        *(_name(text[47:67]) for text in texts[7:10]),
    )


def function_values(
    path: Path, stream: BinaryIO, data: DataSet, head: FunctionHeader
) -> tuple[FloatArray, NDArray[np.float64] | NDArray[np.complex128]]:
    """Return abscissa (N,) and values (N,) of a function, real or complex as stored."""
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
    """Return the numbers of a text function (columns, N), in fixed fields or between blanks."""
    columns = (2 if head.is_complex else 1) + (0 if head.even else 1)
    start = stream.tell()
    if columns * head.count > data.stop - start:
        raise ValueError(f"{path}: line {data.line}: expected {columns * head.count} numbers, found far fewer")
    # Field widths of a line of numbers: cases 1 to 8 of record 12.
    widths: tuple[int, ...] = (13, 20, 20) if head.is_complex else (13, 20, 13, 20)
    if head.even or not head.is_double:
        widths = (20,) * 4 if head.is_double else (13,) * 6
    numbers, filled = np.empty(columns * head.count), 0
    while (left := data.stop - stream.tell()) > 0:
        block = fixed_width(stream.readlines(min(BLOCK, max(left - 1, 1))), widths)
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


def fixed_width(lines: Sequence[bytes], widths: Sequence[int]) -> FloatArray | None:
    """Return the numbers in lines of fixed fields; None for other content."""
    total = sum(widths)
    padded = b"".join(line.rstrip(b"\r\n").ljust(total)[:total] for line in lines)
    table = np.frombuffer(padded.translate(_EXPONENT), np.uint8).reshape(-1, total)
    spaced = np.full((len(table), total + len(widths)), ord(" "), np.uint8)
    spaced[:, -1] = ord("\n")
    position = 0
    for i, width in enumerate(widths):
        spaced[:, position + i : position + i + width] = table[:, position : position + width]
        position += width
    last = free_width(spaced[-1:].tobytes())
    if len(spaced) < 2 or last is None:
        return last
    rows = plain_rows(spaced[:-1].tobytes(), "")
    return None if rows is None or rows.shape[1] != len(widths) else np.append(rows, last)


def free_width(raw: bytes) -> FloatArray | None:
    """Return the numbers between blanks, None for other content; Fortran's D is an exponent too."""
    try:
        return np.array(raw.translate(_EXPONENT).split(), dtype=np.float64)
    except ValueError:
        return None


_EXPONENT = bytes.maketrans(b"Dd", b"EE")


def _decode(record: bytes) -> str:
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
    return "" if text.strip().upper() in _UNSTATED else text.strip()


def _point(node: str, direction: str) -> str:
    """Return node and direction, as 12+Z."""
    return f"{_integer(node)}{_DIRECTIONS.get(_integer(direction), '')}"


def _show(text: bytes) -> str:
    return repr(_decode(text).strip()[:40])


# Universal files: mode shapes and operating deflection shapes, data set 55 (data at nodes).

_ANALYSES = (
    "unknown", "static", "normal mode", "complex mode, first order", "transient", "frequency response", "buckling",
    "complex mode, second order",
)  # fmt: skip
_QUANTITIES = {0: "unknown", 1: "general", 8: "displacement", 9: "reaction force", 11: "velocity", 12: "acceleration"}
_MODE, _TRANSIENT, _RESPONSE, _COMPLEX_MODES = 2, 4, 5, (3, 7)
_COMPLEX = 5  # data type of complex values


@dataclass(frozen=True)
class UniversalShape(Arrays, shapes="node N; value N D"):
    """A shape at nodes, from data set 55.

    Attributes
    ----------
    node : (N,), node numbers.
    value : (N, D), D components in the order x, y, z (, rx, ry, rz).
    analysis, quantity : in words ("normal mode", "frequency response"; "displacement", …).
    frequency_hz : frequency in Hz, NaN where the analysis has none.
    damping_ratio : NaN where the file states none.
    time_s : time of a transient in s, else NaN.
    titles : text lines of the data set.
    """

    node: IntArray
    value: ComplexArray
    analysis: str
    quantity: str
    frequency_hz: float
    damping_ratio: float
    time_s: float
    titles: tuple[str, ...]


def read_universal_shapes(path: str | Path) -> tuple[UniversalShape, ...]:
    """Read all shapes of a universal file in their order; other data sets are skipped.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    One `UniversalShape` for each data set 55.

    Raises
    ------
    OSError, ValueError
        The file cannot be read.

    Examples
    --------
    >>> from shaker import read_universal_shapes
    >>> entries = read_universal_shapes("modes.unv")  # doctest: +SKIP
    """
    path = Path(path)
    shapes = []
    with convert_read_errors(path), path.open("rb") as stream:
        for data in list(data_sets(path, stream)):
            if data.kind == 55:
                stream.seek(data.start)
                shapes.append(_shape(path, data.line, stream.read(data.stop - data.start).splitlines()))
    return tuple(shapes)


def _shape(path: Path, line: int, lines: list[bytes]) -> UniversalShape:
    """Return the shape in the lines of one data set."""
    if len(lines) < 8:
        raise ValueError(f"{path}: line {line}: expected at least 8 records of data set 55, found {len(lines)}")
    _, analysis, _, quantity, data_type, components = _integers(lines[5], 6)
    counts = _integers(lines[6], 2)
    first_real_line = 7 + (2 + counts[0] - 1) // 8  # eight whole numbers a line, its two counts among them
    real_lines = max(1, -(-counts[1] // 6))
    reals = _reals(path, line, lines[first_real_line : first_real_line + real_lines])
    values = components * (2 if data_type == _COMPLEX else 1)
    rows, each = [text for text in lines[first_real_line + real_lines :] if text.strip()], 1 + max(1, -(-values // 6))
    if not rows or len(rows) % each:
        raise ValueError(f"{path}: line {line}: expected {each} lines for every node, found {len(rows)} in all")
    node = np.array([_integers(text, 1)[0] for text in rows[::each]], dtype=np.int64)
    cells = [text for i, text in enumerate(rows) if i % each]
    value = _reals(path, line, cells, len(node) * values).reshape(len(node), values)
    complex_value = value[:, ::2] + 1j * value[:, 1::2] if data_type == _COMPLEX else value.astype(complex)
    frequency, damping, time = _abscissa(analysis, reals)
    return UniversalShape(
        node,
        complex_value,
        _ANALYSES[analysis] if 0 <= analysis < len(_ANALYSES) else f"analysis type {analysis}",
        _QUANTITIES.get(quantity, f"data type {quantity}"),
        frequency,
        damping,
        time,
        tuple(_name(_decode(text)) for text in lines[:5]),
    )


def _abscissa(analysis: int, reals: np.ndarray) -> tuple[float, float, float]:
    """Return frequency, damping ratio and time of a shape from its real parameters."""
    reals = np.concatenate([reals, np.full(4, np.nan)])
    if analysis == _MODE:
        return float(reals[0]), float(reals[2]), np.nan
    if analysis == _RESPONSE:
        return float(reals[0]), np.nan, np.nan
    if analysis in _COMPLEX_MODES:
        eigenvalue = complex(reals[0], reals[1])
        size = abs(eigenvalue)
        return size / (2.0 * np.pi), -eigenvalue.real / size if size else np.nan, np.nan
    return np.nan, np.nan, float(reals[0]) if analysis == _TRANSIENT else np.nan


def _integers(text: bytes, count: int) -> list[int]:
    return [int(cell) for cell in text.split()[:count]] + [0] * (count - len(text.split()[:count]))


def _reals(path: Path, line: int, lines: list[bytes], count: int | None = None) -> np.ndarray:
    """Return the numbers (`count` if stated) in fields of 13, or between blanks."""
    for values in (fixed_width(lines, (13,) * 6), free_width(b" ".join(lines))):
        if values is not None and count in (None, len(values)):
            return values
    raise ValueError(f"{path}: line {line}: expected {count or 'some'} values of data set 55, found others")


# Universal files: time responses and other functions of data set 58, text and binary.

_TIME_RESPONSE = 1
_DIGIT, _HALF_DIGIT = 1e-5, 5e-6  # relative, of numbers with six significant digits
_KINDS = (
    "general", "time response", "auto spectrum", "cross spectrum", "frequency response", "transmissibility",
    "coherence", "auto correlation", "cross correlation", "power spectral density", "energy spectral density",
    "probability density", "spectrum",
)  # fmt: skip


@dataclass(frozen=True)
class UniversalFunction(Arrays, shapes="abscissa N; value N"):
    """A function of data set 58: `value` (N,) over `abscissa` (N,).

    Values are real or complex as stored. `kind` is in words ("frequency response", "spectrum", …). `response` and
    `reference` are node and direction (`12+Z`). `unit` is that of the ordinate, divided by that of its denominator
    where it has one (`(m/s^2)/N`). Texts are empty where the file has none. Frequency responses keep the sign
    convention of the file. Universal files state none; exp(+jωt) is usual.
    """

    name: str
    kind: str
    abscissa: FloatArray
    value: NDArray[np.float64] | NDArray[np.complex128]
    abscissa_unit: str
    unit: str
    response: str
    reference: str
    titles: tuple[str, ...] = ()


def read_universal(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read the time responses of a universal file.

    The name of a channel is its response entity name, else the label of its ordinate, else node and direction (`12+Z`).
    Names that occur twice get node and direction appended, then their position in the file (`Mic #2`). Text headers
    have a sampling interval of six digits, so that a clock may be wrong by several parts in 10⁷; the trigger edges
    correct that.
    """
    headers = _headers(path)
    present = {name: item for name, item in _name_functions(headers).items() if item[1].kind == _TIME_RESPONSE}
    result = {}
    with path.open("rb") as stream:
        for name in select_names(path, names, present):
            data, head = present[name]
            times, values = function_values(path, stream, data, head)
            where = f'channel "{name}"'
            unit, axis = head.abscissa_unit, f"{where}: abscissa"
            if head.even:
                second = seconds_of(path, axis, unit)
                stated = 1.0 / (head.step * second) if head.step else None
                rate = agreed_rate(path, where, stated, sample_rate_hz, _HALF_DIGIT)
                sampled = SampleTimes(rate, head.start * second)
            else:
                digit = None if data.more[:1].lower() == b"b" else _DIGIT * float(np.max(np.abs(times)))
                sampled = times_of_stamps(path, axis, times, unit, digit=digit, given_hz=sample_rate_hz)
            result[name] = RawChannel.from_times(sampled, as_sample_array(path, name, values), head.ordinate_unit)
    return result


def read_universal_functions(path: str | Path) -> tuple[UniversalFunction, ...]:
    """Read all functions of data set 58: frequency responses, spectra, and time responses.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    One `UniversalFunction` for each data set 58, in the order of the file.

    Raises
    ------
    OSError, ValueError
        The file cannot be read.

    Examples
    --------
    >>> from shaker import read_universal_functions
    >>> entries = read_universal_functions("modes.unv")  # doctest: +SKIP
    """
    path = Path(path)
    with convert_read_errors(path):
        headers = _headers(path)
        with path.open("rb") as stream:
            functions = []
            for name, (data, head) in _name_functions(headers).items():
                abscissa, value = function_values(path, stream, data, head)
                kind = _KINDS[head.kind] if 0 <= head.kind < len(_KINDS) else f"function type {head.kind}"
                unit = head.ordinate_unit
                if head.denominator_unit:
                    unit = f"({unit})/({head.denominator_unit})"
                points = head.response_point, head.reference_point
                functions.append(
                    UniversalFunction(name, kind, abscissa, value, head.abscissa_unit, unit, *points, head.titles)
                )
            return tuple(functions)


def _headers(path: Path) -> list[tuple[DataSet, FunctionHeader]]:
    """Return the functions of a file without their numbers."""
    with path.open("rb") as stream:
        found = list(data_sets(path, stream))
        if not found:
            raise ValueError(f"{path}: expected data sets of a universal file, found none")
        headers = []
        for data in found:
            if data.kind == 58:
                stream.seek(data.start)
                records = [stream.readline() for _ in range(11)]
                headers.append((data, function_header(path, records, data.line)))
    return headers


def _name_functions(headers: list[tuple[DataSet, FunctionHeader]]) -> dict[str, tuple[DataSet, FunctionHeader]]:
    plain = [head.response_name or head.ordinate_label or head.response_point for _, head in headers]
    count = Counter(plain)
    full = [
        name if count[name] == 1 else f"{name} {head.response_point}".strip()
        for name, (_, head) in zip(plain, headers, strict=True)
    ]
    count = Counter(full)
    return {
        name if count[name] == 1 else f"{name} #{i + 1}": item
        for i, (name, item) in enumerate(zip(full, headers, strict=True))
    }
