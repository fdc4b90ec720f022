"""A table of resonance frequencies of several loads, such as publications and spectrum analysers give."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from fusion.errors import InputError
from fusion.load_series.series import LoadSeries
from shaker._checks import FloatArray
from shaker.models.load_series.identify import Output
from shaker.models.load_series.masses import stated_masses
from shaker.models.load_series.resonances import stated_resonances

LOAD, FIRST, U_FIRST, SECOND, U_LOAD = "load_mass_kg", "frequency_hz", "u_frequency_hz", "second_hz", "u_load_mass_kg"
COLUMNS = (LOAD, FIRST, U_FIRST, SECOND, U_LOAD)


def read_table(path: Path, moving_mass: float, u_moving_mass: float) -> LoadSeries:
    """Return the series that a table holds; raises `InputError` that names row and column.

    Columns load_mass_kg and frequency_hz are needed; u_frequency_hz, second_hz and u_load_mass_kg may stand beside
    them, an empty cell where a value is not known.
    """
    columns = _columns(path)
    order = np.argsort(columns[LOAD], kind="stable")
    first, load = columns[FIRST][order], columns[LOAD][order]
    u_first = np.nan_to_num(columns[U_FIRST][order])
    names = tuple(f"row {place + 1}" for place in order)
    measured = stated_resonances(first, u_first, columns[SECOND][order])
    masses = stated_masses(moving_mass, u_moving_mass, load, np.nan_to_num(columns[U_LOAD][order]))
    return LoadSeries(Output("F", "", ""), names, measured, masses, (), None)


def _columns(path: Path) -> dict[str, FloatArray]:
    """All columns as numbers, NaN where nothing stands."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(path, "", found=error.strerror or str(error), expected="a file that can be read") from error
    except UnicodeDecodeError as error:
        raise InputError(path, "", found="bytes that are no UTF-8", expected="a CSV text") from error
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    rows = list(csv.DictReader(lines, delimiter=";" if lines and ";" in lines[0] else ",", skipinitialspace=True))
    head = [name.strip() for name in (rows[0] if rows else {}) if name is not None]
    missing = next((name for name in (LOAD, FIRST) if name not in head), None)
    if missing is not None:
        raise InputError(path, missing, found="nothing", expected="this column and a row for every load")
    unknown = next((name for name in head if name not in COLUMNS), None)
    if unknown is not None:
        raise InputError(path, unknown, found="this column", expected="columns of " + ", ".join(COLUMNS))
    return {name: np.array([_number(path, row, name, place) for place, row in enumerate(rows, 1)]) for name in COLUMNS}


def _number(path: Path, row: dict[str, str], column: str, place: int) -> float:
    """One cell, checked."""
    cell = next((value for name, value in row.items() if name is not None and name.strip() == column), None)
    text = (cell or "").strip()
    if not text:
        if column in (LOAD, FIRST):
            raise InputError(path, f"{column}, row {place}", found="nothing", expected="a number")
        return float("nan")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    low = 0.0 if column in (LOAD, U_FIRST, U_LOAD) else np.nextafter(0.0, 1.0)
    if not low <= value < np.inf:
        expected = "a number of at least 0" if low == 0.0 else "a frequency above 0"
        raise InputError(path, f"{column}, row {place}", found=text, expected=expected)
    return value
