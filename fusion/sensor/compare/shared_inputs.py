"""Inputs that results share by certificate or file, and the resulting covariance."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensor.compare.comparison_inputs import ComparedResult, ComparedValue
from shakercal._common.arrays import FloatArray

EQUAL_RTOL = 1e-6
"""Relative tolerance of equal values and standard uncertainties: their rounding in files."""
NOTABLE = 0.1
"""Share of a variance from which an input that may be shared has a notice: chosen."""


@dataclass(frozen=True)
class SharedInput:
    """An input that results share: its quantity (`of`), evidence, and unknowns by result."""

    of: str
    evidence: str
    unknowns: Mapping[str, str]

    @property
    def title(self) -> str:
        """Return quantity and evidence; numbered components have one title."""
        return f"{re.sub(r' [0-9]+$', '', self.of)} ({self.evidence})"


def list_titles(shared: Iterable[SharedInput]) -> list[str]:
    """Return the titles of inputs, each once."""
    return list(dict.fromkeys(item.title for item in shared))


def find_shared_inputs(results: Sequence[ComparedResult]) -> tuple[SharedInput, ...]:
    """Return every input that at least two results share by evidence.

    Unknowns of different results are one if quantity, u and (unless relative) value are equal, and each certificate or
    file behind one is also behind the other. Of several candidates the one of the same name is selected, then that of
    the same value, then a single one. Equal names alone are no evidence.
    """
    groups: list[dict[str, tuple[InputEvidence, ...]]] = []
    for result in results:
        unknowns = _unknowns(result)
        for name, group in _paired(unknowns, groups):
            group[result.name] = unknowns.pop(name)
        groups += [{result.name: rows} for rows in unknowns.values()]
    return tuple(_shared_input(group) for group in groups if len(group) > 1)


def find_contradictory_claims(
    one: ComparedResult, other: ComparedResult, shared: Sequence[SharedInput]
) -> Iterator[str]:
    """Yield inputs for which two results name the same certificate but which are not shared."""
    both = [found.unknowns for found in shared if {one.name, other.name} <= set(found.unknowns)]
    taken = [names[one.name] for names in both], [names[other.name] for names in both]
    mine, theirs = _unknowns(one), _unknowns(other)
    left = ((x, y) for x in mine if x not in taken[0] for y in theirs if y not in taken[1])
    for rows, others in ((mine[x], theirs[y]) for x, y in left):
        number = rows[0].certificate if rows[0].of == others[0].of and not _may_be_one(rows, others) else ""
        if number and _same_source(rows, others):
            yield f"{rows[0].of} (certificate {number})"


def _unknowns(result: ComparedResult) -> dict[str, tuple[InputEvidence, ...]]:
    """Return the evidence of each unknown of a result.

    Of several recordings, proven evidence is preferred.
    """
    found: dict[str, tuple[InputEvidence, ...]] = {}
    for row in sorted(result.evidence, key=lambda row: not row.proven):
        if row.proven or row.unknown not in found:
            found[row.unknown] = (*found.get(row.unknown, ()), row)
    return found


def find_possible_shared_inputs(one: ComparedResult, other: ComparedResult) -> Iterator[str]:
    """Yield inputs of equal name, kind and u for which no result states evidence.

    Only inputs with a notable share of a variance.
    """
    mine, theirs = _unknowns(one), _unknowns(other)
    for name in (name for name in mine if name in theirs):
        row, that = mine[name][0], theirs[name][0]
        is_equal = (row.of, row.unit) == (that.of, that.unit) and _close(row.u, that.u)
        if is_equal and not row.proven and not that.proven and _largest_share(one, name) > NOTABLE:
            yield name


def _largest_share(result: ComparedResult, unknown: str) -> float:
    """Return the largest share of an unknown in any variance of a result."""
    acting = ((value, *value.effects[unknown]) for value in result.values if unknown in value.effects)
    shares = ((along * v.magnitude / v.u_magnitude, across / v.u_phase_rad) for v, along, across in acting)
    return float(max((np.nanmax(np.square(pair)) for pair in shares), default=0.0))


def _paired(
    unknowns: Mapping[str, tuple[InputEvidence, ...]], groups: Sequence[dict[str, tuple[InputEvidence, ...]]]
) -> list[tuple[str, dict[str, tuple[InputEvidence, ...]]]]:
    """Return the unknowns of a result with their groups of unknowns of other results."""
    fitting = {
        name: [n for n, group in enumerate(groups) if all(_may_be_one(rows, other) for other in group.values())]
        for name, rows in unknowns.items()
    }
    found: list[tuple[str, int]] = []

    def take(better: Callable[[tuple[InputEvidence, ...], tuple[InputEvidence, ...]], bool]) -> None:
        """Select candidates that are `better` and the only such pair."""
        free = {name: indices for name, indices in fitting.items() if name not in {paired for paired, _ in found}}
        gone = {index for _, index in found}
        best = {
            name: [n for n in indices if n not in gone and any(better(unknowns[name], o) for o in groups[n].values())]
            for name, indices in free.items()
        }
        every = [index for indices in best.values() for index in indices]
        found.extend((name, p[0]) for name, p in best.items() if len(p) == 1 and every.count(p[0]) == 1)

    take(lambda rows, other: rows[0].unknown == other[0].unknown)
    take(lambda rows, other: _close(rows[0].value, other[0].value))
    take(lambda rows, other: True)
    return [(name, groups[index]) for name, index in found]


def _may_be_one(rows: Sequence[InputEvidence], others: Sequence[InputEvidence]) -> bool:
    """Return whether two unknowns may be one: equal quantity, u, value (unless relative) and source."""
    one, other = rows[0], others[0]
    what = (one.of, one.unit) == (other.of, other.unit) and _close(one.u, other.u)
    return what and (one.unit == "1" or _close(one.value, other.value)) and _same_source(rows, others)


def _same_source(rows: Sequence[InputEvidence], others: Sequence[InputEvidence]) -> bool:
    """Return whether the sources of two unknowns are equal."""

    def behind(row: InputEvidence, those: Sequence[InputEvidence]) -> bool:
        return any(
            (row.certificate != "" and row.certificate == that.certificate)
            or (row.sha256 != "" and row.sha256 == that.sha256)
            for that in those
        )

    return all(behind(row, others) for row in rows) and all(behind(row, rows) for row in others)


def _close(one: float, other: float) -> bool:
    return bool(np.isclose(one, other, rtol=EQUAL_RTOL, atol=0.0, equal_nan=True))


def _shared_input(group: Mapping[str, tuple[InputEvidence, ...]]) -> SharedInput:
    """Return a shared input with its evidence in words."""
    rows = [row for of_result in group.values() for row in of_result]
    numbers = dict.fromkeys(f"certificate {row.certificate}" for row in rows if row.certificate)
    files = dict.fromkeys(f"file {row.sha256[:12]}" for row in rows if row.sha256)
    return SharedInput(
        rows[0].of, ", ".join(numbers or files), {name: of_result[0].unknown for name, of_result in group.items()}
    )


# Covariances of magnitudes and phases by shared inputs.


def select_acting_inputs(
    entries: Sequence[tuple[str, ComparedValue]], shared: Sequence[SharedInput]
) -> list[tuple[SharedInput, FloatArray]]:
    """Return inputs that at least two values share, with effects (N, 2).

    On magnitudes and phases. For one standard uncertainty: relative change of magnitudes, change of phases in rad; 0 of
    values that do not depend on it.
    """
    found = []
    for item in shared:
        effects = [value.effects.get(item.unknowns.get(name, ""), (0.0, 0.0)) for name, value in entries]
        if sum(any(pair) for pair in effects) > 1:
            found.append((item, np.array(effects)))
    return found


def covariance_of(effects: FloatArray, u: FloatArray, size: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (N, N) of results, and absolute effects (S, N).

    `u` (N,) are the standard uncertainties of the results. `effects` (S, N) of shared inputs are relative to the values
    `size` (N,), absolute if None. Relative effects are applied to the weighted mean of the values, also in each
    variance. If each acted on its value, the same relative error would be smaller for smaller values and pull the mean
    below all of them (Peelle's puzzle).
    """
    at = np.ones(len(u)) if size is None else np.full(len(u), np.average(size, weights=u**-2))
    individual = at if size is None else size
    absolute = effects * at
    variance = u**2 + np.sum(absolute**2 - (effects * individual) ** 2, axis=0)
    common = absolute.T @ absolute
    return np.asarray(common - np.diag(np.diag(common)) + np.diag(variance)), absolute
