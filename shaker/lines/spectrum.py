"""Amplitude spectra, lines fitted in few Hann bins, and the noise floor.

Time is counted from the middle of the record. The spectrum of a sine is then its phasor times a real kernel that falls
as the cube of the distance, so that a line affects only the bins around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import lgamma

import numpy as np

from shaker.io.channel import Stacked
from shakercal._common.arrays import ComplexArray, FloatArray, IntArray, check_shape


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
    """Return a periodic Hann window (S,) of mean 1, which preserves a sine's amplitude."""
    return np.asarray(1.0 - np.cos(2.0 * np.pi * np.arange(samples) / samples))


def amplitude_spectrum(samples: FloatArray | Stacked, sample_rate_hz: float, max_bins: int | None = None) -> Spectrum:
    """Return the one-sided Hann amplitude spectrum of samples (S,) or (S, C) without their mean.

    A sine on a bin shows its peak amplitude, one between two bins up to 15 % less. With more than `most_bins` bins, the
    highest of neighbouring bins is returned at their mean frequency.
    """
    count = len(samples)
    if count < 2:
        raise ValueError(f"samples: expected at least 2 samples, found {count}")
    stacked = Stacked.from_array(samples)
    bins = count // 2 + 1
    merged = 1 if max_bins is None else -(-bins // max_bins)
    first = np.arange(0, bins, merged)
    amplitude = np.empty((len(first), stacked.shape[1]))
    for c, column in enumerate(stacked.iterate_channels()):
        spectrum = _hann_rfft(column, count / 2.0)
        spectrum[0] /= 2.0
        if count % 2 == 0:
            spectrum[-1] /= 2.0
        magnitude = np.empty(bins)
        for part in split_bins(bins):
            magnitude[part] = np.abs(spectrum[part]) * (2.0 / count)
        amplitude[:, c] = np.maximum.reduceat(magnitude, first)
    last = np.minimum(first + merged, bins) - 1
    frequency = (first + last) / 2.0 * (1.0 / (count * (1.0 / sample_rate_hz)))
    return Spectrum(frequency, amplitude.reshape(-1, *samples.shape[1:]))


# Hann spectra, in which lines are fitted and subtracted in a few bins.

_HALF_WIDTH = 3  # bins on each side of a line to which it is fitted
_MAX_STEPS = 10  # Gauss-Newton steps of the fit of a line
_CONVERGED = 1e-6  # square of the last step over the variance of the position, at most
_BIN_CORRELATION = (1.0, 2.0 / 3.0, 1.0 / 6.0)  # of white noise in Hann bins at distances 0, 1, 2
_MIN_DRIFT_POWER = 1e4  # power of a line over the noise above which its linear change of amplitude is fitted
_MAX_REMAINDER = 0.05  # amplitude of a line outside its bins over that of the noise
_MAX_HALF_WIDTH = 20_000  # bins on each side of a line from which it is subtracted
_SERIES_BELOW = 1e-5  # bins from its centre below which the kernel is computed by its series


@dataclass(frozen=True)
class BinLine:
    """A line: position in bins, phasor `value`, `slope`, and uncertainties.

    The phasor is that at the middle of the record. `slope` is the factor of the kernel's derivative, which describes a
    linear change of the amplitude; 0 if that is not resolved.
    """

    bin_position: float
    value: complex
    slope: complex
    u_bin_position: float
    u_value: float


def centred_spectrum(samples: FloatArray) -> ComplexArray:
    """Return the Hann spectrum (B,) of samples (S,), phases at their middle."""
    count = len(samples)
    spectrum = _hann_rfft(samples, (count - 1) / 2.0)
    for part in split_bins(len(spectrum)):
        turn = np.exp(np.arange(part.start, part.stop) * (-1j * np.pi / count))
        turn[1::2] *= -1.0  # parts begin at even bins
        spectrum[part] *= turn * (2.0 / count)
    return spectrum


_MIN_SPLIT_SAMPLES = 1 << 22  # samples from which on shorter transforms are combined, to save memory
_BLOCK_BINS = 1 << 18  # bins processed at a time
_MIN_PARTS, _MAX_PARTS = 16, 64  # shorter transforms that are combined
_MMAP_BYTES = 1 << 26  # bytes above which the memory of a deleted array returns to the system at once


def split_bins(bins: int, most: int = _BLOCK_BINS) -> list[slice]:
    """Return slices of at most `most` bins that cover all bins."""
    return [slice(first, min(first + most, bins)) for first in range(0, bins, most)]


def _hann_rfft(samples: FloatArray, middle: float) -> ComplexArray:
    """Return the transform (B,) of samples (S,), mean removed, times 1 + cos(2π/S·(n - middle)).

    Long records are split. Every r-th sample is transformed, r a divisor of S. The r transforms F_q are combined
    (decimation in time, Cooley and Tukey 1965). With M = S/r it is X(jM + m) = Σ_q
    exp(-2πi·qj/r)·exp(-2πi·qm/S)·F_q(m), a transform of r numbers for each m. Values of m up to M/2 are enough: X(jM +
    M - m) is the conjugate of X((r - 1 - j)M + m).
    """
    count, mean = len(samples), samples.mean()
    pieces = (
        next((r for r in range(_MIN_PARTS, _MAX_PARTS + 1) if count % r == 0), 1) if count >= _MIN_SPLIT_SAMPLES else 1
    )
    turn = 2.0 * np.pi / count
    if pieces == 1:
        return np.asarray(np.fft.rfft(_apply_window(samples, mean, middle, slice(0, count))))
    length, bins = count // pieces, count // 2 + 1
    halves = [np.empty(0, dtype=np.complex128)] * pieces
    order = sorted(range(pieces), key=lambda q: min(q, pieces - 1 - q))  # in which their memory can be released
    each = max(1, _MMAP_BYTES // (8 * length))
    for some in (order[first : first + each] for first in range(0, pieces, each)):
        block = np.empty((len(some), length // 2 + 1), dtype=np.complex128)
        for q, row in zip(some, block, strict=True):
            row[:] = np.fft.rfft(_apply_window(samples, mean, middle, slice(q, count, pieces)))
            halves[q] = row
    del block, row
    for part in split_bins(length // 2 + 1):
        step = np.exp(np.arange(part.start, part.stop) * (-1j * turn))
        twist = np.ones(len(step), dtype=np.complex128)
        twisted = np.empty((pieces, len(step)), dtype=np.complex128)
        for half, row in zip(halves, twisted, strict=True):
            np.multiply(half[part], twist, out=row)
            twist *= step
        for half, row in zip(halves, np.fft.fft(twisted, axis=0), strict=True):
            half[part] = row
    del half
    result = np.empty(bins, dtype=np.complex128)
    last = (bins - 1) // length
    for j in range(last + 1):
        target = result[j * length : (j + 1) * length]
        low, high = halves[j][: len(target)], halves[pieces - 1 - j][length - length // 2 - 1 : 0 : -1]
        target[: len(low)] = low
        np.conjugate(high[: len(target) - len(low)], out=target[len(low) :])
        done = (j, pieces - 1 - j) if pieces - 1 - j > last else (j,)
        for number in done:  # release the memory, which the result needs now
            halves[number] = np.empty(0, dtype=np.complex128)
    return result


def _apply_window(samples: FloatArray, mean: float, middle: float, which: slice) -> FloatArray:
    """Return samples `which`, less `mean`, times 1 + cos(2π/S·(n - middle)), with little memory."""
    window = np.arange(which.start, which.stop, which.step, dtype=np.float64)
    window -= middle
    window *= 2.0 * np.pi / len(samples)
    np.cos(window, out=window)
    window += 1.0
    window *= samples[which] - mean
    return window


def hann_kernel(position: float, low: int, high: int, samples: int) -> tuple[FloatArray, FloatArray]:
    """Return the spectrum of a unit line in some bins, and its position derivative.

    The line is at `position`, the bins are `low` to `high` - 1. K(δ) = D(δ) + ½D(δ - 1) + ½D(δ + 1) with Dirichlet's
    kernel D(δ) = sin(πδ) / (N sin(πδ/N)).
    """
    distance = position - np.arange(low - 1, high + 1)
    near = np.abs(distance) < _SERIES_BELOW
    series = distance[near]
    distance[near] = _SERIES_BELOW
    below = samples * np.sin(np.pi / samples * distance)
    dirichlet = np.sin(np.pi * distance) / below
    slope = np.pi * (np.cos(np.pi * distance) - dirichlet * np.cos(np.pi / samples * distance)) / below
    curvature = -(np.pi**2) / 3.0 * (1.0 - 1.0 / samples**2)
    dirichlet[near], slope[near] = 1.0 + curvature / 2.0 * series**2, curvature * series
    return (dirichlet[1:-1] + 0.5 * (dirichlet[:-2] + dirichlet[2:]), slope[1:-1] + 0.5 * (slope[:-2] + slope[2:]))


def fit_line(spectrum: ComplexArray, samples: int, start: float, noise: float) -> BinLine:
    """Fit a line to the bins around `start` by weighted least squares.

    The weights allow for correlated Hann bins. Y = A·K(δ) + B·K'(δ). The part of B in phase with A is a shift of the
    line, which Gauss-Newton steps remove; the other part is a linear change of the amplitude. `noise` is the noise
    power of a bin.
    """
    low, high = max(1, round(start) - _HALF_WIDTH), min(len(spectrum), round(start) + _HALF_WIDTH + 1)
    weight = _hann_weight(high - low)
    position, value = start, 0j
    for _ in range(_MAX_STEPS):
        data = spectrum[low:high] - np.conj(value) * hann_kernel(-position, low, high, samples)[0]
        design = np.stack(hann_kernel(position, low, high, samples))
        weighted = design @ weight
        covariance = np.linalg.inv(weighted @ design.T)
        value, slope = (complex(c) for c in covariance @ (weighted @ data))
        step = (slope / value).real if value else 0.0
        position += min(max(step, -0.5), 0.5)
        if abs(position - start) > 1.0:
            position = start
            break
        if abs(step * value) ** 2 < _CONVERGED * covariance[1, 1] * noise:
            break
    quadrature = noise / 2.0 * covariance.diagonal()
    change = 1j * value * (slope / value).imag if value else 0j
    tame = abs(value) ** 2 > _MIN_DRIFT_POWER * noise and abs(change) < 0.3 * abs(value)
    u_position = float(np.sqrt(quadrature[1])) / max(abs(value), np.finfo(np.float64).tiny)
    return BinLine(position, value, change if tame else 0j, u_position, float(np.sqrt(quadrature[0])))


def line_bins(line: BinLine, bins: int, noise: float) -> tuple[int, int]:
    """Return the range of bins outside which a line is negligible against noise."""
    reach = (abs(line.value) / (_MAX_REMAINDER * np.sqrt(noise) * np.pi)) ** (1.0 / 3.0)
    width = int(min(max(reach, 4.0), _MAX_HALF_WIDTH)) + 2
    return max(0, round(line.bin_position) - width), min(bins, round(line.bin_position) + width + 1)


def add_line(spectrum: ComplexArray, samples: int, line: BinLine, bins: tuple[int, int], sign: float) -> None:
    """Add a line times `sign` to a range of bins of a spectrum, in place."""
    low, high = bins
    shape, slope = hann_kernel(line.bin_position, low, high, samples)
    part = line.value * shape + np.conj(line.value) * hann_kernel(-line.bin_position, low, high, samples)[0]
    spectrum[low:high] += sign * (part + line.slope * slope)


@lru_cache(maxsize=8)
def _hann_weight(count: int) -> FloatArray:
    """Return the inverse of the correlation matrix of white noise in neighbouring Hann bins."""
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(np.linalg.inv(np.array([*_BIN_CORRELATION, *[0.0] * count])[lag]))


# The noise floor of a power spectrum, and the height above it that noise reaches with a given probability.

FIRST_BIN = 3  # the lowest bin used: lower ones contain drift
_BLOCK_SIZES = (64, 256)  # bins per median, narrow and wide
_LOW_BINS = 256  # lowest bins, in which a trend of the noise towards zero frequency is removed first
_MAX_POWER_RATIO = 4.0  # power over the trend at which the power is limited in the fit of the trend
_FIT_STEPS = 60  # steps of the fit of the trend (chosen)
_ROUNDING = 1e-9  # relative rounding error of an interpolated level, with a wide margin
BINS_PER_INDEPENDENT = 1.94  # 1 + 2·(4/9 + 1/36): neighbouring Hann bins are correlated


class BinPower:
    """Power of the bins of a spectrum (B,), computed on demand to save memory."""

    def __init__(self, spectrum: ComplexArray) -> None:
        self._spectrum = spectrum

    def __len__(self) -> int:
        return len(self._spectrum)

    def __getitem__(self, bins: slice | int | IntArray) -> FloatArray:
        values = np.asarray(self._spectrum[bins])
        return np.asarray(np.square(values.real) + np.square(values.imag))

    @property
    def highest(self) -> float:
        """The power of the strongest bin."""
        return max((float(self[part].max()) for part in split_bins(len(self))), default=0.0)


@dataclass(frozen=True, eq=False)
class NoiseLevel:
    """Noise power of the bins (B,), interpolated on demand, and no less than `minimum`.

    `curves` are centres of blocks and the logarithm of their level. `trend` is a factor for the lowest bins.
    `independent_bins` is the number of independent bins behind each value.
    """

    bins: int
    curves: tuple[tuple[FloatArray, FloatArray], ...]
    trend: FloatArray
    independent_bins: float
    minimum: float = 0.0

    def __len__(self) -> int:
        return self.bins

    def __getitem__(self, bins: slice | int | IntArray) -> FloatArray:
        at = np.arange(*bins.indices(self.bins)) if isinstance(bins, slice) else np.asarray(bins)
        levels = [np.exp(np.interp(at, centres, log_level)) for centres, log_level in self.curves]
        level = levels[0] if len(levels) == 1 else np.maximum(levels[0], levels[1])
        if len(self.trend) and at.min(initial=self.bins) < len(self.trend):
            level = level * np.where(at < len(self.trend), self.trend[np.minimum(at, len(self.trend) - 1)], 1.0)
        return np.asarray(np.maximum(level, self.minimum))

    def lower_bound(self, bins: slice) -> float:
        """Return a lower bound of the level of these bins."""
        lowest = -np.inf
        for centres, log_level in self.curves:
            first, last = np.searchsorted(centres, (bins.start, bins.stop - 1))
            lowest = max(lowest, float(log_level[max(first - 1, 0) : last + 1].min()))
        trend = min(1.0, float(self.trend[bins].min(initial=1.0)))
        return max(float(np.exp(lowest)) * trend * (1.0 - _ROUNDING), self.minimum)

    @property
    def lowest(self) -> float:
        """The noise power of the quietest bin."""
        return min(float(self[part].min()) for part in split_bins(self.bins))


def noise_level(
    power: FloatArray | BinPower, previous: NoiseLevel | None = None, changed: Sequence[tuple[int, int]] = ()
) -> NoiseLevel:
    """Return the noise power of every bin (B,).

    It is the median of blocks of bins, which ignores lines, divided by ln 2 (a bin's power has an exponential
    distribution) and interpolated. Narrow and wide blocks are evaluated, and the higher value is used. Towards zero
    frequency, drift and 1/f noise rise faster than a block resolves. A parabola in log power over log frequency is
    therefore divided out first, by maximum Whittle likelihood of the power limited to four times the floor.

    `previous` is the level before the power in the ranges of bins `changed` was modified. Only the medians of blocks
    with such bins, and with the lowest bins, are computed again.
    """
    usable = len(power) - FIRST_BIN
    if usable < 1:
        return NoiseLevel(len(power), ((np.zeros(1), np.zeros(1)),), np.ones(0), 1.0)
    trend = _low_trend(power)
    curves: list[tuple[FloatArray, FloatArray]] = []
    counts: list[float] = []
    for size in _BLOCK_SIZES:
        blocks = max(1, usable // size)
        if blocks == 1 and counts:
            break
        edges = FIRST_BIN + np.round(np.linspace(0.0, usable, blocks + 1)).astype(np.int64)
        new_blocks = np.ones(blocks, dtype=np.bool_)
        log_level = np.empty(blocks)
        if previous is not None:
            new_blocks[:] = False
            log_level[:] = previous.curves[len(curves)][1]
            for low, high in (*changed, (0, len(trend))):
                new_blocks[max(0, np.searchsorted(edges, low, "right") - 1) : np.searchsorted(edges, high)] = True
        medians = _medians(power, trend, edges[:-1][new_blocks], int(np.min(np.diff(edges))))
        log_level[new_blocks] = np.log(np.maximum(medians / np.log(2.0), np.finfo(np.float64).tiny))
        curves.append(((edges[:-1] + edges[1:] - 1) / 2.0, log_level))
        counts.append(usable / blocks)
    return NoiseLevel(len(power), tuple(curves), trend, max(counts) / BINS_PER_INDEPENDENT)


def _medians(power: FloatArray | BinPower, trend: FloatArray, first: IntArray, length: int) -> FloatArray:
    """Return the medians of blocks of `length` bins from `first`, divided by the trend."""
    medians = np.empty(len(first))
    step = max(1, _BLOCK_BINS // length)
    for k in range(0, len(first), step):
        bins = first[k : k + step, None] + np.arange(length)
        flat = power[bins]
        low = np.flatnonzero(bins[:, 0] < len(trend))
        flat[low] /= np.append(trend, 1.0)[np.minimum(bins[low], len(trend))]
        medians[k : k + step] = np.median(flat, axis=1, overwrite_input=True)
    return medians


def _low_trend(power: FloatArray | BinPower) -> FloatArray:
    """Return the trend of the noise over the lowest bins, a factor ending at 1."""
    last = min(_LOW_BINS, len(power) - 1)
    if last - FIRST_BIN < 16:
        return np.ones(0)
    bins = np.arange(FIRST_BIN, last + 1)
    log_bin = np.log(bins / last)
    columns, _ = np.linalg.qr(np.stack([np.ones_like(log_bin), log_bin, log_bin**2], axis=1))
    observed = np.maximum(power[bins], np.finfo(np.float64).tiny)
    log_power = columns @ (columns.T @ (np.log(observed) + np.euler_gamma))
    share = 1.0 - np.exp(-_MAX_POWER_RATIO)
    for _ in range(_FIT_STEPS):
        excess = np.minimum(observed / np.exp(log_power), _MAX_POWER_RATIO) / share - 1.0
        log_power = log_power + columns @ (columns.T @ excess)
    trend = np.exp(log_power - log_power[-1])
    return np.concatenate([np.full(FIRST_BIN, trend[0]), trend])


@lru_cache(maxsize=256)
def chance_height(chance: float, independent_bins: float) -> float:
    """Return the multiple of the noise level that noise exceeds with probability `chance`.

    The level is estimated by the median of `independent_bins`. Of n exponential values, another exceeds T times the
    k-th smallest with probability Π (n - i) / (n - i + T), i < k (Rohling, IEEE Trans. AES 19 (1983), eq. 39).
    """
    n = max(independent_bins, 1.5)
    k = (n + 1.0) / 2.0
    low, high = 0.0, 1e12
    for _ in range(200):
        t = 0.5 * (low + high) if high < 1e3 else np.sqrt(max(low, 1e-3) * high)
        log_chance = lgamma(n + 1.0) - lgamma(n - k + 1.0) + lgamma(n - k + 1.0 + t) - lgamma(n + 1.0 + t)
        low, high = (t, high) if log_chance > np.log(chance) else (low, t)
        if high - low < 1e-9 * high:
            break
    return float(high * np.log(2.0))
