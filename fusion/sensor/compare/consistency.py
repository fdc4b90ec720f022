"""Consistency of results: shared inputs, their covariance, reference value, E_n and drift."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from fusion.estimation.coverage import COVERAGE, along_and_across, region_factor
from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensor.compare.comparison_inputs import ComparedResult, ComparedValue
from shakercal._common.arrays import ComplexArray, FloatArray

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
    proven: bool = True
    """Whether a certificate or file states it; otherwise it is the error of a result that the evaluation uses twice."""

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
    """Return the evidence of each unknown of a result, preferably proven evidence."""
    found: dict[str, tuple[InputEvidence, ...]] = {}
    for row in sorted(result.evidence, key=lambda row: not row.proven):
        if row.proven or row.unknown not in found:
            found[row.unknown] = (*found.get(row.unknown, ()), row)
    return found


def find_possible_shared_inputs(one: ComparedResult, other: ComparedResult) -> Iterator[str]:
    """Yield notable inputs of equal name, kind and u for which no result states evidence."""
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


# Reference value, its consistency, degrees of equivalence and drift.


SIGNIFICANCE = 0.05
"""Level of the χ² test of consistency (Cox 2002)."""
COVERAGE_FACTOR = 2.0
MAX_RESULTS = 12
"""Largest number of results of one element at one frequency, since all their subsets are tried."""


MEDIAN_DRAWS = 50_000
"""Monte Carlo draws of the median: its coverage interval then has two significant digits (JCGM 101, 7.2)."""
MEDIAN_SEED = 589
"""Seed of these draws, so that equal inputs have equal results."""


@dataclass(frozen=True)
class ReferenceValue:
    """Reference value of the results `used` (N,), and degrees of equivalence of all results.

    `deviation` (N,) with `expanded` U, k = 2 of a mean, 95 % of the draws of a median. `interval`: 95 % coverage
    interval of the value. `p`: probability of a χ² at least as large as that of the used results. If no two results are
    consistent, none is used, and all numbers but `p` are NaN.
    """

    value: float
    u: float
    interval: tuple[float, float]
    chi_squared: float
    dof: int
    p: float
    used: np.typing.NDArray[np.bool_]
    deviation: FloatArray
    expanded: FloatArray

    @property
    def expanded_value(self) -> float:
        """U of the value: half of its coverage interval."""
        return 0.5 * (self.interval[1] - self.interval[0])

    @property
    def normalised(self) -> FloatArray:
        """E_n of every result; NaN if it alone defines the reference value."""
        uncertain = self.expanded > 0.0
        return np.asarray(np.where(uncertain, self.deviation / np.where(uncertain, self.expanded, 1.0), np.nan))


def pair_differences(value: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return differences x_i - x_j (N, N) of pairs, and their U (k = 2)."""
    variance = np.diag(covariance)
    spread = variance[:, None] + variance[None, :] - 2.0 * covariance
    return value[:, None] - value[None, :], COVERAGE_FACTOR * np.sqrt(np.maximum(spread, 0.0))


