"""Generalised least squares of all instruments of a body: its six-component acceleration, and whether they agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusion.body import COMPONENTS
from fusion.consistency import Consistency, compare, discrepancy, fails, leave_one_out
from fusion.estimate import SCALE, Solution, System, build_system, solve
from fusion.notices import AnyNotice, Notice
from fusion.observe import Observation
from fusion.uncertainty import Contribution, Influence, Uncertainty, merge_contributions
from shaker.signals.phasor import Phasors

__all__ = ["Acceleration", "CommonEstimate", "Consistency", "Contribution", "Source", "fuse", "fuse_sources"]

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

Source = Literal["fused", "photogrammetry", "vibrometer", "accelerometer"]
SINGLE_SOURCES: tuple[Source, ...] = ("photogrammetry", "vibrometer", "accelerometer")
UNITS = ("m/s^2",) * 3 + ("rad/s^2",) * 3
INCONSISTENCY = "inconsistency of instruments"
UNOBSERVED = "unobserved motion"


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


@dataclass(frozen=True)
class Acceleration:
    """Six-component acceleration phasors of one body at the sensor origin.

    `phasors` (K, 6) in m/s^2 and rad/s^2, NaN where not `observed` (K, 6). `uncertainty` of the six components, NaN
    where not observed: noise of every instrument and the common errors, which act on all lines at once. `unknowns`:
    what the data say of those.
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

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """Return the budget: one contribution per label; they add up to the covariance of the phasors."""
        return self.uncertainty.grouped()


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
    extra = discrepancy(system, first) if failed else np.zeros(len(system.readings))
    final = solve(system, np.diag(extra**2)) if failed else first
    uncertainty = _uncertainty(system, final, extra)
    phasors = _phasors(system, final, uncertainty)
    for observation in own if stated else ():
        if not observation.stated:
            tests += compare(observation, phasors.value, phasors.covariance)
    return Acceleration(
        body=body,
        source=source,
        phasors=phasors,
        observed=system.observed,
        instruments=tuple(_title(observation) for observation in system.observations),
        uncertainty=uncertainty,
        consistency=tests,
        chi2=first.chi2,
        dof=first.dof,
        unknowns=_unknowns(system, final),
        notices=_notices(body, system, bool(stated), tests, first if failed else None),
    )


def _unknowns(system: System, solution: Solution) -> tuple[CommonEstimate, ...]:
    """Every common error with its estimate."""
    found = zip(system.common, solution.errors.tolist(), solution.remaining.tolist(), strict=True)
    return tuple(CommonEstimate(c.name, c.label, c.u, c.unit, value, left) for c, value, left in found)


def _phasors(system: System, solution: Solution, uncertainty: Uncertainty) -> Phasors:
    """Estimate with its whole covariance, NaN where not observed; degrees of freedom of the largest component."""
    lines = np.arange(len(system.observed))
    component = np.argmax(np.where(system.observed, np.abs(solution.acceleration / SCALE), -1.0), axis=1)
    return Phasors(
        frequency_hz=system.observations[0].phasors.frequency_hz,
        value=np.where(system.observed, solution.acceleration, complex(np.nan, np.nan)),
        covariance=uncertainty.covariance,
        channels=COMPONENTS,
        unit=UNITS,
        dof=uncertainty.dof()[lines, component],
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


def _uncertainty(system: System, solution: Solution, extra: FloatArray) -> Uncertainty:
    """Split gain · V · gain^T of every line into noise per instrument, discrepancy and common errors."""
    lines = len(system.observed)
    hidden = ~np.tile(system.observed, (1, 2))
    gain = solution.gain.reshape(lines, 12, -1)
    noise = solution.noise - np.diag(extra**2 + solution.hidden)
    found = []
    for place, observation in enumerate(system.observations):
        rows = np.flatnonzero(system.observation == place)
        part = gain[:, :, rows]
        covariance = part @ noise[np.ix_(rows, rows)] @ part.swapaxes(1, 2)
        dof = np.nan_to_num(observation.phasors.dof, nan=np.inf, posinf=np.inf)
        found.append(Contribution(f"{_title(observation)}: noise", "A", covariance, dof))
    if np.any(solution.hidden > 0.0):
        found.append(Contribution(UNOBSERVED, "B", (gain * solution.hidden) @ gain.swapaxes(1, 2)))
    if np.any(extra > 0.0):
        dof = np.full(lines, max(solution.dof / lines, 1.0))
        found.append(Contribution(INCONSISTENCY, "A", (gain * extra**2) @ gain.swapaxes(1, 2), dof))
    if fails(solution.chi2, solution.dof):
        dof = np.full(lines, max(solution.dof / lines, 1.0))
        spread = solution.noise + solution.effects @ solution.effects.T
        birge = (solution.chi2 / solution.dof - 1.0) * gain @ spread @ gain.swapaxes(1, 2)
        found.append(Contribution(INCONSISTENCY, "A", birge, dof))
    effects = np.where(hidden[:, :, None], np.nan, gain @ solution.effects)
    influences = [
        Influence(c.name, c.label, c.u, c.unit, effects[:, :, place], c.scope, c.type)
        for place, c in enumerate(system.common)
    ]
    random = [replace(part, covariance=_hide(part.covariance, hidden)) for part in found]
    return Uncertainty(merge_contributions(random), tuple(influences))


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
