"""Headers of text tables: names, units and first row, below any preamble."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from shaker.io.channel import LONGEST_LINE, is_time, time_unit
from shaker.io.text import TextLayout, check_line, decimal_sign, decode_text, number_of, open_text
from shaker.io.time_stamps import is_stamp

_COMMENTS = ("#", "%")
_DELIMITERS = ("\t", ";", ",", "|", "")
_WINDOW, _LEAST_LINES = 1 << 18, 8  # bytes and lines that are read to find the header
LEAST_WITHOUT_HEAD = 100  # rows of a file of numbers only that is a recorder's
_LAST_ROWS, _MOST_CELLS = 40, 1 << 17  # rows whose cells are counted, and their cells together
_LEAST_BLOCK = 0.1  # least number of rows of a table over that of the largest block of numbers in the first lines
_FULL = 0.8  # least share of the rows in which a column of numbers has one
_STATED = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)  # a line that states the delimiter to Excel
_NAME_AND_UNIT = re.compile(r"(.*\S)\s*(?:\[([^][]*)\]|\(([^()]*)\)|<([^<>]*)>|\{([^{}]*)\})")
_TIME_WITH_UNIT = re.compile(r"(t|time|zeit)[ _](s|sec|ms|us|ns)", re.IGNORECASE)
_UNITS = re.compile(
    r"[mukµμ]?v|volts?|[mµμ]?v/v|[mkµμ]?a|[mkM]?n|newtons?|[mk]?n\W?m|[mcµμun]?m|[mµμun]?m/s|m/s(\^?2|²|\*\*2)|g|gn"
    r"|[mµμun]?s|secs?|seconds?|sekunden?|min|°|°/s|m?deg|deg/s|[mµμun]?rad|[mµμun]?rad/s|m?bar|[kM]?pa|°?[ck]|k?hz|%|1|-|µm/m|um/m"
    r"|strain|pc|counts?|digits?|sequence",
    re.IGNORECASE,
)
_TRAILING = re.compile(
    r"(.*?[^\W_]\)?)(?:[ _](?=\S{1,3}/|[munµμ]s|m[VN]|[µμu]V|mm|[µμu]m)|_(?=[VNg]|kN|Nm))"
    r"([cmµμun]?m/s(?:\^?2|²)?|[mµμu]?V/V|(?:°|deg|rad)/s|[mµμun]s|[mµμu]?V|[µμum]m|[mk]?N|Nm|g)"
)
_SLASHED = re.compile(rf"(.*?\S)(?:\s*[/,]\s*|\s*:\s+|\s+in\s+)({_UNITS.pattern})", re.IGNORECASE)
_VOLTS_PER = re.compile(r".*(?:[mµμu]|\d\s?)V\s*/\s*(?!V$)(?:\([^()]*\)|[^\s/()\]>}]+)")  # ICP 100 mV/g: in V
_NUMBER = r"([-+]?\d+(?:[., '\u00a0\u202f]\d{3}(?!\d))*(?:[.,]\d+)?(?:[eE][-+]?\d+)?)"
_RATE = re.compile(
    r"(?:sampl\w*|scan|abtast|mess|acquisition|update|daten|data)[ _-]*(?:rate|freq\w*)|^\W*(?:fs|f_s|rate)\b"
    r"|samples?(?:/| per )s\w*",
    re.IGNORECASE,
)
_INTERVAL = re.compile(
    r"(?:sampl\w*|abtast\w*|horizontal|time|zeit|x|x[ _-]?axis|mess)?[ _.-]*"
    r"(?:interval\w*|increment|inkrement|delta[ _]?[tx]|x[ _-]?axis[ _]delta|\bdt)\b|^\W*zeitschritt",
    re.IGNORECASE,
)
_UNIT_ROW = re.compile(
    r"\W*(?:vertical |[vy][ _-]?|channel |signal |kanal)?(?:units?|einheit(?:en)?)\b.*", re.IGNORECASE
)
_NAME_ROW = re.compile(
    r"\W*(?:trace|channel|signal|kanal|curve)?[ _-]*(?:names?|labels?|bezeichnung(?:en)?)\W*", re.IGNORECASE
)


@dataclass(frozen=True)
class TableHead:
    """Header of a table: names, units, layout, and position of the first row.

    A column without a name is no channel. `stated_hz`: the sampling rate in the lines above the table, None without
    one. `stamped`: columns of dates and times; `texts`: columns without numbers.
    """

    names: list[str]
    units: list[str]
    layout: TextLayout
    start: int
    line: int
    stated_hz: float | None = None
    stamped: tuple[int, ...] = ()
    texts: tuple[int, ...] = ()

    @property
    def short(self) -> list[str]:
        """Names without their units."""
        return [split_unit(name)[0] for name in self.names]

    @property
    def plain(self) -> list[str]:
        """Names without their units where these names are unique."""
        short = self.short
        count = Counter(short)
        return [plain if count[plain] == 1 else name for plain, name in zip(short, self.names, strict=True)]

    @property
    def times(self) -> list[int]:
        """Columns of times.

        By their names, else the first column in a unit of time, else that of times of day.
        """
        named = [i for i, name in enumerate(self.short) if is_time(name, self.units[i], text=True)]
        if named:
            return named
        if named := _named_by_unit(self.names):
            return named
        timed = self.units and time_unit(self.units[0]) and 0 not in self.texts
        return [0] if timed else list(self.stamped[:1])


@dataclass(frozen=True)
class _HeadLine:
    start: int
    number: int
    text: str


@dataclass
class _SplitLines:
    """Lines of a table's beginning, split by one delimiter.

    `columns`: the width of most rows; `numeric`: the columns of numbers or times; `comma`: whether the decimal sign is
    a comma, or may be one; `grouped`: it is one for certain.
    """

    lines: list[_HeadLine]
    delimiter: str
    columns: int = 0
    numeric: int = 0
    comma: bool = True
    grouped: bool = False
    rows: dict[int, list[str]] = field(default_factory=dict)

    def cells(self, index: int) -> list[str]:
        """Return the cells of a line; names in columns of blanks may have single blanks."""
        if index not in self.rows:
            self.rows[index] = split_cells(self.lines[index].text, self.delimiter)
        if not self.delimiter and len(self.rows[index]) > self.columns > 1:
            aligned = re.split(r"\s{2,}", self.lines[index].text.strip())
            return aligned if len(aligned) == self.columns else self.rows[index]
        return self.rows[index]

    def is_text(self, index: int) -> bool:
        """Return whether a line has texts and no numbers but the unit 1."""
        cells = [cell for cell in self.cells(index) if cell]
        numbers = {cell for cell in cells if is_number(cell, self.comma)}
        stamps = [cell for cell in cells if is_stamp(cell)]
        return len(numbers) + len(stamps) < len(cells) and (not numbers or (numbers == {"1"} and self.are_units(index)))

    def fits(self, index: int) -> bool:
        """Return whether a line has one text per column."""
        cells = self.cells(index)
        keys = len(cells) > 1 and any(cell.endswith(":") for cell in cells)
        return index >= 0 and self.fits_width(index) and any(cells) and not keys and not any(map(is_stamp, cells))

    def fits_width(self, index: int) -> bool:
        """Return whether a line has as many cells as the table has columns."""
        cells = self.cells(index)
        return self.columns in (len(cells), len(_without_empty_end(cells)))

    def are_units(self, index: int) -> bool:
        """Return whether all texts of a line are units."""
        cells = [cell.strip("[]() ") for cell in self.cells(index) if cell and not is_number(cell, self.comma)]
        return bool(cells) and all(map(_is_unit, cells))

    def has_time(self, index: int) -> bool:
        """Return whether a line names a column of times."""
        return any(is_time(*split_unit(cell), text=True) for cell in self.cells(index))


def _is_unit(text: str) -> bool:
    """Return whether a text is a known unit or made of known units, as mV/(m/s^2)."""
    parts = [part for part in re.split(r"[/()*·^\d²³-]+", text) if part]
    return bool(_UNITS.fullmatch(text) or (len(parts) > 1 and all(_UNITS.fullmatch(part) for part in parts)))


def find_head(path: Path) -> TableHead:
    """Return the header of a table; `ValueError` without one.

    The rows at the end of the first lines decide the delimiter and the number of columns. The header is the next line
    above them that has a text for each column; below it may be a row of units.
    """
    lines, remarks, stated = _first_lines(path)
    if not lines:
        raise ValueError(f"{path}: expected a header and rows of numbers, found 0 lines")
    grids = [grid for delimiter in ([stated] if stated else _DELIMITERS) for grid in _grids(lines, delimiter)]
    found = [(grid, head) for grid in grids if grid.columns and (head := _header(grid, remarks)) is not None]
    if not found:
        return _oscilloscope_head(path, lines) or _no_head(path, grids) or _first_line(path, lines, stated)
    grid, (names, units, first) = max(found, key=lambda item: (item[0].numeric, item[0].columns))
    return _head(path, grid, names, units, first)


def _first_lines(path: Path) -> tuple[list[_HeadLine], list[_HeadLine], str]:
    """Return the first lines with content, the remarks, and a stated delimiter."""
    lines, remarks, stated = list[_HeadLine](), list[_HeadLine](), ""
    with open_text(path) as stream:
        if b"\0" in stream.read(4096):
            raise ValueError(f"{path}: expected text, found binary data")
        stream.seek(0)
        number = 0
        while len(lines) < _LEAST_LINES or stream.tell() < _WINDOW:
            start, raw = stream.tell(), stream.readline(LONGEST_LINE + 1)
            check_line(raw)
            number += 1
            text = decode_text(raw).rstrip("\r\n")
            if not raw:
                break
            if not lines and _STATED.fullmatch(text):
                stated = text.strip('"')[4]
            elif text.strip():
                (remarks if text.startswith(_COMMENTS) else lines).append(_HeadLine(start, number, text))
    return lines, remarks, stated


def _grids(lines: list[_HeadLine], delimiter: str) -> Iterator[_SplitLines]:
    """Yield the table by its usual width, without and with an empty end."""
    whole = _SplitLines(lines, delimiter, comma=delimiter != ",")
    width = max(len(whole.cells(len(lines) - 1)), 1)
    last = range(max(0, len(lines) - max(3, min(_LAST_ROWS, _MOST_CELLS // width))), len(lines))
    sign = decimal_sign(cell for i in last for cell in whole.cells(i))
    whole.comma, whole.grouped = sign == "," if sign else whole.comma, sign == ","
    rows = [whole.cells(i) for i in last if not whole.is_text(i)]
    for cut in (_without_empty_end, list):
        widths = Counter(len(cut(row)) for row in rows)
        columns = max(widths, key=lambda width: (widths[width], width), default=0)
        used = [[row[i] for row in rows if len(cut(row)) == columns and row[i]] for i in range(columns)]
        good = [[is_number(cell, whole.comma) or is_stamp(cell) for cell in cells] for cells in used]
        yield replace(whole, columns=columns, numeric=sum(bool(g) and sum(g) >= _FULL * len(g) for g in good))


def _header(grid: _SplitLines, remarks: Sequence[_HeadLine]) -> tuple[list[str], list[str], int] | None:
    """Return names, row of units, and index of the first row, or None."""
    first = _first_row(grid)
    if first == len(grid.lines) or grid.numeric == 0:
        return None
    last = first - 1
    fitting = [i for i in range(last, -1, -1) if grid.is_text(i) and grid.fits(i)] if grid.columns > 1 else []
    labels = [i for i in fitting if _NAME_ROW.fullmatch(grid.cells(i)[0])]
    if labels and not (grid.fits(last) and grid.has_time(last)):
        return ["", *grid.cells(labels[0])[1:]], [], first
    index = last
    if index >= 0 and not grid.fits(index):
        index = fitting[0] if fitting else -1  # such as "data:" between names and rows
    if index < 0 or not grid.fits(index):
        wide = [_without_empty_end(grid.cells(i)) for i in (last, first)] if last >= 0 else [[], []]
        if len(wide[0]) == len(wide[1]) > grid.columns and grid.are_units(first):
            return wide[0], wide[1], first + 1  # more names than columns, such as an increment
        return _in_remark(grid, remarks, first)
    below = _names_and_units(grid, index)
    if below is not None:
        return grid.cells(below[0]), grid.cells(below[1]), first
    units = list[str]()
    mixed = [cell for cell in grid.cells(first) if cell]
    if index == last and any(not is_number(cell, grid.comma) for cell in mixed) and grid.are_units(first):
        units, first = grid.cells(first), first + 1  # units next to numbers, such as an increment
    return grid.cells(index), units, first


def _names_and_units(grid: _SplitLines, index: int) -> tuple[int, int] | None:
    """Return the lines of names and units of a header of several lines.

    `index`: its last line.
    """
    stack = [index]
    while stack[-1] > 0 and grid.fits(stack[-1] - 1):
        stack.append(stack[-1] - 1)
    timed = [i for i in stack if grid.has_time(i)]
    if timed and timed[-1] < index:
        named = timed[-1]
        return named, next((i for i in stack[::-1] if i > named and grid.are_units(i)), named + 1)
    with_units = any(split_unit(cell)[1] and not _is_unit(cell) for cell in grid.cells(index))
    only_names = not timed and index == 1 and grid.is_text(0) and not with_units
    return (index - 1, index) if len(stack) > 1 and (grid.are_units(index) or only_names) else None


def _first_row(grid: _SplitLines) -> int:
    """Return the first line of the first large block of numbers between texts."""
    texts = [i for i in range(len(grid.lines)) if grid.is_text(i)]
    starts = [0, *(i + 1 for i in texts)]
    stops = [*texts, len(grid.lines)]
    rows = [sum(map(grid.fits_width, range(start, stop))) for start, stop in zip(starts, stops, strict=True)]
    least = max(1.0, _LEAST_BLOCK * max(rows))
    first = next((start for start, count in zip(starts, rows, strict=True) if count >= least), len(grid.lines))
    return len(grid.lines) if grid.columns == 1 and first < starts[-1] else first  # lines that do not split


def _in_remark(grid: _SplitLines, remarks: Sequence[_HeadLine], first: int) -> tuple[list[str], list[str], int] | None:
    """Return the names in a remark above the first row."""
    for remark in reversed([line for line in remarks if line.start < grid.lines[first].start]):
        for delimiter in dict.fromkeys((grid.delimiter, ",", ";", "\t", "")):
            names = [cell for cell in split_cells(remark.text.lstrip("#%! "), delimiter) if cell]
            if len(names) == grid.columns and not any(is_number(name, True) for name in names):
                return names, [], first
    return None


def _head(path: Path, grid: _SplitLines, names: list[str], units: list[str], first: int) -> TableHead:
    """Return a header with units and rate from the lines above."""
    increments = [cell for cell, name in zip(units, names, strict=False) if _INTERVAL.search(name)]
    names, line = names[: grid.columns], grid.lines[first]
    rows = [grid.cells(i) for i in range(len(grid.lines) - 1, first - 1, -1)[:_LAST_ROWS]]
    rows = [row for row in rows if len(row) >= grid.columns]
    used = [[row[column] for row in rows if row[column]] for column in range(grid.columns)]
    stamped = tuple(i for i, cells in enumerate(used) if cells and all(map(is_stamp, cells)))
    texts = tuple(i for i, cells in enumerate(used) if cells and not any(is_number(c, grid.comma) for c in cells))
    twice = Counter(name for name in names if name and not is_time(*split_unit(name), text=True))
    if any(count > 1 for count in twice.values()):
        number = grid.lines[first].number - 1
        raise ValueError(f"{path}: line {number}: expected a header with one name per column, found {names}")
    names = [name or ("" if not used[i] else f"column {i + 1}") for i, name in enumerate(names)]
    rising = next((i for i, cells in enumerate(used[:2]) if cells and _rises(cells, grid.comma)), None)
    if rising is not None and names[rising] in ("", f"column {rising + 1}"):
        names[rising] = "time"
    stripped = [cell.strip("[]()<>{} ") for cell in units] + [""] * len(names)
    own = [split_unit(name)[1] for name in names]
    made = [row or unit for row, unit in zip(stripped, own, strict=False)]
    for i in _named_by_unit(names):
        made[i] = made[i] or names[i]
    made = [unit.removeprefix("in ") for unit in made]
    above = [line.text for line in grid.lines[:first]]
    for cells in (grid.cells(i) for i in range(first)):
        if _UNIT_ROW.fullmatch(cells[0]) and len(cells) >= len(names) > 1:
            made = [unit or cells[i] for i, unit in enumerate(made)]
    stated_hz = _stated_rate(above, grid.comma and any("," in cell for cells in used for cell in cells))
    if stated_hz is None:
        stated_hz = _stated_rate([f"increment {cell}" for cell in increments])
    if units and any(is_number(cell, grid.comma) and cell != "1" for cell in units):
        counted = [not used[i] or made[i].lower() == "sequence" for i in range(len(names))]
        names = ["" if counted[i] else name for i, name in enumerate(names)]
        made = ["" if is_number(unit, grid.comma) and unit != "1" else unit for unit in made]
    layout = TextLayout(path, len(names), grid.delimiter, grid.comma, grouped=grid.grouped)
    return TableHead(names, made, layout, line.start, line.number, stated_hz, stamped, texts)


def _stated_rate(lines: Sequence[str], comma: bool = False) -> float | None:
    """Return the sampling rate that lines state, as a rate or an interval.

    `comma`: the table has a decimal comma, so that a point before three digits groups thousands.
    """
    for index, line in enumerate(lines):
        for pattern, inverse in ((_RATE, False), (_INTERVAL, True)):
            key = pattern.search(line)
            if key is None:
                continue
            behind = line[key.end() :]
            if not re.search(_NUMBER, behind) and index + 1 < len(lines) and re.fullmatch(r"\W*", behind):
                behind = lines[index + 1]
            number = re.search(_NUMBER, behind)
            if number is None:
                continue
            value = _stated_number(number[1], comma)
            scale = re.search(r"(?<![A-Za-z])([kM]?)(?:Hz|S/s|SPS)\b", line[key.start() :], re.IGNORECASE)
            unit = re.search(r"(?<![^\W\d_])([mun\u00b5\u03bc]?)s(?:ec\w*)?\b", line[key.start() :])
            factor = {"": 1.0, "k": 1e3, "m": 1e6}[scale[1].lower()] if scale else 1.0
            step = {"": 1.0, "m": 1e-3, "n": 1e-9}.get(unit[1], 1e-6) if unit else 1.0
            if value > 0.0:
                return 1.0 / (value * step) if inverse else value * factor
    return None


def _stated_number(text: str, comma: bool) -> float:
    """Return a number above a table, which may have another decimal sign."""
    sign = decimal_sign([text]) or ("," if comma or "." not in text else ".")
    with suppress(ValueError):
        return number_of(text, sign == ",")
    return number_of(text.split(maxsplit=1)[0], sign == ",")


def _oscilloscope_head(path: Path, lines: Sequence[_HeadLine]) -> TableHead | None:
    """Return the header of an oscilloscope's table with its preamble in the first three columns."""
    cells = [split_cells(line.text, ",") for line in lines]
    stated = {row[0].strip().lower(): row[1].strip() for row in cells[:30] if len(row) > 4 and row[0]}
    if not {"record length", "sample interval"} <= set(stated) or not all(len(row) > 4 for row in cells):
        return None
    name = stated.get("source", "CH1")
    units = [*[""] * 3, stated.get("horizontal units", "s"), stated.get("vertical units", "")]
    layout = TextLayout(path, 5, ",", comma=False, remarks=True)
    return TableHead([*[""] * 3, "Time", name], units, layout, lines[0].start, lines[0].number)


