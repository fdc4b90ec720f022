"""Raw channels, their times, channels that share one memory, and functions of all readers."""

from __future__ import annotations

import re
import stat
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from shakercal._common.arrays import BoolArray, FloatArray, IntArray, check_shape

T = TypeVar("T")


# Times of samples: one representation for all readers, and statements of files about time.

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
    """Return the seconds of a time unit, such as `milliseconds since 1970-01-01`; empty means seconds."""
    words = unit.strip().split()
    name = words[0].rstrip(".") if words else "s"
    factor = _BY_NAME.get(name.lower())
    if factor is None or (len(words) > 1 and words[1].lower() != "since"):
        raise ValueError(f"{path}: {where}: expected a unit of time (s, ms, us, ns, min, h), found {unit!r}")
    return factor


class MissingRateError(ValueError):
    """Neither a file nor its manifest states the sampling rate."""


def agreed_rate(path: Path, where: str, stated_hz: float | None, given_hz: float | None, u: float = SAME_RATE) -> float:
    """Return the stated sampling rate of a file, or the given one without.

    `u` is the relative uncertainty of the stated rate from its digits. Within it the given rate is used, which has more
    digits. `ValueError` where there is no rate, where it is not positive, or where the two contradict each other.
    """
    rate = given_hz if stated_hz is None else stated_hz
    if rate is None:
        raise MissingRateError(f"{path}: expected a sampling rate for {where}, found none; give sample_rate")
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
    """Return the times of samples (S,) from stamps: numbers in a time unit, or dates.

    Stamps that deviate from a straight line by no more than their digits explain are uniform, at the rate of its slope;
    others are used unchanged. `digit` is the last printed digit of a text, `given_hz` a rate from another source.
    `ValueError` where stamps decrease or contradict that rate, or are so coarse that a lost sample would be hidden.
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
    """Return the power of ten (s) that divides all times; 0 if below 1 ns."""
    interval = float(np.median(np.diff(time_s[:_BLOCK])))
    for decimals in range(_FINEST_DIGIT + 1):
        ticks = time_s[:_BLOCK] * 10.0**decimals
        if np.max(np.abs(ticks - np.rint(ticks))) < 1e-4:
            digit = 10.0**-decimals
            return digit if digit <= _COARSE * interval else 0.0
    return 0.0


def _line(time_s: FloatArray) -> tuple[float, float, float]:
    """Return slope, offset and largest deviation of the straight line through times (S,)."""
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


# Raw channels.


@dataclass(frozen=True)
class RawChannel:
    """Samples of one channel in the unit of the file.

    Attributes
    ----------
    samples : (S,), taken at `start_s + i / sample_rate_hz`.
    sample_rate_hz : sampling rate in Hz; one over the median interval where times are not uniform.
    start_s : start time of the file in s, 0 where the file states none.
    unit : unit as the file writes it, empty where it states none.
    stamp_s : (S,), seconds from the first sample where the times are not uniform, else None.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import RawChannel
    >>> RawChannel(np.zeros(500), 1000.0, unit="V")
    RawChannel(500 samples at 1000 Hz from 0 s, unit V)
    """

    samples: FloatArray
    sample_rate_hz: float
    start_s: float = 0.0
    unit: str = ""
    stamp_s: FloatArray | None = None

    def __post_init__(self) -> None:
        check_shape("samples", self.samples, (None,))
        if not self.sample_rate_hz > 0.0:
            raise ValueError(f"sample_rate_hz: expected a positive number, found {self.sample_rate_hz}")
        if self.stamp_s is not None:
            check_shape("stamp_s", self.stamp_s, self.samples.shape)

    @staticmethod
    def from_times(times: SampleTimes, samples: FloatArray, unit: str) -> RawChannel:
        """Return samples (S,) taken at these times."""
        return RawChannel(samples, times.rate_hz, times.start_s, unit, times.stamp_s)

    @property
    def gap(self) -> str | None:
        """Description of the first deviation from a uniform grid; None where times are uniform."""
        if self.stamp_s is None:
            return None
        step, median = np.diff(self.stamp_s), 1.0 / self.sample_rate_hz
        off = np.flatnonzero(np.abs(step - median) > CONTINUOUS * median)
        gaps = off[step[off] > median]
        if not len(gaps):
            return f"intervals between {step.min():.4g} s and {step.max():.4g} s"
        index = int(gaps[0])
        more = f", the first of {len(gaps)} gaps" if len(gaps) > 1 else ""
        where = f"between samples {index} and {index + 1}, {self.stamp_s[index]:.6g} s from the first"
        return f"{step[index]:.6g} s {where}{more}"

    @property
    def time_s(self) -> FloatArray:
        """Times (S,) of the samples in s from the first one."""
        uniform = self.stamp_s is None
        return np.arange(len(self.samples)) / self.sample_rate_hz if uniform else np.asarray(self.stamp_s)

    def __repr__(self) -> str:
        unit = f"unit {self.unit}" if self.unit else "no unit stated"
        rate = (
            f"{self.sample_rate_hz:g} Hz" if self.stamp_s is None else f"about {self.sample_rate_hz:g} Hz, not uniform,"
        )
        return f"RawChannel({len(self.samples)} samples at {rate} from {self.start_s:g} s, {unit})"


# Channels that share one memory.

_ROWS = 1 << 14  # rows processed at a time


@dataclass(frozen=True, eq=False)
class Stacked:
    """Channels (S, C) stored as separate columns and combined only for the requested rows.

    Each channel is a column times its factor. `rows` (S,) selects rows of the columns; None selects all.
    """

    columns: tuple[FloatArray, ...]
    factors: tuple[float, ...]
    rows: IntArray | None = None
    ndim = 2

    @staticmethod
    def from_array(values: FloatArray | Stacked) -> Stacked:
        """Return the columns of an array (S,) or (S, C); `ValueError` for any other."""
        if isinstance(values, Stacked):
            return values
        array = values[:, None] if values.ndim == 1 else values
        check_shape("values", array, (None, None))
        return Stacked(tuple(array.T), (1.0,) * array.shape[1])

    @property
    def shape(self) -> tuple[int, int]:
        """Number of samples and of channels."""
        every = len(self.columns[0]) if self.columns else 0
        return every if self.rows is None else len(self.rows), len(self.columns)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> FloatArray:
        """Return rows (R, C) of all channels."""
        selected = rows if self.rows is None else self.rows[rows]
        values = np.empty((len(range(*rows.indices(len(self)))), len(self.columns)))
        for c, (column, factor) in enumerate(zip(self.columns, self.factors, strict=True)):
            np.multiply(column[selected], factor, out=values[:, c])
        return values

    def iterate_channels(self) -> Iterator[FloatArray]:
        """Yield the channels (S,) in their order."""
        for column, factor in zip(self.columns, self.factors, strict=True):
            samples = column if self.rows is None else column[self.rows]
            yield np.ascontiguousarray(samples if factor == 1.0 else samples * factor, dtype=np.float64)

    def iterate_row_blocks(self) -> Iterator[FloatArray]:
        """Yield blocks of rows (R, C) in their order."""
        for first in range(0, len(self), _ROWS):
            yield self[first : first + _ROWS]

    def select(self, chosen: Sequence[int]) -> Stacked:
        """Return some of the channels."""
        columns, factors = zip(*((self.columns[c], self.factors[c]) for c in chosen), strict=True)
        return replace(self, columns=columns, factors=factors)

    def select_rows(self, rows: BoolArray | None) -> Stacked:
        """Return the rows (S,) where the mask is true; all rows for None."""
        if rows is None:
            return self
        chosen = np.flatnonzero(rows)
        return replace(self, rows=chosen if self.rows is None else self.rows[chosen])


# Shared by all file readers: channels by name, and errors of one sentence with the file.

BLOCK = 1 << 20  # bytes read at a time
MOST_CHANNELS = 10_000  # of a table
LONGEST_LINE = 16 << 20  # bytes of a line of text
MAX_NESTING = 64  # groups or structs inside one another
_FREE, _EXPANSION = 512 << 20, 100  # bytes of samples that any file may have, and how many more per byte of the file


@contextmanager
def convert_read_errors(path: Path) -> Iterator[None]:
    """Convert every read error into `OSError` or `ValueError`: one sentence with the path.

    A path that is no file is refused before it is opened: a pipe would wait for ever, and a device may have no end.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:  # ValueError: a NUL in its name
        cause = "none" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", None) or error
        raise FileNotFoundError(f"{path}: expected a file, found {cause}".replace("\0", "\\0")) from error
    if not stat.S_ISREG(mode):
        raise FileNotFoundError(
            f"{path}: expected a file, found {'a folder' if stat.S_ISDIR(mode) else 'a device or pipe'}"
        )
    try:
        yield
    except MemoryError as error:
        raise ValueError(f"{path}: expected a file that fits into memory, found one that does not") from error
    except Exception as error:
        # The libraries raise errors of every kind for damaged files; they are converted into one.
        text = " ".join(str(error).split())
        if isinstance(error, OSError | ValueError) and text.startswith(str(path)) and type(error) is not OSError:
            raise
        kind, cause = path.suffix.lower(), f"{type(error).__name__}: {text[:200]}"
        raise ValueError(f"{path}: expected a readable {kind} file, found a damaged one ({cause})") from error


