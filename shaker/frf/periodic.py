"""Transfer functions from periodic excitation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker.frf.result import TransferFunction, TransferRecord, circular_covariance, excited_lines, pooled_scatter
from shaker.signal_notices import (
    EXCITATION_AMPLITUDE_CHANGES,
    NONLINEAR_DISTORTIONS,
    NOT_SETTLED,
    PERIODIC_ESTIMATE,
    RESPONSE_DRIFTS,
)
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import Notice

# Phasors of every period of a periodic signal, also where the period is no whole number of samples.

_SOFT_SAMPLES = 128  # length of the seam of two soft windows, at most
_SOFT_ORDER = 8  # derivatives of a soft window that vanish at its ends; chosen for low leakage
_WHOLE = 1e-7  # distance from a whole number of samples that no record notices
_STEPS = 8  # largest number of corrections of a period
_TOLERANCE = 1e-3  # error of a stated period that is put right
_SAME_PERIOD = 4.0  # standard uncertainties within which a stated period is taken to be the true one


@dataclass(frozen=True)
class Periods:
    """Phasors (M, K, C) of M periods at harmonics, from each period's begin."""

    harmonic: IntArray
    value: ComplexArray


@dataclass(frozen=True)
class Period:
    """Length of a period in samples with uncertainty, begin and number."""

    samples: float
    u_samples: float
    start: float
    count: int


def count_periods(length: int, start: float, samples: float) -> int:
    """Return the number of periods, of which the last may lack half a seam."""
    slack = 0.0 if _is_whole(samples) and _is_whole(start) else 0.5 * _seam(samples)
    return int(np.floor((length - start + slack) / samples + 1e-12))


def find_period(reference: FloatArray, samples: float, settle_periods: int) -> Period:
    """Return the exact period of `reference` (S,) from a stated one.

    The stated period is in samples, good to 0.1 %. Delays of all periods relative to their mean, d_m = Σ k·Im(X_m X̄*)
    / Σ k²|X̄|², weight every line by its information. Their slope over m is the period's error. The stated period is
    used where the record does not contradict it.
    """
    stated, u_samples = samples, np.inf
    for step in range(_STEPS):
        start = settle_periods * samples
        count = count_periods(len(reference), start, samples)
        if count < 2:
            break
        periods = period_phasors(reference[:, None], Period(samples, 0.0, start, count), (0.0, 0.45), rounds=2)
        error, u_samples = _period_error(periods.value[:, :, 0], samples)
        if (step == 0 and abs(error) <= _SAME_PERIOD * u_samples) or abs(error) <= 0.05 * u_samples:
            break
        samples += error
    if abs(samples - stated) > _TOLERANCE * stated:
        raise ValueError(
            f"period_s: expected the period of the reference within 0.1 %, found a record that repeats after "
            f"{samples / stated:.5f} of it"
        )
    start = settle_periods * samples
    return Period(samples, u_samples, start, count_periods(len(reference), start, samples))


def _period_error(spectrum: ComplexArray, samples: float) -> tuple[float, float]:
    """Return the error of the period in samples, positive if too short, and its uncertainty.

    The input are phasors (M, K) at the harmonics 1, 2 … K. A signal that repeats e samples later turns its k-th phasor
    by -2πke/P from one period to the next.
    """
    count, lines = spectrum.shape
    harmonic = np.arange(1.0, lines + 1.0)
    # The delay between periods: of the highest peaks of their correlation the one nearest zero.
    cross = np.sum(spectrum[1:] * spectrum[:-1].conj(), axis=0)
    points = 2 * (lines + 1)
    correlation = np.fft.irfft(np.concatenate([[0.0], cross]), n=points)
    lag = np.fft.fftfreq(points, 1.0 / points)
    inside = np.abs(lag) <= max(2.0, 1.5 * _TOLERANCE * points)
    lags = lag[inside & (correlation >= 0.98 * correlation[inside].max())]
    coarse = float(lags[np.argmin(np.abs(lags))] * samples / points)
    turn = np.exp(2j * np.pi * np.multiply.outer(np.arange(count), harmonic) * coarse / samples)
    aligned = spectrum * turn
    mean = aligned.mean(axis=0)
    weight = np.sum(harmonic**2 * np.abs(mean) ** 2)
    if not weight > 0.0:
        raise ValueError("reference: expected a periodic signal, found none")
    scale = samples / (2.0 * np.pi * weight)
    delay = -scale * np.sum(harmonic * (aligned * mean.conj()).imag, axis=1)
    scatter = np.sum(np.abs(aligned - mean) ** 2, axis=0) / (count - 1)
    u_delay = scale * np.sqrt(0.5 * np.sum(harmonic**2 * np.abs(mean) ** 2 * scatter))
    middle = np.arange(count) - 0.5 * (count - 1)
    return coarse + float(middle @ delay / (middle @ middle)), float(u_delay / np.sqrt(middle @ middle))


