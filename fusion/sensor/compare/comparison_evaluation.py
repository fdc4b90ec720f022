"""Evaluation of a comparison: groups of values, their reference value, E_n and drift."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date as Date
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from fusion.base import CommandEvaluation
from fusion.errors import InputError
from fusion.recording.dsi import parse_unit, same_dimension
from fusion.sensor.compare.comparison_inputs import ComparedResult, ComparedValue, year_of
from fusion.sensor.compare.reference_value import (
    MAX_RESULTS,
    ReferenceValue,
    complex_normalised_error,
    drift,
    normalised_error,
    reference_value,
    weighted_mean,
)
from fusion.sensor.compare.shared_inputs import (
    SharedInput,
    covariance_of,
    find_contradictory_claims,
    find_possible_shared_inputs,
    find_shared_inputs,
    select_acting_inputs,
)
from shaker.arrays import FloatArray
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
    year : (N,), date of each value, NaN if not stated.
    per_year, u_per_year : drift, None if a date is not stated.
    """

    frequency_hz: float
    channel: str
    component: str
    quantity: str
    unit: str
    names: tuple[str, ...]
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
        found = "one result" if len(results) == 1 else f"{len(results)} results"
        raise InputError(results[0].file, "", found=found, expected=f"2 to {MAX_RESULTS} results to compare")
    shared = find_shared_inputs(results)
    compared: list[ComparedQuantity] = []
    alone: list[tuple[str, ComparedValue]] = []
    for own in _groups(results, tolerance):
        if len(own) < 2:
            alone += own
            continue
        group = _in_one_unit(own, results)
        compared.append(_compared(group, "magnitude", dates, shared))
        turned = [entry for entry in group if entry[1].phase_rad is not None]
        if len(turned) > 1:
            compared.append(_compared(turned, "phase", dates, shared))
    if not compared:
        expected = f"an element whose frequencies agree within {tolerance:g}, relative"
        kinds = "; ".join(_kinds_apart(alone, tolerance))
        found = f"nothing in common ({kinds})" if kinds else "nothing in common"
        raise InputError(results[1].file, "frequency_hz", found=found, expected=expected)
    acting = [item for found in compared for item in found.shared]
    return ComparisonEvaluation(
        name=f"Comparison of {', '.join(result.name for result in results)}",
        notices=(
            *_notices(results, alone, shared, acting=bool(acting)),
            *_about_kinds(results, alone, tolerance),
            *opposite_conventions(compared),
        ),
        settings={"tolerance": tolerance} | {f"date of {name}": str(day) for name, day in dates.items()},
        input_hashes=hashes,
        duration_s=time.perf_counter() - begun,
        results=tuple(results),
        shared=tuple(item for item in shared if item in acting),
        quantities=tuple(compared),
        unmatched=tuple(alone),
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
            and name not in {own for own, _ in last}
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
            raise InputError(file, "unit", found=value.unit, expected=f"a unit that converts into {unit}")
        factor = 1.0 if value.unit == unit else parse_unit(value.unit).factor / parse_unit(unit).factor
        size, u = factor * value.magnitude, factor * value.u_magnitude
        converted.append((name, replace(value, unit=unit, magnitude=size, u_magnitude=u)))
    return converted


def _compared(
    group: Sequence[tuple[str, ComparedValue]], quantity: str, dates: Mapping[str, Date], shared: Sequence[SharedInput]
) -> ComparedQuantity:
    """Return reference value, E_n and drift of one quantity.

    Phases are unwrapped relative to the first.
    """
    names, own = tuple(name for name, _ in group), [value for _, value in group]
    if quantity == "magnitude":
        value, u = np.array([v.magnitude for v in own]), np.array([v.u_magnitude for v in own])
    else:
        phase = np.array([v.phase_rad for v in own], dtype=np.float64)
        value = phase[0] + np.angle(np.exp(1j * (phase - phase[0])))
        u = np.array([v.u_phase_rad for v in own])
    column, size = (0, value) if quantity == "magnitude" else (1, None)
    every = select_acting_inputs(group, shared)
    acting = [(item, effect) for item, effect in every if np.count_nonzero(effect[:, column]) > 1]
    relative = np.array([effect[:, column] for _, effect in acting]).reshape(-1, len(u))
    (covariance, effects), change = covariance_of(relative, u, size), None
    year = np.array([year_of(dates[name]) if name in dates else v.year for name, v in group])
    if np.isfinite(year).all() and len(np.unique(year)) > 1:
        change = drift(year, value, covariance)
    return ComparedQuantity(
        frequency_hz=float(np.mean([v.frequency_hz for v in own])),
        channel=own[0].channel,
        component=own[0].component,
        quantity=quantity,
        unit=own[0].unit if quantity == "magnitude" else "rad",
        names=names,
        value=value,
        u=u,
        covariance=covariance,
        shared=tuple(item for item, _ in acting),
        effects=effects,
        reference=reference_value(value, covariance),
        normalised=normalised_error(value, covariance),
        complex_normalised=_of_both(own, every) if quantity == "magnitude" else None,
        year=year,
        per_year=None if change is None else change[0],
        u_per_year=None if change is None else change[1],
    )


def _of_both(own: Sequence[ComparedValue], acting: Sequence[tuple[SharedInput, FloatArray]]) -> FloatArray:
    """Return E_n (N, N) of the complex values, NaN where one has no phase."""
    phase = np.array([np.nan if v.phase_rad is None else v.phase_rad for v in own])
    size, u_size = np.array([v.magnitude for v in own]), np.array([v.u_magnitude for v in own])
    u_phase, effects = np.array([v.u_phase_rad for v in own]), [effect for _, effect in acting]
    return complex_normalised_error(size * np.exp(1j * phase), u_size, u_phase, effects)


def _notices(
    results: Sequence[ComparedResult],
    alone: Sequence[tuple[str, ComparedValue]],
    shared: Sequence[SharedInput],
    *,
    acting: bool,
) -> list[Notice]:
    """Return the notices of the comparison."""
    beside = ", but for the inputs that certificates or files show as shared" if acting else ""
    text = (
        f"results are taken as independent{beside}: what two share without saying so, such as the mass of the same "
        "load or the same accelerometer, cancels in their difference, so that E_n comes out too small"
    )
    found = [*(notice for result in results for notice in result.signed), Notice("note", text, "comparison")]
    for one, other in combinations(results, 2):
        apart = list(dict.fromkeys(find_contradictory_claims(one, other, shared)))
        if apart:
            both = f"{one.name} and {other.name} name the same certificate for {', '.join(apart)}"
            text = f"{both}, but state different values or U"
            found.append(Notice("warning", f"{text}: not taken as shared", "comparison"))
        alike = list(find_possible_shared_inputs(one, other))
        if alike:
            both = f"{one.name} and {other.name} both rest on {', '.join(alike)} with the same u"
            text = f"{both}, and name no certificate for it"
            found.append(Notice("note", f"{text}: taken as independent; a certificate would tell", "comparison"))
        if Path(one.file).resolve() == Path(other.file).resolve():
            found.append(Notice("warning", f"{one.name} and {other.name} are the same file", "comparison"))
    if alone:
        found.append(Notice("note", f"{len(alone)} values have no partner and are not compared", "comparison"))
    return found


def _about_kinds(
    results: Sequence[ComparedResult], alone: Sequence[tuple[str, ComparedValue]], tolerance: float
) -> Iterator[Notice]:
    """Yield notices on ratios, which contain the effect of other loads."""
    if any(value.ratio for result in results for value in result.values):
        text = "ratios of outputs and driven load are compared with ratios only: other loads act in each as they did"
        left = ", ".join(f"{result.responses} of {result.name}" for result in results if result.responses)
        if left:
            text += (
                "; those of outputs that do not belong to the driven load, which other loads dominate, are left out "
            )
            text += f"({left}); a stated matrix, or a campaign that spans it, makes elements of them"
        yield Notice("note", text, "comparison")
    for text in _kinds_apart(alone, tolerance):
        yield Notice("warning", f"{text}: not compared, since a ratio contains what other loads do", "comparison")


def _kinds_apart(alone: Sequence[tuple[str, ComparedValue]], tolerance: float) -> Iterator[str]:
    """Yield elements for which some results state elements of the sensor and others ratios."""
    named: dict[tuple[str, str], list[tuple[float, bool, str]]] = {}
    for name, value in alone:
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
            yield f"{channel} per {component}: {', '.join(ratios)} ratios, {', '.join(others)} elements of the sensor"


CONVENTION_RAD = 0.2
"""Deviation up to which a difference of phases is half a turn, or a sum of phases zero."""


def opposite_conventions(compared: Sequence[ComparedQuantity]) -> Iterator[Notice]:
    """Yield notices of phases that differ by 180° or by sign at all frequencies.

    Only contradictions (|E_n| above 1) count, and opposite signs only if the phase is several times its deviation.
    """
    found: dict[tuple[str, ...], list[tuple[float, float, float]]] = {}
    for own in (own for own in compared if own.quantity == "phase"):
        for i, j in combinations(range(len(own.names)), 2):
            key = own.channel, own.component, *sorted((own.names[i], own.names[j]))
            turned = float(np.angle(np.exp(1j * (own.value[i] - own.value[j]))))
            mirrored = float(np.angle(np.exp(1j * (own.value[i] + own.value[j]))))
            found.setdefault(key, []).append((turned, mirrored, float(own.normalised[i, j])))
    for (channel, component, one, other), rows in found.items():
        turned, mirrored, normalised = np.abs(np.array(rows)).T
        element = f"{channel} per {component}: the phases of {one} and {other}"
        if np.all(normalised <= 1.0):
            continue
        if np.all(turned > np.pi - CONVENTION_RAD):
            text = f"{element} differ by half a turn at every common frequency: is the sign of the output, or the "
            yield Notice(
                "warning", f"{text}sense of the load (sensor.sense), the other one in one of them?", "comparison"
            )
        elif np.all(normalised > 1.0) and np.all(mirrored < np.minimum(CONVENTION_RAD, turned / 4.0)):
            text = f"{element} have opposite signs at every common frequency: does one of them count a lag positive?"
            yield Notice("warning", text, "comparison")
