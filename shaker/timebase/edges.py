"""Edges in sampled signals, numbers of a periodic trigger's edges, and resampling."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape

EdgeKind = Literal["sampled", "resolved"]

_HYSTERESIS = 0.1  # of the distance from the threshold to the nearer level
_ON_RISE = 0.12  # of the step: samples next to a crossing further than this from their level lie on the rise
_SHORT_PAUSE = 0.25  # of the usual pause between pulses: after a shorter one, a pulse is a bounce of the one before
_EQUAL_PAUSE, _USUAL = 0.1, 0.45  # how much equal pauses may differ; pauses over the commonest ones that are usual
_BOUNCES = 0.2  # of all edges from which on bounces are no single strays
_HALF_WIDTH = 24  # samples of the interpolation kernel on each side
_KAISER = 8.0  # parameter of the Kaiser window: side lobes below -80 dB


@dataclass(frozen=True)
class Edges(Arrays, shapes="lower_s E; upper_s E; estimate_s E"):
    """Edges of a trigger signal, in seconds from the record's first sample.

    Attributes
    ----------
    lower_s, upper_s : (E,), last sample below the level, and first at or above it, in s.
    estimate_s : (E,), the middle of both, or the crossing of the reconstructed signal.
    kind : "sampled" where no sample lies on the rise, "resolved" where the crossing is reconstructed.
    u_reading_s : effect of the samples' noise on a resolved crossing.
    record_s : length of the record in s.
    threshold : level used.
    bounces : edges left out because their pulses begin right after others end.
    """

    lower_s: FloatArray
    upper_s: FloatArray
    estimate_s: FloatArray
    kind: EdgeKind
    u_reading_s: float
    record_s: float
    threshold: float
    bounces: int = 0

    def __repr__(self) -> str:
        return f"Edges({len(self.lower_s)} in {self.record_s:g} s, {self.kind}, at threshold {self.threshold:g})"


def find_edges(
    samples: FloatArray,
    sample_rate_hz: float,
    threshold: float | None = None,
    edge: Literal["rising", "falling"] = "rising",
) -> Edges:
    """Find the crossings of a threshold in a sampled signal.

    Parameters
    ----------
    samples
        (S,), finite samples.
    sample_rate_hz
        Sampling rate in Hz.
    threshold
        Level; default midway between the 5 % and 95 % quantiles, or between the smallest and largest sample where
        pulses are shorter than 5 % of the record.
    edge
        "rising" (default) or "falling".

    Returns
    -------
    The edges with their intervals and estimates.

    Raises
    ------
    ValueError
        Samples are not finite, or the signal does not cross the threshold.

    Notes
    -----
    A hysteresis of 10 % of the step prevents noise from counting twice. Where most edges have a sample on the rise, the
    crossing is that of the signal reconstructed by a Kaiser-windowed sinc. It is exact for a band-limited input, and a
    start for `shaker.timebase.trigger` for other rises. Where pulses regularly occur twice or more, as from a bouncing
    contact, the first edge of each counts.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import find_edges
    >>> pulses = (np.arange(2000) % 200 >= 190).astype(float)
    >>> find_edges(pulses, sample_rate_hz=10e3)
    Edges(10 in 0.2 s, sampled, at threshold 0.5)
    """
    check_shape("samples", samples, (None,))
    if not np.all(np.isfinite(samples)):
        raise ValueError(f"samples: expected numbers, found {int(np.sum(~np.isfinite(samples)))} NaN or infinite")
    if edge not in ("rising", "falling"):
        raise ValueError(f'edge: expected "rising" or "falling", found "{edge}"')
    sign = 1.0 if edge == "rising" else -1.0
    signal = sign * samples
    low, high = (float(q) for q in np.quantile(signal, [0.05, 0.95]))
    lowest, highest = float(signal.min()), float(signal.max())
    noise = float(np.median(np.abs(np.diff(signal)))) / 0.954 if len(signal) > 1 else 0.0
    if not high - low > max(8.0 * noise, 0.05 * (highest - lowest)):
        low, high = lowest, highest
    level = (low + high) / 2.0 if threshold is None else sign * threshold
    if not low < level < high and abs(level - (lowest + highest) / 2.0) < 0.4 * (highest - lowest):
        low, high = lowest, highest  # a quantile lies on the rise
    if not low < level < high:
        raise ValueError(
            f"threshold: expected a level that the signal crosses, found {sign * level:.6g} while the "
            f"signal stays between {samples.min():.6g} and {samples.max():.6g}"
        )
    hysteresis = _HYSTERESIS * min(level - low, high - level)
    every = _crossings(signal, level, hysteresis)
    after = _without_bounces(every, _crossings(-signal, -level, hysteresis))
    bounces = len(every) - len(after)
    step = 1.0 / sample_rate_hz
    upper = np.asarray(step * after, dtype=np.float64)
    length_s = step * len(samples)
    edges = Edges(upper - step, upper, upper - step / 2.0, "sampled", 0.0, length_s, sign * level, bounces)
    rest, pulse = np.median(signal[signal < level]), np.median(signal[signal >= level])
    off = np.maximum(signal[after - 1] - rest, pulse - signal[after]) / (pulse - rest)
    if len(after) and np.median(off) > _ON_RISE:  # samples on the rise: it is resolved, and band-limited
        crossing, noise = _reconstruct_crossings(signal, after, level)
        return replace(edges, estimate_s=step * crossing, kind="resolved", u_reading_s=step * noise)
    return edges


def _crossings(signal: FloatArray, level: float, hysteresis: float) -> IntArray:
    """Return the first sample at or above `level` of each rise through the hysteresis band."""
    outside = np.flatnonzero(np.abs(signal - level) >= hysteresis)
    high = signal[outside] > level
    # A rise begins at the last low sample before a high one.
    last_low = outside[:-1][~high[:-1] & high[1:]]
    crossing = np.flatnonzero((signal[:-1] < level) & (signal[1:] >= level)) + 1
    return np.asarray(crossing[np.searchsorted(crossing, last_low, side="right")], dtype=np.int64)


def _without_bounces(rises: IntArray, falls: IntArray) -> IntArray:
    """Return the rises (E,) without those right after a fall, where such bounces are regular.

    The usual pause is the longest common one: of pulses that occur twice, that between the pairs.
    """
    last = np.searchsorted(falls, rises) - 1
    pause = np.full(len(rises), np.inf)
    pause[last >= 0] = rises[last >= 0] - falls[last[last >= 0]]
    finite = np.sort(pause[np.isfinite(pause)])
    if len(finite) < 3:
        return rises
    like = np.searchsorted(finite, finite * (1.0 + _EQUAL_PAUSE)) - np.searchsorted(
        finite, finite * (1.0 - _EQUAL_PAUSE)
    )
    usual = float(np.max(finite[like >= _USUAL * like.max()]))
    bounce = pause < _SHORT_PAUSE * usual
    return rises[~bounce] if np.count_nonzero(bounce) >= _BOUNCES * len(rises) else rises


def _reconstruct_crossings(signal: FloatArray, after: IntArray, level: float) -> tuple[FloatArray, float]:
    """Return the band-limited crossings between sample after-1 and after, and their noise, in samples."""
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


def _interpolate(local: FloatArray, tap: IntArray, position: FloatArray) -> FloatArray:
    """Return the signal at fractional positions (E,) by a Kaiser-windowed sinc."""
    distance = position[:, None] - tap
    inside = np.clip(1.0 - (distance / _HALF_WIDTH) ** 2, 0.0, None)
    kernel = np.sinc(distance) * np.i0(_KAISER * np.sqrt(inside)) / np.i0(_KAISER)
    return np.asarray(np.sum(local * kernel, axis=1) / np.sum(kernel, axis=1))


# Numbers of the edges of a periodic trigger: which edge is which period, and which are none.

_ALTERNATING, _MOSTLY = 0.1, 0.8  # of two distances by which they alternate; of all that do
_CAPTURE = 0.2  # of a period: an edge further from its expected time is spurious


@dataclass(frozen=True)
class Numbering(Arrays, shapes="number E; accepted E"):
    """Number of every edge (E,), accepted edges (E,), and how many are rejected."""

    number: IntArray
    accepted: BoolArray
    doubled: int
    spurious: int


def number_edges(edges: Edges) -> Numbering:
    """Number the edges by the period that most of them share.

    Of several edges near one expected time the nearest is accepted, and the others are doubled. Edges far from every
    expected time are spurious.
    """
    time = edges.estimate_s
    if len(time) < 3:
        raise ValueError(f"edges: expected at least 3 edges, found {len(time)}")
    _check_no_alternation(np.diff(time))
    period = _period(time, edges.upper_s - edges.lower_s)
    start = period * np.angle(np.mean(np.exp(2j * np.pi * time / period))) / (2.0 * np.pi)
    # The first line is drawn aside by doubled edges; one through the edges that agree with each other is not.
    for _ in range(3):
        position = (time - start) / period
        number = np.round(position).astype(np.int64)
        distance = np.abs(position - number)
        accepted = distance <= _CAPTURE
        # Of several edges with one number the nearest to the expected time is accepted.
        order = np.lexsort((distance, number))
        accepted[order[1:][np.diff(number[order]) == 0]] = False
        accepted = _without_outliers(number, edges, accepted)
        count = int(np.count_nonzero(accepted))
        if count < 3 or 2 * count < len(time):
            raise ValueError(
                f"edges: expected at least 3 edges of one period and half of all, found {count} of {len(time)}"
            )
        period, start = np.polyfit(number[accepted], time[accepted], 1)
    near = np.abs((time - start) / period - number) <= _CAPTURE
    doubled = int(np.count_nonzero(~accepted & near & np.isin(number, number[accepted])))
    return Numbering(number, accepted, doubled, int(np.count_nonzero(~accepted)) - doubled)


def _check_no_alternation(gap: FloatArray) -> None:
    """Refuse edges whose distances alternate between two values, since their period is ambiguous."""
    if len(gap) < 4:
        return
    pair, difference = gap[1:] + gap[:-1], np.abs(gap[1:] - gap[:-1])
    both = float(np.median(pair))
    alternate = (np.abs(pair - both) < 0.5 * _ALTERNATING * both) & (difference > _ALTERNATING * both)
    short, long = (float(np.median(part)) for part in np.array_split(np.sort(gap), 2))
    if np.mean(alternate) > _MOSTLY:
        raise ValueError(
            f"edges: expected equal distances, found distances that alternate between {short:.6g} s and {long:.6g} s: "
            f"every pulse twice, every third one lost, or two triggers on one line"
        )


def _period(time: FloatArray, width: FloatArray) -> float:
    """Return the period with the largest Rayleigh statistic |Σ exp(2πi t/p)| near the commonest gap."""
    gap = np.diff(time)
    tolerance = max(0.02, 1.5 * float(np.median(width)) / float(np.median(gap)))
    ordered = np.sort(gap)
    like = np.searchsorted(ordered, gap * (1.0 + tolerance)) - np.searchsorted(ordered, gap * (1.0 - tolerance))
    best = float(np.max(gap[like >= 0.8 * like.max()]))
    typical = float(np.median(gap[np.abs(gap - best) <= tolerance * best]))
    span = float(time[-1] - time[0])
    count = 2 * int(np.ceil(8.0 * tolerance * span / typical)) + 1
    rate = np.linspace(1.0 - tolerance, 1.0 + tolerance, count) / typical
    coherence = [float(np.abs(np.sum(np.exp(2j * np.pi * f * time)))) for f in rate]
    return 1.0 / float(rate[int(np.argmax(coherence))])


def _without_outliers(number: IntArray, edges: Edges, accepted: BoolArray) -> BoolArray:
    """Reject edges further than 6 robust standard deviations from a straight line through the others."""
    resolution = (1.5 if edges.kind == "sampled" else 0.1) * float(np.median(edges.upper_s - edges.lower_s))
    for _ in range(10):
        if np.count_nonzero(accepted) < 3:
            break
        line = np.polynomial.Polynomial.fit(number[accepted], edges.estimate_s[accepted], 1)
        deviation = np.abs(edges.estimate_s - line(number))
        spread = 1.4826 * float(np.median(deviation[accepted]))
        stay = accepted & (deviation <= max(6.0 * spread, resolution))
        if np.array_equal(stay, accepted):
            break
        accepted = stay
    return accepted


# A sampled signal read at other times: band-limited interpolation.

PASS_BAND = 0.4
"""Share of the lower of the two rates below which a resampled signal is unchanged."""
_BETA = 10.06  # Kaiser window of -100 dB
_BLOCK = 1 << 14  # times interpolated at once
_PHASES = 1 << 11  # rows of the kernel's table per sample; linear in between errs by less than 1e-6


def kernel_reach(share: float) -> int:
    """Return how many samples on either side of a time enter its value.

    `share` is the new rate over the old one. Half of Kaiser's N = (A - 8)/(2.285·Δω) for A = 100 dB and the transition
    from 0.4 to 0.6 of the lower rate.
    """
    taps = (100.0 - 8.0) / (2.285 * 2.0 * np.pi * (1.0 - 2.0 * PASS_BAND) * share)
    return int(np.ceil(0.5 * taps))


def resample(samples: FloatArray, position: FloatArray, share: float = 1.0) -> FloatArray:
    """Return samples (S,) at fractional positions (T,), counted in samples from the first one.

    Convolution with a sinc of the pass band up to half of `share` of the sampling rate, with a Kaiser window (Kaiser
    and Schafer, IEEE Trans. Acoust. 28, 1980). A line below 0.4·`share` of the rate keeps amplitude and phase to 3e-5.
    Lines above 0.6·`share`, which would alias onto it at a rate of `share`, are attenuated by 100 dB. `share` is the
    new rate over the old one where that is lower. Positions must lie `kernel_reach` inside the record.
    """
    check_shape("samples", samples, (None,))
    check_shape("position", position, (None,))
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share: expected a number above 0 and at most 1, found {share:g}")
    reach = kernel_reach(share)
    low, high = float(position.min(initial=reach)), float(position.max(initial=reach))
    if low < reach - 1 or high > len(samples) - reach:
        raise ValueError(
            f"position: expected {reach - 1} to {len(samples) - reach} samples, found {low:.1f} to {high:.1f}"
        )
    # Weights of the samples around a time, by its phase between two samples.
    distance = np.arange(1 - reach, reach + 1) - np.linspace(0.0, 1.0, _PHASES + 1)[:, None]
    table = np.sinc(share * distance) * np.i0(_BETA * np.sqrt(np.maximum(0.0, 1.0 - (distance / reach) ** 2)))
    table /= table.sum(axis=1, keepdims=True)
    offsets = np.arange(1 - reach, reach + 1)
    found = np.empty(len(position))
    for start in range(0, len(position), _BLOCK):
        part = position[start : start + _BLOCK]
        first = np.floor(part).astype(np.int64)
        row, between = np.divmod((part - first) * _PHASES, 1.0)
        table_row = row.astype(np.int64)
        near = samples[first[:, None] + offsets]
        lower, upper = (np.einsum("ts,ts->t", table[table_row + step], near) for step in (0, 1))
        found[start : start + _BLOCK] = lower + between * (upper - lower)
    return found
