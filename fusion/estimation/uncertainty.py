"""Uncertain numbers by named unknowns; coverage factors and 95 % regions; magnitude and phase."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from shaker.arrays import BoolArray, ComplexArray, FloatArray, IntArray, check_shape
from shaker.sine.phasor import real_stacked_diagonal

# Coverage: factors that turn standard into expanded uncertainties, and 95 % regions of complex values.


COVERAGE = 0.95
"""Probability with which an interval or a region contains the value."""


ENLARGED = 5.0
"""Over the square of its degrees of freedom: by how much an estimated variance is enlarged in those of a sum."""
LEAST_REGION_DOF = 2.0
"""Degrees of freedom of a complex value below which its region says too little to tell it from zero."""


def coverage_factor(dof: float, coverage: float = COVERAGE) -> float:
    """Return k = t_0.975(dof): ±k·u holds a real value 95 times in 100 (JCGM 100, G.3.2), or as `coverage` says.

    `dof`: effective degrees of freedom, infinite where the uncertainty is known; 1.96 then, infinite below 1e-3.
    """
    from scipy.special import ndtri, stdtrit

    upper = 0.5 + coverage / 2.0
    if np.isinf(dof):
        return float(ndtri(upper))
    return float(stdtrit(dof, upper)) if dof > 1e-3 else np.inf


@dataclass(frozen=True)
class Quantity:
    """A real number with its standard uncertainty, NaN where that is not known, and the degrees of freedom of that."""

    value: float
    u: float
    dof: float
    unit: str

    @property
    def k(self) -> float:
        """Return the coverage factor for 95 %."""
        return coverage_factor(self.dof)

    @property
    def expanded(self) -> float:
        """Return U = k·u."""
        return self.k * self.u


@dataclass(frozen=True)
class NamedQuantity(Quantity):
    """A quantity with its `name` in files and its `label` for readers."""

    name: str
    label: str


def region_factor(dof: float) -> float:
    """Return k₂, so that the ellipse z^T V⁻¹ z ≤ k₂² holds a complex value 95 times in 100.

    k₂² = 2ν/(ν-1)·F_0.95(2, ν-1), chi-square of two degrees of freedom for infinite ν (Willink & Hall 2002,
    Metrologia 39, 361, eq. 5). F(2, n) has the closed quantile n/2·(0.05^(-2/n) - 1), hence k₂² =
    ν·(0.05^(-2/(ν-1)) - 1). Infinite for ν ≤ 1: fewer than two complex readings have no region.
    """
    tail = -2.0 * np.log(1.0 - COVERAGE)
    if np.isinf(dof):
        return float(np.sqrt(tail))
    # Above a power of e^500 the region is infinite for every purpose.
    return float(np.sqrt(dof * np.expm1(tail / (dof - 1.0)))) if dof > 1.0 + tail / 500.0 else np.inf


BENT = 1.716
"""Radial variance that a turn by φ ~ N(0, u²) needs, over u⁴·|X|²: k⁴/(4·(k₂² - k²)) with k = 1.96, k₂² = 5.99.

