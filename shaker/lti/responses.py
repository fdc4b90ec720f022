"""Gain over frequency and step response of a system: peak, bands, overshoot, rise, settling.

All figures are computed to the last digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from shaker.lti.system import LinearSystem, exponentials_between
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, IntArray

STEPS = 120  # of a root search at most; chosen
TINY = 2.0 * float(np.finfo(np.float64).eps)
"""Share of a root to which it is found."""


def sign_changes(value: FloatArray) -> IntArray:
    """Return the indices i after which `value` (N,) changes sign."""
    positive = value > 0
    return np.asarray(np.flatnonzero(positive[1:] != positive[:-1]), dtype=np.int64)


def roots_between(function: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray) -> FloatArray:
    """Return roots (R,) between `low` and `high`, where the function has different signs.

    Inverse quadratic interpolation where it is safe, else bisection (Chandrupatla, Adv. Eng. Softw. 28 (1997) 145-149).
    """
    at_low, at_high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if not len(at_high):
        return at_high
    other, point = np.array([at_low, function(at_low)]), np.array([at_high, function(at_high)])  # position and value
    ahead = np.full(len(at_high), 0.5)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            new = point[0] + ahead * (other[0] - point[0])
            at_new = np.array([new, function(new)])
            same = np.sign(at_new[1]) == np.sign(point[1])
            third, other, point = np.where(same, point, other), np.where(same, other, point), at_new
            span = other - point
            least = TINY * np.abs(np.where(np.abs(point[1]) < np.abs(other[1]), point[0], other[0])) / np.abs(span[0])
            found = ~(least <= 0.5) | (point[1] == 0) | (other[1] == 0)
            if found.all():
                break
            beyond, gap = third - point, other - third
            where, level = span / gap
            safe = (level**2 < where) & ((1.0 - level) ** 2 < 1.0 - where)
            interpolated = third[1] / span[1] - beyond[0] / span[0] / beyond[1] * other[1]
            interpolated *= point[1] / gap[1]
            ahead = np.minimum(np.maximum(np.where(safe, interpolated, 0.5), least), 1.0 - least)
            ahead[found] = 0.0
    nearer = np.where(np.abs(point[1]) < np.abs(other[1]), point[0], other[0])
    return np.asarray(np.where(point[1] == 0, point[0], np.where(other[1] == 0, other[0], nearer)))


# Where the gain of a system peaks, falls and leaves a band, over frequency.


POINTS = 60
"""Points per decade of distance from every pole and zero."""


@dataclass(frozen=True, repr=False)
class GainCurve(Arrays):
    """|H| over frequency: `edges_hz` (E,) from 0 with `gain` (E,), monotonic in between.

    The last edge is half the sampling rate. For a continuous system it is far above every pole and zero, where |H| has
    its final slope. `points_hz` (G,), ascending, with `response` (G,), are dense near poles and zeros.
    """

    system: LinearSystem
    edges_hz: FloatArray
    gain: FloatArray
    points_hz: FloatArray
    response: ComplexArray
    passed: dict[float, FloatArray] = field(default_factory=dict, compare=False)

    def crossings(self, *levels: float) -> list[float]:
        """Return every frequency in Hz at which |H| crosses a level; each is searched once."""
        new = [level for level in dict.fromkeys(levels) if level not in self.passed]
        if new:
            self._search(new)
        return [float(root) for root in np.sort(np.concatenate([self.passed[level] for level in levels]))]

    def _search(self, new: Sequence[float]) -> None:
        """Find the frequencies at which |H| crosses new levels, in one search."""
        hertz, order = np.unique(np.concatenate([self.edges_hz, self.points_hz]), return_index=True)
        gain = np.concatenate([self.gain, np.abs(self.response)])[order]
        changes = [sign_changes(gain - level) for level in new]
        counts, changed = [len(indices) for indices in changes], np.concatenate(changes)
        level = np.repeat(new, counts)

        def above(at: FloatArray) -> FloatArray:
            return np.asarray(np.abs(self.system.response(at)) / level - 1.0)

        roots = roots_between(above, hertz[changed], hertz[changed + 1])
        self.passed.update(zip(new, np.split(roots, np.cumsum(counts)[:-1]), strict=True))

    def inside(self, low: float, high: float) -> list[tuple[float, float]]:
        """Return the ranges of frequency in Hz with low ≤ |H| ≤ high."""
        ends = [0.0, *self.crossings(low, high), float(self.edges_hz[-1])]
        middle = np.abs(self.system.response(np.array([0.5 * (begin + end) for begin, end in pairwise(ends)])))
        ranges: list[tuple[float, float]] = []
        for (begin, end), gain in zip(pairwise(ends), middle, strict=True):
            if low <= gain <= high:
                joined = bool(ranges) and ranges[-1][1] == begin
                ranges.append((ranges.pop()[0] if joined else begin, end))
        if ranges and self.system.sample_rate_hz is None and ranges[-1][1] == ends[-1]:
            ranges[-1] = (ranges[-1][0], np.inf)
        return ranges


def gain_curve(system: LinearSystem) -> GainCurve:
    """Return |H| over frequency in monotonic pieces.

    The turning points are the zeros of d ln|H|/dω between points that are dense near poles and zeros: no resonance is
    too narrow.
    """
    grid = _grid(system)
    turning = sign_changes(log_slope(system, grid))
    turns = roots_between(lambda hertz: log_slope(system, hertz), grid[turning], grid[turning + 1])
    edges = np.concatenate([[0.0], turns, grid[-1:]])
    return GainCurve(system, edges, np.abs(system.response(edges)), grid, system.response(grid))


def roots_rad(system: LinearSystem) -> tuple[ComplexArray, ComplexArray]:
    """Return zeros and poles in rad/s; those of samples are ln(z)·rate without z = 0."""
    if system.sample_rate_hz is None:
        return system.zeros, system.poles
    zeros, poles = (np.log(part[part != 0]) * system.sample_rate_hz for part in (system.zeros, system.poles))
    return np.asarray(zeros), np.asarray(poles)


def _grid(system: LinearSystem) -> FloatArray:
    """Return ascending frequencies (G,) in Hz that are dense near zeros and poles."""
    features = np.concatenate(roots_rad(system))
    features = features[np.abs(features) > 0] / (2 * np.pi)
    if not len(features):
        features = np.ones(1, dtype=np.complex128)
    sizes = np.abs(features)
    least, most = 1e-4 * sizes.min(), 1e3 * sizes.max()
    if system.sample_rate_hz is not None:
        most = 0.5 * system.sample_rate_hz
    parts = [np.geomspace(min(least, 1e-3 * most), most, int(POINTS * np.log10(most / min(least, 1e-3 * most))) + 2)]
    for feature, size in zip(features, sizes, strict=True):
        if feature.imag <= 0:
            continue
        width = max(abs(feature.real), 1e-9 * size)
        distance = np.geomspace(1e-2 * width, size, int(POINTS * np.log10(1e2 * size / width)) + 2)
        parts += [feature.imag - distance, feature.imag + distance]
    grid = np.unique(np.concatenate([*parts, [most]]))
    return np.asarray(grid[(grid > 0) & (grid <= most)])


def log_slope(system: LinearSystem, hertz: FloatArray) -> FloatArray:
    """Return d ln|H|/dω (K,) at frequencies in Hz, 0 on a zero or pole."""
    x = 2j * np.pi * np.asarray(hertz)
    change: ComplexArray = np.full(len(x), 1j)
    if system.sample_rate_hz is not None:
        x = np.exp(x / system.sample_rate_hz)
        change = 1j * x / system.sample_rate_hz
    offset = x[:, None] - np.concatenate([system.zeros, system.poles])
    sense = np.repeat([1.0, -1.0], [len(system.zeros), len(system.poles)])
    hit = offset == 0
    slope = (change * np.sum(sense / np.where(hit, 1.0, offset), axis=1)).real
    return np.asarray(np.where(np.any(hit, axis=1), 0.0, slope))


def band_edges(reference: float, tolerance: float) -> tuple[float, float]:
    """Return the levels of |H| at ±`tolerance` from |`reference`|."""
    return (1 - tolerance) * abs(reference), (1 + tolerance) * abs(reference)


def band_end(curve: GainCurve, reference: float, tolerance: float) -> float | None:
    """Return the end of the band within ±`tolerance` of |`reference`|; None if |H(0)| is outside."""
    ranges = curve.inside(*band_edges(reference, tolerance))
    return ranges[0][1] if ranges and ranges[0][0] == 0.0 else None


def half_power(curve: GainCurve) -> float | None:
    """Return the frequency in Hz at which |H| first falls below |H(0)|/√2, else None."""
    if curve.gain[0] == 0:
        return None
    return next(iter(curve.crossings(float(curve.gain[0]) / np.sqrt(2.0))), None)


def peak(curve: GainCurve) -> tuple[float, float] | None:
    """Return frequency in Hz and |H| of the highest maximum, None if |H| only falls."""
    index = int(np.argmax(curve.gain))
    if index in (0, len(curve.gain) - 1):
        return None
    return float(curve.edges_hz[index]), float(curve.gain[index])


def quadrature(curve: GainCurve) -> float | None:
    """Return the first frequency in Hz at which H is 90° from H(0), else None."""
    first = sign_changes(curve.response.real)[:1]
    if not len(first) or curve.gain[0] == 0:
        return None
    ends = curve.points_hz[first], curve.points_hz[first + 1]
    return float(roots_between(lambda hertz: np.asarray(curve.system.response(hertz).real), *ends)[0])


# Overshoot, rise and settling of the response to a step.


PER_PERIOD = 48
"""Points per period, or per time constant, of the fastest pole that still matters."""
SAMPLES = 1 << 22
"""Longest response of a sampled system that is computed."""
BLOCK = 1024  # points of a response computed at a time
SHORT = 0.01
"""Share by which a turning point may lie beyond the points around it: 1 - cos(π/48) is a fifth of that."""
SETTLING_REACH = 5.0  # ratio of levels within which turning points are sought about a tolerance; chosen
FORGOTTEN = 1e-8
"""Share of the final value below which a pole's part no longer decides where the grid's points lie."""

COINCIDING = 1e12
"""Bound of the parts over the final value where poles coincide and the parts are undefined."""


@dataclass(frozen=True)
class Transient:
    """Figures of a step response in s and over the final value.

    `highest_s`: time of the highest value; `passing_s` (2,): when 10 and 90 % are first reached, of a continuous
    system.
    """

    overshoot: float | None = None
    rise_s: float | None = None
    settling_2_s: float | None = None
    settling_5_s: float | None = None
    highest_s: float | None = None
    passing_s: tuple[float, float] | None = None


def transient(system: LinearSystem) -> Transient:
    """Return overshoot, rise and settling; None of an unstable system or one without static gain."""
    if not system.stable or not system.static_gain or not np.isfinite(system.static_gain):
        return Transient()
    if not len(system.poles):
        return Transient(0.0, 0.0, 0.0, 0.0)
    if system.sample_rate_hz is not None:
        return _sampled_transient(system, system.sample_rate_hz)
    response = _Response(system)
    passings = [response.first_passing(0.1), response.first_passing(0.9), *map(response.settling, (0.02, 0.05))]
    first, last, settled_2, settled_5 = response.times(passings).tolist()
    over, highest = response.overshoot()
    return Transient(over, last - first, settled_2, settled_5, highest, (first, last))


def settling_turns(system: LinearSystem, tolerance: float) -> tuple[FloatArray, FloatArray] | None:
    """Return turning points (T,) about the settling time, and the response there.

    The times are in s, the response over its final value: from the last of `SETTLING_REACH` times the tolerance to the
    last of its `SETTLING_REACH`-th part. None without settling.
    """
    if not system.stable or not system.static_gain or not len(system.poles) or system.sample_rate_hz is not None:
        return None
    response = _Response(system)
    begin = response.settling(SETTLING_REACH * tolerance).begin
    end, parts = response.settling(tolerance / SETTLING_REACH).end, []
    while begin < end:
        until = begin + BLOCK * response.spacing(begin)
        parts.append(response.extremes(begin, until))
        begin = until
    if not parts:
        return None
    time, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    return time, value


def _sampled_transient(system: LinearSystem, rate: float) -> Transient:
    """Return the figures of a sampled system, with linear interpolation between samples."""
    slowest = float(np.max(np.abs(system.poles)))
    length = len(system.poles) + 64 + (int(40.0 / -np.log(slowest)) if slowest > 0 else 0)
    if length > SAMPLES:
        return Transient()
    ratio = system.step(np.arange(length) / rate) / system.static_gain

    def passing(level: float) -> float:
        index = int(np.argmax(ratio >= level))
        before = ratio[index - 1] if index else 0.0
        return float(index - (ratio[index] - level) / (ratio[index] - before)) if index else 0.0

    def settled(tolerance: float) -> float:
        outside = np.flatnonzero(np.abs(ratio - 1) > tolerance)
        return float((outside[-1] + 1) / rate) if len(outside) else 0.0

    over = max(float(ratio.max()) - 1.0, 0.0)
    return Transient(over, (passing(0.9) - passing(0.1)) / rate, settled(0.02), settled(0.05))


@dataclass(frozen=True)
class _Passing:
    """Bracket in s of the crossing of `level`, a share of the final value."""

    begin: float
    end: float
    level: float


class _Response:
    """A continuous step response over its final value, with a suitable spacing of points."""

    def __init__(self, system: LinearSystem) -> None:
        """Split the response into its poles where they are separate."""
        self.system, self.gain, self.poles = system, system.static_gain, system.poles
        self.slowest = float(np.min(-self.poles.real))
        terms, self.separate = system.step_terms()
        self.terms = terms / self.gain if self.separate else terms
        self.size: FloatArray = np.abs(self.terms) if self.separate else np.full(len(terms), COINCIDING)
        self.pieces: dict[tuple[float, float], tuple[FloatArray, FloatArray]] = {}

    def ratio(self, time_s: FloatArray) -> FloatArray:
        """Return the response over its final value (N,)."""
        if not self.separate:
            return self.system.step(time_s) / self.gain
        return np.asarray(1.0 + np.real(np.exp(time_s[:, None] * self.poles) @ self.terms))

    def slope(self, time_s: FloatArray) -> FloatArray:
        """Return its derivative (N,) in 1/s."""
        if not self.separate:
            return self.system.impulse(time_s) / self.gain
        return np.asarray(np.real(np.exp(time_s[:, None] * self.poles) @ (self.terms * self.poles)))

    def envelope(self, time_s: float) -> float:
        """Return a bound of the remaining oscillation: Σ |r/p|·exp(Re p t) over the final value."""
        return float(np.sum(self.size * np.exp(self.poles.real * time_s)))

    def quiet(self, level: float) -> float:
        """Return a time after which the envelope is below `level`.

        It is accurate within 1e-6 of the slowest time constant. The logarithm of a sum of decays is convex: Newton's
        steps from before that time never pass it.
        """
        decay, time, step = -self.poles.real, 0.0, np.inf
        while step > 1e-6 / self.slowest:
            left = self.size * np.exp(-decay * time)
            total = float(left.sum())
            if total <= level:
                break
            step = total * np.log(total / level) / float(left @ decay)
            time += step
        return time + 1e-6 / self.slowest if time else 0.0

    def spacing(self, time_s: float) -> float:
        """Return the largest suitable distance of points after a time."""
        alive = self.size * np.exp(self.poles.real * time_s) > FORGOTTEN
        fastest = np.max(np.abs(self.poles[alive]), initial=self.slowest)
        return float(2 * np.pi / fastest / PER_PERIOD)

    @cached_property
    def last(self) -> float:
        """Time after which the remaining oscillation affects neither rise time nor overshoot."""
        return self.quiet(1e-4)

    def blocks(self) -> Iterator[tuple[float, float]]:
        """Yield begin and end of pieces with evenly spaced points until the response is settled."""
        begin, last = 0.0, self.last
        while begin < last:
            end = begin + BLOCK * self.spacing(begin)
            yield begin, end
            begin = end

    def coarse(self, begin: float, end: float) -> FloatArray:
        """Return the response at the points of a piece, up to `SHORT` low between."""
        if not self.separate:
            return self.ratio(np.linspace(begin, end, BLOCK + 1))
        return 1.0 + exponentials_between(self.poles, self.terms, begin, end, BLOCK + 1)

    def extremes(self, begin: float, end: float) -> tuple[FloatArray, FloatArray]:
        """Return begin, every turning point and end of a piece, and the response there; cached."""
        if (begin, end) not in self.pieces:
            time = np.linspace(begin, end, BLOCK + 1)
            if self.separate:
                slope = exponentials_between(self.poles, self.terms * self.poles, begin, end, BLOCK + 1)
            else:
                slope = self.slope(time)
            turning = sign_changes(slope)
            turns = np.concatenate([[begin], roots_between(self.slope, time[turning], time[turning + 1]), [end]])
            self.pieces[begin, end] = turns, self.ratio(turns)
        return self.pieces[begin, end]

    def overshoot(self) -> tuple[float, float | None]:
        """Return overshoot and its time; 0 and None without overshoot."""
        best, when = 0.0, None
        for begin, end in self.blocks():
            if float(self.coarse(begin, end).max()) - 1.0 >= (1 - SHORT) * best:
                time, value = self.extremes(begin, end)
                index = int(np.argmax(value))
                if value[index] - 1.0 > best:
                    best, when = float(value[index]) - 1.0, float(time[index])
            if self.envelope(end) <= best:
                break
        return best, when

    def first_passing(self, level: float) -> _Passing:
        """Return the bracket in which the response first reaches a share of the final value."""
        begin = end = 0.0
        for begin, end in self.blocks():
            time, value = self.extremes(begin, end)
            above = np.flatnonzero(value >= level)
            if len(above):
                index = int(above[0])
                return _Passing(float(time[max(index - 1, 0)]), float(time[index]), level)
        return _Passing(end, end, level)

    def settling(self, tolerance: float) -> _Passing:
        """Return the bracket, between two turning points, after which it stays within a tolerance."""
        period = 2 * np.pi / float(np.min(np.abs(self.poles)))
        end = min(self.quiet(tolerance) + period, self.quiet(0.05 * tolerance))
        while end > 0:
            begin = max(0.5 * end, end - BLOCK * self.spacing(0.5 * end)) if end > self.spacing(0.0) else 0.0
            if float(np.abs(self.coarse(begin, end) - 1).max()) < (1 - SHORT) * tolerance:
                end = begin
                continue
            time, value = self.extremes(begin, end)
            outside = np.flatnonzero(np.abs(value - 1) > tolerance)
            if len(outside):
                index = int(outside[-1])
                level = float(1 + np.copysign(tolerance, value[index] - 1))
                return _Passing(float(time[index]), float(time[min(index + 1, len(time) - 1)]), level)
            end = begin
        return _Passing(0.0, 0.0, 1.0)

    def times(self, passings: Sequence[_Passing]) -> FloatArray:
        """Return the times (N,) in s of brackets, all in one search."""
        begin, end, level = np.array([(one.begin, one.end, one.level) for one in passings]).T
        return roots_between(lambda time: self.ratio(time) - level, begin, end)
