"""LabVIEW measurement files (.lvm): text with tab, comma or semicolon, decimal point or comma."""

from __future__ import annotations

from bisect import bisect
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np

from shaker.io.channel import (
    MOST_CHANNELS,
    RawChannel,
    SampleTimes,
    Segment,
    agreed_rate,
    select_names,
    times_of_segments,
    times_of_stamps,
)
from shaker.io.text import TextLayout, decode_text, digit_of, find_bytes, last_digit, read_columns, whole_lines
from shakercal._common.arrays import FloatArray

_END, _CHANNELS = b"***End_of_Header***", b"\nChannels"
_SPECIAL, _SPECIAL_END = "***Start_Special***", "***End_Special***"
_SEPARATORS = {"Tab": "\t", "Comma": ",", "Semicolon": ";"}
_NEAREST = 8  # X columns before a channel that are searched for its times
_ROUND = (1.0, 2.0, 2.5, 4.0, 5.0, 8.0, 10.0)  # times a power of ten: rates that few digits state exactly
_FEW, _TOO_FEW = 1e-4, 1e-2  # relative, of half a digit of Delta_X: beyond it, only such rates are believed, or none
_COMMENT, _TIMES, _SEPARATOR = "Comment", "X_Value", "Separator"


@dataclass(frozen=True)
class _Segment:
    """One block of a file: header, column titles, layout, and position of its rows."""

    header: dict[str, list[str]]
    titles: list[str]
    layout: TextLayout
    start: int
    stop: int
    line: int


@dataclass(frozen=True)
class _Part:
    """One channel in one segment, with times from an X column or None."""

    samples: FloatArray
    segment: _Segment
    column: int
    times: FloatArray | None
    digit: float


