"""Phasors of chirps, noise and blows: channels over a reference, and the motion of the frames by the channels."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import ComputeError, InputError
from fusion.instruments.channel import (
    ChainUncertainty,
    ChannelReading,
    ChannelRelativeError,
    FittedError,
    nonzero_errors,
)
from fusion.instruments.stereo import StereoReading
from fusion.phasors.aligned_channels import AlignedChannels, align
from fusion.phasors.channel_phasors import (
    EXCERPT_PERIODS,
    LINE_QUANTITIES,
    ChannelResult,
    chain_correction,
    channel_spectrum,
)
from fusion.phasors.image_effects import THROUGH, rigid_image_effects, with_surface_at_rest
from fusion.phasors.phasor_notices import (
    BROADBAND_REFUSED,
    LINES_WITHOUT_SIGNAL,
    ROWS_NEED_LINES,
    TOO_FEW_FRAMES_FOR_BROADBAND,
)
from fusion.phasors.stereo_motion import RejectedPair, StereoMotion
from fusion.phasors.stereo_phasors import StereoPhasors, StereoResult, with_view
from fusion.phasors.timing import TimeBase, combine_timing_errors
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.transducer import HEAD, STATIONARY, TRANSDUCERS
from photogram.motion import RigidMotion, relative_to
from shaker.frf.periodic import transfer_periodic
from shaker.frf.random import transfer_random
from shaker.frf.result import TransferFunction, TransferRecord
from shaker.frf.sampled_motion import ReferenceSignals, SampledMotion, fit_sampled_motion
from shaker.frf.sweeps import transfer_from_rest
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.phasor import Phasors, real_stacked
from shaker.sine.solve import SineFit
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

LINES, SEGMENTS = 20, 16
"""Lines in equal ratios where none are stated; the line spacing of the channels' spectra is so many times 1/length."""
MIN_COHERENCE = 0.9
"""Coherence with the reference that a channel must reach, else a line has no signal (chosen)."""
EXACT = 1e-6
"""Relative standard uncertainty of the reference's phasors by its noise, at least: the ratios contain it (chosen)."""
INERTIAL = 2
"""Time derivatives from a displacement to forces and outputs."""


@dataclass(frozen=True)
class BroadbandRecord:
    """Channels of a chirp, noise or blows on the first clock, and their phasors at `lines`, as recorded.

    `aligned`, `value` (K, C), `covariance` (K, C, 2, 2), `dof` (K,): of all channels, the reference included. The
    reference has a real phasor, its amplitude within the line spacing. `order`, `unit` (C,): derivatives from a displacement.
    """

    aligned: AlignedChannels
    lines: LineFrequencies
    band_hz: tuple[float, float]
    start_s: float
    rate_hz: float
    order: tuple[int, ...]
    unit: tuple[str, ...]
    value: ComplexArray
    covariance: FloatArray
    dof: FloatArray

    @property
    def signals(self) -> ReferenceSignals:
        """The channels as references of a sampled motion."""
        values, order = np.stack(self.aligned.values, axis=1), np.array(self.order, dtype=np.int64)
        return ReferenceSignals(values, order, self.rate_hz, self.start_s, self.band_hz)


