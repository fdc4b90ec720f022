"""Where in a record the release is, found without a model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray

_FIRST = 0.005  # share of the record that is taken for rest before the release is looked for
_LAST = 0.2  # share of what follows the release from which the new level is read
_MOTION = 5.0  # standard deviations that a sample must leave the baseline by
_RUN = 3  # samples in a row that must have passed a level
_GUARD = 0.9  # share of the rest before the first motion that is free of it beyond doubt


@dataclass(frozen=True)
class Location:
    """Rough place of a release: sample of the first motion above the noise, and levels with the samples' noise.

    `low`, `high`: where the output first passes 10 % and 90 % of the change, in samples with fractions.
    """

    first: int
    low: float
    high: float
    baseline: float
    steady: float
    noise: float
    resolution: float

    @property
    def strength(self) -> float:
        """Change of level over the noise of a sample."""
        return abs(self.steady - self.baseline) / max(self.noise, 1e-300)

    @property
    def longest(self) -> float:
        """Length in samples of a ramp that the output follows from 10 % to 90 %, more where noise hides its begin."""
        seen = max(0.9 - max(0.1, _MOTION / max(self.strength, 1e-300)), 0.2)
        return max(self.high - self.low, 2.0) * 0.8 / seen**2


def locate(samples: FloatArray, near: int | None = None) -> Location:
    """Return where samples (N,) begin to change and where to; `near`: the sample where that is stated to happen.

    The first motion is the last sample within five standard deviations of the baseline ahead of the half-way point.
    """
    count = len(samples)
    if count < 64:
        raise ValueError(f"samples: expected at least 64 of a release, found {count}")
    if near is not None and not 8 <= near < count - 16:
        raise ValueError(f"near: expected a sample of 8 to {count - 17} that leaves rest and response, found {near}")
    rest = max(16, int(_FIRST * count)) if near is None else int(_GUARD * near)
    first = near if near is not None else rest
    baseline, steady = float(np.mean(samples[:rest])), float(np.mean(samples[-max(8, int(_LAST * count)) :]))
    noise = resolution = 0.0
    for _ in range(3):
        before = samples[:rest]
        baseline = float(np.mean(before))
        resolution = _resolution(samples)
        noise = max(float(np.std(before)), resolution / np.sqrt(12.0))
        half = _passing(samples, baseline, steady, 0.5, rest)
        quiet = np.flatnonzero(np.abs(samples[: int(half) + 1] - baseline) <= _MOTION * noise)
        first = int(quiet[-1]) + 1 if quiet.size else int(half)
        rest = max(16, int(_GUARD * first)) if first > 16 else rest
        steady = float(np.mean(samples[first + int((1.0 - _LAST) * (count - first)) :]))
    low, high = (_passing(samples, baseline, steady, share, max(first - 1, 0)) for share in (0.1, 0.9))
    return Location(first, low, high, baseline, steady, noise, resolution)


def _passing(samples: FloatArray, baseline: float, steady: float, share: float, start: int) -> float:
    """Return where samples first pass a share of the change after `start`, between samples by a straight line.

    So many samples in a row must have passed that noise does not.
    """
    change = steady - baseline
    relative = (samples[start:] - baseline) / change if change else np.zeros(len(samples) - start)
    runs = np.convolve(relative >= share, np.ones(_RUN))[_RUN - 1 :]
    above = np.flatnonzero(runs[: len(relative)] >= _RUN)
    if not above.size:
        return float(len(samples) - 1)
    place = int(above[0])
    if place == 0:
        return float(start)
    return start + place - 1 + float((share - relative[place - 1]) / (relative[place] - relative[place - 1]))


def _resolution(samples: FloatArray) -> float:
    """Return the smallest difference between two values that occur, 0 where all are the same."""
    steps = np.diff(np.unique(samples))
    return float(steps.min()) if steps.size else 0.0