The turn takes X to X - X·φ²/2 + j·X·φ. An ellipse of the variances c·u⁴·|X|² and u²·|X|² holds all with |φ| ≤ k·u, 95
in 100, where k² + k⁴/(4c) = k₂². The second moment of φ²/2, c = 3/4, makes it 91.7 (both where nothing else is along
X; with anything else 95 to 95.5, and 91.7 to 95).
"""


def region_covariance(value: ComplexArray | complex, covariance: FloatArray, u_turn: ArrayLike = 0.0) -> FloatArray:
    """Return the covariance (..., 2, 2) of which the 95 % regions of complex values (...) are the ellipses.

    First order, `covariance` (..., 2, 2) of (Re, Im), and along the value what that lacks: what turns it, with the
    standard uncertainty `u_turn` (...) of the angle, bends the region (JCGM 100, 5.1.2, note). Magnitude and phase have
    no part in this: neither depends on how far the other is off.
    """
    values, turn = np.asarray(value, dtype=np.complex128), np.asarray(u_turn, dtype=np.float64) ** 2
    along = np.stack([values.real, values.imag], axis=-1)
    further = np.minimum(BENT * turn, 1.0) * turn  # no longer along the value than across
    return np.asarray(covariance + further[..., None, None] * along[..., :, None] * along[..., None, :])


@dataclass(frozen=True)
class Region:
    """The 95 % region of a complex value: an ellipse about it in the complex plane (`region_covariance`).

    `half_axes`: the larger and the smaller one, in the unit of the value; `angle_rad`: of the larger one from the real
    axis, in (-π/2, π/2]; `holds_zero`: whether the origin lies inside, so that amplitude and phase say nothing.
    """

    half_axes: tuple[float, float]
    angle_rad: float
    holds_zero: bool


def region(value: complex, covariance: FloatArray, dof: float = np.inf) -> Region:
    """Return the 95 % region of a complex value with the covariance (2, 2) of (Re, Im), or of `region_covariance`."""
    if not np.all(np.isfinite(covariance)):
        return Region((np.inf, np.inf), 0.0, holds_zero=True)
    variances, axes = np.linalg.eigh(covariance)
    # A direction without uncertainty has no half-axis, whatever the degrees of freedom.
    small, large = (region_factor(dof) * float(np.sqrt(v)) if v > 0.0 else 0.0 for v in variances.tolist())
    turned = np.abs(axes.T @ [value.real, value.imag]).tolist()
    shares = [part / half if half > 0.0 else np.inf for part, half in zip(turned, (small, large), strict=True) if part]
    along = axes[:, 1] * (1.0 if axes[0, 1] > 0.0 or (axes[0, 1] == 0.0 and axes[1, 1] > 0.0) else -1.0)
    angle = float(np.arctan2(along[1], along[0]))
    return Region((large, small), angle, holds_zero=sum(share**2 for share in shares) <= 1.0)


# What makes complex values uncertain: noise of its own at every line, and named unknowns that act on many values.


Kind = Literal["A", "B"]
Distribution = Literal["normal", "uniform"]
Scope = Literal["recording", "start", "mounting", "rig"]
"""How long an unknown keeps its value: during one recording, in all whose recorders start alike beside the trigger (so
that its edges fall on the same places between the samples), until something is mounted anew, or as long as the rig."""


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


Effect = TypeVar("Effect", FloatArray, ComplexArray)


@dataclass(frozen=True)
class Unknown(Generic[Effect]):
    """One real unknown of standard uncertainty `u` (in `unit`), and the first-order `effect` of that on something.

    `name` identifies the unknown: equal names are the same unknown, wherever they occur within its `scope`. `label`
    groups unknowns in a budget. `dof`: degrees of freedom behind `u`, infinite where that is known. `distribution`:
    "uniform" of what is stated as a bound, ±√3·u.
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
        """Return the same unknown as it acts on complex values, by its `effect` (K, 2C) on them."""
        own = self.scope, self.type, self.dof, self.distribution
        return Influence(self.name, self.label, self.u, self.unit, effect, *own)


@dataclass(frozen=True)
class Influence(Unknown[FloatArray]):
    """An unknown that acts on C complex values: `effect` (K, 2C) on [all Re, all Im], at all lines together."""

    effect: FloatArray


AnyUnknown = TypeVar("AnyUnknown", bound=Unknown[Any])


