"""Mean over repeats and mountings of one excitation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from fusion.campaign.campaign_notices import ONE_MOUNTING, TWO_REPEATS
from fusion.campaign.excited_line import SECOND_ORDER, ExcitedLine, LazyUncertainty
from fusion.estimation.coverage import coverage_factor
from fusion.estimation.fuse import EXPLANATIONS
from fusion.estimation.measurement_model import BODY_SIZE_M
from fusion.estimation.uncertainty import (
    Contribution,
    Uncertainty,
    added_up,
    merge_contributions,
    real_stack,
    total_variance,
)
from fusion.sensitivity.ratio import PriorMatrix, StatedMatrix, driven_component, prior_matrix
from shaker.sine.phasor import real_stacked, real_stacked_diagonal
from shakercal._common.arrays import ComplexArray, FloatArray, IntArray
from shakercal._common.digits import number_text
from shakercal._common.notices import Notice

SAME_FREQUENCY = 1e-4
"""Relative difference of frequencies within which a sensitivity does not change."""
SAME_DIRECTION = 1e-3
"""Largest difference of the unit directions of one excitation."""
SAME_LOAD = 0.05
"""Largest difference of a load component (moments over 0.1 m) within one excitation, relative to the driven one."""
WITHIN, BETWEEN = "repeatability", "mounting anew"
PHASE_DIFFERENCES = "phases that differ"
"""Label of the possible loss of magnitude in a mean of complex values with different phases."""
LEVERS = np.array([1.0, 1.0, 1.0, *np.full(3, 1.0 / BODY_SIZE_M)])
"""Factors that convert moments to forces at the size of a body."""


@dataclass(frozen=True)
class RepeatMean:
    """Mean of the elements, or output ratios, over N recordings of one excitation.

    `component`: 0..5, of the load; `amplitude`: its mean. `value` (C,), `uncertainty` (K = 1) with campaign-wide names;
    `recordings`, `mountings` (N,), `weight` (N,) in the mean. `within`, `between` (C,): relative standard deviation of
    a recording and of a mounting beyond the stated uncertainties, with `within_dof` (N - M) and `between_dof` (M - 1).
    They are NaN without degrees of freedom. `kind`: averaged quantity.
    """

    frequency_hz: float
    direction: tuple[float, ...]
    component: int
    amplitude: float
    channels: tuple[str, ...]
    value: ComplexArray
    uncertainty: Uncertainty
    recordings: tuple[str, ...]
    mountings: tuple[str, ...]
    weight: FloatArray
    within: FloatArray
    between: FloatArray
    within_dof: int
    between_dof: int
    kind: Literal["ratio", "element"] = "ratio"


def drive_element(drive: ExcitedLine, matrix: PriorMatrix) -> tuple[ComplexArray, Uncertainty]:
    """Return the sensor's elements (E,) of one line by a given matrix, otherwise as `drive_ratio`."""
    of_load, of_outputs = drive.campaign_uncertainties()
    indices = [drive.channels.index(channel) for channel in matrix.channels]
    outputs, load = drive.outputs[None, indices], drive.load[None]
    # Unobserved loads are within their uncertainty.
    given = np.abs(load) ** 2 > total_variance(np.nan_to_num(of_load.covariance))
    return matrix.elements(outputs, load)[0], matrix.uncertainty(outputs, load, of_outputs.at(indices), of_load, given)


def known_matrix_of(drives: Sequence[ExcitedLine], component: int, stated: StatedMatrix | None) -> PriorMatrix | None:
    """Return the stated matrix of the outputs that all lines have, or None."""
    usable = common_outputs(drives)
    if stated is None or not usable:
        return None
    return prior_matrix(stated, usable, component, np.array([drives[0].output(channel) for channel in usable]))


def drive_ratio(drive: ExcitedLine, component: int, channels: Sequence[str]) -> tuple[ComplexArray, Uncertainty]:
    """Return output over one load component of one line (C,), with its uncertainty.

    dS = (dU - S·dL)/L; unknowns that outputs and load share act on both. Names of unknowns are campaign-wide.
    """
    of_load, of_outputs = drive.campaign_uncertainties()
    indices = [drive.channels.index(channel) for channel in channels]
    load = drive.load[component]
    ratio = drive.outputs[indices] / load
    through = real_stacked(-ratio[:, None] / load)[None]
    upper = of_outputs.at(indices).scaled(np.full((1, len(indices)), 1.0 / load, dtype=np.complex128))
    return np.asarray(ratio), upper.plus(of_load.at([component]).transformed(through))


