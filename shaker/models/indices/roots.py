"""Roots of a function between pairs of points, all at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from shaker._checks import FloatArray, IntArray

STEPS = 120
TINY = 2.0 * float(np.finfo(np.float64).eps)
"""Share of a root to which it is found."""


def sign_changes(value: FloatArray) -> IntArray:
    """Return the places i at which `value` (N,) changes its sign between i and i + 1, or is 0 at i + 1."""
    positive = value > 0
    return np.asarray(np.flatnonzero(positive[1:] != positive[:-1]), dtype=np.int64)


def roots_between(function: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray) -> FloatArray:
    """Return a root (R,) of a function of (R,) between each `low` and `high`, at which its signs differ.

    Inverse quadratic interpolation where it is safe, else bisection (Chandrupatla, Adv. Eng. Softw. 28 (1997) 145-149),
    to the last digits.
    """
    other, point = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)
    if not len(point):
        return point
    at_other, value = function(other), function(point)
    ahead = np.full(len(point), 0.5)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            new = point + ahead * (other - point)
            at_new = function(new)
            same = np.sign(at_new) == np.sign(value)
            third, at_third = np.where(same, point, other), np.where(same, value, at_other)
            other, at_other = np.where(same, other, point), np.where(same, at_other, value)
            point, value = new, at_new
            best = np.where(np.abs(value) < np.abs(at_other), point, other)
            least = TINY * np.abs(best) / np.abs(other - point)
            if np.all((least > 0.5) | (value == 0) | (at_other == 0)):
                break
            ahead = np.clip(_interpolated((point, other, third), (value, at_other, at_third)), least, 1.0 - least)
    return np.where(value == 0, point, np.where(at_other == 0, other, best))


def _interpolated(place: tuple[FloatArray, ...], value: tuple[FloatArray, ...]) -> FloatArray:
    """Return how far the root lies from the first towards the second of three points (R,), 0.5 where that is unsafe."""
    (a, b, c), (at_a, at_b, at_c) = place, value
    where, level = (a - b) / (c - b), (at_a - at_b) / (at_c - at_b)
    safe = (level**2 < where) & ((1.0 - level) ** 2 < 1.0 - where)
    found = at_a / (at_b - at_a) * at_c / (at_b - at_c)
    found += (c - a) / (b - a) * at_a / (at_c - at_a) * at_b / (at_c - at_b)
    return np.where(safe, found, 0.5)
