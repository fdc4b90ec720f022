"""What makes complex values uncertain: noise of its own at every line, and named unknowns that act on many values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape
from shaker.signals.phasor import real_stacked_diagonal

Kind = Literal["A", "B"]
Scope = Literal["recording", "mounting", "rig"]
"""How long an unknown keeps its value: during one recording, until something is mounted anew, or as long as the rig."""


@dataclass(frozen=True)
class Contribution:
    """Noise of C complex values at K lines, independent from line to line and of all other contributions.

    `label` is its line of a budget, `type` A or B as in the GUM, `covariance` (K, 2C, 2C) of [all Re, all Im], NaN
    where a value is not known, `dof` (K,) degrees of freedom, infinite where None.
    """

    label: str
    type: Kind
    covariance: FloatArray
    dof: FloatArray | None = None


@dataclass(frozen=True)
class Influence:
    """One real unknown of standard uncertainty `u` (in `unit`), and what one standard uncertainty does to the values.

    `name` identifies the unknown: equal names are the same unknown, wherever they occur within its `scope`. `label`
    groups unknowns in a budget. `effect` (K, 2C): first-order change of [all Re, all Im], at all lines together.
    """

    name: str
    label: str
    u: float
    unit: str
    effect: FloatArray
    scope: Scope = "recording"
    type: Kind = "B"

    def acting(self, effect: FloatArray) -> Influence:
        """Return the same unknown with another effect."""
        return Influence(self.name, self.label, self.u, self.unit, effect, self.scope, self.type)


@dataclass(frozen=True)
class Uncertainty:
    """Everything that makes C complex values at K lines uncertain: `random` contributions and common `influences`.

    A first-order error of the values is the sum of the random parts and of effect · ε over the influences, with one
    standard normal ε for each name: what two results share is told by their names, and nothing is counted twice.
    """

    random: tuple[Contribution, ...]
    influences: tuple[Influence, ...] = ()

    def __post_init__(self) -> None:
        if not self.random:
            raise ValueError("random: expected at least one contribution, found none")
        lines, size = self.random[0].covariance.shape[:2]
        for part in self.random:
            check_shape(f"covariance of {part.label}", part.covariance, (lines, size, size))
        for influence in self.influences:
            check_shape(f"effect of {influence.name}", influence.effect, (lines, size))
        names = [influence.name for influence in self.influences]
        if len(set(names)) < len(names):
            raise ValueError("influences: expected every name once; add up the effects of one unknown")

    @property
    def covariance(self) -> FloatArray:
        """Return the whole covariance (K, 2C, 2C) of [all Re, all Im], line by line."""
        total = np.sum([part.covariance for part in self.random], axis=0)
        if self.influences:
            effects = np.stack([influence.effect for influence in self.influences])
            total = total + np.einsum("eki,ekj->kij", effects, effects)
        return np.asarray(total)

    def grouped(self) -> tuple[Contribution, ...]:
        """Return one contribution per label, in the order of their first appearance: the lines of a budget."""
        groups: dict[str, list[Influence]] = {}
        for influence in self.influences:
            groups.setdefault(influence.label, []).append(influence)
        parts = list(self.random)
        for label, group in groups.items():
            effects = np.stack([influence.effect for influence in group])
            parts.append(Contribution(label, group[0].type, np.einsum("eki,ekj->kij", effects, effects)))
        return merge_contributions(parts)

    def transformed(self, jacobian: FloatArray) -> Uncertainty:
        """Return the uncertainty of D values that change by `jacobian` (K, 2D, 2C) times these values' changes."""
        random = tuple(
            replace(part, covariance=jacobian @ part.covariance @ jacobian.swapaxes(1, 2)) for part in self.random
        )
        if not self.influences:
            return Uncertainty(random)
        effects = np.einsum("kij,ekj->eki", jacobian, np.stack([influence.effect for influence in self.influences]))
        return Uncertainty(random, tuple(i.acting(effect) for i, effect in zip(self.influences, effects, strict=True)))

    def scaled(self, factor: ComplexArray) -> Uncertainty:
        """Return the uncertainty of the values times complex factors (K, C)."""
        return self.transformed(real_stacked_diagonal(np.asarray(factor, dtype=np.complex128)))

    def plus(self, other: Uncertainty) -> Uncertainty:
        """Return the uncertainty of a sum: noise adds in squares, effects of equal names add as they are."""
        merged = {influence.name: influence for influence in self.influences}
        for influence in other.influences:
            known = merged.get(influence.name)
            total = influence.effect if known is None else known.effect + influence.effect
            merged[influence.name] = (influence if known is None else known).acting(total)
        return Uncertainty(merge_contributions([*self.random, *other.random]), tuple(merged.values()))

    def at(self, values: IntArray | Sequence[int]) -> Uncertainty:
        """Return the uncertainty of some of the C values, by their places."""
        size = self.random[0].covariance.shape[1] // 2
        index = np.asarray(values, dtype=np.int64)
        both = np.concatenate([index, index + size])
        random = tuple(replace(part, covariance=part.covariance[:, both[:, None], both]) for part in self.random)
        return Uncertainty(random, tuple(i.acting(i.effect[:, both]) for i in self.influences))

    def dof(self) -> FloatArray:
        """Return the effective degrees of freedom (K, C) of every value.

        ν = (2V_rr² + V_rr V_ii + V_ri² + 2V_ii²) / Σ (the same of a contribution)/ν_j, which makes the covariance of a
        value scatter as much in all as a sample covariance of ν + 1 complex readings would (Willink & Hall 2002,
        Metrologia 39, 361); contributions of one label are grouped first (JCGM 100, G.4.1).
        """
        total = _scatter(self.covariance)
        weighted = np.zeros_like(total)
        labels = {influence.label for influence in self.influences}
        shared = any(part.label in labels for part in self.random)
        for part in self.grouped() if shared else merge_contributions(self.random):
            if part.dof is not None:
                weighted += _scatter(part.covariance) / np.maximum(part.dof, 1.0)[:, None]
        empty = np.full(total.shape, np.inf)
        return np.asarray(np.divide(total, weighted, out=empty, where=weighted > 0.0))