def added_up(unknowns: Iterable[AnyUnknown]) -> tuple[AnyUnknown, ...]:
    """Return every unknown once, the effects of equal names added up."""
    merged: dict[str, AnyUnknown] = {}
    for unknown in unknowns:
        known = merged.get(unknown.name)
        merged[unknown.name] = unknown if known is None else replace(known, effect=known.effect + unknown.effect)
    return tuple(merged.values())


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
        """Return one contribution per label, in the order of their first appearance: the lines of a budget."""
        groups: dict[str, list[Influence]] = {}
        for influence in self.influences:
            groups.setdefault(influence.label, []).append(influence)
        parts = list(self.random)
        for label, group in groups.items():
            freedom = dict.fromkeys(influence.dof for influence in group)
            for dof in freedom:
                effects = np.stack([influence.effect for influence in group if influence.dof == dof])
                square = np.einsum("eki,ekj->kij", effects, effects)
                known = None if np.isinf(dof) else np.full(len(square), dof)
                parts.append(Contribution(label, group[0].type, square, known))
        return merge_contributions(parts)

    def _mapped(
        self, of_covariance: Callable[[FloatArray], FloatArray], of_effect: Callable[[FloatArray], FloatArray]
    ) -> Uncertainty:
        """Map every covariance (K, 2C, 2C), and the effects (E, K, 2C) of all influences at once."""
        random = tuple(replace(part, covariance=of_covariance(part.covariance)) for part in self.random)
        effects = of_effect(np.stack([i.effect for i in self.influences])) if self.influences else ()
        return Uncertainty(random, tuple(i.acting(effect) for i, effect in zip(self.influences, effects, strict=True)))

    def transformed(self, jacobian: FloatArray) -> Uncertainty:
        """Return the uncertainty of D values that change by `jacobian` (K, 2D, 2C) times these values' changes."""
        return self._mapped(
            lambda covariance: jacobian @ covariance @ jacobian.swapaxes(1, 2),
            lambda effects: np.einsum("kij,ekj->eki", jacobian, effects),
        )

    def scaled(self, factor: ComplexArray) -> Uncertainty:
        """Return the uncertainty of the values times complex factors (K, C)."""
        return self.transformed(real_stacked_diagonal(np.asarray(factor, dtype=np.complex128)))

    def plus(self, other: Uncertainty) -> Uncertainty:
        """Return the uncertainty of a sum: noise adds in squares, effects of equal names add as they are."""
        random = merge_contributions([*self.random, *other.random])
        return Uncertainty(random, added_up([*self.influences, *other.influences]))

    def at(self, values: IntArray | Sequence[int]) -> Uncertainty:
        """Return the uncertainty of some of the C values, by their places."""
        size = self.random[0].covariance.shape[1] // 2
        index = np.asarray(values, dtype=np.int64)
        both = np.concatenate([index, index + size])
        return self._mapped(lambda covariance: covariance[:, both[:, None], both], lambda effects: effects[..., both])

    def at_lines(self, lines: IntArray | BoolArray | Sequence[int]) -> Uncertainty:
        """Return the uncertainty of the values at some of the K lines, by their places or by a mask."""
        index = np.asarray(lines)
        random = tuple(
            replace(part, covariance=part.covariance[index], dof=None if part.dof is None else part.dof[index])
            for part in self.random
        )
        effects = np.stack([i.effect for i in self.influences])[:, index] if self.influences else ()
        return Uncertainty(random, tuple(i.acting(effect) for i, effect in zip(self.influences, effects, strict=True)))

    def where_known(self) -> Uncertainty:
        """Return the uncertainty with nothing in place of what is not known (NaN)."""
        return self._mapped(np.nan_to_num, np.nan_to_num)

    def dof(self) -> FloatArray:
        """Return the effective degrees of freedom (K, C) of every value.

        ν = (2V_rr² + V_rr V_ii + V_ri² + 2V_ii²) / Σ (the same of a contribution)/ν_j, which makes the covariance of a
        value scatter as much in all as a sample covariance of ν + 1 complex readings would (Willink & Hall 2002,
        Metrologia 39, 361); contributions of one label are grouped first (JCGM 100, G.4.1).
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
        """Return the effective degrees of freedom (K, C) of every value's part along a `direction` (K, C) or (C,).

        Welch-Satterthwaite (JCGM 100, G.4.1) for the real number Re(x·conj(e)) with e the direction, (Σw)²/Σ(w²/ν),
        w = v·(1 + 5/ν²) instead of the variance v that a contribution has in it: a v of one or two degrees of freedom
        comes out too small too often beside what is known, and the formula with v itself covers 87 (92) in 100 where
        it should 95; so enlarged, 93 to 97 for every share of it (docs/uncertainty.md). Alone, a contribution keeps its
        ν. The degrees of freedom of the complex value where the direction is zero or not known.
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
        """Return the effective degrees of freedom (2, K, C) of magnitude and phase of the values (K, C)."""
        return np.stack([self.dof_along(value), self.dof_along(1j * value)])

    def k_polar(self, value: ComplexArray) -> FloatArray:
        """Return the coverage factors (2, K, C) of magnitude and phase of the values (K, C) for 95 %.

        Those of the degrees of freedom; where bounds are among the influences, what the sum of uniform numbers and of
        the rest needs, the rest taken as normal with its U/1.96.
        """
        bounds = [influence for influence in self.influences if influence.distribution == "uniform"]
        rest = Uncertainty(self.random, tuple(i for i in self.influences if i.distribution == "normal"))
        k = _factors(rest.dof_polar(value))
        if not bounds:
            return k
        size = value.shape[-1]
        effects = np.stack([influence.effect[:, :size] + 1j * influence.effect[:, size:] for influence in bounds])
        unit = np.divide(value, np.abs(value), out=np.ones_like(value), where=np.isfinite(value) & (value != 0.0))
        pair = np.arange(size)[:, None] + [0, size]
        own = rest.covariance[:, pair[:, :, None], pair[:, None, :]]
        for way, direction in enumerate((unit, 1j * unit)):
            widths = np.sqrt(3.0) * np.abs((effects * direction.conj()).real)
            e = np.stack([direction.real, direction.imag], axis=-1)
            u = np.sqrt(np.maximum(np.einsum("kci,kcij,kcj->kc", e, own, e), 0.0))
            for place in np.argwhere(np.isfinite(u) & np.isfinite(k[way]) & (widths.sum(axis=0) > 0.0)).tolist():
                one = (way, *place)
                k[one] = _bounded_factor(widths[:, *place], float(u[*place]), float(k[one]))
        return k

    def u_turn(self, value: ComplexArray) -> FloatArray:
        """Return by what angle (K, C) unknown times turn the values (K, C), as a standard uncertainty in rad.

        Delays, times of clocks and of triggers: what is late by τ is turned by -ωτ, whole, not to first order only.
        """
        times = [as_complex(influence.effect) for influence in self.influences if influence.unit == "s"]
        usable = np.isfinite(value) & (value != 0.0)
        none = np.zeros(value.shape, dtype=np.complex128)
        shares = (np.divide(effect, value, out=none.copy(), where=usable).imag for effect in times)
        return np.asarray(np.sqrt(sum((share**2 for share in shares), np.zeros(value.shape))))


