"""What an estimated acceleration wants the user to know: what is missing, who disagrees, what nothing tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.acceleration import Acceleration
from fusion.body import COMPONENTS
from fusion.consistency import CommonEstimate, Consistency
from fusion.discrepancy import Scatter
from fusion.doubt import NOTABLE_DEVIATION
from fusion.notices import Notice
from fusion.system import SCALE
from fusion.uncertainty import total_variance
from shaker._checks import FloatArray

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
                unknown.name, unknown.label, unknown.u, unknown.unit, COMPONENTS[c], float(share[c]), relative
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
            missing = ", ".join(name for name, hidden in zip(COMPONENTS, pattern, strict=True) if hidden)
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