def period_phasors(data: FloatArray, period: Period, share: tuple[float, float], rounds: int = 5) -> Periods:
    """Return phasors of every period of `data` (S, C) in a band.

    `share` is the band relative to the sampling rate. A period of a whole number of samples is transformed directly.
    For others each period has a window that rises and falls as 1 - rise of the next one, so that all windows add to
    one. Then Σ w(t)·exp(j2πnt/T) is zero for every n but 0 to 1e-7 or better (at 0.4 of the rate 1e-11), and the
    harmonics do not leak into one another. The harmonics of 1/T lie on no grid of a fast Fourier transform; the chirp
    z-transform (Rabiner, Schafer and Rader 1969) computes them. Samples missing in the seams at both ends are replaced
    by the mean period, in `rounds` iterations.
    """
    harmonic = np.arange(max(1, int(np.ceil(share[0] * period.samples))), int(share[1] * period.samples) + 1)
    if not len(harmonic):
        raise ValueError(f"band_hz: expected a band with harmonics of the period, found none of {period.samples:.6g}")
    if _is_whole(period.samples) and _is_whole(period.start):
        samples, start = round(period.samples), round(period.start)
        used = data[start : start + period.count * samples].reshape(period.count, samples, -1)
        value = np.stack([np.fft.rfft(part, axis=0)[harmonic] for part in used])
        return Periods(harmonic, 2.0 / samples * value)
    return Periods(harmonic, _soft_phasors(data, period, harmonic, rounds))


def _soft_phasors(data: FloatArray, period: Period, harmonic: IntArray, rounds: int) -> ComplexArray:
    """Return phasors (M, K, C) with windows whose sum is one."""
    from scipy.signal import CZT
    from scipy.special import betainc

    seam, samples = _seam(period.samples), period.samples

    def rise(t: FloatArray) -> FloatArray:
        return np.asarray(betainc(_SOFT_ORDER + 1, _SOFT_ORDER + 1, np.clip(t / seam + 0.5, 0.0, 1.0)))

    half = int(np.ceil(0.5 * seam)) + 2
    first = int(np.floor(period.start)) - half
    last = int(np.ceil(period.start + period.count * samples)) + half
    index = np.arange(first, last)
    missing = (index < 0) | (index >= len(data))
    padded = data[np.clip(index, 0, len(data) - 1)] - data.mean(axis=0)
    padded[missing] = 0.0
    # Samples (M, N) in the window of each period, and its transform at the harmonics 1, 2 … K.
    begin = period.start + samples * np.arange(period.count)
    index_in_window = np.searchsorted(index, begin - 0.5 * seam)[:, None] + np.arange(int(np.ceil(samples + seam)) + 1)
    time = index[index_in_window] - begin[:, None]
    window = rise(time) - rise(time - samples)
    every, step = np.arange(1, int(0.49 * samples) + 1), np.exp(-2j * np.pi / samples)
    transform = CZT(index_in_window.shape[1], m=len(every), w=step, a=1.0 / step)

    def phasors(m: int) -> ComplexArray:
        turn = 2.0 / samples * np.exp(-2j * np.pi * every * (time[m, 0] / samples))
        return np.asarray(turn[:, None] * transform(window[m][:, None] * padded[index_in_window[m]], axis=0))

    value = np.stack([phasors(m) for m in range(period.count)])
    weight = np.bincount(index_in_window.ravel(), window.ravel(), len(index))[missing] / period.count
    turns = 2j * np.pi / samples * (index[missing] - period.start)
    basis = np.exp(np.multiply.outer(turns, every))
    for _ in range(rounds if missing.any() else 0):
        model = (basis @ value.mean(axis=0)).real
        # A missing sample lowers the mean that replaces it by its weight.
        padded[missing] += (model - padded[missing]) / (1.0 - weight[:, None])
        for m in {0, period.count - 1}:
            value[m] = phasors(m)
    return np.asarray(value[:, harmonic[0] - 1 : harmonic[-1]])


