"""How large the noise of every line is: as stated from its scatter, and as its residual says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray
from shaker.models.identification.problem import Problem
from shaker.models.identification.solve import State, effective

_FEWEST_DOF, _MOST_DOF = 3.0, 1e9  # of a stated covariance, as used


@dataclass(frozen=True)
class Noise:
    """Factors on the stated covariances: `lines` (K,) per recording, used as weights; `common` λ ≥ 1 to all of them.

    `chi_squared` of the residuals over the covariances as stated, `dof` what it would be by noise alone, were these
    exact; `chance`: relative standard deviation of χ²/dof by noise alone, from covariances of few degrees of freedom.
    """

    lines: tuple[FloatArray, ...]
    common: float
    chi_squared: float
    dof: float
    chance: float


def stated(problem: Problem) -> tuple[FloatArray, ...]:
    """Return factors of one."""
    return tuple(np.ones(len(curve.whitening)) for curve in problem.curves)


def line_noise(problem: Problem, state: State, before: Sequence[FloatArray]) -> Noise:
    """Return the noise seen at a `state`, whose residuals are whitened with the factors `before`.

    Residual r of p real numbers over a covariance S from ν degrees of freedom: T² = rᵀS⁻¹r. Both say how noisy the line
    is, so that it weighs (ν + p)/(ν + T²), as in Student's likelihood (Lange, Little and Taylor, J. Am. Stat. Assoc.
    84, 1989). With n = ν + p, νS + rrᵀ ~ χ²ₙ: the weights come out too large by n/(n - 2) in the mean, and such an
    estimate has n/(n - 2) times the variance of one with S known; both factors are in `lines`. λ = χ²/dof over its
    expectation ν/(ν - 2), at least 1.
    """
    lengths, freedoms, sizes = [], [], []
    for curve, residual, factor in zip(problem.curves, state.residuals, before, strict=True):
        lengths.append(np.sum(residual**2, axis=1) * factor)
        freedoms.append(np.clip(curve.record.ratio.dof, _FEWEST_DOF, _MOST_DOF))
        sizes.append(residual.shape[1])
    real = sum(size * len(length) for size, length in zip(sizes, lengths, strict=True))
    chi_squared = float(sum(length.sum() for length in lengths))
    spread = sum(size * np.sum(_widened(v, size)) for size, v in zip(sizes, freedoms, strict=True)) / real
    expected = sum(size * np.sum(v / (v - 2.0)) for size, v in zip(sizes, freedoms, strict=True)) / real
    dof = max(1.0, real - effective(problem, state))
    common = max(1.0, chi_squared / dof / float(expected))
    factors = tuple(
        (common * v + length) * (v + p) / (v + p - 2.0) ** 2
        for length, v, p in zip(lengths, freedoms, sizes, strict=True)
    )
    return Noise(factors, common, chi_squared, dof, float(np.sqrt(2.0 * spread / dof)))


def _widened(freedom: FloatArray, size: int) -> FloatArray:
    """Return how much more T² of `size` real numbers varies, relatively, than χ² does, as the F distribution says."""
    return np.asarray((freedom + size - 2.0) / np.maximum(freedom - 4.0, 1.0))
