"""HDF5, MATLAB and WAVE files."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shaker.io.channel import (
    BLOCK,
    MAX_NESTING,
    MOST_CHANNELS,
    RawChannel,
    SampleTimes,
    agreed_rate,
    as_sample_array,
    check_inside,
    check_size,
    is_time,
    max_sample_bytes,
    open_hdf5,
    select_names,
    times_of_stamps,
)
from shakercal._common.arrays import FloatArray
from shakercal._common.mat5 import check_mat5, load_mat

# Names of rates and of intervals, in small letters without marks; structs such as `x_values.increment` in one word.
_RATES = ("samplerate", "samplingrate", "samplingfrequency", "samplefrequency", "fs")
_INTERVALS = ("dt", "tinterval", "sampleinterval", "samplinginterval", "wfincrement", "timestep", "xvaluesincrement")
_STARTS, _UNITS = ("start_time",), ("unit", "units", "unit_string")
_TIMES = ("time", "Time", "t")
_TIME_UNITS = ("time_unit", "time_units")
# Units of times that state none, by the rate.
_ASSUMED_UNITS, _UNIT_TOLERANCE = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}, 0.01
_CF_PACKING = ("scale_factor", "add_offset", "_FillValue")
_NWB_PACKING = ("conversion", "offset", "_FillValue")
_LONGEST_TEXT = 1 << 20  # letters
_MOST_ARRAYS = 250_000  # of a MATLAB file


# Channels in arrays of numbers, in memory or in an HDF5 file: vectors, tables, records.

_NUMBERS = "biuf"
_SLENDER = 4  # a table has at least that many times more samples than channels; others are pictures or matrices


@dataclass(frozen=True)
class DatasetColumn:
    """Position of a channel's `length` samples: along `axis` at `index`, or in a `field`."""

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
    """Return the samples of channels as float64, those of `exact` names as stored."""
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


# Channels with the statements of their file.


@dataclass(frozen=True)
class _Packing:
    """How stored numbers are packed: factor, addend, and the number of a missing sample."""

    factor: float
    addend: float
    missing: float | None

    def unpacked(self, stored: NDArray[Any]) -> FloatArray:
        """Return the samples of stored numbers, NaN where a sample is missing."""
        values = np.multiply(stored, self.factor, dtype=np.float64) + self.addend
        return values if self.missing is None else np.where(stored == self.missing, np.nan, values)


@dataclass(frozen=True)
class _Stated:
    """Statements of a file about a channel; `times` names the vector of its times."""

    rate: float | None
    start: float | None
    unit: str
    times: str | None
    time_unit: str = ""
    packing: _Packing | None = None
    time_packing: _Packing | None = None


def _build_channels(
    path: Path,
    datasets: Mapping[str, Any],
    columns: Mapping[str, DatasetColumn],
    requested: Mapping[str, _Stated],
    sample_rate_hz: float | None,
) -> dict[str, RawChannel]:
    """Return the requested channels with times from the file or the given rate."""
    times = {stated.times for stated in requested.values() if stated.times}
    values = read_datasets(path, datasets, {name: columns[name] for name in {*requested, *times}}, times)
    result = {}
    for name, stated in requested.items():
        stamps = None if stated.times is None else values[stated.times]
        samples = values[name] if stated.packing is None else stated.packing.unpacked(values[name])
        sampled = _sample_times(path, f'channel "{name}"', stated, stamps, sample_rate_hz)
        result[name] = RawChannel.from_times(sampled, as_sample_array(path, name, samples), stated.unit)
    return result


def _sample_times(
    path: Path, where: str, stated: _Stated, stamps: NDArray[Any] | None, given_hz: float | None
) -> SampleTimes:
    """Return the times of a channel's samples.

    Rate and vector of times must agree where a file states both. The vector shows gaps; the rate has more digits.
    """
    if stamps is None:
        return SampleTimes(agreed_rate(path, where, stated.rate, given_hz), stated.start or 0.0)
    rate = None if stated.rate is None else agreed_rate(path, where, stated.rate, given_hz)
    where, unit = f'{where}: times in "{stated.times}"', stated.time_unit
    if stated.time_packing is not None:
        stamps = stated.time_packing.unpacked(stamps)
    if rate is not None and not unit and len(stamps) > 1:
        step = float(np.median(np.diff(stamps)))
        unit = next(
            (name for name, factor in _ASSUMED_UNITS.items() if abs(step * factor * rate - 1.0) < _UNIT_TOLERANCE), ""
        )
        if step == 1.0 and not unit:  # numbers of samples
            stamps, unit = stamps / rate, "s"
    found = times_of_stamps(path, where, stamps, unit, given_hz=given_hz if rate is None else rate)
    if rate is None or found.stamp_s is not None:
        return found
    return SampleTimes(rate, found.start_s if stated.start is None else stated.start)


