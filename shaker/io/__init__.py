"""Channels of any file that a data acquisition system writes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from shaker.io.binary import read_hdf5, read_matlab, read_wave
from shaker.io.channel import RawChannel, reading
from shaker.io.labview import read_labview
from shaker.io.packages import read_dewesoft, read_mdf, read_parquet
from shaker.io.tdms import read_tdms
from shaker.io.text import read_scan_channels, read_table
from shaker.io.universal import read_universal

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
    ".mf4": read_mdf,
    ".dxd": read_dewesoft,
    ".dxz": read_dewesoft,
    ".d7d": read_dewesoft,
    ".parquet": read_parquet,
}
SUFFIXES = tuple(_READERS)


def read_channels(
    path: str | Path, names: Sequence[str] | None = None, sample_rate_hz: float | None = None
) -> dict[str, RawChannel]:
    """Read the named channels (None: all) of a file, by its suffix.

    `sample_rate_hz` serves files that state no rate of their own. NaN is handed on. Anything wrong raises `OSError`
    or `ValueError` with one sentence that begins with the file's path.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from shaker import read_channels
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder, "daq.csv")
    ...     _ = file.write_text("time,Fz\\ns,N\\n0.0,1.5\\n0.1,2.5\\n0.2,3.5\\n")
    ...     read_channels(file)
    {'Fz': RawChannel(3 samples at 10 Hz from 0 s, unit N)}
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: expected a file of type {' '.join(SUFFIXES)}, found {path.suffix or 'no suffix'}")
    with reading(path):
        return reader(path, names, sample_rate_hz)
