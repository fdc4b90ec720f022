"""Generalised least squares of all instruments of a body: its six-component acceleration and its notices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from fusion.estimation.consistent_solution import (
    INCONSISTENCY,
    ConsistentSolution,
    missing_covariance,
    solve_consistently,
)
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
    common_estimates,
    compare_with_estimate,
    deviating_unknowns,
    disputed_values,
    estimate_explanations,
    exchanged_channels,
    explanation_covariance,
    leave_one_out,
    likely_mistake,
    stated_covariance,
)
from fusion.estimation.labelled_phasors import LabelledPhasors, TabularResult
from fusion.estimation.least_squares import (
    UNOBSERVED,
    UNOBSERVED_ITSELF,
    FusionSolution,
    FusionSystem,
    Unbounded,
    products,
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
from fusion.estimation.variance_components import EstimatedNoise, Scatter
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import BoolArray, FloatArray, IntArray
from shakercal._common.digits import number_text, round_to_uncertainty, signed_text
from shakercal._common.notices import Notice, Value

Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]
SINGLE_SOURCES: tuple[Source, ...] = ("photogrammetry", "vibrometer", "accelerometer")
EXPLANATIONS = "explanations of a contradiction"


@dataclass(frozen=True, repr=False)
class Acceleration(TabularResult):
    """Six-component acceleration phasors of one body at the sensor origin.

    Attributes
    ----------
    body, source : body, and instruments used: `fused` or one kind of them.
    phasors : (K, 6), m/s² and rad/s²; NaN where not observed.
    observed : (K, 6), components that the readings determine.
    instruments : names of the instruments used.
    uncertainty : of the six components; noise and common errors, which act on all lines.
    consistency : agreement of each instrument with all others.
    chi2, dof, probability : test of the readings against their stated uncertainties.
    unknowns : estimates of the common errors.
    notices : notices of the estimate.
    scatter : instruments whose readings scatter beyond their stated uncertainties.
    unobserved_limits : limits of components that are not observed.
    assumed : (K, 6), amplitudes of these components; infinite without a limit of the driven motion.
    driven : (K,), largest amplitude of the driven motion; None if the drive is not stated.
    explanations : estimates without each suspect, where instruments contradict each other.
    disputed : (K, 6), values that are not determined because gross errors of several instruments explain a
        contradiction; None if there are none.
    unnoticed : shifts of components by undetected errors of a single channel; of the fused estimate.
    leaked : (K, 12, 12), change of [Re, Im] per standard uncertainty of unobserved motion.
    posterior : (E, E), covariance of `unknowns` after the estimate, in their u; of the fused load only, None if its
        instruments contradict each other.
    products : (E,), second-order action of the unknowns (`least_squares.products`).
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
    unobserved_limits: UnobservedMotion = field(default_factory=UnobservedMotion, metadata={"dataset": "unseen"})
    assumed: FloatArray | None = None
    driven: FloatArray | None = None
    explanations: tuple[Explanation, ...] = ()
    disputed: BoolArray | None = None
    unnoticed: tuple[Unnoticed, ...] = ()
    leaked: FloatArray | None = None
    probability: float = float("nan")
    posterior: FloatArray | None = None
    products: FloatArray | None = None

    def labelled(self) -> LabelledPhasors:
        """Return the components with their names and units."""
        value, body = self.phasors.value, (self.body,) * 6
        name, kind = f"acceleration {self.body}-{self.source}", ("phasor",) * len(value)
        units = component_units(2)
        return LabelledPhasors(
            name, self.phasors.frequency_hz, value, body, MOTION_COMPONENTS, units, self.uncertainty, kind
        )

    @cached_property
    def unobserved_amplitude(self) -> FloatArray:
        """Return the assumed amplitudes (K, 6) of unobserved components, 0 for the others."""
        value = np.asarray(np.nan_to_num(self.phasors.value))
        return self.unobserved_limits.amplitude(value, self.observed) if self.assumed is None else self.assumed

    @cached_property
    def polar(self) -> list[list[Polar | None]]:
        """Return magnitude and phase (K lines of 6), None where one is not observed."""
        return polar_elements(self.phasors.value, self.uncertainty, self.phasors.covariance)


