"""The periodic model of a camera trigger: start, period, jitter, missing and spurious edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import BoolArray, FloatArray, IntArray, check_shape
from shaker.notice import Notice
from shaker.signals.edges import Edges

_CAPTURE = 0.2  # of a period: an edge further from its place is spurious
_IDLE = 1.05  # periods without an edge at an end of the record that show the burst to begin or end there
_STRAY = 1e-6  # probability of an edge that the model does not explain
_SAMPLED_JITTER = 0.8  # of a sample: scatter above which the intervals carry no more than their middles
_JITTERS = 8  # grid of jitters, logarithmic
_GRIDS = (9, 9, 11, 13, 13, 17, 21, 21)  # points per axis of the successive posterior grids


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


def fit_trigger(edges: Edges) -> TriggerFit:
    """Fit t_k = start + k·period to the edges of a periodic trigger and number them.

    Missing edges are counted, doubled and stray ones dropped. Where no sample lies on the rise, each true instant is
    known to lie in an interval one sample wide; the estimate is the mean of the posterior of (start, period) under
    Gaussian jitter of unknown size, which tends to the centre of the polygon of all intervals as the jitter
    vanishes (error ~ 1/edges) and to least squares as it grows (error ~ 1/√edges). Resolved edges, and jitter above a
    sample, go by least squares. At least three edges are needed.
    """
    number, kept = _number(edges)
    n = number[kept] - number[kept][0]
    lower, upper, middle = edges.lower_s[kept], edges.upper_s[kept], edges.estimate_s[kept]
    centre, half = (n[-1] / 2.0, n[-1] / 2.0)
    place = (n - centre) / half
    estimate = _least_squares(place, middle)
    interval = float(np.median(upper - lower))
    if edges.kind == "sampled" and estimate.jitter < _SAMPLED_JITTER * interval:
        estimate = _posterior(place, lower, upper, estimate)
    # From (middle, half span) to (start, period).
    jacobian = np.array([[1.0, -1.0], [0.0, 1.0 / half]])
    start, period = jacobian @ estimate.mean
    missing = tuple(int(i) for i in np.setdiff1d(np.arange(n[-1] + 1), n))
    spurious = int(len(kept) - np.count_nonzero(kept))
    return TriggerFit(
        start_s=float(start),
        period_s=float(period),
        number=n,
        edge_s=middle,
        covariance=jacobian @ estimate.covariance @ jacobian.T,
        jitter_s=estimate.jitter,
        missing=missing,
        spurious=spurious,
        idle_before=bool(start > _IDLE * period),
        idle_after=bool(edges.record_s - (start + n[-1] * period) > _IDLE * period),
        resolution_s=interval,
        notices=_notices(missing, spurious, estimate.jitter, float(period)),
    )


@dataclass(frozen=True)
class _Estimate:
    """Time of the middle and half the span, with covariance, and the jitter."""

    mean: FloatArray
    covariance: FloatArray
    jitter: float


def _number(edges: Edges) -> tuple[IntArray, BoolArray]:
    """Number the edges by the period that most of them share; return numbers and which edges are the period's own."""
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
    return number, kept


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
    """Drop edges far from a straight line through the others: beyond 6 robust standard deviations and 1.5 intervals."""
    interval = float(np.median(edges.upper_s - edges.lower_s))
    for _ in range(10):
        if np.count_nonzero(kept) < 3:
            break
        line = np.polynomial.Polynomial.fit(number[kept], edges.estimate_s[kept], 1)
        deviation = np.abs(edges.estimate_s - line(number))
        spread = 1.4826 * float(np.median(deviation[kept]))
        stay = kept & (deviation <= max(6.0 * spread, 1.5 * interval))
        if np.array_equal(stay, kept):
            break
        kept = stay
    return kept


def _least_squares(place: FloatArray, time: FloatArray) -> _Estimate:
    """Fit time = middle + half span·place."""
    columns = np.stack([np.ones_like(place), place], axis=1)
    inverse = np.linalg.inv(columns.T @ columns)
    mean = inverse @ columns.T @ time
    residual = time - columns @ mean
    variance = float(residual @ residual) / max(len(time) - 2, 1)
    return _Estimate(mean, inverse * variance, float(np.sqrt(variance)))


def _posterior(place: FloatArray, lower: FloatArray, upper: FloatArray, start: _Estimate) -> _Estimate:
    """Return mean and covariance of (middle, half span) given that each edge lies in its interval.

    Likelihood of an edge: Φ((upper - t)/σ) - Φ((lower - t)/σ), σ the jitter with a logarithmic prior. The posterior
    is summed on grids that close in on it.
    """
    width = float(np.median(upper - lower))
    jitters = np.geomspace(1e-3 * width, 2.0 * start.jitter + 0.1 * width, _JITTERS)
    mean, jitter = start.mean, start.jitter
    # Rounding to samples scatters by 0.29 of one, except where period and sampling are commensurate; the grids then
    # grow until they hold the whole polygon.
    columns = np.stack([np.ones_like(place), place], axis=1)
    covariance = np.linalg.inv(columns.T @ columns) * (2.0 * max(jitter, 0.3 * width)) ** 2
    for points in _GRIDS:
        axis = np.linspace(-4.5, 4.5, points)
        root = np.linalg.cholesky(covariance)
        offset = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2) @ root.T
        log_weight = _log_likelihood(mean + offset, jitters, place, lower, upper)
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        over = weight.sum(axis=1)
        mean, old = mean + over @ offset, mean
        centred = offset - (mean - old)
        step = np.diag((9.0 / (points - 1) * np.linalg.norm(root, axis=1)) ** 2 / 12.0)
        covariance = (over[:, None] * centred).T @ centred + step
        share = weight.sum(axis=0)
        jitter = float(share @ jitters)
        likely = jitters[share > 1e-4 * share.max()]
        jitters = np.geomspace(likely[0], max(likely[-1], 1.5 * likely[0]), _JITTERS)
    return _Estimate(mean, covariance, jitter)


def _log_likelihood(
    line: FloatArray, jitters: FloatArray, place: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Return the log-likelihood (G, J) of lines (G, 2) and jitters (J,)."""
    from scipy.special import ndtr

    time = line[:, :1] + line[:, 1:] * place
    reach = 6.0 * jitters[-1]
    # Edges whose interval holds every line of the grid with room to spare say nothing.
    telling = (time.min(axis=0) - reach < lower) | (time.max(axis=0) + reach > upper)
    below, above = lower[telling] - time[:, telling], upper[telling] - time[:, telling]
    columns = [np.log(ndtr(above / s) - ndtr(below / s) + _STRAY).sum(axis=1) for s in jitters]
    return np.stack(columns, axis=1)


def _notices(missing: tuple[int, ...], spurious: int, jitter: float, period: float) -> tuple[Notice, ...]:
    """Tell about edges that were not where the period puts them."""
    found = []
    if missing:
        listed = ", ".join(str(i) for i in missing[:5]) + (", …" if len(missing) > 5 else "")
        found.append(Notice("warning", f"{len(missing)} edges are missing (numbers {listed})", "trigger"))
    if spurious:
        found.append(Notice("warning", f"{spurious} edges off the period of {period:.6g} s were dropped", "trigger"))
    if jitter > 1e-3 * period:
        found.append(Notice("warning", f"jitter of {jitter * 1e6:.3g} us, over 0.1 % of the period", "trigger"))
    return tuple(found)
