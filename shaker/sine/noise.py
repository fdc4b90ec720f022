"""Noise of a line: spectral density of the residual around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import ComplexArray, FloatArray, IntArray

# Distinct sines next to lines and straight-line changes of the lines, subtracted before noise is estimated.

OFFSET_BIN = 0.5  # bins: positions up to this are that of the offset
TONE_CLEARANCE = 1.9  # bins from a line within which a peak belongs to the line's fluctuation
_TONE_LIMIT = 9.2  # height of a sine over the level: exceeded by pure noise once in 10⁴ ordinates
_TONES = 16  # sines and changes that are searched for


def _highest_sine(
    ordinates: ComplexArray, level: FloatArray, bins: FloatArray, line_bin: FloatArray, length: int
) -> tuple[FloatArray, ComplexArray, FloatArray]:
    """Return position, transform and height (K, C) of the highest sine.

    The position is between two bins. Over the level, ordinates on a bin, and half the squared difference of neighbours
    between bins, are standard exponential variables without a sine; with one, the two ordinates are as 1/distance with
    opposite signs. Peaks near a line belong to the line's fluctuation.
    """
    relative = ordinates / np.sqrt(level)
    between = np.abs(relative[:, 1:] - relative[:, :-1]) ** 2 / 2.0
    height = np.maximum(between, np.maximum(np.abs(relative[:, 1:]) ** 2, np.abs(relative[:, :-1]) ** 2))
    clear = np.abs(bins[:, None, :] - line_bin[None, :, None]).min(axis=1) > TONE_CLEARANCE
    allowed = (np.diff(bins, axis=1) == 1.0) & clear[:, :-1] & clear[:, 1:]
    height = np.where(allowed[:, :, None], height, 0.0)
    # Of the two pairs that an ordinate belongs to, the one with the higher partner.
    pair = np.abs(relative[:, 1:]) ** 2 + np.abs(relative[:, :-1]) ** 2
    top = height.max(axis=1, keepdims=True)
    index = np.argmax(np.where(height >= top, pair, -1.0), axis=1, keepdims=True)
    low, high = (np.take_along_axis(ordinates, index + step, axis=1)[:, 0] for step in (0, 1))
    difference = high - low
    share = np.clip((high / np.where(difference == 0.0, 1.0, difference)).real, 0.0, 1.0)
    before, after = _kernel(-share, length), _kernel(1.0 - share, length)
    value = (low * before.conj() + high * after.conj()) / (np.abs(before) ** 2 + np.abs(after) ** 2)
    where = np.take_along_axis(bins[:, :, None], index, axis=1)[:, 0] + share
    return where, np.asarray(value), top[:, 0]


def _subtract_tones(
    ordinates: ComplexArray, bins: FloatArray, line_bin: FloatArray, length: int
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Subtract sines and straight-line changes of lines (K,) from ordinates (K, M, C).

    The highest relative to the remaining level is subtracted first, until pure noise would be as high (Högbom 1974,
    CLEAN, one channel and line at a time). Returned are the remainder, the remainder including the sines, and the power
    (K, C) of the sines in the fitted lines.
    """
    shape, rest, changed = _shapes(bins), ordinates.copy(), np.zeros_like(ordinates)
    leaked = np.zeros((len(bins), ordinates.shape[2]))
    line_positions = line_bin[line_bin > OFFSET_BIN]
    for _ in range(_TONES):
        level = _fit_levels(np.abs(rest) ** 2 + _NO_POWER, shape).mean
        where, top, height = _highest_sine(rest, level, bins, line_bin, length)
        change, drift_height = _highest_change(rest, level, bins, line_positions, length)
        drifts = (drift_height > height) & (drift_height > _TONE_LIMIT)
        peaks = (height >= drift_height) & (height > _TONE_LIMIT)
        if not (drifts.any() or peaks.any()):
            break
        top = np.where(peaks, top, 0.0)
        change = np.where(drifts[:, None, :], change, 0.0)
        leaked += np.abs(_sine(line_bin[:, None], where, top, length)) ** 2
        rest -= change + _sine(bins[:, :, None], where[:, None, :], top[:, None, :], length)
        changed += change
    return rest, ordinates - changed, leaked


