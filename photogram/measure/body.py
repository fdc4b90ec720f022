"""Rigid motion of a body and the deformation of its points, from tracked frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import groupby
from typing import TypeVar

import numpy as np

from photogram.camera import Points3D, Rig, StereoRig, locate
from photogram.direct.direct_fit import DirectFit, rest_covariance, rigid_share
from photogram.direct.surface import ShapeAmplitudes
from photogram.frame_statistics import RunningMean, Sample
from photogram.geometry import RigidTransform
from photogram.images.image_notices import BODY_DEFORMS, FRAMES_WITHOUT_GREY_FIT, GREY_FIT_DISAGREES, SENSOR_SATURATES
from photogram.images.noise import NoiseModel
from photogram.images.sequence import ImageSequence
from photogram.measure.fixed_pattern import FixedPattern, fixed_pattern
from photogram.measure.follow import (
    CAMERAS,
    BodyPrior,
    BodyScene,
    BodyTracker,
    FollowedBlock,
    FollowedFrame,
    Progress,
    Registrations,
    central_point,
    image_motion_px,
    iterate_blocks,
    prepare_body,
    report_progress,
)
from photogram.motion import Deformation, DeformationMean, RigidMotion, fit_motion, overlap_correlation
from photogram.subsets.find import BodyNotFound, DepthRange
from photogram.subsets.icgn import TrackSettings, subset_noise, subset_positions
from photogram.subsets.texture import SubsetQuality, assess_subsets
from photogram.subsets.track import (
    EpipolarMonitor,
    StereoTracks,
    Tracks,
    build_tracks,
    drop_rejected,
)
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray
from shakercal._common.notices import Notice

_Part = TypeVar("_Part", Tracks, Points3D, RigidMotion)
MAX_CACHED_POSITIONS = 500_000  # subsets times frames of a series that is cached with its points: about 100 MB
LARGEST_BENDING = 4.0  # rms, in standard deviations of the points; the reference's noise makes it 1.4
LARGEST_DIFFERENCE = 2.0  # rms, in standard uncertainties of the motion of the points


@dataclass(frozen=True, eq=False, repr=False)
class BodyMotion(Arrays):
    """Motion of a body in the images of one or two cameras.

    Attributes
    ----------
    motion : fitted to the grey values of all pixels, without the effect of the sensors' fixed pattern.
    motion_of_points : fitted to the points alone, in the frames with subsets.
    shape_amplitudes : deformation in addition to the motion, by the shapes it was prepared with (by default
        `direct.surface.PlainShapes`).
    subset_frames : (F,) in which subsets were searched; the other frames have a motion with residual NaN and no points.
    reprojection_px : rms.
    subsets_px : first positions of the subsets in the left camera.
    sigma_px : standard deviation of their positions due to noise, median over subsets and frames.
    zncc : median in the left camera.
    subset_zncc : (N,) of each subset in the left camera, mean over the frames.
    noise : noise models of each camera, None when no frame could be fitted to the grey values.
    quality : of each camera, prediction of the subsets' precision, None as above.
    pattern : effect of the sensors' fixed pattern, None as above.
    notices : of tracking, subsets and the rigid fit.
    tracked, surface : iterate over subsets and points, and over the deformation, some frames at a time, computed anew
        from the tracked frames. `tracks` and `points` are those of all frames at once.
    """

    motion: RigidMotion
    motion_of_points: RigidMotion
    shape_amplitudes: ShapeAmplitudes
    subset_frames: BoolArray
    reprojection_px: float
    subsets_px: FloatArray
    sigma_px: float
    zncc: float
    subset_zncc: FloatArray
    noise: tuple[NoiseModel, ...] | None
    quality: tuple[SubsetQuality, ...] | None
    pattern: FixedPattern | None
    notices: tuple[Notice, ...]
    tracked: TrackedSubsets
    surface: SurfaceDeformation

    @cached_property
    def tracks(self) -> StereoTracks:
        """Subsets of all frames with subsets, about 500 bytes for each."""
        sides = zip(*(block.cameras for block in self.tracked), strict=True)
        return replace(self.tracked.summary, cameras=tuple(_joined(side, "noise_grey") for side in sides))

    @cached_property
    def points(self) -> Points3D:
        """Points of these frames, in the body's frame, 100 bytes for each in every frame."""
        return _joined([points for _, points in self.tracked.with_points()])


