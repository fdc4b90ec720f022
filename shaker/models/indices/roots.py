"""Roots of a function between pairs of points, all at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from shaker._checks import FloatArray, IntArray

STEPS = 120


def sign_changes(value: FloatArray) -> IntArray:
    """Return the places i at which `value` (N,) changes its sign between i and i + 1, or is 0 at i + 1."""
    positive = value > 0
    return np.asarray(np.flatnonzero(positive[1:] != positive[:-1]), dtype=np.int64)


def roots_between(function: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray) -> FloatArray:
    """Return a root (R,) of a function of (R,) between each `low` and `high`, at which its signs differ.

    False position with the Illinois rule (Dowell and Jarratt, BIT 11 (1971) 168-174), every fourth step a bisection, to
    the last digits.
    """
    left, right = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)
    if not len(left):
        return left
    at_left, at_right = function(left), function(right)
    best, at_best = (
        np.where(np.abs(at_left) < np.abs(at_right), left, right),
        np.fmin(np.abs(at_left), np.abs(at_right)),
    )
    done = at_best == 0
    for step in range(STEPS):
        with np.errstate(divide="ignore", invalid="ignore"):
            point = right - at_right * (right - left) / (at_right - at_left)
        inside = (point >= np.minimum(left, right)) & (point <= np.maximum(left, right))
        halve = ~inside | (step % 4 == 3)
        point = np.where(halve, 0.5 * (left + right), point)
        value = function(point)
        better = np.abs(value) <= at_best
        best, at_best = np.where(better, point, best), np.where(better, np.abs(value), at_best)
        same = np.sign(value) == np.sign(at_right)
        done |= (value == 0) | (np.abs(point - right) <= 2e-16 * np.abs(right)) & ~halve
        left, at_left = np.where(same, left, right), np.where(same, 0.5 * at_left, at_right)
        right, at_right = point, value
        if np.all(done | (np.abs(right - left) <= 4e-16 * np.abs(right))):
            break
    return best
