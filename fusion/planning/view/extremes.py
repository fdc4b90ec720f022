"""Extremes of a channel in blocks, so that every zoom shows every peak."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import FloatArray, IntArray

FINEST = 64  # samples of the smallest block
COARSER = 8  # blocks in one of the next level
PARTS = 8  # least number of blocks of a column: its ends are exact within an eighth
PLAIN = 2  # samples per column up to which the samples are returned


@dataclass(frozen=True)
class ExtremeColumns:
    """Extremes of consecutive samples in columns.

    Column i is from `edge[i]` to `edge[i + 1]` (I + 1,), exclusive. `low`, `high` (I,): its smallest and largest
    sample.
    """

    edge: IntArray
    low: FloatArray
    high: FloatArray


class Extremes:
    """Smallest and largest samples of the blocks of one channel, level by level.

    They need 1/28 of its memory. Lost samples (NaN) hide no others of their block.

    >>> import numpy as np
    >>> found = Extremes(np.sin(np.arange(100_000.0))).columns(0, 100_000, 50)
    >>> len(found.low), round(float(found.high.min()), 3)
    (49, 1.0)
    """

    def __init__(self, samples: FloatArray) -> None:
        self.samples = samples
        self.levels: list[tuple[int, FloatArray, FloatArray]] = []
        low, high, block = samples, samples, FINEST
        factor = FINEST
        while len(low) > factor:
            first = np.arange(0, len(low), factor)
            low, high = np.fmin.reduceat(low, first), np.fmax.reduceat(high, first)
            self.levels.append((block, low, high))
            factor, block = COARSER, block * COARSER

    def columns(self, first: int, last: int, most: int) -> ExtremeColumns:
        """Return the extremes of samples `first` to `last` (exclusive) in at most `most` columns.

        Columns end at the ends of blocks. The outermost ones may extend beyond, by less than a column.
        """
        first = min(max(first, 0), len(self.samples) - 1)
        last = min(max(last, first + 1), len(self.samples))
        width = (last - first) / most
        if width <= PLAIN:
            plain = self.samples[first:last]
            return ExtremeColumns(np.arange(first, last + 1), plain, plain)
        block, low, high = 1, self.samples, self.samples
        for level in self.levels:
            if level[0] * PARTS <= width:
                block, low, high = level
        begin, end = first // block, -(-last // block)
        each = -(-(end - begin) // most)
        starts = np.arange(begin, end, each)
        edge = np.append(starts, end) * block
        part = slice(begin, end)
        lowest = np.fmin.reduceat(low[part], starts - begin)
        highest = np.fmax.reduceat(high[part], starts - begin)
        return ExtremeColumns(np.minimum(edge, len(self.samples)), lowest, highest)
