"""Bursts in records that begin and end at rest: noise, and spectra without leakage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker.frf.result import TransferRecord
from shaker.io.condition import converter_step, runs_of
from shaker.lines.spectrum import hann_window
from shaker.signal_notices import EVALUATED_AS_NOISE
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import Notice

# Where a record is active: blocks of samples whose level exceeds that at both ends.

_BLOCKS = 512  # blocks of a record whose levels are compared
_FEWEST_SAMPLES = 8  # of a block
_END_BLOCKS = 4  # blocks at either end that show the level at rest
_ACTIVE = 3.0  # times the level at rest from which a block is active
_QUIET = 0.15  # of the largest level of the reference: its level at the ends of a record with rest
_SAME_LEVEL = 3.0  # ratio of the levels at both ends that noise at rest does not exceed
_MOVES = 0.01  # of the largest level of a channel: where its ends differ by more, it is not at rest
_ENDS = 32  # samples at either end that show the offset
_HIDDEN = 1e-5  # of the largest level, below which no motion matters
_PAUSE = 8  # blocks of the shortest pause between two bursts
_LONGEST = 0.5  # of the slowest period: the longest block that longer records need
_BEFORE = 0.9  # share of the rest before that is certainly rest
_SHORTEST, _UNEQUAL = 16, 0.25  # samples of a piece at rest; share of the longest piece, for its resolution
_STARTS = 4.5  # standard deviations of the noise within which the first samples of a record are at rest
_SIMILAR = 2.0  # ratio of the lengths of bursts that are repeats of one excitation

RecordEnd = Literal["beginning", "end"]


class RestError(ValueError):
    """A record that is not at rest at an end.

    `channel`: the channel that moves; `end`: "beginning" or "end"; `level`: its level there over its largest level;
    `record`: number of the record, from 0.
    """

    def __init__(self, channel: str, end: RecordEnd, level: float, record: int = 0) -> None:
        self.channel, self.end, self.level, self.record = channel, end, level, record
        super().__init__(
            f"record: expected rest at its {end}, found {channel} at {100.0 * level:.2g} % of its largest level"
        )

    @property
    def notice(self) -> Notice:
        """Notice of a chirp that is evaluated as noise instead."""
        return Notice(EVALUATED_AS_NOISE, self.channel, end=self.end, percent=100.0 * self.level)


@dataclass(frozen=True)
class Burst:
    """Samples (N, 1 + C) from rest to rest without offset, reference first.

    They are active from `first` to before `last`. `step`: steps (1 + C,) of the converter, 0 where none are seen.
    """

    samples: FloatArray
    first: int
    last: int
    step: FloatArray

    @property
    def before(self) -> FloatArray:
        """Samples at rest before; none of a record that begins with the motion."""
        return self.samples[: int(_BEFORE * self.first)]

    @property
    def after(self) -> FloatArray:
        """Samples at rest after: the later half, where less rings unseen."""
        return self.samples[(self.last + len(self.samples)) // 2 :]

    @property
    def rests(self) -> list[FloatArray]:
        """Pieces at rest of sufficient length to show their noise."""
        pieces = [self.before, self.after]
        return [piece for piece in pieces if len(piece) >= max(_SHORTEST, _UNEQUAL * max(map(len, pieces)))]


def find_bursts(record: TransferRecord, band_hz: tuple[float, float], number: int = 0) -> tuple[Burst, ...]:
    """Return the parts of a record from rest to rest, separated by pauses.

    Parts of different lengths are one. `band_hz`: of the excitation; noise above twice its upper end does not hide
    where the motion begins. Raises `RestError` with `number` where the record does not begin and end at rest.
    """
    samples = np.column_stack([record.reference, record.responses])
    names = (record.reference_name, *record.channels)
    lowest, highest = (edge / record.sample_rate_hz for edge in band_hz)
    longest = _LONGEST / lowest if lowest > 0.0 else len(samples)
    size = max(_FEWEST_SAMPLES, int(min(len(samples) // _BLOCKS, longest)))
    active = _active_blocks(_low_pass(samples, highest), size, names, number, starts=_starts_at_rest(samples, highest))
    runs = runs_of(active)
    # Runs of active blocks with shorter pauses are one burst.
    apart = runs[1:, 0] - runs[:-1, 1] >= _PAUSE
    first, last = runs[np.append(True, apart), 0], runs[np.append(apart, True), 1]
    if np.max(last - first) > _SIMILAR * np.min(last - first):
        first, last = first[:1], last[-1:]
    middle = (last[:-1] + first[1:]) // 2 * size
    limits = [0, *middle.tolist(), len(samples)]
    step = np.array([converter_step(column) for column in samples.T])
    return tuple(
        _without_offset(Burst(samples[low:high], a * size - low, min(b * size, high) - low, step))
        for low, high, a, b in zip(limits[:-1], limits[1:], first.tolist(), last.tolist(), strict=True)
    )


def _starts_at_rest(samples: FloatArray, highest: float) -> bool:
    """Return whether the first samples of all channels are within the noise at the end.

    That shows rest before a record that a trigger starts with the motion.
    """
    end = samples[-max(_SHORTEST, len(samples) // _BLOCKS) :]
    noise = end.std(axis=0) + _HIDDEN * np.ptp(samples, axis=0)
    first = samples[: max(3, int(0.125 / highest))]
    return bool(np.all(np.abs(first - end.mean(axis=0)) < _STARTS * noise))


def _active_blocks(samples: FloatArray, size: int, names: Sequence[str], number: int, *, starts: bool) -> BoolArray:
    """Return which blocks (B,) of `size` samples are active in any channel (1 + C).

    `starts`: the record begins with the motion, and at rest. The last block has the remaining samples too.
    """
    count = len(samples) // size
    if count < 4 * _END_BLOCKS:
        raise ValueError(f"record: expected {4 * _END_BLOCKS * size} samples or more, found {len(samples)}")
    blocks = samples[: count * size].reshape(count, size, -1)
    level = blocks.std(axis=1)
    largest = np.maximum(level.max(axis=0), np.finfo(np.float64).tiny)
    begin, end = (np.sqrt(np.mean(part**2, axis=0)) for part in (level[:_END_BLOCKS], level[-_END_BLOCKS:]))
    floor = _HIDDEN * largest
    if starts and np.any(begin > np.maximum(_SAME_LEVEL * end, floor)):
        begin = end
    for c, name in enumerate(names):
        ends: tuple[tuple[RecordEnd, float, float], ...] = (
            ("beginning", begin[c], end[c]),
            ("end", end[c], begin[c]),
        )
        for where, here, there in ends:
            if (c == 0 and here > _QUIET * largest[c]) or here > max(_SAME_LEVEL * there, _MOVES * largest[c]):
                raise RestError(name, where, float(here / largest[c]), number)
    return np.asarray(np.any(level > np.maximum(_ACTIVE * np.sqrt(0.5 * (begin**2 + end**2)), floor), axis=1))


def _low_pass(samples: FloatArray, highest: float) -> FloatArray:
    """Return samples (N, D) without what lies above twice a frequency in cycles per sample."""
    frequency = np.fft.rfftfreq(len(samples))
    if 2.0 * highest >= frequency[-1]:
        return samples
    share = 0.5 + 0.5 * np.cos(np.pi * np.clip(frequency / highest - 1.0, 0.0, 1.0))
    # The line through both ends, so that the transform has no step between them.
    line = np.linspace(samples[:_ENDS].mean(axis=0), samples[-_ENDS:].mean(axis=0), len(samples))
    return np.asarray(line + np.fft.irfft(share[:, None] * np.fft.rfft(samples - line, axis=0), n=len(samples), axis=0))


def _without_offset(burst: Burst) -> Burst:
    """Return a burst less the straight line through its levels at rest before and after."""
    count = len(burst.samples)
    after = burst.after.mean(axis=0)
    before = burst.before.mean(axis=0) if len(burst.before) >= _SHORTEST else after
    place = np.clip((np.arange(count) - 0.5 * burst.first) / (count - 0.5 * burst.first), 0.0, 1.0)[:, None]
    return replace(burst, samples=burst.samples - before - place * (after - before))


# Noise of a record at rest.

_ENOUGH_DOF = 60.0  # of a noise spectrum, to which neighbouring lines are averaged
_WIDEST = 8  # lines on either side that are averaged, at most
_OVERLAP_LOSS = 1.9  # lines of a Hann window per independent one


@dataclass(frozen=True)
class RestNoise:
    """Noise spectra `power` (F, D, D) per sample, with degrees of freedom.

    `frequency` (F,): cycles per sample.
    """

    frequency: FloatArray
    power: ComplexArray
    dof: float

    def at(self, frequency: FloatArray) -> ComplexArray:
        """Return the spectra (K, D, D) at frequencies in cycles per sample."""
        flat = self.power.reshape(len(self.power), -1)
        found = [
            np.interp(frequency, self.frequency, part.real) + 1j * np.interp(frequency, self.frequency, part.imag)
            for part in flat.T
        ]
        return np.stack(found, axis=1).reshape(-1, *self.power.shape[1:])


def rest_noise(rests: Sequence[FloatArray]) -> RestNoise:
    """Return the noise spectra of pieces (N, D) at rest.

    Hann segments of the length of the shortest piece are averaged, and neighbouring lines until the degrees of freedom
    suffice.
    """
    length = min(len(rest) for rest in rests)
    segments = [
        rest[start : start + length]
        for rest in rests
        for start in range(0, len(rest) - length + 1, max(1, length // 2))
    ]
    window = hann_window(length)
    level = np.arange(length) - 0.5 * (length - 1)
    total = np.zeros((length // 2 + 1, rests[0].shape[1], rests[0].shape[1]), dtype=np.complex128)
    for segment in segments:
        flat = segment - segment.mean(axis=0)
        flat = flat - level[:, None] * (level @ flat / (level @ level))
        value = np.fft.rfft(window[:, None] * flat, axis=0)
        total += value[:, :, None] * value.conj()[:, None, :]
    total /= len(segments) * np.sum(window**2)
    independent = sum(max(1.0, len(rest) / length) for rest in rests)
    usable = total[2:]  # the offset and the slope were subtracted
    side = int(np.clip(0.25 * _OVERLAP_LOSS * _ENOUGH_DOF / independent, 1, min(_WIDEST, max(1, len(usable) // 8))))
    mean = _running_mean(usable, side)
    dof = 2.0 * independent * max(1.0, (2 * side + 1) / _OVERLAP_LOSS)
    return RestNoise(np.arange(2, length // 2 + 1) / length, mean, dof)


def _running_mean(values: ComplexArray, side: int) -> ComplexArray:
    """Return the mean of each of F rows and up to `side` on either side."""
    total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    index = np.arange(len(values))
    low, high = np.maximum(index - side, 0), np.minimum(index + side + 1, len(values))
    counts = (high - low).reshape(-1, *([1] * (values.ndim - 1)))
    return np.asarray((total[high] - total[low]) / counts)


# Spectra of bursts: no window acts on the motion, so that nothing leaks.

_FLANK = 0.15  # share of a rest in which the window rises or falls
_ROUNDING = 1e-9  # of the range of a signal, below which noise does not matter
_NEARLY = 0.02  # shorter records by this share correlate lines by too little to matter
_LOBES = 4.0  # of the correlation of interpolated lines


@dataclass(frozen=True)
class BurstSpectra:
    """Spectra of M bursts at K lines.

    Attributes
    ----------
    frequency_hz : (K,)
    value : (M, K, 1 + C), reference first, scaled to the noise of the mean burst per sample.
    noise : (K, 1 + C, 1 + C), E[n nᴴ] of each.
    dof : degrees of freedom of `noise`.
    spacing_hz : distance of the lines.
    line_correlation : (D,), correlation of the noise of lines 0, 1, 2 … apart.
    ringing : significant motion beyond the ends.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    noise: ComplexArray
    dof: float
    spacing_hz: float
    line_correlation: ComplexArray
    ringing: tuple[Ringing, ...]

    def at_lines(self, lines: BoolArray) -> BurstSpectra:
        """Return the lines of a mask (K,)."""
        return replace(self, frequency_hz=self.frequency_hz[lines], value=self.value[:, lines], noise=self.noise[lines])


