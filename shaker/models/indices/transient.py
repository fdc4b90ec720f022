"""Overshoot, rise and settling of the response to a step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import count

import numpy as np

from shaker._checks import FloatArray
from shaker.models.indices.roots import roots_between, sign_changes
from shaker.models.linear_system import LinearSystem

PER_PERIOD = 48
"""Points per period, or per time constant, of the fastest pole that still matters."""
SAMPLES = 1 << 22
"""Longest response of a sampled system that is computed."""
BLOCK = 1024
SHORT = 0.01
"""Share by which a turning point may lie beyond the points around it: 1 - cos(π/48) is a fifth of that."""
FORGOTTEN = 1e-8
"""Share of the final value below which a pole's part no longer decides where the grid's points lie."""

COINCIDING = 1e12
"""Bound of the parts, over the final value, where poles coincide and the parts themselves say nothing."""


@dataclass(frozen=True)
class Transient:
    """Figures of a step response: `overshoot` over the final value; times in s; None where there is none.

    `highest_s`, `passing_s` (2,): when it is highest and when it first reaches 10 and 90 %; of a continuous system.
    """

    overshoot: float | None = None
    rise_s: float | None = None
    settling_2_s: float | None = None
    settling_5_s: float | None = None
    highest_s: float | None = None
    passing_s: tuple[float, float] | None = None


def transient(system: LinearSystem) -> Transient:
    """Return overshoot, rise and settling; nothing for a system that is unstable or has no static gain."""
    if not system.stable or not system.static_gain or not np.isfinite(system.static_gain):
        return Transient()
    if not len(system.poles):
        return Transient(0.0, 0.0, 0.0, 0.0)
    if system.sample_rate_hz is not None:
        return _sampled(system, system.sample_rate_hz)
    response = _Response(system)
    first, last = response.first_passing(0.1), response.first_passing(0.9)
    settled = [float(response.settling(tolerance)[0]) for tolerance in (0.02, 0.05)]
    over, highest = response.overshoot()
    return Transient(over, last - first, settled[0], settled[1], highest, (first, last))


def settling_points(system: LinearSystem, tolerance: float) -> FloatArray | None:
    """Return times (3,) in s of a continuous system: settled, the turning points before and after; None if never."""
    if not system.stable or not system.static_gain or not len(system.poles):
        return None
    return _Response(system).settling(tolerance)


def _sampled(system: LinearSystem, rate: float) -> Transient:
    """Return the figures of a sampled system from its samples, crossings between two of them by a straight line."""
    slowest = float(np.max(np.abs(system.poles)))
    length = len(system.poles) + 64 + (int(40.0 / -np.log(slowest)) if slowest > 0 else 0)
    if length > SAMPLES:
        return Transient()
    ratio = system.step(np.arange(length) / rate) / system.static_gain

    def passing(level: float) -> float:
        place = int(np.argmax(ratio >= level))
        before = ratio[place - 1] if place else 0.0
        return float(place - (ratio[place] - level) / (ratio[place] - before)) if place else 0.0

    def settled(tolerance: float) -> float:
        outside = np.flatnonzero(np.abs(ratio - 1) > tolerance)
        return float((outside[-1] + 1) / rate) if len(outside) else 0.0

    over = max(float(ratio.max()) - 1.0, 0.0)
    return Transient(over, (passing(0.9) - passing(0.1)) / rate, settled(0.02), settled(0.05))


class _Response:
    """A continuous step response over its final value, with what decides how finely it is looked at."""

    def __init__(self, system: LinearSystem) -> None:
        """Split the response into its poles where they are apart."""
        self.system, self.gain, self.poles = system, system.static_gain, system.poles
        self.slowest = float(np.min(-self.poles.real))
        terms, self.apart = system.step_terms()
        self.terms = terms / self.gain if self.apart else terms
        self.size: FloatArray = np.abs(self.terms) if self.apart else np.full(len(terms), COINCIDING)
        self.pieces: dict[tuple[float, float], tuple[FloatArray, FloatArray]] = {}

    def ratio(self, time_s: FloatArray) -> FloatArray:
        """Return the response over its final value (N,)."""
        if not self.apart:
            return np.asarray(self.system.step(time_s) / self.gain)
        return np.asarray(1.0 + np.real(np.exp(time_s[:, None] * self.poles) @ self.terms))

    def slope(self, time_s: FloatArray) -> FloatArray:
        """Return its derivative (N,) in 1/s."""
        if not self.apart:
            return np.asarray(self.system.impulse(time_s) / self.gain)
        return np.asarray(np.real(np.exp(time_s[:, None] * self.poles) @ (self.terms * self.poles)))

    def envelope(self, time_s: float) -> float:
        """Return a bound of what is still to come: Σ |r/p|·exp(Re p t) over the final value."""
        return float(np.sum(self.size * np.exp(self.poles.real * time_s)))

    def quiet(self, level: float) -> float:
        """Return a time from which on the envelope is below `level`."""
        if self.envelope(0.0) <= level:
            return 0.0
        top = next(t for t in (2.0**k / self.slowest for k in count()) if self.envelope(t) < level)

        def above(time_s: FloatArray) -> FloatArray:
            return np.array([np.log(self.envelope(float(t)) / level) for t in time_s])

        return float(roots_between(above, np.zeros(1), np.array([top]))[0])

    def spacing(self, time_s: float) -> float:
        """Return how far apart points may lie from a time on."""
        alive = self.size * np.exp(self.poles.real * time_s) > FORGOTTEN
        fastest = np.max(np.abs(self.poles[alive]), initial=self.slowest)
        return float(2 * np.pi / fastest / PER_PERIOD)

    @cached_property
    def last(self) -> float:
        """When nothing is left that a level of 10 or 90 % or the overshoot could notice."""
        return self.quiet(1e-4)

    def blocks(self) -> Iterator[tuple[float, float]]:
        """Yield begin and end of pieces with evenly spaced points, until nothing is left."""
        begin, last = 0.0, self.last
        while begin < last:
            end = begin + BLOCK * self.spacing(begin)
            yield begin, end
            begin = end

    def coarse(self, begin: float, end: float) -> FloatArray:
        """Return the response at the points of a piece, between which it exceeds them by less than `SHORT`."""
        return self.ratio(np.linspace(begin, end, BLOCK + 1))

    def extremes(self, begin: float, end: float) -> tuple[FloatArray, FloatArray]:
        """Return times, begin, every turning point and end, and the response there; looked for once."""
        if (begin, end) not in self.pieces:
            time = np.linspace(begin, end, BLOCK + 1)
            places = sign_changes(self.slope(time))
            found = np.concatenate([[begin], roots_between(self.slope, time[places], time[places + 1]), [end]])
            self.pieces[begin, end] = found, self.ratio(found)
        return self.pieces[begin, end]

    def overshoot(self) -> tuple[float, float | None]:
        """Return the highest value less the final one and its time; 0 and None where the final one is the highest."""
        best, when = 0.0, None
        for begin, end in self.blocks():
            if float(self.coarse(begin, end).max()) - 1.0 >= (1 - SHORT) * best:
                time, value = self.extremes(begin, end)
                place = int(np.argmax(value))
                if value[place] - 1.0 > best:
                    best, when = float(value[place]) - 1.0, float(time[place])
            if self.envelope(end) <= best:
                break
        return best, when

    def first_passing(self, level: float) -> float:
        """Return when the response first reaches a share of the final value."""
        begin = end = 0.0
        for begin, end in self.blocks():
            time, value = self.extremes(begin, end)
            above = np.flatnonzero(value >= level)
            if len(above):
                return self._passing(time, int(above[0]) - 1, level)
        return end

    def settling(self, tolerance: float) -> FloatArray:
        """Return times (3,): from when on it stays within a tolerance, the turning points before and after that."""
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
                place = int(outside[-1])
                settled = self._passing(time, place, float(1 + np.copysign(tolerance, value[place] - 1)))
                return np.array([settled, time[place], time[min(place + 1, len(time) - 1)]])
            end = begin
        return np.zeros(3)

    def _passing(self, time_s: FloatArray, place: int, level: float) -> float:
        """Return where the response passes a level after turning point `place`, or at the end beside it."""
        if place < 0 or place == len(time_s) - 1:
            return float(time_s[place if place > 0 else 0])
        ends = time_s[place : place + 1], time_s[place + 1 : place + 2]
        return float(roots_between(lambda t: self.ratio(t) - level, *ends)[0])
