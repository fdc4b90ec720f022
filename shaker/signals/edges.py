"""Trigger edges in a sampled signal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape

EdgeKind = Literal["sampled", "resolved"]

_HYSTERESIS = 0.1  # of the distance from the threshold to the nearer level
_ON_RISE = 0.12  # of the step: samples beside the crossings further than this from their level lie on the rise
_HALF_WIDTH = 24  # samples of the interpolation kernel on each side
_KAISER = 8.0


@dataclass(frozen=True)
class Edges:
    """Edges of a trigger signal, in seconds from the record's first sample.

    Each crossing lies in (`lower_s`, `upper_s`] (E,), between the last sample below the level and the first at or above
    it. `estimate_s` (E,): without the half-sample bias, the middle where no sample lies on the rise (`kind` "sampled"),
    the crossing of the reconstructed signal where the rise is "resolved"; `u_reading_s` is then what the noise of the
    samples does to it. `record_s` is the record's length, `threshold` the level used.
    """

    lower_s: FloatArray
    upper_s: FloatArray
    estimate_s: FloatArray
    kind: EdgeKind
    u_reading_s: float
    record_s: float
    threshold: float

    def __post_init__(self) -> None:
        check_shape("lower_s", self.lower_s, (None,))
        check_shape("upper_s", self.upper_s, self.lower_s.shape)
        check_shape("estimate_s", self.estimate_s, self.lower_s.shape)


def find_edges(
    samples: FloatArray,
    sample_rate_hz: float,
    threshold: float | None = None,
    edge: Literal["rising", "falling"] = "rising",
) -> Edges:
    """Find where samples (S,) cross `threshold` in the sense of `edge`.

    Default threshold: midway between the 5 % and 95 % quantiles; where these do not span the signal (pulses shorter
    than 5 % of the record), midway between the smallest and largest sample. A hysteresis of 10 % of the step keeps
    noise from counting twice. Where most edges have a sample on the rise, the crossing is that of the signal
    reconstructed by a Kaiser-windowed sinc: exact for a band-limited input, and a start for `shaker.signals.rise`
    where the rise is another.
    """
    check_shape("samples", samples, (None,))
    if not np.all(np.isfinite(samples)):
        raise ValueError(f"samples: expected numbers, found {int(np.sum(~np.isfinite(samples)))} NaN or infinite")
    if edge not in ("rising", "falling"):
        raise ValueError(f'edge: expected "rising" or "falling", found "{edge}"')
    sign = 1.0 if edge == "rising" else -1.0
    signal = sign * samples
    low, high = _levels(signal)
    level = (low + high) / 2.0 if threshold is None else sign * threshold
    lowest, highest = float(signal.min()), float(signal.max())
    if not low < level < high and abs(level - (lowest + highest) / 2.0) < 0.4 * (highest - lowest):
        low, high = lowest, highest  # a quantile lies on the rise
    if not low < level < high:
        raise ValueError(
            f"threshold: expected a level that the signal crosses, found {sign * level:.6g} while the "
            f"signal stays between {samples.min():.6g} and {samples.max():.6g}"
        )
    after = _crossings(signal, level, _HYSTERESIS * min(level - low, high - level))
    step = 1.0 / sample_rate_hz
    upper = np.asarray(step * after, dtype=np.float64)
    if len(after) and _on_rise(signal, after, level):
        crossing, noise = _reconstructed(signal, after, level)
        return Edges(upper - step, upper, step * crossing, "resolved", step * noise, step * len(samples), sign * level)
    return Edges(upper - step, upper, upper - step / 2.0, "sampled", 0.0, step * len(samples), sign * level)


def _levels(signal: FloatArray) -> tuple[float, float]:
    """Return the low and the high level of a trigger signal."""
    low, high = np.quantile(signal, [0.05, 0.95])
    lowest, highest = float(signal.min()), float(signal.max())
    noise = float(np.median(np.abs(np.diff(signal)))) / 0.954 if len(signal) > 1 else 0.0
    if high - low > max(8.0 * noise, 0.05 * (highest - lowest)):
        return float(low), float(high)
    return lowest, highest


def _crossings(signal: FloatArray, level: float, hysteresis: float) -> IntArray:
    """Return the index of the first sample at or above `level` of each rise through the hysteresis band."""
    low = np.flatnonzero(signal <= level - hysteresis)
    high = np.flatnonzero(signal >= level + hysteresis)
    if not len(low) or not len(high):
        return np.zeros(0, dtype=np.int64)
    # A rise begins at the last low sample before a high one that follows it without another low between.
    next_high = np.searchsorted(high, low)
    has_high = next_high < len(high)
    low, target = low[has_high], high[next_high[has_high]]
    last_low = low[np.append(target[1:] != target[:-1], True)] if len(low) else low
    crossing = np.flatnonzero((signal[:-1] < level) & (signal[1:] >= level)) + 1
    return np.asarray(crossing[np.searchsorted(crossing, last_low, side="right")], dtype=np.int64)


def _on_rise(signal: FloatArray, after: IntArray, level: float) -> bool:
    """Tell whether samples beside the crossings lie between the levels: a resolved, band-limited rise."""
    low, high = float(np.median(signal[signal < level])), float(np.median(signal[signal >= level]))
    before_off = (signal[after - 1] - low) / (high - low)
    after_off = (high - signal[after]) / (high - low)
    return bool(np.median(np.maximum(before_off, after_off)) > _ON_RISE)


def _reconstructed(signal: FloatArray, after: IntArray, level: float) -> tuple[FloatArray, float]:
    """Return the crossings of the band-limited signal between sample after-1 and after, and their noise, in samples."""
    tap = np.arange(-_HALF_WIDTH, _HALF_WIDTH)
    index = np.clip(after[:, None] + tap, 0, len(signal) - 1)
    local = signal[index] - level
    low, high = np.full(len(after), -1.0), np.zeros(len(after))
    for _ in range(40):
        middle = (low + high) / 2.0
        above = _interpolate(local, tap, middle) >= 0.0
        high, low = np.where(above, middle, high), np.where(above, low, middle)
    estimate = (low + high) / 2.0
    slope = (_interpolate(local, tap, estimate + 0.05) - _interpolate(local, tap, estimate - 0.05)) / 0.1
    # Noise of single samples, seen in second differences where the signal is at rest, divided by the slope.
    noise = float(np.median(np.abs(np.diff(signal, 2)))) / (0.6745 * np.sqrt(6.0))
    return after + estimate, noise / float(np.median(np.abs(slope)))


def _interpolate(local: FloatArray, tap: IntArray, place: FloatArray) -> FloatArray:
    """Return the signal at fractional places from its neighbours by a Kaiser-windowed sinc, (E,)."""
    distance = place[:, None] - tap
    inside = np.clip(1.0 - (distance / _HALF_WIDTH) ** 2, 0.0, None)
    kernel = np.sinc(distance) * np.i0(_KAISER * np.sqrt(inside)) / np.i0(_KAISER)
    return np.asarray(np.sum(local * kernel, axis=1) / np.sum(kernel, axis=1))
