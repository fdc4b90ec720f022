"""From the images, or points, of a stereo pair to rigid motion.

Images are tracked pair by pair and block by block, by threads of this process or by processes of an executor. Functions
that track import numba; reading does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fusion.base import CheckpointStore, Executor, Pending, ProgressCallback, Settings, Threads
from fusion.errors import ComputeError, InputError, as_input_error
from fusion.instruments.transducer import STATIONARY
from fusion.phasors.phasor_notices import (
    CALIBRATION_REFUSED,
    COPIED_FRAMES,
    EXPOSURE_DIFFERS,
    EXPOSURE_REFUSED,
    FILE_TIMES_GAP,
    FRAME_RATE_DIFFERS,
    FREQUENCIES_UNSTATED,
    HARMONIC_WITHOUT_FUNDAMENTAL,
    IMAGES_REFUSED,
    LINES_UNRESOLVED,
    NO_INSTRUMENT,
    NO_RIGID_MOTION,
    PAIR_DECALIBRATED,
    PAIR_REJECTED,
    SINGLE_CAMERA_NOT_ASSESSED,
)
from fusion.phasors.shutter import PhaseRotated
from fusion.phasors.timing import Sight, TimeBase, frame_edges, frame_sight, lines_not_found_error
from fusion.phasors.tracked_blocks import TrackedBlocks, track_block
from fusion.recording.daq_records import FileCache
from fusion.recording.load import Manifest
from fusion.recording.manifest import MINIMUM_FRAMES, Images, PointFiles
from fusion.recording.rig import Stereo
from fusion.recording.values import FILE, SurfacePlane
from photogram.calibration.calibration_file import read_calibration, read_camera
from photogram.camera import FaceCamera, Rig, StereoRig
from photogram.geometry import RigidTransform
from photogram.images.image_files import open_sequence
from photogram.images.sequence import (
    GreyImage,
    ImageSequence,
    find_copied_frames,
    inspect_first_image,
    numbers_of_names,
)
from shaker.lines.frequencies import LineFrequencies, find_lines
from shaker.sine.aliasing import usable_lines
from shakercal._common.arrays import BoolArray, FloatArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.sensitivity.mode_shapes import ModeShapes
    from photogram.direct.surface import ShapeAmplitudes
    from photogram.epipolar import EpipolarCheck
    from photogram.images.noise import NoiseModel
    from photogram.measure.body import BodyMotion
    from photogram.measure.follow import BodyScene
    from photogram.motion import Deformation, RigidMotion
    from photogram.subsets.icgn import TrackSettings
    from photogram.subsets.texture import SubsetQuality
    from photogram.subsets.track import StereoTracks

    BodyInputs = tuple[tuple[ImageSequence, ...], Rig, RigidTransform, TrackSettings]

T = TypeVar("T")

MAX_SATURATED = 0.02  # fraction of pixels at full scale above which a camera is refused
SAME_EXPOSURE = 0.02  # relative difference of equal exposures
SAME_RATE = 0.01  # of frames on the camera's clock and of edges on that of a DAQ
MIN_SUBSET_FRAMES, SPARED, TIMES_UNKNOWNS = 24, 8, 2
"""Fewest frames with subsets: number, inverse share of all, and multiple of the unknowns of the lines (chosen)."""
MOST_NAMED = 5  # frames in a notice
MIN_POSITIONS = 3  # on a body that determine its depth
NO_MOTION = "no frame has enough points for a rigid motion"


@dataclass(frozen=True)
class PreparedImages:
    """The images of one stereo pair, opened and checked.

    `sight`; `cameras`: images of each camera; `rig`; `first`: the first left image. `notices`: of the files and their
    contradictions to the manifest. `depth_m`: nearest and farthest depth in the left camera at which its body can be
    (`depth_range_m`), None if not known. `modes`: of an elastic load, with measurable amplitudes. `entry`: as the
    manifest states them. `copied` (F,): frames in which a camera repeats an earlier one.
    """

    sight: Sight
    cameras: tuple[ImageSequence, ...]
    rig: Rig
    first: GreyImage
    notices: tuple[Notice, ...]
    depth_m: tuple[float, float] | None
    modes: ModeShapes | None
    entry: Images
    copied: BoolArray

    @property
    def left(self) -> ImageSequence:
        """Images of the left camera, or of the only one."""
        return self.cameras[0]


@dataclass(frozen=True)
class ImageView:
    """Tracking results of the images of one stereo pair.

    Tracked subsets of some frames at a time, their rig, the first left image, the noise models of its cameras and the
    predicted quality of subsets. `epipolar`: whether the pair is as calibrated (None for a single camera). `deformed`:
    deformation in shapes, from all pixels. Medians: `sigma_px` of positions by noise, and `zncc` in the left camera.
    `phase_rotated`: of a rolling shutter, after its refinement.
    """

    tracks: Iterable[StereoTracks]
    rig: Rig
    reference_image: GreyImage
    noise: tuple[NoiseModel, ...] | None
    quality: tuple[SubsetQuality, ...] | None
    epipolar: EpipolarCheck | None
    deformed: ShapeAmplitudes
    sigma_px: float
    zncc: float
    phase_rotated: PhaseRotated | None = None


@dataclass(frozen=True)
class StereoMotion:
    """Motion of one body in the sensor frame, before the lines are used.

    `motion` from the first frame's pose about the sensor origin. `deformation`: of the points, of some frames at a
    time. `view`: None for points of another program. `subset_frames` (F,): frames with tracked points, those of
    `deformation` and the view's tracks; None for all.
    """

    sight: Sight
    motion: RigidMotion
    deformation: Iterable[Deformation]
    reprojection_px: float
    view: ImageView | None
    notices: tuple[Notice, ...]
    subset_frames: BoolArray | None = None

    @property
    def points_time_s(self) -> FloatArray:
        """Exposure times of the frames with points."""
        return self.sight.time_s if self.subset_frames is None else self.sight.time_s[self.subset_frames]


@dataclass(frozen=True)
class RejectedPair:
    """A stereo pair without a motion.

    `error` ends the run if no other instrument measures one.
    """

    name: str
    error: InputError | ComputeError

    @property
    def notice(self) -> Notice:
        """Return the warning that the other instruments are evaluated without the pair."""
        return Notice(PAIR_REJECTED, f"stereo pair {self.name}", reason=self.error.sentence.rstrip("."))


def sensor_from_camera(stereo: Stereo) -> RigidTransform:
    """Return the pose of the left camera in the sensor frame.

    Or of the frame of the points.
    """
    return RigidTransform(np.array(stereo.rotation), np.array(stereo.translation))


def prepare_images(
    manifest: Manifest, base: TimeBase, entry: Images, already: FileCache | None = None
) -> PreparedImages:
    """Open the images of one stereo pair and check them before tracking.

    A saturated image is refused when it is read; the first ones are read already.
    """
    key, sequences, cached = f"images.{entry.stereo}", [], {} if already is None else already.images
    for side, paths in entry.cameras:
        with as_input_error(manifest.path, f"{key}.{side}"):
            sequence = cached.get((paths, entry.bit_depth)) or open_sequence(paths, entry.bit_depth)
            sequences.append(sequence)
    left = sequences[0]
    for other in sequences[1:]:
        if len(left) != len(other):
            found, expected = f"{len(other)} images", f"{len(left)} as on the left"
            raise InputError(IMAGES_REFUSED, manifest.path, f"{key}.right", found=found, expected=expected)
    if len(left) < MINIMUM_FRAMES:
        found, expected = f"{len(left)} in {entry.left[0].name}", f"at least {MINIMUM_FRAMES} frames"
        raise InputError(IMAGES_REFUSED, manifest.path, f"{key}.left", found=found, expected=expected)
    if entry.exposure == FILE:
        entry = entry.model_copy(update={"exposure": _stated_exposure(manifest, entry, sequences)})
    numbers = {side: images.numbers for (side, _), images in zip(entry.cameras, sequences, strict=True)}
    edges, remarks = frame_edges(manifest, base, entry, numbers, len(left))
    sight = frame_sight(manifest, base, entry, edges, max(images.size_px[1] for images in sequences))
    rig = read_rig(sight.pair, sequences)
    first = []
    for number, (side, _) in enumerate(entry.cameras):
        with as_input_error(manifest.path, f"{key}.{side}"):
            first.append(sequences[number].read(0))
            sequences[number] = inspect_first_image(
                replace(sequences[number], most_saturated=MAX_SATURATED), first[number]
            )
    copied, copies = _copies(entry, sequences)
    pair = _without_calibration_share(sight.pair, rig)
    notices: list[Notice] = [*remarks, *copies, *(notice for images in sequences for notice in images.notices)]
    notices += [notice for images in sequences for notice in _contradictions(sight, images)]
    x, y, *_ = entry.region or (0, 0)
    if x >= left.size_px[0] or y >= left.size_px[1]:
        expected, found = f"a part of images of {left.size_px[0]} x {left.size_px[1]} px", str(list(entry.region or ()))
        raise InputError(IMAGES_REFUSED, manifest.path, f"{key}.region", found=found, expected=expected)
    depth_m, load, modes = depth_range_m(manifest, pair), manifest.rig.load, None
    if pair.body == "load" and load is not None and any(part.measured_by for part in load.elastic):
        from fusion.sensitivity.mode_shapes import mode_shapes

        modes = mode_shapes(load, sight.name)
    placed = replace(sight, pair=pair)
    return PreparedImages(placed, tuple(sequences), rig, first[0], tuple(notices), depth_m, modes, entry, copied)


def _copies(entry: Images, sequences: Sequence[ImageSequence]) -> tuple[BoolArray, list[Notice]]:
    """Return the frames (F,) in which a camera repeats an earlier one, and their notices."""
    found = [find_copied_frames(images) for images in sequences]
    copied, notices = np.any(found, axis=0), list[Notice]()
    for (side, _), images, repeated in zip(entry.cameras, sequences, found, strict=True):
        if repeated.any():
            count = int(repeated.sum())
            names = ", ".join(Path(images.names[k]).name for k in np.flatnonzero(repeated)[:MOST_NAMED])
            more = f" and {count - MOST_NAMED} more" if count > MOST_NAMED else ""
            notices.append(Notice(COPIED_FRAMES, entry.stereo, camera=side, count=count, names=names + more))
    return copied, notices


def _stated_exposure(manifest: Manifest, entry: Images, sequences: Sequence[ImageSequence]) -> float:
    """Return the exposure in s that the files of all cameras state."""
    stated = [images.exposure_s for images in sequences]
    both = [exposure for exposure in stated if exposure is not None]
    if len(both) < len(stated) or max(both) - min(both) > SAME_EXPOSURE * max(both):
        values = " and ".join("no exposure" if exposure is None else f"{1e6 * exposure:g} µs" for exposure in stated)
        found = f'"{FILE}", but the files state {values}'
        key, expected = f"images.{entry.stereo}.exposure", "the exposure in s"
        raise InputError(EXPOSURE_REFUSED, manifest.path, key, found=found, expected=expected)
    return float(np.mean(both))


def _contradictions(sight: Sight, images: ImageSequence) -> list[Notice]:
    """Return warnings where the file of a camera contradicts the sight.

    By its exposure and frame times.
    """
    where, notices = images.names[0].rpartition("[")[0] or sight.name, list[Notice]()
    stated, used = images.exposure_s, sight.exposure.length_s
    if stated is not None and abs(stated - used) > SAME_EXPOSURE * max(stated, used):
        notices.append(Notice(EXPOSURE_DIFFERS, where, file_us=1e6 * stated, used_us=1e6 * used))
    if images.time_s is not None and len(images) > 1:
        steps, edges = np.diff(images.time_s), np.diff(sight.time_s)
        rate = float(np.median(steps / edges))
        if abs(rate - 1.0) > SAME_RATE:
            frame_s, edge_s = np.median(steps), np.median(edges)
            notices.append(Notice(FRAME_RATE_DIFFERS, where, frame_s=frame_s, edge_s=edge_s))
        gaps = np.flatnonzero(np.abs(steps / rate - edges) > 0.5 * edges)
        if len(gaps):
            frames = ", ".join(f"{gap} and {gap + 1}" for gap in gaps)
            notices.append(Notice(FILE_TIMES_GAP, where, frames=frames))
    return notices


def depth_range_m(manifest: Manifest, pair: Stereo) -> tuple[float, float] | None:
    """Return the nearest and farthest depth of the visible face.

    In the left camera. From the sensor's origin and the points of the channels on the pair's body. The face is assumed
    to be no further beyond them, nearer or farther, than their distance from the origin. None with fewer than three
    points.
    """
    channels = (channel for daq in manifest.daq for channel in daq.channel)
    points = [channel.point for channel in channels if channel.body == pair.body and channel.point is not None]
    if len(points) < MIN_POSITIONS:
        return None
    positions = np.array([(0.0, 0.0, 0.0), *points])
    depth = sensor_from_camera(pair).inverse().apply(positions)[:, 2]
    reach = float(np.linalg.norm(positions, axis=1).max())
    return float(depth.min()) - reach, float(depth.max()) + reach


Motions = Callable[[ProgressCallback], tuple[StereoMotion | RejectedPair, ...]]


@contextmanager
def tracked_pairs(
    images: Sequence[PreparedImages],
    settings: Settings,
    executor: Executor | None = None,
    checkpoints: CheckpointStore | None = None,
    lines: LineFrequencies | None = None,
) -> Iterator[Motions]:
    """Start tracking the images of stereo pairs; yield a function that returns their motions.

    The function returns the rigid motion of the body of each pair, or the reason why there is none. The caller may
    continue with other work before.

    Subsets are tracked in enough frames to resolve the `lines`, in all frames without lines. Files that cannot be read
    are refused. An executor opens the images by the same paths; without one, threads of this process track them.
    Results are identical to the last bit. Blocks of frames in `checkpoints` are not tracked again.
    """
    from photogram.kernels import resolve_device

    on_gpu = executor is None and resolve_device(settings.device) != "cpu"
    with Threads(
        max(1, len(images)) if on_gpu else None
    ) as threads:  # a GPU processes one block of each body at a time
        crew = threads if executor is None else executor
        prepared = [crew.submit(0, _prepared, item, settings, lines) for item in images]

        def motions(progress: ProgressCallback) -> tuple[StereoMotion | RejectedPair, ...]:
            begun, moved = [], list[RejectedPair | Pending]()
            for item, pending in zip(images, prepared, strict=True):
                scene: BodyScene | RejectedPair = _attempted(item, partial(_answer, item, pending))
                followed = (
                    scene
                    if isinstance(scene, RejectedPair)
                    else TrackedBlocks(item, scene, settings.device, checkpoints)
                )
                shares = () if isinstance(followed, RejectedPair) else followed.missing()
                submitted = {share: crew.submit(1, track_block, pending, share, settings.device) for share in shares}
                begun.append((item, followed, submitted))
            for item, followed, submitted in begun:  # so that no block waits in memory for the motion of another pair
                if isinstance(followed, RejectedPair):
                    moved.append(followed)
                    continue
                stage, total = f"track {item.sight.name}", 2 * len(item.left)
                for frames in followed.scene.blocks:
                    progress(stage, 2 * frames.start, total)
                    if frames in submitted:
                        followed.add(frames, _answer(item, submitted.pop(frames)))
                progress(stage, total, total)
                moved.append(threads.submit(2, _moved, item, followed))
            return tuple(
                pending if isinstance(pending, RejectedPair) else _attempted(item, partial(_answer, item, pending))
                for item, pending in zip(images, moved, strict=True)
            )

        yield motions


def _attempted(images: PreparedImages, act: Callable[[], T]) -> T | RejectedPair:
    """Return the result of an action on a pair, or the rejected pair.

    Rejected if its body is not found.
    """
    from photogram.subsets.find import BodyNotFound

    try:
        return act()
    except InputError as error:
        if not isinstance(error.__cause__, BodyNotFound):
            raise
        return RejectedPair(images.sight.name, error)


def _moved(images: PreparedImages, followed: TrackedBlocks) -> StereoMotion:
    from photogram.measure.body import body_motion

    with as_input_error(*images.sight.where):
        body = body_motion(followed.scene, followed)
    return motion_from_tracks(images, body)


def _answer(images: PreparedImages, pending: Pending) -> Any:
    """Return the result of a task on some images; raise its refusal as wrong input."""
    answer = pending.result()
    with as_input_error(*images.sight.where):
        return answer.unwrap()


def _prepared(
    images: PreparedImages, settings: Settings, lines: LineFrequencies | None
) -> BodyScene:  # a task, so of this module
    from photogram.kernels import resolve_device
    from photogram.measure.follow import BodyPrior, prepare_body, sine_terms
    from photogram.subsets.find import BodyNotFound

    left = int(np.count_nonzero(~images.copied))
    if left < MINIMUM_FRAMES:
        why = f"{left} of {len(images.copied)}, since the others are copies of earlier frames, grey value by grey value"
        raise BodyNotFound(f"expected at least {MINIMUM_FRAMES} different frames, found {why}")
    inputs, terms = body_inputs(images, settings, None if lines is None else len(lines.frequency_hz)), None
    if lines is not None:
        strongest = np.argsort(lines.multiple, kind="stable")  # mostly
        terms = sine_terms(images.sight.time_s, lines.frequency_hz[strongest])
    rolls = any(images.sight.pair.row_time)
    prior = BodyPrior(images.depth_m, images.modes, rolls, terms, images.copied if images.copied.any() else None)
    return prepare_body(*inputs, resolve_device(settings.device), prior=prior)


def measure_images(images: PreparedImages, settings: Settings, progress: ProgressCallback) -> StereoMotion:
    """Track the images of one stereo pair and fit the rigid motion of its body."""
    with tracked_pairs((images,), settings) as motions:
        (found,) = motions(progress)
    if isinstance(found, RejectedPair):
        raise found.error
    return found


def body_inputs(images: PreparedImages, settings: Settings, lines: int | None = None) -> BodyInputs:
    """Return the inputs of `photogram.measure` for a stereo pair: images, rig, pose, and settings.

    With so many `lines`, and if points are not saved, a part of the frames is enough for deformation and the test of
    the calibration.
    """
    from photogram.subsets.icgn import TrackSettings
    from photogram.subsets.texture import radius_from_image_px

    radius = settings.subset_radius_px or radius_from_image_px(images.first)
    entry, frames = images.entry, None
    if lines is not None and not settings.save_points and not any(images.sight.pair.row_time):
        frames = max(MIN_SUBSET_FRAMES, len(images.left) // SPARED, TIMES_UNKNOWNS * (2 * lines + 1))
    options = TrackSettings(radius, degree=settings.spline_degree, region=entry.region, mask=entry.mask, frames=frames)
    return images.cameras, images.rig, sensor_from_camera(images.sight.pair), options


def motion_from_tracks(images: PreparedImages, body: BodyMotion) -> StereoMotion:
    """Return the motion of a stereo pair's body from its tracks."""
    from photogram.epipolar import check_epipolar
    from photogram.subsets.find import BodyNotFound

    if not np.isfinite(body.motion.pose).all(axis=1).any():
        with as_input_error(*images.sight.where):
            raise BodyNotFound(NO_MOTION)
    epipolar, notices = None, tuple[Notice, ...]([Notice(SINGLE_CAMERA_NOT_ASSESSED, "camera")])
    if isinstance(images.rig, StereoRig):
        epipolar = check_epipolar(body.tracked, images.rig, body.subset_frames)
        notices = epipolar.notices
    medians = body.sigma_px, body.zncc
    return StereoMotion(
        images.sight,
        body.motion,
        body.surface,
        body.reprojection_px,
        ImageView(
            body.tracked, images.rig, images.first, body.noise, body.quality, epipolar, body.shape_amplitudes, *medians
        ),
        (*images.notices, *body.notices, *notices),
        body.subset_frames,
    )


