"""Effects of sampling on lines: aliases, exposure loss, and separable lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker.signal_notices import ALIASED_LINE, ALIASED_LINE_OTHER_RATE, INSEPARABLE_LINE
from shakercal._common.arrays import BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.notices import Notice, Value

CAPTURE = 5e-3  # relative: how far a fundamental may lie from its nominal frequency, besides two bins
_GAP = 3.0  # times the median interval: longer ones are gaps
_MAX_GAP_RATIO, _MAX_GRID_POINTS = 16, 1 << 22  # grid points: limit relative to the samples, and in total
GRID_TOLERANCE = 1e-2  # of a sampling interval: times this close to a grid are treated as being on it


@dataclass(frozen=True)
class AliasedHarmonic:
    """A harmonic `multiple`·`fundamental_hz` that appears at `alias_hz`, as the line `line_hz` does."""

    frequency_hz: float
    fundamental_hz: float
    multiple: int
    alias_hz: float
    line_hz: float


@dataclass(frozen=True)
class SamplingGrid:
    """Uniform sampling with gaps: sample i lies at `start_s + index[i] / rate_hz`."""

    start_s: float
    rate_hz: float
    index: IntArray

    @property
    def length(self) -> int:
        """Number of grid points from the first to the last sample."""
        return int(self.index[-1]) + 1

    def filled(self, values: FloatArray) -> FloatArray:
        """Return values (S,) or (S, C) on all grid points, zero in the gaps."""
        if len(values) == self.length:
            return values
        full = np.zeros((self.length, *values.shape[1:]))
        full[self.index] = values
        return full


def alias_frequency(frequency_hz: FloatArray | float, rate_hz: float) -> FloatArray:
    """Return the alias |f - rate·round(f/rate)| of lines, below the Nyquist frequency."""
    f = np.asarray(frequency_hz, dtype=np.float64)
    return np.asarray(np.abs(f - rate_hz * np.round(f / rate_hz)))


def frequency_of_alias(seen_hz: FloatArray, nominal_hz: FloatArray, rate_hz: float) -> FloatArray:
    """Return the frequencies near nominal ones with aliases `seen_hz`, which may move the opposite way."""
    off = seen_hz - alias_frequency(nominal_hz, rate_hz)
    downwards = nominal_hz - rate_hz * np.floor(nominal_hz / rate_hz) > rate_hz / 2.0
    return np.asarray(nominal_hz + np.where(downwards, -off, off))


def exposure_gain(frequency_hz: FloatArray, exposure_s: float) -> FloatArray:
    """Return sin(πfT) / (πfT), the gain of a rectangular exposure of T seconds."""
    return np.asarray(np.sinc(np.asarray(frequency_hz, dtype=np.float64) * exposure_s))


def sampling_grid(time_s: FloatArray) -> SamplingGrid | None:
    """Return the uniform grid, with gaps, of times within 1 %, else None."""
    check_shape("time_s", time_s, (None,))
    steps = np.diff(time_s)
    if len(time_s) < 3 or not np.all(steps > 0.0):
        return None
    interval = float(np.median(steps))
    steps /= interval
    np.round(steps, out=steps)
    if np.any(steps < 1.0):
        return None
    index = np.zeros(len(time_s), dtype=np.int64)
    index[1:] = np.cumsum(steps, out=steps)
    del steps  # of long records each array counts
    centred = index - index.mean()
    interval = float(centred @ time_s / (centred @ centred))
    start = float(np.mean(time_s) - interval * index.mean())
    np.multiply(index, interval, out=centred)
    centred -= time_s - start
    deviation = float(np.max(np.abs(centred, out=centred)))
    return SamplingGrid(start, 1.0 / interval, index) if deviation <= GRID_TOLERANCE * interval else None


def nearest_grid(time_s: FloatArray, oversampling: int = 1) -> SamplingGrid | None:
    """Return a uniform grid with each ascending time at its nearest point.

    `oversampling` is the number of grid points per mean interval without gaps. None where gaps make the grid far
    longer. Two samples may share a point, of which `filled` uses the later. Use such a grid for a spectrum to search
    in, never for a phase.
    """
    steps = np.diff(time_s)
    if len(time_s) < 3 or not np.all(steps > 0.0):
        return None
    interval = float(np.mean(steps[steps <= _GAP * float(np.median(steps))]))
    if (time_s[-1] - time_s[0]) / interval > max(_MAX_GRID_POINTS, _MAX_GAP_RATIO * len(time_s)):
        return None
    interval /= oversampling
    return SamplingGrid(float(time_s[0]), 1.0 / interval, np.rint((time_s - time_s[0]) / interval).astype(np.int64))


def sine_columns(time_s: FloatArray, frequency_hz: FloatArray) -> FloatArray:
    """Return the design matrix (S, 2K + 1) of lines and offset.

    Its columns are cos and sin of each line in turn, then the offset. Columns have unit length for ideal sampling (cos,
    sin by √(2/S)). The condition number therefore shows the deviation from ideal sampling. A line at zero or the
    Nyquist frequency has a vanishing column.
    """
    samples, lines = len(time_s), len(frequency_hz)
    columns = np.empty((samples, 2 * lines + 1), order="F")
    for k, frequency in enumerate(frequency_hz):
        angle = angles(frequency * time_s)
        np.cos(angle, out=columns[:, 2 * k])
        np.sin(angle, out=columns[:, 2 * k + 1])
    columns[:, : 2 * lines] *= np.sqrt(2.0 / samples)
    columns[:, 2 * lines] = np.sqrt(1.0 / samples)
    return columns


def angles(turns: FloatArray) -> FloatArray:
    """Return angles (-π to π rad) of turns, in place, with their last digits."""
    turns -= np.rint(turns)
    turns *= 2.0 * np.pi
    return turns


def condition_number(gram: FloatArray) -> float:
    """Return a design matrix's condition number from its Gram matrix, infinite if singular."""
    eigenvalues = np.linalg.eigvalsh(gram)
    limit = float(eigenvalues[-1]) * len(gram) * float(np.finfo(np.float64).eps)
    return float(np.sqrt(eigenvalues[-1] / eigenvalues[0])) if eigenvalues[0] > limit else float("inf")


