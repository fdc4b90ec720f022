"""Transfer functions from hammer blows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.frf.random import EstimatorSelection, Spectra, choose_estimator, estimate_ratio
from shaker.frf.result import TransferFunction, TransferRecord, circular_covariance, pooled_scatter, share_of_reference
from shaker.io.condition import runs_of
from shaker.lines.spectrum import hann_window
from shaker.signal_notices import (
    ESTIMATOR_FEW_HITS,
    EXPONENTIAL_WINDOW,
    HIT_OVERLOADED,
    HIT_REPEATED,
    HIT_WITHOUT_WINDOW,
    SINGLE_HIT,
    SINGLE_HIT_WITHOUT_NOISE,
)
from shaker.sine.phasor import Phasors
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import DeclaredNotice, Notice, Value

# Hits of an impact hammer in a force record: where they are, and which of them count.

_HIT_SHARE = 0.1  # share of the largest force from which a pulse is a hit
_FOOT_SHARE = 0.01  # share of a pulse's peak at which it begins and ends
_SECOND_PULSE = 0.05  # share of a pulse's peak from which a second pulse is a second hit
_NOISE_SIGMAS = 6.0  # standard deviations of the force at rest that no foot goes below
_RANGE_END_SHARE = 0.3  # share of the largest excursion from which an end of the range is not the level at rest
_CLIPPED_RUN = 3  # equal samples in a row at the range's end that indicate an overload


@dataclass(frozen=True)
class Hit:
    """A pulse above its foot, why it is rejected, and a second pulse's delay."""

    first: int
    last: int
    peak: int
    rejected: DeclaredNotice | None = None
    repeated_after: int = 0


def find_hits(record: TransferRecord, length: int) -> list[Hit]:
    """Return the hits of a record whose reference is a force.

    They are judged for windows of `length` samples. A hit is rejected where the record ends before its window does,
    where a second pulse follows in the window (which is no separate hit), and where any channel is overloaded in it.
    """
    force = record.reference - float(np.median(record.reference))
    noise = float(np.median(np.abs(force)) / 0.6745)
    if force.max() < -force.min():
        force = -force
    largest = float(force.max(initial=0.0))
    if not largest > 2.0 * _NOISE_SIGMAS * noise:
        raise ValueError(f"reference: expected a force with hits, found only noise in {record.reference_name}")
    overloaded, hits = _overloads(record), list[Hit]()
    for around in runs_of(force > _HIT_SHARE * largest).tolist():
        if not hits or around[0] >= hits[-1].first + length:
            hits.append(_hit(force, noise, overloaded, (around[0], around[1]), length))
    return hits


def _hit(force: FloatArray, noise: float, overloaded: BoolArray, around: tuple[int, int], length: int) -> Hit:
    """Return the pulse in a run of samples, with the reason for its rejection."""
    peak = around[0] + int(np.argmax(force[around[0] : around[1]]))
    foot = max(_FOOT_SHARE * float(force[peak]), _NOISE_SIGMAS * noise)
    before, after = np.flatnonzero(force[: peak + 1] < foot), np.flatnonzero(force[peak:] < foot)
    first = int(before[-1]) + 1 if len(before) else 0
    last = peak + int(after[0]) - 1 if len(after) else len(force) - 1
    end, calm = first + length, 1 + (last - first + 1) // 2
    second = np.flatnonzero(force[last + calm : end] > max(_SECOND_PULSE * float(force[peak]), _NOISE_SIGMAS * noise))
    if end > len(force):
        return Hit(first, last, peak, HIT_WITHOUT_WINDOW)
    if overloaded[first:end].any():
        return Hit(first, last, peak, HIT_OVERLOADED)
    if len(second):
        return Hit(first, last, peak, HIT_REPEATED, int(second[0]) + calm)
    return Hit(first, last, peak)


def _overloads(record: TransferRecord) -> BoolArray:
    """Return the samples (S,) where any channel stays at the end of its range."""
    overloaded = np.zeros(len(record.reference), dtype=np.bool_)
    for samples in (record.reference, *record.responses.T):
        rest = float(np.median(samples))
        far = _RANGE_END_SHARE * float(np.max(np.abs(samples - rest)))
        for end in (samples.min(), samples.max()):
            for low, high in runs_of(samples == end).tolist() if abs(end - rest) >= far else ():
                if high - low >= _CLIPPED_RUN:
                    overloaded[low:high] = True
    return overloaded


# Transfer functions from hammer blows: windows, average over hits, covariance over hits.

