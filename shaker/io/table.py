"""Text tables of recorders and spreadsheets: channels with their times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shaker.io.channel import (
    RawChannel,
    SampleTimes,
    agreed_rate,
    convert_read_errors,
    select_by_either_name,
    select_names,
    times_of_stamps,
)
from shaker.io.table_head import LEAST_WITHOUT_HEAD, TableHead, find_head, is_number, split_cells
from shaker.io.text import cells_of, decode_text, end_of_rows, last_digit, open_text, read_columns, whole_lines
from shaker.io.time_stamps import is_date, seconds_of_stamps
from shakercal._common.arrays import FloatArray

_COMMENT = "#"
_EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))  # since 1970: numbers above which times have this unit
_DAYS, _SHORT = (36526, 73050), 1e-6  # of the years 2000 to 2100; mean step below which numbers are days, not s
_NUMBER_FIRST = re.compile(rb"^[ \t\"]*[-+]?\d+(?:[.,]\d*)?(?:[eE][-+]?\d+)?[ \t\r\";,|]*(?:[-+\d\"]|$)", re.MULTILINE)
_LEAST_ROWS = 8  # of a text file that is a table


def read_table(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read a text table with a header below any preamble.

    Lines that begin with # are remarks.
    The delimiter is that of a first line `sep=;`, else the tab, semicolon, comma or white space that splits the rows
    into columns of numbers. Decimal commas are accepted where the comma is no delimiter. Units are in a row below the
    header or in it (`Fz [N]`, `Fz (N)`; also found as `Fz`). Times are those of a column such as `time` or `Zeit`, in
    s or its unit, or dates and times of day; with several such columns a channel has the one before it. Uniform within
    their printed digits, they give the slope of the straight line through them as the rate. Without such a column the
    lines above the header may state the rate. Empty cells and `nan` are NaN. Memory: the result and one block.
    """
    head = find_head(path)
    times = head.times
    channels = [i for i, name in enumerate(head.names) if name and i not in times]
    present, short = {head.names[i]: i for i in channels}, head.short
    chosen = [i for i in channels if i not in head.texts or names is not None]
    requested = [head.names[i] for i in chosen] if names is None else names
    columns_by_name = select_by_either_name(path, requested, present, [short[i] for i in channels])
    time_of = {i: max((t for t in times if t < i), default=times[0]) if times else None for i in channels}
    needed = {time_of[i] for i in columns_by_name.values()}
    numeric = {t for t in needed if t is not None and t not in head.stamped}
    columns = read_table_numbers(head, sorted({*columns_by_name.values(), *numeric}))
    found_times: dict[int | None, tuple[SampleTimes, int]] = {}
    for time in needed:
        samples = len(next(iter(columns.values()))) if columns else 0
        found_times[time] = _times(path, head, time, columns, samples, sample_rate_hz)
    made = {}
    for name, i in columns_by_name.items():
        sample_times, count = found_times[time_of[i]]
        made[name] = RawChannel.from_times(sample_times, columns[i][:count], head.units[i])
    return made


def _times(
    path: Path, head: TableHead, time: int | None, columns: dict[int, FloatArray], count: int, given_hz: float | None
) -> tuple[SampleTimes, int]:
    """Return the times of a column and the number of its rows.

    Without a column they are those of the stated rate.
    """
    if time is None:
        where = "the lines above the header" if head.stated_hz else 'a table without a column "time"'
        return SampleTimes(agreed_rate(path, where, head.stated_hz, given_hz)), count
    where, unit = f'column "{head.names[time]}"', head.units[time]
    if time in head.stamped:
        try:
            stamps, start_s, digit = seconds_of_stamps(_stamp_cells(path, head, time))
        except ValueError as error:
            raise ValueError(f"{path}: {where}: {error}") from error
        unit = "s"
    else:
        stamps, start_s = columns[time], 0.0
        count = len(stamps) - int(np.argmax(np.isfinite(stamps[::-1]))) if len(stamps) else 0
        stamps = stamps[:count]  # a slower group of channels ends before the others
        digit = last_digit(head.layout, head.start, end_of_rows(path), time)
        if not unit and len(stamps):
            unit = next((name for least, name in _EPOCHS if stamps[0] > least), "D" if _are_days(stamps) else "")
    try:
        times = times_of_stamps(path, where, stamps, unit, digit=digit, given_hz=given_hz)
    except ValueError:
        if head.stated_hz is None or given_hz is not None:
            raise
        return SampleTimes(head.stated_hz, start_s), count  # the times have too few digits
    return SampleTimes(times.rate_hz, times.start_s + start_s, times.stamp_s), count


def _are_days(stamps: FloatArray) -> bool:
    """Return whether times are days from 1900 on, as spreadsheets count them."""
    return bool(_DAYS[0] < stamps[0] < _DAYS[1] and 0.0 < stamps[-1] - stamps[0] < _SHORT * len(stamps))


def _stamp_cells(path: Path, head: TableHead, column: int) -> list[str]:
    """Return the texts of a column of dates and times.

    A date in a separate column is put before them.
    """
    dates = [i for i in head.stamped if i != column]
    cells, delimiter = [], head.layout.delimiter
    with open_text(path) as stream:
        for _, block in whole_lines(stream, head.start, end_of_rows(path)):
            for line in decode_text(block).splitlines():
                if not line.strip() or line.startswith(_COMMENT):
                    continue
                row = cells_of(line, delimiter)
                cell = row[column] if column < len(row) else ""
                day = row[dates[0]].strip() if dates and dates[0] < len(row) else ""
                cells.append(f"{day} {cell.strip()}" if is_date(day) else cell)
    return cells


def read_table_numbers(head: TableHead, requested: Sequence[int]) -> dict[int, FloatArray]:
    """Return columns of a table by their index."""
    return read_columns(head.layout, head.start, end_of_rows(head.layout.path), head.line, requested)


def table_units(path: Path) -> dict[str, str]:
    """Return the unit of each table column by its name without unit."""
    with convert_read_errors(path):
        head = find_head(path)
        return dict(zip(head.plain, head.units, strict=True))


def read_table_columns(path: Path, names: Sequence[str]) -> FloatArray:
    """Read columns (S, W) of a text table by the names of `table_units`."""
    with convert_read_errors(path):
        head = find_head(path)
        columns_by_name = [head.plain.index(name) for name in select_names(path, names, head.plain)]
        columns = read_table_numbers(head, sorted(set(columns_by_name)))
        return np.stack([columns[index] for index in columns_by_name], axis=1)


def _has_numbers(path: Path) -> bool:
    """Return whether many lines of a text file begin with a number."""
    try:
        with open_text(path) as stream:
            sample = stream.read(1 << 16)
    except OSError:
        return False
    return b"\0" not in sample and len(_NUMBER_FIRST.findall(sample)) >= LEAST_WITHOUT_HEAD


def is_table(path: Path) -> bool:
    """Return whether a text file has a header and enough rows of numbers."""
    try:
        with convert_read_errors(path):
            head = find_head(path)
            with open_text(path) as stream:
                stream.seek(head.start)
                lines = decode_text(stream.read(1 << 16)).splitlines()
    except (OSError, ValueError):
        return _has_numbers(path)
    cells = [split_cells(line, head.layout.delimiter) for line in lines if line.strip()][:_LEAST_ROWS]
    numbers = [any(is_number(c, head.layout.comma) for c in row) for row in cells]
    return (len(cells) == _LEAST_ROWS and all(numbers)) or _has_numbers(path)