def reject_decalibrated(motion: StereoMotion) -> StereoMotion | RejectedPair:
    """Return the motion of a pair that may be as calibrated, or the rejected pair."""
    epipolar = None if motion.view is None else motion.view.epipolar
    name, why = motion.sight.name, "" if epipolar is None else epipolar.rejection_reason
    return RejectedPair(name, ComputeError(PAIR_DECALIBRATED, reason=why)) if why else motion


def measure_points(manifest: Manifest, base: TimeBase, entry: PointFiles) -> StereoMotion:
    """Fit the rigid motion about the sensor origin to the points of another program."""
    from photogram.motion import deformation, fit_motion, points_with_estimated_noise
    from photogram.point_tables import read_point_tables

    name, key = entry.stereo, f"points.{entry.stereo}.files"
    with as_input_error(manifest.path, key):
        table = read_point_tables(entry.files, entry.columns, entry.valid_status, entry.scale)
    edges, remarks = frame_edges(manifest, base, entry, {"files": numbers_of_names(table.frames)}, len(table.frames))
    sight = frame_sight(manifest, base, entry, edges)
    with as_input_error(manifest.path, key):
        points = points_with_estimated_noise(table.position_m, table.reference_m)
    placed = sensor_from_camera(sight.pair)
    reference = None if table.reference_m is None else placed.apply(table.reference_m)
    points = points.transformed(placed)
    try:
        motion = fit_motion(points, reference, np.zeros(3))
    except ValueError as error:
        raise ComputeError(NO_RIGID_MOTION, pair=name, reason=str(error)) from error
    if not np.isfinite(motion.pose).all(axis=1).any():
        raise ComputeError(NO_RIGID_MOTION, pair=name, reason=NO_MOTION)
    return StereoMotion(sight, motion, (deformation(points, motion, reference),), float("nan"), None, remarks)