def read_broadband(manifest: Manifest, base: TimeBase) -> BroadbandRecord:
    """Return the channels' phasors relative to a reference.

    At the stated frequencies, or at 20 in equal ratios.
    """
    excitation = manifest.excitation
    if excitation.band is None or not excitation.band[0] > 0.0:
        found = "none" if excitation.band is None else f"a band from {excitation.band[0]:g} Hz"
        raise _refusal(manifest, "excitation.band", found, "the band of the excitation in Hz, from above 0")
    if any(daq.further_files for daq in manifest.daq):
        raise _refusal(manifest, "daq.repeats", "further files", "one file per block for a recording with cameras")
    selected = [
        (record.entry.name, entry)
        for record in base.records
        for entry in record.entry.channel
        if entry.quantity != "trigger" and entry.body not in (STATIONARY, HEAD)
    ]
    if not selected:
        raise _refusal(manifest, "daq.channel", "triggers only", "a channel that measures the excitation or the motion")
    aligned = align(manifest, base.records, selected, "daq.channel")
    start_s, rate_hz = aligned.start_s, aligned.rate_hz
    if aligned.base is None:
        block = selected[0][0]
        tie = base.ties[block]
        start_s = float(base.to_base_s(block, np.asarray(start_s)))
        rate_hz = rate_hz if tie is None else rate_hz / tie.rate
    band_hz = excitation.band[0], min(excitation.band[1], aligned.highest_hz or 0.4 * rate_hz)
    wanted = np.geomspace(*band_hz, LINES) if excitation.frequencies is None else np.sort(excitation.frequencies)
    outside = wanted[(wanted < band_hz[0] * (1.0 - 1e-9)) | (wanted > band_hz[1] * (1.0 + 1e-9))]
    if len(outside):
        expected = f"frequencies within the band, {band_hz[0]:g} to {band_hz[1]:g} Hz"
        raise _refusal(manifest, "excitation.frequencies", f"{outside[0]:g} Hz", expected)
    reference = _reference(excitation.reference, [entry for _, entry in selected])
    names = [entry.name for _, entry in selected]
    record = TransferRecord(
        reference=aligned.values[reference],
        responses=np.stack([*np.delete(np.stack(aligned.values), reference, axis=0)], axis=1),
        sample_rate_hz=rate_hz,
        reference_name=names[reference],
        reference_unit="",
        channels=tuple(np.delete(names, reference).tolist()),
        unit=("",) * (len(names) - 1),
    )
    resolution_hz = SEGMENTS * rate_hz / len(record.reference)
    kept, wanted, silent = _ratios(manifest, record, wanted, band_hz)
    if not len(wanted):
        expected = f"lines at which a channel follows {names[reference]} (coherence of at least {MIN_COHERENCE:g})"
        raise _refusal(manifest, "excitation.band", f"noise at {silent} Hz", expected)
    notices = (Notice(LINES_WITHOUT_SIGNAL, "excitation.band", frequencies=silent),) if silent else ()
    frequency_hz = kept.ratio.frequency_hz
    amplitude = _amplitude(record, frequency_hz, resolution_hz)
    covariance = np.stack([kept.channel_covariance(name) for name in record.channels], axis=1)
    covariance = np.insert(covariance, reference, EXACT**2 * np.eye(2), axis=1)
    value = np.insert(kept.ratio.value, reference, 1.0, axis=1)
    count = len(wanted)
    lines = LineFrequencies(
        frequency_hz, np.zeros(count), wanted, np.ones(count, np.int64), (excitation.kind,) * count, notices
    )
    order = tuple(
        TRANSDUCERS[entry.quantity].order + INERTIAL if entry.quantity in TRANSDUCERS else INERTIAL
        for _, entry in selected
    )
    scale = amplitude[:, None]
    return BroadbandRecord(
        aligned, lines, band_hz, start_s, rate_hz, order, tuple(manifest.rig.unit_of(entry.quantity) for _, entry in selected),
        value * scale, covariance * scale[..., None, None] ** 2, kept.ratio.dof,
    )  # fmt: skip


def _ratios(
    manifest: Manifest, record: TransferRecord, wanted: FloatArray, band_hz: tuple[float, float]
) -> tuple[TransferFunction, FloatArray, str]:
    """Return the ratios near frequencies with a signal, these frequencies, and a list of those without.

    With a period: from the means over whole periods. Of a chirp between rest and rest: from the spectra of the record.
    Otherwise by local polynomials, at the frequencies themselves.
    """
    excitation, found = manifest.excitation, None
    try:
        if excitation.period is not None:
            found = transfer_periodic(
                record, excitation.period, settle_periods=excitation.settle_periods, band_hz=band_hz
            )
        elif excitation.kind == "chirp":
            with suppress(ValueError):
                found = transfer_from_rest((record,), band_hz=band_hz)
        if found is None:
            resolution_hz = SEGMENTS * record.sample_rate_hz / len(record.reference)
            found = transfer_random(record, resolution_hz, estimator="local", band_hz=band_hz, frequency_hz=wanted)
    except ValueError as error:
        raise InputError.from_exception(error, manifest.path, "excitation") from error
    near = np.abs(np.subtract.outer(wanted, found.ratio.frequency_hz)).argmin(axis=1)
    near, first = np.unique(near, return_index=True)
    near_lines, wanted = found.at_lines(near), wanted[first]
    seen = near_lines.coherence.max(axis=1, initial=0.0) >= MIN_COHERENCE
    return near_lines.at_lines(seen), wanted[seen], ", ".join(f"{f:.6g}" for f in wanted[~seen])


def _refusal(manifest: Manifest, key: str, found: str, expected: str) -> InputError:
    return InputError(BROADBAND_REFUSED, manifest.path, key, found=found, expected=expected)