def _no_head(path: Path, grids: Sequence[_SplitLines]) -> TableHead | None:
    """Return the columns of many rows of numbers without names, called by their places."""
    grid = max(grids, key=lambda grid: (grid.numeric, grid.columns))
    first = _first_row(grid)
    above = grid.cells(first - 1) if first else [""]
    named = len(_without_empty_end(above)) > 1 and not above[0].endswith(":")  # by fewer or more names
    whole = 0 < grid.numeric == grid.columns and len(grid.lines) - first >= LEAST_WITHOUT_HEAD and not named
    return _head(path, grid, [""] * grid.columns, [], first) if whole else None


def _named_by_unit(names: Sequence[str]) -> list[int]:
    """Return the columns of times that a unit names.

    Such as `in s` for the first one, or `ms` for any; capital letters such as `US` are a name.
    """
    bare = [name.removeprefix("in ") for name in names]
    return [i for i, name in enumerate(bare) if name.islower() and time_unit(name) and (i == 0 or len(name) > 1)]


def _rises(cells: Sequence[str], comma: bool) -> bool:
    """Return whether numbers rise in equal steps, and do not count."""
    if not all(is_number(cell, comma) for cell in cells):
        return False
    with np.errstate(all="ignore"):
        steps = np.diff([number_of(cell, comma) for cell in reversed(cells)])
        return len(steps) > 1 and bool(0.0 < steps.max() < 2.0 * steps.min()) and not np.all(steps == 1.0)