def burst_spectra(
    bursts: Sequence[Burst], rate_hz: float, spacing_hz: float | None, band_hz: tuple[float, float]
) -> BurstSpectra:
    """Return the spectra of bursts at lines `spacing_hz` apart (default: one over the longest)."""
    finest = rate_hz / max(len(burst.samples) for burst in bursts)
    step = 1  # lines of the transform from one line to the next
    if spacing_hz is not None:
        step = max(1, int(np.floor(spacing_hz / finest + 1e-9)))
        finest = spacing_hz / step
    length = round(rate_hz / finest)
    finest = rate_hz / length
    chosen = np.arange(max(1, int(np.ceil(band_hz[0] / (step * finest)))), int(band_hz[1] / (step * finest)) + 1) * step
    chosen = chosen[chosen < (length + 1) // 2]
    if not len(chosen):
        raise ValueError(f"band_hz: expected lines inside the band, found none in {band_hz[0]} to {band_hz[1]} Hz")
    # Noise differs between records of different ranges, by one factor for all channels.
    power = np.array([np.mean(np.concatenate(_centred(burst.rests)) ** 2, axis=0) for burst in bursts])
    steps = np.array([burst.step for burst in bursts])
    least = np.maximum(steps**2 / 12.0, [np.ptp(burst.samples, axis=0) ** 2 * _ROUNDING**2 for burst in bursts])
    louder = np.exp(np.mean(np.log(np.maximum(power, least) / np.mean(np.maximum(power, least), axis=0)), axis=1))
    value = np.stack(
        [
            np.fft.rfft(_window(burst) * burst.samples, n=length, axis=0)[chosen] / np.sqrt(factor * len(burst.samples))
            for burst, factor in zip(bursts, louder, strict=True)
        ]
    )
    pieces = [rest / np.sqrt(factor) for burst, factor in zip(bursts, louder, strict=True) for rest in burst.rests]
    noise = rest_noise(pieces)
    # Where noise does not exceed the steps of the converter, rounding adds to a signal what it does not add at rest,
    # and may be the same in every repeat.
    rounded = np.mean(np.where(power < 0.25 * steps**2, steps**2 / 12.0, 0.0) / louder[:, None], axis=0)
    frequency = np.asarray(chosen * finest, dtype=np.float64)
    return BurstSpectra(
        frequency_hz=frequency,
        value=value,
        noise=noise.at(frequency / rate_hz) + np.diag(len(bursts) * rounded),
        dof=noise.dof,
        spacing_hz=step * finest,
        line_correlation=_interpolated(step * float(np.mean([len(burst.samples) for burst in bursts])) / length),
        ringing=_ringing(bursts, rate_hz, band_hz),
    )


def _interpolated(share: float) -> ComplexArray:
    """Return the correlation of the noise of lines 0, 1, 2 … apart.

    `share`: their spacing relative to one over the length of the record.
    """
    if share > 1.0 - _NEARLY:
        return np.ones(1, dtype=np.complex128)
    lag = np.arange(int(_LOBES / share) + 1)
    # The triangle keeps the variance of every combination of lines positive.
    return np.asarray(np.sinc(share * lag) * (1.0 - lag / len(lag)), dtype=np.complex128)


def _centred(rests: Sequence[FloatArray]) -> list[FloatArray]:
    """Return pieces at rest without their means."""
    return [rest - rest.mean(axis=0) for rest in rests]


def _window(burst: Burst) -> FloatArray:
    """Return a window (N, 1): 1 over the motion, with cosine flanks in both rests."""
    length = len(burst.samples)
    index = np.arange(length)
    rise, fall = (max(0.5, _FLANK * rest) for rest in (burst.first, length - burst.last))
    ends = np.minimum((index + 0.5) / rise, (length - index - 0.5) / fall)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(ends, 0.0, 1.0)))[:, None]


