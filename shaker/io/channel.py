"""Raw channels, and functions that the readers of all formats share."""

from __future__ import annotations

import math
import stat
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from shaker.io.times import SampleTimes, first_gap
from shakercal._common.arrays import FloatArray, check_shape

T = TypeVar("T")


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
        return first_gap(SampleTimes(self.sample_rate_hz, self.start_s, self.stamp_s))

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
    """Return the most sample bytes in a file of this length; compression makes samples up to 100 times smaller."""
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
    """Return the items of the requested names (None: all); a unique `short` name is accepted too."""
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


def is_time(name: str) -> bool:
    """Return whether a channel or column is called `time`, in upper or lower case."""
    return name.strip().lower() == "time"


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


# Channels in arrays of numbers, in memory or in an HDF5 file: vectors, tables, records.

_NUMBERS = "biuf"
_SLENDER = 4  # a table has at least that many times more samples than channels; others are pictures or matrices


@dataclass(frozen=True)
class DatasetColumn:
    """Position of a channel's `length` samples in a dataset: along `axis` at `index` across it, or in a `field`."""

    dataset: str
    length: int
    axis: int = 0
    index: int | None = None
    field: str | None = None


def columns_of(name: str, dataset: Any) -> dict[str, DatasetColumn]:
    """Return the channels of a dataset by name, empty where it contains no numeric series.

    A table (S, C) or (C, S) has the channels `name/1`, `name/2`, … across its longer side, a dataset of records
    `name/field`. A vector is one channel, and so is a table of one row or column.
    """
    if getattr(dataset, "shape", None) is None or dataset.size < 1 or dataset.ndim > 2:
        return {}
    if dataset.dtype.names and dataset.ndim == 1:
        fields = [field for field in dataset.dtype.names if dataset.dtype[field].kind in _NUMBERS]
        return {f"{name}/{field}": DatasetColumn(name, dataset.size, field=field) for field in fields}
    if dataset.dtype.kind in _NUMBERS and dataset.ndim == 1:
        return {name: DatasetColumn(name, dataset.size)}
    count, length = min(dataset.shape, default=0), max(dataset.shape, default=0)
    if dataset.dtype.kind not in _NUMBERS or length == count or (count > 1 and length < _SLENDER * count):
        return {}
    if count > MOST_CHANNELS:
        return {}
    axis = dataset.shape.index(length)
    return {f"{name}/{i + 1}" if count > 1 else name: DatasetColumn(name, length, axis, i) for i in range(count)}


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


def check_stored(path: Path, name: str, dataset: Any) -> None:
    """Refuse an HDF5 dataset without samples in its file; arrays in memory pass."""
    if not hasattr(dataset, "is_virtual"):
        return  # an array in memory
    check_inside(path, name, dataset)
    if dataset.size and not dataset.id.get_storage_size():
        raise ValueError(f'{path}: dataset "{name}": expected stored samples, found none')
    if dataset.chunks:
        check_size(path, f'dataset "{name}", a chunk', math.prod(dataset.chunks) * dataset.dtype.itemsize)


def read_datasets(
    path: Path, datasets: Mapping[str, Any], requested: Mapping[str, DatasetColumn], exact: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """Return the samples (S,) of channels as float64, of `exact` names as stored; blocks of whole chunks are read."""
    total = 0
    for name in {column.dataset for column in requested.values()}:
        check_stored(path, name, datasets[name])
    for name, column in requested.items():
        total += 8 * column.length
        check_size(path, f'channel "{name}"', total)
    results: dict[str, NDArray[Any]] = {}
    for name in dict.fromkeys(column.dataset for column in requested.values()):
        columns = {key: column for key, column in requested.items() if column.dataset == name}
        dataset, first_column = datasets[name], next(iter(columns.values()))
        length, axis = first_column.length, first_column.axis
        for key, column in columns.items():
            stored = dataset.dtype if column.field is None else dataset.dtype[column.field]
            results[key] = np.empty(length, stored.newbyteorder("=") if key in exact else np.float64)
        chunks = getattr(dataset, "chunks", None)
        chunk = chunks[axis] if chunks else 1
        item = dataset.dtype.itemsize * dataset.size // length
        rows = max(chunk, BLOCK // item // chunk * chunk)
        for first in range(0, length, rows):
            part = slice(first, min(first + rows, length))
            block = np.asarray(dataset[part] if axis == 0 else dataset[:, part])
            for key, column in columns.items():
                if column.field is not None:
                    results[key][part] = block[column.field]
                elif column.index is None:
                    results[key][part] = block
                else:
                    results[key][part] = block[:, column.index] if axis == 0 else block[column.index]
    return results
