"""Consistency tests of instruments, and explanations of contradictions.

Instruments are tested all together, each against the prediction of the others, and each unknown against its statement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.least_squares import FusionSolution, FusionSystem, drop_rows, solve
from fusion.estimation.uncertainty import as_complex, real_stack
from fusion.estimation.variance_components import TEST_CONFIDENCE, EstimatedNoise, fails
from shaker.sine.phasor import real_stacked
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.digits import number_text

if TYPE_CHECKING:
    from fusion.estimation.measurement_model import CommonError, Observation

RANK_TOLERANCE = 1e-11
UNTESTABLE_SHARE = 0.99
"""Ratio of the uncertainty after the fit to the stated one, above which data cannot test an unknown (chosen)."""
NOTABLE_DEVIATION = 3.5
"""Standard deviations that an unknown must exceed to explain a contradiction (probability 5e-4 by chance)."""
COVARIANCE_CUTOFF = 1e-9
"""Relative eigenvalue of a covariance below which a direction is treated as singular: well above rounding."""
GROSS_FACTOR = 10.0
"""Multiple of the stated uncertainty above which an error is gross or its statement wrong (chosen)."""
MISTAKES = (
    (-1.0, "its sign were reversed"),
    (9.80665, "values in m/s² were treated as values in g"),
    (1.0 / 9.80665, "values in g were treated as values in m/s²"),
    (1e3, "the stated unit were a thousand times too large, such as V for mV"),
    (1e-3, "the stated unit were a thousand times too small, such as mV for V"),
    (10.0, "its scale were ten times too large"),
    (0.1, "its scale were ten times too small"),
    (100.0, "its scale were a hundred times too large"),
    (0.01, "its scale were a hundred times too small"),
    (2.0, "its scale were twice the true one, such as that of another range"),
    (0.5, "its scale were half the true one, such as that of another range"),
    (2.0**0.5, "peak values were treated as rms values"),
    (0.5**0.5, "rms values were treated as peak values"),
)
"""Ratios reading/prediction, each with the mistake that causes it (continues "as if ...")."""
OUTPUT_MISTAKES = (MISTAKES[0], *MISTAKES[3:5])
"""Mistakes that the sensor's outputs may show: sign and unit."""
MISTAKE_TOLERANCE = 0.03
"""Relative distance between a ratio and one of `MISTAKES` up to which the mistake is reported (chosen)."""
LOST_SHARE = 1e-6
"""Share of an estimate that only the suspect readings determine, above which it is lost without them."""
MAX_PAIR_CANDIDATES = 12
"""Most channels and instruments, those that deviate most, whose pairs are tested (limits the time)."""
NORMAL_QUANTILE = 2.576
"""Standard deviations that the size of a normal value exceeds with a probability of 1 %."""
DETECTABLE_NONCENTRALITY = 25.0
"""Noncentrality of chi-square above which a deviation is practically always detected (5 standard deviations)."""


@dataclass(frozen=True)
class CommonEstimate:
    """Estimate of one common error in multiples of its stated standard uncertainty `u`.

    `u` is in `unit`. `remaining`: ratio of the standard uncertainty after the fit to the stated one; 1 if the data
    cannot test it.
    """

    name: str
    label: str
    u: float
    unit: str
    estimate: float
    remaining: float

    @property
    def deviation(self) -> float:
        """Return the estimate over its standard deviation, NaN if the data cannot test it.

        It is standard normal if the statements are correct. The variance of a posterior mean is 1 - remaining² in units
        of the prior's.
        """
        if not self.remaining < UNTESTABLE_SHARE:
            return float("nan")
        return self.estimate / float(np.sqrt(1.0 - self.remaining**2))

    @property
    def unconstrained_value(self) -> float:
        """Return the value, in `unit`, that the readings alone require."""
        return self.u * self.estimate / (1.0 - self.remaining**2) if self.remaining < UNTESTABLE_SHARE else float("nan")

    @property
    def gross(self) -> bool:
        """Return whether the readings alone require more than 10 u, by two standard deviations."""
        if not self.remaining < UNTESTABLE_SHARE:
            return False
        certain = 1.0 - self.remaining**2
        return bool(abs(self.estimate) / certain - 2.0 * self.remaining / np.sqrt(certain) > GROSS_FACTOR)