def find_aliased_harmonics(
    frequency_hz: float, fundamentals_hz: Sequence[float], rate_hz: float, resolution_hz: float, max_multiple: int = 20
) -> tuple[AliasedHarmonic, ...]:
    """Return the harmonics that alias within `resolution_hz` of a line, where they are inseparable."""
    alias = float(alias_frequency(frequency_hz, rate_hz))
    found: dict[float, AliasedHarmonic] = {}
    for fundamental in fundamentals_hz:
        for multiple in range(1, max_multiple + 1):
            other = multiple * fundamental
            other_alias = float(alias_frequency(other, rate_hz))
            same_line = abs(other - frequency_hz) <= resolution_hz
            duplicate = any(abs(other - f) <= resolution_hz for f in found)
            if abs(other_alias - alias) <= resolution_hz and not same_line and not duplicate:
                found[other] = AliasedHarmonic(other, float(fundamental), multiple, other_alias, frequency_hz)
    return tuple(sorted(found.values(), key=lambda fold: fold.frequency_hz))


# Lines that sampling times can separate, and the nearest rate that can.

MAX_CONDITION = 10.0  # above it, the standard uncertainty of a line is several times that of well-spread sampling
CLEAR_BINS = 1.25
"""Distance, in bins of rate/frames, of lines that are clear of each other: the condition number is then at most 3."""
_MAX_CHANGE = 0.2  # of the rate: a larger change would be another measurement
_RATE_STEP_HZ = 1e-3  # resolution of proposed camera rates


def usable_lines(time_s: FloatArray, frequency_hz: FloatArray) -> tuple[BoolArray, tuple[Notice, ...]]:
    """Return which lines (K,) are separable, and notices of the dropped ones.

    Lines are examined in the given order, so put fundamentals first. A line is dropped if it raises the condition
    number of the design matrix, with the accepted lines and the offset, above `MAX_CONDITION`. The notice names the
    line or frequency onto which it aliases, and a nearby rate that would separate all lines.
    """
    columns = sine_columns(time_s, frequency_hz)
    gram = columns.T @ columns
    accepted: list[int] = []
    dropped: list[int] = []
    for k in range(len(frequency_hz)):
        chosen = [i for line in [*accepted, k] for i in (2 * line, 2 * line + 1)] + [-1]
        usable = condition_number(gram[np.ix_(chosen, chosen)]) <= MAX_CONDITION
        (accepted if usable else dropped).append(k)
    grid = sampling_grid(time_s) if dropped else None
    lines = np.asarray(frequency_hz, dtype=np.float64)
    notices = tuple(
        _dropped_line_notice(grid, float(lines[k]), lines[[i for i in accepted if i < k]], lines) for k in dropped
    )
    return np.isin(np.arange(len(lines)), accepted), notices


