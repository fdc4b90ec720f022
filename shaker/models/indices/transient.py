"""Overshoot, rise and settling of the response to a step."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count, pairwise

import numpy as np

from shaker._checks import FloatArray
from shaker.models.linear_system import LinearSystem

PER_PERIOD = 48
"""Points per period, or per time constant, of the fastest pole that still matters."""
SAMPLES = 1 << 22
"""Longest response of a sampled system that is computed."""
BLOCK = 2048
FORGOTTEN = 1e-8
"""Share of the final value below which a pole's part no longer decides where the grid's points lie."""


@dataclass(frozen=True)
class Transient:
    """Figures of a step response: `overshoot` over the final value; times in s; None where there is none."""

    overshoot: float | None
    rise_s: float | None
    settling_2_s: float | None
    settling_5_s: float | None


NONE = Transient(None, None, None, None)


def transient(system: LinearSystem) -> Transient:
    """Return overshoot, rise and settling; nothing for a system that is unstable or has no static gain."""
    if not system.stable or not system.static_gain or not np.isfinite(system.static_gain):
        return NONE
    if not len(system.poles):
        return Transient(0.0, 0.0, 0.0, 0.0)
    if system.sample_rate_hz is not None:
        return _sampled(system, system.sample_rate_hz)
    response = _Response(system)
    first, last = response.first_crossing(0.1), response.first_crossing(0.9)
    return Transient(response.overshoot(), last - first, response.settling(0.02), response.settling(0.05))


def _sampled(system: LinearSystem, rate: float) -> Transient:
    """Return the figures of a sampled system from its samples, crossings between two of them by a straight line."""
    slowest = float(np.max(np.abs(system.poles)))
    length = int(40.0 / -np.log(slowest)) + 64 if slowest > 0 else 64
    if length > SAMPLES:
        return NONE
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
        residues, sound = system.step_terms()
        size = np.abs(residues / self.gain) if sound else np.full(len(self.poles), 1e12)
        self.size: FloatArray = np.asarray(size)

    def ratio(self, time_s: FloatArray) -> FloatArray:
        """Return the response over its final value (N,)."""
        return np.asarray(self.system.step(time_s) / self.gain)

    def slope(self, time_s: float) -> float:
        """Return its derivative in 1/s."""
        return float(self.system.impulse(np.array([time_s]))[0] / self.gain)

    def envelope(self, time_s: float) -> float:
        """Return a bound of what is still to come: Σ |r/p|·exp(Re p t) over the final value."""
        return float(np.sum(self.size * np.exp(self.poles.real * time_s)))

    def spacing(self, time_s: float) -> float:
        """Return how far apart points may lie from a time on."""
        alive = self.size * np.exp(self.poles.real * time_s) > FORGOTTEN
        fastest = np.max(np.abs(self.poles[alive]), initial=self.slowest)
        return float(2 * np.pi / fastest / PER_PERIOD)

    def blocks(self) -> list[float]:
        """Return times between which the points are evenly spaced, until nothing is left."""
        end = self._quiet(1e-4)
        found = [0.0]
        while found[-1] < end:
            found.append(found[-1] + BLOCK * self.spacing(found[-1]))
        return found

    def _quiet(self, level: float) -> float:
        """Return a time from which on the envelope is below `level`."""
        from scipy.optimize import brentq

        if self.envelope(0.0) <= level:
            return 0.0
        top = next(t for t in (2.0**k / self.slowest for k in count()) if self.envelope(t) < level)
        return float(brentq(lambda t: np.log(self.envelope(t) / level), 0.0, top))

    def extremes(self, begin: float, end: float) -> tuple[FloatArray, FloatArray]:
        """Return times, begin, every turning point and end, and the response there."""
        from scipy.optimize import brentq

        time = np.linspace(begin, end, BLOCK + 1)
        slope = self.system.impulse(time) / self.gain
        places = np.flatnonzero(np.sign(slope[1:]) * np.sign(slope[:-1]) < 0)
        turns = [float(brentq(self.slope, time[i], time[i + 1], xtol=1e-15 * time[i + 1])) for i in places]
        found = np.array([begin, *turns, end])
        return found, self.ratio(found)

    def overshoot(self) -> float:
        """Return the highest value less the final one, at least 0."""
        best = 0.0
        for begin, end in self._pairs():
            best = max(best, float(self.extremes(begin, end)[1].max()) - 1.0)
            if self.envelope(end) <= best:
                break
        return best

    def _pairs(self) -> list[tuple[float, float]]:
        """Return begin and end of every block."""
        return list(pairwise(self.blocks()))

    def first_crossing(self, level: float) -> float:
        """Return when the response first reaches a share of the final value."""
        for begin, end in self._pairs():
            time, value = self.extremes(begin, end)
            above = np.flatnonzero(value >= level)
            if len(above):
                place = int(above[0])
                return float(time[0]) if place == 0 else self._passing(time[place - 1], time[place], level)
        raise ArithmeticError(f"level: expected one that the response reaches, found {level}")

    def settling(self, tolerance: float) -> float:
        """Return from when on the response stays within a tolerance of the final value."""
        end = self._quiet(tolerance)
        while end > 0:
            begin = max(0.5 * end, end - BLOCK * self.spacing(0.5 * end)) if end > self.spacing(0.0) else 0.0
            time, value = self.extremes(begin, end)
            outside = np.flatnonzero(np.abs(value - 1) > tolerance)
            if len(outside):
                place = int(outside[-1])
                if place == len(time) - 1:
                    return float(time[place])
                level = 1 + np.copysign(tolerance, value[place] - 1)
                return self._passing(time[place], time[place + 1], float(level))
            end = begin
        return 0.0

    def _passing(self, begin: float, end: float, level: float) -> float:
        """Return where the response passes a level between two neighbouring turning points."""
        from scipy.optimize import brentq

        return float(brentq(lambda t: self.ratio(np.array([t]))[0] - level, begin, end, xtol=1e-15 * end))
