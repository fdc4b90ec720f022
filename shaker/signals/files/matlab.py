"""MATLAB files: one vector per channel; the sampling rate stands in the manifest or in a variable `sample_rate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shaker.signals.files.common import checked_rate, chosen, numbers
from shaker.signals.recording import RawChannel

_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_RATE, _START = "sample_rate", "start_time"


def read_matlab(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read vectors of a .mat file, versions 4 to 7.2 and 7.3 (HDF5 inside); row and column vectors alike."""
    variables = _hdf5_variables(path) if _is_hdf5(path) else _classic_variables(path)
    scalars = {name: value for name, value in variables.items() if value.size == 1}
    vectors = {
        name: value.reshape(-1)
        for name, value in variables.items()
        if value.size > 1 and value.size == max(value.shape) and value.dtype.kind in "biuf"
    }
    wanted = chosen(path, names, vectors)
    rate = float(scalars[_RATE].reshape(())) if _RATE in scalars else sample_rate_hz
    start = float(scalars[_START].reshape(())) if _START in scalars else 0.0
    return {
        name: RawChannel(numbers(path, name, vectors[name]), checked_rate(path, rate, f'channel "{name}"'), start, "")
        for name in wanted
    }


def _is_hdf5(path: Path) -> bool:
    """Tell whether the file is version 7.3: HDF5 behind a user block of 512 bytes (or none)."""
    with path.open("rb") as file:
        head = file.read(520)
    return head[:8] == _HDF5_SIGNATURE or head[512:520] == _HDF5_SIGNATURE


def _hdf5_variables(path: Path) -> dict[str, Any]:
    """Return the numeric arrays of a version 7.3 file."""
    import h5py

    with h5py.File(path, "r") as file:
        return {
            name: np.asarray(node[()])
            for name, node in file.items()
            if isinstance(node, h5py.Dataset) and node.dtype.kind in "biuf"
        }


def _classic_variables(path: Path) -> dict[str, Any]:
    """Return the numeric arrays of an older file."""
    from scipy.io import loadmat

    content = loadmat(str(path))
    return {
        name: value
        for name, value in content.items()
        if not name.startswith("__") and isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    }
