"""Sine approximation at exact times, its stationarity over blocks of whole periods, and converter steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from shaker.io.channel import Stacked
from shaker.signal_notices import MISSING_SAMPLES, SPIKES_REJECTED
from shaker.sine.aliasing import MAX_CONDITION, alias_frequency, sampling_grid, separation_bins, sine_columns
from shaker.sine.noise import LineNoise, line_noise
from shaker.sine.normal_equations import (
    SineSamples,
    as_complex,
    check_samples,
    solve_sines,
    timeline,
)
from shaker.sine.solve import (
    Estimate,
    SineFit,
    SineModel,
    apply_step,
    estimate,
    factor_of,
    find_spikes,
    frequency_step,
    noise_at_lines,
    phasors_at_zero,
    sum_remainder,
)
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray, check_shape
from shakercal._common.notices import Notice

_NO_ADDITIONS = SineModel()
_ROUNDING = 1e-15  # of a channel's lines: no residual is more certain


def fit_sines(
    time_s: FloatArray,
    values: FloatArray | Stacked,
    frequency_hz: FloatArray,
    channels: Sequence[str],
    unit: Sequence[str],
    *,
    model: SineModel = _NO_ADDITIONS,
    variance: FloatArray | None = None,
) -> SineFit:
    """Fit offset, lines and the additions of a model to samples by least squares.

    The method is the three-parameter fit of IEEE 1057 and method 3 of ISO 16063-11, for any number of lines and
    channels, above or below the Nyquist rate. With free frequencies it is the four-parameter fit, with frequencies
    common to all channels. Rows with a NaN in any channel are dropped.

    Parameters
    ----------
    time_s
        (S,), sampling times in s.
    values
        (S, C), samples of C channels.
    frequency_hz
        (K,), frequencies of the lines in Hz; start values where they are free.
    channels
        C names.
    unit
        C units.
    model
        Free frequencies, drift, decay, removal of spikes; default: none of them.
    variance
        (S,) or (S, C), noise variances of the samples up to a factor per channel; None: all equal.

    Returns
    -------
    The fit with phasors, offset, uncertainties and notices.

    Raises
    ------
    ValueError
        Shapes differ, samples are too few, lines cannot be separated, or the fit does not converge.

    Notes
    -----
    The covariance of a line is (XᵀX)⁻¹ ⊗ Σ with the residuals' covariance Σ = F·Fᵀ (C, C), plus the contributions of
    frequency and decay. Where the times lie on a grid and the record is long enough, Σ = F·diag(S)·Fᵀ. S is the
    spectral density of the series F⁻¹·residual around the line's alias. Noise then counts at the frequency where it
    acts, and a combination of channels with little noise keeps its small uncertainty.

    Uniform records above 10⁵ samples are processed block by block; neither columns nor residual are stored.

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import fit_sines
    >>> time_s = np.arange(400) / 21.3  # a camera far below the Nyquist rate
    >>> position = 2e-6 * np.cos(2 * np.pi * 80.0 * time_s + 0.5) + 1e-9 * np.sin(time_s**2)
    >>> fit = fit_sines(time_s, position[:, None], np.array([80.0]), ["z"], ["m"])
    >>> fit.phasors
    Phasors(1 line from 80 to 80 Hz: z [m])
    >>> print(f"{abs(fit.phasors.value[0, 0]):.2e} m, {np.angle(fit.phasors.value[0, 0]):.2f} rad")
    2.00e-06 m, 0.50 rad
    """
    _check_arguments(time_s, values, frequency_hz, channels, unit)
    present = rows_present(values)
    samples = SineSamples(timeline(time_s, present), values, _root(values, variance, present))
    names = (tuple(channels), tuple(unit))
    where = ", ".join(channels)
    notices: tuple[Notice, ...] = ()
    if present is not None:
        missing = len(time_s) - int(np.count_nonzero(present))
        notices = (Notice(MISSING_SAMPLES, where, missing=missing, samples=len(time_s)),)
    parameters = 2 * len(frequency_hz) + (2 if model.drift else 1) + int(model.exponents(frequency_hz).shape[1])
    check_samples(samples.count, parameters)
    if not model.robust:
        return _fit_rows(time_s, samples, frequency_hz, model, names, notices)
    spikes, limit = find_spikes(samples, frequency_hz, model)
    if spikes.any():
        first_s = time_s[np.argmax(spikes)]
        count, total = int(np.count_nonzero(spikes)), samples.count
        notices += (Notice(SPIKES_REJECTED, where, spikes=count, samples=total, limit_sigmas=limit, first_s=first_s),)
        samples = samples.drop_rows(spikes)
    check_samples(samples.count, parameters)
    return replace(_fit_rows(time_s, samples, frequency_hz, model, names, notices), spikes=np.flatnonzero(spikes))


def _fit_rows(
    time_s: FloatArray,
    samples: SineSamples,
    frequency_hz: FloatArray,
    model: SineModel,
    names: tuple[tuple[str, ...], tuple[str, ...]],
    notices: tuple[Notice, ...],
) -> SineFit:
    """Fit the remaining samples, and refer the parameters about the middle to time zero."""
    lines, unknown = len(frequency_hz), model.exponents(frequency_hz)
    columns, system, coefficients = estimate(samples, frequency_hz, model, slopes=True)
    columns = columns if unknown.shape[1] else replace(columns, slopes=False)
    left = sum_remainder(samples, columns, coefficients)
    channels = samples.values.shape[1]
    free = samples.count - system.linear - unknown.shape[1] / channels
    # The last step, on the exact residual.
    change = system.coefficients(left.right)
    explained = left.right[: system.linear].T @ change
    power = left.power - (explained + explained.T) / 2.0
    power += np.diag(np.maximum(0.0, -power.diagonal()))
    factor, whitening = factor_of(power / free)
    noise = noise_at_lines(samples, columns, left, whitening, time_s if left.residual is not None else None)
    if noise is None:
        noise = LineNoise(np.ones((lines + 1, channels)), np.full(lines + 1, free))
    best = Estimate(columns, coefficients + change, system, factor, noise.variance, unknown, None)
    if unknown.shape[1]:
        value = as_complex(coefficients, lines)
        rounding = (_ROUNDING * np.abs(value).max(axis=0)) ** 2
        step = frequency_step(system, left.right, value, unknown, np.maximum(power.diagonal() / free, rounding))
        best = replace(best, columns=apply_step(columns, unknown, step.change), step=step)
        best = replace(best, coefficients=best.coefficients + best.linear_change() @ step.change)
    covariance, carried = best.exponent_covariance(), best.linear_change()[2 * lines]
    spread = system.spread()[:, :, 2 * lines, 2 * lines]
    middle = samples.timeline.middle_s
    turns = np.array([samples.timeline.middle_turns(float(f)) for f in best.columns.frequency_hz])
    to_zero = np.asarray(np.exp(best.columns.decay_per_s * middle - 2j * np.pi * turns))
    return SineFit(
        phasors=phasors_at_zero(best, covariance, to_zero, middle, np.minimum(noise.dof, free)[:lines], names),
        offset=best.coefficients[2 * lines],
        offset_covariance=spread * best.noise_between(lines, lines) + carried @ covariance @ carried.T,
        drift_per_s=best.coefficients[2 * lines + 1] if model.drift else np.zeros(channels),
        middle_s=middle,
        u_frequency_hz=np.sqrt(np.einsum("kq,qr,kr->k", unknown.imag, covariance, unknown.imag)) / (2.0 * np.pi),
        decay_per_s=best.columns.decay_per_s,
        u_decay_per_s=np.sqrt(np.einsum("kq,qr,kr->k", unknown.real, covariance, unknown.real)),
        slopes=-system.project[:, : 2 * lines],
        residual_rms=np.sqrt(power.diagonal() / samples.count),
        spikes=np.zeros(0, dtype=np.int64),
        condition=system.condition,
        notices=notices,
    )


def rows_present(values: FloatArray | Stacked) -> BoolArray | None:
    """Return which rows (S,) have finite values in all channels, None where all have."""
    stacked = Stacked.from_array(values)
    with np.errstate(over="ignore", invalid="ignore"):
        if all(np.isfinite(np.sum(part)) for part in stacked.iterate_row_blocks()):
            return None
    present = np.concatenate([np.isfinite(part).all(axis=1) for part in stacked.iterate_row_blocks()])
    return None if present.all() else present


def _root(values: FloatArray | Stacked, variance: FloatArray | None, present: BoolArray | None) -> FloatArray | None:
    """Return weights 1/σ of unit mean square, zero for absent rows; None for equal ones."""
    if variance is None:
        return None if present is None else present.astype(np.float64)
    if variance.shape not in (values.shape, values.shape[:1]):
        expected = f"an array of shape {values.shape[:1]} or {values.shape}"
        raise ValueError(f"variance: expected {expected}, found {variance.shape}")
    used = np.ones(len(values), dtype=np.bool_) if present is None else present
    if not np.all((variance[used] > 0.0) & np.isfinite(variance[used])):
        raise ValueError("variance: expected positive numbers, found others")
    root = np.zeros(variance.shape)
    root[used] = 1.0 / np.sqrt(variance[used])
    return np.asarray(root / np.sqrt(np.mean(root[used] ** 2, axis=0)))


def _check_arguments(
    time_s: FloatArray,
    values: FloatArray | Stacked,
    frequency_hz: FloatArray,
    channels: Sequence[str],
    unit: Sequence[str],
) -> None:
    check_shape("time_s", time_s, (None,))
    if not np.all(np.isfinite(time_s)):
        raise ValueError(f"time_s: expected finite times, found {int(np.sum(~np.isfinite(time_s)))} that are not")
    check_shape("values", values, (len(time_s), len(channels)))
    check_shape("frequency_hz", frequency_hz, (None,))
    if len(unit) != len(channels):
        raise ValueError(f"unit: expected {len(channels)} units, one per channel, found {len(unit)}")


# Whether amplitude and phase of lines stay the same through a record, from blocks of whole periods.

MAX_BLOCKS = 10  # of a record in the test for drift; chosen
_FULL, _FEWEST = 0.5, 2  # of the mean number of samples in a block that it must have; blocks that show a drift
_UNUSED = 0.02  # of the record may be left over for the sake of more blocks
_DRIFT_SEPARATION = 8.0  # bins between lines from which on a drift can be taken off without touching their noise
_SLOPES = ("amplitude_per_s", "u_amplitude_per_s", "phase_rad_per_s", "u_phase_rad_per_s", "p_value")
_TURNS = 3  # of estimating a wrong rate
_NO_NOISE = 1e-200  # variance used for zero: sums of its inverse are finite
_NOISE_SAMPLES = 1 << 17  # of a longer record no more are needed for its noise density


@dataclass(frozen=True)
class Stationarity(
    Arrays,
    shapes="frequency_hz K; dof K; channels C; time_s B; value B K C; u B K C; amplitude_per_s K C;"
    "u_amplitude_per_s K C; phase_rad_per_s K C; u_phase_rad_per_s K C; p_value K C",
):
    """Phasors of lines over blocks of a record, with a test for drift.

    K lines, C channels, B blocks.

    Attributes
    ----------
    frequency_hz : (K,), frequencies of the lines in Hz.
    channels : C names.
    time_s : (B,), middles of the blocks in s.
    block_s : length of a block in s.
    periods : periods of the first line in a block; of its alias below twice its frequency.
    whole : whether `periods` is a whole number.
    value, u : (B, K, C), phasors referred to time zero, and the standard uncertainty of either part.
    amplitude_per_s, phase_rad_per_s : (K, C), slopes of a straight line through the blocks; `u_…`: their uncertainties.
    p_value : (K, C), probability that noise alone moves the blocks as far from their mean.
    dof : (K,), degrees of freedom of that noise.
    """

    frequency_hz: FloatArray
    channels: tuple[str, ...]
    time_s: FloatArray
    block_s: float
    periods: float
    whole: bool
    value: ComplexArray
    u: FloatArray
    amplitude_per_s: FloatArray
    u_amplitude_per_s: FloatArray
    phase_rad_per_s: FloatArray
    u_phase_rad_per_s: FloatArray
    p_value: FloatArray
    dof: FloatArray

    def p_value_with_rate(self, u_phase_rad_per_s: ArrayLike) -> FloatArray:
        """Return the probability of such a scatter from noise and an uncertain rate, like `p_value`.

        `u_phase_rad_per_s` (K,) or number is the standard uncertainty of the phase slope from an influence that rotates
        all blocks in proportion to time, such as the rate of a clock. It widens the covariance of the blocks along one
        direction. To first order χ² falls by that of the slope times the share of this variance in that of the slope
        (Sherman & Morrison).
        """
        return _chance_probability(self._chi_square(u_phase_rad_per_s), len(self.time_s), self.dof)

    def excess_variance(self, u_phase_rad_per_s: ArrayLike) -> FloatArray:
        """Return the variance (K, C) of blocks, both parts, beyond noise and rate error."""
        blocks = len(self.time_s)
        more = np.maximum(self._chi_square(u_phase_rad_per_s) - 2.0 * (blocks - 1), 0.0)
        return np.asarray(more / np.sum(1.0 / np.maximum(self.u**2, _NO_NOISE), axis=0))

    def _chi_square(self, u_phase_rad_per_s: ArrayLike) -> FloatArray:
        """Return the χ² (K, C) about the mean and of the likeliest rate."""
        rate = np.broadcast_to(np.asarray(u_phase_rad_per_s, dtype=np.float64), self.frequency_hz.shape)[:, None] ** 2
        weight = 1.0 / np.maximum(self.u**2, _NO_NOISE)
        total = np.sum(weight, axis=0)
        time = self.time_s[:, None, None] - np.sum(weight * self.time_s[:, None, None], axis=0) / total
        slope_variance = np.maximum(self.u_phase_rad_per_s, np.finfo(np.float64).tiny) ** 2
        part = rate / (slope_variance + rate)
        # Turned back by the likeliest rate, not subtracted: a tenth of a radian bends the blocks beyond their noise.
        rest, turn = self.value, part * self.phase_rad_per_s
        for _ in range(_TURNS):
            rest = self.value * np.exp(-1j * turn * time)
            mean = np.sum(weight * rest, axis=0) / total
            across = (rest * np.exp(-1j * np.angle(mean))).imag / np.maximum(np.abs(mean), np.finfo(np.float64).tiny)
            turn = part * (turn + np.sum(weight * time * across, axis=0) / np.sum(weight * time**2, axis=0))
        rest = self.value * np.exp(-1j * turn * time)
        mean = np.sum(weight * rest, axis=0) / total
        wrong = np.divide(turn**2, rate, out=np.zeros(turn.shape), where=rate > 0.0)
        return np.asarray(np.sum(weight * np.abs(rest - mean) ** 2, axis=0) + wrong)

    @property
    def length_s(self) -> float:
        """Time from the beginning of the first block to the end of the last."""
        return float(self.time_s[-1] - self.time_s[0]) + self.block_s

    def select(self, channel: str) -> Stationarity:
        """Return one channel."""
        if channel not in self.channels:
            raise ValueError(f"channel: expected one of {', '.join(self.channels)}, found {channel}")
        index = self.channels.index(channel)
        names = ("value", "u", *_SLOPES)
        chosen = {name: getattr(self, name)[..., index : index + 1] for name in names}
        return replace(self, channels=(channel,), **chosen)


def stationarity(
    time_s: FloatArray, values: FloatArray | Stacked, frequency_hz: FloatArray, channels: Sequence[str]
) -> Stationarity | None:
    """Fit the lines (K,) to blocks of whole periods and test whether they drift.

    `values` (S, C) are samples at ascending times (S,). At most ten blocks have whole periods of the first line's
    alias; fewer than two periods are cut into halves. Their noise is the density around each line of the residual of
    the whole record, without the sidebands of a drift. The test is Fisher's for 2(B - 1) real residuals about the
    weighted mean. None where blocks are too short to separate the lines, or fewer than two have half of their samples;
    rows with a NaN are left out.
    """
    tiny = np.finfo(np.float64).tiny
    check_shape("time_s", time_s, (None,))
    check_shape("values", values, (len(time_s), len(channels)))
    present = rows_present(values)
    time, data = time_s if present is None else time_s[present], Stacked.from_array(values).select_rows(present)
    block_s, periods, whole = _block_length(time, frequency_hz)
    interval = float(time[-1] - time[0]) / (len(time) - 1)
    length = float(time[-1] - time[0]) + interval
    count = int(np.floor(length / block_s + 0.5 / len(time)))  # the last block may lack half a sample
    start = float(time[0]) - interval / 2.0 + (length - count * block_s) / 2.0  # the blocks lie in the record's middle
    blocks = [slice(low, high) for low, high in pairwise(np.searchsorted(time, start + block_s * np.arange(count + 1)))]
    blocks = [rows for rows in blocks if rows.stop - rows.start > _FULL * len(time) / count]
    if len(blocks) < _FEWEST:
        return None
    try:
        every = (solve_sines(sine_columns(time[rows], frequency_hz), data[rows]) for rows in blocks)
        found = [(one.condition, *one.phasors(len(frequency_hz))) for one in every]  # the residuals are not stored
    except ValueError:
        return None
    condition, value, spread = (np.stack(part) for part in zip(*found, strict=True))
    if condition.max() > MAX_CONDITION:
        return None
    first = max(0, (len(time) - _NOISE_SAMPLES) // 2)
    inner = slice(first, first + _NOISE_SAMPLES)
    variance, dof = _noise(time[inner], data[inner], frequency_hz)
    u = np.sqrt(spread[:, :, None] * variance[None])
    middle = np.array([time[rows].mean() for rows in blocks])
    weight = 1.0 / np.maximum(u**2, _NO_NOISE)
    mean = np.sum(weight * value, axis=0) / np.sum(weight, axis=0)
    # Along the mean phasor the change of amplitude, across it that of phase times amplitude.
    rotated = (value - mean) * np.exp(-1j * np.angle(mean))
    chi2 = np.sum(weight * np.abs(rotated) ** 2, axis=0)
    centred = middle[:, None, None] - np.sum(weight * middle[:, None, None], axis=0) / np.sum(weight, axis=0)
    information = np.sum(weight * centred**2, axis=0)
    slope, u_slope = np.sum(weight * centred * rotated, axis=0) / information, 1.0 / np.sqrt(information)
    size = np.maximum(np.abs(mean), tiny)
    return Stationarity(
        frequency_hz=frequency_hz,
        channels=tuple(channels),
        time_s=middle,
        block_s=block_s,
        periods=periods,
        whole=whole,
        value=value,
        u=u,
        amplitude_per_s=slope.real,
        u_amplitude_per_s=u_slope,
        phase_rad_per_s=slope.imag / size,
        u_phase_rad_per_s=u_slope / size,
        p_value=_chance_probability(chi2, len(middle), dof),
        dof=dof,
    )


def _chance_probability(chi2: FloatArray, blocks: int, dof: FloatArray) -> FloatArray:
    """Return the probability that noise of `dof` (K,) exceeds χ² (K, C), by Fisher's distribution."""
    from scipy.special import fdtrc

    free = 2.0 * (blocks - 1)
    return np.asarray(fdtrc(free, dof[:, None], chi2 / free))


