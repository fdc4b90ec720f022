"""Camera trigger and clocks: the periodic model of the edges, and one clock against another by the same edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape
from shaker.notice import Notice
from shaker.signals.edges import Edges

__all__ = ["ClockTie", "Edges", "TriggerFit"]


@dataclass(frozen=True)
class TriggerFit:
    """Periodic model t_k = start_s + k·period_s of a trigger, in seconds from the record's first sample.

    `number` (E,): count of each edge kept (0 = first), `edge_s` (E,) their own estimates; `covariance` (2, 2) of
    (start_s, period_s); `jitter_s` standard deviation of the edges about the model beyond what sampling explains;
    `missing` numbers without an edge, `spurious` edges dropped. `idle_before`, `idle_after`: the record shows that the
    burst begins or ends here. `resolution_s`: width of an edge's interval.
    """

    start_s: float
    period_s: float
    number: IntArray
    edge_s: FloatArray
    covariance: FloatArray
    jitter_s: float
    missing: tuple[int, ...]
    spurious: int
    idle_before: bool
    idle_after: bool
    resolution_s: float
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        check_shape("number", self.number, (None,))
        check_shape("edge_s", self.edge_s, self.number.shape)
        check_shape("covariance", self.covariance, (2, 2))

    @property
    def edges(self) -> int:
        """Number of edges from the first to the last, missing ones counted."""
        return int(self.number[-1]) + 1

    def time_s(self, number: IntArray) -> FloatArray:
        """Return the modelled times of the edges numbered (any shape), seconds from the record's first sample."""
        return np.asarray(self.start_s + self.period_s * np.asarray(number, dtype=np.float64))

    def u_time_s(self, number: IntArray) -> FloatArray:
        """Return the standard uncertainty of `time_s` from the fit (the single edge's jitter is not in it)."""
        k = np.asarray(number, dtype=np.float64)
        c = self.covariance
        return np.asarray(np.sqrt(c[0, 0] + 2.0 * k * c[0, 1] + k**2 * c[1, 1]))


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