def fuse(
    observations: Sequence[Observation],
    body: str = "load",
    source: Source = "fused",
    scatter: tuple[Scatter, ...] | None = None,
    unobserved_motion: UnobservedMotion | None = None,
) -> Acceleration:
    """Estimate the acceleration of `body` from all its instruments, jointly over all lines.

    Instruments without a stated systematic uncertainty are compared with the result and not used, unless there are no
    others. A component is observed only if the readings of its line determine it, without priors and without
    assumptions about other components.

    Readings of one instrument that contradict a rigid motion get a `scatter`, estimated before they are weighted if
    none is given. If the instruments then contradict each other at 1 %, their differences become further unknowns, and
    the Birge ratio enlarges U for the remaining ones. U also covers the estimates without each suspect. A single
    suspect with a gross error is rejected. Where gross errors of several instruments would explain a contradiction, the
    affected components have no value.
    """
    of_body = [observation for observation in observations if observation.body == body]
    if not of_body:
        raise ValueError(f"observations: expected at least one of body {body}, found none")
    stated = [observation for observation in of_body if observation.stated]
    solved = solve_consistently(stated or of_body, unobserved_motion, scatter)
    system, first, final = solved.system, solved.stated, solved.final
    parts, suspicions = solved.parts, solved.suspicions
    unknowns = common_estimates(system.common, first)
    suspects = [name for one in suspicions for name in one.names]
    tests = leave_one_out(system, first, suspects) if parts or source == "fused" else ()
    unclear = disputed_values(system, first, suspicions)
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
    for observation in [one for one in of_body if stated and not one.stated]:
        tests += compare_with_estimate(observation, phasors.value, phasors.covariance)
    result = Acceleration(
        body=body,
        source=source,
        phasors=phasors,
        observed=given.observed,
        instruments=tuple(o.title for o in system.observations if np.any(np.isfinite(o.phasors.value))),
        uncertainty=uncertainty,
        consistency=(*tests, *solved.rejected),
        chi2=first.chi2,
        dof=first.dof,
        unknowns=common_estimates(system.common, final) if parts else unknowns,
        notices=(),
        scatter=solved.scatter,
        unobserved_limits=system.unobserved_motion,
        assumed=system.unobserved_motion.amplitude(final.acceleration, given.observed, system.share),
        driven=system.driven_limit(final.acceleration),
        explanations=estimate_explanations(system, first, suspicions),
        disputed=unclear if np.any(unclear) else None,
        unnoticed=unnoticed(given, first) if source == "fused" and stated else (),
        leaked=leaked,
        probability=EstimatedNoise.from_system(system, first.effects).p_value(first.chi2, first.dof, first.projector),
    )
    if (body, source) == ("load", "fused") and system.common and not solved.contradicted:
        result = replace(result, posterior=final.posterior, products=products(system, final.acceleration))
    gross = any(one.gross for one in suspicions)
    swapped = exchanged_channels(system, first, suspicions) if gross else ()
    contradicted = deviating_unknowns(system, first, unknowns) if solved.contradicted else None
    return replace(result, notices=_notices(result, bool(stated), contradicted, swapped))


def fuse_sources(
    observations: Sequence[Observation], body: str, unobserved_motion: UnobservedMotion | None = None
) -> tuple[Acceleration, ...]:
    """Return the fused acceleration of `body` and that of each kind of instrument alone.

    Kinds that determine no component are omitted. The scatter of an instrument is estimated once for all sources, and
    the driven motion is limited by all instruments.
    """
    of_body = [observation for observation in observations if observation.body == body]
    fused = fuse(of_body, body, unobserved_motion=unobserved_motion)
    accelerations = [fused]
    limits = None if unobserved_motion is None else replace(unobserved_motion, driven=fused.driven)
    for source in SINGLE_SOURCES:
        alone = [observation for observation in of_body if observation.kind == source]
        if not alone:
            continue
        used = any(observation.title in fused.instruments for observation in alone)
        if len(alone) == len(of_body):
            result = replace(fused, source=source, posterior=None, products=None)
        else:
            try:
                result = fuse(alone, body, source, fused.scatter if used else None, limits)
            except Unbounded:
                continue
        if np.any(result.observed):
            accelerations.append(result)
    return tuple(accelerations)


