"""Phasors of every period of a periodic signal, also where the period is no whole number of samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray

_SOFT_SAMPLES = 128  # length of the seam of two soft windows, at most
_SOFT_ORDER = 8
_WHOLE = 1e-7  # distance from a whole number of samples that no record notices
_STEPS = 8
_TOLERANCE = 1e-3  # error of a stated period that is put right
_SAME_PERIOD = 4.0  # standard uncertainties within which a stated period is taken to be the true one


@dataclass(frozen=True)
class Periods:
    """Phasors of M periods at the harmonics (K,) of 1/period: `value` (M, K, C), phases from each period's begin."""

    harmonic: IntArray
    value: ComplexArray


@dataclass(frozen=True)
class Period:
    """Length of a period in samples, its uncertainty, and where the first kept period begins."""

    samples: float
    u_samples: float
    start: float
    count: int


def count_periods(length: int, start: float, samples: float) -> int:
    """Return how many periods a record holds; the last may lack less than half a seam where samples do not fit."""
    slack = 0.0 if _is_whole(samples) and _is_whole(start) else 0.5 * _seam(samples)
    return int(np.floor((length - start + slack) / samples + 1e-12))


def find_period(reference: FloatArray, samples: float, settle_periods: int) -> Period:
    """Return the exact period of `reference` (S,) from a stated one in samples, good to 0.1 %.

    Delays of all periods against their mean, d_m = Σ k·Im(X_m X̄*) / Σ k²|X̄|², weigh every line by its information;
    their slope over m is the period's error. The stated period is kept where the record does not contradict it.
    """
    stated, u_samples = samples, np.inf
    for step in range(_STEPS):
        start = settle_periods * samples
        count = count_periods(len(reference), start, samples)
        if count < 2:
            break
        spectrum = period_phasors(reference[:, None], Period(samples, 0.0, start, count), (0.0, 0.45), rounds=2).value[
            :, :, 0
        ]
        error, u_samples = _period_error(spectrum, samples)
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
    """Return by how many samples the period is too short, and its uncertainty, from phasors (M, K) at 1, 2 … K.

    What repeats too late by e samples turns its k-th phasor by -2πke/P from one period to the next.
    """
    count, lines = spectrum.shape
    harmonic = np.arange(1.0, lines + 1.0)
    coarse = _coarse_error(np.sum(spectrum[1:] * spectrum[:-1].conj(), axis=0), samples)
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


def _coarse_error(cross: ComplexArray, samples: float) -> float:
    """Return the delay between periods in samples: of the highest peaks of their correlation the one nearest zero."""
    points = 2 * (len(cross) + 1)
    correlation = np.fft.irfft(np.concatenate([[0.0], cross]), n=points)
    lag = np.fft.fftfreq(points, 1.0 / points)
    inside = np.abs(lag) <= max(2.0, 1.5 * _TOLERANCE * points)
    high = inside & (correlation >= 0.98 * correlation[inside].max())
    place = lag[high][np.argmin(np.abs(lag[high]))]
    return float(place * samples / points)


def period_phasors(data: FloatArray, period: Period, share: tuple[float, float], rounds: int = 5) -> Periods:
    """Return the phasors of every period of `data` (S, C) at the harmonics between two shares of the sampling rate.

    A period of a whole number of samples is transformed as it is. Otherwise each period is seen through a window that
    rises and falls as 1 - rise of the next one, so that all windows add to one: then Σ w(t)·exp(j2πnt/T) is zero for
    every n but 0 to 1e-7 or better (at 0.4 of the rate 1e-11), and the harmonics do not leak into one another. The
    harmonics of 1/T lie on no grid of a fast Fourier transform; the chirp z-transform (Rabiner, Schafer and Rader
    1969) reaches them. What the seams at both ends of the record lack comes from the mean
    period, in some rounds.
    """
    harmonic = np.arange(max(1, int(np.ceil(share[0] * period.samples))), int(share[1] * period.samples) + 1)
    if not len(harmonic):
        raise ValueError(f"band_hz: expected a band with harmonics of the period, found none of {period.samples:.6g}")
    if _is_whole(period.samples) and _is_whole(period.start):
        samples, start = round(period.samples), round(period.start)
        kept = data[start : start + period.count * samples].reshape(period.count, samples, -1)
        value = np.stack([np.fft.rfft(part, axis=0)[harmonic] for part in kept])
        return Periods(harmonic, 2.0 / samples * value)
    return Periods(harmonic, _soft_phasors(data, period, harmonic, rounds))


