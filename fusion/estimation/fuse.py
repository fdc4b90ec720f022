"""Generalised least squares of all instruments of a body: its six-component acceleration, and what to tell of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from fusion.base import AnyNotice
from fusion.estimation.consistency import (
    NOTABLE_DEVIATION,
    CommonEstimate,
    Consistency,
    compare,
    contradicts,
    estimates,
    leave_one_out,
    not_allowed_for,
    undetected_errors,
)
from fusion.estimation.least_squares import SCALE, UNOBSERVED, Solution, System, UnseenMotion, build_system, solve
from fusion.estimation.measurement_model import Observation
from fusion.estimation.uncertainty import (
    Contribution,
    Influence,
    Uncertainty,
    merge_contributions,
    total_variance,
)
from fusion.estimation.variance_components import (
    Discrepancy,
    Scatter,
    disagreement,
    estimate_scatter,
    failing_lines,
    fails,
    scatter_covariances,
)
from shaker.arrays import BoolArray, FloatArray, IntArray, Notice, brief
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors

Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]
SINGLE_SOURCES: tuple[Source, ...] = ("photogrammetry", "vibrometer", "accelerometer")
INCONSISTENCY = "inconsistency of instruments"


@dataclass(frozen=True)
class Acceleration:
    """Six-component acceleration phasors of one body at the sensor origin.

    `phasors` (K, 6) in m/s^2 and rad/s^2, NaN where not `observed` (K, 6). `uncertainty` of the six components, NaN
    where not observed: noise of every instrument and the common errors, which act on all lines at once. `unknowns`:
    what the data say of those. `consistency`, `chi2` and `dof` rest on what is stated; `scatter`: instruments whose
    readings scatter beyond that. `unseen`: what is assumed of components that are not observed.
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
    unseen: UnseenMotion = field(default_factory=UnseenMotion)

    __repr__ = brief

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """Return the budget: one contribution per label; they add up to the covariance of the phasors."""
        return self.uncertainty.grouped()


def fuse(
    observations: Sequence[Observation],
    body: str = "load",
    source: Source = "fused",
    scatter: tuple[Scatter, ...] | None = None,
    unseen: UnseenMotion | None = None,
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
    system = build_system(stated or own, unseen)
    solved = solve_consistently(system, scatter)
    first, final, parts = solved.stated, solved.final, solved.parts
    unknowns = estimates(system.common, first)
    failed = unknowns if contradicts(first, unknowns) else None
    tests = leave_one_out(system, first, failed is not None) if parts or source == "fused" else ()
    uncertainty = _uncertainty(system, solved)
    lines = np.arange(len(system.observed))
    largest = np.argmax(np.where(system.observed, np.abs(final.acceleration / SCALE), -1.0), axis=1)
    phasors = Phasors(
        frequency_hz=system.observations[0].phasors.frequency_hz,
        value=np.where(system.observed, final.acceleration, complex(np.nan, np.nan)),
        covariance=uncertainty.covariance,
        channels=MOTION_COMPONENTS,
        unit=component_units(2),
        dof=uncertainty.dof()[lines, largest],
    )
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
        unseen=system.unseen,
    )
    return replace(result, notices=_notices(result, bool(stated), failed))


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
    scatter = estimate_scatter(system, first) if scatter is None else scatter
    parts = scatter_covariances(system, first.acceleration, scatter)
    final = solve(system, np.sum([p.covariance for p in parts], axis=0)) if parts else first
    birge, beside = 1.0, None
    unknowns = estimates(system.common, final)
    if contradicts(final, unknowns):
        beside = undetected_errors(system, final, unknowns, INCONSISTENCY)
        failing = failing_lines(system, final)
        parts.append(disagreement(system, final, failing or range(len(system.observed)), INCONSISTENCY))
        final = solve(system, np.sum([p.covariance for p in parts], axis=0))
        birge = final.chi2 / final.dof if not failing and fails(final.chi2, final.dof) else 1.0
    return Solved(first, final, scatter, tuple(parts), birge, beside)


def fuse_sources(
    observations: Sequence[Observation], body: str, unseen: UnseenMotion | None = None
) -> tuple[Acceleration, ...]:
    """Return the fused acceleration of `body`, then that of each kind of instrument alone where it determines any.

    The scatter of an instrument is estimated once, so that no source claims more of it than another.
    """
    own = [observation for observation in observations if observation.body == body]
    fused = fuse(own, body, unseen=unseen)
    accelerations = [fused]
    for source in SINGLE_SOURCES:
        alone = [observation for observation in own if observation.kind == source]
        if alone:
            used = any(observation.title in fused.instruments for observation in alone)
            same = len(alone) == len(own)
            result = (
                replace(fused, source=source)
                if same
                else fuse(alone, body, source, fused.scatter if used else None, unseen)
            )
            if np.any(result.observed):
                accelerations.append(result)
    return tuple(accelerations)


