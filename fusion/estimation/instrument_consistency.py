"""Whether instruments contradict each other, which, and what undetected common errors may do.

Instruments are judged all together, each against the prediction of the others, and each unknown against what is stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.least_squares import FusionSolution, FusionSystem, drop_rows, solve
from fusion.estimation.uncertainty import as_complex, real_design, real_stack
from fusion.estimation.variance_components import (
    MIN_DOF,
    TEST_LEVEL,
    Contrasts,
    Discrepancy,
    EstimatedNoise,
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
GROSS = 10.0
"""Times its stated uncertainty beyond which a cause is a gross error or wrongly stated, and explains nothing."""
MISTAKES = (
    (-1.0, "its sign were reversed"),
    (9.80665, "m/s² were taken for g"),
    (1.0 / 9.80665, "g were taken for m/s²"),
    (1e3, "a unit were taken for a thousand of it"),
    (1e-3, "a unit were taken for a thousandth of it"),
    (10.0, "its scale were ten times too large"),
    (0.1, "its scale were ten times too small"),
    (100.0, "its scale were a hundred times too large"),
    (0.01, "its scale were a hundred times too small"),
    (2.0, "its scale were twice too large, such as that of another range"),
    (0.5, "its scale were half of what it is, such as that of another range"),
    (2.0**0.5, "rms were taken for peak values"),
    (0.5**0.5, "peak were taken for rms values"),
)
"""Reading over prediction, and what would make it so."""
OUTPUT_MISTAKES = (MISTAKES[0], *MISTAKES[3:5])
"""Those of them that outputs of the sensor may owe."""
MISTAKE_TOLERANCE = 0.03
"""Relative distance from such a factor within which a ratio looks like it."""
LOST = 1e-6
"""Share of an estimate in directions that only the readings left out tell, from which on it is lost without them."""
PAIRED = 12
"""Channels and instruments that deviate most, of which pairs are looked at."""
NORMAL_LIMIT = 2.576
"""Standard deviations that a normal value exceeds with 1 %."""
CERTAIN = 25.0
"""Noncentrality of chi-square from which on a deviation is as good as always noticed (5 standard deviations)."""


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
    def unconstrained_value(self) -> float:
        """Return the value, in `unit`, that the readings ask for if nothing were stated of this unknown."""
        return self.u * self.estimate / (1.0 - self.remaining**2) if self.remaining < UNTESTED else float("nan")

    @property
    def gross(self) -> bool:
        """Return whether what the readings ask for is surely, by two standard deviations, beyond ten times `u`."""
        if not self.remaining < UNTESTED:
            return False
        certain = 1.0 - self.remaining**2
        return bool(abs(self.estimate) / certain - 2.0 * self.remaining / np.sqrt(certain) > GROSS)


@dataclass(frozen=True)
class Consistency:
    """How one instrument, or one channel of it, agrees with the prediction of all others.

    `normalised_deviation`: root of chi-square per degree of freedom of the leave-one-out difference (1 is expected,
    NaN where the others cannot predict it); `channels` of it; `used` in the fused estimate or only compared;
    `ratio`: measured over predicted at its largest reading, complex, NaN where it has no prediction; `suspect`: it
    deviates, and without it all others agree (or without it and another); `left_out`: it is a gross error that all
    others contradict, and was left out of the estimate.
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
    """Tell at 1 % whether readings contradict what is stated: by chi-square, or by the deviation of a single unknown.

    A camera that was turned hardly shows in the chi-square of a hundred readings, but in the unknown that is its turn.
    """
    half = (1.0 + TEST_LEVEL) / 2.0
    deviations = np.nan_to_num([unknown.deviation for unknown in unknowns])
    # Unknowns that the readings cannot tell apart deviate alike: together they are one test.
    tests = len(np.unique(np.round(np.abs(deviations[[np.isfinite(unknown.deviation) for unknown in unknowns]]), 2)))
    noise = EstimatedNoise.of(system, solution.effects)
    if noise.fails(solution.chi2, solution.dof, solution.projector, half):
        return True
    level = 1.0 - (1.0 - half) / max(tests, 1)
    for place in np.flatnonzero([fails(deviation**2, 1, level) for deviation in deviations]).tolist():
        weights = solution.projector @ solution.effects[:, place]
        weights = np.outer(weights, weights) / (1.0 - unknowns[place].remaining ** 2)
        if noise.fails(float(deviations[place] ** 2), 1, weights, level):
            return True
    return False