def _block_length(time: FloatArray, frequency_hz: FloatArray) -> tuple[float, float, bool]:
    """Return length of a block in s, the first line's periods, and whether whole."""
    grid = sampling_grid(time)
    if grid is None:
        length, seen_hz = float(time[-1] - time[0]), float(frequency_hz[0])
    else:
        length, seen_hz = grid.length / grid.rate_hz, float(alias_frequency(frequency_hz[0], grid.rate_hz))
    # A tenth of a period more or less is no harm: each block is fitted, not averaged.
    total = int(np.floor(length * seen_hz + 0.1))
    if total < 2:
        return length / 2.0, length * seen_hz / 2.0, False
    counts = np.arange(2, min(total, MAX_BLOCKS) + 1)
    used = counts * (total // counts)
    count = int(np.max(counts[used >= min((1.0 - _UNUSED) * total, used.max())]))
    periods = total // count
    return min(periods / seen_hz, length / count), float(periods), True


def _noise(time: FloatArray, data: FloatArray, frequency_hz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the noise variance (K, C) around the lines, and its degrees of freedom (K,)."""
    columns, lines, grid = sine_columns(time, frequency_hz), len(frequency_hz), sampling_grid(time)
    if grid is not None and separation_bins(frequency_hz, grid.rate_hz, grid.length) >= _DRIFT_SEPARATION:
        # A drift of amplitude and phase makes skirts around each line that would count as noise.
        span = np.sqrt(3.0) * (2.0 * (time - time[0]) / (time[-1] - time[0]) - 1.0)
        columns = np.hstack([columns, columns[:, : 2 * lines] * span[:, None]])
    solution = solve_sines(columns, data)
    residual, free = solution.residual, float(len(time) - len(solution.coefficients))
    if grid is not None:
        line_bin = alias_frequency(frequency_hz, grid.rate_hz) * grid.length / grid.rate_hz
        noise = line_noise(grid.filled(residual), len(time), line_bin, blocks=False)
        if noise is not None:
            return noise.variance, np.minimum(noise.dof, free)
    return np.tile(np.sum(residual**2, axis=0) / free, (lines, 1)), np.full(lines, free)


# Effect of converter steps on a sine approximation.

_MOST = 1 << 21  # values of the exponentials of all lines
_LONGEST = 1 << 15  # samples that are rounded
_OFFSETS, _SIZES = 4, np.arange(-16, 17) / 32.0  # offsets between two steps; changes of the amplitude, in steps
_SHIFTS, _GOLDEN = 6, (5.0**0.5 - 1.0) / 2.0  # phases of the sampling times between two samples, and their increment
_UNDITHERED = 0.1  # of a step: noise below which rounding is that of the sine alone
_DITHERED = 0.8  # of a step: with more noise less than 1e-5 of a step is left
_TERMS = 30.0  # exponent at which terms of the series end


def quantisation_error(fit: SineFit, channel: int, time_s: FloatArray, step: float) -> ComplexArray:
    """Return the largest relative change of each line (K,) by rounding samples to a `step`.

    Real and imaginary part are those of the change. Rounding x + noise of standard deviation σ to multiples of q adds,
    on average, Σ (-1)^m q/(πm)·exp(-2π²m²σ²/q²)·sin(2πm·x/q). For one sine this changes its amplitude A by Σ (-1)^m
    2q/(πm)·J₁(2πmA/q)·cos(2πm·offset/q) without noise (Widrow and Kollár, Quantization Noise, 2008); synchronous
    samples add the terms that alias onto it.

    The sum is evaluated at the sampling times for all lines together, and is the largest over offsets, amplitudes
    within a step and sampling times within an interval. Lines below half a step may be caused by rounding alone. The
    noise is that around each line, at most the residual, minus q²/12.
    """
    phasors, value = fit.phasors, fit.phasors.value[:, channel]
    count = min(len(time_s), _LONGEST, max(_MOST // max(len(value), 1), 256))
    time, size = time_s[:count], float(np.max(np.abs(value)))
    near = 0.5 * len(time_s) * float(np.min(phasors.u_re[:, channel] ** 2 + phasors.u_im[:, channel] ** 2)) / 2.0
    noise = np.sqrt(max(min(near, float(fit.residual_rms[channel]) ** 2) - step**2 / 12.0, 0.0)) / step
    if noise > _DITHERED:
        return np.zeros(len(value), dtype=np.complex128)
    used_lines = np.where(np.abs(value) > min(0.5 * step, 0.5 * size), value, 0.0)
    sizes = _SIZES if size > step else np.zeros(_SHIFTS)
    interval = float(time[-1] - time[0]) / (count - 1)
    largest = np.zeros((2, len(value)))
    for number, late in enumerate(np.arange(_SHIFTS) * _GOLDEN % 1.0 * interval):
        turns = np.exp(-2j * np.pi * np.multiply.outer(phasors.frequency_hz, time + late))
        curve = (used_lines.conj() @ turns).real / step
        for scale in 1.0 + sizes[number::_SHIFTS] * step / size:
            for offset in np.arange(_OFFSETS) / _OFFSETS:
                change = turns @ _rounding(scale * curve + offset, noise) * (2.0 / count * step)
                relative = np.divide(change, value, out=np.zeros_like(change), where=value != 0.0)
                largest = np.maximum(largest, np.abs([relative.real, relative.imag]))
    return np.asarray(largest[0] + 1j * largest[1])


def _rounding(values: FloatArray, noise: float) -> FloatArray:
    """Return the mean error (S,) of rounding values with noise to whole numbers."""
    if noise < _UNDITHERED:
        return np.asarray(np.rint(values) - values)
    orders = np.arange(1, int(np.ceil(np.sqrt(_TERMS / 2.0) / (np.pi * noise))) + 1)
    total = np.zeros_like(values)
    for m in orders.tolist():
        total += (-1.0) ** m / (np.pi * m) * np.exp(-2.0 * (np.pi * m * noise) ** 2) * np.sin(2.0 * np.pi * m * values)
    return total
