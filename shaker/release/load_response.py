"""Responses of poles to a release, in blocks of samples, with derivatives.

The load changes from 0 to `amplitude` from the onset, within the length T: at once ("step"), linearly ("ramp"), along
half a cosine ("smooth"), or as a force channel shows ("measured"). With τ from the onset and σ from the end of the
release, a pole responds by (F·exp(pσ) - 1)/p after it. F = (exp(x) - 1)/x for a ramp and ½π²(1 + exp(x))/(x² + π²) for
half a cosine, x = pT. The mean of the samples of a block multiplies exp(pσ) by a constant.

An "exponential" load 1 - exp(qτ) is a step behind a lag, q = -2/T: its mean delay is T/2, as for the others.
With the responses S to a step it is q(S_q - S_p)/(p - q). A load in "stages" is two ramps of equal length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from shaker.lti.system import even_exponentials
from shaker.release.record import ReleaseShape
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, IntArray, check_shape

_SMALL = 1e-2  # |x| below which factors are computed from their series
_SERIES = 64  # number of equally spaced times above which exponentials are products of two short series
_EVEN = 1e-9  # deviation of equally spaced times, in intervals
_CONFLUENT = (1e-4, 1e-6)  # distances of two poles, relative, below which slopes replace their quotient; the smallest
_RESTS = 40  # number of blocks before the release
MOMENTS: dict[ReleaseShape, float] = {
    "step": 0.0,
    "ramp": 1.0 / 12.0,
    "smooth": 0.25 - 2.0 / np.pi**2,
    "exponential": 0.25,
}
"""Second moment of a release about its middle over its squared length; 1/a² of a lag adds to it."""
BLOCKS_PER_PERIOD = 12  # blocks per period of the fastest mode: the mean of a block is 1 % lower, sinc(1/12)


@dataclass(frozen=True, repr=False)
class BlockMeans(Arrays):
    """Means `value` (B, …) over blocks of `length` (B,) neighbouring samples, `step_s` apart.

    The first sample of a block is at `time_s` (B,). White noise stays white, and the response of a pole stays an
    exponential: no filter has to be modelled.
    """

    time_s: FloatArray
    length: IntArray
    value: FloatArray
    step_s: float

    def __post_init__(self) -> None:
        check_shape("time_s", self.time_s, (None,))
        check_shape("length", self.length, self.time_s.shape)
        check_shape("value", self.value, (*self.time_s.shape, *self.value.shape[1:]))

    @cached_property
    def runs(self) -> tuple[slice, ...]:
        """Slices of blocks of equal length."""
        edges = [0, *(np.flatnonzero(np.diff(self.length)) + 1).tolist(), len(self.length)]
        return tuple(slice(first, stop) for first, stop in pairwise(edges))

    @cached_property
    def weight(self) -> FloatArray:
        """Reciprocal standard deviation (B,) of a mean over that of a sample: √length."""
        return np.sqrt(self.length.astype(np.float64))

    def between(self, from_s: float, to_s: float) -> BlockMeans:
        """Return the blocks that start between two times."""
        selected = (self.time_s >= from_s) & (self.time_s <= to_s)
        return BlockMeans(self.time_s[selected], self.length[selected], self.value[selected], self.step_s)


def every_sample(value: FloatArray, time_s: FloatArray, step_s: float) -> BlockMeans:
    """Return samples (N, …) at times (N,) as blocks of one."""
    return BlockMeans(time_s, np.ones(len(time_s), dtype=np.int64), value, step_s)


def reduce_to_blocks(whole: BlockMeans, fine_from_s: float, fine_to_s: float, length: int) -> BlockMeans:
    """Return single samples between two times, blocks of `length` after them, long ones before."""

    def edges(start: int, stop: int, size: int) -> IntArray:
        """Return the starts of blocks of a size; the remainder is the first block."""
        if stop <= start:
            return np.zeros(0, dtype=np.int64)
        starts = np.arange(stop - size, start, -size, dtype=np.int64)[::-1]
        return np.concatenate([np.array([start], dtype=np.int64), starts[starts > start]])

    first, last = (int(index) for index in np.searchsorted(whole.time_s, [fine_from_s, fine_to_s]))
    parts = (edges(0, first, max(1, first // _RESTS)), np.arange(first, last), edges(last, len(whole.value), length))
    begins = np.concatenate([*parts, [len(whole.value)]]).astype(np.int64)
    lengths = np.diff(begins)
    means = np.add.reduceat(whole.value, begins[:-1]) / lengths
    return BlockMeans(whole.time_s[begins[:-1]], lengths, means, whole.step_s)


def block_length(sample_rate_hz: float, highest_hz: float) -> int:
    """Return the samples per block after the release, twelve blocks per fastest period."""
    return max(1, int(sample_rate_hz / (BLOCKS_PER_PERIOD * highest_hz)))


def average_blocks(samples: FloatArray, size: int) -> FloatArray:
    """Return means (…, A) over whole blocks of `size` samples (…, N)."""
    count = samples.shape[-1] // size
    return np.asarray(samples[..., : count * size].reshape(*samples.shape[:-1], count, size).mean(axis=-1))


@dataclass(frozen=True, repr=False)
class ReleaseLoad(Arrays):
    """Time course of a load: by `amplitude` in a `shape`, or measured.

    `force` (N,) from `start_s` for "measured": linear between its samples, with the level at rest subtracted.
    """

    shape: ReleaseShape
    amplitude: float
    force: FloatArray | None = None
    start_s: float = 0.0

    @property
    def timed(self) -> bool:
        """Whether the onset is unknown."""
        return self.shape != "measured"

    @property
    def lasting(self) -> bool:
        """Whether the release has an unknown duration."""
        return self.shape in ("ramp", "smooth", "exponential", "stages")


class Stages(NamedTuple):
    """A release in two ramps: share of the first, length of each."""

    share: float = 0.5
    part_s: float = 0.0


def load_share(shape: ReleaseShape, time_s: FloatArray, onset_s: float, release_s: float) -> FloatArray:
    """Return the share (N,) of the load's change at `time_s` (N,).

    With x = (t - onset)/T from 0 to 1: x for a "ramp", (1 - cos πx)/2 for a "smooth" release. 1 - exp(-2x) for an
    "exponential" one.
    """
    tau = np.asarray(time_s, dtype=np.float64) - onset_s
    if release_s <= 0.0 or shape == "step":
        return np.asarray((tau > 0).astype(np.float64))
    if shape == "exponential":
        return np.asarray(-np.expm1(-2.0 * np.maximum(tau, 0.0) / release_s))
    x = np.clip(tau / release_s, 0.0, 1.0)
    return np.asarray(x if shape == "ramp" else 0.5 * (1.0 - np.cos(np.pi * x)))


def load_rate(shape: ReleaseShape, time_s: FloatArray, onset_s: float, release_s: float) -> FloatArray:
    """Return the derivative (N,) of `load_share` in 1/s, 0 for a step."""
    tau = np.asarray(time_s, dtype=np.float64) - onset_s
    if release_s <= 0.0 or shape == "step":
        return np.zeros(len(tau))
    if shape == "exponential":
        return np.asarray(np.where(tau > 0, np.exp(-2.0 * np.maximum(tau, 0.0) / release_s), 0.0) * 2.0 / release_s)
    during = (tau > 0) & (tau < release_s)
    rate = 1.0 if shape == "ramp" else 0.5 * np.pi * np.sin(np.pi * tau / release_s)
    return np.asarray(np.where(during, rate, 0.0) / release_s)


def pole_responses(
    poles: ComplexArray, time_s: FloatArray, onset_s: float, release_s: float, shape: ReleaseShape = "ramp"
) -> ComplexArray:
    """Return responses (N, P) of 1/(s - p) to a load from 0 to 1."""
    if release_s < 0:
        raise ValueError(f"release_s: expected 0 or more, found {release_s}")
    if shape not in ("step", "ramp", "smooth"):
        raise ValueError(f'shape: expected "step", "ramp" or "smooth", found "{shape}"')
    p, length = np.asarray(poles, dtype=np.complex128), 0.0 if shape == "step" else release_s
    return np.asarray(_at_times(shape, p, np.asarray(time_s, dtype=np.float64) - onset_s, length, 1)[0].T)


def exponentials(poles: ComplexArray, tau: FloatArray) -> ComplexArray:
    """Return exp(pτ) (P, N) at times (N,), equally spaced ones from `even_exponentials`."""
    count = len(tau)
    p = poles[:, None]
    if count < _SERIES:
        return np.asarray(np.exp(p * tau))
    step = float(tau[-1] - tau[0]) / (count - 1)
    if not np.max(np.abs(tau - (tau[0] + step * np.arange(count)))) <= _EVEN * step:
        return np.asarray(np.exp(p * tau))
    coarse, fine = even_exponentials(poles, float(tau[0]), step, count)
    return np.asarray((coarse[:, :, None] * fine[:, None]).reshape(len(poles), -1)[:, :count])


@dataclass(frozen=True, repr=False)
class BlockResponses(Arrays):
    """Responses (B, P) of 1/(s - p) in blocks, and their derivatives.

    The derivatives are by the onset, the length of the release and the poles. That by the length keeps the middle of
    the release: the onset moves by half the change. For fixed poles `by_pole` is empty (B, 0). `by_stage` (2, B, P): by
    the share of the first stage and by the length of both, empty (0, B, P) for other shapes.
    """

    value: ComplexArray
    by_onset: ComplexArray
    by_length: ComplexArray
    by_pole: ComplexArray
    by_stage: ComplexArray


def responses_with_derivatives(
    load: ReleaseLoad,
    poles: ComplexArray,
    samples: BlockMeans,
    middle_s: float,
    length_s: float,
    fixed_poles: bool = False,
    stages: Stages | None = None,
) -> BlockResponses:
    """Return the responses of poles (P,) in rad/s to a load, with derivatives."""
    if load.shape == "measured":
        return _to_force(load, poles, samples)
    rows, release = 3 if fixed_poles else 4, (middle_s, length_s)
    if load.shape == "stages":
        value, *changes = _staged(load, poles, samples, release, stages or Stages(), rows)
    else:
        value, *changes = _answered(load, poles, samples, release, rows)
    by_stage = np.asarray(changes[rows - 1 :]) if load.shape == "stages" else np.zeros((0, *value.shape), complex)
    return BlockResponses(value, changes[0], changes[1], value[:, :0] if fixed_poles else changes[2], by_stage)


def responses(
    load: ReleaseLoad,
    poles: ComplexArray,
    samples: BlockMeans,
    middle_s: float,
    length_s: float,
    stages: Stages | None = None,
) -> ComplexArray:
    """Return the responses (B, P) only, in half the time."""
    if load.shape == "measured":
        return _to_force(load, poles, samples).value
    if load.shape == "stages":
        return np.asarray(_staged(load, poles, samples, (middle_s, length_s), stages or Stages(), 1)[0])
    return np.asarray(_answered(load, poles, samples, (middle_s, length_s), 1)[0])


def _staged(
    load: ReleaseLoad,
    poles: ComplexArray,
    samples: BlockMeans,
    release: tuple[float, float],
    stages: Stages,
    rows: int,
) -> ComplexArray:
    """Return rows of `BlockResponses` for two ramps, those by `stages` last.

    The length of the release is that of one stage and the distance of their middles. At a fixed length of the stages,
    a change of the whole moves them apart.
    """
    ramp, (middle, length), (share, part) = replace(load, shape="ramp"), release, stages
    apart = 0.5 * (length - part)
    if rows == 1:
        first, last = (_answered(ramp, poles, samples, (middle + by, part), 1) for by in (-apart, apart))
        return np.asarray(share * first + (1.0 - share) * last)
    first, last = (_answered(ramp, poles, samples, (middle + by, part), rows) for by in (-apart, apart))
    whole = share * first + (1.0 - share) * last
    by_part = whole[2].copy()
    whole[2] = 0.5 * ((1.0 - share) * last[1] - share * first[1])
    return np.concatenate([whole, [first[0] - last[0], by_part - whole[2]]])


def _answered(
    load: ReleaseLoad, poles: ComplexArray, samples: BlockMeans, release: tuple[float, float], rows: int
) -> ComplexArray:
    """Return the first R rows of `BlockResponses` (R, B, P), one, three or four."""
    if load.shape == "exponential":
        return _behind_lag(load, poles, samples, release, rows)
    length = release[1] if load.lasting else 0.0
    tau = samples.time_s - (release[0] - 0.5 * length)
    whole = np.zeros((rows, len(poles), len(tau)), dtype=np.complex128)
    first = int(np.searchsorted(tau, length, "left" if length > 0.0 else "right"))
    for run in samples.runs:
        later = slice(max(run.start, first), run.stop)
        if later.start < later.stop:
            means = _means(poles, int(samples.length[later.start]), samples.step_s)
            _after((load.shape, length), poles, tau[later] - length, means, whole[:, :, later])
    touched = slice(int(np.searchsorted(tau + (samples.length - 1) * samples.step_s, 0.0, "right")), first)
    if touched.start < touched.stop:
        size = samples.length[touched]
        ends = np.cumsum(size)
        inside = np.arange(ends[-1]) - np.repeat(ends - size, size)
        single = _at_times(load.shape, poles, np.repeat(tau[touched], size) + inside * samples.step_s, length, rows)
        whole[:, :, touched] = np.add.reduceat(single, ends - size, axis=2) / size
    whole *= load.amplitude
    return whole.transpose(0, 2, 1)


def _behind_lag(
    load: ReleaseLoad, poles: ComplexArray, samples: BlockMeans, release: tuple[float, float], rows: int
) -> ComplexArray:
    """Return the first R rows of `BlockResponses` (R, B, P) for an exponential load.

    A quotient of differences of close poles is replaced by the mean of the slopes at both.
    """
    middle, length = release
    q = -2.0 / length
    if np.any(np.abs(poles - q) < _CONFLUENT[1] * abs(q)):
        q *= 1.0 + 2.0 * _CONFLUENT[1]
    whole = _answered(replace(load, shape="step"), np.append(poles, q), samples, (middle - 0.5 * length, 0.0), 4)
    ours, last = whole[:, :, :-1], whole[:, :, -1:]
    apart = poles - q
    near = np.abs(apart) < _CONFLUENT[0] * abs(q)
    quotient = np.where(near, -0.5 * (ours[3] + last[3]), (last[0] - ours[0]) / apart)
    out = np.zeros((rows, *quotient.shape), dtype=np.complex128)
    out[0] = q * quotient
    if rows > 1:
        out[1] = q * (last[1] - ours[1]) / apart
        by_lag = quotient + q * (last[3] + quotient) / apart
        out[2] = by_lag * q / -length - 0.5 * out[1]
    if rows > 3:
        out[3] = -q * (ours[3] + quotient) / apart
    return out


def release_factor(shape: ReleaseShape, x: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the factor F of a release, ∫ du/dt·exp(p(T - t)) dt, and dF/dx."""
    if shape == "smooth":
        below, grown = x**2 + np.pi**2, np.exp(x)
        value = 0.5 * np.pi**2 * (1.0 + grown) / below
        return value, 0.5 * np.pi**2 * grown / below - 2.0 * x * value / below
    small = np.abs(x) < _SMALL
    safe: ComplexArray = np.where(small, 1.0, x).astype(np.complex128)
    growth = np.expm1(safe)
    value = growth / safe
    slope = (growth + 1.0 - value) / safe
    if np.any(small):
        value = np.where(small, 1 + x / 2 + x**2 / 6 + x**3 / 24 + x**4 / 120, value)
        slope = np.where(small, 0.5 + x / 3 + x**2 / 8 + x**3 / 30 + x**4 / 144, slope)
    return value, slope


