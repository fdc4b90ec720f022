"""Systems solved without gross errors, and with discrepancies where the readings contradict their statements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.estimation.instrument_consistency import (
    COVARIANCE_CUTOFF,
    NOTABLE_DEVIATION,
    CommonEstimate,
    Consistency,
    Suspicion,
    common_estimates,
    contradicts,
    find_suspicions,
    leave_one_out,
    without_readings,
)
from fusion.estimation.least_squares import FusionSolution, FusionSystem, bounded_system, solve
from fusion.estimation.measurement_model import Observation, UnobservedMotion
from fusion.estimation.variance_components import (
    MIN_DISCREPANCY_DOF,
    AddedCovariance,
    Contrasts,
    EstimatedNoise,
    Scatter,
    contradictory_lines,
    estimate_scatter,
    instrument_discrepancy,
    scatter_covariances,
    variance_components,
)
from shakercal._common.arrays import FloatArray

INCONSISTENCY = "inconsistency of instruments"
MOST_LEFT_OUT = 4
"""Gross errors that are looked for one after another."""
NOT_EXCLUDED = 6.63
"""Difference of squared deviations below which both unknowns may be the cause: chi-square, 1 degree of freedom, 1 %."""


@dataclass(frozen=True)
class ConsistentSolution:
    """A `system` without gross errors, solved as stated, and with discrepancies where readings contradict that.

    `stated`: solution by the stated uncertainties. `final`: solution with the discrepancies `parts`. `scatter`: of
    instruments whose readings contradict a rigid motion. `birge`: factor of variances if the lines agree separately and
    contradict each other only together. `undetected`: unknowns that may cause a contradiction, which U includes also in
    components that a single instrument observes. `contradicted`: whether the readings contradict the stated
    uncertainties; `suspicions`: explanations of that. `rejected`: tests of the rejected readings.
    """

    system: FusionSystem
    stated: FusionSolution
    final: FusionSolution
    scatter: tuple[Scatter, ...]
    parts: tuple[AddedCovariance, ...]
    birge: float
    undetected: AddedCovariance | None
    contradicted: bool
    suspicions: tuple[Suspicion, ...]
    rejected: tuple[Consistency, ...]


def solve_consistently(
    observations: Sequence[Observation],
    unobserved_motion: UnobservedMotion | None = None,
    scatter: tuple[Scatter, ...] | None = None,
) -> ConsistentSolution:
    """Solve the system of some observations, with the discrepancies that `fuse` describes.

    A reading is rejected (NaN) if it alone explains that readings contradict each other, one after another. If several
    would explain it, none is rejected.
    """
    rejected: list[Consistency] = []
    for remaining in range(MOST_LEFT_OUT, -1, -1):
        system = bounded_system(observations, unobserved_motion)
        first = solve(system)
        contradicted = contradicts(system, first, common_estimates(system.common, first))
        found = find_suspicions(system, first) if contradicted else ()
        if not remaining or len(found) != 1 or len(found[0].names) > 1 or not found[0].gross:
            break
        tests = leave_one_out(system, first, found[0].names)
        rejected += [replace(test, used=False, left_out=True) for test in tests if test.suspect]
        observations = without_readings(system, found[0].rows)
    scatter = estimate_scatter(system, first) if scatter is None else scatter
    parts = scatter_covariances(system, first.acceleration, scatter)
    final = solve(system, np.sum([p.covariance for p in parts], axis=0)) if parts else first
    birge, undetected = 1.0, None
    unknowns = common_estimates(system.common, final)
    if contradicts(system, final, unknowns) if parts else contradicted:
        undetected = undetected_errors(system, final, unknowns, INCONSISTENCY)
        failing = contradictory_lines(system, final)
        parts.append(instrument_discrepancy(system, final, failing or range(len(system.observed)), INCONSISTENCY))
        final = solve(system, np.sum([p.covariance for p in parts], axis=0))
        noise = EstimatedNoise.from_system(system, final.effects)
        beyond = not failing and noise.fails(final.chi2, final.dof, final.projector)
        birge = final.chi2 / final.dof if beyond else 1.0
    unexplained = birge, undetected, contradicted, found
    return ConsistentSolution(system, first, final, scatter, tuple(parts), *unexplained, tuple(rejected))


# Undetected common errors where no reading can contradict them.


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
