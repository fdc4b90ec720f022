"""Where the gain of a system peaks, falls and leaves a band, over frequency."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.indices.roots import roots_between, sign_changes
from shaker.models.linear_system import LinearSystem

POINTS = 60
"""Points per decade of distance from every pole and zero."""


@dataclass(frozen=True)
class GainCurve:
    """|H| over frequency: `edges_hz` (E,), rising from 0, with `gain` (E,), between which |H| only rises or only falls.

    The last edge is half the sampling rate, or, of a continuous system, far above every pole and zero, where |H| has
    come to its last slope; `gain_beyond`: what it tends to from there on.
    """

    system: LinearSystem
    edges_hz: FloatArray
    gain: FloatArray
    gain_beyond: float

    def crossings(self, *levels: float) -> list[float]:
        """Return every frequency in Hz at which |H| passes one of the levels, rising."""
        passed = [sign_changes(self.gain - level) for level in levels]
        level, places = np.repeat(levels, [len(own) for own in passed]), np.concatenate(passed)

        def above(hertz: FloatArray) -> FloatArray:
            return np.asarray(np.abs(self.system.response(hertz)) / level - 1.0)

        found = roots_between(above, self.edges_hz[places], self.edges_hz[places + 1])
        return [float(f) for f in np.sort(found)]

    def inside(self, low: float, high: float) -> list[tuple[float, float]]:
        """Return the ranges of frequency in Hz in which low ≤ |H| ≤ high, rising; the last may be endless."""
        ends = [0.0, *self.crossings(low, high), float(self.edges_hz[-1])]
        middle = np.abs(self.system.response(np.array([0.5 * (begin + end) for begin, end in pairwise(ends)])))
        found: list[tuple[float, float]] = []
        for (begin, end), gain in zip(pairwise(ends), middle, strict=True):
            if not low <= gain <= high:
                continue
            if found and found[-1][1] == begin:
                found[-1] = (found[-1][0], end)
            else:
                found.append((begin, end))
        if found and self.system.sample_rate_hz is None and found[-1][1] == ends[-1]:
            found[-1] = (found[-1][0], np.inf)
        return found


def gain_curve(system: LinearSystem) -> GainCurve:
    """Return |H| over frequency in pieces that only rise or only fall.

    The turning points are the zeros of d ln|H|/dω = Re{x'·[Σ 1/(x - zero) - Σ 1/(x - pole)]}, x' = dx/dω, between
    points that lie close where poles and zeros are near: no resonance is too narrow.
    """
    grid = _grid(system)
    places = sign_changes(log_slope(system, grid))
    turns = roots_between(lambda hertz: log_slope(system, hertz), grid[places], grid[places + 1])
    edges = np.concatenate([[0.0], turns, grid[-1:]])
    return GainCurve(system, edges, np.abs(system.response(edges)), _beyond(system))


def _beyond(system: LinearSystem) -> float:
    """Return the gain at the highest frequency: at half the rate, or at infinity."""
    if system.sample_rate_hz is not None:
        return float(np.abs(system.at(np.array([-1.0 + 0j]))[0]))
    return abs(system.gain) if len(system.zeros) == len(system.poles) else 0.0


def places_rad(system: LinearSystem) -> tuple[ComplexArray, ComplexArray]:
    """Return zeros and poles as s in rad/s, those of samples by ln(z)·rate; z = 0 is left out."""
    if system.sample_rate_hz is None:
        return system.zeros, system.poles
    zeros, poles = (np.log(part[part != 0]) * system.sample_rate_hz for part in (system.zeros, system.poles))
    return np.asarray(zeros), np.asarray(poles)


def _grid(system: LinearSystem) -> FloatArray:
    """Return frequencies (G,) in Hz, rising, that lie as close as zeros and poles make the gain change."""
    features = np.concatenate(places_rad(system))
    features = features[np.abs(features) > 0] / (2 * np.pi)
    if not len(features):
        features = np.ones(1, dtype=np.complex128)
    sizes = np.abs(features)
    least, most = 1e-4 * sizes.min(), 1e3 * sizes.max()
    if system.sample_rate_hz is not None:
        most = 0.5 * system.sample_rate_hz
    parts = [np.geomspace(min(least, 1e-3 * most), most, int(POINTS * np.log10(most / min(least, 1e-3 * most))) + 2)]
    for place, size in zip(features, sizes, strict=True):
        if place.imag <= 0:
            continue
        width = max(abs(place.real), 1e-9 * size)
        away = np.geomspace(1e-2 * width, size, int(POINTS * np.log10(1e2 * size / width)) + 2)
        parts += [place.imag - away, place.imag + away]
    grid = np.unique(np.concatenate([*parts, [most]]))
    return np.asarray(grid[(grid > 0) & (grid <= most)])


def log_slope(system: LinearSystem, hertz: FloatArray) -> FloatArray:
    """Return d ln|H|/dω (K,) in s at frequencies (K,) in Hz, 0 on a zero or a pole, where it changes its sign."""
    x = 2j * np.pi * np.asarray(hertz)
    change: ComplexArray = np.full(len(x), 1j)
    if system.sample_rate_hz is not None:
        x = np.exp(x / system.sample_rate_hz)
        change = 1j * x / system.sample_rate_hz
    away = x[:, None] - np.concatenate([system.zeros, system.poles])
    sense = np.repeat([1.0, -1.0], [len(system.zeros), len(system.poles)])
    hit = away == 0
    found = (change * np.sum(sense / np.where(hit, 1.0, away), axis=1)).real
    return np.asarray(np.where(np.any(hit, axis=1), 0.0, found))


def band_end(curve: GainCurve, reference: float, tolerance: float) -> float | None:
    """Return the frequency in Hz up to which |H| is within ±`tolerance` of |`reference`|, None if not at rest."""
    level = abs(reference)
    ranges = curve.inside((1 - tolerance) * level, (1 + tolerance) * level)
    return ranges[0][1] if ranges and ranges[0][0] == 0.0 else None


def half_power(curve: GainCurve) -> float | None:
    """Return the frequency in Hz at which |H| first falls below |H(0)|/√2, None if nowhere."""
    if curve.gain[0] == 0:
        return None
    found = curve.crossings(float(curve.gain[0]) / np.sqrt(2.0))
    return found[0] if found else None


def peak(curve: GainCurve) -> tuple[float, float] | None:
    """Return frequency in Hz and |H| of the highest maximum between rest and the end, None if |H| only falls."""
    place = int(np.argmax(curve.gain))
    if place in (0, len(curve.gain) - 1):
        return None
    return float(curve.edges_hz[place]), float(curve.gain[place])


def quadrature(system: LinearSystem) -> float | None:
    """Return the first frequency in Hz at which H is 90° from H(0), None if nowhere."""
    gain, grid = system.static_gain, _grid(system)
    if gain == 0:
        return None

    def along(hertz: FloatArray) -> FloatArray:
        return np.asarray(system.response(hertz).real / gain)

    first = sign_changes(along(grid))[:1]
    found = roots_between(along, grid[first], grid[first + 1])
    return float(found[0]) if len(found) else None