def _first_line(path: Path, lines: Sequence[_HeadLine], stated: str) -> TableHead:
    """Return the first line as the header, for rows that fit none."""
    text = lines[0].text
    plain = re.sub(r'"[^"]*"', "", text)
    best = max(_DELIMITERS[:3], key=plain.count)
    delimiter = stated or (best if best in plain else "")
    comma = delimiter != ","
    names = _without_empty_end(split_cells(text, delimiter))
    if len(lines) < 2:
        raise ValueError(f"{path}: expected a header and rows of numbers, found {len(lines)} lines")
    if len(set(names)) < len(names) or all(is_number(name, comma) for name in names):
        raise ValueError(
            f"{path}: line {lines[0].number}: expected a header with one name per column, found {names}; "
            f"write the names of the columns in the line above the numbers"
        )
    units = [split_unit(name)[1] for name in names]
    cells, first = split_cells(lines[1].text, delimiter), lines[1]
    if not any(is_number(cell, comma) for cell in cells if cell != "1"):
        stripped = [cell.strip("[]()").strip() for cell in cells] + [""] * len(names)
        units = [row or unit for row, unit in zip(stripped, units, strict=False)]
        behind = first.start + len(first.text.encode()) + 1
        first = lines[2] if len(lines) > 2 else _HeadLine(behind, first.number + 1, "")
    return TableHead(names, units, TextLayout(path, len(names), delimiter, comma), first.start, first.number)