def _uncertainty(system: System, solved: Solved) -> Uncertainty:
    """Split gain · V · gain^T of every line into noise per instrument, discrepancies and common errors."""
    solution, lines = solved.final, len(system.observed)
    hidden = ~np.tile(system.observed, (1, 2))
    gain = solution.gain.reshape(lines, 12, -1)

    def carried(covariance: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        return np.asarray(gain[:, :, rows] @ covariance @ gain[:, :, rows].swapaxes(1, 2))

    noise = solution.noise - solution.hidden
    parts = []
    for part in solved.parts:
        noise = noise - part.covariance
        parts.append(Contribution(part.label, "A", carried(part.covariance), part.dof))
    if solved.beside is not None:
        allowed = np.sum([part.covariance for part in parts], axis=0)
        missing = not_allowed_for(carried(solved.beside.covariance), allowed)
        parts.append(Contribution(solved.beside.label, "A", missing, solved.beside.dof))
    for place, observation in enumerate(system.observations):
        rows = np.flatnonzero(system.observation == place)
        dof = np.nan_to_num(observation.phasors.dof, nan=np.inf, posinf=np.inf)
        own = carried(noise[np.ix_(rows, rows)], rows)
        parts.append(Contribution(f"{observation.title}: noise", "A", own, dof))
    if np.any(solution.hidden > 0.0):
        parts.append(Contribution(UNOBSERVED, "B", carried(solution.hidden)))
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
    return Uncertainty(merge_contributions(random), tuple(influences))


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


def _notices(result: Acceleration, stated: bool, contradicted: Sequence[CommonEstimate] | None) -> tuple[Notice, ...]:
    """Return the notices of an estimate.

    `stated`: some instrument states a systematic uncertainty; `contradicted`: the unknowns as they come out of what is
    stated, where the readings contradict that.
    """
    notices = []
    titles = ", ".join(result.instruments)
    for pattern in [] if np.all(result.observed) else np.unique(~result.observed, axis=0):
        if np.any(pattern):
            lines = int(np.sum(np.all(result.observed == ~pattern, axis=1)))
            missing = ", ".join(name for name, hidden in zip(MOTION_COMPONENTS, pattern, strict=True) if hidden)
            text = (
                f"{missing} of the {result.body} cannot be told from the readings of {titles} at {lines} of "
                f"{len(result.observed)} lines: too few points, directions or usable lines; no values are given"
            )
            notices.append(Notice("info", text, result.body))
    if not stated:
        text = f"no instrument ({titles}) states a systematic uncertainty: U contains noise only"
        notices.append(Notice("warning", text, result.body))
    for test in (test for test in result.consistency if not test.used):
        text = (
            "states no systematic uncertainty and was compared, not fused: "
            f"{test.normalised_deviation:.2g} times its standard uncertainty from the others, reading/prediction "
            f"{abs(test.ratio):.5g} at {np.angle(test.ratio):.5f} rad"
        )
        notices.append(Notice("info", text, test.instrument))
    if contradicted is not None:
        notices.append(_disagreement(result, contradicted))
    for scatter in result.scatter:
        line = int(np.argmax(np.hypot(scatter.amplitude, scatter.phase)))
        text = (
            "its readings scatter beyond what is stated of them: by "
            f"{scatter.amplitude[line]:.2g} of the motion in amplitude and {scatter.phase[line]:.2g} rad in phase at "
            f"{result.phasors.frequency_hz[line]:.6g} Hz; this scatter is in U"
        )
        notices.append(Notice("warning", text, scatter.instrument))
    rows = untested(result) if result.source == "fused" and stated else ()
    if rows:
        listed = ", ".join(f"{row.name} ({row.share:.0%} of the variance of {row.component})" for row in rows)
        text = f"not tested by these data, in U as stated: {listed}"
        notices.append(Notice("info", text, result.body))
    return tuple(notices)


def _disagreement(result: Acceleration, unknowns: Sequence[CommonEstimate]) -> Notice:
    """Name who deviates from the others, and which stated unknown would explain it."""
    chi2 = f"chi-square {result.chi2:.3g} for {result.dof} degrees of freedom"
    text = f"the instruments of the {result.body} disagree ({chi2})"
    used = [test for test in result.consistency if test.used and np.isfinite(test.normalised_deviation)]
    used = sorted(used, key=lambda test: -test.normalised_deviation)
    suspects = [test for test in used if test.suspect]
    for test in suspects or used[:1]:
        text += f"; {test.instrument} lies {test.normalised_deviation:.3g} standard uncertainties from the others"
        if np.isfinite(test.ratio):
            text += f", reading/prediction {abs(test.ratio):.5g} at {np.angle(test.ratio):.5f} rad"
    if suspects:
        text += "; without it all others agree" if len(suspects) == 1 else "; without any one of these the others agree"
    # Of the stated unknowns those that deviate most, those that the readings cannot tell apart included.
    tested = [unknown for unknown in unknowns if abs(unknown.deviation) > NOTABLE_DEVIATION]
    largest = max((abs(unknown.deviation) for unknown in tested), default=0.0)
    close = [unknown for unknown in tested if abs(unknown.deviation) >= EQUALLY_LIKELY * largest]
    for unknown in sorted(close, key=lambda unknown: -abs(unknown.deviation)):
        unit = "" if unknown.unit == "1" else f" {unknown.unit}"
        text += (
            f"; {unknown.name} would have to be {unknown.wanted:.2g}{unit} "
            f"({abs(unknown.wanted) / unknown.u:.3g} times its standard uncertainty)"
        )
    return Notice("warning", text + "; U was enlarged to cover the disagreement", result.body)
