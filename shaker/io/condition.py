"""Defects in a channel's samples: lost stretches, clipping, coarse converter steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.digits import number_text

DefectKind = Literal["lost", "clipped", "steps"]

FEWEST_STEPS = 30.0
"""Converter steps in an amplitude below which quantisation without dither may cost more than 1e-3 of it: 0.2·n^-1.5."""
_FAR = 100.0  # median deviations from the median: samples beyond are spikes, or numbers for lost samples
_EXCERPT = 1 << 16  # samples that show the steps of a converter
_ROUNDING = 5e-7  # of the largest value: single precision of equal values
_LONGER = 3  # times the longest constant run that is typical of a record: a longer one is a stretch without signal
_SHORTEST = 8  # samples of a stretch that counts as lost
_QUIET, _USUAL = 0.02, 0.9  # of the range that nine in ten periods do not exceed: less is no signal
_BLOCKS = 32  # parts of a record in which the longest constant run is typical
_FEWEST = 8  # samples at a limit
# Shares of all samples that may lie beyond a limit: none, spikes, noise added later.
_BEYOND = (0.0, 5e-4, 1e-2)
_CURVED = 25.0  # times the range and the square of such a share: ten times the depth of a sine's crest of this share
_WIDEST = 0.03  # of the range: how far samples at one limit may differ
_CLIPPED_RATIO = 4.0 / 3.0  # samples within eight widths of a limit over those within one
# Widths, samples within them over those within one that are fewer than the √widths of a smooth crest, and samples from
# which on that is no chance.
_CROWDED = ((8.0, 1.8, 200), (4.0, 1.5, 300), (2.0, 1.25, 1000))
_RUN = 3  # samples at a limit one after another, which no sampling of a smooth crest can give without others nearby
_CHOSEN, _CLUSTER = 4096, 2.5  # values of the middle half whose clusters are counted; samples at a limit over theirs
_LIKE = 1e-5  # of the range: largest distance of values in one cluster
_CLUSTERED = 0.5  # of the middle half of the values that the widest twentieth of their gaps takes
_RESTS = 0.02  # of the record: a level that lasts longer at a time is the resting level
_OUTSIDE = 12.0  # resolutions by which the record falls next to a clipped peak; the top of a wave falls by 9 at most
_NOISE, _MEDIAN_DIFFERENCE = 6.0, 0.954  # standard deviations of noise; median difference of two samples of unit noise
_NAMED = 3  # stretches named


@dataclass(frozen=True, repr=False)
class Defect(Arrays, shapes="spans N 2"):
    """A defect in the samples of a channel.

    Attributes
    ----------
    kind : "lost" (constant, quiet or NaN for longer than the signal can be), "clipped" (constant at a limit) or "steps"
        (few converter steps in the driven line).
    spans : (N, 2), first sample and the one after the last of each stretch; empty for steps.
    levels : constant values of lost stretches; limits of clipped samples, lower first, -inf or inf for an intact side.
    step : converter step, 0 where none is visible.
    steps : number of converter steps in the amplitude of the driven line, infinite if unknown.
    """

    kind: DefectKind
    spans: IntArray
    levels: tuple[float, ...] = ()
    step: float = 0.0
    steps: float = np.inf

    @property
    def count(self) -> int:
        """Number of samples in all stretches."""
        return int(np.sum(self.spans[:, 1] - self.spans[:, 0]))

    def mask(self, samples: int) -> BoolArray:
        """Return which of `samples` samples lie in a stretch, (S,)."""
        change = np.zeros(samples + 1, dtype=np.int64)
        np.add.at(change, self.spans[:, 0], 1)
        np.add.at(change, self.spans[:, 1], -1)
        return np.asarray(np.cumsum(change[:-1]) > 0)

    def text(self, time_s: FloatArray, unit: str = "") -> str:
        """Describe the defect of a channel sampled at `time_s` (S,): kind, numbers, times."""
        unit = f" {unit}" if unit else ""
        if self.kind == "steps":
            size = f"{number_text(self.steps, 2)} converter steps of {number_text(self.step, 4)}{unit}"
            return f"its driven line has an amplitude of only {size}"
        share = f"{self.count} of {len(time_s)} samples"
        if self.kind == "clipped":
            low, high = self.levels
            limits = [f"{number_text(level, 5)}{unit}" for level in (low, high) if np.isfinite(level)]
            return f"is clipped at {' and '.join(limits)}: {share}"
        ends = [(float(time_s[first]), float(time_s[last - 1])) for first, last in self.spans[:_NAMED].tolist()]
        times = ", ".join(f"{first:.6g} s to {last:.6g} s" for first, last in ends)
        more = f" and {len(self.spans) - _NAMED} more" if len(self.spans) > _NAMED else ""
        return f"has no signal (constant, quiet or no numbers) from {times}{more}: {share}"


def examine_samples(
    samples: FloatArray, sample_rate_hz: float, amplitude: float | None = None, frequency_hz: float | None = None
) -> list[Defect]:
    """Find lost stretches, clipping and coarse converter steps in the samples (S,) of a channel.

    `amplitude` is that of the driven line in this channel, in the unit of the samples. `frequency_hz` is that of the
    slowest driven line. Without a driven line only clipping is searched for: a decaying signal becomes constant anyway,
    and the level of most samples is no limit.

    >>> import numpy as np
    >>> time_s = np.arange(20_000) / 2000.0
    >>> clipped = np.minimum(50.0 * np.cos(2 * np.pi * 106.25 * time_s), 40.0)
    >>> [defect.text(time_s, "m/s²") for defect in examine_samples(clipped, 2000.0)]
    ['is clipped at 40 m/s²: 4063 of 20000 samples']
    """
    check_shape("samples", samples, (None,))
    found: list[Defect] = []
    step = converter_step(samples)
    rest = samples
    if frequency_hz is not None:
        seen_hz = abs(frequency_hz - sample_rate_hz * round(frequency_hz / sample_rate_hz))  # its alias
        lost = find_lost(samples, step, min(sample_rate_hz / max(seen_hz, 1e-300), len(samples) / 8.0))
        if lost is not None:
            found.append(lost)
            rest = samples[~lost.mask(len(samples))]
    low, high = clip_levels(rest, step, resting=frequency_hz is None)
    if np.isfinite(low) or np.isfinite(high):
        reach = (samples <= low) | (samples >= high)
        for defect in found:
            reach &= ~defect.mask(len(samples))
        found.append(Defect("clipped", runs_of(reach), (low, high), step))
    if amplitude is not None and step > 0.0 and amplitude < FEWEST_STEPS * step:
        found.append(Defect("steps", np.zeros((0, 2), dtype=np.int64), (), step, amplitude / step))
    return found


def runs_of(chosen: BoolArray) -> IntArray:
    """Return first and last + 1 (N, 2) of each run of true values (S,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    return np.asarray(edges.reshape(-1, 2), dtype=np.int64)


# Steps of the converter.


def converter_step(samples: FloatArray) -> float:
    """Return the step that divides all differences of samples (S,); 0 without one."""
    excerpt = samples[:_EXCERPT]
    excerpt = excerpt[np.isfinite(excerpt)]
    off = np.abs(excerpt - np.median(excerpt)) if len(excerpt) else excerpt
    excerpt = excerpt[off <= _FAR * np.median(off)] if np.any(off) and np.median(off) > 0.0 else excerpt
    levels = np.unique(excerpt)
    if len(levels) < 2:
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > _ROUNDING * float(np.max(np.abs(levels)))]
    if not len(gaps):
        return 0.0
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    off = np.abs(gaps / step - np.rint(gaps / step))
    return step if np.mean(off < 0.1) > 0.95 else 0.0


