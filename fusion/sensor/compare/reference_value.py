"""The reference value of a comparison, its consistency, degrees of equivalence and drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from fusion.estimation.coverage import along_and_across, region_factor
from shakercal._common.arrays import ComplexArray, FloatArray

SIGNIFICANCE = 0.05
"""Level of the χ² test of consistency (Cox 2002)."""
COVERAGE_FACTOR = 2.0
MAX_RESULTS = 12
"""Largest number of results of one element at one frequency, since all their subsets are tried."""


@dataclass(frozen=True)
class ReferenceValue:
    """Weighted mean of the results `used` (N,), and deviations of all results.

    `deviation` (N,) with `expanded` U, k = 2. `p`: probability of a χ² at least as large as that of the used results.
    If no two results are consistent, none is used, and all numbers but `p` are NaN.
    """

    value: float
    u: float
    chi_squared: float
    dof: int
    p: float
    used: np.typing.NDArray[np.bool_]
    deviation: FloatArray
    expanded: FloatArray

    @property
    def normalised(self) -> FloatArray:
        """Return E_n of every result relative to the reference value.

        NaN for a result that defines the reference value alone.
        """
        uncertain = self.expanded > 0.0
        return np.asarray(np.where(uncertain, self.deviation / np.where(uncertain, self.expanded, 1.0), np.nan))


def normalised_error(value: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return E_n (N, N) of pairs of results, with their correlations.

    (x_i - x_j) / U(x_i - x_j), k = 2; 0 on the diagonal.
    """
    variance = np.diag(covariance)
    spread = variance[:, None] + variance[None, :] - 2.0 * covariance
    u = np.sqrt(np.maximum(spread, 0.0))
    difference = value[:, None] - value[None, :]
    return np.asarray(np.where(u > 0.0, difference / (COVERAGE_FACTOR * np.where(u > 0.0, u, 1.0)), 0.0))


def complex_normalised_error(
    value: ComplexArray, u_magnitude: FloatArray, u_phase_rad: FloatArray, shared: Sequence[FloatArray] = ()
) -> FloatArray:
    """Return E_n (N, N) of complex values by magnitude and phase.

    It is 1 at the edge of the 95 % region. sqrt(d' V^-1 d / 5.99) of the difference d (real and imaginary part) with
    covariance V = V_i + V_j - C_ij - C_ji. 5.99 is the 95 % quantile of χ² with two degrees of freedom (JCGM 102, 6.5).
    0 on the diagonal, NaN for NaN values. `shared`: effects (N, 2) of every shared input on relative magnitudes and
    phases, from which C follows.
    """
    found, frame = np.zeros((len(value), len(value))), along_and_across(value)
    roots = frame * np.stack([u_magnitude, np.abs(value) * u_phase_rad], axis=-1)[:, None, :]
    covariances = roots @ roots.swapaxes(-1, -2)
    common = [np.einsum("nij,nj->ni", frame, effect * np.abs(value)[:, None]) for effect in shared]
    for i, j in combinations(range(len(value)), 2):
        both = np.array([(value[i] - value[j]).real, (value[i] - value[j]).imag])
        spread = covariances[i] + covariances[j]
        for effect in common:
            spread = spread - np.outer(effect[i], effect[j]) - np.outer(effect[j], effect[i])
        usable = bool(np.isfinite(spread).all()) and np.linalg.det(spread) > 0.0
        squared = float(both @ np.linalg.solve(spread, both)) if usable else np.nan
        found[i, j] = found[j, i] = np.sqrt(squared) / region_factor(np.inf)
    return found


def weighted_mean(value: FloatArray, covariance: FloatArray) -> tuple[float, float, FloatArray, float]:
    """Return mean, its u, weights (N,) and χ² by generalised least squares of one constant."""
    solved = np.linalg.solve(covariance, np.column_stack([np.ones(len(value)), value]))
    total = float(solved[:, 0].sum())
    weights = np.asarray(solved[:, 0] / total, dtype=np.float64)
    mean = float(weights @ value)
    left = value - mean
    return mean, float(total**-0.5), weights, float(left @ np.linalg.solve(covariance, left))


def reference_value(value: FloatArray, covariance: FloatArray) -> ReferenceValue:
    """Return the reference value of N results with covariance (N, N).

    Cox, Metrologia 39 (2002) 589, procedure A: the weighted mean if χ² does not reject it at 5 %. Otherwise that of the
    largest consistent subset, among equal ones that of the smallest χ² (Cox, Metrologia 44 (2007) 187).
    """
    count = len(value)
    if not 2 <= count <= MAX_RESULTS:
        raise ValueError(f"value: expected 2 to {MAX_RESULTS} results, found {count}")
    tried = []
    for size in range(count, 1, -1):
        found = []
        for subset in combinations(range(count), size):
            indices = np.array(subset)
            found.append((weighted_mean(value[indices], covariance[np.ix_(indices, indices)])[3], subset))
        squared, subset = min(found)
        tried.append(float(chdtrc(size - 1.0, max(squared, 0.0))))
        if tried[-1] >= SIGNIFICANCE:
            break
    else:
        unknown, none = np.full(count, np.nan), np.zeros(count, dtype=np.bool_)
        return ReferenceValue(np.nan, np.nan, np.nan, 0, tried[0], none, unknown, unknown)
    indices, p = np.array(subset), tried[-1]
    mean, u, inner, squared = weighted_mean(value[indices], covariance[np.ix_(indices, indices)])
    weights = np.zeros(count)
    weights[indices] = inner
    transform = np.eye(count) - weights  # deviations x_i - w.x, row by row
    variance = np.einsum("ij,jk,ik->i", transform, covariance, transform)
    expanded = COVERAGE_FACTOR * np.sqrt(np.maximum(variance, 0.0))
    expanded[expanded < 1e-9 * np.sqrt(np.diag(covariance))] = 0.0
    return ReferenceValue(mean, u, squared, size - 1, p, np.isin(np.arange(count), indices), value - mean, expanded)


def drift(year: FloatArray, value: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Return the change per year and its u, by generalised least squares.

    Raises `ValueError` for a single date.
    """
    if len(np.unique(year)) < 2:
        raise ValueError("year: expected two dates, found one")
    design = np.column_stack([np.ones(len(year)), year - year.mean()])
    weighed = np.linalg.solve(covariance, np.column_stack([design, value]))
    scatter = np.linalg.inv(design.T @ weighed[:, :2])
    return float((scatter @ (design.T @ weighed[:, 2]))[1]), float(scatter[1, 1] ** 0.5)
