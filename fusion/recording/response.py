"""Frequency response of a measuring chain: a table, or gain, poles and standard filters."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from fusion.errors import InputError, as_input_error
from fusion.recording.dcc import SUFFIX, CalibrationCertificate, read_dcc
from fusion.recording.dcc_curves import HERTZ, UNAMBIGUOUS_SIGN, CertifiedCurve, curve_named, leading_phase
from fusion.recording.dsi import parse_unit
from fusion.recording.recording_notices import (
    AMBIGUOUS_PHASE_SIGN,
    INVALID_RESPONSE_VALUE,
    KEY_NOT_APPLICABLE,
    MISSING_KEY,
    MISSING_RESPONSE_COLUMN,
    PHASE_NOT_IN_RADIANS,
    RESPONSE_RANGE_TOO_SMALL,
    RESPONSE_UNIT_CONTRADICTION,
    UNREADABLE_RESPONSE_FILE,
    VALUE_OUT_OF_RANGE,
)
from fusion.recording.toml import read_rows, read_toml, validate
from fusion.recording.values import (
    ManifestBlock,
    NotNegative,
    Number,
    Positive,
    Text,
    Version,
    array_of_tables,
    describe,
    refusal,
    rows_of,
    wrong_size,
)
from shaker.frf.chain import (
    ChainResponse,
    FilterKind,
    PassBand,
    PoleModel,
    ResponseTable,
    cascade_responses,
    filter_poles,
    pole_response,
    table_response,
)
from shakercal._common.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from fusion.recording.manifest import ResponseColumns

COLUMNS = ("frequency_hz", "magnitude", "phase_rad", "u_magnitude", "u_phase_rad")
ELEMENTS = ".toml"
LARGEST_TABLE = 50_000_000  # bytes
MOST_ROOTS = 100  # poles or zeros of an element
TURN = 2.0 * np.pi
ANGLES = {"rad": 1.0, "radian": 1.0} | dict.fromkeys(("deg", "°", "degree", "degrees"), np.pi / 180.0)
CLOCKS = 2e-4  # relative clock error that may move a line beyond the last point of a table
UNCERTAINTY_OF = re.compile(r"[uU]\s*\(.*\)")
"""U(x), u(x): uncertainty of x, whose name is no unit (GUM)."""
SAME_HZ = 1e-6  # relative difference of equal frequencies of a table


def _roots(value: object) -> tuple[tuple[float, ...], ...]:
    count = len(value) if isinstance(value, list | tuple) else 0
    if count > MOST_ROOTS:
        raise refusal(f"at most {MOST_ROOTS} pairs", f"{count}", declared=VALUE_OUT_OF_RANGE)
    return rows_of(count, 2)(value)


Roots = Annotated[tuple[tuple[float, float], ...], BeforeValidator(_roots)]
"""A list of [real, imaginary] pairs."""


def _complex(roots: tuple[tuple[float, float], ...]) -> NDArray[np.complex128]:
    return np.array([complex(*root) for root in roots], dtype=np.complex128)


class ChainElement(ManifestBlock):
    """One element of a chain: gain, delay, poles and zeros (rad/s) or filter."""

    name: Text = "element"
    gain: Number = 1.0
    gain_uncertainty: NotNegative = 0.0
    gain_at: NotNegative | None = None
    zeros: Roots = ()
    poles: Roots = ()
    filter: FilterKind | None = None
    band: PassBand = "lowpass"
    order: Annotated[int, Field(ge=1, le=12)] | None = None
    corner: Positive | None = None
    damping: Positive | None = None
    frequency_uncertainty: NotNegative = 0.0
    delay: Number = 0.0
    delay_uncertainty: NotNegative = 0.0

    OF_FILTER: ClassVar[tuple[str, ...]] = ("band", "order", "corner", "damping")
    OF_POLES: ClassVar[tuple[str, ...]] = ("zeros", "poles", "gain_at")

    @model_validator(mode="after")
    def _keys_belong_together(self) -> Self:
        unused = self.OF_FILTER if self.filter is None else self.OF_POLES
        if self.filter != "resonance":
            unused = (*unused, "damping")
        for key in unused:
            if key in self.model_fields_set:
                kind = "an element without filter" if self.filter is None else f'filter = "{self.filter}"'
                raise refusal(f"no such key for {kind}", "one", key=key, declared=KEY_NOT_APPLICABLE)
        needed = {None: (), "resonance": ("corner", "damping")}.get(self.filter, ("order", "corner"))
        for key in needed:
            if getattr(self, key) is None:
                raise refusal(
                    f'this key, required for filter = "{self.filter}"', "no such key", key=key, declared=MISSING_KEY
                )
        if self.filter == "resonance" and self.order not in (None, 2):
            raise refusal("order 2 of a resonance", f"{self.order}", key="order")
        try:
            self.model()
        except ValueError as error:
            key, _, text = str(error).partition(": expected ")
            expected, _, found = text.partition(", found ")
            raise refusal(expected, found, key=key) from error
        return self

    def model(self) -> PoleModel:
        """Return the poles of the element, its gain and its delay."""
        if self.filter is None:
            return PoleModel(_complex(self.zeros), _complex(self.poles), self.gain, self.gain_at, self.delay)
        damping = {} if self.damping is None else {"damping": self.damping}
        standard = filter_poles(self.filter, self.order or 2, self.corner or 0.0, self.band, **damping)
        return PoleModel(standard.zeros, standard.poles, self.gain * standard.gain, standard.gain_hz, self.delay)

    def response(self, frequency_hz: FloatArray) -> ChainResponse:
        """Return the element's response at frequencies (K,), Hz, with named causes of error."""
        found = pole_response(
            frequency_hz,
            self.model(),
            u_gain=self.gain_uncertainty,
            u_frequency=self.frequency_uncertainty,
            u_delay_s=self.delay_uncertainty,
        )
        return ChainResponse(found.value, found.errors, tuple(f"{cause} of {self.name}" for cause in found.causes))


