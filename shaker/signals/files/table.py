"""CSV: a header with the channels' names, an optional row of units, numbers."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from shaker._checks import FloatArray
from shaker.signals.files.common import checked_rate, chosen, is_time, rate_of_times, reading
from shaker.signals.files.text import TextLayout, decoded, number_of, read_columns
from shaker.signals.recording import RawChannel

_DELIMITERS = ("\t", ";", ",")
_STATED = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)  # how Excel is told the delimiter
_NAME_AND_UNIT = re.compile(r"(.*\S)\s*(?:\[([^][]*)\]|\(([^()]*)\))")
_SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0}
_COMMENT = "#"


@dataclass(frozen=True)
class _Head:
    """What stands above the numbers: names, their units, the layout, byte and line number of the first row."""

    names: list[str]
    units: list[str]
    layout: TextLayout
    start: int
    line: int


def read_table(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read a text table with a header line; lines that begin with # are remarks.

    The delimiter is the one that a first line `sep=;` states, else the tab, semicolon or comma that splits the header
    into most cells, else white space; decimal commas are understood where the comma is not the delimiter. A row of
    units may follow the header, or units may stand in it (`Fz [N]`, `Fz (N)`; the channel answers to `Fz` too). Times
    come from a column `time`, uniform, in s or as its unit says (ms, us, ns, min), else from `sample_rate_hz`; empty
    cells and `nan` are NaN. Memory: the result and one block.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = _head(path, stream)
    short = [_split_unit(name)[0] for name in head.names]
    time = next((i for i, name in enumerate(short) if is_time(name)), None)
    present = {name: i for i, name in enumerate(head.names) if i != time}
    alone = {name: i for i, name in enumerate(short) if i != time and short.count(name) == 1 and name not in present}
    if names is not None:
        chosen(path, names, [*present, *alone])
    places = present if names is None else {name: present.get(name, alone.get(name, 0)) for name in names}
    wanted = sorted({*places.values(), *([] if time is None else [time])})
    columns = dict(zip(wanted, read_columns(head.layout, head.start, size, head.line, wanted), strict=True))
    if time is None:
        rate, start = checked_rate(path, sample_rate_hz, 'a table without a column "time"'), 0.0
    else:
        where = f'column "{head.names[time]}"'
        factor = _SECONDS.get(head.units[time].strip().lower())
        if factor is None:
            raise ValueError(f"{path}: {where}: expected s, ms, us, ns or min, found {head.units[time]!r}")
        rate, start = rate_of_times(path, columns.pop(time) * factor, where)
    return {name: RawChannel(columns[i], rate, start, head.units[i]) for name, i in places.items()}


def table_units(path: Path) -> dict[str, str]:
    """Return the columns of a text table, named without their units, and the unit of each."""
    with reading(path):
        with path.open("rb") as stream:
            head = _head(path, stream)
        short = [_split_unit(name)[0] for name in head.names]
        names = [own if short.count(own) == 1 else name for own, name in zip(short, head.names, strict=True)]
        return dict(zip(names, head.units, strict=True))


def read_table_columns(path: Path, names: Sequence[str]) -> FloatArray:
    """Read columns, named as `table_units` does, of a text table whose rows need no times, as (S, len(names))."""
    places = list(table_units(path))
    with reading(path):
        chosen(path, names, places)
        with path.open("rb") as stream:
            head = _head(path, stream)
        wanted = sorted({places.index(name) for name in names})
        columns = read_columns(head.layout, head.start, path.stat().st_size, head.line, wanted)
        return np.stack([columns[wanted.index(places.index(name))] for name in names], axis=1)


def _head(path: Path, stream: BinaryIO) -> _Head:
    """Read the header and the row of units."""
    if b"\0" in stream.read(4096):
        raise ValueError(f"{path}: expected text, found binary data")
    stream.seek(0)
    start, line, text = _next_line(stream, 0)
    stated = _STATED.fullmatch(text)
    if stated:
        start, line, text = _next_line(stream, line)
    delimiter = stated[1] if stated else _delimiter(text)
    comma = delimiter != ","
    names = _cells(text, delimiter)
    header_line = line
    start, line, second = _next_line(stream, line)
    if not second:
        raise ValueError(f"{path}: expected a header and rows of numbers, found {1 if text else 0} lines")
    if len(names) > 1 and not names[-1]:
        names.pop()
    if len(set(names)) < len(names) or all(_is_number(name, comma) for name in names):
        raise ValueError(f"{path}: line {header_line}: expected a header with one name per column, found {names}")
    units = [_split_unit(name)[1] for name in names]
    cells = _cells(second, delimiter)
    if _are_units(cells, comma):
        stripped = [cell.strip("[]()").strip() for cell in cells] + [""] * len(names)
        units = [row or own for row, own in zip(stripped, units, strict=False)]
        start, line = stream.tell(), line + 1
    return _Head(names, units, TextLayout(path, len(names), delimiter, comma), start, line)


def _next_line(stream: BinaryIO, line: int) -> tuple[int, int, str]:
    """Return place, number and text of the next line that is neither empty nor a remark; no text at the end."""
    while True:
        start, raw = stream.tell(), stream.readline()
        line += 1
        text = decoded(raw).rstrip("\r\n")
        if not raw or (text.strip() and not text.startswith(_COMMENT)):
            return start, line, text


def _delimiter(header: str) -> str:
    """Return the delimiter that gives most cells outside quotes, empty for white space."""
    plain = re.sub(r'"[^"]*"', "", header)
    best = max(_DELIMITERS, key=plain.count)
    return best if best in plain else ""


def _cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells without quotes and blanks."""
    if not delimiter:
        return [cell[0] or cell[1] for cell in re.findall(r'"([^"]*)"|(\S+)', line)]
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


def _split_unit(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit: `Fz [N]` or `Fz (N)`."""
    match = _NAME_AND_UNIT.fullmatch(name)
    return (match[1], (match[2] or match[3] or "").strip()) if match else (name, "")


def _are_units(cells: Sequence[str], comma: bool) -> bool:
    """Tell whether a row holds units: texts, and no number but the unit 1."""
    return any(cell and not _is_number(cell, comma) for cell in cells) and not any(
        _is_number(cell, comma) for cell in cells if cell != "1"
    )


def _is_number(cell: str, comma: bool) -> bool:
    """Tell whether a cell holds a number."""
    try:
        number_of(cell, comma)
    except ValueError:
        return False
    return bool(cell)
