"""Coverage factors, expanded uncertainties and 95 % regions of complex values."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from shakercal._common.arrays import ComplexArray, FloatArray

COVERAGE = 0.95
"""Probability with which an interval or a region contains the value."""


def coverage_factor(dof: float, coverage: float = COVERAGE) -> float:
    """Return the coverage factor k = t_0.975(dof) of a real value (JCGM 100, G.3.2).

    ±k·u covers 95 %, or the share `coverage`. `dof`: effective degrees of freedom, infinite where the uncertainty is
    exact; then k is 1.96. Below 1e-3 degrees of freedom k is infinite.
    """
    from scipy.special import ndtri, stdtrit

    upper = 0.5 + coverage / 2.0
    if np.isinf(dof):
        return float(ndtri(upper))
    return float(stdtrit(dof, upper)) if dof > 1e-3 else np.inf


_PERIOD, _LAST, _LEAST_WIDTH = 40.0, 300.0, 0.02  # in standard deviations of the sum


def bounded_factor(widths: FloatArray, u: float, k: float) -> float:
    """Return U/u, for 95 %, of a sum of uniform and normal numbers.

    The uniform numbers lie within ± `widths` (N,); the rest has U = k·u. P(|s| ≤ U) = 2/π·∫ sin(U·t)/t·φ(t) dt with the
    characteristic function φ, by the trapezoidal rule. That rule is exact for a periodic density, except for the part
    beyond one period.
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


@dataclass(frozen=True)
class RealQuantity:
    """A real number with its standard uncertainty `u`, NaN if unknown, and degrees of freedom."""

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
class NamedQuantity(RealQuantity):
    """A quantity with its `name` in files and its `label` for readers.

    `low`, `high`: ends of its 95 % interval where that is not symmetric, else NaN; `expanded` includes both.
    """

    name: str
    label: str
    low: float = field(default=np.nan, kw_only=True)
    high: float = field(default=np.nan, kw_only=True)


# 95 % regions of complex values.


def region_factor(dof: ArrayLike) -> FloatArray:
    """Return the factor K of a half-axis K·u of a 95 % region.

    `dof` (...): degrees of freedom of the part along the half-axis. K² = 2·F_0.95(2, ν) = ν·(0.05^(-2/ν) - 1), for two
    parts that share one estimated variance; 5.99 (chi-square of two degrees of freedom) for infinite ν. An ellipse
    whose half-axes have different, independently estimated ν covers 93.6 % (both of one degree of freedom) to 95.3 %.
    """
    nu, tail = np.asarray(dof, dtype=np.float64), -2.0 * np.log(1.0 - COVERAGE)
    # Above a power of e^500 the region is infinite for every purpose.
    finite = np.isfinite(nu) & (nu > tail / 500.0)
    some = np.where(finite, nu, 1.0)
    square = np.where(finite, some * np.expm1(tail / some), np.where(np.isposinf(nu), tail, np.inf))
    return np.asarray(np.sqrt(np.where(np.isnan(nu), np.nan, square)))


def along_and_across(value: ComplexArray | complex) -> FloatArray:
    """Return unit vectors along values and across them, as columns; the axes at zero."""
    values = np.asarray(value, dtype=np.complex128)
    size = np.abs(values)
    unit = np.divide(values, size, out=np.ones_like(values), where=np.isfinite(values) & (size > 0.0))
    return np.stack([np.stack([unit.real, -unit.imag], -1), np.stack([unit.imag, unit.real], -1)], -2)


def counted_covariance(parts: FloatArray, dof: ArrayLike) -> FloatArray:
    """Return the covariance of two parts (..., 2, 2) that a region uses.

    `dof` (...). The ellipse of an estimated correlation r is too narrow if r is large by chance: it covers 91 % with ν
    = 5, 78 % with 2, and is a line with 1. One part predicts the other with the remaining variance 1 - r², estimated
    with ν - 1 degrees of freedom, and with the error of the regression. The factor g enlarges 1 - r², up to 1: g = ν/(ν
    - 1)·(K(ν - 1)/K(ν))²·(1 + 3/ν)², with K of `region_factor`. The last factor was set by simulation: regions then
    cover 93 to 97 % for every correlation and ν (docs/uncertainty.md).
    """
    nu, mixed = np.asarray(dof, dtype=np.float64), parts[..., 0, 1]
    few = np.where(np.isposinf(nu), 2.0, np.maximum(nu, 1.0))
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        g = few / (few - 1.0) * (region_factor(few - 1.0) / region_factor(few)) ** 2 * (1.0 + 3.0 / few) ** 2
        lost = (g - 1.0) * np.maximum(parts[..., 0, 0] * parts[..., 1, 1] - mixed**2, 0.0)
    lost = np.where(np.isposinf(nu), 0.0, np.where(np.isfinite(g), lost, np.inf))
    return np.asarray(np.sign(mixed) * np.sqrt(np.maximum(mixed**2 - lost, 0.0)))


