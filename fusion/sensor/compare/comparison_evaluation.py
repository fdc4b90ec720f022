"""Evaluation of a comparison: groups of values, their reference value, E_n and drift."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date as Date
from itertools import combinations, pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import InputError
from fusion.recording.dsi import parse_unit, same_dimension
from fusion.sensor import result_notices as declared
from fusion.sensor.compare.comparison_inputs import ComparedResult, ComparedValue, year_of
from fusion.sensor.compare.consistency import (
    MAX_RESULTS,
    ReferenceValue,
    SharedInput,
    complex_normalised_error,
    covariance_of,
    drift,
    find_contradictory_claims,
    find_possible_shared_inputs,
    find_shared_inputs,
    normalised_error,
    reference_value,
    select_acting_inputs,
    weighted_mean,
)
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice


@dataclass(frozen=True)
class ComparedQuantity:
    """Magnitude or phase of an element at one frequency, of the results `names`.

    Attributes
    ----------
    covariance : (N, N), of the values.
    shared, effects : the S inputs that correlate the values, and their effects (S, N) for one u.
    normalised : (N, N), E_n of every pair.
    complex_normalised : (N, N), of magnitudes: E_n of magnitude and phase together, NaN without a phase.
    opposite_sign : names of the results whose sign was changed (180°), because it is opposite at all frequencies.
    year : (N,), date of each value, NaN if not stated.
    per_year, u_per_year : drift, None if a date is not stated.
    """

    frequency_hz: float
    channel: str
    component: str
    quantity: str
    unit: str
    names: tuple[str, ...]
    opposite_sign: tuple[str, ...]
    value: FloatArray
    u: FloatArray
    covariance: FloatArray
    shared: tuple[SharedInput, ...]
    effects: FloatArray
    reference: ReferenceValue
    normalised: FloatArray
    complex_normalised: FloatArray | None
    year: FloatArray
    per_year: float | None
    u_per_year: float | None

    @property
    def largest(self) -> float:
        """Return the largest |E_n| of all pairs."""
        return float(np.abs(self.normalised).max())

    @property
    def centre(self) -> float:
        """Return the reference value, or the weighted mean of all results if they are inconsistent."""
        used = bool(self.reference.used.any())
        return self.reference.value if used else weighted_mean(self.value, self.covariance)[0]


@dataclass(frozen=True)
class ComparisonEvaluation(CommandEvaluation):
    """A comparison: the compared quantities, and values without a partner."""

    results: tuple[ComparedResult, ...]
    shared: tuple[SharedInput, ...]
    quantities: tuple[ComparedQuantity, ...]
    unmatched: tuple[tuple[str, ComparedValue], ...]


def evaluate_comparison(
    results: Sequence[ComparedResult], dates: Mapping[str, Date], tolerance: float, hashes: dict[str, str]
) -> ComparisonEvaluation:
    """Compare results by name; frequencies match within the relative `tolerance` of the lowest.

    Results are independent except for shared inputs with evidence (`find_shared_inputs`). Raises `InputError` if no
    value can be compared, or if units differ.
    """
    begun = time.perf_counter()
    if not 2 <= len(results) <= MAX_RESULTS:
        raise InputError(declared.WRONG_RESULT_COUNT, results[0].file, found=len(results), limit=MAX_RESULTS)
    shared = find_shared_inputs(results)
    groups = list(_groups(results, tolerance))
    unmatched = [entry for entries in groups if len(entries) < 2 for entry in entries]
    matched = [_in_one_unit(entries, results) for entries in groups if len(entries) > 1]
    compared = [one for group in matched for one in _both_quantities(group, dates, shared, {})]
    conventions = list(opposite_conventions(compared))
    opposite_sign = opposite_signs(compared, [result.name for result in results])
    if opposite_sign:
        compared = [one for group in matched for one in _both_quantities(group, dates, shared, opposite_sign)]
    if not compared:
        kinds = "; ".join(f"{channel} per {other}" for channel, other, *_ in _different_kinds(unmatched, tolerance))
        if kinds:
            raise InputError(
                declared.ONLY_DIFFERENT_KINDS, results[1].file, "frequency_hz", tolerance=tolerance, kinds=kinds
            )
        raise InputError(declared.NO_COMMON_VALUE, results[1].file, "frequency_hz", tolerance=tolerance)
    acting = [item for found in compared for item in found.shared]
    return ComparisonEvaluation(
        name=f"Comparison of {', '.join(result.name for result in results)}",
        notices=(
            *_notices(results, unmatched, shared, acting=bool(acting)),
            *_about_kinds(results, unmatched, tolerance),
            *conventions,
        ),
        settings={"tolerance": tolerance} | {f"date of {name}": str(day) for name, day in dates.items()},
        input_hashes=hashes,
        duration_s=time.perf_counter() - begun,
        results=tuple(results),
        shared=tuple(item for item in shared if item in acting),
        quantities=tuple(compared),
        unmatched=tuple(unmatched),
    )


def _groups(results: Sequence[ComparedResult], tolerance: float) -> list[list[tuple[str, ComparedValue]]]:
    """Return values of the same element and frequency, at most one of each result."""
    entries = [(result.name, value) for result in results for value in result.values]
    entries.sort(key=lambda entry: (entry[1].channel, entry[1].component, entry[1].ratio, entry[1].frequency_hz))
    groups: list[list[tuple[str, ComparedValue]]] = []
    for name, value in entries:
        last = groups[-1] if groups else []
        first = last[0][1] if last else None
        if (
            first is not None
            and (first.channel, first.component, first.ratio) == (value.channel, value.component, value.ratio)
            and value.frequency_hz - first.frequency_hz <= tolerance * first.frequency_hz
            and name not in {used for used, _ in last}
        ):
            last.append((name, value))
        else:
            groups.append([(name, value)])
    return groups


def _in_one_unit(
    group: list[tuple[str, ComparedValue]], results: Sequence[ComparedResult]
) -> list[tuple[str, ComparedValue]]:
    """Return values in one unit; raise `InputError` for one that does not convert."""
    units = {value.unit for _, value in group}
    if len(units) == 1:
        return group
    unit = next((value.unit for _, value in group if not value.unit.startswith("\\")), group[0][1].unit)
    converted = []
    for name, value in group:
        if not same_dimension(value.unit, unit):
            file = next(result.file for result in results if result.name == name)
            raise InputError(declared.UNIT_NOT_CONVERTIBLE, file, "unit", found=value.unit, expected=unit)
        factor = 1.0 if value.unit == unit else parse_unit(value.unit).factor / parse_unit(unit).factor
        size, u = factor * value.magnitude, factor * value.u_magnitude
        converted.append((name, replace(value, unit=unit, magnitude=size, u_magnitude=u)))
    return converted


OppositeSigns: TypeAlias = Mapping[tuple[str, str], frozenset[str]]
"""Results whose sign is opposite to that of the first result, by channel and component."""


def _both_quantities(
    group: Sequence[tuple[str, ComparedValue]],
    dates: Mapping[str, Date],
    shared: Sequence[SharedInput],
    opposite_sign: OppositeSigns,
) -> Iterator[ComparedQuantity]:
    """Yield magnitude and, where two results have one, phase of one element at one frequency."""
    names = opposite_sign.get((group[0][1].channel, group[0][1].component), frozenset())
    group = [
        (name, replace(value, phase_rad=value.phase_rad - np.pi))
        if name in names and value.phase_rad is not None
        else (name, value)
        for name, value in group
    ]
    yield _compared(group, "magnitude", dates, shared, names)
    with_phase = [entry for entry in group if entry[1].phase_rad is not None]
    if len(with_phase) > 1:
        yield _compared(with_phase, "phase", dates, shared, names)


def _compared(
    group: Sequence[tuple[str, ComparedValue]],
    quantity: str,
    dates: Mapping[str, Date],
    shared: Sequence[SharedInput],
    opposite_sign: frozenset[str],
) -> ComparedQuantity:
    """Return reference value, E_n and drift of one quantity; phases are unwrapped."""
    names, values = tuple(name for name, _ in group), [value for _, value in group]
    if quantity == "magnitude":
        value, u = np.array([v.magnitude for v in values]), np.array([v.u_magnitude for v in values])
    else:
        phase = np.array([v.phase_rad for v in values], dtype=np.float64)
        value = phase[0] + np.angle(np.exp(1j * (phase - phase[0])))
        u = np.array([v.u_phase_rad for v in values])
    column, size = (0, value) if quantity == "magnitude" else (1, None)
    every = select_acting_inputs(group, shared)
    acting = [(item, effect) for item, effect in every if np.count_nonzero(effect[:, column]) > 1]
    relative = np.array([effect[:, column] for _, effect in acting]).reshape(-1, len(u))
    (covariance, effects), change = covariance_of(relative, u, size), None
    year = np.array([year_of(dates[name]) if name in dates else v.year for name, v in group])
    if np.isfinite(year).all() and len(np.unique(year)) > 1:
        change = drift(year, value, covariance)
    return ComparedQuantity(
        frequency_hz=float(np.mean([v.frequency_hz for v in values])),
        channel=values[0].channel,
        component=values[0].component,
        quantity=quantity,
        unit=values[0].unit if quantity == "magnitude" else "rad",
        names=names,
        opposite_sign=tuple(name for name in names if name in opposite_sign),
        value=value,
        u=u,
        covariance=covariance,
        shared=tuple(item for item, _ in acting),
        effects=effects,
        reference=reference_value(value, covariance),
        normalised=normalised_error(value, covariance),
        complex_normalised=_complex_errors(values, every) if quantity == "magnitude" else None,
        year=year,
        per_year=None if change is None else change[0],
        u_per_year=None if change is None else change[1],
    )


def _complex_errors(values: Sequence[ComparedValue], acting: Sequence[tuple[SharedInput, FloatArray]]) -> FloatArray:
    """Return E_n (N, N) of the complex values, NaN where one has no phase."""
    phase = np.array([np.nan if v.phase_rad is None else v.phase_rad for v in values])
    size, u_size = np.array([v.magnitude for v in values]), np.array([v.u_magnitude for v in values])
    u_phase, effects = np.array([v.u_phase_rad for v in values]), [effect for _, effect in acting]
    return complex_normalised_error(size * np.exp(1j * phase), u_size, u_phase, effects)


def _notices(
    results: Sequence[ComparedResult],
    unmatched: Sequence[tuple[str, ComparedValue]],
    shared: Sequence[SharedInput],
    *,
    acting: bool,
) -> list[Notice]:
    """Return the notices of the comparison."""
    independence = declared.RESULTS_SHARE_INPUTS if acting else declared.RESULTS_INDEPENDENT
    found = [*(notice for result in results for notice in result.notices), Notice(independence, "comparison")]
    for one, other in combinations(results, 2):
        names = {"first": one.name, "second": other.name}
        contradictory = dict.fromkeys(find_contradictory_claims(one, other, shared))
        if contradictory:
            found.append(Notice(declared.CONTRADICTORY_CLAIMS, "comparison", **names, inputs=", ".join(contradictory)))
        possible = list(find_possible_shared_inputs(one, other))
        if possible:
            found.append(Notice(declared.POSSIBLY_SHARED, "comparison", **names, inputs=", ".join(possible)))
        if Path(one.file).resolve() == Path(other.file).resolve():
            found.append(Notice(declared.SAME_FILE, "comparison", **names))
    if unmatched:
        found.append(Notice(declared.UNMATCHED_VALUES, "comparison", count=len(unmatched)))
    return found


def _about_kinds(
    results: Sequence[ComparedResult], unmatched: Sequence[tuple[str, ComparedValue]], tolerance: float
) -> Iterator[Notice]:
    """Yield notices on ratios, which contain the effect of other loads."""
    if any(value.ratio for result in results for value in result.values):
        counts = ", ".join(f"{result.responses} of {result.name}" for result in results if result.responses)
        if counts:
            yield Notice(declared.RESPONSES_LEFT_OUT, "comparison", counts=counts)
        else:
            yield Notice(declared.RATIOS_COMPARED, "comparison")
    for channel, component, ratios, elements in _different_kinds(unmatched, tolerance):
        yield Notice(
            declared.KINDS_NOT_COMPARED,
            "comparison",
            channel=channel,
            component=component,
            ratios=", ".join(ratios),
            elements=", ".join(elements),
        )


def _different_kinds(
    unmatched: Sequence[tuple[str, ComparedValue]], tolerance: float
) -> Iterator[tuple[str, str, list[str], list[str]]]:
    """Yield channel, component, results with ratios, and results with elements of the sensor."""
    named: dict[tuple[str, str], list[tuple[float, bool, str]]] = {}
    for name, value in unmatched:
        named.setdefault((value.channel, value.component), []).append((value.frequency_hz, value.ratio, name))
    for (channel, component), entries in named.items():
        entries.sort()
        pairs = [
            (first, other)
            for first, other in pairwise(entries)
            if first[1] != other[1] and first[2] != other[2] and other[0] - first[0] <= tolerance * first[0]
        ]
        if pairs:
            ratios = dict.fromkeys(entry[2] for pair in pairs for entry in pair if entry[1])
            others = dict.fromkeys(entry[2] for pair in pairs for entry in pair if not entry[1])
            yield channel, component, list(ratios), list(others)


CONVENTION_RAD = 0.2
"""Tolerance of a difference of phases from 180°, or of a sum of phases from 0: chosen, far above any U."""


def _pairs_of_phases(
    compared: Sequence[ComparedQuantity],
) -> dict[tuple[str, str, str, str], list[tuple[float, float, float]]]:
    """Return difference and sum of the phases (rad), and E_n, of every pair of results."""
    found: dict[tuple[str, str, str, str], list[tuple[float, float, float]]] = {}
    for phases in (one for one in compared if one.quantity == "phase"):
        for i, j in combinations(range(len(phases.names)), 2):
            one, other = sorted((phases.names[i], phases.names[j]))
            difference = float(np.angle(np.exp(1j * (phases.value[i] - phases.value[j]))))
            mirrored = float(np.angle(np.exp(1j * (phases.value[i] + phases.value[j]))))
            key = phases.channel, phases.component, one, other
            found.setdefault(key, []).append((difference, mirrored, float(phases.normalised[i, j])))
    return found


def _differ_by_half_a_turn(rows: Sequence[tuple[float, float, float]]) -> bool:
    """Whether phases contradict each other by 180° at every frequency."""
    difference, _, normalised = np.abs(np.array(rows)).T
    return bool(np.any(normalised > 1.0) and np.all(difference > np.pi - CONVENTION_RAD))


def opposite_signs(compared: Sequence[ComparedQuantity], names: Sequence[str]) -> OppositeSigns:
    """Return the results whose sign is opposite to that of the first result."""
    opposite_sign: dict[tuple[str, str], frozenset[str]] = {}
    pairs = _pairs_of_phases(compared)
    for channel, component in dict.fromkeys(key[:2] for key in pairs):
        of_element = {key[2:]: rows for key, rows in pairs.items() if key[:2] == (channel, component)}
        present = [name for name in names if any(name in pair for pair in of_element)]
        opposite = [
            name
            for name in present[1:]
            if (rows := of_element.get((min(present[0], name), max(present[0], name)))) and _differ_by_half_a_turn(rows)
        ]
        if opposite:
            opposite_sign[channel, component] = frozenset(opposite)
    return opposite_sign


def opposite_conventions(compared: Sequence[ComparedQuantity]) -> Iterator[Notice]:
    """Yield notices of phases that differ by 180° or by sign at all frequencies.

    Only contradictions (|E_n| above 1) count, and opposite signs only if the phase is several times its deviation.
    """
    for (channel, component, one, other), rows in _pairs_of_phases(compared).items():
        difference, mirrored, normalised = np.abs(np.array(rows)).T
        values = {"channel": channel, "component": component, "first": one, "second": other}
        if _differ_by_half_a_turn(rows):
            yield Notice(declared.PHASES_DIFFER_BY_180, "comparison", **values)
        elif np.all(normalised > 1.0) and np.all(mirrored < np.minimum(CONVENTION_RAD, difference / 4.0)):
            yield Notice(declared.PHASES_OPPOSITE, "comparison", **values)
