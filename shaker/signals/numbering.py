"""Numbers of the edges of a periodic trigger: which edge is which period, and which are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import BoolArray, FloatArray, IntArray, check_shape
from shaker.signals.edges import Edges

_CAPTURE = 0.2  # of a period: an edge further from its place is spurious


@dataclass(frozen=True)
class Numbering:
    """Number of every edge (E,), which are kept (E,) as the period's own, and how many were doubled or spurious."""

    number: IntArray
    kept: BoolArray
    doubled: int
    spurious: int

    def __post_init__(self) -> None:
        check_shape("kept", self.kept, self.number.shape)


def number_edges(edges: Edges) -> Numbering:
    """Number the edges by the period that most of them share.

    Of several edges at one place the nearest stays, the others are doubled; those off every place are spurious.
    """
    time = edges.estimate_s
    if len(time) < 3:
        raise ValueError(f"edges: expected at least 3 edges, found {len(time)}")
    period = _period(time, edges.upper_s - edges.lower_s)
    start = period * np.angle(np.mean(np.exp(2j * np.pi * time / period))) / (2.0 * np.pi)
    # The first line is drawn aside by doubled edges; one through the edges that agree with each other is not.
    for _ in range(3):
        number, kept = _assigned((time - start) / period)
        kept = _without_outliers(number, edges, kept)
        own = int(np.count_nonzero(kept))
        if own < 3 or 2 * own < len(time):
            raise ValueError(
                f"edges: expected at least 3 edges of one period and half of all, found {own} of {len(time)}"
            )
        period, start = np.polyfit(number[kept], time[kept], 1)
    near = np.abs((time - start) / period - number) <= _CAPTURE
    doubled = int(np.count_nonzero(~kept & near & np.isin(number, number[kept])))
    return Numbering(number, kept, doubled, int(np.count_nonzero(~kept)) - doubled)


def _assigned(place: FloatArray) -> tuple[IntArray, BoolArray]:
    """Round places to numbers; of several edges with one number the nearest to its place stays."""
    number = np.round(place).astype(np.int64)
    distance = np.abs(place - number)
    kept = distance <= _CAPTURE
    order = np.lexsort((distance, number))
    kept[order[1:][np.diff(number[order]) == 0]] = False
    return number, kept


def _period(time: FloatArray, width: FloatArray) -> float:
    """Return the period with the largest Rayleigh statistic |Σ exp(2πi t/p)| near the commonest gap."""
    gap = np.diff(time)
    tolerance = max(0.02, 1.5 * float(np.median(width)) / float(np.median(gap)))
    ordered = np.sort(gap)
    like = np.searchsorted(ordered, gap * (1.0 + tolerance)) - np.searchsorted(ordered, gap * (1.0 - tolerance))
    best = float(np.max(gap[like >= 0.8 * like.max()]))
    typical = float(np.median(gap[np.abs(gap - best) <= tolerance * best]))
    span = float(time[-1] - time[0])
    count = 2 * int(np.ceil(8.0 * tolerance * span / typical)) + 1
    rate = np.linspace(1.0 - tolerance, 1.0 + tolerance, count) / typical
    coherence = [float(np.abs(np.sum(np.exp(2j * np.pi * f * time)))) for f in rate]
    return 1.0 / float(rate[int(np.argmax(coherence))])


def _without_outliers(number: IntArray, edges: Edges, kept: BoolArray) -> BoolArray:
    """Drop edges far from a straight line through the others: by 6 robust standard deviations and more."""
    resolution = (1.5 if edges.kind == "sampled" else 0.1) * float(np.median(edges.upper_s - edges.lower_s))
    for _ in range(10):
        if np.count_nonzero(kept) < 3:
            break
        line = np.polynomial.Polynomial.fit(number[kept], edges.estimate_s[kept], 1)
        deviation = np.abs(edges.estimate_s - line(number))
        spread = 1.4826 * float(np.median(deviation[kept]))
        stay = kept & (deviation <= max(6.0 * spread, resolution))
        if np.array_equal(stay, kept):
            break
        kept = stay
    return kept
