"""LabVIEW measurement files (.lvm): text with tab, comma or semicolon, decimal point or comma."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from shaker._checks import FloatArray
from shaker.signals.files.common import chosen
from shaker.signals.recording import RawChannel

_END = "***End_of_Header***"
_SEPARATORS = {"Tab": "\t", "Comma": ",", "Semicolon": ";"}
_COMMENT, _TIMES = "Comment", "X_Value"
_GAP = 0.5  # of a sampling interval: how far a segment or a time may lie from where the last one left off


@dataclass(frozen=True)
class _Segment:
    """One block of a file: header entries, column titles, numbers (S, columns) and the line of its titles."""

    header: dict[str, list[str]]
    titles: list[str]
    rows: FloatArray
    line: int


def read_labview(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read the channels of a LabVIEW measurement file by their column titles.

    The sampling interval is the header's `Delta_X`. Where an X column contradicts it, the column counts: such a file
    was decimated after recording and kept its old header; an interval that is a whole multiple of `Delta_X` is then
    taken as exactly that. Several segments must continue one another (by `X0` or the X column, and their time stamps)
    and are joined. The `Comment` column is passed over. `sample_rate_hz` serves files that state no interval.
    """
    segments = list(_segments(path))
    first = segments[0]
    names_present = [title for title in first.titles if title not in (_TIMES, _COMMENT)]
    wanted = chosen(path, names, names_present)
    return {name: _channel(path, segments, name, names_present.index(name), sample_rate_hz) for name in wanted}


def _segments(path: Path) -> Iterator[_Segment]:
    """Yield the segments of a file."""
    lines = path.read_text(encoding="latin-1").splitlines()
    if not lines or not lines[0].startswith("LabVIEW Measurement"):
        raise ValueError(f"{path}: expected the first line of a LabVIEW measurement, found another")
    ends = [i for i, line in enumerate(lines) if line.startswith(_END)]
    if len(ends) < 2:
        raise ValueError(f"{path}: expected the header of a file and of a segment, found {len(ends)} headers")
    file_header = _entries(lines[1 : ends[0]])
    separator = _SEPARATORS.get(file_header.get("Separator", ["Tab"])[0], "\t")
    comma = file_header.get("Decimal_Separator", ["."])[0] == ","
    starts = [ends[0], *(_segment_start(lines, ends[i], ends[i + 1]) for i in range(1, len(ends) - 1))]
    for i, (start, end) in enumerate(zip(starts, ends[1:], strict=True)):
        stop = starts[i + 1] if i + 1 < len(starts) else len(lines)
        header = {**file_header, **_entries(lines[start + 1 : end], separator)}
        if end + 1 >= len(lines):
            raise ValueError(f"{path}: line {end + 1}: expected column titles after the header, found the end")
        titles = [title.strip() for title in lines[end + 1].rstrip("\r\n").split(separator)]
        yield _Segment(header, titles, _rows(path, lines, end + 2, stop, titles, separator, comma), end + 2)


def _segment_start(lines: Sequence[str], end: int, next_end: int) -> int:
    """Return the line before the header of the next segment."""
    for i in range(end + 1, next_end):
        if lines[i].startswith("Channels"):
            return i - 1
    return next_end - 1


def _entries(lines: Sequence[str], separator: str = "\t") -> dict[str, list[str]]:
    """Return header lines as key and values."""
    split = [[cell.strip() for cell in line.split(separator)] for line in lines if line.strip()]
    return {cells[0]: cells[1:] for cells in split if cells[0] and len(cells) > 1}


def _rows(
    path: Path, lines: Sequence[str], start: int, stop: int, titles: Sequence[str], separator: str, comma: bool
) -> FloatArray:
    """Return the numbers of a segment; a missing X column is NaN."""
    columns = len(titles) - (1 if titles[-1] in (_COMMENT, "") else 0)
    rows = []
    for i in range(start, stop):
        line = lines[i].replace(",", ".") if comma and separator != "," else lines[i]
        if not line.strip():
            continue
        cells = line.split(separator)[:columns]
        try:
            rows.append([float(cell) if cell.strip() else np.nan for cell in cells])
        except ValueError as error:
            raise ValueError(f"{path}: line {i + 1}: expected numbers, found {line.strip()[:60]!r}") from error
        if len(cells) != columns:
            raise ValueError(f"{path}: line {i + 1}: expected {columns} columns, found {len(cells)}")
    if not rows:
        raise ValueError(f"{path}: line {start}: expected rows of numbers, found none")
    return np.array(rows)