def _reference(stated: Sequence[str], entries: Sequence[ChannelEntry]) -> int:
    """Return the index of the first stated reference, else of a channel that shows high frequencies best."""
    if stated:
        return next(index for index, entry in enumerate(entries) if entry.name == stated[0])
    ranks = [LINE_QUANTITIES.index(entry.quantity) for entry in entries]
    return int(np.argmin(ranks))


def _amplitude(record: TransferRecord, frequency_hz: FloatArray, width_hz: float) -> FloatArray:
    """Return the amplitude (K,) of a sine with the reference's power within `width_hz` of lines."""
    power = np.abs(np.fft.rfft(record.reference - record.reference.mean()) * 2.0 / len(record.reference)) ** 2
    spectrum_hz = np.fft.rfftfreq(len(record.reference), 1.0 / record.sample_rate_hz)
    near = np.searchsorted(spectrum_hz, frequency_hz[:, None] + width_hz * np.array([-0.5, 0.5]))
    return np.sqrt([power[first : max(last, first + 1)].sum() for first, last in near])


def broadband_channels(base: TimeBase, record: BroadbandRecord) -> tuple[list[ChannelResult], list[ChannelReading]]:
    """Return results and readings of all channels, corrected for delay and response."""
    results, readings = list[ChannelResult](), list[ChannelReading]()
    frequency_hz, middle_s = record.lines.frequency_hz, record.start_s + 0.5 * record.signals.duration_s
    for c, (channel, samples) in enumerate(zip(record.aligned.channels, record.aligned.values, strict=True)):
        entry, block = channel.entry, channel.record.entry.name
        unit = record.unit[c]
        raw = Phasors(
            frequency_hz, record.value[:, c : c + 1], record.covariance[:, c], (entry.name,), (unit,), record.dof
        )
        correction, response = chain_correction(entry, frequency_hz)
        chain = ChainUncertainty(clock=block)
        if response is not None:
            chain = replace(chain, u_magnitude=response.u_magnitude, u_phase_rad=response.u_phase_rad)
        phasors = raw.scaled(correction[:, None])
        late = [
            ChannelRelativeError(
                error.name, error.name, error.u, error.unit,
                -2j * np.pi * frequency_hz[:, None] * (error.offset_s + error.rate * middle_s),
                error.scope, "A", error.dof,
            )
            for error in base.tie_errors(block)
        ]  # fmt: skip
        readings.append(ChannelReading(entry, phasors, chain, nonzero_errors(late)))
        shown = slice(0, int(EXCERPT_PERIODS * record.rate_hz / frequency_hz[0]) + 2)
        spectrum = channel_spectrum(samples[:, None], None, record.rate_hz)
        results.append(
            ChannelResult(
                name=entry.name,
                daq=block,
                quantity=entry.quantity,
                body=entry.body or "",
                unit=unit,
                sample_rate_hz=record.rate_hz,
                samples=len(samples),
                phasors=phasors,
                residual_rms=float("nan"),
                excerpt_s=record.start_s + np.arange(len(samples[shown])) / record.rate_hz,
                excerpt=samples[shown].copy(),
                excerpt_fit=np.full(len(samples[shown]), np.nan),
                spectrum_hz=results[0].spectrum_hz if results else spectrum.frequency_hz,
                spectrum=spectrum.amplitude[:, 0],
            )
        )
    return results, readings


@dataclass(frozen=True, eq=False, repr=False)
class SampledFit(SineFit):
    """Motion of the frames by the channels, with its phasors at the lines, in the form of a sine approximation.

    `remaining` (F, C): residuals of the frames, NaN where not used.
    """

    remaining: FloatArray

    def residual_of(self, time_s: FloatArray, values: FloatArray) -> FloatArray:
        """Return the residuals (F, C) of the frames."""
        return self.remaining


def broadband_pairs(
    base: TimeBase, record: BroadbandRecord, motions: Sequence[StereoMotion]
) -> tuple[tuple[StereoPhasors, ...], tuple[RejectedPair, ...]]:
    """Return the phasors of every pair, and the pairs that have none."""
    fitted, rejected = list[StereoPhasors](), list[RejectedPair]()
    for measured in motions:
        try:
            fitted.append(broadband_phasors(base, record, measured))
        except ComputeError as error:
            rejected.append(RejectedPair(measured.sight.name, error))
    return tuple(fitted), tuple(rejected)


