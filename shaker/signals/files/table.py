"""CSV: a header with the channels' names, an optional row of units, numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shaker._checks import FloatArray
from shaker.signals.files.common import checked_rate, chosen, rate_of_times
from shaker.signals.recording import RawChannel

_TIME = "time"
_DELIMITERS = ("\t", ";", ",")


def read_table(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read a text table with a header line; lines that begin with # are remarks.

    The delimiter is the tab, semicolon or comma that splits the header into most cells, else white space; decimal
    commas are understood where the comma is not the delimiter. A row of units may follow the header. Times come from
    a column `time` (s, uniform), else from `sample_rate_hz`; empty cells and `nan` are NaN.
    """
    lines = [(n, line) for n, line in enumerate(_text(path).splitlines(), 1) if line.strip() and line[0] != "#"]
    if len(lines) < 2:
        raise ValueError(f"{path}: expected a header and rows of numbers, found {len(lines)} lines")
    delimiter = _delimiter(lines[0][1])
    header = _cells(lines[0][1], delimiter)
    if len(set(header)) < len(header) or all(_is_number(cell, delimiter) for cell in header):
        raise ValueError(f"{path}: line {lines[0][0]}: expected a header with one name per column, found {header}")
    second = _cells(lines[1][1], delimiter)
    has_units = any(cell and not _is_number(cell, delimiter) for cell in second)
    units = second if has_units else [""] * len(header)
    rows = _numbers(path, lines[2 if has_units else 1 :], delimiter, len(header))
    columns = dict(zip(header, rows.T, strict=True))
    unit_of = dict(zip(header, [unit.strip("[]()") for unit in units], strict=False))
    if _TIME in columns:
        rate, start = rate_of_times(path, columns[_TIME], f'column "{_TIME}"')
    else:
        rate, start = checked_rate(path, sample_rate_hz, f'a table without a column "{_TIME}"'), 0.0
    wanted = chosen(path, names, [name for name in header if name != _TIME])
    return {
        name: RawChannel(np.ascontiguousarray(columns[name]), rate, start, unit_of.get(name, "")) for name in wanted
    }


def _text(path: Path) -> str:
    """Return the file's text, UTF-8 with or without mark, or else Latin-1."""
    raw = path.read_bytes()
    if b"\0" in raw[:4096]:
        raise ValueError(f"{path}: expected text, found binary data")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def _delimiter(header: str) -> str | None:
    """Return the delimiter that gives most cells; None is white space."""
    best = max(_DELIMITERS, key=header.count)
    return best if best in header else None


def _cells(line: str, delimiter: str | None) -> list[str]:
    """Split a line into cells without quotes and blanks."""
    return [cell.strip().strip('"') for cell in line.split(delimiter)]


def _number(cell: str, delimiter: str | None) -> float:
    """Return the number in a cell, NaN where it is empty."""
    if not cell:
        return float("nan")
    return float(cell if delimiter == "," else cell.replace(",", "."))


def _is_number(cell: str, delimiter: str | None) -> bool:
    """Tell whether a cell holds a number."""
    try:
        _number(cell, delimiter)
    except ValueError:
        return False
    return True


def _numbers(path: Path, lines: Sequence[tuple[int, str]], delimiter: str | None, columns: int) -> FloatArray:
    """Return the rows of numbers (S, columns), or raise `ValueError` naming the line."""
    rows = np.empty((len(lines), columns))
    for i, (number, line) in enumerate(lines):
        cells = _cells(line, delimiter)
        if len(cells) == columns + 1 and not cells[-1]:
            cells.pop()
        if len(cells) != columns:
            raise ValueError(f"{path}: line {number}: expected {columns} columns, found {len(cells)}")
        try:
            rows[i] = [_number(cell, delimiter) for cell in cells]
        except ValueError as error:
            raise ValueError(f"{path}: line {number}: expected numbers, found {line.strip()[:60]!r}") from error
    if not len(rows):
        raise ValueError(f"{path}: expected rows of numbers, found none")
    return rows
