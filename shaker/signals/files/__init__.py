"""Reading recorded channels from the files that laboratories have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from shaker.signals.files.common import reading
from shaker.signals.files.hdf5 import read_hdf5
from shaker.signals.files.labview import read_labview
from shaker.signals.files.matlab import read_matlab
from shaker.signals.files.scan import Scan, read_scan_asc, read_scan_channels
from shaker.signals.files.table import read_table, read_table_columns, table_units
from shaker.signals.files.tdms import read_tdms
from shaker.signals.files.universal import UniversalFunction, read_universal, read_universal_functions
from shaker.signals.files.universal_shapes import UniversalShape, read_universal_shapes
from shaker.signals.files.wave import read_wave
from shaker.signals.recording import RawChannel

__all__ = [
    "SUFFIXES",
    "Scan",
    "UniversalFunction",
    "UniversalShape",
    "read_channels",
    "read_scan_asc",
    "read_table_columns",
    "read_universal_functions",
    "read_universal_shapes",
    "table_units",
]

_Reader = Callable[[Path, Sequence[str] | None, float | None], dict[str, RawChannel]]

_READERS: dict[str, _Reader] = {
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".tdms": read_tdms,
    ".uff": read_universal,
    ".unv": read_universal,
    ".mat": read_matlab,
    ".csv": read_table,
    ".wav": read_wave,
    ".lvm": read_labview,
    ".asc": read_scan_channels,
}
SUFFIXES = tuple(_READERS)


def read_channels(
    path: Path, names: Sequence[str] | None = None, sample_rate_hz: float | None = None
) -> dict[str, RawChannel]:
    """Read the named channels (None: all) of a file, by its suffix.

    `sample_rate_hz` serves files that state no rate of their own. NaN is handed on. Anything wrong raises `OSError`
    or `ValueError` with one sentence that begins with the file's path.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: expected a file of type {' '.join(SUFFIXES)}, found {path.suffix or 'no suffix'}")
    with reading(path):
        return reader(path, names, sample_rate_hz)