# Motion at the ends that noise hides from the levels: lines in the spectrum of one end that the other lacks.

_CHANCE = 1e-3  # that noise at rest shows a line, over all lines and channels of a record
_SLOWEST = 0.95  # ratio of the amplitudes of two pieces above which a decay is not resolved


@dataclass(frozen=True)
class Ringing:
    """Motion beyond an end of the records, as a share of the spectrum."""

    channel: int
    end: RecordEnd
    frequency_hz: float
    share: float


def _ringing(bursts: Sequence[Burst], rate_hz: float, band_hz: tuple[float, float]) -> tuple[Ringing, ...]:
    """Return the most significant line at either end of every channel, if significant."""
    from scipy.special import fdtri

    if any(len(burst.rests) < 2 for burst in bursts):
        return ()  # nothing to compare an end with
    length = min(len(rest) for burst in bursts for rest in burst.rests)
    frequency = np.arange(length // 2 + 1) * (rate_hz / length)
    inside = np.flatnonzero((frequency >= band_hz[0]) & (frequency <= band_hz[1]) & (np.arange(len(frequency)) >= 2))
    if not len(inside):
        return ()
    window, found = hann_window(length), list[Ringing]()

    def power(pieces: Sequence[FloatArray]) -> FloatArray:
        values = [np.fft.rfft(window[:, None] * piece, n=length, axis=0)[inside] for piece in _centred(pieces)]
        return np.asarray(np.mean(np.abs(values) ** 2, axis=0))

    ends: tuple[tuple[RecordEnd, list[FloatArray], list[FloatArray], list[FloatArray]], ...] = (
        (
            "beginning",
            [burst.before[:length] for burst in bursts],
            [burst.before[-length:] for burst in bursts],
            [burst.after[-length:] for burst in bursts],
        ),
        (
            "end",
            [burst.after[-length:] for burst in bursts],
            [burst.samples[-2 * length : -length] for burst in bursts],
            [burst.before[:length] for burst in bursts],
        ),
    )
    for end, outer, inner, opposite in ends:
        noise = rest_noise(opposite)
        power_at_rest = noise.at(np.asarray(frequency[inside] / rate_hz, dtype=np.float64))
        level: FloatArray = np.asarray(np.diagonal(power_at_rest, axis1=1, axis2=2).real * np.sum(window**2))
        tiny = np.finfo(np.float64).tiny
        level = np.maximum(level, tiny)
        line, before = power(outer), power(inner)
        limit = fdtri(2.0 * len(bursts), noise.dof, 1.0 - _CHANCE / line.size)
        for c in range(line.shape[1]):
            at = int(np.argmax(np.log(line[:, c] + tiny) - np.log(level[:, c])))
            if line[at, c] <= limit * level[at, c]:
                continue
            # The motion beyond the end is a geometric series of such pieces, which the Hann window did not change.
            excess = line[at, c] - level[at, c]
            ratio = np.sqrt(min(excess / max(before[at, c], excess), _SLOWEST**2))
            beyond = np.sqrt(excess) * ratio / (1.0 - ratio)
            share = float(beyond / _spectrum_at(bursts, c, frequency[inside[at]] / rate_hz, 1.0 / length))
            if share > _HIDDEN:
                found.append(Ringing(c, end, float(frequency[inside[at]]), share))
    return tuple(found)


def _spectrum_at(bursts: Sequence[Burst], channel: int, frequency: float, reach: float) -> float:
    """Return the rms spectrum of bursts around a frequency, both in cycles per sample."""
    found = []
    for burst in bursts:
        count = len(burst.samples)
        low, high = max(1, int((frequency - reach) * count)), int((frequency + reach) * count) + 2
        found.append(np.mean(np.abs(np.fft.rfft(burst.samples[:, channel])[low:high]) ** 2))
    return float(np.sqrt(np.mean(found)))
