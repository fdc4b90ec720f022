"""The straight line from one clock to another, from the edges that both have seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape
from shaker.signals.posterior import Posterior, line_posterior
from shaker.signals.rise import fit_resolved
from shaker.signals.trigger import LEAST_JITTER, TriggerFit, straight_line

_LEAST_PAIRS = 4
_DIFFERENCE = np.array([[1.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, -1.0]])


@dataclass(frozen=True)
class ClockLine:
    """t_base = offset_s + rate·t_other with covariance (2, 2) of (offset_s, rate)."""

    offset_s: float
    rate: float
    covariance: FloatArray

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (2, 2))

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return times of the other clock on the base clock."""
        return np.asarray(self.offset_s + self.rate * np.asarray(time_s, dtype=np.float64))

    def u_at(self, time_s: FloatArray) -> FloatArray:
        """Return the standard uncertainty of `at`."""
        t, c = np.asarray(time_s, dtype=np.float64), self.covariance
        return np.asarray(np.sqrt(c[0, 0] + 2.0 * t * c[0, 1] + t**2 * c[1, 1]))

    def inverse(self) -> ClockLine:
        """Return the line with the two clocks exchanged."""
        rate = 1.0 / self.rate
        jacobian = np.array([[-rate, self.offset_s * rate**2], [0.0, -(rate**2)]])
        return ClockLine(-self.offset_s * rate, rate, jacobian @ self.covariance @ jacobian.T)


def clock_line(base: TriggerFit, other: TriggerFit, shift: int) -> ClockLine:
    """Return the line from the other clock to the base clock; `shift` is the base edge that is the other's edge 0.

    The trigger's jitter is the same in both records and cancels in the differences of paired edges; what sampling
    leaves open is not. Where both records give intervals, both lines and the common jitter are estimated together;
    where one resolves its edges, they take the period's place for the other's intervals; where both do, the
    differences are fitted. Two periodic models one by one are the start, and the result where they know more.
    """
    _, here, there = np.intersect1d(base.number, other.number + shift, return_indices=True)
    single = _from_models(base, other, shift)
    if len(here) < _LEAST_PAIRS:
        return single
    if base.kind == other.kind:
        fit_pairs = _from_crossings if base.kind == "resolved" else _from_middles
        paired = fit_pairs(base, other, here, there)
        middle = np.asarray(np.mean(other.edge_s[there]))
        line = paired if paired.u_at(middle) < single.u_at(middle) else single
        if base.kind == "sampled":
            line = _from_intervals(base, other, shift, line, line is paired)
        elif line is single:
            return line
    elif base.kind == "resolved":
        line = _from_one_resolved(base, other, here, there).inverse()
    else:
        line = _from_one_resolved(other, base, there, here)
    return replace(line, covariance=line.covariance + np.diag([(base.open_s**2 + other.open_s**2) / 12.0, 0.0]))


def _from_models(base: TriggerFit, other: TriggerFit, shift: int) -> ClockLine:
    """Compare the two periodic models as if their errors had nothing in common."""
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
    return ClockLine(offset, rate, jacobian @ joint @ jacobian.T)


def _from_middles(base: TriggerFit, other: TriggerFit, here: IntArray, there: IntArray) -> ClockLine:
    """Fit a line to the middles of paired intervals."""
    place, unscale = _scaled(other.edge_s[there])
    return unscale(straight_line(place, base.edge_s[here], 0.3 * base.resolution_s))


def _from_crossings(base: TriggerFit, other: TriggerFit, here: IntArray, there: IntArray) -> ClockLine:
    """Fit a line to paired resolved crossings, free of the trigger's jitter."""
    place, unscale = _scaled(other.crossing_s[there])
    y, x = base.crossing_s[here], other.crossing_s[there]
    phases = [(y - base.lower_s[here]) / base.sample_s, (x - other.lower_s[there]) / other.sample_s]
    fit = fit_resolved(y, place, phases)
    return unscale(Posterior(fit.mean, fit.covariance, fit.scatter_s))


def _from_one_resolved(resolved: TriggerFit, sampled: TriggerFit, here: IntArray, there: IntArray) -> ClockLine:
    """Return the line from the clock with resolved edges to the one with intervals."""
    place, unscale = _scaled(resolved.edge_s[here])
    lower, upper = sampled.lower_s[there], sampled.upper_s[there]
    width = float(np.median(upper - lower))
    start = straight_line(place, (lower + upper) / 2.0, 0.3 * width)
    return unscale(line_posterior(place, lower[None], upper[None], start, LEAST_JITTER * width))


def _from_intervals(base: TriggerFit, other: TriggerFit, shift: int, start: ClockLine, paired: bool) -> ClockLine:
    """Estimate both lines and the common jitter from the intervals of both records.

    The other record's intervals are read on the base clock by `start`; the two lines then differ by what `start`
    lacks.
    """
    numbers = np.union1d(base.number, other.number + shift)
    centre, half = (numbers[0] + numbers[-1]) / 2.0, (numbers[-1] - numbers[0]) / 2.0
    lower, upper = np.full((2, len(numbers)), -np.inf), np.full((2, len(numbers)), np.inf)
    for row, (fit, number) in enumerate(((base, base.number), (other, other.number + shift))):
        at = np.searchsorted(numbers, number)
        lower[row, at], upper[row, at] = fit.lower_s, fit.upper_s
    lower[1], upper[1] = start.at(lower[1]), start.at(upper[1])
    to_middle = np.array([[1.0, centre], [0.0, half]])
    line = to_middle @ np.array([base.start_s, base.period_s])
    own = to_middle @ base.covariance @ to_middle.T
    over = np.array([[1.0, other.time_s(centre - shift)], [0.0, half * other.period_s]])
    difference = over @ start.covariance @ over.T
    cross, second = (own, own + difference) if paired else (np.zeros((2, 2)), difference - own)
    covariance = np.block([[own, cross], [cross, second]])
    jitter = max(base.jitter_s, other.jitter_s)
    place = (numbers - centre) / half
    found = line_posterior(
        place,
        lower,
        upper,
        Posterior(np.tile(line, 2), covariance, jitter),
        LEAST_JITTER * base.resolution_s,
    )
    shifted, tilted = _DIFFERENCE @ found.mean
    # On the base clock: later by shifted + tilted·(time - line[0]) / line[1].
    stretch = 1.0 + tilted / line[1]
    offset = shifted - tilted * line[0] / line[1] + stretch * start.offset_s
    jacobian = np.array([[1.0, (start.offset_s - line[0]) / line[1]], [0.0, start.rate / line[1]]])
    covariance = jacobian @ _DIFFERENCE @ found.covariance @ _DIFFERENCE.T @ jacobian.T
    return ClockLine(float(offset), float(stretch * start.rate), covariance)


def _scaled(time: FloatArray) -> tuple[FloatArray, Callable[[Posterior], ClockLine]]:
    """Return times as places within ±1, and what turns a line over places into one over times."""
    centre, half = (time[0] + time[-1]) / 2.0, (time[-1] - time[0]) / 2.0
    jacobian = np.array([[1.0, -centre / half], [0.0, 1.0 / half]])

    def unscale(line: Posterior) -> ClockLine:
        offset, rate = jacobian @ line.mean
        return ClockLine(float(offset), float(rate), jacobian @ line.covariance @ jacobian.T)

    return (time - centre) / half, unscale
