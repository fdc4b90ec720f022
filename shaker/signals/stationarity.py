"""Whether amplitude and phase of lines stay the same through a record, from blocks of whole periods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape
from shaker.signals.folding import alias_frequency, sampling_grid, sine_columns
from shaker.signals.noise import line_noise
from shaker.signals.separation import MAX_CONDITION, separation_bins
from shaker.signals.sine import SineSolution, solve_sines

MAX_BLOCKS = 10
_UNUSED = 0.02  # of the record may be left over for the sake of more blocks
_APART = 8.0  # bins between lines from which on a drift can be taken off without touching their noise
_SLOPES = ("amplitude_per_s", "u_amplitude_per_s", "phase_rad_per_s", "u_phase_rad_per_s", "p_value")
_NOISE_SAMPLES = 1 << 17  # of a longer record no more are needed for its noise density


@dataclass(frozen=True)
class Stationarity:
    """Phasors of K lines in C channels over B blocks of a record, and what they say of a drift.

    `time_s` (B,) middles of the blocks, of `block_s` each; `periods`, how many of the first line's periods a block
    holds (below twice its frequency, those of its alias), `whole` whether that is a whole number. `value` (B, K, C),
    referred to time zero as those of the whole record, with `u` (B, K, C), standard uncertainty of either part.
    `amplitude_per_s` and `phase_rad_per_s` (K, C): slope of a straight line through the blocks, with their `u_`.
    `p_value` (K, C): how often noise alone moves the blocks that far from their mean.
    """

    frequency_hz: FloatArray
    channels: tuple[str, ...]
    time_s: FloatArray
    block_s: float
    periods: float
    whole: bool
    value: ComplexArray
    u: FloatArray
    amplitude_per_s: FloatArray
    u_amplitude_per_s: FloatArray
    phase_rad_per_s: FloatArray
    u_phase_rad_per_s: FloatArray
    p_value: FloatArray

    def __post_init__(self) -> None:
        lines, channels = len(self.frequency_hz), len(self.channels)
        check_shape("time_s", self.time_s, (None,))
        for name in ("value", "u"):
            check_shape(name, getattr(self, name), (len(self.time_s), lines, channels))
        for name in _SLOPES:
            check_shape(name, getattr(self, name), (lines, channels))

    @property
    def length_s(self) -> float:
        """Time from the beginning of the first block to the end of the last."""
        return float(self.time_s[-1] - self.time_s[0]) + self.block_s

    def select(self, channel: str) -> Stationarity:
        """Return one channel."""
        if channel not in self.channels:
            raise ValueError(f"channel: expected one of {', '.join(self.channels)}, found {channel}")
        place = self.channels.index(channel)
        names = ("value", "u", *_SLOPES)
        chosen = {name: getattr(self, name)[..., place : place + 1] for name in names}
        return replace(self, channels=(channel,), **chosen)


def stationarity(
    time_s: FloatArray, values: FloatArray, frequency_hz: FloatArray, channels: Sequence[str]
) -> Stationarity | None:
    """Fit the lines (K,) to blocks of `values` (S, C) at ascending times (S,), the blocks holding whole periods.

    The periods are those of the first line's alias, so that beyond the Nyquist rate a block holds whole beats; where
    the record has fewer than two, its halves are the blocks. At most ten blocks. Phasors of a block come from the fit
    of all lines and an offset to its samples, their noise from the density around each line of what the whole record's
    fit leaves, without the sidebands that a drift makes. The test is that of Fisher for 2(B - 1) real residuals about
    the weighted mean. None where the blocks are too short to tell the lines apart. Rows with a NaN are left out.
    """
    check_shape("time_s", time_s, (None,))
    check_shape("values", values, (len(time_s), len(channels)))
    present = np.isfinite(values).all(axis=1)
    time, data = (time_s, values) if present.all() else (time_s[present], values[present])
    block_s, periods, whole = _block_length(time, frequency_hz)
    blocks = _blocks(time, block_s)
    found = [_solved(time[rows], data[rows], frequency_hz) for rows in blocks]
    solved = [solution for solution in found if solution is not None]
    if len(solved) < len(blocks):
        return None
    value, spread = _phasors(solved, [rows.stop - rows.start for rows in blocks], len(frequency_hz))
    variance, dof = _noise(time, data, frequency_hz)
    u = np.sqrt(spread[:, :, None] * variance[None])
    middle = np.array([time[rows].mean() for rows in blocks])
    amplitude, phase, p_value = _course(middle, value, u, dof)
    return Stationarity(
        frequency_hz, tuple(channels), middle, block_s, periods, whole, value, u, *amplitude, *phase, p_value
    )


def _block_length(time: FloatArray, frequency_hz: FloatArray) -> tuple[float, float, bool]:
    """Return length of a block in s, the first line's periods in it, and whether these are whole."""
    grid = sampling_grid(time)
    if grid is None:
        length, seen_hz = float(time[-1] - time[0]), float(frequency_hz[0])
    else:
        length, seen_hz = grid.length / grid.rate_hz, float(alias_frequency(frequency_hz[0], grid.rate_hz))
    # A tenth of a period more or less is no harm: each block is fitted, not averaged.
    total = int(np.floor(length * seen_hz + 0.1))
    if total < 2:
        return length / 2.0, length * seen_hz / 2.0, False
    counts = np.arange(2, min(total, MAX_BLOCKS) + 1)
    used = counts * (total // counts)
    count = int(np.max(counts[used >= min((1.0 - _UNUSED) * total, used.max())]))
    periods = total // count
    return min(periods / seen_hz, length / count), float(periods), True


def _blocks(time: FloatArray, block_s: float) -> list[slice]:
    """Return the rows of each block, the blocks in the middle of the record."""
    interval = float(time[-1] - time[0]) / (len(time) - 1)
    length = float(time[-1] - time[0]) + interval
    count = int(np.floor(length / block_s * (1.0 + 1e-9)))
    start = float(time[0]) - interval / 2.0 + (length - count * block_s) / 2.0
    edges: IntArray = np.searchsorted(time, start + block_s * np.arange(count + 1))
    return [slice(int(low), int(high)) for low, high in pairwise(edges)]


def _solved(time: FloatArray, data: FloatArray, frequency_hz: FloatArray) -> SineSolution | None:
    """Fit all lines to one block, None where it cannot tell them apart."""
    columns = sine_columns(time, frequency_hz)
    if len(columns) <= columns.shape[1]:
        return None
    try:
        solution = solve_sines(columns, data)
    except ValueError:
        return None
    return solution if solution.condition <= MAX_CONDITION else None


def _phasors(solved: Sequence[SineSolution], samples: Sequence[int], lines: int) -> tuple[ComplexArray, FloatArray]:
    """Return the phasors (B, K, C) and the variance (B, K) of their parts for noise of variance 1."""
    scale = np.sqrt(2.0 / np.array(samples, dtype=np.float64))
    parts = np.array([solution.coefficients[: 2 * lines] for solution in solved])
    value = scale[:, None, None] * (parts[:, 0::2] - 1j * parts[:, 1::2])
    inverse = np.array([np.diag(solution.inverse)[: 2 * lines] for solution in solved])
    return value, scale[:, None] ** 2 * (inverse[:, 0::2] + inverse[:, 1::2]) / 2.0


def _noise(time: FloatArray, data: FloatArray, frequency_hz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the noise variance (K, C) around the lines, and its degrees of freedom (K,), from the record's middle."""
    first = max(0, (len(time) - _NOISE_SAMPLES) // 2)
    time, data = time[first : first + _NOISE_SAMPLES], data[first : first + _NOISE_SAMPLES]
    columns, lines, grid = sine_columns(time, frequency_hz), len(frequency_hz), sampling_grid(time)
    if grid is not None and separation_bins(frequency_hz, grid.rate_hz, grid.length) >= _APART:
        # A drift of amplitude and phase makes skirts around each line that would count as noise.
        span = np.sqrt(3.0) * (2.0 * (time - time[0]) / (time[-1] - time[0]) - 1.0)
        columns = np.hstack([columns, columns[:, : 2 * lines] * span[:, None]])
    solution = solve_sines(columns, data)
    residual, free = solution.residual, float(len(time) - len(solution.coefficients))
    if grid is not None:
        line_bin = alias_frequency(frequency_hz, grid.rate_hz) * grid.length / grid.rate_hz
        noise = line_noise(grid.filled(residual), len(time), line_bin, blocks=False)
        if noise is not None:
            return noise.variance, np.minimum(noise.dof, free)
    return np.tile(np.sum(residual**2, axis=0) / free, (lines, 1)), np.full(lines, free)


_Slope = tuple[FloatArray, FloatArray]


def _course(
    middle: FloatArray, value: ComplexArray, u: FloatArray, dof: FloatArray
) -> tuple[_Slope, _Slope, FloatArray]:
    """Return the slopes of amplitude and phase with their uncertainty (K, C), and the chance of such blocks."""
    from scipy.stats import f

    tiny = np.finfo(np.float64).tiny
    weight = 1.0 / np.maximum(u**2, tiny)
    mean = np.sum(weight * value, axis=0) / np.sum(weight, axis=0)
    # Along the mean phasor the change of amplitude, across it that of phase times amplitude.
    turned = (value - mean) * np.exp(-1j * np.angle(mean))
    chi2 = np.sum(weight * np.abs(turned) ** 2, axis=0)
    free = 2.0 * (len(middle) - 1)
    centred = middle[:, None, None] - np.sum(weight * middle[:, None, None], axis=0) / np.sum(weight, axis=0)
    spread = np.sum(weight * centred**2, axis=0)
    slope = np.sum(weight * centred * turned, axis=0) / spread
    u_slope = 1.0 / np.sqrt(spread)
    size = np.maximum(np.abs(mean), tiny)
    p_value = np.asarray(f.sf(chi2 / free, free, dof[:, None]))
    return (slope.real, u_slope), (slope.imag / size, u_slope / size), p_value