def max_sample_bytes(path: Path) -> int:
    """Return the most bytes of samples that a file of this length may have."""
    return _FREE + _EXPANSION * path.stat().st_size


def check_size(path: Path, what: str, size: int) -> None:
    """Raise `ValueError` where a file declares more bytes, `size`, than its length allows."""
    most = max_sample_bytes(path)
    if size > most:
        found = f"{size / 1e6:.0f} MB declared in a file of {path.stat().st_size / 1e6:.3g} MB"
        raise ValueError(f"{path}: {what}: expected at most {most / 1e6:.0f} MB of samples, found {found}")


def select_names(path: Path, names: Sequence[str] | None, present: Iterable[str]) -> list[str]:
    """Return the requested names (None: all present), or raise `ValueError` with those present."""
    available = dict.fromkeys(present)
    if names is None:
        return list(available)
    for name in names:
        if name not in available:
            raise ValueError(f'{path}: expected a channel "{name}", found {format_names(list(available))}')
    return list(names)


def select_by_either_name(
    path: Path, names: Sequence[str] | None, present: Mapping[str, T], short: Sequence[str]
) -> dict[str, T]:
    """Return the items of requested names (None: all), which may be unique `short` names."""
    count = Counter(short)
    alone = {name: item for name, item in zip(short, present.values(), strict=True) if count[name] == 1}
    items = {**present, **alone, **present}
    return {name: items[name] for name in (present if names is None else select_names(path, names, items))}


