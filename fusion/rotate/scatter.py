"""Repeats of a rotation test: what recordings and mountings of one state scatter by beyond what is stated for them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion.repeats import BETWEEN, WITHIN, nested
from shaker._checks import FloatArray


@dataclass(frozen=True)
class Repeats:
    """Recordings of one state, with or without load.

    `recordings`, `mountings` (N,); `within`, `between`: standard deviation in N of a recording's weight and of a
    mounting's beyond what is stated, with N - M and M - 1 degrees of freedom; NaN where there are none.
    """

    state: str
    recordings: tuple[str, ...]
    mountings: tuple[str, ...]
    within: float
    between: float
    within_dof: int
    between_dof: int


@dataclass(frozen=True)
class Carried:
    """What N recordings of one state found: `value` (N, V) and the effect (N, V, r) of every cause of error on it."""

    state: str
    recordings: tuple[str, ...]
    mountings: tuple[str, ...]
    value: FloatArray
    effects: tuple[FloatArray, ...]

    def repeats(self, gradient: FloatArray) -> Repeats:
        """Return how much the number with a gradient (V,) scatters."""
        forms = nested(self.mountings)
        found = dict(components(self, gradient[None]))
        within, between = (float(np.sqrt(found[n].variance[0])) if n in found else np.nan for n in (WITHIN, BETWEEN))
        counts = (forms.within_dof, forms.between_dof)
        return Repeats(self.state, self.recordings, self.mountings, within, between, *counts)


class Component(NamedTuple):
    """Variance (Q,) of one recording or mounting beyond what is stated, and that of the mean.

    `wide`, `dof` (Q,): variance of the mean and its degrees of freedom for the formula of Welch and Satterthwaite.
    """

    variance: FloatArray
    in_mean: FloatArray
    wide: FloatArray
    dof: FloatArray

    def spread_over(self, each: float, share: float) -> Component:
        """Return this per `each` recordings of a mounting, with a share in the mean."""
        factor = share / each
        return Component(self.variance / each, self.variance * factor, self.wide * factor, self.dof)


def components(carried: Carried, gradient: FloatArray) -> Iterator[tuple[str, Component]]:
    """Yield what recordings, then mountings, scatter by in Q numbers, each by itself; `gradient` (Q, V) of the mean.

    One-way random effects, unbalanced: of the mean squares s² between the recordings of a mounting and between the
    mountings, what is stated makes σ², and beyond it are τ² = s² - σ², none where negative (Searle, Casella &
    McCulloch 1992, Variance Components, 3.6). The mean is that of the recordings; where it scatters, its u has the
    N - M or M - 1 = ν degrees of freedom of s². Beside other contributions, effective degrees of freedom follow from
    s² enlarged by its relative variance 2/ν, τ² + 2s²/ν for τ²: with s² itself there are too many wherever few
    readings happen to scatter little, and 95 % intervals of three would hold 92 in 100.
    """
    forms, count = nested(carried.mountings), len(carried.recordings)
    reading = carried.value @ gradient.T
    effects = [np.einsum("qv,nvr->nqr", gradient, effect) for effect in carried.effects]
    known: FloatArray = np.zeros(len(gradient))
    if forms.within_dof:
        within = _beyond(reading, effects, forms.within, forms.within_dof, known)
        known = within.variance
        yield WITHIN, within.spread_over(1.0, 1.0 / count)
    if forms.between_dof:
        found = _beyond(reading, effects, forms.between, forms.between_dof, known)
        share = sum(carried.mountings.count(kind) ** 2 for kind in set(carried.mountings)) / count**2
        yield BETWEEN, found.spread_over(forms.each, share)


def _beyond(
    reading: FloatArray, effects: Sequence[FloatArray], form: FloatArray, dof: int, known: FloatArray
) -> Component:
    """What a mean square of readings (N, Q) exceeds stated errors by, and a variance that is known beyond them."""
    square = np.einsum("nq,nm,mq->q", reading, form, reading) / dof
    stated = sum((np.einsum("nqr,nm,mqr->q", effect, form, effect) for effect in effects), np.zeros(len(square))) / dof
    variance = np.maximum(square - stated - known, 0.0)
    enlarged = np.where(variance > 0.0, square * (1.0 + 2.0 / dof), 1.0)
    wide = np.where(variance > 0.0, variance + square * (2.0 / dof), 0.0)
    return Component(variance, variance, wide, dof * (wide / enlarged) ** 2)