@dataclass(frozen=True)
class _Seen:
    """One period as its window sees it: where it stands in the padded record, the window, and its transform."""

    part: slice
    window: FloatArray
    transform: Callable[..., ComplexArray]
    turn: ComplexArray

    def phasors(self, padded: FloatArray) -> ComplexArray:
        """Return the phasors (K, C) of the period."""
        return self.turn[:, None] * self.transform(self.window[:, None] * padded[self.part], axis=0)


def _soft_phasors(data: FloatArray, period: Period, harmonic: IntArray, rounds: int) -> ComplexArray:
    """Return phasors (M, K, C) through windows whose sum is one."""
    half = int(np.ceil(0.5 * _seam(period.samples))) + 1
    first = int(np.floor(period.start)) - half
    last = int(np.ceil(period.start + period.count * period.samples)) + half
    index = np.arange(first, last)
    missing = (index < 0) | (index >= len(data))
    padded = data[np.clip(index, 0, len(data) - 1)] - data.mean(axis=0)
    padded[missing] = 0.0
    seen = _windows(index, period, np.arange(1, int(0.49 * period.samples) + 1))
    value = np.stack([window.phasors(padded) for window in seen])
    weight = np.zeros(len(index))
    for window in seen:
        weight[window.part] += window.window
    weight = weight[missing] / period.count
    turns = 2j * np.pi / period.samples * (index[missing] - period.start)
    basis = np.exp(np.multiply.outer(turns, np.arange(1.0, value.shape[1] + 1.0)))
    for _ in range(rounds if missing.any() else 0):
        model = (basis @ value.mean(axis=0)).real
        # A sample that is missing lowers the mean it is taken from by its own weight.
        padded[missing] += (model - padded[missing]) / (1.0 - weight[:, None])
        for m in {0, period.count - 1}:
            value[m] = seen[m].phasors(padded)
    return np.asarray(value[:, harmonic[0] - 1 : harmonic[-1]])


def _windows(index: IntArray, period: Period, harmonic: IntArray) -> list[_Seen]:
    """Return the soft windows of all periods and their transforms at the harmonics 1, 2 … K."""
    from scipy.signal import CZT
    from scipy.special import betainc

    seam, samples = _seam(period.samples), period.samples

    def rise(t: FloatArray) -> FloatArray:
        return np.asarray(betainc(_SOFT_ORDER + 1, _SOFT_ORDER + 1, np.clip(t / seam + 0.5, 0.0, 1.0)))

    step = np.exp(-2j * np.pi / samples)
    transforms: dict[int, Callable[..., ComplexArray]] = {}
    seen = []
    for number in range(period.count):
        begin = period.start + number * samples
        low, high = np.searchsorted(index, [begin - 0.5 * seam, begin + samples + 0.5 * seam])
        time = np.asarray(index[low:high] - begin, dtype=np.float64)
        length = int(high - low)
        if length not in transforms:
            transforms[length] = CZT(length, m=len(harmonic), w=step, a=1.0 / step)
        turn = 2.0 / samples * np.exp(-2j * np.pi * harmonic * (time[0] / samples))
        seen.append(_Seen(slice(low, high), rise(time) - rise(time - samples), transforms[length], turn))
    return seen


def _seam(samples: float) -> float:
    """Return over how many samples one window passes into the next."""
    return float(min(_SOFT_SAMPLES, samples / 4.0))


def _is_whole(samples: float) -> bool:
    """Tell whether a number of samples is whole as far as any record can tell."""
    return abs(samples - round(samples)) < _WHOLE * max(1.0, samples / 1e4)
