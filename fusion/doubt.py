"""What stated unknowns that would explain a contradiction do to components in which nothing can contradict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.consistency import CommonEstimate
from fusion.discrepancy import LEAST_DOF, Contrasts, Discrepancy, variance_components
from fusion.estimate import Solution
from fusion.system import System
from shaker._checks import FloatArray, IntArray

NOTABLE_DEVIATION = 3.5
"""An unknown that deviates by less, in standard deviations, explains nothing by itself."""
NOT_EXCLUDED = 6.63
"""Difference of squared deviations, chi-square of one degree of freedom at 1 %: both unknowns may be the cause."""
RANK_TOLERANCE = 1e-9


def doubt(system: System, solution: Solution, unknowns: Sequence[CommonEstimate], label: str) -> Discrepancy | None:
    """Return the covariance of the readings by unknowns in doubt: those of which one would explain a contradiction.

    In doubt are the unknown that deviates most and all whose deviation is not smaller at 1 %: the data do not tell
    which of them it is. Each instrument's, an error of the size d that the readings ask for, has the variance θ·d²; θ
    is common to all and of greatest restricted likelihood beside what is stated. A camera that is in doubt for being
    turned is so in every component, also in those that no other instrument sees: what instruments differ by in the
    components that they share says nothing of these. None where no unknown deviates.
    """
    chosen = _in_doubt(unknowns)
    if not len(chosen):
        return None
    wanted = np.array([unknowns[place].wanted / unknowns[place].u for place in chosen])
    pattern = solution.effects[:, chosen] * wanted * _shares(system, solution.effects[:, chosen])
    seen = pattern.T @ solution.projector
    values, vectors = np.linalg.eigh(seen @ pattern)
    kept = values > RANK_TOLERANCE * values[-1]
    # z = c/λ has the variance 1/λ as stated and 1/λ + θ with the doubt: exhaustive for θ.
    known = (vectors[:, kept].T @ (seen @ system.readings)) / values[kept]
    group = Contrasts(known, np.diag(1.0 / values[kept]), np.eye(len(known))[None])
    (variance,), (dof,) = variance_components([group])
    found = np.full(len(system.observed), max(float(dof), LEAST_DOF))
    return Discrepancy(label, variance * (pattern @ pattern.T), found)


def not_allowed_for(wanted: FloatArray, allowed: FloatArray) -> FloatArray:
    """Return the part of a `wanted` covariance (K, 2C, 2C) that an `allowed` one does not contain, value by value.

    Of the covariance W of Re and Im of a value remains the positive part M of W - A in whatever direction of the
    complex plane: F·W·Fᵀ of all values together, F = √M·√W⁻¹ for each.
    """
    own, there = _blocks(wanted), _blocks(allowed)
    missing, axes = np.linalg.eigh(own - there)
    root = (axes * np.sqrt(np.maximum(missing, 0.0))[:, :, None, :]) @ axes.swapaxes(2, 3)
    values, vectors = np.linalg.eigh(own)
    usable = values > RANK_TOLERANCE * values[:, :, 1:]
    inverse = np.where(usable, 1.0 / np.sqrt(np.where(usable, values, 1.0)), 0.0)
    part = root @ (vectors * inverse[:, :, None, :]) @ vectors.swapaxes(2, 3)
    lines, count = part.shape[:2]
    turn = np.zeros((lines, 2, count, 2, count))
    turn[:, :, np.arange(count), :, np.arange(count)] = part.swapaxes(0, 1)
    factor = turn.reshape(lines, 2 * count, 2 * count)
    return np.asarray(factor @ wanted @ factor.swapaxes(1, 2))


def _blocks(covariance: FloatArray) -> FloatArray:
    """Covariances (K, C, 2, 2) of Re and Im of each value."""
    lines, size = covariance.shape[:2]
    parts = covariance.reshape(lines, 2, size // 2, 2, size // 2)
    return np.asarray(np.moveaxis(parts.diagonal(axis1=2, axis2=4), -1, 1))


def _in_doubt(unknowns: Sequence[CommonEstimate]) -> IntArray:
    """Places of the unknown that deviates most and of those that may be the cause as well."""
    deviations = np.abs(np.nan_to_num([unknown.deviation for unknown in unknowns]))
    largest = np.max(deviations, initial=0.0)
    if largest < NOTABLE_DEVIATION:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(deviations**2 >= largest**2 - NOT_EXCLUDED)


def _shares(system: System, effects: FloatArray) -> FloatArray:
    """Factors (E,) of effects (N, E): one over the root of how many are of the same instruments."""
    touched = [frozenset(system.observation[effect != 0.0].tolist()) for effect in effects.T]
    return np.asarray([1.0 / np.sqrt(touched.count(own)) for own in touched])
