"""Generalised least squares of all instruments of a body: its six-component acceleration and its notices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from fusion.estimation.acceleration_checks import MISSED, acceleration_notices
from fusion.estimation.coverage import Polar, region_factor
from fusion.estimation.instrument_consistency import (
    CommonEstimate,
    Consistency,
    Explanation,
    Suspicion,
    common_estimates,
    compare_with_estimate,
    contradicts,
    deviating_unknowns,
    disputed_values,
    estimate_explanations,
    exchanged_channels,
    explanation_covariance,
    find_suspicions,
    leave_one_out,
    stated_covariance,
    without_readings,
)
from fusion.estimation.labelled_phasors import LabelledPhasors, TabularResult
from fusion.estimation.least_squares import (
    UNOBSERVED,
    UNOBSERVED_ITSELF,
    FusionSolution,
    FusionSystem,
    Unbounded,
    bounded_system,
    products,
    solve,
)
from fusion.estimation.measurement_model import SCALE, Observation, UnobservedMotion
from fusion.estimation.uncertainty import (
    Contribution,
    Influence,
    Uncertainty,
    merge_contributions,
    polar_elements,
    total_variance,
)
from fusion.estimation.undetected_errors import missing_covariance, undetected_errors
from fusion.estimation.variance_components import (
    AddedCovariance,
    EstimatedNoise,
    Scatter,
    contradictory_lines,
    estimate_scatter,
    instrument_discrepancy,
    scatter_covariances,
)
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import BoolArray, FloatArray, IntArray
from shakercal._common.notices import Notice

Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]
SINGLE_SOURCES: tuple[Source, ...] = ("photogrammetry", "vibrometer", "accelerometer")
INCONSISTENCY = "inconsistency of instruments"
EXPLANATIONS = "explanations of a contradiction"
MOST_LEFT_OUT = 4
"""Gross errors that are looked for one after another."""


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

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """Return the budget, one contribution per label.

        Their sum is the covariance of the phasors.
        """
        return self.uncertainty.grouped()

    @cached_property
    def polar(self) -> list[list[Polar | None]]:
        """Return the components (K lines of 6) as magnitude and phase.

        None where one is not observed.
        """
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
    system, alone, out = reject_gross_errors(stated or of_body, unobserved_motion)
    solved = solve_consistently(system, alone, scatter)
    first, final, parts, suspicions = solved.stated, solved.final, solved.parts, solved.suspicions
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
        consistency=(*tests, *out),
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
    return replace(result, notices=acceleration_notices(result, bool(stated), contradicted, swapped))


def reject_gross_errors(
    observations: Sequence[Observation], unobserved_motion: UnobservedMotion | None = None
) -> tuple[FusionSystem, FusionSolution, tuple[Consistency, ...]]:
    """Return the system without gross errors, its solution, and the tests of the rejected readings.

    A reading is rejected (NaN) if it alone explains that readings contradict each other, one after another. If several
    would explain it, none is rejected.
    """
    out: list[Consistency] = []
    system = bounded_system(observations, unobserved_motion)
    first = solve(system)
    for _ in range(MOST_LEFT_OUT):
        if not contradicts(system, first, common_estimates(system.common, first)):
            break
        found = find_suspicions(system, first)
        if len(found) != 1 or len(found[0].names) > 1 or not found[0].gross:
            break
        tests = leave_one_out(system, first, found[0].names)
        out += [replace(test, used=False, left_out=True) for test in tests if test.suspect]
        system = bounded_system(without_readings(system, found[0].rows), unobserved_motion)
        first = solve(system)
    return system, first, tuple(out)


@dataclass(frozen=True)
class ConsistentSolution:
    """A system solved as stated, and with discrepancies where the readings contradict that.

    `stated`: solution by the stated uncertainties. `final`: solution with the discrepancies `parts`. `scatter`: of
    instruments whose readings contradict a rigid motion. `birge`: factor of variances if the lines agree separately and
    contradict each other only together. `undetected`: unknowns that may cause a contradiction, which U includes also in
    components that a single instrument observes. `contradicted`: whether the readings contradict the stated
    uncertainties; `suspicions`: explanations of that.
    """

    stated: FusionSolution
    final: FusionSolution
    scatter: tuple[Scatter, ...]
    parts: tuple[AddedCovariance, ...]
    birge: float = 1.0
    undetected: AddedCovariance | None = None
    contradicted: bool = False
    suspicions: tuple[Suspicion, ...] = ()


def solve_consistently(
    system: FusionSystem, first: FusionSolution, scatter: tuple[Scatter, ...] | None = None
) -> ConsistentSolution:
    """Solve a system with discrepancies if its `first` solution is contradicted.

    The discrepancies are those that `fuse` describes.
    """
    contradicted = contradicts(system, first, common_estimates(system.common, first))
    found = find_suspicions(system, first) if contradicted else ()
    scatter = estimate_scatter(system, first) if scatter is None else scatter
    parts = scatter_covariances(system, first.acceleration, scatter)
    final = solve(system, np.sum([p.covariance for p in parts], axis=0)) if parts else first
    birge, undetected = 1.0, None
    unknowns = common_estimates(system.common, final)
    if contradicts(system, final, unknowns):
        undetected = undetected_errors(system, final, unknowns, INCONSISTENCY)
        failing = contradictory_lines(system, final)
        parts.append(instrument_discrepancy(system, final, failing or range(len(system.observed)), INCONSISTENCY))
        final = solve(system, np.sum([p.covariance for p in parts], axis=0))
        noise = EstimatedNoise.from_system(system, final.effects)
        beyond = not failing and noise.fails(final.chi2, final.dof, final.projector)
        birge = final.chi2 / final.dof if beyond else 1.0
    return ConsistentSolution(first, final, scatter, tuple(parts), birge, undetected, contradicted, found)


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
    """Split gain · V · gain^T of every line into noise, discrepancies and common errors.

    Also return the direct effect of unobserved motion on the estimate (`Acceleration.leaked`).
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
    """Shift of a `component` by an undetected error of one `channel` or stereo pair.

    `shift`: in units of U.
    """

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