def read_hdf5(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read channels by the names of their datasets, in groups as `group/name`.

    A table (S, C) or (C, S) has the channels `name/1`, `name/2`, …, a dataset of records `name/field`. Rate
    (`sample_rate`, `sampling_rate`, `sampling_frequency`, `fs`), `unit` and `start_time` are attributes of the dataset,
    of the groups around it, or of the file. A dataset or field `time` next to the channel and as long contains the
    times, in s or its `units`. Packed numbers are unpacked by CF or NWB conventions. Memory: the result and one block.
    """
    import h5py

    with open_hdf5(path, links=True) as file:
        columns: dict[str, DatasetColumn] = {}

        def add(name: str, node: Any) -> None:
            if name.count("/") > MAX_NESTING:
                raise ValueError(f"groups in {MAX_NESTING} others")
            columns.update(columns_of(name, node))

        file.visititems(add)  # follows no links
        for name in names or ():
            if name not in columns and isinstance(file.get(name, getlink=True), h5py.ExternalLink):
                raise ValueError(f'{path}: channel "{name}": expected samples in this file, found a link to another')
        present = columns if names is not None else [name for name in columns if not is_time(name.rsplit("/", 1)[-1])]
        requested = {}
        for name in select_names(path, names, present):
            node, index, where = file[columns[name].dataset], columns[name].index, f'{path}: channel "{name}"'
            stated_rate, start = (_number(where, _attribute(node, keys), index) for keys in (_RATES, _STARTS))
            interval = _number(where, _attribute(node, _INTERVALS), index)
            rate = 1.0 / interval if stated_rate is None and interval else stated_rate
            times = _neighbouring_time(name, columns)
            if times is not None and _holder(node, _RATES).name.rstrip("/").count("/") < times.count("/"):
                rate = None  # stated for a group around that of the times
            unit = _one_text(_attribute(node, _UNITS, ""), index)
            packings, time_unit = [_packing(where, node, index), None], ""
            if times is not None:
                dated = file[columns[times].dataset]
                packings[1] = _packing(where, dated, columns[times].index)
                time_unit = _one_text(next((dated.attrs[key] for key in _UNITS if key in dated.attrs), ""), None)
            requested[name] = _Stated(rate, start, unit, times, time_unit, *packings)
        return _build_channels(path, file, columns, requested, sample_rate_hz)


def _attribute(node: Any, keys: Sequence[str], default: Any = None) -> Any:
    """Return an attribute of a dataset, of the groups around it, or of the file."""
    attributes = {_plain(key): value for key, value in _holder(node, keys).attrs.items()}
    return next((attributes[_plain(key)] for key in keys if _plain(key) in attributes), default)


def _holder(node: Any, keys: Sequence[str]) -> Any:
    """Return the dataset, nearest group or file that has one of the attributes."""
    plain_keys = {_plain(key) for key in keys}
    while node.name != "/" and not any(_plain(key) in plain_keys for key in node.attrs):
        node = node.parent
    return node


def _plain(key: str) -> str:
    """Return a key in small letters and digits, so that `Sample_Rate` is `samplerate`."""
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _one_text(value: Any, index: int | None) -> str:
    """Return a text; of several texts that of one column."""
    texts = np.asarray(value, dtype=object).reshape(-1)
    text = texts[index if index is not None and index < len(texts) else 0] if len(texts) else ""
    return text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)


def _packing(where: str, node: Any, index: int | None) -> _Packing | None:
    """Return the packing of a dataset's numbers, None where they are samples."""
    keys = _NWB_PACKING if "conversion" in node.attrs else _CF_PACKING
    if not any(key in node.attrs for key in keys):
        return None
    factor, addend, missing = (_number(where, node.attrs.get(key), index) for key in keys)
    return _Packing(1.0 if factor is None else factor, addend or 0.0, missing)


def _neighbouring_time(name: str, columns: Mapping[str, DatasetColumn]) -> str | None:
    """Return the `time` next to a channel or its table, of equal length."""
    group = name.rpartition("/")[0]
    for other, column in columns.items():
        parent, _, tail = other.rpartition("/")
        neighbouring = parent in (group, group.rpartition("/")[0])
        if neighbouring and is_time(tail) and column.length == columns[name].length:
            return other
    return None


def _number(where: str, value: Any, index: int | None) -> float | None:
    """Return an attribute's number for one column of a table; None where there is none."""
    if value is None:
        return None
    try:
        values = np.asarray(value, dtype=np.float64).reshape(-1)
        return float(values[index] if index is not None and len(values) > 1 else values.reshape(())[()])
    except (TypeError, ValueError, IndexError) as error:
        raise ValueError(f"{where}: expected a number in its attributes, found {value!r}") from error


# MATLAB files, versions 4 to 7.2 and 7.3 (HDF5 inside): one vector, table column or field of a struct per channel.


_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


class _Unreadable(str):
    """Description of a variable that cannot be read, used instead of its values."""


def read_matlab(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read vectors by name, fields as `struct.field`, and table columns as `name/1`, ….

    Scalars `sample_rate` (or `fs`, `Fs`) and `start_time` and texts `unit` are those next to the channel, in the
    structs around it, or in the file, and so is a vector `time` (or `t`) of the channel's length, in s or its
    `time_unit`. Cell arrays, arrays of structs and objects (also `timeseries`) are refused by name.
    """
    with path.open("rb") as stream:
        head = stream.read(520)
    # Version 7.3 is HDF5 behind a user block of 512 bytes (or none).
    if _HDF5_SIGNATURE not in (head[:8], head[512:]):
        return _channels(path, _classic(path, names), names, sample_rate_hz)
    with open_hdf5(path) as file:
        return _channels(path, dict(_hdf5_leaves("", file)), names, sample_rate_hz)


def _channels(
    path: Path, variables: Mapping[str, Any], names: Sequence[str] | None, sample_rate_hz: float | None
) -> dict[str, RawChannel]:
    """Return the channels among a file's variables: arrays, texts and `_Unreadable` ones."""
    columns: dict[str, DatasetColumn] = {}
    for name, variable in variables.items():
        if not isinstance(variable, str) and variable.size > 1:
            columns |= columns_of(name, variable)
    for name in names or ():
        if name not in columns and isinstance(kind := variables.get(name), _Unreadable):
            raise ValueError(f'{path}: channel "{name}": expected a vector of numbers, found {kind}')
    present = columns if names is not None else [n for n in columns if n.rpartition(".")[2] not in _TIMES]
    scalars = _scalars(variables)
    requested = {}
    for name in select_names(path, names, present):
        (rate_key, rate), (_, start) = (_find_scalar(path, scalars, name, keys) for keys in (_RATES, _STARTS))
        if rate is None:
            rate_key, interval = _find_scalar(path, scalars, name, _INTERVALS)
            rate = 1.0 / interval if interval else None
        near = [columns[other] for other in _neighbouring_keys(name, _TIMES) if other in columns and other != name]
        times = next((column.dataset for column in near if column.length == columns[name].length), None)
        units = (variables.get(key) for key in _neighbouring_keys(name, (*_UNITS, "quantity.label")))
        unit = next((text for text in units if type(text) is str), "")
        texts = (variables.get(key) for key in _neighbouring_keys(name, _TIME_UNITS))
        time_unit = next((text for text in texts if type(text) is str), "")
        if times is not None and rate_key.count(".") < times.count("."):
            rate = None  # stated for a struct around that of the times
        requested[name] = _Stated(rate, start, unit, times, time_unit)
    return _build_channels(path, variables, columns, requested, sample_rate_hz)


def _neighbouring_keys(name: str, keys: Sequence[str]) -> Iterator[str]:
    """Yield full names of keys next to a channel and in all enclosing levels."""
    struct = name.rpartition("/")[0] or name
    while struct:
        struct = struct.rpartition(".")[0]
        yield from (f"{struct}.{key}" if struct else key for key in keys)


def _scalars(variables: Mapping[str, Any]) -> dict[str, tuple[str, Any]]:
    """Return the scalars by plain names; those of structs also a level higher."""
    found: dict[str, tuple[str, Any]] = {}
    for name, variable in variables.items():
        if not isinstance(variable, str) and getattr(variable, "size", 0) == 1:
            *levels, key = name.split(".")
            for depth in (len(levels), len(levels) - 1) if levels else (0,):
                plain = ".".join((*levels[:depth], _plain("".join((*levels[depth:], key)))))
                found.setdefault(plain, (name, variable))
    return found


def _find_scalar(
    path: Path, scalars: Mapping[str, tuple[str, Any]], name: str, keys: Sequence[str]
) -> tuple[str, float | None]:
    """Return name and value of the first scalar among the keys, else None."""
    for key in _neighbouring_keys(name, [_plain(key) for key in keys]):
        if key in scalars:
            full, variable = scalars[key]
            check_stored(path, full, variable)
            return full, float(np.asarray(variable).reshape(()))
    return "", None


def _hdf5_leaves(prefix: str, group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the variables of a version 7.3 file; arrays stay in the file."""
    if prefix.count(".") > MAX_NESTING:
        raise ValueError(f"structs in {MAX_NESTING} others")
    for key, node in group.items():
        if key.startswith("#"):
            continue
        name, kind = prefix + key, bytes(node.attrs.get("MATLAB_class", b"")).decode()
        if hasattr(node, "items"):
            yield from _hdf5_leaves(f"{name}.", node)
        elif kind == "cell" or node.dtype.kind == "O":
            yield name, _Unreadable("a cell array" if kind == "cell" else "an array of structs or an object")
        elif "MATLAB_empty" in node.attrs:
            yield name, _Unreadable("an empty array")
        elif kind == "char" and node.size > _LONGEST_TEXT:
            yield name, _Unreadable(f"a text of {node.size} letters")
        elif kind == "char":
            check_stored(Path(node.file.filename), name, node)
            yield name, "".join(map(chr, np.asarray(node[()]).ravel()))
        elif kind == "string" or node.attrs.get("MATLAB_object_decode"):
            yield name, _Unreadable("a MATLAB object")
        else:
            yield name, node if node.dtype.kind in "biuf" else _Unreadable("complex numbers")


def _classic(path: Path, names: Sequence[str] | None) -> dict[str, Any]:
    """Return the variables of an older file; for requested channels only the relevant ones."""
    from scipy.io import whosmat

    check_mat5(path, max_sample_bytes(path), _MOST_ARRAYS)
    roots = None
    if names is not None:
        roots = {re.split("[./]", name)[0] for name in names}
        if roots <= {name for name, *_ in whosmat(str(path))}:
            known = {*_UNITS, *_TIMES, *_TIME_UNITS}
            scalars = {_plain(key) for key in (*_RATES, *_INTERVALS, *_STARTS)}
            roots |= {name for name, *_ in whosmat(str(path)) if name in known or _plain(name) in scalars}
        else:
            roots = None  # a name is wrong: the message lists all of them
    content = load_mat(path, variable_names=roots)
    return dict(leaf for name, value in content.items() for leaf in _classic_leaves(name, value))


def _classic_leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield a variable of an older file, or the fields of a struct."""
    if name.startswith("__") or not isinstance(value, np.ndarray):
        return
    if type(value).__name__ in ("MatlabOpaque", "MatlabFunction", "MatlabObject"):
        yield name, _Unreadable("a MATLAB object")
    elif value.dtype.names and value.size != 1:
        yield name, _Unreadable(f"an array of {value.size} structs")
    elif value.dtype.names:
        for field in value.dtype.names:
            yield from _classic_leaves(f"{name}.{field}", value[field].reshape(-1)[0])
    elif value.dtype.kind == "O":
        yield name, _Unreadable("a cell array")
    elif value.dtype.kind in "US":
        yield name, "".join(map(str, value.ravel()[:1]))
    elif value.dtype.kind in "biuf" and value.size:
        yield name, value
    else:
        yield name, _Unreadable("complex numbers" if value.size else "an empty array")


# WAV files, their channels called by number.


def read_wave(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read channels by their number, counted from 1, without scaling.

    Integers and floats keep their values; 24 bits are the upper bytes of 32 (times 256), and 8 bits range from 0 to
    255. RIFF, RIFX and RF64 files are read. `sample_rate_hz` must not contradict the file.
    """
    from scipy.io import wavfile

    with warnings.catch_warnings():
        # Chunks with remarks of the recorder are skipped; a record shorter than stated is refused.
        warnings.simplefilter("ignore", wavfile.WavFileWarning)
        warnings.filterwarnings("error", message="Reached EOF", category=wavfile.WavFileWarning)
        try:
            with path.open("rb") as file:
                rate, samples = wavfile.read(file)
        except wavfile.WavFileWarning as error:
            raise ValueError(f"{path}: expected a complete WAV file, found its end too early") from error
    columns = samples.reshape(len(samples), -1)
    requested = select_names(path, names, [str(i + 1) for i in range(columns.shape[1])])
    rate_hz = agreed_rate(path, "the record", float(rate), sample_rate_hz)
    return {name: RawChannel(as_sample_array(path, name, columns[:, int(name) - 1]), rate_hz) for name in requested}
