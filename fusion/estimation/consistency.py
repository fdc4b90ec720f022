"""Whether instruments contradict each other, which, and what undetected common errors may do.

Instruments are judged all together, each against the prediction of the others, and each unknown against what is stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.least_squares import Solution, System
from fusion.estimation.uncertainty import real_design, real_stack
from fusion.estimation.variance_components import (
    LEAST_DOF,
    TEST_LEVEL,
    Contrasts,
    Discrepancy,
    fails,
    variance_components,
)
from shaker.arrays import BoolArray, ComplexArray, FloatArray, IntArray

if TYPE_CHECKING:
    from fusion.estimation.measurement_model import CommonError, Observation

RANK_TOLERANCE = 1e-11
UNTESTED = 0.99
"""An unknown of which more of its stated uncertainty remains after the estimate cannot be judged by the data."""
NOTABLE_DEVIATION = 3.5
"""An unknown that deviates by less, in standard deviations, explains nothing by itself."""
NOT_EXCLUDED = 6.63
"""Difference of squared deviations, chi-square of one degree of freedom at 1 %: both unknowns may be the cause."""
VISIBLE = 1e-9
"""Relative size from which on a direction of several values counts."""


@dataclass(frozen=True)
class CommonEstimate:
    """What the data say of one common error: `estimate` in standard uncertainties `u` (in `unit`), and what remains.

    `remaining`: standard uncertainty after the estimate over that before; 1 where the data cannot test it.
    """

    name: str
    label: str
    u: float
    unit: str
    estimate: float
    remaining: float

    @property
    def deviation(self) -> float:
        """Return the estimate over its standard deviation, standard normal if all is as stated; NaN if not testable.

        The variance of a posterior mean is 1 - remaining² in units of the prior's.
        """
        if not self.remaining < UNTESTED:
            return float("nan")
        return self.estimate / float(np.sqrt(1.0 - self.remaining**2))

    @property
    def wanted(self) -> float:
        """Return the value, in `unit`, that the readings ask for if nothing were stated of this unknown."""
        return self.u * self.estimate / (1.0 - self.remaining**2) if self.remaining < UNTESTED else float("nan")


@dataclass(frozen=True)
class Consistency:
    """How one instrument, or one channel of it, agrees with the prediction of all others.

    `normalised_deviation`: root of chi-square per degree of freedom of the leave-one-out difference (1 is expected,
    NaN where the others cannot predict it); `channels` of it; `used` in the fused estimate or only compared;
    `ratio`: measured over predicted at its largest reading, complex, NaN where it has no prediction; `suspect`: it
    deviates, and without it all others agree.
    """

    instrument: str
    normalised_deviation: float
    channels: int
    used: bool = True
    ratio: complex = complex(np.nan, np.nan)
    suspect: bool = False


def estimates(common: Sequence[CommonError], solution: Solution) -> tuple[CommonEstimate, ...]:
    """Return every common error with its estimate."""
    values = zip(common, solution.errors.tolist(), solution.remaining.tolist(), strict=True)
    return tuple(CommonEstimate(c.name, c.label, c.u, c.unit, value, left) for c, value, left in values)


def contradicts(solution: Solution, unknowns: Sequence[CommonEstimate]) -> bool:
    """Tell at 1 % whether readings contradict what is stated: by chi-square, or by the deviation of a single unknown.

    A camera that was turned hardly shows in the chi-square of a hundred readings, but in the unknown that is its turn.
    """
    from scipy.special import ndtr

    half = (1.0 + TEST_LEVEL) / 2.0
    deviations = np.array([unknown.deviation for unknown in unknowns])
    # Unknowns that the readings cannot tell apart deviate alike: together they are one test.
    tested = np.unique(np.round(np.abs(deviations[np.isfinite(deviations)]), 2))
    extreme = len(tested) > 0 and 2.0 * ndtr(-np.max(tested)) * len(tested) < 1.0 - half
    return bool(extreme) or fails(solution.chi2, solution.dof, half)


def leave_one_out(system: System, solution: Solution, contradicted: bool) -> tuple[Consistency, ...]:
    """Return for each channel or stereo pair, and each instrument of several channels, its readings against the others.

    Where readings are `contradicted`, those are suspect without which all others agree and whose chi-square is beyond
    what is expected by at least half of what any other's is.

    With q = P y the difference is d = P_II^-1 q_I with covariance P_II^-1, so that no fit is repeated; chi-square is
    q_I^T P_II^+ q_I on the rank of P_II, and that of the others is smaller by as much.
    """
    groups = [(name, system.member == place) for place, name in enumerate(system.member_names)]
    several = len(system.observations) > 1
    for place, observation in enumerate(system.observations):
        if several and len(set(observation.members)) > 1:
            groups.append((f"{observation.title} as a whole", system.observation == place))
    tests = [_left_out(system, solution, name, np.flatnonzero(mask)) for name, mask in groups]
    if not contradicted:
        return tuple(test for test, _, _ in tests)
    most = max(chi2 - dof for _, chi2, dof in tests)
    judged: list[Consistency] = []
    single: list[BoolArray] = []
    for (test, chi2, dof), (_, mask) in zip(tests, groups, strict=True):
        agrees = not fails(solution.chi2 - chi2, solution.dof - dof)
        # An instrument is not suspect for one of its channels.
        own = not any(np.all(mask[other]) for other in single)
        suspect = agrees and own and dof > 0 and chi2 - dof >= 0.5 * most
        single += [mask] if suspect else []
        judged.append(replace(test, suspect=suspect))
    return tuple(judged)


def deleted(
    projector: FloatArray, left: FloatArray, sizes: FloatArray, rows: IntArray, tolerance: float = RANK_TOLERANCE
) -> tuple[float, int, FloatArray | None]:
    """Return chi-square and degrees of freedom of readings against the prediction of all others, and the difference.

    Deletion formula of generalised least squares, `left` being projector · readings (N,); `sizes` (N,) make the
    readings comparable. The difference (n,) is None where the others do not predict all of them.
    """
    scale = sizes[rows]
    values, vectors = np.linalg.eigh(projector[np.ix_(rows, rows)] * np.outer(scale, scale))
    kept = values > tolerance
    turned = vectors[:, kept].T @ (scale * left[rows])
    difference = scale * (vectors @ (turned / values)) if np.all(kept) else None
    return float(np.sum(turned**2 / values[kept])), int(np.count_nonzero(kept)), difference


def _left_out(system: System, solution: Solution, name: str, rows: IntArray) -> tuple[Consistency, float, int]:
    """One group of readings against all others, with chi-square and degrees of freedom of their difference."""
    left, sizes = solution.projector @ system.readings, np.sqrt(np.diag(solution.noise))
    chi2, dof, difference = deleted(solution.projector, left, sizes, rows)
    channels = len(set(zip(system.observation[rows].tolist(), system.channel[rows].tolist(), strict=True)))
    if not dof:
        return Consistency(name, np.nan, channels), 0.0, 0
    ratio = complex(np.nan, np.nan)
    if difference is not None:
        # Measured over predicted phasor of the reading with the largest prediction.
        predicted = np.zeros(len(system.readings))
        predicted[rows] = system.readings[rows] - difference
        pairs = system.pairs[np.isin(system.pairs[:, 0], rows)]
        phasors = predicted[pairs[:, 0]] + 1j * predicted[pairs[:, 1]]
        largest = int(np.argmax(np.abs(phasors)))
        if phasors[largest] != 0.0:
            re, im = system.readings[pairs[largest]]
            ratio = complex((re + 1j * im) / phasors[largest])
    return Consistency(name, float(np.sqrt(chi2 / dof)), channels, True, ratio), chi2, dof


def compare(observation: Observation, acceleration: ComplexArray, covariance: FloatArray) -> tuple[Consistency, ...]:
    """Return how the members of an instrument that was not fused agree with A (K, 6) and its covariance (K, 12, 12)."""
    compared = []
    names = np.array(observation.members)
    for name in dict.fromkeys(observation.members):
        chi2, count, size, ratio = 0.0, 0, 0.0, complex(np.nan, np.nan)
        for k, value in enumerate(observation.phasors.value):
            rows = np.flatnonzero((names == name) & np.isfinite(value))
            design = observation.design[k, rows]
            usable = np.all((design == 0.0) | np.isfinite(acceleration[k]), axis=1)
            rows, design = rows[usable], design[usable]
            predicted = design @ np.nan_to_num(acceleration[k])
            both = np.concatenate([rows, rows + len(names)])
            jacobian = real_design(design)
            spread = observation.phasors.covariance[k][np.ix_(both, both)]
            spread = spread + jacobian @ np.nan_to_num(covariance[k]) @ jacobian.T
            difference = real_stack(value[rows] - predicted)
            chi2 += float(difference @ np.linalg.pinv(spread, rcond=1e-12, hermitian=True) @ difference)
            count += len(both)
            place = int(np.argmax(np.abs(predicted))) if len(rows) else -1
            if place >= 0 and abs(predicted[place]) > size:
                size = float(abs(predicted[place]))
                ratio = complex(value[rows[place]] / predicted[place])
        deviation = float(np.sqrt(chi2 / count)) if count else np.nan
        compared.append(Consistency(name, deviation, int(np.sum(names == name)), False, ratio))
    return tuple(compared)


# What undetected common errors, which would explain a contradiction, do where nothing can contradict.


def undetected_errors(
    system: System, solution: Solution, unknowns: Sequence[CommonEstimate], label: str
) -> Discrepancy | None:
    """Return the covariance of the readings by the common errors of which one would explain a contradiction.

    These are the unknown that deviates most and all whose deviation is not smaller at 1 %: the data do not tell which
    of them it is. Each instrument's, an error of the size d that the readings ask for, has the variance θ·d²; θ is
    common to all and of greatest restricted likelihood beside what is stated. A camera that may have been turned has
    been so in every component, also in those that no other instrument sees: what instruments differ by in the
    components that they share says nothing of these. None where no unknown deviates.
    """
    deviations = np.abs(np.nan_to_num([unknown.deviation for unknown in unknowns]))
    most = np.max(deviations, initial=0.0)
    if most < NOTABLE_DEVIATION:
        return None
    chosen = np.flatnonzero(deviations**2 >= most**2 - NOT_EXCLUDED).tolist()
    effects = solution.effects[:, chosen]
    wanted = np.array([unknowns[place].wanted / unknowns[place].u for place in chosen])
    # Several of the same instruments share its error.
    touched = [frozenset(system.observation[effect != 0.0].tolist()) for effect in effects.T]
    pattern = effects * wanted * np.asarray([1.0 / np.sqrt(touched.count(own)) for own in touched])
    seen = pattern.T @ solution.projector
    values, vectors = np.linalg.eigh(seen @ pattern)
    kept = values > VISIBLE * values[-1]
    # z = c/λ has the variance 1/λ as stated and 1/λ + θ with the undetected error: exhaustive for θ.
    known = (vectors[:, kept].T @ (seen @ system.readings)) / values[kept]
    group = Contrasts(known, np.diag(1.0 / values[kept]), np.eye(len(known))[None])
    (variance,), (dof,) = variance_components([group])
    every_line = np.full(len(system.observed), max(float(dof), LEAST_DOF))
    return Discrepancy(label, variance * (pattern @ pattern.T), every_line)


def not_allowed_for(wanted: FloatArray, allowed: FloatArray) -> FloatArray:
    """Return the part of a `wanted` covariance (K, 2C, 2C) that an `allowed` one does not contain, value by value.

    Of the covariance W of Re and Im of a value remains the positive part M of W - A in whatever direction of the
    complex plane: F·W·Fᵀ of all values together, F = √M·√W⁻¹ for each.
    """
    lines, size = wanted.shape[:2]

    def each(covariance: FloatArray) -> FloatArray:
        """Covariances (K, C, 2, 2) of Re and Im of each value."""
        parts = covariance.reshape(lines, 2, size // 2, 2, size // 2)
        return np.asarray(np.moveaxis(parts.diagonal(axis1=2, axis2=4), -1, 1))

    missing, axes = np.linalg.eigh(each(wanted) - each(allowed))
    root = (axes * np.sqrt(np.maximum(missing, 0.0))[:, :, None, :]) @ axes.swapaxes(2, 3)
    values, vectors = np.linalg.eigh(each(wanted))
    usable = values > VISIBLE * values[:, :, 1:]
    inverse = np.where(usable, 1.0 / np.sqrt(np.where(usable, values, 1.0)), 0.0)
    part = root @ (vectors * inverse[:, :, None, :]) @ vectors.swapaxes(2, 3)
    turn = np.zeros((lines, 2, size // 2, 2, size // 2))
    turn[:, :, np.arange(size // 2), :, np.arange(size // 2)] = part.swapaxes(0, 1)
    factor = turn.reshape(lines, size, size)
    return np.asarray(factor @ wanted @ factor.swapaxes(1, 2))