def _channel(
    path: Path, segments: Sequence[_Segment], name: str, index: int, sample_rate_hz: float | None
) -> RawChannel:
    """Join one channel over the segments."""
    parts, first_times, step = [], [], 0.0
    for number, segment in enumerate(segments):
        if name not in segment.titles:
            raise ValueError(f'{path}: line {segment.line}: expected the channel "{name}" in every segment')
        column = segment.titles.index(name)
        times = _times(segment, column)
        step_here = _interval(path, segment, times, index, sample_rate_hz)
        start = float(times[0]) if times is not None else _value(segment, "X0", index, 0.0)
        if number and abs(step_here - step) > 1e-6 * step:
            raise ValueError(f"{path}: line {segment.line}: expected one sampling interval, found {step_here} s")
        step = step_here
        first_times.append(start + _stamp(segment, index) - _stamp(segments[0], index))
        parts.append(segment.rows[:, column])
    _check_joined(path, segments, parts, first_times, step)
    units = segments[0].header.get("Y_Unit_Label", [])
    return RawChannel(np.concatenate(parts), 1.0 / step, first_times[0], units[index] if index < len(units) else "")


def _times(segment: _Segment, column: int) -> FloatArray | None:
    """Return the X column that belongs to a channel: the last one before it that holds numbers."""
    before = [i for i in range(column) if segment.titles[i] == _TIMES and np.isfinite(segment.rows[:, i]).all()]
    return segment.rows[:, before[-1]] if before else None


def _value(segment: _Segment, key: str, index: int, default: float) -> float:
    """Return a channel's number from the header."""
    cells = [cell for cell in segment.header.get(key, []) if cell]
    return float(cells[min(index, len(cells) - 1)].replace(",", ".")) if cells else default


def _interval(
    path: Path, segment: _Segment, times: FloatArray | None, index: int, sample_rate_hz: float | None
) -> float:
    """Return the sampling interval of a segment, the X column ruling the header."""
    stated = _value(segment, "Delta_X", index, 1.0 / sample_rate_hz if sample_rate_hz else 0.0)
    count = len(segment.rows)
    if times is not None and count > 1:
        measured = float(times[-1] - times[0]) / (count - 1)
        stray = np.max(np.abs(times - times[0] - measured * np.arange(count))) if measured > 0.0 else np.inf
        if not stray <= _GAP * measured:
            raise ValueError(f"{path}: line {segment.line}: expected an X column in uniform steps, found others")
        multiple = round(measured / stated) if stated > 0.0 else 0
        # The column is printed with few digits; the header's interval, or a multiple of it, has them all.
        exact = multiple > 0 and abs(multiple * stated - measured) * (count - 1) <= _GAP * measured
        if not (exact and multiple == 1):
            return multiple * stated if exact else measured
    if not stated > 0.0:
        raise ValueError(f"{path}: expected a sampling interval Delta_X, found none; give sample_rate")
    samples = int(_value(segment, "Samples", index, count))
    if count < samples:
        raise ValueError(f"{path}: line {segment.line}: expected {samples} samples as the header says, found {count}")
    return stated


def _stamp(segment: _Segment, index: int) -> float:
    """Return a segment's time stamp in seconds, 0 where it has none."""
    dates, times = segment.header.get("Date", []), segment.header.get("Time", [])
    if not dates or not times:
        return 0.0
    date, time = dates[min(index, len(dates) - 1)], times[min(index, len(times) - 1)].replace(",", ".")
    if not date or not time:
        return 0.0
    clock, _, fraction = time.partition(".")
    seconds = (datetime.strptime(f"{date} {clock}", "%Y/%m/%d %H:%M:%S") - datetime(2000, 1, 1)).total_seconds()
    return seconds + float(f"0.{fraction or 0}")


def _check_joined(
    path: Path, segments: Sequence[_Segment], parts: Sequence[FloatArray], first_times: Sequence[float], step: float
) -> None:
    """Refuse segments with a gap between them."""
    expected = first_times[0]
    for segment, part, start in zip(segments, parts, first_times, strict=True):
        if abs(start - expected) > _GAP * step:
            raise ValueError(
                f"{path}: line {segment.line}: expected a segment that goes on at {expected:.6f} s, "
                f"found one from {start:.6f} s"
            )
        expected += len(part) * step
