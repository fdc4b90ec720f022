"""The frequency response of a measuring chain, given as a table and interpolated to the lines."""

from __future__ import annotations

import csv
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.errors import InputError

FloatArray = NDArray[np.float64]
COLUMNS = ("frequency_hz", "magnitude", "phase_rad", "u_magnitude", "u_phase_rad")


@dataclass(frozen=True)
class ChainResponse:
    """Response of a chain at K lines: `value` (K,) complex, relative `u_magnitude` (K,), `u_phase_rad` (K,)."""

    value: NDArray[np.complex128]
    u_magnitude: FloatArray
    u_phase_rad: FloatArray


def read_response(path: Path, frequency_hz: FloatArray) -> ChainResponse:
    """Read a response table and interpolate magnitude and unwrapped phase linearly to frequencies (K,) in Hz.

    Columns: frequency_hz, magnitude, phase_rad, u_magnitude, u_phase_rad (u_: standard uncertainty in the unit of the
    column it belongs to). Raises `InputError` for a missing column, a cell that is no number, and lines out of range.
    """
    table = _read_table(path)
    frequency = table["frequency_hz"]
    if len(frequency) == 0 or np.any(np.diff(frequency) <= 0.0):
        raise InputError(path, "frequency_hz", found="values that do not ascend", expected="ascending frequencies")
    outside = [f for f in frequency_hz if not frequency[0] <= f <= frequency[-1]]
    if outside:
        found = f"{frequency[0]:g} to {frequency[-1]:g} Hz"
        raise InputError(path, "frequency_hz", found=found, expected=f"a range that contains {outside[0]:g} Hz")
    if np.any(table["magnitude"] <= 0.0):
        raise InputError(path, "magnitude", found=f"{table['magnitude'].min():g}", expected="positive values")
    magnitude = np.interp(frequency_hz, frequency, table["magnitude"])
    phase = np.interp(frequency_hz, frequency, np.unwrap(table["phase_rad"]))
    return ChainResponse(
        value=np.asarray(magnitude * np.exp(1j * phase)),
        u_magnitude=np.interp(frequency_hz, frequency, table["u_magnitude"]) / magnitude,
        u_phase_rad=np.interp(frequency_hz, frequency, table["u_phase_rad"]),
    )


def _read_table(path: Path) -> dict[str, FloatArray]:
    """Return the columns of a response table as arrays."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            found, rows = tuple(reader.fieldnames or ()), list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, "", found=str(error), expected="a table in UTF-8 text") from error
    missing = [name for name in COLUMNS if name not in found]
    if missing:
        columns = ", ".join(str(name) for name in found) or "none"
        raise InputError(path, missing[0], found=f"columns {columns}", expected="this column")
    return {
        name: np.array([_number(path, name, row[name], line) for line, row in enumerate(rows, 2)]) for name in COLUMNS
    }


def _number(path: Path, name: str, cell: str | None, line: int) -> float:
    """Return a cell as the finite number it has to be."""
    with suppress(TypeError, ValueError):
        value = float(cell)  # type: ignore[arg-type]
        if math.isfinite(value):
            return value
    raise InputError(path, name, found=f'"{cell or ""}" in line {line}', expected="one finite number per row")
