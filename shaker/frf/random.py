"""Transfer functions from random excitation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from shaker.frf.result import TransferFunction, TransferRecord, circular_covariance, resolution_notices
from shaker.lines.spectrum import hann_window
from shaker.signal_notices import ESTIMATOR_H1, ESTIMATOR_H2, ESTIMATOR_HV, ESTIMATOR_REQUESTED
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import DeclaredNotice, Notice, Value

_MAX_BIAS = 0.3  # accepted bias of an estimator, in its standard uncertainties
_MIN_COHERENCE = 0.5  # from which 1 - γ² is about the sum of the two noise-to-signal ratios


@dataclass(frozen=True)
class Spectra(Arrays, shapes="power K D D; averages K"):
    """Averaged auto and cross spectra of [reference, responses].

    `power` (K, 1 + C, 1 + C) is E[z zᴴ] of the spectra z. `averages` (K,) is the number of independent averages.
    """

    power: ComplexArray
    averages: FloatArray

    @property
    def reference(self) -> FloatArray:
        """Auto spectrum S_xx (K,)."""
        return np.asarray(self.power[:, 0, 0].real)

    @property
    def responses(self) -> FloatArray:
        """Auto spectra S_yy (K, C)."""
        return np.asarray(np.einsum("kcc->kc", self.power).real[:, 1:])

    @property
    def cross(self) -> ComplexArray:
        """Cross spectra S_yx = E[y x*] (K, C); H1 is S_yx/S_xx."""
        return np.asarray(self.power[:, 1:, 0])

    @property
    def coherence(self) -> FloatArray:
        """|S_yx|²/(S_xx S_yy) (K, C); 1 where a channel has no signal."""
        both = self.reference[:, None] * self.responses
        found = np.divide(np.abs(self.cross) ** 2, both, out=np.ones_like(both), where=both > 0.0)
        return np.asarray(np.minimum(found, 1.0))


@dataclass(frozen=True)
class EstimatorSelection:
    """Selected estimator, noise ratio (response over reference) for Hv, and the reason as a notice."""

    estimator: Literal["H1", "H2", "Hv"]
    noise_ratio: float
    reason: DeclaredNotice
    values: dict[str, Value] = field(default_factory=dict)

    def notice(self, where: str, method: str) -> Notice:
        """Return the notice that states the estimator, the reason and the averaging method."""
        return Notice(self.reason, where, estimator=self.estimator, averaged=method, **self.values)


def ratio_covariance(spectra: Spectra, ratio: ComplexArray, selection: EstimatorSelection) -> FloatArray:
    """Return the covariance (K, 2C, 2C) of a ratio, [all Re, all Im]."""
    power, averages = spectra.power, spectra.averages
    if not np.all(averages > 1.0):
        return np.full((len(ratio), 2 * ratio.shape[1], 2 * ratio.shape[1]), np.nan)
    cross = ratio[:, :, None] * spectra.cross.conj()[:, None, :]
    # Power of y - H x for this H; for H1 it is the residual of the regression.
    left = power[:, 1:, 1:] - cross - cross.conj().swapaxes(1, 2)
    left = left + ratio[:, :, None] * ratio.conj()[:, None, :] * power[:, :1, :1]
    noise = left / (power[:, :1, :1].real * (averages[:, None, None] - 1.0))
    if selection.estimator != "H1":
        loss = 1.0 / np.sqrt(np.maximum(spectra.coherence, 1.0 / averages[:, None]))
        noise = noise * loss[:, :, None] * loss[:, None, :]
    hermitian = 0.5 * (noise + noise.conj().swapaxes(1, 2))
    diagonal = np.arange(noise.shape[1])  # rounding can make it negative
    hermitian[:, diagonal, diagonal] = np.maximum(hermitian[:, diagonal, diagonal].real, np.finfo(np.float64).tiny)
    return circular_covariance(hermitian)


def estimate_ratio(spectra: Spectra, selection: EstimatorSelection) -> ComplexArray:
    """Return H (K, C); Hv minimises |n_x|² + |n_y|²/κ with the noise ratio κ."""
    cross, reference, responses = spectra.cross, spectra.reference[:, None], spectra.responses
    if selection.estimator == "H1":
        return np.asarray(cross / reference)
    if selection.estimator == "H2":
        return np.asarray(responses / cross.conj())
    kappa = selection.noise_ratio
    difference = responses - kappa * reference
    root = np.sqrt(difference**2 + 4.0 * kappa * np.abs(cross) ** 2)
    return np.asarray((difference + root) / (2.0 * cross.conj()))


def choose_estimator(
    spectra: Spectra, requested: Literal["auto", "H1", "H2", "Hv"], noise_ratio: float | None, reference_name: str
) -> EstimatorSelection:
    """Return the requested estimator, or the first of H1, H2, Hv with a small bias.

    The coherence distinguishes noise on the reference from noise on a response if both are about white over the band.
    Then 1 - γ² = N_x/S_xx + N_y/S_yy is solved for N_x, N_y ≥ 0 by weighted least squares.
    """
    if noise_ratio is not None and not noise_ratio > 0.0:
        raise ValueError(f"noise_ratio: expected a positive number, found {noise_ratio}")
    on_reference, on_response, bias_h1, bias_h2 = _estimate_noise(spectra)
    distinguishable = on_reference > 0.0 and on_response > 0.0
    if requested == "Hv" and noise_ratio is None and not distinguishable:
        raise ValueError(
            "noise_ratio: expected a value for Hv, found none; the noise is too small to estimate it from the coherence"
        )
    kappa = noise_ratio or (on_response / on_reference if distinguishable else 1.0)
    if requested != "auto":
        return EstimatorSelection(requested, kappa, ESTIMATOR_REQUESTED)
    if bias_h1 <= _MAX_BIAS:
        return EstimatorSelection("H1", kappa, ESTIMATOR_H1, {"reference": reference_name})
    if bias_h2 <= _MAX_BIAS:
        return EstimatorSelection("H2", kappa, ESTIMATOR_H2, {"reference": reference_name})
    return EstimatorSelection("Hv", kappa, ESTIMATOR_HV, {"reference": reference_name, "noise_ratio": kappa})


def _estimate_noise(spectra: Spectra) -> tuple[float, float, float, float]:
    """Return the noise powers on reference and response, and the biases of H1, H2.

    A noise power is the median over the responses. A bias is in standard uncertainties of the estimator: the 95th
    percentile over the lines, the largest over the responses.
    """
    from scipy.optimize import nnls

    coherence = spectra.coherence
    bias = (1.0 - coherence) ** 2 / spectra.averages[:, None]
    missing = np.maximum(1.0 - coherence - bias, 0.0)
    # The estimate of 1 - γ² scatters by about √2 γ (1 - γ²)/√n; a smooth approximation weights the lines.
    scale = 1.0 / np.maximum(missing, np.maximum(np.median(missing), 1e-12))
    noise_powers, biases = [], []
    for c in range(coherence.shape[1]):
        # Lines whose signal is above the noise: outside the excited band there is only noise.
        usable = coherence[:, c] > _MIN_COHERENCE
        if not usable.any():
            usable[:] = True
        x, y, averages = spectra.reference[usable], spectra.responses[usable, c], spectra.averages[usable]
        columns = np.stack([1.0 / x, 1.0 / y], axis=1) * scale[usable, c, None]
        unit = np.linalg.norm(columns, axis=0)
        level = nnls(columns / unit, missing[usable, c] * scale[usable, c])[0] / unit
        noise_powers.append(level)
        u_relative = np.sqrt(np.maximum(missing[usable, c], 1e-12) / averages)
        biases.append(np.quantile([level[0] / x / u_relative, level[1] / y / u_relative], 0.95, axis=1))
    noise = np.median(noise_powers, axis=0)
    bias_h1, bias_h2 = np.max(biases, axis=0)
    return float(noise[0]), float(noise[1]), float(bias_h1), float(bias_h2)


# Transfer functions by local polynomials: the spectrum of a whole record, without segments and window.

_ORDER = 6  # of the polynomials in frequency
_LOWER_ORDER = 4  # of a second fit; its difference from the first bounds the bias
_WINDOW_LINES = 5.0  # lines that one polynomial spans
_COEFFICIENTS = 2 * (_ORDER + 1)  # number of them for transfer function and transient
_MIN_BINS = 2 * _COEFFICIENTS  # of a record's DFT in a window, half of them for the noise
MIN_SEGMENTS = _MIN_BINS / _WINDOW_LINES
"""Length of the shortest record for local polynomials, in segments of 1/(line spacing)."""
_MIN_SQUARED_BIAS = 4.0  # of the difference of the fits, in its variances; noise exceeds it at one of fifty lines
_BATCH_BINS = 200_000  # bins of all windows that are fitted at once


@dataclass(frozen=True)
class SpectralEstimate:
    """Spectra at K lines, and the bias, degrees of freedom and correlation of their errors.

    Attributes
    ----------
    spectra : averaged spectra of [reference, responses].
    bias : (K, C), possible bias of the transfer function; None if it is to be estimated from the curvature.
    dof : real degrees of freedom of the noise.
    line_correlation : (D,), correlation of the errors of lines 0, 1, … line spacings apart.
    method : description of the averaging for the notice.
    """

    spectra: Spectra
    bias: ComplexArray | None
    dof: float
    line_correlation: ComplexArray
    method: str


def local_spectra(record: TransferRecord, length: int, frequency_hz: FloatArray) -> SpectralEstimate:
    """Return spectra [reference, responses] at lines (K,) in Hz by local polynomials.

    The lines are spaced by 1/`length` of the sample rate. The model in a window of five lines of the record's DFT, r
    bins from the line, is Y(r) = Σ g_s rˢ·X(r) + Σ t_s rˢ, s = 0 … 6. It is fitted by least squares. The transient t
    from the start and end of the record (leakage) is smooth in frequency. The transfer function at the line is g₀
    (Pintelon and Schoukens, System Identification, 2nd ed., 2012, sec. 7.2; Schoukens et al., Eur. J. Control 15,
    2009). The residual per degree of freedom is the noise S_ee.

    The result is S_xx = mean |X|², S_yx = g₀ S_xx, S_yy = |g₀|² S_xx + S_ee, equivalent to n + 1 averages. Here n =
    (X*QX)/S_xx, with the projection Q orthogonal to the other unknowns. Then var g₀ = S_ee/(n S_xx), and noise on the
    reference lowers g₀ as it lowers H1. Both H2 and Hv therefore follow from these spectra as from averaged ones.
    Errors of two lines correlate if their windows overlap.

    A second fit with polynomials of order 4 bounds the bias: a resonance that is too narrow for order 6 is even less
    compatible with order 4. The difference of the fits is the bias where it exceeds the noise, else the bias is 0.
    """
    samples = len(record.reference)
    if samples < MIN_SEGMENTS * length:
        least = record.sample_rate_hz / samples * MIN_SEGMENTS
        expected = f"expected lines at least {least:.3g} Hz apart for local polynomials"
        raise ValueError(f"resolution_hz: {expected}, found {record.sample_rate_hz / length:.6g} Hz")
    signals = np.column_stack([record.reference, record.responses])
    transform = np.fft.rfft(signals - signals.mean(axis=0), axis=0)
    bins = round(_WINDOW_LINES * samples / length)
    position = frequency_hz * (samples / record.sample_rate_hz)
    first = np.clip(np.round(position - 0.5 * (bins - 1)).astype(np.int64), 1, len(transform) - 1 - bins)
    count = max(1, _BATCH_BINS // bins)
    parts = [
        _fit_windows(transform, position[k : k + count], first[k : k + count], bins)
        for k in range(0, len(position), count)
    ]
    power, averages, bias = (np.concatenate(part) for part in zip(*parts, strict=True))
    # Correlation of polynomial fits at the centres of windows whose distances are multiples of samples/length bins.
    centred = (np.arange(bins) - 0.5 * (bins - 1)) / (0.5 * bins)
    kernel = np.linalg.pinv(centred[:, None] ** np.arange(_ORDER + 1))[0]
    lag = np.round(np.arange(0.0, bins, samples / length)).astype(np.int64)
    correlation = np.array([kernel[: bins - d] @ kernel[d:] / (kernel @ kernel) for d in lag if d < bins])
    method = f"local polynomials of order {_ORDER} over {bins} bins of the whole record"
    dof = 2.0 * (bins - _COEFFICIENTS)
    return SpectralEstimate(Spectra(power, averages), bias, dof, correlation.astype(np.complex128), method)


def _fit_windows(
    transform: ComplexArray, position: FloatArray, first: IntArray, bins: int
) -> tuple[ComplexArray, FloatArray, ComplexArray]:
    """Return `power`, `averages` and bias at lines in windows from bins `first`."""
    index = first[:, None] + np.arange(bins)
    basis = ((index - position[:, None]) / (0.5 * bins))[:, :, None] ** np.arange(_ORDER + 1)
    reference, responses = transform[index, :1], transform[index, 1:]
    ratio, information, noise = _fit_polynomials(basis, reference, responses)
    lower_ratio, lower_information, _ = _fit_polynomials(basis[:, :, : _LOWER_ORDER + 1], reference, responses)
    level = np.mean(np.abs(reference[:, :, 0]) ** 2, axis=1) + np.finfo(np.float64).tiny ** 0.5
    through = np.concatenate([np.ones_like(ratio[:, :1]), ratio], axis=1)
    power = level[:, None, None] * through[:, :, None] * through.conj()[:, None, :]
    power[:, 1:, 1:] += noise
    # The fits are nested: the variance of their difference is the difference of their variances, over the noise.
    variance_difference = 1.0 / information - 1.0 / lower_information
    by_chance = np.einsum("kcc->kc", noise).real * variance_difference[:, None]
    difference = ratio - lower_ratio
    bias = np.where(np.abs(difference) ** 2 > _MIN_SQUARED_BIAS * by_chance, difference, 0.0)
    return power, 1.0 + information / level, bias


def _fit_polynomials(
    basis: FloatArray, reference: ComplexArray, responses: ComplexArray
) -> tuple[ComplexArray, FloatArray, ComplexArray]:
    """Fit responses on a reference, with polynomials for the transfer function and the transient.

    `basis` (K, B, P): powers 0 … P − 1 of the bins' positions; `reference` (K, B, 1); `responses` (K, B, C).
    Returns the ratio (K, C), its information (K,) (the inverse of its variance per noise power) and noise (K, C, C).
    """
    # The column of g₀ is the last before the responses, so that one row of the triangle determines g₀ alone.
    columns = np.concatenate([basis[:, :, 1:] * reference, basis, reference, responses], axis=2)
    triangle: ComplexArray = np.asarray(np.linalg.qr(columns, mode="r"))
    last = 2 * basis.shape[2] - 1
    pivot = triangle[:, last, last]
    pivot = np.where(pivot == 0.0, np.finfo(np.float64).tiny ** 0.25, pivot)
    left = triangle[:, last + 1 :, last + 1 :]
    noise = left.swapaxes(1, 2) @ left.conj() / (basis.shape[1] - last - 1)
    return triangle[:, last, last + 1 :] / pivot[:, None], np.abs(pivot) ** 2, noise


# Transfer functions by H1, H2 or Hv, from local polynomials or from averaged spectra of overlapping segments.

_HOPS_PER_SEGMENT = 3  # segments begin every third of their length: 67 % overlap
_FIRST_LINE = 3  # a Hann window spreads the remaining mean over the lines below
_MAX_CORRELATED_LINES = 8  # line spacings for which the correlation of errors is calculated
_MIN_CORRELATION = 1e-4  # smaller correlations of the errors of neighbouring lines are neglected


def transfer_random(
    record: TransferRecord,
    resolution_hz: float,
    *,
    estimator: Literal["auto", "local", "H1", "H2", "Hv"] = "auto",
    noise_ratio: float | None = None,
    band_hz: tuple[float, float] | None = None,
    frequency_hz: FloatArray | None = None,
) -> TransferFunction:
    """Estimate transfer functions from a stationary random excitation at equidistant lines.

    Parameters
    ----------
    record
        Reference and responses.
    resolution_hz
        Line spacing in Hz.
    estimator
        "local", "H1", "H2", "Hv"; default "auto".
    noise_ratio
        Ratio of the noise powers, response over reference, for Hv; default: estimated from the coherence.
    band_hz
        Band in Hz; default: all lines.
    frequency_hz
        (K,), other lines in Hz, of which "local" needs no grid; default: multiples of the resolution.

    Returns
    -------
    The transfer function with covariance and coherence; a notice states the selected estimator and the reason.

    Raises
    ------
    ValueError
        The record is too short for the resolution, the band has no line, or Hv has no noise ratio.

    Notes
    -----
    "local": local polynomials on the spectrum of the whole record (see `local_spectra`), without leakage, and H1, H2 or
    Hv of these spectra. "H1", "H2", "Hv": averaged spectra of Hann segments of 1/resolution with 67 % overlap, which
    are equivalent to n independent ones (Welch, IEEE Trans. Audio Electroacoust. 15, 1967). "auto": "local" if the
    record has at least 5.6 such segments, else averaged spectra.

    H1 = S_yx/S_xx is biased by noise on the reference, H2 = S_yy/S_xy by noise on the response. Hv (total least
    squares) is biased by neither if `noise_ratio` is right. The covariance is S_ee/(n S_xx) of the residual of the
    responses (Bendat and Piersol, Random Data, 4th ed., eqs. 9.89 and 9.90, without the approximation for large n),
    plus the square of the bias. For polynomials the bias is the difference from a lower order. For segments it is its
    leading term, H''/6 per line squared: the average of H over |W|², whose second moment is 1/3 for Hann.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> from shaker import TransferRecord, transfer_random
    >>> force = np.random.default_rng(0).normal(size=40_000)
    >>> motion = lfilter([0.02], [1.0, -1.8, 0.97], force)
    >>> record = TransferRecord(force, motion[:, None], 1000.0, "force", "N", ("z",), ("m",))
    >>> transfer_random(record, resolution_hz=1.0)
    TransferFunction(local over force: Phasors(497 lines from 3 to 499 Hz: z [m/N]))
    """
    length, lines_hz = _select_lines(record, resolution_hz, band_hz)
    lines_hz = lines_hz if frequency_hz is None else frequency_hz
    enough = len(record.reference) >= MIN_SEGMENTS * length
    local = estimator == "local" or (estimator == "auto" and enough)
    estimate = (local_spectra if local else averaged_spectra)(record, length, lines_hz)
    requested = "auto" if estimator == "local" else estimator
    selection = choose_estimator(estimate.spectra, requested, noise_ratio, record.reference_name)
    ratio = estimate_ratio(estimate.spectra, selection)
    noise, bias = ratio_covariance(estimate.spectra, ratio, selection), estimate.bias
    if bias is None:  # H''/6 of a Hann window, zero at both ends
        bias = np.zeros_like(ratio)
        bias[1:-1] = (ratio[2:] - 2.0 * ratio[1:-1] + ratio[:-2]) / 6.0
    covariance = noise + circular_covariance(bias[:, :, None] * bias.conj()[:, None, :])
    notices = [selection.notice(record.reference_name, estimate.method)]
    cause, dof = "A polynomial over five lines" if local else "Leakage", np.full(len(lines_hz), estimate.dof)
    for c, name in enumerate(record.channels if frequency_hz is None else ()):
        notices += resolution_notices(lines_hz, ratio[:, c], np.sqrt(noise[:, c, c]), name, cause)
    return TransferFunction(
        ratio=Phasors(lines_hz, ratio, covariance, record.channels, record.ratio_unit, dof),
        coherence=estimate.spectra.coherence,
        estimator="local" if local else selection.estimator,
        reference=record.reference_name,
        averages=estimate.spectra.averages,
        line_spacing_hz=record.sample_rate_hz / length,
        line_correlation=estimate.line_correlation,
        notices=tuple(notices),
    )


def _select_lines(
    record: TransferRecord, resolution_hz: float, band_hz: tuple[float, float] | None
) -> tuple[int, FloatArray]:
    """Return the samples of a segment, and the lines (K,) in Hz inside a band."""
    rate = record.sample_rate_hz
    if not 0.0 < resolution_hz < rate / 16.0:
        raise ValueError(f"resolution_hz: expected a value in (0, {rate / 16.0:.6g}), found {resolution_hz}")
    length = round(rate / resolution_hz)
    if len(record.reference) < 2 * length:
        raise ValueError(
            f"resolution_hz: expected at least {2.0 * rate / len(record.reference):.3g} Hz, so that the record has two "
            f"segments, found {resolution_hz} Hz"
        )
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    low, high = band_hz or (0.0, 0.5 * rate)
    inside = (frequency >= low) & (frequency <= high)
    inside[:_FIRST_LINE] = inside[-1] = False
    if not inside.any():
        raise ValueError(f"band_hz: expected a band with lines of {rate / length:.6g} Hz, found {low} to {high} Hz")
    return length, np.asarray(frequency[inside], dtype=np.float64)


def averaged_spectra(record: TransferRecord, length: int, frequency_hz: FloatArray) -> SpectralEstimate:
    """Return Welch's averaged spectra [reference, responses] at consecutive lines (K,) in Hz.

    Hann segments w have `length` samples. Noise in two segments that begin d samples apart correlates as Σ
    w(n)·w(n+d)·exp(-jωn). The number of independent segments and the correlation of the errors of neighbouring lines
    follow from this.
    """
    window, hop = hann_window(length), max(1, length // _HOPS_PER_SEGMENT)
    starts = range(0, len(record.reference) - length + 1, hop)
    count = len(starts)
    total = np.zeros(_MAX_CORRELATED_LINES)
    for lag in range(min(count, -(-length // hop))):
        overlap = np.zeros(length)
        overlap[: length - lag * hop] = window[lag * hop :] * window[: length - lag * hop]
        share = (count - lag) / count * (1.0 if lag == 0 else 2.0)
        total = total + share * np.abs(np.fft.rfft(overlap)[:_MAX_CORRELATED_LINES] / np.sum(window**2)) ** 2
    independent, correlation = count / float(total[0]), np.asarray(total / total[0], dtype=np.complex128)
    signals = np.column_stack([record.reference, record.responses])
    signals = signals - signals.mean(axis=0)
    first = round(float(frequency_hz[0]) * length / record.sample_rate_hz)
    power = np.zeros((len(frequency_hz), signals.shape[1], signals.shape[1]), dtype=np.complex128)
    for start in starts:
        transform = np.fft.rfft(window[:, None] * signals[start : start + length], axis=0)
        value = transform[first : first + len(frequency_hz)]
        power += value[:, :, None] * value.conj()[:, None, :]
    return SpectralEstimate(
        Spectra(np.asarray(power / count), np.full(len(frequency_hz), independent)),
        None,
        2.0 * (independent - 1.0),
        correlation[np.abs(correlation) > _MIN_CORRELATION],
        f"{count} Hann segments with 67 % overlap, equivalent to {independent:.3g} independent ones",
    )
