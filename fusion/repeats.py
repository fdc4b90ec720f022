"""Recordings of one excitation again: their mean with what recordings and mountings scatter by."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fusion.drive import Drive
from fusion.notices import Notice
from fusion.sensitivity import driven_component
from fusion.system import BODY_SIZE_M, real_design
from fusion.uncertainty import Contribution, Uncertainty
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.phasor import real_stacked_diagonal

SAME_FREQUENCY = 1e-4
"""Relative difference of frequencies at which a sensitivity is the same."""
SAME_DIRECTION = 1e-3
SAME_LOAD = 0.05
"""Difference of any load component (moments over 0.1 m), relative to the driven one, within one excitation."""
WITHIN, BETWEEN = "repeatability", "mounting anew"
LEVERS = np.array([1.0, 1.0, 1.0, *np.full(3, 1.0 / BODY_SIZE_M)])


@dataclass(frozen=True)
class Repeats:
    """Mean ratio of outputs over the driven load of N recordings of one excitation.

    `component`: 0..5, of the load; `amplitude`: its mean. `value` (C,), `uncertainty` (K = 1) with names that hold
    between recordings; `recordings`, `mountings` (N,), `weight` (N,) in the mean. `within`, `between` (C,): relative
    standard deviation of a recording and of a mounting beyond what is stated for them, with `within_dof` (N - M) and
    `between_dof` (M - 1); NaN where there are no degrees of freedom.
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
    notices: tuple[Notice, ...]


def drive_ratio(drive: Drive, component: int, channels: Sequence[str]) -> tuple[ComplexArray, Uncertainty]:
    """Return output over one load component of one drive (C,), with names that hold between recordings (K = 1).

    dS = (dU - S·dL)/L; what outputs and load share acts on both.
    """
    of_load, of_outputs = drive.shared()
    places = [drive.channels.index(channel) for channel in channels]
    load = drive.load[component]
    ratio = drive.outputs[places] / load
    through = real_design(-ratio[:, None] / load)[None]
    upper = of_outputs.at(places).scaled(np.full((1, len(places)), 1.0 / load, dtype=np.complex128))
    return np.asarray(ratio), upper.plus(of_load.at([component]).transformed(through))


def find_repeats(
    drives: Iterable[Drive], capacity: Sequence[float] | None = None, *, amplitudes_apart: bool = True
) -> tuple[Repeats, ...]:
    """Return the drives in groups of one excitation, each with its mean, ascending in frequency.

    One excitation: frequencies within 1e-4, directions within 1e-3, and every load component (moments over 0.1 m)
    within 5 % of the driven one; with `amplitudes_apart` false after the loads have been scaled to one amplitude.
    """
    groups = alike(drives, capacity, amplitudes_apart=amplitudes_apart)
    return tuple(mean_ratio(group, driven_component(group[0].direction, capacity)) for group in groups)


def alike(
    drives: Iterable[Drive], capacity: Sequence[float] | None = None, *, amplitudes_apart: bool = True
) -> tuple[tuple[Drive, ...], ...]:
    """Return the drives in groups of one excitation, ascending in frequency."""
    groups: list[list[Drive]] = []
    for drive in sorted(drives, key=lambda drive: drive.frequency_hz):
        component = driven_component(drive.direction, capacity)
        if drive.load[component] == 0.0:
            continue
        match = next((g for g in groups if _same(g[0], drive, component, amplitudes_apart=amplitudes_apart)), None)
        if match is None:
            groups.append([drive])
        else:
            match.append(drive)
    return tuple(tuple(group) for group in groups)


def _same(first: Drive, other: Drive, component: int, *, amplitudes_apart: bool) -> bool:
    """Whether two drives are one excitation; phases follow the start of the recording, and a sign is one of them."""
    if abs(np.log(other.frequency_hz / first.frequency_hz)) > SAME_FREQUENCY:
        return False
    if len(first.direction) != len(other.direction):
        return False
    units = [np.array(drive.direction) / np.linalg.norm(drive.direction) for drive in (first, other)]
    if min(np.max(np.abs(units[0] - units[1])), np.max(np.abs(units[0] + units[1]))) > SAME_DIRECTION:
        return False
    loads = [np.abs(drive.load) * LEVERS for drive in (first, other)]
    if not amplitudes_apart:
        loads = [load / load[component] for load in loads]
    return bool(np.max(np.abs(loads[0] - loads[1])) <= SAME_LOAD * loads[0][component])


