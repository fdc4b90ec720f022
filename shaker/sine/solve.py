"""Least-squares sines with free frequencies, drift, decay and spike removal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Literal

import numpy as np

from shaker.sine.aliasing import alias_frequency, condition_number, nearest_grid, sampling_grid
from shaker.sine.noise import LineNoise, line_noise, neighbour_bins, noise_of_ordinates
from shaker.sine.normal_equations import (
    LONG,
    Demodulator,
    SineColumns,
    SineNormalEquations,
    SineSamples,
    as_complex,
    check_condition,
    normal_equations,
    residuals,
)
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import Notice

_STEPS = 40  # Gauss-Newton steps at most
_CONVERGED = 1e-3  # of the standard uncertainty: the last step is taken on the exact residual
_MIN_ROTATION = 1e-9  # rad: a step that turns the ends of the record by less is the last, too
_FARTHEST = 2.0  # rad by which one step may turn the ends of the record against its middle
_ROUNDING = 1e-14  # of a channel's power: below it, differences of sums are rounding
_SINGULAR = 1e-12  # smallest eigenvalue of a scaled Hessian, near rounding


@dataclass(frozen=True)
class SineModel:
    """Terms of a fit in addition to amplitudes, phases and an offset.

    Attributes
    ----------
    drift : fit a linear drift.
    free : a label per line; lines with the same label share one relative change of frequency, as harmonics of one
        generator do. -1 fixes a frequency; None fixes all.
    decay : lines decay as exp(-δt): "none", "common" for one rate, "each" for individual rates.
    robust : leave out and report rows with an outlying residual; Gaussian noise loses none in 99 of 100 records.

    Examples
    --------
    >>> from shaker import SineModel
    >>> SineModel(drift=True, free=(0, 0))  # a fundamental and its harmonic at an unknown frequency
    SineModel(drift=True, free=(0, 0), decay='none', robust=False)
    """

    drift: bool = False
    free: tuple[int, ...] | None = None
    decay: Literal["none", "common", "each"] = "none"
    robust: bool = False

    def exponents(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the derivative (K, Q) of s = -δ + jω by frequencies and δ."""
        lines = len(frequency_hz)
        labels = np.full(lines, -1) if self.free is None else np.asarray(self.free)
        if labels.shape != (lines,):
            raise ValueError(f"free: expected {lines} labels, one per line, found {len(labels)}")
        groups = [(labels == label) * (2j * np.pi * frequency_hz) for label in np.unique(labels[labels >= 0])]
        decays = {"none": [], "common": [-np.ones(lines)], "each": list(-np.eye(lines))}[self.decay]
        return np.array([*groups, *decays], dtype=np.complex128).reshape(-1, lines).T


@dataclass(frozen=True)
class SineSystem:
    """Normal equations solved for the linear parameters.

    Attributes
    ----------
    gram : (D, D, P', P'), of all columns; D = 1 where all channels have the same weights, else C.
    inverse : (D, P, P), for the P linear columns.
    project : (D, P', 2K), combines columns to slopes orthogonal to the linear ones.
    condition : condition number of the linear columns at unit length.
    """

    gram: FloatArray
    inverse: FloatArray
    project: FloatArray
    condition: float

    @property
    def linear(self) -> int:
        """Number of linear parameters."""
        return int(self.inverse.shape[1])

    def coefficients(self, right: FloatArray) -> FloatArray:
        """Return the linear parameters (P, C) of right-hand sides (P', C)."""
        return _products(self.inverse, right[: self.linear])

    def information(self) -> FloatArray:
        """Return the products (D, D, 2K, 2K) of projected slopes of two channels."""
        return np.asarray(self.project.swapaxes(1, 2)[:, None] @ self.gram @ self.project[None])

    def spread(self) -> FloatArray:
        """Return the covariance G⁻¹·XᵀX·G⁻¹ of linear parameters for unit noise, between channels."""
        gram = self.gram[:, :, : self.linear, : self.linear]
        return np.asarray(self.inverse[:, None] @ gram @ self.inverse[None])


