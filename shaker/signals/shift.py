"""Which edges of two records belong together: the whole-period shift and what decides it."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from shaker._checks import FloatArray
from shaker.signals.trigger import TriggerFit

_GAP_MATCH = 0.8  # share of the missing edges that must be missing in both records for gaps to decide the shift
_GAP_CHANCE = 1e-3  # probability of as many coincidences at any shift by chance, where gaps lie outside the overlap
_START_MATCH = 0.25  # of a period: how well start times must agree with a whole number of periods
_JITTER_EDGES = 20
_JITTER_SHARE = 0.4  # of an edge's interval: jitter that rises above the pattern which sampling makes
_JITTER_RESOLVED = 0.1  # of a sample: the interval that the unknown shape of a resolved rise may leave
_JITTER_SCORE = 6.0  # standard deviations by which one shift's correlation of the jitter must stand out
_JITTER_RIVAL = 0.6  # of the best shift's correlation: largest that any other shift may reach


@dataclass(frozen=True)
class Shift:
    """Which base edge the other record's edge 0 is, and what decided that, in words."""

    edges: int
    decided_by: str


def decide_shift(base: TriggerFit, other: TriggerFit, start_difference_s: float | None = None) -> Shift:
    """Return which base edge the other record's edge 0 is.

    Burst starts and ends that the records show leave a range of shifts; where it is more than one, gaps that both
    show, the jitter that both saw, or start times (good to a quarter period) choose among them. Where start and end
    contradict each other, because edges are lost at an end, the same three choose. `ValueError` where none does.
    """
    low, high = _bounds(base, other)
    if low == high:
        return Shift(low, _burst_evidence(base, other))
    between = (low, high) if low < high else (high, low)
    for shift, name in (
        (_by_gaps(base, other, *between), "gaps"),
        (_by_jitter(base, other, *between), "jitter"),
        (by_start_times(base, other, start_difference_s), "start times"),
    ):
        if shift is not None and between[0] <= shift <= between[1]:
            return Shift(shift, name)
    if low > high:
        found = f"{base.edges} and {other.edges} edges whose ends of the burst say {low} and {high}"
    else:
        found = f"{high - low + 1} whole-period shifts from {low} to {high}"
        found += f" that fit {base.edges} and {other.edges} edges"
    raise ValueError(
        f"shift: expected burst start, burst end, gaps or start times to say which edges belong together, found "
        f"{found}; give first_edge"
    )


def by_start_times(base: TriggerFit, other: TriggerFit, start_difference_s: float | None) -> int | None:
    """Return the shift that start times tell, None where they lie between two."""
    if start_difference_s is None:
        return None
    exact = (other.start_s + start_difference_s - base.start_s) / base.period_s
    return round(exact) if abs(exact - round(exact)) <= _START_MATCH else None


def _bounds(base: TriggerFit, other: TriggerFit) -> tuple[int, int]:
    """Return the smallest and largest shift that burst starts and ends allow."""
    difference = base.edges - other.edges
    low, high = 1 - other.edges, base.edges - 1
    if base.idle_before:  # the other record's first edge cannot come before the burst
        low = max(low, 0)
    if other.idle_after:
        low = max(low, difference)
    if other.idle_before:
        high = min(high, 0)
    if base.idle_after:
        high = min(high, difference)
    return low, high


def _burst_evidence(base: TriggerFit, other: TriggerFit) -> str:
    """Name what leaves a single shift."""
    start = base.idle_before and other.idle_before
    end = base.idle_after and other.idle_after
    if start and end:
        return "burst start and end"
    return "burst start" if start else "burst end" if end else "burst length"


def _by_gaps(base: TriggerFit, other: TriggerFit, low: int, high: int) -> int | None:
    """Return the one shift in the range at which the missing edges of both records coincide, else None."""
    matching = []
    for shift in range(low, high + 1):
        first, last = max(0, shift), min(base.edges, other.edges + shift) - 1
        here = {i for i in base.missing if first <= i <= last}
        there = {i + shift for i in other.missing if first <= i + shift <= last}
        both, overlap = len(here & there), last - first + 1
        if not both or both < _GAP_MATCH * len(here | there) or 2 * overlap < other.edges:
            continue
        everything = both >= _GAP_MATCH * max(len(base.missing), len(other.missing))
        if everything or (high - low + 1) * _by_chance(both, overlap, len(here), len(there)) < _GAP_CHANCE:
            matching.append(shift)
    return matching[0] if len(matching) == 1 else None


def _by_chance(both: int, edges: int, here: int, there: int) -> float:
    """Return the probability that at least `both` of two independent sets of missing edges coincide."""
    ways = sum(comb(here, k) * comb(edges - here, there - k) for k in range(both, min(here, there) + 1))
    return ways / comb(edges, there)


def _by_jitter(base: TriggerFit, other: TriggerFit, low: int, high: int) -> int | None:
    """Return the one shift in the range at which the deviations from the period agree, else None."""
    if not (_jitters(base) and _jitters(other)):
        return None
    here, there = _deviations(base), _deviations(other)
    score = np.zeros(high - low + 1)
    for i, shift in enumerate(range(low, high + 1)):
        first, last = max(0, shift), min(base.edges, other.edges + shift)
        if last - first < _JITTER_EDGES:
            continue
        a, b = here[first:last], there[first - shift : last - shift]
        norm = float(np.sqrt((a @ a) * (b @ b)))
        score[i] = float(a @ b) / norm * np.sqrt(np.count_nonzero(a * b)) if norm > 0.0 else 0.0
    best = int(np.argmax(score))
    rivals = np.delete(score, best)
    stands_out = score[best] > _JITTER_SCORE and np.all(rivals < _JITTER_RIVAL * score[best])
    return low + best if stands_out else None


def _jitters(fit: TriggerFit) -> bool:
    """Tell whether the jitter rises above what sampling and the shape of the rise do to an edge."""
    least = 1.0 if fit.kind == "sampled" else _JITTER_RESOLVED
    return fit.jitter_s > _JITTER_SHARE * max(fit.resolution_s, least * fit.sample_s)


def _deviations(fit: TriggerFit) -> FloatArray:
    """Return every edge's deviation from the model (edges,), 0 where it is missing."""
    deviation = np.zeros(fit.edges)
    deviation[fit.number] = fit.edge_s - fit.time_s(fit.number)
    return deviation
