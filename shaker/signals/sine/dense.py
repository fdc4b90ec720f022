"""Least squares with a design matrix, for short records and for channels too many for a covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.signals.folding import condition_number, sine_columns

SINGULAR = 1e6  # condition above which the normal equations carry no information about some line


@dataclass(frozen=True)
class SineSolution:
    """Least-squares solution of a design matrix: `coefficients` (P, C), `inverse` (P, P) of XᵀX, `residual` (S, C)."""

    coefficients: FloatArray
    inverse: FloatArray
    residual: FloatArray
    condition: float


def solve_sines(columns: FloatArray, data: FloatArray) -> SineSolution:
    """Solve columns (S, P) · coefficients = data (S, C) by normal equations with one step of refinement.

    The columns have about unit length and a condition number below 10⁶ is demanded, so the refined solution has the
    accuracy of an orthogonal factorisation at a fraction of its time.
    """
    samples, parameters = columns.shape
    check_samples(samples, parameters)
    gram = columns.T @ columns
    condition = condition_number(gram)
    check_condition(condition)
    inverse = np.linalg.inv(gram)
    coefficients = inverse @ (columns.T @ data)
    coefficients += inverse @ (columns.T @ (data - columns @ coefficients))
    return SineSolution(coefficients, np.asarray(inverse), data - columns @ coefficients, condition)


def sine_amplitudes(
    time_s: FloatArray, values: FloatArray, frequency_hz: FloatArray
) -> tuple[FloatArray, ComplexArray]:
    """Return offset (C,) and phasors (K, C) of `values` (S, C) at `time_s` (S,) as `fit_sines`, without covariance.

    For many channels, whose covariance matrix would be large.
    """
    check_shape("values", values, (len(time_s), None))
    lines, samples = len(frequency_hz), len(time_s)
    found = solve_sines(sine_columns(time_s, frequency_hz), values).coefficients
    value = np.sqrt(2.0 / samples) * (found[0 : 2 * lines : 2] - 1j * found[1 : 2 * lines : 2])
    return found[2 * lines] / np.sqrt(samples), np.asarray(value)


def check_samples(samples: int, parameters: int) -> None:
    """Refuse a fit without degrees of freedom."""
    if samples <= parameters:
        raise ValueError(f"time_s: expected more than {parameters} complete samples, found {samples}")


def check_condition(condition: float) -> None:
    """Refuse lines that the sampling folds onto each other."""
    if not condition < SINGULAR:
        raise ValueError(
            f"frequency_hz: expected lines that the sampling times can tell apart, found condition number "
            f"{condition:.2g}; drop those that usable_lines names"
        )