def mean_ratio(drives: Sequence[Drive], component: int) -> Repeats:
    """Return the mean over recordings of one excitation of output over a load component.

    One-way random effects, unbalanced: mean squares within and between M mountings, from which what is stated for
    them is taken off with all its correlations; what is left are variances of a recording (N - M degrees of freedom)
    and of a mounting (M - 1) beyond what is stated, none where negative (Searle, Casella & McCulloch 1992, Variance
    Components, 3.6). Recordings and mountings weigh by the inverse of their own variances in the best known
    channel; shared unknowns do not average away. Only channels with a reading in all recordings have a value.
    """
    usable = common_outputs(drives)
    if not usable:
        raise ValueError("drives: expected an output that all recordings of one excitation have, found none")
    found = [drive_ratio(drive, component, usable) for drive in drives]
    plain = plain_mean([value for value, _ in found])
    scaled = [(value / plain, relative_uncertainty(uncertainty, plain)) for value, uncertainty in found]
    mountings = [drive.mounting for drive in drives]
    scatter = _components(scaled, mountings)
    weight = _weights(scaled, mountings, scatter)
    value = np.einsum("n,nc->c", weight, np.array([value for value, _ in found]))
    uncertainty = _weighted_sum([uncertainty for _, uncertainty in found], weight)
    extra = _contributions(scatter, weight, mountings, plain)
    return Repeats(
        frequency_hz=float(np.mean([drive.frequency_hz for drive in drives])),
        direction=drives[0].direction,
        component=component,
        amplitude=float(np.mean([abs(drive.load[component]) for drive in drives])),
        channels=tuple(usable),
        value=value,
        uncertainty=replace(uncertainty, random=(*uncertainty.random, *extra)),
        recordings=tuple(drive.recording for drive in drives),
        mountings=tuple(mountings),
        weight=weight,
        within=_deviation(scatter.within, scatter.within_dof),
        between=_deviation(scatter.between, scatter.between_dof),
        within_dof=scatter.within_dof,
        between_dof=scatter.between_dof,
        notices=_notices(drives, scatter),
    )


class Nested(NamedTuple):
    """Quadratic forms (N, N) of N readings whose sums of squares are those within and between M mountings.

    `within_dof` N - M, `between_dof` M - 1; `each`: recordings per mounting in the expectation of the mean square
    between them, NaN of one mounting.
    """

    within: FloatArray
    between: FloatArray
    within_dof: int
    between_dof: int
    each: float


def nested(mountings: Sequence[str]) -> Nested:
    """Return the analysis of variance of recordings (N,) by the mounting of each (Searle et al. 1992, 3.6)."""
    count, kinds = len(mountings), list(dict.fromkeys(mountings))
    member = np.array([[mounting == kind for mounting in mountings] for kind in kinds], dtype=np.float64)
    sizes = member.sum(axis=1)
    own = member.T @ (member / sizes[:, None])
    whole = np.full((count, count), 1.0 / count)
    dof = len(kinds) - 1
    each = (count - float(np.sum(sizes**2)) / count) / dof if dof else np.nan
    return Nested(np.eye(count) - own, own - whole, count - len(kinds), dof, each)


@dataclass(frozen=True)
class _Scatter:
    """Covariances (2C, 2C) of relative values beyond what is stated: of a recording and of a mounting."""

    within: FloatArray
    between: FloatArray
    within_dof: int
    between_dof: int


def common_outputs(drives: Sequence[Drive]) -> list[str]:
    """Return the outputs that have a reading in all drives."""
    return [
        name
        for name in drives[0].channels
        if all(name in d.channels and np.isfinite(d.outputs[d.channels.index(name)]) for d in drives)
    ]


def plain_mean(values: Sequence[ComplexArray]) -> ComplexArray:
    """Return the mean (C,) that values are measured in, 1 for an output that is dead."""
    mean = np.mean(values, axis=0)
    return np.asarray(np.where(mean == 0.0, 1.0, mean))


def relative_uncertainty(uncertainty: Uncertainty, value: ComplexArray) -> Uncertainty:
    """Uncertainty of values divided by constants (C,)."""
    return uncertainty.scaled(np.asarray(1.0 / value[None], dtype=np.complex128))


def stack_values(values: Sequence[tuple[ComplexArray, Uncertainty]]) -> tuple[FloatArray, FloatArray]:
    """Real readings (N, 2C) and their joint covariance (N, 2C, N, 2C), what is shared included."""
    readings = np.array([np.concatenate([value.real, value.imag]) for value, _ in values])
    count, size = readings.shape
    covariance = np.zeros((count, size, count, size))
    names = {influence.name: None for _, uncertainty in values for influence in uncertainty.influences}
    effect = np.zeros((len(names), count, size))
    place = {name: number for number, name in enumerate(names)}
    for n, (_, uncertainty) in enumerate(values):
        covariance[n, :, n] = np.sum([part.covariance[0] for part in uncertainty.random], axis=0)
        for influence in uncertainty.influences:
            effect[place[influence.name], n] = influence.effect[0]
    return readings, covariance + np.einsum("eni,emj->nimj", effect, effect)


