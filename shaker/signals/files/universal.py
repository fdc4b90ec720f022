"""Universal files: time responses and other functions of data set 58, text and binary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shaker._checks import FloatArray, check_shape
from shaker.signals.files.common import checked_rate, chosen, numbers, rate_of_times, reading
from shaker.signals.files.universal_sets import DataSet, FunctionHeader, data_sets, function_header, function_values
from shaker.signals.recording import RawChannel

_TIME_RESPONSE = 1
_KINDS = (
    "general", "time response", "auto spectrum", "cross spectrum", "frequency response", "transmissibility",
    "coherence", "auto correlation", "cross correlation", "power spectral density", "energy spectral density",
    "probability density", "spectrum",
)  # fmt: skip


@dataclass(frozen=True)
class UniversalFunction:
    """A function of data set 58: `value` (N,), real or complex as stored, over `abscissa` (N,).

    `kind` in words ("frequency response", "spectrum", …); `response` and `reference` are node and direction (`12+Z`);
    `unit` is the ordinate's, over that of its denominator where it has one (`(m/s^2)/N`); texts are empty where the
    file says nothing. Frequency responses follow the file's own sign; universal files state none, and exp(+jωt) is
    usual.
    """

    name: str
    kind: str
    abscissa: FloatArray
    value: NDArray[np.float64] | NDArray[np.complex128]
    abscissa_unit: str
    unit: str
    response: str
    reference: str
    titles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_shape("abscissa", self.abscissa, (None,))
        check_shape("value", self.value, (len(self.abscissa),))


def read_universal(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read the time responses of a universal file.

    A channel is called by its response entity name where it has one, else by the label of its ordinate, else by node
    and direction (`12+Z`); names that occur twice get node and direction after them (`Mic 3+X`), and where these do
    not tell them apart either, the place in the file (`Mic #2`). Its unit is the ordinate's units label. Data sets of
    other kinds are passed over. Text headers hold the sampling interval with six digits, so a clock read from them may
    be wrong by several parts in 10⁷; the trigger edges put that right.
    """
    headers = _headers(path)
    present = {name: item for name, item in _named(headers).items() if item[1].kind == _TIME_RESPONSE}
    result = {}
    with path.open("rb") as stream:
        for name in chosen(path, names, present):
            data, head = present[name]
            times, values = function_values(path, stream, data, head)
            where = f'channel "{name}"'
            if head.even:
                rate, start = checked_rate(path, 1.0 / head.step if head.step else sample_rate_hz, where), head.start
            else:
                rate, start = rate_of_times(path, times, where)
            result[name] = RawChannel(numbers(path, name, values), rate, start, head.ordinate.unit)
    return result


def read_universal_functions(path: Path) -> tuple[UniversalFunction, ...]:
    """Read all functions of data set 58 of a universal file: frequency responses, spectra, and time responses."""
    with reading(path):
        headers = _headers(path)
        with path.open("rb") as stream:
            return tuple(
                _function(name, head, *function_values(path, stream, data, head))
                for name, (data, head) in _named(headers).items()
            )


def _headers(path: Path) -> list[tuple[DataSet, FunctionHeader]]:
    """Return the functions of a file without their numbers."""
    with path.open("rb") as stream:
        found = list(data_sets(path, stream))
        if not found:
            raise ValueError(f"{path}: expected data sets of a universal file, found none")
        headers = []
        for data in found:
            if data.kind == 58:
                stream.seek(data.start)
                records = [stream.readline() for _ in range(11)]
                headers.append((data, function_header(path, records, data.line)))
    return headers


def _function(
    name: str, head: FunctionHeader, abscissa: FloatArray, value: NDArray[np.float64] | NDArray[np.complex128]
) -> UniversalFunction:
    """Put a function together."""
    unit = head.ordinate.unit
    if head.denominator.unit:
        unit = f"({unit})/({head.denominator.unit})"
    kind = _KINDS[head.kind] if 0 <= head.kind < len(_KINDS) else f"function type {head.kind}"
    return UniversalFunction(
        name, kind, abscissa, value, head.abscissa.unit, unit, head.response_point, head.reference_point, head.titles
    )


def _named(headers: list[tuple[DataSet, FunctionHeader]]) -> dict[str, tuple[DataSet, FunctionHeader]]:
    """Return the functions by unique names."""
    plain = [head.response_name or head.ordinate.label or head.response_point for _, head in headers]
    full = [
        name if plain.count(name) == 1 else f"{name} {head.response_point}".strip()
        for name, (_, head) in zip(plain, headers, strict=True)
    ]
    return {
        name if full.count(name) == 1 else f"{name} #{i + 1}": item
        for i, (name, item) in enumerate(zip(full, headers, strict=True))
    }
