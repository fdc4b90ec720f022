"""Levenberg's and Marquardt's method for residuals that come with their derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from shaker._checks import FloatArray

Residual = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
FIRST, GROW, SHRINK = 1e-4, 10.0, 0.2
LARGEST = 1e12
ROUNDS = 100
NOTHING = 1e-18
"""Share of the sum at the start below which no step is worth its while."""


def minimum(function: Residual, start: FloatArray, tolerance: float = 1e-10) -> tuple[FloatArray, float]:
    """Return x (X,) with the smallest Σ r² next to a start, and that sum.

    `function` returns r (N,) and dr/dx (N, X); where r is not finite a step is refused. Ends when a step would lower
    the sum by less than `tolerance` of it or moves nothing (Marquardt 1963; each unknown damped by its curvature).
    """
    x = np.asarray(start, dtype=np.float64)
    residual, slope = function(x)
    cost = float(residual @ residual)
    if not np.isfinite(cost):
        raise ValueError("start: expected unknowns for which all residuals are finite, found others")
    first, damping = cost, FIRST
    size, triangle, along = _reduced(residual, slope)
    for _ in range(ROUNDS):
        step = _step(triangle, along, damping)
        foretold = float(along @ along - np.sum((along + triangle @ step) ** 2))
        step = step / size
        if foretold <= max(tolerance * cost, NOTHING * first) or np.all(np.abs(step) <= 1e-14 * np.abs(x)):
            break
        trial, trial_slope = function(x + step)
        lower = float(trial @ trial)
        if np.isfinite(lower) and lower < cost:
            x, cost = x + step, lower
            size, triangle, along = _reduced(trial, trial_slope)
            damping = max(damping * SHRINK, 1e-15)
        else:
            damping *= GROW
            if damping > LARGEST:
                break
    return x, cost


def _reduced(residual: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Size of every column (X,), the scaled problem as a triangle (X, X), and the residual along it (X,)."""
    size = np.sqrt(np.sum(slope**2, axis=0))
    size[size == 0.0] = 1.0
    basis, triangle = np.linalg.qr(slope / size)
    return size, triangle, basis.T @ residual


def _step(triangle: FloatArray, along: FloatArray, damping: float) -> FloatArray:
    """The damped step, by least squares, not by the normal equations."""
    count = triangle.shape[1]
    rows = np.vstack([triangle, np.sqrt(damping) * np.eye(count)])
    return np.asarray(np.linalg.lstsq(rows, -np.concatenate([along, np.zeros(count)]), rcond=None)[0])
