"""Significant peaks of a record's spectrum, fitted and subtracted until only noise remains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.lines.spectrum import (
    BINS_PER_INDEPENDENT,
    FIRST_BIN,
    BinLine,
    BinPower,
    NoiseLevel,
    add_line,
    centred_spectrum,
    chance_height,
    fit_line,
    hann_kernel,
    line_bins,
    noise_level,
    split_bins,
)
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, IntArray

MOST_LINES = 200  # of one record; more are left out with a notice
MIN_SEPARATION_BINS = 2.5  # lines closer than this count as one; a line's change of amplitude lies within it
_ROUNDS = 12  # searches of one spectrum at most
_SWEEPS = 3  # refinements of neighbouring lines
_INTERACT = 12.0  # bins within which lines are refitted when another is found
_LEAKAGE = 2.0  # times the leakage of a stronger line: a lower peak waits until that line is subtracted
_SMALLEST = 1e-9  # of the strongest line: below it, rounding looks like lines
_NEIGHBOURHOOD = 16  # bins on either side that a line must exceed too, fewer next to a stronger one
_RAMP_BINS = 256  # bins in which a straight line is subtracted
_LOOKED_AT = 1 << 14  # bins among which the noise level differs little
_REMEMBERED = 1 << 10  # bins stored at a time before they change
_EXPECTED_BINS = 1.0  # largest distance of a line from an expected position


@dataclass(frozen=True)
class Peaks(Arrays, shapes="bin_position L; u_bin_position L; value L; u_value L; noise L"):
    """Lines of one record in ascending frequency, with standard uncertainties.

    Attributes
    ----------
    bin_position, u_bin_position : (L,), in bins of 1 / length of the record.
    value, u_value : (L,), phasors at the middle of the record; u of their real or imaginary part.
    noise : (L,), noise power in a bin near the line.
    level : noise floor of the whole spectrum.
    cut : number of lines left out because there were too many.
    """

    bin_position: FloatArray
    u_bin_position: FloatArray
    value: ComplexArray
    u_value: FloatArray
    noise: FloatArray
    level: NoiseLevel
    cut: int


class FloorSpectrum:
    """Hann spectrum (B,) of samples with its noise floor; a search restores it."""

    def __init__(self, samples: FloatArray) -> None:
        self.samples = len(samples)
        self.spectrum = centred_spectrum(samples)
        self.power = BinPower(self.spectrum)
        self._found: dict[int, ComplexArray] = {}
        self.remove_ramp()
        self.level = noise_level(self.power)
        self.lowest, self.highest = self.level.lowest, self.power.highest

    def remove_ramp(self) -> None:
        """Subtract the straight line that the lowest bins show."""
        _, ramp = hann_kernel(0.0, 0, min(len(self.spectrum), _RAMP_BINS), self.samples)
        lowest = self.spectrum.imag[: len(ramp)]
        lowest -= float(ramp @ lowest) / float(ramp @ ramp) * ramp

    def add(self, line: BinLine, noise: float, sign: float) -> tuple[int, int]:
        """Add a line times `sign` above a noise power; return its bins."""
        low, high = line_bins(line, len(self.spectrum), noise)
        self.remember(low, high)
        add_line(self.spectrum, self.samples, line, (low, high), sign)
        return low, high

    def remember(self, low: int, high: int) -> None:
        """Store the content of bins before their first change."""
        for first in range(low - low % _REMEMBERED, high, _REMEMBERED):
            if first not in self._found:
                self._found[first] = self.spectrum[first : first + _REMEMBERED].copy()

    def restore(self) -> None:
        """Restore the content of the bins before the first change."""
        for first, found in self._found.items():
            self.spectrum[first : first + len(found)] = found
        self._found.clear()


def find_peaks(
    floored: FloorSpectrum,
    chance: float,
    expected_bins: FloatArray,
    fitted_bins: FloatArray,
    min_amplitude: float = 0.0,
) -> Peaks:
    """Find the lines of a spectrum, where noise alone adds one with probability `chance`.

    Half of the chance is for peaks anywhere, half for those at `expected_bins` (E,), where less height is enough. Each
    line is fitted and subtracted from the spectrum with its leakage before the floor is estimated again. A line must
    also exceed the remainder next to it, which the skirts of a stronger line and a resonance do not. The height needed
    there follows from the square root of the chance, at least, for so few bins. `fitted_bins` (T,) are lines fitted
    already, with these samples as residual. `min_amplitude` is the amplitude below which a peak is rounding.
    """
    state = _Search(floored, fitted_bins, expected_bins, chance, min_amplitude**2)
    for _ in range(_ROUNDS):
        if not state.grow() and not state.grow_expected():
            break
    found = state.result()
    floored.restore()
    return found


def excess_power(samples: FloatArray, bin_intervals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the highest power over the floor in intervals, and its position in bins."""
    spectrum = centred_spectrum(samples)
    power = BinPower(spectrum)
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
    """A spectrum from which the lines found so far are subtracted."""

    def __init__(
        self, floored: FloorSpectrum, taken: FloatArray, expected: FloatArray, chance: float, smallest: float
    ) -> None:
        self.floored, self.remainder, self.power, self.samples = (
            floored,
            floored.spectrum,
            floored.power,
            floored.samples,
        )
        self.smallest, self.fitted_bins, self.expected = smallest, taken, expected
        self.lines: list[BinLine] = []
        self.changed: list[tuple[int, int]] = []
        self.last = len(self.remainder) - (2 if self.samples % 2 == 0 else 1)
        share = 0.5 if len(expected) else 1.0
        self.chance_anywhere = share * chance / max(self.last - FIRST_BIN, 1)
        self.chance_expected = share * chance / max(3 * len(expected), 1)
        self.level = replace(floored.level, minimum=self._rounding())
        self.minimum = max(floored.lowest, self.level.minimum)

    def update_floor(self) -> None:
        """Estimate the noise floor of the remainder."""
        self.floored.remember(0, min(len(self.remainder), _RAMP_BINS))
        self.floored.remove_ramp()
        self.level = replace(noise_level(self.power, self.level, self.changed), minimum=self._rounding())
        self.changed = []

    def _rounding(self) -> float:
        strongest = max((abs(line.value) ** 2 for line in self.lines), default=self.floored.highest)
        return max(self.smallest, _SMALLEST**2 * strongest, float(np.finfo(np.float64).tiny))

    def grow(self) -> bool:
        """Add all significant peaks except leakage; return whether there were any."""
        height = chance_height(self.chance_anywhere, self.level.independent_bins)
        found = []
        for part in split_bins(self.last, _LOOKED_AT):
            first, stop = max(part.start, FIRST_BIN), part.stop
            power = self.power[first - 1 : stop + 1]
            # Few bins exceed the lower bound of the level, which is interpolated only for these.
            high = np.flatnonzero(power[1:-1] > height * self.level.lower_bound(slice(first, stop))) + 1
            high = high[(power[high] >= power[high - 1]) & (power[high] >= power[high + 1])]
            found.append(first - 1 + high[power[high] > height * self.level[first - 1 + high]])
        bins = np.concatenate([np.empty(0, dtype=np.int64), *found])
        return self._add(self._clear(bins[np.argsort(-self.power[bins], kind="stable")]))

    def grow_expected(self) -> bool:
        """Add the significant peaks at expected positions; return whether there were any."""
        height = chance_height(self.chance_expected, self.level.independent_bins)
        around = [np.arange(max(FIRST_BIN, round(p) - 1), min(self.last, round(p) + 2)) for p in self.expected]
        best = {int(bins[np.argmax(self.power[bins])]) for bins in around if len(bins)}
        high = sorted((k for k in best if self.power[k] > height * self.level[k]), key=lambda k: -self.power[k])
        return self._add(self._clear(np.array(high, dtype=np.int64)))

    def _clear(self, bins: IntArray) -> list[int]:
        """Return, strongest first, the bins that neither fitted lines nor stronger peaks can have filled."""
        fitted = np.concatenate([self.fitted_bins, [line.bin_position for line in self.lines]])
        clear: list[int] = []
        for k in bins.tolist():
            if len(fitted) and np.min(np.abs(fitted - k)) < MIN_SEPARATION_BINS:
                continue
            distance = np.abs(np.array(clear, dtype=np.float64) - k)
            leak = self.power[np.array(clear, dtype=np.int64)] / (np.pi * np.maximum(distance - 1.0, 0.3) ** 3) ** 2
            if not np.any(_LEAKAGE**2 * leak > self.power[k]):
                clear.append(k)
            if len(clear) + len(self.lines) >= 2 * MOST_LINES:
                break
        return clear

    def _add(self, bins: Sequence[int]) -> bool:
        """Fit lines at these bins, subtract them, and refine them and their neighbours in turn."""
        for k in bins:
            self._subtract(fit_line(self.remainder, self.samples, float(k), float(self.level[k])))
        near = np.array(bins, dtype=np.float64)
        for _ in range(_SWEEPS if bins else 0):
            for line in [line for line in self.lines if np.min(np.abs(near - line.bin_position)) < _INTERACT]:
                self.lines.remove(line)
                noise = float(self.level[round(line.bin_position)])
                self.changed.append(self.floored.add(line, self.minimum, 1.0))
                self._subtract(fit_line(self.remainder, self.samples, line.bin_position, noise))
        if bins:
            self.update_floor()
        return bool(bins)

    def _subtract(self, line: BinLine) -> None:
        self.changed.append(self.floored.add(line, self.minimum, -1.0))
        self.lines.append(line)

    def result(self) -> Peaks:
        """Return the lines that also exceed their neighbourhood, the strongest if there are too many."""
        self.lines.sort(key=lambda line: -abs(line.value))
        significant: list[tuple[BinLine, float]] = []
        for line in self.lines:
            around = self._local_noise(line, [other.bin_position for other, _ in significant])
            if around is not None:
                significant.append((line, around))
        cut = max(0, len(significant) - MOST_LINES)
        significant = sorted(significant[:MOST_LINES], key=lambda item: item[0].bin_position)
        noise = np.array([item[1] for item in significant])
        wider = np.sqrt(noise / np.array([self.level[round(line.bin_position)] for line, _ in significant]))
        return Peaks(
            bin_position=np.array([line.bin_position for line, _ in significant]),
            u_bin_position=np.array([line.u_bin_position for line, _ in significant]) * wider,
            value=np.array([line.value for line, _ in significant], dtype=np.complex128),
            u_value=np.array([line.u_value for line, _ in significant]) * wider,
            noise=noise,
            level=self.level,
            cut=cut,
        )

    def _local_noise(self, line: BinLine, stronger: Sequence[float]) -> float | None:
        """Return the noise next to a line, None where the line does not exceed it."""
        centres = np.concatenate([[0.0, self.samples / 2.0], self.fitted_bins, stronger])
        distance = float(np.min(np.abs(centres - line.bin_position)))
        half = int(np.clip(distance / 2.0, 3.0, _NEIGHBOURHOOD))
        centre = round(line.bin_position)
        bins = np.arange(max(1, centre - half), min(self.last, centre + half) + 1)
        fitted = np.concatenate([[line.bin_position], self.fitted_bins, stronger])
        free = bins[np.min(np.abs(np.subtract.outer(bins, fitted)), axis=1) > 1.0]
        floor = float(self.level[centre])
        expected = np.any(np.abs(self.expected - line.bin_position) <= _EXPECTED_BINS)
        if distance < MIN_SEPARATION_BINS or len(free) < 3:
            return None
        local = float(np.median(self.power[free])) / np.log(2.0)
        chance = self.chance_expected if expected else self.chance_anywhere
        height = chance_height(float(np.sqrt(chance)), len(free) / BINS_PER_INDEPENDENT)
        height = max(height, chance_height(chance, self.level.independent_bins))
        return max(local, floor) if abs(line.value) ** 2 > height * local else None
