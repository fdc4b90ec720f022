"""From the image pairs (or points) of one stereo pair to the motion of its body and to displacement phasors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.channels import nominal_lines, spread_lines
from fusion.deflection import deflection_shape
from fusion.errors import ComputeError, InputError
from fusion.evaluation import StereoResult
from fusion.manifest import Images, Manifest, PointFiles, Stereo
from fusion.notices import AnyNotice, Notice
from fusion.settings import ProgressCallback, Settings
from fusion.timing import TimeBase, exposure_middles
from photogram.calibration_file import read_calibration
from photogram.camera import StereoRig
from photogram.deformation import Deformation, deformation
from photogram.device import resolve_device
from photogram.images import GreyImage, ImageSequence, open_sequence, saturated_fraction
from photogram.measure import BodyMotion, measure_body
from photogram.motion import RigidMotion, fit_motion, points_with_estimated_noise, relative_to
from photogram.noise import NoiseModel
from photogram.point_tables import read_point_tables
from photogram.quality import SubsetQuality, suggested_radius_px
from photogram.rigid import RigidTransform
from photogram.track import StereoTracks, TrackSettings, TrackStatus
from photogram.triangulate import Points, triangulate
from shaker.signals.frequencies import Lines, find_lines
from shaker.signals.phasor import Phasors
from shaker.signals.sine import SineFit, exposure_gain, fit_sines, sine_amplitudes, usable_lines

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
DISPLACEMENT_UNITS = ("m", "m", "m", "rad", "rad", "rad")
MAX_SATURATED = 0.02  # fraction of pixels at full scale above which a camera is refused
MIN_SUBSETS = 6
PERIODIC_SHARE = 0.4  # standard uncertainty of a line over the amplitude of an error periodic in the pixel
BIAS_STEP_PX = 0.01
NO_MOTION = "no frame has enough points for a rigid motion"


@dataclass(frozen=True)
class OpenImages:
    """The images of one stereo pair, opened and checked: sequences, exposure middles (F,), rig, first left image."""

    entry: Images
    stereo: Stereo
    left: ImageSequence
    right: ImageSequence
    time_s: FloatArray
    rig: StereoRig
    first: GreyImage


@dataclass(frozen=True)
class ImageView:
    """What the images of one stereo pair gave: tracked subsets, their rig, the first left image, and
    the noise models of both cameras and what their subsets promised."""

    tracks: StereoTracks
    rig: StereoRig
    reference_image: GreyImage
    noise: tuple[NoiseModel, NoiseModel]
    quality: tuple[SubsetQuality, SubsetQuality]


@dataclass(frozen=True)
class StereoMotion:
    """Motion of one body in the sensor frame before any line is known.

    `time_s` (F,) exposure middles on the first block's clock; `motion` from the first frame's pose about the sensor
    origin; `deformation` what the points do beside it; `view` is None for points of another program.
    """

    entry: Images | PointFiles
    stereo: Stereo
    time_s: FloatArray
    motion: RigidMotion
    deformation: Deformation
    reprojection_px: float
    view: ImageView | None
    notices: tuple[AnyNotice, ...]


@dataclass(frozen=True)
class StereoPhasors:
    """Displacement phasors of one stereo pair at all lines, exposure loss corrected, and the calibration's effects.

    `displacement`: six components, m and rad, NaN at lines that this camera rate cannot tell apart.
    `calibration_effects` (P, K, 6): change of the phasors for one standard deviation of each principal component of the
    calibration's covariance; P = 0 where the calibration has none.
    """

    entry: Images | PointFiles
    result: StereoResult
    displacement: Phasors
    calibration_effects: ComplexArray
    notices: tuple[AnyNotice, ...]


def sensor_from_camera(stereo: Stereo) -> RigidTransform:
    """Return the pose of the left camera (or of the frame of the points) in the sensor frame."""
    return RigidTransform(np.array(stereo.rotation), np.array(stereo.translation))


def open_images(manifest: Manifest, base: TimeBase, entry: Images) -> OpenImages:
    """Open the images of one stereo pair and check all that can be checked before the work begins."""
    stereo = manifest.rig.stereo[entry.stereo]
    left, right = _open(manifest, entry, "left"), _open(manifest, entry, "right")
    if len(left) != len(right):
        key = f"images.{entry.stereo}.right"
        raise InputError(manifest.path, key, found=f"{len(right)} images", expected=f"{len(left)} as on the left")
    time_s = exposure_middles(manifest, base, entry, len(left))
    rig = _calibration(stereo, left, right)
    return OpenImages(entry, stereo, left, right, time_s, rig, _read_first(manifest, entry, left, right))


def measure_images(
    manifest: Manifest, images: OpenImages, settings: Settings, progress: ProgressCallback
) -> StereoMotion:
    """Track the image pairs of one stereo pair and fit the rigid motion of the body it sees."""
    body = _measure(manifest, images, settings, progress)
    if not np.isfinite(body.motion.pose).all(axis=1).any():
        raise ComputeError(f"stereo pair {images.entry.stereo}: {NO_MOTION}; look at its images")
    reprojection = float(np.sqrt(np.nanmean(body.points.reprojection_px**2)))
    return StereoMotion(
        images.entry,
        images.stereo,
        images.time_s,
        body.motion,
        deformation(body.points, body.motion),
        reprojection,
        ImageView(body.tracks, images.rig, images.first, body.noise, body.quality),
        body.notices,
    )


def measure_points(manifest: Manifest, base: TimeBase, entry: PointFiles) -> StereoMotion:
    """Fit the rigid motion to the points of another program."""
    stereo = manifest.rig.stereo[entry.stereo]
    key = f"points.{entry.stereo}.files"
    try:
        table = read_point_tables(entry.files, entry.columns, entry.valid_status, entry.scale)
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, manifest.path, key) from error
    time_s = exposure_middles(manifest, base, entry, len(table.frames))
    try:
        points = points_with_estimated_noise(table.position_m, table.reference_m)
    except ValueError as error:
        raise InputError.told_by(error, manifest.path, key) from error
    placed = sensor_from_camera(stereo)
    reference = None if table.reference_m is None else placed.apply(table.reference_m)
    points = points.transformed(placed)
    motion = _fit(entry.stereo, points, reference)
    beside = deformation(points, motion, reference)
    return StereoMotion(entry, stereo, time_s, motion, beside, float("nan"), None, ())


def _open(manifest: Manifest, entry: Images, side: str) -> ImageSequence:
    """Open one camera's images."""
    paths = entry.left if side == "left" else entry.right
    try:
        return _unsaturated(open_sequence(paths, entry.bit_depth))
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, manifest.path, f"images.{entry.stereo}.{side}") from error


