"""Readers of the files of data acquisition systems."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

from shaker.io.channel import RawChannel, convert_read_errors

_READERS = {
    ".h5": "binary.read_hdf5",
    ".hdf5": "binary.read_hdf5",
    ".tdms": "tdms.read_tdms",
    ".uff": "universal.read_universal",
    ".unv": "universal.read_universal",
    ".mat": "binary.read_matlab",
    ".csv": "table.read_table",
    ".tsv": "table.read_table",
    ".txt": "table.read_table",
    ".dat": "table.read_table",
    ".wav": "binary.read_wave",
    ".lvm": "labview.read_labview",
    ".asc": "text.read_scan_channels",
    ".mf4": "packages.read_mdf",
    ".dxd": "packages.read_dewesoft",
    ".dxz": "packages.read_dewesoft",
    ".d7d": "packages.read_dewesoft",
    ".parquet": "packages.read_parquet",
}
"""Module and function of each suffix, imported for a file that has it."""
SUFFIXES = tuple(_READERS)
_UNIVERSAL = "export universal files (.uff, data set 58, binary)"
EXPORTS = {
    ".svd": f"Polytec's PSV or VibSoft file: {_UNIVERSAL} or MATLAB from its presentation mode",
    ".pvd": f"Polytec's VibSoft file: {_UNIVERSAL} or MATLAB",
    ".hdf": f"HEAD acoustics' ArtemiS file (if it is HDF5, name it .h5): {_UNIVERSAL} or MATLAB",
    ".bkc": f"Brüel & Kjær's BK Connect file: {_UNIVERSAL}, MATLAB or WAVE",
    ".pls": f"Brüel & Kjær's PULSE project: {_UNIVERSAL}, MATLAB or WAVE",
    ".lms": f"Siemens Testlab project: {_UNIVERSAL} or MATLAB",
    ".tdm": "National Instruments' older TDM file: save as .tdms",
    ".mdf": "ASAM MDF of version 2 or 3: convert to version 4 (.mf4)",
    ".xlsx": "an Excel workbook: save the sheet as CSV",
    ".xls": "an Excel workbook: save the sheet as CSV",
    ".trc": "LeCroy's binary trace: save as text (.csv)",
    ".wfm": "an oscilloscope's binary waveform: save as text (.csv)",
    ".isf": "Tektronix' binary waveform: save as text (.csv)",
    ".wvf": "Yokogawa's binary waveform: export text (.csv)",
    ".wdf": "Yokogawa's binary waveform: export text (.csv)",
    ".bin": "a binary file of a recorder: export text (.csv)",
    ".tst": "HBM's catman project: export text (.txt), MATLAB or universal files",
}
"""Files that have no reader: maker and what to export."""


def unsupported_suffix(path: Path) -> tuple[str, str] | None:
    """Return the expected suffixes and a description of an unsupported file, else None."""
    suffix = path.suffix.lower()
    if suffix in _READERS:
        return None
    maker, _, export = EXPORTS.get(suffix, "").partition(": ")
    found = f"{path.name}, {maker}" if maker else path.name
    return f"a file that ends in one of {' '.join(SUFFIXES)}" + (f" ({export})" if export else ""), found


def read_channels(
    path: str | Path, names: Sequence[str] | None = None, sample_rate_hz: float | None = None
) -> dict[str, RawChannel]:
    r"""Read channels of a file with the reader of its suffix.

    Parameters
    ----------
    path
        The file.
    names
        Channels to read; None reads all.
    sample_rate_hz
        Sampling rate in Hz for a file that states none; it must agree with the rate that a file states.

    Returns
    -------
    The channels by name. Missing samples are NaN.

    Raises
    ------
    OSError, ValueError
        The file cannot be read; the message is one sentence that begins with the path.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from shaker import read_channels
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder, "daq.csv")
    ...     _ = file.write_text("time,Fz\ns,N\n0.0,1.5\n0.1,2.5\n0.2,3.5\n")
    ...     read_channels(file)
    {'Fz': RawChannel(3 samples at 10 Hz from 0 s, unit N)}
    """
    path = Path(path)
    wrong = unsupported_suffix(path)
    if wrong is not None:
        raise ValueError(f"{path}: expected {wrong[0]}, found {wrong[1]}")
    module, _, name = _READERS[path.suffix.lower()].partition(".")
    read: Callable[..., dict[str, RawChannel]] = getattr(import_module(f"shaker.io.{module}"), name)
    with convert_read_errors(path):
        return read(path, names, sample_rate_hz)
