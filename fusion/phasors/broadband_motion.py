"""Motion of frames of a chirp, noise or blows: phasors by the channels as references."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fusion.errors import ComputeError
from fusion.estimation.uncertainty import Kind as ErrorType
from fusion.instruments.channel import FittedError
from fusion.instruments.stereo import StereoReading
from fusion.phasors.broadband import BroadbandRecord
from fusion.phasors.image_effects import THROUGH, rigid_image_effects, with_surface_at_rest
from fusion.phasors.phasor_notices import ROWS_NEED_LINES, TOO_FEW_FRAMES_FOR_BROADBAND
from fusion.phasors.stereo_motion import RejectedPair, StereoMotion
from fusion.phasors.stereo_phasors import StereoPhasors, StereoResult, with_view
from fusion.phasors.timing import Sight, TimeBase, combine_timing_errors
from fusion.recording.transducer import STATIONARY
from photogram.motion import RigidMotion, relative_to
from shaker.frf.sampled_motion import SampledFit, SampledMotion, SampledPhasors, fit_sampled_motion
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.phasor import Phasors, real_stacked
from shakercal._common.arrays import ComplexArray, FloatArray


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
    """Return the phasors of a body about its mean pose, by the channels."""
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
    frequency_hz, dof = record.lines.frequency_hz, np.full(len(record.value), found.dof)
    estimate = found.phasors(frequency_hz, record.value)
    covariance = estimate.covariance + _by_channels(found, record)
    moved = Phasors(frequency_hz, estimate.of(from_mean.pose), covariance, MOTION_COMPONENTS, component_units(0), dof)
    errors = _timing_errors(base, sight, found, estimate)
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


def _by_channels(found: SampledMotion, record: BroadbandRecord) -> FloatArray:
    """Return the covariance (K, 12, 12) of a motion by the channels' noise."""
    gains = real_stacked(found.gains(record.lines.frequency_hz))
    return np.asarray(gains @ record.covariance @ gains.swapaxes(1, 2))


def _timing_errors(
    base: TimeBase, sight: Sight, found: SampledMotion, estimate: SampledPhasors
) -> Iterator[FittedError]:
    """Yield effects of late frames: motion late by L changes by -L times its rate."""
    zero = np.zeros((estimate.covariance.shape[0], 1), np.complex128)
    for error in combine_timing_errors(base.sight_errors(sight)):
        late_s = error.offset_s + error.rate * sight.time_s
        kind: ErrorType = "B" if np.isinf(error.dof) else "A"
        stated = error.name, error.name, error.u, error.unit, zero, error.scope, kind, error.dof
        yield FittedError(*stated, additive=estimate.of(-late_s[:, None] * found.rate))


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