def _factors(dof: FloatArray) -> FloatArray:
    """Return the coverage factor of each number of degrees of freedom (...), NaN where there is none."""
    found = [np.nan if np.isnan(one) else coverage_factor(one) for one in dof.ravel().tolist()]
    return np.array(found, dtype=np.float64).reshape(dof.shape)


_PERIOD, _LAST, _LEAST_WIDTH = 40.0, 300.0, 0.02  # in standard deviations of the sum


def _bounded_factor(widths: FloatArray, u: float, k: float) -> float:
    """Return U/u of a sum of numbers uniform within ± `widths` (N,) and of one with U = k·u, for 95 %.

    P(|s| ≤ U) = 2/π·∫ sin(U·t)/t·φ(t) dt with the characteristic function φ, by the trapezoidal rule, which is that of
    a periodic density: exact but for what lies beyond a period.
    """
    from scipy.optimize import brentq

    whole = float(np.hypot(np.sqrt(np.sum(widths**2) / 3.0), u))
    normal = max(k * u / coverage_factor(np.inf) / whole, _LEAST_WIDTH)
    step = 2.0 * np.pi / _PERIOD
    t = step * np.arange(1.0, _LAST / step)
    phi = np.exp(-0.5 * (normal * t) ** 2) * np.prod(np.sinc(widths[:, None] / whole * t / np.pi), axis=0)
    weight = 2.0 / np.pi * step * phi / t

    def missing(factor: float) -> float:
        return 2.0 * factor / _PERIOD + float(np.sin(factor * t) @ weight) - COVERAGE

    return float(brentq(missing, 0.0, _PERIOD / 2.0)) if normal < _PERIOD / 8.0 else k


def real_design(matrix: ComplexArray) -> FloatArray:
    """Return the real form (..., 2M, 2J) of complex matrices (..., M, J), which acts on [all Re, all Im]."""
    return np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]])


def real_stack(values: ComplexArray) -> FloatArray:
    """Return [all Re, all Im] along the last axis."""
    return np.concatenate([values.real, values.imag], axis=-1)


def as_complex(values: FloatArray) -> ComplexArray:
    """Return the complex values of [all Re, all Im] along the last axis."""
    half = values.shape[-1] // 2
    return np.asarray(values[..., :half] + 1j * values[..., half:])


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


# Complex numbers as magnitude and phase with uncertainty.


UNIFORM_PHASE_U = float(np.pi / np.sqrt(3.0))


@dataclass(frozen=True)
class Polar:
    """A complex value as magnitude and phase in (-pi, pi] and as parts, with standard uncertainties (k = 1).

    `r`: correlation of real and imaginary part; `dof`: effective degrees of freedom of the complex value, for its
    region; `dof_magnitude`, `dof_phase`: those of the real quantities, with their coverage factors for 95 %;
    `u_turn_rad`: what of the phase's uncertainty turns the value, and so bends its region.
    """

    magnitude: float
    phase_rad: float
    u_magnitude: float
    u_phase_rad: float
    re: float
    im: float
    u_re: float
    u_im: float
    r: float
    dof: float
    dof_magnitude: float
    dof_phase: float
    k_magnitude: float
    k_phase: float
    u_turn_rad: float

    @property
    def k(self) -> float:
        """Return the coverage factor of the magnitude for 95 %."""
        return self.k_magnitude

    @property
    def expanded_magnitude(self) -> float:
        """Return U of the magnitude, k·u."""
        return self.k * self.u_magnitude

    @property
    def expanded_phase_rad(self) -> float:
        """Return U of the phase, k·u."""
        return self.k_phase * self.u_phase_rad

    @property
    def region_covariance(self) -> FloatArray:
        """Return the covariance (2, 2) of which the 95 % region of the complex value is the ellipse."""
        mixed = self.r * self.u_re * self.u_im
        first = np.array([[self.u_re**2, mixed], [mixed, self.u_im**2]])
        return region_covariance(complex(self.re, self.im), first, self.u_turn_rad)

    @property
    def region(self) -> Region:
        """Return the 95 % region of the complex value.

        Of two complex readings and fewer there is none, yet intervals of magnitude and phase there are: then zero is in
        it unless the interval of the magnitude for 97.5 % ends before (Bonferroni, with one as large across).
        """
        found = region(complex(self.re, self.im), self.region_covariance, self.dof)
        if self.dof >= LEAST_REGION_DOF or not self.u_magnitude > 0.0:
            return found
        half = coverage_factor(self.dof_magnitude, (1.0 + COVERAGE) / 2.0) * self.u_magnitude
        return replace(found, holds_zero=bool(half >= self.magnitude))