class MeasuringChainFile(ManifestBlock):
    """A file of a measuring chain: elements in series."""

    format: Version = 1
    element: Annotated[tuple[ChainElement, ...], BeforeValidator(array_of_tables), Field(min_length=1)]


def read_response(
    path: Path, frequency_hz: FloatArray, result: str | None = None, columns: ResponseColumns | None = None
) -> ChainResponse:
    """Return the response of a file at frequencies (K,) in Hz.

    `.toml`: `[[element]]` blocks in series. `.xml`: a Digital Calibration Certificate, in SI units; `result` is the id,
    name or type of one of several lists over frequency. Other files are tables with the columns frequency_hz,
    magnitude, phase_rad, u_magnitude, u_phase_rad, or those of `columns`. The prefix u_ is the standard uncertainty in
    the unit of its column. Raises `InputError` with file and key or column.
    """
    if path.suffix.lower() == ELEMENTS:
        with as_input_error(path, "element", UNREADABLE_RESPONSE_FILE):
            return cascade_responses([element.response(frequency_hz) for element in read_chain(path).element])
    if path.suffix.lower() == SUFFIX:
        certificate = read_dcc(path)
        table = certified_table(certificate, result or "")
        _refuse_unmeasured(certificate, curve_named(certificate, result or ""), table, frequency_hz)
    else:
        table = read_table(path, columns)
    low, high = float(table.frequency_hz[0]), float(table.frequency_hz[-1])
    outside = [f for f in frequency_hz if not low * (1.0 - CLOCKS) <= f <= high * (1.0 + CLOCKS)]
    if outside:
        expected = f"a range that contains {outside[0]:g} Hz"
        raise InputError(
            RESPONSE_RANGE_TOO_SMALL, path, "frequency_hz", found=f"{low:g} to {high:g} Hz", expected=expected
        )
    return table_response(table, np.clip(frequency_hz, low, high))


def check_response(path: Path, columns: ResponseColumns | None = None) -> None:
    """Raise `InputError` if a response file cannot be read; certificates are read with the manifest."""
    if path.suffix.lower() != SUFFIX:
        _ = read_chain(path) if path.suffix.lower() == ELEMENTS else read_table(path, columns)