def drive_value(
    drive: ExcitedLine, component: int, channels: Sequence[str], matrix: PriorMatrix | None
) -> tuple[ComplexArray, Uncertainty]:
    """Return the sensor's elements of some outputs (C,) if its matrix is given, otherwise ratios."""
    if matrix is None:
        return drive_ratio(drive, component, channels)
    value, uncertainty = drive_element(drive, matrix)
    indices = [matrix.rows.index(matrix.channels.index(channel)) for channel in channels]
    return value[indices], uncertainty.at(indices)


def drive_values(
    drives: Sequence[ExcitedLine], component: int, stated: StatedMatrix | None, channels: Sequence[str]
) -> tuple[Literal["ratio", "element"], list[tuple[ComplexArray, Uncertainty]]]:
    """Return elements of some outputs if the stated matrix gives all of them, otherwise ratios."""
    matrix = known_matrix_of(drives, component, stated)
    if matrix is not None and not set(channels) <= {matrix.channels[row] for row in matrix.rows}:
        matrix = None
    kind: Literal["ratio", "element"] = "ratio" if matrix is None else "element"
    return kind, [drive_value(drive, component, channels, matrix) for drive in drives]


def find_repeats(
    drives: Iterable[ExcitedLine],
    capacity: Sequence[float] | None = None,
    stated: StatedMatrix | None = None,
    mean: Mean | None = None,
) -> tuple[RepeatMean, ...]:
    """Return the mean of every group of lines of one excitation, ascending in frequency.

    One excitation: frequencies within 1e-4, directions within 1e-3, and every load component (moments over 0.1 m)
    within 5 % of the driven one. `stated`: of the sensor's matrix; it allows means of elements. `mean`: replaces
    `mean_ratio` (`cached_mean_ratio`).
    """
    mean = mean_ratio if mean is None else mean
    groups = [(group, driven_component(group[0].direction, capacity)) for group in group_excitations(drives, capacity)]
    return tuple(mean(group, component, known_matrix_of(group, component, stated)) for group, component in groups)


def group_excitations(
    drives: Iterable[ExcitedLine], capacity: Sequence[float] | None = None, *, separate_amplitudes: bool = True
) -> tuple[tuple[ExcitedLine, ...], ...]:
    """Return the lines in groups of one excitation, ascending in frequency.

    If `separate_amplitudes` is false, loads are compared after scaling to one amplitude.
    """
    groups: list[list[ExcitedLine]] = []
    near: list[list[ExcitedLine]] = []
    for drive in sorted(drives, key=lambda drive: drive.frequency_hz):
        component = driven_component(drive.direction, capacity)
        if drive.load[component] == 0.0 or not drive.observed[component]:
            continue
        # Frequencies ascend: a group that began lower cannot take any drive that is still to come.
        near = [g for g in near if np.log(drive.frequency_hz / g[0].frequency_hz) <= SAME_FREQUENCY]
        match = next((g for g in near if _same(g[0], drive, component, separate_amplitudes=separate_amplitudes)), None)
        if match is None:
            groups.append([drive])
            near.append(groups[-1])
        else:
            match.append(drive)
    return tuple(tuple(group) for group in groups)


def _same(first: ExcitedLine, other: ExcitedLine, component: int, *, separate_amplitudes: bool) -> bool:
    """Return whether two lines are one excitation.

    Phases and signs of the load do not count.
    """
    if abs(np.log(other.frequency_hz / first.frequency_hz)) > SAME_FREQUENCY:
        return False
    if len(first.direction) != len(other.direction):
        return False
    units = [np.array(drive.direction) / np.linalg.norm(drive.direction) for drive in (first, other)]
    if min(np.max(np.abs(units[0] - units[1])), np.max(np.abs(units[0] + units[1]))) > SAME_DIRECTION:
        return False
    loads = [np.abs(drive.load) * LEVERS for drive in (first, other)]
    if not separate_amplitudes:
        loads = [load / load[component] for load in loads]
    return bool(np.max(np.abs(loads[0] - loads[1])) <= SAME_LOAD * loads[0][component])