def measure_body(
    images: tuple[ImageSequence, ...],
    rig: Rig,
    body_from_left: RigidTransform,
    settings: TrackSettings,
    progress: Progress | None = None,
    device: str = "cpu",
    depth_m: DepthRange | None = None,
) -> BodyMotion:
    """Track a body through the images and fit its six components of motion.

    Subsets are tracked. The motion that brings the body to their positions (`surface.motion_from_positions`) is the
    start of a fit to the grey values (`direct_fit.fit_direct`), weighted by the noise of the first frame so fitted. The
    effect of the sensors' fixed pattern is corrected (`fixed_pattern.fixed_pattern`). A frame in which the fit fails
    has the motion of its points (`motion.fit_motion`). `prepare_body`, `follow_block` for each of the blocks and
    `body_motion` are the same in parts, for several threads.

    Parameters
    ----------
    images
        Left and right, or one of a single camera.
    rig
        Calibrated pair; a single camera states the face that it shows.
    body_from_left
        Frame of the body, about whose origin it moves.
    settings
        Of the subsets.
    progress
        Called with the number of finished images, 1…2F; default None.
    device
        'cpu' (default) or 'cuda'.
    depth_m
        Nearest and farthest possible depth in the left camera, for repeating patterns; default None.

    Returns
    -------
    BodyMotion
        Poses in m and rad with covariances, deformation, and notices.

    Raises
    ------
    BodyNotFound
        Where the images do not show the body, or its pattern repeats so that its position is undetermined.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> rng = np.random.default_rng(1)
    >>> image = np.rint(128 + 300 * gaussian_filter(rng.standard_normal((96, 96)), 2.0, mode="wrap")).astype(np.uint8)
    >>> def camera_images(shift_px):  # a body that moves one pixel to the right between two noisy frames
    ...     frames = [np.roll(image, shift_px + k, axis=1) + rng.integers(0, 3, (96, 96), np.uint8) for k in (0, 1)]
    ...     return ImageSequence(("before", "after"), (96, 96), 255, lambda k: frames[k])
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 48, 48, 0, 0, 0, 0, 0]), np.array([96, 96]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.005, 0.0, 0.0])))
    >>> images, body_from_left = (camera_images(0), camera_images(-5)), RigidTransform(np.eye(3), -np.eye(3)[2])
    >>> body = measure_body(images, rig, body_from_left, TrackSettings(radius_px=7))
    >>> f"{1e3 * body.motion.pose[1, 0]:.1f} mm"
    '1.0 mm'
    """
    prior = BodyPrior(depth_m)
    scene = prepare_body(images, rig, body_from_left, settings, device, progress, prior)
    return body_motion(scene, [follow_block(scene, block, device, progress) for block in scene.blocks])


def follow_block(
    scene: BodyScene, frames: range, device: str = "cpu", progress: Progress | None = None
) -> FollowedBlock:
    """Track the body through a block of later frames."""
    followed = []
    for number, one in zip(frames, _found(BodyTracker(scene), frames, device), strict=True):
        followed.append(one)
        report_progress(progress, number + 1)
    return tuple(followed)


def _found(tracker: BodyTracker, frames: range, device: str) -> Iterator[FollowedFrame]:
    """Yield the body and its subsets in some frames in turn, none for absent frames."""
    scene = tracker.scene
    for absent, group in groupby(frames, scene.body.is_absent):
        numbers = list(group)
        run = range(numbers[0], numbers[-1] + 1)
        if absent:
            yield from (tracker.add_frame(None, None) for _ in run)
        elif device != "cpu" and not scene.body.rolling_shutter:
            from photogram.measure.follow_torch import find_in_batches

            yield from find_in_batches(tracker, run, device)
        else:
            yield from map(tracker.find, run, zip(*(images.read_ahead(run) for images in scene.images), strict=True))