_END_SHARE = (1e-6, 1e-3)  # least and largest share of a response's beginning that its end may keep
_HIDDEN_SHARE = 0.3  # share of the noise at which the end of a response is hidden in it
_RINGING_FACTOR = 8.0  # factor over neighbouring lines from which a line is ringing
_NEIGHBOUR_LINES = 41  # lines that are around
_EXCITED_SHARE = 0.01  # share of the force spectrum's maximum below which lines are not excited
_MANY_HITS = 5  # hits from which the coherence shows where the noise is
_MIN_REST_SAMPLES = 8  # samples before the hits from which noise can be read
_MAX_CORRELATED_LINES = 512  # lines over which errors correlate under an exponential window, at most


def transfer_impact(
    record: TransferRecord,
    duration_s: float,
    *,
    pretrigger_s: float | None = None,
    added_decay_per_s: float | None = None,
    estimator: Literal["auto", "H1", "H2", "Hv"] = "auto",
    band_hz: tuple[float, float] | None = None,
) -> TransferFunction:
    """Return H from hammer blows: the average over windows around all valid hits.

    Parameters
    ----------
    record
        Force as reference, and responses.
    duration_s
        Length of a window in s.
    pretrigger_s
        Part of the window before a hit in s; default 5 % of it.
    added_decay_per_s
        Decay a of the exponential window in 1/s; default: the smallest needed, often zero.
    estimator
        "H1", "H2", "Hv"; default "auto" selects by the noise.
    band_hz
        Band of the result in Hz; default: all excited lines.

    Returns
    -------
    The transfer function H(a + jω) with covariance and coherence.

    Raises
    ------
    ValueError
        No hit is valid, the window is too short, or the band has no excited line.

    Notes
    -----
    Hits with a second pulse, an overload or a window beyond the record are rejected, with a notice. The force keeps
    only its pulse (force window with cosine flanks). Force and responses are multiplied by exp(-at), t from the hit.
    The ratio is then exactly H(a + jω), even if the response outlasts the window, except for exp(-a·duration). The
    default a is the smallest that hides the rest of the slowest mode at the end in its noise. The covariance is the
    scatter over the hits, pooled over neighbouring lines. For a single hit it is the noise before it, treated as white.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> from shaker import TransferRecord, transfer_impact
    >>> force = np.zeros(4000)
    >>> force[500:503] = force[2500:2503] = [30.0, 60.0, 30.0]  # two blows
    >>> motion = lfilter([0.02], [1.0, -1.8, 0.97], force)
    >>> record = TransferRecord(force, motion[:, None], 1000.0, "force", "N", ("z",), ("m",))
    >>> transfer_impact(record, duration_s=1.0)
    TransferFunction(H1 over force: Phasors(468 lines from 1 to 468 Hz: z [m/N]))
    """
    rate = record.sample_rate_hz
    length = round(duration_s * rate)
    pretrigger = round((0.05 * duration_s if pretrigger_s is None else pretrigger_s) * rate)
    if not 0 <= pretrigger < length // 2 or length < 64:
        found = f"{length} and {pretrigger} samples"
        raise ValueError(f"duration_s: expected 64 samples or more and a shorter pretrigger_s, found {found}")
    hits = find_hits(record, length)
    valid = [hit for hit in hits if hit.rejected is None]
    if not valid:
        rejected = " ".join(notice.text for notice in _rejections(record, hits))
        raise ValueError(f"record: expected a valid hit, found {len(hits)} rejected: {rejected}")
    blows = _cut_windows(record, valid, length, min([pretrigger, *(hit.first for hit in valid)]))
    decay = _required_decay(blows) if added_decay_per_s is None else added_decay_per_s
    lines = _transform_windows(blows, decay, band_hz or (0.0, 0.5 * rate))
    averages = np.full(len(lines.frequency_hz), float(len(valid)))
    spectra = Spectra(np.mean(lines.value[:, :, :, None] * lines.value.conj()[:, :, None, :], axis=0), averages)
    few = len(valid) < _MANY_HITS  # too few to show where the noise is
    selection = EstimatorSelection("H1", 1.0, ESTIMATOR_FEW_HITS, {"enough": _MANY_HITS})
    if estimator != "auto" or not few:
        selection = choose_estimator(spectra, estimator, 1.0 if few else None, record.reference_name)
    ratio = estimate_ratio(spectra, selection)
    # Correlation of the errors of lines at distances 0, 1, 2 …: with the exponential window, and with the force window.
    square = np.exp(-2.0 * decay * blows.time_s)
    under_window = np.fft.fft(np.roll(square, -int(np.searchsorted(blows.time_s, 0.0))))
    under_force = np.fft.fft(np.mean(blows.force_window**2, axis=0) * square)
    correlation = np.ones(1, dtype=np.complex128)
    if decay > 0.0:
        correlation = np.asarray(under_window[: min(_MAX_CORRELATED_LINES, len(lines.frequency_hz))] / under_window[0])
    covariance, dof = _covariance(lines, ratio, (correlation, np.asarray(under_force / under_force[0])))
    return TransferFunction(
        ratio=Phasors(lines.frequency_hz, ratio, covariance, record.channels, record.ratio_unit, dof),
        coherence=spectra.coherence,
        estimator=selection.estimator,
        reference=record.reference_name,
        averages=averages,
        line_spacing_hz=rate / length,
        line_correlation=correlation,
        notices=_notices(record, hits, selection, decay, lines),
        added_decay_per_s=decay,
    )


