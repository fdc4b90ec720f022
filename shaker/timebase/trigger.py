"""Periodic model of a trigger: start, period, jitter, and width of its pulses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from shaker.signal_notices import (
    CONTRADICTORY_PERIOD,
    DOUBLED_EDGES,
    EXTERNAL_PERIOD,
    LOCKED_EDGES,
    MISSING_EDGES,
    STRAY_EDGES,
    TRIGGER_JITTER,
)
from shaker.timebase.edges import EdgeKind, Edges, Posterior, Slopes, find_edges, line_posterior, number_edges
from shakercal._common.arrays import Arrays, FloatArray, IntArray
from shakercal._common.notices import Notice

# Crossings of a resolved rise: the effect of its shape on the reconstruction, estimated from all edges.

_TERMS = 16  # sines of the shape of a rise; chosen
_ORDER = np.arange(1.0, _TERMS + 1)
_SHAPE_POWERS = (1.5, 2.5)  # of the order, by which the sines fall off: kinks of the rise near the crossing, and far
# Standard deviations of the first sine, of a sample: from filters to RC inputs with half a sample as time constant.
_MIN_SHAPE_SIZE, _MAX_SHAPE_SIZE = 1e-3, 0.15
_SIZE_RATIO = 3.0  # from one size of the sines to the next
# Standard deviations of the sines if there are too few phases to estimate them: the first, of a sample, and the power.
_LOCKED_SHAPE_SIZE, _LOCKED_SHAPE_POWER = 0.12, 1.5


def fit_straight_line(position: FloatArray, time_s: FloatArray, min_scatter_s: float = 0.0) -> Posterior:
    """Fit time_s (E,) = m + h·position by least squares, with covariance for the scatter."""
    columns = np.column_stack([np.ones_like(position), position])
    inverse, centre = np.linalg.inv(columns.T @ columns), float(time_s.mean())
    value = inverse @ (columns.T @ (time_s - centre))
    residual = time_s - centre - columns @ value
    scatter = float(np.sqrt(residual @ residual / max(len(time_s) - 2, 1)))
    return Posterior(value + np.array([centre, 0.0]), inverse * max(scatter, min_scatter_s) ** 2, scatter)


@dataclass(frozen=True)
class RisePhases:
    """Phases (E,) of resolved edges between samples; `locked`: too few for a shape."""

    phase: FloatArray
    sample_s: float
    locked: bool

    @property
    def sines(self) -> FloatArray:
        """Shift of the edges (E, J) in s by unit shape terms."""
        return np.asarray(self.sample_s * np.sin(np.pi * _ORDER * self.phase[:, None]))


@dataclass(frozen=True)
class ResolvedLine(Arrays, shapes="scatter_covariance 2 2; correction_s E"):
    """Line through resolved edges, their shifts by rise shapes, covariance of their individual scatter."""

    line: Posterior
    scatter_covariance: FloatArray
    correction_s: FloatArray


def fit_resolved(
    time_s: FloatArray, position: FloatArray, rises: Sequence[RisePhases], min_scatter_s: float = 0.0
) -> ResolvedLine:
    """Fit a line to resolved edges, with the shapes of the rises.

    The model is time_s (E,) = m + h·position + e_1(φ_1) - e_2(φ_2) with phases φ (E,) of the crossings; the second rise
    is that of the clock on which `position` counts. A rise that is not band-limited leaves the reconstruction with an
    error e of the crossing's phase between two samples (as an effective point-spread function: Anderson & King, PASP
    112, 2000). It vanishes at a sample, hence e = Σ a_j sin(π j φ), a_j Gaussian with a standard deviation that falls
    as a power of j. Size and power are averaged by the restricted likelihood (Patterson & Thompson, Biometrika 58,
    1971), so that the covariance includes an undetermined shape.

    A phase is the time read, not the true one: dφ_true/dφ = 1 - e' enters the likelihood, else the slow drift of edges
    past the samples would be attributed to the shape. A locked rise is not estimated; the possible effect of RC inputs
    is in the covariance.
    """
    columns = np.column_stack([np.ones_like(position), position])
    inverse = np.linalg.inv(columns.T @ columns)
    min_scatter = max(min_scatter_s, MIN_JITTER_SAMPLES * max(r.sample_s for r in rises))
    start, locked_covariance = fit_straight_line(position, time_s, min_scatter), np.zeros((2, 2))
    for rise in rises:
        if rise.locked:
            tilt = inverse @ (columns.T @ rise.sines) * (_LOCKED_SHAPE_SIZE * _ORDER**-_LOCKED_SHAPE_POWER)
            locked_covariance += tilt @ tilt.T
    estimated = [(sign, rise) for sign, rise in zip((1.0, -1.0), rises, strict=False) if not rise.locked]
    if not estimated:
        line = replace(start, covariance=start.covariance + locked_covariance)
        return ResolvedLine(line, start.covariance, np.zeros_like(time_s))
    sines = np.hstack([sign * rise.sines for sign, rise in estimated])
    into_line = inverse @ (columns.T @ sines)
    left, orthogonal = time_s - columns @ start.mean, sines - columns @ into_line
    normal, right, edges = orthogonal.T @ orthogonal, orthogonal.T @ left, len(position)
    # Standard deviations of the a_j over the scatter of the edges, for every size and power.
    low, high = _MIN_SHAPE_SIZE / max(start.jitter_s, min_scatter), _MAX_SHAPE_SIZE / min_scatter
    sizes = np.geomspace(low, high, 1 + int(np.ceil(np.log(high / low) / np.log(_SIZE_RATIO))))
    one = [size * _ORDER**-power for size in sizes for power in _SHAPE_POWERS]
    spread = np.array([np.concatenate(pair) for pair in product(one, repeat=len(estimated))])
    whitened = np.eye(spread.shape[1]) + spread[:, :, None] * normal * spread[:, None, :]
    posterior = np.linalg.inv(whitened) * spread[:, :, None] * spread[:, None, :]
    shape = posterior @ right
    squares = np.maximum(left @ left - shape @ right, 0.0)
    variance = np.maximum(squares / max(edges - 2, 1), min_scatter**2)
    score = -0.5 * (np.linalg.slogdet(whitened)[1] + (edges - 2) * np.log(variance) + squares / variance)
    allowed = np.ones(len(spread), dtype=bool)
    for number, (_, rise) in enumerate(estimated):
        terms = slice(number * _TERMS, (number + 1) * _TERMS)
        slope = shape[:, terms] @ (np.pi * _ORDER * np.cos(np.pi * _ORDER * rise.phase[:, None])).T
        score += np.log(np.maximum(np.abs(1.0 - slope), 1e-9)).sum(axis=1)
        allowed &= spread[:, terms.start] * np.sqrt(variance) <= _MAX_SHAPE_SIZE
    score = np.where(allowed | ~allowed.any(), score, -np.inf)
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    tilt = into_line @ posterior
    means = start.mean - shape @ into_line.T
    mean = weight @ means
    noise = variance[:, None, None] * (inverse + tilt @ normal @ np.swapaxes(tilt, 1, 2))
    covariance = np.einsum("g,gpq->pq", weight * variance, inverse + tilt @ into_line.T)
    covariance += (weight[:, None] * (means - mean)).T @ (means - mean)
    line = Posterior(mean, covariance + locked_covariance, float(np.sqrt(weight @ variance)))
    return ResolvedLine(line, np.einsum("g,gpq->pq", weight, noise), sines @ (weight @ shape))


# The periodic model of a camera trigger: start, period, jitter, missing, doubled and spurious edges.

MIN_JITTER_SAMPLES = 5e-6  # of a sample: 0.1 ns at 51.2 kHz, the least jitter of a logic output driven by a quartz
_IDLE_PERIODS = 1.05  # periods without an edge at an end of the record that show the begin or end of the burst
_LOCKED_GAP_SAMPLES = 0.15  # of a sample: gap in the phases of many edges that marks them as locked
MAX_DISAGREEMENT_SIGMAS = (
    5.0  # standard uncertainties by which two values of one quantity may differ; chosen for few false alarms
)
RINGING_SAMPLES = 1e-3  # of a sample: timing uncertainty of a resolved edge from the ringing of the pulse's other edge


@dataclass(frozen=True)
class TriggerFit(Arrays, shapes="number E; lower_s E; upper_s E; edge_s E; correction_s E; covariance 2 2"):
    """Periodic model t_k = start_s + k·period_s of a trigger.

    Times count in seconds from the record's first sample.

    Attributes
    ----------
    start_s, period_s, covariance : the model with the covariance (2, 2) of (start_s, period_s).
    number : (E,), count of each accepted edge, 0 for the first.
    lower_s, upper_s : (E,), interval (lower, upper] of each edge.
    edge_s, correction_s : (E,), individual estimates, and the correction for the rise's shape already subtracted.
    kind : input of the model, the intervals ("sampled") or the estimates ("resolved").
    jitter_s : standard deviation of the edges about the model beyond the effect of sampling.
    missing : numbers without an edge.
    doubled, spurious : numbers of rejected edges.
    idle_before, idle_after : whether the record shows the begin and the end of the burst.
    resolution_s : √12 times the uncertainty of one edge from sampling and noise.
    open_s : the same for an error common to all edges: locked phases, rise shape, or ringing.
    notices : notices of the fit.
    known_period_s : period and standard uncertainty from another source (`with_period`), else None.
    """

    start_s: float
    period_s: float
    number: IntArray
    lower_s: FloatArray
    upper_s: FloatArray
    edge_s: FloatArray
    correction_s: FloatArray
    kind: EdgeKind
    covariance: FloatArray
    jitter_s: float
    missing: tuple[int, ...]
    doubled: int
    spurious: int
    idle_before: bool
    idle_after: bool
    resolution_s: float
    open_s: float
    notices: tuple[Notice, ...]
    known_period_s: tuple[float, float] | None = None

    def __repr__(self) -> str:
        lost = f", {len(self.missing)} of them missing" if self.missing else ""
        return f"TriggerFit({self.edges} edges{lost}, from {self.start_s:.9g} s every {self.period_s:.9g} s)"

    @property
    def edges(self) -> int:
        """Number of edges from the first to the last, including missing ones."""
        return int(self.number[-1]) + 1

    @property
    def jitter_detected(self) -> bool:
        """Whether the edges certainly scatter.

        Intervals that one line meets allow a jitter of less than one of them over their number.
        """
        return self.jitter_s * (len(self.number) if self.kind == "sampled" else 1) > self.resolution_s

    @property
    def crossing_s(self) -> FloatArray:
        """Reconstructed crossing times (E,), before the rise-shape correction."""
        return self.edge_s + self.correction_s

    @property
    def locked(self) -> bool:
        """Whether the edges always have few phases between two samples."""
        return _locked_gap(self.number, self.period_s / self.sample_s, self.jitter_s / self.sample_s) > 0.0

    @property
    def rise(self) -> RisePhases:
        """Phases of the crossings between two samples."""
        return RisePhases((self.crossing_s - self.lower_s) / self.sample_s, self.sample_s, self.locked)

    @property
    def sample_s(self) -> float:
        """Sampling interval."""
        return float(np.median(self.upper_s - self.lower_s))

    @property
    def u_shape_s(self) -> float:
        """Standard uncertainty (rms) of one edge from an undetermined shape of a resolved rise."""
        if self.kind == "sampled" or not (self.locked or self.known_period_s):
            return 0.0
        squares = 0.5 * np.sum(_ORDER ** (-2.0 * _LOCKED_SHAPE_POWER))
        return self.sample_s * _LOCKED_SHAPE_SIZE * float(np.sqrt(squares))

    def time_s(self, number: IntArray) -> FloatArray:
        """Return the modelled times of edges `number` in s from the first sample."""
        return np.asarray(self.start_s + self.period_s * np.asarray(number, dtype=np.float64))

    def u_time_s(self, number: IntArray) -> FloatArray:
        """Return the standard uncertainty of `time_s` without single-edge jitter."""
        k = np.asarray(number, dtype=np.float64)
        c = self.covariance
        return np.asarray(np.sqrt(c[0, 0] + 2.0 * k * c[0, 1] + k**2 * c[1, 1]))

    def with_period(self, period_s: float, u_period_s: float) -> TriggerFit:
        """Return the fit combined with an independently known period.

        The period is a reading of the line's slope, and the intervals are read again with it. Edges that pass one
        sample during the record then determine the instants of all. The gap between the phases of locked edges
        (`open_s`) is reduced to the uncertainty that the intervals leave, since no other period is possible. For
        resolved rises with unknown shape, the line rotates about the middle of the burst. A period that contradicts the
        edges is reported and not used.
        """
        difference, both = period_s - self.period_s, np.hypot(u_period_s, np.sqrt(self.covariance[1, 1]))
        if abs(difference) > MAX_DISAGREEMENT_SIGMAS * both:
            notice = Notice(
                CONTRADICTORY_PERIOD,
                "trigger",
                relative_difference=abs(difference) / self.period_s,
                direction="longer" if difference > 0.0 else "shorter",
                u_relative=both / self.period_s,
            )
            return replace(self, notices=(*self.notices, notice))
        half, number = self.number[-1] / 2.0, self.number
        slopes = Slopes(np.array([half * period_s]), np.array([[(half * u_period_s) ** -2.0]]))
        to_middle = np.array([[1.0, half], [0.0, half]])
        mean, covariance = (
            to_middle @ np.array([self.start_s, self.period_s]),
            to_middle @ self.covariance @ to_middle.T,
        )
        if self.kind == "resolved":  # no one shape of a rise makes both of a slope and of the middle
            covariance = np.diag(covariance.diagonal())
        line = slopes.update(Posterior(mean, covariance, self.jitter_s))
        if self.kind == "sampled":
            intervals = (number - half) / half, self.lower_s[None], self.upper_s[None]
            line = line_posterior(*intervals, line, MIN_JITTER_SAMPLES * self.sample_s, slopes)
        jacobian = np.array([[1.0, -1.0], [0.0, 1.0 / half]])
        start, period = jacobian @ line.mean
        fit = replace(
            self,
            start_s=float(start),
            period_s=float(period),
            covariance=jacobian @ line.covariance @ jacobian.T,
            jitter_s=line.jitter_s,
            open_s=min(self.open_s, float(np.sqrt(12.0 * line.covariance[0, 0]))),
            known_period_s=(period_s, u_period_s),
        )
        return replace(fit, notices=_notices(fit))

    def delay_by(self, lag_s: float) -> TriggerFit:
        """Return the same trigger on a time axis on which it is `lag_s` later."""
        return replace(
            self,
            start_s=self.start_s + lag_s,
            lower_s=self.lower_s + lag_s,
            upper_s=self.upper_s + lag_s,
            edge_s=self.edge_s + lag_s,
        )


NOMINAL_INTERVAL_S = 1e-9
"""Interval of an edge that no samples determine (chosen)."""


def nominal_trigger(edges: int, period_s: float, covariance: FloatArray | None = None) -> TriggerFit:
    """Return a trigger of even edges that no channel recorded.

    From 0 s on, by default exact. `covariance` (2, 2): of start and period, s².
    """
    number = np.arange(edges)
    time_s = np.asarray(number * period_s, dtype=np.float64)
    return TriggerFit(
        start_s=0.0,
        period_s=period_s,
        number=number,
        lower_s=time_s - NOMINAL_INTERVAL_S,
        upper_s=time_s,
        edge_s=time_s,
        correction_s=np.zeros(edges),
        kind="resolved",
        covariance=np.zeros((2, 2)) if covariance is None else covariance,
        jitter_s=0.0,
        missing=(),
        doubled=0,
        spurious=0,
        idle_before=False,
        idle_after=False,
        resolution_s=0.0,
        open_s=0.0,
        notices=(),
    )


def fit_trigger(edges: Edges) -> TriggerFit:
    """Fit the periodic model t_k = start + k·period to trigger edges.

    Parameters
    ----------
    edges
        At least three edges of the trigger.

    Returns
    -------
    The periodic model with its covariance; missing edges are counted, doubled and stray ones rejected.

    Raises
    ------
    ValueError
        Fewer than three edges, or fewer than half of them, share a period.

    Notes
    -----
    Each true instant lies in an interval one sample wide. The estimate is the mean of the posterior of (start, period)
    under Gaussian jitter of unknown size. It tends to the centre of the polygon of all intervals as the jitter vanishes
    (error ~ 1/edges) and to least squares as it grows (error ~ 1/√edges). Where the rise is resolved, the line is
    fitted to the reconstructed crossings (`fit_resolved`), whose noise intervals would treat as jitter.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import find_edges, fit_trigger
    >>> time_s = np.arange(20_000) / 10e3
    >>> camera = ((time_s - 0.0123) % (1.0 / 21.3) < 2e-3).astype(float)
    >>> fit = fit_trigger(find_edges(camera, 10e3))
    >>> print(f"{fit.edges} edges, {1.0 / fit.period_s:.2f} Hz")
    43 edges, 21.30 Hz
    """
    numbering = number_edges(edges)
    accepted = numbering.accepted
    n = numbering.number[accepted] - numbering.number[accepted][0]
    lower, upper, estimate = edges.lower_s[accepted], edges.upper_s[accepted], edges.estimate_s[accepted]
    half = n[-1] / 2.0
    position = (n - half) / half
    sample = float(np.median(upper - lower))
    kind: EdgeKind = "sampled"
    # Rounding to samples scatters by 0.29 of one, except where period and sampling are commensurate.
    rough = fit_straight_line(position, (lower + upper) / 2.0, 0.3 * sample)
    edge, correction = (lower + upper) / 2.0, np.zeros(len(n))
    if edges.kind == "resolved":
        step = fit_straight_line(position, estimate)
        rise = RisePhases(
            (estimate - lower) / sample,
            sample,
            _locked_gap(n, step.mean[1] / half / sample, step.jitter_s / sample) > 0,
        )
        found = fit_resolved(estimate, position, [rise], edges.u_reading_s)
        line, shape = found.line, found.correction_s
        line = replace(line, jitter_s=float(np.sqrt(max(line.jitter_s**2 - edges.u_reading_s**2, 0.0))))
        kind, edge, correction, resolution = "resolved", estimate - shape, shape, np.sqrt(12.0) * edges.u_reading_s
        # The uncertainty from the rise's shape and the ringing of other flanks is common to all edges.
        more = (RINGING_SAMPLES * sample) ** 2 / 12.0
        open_s = float(np.sqrt(12.0 * (more + max(line.covariance[0, 0] - found.scatter_covariance[0, 0], 0.0))))
    else:
        line = line_posterior(position, lower[None], upper[None], rough, MIN_JITTER_SAMPLES * sample)
        resolution = sample
        # A gap is common to all instants where the period is a simple multiple of the sampling interval. Intervals
        # treat all periods as equally likely: the larger of the two uncertainties counts.
        open_s = sample * _locked_gap(n, line.mean[1] / half / sample, line.jitter_s / sample)
        more = max(open_s**2 / 12.0 - line.covariance[0, 0], 0.0)
    line = replace(line, covariance=line.covariance + np.diag([more, 0.0]))
    # From (middle, half span) to (start, period).
    jacobian = np.array([[1.0, -1.0], [0.0, 1.0 / half]])
    start, period = jacobian @ line.mean
    missing = tuple(int(i) for i in np.setdiff1d(np.arange(n[-1] + 1), n))
    fit = TriggerFit(
        start_s=float(start),
        period_s=float(period),
        number=n,
        lower_s=lower,
        upper_s=upper,
        edge_s=edge,
        correction_s=correction,
        kind=kind,
        covariance=jacobian @ line.covariance @ jacobian.T,
        jitter_s=line.jitter_s,
        missing=missing,
        doubled=numbering.doubled + edges.bounces,
        spurious=numbering.spurious,
        idle_before=bool(start > _IDLE_PERIODS * period),
        idle_after=bool(edges.record_s - (start + n[-1] * period) > _IDLE_PERIODS * period),
        resolution_s=float(resolution),
        open_s=open_s,
        notices=(),
    )
    return replace(fit, notices=_notices(fit))


def _locked_gap(number: IntArray, period: float, jitter: float) -> float:
    """Return the widest gap (samples) between the phases of locked edges, 0 for others."""
    phase = np.sort(number * period % 1.0)
    gap = float(np.max(np.append(np.diff(phase), phase[0] + 1.0 - phase[-1])))
    return 0.0 if gap <= max(_LOCKED_GAP_SAMPLES, 10.0 / len(number)) or jitter >= _LOCKED_GAP_SAMPLES else gap


def _notices(fit: TriggerFit) -> tuple[Notice, ...]:
    """Return notices of missing, rejected, scattering and locked edges."""
    notices = []
    if fit.missing:
        listed = ", ".join(str(i) for i in fit.missing[:5]) + (", …" if len(fit.missing) > 5 else "")
        notices.append(Notice(MISSING_EDGES, "trigger", missing=len(fit.missing), numbers=listed))
    if fit.doubled:
        notices.append(Notice(DOUBLED_EDGES, "trigger", doubled=fit.doubled))
    if fit.spurious:
        notices.append(Notice(STRAY_EDGES, "trigger", stray=fit.spurious, period_s=fit.period_s))
    if fit.jitter_s > 1e-3 * fit.period_s:
        notices.append(Notice(TRIGGER_JITTER, "trigger", jitter_us=fit.jitter_s * 1e6))
    if fit.known_period_s:
        period, u = fit.known_period_s
        notices.append(Notice(EXTERNAL_PERIOD, "trigger", u_relative=u / period))
    if fit.locked:
        u_middle = float(fit.u_time_s(np.asarray(fit.edges // 2)))
        notices.append(Notice(LOCKED_EDGES, "trigger", u_us=u_middle * 1e6))
    return tuple(notices)


# Width of a trigger's pulses, as a strobe's exposure needs it.

_MIN_WIDTH = 1.5  # samples: pulses shorter than one fall between the samples, and those seen seem one long
_MIN_WIDTH_RISE_TIMES = 5.0  # rise times: shorter pulses do not settle at their level
_RISE_SEARCH_SAMPLES = 16  # samples on either side of a flank in which its rise is searched for
_FLANK_RINGING = 0.2  # u in samples² over the width: crossings of one flank on the ringing of the other


@dataclass(frozen=True)
class PulseWidth:
    """Mean width of a signal's pulses with its standard uncertainty, their number, and both flanks."""

    width_s: float
    u_width_s: float
    pulses: int
    begin: TriggerFit
    end: TriggerFit
    notices: tuple[Notice, ...]