def broadband_phasors(base: TimeBase, record: BroadbandRecord, measured: StereoMotion) -> StereoPhasors:
    """Return the phasors of a body about its mean pose, by the channels as references of its motion."""
    sight, name = measured.sight, measured.sight.name
    if any(sight.pair.row_time):
        raise ComputeError(ROWS_NEED_LINES, f"stereo pair {name}")
    rest = np.nanmean(measured.motion.pose, axis=0)
    measured = with_surface_at_rest(measured, rest)
    from_mean = relative_to(measured.motion, rest)
    try:
        found = fit_sampled_motion(record.signals, sight.time_s, from_mean.pose, sight.exposure.length_s)
    except ValueError as error:
        found_frames = str(error).partition(": ")[2]
        raise ComputeError(TOO_FEW_FRAMES_FOR_BROADBAND, f"stereo pair {name}", reason=found_frames) from error
    frequency_hz = record.lines.frequency_hz
    estimate = found.phasors(frequency_hz, record.value)
    gains = real_stacked(found.gains(frequency_hz))
    noise = np.zeros((len(frequency_hz), 2, record.value.shape[1], 2, record.value.shape[1]))
    each = np.arange(record.value.shape[1])
    noise[:, :, each, :, each] = np.moveaxis(record.covariance, 1, 0)
    noise = noise.reshape(len(frequency_hz), 2 * len(each), -1)
    covariance = estimate.covariance + gains @ noise @ gains.swapaxes(1, 2)
    dof = np.full(len(frequency_hz), found.dof)
    moved = Phasors(frequency_hz, estimate.of(from_mean.pose), covariance, MOTION_COMPONENTS, component_units(0), dof)
    nothing = np.zeros((len(frequency_hz), 1), np.complex128)
    errors = [
        FittedError(
            error.name, error.name, error.u, error.unit, nothing, error.scope,
            "B" if np.isinf(error.dof) else "A", error.dof,
            additive=estimate.of(-(error.offset_s + error.rate * sight.time_s)[:, None] * found.rate),
        )
        for error in combine_timing_errors(base.sight_errors(sight))
    ]  # fmt: skip
    view, effects = measured.view, dict[str, ComplexArray]()
    if view is not None and sight.pair.body != STATIONARY:
        effects = rigid_image_effects(measured, view, moved.value, estimate.of)
    reading = StereoReading(
        name=name,
        pair=sight.pair,
        phasors=moved,
        effects=effects,
        clock_uncertainty=base.records[0].entry.clock_uncertainty,
        errors=(*errors, *sight.exposure.errors(frequency_hz)),
        face_m=np.asarray(np.nanmean(next(iter(measured.deformation)).reference_m, axis=0)),
        through_surface=effects.pop(THROUGH, None),
    )
    result = _result(base, measured, (moved, found, from_mean, rest))
    notices = tuple(notice.at(f"stereo pair {name}, {notice.where}") for notice in measured.notices)
    return StereoPhasors(result, reading, notices)


def _result(
    base: TimeBase, measured: StereoMotion, fitted: tuple[Phasors, SampledMotion, RigidMotion, FloatArray]
) -> StereoResult:
    """Return the motion of a pair with its phasors."""
    (moved, found, from_mean, rest), sight = fitted, measured.sight
    lines, none = len(moved.frequency_hz), np.zeros(6)
    fit = SampledFit(
        phasors=moved,
        offset=rest,
        offset_covariance=np.zeros((6, 6)),
        drift_per_s=none,
        middle_s=float(sight.time_s.mean()),
        u_frequency_hz=np.zeros(lines),
        decay_per_s=np.zeros(lines),
        u_decay_per_s=np.zeros(lines),
        slopes=np.zeros((1, 2 * lines, 2 * lines)),
        residual_rms=np.sqrt(np.nanmean(found.residual**2, axis=0)),
        spikes=np.flatnonzero(np.isfinite(from_mean.pose).all(axis=1) & ~found.used),
        condition=1.0,
        notices=(),
        remaining=found.residual,
    )
    result = StereoResult(
        name=sight.name,
        body=sight.pair.body,
        time_s=sight.time_s,
        exposure_s=sight.exposure.length_s,
        u_exposure_s=sight.exposure.u_length_s,
        u_rate=float(np.linalg.norm([error.rate for error in base.sight_errors(sight)])),
        motion=measured.motion,
        motion_from_mean=from_mean,
        fit=fit,
        phasors=moved,
        usable=np.ones(lines, dtype=np.bool_),
        reprojection_px=measured.reprojection_px,
        surface=measured.deformation,
    )
    return result if measured.view is None else with_view(result, measured.view)