def _without_empty_end(cells: list[str]) -> list[str]:
    """Return cells without an empty last one."""
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells without quotes and blanks."""
    if not delimiter:
        return [cell[0] or cell[1] for cell in re.findall(r'"([^"]*)"|(\S+)', line)]
    if '"' in line:
        with suppress(csv.Error):  # a cell of 128 KiB
            row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [""])
            return [cell.strip() for cell in row]
    return [cell.strip() for cell in line.split(delimiter)]


def split_unit(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit.

    Such as `Fz [N]`, `Fz (N)`, `Fz / N`, `t_s`. Volts per unit are none: `ICP 100 mV/g` is read in V.
    """
    if _VOLTS_PER.fullmatch(name):
        return name, ""
    match = _NAME_AND_UNIT.fullmatch(name)
    if match:
        return match[1], next((unit for unit in match.groups()[1:] if unit), "").strip()
    match = _TIME_WITH_UNIT.fullmatch(name) or _TRAILING.fullmatch(name) or _SLASHED.fullmatch(name)
    return (match[1], match[2]) if match and match[2] not in ("-", "1") else (name, "")


def is_number(cell: str, comma: bool) -> bool:
    """Return whether a cell has a number."""
    try:
        number_of(cell, comma)
    except ValueError:
        return False
    return bool(cell)