def read_rig(stereo: Stereo, sequences: Sequence[ImageSequence]) -> Rig:
    """Read a stereo pair's calibration.

    Raises `InputError` for another file, or for images of another size.
    """
    path = stereo.calibration
    if path is None:
        raise ComputeError(NO_INSTRUMENT, quantity="a motion", reason=": a stereo pair has no calibration")
    with as_input_error(path):
        rig = read_calibration(path) if stereo.surface is None else _before_surface(stereo, path, stereo.surface)
    for images, (camera, _) in zip(sequences, rig.camera_poses, strict=False):
        size = camera.size_px.tolist()
        if size != list(images.size_px):
            expected = f"{list(images.size_px)}, the size of {images.names[0]}"
            raise InputError(CALIBRATION_REFUSED, path, "image_size", found=f"{size}", expected=expected)
    return rig


def _before_surface(stereo: Stereo, calibration: Path, surface: SurfacePlane) -> FaceCamera:
    """Return the camera of a file before its stated surface.

    With both uncertainties.
    """
    camera, of_camera = read_camera(calibration)
    stated = np.square([surface.distance_uncertainty, surface.tilt_uncertainty, surface.tilt_uncertainty])
    covariance = np.pad(of_camera, (0, len(stated)))
    covariance[len(of_camera) :, len(of_camera) :] = np.diag(stated)
    left_from_sensor = sensor_from_camera(stereo).inverse()
    return FaceCamera(
        camera, left_from_sensor.apply(np.array(surface.point)), left_from_sensor.rotation @ surface.normal, covariance
    )


