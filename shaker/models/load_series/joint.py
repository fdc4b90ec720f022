"""One load model fitted to the time records of all loads together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.load_series.chain_poles import upper_poles
from shaker.models.load_series.decay import FreeDecay, coloured, projected
from shaker.models.load_series.fit import CHANCE, SeriesFit, number_covariance
from shaker.models.load_series.least_squares import minimum
from shaker.models.load_series.problem import Problem

ALLOWED = 2.0
"""Excess over that of white noise that is taken for the noise's colour."""


def fit_decays(decays: tuple[FreeDecay, ...], noise: FloatArray, problem: Problem, start: SeriesFit) -> SeriesFit:
    """Return the parameters that explain all records at once, from those that explain their resonances.

    Unknown are what all records share, k, c, k_L, c_L and the named masses; level and complex amplitude of every mode
    are free in every record. `noise` (R,): standard deviations of what free modes leave, the weights. The covariance
    takes the colour of the noise from the residuals.
    """
    count = problem.springs + problem.dampers
    first = np.concatenate([_logarithms(problem, start.numbers), start.deviates])

    def rows(x: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        found = []
        for r, decay in enumerate(decays):
            poles, moved = _poles(problem, x, r)
            residual, slope = projected(decay, poles)
            by_x = slope @ np.stack([moved.real, moved.imag], axis=1).reshape(-1, len(x))
            found.append((residual / noise[r], by_x / noise[r]))
        prior = np.zeros((len(x) - count, len(x)))
        prior[:, count:] = np.eye(len(x) - count)
        return [*found, (x[count:], prior)]

    def stacked(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not problem.is_sound(x):
            return np.full(1, np.inf), np.zeros((1, len(x)))
        parts = rows(x)
        return np.concatenate([part for part, _ in parts]), np.vstack([slope for _, slope in parts])

    x, _ = minimum(stacked, first)
    parts = rows(x)
    inner = np.linalg.inv(sum((slope.T @ slope for _, slope in parts), np.zeros((len(x), len(x)))))
    middle = sum((coloured(slope, residual) for residual, slope in parts[:-1]), parts[-1][1].T @ parts[-1][1])
    (f, z), _ = problem.modes(x)
    return replace(
        start,
        numbers=problem.numbers(x),
        deviates=problem.deviates(x),
        covariance=number_covariance(problem, x, inner @ middle @ inner),
        frequency_hz=f,
        damping_ratio=z,
    )


def explains(decays: tuple[FreeDecay, ...], noise: FloatArray, problem: Problem, fit: SeriesFit) -> bool:
    """Return whether a model leaves no more of the records than modes of their own do, but for chance (1 in 1000).

    Σ |r|²/s² of the model less that of the free modes is a chi-squared with as many degrees of freedom as the model has
    fewer unknowns; twice its quantile is allowed, since the noise of a decimated record is not quite white.
    """
    from scipy.special import chdtri

    x = np.concatenate([_logarithms(problem, fit.numbers), fit.deviates])
    modes = np.sum(np.isfinite(problem.measured.frequency_hz), axis=1)
    more = 0.0
    for r, decay in enumerate(decays):
        residual, _ = projected(decay, _poles(problem, x, r)[0])
        more += float(residual @ residual) / float(noise[r]) ** 2 - (len(residual) - 1 - 4 * int(modes[r]))
    return more <= ALLOWED * float(chdtri(max(sum(problem.dof), 1), CHANCE))


def _poles(problem: Problem, x: FloatArray, record: int) -> tuple[ComplexArray, ComplexArray]:
    """Upper poles (M,) of one record and their derivatives (M, X)."""
    masses = problem.masses
    moving, loads = masses.at(problem.deviates(x))
    load = float(loads[record]) if masses.load[record] > 0 else 0.0
    poles, moved = upper_poles(problem.numbers(x), moving, load)
    by_mass = np.outer(moved[:, -2], masses.moving_effect) + np.outer(moved[:, -1], masses.load_effect[record])
    return poles, np.hstack([moved[:, :-2] @ problem.number_rates(x), by_mass])


def _logarithms(problem: Problem, numbers: FloatArray) -> FloatArray:
    """Logarithms of stiffnesses, then of the dampings that are unknowns."""
    return np.asarray(np.log(np.concatenate([numbers[::2], numbers[1::2][: problem.dampers]])))
