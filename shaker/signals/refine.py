"""Frequencies refined by least squares, jointly over harmonics and channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.signals.folding import alias_frequency, sampling_grid, sine_columns
from shaker.signals.noise import LineNoise, line_noise
from shaker.signals.sine import solve_sines

_STEPS = 30


@dataclass(frozen=True)
class Refined:
    """Fundamentals refined by least squares: `frequency_hz`, `u_frequency_hz` (Q,)."""

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray


def refine_frequency(
    time_s: FloatArray, values: FloatArray, start_hz: FloatArray, multiples: Sequence[Sequence[int]]
) -> Refined:
    """Refine fundamentals (Q,) jointly with their harmonics over all channels of `values` (S, C).

    Four-parameter fit of IEEE 1057 extended to harmonics and channels: Gauss-Newton on the frequencies alone, the
    linear parameters projected out at every step (variable projection; Golub and Pereyra 1973, with Kaufman's
    simplification). `multiples[q]` lists the harmonics of fundamental q, 1 among them. Channels weigh by their
    residuals. The covariance is (DᵀWD)⁻¹ with the residual's density around the fundamental in place of its variance.
    """
    check_shape("time_s", time_s, (None,))
    check_shape("values", values, (len(time_s), None))
    middle = float(np.mean(time_s))
    time = time_s - middle
    frequency = np.array(start_hz, dtype=np.float64)
    for _ in range(_STEPS):
        step, covariance = _frequency_step(time, values, frequency, multiples)
        frequency = frequency + step
        if np.all(np.abs(step) <= 1e-3 * np.sqrt(covariance.diagonal()) + 1e-13 * frequency):
            return Refined(frequency, np.sqrt(covariance.diagonal()))
    listed = ", ".join(f"{f:.6g}" for f in start_hz)
    raise ValueError(f"start_hz: expected frequencies from which the fit converges, found {listed} Hz")


def _frequency_step(
    time: FloatArray, values: FloatArray, frequency: FloatArray, multiples: Sequence[Sequence[int]]
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton step of the fundamentals (Q,) and their covariance (Q, Q)."""
    lines = np.array([m * f for f, orders in zip(frequency, multiples, strict=True) for m in orders])
    columns = sine_columns(time, lines)
    solution = solve_sines(columns, values)
    free = len(time) - len(solution.coefficients) - len(frequency)
    variance = np.maximum(np.sum(solution.residual**2, axis=0) / free, np.finfo(np.float64).tiny)
    normal = np.zeros((len(frequency), len(frequency)))
    right = np.zeros(len(frequency))
    for c in range(values.shape[1]):
        slope = _frequency_slope(time, columns, solution.coefficients[:, c], multiples)
        slope -= columns @ (solution.inverse @ (columns.T @ slope))
        normal += slope.T @ slope / variance[c]
        right += slope.T @ solution.residual[:, c] / variance[c]
    inverse = np.linalg.inv(normal)
    first = np.array([m * f for f, orders in zip(frequency, multiples, strict=True) for m in orders if m == 1])
    colour = np.sqrt(_colour(time, solution.residual, lines, first, variance))
    return np.asarray(inverse @ right), np.asarray(inverse * np.multiply.outer(colour, colour))


def _frequency_slope(
    time: FloatArray, columns: FloatArray, coefficients: FloatArray, multiples: Sequence[Sequence[int]]
) -> FloatArray:
    """Return the derivative (S, Q) of one channel's model by the fundamentals: Σ 2πm t (b cos - a sin)."""
    slope = np.zeros((len(time), len(multiples)))
    place = 0
    for q, orders in enumerate(multiples):
        for m in orders:
            a, b = coefficients[2 * place], coefficients[2 * place + 1]
            slope[:, q] += 2.0 * np.pi * m * (b * columns[:, 2 * place] - a * columns[:, 2 * place + 1])
            place += 1
        slope[:, q] *= time
    return slope


def _colour(
    time: FloatArray, residual: FloatArray, lines: FloatArray, fundamentals: FloatArray, variance: FloatArray
) -> FloatArray:
    """Return the noise density around each fundamental over the white variance (Q,), the largest of the channels."""
    noise = noise_around(time, residual, lines, fundamentals)
    return np.ones(len(fundamentals)) if noise is None else np.asarray(np.max(noise.variance / variance, axis=1))


def noise_around(time: FloatArray, residual: FloatArray, lines: FloatArray, wanted: FloatArray) -> LineNoise | None:
    """Return the noise at the wanted frequencies (W,) in the residual (S, C) of `lines`, None where too short."""
    grid = sampling_grid(time)
    if grid is None:
        return None
    filled = grid.filled(residual)
    both = alias_frequency(np.concatenate([wanted, lines]), grid.rate_hz)
    all_bins = both * grid.length / grid.rate_hz
    noise = line_noise(filled, len(time), all_bins)
    return None if noise is None else LineNoise(noise.variance[: len(wanted)], noise.dof[: len(wanted)])