def normalised_error(value: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return E_n (N, N) of pairs of results, with their correlations; 0 on the diagonal."""
    difference, expanded = pair_differences(value, covariance)
    return np.asarray(np.where(expanded > 0.0, difference / np.where(expanded > 0.0, expanded, 1.0), 0.0))


def complex_normalised_error(
    value: ComplexArray, u_magnitude: FloatArray, u_phase_rad: FloatArray, shared: Sequence[FloatArray] = ()
) -> FloatArray:
    """Return E_n (N, N) of complex values by magnitude and phase.

    It is 1 at the edge of the 95 % region. sqrt(d' V^-1 d / 5.99) of the difference d (real and imaginary part) with
    covariance V = V_i + V_j - C_ij - C_ji. 5.99 is the 95 % quantile of χ² with two degrees of freedom (JCGM 102, 6.5).
    0 on the diagonal, NaN for NaN values. `shared`: effects (N, 2) of every shared input on relative magnitudes and
    phases, from which C follows.
    """
    found, frame = np.zeros((len(value), len(value))), along_and_across(value)
    size = np.abs(value)[:, None]
    variance = np.column_stack([u_magnitude, size[:, 0] * u_phase_rad]) ** 2
    # A shared input correlates magnitude and phase of one result, too.
    individual = variance - sum(((effect * size) ** 2 for effect in shared), np.zeros_like(variance))
    roots = frame * np.sqrt(np.maximum(individual, 0.0))[:, None, :]
    common = [np.einsum("nij,nj->ni", frame, effect * size) for effect in shared]
    covariances = roots @ roots.swapaxes(-1, -2)
    covariances += sum((c[:, :, None] * c[:, None, :] for c in common), np.zeros_like(covariances))
    for i, j in combinations(range(len(value)), 2):
        both = np.array([(value[i] - value[j]).real, (value[i] - value[j]).imag])
        spread = covariances[i] + covariances[j]
        for effect in common:
            spread = spread - np.outer(effect[i], effect[j]) - np.outer(effect[j], effect[i])
        usable = bool(np.isfinite(spread).all()) and np.linalg.det(spread) > 0.0
        squared = float(both @ np.linalg.solve(spread, both)) if usable else np.nan
        found[i, j] = found[j, i] = np.sqrt(squared) / region_factor(np.inf)
    return found


def weighted_mean(value: FloatArray, covariance: FloatArray) -> tuple[float, float, FloatArray, float]:
    """Return mean, its u, weights (N,) and χ² by generalised least squares of one constant."""
    solved = np.linalg.solve(covariance, np.column_stack([np.ones(len(value)), value]))
    total = float(solved[:, 0].sum())
    weights = np.asarray(solved[:, 0] / total, dtype=np.float64)
    mean = float(weights @ value)
    left = value - mean
    return mean, float(total**-0.5), weights, float(left @ np.linalg.solve(covariance, left))


def reference_value(value: FloatArray, covariance: FloatArray, count: int | None = None) -> ReferenceValue:
    """Return the weighted mean of the first `count` (default: all) of N results.

    `covariance` (N, N) of the results. Cox, Metrologia 39 (2002) 589, procedure A: the weighted mean if χ² does not
    reject it at 5 %. Otherwise that of the largest consistent subset, among equal ones that of the smallest χ² (Cox,
    Metrologia 44 (2007) 187). The other results, which are linked, have degrees of equivalence only.
    """
    every, count = len(value), len(value) if count is None else count
    if not 2 <= count <= MAX_RESULTS:
        raise ValueError(f"value: expected 2 to {MAX_RESULTS} results, found {count}")
    tried = []
    for size in range(count, 1, -1):
        found = []
        for subset in combinations(range(count), size):
            indices = np.array(subset)
            found.append((weighted_mean(value[indices], covariance[np.ix_(indices, indices)])[3], subset))
        squared, subset = min(found)
        tried.append(float(chdtrc(size - 1.0, max(squared, 0.0))))
        if tried[-1] >= SIGNIFICANCE:
            break
    else:
        unknown, none = np.full(every, np.nan), np.zeros(every, dtype=np.bool_)
        return ReferenceValue(np.nan, np.nan, (np.nan, np.nan), np.nan, 0, tried[0], none, unknown, unknown)
    indices, p = np.array(subset), tried[-1]
    mean, u, inner, squared = weighted_mean(value[indices], covariance[np.ix_(indices, indices)])
    weights = np.zeros(every)
    weights[indices] = inner
    transform = np.eye(every) - weights  # deviations x_i - w.x, row by row
    variance = np.einsum("ij,jk,ik->i", transform, covariance, transform)
    expanded = COVERAGE_FACTOR * np.sqrt(np.maximum(variance, 0.0))
    expanded[expanded < 1e-9 * np.sqrt(np.diag(covariance))] = 0.0  # one that alone defines the value
    interval = mean - COVERAGE_FACTOR * u, mean + COVERAGE_FACTOR * u
    used = np.isin(np.arange(every), indices)
    return ReferenceValue(mean, u, interval, squared, size - 1, p, used, value - mean, expanded)


def median_reference(value: FloatArray, covariance: FloatArray, count: int | None = None) -> ReferenceValue:
    """Return the median of the first `count` (default: all) of N results.

    `covariance` (N, N) of the results. Cox, Metrologia 39 (2002) 589, procedure B: all results are used. Value and u
    are mean and standard deviation of the medians of Monte Carlo draws, the interval is the shortest that contains 95 %
    of them. U of a deviation covers 95 % of its draws. χ² is that of the weighted mean.
    """
    every, count = len(value), len(value) if count is None else count
    u = np.sqrt(np.diag(covariance))
    normal = np.random.default_rng(MEDIAN_SEED).standard_normal((MEDIAN_DRAWS, every))
    variances, vectors = np.linalg.eigh(covariance / np.outer(u, u))
    errors = u * (normal * np.sqrt(np.maximum(variances, 0.0)) @ vectors.T)
    medians = np.median(value[:count] + errors[:, :count], axis=1)
    centre, ordered = float(medians.mean()), np.sort(medians)
    inside = int(COVERAGE * MEDIAN_DRAWS)
    begin = int(np.argmin(ordered[inside:] - ordered[:-inside]))
    deviation = value - centre
    spread = np.abs(value + errors - medians[:, None] - deviation)
    squared = weighted_mean(value[:count], covariance[:count, :count])[3]
    return ReferenceValue(
        centre,
        float(medians.std()),
        (float(ordered[begin]), float(ordered[begin + inside])),
        squared,
        count - 1,
        float(chdtrc(count - 1.0, max(squared, 0.0))),
        np.arange(every) < count,
        deviation,
        np.quantile(spread, COVERAGE, axis=0),
    )


def drift(year: FloatArray, value: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Return the change per year and its u; `ValueError` for a single date."""
    if len(np.unique(year)) < 2:
        raise ValueError("year: expected two dates, found one")
    design = np.column_stack([np.ones(len(year)), year - year.mean()])
    weighed = np.linalg.solve(covariance, np.column_stack([design, value]))
    scatter = np.linalg.inv(design.T @ weighed[:, :2])
    return float((scatter @ (design.T @ weighed[:, 2]))[1]), float(scatter[1, 1] ** 0.5)