def _after(
    load: tuple[ReleaseShape, float],
    p: ComplexArray,
    sigma: FloatArray,
    means: tuple[ComplexArray, ComplexArray],
    out: ComplexArray,
) -> None:
    """Write the responses (R, P, B) of blocks after the release to `out`.

    `sigma` (B,): first sample of each block after the end of the release. `means` (P,): of exp(pt) over a block, and
    its derivative by p.
    """
    (mean, mean_slope), (shape, length) = means, load
    factor, slope = release_factor(shape, p * length) if length > 0 else (np.ones_like(p), np.full_like(p, 0.5))
    swing, per_pole = exponentials(p, sigma), (1.0 / p)[:, None]
    decay = swing * (mean * factor)[:, None]
    np.multiply(decay - 1.0, per_pole, out=out[0])
    if len(out) > 1:
        np.negative(decay, out=out[1])
        np.multiply(swing, (mean * (slope - 0.5 * factor))[:, None], out=out[2])
    if len(out) > 3:
        change = swing * (mean_slope * factor + mean * length * slope)[:, None] + decay * sigma
        np.multiply(change - out[0], per_pole, out=out[3])


def _at_times(shape: ReleaseShape, p: ComplexArray, tau: FloatArray, length: float, rows: int) -> ComplexArray:
    """Return the responses (R, P, B) of single samples at `tau` (B,), sorted or not."""
    whole = np.zeros((rows, len(p), len(tau)), dtype=np.complex128)
    if np.any(tau[1:] < tau[:-1]):
        order = np.argsort(tau)
        whole[:, :, order] = _at_times(shape, p, tau[order], length, rows)
        return whole
    start = int(np.searchsorted(tau, 0.0, "right"))
    stop = max(start, int(np.searchsorted(tau, length)))
    if stop < len(tau):
        _after((shape, length), p, tau[stop:] - length, _means(p, 1, 0.0), whole[:, :, stop:])
    if start < stop:
        early, p = tau[start:stop], p[:, None]
        share, value, by_pole = (_along_line if shape == "ramp" else _along_cosine)(p, early, length)
        during = whole[:, :, start:stop]
        during[0] = value
        if rows > 1:
            by_onset = -(p * value + share)
            # the response is T·f(τ/T, pT): the derivative by the length follows from those by time and pole
            by_length = (value + early * by_onset + p * by_pole) / length - 0.5 * by_onset
            during[1:] = (by_onset, by_length, by_pole)[: rows - 1]
    return whole


