"""Tie between two clocks: matching edges, and the straight line between the clocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from shaker.signal_notices import CONTRADICTORY_CLOCK_RATE, START_TIMES_DISAGREE
from shaker.timebase.edges import Posterior, Slopes, line_posterior, normal_cdf
from shaker.timebase.trigger import (
    MAX_DISAGREEMENT_SIGMAS,
    MIN_JITTER_SAMPLES,
    RINGING_SAMPLES,
    TriggerFit,
    fit_resolved,
    fit_straight_line,
)
from shakercal._common.arrays import Arrays, FloatArray, IntArray
from shakercal._common.notices import Notice

# Matching edges of two records: the whole-period shift and its evidence.

_GAP_MATCH = 0.8  # share of the missing edges that must be missing in both records for gaps to decide the shift
_GAP_CHANCE = 1e-3  # probability of as many coincidences at any shift by chance, where gaps lie outside the overlap
_START_MATCH = 0.25  # of a period: how well start times must agree with a whole number of periods
_JITTER_EDGES = 20  # common edges below which jitter decides no shift; chosen
_JITTER_SHARE = 0.4  # of an edge's interval: jitter that rises above the pattern which sampling makes
_JITTER_RESOLVED = 0.1  # of a sample: the interval that the unknown shape of a resolved rise may leave
_JITTER_SCORE = 6.0  # standard deviations by which one shift's correlation of the jitter must exceed zero
_JITTER_RIVAL = 0.6  # of the best shift's correlation: largest that any other shift may reach


def decide_shift(base: TriggerFit, other: TriggerFit, start_difference_s: float | None) -> tuple[int, str]:
    """Return the base edge of the other record's edge 0, with the evidence in words.

    Visible burst starts and ends limit the range of shifts. Where it is more than one, common gaps, the common jitter,
    or start times (good to a quarter period) choose among them. Where start and end contradict each other, because
    edges are lost at an end, the same three choose. `ValueError` where none does.
    """
    low, high = _bounds(base, other)
    if low == high:
        start, end = base.idle_before and other.idle_before, base.idle_after and other.idle_after
        seen = "burst start and end" if start and end else "burst start" if start else "burst end" if end else ""
        return low, seen or "burst length"
    between = (low, high) if low < high else (high, low)
    for shift, name in (
        (_by_gaps(base, other, *between), "gaps"),
        (_by_jitter(base, other, *between), "jitter"),
        (by_start_times(base, other, start_difference_s), "start times"),
    ):
        if shift is not None and between[0] <= shift <= between[1]:
            return shift, name
    if low > high:
        found = f"{base.edges} and {other.edges} edges with shifts from the ends of the burst of {low} and {high}"
    else:
        found = f"{high - low + 1} whole-period shifts from {low} to {high}"
        found += f" that fit {base.edges} and {other.edges} edges"
    raise ValueError(
        f"shift: expected burst start, burst end, gaps or start times that determine the matching edges, found "
        f"{found}; give first_edge"
    )


def by_start_times(base: TriggerFit, other: TriggerFit, start_difference_s: float | None) -> int | None:
    """Return the shift from start times, None where they lie between two."""
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


def _by_gaps(base: TriggerFit, other: TriggerFit, low: int, high: int) -> int | None:
    """Return the only shift in the range at which missing edges coincide, else None."""
    from scipy.stats import hypergeom

    matching = []
    for shift in range(low, high + 1):
        first, last = max(0, shift), min(base.edges, other.edges + shift) - 1
        base_index = {i for i in base.missing if first <= i <= last}
        other_index = {i + shift for i in other.missing if first <= i + shift <= last}
        both, overlap = len(base_index & other_index), last - first + 1
        if not both or both < _GAP_MATCH * len(base_index | other_index) or 2 * overlap < other.edges:
            continue
        everything = both >= _GAP_MATCH * max(len(base.missing), len(other.missing))
        # Probability that at least so many of two independent sets of missing edges coincide.
        chance = hypergeom.sf(both - 1, overlap, len(base_index), len(other_index))
        if everything or (high - low + 1) * chance < _GAP_CHANCE:
            matching.append(shift)
    return matching[0] if len(matching) == 1 else None


def _by_jitter(base: TriggerFit, other: TriggerFit, low: int, high: int) -> int | None:
    """Return the only shift in the range with equal deviations from the period, else None."""
    if not (_has_jitter(base) and _has_jitter(other)):
        return None
    base_index, other_index = _deviations(base), _deviations(other)
    score = np.zeros(high - low + 1)
    for i, shift in enumerate(range(low, high + 1)):
        first, last = max(0, shift), min(base.edges, other.edges + shift)
        if last - first < _JITTER_EDGES:
            continue
        a, b = base_index[first:last], other_index[first - shift : last - shift]
        norm = float(np.sqrt((a @ a) * (b @ b)))
        score[i] = float(a @ b) / norm * np.sqrt(np.count_nonzero(a * b)) if norm > 0.0 else 0.0
    best = int(np.argmax(score))
    rivals = np.delete(score, best)
    unique = score[best] > _JITTER_SCORE and np.all(rivals < _JITTER_RIVAL * score[best])
    return low + best if unique else None


def _has_jitter(fit: TriggerFit) -> bool:
    """Return whether the jitter exceeds the effect of sampling and rise shape on an edge."""
    min_interval = 1.0 if fit.kind == "sampled" else _JITTER_RESOLVED
    return fit.jitter_s > _JITTER_SHARE * max(fit.resolution_s, min_interval * fit.sample_s)


def _deviations(fit: TriggerFit) -> FloatArray:
    """Return every edge's deviation from the model (edges,), 0 where it is missing."""
    deviation = np.zeros(fit.edges)
    deviation[fit.number] = fit.edge_s - fit.time_s(fit.number)
    return deviation


