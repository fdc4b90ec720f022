"""Significant peaks of one record's spectrum: lines found, fitted and taken out until noise is left."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape
from shaker.signals.survey.floor import BINS_PER_INDEPENDENT, FIRST_BIN, chance_height, noise_level
from shaker.signals.survey.hann import BinLine, add_line, centred_spectrum, fit_line, take_out_ramp

MOST_LINES = 200
APART_BINS = 2.5  # two lines closer than this pass for one, and a line's own change stands within it
_ROUNDS = 12
_SWEEPS = 3
_INTERACT = 12.0  # bins within which lines are fitted again when another is found
_LEAKAGE = 2.0  # times what a stronger line may leave in a bin: below it, a peak waits until that line is out
_SMALLEST = 1e-9  # of the strongest line: below it, rounding looks like lines
_NEIGHBOURHOOD = 16  # bins on either side that a line must stand out of as well, fewer beside a stronger one
_EXPECTED_BINS = 1.0  # how far from an expected place a line may lie


@dataclass(frozen=True)
class Peaks:
    """Lines of one record in ascending frequency, with standard uncertainties.

    `place`, `u_place` (L,) in bins, 1 / length of the record; `value` (L,) phasors at the middle of the record,
    `u_value` (L,) of their real or imaginary part; `noise` (L,) noise power in a bin about the line; `level` (B,) noise
    floor of the whole spectrum, likewise; `cut` the number of lines left out because there were too many.
    """

    place: FloatArray
    u_place: FloatArray
    value: ComplexArray
    u_value: FloatArray
    noise: FloatArray
    level: FloatArray
    cut: int

    def __post_init__(self) -> None:
        for name in ("u_place", "value", "u_value", "noise"):
            check_shape(name, getattr(self, name), self.place.shape)


def find_peaks(
    samples: FloatArray,
    chance: float,
    expected: FloatArray,
    taken: FloatArray,
    smallest: float = 0.0,
) -> Peaks:
    """Find the lines of samples (S,): noise alone adds one with probability `chance` in the whole spectrum.

    Half of the chance is for peaks anywhere, half for those at the `expected` places (E,), where less height is enough.
    Each line is fitted and taken out of the spectrum with its leakage before the floor is looked at again; a
    line must stand out of what is left next to it just as well (and by no less than the square root of its chance
    allows for so few bins), which the skirts of a stronger line and a resonance do not.
    `taken` (T,): bins of lines fitted already, whose samples these are the residual of; `smallest`: amplitude below
    which a peak is rounding.
    """
    state = _Search(centred_spectrum(samples), len(samples), taken, expected, chance, smallest**2)
    for _ in range(_ROUNDS):
        if not state.grow() and not state.grow_expected():
            break
    return state.result()


def excess_power(samples: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the highest power over the noise floor within each of the intervals `place` (Q, 2) in bins, and where.

    Samples (S,) → ratio (Q,), fitted place of the peak (Q,), and its amplitude (Q,).
    """
    spectrum = centred_spectrum(samples)
    power = spectrum.real**2 + spectrum.imag**2
    level = np.maximum(noise_level(power)[0], np.finfo(np.float64).tiny)
    found = []
    for low, high in place:
        first = min(max(math.ceil(low), 1), len(power) - 2)
        last = min(max(math.floor(high), first), len(power) - 2)
        top = first + int(np.argmax(power[first : last + 1] / level[first : last + 1]))
        line = fit_line(spectrum, len(samples), float(top), float(level[top]))
        found.append((float(power[top] / level[top]), line.place, abs(line.value)))
    ratio, where, amplitude = np.array(found).T
    return ratio, where, amplitude