def _along_line(p: ComplexArray, tau: FloatArray, length: float) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return a ramp's load, its response [(exp(pτ) - 1)/p - τ]/(pT), the derivative by p."""
    grown = np.expm1(p * tau)
    rise = grown / p
    value = (rise - tau) / (p * length)
    slope = (tau * (grown + 1.0) - rise) / p
    return tau / length, value, slope / (p * length) - value / p


def _along_cosine(p: ComplexArray, tau: FloatArray, length: float) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return half a cosine's load, its response and the derivative by the pole.

    With ω = π/T the response is [(exp(pτ) - 1)/p - (p(exp(pτ) - cos ωτ) + ω sin ωτ)/(p² + ω²)]/2.
    """
    omega = np.pi / length
    swing, cosine, sine = np.exp(p * tau), np.cos(omega * tau), np.sin(omega * tau)
    below, top = p**2 + omega**2, p * (swing - cosine) + omega * sine
    value = 0.5 * (np.expm1(p * tau) / p - top / below)
    slope = tau * swing / p - np.expm1(p * tau) / p**2 - (swing - cosine + p * tau * swing) / below
    return 0.5 * (1.0 - cosine), value, 0.5 * (slope + 2 * p * top / below**2)


def _means(p: ComplexArray, size: int, step_s: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the mean of exp(pt) (P,) over `size` samples from 0, with derivative."""
    if size == 1:
        return np.ones_like(p), np.zeros_like(p)
    k = np.arange(size)[:, None]
    powers = np.exp(k * (p * step_s))
    return powers.mean(axis=0), (k * powers).mean(axis=0) * step_s


