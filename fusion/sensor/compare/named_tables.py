"""Tables of other laboratories in a comparison: columns, repeated frequencies, uncertainties by a formula."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from fusion.errors import InputError
from fusion.recording.dsi import parse_unit
from fusion.recording.manifest import ResponseColumns
from fusion.recording.response import named_columns, without_repeats
from fusion.recording.toml import read_toml, validate
from fusion.recording.values import ManifestBlock, Text, Version
from fusion.sensor import result_notices as declared
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

EQUAL_SHARES = 0.01
"""Relative difference of equal ratios of u and value: measured ones of N repeats scatter by 1/√(2N − 2)."""
MOST_SHARES = 2.0 / 3.0
"""Share of the points from which on equal ratios are a formula: chosen, far above chance."""
FEWEST_POINTS = 6


class ComparedColumns(ResponseColumns):
    """Columns of a table in a comparison, and the element that it describes."""

    KEY: ClassVar[str] = "columns"

    channel: Text = "output"
    component: Text = "input"


class ComparedTables(ManifestBlock):
    """The file of `--columns`: columns of all tables, and of single results where they differ."""

    format: Version = 1
    columns: ComparedColumns | None = None
    columns_of: dict[str, ComparedColumns] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, values: Any) -> Any:
        """Complete the columns of single results by those of all."""
        of_all, of_one = values.get("columns", {}), values.get("columns_of", {})
        if not isinstance(of_all, dict) or not isinstance(of_one, dict):
            return values
        complete = {name: of_all | keys if isinstance(keys, dict) else keys for name, keys in of_one.items()}
        return values | {"columns_of": complete}


@dataclass(frozen=True)
class NamedTable:
    """Values over frequency (K,) of a table, repeats averaged, with standard uncertainties.

    Attributes
    ----------
    columns : its columns.
    unit : str
        Unit of the magnitudes.
    repeats : int
        Largest number of rows at one frequency.
    """

    columns: ComparedColumns
    unit: str
    frequency_hz: FloatArray
    magnitude: FloatArray
    phase_rad: FloatArray
    u_magnitude: FloatArray
    u_phase_rad: FloatArray
    repeats: int
    notices: tuple[Notice, ...]


def read_tables(path: Path, names: Collection[str]) -> ComparedTables:
    """Read a file of `--columns`.

    Raises `InputError` for errors, or for a result that is not compared.
    """
    found = validate(ComparedTables, read_toml(path), path)
    for name in found.columns_of:
        if name not in names:
            raise InputError(
                declared.WRONG_COMPARISON_OPTION, path, f"columns_of.{name}", found=name, expected=", ".join(names)
            )
    return found


def read_named_table(name: str, path: Path, columns: ComparedColumns) -> NamedTable:
    """Read a table by the names of its columns.

    Rows may be in any order, repeats are averaged. Raises `InputError` for a missing column, or a cell without a
    usable number.
    """
    values = named_columns(path, columns)
    for column, least, numbers in zip(columns.names, (0.0, 0.0, None, 0.0, 0.0), values, strict=True):
        if least is not None and np.any(numbers <= least):
            row = int(np.argmax(numbers <= least))
            raise InputError(
                declared.WRONG_RESULT_CELL,
                path,
                column,
                found=f"{numbers[row]:g}",
                expected="a number above 0",
                line=row + 2,
            )
    unit = columns.magnitude_unit or "1"
    factor = 1.0 if columns.magnitude_unit is None else parse_unit(unit).factor
    averaged = without_repeats(values)
    frequency_hz, magnitude, phase, u_magnitude, u_phase = averaged
    return NamedTable(
        columns,
        unit,
        frequency_hz,
        magnitude / factor,
        phase,
        u_magnitude / factor,
        u_phase,
        repeats=int(np.max(np.diff(np.searchsorted(np.sort(values[0]), [*frequency_hz * (1.0 - 2e-6), np.inf])))),
        notices=_by_a_formula(name, values, columns.k),
    )


def _by_a_formula(name: str, values: list[FloatArray], k: float) -> tuple[Notice, ...]:
    """Return a notice if k·u of most points is the same share of the value."""
    _, magnitude, _, u_magnitude, _ = values
    share = np.sort(u_magnitude / magnitude)
    ends = np.searchsorted(share, share * (1.0 + EQUAL_SHARES), "right")
    begin = int(np.argmax(ends - np.arange(len(share))))
    count = int(ends[begin] - begin)
    if len(share) < FEWEST_POINTS or count < MOST_SHARES * len(share):
        return ()
    percent = 100.0 * k * float(np.median(share[begin : ends[begin]]))
    return (
        Notice(declared.UNCERTAINTY_BY_FORMULA, name, result=name, percent=percent, count=count, points=len(share)),
    )
