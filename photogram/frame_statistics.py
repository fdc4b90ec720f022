"""Statistics over frames that arrive in blocks, and evenly spread choices of frames."""

from __future__ import annotations

import numpy as np

from shakercal._common.arrays import BoolArray, FloatArray, IntArray

GOLDEN = (5.0**0.5 - 1.0) / 2.0  # the golden ratio, least approximable by fractions


def spread_choice(numbers: IntArray, share: float) -> BoolArray:
    """Return which of some numbers are chosen, `share` of them, evenly and without a period.

    By the golden ratio.
    """
    return np.asarray(numbers * GOLDEN % 1.0 < share)


class RunningMean:
    """Mean over frames of the finite values, independent of how the frames are divided.

    It has the digits of `values.sum(axis=0)` over all of them.
    """

    def __init__(self) -> None:
        self._total: FloatArray | None = None
        self.count: IntArray = np.zeros((), np.int64)

    def add(self, values: FloatArray) -> None:
        """Add further frames (F, ...)."""
        finite = np.isfinite(values)
        rows = np.where(finite, values, 0.0)
        rows = rows if self._total is None else np.concatenate([self._total[None], rows])  # in the order of the frames
        self._total, self.count = np.asarray(rows.sum(axis=0)), self.count + finite.sum(axis=0)

    @property
    def mean(self) -> FloatArray:
        """The mean so far (...), NaN without a finite value."""
        assert self._total is not None
        return np.asarray(self._total / np.where(self.count > 0, self.count, np.nan))


SAMPLED = 1 << 19  # values of a sample: 4 MB


class Sample:
    """Values of all frames, or of equally spaced ones beyond `SAMPLED` values: for a median."""

    def __init__(self) -> None:
        self._rows: list[FloatArray] = []
        self._every, self._frames = 1, 0

    def add(self, values: FloatArray) -> None:
        """Add further frames (F, ...)."""
        first = -self._frames % self._every
        self._rows += [row.copy() for row in values[first :: self._every]]
        self._frames += len(values)
        while sum(row.size for row in self._rows[:1]) * len(self._rows) > SAMPLED and len(self._rows) > 1:
            self._rows, self._every = self._rows[::2], 2 * self._every

    @property
    def median(self) -> float:
        """Median of the finite values, NaN without any."""
        values = np.array(self._rows)
        values = values[np.isfinite(values)]
        return float(np.median(values)) if len(values) else float("nan")
