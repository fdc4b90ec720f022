"""Image noise as a function of brightness: read noise and shot noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import FloatArray, check_shape

QUANTISATION = 1.0 / 12.0  # variance of rounding to whole grey values
CUT = 9.0  # squared residuals beyond three standard deviations count as outliers
_ENLARGED = 1.0 / (1.0 - math.sqrt(2.0 * CUT / math.pi) * math.exp(-CUT / 2.0) / math.erf(math.sqrt(CUT / 2.0)))
"""F₁/F₃ at the cut, Fₙ the distribution of χ² with n degrees of freedom: correction of a mean for rejection."""
MEDIAN_CHI2 = 0.4549364231195724  # of χ² with one degree of freedom
BINS = 32  # enough for a line, with thousands of pixels in each
MIN_IN_BIN = 50  # pixels, for a variance to 20 %
NARROW = 0.1  # brightness range, relative to the brightest, below which shot noise and read noise cannot be separated
ROUNDS = 30  # usually fewer than ten are needed


@dataclass(frozen=True)
class NoiseModel:
    """Noise variance of a pixel of grey value g: read_variance_grey2 + variance_per_grey·g.

    It is at least 1/12, the variance of rounding. The photon transfer curve (Janesick 2007, Photon Transfer, SPIE, ch.
    5; EMVA 1288 release 4.0, eq. 10): the first term is the noise of the dark sensor, quantisation included. The second
    is shot noise, 1/(electrons per grey value).
    """

    read_variance_grey2: float
    variance_per_grey: float

    def __post_init__(self) -> None:
        for name in ("read_variance_grey2", "variance_per_grey"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected a finite variance of 0 or more, found {getattr(self, name)}")

    def variance(self, grey: FloatArray | float) -> FloatArray:
        """Return the noise variance in grey² of pixels of any shape with grey values `grey`."""
        shot = self.variance_per_grey * np.maximum(grey, 0.0)
        return np.asarray(np.maximum(self.read_variance_grey2 + shot, QUANTISATION), dtype=np.float64)


def fit_noise_model(grey: FloatArray, residual_grey2: FloatArray) -> NoiseModel:
    """Fit a noise model to pixels' brightness (M,) and squared residuals (M,).

    Each squared residual is χ² distributed with one degree of freedom. Up to 32 bins of equal count divide the
    brightness. In a bin the variance s² is the mean of the residuals below 9·s², enlarged by F₁(9)/F₃(9) = 1.027 (Fₙ:
    distribution of χ² with n degrees of freedom, since ∫₀ᵗ x·f₁ = F₃(t)). The line through the bins has no negative
    coefficient; its relative weights follow from the line itself. A brightness range of less than 10 % of the brightest
    bin gives a constant. NaN pixels are ignored.
    """
    check_shape("grey", grey, (None,))
    check_shape("residual_grey2", residual_grey2, (len(grey),))
    finite = np.isfinite(grey) & np.isfinite(residual_grey2)
    if finite.sum() < MIN_IN_BIN:
        raise ValueError(f"grey: expected at least {MIN_IN_BIN} finite pixels, found {finite.sum()}")
    order = np.flatnonzero(finite)[np.argsort(grey[finite])]
    parts = np.array_split(order, max(1, min(BINS, len(order) // MIN_IN_BIN)))
    brightness = np.array([grey[part].mean() for part in parts])
    variance = np.array([_robust_variance(residual_grey2[part]) for part in parts])
    count = np.array([float(len(part)) for part in parts])
    if np.ptp(brightness) < NARROW * np.abs(brightness).max():
        return NoiseModel(max(float(np.average(variance, weights=count)), QUANTISATION), 0.0)
    columns = np.column_stack([np.ones_like(brightness), np.maximum(brightness, 0.0)])
    solution, expected = np.zeros(2), np.full_like(variance, variance.mean())
    for _ in range(4):
        weight = np.sqrt(count) / np.maximum(expected, QUANTISATION)
        solution = _nonnegative(columns * weight[:, None], variance * weight)
        expected = columns @ solution
    return NoiseModel(float(solution[0]), float(solution[1]))


def _robust_variance(squares: FloatArray) -> float:
    """Return the mean of squares of normal deviates, corrected for those rejected beyond 3σ."""
    ordered, middle = np.sort(squares), len(squares) // 2
    median = 0.5 * float(ordered[middle] + ordered[-1 - middle])
    sums, variance = np.cumsum(ordered), median / MEDIAN_CHI2
    for _ in range(ROUNDS):
        number = np.searchsorted(ordered, CUT * variance, side="right")
        before, variance = variance, _ENLARGED * float(sums[number - 1] / number)
        if abs(variance - before) <= 1e-6 * before:
            break
    return variance


def _nonnegative(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Solve values (M,) by columns (M, 2) in least squares, neither coefficient below zero."""
    both, *_ = np.linalg.lstsq(columns, values)
    if (both >= 0.0).all():
        return np.asarray(both)
    alone = np.diag(np.maximum(columns.T @ values, 0.0) / np.sum(columns**2, axis=0))
    return np.asarray(min(alone, key=lambda one: float(np.sum((values - columns @ one) ** 2))))