class _Search:
    """A spectrum from which the lines found so far are taken out."""

    def __init__(
        self,
        spectrum: ComplexArray,
        samples: int,
        taken: FloatArray,
        expected: FloatArray,
        chance: float,
        smallest: float,
    ) -> None:
        self.rest, self.samples, self.smallest = spectrum, samples, smallest
        self.taken, self.expected = taken, expected
        self.lines: list[BinLine] = []
        self.last = len(spectrum) - (2 if samples % 2 == 0 else 1)
        share = 0.5 if len(expected) else 1.0
        self.chance_anywhere = share * chance / max(self.last - FIRST_BIN, 1)
        self.chance_expected = share * chance / max(3 * len(expected), 1)
        self.look()
        self.least = float(self.level.min())

    def look(self) -> None:
        """Take the power of what is left, and its noise floor."""
        take_out_ramp(self.rest, self.samples)
        self.power = self.rest.real**2 + self.rest.imag**2
        level, self.independent = noise_level(self.power)
        strongest = max((abs(line.value) ** 2 for line in self.lines), default=float(self.power.max(initial=0.0)))
        rounding = max(self.smallest, _SMALLEST**2 * strongest, np.finfo(np.float64).tiny)
        self.level = np.maximum(level, rounding)

    def grow(self) -> bool:
        """Add all peaks that stand out anywhere and are no leakage of stronger ones; tell whether there were any."""
        height = chance_height(self.chance_anywhere, self.independent)
        inner = self.power[FIRST_BIN : self.last]
        top = (inner > height * self.level[FIRST_BIN : self.last]) & (
            inner >= self.power[FIRST_BIN - 1 : self.last - 1]
        )
        top &= inner >= self.power[FIRST_BIN + 1 : self.last + 1]
        bins = FIRST_BIN + np.flatnonzero(top)
        return self._add(self._clear(bins[np.argsort(-self.power[bins], kind="stable")]))

    def grow_expected(self) -> bool:
        """Add the peaks that stand out at expected places; tell whether there were any."""
        found = []
        height = chance_height(self.chance_expected, self.independent)
        for place in self.expected:
            bins = np.arange(max(FIRST_BIN, round(place) - 1), min(self.last, round(place) + 2))
            if len(bins):
                best = int(bins[np.argmax(self.power[bins])])
                if self.power[best] > height * self.level[best]:
                    found.append(best)
        order = sorted(set(found), key=lambda k: -self.power[k])
        return self._add(self._clear(np.array(order, dtype=np.int64)))

    def _clear(self, bins: IntArray) -> list[int]:
        """Return, strongest first, the bins away from known lines that no stronger one of them can have filled."""
        known = np.concatenate([self.taken, [line.place for line in self.lines]])
        clear: list[int] = []
        for k in bins.tolist():
            if len(known) and np.min(np.abs(known - k)) < APART_BINS:
                continue
            distance = np.abs(np.array(clear, dtype=np.float64) - k)
            leak = self.power[clear] / (np.pi * np.maximum(distance - 1.0, 0.3) ** 3) ** 2
            if not np.any(_LEAKAGE**2 * leak > self.power[k]):
                clear.append(k)
            if len(clear) + len(self.lines) >= 2 * MOST_LINES:
                break
        return clear

    def _add(self, bins: Sequence[int]) -> bool:
        """Fit lines at these bins, take them out, and fit them and their neighbours again in turn."""
        for k in bins:
            self._take(fit_line(self.rest, self.samples, float(k), float(self.level[k])))
        near = np.array(bins, dtype=np.float64)
        for _ in range(_SWEEPS if bins else 0):
            for line in [line for line in self.lines if np.min(np.abs(near - line.place)) < _INTERACT]:
                self.lines.remove(line)
                noise = float(self.level[round(line.place)])
                add_line(self.rest, self.samples, line, self.least, 1.0)
                self._take(fit_line(self.rest, self.samples, line.place, noise))
        if bins:
            self.look()
        return bool(bins)

    def _take(self, line: BinLine) -> None:
        """Take a line out of the spectrum and keep it."""
        add_line(self.rest, self.samples, line, self.least, -1.0)
        self.lines.append(line)

    def result(self) -> Peaks:
        """Return the lines that stand out of their neighbourhood too, the strongest where there are too many."""
        self.lines.sort(key=lambda line: -abs(line.value))
        kept: list[tuple[BinLine, float]] = []
        for line in self.lines:
            around = self._stands_out(line, [other.place for other, _ in kept])
            if around is not None:
                kept.append((line, around))
        cut = max(0, len(kept) - MOST_LINES)
        kept = sorted(kept[:MOST_LINES], key=lambda item: item[0].place)
        noise = np.array([item[1] for item in kept])
        wider = np.sqrt(noise / np.array([self.level[round(line.place)] for line, _ in kept]))
        return Peaks(
            place=np.array([line.place for line, _ in kept]),
            u_place=np.array([line.u_place for line, _ in kept]) * wider,
            value=np.array([line.value for line, _ in kept], dtype=np.complex128),
            u_value=np.array([line.u_value for line, _ in kept]) * wider,
            noise=noise,
            level=self.level,
            cut=cut,
        )

    def _stands_out(self, line: BinLine, stronger: Sequence[float]) -> float | None:
        """Return the noise next to a line, None where the line is no more than a part of it."""
        centres = np.concatenate([[0.0, self.samples / 2.0], self.taken, stronger])
        distance = float(np.min(np.abs(centres - line.place)))
        half = int(np.clip(distance / 2.0, 3.0, _NEIGHBOURHOOD))
        centre = round(line.place)
        bins = np.arange(max(1, centre - half), min(self.last, centre + half) + 1)
        fitted = np.concatenate([[line.place], self.taken, stronger])
        free = bins[np.min(np.abs(np.subtract.outer(bins, fitted)), axis=1) > 1.0]
        floor = float(self.level[centre])
        expected = np.any(np.abs(self.expected - line.place) <= _EXPECTED_BINS)
        if distance < APART_BINS or len(free) < 3:
            return None
        local = float(np.median(self.power[free])) / np.log(2.0)
        chance = self.chance_expected if expected else self.chance_anywhere
        height = chance_height(float(np.sqrt(chance)), len(free) / BINS_PER_INDEPENDENT)
        height = max(height, chance_height(chance, self.independent))
        return max(local, floor) if abs(line.value) ** 2 > height * local else None
