"""Sampling times of a record, cut into blocks whose phases are exact however long the record is."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise

import numpy as np

from shaker._checks import BoolArray, FloatArray, IntArray

LONG = 1 << 17  # samples from which a record is never copied, and its residual never held
_BLOCKS = 2048  # blocks of a long record
_SHORT_BLOCK = 2048  # samples in a block of a short one
_ROUNDING = 8.0  # units in the last place by which the times of a uniform grid may be off


@dataclass(frozen=True)
class UniformTimes:
    """Times `start_s` + i / `rate_hz`, i < `samples`, in place of an array that would hold them."""

    start_s: float
    rate_hz: float
    samples: int

    def __len__(self) -> int:
        return self.samples

    def array(self) -> FloatArray:
        """Return the times (S,) written out."""
        return np.asarray(self.start_s + np.arange(self.samples) / self.rate_hz)


Times = FloatArray | UniformTimes


@dataclass(frozen=True)
class _Grid:
    """A uniform grid: sample i at `start_s` + i·`interval_s`, both exact; block centres at samples `centre` (B,)."""

    start_s: Fraction
    interval_s: Fraction
    middle: int
    centre: IntArray


@dataclass(frozen=True)
class Timeline:
    """Times of S samples in B blocks: t = `middle_s` + `centre_s[b]` + local time.

    `edges` (B + 1,) rows at which blocks begin; `local_s` one block's local times where the sampling is uniform
    (`grid`), those of all samples (S,) where it is not.
    """

    edges: IntArray
    middle_s: float
    centre_s: FloatArray
    local_s: FloatArray
    grid: _Grid | None

    @property
    def samples(self) -> int:
        """Number of samples."""
        return int(self.edges[-1])

    def rows(self, block: int) -> slice:
        """Return the rows of a block."""
        return slice(int(self.edges[block]), int(self.edges[block + 1]))

    def local(self, block: int) -> FloatArray:
        """Return the local times of a block's samples, counted from its centre."""
        rows = self.rows(block)
        return self.local_s[: rows.stop - rows.start] if self.grid else self.local_s[rows]

    def is_full(self, block: int) -> bool:
        """Tell whether a block has the same local times as all other full ones."""
        return self.grid is not None and self.edges[block + 1] - self.edges[block] == len(self.local_s)

    def turns(self, frequency_hz: float) -> FloatArray:
        """Return the periods (B,) from the middle of the record to the centre of each block, whole ones taken off.

        On a grid by a phase accumulator of 64 bits (as in a numerically controlled oscillator): 3·10⁶ samples leave
        no more than 10⁻¹² rad.
        """
        if self.grid is None:
            return np.mod(frequency_hz * self.centre_s, 1.0)
        step = round(Fraction(frequency_hz) * self.grid.interval_s % 1 * 2**64) % 2**64
        places = (self.grid.centre - self.grid.middle).view(np.uint64)
        return np.asarray((places * np.array([step], dtype=np.uint64)) / 2.0**64, dtype=np.float64)

    def middle_turns(self, frequency_hz: float) -> float:
        """Return the periods from time zero to the middle of the record, whole ones taken off."""
        if self.grid is None:
            return float(np.mod(frequency_hz * self.middle_s, 1.0))
        middle = self.grid.start_s + self.grid.middle * self.grid.interval_s
        return float(Fraction(frequency_hz) * middle % 1)


def timeline(times: Times, kept: BoolArray | None) -> Timeline:
    """Return the blocks of a record; long ones that are uniform but for rounding become a grid."""
    if isinstance(times, UniformTimes):
        return _on_grid(Fraction(times.start_s), 1 / Fraction(times.rate_hz), times.samples)
    grid = _uniform(times) if len(times) > LONG else None
    if grid is not None:
        return _on_grid(*grid, len(times))
    edges = _edges(len(times))
    middle = float(np.mean(times if kept is None else times[kept]))
    local = times - middle
    centre = np.array([local[a:b].mean() for a, b in pairwise(edges)])
    local -= np.repeat(centre, np.diff(edges))
    return Timeline(edges, middle, centre, local, None)


def _edges(samples: int) -> IntArray:
    """Return the rows (B + 1,) at which blocks begin and the last one ends."""
    length = min(samples, _SHORT_BLOCK) if samples <= LONG else -(-samples // _BLOCKS)
    return np.append(np.arange(0, samples, max(length, 1)), samples).astype(np.int64)


def _on_grid(start_s: Fraction, interval_s: Fraction, samples: int) -> Timeline:
    """Return the blocks of a uniform grid."""
    edges = _edges(samples)
    length = int(edges[1])
    middle = (samples - 1) // 2
    centre = edges[:-1] + length // 2
    interval = float(interval_s)
    local = np.asarray((np.arange(length) - length // 2) * interval, dtype=np.float64)
    grid = _Grid(start_s, interval_s, middle, centre)
    centre_s = np.asarray((centre - middle) * interval, dtype=np.float64)
    return Timeline(edges, float(start_s + middle * interval_s), centre_s, local, grid)


def _uniform(time_s: FloatArray) -> tuple[Fraction, Fraction] | None:
    """Return start and interval of the grid from which only rounding separates the times; None if something else does.

    The line through the deviations is added exactly, so that what rounding did to single times averages out.
    """
    samples = len(time_s)
    start, interval = float(time_s[0]), float(time_s[-1] - time_s[0]) / (samples - 1)
    tolerance = _ROUNDING * float(np.spacing(max(abs(float(time_s[0])), abs(float(time_s[-1])))))
    if not interval > 0.0:
        return None
    half = (samples - 1) / 2.0
    total = moment = 0.0
    for first in range(0, samples, LONG):
        index = np.arange(first, min(first + LONG, samples))
        deviation = time_s[index[0] : index[-1] + 1] - (start + interval * index)
        if not np.max(np.abs(deviation)) <= tolerance:
            return None
        total += float(np.sum(deviation))
        moment += float(deviation @ (index - half))
    slope = moment / (samples * (samples**2 - 1.0) / 12.0)
    first_s = Fraction(start) + Fraction(total / samples) - Fraction(slope) * Fraction(half)
    return first_s, Fraction(interval) + Fraction(slope)
