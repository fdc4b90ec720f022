"""Generalised least squares of all instruments of a body: its six-component acceleration, and what to tell of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from fusion.base import round_to_uncertainty
from fusion.estimation.coverage import Polar, polar, region_factor
from fusion.estimation.estimation_notices import (
    COMPARED_ONLY,
    GROSS_ERROR,
    INSTRUMENTS_DISAGREE,
    INSTRUMENTS_DISPUTED,
    NOISE_ONLY,
    READINGS_SCATTER,
    SINGLE_ERROR_NOT_ASSESSED,
    UNBOUNDED_MOTION,
    UNOBSERVED_COMPONENTS,
)
from fusion.estimation.instrument_consistency import (
    CommonEstimate,
    Consistency,
    Explanation,
    Suspicion,
    as_stated,
    common_estimates,
    compare,
    contradicts,
    deviating_unknowns,
    disputed_values,
    exchanged_channels,
    explanation_covariance,
    explanations,
    leave_one_out,
    likely_mistake,
    missing_covariance,
    suspicions,
    undetected_errors,
    without_readings,
)
from fusion.estimation.least_squares import (
    UNOBSERVED,
    UNOBSERVED_ITSELF,
    FusionSolution,
    FusionSystem,
    Unbounded,
    bounded_system,
    products,
    solve,
    unmeasured_drive,
)
from fusion.estimation.measurement_model import SCALE, Observation, UnobservedMotion
from fusion.estimation.uncertainty import (
    Contribution,
    Influence,
    Uncertainty,
    element_covariance,
    merge_contributions,
    polar_elements,
    total_variance,
)
from fusion.estimation.variance_components import (
    Discrepancy,
    EstimatedNoise,
    Scatter,
    disagreement,
    estimate_scatter,
    failing_lines,
    scatter_covariances,
)
from shaker.arrays import BoolArray, FloatArray, IntArray, brief
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors
from shakercal._common.notices import Notice, Value

Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]
SINGLE_SOURCES: tuple[Source, ...] = ("photogrammetry", "vibrometer", "accelerometer")
INCONSISTENCY = "inconsistency of instruments"
EXPLANATIONS = "explanations of a contradiction"
MOST_LEFT_OUT = 4
"""Gross errors that are looked for one after another."""


@dataclass(frozen=True)
class Acceleration:
    """Six-component acceleration phasors of one body at the sensor origin.

    `phasors` (K, 6) in m/s^2 and rad/s^2, NaN where not `observed` (K, 6). `uncertainty` of the six components, NaN
    where not observed: noise of every instrument and the common errors, which act on all lines at once. `unknowns`:
    what the data say of those. `consistency`, `chi2`, `dof` and its `probability` rest on what is stated; `scatter`:
    instruments whose readings scatter beyond that. `explanations`: where instruments contradict each other, what the
    estimate is without each suspect; `disputed` (K, 6): values that are not given (not `observed`), since these differ
    by gross errors and nothing decides between them; None where there are none. `unseen`: what is assumed of components
    that are not observed, `assumed` (K, 6) their amplitudes by that, infinite where nothing bounds the driven motion;
    `driven` (K,): limit of that amplitude, None where it is not known what is driven; `leaked` (K, 12, 12): what one
    standard uncertainty of their [Re, Im] adds to [Re, Im] of the values. `unnoticed`: of the fused estimate, which
    components an error of a single channel may move by more than U although no test sees it. `posterior` (E, E):
    covariance of the `unknowns` after the estimate, in their u; of the fused load only, and None where its instruments
    contradict each other, which tells nothing of unknowns. `products` (E,): by how much, in their u, these act
    otherwise than to first order (`least_squares.products`).
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
    notices: tuple[Notice, ...]
    scatter: tuple[Scatter, ...] = ()
    unseen: UnobservedMotion = field(default_factory=UnobservedMotion)
    assumed: FloatArray | None = None
    driven: FloatArray | None = None
    explanations: tuple[Explanation, ...] = ()
    disputed: BoolArray | None = None
    unnoticed: tuple[Unnoticed, ...] = ()
    leaked: FloatArray | None = None
    probability: float = float("nan")
    posterior: FloatArray | None = None
    products: FloatArray | None = None

    __repr__ = brief

    @cached_property
    def unobserved_amplitude(self) -> FloatArray:
        """Return what is assumed of components that are not observed (K, 6); 0 of the others."""
        known = np.asarray(np.nan_to_num(self.phasors.value))
        return self.unseen.amplitude(known, self.observed) if self.assumed is None else self.assumed

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """Return the budget: one contribution per label; they add up to the covariance of the phasors."""
        return self.uncertainty.grouped()

    @cached_property
    def polar(self) -> list[list[Polar | None]]:
        """Return the components (K lines of 6) as magnitude and phase, None where one is not observed."""
        return polar_elements(self.phasors.value, self.uncertainty, self.phasors.covariance)