@dataclass(frozen=True)
class Consistency:
    """Agreement of one instrument, or one channel of it, with the prediction of all others.

    `normalised_deviation`: root of chi-square per degree of freedom of the leave-one-out difference. 1 is expected; NaN
    if the others cannot predict it. `channels`: number of channels. `used`: part of the fused estimate, not only
    compared with it. `ratio`: complex, measured over predicted at its largest reading, NaN without a prediction.
    `suspect`: it deviates, and all others agree without it (or without it and another). `left_out`: rejected because of
    a gross error.
    """

    instrument: str
    normalised_deviation: float
    channels: int
    used: bool = True
    ratio: complex = complex(np.nan, np.nan)
    suspect: bool = False
    left_out: bool = False


def common_estimates(common: Sequence[CommonError], solution: FusionSolution) -> tuple[CommonEstimate, ...]:
    """Return every common error with its estimate."""
    values = zip(common, solution.errors.tolist(), solution.remaining.tolist(), strict=True)
    return tuple(CommonEstimate(c.name, c.label, c.u, c.unit, value, left) for c, value, left in values)


def contradicts(system: FusionSystem, solution: FusionSolution, unknowns: Sequence[CommonEstimate]) -> bool:
    """Return whether the readings contradict the stated uncertainties at 1 % significance.

    The tests are chi-square and the deviation of every single unknown. A rotated camera hardly affects the chi-square
    of a hundred readings, but it appears in the unknown of its rotation.
    """
    half = (1.0 + TEST_CONFIDENCE) / 2.0
    deviations = np.nan_to_num([unknown.deviation for unknown in unknowns])
    # Unknowns that the readings cannot distinguish have equal deviations: together they are one test.
    tests = len(np.unique(np.round(np.abs(deviations[[np.isfinite(unknown.deviation) for unknown in unknowns]]), 2)))
    noise = EstimatedNoise.from_system(system, solution.effects)
    if noise.fails(solution.chi2, solution.dof, solution.projector, half):
        return True
    level = 1.0 - (1.0 - half) / max(tests, 1)
    for index in np.flatnonzero([fails(deviation**2, 1, level) for deviation in deviations]).tolist():
        weights = solution.projector @ solution.effects[:, index]
        weights = np.outer(weights, weights) / (1.0 - unknowns[index].remaining ** 2)
        if noise.fails(float(deviations[index] ** 2), 1, weights, level):
            return True
    return False


def leave_one_out(
    system: FusionSystem, solution: FusionSolution, suspects: Sequence[str] = ()
) -> tuple[Consistency, ...]:
    """Return the tests of each channel, stereo pair and multi-channel instrument against all others.

    With q = P y the difference is d = P_II^-1 q_I with covariance P_II^-1, so that no fit is repeated. Chi-square is
    q_I^T P_II^+ q_I, with the rank of P_II as degrees of freedom. The chi-square of the others is smaller by the same
    amount. `suspects`: names in an explanation.
    """
    tests = [_test_group(system, solution, name, rows) for name, rows in _groups(system)]
    return tuple(replace(test, suspect=test.instrument in suspects) for test in tests)


def _groups(system: FusionSystem) -> list[tuple[str, IntArray]]:
    """Return the rows of each channel, stereo pair, and instrument of several channels."""
    groups = [(name, np.flatnonzero(system.member == index)) for index, name in enumerate(system.member_names)]
    for index, observation in enumerate(system.observations):
        rows = np.flatnonzero(system.observation == index)
        if len(rows) < len(system.readings) and len(np.unique(system.member[rows])) > 1:
            groups.append((f"{observation.title} as a whole", rows))
    return [(name, rows) for name, rows in groups if len(rows)]


