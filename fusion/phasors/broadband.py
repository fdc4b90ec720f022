"""Channels of chirps, noise and blows: phasors over that of a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import InputError
from fusion.instruments.channel import (
    ChainUncertainty,
    ChannelReading,
    ChannelRelativeError,
    nonzero_errors,
)
from fusion.phasors.aligned_channels import AlignedChannels, align
from fusion.phasors.channel_phasors import (
    EXCERPT_PERIODS,
    LINE_QUANTITIES,
    ChannelResult,
    chain_correction,
    channel_spectrum,
)
from fusion.phasors.phasor_notices import (
    BROADBAND_REFUSED,
    LINES_WITHOUT_SIGNAL,
)
from fusion.phasors.timing import TimeBase
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.transducer import HEAD, STATIONARY, TRANSDUCERS
from shaker.frf.periodic import transfer_periodic
from shaker.frf.random import transfer_random
from shaker.frf.rest import RestError
from shaker.frf.result import TransferFunction, TransferRecord
from shaker.frf.sampled_motion import ReferenceSignals
from shaker.frf.sweeps import transfer_from_rest
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.phasor import Phasors
from shaker.timebase.edges import PASS_BAND
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

LINES, SEGMENTS = 20, 16
"""Lines in equal ratios where none are stated; the line spacing of the channels' spectra is so many times 1/length."""
MIN_COHERENCE = 0.9
"""Coherence with the reference that a channel must reach, else a line has no signal (chosen)."""
MOST_SPACINGS = 2.5
"""Line spacings from one excited line to the next, between which the spectra of a chirp are interpolated (chosen)."""
EXACT = 1e-6
"""Relative standard uncertainty of the reference's phasors by its noise, at least: the ratios contain it (chosen)."""
MIN_CHANNELS, INERTIAL = 2, 2
"""Channels that a ratio requires; time derivatives from a displacement to forces and outputs."""


@dataclass(frozen=True)
class BroadbandRecord:
    """Channels of a chirp, noise or blows on the first clock, and their recorded phasors.

    `signals`: samples of all channels. `value` (K, C), `covariance` (K, 2C, 2C), `dof` (K,): phasors relative to that
    of the reference, which is real, times its amplitude within the line spacing. `unit` (C,): of the channels.
    """

    aligned: AlignedChannels
    lines: LineFrequencies
    signals: ReferenceSignals
    unit: tuple[str, ...]
    value: ComplexArray
    covariance: FloatArray
    dof: FloatArray


def read_broadband(manifest: Manifest, base: TimeBase) -> BroadbandRecord:
    """Return the channels' phasors relative to a reference.

    At the stated frequencies, or at 20 in equal ratios.
    """
    band_hz = _band(manifest)
    selected = [
        (record.entry.name, entry)
        for record in base.records
        for entry in record.entry.channel
        if entry.quantity != "trigger" and entry.body not in (STATIONARY, HEAD)
    ]
    if len(selected) < MIN_CHANNELS:
        expected = "a reference, and another channel that follows it"
        raise _refusal(manifest, "daq.channel", f"{len(selected)} channels", expected)
    aligned = align(manifest, base.records, selected, "daq.channel", base)
    if band_hz[1] > 0.5 * aligned.rate_hz:
        expected = f"a band below half the sampling rate, {0.5 * aligned.rate_hz:g} Hz"
        raise _refusal(manifest, "excitation.band", f"{band_hz[1]:g} Hz", expected)
    signals = _signals(base, aligned, band_hz)
    band_hz = signals.band_hz
    wanted = _wanted(manifest, band_hz)
    names = [entry.name for _, entry in selected]
    first = _reference(manifest, [entry for _, entry in selected], signals, wanted)
    record = TransferRecord(
        reference=signals.values[:, first],
        responses=np.delete(signals.values, first, axis=1),
        sample_rate_hz=signals.rate_hz,
        reference_name=names[first],
        reference_unit="",
        channels=(*names[:first], *names[first + 1 :]),
        unit=("",) * (len(names) - 1),
    )
    ratios, wanted, silent, unrest = _ratios(manifest, record, wanted, band_hz)
    if not len(wanted):
        expected = f"lines at which a channel follows {names[first]} (coherence of at least {MIN_COHERENCE:g})"
        raise _refusal(manifest, "excitation.band", f"noise at {silent} Hz", expected)
    others = np.delete(np.arange(len(names)), first)
    both = np.concatenate([others, others + len(names)])
    covariance = np.zeros((len(wanted), 2 * len(names), 2 * len(names)))
    covariance[:, both[:, None], both] = ratios.ratio.covariance
    covariance[:, [first, first + len(names)], [first, first + len(names)]] = EXACT**2
    scale = _amplitude(record.reference, signals.rate_hz, ratios.ratio.frequency_hz)[:, None]
    notices = [Notice(LINES_WITHOUT_SIGNAL, "excitation.band", frequencies=silent)] if silent else []
    if unrest is not None:
        notices.append(unrest.notice)
    return BroadbandRecord(
        aligned=aligned,
        lines=LineFrequencies(
            frequency_hz=ratios.ratio.frequency_hz,
            u_frequency_hz=np.zeros(len(wanted)),
            nominal_hz=wanted,
            multiple=np.ones(len(wanted), np.int64),
            why=(manifest.excitation.kind,) * len(wanted),
            notices=tuple(notices),
        ),
        signals=signals,
        unit=tuple(manifest.rig.unit_of(entry.quantity) for _, entry in selected),
        value=np.insert(ratios.ratio.value, first, 1.0, axis=1) * scale,
        covariance=covariance * scale[..., None] ** 2,
        dof=ratios.ratio.dof,
    )