def body_motion(scene: BodyScene, blocks: Iterable[FollowedBlock]) -> BodyMotion:
    """Return the motion of the body from the tracked blocks of a scene.

    The blocks, a list or a reader from disk, are iterated twice, one at a time, and again for each use of subsets or
    points.
    """
    tracked, fits, pattern = _tracked(scene, blocks)
    settings, references, noise = scene.settings, scene.references, scene.noise
    quality, remarks = None, list[Notice]()
    if noise is not None:
        sides = zip(references, scene.first, noise, scene.images, strict=True)
        quality = tuple(
            assess_subsets(reference, first, model, side.saturation) for reference, first, model, side in sides
        )
        named = zip(CAMERAS, quality, strict=False)
        remarks = [*scene.noise_notices, *(notice for where, predicted in named for notice in predicted.notices(where))]
    shared = None
    if settings.grid_step_px <= 2 * settings.radius_px:
        shared = overlap_correlation(scene.grid.left_px, settings.radius_px)
    sums = _Sums()
    for block, points in tracked.with_points():
        if sums.mean is None:
            seen = int(np.count_nonzero(np.isfinite(points.position_m[0]).all(axis=1)))  # also in a later frame
            if seen < 3:
                text = f"at least 3 points that every camera shows in a later frame, found {seen}"
                raise BodyNotFound(f"rig: expected {text}")
            sums.mean, sums.subsets_px = DeformationMean(points.position_m[0]), block.left.position_px[0]
        of_points = fit_motion(points, sums.mean.reference_m, np.zeros(3), shared)
        numbers = tracked.frames[sums.frames : sums.frames + len(of_points.pose)]
        sums.add(block, points, of_points, fits.merged(of_points, numbers))
    assert sums.mean is not None
    of_points = _joined(sums.of_points, "origin_m")
    motion, missing = fits.of_all(of_points, tracked.frames), fits.count_missing(scene.body)
    notices = (
        *tracked.summary.notices,
        *remarks,
        *_rigid_notices(sums, _of_frames(motion, tracked.frames), of_points, missing),
    )
    correction = 0.0 if pattern is None else pattern.correction
    return BodyMotion(
        motion=replace(motion, pose=motion.pose + correction),
        motion_of_points=of_points,
        shape_amplitudes=ShapeAmplitudes(
            scene.shapes, fits.amplitude, fits.amplitude_covariance, rigid_share(scene.views)
        ),
        subset_frames=np.isin(np.arange(len(motion.pose)), tracked.frames),
        reprojection_px=float(np.sqrt(sums.reprojection[0] / (sums.reprojection[1] or np.nan))),
        subsets_px=sums.subsets_px,
        sigma_px=float(np.sqrt(sums.variance_px2.median)),
        zncc=sums.zncc.median,
        subset_zncc=sums.subset_zncc.mean,
        noise=noise,
        quality=quality,
        pattern=pattern,
        notices=notices,
        tracked=tracked,
        surface=SurfaceDeformation(sums.mean, motion, tracked),
    )


# Iteration over the tracked frames, some at a time.