def _without_calibration_share(stereo: Stereo, rig: Rig) -> Stereo:
    """Return the pair with the uncertainty of its pose without that of the calibration.

    The share of the calibration, X·C·Xᵀ with X = `pose_by_calibration`, is included with the effects of the
    calibration.
    """
    if stereo.pose_by_calibration is None or rig.covariance is None:
        return stereo
    answer = np.array(stereo.pose_by_calibration)
    share = np.einsum("ij,jk,ik->i", answer, rig.covariance, answer)
    left = np.sqrt(np.maximum(np.square(stereo.pose_uncertainty) - share, 0.0))
    return stereo.model_copy(update={"pose_uncertainty": tuple(left.tolist())})


def resolved_lines(measured: StereoMotion, lines: LineFrequencies) -> tuple[BoolArray, tuple[Notice, ...]]:
    """Return which lines (K,) the frames resolve, and a notice for each rejected one."""
    order = np.lexsort((lines.frequency_hz, lines.multiple))  # fundamentals have precedence over harmonics
    usable = np.zeros(len(order), dtype=np.bool_)
    usable[order], aliased = usable_lines(measured.sight.time_s, lines.frequency_hz[order])
    for k in np.flatnonzero(usable & (lines.multiple > 1)):
        driven = (lines.nominal_hz == lines.nominal_hz[k]) & (lines.multiple == 1)
        if driven.any() and not usable[driven].all():  # a fit without the strong line is none of the weak one
            usable[k] = False
            aliased += (Notice(HARMONIC_WITHOUT_FUNDAMENTAL, f"{lines.frequency_hz[k]:.6g} Hz"),)
    return usable, aliased


