"""Errors common to all frames of a pair: calibration, surface, pixel grid, fixed pattern."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.errors import ComputeError, InputError
from fusion.instruments.stereo import CALIBRATION, PATTERN, PERIODIC, SURFACE
from fusion.phasors.pattern_effects import PatternReading
from fusion.phasors.phasor_notices import (
    CALIBRATION_REFUSED,
    NO_RIGID_MOTION,
    UNEQUAL_FRAMES,
)
from fusion.phasors.stereo_motion import ImageView, StereoMotion, sensor_from_camera
from photogram.camera import (
    CAMERA_PARAMETERS,
    FaceCamera,
    Rig,
    locate,
    principal_components,
)
from photogram.direct.surface import PlacedCamera, Shapes, project_body_points
from photogram.frame_statistics import RunningMean, spread_choice
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.measure.body import TrackedSubsets
from photogram.motion import RigidMotion, relative_to
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.normal_equations import SineSums
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineFit, SineModel
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

MIN_SUBSETS, SEEN_SHARE, EFFECT_SUBSETS = 6, 0.5, 200
PERIODIC_SHARE = 0.4  # standard uncertainty of a line over the amplitude of an error periodic in the pixel
BIAS_STEP_PX = 0.01
MIN_VARIANCE_RATIO = 2.0  # variance ratio of frames: weights for smaller ones gain less than 6 %
THROUGH = "pose through the surface"


def image_effects(
    measured: StereoMotion,
    view: ImageView,
    frequency_hz: FloatArray,
    usable: NDArray[np.bool_],
    gain: FloatArray,
) -> tuple[dict[str, ComplexArray], ComplexArray]:
    """Return effects of calibration, pixel grid and fixed pattern on phasors and shapes.

    On phasors NaN at lines not `usable`; on amplitudes of shapes at the usable ones. For a single camera also the
    effects of the stated surface, and of the pose through it (THROUGH).
    """
    sums, means = None, tuple(RunningMean() for _ in view.rig.camera_poses)
    for block in view.tracks:
        both_positions = [camera.position_px for camera in block.cameras]
        both = np.concatenate(both_positions, axis=2)
        if sums is None:
            sums, bias_px = SineSums(measured.points_time_s, frequency_hz, np.nan_to_num(both[0])), block.bias_px
        sums.add(both)
        for running, position in zip(means, both_positions, strict=True):
            running.add(position)
    assert sums is not None
    mean_positions = [running.mean for running in means]
    frames = list[FloatArray]()
    if view.rig.covariance is not None:
        frames = _phasor_frames(sums, len(measured.points_time_s), measured.sight.name)
    of_calibration = _calibration_effects(measured, view, frames, len(frequency_hz))
    periodic, periodic_of_shapes = _periodic_effects(measured, view, mean_positions, bias_px, len(frequency_hz))
    changes = {CALIBRATION: of_calibration[..., :6], PERIODIC: periodic}
    reading = pattern_reading(measured, view)
    if reading is not None:
        changes[PATTERN] = reading.effects(frequency_hz)
    if isinstance(view.rig, FaceCamera):
        changes |= surface_effects(measured, view.rig, frames, view.deformed.shapes)
    effects, loss = {}, gain[usable][:, None]
    for what, change in changes.items():
        effects[what] = np.full((len(change), len(usable), 6), np.nan, dtype=np.complex128)
        effects[what][:, usable] = change / loss
    return effects, np.asarray(np.concatenate([of_calibration[..., 6:], periodic_of_shapes]) / loss)


def rigid_image_effects(
    measured: StereoMotion, view: ImageView, moved: ComplexArray, phasors_of: Callable[[FloatArray], ComplexArray]
) -> dict[str, ComplexArray]:
    """Return effects (P, K, 6) of calibration, surface, grid and pattern on phasors (K, 6).

    Of a motion at more frequencies than its frames resolve: the displacements of the subsets are those of the rigid
    body. Of an error periodic in the pixel, only the part in proportion to the motion is common to all frames:
    B·sin(2πu) of a normally distributed motion u has the slope 2πB·exp(-2π²σ²) (describing function), with the phase of
    a random position. `phasors_of`: phasors (K, 6) of a series (F, 6) by the same estimate.
    """
    means = tuple(RunningMean() for _ in view.rig.camera_poses)
    bias_px = np.zeros(len(means))
    for block in view.tracks:
        bias_px = block.bias_px
        for running, tracked in zip(means, block.cameras, strict=True):
            running.add(tracked.position_px)
    positions = [running.mean for running in means]
    good = np.flatnonzero(np.isfinite(np.concatenate(positions, axis=1)).all(axis=1))
    good = good[spread_choice(np.arange(len(good)), min(1.0, EFFECT_SUBSETS / max(len(good), 1)))]
    pose = sensor_from_camera(measured.sight.pair)
    points = locate(view.rig, [position[None, good] for position in positions]).transformed(pose).position_m[0]
    frames, motion_px, size_px = list[FloatArray](), np.zeros(len(moved)), list[float]()
    scatter = np.cov(measured.motion.pose[np.isfinite(measured.motion.pose).all(axis=1)].T)
    for position, (camera, from_left) in zip(positions, view.rig.camera_poses, strict=True):
        rates = project_body_points(PlacedCamera(camera, from_left @ pose.inverse()), points).rates
        parts = [rates @ part for value in moved for part in (value.real, value.imag)]
        frames.append(np.stack([position[good], *(position[good] + part for part in parts)]))
        motion_px += np.sqrt(np.nanmean(np.abs(np.einsum("nic,kc->kni", rates, moved)) ** 2, axis=(1, 2)))
        size_px.append(float(np.nanmean(np.einsum("nic,cd,nid->ni", rates, scatter, rates))))
    lines = len(moved)
    effects = dict[str, ComplexArray]()
    if view.rig.covariance is not None:
        effects[CALIBRATION] = _calibration_effects(measured, view, frames, lines)[..., :6]
    periodic, _ = _periodic_effects(measured, view, positions, bias_px, lines)
    slope = np.sqrt(2.0) * np.pi * np.exp(-2.0 * np.pi**2 * float(np.mean(size_px)))
    effects[PERIODIC] = periodic * (slope * motion_px / len(means) / PERIODIC_SHARE)[:, None]
    if view.pattern is not None:
        effects[PATTERN] = np.array([phasors_of(step) for step in np.moveaxis(view.pattern.change, 1, 0)])
    if isinstance(view.rig, FaceCamera):
        effects |= surface_effects(measured, view.rig, frames, view.deformed.shapes)
    return {what: change for what, change in effects.items() if len(change)}


def pattern_reading(measured: StereoMotion, view: ImageView) -> PatternReading | None:
    """Return the motion with its fixed pattern, None without a grey-value fit."""
    if view.pattern is None or not isinstance(view.tracks, TrackedSubsets):
        return None
    amplitude = view.deformed.amplitude
    return PatternReading(measured.sight.time_s, measured.motion.pose, amplitude, view.pattern, view.tracks)


def _periodic_effects(
    measured: StereoMotion, view: ImageView, means: Sequence[FloatArray], bias_px: FloatArray, lines: int
) -> tuple[ComplexArray, ComplexArray]:
    """Return the effects (12·K, K, 6) of errors periodic in the pixel.

    On phasors, each at one line. A mean error B·sin(2πu + φ) of all subsets moving as u(t) = a·cos ωt is at most
    2·B·J₁(1.84) = 1.16·B at any multiple of ω; over amplitudes and phases about 0.4·B, as a standard uncertainty of
    real and imaginary part. Because u differs across the image, it acts on x and y of either camera as a shift of all
    subsets by B and as displacements growing to B at the body's rim, along and across. These are twelve separate
    patterns, of which the motion has six independent combinations. A single camera measures tilts by patterns of second
    order, which are then included. `means` (N, 2): positions of the subsets in each camera.

    Also return their effects (2S·K, K, S) on amplitudes of shapes, with displacements of second order over the image.
    """
    seen = np.isfinite(np.concatenate(means, axis=1)).all(axis=1)
    motions: list[FloatArray] = []
    positions = [mean[seen] for mean in means]
    for side, bias in enumerate(np.nan_to_num(bias_px)):
        centred = positions[side] - positions[side].mean(axis=0)
        x, y = (centred / np.abs(centred).max(axis=0)).T
        for pattern in (np.ones(len(x)), x, y, x * x, x * y, y * y):
            moved = [np.repeat(position[None], 3, axis=0) for position in positions]  # at rest, along x, along y
            moved[side][[1, 2], :, [0, 1]] += BIAS_STEP_PX * pattern
            pose, shapes = sensor_from_camera(measured.sight.pair), view.deformed.shapes
            (both,) = phasor_motion(view.rig, pose, moved, shapes)
            motions += [PERIODIC_SHARE * bias / BIAS_STEP_PX * part for part in (both.real, both.imag)]
    of_order = np.arange(len(motions)) // 2 % 6 // 3  # 0 for patterns up to first order
    effects = []
    for rows in (np.array(motions)[of_order <= (len(means) == 1), :6], np.array(motions)[:, 6:]):
        combined = np.asarray(np.linalg.qr(rows, mode="r"))
        parts = np.concatenate([combined, 1j * combined])
        each_line = np.einsum("kl,pc->kplc", np.eye(lines), parts)
        effects.append(np.asarray(each_line.reshape(-1, lines, combined.shape[1])))
    return effects[0], effects[1]


def _calibration_effects(
    measured: StereoMotion, view: ImageView, frames: Sequence[FloatArray], lines: int
) -> ComplexArray:
    """Return the changes (P, K, 6 + S) by each principal component of the calibration.

    Of phasors and amplitudes of shapes. The path from the tracks onward is evaluated again with each perturbed rig.
    Phasors are linear in small pixel displacements. Only the mean positions of the subsets and their displacement
    phasors at each line are therefore triangulated and fitted: 1 + 2K `frames`. For a single camera without the
    uncertainty of its surface.
    """
    covariance, shapes = view.rig.covariance, view.deformed.shapes
    if covariance is None:
        return np.empty((0, lines, 6 + len(shapes.names)), dtype=np.complex128)
    if isinstance(view.rig, FaceCamera):
        covariance = np.where(np.arange(len(covariance)) < len(CAMERA_PARAMETERS), covariance, 0.0)
    change, pose = measured.sight.pair.pose_by_calibration, sensor_from_camera(measured.sight.pair)
    answer = np.zeros((6, len(covariance))) if change is None else np.array(change)  # the pose was found with this rig
    nominal = phasor_motion(view.rig, pose, frames, shapes)
    changes = []
    for step in principal_components(covariance):
        moved = RigidTransform.from_pose(answer @ step) @ pose
        try:
            changes.append(phasor_motion(view.rig.perturbed(step), moved, frames, shapes) - nominal)
        except ValueError as error:
            file = measured.sight.pair.calibration or measured.sight.where[0]
            found = "rays that do not meet in front of the cameras if it is wrong by its standard uncertainty"
            expected = "focal lengths in px and a translation in m of this pair"
            raise InputError(CALIBRATION_REFUSED, file, "matrix", found=found, expected=expected) from error
    return np.array(changes)


def surface_effects(
    measured: StereoMotion, rig: FaceCamera, frames: Sequence[FloatArray], shapes: Shapes
) -> dict[str, ComplexArray]:
    """Return the uncertainty of displacement phasors by the surface before a single camera.

    SURFACE (3, K, 6): its position along its normal and its two tilts, one standard uncertainty of each. THROUGH (6, K,
    6): the pose, in the order of its uncertainties. The surface is fixed in the sensor frame: with the camera's frame
    displaced by E the pixels were on S⁻¹·E⁻¹·S of the surface, S = sensor_from_camera.
    """
    pair, pose, count = measured.sight.pair, sensor_from_camera(measured.sight.pair), len(CAMERA_PARAMETERS)
    assert rig.covariance is not None
    nominal, u = phasor_motion(rig, pose, frames, shapes), np.array(pair.pose_uncertainty)

    def seen_on(other: FaceCamera) -> ComplexArray:
        return np.asarray((nominal - phasor_motion(other, pose, frames, shapes))[:, :6])

    stated = [rig.perturbed(step) for step in np.diag(np.sqrt(np.diagonal(rig.covariance)))[count:]]
    errors = [RigidTransform(rotation_from_vector(-step[3:]), step[:3]) for step in np.diag(u)]
    moved = [rig.move_face(pose.inverse() @ error.inverse() @ pose) for error in errors]
    return {SURFACE: np.array([*map(seen_on, stated)]), THROUGH: np.array([*map(seen_on, moved)])}


def _phasor_frames(sums: SineSums, samples: int, name: str) -> list[FloatArray]:
    """Return positions (1 + 2K, N, 2) in each camera.

    Mean, mean + Re and mean + Im of the displacement at each line. Of the subsets in most frames, each by its frames,
    because in a long recording all are lost at times. About 200 of them are enough, because the effect of the
    calibration is smooth over the image.
    """
    mean, phasors, _ = sums.solve(1)
    good = np.isfinite(mean).all(axis=1) & (sums.count >= SEEN_SHARE * samples)
    if np.count_nonzero(good) < MIN_SUBSETS:
        reason = f"only {np.count_nonzero(good)} subsets are tracked in half of the frames"
        raise ComputeError(NO_RIGID_MOTION, pair=name, reason=reason)
    some = np.flatnonzero(good)
    some = some[spread_choice(np.arange(len(some)), EFFECT_SUBSETS / len(some))]
    parts = [part[some] for value in phasors for part in (value.real, value.imag)]
    frames = np.stack([mean[some], *(mean[some] + part for part in parts)])
    return [np.ascontiguousarray(frames[..., side : side + 2]) for side in range(0, frames.shape[2], 2)]


def phasor_motion(rig: Rig, pose: RigidTransform, frames: Sequence[FloatArray], shapes: Shapes) -> ComplexArray:
    """Return displacement phasors (K, 6) and shape amplitudes (K, S) of phasor frames.

    The left camera has the pose `pose`. By least squares of the points with their depth uncertainty. Linear in the
    displacements: differences by the rig are required, to which a rotation by a milliradian adds a thousandth.
    """
    points = locate(rig, frames).transformed(pose)
    rest, finite = points.position_m[0], np.isfinite(points.position_m).all(axis=(0, 2))
    columns = [*np.broadcast_to(np.eye(3)[:, None], (3, len(rest), 3)), *np.cross(np.eye(3)[:, None], rest)]
    design = np.stack([*columns, *shapes(rest)])[:, finite].reshape(6 + len(shapes.names), -1)
    weight = np.linalg.inv(points.covariance_m2[0][finite])
    weighted = np.einsum("pni,nij->pnj", design.reshape(len(design), -1, 3), weight).reshape(len(design), -1)
    moved = (points.position_m[1:] - rest)[:, finite].reshape(len(frames[0]) - 1, -1)
    information, sums = weighted @ design.T, weighted @ moved.T
    motion = np.linalg.lstsq(information[:6, :6], sums[:6], rcond=None)[0]
    amplitude = np.linalg.lstsq(information, sums, rcond=None)[0][6:]
    both = np.concatenate([motion, amplitude]).T
    return np.asarray(both[0::2] + 1j * both[1::2])


def with_surface_at_rest(measured: StereoMotion, mean_pose: FloatArray) -> StereoMotion:
    """Return the motion of a single camera with its surface at the mean pose (6,).

    The frames were fitted with the surface at the first frame, which differs from rest by the motion of the body then.
    A motion p that shifts pixels by J₀·p there shifts them as (JᵀJ)⁻¹·Jᵀ·J₀·p does on the surface at rest, with the
    rates J of the subsets' pixels by the six components. The remaining error is of second order in the motion over the
    distance.
    """
    view = measured.view
    if view is None or not isinstance(view.rig, FaceCamera):
        return measured
    pose = sensor_from_camera(measured.sight.pair)
    positions = next(iter(view.tracks)).left.position_px[:1]
    camera, rates = PlacedCamera(view.rig.camera, pose.inverse()), []
    for rig in (view.rig, view.rig.move_face(pose.inverse() @ RigidTransform.from_pose(mean_pose).inverse() @ pose)):
        rates.append(project_body_points(camera, locate(rig, [positions]).transformed(pose).position_m[0]).rates)
    finite = np.isfinite(rates).all(axis=(0, 2, 3))
    stated, true = (one[finite].reshape(-1, 6) for one in rates)
    scale = np.linalg.norm(true, axis=0)
    answer = np.linalg.lstsq(true / scale, stated, rcond=None)[0] / scale[:, None]
    motion = measured.motion
    covariance = answer @ motion.covariance @ answer.T
    if view.phase_rotated is not None:
        response = view.phase_rotated.response.copy()
        response[:, :, :6] = response[:, :, :6] @ np.linalg.inv(answer)
        view = replace(view, phase_rotated=replace(view.phase_rotated, response=response))
    return replace(measured, view=view, motion=replace(motion, pose=motion.pose @ answer.T, covariance=covariance))


def displacement(measured: StereoMotion, fit: SineFit) -> Phasors:
    """Return the phasors of a body's motion at the lines, means over an exposure."""
    rotated = None if measured.view is None else measured.view.phase_rotated
    return fit.phasors if rotated is None else rotated.motion(measured.sight.time_s, fit)