# The straight line from one clock to another, from the edges that both have seen.

_MIN_PAIRS = 4  # common edges below which only the two models are compared
_DIFFERENCE = np.array([[1.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, -1.0]])


@dataclass(frozen=True)
class ClockLine(Arrays, shapes="covariance 2 2; noise 2 2"):
    """Line t_base = offset_s + rate·t_other with covariance (2, 2) of (offset_s, rate).

    Attributes
    ----------
    offset_s, rate : the line.
    covariance : (2, 2), in total.
    noise : (2, 2), part from the samples' noise, which differs in every record.
    follows : (2, 2), response to an error of the base trigger's (start_s, period_s), where available.
    remaining_covariance : (2, 2), covariance of the remaining part.
    """

    offset_s: float
    rate: float
    covariance: FloatArray
    noise: FloatArray = field(default_factory=lambda: np.zeros((2, 2)), kw_only=True)
    follows: FloatArray | None = field(default=None, kw_only=True)
    remaining_covariance: FloatArray | None = field(default=None, kw_only=True, metadata={"dataset": "beside"})

    def to_base_s(self, time_s: FloatArray) -> FloatArray:
        """Return times of the other clock on the base clock."""
        return np.asarray(self.offset_s + self.rate * np.asarray(time_s, dtype=np.float64))

    def u_to_base_s(self, time_s: FloatArray) -> FloatArray:
        """Return the standard uncertainty of `to_base_s`."""
        t, c = np.asarray(time_s, dtype=np.float64), self.covariance
        return np.asarray(np.sqrt(c[0, 0] + 2.0 * t * c[0, 1] + t**2 * c[1, 1]))

    def inverse(self) -> ClockLine:
        """Return the line with the two clocks exchanged."""
        rate = 1.0 / self.rate
        jacobian = np.array([[-rate, self.offset_s * rate**2], [0.0, -(rate**2)]])
        covariance, noise = (jacobian @ part @ jacobian.T for part in (self.covariance, self.noise))
        return ClockLine(-self.offset_s * rate, rate, covariance, noise=noise)


