"""Sine approximation: complex amplitudes, frequencies and decay rates of lines in samples at arbitrary times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray, check_shape
from shaker.notice import Notice
from shaker.signals.noise import LineNoise
from shaker.signals.sine.dense import check_samples
from shaker.signals.sine.normal import Columns, Samples, Tones, as_complex
from shaker.signals.sine.remainder import Remainder, factor_of, noise_at_lines, remainder
from shaker.signals.sine.result import Estimate, SineFit, phasors_at_zero
from shaker.signals.sine.robust import find_spikes, spike_limit, spike_notice
from shaker.signals.sine.solve import SineModel, System, estimate, frequency_step, moved
from shaker.signals.sine.times import Timeline, Times, UniformTimes, timeline

_PLAIN = SineModel()
_ROUNDING = 1e-15  # of a channel's lines: no residual is known better
_SCAN = 1 << 14  # rows looked through at a time


def fit_sines(
    time_s: Times,
    values: FloatArray,
    frequency_hz: FloatArray,
    channels: Sequence[str],
    unit: Sequence[str],
    *,
    model: SineModel = _PLAIN,
    variance: FloatArray | None = None,
    robust: bool = False,
) -> SineFit:
    """Fit offset, lines (K,) and what `model` adds to `values` (S, C) at `time_s` (S,) by least squares.

    The three-parameter fit of IEEE 1057 and method 3 of ISO 16063-11 for any number of lines and channels at once,
    above or below the Nyquist rate alike; with free frequencies the four-parameter fit, its frequencies common to all
    channels. Rows with a NaN in any channel are dropped. `variance` (S,) or (S, C): noise variances of the samples, up
    to a common factor for each channel. `robust` leaves out rows whose residual stands out of the noise so far that
    Gaussian noise loses none in 99 of 100 records, and names them.

    The covariance of a line is (XᵀX)⁻¹ ⊗ Σ with the residuals' covariance Σ = F·Fᵀ (C, C), plus what frequency and
    decay add. Where the times lie on a grid and the record is long enough, Σ = F·diag(S)·Fᵀ instead, S the spectral
    density around the line's alias of the series F⁻¹·residual: noise counts where it acts, and combinations of channels
    that are known better than each channel keep their own.

    Uniform records above 10⁵ samples pass through block by block; neither columns nor residual are ever held.
    """
    _check_arguments(time_s, values, frequency_hz, channels, unit)
    present = _present(values)
    samples = Samples(timeline(time_s, present), values, _root(values, variance, present))
    names = (tuple(channels), tuple(unit))
    where = ", ".join(channels)
    notices: tuple[Notice, ...] = ()
    if present is not None:
        missing = len(time_s) - int(np.count_nonzero(present))
        notices = (Notice("info", f"{missing} of {len(time_s)} samples are missing", where),)
    check_samples(samples.count, _parameters(frequency_hz, model))
    if not robust:
        return _fitted(time_s, samples, frequency_hz, model, names, notices)
    spikes = find_spikes(samples, frequency_hz, model)
    if spikes.any():
        limit = spike_limit(samples, len(frequency_hz), model)
        first_s = float(_written_out(time_s)[np.argmax(spikes)])
        notices += (spike_notice(spikes, samples, limit, first_s, where),)
        samples = samples.without(spikes)
    check_samples(samples.count, _parameters(frequency_hz, model))
    return replace(_fitted(time_s, samples, frequency_hz, model, names, notices), spikes=np.flatnonzero(spikes))


def _fitted(
    time_s: Times,
    samples: Samples,
    frequency_hz: FloatArray,
    model: SineModel,
    names: tuple[tuple[str, ...], tuple[str, ...]],
    notices: tuple[Notice, ...],
) -> SineFit:
    """Fit the samples kept, and turn parameters about the middle of the record into the result."""
    lines, unknown = len(frequency_hz), model.exponents(frequency_hz)
    columns, system, coefficients = estimate(samples, frequency_hz, model)
    left = remainder(samples, columns, coefficients)
    held_s = _written_out(time_s) if left.held is not None else None
    found, dof, rms = _final(samples, columns, system, coefficients, left, unknown, held_s)
    covariance = found.exponent_covariance()
    change = found.linear_change()[2 * lines]
    spread = found.system.spread()[:, :, 2 * lines, 2 * lines]
    middle = samples.timeline.middle_s
    return SineFit(
        phasors=phasors_at_zero(found, covariance, _to_zero(found.tones, samples.timeline), middle, dof[:lines], names),
        offset=found.coefficients[2 * lines],
        offset_covariance=spread * found.noise_between(lines, lines) + change @ covariance @ change.T,
        drift_per_s=found.coefficients[2 * lines + 1] if model.drift else np.zeros(len(names[0])),
        middle_s=middle,
        u_frequency_hz=np.sqrt(np.einsum("kq,qr,kr->k", unknown.imag, covariance, unknown.imag)) / (2.0 * np.pi),
        decay_per_s=found.tones.decay_per_s,
        u_decay_per_s=np.sqrt(np.einsum("kq,qr,kr->k", unknown.real, covariance, unknown.real)),
        residual_rms=rms,
        spikes=np.zeros(0, dtype=np.int64),
        condition=system.condition,
        notices=notices,
    )


def _final(
    samples: Samples,
    columns: Columns,
    system: System,
    coefficients: FloatArray,
    left: Remainder,
    unknown: ComplexArray,
    time_s: FloatArray | None,
) -> tuple[Estimate, FloatArray, FloatArray]:
    """Take the last step on the exact residual; return the estimate, degrees of freedom (K + 1,) and rms (C,)."""
    lines, channels = len(columns.tones.frequency_hz), samples.values.shape[1]
    free = samples.count - system.linear - unknown.shape[1] / channels
    change = system.coefficients(left.right)
    gained = left.right[: system.linear].T @ change
    power = left.power - (gained + gained.T) / 2.0
    power += np.diag(np.maximum(0.0, -power.diagonal()))
    factor, whitening = factor_of(power / free)
    noise = noise_at_lines(samples, columns, left, whitening, time_s)
    if noise is None:
        noise = LineNoise(np.ones((lines + 1, channels)), np.full(lines + 1, free))
    tones, total = columns.tones, coefficients + change
    step = None
    if unknown.shape[1]:
        value = as_complex(coefficients, lines)
        rounding = (_ROUNDING * np.abs(value).max(axis=0)) ** 2
        step = frequency_step(system, left.right, value, unknown, np.maximum(power.diagonal() / free, rounding))
        tones = moved(tones, unknown, step.change)
    found = Estimate(tones, total, system, factor, noise.variance, unknown, step)
    if step is not None:
        found = replace(found, coefficients=total + found.linear_change() @ step.change)
    return found, np.minimum(noise.dof, free), np.sqrt(power.diagonal() / samples.count)


def _to_zero(tones: Tones, times: Timeline) -> ComplexArray:
    """Return exp(-s·t) (K,), which takes phasors from the middle t of the record to time zero."""
    turns = np.array([times.middle_turns(float(f)) for f in tones.frequency_hz])
    return np.asarray(np.exp(tones.decay_per_s * times.middle_s - 2j * np.pi * turns))


def _parameters(frequency_hz: FloatArray, model: SineModel) -> int:
    """Return the number of parameters of one channel."""
    return 2 * len(frequency_hz) + (2 if model.drift else 1) + int(model.exponents(frequency_hz).shape[1])


def _present(values: FloatArray) -> BoolArray | None:
    """Return which rows (S,) have finite values in all channels, None where all have."""
    parts = [slice(first, first + _SCAN) for first in range(0, len(values), _SCAN)]
    with np.errstate(over="ignore", invalid="ignore"):
        if all(np.isfinite(np.sum(values[part])) for part in parts):
            return None
    present = np.concatenate([np.isfinite(values[part]).all(axis=1) for part in parts])
    return None if present.all() else present


def _root(values: FloatArray, variance: FloatArray | None, present: BoolArray | None) -> FloatArray | None:
    """Return weights 1/σ (S,) or (S, C) with mean square one over the rows present, zero elsewhere; None for ones."""
    if variance is None:
        return None if present is None else present.astype(np.float64)
    if variance.shape not in (values.shape, values.shape[:1]):
        expected = f"an array of shape {values.shape[:1]} or {values.shape}"
        raise ValueError(f"variance: expected {expected}, found {variance.shape}")
    kept = np.ones(len(values), dtype=np.bool_) if present is None else present
    if not np.all((variance[kept] > 0.0) & np.isfinite(variance[kept])):
        raise ValueError("variance: expected positive numbers, found others")
    root = np.zeros(variance.shape)
    root[kept] = 1.0 / np.sqrt(variance[kept])
    return np.asarray(root / np.sqrt(np.mean(root[kept] ** 2, axis=0)))


def _written_out(time_s: Times) -> FloatArray:
    """Return the times as an array."""
    return time_s.array() if isinstance(time_s, UniformTimes) else time_s


def _check_arguments(
    time_s: Times, values: FloatArray, frequency_hz: FloatArray, channels: Sequence[str], unit: Sequence[str]
) -> None:
    """Refuse arrays that do not belong together."""
    if not isinstance(time_s, UniformTimes):
        check_shape("time_s", time_s, (None,))
        if not np.all(np.isfinite(time_s)):
            raise ValueError(f"time_s: expected finite times, found {int(np.sum(~np.isfinite(time_s)))} that are not")
    check_shape("values", values, (len(time_s), len(channels)))
    check_shape("frequency_hz", frequency_hz, (None,))
    if len(unit) != len(channels):
        raise ValueError(f"unit: expected {len(channels)} units, one per channel, found {len(unit)}")