BENT = 1.716
"""Radial variance that a turn by φ ~ N(0, u²) needs, over u⁴·|X|²: k⁴/(4·(K² - k²)) with k = 1.96, K² = 5.99.

The turn takes X to X - X·φ²/2 + j·X·φ. An ellipse of the variances c·u⁴·|X|² and u²·|X|² holds all with |φ| ≤ k·u, 95
in 100, where k² + k⁴/(4c) = K². The second moment of φ²/2, c = 3/4, makes it 91.7 (both where nothing else is along
X; with anything else 95 to 95.5, and 91.7 to 95).
"""


def region_matrix(
    value: ComplexArray | complex,
    covariance: FloatArray,
    dof: ArrayLike = (np.inf, np.inf),
    mixed: ArrayLike | None = None,
    u_turn: ArrayLike = 0.0,
) -> FloatArray:
    """Return the matrices M (..., 2, 2) of the 95 % regions of complex values.

    The region of a value X is the ellipse (z - X)ᵀ·M⁻¹·(z - X) ≤ 1. `covariance` (..., 2, 2) of (Re, Im), of first
    order. `dof` (2, ...): along X and across it, each with its factor (`region_factor`). `mixed` (...): the covariance
    of these two parts as `counted_covariance` reduces it, by default all of it. An uncertain angle of X, with the
    standard uncertainty `u_turn` (...), bends the region (`BENT`). It then reaches further along X, but
    no further than across.
    """
    frame, turn = along_and_across(value), np.asarray(u_turn, dtype=np.float64) ** 2
    parts = frame.swapaxes(-1, -2) @ covariance @ frame
    if mixed is not None:
        parts[..., 0, 1] = parts[..., 1, 0] = mixed
    factors = np.stack(np.broadcast_arrays(*region_factor(dof)), axis=-1)
    # What has no uncertainty has no half-axis, whatever the degrees of freedom.
    factors = np.where(np.einsum("...ii->...i", parts) > 0.0, factors, 1.0)
    matrix = parts * factors[..., :, None] * factors[..., None, :]
    matrix[..., 0, 0] += region_factor(np.inf) ** 2 * np.minimum(BENT * turn, 1.0) * turn * np.abs(value) ** 2
    return np.asarray(frame @ matrix @ frame.swapaxes(-1, -2))


@dataclass(frozen=True)
class CoverageRegion:
    """The 95 % region of a complex value: an ellipse in the complex plane (`region_matrix`).

    `half_axes`: the larger and the smaller one, in the unit of the value. `angle_rad`: from the real axis to the larger
    one, in (-π/2, π/2]. `holds_zero`: whether the origin lies inside, so that amplitude and phase are meaningless.
    """

    half_axes: tuple[float, float]
    angle_rad: float
    holds_zero: bool


def region(value: complex, matrix: FloatArray) -> CoverageRegion:
    """Return the 95 % region of a complex value from its `matrix` (2, 2) (`region_matrix`)."""
    if not np.all(np.isfinite(matrix)):
        return CoverageRegion((np.inf, np.inf), 0.0, holds_zero=True)
    squares, axes = np.linalg.eigh(matrix)
    small, large = np.sqrt(np.maximum(squares, 0.0)).tolist()
    direction = np.abs(axes.T @ [value.real, value.imag]).tolist()
    shares = [
        part / half if half > 0.0 else np.inf for part, half in zip(direction, (small, large), strict=True) if part
    ]
    along = axes[:, 1] * (1.0 if axes[0, 1] > 0.0 or (axes[0, 1] == 0.0 and axes[1, 1] > 0.0) else -1.0)
    angle = float(np.arctan2(along[1], along[0]))
    return CoverageRegion((large, small), angle, holds_zero=sum(share**2 for share in shares) <= 1.0)


# Complex numbers as magnitude and phase with uncertainty.


UNIFORM_PHASE_U = float(np.pi / np.sqrt(3.0))