def mean_ratio(drives: Sequence[ExcitedLine], component: int, matrix: PriorMatrix | None = None) -> RepeatMean:
    """Return the mean over recordings of one excitation, of output over load or of elements.

    The M means of the mountings differ by everything that mountings do not share (noise, unknowns of a recording and of
    a mounting, stated or not). This scatter alone is its uncertainty: Σw_m·(y_m - y)²/(M - 1) with M - 1 degrees of
    freedom and weights of sum 1 (Hartung & Knapp 2001, Statistics in Medicine 20, 3875; Sidik & Jonkman 2002). If there
    is one mounting, its recordings are used instead. This needs no positive variance component, and close agreement of
    few mountings by chance does not give a zero variance. Shared unknowns do not average out.

    Recordings and mountings have weights by the inverse of their variances in the channel of smallest uncertainty. The
    variances for weights and report are one-way random effects, unbalanced: mean squares within and between mountings,
    less the stated uncertainties with all correlations. The remainders are variances of a recording (N - M degrees of
    freedom) and of a mounting (M - 1), zero if negative (Searle, Casella & McCulloch 1992, Variance Components, 3.6).
    Bounds without a known unknown, such as unobserved motion, may be equal in all recordings and do not average out.
    Only channels with a reading in all recordings have a value.
    """
    usable = common_outputs(drives)
    if not usable:
        raise ValueError("drives: expected an output that all recordings of one excitation have, found none")
    usable = usable if matrix is None else [matrix.channels[row] for row in matrix.rows]
    each = (drive_value(drive, component, usable, matrix) for drive in drives)
    found: list[tuple[ComplexArray, Uncertainty]] = [
        (value, LazyUncertainty.of(uncertainty)) for value, uncertainty in each
    ]
    plain = unweighted_mean([value for value, _ in found])
    scaled = relative_to_mean(found, plain)
    mountings = [drive.mounting for drive in drives]
    scatter = _components(scaled, mountings)
    weight = _weights(scaled, mountings, scatter)
    del scaled  # for thousands of recordings it is as large as `found`
    value = np.einsum("n,nc->c", weight, np.array([value for value, _ in found]))
    uncertainty = _of_mean(found, weight, mountings, plain)
    if len(drives) > 1:
        bounds = _bounds(weight, [of_value for _, of_value in found], drives)
        uncertainty = Uncertainty((*uncertainty.random, *bounds), uncertainty.influences)
    # Relative standard deviations of the whole complex value: root of the sum of both parts' variances.
    within, between = (
        np.sqrt(total_variance(covariance[None])[0]) if dof else np.full(len(usable), np.nan)
        for covariance, dof in ((scatter.within, scatter.within_dof), (scatter.between, scatter.between_dof))
    )
    return RepeatMean(
        frequency_hz=float(np.mean([drive.frequency_hz for drive in drives])),
        direction=drives[0].direction,
        component=component,
        amplitude=float(np.mean([abs(drive.load[component]) for drive in drives])),
        channels=tuple(usable),
        value=value,
        uncertainty=uncertainty,
        recordings=tuple(drive.recording for drive in drives),
        mountings=tuple(mountings),
        weight=weight,
        within=within,
        between=between,
        within_dof=scatter.within_dof,
        between_dof=scatter.between_dof,
        kind="ratio" if matrix is None else "element",
    )


Mean = Callable[[Sequence[ExcitedLine], int, PriorMatrix | None], RepeatMean]


def cached_mean_ratio() -> Mean:
    """Return a `mean_ratio` that computes the mean of the same lines only once.

    Curves average recordings of all amplitudes, repeats those of one amplitude; these are often the same. The matrix
    follows from the lines.
    """
    found: dict[tuple[object, ...], RepeatMean] = {}

    def mean(drives: Sequence[ExcitedLine], component: int, matrix: PriorMatrix | None) -> RepeatMean:
        key = (component, matrix is None, *map(id, drives))
        if key not in found:
            found[key] = mean_ratio(drives, component, matrix)
        return found[key]

    return mean


