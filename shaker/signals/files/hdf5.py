"""HDF5: one dataset per channel with attributes `sample_rate`, optional `start_time`, `unit`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shaker.signals.files.common import checked_rate, chosen, is_time, rate_of_times
from shaker.signals.files.datasets import Column, columns_of, length_of, read_datasets
from shaker.signals.recording import RawChannel

_RATES = ("sample_rate", "sampling_rate", "sampling_frequency", "fs")
_STARTS = ("start_time",)
_UNITS = ("unit", "units")


def read_hdf5(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read channels by the names of their datasets, in groups as `group/name`.

    A table (S, C) or (C, S) has the channels `name/1`, `name/2`, …, a dataset of records one channel `name/field` per
    field of numbers. The rate is the attribute `sample_rate` (or `sampling_rate`, `sampling_frequency`, `fs`) of the
    dataset, else of the groups around it, else of the file; without it a dataset or field `time` (s, uniform) beside
    the channel and of its length counts, then `sample_rate_hz`. `unit` (or `units`) and `start_time` are looked for
    in the same places. Memory: the result and one block.
    """
    import h5py

    with h5py.File(path, "r") as file:
        columns: dict[str, Column] = {}

        def collect(name: str, node: Any) -> None:
            if isinstance(node, h5py.Dataset):
                columns.update(columns_of(name, node))

        file.visititems(collect)
        present = columns if names is not None else [name for name in columns if not is_time(name.rsplit("/", 1)[-1])]
        wanted = chosen(path, names, present)
        rates = {name: _attribute(file, columns[name].dataset, _RATES) for name in wanted}
        times = {name: _time_beside(file, name, columns) for name in wanted if rates[name] is None}
        needed = {*wanted, *(time for time in times.values() if time)}
        values = read_datasets(file, {name: columns[name] for name in needed})
        result = {}
        for name in wanted:
            index, dataset, where = columns[name].index, columns[name].dataset, f'channel "{name}"'
            rate = _number(path, where, rates[name], index)
            start = _number(path, where, _attribute(file, dataset, _STARTS), index) or 0.0
            time = times.get(name)
            if time is not None:
                rate, start = rate_of_times(path, values[time], f'{where}: dataset "{time}"')
            rate = checked_rate(path, sample_rate_hz if rate is None else rate, where)
            result[name] = RawChannel(values[name], rate, start, _text(_attribute(file, dataset, _UNITS), index))
    return result


def _attribute(file: Any, name: str, keys: Sequence[str]) -> Any:
    """Return an attribute of a dataset, else of the groups around it, else of the file; None where there is none."""
    node = file[name]
    while True:
        for key in keys:
            if key in node.attrs:
                return node.attrs[key]
        if node.name == "/":
            return None
        node = node.parent


def _time_beside(file: Any, name: str, columns: Mapping[str, Column]) -> str | None:
    """Return the dataset or field `time` beside a channel (or beside its table) and of its length."""
    group = name.rpartition("/")[0]
    length = length_of(file[columns[name].dataset], columns[name])
    for other, column in columns.items():
        parent, _, tail = other.rpartition("/")
        beside = parent in (group, group.rpartition("/")[0])
        if beside and is_time(tail) and length_of(file[column.dataset], column) == length:
            return other
    return None


def _number(path: Path, where: str, value: Any, index: int | None) -> float | None:
    """Return an attribute's number (one for all columns of a table, or one each), None where there is none."""
    if value is None:
        return None
    try:
        values = np.asarray(value, dtype=np.float64).reshape(-1)
        return float(values[index] if index is not None and len(values) > 1 else values.reshape(())[()])
    except (TypeError, ValueError, IndexError) as error:
        raise ValueError(f"{path}: {where}: expected numbers in sample_rate and start_time, found {value!r}") from error


def _text(value: Any, index: int | None) -> str:
    """Return an attribute's text, of several that of a table's column; empty where there is none."""
    if value is None:
        return ""
    values = np.asarray(value, dtype=object).reshape(-1)
    own = values[index if index is not None and index < len(values) else 0] if len(values) else ""
    return own.decode("utf-8", "replace") if isinstance(own, bytes) else str(own)
