"""Where subsets will be in the next frame, from where they were in the last ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from photogram._checks import FloatArray

LARGEST_COEFFICIENT = 3.0


def predict_warp(history: Sequence[FloatArray]) -> FloatArray:
    """The next warps (N,6) after those in `history` (oldest first): by the rule that would have foretold the last best.

    Rules: stay; go on evenly, 2x₋₁ − x₋₂; one sine about any mean, x₋₃ + c(x₋₁ − x₋₂) with c = 1 + 2cos(ωΔt) fitted
    over all subsets, which holds for a vibration sampled below its frequency as well.
    """
    rules = (_stay, _go_on, _swing)
    errors = [_error(rule(history[:-1]), history[-1]) if len(history) > 1 else np.inf for rule in rules]
    best = rules[int(np.argmin(errors))]
    guess = best(history)
    return np.where(np.isfinite(guess), guess, history[-1])


def _stay(history: Sequence[FloatArray]) -> FloatArray:
    """The last warp."""
    return history[-1]


def _go_on(history: Sequence[FloatArray]) -> FloatArray:
    """The last step once more; NaN when there is none."""
    if len(history) < 2:
        return np.full_like(history[-1], np.nan)
    return 2.0 * history[-1] - history[-2]


def _swing(history: Sequence[FloatArray]) -> FloatArray:
    """The next value of one sine with offset; NaN with fewer than four frames."""
    if len(history) < 4:
        return np.full_like(history[-1], np.nan)
    before, third, second, last = (warp[:, [0, 3]] for warp in history[-4:])
    slope, change = (second - third).ravel(), (last - before).ravel()
    known = np.isfinite(slope) & np.isfinite(change)
    power = float(np.sum(slope[known] ** 2))
    coefficient = float(np.sum(slope[known] * change[known])) / power if power > 0.0 else 0.0
    coefficient = min(max(coefficient, -LARGEST_COEFFICIENT), LARGEST_COEFFICIENT)
    return history[-3] + coefficient * (history[-1] - history[-2])


def _error(guess: FloatArray, truth: FloatArray) -> float:
    """Median distance of the predicted from the found positions; infinite when nothing can be compared."""
    distance = np.hypot(guess[:, 0] - truth[:, 0], guess[:, 3] - truth[:, 3])
    finite = distance[np.isfinite(distance)]
    return float(np.median(finite)) if len(finite) else np.inf