def _seam(samples: float) -> float:
    """Return the number of samples over which one window passes into the next."""
    return float(min(_SOFT_SAMPLES, samples / 4.0))


def _is_whole(samples: float) -> bool:
    """Return whether a number of samples is whole within the resolution of any record."""
    return abs(samples - round(samples)) < _WHOLE * max(1.0, samples / 1e4)


# Further results of the periods: a structure not settled, drift, distortions.

_BLOCK = 8  # lines that are tested together
_UNLIKELY = 1e-4  # probability, over all blocks of a record, below which periods differ
_GAIN = 1e-3  # change of the reference's amplitude between periods that is reported
_DISTORTION = 3.0  # mean of an unexcited line over its uncertainty, rms, from which it is a distortion


def period_notices(
    record: TransferRecord, period: Period, lines: Periods, excited: BoolArray, ratio: ComplexArray
) -> tuple[Notice, ...]:
    """Return the notices about periods with phasors (M, K, 1 + C)."""
    rate = record.sample_rate_hz
    frequency = np.asarray(lines.harmonic * (rate / period.samples), dtype=np.float64)
    value = lines.value[:, excited]
    estimate = Notice(
        PERIODIC_ESTIMATE,
        record.reference_name,
        lines=value.shape[1],
        periods=period.count,
        period_s=period.samples / rate,
        u_relative=period.u_samples / period.samples,
    )
    notices = [estimate, *_reference_drift(value[:, :, 0], record.reference_name)]
    for c, name in enumerate(record.channels):
        error = value[:, :, 1 + c] - ratio[:, c] * value[:, :, 0]
        notices += _unsettled(error, value[:, :, 1 + c], frequency[excited], name)
        notices += _distortions(lines, excited, ratio[:, c], 1 + c, name)
    return tuple(notices)


def _reference_drift(reference: ComplexArray, name: str) -> list[Notice]:
    """Return a notice of a reference whose amplitude changes; the ratio is not affected."""
    mean = reference.mean(axis=0)
    power = np.sum(np.abs(mean) ** 2)
    gain = np.sum(reference * mean.conj(), axis=1) / power
    scatter = np.sum(np.abs(reference - gain[:, None] * mean) ** 2 * np.abs(mean) ** 2) / max(1, len(reference) - 1)
    u_gain = np.sqrt(0.5 * scatter) / power
    span = float(np.ptp(gain.real))
    if span < max(_GAIN, 6.0 * float(u_gain)):
        return []
    return [Notice(EXCITATION_AMPLITUDE_CHANGES, name, change_percent=100.0 * span)]


