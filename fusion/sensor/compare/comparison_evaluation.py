"""Evaluation of a comparison: groups of values, their reference value, degrees of equivalence and drift."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
    SIGNIFICANCE,
    ReferenceValue,
    SharedInput,
    complex_normalised_error,
    covariance_of,
    drift,
    find_contradictory_claims,
    find_possible_shared_inputs,
    find_shared_inputs,
    median_reference,
    normalised_error,
    pair_differences,
    reference_value,
    select_acting_inputs,
    weighted_mean,
)
from fusion.sensor.compare.linking import (
    ArtefactStability,
    ComparedGroup,
    Participant,
    RoundLink,
    link_rounds,
    linked_rounds,
    linking_laboratories,
    merge_repeats,
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
    def differences(self) -> tuple[FloatArray, FloatArray]:
        """Return the degrees of equivalence of all pairs (N, N), and their U."""
        return pair_differences(self.value, self.covariance)

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
class ComparisonMethod:
    """Method of the reference value, and laboratories that link rounds.

    `reference`: `mean` or `median`. `link`: names; empty: all laboratories in several rounds.
    """

    reference: str = "mean"
    link: tuple[str, ...] = ()


PROCEDURE_A = ComparisonMethod()


@dataclass(frozen=True)
class ComparisonEvaluation(CommandEvaluation):
    """A comparison: the compared quantities, and values without a partner.

    `stated`: the values of each element and frequency as the results state them. `stability` of the artefacts.
    `links` of the rounds.
    """

    results: tuple[ComparedResult, ...]
    shared: tuple[SharedInput, ...]
    quantities: tuple[ComparedQuantity, ...]
    unmatched: tuple[tuple[str, ComparedValue], ...]
    method: ComparisonMethod = PROCEDURE_A
    stated: tuple[ComparedGroup, ...] = ()
    stability: tuple[ArtefactStability, ...] = ()
    links: tuple[RoundLink, ...] = ()

    @property
    def laboratories(self) -> list[str]:
        """Return the names of the compared results, in the order of the results."""
        used = {name for found in self.quantities for name in found.names}
        return [
            name for name in dict.fromkeys(Participant.of(result.name).name for result in self.results) if name in used
        ]


def evaluate_comparison(
    results: Sequence[ComparedResult],
    dates: Mapping[str, Date] | None = None,
    tolerance: float = 1e-3,
    hashes: Mapping[str, str] | None = None,
    method: ComparisonMethod = PROCEDURE_A,
) -> ComparisonEvaluation:
    r"""Compare results value by value: reference value, degrees of equivalence, E_n.

    Parameters
    ----------
    results : sequence of ComparedResult
        Of `read_compared`. Names state rounds and repeats (`Participant`). The first result belongs to the round of the
        reference value.
    dates : mapping of str to date, optional
        Date of each result by its name; default: those of the files.
    tolerance : float
        Relative difference of the frequencies of one value, of the lowest; default 0.001.
    hashes : mapping of str to str, optional
        File → SHA-256, copied into the result.
    method : ComparisonMethod
        Reference value; default: weighted mean, procedure A.

    Returns
    -------
    ComparisonEvaluation
        Its `quantities` are the magnitudes and phases that several results have.

    Raises
    ------
    InputError
        No value can be compared, units differ, or a round is not linked.

    Notes
    -----
    Results are independent except for shared inputs with evidence (`find_shared_inputs`), and for errors that they have
    in common by a link of rounds or a drift.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from fusion import evaluate_comparison, read_compared
    >>> head = "frequency_hz,channel,component,magnitude,u_magnitude,unit"
    >>> with TemporaryDirectory() as folder:
    ...     files = {name: Path(folder, f"{name}.csv") for name in ("own", "ptb")}
    ...     for file, value in zip(files.values(), ("1.000", "1.002")):
    ...         _ = file.write_text(f"{head}\n80,Fz,Fz,{value},0.001,(mV/V)/N\n")
    ...     (magnitude,) = evaluate_comparison(read_compared(files)).quantities
    >>> print(f"mean {magnitude.reference.value:.4f}, E_n of the pair {magnitude.normalised[1, 0]:.2f}")
    mean 1.0010, E_n of the pair 0.71
    """
    begun = time.perf_counter()
    settings: dict[str, str | float | int] = {"tolerance": tolerance, "reference value": method.reference}
    dates = dates or {}
    results = [_dated(result, dates) for result in results]
    first, links = _check_rounds(results, method)
    if links:
        settings["linking laboratories"] = ", ".join(sorted(links))
    shared = find_shared_inputs(results)
    unmatched: list[tuple[str, ComparedValue]] = []
    stated, linked, stability, rounds = [], list[ComparedGroup](), list[ArtefactStability](), list[RoundLink]()
    for entries in _groups(results, tolerance):
        comparable, others = _comparable(entries, links, first)
        unmatched += others
        if comparable:
            comparable = _in_one_unit(comparable, results)
            names, values = zip(*comparable, strict=True)
            stated.append(ComparedGroup(names, values, tuple(select_acting_inputs(comparable, shared))))
            merged, found = merge_repeats(stated[-1])
            group, found_links = link_rounds(merged, links, first)
            linked.append(group)
            stability += found
            rounds += found_links
    compared, conventions = _quantities(linked, method, first)
    if not compared:
        raise _no_common_value(results, unmatched, tolerance)
    acting = _each_once(item for found in compared for item in found.shared)
    return ComparisonEvaluation(
        name=f"Comparison of {', '.join(dict.fromkeys(Participant.of(result.name).name for result in results))}",
        notices=(
            *_notices(results, unmatched, shared, acting=bool(acting)),
            *_about_kinds(results, unmatched, tolerance),
            *_about_artefacts(stability, rounds),
            *conventions,
        ),
        settings=settings | {f"date of {name}": str(day) for name, day in dates.items()},
        input_hashes=dict(hashes or {}),
        duration_s=time.perf_counter() - begun,
        results=tuple(results),
        shared=tuple(acting),
        quantities=tuple(compared),
        unmatched=tuple(unmatched),
        method=method,
        stated=tuple(stated),
        stability=tuple(stability),
        links=tuple(rounds),
    )


def _no_common_value(
    results: Sequence[ComparedResult], unmatched: Sequence[tuple[str, ComparedValue]], tolerance: float
) -> InputError:
    """Return the error of results without a common value."""
    kinds = "; ".join(f"{channel} per {other}" for channel, other, *_ in _different_kinds(unmatched, tolerance))
    if kinds:
        return InputError(
            declared.ONLY_DIFFERENT_KINDS, results[1].file, "frequency_hz", tolerance=tolerance, kinds=kinds
        )
    return InputError(declared.NO_COMMON_VALUE, results[1].file, "frequency_hz", tolerance=tolerance)


def _dated(result: ComparedResult, dates: Mapping[str, Date]) -> ComparedResult:
    """Return a result whose values have its stated day."""
    if result.name not in dates:
        return result
    values = tuple(replace(value, year=year_of(dates[result.name])) for value in result.values)
    return replace(result, values=values, date=dates[result.name])


def _each_once(items: Iterable[SharedInput]) -> list[SharedInput]:
    """Return inputs that correlate values, each once."""
    found: list[SharedInput] = []
    for item in items:
        if item not in found:
            found.append(item)
    return found


def _check_rounds(results: Sequence[ComparedResult], method: ComparisonMethod) -> tuple[str, frozenset[str]]:
    """Return the round of the reference value and the linking laboratories.

    Raises `InputError` for a round without a link.
    """
    names = [result.name for result in results]
    participants = [Participant.of(name) for name in names]
    first = participants[0].round
    count = len({p.laboratory for p in participants if p.round == first})
    if not 2 <= count <= MAX_RESULTS:
        raise InputError(declared.WRONG_RESULT_COUNT, results[0].file, found=count, limit=MAX_RESULTS)
    links = linking_laboratories(names, method.link)
    for name in method.link:
        if name not in links:
            expected = "a laboratory with results in several rounds, ROUND/NAME=RESULT"
            raise InputError(declared.WRONG_COMPARISON_OPTION, "--link", name, found=name, expected=expected)
    linked = linked_rounds(names, links, first)
    for participant, result in zip(participants, results, strict=True):
        if participant.round not in linked:
            unnamed = "(no name)"
            raise InputError(
                declared.ROUND_NOT_LINKED, result.file, round=participant.round or unnamed, first=first or unnamed
            )
    return first, links


def _comparable(
    entries: list[tuple[str, ComparedValue]], links: frozenset[str], first: str
) -> tuple[list[tuple[str, ComparedValue]], list[tuple[str, ComparedValue]]]:
    """Return values comparable with two laboratories of the first round, and all others."""
    rounds = linked_rounds([name for name, _ in entries], links, first)
    found = [entry for entry in entries if Participant.of(entry[0]).round in rounds]
    if len({p.laboratory for p in (Participant.of(name) for name, _ in found) if p.round == first}) < 2:
        return [], entries
    return found, [entry for entry in entries if entry not in found]


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


def _quantities(
    groups: Sequence[ComparedGroup], method: ComparisonMethod, first: str
) -> tuple[list[ComparedQuantity], list[Notice]]:
    """Return all compared quantities with one sign of each element, and notices of conventions."""
    compared = [one for group in groups for one in _both_quantities(group, method, first, {})]
    conventions = list(opposite_conventions(compared))
    opposite_sign = opposite_signs(compared, list(dict.fromkeys(name for group in groups for name in group.names)))
    if opposite_sign:
        compared = [one for group in groups for one in _both_quantities(group, method, first, opposite_sign)]
    return compared, conventions


def _both_quantities(
    group: ComparedGroup, method: ComparisonMethod, first: str, opposite_sign: OppositeSigns
) -> Iterator[ComparedQuantity]:
    """Yield magnitude and, where two results have one, phase of one element at one frequency."""
    names = opposite_sign.get((group.values[0].channel, group.values[0].component), frozenset())
    values = tuple(
        replace(value, phase_rad=value.phase_rad - np.pi) if name in names and value.phase_rad is not None else value
        for name, value in zip(group.names, group.values, strict=True)
    )
    yield _compared(replace(group, values=values), "magnitude", method, first, names)
    phased = [n for n, value in enumerate(values) if value.phase_rad is not None]
    if sum(group.participants[n].round == first for n in phased) > 1:
        acting = tuple((item, effect[phased]) for item, effect in group.acting)
        with_phase = ComparedGroup(tuple(group.names[n] for n in phased), tuple(values[n] for n in phased), acting)
        yield _compared(with_phase, "phase", method, first, names)


def _compared(
    group: ComparedGroup, quantity: str, method: ComparisonMethod, first: str, opposite_sign: frozenset[str]
) -> ComparedQuantity:
    """Return reference value, E_n and drift of one quantity; phases are unwrapped."""
    names, values = group.names, group.values
    if quantity == "magnitude":
        value, u = np.array([v.magnitude for v in values]), np.array([v.u_magnitude for v in values])
    else:
        phase = np.array([v.phase_rad for v in values], dtype=np.float64)
        value = phase[0] + np.angle(np.exp(1j * (phase - phase[0])))
        u = np.array([v.u_phase_rad for v in values])
    column, size = (0, value) if quantity == "magnitude" else (1, None)
    acting = [(item, effect) for item, effect in group.acting if np.count_nonzero(effect[:, column]) > 1]
    relative = np.array([effect[:, column] for _, effect in acting]).reshape(-1, len(u))
    (covariance, effects), change = covariance_of(relative, u, size), None
    proven = [item.proven for item, _ in acting]
    year = np.array([v.year for v in values])
    if np.isfinite(year).all() and len(np.unique(year)) > 1:
        change = drift(year, value, covariance)
    reference = median_reference if method.reference == "median" else reference_value
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
        shared=tuple(item for item, _ in acting if item.proven),
        effects=effects[proven],
        reference=reference(value, covariance, sum(p.round == first for p in group.participants)),
        normalised=normalised_error(value, covariance),
        complex_normalised=_complex_errors(values, group.acting) if quantity == "magnitude" else None,
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
        disjoint = one.rows is not None and other.rows is not None and one.rows.isdisjoint(other.rows)
        if Path(one.file).resolve() == Path(other.file).resolve() and not disjoint:
            found.append(Notice(declared.SAME_FILE, "comparison", **names))
    if unmatched:
        found.append(Notice(declared.UNMATCHED_VALUES, "comparison", count=len(unmatched)))
    return found


def _about_artefacts(stability: Sequence[ArtefactStability], links: Sequence[RoundLink]) -> Iterator[Notice]:
    """Yield notices of drifting artefacts, and of linking laboratories that contradict each other."""
    elements: dict[tuple[str, str, str], list[ArtefactStability]] = {}
    for one in stability:
        elements.setdefault((one.laboratory, one.value.channel, one.value.component), []).append(one)
    for (laboratory, channel, component), found in elements.items():
        if min(one.p for one in found) >= SIGNIFICANCE / len(found):
            continue  # one value in twenty drifts by chance (Bonferroni); the table lists it
        for notice, removed in ((declared.DRIFT_REMOVED, True), (declared.DRIFT_NOT_REMOVED, False)):
            count = sum(one.p < SIGNIFICANCE and one.removed is removed for one in found)
            if count:
                of = {"laboratory": laboratory, "channel": channel, "component": component}
                yield Notice(notice, "comparison", **of, count=count, points=len(found))
    rounds: dict[tuple[str, str, str], list[float]] = {}
    for link in links:
        if np.isfinite(link.p):
            rounds.setdefault((link.round, link.value.channel, link.value.component), []).append(link.p)
    for (name, channel, component), p in rounds.items():
        if min(p) < SIGNIFICANCE / len(p):
            of = {"round": name, "channel": channel, "component": component}
            yield Notice(declared.LINKS_INCONSISTENT, "comparison", **of, p=min(p), count=len(p))


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