@dataclass(frozen=True)
class Polar:
    """A complex value as magnitude and phase and as parts, with standard uncertainties.

    The phase is in (-pi, pi]. `r`: correlation of real and imaginary part. `dof`: effective degrees of freedom of the
    complex value. `dof_magnitude`, `dof_phase`: those of the real quantities, with their coverage factors for 95 %.
    `region_re`, `region_im`: reach of the 95 % region along the real and the imaginary axis. `region_r`: correlation of
    its ellipse: z = X + (a, b) lies inside if (a² - 2r·a·b + b²)/(1 - r²) ≤ 1, a and b over region_re and region_im.
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
    region_re: float
    region_im: float
    region_r: float

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
    def covariance(self) -> FloatArray:
        """Return the covariance (2, 2) of (Re, Im), of first order."""
        return _pair(self.u_re, self.u_im, self.r)

    @property
    def region_matrix(self) -> FloatArray:
        """Return the matrix (2, 2) of the 95 % region, as `fusion.estimation.coverage.region_matrix` has it."""
        return _pair(self.region_re, self.region_im, self.region_r)

    @property
    def region(self) -> CoverageRegion:
        """Return the 95 % region of the complex value.

        A turn by any angle makes it a disc. If the magnitude is determined, the origin does not belong to it.
        """
        found = region(complex(self.re, self.im), self.region_matrix)
        any_phase = self.u_phase_rad >= UNIFORM_PHASE_U and self.expanded_magnitude < self.magnitude
        return replace(found, holds_zero=False) if any_phase else found

    @property
    def region_factor(self) -> float:
        """Return the single factor that enlarges the ellipse of the covariance to the region."""
        areas = np.linalg.det(self.region_matrix), np.linalg.det(self.covariance)
        usable = np.all(np.isfinite(areas)) and min(areas) > 0.0
        return float((areas[0] / areas[1]) ** 0.25) if usable else float(region_factor(self.dof))


def _pair(first: float, second: float, correlation: float) -> FloatArray:
    """Matrix (2, 2) of two roots of variances and their correlation."""
    mixed = correlation * first * second
    return np.array([[first**2, mixed], [mixed, second**2]])


def polar(
    value: complex,
    covariance: FloatArray,
    dof: float = np.inf,
    dof_polar: tuple[float, float] | None = None,
    k_polar: tuple[float, float] | None = None,
    region: FloatArray | None = None,
) -> Polar:
    """Propagate the covariance (2, 2) of (Re, Im) of `value` to magnitude and phase.

    u(|X|)^2 = e^T V e with e = (Re, Im)/|X|, u(arg X)^2 = n^T V n / |X|^2 with n = (-Im, Re)/|X| (JCGM 102, 9.4). The
    expansion fails where |X| is of the order of its uncertainty. There u(arg X) is limited to pi/sqrt(3), the standard
    deviation of a uniform phase; at X = 0, u(|X|) is that of the mean direction.

    `dof`: of the complex value. `dof_polar`: of magnitude and phase, by default `dof`; `k_polar`: their coverage
    factors, by default those of `dof_polar`. `region` (2, 2): see `region_matrix`, by default that of a covariance
    estimated with `dof`.
    """
    re, im = float(value.real), float(value.imag)
    magnitude = float(np.hypot(re, im))
    u_re, u_im, r = _roots(covariance)
    if magnitude == 0.0:
        u_magnitude, u_phase = float(np.sqrt(np.trace(covariance) / 2.0)), UNIFORM_PHASE_U
    elif np.isnan(covariance).any():
        u_magnitude = u_phase = float("nan")
    else:
        along, across = np.array([re, im]) / magnitude, np.array([-im, re]) / magnitude
        u_magnitude = float(np.sqrt(max(float(along @ covariance @ along), 0.0)))
        u_across = float(np.sqrt(max(float(across @ covariance @ across), 0.0)))
        u_phase = min(u_across / magnitude, UNIFORM_PHASE_U)
    # An imaginary part of -0 does not turn pi into -pi.
    phase, freedom = float(np.arctan2(im + 0.0, re)), (dof, dof) if dof_polar is None else dof_polar
    factors = (coverage_factor(freedom[0]), coverage_factor(freedom[1])) if k_polar is None else k_polar
    if region is None:
        frame = along_and_across(value)
        region = region_matrix(value, covariance, freedom, counted_covariance(frame.T @ covariance @ frame, dof))
    sizes = magnitude, phase, u_magnitude, u_phase
    return Polar(*sizes, re, im, u_re, u_im, r, dof, *freedom, *factors, *_roots(region))


def _roots(matrix: FloatArray) -> tuple[float, float, float]:
    """Return the roots of the diagonal of a matrix (2, 2) and the correlation."""
    first, second = (float(u) for u in np.sqrt(np.diag(matrix)))
    product = first * second
    return first, second, float(matrix[0, 1]) / product if 0.0 < product < np.inf else 0.0