@dataclass(frozen=True, eq=False, repr=False)
class TrackedSubsets(Arrays, shapes="frames S; residual_frames R; pose S 6"):
    """Tracked subsets of a body, some frames at a time, repeatedly.

    Attributes
    ----------
    frames : (S,) in which subsets were searched.
    residual_frames : those of them with a direct fit.
    pose : (S, 6) of the body in these frames.
    noise_grey : image noise (N,) at the subsets of each camera, over these frames.
    summary : properties of the cameras and notices.
    cached_blocks : all frames of a short series with points, after the first iteration.
    """

    scene: BodyScene
    blocks: Iterable[FollowedBlock]
    frames: IntArray
    residual_frames: IntArray
    pose: FloatArray
    noise_grey: tuple[FloatArray, ...]
    monitor: EpipolarMonitor
    summary: StereoTracks
    cached_blocks: list[tuple[StereoTracks, Points3D]] = field(default_factory=list)

    def __iter__(self) -> Iterator[StereoTracks]:
        return (tracks for tracks, _ in self.cached_blocks) if self.cached_blocks else self._computed()

    def with_points(self) -> Iterator[tuple[StereoTracks, Points3D]]:
        """Yield some frames at a time with the points of their subsets.

        In the body's frame.
        """
        if self.cached_blocks:
            yield from self.cached_blocks
            return
        short = len(self.frames) * len(self.scene.grid.left_px) <= MAX_CACHED_POSITIONS
        seen, start = [], 0
        for tracks in self._computed():
            stop = start + len(tracks.left.position_px)
            both, start = (tracks, self._points(tracks, self.pose[start:stop])), stop
            if short:
                seen.append(both)
            yield both
        self.cached_blocks.extend(seen)

    def fits(self) -> Iterator[list[DirectFit]]:
        """Yield the direct fits of the `residual_frames`, some at a time."""
        for block in iterate_blocks(self.scene, self.blocks):
            yield [fit for found, fit in block if found is not None and fit is not None]

    def _computed(self) -> Iterator[StereoTracks]:
        for block in iterate_blocks(self.scene, self.blocks):
            found = [both for both, _ in block if both is not None]
            if not found:
                continue
            cameras = tuple(
                build_tracks(
                    [both[side] for both in found], self.scene.references[side], self.scene.settings.degree, noise
                )
                for side, noise in enumerate(self.noise_grey)
            )
            rejected = self.monitor.find_rejected(tuple(camera.position_px for camera in cameras))
            yield replace(self.summary, cameras=drop_rejected(cameras, rejected))

    def _points(self, tracks: StereoTracks, pose: FloatArray) -> Points3D:
        """Return points of some frames, in the body's frame.

        Those of a single camera lie on the face in its `pose` (F, 6).
        """
        rig, placed, moved = self.scene.rig, self.scene.body_from_left, None
        if not isinstance(rig, StereoRig):
            turns = (placed.inverse() @ RigidTransform.from_pose(one) @ placed for one in np.nan_to_num(pose))
            moved = np.array([turn.pose for turn in turns])
        positions = [camera.position_px for camera in tracks.cameras]
        return locate(rig, positions, [camera.covariance_px2 for camera in tracks.cameras], moved).transformed(placed)


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceDeformation(Arrays):
    """Deformation of the points of a body, some frames at a time, repeatedly."""

    mean: DeformationMean
    motion: RigidMotion
    tracked: TrackedSubsets

    def __iter__(self) -> Iterator[Deformation]:
        start = 0
        for block, points in self.tracked.with_points():
            stop = start + len(block.left.position_px)
            yield self.mean.of(points, _of_frames(self.motion, self.tracked.frames[start:stop]))
            start = stop


@dataclass(frozen=True, eq=False, repr=False)
class _Fits(Arrays, shapes="pose F 6; covariance F 6 6; amplitude F S; amplitude_covariance F S S; misfit F V 2"):
    """Direct fits of all frames, NaN for none; the first frame has a typical covariance."""

    pose: FloatArray
    covariance: FloatArray
    amplitude: FloatArray
    amplitude_covariance: FloatArray
    misfit: FloatArray

    def count_missing(self, body: BodyPrior) -> tuple[int, int]:
        """Return how many later frames have no fit, and how many there are."""
        later = [number for number in range(1, len(self.pose)) if not body.is_absent(number)]
        return int(np.count_nonzero(~np.isfinite(self.pose[later, 0]))), len(later)

    def merged(self, of_points: RigidMotion, frames: IntArray) -> RigidMotion:
        """Return the motion of points in some frames, replaced where there is a direct fit."""
        pose, covariance = self.pose[frames], self.covariance[frames]
        fitted = np.asarray(np.isfinite(pose).all(axis=1))
        typical = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
        return replace(
            of_points,
            pose=np.where(fitted[:, None], pose, of_points.pose),
            covariance=np.where(typical[:, None, None], covariance, of_points.covariance),
        )

    def of_all(self, of_points: RigidMotion, frames: IntArray) -> RigidMotion:
        """Return the motion of all frames, by direct fits where available, else by points."""
        merged = self.merged(of_points, frames)
        pose, covariance = self.pose.copy(), self.covariance.copy()
        residual_m, points = np.full(len(pose), np.nan), np.zeros(len(pose), np.int64)
        pose[frames], covariance[frames] = merged.pose, merged.covariance
        residual_m[frames], points[frames] = merged.residual_m, merged.points
        return RigidMotion(pose, covariance, residual_m, points, merged.origin_m)


