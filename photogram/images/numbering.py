"""Missing frames of a series, from numbers in file names or time stamps."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from shakercal._common.arrays import FloatArray, IntArray

MAX_DIGITS = 18  # of a number of 64 bits
NEAR = 0.25  # intervals by which time stamps may be wrong
SHOWN = 3  # missing numbers that are named
SEXAGESIMAL = (40, 4040)  # by which hhmmss grows from one minute, or hour, to the next beyond a second


@dataclass(frozen=True)
class FrameNumbers:
    """How the frames of a series are counted, from its first one on.

    Attributes
    ----------
    frame_index : (F,) 0, then how many frames later each one was, the missing ones counted.
    first, last : their numbers as written.
    step : increment of the numbers.
    missing : the missing numbers as text, "" for none.
    exact : whether a counter numbers the frames; False for times, which may stray.
    """

    frame_index: IntArray
    first: str
    last: str
    step: int = 1
    missing: str = ""
    exact: bool = True


def numbers_of_names(names: Sequence[str]) -> FrameNumbers | None:
    """Return how file names count their frames, None if no number in them does.

    The names differ in numbers alone. A counter ascends from file to file, in most cases by one step, in all cases by
    multiples of it. A number that ascends by nearly one step is a time. Of several counters the one with a gap is
    returned.

    >>> counted = numbers_of_names(["a0001.tif", "a0002.tif", "a0004.tif"])
    >>> counted.frame_index.tolist(), counted.missing
    ([0, 1, 3], '0003')
    """
    parts = [re.split(r"(\d+)", Path(name).name) for name in names]
    if len(names) < 3 or len({tuple(part[::2]) for part in parts}) != 1:
        return None
    columns = [column for column in zip(*(part[1::2] for part in parts), strict=True) if len(set(column)) > 1]
    found = [counted for column in columns if (counted := _counter(column)) is not None]
    if not found and len(columns) == 1:
        found = [counted for column in columns if (counted := _stamps(column)) is not None]
    return max(found, key=lambda counted: bool(counted.missing), default=None)


def _steps(texts: Sequence[str]) -> IntArray | None:
    """Return steps (F-1,) from number to number, None unless they ascend."""
    if max(map(len, texts)) > MAX_DIGITS:
        return None
    steps: IntArray = np.array([int(after) - int(before) for before, after in pairwise(texts)], dtype=np.int64)
    return steps if steps.min() > 0 else None


def _counter(texts: Sequence[str]) -> FrameNumbers | None:
    steps = _steps(texts)
    if steps is None:
        return None
    step = math.gcd(*steps.tolist())
    if 2 * np.count_nonzero(steps == step) < len(steps):
        return None
    missing = []
    for start, size in zip(texts[:-1], steps.tolist(), strict=True):
        between = range(int(start) + step, int(start) + size, step)
        if between:
            ends = dict.fromkeys(f"{number:0{len(start)}d}" for number in (between[0], between[-1]))
            missing.append(" to ".join(ends))
    frame_index = np.concatenate([[0], np.cumsum(steps // step)])
    return FrameNumbers(frame_index, texts[0], texts[-1], step, _listed(missing))


def _stamps(texts: Sequence[str]) -> FrameNumbers | None:
    """Count by a time in the name, also one written as hhmmss and decimals."""
    steps = _steps(texts)
    if steps is None:
        return None
    interval = float(np.median(steps))
    for jump in (base * 10**power for base in SEXAGESIMAL for power in range(MAX_DIGITS - 4)):
        steps = np.where(np.abs(steps - jump - interval) <= NEAR * interval, np.int64(interval), steps)
    return _counted_by_times(np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)]), 0.0, texts)


def numbers_of_times(time_s: FloatArray, resolution_s: float) -> FrameNumbers | None:
    """Return how frames at times (F,) are counted, None without a common interval.

    The times are rounded to a resolution.
    """
    if len(time_s) < 3 or np.diff(time_s).min() <= 0.0:
        return None
    return _counted_by_times(time_s, resolution_s, [f"{time:.6g} s" for time in time_s.tolist()])


def _counted_by_times(time: FloatArray, resolution: float, written: Sequence[str]) -> FrameNumbers | None:
    steps = np.diff(time)
    interval = float(np.median(steps))
    count = np.maximum(np.rint(steps / interval), 1.0)
    if interval <= resolution or np.any(np.abs(steps - count * interval) > NEAR * interval + resolution):
        return None
    missing = [
        f"{int(count[k]) - 1} between {written[k]} and {written[k + 1]}" for k in np.flatnonzero(count > 1.0).tolist()
    ]
    frame_index = np.concatenate([[0], np.cumsum(count.astype(np.int64))])
    return FrameNumbers(frame_index, written[0], written[-1], 1, _listed(missing), exact=False)


def _listed(missing: Sequence[str]) -> str:
    """Return the first missing numbers as text."""
    more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
    return ", ".join(missing[:SHOWN]) + more
