"""Nonlinear least squares: Levenberg-Marquardt and variable projection.

Residuals are whitened: they have unit variance, or one unknown variance. A fit is a search over points. A point has
parameters, a loss (the sum of squares) and, on demand, normal equations. `WhitenedResiduals` makes them from a residual
and its Jacobian. `SeparablePoint` makes them from blocks whose coefficients are projected out (variable projection;
Golub and Pereyra, Inverse Problems 19 (2003) R1, with Kaufman's Jacobian, BIT 15 (1975) 49).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from shakercal._common.arrays import FloatArray, IntArray

_MAX_PREDICTED_STEPS = 10  # predicted decreases within which a search must reach its tolerance; chosen
_ROUNDING_SHARE = 1e-18  # share of the first loss below which a decrease is rounding
_MIN_RELATIVE_STEP = 1e-14  # relative change of every parameter below which a step is rounding
_MAX_BEND = 0.75  # largest length of a step's bend over that of the step (Transtrum and Sethna 2012)
_RANK = 1e-12  # diagonal of a triangle, over its largest element, below which columns depend on one another


class TrialPoint(Protocol):
    """Trial parameters (P,) with their loss, which is infinite where the parameters are impossible."""

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
        """Number of data minus that of all parameters, linear ones too; at least 1."""
        ...

    @property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """Matrix JᵀJ (P, P) and vector -Jᵀr (P,) of the residual r.

        A row and column of zeros fixes a parameter.
        """
        ...


P = TypeVar("P", bound=TrialPoint)


@dataclass(frozen=True)
class LMOptions:
    """Rules for damping and for ending a Levenberg-Marquardt search.

    Attributes
    ----------
    predicted_decrease, predicted_decrease_share : the search has converged when a step is predicted to lower the loss
        by less than max(`predicted_decrease`, `predicted_decrease_share`·loss).
    actual_decrease, actual_decrease_share : the same limit for the decrease that a step has achieved.
    tolerance : largest acceptable loss; the search is given up when ten predicted decreases would not reach it.
    max_steps : number of steps after which the search ends.
    max_dampings : number of dampings in a row that are tried for one step.
    initial_damping : damping of the first step.
    damping_increase, damping_decrease : factor of the damping after a refused step, and after an accepted one.
    min_damping, max_damping : limits of the damping.
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
    """Prior knowledge of parameters: `value` (P,) with standard uncertainties `u` (P,), infinite where unknown.

    Its weight relative to the data uses the variance of the residual at the present point.
    """

    value: FloatArray
    u: FloatArray

    def pull(self, parameters: FloatArray) -> float:
        """Return Σ ((x - value)/u)²."""
        return float(np.sum(((parameters - self.value) / self.u) ** 2))


@dataclass(frozen=True)
class Minimum(Generic[P]):
    """Result of a search: last point, losses of all steps, and whether it converged."""

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
    """Return the least-squares solution near a start (Marquardt, J. SIAM 11 (1963) 431).

    `evaluate` returns the point of parameters (P,), None where there is none, or the point at a bound that the
    parameters exceed. Every parameter is damped by its curvature, at least by that of `smallest_change` (P,), the
    change of it that matters. A parameter that the data do not determine therefore keeps its value. `curvature`
    returns, for a point and a step, -Jᵀr'' (P,) with the second derivative r'' of the residual along the step, or None.
    After a refused step the following ones are bent along a curved valley (geodesic acceleration: Transtrum and Sethna,
    arXiv:1201.5885).
    """
    if not np.isfinite(start.loss):
        raise ValueError("start: expected parameters for which all residuals are finite, found others")
    floor = 1e-300 if smallest_change is None else 1.0 / smallest_change**2
    point, damping, losses = start, options.initial_damping, [start.loss]
    for _ in range(options.max_steps):
        normal, downhill = point.normal
        variance = point.loss / point.freedom
        if prior is not None:
            normal = normal + np.diag(variance / prior.u**2)
            downhill = downhill + variance * (prior.value - point.parameters) / prior.u**2
        scale = np.sqrt(np.maximum(np.diag(normal), floor))
        scaled, target = normal / scale / scale[:, None], downhill / scale
        for tried in range(options.max_dampings + 1):
            step = _damped_step(scaled, target, damping) / scale
            predicted = float(step @ (2.0 * downhill - normal @ step))
            limit = max(
                options.predicted_decrease, options.predicted_decrease_share * point.loss, _ROUNDING_SHARE * losses[0]
            )
            if not tried and point.loss - _MAX_PREDICTED_STEPS * predicted > options.tolerance:
                return Minimum(point, tuple(losses), False)
            if predicted < limit or np.all(np.abs(step) <= _MIN_RELATIVE_STEP * np.abs(point.parameters)):
                return Minimum(point, tuple(losses), True)
            if tried == options.max_dampings or damping > options.max_damping:
                return Minimum(point, tuple(losses), tried == options.max_dampings)
            proposed: FloatArray | None = step
            if tried and curvature is not None and (along := curvature(point, step)) is not None:
                bend = 0.5 * _damped_step(scaled, along / scale, damping) / scale
                short = np.linalg.norm(bend * scale) <= _MAX_BEND * np.linalg.norm(step * scale)
                proposed = step + bend if short else None
            trial = None if proposed is None else evaluate(point.parameters + proposed)
            pull = (
                0.0 if prior is None or trial is None else prior.pull(trial.parameters) - prior.pull(point.parameters)
            )
            if trial is not None and trial.loss + variance * pull < point.loss:
                break
            damping *= options.damping_increase
        assert trial is not None
        decrease = point.loss - trial.loss
        converged = decrease < max(options.actual_decrease, options.actual_decrease_share * point.loss)
        point, damping = trial, max(damping * options.damping_decrease, options.min_damping)
        losses.append(point.loss)
        if converged:
            return Minimum(point, tuple(losses), True)
    return Minimum(point, tuple(losses), False)