def _scatter(covariance: FloatArray) -> FloatArray:
    """Sum (K, C) of the variances of the elements of a sample covariance of (Re, Im), per degree of freedom."""
    diagonal = covariance.diagonal(axis1=1, axis2=2)
    size = diagonal.shape[1] // 2
    real, imaginary = diagonal[:, :size], diagonal[:, size:]
    mixed = covariance[:, :size, size:].diagonal(axis1=1, axis2=2)
    return np.asarray(2.0 * real**2 + real * imaginary + mixed**2 + 2.0 * imaginary**2)


def total_variance(covariance: FloatArray) -> FloatArray:
    """Return the sum (K, C) of the variances of Re and Im of every value."""
    diagonal = covariance.diagonal(axis1=1, axis2=2)
    size = diagonal.shape[1] // 2
    return np.asarray(diagonal[:, :size] + diagonal[:, size:])


def merge_contributions(parts: Sequence[Contribution]) -> tuple[Contribution, ...]:
    """Add up contributions of equal label, their degrees of freedom by Welch and Satterthwaite."""
    groups: dict[str, list[Contribution]] = {}
    for part in parts:
        groups.setdefault(part.label, []).append(part)
    return tuple(group[0] if len(group) == 1 else _sum(group) for group in groups.values())


def _sum(group: Sequence[Contribution]) -> Contribution:
    """Sum of independent contributions to the same values."""
    covariance = np.sum([part.covariance for part in group], axis=0)
    if all(part.dof is None for part in group):
        return replace(group[0], covariance=covariance)
    weighted = np.zeros(len(covariance))
    for part in group:
        trace = np.nansum(total_variance(part.covariance), axis=1)
        weighted += trace**2 / (np.inf if part.dof is None else np.maximum(part.dof, 1.0))
    trace = np.nansum(total_variance(covariance), axis=1)
    empty = np.full(len(covariance), np.inf)
    dof = np.divide(trace**2, weighted, out=empty, where=weighted > 0.0)
    return replace(group[0], covariance=covariance, dof=dof)
