"""Inputs of a comparison: folders of results, CSV tables, and certificates."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date as Date
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np

from fusion.errors import InputError
from fusion.estimation.labelled_phasors import LabelledPhasors
from fusion.recording.dcc import SUFFIX, read_dcc
from fusion.recording.dcc_curves import curves
from fusion.recording.toml import read_rows
from fusion.recording.values import describe, wrong_size
from fusion.report.folder import CURVE_FILE, RESULT_FILE, SENSITIVITY_FILE
from fusion.report.h5 import open_results, read_evidence
from fusion.report.labelled_results import CAMPAIGN_FILE, read_results
from fusion.report.report_notices import WRONG_CONDITION
from fusion.report.result_database import query_results
from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensor import result_notices as declared
from fusion.sensor.compare.named_tables import ComparedColumns, ComparedTables, read_named_table, read_tables
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

LARGEST_TABLE = 50_000_000  # bytes
NEEDED = ("frequency_hz", "channel", "component", "magnitude", "unit")
KINDS = ("matrix", "element", "ratio")
"""Kinds of rows that are results of a driven load, in the order of preference."""
HARMONIC = "harmonic"
"""Kind of rows without a driven load."""
SAME_LINE = 1e-4
"""Relative difference of frequencies within which rows of different kinds are one line: each is a separate mean."""
DAYS = 365.2425
COMPANION_FILES = {CURVE_FILE: CAMPAIGN_FILE, SENSITIVITY_FILE: RESULT_FILE}
"""HDF5 file with the origin of the values, by the table of results."""
DATABASE = ".parquet"
QUERY = f"{DATABASE}?"
ELEMENT = re.compile(r"(?P<ratio>Ratio of output )?(\S+) (?(ratio)to driven load|per) (\S+)$")
"""End of the name of a certificate's result, of an element or of a ratio."""