# Stretches without signal.


def find_lost(samples: FloatArray, step: float, period: float) -> Defect | None:
    """Find stretches without a signal of this `period` (samples) in samples (S,).

    A stretch is constant for longer than the constant runs that are typical of the record (crests between two steps or
    at a limit), quiet for whole periods, or not a number. It begins or ends abruptly next to the usual signal, whereas
    a beat or a decaying motion fades.
    """
    bad = ~np.isfinite(samples)
    values = np.where(bad, np.inf, samples) if bad.any() else samples
    edges = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1, [len(values)]])
    length = np.diff(edges)
    parts = int(np.clip(len(samples) / (2.0 * period), 4, _BLOCKS))
    cuts = np.searchsorted(edges[:-1], np.linspace(0, len(samples), parts + 1)[:-1])
    cuts = np.unique(np.minimum(cuts, len(length) - 1))
    least = max(_SHORTEST, _LONGER * float(np.median(np.maximum.reduceat(length, cuts))))
    long = length >= least
    constant = np.stack([edges[:-1][long], edges[1:][long]], axis=1)
    reach = max(int(np.ceil(period)), _SHORTEST)
    swing = _swings(samples[: len(samples) // reach * reach].reshape(-1, reach))
    usual = float(np.nanquantile(swing, _USUAL)) if np.isfinite(swing).any() else 0.0
    quiet = runs_of(swing < _QUIET * usual)
    quiet = reach * quiet[quiet[:, 1] - quiet[:, 0] > 1]
    lost = bad.copy()
    for first, last in _interruptions(samples, constant, reach, 0.5 * usual if step > 0.0 else -1.0):
        lost[first:last] = True
    for first, last in _interruptions(samples, quiet, 2 * reach, 0.5 * usual):
        lost[first:last] = True
    if not lost.any():
        return None
    spans = runs_of(lost)
    return Defect("lost", spans, tuple(float(v) for v in np.unique(values[spans[:, 0]])[:_NAMED]), step)


def _swings(blocks: FloatArray) -> FloatArray:
    """Return the range of the finite values of each block (B, L), NaN without any."""
    high = np.max(np.where(np.isfinite(blocks), blocks, -np.inf), axis=1)
    low = np.min(np.where(np.isfinite(blocks), blocks, np.inf), axis=1)
    return np.where(high >= low, high - low, np.nan)


def _interruptions(samples: FloatArray, spans: IntArray, reach: int, least: float) -> Iterator[tuple[int, int]]:
    """Yield the spans (N, 2) with a swing above `least` within `reach` samples."""
    for first, last in spans.tolist():
        neighbours = [
            part for part in (samples[max(first - reach, 0) : first], samples[last : last + reach]) if len(part)
        ]
        if least < 0.0 or any(float(_swings(part[None])[0]) > least for part in neighbours):
            yield first, last


# Limits at which samples are clipped.


def clip_levels(samples: FloatArray, step: float, *, resting: bool = False) -> tuple[float, float]:
    """Return the lower and upper clipping limits of samples (S,), -inf and inf where intact.

    A smooth crest has √8 times as many samples within eight widths of its top as within one. A clipped crest has hardly
    more, whether the values at the limit are equal or scatter a little. With `resting`, the level of most samples is
    the resting level of the signal and no limit.
    """
    samples = samples[np.isfinite(samples)]
    if len(samples) < 2 * _FEWEST or np.ptp(samples) == 0.0:
        return -np.inf, np.inf
    high, low = (_clipping_level(signal, step, resting) for signal in (samples, -samples))
    # One level is the resting level of the signal between its peaks.
    return (-low, high) if -low < high else (-np.inf, np.inf)


def cut_run(samples: FloatArray, resolution: float, noise: float) -> int:
    """Return the length of a run of equal samples at a clipped maximum, else 0.

    The top of a wave of resolution q falls by 9q at most within the length of the run on either side. A clipped one
    falls by more.
    """
    top = runs_of(samples >= samples.max() - 0.25 * resolution)
    for start, end in top.tolist():
        length = end - start
        if length >= _RUN and start - length >= 0 and end + length <= len(samples):
            drop = samples.max() - max(samples[start - length], samples[end + length - 1])
            if drop > _OUTSIDE * resolution + _NOISE * noise:
                return int(length)
    return 0


def _clipping_level(samples: FloatArray, step: float, resting: bool) -> float:
    """Return the level above which samples are clipped, inf where they are not."""
    span, total = float(np.ptp(samples)), len(samples)
    exact = step * (1.0 - 1e-3) if step > 0.0 else _ROUNDING * float(np.max(np.abs(samples)))
    for share in _BEYOND:
        beyond = int(share * total)
        top = float(np.partition(samples, -1 - beyond)[-1 - beyond])
        width = max(exact, _CURVED * share**2 * span)
        while width <= max(_WIDEST * span, exact):
            near = samples > top - width
            count = int(np.count_nonzero(near))
            if count >= max(_FEWEST, 10 * beyond) and _is_limit(samples, near, (top, width, exact), resting):
                return float(np.min(samples[near]))
            width *= 2.0
    noise = float(np.median(np.abs(np.diff(samples)))) / _MEDIAN_DIFFERENCE
    if resting and 0 < cut_run(samples, step, noise) <= _RESTS * total:
        return float(samples.max())
    return np.inf


def _is_limit(samples: FloatArray, near: BoolArray, where: tuple[float, float, float], resting: bool) -> bool:
    """Return whether the samples `near` a top are clipped; `where`: it and two widths."""
    top, width, exact = where
    count, spans = int(np.count_nonzero(near)), runs_of(near)
    length = spans[:, 1] - spans[:, 0]
    if resting:
        visits = runs_of(samples > top - _CROWDED[0][0] * width)
        if len(spans) < 3 or np.max(visits[:, 1] - visits[:, 0]) > _RESTS * len(near):
            return False
    within = [int(np.count_nonzero(samples > top - widths * width)) for widths, _, _ in _CROWDED]
    if within[0] < _CLIPPED_RATIO * int(np.sum(length[length >= _RUN])):
        return True
    equal = within[0] < _CLIPPED_RATIO * count and (width <= exact or count >= _CROWDED[0][2])
    crowded = any(
        count >= fewest and number < most * count for (_, most, fewest), number in zip(_CROWDED, within, strict=True)
    )
    if not (equal or crowded):
        return False
    # Samples synchronous with the signal lie in clusters everywhere, not at its limits alone.
    quarter = len(samples) // 4
    inner = np.sort(np.partition(samples, (quarter, -1 - quarter))[quarter:-quarter])
    if equal:
        middle = inner[:: -(-len(inner) // _CHOSEN)]
        half = max(width, _LIKE * float(np.ptp(samples))) / 2.0
        like = np.searchsorted(inner, middle + half) - np.searchsorted(inner, middle - half)
        if count > _CLUSTER * float(np.median(like)):
            return True
    gaps = np.sort(np.maximum(np.diff(inner) - 1.01 * exact, 0.0))
    return crowded and float(np.sum(gaps[-len(gaps) // 20 :])) < _CLUSTERED * float(inner[-1] - inner[0])
