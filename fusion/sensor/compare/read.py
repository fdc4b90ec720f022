"""What a comparison reads: a results folder of this program, or a CSV table or certificate of others."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from datetime import date as Date
from pathlib import Path

import numpy as np

from fusion.base import InputError
from fusion.recording.dcc import SUFFIX, curves, read_dcc
from fusion.recording.toml import read_text
from fusion.recording.values import describe, wrong_size
from fusion.report.folder import CURVE_FILE, SENSITIVITY_FILE

LARGEST_TABLE = 50_000_000  # bytes
NEEDED = ("frequency_hz", "channel", "component", "magnitude", "unit")
KINDS = ("matrix", "element", "ratio")
"""Of the rows of a table: those that are results of a driven load, the one that tells most of the sensor first."""
ELEMENT = re.compile(r"(\S+) per (\S+)$")
"""How the name of a certificate's result ends."""


@dataclass(frozen=True)
class Value:
    """One value of one result: magnitude and phase (rad, None where not determined) with u, of which 2·u is U.

    `ratio`: of one recording's output and driven load, not the sensor's own element. u = U/k, with k no larger than 2:
    where few degrees of freedom make k larger, 2·u stays the stated U.
    """

    frequency_hz: float
    channel: str
    component: str
    ratio: bool
    unit: str
    magnitude: float
    u_magnitude: float
    phase_rad: float | None
    u_phase_rad: float


@dataclass(frozen=True)
class Result:
    """What is compared: its name, file and values, and the day that its certificate states."""

    name: str
    file: Path
    values: tuple[Value, ...]
    date: Date | None = None


def result_file(path: Path) -> Path:
    """Return the table of a results folder, or the file itself; `InputError` where there is none."""
    if not path.is_dir():
        return path
    for folder in (path, path / "results"):
        for name in (CURVE_FILE, SENSITIVITY_FILE):
            if (folder / name).is_file():
                return folder / name
    raise InputError(path, "", found=f"no {CURVE_FILE} and no {SENSITIVITY_FILE}", expected="a folder of results")


def read_result(name: str, path: Path) -> Result:
    """Read one result: curve.csv or sensitivity.csv of a folder, a table, or a Digital Calibration Certificate.

    `InputError` for what cannot be compared.

    Columns: frequency_hz, channel, component, magnitude, unit, and U_magnitude with k, or u_magnitude; optionally
    phase_rad with U_phase_rad (k_phase, else k) or u_phase_rad, and kind (element where there is none). Of several
    kinds of one value that counts which tells most of the sensor: matrix, element, ratio.
    """
    file = result_file(path)
    if file.suffix.lower() == SUFFIX:
        return _certified(name, file)
    try:
        reader = csv.DictReader(read_text(file, LARGEST_TABLE, "a table").splitlines())
        columns, rows = tuple(reader.fieldnames or ()), list(reader)
    except csv.Error as error:
        raise InputError(file, "", found=str(error), expected="a table in UTF-8 text") from error
    missing = [column for column in NEEDED if column not in columns]
    if missing:
        raise InputError(file, missing[0], found="no such column", expected="this column")
    if not {"U_magnitude", "u_magnitude"} & set(columns):
        raise InputError(file, "U_magnitude", found="no such column", expected="this column, or u_magnitude")
    found: dict[tuple[float, str, str], tuple[int, Value]] = {}
    for line, row in enumerate(rows, 2):
        kind = row["kind"] if "kind" in columns else KINDS[1]
        if kind not in KINDS:
            continue
        value, rank = _value(row, file, line, ratio=kind == "ratio"), KINDS.index(kind)
        key = value.frequency_hz, value.channel, value.component
        if key in found and found[key][0] == rank:
            told = f"{value.frequency_hz:g} Hz twice for {value.channel} per {value.component}"
            raise InputError(file, "frequency_hz", found=f"{told} (line {line})", expected="one value each")
        if key not in found or rank < found[key][0]:
            found[key] = rank, value
    if not found:
        raise InputError(file, "", found="no values", expected="a table with results")
    return Result(name, file, tuple(value for _, value in found.values()))


def _certified(name: str, file: Path) -> Result:
    """Read the results of a certificate that are named as `shakercal certificate` does, "… CHANNEL per COMPONENT"."""
    certificate, values = read_dcc(file), list[Value]()
    for curve in curves(certificate):
        element = ELEMENT.search(curve.name)
        if element is None:
            continue
        u_magnitude, phased = curve.u_magnitude / curve.unit.factor, np.isfinite(curve.phase_rad)
        if np.any(curve.u_magnitude <= 0.0) or np.any(curve.u_phase_rad[phased] <= 0.0):
            raise InputError(file, f'result "{curve.name}"', found="an uncertainty of 0", expected="one above 0")
        for n, frequency_hz in enumerate(curve.frequency_hz.tolist()):
            own = Value(
                frequency_hz=frequency_hz,
                channel=element[1],
                component=element[2],
                ratio=False,
                unit=curve.unit.text,
                magnitude=float(curve.magnitude[n]) / curve.unit.factor,
                u_magnitude=float(u_magnitude[n]),
                phase_rad=float(curve.phase_rad[n]) if phased[n] else None,
                u_phase_rad=float(curve.u_phase_rad[n]),
            )
            values.append(own)
    if not values:
        expected = 'a result over frequency named "… CHANNEL per COMPONENT", such as "Sensitivity Fz per Fz"'
        raise InputError(file, "dcc:results", found="none", expected=expected)
    return Result(name, file, tuple(values), certificate.date)


def _value(row: dict[str, str], file: Path, line: int, *, ratio: bool) -> Value:
    """One row of a table."""

    def number(column: str, least: float = -np.inf) -> float:
        text = row.get(column) or ""
        try:
            found = float(text)
        except ValueError:
            found = np.nan
        if not np.isfinite(found) or wrong_size(found) or found < least:
            shown = f'"{describe(text, plain=True)}" in line {line}'
            expected = "a finite number" if least == -np.inf else f"a number of at least {least:g}"
            raise InputError(file, column, found=shown, expected=expected)
        return found

    def uncertainty(of: str, factor: str) -> float:
        if not row.get(f"U_{of}"):
            found, column = number(f"u_{of}", 0.0), f"u_{of}"
        else:
            found, column = number(f"U_{of}", 0.0) / min(number(factor, 1.0), 2.0), f"U_{of}"
        if found == 0.0:
            raise InputError(file, column, found=f"0 in line {line}", expected="a number above 0")
        return found

    texts = {}
    for column in ("channel", "component", "unit"):
        texts[column] = (row.get(column) or "").strip()
        if not texts[column]:
            raise InputError(file, column, found=f"nothing in line {line}", expected="a text")
    phase = row.get("phase_rad") not in (None, "", "nan")
    turned = uncertainty("phase_rad", "k_phase" if row.get("k_phase") else "k") if phase else np.nan
    return Value(
        frequency_hz=number("frequency_hz", 0.0),
        ratio=ratio,
        **texts,
        magnitude=number("magnitude", 0.0),
        u_magnitude=uncertainty("magnitude", "k"),
        phase_rad=number("phase_rad") if phase else None,
        u_phase_rad=turned,
    )
