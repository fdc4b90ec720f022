"""Generalised least squares of all instruments of a body: its six-component acceleration, and whether they agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.estimation.consistency import (
    Acceleration,
    Source,
    compare,
    contradicts,
    doubt,
    estimates,
    fails,
    leave_one_out,
    not_allowed_for,
    verdict,
)
from fusion.estimation.least_squares import SCALE, Solution, System, build_system, solve
from fusion.estimation.measurement_model import Observation
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty, merge_contributions
from fusion.estimation.variance_components import (
    Discrepancy,
    Scatter,
    disagreement,
    estimate_scatter,
    failing_lines,
    scatter_covariances,
)
from shaker.arrays import BoolArray, FloatArray
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors

SINGLE_SOURCES: tuple[Source, ...] = ("photogrammetry", "vibrometer", "accelerometer")
INCONSISTENCY = "inconsistency of instruments"
UNOBSERVED = "unobserved motion"


def fuse(
    observations: Sequence[Observation],
    body: str = "load",
    source: Source = "fused",
    scatter: tuple[Scatter, ...] | None = None,
) -> Acceleration:
    """Estimate the acceleration of `body` from all its instruments, jointly over all lines.

    Instruments without any stated systematic uncertainty are compared with the result, not used, unless there are no
    others. A component is observed only if the readings of its line determine it by themselves: neither a prior nor an
    assumption about other components enters. Readings of one instrument that contradict a rigid motion get a `scatter`
    of their own, estimated before they are weighted where none is given. If the instruments then still contradict each
    other at 1 %, what they differ by is a further unknown of each, and what remains even so enlarges U by the Birge
    ratio.
    """
    own = [observation for observation in observations if observation.body == body]
    if not own:
        raise ValueError(f"observations: expected at least one of body {body}, found none")
    stated = [observation for observation in own if observation.stated]
    system = build_system(stated or own)
    solved = solve_consistently(system, scatter)
    first, final, parts, unknowns = solved.stated, solved.final, solved.parts, estimates(system.common, solved.stated)
    failed = unknowns if contradicts(first, unknowns) else None
    tests = leave_one_out(system, first, failed is not None) if parts or source == "fused" else ()
    uncertainty = _uncertainty(system, solved)
    phasors = _phasors(system, final, uncertainty)
    for observation in own if stated else ():
        if not observation.stated:
            tests += compare(observation, phasors.value, phasors.covariance)
    result = Acceleration(
        body=body,
        source=source,
        phasors=phasors,
        observed=system.observed,
        instruments=tuple(observation.title for observation in system.observations),
        uncertainty=uncertainty,
        consistency=tests,
        chi2=first.chi2,
        dof=first.dof,
        unknowns=estimates(system.common, final) if parts else unknowns,
        notices=(),
        scatter=solved.scatter,
    )
    return replace(result, notices=verdict(result, bool(stated), failed))


@dataclass(frozen=True)
class Solved:
    """A system solved with what is `stated`, and, where this is contradicted, with discrepancies (`parts`): `final`.

    `scatter`: of the instruments whose own readings contradict a rigid motion; `birge`: by which factor variances grow
    where the lines agree by themselves and contradict each other only together; `beside`: the unknowns that may be the
    cause of a contradiction, of which U has no less than they do, also in components that one instrument alone sees.
    """

    stated: Solution
    final: Solution
    scatter: tuple[Scatter, ...]
    parts: tuple[Discrepancy, ...]
    birge: float = 1.0
    beside: Discrepancy | None = None


def solve_consistently(system: System, scatter: tuple[Scatter, ...] | None = None) -> Solved:
    """Solve a system; readings that contradict what is stated get the discrepancies that `fuse` tells of."""
    first = solve(system)
    found = estimate_scatter(system, first) if scatter is None else scatter
    parts = scatter_covariances(system, first.acceleration, found)
    final = solve(system, _total(parts)) if parts else first
    birge, beside = 1.0, None
    unknowns = estimates(system.common, final)
    if contradicts(final, unknowns):
        beside = doubt(system, final, unknowns, INCONSISTENCY)
        failing = failing_lines(system, final)
        parts.append(disagreement(system, final, failing or range(len(system.observed)), INCONSISTENCY))
        final = solve(system, _total(parts))
        birge = final.chi2 / final.dof if not failing and fails(final.chi2, final.dof) else 1.0
    return Solved(first, final, found, tuple(parts), birge, beside)


def _total(parts: Sequence[Discrepancy]) -> FloatArray:
    """Sum of what discrepancies add to the covariance of the readings."""
    return np.asarray(np.sum([part.covariance for part in parts], axis=0))


def _phasors(system: System, solution: Solution, uncertainty: Uncertainty) -> Phasors:
    """Estimate with its whole covariance, NaN where not observed; degrees of freedom of the largest component."""
    lines = np.arange(len(system.observed))
    component = np.argmax(np.where(system.observed, np.abs(solution.acceleration / SCALE), -1.0), axis=1)
    return Phasors(
        frequency_hz=system.observations[0].phasors.frequency_hz,
        value=np.where(system.observed, solution.acceleration, complex(np.nan, np.nan)),
        covariance=uncertainty.covariance,
        channels=MOTION_COMPONENTS,
        unit=component_units(2),
        dof=uncertainty.dof()[lines, component],
    )


def fuse_sources(observations: Sequence[Observation], body: str) -> tuple[Acceleration, ...]:
    """Return the fused acceleration of `body`, then that of each kind of instrument alone where it determines any.

    The scatter of an instrument is estimated once, so that no source claims more of it than another.
    """
    own = [observation for observation in observations if observation.body == body]
    fused = fuse(own, body)
    found = [fused]
    for source in SINGLE_SOURCES:
        alone = [observation for observation in own if observation.kind == source]
        if alone:
            result = replace(fused, source=source) if len(alone) == len(own) else _alone(alone, body, source, fused)
            if np.any(result.observed):
                found.append(result)
    return tuple(found)


def _alone(observations: Sequence[Observation], body: str, source: Source, fused: Acceleration) -> Acceleration:
    """Estimate from one kind of instrument; its scatter is known from the fused estimate if that used any of it."""
    used = any(observation.title in fused.instruments for observation in observations)
    return fuse(observations, body, source, fused.scatter if used else None)


def _hide(covariance: FloatArray, hidden: BoolArray) -> FloatArray:
    """NaN in the rows and columns of components that are not observed."""
    return np.where(hidden[:, :, None] | hidden[:, None, :], np.nan, covariance)


def _uncertainty(system: System, solved: Solved) -> Uncertainty:
    """Split gain · V · gain^T of every line into noise per instrument, discrepancies and common errors."""
    solution, lines = solved.final, len(system.observed)
    hidden = ~np.tile(system.observed, (1, 2))
    gain = solution.gain.reshape(lines, 12, -1)
    noise = solution.noise - np.diag(solution.hidden)
    found = []
    for part in solved.parts:
        noise = noise - part.covariance
        found.append(Contribution(part.label, "A", _carried(gain, part.covariance), part.dof))
    if solved.beside is not None:
        allowed = np.sum([part.covariance for part in found], axis=0)
        missing = not_allowed_for(_carried(gain, solved.beside.covariance), allowed)
        found.append(Contribution(solved.beside.label, "A", missing, solved.beside.dof))
    for place, observation in enumerate(system.observations):
        rows = np.flatnonzero(system.observation == place)
        covariance = _carried(gain[:, :, rows], noise[np.ix_(rows, rows)])
        dof = np.nan_to_num(observation.phasors.dof, nan=np.inf, posinf=np.inf)
        found.append(Contribution(f"{observation.title}: noise", "A", covariance, dof))
    if np.any(solution.hidden > 0.0):
        found.append(Contribution(UNOBSERVED, "B", _carried(gain, np.diag(solution.hidden))))
    if solved.birge > 1.0:
        excess = (solved.birge - 1.0) * _carried(gain, solution.noise + solution.effects @ solution.effects.T)
        found.append(Contribution(INCONSISTENCY, "A", excess, np.full(lines, max(solution.dof / lines, 1.0))))
    effects = np.where(hidden[:, :, None], np.nan, gain @ solution.effects)
    influences = [
        Influence(c.name, c.label, c.u, c.unit, effects[:, :, place], c.scope, c.type)
        for place, c in enumerate(system.common)
    ]
    random = [replace(part, covariance=_hide(part.covariance, hidden)) for part in found]
    return Uncertainty(merge_contributions(random), tuple(influences))


def _carried(gain: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (K, 12, 12) of the estimate from that of the readings."""
    return np.asarray(gain @ covariance @ gain.swapaxes(1, 2))