def polar(
    value: complex,
    covariance: FloatArray,
    dof: float = np.inf,
    dof_polar: tuple[float, float] | None = None,
    k_polar: tuple[float, float] | None = None,
    u_turn: float = 0.0,
) -> Polar:
    """First-order propagation of the covariance (2, 2) of (Re, Im) of `value` to magnitude and phase.

    u(|X|)^2 = e^T V e with e = (Re, Im)/|X|, u(arg X)^2 = n^T V n / |X|^2 with n = (-Im, Re)/|X| (JCGM 102, 9.4).
    Where |X| is of the order of its uncertainty the expansion fails: u(arg X) is capped at pi/sqrt(3), the standard
    deviation of a phase of which nothing is known, and at X = 0 u(|X|) is that of the mean direction. `dof`: of the
    complex value; `dof_polar`: of magnitude and phase, `dof` by default; `k_polar`: their coverage factors, by default
    those of `dof_polar`; `u_turn`: see `Polar`.
    """
    re, im = float(value.real), float(value.imag)
    magnitude = float(np.hypot(re, im))
    u_re, u_im = (float(u) for u in np.sqrt(np.diag(covariance)))
    r = float(covariance[0, 1]) / (u_re * u_im) if u_re * u_im > 0.0 else 0.0
    if magnitude == 0.0:
        u_magnitude, u_phase = float(np.sqrt(np.trace(covariance) / 2.0)), UNIFORM_PHASE_U
    elif np.isnan(covariance).any():
        u_magnitude = u_phase = float("nan")
    else:
        along, across = np.array([re, im]) / magnitude, np.array([-im, re]) / magnitude
        u_magnitude = float(np.sqrt(max(float(along @ covariance @ along), 0.0)))
        turned = float(np.sqrt(max(float(across @ covariance @ across), 0.0)))
        u_phase = min(turned / magnitude, UNIFORM_PHASE_U)
    # An imaginary part of -0 does not turn pi into -pi.
    phase, freedom = float(np.arctan2(im + 0.0, re)), (dof, dof) if dof_polar is None else dof_polar
    factors = (coverage_factor(freedom[0]), coverage_factor(freedom[1])) if k_polar is None else k_polar
    return Polar(magnitude, phase, u_magnitude, u_phase, re, im, u_re, u_im, r, dof, *freedom, *factors, u_turn)


def polar_elements(
    value: ComplexArray, uncertainty: Uncertainty, covariance: FloatArray | None = None
) -> list[list[Polar | None]]:
    """Return complex values (K, C) with their uncertainty as magnitude and phase, None where a value is not known.

    `covariance` (K, 2C, 2C): that of `uncertainty`, where it has been added up already.
    """
    covariance = uncertainty.covariance if covariance is None else covariance
    dof, turn = uncertainty.dof(), uncertainty.u_turn(value)
    along, factors = uncertainty.dof_polar(value), uncertainty.k_polar(value)
    lines: list[list[Polar | None]] = [[None] * len(row) for row in value]
    for k, c in np.argwhere(np.isfinite(value)).tolist():
        pair, both = element_covariance(covariance[k], c), (float(along[0, k, c]), float(along[1, k, c]))
        k_both = float(factors[0, k, c]), float(factors[1, k, c])
        lines[k][c] = polar(complex(value[k, c]), pair, float(dof[k, c]), both, k_both, float(turn[k, c]))
    return lines


def element_covariance(covariance: FloatArray, element: int) -> FloatArray:
    """Covariance (2, 2) of (Re, Im) of one element of a real-stacked covariance (2M, 2M)."""
    pair = [element, element + covariance.shape[-1] // 2]
    return covariance[np.ix_(pair, pair)]
