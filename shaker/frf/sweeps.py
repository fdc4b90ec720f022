"""Transfer functions from records that begin and end at rest: sweeps, bursts, pulses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shaker.frf.rest import BurstSpectra, RestError, burst_spectra, find_bursts
from shaker.frf.result import TransferFunction, TransferRecord, circular_covariance
from shaker.signal_notices import (
    AMPLITUDE_DEPENDENCE,
    REPEATS_DIFFER,
    REST_ESTIMATE,
    RINGS_AT_END,
    SINGLE_REPEAT,
)
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import Notice, Value

_HIGHEST = 0.45  # share of the sampling rate up to which lines are used where no band is named
_SIGNAL = 10.0  # the reference over its noise from which a line is used
_TOLERANCE = 1e-9  # relative difference of sampling rates that are equal
_RINGS = 0.05  # motion beyond the ends, of the spectrum, from which a record is refused
_MATTERS = 1.0  # motion beyond the ends, in standard uncertainties of the ratio, that is mentioned


def transfer_from_rest(
    records: Sequence[TransferRecord],
    *,
    spacing_hz: float | None = None,
    band_hz: tuple[float, float] | None = None,
) -> TransferFunction:
    """Return H from records that begin and end at rest, repeats of one measurement.

    Parameters
    ----------
    records
        Records of the same channels at one rate. Levels, lead times, lengths and even the excitation may differ. A
        record of several bursts with pauses between them is as many repeats.
    spacing_hz
        Distance of the lines in Hz; default: one over the longest record.
    band_hz
        Band in Hz; default up to 0.45 of the sampling rate.

    Returns
    -------
    The transfer function with covariance and coherence.

    Raises
    ------
    ValueError
        A record does not begin or end at rest (`RestError`), the channels differ, or no line exceeds the noise.

    Notes
    -----
    A record from rest to rest is one period of a periodic signal: its spectrum has no leakage, and the ratio Y/X of one
    record needs neither a clock nor a trigger in common with others. The noise of all channels is estimated where the
    record is at rest. The estimate is the maximum-likelihood one for noise on reference and responses with that
    covariance (generalised total least squares; Pintelon and Schoukens, System Identification, 2nd ed., sec. 2.7), so
    that a repeat counts by its level. Where the ratios of the repeats scatter by more than this noise, the excess is
    their repeatability T: a random deviation of each ratio, independent of the level, with the covariance T (the
    random-effects model of DerSimonian and Laird 1986). It is estimated over neighbouring lines, lowers the weight of
    strong repeats and is part of the covariance. For one record the covariance is that of the noise alone.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import chirp, lfilter
    >>> from shaker import TransferRecord, transfer_from_rest
    >>> rng, records = np.random.default_rng(0), []
    >>> for level in (1.0, 2.0):
    ...     force = np.zeros(4000)
    ...     force[500:2500] = level * chirp(np.arange(2000) / 1000.0, 10.0, 2.0, 400.0)
    ...     motion = lfilter([0.02], [1.0, -1.8, 0.97], force)
    ...     seen = np.column_stack([force, motion]) + 1e-4 * rng.normal(size=(4000, 2))
    ...     records.append(TransferRecord(seen[:, 0], seen[:, 1:], 1000.0, "force", "N", ("z",), ("m",)))
    >>> transfer_from_rest(records, band_hz=(20.0, 390.0))
    TransferFunction(rest over force: Phasors(1481 lines from 20 to 390 Hz: z [m/N]))
    """
    first = records[0]
    _check_same_channels(records)
    rate = first.sample_rate_hz
    band = usable_band(first, band_hz)
    bursts = [burst for number, record in enumerate(records) for burst in find_bursts(record, band, number)]
    spectra = burst_spectra(bursts, rate, spacing_hz, band)
    power = np.sum(np.abs(spectra.value[:, :, 0]) ** 2, axis=0)
    excited = power > np.maximum(_SIGNAL**2 * spectra.noise[:, 0, 0].real, 0.0)
    if not excited.any():
        raise ValueError(f"record: expected a reference that excites lines, found only noise in {first.reference_name}")
    spectra = spectra.at_lines(excited)
    estimate = _estimate(spectra)
    variance, count = _total_variance(estimate.covariance), len(bursts)
    ratio = Phasors(
        spectra.frequency_hz,
        estimate.ratio,
        estimate.covariance,
        first.channels,
        first.ratio_unit,
        estimate.dof,
    )
    return TransferFunction(
        ratio=ratio,
        coherence=1.0 / (1.0 + count * variance / np.abs(estimate.ratio) ** 2),
        estimator="rest",
        reference=first.reference_name,
        averages=np.full(len(power[excited]), float(count)),
        line_spacing_hz=spectra.spacing_hz,
        line_correlation=spectra.line_correlation,
        notices=_notices(first, spectra, estimate, len(records)),
        repeat_effects=_repeat_effects(estimate, spectra.dof),
    )


def usable_band(record: TransferRecord, band_hz: tuple[float, float] | None) -> tuple[float, float]:
    """Return a band within the sampling; by default up to 0.45 of the rate."""
    rate = record.sample_rate_hz
    return (0.0, _HIGHEST * rate) if band_hz is None else (max(0.0, band_hz[0]), min(0.5 * rate, band_hz[1]))


def _check_same_channels(records: Sequence[TransferRecord]) -> None:
    """Refuse records of other channels or another sampling rate."""
    first = records[0]
    for record in records[1:]:
        if (record.reference_name, record.channels) != (first.reference_name, first.channels):
            raise ValueError(f"records: expected the channels {first.channels} in all, found {record.channels}")
        if abs(record.sample_rate_hz - first.sample_rate_hz) > _TOLERANCE * first.sample_rate_hz:
            raise ValueError(
                f"records: expected one sampling rate, found {first.sample_rate_hz:.9g} and "
                f"{record.sample_rate_hz:.9g} Hz"
            )


# Errors-in-variables estimate over repeats, with their scatter beyond the noise.

_ROUNDS = 3  # of scatter and weights; they change little after the second
_NEIGHBOURS = 4  # lines on either side over which the repeatability is averaged
_WIDEST = 300  # lines on either side over which it is averaged, at most
_CERTAIN = 3.0  # standard deviations from which a correlation is significant


@dataclass(frozen=True)
class _JoinedRepeats:
    """Ratio (K, C) with covariance (K, 2C, 2C), and what the repeats show.

    Attributes
    ----------
    common : (M, K, C), what the deviation of each repeat beyond the noise adds to the mean, relative to the ratio.
    repeatability : (K, 2C, 2C), covariance of the relative deviations of repeats beyond the noise, [all Re, all Im].
    excess : (K, C), observed scatter of the repeats over that of the noise.
    dof : (K,)
    """

    ratio: ComplexArray
    covariance: FloatArray
    common: ComplexArray
    repeatability: FloatArray
    excess: FloatArray
    dof: FloatArray


def _estimate(spectra: BurstSpectra) -> _JoinedRepeats:
    """Return the maximum-likelihood ratio, with weights by noise and repeatability."""
    reference, responses = spectra.value[:, :, 0], spectra.value[:, :, 1:]
    level = np.maximum(np.abs(reference) ** 2, np.finfo(np.float64).tiny ** 0.5)
    count, lines, channels = responses.shape
    weight, dof_repeats = np.ones(responses.shape), np.ones(lines)
    repeatability, excess = np.zeros((lines, 2 * channels, 2 * channels)), np.ones((lines, channels))
    for _ in range(_ROUNDS if count > 1 else 1):
        ratio = _total_least_squares(reference, responses, spectra.noise, weight)
        error = _error_covariance(spectra.noise, ratio) / (ratio[:, :, None] * ratio.conj()[:, None, :])
        variance = np.einsum("kcc->kc", error).real / level[:, :, None]
        deviation = responses / (ratio * reference[:, :, None]) - 1.0
        if count > 1:
            near, excess = _repeatability(deviation, error, level, repeatability, _NEIGHBOURS)
            length = _correlated_lines(deviation, near, variance)
            wide = min(round(_NEIGHBOURS * length), _WIDEST)
            far = near if wide == _NEIGHBOURS else _repeatability(deviation, error, level, near, wide)[0]
            # Smooth deviations pass through zero: what lines farther away show holds there too.
            larger = np.trace(near, axis1=1, axis2=2) > np.trace(far, axis1=1, axis2=2)
            repeatability = np.where(larger[:, None, None], near, far)
            pooled = np.where(larger, 2 * _NEIGHBOURS + 1, min(2 * wide + 1, lines))
            dof_repeats = (count - 1) * np.maximum(pooled / length, 1.0)
            weight = variance / (variance + _total_variance(repeatability))
    share = weight * level[:, :, None]
    share = share / np.sum(share, axis=0)
    both = np.einsum("mkc,mkd->kcd", np.tile(share, 2), np.tile(share, 2))
    by_repeats = both * repeatability
    inverse = np.einsum("mkc,mkd,mk->kcd", share, share, 1.0 / level)
    by_noise = circular_covariance(inverse * error)
    parts = [_total_variance(part) for part in (by_noise, by_repeats)]
    dof = np.sum(parts, axis=0) ** 2 / (parts[0] ** 2 / spectra.dof + parts[1] ** 2 / dof_repeats[:, None])
    along = np.concatenate([ratio.real, ratio.imag], axis=1)
    across = np.concatenate([-ratio.imag, ratio.real], axis=1)
    turn = np.zeros((lines, 2 * channels, 2 * channels))
    index = np.arange(2 * channels)
    turn[:, index, index % channels] = along
    turn[:, index, index % channels + channels] = across
    covariance = turn @ (by_noise + by_repeats) @ turn.swapaxes(1, 2)
    common = share * deviation * np.clip(excess - 1.0, 0.0, 1.0)  # no effect where there is only noise
    return _JoinedRepeats(ratio, covariance, common, repeatability, excess, dof.min(axis=1))


def _total_variance(covariance: FloatArray) -> FloatArray:
    """Return the variance (K, C) of both parts together of covariances (K, 2C, 2C)."""
    variance = np.einsum("kcc->kc", covariance)
    return np.asarray(variance[:, : variance.shape[1] // 2] + variance[:, variance.shape[1] // 2 :])


def _total_least_squares(
    reference: ComplexArray, responses: ComplexArray, noise: ComplexArray, weight: FloatArray
) -> ComplexArray:
    """Return H (K, C) of least Σ w·|Y - HX|²/var(Y - HX) over repeats."""
    tiny = np.finfo(np.float64).eps ** 2
    power = np.sum(weight * np.abs(reference[:, :, None]) ** 2, axis=0)
    cross = np.sum(weight * responses * reference.conj()[:, :, None], axis=0)
    through = np.sum(weight * np.abs(responses) ** 2, axis=0)
    on_reference = noise[:, :1, 0].real + tiny * power
    # Noise that the response shares with the reference is subtracted first, so that the rest is independent of it.
    shared = noise[:, 1:, 0] / on_reference
    alone = np.einsum("kcc->kc", noise).real[:, 1:] - np.abs(shared) ** 2 * on_reference
    alone = np.maximum(alone, tiny * through)
    through = through - 2.0 * (shared.conj() * cross).real + np.abs(shared) ** 2 * power
    cross = cross - shared * power
    kappa = alone / on_reference
    difference = through - kappa * power
    root = np.sqrt(difference**2 + 4.0 * kappa * np.abs(cross) ** 2)
    # Either form of the root of the quadratic loses no digits where the other one does.
    positive = (difference + root) / (2.0 * cross.conj())
    negative = 2.0 * kappa * cross / np.where(difference < 0.0, root - difference, 1.0)
    return np.asarray(np.where(difference < 0.0, negative, positive) + shared)


def _error_covariance(noise: ComplexArray, ratio: ComplexArray) -> ComplexArray:
    """Return the covariance (K, C, C) of Y - HX by noise."""
    cross = ratio[:, :, None] * noise[:, :1, 1:]
    through = ratio[:, :, None] * ratio.conj()[:, None, :] * noise[:, :1, :1]
    found = noise[:, 1:, 1:] - cross - cross.conj().swapaxes(1, 2) + through
    diagonal = np.arange(ratio.shape[1])
    floor = np.finfo(np.float64).eps ** 2 * np.abs(ratio) ** 2
    found[:, diagonal, diagonal] = np.maximum(found[:, diagonal, diagonal].real, floor)
    return found


def _repeatability(
    deviation: ComplexArray, error: ComplexArray, level: FloatArray, before: FloatArray, side: int
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (K, 2C, 2C) of deviations beyond the noise, and their excess.

    The excess (K, C) is the scatter over that of the noise. Expected is a scatter Σ w d dᵀ, w ∝ level, of
    (M - 1)·noise/Σ level + (1 - Σ w²)·T. What it exceeds the noise by is averaged over neighbouring lines, which count
    by the precision of theirs, with T of the round `before`.
    """
    count, total = len(level), level.sum(axis=0)
    share = level / total
    apart = deviation - np.sum(share[:, :, None] * deviation, axis=0)
    stacked = np.concatenate([apart.real, apart.imag], axis=2)
    scatter = np.einsum("mk,mkc,mkd->kcd", share, stacked, stacked)
    expected = circular_covariance((count - 1) * error / total[:, None, None])
    room = 1.0 - np.sum(share**2, axis=0)
    seen, by_noise = _total_variance(scatter), _total_variance(expected)
    spread = _total_variance(before) * room[:, None]
    precision = 1.0 / (by_noise + _smooth(spread if spread.any() else seen, side))
    both = np.tile(precision, 2)[:, :, None] * np.tile(precision, 2)[:, None, :]
    found = _smooth(both * (scatter - expected), side) / _smooth(both * room[:, None, None], side)
    values, vectors = np.linalg.eigh(found)
    found = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.swapaxes(1, 2)
    return found, _smooth(precision * seen, side) / _smooth(precision * by_noise, side)


