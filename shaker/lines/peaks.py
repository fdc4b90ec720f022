"""Significant peaks of one record's spectrum: lines found, fitted and taken out until noise is left."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, IntArray, check_shapes
from shaker.lines.spectrum import (
    BINS_PER_INDEPENDENT,
    FIRST_BIN,
    BinLine,
    NoiseLevel,
    Power,
    add_line,
    bins_of,
    centred_spectrum,
    chance_height,
    fit_line,
    hann_kernel,
    noise_level,
    split_bins,
)

MOST_LINES = 200
MIN_SEPARATION_BINS = 2.5  # two lines closer than this pass for one, and a line's own change stands within it
_ROUNDS = 12
_SWEEPS = 3
_INTERACT = 12.0  # bins within which lines are fitted again when another is found
_LEAKAGE = 2.0  # times what a stronger line may leave in a bin: below it, a peak waits until that line is out
_SMALLEST = 1e-9  # of the strongest line: below it, rounding looks like lines
_NEIGHBOURHOOD = 16  # bins on either side that a line must stand out of as well, fewer beside a stronger one
_RAMP_BINS = 256
_LOOKED_AT = 1 << 14  # bins among which the noise level differs little
_REMEMBERED = 1 << 10
_EXPECTED_BINS = 1.0  # how far from an expected place a line may lie


@dataclass(frozen=True)
class Peaks:
    """Lines of one record in ascending frequency, with standard uncertainties.

    `place`, `u_place` (L,) in bins, 1 / length of the record; `value` (L,) phasors at the middle of the record,
    `u_value` (L,) of their real or imaginary part; `noise` (L,) noise power in a bin about the line; `level` (B,) noise
    floor of the whole spectrum; `cut` the number of lines left out because there were too many.
    """

    bin_position: FloatArray
    u_bin_position: FloatArray
    value: ComplexArray
    u_value: FloatArray
    noise: FloatArray
    level: NoiseLevel
    cut: int

    def __post_init__(self) -> None:
        check_shapes(self, self.bin_position.shape, "u_bin_position", "value", "u_value", "noise")


class FloorSpectrum:
    """The Hann spectrum (B,) of samples (S,) and the noise floor under it, in which lines are looked for, also again.

    A search takes its lines out of `spectrum` and puts back what it found there.
    """

    def __init__(self, samples: FloatArray) -> None:
        self.samples = len(samples)
        self.spectrum = centred_spectrum(samples)
        self.power = Power(self.spectrum)
        self._found: dict[int, ComplexArray] = {}
        self.straighten()
        self.level = noise_level(self.power)
        self.lowest, self.highest = self.level.lowest, self.power.highest

    def straighten(self) -> None:
        """Take out the straight line that the lowest bins show."""
        _, ramp = hann_kernel(0.0, 0, min(len(self.spectrum), _RAMP_BINS), self.samples)
        lowest = self.spectrum.imag[: len(ramp)]
        lowest -= float(ramp @ lowest) / float(ramp @ ramp) * ramp

    def add(self, line: BinLine, noise: float, sign: float) -> tuple[int, int]:
        """Add a line times `sign` where it can be told from a noise power; return the first bin and the one behind."""
        low, high = bins_of(line, len(self.spectrum), noise)
        self.remember(low, high)
        add_line(self.spectrum, self.samples, line, (low, high), sign)
        return low, high

    def remember(self, low: int, high: int) -> None:
        """Note what bins hold that are about to change, the first time that they do."""
        for first in range(low - low % _REMEMBERED, high, _REMEMBERED):
            if first not in self._found:
                self._found[first] = self.spectrum[first : first + _REMEMBERED].copy()

    def restore(self) -> None:
        """Put back what the bins held before the first change."""
        for first, found in self._found.items():
            self.spectrum[first : first + len(found)] = found
        self._found.clear()


def find_peaks(
    samples: FloatArray | FloorSpectrum,
    chance: float,
    expected_bins: FloatArray,
    fitted_bins: FloatArray,
    min_amplitude: float = 0.0,
) -> Peaks:
    """Find the lines of samples (S,): noise alone adds one with probability `chance` in the whole spectrum.

    Half of the chance is for peaks anywhere, half for those at the `expected` places (E,), where less height is enough.
    Each line is fitted and taken out of the spectrum with its leakage before the floor is looked at again; a line must
    stand out of what is left next to it just as well (and by no less than the square root of its chance allows for so
    few bins), which the skirts of a stronger line and a resonance do not. `taken` (T,): bins of lines fitted already,
    whose samples these are the residual of; `smallest`: amplitude below which a peak is rounding.
    """
    floored = samples if isinstance(samples, FloorSpectrum) else FloorSpectrum(samples)
    state = _Search(floored, fitted_bins, expected_bins, chance, min_amplitude**2)
    for _ in range(_ROUNDS):
        if not state.grow() and not state.grow_expected():
            break
    found = state.result()
    floored.restore()
    return found


def excess_power(samples: FloatArray, bin_intervals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the highest power over the noise floor within each of the intervals `place` (Q, 2) in bins, and where.

    Samples (S,) → ratio (Q,) and fitted place of the peak (Q,).
    """
    spectrum = centred_spectrum(samples)
    power = Power(spectrum)
    level = replace(noise_level(power), minimum=np.finfo(np.float64).tiny)
    ratio, where = np.empty(len(bin_intervals)), np.empty(len(bin_intervals))
    for q, (low, high) in enumerate(bin_intervals):
        first = min(max(math.ceil(low), 1), len(power) - 2)
        last = min(max(math.floor(high), first), len(power) - 2)
        top = first + int(np.argmax(power[first : last + 1] / level[first : last + 1]))
        ratio[q] = float(power[top]) / float(level[top])
        where[q] = fit_line(spectrum, len(samples), float(top), float(level[top])).bin_position
    return ratio, where


