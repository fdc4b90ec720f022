"""Edges in sampled signals: their numbers, lines through their intervals; signals read at other times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, reduce
from math import erfc
from statistics import NormalDist
from typing import Literal

import numpy as np

from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape

EdgeKind = Literal["sampled", "resolved"]

_HYSTERESIS = 0.1  # of the distance from the threshold to the nearer level
_ON_RISE = 0.12  # of the step: samples next to a crossing further than this from their level lie on the rise
_SHORT_PAUSE = 0.25  # of the usual pause between pulses: after a shorter one, a pulse is a bounce of the one before
_EQUAL_PAUSE, _USUAL = 0.1, 0.45  # how much equal pauses may differ; pauses over the commonest ones that are usual
_BOUNCES = 0.2  # of all edges from which on bounces are no single strays
_HALF_WIDTH = 24  # samples of the interpolation kernel on each side
_KAISER = 8.0  # parameter of the Kaiser window: side lobes below -80 dB


@dataclass(frozen=True)
class Edges(Arrays, shapes="lower_s E; upper_s E; estimate_s E"):
    """Edges of a trigger signal, in seconds from the record's first sample.

    Attributes
    ----------
    lower_s, upper_s : (E,), last sample below the level, and first at or above it, in s.
    estimate_s : (E,), the middle of both, or the crossing of the reconstructed signal.
    kind : "sampled" where no sample lies on the rise, "resolved" where the crossing is reconstructed.
    u_reading_s : effect of the samples' noise on a resolved crossing.
    record_s : length of the record in s.
    threshold : level used.
    bounces : edges left out because their pulses begin right after others end.
    """

    lower_s: FloatArray
    upper_s: FloatArray
    estimate_s: FloatArray
    kind: EdgeKind
    u_reading_s: float
    record_s: float
    threshold: float
    bounces: int = 0

    def __repr__(self) -> str:
        return f"Edges({len(self.lower_s)} in {self.record_s:g} s, {self.kind}, at threshold {self.threshold:g})"


def find_edges(
    samples: FloatArray,
    sample_rate_hz: float,
    threshold: float | None = None,
    edge: Literal["rising", "falling"] = "rising",
) -> Edges:
    """Find the crossings of a threshold in a sampled signal.

    Parameters
    ----------
    samples
        (S,), finite samples.
    sample_rate_hz
        Sampling rate in Hz.
    threshold
        Level; default midway between the 5 % and 95 % quantiles, or between the smallest and largest sample where
        pulses are shorter than 5 % of the record.
    edge
        "rising" (default) or "falling".

    Returns
    -------
    The edges with their intervals and estimates.

    Raises
    ------
    ValueError
        Samples are not finite, or the signal does not cross the threshold.

    Notes
    -----
    A hysteresis of 10 % of the step prevents noise from counting twice. Where most edges have a sample on the rise, the
    crossing is that of the signal reconstructed by a Kaiser-windowed sinc. It is exact for a band-limited input, and a
    start for `shaker.timebase.trigger` for other rises. Where pulses regularly occur twice or more, as from a bouncing
    contact, the first edge of each counts.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import find_edges
    >>> pulses = (np.arange(2000) % 200 >= 190).astype(float)
    >>> find_edges(pulses, sample_rate_hz=10e3)
    Edges(10 in 0.2 s, sampled, at threshold 0.5)
    """
    check_shape("samples", samples, (None,))
    if not np.all(np.isfinite(samples)):
        raise ValueError(f"samples: expected numbers, found {int(np.sum(~np.isfinite(samples)))} NaN or infinite")
    if edge not in ("rising", "falling"):
        raise ValueError(f'edge: expected "rising" or "falling", found "{edge}"')
    sign = 1.0 if edge == "rising" else -1.0
    signal = sign * samples
    low, high = (float(q) for q in np.quantile(signal, [0.05, 0.95]))
    lowest, highest = float(signal.min()), float(signal.max())
    noise = float(np.median(np.abs(np.diff(signal)))) / 0.954 if len(signal) > 1 else 0.0
    if not high - low > max(8.0 * noise, 0.05 * (highest - lowest)):
        low, high = lowest, highest
    level = (low + high) / 2.0 if threshold is None else sign * threshold
    if not low < level < high and abs(level - (lowest + highest) / 2.0) < 0.4 * (highest - lowest):
        low, high = lowest, highest  # a quantile lies on the rise
    if not low < level < high:
        raise ValueError(
            f"threshold: expected a level that the signal crosses, found {sign * level:.6g} while the "
            f"signal stays between {samples.min():.6g} and {samples.max():.6g}"
        )
    hysteresis = _HYSTERESIS * min(level - low, high - level)
    every = _crossings(signal, level, hysteresis)
    after = _without_bounces(every, _crossings(-signal, -level, hysteresis))
    bounces = len(every) - len(after)
    step = 1.0 / sample_rate_hz
    upper = np.asarray(step * after, dtype=np.float64)
    length_s = step * len(samples)
    edges = Edges(upper - step, upper, upper - step / 2.0, "sampled", 0.0, length_s, sign * level, bounces)
    rest, pulse = np.median(signal[signal < level]), np.median(signal[signal >= level])
    off = np.maximum(signal[after - 1] - rest, pulse - signal[after]) / (pulse - rest)
    if len(after) and np.median(off) > _ON_RISE:  # samples on the rise: it is resolved, and band-limited
        crossing, noise = _reconstruct_crossings(signal, after, level)
        return replace(edges, estimate_s=step * crossing, kind="resolved", u_reading_s=step * noise)
    return edges


def _crossings(signal: FloatArray, level: float, hysteresis: float) -> IntArray:
    """Return the first sample at or above `level` of each rise through the hysteresis band."""
    outside = np.flatnonzero(np.abs(signal - level) >= hysteresis)
    high = signal[outside] > level
    # A rise begins at the last low sample before a high one.
    last_low = outside[:-1][~high[:-1] & high[1:]]
    crossing = np.flatnonzero((signal[:-1] < level) & (signal[1:] >= level)) + 1
    return np.asarray(crossing[np.searchsorted(crossing, last_low, side="right")], dtype=np.int64)


def _without_bounces(rises: IntArray, falls: IntArray) -> IntArray:
    """Return the rises (E,) without those right after a fall, where such bounces are regular.

    The usual pause is the longest common one: of pulses that occur twice, that between the pairs.
    """
    last = np.searchsorted(falls, rises) - 1
    pause = np.full(len(rises), np.inf)
    pause[last >= 0] = rises[last >= 0] - falls[last[last >= 0]]
    finite = np.sort(pause[np.isfinite(pause)])
    if len(finite) < 3:
        return rises
    like = np.searchsorted(finite, finite * (1.0 + _EQUAL_PAUSE)) - np.searchsorted(
        finite, finite * (1.0 - _EQUAL_PAUSE)
    )
    usual = float(np.max(finite[like >= _USUAL * like.max()]))
    bounce = pause < _SHORT_PAUSE * usual
    return rises[~bounce] if np.count_nonzero(bounce) >= _BOUNCES * len(rises) else rises


def _reconstruct_crossings(signal: FloatArray, after: IntArray, level: float) -> tuple[FloatArray, float]:
    """Return the band-limited crossings between sample after-1 and after, and their noise, in samples."""
    tap = np.arange(-_HALF_WIDTH, _HALF_WIDTH)
    index = np.clip(after[:, None] + tap, 0, len(signal) - 1)
    local = signal[index] - level
    low, high = np.full(len(after), -1.0), np.zeros(len(after))
    for _ in range(40):
        middle = (low + high) / 2.0
        above = _interpolate(local, tap, middle) >= 0.0
        high, low = np.where(above, middle, high), np.where(above, low, middle)
    estimate = (low + high) / 2.0
    slope = (_interpolate(local, tap, estimate + 0.05) - _interpolate(local, tap, estimate - 0.05)) / 0.1
    # Noise of single samples, seen in second differences where the signal is at rest, divided by the slope.
    noise = float(np.median(np.abs(np.diff(signal, 2)))) / (0.6745 * np.sqrt(6.0))
    return after + estimate, noise / float(np.median(np.abs(slope)))


def _interpolate(local: FloatArray, tap: IntArray, position: FloatArray) -> FloatArray:
    """Return the signal at fractional positions (E,) by a Kaiser-windowed sinc."""
    distance = position[:, None] - tap
    inside = np.clip(1.0 - (distance / _HALF_WIDTH) ** 2, 0.0, None)
    kernel = np.sinc(distance) * np.i0(_KAISER * np.sqrt(inside)) / np.i0(_KAISER)
    return np.asarray(np.sum(local * kernel, axis=1) / np.sum(kernel, axis=1))


# Numbers of the edges of a periodic trigger: which edge is which period, and which are none.

_ALTERNATING, _MOSTLY = 0.1, 0.8  # of two distances by which they alternate; of all that do
_CAPTURE = 0.2  # of a period: an edge further from its expected time is spurious


@dataclass(frozen=True)
class Numbering(Arrays, shapes="number E; accepted E"):
    """Number of every edge (E,), accepted edges (E,), and how many are rejected."""

    number: IntArray
    accepted: BoolArray
    doubled: int
    spurious: int


def number_edges(edges: Edges) -> Numbering:
    """Number the edges by the period that most of them share.

    Of several edges near one expected time the nearest is accepted, and the others are doubled. Edges far from every
    expected time are spurious.
    """
    time = edges.estimate_s
    if len(time) < 3:
        raise ValueError(f"edges: expected at least 3 edges, found {len(time)}")
    _check_no_alternation(np.diff(time))
    period = _period(time, edges.upper_s - edges.lower_s)
    start = period * np.angle(np.mean(np.exp(2j * np.pi * time / period))) / (2.0 * np.pi)
    # The first line is drawn aside by doubled edges; one through the edges that agree with each other is not.
    for _ in range(3):
        position = (time - start) / period
        number = np.round(position).astype(np.int64)
        distance = np.abs(position - number)
        accepted = distance <= _CAPTURE
        # Of several edges with one number the nearest to the expected time is accepted.
        order = np.lexsort((distance, number))
        accepted[order[1:][np.diff(number[order]) == 0]] = False
        accepted = _without_outliers(number, edges, accepted)
        count = int(np.count_nonzero(accepted))
        if count < 3 or 2 * count < len(time):
            raise ValueError(
                f"edges: expected at least 3 edges of one period and half of all, found {count} of {len(time)}"
            )
        period, start = np.polyfit(number[accepted], time[accepted], 1)
    near = np.abs((time - start) / period - number) <= _CAPTURE
    doubled = int(np.count_nonzero(~accepted & near & np.isin(number, number[accepted])))
    return Numbering(number, accepted, doubled, int(np.count_nonzero(~accepted)) - doubled)


def _check_no_alternation(gap: FloatArray) -> None:
    """Refuse edges whose distances alternate between two values, since their period is ambiguous."""
    if len(gap) < 4:
        return
    pair, difference = gap[1:] + gap[:-1], np.abs(gap[1:] - gap[:-1])
    both = float(np.median(pair))
    alternate = (np.abs(pair - both) < 0.5 * _ALTERNATING * both) & (difference > _ALTERNATING * both)
    short, long = (float(np.median(part)) for part in np.array_split(np.sort(gap), 2))
    if np.mean(alternate) > _MOSTLY:
        raise ValueError(
            f"edges: expected equal distances, found distances that alternate between {short:.6g} s and {long:.6g} s: "
            f"every pulse twice, every third one lost, or two triggers on one line"
        )


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


def _without_outliers(number: IntArray, edges: Edges, accepted: BoolArray) -> BoolArray:
    """Reject edges further than 6 robust standard deviations from a straight line through the others."""
    resolution = (1.5 if edges.kind == "sampled" else 0.1) * float(np.median(edges.upper_s - edges.lower_s))
    for _ in range(10):
        if np.count_nonzero(accepted) < 3:
            break
        line = np.polynomial.Polynomial.fit(number[accepted], edges.estimate_s[accepted], 1)
        deviation = np.abs(edges.estimate_s - line(number))
        spread = 1.4826 * float(np.median(deviation[accepted]))
        stay = accepted & (deviation <= max(6.0 * spread, resolution))
        if np.array_equal(stay, accepted):
            break
        accepted = stay
    return accepted


# Posterior of straight lines given intervals, by adaptive importance sampling.

_POINTS, _LAST_POINTS = 250, 1000  # while the proposals settle, and afterwards
_WIDER = 1.35  # of the standard deviation: proposals reach over the corners of a polygon
_ROUNDS = 30  # of fitting a proposal at most
_SETTLED = 0.15  # relative change of the standard deviations below which the sampling has settled
_STRAY = 1e-6  # probability of an edge that the model does not explain
_STEP = 1.0  # in the logarithm of the jitter
_STEEP = 2.0  # change of the log-likelihood from step to step above which a step is halved
_MIN_STEP = 0.02  # in the logarithm of the jitter; chosen
_NEGLIGIBLE_JITTER = 0.1  # of the line's smallest standard deviation: smaller jitter has no effect
_NEGLIGIBLE_SHARE = 1e-4  # share of the whole below which a step of the jitter does not count
_NODES, _WIDE_NODES, _FARTHEST = 512, 64, 9.0  # of Φ and of ln ΔΦ: how many for one standard deviation, up to where
_AT_ONCE = 16384  # values of Φ: their memory stays in the processor's cache
_EQUAL_WIDTH = 1e-6  # relative difference between the widths of intervals that one record reads


@dataclass(frozen=True)
class Posterior(Arrays, shapes="mean P; covariance P P"):
    """Mean (P,) and covariance (P, P) of the parameters, and the mean jitter, in seconds."""

    mean: FloatArray
    covariance: FloatArray
    jitter_s: float


@dataclass(frozen=True)
class Slopes(Arrays, shapes="mean R; weight R R"):
    """External information about the half spans h (R,) of R lines.

    They are normal about `mean` (R,) with the inverse covariance `weight` (R, R), which is singular where only a
    combination of them is stated.
    """

    mean: FloatArray
    weight: FloatArray

    def update(self, line: Posterior) -> Posterior:
        """Return normal lines updated with this reading by linear least squares."""
        select = np.kron(np.eye(len(self.mean)), [0.0, 1.0])
        cross = line.covariance @ select.T
        covariance, difference = select @ cross, self.mean - select @ line.mean
        gain = cross @ np.linalg.solve(np.eye(len(covariance)) + self.weight @ covariance, self.weight)
        left = line.covariance - gain @ cross.T
        return Posterior(line.mean + gain @ difference, (left + left.T) / 2.0, line.jitter_s)

    def log_likelihood(self, points: FloatArray) -> FloatArray:
        """Return the log-likelihood (N,) of lines (N, 2R)."""
        off = points[:, 1::2] - self.mean
        return np.asarray(-0.5 * np.einsum("nr,rs,ns->n", off, self.weight, off))


def line_posterior(
    position: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    start: Posterior,
    min_jitter_s: float,
    slopes: Slopes | None = None,
) -> Posterior:
    """Return the posterior of one line of instants per record.

    Record r has edge e, with jitter ε_e common to all records, at m_r + h_r·position_e + ε_e in the interval (lower_re,
    upper_re] (R, E), infinite for an edge that it has not seen. Parameters: m_1 h_1 m_2 h_2 …. The likelihood of an
    edge is Φ(b/σ) - Φ(a/σ) with a the largest lower and b the smallest upper bound minus its line; σ is unknown,
    log-uniform above `min_jitter_s`. The posterior tends to the polygon of all intervals as the jitter vanishes and to
    the paired differences as it grows. `start` need only be roughly right; `slopes` is a further factor of the
    likelihood.

    Lines and jitter together fill a funnel that no Gaussian proposal fits. The lines are therefore sampled for one
    jitter after another, in smaller steps where the likelihood is steep, and averaged.
    """
    width = upper - lower
    most = 3.0 * start.jitter_s + 0.3 * float(np.median(width[np.isfinite(width)]))
    left = float(np.log(max(most / min_jitter_s, 3.0)))
    start = start if slopes is None else slopes.update(start)
    intervals, line = (position, lower, upper, slopes), (start.mean, start.covariance)
    steps: list[_JitterStep] = []
    while left > 0.0:
        step = _at_jitter(float(np.log(min_jitter_s)) + left, min(left, _STEP), line, intervals)
        best, line = max([step.log_weight, *(s.log_weight for s in steps)]), (step.mean, step.covariance)
        settled = step.jitter_s < _NEGLIGIBLE_JITTER * np.sqrt(np.diagonal(step.covariance).min())
        steps.append(replace(step, width=left) if settled else step)
        left -= left if settled or step.log_weight < best + np.log(_NEGLIGIBLE_SHARE) else step.width
    while True:
        steep = np.abs(np.diff([s.log_likelihood for s in steps])) > _STEEP
        halved = (_shares(steps) > 0.01) & (np.array([s.width for s in steps]) > _MIN_STEP)
        halved &= np.append(steep, False) | np.append(False, steep)
        if not halved.any():
            break
        steps = [
            part for s, split in zip(steps, halved, strict=True) for part in (s.halves(intervals) if split else (s,))
        ]
    points, share = _normal_points(len(start.mean)), _shares(steps)
    steps = [_sample(s, points, intervals)[0] for s, of in zip(steps, share, strict=True) if of > _NEGLIGIBLE_SHARE]
    share = _shares(steps)
    means = np.array([s.mean for s in steps])
    mean = share @ means
    covariance = np.einsum("j,jpq->pq", share, np.array([s.covariance for s in steps]))
    covariance += (share[:, None] * (means - mean)).T @ (means - mean)
    return Posterior(mean, covariance, float(share @ [s.jitter_s for s in steps]))


_Intervals = tuple[FloatArray, FloatArray, FloatArray, Slopes | None]


@dataclass(frozen=True)
class _JitterStep:
    """Mean and covariance of lines at a step `width` down from `top` in ln jitter."""

    top: float
    width: float
    log_likelihood: float
    mean: FloatArray
    covariance: FloatArray

    @property
    def log_weight(self) -> float:
        """Logarithm of the integral of the likelihood over the step."""
        return self.log_likelihood + float(np.log(self.width))

    @property
    def jitter_s(self) -> float:
        """Jitter in the middle of the step."""
        return float(np.exp(self.top - 0.5 * min(self.width, _STEP)))

    def halves(self, intervals: _Intervals) -> tuple[_JitterStep, _JitterStep]:
        """Return the two halves of the step."""
        line, half = (self.mean, self.covariance), 0.5 * self.width
        return _at_jitter(self.top, half, line, intervals), _at_jitter(self.top - half, half, line, intervals)


def _shares(steps: Sequence[_JitterStep]) -> FloatArray:
    """Return the share of each step in the integral of the likelihood."""
    log_weight = np.array([step.log_weight for step in steps])
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


def _at_jitter(top: float, width: float, line: tuple[FloatArray, FloatArray], intervals: _Intervals) -> _JitterStep:
    """Return a step of the jitter. `line`: mean and covariance of the first proposal.

    Gaussian proposals are fitted to the weighted points until they settle, tempered where few points have most of the
    weight (Cappé et al., Statistics and Computing 18, 2008: adaptive importance sampling). The points are a
    low-discrepancy sequence, not random numbers.
    """
    step = _JitterStep(top, width, -np.inf, *line)
    normal = _normal_points(len(step.mean))[:_POINTS]
    for _ in range(_ROUNDS):
        old = step.covariance
        step, power = _sample(step, normal, intervals)
        change = np.sqrt(np.diagonal(step.covariance) / np.diagonal(old)) - 1.0
        if power == 1.0 and np.max(np.abs(change)) < _SETTLED:
            break
    return step


def _sample(step: _JitterStep, normal: FloatArray, intervals: _Intervals) -> tuple[_JitterStep, float]:
    """Return the step from weighted points, and their power: 1 where a twentieth counts."""
    root = _WIDER * np.linalg.cholesky(step.covariance)
    points = step.mean + normal @ root.T
    log_weight = _log_likelihood(points, step.jitter_s, intervals) + 0.5 * np.sum(normal**2, axis=1)
    highest = float(log_weight.max())
    size = highest + float(np.log(np.mean(np.exp(log_weight - highest))) + np.sum(np.log(np.diagonal(root))))
    power = 1.0
    while True:
        weight = np.exp(power * (log_weight - highest))
        weight /= weight.sum()
        if 1.0 / np.sum(weight**2) >= len(weight) / 20.0:
            break
        power *= 0.7
    mean = weight @ points
    centred = points - mean
    return replace(step, log_likelihood=size, mean=mean, covariance=(weight[:, None] * centred).T @ centred), power


def _log_likelihood(points: FloatArray, jitter: float, intervals: _Intervals) -> FloatArray:
    """Return the log-likelihood (N,) of points (N, 2R), a line per record, at a jitter."""
    position, lower, upper, slopes = intervals
    width = upper[0] - lower[0]
    equal_widths = len(lower) == 1 and np.ptp(width) <= _EQUAL_WIDTH * width.max()
    chance = _log_chance(float(width.mean()) / jitter) if equal_widths else None
    result, rows = np.empty(len(points)), max(1, _AT_ONCE // len(position))
    for first in range(0, len(points), rows):
        line = points[first : first + rows].T[:, :, None]
        lines = line[::2] + line[1::2] * position
        below, above = (lower[:, None] - lines).max(axis=0), (upper[:, None] - lines).min(axis=0)
        # Edges whose intervals include every line with a margin contribute no information.
        telling = (below.max(axis=0) > -6.0 * jitter) | (above.min(axis=0) < 6.0 * jitter)
        below, above = below[:, telling] / jitter, above[:, telling] / jitter
        if chance is not None:
            each = _series(np.minimum(above, -below), chance, _WIDE_NODES)
        else:
            each = np.log(np.maximum(normal_cdf(above) - normal_cdf(below), 0.0) + _STRAY)
        result[first : first + rows] = each.sum(axis=1)
    return result if slopes is None else result + slopes.log_likelihood(points)


@lru_cache(4)  # proposals of one jitter follow each other
def _log_chance(width: float) -> FloatArray:
    """Return Taylor's series (3, N) of an interval's log-likelihood, to 10⁻⁶.

    It is ln(Φ(v) - Φ(v - width) + a stray's). Units: the jitter. v is the distance of lines inside the nearer bound of
    intervals of one width.
    """
    node = np.arange(2.0 * _WIDE_NODES * _FARTHEST + 1.0) / _WIDE_NODES - _FARTHEST
    share = normal_cdf(node) - normal_cdf(node - width) + _STRAY
    first, second = (np.exp(-0.5 * end**2) / np.sqrt(2.0 * np.pi) for end in (node, node - width))
    slope = (first - second) / share
    bend = ((node - width) * second - node * first) / share - slope**2
    return np.stack([np.log(share), slope, bend / 2.0])


def normal_cdf(x: FloatArray) -> FloatArray:
    """Return Φ(x) to 2·10⁻¹⁴ by Taylor's series of third order.

    Its nodes are 1/512 apart. SciPy's function adds a sixth to the time of `check` and `lines`, by its import.
    """
    return _series(x, _normal_series(), _NODES)


def _series(x: FloatArray, coefficients: FloatArray, nodes: int) -> FloatArray:
    """Return Taylor's series (K, N) at x; `nodes` per standard deviation from -9 to 9."""
    flat, found = x.ravel(), np.empty(x.size)
    for first in range(0, x.size, _AT_ONCE):
        off = np.clip(flat[first : first + _AT_ONCE], -_FARTHEST, _FARTHEST)
        node_index = (nodes * off + (nodes * _FARTHEST + 0.5)).astype(np.intp)
        off -= node_index / nodes - _FARTHEST
        *lower, highest = (order.take(node_index) for order in coefficients)
        found[first : first + _AT_ONCE] = reduce(lambda value, order: order + off * value, lower[::-1], highest)
    return found.reshape(x.shape)


@cache
def _normal_series() -> FloatArray:
    """Return the coefficients (4, N) of Taylor's series at the nodes."""
    node = np.arange(2.0 * _NODES * _FARTHEST + 1.0) / _NODES - _FARTHEST
    density = np.exp(-0.5 * node**2) / np.sqrt(2.0 * np.pi)
    value = np.array([0.5 * erfc(x) for x in (-node / np.sqrt(2.0)).tolist()])
    return np.stack([value, density, -density * node / 2.0, density * (node**2 - 1.0) / 6.0])


@cache
def _normal_points(dimensions: int) -> FloatArray:
    """Return standard normal points (N, D) from the additive recurrence with the generalised golden ratio."""
    ratio = 1.5
    for _ in range(50):  # ratio^(D + 1) = ratio + 1
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    step = ratio ** -np.arange(1.0, dimensions + 1)
    chance = (0.5 + np.arange(1.0, _LAST_POINTS + 1)[:, None] * step) % 1.0
    points = np.array([[NormalDist().inv_cdf(p) for p in row] for row in chance.tolist()])
    points.flags.writeable = False
    return points


# A sampled signal read at other times: band-limited interpolation.

PASS_BAND = 0.4
"""Share of the lower of the two rates below which a resampled signal is unchanged."""
_BETA = 10.06  # Kaiser window of -100 dB
_BLOCK = 1 << 14  # times interpolated at once
_PHASES = 1 << 11  # rows of the kernel's table per sample; linear in between errs by less than 1e-6


def kernel_reach(share: float) -> int:
    """Return how many samples on either side of a time enter its value.

    `share` is the new rate over the old one. Half of Kaiser's N = (A - 8)/(2.285·Δω) for A = 100 dB and the transition
    from 0.4 to 0.6 of the lower rate.
    """
    taps = (100.0 - 8.0) / (2.285 * 2.0 * np.pi * (1.0 - 2.0 * PASS_BAND) * share)
    return int(np.ceil(0.5 * taps))


@lru_cache(maxsize=4)
def _kernel(share: float) -> FloatArray:
    """Return weights of the samples around a time, by its phase between two samples."""
    reach = kernel_reach(share)
    distance = np.arange(1 - reach, reach + 1) - np.linspace(0.0, 1.0, _PHASES + 1)[:, None]
    table = np.sinc(share * distance) * np.i0(_BETA * np.sqrt(np.maximum(0.0, 1.0 - (distance / reach) ** 2)))
    return np.asarray(table / table.sum(axis=1, keepdims=True))


def resample(samples: FloatArray, position: FloatArray, share: float = 1.0) -> FloatArray:
    """Return samples (S,) at fractional positions (T,), counted in samples from the first one.

    Convolution with a sinc of the pass band up to half of `share` of the sampling rate, with a Kaiser window (Kaiser
    and Schafer, IEEE Trans. Acoust. 28, 1980). A line below 0.4·`share` of the rate keeps amplitude and phase to 3e-5.
    Lines above 0.6·`share`, which would alias onto it at a rate of `share`, are attenuated by 100 dB. `share` is the
    new rate over the old one where that is lower. Positions must lie `kernel_reach` inside the record.
    """
    check_shape("samples", samples, (None,))
    check_shape("position", position, (None,))
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share: expected a number above 0 and at most 1, found {share:g}")
    reach = kernel_reach(share)
    low, high = float(position.min(initial=reach)), float(position.max(initial=reach))
    if low < reach - 1 or high > len(samples) - reach:
        raise ValueError(
            f"position: expected {reach - 1} to {len(samples) - reach} samples, found {low:.1f} to {high:.1f}"
        )
    table = _kernel(share)
    offsets = np.arange(1 - reach, reach + 1)
    found = np.empty(len(position))
    for start in range(0, len(position), _BLOCK):
        part = position[start : start + _BLOCK]
        first = np.floor(part).astype(np.int64)
        row, between = np.divmod((part - first) * _PHASES, 1.0)
        table_row = row.astype(np.int64)
        near = samples[first[:, None] + offsets]
        lower, upper = (np.einsum("ts,ts->t", table[table_row + step], near) for step in (0, 1))
        found[start : start + _BLOCK] = lower + between * (upper - lower)
    return found
