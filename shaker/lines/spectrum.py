"""Amplitude spectra, their noise floor, and the peaks above it.

Hann spectra whose lines can be fitted and taken out bin by bin.

Time is counted from the middle of the record, so that the spectrum of a sine is its phasor times a real kernel that
falls as the cube of the distance: a line touches the bins around it only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import lgamma

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, IntArray, Stacked, check_shape, check_shapes


@dataclass(frozen=True)
class Spectrum:
    """One-sided amplitude spectrum: `frequency_hz` (B,), `amplitude` (B,) or (B, C), peak amplitude of a sine."""

    frequency_hz: FloatArray
    amplitude: FloatArray

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (None,))
        if self.amplitude.shape[:1] != self.frequency_hz.shape:
            raise ValueError(
                f"amplitude: expected {len(self.frequency_hz)} bins, found an array of shape {self.amplitude.shape}"
            )


def hann_window(samples: int) -> FloatArray:
    """Return a periodic Hann window (S,) with mean 1, so that a sine keeps its amplitude."""
    return np.asarray(1.0 - np.cos(2.0 * np.pi * np.arange(samples) / samples))


def amplitude_spectrum(samples: FloatArray | Stacked, sample_rate_hz: float, most_bins: int | None = None) -> Spectrum:
    """Return the one-sided amplitude spectrum of samples (S,) or (S, C) under a Hann window, their mean removed.

    A sine on a bin shows its peak amplitude, one between two bins up to 15 % less. Of more than `most_bins` bins the
    highest of each few neighbours is kept, at their mean frequency.
    """
    count = len(samples)
    if count < 2:
        raise ValueError(f"samples: expected at least 2 samples, found {count}")
    stacked = Stacked.of(samples)
    bins = count // 2 + 1
    merged = 1 if most_bins is None else -(-bins // most_bins)
    first = np.arange(0, bins, merged)
    amplitude = np.empty((len(first), stacked.shape[1]))
    for c, column in enumerate(stacked.each()):
        spectrum = _hann_rfft(column, count / 2.0)
        spectrum[0] /= 2.0
        if count % 2 == 0:
            spectrum[-1] /= 2.0
        own = np.empty(bins)
        for part in _parts(bins):
            own[part] = np.abs(spectrum[part]) * (2.0 / count)
        amplitude[:, c] = np.maximum.reduceat(own, first)
    last = np.minimum(first + merged, bins) - 1
    frequency = (first + last) / 2.0 * (1.0 / (count * (1.0 / sample_rate_hz)))
    return Spectrum(frequency, amplitude.reshape(-1, *samples.shape[1:]))


# Hann spectra whose lines can be fitted and taken out bin by bin.

_SPAN = 3  # bins on either side from which a line is fitted
_STEPS = 10
_CONVERGED = 1e-6  # of the variance of the place: the square of the last step
_BIN_CORRELATION = (1.0, 2.0 / 3.0, 1.0 / 6.0)  # of white noise in Hann bins 0, 1, 2 apart
_DRIFT_FROM = 1e4  # power over noise from which a line's own slow change of amplitude is taken out with it
_NEGLIGIBLE = 0.05  # of the noise amplitude: what a line leaves beyond the bins it is taken out of
_WIDEST = 20_000
_RAMP_BINS = 256
_SERIES_BELOW = 1e-5  # bins: nearer to its centre the kernel is taken from its series


@dataclass(frozen=True)
class BinLine:
    """One line: `place` in bins, `value` its phasor at the middle of the record, `slope` its change, uncertainties."""

    place: float
    value: complex
    slope: complex
    u_place: float
    u_value: float


def centred_spectrum(samples: FloatArray) -> ComplexArray:
    """Return the Hann spectrum (B,) of samples (S,), their mean removed: the phasor of a sine that lies on a bin.

    The window is symmetric about the middle of the record, to which the phases refer.
    """
    count = len(samples)
    spectrum = _hann_rfft(samples, (count - 1) / 2.0)
    for part in _parts(len(spectrum)):
        turn = np.exp(np.arange(part.start, part.stop) * (-1j * np.pi / count))
        turn[1::2] *= -1.0  # parts begin at even bins
        spectrum[part] *= turn * (2.0 / count)
    return spectrum


_LONG = 1 << 22  # samples from which a transform is put together from shorter ones, in little more than its own memory
_PART = 1 << 18  # bins worked on at a time
_FEWEST_PARTS, _MOST_PARTS = 16, 64
_RETURNED = 1 << 26  # bytes of an array whose memory the system has back at once


def _parts(bins: int) -> list[slice]:
    """Return slices that cover so many bins."""
    return [slice(first, min(first + _PART, bins)) for first in range(0, bins, _PART)]


def _hann_rfft(samples: FloatArray, middle: float) -> ComplexArray:
    """Return the transform (B,) of samples (S,), their mean removed, times 1 + cos(2π/S·(n - middle)).

    Of long records every r-th sample is transformed for itself, r a divisor of S, and the r transforms F_q are put
    together (decimation in time, Cooley and Tukey 1965): X(jM + m) = Σ_q exp(-2πi·qj/r)·exp(-2πi·qm/S)·F_q(m), M = S/r,
    a transform of r numbers for each m. m up to M/2 are enough: X(jM + M - m) is the conjugate of X((r - 1 - j)M + m).
    """
    count, mean = len(samples), samples.mean()
    pieces = next((r for r in range(_FEWEST_PARTS, _MOST_PARTS + 1) if count % r == 0), 1) if count >= _LONG else 1
    turn = 2.0 * np.pi / count
    if pieces == 1:
        return np.asarray(np.fft.rfft(_windowed(samples, mean, middle, slice(0, count))))
    length, bins = count // pieces, count // 2 + 1
    halves = [np.empty(0, dtype=np.complex128)] * pieces
    order = sorted(range(pieces), key=lambda q: min(q, pieces - 1 - q))  # in which they are done with
    each = max(1, _RETURNED // (8 * length))
    for some in (order[first : first + each] for first in range(0, pieces, each)):
        block = np.empty((len(some), length // 2 + 1), dtype=np.complex128)
        for q, row in zip(some, block, strict=True):
            row[:] = np.fft.rfft(_windowed(samples, mean, middle, slice(q, count, pieces)))
            halves[q] = row
    del block, row
    for part in _parts(length // 2 + 1):
        step = np.exp(np.arange(part.start, part.stop) * (-1j * turn))
        twist = np.ones(len(step), dtype=np.complex128)
        twisted = np.empty((pieces, len(step)), dtype=np.complex128)
        for half, own in zip(halves, twisted, strict=True):
            np.multiply(half[part], twist, out=own)
            twist *= step
        for half, own in zip(halves, np.fft.fft(twisted, axis=0), strict=True):
            half[part] = own
    del half
    result = np.empty(bins, dtype=np.complex128)
    last = (bins - 1) // length
    for j in range(last + 1):
        target = result[j * length : (j + 1) * length]
        low, high = halves[j][: len(target)], halves[pieces - 1 - j][length - length // 2 - 1 : 0 : -1]
        target[: len(low)] = low
        np.conjugate(high[: len(target) - len(low)], out=target[len(low) :])
        done = (j, pieces - 1 - j) if pieces - 1 - j > last else (j,)
        for number in done:  # whose memory is that of the result now
            halves[number] = np.empty(0, dtype=np.complex128)
    return result


def _windowed(samples: FloatArray, mean: float, middle: float, which: slice) -> FloatArray:
    """Return some of the samples (S,) less their mean, times 1 + cos(2π/S·(n - middle)), in little more memory."""
    window = np.arange(which.start, which.stop, which.step, dtype=np.float64)
    window -= middle
    window *= 2.0 * np.pi / len(samples)
    np.cos(window, out=window)
    window += 1.0
    window *= samples[which] - mean
    return window


def kernel(place: float, low: int, high: int, samples: int) -> tuple[FloatArray, FloatArray]:
    """Return what a unit line at `place` leaves in the bins from `low` to below `high`, and its derivative by `place`.

    K(δ) = D(δ) + ½D(δ - 1) + ½D(δ + 1) with Dirichlet's kernel D(δ) = sin(πδ) / (N sin(πδ/N)).
    """
    distance = place - np.arange(low - 1, high + 1)
    near = np.abs(distance) < _SERIES_BELOW
    series = distance[near]
    distance[near] = _SERIES_BELOW
    below = samples * np.sin(np.pi / samples * distance)
    dirichlet = np.sin(np.pi * distance) / below
    slope = np.pi * (np.cos(np.pi * distance) - dirichlet * np.cos(np.pi / samples * distance)) / below
    curvature = -(np.pi**2) / 3.0 * (1.0 - 1.0 / samples**2)
    dirichlet[near], slope[near] = 1.0 + curvature / 2.0 * series**2, curvature * series
    return (
        dirichlet[1:-1] + 0.5 * (dirichlet[:-2] + dirichlet[2:]),
        slope[1:-1] + 0.5 * (slope[:-2] + slope[2:]),
    )


def fit_line(spectrum: ComplexArray, samples: int, start: float, noise: float) -> BinLine:
    """Fit a line to the bins around `start` by least squares, weighted with the correlation of Hann bins.

    Y = A·K(δ) + B·K'(δ): the part of B in phase with A is a shift of the line, Gauss-Newton takes it off; the other
    part is a linear change of the amplitude. `noise` is the noise power of a bin.
    """
    low, high = max(1, round(start) - _SPAN), min(len(spectrum), round(start) + _SPAN + 1)
    weight = _hann_weight(high - low)
    place, value = start, 0j
    for _ in range(_STEPS):
        data = spectrum[low:high] - np.conj(value) * kernel(-place, low, high, samples)[0]
        design = np.stack(kernel(place, low, high, samples))
        weighted = design @ weight
        covariance = np.linalg.inv(weighted @ design.T)
        value, slope = (complex(c) for c in covariance @ (weighted @ data))
        step = (slope / value).real if value else 0.0
        place += min(max(step, -0.5), 0.5)
        if abs(place - start) > 1.0:
            place = start
            break
        if abs(step * value) ** 2 < _CONVERGED * covariance[1, 1] * noise:
            break
    quadrature = noise / 2.0 * covariance.diagonal()
    change = 1j * value * (slope / value).imag if value else 0j
    tame = abs(value) ** 2 > _DRIFT_FROM * noise and abs(change) < 0.3 * abs(value)
    u_place = float(np.sqrt(quadrature[1])) / max(abs(value), np.finfo(np.float64).tiny)
    return BinLine(place, value, change if tame else 0j, u_place, float(np.sqrt(quadrature[0])))


def add_line(spectrum: ComplexArray, samples: int, line: BinLine, noise: float, sign: float) -> None:
    """Add a line times `sign` to the bins of a spectrum in which it can be told from a noise power, in place."""
    reach = (abs(line.value) / (_NEGLIGIBLE * np.sqrt(noise) * np.pi)) ** (1.0 / 3.0)
    width = int(min(max(reach, 4.0), _WIDEST)) + 2
    low, high = max(0, round(line.place) - width), min(len(spectrum), round(line.place) + width + 1)
    shape, slope = kernel(line.place, low, high, samples)
    part = line.value * shape + np.conj(line.value) * kernel(-line.place, low, high, samples)[0]
    spectrum[low:high] += sign * (part + line.slope * slope)


@lru_cache(maxsize=8)
def _hann_weight(count: int) -> FloatArray:
    """Return the inverse of the correlation matrix of white noise in neighbouring Hann bins."""
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(np.linalg.inv(np.array([*_BIN_CORRELATION, *[0.0] * count])[apart]))


# The noise floor of a power spectrum, and how far above it chance alone does not reach.

FIRST_BIN = 3  # the lowest bin looked at: fewer periods are drift
_BLOCKS = (64, 256)  # bins per median, narrow and wide
_LOW_BINS = 256  # in which a slope of the noise towards zero is taken off first
_CAPPED = 4.0  # times the floor: what stands higher does not pull at the slope
_FIT_STEPS = 60
BINS_PER_INDEPENDENT = 1.94  # 1 + 2·(4/9 + 1/36): Hann bins share their noise


class Power:
    """Power of the bins of a spectrum (B,), taken from it where it is asked for: all of it is half its memory."""

    def __init__(self, spectrum: ComplexArray) -> None:
        self._spectrum = spectrum

    def __len__(self) -> int:
        return len(self._spectrum)

    def __getitem__(self, bins: slice | int | IntArray) -> FloatArray:
        own = np.asarray(self._spectrum[bins])
        return np.asarray(np.square(own.real) + np.square(own.imag))

    @property
    def highest(self) -> float:
        """The power of the strongest bin."""
        return max((float(self[part].max()) for part in _parts(len(self))), default=0.0)


@dataclass(frozen=True, eq=False)
class NoiseLevel:
    """Noise power of the bins (B,), interpolated where it is asked for, and no less than `least`.

    `curves`: centres of blocks and the logarithm of their level; `trend`: factor of the lowest bins; `independent`: the
    number of independent bins each value rests on.
    """

    bins: int
    curves: tuple[tuple[FloatArray, FloatArray], ...]
    trend: FloatArray
    independent: float
    least: float = 0.0

    def __len__(self) -> int:
        return self.bins

    def __getitem__(self, bins: slice | int | IntArray) -> FloatArray:
        at = np.arange(*bins.indices(self.bins)) if isinstance(bins, slice) else np.asarray(bins)
        levels = [np.exp(np.interp(at, centres, log_level)) for centres, log_level in self.curves]
        level = levels[0] if len(levels) == 1 else np.maximum(levels[0], levels[1])
        if len(self.trend) and at.min(initial=self.bins) < len(self.trend):
            level = level * np.where(at < len(self.trend), self.trend[np.minimum(at, len(self.trend) - 1)], 1.0)
        return np.asarray(np.maximum(level, self.least))

    @property
    def lowest(self) -> float:
        """The noise power of the quietest bin."""
        return min(float(self[part].min()) for part in _parts(self.bins))


def noise_level(power: FloatArray | Power) -> NoiseLevel:
    """Return the noise power of every bin (B,).

    Medians of blocks of bins, which pass over lines, divided by ln 2 (a bin's power has an exponential distribution)
    and interpolated; of narrow and wide blocks the higher value. Towards zero frequency, where drift and 1/f noise
    rise faster than a block sees, a parabola in log power over log frequency is taken off first, by maximum Whittle
    likelihood of the power capped at four times the floor.
    """
    usable = len(power) - FIRST_BIN
    if usable < 1:
        return NoiseLevel(len(power), ((np.zeros(1), np.zeros(1)),), np.ones(0), 1.0)
    trend = _low_trend(power)
    curves: list[tuple[FloatArray, FloatArray]] = []
    counts: list[float] = []
    for size in _BLOCKS:
        blocks = max(1, usable // size)
        if blocks == 1 and counts:
            break
        edges = FIRST_BIN + np.round(np.linspace(0.0, usable, blocks + 1)).astype(np.int64)
        medians = _medians(power, trend, edges[:-1], int(np.min(np.diff(edges))))
        centres = (edges[:-1] + edges[1:] - 1) / 2.0
        curves.append((centres, np.log(np.maximum(medians / np.log(2.0), np.finfo(np.float64).tiny))))
        counts.append(usable / blocks)
    return NoiseLevel(len(power), tuple(curves), trend, max(counts) / BINS_PER_INDEPENDENT)


def _medians(power: FloatArray | Power, trend: FloatArray, first: IntArray, length: int) -> FloatArray:
    """Return the medians of blocks of bins of a length from their first ones on, the trend taken off."""
    medians = np.empty(len(first))
    step = max(1, _PART // length)
    for k in range(0, len(first), step):
        own = first[k : k + step]
        flat = power[own[0] : own[-1] + length].copy()
        low = trend[own[0] :]
        flat[: len(low)] /= low[: len(flat)]
        medians[k : k + step] = np.median(np.lib.stride_tricks.sliding_window_view(flat, length)[own - own[0]], axis=1)
    return medians


def _low_trend(power: FloatArray | Power) -> FloatArray:
    """Return the slope of the noise over the lowest bins, as many as it has; it is 1 beyond them."""
    last = min(_LOW_BINS, len(power) - 1)
    if last - FIRST_BIN < 16:
        return np.ones(0)
    bins = np.arange(FIRST_BIN, last + 1)
    log_bin = np.log(bins / last)
    columns, _ = np.linalg.qr(np.stack([np.ones_like(log_bin), log_bin, log_bin**2], axis=1))
    observed = np.maximum(power[bins], np.finfo(np.float64).tiny)
    log_power = columns @ (columns.T @ (np.log(observed) + np.euler_gamma))
    share = 1.0 - np.exp(-_CAPPED)
    for _ in range(_FIT_STEPS):
        excess = np.minimum(observed / np.exp(log_power), _CAPPED) / share - 1.0
        log_power = log_power + columns @ (columns.T @ excess)
    trend = np.exp(log_power - log_power[-1])
    return np.concatenate([np.full(FIRST_BIN, trend[0]), trend])


@lru_cache(maxsize=256)
def chance_height(chance: float, independent: float) -> float:
    """Return by which factor a bin exceeds the noise level with probability `chance`, the level being a median.

    The level is known from `independent` bins only: of n exponential values, another exceeds T times the k-th smallest
    with probability Π (n - i) / (n - i + T), i < k (Rohling, IEEE Trans. AES 19 (1983), eq. 39).
    """
    n = max(independent, 1.5)
    k = (n + 1.0) / 2.0
    low, high = 0.0, 1e12
    for _ in range(200):
        t = 0.5 * (low + high) if high < 1e3 else np.sqrt(max(low, 1e-3) * high)
        log_chance = lgamma(n + 1.0) - lgamma(n - k + 1.0) + lgamma(n - k + 1.0 + t) - lgamma(n + 1.0 + t)
        low, high = (t, high) if log_chance > np.log(chance) else (low, t)
        if high - low < 1e-9 * high:
            break
    return float(high * np.log(2.0))


# Significant peaks of one record's spectrum: lines found, fitted and taken out until noise is left.

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
    floor of the whole spectrum; `cut` the number of lines left out because there were too many.
    """

    place: FloatArray
    u_place: FloatArray
    value: ComplexArray
    u_value: FloatArray
    noise: FloatArray
    level: NoiseLevel
    cut: int

    def __post_init__(self) -> None:
        check_shapes(self, self.place.shape, "u_place", "value", "u_value", "noise")


def find_peaks(
    samples: FloatArray,
    chance: float,
    expected: FloatArray,
    taken: FloatArray,
    smallest: float = 0.0,
) -> Peaks:
    """Find the lines of samples (S,): noise alone adds one with probability `chance` in the whole spectrum.

    Half of the chance is for peaks anywhere, half for those at the `expected` places (E,), where less height is enough.
    Each line is fitted and taken out of the spectrum with its leakage before the floor is looked at again; a line must
    stand out of what is left next to it just as well (and by no less than the square root of its chance allows for so
    few bins), which the skirts of a stronger line and a resonance do not. `taken` (T,): bins of lines fitted already,
    whose samples these are the residual of; `smallest`: amplitude below which a peak is rounding.
    """
    state = _Search(centred_spectrum(samples), len(samples), taken, expected, chance, smallest**2)
    for _ in range(_ROUNDS):
        if not state.grow() and not state.grow_expected():
            break
    return state.result()


def excess_power(samples: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the highest power over the noise floor within each of the intervals `place` (Q, 2) in bins, and where.

    Samples (S,) → ratio (Q,) and fitted place of the peak (Q,).
    """
    spectrum = centred_spectrum(samples)
    power = Power(spectrum)
    level = replace(noise_level(power), least=np.finfo(np.float64).tiny)
    ratio, where = np.empty(len(place)), np.empty(len(place))
    for q, (low, high) in enumerate(place):
        first = min(max(math.ceil(low), 1), len(power) - 2)
        last = min(max(math.floor(high), first), len(power) - 2)
        top = first + int(np.argmax(power[first : last + 1] / level[first : last + 1]))
        ratio[q] = float(power[top]) / float(level[top])
        where[q] = fit_line(spectrum, len(samples), float(top), float(level[top])).place
    return ratio, where


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
        self.rest, self.power, self.samples, self.smallest = spectrum, Power(spectrum), samples, smallest
        self.taken, self.expected = taken, expected
        self.lines: list[BinLine] = []
        self.last = len(spectrum) - (2 if samples % 2 == 0 else 1)
        share = 0.5 if len(expected) else 1.0
        self.chance_anywhere = share * chance / max(self.last - FIRST_BIN, 1)
        self.chance_expected = share * chance / max(3 * len(expected), 1)
        self.look()
        self.least = self.level.lowest

    def look(self) -> None:
        """Take the power of what is left, and its noise floor."""
        # The straight line that the lowest bins show is taken out.
        _, ramp = kernel(0.0, 0, min(len(self.rest), _RAMP_BINS), self.samples)
        lowest = self.rest.imag[: len(ramp)]
        lowest -= float(ramp @ lowest) / float(ramp @ ramp) * ramp
        level = noise_level(self.power)
        strongest = max((abs(line.value) ** 2 for line in self.lines), default=self.power.highest)
        rounding = max(self.smallest, _SMALLEST**2 * strongest, np.finfo(np.float64).tiny)
        self.level = replace(level, least=rounding)

    def grow(self) -> bool:
        """Add all peaks that stand out anywhere and are no leakage of stronger ones; tell whether there were any."""
        height = chance_height(self.chance_anywhere, self.level.independent)
        found = []
        for part in _parts(self.last):
            first, stop = max(part.start, FIRST_BIN), part.stop
            power = self.power[first - 1 : stop + 1]
            inner, beside = power[1:-1], np.maximum(power[:-2], power[2:])
            found.append(first + np.flatnonzero((inner > height * self.level[first:stop]) & (inner >= beside)))
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
        known = np.concatenate([self.taken, [line.place for line in self.lines]])
        clear: list[int] = []
        for k in bins.tolist():
            if len(known) and np.min(np.abs(known - k)) < APART_BINS:
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
            for line in [line for line in self.lines if np.min(np.abs(near - line.place)) < _INTERACT]:
                self.lines.remove(line)
                noise = float(self.level[round(line.place)])
                add_line(self.rest, self.samples, line, self.least, 1.0)
                self._take(fit_line(self.rest, self.samples, line.place, noise))
        if bins:
            self.look()
        return bool(bins)

    def _take(self, line: BinLine) -> None:
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
        height = max(height, chance_height(chance, self.level.independent))
        return max(local, floor) if abs(line.value) ** 2 > height * local else None