def clock_line(base: TriggerFit, other: TriggerFit, shift: int, rate: tuple[float, float] | None = None) -> ClockLine:
    """Return the line from the other clock to the base clock.

    `shift` is the base edge that is the other's edge 0. The trigger's jitter cancels in the differences of paired
    edges; the uncertainty from sampling does not. Intervals of both records give both lines and the common jitter
    together, resolved edges of one replace the period for the other's intervals, and those of both are fitted by their
    differences. Two separate periodic models are the start, and the result where they are more certain. `rate` is that
    of the clocks with standard uncertainty from another source.
    """
    _, base_index, other_index = np.intersect1d(base.number, other.number + shift, return_indices=True)
    single = _from_models(base, other, shift)
    if len(base_index) < _MIN_PAIRS:
        return single
    if base.kind == other.kind:
        paired = _from_pairs(base, other, base_index, other_index)
        middle = np.asarray(np.mean(other.edge_s[other_index]))
        line = paired if paired.u_to_base_s(middle) < single.u_to_base_s(middle) else single
        if base.kind == "sampled":
            line = _from_intervals(base, other, shift, (line, line is paired), rate)
        elif line is single:
            variance = float(line.u_to_base_s(middle)) ** 2
            common_variance = (base.open_s**2 + other.open_s**2) / 12.0
            sample_share = min(f.resolution_s**2 / (f.resolution_s**2 + 12.0 * f.jitter_s**2) for f in (base, other))
            return replace(line, noise=line.covariance * sample_share * max(1.0 - common_variance / variance, 0.0))
    elif base.kind == "resolved":
        line = _from_one_resolved(base, other, base_index, other_index).inverse()
    else:
        line = _from_one_resolved(other, base, other_index, base_index)
    # As in `fit_trigger`: the gap between samples is a lower limit, the uncertainty of a rise is added.
    fits = base, other
    gaps = sum(f.open_s**2 for f in fits if f.kind == "sampled") / 12.0
    if base.kind == other.kind:  # the shapes of both rises are in the line
        rises = sum((RINGING_SAMPLES * f.sample_s) ** 2 for f in fits if f.kind == "resolved") / 12.0
    else:
        rises = sum(f.open_s**2 for f in fits if f.kind == "resolved") / 12.0
    variance_before = float(line.u_to_base_s(np.asarray(np.mean(other.edge_s[other_index])))) ** 2
    more = np.diag([rises + max(gaps - variance_before, 0.0), 0.0])
    rest = None if line.remaining_covariance is None else line.remaining_covariance + more
    return replace(line, covariance=line.covariance + more, remaining_covariance=rest)


def _from_models(base: TriggerFit, other: TriggerFit, shift: int) -> ClockLine:
    """Compare the two periodic models as if their errors were independent."""
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


def _from_pairs(base: TriggerFit, other: TriggerFit, base_index: IntArray, other_index: IntArray) -> ClockLine:
    """Fit a line to paired edges, free of the trigger's jitter."""
    if base.kind == "sampled":
        position, unscale = _scale_times(other.edge_s[other_index])
        return unscale(fit_straight_line(position, base.edge_s[base_index], 0.3 * base.resolution_s))
    position, unscale = _scale_times(other.crossing_s[other_index])
    rises = [replace(rise, phase=rise.phase[at]) for rise, at in ((base.rise, base_index), (other.rise, other_index))]
    read = (base.resolution_s**2 + other.resolution_s**2) / 12.0
    found = fit_resolved(base.crossing_s[base_index], position, rises, float(np.sqrt(read)))
    # Scatter of the edges beyond the samples' noise may be caused by the rise.
    share = min(read / max(found.line.jitter_s**2, 1e-30), 1.0)
    noise = unscale(replace(found.line, covariance=share * found.scatter_covariance)).covariance
    return replace(unscale(found.line), noise=noise)


def _from_one_resolved(
    resolved: TriggerFit, sampled: TriggerFit, base_index: IntArray, other_index: IntArray
) -> ClockLine:
    """Return the line from the clock with resolved edges to the one with intervals."""
    position, unscale = _scale_times(resolved.edge_s[base_index])
    lower, upper = sampled.lower_s[other_index], sampled.upper_s[other_index]
    width = float(np.median(upper - lower))
    start = fit_straight_line(position, (lower + upper) / 2.0, 0.3 * width)
    return unscale(line_posterior(position, lower[None], upper[None], start, MIN_JITTER_SAMPLES * width))


