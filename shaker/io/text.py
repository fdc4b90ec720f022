"""Rows of numbers in text files, and scan files.

Text export of a scanning vibrometer, as in PTB's data set 10.7795/720.20181105 (`Scan_time.asc`).

The published description (content.txt) states this order. From line 19 the file has the x, y, z coordinates of the scan
points. The next line has the number of samples and the sampling interval (line 29 in one file, 44 in another). Then
follow data blocks with one data set per scan point. Block 1 is the vibrometer, blocks 2 and 3 are reference, force or
camera trigger. This module decides the points that the description does not define:

- Coordinates are metres. A scan point is a line of exactly three numbers; the list ends at the first other line.
- The acquisition line is the first line after the list with exactly two numbers, a whole number of samples and a
  positive interval in seconds.
- Numbers are separated by blanks, tabs or semicolons, with a decimal point or comma. Lines with other content (titles,
  blank lines) are skipped.
- A block is a table of one row per sample with one column per scan point. Where rows have another length, it is the
  data sets of its points one after another. All blocks have the same size; their number is arbitrary.
- Units are not read from the file: the manifest's scale converts.
- The first sample of every data set is at time zero.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO

import numpy as np

from shaker.io.channel import (
    BLOCK,
    LONGEST_LINE,
    RawChannel,
    agreed_rate,
    convert_read_errors,
    select_names,
)
from shakercal._common.arrays import Arrays, FloatArray

# Rows of numbers in text files: whole blocks at once, line by line only for unusual blocks.

_COMMENT = "#"
_SAMPLE = 1 << 12  # bytes of a table from which the digits of its times are read
_LATIN = 0.8  # least share of letters below 256 in a text of UTF-16 without mark
_COMMA_TO_POINT = bytes.maketrans(b",", b".")
_GROUPED = re.compile(r"[-+]?\d{1,3}(?:([.,'\u2019 \u00a0\u202f])\d{3})(?:\1\d{3})*(?:[.,]\d*)?")  # 1.234.567,8
_FOOTER = re.compile(rb"\W*(?!nan|inf|over|under|null|n/?a)[A-Za-z]{2}", re.IGNORECASE)
_NO_SAMPLE = re.compile(
    r"[-+]?\d*[.,]?\d*#(?:[QS]NAN|IND)\d*|-+|#?(?:NV|N/?A|NULL)|\*+", re.IGNORECASE
)  # 1.#QNAN, ---, #NV


@dataclass(frozen=True)
class TextLayout:
    """Layout of rows; with `remarks`, text after the last column is a remark.

    `comma`: the decimal sign is a comma, or may be one; `grouped`: it is one, so that points group thousands.
    """

    path: Path
    columns: int
    delimiter: str
    comma: bool
    remarks: bool = False
    grouped: bool = False


def open_text(path: Path) -> BinaryIO:
    """Open a text file.

    UTF-16, with or without mark, and lines that end by CR alone are converted in memory.
    """
    stream = path.open("rb")
    sample = stream.read(_SAMPLE)
    encoding, returns = _utf16(sample), b"\r" in sample and b"\n" not in sample
    stream.seek(0)
    if not (encoding or returns):
        return stream
    with stream:
        raw = stream.read()
    text = raw.decode(encoding, "replace").lstrip("\ufeff").encode() if encoding else raw
    return BytesIO(text.replace(b"\r", b"\n") if returns else text)


def end_of_rows(path: Path) -> int:
    """Return the end of the rows in the stream of `open_text`, without a footer."""
    with open_text(path) as stream:
        end = stream.seek(0, 2)
        start = stream.seek(max(0, end - _SAMPLE))
        lines = stream.read().splitlines(keepends=True)[start > 0 :]
    while lines and (not lines[-1].strip() or _FOOTER.match(lines[-1])):
        end -= len(lines.pop())
    return end


def _utf16(raw: bytes) -> str:
    """Return the name of an encoding of two bytes per letter, empty for any other."""
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    odd, even = raw[1::2].count(0), raw[::2].count(0)
    least = _LATIN * max(len(raw) // 2, 8)
    return "utf-16-le" if odd > least and not even else "utf-16-be" if even > least and not odd else ""


def read_columns(layout: TextLayout, start: int, stop: int, line: int, numbers: Sequence[int]) -> dict[int, FloatArray]:
    """Return columns (S,) by index from the rows in bytes `start` to `stop`.

    The first row is in line `line`. Empty cells are NaN. Empty lines and lines that begin with # are skipped. Memory:
    the result and one block.
    """
    columns = [np.empty(0) for _ in numbers]
    filled = 0
    with open_text(layout.path) as stream:
        for position, block in whole_lines(stream, start, stop):
            rows = _whole_block(layout, block)
            rows = _line_by_line(layout, block, line, numbers) if rows is None else rows[:, list(numbers)]
            line += block.count(b"\n")
            if columns and filled + len(rows) > len(columns[0]):
                share = (position - start) / (stop - start)
                capacity = max(filled + len(rows), int((filled + len(rows)) / share * 1.01))
                for column in columns:
                    column.resize(capacity, refcheck=False)
            for column, values in zip(columns, rows.T, strict=True):
                column[filled : filled + len(rows)] = values
            filled += len(rows)
    for column in columns:
        column.resize(filled, refcheck=False)
    if not filled:
        raise ValueError(f"{layout.path}: line {line}: expected rows of numbers, found none")
    return dict(zip(numbers, columns, strict=True))


def last_digit(layout: TextLayout, start: int, stop: int, column: int) -> float:
    """Return the last printed digit of a column, 0.001 for 12.345.

    The rows are in bytes `start` to `stop`. Of the first and the last rows the coarser digit is returned. Trailing
    zeros may be missing, and numbers with a fixed number of significant digits become coarser as they grow.
    """
    digits = []
    with open_text(layout.path) as stream:
        for first, last in ((start, min(start + _SAMPLE, stop)), (max(start, stop - _SAMPLE), stop)):
            stream.seek(first)
            lines = decode_text(stream.read(last - first)).splitlines()[first > start : None if last == stop else -1]
            rows = (line.split(layout.delimiter or None) for line in lines if not line.startswith(_COMMENT))
            cells = [row[column].strip().strip('"') for row in rows if len(row) > column]
            digits.append(min((digit_of(cell, layout.comma) for cell in cells if cell), default=0.0))
    return max(digits)


def digit_of(cell: str, comma: bool) -> float:
    """Return the last printed digit of a number: 0.001 for 1.2345E1."""
    mantissa, _, exponent = cell.lower().replace(",", "." if comma else ",").partition("e")
    try:
        return float(10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])))
    except (ValueError, OverflowError):
        return np.inf


def find_bytes(stream: BinaryIO, text: bytes, start: int, stop: int) -> int:
    """Return the position of a text in a range of bytes, -1 if absent."""
    with mmap(stream.fileno(), 0, access=ACCESS_READ) as mapped:
        return mapped.find(text, start, stop)


def decode_text(raw: bytes) -> str:
    """Return text that is UTF-8, with or without mark, or else Latin-1."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def whole_lines(stream: BinaryIO, start: int, stop: int) -> Iterator[tuple[int, bytes]]:
    """Yield end position and content of blocks of whole lines, each with a line end."""
    stream.seek(start)
    rest = b""
    while start < stop and (block := stream.read(min(BLOCK, stop - start))):
        start += len(block)
        head, mark, tail = block.rpartition(b"\n")
        if mark:
            yield start - len(tail), rest + head + mark
            rest = tail
        else:
            rest += tail
            check_line(rest)
    if rest.strip():
        yield stop, rest + b"\n"