def leave_one_out(
    system: FusionSystem, solution: FusionSolution, suspects: Sequence[str] = ()
) -> tuple[Consistency, ...]:
    """Return for each channel or stereo pair, and each instrument of several channels, its readings against the others.

    With q = P y the difference is d = P_II^-1 q_I with covariance P_II^-1, so that no fit is repeated; chi-square is
    q_I^T P_II^+ q_I on the rank of P_II, and that of the others is smaller by as much. `suspects`: names of those that
    an explanation leaves out.
    """
    tests = [_left_out(system, solution, name, rows) for name, rows in _groups(system)]
    return tuple(replace(test, suspect=test.instrument in suspects) for test in tests)


def _groups(system: FusionSystem) -> list[tuple[str, IntArray]]:
    """Each channel or stereo pair and, where there are several instruments, each of several channels: its rows."""
    groups = [(name, np.flatnonzero(system.member == place)) for place, name in enumerate(system.member_names)]
    for place, observation in enumerate(system.observations):
        rows = np.flatnonzero(system.observation == place)
        if len(rows) < len(system.readings) and len(np.unique(system.member[rows])) > 1:
            groups.append((f"{observation.title} as a whole", rows))
    return [(name, rows) for name, rows in groups if len(rows)]


def leave_out_rows(
    projector: FloatArray, left: FloatArray, sizes: FloatArray, rows: IntArray, tolerance: float = RANK_TOLERANCE
) -> tuple[float, int, FloatArray | None]:
    """Return chi-square and degrees of freedom of readings against the prediction of all others, and the difference.

    Deletion formula of generalised least squares, `left` being projector · readings (N,); `sizes` (N,) make the
    readings comparable. The difference (n,) is None where the others do not predict all of them.
    """
    scale, root, tested, blind, white = _whitened(projector, left, sizes, rows, tolerance)
    difference = None if blind.shape[1] else scale * (tested @ (white / root))
    return float(white @ white), len(white), difference


