"""Sensitivity curves over frequency: linearity, interpolation and values relative to static."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fusion.campaign.excited_line import ExcitedLine, join_lines
from fusion.campaign.matrix import MatrixFit
from fusion.campaign.repeats import (
    BETWEEN,
    LEVERS,
    SAME_FREQUENCY,
    Mean,
    RepeatMean,
    common_outputs,
    drive_value,
    drive_values,
    group_excitations,
    known_matrix_of,
    mean_ratio,
    relative_to_mean,
    split_covariance,
    unweighted_mean,
)
from fusion.estimation.coverage import Polar, region, region_matrix
from fusion.estimation.uncertainty import Contribution, Uncertainty, as_complex, over_static, polar_elements, real_stack
from fusion.sensitivity.ratio import StatedMatrix, driven_component
from shaker.labels import LOAD_COMPONENTS
from shaker.sine.phasor import real_stacked
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, check_shape

# Linearity: whether the ratio of outputs over load changes with the amplitude of the load.


SERIES = 1.2
"""Smallest ratio of the largest to the smallest amplitude of a series."""


@dataclass(frozen=True)
class Linearity:
    """Change of the sensor's elements, or ratios, with amplitude in N recordings of one excitation.

    `amplitude` (N,) of the driven load; `slope` (C,): relative change per N or N·m, complex. `change` (C,): from the
    smallest to the largest amplitude, with `covariance` (C, 2, 2) of (Re, Im) and `dof`. `linear` (C,): whether its 95
    % region includes zero. `kind`: ratio or element.
    """

    frequency_hz: float
    direction: tuple[float, ...]
    component: int
    channels: tuple[str, ...]
    recordings: tuple[str, ...]
    amplitude: FloatArray
    slope: ComplexArray
    change: ComplexArray
    covariance: FloatArray
    dof: float
    linear: BoolArray
    kind: Literal["ratio", "element"] = "ratio"


def find_linearity(
    drives: Iterable[ExcitedLine], capacity: Sequence[float] | None = None, stated: StatedMatrix | None = None
) -> tuple[Linearity, ...]:
    """Return the linearity of every excitation whose amplitudes have a ratio of 1.2 or more.

    It is that of the sensor's elements if the stated matrix gives them, as for means and curves.
    """
    found = []
    for group in group_excitations(drives, capacity, separate_amplitudes=False):
        component = driven_component(group[0].direction, capacity)
        amplitude = [abs(drive.load[component]) for drive in group]
        if max(amplitude) >= SERIES * min(amplitude):
            found.append(linearity(group, component, stated))
    return tuple(found)


def linearity(drives: Sequence[ExcitedLine], component: int, stated: StatedMatrix | None = None) -> Linearity:
    """Return the slope of elements or ratios over amplitude by generalised least squares.

    S_n/S̄ = a + b·(A_n - Ā), slope b/a. Common scale errors cancel, since their covariance is included. Scatter beyond
    the stated uncertainties enlarges the covariance by chi-square per degree of freedom (Birge 1932, Phys. Rev. 40,
    207). Only outputs with a reading other than zero in all recordings have a slope.
    """
    channels = [name for name in common_outputs(drives) if all(drive.output(name) != 0.0 for drive in drives)]
    matrix = known_matrix_of(drives, component, stated)
    if matrix is not None:  # other outputs would be ratios among elements
        channels = [matrix.channels[row] for row in matrix.rows if matrix.channels[row] in channels]
    kind, found = drive_values(drives, component, stated, channels)
    plain = unweighted_mean([value for value, _ in found])
    scaled = relative_to_mean(found, plain)
    readings = np.array([real_stack(value) for value, _ in scaled])
    individual, shared = split_covariance(scaled)
    amplitude = np.array([abs(drive.load[component]) for drive in drives])
    width = float(np.ptp(amplitude))
    dof = 2 * (len(drives) - 2)
    fits = [
        _slope(readings, individual, shared, (amplitude - amplitude.mean()) / width, c) for c in range(len(channels))
    ]
    change = np.array([fit[0] for fit in fits])
    covariance = np.array([fit[1] * (max(1.0, fit[2] / dof) if dof else 1.0) for fit in fits])
    freedom = float(dof) if dof and any(fit[2] > dof for fit in fits) else np.inf
    regions = region_matrix(change, covariance, (freedom, freedom))
    linear = np.array([region(complex(v), m).holds_zero for v, m in zip(change, regions, strict=True)])
    return Linearity(
        frequency_hz=float(np.mean([drive.frequency_hz for drive in drives])),
        direction=drives[0].direction,
        component=component,
        channels=tuple(channels),
        recordings=tuple(drive.recording for drive in drives),
        amplitude=amplitude,
        slope=np.asarray(change / width, dtype=np.complex128),
        change=change,
        covariance=covariance,
        dof=freedom,
        linear=linear,
        kind=kind,
    )


def _slope(
    readings: FloatArray, individual: FloatArray, shared: Sequence[Shared], abscissa: FloatArray, c: int
) -> tuple[complex, FloatArray, float]:
    """Return the relative slope of channel c, its covariance (2, 2), and chi-square.

    Errors that all readings share are unknowns of the fit with a prior of zero ± 1 each; those that some share are
    blocks of the covariance. Time and memory grow with the number of readings, not with its square.
    """
    count, both = len(readings), np.array([c, c + readings.shape[1] // 2])
    individual = individual[:, both[:, None], both]
    effects = [(rows, effect[:, :, both]) for rows, effect in shared]
    total = np.trace(individual, axis1=1, axis2=2).sum() + sum(float(np.sum(effect**2)) for _, effect in effects)
    individual = individual + np.eye(2) * 1e-12 * total / (2 * count)
    wide = [effect.reshape(len(effect), -1).T for rows, effect in effects if len(rows) == count]
    design = np.concatenate([np.kron(np.ones((count, 1)), np.eye(2)), np.kron(abscissa[:, None], np.eye(2))], axis=1)
    columns = np.column_stack([*wide, design, readings[:, both].ravel()])
    for rows, narrow in _blocks(count, [item for item in effects if len(item[0]) < count]):
        index = {row: number for number, row in enumerate(rows)}
        block = np.zeros((len(rows), 2, len(rows), 2))
        block[range(len(rows)), :, range(len(rows))] = individual[rows]
        for acting, effect in narrow:
            at = [index[row] for row in acting]
            block[np.ix_(at, range(2), at)] += np.einsum("eni,emj->nimj", effect, effect)
        lines = (2 * np.array(rows)[:, None] + np.arange(2)).ravel()
        root = np.linalg.cholesky(block.reshape(2 * len(rows), -1))
        columns[lines] = solve_triangular(root, columns[lines], lower=True)
    free = columns.shape[1] - 5
    upper = np.asarray(np.linalg.qr(np.concatenate([columns, np.eye(free, free + 5)]), mode="r"))
    inverse = np.linalg.inv(upper[free : free + 4, free : free + 4])
    unknowns, covariance = inverse @ upper[free : free + 4, -1], inverse @ inverse.T
    middle, step = complex(unknowns[0], unknowns[1]), complex(unknowns[2], unknowns[3])
    slope = step / middle
    jacobian = np.concatenate(
        [real_stacked(np.array([[-slope / middle]])), real_stacked(np.array([[1.0 / middle]]))], 1
    )
    return slope, jacobian @ covariance @ jacobian.T, float(np.sum(upper[free + 4 :, -1] ** 2))


Shared = tuple[list[int], FloatArray]
"""Rows of the readings that share unknowns, and the effects on them."""


def _blocks(count: int, shared: Sequence[Shared]) -> list[tuple[list[int], list[Shared]]]:
    """Return all `count` readings in blocks without shared errors between them."""
    pairs = [(rows[0], row) for rows, _ in shared for row in rows]
    first, other = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(pairs)), (first, other)), shape=(count, count))
    label = connected_components(graph, directed=False)[1].tolist()
    blocks: dict[int, tuple[list[int], list[Shared]]] = {}
    for row, block in enumerate(label):
        blocks.setdefault(block, ([], []))[0].append(row)
    for item in shared:
        blocks[label[item[0][0]]][1].append(item)
    return list(blocks.values())


# Interpolation of noisy values over frequency, with its uncertainty between the points.


MIN_POINTS = 5
"""Smallest number of points of an interpolation: three for the trend, two for the process."""
_LENGTHS = np.geomspace(0.05, 10.0, 6)
"""Correlation lengths of the first grid, in units of the range of ln f."""
_SIZES = np.geomspace(1e-6, 1.0, 7)
"""Standard deviations of the first grid, in units of the values."""
_JITTER = 1e-9
"""Standard deviation in units of the values that keeps matrices of noiseless points regular."""
_DIGITS = 1e-13
"""Relative variance added to the diagonal for numerical stability."""


@dataclass(frozen=True)
class Weights:
    """Weights (Q, K) of K points in the values at Q frequencies.

    Rows have the sum 1. `variance` (Q,): of the interpolation, in squares of the values' unit; `dof`: of its estimate.
    """

    weight: FloatArray
    variance: FloatArray
    dof: float


def interpolation_weights(
    frequency_hz: FloatArray, value: FloatArray, variance: FloatArray, target_hz: FloatArray
) -> Weights:
    """Return the weights of values (K,) with random `variance` (K,) for other frequencies (Q,).

    Universal kriging over ln f. The trend is a parabola in f, as stiffness, mass and damping give far below a
    resonance. The remainder is a stationary process of Matérn's kind with ν = 5/2 (Rasmussen & Williams 2006, Gaussian
    Processes, 2.7 and eq. 4.17). Its size and length follow from restricted maximum likelihood. If left-out points are
    predicted worse than that (mean of their normalised squares, ibid. eq. 5.12), its variance is enlarged.
    """
    if len(frequency_hz) < MIN_POINTS:
        raise ValueError(f"frequency_hz: expected at least {MIN_POINTS} points, found {len(frequency_hz)}")
    low, high = float(np.min(frequency_hz)), float(np.max(frequency_hz))
    outside = target_hz[(target_hz < low) | (target_hz > high)]
    if len(outside):
        raise ValueError(f"target_hz: expected {low:g} to {high:g} Hz, the range of the points, found {outside[0]:g}")
    largest = float(np.max(np.abs(value)))
    size = largest if largest > 0.0 else 1.0
    data = value[:, None] / size
    noise = variance / size**2 + _JITTER**2
    # Columns 1, f, f² of a trend.
    trend, target_trend = (
        np.stack([(f / high) ** power for power in range(3)], axis=1) for f in (frequency_hz, target_hz)
    )
    position, target = np.log(frequency_hz), np.log(target_hz)
    distance = np.abs(position[:, None] - position)
    contrasts = np.linalg.qr(trend, mode="complete")[0][:, trend.shape[1] :]
    best = _restricted_maximum(distance, contrasts, data, noise)
    covariance = _matern(distance, best)
    across = _matern(np.abs(target[:, None] - position), best)
    readings = covariance + np.diag(noise + _DIGITS * np.exp(2.0 * best[0]))
    projector = contrasts @ np.linalg.solve(contrasts.T @ readings @ contrasts, contrasts.T)
    plain = target_trend @ np.linalg.pinv(trend)
    weight = plain + (across - plain @ readings) @ projector
    between = np.exp(2.0 * best[0]) - 2.0 * np.sum(weight * across, axis=1)
    between = np.maximum(between + np.einsum("qk,kl,ql->q", weight, covariance, weight), 0.0)
    left_out = np.mean((projector @ data) ** 2 / np.diag(projector)[:, None])
    return Weights(weight, max(1.0, float(left_out)) * between * size**2, float(contrasts.shape[1]))


def _matern(distance: FloatArray, log_parameters: FloatArray) -> FloatArray:
    """Return the Matérn covariance, ν = 5/2, for the logarithms of standard deviation and length."""
    size, length = np.exp(log_parameters)
    ratio = np.sqrt(5.0) * distance / length
    return np.asarray(size**2 * (1.0 + ratio + ratio**2 / 3.0) * np.exp(-ratio))


def _restricted_maximum(distance: FloatArray, contrasts: FloatArray, data: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the logarithms of size and length of greatest restricted likelihood."""
    from scipy.optimize import minimize

    span = float(np.max(distance))
    bounds = np.log([[1e-9, 10.0], [_LENGTHS[0] * span, _LENGTHS[-1] * span]])
    left = contrasts.T @ data

    def cost(parameters: FloatArray) -> float:
        """Return minus twice the log-likelihood of the contrasts, up to a constant."""
        inside = np.clip(parameters, bounds[:, 0], bounds[:, 1])
        readings = _matern(distance, inside) + np.diag(noise + _DIGITS * np.exp(2.0 * inside[0]))
        root = np.linalg.cholesky(contrasts.T @ readings @ contrasts)
        fit = 2.0 * np.sum(np.log(np.diag(root))) + np.sum(np.linalg.solve(root, left) ** 2)
        return float(fit) + float(np.sum((parameters - inside) ** 2))

    grid = [np.log([size, length * span]) for size in _SIZES for length in _LENGTHS]
    start = min(grid, key=cost)
    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-3, "maxiter": 100})
    return np.asarray(np.clip(best.x, bounds[:, 0], bounds[:, 1]))