def frequencies_text(frequency_hz: Sequence[float]) -> str:
    """Return the text for one frequency, or for the number and range of several."""
    if len(frequency_hz) == 1:
        return f"{number_text(frequency_hz[0], 6)} Hz"
    return f"{len(frequency_hz)} frequencies, {min(frequency_hz):.6g} to {max(frequency_hz):.6g} Hz"


def repeat_notices(means: Iterable[RepeatMean]) -> tuple[Notice, ...]:
    """Return one notice per kind for the frequencies with one mounting or only two repeats."""
    one_mounting: dict[int, list[float]] = {}
    two_repeats: dict[str, list[float]] = {}
    for mean in means:
        recordings, mountings = len(mean.recordings), mean.between_dof + 1
        if recordings > 1 and mountings == 1:
            one_mounting.setdefault(recordings, []).append(mean.frequency_hz)
        if recordings > 1 and max(mountings, recordings if mountings == 1 else 0) == 2:
            repeated = "mountings" if mountings == 2 else "recordings"
            two_repeats.setdefault(repeated, []).append(mean.frequency_hz)
    notices = [
        Notice(ONE_MOUNTING, "repeats", frequencies=frequencies_text(sorted(lines)), recordings=recordings)
        for recordings, lines in one_mounting.items()
    ]
    factors = {"k_two": coverage_factor(1.0), "k_three": coverage_factor(2.0)}
    notices += [
        Notice(TWO_REPEATS, "repeats", frequencies=frequencies_text(sorted(lines)), repeated=repeated, **factors)
        for repeated, lines in two_repeats.items()
    ]
    return tuple(notices)


class NestedAnova(NamedTuple):
    """Sums of squares of N readings within and between M mountings, as projections.

    `mounting_index` (N,): the mounting of each reading; `sizes` (M,): of the mountings. `within_dof` N - M,
    `between_dof` M - 1; `each`: recordings per mounting in the expectation of the mean square between them, NaN for one
    mounting.
    """

    mounting_index: IntArray
    sizes: FloatArray
    within_dof: int
    between_dof: int
    each: float

    def within(self, values: FloatArray, rows: IntArray | None = None) -> FloatArray:
        """Return values (N, ...) less the mean of their mounting.

        `rows`: the rows that are given; all others are zero.
        """
        return np.asarray(values - self._means(values, rows))

    def between(self, values: FloatArray, rows: IntArray | None = None) -> FloatArray:
        """Return the means of the mountings less the total mean.

        `rows`: the rows that are given; all others are zero.
        """
        return np.asarray(self._means(values, rows) - np.sum(values, axis=0) / len(self.mounting_index))

    def _means(self, values: FloatArray, rows: IntArray | None) -> FloatArray:
        mounting = self.mounting_index if rows is None else self.mounting_index[rows]
        kinds, inverse = np.unique(mounting, return_inverse=True)
        sums = np.zeros((len(kinds), *values.shape[1:]))
        np.add.at(sums, inverse, values)
        size = self.sizes[kinds].reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray((sums / size)[inverse])


def nested_anova(mountings: Sequence[str]) -> NestedAnova:
    """Return the analysis of variance of recordings (N,) by mounting (Searle et al. 1992, 3.6)."""
    kinds = {name: number for number, name in enumerate(dict.fromkeys(mountings))}
    mounting = np.array([kinds[name] for name in mountings])
    sizes, count, dof = np.bincount(mounting).astype(np.float64), len(mounting), len(kinds) - 1
    each = (count - float(np.sum(sizes**2)) / count) / dof if dof else np.nan
    return NestedAnova(mounting, sizes, count - len(kinds), dof, each)


@dataclass(frozen=True)
class _Scatter:
    """Covariances (2C, 2C) of relative values beyond the stated ones."""

    within: FloatArray
    between: FloatArray
    within_dof: int
    between_dof: int


def common_outputs(drives: Sequence[ExcitedLine]) -> list[str]:
    """Return the outputs that have a reading in all lines."""
    return [name for name in drives[0].channels if all(np.isfinite(drive.output(name)) for drive in drives)]


