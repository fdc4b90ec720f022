"""Phasors of the motion with their common errors, and phasors as rows of the linear model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.base import AnyNotice, ComputeError
from fusion.estimation.measurement_model import (
    CALIBRATION,
    PERIODIC,
    ChainUncertainty,
    LineTurns,
    Observation,
    PulseExposure,
    Reading,
    StereoReading,
    observe_channels,
)
from fusion.phasors.channels import spread_lines
from fusion.phasors.results import ChannelResult, StereoResult, deflection_shape
from fusion.phasors.stereo_motion import ImageView, StereoMotion, sensor_from_camera
from fusion.phasors.timing import TimeBase
from fusion.recording.files import read_response
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry, Images, PointFiles
from fusion.recording.rig import Load, Part, Stereo
from fusion.sensitivity.body import Body, make_joint, make_part
from fusion.sensitivity.body import Part as RigidPart
from photogram.camera import StereoRig, principal_components, triangulate
from photogram.geometry import RigidTransform
from photogram.motion import RigidMotion, fit_motion, relative_to
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import StereoTracks
from shaker.arrays import ComplexArray, FloatArray, Notice
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.lines.aliasing import exposure_gain, usable_lines
from shaker.lines.frequencies import Lines
from shaker.sine.fit import fit_sines, stationarity
from shaker.sine.normal_equations import sine_amplitudes
from shaker.sine.phasor import Phasors
from shaker.sine.solve import SineFit

# From the motion of a stereo pair's body to displacement phasors, and what is common to all its frames.


MIN_SUBSETS = 6
PERIODIC_SHARE = 0.4  # standard uncertainty of a line over the amplitude of an error periodic in the pixel
BIAS_STEP_PX = 0.01
NO_LINE = "its camera rate tells no line of the recording apart"


@dataclass(frozen=True)
class StereoPhasors:
    """Displacement phasors of one stereo pair at all lines, exposure loss corrected, and the calibration's effects.

    `pair`: as rig.toml has it, its pose without the calibration's share. `displacement`: six components, m and rad,
    NaN at lines that this camera rate cannot tell apart.
    `effects`: by name, the changes (P, K, 6) of the phasors for one standard uncertainty of what is common to all
    frames: each principal component of the calibration's covariance, errors periodic in the pixel at each line.
    """

    entry: Images | PointFiles
    pair: Stereo
    result: StereoResult
    displacement: Phasors
    effects: Mapping[str, ComplexArray]
    notices: tuple[AnyNotice, ...]


def pairs_phasors(
    motions: Sequence[StereoMotion], lines: Lines
) -> tuple[tuple[StereoPhasors, ...], tuple[AnyNotice, ...]]:
    """Fit the lines to the motion of every stereo pair, and leave out the pairs whose rate tells no line apart.

    The notices name what was left out, line by line and pair by pair.
    """
    kept: list[StereoMotion] = []
    notices: list[AnyNotice] = []
    for measured in motions:
        name = measured.entry.stereo
        usable, folded = _usable(measured, lines)
        notices += [Notice(notice.severity, f"stereo pair {name}: {notice.text}", name) for notice in folded]
        if usable.any():
            kept.append(measured)
        else:
            notices.append(Notice("warning", f"stereo pair {name} is left out: {NO_LINE}", name))
    return tuple(stereo_phasors(measured, lines) for measured in kept), tuple(notices)


def _usable(measured: StereoMotion, lines: Lines) -> tuple[NDArray[np.bool_], tuple[Notice, ...]]:
    """Return which lines (K,) the frames tell apart, and a notice for each that is dropped."""
    order = np.lexsort((lines.frequency_hz, lines.multiple))  # fundamentals have precedence over harmonics
    usable = np.zeros(len(order), dtype=np.bool_)
    usable[order], folded = usable_lines(measured.time_s, lines.frequency_hz[order])
    return usable, folded


def stereo_phasors(measured: StereoMotion, lines: Lines) -> StereoPhasors:
    """Fit those lines to a body's motion about its mean pose that its frames tell apart."""
    name = measured.entry.stereo
    usable, _ = _usable(measured, lines)
    if not usable.any():
        raise ComputeError(f"stereo pair {name}: {NO_LINE}")
    frequency_hz = lines.frequency_hz[usable]
    from_mean, fit = _fit_about_mean(name, measured, frequency_hz)
    gain = exposure_gain(lines.frequency_hz, measured.exposure.length_s)
    displacement = spread_lines(fit.phasors, usable, lines.frequency_hz).scaled((1.0 / gain)[:, None])
    effects = {}
    if measured.view is not None:
        found_effects = {
            CALIBRATION: _calibration_effects(measured, measured.view, frequency_hz),
            PERIODIC: _periodic_effects(measured, measured.view, len(frequency_hz)),
        }
        for what, changes in found_effects.items():
            effects[what] = np.full((len(changes), len(usable), 6), np.nan, dtype=np.complex128)
            effects[what][:, usable] = changes / gain[usable][:, None]
    found = [(f"{name}, {notice.where}", notice) for notice in measured.notices]
    found += [(name, notice) for notice in fit.notices if notice.severity == "warning"]
    notices = tuple(Notice(notice.severity, f"stereo pair {where}: {notice.text}", name) for where, notice in found)
    shape = deflection_shape(measured.time_s, frequency_hz, measured.deformation, measured.exposure.length_s)
    pose = from_mean.pose.copy()
    pose[fit.spikes] = np.nan
    steady = stationarity(measured.time_s, pose, frequency_hz, MOTION_COMPONENTS)
    result = replace(_result(measured, from_mean, fit, usable), deflection=shape, stationarity=steady)
    return StereoPhasors(measured.entry, measured.stereo, result, displacement, effects, notices)