def _smooth(values: FloatArray, side: int) -> FloatArray:
    """Return the mean of each of K rows and of `side` neighbours on either side.

    Many neighbours are averaged in blocks first.
    """
    from scipy.ndimage import convolve1d  # unlike a running sum it loses no digits next to larger values

    block = max(1, side // _NEIGHBOURS)
    starts = np.arange(0, len(values), block)
    counts = np.diff(np.append(starts, len(values)))
    means = np.add.reduceat(values, starts, axis=0) / counts.reshape(-1, *([1] * (values.ndim - 1)))
    size = min(2 * (side // block) + 1, len(means))
    return np.repeat(convolve1d(means, np.full(size, 1.0 / size), axis=0, mode="nearest"), counts, axis=0)


def _correlated_lines(deviation: ComplexArray, repeatability: FloatArray, noise: FloatArray) -> float:
    """Return the number of lines over which deviations of repeats correlate, 1 for noise."""
    lines = len(repeatability)
    scaled = deviation / np.sqrt(noise + _total_variance(repeatability))
    spectrum = np.fft.fft(scaled - scaled.mean(axis=0), n=2 * lines, axis=1)
    products = np.abs(np.fft.ifft(np.sum(np.abs(spectrum) ** 2, axis=(0, 2))))[: lines // 2 + 1]
    found = products / max(float(products[0]), np.finfo(np.float64).tiny)
    small = np.flatnonzero(found < _CERTAIN / np.sqrt((len(deviation) - 1) * lines * deviation.shape[2]))
    return float(1.0 + 2.0 * np.sum(found[1 : int(small[0]) if len(small) else None] ** 2))


# What the repeats show, as notices.

_UNLIKELY = 1e-4  # probability, over all blocks of a record, below which the repeats differ
_BLOCK = 2 * _NEIGHBOURS + 1
_DIFFERENT_LEVELS = 1.2  # ratio of levels of the excitation


def _notices(record: TransferRecord, spectra: BurstSpectra, estimate: _JoinedRepeats, files: int) -> tuple[Notice, ...]:
    """Return the notices of an estimate from repeats."""
    repeats, name = len(spectra.value), record.reference_name
    lines, spacing = len(spectra.frequency_hz), spectra.spacing_hz
    notices = [Notice(REST_ESTIMATE, name, lines=lines, repeats=repeats, records=files, spacing_hz=spacing)]
    if repeats == 1:
        notices.append(Notice(SINGLE_REPEAT, name))
    names = (name, *record.channels)
    relative = np.sqrt(_total_variance(estimate.covariance)) / np.abs(estimate.ratio)
    for ringing in spectra.ringing:
        near = int(np.argmin(np.abs(spectra.frequency_hz - ringing.frequency_hz)))
        channel = names[ringing.channel]
        if ringing.share > _RINGS:
            raise RestError(channel, ringing.end, ringing.share)
        if ringing.share > _MATTERS * relative[near].min():
            notices.append(
                Notice(
                    RINGS_AT_END,
                    channel,
                    end=ringing.end,
                    frequency_hz=ringing.frequency_hz,
                    share_percent=100.0 * ringing.share,
                )
            )
    levels = np.sqrt(np.mean(np.abs(spectra.value[:, :, 0]) ** 2, axis=1))
    factor = float(levels.max() / levels.min())
    for c, channel in enumerate(record.channels):
        differ = _differs(estimate.excess[:, c], repeats, spectra.dof)
        if not differ.any():
            continue
        frequency = spectra.frequency_hz[differ]
        values: dict[str, Value] = {
            "low_hz": float(frequency.min()),
            "high_hz": float(frequency.max()),
            "percent": 100.0 * float(np.sqrt(np.median(_total_variance(estimate.repeatability)[differ, c]))),
            "times": float(np.sqrt(np.median(estimate.excess[differ, c]))),
        }
        same_level = factor < _DIFFERENT_LEVELS
        notices.append(
            Notice(REPEATS_DIFFER, channel, **values)
            if same_level
            else Notice(AMPLITUDE_DEPENDENCE, channel, factor=factor, **values)
        )
    return tuple(notices)


def _differs(excess: FloatArray, repeats: int, noise_dof: float) -> BoolArray:
    """Return the lines around which the repeats scatter by more than the noise (Fisher)."""
    from scipy.special import fdtrc

    blocks = max(1, len(excess) // _BLOCK)
    dof = 2.0 * max(repeats - 1, 1) * min(_BLOCK, len(excess))
    return np.asarray((repeats > 1) & (fdtrc(dof, noise_dof, excess) < _UNLIKELY / blocks))


def _repeat_effects(estimate: _JoinedRepeats, noise_dof: float) -> ComplexArray | None:
    """Return the effect (M, K, C) of repeats that differ by more than noise.

    Their root sum of squares is the standard uncertainty of the mean of M repeats, enlarged for its M - 1 degrees of
    freedom so that twice it covers 95 %. All lines of one repeat deviate together: a resonance that moves, moves in
    all of its lines.
    """
    from scipy.special import stdtrit

    count = len(estimate.common)
    differ = [_differs(excess, count, noise_dof).any() for excess in estimate.excess.T]
    if not any(differ):
        return None
    factor = np.sqrt(count / (count - 1.0)) * float(stdtrit(count - 1.0, 0.975)) / 1.96
    return np.asarray(factor * estimate.common * differ)