def certified_table(certificate: CalibrationCertificate, result: str) -> ResponseTable:
    """Return a response of a certificate in SI units; `InputError` for one without phase."""
    curve = curve_named(certificate, result)
    key = f'result "{curve.name}"'
    if not np.any(np.isfinite(curve.phase_rad)):
        raise certificate.refusal(key, "no phase", "magnitude and phase, each with U, which a response needs")
    if np.any(np.isnan(curve.frequency_hz)):
        raise certificate.refusal(key, "nan", "finite frequencies")
    measured = np.flatnonzero(_measured(curve))
    if len(measured) == 0:
        raise certificate.refusal(key, "nan", "a frequency with magnitude and phase, each with U")
    order = measured[np.argsort(curve.frequency_hz[measured])]
    frequency_hz = curve.frequency_hz[order]
    if frequency_hz[0] < 0.0 or np.any(np.diff(frequency_hz) <= 0.0):
        raise certificate.refusal(key, "a negative frequency, or one twice", "each frequency once")
    columns = curve.magnitude, curve.phase_rad, curve.u_magnitude, curve.u_phase_rad
    if np.any(columns[0][order] <= 0.0):
        raise certificate.refusal(key, f"{columns[0][order].min():g}", "magnitudes above 0")
    return ResponseTable(frequency_hz, *(column[order] for column in columns))


def _measured(curve: CertifiedCurve) -> BoolArray:
    """Return where (N,) magnitude, phase and both uncertainties are stated."""
    columns = curve.magnitude, curve.phase_rad, curve.u_magnitude, curve.u_phase_rad
    return np.asarray(np.isfinite(columns).all(axis=0))


def _refuse_unmeasured(
    certificate: CalibrationCertificate, curve: CertifiedCurve, table: ResponseTable, frequency_hz: FloatArray
) -> None:
    """Raise `InputError` for a frequency whose nearest point was not measured."""
    for missing in np.sort(curve.frequency_hz[~_measured(curve)]).tolist():
        below, above = (
            np.searchsorted(table.frequency_hz, missing, "left") - 1,
            np.searchsorted(table.frequency_hz, missing, "right"),
        )
        low = table.frequency_hz[below] if below >= 0 else -np.inf
        high = table.frequency_hz[above] if above < len(table.frequency_hz) else np.inf
        needed = frequency_hz[(frequency_hz > low) & (frequency_hz < high)]
        if len(needed):
            raise certificate.refusal(
                f'result "{curve.name}"',
                f"nan at {missing:g} Hz",
                f"numbers near {needed[0]:g} Hz, which is evaluated",
            )


def read_chain(path: Path) -> MeasuringChainFile:
    """Read the elements of a chain; `InputError` for errors."""
    return validate(MeasuringChainFile, read_toml(path), path)


def read_table(path: Path, columns: ResponseColumns | None = None) -> ResponseTable:
    """Read a response table; `InputError` for a missing column or a cell without a number.

    With `columns` any file of channels is accepted, with rows in any order. Repeated frequencies (loops of a
    calibration) are averaged. The standard uncertainty combines the mean of the stated ones, which repetition does not
    reduce, and that of the mean by the scatter.
    """
    names: tuple[str, ...] = COLUMNS if columns is None else columns.names
    values = _typed_columns(path) if columns is None else named_columns(path, columns)
    if np.any(values[1] <= 0.0):
        raise InputError(
            INVALID_RESPONSE_VALUE, path, names[1], found=f"{values[1].min():g}", expected="positive values"
        )
    for name, u in zip(names[3:], values[3:], strict=True):
        if np.any(u < 0.0):
            raise InputError(INVALID_RESPONSE_VALUE, path, name, found=f"{u.min():g}", expected="no negative values")
    values = values if columns is None else without_repeats(values)
    if len(values[0]) == 0 or np.any(np.diff(values[0]) <= 0.0):
        raise InputError(
            INVALID_RESPONSE_VALUE, path, names[0], found="values that do not ascend", expected="ascending frequencies"
        )
    if columns is None or columns.phase_unit != "deg":
        _refuse_degrees(path, names[2], values[2])
    return ResponseTable(*values)


def is_flat(path: Path, columns: ResponseColumns | None, up_to_hz: float) -> bool:
    """Whether the magnitudes of a table agree within 2 % up to a frequency."""
    if path.suffix.lower() in (ELEMENTS, SUFFIX):
        return False
    table = read_table(path, columns)
    below = table.magnitude[: max(2, int(np.searchsorted(table.frequency_hz, up_to_hz)) + 1)]
    return len(below) > 1 and bool(np.ptp(below) < 0.02 * below[0])


