"""Whether instruments contradict each other, which, and what an undetected common error may do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fusion.base import AnyNotice
from fusion.estimation.least_squares import SCALE, Solution, System, real_design, real_stack
from fusion.estimation.measurement_model import CommonError, Observation
from fusion.estimation.uncertainty import Contribution, Uncertainty, total_variance
from fusion.estimation.variance_components import LEAST_DOF, Contrasts, Discrepancy, Scatter, variance_components
from shaker.arrays import BoolArray, ComplexArray, FloatArray, IntArray, Notice
from shaker.labels import MOTION_COMPONENTS
from shaker.sine.phasor import Phasors

# Whether instruments agree: all together, each against the others' prediction, each unknown against what is stated.


TEST_LEVEL = 0.99
RANK_TOLERANCE = 1e-11
UNTESTED = 0.99
"""An unknown of which more of its stated uncertainty remains after the estimate cannot be judged by the data."""


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


def fails(chi2: float, dof: int, level: float = TEST_LEVEL) -> bool:
    """Return whether chi-square is beyond its quantile."""
    from scipy.special import chdtrc

    return dof > 0 and bool(chdtrc(dof, chi2) < 1.0 - level)


def estimates(common: Sequence[CommonError], solution: Solution) -> tuple[CommonEstimate, ...]:
    """Return every common error with its estimate."""
    found = zip(common, solution.errors.tolist(), solution.remaining.tolist(), strict=True)
    return tuple(CommonEstimate(c.name, c.label, c.u, c.unit, value, left) for c, value, left in found)


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

    With q = P y the difference is d = P_II^-1 q_I with covariance P_II^-1 (deletion formula of generalised least
    squares), so that no fit is repeated; chi-square is q_I^T P_II^+ q_I on the rank of P_II, and that of the others is
    smaller by as much.
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
    found: list[Consistency] = []
    single: list[BoolArray] = []
    for (test, chi2, dof), (_, mask) in zip(tests, groups, strict=True):
        agrees = not fails(solution.chi2 - chi2, solution.dof - dof)
        # An instrument is not suspect for one of its channels.
        own = not any(np.all(mask[other]) for other in single)
        suspect = agrees and own and dof > 0 and chi2 - dof >= 0.5 * most
        single += [mask] if suspect else []
        found.append(replace(test, suspect=suspect))
    return tuple(found)


def _left_out(system: System, solution: Solution, name: str, rows: IntArray) -> tuple[Consistency, float, int]:
    """One group of readings against all others, with chi-square and degrees of freedom of their difference."""
    sizes = np.sqrt(np.diag(solution.noise))
    values, vectors = np.linalg.eigh(solution.projector[np.ix_(rows, rows)] * np.outer(sizes[rows], sizes[rows]))
    kept = values > RANK_TOLERANCE
    dof = int(np.count_nonzero(kept))
    channels = len(set(zip(system.observation[rows].tolist(), system.channel[rows].tolist(), strict=True)))
    if not dof:
        return Consistency(name, np.nan, channels), 0.0, 0
    turned = vectors[:, kept].T @ (sizes[rows] * (solution.projector[rows] @ system.readings))
    chi2 = float(np.sum(turned**2 / values[kept]))
    ratio = complex(np.nan, np.nan)
    if np.all(kept):
        difference = sizes[rows] * (vectors @ (turned / values))
        ratio = _largest_ratio(system, rows, system.readings[rows] - difference)
    return Consistency(name, float(np.sqrt(chi2 / dof)), channels, True, ratio), chi2, dof


def _largest_ratio(system: System, rows: IntArray, predicted: FloatArray) -> complex:
    """Measured over predicted phasor of the reading among some rows with the largest prediction."""
    values = np.zeros(len(system.readings))
    values[rows] = predicted
    own = np.isin(system.pairs[:, 0], rows)
    pairs = system.pairs[own]
    phasor = values[pairs[:, 0]] + 1j * values[pairs[:, 1]]
    largest = int(np.argmax(np.abs(phasor)))
    if phasor[largest] == 0.0:
        return complex(np.nan, np.nan)
    re, im = pairs[largest]
    return complex((system.readings[re] + 1j * system.readings[im]) / phasor[largest])


def compare(observation: Observation, acceleration: ComplexArray, covariance: FloatArray) -> tuple[Consistency, ...]:
    """Return how the members of an instrument that was not fused agree with A (K, 6) and its covariance (K, 12, 12)."""
    found = []
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
        found.append(Consistency(name, deviation, int(np.sum(names == name)), False, ratio))
    return tuple(found)


# What stated unknowns that would explain a contradiction do to components in which nothing can contradict.


NOTABLE_DEVIATION = 3.5
"""An unknown that deviates by less, in standard deviations, explains nothing by itself."""
NOT_EXCLUDED = 6.63
"""Difference of squared deviations, chi-square of one degree of freedom at 1 %: both unknowns may be the cause."""
DOUBT_RANK_TOLERANCE = 1e-9


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
    kept = values > DOUBT_RANK_TOLERANCE * values[-1]
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
    usable = values > DOUBT_RANK_TOLERANCE * values[:, :, 1:]
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


# The six-component acceleration of one body, with all that its estimate says of itself.


Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]


@dataclass(frozen=True)
class Acceleration:
    """Six-component acceleration phasors of one body at the sensor origin.

    `phasors` (K, 6) in m/s^2 and rad/s^2, NaN where not `observed` (K, 6). `uncertainty` of the six components, NaN
    where not observed: noise of every instrument and the common errors, which act on all lines at once. `unknowns`:
    what the data say of those. `consistency`, `chi2` and `dof` rest on what is stated; `scatter`: instruments whose
    readings scatter beyond that.
    """

    body: str
    source: Source
    phasors: Phasors
    observed: BoolArray
    instruments: tuple[str, ...]
    uncertainty: Uncertainty
    consistency: tuple[Consistency, ...]
    chi2: float
    dof: int
    unknowns: tuple[CommonEstimate, ...]
    notices: tuple[AnyNotice, ...]
    scatter: tuple[Scatter, ...] = ()

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """Return the budget: one contribution per label; they add up to the covariance of the phasors."""
        return self.uncertainty.grouped()


# What an estimated acceleration wants the user to know: what is missing, who disagrees, what nothing tests.


REMAINING = 0.9
"""Where more than this share of a stated uncertainty remains, an error of three times as much would not be noticed."""
NOTABLE_SHARE = 0.1
"""Least share in the variance of a component for which an untested unknown is worth a word."""
EQUALLY_LIKELY = 0.95


@dataclass(frozen=True)
class Untested:
    """An unknown that the data cannot test: its stated `u` in `unit` is taken as it is.

    `share`: its part in the variance of the `component` that it touches most, at the strongest line; `relative`: what
    one standard uncertainty does to that component, over the component's amplitude.
    """

    name: str
    label: str
    u: float
    unit: str
    component: str
    share: float
    relative: float


def untested(result: Acceleration) -> tuple[Untested, ...]:
    """Return the unknowns that matter and that the readings cannot test, the largest share first."""
    value = np.where(result.observed, result.phasors.value, 0.0)
    line = int(np.argmax(np.linalg.norm(value / SCALE, axis=1)))
    total = np.where(result.observed, total_variance(result.uncertainty.covariance), np.inf)[line]
    effects = {influence.name: influence.effect[line] for influence in result.uncertainty.influences}
    found = []
    for unknown in (u for u in result.unknowns if u.name in effects):
        part = np.nan_to_num(effects[unknown.name])
        size = np.hypot(part[:6], part[6:])
        share = size**2 / total
        c = int(np.argmax(share))
        if unknown.remaining > REMAINING and share[c] > NOTABLE_SHARE:
            relative = float(size[c] / np.abs(value[line, c])) if value[line, c] else np.inf
            row = Untested(
                unknown.name, unknown.label, unknown.u, unknown.unit, MOTION_COMPONENTS[c], float(share[c]), relative
            )
            found.append(row)
    return tuple(sorted(found, key=lambda row: -row.share))


def verdict(result: Acceleration, stated: bool, contradicted: Sequence[CommonEstimate] | None) -> tuple[Notice, ...]:
    """Return the notices of an estimate.

    `stated`: some instrument states a systematic uncertainty; `contradicted`: the unknowns as they come out of what is
    stated, where the readings contradict that.
    """
    found = _missing(result)
    if not stated:
        titles = ", ".join(result.instruments)
        text = f"no instrument ({titles}) states a systematic uncertainty: U contains noise only"
        found.append(Notice("warning", text, result.body))
    found += [_compared(test) for test in result.consistency if not test.used]
    if contradicted is not None:
        found.append(_disagreement(result, contradicted))
    found += [_scatter(scatter, result.phasors.frequency_hz) for scatter in result.scatter]
    rows = untested(result) if result.source == "fused" and stated else ()
    if rows:
        found.append(_not_tested(result.body, rows))
    return tuple(found)


def _missing(result: Acceleration) -> list[Notice]:
    """Components that no reading determines."""
    found = []
    titles = ", ".join(result.instruments)
    for pattern in [] if np.all(result.observed) else np.unique(~result.observed, axis=0):
        lines = int(np.sum(np.all(result.observed == ~pattern, axis=1)))
        if np.any(pattern):
            missing = ", ".join(name for name, hidden in zip(MOTION_COMPONENTS, pattern, strict=True) if hidden)
            text = (
                f"{missing} of the {result.body} cannot be told from the readings of {titles} at {lines} of "
                f"{len(result.observed)} lines: too few points, directions or usable lines; no values are given"
            )
            found.append(Notice("info", text, result.body))
    return found


def _compared(test: Consistency) -> Notice:
    """An instrument that was not fused."""
    text = (
        "states no systematic uncertainty and was compared, not fused: "
        f"{test.normalised_deviation:.2g} times its standard uncertainty from the others, reading/prediction "
        f"{abs(test.ratio):.5g} at {np.angle(test.ratio):.5f} rad"
    )
    return Notice("info", text, test.instrument)


def _disagreement(result: Acceleration, unknowns: Sequence[CommonEstimate]) -> Notice:
    """Name who deviates from the others, and which stated unknown would explain it."""
    chi2 = f"chi-square {result.chi2:.3g} for {result.dof} degrees of freedom"
    text = f"the instruments of the {result.body} disagree ({chi2})"
    used = [test for test in result.consistency if test.used and np.isfinite(test.normalised_deviation)]
    suspects = sorted((test for test in used if test.suspect), key=lambda test: -test.normalised_deviation)
    named = suspects or sorted(used, key=lambda test: -test.normalised_deviation)[:1]
    text += "".join(f"; {_named(test)}" for test in named)
    if suspects:
        text += "; without it all others agree" if len(suspects) == 1 else "; without any one of these the others agree"
    text += "".join(f"; {_wanted(unknown)}" for unknown in _explaining(unknowns))
    return Notice("warning", text + "; U was enlarged to cover the disagreement", result.body)


def _named(test: Consistency) -> str:
    """How far an instrument lies from the others."""
    text = f"{test.instrument} lies {test.normalised_deviation:.3g} standard uncertainties from the others"
    if np.isfinite(test.ratio):
        text += f", reading/prediction {abs(test.ratio):.5g} at {np.angle(test.ratio):.5f} rad"
    return text


def _explaining(unknowns: Sequence[CommonEstimate]) -> list[CommonEstimate]:
    """Stated unknowns that deviate most, those that the readings cannot tell apart included."""
    tested = [unknown for unknown in unknowns if abs(unknown.deviation) > NOTABLE_DEVIATION]
    largest = max((abs(unknown.deviation) for unknown in tested), default=0.0)
    close = [unknown for unknown in tested if abs(unknown.deviation) >= EQUALLY_LIKELY * largest]
    return sorted(close, key=lambda unknown: -abs(unknown.deviation))


def _wanted(unknown: CommonEstimate) -> str:
    """The value of an unknown that the readings ask for."""
    unit = "" if unknown.unit == "1" else f" {unknown.unit}"
    return (
        f"{unknown.name} would have to be {unknown.wanted:.2g}{unit} "
        f"({abs(unknown.wanted) / unknown.u:.3g} times its standard uncertainty)"
    )


def _scatter(scatter: Scatter, frequency_hz: FloatArray) -> Notice:
    """An instrument whose own readings do not fit a rigid motion."""
    line = int(np.argmax(np.hypot(scatter.amplitude, scatter.phase)))
    text = (
        "its readings scatter beyond what is stated of them: by "
        f"{scatter.amplitude[line]:.2g} of the motion in amplitude and {scatter.phase[line]:.2g} rad in phase at "
        f"{frequency_hz[line]:.6g} Hz; this scatter is in U"
    )
    return Notice("warning", text, scatter.instrument)


def _not_tested(body: str, rows: Sequence[Untested]) -> Notice:
    """Unknowns that only their statement bounds."""
    listed = ", ".join(f"{row.name} ({row.share:.0%} of the variance of {row.component})" for row in rows)
    return Notice("info", f"not tested by these data, in U as stated: {listed}", body)
