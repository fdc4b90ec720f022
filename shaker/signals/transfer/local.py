"""Transfer functions by local polynomials: the spectrum of a whole record, without segments and window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray
from shaker.signals.transfer.estimators import Spectra
from shaker.signals.transfer.result import TransferRecord

_ORDER = 6  # of the polynomials in frequency
_WINDOW = 5.0  # lines of the wanted spacing that one polynomial spans
_UNKNOWNS = 2 * (_ORDER + 1)  # coefficients of transfer function and transient
_FEWEST_BINS = 2 * _UNKNOWNS  # of a record's spectrum in a window, half of them for the noise
LEAST_SEGMENTS = _FEWEST_BINS / _WINDOW
"""Length of the shortest record over 1/(line spacing)."""
_TOGETHER = 200_000  # bins of all windows that are solved at once


@dataclass(frozen=True)
class LocalSpectra:
    """Spectra at K lines freed from leakage, `dof` real degrees of freedom of the noise, correlation of lines (D,)."""

    spectra: Spectra
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
    these spectra as from averaged ones. Errors of two lines correlate as far as their windows overlap.
    """
    samples = len(record.reference)
    together = np.column_stack([record.reference, record.responses])
    transform = np.fft.rfft(together - together.mean(axis=0), axis=0)
    bins = round(_WINDOW * samples / length)
    place = frequency_hz * (samples / record.sample_rate_hz)
    first = np.clip(np.round(place - 0.5 * (bins - 1)).astype(np.int64), 1, len(transform) - 1 - bins)
    count = max(1, _TOGETHER // bins)
    parts = [_solved(transform, place[k : k + count], first[k : k + count], bins) for k in range(0, len(place), count)]
    power, averages = (np.concatenate(part) for part in zip(*parts, strict=True))
    correlation = _kernel_correlation(bins, samples / length)
    return LocalSpectra(Spectra(power, averages), 2.0 * (bins - _UNKNOWNS), correlation, bins)


def _solved(transform: ComplexArray, place: FloatArray, first: IntArray, bins: int) -> tuple[ComplexArray, FloatArray]:
    """Return power (K, 1 + C, 1 + C) and averages (K,) of the windows that begin at the bins `first`."""
    index = first[:, None] + np.arange(bins)
    powers = ((index - place[:, None]) / (0.5 * bins))[:, :, None] ** np.arange(_ORDER + 1)
    reference, responses = transform[index, :1], transform[index, 1:]
    # The transfer function at the line comes last but the responses, so that the triangle holds it alone.
    columns = np.concatenate([powers[:, :, 1:] * reference, powers, reference, responses], axis=2)
    triangle: ComplexArray = np.asarray(np.linalg.qr(columns, mode="r"))
    last = _UNKNOWNS - 1
    pivot = triangle[:, last, last]
    pivot = np.where(pivot == 0.0, np.finfo(np.float64).tiny ** 0.25, pivot)
    ratio = triangle[:, last, last + 1 :] / pivot[:, None]
    left = triangle[:, last + 1 :, last + 1 :]
    noise = left.swapaxes(1, 2) @ left.conj() / (bins - _UNKNOWNS)
    level = np.mean(np.abs(reference[:, :, 0]) ** 2, axis=1) + np.finfo(np.float64).tiny ** 0.5
    through = np.concatenate([np.ones_like(ratio[:, :1]), ratio], axis=1)
    power = level[:, None, None] * through[:, :, None] * through.conj()[:, None, :]
    power[:, 1:, 1:] += noise
    return power, 1.0 + np.abs(pivot) ** 2 / level


def _kernel_correlation(bins: int, step: float) -> ComplexArray:
    """Return the correlation (D,) of polynomial fits at the middle of windows that lie `step` bins apart."""
    centred = (np.arange(bins) - 0.5 * (bins - 1)) / (0.5 * bins)
    kernel = np.linalg.pinv(centred[:, None] ** np.arange(_ORDER + 1))[0]
    apart = np.round(np.arange(0.0, bins, step)).astype(np.int64)
    apart = apart[apart < bins]
    return np.array([kernel[: bins - d] @ kernel[d:] / (kernel @ kernel) for d in apart], dtype=np.complex128)
