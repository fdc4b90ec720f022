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

from shaker.arrays import FloatArray
from shaker.io.channel import MOST_CHANNELS, UNIFORM, RawChannel, chosen, rate_of_times
from shaker.io.text import TextLayout, decoded, find_bytes, read_columns, whole_lines

_END, _CHANNELS = b"***End_of_Header***", b"\nChannels"
_SPECIAL, _SPECIAL_END = "***Start_Special***", "***End_Special***"
_SEPARATORS = {"Tab": "\t", "Comma": ",", "Semicolon": ";"}
_NEAREST = 8  # X columns before a channel that are looked at for its times
_COMMENT, _TIMES, _SEPARATOR = "Comment", "X_Value", "Separator"


@dataclass(frozen=True)
class _Segment:
    """One block of a file: header entries, column titles, layout, bytes of its rows and the line of the first."""

    header: dict[str, list[str]]
    titles: list[str]
    layout: TextLayout
    start: int
    stop: int
    line: int


@dataclass(frozen=True)
class _Part:
    """One channel in one segment: samples, their times where there is an X column, the segment, its own place."""

    samples: FloatArray
    times: FloatArray | None
    segment: _Segment
    index: int


def read_labview(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read the channels of a LabVIEW measurement file by their column titles.

    Titles that occur twice get their number (`Force #1`, `Force #2`). The sampling interval is the header's `Delta_X`.
    Where an X column contradicts it, the column counts: such a file was decimated after recording and kept its old
    header; an interval that is a whole multiple of `Delta_X` is then taken as exactly that. Several segments must
    continue one another (by `X0` or the X column, and their time stamps) and are joined. The `Comment` column and
    special blocks are passed over. `sample_rate_hz` serves files that state no interval. Memory: the result and one
    block.
    """
    with path.open("rb") as stream:
        segments = list(_segments(path, stream))
    wanted = chosen(path, names, _channel_columns(segments[0].titles))
    parts: dict[str, list[_Part]] = {name: [] for name in wanted}
    for segment in segments:
        for name, part in _read_segment(path, segment, wanted).items():
            parts[name].append(part)
    return {name: _joined(path, parts.pop(name), sample_rate_hz) for name in wanted}


def _segments(path: Path, stream: BinaryIO) -> Iterator[_Segment]:
    """Yield the segments of a file, their headers read."""
    if not stream.readline().startswith(b"LabVIEW Measurement"):
        raise ValueError(f"{path}: expected the first line of a LabVIEW measurement, found another")
    place, size = stream.tell(), stream.seek(0, 2)
    file_header, place, line = _header(path, stream, place, size, 2, None)
    separator = _SEPARATORS.get(file_header.get(_SEPARATOR, ["Tab"])[0], "\t")
    comma = file_header.get("Decimal_Separator", ["."])[0] == "," and separator != ","
    while place < size:
        header, place, line = _header(path, stream, place, size, line, separator)
        titles = [title.strip() for title in decoded(stream.readline()).rstrip("\r\n").split(separator)]
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
        place = rows_end


def _header(
    path: Path, stream: BinaryIO, start: int, size: int, line: int, separator: str | None
) -> tuple[dict[str, list[str]], int, int]:
    """Return the entries of a header but those of special blocks, the byte behind it, the number of the line there.

    The header of the file (`separator` None) is split by what stands behind its key Separator.
    """
    end = find_bytes(stream, _END, start, size)
    if end < 0:
        raise ValueError(f"{path}: line {line}: expected ***End_of_Header***, found the end of the file")
    stream.seek(start)
    raw = stream.read(end - start) + stream.readline()
    texts = decoded(raw).splitlines()
    own = next((text[len(_SEPARATOR)] for text in texts if text.startswith(_SEPARATOR) and text != _SEPARATOR), "\t")
    entries: dict[str, list[str]] = {}
    special = False
    for text in texts:
        special = (special or text.startswith(_SPECIAL)) and not text.startswith(_SPECIAL_END)
        cells = [cell.strip() for cell in text.split(own if separator is None else separator)]
        if not special and cells[0] and len(cells) > 1:
            entries[cells[0]] = cells[1:]
    return entries, start + len(raw), line + raw.count(b"\n")


def _channel_columns(titles: Sequence[str]) -> dict[str, int]:
    """Return the columns of channels by unique names."""
    columns = [i for i, title in enumerate(titles) if title not in (_TIMES, _COMMENT, "")]
    plain = [titles[i] for i in columns]
    count, seen, places = Counter(plain), Counter[str](), dict[str, int]()
    for name, i in zip(plain, columns, strict=True):
        seen[name] += 1
        places[name if count[name] == 1 else f"{name} #{seen[name]}"] = i
    return places


def _read_segment(path: Path, segment: _Segment, wanted: Sequence[str]) -> dict[str, _Part]:
    """Read the channels wanted of a segment, and the X columns that belong to them."""
    channels = _channel_columns(segment.titles)
    for name in wanted:
        if name not in channels:
            raise ValueError(f'{path}: line {segment.line}: expected the channel "{name}" in every segment')
    own = {name: channels[name] for name in wanted}
    all_times = [i for i, title in enumerate(segment.titles) if title == _TIMES]
    before = {name: all_times[: bisect(all_times, column)][-_NEAREST:] for name, column in own.items()}
    needed = sorted({*own.values(), *(i for places in before.values() for i in places)})
    columns = read_columns(segment.layout, segment.start, segment.stop, segment.line, needed)
    parts, places = {}, {name: index for index, name in enumerate(channels)}
    for name in wanted:
        samples, index = columns[own[name]], places[name]
        stated = int(_value(segment, "Samples", index, len(samples)))
        if 0 < stated < len(samples) and np.isnan(samples[stated:]).all():
            samples = samples[:stated]  # columns shorter than others (X_Columns Multi) end where the header says
        near = (columns[i][: len(samples)] for i in before[name])
        times = [time for time in near if np.isfinite(time).all()]
        parts[name] = _Part(samples, times[-1] if times else None, segment, index)
    return parts


def _joined(path: Path, parts: Sequence[_Part], sample_rate_hz: float | None) -> RawChannel:
    """Join one channel over the segments, which must continue one another."""
    steps = [_interval(path, part, sample_rate_hz) for part in parts]
    first = parts[0]
    start = expected = _start(first)
    for part, step in zip(parts, steps, strict=True):
        line = part.segment.line - 1
        if abs(step - steps[0]) > 1e-6 * steps[0]:
            raise ValueError(f"{path}: line {line}: expected one sampling interval, found {step} s")
        here = _start(part) + _stamp(part) - _stamp(first)
        if abs(here - expected) > UNIFORM * steps[0]:
            raise ValueError(
                f"{path}: line {line}: expected a segment that goes on at {expected:.6f} s, found one from {here:.6f} s"
            )
        expected += len(part.samples) * steps[0]
    samples = first.samples if len(parts) == 1 else np.concatenate([part.samples for part in parts])
    units = first.segment.header.get("Y_Unit_Label", [])
    return RawChannel(samples, 1.0 / steps[0], start, units[first.index] if first.index < len(units) else "")


def _start(part: _Part) -> float:
    """Return the time of a part's first sample, from its X column or header."""
    return float(part.times[0]) if part.times is not None else _value(part.segment, "X0", part.index, 0.0)


def _cell(segment: _Segment, key: str, index: int) -> str:
    """Return a channel's text from the header, the last one where there are fewer, empty where there is none."""
    cells = [cell for cell in segment.header.get(key, []) if cell]
    return cells[min(index, len(cells) - 1)].replace(",", ".") if cells else ""


def _value(segment: _Segment, key: str, index: int, default: float) -> float:
    return float(_cell(segment, key, index) or default)


def _interval(path: Path, part: _Part, sample_rate_hz: float | None) -> float:
    """Return the sampling interval of a channel in a segment (s)."""
    given = 1.0 / sample_rate_hz if sample_rate_hz is not None else 0.0
    stated, count = _value(part.segment, "Delta_X", part.index, given), len(part.samples)
    line = part.segment.line - 1
    if part.times is not None and count > 1:
        measured = 1.0 / rate_of_times(path, part.times, f"line {line}: X column")[0]
        multiple = round(measured / stated) if stated > 0.0 else 0
        # The column is printed with few digits; the header's interval, or a multiple of it, has them all.
        exact = multiple > 0 and abs(multiple * stated - measured) * (count - 1) <= UNIFORM * measured
        if not (exact and multiple == 1):
            return multiple * stated if exact else measured
    if not stated > 0.0:
        raise ValueError(f"{path}: expected a sampling interval Delta_X, found none; give sample_rate")
    samples = int(_value(part.segment, "Samples", part.index, count))
    if count < samples:
        raise ValueError(f"{path}: line {line}: expected {samples} samples as the header says, found {count}")
    return stated


def _stamp(part: _Part) -> float:
    """Return a segment's time stamp in seconds, 0 where it has none."""
    date, time = (_cell(part.segment, key, part.index) for key in ("Date", "Time"))
    if not date or not time:
        return 0.0
    clock, _, fraction = time.partition(".")
    seconds = (datetime.strptime(f"{date} {clock}", "%Y/%m/%d %H:%M:%S") - datetime(2000, 1, 1)).total_seconds()
    return seconds + float(f"0.{fraction or 0}")