def fuse(
    observations: Sequence[Observation],
    body: str = "load",
    source: Source = "fused",
    scatter: tuple[Scatter, ...] | None = None,
    unobserved_motion: UnobservedMotion | None = None,
) -> Acceleration:
    """Estimate the acceleration of `body` from all its instruments, jointly over all lines.

    Instruments without any stated systematic uncertainty are compared with the result, not used, unless there are no
    others. A component is observed only if the readings of its line determine it by themselves: neither a prior nor an
    assumption about other components enters. Readings of one instrument that contradict a rigid motion get a `scatter`
    of their own, estimated before they are weighted where none is given. If the instruments then still contradict each
    other at 1 %, what they differ by is a further unknown of each, what remains even so enlarges U by the Birge ratio,
    and U reaches what the estimate is without each suspect. A single suspect that is a gross error is left out; where
    gross errors of several instruments would explain a contradiction, what they change is given no value.
    """
    own = [observation for observation in observations if observation.body == body]
    if not own:
        raise ValueError(f"observations: expected at least one of body {body}, found none")
    stated = [observation for observation in own if observation.stated]
    system, alone, out = reject_gross_errors(stated or own, unobserved_motion)
    solved = solve_consistently(system, alone, scatter)
    first, final, parts, open_ = solved.stated, solved.final, solved.parts, solved.suspicions
    unknowns = common_estimates(system.common, first)
    suspects = [name for one in open_ for name in one.names]
    tests = leave_one_out(system, first, suspects) if parts or source == "fused" else ()
    unclear = disputed_values(system, first, open_)
    given = replace(system, observed=system.observed & ~unclear)
    uncertainty, leaked = _uncertainty(given, solved)
    largest = np.argmax(np.where(given.observed, np.abs(final.acceleration / SCALE), -1.0), axis=1)
    phasors = Phasors(
        frequency_hz=system.observations[0].phasors.frequency_hz,
        value=np.where(given.observed, final.acceleration, complex(np.nan, np.nan)),
        covariance=uncertainty.covariance,
        channels=MOTION_COMPONENTS,
        unit=component_units(2),
        dof=uncertainty.dof()[np.arange(len(largest)), largest],
    )
    for observation in own if stated else ():
        if not observation.stated:
            tests += compare(observation, phasors.value, phasors.covariance)
    result = Acceleration(
        body=body,
        source=source,
        phasors=phasors,
        observed=given.observed,
        instruments=tuple(o.title for o in system.observations if np.any(np.isfinite(o.phasors.value))),
        uncertainty=uncertainty,
        consistency=(*tests, *out),
        chi2=first.chi2,
        dof=first.dof,
        unknowns=common_estimates(system.common, final) if parts else unknowns,
        notices=(),
        scatter=solved.scatter,
        unseen=system.unobserved_motion,
        assumed=system.unobserved_motion.amplitude(final.acceleration, given.observed, system.share),
        driven=system.driven_limit(final.acceleration),
        explanations=explanations(system, first, open_),
        disputed=unclear if np.any(unclear) else None,
        unnoticed=unnoticed(given, first) if source == "fused" and stated else (),
        leaked=leaked,
        probability=EstimatedNoise.of(system, first.effects).probability(first.chi2, first.dof, first.projector),
    )
    if (body, source) == ("load", "fused") and system.common and not solved.contradicted:
        result = replace(result, posterior=final.posterior, products=products(system, final.acceleration))
    swapped = exchanged_channels(system, first, open_) if any(one.gross for one in open_) else ()
    contradicted = deviating_unknowns(system, first, unknowns) if solved.contradicted else None
    return replace(result, notices=_notices(result, bool(stated), contradicted, swapped))