# One curve over frequency for every element of the sensitivity: values with U, relative to static, interpolated.


INTERPOLATION = "interpolation"


@dataclass(frozen=True)
class SensitivityCurve:
    """E elements of the sensitivity at K frequencies.

    `kind`: ratios, elements of single recordings, or of matrices.

    `elements`: channel and component of each; `value` (K, E), NaN if there is none; `uncertainty` of K lines with
    campaign-wide names, which includes correlations between frequencies; `recordings`: those of each line, empty if
    interpolated.
    """

    kind: Literal["ratio", "element", "matrix"]
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


def ratio_curves(
    drives: Iterable[ExcitedLine],
    capacity: Sequence[float] | None = None,
    stated: StatedMatrix | None = None,
    mean: Mean = mean_ratio,
) -> tuple[SensitivityCurve, ...]:
    """Return one curve per driven component: all outputs over it, averaged over repeats.

    With a `stated` matrix, curves of the sensor's elements are returned where it allows them. Recordings of one
    excitation are repeats whatever their amplitude. If several excitations drive the same component at one frequency
    (other lever arms), the one with the smallest other components is used. `mean`: replaces `mean_ratio`
    (`cached_mean_ratio`).
    """
    groups: dict[int, list[tuple[float, tuple[ExcitedLine, ...]]]] = {}
    for group in group_excitations(drives, capacity, separate_amplitudes=False):
        component = driven_component(group[0].direction, capacity)
        # Largest other component of the load over the driven one, moments over 0.1 m.
        size = np.abs(group[0].load) * LEVERS
        impurity = float(np.max(np.delete(size, component)) / size[component])
        chosen = groups.setdefault(component, [])
        if not chosen or np.log(group[0].frequency_hz / chosen[-1][1][0].frequency_hz) > SAME_FREQUENCY:
            chosen.append((impurity, group))
        elif impurity < chosen[-1][0]:
            chosen[-1] = impurity, group
    curves = []
    for j in sorted(groups):
        matrices = [(group, known_matrix_of(group, j, stated)) for _, group in groups[j]]
        means = [mean(group, j, matrix) for group, matrix in matrices if (matrix is None) == (stated is None)]
        if means:
            curves.append(_ratio_curve(j, means))
    return tuple(curves)


