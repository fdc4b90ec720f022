"""Rounding of readings: last digit, readings that share one rounding error, effect on fitted terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shakercal._common.arrays import Arrays, FloatArray, IntArray
from shakercal._common.propagation import covariance_root

FINEST, WHOLE = 1e-12, 1e-3
"""Relative precision of the finest display, and the tolerance of a whole number."""
FEW_STEPS, SAME_STEP = 4, 0.02
"""Different readings from which steps of a converter are found, and the tolerance of a whole number of them."""
IN_PHASE = 0.0123
"""Variance of a rounded sine's amplitude, of A digits at any offset, times A: ζ(3)/π⁴ digits².

The rounding error of a slow sine is Σ a/(πm)·sin(2πm x/a). Its share in phase is Σ 2a/(πm)·J₁(2πmA/a)·cos(2πm x₀/a),
the mean square of which follows from J₁² ≈ 1/(πx) (Widrow and Kollár 2008, Quantization Noise, appendix G).
"""


@dataclass(frozen=True, repr=False)
class Rounding(Arrays, shapes="digit C; group N C"):
    """Last digit (C,) of the readings, 0 if exact; readings of one `group` (N, C) share one rounding error.

    The error is a function of what is rounded: a sine read at angles θ and π - θ, or on the way there and back, has the
    same error twice.
    """

    digit: FloatArray
    group: IntArray

    @classmethod
    def of(cls, reading: FloatArray, digit: FloatArray | None = None) -> Rounding:
        """Return the rounding of readings (N, C); equal ones share their error."""
        digits = np.array([last_digit(column) for column in reading.T]) if digit is None else digit
        groups = [np.unique(column, return_inverse=True)[1] for column in reading.T]
        return cls(digits, np.stack([group.ravel() for group in groups], axis=1))

    @property
    def variance(self) -> FloatArray:
        """Variance (C,) of one rounding error."""
        return np.asarray(self.digit**2 / 12.0)

    @property
    def repeats(self) -> FloatArray:
        """Mean number (C,) of readings that share one error."""
        return np.asarray(len(self.group) / (1.0 + self.group.max(axis=0)))

    def without(self, noise: FloatArray) -> FloatArray:
        """Return the covariance (C, C) of readings without their rounding."""
        total = np.diag(noise)
        share = np.sqrt(np.maximum(1.0 - self.variance / np.where(total > 0.0, total, np.inf), 0.0))
        return np.asarray(noise * np.outer(share, share))

    def effect(self, estimator: Sequence[FloatArray], coefficient: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the effect (T·C, r) of rounding on T terms by their estimators (T, N), one per channel.

        Errors of different groups are independent. Of a signal (T, C) of few digits without noise they are not: the
        amplitude itself may be off by up to half a digit.
        """
        terms, count = coefficient.shape
        columns = []
        for c in np.flatnonzero(self.digit):
            in_group = np.zeros((terms, 1 + self.group[:, c].max()))
            np.add.at(in_group.T, self.group[:, c], estimator[c].T)
            covariance = self.variance[c] * in_group @ in_group.T
            digits = float(np.linalg.norm(coefficient[:, c])) / self.digit[c]
            dither = np.exp(-4.0 * np.pi**2 * max(noise[c, c] / self.digit[c] ** 2 - 1.0 / 12.0, 0.0))
            in_phase = min(self.variance[c], self.digit[c] ** 2 * IN_PHASE / max(digits, IN_PHASE)) * dither
            covariance += np.diag(np.maximum(in_phase - np.diag(covariance), 0.0))
            root = covariance_root(covariance)
            wide = np.zeros((terms, count, root.shape[1]))
            wide[:, c] = root
            columns.append(wide.reshape(terms * count, -1))
        return np.hstack(columns) if columns else np.zeros((terms * count, 0))


def last_digit(column: FloatArray) -> float:
    """Return the last digit of all readings, 1, 2, 5 times 10ⁿ, or the step of a converter; 0 without either."""
    largest = float(np.abs(column).max())
    if FINEST * largest < np.finfo(np.float64).tiny:
        return 0.0
    different = np.unique(column)
    if len(different) >= FEW_STEPS:
        gaps = np.diff(different)
        steps = gaps / gaps.min()
        if np.all(np.abs(steps - np.round(steps)) < SAME_STEP) and gaps.min() > 2.0 * FINEST * largest:
            return float(np.ptp(different) / np.round(steps).sum())
    for power in range(int(np.ceil(np.log10(largest))), int(np.floor(np.log10(FINEST * largest))), -1):
        for mantissa in (5.0, 2.0, 1.0):
            steps = column / (mantissa * 10.0**power)
            if np.all(np.abs(steps - np.round(steps)) < WHOLE):
                return float(mantissa * 10.0**power)
    return 0.0