def _whitened(
    projector: FloatArray, left: FloatArray, sizes: FloatArray, rows: IntArray, tolerance: float = RANK_TOLERANCE
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Decompose P_II, scaled by the sizes (n,) of the readings, into the directions (n, r) that the others test.

    Returns these sizes, the roots (r,) of the eigenvalues, their vectors, those (n, n - r) that nothing tests, and
    P·y of the rows in them (r,), of variance one.
    """
    scale = sizes[rows]
    values, vectors = np.linalg.eigh(projector[np.ix_(rows, rows)] * np.outer(scale, scale))
    kept = values > tolerance
    root, tested = np.sqrt(values[kept]), vectors[:, kept]
    return scale, root, tested, vectors[:, ~kept], tested.T @ (scale * left[rows]) / root


def _left_out(system: FusionSystem, solution: FusionSolution, name: str, rows: IntArray) -> Consistency:
    """One group of readings against all others."""
    left, sizes = solution.projector @ system.readings, np.sqrt(np.diag(solution.noise))
    chi2, dof, difference = leave_out_rows(solution.projector, left, sizes, rows)
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


# What the estimate is if some readings are wrong: explanations of a contradiction, and what they leave of a value.


@dataclass(frozen=True)
class Explanation:
    """What the estimate is if the readings of a `suspect` are wrong: a channel, an instrument, or two of these.

    `value` (K, 6) from all other readings and its `covariance` (K, 12, 12), NaN where these do not determine it;
    `gross`: the readings lie further from the others than ten times the stated uncertainties of the suspect allow.
    """

    suspect: str
    value: ComplexArray
    covariance: FloatArray
    gross: bool


@dataclass(frozen=True)
class Suspicion:
    """Groups of readings, `names` and `rows`, that are taken as wrong together, and what follows for the estimate.

    `chi2`, `dof` of their difference to the prediction of the others, `tested` (N, r) · its transpose the weights of
    all readings in it; `change` (12K,) of the estimate by leaving them
    out, which is `pull` (12K, n) · (P y) of the rows, `spread` (12K, r): a root of its covariance, `lost` (12K,): which
    values the others do not determine; `tenfold` (12K,): change of the estimate by stating ten times as much of the
    rows; `gross`: that does not suffice.
    """

    names: tuple[str, ...]
    rows: IntArray
    chi2: float
    dof: int
    change: FloatArray
    pull: FloatArray
    spread: FloatArray
    lost: BoolArray
    tenfold: FloatArray
    gross: bool
    tested: FloatArray

    @property
    def weights(self) -> FloatArray:
        """Return Θ (N, N), so that chi-square is yᵀ·Θ·y."""
        return np.asarray(self.tested @ self.tested.T)

    @property
    def excess(self) -> float:
        """Return by how much chi-square is beyond what is expected."""
        return self.chi2 - self.dof


def suspicion(system: FusionSystem, solution: FusionSolution, names: tuple[str, ...], rows: IntArray) -> Suspicion:
    """Return what follows if some readings are wrong by anything, without another fit.

    An arbitrary error δ of the readings I, estimated beside the motion, is δ = P_II⁺ q_I with q = P y and covariance
    P_II⁺; the estimate becomes gain · (y - δ), its covariance grows by gain_I P_II⁺ gain_Iᵀ, and what depends on a
    direction in which P_II is singular is lost. If δ has the covariance c·W instead, W being what is stated of the
    readings I, the best estimate of it is c·W·(1 + c·P_II·W)⁻¹ q_I: with c = 10² - 1 this is the estimate from all
    readings, these with ten times their stated uncertainty, and nothing is lost. With c = (10/2.58)² - 1 ten standard
    uncertainties are where a test at 1 % fails; if the readings fail even so, the error is gross.
    """
    sizes = np.sqrt(np.diag(solution.noise))
    left = solution.projector @ system.readings
    scale, root, tested, blind, white = _whitened(solution.projector, left, sizes, rows)
    gain = solution.gain[:, rows] * scale
    spread = gain @ (tested / root)
    reach = np.linalg.norm(solution.gain * sizes, axis=1)
    lost = np.linalg.norm(gain @ blind, axis=1) > LOST * reach
    own = solution.effects[rows] / scale[:, None]
    stated = solution.noise[np.ix_(rows, rows)] / np.outer(scale, scale) + own @ own.T
    seen = tested * root
    inner, unit = seen.T @ stated @ seen, np.eye(len(white))
    limit = (GROSS / NORMAL_LIMIT) ** 2 - 1.0
    chi2, dof = float(white @ white), len(white)
    all_rows = solution.projector[:, rows] @ (scale[:, None] * tested / root)
    gross = chi2 - dof > CERTAIN and EstimatedNoise.of(system, solution.effects).fails(
        float(white @ np.linalg.solve(unit + limit * inner, white)), dof, all_rows @ all_rows.T
    )
    more = GROSS**2 - 1.0
    tenfold = -gain @ (more * stated @ seen @ np.linalg.solve(unit + more * inner, white))
    pull = -(spread / root) @ tested.T * scale
    return Suspicion(names, rows, chi2, dof, -spread @ white, pull, spread, lost, tenfold, gross, all_rows)


def suspicions(system: FusionSystem, solution: FusionSolution) -> tuple[Suspicion, ...]:
    """Return the explanations that contradicting readings leave open, of as few wrong groups of readings as may be.

    Those are suspect without which all others agree at 1 % and whose chi-square is beyond what is expected by at least
    half of what any other's is; an instrument is not suspect for one of its channels. Where no one is, pairs of those
    that deviate most are; where no pair is, every instrument that deviates.
    """
    every = [suspicion(system, solution, (name,), rows) for name, rows in _groups(system)]
    every = [one for one in every if one.dof]
    noise = EstimatedNoise.of(system, solution.effects)

    def agreeing(some: Sequence[Suspicion]) -> list[Suspicion]:
        most = max((one.excess for one in some), default=0.0)
        chosen: list[Suspicion] = []
        for one in some:
            own = not any(np.all(np.isin(other.rows, one.rows)) for other in chosen)
            agrees = not noise.fails(solution.chi2 - one.chi2, solution.dof - one.dof, solution.projector - one.weights)
            chosen += [one] if own and agrees and one.excess >= 0.5 * most else []
        return chosen

    found = agreeing(every)
    if not found:
        first = sorted(every, key=lambda one: -one.excess)[:PAIRED]
        pairs = [both for both in combinations(first, 2) if not np.intersect1d(both[0].rows, both[1].rows).size]
        found = agreeing(
            [
                suspicion(system, solution, a.names + b.names, np.sort(np.concatenate([a.rows, b.rows])))
                for a, b in pairs
            ]
        )
    if not found:
        places = range(len(system.observations))
        whole = [one for one in every if any(len(one.rows) == np.sum(system.observation == place) for place in places)]
        found = [one for one in whole if noise.fails(one.chi2, one.dof, one.weights)]
    return tuple(_where_untested(system, solution, one) for one in found)


def _where_untested(system: FusionSystem, solution: FusionSolution, whole: Suspicion) -> Suspicion:
    """Return the suspicion without the lines at which the readings agree although such an error would show there.

    An artefact at a harmonic says nothing against an instrument at the fundamental. The error's relative size is the
    largest that a line asks for, √(χ²/λ) with λ the noncentrality of readings that are wrong by all of their size.
    """
    line, noise = system.line[whole.rows], EstimatedNoise.of(system, solution.effects)
    parts = [whole.rows[line == k] for k in np.unique(line).tolist()]
    each = [suspicion(system, solution, whole.names, rows) for rows in parts]
    # A line by itself is judged by what all others say without the suspect's other lines.
    others = [suspicion(system, solution, whole.names, whole.rows[line != k]) for k in np.unique(line).tolist()]
    wrong = [float(system.readings[r] @ solution.projector[np.ix_(r, r)] @ system.readings[r]) for r in parts]
    size2 = max((one.chi2 / power for one, power in zip(each, wrong, strict=True) if power > 0.0), default=0.0)
    kept = [
        rows
        for rows, rest, power in zip(parts, others, wrong, strict=True)
        if noise.fails(whole.chi2 - rest.chi2, whole.dof - rest.dof, whole.weights - rest.weights)
        or size2 * power <= CERTAIN
    ]
    if not kept or len(kept) == len(parts):
        return whole
    less = suspicion(system, solution, whole.names, np.concatenate(kept))
    weights = solution.projector - less.weights
    return whole if noise.fails(solution.chi2 - less.chi2, solution.dof - less.dof, weights) else less


def explanations(system: FusionSystem, solution: FusionSolution, found: Sequence[Suspicion]) -> tuple[Explanation, ...]:
    """Return for each suspicion what all other readings say."""
    lines = len(system.observed)
    before = as_stated(solution, solution.gain.reshape(lines, 12, -1))
    told = []
    for one in found:
        lost = (one.lost.reshape(lines, 12)[:, :6] | one.lost.reshape(lines, 12)[:, 6:]) | ~system.observed
        spread = one.spread.reshape(lines, 12, -1)
        unknown = np.tile(lost, (1, 2))
        covariance = before + spread @ spread.swapaxes(1, 2)
        change = as_complex(one.change.reshape(lines, 12))
        told.append(
            Explanation(
                " and ".join(one.names),
                np.where(lost, complex(np.nan, np.nan), solution.acceleration + change),
                np.where(unknown[:, :, None] | unknown[:, None, :], np.nan, covariance),
                one.gross,
            )
        )
    return tuple(told)


def as_stated(solution: FusionSolution, gain: FloatArray) -> FloatArray:
    """Return the covariance (..., 12, 12) of gain (..., 12, N) · readings by all that is stated."""
    effects = gain @ solution.effects
    return np.asarray(gain @ solution.noise @ gain.swapaxes(-1, -2) + effects @ effects.swapaxes(-1, -2))


def disputed_values(system: FusionSystem, solution: FusionSolution, found: Sequence[Suspicion]) -> BoolArray:
    """Return (K, 6): which values gross suspicions of several instruments leave without any mean.

    At least two explanations are open, all of them gross errors, of more than one instrument: nothing decides. In
    dispute is where any two of them differ at 1 %, and what one of them does not determine.
    """
    blamed = {place for one in found for place in np.unique(system.observation[one.rows]).tolist()}
    if len(found) < 2 or len(blamed) < 2 or not all(one.gross for one in found):
        return np.zeros_like(system.observed)
    unclear = np.any([one.lost.reshape(-1, 2, 6).any(axis=1) for one in found], axis=0)
    for one, other in combinations(found, 2):
        pull = np.zeros((one.change.size, len(system.readings)))
        pull[:, one.rows] += one.pull
        pull[:, other.rows] -= other.pull
        parts = pull.reshape(-1, 2, 6, len(system.readings)).swapaxes(1, 2)
        covariance = parts @ solution.projector @ parts.swapaxes(2, 3)
        change = parts @ (solution.projector @ system.readings)
        inverse = np.linalg.pinv(covariance, rcond=VISIBLE, hermitian=True)
        square = np.einsum("kca,kcab,kcb->kc", change, inverse, change)
        unclear |= square > -2.0 * np.log(1.0 - TEST_LEVEL)  # the quantile for two degrees of freedom
    return np.asarray(system.observed & unclear)


def explanation_covariance(solution: FusionSolution, found: Sequence[Suspicion], value: ComplexArray) -> FloatArray:
    """Return the covariance (K, 12, 12) of an estimate (K, 6) of which several explanations are open.

    Each is as likely as any other: a discrete distribution about the estimate with the variance Σ (x_h - x)²/n
    (GUM 4.3, JCGM 101 6.4). Where one of many lies far off, all of a value's variance is enlarged until it lies within
    √2 standard deviations: U = 1.96 u is then 1.4 times its distance, in whatever direction of the complex plane.
    x_h is the estimate with ten times the suspect's stated uncertainties, which leaves it a say where no other
    instrument has one; only a gross error leaves it none. Where all are gross the variance of each x_h beyond that of x
    is added, so that the whole is that of the mixture, Σ (u_h² + (x_h - x)²)/n.
    """
    lines = len(value)
    away, within = np.zeros((len(found), lines, 12)), np.zeros((lines, 12, 12))
    for h, one in enumerate(found):
        lost = one.lost.reshape(lines, 2, 6).any(axis=1) & one.gross
        other = solution.acceleration + as_complex((one.change if one.gross else one.tenfold).reshape(lines, 12))
        away[h] = real_stack(np.where(lost, 0.0, other - value))
        if all(each.gross for each in found):
            spread = one.spread.reshape(lines, 12, -1) * np.tile(~lost, (1, 2))[:, :, None]
            within += spread @ spread.swapaxes(1, 2) / len(found)
    mixture = np.einsum("hki,hkj->kij", away, away) / len(found)
    factor = np.ones((lines, 12))
    for c in range(6):
        both = [c, c + 6]
        inverse = np.linalg.pinv(mixture[:, both][:, :, both], rcond=VISIBLE, hermitian=True)
        square = np.einsum("hki,kij,hkj->hk", away[:, :, both], inverse, away[:, :, both])
        factor[:, both] = np.sqrt(np.maximum(1.0, np.max(square, axis=0) / 2.0))[:, None]
    return np.asarray(factor[:, :, None] * mixture * factor[:, None, :] + within)


def without_readings(system: FusionSystem, rows: IntArray) -> tuple[Observation, ...]:
    """Return the observations of a system with some of its readings gone, NaN."""
    kept = []
    for place, observation in enumerate(system.observations):
        own = rows[system.observation[rows] == place]
        gone = np.zeros(observation.phasors.value.shape, np.bool_)
        gone[system.line[own], system.channel[own]] = True
        kept.append(drop_rows(observation, gone))
    return tuple(kept)


NEARLY = 0.9999
"""An unknown after whose estimate the readings still fail even at this level is not what they differ by."""


def deviating_unknowns(
    system: FusionSystem, solution: FusionSolution, unknowns: Sequence[CommonEstimate]
) -> dict[CommonEstimate, bool]:
    """Return the unknowns that deviate, and whether the readings agree nearly once such a one is free."""
    noise, found = EstimatedNoise.of(system, solution.effects), dict[CommonEstimate, bool]()
    for unknown, effect in zip(unknowns, solution.effects.T, strict=True):
        if abs(unknown.deviation) > NOTABLE_DEVIATION:
            part = solution.projector @ effect
            rest = solution.projector - np.outer(part, part) / (1.0 - unknown.remaining**2)
            chi2 = solution.chi2 - unknown.deviation**2
            found[unknown] = not noise.fails(chi2, solution.dof - 1, rest, NEARLY)
    return found


# Mistakes that are common enough to be named where the readings look like one.


def likely_mistake(
    ratio: complex, tolerance: float = MISTAKE_TOLERANCE, mistakes: Sequence[tuple[float, str]] = MISTAKES
) -> str:
    """Return what reading/prediction looks like within `alike`, in words; empty where it is no common mistake."""
    away, text = min((abs(ratio / factor - 1.0), text) for factor, text in mistakes)
    return text if away <= tolerance else ""


def exchanged_channels(
    system: FusionSystem, first: FusionSolution, found: Sequence[Suspicion]
) -> tuple[tuple[str, str], ...]:
    """Return the pairs of channels of one kind of instrument that, exchanged, leave all readings in agreement."""
    blamed = np.unique(np.concatenate([system.member[one.rows] for one in found]))
    rows = {place: np.flatnonzero(system.member == place) for place in blamed.tolist()}
    kind = {place: system.observations[system.observation[own[0]]].kind for place, own in rows.items()}
    single = [place for place, own in rows.items() if kind[place] != "photogrammetry" and len(own)]
    pairs = []
    for a, b in combinations(single[:PAIRED], 2):
        if kind[a] == kind[b] and np.array_equal(system.line[rows[a]], system.line[rows[b]]):
            readings = system.readings.copy()
            readings[rows[a]], readings[rows[b]] = system.readings[rows[b]], system.readings[rows[a]]
            if readings @ first.projector @ readings > 0.5 * first.chi2:
                continue  # too far off for another fit to be worth its time
            solution = solve(replace(system, readings=readings))
            noise = EstimatedNoise.of(system, solution.effects)
            if not noise.fails(solution.chi2, solution.dof, solution.projector):
                pairs.append((system.member_names[a], system.member_names[b]))
    return tuple(pairs)


# What undetected common errors, which would explain a contradiction, do where nothing can contradict.


def undetected_errors(
    system: FusionSystem, solution: FusionSolution, unknowns: Sequence[CommonEstimate], label: str
) -> Discrepancy | None:
    """Return the covariance of the readings by the common errors of which one would explain a contradiction.

    Of those that are no gross errors these are the unknown that deviates most and all whose deviation is not smaller at
    1 %: the data do not tell which of them it is. Each instrument's, an error of the size d that the readings ask for,
    has the variance θ·d²; θ is common to all and of greatest restricted likelihood beside what is stated. A camera that
    may have been turned has been so in every component, also in those that no other instrument sees: what instruments
    differ by in the components that they share says nothing of these. None where no unknown deviates.
    """
    deviations = np.abs(np.nan_to_num([unknown.deviation for unknown in unknowns]))
    # The largest of several absurd unknowns is no better a cause than the others: it must not displace what may be one.
    deviations = np.where([unknown.gross for unknown in unknowns], 0.0, deviations)
    most = np.max(deviations, initial=0.0)
    if most < NOTABLE_DEVIATION:
        return None
    chosen = np.flatnonzero(deviations**2 >= most**2 - NOT_EXCLUDED).tolist()
    effects = solution.effects[:, chosen]
    wanted = np.array([unknowns[place].unconstrained_value / unknowns[place].u for place in chosen])
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
    every_line = np.full(len(system.observed), max(float(dof), MIN_DOF))
    return Discrepancy(label, variance * (pattern @ pattern.T), every_line)


def missing_covariance(required: FloatArray, allowed: FloatArray) -> FloatArray:
    """Return the part of a `wanted` covariance (K, 2C, 2C) that an `allowed` one does not contain, value by value.

    Of the covariance W of Re and Im of a value remains the positive part M of W - A in whatever direction of the
    complex plane: F·W·Fᵀ of all values together, F = √M·√W⁻¹ for each.
    """
    lines, size = required.shape[:2]

    def each(covariance: FloatArray) -> FloatArray:
        """Covariances (K, C, 2, 2) of Re and Im of each value."""
        parts = covariance.reshape(lines, 2, size // 2, 2, size // 2)
        return np.asarray(np.moveaxis(parts.diagonal(axis1=2, axis2=4), -1, 1))

    missing, axes = np.linalg.eigh(each(required) - each(allowed))
    root = (axes * np.sqrt(np.maximum(missing, 0.0))[:, :, None, :]) @ axes.swapaxes(2, 3)
    values, vectors = np.linalg.eigh(each(required))
    usable = values > VISIBLE * values[:, :, 1:]
    inverse = np.where(usable, 1.0 / np.sqrt(np.where(usable, values, 1.0)), 0.0)
    part = root @ (vectors * inverse[:, :, None, :]) @ vectors.swapaxes(2, 3)
    turn = np.zeros((lines, 2, size // 2, 2, size // 2))
    turn[:, :, np.arange(size // 2), :, np.arange(size // 2)] = part.swapaxes(0, 1)
    factor = turn.reshape(lines, size, size)
    return np.asarray(factor @ required @ factor.swapaxes(1, 2))
