"""What all frames of a pair share: mean pose, calibration, the surface before one camera, errors of the pixel grid."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.errors import ComputeError, InputError
from fusion.instruments.stereo import CALIBRATION, PERIODIC, SURFACE
from fusion.phasors.phasor_notices import CALIBRATION_REFUSED, NO_RIGID_MOTION, UNEQUAL_FRAMES
from fusion.phasors.shutter import check_in_step
from fusion.phasors.stereo_motion import ImageView, StereoMotion, sensor_from_camera
from photogram.arrays import RunningMean, spread_choice
from photogram.camera import CAMERA_PARAMETERS, FaceCamera, Rig, StereoRig, locate, principal_components
from photogram.direct.shapes import Shapes
from photogram.direct.surface import PlacedCamera, project_body_points
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.motion import RigidMotion, relative_to
from shaker.arrays import ComplexArray, FloatArray
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.sine.normal_equations import SineSums
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineFit, SineModel
from shakercal._common.notices import Notice

MIN_SUBSETS, SEEN_SHARE, EFFECT_SUBSETS = 6, 0.5, 200
PERIODIC_SHARE = 0.4  # standard uncertainty of a line over the amplitude of an error periodic in the pixel
BIAS_STEP_PX = 0.01
UNLIKE = 2.0  # times the variance of other frames: weights of less gain less than 6 %
THROUGH = "pose through the surface"


def image_effects(
    measured: StereoMotion,
    view: ImageView,
    frequency_hz: FloatArray,
    usable: NDArray[np.bool_],
    gain: FloatArray,
    notices: list[Notice],
) -> tuple[dict[str, ComplexArray], ComplexArray]:
    """Return what calibration and errors periodic in the pixel do to the phasors, NaN at lines not `usable`, and to
    amplitudes of shapes at those that are. Add to `notices` if the cameras of a pair are not in step.

    Of a camera alone also what the stated surface does, and what the pose does through it (THROUGH).
    """
    sums, means = None, tuple(RunningMean() for _ in view.rig.camera_poses)
    for block in view.tracks:
        positions = [camera.position_px for camera in block.cameras]
        both = np.concatenate(positions, axis=2)
        if sums is None:
            sums, bias_px = SineSums(measured.points_time_s, frequency_hz, np.nan_to_num(both[0])), block.bias_px
        sums.add(both)
        for running, position in zip(means, positions, strict=True):
            running.add(position)
    assert sums is not None
    places = [running.mean for running in means]
    frames = list[FloatArray]()
    # Without a covariance nothing but the comparison of the cameras needs the displacement of each subset.
    with suppress(ComputeError) if view.rig.covariance is None else nullcontext():
        frames = _phasor_frames(sums, len(measured.points_time_s), measured.sight.name)
    if frames and isinstance(view.rig, StereoRig):
        notices += check_in_step(view.rig, frames, frequency_hz, measured.sight.time_s)
    of_calibration = _calibration_effects(measured, view, frames, len(frequency_hz))
    periodic, periodic_of_shapes = _periodic_effects(measured, view, places, bias_px, len(frequency_hz))
    changes = {CALIBRATION: of_calibration[..., :6], PERIODIC: periodic}
    if isinstance(view.rig, FaceCamera):
        changes |= surface_effects(measured, view.rig, frames, view.deformed.shapes)
    effects, loss = {}, gain[usable][:, None]
    for what, change in changes.items():
        effects[what] = np.full((len(change), len(usable), 6), np.nan, dtype=np.complex128)
        effects[what][:, usable] = change / loss
    return effects, np.asarray(np.concatenate([of_calibration[..., 6:], periodic_of_shapes]) / loss)


def _periodic_effects(
    measured: StereoMotion, view: ImageView, means: Sequence[FloatArray], bias_px: FloatArray, lines: int
) -> tuple[ComplexArray, ComplexArray]:
    """Return (12·K, K, 6): what errors periodic in the pixel may do to the phasors, each at one line only.

    A mean error B·sin(2πu + φ) of all subsets moving as u(t) = a·cos ωt is at most 2·B·J₁(1.84) = 1.16·B at any
    multiple of ω; over amplitudes and phases that is about 0.4·B, as a standard uncertainty of real and imaginary part
    alike. Since u differs across the image, it counts for x and y of either camera as a shift of all subsets by B and
    as displacements growing to B at the body's rim, along and across: twelve patterns, each on its own, of which the
    motion has six independent combinations. A camera alone sees tilts by patterns of second order, which then count as
    well. `means` (N, 2): the subsets' positions in each camera.

    Beside it (2S·K, K, S): what they do to the amplitudes of shapes, for which displacements of second order over the
    picture count as well.
    """
    seen = np.isfinite(np.concatenate(means, axis=1)).all(axis=1)
    motions: list[FloatArray] = []
    places = [mean[seen] for mean in means]
    for side, bias in enumerate(np.nan_to_num(bias_px)):
        centred = places[side] - places[side].mean(axis=0)
        x, y = (centred / np.abs(centred).max(axis=0)).T
        for pattern in (np.ones(len(x)), x, y, x * x, x * y, y * y):
            moved = [np.repeat(place[None], 3, axis=0) for place in places]  # at rest, along x, along y
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
    """Return (P, K, 6 + S): the displacement phasors' change for each principal component of the calibration, and that
    of the amplitudes of shapes.

    The path from the tracks onward is evaluated again with each perturbed rig. Phasors are linear in small pixel
    displacements, so instead of all frames only the mean positions of the subsets and their displacement phasors at
    each line are triangulated and fitted: 1 + 2K `frames`. Of a camera alone without what is open of its surface.
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
    """Return what the surface before a camera alone leaves open of the displacement phasors, by what it is due to.

    SURFACE (3, K, 6): its place along its normal and its two tilts, one standard uncertainty of each. THROUGH (6, K,
    6): the pose, in the order of its uncertainties, because the surface stays where it is in the sensor frame: with the
    camera's frame elsewhere by E the pixels were seen on S⁻¹·E⁻¹·S of the surface, S = sensor_from_camera.
    """
    pair, pose, own = measured.sight.pair, sensor_from_camera(measured.sight.pair), len(CAMERA_PARAMETERS)
    assert rig.covariance is not None
    nominal, u = phasor_motion(rig, pose, frames, shapes), np.array(pair.pose_uncertainty)

    def seen_on(other: FaceCamera) -> ComplexArray:
        return np.asarray((nominal - phasor_motion(other, pose, frames, shapes))[:, :6])

    stated = [rig.perturbed(step) for step in np.diag(np.sqrt(np.diagonal(rig.covariance)))[own:]]
    errors = [RigidTransform(rotation_from_vector(-step[3:]), step[:3]) for step in np.diag(u)]
    moved = [rig.move_face(pose.inverse() @ error.inverse() @ pose) for error in errors]
    return {SURFACE: np.array([*map(seen_on, stated)]), THROUGH: np.array([*map(seen_on, moved)])}


