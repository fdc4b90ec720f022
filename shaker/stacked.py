"""Channels that share one memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shakercal._common.arrays import BoolArray, FloatArray, IntArray, check_shape


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