def _unsaturated(sequence: ImageSequence) -> ImageSequence:
    """Return the same images, of which a saturated one is refused when it is read."""

    def read(index: int) -> GreyImage:
        image = sequence.read(index)
        saturated = saturated_fraction(image, sequence.full_scale)
        if saturated > MAX_SATURATED:
            found = f"{100 * saturated:.1f} % of its pixels at full scale {sequence.full_scale}"
            raise ValueError(f"{sequence.names[index]}: expected an image that is not saturated, found {found}")
        return image

    return replace(sequence, reader=read)


def _read_first(manifest: Manifest, entry: Images, left: ImageSequence, right: ImageSequence) -> GreyImage:
    """Return the first left image after a look at the first right one."""
    images = []
    for side, sequence in (("left", left), ("right", right)):
        try:
            images.append(sequence.read(0))
        except (OSError, ValueError) as error:
            raise InputError.told_by(error, manifest.path, f"images.{entry.stereo}.{side}") from error
    return images[0]


def _calibration(stereo: Stereo, left: ImageSequence, right: ImageSequence) -> StereoRig:
    """Read a stereo pair's calibration and refuse one made for images of another size."""
    path = stereo.calibration
    if path is None:
        raise ComputeError("a stereo pair with images has no calibration")
    try:
        rig = read_calibration(path)
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, path) from error
    size = [int(length) for length in rig.left.size_px]
    for images in (left, right):
        if size != list(images.size_px):
            expected = f"{list(images.size_px)}, the size of {images.names[0]}"
            raise InputError(path, "image_size", found=f"{size}", expected=expected)
    return rig


