"""Which samples of a record are fitted: all of them about the release, means of blocks elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape

BLOCKS_PER_PERIOD = 12  # blocks in a period of the fastest mode: its mean over one loses 1 % of it, sinc(1/12)
_RESTS = 40  # blocks of what comes before the release


@dataclass(frozen=True)
class Samples:
    """Means of neighbouring samples: block b is the mean `value` (B,) of `length` (B,) samples.

    They are `step_s` apart and the first of them is taken at `time_s` (B,). Noise of white samples stays white, with
    1/√length of its standard deviation, and what a pole answers stays an exponential, so nothing is filtered away
    and no filter has to be modelled.
    """

    time_s: FloatArray
    length: IntArray
    value: FloatArray
    step_s: float

    def __post_init__(self) -> None:
        check_shape("time_s", self.time_s, (None,))
        check_shape("length", self.length, self.time_s.shape)
        check_shape("value", self.value, self.time_s.shape)

    @cached_property
    def lengths(self) -> tuple[IntArray, IntArray]:
        """Lengths (L,) that occur, and which of them every block has (B,)."""
        sizes, place = np.unique(self.length, return_inverse=True)
        return sizes, place

    @cached_property
    def weight(self) -> FloatArray:
        """Reciprocal standard deviation (B,) of a mean over that of a sample: √length."""
        return np.sqrt(self.length.astype(np.float64))

    def between(self, from_s: float, to_s: float) -> Samples:
        """Return the blocks that begin in a stretch of time."""
        kept = (self.time_s >= from_s) & (self.time_s <= to_s)
        return Samples(self.time_s[kept], self.length[kept], self.value[kept], self.step_s)


def every_sample(value: FloatArray, time_s: FloatArray, step_s: float) -> Samples:
    """Return samples (N,) at times (N,) as blocks of one."""
    return Samples(time_s, np.ones(len(time_s), dtype=np.int64), value, step_s)


def in_blocks(whole: Samples, fine_from_s: float, fine_to_s: float, length: int) -> Samples:
    """Return samples one by one between two times, as means of `length` after them, as means of many before them."""
    first, last = np.searchsorted(whole.time_s, [fine_from_s, fine_to_s])
    ahead = _edges(0, int(first), max(1, int(first) // _RESTS))
    after = _edges(int(last), len(whole.value), length)
    edges = np.concatenate([ahead, np.arange(first, last), after, [len(whole.value)]]).astype(np.int64)
    lengths = np.diff(edges)
    means = np.add.reduceat(whole.value, edges[:-1]) / lengths
    return Samples(whole.time_s[edges[:-1]], lengths, means, whole.step_s)


def _edges(start: int, stop: int, length: int) -> IntArray:
    """Return where blocks of a length begin; what is left over is the first one."""
    if stop <= start:
        return np.zeros(0, dtype=np.int64)
    places = np.arange(stop - length, start, -length, dtype=np.int64)[::-1]
    return np.concatenate([np.array([start], dtype=np.int64), places[places > start]])


def block_length(sample_rate_hz: float, highest_hz: float) -> int:
    """Return how many samples a block after the release takes, twelve blocks in the period of the fastest mode."""
    return max(1, int(sample_rate_hz / (BLOCKS_PER_PERIOD * highest_hz)))
