"""Coverage: factors that turn standard into expanded uncertainties, and 95 % regions of complex values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray

COVERAGE = 0.95
"""Probability with which an interval or a region contains the value."""


def coverage_factor(dof: float) -> float:
    """Return k = t_0.975(dof), so that ±k·u holds a real value 95 times in 100 (JCGM 100, G.3.2).

    `dof`: effective degrees of freedom, infinite where the uncertainty is known; 1.96 then, infinite below 1e-3.
    """
    from scipy.special import ndtri, stdtrit

    upper = 0.5 + COVERAGE / 2.0
    if np.isinf(dof):
        return float(ndtri(upper))
    return float(stdtrit(dof, upper)) if dof > 1e-3 else np.inf


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


@dataclass(frozen=True)
class Region:
    """The 95 % region of a complex value: an ellipse about it in the complex plane.

    `half_axes`: the larger and the smaller one, in the unit of the value; `angle_rad`: of the larger one from the real
    axis, in (-π/2, π/2]; `holds_zero`: whether the origin lies inside, so that amplitude and phase say nothing.
    """

    half_axes: tuple[float, float]
    angle_rad: float
    holds_zero: bool


def region(value: complex, covariance: FloatArray, dof: float = np.inf) -> Region:
    """Return the 95 % region of a complex value with the covariance (2, 2) of (Re, Im)."""
    if not np.all(np.isfinite(covariance)):
        return Region((np.inf, np.inf), 0.0, holds_zero=True)
    variances, axes = np.linalg.eigh(covariance)
    small, large = (_half_axis(float(variance), dof) for variance in variances)
    turned = np.abs(axes.T @ [value.real, value.imag])
    reached = sum(_share(float(part), half) ** 2 for part, half in zip(turned, (small, large), strict=True))
    along = axes[:, 1] * (1.0 if axes[0, 1] > 0.0 or (axes[0, 1] == 0.0 and axes[1, 1] > 0.0) else -1.0)
    return Region((large, small), float(np.arctan2(along[1], along[0])), holds_zero=reached <= 1.0)


def _half_axis(variance: float, dof: float) -> float:
    """Half axis of a region; a direction without uncertainty has none, whatever the degrees of freedom."""
    return region_factor(dof) * float(np.sqrt(variance)) if variance > 0.0 else 0.0


def _share(part: float, half_axis: float) -> float:
    """Part of the way to the edge of a region, infinite outside of one without extent."""
    if part == 0.0:
        return 0.0
    return part / half_axis if half_axis > 0.0 else np.inf