@dataclass(frozen=True)
class ComparedValue:
    """One value of one result: magnitude and phase with u = U/2.

    The phase (rad) is None if not determined.

    Attributes
    ----------
    ratio : whether it is the ratio of one recording's output and load, otherwise an element of the sensor.
    u_magnitude, u_phase_rad : U/k, with k at most 2, so that 2·u is the stated U even with few degrees of freedom.
    effects : by unknown of certificates and files: relative change of the magnitude and change of the phase (rad) for
        one standard uncertainty.
    year : mean date of the recordings, NaN if one states none.
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
    effects: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    year: float = np.nan


@dataclass(frozen=True)
class ComparedResult:
    """A result to be compared, with its values and their evidence.

    `date` and `certificate` (number) of a certificate. `notices`: on its signature, or on its uncertainties.
    `repeats`: most rows at one frequency of a table, which are averaged. `responses`: number of ratios left out because
    the output does not belong to the driven load. The effect of other loads on such an output is as large as the output
    itself, and differs between rigs. `rows`: which rows of a database were selected, None for other files.
    """

    name: str
    file: Path
    values: tuple[ComparedValue, ...]
    date: Date | None = None
    evidence: tuple[InputEvidence, ...] = ()
    notices: tuple[Notice, ...] = ()
    repeats: int = 1
    responses: int = 0
    certificate: str = ""
    rows: frozenset[tuple[Any, ...]] | None = None


def result_file(path: Path) -> Path:
    """Return the table of a folder of results, or the file itself; `InputError` without one."""
    path = split_query(path)[0]
    if not path.is_dir():
        return path
    for folder in (path, path / "results"):
        for name in (CURVE_FILE, SENSITIVITY_FILE):
            if (folder / name).is_file():
                return folder / name
    raise InputError(declared.NO_RESULT_TABLE, path, expected=f"{CURVE_FILE} or {SENSITIVITY_FILE}")


def split_query(path: Path) -> tuple[Path, str]:
    """Return the database and the condition of `FILE.parquet?CONDITION`; other paths unchanged with "true"."""
    before, query, condition = str(path).partition(QUERY)
    return (Path(f"{before}{DATABASE}"), condition) if query else (path, "true")


def result_files(path: Path) -> list[Path]:
    """Return all files that `read_result` reads of a path."""
    file = result_file(path)
    companion = file.with_name(COMPANION_FILES.get(file.name, file.name))
    return [file, companion] if companion != file and companion.is_file() else [file]


def read_compared(paths: Mapping[str, str | Path], columns: str | Path | None = None) -> tuple[ComparedResult, ...]:
    """Read the results of a comparison by name, for `evaluate_comparison`.

    Parameters
    ----------
    paths : mapping of str to str or Path
        Name `[ROUND/]LABORATORY[@DATE]` → folder of results, CSV table, Digital Calibration Certificate, or
        `DATABASE.parquet?CONDITION` for rows of a database (`query_results`).
    columns : str or Path, optional
        File that names the columns of tables with other columns, as of `shakercal compare --columns`.

    Returns
    -------
    One result per path, in their order.

    Raises
    ------
    InputError
        A file cannot be compared.

    Examples
    --------
    >>> from fusion import read_compared
    >>> results = read_compared({"own": "campaign/results", "ptb": "ptb.csv"})  # doctest: +SKIP
    >>> results[1].values[0].magnitude  # doctest: +SKIP
    """
    tables = None if columns is None else read_tables(Path(columns), paths)
    return tuple(read_result(name, Path(path), tables) for name, path in paths.items())


def read_result(name: str, path: Path, tables: ComparedTables | None = None) -> ComparedResult:
    """Read a folder of results, a table, a certificate (DCC), or rows of a database.

    Raises `InputError` if it cannot be compared.

    Columns: frequency_hz, channel, component, magnitude, unit, and U_magnitude with k, or u_magnitude. Optional:
    phase_rad with U_phase_rad (k_phase, otherwise k) or u_phase_rad, and kind (default element). Of several kinds of
    one value, the first of matrix, element, ratio is used. Ratios of outputs that do not belong to the driven load are
    left out. `tables` names the columns of tables that have others.
    """
    file = result_file(path)
    if file.suffix.lower() == SUFFIX:
        return _certified(name, file)
    if file.suffix.lower() == DATABASE:
        return _queried(name, file, split_query(path)[1])
    if tables is not None and not path.is_dir():
        named = tables.columns_of.get(name, tables.columns)
        if named is not None and (name in tables.columns_of or not _has_usual_columns(file)):
            return _named(name, file, named)
    columns, rows = read_rows(file, LARGEST_TABLE)
    missing = [column for column in NEEDED if column not in columns]
    if missing:
        raise InputError(declared.WRONG_RESULT_TABLE, file, missing[0], found="none", expected="this column")
    if not {"U_magnitude", "u_magnitude"} & set(columns):
        expected = "this column, or u_magnitude"
        raise InputError(declared.WRONG_RESULT_TABLE, file, "U_magnitude", found="none", expected=expected)
    found: dict[tuple[float, str, str, str], ComparedValue] = {}
    for line, row in enumerate(rows, 2):
        kind = row["kind"] if "kind" in columns else KINDS[1]
        if kind == HARMONIC:
            continue
        if kind not in KINDS:
            expected = f"one of {', '.join((*KINDS, HARMONIC))}"
            text = f'"{describe(kind, plain=True)}"'
            raise InputError(declared.WRONG_RESULT_CELL, file, "kind", found=text, expected=expected, line=line)
        value = _value(row, file, line, ratio=kind == "ratio")
        key = value.frequency_hz, value.channel, value.component, kind
        if key in found:
            text = f"{value.frequency_hz:g} Hz twice for {value.channel} per {value.component}"
            raise InputError(
                declared.WRONG_RESULT_CELL, file, "frequency_hz", found=text, expected="one value each", line=line
            )
        found[key] = value
    if not found:
        raise InputError(declared.WRONG_RESULT_TABLE, file, found="no values", expected="a table with results")
    companions = result_files(path)[1:]
    origins, evidence = _origin(companions[0]) if companions else ({}, ())
    values = []
    for key in _best(found):
        effects, year = origins.get(key, ({}, np.nan))
        values.append(replace(found[key], effects=effects, year=year))
    selected, responses = _without_responses(values)
    return ComparedResult(name, file, selected, evidence=evidence, responses=responses)


def _queried(name: str, file: Path, condition: str) -> ComparedResult:
    """Return the means of selected rows of a database, by element and frequency."""
    rows = query_results(file, condition)
    sensors = sorted({row["serial"] or row["sensor"] for row in rows})
    found = rows_by_line(rows, "channel", "component", "kind", "unit")
    if not found or len(sensors) > 1:
        what = f"several sensors ({', '.join(sensors[:3])}{', …' * (len(sensors) > 3)})" if found else "no result"
        raise InputError(WRONG_CONDITION, file, reason=f"found {condition!r}, which selects {what}")
    means = {}
    for (channel, component, kind, unit), lines in found.items():
        for line in lines:
            mean = _mean_of(line, channel, component, unit)
            means[mean.frequency_hz, channel, component, kind] = mean
    values, responses = _without_responses([means[key] for key in _best(means)])
    repeats = max(len(line) for lines in found.values() for line in lines)
    identity = ("path", "channel", "component", "kind", "frequency_hz")
    selected = frozenset(tuple(row[key] for key in identity) for row in rows)
    return ComparedResult(name, file, values, repeats=repeats, responses=responses, rows=selected)


Row: TypeAlias = Mapping[str, Any]


def rows_by_line(rows: Iterable[Row], *names: str) -> dict[tuple[str, ...], list[list[Row]]]:
    """Return rows of a database by some columns and by frequency, without harmonics."""
    found: dict[tuple[str, ...], list[list[Row]]] = {}
    for row in sorted(rows, key=lambda row: float(row["frequency_hz"])):
        if row["kind"] != HARMONIC:
            lines = found.setdefault(tuple(row[name] for name in names), [])
            if not lines or row["frequency_hz"] > lines[-1][0]["frequency_hz"] * (1.0 + SAME_LINE):
                lines.append([])
            lines[-1].append(row)
    return found


def _mean_of(rows: Sequence[Row], channel: str, component: str, unit: str) -> ComparedValue:
    """Return the mean of repeated results of one element.

    u² is the square of the mean u, which repeats do not reduce, plus the squared scatter over their number.
    """
    columns = ("frequency_hz", "magnitude", "u_magnitude", "k_magnitude", "phase_rad", "u_phase_rad", "k_phase")
    table = np.array([[row[name] for name in columns] for row in rows])
    frequency, magnitude, u_magnitude, k, phase, u_phase, k_phase = table.T
    phase = phase[0] + np.angle(np.exp(1j * (phase - phase[0])))
    days = [year_of(row["date"]) for row in rows if row["date"] is not None]
    phased = bool(np.isfinite([*phase, *u_phase]).all())
    scatter = [np.std(values, ddof=1) / np.sqrt(len(rows)) if len(rows) > 1 else 0.0 for values in (magnitude, phase)]
    return ComparedValue(
        frequency_hz=float(np.mean(frequency)),
        channel=channel,
        component=component,
        ratio=rows[0]["kind"] == KINDS[2],
        unit=unit,
        magnitude=float(np.mean(magnitude)),
        u_magnitude=float(np.hypot(np.mean(u_magnitude * np.maximum(k / 2.0, 1.0)), scatter[0])),
        phase_rad=float(np.mean(phase)) if phased else None,
        u_phase_rad=float(np.hypot(np.mean(u_phase * np.maximum(k_phase / 2.0, 1.0)), scatter[1]))
        if phased
        else np.nan,
        year=float(np.mean(days)) if len(days) == len(rows) else np.nan,
    )


def _has_usual_columns(file: Path) -> bool:
    """Whether the first line of a text file names the usual columns."""
    try:
        with file.open("rb") as opened:
            first = opened.readline(10_000)
    except OSError:
        return True
    return all(name.encode() in first for name in NEEDED)


def _named(name: str, file: Path, columns: ComparedColumns) -> ComparedResult:
    """Read a table by the names of its columns."""
    table = read_named_table(name, file, columns)
    values = tuple(
        ComparedValue(
            frequency_hz=float(table.frequency_hz[k]),
            channel=columns.channel,
            component=columns.component,
            ratio=False,
            unit=table.unit,
            magnitude=float(table.magnitude[k]),
            u_magnitude=float(table.u_magnitude[k]),
            phase_rad=float(table.phase_rad[k]),
            u_phase_rad=float(table.u_phase_rad[k]),
        )
        for k in range(len(table.frequency_hz))
    )
    return ComparedResult(name, file, values, notices=table.notices, repeats=table.repeats)


Key: TypeAlias = tuple[float, str, str, str]
"""Frequency, channel, component and kind of a value."""


def _best(found: Collection[Key]) -> list[Key]:
    """Return the preferred kind of each value at each line, in table order."""
    better: dict[tuple[str, str], FloatArray] = {}
    dropped: set[Key] = set()
    for kind in KINDS:
        of_kind: dict[tuple[str, str], list[Key]] = {}
        for key in (key for key in found if key[3] == kind):
            of_kind.setdefault(key[1:3], []).append(key)
        for element, keys in of_kind.items():
            covered, frequency = better.get(element, np.array([])), np.array([key[0] for key in keys])
            near = np.searchsorted(covered, frequency * (1.0 + SAME_LINE), "right")
            taken = near > np.searchsorted(covered, frequency * (1.0 - SAME_LINE), "left")
            dropped.update(key for key, one in zip(keys, taken.tolist(), strict=True) if one)
            better[element] = np.sort(np.concatenate([covered, frequency[~taken]]))
    return [key for key in found if key not in dropped]


def _without_responses(values: Sequence[ComparedValue]) -> tuple[tuple[ComparedValue, ...], int]:
    """Return values without responses to other loads, and the number left out.

    The output of a load is that of its name, otherwise the one with the largest value.
    """
    main: dict[str, str] = {}
    for value in sorted(values, key=lambda value: (value.channel != value.component, -value.magnitude)):
        main.setdefault(value.component, value.channel)
    selected = tuple(value for value in values if not value.ratio or value.channel == main[value.component])
    return selected, len(values) - len(selected)


def year_of(day: Date) -> float:
    """Return a day as a number of years."""
    return 1.0 + (day.toordinal() - 1) / DAYS


ValueOrigins = dict[Key, tuple[dict[str, tuple[float, float]], float]]
"""Effects and year of every value."""


def _origin(path: Path) -> tuple[ValueOrigins, tuple[InputEvidence, ...]]:
    """Return effects of inputs and years of all values, and the evidence."""
    found = read_results(path)
    parts = [part for part in (*found.curve, found.sensitivity, found.element) if part is not None]
    with open_results(path) as file:
        evidence = read_evidence(file)
        if "curves" in file:
            years = list(_years_of_curves(file))
        else:
            year = year_of(Date.fromisoformat(file.attrs["date"])) if "date" in file.attrs else np.nan
            years = [np.full(len(part.frequency_hz), year) for part in parts]
    named, origins = {row.unknown for row in evidence}, ValueOrigins()
    for part, part_years in zip(parts, years, strict=True):
        origins |= _effects(part, named, part_years)
    return origins, evidence


def _years_of_curves(file: h5py.File) -> Iterator[FloatArray]:
    """Yield the mean date of the recordings at each frequency, NaN without one."""
    table = file["recordings"]
    names = table["name"].asstr()[()].tolist() if len(table["name"]) else []
    days = table["date"].asstr()[()].tolist() if "date" in table and names else [""] * len(names)
    of = {name: year_of(Date.fromisoformat(day)) if day else np.nan for name, day in zip(names, days, strict=True)}
    for curve in file["curves"].values():
        behind = curve.get("recordings", {})
        names_of_lines = [behind.get(f"{k:03d}", ()) for k in range(len(curve["frequency_hz"]))]
        yield np.array([np.mean([of[n] for n in each.asstr()[()]]) if len(each) else np.nan for each in names_of_lines])


def _effects(part: LabelledPhasors, named: Collection[str], year: FloatArray) -> ValueOrigins:
    """Return effects of the unknowns `named`, and years (K,), of every value of a curve."""
    size, origins = len(part.unit), ValueOrigins()
    acting = [i for i in part.uncertainty.influences if i.name in named and i.scope == "rig"]
    for k, e in np.ndindex(part.value.shape):
        value = complex(part.value[k, e])
        if np.isfinite(value) and value != 0.0:
            changes = {i.name: complex(i.effect[k, e], i.effect[k, e + size]) / value for i in acting}
            effects = {name: (change.real, change.imag) for name, change in changes.items() if change != 0.0}
            key = float(part.frequency_hz[k]), part.channel[e], part.component[e], part.kind[k]
            origins[key] = effects, float(year[k])
    return origins


def _certified(name: str, file: Path) -> ComparedResult:
    """Read the results of a certificate with names "… CHANNEL per COMPONENT"."""
    certificate, values = read_dcc(file), list[ComparedValue]()
    for curve in curves(certificate):
        element = ELEMENT.search(curve.name)
        if element is None:
            continue
        curve.usable()
        u_magnitude = curve.u_magnitude / curve.unit.factor
        phased = np.isfinite(curve.phase_rad)
        columns = [curve.frequency_hz, curve.magnitude, u_magnitude]
        columns += [curve.phase_rad, curve.u_phase_rad] if np.any(phased) else []
        key = f'result "{curve.name}"'
        if not np.isfinite(columns).all():
            raise InputError(declared.WRONG_CERTIFIED_RESULT, file, key, found="nan", expected="finite numbers")
        if np.any(curve.u_magnitude <= 0.0) or np.any(curve.u_phase_rad[phased] <= 0.0):
            raise InputError(declared.WRONG_CERTIFIED_RESULT, file, key, found="0", expected="an uncertainty above 0")
        for n, frequency_hz in enumerate(curve.frequency_hz.tolist()):
            value = ComparedValue(
                frequency_hz=frequency_hz,
                channel=element[2],
                component=element[3],
                ratio=element["ratio"] is not None,
                unit=curve.unit.text,
                magnitude=float(curve.magnitude[n]) / curve.unit.factor,
                u_magnitude=float(u_magnitude[n]),
                phase_rad=float(curve.phase_rad[n]) if phased[n] else None,
                u_phase_rad=float(curve.u_phase_rad[n]),
            )
            values.append(value)
    if not values:
        expected = 'a result over frequency named "… CHANNEL per COMPONENT", such as "Sensitivity Fz per Fz"'
        raise InputError(declared.WRONG_CERTIFIED_RESULT, file, "dcc:results", found="none", expected=expected)
    notices = certificate.signature_notices
    return ComparedResult(name, file, tuple(values), certificate.date, notices=notices, certificate=certificate.number)


def _value(row: dict[str, str], file: Path, line: int, *, ratio: bool) -> ComparedValue:
    """Return the value of one row of a table."""

    def number(column: str, least: float = -np.inf) -> float:
        text = row.get(column) or ""
        try:
            found = float(text)
        except ValueError:
            found = np.nan
        if not np.isfinite(found) or wrong_size(found) or found < least:
            shown = f'"{describe(text, plain=True)}"'
            expected = "a finite number" if least == -np.inf else f"a number of at least {least:g}"
            raise InputError(declared.WRONG_RESULT_CELL, file, column, found=shown, expected=expected, line=line)
        return found

    def uncertainty(of: str, factor: str) -> float:
        if not row.get(f"U_{of}"):
            found, column = number(f"u_{of}", 0.0), f"u_{of}"
        else:
            found, column = number(f"U_{of}", 0.0) / min(number(factor, 1.0), 2.0), f"U_{of}"
        if found == 0.0:
            raise InputError(
                declared.WRONG_RESULT_CELL, file, column, found="0", expected="a number above 0", line=line
            )
        return found

    texts = {}
    for column in ("channel", "component", "unit"):
        texts[column] = (row.get(column) or "").strip()
        if not texts[column]:
            raise InputError(declared.WRONG_RESULT_CELL, file, column, found="no value", expected="a text", line=line)
    phase = row.get("phase_rad") not in (None, "", "nan")
    u_phase = uncertainty("phase_rad", "k_phase" if row.get("k_phase") else "k") if phase else np.nan
    return ComparedValue(
        frequency_hz=number("frequency_hz", 0.0),
        ratio=ratio,
        channel=texts["channel"],
        component=texts["component"],
        unit=texts["unit"],
        magnitude=number("magnitude", 0.0),
        u_magnitude=uncertainty("magnitude", "k"),
        phase_rad=number("phase_rad") if phase else None,
        u_phase_rad=u_phase,
    )