def _phasor_frames(sums: SineSums, samples: int, name: str) -> list[FloatArray]:
    """Return positions (1 + 2K, N, 2) in each camera: mean, mean + Re and mean + Im of each line's displacement.

    Of the subsets that are seen in most frames, each by its own: in a long recording all are lost now and then. Some
    200 of them are enough, since what the calibration does is smooth over the picture.
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
    """Return the displacement phasors (K, 6) that a rig, its left camera in this pose, makes of phasor frames, and the
    amplitudes (K, S) of shapes beside them, by least squares of the points with what depth is worth in them.

    Linear in the displacements: what differs by the rig is sought, to which turning by a milliradian adds a thousandth.
    """
    points = locate(rig, frames).transformed(pose)
    rest, known = points.position_m[0], np.isfinite(points.position_m).all(axis=(0, 2))
    columns = [*np.broadcast_to(np.eye(3)[:, None], (3, len(rest), 3)), *np.cross(np.eye(3)[:, None], rest)]
    design = np.stack([*columns, *shapes(rest)])[:, known].reshape(6 + len(shapes.names), -1)
    weight = np.linalg.inv(points.covariance_m2[0][known])
    weighted = np.einsum("pni,nij->pnj", design.reshape(len(design), -1, 3), weight).reshape(len(design), -1)
    moved = (points.position_m[1:] - rest)[:, known].reshape(len(frames[0]) - 1, -1)
    information, sums = weighted @ design.T, weighted @ moved.T
    motion = np.linalg.lstsq(information[:6, :6], sums[:6], rcond=None)[0]
    amplitude = np.linalg.lstsq(information, sums, rcond=None)[0][6:]
    both = np.concatenate([motion, amplitude]).T
    return np.asarray(both[0::2] + 1j * both[1::2])


def with_surface_at_rest(measured: StereoMotion, mean_pose: FloatArray) -> StereoMotion:
    """Return the motion of a camera alone, whose stated surface is that of the mean pose (6,), not of the first frame.

    The frames were fitted with the surface stated for the first one, which is as far from rest as the body is then. A
    motion p that shifts pixels by J₀·p there shifts them as (JᵀJ)⁻¹·Jᵀ·J₀·p does on the surface where it was, J the
    rates of the subsets' pixels by the six components; what is left is of second order in the motion over the distance.
    """
    view = measured.view
    if view is None or not isinstance(view.rig, FaceCamera):
        return measured
    pose = sensor_from_camera(measured.sight.pair)
    places = next(iter(view.tracks)).left.position_px[:1]
    camera, rates = PlacedCamera(view.rig.camera, pose.inverse()), []
    for rig in (view.rig, view.rig.move_face(pose.inverse() @ RigidTransform.from_pose(mean_pose).inverse() @ pose)):
        rates.append(project_body_points(camera, locate(rig, [places]).transformed(pose).position_m[0]).rates)
    known = np.isfinite(rates).all(axis=(0, 2, 3))
    stated, true = (one[known].reshape(-1, 6) for one in rates)
    scale = np.linalg.norm(true, axis=0)
    answer = np.linalg.lstsq(true / scale, stated, rcond=None)[0] / scale[:, None]
    motion = measured.motion
    covariance = answer @ motion.covariance @ answer.T
    return replace(measured, motion=replace(motion, pose=motion.pose @ answer.T, covariance=covariance))


def displacement(measured: StereoMotion, fit: SineFit) -> Phasors:
    """Return the phasors of a body's motion at the lines of its fit, each as the mean over an exposure."""
    turned = None if measured.view is None else measured.view.phase_rotated
    return fit.phasors if turned is None else turned.motion(measured.sight.time_s, fit)


