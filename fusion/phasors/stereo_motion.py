"""Images and points of a stereo pair, opened and checked, and their rigid motion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import ComputeError, InputError, as_input_error
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
from fusion.phasors.timing import Sight, TimeBase, frame_edges, frame_sight, lines_not_found_error, shared_edges
from fusion.recording.daq_records import FileCache
from fusion.recording.load import Manifest
from fusion.recording.manifest import MINIMUM_FRAMES, Images, PointFiles
from fusion.recording.rig import Stereo
from fusion.recording.transducer import STATIONARY
from fusion.recording.values import FILE, SensorOfCamera, SurfacePlane
from photogram.calibration.calibration_file import read_calibration, read_camera
from photogram.camera import FaceCamera, Rig, StereoRig
from photogram.geometry import RigidTransform
from photogram.images.image_files import open_sequence
from photogram.images.sensor_pattern import stated_pattern
from photogram.images.sequence import (
    GreyImage,
    ImageSequence,
    find_copied_frames,
    inspect_first_image,
    numbers_of_names,
)
from shaker.lines.frequencies import LineFrequencies, find_lines
from shaker.sine.aliasing import usable_lines
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineFit, SineModel
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.sensitivity.mode_shapes import ModeShapes
    from photogram.direct.surface import ShapeAmplitudes
    from photogram.images.noise import NoiseModel
    from photogram.measure.body import BodyMotion
    from photogram.measure.epipolar import EpipolarCheck
    from photogram.measure.fixed_pattern import FixedPattern
    from photogram.motion import Deformation, RigidMotion
    from photogram.subsets.texture import SubsetQuality
    from photogram.subsets.track import StereoTracks


MAX_SATURATED = 0.02  # fraction of pixels at full scale above which a camera is refused
SAME_EXPOSURE = 0.02  # relative difference of equal exposures
SAME_RATE = 0.01  # of frames on the camera's clock and of edges on that of a DAQ
MOST_NAMED = 5  # frames in a notice
MIN_POSITIONS = 3  # on a body that determine its depth
NO_MOTION = "no frame has enough points for a rigid motion"


@dataclass(frozen=True)
class PreparedImages:
    """The images of one stereo pair, opened and checked.

    `sight`; `cameras`: images of each camera; `rig`; `first`: the first left image. `notices`: of the files and their
    contradictions to the manifest. `depth_m`: nearest and farthest depth in the left camera at which its body can be
    (`depth_range_m`), None if not known. `modes`: of an elastic load, with measurable amplitudes. `entry`: as the
    manifest states them. `copied` (F,): frames in which a camera repeats an earlier one. `displaced`: further images of
    each camera, of the displaced body.
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
    displaced: tuple[ImageSequence, ...]

    @property
    def left(self) -> ImageSequence:
        """Images of the left camera, or of the only one."""
        return self.cameras[0]