def reject_gross_errors(
    observations: Sequence[Observation], unobserved_motion: UnobservedMotion | None = None
) -> tuple[FusionSystem, FusionSolution, tuple[Consistency, ...]]:
    """Return the system without the readings that are gross errors by all others (NaN), its solution, and those errors.

    Left out is what alone would explain that readings contradict each other, one after another. Where several would,
    none is.
    """
    out: list[Consistency] = []
    system = bounded_system(observations, unobserved_motion)
    first = solve(system)
    for _ in range(MOST_LEFT_OUT):
        if not contradicts(system, first, common_estimates(system.common, first)):
            break
        found = suspicions(system, first)
        if len(found) != 1 or len(found[0].names) > 1 or not found[0].gross:
            break
        tests = leave_one_out(system, first, found[0].names)
        out += [replace(test, used=False, left_out=True) for test in tests if test.suspect]
        system = bounded_system(without_readings(system, found[0].rows), unobserved_motion)
        first = solve(system)
    return system, first, tuple(out)


@dataclass(frozen=True)
class ConsistentSolution:
    """A system solved with what is `stated`, and, where this is contradicted, with discrepancies (`parts`): `final`.

    `scatter`: of the instruments whose own readings contradict a rigid motion; `birge`: by which factor variances grow
    where the lines agree by themselves and contradict each other only together; `beside`: the unknowns that may be the
    cause of a contradiction, of which U has no less than they do, also in components that one instrument alone sees;
    `contradicted`: what is stated is, and `open` are the explanations of that.
    """

    stated: FusionSolution
    final: FusionSolution
    scatter: tuple[Scatter, ...]
    parts: tuple[Discrepancy, ...]
    birge: float = 1.0
    undetected: Discrepancy | None = None
    contradicted: bool = False
    suspicions: tuple[Suspicion, ...] = ()


def solve_consistently(
    system: FusionSystem, first: FusionSolution, scatter: tuple[Scatter, ...] | None = None
) -> ConsistentSolution:
    """Solve a system anew from its `first` solution, by what is stated, where the readings contradict that.

    They then get the discrepancies that `fuse` tells of.
    """
    contradicted = contradicts(system, first, common_estimates(system.common, first))
    open_ = suspicions(system, first) if contradicted else ()
    scatter = estimate_scatter(system, first) if scatter is None else scatter
    parts = scatter_covariances(system, first.acceleration, scatter)
    final = solve(system, np.sum([p.covariance for p in parts], axis=0)) if parts else first
    birge, beside = 1.0, None
    unknowns = common_estimates(system.common, final)
    if contradicts(system, final, unknowns):
        beside = undetected_errors(system, final, unknowns, INCONSISTENCY)
        failing = failing_lines(system, final)
        parts.append(disagreement(system, final, failing or range(len(system.observed)), INCONSISTENCY))
        final = solve(system, np.sum([p.covariance for p in parts], axis=0))
        noise = EstimatedNoise.of(system, final.effects)
        beyond = not failing and noise.fails(final.chi2, final.dof, final.projector)
        birge = final.chi2 / final.dof if beyond else 1.0
    return ConsistentSolution(first, final, scatter, tuple(parts), birge, beside, contradicted, open_)