def _to_force(load: ReleaseLoad, poles: ComplexArray, samples: BlockMeans) -> BlockResponses:
    """Return the responses to a measured force, exact if it is linear between samples."""
    from scipy.signal import lfilter

    assert load.force is not None
    force, step = load.force, samples.step_s
    first = np.round((samples.time_s - load.start_s) / step).astype(int)
    value, slope = np.zeros((2, len(force), len(poles)), dtype=np.complex128)
    for column, p in enumerate(poles):
        fall, now, next_ = _linear_weights(p, step)
        value[:, column] = lfilter([next_[0], now[0]], [1.0, -fall], force)
        moved = lfilter([0.0, step * fall], [1.0, -fall], value[:, column])
        slope[:, column] = moved + lfilter([next_[1], now[1]], [1.0, -fall], force)
    start = -force[0] * np.array([_linear_weights(p, step)[2] for p in poles])
    decay = np.exp(np.arange(len(force))[:, None] * step * poles)
    value += start[:, 0] * decay
    slope += (start[:, 1] + start[:, 0] * np.arange(len(force))[:, None] * step) * decay
    if np.any(samples.length > 1):
        none = np.zeros((1, len(poles)), dtype=np.complex128)
        sums = (np.concatenate([none, np.cumsum(part, axis=0)]) for part in (value, slope))
        value, slope = ((part[first + samples.length] - part[first]) / samples.length[:, None] for part in sums)
    else:
        value, slope = value[first], slope[first]
    blank = np.zeros_like(value)
    return BlockResponses(value, blank, blank, slope, np.zeros((0, *value.shape), complex))


def _linear_weights(p: complex, step: float) -> tuple[complex, FloatArray, FloatArray]:
    """Return exp(pΔ) and the weights of two samples for a straight line, with derivatives."""
    x = p * step
    if abs(x) < _SMALL:
        now = 0.5 + x / 3 + x**2 / 8 + x**3 / 30 + x**4 / 144
        next_ = 0.5 + x / 6 + x**2 / 24 + x**3 / 120 + x**4 / 720
        slopes = 1 / 3 + x / 4 + x**2 / 10 + x**3 / 36, 1 / 6 + x / 12 + x**2 / 40 + x**3 / 180
        return np.exp(x), step * np.array([now, slopes[0] * step]), step * np.array([next_, slopes[1] * step])
    fall = np.exp(x)
    now = (fall * (x - 1) + 1) / x**2
    next_ = (fall - 1 - x) / x**2
    slopes = fall / x - 2 * now / x, (fall - 1) / x**2 - 2 * next_ / x
    return fall, step * np.array([now, slopes[0] * step]), step * np.array([next_, slopes[1] * step])