def _refuse_degrees(path: Path, name: str, phase_rad: FloatArray) -> None:
    """Raise `InputError` for phases that cannot be in radians, neither wrapped nor unwrapped.

    The first one is between −1.5π, the largest lag before the first point, and 2π.
    """
    steps = np.abs(np.diff(phase_rad))
    if not -0.75 * TURN <= phase_rad[0] <= TURN or (np.any(np.abs(phase_rad) > TURN) and np.any(steps > np.pi)):
        found = f"{phase_rad[np.argmax(np.abs(phase_rad))]:g}"
        raise InputError(
            PHASE_NOT_IN_RADIANS,
            path,
            name,
            found=found,
            expected="radians, within one turn or without jumps (degrees need response_columns)",
        )


def _typed_columns(path: Path) -> list[FloatArray]:
    """Return the columns of a table in the standard format."""
    names, rows = read_rows(path, LARGEST_TABLE)
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        found = f"columns {describe(', '.join(map(str, names)), plain=True) or 'none'}"
        raise InputError(MISSING_RESPONSE_COLUMN, path, missing[0], found=found, expected="this column")
    columns = []
    for name in COLUMNS:
        values = [_number(row[name]) for row in rows]
        for line, value in enumerate(values):
            if not isfinite(value) or wrong_size(value):
                found = f'"{describe(rows[line][name] or "", plain=True)}" in line {line + 2}'
                raise InputError(
                    INVALID_RESPONSE_VALUE,
                    path,
                    name,
                    found=found,
                    expected=wrong_size(value) or "one finite number per row",
                )
        columns.append(np.array(values))
    return columns


def _number(cell: str | None) -> float:
    """Return the number in a cell, NaN if there is none."""
    try:
        return nan if cell is None else float(cell)
    except ValueError:
        return nan


def named_columns(path: Path, columns: ResponseColumns) -> list[FloatArray]:
    """Return frequency, magnitude, phase, u_magnitude and u_phase (N,) of a file in SI units."""
    from shaker.io import read_channels

    names = columns.names
    with as_input_error(path, columns.KEY, UNREADABLE_RESPONSE_FILE):
        read = read_channels(path, list(dict.fromkeys(names)), 1.0)
    values = [read[name].samples for name in names]
    if len({len(column) for column in values}) > 1:
        found = ", ".join(f"{len(column)} of {name}" for name, column in zip(names, values, strict=True))
        raise InputError(INVALID_RESPONSE_VALUE, path, columns.KEY, found=found, expected="columns of equal length")
    for name, column in zip(names, values, strict=True):
        for row, value in enumerate(column.tolist()):
            if not np.isfinite(value) or wrong_size(value):
                found = f"{value:g} in row {row + 1}"
                raise InputError(
                    INVALID_RESPONSE_VALUE,
                    path,
                    name,
                    found=found,
                    expected=wrong_size(value) or "one finite number per row",
                )
    units = ["" if UNCERTAINTY_OF.fullmatch(name) else read[name].unit.strip() for name in names]
    frequency_hz, magnitude, phase, u_magnitude, u_phase = values
    factor = _magnitude_factor(path, columns, units)
    turn, u_turn = (
        _angle_factor(path, columns, name, unit) for name, unit in zip(names[2::2], units[2::2], strict=True)
    )
    if columns.u_magnitude_unit == "%" or units[3] == "%":
        u_magnitude = u_magnitude / 100 * magnitude
    try:
        phase = leading_phase(turn * phase, u_turn * u_phase, columns.phase.lower().replace("_", " "))
    except ValueError as error:
        raise InputError(
            AMBIGUOUS_PHASE_SIGN, path, f"{columns.KEY}.phase", found=str(error), expected=UNAMBIGUOUS_SIGN
        ) from error
    u = factor / columns.k * u_magnitude, u_turn / columns.k * u_phase
    return [_hertz_factor(path, names[0], units[0]) * frequency_hz, factor * magnitude, phase, *u]


def _hertz_factor(path: Path, name: str, unit: str) -> float:
    """Return the factor to Hz of the file's unit of frequencies."""
    if not unit:
        return 1.0
    with suppress(ValueError):
        found = parse_unit(unit)
        if found.dimension == HERTZ and found.angle in (0, 1):
            return found.factor / (TURN if found.angle else 1.0)
    raise InputError(RESPONSE_UNIT_CONTRADICTION, path, name, found=unit, expected="frequencies in Hz, as its unit")