def matrix_curve(fits: Sequence[MatrixFit]) -> SensitivityCurve:
    """Return the elements of matrices of one sensor at several frequencies as one curve."""
    ordered = sorted(fits, key=lambda fit: fit.frequency_hz)
    if not ordered or any(fit.channels != ordered[0].channels for fit in ordered):
        raise ValueError("fits: expected matrices of the same outputs, found others or none")
    channels = ordered[0].channels
    return SensitivityCurve(
        kind="matrix",
        frequency_hz=np.array([fit.frequency_hz for fit in ordered]),
        channels=channels,
        elements=tuple((c, j) for c in range(len(channels)) for j in range(len(LOAD_COMPONENTS))),
        value=np.array([fit.value.ravel() for fit in ordered]),
        uncertainty=join_lines([fit.uncertainty for fit in ordered]),
        recordings=tuple(tuple(dict.fromkeys(item.recording for item in fit.agreement)) for fit in ordered),
    )


def relative_curve(curve: SensitivityCurve, static: ArrayLike, u_static: ArrayLike) -> SensitivityCurve | None:
    """Return the elements over their static sensitivity; None if no element has one.

    `static` (C, 6), in the order of the curve's channels, with standard uncertainties `u_static` (C, 6).
    """
    table, u_table = np.asarray(static, dtype=np.float64), np.asarray(u_static, dtype=np.float64)
    check_shape("static", table, (len(curve.channels), len(LOAD_COMPONENTS)))
    indices = [e for e, element in enumerate(curve.elements) if table[element] != 0.0]
    if not indices:
        return None
    chosen = replace(
        curve,
        elements=tuple(curve.elements[e] for e in indices),
        value=curve.value[:, indices],
        uncertainty=curve.uncertainty.at(indices),
    )
    rows, columns = np.transpose(chosen.elements)
    names = [chosen.name(e) for e in range(len(indices))]
    stated = table[rows, columns], u_table[rows, columns]
    value, uncertainty = over_static(chosen.value, chosen.uncertainty, *stated, names)
    return replace(chosen, value=value, uncertainty=uncertainty)