def _highest_change(
    ordinates: ComplexArray, level: FloatArray, bins: FloatArray, line_positions: FloatArray, length: int
) -> tuple[ComplexArray, FloatArray]:
    """Return transform (K, M, C) and height (K, C) of the highest straight-line change."""
    best, height = np.zeros_like(ordinates), np.zeros((len(bins), ordinates.shape[2]))
    for position in line_positions:
        near = (bins[:, 0] < position) & (position < bins[:, -1])
        ramp = np.where(near[:, None], _ramp_kernel(bins - position, length), 0.0)[:, :, None]
        seen = np.sum(np.abs(ramp) ** 2 / level, axis=1)
        size = np.sum(ramp.conj() * ordinates / level, axis=1) / np.where(near[:, None], seen, 1.0)
        line_height = np.abs(size) ** 2 * seen
        size = size[:, None, :]
        made = size * ramp + size.conj() * _ramp_kernel(bins + position, length)[:, :, None]
        best = np.where((line_height > height)[:, None, :], made, best)
        height = np.maximum(line_height, height)
    return best, height


def _sine(bins: FloatArray, position: FloatArray, top: ComplexArray, length: int) -> ComplexArray:
    """Return the transform of a real sine, `top` at its position, at `bins`."""
    return np.asarray(top * _kernel(bins - position, length) + top.conj() * _kernel(bins + position, length))


def _kernel(distance: FloatArray, length: int) -> ComplexArray:
    """Return the transform of a complex sine at a distance in bins."""
    turn = np.exp(-1j * np.pi * distance * (1.0 - 1.0 / length))
    return np.asarray(np.sinc(distance) / np.sinc(distance / length) * turn)


def _ramp_kernel(distance: FloatArray, length: int) -> ComplexArray:
    """Return the transform of a complex sine that grows from -1 to 1."""
    angle = np.pi * distance
    size = (np.cos(angle) - np.sinc(distance)) / np.where(angle == 0.0, 1.0, angle)
    return np.asarray(1j * size * np.exp(-1j * angle * (1.0 - 1.0 / length)))


# The noise that disturbs a line: spectral density of the residual around it.

_NEIGHBOURS = 96  # bins from which the noise around a line is estimated
_MIN_NEIGHBOURS = 12  # bins below which no noise is estimated; chosen
_CLEARANCE = 0.75  # bins from a line that its fit has emptied
# Shapes that the noise may have: S(j) = s·(1 + (corner/j)^exponent), the corner in bins.
# With a corner below four bins a steep shape differs from white noise in the first ordinates only: too few to decide.
_CORNERS = {1.0: 2.0 ** np.arange(0, 10), 2.0: 2.0 ** np.arange(2, 10), 3.0: 2.0 ** np.arange(2, 10)}
_WHITE_WEIGHT = 0.25  # prior weight of white noise; the exponents share the rest
_PRIOR = np.concatenate(
    [[_WHITE_WEIGHT], *(np.full(len(c), (1.0 - _WHITE_WEIGHT) / len(_CORNERS) / len(c)) for c in _CORNERS.values())]
)
_BLOCK_BINS = 4  # ordinates nearest to a line, which show the scatter between blocks of the record
_BLOCK_LIMIT = 3.27  # their mean over the level: exceeded by pure noise once in 1000 lines
_NEWTON_STEPS = 30  # of the radius of a 95 % region at most
_NO_POWER = 1e-77  # power of an ordinate without noise


@dataclass(frozen=True)
class LineNoise:
    """Variance (K, C) of equivalent white noise for each line, with `dof` (K,)."""

    variance: FloatArray
    dof: FloatArray


@dataclass(frozen=True)
class _Levels:
    """Noise levels of N shapes from `count` ordinates (K, M, C).

    Attributes
    ----------
    shape : (K, N, M), the shapes at the bins.
    weight, scale : (K, N, C), probability and level of each shape.
    """

    shape: FloatArray
    weight: FloatArray
    scale: FloatArray
    count: int

    @property
    def mean(self) -> FloatArray:
        """Level at the bins, (K, M, C)."""
        return np.asarray(self.shape.swapaxes(1, 2) @ (self.weight * self.scale))


