"""What is left of a system whose coefficients were rounded."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from shaker._checks import FloatArray, check_shape

POINTS = 129
SCAN = 20001
MOST = 10


@dataclass(frozen=True)
class RoundingRange:
    """Natural frequency in Hz of the lowest mode and the largest |z| of a pole over all that rounding permits.

    `natural_hz` (2,): lowest and highest, NaN where no system of the box oscillates; `always_oscillates`: whether every
    system does; `radius`: unstable systems are among them if it is 1 or more.
    """

    natural_hz: FloatArray
    always_oscillates: bool
    radius: float


def rounding_range(denominator: FloatArray, last_digit: FloatArray, sample_rate_hz: float) -> RoundingRange:
    """Return what a0 + a1 z⁻¹ + … + an z⁻ⁿ (n + 1,) may stand for, each coefficient rounded to a `last_digit` (n + 1,).

    0 as last digit of one that is exact. The extremes of the roots lie on the edges of the box of coefficients
    (Bartlett, Hollot, Lin, Math. Control Signals Systems 1 (1988) 61-71), each looked at in 129 points, or where two
    roots meet on the real axis.
    """
    centre, half = np.asarray(denominator, dtype=np.float64), 0.5 * np.asarray(last_digit, dtype=np.float64)
    check_shape("last_digit", half, centre.shape)
    if not 1 < len(centre) <= MOST + 1:
        raise ValueError(f"denominator: expected 2 to {MOST + 1} coefficients, found {len(centre)}")
    if not sample_rate_hz > 0:
        raise ValueError(f"sample_rate_hz: expected a positive number, found {sample_rate_hz}")
    lowest, largest = [], []
    for edge in _edges(half):
        z = np.roots(centre + edge)
        largest.append(float(np.max(np.abs(z))))
        upper = z[z.imag > 1e-9 * np.abs(z)]
        lowest.append(float(np.min(np.abs(np.log(upper)), initial=np.inf)) * sample_rate_hz / (2 * np.pi))
    found = np.array(lowest)
    seen, always = found[np.isfinite(found)], bool(np.all(np.isfinite(found)))
    if not always:
        seen = np.concatenate([seen, _doubled(centre, half) * sample_rate_hz / (2 * np.pi)])
    ends = np.array([seen.min(), seen.max()]) if len(seen) else np.full(2, np.nan)
    return RoundingRange(ends, always, max(largest))


def _doubled(centre: FloatArray, half: FloatArray) -> FloatArray:
    """Return |ln z| (K,) of double roots z > 0 that the box has, on a fine grid.

    p(z) = 0 and p'(z) = 0 have a solution in the box if and only if, for the power k of every free coefficient,
    |Σ (k - j) c_j z^j| ≤ Σ half_j |k - j| z^j (Farkas: the two equations combined so that c_k drops out).
    """
    decay = np.geomspace(1e-5, 10.0, SCAN)
    decay = np.concatenate([decay, -decay])
    power = np.arange(len(centre) - 1, -1, -1.0)
    terms = np.exp(-np.outer(decay, power))
    possible = np.ones(len(decay), dtype=bool)
    for k in power[half > 0]:
        possible &= np.abs(terms @ ((k - power) * centre)) <= terms @ (np.abs(k - power) * half)
    return np.asarray(np.abs(decay[possible]))


def _edges(half: FloatArray) -> FloatArray:
    """Return points (E, n + 1) on all edges of a box about 0."""
    free = np.flatnonzero(half)
    parts = [np.zeros((1, len(half)))]
    for moving in free:
        others = [i for i in free if i != moving]
        for signs in product((-1.0, 1.0), repeat=len(others)):
            points = np.zeros((POINTS, len(half)))
            points[:, others] = np.array(signs) * half[others]
            points[:, moving] = np.linspace(-half[moving], half[moving], POINTS)
            parts.append(points)
    return np.concatenate(parts)