def unweighted_mean(values: Sequence[ComplexArray]) -> ComplexArray:
    """Return the mean (C,) of values, 1 for an output without a signal."""
    mean = np.mean(values, axis=0)
    return np.asarray(np.where(mean == 0.0, 1.0, mean))


def relative_to_mean(
    values: Sequence[tuple[ComplexArray, Uncertainty]], plain: ComplexArray
) -> list[tuple[ComplexArray, Uncertainty]]:
    """Return values and their uncertainties divided by constants (C,)."""
    factor = np.asarray(1.0 / plain[None], dtype=np.complex128)
    return [(value / plain, uncertainty.scaled(factor)) for value, uncertainty in values]


def split_covariance(
    values: Sequence[tuple[ComplexArray, Uncertainty]],
) -> tuple[FloatArray, list[tuple[list[int], FloatArray]]]:
    """Return individual covariances (N, 2C, 2C) and the effects (E, n, 2C) of shared unknowns."""
    acts: dict[str, list[tuple[int, FloatArray]]] = {}
    for n, (_, uncertainty) in enumerate(values):
        for influence in uncertainty.influences:
            acts.setdefault(influence.name, []).append((n, influence.effect[0]))
    alone: dict[int, list[FloatArray]] = {}
    groups: dict[tuple[int, ...], list[list[FloatArray]]] = {}
    for found in acts.values():
        rows, effects = tuple(n for n, _ in found), [effect for _, effect in found]
        if len(rows) == 1:
            alone.setdefault(rows[0], []).append(effects[0])
        else:
            groups.setdefault(rows, []).append(effects)
    individual = np.array(
        [np.sum([part.covariance[0] for part in uncertainty.random], axis=0) for _, uncertainty in values]
    )
    for n, effects in alone.items():
        individual[n] += np.array(effects).T @ np.array(effects)
    return individual, [(list(rows), np.array(several)) for rows, several in groups.items()]


def _components(values: Sequence[tuple[ComplexArray, Uncertainty]], mountings: Sequence[str]) -> _Scatter:
    """Return the variance components of a recording and of a mounting."""
    readings, forms = np.array([real_stack(value) for value, _ in values]), nested_anova(mountings)
    size = readings.shape[1]
    individual, shared = split_covariance(values)

    def mean_square(form: Callable[..., FloatArray], diagonal: FloatArray, dof: int) -> FloatArray:
        """Return the mean square of a projection, less its expectation by stated uncertainties."""
        stated = np.einsum("n,nij->ij", diagonal, individual)
        for rows, effect in shared:
            effects_by_row = effect.swapaxes(0, 1)
            stated += np.tensordot(effects_by_row, form(effects_by_row, np.array(rows)), axes=((0, 1), (0, 1)))
        return np.asarray((readings.T @ form(readings) - stated) / dof)

    def positive(matrix: FloatArray) -> FloatArray:
        """Return the nearest covariance of a symmetric matrix, with negative variances set to zero."""
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2.0)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)

    within = between = np.zeros((size, size))
    share = 1.0 / forms.sizes[forms.mounting_index]
    if forms.within_dof:
        within = positive(mean_square(forms.within, 1.0 - share, forms.within_dof))
    if forms.between_dof:
        whole = mean_square(forms.between, share - 1.0 / len(readings), forms.between_dof)
        between = positive((whole - within) / forms.each)
    return _Scatter(within, between, forms.within_dof, forms.between_dof)


def _weights(
    values: Sequence[tuple[ComplexArray, Uncertainty]], mountings: Sequence[str], scatter: _Scatter
) -> FloatArray:
    """Return the weights (N,) of recordings in the mean.

    Recordings of a mounting have the inverse of their individual variance, mountings that of their mean and of a new
    mounting, both in the channel of smallest uncertainty.
    """
    # Individual errors: noise, and unknowns of the recording.
    count = Counter(influence.name for _, uncertainty in values for influence in uncertainty.influences)
    individual = (Uncertainty(u.random, tuple(i for i in u.influences if count[i.name] == 1)) for _, u in values)
    variances = np.array([total_variance(uncertainty.covariance)[0] for uncertainty in individual])
    best = int(np.argmin(np.sum(variances, axis=0)))
    within, between = (total_variance(part[None])[0, best] for part in (scatter.within, scatter.between))
    variance = variances[:, best] + within
    if not np.all(variance > 0.0):
        return np.full(len(values), 1.0 / len(values))
    mounting, precision = nested_anova(mountings).mounting_index, 1.0 / variance
    total = np.bincount(mounting, precision)[mounting]
    weight = precision / total / (between + 1.0 / total)
    return np.asarray(weight / np.sum(weight))


