"""Hits of an impact hammer in a force record: where they are, and which of them count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import BoolArray, FloatArray, IntArray
from shaker.signals.transfer.result import TransferRecord

_HIT = 0.1  # share of the largest force from which a pulse is a hit
_FOOT = 0.01  # share of a pulse's peak at which it begins and ends
_AGAIN = 0.05  # share of a pulse's peak from which a second pulse is a second hit
_NOISE = 6.0  # standard deviations of the force at rest that no foot goes below
_FAR = 0.3  # share of the largest excursion from which an end of the range is not the level at rest
_CLIPPED = 3  # equal samples in a row at the range's end that tell an overload


@dataclass(frozen=True)
class Hit:
    """A pulse: first and last sample above its foot, and its peak; `refused` says why it does not count (or empty)."""

    first: int
    last: int
    peak: int
    refused: str = ""


def find_hits(record: TransferRecord, length: int) -> list[Hit]:
    """Return the hits of a record whose reference is a force, judged for windows of `length` samples.

    A hit does not count where the record ends before its window does, where a second pulse stands in the window (which
    is no hit of its own), and where any channel is overloaded in it.
    """
    force, noise = _pulses_up(record.reference)
    largest = float(force.max(initial=0.0))
    if not largest > 2.0 * _NOISE * noise:
        raise ValueError(f"reference: expected a force with hits, found only noise in {record.reference_name}")
    overloaded = _overloads(record)
    above = _runs(force > _HIT * largest)
    hits: list[Hit] = []
    for low, high in above:
        if hits and low < hits[-1].first + length:
            continue
        hits.append(_judged(force, noise, overloaded, _foot(force, noise, low, high), length))
    return hits


def _pulses_up(reference: FloatArray) -> tuple[FloatArray, float]:
    """Return the force without its rest level, pulses upwards, and the standard deviation of its noise at rest."""
    rest = float(np.median(reference))
    deviation = reference - rest
    noise = float(np.median(np.abs(deviation)) / 0.6745)
    return (deviation if deviation.max() >= -deviation.min() else -deviation), noise


def _foot(force: FloatArray, noise: float, low: int, high: int) -> tuple[int, int, int]:
    """Return first, last and peak sample of the pulse around samples low … high."""
    peak = low + int(np.argmax(force[low : high + 1]))
    foot = max(_FOOT * float(force[peak]), _NOISE * noise)
    before = np.flatnonzero(force[: peak + 1] < foot)
    after = np.flatnonzero(force[peak:] < foot)
    first = int(before[-1]) + 1 if len(before) else 0
    last = peak + int(after[0]) - 1 if len(after) else len(force) - 1
    return first, last, peak


def _judged(force: FloatArray, noise: float, overloaded: BoolArray, pulse: tuple[int, int, int], length: int) -> Hit:
    """Return a hit with the reason why it does not count."""
    first, last, peak = pulse
    end = first + length
    rest = force[last + 1 + (last - first + 1) // 2 : end]
    again = np.flatnonzero(rest > max(_AGAIN * float(force[peak]), _NOISE * noise))
    if end > len(force):
        return Hit(first, last, peak, "the record ends before its window does")
    if overloaded[first:end].any():
        return Hit(first, last, peak, "a channel is overloaded")
    if len(again):
        return Hit(first, last, peak, f"a second pulse follows {again[0] + 1 + (last - first + 1) // 2} samples later")
    return Hit(first, last, peak)


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Return first and last index of every run of true samples."""
    edges: IntArray = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _overloads(record: TransferRecord) -> BoolArray:
    """Tell the samples (S,) where any channel stays at the end of its range."""
    found = np.zeros(len(record.reference), dtype=np.bool_)
    for samples in (record.reference, *record.responses.T):
        rest = float(np.median(samples))
        far = _FAR * float(np.max(np.abs(samples - rest)))
        for end in (samples.min(), samples.max()):
            if abs(end - rest) < far:
                continue
            for low, high in _runs(samples == end):
                if high - low + 1 >= _CLIPPED:
                    found[low : high + 1] = True
    return found