def fit_about_mean(measured: StereoMotion, frequency_hz: FloatArray) -> tuple[StereoMotion, RigidMotion, SineFit]:
    """Fit the lines about the mean pose, to which the motion is referred."""
    motion, time_s, fit = measured.motion, measured.sight.time_s, None
    variance: FloatArray | None = None
    try:
        for number in range(3):
            if fit is not None and number == 1:
                measured = with_surface_at_rest(measured, fit.offset)
                motion = measured.motion
            motion = motion if fit is None else relative_to(motion, fit.offset)
            variance = None if fit is None else _frame_variance(time_s, motion, fit)
            fit = fit_sines(
                time_s,
                motion.pose,
                frequency_hz,
                MOTION_COMPONENTS,
                component_units(0),
                model=SineModel(robust=True),
                variance=variance,
            )
    except ValueError as error:
        reason = f"the lines cannot be fitted ({error})"
        raise ComputeError(NO_RIGID_MOTION, pair=measured.sight.name, reason=reason) from error
    assert fit is not None
    if variance is not None:
        notice = Notice(UNEQUAL_FRAMES, "frames", factor=float(variance.max() / variance.min()))
        fit = replace(fit, notices=(*fit.notices, notice))
    return measured, motion, fit


def _frame_variance(time_s: FloatArray, motion: RigidMotion, fit: SineFit) -> FloatArray | None:
    """Return the relative noise variance (F,) of each frame by its pixels.

    The geometric mean over the six components; frames with other illumination, partly hidden, or with points only have
    less weight. Sums of pixels over all frames would weight by the total information, which is not better
    (`benchmarks/grey_phasors.py`). None if the ratios are below `MIN_VARIANCE_RATIO`, or if the residuals of a `fit`
    favour one variance for all by likelihood: air and vibration do not depend on pixels.
    """
    variance = np.diagonal(motion.covariance, axis1=1, axis2=2)
    left = fit.residual_of(time_s, motion.pose)
    usable = np.asarray(np.isfinite(left).all(axis=1) & (variance > 0.0).all(axis=1))
    usable[fit.spikes] = False
    if not usable.any():
        return None
    size = np.ones(len(variance))
    size[usable] = np.exp(np.mean(np.log(variance[usable] / np.median(variance[usable], axis=0)), axis=1))
    square = left[usable] ** 2
    with np.errstate(divide="ignore"):  # of residuals that are zero
        equal, separate = (
            float(np.mean(np.log(np.mean(square / one[:, None], axis=0)))) + float(np.mean(np.log(one)))
            for one in (np.ones(len(square)), size[usable])
        )
    return size if np.ptp(np.log(size[usable])) > np.log(MIN_VARIANCE_RATIO) and separate < equal else None