class _Sums:
    """Running sums over the subsets and points of a body."""

    def __init__(self) -> None:
        self.mean: DeformationMean | None = None
        self.subsets_px: FloatArray = np.empty((0, 2))
        self.frames, self.reprojection = 0, (0.0, 0)
        self.of_points: list[RigidMotion] = []
        self.variance_px2, self.variance_m2, self.zncc = Sample(), Sample(), Sample()
        self.subset_zncc = RunningMean()

    def add(self, tracks: StereoTracks, points: Points3D, of_points: RigidMotion, motion: RigidMotion) -> None:
        """Add further frames."""
        assert self.mean is not None
        self.mean.add(points, motion)
        squares = points.reprojection_px**2
        total, count = self.reprojection
        self.reprojection = total + float(np.nansum(squares)), count + int(np.count_nonzero(np.isfinite(squares)))
        sides = [np.diagonal(side.covariance_px2, axis1=2, axis2=3) for side in tracks.cameras]
        self.variance_px2.add(np.stack(sides, axis=1))
        self.zncc.add(tracks.left.zncc)
        self.subset_zncc.add(tracks.left.zncc)
        variance = np.trace(points.covariance_m2, axis1=2, axis2=3) / 3.0
        first = 1 if self.frames == 0 else 0
        self.variance_m2.add(np.where(np.isfinite(of_points.residual_m)[:, None], variance, np.nan)[first:])
        self.frames += len(squares)
        self.of_points.append(of_points)


def _tracked(scene: BodyScene, blocks: Iterable[FollowedBlock]) -> tuple[TrackedSubsets, _Fits, FixedPattern | None]:
    """Iterate over the tracked frames for noise, notices, direct fits, and their fixed pattern."""
    monitor = EpipolarMonitor(scene.rig if isinstance(scene.rig, StereoRig) else None)
    noise = tuple(RunningMean() for _ in scene.images)
    levels, frames, fits = list[float](), list[int](), list[tuple[FloatArray, ...]]()
    shapes, cameras = scene.views[0].rates.shape[2] - 6, len(scene.views)
    missing = tuple(np.full(shape, np.nan) for shape in (6, (6, 6), shapes, (shapes, shapes), (cameras, 2)))
    centres = tuple(map(central_point, scene.seen))
    for block in iterate_blocks(scene, blocks):
        for with_subsets, group in groupby(block, lambda one: one[0] is not None):
            run = list(group)
            if with_subsets:
                frames += range(len(fits), len(fits) + len(run))
                _add_subsets(scene, [both for both, _ in run if both is not None], monitor, noise)
            for _, fit in run:
                if fit is None:
                    fits.append(missing)
                else:
                    fits.append((fit.moved.pose, fit.covariance, fit.amplitude, fit.amplitude_covariance, fit.misfit))
                levels += [] if fit is None else [fit.noise_ratio]
                if fit is not None and not with_subsets:
                    monitor.add_motion(tuple(image_motion_px(centre, fit.moved)[0] for centre in centres))
    if levels:
        fits[0] = (missing[0], rest_covariance(scene.views, float(np.median(levels))), *missing[2:])
    grey = tuple(np.sqrt(side.mean) for side in noise)
    whole, numbers, pattern = _Fits(*map(np.array, zip(*fits, strict=True))), np.array(frames), None
    with_residuals = numbers[np.isfinite(whole.pose[numbers, 0])]
    if levels:
        known = [images.pattern for images in scene.images]
        full_scales = [float(images.full_scale) for images in scene.images]
        shown = _displaced(scene)
        if not any(notice.code == SENSOR_SATURATES.code for notice in scene.noise_notices):  # whose misfit grows too
            shown = np.concatenate([shown[0], whole.pose]), np.concatenate([shown[1], whole.misfit])
        pattern = fixed_pattern(scene.views, known, full_scales, scene.settings.degree, whole.pose, shown)
    white = grey if pattern is None else _with_pattern(scene, grey, pattern)
    summary = monitor.summarize(scene.first, scene.grid, scene.settings, white)
    tracked = TrackedSubsets(scene, blocks, numbers, with_residuals, whole.pose[numbers], grey, monitor, summary)
    return tracked, whole, pattern