def _band(manifest: Manifest) -> tuple[float, float]:
    """Return the band of the excitation; refuse files that cannot be evaluated with images."""
    band_hz = manifest.excitation.band
    if band_hz is None or not band_hz[0] > 0.0:
        found = "none" if band_hz is None else f"a band from {band_hz[0]:g} Hz"
        raise _refusal(manifest, "excitation.band", found, "the band of the excitation in Hz, from above 0")
    if any(daq.further_files for daq in manifest.daq):
        raise _refusal(manifest, "daq.repeats", "further files", "one file per block for a recording with images")
    return band_hz


def _wanted(manifest: Manifest, band_hz: tuple[float, float]) -> FloatArray:
    """Return the frequencies of the results; refuse those outside the band."""
    stated = manifest.excitation.frequencies
    wanted: FloatArray = np.geomspace(*band_hz, LINES) if stated is None else np.sort(np.asarray(stated, np.float64))
    outside = wanted[(wanted < band_hz[0] * (1.0 - EXACT)) | (wanted > band_hz[1] * (1.0 + EXACT))]
    if len(outside):
        expected = f"frequencies within the band, {band_hz[0]:g} to {band_hz[1]:g} Hz"
        raise _refusal(manifest, "excitation.frequencies", f"{outside[0]:g} Hz", expected)
    return wanted


def _signals(base: TimeBase, aligned: AlignedChannels, band_hz: tuple[float, float]) -> ReferenceSignals:
    """Return the channels on the first clock, with the band that their samples allow."""
    start_s, rate_hz = aligned.start_s, aligned.rate_hz
    if aligned.base is None:  # as recorded by one block
        block = aligned.channels[0].record.entry.name
        tie = base.ties[block]
        start_s = float(base.to_base_s(block, np.asarray(start_s)))
        rate_hz = rate_hz if tie is None else rate_hz / tie.rate
    quantities = [channel.entry.quantity for channel in aligned.channels]
    order = [TRANSDUCERS[name].order + INERTIAL if name in TRANSDUCERS else INERTIAL for name in quantities]
    highest_hz = min(band_hz[1], aligned.highest_hz or PASS_BAND * rate_hz)
    values = np.stack(aligned.values, axis=1)
    return ReferenceSignals(values, np.array(order, dtype=np.int64), rate_hz, start_s, (band_hz[0], highest_hz))


def _ratios(
    manifest: Manifest, record: TransferRecord, wanted: FloatArray, band_hz: tuple[float, float]
) -> tuple[TransferFunction, FloatArray, str, RestError | None]:
    """Return ratios at frequencies with a signal, those without, and an end without rest.

    With a period: from the means over whole periods, at the nearest lines. Of a chirp between rest and rest: from the
    spectra of the record, interpolated between lines. Otherwise by local polynomials.
    """
    excitation, found, unrest = manifest.excitation, None, None
    resolution_hz = line_spacing_hz(record.sample_rate_hz, len(record.reference))
    try:
        if excitation.period is not None:
            found = transfer_periodic(
                record, excitation.period, settle_periods=excitation.settle_periods, band_hz=band_hz
            )
        elif excitation.kind == "chirp":
            try:
                lowest_hz = max(band_hz[0] - resolution_hz, 0.5 * band_hz[0])
                wider = lowest_hz, band_hz[1] + resolution_hz  # lines on both sides of its ends
                found = _interpolated(transfer_from_rest((record,), band_hz=wider), wanted)
            except RestError as error:
                unrest = error
        if found is None:
            found = transfer_random(record, resolution_hz, estimator="local", band_hz=band_hz, frequency_hz=wanted)
    except ValueError as error:
        raise InputError.from_exception(error, manifest.path, "excitation") from error
    distance_hz = np.abs(np.subtract.outer(wanted, found.ratio.frequency_hz))
    near = distance_hz.argmin(axis=1)
    seen = found.coherence[near].max(axis=1, initial=0.0) >= MIN_COHERENCE
    seen &= distance_hz.min(axis=1) <= found.line_spacing_hz
    silent = ", ".join(f"{f:.6g}" for f in wanted[~seen])
    near, first = np.unique(near[seen], return_index=True)
    return found.at_lines(near), wanted[seen][first], silent, unrest