def _fit_about_mean(name: str, measured: StereoMotion, frequency_hz: FloatArray) -> tuple[RigidMotion, SineFit]:
    """Fit the lines twice: the first fit's offset is the mean pose, to which the motion is re-referred."""
    motion = measured.motion
    try:
        for _ in range(2):
            fit = fit_sines(
                measured.time_s, motion.pose, frequency_hz, MOTION_COMPONENTS, component_units(0), robust=True
            )
            motion = relative_to(motion, fit.offset)
        fit = fit_sines(measured.time_s, motion.pose, frequency_hz, MOTION_COMPONENTS, component_units(0), robust=True)
        return motion, fit
    except ValueError as error:
        raise ComputeError(f"stereo pair {name}: the lines cannot be fitted to its motion ({error})") from error


def _periodic_effects(measured: StereoMotion, view: ImageView, lines: int) -> ComplexArray:
    """Return (12·K, K, 6): what errors periodic in the pixel may do to the phasors, each at one line only.

    A mean error B·sin(2πu + φ) of all subsets moving as u(t) = a·cos ωt is at most 2·B·J₁(1.84) = 1.16·B at any
    multiple of ω; over amplitudes and phases that is about 0.4·B, as a standard uncertainty of real and imaginary part
    alike. Since u differs across the image, it counts for x and y of either camera as a shift of all subsets by B and
    as displacements growing to B at the body's rim, along and across: twelve patterns, each on its own, of which the
    motion has six independent combinations.
    """
    tracks = view.tracks
    seen = (tracks.left.status == TrackStatus.OK).any(axis=0) & (tracks.right.status == TrackStatus.OK).any(axis=0)
    motions: list[FloatArray] = []
    places = [np.nanmean(side.position_px[:, seen], axis=0) for side in (tracks.left, tracks.right)]
    for side, bias in enumerate(np.nan_to_num(tracks.bias_px)):
        centred = places[side] - places[side].mean(axis=0)
        patterns = np.column_stack([np.ones(len(centred)), centred / np.abs(centred).max(axis=0)])
        for pattern in patterns.T:
            moved = [np.repeat(place[None], 3, axis=0) for place in places]  # at rest, along x, along y
            moved[side][[1, 2], :, [0, 1]] += BIAS_STEP_PX * pattern
            (both,) = _phasor_motion(view.rig, sensor_from_camera(measured.stereo), (moved[0], moved[1]))
            motions += [PERIODIC_SHARE * bias / BIAS_STEP_PX * part for part in (both.real, both.imag)]
    combined = np.asarray(np.linalg.qr(np.array(motions), mode="r"))
    parts = np.concatenate([combined, 1j * combined])
    return np.asarray(np.einsum("kl,pc->kplc", np.eye(lines), parts).reshape(-1, lines, 6))


