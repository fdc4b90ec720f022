"""Least squares with many linear and few other parameters: the linear ones are projected out.

Golub and Pereyra, Separable nonlinear least squares, Inverse Problems 19 (2003) R1, with Kaufman's Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, IntArray

_RANK = 1e-11
_CALM = 1e-9
_SETTLED = 1e-2
_DAMPINGS = 8
_LEAST_DAMPING = 1e-7


@dataclass(frozen=True)
class Slope:
    """∂design/∂parameter `place`: `value` (R, b) at the rows `rows` and the columns `columns` (b,) of a design."""

    place: int
    rows: slice
    columns: IntArray
    value: FloatArray


@dataclass(frozen=True)
class Block:
    """Rows `design` (N, B) that explain `data` (N, C) of unit variance by coefficients of their own, and its slopes."""

    design: FloatArray
    data: FloatArray
    slopes: tuple[Slope, ...]


@dataclass(frozen=True)
class Projected:
    """A problem linearised at one point: coefficients (B, C) and residuals (N, C) of every block, the sum of squares
    `loss`, and the normal equations `normal` (P, P), `gradient` (P,) of the parameters that are not linear."""

    coefficients: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    loss: float
    normal: FloatArray
    gradient: FloatArray


@dataclass(frozen=True)
class Solution:
    """Where the search ended: parameters, the problem there, the loss of every step, whether it came to rest."""

    parameters: FloatArray
    blocks: tuple[Block, ...]
    projected: Projected
    losses: tuple[float, ...]
    converged: bool


def project(blocks: Sequence[Block], count: int) -> Projected:
    """Return coefficients, residuals and normal equations of blocks that share `count` other parameters."""
    normal, gradient = np.zeros((count, count)), np.zeros(count)
    coefficients, residuals = [], []
    for block in blocks:
        basis, triangle = np.linalg.qr(block.design)
        along = basis.T @ block.data
        own = _solved(triangle, along)
        rest = block.data - block.design @ own
        if block.slopes:
            places, change = _changes(block, own)
            inside = np.einsum("nb,pnc->pbc", basis, change, optimize=True)
            table, kept = change.reshape(len(change), -1), inside.reshape(len(change), -1)
            normal[np.ix_(places, places)] += table @ table.T - kept @ kept.T
            gradient[places] += table @ rest.ravel()
        coefficients.append(own)
        residuals.append(rest)
    loss = float(sum(np.vdot(rest, rest) for rest in residuals))
    return Projected(tuple(coefficients), tuple(residuals), loss, normal, gradient)


def minimise(
    blocks_at: Callable[[FloatArray], Sequence[Block] | None],
    start: FloatArray,
    scale: FloatArray,
    steps: int = 40,
    calm: float = _SETTLED,
) -> Solution:
    """Return the least squares parameters by Levenberg and Marquardt's steps.

    `blocks_at` gives the blocks of parameters (P,), None where these are not allowed; `scale` (P,): size of a change
    that matters, which also damps parameters that the data do not tell. The search ends where a step lowers the sum of
    squares, in units of the data's variance, by less than `calm`.
    """
    place, damping, losses = np.asarray(start, dtype=np.float64), 1e-3, []
    blocks = blocks_at(place)
    if blocks is None:
        raise ValueError(f"start: expected allowed parameters, found {place.tolist()}")
    here, converged = project(blocks, len(place)), False
    for _ in range(steps):
        losses.append(here.loss)
        found, promised = None, 0.0
        for _ in range(_DAMPINGS):
            step = _step(here, damping, scale)
            promised = float(step @ (2.0 * here.gradient - here.normal @ step))
            if promised < calm:
                break
            found = _tried(blocks_at, place + step, here)
            if found is not None:
                break
            damping *= 10.0
        if found is None:
            converged = True
            break
        gained = here.loss - found[1].loss
        place, (blocks, here) = place + step, found
        damping = max(damping / 10.0, _LEAST_DAMPING)
        if gained < max(_CALM * here.loss, calm):
            converged = True
            break
    return Solution(place, tuple(blocks), here, (*losses, here.loss), converged)


def _step(here: Projected, damping: float, scale: FloatArray) -> FloatArray:
    """One damped step."""
    weight = np.maximum(np.diag(here.normal), 1.0 / scale**2)
    return np.asarray(np.linalg.solve(here.normal + damping * np.diag(weight), here.gradient))


def _tried(
    blocks_at: Callable[[FloatArray], Sequence[Block] | None], place: FloatArray, here: Projected
) -> tuple[Sequence[Block], Projected] | None:
    """The problem at another place, None where that is not allowed or no better."""
    blocks = blocks_at(place)
    if blocks is None:
        return None
    there = project(blocks, len(place))
    return (blocks, there) if there.loss <= here.loss else None


def _solved(triangle: FloatArray, right: FloatArray) -> FloatArray:
    """Solve a triangular system whose columns may depend on one another."""
    diagonal = np.abs(np.diag(triangle))
    if diagonal.min() > _RANK * diagonal.max():
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(triangle, right))
    return np.asarray(np.linalg.lstsq(triangle, right, rcond=_RANK)[0])


def _changes(block: Block, own: FloatArray) -> tuple[IntArray, FloatArray]:
    """Parameters of a block (p,) and how its rows change with each (p, N, C)."""
    places = np.unique([slope.place for slope in block.slopes]).astype(np.int64)
    found = np.zeros((len(places), *block.data.shape))
    for slope in block.slopes:
        found[np.searchsorted(places, slope.place), slope.rows] += slope.value @ own[slope.columns]
    return places, found


def covariances(solution: Solution, variances: Sequence[FloatArray]) -> tuple[FloatArray, list[list[FloatArray]]]:
    """Return the covariance (P, P) of the parameters, and for every block and column how its coefficients follow them.

    `variances`: of the columns (C,) of every block, in units of the weights. Element [i][c] (B, P + B): change of the
    coefficients with the parameters, beside a square root of their covariance where the parameters are known.
    """
    projected, count = solution.projected, len(solution.parameters)
    spread = np.zeros((count, count))
    unit = 1.0 / np.sqrt(np.maximum(np.diag(projected.normal), 1e-300))
    unit[np.diag(projected.normal) <= 0.0] = 0.0
    inverse = np.linalg.pinv(projected.normal * np.outer(unit, unit), rcond=1e-13, hermitian=True) * np.outer(
        unit, unit
    )
    follows: list[list[FloatArray]] = []
    for block, own, variance in zip(solution.blocks, projected.coefficients, variances, strict=True):
        basis, triangle = np.linalg.qr(block.design)
        root = _solved(triangle, np.eye(len(triangle)))
        places, change = _changes(block, own)
        rows = []
        for c, size in enumerate(variance):
            along = basis.T @ change[:, :, c].T
            free = change[:, :, c].T - basis @ along
            spread[np.ix_(places, places)] += size * (free.T @ free)
            follow = np.zeros((len(own), count))
            follow[:, places] = -root @ along
            rows.append(np.concatenate([follow, np.sqrt(size) * root], axis=1))
        follows.append(rows)
    return inverse @ spread @ inverse, follows
