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
_UNIVERSAL = "export universal files (.uff, data set 58, binary)"
_EXPORTS = {
    ".svd": f"Polytec's PSV or VibSoft file: {_UNIVERSAL} or MATLAB from its presentation mode",
    ".pvd": f"Polytec's VibSoft file: {_UNIVERSAL} or MATLAB",
    ".hdf": f"HEAD acoustics' ArtemiS file (if it is HDF5, name it .h5): {_UNIVERSAL} or MATLAB",
    ".bkc": f"Brüel & Kjær's BK Connect file: {_UNIVERSAL}, MATLAB or WAVE",
    ".pls": f"Brüel & Kjær's PULSE project: {_UNIVERSAL}, MATLAB or WAVE",
    ".lms": f"Siemens Testlab project: {_UNIVERSAL} or MATLAB",
    ".tdm": "National Instruments' older TDM file: save as .tdms",
    ".mdf": "ASAM MDF of version 2 or 3: convert to version 4 (.mf4)",
}


def refused_suffix(path: Path) -> tuple[str, str] | None:
    """Return what is expected instead of a file that no reader takes, and what it is; None where one takes it."""
    suffix = path.suffix.lower()
    if suffix in _READERS:
        return None
    maker, _, export = _EXPORTS.get(suffix, "").partition(": ")
    found = f"{path.name}, {maker}" if maker else path.name
    return f"a file that ends in one of {' '.join(SUFFIXES)}" + (f" ({export})" if export else ""), found


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
    wrong = refused_suffix(path)
    if wrong is not None:
        raise ValueError(f"{path}: expected {wrong[0]}, found {wrong[1]}")
    with reading(path):
        return _READERS[path.suffix.lower()](path, names, sample_rate_hz)