def _from_intervals(
    base: TriggerFit, other: TriggerFit, shift: int, begin: tuple[ClockLine, bool], rate: tuple[float, float] | None
) -> ClockLine:
    """Estimate both lines and the common jitter from the intervals of both records.

    The other record's intervals are read on the base clock by the first line to `begin` with, found from pairs or not.
    The two lines then differ by its error.
    """
    start, paired = begin
    numbers = np.union1d(base.number, other.number + shift)
    centre, half = (numbers[0] + numbers[-1]) / 2.0, (numbers[-1] - numbers[0]) / 2.0
    lower, upper = np.full((2, len(numbers)), -np.inf), np.full((2, len(numbers)), np.inf)
    for row, (fit, number) in enumerate(((base, base.number), (other, other.number + shift))):
        at = np.searchsorted(numbers, number)
        lower[row, at], upper[row, at] = fit.lower_s, fit.upper_s
    lower[1], upper[1] = start.to_base_s(lower[1]), start.to_base_s(upper[1])
    to_middle = np.array([[1.0, centre], [0.0, half]])
    line = to_middle @ np.array([base.start_s, base.period_s])
    base_covariance = to_middle @ base.covariance @ to_middle.T
    over = np.array([[1.0, other.time_s(centre - shift)], [0.0, half * other.period_s]])
    difference = over @ start.covariance @ over.T
    cross, second = (
        (base_covariance, base_covariance + difference) if paired else (np.zeros((2, 2)), difference - base_covariance)
    )
    covariance = np.block([[base_covariance, cross], [cross, second]])
    both = Posterior(np.tile(line, 2), covariance, max(base.jitter_s, other.jitter_s))
    slopes = None if rate is None else _slopes(half, base, rate[0] / start.rate, rate[1] / start.rate)
    both = line_posterior((numbers - centre) / half, lower, upper, both, MIN_JITTER_SAMPLES * base.resolution_s, slopes)
    shifted, tilted = _DIFFERENCE @ both.mean
    # On the base clock: later by shifted + tilted·(time - line[0]) / line[1].
    stretch = 1.0 + tilted / line[1]
    offset = shifted - tilted * line[0] / line[1] + stretch * start.offset_s
    jacobian = np.array([[1.0, (start.offset_s - line[0]) / line[1]], [0.0, start.rate / line[1]]])
    into_line = jacobian @ _DIFFERENCE
    covariance = into_line @ both.covariance @ into_line.T
    # By regression: the line of the base trigger is among the estimates.
    on_base = np.linalg.solve(both.covariance[:2, :2], both.covariance[:2]).T
    rest = both.covariance - on_base @ both.covariance[:2]
    return ClockLine(
        float(offset),
        float(stretch * start.rate),
        covariance,
        follows=into_line @ on_base @ to_middle,
        remaining_covariance=into_line @ rest @ into_line.T,
    )


def _slopes(half: float, base: TriggerFit, ratio: float, u_ratio: float) -> Slopes:
    """Return the ratio of two half spans, and the base one, as external information."""
    period, u_period = base.known_period_s or (base.period_s, np.inf)
    span, signs = half * period, np.array([1.0, -1.0])
    weight = np.diag([(half * u_period) ** -2.0, 0.0]) + np.multiply.outer(signs, signs) / (u_ratio * span) ** 2
    return Slopes(span * np.array([1.0, 2.0 - ratio]), weight)


def _scale_times(time: FloatArray) -> tuple[FloatArray, Callable[[Posterior], ClockLine]]:
    """Return times as positions within ±1, and the inverse scaling of lines."""
    centre, half = (time[0] + time[-1]) / 2.0, (time[-1] - time[0]) / 2.0
    jacobian = np.array([[1.0, -centre / half], [0.0, 1.0 / half]])

    def unscale(line: Posterior) -> ClockLine:
        offset, rate = jacobian @ line.mean
        return ClockLine(float(offset), float(rate), jacobian @ line.covariance @ jacobian.T)

    return (time - centre) / half, unscale


# One clock against another by the edges of the trigger that both have recorded.

_SAME_PERIOD = 0.01  # relative: clocks differ by less, two triggers by more