@dataclass(frozen=True, eq=False)
class PhaseRotated:
    """Frames fitted cell by cell, with row delays corrected at K lines.

    `pose` (F, K, p): six components and p - 6 shapes, in addition to the reference motion. `response` (K, p, p): effect
    of a motion on them; `reference_motion` (K, p): that of the reference. `row_delay` (6, 6): number of rows after the
    first one at which a motion is measured. `delay_s` (N,): of the rows at the points of the surface. `side_px`: of the
    cells.
    """

    pose: ComplexArray
    response: ComplexArray
    reference_motion: ComplexArray
    row_delay: FloatArray
    delay_s: FloatArray
    side_px: int

    def motion(self, time_s: FloatArray, fit: SineFit) -> Phasors:
        """Return the phasors (K, 6) of the body at the lines: means over an exposure."""
        return self._restored(time_s, fit, slice(0, 6), self.reference_motion[:, :6], lambda _, found: found.phasors)

    def shapes(
        self, time_s: FloatArray, fit: SineFit, motion: Phasors, noise: Callable[[FloatArray, SineFit], Phasors]
    ) -> Phasors:
        """Return the amplitudes (K, S) of shapes beyond that motion, by a model of `noise`."""
        moved = np.einsum("kij,kj->ki", self.response[:, 6:, :6], motion.value)
        return self._restored(time_s, fit, slice(6, None), self.reference_motion[:, 6:] - moved, noise)

    def _restored(
        self,
        time_s: FloatArray,
        fit: SineFit,
        columns: slice,
        offset: ComplexArray,
        noise: Callable[[FloatArray, SineFit], Phasors],
    ) -> Phasors:
        """Return G⁻¹·(A + jB + `offset`).

        A and B are the phasors of real and imaginary part of the pose. A motion Re{X exp(jωt)} appears in a rotated
        pose as G·X·exp(jωt)/2 and a part of opposite rotation. With the parts Re{A exp(jωt)} and Re{B exp(jωt)} that is
        (A + jB)/2.
        """
        frequency_hz, model = fit.phasors.frequency_hz, SineModel(robust=True)
        names, unit = fit.phasors.channels, fit.phasors.unit
        both = (*(f"Re {name}" for name in names), *(f"Im {name}" for name in names))
        inverse, unity, lines = np.linalg.inv(self.response[:, columns, columns]), np.eye(len(names)), list[Phasors]()
        for k in range(len(frequency_hz)):
            series = np.concatenate([self.pose[:, k, columns].real, self.pose[:, k, columns].imag], axis=1)
            found = noise(series, fit_sines(time_s, series, frequency_hz, both, unit * 2, model=model))
            matrix = inverse[k] @ np.hstack([unity, 1j * unity])
            lines.append(found.at_lines(np.array([k])).combined(matrix[None], names, unit))
        value, covariance = (np.concatenate([getattr(one, name) for one in lines]) for name in ("value", "covariance"))
        value = value + np.einsum("kij,kj->ki", inverse, offset)
        dof = np.concatenate([one.dof for one in lines])
        return replace(fit.phasors, value=value, covariance=covariance, dof=dof)