def leave_out_rows(
    projector: FloatArray,
    weighted_residuals: FloatArray,
    scales: FloatArray,
    rows: IntArray,
    tolerance: float = RANK_TOLERANCE,
) -> tuple[float, int, FloatArray | None]:
    """Return chi-square, degrees of freedom and difference of readings from the others' prediction.

    This is the deletion formula of generalised least squares. `weighted_residuals` (N,) is projector · readings. The
    `scales` (N,), such as standard uncertainties, make the readings comparable. The difference (n,) is None if the
    others do not predict all of these readings.
    """
    scale, root, tested, blind, white = _testable_directions(projector, weighted_residuals, scales, rows, tolerance)
    difference = None if blind.shape[1] else scale * (tested @ (white / root))
    return float(white @ white), len(white), difference


def _testable_directions(
    projector: FloatArray,
    weighted_residuals: FloatArray,
    scales: FloatArray,
    rows: IntArray,
    tolerance: float = RANK_TOLERANCE,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Decompose the scaled P_II of some rows into testable directions (n, r).

    Returns the scales (n,) of the rows, the square roots (r,) of the eigenvalues, their vectors (n, r), those (n, n-r)
    that no other reading tests, and the whitened P·y (r,) of the rows, of variance one.
    """
    scale = scales[rows]
    values, vectors = np.linalg.eigh(projector[np.ix_(rows, rows)] * np.outer(scale, scale))
    testable = values > tolerance
    root, tested = np.sqrt(values[testable]), vectors[:, testable]
    return scale, root, tested, vectors[:, ~testable], tested.T @ (scale * weighted_residuals[rows]) / root


def _test_group(system: FusionSystem, solution: FusionSolution, name: str, rows: IntArray) -> Consistency:
    """Return the test of one group of readings against all others."""
    weighted_residuals, scales = solution.projector @ system.readings, np.sqrt(np.diag(solution.noise))
    chi2, dof, difference = leave_out_rows(solution.projector, weighted_residuals, scales, rows)
    channels = len(set(zip(system.observation[rows].tolist(), system.channel[rows].tolist(), strict=True)))
    if not dof:
        return Consistency(name, np.nan, channels)
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
    return Consistency(name, float(np.sqrt(chi2 / dof)), channels, True, ratio)


def compare_with_estimate(
    observation: Observation, acceleration: ComplexArray, covariance: FloatArray
) -> tuple[Consistency, ...]:
    """Test each member of an instrument that was not used against the estimate."""
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
            jacobian = real_stacked(design)
            spread = observation.phasors.covariance[k][np.ix_(both, both)]
            spread = spread + jacobian @ np.nan_to_num(covariance[k]) @ jacobian.T
            difference = real_stack(value[rows] - predicted)
            chi2 += float(difference @ np.linalg.pinv(spread, rcond=1e-12, hermitian=True) @ difference)
            count += len(both)
            index = int(np.argmax(np.abs(predicted))) if len(rows) else -1
            if index >= 0 and abs(predicted[index]) > size:
                size = float(abs(predicted[index]))
                ratio = complex(value[rows[index]] / predicted[index])
        deviation = float(np.sqrt(chi2 / count)) if count else np.nan
        compared.append(Consistency(name, deviation, int(np.sum(names == name)), False, ratio))
    return tuple(compared)


# Explanations of a contradiction: some readings are wrong, and the estimate is that of the others.


@dataclass(frozen=True)
class Explanation:
    """Estimate without the readings of a `suspect`: a channel, an instrument, or two of these.

    `value` (K, 6) from all other readings and its `covariance` (K, 12, 12), NaN where these do not determine it.
    `gross`: even ten times the stated uncertainties of the suspect do not explain its difference from the others.
    """

    suspect: str
    value: ComplexArray
    covariance: FloatArray
    gross: bool


@dataclass(frozen=True)
class Suspicion:
    """Groups of readings that may be wrong together, and the estimate without them.

    `names`, `rows`: of the groups. `chi2`, `dof`: of their difference from the prediction of the others. `weight_root`
    (N, r): root of the matrix Θ of this chi-square, `weights`. `change` (12K,): change of the estimate without these
    groups, equal to `change_gain` (12K, n) · (P y) of the rows. `change_root` (12K, r): root of its covariance. `lost`
    (12K,): values that the others do not determine. `tenfold_change` (12K,): change of the estimate if ten times the
    uncertainty of the rows were stated. `gross`: ten times the uncertainty does not remove the contradiction.
    """

    names: tuple[str, ...]
    rows: IntArray
    chi2: float
    dof: int
    change: FloatArray
    change_gain: FloatArray
    change_root: FloatArray
    lost: BoolArray
    tenfold_change: FloatArray
    gross: bool
    weight_root: FloatArray

    @property
    def weights(self) -> FloatArray:
        """Return Θ (N, N), so that chi-square is yᵀ·Θ·y."""
        return np.asarray(self.weight_root @ self.weight_root.T)

    @property
    def excess(self) -> float:
        """Return chi-square minus its expectation."""
        return self.chi2 - self.dof


def evaluate_suspicion(
    system: FusionSystem, solution: FusionSolution, names: tuple[str, ...], rows: IntArray
) -> Suspicion:
    """Evaluate the suspicion that some readings have an arbitrary error.

    An arbitrary error δ of the readings I, estimated together with the motion, is δ = P_II⁺ q_I with q = P y and
    covariance P_II⁺. The estimate becomes gain · (y - δ), and its covariance grows by gain_I P_II⁺ gain_Iᵀ. Values that
    depend on a direction in which P_II is singular are lost.

    If δ has the covariance c·W instead, W being the stated one of the readings I, its best estimate is c·W·(1 +
    c·P_II·W)⁻¹ q_I. With c = 10² - 1 this is the estimate from all readings, these with ten times their stated
    uncertainty, and no value is lost. With c = (10/2.58)² - 1, a test at 1 % fails for errors above ten standard
    uncertainties. If the readings still fail, the error is gross.
    """
    scales = np.sqrt(np.diag(solution.noise))
    weighted_residuals = solution.projector @ system.readings
    scale, root, tested, blind, white = _testable_directions(solution.projector, weighted_residuals, scales, rows)
    gain = solution.gain[:, rows] * scale
    spread = gain @ (tested / root)
    reach = np.linalg.norm(solution.gain * scales, axis=1)
    lost = np.linalg.norm(gain @ blind, axis=1) > LOST_SHARE * reach
    scaled_effects = solution.effects[rows] / scale[:, None]
    stated = solution.noise[np.ix_(rows, rows)] / np.outer(scale, scale) + scaled_effects @ scaled_effects.T
    seen = tested * root
    inner, unit = seen.T @ stated @ seen, np.eye(len(white))
    limit = (GROSS_FACTOR / NORMAL_QUANTILE) ** 2 - 1.0
    chi2, dof = float(white @ white), len(white)
    all_rows = solution.projector[:, rows] @ (scale[:, None] * tested / root)
    gross = chi2 - dof > DETECTABLE_NONCENTRALITY and EstimatedNoise.from_system(system, solution.effects).fails(
        float(white @ np.linalg.solve(unit + limit * inner, white)), dof, all_rows @ all_rows.T
    )
    more = GROSS_FACTOR**2 - 1.0
    tenfold = -gain @ (more * stated @ seen @ np.linalg.solve(unit + more * inner, white))
    pull = -(spread / root) @ tested.T * scale
    return Suspicion(names, rows, chi2, dof, -spread @ white, pull, spread, lost, tenfold, gross, all_rows)


def find_suspicions(system: FusionSystem, solution: FusionSolution) -> tuple[Suspicion, ...]:
    """Return the explanations of a contradiction with the fewest wrong groups of readings.

    A group is suspect if all others agree at 1 % without it and its chi-square exceeds the expectation by at least half
    of the largest excess. An instrument is not suspect because of one of its channels. Without such a group, pairs of
    those that deviate most are examined; without such a pair, every instrument that deviates is suspect.
    """
    every = [evaluate_suspicion(system, solution, (name,), rows) for name, rows in _groups(system)]
    every = [one for one in every if one.dof]
    noise = EstimatedNoise.from_system(system, solution.effects)

    def agreeing(some: Sequence[Suspicion]) -> list[Suspicion]:
        most = max((one.excess for one in some), default=0.0)
        chosen: list[Suspicion] = []
        for one in some:
            separate = not any(np.all(np.isin(other.rows, one.rows)) for other in chosen)
            agrees = not noise.fails(solution.chi2 - one.chi2, solution.dof - one.dof, solution.projector - one.weights)
            chosen += [one] if separate and agrees and one.excess >= 0.5 * most else []
        return chosen

    found = agreeing(every)
    if not found:
        first = sorted(every, key=lambda one: -one.excess)[:MAX_PAIR_CANDIDATES]
        pairs = [both for both in combinations(first, 2) if not np.intersect1d(both[0].rows, both[1].rows).size]
        found = agreeing(
            [
                evaluate_suspicion(system, solution, a.names + b.names, np.sort(np.concatenate([a.rows, b.rows])))
                for a, b in pairs
            ]
        )
    if not found:
        indices = range(len(system.observations))
        whole = [one for one in every if any(len(one.rows) == np.sum(system.observation == index) for index in indices)]
        found = [one for one in whole if noise.fails(one.chi2, one.dof, one.weights)]
    return tuple(_limit_to_deviating_lines(system, solution, one) for one in found)


def _limit_to_deviating_lines(system: FusionSystem, solution: FusionSolution, whole: Suspicion) -> Suspicion:
    """Return the suspicion limited to the lines at which the suspect readings may be wrong.

    A line is dropped if its readings agree although such an error would be visible there. An artefact at a harmonic is
    no evidence against an instrument at the fundamental. The relative size of the error is the largest that a line
    requires, √(χ²/λ), with the noncentrality λ of readings that are wrong by their whole size.
    """
    line, noise = system.line[whole.rows], EstimatedNoise.from_system(system, solution.effects)
    parts = [whole.rows[line == k] for k in np.unique(line).tolist()]
    each = [evaluate_suspicion(system, solution, whole.names, rows) for rows in parts]
    # Chi-square of one line against other instruments: that of all the suspect's lines minus that of the others.
    others = [
        evaluate_suspicion(system, solution, whole.names, whole.rows[line != k]) for k in np.unique(line).tolist()
    ]
    wrong = [float(system.readings[r] @ solution.projector[np.ix_(r, r)] @ system.readings[r]) for r in parts]
    size2 = max((one.chi2 / power for one, power in zip(each, wrong, strict=True) if power > 0.0), default=0.0)
    remaining = [
        rows
        for rows, rest, power in zip(parts, others, wrong, strict=True)
        if noise.fails(whole.chi2 - rest.chi2, whole.dof - rest.dof, whole.weights - rest.weights)
        or size2 * power <= DETECTABLE_NONCENTRALITY
    ]
    if not remaining or len(remaining) == len(parts):
        return whole
    less = evaluate_suspicion(system, solution, whole.names, np.concatenate(remaining))
    weights = solution.projector - less.weights
    return whole if noise.fails(solution.chi2 - less.chi2, solution.dof - less.dof, weights) else less


def estimate_explanations(
    system: FusionSystem, solution: FusionSolution, found: Sequence[Suspicion]
) -> tuple[Explanation, ...]:
    """Return for each suspicion the estimate from all other readings."""
    lines = len(system.observed)
    before = stated_covariance(solution, solution.gain.reshape(lines, 12, -1))
    result = []
    for one in found:
        lost = (one.lost.reshape(lines, 12)[:, :6] | one.lost.reshape(lines, 12)[:, 6:]) | ~system.observed
        spread = one.change_root.reshape(lines, 12, -1)
        unknown = np.tile(lost, (1, 2))
        covariance = before + spread @ spread.swapaxes(1, 2)
        change = as_complex(one.change.reshape(lines, 12))
        result.append(
            Explanation(
                " and ".join(one.names),
                np.where(lost, complex(np.nan, np.nan), solution.acceleration + change),
                np.where(unknown[:, :, None] | unknown[:, None, :], np.nan, covariance),
                one.gross,
            )
        )
    return tuple(result)


def stated_covariance(solution: FusionSolution, gain: FloatArray) -> FloatArray:
    """Return the covariance (..., 12, 12) of gain · readings by stated uncertainties."""
    effects = gain @ solution.effects
    return np.asarray(gain @ solution.noise @ gain.swapaxes(-1, -2) + effects @ effects.swapaxes(-1, -2))


def disputed_values(system: FusionSystem, solution: FusionSolution, found: Sequence[Suspicion]) -> BoolArray:
    """Return a mask (K, 6) of values that differ between gross suspicions of several instruments.

    The mask is empty unless there are at least two explanations, all are gross errors, and they concern more than one
    instrument. A value is disputed if two explanations differ at 1 % significance, or if one does not determine it.
    """
    blamed = {index for one in found for index in np.unique(system.observation[one.rows]).tolist()}
    if len(found) < 2 or len(blamed) < 2 or not all(one.gross for one in found):
        return np.zeros_like(system.observed)
    unclear = np.any([one.lost.reshape(-1, 2, 6).any(axis=1) for one in found], axis=0)
    for one, other in combinations(found, 2):
        pull = np.zeros((one.change.size, len(system.readings)))
        pull[:, one.rows] += one.change_gain
        pull[:, other.rows] -= other.change_gain
        parts = pull.reshape(-1, 2, 6, len(system.readings)).swapaxes(1, 2)
        covariance = parts @ solution.projector @ parts.swapaxes(2, 3)
        change = parts @ (solution.projector @ system.readings)
        inverse = np.linalg.pinv(covariance, rcond=COVARIANCE_CUTOFF, hermitian=True)
        square = np.einsum("kca,kcab,kcb->kc", change, inverse, change)
        unclear |= square > -2.0 * np.log(1.0 - TEST_CONFIDENCE)  # the quantile for two degrees of freedom
    return np.asarray(system.observed & unclear)


def explanation_covariance(solution: FusionSolution, found: Sequence[Suspicion], value: ComplexArray) -> FloatArray:
    """Return the covariance (K, 12, 12) of an estimate (K, 6) with several explanations.

    All explanations are equally likely: a discrete distribution about the estimate with the variance Σ (x_h - x)²/n
    (GUM 4.3, JCGM 101 6.4). If one of many is far from the others, the variance of a value is enlarged until this
    explanation lies within √2 standard deviations. U = 1.96 u is then 1.4 times its distance, in every direction of the
    complex plane.

    x_h is the estimate with ten times the suspect's stated uncertainties, which keeps its influence where no other
    instrument has one. A gross error has no influence. If all are gross, the variance of each x_h beyond that of x is
    added, so that the total is that of the mixture, Σ (u_h² + (x_h - x)²)/n.
    """
    lines = len(value)
    deviation, within = np.zeros((len(found), lines, 12)), np.zeros((lines, 12, 12))
    for h, one in enumerate(found):
        lost = one.lost.reshape(lines, 2, 6).any(axis=1) & one.gross
        other = solution.acceleration + as_complex((one.change if one.gross else one.tenfold_change).reshape(lines, 12))
        deviation[h] = real_stack(np.where(lost, 0.0, other - value))
        if all(each.gross for each in found):
            spread = one.change_root.reshape(lines, 12, -1) * np.tile(~lost, (1, 2))[:, :, None]
            within += spread @ spread.swapaxes(1, 2) / len(found)
    mixture = np.einsum("hki,hkj->kij", deviation, deviation) / len(found)
    factor = np.ones((lines, 12))
    for c in range(6):
        both = [c, c + 6]
        inverse = np.linalg.pinv(mixture[:, both][:, :, both], rcond=COVARIANCE_CUTOFF, hermitian=True)
        square = np.einsum("hki,kij,hkj->hk", deviation[:, :, both], inverse, deviation[:, :, both])
        factor[:, both] = np.sqrt(np.maximum(1.0, np.max(square, axis=0) / 2.0))[:, None]
    return np.asarray(factor[:, :, None] * mixture * factor[:, None, :] + within)


def without_readings(system: FusionSystem, rows: IntArray) -> tuple[Observation, ...]:
    """Return the observations of a system with some of its readings replaced by NaN."""
    remaining = []
    for index, observation in enumerate(system.observations):
        rejected = rows[system.observation[rows] == index]
        gone = np.zeros(observation.phasors.value.shape, np.bool_)
        gone[system.line[rejected], system.channel[rejected]] = True
        remaining.append(drop_rows(observation, gone))
    return tuple(remaining)


RELEASE_CONFIDENCE = 0.9999
"""Confidence of the test that the readings pass if a released unknown explains their contradiction."""


def deviating_unknowns(
    system: FusionSystem, solution: FusionSolution, unknowns: Sequence[CommonEstimate]
) -> dict[CommonEstimate, bool]:
    """Return the unknowns that deviate, each with whether its release removes the contradiction."""
    noise, found = EstimatedNoise.from_system(system, solution.effects), dict[CommonEstimate, bool]()
    for unknown, effect in zip(unknowns, solution.effects.T, strict=True):
        if abs(unknown.deviation) > NOTABLE_DEVIATION:
            part = solution.projector @ effect
            rest = solution.projector - np.outer(part, part) / (1.0 - unknown.remaining**2)
            chi2 = solution.chi2 - unknown.deviation**2
            found[unknown] = not noise.fails(chi2, solution.dof - 1, rest, RELEASE_CONFIDENCE)
    return found


# Common mistakes that explain a ratio of readings.


def likely_mistake(
    ratio: complex, tolerance: float = MISTAKE_TOLERANCE, mistakes: Sequence[tuple[float, str]] = MISTAKES
) -> str:
    """Return the mistake whose ratio reading/prediction is within the relative `tolerance`, or an empty text."""
    distance, text = min((abs(ratio / factor - 1.0), text) for factor, text in mistakes)
    return text if distance <= tolerance else ""


def describe_deviation(name: str, ratio: complex, mistake: str) -> str:
    """Describe how an output deviates from its prediction, with the mistake that would cause it."""
    cause = f", as if {mistake}" if mistake else ""
    size, angle = number_text(abs(ratio)), number_text(float(np.angle(ratio)))
    return f"{name} is {size} times as large, turned by {angle} rad{cause}"


def exchanged_channels(
    system: FusionSystem, first: FusionSolution, found: Sequence[Suspicion]
) -> tuple[tuple[str, str], ...]:
    """Return pairs of channels of one kind whose exchange brings all readings into agreement."""
    blamed = np.unique(np.concatenate([system.member[one.rows] for one in found]))
    rows = {index: np.flatnonzero(system.member == index) for index in blamed.tolist()}
    kind = {index: system.observations[system.observation[chosen[0]]].kind for index, chosen in rows.items()}
    single = [index for index, chosen in rows.items() if kind[index] != "photogrammetry" and len(chosen)]
    pairs = []
    for a, b in combinations(single[:MAX_PAIR_CANDIDATES], 2):
        if kind[a] == kind[b] and np.array_equal(system.line[rows[a]], system.line[rows[b]]):
            readings = system.readings.copy()
            readings[rows[a]], readings[rows[b]] = system.readings[rows[b]], system.readings[rows[a]]
            if readings @ first.projector @ readings > 0.5 * first.chi2:
                continue  # hardly less contradiction: not worth another fit
            solution = solve(replace(system, readings=readings))
            noise = EstimatedNoise.from_system(system, solution.effects)
            if not noise.fails(solution.chi2, solution.dof, solution.projector):
                pairs.append((system.member_names[a], system.member_names[b]))
    return tuple(pairs)
