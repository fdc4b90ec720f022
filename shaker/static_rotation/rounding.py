"""Rounding of readings: last digit, readings that share one rounding error, effect on fitted terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import Arrays, FloatArray
from shakercal._common.propagation import covariance_root

FINEST, WHOLE = 1e-12, 1e-3
"""Relative precision of the finest display, and the tolerance of a whole number."""
FEW_STEPS, SAME_STEP = 4, 0.02
"""Different readings from which steps of a converter are found, and the tolerance of a whole number of them."""
SHARED = 4.0  # readings that share a rounding error, of a sine on the way there and back
VARYING = 2  # selected coefficients that are certain to be of what varies rather than of the constant
SURE_NOISE = 0.5  # share of the variance of few readings that is more than rounding: chosen, two readings' of 34
SMALLEST = 1e-6  # share of a digit's square below which errors of two readings are independent
HARMONICS = np.arange(1.0, 25.0)
"""Of the rounding error as a periodic function of the value: 98 % of its variance."""
FEW_DIGITS = 1.0  # amplitude, in digits, below which it may itself be lost in rounding


@dataclass(frozen=True, repr=False)
class Rounding(Arrays, shapes="digit C"):
    """Last digit (C,) of readings, 0 if exact.

    The rounding error is a periodic function of the value before rounding, Σ a/(πm)·sin(2πm x/a) for the digit a
    (Widrow & Kollár 2008, Quantization Noise). Readings of one value have the same error, such as a sine at θ and
    π - θ, or on the way there and back; noise of more than half a digit makes them independent.
    """

    digit: FloatArray

    @property
    def variance(self) -> FloatArray:
        """Variance (C,) of one rounding error."""
        return np.asarray(self.digit**2 / 12.0)

    def without(self, noise: FloatArray) -> FloatArray:
        """Return the covariance (C, C) of readings without their rounding."""
        total = np.diag(noise)
        share = np.sqrt(np.maximum(1.0 - self.variance / np.where(total > 0.0, total, np.inf), 0.0))
        return np.asarray(noise * np.outer(share, share))

    def _covariance(self, c: int, reading: FloatArray, fitted: FloatArray, hat: FloatArray, noise: float) -> FloatArray:
        """Return the covariance (N, N) of the rounding errors of a channel's readings (N,).

        At unknown offset it is a² Σ cos(2πmδ)/(2π²m²) for values that differ by δ digits. Noise of σ digits lessens it
        by exp(-4π²m²σ²), the uncertainty of δ by the fit with its matrix `hat` (N, N) by exp(-2π²m²u²). Values that
        round to the same digit share the range of 1 - δ digits in which both may lie.
        """
        value, own = fitted / self.digit[c], np.diag(hat)
        sigma = max(SURE_NOISE * noise / self.digit[c] ** 2 - 1.0 / 12.0, 0.0)
        apart = np.maximum(own[:, None] + own - hat - hat.T, 0.0) * SHARED / 12.0
        found = np.zeros_like(hat)
        for m in HARMONICS:
            size = np.exp(-4.0 * (np.pi * m) ** 2 * sigma) / (2.0 * (np.pi * m) ** 2)
            if size < SMALLEST:
                break
            wave = np.exp(2j * np.pi * m * value)
            found += size * np.real(np.outer(wave, wave.conj())) * np.exp(-2.0 * (np.pi * m) ** 2 * apart)
        inside = np.maximum(1.0 - np.abs(value[:, None] - value), 0.0) * np.exp(-4.0 * np.pi**2 * sigma)
        found = np.where(reading[:, None] == reading, np.maximum(found, inside**2 / 12.0), found)
        np.fill_diagonal(found, 1.0 / 12.0)
        return np.asarray(self.digit[c] ** 2 * found)

    def effect(
        self,
        estimator: FloatArray,
        design: FloatArray,
        reading: FloatArray,
        coefficient: FloatArray,
        noise: FloatArray,
        selected: Sequence[int],
    ) -> FloatArray:
        """Return the effect (T·C, r) of rounding on T selected coefficients.

        `estimator` (C, P, N). Coefficients of less than a digit may themselves be lost.
        """
        (terms, count), rows = (len(selected), len(self.digit)), list(selected)
        columns = []
        for c in np.flatnonzero(self.digit):
            fitted, hat = design @ coefficient[:, c], design @ estimator[c]
            between = self._covariance(int(c), reading[:, c], fitted, hat, float(noise[c, c]))
            covariance = estimator[c, rows] @ between @ estimator[c, rows].T
            if np.linalg.norm(coefficient[rows[:VARYING], c]) < FEW_DIGITS * self.digit[c]:
                covariance += np.diag(np.maximum(self.variance[c] - np.diag(covariance), 0.0))
            root = covariance_root(covariance)
            wide = np.zeros((terms, count, root.shape[1]))
            wide[:, c] = root
            columns.append(wide.reshape(terms * count, -1))
        return np.hstack(columns) if columns else np.zeros((terms * count, 0))


def last_digit(column: FloatArray) -> float:
    """Return the last digit of all readings, or the step of a converter.

    A digit is 1, 2 or 5 times 10ⁿ; 0 without either.
    """
    largest = float(np.abs(column).max())
    if FINEST * largest < np.finfo(np.float64).tiny:
        return 0.0
    different = np.unique(column)
    gaps = np.diff(different)
    if len(different) >= FEW_STEPS and gaps.min() > 2.0 * FINEST * largest:
        steps = gaps / gaps.min()
        if np.all(np.abs(steps - np.round(steps)) < SAME_STEP):
            return float(np.ptp(different) / np.round(steps).sum())
    for power in range(int(np.ceil(np.log10(largest))), int(np.floor(np.log10(FINEST * largest))), -1):
        for mantissa in (5.0, 2.0, 1.0):
            steps = column / (mantissa * 10.0**power)
            if np.all(np.abs(steps - np.round(steps)) < WHOLE):
                return float(mantissa * 10.0**power)
    return 0.0
