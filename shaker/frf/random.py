"""Transfer functions from random excitation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, IntArray, check_shape
from shaker.frf.frf_notices import ESTIMATOR_H1, ESTIMATOR_H2, ESTIMATOR_HV, ESTIMATOR_REQUESTED
from shaker.frf.result import TransferFunction, TransferRecord, circular_covariance, resolution_notices
from shaker.lines.spectrum import hann_window
from shaker.sine.phasor import Phasors
from shakercal._common.notices import DeclaredNotice, Notice, Value

_TOLERANCE = 0.3  # bias of an estimator, over its standard uncertainty, that is accepted
_MIN_COHERENCE = 0.5  # coherence from which 1 - γ² is about the sum of the two noise-to-signal ratios


@dataclass(frozen=True)
class Spectra:
    """Averaged spectra of [reference, responses].

    `power` (K, 1 + C, 1 + C) is E[z zᴴ]. `averages` (K,) is the number of independent averages.
    """

    power: ComplexArray
    averages: FloatArray

    def __post_init__(self) -> None:
        check_shape("power", self.power, (None, self.power.shape[-1], self.power.shape[-1]))
        check_shape("averages", self.averages, (len(self.power),))

    @property
    def reference(self) -> FloatArray:
        """S_xx (K,)."""
        return np.asarray(self.power[:, 0, 0].real)

    @property
    def responses(self) -> FloatArray:
        """S_yy (K, C)."""
        return np.asarray(np.einsum("kcc->kc", self.power).real[:, 1:])

    @property
    def cross(self) -> ComplexArray:
        """E[y x*] (K, C), which over S_xx is H1."""
        return np.asarray(self.power[:, 1:, 0])

    @property
    def coherence(self) -> FloatArray:
        """|S_xy|²/(S_xx S_yy) (K, C), one where a channel is silent."""
        both = self.reference[:, None] * self.responses
        found = np.divide(np.abs(self.cross) ** 2, both, out=np.ones_like(both), where=both > 0.0)
        return np.asarray(np.minimum(found, 1.0))


@dataclass(frozen=True)
class EstimatorSelection:
    """Selected estimator, ratio of the noise powers for Hv, and the declared reason."""

    estimator: Literal["H1", "H2", "Hv"]
    noise_ratio: float
    reason: DeclaredNotice
    values: dict[str, Value] = field(default_factory=dict)

    def notice(self, where: str, averaged: str) -> Notice:
        """Return the notice of the selection."""
        return Notice(self.reason, where, estimator=self.estimator, averaged=averaged, **self.values)


def ratio_covariance(spectra: Spectra, ratio: ComplexArray, choice: EstimatorSelection) -> FloatArray:
    """Return the covariance (K, 2C, 2C) of a ratio (K, C) from `ratio_of`."""
    power, averages = spectra.power, spectra.averages
    if not np.all(averages > 1.0):
        return np.full((len(ratio), 2 * ratio.shape[1], 2 * ratio.shape[1]), np.nan)
    cross = ratio[:, :, None] * spectra.cross.conj()[:, None, :]
    # Power of y - H x for this H; for H1 it is the residual of the regression.
    left = power[:, 1:, 1:] - cross - cross.conj().swapaxes(1, 2)
    left = left + ratio[:, :, None] * ratio.conj()[:, None, :] * power[:, :1, :1]
    noise = left / (power[:, :1, :1].real * (averages[:, None, None] - 1.0))
    if choice.estimator != "H1":
        loss = 1.0 / np.sqrt(np.maximum(spectra.coherence, 1.0 / averages[:, None]))
        noise = noise * loss[:, :, None] * loss[:, None, :]
    hermitian = 0.5 * (noise + noise.conj().swapaxes(1, 2))
    diagonal = np.arange(noise.shape[1])  # rounding may have made it negative
    hermitian[:, diagonal, diagonal] = np.maximum(hermitian[:, diagonal, diagonal].real, np.finfo(np.float64).tiny)
    return circular_covariance(hermitian)


def ratio_of(spectra: Spectra, choice: EstimatorSelection) -> ComplexArray:
    """Return H (K, C) by the selected estimator.

    Hv minimises the noise |n_x|² + |n_y|²/κ that explains the spectra.
    """
    cross, reference, responses = spectra.cross, spectra.reference[:, None], spectra.responses
    if choice.estimator == "H1":
        return np.asarray(cross / reference)
    if choice.estimator == "H2":
        return np.asarray(responses / cross.conj())
    kappa = choice.noise_ratio
    difference = responses - kappa * reference
    root = np.sqrt(difference**2 + 4.0 * kappa * np.abs(cross) ** 2)
    return np.asarray((difference + root) / (2.0 * cross.conj()))


def choose_estimator(
    spectra: Spectra,
    requested: Literal["auto", "H1", "H2", "Hv"],
    noise_ratio: float | None,
    reference_name: str,
) -> EstimatorSelection:
    """Return the requested estimator, or the one whose bias is below its uncertainty.

    The coherence distinguishes noise on the reference from noise on a response if both are about white over the band: 1
    - γ² = N_x/S_xx + N_y/S_yy, solved for N_x, N_y ≥ 0 by weighted least squares.
    """
    if noise_ratio is not None and not noise_ratio > 0.0:
        raise ValueError(f"noise_ratio: expected a positive number, found {noise_ratio}")
    on_reference, on_response, bias_h1, bias_h2 = _noise_shares(spectra)
    distinguishable = on_reference > 0.0 and on_response > 0.0
    if requested == "Hv" and noise_ratio is None and not distinguishable:
        raise ValueError(
            "noise_ratio: expected the ratio of the noise powers, found none and too little noise to estimate it"
        )
    kappa = noise_ratio or (on_response / on_reference if distinguishable else 1.0)
    if requested != "auto":
        return EstimatorSelection(requested, kappa, ESTIMATOR_REQUESTED)
    if bias_h1 <= _TOLERANCE:
        return EstimatorSelection("H1", kappa, ESTIMATOR_H1, {"reference": reference_name})
    if bias_h2 <= _TOLERANCE:
        return EstimatorSelection("H2", kappa, ESTIMATOR_H2, {"reference": reference_name})
    return EstimatorSelection("Hv", kappa, ESTIMATOR_HV, {"reference": reference_name, "noise_ratio": kappa})


def _noise_shares(spectra: Spectra) -> tuple[float, float, float, float]:
    """Return the noise powers on reference and responses, and the bias of H1 and H2.

    The bias is relative to its uncertainty (95th centile).
    """
    from scipy.optimize import nnls

    coherence = spectra.coherence
    bias = (1.0 - coherence) ** 2 / spectra.averages[:, None]
    missing = np.maximum(1.0 - coherence - bias, 0.0)
    # The estimate of 1 - γ² scatters by about √2 γ (1 - γ²)/√n; a smooth approximation weights the lines.
    scale = 1.0 / np.maximum(missing, np.maximum(np.median(missing), 1e-12))
    fits, shares = [], []
    for c in range(coherence.shape[1]):
        usable = (
            coherence[:, c] > _MIN_COHERENCE
        )  # lines whose signal is above the noise: outside a band there is only noise
        if not usable.any():
            usable[:] = True
        x, y, averages = spectra.reference[usable], spectra.responses[usable, c], spectra.averages[usable]
        columns = np.stack([1.0 / x, 1.0 / y], axis=1) * scale[usable, c, None]
        unit = np.linalg.norm(columns, axis=0)
        level = nnls(columns / unit, missing[usable, c] * scale[usable, c])[0] / unit
        fits.append(level)
        u_relative = np.sqrt(np.maximum(missing[usable, c], 1e-12) / averages)
        shares.append(np.quantile([level[0] / x / u_relative, level[1] / y / u_relative], 0.95, axis=1))
    noise = np.median(fits, axis=0)
    bias_h1, bias_h2 = np.max(shares, axis=0)
    return float(noise[0]), float(noise[1]), float(bias_h1), float(bias_h2)


# Transfer functions by local polynomials: the spectrum of a whole record, without segments and window.

_ORDER = 6  # of the polynomials in frequency
_LOWER_ORDER = 4  # of the polynomials that show the influence of the order
_WINDOW = 5.0  # lines that one polynomial spans
_UNKNOWNS = 2 * (_ORDER + 1)  # coefficients of transfer function and transient
_FEWEST_BINS = 2 * _UNKNOWNS  # of a record's spectrum in a window, half of them for the noise
LEAST_SEGMENTS = _FEWEST_BINS / _WINDOW
"""Length of the shortest record over 1/(line spacing)."""
_CERTAIN = 4.0  # times its variance that the square of a difference reaches by chance once in fifty lines
_TOGETHER = 200_000  # bins of all windows that are solved at once


@dataclass(frozen=True)
class LineSpectra:
    """Spectra at K lines with the properties of their errors.

    Attributes
    ----------
    spectra : the spectra.
    bias : (K, C), possible bias of the transfer function, None where it follows from the curvature.
    dof : real degrees of freedom of the noise.
    line_correlation : (D,), correlation of the errors of lines.
    text : description of the method.
    """

    spectra: Spectra
    bias: ComplexArray | None
    dof: float
    line_correlation: ComplexArray
    text: str


def local_spectra(record: TransferRecord, length: int, frequency_hz: FloatArray) -> LineSpectra:
    """Return spectra [reference, responses] at lines (K,) in Hz by local polynomials.

    The lines are a `length`-th of the sample rate apart. The model in a window of five lines of the record's DFT, r
    bins from the line, is Y(r) = Σ g_s rˢ·X(r) + Σ t_s rˢ, s = 0 … 6. It is fitted by least squares. The transient t of
    the record's begin and end (leakage) is smooth in frequency. The transfer function at the line is g₀ (Pintelon and
    Schoukens, System Identification, 2nd ed., 2012, sec. 7.2; Schoukens et al., Eur. J. Control 15, 2009). The residual
    per degree of freedom is the noise S_ee.

    The result is S_xx = mean |X|², S_yx = g₀ S_xx, S_yy = |g₀|² S_xx + S_ee, worth n + 1 averages. Here n =
    (X*QX)/S_xx, with the projection Q orthogonal to the other unknowns. Then var g₀ = S_ee/(n S_xx), and noise on the
    reference lowers g₀ as it lowers H1. Both H2 and Hv therefore follow from these spectra as from averaged ones.
    Errors of two lines correlate as far as their windows overlap. A resonance that is too narrow for these polynomials
    is even more so for those of order 4. The difference, where it exceeds the noise, bounds the bias.
    """
    samples = len(record.reference)
    if samples < LEAST_SEGMENTS * length:
        least = record.sample_rate_hz / samples * LEAST_SEGMENTS
        expected = f"expected lines at least {least:.3g} Hz apart for local polynomials"
        raise ValueError(f"resolution_hz: {expected}, found {record.sample_rate_hz / length:.6g} Hz")
    together = np.column_stack([record.reference, record.responses])
    transform = np.fft.rfft(together - together.mean(axis=0), axis=0)
    bins = round(_WINDOW * samples / length)
    position = frequency_hz * (samples / record.sample_rate_hz)
    first = np.clip(np.round(position - 0.5 * (bins - 1)).astype(np.int64), 1, len(transform) - 1 - bins)
    count = max(1, _TOGETHER // bins)
    parts = [
        _solve_windows(transform, position[k : k + count], first[k : k + count], bins)
        for k in range(0, len(position), count)
    ]
    power, averages, bias = (np.concatenate(part) for part in zip(*parts, strict=True))
    # Correlation of polynomial fits at the middle of windows at a distance of samples/length bins.
    centred = (np.arange(bins) - 0.5 * (bins - 1)) / (0.5 * bins)
    kernel = np.linalg.pinv(centred[:, None] ** np.arange(_ORDER + 1))[0]
    lag = np.round(np.arange(0.0, bins, samples / length)).astype(np.int64)
    correlation = np.array([kernel[: bins - d] @ kernel[d:] / (kernel @ kernel) for d in lag if d < bins])
    text = f"local polynomials of order {_ORDER} over {bins} bins of the whole record"
    dof = 2.0 * (bins - _UNKNOWNS)
    return LineSpectra(Spectra(power, averages), bias, dof, correlation.astype(np.complex128), text)


def _solve_windows(
    transform: ComplexArray, position: FloatArray, first: IntArray, bins: int
) -> tuple[ComplexArray, FloatArray, ComplexArray]:
    """Return power, averages (K,) and bias (K, C) of windows.

    `power` is (K, 1 + C, 1 + C). The windows begin at bins `first`.
    """
    index = first[:, None] + np.arange(bins)
    powers = ((index - position[:, None]) / (0.5 * bins))[:, :, None] ** np.arange(_ORDER + 1)
    reference, responses = transform[index, :1], transform[index, 1:]
    ratio, information, noise = _fit_polynomials(powers, reference, responses)
    lower_ratio, lower_information, _ = _fit_polynomials(powers[:, :, : _LOWER_ORDER + 1], reference, responses)
    level = np.mean(np.abs(reference[:, :, 0]) ** 2, axis=1) + np.finfo(np.float64).tiny ** 0.5
    through = np.concatenate([np.ones_like(ratio[:, :1]), ratio], axis=1)
    power = level[:, None, None] * through[:, :, None] * through.conj()[:, None, :]
    power[:, 1:, 1:] += noise
    # The lower fit is part of the higher one, so that the variance of their difference is that of their variances.
    variance_difference = 1.0 / information - 1.0 / lower_information
    by_chance = np.einsum("kcc->kc", noise).real * variance_difference[:, None]
    difference = ratio - lower_ratio
    bias = np.where(np.abs(difference) ** 2 > _CERTAIN * by_chance, difference, 0.0)
    return power, 1.0 + information / level, bias


def _fit_polynomials(
    powers: FloatArray, reference: ComplexArray, responses: ComplexArray
) -> tuple[ComplexArray, FloatArray, ComplexArray]:
    """Fit polynomials with `powers` (K, B, P) of the position to responses on a reference.

    `responses` (K, B, C), `reference` (K, B, 1). Returns the ratio (K, C), its information (K,) and noise (K, C, C).
    """
    # The transfer function at the line is last before the responses, so that the triangle separates it.
    columns = np.concatenate([powers[:, :, 1:] * reference, powers, reference, responses], axis=2)
    triangle: ComplexArray = np.asarray(np.linalg.qr(columns, mode="r"))
    last = 2 * powers.shape[2] - 1
    pivot = triangle[:, last, last]
    pivot = np.where(pivot == 0.0, np.finfo(np.float64).tiny ** 0.25, pivot)
    left = triangle[:, last + 1 :, last + 1 :]
    noise = left.swapaxes(1, 2) @ left.conj() / (powers.shape[1] - last - 1)
    return triangle[:, last, last + 1 :] / pivot[:, None], np.abs(pivot) ** 2, noise


# Transfer functions from noise: local polynomials, or averaged spectra of overlapping segments; H1, H2, Hv.

_HOP = 3  # segments begin every third of their length: 67 % overlap
_FIRST_BIN = 3  # a Hann window spreads the rest of the mean over the bins below
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

    Parameters
    ----------
    record
        Reference and responses.
    resolution_hz
        Distance of the lines in Hz.
    estimator
        "local", "H1", "H2", "Hv"; default "auto".
    noise_ratio
        Ratio of the noise powers, response over reference, for Hv; default: from the coherence.
    band_hz
        Band in Hz; default: all lines.

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
    Hv of these spectra. "H1", "H2", "Hv": Welch's averaged spectra of Hann segments of 1/resolution with 67 % overlap,
    which count as n independent ones (IEEE Trans. Audio Electroacoust. 15, 1967). "auto" uses "local" where the record
    is 5.6 such segments long or more, else the segments.

    H1 = S_xy/S_xx is biased by noise on the reference, H2 = S_yy/S_yx by noise on the response. Hv (total least
    squares) is biased by neither if `noise_ratio` is right. Covariance: S_ee/(n S_xx) of the residual of the responses
    (Bendat and Piersol, Random Data, 4th ed., eqs. 9.89 and 9.90, without the approximation for large n), plus the
    square of the bias. For segments that is its leading term, H''/6 per line squared (the average of H over |W|², whose
    second moment is 1/3 for Hann). For polynomials it is the difference from a lower order.

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
    length, chosen = _select_lines(record, resolution_hz, band_hz)
    enough = len(record.reference) >= LEAST_SEGMENTS * length
    local = estimator == "local" or (estimator == "auto" and enough)
    source = (local_spectra if local else averaged_spectra)(record, length, chosen)
    requested = "auto" if estimator == "local" else estimator
    choice = choose_estimator(source.spectra, requested, noise_ratio, record.reference_name)
    ratio = ratio_of(source.spectra, choice)
    noise, bias = ratio_covariance(source.spectra, ratio, choice), source.bias
    if bias is None:  # H''/6 of a Hann window, zero at both ends
        bias = np.zeros_like(ratio)
        bias[1:-1] = (ratio[2:] - 2.0 * ratio[1:-1] + ratio[:-2]) / 6.0
    covariance = noise + circular_covariance(bias[:, :, None] * bias.conj()[:, None, :])
    notices = [choice.notice(record.reference_name, source.text)]
    cause, dof = "A polynomial over five lines" if local else "Leakage", np.full(len(chosen), source.dof)
    for c, name in enumerate(record.channels):
        notices += resolution_notices(chosen, ratio[:, c], np.sqrt(noise[:, c, c]), name, cause)
    return TransferFunction(
        ratio=Phasors(chosen, ratio, covariance, record.channels, record.ratio_unit, dof),
        coherence=source.spectra.coherence,
        estimator="local" if local else choice.estimator,
        reference=record.reference_name,
        averages=source.spectra.averages,
        line_spacing_hz=record.sample_rate_hz / length,
        line_correlation=source.line_correlation,
        notices=tuple(notices),
    )


def _select_lines(
    record: TransferRecord, resolution_hz: float, band_hz: tuple[float, float] | None
) -> tuple[int, FloatArray]:
    """Return the samples of 1/resolution, and the lines (K,) in Hz inside a band."""
    rate = record.sample_rate_hz
    if not 0.0 < resolution_hz < rate / 16.0:
        raise ValueError(f"resolution_hz: expected a value in (0, {rate / 16.0:.6g}), found {resolution_hz}")
    length = round(rate / resolution_hz)
    if len(record.reference) < 2 * length:
        raise ValueError(
            f"resolution_hz: expected two segments or more in the record, so at least "
            f"{2.0 * rate / len(record.reference):.3g} Hz, found {resolution_hz} Hz"
        )
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    low, high = band_hz or (0.0, 0.5 * rate)
    inside = (frequency >= low) & (frequency <= high)
    inside[:_FIRST_BIN] = inside[-1] = False
    if not inside.any():
        raise ValueError(f"band_hz: expected a band with lines of {rate / length:.6g} Hz, found {low} to {high} Hz")
    return length, np.asarray(frequency[inside], dtype=np.float64)


def averaged_spectra(record: TransferRecord, length: int, frequency_hz: FloatArray) -> LineSpectra:
    """Return averaged spectra [reference, responses] at neighbouring lines (K,) in Hz.

    Segments have `length` samples. Noise in two segments that begin d samples apart correlates as Σ
    w(n)·w(n+d)·exp(-jωn). This gives the number of independent segments and the correlation of errors of neighbouring
    lines.
    """
    window, hop = hann_window(length), max(1, length // _HOP)
    starts = range(0, len(record.reference) - length + 1, hop)
    count = len(starts)
    total = np.zeros(_REACH)
    for lag in range(min(count, -(-length // hop))):
        overlap = np.zeros(length)
        overlap[: length - lag * hop] = window[lag * hop :] * window[: length - lag * hop]
        share = (count - lag) / count * (1.0 if lag == 0 else 2.0)
        total = total + share * np.abs(np.fft.rfft(overlap)[:_REACH] / np.sum(window**2)) ** 2
    independent, correlation = count / float(total[0]), np.asarray(total / total[0], dtype=np.complex128)
    together = np.column_stack([record.reference, record.responses])
    together = together - together.mean(axis=0)
    first = round(float(frequency_hz[0]) * length / record.sample_rate_hz)
    power = np.zeros((len(frequency_hz), together.shape[1], together.shape[1]), dtype=np.complex128)
    for start in starts:
        transform = np.fft.rfft(window[:, None] * together[start : start + length], axis=0)
        value = transform[first : first + len(frequency_hz)]
        power += value[:, :, None] * value.conj()[:, None, :]
    return LineSpectra(
        Spectra(np.asarray(power / count), np.full(len(frequency_hz), independent)),
        None,
        2.0 * (independent - 1.0),
        correlation[np.abs(correlation) > _CORRELATED],
        f"{count} Hann segments with 67 % overlap, worth {independent:.3g} independent ones",
    )