@dataclass(frozen=True)
class ClockTie(ClockLine, shapes="covariance 2 2; noise 2 2"):
    """A clock tied to another: t_base = offset_s + rate·t_other.

    Both count from their record's first sample.

    Attributes
    ----------
    offset_s, rate, covariance : the line with the covariance (2, 2) of (offset_s, rate).
    shift : base edge of the other record's edge 0.
    decided_by : evidence for the shift.
    pairs : number of edges that both records show.
    middle_s : middle of these edges on the other clock in s.
    notices : notices of the tie.
    """

    shift: int
    decided_by: str
    pairs: int
    middle_s: float
    notices: tuple[Notice, ...]

    def with_rate(self, rate: float, u_rate: float) -> ClockTie:
        """Return the tie combined with an independent rate; a contradictory one is reported, not used."""
        both, difference = float(self.covariance[1, 1]) + u_rate**2, rate - self.rate
        if abs(difference) > MAX_DISAGREEMENT_SIGMAS * np.sqrt(both):
            notice = Notice(
                CONTRADICTORY_CLOCK_RATE,
                "clock",
                relative_difference=abs(difference),
                direction="higher" if difference > 0.0 else "lower",
                u_relative=float(np.sqrt(both)),
            )
            return replace(self, notices=(*self.notices, notice))
        gain = self.covariance[:, 1] / both
        offset_s, rate = np.array([self.offset_s, self.rate]) + gain * difference
        covariance = self.covariance - np.outer(gain, self.covariance[1])
        left = np.eye(2) - np.outer(gain, [0.0, 1.0])
        return replace(
            self, offset_s=float(offset_s), rate=float(rate), covariance=covariance, noise=left @ self.noise @ left.T
        )

    def __repr__(self) -> str:
        line = f"t = {self.offset_s:.9g} s + {self.rate:.12g}·t_other"
        return f"ClockTie({line}, {self.pairs} edges, decided by {self.decided_by})"


def tie_clocks(
    base: TriggerFit,
    other: TriggerFit,
    shift: int | None = None,
    *,
    start_difference_s: float | None = None,
    rate: tuple[float, float] | None = None,
) -> ClockTie:
    """Tie another DAQ's clock to the base clock by the trigger that both have recorded.

    Parameters
    ----------
    base, other
        Fits of the trigger in both records.
    shift
        Base edge that is the other record's edge 0; None determines it (`decide_shift`).
    start_difference_s
        How much later the other record started, in s; None if unknown.
    rate
        Rate of the clocks with its standard uncertainty from another source that agrees with the edges; None without.

    Returns
    -------
    The line t_base = offset_s + rate·t_other with covariance (see `clock_line`).

    Raises
    ------
    ValueError
        The periods differ, or no evidence determines the shift.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import find_edges, fit_trigger, tie_clocks
    >>> def trigger(start_s, rate_hz):
    ...     time_s = start_s + np.arange(int(2.0 * rate_hz)) / rate_hz
    ...     burst = (time_s > 0.1) & (time_s < 1.9)
    ...     pulses = burst & (time_s % (1.0 / 21.3) < 2e-3)
    ...     return fit_trigger(find_edges(pulses.astype(float), rate_hz))
    >>> tie = tie_clocks(trigger(0.0, 51.2e3), trigger(0.025, 10e3))
    >>> print(f"{tie.pairs} edges tell that the other record began {tie.offset_s:.3f} s later")
    38 edges tell that the other record began 0.025 s later
    """
    if abs(other.period_s / base.period_s - 1.0) > _SAME_PERIOD:
        raise ValueError(
            f"other: expected the trigger period of the base clock, {base.period_s:.6g} s, found "
            f"{other.period_s:.6g} s: check the sampling rates of both"
        )
    edges, evidence = decide_shift(base, other, start_difference_s) if shift is None else (shift, "first_edge")
    by_start = by_start_times(base, other, start_difference_s)
    notices: tuple[Notice, ...] = ()
    if by_start is not None and by_start != edges:
        notice = Notice(START_TIMES_DISAGREE, "clock", start_time_edge=by_start, evidence=evidence, used_edge=edges)
        notices = (notice,)
    pairs, _, other_index = np.intersect1d(base.number, other.number + edges, return_indices=True)
    # Always from the coarser to the finer record, so that exchanged roles give the same tie.
    finer = min((base, other), key=lambda fit: (fit.resolution_s, fit.edges, fit.start_s))
    if finer is other and rate is None:
        line = clock_line(other, base, -edges).inverse()
    else:
        line = clock_line(base, other, edges, rate)
    middle_s = float(np.mean(other.edge_s[other_index] if len(pairs) else other.edge_s))
    return ClockTie(
        line.offset_s,
        line.rate,
        line.covariance,
        edges,
        evidence,
        len(pairs),
        middle_s,
        notices,
        noise=line.noise,
        follows=None if rate is None else line.follows,
        remaining_covariance=None if rate is None else line.remaining_covariance,
    )