def interpolate(curve: SensitivityCurve, frequency_hz: FloatArray) -> SensitivityCurve:
    """Return the curve at other frequencies within its range, with its uncertainty.

    Real and imaginary part of every element are weighted sums of its points (`interpolation_weights`). Shared errors
    act on the sum as on the points, since the weights add up to 1; noise averages according to the weights. An element
    of fewer than five points has no value.
    """
    target_hz = np.asarray(frequency_hz, dtype=np.float64)
    lines, count = curve.value.shape
    data = real_stack(curve.value)
    # Individual variance of a point: noise, and unknowns that act on one frequency only.
    noise = np.sum([part.covariance.diagonal(axis1=1, axis2=2) for part in curve.uncertainty.random], axis=0)
    for influence in curve.uncertainty.influences:
        if np.count_nonzero(np.any(influence.effect != 0.0, axis=1)) == 1:
            noise = noise + influence.effect**2
    weight, between = np.zeros((len(target_hz), lines, 2 * count)), np.zeros((len(target_hz), 2 * count))
    dof = np.inf
    for part in range(2 * count):
        usable = np.flatnonzero(np.isfinite(data[:, part]))
        if len(usable) < MIN_POINTS:
            weight[:, :, part] = np.nan
            continue
        found = interpolation_weights(curve.frequency_hz[usable], data[usable, part], noise[usable, part], target_hz)
        weight[:, usable, part], between[:, part], dof = found.weight, found.variance, min(dof, found.dof)
    sums = np.einsum("qki,ki->qi", weight, np.nan_to_num(data))
    uncertainty = _interpolated(curve, weight, between, dof)
    return replace(
        curve,
        frequency_hz=target_hz,
        value=as_complex(sums),
        uncertainty=uncertainty,
        recordings=((),) * len(target_hz),
    )