def _damped_step(scaled: FloatArray, target: FloatArray, damping: float) -> FloatArray:
    """Return the step of scaled normal equations whose diagonal is damped."""
    matrix = scaled + damping * np.eye(len(target))
    try:
        return np.asarray(np.linalg.solve(matrix, target))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, target, rcond=None)[0])


@dataclass(frozen=True)
class WhitenedResiduals:
    """A point with a whitened residual r (N,) and its Jacobian dr/dx (N, P)."""

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
    """Least-squares coefficients of a design, and the remaining residual.

    Attributes
    ----------
    coefficients : (B, C), of a design (N, B).
    residual : (N, C), the data without the fitted part.
    basis : (N, B), orthonormal basis of the design's columns.
    root : (B, B) with root·rootᵀ = (AᵀA)⁻¹.
    """

    coefficients: FloatArray
    residual: FloatArray
    basis: FloatArray
    root: FloatArray

    def orthogonal_complement(self, columns: FloatArray) -> FloatArray:
        """Return the part of columns (N, …) that is orthogonal to the design."""
        table = columns.reshape(len(self.basis), -1)
        return np.asarray(columns - (self.basis @ (self.basis.T @ table)).reshape(columns.shape))


def eliminate(design: FloatArray, data: FloatArray) -> LinearElimination:
    """Fit data (N, C) by a design (N, B) and return coefficients and residual.

    Columns are scaled to unit length. Linearly dependent columns share their coefficient equally.
    """
    size = np.sqrt(np.einsum("nb,nb->b", design, design))
    size[size == 0.0] = 1.0
    scaled = design / size
    basis, triangle = np.linalg.qr(scaled)
    diagonal = np.abs(np.diag(triangle))
    if diagonal.min(initial=np.inf) < _RANK * diagonal.max(initial=0.0):
        root = np.linalg.pinv(triangle, rcond=_RANK) / size[:, None]
        coefficients = np.linalg.lstsq(scaled, data, rcond=_RANK)[0] / size[:, None]
    else:
        root = np.linalg.inv(triangle) / size[:, None]
        coefficients = root @ (basis.T @ data)
    return LinearElimination(coefficients, data - design @ coefficients, basis, root)


class BlockJacobian(NamedTuple):
    """Change of the fitted rows of a block with the parameters.

    Attributes
    ----------
    parameter_index : (p,), parameters that move the rows.
    rows : (N, p, C), derivative of the rows.
    complement_normal : (C, p, p), products of derivatives of the rows orthogonal to the block's design.
    complement_gradient : (C, p), products of these derivatives with the remaining data.
    """

    parameter_index: IntArray
    rows: FloatArray
    complement_normal: FloatArray = np.zeros((1, 1, 1))
    complement_gradient: FloatArray = np.zeros((1, 1))


@dataclass(frozen=True)
class LinearBlock:
    """Rows `design` (N, B) that describe `data` (N, C) with the block's linear coefficients.

    `jacobian` returns the `BlockJacobian` for coefficients (B, C). Long rows may be given in an orthonormal basis of
    their design. The part of the data orthogonal to it then enters as its sum of squares `extra_squares` and number
    `extra_rows`.
    """

    design: FloatArray
    data: FloatArray
    jacobian: Callable[[FloatArray], BlockJacobian]
    extra_squares: float = 0.0
    extra_rows: int = 0


@dataclass(frozen=True)
class SeparablePoint:
    """A point with projected-out coefficients; blocks share the parameters (P,)."""

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
        """Residual (N, C) of every block."""
        return tuple(part.residual for part in self.solved)

    @cached_property
    def loss(self) -> float:
        """Sum of squares, infinite where a design is not finite."""
        if not all(np.all(np.isfinite(block.design)) for block in self.blocks):
            return np.inf
        extra = sum(block.extra_squares for block in self.blocks)
        return float(sum((np.vdot(part.residual, part.residual) for part in self.solved), start=extra))

    @property
    def freedom(self) -> int:
        """Degrees of freedom, at least 1."""
        linear = sum(part.coefficients.size for part in self.solved)
        return max(1, sum(block.data.size + block.extra_rows for block in self.blocks) - linear - len(self.parameters))

    @cached_property
    def jacobians(self) -> tuple[BlockJacobian, ...]:
        """Jacobian of every block at its best coefficients."""
        pairs = zip(self.blocks, self.solved, strict=True)
        return tuple(block.jacobian(part.coefficients) for block, part in pairs)

    @cached_property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """Normal equations of Kaufman's Jacobian."""
        count = len(self.parameters)
        normal, downhill = np.zeros((count, count)), np.zeros(count)
        for part, (index, rows, complement_normal, pull) in zip(self.solved, self.jacobians, strict=True):
            free = part.orthogonal_complement(rows).transpose(0, 2, 1).reshape(-1, len(index))
            normal[np.ix_(index, index)] += free.T @ free + complement_normal.sum(axis=0)
            downhill[index] += free.T @ part.residual.ravel() + pull.sum(axis=0)
        return normal, downhill


# Minima other than the lowest one.

NORMAL_QUANTILE_95 = 1.96  # 97.5 % quantile of the normal distribution
REJECT_CHI2 = 9.0  # excess of χ² from which a minimum is rejected: three standard deviations


def excess_chi2_sigmas(excess: float) -> float:
    """Return the distance of a minimum with χ² larger by `excess`, in standard uncertainties.

    By the ratio of the likelihoods it is √excess. A minimum of equal χ² is placed at the end of a 95 % interval.
    """
    return float(np.sqrt(max(excess, NORMAL_QUANTILE_95**2)))