def _products(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Return the products (N, C) of one matrix, or one per channel, and columns."""
    if len(matrices) == 1:
        return np.asarray(matrices[0] @ right)
    return np.asarray((matrices @ right.T[:, :, None])[:, :, 0].T)


def solve_linear(normal: SineNormalEquations, columns: SineColumns) -> SineSystem:
    """Invert the normal equations of the linear columns, scaled to unit length."""
    lines, linear = columns.lines, columns.linear
    diagonal_blocks = np.einsum("ddpq->dpq", normal.gram)
    squares = np.einsum("dpp->dp", diagonal_blocks)[:, :linear].copy()
    pairs = squares[:, : 2 * lines].reshape(len(diagonal_blocks), lines, 2)
    # Both columns of a line by the same factor: at zero or the Nyquist frequency one of them vanishes, and must.
    squares[:, : 2 * lines] = np.repeat(pairs.mean(axis=2), 2, axis=1)
    scale = 1.0 / np.sqrt(squares)
    scaled = diagonal_blocks[:, :linear, :linear] * scale[:, :, None] * scale[:, None, :]
    condition = max(condition_number(matrix) for matrix in scaled)
    check_condition(condition)
    inverse = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    inverse = (inverse + inverse.swapaxes(1, 2)) / 2.0
    carried = -inverse @ diagonal_blocks[:, :linear, linear:]
    rest = np.broadcast_to(
        np.eye(diagonal_blocks.shape[1] - linear),
        (len(diagonal_blocks), diagonal_blocks.shape[1] - linear, diagonal_blocks.shape[1] - linear),
    )
    return SineSystem(normal.gram, inverse, np.concatenate([carried, rest], axis=1), condition)


@dataclass(frozen=True)
class GaussNewtonStep:
    """A Gauss-Newton step: `change` (Q,) of the unknowns, `inverse` (Q, Q) of the Hessian.

    `derivative` (C, 2K, Q) is that of the slopes' coefficients in each channel; `pull` is the same over its noise
    variance.
    """

    change: FloatArray
    inverse: FloatArray
    derivative: FloatArray
    pull: FloatArray


def frequency_step(
    system: SineSystem, right: FloatArray, value: ComplexArray, exponents: ComplexArray, variance: FloatArray
) -> GaussNewtonStep:
    """Return the step of frequencies and decay rates.

    Gauss-Newton on the nonlinear unknowns alone, with the linear ones projected out (variable projection; Golub and
    Pereyra 1973, with Kaufman's simplification). `right` (P', C) are products with values or residuals. Channels are
    weighted by their noise variance (C,).
    """
    product = value.T[:, :, None] * exponents[None]
    derivative = np.stack([product.real, product.imag], axis=2).reshape(len(variance), -1, exponents.shape[1])
    weight = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0.0)
    pull = derivative * weight[:, None, None]
    diagonal_blocks = np.einsum("ddpq->dpq", system.information())
    hessian = np.sum(pull.swapaxes(1, 2) @ diagonal_blocks @ derivative, axis=0)
    size = np.sqrt(hessian.diagonal())
    scaled = hessian / np.multiply.outer(size, size) if np.all(size > 0.0) else np.zeros_like(hessian)
    if not np.linalg.eigvalsh(scaled)[0] > _SINGULAR:
        raise ValueError("frequency_hz: expected lines whose frequencies and decays the record determines, found none")
    inverse = np.linalg.inv(scaled) / np.multiply.outer(size, size)
    gradient = np.einsum("ckq,kc->q", pull, _products(system.project.swapaxes(1, 2), right))
    return GaussNewtonStep(inverse @ gradient, inverse, derivative, pull)


def apply_step(columns: SineColumns, exponents: ComplexArray, change: FloatArray) -> SineColumns:
    """Return the columns after a step of the unknowns."""
    exponent = exponents @ change
    frequency_hz = columns.frequency_hz + exponent.imag / (2.0 * np.pi)
    return replace(columns, frequency_hz=frequency_hz, decay_per_s=columns.decay_per_s - exponent.real)


def estimate(
    samples: SineSamples, frequency_hz: FloatArray, model: SineModel, *, slopes: bool = False
) -> tuple[SineColumns, SineSystem, FloatArray]:
    """Return columns, normal equations and linear parameters (P, C) of a converged fit.

    Frequencies and decays are converged within 1/1000 of their u. One pass over the data is needed where frequencies
    are fixed and no line decays, else one per step. With `slopes` the normal equations include the slopes of the lines
    even where no nonlinear parameter is fitted.
    """
    exponents = model.exponents(frequency_hz)
    count = exponents.shape[1]
    lines = np.array(frequency_hz, dtype=np.float64)
    columns = SineColumns(lines, np.zeros(len(lines)), model.drift, count > 0 or slopes)
    half_s = float(np.max(np.abs(samples.timeline.centre_s))) + float(np.max(np.abs(samples.timeline.local_s)))
    # Not by `_common.fitting`: the channels' weights follow the fit, so no sum of squares falls, and each trial is a
    # pass over the record. On the likelihood it finds the same sines, in up to twice the passes, but from 0.9 bins
    # off it leaps into a side lobe; steps limited by their phase do not.
    for _ in range(_STEPS):
        normal = normal_equations(samples, columns)
        system = solve_linear(normal, columns)
        coefficients = system.coefficients(normal.right)
        if not count:
            return columns, system, coefficients
        left = normal.power - np.einsum("pc,pc->c", coefficients, normal.right[: system.linear])
        variance = np.maximum(left, _ROUNDING * normal.power) / samples.timeline.samples
        value = as_complex(coefficients, len(frequency_hz))
        step = frequency_step(system, normal.right, value, exponents, variance)
        # How far the step turns the ends of the record, in rad, rms by the power of the lines.
        power = np.sum(np.abs(value) ** 2, axis=1)
        rate = np.sqrt(power @ np.abs(exponents @ step.change) ** 2 / np.sum(power)) if power.any() else 0.0
        turn = half_s * float(rate)
        if turn <= _MIN_ROTATION or np.all(np.abs(step.change) <= _CONVERGED * np.sqrt(step.inverse.diagonal())):
            return columns, system, coefficients
        shorter = min(1.0, _FARTHEST / turn) if turn > 0.0 else 1.0
        columns = apply_step(columns, exponents, shorter * step.change)
    listed = ", ".join(f"{f:.6g}" for f in frequency_hz)
    raise ValueError(f"frequency_hz: expected frequencies from which the fit converges, found {listed} Hz")


# Result of a sine approximation, with the covariance that frequencies and decay rates share with the phasors.

_CHUNK = 1 << 16  # samples for which the curve is worked out at a time
_SAME_ROTATION = 1e-9  # rad, largest difference of the phases of lines in two parts that count as equal


@dataclass(frozen=True)
class SineFit(
    Arrays,
    shapes="offset C; drift_per_s C; residual_rms C; offset_covariance C C; spikes N;"
    "u_frequency_hz K; decay_per_s K; u_decay_per_s K",
):
    """Sine approximation of C channels over S times.

    Attributes
    ----------
    phasors : K lines, C channels, at time zero also where lines decay.
    offset, offset_covariance : (C,) and (C, C), the value at mean phase zero.
    drift_per_s : (C,), counted from `middle_s`; zero where no drift was fitted.
    middle_s : middle of the record in s.
    u_frequency_hz : (K,), zero where the frequency was fixed.
    decay_per_s, u_decay_per_s : (K,), δ of exp(-δt), zero where none was fitted.
    slopes : (1 or C, 2K, 2K), response of the fit about the middle to Re and Im of each line times the time from there.
    residual_rms : (C,), over the samples used.
    spikes : rows left out as outliers.
    condition : condition number of the design matrix with columns of unit length.
    notices : notices of the fit.
    """

    phasors: Phasors
    offset: FloatArray
    offset_covariance: FloatArray
    drift_per_s: FloatArray
    middle_s: float
    u_frequency_hz: FloatArray
    decay_per_s: FloatArray
    u_decay_per_s: FloatArray
    slopes: FloatArray
    residual_rms: FloatArray
    spikes: IntArray
    condition: float
    notices: tuple[Notice, ...]

    def __repr__(self) -> str:
        return f"SineFit({self.phasors}, condition {self.condition:.3g}, {len(self.spikes)} spikes)"

    def model(self, time_s: FloatArray, channels: slice = slice(None)) -> FloatArray:
        """Return the curve offset + drift + Σ Re{X exp((jω - δ)t)} at times (T,)."""
        offset, drift_per_s, value = self.offset[channels], self.drift_per_s[channels], self.phasors.value[:, channels]
        curve = np.empty((len(time_s), len(offset)))
        exponent = 2j * np.pi * self.phasors.frequency_hz - self.decay_per_s
        cached_local, turns = np.empty(0), np.empty((0, len(exponent)), np.complex128)
        for first in range(0, len(time_s), _CHUNK):
            time = time_s[first : first + _CHUNK]
            local = time - time[0]
            off = np.max(np.abs(local - cached_local[: len(local)])) if len(cached_local) >= len(local) else np.inf
            if off * np.max(np.abs(exponent)) > _SAME_ROTATION:
                cached_local, turns = local, np.exp(np.multiply.outer(local, exponent))
            lines = (turns[: len(time)] @ (np.exp(exponent * time[0])[:, None] * value)).real
            curve[first : first + _CHUNK] = offset + np.multiply.outer(time - self.middle_s, drift_per_s) + lines
        return curve

    def slope_response(self, change: ComplexArray) -> ComplexArray:
        """Return the first-order response (K, C) of the fit to a slope of the lines.

        The values change by Σ Re{change·(t - middle_s)·exp((jω - δ)t)} with `change` (K, C) at time zero. The response
        is negligible over many periods, or beats of an alias. Over less than one, slopes resemble the lines, their
        conjugates, and the offset.
        """
        to_middle = np.exp((2j * np.pi * self.phasors.frequency_hz - self.decay_per_s) * self.middle_s)[:, None]
        middle = change * to_middle
        parts = np.stack([middle.real, middle.imag], axis=1).reshape(2 * len(middle), -1)
        return np.asarray(as_complex(_products(self.slopes, parts), len(middle)) / to_middle)

    def residual_of(self, time_s: FloatArray, values: FloatArray) -> FloatArray:
        """Return values (T, C) minus the curve, NaN in rows with a NaN."""
        residual = values - self.model(time_s)
        residual[~np.isfinite(values).all(axis=1)] = np.nan
        return np.asarray(residual)


@dataclass(frozen=True)
class Estimate:
    """A solved fit about the middle of its record, the input of the covariances.

    Attributes
    ----------
    columns, system : columns and solved normal equations.
    coefficients : (P, C), linear parameters.
    factor : (C, C) with F·Fᵀ the residuals' covariance.
    noise : (K + 1, C), density of F⁻¹·residual around each line and zero over its mean.
    exponents : (K, Q), derivative of each line's exponent by the Q unknown frequencies and decay rates.
    step : the last step, None where no unknown is nonlinear.
    """

    columns: SineColumns
    coefficients: FloatArray
    system: SineSystem
    factor: FloatArray
    noise: FloatArray
    exponents: ComplexArray
    step: GaussNewtonStep | None

    def noise_between(self, first: int, second: int) -> FloatArray:
        """Return the noise covariance (C, C) between two lines, or of one line."""
        level = np.sqrt(self.noise[first] * self.noise[second])
        return np.asarray(self.factor * level @ self.factor.T)

    def exponent_covariance(self) -> FloatArray:
        """Return the covariance (Q, Q) of the unknown frequencies and decay rates."""
        if self.step is None:
            return np.zeros((0, 0))
        seen = np.repeat(self.factor[:, None, :] * np.sqrt(self.noise[: self.columns.lines]), 2, axis=1)
        noise = np.tensordot(seen, seen, axes=(2, 2))  # channel and slope, channel and slope
        both = noise * self.system.information().transpose(0, 2, 1, 3)
        pull = self.step.pull.reshape(-1, self.step.pull.shape[2])
        middle = pull.T @ both.reshape(len(pull), len(pull)) @ pull
        return np.asarray(self.step.inverse @ middle @ self.step.inverse)

    def linear_change(self) -> FloatArray:
        """Return the derivative (P, C, Q) of the linear parameters by the nonlinear unknowns."""
        if self.step is None:
            return np.zeros((*self.coefficients.shape, 0))
        carried = self.system.project[:, : self.system.linear] @ self.step.derivative
        return np.asarray(carried.transpose(1, 0, 2))


def phasors_at_zero(
    found: Estimate,
    exponent_covariance: FloatArray,
    factor: ComplexArray,
    middle_s: float,
    dof: FloatArray,
    names: tuple[tuple[str, ...], tuple[str, ...]],
) -> Phasors:
    """Return the phasors at time zero from those about the middle.

    `factor` (K,) = exp(-s·middle). An error of frequency and decay rotates and scales a phasor between the middle and
    time zero: dX = exp(-s·t)·(dX' - X'·t·ds). With the covariance of s that adds to the (XᵀX)⁻¹ ⊗ Σ of a fit at fixed
    frequencies.
    """
    lines, channels = found.columns.lines, found.coefficients.shape[1]
    value = as_complex(found.coefficients, lines)
    spread = found.system.spread()
    change = as_complex(found.linear_change(), lines) - middle_s * value[:, :, None] * found.exponents[:, None, :]
    covariance = np.empty((lines, 2 * channels, 2 * channels))
    for k in range(lines):
        quadratures = slice(2 * k, 2 * k + 2)
        block = spread[:, :, quadratures, quadratures] * found.noise_between(k, k)[:, :, None, None]
        stacked = np.concatenate([change[k].real, change[k].imag])
        covariance[k] = block.transpose(2, 0, 3, 1).reshape(2 * channels, 2 * channels)
        covariance[k] += stacked @ exponent_covariance @ stacked.T
    middle = Phasors(found.columns.frequency_hz, value, covariance, *names, dof)
    return middle.scaled(factor[:, None])


# Residual of a fit: its sums, its covariance between channels, and its density around each line.

_DEPENDENT = 1e-12  # smallest eigenvalue of a correlation matrix that counts, for channels that depend on others


@dataclass(frozen=True)
class FitRemainder:
    """Weighted sums over the residual of a fit.

    Attributes
    ----------
    right : (P, C), columns times residual.
    power : (C, C), residual times residual.
    residual : (S, C), of a short record, else None.
    transform : (K + 1, M, C), Fourier transform of a long record's residual at `bins`, else None.
    bins : (K + 1, M), bins near the lines and the offset.
    line_bin : (K + 1,), positions of the lines and of the offset in bins.
    """

    right: FloatArray
    power: FloatArray
    residual: FloatArray | None
    transform: ComplexArray | None
    bins: IntArray | None
    line_bin: FloatArray | None


def sum_remainder(samples: SineSamples, columns: SineColumns, coefficients: FloatArray) -> FitRemainder:
    """Return the sums over the residual of a fit from one pass over its samples."""
    timeline, channels = samples.timeline, samples.values.shape[1]
    transforms = columns.block_transforms(timeline)
    long = timeline.grid is not None and timeline.samples > LONG
    line_bin, bins = None, None
    if timeline.grid is not None and long:
        line_bin = line_bins(columns, timeline.samples, 1.0 / float(timeline.grid.interval_s))
        bins = neighbour_bins(timeline.samples, line_bin)
    demodulator = None if bins is None else Demodulator(timeline, bins)
    down = np.empty((0, 0)) if demodulator is None else demodulator.columns()
    moments = np.empty((len(transforms), down.shape[1], channels))
    stored = None if long else np.empty(samples.values.shape)
    local_right = np.empty((len(transforms), transforms.shape[1], channels))
    power = np.zeros((channels, channels))
    for chunk, basis, residual in residuals(samples, columns, coefficients):
        blocks = slice(chunk.first, chunk.last)
        single = residual.reshape(-1, channels)
        power += single.T @ single
        local_right[blocks] = chunk.by_block(basis.T @ chunk.weighted(residual, 1))
        if demodulator is not None:
            moments[blocks] = chunk.by_block(down[: len(residual)].T @ residual)
        if stored is not None:
            stored[timeline.edges[chunk.first] : timeline.edges[chunk.last]] = chunk.in_order(residual)
    right = np.asarray(np.sum(transforms.swapaxes(1, 2) @ local_right, axis=0))
    transform = None if demodulator is None else demodulator.transform(moments)
    return FitRemainder(right, power, stored, transform, bins, line_bin)


def noise_at_lines(
    samples: SineSamples,
    columns: SineColumns,
    remainder: FitRemainder,
    whitening: FloatArray,
    time_s: FloatArray | None,
) -> LineNoise | None:
    """Return the noise of the whitened series at each line and the offset.

    The offset is last and is represented by the lowest bin. `time_s` are the times of a record whose residual is
    stored. None where times lie on no grid or are too few.
    """
    if remainder.transform is not None and remainder.bins is not None and remainder.line_bin is not None:
        ordinates = remainder.transform @ whitening.T / np.sqrt(samples.count)
        return noise_of_ordinates(
            ordinates, remainder.bins.astype(np.float64), remainder.line_bin, samples.timeline.samples
        )
    if remainder.residual is None or time_s is None:
        return None
    used = samples.used_rows()
    exact = sampling_grid(time_s[used])
    grid = exact or nearest_grid(time_s[used])
    if grid is None:
        return None
    whitened = np.asarray(remainder.residual[used] @ whitening.T)
    found = line_noise(grid.filled(whitened), len(whitened), line_bins(columns, grid.length, grid.rate_hz))
    # Uneven times bring noise of all frequencies to a line: that of a white series of this power is the least.
    return found if exact or found is None else replace(found, variance=np.maximum(found.variance, 1.0))


def line_bins(columns: SineColumns, length: int, rate: float) -> FloatArray:
    """Return the bins of all lines of a record, last the offset."""
    return np.append(alias_frequency(columns.frequency_hz, rate) * length / rate, 0.5)


def factor_of(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return F (C, C) with F·Fᵀ = covariance, and F⁻¹, zero for channels without noise.

    F = D·√R with the symmetric root of the correlation matrix. Of all roots it mixes the channels least, and it does
    not depend on their order.
    """
    sigma = np.sqrt(covariance.diagonal())
    inverse_sigma = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
    correlation = covariance * np.multiply.outer(inverse_sigma, inverse_sigma)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    root = np.sqrt(np.maximum(eigenvalues, _DEPENDENT))
    factor = sigma[:, None] * ((vectors * root) @ vectors.T)
    inverse = ((vectors / root) @ vectors.T) * inverse_sigma
    return np.asarray(factor), np.asarray(inverse)


# Outlying samples of a fit.

_FALSE_ALARM = 0.01  # samples of a whole record that Gaussian noise may lose
_SCATTER = 1.16  # relative standard deviation of a median absolute deviation, times the root of the samples
_SAMPLE = 1 << 16  # residuals from which the scale of a long record is read
_NORMAL_MEDIAN = 0.6744897501960817  # of |x| for a standard normal x
_ROUNDS = 20  # of fitting and rejecting spikes at most
_FINEST = 1e-12  # of the largest coefficient: no residual is judged more finely
_MOST = 0.25  # of the samples: more are no spikes


def find_spikes(samples: SineSamples, frequency_hz: FloatArray, model: SineModel) -> tuple[BoolArray, float]:
    """Return the outlying rows (S,) of the residual, and the limit in standard deviations.

    The limit is such that Gaussian noise exceeds it in 1 of 100 records, plus two standard deviations of the scale, so
    that short records lose no more. Fitting and rejection are repeated until the set is stable; every row is tested
    again each time. The standard deviation is estimated from the median absolute residual, which tolerates up to half
    of the rows as outliers (Hampel, J. Am. Stat. Assoc. 69 (1974) 383). Where more than a quarter would be rejected,
    the noise is not Gaussian with spikes, and no row is rejected.
    """
    count, parameters = samples.count, 2 * len(frequency_hz) + (2 if model.drift else 1)
    limit = -NormalDist().inv_cdf(_FALSE_ALARM / (2.0 * count * samples.values.shape[1]))
    limit *= (1.0 + 2.0 * _SCATTER / float(np.sqrt(count))) * float(np.sqrt(count / (count - parameters)))
    spikes = np.zeros(samples.timeline.samples, dtype=np.bool_)
    for _ in range(_ROUNDS):
        columns, _, coefficients = estimate(samples.drop_rows(spikes) if spikes.any() else samples, frequency_hz, model)
        scale = _scale(samples, columns, coefficients)
        found = np.zeros_like(spikes)
        for chunk, _, residual in residuals(samples, columns, coefficients):
            rows = slice(samples.timeline.edges[chunk.first], samples.timeline.edges[chunk.last])
            found[rows] = (np.abs(chunk.in_order(residual)) > limit * scale).any(axis=1)
        if np.count_nonzero(found) > _MOST * samples.count:
            return np.zeros_like(spikes), limit
        if np.array_equal(found, spikes):
            break
        spikes = found
    return spikes, limit


def _scale(samples: SineSamples, columns: SineColumns, coefficients: FloatArray) -> FloatArray:
    """Return the standard deviation (C,) of the weighted residual from the median of rows."""
    step = -(-samples.timeline.samples // _SAMPLE)
    chosen = []
    for chunk, _, residual in residuals(samples, columns, coefficients):
        rows = slice(-int(samples.timeline.edges[chunk.first]) % step, None, step)
        part = chunk.in_order(residual)[rows]
        chosen.append(part.copy() if chunk.root is None else part[(chunk.root[rows] > 0.0).all(axis=1)])
    scale = np.median(np.abs(np.concatenate(chosen)), axis=0) / _NORMAL_MEDIAN
    return np.asarray(np.maximum(scale, _FINEST * np.max(np.abs(coefficients), axis=0)))