def _interpolated(found: TransferFunction, wanted: FloatArray) -> TransferFunction:
    """Return ratios at frequencies between lines, of which the nearest one has their uncertainty.

    The coherence is 0 where no line is excited on both sides.
    """
    lines_hz, ratio = found.ratio.frequency_hz, found.ratio
    near = found.at_lines(np.abs(np.subtract.outer(wanted, lines_hz)).argmin(axis=1))
    after = np.searchsorted(lines_hz, wanted)
    gap_hz = np.diff(lines_hz, prepend=-np.inf, append=np.inf)[after]
    near = replace(near, coherence=near.coherence * (gap_hz < MOST_SPACINGS * found.line_spacing_hz)[:, None])
    parts = [
        np.interp(wanted, lines_hz, one.real) + 1j * np.interp(wanted, lines_hz, one.imag) for one in ratio.value.T
    ]
    return replace(near, ratio=replace(near.ratio, frequency_hz=wanted, value=np.stack(parts, axis=1)))


def _refusal(manifest: Manifest, key: str, found: str, expected: str) -> InputError:
    return InputError(BROADBAND_REFUSED, manifest.path, key, found=found, expected=expected)


def line_spacing_hz(rate_hz: float, samples: int) -> float:
    """Return the line spacing of the channels' spectra."""
    return SEGMENTS * rate_hz / samples


def _reference(
    manifest: Manifest, entries: Sequence[ChannelEntry], signals: ReferenceSignals, frequency_hz: FloatArray
) -> int:
    """Return the index of the stated reference, else of the largest motion of one kind."""
    names, stated = [entry.name for entry in entries], manifest.excitation.reference
    if stated and stated[0] not in names:
        raise _refusal(manifest, "excitation.reference", stated[0], f"one of {', '.join(names)}")
    if stated:
        return names.index(stated[0])
    ranks = np.array([LINE_QUANTITIES.index(entry.quantity) for entry in entries])
    best = np.flatnonzero(ranks == ranks.min())
    amplitude = [_amplitude(signals.values[:, one], signals.rate_hz, frequency_hz) for one in best]
    return int(best[np.argmax(np.log(np.maximum(amplitude, np.finfo(np.float64).tiny)).mean(axis=1))])


def _amplitude(samples: FloatArray, rate_hz: float, frequency_hz: FloatArray) -> FloatArray:
    """Return amplitudes (K,) of sines with a channel's power within the line spacing."""
    width_hz = line_spacing_hz(rate_hz, len(samples))
    power = np.abs(np.fft.rfft(samples - samples.mean()) * 2.0 / len(samples)) ** 2
    spectrum_hz = np.fft.rfftfreq(len(samples), 1.0 / rate_hz)
    near = np.searchsorted(spectrum_hz, frequency_hz[:, None] + width_hz * np.array([-0.5, 0.5]))
    return np.sqrt([power[first : max(last, first + 1)].sum() for first, last in near])


def broadband_channels(
    base: TimeBase, record: BroadbandRecord
) -> tuple[tuple[ChannelResult, ...], tuple[ChannelReading, ...]]:
    """Return results and readings of all channels, corrected for delay and response."""
    results, readings = list[ChannelResult](), list[ChannelReading]()
    frequency_hz, middle_s = record.lines.frequency_hz, record.signals.start_s + 0.5 * record.signals.duration_s
    for c, (channel, samples) in enumerate(zip(record.aligned.channels, record.aligned.values, strict=True)):
        entry, block = channel.entry, channel.record.entry.name
        unit = record.unit[c]
        parts = np.array([c, c + record.value.shape[1]])
        covariance = record.covariance[:, parts[:, None], parts]
        raw = Phasors(frequency_hz, record.value[:, c : c + 1], covariance, (entry.name,), (unit,), record.dof)
        correction, response = chain_correction(entry, frequency_hz)
        chain = ChainUncertainty(clock=block)
        if response is not None:
            chain = replace(chain, u_magnitude=response.u_magnitude, u_phase_rad=response.u_phase_rad)
        phasors = raw.scaled(correction[:, None])
        turn = np.asarray(-2j * np.pi * frequency_hz[:, None], dtype=np.complex128)
        late = [
            ChannelRelativeError(
                e.name, e.name, e.u, e.unit, turn * (e.offset_s + e.rate * middle_s), e.scope, "A", e.dof
            )
            for e in base.tie_errors(block)
        ]
        readings.append(ChannelReading(entry, phasors, chain, nonzero_errors(late)))
        shown = slice(0, int(EXCERPT_PERIODS * record.signals.rate_hz / frequency_hz[0]) + 2)
        spectrum = channel_spectrum(samples[:, None], None, record.signals.rate_hz)
        results.append(
            ChannelResult(
                name=entry.name,
                daq=block,
                quantity=entry.quantity,
                body=entry.body or "",
                unit=unit,
                sample_rate_hz=record.signals.rate_hz,
                samples=len(samples),
                phasors=phasors,
                residual_rms=float("nan"),
                excerpt_s=record.signals.start_s + np.arange(len(samples[shown])) / record.signals.rate_hz,
                excerpt=samples[shown].copy(),
                excerpt_fit=np.full(len(samples[shown]), np.nan),
                spectrum_hz=results[0].spectrum_hz if results else spectrum.frequency_hz,
                spectrum=spectrum.amplitude[:, 0],
            )
        )
    return tuple(results), tuple(readings)
