"""Generalised least squares of all instruments of a body: its six-component acceleration, and whether they agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusion.body import COMPONENTS
from fusion.consistency import Consistency, compare, discrepancy, fails, leave_one_out
from fusion.estimate import SCALE, Solution, System, build_system, solve
from fusion.notices import AnyNotice, Notice
from fusion.observe import Observation
from shaker.signals.phasor import Phasors

__all__ = ["Acceleration", "Consistency", "Contribution", "Source", "fuse", "fuse_sources"]

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]
SINGLE_SOURCES: tuple[Source, ...] = ("photogrammetry", "vibrometer", "accelerometer")
UNITS = ("m/s^2",) * 3 + ("rad/s^2",) * 3
INCONSISTENCY = "inconsistency of instruments"
UNOBSERVED = "unobserved motion"


@dataclass(frozen=True)
class Contribution:
    """One entry of an uncertainty budget: `covariance` (K, 12, 12) of [6 Re, 6 Im], NaN where unobserved."""

    label: str
    type: Literal["A", "B"]
    covariance: FloatArray


@dataclass(frozen=True)
class Acceleration:
    """Six-component acceleration phasors of one body at the sensor origin.

    `phasors` (K, 6) in m/s^2 and rad/s^2, NaN where not `observed` (K, 6). `contributions` add up to the covariance.
    The common errors (E of them): `common` names, `common_estimate` (E,) in standard uncertainties, and
    `common_influence` (E, K, 12), what one standard uncertainty of each does to the estimate in all lines at once.
    """

    body: str
    source: Source
    phasors: Phasors
    observed: BoolArray
    instruments: tuple[str, ...]
    contributions: tuple[Contribution, ...]
    consistency: tuple[Consistency, ...]
    chi2: float
    dof: int
    common: tuple[str, ...]
    common_estimate: FloatArray
    common_influence: FloatArray
    notices: tuple[AnyNotice, ...]


def fuse(observations: Sequence[Observation], body: str = "load", source: Source = "fused") -> Acceleration:
    """Estimate the acceleration of `body` from all its instruments, jointly over all lines.

    Instruments without any stated systematic uncertainty are compared with the result, not used, unless there are no
    others. A component is observed only if the readings of its line determine it by themselves: neither a prior nor an
    assumption about other components enters. If chi-square fails at 1 %, a discrepancy common to the readings of each
    failing line is added before the estimate is repeated, and what then remains enlarges U by the Birge ratio.
    """
    own = [observation for observation in observations if observation.body == body]
    if not own:
        raise ValueError(f"observations: expected at least one of body {body}, found none")
    stated = [observation for observation in own if observation.stated]
    system = build_system(stated or own)
    first = solve(system)
    tests = leave_one_out(system, first)
    failed = fails(first.chi2, first.dof)
    final, contributions = _enlarged(system, first) if failed else (first, _contributions(system, first))
    phasors = _phasors(system, final, contributions)
    for observation in own if stated else ():
        if not observation.stated:
            tests += compare(observation, phasors.value, phasors.covariance)
    hidden = ~np.tile(system.observed, (1, 2))
    influence = (final.gain @ final.effects).T.reshape(len(system.names), len(hidden), 12)
    return Acceleration(
        body=body,
        source=source,
        phasors=phasors,
        observed=system.observed,
        instruments=tuple(_title(observation) for observation in system.observations),
        contributions=tuple(Contribution(c.label, c.type, _hide(c.covariance, hidden)) for c in contributions),
        consistency=tests,
        chi2=first.chi2,
        dof=first.dof,
        common=system.names,
        common_estimate=final.errors,
        common_influence=np.where(hidden, np.nan, influence),
        notices=_notices(body, system, bool(stated), tests, first if failed else None),
    )


def _enlarged(system: System, first: Solution) -> tuple[Solution, list[Contribution]]:
    """Repeat an estimate that failed its test with a discrepancy in the failing lines, and enlarge what still fails."""
    extra = discrepancy(system, first)
    final = solve(system, extra)
    contributions = _contributions(system, final, extra)
    if fails(final.chi2, final.dof):
        total = np.sum([entry.covariance for entry in contributions], axis=0)
        birge = Contribution(INCONSISTENCY, "A", (final.chi2 / final.dof - 1.0) * total)
        contributions = _merge([*contributions, birge])
    return final, contributions


def _phasors(system: System, solution: Solution, contributions: Sequence[Contribution]) -> Phasors:
    """Estimate with its whole covariance, NaN where not observed."""
    hidden = ~np.tile(system.observed, (1, 2))
    return Phasors(
        frequency_hz=system.observations[0].phasors.frequency_hz,
        value=np.where(system.observed, solution.acceleration, complex(np.nan, np.nan)),
        covariance=_hide(np.sum([entry.covariance for entry in contributions], axis=0), hidden),
        channels=COMPONENTS,
        unit=UNITS,
        dof=_effective_dof(system, solution, contributions),
    )


def fuse_sources(observations: Sequence[Observation], body: str) -> tuple[Acceleration, ...]:
    """Return the fused acceleration of `body`, then that of each kind of instrument alone where it determines any."""
    own = [observation for observation in observations if observation.body == body]
    found = [fuse(own, body)]
    for source in SINGLE_SOURCES:
        alone = [observation for observation in own if observation.kind == source]
        if alone:
            result = fuse(alone, body, source)
            if np.any(result.observed):
                found.append(result)
    return tuple(found)


def _title(observation: Observation) -> str:
    """Name of an instrument as it stands in budgets."""
    return f"stereo {observation.name}" if observation.kind == "photogrammetry" else observation.name


def _hide(covariance: FloatArray, hidden: BoolArray) -> FloatArray:
    """NaN in the rows and columns of components that are not observed."""
    return np.where(hidden[:, :, None] | hidden[:, None, :], np.nan, covariance)


def _contributions(system: System, solution: Solution, extra: FloatArray | None = None) -> list[Contribution]:
    """Split gain · V · gain^T of every line into noise per instrument, labelled common errors and discrepancy."""
    extra = np.zeros(len(system.readings)) if extra is None else extra
    lines = len(system.observed)
    gain = solution.gain.reshape(lines, 12, -1)
    noise = solution.noise - np.diag(extra**2 + solution.hidden)
    found = []
    for place, observation in enumerate(system.observations):
        rows = np.flatnonzero(system.observation == place)
        part = gain[:, :, rows]
        covariance = part @ noise[np.ix_(rows, rows)] @ part.swapaxes(1, 2)
        found.append(Contribution(f"{_title(observation)}: noise", "A", covariance))
    influence = gain @ solution.effects
    for place, label in enumerate(system.labels):
        column = influence[:, :, place]
        found.append(Contribution(label, "B", column[:, :, None] * column[:, None, :]))
    if np.any(solution.hidden > 0.0):
        found.append(Contribution(UNOBSERVED, "B", (gain * solution.hidden) @ gain.swapaxes(1, 2)))
    if np.any(extra > 0.0):
        found.append(Contribution(INCONSISTENCY, "A", (gain * extra**2) @ gain.swapaxes(1, 2)))
    return _merge(found)


def _merge(entries: Sequence[Contribution]) -> list[Contribution]:
    """Add up entries of equal label, in the order of their first appearance."""
    merged: dict[str, Contribution] = {}
    for entry in entries:
        known = merged.get(entry.label)
        total = entry.covariance if known is None else known.covariance + entry.covariance
        merged[entry.label] = Contribution(entry.label, entry.type, total)
    return list(merged.values())


def _effective_dof(system: System, solution: Solution, contributions: Sequence[Contribution]) -> FloatArray:
    """Welch-Satterthwaite degrees of freedom (K,) of the largest component of each line (JCGM 100, G.4.1)."""
    dof = {f"{_title(o)}: noise": o.phasors.dof for o in system.observations}
    lines = len(system.observed)
    component = np.argmax(np.abs(solution.acceleration / SCALE), axis=1)
    weighted, total = np.zeros(lines), np.zeros(lines)
    for entry in contributions:
        variance = entry.covariance.diagonal(axis1=1, axis2=2).reshape(lines, 2, 6).sum(axis=1)
        own = variance[np.arange(lines), component]
        fallback = np.full(lines, max(solution.dof / lines, 1.0) if entry.label == INCONSISTENCY else np.inf)
        freedom = np.nan_to_num(dof.get(entry.label, fallback), nan=np.inf, posinf=np.inf)
        weighted += own**2 / np.maximum(freedom, 1.0)
        total += own
    return np.asarray(np.divide(total**2, weighted, out=np.full(lines, np.inf), where=weighted > 0.0))


def _notices(
    body: str, system: System, stated: bool, tests: Sequence[Consistency], failed: Solution | None
) -> tuple[Notice, ...]:
    """What a user has to know about an estimate."""
    found = []
    titles = ", ".join(_title(observation) for observation in system.observations)
    for pattern in np.unique(~system.observed, axis=0):
        lines = int(np.sum(np.all(system.observed == ~pattern, axis=1)))
        if np.any(pattern):
            missing = ", ".join(name for name, hidden in zip(COMPONENTS, pattern, strict=True) if hidden)
            text = (
                f"{missing} of the {body} cannot be told from the readings of {titles} at {lines} of "
                f"{len(system.observed)} lines: too few points, directions or usable lines; no values are given"
            )
            found.append(Notice("info", text, body))
    if not stated:
        text = f"no instrument ({titles}) states a systematic uncertainty: U contains noise only"
        found.append(Notice("warning", text, body))
    for test in (t for t in tests if not t.used):
        text = (
            "states no systematic uncertainty and was compared, not fused: "
            f"{test.normalised_deviation:.2g} times its standard uncertainty from the others, reading/prediction "
            f"{abs(test.ratio):.5g} at {np.angle(test.ratio):.5f} rad"
        )
        found.append(Notice("info", text, test.instrument))
    if failed is not None:
        found.append(_disagreement(body, tests, failed))
    return tuple(found)


def _disagreement(body: str, tests: Sequence[Consistency], failed: Solution) -> Notice:
    """Name the instrument that deviates most from the others."""
    testable = [test for test in tests if test.used and np.isfinite(test.normalised_deviation)]
    text = f"the instruments of the {body} disagree (chi-square {failed.chi2:.3g} for {failed.dof} degrees of freedom)"
    if testable:
        worst = max(testable, key=lambda test: test.normalised_deviation)
        text += f"; {worst.instrument} lies {worst.normalised_deviation:.2g} standard uncertainties from the others"
        if np.isfinite(worst.ratio):
            text += f", reading/prediction {abs(worst.ratio):.5g} at {np.angle(worst.ratio):.5f} rad"
    return Notice("warning", text + "; U was enlarged to cover the disagreement", body)