def read_labview(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read the channels of a LabVIEW measurement file by their column titles.

    Titles that occur twice get their number (`Force #1`). The sampling interval is the header's `Delta_X`, or that of
    an X column which contradicts it: such a file was decimated after recording. A whole multiple of `Delta_X` is then
    exact. A `Delta_X` of few digits needs an X column or `sample_rate_hz`. Segments keep their starts and pauses. The
    `Comment` column and special blocks are skipped. Memory: the result and one block.
    """
    with path.open("rb") as stream:
        segments = list(_segments(path, stream))
    requested = select_names(path, names, _channel_columns(segments[0].titles))
    parts: dict[str, list[_Part]] = {name: [] for name in requested}
    for segment in segments:
        for name, part in _read_segment(path, segment, requested).items():
            parts[name].append(part)
    return {name: _join_segments(path, parts.pop(name), sample_rate_hz) for name in requested}


def _segments(path: Path, stream: BinaryIO) -> Iterator[_Segment]:
    """Yield the segments of a file with parsed headers."""
    if not stream.readline().startswith(b"LabVIEW Measurement"):
        raise ValueError(f"{path}: expected the first line of a LabVIEW measurement, found another")
    position, size = stream.tell(), stream.seek(0, 2)
    file_header, position, line = _header(path, stream, position, size, 2, None)
    separator = _SEPARATORS.get(file_header.get(_SEPARATOR, ["Tab"])[0], "\t")
    comma = file_header.get("Decimal_Separator", ["."])[0] == "," and separator != ","
    while position < size:
        header, position, line = _header(path, stream, position, size, line, separator)
        titles = [title.strip() for title in decode_text(stream.readline()).rstrip("\r\n").split(separator)]
        if titles == [""]:
            raise ValueError(f"{path}: line {line}: expected column titles after the header, found none")
        if len(titles) > MOST_CHANNELS:
            raise ValueError(f"{path}: line {line}: expected at most {MOST_CHANNELS} columns, found {len(titles)}")
        start = stream.tell()
        columns = len(titles) - (1 if titles[-1] in (_COMMENT, "") else 0)
        layout = TextLayout(path, columns, separator, comma, remarks=True)
        stop = find_bytes(stream, _CHANNELS, start, size) + 1 or size
        special = find_bytes(stream, _SPECIAL.encode(), start, stop)
        rows_end = special if special >= 0 else stop
        yield _Segment({**file_header, **header}, titles, layout, start, rows_end, line + 1)
        if special >= 0 and find_bytes(stream, _END, special, size) < 0:
            return
        line += 1 + sum(block.count(b"\n") for _, block in whole_lines(stream, start, rows_end))
        position = rows_end


def _header(
    path: Path, stream: BinaryIO, start: int, size: int, line: int, separator: str | None
) -> tuple[dict[str, list[str]], int, int]:
    """Return a header's entries without special blocks, the next byte, and its line number."""
    end = find_bytes(stream, _END, start, size)
    if end < 0:
        raise ValueError(f"{path}: line {line}: expected ***End_of_Header***, found the end of the file")
    stream.seek(start)
    raw = stream.read(end - start) + stream.readline()
    texts = decode_text(raw).splitlines()
    file_separator = next(
        (text[len(_SEPARATOR)] for text in texts if text.startswith(_SEPARATOR) and text != _SEPARATOR), "\t"
    )
    entries: dict[str, list[str]] = {}
    special = False
    for text in texts:
        special = (special or text.startswith(_SPECIAL)) and not text.startswith(_SPECIAL_END)
        cells = [cell.strip() for cell in text.split(file_separator if separator is None else separator)]
        if not special and cells[0] and len(cells) > 1:
            entries[cells[0]] = cells[1:]
    return entries, start + len(raw), line + raw.count(b"\n")


def _channel_columns(titles: Sequence[str]) -> dict[str, int]:
    """Return the columns of channels by unique names."""
    columns = [i for i, title in enumerate(titles) if title not in (_TIMES, _COMMENT, "")]
    plain = [titles[i] for i in columns]
    count, seen, named_columns = Counter(plain), Counter[str](), dict[str, int]()
    for name, i in zip(plain, columns, strict=True):
        seen[name] += 1
        named_columns[name if count[name] == 1 else f"{name} #{seen[name]}"] = i
    return named_columns


def _read_segment(path: Path, segment: _Segment, requested: Sequence[str]) -> dict[str, _Part]:
    """Read the requested channels of a segment and their X columns."""
    channels = _channel_columns(segment.titles)
    for name in requested:
        if name not in channels:
            raise ValueError(f'{path}: line {segment.line}: expected the channel "{name}" in every segment')
    requested_columns = {name: channels[name] for name in requested}
    all_times = [i for i, title in enumerate(segment.titles) if title == _TIMES]
    before = {name: all_times[: bisect(all_times, column)][-_NEAREST:] for name, column in requested_columns.items()}
    needed = sorted({*requested_columns.values(), *(i for columns in before.values() for i in columns)})
    columns = read_columns(segment.layout, segment.start, segment.stop, segment.line, needed)
    parts = {}
    for name in requested:
        samples, column = columns[requested_columns[name]], requested_columns[name]
        stated = int(_value(segment, "Samples", column, len(samples)))
        if 0 < stated < len(samples) and np.isnan(samples[stated:]).all():
            samples = samples[:stated]  # columns shorter than others (X_Columns Multi) end there
        near = {i: columns[i][: len(samples)] for i in before[name]}
        dated = [i for i, time in near.items() if np.isfinite(time).all()][-1:]
        digit = last_digit(segment.layout, segment.start, segment.stop, dated[0]) if dated else 0.0
        parts[name] = _Part(samples, segment, column, near[dated[0]] if dated else None, digit)
    return parts


def _join_segments(path: Path, parts: Sequence[_Part], sample_rate_hz: float | None) -> RawChannel:
    """Join one channel over its segments, each with its start."""
    times = [_times(path, part, sample_rate_hz) for part in parts]
    unit = _cell(parts[0].segment, "Y_Unit_Label", parts[0].column)
    if len(parts) == 1:
        return RawChannel.from_times(times[0], parts[0].samples, unit)
    segments = []
    for part, part_times in zip(parts, times, strict=True):
        if part_times.stamp_s is not None:
            raise ValueError(f"{path}: line {part.segment.line}: expected uniform times in each of several segments")
        start = part_times.start_s + _stamp_seconds(part) - _stamp_seconds(parts[0])
        segments.append(Segment(start, len(part.samples), 1.0 / part_times.rate_hz))
    joined = times_of_segments(path, f"line {parts[-1].segment.line - 1}", segments)
    return RawChannel.from_times(joined, np.concatenate([part.samples for part in parts]), unit)


def _cell(segment: _Segment, key: str, column: int) -> str:
    """Return a channel's text from the header, empty where there is none.

    The cell of a channel is above its column, or, where the header has one cell per channel without blanks, at the
    channel's position among the channels.
    """
    cells, channel_columns = segment.header.get(key, []), sorted(_channel_columns(segment.titles).values())
    counted = segment.header.get("Samples", cells)
    in_columns = any(counted[:index].count("") for index in range(1, len(counted)) if counted[index])
    index = column - 1 if in_columns else channel_columns.index(column)
    return cells[index] if index < len(cells) else ""


def _value(segment: _Segment, key: str, column: int, default: float) -> float:
    """Return a channel's number from the header; a single number applies to all channels."""
    cells = [cell for cell in segment.header.get(key, []) if cell]
    text = _cell(segment, key, column) or (cells[0] if len(cells) == 1 else "")
    return float(text.replace(",", ".") or default)


def _times(path: Path, part: _Part, sample_rate_hz: float | None) -> SampleTimes:
    """Return the times of a channel's samples in one segment."""
    segment, column, count = part.segment, part.column, len(part.samples)
    line, start = segment.line - 1, _value(segment, "X0", column, 0.0)
    dimension = _cell(segment, "X_Dimension", column)
    if dimension not in ("", "Time"):
        raise ValueError(f"{path}: line {line}: expected samples over time, found X_Dimension {dimension}")
    text, where = _cell(segment, "Delta_X", column) or "0", f"line {line}: Delta_X"
    step = float(text.replace(",", "."))
    u_step = 0.5 * digit_of(text, "," in text) / step if step > 0.0 else np.inf
    if part.times is not None and count > 1:
        return _of_column(path, part, (step, u_step), sample_rate_hz)
    samples = int(_value(segment, "Samples", column, count))
    if count < samples or 0 < samples < count:
        more = "" if count < samples else "; an X column must state the times of samples added by other writes"
        raise ValueError(f"{path}: line {line}: expected {samples} samples as in the header, found {count}{more}")
    if not step > 0.0:
        return SampleTimes(agreed_rate(path, where, None, sample_rate_hz), start)
    decade = 1.0 / step / 10.0 ** np.floor(-np.log10(step))
    believed = u_step <= _FEW or (u_step <= _TOO_FEW and np.min(np.abs(decade / np.array(_ROUND) - 1.0)) < 1e-9)
    if not believed and sample_rate_hz is None:
        raise ValueError(f"{path}: {where}: expected more digits than {text} or an X column; give sample_rate")
    return SampleTimes(agreed_rate(path, where, 1.0 / step, sample_rate_hz, u_step), start)


def _of_column(path: Path, part: _Part, stated: tuple[float, float], sample_rate_hz: float | None) -> SampleTimes:
    """Return the times from an X column and the stated interval with its relative u."""
    assert part.times is not None
    (step, u_step), count, where = stated, len(part.samples), f"line {part.segment.line - 1}: X column"
    mean = float(part.times[-1] - part.times[0]) / (count - 1)
    multiple = round(mean / step) if step > 0.0 and mean > 0.0 else 0
    exact = multiple > 0 and abs(multiple * step - mean) * (count - 1) <= max(0.5 * mean, part.digit)
    exact_rate = 1.0 / (multiple * step) if exact else None
    coarse = part.digit > 0.25 * mean
    given = (exact_rate if sample_rate_hz is None else sample_rate_hz) if coarse else None
    found = times_of_stamps(path, where, part.times, digit=part.digit, given_hz=given)
    if found.stamp_s is not None:
        return found
    # The column is printed with few digits; the header's interval, or a multiple of it, often has more.
    u_column = part.digit / ((count - 1) * mean)
    rate, u = (exact_rate, u_step) if exact_rate is not None and u_step < u_column else (found.rate_hz, u_column)
    return SampleTimes(agreed_rate(path, where, rate, sample_rate_hz, u), float(part.times[0]))


def _stamp_seconds(part: _Part) -> float:
    """Return a segment's time stamp in seconds, 0 where it has none."""
    date, time = (_cell(part.segment, key, part.column) for key in ("Date", "Time"))
    if not date or not time:
        return 0.0
    clock, _, fraction = time.replace(",", ".").partition(".")
    seconds = (datetime.strptime(f"{date} {clock}", "%Y/%m/%d %H:%M:%S") - datetime(2000, 1, 1)).total_seconds()
    return seconds + float(f"0.{fraction or 0}")