def _ratio_curve(component: int, means: Sequence[RepeatMean]) -> SensitivityCurve:
    """Return the curve of all outputs over one component."""
    channels = tuple(dict.fromkeys(name for mean in means for name in mean.channels))
    parts = [_all_channels(mean, channels) for mean in means]
    return SensitivityCurve(
        kind=means[0].kind,
        frequency_hz=np.array([mean.frequency_hz for mean in means]),
        channels=channels,
        elements=tuple((c, component) for c in range(len(channels))),
        value=np.array([value for value, _ in parts]),
        uncertainty=join_lines([uncertainty for _, uncertainty in parts]),
        recordings=tuple(tuple(dict.fromkeys(mean.recordings)) for mean in means),
    )


def _all_channels(mean: RepeatMean, channels: Sequence[str]) -> tuple[ComplexArray, Uncertainty]:
    """Return values and uncertainty in the order of all channels, NaN if missing."""
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


def _interpolated(curve: SensitivityCurve, weight: FloatArray, between: FloatArray, dof: float) -> Uncertainty:
    """Return the uncertainty of weighted sums (Q, K, 2E) of points, and of the interpolation."""
    size = np.abs(curve.value)
    size = np.where(size > 0.0, size, np.inf)
    random = [_averaged(part, weight, size) for part in curve.uncertainty.random]
    spread = between[:, :, None] * np.eye(between.shape[1])
    random.append(Contribution(INTERPOLATION, "A", spread, np.full(len(between), dof)))
    shared = curve.uncertainty.influences
    influences = tuple(i.acting(np.einsum("qki,ki->qi", weight, i.effect)) for i in shared)
    return Uncertainty(tuple(random), influences)