def check_line(line: bytes) -> None:
    """Raise `ValueError` for a line longer than any text has."""
    if len(line) > LONGEST_LINE:
        raise ValueError(f"a line of more than {LONGEST_LINE >> 20} MiB")


def _whole_block(layout: TextLayout, block: bytes) -> FloatArray | None:
    """Return the rows of a purely numeric block of equal rows, else None."""
    delimiter = layout.delimiter.encode()
    block = block.replace(b"\r\n", b"\n")
    if layout.comma:
        if layout.grouped and b"." in block:
            return None
        block = block.translate(_COMMA_TO_POINT)
    empty_first = bool(delimiter) and block.startswith(delimiter)
    if empty_first:
        block = block[1:].replace(b"\n" + delimiter, b"\n")
    if delimiter and block.find(delimiter + b"\n", 0, block.find(b"\n") + 1) >= 0:
        block = block.replace(delimiter + b"\n", b"\n")
    rows = plain_rows(block, layout.delimiter)
    if rows is None or rows.shape[1] != layout.columns - empty_first:
        return None
    return np.pad(rows, ((0, 0), (1, 0)), constant_values=np.nan) if empty_first else rows


def plain_rows(block: bytes, delimiter: str) -> FloatArray | None:
    """Return the rows (S, columns) of a purely numeric block, else None."""
    if not block.strip() or _COMMENT.encode() in block:
        return None
    try:
        return np.loadtxt(BytesIO(block), delimiter=delimiter or None, comments=None, quotechar='"', ndmin=2)
    except ValueError:
        return None