def _measure(manifest: Manifest, images: OpenImages, settings: Settings, progress: ProgressCallback) -> BodyMotion:
    """Follow the body through both cameras' images."""
    name, total = images.entry.stereo, 2 * len(images.left)
    radius = settings.subset_radius_px
    if radius is None:
        radius = suggested_radius_px(images.first)
    options = TrackSettings(radius_px=radius, degree=settings.spline_degree)
    try:
        return measure_body(
            (images.left, images.right),
            images.rig,
            sensor_from_camera(images.stereo),
            options,
            lambda done: progress(f"track {name}", done, total),
            resolve_device(settings.device),
        )
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, manifest.path, f"images.{name}") from error


def _fit(name: str, points: Points, reference_m: FloatArray | None) -> RigidMotion:
    """Fit the rigid motion about the sensor origin; a series without any frame is an error."""
    try:
        motion = fit_motion(points, reference_m, np.zeros(3))
    except ValueError as error:
        raise ComputeError(f"stereo pair {name}: no rigid motion can be fitted ({error})") from error
    if not np.isfinite(motion.pose).all(axis=1).any():
        raise ComputeError(f"stereo pair {name}: {NO_MOTION}; look at its points")
    return motion


def motion_lines(manifest: Manifest, base: TimeBase, motions: Sequence[StereoMotion]) -> Lines:
    """Find the lines in the motion itself, for recordings without any channel that shows the excitation.

    The period of the camera trigger is their clock, and its uncertainty part of theirs.
    """
    if not motions:
        raise ComputeError("no channel or camera of this recording shows the excitation; add one to recording.toml")
    first, (nominal_hz, harmonics) = motions[0], nominal_lines(manifest)
    try:
        lines = find_lines(first.time_s, first.motion.pose, nominal_hz, harmonics)
    except ValueError as error:
        told = ValueError(f"{error} (motion seen by stereo pair {first.entry.stereo})")
        raise InputError.told_by(told, manifest.path, "excitation.frequencies") from error
    u_clock_hz = lines.frequency_hz * base.u_trigger_rate(first.entry.trigger)
    return replace(lines, u_frequency_hz=np.hypot(lines.u_frequency_hz, u_clock_hz))


def stereo_phasors(measured: StereoMotion, lines: Lines) -> StereoPhasors:
    """Fit the lines to a body's motion about its mean pose."""
    order = np.lexsort((lines.frequency_hz, lines.multiple))  # fundamentals have precedence over harmonics
    usable = np.zeros(len(order), dtype=np.bool_)
    usable[order], folded = usable_lines(measured.time_s, lines.frequency_hz[order])
    name = measured.entry.stereo
    if not usable.any():
        raise ComputeError(f"stereo pair {name}: its camera rate cannot tell any line of the recording apart")
    frequency_hz = lines.frequency_hz[usable]
    from_mean, fit = _fit_about_mean(name, measured, frequency_hz)
    gain = exposure_gain(lines.frequency_hz, measured.entry.exposure)
    displacement = spread_lines(fit.phasors, usable, lines.frequency_hz).scaled((1.0 / gain)[:, None])
    if measured.view is not None:
        displacement = _with_periodic_error(displacement, measured, measured.view)
    effects = np.full((0, len(usable), 6), np.nan, dtype=np.complex128)
    if measured.view is not None and measured.view.rig.covariance is not None:
        changes = _calibration_effects(measured, measured.view, frequency_hz)
        effects = np.full((len(changes), len(usable), 6), np.nan, dtype=np.complex128)
        effects[:, usable] = changes / gain[usable][:, None]
    found = [(f"{name}, {notice.where}", notice) for notice in measured.notices]
    found += [(name, notice) for notice in folded]
    notices = tuple(Notice(notice.severity, f"stereo pair {where}: {notice.text}", name) for where, notice in found)
    shape = deflection_shape(measured.time_s, frequency_hz, measured.deformation, measured.entry.exposure)
    result = replace(_result(measured, from_mean, fit, usable), deflection=shape)
    return StereoPhasors(measured.entry, result, displacement, effects, notices)