def fit_about_mean(measured: StereoMotion, frequency_hz: FloatArray) -> tuple[StereoMotion, RigidMotion, SineFit]:
    """Fit the lines again about the mean pose, the offset of a fit, to which the motion is re-referred.

    That pose is also where the surface before a camera alone lies as it is stated.
    """
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
    """Return the noise variance (F,) of each frame over a typical one's, by what its pixels state; None for all alike.

    The geometric mean over the six components, by which frames in another light, half hidden, or known by points alone
    count less. Sums of pixels over all frames at once would weigh by the whole of their information, which gains no
    more (`benchmarks/grey_phasors.py`). Frames less unlike than by `UNLIKE` count alike, and all do where what a `fit`
    leaves of them has the likelihood of one variance for all: air and vibration ask for no pixels.
    """
    own = np.diagonal(motion.covariance, axis1=1, axis2=2)
    left = fit.residual_of(time_s, motion.pose)
    known = np.asarray(np.isfinite(left).all(axis=1) & (own > 0.0).all(axis=1))
    known[fit.spikes] = False
    if not known.any():
        return None
    size = np.ones(len(own))
    size[known] = np.exp(np.mean(np.log(own[known] / np.median(own[known], axis=0)), axis=1))
    square = left[known] ** 2
    with np.errstate(divide="ignore"):  # of residuals that are zero
        alike, unlike = (
            float(np.mean(np.log(np.mean(square / one[:, None], axis=0)))) + float(np.mean(np.log(one)))
            for one in (np.ones(len(square)), size[known])
        )
    return size if np.ptp(np.log(size[known])) > np.log(UNLIKE) and unlike < alike else None