def line_noise(residual: FloatArray, samples: int, line_bin: FloatArray, *, blocks: bool = True) -> LineNoise | None:
    """Return the noise of lines (K,) from the residual (L, C) of their fit.

    `line_bin` are fractional bins. The residual is zero in gaps, and `samples` is the number of samples present.
    Distinct sines between the lines (mains) are not noise. They are subtracted, and their contribution to a line is
    added to its variance. Without `blocks` the noise may be smaller than the scatter between blocks. None where the
    record has too few bins.
    """
    bins = neighbour_bins(len(residual), line_bin)
    if bins is None:
        return None
    # The transposed copy makes every channel's transform contiguous, several times faster for long records.
    transform = np.fft.rfft(np.ascontiguousarray(residual.T), axis=1)
    ordinates = np.moveaxis(transform[:, bins], 0, -1) / np.sqrt(samples)
    return noise_of_ordinates(ordinates, bins.astype(np.float64), line_bin, len(residual), blocks=blocks)


def noise_of_ordinates(
    ordinates: ComplexArray, bins: FloatArray, line_bin: FloatArray, length: int, *, blocks: bool = True
) -> LineNoise:
    """Return the noise of lines (K,) from ordinates (K, M, C), DFT over √samples.

    As `levels_at_lines`, without distinct sines between the lines and without the significant straight-line change of a
    line, which `stationarity` reports. The noise is no smaller than the scatter between blocks of the record, the mean
    of the ordinates nearest to the line, where this is significantly larger. `length` is that of the record.
    """
    rest, steady, leaked = _subtract_tones(ordinates, bins, line_bin, length)
    variance, dof, level = levels_at_lines(np.abs(rest) ** 2, bins, line_bin)
    if blocks:
        distance = np.abs(bins - line_bin[:, None])
        # Near the line a sine may be the line's fluctuation; farther off it is another line.
        near = np.where((distance < TONE_CLEARANCE + 0.5)[:, :, None], steady, rest)
        nearest = np.argsort(distance, axis=1, kind="stable")[:, :_BLOCK_BINS, None]
        power = np.take_along_axis(np.abs(near) ** 2, nearest, axis=1)
        relative, scatter = np.mean(power / np.take_along_axis(level, nearest, axis=1), axis=1), np.mean(power, axis=1)
        unrest = (relative > _BLOCK_LIMIT) & (scatter > variance)
        variance = np.where(unrest, scatter, variance)
        dof = np.where(unrest, np.minimum(dof, 2.0 * _BLOCK_BINS), dof)
    # All channels of a line are given the same degrees of freedom and keep their 95 % regions.
    common = 1.0 / np.mean(1.0 / dof, axis=1)
    return LineNoise((variance + leaked) * _limit(dof) / _limit(common)[:, None], common)