def _of_mean(
    values: Sequence[tuple[ComplexArray, Uncertainty]],
    weight: FloatArray,
    mountings: Sequence[str],
    plain: ComplexArray,
) -> Uncertainty:
    """Return the uncertainty of the weighted mean: shared unknowns, and the scatter of groups.

    Groups are mountings, or recordings of the only mounting; a single recording has its stated uncertainty.
    """
    weighted = [u.scaled(np.full((1, len(plain)), w, np.complex128)) for w, (_, u) in zip(weight, values, strict=True)]
    total = Uncertainty(
        merge_contributions([part for one in weighted for part in one.random]),
        added_up(influence for one in weighted for influence in one.influences),
    )
    several = len(set(mountings)) > 1
    groups = list(mountings) if several else [str(mounting) for mounting in range(len(values))]
    kinds = list(dict.fromkeys(groups))
    if len(kinds) == 1:
        return total
    acts_on: dict[str, set[str]] = {}
    for group, (_, uncertainty) in zip(groups, values, strict=True):
        for influence in uncertainty.influences:
            acts_on.setdefault(influence.name, set()).add(group)
    shared = tuple(influence for influence in total.influences if len(acts_on[influence.name]) > 1)
    mounting, means = nested_anova(groups).mounting_index, np.zeros((len(kinds), 2 * len(plain)))
    share = np.bincount(mounting, weight)
    readings = np.array([real_stack(value / plain) for value, _ in values])
    np.add.at(means, mounting, (weight / share[mounting])[:, None] * readings)
    off = means - share @ means
    matrix = np.einsum("m,mi,mj->ij", share, off, off) / (len(kinds) - 1)
    design = real_stacked_diagonal(plain[None])[0]
    scattered = (design @ matrix @ design.T)[None]
    part = Contribution(BETWEEN if several else WITHIN, "A", scattered, np.array([len(kinds) - 1.0]))
    return Uncertainty((part, _phase_loss(np.array([value for value, _ in values]), weight)), shared)


def _bounds(
    weight: FloatArray, uncertainties: Sequence[Uncertainty], drives: Sequence[ExcitedLine]
) -> tuple[Contribution, ...]:
    """Return the contribution of bounds (unobserved motion, undetermined explanations) to a mean.

    They may be equal in all recordings and then do not average out: Σw·C bounds the covariance of a mean of fully
    correlated effects. `SECOND_ORDER` is a difference between recordings and is excluded.
    """
    parts = (
        replace(part, covariance=w * part.covariance)
        for w, uncertainty, drive in zip(weight, uncertainties, drives, strict=True)
        for part in uncertainty.random
        if part.label == EXPLANATIONS or (part.type == "B" and part.label != SECOND_ORDER and not all(drive.observed))
    )
    return merge_contributions(list(parts))


def _phase_loss(values: ComplexArray, weight: FloatArray) -> Contribution:
    """Return the possible loss of magnitude in a mean of values with different phases.

    The mean of values (N, C) with phase differences φ_n is short by Σw·φ²/2; noise does not shorten it. The scatter
    across the mean may be due to phases as far as it exceeds that along it: a bound, u = 1/√3 of it. A mean below its
    scatter gives no bound.
    """
    mean = weight @ values
    off = np.divide(values, mean, out=np.full_like(values, 2.0), where=mean != 0.0) - 1.0
    usable = weight @ np.abs(off) ** 2 < 1.0
    short = np.where(usable, np.maximum(weight @ (off.imag**2 - off.real**2), 0.0), 0.0) / 2.0
    along = real_stack(mean * short / np.sqrt(3.0))
    covariance = np.outer(along, along) * np.tile(np.eye(values.shape[1]), (2, 2))
    return Contribution(PHASE_DIFFERENCES, "B", covariance[None])
