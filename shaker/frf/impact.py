"""Transfer functions from blows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shaker.frf.random import EstimatorChoice, Spectra, choose_estimator, ratio_of
from shaker.frf.result import TransferFunction, TransferRecord, circular_covariance, pooled_scatter, share_of_reference
from shaker.lines.spectrum import hann_window
from shaker.sine.phasor import Phasors
from shakercal._common.notices import Notice

# Hits of an impact hammer in a force record: where they are, and which of them count.

_HIT = 0.1  # share of the largest force from which a pulse is a hit
_FOOT = 0.01  # share of a pulse's peak at which it begins and ends
_AGAIN = 0.05  # share of a pulse's peak from which a second pulse is a second hit
_NOISE = 6.0  # standard deviations of the force at rest that no foot goes below
_FAR = 0.3  # share of the largest excursion from which an end of the range is not the level at rest
_CLIPPED = 3  # equal samples in a row at the range's end that tell an overload


@dataclass(frozen=True)
class Hit:
    """A pulse: first and last sample above its foot, and its peak; `refused` says why it does not count (or empty)."""

    first: int
    last: int
    peak: int
    refused: str = ""


def find_hits(record: TransferRecord, length: int) -> list[Hit]:
    """Return the hits of a record whose reference is a force, judged for windows of `length` samples.

    A hit does not count where the record ends before its window does, where a second pulse stands in the window (which
    is no hit of its own), and where any channel is overloaded in it.
    """
    force = record.reference - float(np.median(record.reference))
    noise = float(np.median(np.abs(force)) / 0.6745)
    if force.max() < -force.min():
        force = -force
    largest = float(force.max(initial=0.0))
    if not largest > 2.0 * _NOISE * noise:
        raise ValueError(f"reference: expected a force with hits, found only noise in {record.reference_name}")
    overloaded, hits = _overloads(record), list[Hit]()
    for around in _runs(force > _HIT * largest):
        if not hits or around[0] >= hits[-1].first + length:
            hits.append(_hit(force, noise, overloaded, around, length))
    return hits


def _hit(force: FloatArray, noise: float, overloaded: BoolArray, around: tuple[int, int], length: int) -> Hit:
    """Return the pulse around samples low … high, with the reason why it does not count."""
    peak = around[0] + int(np.argmax(force[around[0] : around[1] + 1]))
    foot = max(_FOOT * float(force[peak]), _NOISE * noise)
    before, after = np.flatnonzero(force[: peak + 1] < foot), np.flatnonzero(force[peak:] < foot)
    first = int(before[-1]) + 1 if len(before) else 0
    last = peak + int(after[0]) - 1 if len(after) else len(force) - 1
    end, calm = first + length, 1 + (last - first + 1) // 2
    again = np.flatnonzero(force[last + calm : end] > max(_AGAIN * float(force[peak]), _NOISE * noise))
    refused = ""
    if end > len(force):
        refused = "the record ends before its window does"
    elif overloaded[first:end].any():
        refused = "a channel is overloaded"
    elif len(again):
        refused = f"a second pulse follows {again[0] + calm} samples later"
    return Hit(first, last, peak, refused)


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Return first and last index of every run of true samples."""
    edges: IntArray = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _overloads(record: TransferRecord) -> BoolArray:
    """Tell the samples (S,) where any channel stays at the end of its range."""
    overloaded = np.zeros(len(record.reference), dtype=np.bool_)
    for samples in (record.reference, *record.responses.T):
        rest = float(np.median(samples))
        far = _FAR * float(np.max(np.abs(samples - rest)))
        for end in (samples.min(), samples.max()):
            for low, high in _runs(samples == end) if abs(end - rest) >= far else ():
                if high - low + 1 >= _CLIPPED:
                    overloaded[low : high + 1] = True
    return overloaded


# Transfer functions from hammer blows: windows, average over hits, covariance over hits.

_END = (1e-6, 1e-3)  # least and largest share of a response's beginning that its end may keep
_HIDDEN = 0.3  # share of the noise at which the end of a response is hidden in it
_STANDS_OUT = 8.0  # factor over the lines around from which a line still rings
_AROUND = 41  # lines that are around
_EXCITED = 0.01  # share of the force spectrum's maximum below which nothing is excited
_ENOUGH = 5  # hits from which the coherence tells where the noise is
_REST = 8  # samples before the hits from which noise can be read
_REACH = 512  # lines over which errors correlate under an exponential window, at most