def _components(values: Sequence[tuple[ComplexArray, Uncertainty]], mountings: Sequence[str]) -> _Scatter:
    """Variance components of a recording and of a mounting by the analysis of variance."""
    readings, stated = stack_values(values)
    size, forms = readings.shape[1], nested(mountings)
    within = between = np.zeros((size, size))
    if forms.within_dof:
        within = _positive(_mean_square(readings, stated, forms.within, forms.within_dof))
    if forms.between_dof:
        square = _mean_square(readings, stated, forms.between, forms.between_dof)
        between = _positive((square - within) / forms.each)
    return _Scatter(within, between, forms.within_dof, forms.between_dof)


def _mean_square(readings: FloatArray, stated: FloatArray, form: FloatArray, dof: int) -> FloatArray:
    """Mean square (2C, 2C) of a quadratic form (N, N), less what stated uncertainties make of it."""
    observed = np.einsum("ni,nm,mj->ij", readings, form, readings)
    return np.asarray((observed - np.einsum("nm,nimj->ij", form, stated)) / dof)


def _positive(matrix: FloatArray) -> FloatArray:
    """Nearest covariance of a symmetric matrix: negative variances are none."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2.0)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _weights(
    values: Sequence[tuple[ComplexArray, Uncertainty]], mountings: Sequence[str], scatter: _Scatter
) -> FloatArray:
    """Weights (N,) of recordings in the mean: recordings of a mounting by the inverse of their own variance, mountings
    by that of what their recordings and mounting anew leave, both in the best known channel.
    """
    own = np.array([_own_variance(uncertainty) for _, uncertainty in values])
    best = int(np.argmin(np.sum(own, axis=0)))
    within, between = (_total(part)[best] for part in (scatter.within, scatter.between))
    variance = own[:, best] + within
    if not np.all(variance > 0.0):
        return np.full(len(values), 1.0 / len(values))
    weight = np.zeros(len(values))
    for kind in dict.fromkeys(mountings):
        rows = [place for place, mounting in enumerate(mountings) if mounting == kind]
        precision = 1.0 / variance[rows]
        weight[rows] = precision / np.sum(precision) / (between + 1.0 / np.sum(precision))
    return np.asarray(weight / np.sum(weight))


def _own_variance(uncertainty: Uncertainty) -> FloatArray:
    """Variance (C,) of Re and Im together from what no other recording shares: noise, and unknowns of the recording."""
    own = np.sum([part.covariance[0] for part in uncertainty.random], axis=0)
    for influence in uncertainty.influences:
        if influence.scope == "recording":
            own = own + np.outer(influence.effect[0], influence.effect[0])
    return _total(own)


def _total(matrix: FloatArray) -> FloatArray:
    """Sum (C,) of the variances of real and imaginary parts."""
    variance = np.diag(matrix)
    return np.asarray(variance[: len(variance) // 2] + variance[len(variance) // 2 :])


def _weighted_sum(parts: Sequence[Uncertainty], weight: FloatArray) -> Uncertainty:
    """Uncertainty of a sum of values (C,) with constant weights (N,)."""
    size = parts[0].random[0].covariance.shape[1] // 2
    total = parts[0].scaled(np.full((1, size), weight[0], dtype=np.complex128))
    for part, share in zip(parts[1:], weight[1:], strict=True):
        total = total.plus(part.scaled(np.full((1, size), share, dtype=np.complex128)))
    return total


def _contributions(
    scatter: _Scatter, weight: FloatArray, mountings: Sequence[str], plain: ComplexArray
) -> list[Contribution]:
    """What recordings and mountings scatter by beyond what is stated, in the mean."""
    shares = np.array([np.sum(weight[[m == kind for m in mountings]]) for kind in dict.fromkeys(mountings)])
    turn = real_stacked_diagonal(plain[None])[0]
    parts = (
        (WITHIN, scatter.within, float(np.sum(weight**2)), scatter.within_dof),
        (BETWEEN, scatter.between, float(np.sum(shares**2)), scatter.between_dof),
    )
    return [
        Contribution(label, "A", (turn @ (factor * matrix) @ turn.T)[None], np.array([float(dof)]))
        for label, matrix, factor, dof in parts
        if dof and np.any(matrix)
    ]


def _deviation(matrix: FloatArray, dof: int) -> FloatArray:
    """Relative standard deviation (C,) of the whole complex value: root of the sum of both parts' variances."""
    variance = _total(matrix)
    return np.asarray(np.sqrt(variance) if dof else np.full_like(variance, np.nan))


def _notices(drives: Sequence[Drive], scatter: _Scatter) -> tuple[Notice, ...]:
    """Say where repeats tell nothing of mounting anew."""
    if len(drives) < 2 or scatter.between_dof:
        return ()
    text = (
        f"{len(drives)} recordings at {drives[0].frequency_hz:.6g} Hz are of one mounting: what mounting anew changes "
        f"is not in U beyond what is stated of positions and directions"
    )
    return (Notice("info", text, "repeats"),)
