"""Transfer functions from noise: averaged spectra of overlapping segments, H1, H2, Hv."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray
from shaker.signals.phasor import Phasors
from shaker.signals.spectrum import window_samples
from shaker.signals.transfer.estimators import Spectra, choose_estimator, transfer_of
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
    estimator: Literal["auto", "H1", "H2", "Hv"] = "auto",
    noise_ratio: float | None = None,
    band_hz: tuple[float, float] | None = None,
) -> TransferFunction:
    """Return H from a stationary random excitation, by Welch's averaged spectra of Hann segments of 1/resolution.

    The segments overlap by 67 % and count as n independent ones (Welch, IEEE Trans. Audio Electroacoust. 15, 1967).
    H1 = S_xy/S_xx suffers from noise on the reference, H2 = S_yy/S_yx from noise on the response, Hv (total least
    squares) from neither if the ratio of the noise powers, response over reference, is that of `noise_ratio`; None
    takes it from the coherence. Covariance: S_ee/(n S_xx) of what H leaves of the responses (Bendat and Piersol,
    Random Data, 4th ed., eqs. 9.89 and 9.90, without the approximation for large n), `dof` 2(n-1);
    added is the square of the leading bias by the window, H''/6 per line squared: the average of H over |W|², whose
    second moment is 1/3 for Hann. "auto" says in a notice what it took and why.
    """
    rate = record.sample_rate_hz
    if not 0.0 < resolution_hz < rate / 16.0:
        raise ValueError(f"resolution_hz: expected a value in (0, {rate / 16.0:.6g}), found {resolution_hz}")
    length = round(rate / resolution_hz)
    if len(record.reference) < 2 * length:
        raise ValueError(
            f"resolution_hz: expected two segments or more in the record, so at least "
            f"{2.0 * rate / len(record.reference):.3g} Hz, found {resolution_hz} Hz"
        )
    overlap = _Overlap.of(len(record.reference), length)
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    low, high = band_hz or (0.0, 0.5 * rate)
    inside = (frequency >= low) & (frequency <= high)
    inside[:_FIRST_BIN] = inside[-1] = False
    if not inside.any():
        raise ValueError(f"band_hz: expected a band with lines of {rate / length:.6g} Hz, found {low} to {high} Hz")
    spectra = _averaged(record, overlap, inside)
    choice = choose_estimator(spectra, estimator, noise_ratio, record.reference_name)
    found = transfer_of(spectra, choice)
    covariance = found.covariance + circular_covariance(_leakage(found.ratio))
    chosen = np.asarray(frequency[inside], dtype=np.float64)
    notices = [choice.notice(record.reference_name, overlap.text())]
    for c, name in enumerate(record.channels):
        notices += resolution_notices(chosen, found.ratio[:, c], np.sqrt(found.covariance[:, c, c]), name)
    lines = len(chosen)
    return TransferFunction(
        ratio=Phasors(
            chosen,
            found.ratio,
            covariance,
            record.channels,
            record.ratio_unit,
            np.full(lines, 2.0 * (overlap.independent - 1.0)),
        ),
        coherence=found.coherence,
        estimator=choice.estimator,
        reference=record.reference_name,
        averages=np.full(lines, overlap.independent),
        line_spacing_hz=rate / length,
        line_correlation=overlap.line_correlation,
        notices=tuple(notices),
    )


def _leakage(ratio: ComplexArray) -> ComplexArray:
    """Return b·bᴴ (K, C, C) of the bias b = H''/6 that a Hann window gives H (K, C), zero at both ends."""
    bias = np.zeros_like(ratio)
    bias[1:-1] = (ratio[2:] - 2.0 * ratio[1:-1] + ratio[:-2]) / 6.0
    return np.asarray(bias[:, :, None] * bias.conj()[:, None, :])


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


def _averaged(record: TransferRecord, overlap: _Overlap, inside: BoolArray) -> Spectra:
    """Return the averaged auto and cross spectra at the lines inside the band."""
    length = len(overlap.window)
    together = np.column_stack([record.reference, record.responses])
    together = together - together.mean(axis=0)
    lines, channels = int(np.count_nonzero(inside)), together.shape[1]
    total = np.zeros((lines, channels, channels), dtype=np.complex128)
    for start in overlap.starts:
        part = together[start : start + length]
        value = np.fft.rfft(overlap.window[:, None] * part, axis=0)[inside]
        total += value[:, :, None] * value.conj()[:, None, :]
    total /= len(overlap.starts)
    return Spectra(total, overlap.independent)
