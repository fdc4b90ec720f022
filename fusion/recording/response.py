"""The frequency response of a measuring chain: a table, or a text of gain, poles and standard filters."""

from __future__ import annotations

import csv
from contextlib import suppress
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from fusion.base import InputError, as_input_error
from fusion.recording.dcc import SUFFIX, CalibrationCertificate, curve_named, read_dcc
from fusion.recording.toml import read_text, read_toml, validate
from fusion.recording.values import (
    Block,
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
from shaker.arrays import FloatArray
from shaker.frf.chain import (
    ChainResponse,
    FilterKind,
    PassBand,
    PoleModel,
    ResponseTable,
    filter_poles,
    pole_response,
    product,
    table_response,
)

COLUMNS = ("frequency_hz", "magnitude", "phase_rad", "u_magnitude", "u_phase_rad")
ELEMENTS = ".toml"
LARGEST_TABLE = 50_000_000  # bytes
MOST_ROOTS = 100  # poles or zeros of an element


def _roots(value: object) -> tuple[tuple[float, ...], ...]:
    count = len(value) if isinstance(value, list | tuple) else 0
    if count > MOST_ROOTS:
        raise refusal(f"at most {MOST_ROOTS} pairs", f"{count}")
    return rows_of(count, 2)(value)


Roots = Annotated[tuple[tuple[float, float], ...], BeforeValidator(_roots)]
"""A list of [real, imaginary] pairs."""


def _complex(roots: tuple[tuple[float, float], ...]) -> NDArray[np.complex128]:
    return np.array([complex(*root) for root in roots], dtype=np.complex128)


class Element(Block):
    """One element of a chain: gain and delay of its own, and poles and zeros in rad/s or a standard filter."""

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
        foreign = self.OF_FILTER if self.filter is None else self.OF_POLES
        if self.filter != "resonance":
            foreign = (*foreign, "damping")
        for key in foreign:
            if key in self.model_fields_set:
                kind = "an element without filter" if self.filter is None else f'filter = "{self.filter}"'
                raise refusal(f"no such key for {kind}", "one", key=key)
        needed = {None: (), "resonance": ("corner", "damping")}.get(self.filter, ("order", "corner"))
        for key in needed:
            if getattr(self, key) is None:
                raise refusal(f'this key, required for filter = "{self.filter}"', "nothing", key=key)
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
        own = filter_poles(self.filter, self.order or 2, self.corner or 0.0, self.band, **damping)
        return PoleModel(own.zeros, own.poles, self.gain * own.gain, own.gain_hz, self.delay)

    def response(self, frequency_hz: FloatArray) -> ChainResponse:
        """Return the element's response at frequencies (K,) in Hz, its causes of error named by the element."""
        found = pole_response(
            frequency_hz,
            self.model(),
            u_gain=self.gain_uncertainty,
            u_frequency=self.frequency_uncertainty,
            u_delay_s=self.delay_uncertainty,
        )
        return ChainResponse(found.value, found.errors, tuple(f"{cause} of {self.name}" for cause in found.causes))


class Chain(Block):
    """A chain's file: elements one behind the other."""

    format: Version = 1
    element: Annotated[tuple[Element, ...], BeforeValidator(array_of_tables), Field(min_length=1)]


def read_response(path: Path, frequency_hz: FloatArray, result: str | None = None) -> ChainResponse:
    """Return the response that a file states at frequencies (K,) in Hz.

    `.toml`: `[[element]]` blocks, which multiply. `.xml`: a Digital Calibration Certificate, in SI units, of which
    `result` is the id, name or type of a list over frequency where it has several. Any other file is a table with the
    columns frequency_hz, magnitude, phase_rad, u_magnitude, u_phase_rad (u_: standard uncertainty in the unit of the
    column it belongs to). Raises `InputError` naming file and key or column.
    """
    if path.suffix.lower() == ELEMENTS:
        with as_input_error(path, "element"):
            return product([element.response(frequency_hz) for element in read_chain(path).element])
    table = certified_table(read_dcc(path), result or "") if path.suffix.lower() == SUFFIX else read_table(path)
    outside = [f for f in frequency_hz if not table.frequency_hz[0] <= f <= table.frequency_hz[-1]]
    if outside:
        found = f"{table.frequency_hz[0]:g} to {table.frequency_hz[-1]:g} Hz"
        raise InputError(path, "frequency_hz", found=found, expected=f"a range that contains {outside[0]:g} Hz")
    return table_response(table, frequency_hz)


def check_response(path: Path) -> None:
    """Raise `InputError` unless a response file can be read; certificates are when their manifest is."""
    if path.suffix.lower() != SUFFIX:
        _ = read_chain(path) if path.suffix.lower() == ELEMENTS else read_table(path)


def certified_table(certificate: CalibrationCertificate, result: str) -> ResponseTable:
    """Return a list over frequency of a certificate, in SI; `InputError` for one without phase, or of no response."""
    curve = curve_named(certificate, result)
    key = f'result "{curve.name}"'
    if not np.all(np.isfinite(curve.phase_rad)):
        raise certificate.refusal(key, "no phase", "magnitude and phase, each with U, which a response needs")
    order = np.argsort(curve.frequency_hz)
    frequency_hz = curve.frequency_hz[order]
    if frequency_hz[0] < 0.0 or np.any(np.diff(frequency_hz) <= 0.0):
        raise certificate.refusal(key, "a negative frequency, or one twice", "each frequency once")
    if np.any(curve.magnitude <= 0.0):
        raise certificate.refusal(key, f"{curve.magnitude.min():g}", "magnitudes above 0")
    columns = curve.magnitude, curve.phase_rad, curve.u_magnitude, curve.u_phase_rad
    return ResponseTable(frequency_hz, *(column[order] for column in columns))


def read_chain(path: Path) -> Chain:
    """Read the elements of a chain; raises `InputError`."""
    return validate(Chain, read_toml(path), path)


def read_table(path: Path) -> ResponseTable:
    """Read a response table; raises `InputError` for a missing column and a cell that is no number."""
    try:
        reader = csv.DictReader(read_text(path, LARGEST_TABLE, "a table").splitlines())
        names, rows = tuple(reader.fieldnames or ()), list(reader)
    except csv.Error as error:
        raise InputError(path, "", found=str(error), expected="a table in UTF-8 text") from error
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        found = f"columns {describe(', '.join(map(str, names)), plain=True) or 'none'}"
        raise InputError(path, missing[0], found=found, expected="this column")
    columns = {name: np.full(len(rows), np.nan) for name in COLUMNS}
    for name, values in columns.items():
        for line, row in enumerate(rows):
            with suppress(TypeError, ValueError):
                values[line] = float(row[name])
            if not np.isfinite(values[line]) or wrong_size(float(values[line])):
                found = f'"{describe(row[name] or "", plain=True)}" in line {line + 2}'
                expected = wrong_size(float(values[line])) or "one finite number per row"
                raise InputError(path, name, found=found, expected=expected)
    frequency_hz, magnitude = columns["frequency_hz"], columns["magnitude"]
    if len(rows) == 0 or np.any(np.diff(frequency_hz) <= 0.0):
        raise InputError(path, "frequency_hz", found="values that do not ascend", expected="ascending frequencies")
    if np.any(magnitude <= 0.0):
        raise InputError(path, "magnitude", found=f"{magnitude.min():g}", expected="positive values")
    for name in ("u_magnitude", "u_phase_rad"):
        if np.any(columns[name] < 0.0):
            raise InputError(path, name, found=f"{columns[name].min():g}", expected="no negative values")
    return ResponseTable(**columns)
