"""One clock against another by the edges of the trigger that both have recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.notice import Notice
from shaker.signals.edges import Edges, find_edges
from shaker.signals.trigger import TriggerFit, fit_trigger

__all__ = ["ClockTie", "Edges", "TriggerFit", "find_edges", "fit_trigger", "tie_clocks"]

_GAP_MATCH = 0.8  # share of the missing edges that must be missing in both records for gaps to decide the shift
_START_MATCH = 0.25  # of a period: how well start times must agree with a whole number of periods


@dataclass(frozen=True)
class ClockTie:
    """One clock read on another: t_base = offset_s + rate·t_other, both in seconds from their record's first sample.

    `covariance` (2, 2) of (offset_s, rate); `shift` is the base edge that the other record's edge 0 belongs to.
    """

    offset_s: float
    rate: float
    covariance: FloatArray
    shift: int
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (2, 2))

    def to_base_s(self, time_s: FloatArray) -> FloatArray:
        """Return times of the other clock on the base clock."""
        return np.asarray(self.offset_s + self.rate * np.asarray(time_s, dtype=np.float64))

    def u_to_base_s(self, time_s: FloatArray) -> FloatArray:
        """Return the standard uncertainty of `to_base_s`."""
        t, c = np.asarray(time_s, dtype=np.float64), self.covariance
        return np.asarray(np.sqrt(c[0, 0] + 2.0 * t * c[0, 1] + t**2 * c[1, 1]))


def tie_clocks(
    base: TriggerFit, other: TriggerFit, shift: int | None = None, *, start_difference_s: float | None = None
) -> ClockTie:
    """Tie another DAQ's clock to the base clock by the trigger both have recorded: t_base = offset_s + rate·t_other.

    `shift` is the number of the base edge that is the other record's edge 0. Where it is not given, it follows from
    burst starts and ends seen in the records, from gaps that both show, or from `start_difference_s` (how much later
    the other record started, good to a quarter period); if more than one shift fits, `ValueError`.
    """
    if abs(other.period_s / base.period_s - 1.0) > 0.01:
        raise ValueError(
            f"other: expected the trigger period of the base clock, {base.period_s:.6g} s, found {other.period_s:.6g} s"
        )
    if shift is None:
        shift = decide_shift(base, other, start_difference_s)
    rate = base.period_s / other.period_s
    offset = base.start_s + shift * base.period_s - rate * other.start_s
    jacobian = np.array(
        [
            [1.0, shift - other.start_s / other.period_s, -rate, rate * other.start_s / other.period_s],
            [0.0, 1.0 / other.period_s, 0.0, -rate / other.period_s],
        ]
    )
    joint = np.zeros((4, 4))
    joint[:2, :2], joint[2:, 2:] = base.covariance, other.covariance
    tie = ClockTie(offset, rate, jacobian @ joint @ jacobian.T, shift, ())
    paired = _paired(base, other, shift)
    return paired if paired is not None and _u_middle(paired, other) < _u_middle(tie, other) else tie


def decide_shift(base: TriggerFit, other: TriggerFit, start_difference_s: float | None = None) -> int:
    """Return which base edge the other record's edge 0 is, or raise `ValueError` where that stays open."""
    low, high = _bounds(base, other)
    if low == high:
        return low
    if low > high:  # an end of the burst is damaged in one record
        low, high = high, low
    by_gaps = _shift_by_gaps(base, other, low, high)
    if by_gaps is not None:
        return by_gaps
    if start_difference_s is not None:
        exact = (other.start_s + start_difference_s - base.start_s) / base.period_s
        if abs(exact - round(exact)) <= _START_MATCH and low <= round(exact) <= high:
            return round(exact)
    raise ValueError(
        f"shift: expected burst start, burst end, gaps or start times to say which edges belong together, found "
        f"{high - low + 1} whole-period shifts from {low} to {high} that fit {base.edges} and {other.edges} edges; "
        f"give first_edge"
    )


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


def _shift_by_gaps(base: TriggerFit, other: TriggerFit, low: int, high: int) -> int | None:
    """Return the one shift in the range at which the missing edges of both records coincide, else None."""
    matching = []
    for shift in range(low, high + 1):
        first, last = max(0, shift), min(base.edges, other.edges + shift) - 1
        here = {i for i in base.missing if first <= i <= last}
        there = {i + shift for i in other.missing if first <= i + shift <= last}
        overlap = last - first + 1
        if here & there and len(here & there) >= _GAP_MATCH * len(here | there) and 2 * overlap >= other.edges:
            matching.append(shift)
    return matching[0] if len(matching) == 1 else None


def _paired(base: TriggerFit, other: TriggerFit, shift: int) -> ClockTie | None:
    """Tie the clocks by the single edges of both records, which is better where the trigger itself jitters much."""
    _, here, there = np.intersect1d(base.number, other.number + shift, return_indices=True)
    if len(here) < 3:
        return None
    y, x = base.edge_s[here], other.edge_s[there]
    columns = np.stack([np.ones_like(x), x - x.mean()], axis=1)
    inverse = np.linalg.inv(columns.T @ columns)
    middle, rate = inverse @ columns.T @ y
    residual = y - columns @ np.array([middle, rate])
    variance = float(residual @ residual) / (len(x) - 2)
    jacobian = np.array([[1.0, -x.mean()], [0.0, 1.0]])
    covariance = variance * jacobian @ inverse @ jacobian.T
    return ClockTie(float(middle - rate * x.mean()), float(rate), covariance, shift, ())


def _u_middle(tie: ClockTie, other: TriggerFit) -> float:
    """Return the standard uncertainty of the tie in the middle of the other record's edges."""
    return float(tie.u_to_base_s(other.time_s(np.asarray(other.edges // 2))))