def transfer_impact(
    record: TransferRecord,
    duration_s: float,
    *,
    pretrigger_s: float | None = None,
    added_decay_per_s: float | None = None,
    estimator: Literal["auto", "H1", "H2", "Hv"] = "auto",
    band_hz: tuple[float, float] | None = None,
) -> TransferFunction:
    """Return H from hammer blows: windows of `duration_s` around every hit that counts, averaged.

    Hits with a second pulse, an overload or a window beyond the record do not count, with a notice. The force keeps its
    pulse only (force window with cosine flanks). Force and responses are multiplied by exp(-at), t from the hit: the
    ratio is then exactly H(a + jω), also if the response outlasts the window but for exp(-a·duration). a is
    `added_decay_per_s`; None takes the smallest that hides what the slowest mode still does at the end in its noise,
    often zero. The covariance is the scatter over the hits, pooled over neighbouring lines; that of a single hit
    is the noise before it, taken as white. `pretrigger_s` is what the window shows before a hit, None 5 % of it.

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
    wanted = round((0.05 * duration_s if pretrigger_s is None else pretrigger_s) * rate)
    if not 0 <= wanted < length // 2 or length < 64:
        raise ValueError(
            f"duration_s: expected 64 samples or more and a shorter pretrigger_s, found {length} and {wanted} samples"
        )
    hits = find_hits(record, length)
    taken = [hit for hit in hits if not hit.refused]
    if not taken:
        raise ValueError(f"record: expected a hit that counts, found {len(hits)}: {'; '.join(h.refused for h in hits)}")
    blows = _cut(record, taken, length, min([wanted, *(hit.first for hit in taken)]))
    decay = _needed_decay(blows) if added_decay_per_s is None else added_decay_per_s
    lines = _transformed(blows, decay, band_hz or (0.0, 0.5 * rate))
    averages = np.full(len(lines.frequency_hz), float(len(taken)))
    spectra = Spectra(np.mean(lines.value[:, :, :, None] * lines.value.conj()[:, :, None, :], axis=0), averages)
    few = len(taken) < _ENOUGH  # too few to tell where the noise is
    choice = EstimatorChoice("H1", 1.0, f"fewer than {_ENOUGH} hits, and the window keeps noise off the force")
    if estimator != "auto" or not few:
        choice = choose_estimator(spectra, estimator, 1.0 if few else None, record.reference_name)
    ratio = ratio_of(spectra, choice)
    # How the errors of lines 0, 1, 2 … apart correlate under the exponential window, and the force's under its own.
    square = np.exp(-2.0 * decay * blows.time_s)
    under_window = np.fft.fft(np.roll(square, -int(np.searchsorted(blows.time_s, 0.0))))
    under_force = np.fft.fft(np.mean(blows.force_window**2, axis=0) * square)
    correlation = np.ones(1, dtype=np.complex128)
    if decay > 0.0:
        correlation = np.asarray(under_window[: min(_REACH, len(lines.frequency_hz))] / under_window[0])
    covariance, dof = _covariance(lines, ratio, (correlation, np.asarray(under_force / under_force[0])))
    return TransferFunction(
        ratio=Phasors(lines.frequency_hz, ratio, covariance, record.channels, record.ratio_unit, dof),
        coherence=spectra.coherence,
        estimator=choice.estimator,
        reference=record.reference_name,
        averages=averages,
        line_spacing_hz=rate / length,
        line_correlation=correlation,
        notices=_notices(record, hits, choice, decay, lines),
        added_decay_per_s=decay,
    )


@dataclass(frozen=True)
class _Blows:
    """Windows (N samples) of n hits: `time_s` (N,) from the hit, `samples` (n, N, 1 + C) without offset, force first.

    `force_window` (n, N); `noise` (1 + C, 1 + C): covariance of the samples before the hits, of `noise_dof` degrees of
    freedom, zero where there are too few.
    """

    time_s: FloatArray
    samples: FloatArray
    force_window: FloatArray
    noise: FloatArray
    noise_dof: float


@dataclass(frozen=True)
class _Lines:
    """Transforms `value` (n, K, 1 + C) at the lines excited; `noise` (K, 1 + C, 1 + C) that stands in each of them."""

    frequency_hz: FloatArray
    value: ComplexArray
    noise: FloatArray
    noise_dof: float


def _cut(record: TransferRecord, hits: list[Hit], length: int, before: int) -> _Blows:
    """Cut the windows and take offsets off: of the force that before the hit, of the responses that of the second half.

    A Hann weight keeps what still rings out of a response's offset.
    """
    together = np.column_stack([record.reference, record.responses])
    windows = np.stack([together[hit.first - before : hit.first - before + length] for hit in hits])
    rest = windows[:, :before] - windows[:, :before].mean(axis=1, keepdims=True) if before else windows[:, :0]
    later = length // 2
    offset = np.einsum("l,nlc->nc", hann_window(later) / later, windows[:, -later:])
    offset[:, 0] = windows[:, :before, 0].mean(axis=1) if before else np.median(record.reference)
    windows = windows - offset[:, None, :]
    rest = rest.reshape(-1, together.shape[1])
    dof = len(hits) * (before - 1.0) if before >= _REST else 0.0
    noise = rest.T @ rest / dof if dof else np.zeros((together.shape[1],) * 2)
    # One over the pulse and half its length on either side, with cosine flanks.
    pulse = np.array([[hit.last - hit.first + 1] for hit in hits])
    half, place = np.maximum(2, pulse // 2), np.arange(length)
    outside = np.maximum(before - half - place, place - (before + pulse - 1 + half))
    force_window = 0.5 + 0.5 * np.cos(np.pi * np.clip(outside / half, 0.0, 1.0))
    return _Blows((np.arange(length) - before) / record.sample_rate_hz, windows, force_window, noise, dof)


def _needed_decay(blows: _Blows) -> float:
    """Return the decay per second that lets every mode end below the noise, zero where none is needed.

    Modes are the lines that stand out of the spectrum of the window's last quarter; how much lower they are than in the
    first quarter tells their own decay.
    """
    from scipy.ndimage import median_filter

    begin = int(np.searchsorted(blows.time_s, 0.0))
    quarter = (len(blows.time_s) - begin) // 4
    taper = hann_window(quarter)[:, None]
    first, last = (
        np.sqrt(np.mean(np.abs(np.fft.rfft(part * taper, axis=1)[:, 2:]) ** 2, axis=0))
        for part in (blows.samples[:, begin : begin + quarter, 1:], blows.samples[:, -quarter:, 1:])
    )
    around = median_filter(last, size=(min(_AROUND, len(last)), 1), mode="nearest")
    rings = last > _STANDS_OUT * around
    if not rings.any():
        return 0.0
    start = np.maximum(first[rings], np.finfo(np.float64).tiny)
    allowed = np.clip(_HIDDEN * around[rings] / start, *_END)
    # Three quarters of the window lie between the two, four between the hit and the end.
    left = np.minimum(last[rings] / start, 1.0) ** (4.0 / 3.0)
    return max(0.0, float(np.max(np.log(left / allowed)) / blows.time_s[-1]))


def _transformed(blows: _Blows, decay: float, band_hz: tuple[float, float]) -> _Lines:
    """Return the transforms of the windows at the lines of the band that the force excites without a gap from zero."""
    length = len(blows.time_s)
    window = np.exp(-decay * blows.time_s)
    seen = blows.samples * window[:, None]
    seen[:, :, 0] *= blows.force_window
    rate = 1.0 / (blows.time_s[1] - blows.time_s[0])
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    value = np.fft.rfft(seen, axis=1)
    force = np.sqrt(np.mean(np.abs(value[:, :, 0]) ** 2, axis=0))
    weak = np.flatnonzero(force < _EXCITED * force.max())
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
    return _Lines(np.asarray(frequency[inside], dtype=np.float64), value[:, inside], noise, blows.noise_dof)


def _covariance(
    lines: _Lines, ratio: ComplexArray, correlations: tuple[ComplexArray, ComplexArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (K, 2C, 2C) of the ratio and its dof (K,), given how lines correlate: all, force alone.

    The force window leaves the force's noise in one hit about the same over many lines: what it does to them is known
    from the hits only. Flat noise and noise times |H|² add as Welch and Satterthwaite say: 1/ν = (1 - s)²/ν₁ + s²/ν₂.
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
    record: TransferRecord, hits: list[Hit], choice: EstimatorChoice, decay: float, lines: _Lines
) -> tuple[Notice, ...]:
    """Return what the user should know about hits, windows and estimator."""
    count = len(lines.value)
    found = [choice.notice(record.reference_name, f"{count} of {len(hits)} hits")]
    for number, hit in enumerate(hits, start=1):
        if hit.refused:
            seconds = hit.peak / record.sample_rate_hz
            text = f"hit {number} at {seconds:.6g} s does not count: {hit.refused}"
            found.append(Notice("warning", text, record.reference_name))
    if decay > 0.0:
        text = f"exponential window exp(-{decay:.6g}/s·t): the transfer function is H(a + jω), fits take the window off"
        found.append(Notice("note", text, record.reference_name))
    if count == 1:
        known = "is the noise before it" if lines.noise_dof else "is not known: too few samples before it"
        found.append(Notice("warning", f"a single hit: its uncertainty {known}", record.reference_name))
    return tuple(found)