def _uncertainty(system: FusionSystem, solved: ConsistentSolution) -> tuple[Uncertainty, FloatArray]:
    """Return noise, discrepancies and common errors of an estimate, and `Acceleration.leaked`."""
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
        required = explanation_covariance(solved.stated, solved.suspicions, solution.acceleration)
        allowed = np.sum([np.zeros_like(required), *(part.covariance for part in parts)], axis=0)
        parts.append(Contribution(EXPLANATIONS, "B", missing_covariance(required, allowed)))
    estimated = EstimatedNoise.from_system(system, solution.effects)
    for index, observation in enumerate(system.observations):
        rows = np.flatnonzero(system.observation == index)
        dof = np.nan_to_num(observation.phasors.dof, nan=np.inf, posinf=np.inf)
        part_covariance = carried(noise[np.ix_(rows, rows)], rows)
        part_covariance = part_covariance + estimated.estimation_covariance(solution.projector, gain, rows)
        parts.append(Contribution(f"{observation.title}: noise", "A", part_covariance, dof))
    leaked, rest = solution.hidden.carried(system, gain)
    if np.any(rest):
        parts.append(Contribution(UNOBSERVED, "B", rest))
    for index, label in enumerate(UNOBSERVED_ITSELF):
        part_covariance = leaked[:, :, [index, index + 6]]
        if np.any(part_covariance):
            parts.append(Contribution(label, "B", part_covariance @ part_covariance.swapaxes(1, 2)))
    if solved.birge > 1.0:
        excess = (solved.birge - 1.0) * carried(solution.noise + solution.effects @ solution.effects.T)
        parts.append(Contribution(INCONSISTENCY, "A", excess, np.full(lines, max(solution.dof / lines, 1.0))))
    effects = np.where(hidden[:, :, None], np.nan, gain @ solution.effects)
    influences = [
        Influence(c.name, c.label, c.u, c.unit, effects[:, :, index], c.scope, c.type, c.dof)
        for index, c in enumerate(system.common)
    ]
    unknown = hidden[:, :, None] | hidden[:, None, :]
    random = [replace(part, covariance=np.where(unknown, np.nan, part.covariance)) for part in parts]
    return Uncertainty(merge_contributions(random), tuple(influences)), np.where(hidden[:, :, None], 0.0, leaked)


# Unknowns that the data cannot test, and errors that they cannot detect.

REMAINING = 0.9
"""Remaining share of a stated uncertainty above which an error of three times its size is undetected."""
NOTABLE_SHARE = 0.1
"""Share in the variance of a component above which an untested unknown is listed (chosen)."""
POWER = 0.8
"""Probability with which the test detects an error (Baarda's β)."""
MISSED = 5.0
"""Largest undetected error of a channel that is examined, in its stated standard uncertainties (chosen)."""