def separation_bins(frequency_hz: FloatArray, rate_hz: float, frames: int) -> float:
    """Return the smallest distance of uniformly sampled lines (K,) and zero, in bins of rate/frames.

    It is the distance, modulo the rate, between any two of the complex exponentials at 0 and ±f of the lines. The
    distance of a line from the Nyquist frequency thus counts twice. A distance of s > 1 bins limits the condition
    number of the design matrix to √((s + 1)/(s - 1)), for any number of lines (Moitra, Proc. 47th ACM Symp. Theory of
    Computing (2015), Theorem 2.3, for many frames).
    """
    turns = differences_hz(frequency_hz) / rate_hz
    return float(frames * np.min(np.abs(turns - np.round(turns)), initial=0.5))


def differences_hz(frequency_hz: FloatArray) -> FloatArray:
    """Return the distances between the exponentials at 0 and ±f of lines (K,)."""
    check_shape("frequency_hz", frequency_hz, (None,))
    first, second = np.triu_indices(len(frequency_hz), k=1)
    f, g = frequency_hz[first], frequency_hz[second]
    return np.concatenate([frequency_hz, 2.0 * frequency_hz, f + g, np.abs(f - g)])


def nearest_clear_rate(frequency_hz: FloatArray, rate_hz: float, frames: int) -> float | None:
    """Return the rate nearest to `rate_hz` that separates lines (K,) by `CLEAR_BINS`; None without one.

    Only multiples of 1 mHz within a fifth of `rate_hz` are considered. Two exponentials at a distance F are too
    close where |F/rate - k| < `CLEAR_BINS`/frames for a whole number k, which is an interval of rates. The search moves
    outwards from the present rate and leaves each interval at its far end. It therefore misses no rate and tries few.
    """
    if not rate_hz > 0.0:
        raise ValueError(f"rate_hz: expected a number above 0, found {rate_hz}")
    differences = differences_hz(frequency_hz)
    margin = CLEAR_BINS / frames
    limits = (rate_hz * (1.0 - _MAX_CHANGE), rate_hz * (1.0 + _MAX_CHANGE))
    found = [
        rate
        for direction, limit in zip((-1, 1), limits, strict=True)
        if (rate := _clear_rate_towards(differences, margin, rate_hz, _RATE_STEP_HZ * direction, limit)) is not None
    ]
    return min(found, key=lambda rate: abs(rate - rate_hz), default=None)


def _clear_rate_towards(
    differences: FloatArray, margin: float, start: float, step: float, limit: float
) -> float | None:
    """Return the first multiple of `step` from `start` towards `limit` outside all excluded intervals."""
    outward = 1.0 if step > 0.0 else -1.0
    count = np.ceil(start / step - 1e-9)  # a negative step turns "next above" into "next below"
    while outward * (limit - count * step) >= 0.0:
        rate = count * step
        turns = differences / rate
        nearest = np.round(turns)
        close = np.abs(turns - nearest) < margin
        if not close.any():
            return float(np.round(rate, 9))
        ends = nearest[close] - outward * margin
        if np.any(ends <= 0.0):  # the distance of these two does not increase in this direction
            return None
        edge = outward * np.max(outward * differences[close] / ends)
        count = max(count + 1.0, np.ceil(edge / step))
    return None


def _dropped_line_notice(
    grid: SamplingGrid | None, frequency: float, accepted: FloatArray, all_lines: FloatArray
) -> Notice:
    """Return the notice of a dropped line with its alias and a better rate."""
    where = f"{frequency:.6g} Hz"
    if grid is None:
        return Notice(INSEPARABLE_LINE, where, frequency_hz=frequency)
    rate, resolution = grid.rate_hz, grid.rate_hz / grid.length
    alias = float(alias_frequency(frequency, rate))
    neighbours = [(alias, "zero"), (abs(rate / 2.0 - alias), "the Nyquist frequency")]
    for other in accepted:
        other_alias = float(alias_frequency(other, rate))
        neighbours.append((abs(alias - other_alias), f"the line {other:.6g} Hz (at {other_alias:.4g} Hz)"))
    distance, neighbour = min(neighbours)
    values: dict[str, Value] = {
        "frequency_hz": frequency,
        "alias_hz": round(alias, 9),
        "distance_hz": distance if distance > 1e-3 * resolution else 0.0,
        "neighbour": neighbour,
        "rate_hz": rate,
        "duration_s": grid.length / rate,
        "resolution_hz": resolution,
    }
    for lines, separated in ((all_lines, "all lines"), (np.append(accepted, frequency), "this line")):
        better = nearest_clear_rate(lines, rate, grid.length)
        if better is not None:
            values |= {"better_rate_hz": better, "rate_change_hz": better - rate, "separated": separated}
            return Notice(ALIASED_LINE_OTHER_RATE, where, **values)
    return Notice(ALIASED_LINE, where, **values)
