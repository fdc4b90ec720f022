"""Transfer functions by local polynomials: the spectrum of a whole record, without segments and window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray
from shaker.signals.transfer.estimators import Spectra
from shaker.signals.transfer.result import TransferRecord

_ORDER = 6  # of the polynomials in frequency
_LOWER_ORDER = 4  # of those that show what the order matters
_WINDOW = 5.0  # lines of the wanted spacing that one polynomial spans
_UNKNOWNS = 2 * (_ORDER + 1)  # coefficients of transfer function and transient
_FEWEST_BINS = 2 * _UNKNOWNS  # of a record's spectrum in a window, half of them for the noise
LEAST_SEGMENTS = _FEWEST_BINS / _WINDOW
"""Length of the shortest record over 1/(line spacing)."""
_CERTAIN = 4.0  # times its variance that the square of a difference reaches by chance once in fifty lines
_TOGETHER = 200_000  # bins of all windows that are solved at once


@dataclass(frozen=True)
class LocalSpectra:
    """Spectra at K lines freed from leakage, `dof` real degrees of freedom of the noise, correlation of lines (D,).

    `bias` (K, C): by how much a lower order gives another transfer function, zero where noise may have done it.
    """

    spectra: Spectra
    bias: ComplexArray
    dof: float
    line_correlation: ComplexArray
    bins: int

    def text(self) -> str:
        """Say what was fitted."""
        return f"local polynomials of order {_ORDER} over {self.bins} bins of the whole record"


def enough_bins(samples: int, length: int) -> bool:
    """Tell whether a record of `samples` has bins enough for lines a `length`-th of the sample rate apart."""
    return samples >= LEAST_SEGMENTS * length


def local_spectra(record: TransferRecord, length: int, frequency_hz: FloatArray) -> LocalSpectra:
    """Return spectra [reference, responses] at lines (K,), Hz, a `length`-th of the sample rate apart.

    Over a window of five lines of the record's own DFT, r bins from the line,
    Y(r) = Σ g_s rˢ·X(r) + Σ t_s rˢ, s = 0 … 6, by least squares: t is what the record's beginning and end leave
    (leakage), smooth in frequency, g₀ the transfer function at the line (Pintelon and Schoukens, System Identification,
    2nd ed., 2012, sec. 7.2; Schoukens, Vandersteen, Barbé and Pintelon, Eur. J. Control 15, 2009). What the fit leaves,
    per degree of freedom, is the noise S_ee. Given back is S_xx = mean |X|², S_yx = g₀ S_xx, S_yy = |g₀|² S_xx + S_ee,
    worth n + 1 averages, n = (X*QX)/S_xx, Q the projection on what the other unknowns do not explain: then
    var g₀ = S_ee/(n S_xx), and noise on the reference lowers g₀ as it lowers H1, so that H2 and Hv can be had from
    these spectra as from averaged ones. Errors of two lines correlate as far as their windows overlap. A resonance
    that is too narrow for these polynomials is still more so for those of order 4: the difference bounds the bias.
    """
    samples = len(record.reference)
    together = np.column_stack([record.reference, record.responses])
    transform = np.fft.rfft(together - together.mean(axis=0), axis=0)
    bins = round(_WINDOW * samples / length)
    place = frequency_hz * (samples / record.sample_rate_hz)
    first = np.clip(np.round(place - 0.5 * (bins - 1)).astype(np.int64), 1, len(transform) - 1 - bins)
    count = max(1, _TOGETHER // bins)
    parts = [_solved(transform, place[k : k + count], first[k : k + count], bins) for k in range(0, len(place), count)]
    power, averages, bias = (np.concatenate(part) for part in zip(*parts, strict=True))
    correlation = _kernel_correlation(bins, samples / length)
    return LocalSpectra(Spectra(power, averages), bias, 2.0 * (bins - _UNKNOWNS), correlation, bins)


@dataclass(frozen=True)
class _Fit:
    """Polynomials in windows of B bins: `ratio` (K, C), `information` (K,) and `noise` (K, C, C) behind it."""

    ratio: ComplexArray
    information: FloatArray
    noise: ComplexArray


def _solved(
    transform: ComplexArray, place: FloatArray, first: IntArray, bins: int
) -> tuple[ComplexArray, FloatArray, ComplexArray]:
    """Return power (K, 1 + C, 1 + C), averages (K,) and bias (K, C) of the windows that begin at the bins `first`."""
    index = first[:, None] + np.arange(bins)
    powers = ((index - place[:, None]) / (0.5 * bins))[:, :, None] ** np.arange(_ORDER + 1)
    reference, responses = transform[index, :1], transform[index, 1:]
    fit = _fitted(powers, reference, responses)
    lower = _fitted(powers[:, :, : _LOWER_ORDER + 1], reference, responses)
    level = np.mean(np.abs(reference[:, :, 0]) ** 2, axis=1) + np.finfo(np.float64).tiny ** 0.5
    through = np.concatenate([np.ones_like(fit.ratio[:, :1]), fit.ratio], axis=1)
    power = level[:, None, None] * through[:, :, None] * through.conj()[:, None, :]
    power[:, 1:, 1:] += fit.noise
    # The lower fit is part of the higher one, so that the variance of their difference is that of their variances.
    gained = 1.0 / fit.information - 1.0 / lower.information
    by_chance = np.einsum("kcc->kc", fit.noise).real * gained[:, None]
    difference = fit.ratio - lower.ratio
    bias = np.where(np.abs(difference) ** 2 > _CERTAIN * by_chance, difference, 0.0)
    return power, 1.0 + fit.information / level, bias


def _fitted(powers: FloatArray, reference: ComplexArray, responses: ComplexArray) -> _Fit:
    """Fit polynomials with `powers` (K, B, P) of the place to responses (K, B, C) on a reference (K, B, 1)."""
    # The transfer function at the line comes last but the responses, so that the triangle holds it alone.
    columns = np.concatenate([powers[:, :, 1:] * reference, powers, reference, responses], axis=2)
    triangle: ComplexArray = np.asarray(np.linalg.qr(columns, mode="r"))
    last = 2 * powers.shape[2] - 1
    pivot = triangle[:, last, last]
    pivot = np.where(pivot == 0.0, np.finfo(np.float64).tiny ** 0.25, pivot)
    left = triangle[:, last + 1 :, last + 1 :]
    noise = left.swapaxes(1, 2) @ left.conj() / (powers.shape[1] - last - 1)
    return _Fit(triangle[:, last, last + 1 :] / pivot[:, None], np.abs(pivot) ** 2, noise)


def _kernel_correlation(bins: int, step: float) -> ComplexArray:
    """Return the correlation (D,) of polynomial fits at the middle of windows that lie `step` bins apart."""
    centred = (np.arange(bins) - 0.5 * (bins - 1)) / (0.5 * bins)
    kernel = np.linalg.pinv(centred[:, None] ** np.arange(_ORDER + 1))[0]
    apart = np.round(np.arange(0.0, bins, step)).astype(np.int64)
    apart = apart[apart < bins]
    return np.array([kernel[: bins - d] @ kernel[d:] / (kernel @ kernel) for d in apart], dtype=np.complex128)