def pulse_width(
    samples: FloatArray,
    sample_rate_hz: float,
    threshold: float | None = None,
    edge: Literal["rising", "falling"] = "rising",
    begin_fit: TriggerFit | None = None,
) -> PulseWidth:
    """Measure the width of pulses that begin with `edge` at `threshold` in samples.

    Default threshold: half height. `begin_fit`, the fit of their beginnings at another threshold, is used where both
    are "sampled" and have the same edges. The width is the distance of both flanks' lines in the middle of the burst,
    where neither depends on the period. Errors are treated as independent: common jitter makes the uncertainty too
    large. The ringing of one flank after an ideal low-pass, sin(πx)/(π²x) at x samples, is included for short pulses.
    """
    ends: Literal["rising", "falling"] = "falling" if edge == "rising" else "rising"
    above = samples >= find_edges(samples, sample_rate_hz, threshold, edge).threshold
    low, high = float(np.median(samples[~above])), float(np.median(samples[above]))
    level = (low + high) / 2.0 if threshold is None else threshold
    edges = find_edges(samples, sample_rate_hz, level, edge)
    begin = begin_fit
    if begin is None or not (begin.kind == edges.kind == "sampled" and np.array_equal(begin.upper_s, edges.upper_s)):
        begin = fit_trigger(edges)
    end = fit_trigger(find_edges(samples, sample_rate_hz, level, ends))
    if abs(end.period_s / begin.period_s - 1.0) > 0.5 / begin.edges:
        raise ValueError(
            f"samples: expected pulses, found {edge} edges every {begin.period_s:.6g} s and {ends} ones every "
            f"{end.period_s:.6g} s"
        )
    middle = np.asarray(begin.edges // 2)
    # The first end after this beginning.
    partner = np.asarray(np.ceil((begin.time_s(middle) - end.start_s) / end.period_s), dtype=np.int64)
    width = float(end.time_s(partner) - begin.time_s(middle))
    # The rise: how many samples per flank lie between 10 % and 90 % of the height.
    flanks = np.rint(sample_rate_hz * np.concatenate([begin.edge_s, end.edge_s])).astype(np.int64)
    flank_samples = np.unique(
        np.clip(flanks[:, None] + np.arange(-_RISE_SEARCH_SAMPLES, _RISE_SEARCH_SAMPLES + 1), 0, len(samples) - 1)
    )
    rising = np.count_nonzero(np.abs((samples[flank_samples] - low) / (high - low) - 0.5) < 0.4)
    min_width = max(_MIN_WIDTH, _MIN_WIDTH_RISE_TIMES * float(rising / len(flanks)))
    if width * sample_rate_hz < min_width:
        raise ValueError(
            f"samples: expected pulses of at least {min_width:.2g} samples, {1e6 * min_width / sample_rate_hz:.3g} µs, "
            f"found pulses of {1e6 * width:.3g} µs"
        )
    u = float(np.hypot(begin.u_time_s(middle), end.u_time_s(partner)))
    if "resolved" in (begin.kind, end.kind):
        u = float(np.hypot(u, _FLANK_RINGING / (width * sample_rate_hz**2)))
    notices = tuple(dict.fromkeys(begin.notices + end.notices))
    return PulseWidth(width, u, min(len(begin.number), len(end.number)), begin, end, notices)
