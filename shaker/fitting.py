"""Nonlinear least squares: one method of Levenberg and Marquardt, and the elimination of what enters linearly.

Residuals are whitened: of unit variance, or of one unknown variance. A fit is a search over points. A point knows its
parameters, its loss (the sum of squares), and on demand its normal equations; how it comes by them is its own affair:
`Residuals` from a residual and its Jacobian, `Separable` from blocks whose coefficients are projected out (variable
projection; Golub and Pereyra, Inverse Problems 19 (2003) R1, with Kaufman's Jacobian, BIT 15 (1975) 49).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from shaker.arrays import FloatArray, IntArray

_HOPED = 10  # steps as long as the one foretold, after which a search that is not where it is wanted is given up
_NOTHING = 1e-18  # share of the first loss below which no step is worth its while: rounding alone is left
_STILL = 1e-14  # relative change of every parameter below which nothing moves
_MOST_BENT = 0.75  # length of the bend of a step in that of the step
_RANK = 1e-12  # diagonal of a triangle, over its largest element, below which columns depend on one another


class TrialPoint(Protocol):
    """A trial of parameters (P,): its loss, infinite where the parameters are impossible."""

    @property
    def parameters(self) -> FloatArray:
        """Parameters (P,)."""
        ...

    @property
    def loss(self) -> float:
        """Sum of squares of the residual."""
        ...

    @property
    def freedom(self) -> int:
        """Number of data less that of all parameters, linear ones too, at least 1."""
        ...

    @property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """JᵀJ (P, P) and -Jᵀr (P,) of the residual r: a row and column of zeros holds a parameter where it is."""
        ...


P = TypeVar("P", bound=TrialPoint)


@dataclass(frozen=True)
class LMOptions:
    """When a search ends, and how it is damped.

    It ends where a step is foretold to lower the loss by less than max(`foretold`, `foretold_share`·loss), or where one
    did lower it by less than max(`gained`, `gained_share`·loss); where ten steps as long as the one foretold would not
    bring it below `wanted`; after `steps`; or where no step damped by up to `largest`, or by `tries` dampings in a row,
    lowers it. The damping begins at `first`, times `grow` after a step refused, times `shrink` after one taken, never
    below `least`.
    """

    predicted_decrease: float = 0.0
    predicted_decrease_share: float = 1e-10
    actual_decrease: float = 0.0
    actual_decrease_share: float = 0.0
    tolerance: float = np.inf
    max_steps: int = 100
    max_dampings: int = 100
    initial_damping: float = 1e-3
    damping_increase: float = 10.0
    damping_decrease: float = 0.1
    min_damping: float = 1e-9
    max_damping: float = 1e9


@dataclass(frozen=True)
class ParameterPrior:
    """What is known of parameters beforehand: `value` (P,) with standard deviations `u` (P,), infinite where nothing.

    Its weight against the data takes the residual's variance at the present point for that of the data.
    """

    value: FloatArray
    u: FloatArray

    def pull(self, parameters: FloatArray) -> float:
        """Return Σ ((x - value)/u)²."""
        return float(np.sum(((parameters - self.value) / self.u) ** 2))


@dataclass(frozen=True)
class Minimum(Generic[P]):
    """Where a search ended: the point, the losses on the way, and whether it came to rest."""

    point: P
    losses: tuple[float, ...]
    converged: bool


def levenberg_marquardt(
    evaluate: Callable[[FloatArray], P | None],
    start: P,
    options: LMOptions,
    smallest_change: FloatArray | None = None,
    prior: ParameterPrior | None = None,
    curvature: Callable[[P, FloatArray], FloatArray | None] | None = None,
) -> Minimum[P]:
    """Return the least squares next to a start (Marquardt, J. SIAM 11 (1963) 431).

    `evaluate` gives the point of parameters (P,), of others near by where these are beyond a bound, or None where there
    is none. Every parameter is damped by its own curvature, at least by that of `smallest` (P,), the change of it that
    matters, so that one which the data do not tell stays where it is. `curvature`: of a point and a step -Jᵀr'' (P,),
    r'' the residual's second derivative along the step, or None where there is none; after a refusal steps are then
    bent to follow a curved valley (geodesic acceleration: Transtrum and Sethna, arXiv:1201.5885).
    """
    if not np.isfinite(start.loss):
        raise ValueError("start: expected parameters for which all residuals are finite, found others")
    floor = 1e-300 if smallest_change is None else 1.0 / smallest_change**2
    here, damping, losses = start, options.initial_damping, [start.loss]
    for _ in range(options.max_steps):
        normal, downhill = here.normal
        variance = here.loss / here.freedom
        if prior is not None:
            normal = normal + np.diag(variance / prior.u**2)
            downhill = downhill + variance * (prior.value - here.parameters) / prior.u**2
        scale = np.sqrt(np.maximum(np.diag(normal), floor))
        scaled, target = normal / scale / scale[:, None], downhill / scale
        for tried in range(options.max_dampings + 1):
            step = _damped(scaled, target, damping) / scale
            foretold = float(step @ (2.0 * downhill - normal @ step))
            least = max(options.predicted_decrease, options.predicted_decrease_share * here.loss, _NOTHING * losses[0])
            if not tried and here.loss - _HOPED * foretold > options.tolerance:
                return Minimum(here, tuple(losses), False)
            if foretold < least or np.all(np.abs(step) <= _STILL * np.abs(here.parameters)):
                return Minimum(here, tuple(losses), True)
            if tried == options.max_dampings or damping > options.max_damping:
                return Minimum(here, tuple(losses), tried == options.max_dampings)
            taken: FloatArray | None = step
            if tried and curvature is not None and (along := curvature(here, step)) is not None:
                bend = 0.5 * _damped(scaled, along / scale, damping) / scale
                short = np.linalg.norm(bend * scale) <= _MOST_BENT * np.linalg.norm(step * scale)
                taken = step + bend if short else None
            there = None if taken is None else evaluate(here.parameters + taken)
            pull = 0.0 if prior is None or there is None else prior.pull(there.parameters) - prior.pull(here.parameters)
            if there is not None and there.loss + variance * pull < here.loss:
                break
            damping *= options.damping_increase
        assert there is not None
        gained = here.loss - there.loss
        little = gained < max(options.actual_decrease, options.actual_decrease_share * here.loss)
        here, damping = there, max(damping * options.damping_decrease, options.min_damping)
        losses.append(here.loss)
        if little:
            return Minimum(here, tuple(losses), True)
    return Minimum(here, tuple(losses), False)


def _damped(scaled: FloatArray, target: FloatArray, damping: float) -> FloatArray:
    """Return the step of scaled normal equations with a damping of their diagonal."""
    matrix = scaled + damping * np.eye(len(target))
    try:
        return np.asarray(np.linalg.solve(matrix, target))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, target, rcond=None)[0])


@dataclass(frozen=True)
class WhitenedResiduals:
    """A point by its whitened residual r (N,) and Jacobian dr/dx (N, P)."""

    parameters: FloatArray
    residual: FloatArray
    jacobian: FloatArray

    @property
    def loss(self) -> float:
        """Sum of squares."""
        value = float(self.residual @ self.residual)
        return value if np.isfinite(value) else np.inf

    @property
    def freedom(self) -> int:
        """Degrees of freedom, at least 1."""
        return max(1, len(self.residual) - len(self.parameters))

    @property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """Normal equations."""
        return self.jacobian.T @ self.jacobian, -self.jacobian.T @ self.residual


@dataclass(frozen=True)
class LinearElimination:
    """Coefficients (B, C) of a design (N, B) by least squares, what they leave of the data (N, C), `basis` (N, B) of
    the design's columns, and `root` (B, B) with root·rootᵀ = (AᵀA)⁻¹."""

    coefficients: FloatArray
    residual: FloatArray
    basis: FloatArray
    root: FloatArray

    def orthogonal_complement(self, columns: FloatArray) -> FloatArray:
        """Return the part of columns (N, …) that the design cannot take up."""
        table = columns.reshape(len(self.basis), -1)
        return np.asarray(columns - (self.basis @ (self.basis.T @ table)).reshape(columns.shape))