@dataclass(frozen=True)
class _Blows:
    """Windows (N samples) of n hits without offset.

    Attributes
    ----------
    time_s : (N,), from the hit.
    samples : (n, N, 1 + C), force first.
    force_window : (n, N).
    noise, noise_dof : (1 + C, 1 + C), covariance of the samples before the hits and its degrees of freedom, zero if too
        few.
    """

    time_s: FloatArray
    samples: FloatArray
    force_window: FloatArray
    noise: FloatArray
    noise_dof: float


@dataclass(frozen=True)
class _BlowLines:
    """Transforms (n, K, 1 + C) at the excited lines, and noise of each."""

    frequency_hz: FloatArray
    value: ComplexArray
    noise: FloatArray
    noise_dof: float


def _cut_windows(record: TransferRecord, hits: list[Hit], length: int, before: int) -> _Blows:
    """Cut the windows and subtract offsets.

    The offset of the force is that before the hit, that of the responses is from the second half. A Hann weight removes
    ringing from a response's offset.
    """
    together = np.column_stack([record.reference, record.responses])
    windows = np.stack([together[hit.first - before : hit.first - before + length] for hit in hits])
    rest = windows[:, :before] - windows[:, :before].mean(axis=1, keepdims=True) if before else windows[:, :0]
    later = length // 2
    offset = np.einsum("l,nlc->nc", hann_window(later) / later, windows[:, -later:])
    offset[:, 0] = windows[:, :before, 0].mean(axis=1) if before else np.median(record.reference)
    windows = windows - offset[:, None, :]
    rest = rest.reshape(-1, together.shape[1])
    dof = len(hits) * (before - 1.0) if before >= _MIN_REST_SAMPLES else 0.0
    noise = rest.T @ rest / dof if dof else np.zeros((together.shape[1],) * 2)
    # One over the pulse and half its length on either side, with cosine flanks.
    pulse = np.array([[hit.last - hit.first + 1] for hit in hits])
    half, index = np.maximum(2, pulse // 2), np.arange(length)
    outside = np.maximum(before - half - index, index - (before + pulse - 1 + half))
    force_window = 0.5 + 0.5 * np.cos(np.pi * np.clip(outside / half, 0.0, 1.0))
    return _Blows((np.arange(length) - before) / record.sample_rate_hz, windows, force_window, noise, dof)


def _required_decay(blows: _Blows) -> float:
    """Return the decay per second that hides every mode's end in noise.

    It is zero where none is needed. Modes are the significant lines in the spectrum of the window's last quarter. Their
    level relative to the first quarter shows their decay.
    """
    from scipy.ndimage import median_filter

    begin = int(np.searchsorted(blows.time_s, 0.0))
    quarter = (len(blows.time_s) - begin) // 4
    taper = hann_window(quarter)[:, None]
    first, last = (
        np.sqrt(np.mean(np.abs(np.fft.rfft(part * taper, axis=1)[:, 2:]) ** 2, axis=0))
        for part in (blows.samples[:, begin : begin + quarter, 1:], blows.samples[:, -quarter:, 1:])
    )
    around = median_filter(last, size=(min(_NEIGHBOUR_LINES, len(last)), 1), mode="nearest")
    rings = last > _RINGING_FACTOR * around
    if not rings.any():
        return 0.0
    start = np.maximum(first[rings], np.finfo(np.float64).tiny)
    allowed = np.clip(_HIDDEN_SHARE * around[rings] / start, *_END_SHARE)
    # Three quarters of the window lie between the two, four between the hit and the end.
    left = np.minimum(last[rings] / start, 1.0) ** (4.0 / 3.0)
    return max(0.0, float(np.max(np.log(left / allowed)) / blows.time_s[-1]))


def _transform_windows(blows: _Blows, decay: float, band_hz: tuple[float, float]) -> _BlowLines:
    """Return the windows' transforms at the band's lines below the first unexcited one."""
    length = len(blows.time_s)
    window = np.exp(-decay * blows.time_s)
    seen = blows.samples * window[:, None]
    seen[:, :, 0] *= blows.force_window
    rate = 1.0 / (blows.time_s[1] - blows.time_s[0])
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    value = np.fft.rfft(seen, axis=1)
    force = np.sqrt(np.mean(np.abs(value[:, :, 0]) ** 2, axis=0))
    weak = np.flatnonzero(force < _EXCITED_SHARE * force.max())
    inside = (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    inside[0] = inside[-1] = False
    inside[weak[0] if len(weak) else len(inside) :] = False
    if not inside.any():
        raise ValueError(
            f"band_hz: expected lines that the force excites, found none in {band_hz[0]} to {band_hz[1]} Hz"
        )
    # White noise of the samples, as the windows let it through.
    share = np.append(
        np.mean(np.sum((window * blows.force_window) ** 2, axis=1)), np.full(value.shape[2] - 1, window @ window)
    )
    noise = blows.noise * np.sqrt(np.multiply.outer(share, share))
    noise[0, 1:] = noise[1:, 0] = 0.0
    return _BlowLines(np.asarray(frequency[inside], dtype=np.float64), value[:, inside], noise, blows.noise_dof)


def _covariance(
    lines: _BlowLines, ratio: ComplexArray, correlations: tuple[ComplexArray, ComplexArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (K, 2C, 2C) of the ratio and its dof (K,).

    `correlations` are those of lines: in all channels, and in the force alone. The force window leaves the force's
    noise in one hit about the same over many lines. Its effect on them is therefore only estimated from the hits. Flat
    noise and noise times |H|² are combined by Welch and Satterthwaite: 1/ν = (1 - s)²/ν₁ + s²/ν₂.
    """
    count = len(lines.value)
    force = np.sum(np.abs(lines.value[:, :, 0]) ** 2, axis=0)[:, None, None]
    if count > 1:
        error = lines.value[:, :, 1:] - ratio * lines.value[:, :, :1]
        scatter = np.einsum("nkc,nkd->kcd", error, error.conj()) / (count - 1)
        pooled, number = pooled_scatter(scatter, ratio, 2.0 * (count - 1))
        # As how many independent lines neighbours count whose errors correlate.
        flat, through = (np.maximum(1.0, number / (1.0 + 2.0 * np.sum(np.abs(c[1:17]) ** 2))) for c in correlations)
        share = np.max(share_of_reference(scatter, ratio), axis=1)
        worth = 1.0 / ((1.0 - share) ** 2 / flat + share**2 / np.minimum(flat, through))
        return circular_covariance(pooled / force), 2.0 * (count - 1) * worth
    if lines.noise_dof == 0.0:
        size = 2 * ratio.shape[1]
        return np.full((len(ratio), size, size), np.nan), np.full(len(ratio), np.nan)
    through = ratio[:, :, None] * ratio.conj()[:, None, :] * lines.noise[0, 0]
    return circular_covariance((lines.noise[1:, 1:] + through) / force), np.full(len(ratio), lines.noise_dof)


def _notices(
    record: TransferRecord, hits: list[Hit], selection: EstimatorSelection, decay: float, lines: _BlowLines
) -> tuple[Notice, ...]:
    """Return notices about hits, windows and estimator."""
    count, where = len(lines.value), record.reference_name
    notices = [selection.notice(where, f"{count} of {len(hits)} hits"), *_rejections(record, hits)]
    if decay > 0.0:
        notices.append(Notice(EXPONENTIAL_WINDOW, where, decay_per_s=decay))
    if count == 1:
        notices.append(Notice(SINGLE_HIT if lines.noise_dof else SINGLE_HIT_WITHOUT_NOISE, where))
    return tuple(notices)


def _rejections(record: TransferRecord, hits: list[Hit]) -> list[Notice]:
    """Return a notice for every rejected hit."""
    notices = []
    for number, hit in enumerate(hits, start=1):
        if hit.rejected is not None:
            values: dict[str, Value] = {"number": number, "time_s": hit.peak / record.sample_rate_hz}
            if hit.repeated_after:
                values["samples"] = hit.repeated_after
            notices.append(Notice(hit.rejected, record.reference_name, **values))
    return notices