class _Search:
    """A spectrum from which the lines found so far are taken out."""

    def __init__(
        self, floored: FloorSpectrum, taken: FloatArray, expected: FloatArray, chance: float, smallest: float
    ) -> None:
        self.floored, self.rest, self.power, self.samples = floored, floored.spectrum, floored.power, floored.samples
        self.smallest, self.taken, self.expected = smallest, taken, expected
        self.lines: list[BinLine] = []
        self.changed: list[tuple[int, int]] = []
        self.last = len(self.rest) - (2 if self.samples % 2 == 0 else 1)
        share = 0.5 if len(expected) else 1.0
        self.chance_anywhere = share * chance / max(self.last - FIRST_BIN, 1)
        self.chance_expected = share * chance / max(3 * len(expected), 1)
        self.level = replace(floored.level, minimum=self._rounding())
        self.least = max(floored.lowest, self.level.minimum)

    def look(self) -> None:
        """Take the noise floor of what is left."""
        self.floored.remember(0, min(len(self.rest), _RAMP_BINS))
        self.floored.straighten()
        self.level = replace(noise_level(self.power, self.level, self.changed), minimum=self._rounding())
        self.changed = []

    def _rounding(self) -> float:
        strongest = max((abs(line.value) ** 2 for line in self.lines), default=self.floored.highest)
        return max(self.smallest, _SMALLEST**2 * strongest, float(np.finfo(np.float64).tiny))

    def grow(self) -> bool:
        """Add all peaks that stand out anywhere and are no leakage of stronger ones; tell whether there were any."""
        height = chance_height(self.chance_anywhere, self.level.independent)
        found = []
        for part in split_bins(self.last, _LOOKED_AT):
            first, stop = max(part.start, FIRST_BIN), part.stop
            power = self.power[first - 1 : stop + 1]
            # Few bins reach what none of these falls short of: the level is interpolated there only.
            high = np.flatnonzero(power[1:-1] > height * self.level.lower_bound(slice(first, stop))) + 1
            high = high[(power[high] >= power[high - 1]) & (power[high] >= power[high + 1])]
            found.append(first - 1 + high[power[high] > height * self.level[first - 1 + high]])
        bins = np.concatenate([np.empty(0, dtype=np.int64), *found])
        return self._add(self._clear(bins[np.argsort(-self.power[bins], kind="stable")]))

    def grow_expected(self) -> bool:
        """Add the peaks that stand out at expected places; tell whether there were any."""
        height = chance_height(self.chance_expected, self.level.independent)
        around = [np.arange(max(FIRST_BIN, round(p) - 1), min(self.last, round(p) + 2)) for p in self.expected]
        best = {int(bins[np.argmax(self.power[bins])]) for bins in around if len(bins)}
        high = sorted((k for k in best if self.power[k] > height * self.level[k]), key=lambda k: -self.power[k])
        return self._add(self._clear(np.array(high, dtype=np.int64)))

    def _clear(self, bins: IntArray) -> list[int]:
        """Return, strongest first, the bins away from known lines that no stronger one of them can have filled."""
        known = np.concatenate([self.taken, [line.bin_position for line in self.lines]])
        clear: list[int] = []
        for k in bins.tolist():
            if len(known) and np.min(np.abs(known - k)) < MIN_SEPARATION_BINS:
                continue
            distance = np.abs(np.array(clear, dtype=np.float64) - k)
            leak = self.power[np.array(clear, dtype=np.int64)] / (np.pi * np.maximum(distance - 1.0, 0.3) ** 3) ** 2
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
            for line in [line for line in self.lines if np.min(np.abs(near - line.bin_position)) < _INTERACT]:
                self.lines.remove(line)
                noise = float(self.level[round(line.bin_position)])
                self.changed.append(self.floored.add(line, self.least, 1.0))
                self._take(fit_line(self.rest, self.samples, line.bin_position, noise))
        if bins:
            self.look()
        return bool(bins)

    def _take(self, line: BinLine) -> None:
        self.changed.append(self.floored.add(line, self.least, -1.0))
        self.lines.append(line)

    def result(self) -> Peaks:
        """Return the lines that stand out of their neighbourhood too, the strongest where there are too many."""
        self.lines.sort(key=lambda line: -abs(line.value))
        kept: list[tuple[BinLine, float]] = []
        for line in self.lines:
            around = self._stands_out(line, [other.bin_position for other, _ in kept])
            if around is not None:
                kept.append((line, around))
        cut = max(0, len(kept) - MOST_LINES)
        kept = sorted(kept[:MOST_LINES], key=lambda item: item[0].bin_position)
        noise = np.array([item[1] for item in kept])
        wider = np.sqrt(noise / np.array([self.level[round(line.bin_position)] for line, _ in kept]))
        return Peaks(
            bin_position=np.array([line.bin_position for line, _ in kept]),
            u_bin_position=np.array([line.u_bin_position for line, _ in kept]) * wider,
            value=np.array([line.value for line, _ in kept], dtype=np.complex128),
            u_value=np.array([line.u_value for line, _ in kept]) * wider,
            noise=noise,
            level=self.level,
            cut=cut,
        )

    def _stands_out(self, line: BinLine, stronger: Sequence[float]) -> float | None:
        """Return the noise next to a line, None where the line is no more than a part of it."""
        centres = np.concatenate([[0.0, self.samples / 2.0], self.taken, stronger])
        distance = float(np.min(np.abs(centres - line.bin_position)))
        half = int(np.clip(distance / 2.0, 3.0, _NEIGHBOURHOOD))
        centre = round(line.bin_position)
        bins = np.arange(max(1, centre - half), min(self.last, centre + half) + 1)
        fitted = np.concatenate([[line.bin_position], self.taken, stronger])
        free = bins[np.min(np.abs(np.subtract.outer(bins, fitted)), axis=1) > 1.0]
        floor = float(self.level[centre])
        expected = np.any(np.abs(self.expected - line.bin_position) <= _EXPECTED_BINS)
        if distance < MIN_SEPARATION_BINS or len(free) < 3:
            return None
        local = float(np.median(self.power[free])) / np.log(2.0)
        chance = self.chance_expected if expected else self.chance_anywhere
        height = chance_height(float(np.sqrt(chance)), len(free) / BINS_PER_INDEPENDENT)
        height = max(height, chance_height(chance, self.level.independent))
        return max(local, floor) if abs(line.value) ** 2 > height * local else None
