"""HDF5: one 1-D dataset per channel, attributes `sample_rate`, optional `start_time`, `unit`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shaker.signals.files.common import checked_rate, chosen, numbers
from shaker.signals.recording import RawChannel


def read_hdf5(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read 1-D datasets (in groups too, as `group/name`); attributes of the file stand in for missing ones."""
    import h5py

    with h5py.File(path, "r") as file:
        found: list[str] = []

        def collect(name: str, node: Any) -> None:
            if isinstance(node, h5py.Dataset) and node.ndim == 1 and node.dtype.kind in "biuf":
                found.append(name)

        file.visititems(collect)
        return {name: _channel(path, file, name, sample_rate_hz) for name in chosen(path, names, found)}


def _channel(path: Path, file: Any, name: str, sample_rate_hz: float | None) -> RawChannel:
    """Read one dataset with its attributes."""
    dataset = file[name]
    attributes = {**file.attrs, **dataset.attrs}
    rate = attributes.get("sample_rate", sample_rate_hz)
    where = f'channel "{name}"'
    try:
        rate = None if rate is None else float(np.asarray(rate).reshape(()))
        start = float(np.asarray(attributes.get("start_time", 0.0)).reshape(()))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {where}: expected numbers in sample_rate and start_time, found {error}") from error
    unit = attributes.get("unit", "")
    unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    return RawChannel(numbers(path, name, dataset[()]), checked_rate(path, rate, where), start, unit)
