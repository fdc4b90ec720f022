"""Times of samples: one representation for all readers, and statements of files about time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shakercal._common.arrays import FloatArray

CONTINUOUS = 0.5
"""Sampling intervals by which a segment may begin early or late and still continue the one before."""
SAME_RATE = 1e-6
"""Relative difference of two statements of one sampling rate that agree."""
_GRID = 0.01  # sampling intervals by which a stamp may lie off a uniform grid: 0.03 rad of phase at the Nyquist rate
_ROUNDING = 8.0  # units in the last place by which a stamp may deviate from a uniform grid
_DIGITS = 0.75  # of the last printed digit: rounding leaves a half, a straight line through few samples a little more
_COARSE = 0.25  # last printed digit over the sampling interval, from which on stamps may hide a lost sample
_FINEST_DIGIT = 9  # decimals of a second that numbers without text are searched for: nanoseconds
_BLOCK = 1 << 16  # stamps worked on at a time

_SECONDS = {
    "s": "s sec secs second seconds sekunde sekunden",
    "ms": "ms msec msecs millisecond milliseconds",
    "us": "us µs μs usec usecs microsecond microseconds",
    "ns": "ns nsec nsecs nanosecond nanoseconds",
    "min": "min mins minute minutes",
    "h": "h hr hrs hour hours",
    "D": "d day days",
}
_FACTORS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "D": 86400.0}
_BY_NAME = {name: _FACTORS[unit] for unit, names in _SECONDS.items() for name in names.split()}


@dataclass(frozen=True)
class SampleTimes:
    """Times of the samples of a channel, in seconds.

    Uniform times are `start_s` + i / `rate_hz`. Other times are `start_s` + `stamp_s` (S,), ascending from 0, and
    `rate_hz` is one over their median interval.
    """

    rate_hz: float
    start_s: float = 0.0
    stamp_s: FloatArray | None = None


@dataclass(frozen=True)
class Segment:
    """Samples that a file states as uninterrupted: `count` every `interval_s` from `start_s`."""

    start_s: float
    count: int
    interval_s: float


def seconds_of(path: Path, where: str, unit: str) -> float:
    """Return the seconds of a time unit of files (`ms`, `milliseconds since 1970-01-01`); seconds without one."""
    words = unit.strip().split()
    name = words[0].rstrip(".") if words else "s"
    factor = _BY_NAME.get(name.lower())
    if factor is None or (len(words) > 1 and words[1].lower() != "since"):
        raise ValueError(f"{path}: {where}: expected a unit of time (s, ms, us, ns, min, h), found {unit!r}")
    return factor


def agreed_rate(path: Path, where: str, stated_hz: float | None, given_hz: float | None, u: float = SAME_RATE) -> float:
    """Return the stated sampling rate of a file, or the given one without.

    `u` is the relative uncertainty of the stated rate from its digits. Within it the given rate is used, which has more
    digits. `ValueError` where there is no rate, where it is not positive, or where the two contradict each other.
    """
    rate = given_hz if stated_hz is None else stated_hz
    if rate is None:
        raise ValueError(f"{path}: expected a sampling rate for {where}, found none; give sample_rate")
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"{path}: expected a positive sampling rate for {where}, found {rate}")
    if given_hz is None or stated_hz is None:
        return float(rate)
    if not abs(given_hz - rate) <= max(u, SAME_RATE) * rate:
        raise ValueError(
            f"{path}: {where}: expected sample_rate = {rate:.9g} Hz as in the file, found {given_hz:.9g} Hz; "
            f"correct or remove sample_rate"
        )
    return float(given_hz if u > SAME_RATE else rate)


def times_of_segments(path: Path, where: str, segments: Sequence[Segment]) -> SampleTimes:
    """Return the times of samples in segments, each with its start.

    Segments that continue one another are uniform together, by the clock of the samples. Pauses between them are
    preserved. `ValueError` where two segments have different rates, or one begins before the previous one has ended.
    """
    first, interval = segments[0], segments[0].interval_s
    gaps, index = False, 0
    for before, after in pairwise(segments):
        index += before.count
        if abs(after.interval_s - interval) > SAME_RATE * interval:
            raise ValueError(
                f"{path}: {where}: expected one sampling rate, found {1.0 / interval:.9g} Hz and, from sample {index} "
                f"on, {1.0 / after.interval_s:.9g} Hz"
            )
        end = before.start_s + before.count * interval
        if after.start_s < end - CONTINUOUS * interval:
            raise ValueError(
                f"{path}: {where}: expected a segment that begins at {end - first.start_s:.6f} s or later, found "
                f"one that begins at {after.start_s - first.start_s:.6f} s, before the last one has ended"
            )
        gaps = gaps or after.start_s > end + CONTINUOUS * interval
    if not gaps:
        return SampleTimes(1.0 / interval, first.start_s)
    stamps = [part.start_s - first.start_s + interval * np.arange(part.count) for part in segments]
    return SampleTimes(1.0 / interval, first.start_s, np.concatenate(stamps))


def times_of_stamps(
    path: Path,
    where: str,
    stamps: NDArray[Any],
    unit: str = "",
    *,
    digit: float | None = None,
    given_hz: float | None = None,
) -> SampleTimes:
    """Return the times of samples (S,) from stamps: numbers or dates.

    Numbers are in a time unit. Stamps that deviate from a straight line by no more than their digits explain are
    uniform, at the rate of its slope. All others are used unchanged. `digit` is the last printed digit of a text, in
    its unit. `given_hz` is a rate from another source. `ValueError` where stamps decrease, where they contradict the
    given rate, and where their digits are so coarse that a lost sample would be hidden and no rate is given.
    """
    if len(stamps) < 2:
        raise ValueError(f"{path}: {where}: expected at least 2 samples, found {len(stamps)}")
    time_s, start_s, digit_s = _from_first(path, where, stamps, unit, digit)
    if not np.isfinite(time_s[-1]) or not np.isfinite(np.sum(time_s)):
        raise ValueError(f"{path}: {where}: expected times, found {int(np.sum(~np.isfinite(time_s)))} invalid ones")
    interval, offset, deviation = _line(time_s)
    if interval <= 0.0:
        raise ValueError(f"{path}: {where}: expected ascending times, found {_backwards(time_s)}")
    rounding = _ROUNDING * float(np.spacing(max(abs(start_s), float(np.max(np.abs(time_s))))))
    coarse = digit_s > _COARSE * interval
    if deviation <= max(_DIGITS * digit_s, _GRID * interval, rounding):
        u = 0.0
        if deviation > max(_GRID * interval, rounding) and coarse:
            step = np.rint(np.diff(time_s) / digit_s)
            if given_hz is None and step.max() >= 2.0 * step.min():
                raise ValueError(
                    f"{path}: {where}: expected times with more digits, found steps of {digit_s:.3g} s at intervals "
                    f"of {interval:.6g} s, which would hide lost samples; give sample_rate"
                )
            u = 2.0 * digit_s / float(time_s[-1])
        return SampleTimes(
            agreed_rate(path, where, 1.0 / interval, given_hz, max(u, _GRID / len(time_s))), start_s + offset
        )
    step = np.diff(time_s)
    if not step.min() > 0.0:
        raise ValueError(f"{path}: {where}: expected ascending times, found {_backwards(time_s)}")
    rate = 1.0 / float(np.median(step))
    if given_hz is not None and abs(given_hz - rate) > _GRID * rate:
        agreed_rate(path, where, rate, given_hz)
    return SampleTimes(rate, start_s, time_s)


def _from_first(
    path: Path, where: str, stamps: NDArray[Any], unit: str, digit: float | None
) -> tuple[FloatArray, float, float]:
    """Return seconds (S,) from the first stamp, that stamp, and the last digit, in seconds."""
    kind = stamps.dtype.kind
    if kind in "mM":
        name, multiple = np.datetime_data(stamps.dtype)
        if name not in _FACTORS or np.isnat(stamps).any():
            raise ValueError(f"{path}: {where}: expected dates, found {int(np.isnat(stamps).sum())} invalid ones")
        ticks, factor, digit = stamps.astype(np.int64), multiple * _FACTORS[name], 1.0
    elif kind in "iuf":
        ticks, factor = stamps, seconds_of(path, where, unit)
    else:
        raise ValueError(f"{path}: {where}: expected times, found {stamps.dtype}")
    if kind in "iu" and not unit.strip():
        raise ValueError(f"{path}: {where}: expected a unit of the whole numbers (s, ms, us, ns), found none")
    first = ticks[0]
    time_s = np.multiply(np.subtract(ticks, first), factor, dtype=np.float64)
    if digit is None:
        digit = 1.0 if ticks.dtype.kind in "iu" else 0.0
        if kind == "f" and np.array_equal(ticks, ticks.astype(np.float32)):
            digit = float(np.spacing(np.max(np.abs(ticks)).astype(np.float32)))
        elif not digit:
            digit = _last_digit(time_s) / factor
    return time_s, float(first) * factor, digit * factor


def _last_digit(time_s: FloatArray) -> float:
    """Return the power of ten (s) that divides all times, 0 if finer than 1 ns or a whole interval, which is exact."""
    interval = float(np.median(np.diff(time_s[:_BLOCK])))
    for decimals in range(_FINEST_DIGIT + 1):
        ticks = time_s[:_BLOCK] * 10.0**decimals
        if np.max(np.abs(ticks - np.rint(ticks))) < 1e-4:
            digit = 10.0**-decimals
            return digit if digit <= _COARSE * interval else 0.0
    return 0.0


def _line(time_s: FloatArray) -> tuple[float, float, float]:
    """Return slope, offset and largest deviation of the straight line through times (S,), of its ends if exact."""
    count = len(time_s)
    interval, half = float(time_s[-1] - time_s[0]) / (count - 1), (count - 1) / 2.0
    total = moment = 0.0
    parts = [slice(first, first + _BLOCK) for first in range(0, count, _BLOCK)]
    largest = 0.0
    for part in parts:
        index = np.arange(part.start, min(part.stop, count))
        off = time_s[part] - interval * index
        total, moment = total + float(np.sum(off)), moment + float(off @ (index - half))
        largest = max(largest, float(np.max(np.abs(off))))
    if largest <= _ROUNDING * float(np.spacing(np.max(np.abs(time_s)))):
        return interval, 0.0, largest
    slope = moment / (count * (count**2 - 1.0) / 12.0)
    interval, offset = interval + slope, total / count - slope * half
    deviation = max(
        float(np.max(np.abs(time_s[part] - offset - interval * np.arange(part.start, min(part.stop, count)))))
        for part in parts
    )
    return interval, offset, deviation


def _backwards(time_s: FloatArray) -> str:
    """Describe the first step that does not go forward."""
    index = int(np.argmax(~(np.diff(time_s) > 0.0)))
    step = time_s[index + 1] - time_s[index]
    return f"a step of {step:.6g} s after sample {index}, {time_s[index]:.6g} s from the first"


def first_gap(times: SampleTimes) -> str | None:
    """Describe the first deviation of non-uniform times from the grid; None for uniform ones."""
    if times.stamp_s is None:
        return None
    step = np.diff(times.stamp_s)
    median = 1.0 / times.rate_hz
    off = np.flatnonzero(np.abs(step - median) > CONTINUOUS * median)
    gaps = off[step[off] > median]
    if not len(gaps):
        return f"intervals between {step.min():.4g} s and {step.max():.4g} s"
    index = int(gaps[0])
    more = f", the first of {len(gaps)} gaps" if len(gaps) > 1 else ""
    where = f"between samples {index} and {index + 1}, {times.stamp_s[index]:.6g} s from the first"
    return f"{step[index]:.6g} s {where}{more}"
