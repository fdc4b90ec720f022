"""Operating deflection shape: phasors of what a body does beside its rigid motion, point by point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram.deformation import Deformation
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.folding import exposure_gain, sine_columns
from shaker.signals.sine import solve_sines

LEAST_FREEDOM = 4  # frames beyond the unknowns of the fit that make a scatter


@dataclass(frozen=True, eq=False)
class DeflectionShape:
    """Complex deflection of N points of a body at K lines, in m, peak values, in the body's axes.

    `frequency_hz` (K,); `reference_m` (N, 3); `value` (K, N, 3) of x(t) = Re{X exp(jωt)}, exposure loss corrected;
    `u` (K, N, 3): standard uncertainty of the real and of the imaginary part. A point seen too rarely is NaN.
    """

    frequency_hz: FloatArray
    reference_m: FloatArray
    value: ComplexArray
    u: FloatArray


def deflection_shape(
    time_s: FloatArray, frequency_hz: FloatArray, deformation: Deformation, exposure_s: float
) -> DeflectionShape:
    """Return the phasors of a deformation of F frames at times (F,) and lines (K,), by sine approximation.

    Least squares with all lines and an offset, as `fit_sines` does for the rigid motion, on the frames in which the
    point is seen; u² = s²·(2/S)·(XᵀX)⁻¹ with the variance s² of the point's own residual, mean of both parts.
    """
    shape = (len(frequency_hz), *deformation.reference_m.shape)
    value, u = np.full(shape, np.nan, dtype=np.complex128), np.full(shape, np.nan)
    seen = np.isfinite(deformation.residual_m).all(axis=2)
    patterns, member = np.unique(seen, axis=1, return_inverse=True)
    for index, pattern in enumerate(patterns.T):
        if pattern.sum() < 2 * len(frequency_hz) + 1 + LEAST_FREEDOM:
            continue
        points = np.flatnonzero(member.ravel() == index)
        data = deformation.residual_m[np.ix_(pattern, points)].reshape(pattern.sum(), -1)
        found = _fit(time_s[pattern], frequency_hz, data)
        if found is not None:
            value[:, points], u[:, points] = (part.reshape(len(frequency_hz), -1, 3) for part in found)
    gain = exposure_gain(frequency_hz, exposure_s)[:, None, None]
    return DeflectionShape(frequency_hz, deformation.reference_m, np.asarray(value / gain), u / gain)


def _fit(time_s: FloatArray, frequency_hz: FloatArray, data: FloatArray) -> tuple[ComplexArray, FloatArray] | None:
    """Phasors (K, C) and their standard uncertainties; None where these frames cannot tell the lines apart."""
    try:
        solution = solve_sines(sine_columns(time_s, frequency_hz), data)
    except ValueError:
        return None
    samples, last = len(data), 2 * len(frequency_hz)
    cosine, sine = solution.coefficients[0:last:2], solution.coefficients[1:last:2]
    variance = np.sum(solution.residual**2, axis=0) / (samples - last - 1)
    spread = np.diagonal(solution.inverse)[:last].reshape(-1, 2).mean(axis=1)
    u = np.sqrt(2.0 / samples * np.multiply.outer(spread, variance))
    return np.sqrt(2.0 / samples) * (cosine - 1j * sine), u