def eliminate(design: FloatArray, data: FloatArray) -> LinearElimination:
    """Return data (N, C) explained by a design (N, B), columns scaled to one length; those that depend share alike."""
    size = np.sqrt(np.einsum("nb,nb->b", design, design))
    size[size == 0.0] = 1.0
    scaled = design / size
    basis, triangle = np.linalg.qr(scaled)
    diagonal = np.abs(np.diag(triangle))
    if diagonal.min(initial=np.inf) < _RANK * diagonal.max(initial=0.0):
        root = np.linalg.pinv(triangle, rcond=_RANK) / size[:, None]
        own = np.linalg.lstsq(scaled, data, rcond=_RANK)[0] / size[:, None]
    else:
        root = np.linalg.inv(triangle) / size[:, None]
        own = root @ (basis.T @ data)
    return LinearElimination(own, data - design @ own, basis, root)


class BlockJacobian(NamedTuple):
    """How fitted rows change, `rows` (N, p, C), with the parameters `places` (p,) that move them.

    Of rows beside a block's own: products of their changes, `beside` (C, p, p), and of these with what is left of the
    data there, `pull` (C, p).
    """

    parameter_index: IntArray
    rows: FloatArray
    complement_normal: FloatArray = np.zeros((1, 1, 1))
    complement_gradient: FloatArray = np.zeros((1, 1))


