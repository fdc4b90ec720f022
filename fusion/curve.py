"""One curve over frequency for every element of the sensitivity: values with U, relative to static, interpolated."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion.drive import Drive, over_lines
from fusion.interpolation import LEAST_POINTS, interpolation_weights
from fusion.load import LOAD_COMPONENTS
from fusion.matrix import MatrixFit
from fusion.repeats import LEVERS, SAME_FREQUENCY, Repeats, alike, mean_ratio
from fusion.sensitivity import driven_component
from fusion.uncertainty import Contribution, Influence, Uncertainty
from shaker._checks import ComplexArray, FloatArray, check_shape

INTERPOLATION = "interpolation"


@dataclass(frozen=True)
class Curve:
    """E elements of the sensitivity at K frequencies, ratios or elements of matrices.

    `elements`: channel and component of each; `value` (K, E), NaN where there is none; `uncertainty` of K lines, with
    names that hold between recordings, so that what frequencies share is known; `recordings`: those behind each line,
    none where it was interpolated.
    """

    kind: Literal["ratio", "matrix"]
    frequency_hz: FloatArray
    channels: tuple[str, ...]
    elements: tuple[tuple[int, int], ...]
    value: ComplexArray
    uncertainty: Uncertainty
    recordings: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        lines, count = len(self.frequency_hz), len(self.elements)
        check_shape("value", self.value, (lines, count))
        check_shape("uncertainty", self.uncertainty.random[0].covariance, (lines, 2 * count, 2 * count))
        if len(self.recordings) != lines:
            raise ValueError(f"recordings: expected {lines} lists, one per frequency, found {len(self.recordings)}")

    def name(self, element: int) -> str:
        """Return output and load of an element: `Fz/Fx`."""
        channel, component = self.elements[element]
        return f"{self.channels[channel]}/{LOAD_COMPONENTS[component]}"


def ratio_curves(drives: Iterable[Drive], capacity: Sequence[float] | None = None) -> tuple[Curve, ...]:
    """Return one curve per driven component: all outputs over it, every frequency the mean of its repeats.

    Recordings of one excitation count as repeats whatever their amplitude. Of several excitations that drive the same
    component at one frequency (other lever arms) the one with the least of other components is on the curve.
    """
    found: dict[int, list[tuple[float, tuple[Drive, ...]]]] = {}
    for group in alike(drives, capacity, amplitudes_apart=False):
        component = driven_component(group[0].direction, capacity)
        found.setdefault(component, []).append((_impurity(group, component), group))
    return tuple(_ratio_curve(component, _purest(found[component])) for component in sorted(found))


def matrix_curve(fits: Sequence[MatrixFit]) -> Curve:
    """Return the elements of matrices at several frequencies, of one sensor, as one curve."""
    ordered = sorted(fits, key=lambda fit: fit.frequency_hz)
    if not ordered or any(fit.channels != ordered[0].channels for fit in ordered):
        raise ValueError("fits: expected matrices of the same outputs, found others or none")
    channels = ordered[0].channels
    return Curve(
        kind="matrix",
        frequency_hz=np.array([fit.frequency_hz for fit in ordered]),
        channels=channels,
        elements=tuple((c, j) for c in range(len(channels)) for j in range(len(LOAD_COMPONENTS))),
        value=np.array([fit.value.ravel() for fit in ordered]),
        uncertainty=over_lines([fit.uncertainty for fit in ordered]),
        recordings=tuple(tuple(dict.fromkeys(item.recording for item in fit.agreement)) for fit in ordered),
    )


def relative_curve(curve: Curve, static: ArrayLike, u_static: float = 0.0) -> Curve | None:
    """Return the elements over their static sensitivity, of those that have one; None where none has.

    `static` (C, 6), in the order of the curve's channels; `u_static`: relative, one unknown per element that is the
    same at all frequencies.
    """
    table = np.asarray(static, dtype=np.float64)
    check_shape("static", table, (len(curve.channels), len(LOAD_COMPONENTS)))
    places = [e for e, element in enumerate(curve.elements) if table[element] != 0.0]
    if not places:
        return None
    chosen = replace(
        curve,
        elements=tuple(curve.elements[e] for e in places),
        value=curve.value[:, places],
        uncertainty=curve.uncertainty.at(places),
    )
    factor = 1.0 / np.array([table[element] for element in chosen.elements])
    value = chosen.value * factor
    scaled = chosen.uncertainty.scaled(np.broadcast_to(factor + 0.0j, value.shape))
    references = tuple(_reference(chosen, e, value, u_static) for e in range(len(places)) if u_static > 0.0)
    return replace(chosen, value=value, uncertainty=Uncertainty(scaled.random, (*scaled.influences, *references)))


def interpolate(curve: Curve, frequency_hz: FloatArray) -> Curve:
    """Return the curve at other frequencies within its range, with the uncertainty of the points and between them.

    Real and imaginary part of every element are weighted sums of its points (`fusion.interpolation`); what points share
    acts on the sum as on them, since the weights add up to 1, and noise averages as the weights let it. An element of
    fewer than five points has no value.
    """
    wanted = np.asarray(frequency_hz, dtype=np.float64)
    lines, count = curve.value.shape
    data = np.concatenate([curve.value.real, curve.value.imag], axis=1)
    noise = _point_variance(curve)
    weight, between = np.zeros((len(wanted), lines, 2 * count)), np.zeros((len(wanted), 2 * count))
    dof = np.inf
    for part in range(2 * count):
        usable = np.flatnonzero(np.isfinite(data[:, part]))
        if len(usable) < LEAST_POINTS:
            weight[:, :, part] = np.nan
            continue
        found = interpolation_weights(curve.frequency_hz[usable], data[usable, part], noise[usable, part], wanted)
        weight[:, usable, part], between[:, part], dof = found.weight, found.variance, min(dof, found.dof)
    sums = np.einsum("qki,ki->qi", weight, np.nan_to_num(data))
    uncertainty = _interpolated(curve, weight, between, dof)
    value = np.asarray(sums[:, :count] + 1j * sums[:, count:])
    return replace(curve, frequency_hz=wanted, value=value, uncertainty=uncertainty, recordings=((),) * len(wanted))


def _impurity(group: Sequence[Drive], component: int) -> float:
    """Largest other component of the load over the driven one, moments over 0.1 m."""
    size = np.abs(group[0].load) * LEVERS
    return float(np.max(np.delete(size, component)) / size[component])


def _purest(groups: Sequence[tuple[float, tuple[Drive, ...]]]) -> list[tuple[Drive, ...]]:
    """One group per frequency: the one with the least of other components."""
    chosen: list[tuple[float, tuple[Drive, ...]]] = []
    for impurity, group in groups:
        same = chosen and np.log(group[0].frequency_hz / chosen[-1][1][0].frequency_hz) <= SAME_FREQUENCY
        if not same:
            chosen.append((impurity, group))
        elif impurity < chosen[-1][0]:
            chosen[-1] = impurity, group
    return [group for _, group in chosen]


def _ratio_curve(component: int, groups: Sequence[tuple[Drive, ...]]) -> Curve:
    """Curve of all outputs over one component."""
    means = [mean_ratio(group, component) for group in groups]
    channels = tuple(dict.fromkeys(name for mean in means for name in mean.channels))
    parts = [_all_channels(mean, channels) for mean in means]
    return Curve(
        kind="ratio",
        frequency_hz=np.array([mean.frequency_hz for mean in means]),
        channels=channels,
        elements=tuple((c, component) for c in range(len(channels))),
        value=np.array([value for value, _ in parts]),
        uncertainty=over_lines([uncertainty for _, uncertainty in parts]),
        recordings=tuple(tuple(dict.fromkeys(mean.recordings)) for mean in means),
    )


def _all_channels(mean: Repeats, channels: Sequence[str]) -> tuple[ComplexArray, Uncertainty]:
    """Values and uncertainty in the order of all channels, NaN where this frequency has none."""
    have, want = len(mean.channels), len(channels)
    value = np.full(want, complex(np.nan, np.nan))
    matrix = np.zeros((2 * want, 2 * have))
    for column, name in enumerate(mean.channels):
        row = channels.index(name)
        value[row] = mean.value[column]
        matrix[row, column] = matrix[row + want, column + have] = 1.0
    found = mean.uncertainty.transformed(matrix[None])
    absent = np.tile(~np.isfinite(value), 2)
    first = found.random[0]
    hidden = np.where(absent[:, None] | absent, np.nan, first.covariance)
    return value, replace(found, random=(replace(first, covariance=hidden), *found.random[1:]))


def _reference(curve: Curve, element: int, value: ComplexArray, u_static: float) -> Influence:
    """The unknown of one element's static sensitivity: S/S₀ is too small where S₀ is too large."""
    change = np.zeros(value.shape, np.complex128)
    change[:, element] = -u_static * np.nan_to_num(value[:, element])
    effect = np.concatenate([change.real, change.imag], axis=1)
    return Influence(f"static sensitivity {curve.name(element)}", "static sensitivity", u_static, "1", effect, "rig")


