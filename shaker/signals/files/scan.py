"""Text export of a scanning vibrometer, as in PTB's data set 10.7795/720.20181105 (`Scan_time.asc`).

The published description (content.txt) says: from line 19 on stand the x, y, z coordinates of the scan points, then a
line with the number of samples and the sampling interval (line 29 in one file, 44 in another), then data blocks, each
with one data set per scan point: block 1 the vibrometer, blocks 2 and 3 reference, force or camera trigger. What it
leaves open is decided here, and only here:

- Coordinates are metres; a scan point is a line of exactly three numbers, and the list ends at the first line that is
  none.
- The acquisition line is the first line after it with exactly two numbers, a whole number of samples and a positive
  interval in seconds.
- Numbers are separated by blanks, tabs or semicolons, with a decimal point or comma. Lines that are not all numbers
  (titles, blank lines) are passed over.
- A block is a table of one row per sample with one column per scan point, or, where rows have another length, the
  data sets of its points one after another. All blocks have the same size; there may be any number of them.
- Units are not read from the file: the manifest's scale converts.
- The first sample of every data set is at time zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.signals.files.common import chosen, reading
from shaker.signals.files.text import plain_rows, whole_lines
from shaker.signals.recording import RawChannel

_FIRST_POINT = 19  # line number, counted from 1
_PLAIN = bytes.maketrans(b",;", b". ")  # decimal comma to point, semicolon to blank


@dataclass(frozen=True)
class Scan:
    """A scan: `point_m` (P, 3), `samples` (B blocks, P points, S), taken point after point, each from time zero."""

    point_m: FloatArray
    samples: FloatArray
    sample_rate_hz: float

    def __post_init__(self) -> None:
        check_shape("point_m", self.point_m, (None, 3))
        check_shape("samples", self.samples, (None, len(self.point_m), None))

    def take(self, point: int) -> dict[str, RawChannel]:
        """Return what was recorded at one scan point: block numbers "1", "2", … to channels."""
        return {
            str(block + 1): RawChannel(self.samples[block, point], self.sample_rate_hz)
            for block in range(len(self.samples))
        }


def read_scan_asc(path: Path) -> Scan:
    """Read a scanning vibrometer's text; every scan point is a take of its own."""
    with reading(path):
        return _scan(path)


def _scan(path: Path) -> Scan:
    """Read points, acquisition and data blocks."""
    with path.open("rb") as stream:
        for _ in range(_FIRST_POINT - 1):
            stream.readline()
        points = []
        while len(row := _numbers(line := stream.readline())) == 3:
            points.append(row)
        if not points:
            raise ValueError(f"{path}: line {_FIRST_POINT}: expected x, y, z of the first scan point, found none")
        samples, interval = _acquisition(path, stream, line)
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
    shaped = values.reshape(-1, samples, count).swapaxes(1, 2) if by_rows else values.reshape(-1, count, samples)
    return Scan(np.array(points), np.ascontiguousarray(shaped), 1.0 / interval)


def read_scan_channels(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read a scan by `block/point`, both counted from 1; `block` alone where the scan has one point."""
    scan = read_scan_asc(path)
    present = {
        f"{block}/{point + 1}": channel
        for point in range(len(scan.point_m))
        for block, channel in scan.take(point).items()
    }
    if len(scan.point_m) == 1:
        present |= scan.take(0)
    return {name: present[name] for name in chosen(path, names, present)}


def _numbers(line: bytes) -> list[float]:
    """Return a line's numbers, none where it holds anything else."""
    try:
        return [float(cell) for cell in line.translate(_PLAIN).split()]
    except ValueError:
        return []


def _acquisition(path: Path, stream: BinaryIO, line: bytes) -> tuple[int, float]:
    """Return number of samples and sampling interval from the first line of numbers, which is to be theirs."""
    while line:
        row = _numbers(line)
        if row:
            if len(row) == 2 and row[0] >= 1.0 and row[0] == int(row[0]) and row[1] > 0.0:
                return int(row[0]), row[1]
            break
        line = stream.readline()
    raise ValueError(f"{path}: expected a line with the number of samples and the sampling interval, found none")


def _data(stream: BinaryIO, start: int, stop: int) -> tuple[FloatArray, set[int]]:
    """Return all numbers behind the acquisition line one after another, and the lengths of their rows."""
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