@dataclass(frozen=True)
class LinearBlock:
    """Rows `design` (N, B) that explain `data` (N, C) by coefficients of their own.

    `changes`: of coefficients (B, C), as `Changes`. Long rows may be given turned, by an orthonormal basis of their
    design: those along it, and of the data beside them, which no coefficients explain, `squares` and number `more`.
    """

    design: FloatArray
    data: FloatArray
    jacobian: Callable[[FloatArray], BlockJacobian]
    extra_squares: float = 0.0
    extra_rows: int = 0


@dataclass(frozen=True)
class SeparablePoint:
    """A point by blocks whose coefficients are projected out; parameters (P,) are those that blocks share."""

    parameters: FloatArray
    blocks: Sequence[LinearBlock]

    @cached_property
    def solved(self) -> tuple[LinearElimination, ...]:
        """Coefficients and residuals of every block."""
        return tuple(eliminate(block.design, block.data) for block in self.blocks)

    @property
    def coefficients(self) -> tuple[FloatArray, ...]:
        """Coefficients (B, C) of every block."""
        return tuple(part.coefficients for part in self.solved)

    @property
    def residuals(self) -> tuple[FloatArray, ...]:
        """What is left of the data (N, C) of every block."""
        return tuple(part.residual for part in self.solved)

    @cached_property
    def loss(self) -> float:
        """Sum of squares, infinite where a design is not finite."""
        if not all(np.all(np.isfinite(block.design)) for block in self.blocks):
            return np.inf
        beside = sum(block.extra_squares for block in self.blocks)
        return float(sum((np.vdot(part.residual, part.residual) for part in self.solved), start=beside))

    @property
    def freedom(self) -> int:
        """Degrees of freedom, at least 1."""
        linear = sum(part.coefficients.size for part in self.solved)
        return max(1, sum(block.data.size + block.extra_rows for block in self.blocks) - linear - len(self.parameters))

    @cached_property
    def jacobians(self) -> tuple[BlockJacobian, ...]:
        """Changes of every block at its best coefficients."""
        pairs = zip(self.blocks, self.solved, strict=True)
        return tuple(block.jacobian(part.coefficients) for block, part in pairs)

    @cached_property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """Normal equations of Kaufman's Jacobian."""
        count = len(self.parameters)
        normal, downhill = np.zeros((count, count)), np.zeros(count)
        for part, (places, rows, beside, pull) in zip(self.solved, self.jacobians, strict=True):
            free = part.orthogonal_complement(rows).transpose(0, 2, 1).reshape(-1, len(places))
            normal[np.ix_(places, places)] += free.T @ free + beside.sum(axis=0)
            downhill[places] += free.T @ part.residual.ravel() + pull.sum(axis=0)
        return normal, downhill


# Minima beside the least one.

NORMAL_QUANTILE_95 = 1.96  # standard uncertainties of 95 %
REJECT_CHI2 = 9.0  # χ² above the least from which a minimum is refuted: three standard deviations


def excess_chi2_sigmas(excess: float) -> float:
    """Return how many standard uncertainties away a minimum is whose χ² is larger than the least by `excess`.

    By the ratio of the likelihoods √excess; one that is as likely is at the end of a 95 % interval.
    """
    return float(np.sqrt(max(excess, NORMAL_QUANTILE_95**2)))


def covariance_root(covariance: FloatArray) -> FloatArray:
    """Return deviations (N, E) by E independent causes of variance one that make up a covariance (N, N).

    It may have directions without spread, which make no cause; numbers may be of any size.
    """
    size = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    scale = np.where(size > 0.0, size, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.multiply.outer(scale, scale))
    spread = variance > _RANK
    return np.asarray(scale[:, None] * axes[:, spread] * np.sqrt(variance[spread]))
