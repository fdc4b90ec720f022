"""Effects of undetected common errors where no reading can contradict them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.instrument_consistency import COVARIANCE_CUTOFF, NOTABLE_DEVIATION
from fusion.estimation.variance_components import MIN_DISCREPANCY_DOF, AddedCovariance, Contrasts, variance_components
from shakercal._common.arrays import FloatArray

if TYPE_CHECKING:
    from fusion.estimation.instrument_consistency import CommonEstimate
    from fusion.estimation.least_squares import FusionSolution, FusionSystem

NOT_EXCLUDED = 6.63
"""Difference of squared deviations below which both unknowns may be the cause: chi-square, 1 degree of freedom, 1 %."""


def undetected_errors(
    system: FusionSystem, solution: FusionSolution, unknowns: Sequence[CommonEstimate], label: str
) -> AddedCovariance | None:
    """Return the covariance of the readings by common errors that would explain a contradiction.

    These are the unknown that deviates most and all whose deviation is not smaller at 1 %, without gross errors: the
    data cannot distinguish them. Each instrument has such an error with the variance θ·d², d being the required size. θ
    is common to all and maximises the restricted likelihood in addition to the stated uncertainties. A camera that may
    have been rotated is so in every component, also in those that no other instrument observes; differences in the
    common components do not show these. None if no unknown deviates.
    """
    deviations = np.abs(np.nan_to_num([unknown.deviation for unknown in unknowns]))
    # A gross error is no better a cause than the others and must not displace possible ones.
    deviations = np.where([unknown.gross for unknown in unknowns], 0.0, deviations)
    largest = np.max(deviations, initial=0.0)
    if largest < NOTABLE_DEVIATION:
        return None
    chosen = np.flatnonzero(deviations**2 >= largest**2 - NOT_EXCLUDED).tolist()
    effects = solution.effects[:, chosen]
    required = np.array([unknowns[index].unconstrained_value / unknowns[index].u for index in chosen])
    # Several unknowns of the same instruments share its error.
    touched = [frozenset(system.observation[effect != 0.0].tolist()) for effect in effects.T]
    pattern = effects * required * np.asarray([1.0 / np.sqrt(touched.count(one)) for one in touched])
    seen = pattern.T @ solution.projector
    values, vectors = np.linalg.eigh(seen @ pattern)
    significant = values > COVARIANCE_CUTOFF * values[-1]
    # z = c/λ has the variance 1/λ as stated and 1/λ + θ with the undetected error: exhaustive for θ.
    estimates = (vectors[:, significant].T @ (seen @ system.readings)) / values[significant]
    group = Contrasts(estimates, np.diag(1.0 / values[significant]), np.eye(len(estimates))[None])
    (variance,), (dof,) = variance_components([group])
    every_line = np.full(len(system.observed), max(float(dof), MIN_DISCREPANCY_DOF))
    return AddedCovariance(label, variance * (pattern @ pattern.T), every_line)


def missing_covariance(required: FloatArray, allowed: FloatArray) -> FloatArray:
    """Return the part of a `required` covariance that an `allowed` one does not include.

    Both (K, 2C, 2C). For the covariance W of Re and Im of a value, the positive part M of W - A remains in each
    direction of the complex plane. The result is F·W·Fᵀ of all values together, with F = √M·√W⁻¹ for each.
    """
    lines, size = required.shape[:2]

    def each(covariance: FloatArray) -> FloatArray:
        parts = covariance.reshape(lines, 2, size // 2, 2, size // 2)
        return np.asarray(np.moveaxis(parts.diagonal(axis1=2, axis2=4), -1, 1))

    missing, axes = np.linalg.eigh(each(required) - each(allowed))
    root = (axes * np.sqrt(np.maximum(missing, 0.0))[:, :, None, :]) @ axes.swapaxes(2, 3)
    values, vectors = np.linalg.eigh(each(required))
    usable = values > COVARIANCE_CUTOFF * values[:, :, 1:]
    inverse = np.where(usable, 1.0 / np.sqrt(np.where(usable, values, 1.0)), 0.0)
    part = root @ (vectors * inverse[:, :, None, :]) @ vectors.swapaxes(2, 3)
    turn = np.zeros((lines, 2, size // 2, 2, size // 2))
    turn[:, :, np.arange(size // 2), :, np.arange(size // 2)] = part.swapaxes(0, 1)
    factor = turn.reshape(lines, size, size)
    return np.asarray(factor @ required @ factor.swapaxes(1, 2))
