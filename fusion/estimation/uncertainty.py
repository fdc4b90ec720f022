"""Uncertainty of complex values: random contributions and named unknowns, propagated with their degrees of freedom."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from fusion.estimation.coverage import (
    Polar,
    along_and_across,
    bounded_factor,
    counted_covariance,
    coverage_factor,
    polar,
    region_matrix,
)
from shaker.sine.phasor import real_stacked_diagonal
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray, check_shape

ENLARGED = 5.0
"""Enlargement of an estimated variance in a sum, over the square of its degrees of freedom (set by simulation)."""

Kind = Literal["A", "B"]
Distribution = Literal["normal", "uniform"]
Scope = Literal["recording", "start", "mounting", "rig"]
"""How long an unknown keeps its value: one recording; all recordings whose recorders start equally relative to the
trigger (its edges then have the same positions between samples); until a new mounting; as long as the rig."""


@dataclass(frozen=True)
class Contribution:
    """Independent noise of C complex values at K lines.

    It is independent from line to line and of all other contributions. `label`: its line of a budget. `type`: A or B as
    in the GUM. `covariance` (K, 2C, 2C) of [all Re, all Im], NaN where a value is not known. `dof` (K,): degrees of
    freedom, None for infinite.
    """

    label: str
    type: Kind
    covariance: FloatArray
    dof: FloatArray | None = None


Effect = TypeVar("Effect", FloatArray, ComplexArray)


@dataclass(frozen=True)
class Unknown(Generic[Effect]):
    """One real unknown of standard uncertainty `u` and its first-order `effect`.

    `name` identifies the unknown: within its `scope` equal names are one unknown. `u` is in `unit`. `label` groups
    unknowns in a budget. `dof`: degrees of freedom of `u`, infinite if that is exact. `distribution`: "uniform" for a
    stated bound ±√3·u.
    """

    name: str
    label: str
    u: float
    unit: str
    effect: Effect
    scope: Scope = "recording"
    type: Kind = "B"
    dof: float = np.inf
    distribution: Distribution = "normal"

    def acting(self, effect: FloatArray) -> Influence:
        """Return the same unknown with another `effect` (K, 2C), on complex values."""
        attributes = self.scope, self.type, self.dof, self.distribution
        return Influence(self.name, self.label, self.u, self.unit, effect, *attributes)


@dataclass(frozen=True)
class Influence(Unknown[FloatArray]):
    """An unknown with its `effect` (K, 2C) on [all Re, all Im] at all lines."""

    effect: FloatArray


AnyUnknown = TypeVar("AnyUnknown", bound=Unknown[Any])


def added_up(unknowns: Iterable[AnyUnknown]) -> tuple[AnyUnknown, ...]:
    """Return every unknown once, the effects of equal names added up."""
    merged: dict[str, AnyUnknown] = {}
    for unknown in unknowns:
        earlier = merged.get(unknown.name)
        merged[unknown.name] = unknown if earlier is None else replace(earlier, effect=earlier.effect + unknown.effect)
    return tuple(merged.values())


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of C complex values at K lines: `random` contributions and common `influences`.

    A first-order error of the values is the sum of the random parts and of effect · ε over the influences. Each name
    has one standard normal ε, so that two results share an unknown by its name and count it once.
    """

    random: tuple[Contribution, ...]
    influences: tuple[Influence, ...] = ()

    def __post_init__(self) -> None:
        if not self.random:
            raise ValueError("random: expected at least one contribution, found none")
        lines, size = self.random[0].covariance.shape[:2]
        for part in self.random:
            check_shape(f"covariance of {part.label}", part.covariance, (lines, size, size))
            if part.dof is not None:
                check_shape(f"dof of {part.label}", part.dof, (lines,))
        for influence in self.influences:
            if influence.effect.shape != (lines, size):
                check_shape(f"effect of {influence.name}", influence.effect, (lines, size))
        if len({influence.name for influence in self.influences}) < len(self.influences):
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
        """Return one contribution per label, in order: the lines of a budget."""
        groups: dict[str, list[Influence]] = {}
        for influence in self.influences:
            groups.setdefault(influence.label, []).append(influence)
        parts = list(self.random)
        for label, group in groups.items():
            freedom = dict.fromkeys(influence.dof for influence in group)
            for dof in freedom:
                effects = np.stack([influence.effect for influence in group if influence.dof == dof])
                square = np.einsum("eki,ekj->kij", effects, effects)
                finite_dof = None if np.isinf(dof) else np.full(len(square), dof)
                parts.append(Contribution(label, group[0].type, square, finite_dof))
        return merge_contributions(parts)

    def _mapped(
        self, of_covariance: Callable[[FloatArray], FloatArray], of_effect: Callable[[FloatArray], FloatArray]
    ) -> Uncertainty:
        """Map all covariances (K, 2C, 2C) and all effects (E, K, 2C) of influences."""
        random = tuple(replace(part, covariance=of_covariance(part.covariance)) for part in self.random)
        effects = of_effect(np.stack([i.effect for i in self.influences])) if self.influences else ()
        return Uncertainty(random, tuple(i.acting(effect) for i, effect in zip(self.influences, effects, strict=True)))

    def transformed(self, jacobian: FloatArray) -> Uncertainty:
        """Return the uncertainty of values that are linear in these by a `jacobian`."""
        return self._mapped(
            lambda covariance: jacobian @ covariance @ jacobian.swapaxes(1, 2),
            lambda effects: np.einsum("kij,ekj->eki", jacobian, effects),
        )

    def scaled(self, factor: ComplexArray) -> Uncertainty:
        """Return the uncertainty of the values times complex factors (K, C)."""
        return self.transformed(real_stacked_diagonal(np.asarray(factor, dtype=np.complex128)))

    def relative_to(self, value: ComplexArray) -> Uncertainty:
        """Return the uncertainty of ln|X| and arg X of values X (K, C).

        dX/X = d ln|X| + j d arg X (JCGM 102, 9.4); NaN for zero.
        """
        usable = np.isfinite(value) & (value != 0.0)
        return self.scaled(np.divide(1.0, value, out=np.full(value.shape, complex(np.nan, np.nan)), where=usable))

    def plus(self, other: Uncertainty) -> Uncertainty:
        """Return the uncertainty of a sum; effects of equal names add linearly."""
        random = merge_contributions([*self.random, *other.random])
        return Uncertainty(random, added_up([*self.influences, *other.influences]))

    def at(self, values: IntArray | Sequence[int]) -> Uncertainty:
        """Return the uncertainty of some of the C values, by their places."""
        size = self.random[0].covariance.shape[1] // 2
        index = np.asarray(values, dtype=np.int64)
        both = np.concatenate([index, index + size])
        return self._mapped(lambda covariance: covariance[:, both[:, None], both], lambda effects: effects[..., both])

    def at_lines(self, lines: IntArray | BoolArray | Sequence[int]) -> Uncertainty:
        """Return the uncertainty at some of the K lines, by indices or mask."""
        index = np.asarray(lines)
        random = tuple(
            replace(part, covariance=part.covariance[index], dof=None if part.dof is None else part.dof[index])
            for part in self.random
        )
        effects = np.stack([i.effect for i in self.influences])[:, index] if self.influences else ()
        return Uncertainty(random, tuple(i.acting(effect) for i, effect in zip(self.influences, effects, strict=True)))

    def nan_as_zero(self) -> Uncertainty:
        """Return the uncertainty with zero for values that are not known (NaN)."""
        return self._mapped(np.nan_to_num, np.nan_to_num)

    def dof(self) -> FloatArray:
        """Return the effective degrees of freedom (K, C) of every value.

        ν = (2V_rr² + V_rr V_ii + V_ri² + 2V_ii²) / Σ (the same of a contribution)/ν_j. The covariance of a value then
        scatters like a sample covariance of ν + 1 complex readings (Willink & Hall 2002, Metrologia 39, 361).
        Contributions of one label are grouped first (JCGM 100, G.4.1).
        """
        total = _scatter(self.covariance)
        weighted = np.zeros_like(total)
        labels = {influence.label for influence in self.influences}
        estimated = any(np.isfinite(influence.dof) for influence in self.influences)
        shared = estimated or any(part.label in labels for part in self.random)
        for part in self.grouped() if shared else merge_contributions(self.random):
            if part.dof is not None:
                weighted += _scatter(part.covariance) / np.maximum(part.dof, 1.0)[:, None]
        empty = np.full(total.shape, np.inf)
        return np.asarray(np.divide(total, weighted, out=empty, where=weighted > 0.0))

    def dof_along(self, direction: ComplexArray) -> FloatArray:
        """Return the effective degrees of freedom (K, C) along a `direction` (K, C) or (C,).

        Welch-Satterthwaite (JCGM 100, G.4.1) for the real number Re(x·conj(e)) with the direction e: (Σw)²/Σ(w²/ν). w =
        v·(1 + 5/ν²) replaces the variance v of a contribution, because a v of one or two degrees of freedom is too
        often underestimated relative to exact ones. The formula with v covers 87 (92) % instead of 95 %; with w it
        covers 93 to 97 % for every share (docs/uncertainty.md). A single contribution keeps its ν. Where the direction
        is zero or not known, the degrees of freedom are those of the complex value.
        """
        usable = np.isfinite(direction) & (direction != 0.0)
        unit = np.divide(direction, np.abs(direction), out=np.zeros_like(direction), where=usable)
        lines, size = self.random[0].covariance.shape[:2]
        unit = np.broadcast_to(unit, (lines, size // 2))
        real, imaginary = unit.real, unit.imag
        total, weighted = np.zeros(unit.shape), np.zeros(unit.shape)

        def add(variance: FloatArray, dof: FloatArray) -> None:
            """Take in variances (K, C) with degrees of freedom (K, 1)."""
            nonlocal total, weighted
            freedom = np.maximum(dof, 1.0)
            wide = variance * (1.0 + ENLARGED / freedom**2)
            total, weighted = total + wide, weighted + wide**2 / freedom

        for part in self.random:
            two = part.covariance.reshape(lines, 2, size // 2, 2, size // 2).diagonal(axis1=2, axis2=4)
            along = real**2 * two[:, 0, 0] + 2.0 * real * imaginary * two[:, 0, 1] + imaginary**2 * two[:, 1, 1]
            add(along, np.full((lines, 1), np.inf) if part.dof is None else part.dof[:, None])
        for dof in dict.fromkeys(influence.dof for influence in self.influences):
            effects = np.stack([influence.effect for influence in self.influences if influence.dof == dof])
            along = real * effects[..., : size // 2] + imaginary * effects[..., size // 2 :]
            # Unknowns of one number of degrees of freedom are independent: each enters by itself.
            for squares in along**2 if np.isfinite(dof) else [np.sum(along**2, axis=0)]:
                add(squares, np.full((lines, 1), dof))
        empty = np.full(unit.shape, np.inf)
        found = np.divide(total**2, weighted, out=empty, where=weighted > 0.0)
        return np.asarray(found if usable.all() else np.where(np.broadcast_to(usable, found.shape), found, self.dof()))

    def dof_polar(self, value: ComplexArray) -> FloatArray:
        """Return the effective degrees of freedom (2, K, C) of magnitude and phase of `value`."""
        return np.stack([self.dof_along(value), self.dof_along(1j * value)])

    def k_polar(self, value: ComplexArray, dof_polar: FloatArray | None = None) -> FloatArray:
        """Return the coverage factors (2, K, C) of magnitude and phase for 95 %.

        Of `value` (K, C). They follow from the degrees of freedom. If bounds are among the influences, they are those
        of the sum of uniform numbers and a normal rest of its U/1.96. `dof_polar`: of `value`, if already computed.
        """
        bounds = [influence for influence in self.influences if influence.distribution == "uniform"]
        if not bounds:
            return _factors(self.dof_polar(value) if dof_polar is None else dof_polar)
        rest = Uncertainty(self.random, tuple(i for i in self.influences if i.distribution == "normal"))
        k = _factors(rest.dof_polar(value))
        size = value.shape[-1]
        effects = np.stack([influence.effect[:, :size] + 1j * influence.effect[:, size:] for influence in bounds])
        unit = np.divide(value, np.abs(value), out=np.ones_like(value), where=np.isfinite(value) & (value != 0.0))
        covariances = element_covariances(rest.covariance)
        for part_index, direction in enumerate((unit, 1j * unit)):
            widths = np.sqrt(3.0) * np.abs((effects * direction.conj()).real)
            e = np.stack([direction.real, direction.imag], axis=-1)
            u = np.sqrt(np.maximum(np.einsum("kci,kcij,kcj->kc", e, covariances, e), 0.0))
            for index in np.argwhere(np.isfinite(u) & np.isfinite(k[part_index]) & (widths.sum(axis=0) > 0.0)).tolist():
                one = (part_index, *index)
                k[one] = bounded_factor(widths[:, *index], float(u[*index]), float(k[one]))
        return k

    def regions(
        self, value: ComplexArray, covariance: FloatArray | None = None, dof_polar: FloatArray | None = None
    ) -> FloatArray:
        """Return the matrices (K, C, 2, 2) of the 95 % regions of `value` (`coverage.region_matrix`).

        The parts along and across a value have separate degrees of freedom. The covariance between them is used as far
        as it is significant. `covariance`, `dof_polar`: of `value`, if already computed.
        """
        frame = along_and_across(value)
        whole = element_covariances(self.covariance if covariance is None else covariance)
        mixed = (frame.swapaxes(-1, -2) @ whole @ frame)[..., 0, 1]
        for part in self.random:
            if part.dof is not None:
                rotated = frame.swapaxes(-1, -2) @ element_covariances(part.covariance) @ frame
                mixed += counted_covariance(rotated, part.dof[:, None]) - rotated[..., 0, 1]
        freedom = self.dof_polar(value) if dof_polar is None else dof_polar
        return region_matrix(value, whole, freedom, mixed, self._turn(value))

    def _turn(self, value: ComplexArray) -> FloatArray:
        """Return the standard uncertainty (K, C) in rad by which unknown times turn `value`.

        Delays, times of clocks and of triggers: a time error τ turns a value by -ωτ exactly, not only to first order.
        """
        times = [as_complex(influence.effect) for influence in self.influences if influence.unit == "s"]
        usable = np.isfinite(value) & (value != 0.0)
        none = np.zeros(value.shape, dtype=np.complex128)
        shares = (np.divide(effect, value, out=none.copy(), where=usable).imag for effect in times)
        return np.asarray(np.sqrt(sum((share**2 for share in shares), np.zeros(value.shape))))


def _factors(dof: FloatArray) -> FloatArray:
    """Return the coverage factor of each number of degrees of freedom, or NaN."""
    found = [np.nan if np.isnan(one) else coverage_factor(one) for one in dof.ravel().tolist()]
    return np.array(found, dtype=np.float64).reshape(dof.shape)


def real_stack(values: ComplexArray) -> FloatArray:
    """Return [all Re, all Im] along the last axis."""
    return np.concatenate([values.real, values.imag], axis=-1)


def as_complex(values: FloatArray) -> ComplexArray:
    """Return the complex values of [all Re, all Im] along the last axis."""
    half = values.shape[-1] // 2
    return np.asarray(values[..., :half] + 1j * values[..., half:])


def _scatter(covariance: FloatArray) -> FloatArray:
    """Return the sum (K, C) of variances of a sample covariance, per degree of freedom."""
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
    merged = []
    for group in groups.values():
        covariance = group[0].covariance if len(group) == 1 else np.sum([part.covariance for part in group], axis=0)
        dof = group[0].dof
        if len(group) > 1 and any(part.dof is not None for part in group):
            weighted = np.zeros(len(covariance))
            for part in group:
                trace = np.nansum(total_variance(part.covariance), axis=1)
                weighted += trace**2 / (np.inf if part.dof is None else np.maximum(part.dof, 1.0))
            trace = np.nansum(total_variance(covariance), axis=1)
            dof = np.divide(trace**2, weighted, out=np.full(len(covariance), np.inf), where=weighted > 0.0)
        merged.append(replace(group[0], covariance=covariance, dof=dof))
    return tuple(merged)


def polar_elements(
    value: ComplexArray, uncertainty: Uncertainty, covariance: FloatArray | None = None
) -> list[list[Polar | None]]:
    """Return complex values (K, C) as magnitude and phase with their uncertainty.

    None where a value is not known. `covariance` (K, 2C, 2C): the sum of `uncertainty`, if already computed.
    """
    covariance = uncertainty.covariance if covariance is None else covariance
    dof, along = uncertainty.dof(), uncertainty.dof_polar(value)
    region, factors = uncertainty.regions(value, covariance, along), uncertainty.k_polar(value, along)
    lines: list[list[Polar | None]] = [[None] * len(row) for row in value]
    for k, c in np.argwhere(np.isfinite(value)).tolist():
        pair, both = element_covariance(covariance[k], c), (float(along[0, k, c]), float(along[1, k, c]))
        k_both = float(factors[0, k, c]), float(factors[1, k, c])
        lines[k][c] = polar(complex(value[k, c]), pair, float(dof[k, c]), both, k_both, region[k, c])
    return lines


def over_static(
    value: ComplexArray, uncertainty: Uncertainty, static: FloatArray, u_static: FloatArray, names: Sequence[str]
) -> tuple[ComplexArray, Uncertainty]:
    """Return sensitivities (K, E) over static values (E,) and the uncertainty of these ratios.

    `u_static` (E,): standard uncertainties of the static values, each one unknown for all K lines. `names` (E,) of the
    elements, such as `Fz/Fz`; a correction by the static matrix uses the same names.
    """
    ratio, factor = np.asarray(value / static), np.broadcast_to(1.0 / static + 0.0j, value.shape)
    references = []
    for e, name in ((e, name) for e, name in enumerate(names) if u_static[e] > 0.0):
        change = np.zeros(ratio.shape, np.complex128)
        change[:, e] = -u_static[e] / abs(static[e]) * np.nan_to_num(ratio[:, e])  # too small where static is too large
        label = "static sensitivity"
        references.append(Influence(f"{label} {name}", label, float(u_static[e]), "", real_stack(change), "rig"))
    scaled = uncertainty.scaled(factor)
    return ratio, Uncertainty(scaled.random, added_up([*scaled.influences, *references]))


def element_covariances(covariance: FloatArray) -> FloatArray:
    """Return the covariances (K, C, 2, 2) of elements from real-stacked ones."""
    size = covariance.shape[-1] // 2
    pair = np.arange(size)[:, None] + [0, size]
    return covariance[:, pair[:, :, None], pair[:, None, :]]


def element_covariance(covariance: FloatArray, element: int) -> FloatArray:
    """Covariance (2, 2) of (Re, Im) of one element of a real-stacked covariance (2M, 2M)."""
    pair = [element, element + covariance.shape[-1] // 2]
    return covariance[np.ix_(pair, pair)]