@dataclass(frozen=True)
class ImageView:
    """Tracking results of the images of one stereo pair.

    Tracked subsets of some frames at a time, their rig, the first left image, the noise models of its cameras and the
    predicted quality of subsets. `epipolar`: whether the pair is as calibrated (None for a single camera). `deformed`:
    deformation in shapes, from all pixels. `pattern`: effect of the sensors' fixed pattern. Medians: `sigma_px` of
    positions by noise, and `zncc` in the left camera; `subset_zncc` (N,): mean of each subset.
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
    pattern: FixedPattern | None = None
    phase_rotated: PhaseRotated | None = None
    subset_zncc: FloatArray | None = None


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
    """A stereo pair without a motion, and the error that is the reason."""

    name: str
    error: InputError | ComputeError

    @property
    def notice(self) -> Notice:
        """Return the warning that the other instruments are evaluated without the pair."""
        return Notice(PAIR_REJECTED, f"stereo pair {self.name}", reason=self.error.sentence.rstrip("."))


def sensor_from_camera(stereo: Stereo) -> RigidTransform:
    """Return the pose of the left camera, or of the points, in the sensor frame."""
    return RigidTransform(np.array(stereo.rotation), np.array(stereo.translation))


def prepare_images(
    manifest: Manifest, base: TimeBase, entry: Images, already: FileCache | None = None
) -> PreparedImages:
    """Open the images of one stereo pair and check them before tracking."""
    key, sequences, cached = f"images.{entry.stereo}", [], {} if already is None else already.images
    for side, paths in entry.cameras:
        with as_input_error(manifest.path, f"{key}.{side}"):
            sequence = cached.get((paths, entry.bit_depth)) or open_sequence(paths, entry.bit_depth)
            sequences.append(sequence)
    chosen, stated = list[IntArray](), isinstance(entry.first_edge, dict)
    if stated:
        numbering, counts = [images.numbers for images in sequences], [len(images) for images in sequences]
        edges, chosen = shared_edges(manifest, base, entry, numbering, counts)
        sequences = [images.select(frames) for images, frames in zip(sequences, chosen, strict=True)]
        entry = entry.model_copy(update={"first_edge": int(edges[0])})
    left = sequences[0]
    for other in sequences[1:]:
        if len(left) != len(other):
            found, expected = f"{len(other)} images", f"{len(left)} as on the left, or `first_edge` of each camera"
            raise InputError(IMAGES_REFUSED, manifest.path, f"{key}.right", found=found, expected=expected)
    if len(left) < MINIMUM_FRAMES:
        found, expected = f"{len(left)} in {entry.left[0].name}", f"at least {MINIMUM_FRAMES} frames"
        raise InputError(IMAGES_REFUSED, manifest.path, f"{key}.left", found=found, expected=expected)
    if entry.exposure == FILE:
        entry = entry.model_copy(update={"exposure": _stated_exposure(manifest, entry, sequences)})
    numbers = {side: images.numbers for (side, _), images in zip(entry.cameras, sequences, strict=True)}
    edges, remarks = (edges - edges[0], ()) if stated else frame_edges(manifest, base, entry, numbers, len(left))
    sight = frame_sight(manifest, base, entry, edges, max(images.size_px[1] for images in sequences))
    sight = replace(sight, files=tuple(chosen))
    rig = read_rig(sight.pair, sequences)
    first = []
    for number, (side, _) in enumerate(entry.cameras):
        with as_input_error(manifest.path, f"{key}.{side}"):
            first.append(sequences[number].read(0))
            sequences[number] = inspect_first_image(
                replace(sequences[number], most_saturated=MAX_SATURATED), first[number]
            )
        sequences[number] = _with_pattern(manifest, sight, side, sequences[number])
        first[number] = sequences[number].without_pattern(first[number])
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
    whole = replace(sight, pair=pair), tuple(sequences), rig, first[0], tuple(notices), depth_m, modes, entry, copied
    return PreparedImages(*whole, _displaced(manifest, entry, sequences))


def _displaced(manifest: Manifest, entry: Images, sequences: Sequence[ImageSequence]) -> tuple[ImageSequence, ...]:
    """Return the images of the displaced body of each camera, corrected as the others."""
    found = []
    for (key, files), images in zip(entry.displaced, sequences, strict=False):
        with as_input_error(manifest.path, f"images.{entry.stereo}.{key}"):
            opened = open_sequence(files, entry.bit_depth)
            if opened.size_px != images.size_px:
                size, other = ("{} x {} px".format(*one.size_px) for one in (images, opened))
                raise ValueError(f"{opened.names[0]}: expected {size} as of {images.names[0]}, found {other}")
        found.append(replace(opened, flat_field=images.flat_field, pattern=images.pattern))
    return tuple(found)


def _with_pattern(manifest: Manifest, sight: Sight, side: str, images: ImageSequence) -> ImageSequence:
    """Return a camera's images with its fixed pattern as stated, or corrected."""
    stated: SensorOfCamera = getattr(sight.pair, side) or SensorOfCamera()
    if not (stated.dark or stated.flat):
        return replace(images, pattern=stated_pattern(stated.prnu, stated.dsnu))
    from photogram.images.flat_field import corrected_sequence, flat_field

    bits = images.full_scale.bit_length()
    with as_input_error(manifest.rig_path, f"stereo.{sight.name}.{side}"):
        dark, flat = (open_sequence(files, bits) if files else None for files in (stated.dark, stated.flat))
        return corrected_sequence(images, flat_field(images, dark, flat))


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
    """Return warnings where a camera's file contradicts exposure and frame times."""
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


def motion_from_tracks(images: PreparedImages, body: BodyMotion) -> StereoMotion:
    """Return the motion of a stereo pair's body from its tracks."""
    from photogram.measure.epipolar import check_epipolar
    from photogram.subsets.find import BodyNotFound

    if not np.isfinite(body.motion.pose).all(axis=1).any():
        with as_input_error(*images.sight.where):
            raise BodyNotFound(NO_MOTION)
    epipolar, notices = None, tuple[Notice, ...]([Notice(SINGLE_CAMERA_NOT_ASSESSED, "camera")])
    if isinstance(images.rig, StereoRig):
        epipolar = check_epipolar(body.tracked, images.rig, body.subset_frames)
        notices = epipolar.notices
    others = body.shape_amplitudes, body.sigma_px, body.zncc, body.pattern
    return StereoMotion(
        images.sight,
        body.motion,
        body.surface,
        body.reprojection_px,
        ImageView(
            *(body.tracked, images.rig, images.first, body.noise, body.quality, epipolar, *others),
            subset_zncc=body.subset_zncc,
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
    """Read a stereo pair's calibration; raise `InputError` for another file or image size."""
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
    """Return the camera of a file before its stated surface, with both uncertainties."""
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
