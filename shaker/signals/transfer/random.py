"""Transfer functions from noise: local polynomials, or averaged spectra of overlapping segments; H1, H2, Hv."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.signals.phasor import Phasors
from shaker.signals.spectrum import window_samples
from shaker.signals.transfer.estimators import Spectra, choose_estimator, transfer_of
from shaker.signals.transfer.local import LEAST_SEGMENTS, enough_bins, local_spectra
from shaker.signals.transfer.result import TransferFunction, TransferRecord, circular_covariance
from shaker.signals.transfer.sharpness import resolution_notices

_HOP = 3  # segments begin every third of their length: 67 % overlap
_FIRST_BIN = 3  # a Hann window lets what the mean left reach the bins below
_REACH = 8  # lines over which those errors correlate
_CORRELATED = 1e-4  # correlation of the errors of neighbouring lines that counts


def transfer_random(
    record: TransferRecord,
    resolution_hz: float,
    *,
    estimator: Literal["auto", "local", "H1", "H2", "Hv"] = "auto",
    noise_ratio: float | None = None,
    band_hz: tuple[float, float] | None = None,
) -> TransferFunction:
    """Return H from a stationary random excitation at lines `resolution_hz` apart.

    "local": local polynomials on the spectrum of the whole record (see `local_spectra`), no leakage, H1, H2 or Hv of
    the spectra that they give. "H1", "H2", "Hv": Welch's averaged spectra of Hann segments of 1/resolution that overlap
    by 67 % and count as n independent ones (IEEE Trans. Audio Electroacoust. 15, 1967). "auto" takes "local" where the
    record is 5.6 such segments long or more, else the segments.
    H1 = S_xy/S_xx suffers from noise on the reference, H2 = S_yy/S_yx from noise on the response, Hv (total least
    squares) from neither if the ratio of the noise powers, response over reference, is that of `noise_ratio`; None
    takes it from the coherence. A notice says what was taken and why. Covariance: S_ee/(n S_xx) of what H leaves of the
    responses (Bendat and Piersol, Random Data, 4th ed., eqs. 9.89 and 9.90, without the approximation for large n);
    added is the square of the bias: of segments its leading term, H''/6 per line squared (the average of H over |W|²,
    whose second moment is 1/3 for Hann), of polynomials what a lower order makes of H.
    """
    length = _length(record, resolution_hz)
    chosen = _lines(record.sample_rate_hz, length, band_hz)
    local = estimator == "local" or (estimator == "auto" and enough_bins(len(record.reference), length))
    source = _local(record, length, chosen) if local else _segments(record, length, chosen)
    wanted = "auto" if estimator == "local" else estimator
    choice = choose_estimator(source.spectra, wanted, noise_ratio, record.reference_name)
    found = transfer_of(source.spectra, choice)
    bias = _leakage(found.ratio) if source.bias is None else source.bias
    covariance = found.covariance + circular_covariance(bias[:, :, None] * bias.conj()[:, None, :])
    notices = [choice.notice(record.reference_name, source.text)]
    cause = "a polynomial over five lines" if local else "leakage"
    for c, name in enumerate(record.channels):
        notices += resolution_notices(chosen, found.ratio[:, c], np.sqrt(found.covariance[:, c, c]), name, cause)
    return TransferFunction(
        ratio=Phasors(chosen, found.ratio, covariance, record.channels, record.ratio_unit, source.dof),
        coherence=found.coherence,
        estimator="local" if local else choice.estimator,
        reference=record.reference_name,
        averages=source.spectra.averages,
        line_spacing_hz=record.sample_rate_hz / length,
        line_correlation=source.line_correlation,
        notices=tuple(notices),
    )


@dataclass(frozen=True)
class _Source:
    """Spectra at K lines, bias (K, C) if known, `dof` (K,) of noise, correlation of lines (D,), how they were made."""

    spectra: Spectra
    bias: ComplexArray | None
    dof: FloatArray
    line_correlation: ComplexArray
    text: str


def _length(record: TransferRecord, resolution_hz: float) -> int:
    """Return the samples of 1/resolution."""
    rate = record.sample_rate_hz
    if not 0.0 < resolution_hz < rate / 16.0:
        raise ValueError(f"resolution_hz: expected a value in (0, {rate / 16.0:.6g}), found {resolution_hz}")
    length = round(rate / resolution_hz)
    if len(record.reference) < 2 * length:
        raise ValueError(
            f"resolution_hz: expected two segments or more in the record, so at least "
            f"{2.0 * rate / len(record.reference):.3g} Hz, found {resolution_hz} Hz"
        )
    return length


def _lines(rate: float, length: int, band_hz: tuple[float, float] | None) -> FloatArray:
    """Return the lines (K,), Hz, inside a band."""
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    low, high = band_hz or (0.0, 0.5 * rate)
    inside = (frequency >= low) & (frequency <= high)
    inside[:_FIRST_BIN] = inside[-1] = False
    if not inside.any():
        raise ValueError(f"band_hz: expected a band with lines of {rate / length:.6g} Hz, found {low} to {high} Hz")
    return np.asarray(frequency[inside], dtype=np.float64)


def _local(record: TransferRecord, length: int, frequency_hz: FloatArray) -> _Source:
    """Return spectra by local polynomials."""
    samples = len(record.reference)
    if not enough_bins(samples, length):
        least = record.sample_rate_hz / samples * LEAST_SEGMENTS
        expected = f"expected lines at least {least:.3g} Hz apart for local polynomials"
        raise ValueError(f"resolution_hz: {expected}, found {record.sample_rate_hz / length:.6g} Hz")
    found = local_spectra(record, length, frequency_hz)
    return _Source(
        found.spectra, found.bias, np.full(len(frequency_hz), found.dof), found.line_correlation, found.text()
    )


def _segments(record: TransferRecord, length: int, frequency_hz: FloatArray) -> _Source:
    """Return averaged spectra of segments."""
    overlap = _Overlap.of(len(record.reference), length)
    first = round(float(frequency_hz[0]) * length / record.sample_rate_hz)
    spectra = _averaged(record, overlap, slice(first, first + len(frequency_hz)))
    dof = np.full(len(frequency_hz), 2.0 * (overlap.independent - 1.0))
    return _Source(spectra, None, dof, overlap.line_correlation, overlap.text())


def _leakage(ratio: ComplexArray) -> ComplexArray:
    """Return the bias H''/6 (K, C) that a Hann window gives H (K, C), zero at both ends."""
    bias = np.zeros_like(ratio)
    bias[1:-1] = (ratio[2:] - 2.0 * ratio[1:-1] + ratio[:-2]) / 6.0
    return bias


@dataclass(frozen=True)
class _Overlap:
    """Segments of a record: how they overlap, and what that means for their average.

    `independent`: equivalent number of independent segments; `line_correlation` (D,) of the errors of an averaged
    cross spectrum at neighbouring lines.
    """

    window: FloatArray
    starts: tuple[int, ...]
    independent: float
    line_correlation: ComplexArray

    @classmethod
    def of(cls, samples: int, length: int) -> _Overlap:
        """Lay segments over a record; noise in two of them d apart correlates as Σ w(n)·w(n+d)·exp(-jωn)."""
        window = window_samples("hann", length)
        hop = max(1, length // _HOP)
        starts = tuple(range(0, samples - length + 1, hop))
        count = len(starts)
        total = np.zeros(_REACH)
        for apart in range(min(count, -(-length // hop))):
            overlap = np.zeros(length)
            overlap[: length - apart * hop] = window[apart * hop :] * window[: length - apart * hop]
            share = (count - apart) / count * (1.0 if apart == 0 else 2.0)
            total = total + share * np.abs(np.fft.rfft(overlap)[:_REACH] / np.sum(window**2)) ** 2
        correlation = np.asarray(total / total[0], dtype=np.complex128)
        return cls(window, starts, count / float(total[0]), correlation[np.abs(correlation) > _CORRELATED])

    def text(self) -> str:
        """Say what was averaged."""
        return f"{len(self.starts)} Hann segments with 67 % overlap, worth {self.independent:.3g} independent ones"


def _averaged(record: TransferRecord, overlap: _Overlap, inside: slice) -> Spectra:
    """Return the averaged auto and cross spectra at the lines inside the band."""
    length = len(overlap.window)
    together = np.column_stack([record.reference, record.responses])
    together = together - together.mean(axis=0)
    lines, channels = inside.stop - inside.start, together.shape[1]
    total = np.zeros((lines, channels, channels), dtype=np.complex128)
    for start in overlap.starts:
        part = together[start : start + length]
        value = np.fft.rfft(overlap.window[:, None] * part, axis=0)[inside]
        total += value[:, :, None] * value.conj()[:, None, :]
    total /= len(overlap.starts)
    return Spectra(total, np.full(lines, overlap.independent))