def neighbour_bins(length: int, line_bin: FloatArray) -> IntArray | None:
    """Return the bins (K, M) that determine the noise of lines (K,).

    The record has `length` samples. They are the nearest to each line, ascending, without those that a fitted line or
    the mean has emptied. None where there are too few.
    """
    # Bin 0 is the offset's and the Nyquist bin of an even length has one quadrature only.
    free = np.ones((length + 1) // 2, dtype=np.bool_)
    free[0] = False
    for j in line_bin[line_bin > OFFSET_BIN]:
        free[math.ceil(j - _CLEARANCE) : math.ceil(j + _CLEARANCE)] = False
    candidates = np.flatnonzero(free)
    if len(candidates) < _MIN_NEIGHBOURS:
        return None
    count = min(_NEIGHBOURS, len(candidates))
    nearest = []
    for j in line_bin:
        low = max(0, min(int(np.searchsorted(candidates, j)) - count, len(candidates) - 2 * count))
        window = candidates[low : low + 2 * count]
        nearest.append(np.sort(window[np.argsort(np.abs(window - j), kind="stable")[:count]]))
    return np.stack(nearest)


def levels_at_lines(
    power: FloatArray, bins: FloatArray, line_bin: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return noise variance, degrees of freedom (K, C) and level (K, M, C) of lines.

    `power` (K, M, C) is |DFT|² over the number of samples, with the mean σ² for white noise, at bins (K, M) near each
    line at fractional bins (K,). Each is its level S(j) = s·h(j) times a standard exponential variable (Whittle's
    likelihood); shapes h are white, 1/f, 1/f² and 1/f³ above white noise with various corners. With the prior 1/s a
    shape has the weight Π 1/h(j)·Q^-M, Q = Σ I(j)/h(j), and s has the inverse gamma distribution (M, Q).

    The noise of the line, s·h(line), is distributed as their mixture, which gives its degrees of freedom and the
    variance with the same 95 % region. A position up to half a bin is that of the offset.
    """
    # The power that the fit of the lines has removed is restored; numbers of any size become moderate ones.
    top = np.maximum(power.max(axis=1, keepdims=True), _NO_POWER)
    distance = bins[None, :, :] - line_bin[line_bin > OFFSET_BIN][:, None, None]
    lost = np.minimum(np.sum(np.sinc(distance) ** 2, axis=0), 0.8)
    relative = np.maximum(power / top, 1e-30) / (1.0 - lost)[:, :, None]
    levels = _fit_levels(relative, _shapes(bins))
    at_line = _shapes(np.maximum(line_bin, OFFSET_BIN)[:, None])[:, :, 0]
    variance, dof = _mixture(levels, at_line)
    return variance * top[:, 0], dof, levels.mean * top


def _shapes(bins: FloatArray) -> FloatArray:
    """Return the noise shapes (K, N, M) at bins (K, M), white noise first."""
    position = bins[:, None, :]
    coloured = [1.0 + (corner[:, None] / position) ** exponent for exponent, corner in _CORNERS.items()]
    return np.concatenate([np.ones_like(position), *coloured], axis=1)


def _fit_levels(power: FloatArray, shape: FloatArray) -> _Levels:
    """Return weight and scale of each shape given ordinates (K, M, C)."""
    count = power.shape[1]
    total = (1.0 / shape) @ power
    log_weight = np.log(_PRIOR)[:, None] - np.log(shape).sum(axis=2, keepdims=True) - count * np.log(total)
    weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    return _Levels(shape, weight / weight.sum(axis=1, keepdims=True), total / count, count)


def _mixture(levels: _Levels, at_line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return variance and degrees of freedom (K, C) of mixed levels.

    `at_line` (K, N) are the shapes there. |error|²/2 over the level is a standard exponential variable, so that
    P(|error|²/2 > r) = Σ w (1 + r/(h·Q))^-M. The degrees of freedom are those of the scaled inverse χ² distribution
    with the same variance of the logarithm.
    """
    count = levels.count
    total = at_line[:, :, None] * levels.scale * count
    logs = np.log(total)
    mean = np.sum(levels.weight * logs, axis=1, keepdims=True)
    spread = np.sum(levels.weight * (logs - mean) ** 2, axis=1) + _trigamma(np.asarray(float(count)))
    half = 1.0 / spread + 0.5  # ψ'(dof/2) = spread, dof at least 2
    for _ in range(6):
        half = np.maximum(
            half + (_trigamma(half) - spread) / (1.0 / half**2 + 1.0 / half**3 + 1.0 / (2.0 * half**4)), 1.0
        )
    dof = 2.0 * half
    log_radius = np.log(3.0 / count) + mean[:, 0]
    for _ in range(_NEWTON_STEPS):
        ratio = np.exp(log_radius)[:, None] / total
        tails = levels.weight * (1.0 + ratio) ** -count
        tail = tails.sum(axis=1)
        slope = -np.sum(tails * count * ratio / (1.0 + ratio), axis=1) / tail
        step = np.log(tail / 0.05) / slope
        log_radius -= np.clip(step, -1.0, 1.0)
        if np.max(np.abs(step)) < 1e-6:
            break
    return np.exp(log_radius) / _limit(dof), dof


def _limit(dof: FloatArray) -> FloatArray:
    """Return the 95 % point of Fisher's distribution with 2 and `dof` degrees of freedom."""
    return np.asarray(dof / 2.0 * (0.05 ** (-2.0 / dof) - 1.0))


def _trigamma(x: FloatArray) -> FloatArray:
    """Return ψ'(x) for x ≥ 1 within 2 % (Abramowitz and Stegun, 6.4.12)."""
    return np.asarray(1.0 / x + 1.0 / (2.0 * x**2) + 1.0 / (6.0 * x**3))