def _fit_about_mean(name: str, measured: StereoMotion, frequency_hz: FloatArray) -> tuple[RigidMotion, SineFit]:
    """Fit the lines twice: the first fit's offset is the mean pose, to which the motion is re-referred."""
    motion = measured.motion
    try:
        for _ in range(2):
            fit = fit_sines(measured.time_s, motion.pose, frequency_hz, COMPONENTS, DISPLACEMENT_UNITS)
            motion = relative_to(motion, fit.offset)
        return motion, fit_sines(measured.time_s, motion.pose, frequency_hz, COMPONENTS, DISPLACEMENT_UNITS)
    except ValueError as error:
        raise ComputeError(f"stereo pair {name}: the lines cannot be fitted to its motion ({error})") from error


def _with_periodic_error(displacement: Phasors, measured: StereoMotion, view: ImageView) -> Phasors:
    """Enlarge the covariances of phasors (K, 6) by what errors periodic in the pixel may do to any line.

    A mean error B·sin(2πu + φ) of all subsets moving as u(t) = a·cos ωt is at most 2·B·J₁(1.84) = 1.16·B at any
    multiple of ω; over amplitudes and phases that is about 0.4·B, as a standard uncertainty of real and imaginary part
    alike. It counts for x and y of either camera on its own, as the motion that shifts all their subsets by B.
    """
    tracks = view.tracks
    left, right = (np.nanmean(side.position_px, axis=0) for side in (tracks.left, tracks.right))
    known = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    shift = BIAS_STEP_PX * np.eye(4)
    left, right = (side[known] + moved[:, None] for side, moved in ((left, shift[:, :2]), (right, shift[:, 2:])))
    frames = [np.concatenate([side[:1] - moved, side]) for side, moved in ((left, shift[0, :2]), (right, shift[0, 2:]))]
    paired = _phasor_motion(measured, view.rig, (frames[0], frames[1]))
    motion = np.stack([paired[0].real, paired[0].imag, paired[1].real, paired[1].imag]) / BIAS_STEP_PX
    motion *= PERIODIC_SHARE * np.nan_to_num(np.repeat(tracks.bias_px, 2))[:, None]
    covariance = displacement.covariance + np.kron(np.eye(2), motion.T @ motion)
    return replace(displacement, covariance=covariance)


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
    nominal = _phasor_motion(measured, view.rig, frames)
    steps = _principal_components(covariance)
    return np.array([_phasor_motion(measured, view.rig.perturbed(step), frames) - nominal for step in steps])


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


def _phasor_motion(measured: StereoMotion, rig: StereoRig, frames: tuple[FloatArray, FloatArray]) -> ComplexArray:
    """Return the displacement phasors (K, 6) that a rig makes of phasor frames."""
    points = triangulate(rig, frames[0], frames[1], None, None).transformed(sensor_from_camera(measured.stereo))
    pose = fit_motion(points, None, np.zeros(3)).pose[1:]
    return np.asarray(pose[0::2] + 1j * pose[1::2])


def _principal_components(covariance: FloatArray) -> FloatArray:
    """Return steps (P, 24), one standard deviation along each principal component of a covariance."""
    sigma = np.sqrt(np.diagonal(covariance))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = eigenvalues > 1e-9 * eigenvalues[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(eigenvalues[kept])).T * sigma)


def _sigmas(view: ImageView) -> FloatArray:
    """Return predicted and found standard deviation (2,) of a subset's coordinate: median of both cameras."""
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
        exposure_s=measured.entry.exposure,
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
        noise=() if view is None else view.noise,
        median_zncc=None if view is None else float(np.nanmedian(view.tracks.left.zncc)),
    )