def motion_lines(manifest: Manifest, base: TimeBase, motions: Sequence[StereoMotion]) -> tuple[LineFrequencies, Sight]:
    """Find the lines in the motion, for recordings without a channel that shows the excitation.

    The camera trigger of the pair of the returned sight is their clock, and its uncertainty is part of theirs.
    """
    if not motions:
        raise ComputeError(NO_INSTRUMENT, quantity="the excitation", reason="")
    excitation = manifest.excitation
    if excitation.frequencies is None:
        expected = "the frequencies of the lines, because no channel measures them"
        raise InputError(FREQUENCIES_UNSTATED, manifest.path, "excitation.frequencies", found="none", expected=expected)
    reasons: list[str] = []
    moving = [motion for motion in motions if motion.sight.pair.body != STATIONARY]
    for first in moving or motions:  # the first whose frames resolve a fundamental
        usable, notices = usable_lines(first.sight.time_s, np.array(excitation.frequencies, dtype=np.float64))
        if usable.any():
            break
        reasons += [f"stereo pair {first.sight.name}: {notice.text.rstrip('.')}" for notice in notices]
    else:
        listed = " and ".join(f"{frequency:g} Hz" for frequency in excitation.frequencies)
        raise ComputeError(LINES_UNRESOLVED, frequencies=listed, reasons=f" ({'; '.join(reasons)})")
    try:
        lines = find_lines(first.sight.time_s, first.motion.pose, excitation.frequencies, excitation.harmonics)
    except ValueError as error:
        raise lines_not_found_error(manifest, f"stereo pair {first.sight.name}", error) from error
    return base.add_clock_uncertainty(lines, base.sight_errors(first.sight)), first.sight
