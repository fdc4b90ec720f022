"""How large the noise of every line is: as stated from its scatter, and as its residual says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape

_FEWEST_DOF, _MOST_DOF = 3.0, 1e9  # of a stated covariance, as used


@dataclass(frozen=True)
class CurveResidual:
    """Residuals of one curve: `length` (K,) = T² = rᵀS⁻¹r over the covariance S stated of p real numbers, `dof` (K,).

    `size` is p; `dof` are the degrees of freedom ν behind S, infinite where S is known.
    """

    length: FloatArray
    dof: FloatArray
    size: int

    def __post_init__(self) -> None:
        check_shape("length", self.length, (None,))
        check_shape("dof", self.dof, self.length.shape)


@dataclass(frozen=True)
class SeenNoise:
    """Factors on the stated covariances: `lines` (K,) per curve, used as weights; `common` λ ≥ 1 to all of them.

    `chi_squared` of the residuals over the covariances as stated, `dof` what it would be by noise alone, were these
    exact, `expected` its mean over `dof` as they are; `chance`: relative standard deviation of χ²/dof by noise alone.
    """

    lines: tuple[FloatArray, ...]
    common: float
    chi_squared: float
    dof: float
    expected: float
    chance: float


def seen_noise(curves: Sequence[CurveResidual], unknowns: float) -> SeenNoise:
    """Return the noise that residuals of a fit with a number of `unknowns` show.

    T² and the covariance S of ν degrees of freedom both say how noisy a line is, so that it weighs (ν + p)/(ν + T²), as
    in Student's likelihood (Lange, Little and Taylor, J. Am. Stat. Assoc. 84, 1989). With n = ν + p, νS + rrᵀ ~ χ²ₙ:
    the weights come out too large by n/(n - 2) in the mean, and such an estimate has n/(n - 2) times the variance of
    one with S known; both factors are in `lines`. λ = χ²/dof over its expectation ν/(ν - 2), at least 1.
    """
    freedoms = [np.clip(curve.dof, _FEWEST_DOF, _MOST_DOF) for curve in curves]
    pairs = list(zip(curves, freedoms, strict=True))
    real = sum(curve.size * len(curve.length) for curve in curves)
    chi_squared = float(sum(curve.length.sum() for curve in curves))
    spread = sum(curve.size * np.sum(_widened(v, curve.size)) for curve, v in pairs) / real
    expected = float(sum(curve.size * np.sum(v / (v - 2.0)) for curve, v in pairs) / real)
    dof = max(1.0, real - unknowns)
    common = max(1.0, chi_squared / dof / expected)
    factors = tuple((common * v + curve.length) * (v + curve.size) / (v + curve.size - 2.0) ** 2 for curve, v in pairs)
    return SeenNoise(factors, common, chi_squared, dof, expected, float(np.sqrt(2.0 * spread / dof)))


def _widened(freedom: FloatArray, size: int) -> FloatArray:
    """Return how much more T² of `size` real numbers varies, relatively, than χ² does, as the F distribution says."""
    return np.asarray((freedom + size - 2.0) / np.maximum(freedom - 4.0, 1.0))