def _line_by_line(layout: TextLayout, block: bytes, line: int, requested: Sequence[int]) -> FloatArray:
    """Return columns (S, W) of a block line by line; `ValueError` for a text."""
    rows = []
    for number, text in enumerate(decode_text(block.replace(b"\r\n", b"\n")).split("\n"), line):
        if not text.strip() or text.startswith(_COMMENT):
            continue
        cells = cells_of(text, layout.delimiter)
        if layout.remarks or not any(cell.strip() for cell in cells[layout.columns :]):
            cells = cells[: layout.columns]
        if len(cells) != layout.columns:
            raise ValueError(f"{layout.path}: line {number}: expected {layout.columns} columns, found {len(cells)}")
        try:
            if not re.search(r"\d", text) and re.search(r"[^\W\d_]{2}", text.lower().replace("nan", "")):
                raise ValueError("a row of texts")
            rows.append([_number_or_nan(cells[i], layout) for i in requested])
        except ValueError as error:
            raise ValueError(f"{layout.path}: line {number}: expected numbers, found {text.strip()[:60]!r}") from error
    return np.array(rows).reshape(-1, len(requested))


def cells_of(line: str, delimiter: str) -> list[str]:
    """Split a row of a table into its cells."""
    return next(csv.reader([line], delimiter=delimiter)) if delimiter and '"' in line else line.split(delimiter or None)


def _number_or_nan(cell: str, layout: TextLayout) -> float:
    """Return the number in a cell, NaN for marks of a missing sample."""
    if layout.grouped and _GROUPED.fullmatch(cell.strip()):
        cell = cell.replace(".", "")
    return float("nan") if _NO_SAMPLE.fullmatch(cell.strip()) else number_of(cell, layout.comma)


def number_of(cell: str, comma: bool) -> float:
    """Return the number in a cell, NaN where it is empty.

    Thousands may be grouped, and `D` may begin an exponent.
    """
    cell = cell.strip().strip('"')
    if not cell:
        return float("nan")
    try:
        return float(cell.replace(",", ".") if comma else cell)
    except ValueError:
        decimal = "," if comma else "."
        grouped = _GROUPED.fullmatch(cell)
        if grouped and grouped[1] != decimal:
            return float(cell.replace(grouped[1], "").replace(",", "."))
        return float(re.sub("[dD]", "e", cell.replace(",", ".") if comma else cell))


def decimal_sign(cells: Iterable[str]) -> str:
    """Return the decimal sign that cells show, empty where they show none or both.

    A sign is decimal where other than three digits follow it, or no digit but 0 precedes it, or another sign does.
    """
    found = set()
    for cell in cells:
        signs = re.findall("[.,]", cell)
        number = re.fullmatch(r"[-+]?([\d.,' \u2019\u00a0\u202f]*?)([.,])(\d*)(?:[eEdD][-+]?\d+)?", cell.strip())
        if number is None:
            continue
        before, sign, behind = number.groups()
        if len(signs) > 1 and signs[0] == sign:
            found.add("." if sign == "," else ",")
        elif (
            len(signs) > 1
            or len(behind) != 3
            or before.lstrip("0") == ""
            or len(before) > 3
            or cell[-1:] != behind[-1:]
        ):
            found.add(sign)
    return found.pop() if len(found) == 1 else ""


