"""Notices of the fused acceleration: undetermined components, disagreement, scatter and undetected errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import round_to_uncertainty
from fusion.estimation.coverage import polar
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
from fusion.estimation.instrument_consistency import CommonEstimate, Consistency, likely_mistake
from fusion.estimation.least_squares import unmeasured_drive
from fusion.estimation.measurement_model import SCALE
from fusion.estimation.uncertainty import element_covariance
from shaker.labels import MOTION_COMPONENTS
from shakercal._common.notices import Notice, Value

if TYPE_CHECKING:
    from fusion.estimation.fuse import Acceleration, Unnoticed

EQUALLY_LIKELY = 0.95
"""Deviation over the largest one above which an unknown is an equally likely cause (chosen)."""
MOST_NAMED = 3
MISSED = 5.0
"""Largest undetected error of a channel that is examined, in its stated standard uncertainties (chosen)."""


def acceleration_notices(
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
    """Return the stated unknowns that explain a contradiction, else possible gross errors, as text."""

    def describe(unknown: CommonEstimate) -> str:
        unit = "" if unknown.unit == "1" else f" {unknown.unit}"
        factor = abs(unknown.unconstrained_value) / unknown.u
        return f"{unknown.name} of {unknown.unconstrained_value:.2g}{unit} ({factor:.3g} times its u)"

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
    at = f"{MOTION_COMPONENTS[c]} at {result.phasors.frequency_hz[line]:.6g} Hz"
    return f"{at} is {', '.join(listed)} (U, k = 2)"