def fuse_sources(
    observations: Sequence[Observation], body: str, unobserved_motion: UnobservedMotion | None = None
) -> tuple[Acceleration, ...]:
    """Return the fused acceleration of `body`, then that of each kind of instrument alone where it determines any.

    The scatter of an instrument is estimated once, so that no source claims more of it than another, and the driven
    motion is bounded by all instruments.
    """
    own = [observation for observation in observations if observation.body == body]
    fused = fuse(own, body, unobserved_motion=unobserved_motion)
    accelerations = [fused]
    known = None if unobserved_motion is None else replace(unobserved_motion, driven=fused.driven)
    for source in SINGLE_SOURCES:
        alone = [observation for observation in own if observation.kind == source]
        if not alone:
            continue
        used = any(observation.title in fused.instruments for observation in alone)
        if len(alone) == len(own):
            result = replace(fused, source=source, posterior=None, products=None)
        else:
            try:
                result = fuse(alone, body, source, fused.scatter if used else None, known)
            except Unbounded:
                continue
        if np.any(result.observed):
            accelerations.append(result)
    return tuple(accelerations)


def _uncertainty(system: FusionSystem, solved: ConsistentSolution) -> tuple[Uncertainty, FloatArray]:
    """Split gain · V · gain^T of every line into noise per instrument, discrepancies and common errors.

    With it, what motion that nobody observes does to the estimate by itself (`Acceleration.leaked`).
    """
    solution, lines = solved.final, len(system.observed)
    hidden = ~np.tile(system.observed, (1, 2))
    gain = solution.gain.reshape(lines, 12, -1)

    def carried(covariance: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        return np.asarray(gain[:, :, rows] @ covariance @ gain[:, :, rows].swapaxes(1, 2))

    noise = solution.noise - solution.hidden.covariance
    parts = []
    for part in solved.parts:
        noise = noise - part.covariance
        parts.append(Contribution(part.label, "A", carried(part.covariance), part.dof))
    if solved.undetected is not None:
        allowed = np.sum([part.covariance for part in parts], axis=0)
        missing = missing_covariance(carried(solved.undetected.covariance), allowed)
        parts.append(Contribution(solved.undetected.label, "A", missing, solved.undetected.dof))
    if solved.suspicions:
        wanted = explanation_covariance(solved.stated, solved.suspicions, solution.acceleration)
        allowed = np.sum([np.zeros_like(wanted), *(part.covariance for part in parts)], axis=0)
        parts.append(Contribution(EXPLANATIONS, "B", missing_covariance(wanted, allowed)))
    estimated = EstimatedNoise.of(system, solution.effects)
    for place, observation in enumerate(system.observations):
        rows = np.flatnonzero(system.observation == place)
        dof = np.nan_to_num(observation.phasors.dof, nan=np.inf, posinf=np.inf)
        own = carried(noise[np.ix_(rows, rows)], rows) + estimated.lost(solution.projector, gain, rows)
        parts.append(Contribution(f"{observation.title}: noise", "A", own, dof))
    leaked, rest = solution.hidden.carried(system, gain)
    if np.any(rest):
        parts.append(Contribution(UNOBSERVED, "B", rest))
    for place, label in enumerate(UNOBSERVED_ITSELF):
        own = leaked[:, :, [place, place + 6]]
        if np.any(own):
            parts.append(Contribution(label, "B", own @ own.swapaxes(1, 2)))
    if solved.birge > 1.0:
        excess = (solved.birge - 1.0) * carried(solution.noise + solution.effects @ solution.effects.T)
        parts.append(Contribution(INCONSISTENCY, "A", excess, np.full(lines, max(solution.dof / lines, 1.0))))
    effects = np.where(hidden[:, :, None], np.nan, gain @ solution.effects)
    influences = [
        Influence(c.name, c.label, c.u, c.unit, effects[:, :, place], c.scope, c.type, c.dof)
        for place, c in enumerate(system.common)
    ]
    unknown = hidden[:, :, None] | hidden[:, None, :]
    random = [replace(part, covariance=np.where(unknown, np.nan, part.covariance)) for part in parts]
    return Uncertainty(merge_contributions(random), tuple(influences)), np.where(hidden[:, :, None], 0.0, leaked)


# What an estimated acceleration wants the user to know: what is missing, who disagrees, what nothing tests.

REMAINING = 0.9
"""Where more than this share of a stated uncertainty remains, an error of three times as much would not be noticed."""
NOTABLE_SHARE = 0.1
"""Least share in the variance of a component for which an untested unknown is worth a word."""
EQUALLY_LIKELY = 0.95
MOST_NAMED = 3
MISSED = 5.0
"""Times its stated uncertainty: the largest error of a channel that is looked for among those that no test need see."""
POWER = 0.8
"""Chance with which the test sees an error that counts as noticed (Baarda's β)."""


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
    rows = []
    for unknown in (u for u in result.unknowns if u.name in effects):
        part = np.nan_to_num(effects[unknown.name])
        size = np.hypot(part[:6], part[6:])
        share = size**2 / total
        c = int(np.argmax(share))
        if unknown.remaining > REMAINING and share[c] > NOTABLE_SHARE:
            relative = float(size[c] / np.abs(value[line, c])) if value[line, c] else np.inf
            component = MOTION_COMPONENTS[c]
            rows.append(
                Untested(unknown.name, unknown.label, unknown.u, unknown.unit, component, float(share[c]), relative)
            )
    return tuple(sorted(rows, key=lambda row: -row.share))


@dataclass(frozen=True)
class Unnoticed:
    """What an error of one `channel` (or stereo pair) alone may move a `component` by, `shift` of its U, unnoticed."""

    channel: str
    component: str
    shift: float


def unnoticed(system: FusionSystem, solution: FusionSolution) -> tuple[Unnoticed, ...]:
    """Return what errors of single channels that a test may miss move by more than U as stated, at the strongest line.

    Reliability of a network (Baarda 1968, A testing procedure for use in geodetic networks): chi-square at 1 % sees an
    error δ of the readings I with 80 % where its noncentrality δᵀ·P_II·δ is λ (internal reliability); one below that
    moves the estimate by gain_I·δ (external reliability). Looked for are errors δ = R·z, R being the effects of one
    standard uncertainty of the unknowns that act on I alone, with |z| up to 5. With the eigenvalues p of RᵀP_II·R each
    of its directions goes to z² = min(25, λ/p): an ellipsoid inside both limits. Of a value it covers √μ standard
    deviations, μ the largest eigenvalue of the ellipsoid in that value over its covariance. U that held these errors,
    which the readings hardly show, would be too large wherever all is as stated (docs/uncertainty.md).
    """
    line = int(np.argmax(np.linalg.norm(solution.acceleration / SCALE, axis=1)))
    limit = EstimatedNoise.of(system, solution.effects).noticed(solution.dof, solution.projector, POWER)
    gain = solution.gain[12 * line : 12 * line + 12]
    covariance, touched, found = as_stated(solution, gain), solution.effects != 0.0, list[Unnoticed]()
    for place, name in enumerate(system.member_names):
        rows = np.flatnonzero(system.member == place)
        alone = touched[rows].any(axis=0) & (touched[rows].sum(axis=0) == touched.sum(axis=0))
        own = solution.effects[np.ix_(rows, alone)]
        power, vectors = np.linalg.eigh(own.T @ solution.projector[np.ix_(rows, rows)] @ own)
        reach = gain[:, rows] @ own @ (vectors / np.sqrt(np.maximum(1.0 / MISSED**2, power / limit)))
        moved = reach @ reach.T
        for c in np.flatnonzero(system.observed[line]).tolist():
            both = np.ix_([c, c + 6], [c, c + 6])
            largest = np.max(np.linalg.eigvals(np.linalg.solve(covariance[both], moved[both])).real, initial=0.0)
            shift = float(np.sqrt(largest) / region_factor(np.inf))
            found += [Unnoticed(name, MOTION_COMPONENTS[c], shift)] if shift > 1.0 else []
    return tuple(found)


def _notices(
    result: Acceleration,
    stated: bool,
    contradicted: Mapping[CommonEstimate, bool] | None,
    swapped: Sequence[tuple[str, str]],
) -> tuple[Notice, ...]:
    """Return the notices of an estimate.

    `stated`: some instrument states a systematic uncertainty; `contradicted`: the unknowns that deviate as they come
    out of what is stated, where the readings contradict that, and whether they explain it; `swapped`: channels that,
    exchanged, leave no contradiction.
    """
    titles, body = ", ".join(result.instruments), result.body
    notices = list(_unobserved_notices(result, titles))
    if not stated:
        notices.append(Notice(NOISE_ONLY, body, instruments=titles))
    for test in result.consistency:
        values: dict[str, Value] = {"deviation": test.normalised_deviation, "ratio": _ratio_text(test)}
        if test.left_out:
            notices.append(Notice(GROSS_ERROR, test.instrument, instrument=test.instrument, **values))
        elif not test.used:
            notices.append(Notice(COMPARED_ONLY, test.instrument, **values))
    if contradicted is not None:
        notices.append(_disagreement(result, contradicted, swapped))
    for scatter in result.scatter:
        line = int(np.argmax(np.hypot(scatter.amplitude, scatter.phase)))
        notices.append(
            Notice(
                READINGS_SCATTER,
                scatter.instrument,
                amplitude=scatter.amplitude[line],
                phase_rad=scatter.phase[line],
                frequency_hz=result.phasors.frequency_hz[line],
            )
        )
    if result.unnoticed:
        shifts = _describe_shifts(result.unnoticed)
        notices.append(Notice(SINGLE_ERROR_NOT_ASSESSED, body, limit=MISSED, shifts=shifts))
    return tuple(notices)


def _unobserved_notices(result: Acceleration, titles: str) -> Iterator[Notice]:
    """Yield which components the readings do not determine, and whether the driven motion has a limit."""
    seen = result.observed if result.disputed is None else result.observed | result.disputed
    for pattern in [] if np.all(seen) else np.unique(~seen, axis=0):
        if np.any(pattern):
            missing = ", ".join(name for name, hidden in zip(MOTION_COMPONENTS, pattern, strict=True) if hidden)
            lines, count = int(np.sum(np.all(seen == ~pattern, axis=1))), len(result.observed)
            values: dict[str, Value] = {"components": missing, "lines": lines, "all_lines": count}
            yield Notice(UNOBSERVED_COMPONENTS, result.body, instruments=titles, **values)
    if np.any(np.isinf(result.unobserved_amplitude)):
        driven = unmeasured_drive(result.body, result.unseen, np.any(result.observed, axis=0))
        yield Notice(UNBOUNDED_MOTION, result.body, driven=driven, unused="")


def _describe_shifts(found: Sequence[Unnoticed]) -> str:
    """Return which components undetected errors shift, how far, and of which channels."""
    listed = []
    for component in dict.fromkeys(one.component for one in sorted(found, key=lambda one: -one.shift)):
        rows = [one for one in found if one.component == component]
        largest = max(one.shift for one in rows)
        listed.append(f"{component} by up to {largest:.2g} U ({', '.join(one.channel for one in rows)})")
    return ", ".join(listed)


def _ratio_text(test: Consistency) -> str:
    """Return reading over prediction of an instrument, and the mistake that would cause it."""
    if not np.isfinite(test.ratio):
        return ""
    mistake = likely_mistake(test.ratio)
    cause = f", as if {mistake}" if mistake else ""
    return f" (reading/prediction {abs(test.ratio):.5g} at {np.angle(test.ratio):.5f} rad{cause})"


def _disagreement(
    result: Acceleration, unknowns: Mapping[CommonEstimate, bool], swapped: Sequence[tuple[str, str]]
) -> Notice:
    """Return the notice of instruments that disagree: which deviate, and which stated unknown explains it."""
    used = [test for test in result.consistency if test.used and np.isfinite(test.normalised_deviation)]
    used = sorted(used, key=lambda test: -test.normalised_deviation)
    suspects = [test for test in used if test.suspect] or used[:1]
    listed = [f"{one.instrument} by {one.normalised_deviation:.3g} u{_ratio_text(one)}" for one in suspects]
    exchanges = [f"whether {a} and {b} are exchanged" for a, b in swapped]
    values: dict[str, Value] = {
        "chi2": result.chi2,
        "dof": result.dof,
        "suspects": "; ".join(listed),
        "agreeing": " or ".join(one.suspect for one in result.explanations) or "several instruments",
        "causes": _causes(result, unknowns),
        "checks": ", ".join([*exchanges, "scale, sign, position and direction"]),
    }
    if result.disputed is None:
        return Notice(INSTRUMENTS_DISAGREE, result.body, **values)
    components = ", ".join(MOTION_COMPONENTS[c] for c in np.flatnonzero(np.any(result.disputed, axis=0)))
    return Notice(INSTRUMENTS_DISPUTED, result.body, components=components, values=_values(result), **values)


def _causes(result: Acceleration, deviating: Mapping[CommonEstimate, bool]) -> str:
    """Return the stated unknowns that explain a contradiction, else those that may contain a gross error."""

    def describe(unknown: CommonEstimate) -> str:
        unit = "" if unknown.unit == "1" else f" {unknown.unit}"
        factor = abs(unknown.unconstrained_value) / unknown.u
        return f"{unknown.name} of {unknown.unconstrained_value:.2g}{unit} ({factor:.3g} times its u)"

    # Those that deviate most, those that the readings cannot tell apart included.
    ranked = sorted(deviating, key=lambda unknown: -abs(unknown.deviation))
    possible, gross = [u for u in ranked if not u.gross], [u for u in ranked if u.gross]
    possible, gross = (
        [u for u in some if abs(u.deviation) >= EQUALLY_LIKELY * abs(some[0].deviation)] for some in (possible, gross)
    )
    explain = [u for u in possible if deviating[u]]
    if explain and result.disputed is None:
        return ", or ".join(map(describe, explain))
    if gross:
        return f"a gross error or wrong statement, {', or '.join(map(describe, gross[:MOST_NAMED]))}"
    return "none of the stated unknowns"


def _values(result: Acceleration) -> str:
    """Return the largest disputed value as it is without each suspect."""
    assert result.disputed is not None
    values = np.stack([one.value for one in result.explanations])
    size = np.max(np.abs(np.nan_to_num(values / SCALE)), axis=0)
    # A component that each of them determines takes precedence.
    size = np.where(np.all(np.isfinite(values), axis=0), 1e6 * size, size)
    line, c = np.unravel_index(np.argmax(np.where(result.disputed, size, -1.0)), size.shape)
    listed = []
    for one in result.explanations:
        text = "not determined"
        if np.isfinite(one.value[line, c]):
            found = polar(complex(one.value[line, c]), element_covariance(one.covariance[line], int(c)))
            number = round_to_uncertainty(found.magnitude, found.expanded_magnitude, 0)
            text = f"({number.value} ± {number.expanded}) {result.phasors.unit[c]}"
        listed.append(f"{text} without {one.suspect}")
    at = f"{MOTION_COMPONENTS[c]} at {result.phasors.frequency_hz[line]:.6g} Hz"
    return f"{at} is {', '.join(listed)} (U, k = 2)"