def _unsettled(error: ComplexArray, response: ComplexArray, frequency: FloatArray, name: str) -> list[Notice]:
    """Return a notice of a different first period, or of drift."""
    count = len(error)
    if count < 3:
        return []
    first = np.full(count, -1.0 / (count - 1))
    first[0] = 1.0
    early = _differs(error, first, frequency)
    if early.any():
        size = np.abs(error[0] - error[1:].mean(axis=0))[early].max() / np.abs(response.mean(axis=0))[early].max()
        return [Notice(NOT_SETTLED, name, **_limits(frequency[early]), difference_percent=100.0 * float(size))]
    trend = _differs(error, np.arange(0.0, count) - 0.5 * (count - 1), frequency)
    if trend.any():
        return [Notice(RESPONSE_DRIFTS, name, **_limits(frequency[trend]))]
    return []


def _limits(frequency: FloatArray) -> dict[str, float]:
    """Return the lowest and the highest frequency as values of a notice."""
    return {"low_hz": float(frequency.min()), "high_hz": float(frequency.max())}


def _differs(error: ComplexArray, contrast: FloatArray, frequency: FloatArray) -> BoolArray:
    """Return the lines in blocks where a contrast over periods is significant (Fisher)."""
    from scipy.special import fdtrc

    unit = contrast / np.sqrt(contrast @ contrast)
    along = np.einsum("m,mk->k", unit, error)
    power = np.abs(along) ** 2
    rest = np.sum(np.abs(error - error.mean(axis=0)) ** 2, axis=0) - power
    blocks = np.arange(0, len(frequency), _BLOCK)
    size = np.diff(np.append(blocks, len(frequency)))
    others = len(error) - 2
    tiny = np.finfo(np.float64).tiny
    quotient = np.add.reduceat(power, blocks) / np.maximum(np.add.reduceat(rest, blocks) / others, tiny)
    probability = fdtrc(2.0 * size, 2.0 * size * others, quotient)
    return np.repeat(np.asarray(probability < _UNLIKELY / len(blocks)), size)


def _distortions(lines: Periods, excited: BoolArray, ratio: ComplexArray, channel: int, name: str) -> list[Notice]:
    """Return a notice of distortions at even and odd unexcited lines of a multisine."""
    excited_index = np.flatnonzero(excited)
    silent = ~excited
    silent[: excited_index[0]] = silent[excited_index[-1] :] = False
    if np.count_nonzero(silent) < 0.1 * len(excited_index):
        return []
    through = np.interp(lines.harmonic, lines.harmonic[excited_index], ratio.real) + 1j * np.interp(
        lines.harmonic, lines.harmonic[excited_index], ratio.imag
    )
    # The response to a distorted reference is no distortion of the structure.
    remaining = lines.value[:, :, channel] - through * lines.value[:, :, 0]
    level = np.sqrt(np.mean(np.abs(lines.value[:, excited, channel].mean(axis=0)) ** 2))
    levels = []
    for word, remainder in (("even", 0), ("odd", 1)):
        chosen = silent & (lines.harmonic % 2 == remainder)
        if not chosen.any():
            continue
        mean = np.mean(np.abs(remaining[:, chosen].mean(axis=0)) ** 2)
        noise = np.mean(np.var(remaining[:, chosen], axis=0, ddof=1)) / len(remaining)
        if mean > _DISTORTION**2 * noise:
            levels.append(f"{20.0 * np.log10(np.sqrt(mean - noise) / level):.0f} dB at {word} lines")
    return [Notice(NONLINEAR_DISTORTIONS, name, levels=" and ".join(levels))] if levels else []


# Transfer functions from periodic excitation: errors-in-variables estimate, covariance over periods.

_HIGHEST = 0.45  # share of the sampling rate up to which lines are taken where no band is named


