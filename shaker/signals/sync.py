"""One clock against another by the edges of the trigger that both have recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.notice import Notice
from shaker.signals.clock_line import clock_line
from shaker.signals.edges import Edges, find_edges
from shaker.signals.shift import Shift, by_start_times, decide_shift
from shaker.signals.trigger import TriggerFit, fit_trigger

__all__ = ["ClockTie", "Edges", "TriggerFit", "find_edges", "fit_trigger", "tie_clocks"]

_SAME_PERIOD = 0.01  # relative: clocks differ by less, two triggers by more


@dataclass(frozen=True)
class ClockTie:
    """One clock read on another: t_base = offset_s + rate·t_other, both in seconds from their record's first sample.

    `covariance` (2, 2) of (offset_s, rate); `shift` is the base edge that the other record's edge 0 belongs to,
    `decided_by` what says so; `pairs` edges were seen by both, `middle_s` is the middle of these on the other clock.
    """

    offset_s: float
    rate: float
    covariance: FloatArray
    shift: int
    decided_by: str
    pairs: int
    middle_s: float
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

    `shift` is the number of the base edge that is the other record's edge 0. Where it is not given, it is found
    (`decide_shift`), with `start_difference_s` (how much later the other record started) among the evidence; where
    nothing decides it, `ValueError`. The line is that of `clock_line`.
    """
    if abs(other.period_s / base.period_s - 1.0) > _SAME_PERIOD:
        raise ValueError(
            f"other: expected the trigger period of the base clock, {base.period_s:.6g} s, found {other.period_s:.6g} s"
        )
    decided = decide_shift(base, other, start_difference_s) if shift is None else Shift(shift, "first_edge")
    pairs, _, there = np.intersect1d(base.number, other.number + decided.edges, return_indices=True)
    # Always from the coarser to the finer record, so that exchanged roles give the same tie.
    if _fineness(other) < _fineness(base):
        line = clock_line(other, base, -decided.edges).inverse()
    else:
        line = clock_line(base, other, decided.edges)
    return ClockTie(
        offset_s=line.offset_s,
        rate=line.rate,
        covariance=line.covariance,
        shift=decided.edges,
        decided_by=decided.decided_by,
        pairs=len(pairs),
        middle_s=float(np.mean(other.edge_s[there] if len(pairs) else other.edge_s)),
        notices=_notices(decided, by_start_times(base, other, start_difference_s)),
    )


def _fineness(fit: TriggerFit) -> tuple[float, int, float]:
    """Return a key that orders records: the one with the finer edges first."""
    return fit.resolution_s, fit.edges, fit.start_s


def _notices(decided: Shift, by_start: int | None) -> tuple[Notice, ...]:
    """Tell where start times contradict what decided the shift."""
    if by_start is None or by_start == decided.edges:
        return ()
    text = (
        f"the start times put edge 0 at edge {by_start} of the first clock, {decided.decided_by} at {decided.edges}, "
        "which counts; first_edge states it where that is wrong"
    )
    return (Notice("info", text, "clock"),)
