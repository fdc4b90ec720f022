"""Channels in arrays of numbers, in memory or in an HDF5 file: vectors, tables, records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from shaker._checks import FloatArray
from shaker.signals.files.common import BLOCK

_NUMBERS = "biuf"
_SLENDER = 4  # a table has at least that many times more samples than channels; others are pictures or matrices


@dataclass(frozen=True)
class Column:
    """Where a channel's samples stand: along `axis` of a dataset, at `index` of the other axis, or in a `field`."""

    dataset: str
    axis: int = 0
    index: int | None = None
    field: str | None = None


def columns_of(name: str, dataset: Any) -> dict[str, Column]:
    """Return the channels of a dataset by name, none where it holds no series of numbers.

    A table (S, C) or (C, S) has the channels `name/1`, `name/2`, … across its longer side, a dataset of records
    `name/field`; a vector, and a table of one row or column, is one channel.
    """
    if dataset.shape is None or dataset.size < 1 or dataset.ndim > 2:
        return {}
    if dataset.dtype.names and dataset.ndim == 1:
        fields = [field for field in dataset.dtype.names if dataset.dtype[field].kind in _NUMBERS]
        return {f"{name}/{field}": Column(name, field=field) for field in fields}
    if dataset.dtype.kind in _NUMBERS and dataset.ndim == 1:
        return {name: Column(name)}
    count, length = min(dataset.shape, default=0), max(dataset.shape, default=0)
    if dataset.dtype.kind not in _NUMBERS or length == count or (count > 1 and length < _SLENDER * count):
        return {}
    axis = dataset.shape.index(length)
    return {f"{name}/{i + 1}" if count > 1 else name: Column(name, axis, i) for i in range(count)}


def length_of(dataset: Any, column: Column) -> int:
    """Return the number of samples of a channel."""
    return int(dataset.shape[column.axis])


def read_datasets(datasets: Mapping[str, Any], wanted: Mapping[str, Column]) -> dict[str, FloatArray]:
    """Return the samples (S,) of channels by name; each dataset is read once, in blocks of whole chunks."""
    result: dict[str, FloatArray] = {}
    for name in dict.fromkeys(column.dataset for column in wanted.values()):
        own = {key: column for key, column in wanted.items() if column.dataset == name}
        result |= dict(zip(own, _read(datasets[name], list(own.values())), strict=True))
    return result


def _read(dataset: Any, columns: Sequence[Column]) -> list[FloatArray]:
    """Return the samples of the columns of one dataset."""
    axis = columns[0].axis
    length = dataset.shape[axis]
    results = [np.empty(length) for _ in columns]
    chunks = getattr(dataset, "chunks", None)
    chunk = chunks[axis] if chunks else 1
    item = dataset.dtype.itemsize * dataset.size // length
    rows = max(chunk, BLOCK // item // chunk * chunk)
    for first in range(0, length, rows):
        part = slice(first, min(first + rows, length))
        block = np.asarray(dataset[part] if axis == 0 else dataset[:, part])
        for result, column in zip(results, columns, strict=True):
            result[part] = _taken(block, column)
    return results


def _taken(block: np.ndarray[Any, Any], column: Column) -> np.ndarray[Any, Any]:
    """Return a channel's part of a block."""
    if column.field is not None:
        return block[column.field]
    if column.index is None:
        return block
    return block[:, column.index] if column.axis == 0 else block[column.index]