@dataclass(frozen=True)
class Untested:
    """An unknown that the data cannot test, with its stated `u` in `unit`.

    `share`: part in the variance of the `component` that it affects most, at the strongest line. `relative`: change of
    that component per standard uncertainty, over the component's amplitude.
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
    """Shift of a `component`, over U, by an undetected error of one `channel` or pair."""

    channel: str
    component: str
    shift: float


def unnoticed(system: FusionSystem, solution: FusionSolution) -> tuple[Unnoticed, ...]:
    """Return shifts beyond U by undetected errors of single channels, at the strongest line.

    Reliability of a network (Baarda 1968, A testing procedure for use in geodetic networks). Chi-square at 1 % detects
    an error δ of the readings I with 80 % if its noncentrality δᵀ·P_II·δ is λ (internal reliability). A smaller one
    moves the estimate by gain_I·δ (external reliability).

    The errors examined are δ = R·z, with the effects R of one standard uncertainty of the unknowns that act on I alone
    and |z| up to 5. With the eigenvalues p of RᵀP_II·R each direction reaches z² = min(25, λ/p): an ellipsoid inside
    both limits. It covers √μ standard deviations of a value, μ being the largest eigenvalue of the ellipsoid in that
    value over its covariance. Including these errors would make U too large wherever the statements are correct
    (docs/uncertainty.md).
    """
    line = int(np.argmax(np.linalg.norm(solution.acceleration / SCALE, axis=1)))
    noise = EstimatedNoise.from_system(system, solution.effects)
    limit = noise.detectable_noncentrality(solution.dof, solution.projector, POWER)
    gain = solution.gain[12 * line : 12 * line + 12]
    covariance, touched, found = stated_covariance(solution, gain), solution.effects != 0.0, list[Unnoticed]()
    for index, name in enumerate(system.member_names):
        rows = np.flatnonzero(system.member == index)
        alone = touched[rows].any(axis=0) & (touched[rows].sum(axis=0) == touched.sum(axis=0))
        effects = solution.effects[np.ix_(rows, alone)]
        power, vectors = np.linalg.eigh(effects.T @ solution.projector[np.ix_(rows, rows)] @ effects)
        reach = gain[:, rows] @ effects @ (vectors / np.sqrt(np.maximum(1.0 / MISSED**2, power / limit)))
        moved = reach @ reach.T
        for c in np.flatnonzero(system.observed[line]).tolist():
            both = np.ix_([c, c + 6], [c, c + 6])
            largest = np.max(np.linalg.eigvals(np.linalg.solve(covariance[both], moved[both])).real, initial=0.0)
            shift = float(np.sqrt(largest) / region_factor(np.inf))
            found += [Unnoticed(name, MOTION_COMPONENTS[c], shift)] if shift > 1.0 else []
    return tuple(found)


# Notices: undetermined components, disagreement, scatter and undetected errors.


EQUALLY_LIKELY = 0.95
"""Deviation over the largest one above which an unknown is an equally likely cause (chosen)."""
MOST_NAMED = 3


def _notices(
    result: Acceleration,
    stated: bool,
    contradicted: Mapping[CommonEstimate, bool] | None,
    swapped: Sequence[tuple[str, str]],
) -> tuple[Notice, ...]:
    """Return the notices of an estimate.

    `stated`: some instrument states a systematic uncertainty. `contradicted`: unknowns that deviate from their stated
    values where the readings contradict these, and whether they explain it; None without a contradiction. `swapped`:
    channels that, exchanged, leave no contradiction.
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
    """Yield notices of undetermined components and of a driven motion without limit."""
    seen = result.observed if result.disputed is None else result.observed | result.disputed
    for pattern in [] if np.all(seen) else np.unique(~seen, axis=0):
        if np.any(pattern):
            missing = ", ".join(name for name, hidden in zip(MOTION_COMPONENTS, pattern, strict=True) if hidden)
            lines, count = int(np.sum(np.all(seen == ~pattern, axis=1))), len(result.observed)
            yield Notice(
                UNOBSERVED_COMPONENTS, result.body, instruments=titles, components=missing, lines=lines, all_lines=count
            )
    if np.any(np.isinf(result.unobserved_amplitude)):
        driven = unmeasured_drive(result.body, result.unobserved_limits, np.any(result.observed, axis=0))
        yield Notice(UNBOUNDED_MOTION, result.body, driven=driven, unused="")


def _describe_shifts(found: Sequence[Unnoticed]) -> str:
    """Return which components undetected errors shift, how far, and of which channels."""
    listed = []
    for component in dict.fromkeys(one.component for one in sorted(found, key=lambda one: -one.shift)):
        rows = [one for one in found if one.component == component]
        largest = max(one.shift for one in rows)
        listed.append(f"{component} by up to {number_text(largest, 2)} U ({', '.join(one.channel for one in rows)})")
    return ", ".join(listed)


def _ratio_text(test: Consistency) -> str:
    """Return reading over prediction of an instrument, and the mistake that would cause it."""
    if not np.isfinite(test.ratio):
        return ""
    mistake = likely_mistake(test.ratio)
    cause = f", as if {mistake}" if mistake else ""
    angle = signed_text(float(np.angle(test.ratio)), ".5f")
    return f" (reading/prediction {number_text(abs(test.ratio), 5)} at {angle} rad{cause})"


def _disagreement(
    result: Acceleration, unknowns: Mapping[CommonEstimate, bool], swapped: Sequence[tuple[str, str]]
) -> Notice:
    """Return the notice of instruments that disagree: which deviate, and which stated unknown explains it."""
    used = [test for test in result.consistency if test.used and np.isfinite(test.normalised_deviation)]
    used = sorted(used, key=lambda test: -test.normalised_deviation)
    suspects = [test for test in used if test.suspect] or used[:1]
    listed = [f"{one.instrument} by {number_text(one.normalised_deviation)} u{_ratio_text(one)}" for one in suspects]
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
    """Return the stated unknowns that explain a contradiction, else possible gross errors, as text."""

    def describe(unknown: CommonEstimate) -> str:
        unit = "" if unknown.unit == "1" else f" {unknown.unit}"
        factor = abs(unknown.unconstrained_value) / unknown.u
        return (
            f"{unknown.name} of {number_text(unknown.unconstrained_value, 2)}{unit} ({number_text(factor)} times its u)"
        )

    # Those that deviate most, including those that the readings cannot distinguish.
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
    at = f"{MOTION_COMPONENTS[c]} at {number_text(result.phasors.frequency_hz[line], 6)} Hz"
    return f"{at} is {', '.join(listed)} (U, k = 2)"
