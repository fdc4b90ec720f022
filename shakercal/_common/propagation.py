"""Propagation of uncertainty: derivatives by differences, and independent causes of a covariance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from shakercal._common.arrays import FloatArray


def derivatives(of: Callable[[FloatArray], FloatArray], step: FloatArray) -> FloatArray:
    """Return the derivatives (...,N) of a function at zero by central differences of steps (N,).

    They are zero for numbers whose step is zero, which are exact.
    """
    moved = np.flatnonzero(step)
    rates = [(of(delta) - of(-delta)) / (2.0 * delta.sum()) for delta in np.diag(step)[moved]]
    slope = np.zeros((*np.shape(rates[0] if rates else of(step)), len(step)))
    slope[..., moved] = np.stack(rates, axis=-1) if rates else 0.0
    return slope


_RANK = 1e-12  # variance in a direction, relative to the scale, below which it is rounding


def covariance_root(covariance: FloatArray) -> FloatArray:
    """Return deviations (N, E) of E independent unit causes for a covariance (N, N).

    Directions without variance have no cause. The scale of the numbers is arbitrary.
    """
    size = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    scale = np.where(size > 0.0, size, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.multiply.outer(scale, scale))
    spread = variance > _RANK
    return np.asarray(scale[:, None] * axes[:, spread] * np.sqrt(variance[spread]))