def _averaged(part: Contribution, weight: FloatArray, size: FloatArray) -> Contribution:
    """Return the noise of weighted sums of lines, with degrees of freedom by Welch–Satterthwaite.

    The degrees of freedom use relative variances. Differences of mountings may be equal at all frequencies of a
    mounting, such as a position error: they do not average out, (Σ w·e)² ≤ Σ|w|·Σ|w|·e².
    """
    covariances = np.nan_to_num(part.covariance)
    if part.label == BETWEEN:
        size_of = np.abs(weight)
        weight = np.sqrt(size_of * np.sum(size_of, axis=1, keepdims=True))
    covariance = np.einsum("qki,kij,qkj->qij", weight, covariances, weight, optimize=True)
    if part.dof is None:
        return replace(part, covariance=covariance)
    relative = covariances.diagonal(axis1=1, axis2=2) / np.tile(size, (1, 2)) ** 2
    share = np.einsum("qki,ki->qk", np.nan_to_num(weight) ** 2, relative)
    total, weighted = share.sum(axis=1), np.sum(share**2 / np.maximum(part.dof, 1.0), axis=1)
    dof = np.divide(total**2, weighted, out=np.full(len(total), np.inf), where=weighted > 0.0)
    return replace(part, covariance=covariance, dof=dof)


# The points of a curve: magnitude and phase of every element at every frequency, and of single recordings.


@dataclass(frozen=True)
class CurvePoint:
    """One element of the sensitivity at one frequency.

    `channel` and `component` by name; `element`: the value; `relative`: over its static sensitivity, None if that is
    not stated; number of `recordings` and `mountings`; `kind`: ratio, element or matrix.
    """

    frequency_hz: float
    channel: str
    component: str
    unit: str
    element: Polar
    relative: Polar | None
    recordings: int
    mountings: int
    kind: str


def single_points(
    curve: SensitivityCurve, element: int, drives: Iterable[ExcitedLine], stated: StatedMatrix | None = None
) -> list[tuple[float, str, Polar]]:
    """Return frequency, mounting and value of every recording in one element of a curve."""
    c, component = curve.elements[element]
    channel = curve.channels[c]
    contributing = {(name, k) for k, names in enumerate(curve.recordings) for name in names}
    found = []
    for drive in drives:
        line = int(np.argmin(np.abs(curve.frequency_hz - drive.frequency_hz)))
        if (drive.recording, line) in contributing and channel in drive.channels:
            matrix = known_matrix_of([drive], component, stated) if curve.kind == "element" else None
            value, uncertainty = drive_value(drive, component, [channel], matrix)
            ((point,),) = polar_elements(value[None], uncertainty)
            if point is not None:
                found.append((drive.frequency_hz, drive.mounting, point))
    return found


def curve_elements(curve: SensitivityCurve) -> list[list[Polar | None]]:
    """Return magnitude and phase of every element (K lines of E), or None."""
    return polar_elements(curve.value, curve.uncertainty)
