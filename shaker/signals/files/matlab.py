"""MATLAB files, versions 4 to 7.2 and 7.3 (HDF5 inside): one vector, table column or field of a struct per channel."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shaker.signals.files.common import checked_rate, chosen, rate_of_times
from shaker.signals.files.datasets import Column, columns_of, length_of, read_datasets
from shaker.signals.recording import RawChannel

_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_RATES, _STARTS, _UNITS = ("sample_rate", "fs", "Fs"), ("start_time",), ("unit", "units")
_TIMES = ("time", "Time", "t")


@dataclass(frozen=True)
class _Variables:
    """What a file holds, fields of structs as `struct.field`: arrays of numbers, texts, and what cannot be read."""

    arrays: dict[str, Any]
    texts: dict[str, str]
    others: dict[str, str]


def read_matlab(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read vectors by their names, fields of structs as `struct.field`, columns of a table (S, C) as `name/1`, ….

    The rate is a scalar `sample_rate` (or `fs`, `Fs`) beside the channel, else in the structs around it, else in the
    file; without it a vector `time` (or `t`; s, uniform) there of the channel's length counts, then `sample_rate_hz`.
    Texts `unit` (or `units`) and the scalar `start_time` are looked for in the same places. Cell arrays, arrays of
    structs and objects (among them `timeseries`) are refused by name.
    """
    if not _is_hdf5(path):
        return _channels(path, _classic(path, names), names, sample_rate_hz)
    import h5py

    with h5py.File(path, "r") as file:
        return _channels(path, _sorted(_hdf5_leaves("", file)), names, sample_rate_hz)


def _channels(
    path: Path, variables: _Variables, names: Sequence[str] | None, sample_rate_hz: float | None
) -> dict[str, RawChannel]:
    """Return the channels among the variables of a file."""
    arrays = variables.arrays
    columns: dict[str, Column] = {}
    for name, array in arrays.items():
        if array.size > 1:
            columns |= columns_of(name, array)
    for name in names or ():
        if name not in columns and name in variables.others:
            raise ValueError(f'{path}: channel "{name}": expected a vector of numbers, found {variables.others[name]}')
    wanted = chosen(path, names, columns if names is not None else [n for n in columns if not _is_clock(n)])
    rates = {name: _scalar(arrays, name, _RATES) for name in wanted}
    times = {name: _time_beside(arrays, name, columns) for name in wanted if rates[name] is None}
    needed = {*wanted, *(time for time in times.values() if time)}
    values = read_datasets(arrays, {name: columns[name] for name in needed})
    result = {}
    for name in wanted:
        rate, start, where = rates[name], _scalar(arrays, name, _STARTS) or 0.0, f'channel "{name}"'
        time = times.get(name)
        if time is not None:
            rate, start = rate_of_times(path, values[time], f'{where}: variable "{time}"')
        rate = checked_rate(path, sample_rate_hz if rate is None else rate, where)
        unit = next((variables.texts[key] for key in _beside(name, _UNITS) if key in variables.texts), "")
        result[name] = RawChannel(values[name], rate, start, unit)
    return result


def _beside(name: str, keys: Sequence[str]) -> Iterator[str]:
    """Yield the names that keys have beside a channel, in the structs around it, and in the file."""
    struct = name.rpartition("/")[0] or name
    while struct:
        struct = struct.rpartition(".")[0]
        yield from (f"{struct}.{key}" if struct else key for key in keys)


def _is_clock(name: str) -> bool:
    """Tell whether a variable holds times."""
    return name.rpartition(".")[2] in _TIMES


def _scalar(arrays: Mapping[str, Any], name: str, keys: Sequence[str]) -> float | None:
    """Return the number that stands beside a channel under one of the keys, None where there is none."""
    for key in _beside(name, keys):
        if key in arrays and arrays[key].size == 1:
            return float(np.asarray(arrays[key][()]).reshape(()))
    return None


def _time_beside(arrays: Mapping[str, Any], name: str, columns: Mapping[str, Column]) -> str | None:
    """Return the vector of times beside a channel that has its length."""
    length = length_of(arrays[columns[name].dataset], columns[name])
    for other in _beside(name, _TIMES):
        if other in columns and other != name and length_of(arrays[other], columns[other]) == length:
            return other
    return None


def _is_hdf5(path: Path) -> bool:
    """Tell whether the file is version 7.3: HDF5 behind a user block of 512 bytes (or none)."""
    with path.open("rb") as file:
        head = file.read(520)
    return head[:8] == _HDF5_SIGNATURE or head[512:520] == _HDF5_SIGNATURE


def _sorted(leaves: Iterator[tuple[str, Any]]) -> _Variables:
    """Sort what a file holds: numbers, texts, and descriptions (in a tuple) of what cannot be read."""
    variables = _Variables({}, {}, {})
    for name, leaf in leaves:
        if isinstance(leaf, str):
            variables.texts[name] = leaf
        elif isinstance(leaf, tuple):
            variables.others[name] = leaf[0]
        else:
            variables.arrays[name] = leaf
    return variables


def _hdf5_leaves(prefix: str, group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the variables of a version 7.3 file; arrays stay in the file."""
    for key, node in group.items():
        if key.startswith("#"):
            continue
        name, kind = prefix + key, bytes(node.attrs.get("MATLAB_class", b"")).decode()
        if hasattr(node, "items"):
            yield from _hdf5_leaves(f"{name}.", node)
        elif kind == "cell" or node.dtype.kind == "O":
            yield name, ("a cell array" if kind == "cell" else "an array of structs or an object",)
        elif "MATLAB_empty" in node.attrs:
            yield name, ("an empty array",)
        elif kind == "char":
            yield name, "".join(map(chr, np.asarray(node[()]).ravel()))
        elif kind == "string" or node.attrs.get("MATLAB_object_decode"):
            yield name, ("a MATLAB object",)
        else:
            yield name, node if node.dtype.kind in "biuf" else ("complex numbers",)


def _classic(path: Path, names: Sequence[str] | None) -> _Variables:
    """Return the variables of an older file, where only some channels are asked for those that matter to them."""
    from scipy.io import loadmat, whosmat

    roots = None
    if names is not None:
        roots = {re.split("[./]", name)[0] for name in names}
        if roots <= {name for name, *_ in whosmat(str(path))}:
            roots |= {*_RATES, *_STARTS, *_UNITS, *_TIMES}
        else:
            roots = None  # a name is wrong: all of them stand in the message
    content = loadmat(str(path), variable_names=roots)
    return _sorted(leaf for name, value in content.items() for leaf in _classic_leaves(name, value))


def _classic_leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield a variable of an older file, of a struct its fields."""
    if name.startswith("__") or not isinstance(value, np.ndarray):
        return
    if type(value).__name__ in ("MatlabOpaque", "MatlabFunction", "MatlabObject"):
        yield name, ("a MATLAB object",)
    elif value.dtype.names:
        if value.size != 1:
            yield name, (f"an array of {value.size} structs",)
            return
        for field in value.dtype.names:
            yield from _classic_leaves(f"{name}.{field}", value[field].reshape(-1)[0])
    elif value.dtype.kind == "O":
        yield name, ("a cell array",)
    elif value.dtype.kind in "US":
        yield name, "".join(map(str, value.ravel()[:1]))
    elif value.dtype.kind in "biuf" and value.size:
        yield name, value
    else:
        yield name, ("complex numbers" if value.size else "an empty array",)