def _calibration_effects(measured: StereoMotion, view: ImageView, frequency_hz: FloatArray) -> ComplexArray:
    """Return (P, K, 6): the displacement phasors' change for each principal component of the calibration.

    The path from the tracks onward is evaluated again with each perturbed rig. Phasors are linear in small pixel
    displacements, so instead of all frames only the mean positions of the subsets and their displacement phasors at
    each line are triangulated and fitted: 1 + 2K frames.
    """
    covariance = view.rig.covariance
    if covariance is None:
        return np.empty((0, len(frequency_hz), 6), dtype=np.complex128)
    frames = _phasor_frames(measured.time_s, view.tracks, frequency_hz)
    change, pose = measured.stereo.pose_by_calibration, sensor_from_camera(measured.stereo)
    answer = np.zeros((6, len(covariance))) if change is None else np.array(change)  # the pose was found with this rig
    nominal = _phasor_motion(view.rig, pose, frames)
    changes = []
    for step in principal_components(covariance):
        moved = RigidTransform.from_pose(answer @ step) @ pose
        changes.append(_phasor_motion(view.rig.perturbed(step), moved, frames) - nominal)
    return np.array(changes)


def _phasor_frames(time_s: FloatArray, tracks: StereoTracks, frequency_hz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return left and right positions (1 + 2K, N, 2): mean, mean + Re and mean + Im of each line's displacement."""
    good = (tracks.left.status == TrackStatus.OK).all(axis=0) & (tracks.right.status == TrackStatus.OK).all(axis=0)
    if np.count_nonzero(good) < MIN_SUBSETS:
        raise ComputeError(f"only {np.count_nonzero(good)} subsets are followed through all frames; look at the images")
    both = np.concatenate([tracks.left.position_px[:, good], tracks.right.position_px[:, good]], axis=1)
    flat = both.reshape(len(time_s), -1)
    mean, phasors = sine_amplitudes(time_s, flat, frequency_hz)
    parts = [part for value in phasors for part in (value.real, value.imag)]
    frames = np.stack([mean, *(mean + part for part in parts)]).reshape(-1, 2, flat.shape[1] // 4, 2)
    return frames[:, 0], frames[:, 1]


def _phasor_motion(rig: StereoRig, pose: RigidTransform, frames: tuple[FloatArray, FloatArray]) -> ComplexArray:
    """Return the displacement phasors (K, 6) that a rig, its left camera in this pose, makes of phasor frames."""
    points = triangulate(rig, frames[0], frames[1], None, None).transformed(pose)
    found = fit_motion(points, None, np.zeros(3)).pose[1:]
    return np.asarray(found[0::2] + 1j * found[1::2])


def _sigmas(view: ImageView) -> FloatArray | None:
    """Return predicted and found standard deviation (2,) of a subset's coordinate: median of both cameras."""
    if view.quality is None:
        return None
    predicted = [side.predicted_sigma_px for side in view.quality]
    variance = [np.diagonal(side.covariance_px2, axis1=2, axis2=3) for side in (view.tracks.left, view.tracks.right)]
    return np.array([np.nanmedian(predicted), np.sqrt(np.nanmedian(variance))])


def _result(measured: StereoMotion, from_mean: RigidMotion, fit: SineFit, usable: NDArray[np.bool_]) -> StereoResult:
    """Collect what the result files and the report show of a stereo pair."""
    view = measured.view
    return StereoResult(
        name=measured.entry.stereo,
        body=measured.stereo.body,
        time_s=measured.time_s,
        exposure_s=measured.exposure.length_s,
        u_exposure_s=measured.exposure.u_length_s,
        motion=measured.motion,
        motion_from_mean=from_mean,
        fit=fit,
        usable=usable,
        reprojection_px=measured.reprojection_px,
        reference_image=None if view is None else view.reference_image,
        subsets_px=None if view is None else view.tracks.left.position_px[0],
        speckle_px=None if view is None else float(np.min(view.tracks.speckle_px)),
        noise_grey=None if view is None else float(np.mean(view.tracks.noise_grey)),
        sigma_px=None if view is None else _sigmas(view),
        noise=() if view is None or view.noise is None else view.noise,
        median_zncc=None if view is None else float(np.nanmedian(view.tracks.left.zncc)),
        epipolar=None if view is None else replace(view.epipolar, notices=()),
    )


# From evaluated channels and the rig's entries to what the fusion takes: readings, observations, the body.


def channel_readings(base: TimeBase, channels: Sequence[ChannelResult]) -> tuple[Reading, ...]:
    """Return every channel with its manifest entry and the uncertainty of its chain and clock."""
    entries = {(r.entry.name, c.name): c for r in base.records for c in r.entry.channel}
    return tuple(_reading(base, channel, entries[channel.daq, channel.name]) for channel in channels)


def _reading(base: TimeBase, channel: ChannelResult, entry: ChannelEntry) -> Reading:
    """Return one channel with the uncertainty of its response table and of its clock's tie to the first one."""
    tie = base.ties[channel.daq]
    u_clock_s = 0.0 if tie is None else float(tie.u_to_base_s(np.asarray(channel.samples / channel.sample_rate_hz / 2)))
    if entry.response is None:
        return Reading(entry, channel.phasors, ChainUncertainty(clock=channel.daq, u_clock_s=u_clock_s))
    response = read_response(entry.response, channel.phasors.frequency_hz)
    chain = ChainUncertainty(response.u_magnitude, response.u_phase_rad, channel.daq, u_clock_s)
    return Reading(entry, channel.phasors, chain)


def stereo_readings(
    manifest: Manifest, base: TimeBase, readings: Sequence[Reading], stereo: Sequence[StereoPhasors], lines: Lines
) -> tuple[StereoReading, ...]:
    """Return every stereo pair with its phasors and all that is known of their errors.

    Without any reading of a channel the lines were found in the motion itself, and what it leaves open of their
    frequencies turns the phasors by as much as its noise does; a channel knows them far better than that.
    """
    clock = manifest.daq[0].clock_uncertainty if manifest.daq else 0.0
    seen = []
    for item in stereo:
        pair = item.pair.model_copy(update={"delay_uncertainty": item.entry.delay_uncertainty})
        trigger = (item.entry.trigger, base.u_trigger_s(item.entry.trigger))
        middle_s = float(np.mean(item.result.time_s))
        turns = None if readings else LineTurns(lines.nominal_hz, lines.u_frequency_hz, middle_s)
        pulse = PulseExposure(item.entry.trigger, item.result.exposure_s, item.result.u_exposure_s)
        reading = StereoReading(item.result.name, pair, item.displacement, item.effects, clock, trigger, turns, pulse)
        seen.append(reading)
    return tuple(seen)


def observations(
    manifest: Manifest, base: TimeBase, readings: Sequence[Reading], stereo: Sequence[StereoPhasors], lines: Lines
) -> tuple[Observation, ...]:
    """Return every instrument of what was recorded at once as rows of the linear model."""
    return all_rows(manifest, readings, stereo_readings(manifest, base, readings, stereo, lines))


def all_rows(
    manifest: Manifest, readings: Sequence[Reading], pairs: Sequence[StereoReading]
) -> tuple[Observation, ...]:
    """Return channels and stereo pairs as rows of the linear model, the first block's clock being their time base."""
    first = manifest.daq or manifest.take[0].daq
    channels = observe_channels(readings, gravity(manifest), first[0].clock_uncertainty)
    return (*(pair.observed() for pair in pairs), *channels)


def unseen_fundamentals(
    seen: Sequence[Observation], lines: Lines, folded: Sequence[AnyNotice]
) -> tuple[AnyNotice, ...]:
    """Return a notice for each driven line at which no instrument sees a motion, and refuse a recording without any.

    `folded`: what was said of the lines that camera rates cannot tell apart.
    """
    driven = lines.frequency_hz[lines.multiple == 1]
    lost = [f for f in driven if not any(_sees(observation, float(f)) for observation in seen)]
    if len(driven) and len(lost) == len(driven) and (seen or folded):
        listed = " and ".join(f"{f:.6g} Hz" for f in lost)
        reasons = dict.fromkeys(notice.text for notice in folded if any(f"{f:.6g} Hz" in notice.text for f in lost))
        why = f" ({'; '.join(reasons)})" if reasons else ""
        raise ComputeError(f"no instrument sees the motion of the driven line at {listed}{why}")
    return tuple(
        Notice("warning", f"no instrument sees the motion at {f:.6g} Hz, a driven line", f"{f:.6g} Hz") for f in lost
    )


def _sees(observation: Observation, frequency_hz: float) -> bool:
    """Tell whether an instrument has a reading at a line."""
    line = observation.phasors.frequency_hz == frequency_hz
    return bool(np.isfinite(observation.phasors.value[line]).any())


def gravity(manifest: Manifest) -> tuple[float, float, float] | None:
    """Return the acceleration of gravity (m/s^2, sensor frame), None where the rig does not state it."""
    environment = manifest.rig.environment
    return None if environment is None else environment.gravity


def load_body(manifest: Manifest) -> Body | None:
    """Return all that moves above the elastic element: load, parts and internal mass; None without a `[load]`.

    The sensor's own mass lies below the load's joint, where there is one.
    """
    load, sensor, environment = manifest.rig.load, manifest.rig.sensor, manifest.rig.environment
    if load is None:
        return None
    air = 0.0 if environment is None else environment.air_density or 0.0
    parts = [_part("load", load, air)]
    parts += [_part(part.name, part, air, part.below_joint) for part in manifest.part if part.body == "load"]
    if sensor is not None and sensor.internal_mass > 0.0:
        u = (
            sensor.internal_mass_uncertainty,
            sensor.internal_centre_of_mass_uncertainty,
            sensor.internal_inertia_uncertainty,
        )
        centre, inertia = sensor.internal_centre_of_mass, sensor.internal_inertia
        parts.append(make_part("internal mass", sensor.internal_mass, centre, inertia, u, below_joint=True))
    if load.elastic_frequency is None:
        return Body(tuple(parts))
    joint = make_joint(load.elastic_frequency, load.elastic_frequency_uncertainty, load.elastic_damping)
    return Body(tuple(parts), joint)


def _part(name: str, entry: Load | Part, air_density: float, below_joint: bool = False) -> RigidPart:
    """Return one table of the rig as a rigid part with its true mass, in air of a density in kg/m^3 (0: not stated)."""
    u = (entry.mass_uncertainty, entry.centre_of_mass_uncertainty, entry.inertia_uncertainty)
    share = 0.0 if entry.density is None else air_density / entry.density
    return make_part(name, entry.true_mass, entry.centre_of_mass, entry.inertia, u, share, below_joint)