def format_names(names: Sequence[str], most: int = 12) -> str:
    """Return names as a readable list."""
    if not names:
        return "no channels"
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(f'"{name}"' for name in names[:most]) + more


_TIME = re.compile(r"(time|zeit)(\s*\d+)?(\s+-\s.*)?", re.IGNORECASE)
_TIME_IN_TEXT = re.compile(
    r"((elapsed|relative?|rel\.?|absolute?|abs\.?|record(ing)?|sampl(e|ing)|mess|utc|local|system|trigger"
    r"|measure\w*|messung)[ _-]*)?"
    r"(times?|zeit|uhrzeit|clock|time[ _-]?stamps?|zeitstempel|date[ _/&-]*time|datum[ _/-]*(uhr)?zeit|temps|tiempo"
    r"|tempo)([ _-]*(\d+|rel|abs))?(\s+-\s.*)?|x[ _-]?(value|axis|achse)|seconds?|sekunden?",
    re.IGNORECASE,
)


def is_time(name: str, unit: str = "", *, text: bool = False) -> bool:
    """Return whether a channel or column is called `time`, `Zeit` or `t`.

    With `text` it may have any name that tables use for times.
    """
    name = name.strip().rpartition(" - ")[2] if text and " - time" in name.lower() else name.strip()
    if name in ("t", "T"):
        return time_unit(unit) or (name == "t" and not unit.strip())
    return (_TIME_IN_TEXT if text else _TIME).fullmatch(name) is not None


def time_unit(unit: str) -> bool:
    """Return whether a unit is one of short times."""
    return _BY_NAME.get(unit.strip().lower(), 60.0) < 60.0


def as_sample_array(path: Path, name: str, samples: object) -> FloatArray:
    """Return samples as float64 (S,), or raise `ValueError` with the channel's name."""
    array = np.asarray(samples)
    if array.ndim != 1 or array.dtype.kind not in "biuf":
        raise ValueError(
            f'{path}: channel "{name}": expected one row of real numbers, found {array.dtype} of shape {array.shape}'
        )
    if not len(array):
        raise ValueError(f'{path}: channel "{name}": expected samples, found none')
    return np.ascontiguousarray(array, dtype=np.float64)


# HDF5 files.


@contextmanager
def open_hdf5(path: Path, *, links: bool = False) -> Iterator[Any]:
    """Open an HDF5 file for reading; links to other files are refused unless `links`.

    Call `check_inside` and `check_stored` to verify that the samples of a dataset are in the file.
    """
    import h5py

    with h5py.File(path, "r") as file:
        if not links:
            check_links(path, file)
        yield file


def full_name(group: Any, name: bytes) -> str:
    """Return the full name in the file of an entry of an HDF5 group."""
    return f"{group.name}/{name.decode('utf-8', 'replace')}".lstrip("/")


def check_links(path: Path, group: Any, *, soft: bool = True) -> None:
    """Refuse links to other files below an HDF5 group; also soft links unless `soft`."""
    import h5py

    local_types = (h5py.h5l.TYPE_HARD, h5py.h5l.TYPE_SOFT)[: 1 + soft]

    def wrong(name: bytes, link: Any) -> str | None:
        if name.count(b"/") > MAX_NESTING:
            return f"groups in {MAX_NESTING} others"
        refusal = f'"{full_name(group, name)}": expected samples in this file, found a link to another'
        return None if link.type in local_types else refusal

    found = group.id.links.visit(wrong, info=True)
    if found is not None:
        raise ValueError(f"{path}: {found}")


def check_inside(path: Path, name: str, dataset: Any) -> None:
    """Refuse an HDF5 dataset with samples in other files; groups and arrays in memory pass."""
    if hasattr(dataset, "is_virtual") and (dataset.is_virtual or dataset.external):
        found = "a virtual one, made of others" if dataset.is_virtual else "one in other files (external storage)"
        raise ValueError(f'{path}: dataset "{name}": expected samples in this file, found {found}')