def _displaced(scene: BodyScene) -> tuple[FloatArray, FloatArray]:
    """Return poses (D, 6) and misfits (D, V, 2) of the displaced body."""
    images = scene.body.displaced
    frames = zip(*(one.read_ahead(range(len(one))) for one in images), strict=True)
    found = [fit for frame in frames if (fit := BodyTracker(scene).find(0, frame)[1]) is not None]
    pose, misfit = [fit.moved.pose for fit in found], [fit.misfit for fit in found]
    return np.array(pose).reshape(-1, 6), np.array(misfit).reshape(-1, len(scene.views), 2)


def _with_pattern(
    scene: BodyScene, noise_grey: tuple[FloatArray, ...], pattern: FixedPattern
) -> tuple[FloatArray, ...]:
    """Return the noise of the first image at the subsets, fixed pattern included."""
    whole = []
    for side, grey in enumerate(noise_grey):
        mean2 = np.array(np.mean(scene.references[side].mean ** 2))
        fixed = pattern.patterns[side].variance(mean2, float(scene.images[side].full_scale))
        whole.append(np.sqrt(grey**2 + np.maximum(pattern.variance[side, 0], 0.0) * fixed))
    return tuple(whole)


def _add_subsets(
    scene: BodyScene, found: Sequence[Registrations], monitor: EpipolarMonitor, noise: tuple[RunningMean, ...]
) -> None:
    """Add the subsets of successive frames to monitor and noise."""
    sides = [list(side) for side in zip(*found, strict=True)]
    positions, statuses = zip(
        *(subset_positions(*both) for both in zip(sides, scene.references, strict=True)), strict=True
    )
    monitor.add(positions, statuses)
    for running, side, reference in zip(noise, sides, scene.references, strict=True):
        running.add(subset_noise(side, reference, scene.settings.degree) ** 2)


def _of_frames(motion: RigidMotion, frames: IntArray) -> RigidMotion:
    """Return the motion in some frames."""
    selected = {name: getattr(motion, name)[frames] for name in ("pose", "covariance", "residual_m", "points")}
    return replace(motion, **selected)


def _joined(parts: Sequence[_Part], constant: str = "") -> _Part:
    """Return arrays of several runs of frames in one; `constant` is the same in all."""
    names = [field.name for field in fields(parts[0]) if field.name != constant]
    return replace(parts[0], **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _rigid_notices(sums: _Sums, motion: RigidMotion, of_points: RigidMotion, failed: tuple[int, int]) -> list[Notice]:
    """Return notices of departures from a rigid motion."""
    notices, where = list[Notice](), "rigid motion"
    finite = np.isfinite(of_points.residual_m[1:])
    if finite.any():
        misfit, noise = np.median(of_points.residual_m[1:][finite]), np.sqrt(sums.variance_m2.median)
        if misfit >= LARGEST_BENDING * noise:
            notices.append(Notice(BODY_DEFORMS, where, misfit_um=1e6 * misfit, ratio=misfit / noise))
    if failed[0]:
        notices.append(Notice(FRAMES_WITHOUT_GREY_FIT, where, failed=failed[0], frames=failed[1]))
    difference = (motion.pose - of_points.pose)[1:]
    both = np.isfinite(difference).all(axis=1)
    squares = difference[both] ** 2 / np.diagonal(of_points.covariance[1:], axis1=1, axis2=2)[both]
    ratio = float(np.sqrt(np.mean(squares))) if both.any() else 0.0
    if ratio > LARGEST_DIFFERENCE:
        notices.append(Notice(GREY_FIT_DISAGREES, where, ratio=ratio))
    return notices