def _point_variance(curve: Curve) -> FloatArray:
    """Variance (K, 2E) that is a point's own: noise, and unknowns that act on one frequency only."""
    own = np.sum([part.covariance.diagonal(axis1=1, axis2=2) for part in curve.uncertainty.random], axis=0)
    for influence in curve.uncertainty.influences:
        if np.count_nonzero(np.any(influence.effect != 0.0, axis=1)) == 1:
            own = own + influence.effect**2
    return np.asarray(own)


def _interpolated(curve: Curve, weight: FloatArray, between: FloatArray, dof: float) -> Uncertainty:
    """Uncertainty of weighted sums (Q, K, 2E) of the points, and of what lies between them (Q, 2E)."""
    size = np.abs(curve.value)
    size = np.where(size > 0.0, size, np.inf)
    random = [_averaged(part, weight, size) for part in curve.uncertainty.random]
    spread = between[:, :, None] * np.eye(between.shape[1])
    random.append(Contribution(INTERPOLATION, "A", spread, np.full(len(between), dof)))
    influences = tuple(
        replace(influence, effect=np.einsum("qki,ki->qi", weight, influence.effect))
        for influence in curve.uncertainty.influences
    )
    return Uncertainty(tuple(random), influences)


def _averaged(part: Contribution, weight: FloatArray, size: FloatArray) -> Contribution:
    """Noise of weighted sums of lines; its degrees of freedom by Welch and Satterthwaite over relative variances."""
    known = np.nan_to_num(part.covariance)
    covariance = np.einsum("qki,kij,qkj->qij", weight, known, weight, optimize=True)
    if part.dof is None:
        return replace(part, covariance=covariance)
    relative = known.diagonal(axis1=1, axis2=2) / np.tile(size, (1, 2)) ** 2
    share = np.einsum("qki,ki->qk", np.nan_to_num(weight) ** 2, relative)
    total, weighted = share.sum(axis=1), np.sum(share**2 / np.maximum(part.dof, 1.0), axis=1)
    dof = np.divide(total**2, weighted, out=np.full(len(total), np.inf), where=weighted > 0.0)
    return replace(part, covariance=covariance, dof=dof)