# Instants of single trigger edges from all records: the periodic model and each edge's deviation.


@dataclass(frozen=True)
class EdgeInstants(Arrays, shapes="time_s F; u_time_s F; model_share F"):
    """Times (F,) of edges on the base clock with standard uncertainty (F,).

    The uncertainty includes model and ties. `model_share` (F,) is their response to an error of the periodic model, 1
    for an edge that no record shows.
    """

    time_s: FloatArray
    u_time_s: FloatArray
    model_share: FloatArray


def edge_instants(
    base: TriggerFit, number: IntArray, others: Sequence[tuple[TriggerFit, ClockTie]] = ()
) -> EdgeInstants:
    """Return the instants of the base record's edges `number` (F,) from all records.

    An edge is the model's time plus a Gaussian deviation of the size of the jitter. Resolved crossings update it with
    their noise; intervals truncate the remaining distribution. An edge that no record shows keeps the model's time,
    with the jitter as uncertainty. Single edges also reduce the uncertainty of the model, but not where that is common
    to all of them or external information has entered it. There the jitter alone moves them, less where the shape of a
    rise may explain all of it.
    """
    records = [(base, base.number, None), *((fit, fit.number + tie.shift, tie) for fit, tie in others)]
    common_error = base.locked or base.known_period_s is not None
    u_model = base.u_time_s(number)
    shape = min(base.u_shape_s, base.jitter_s) ** 2  # of the scatter of the edges
    first = base.jitter_s**2 - shape + (0.0 if common_error else u_model**2)
    mean, variance = np.zeros(len(number)), np.full(len(number), first)
    below, above = np.full(len(number), -np.inf), np.full(len(number), np.inf)
    model = base.time_s(number)
    for fit, seen, tie in records:
        _, at, which = np.intersect1d(number, seen, return_indices=True)
        lower, upper, edge = (
            (time if tie is None else tie.to_base_s(time)) - model[at]
            for time in (fit.lower_s[which], fit.upper_s[which], fit.edge_s[which])
        )
        if fit.kind == "resolved":
            u_tie = np.zeros(len(at)) if tie is None else tie.u_to_base_s(fit.edge_s[which])
            noise = np.maximum(fit.resolution_s**2 / 12.0 + u_tie**2 + fit.u_shape_s**2, 1e-30)
            gain = variance[at] / (variance[at] + noise)
            mean[at] += gain * (edge - mean[at])
            variance[at] *= 1.0 - gain
        else:
            below[at], above[at] = np.maximum(below[at], lower), np.minimum(above[at], upper)
    mean, variance = _truncate(mean, variance, below, above)
    # A prior's mean shifts that of the posterior by the ratio of their variances, for readings and for bounds.
    share = np.divide(variance, first, out=np.ones_like(variance), where=np.asarray(first) > 0.0)
    return EdgeInstants(model + mean, np.sqrt(variance + shape + (share * u_model) ** 2 * common_error), share)


def _truncate(
    mean: FloatArray, variance: FloatArray, below: FloatArray, above: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of Gaussians (F,) between bounds; unchanged for distant bounds."""
    deviation = np.sqrt(np.maximum(variance, 1e-30))
    low, high = np.clip((below - mean) / deviation, -40.0, 40.0), np.clip((above - mean) / deviation, -40.0, 40.0)
    share = normal_cdf(high) - normal_cdf(low)
    # An interval that the model misses by more than the jitter explains is ignored.
    inside = share > 1e-6
    share = np.where(inside, share, 1.0)
    density_low, density_high = np.exp(-0.5 * low**2), np.exp(-0.5 * high**2)
    step = (density_low - density_high) / np.sqrt(2.0 * np.pi) / share
    spread = 1.0 + (low * density_low - high * density_high) / np.sqrt(2.0 * np.pi) / share - step**2
    return (
        np.where(inside, mean + deviation * step, mean),
        np.where(inside, variance * np.clip(spread, 0.0, 1.0), variance),
    )