# Text export of a scanning vibrometer, as in PTB's data set 10.7795/720.20181105 (`Scan_time.asc`).

_FIRST_POINT = 19  # line number, counted from 1
_PLAIN = bytes.maketrans(b",;", b". ")  # decimal comma to point, semicolon to blank


@dataclass(frozen=True)
class VibrometerScan(Arrays, shapes="point_m P 3; samples B P S"):
    """A scan of P points one after another: `point_m` (P, 3), `samples` (B, P, S)."""

    point_m: FloatArray
    samples: FloatArray
    sample_rate_hz: float

    def channels_at(self, point: int) -> dict[str, RawChannel]:
        """Return the channels of one scan point by their block number "1", "2", …."""
        return {
            str(block + 1): RawChannel(self.samples[block, point], self.sample_rate_hz)
            for block in range(len(self.samples))
        }


def read_scan_asc(path: Path) -> VibrometerScan:
    """Read the text export of a scanning vibrometer; every scan point is a separate recording."""
    with convert_read_errors(path), path.open("rb") as stream:
        for _ in range(_FIRST_POINT - 1):
            check_line(stream.readline(LONGEST_LINE + 1))
        points = []
        while len(row := _numbers(line := stream.readline(LONGEST_LINE))) == 3:
            points.append(row)
        if not points:
            raise ValueError(f"{path}: line {_FIRST_POINT}: expected x, y, z of the first scan point, found none")
        while line and not row:
            row = _numbers(line := stream.readline(LONGEST_LINE))
        if not (len(row) == 2 and row[0] >= 1.0 and row[0] == int(row[0]) and row[1] > 0.0):
            expected = "a line with the number of samples and the sampling interval"
            raise ValueError(f"{path}: expected {expected}, found none")
        samples, interval = int(row[0]), row[1]
        start, stop = stream.tell(), stream.seek(0, 2)
        values, widths = _data(stream, start, stop)
        count = len(points)
        block = count * samples
        if not len(values) or len(values) % block:
            raise ValueError(
                f"{path}: expected whole blocks of {count} points with {samples} samples ({block} numbers), "
                f"found {len(values)} numbers"
            )
        by_rows = count > 1 and widths == {count}
        channels = values.reshape(-1, samples, count).swapaxes(1, 2) if by_rows else values.reshape(-1, count, samples)
        return VibrometerScan(np.array(points), np.ascontiguousarray(channels), 1.0 / interval)


def read_scan_channels(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read a scan by `block/point`, both counted from 1; a single point also by `block`."""
    scan = read_scan_asc(path)
    agreed_rate(path, "the scan", scan.sample_rate_hz, sample_rate_hz)
    present = {
        f"{block}/{point + 1}": channel
        for point in range(len(scan.point_m))
        for block, channel in scan.channels_at(point).items()
    }
    if len(scan.point_m) == 1:
        present |= scan.channels_at(0)
    return {name: present[name] for name in select_names(path, names, present)}


def _numbers(line: bytes) -> list[float]:
    """Return a line's numbers, none where it has other content."""
    try:
        return [float(cell) for cell in line.translate(_PLAIN).split()]
    except ValueError:
        return []


def _data(stream: BinaryIO, start: int, stop: int) -> tuple[FloatArray, set[int]]:
    """Return all numbers after the acquisition line, and the lengths of their rows."""
    parts, widths = [], set()
    for _, block in whole_lines(stream, start, stop):
        rows = plain_rows(block.translate(_PLAIN), "")
        if rows is not None:
            parts.append(rows.reshape(-1))
            widths.add(rows.shape[1])
            continue
        single = [row for row in map(_numbers, block.splitlines()) if row]
        parts.append(np.array([value for row in single for value in row]))
        widths |= {len(row) for row in single}
    return np.concatenate(parts) if parts else np.empty(0), widths