def _angle_factor(path: Path, columns: ResponseColumns, name: str, unit: str) -> float:
    """Return the factor to rad of a column of angles.

    `InputError` if the file's unit contradicts `columns`.
    """
    stated, of_file = columns.phase_unit, ANGLES.get(unit.lower())
    if unit and of_file is None:
        with suppress(ValueError):
            of_file = parse_unit(unit).factor if parse_unit(unit).angle == 1 else None
        if of_file is None:
            raise InputError(RESPONSE_UNIT_CONTRADICTION, path, name, found=unit, expected="rad or deg as its unit")
    if stated is None and of_file is None and re.search(r"deg|°", name.lower()):
        raise InputError(
            PHASE_NOT_IN_RADIANS,
            path,
            columns.KEY,
            found="no phase_unit",
            expected=f'one, because "{name}" suggests degrees',
        )
    if stated is not None and of_file is not None and ANGLES[stated] != of_file:
        raise InputError(
            RESPONSE_UNIT_CONTRADICTION,
            path,
            name,
            found=f"{unit} in the file",
            expected=f"{stated}, as in {columns.KEY}.phase_unit",
        )
    return of_file if of_file is not None else ANGLES[stated or "rad"]


def _magnitude_factor(path: Path, columns: ResponseColumns, units: Sequence[str]) -> float:
    """Return the factor to SI of the magnitudes.

    `InputError` if the file's unit contradicts `columns`.
    """
    _, magnitude, _, u_magnitude, _ = units
    if columns.u_magnitude_unit == "%" and u_magnitude not in ("", "%"):
        raise InputError(
            RESPONSE_UNIT_CONTRADICTION,
            path,
            columns.u_magnitude,
            found=f"{u_magnitude} in the file",
            expected="%, as in u_magnitude_unit",
        )
    if u_magnitude not in ("", "%", magnitude) and magnitude and not _same_unit(u_magnitude, magnitude):
        raise InputError(
            RESPONSE_UNIT_CONTRADICTION,
            path,
            columns.u_magnitude,
            found=u_magnitude,
            expected=f"% or {magnitude}, the unit of the magnitude",
        )
    if magnitude.lower() in ("db", "decibel"):
        raise InputError(
            RESPONSE_UNIT_CONTRADICTION,
            path,
            columns.magnitude,
            found=magnitude,
            expected="magnitudes, not their levels",
        )
    if columns.magnitude_unit is None:
        return 1.0
    stated = parse_unit(columns.magnitude_unit)
    if magnitude and _same_unit(magnitude, columns.magnitude_unit) is False:
        expected = f"{columns.magnitude_unit}, as in {columns.KEY}.magnitude_unit"
        raise InputError(
            RESPONSE_UNIT_CONTRADICTION, path, columns.magnitude, found=f"{magnitude} in the file", expected=expected
        )
    return stated.factor


def _same_unit(one: str, other: str) -> bool | None:
    """Whether two units are equal; None if one of them is not recognised."""
    try:
        units = parse_unit(one), parse_unit(other)
    except ValueError:
        return None
    return units[0].dimension == units[1].dimension and bool(
        np.isclose(units[0].factor, units[1].factor, rtol=1e-9, atol=0)
    )


def without_repeats(values: Sequence[FloatArray]) -> list[FloatArray]:
    """Return columns with one row per frequency, ascending; repeats are averaged.

    Repetition reduces scatter, not the mean of the stated uncertainties: u² = (mean u)² + scatter²/N.
    """
    order = np.argsort(values[0], kind="stable")
    frequency_hz = values[0][order]
    starts = np.flatnonzero(np.diff(frequency_hz, prepend=-np.inf) > SAME_HZ * np.abs(frequency_hz))
    rows = []
    for members in np.split(order, starts[1:]):
        frequency, magnitude, phase, u_magnitude, u_phase = (column[members] for column in values)
        phase = phase[0] + np.angle(np.exp(1j * (phase - phase[0])))  # +180° and −180° are equal
        mean = [column.mean() for column in (frequency, magnitude, phase)]
        scatter = [
            column.std(ddof=1) / np.sqrt(len(members)) if len(members) > 1 else 0.0 for column in (magnitude, phase)
        ]
        rows.append([*mean, np.hypot(u_magnitude.mean(), scatter[0]), np.hypot(u_phase.mean(), scatter[1])])
    return list(np.array(rows).reshape(-1, len(values)).T)