def transfer_periodic(
    record: TransferRecord, period_s: float, *, settle_periods: int = 0, band_hz: tuple[float, float] | None = None
) -> TransferFunction:
    """Return H = Ȳ/X̄ at the excited harmonics of a periodic excitation (chirp, multisine).

    Parameters
    ----------
    record
        Reference and responses.
    period_s
        Period in s, good to 0.1 %; it is refined on the reference.
    settle_periods
        Number of periods skipped at the begin, default 0.
    band_hz
        Band in Hz; default up to 0.45 of the sampling rate.

    Returns
    -------
    The transfer function with covariance and coherence.

    Raises
    ------
    ValueError
        Fewer than 2 whole periods remain, or the reference excites no line.

    Notes
    -----
    The maximum-likelihood estimate with noise on reference and responses (Pintelon and Schoukens, System
    Identification, 2nd ed., section 2.7.2): phasors are averaged over the M periods, then divided. The refined period
    avoids leakage if the excitation and the DAQ have separate clocks. The covariance is the scatter of Y_m - H·X_m over
    the periods (M ≥ 2), pooled over up to 17 neighbouring lines; `dof` is 2(M-1) times the lines pooled.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> from shaker import TransferRecord, transfer_periodic
    >>> force = np.tile(np.random.default_rng(0).normal(size=500), 8)
    >>> motion = lfilter([0.02], [1.0, -1.8, 0.97], force)
    >>> record = TransferRecord(force, motion[:, None], 1000.0, "force", "N", ("z",), ("m",))
    >>> transfer_periodic(record, period_s=0.5, settle_periods=1)
    TransferFunction(periodic over force: Phasors(225 lines from 2 to 450 Hz: z [m/N]))
    """
    rate = record.sample_rate_hz
    if settle_periods < 0 or not period_s * rate >= 16.0:
        raise ValueError(
            f"period_s: expected a period of 16 samples or more and settle_periods 0 or more, found {period_s} s "
            f"at {rate} Hz and {settle_periods}"
        )
    period = find_period(record.reference, period_s * rate, settle_periods)
    if period.count < 2:
        raise ValueError(
            f"period_s: expected at least 2 whole periods after {settle_periods} to settle, found {period.count} in "
            f"{len(record.reference) / rate:.6g} s"
        )
    share = (0.0, _HIGHEST) if band_hz is None else (max(0.0, band_hz[0] / rate), min(0.5, band_hz[1] / rate))
    together = np.column_stack([record.reference, record.responses])
    lines = period_phasors(together, period, share)
    excited = excited_lines(lines.value[:, :, 0])
    if not excited.any():
        raise ValueError(
            f"record: expected a reference that excites lines, found only noise in {record.reference_name}"
        )
    frequency = np.asarray(lines.harmonic * (rate / period.samples), dtype=np.float64)
    ratio, coherence = _ratio(lines.value[:, excited], frequency[excited], record)
    return TransferFunction(
        ratio=ratio,
        coherence=coherence,
        estimator="periodic",
        reference=record.reference_name,
        averages=np.full(len(coherence), float(period.count)),
        line_spacing_hz=rate / period.samples,
        line_correlation=np.ones(1, dtype=np.complex128),
        notices=period_notices(record, period, lines, excited, ratio.value),
    )


def _ratio(value: ComplexArray, frequency_hz: FloatArray, record: TransferRecord) -> tuple[Phasors, FloatArray]:
    """Return the ratio of means over periods, reference first, and its coherence."""
    count = len(value)
    reference, responses = value[:, :, 0], value[:, :, 1:]
    mean = reference.mean(axis=0)
    ratio = responses.mean(axis=0) / mean[:, None]
    error = responses - ratio * reference[:, :, None]
    scatter = np.einsum("mkc,mkd->kcd", error, error.conj()) / (count - 1)
    pooled, lines = pooled_scatter(scatter, ratio, 2.0 * (count - 1))
    covariance = circular_covariance(pooled / (count * np.abs(mean[:, None, None]) ** 2))
    cross = np.abs(np.sum(responses * reference.conj()[:, :, None], axis=0)) ** 2
    power = np.sum(np.abs(reference) ** 2, axis=0)[:, None] * np.sum(np.abs(responses) ** 2, axis=0)
    coherence = np.divide(cross, power, out=np.ones_like(power), where=power > 0.0)
    dof = 2.0 * (count - 1) * lines
    phasors = Phasors(frequency_hz, ratio, covariance, record.channels, record.ratio_unit, dof)
    return phasors, np.minimum(coherence, 1.0)
