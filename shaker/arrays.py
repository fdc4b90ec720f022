"""Array types, checks of shapes, and channels that share one memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

__version__ = "0.2.0"  # as in pyproject.toml: to look for the installed one takes longer than many a module

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
MAX_SHOWN_CHARACTERS = 60
"""Characters of a value that a result shows when it is printed in Python."""


@dataclass(frozen=True, eq=False)
class Stacked:
    """Channels (S, C) stored as separate columns and combined only for the requested rows.

    Each channel is a column times its factor. `rows` (S,) selects rows of the columns; None selects all.
    """

    columns: tuple[FloatArray, ...]
    factors: tuple[float, ...]
    rows: IntArray | None = None
    ndim = 2

    @staticmethod
    def from_array(values: FloatArray | Stacked) -> Stacked:
        """Return the columns of an array (S,) or (S, C); `ValueError` for any other."""
        if isinstance(values, Stacked):
            return values
        array = values[:, None] if values.ndim == 1 else values
        check_shape("values", array, (None, None))
        return Stacked(tuple(array.T), (1.0,) * array.shape[1])

    @property
    def shape(self) -> tuple[int, int]:
        """Number of samples and of channels."""
        every = len(self.columns[0]) if self.columns else 0
        return every if self.rows is None else len(self.rows), len(self.columns)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> FloatArray:
        """Return rows (R, C) of all channels."""
        selected = rows if self.rows is None else self.rows[rows]
        values = np.empty((len(range(*rows.indices(len(self)))), len(self.columns)))
        for c, (column, factor) in enumerate(zip(self.columns, self.factors, strict=True)):
            np.multiply(column[selected], factor, out=values[:, c])
        return values

    def iterate_channels(self) -> Iterator[FloatArray]:
        """Yield the channels (S,) in their order."""
        for column, factor in zip(self.columns, self.factors, strict=True):
            samples = column if self.rows is None else column[self.rows]
            yield np.ascontiguousarray(samples if factor == 1.0 else samples * factor, dtype=np.float64)

    def iterate_row_blocks(self) -> Iterator[FloatArray]:
        """Yield blocks of rows (R, C) in their order."""
        for first in range(0, len(self), _ROWS):
            yield self[first : first + _ROWS]

    def select(self, chosen: Sequence[int]) -> Stacked:
        """Return some of the channels."""
        columns, factors = zip(*((self.columns[c], self.factors[c]) for c in chosen), strict=True)
        return replace(self, columns=columns, factors=factors)

    def select_rows(self, rows: BoolArray | None) -> Stacked:
        """Return the rows (S,) where the mask is true; all rows for None."""
        if rows is None:
            return self
        chosen = np.flatnonzero(rows)
        return replace(self, rows=chosen if self.rows is None else self.rows[chosen])


_ROWS = 1 << 14  # rows processed at a time


def check_shape(name: str, array: NDArray[Any] | Stacked, shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` has `shape`; `None` means any length."""
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        expected = "(" + ", ".join("any" if want is None else str(want) for want in shape) + ")"
        raise ValueError(f"{name}: expected an array of shape {expected}, found {array.shape}")


def check_shapes(owner: Any, shape: tuple[int | None, ...], *names: str) -> None:
    """Raise `ValueError` unless these fields of a data class have `shape`; `None` means any length."""
    for name in names:
        check_shape(name, getattr(owner, name), shape)


def brief(result: Any) -> str:
    """Return a data class as one line: arrays by their shape, collections by their length."""
    shown = []
    for field in fields(result):
        value: Any = getattr(result, field.name, None)
        if hasattr(value, "shape"):
            text = f"array {value.shape}"
        elif isinstance(value, tuple | dict) and len(repr(value)) > MAX_SHOWN_CHARACTERS:
            text = f"{len(value)} of {type(value).__name__}"
        else:
            text = repr(value) if len(repr(value)) <= MAX_SHOWN_CHARACTERS else type(value).__name__
        shown.append(f"{field.name}={text}")
    return f"{type(result).__name__}({', '.join(shown)})"


class Brief:
    """Base of data classes with arrays that print on one line: `@dataclass(frozen=True, repr=False)`."""

    __repr__ = brief
