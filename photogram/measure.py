"""One body through a series of stereo images: tracked subsets, points, and its rigid motion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, groupby

import numpy as np

from photogram.arrays import Arrays, FloatArray, Notice, RunningMean, Sample
from photogram.bspline import Spline, spline_of_image
from photogram.camera import Points, StereoRig, triangulate
from photogram.direct.fit import (
    BodyView,
    DirectFit,
    fit_direct,
    image_noise,
    rest_covariance,
    reweighted_view,
    view_body,
)
from photogram.geometry import RigidTransform
from photogram.images.noise import NoiseModel
from photogram.images.sequence import ImageSequence
from photogram.motion import (
    Deformation,
    DeformationMean,
    PlacedCamera,
    RigidMotion,
    SeenPoints,
    fit_motion,
    motion_of_places,
    overlap_correlation,
    see_points,
)
from photogram.subsets.find import BodyNotFound, DepthRange, identity
from photogram.subsets.icgn import Registration, TrackSettings
from photogram.subsets.reference import Reference
from photogram.subsets.texture import SubsetQuality, assess
from photogram.subsets.track import (
    FollowedFrame,
    StereoCourse,
    StereoGrid,
    StereoTracks,
    Told,
    Tracks,
    follow_sequence,
    lay_stereo_grid,
    noise_of,
    places_of,
    prepare_sequence,
    tracks_of,
    without_aside,
)

Progress = Callable[[int], None]
Splines = tuple[Spline, Spline]
Noise = tuple[NoiseModel, NoiseModel]
Found = tuple[Registration, Registration]
UNIFORM = NoiseModel(1.0, 0.0)
BLOCK_FRAMES = 32
"""A constant, so that results do not depend on who computes them; few enough to share, many enough to start seldom."""
GPU_BLOCK_FRAMES = 1024
"""On a GPU, which follows frames in batches: more than most series have, few enough to hold."""
MOST_HELD = 500_000  # subsets times frames of a series that is held with its points: some 100 MB
LARGEST_BENDING = 4.0  # rms, in standard deviations of the points; the reference's noise makes it 1.4
LARGEST_DIFFERENCE = 2.0  # rms, in standard uncertainties of the motion of the points


@dataclass(frozen=True, eq=False, repr=False)
class BodyMotion(Arrays):
    """The motion of a body seen by a stereo pair, and what the user should know.

    motion: fitted to the grey values of all pixels, `motion_of_points` to the points alone. Of the left and the right
    camera: noise models, and quality, what the subsets promised before they were tracked; None when no frame could be
    fitted to the grey values. subsets_px: where the left camera sees the subsets first; medians over subsets and
    frames: sigma_px, standard deviation that the noise gives to their positions, and `zncc` in the left camera.
    `tracked` and `surface` go through the subsets and points, and what these do beside the motion, some frames at a
    time, made anew from what was followed; `tracks` and `points` are those of all frames at once.
    """

    motion: RigidMotion
    motion_of_points: RigidMotion
    reprojection_px: float
    subsets_px: FloatArray
    sigma_px: float
    zncc: float
    noise: Noise | None
    quality: tuple[SubsetQuality, SubsetQuality] | None
    notices: tuple[Notice, ...]
    tracked: Tracked
    surface: Surface

    @cached_property
    def tracks(self) -> StereoTracks:
        """Subsets of all frames, some 500 bytes for each in every frame."""
        blocks = list(self.tracked)
        left, right = (
            Tracks(
                np.concatenate([track.position_px for track in side]),
                np.concatenate([track.covariance_px2 for track in side]),
                np.concatenate([track.zncc for track in side]),
                np.concatenate([track.status for track in side]),
                side[0].noise_grey,
            )
            for side in ([block.left for block in blocks], [block.right for block in blocks])
        )
        return self.tracked.told.of((left, right))

    @cached_property
    def points(self) -> Points:
        """Points of all frames, in the body's frame, 100 bytes for each in every frame."""
        parts = [points for _, points in self.tracked.with_points()]
        return Points(
            np.concatenate([part.position_m for part in parts]),
            np.concatenate([part.covariance_m2 for part in parts]),
            np.concatenate([part.reprojection_px for part in parts]),
        )


FollowedBlock = tuple[tuple[Found, DirectFit | None], ...]
"""Successive frames: where the subsets are in the left and the right camera, and the direct fit, None for none."""


@dataclass(frozen=True, eq=False, repr=False)
class BodyScene(Arrays, shapes="rest_m N 3"):
    """What stays the same through a series, whoever follows which of its frames.

    views: the body at rest, whose points are rest_m (N, 3), weighted by the `noise` of the images, which is None where
    no frame tells it; seen: those points in each camera. lead: the frames after the first, mostly one, that were
    followed to find that noise. blocks: the other frames, each block of which is followed from the reference on, by
    itself.
    """

    images: tuple[ImageSequence, ImageSequence]
    rig: StereoRig
    body_from_left: RigidTransform
    settings: TrackSettings
    grid: StereoGrid
    references: tuple[Reference, Reference]
    rest_m: FloatArray
    views: tuple[BodyView, ...]
    seen: tuple[SeenPoints, ...]
    noise: Noise | None
    lead: FollowedBlock
    blocks: tuple[range, ...]


def measure_body(
    images: tuple[ImageSequence, ImageSequence],
    rig: StereoRig,
    body_from_left: RigidTransform,
    settings: TrackSettings,
    progress: Progress | None = None,
    device: str = "cpu",
    depth_m: DepthRange | None = None,
) -> BodyMotion:
    """Follow a body through the left and right `images` and fit its six components, about the origin of its frame.

    Subsets are tracked; from the motion that brings the body to where they are (`motion.motion_of_places`) it is fitted
    to the grey values (`direct.fit.fit_direct`), weighted by the noise that the first frame so fitted shows. A frame in
    which this fails has the motion of its triangulated points (`motion.fit_motion`). `progress` is called with the
    number of finished images, 1…2F. `prepare_body`, `follow_block` for each of the blocks and `body_motion` are the
    same in parts, for several threads.

    >>> from scipy.ndimage import gaussian_filter
    >>> rng = np.random.default_rng(1)
    >>> picture = np.rint(128 + 300 * gaussian_filter(rng.standard_normal((96, 96)), 2.0, mode="wrap")).astype(np.uint8)
    >>> def camera_images(shift_px):  # a body that goes one pixel to the right between two noisy frames
    ...     frames = [np.roll(picture, shift_px + k, axis=1) + rng.integers(0, 3, (96, 96), np.uint8) for k in (0, 1)]
    ...     return ImageSequence(("before", "after"), (96, 96), 255, lambda k: frames[k])
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 48, 48, 0, 0, 0, 0, 0]), np.array([96, 96]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.005, 0.0, 0.0])))
    >>> images, body_from_left = (camera_images(0), camera_images(-5)), RigidTransform(np.eye(3), -np.eye(3)[2])
    >>> body = measure_body(images, rig, body_from_left, TrackSettings(radius_px=7))
    >>> f"{1e3 * body.motion.pose[1, 0]:.1f} mm"
    '1.0 mm'
    """
    scene = prepare_body(images, rig, body_from_left, settings, device, progress, depth_m)
    return body_motion(scene, [follow_block(scene, block, device, progress) for block in scene.blocks])


def prepare_body(
    images: tuple[ImageSequence, ImageSequence],
    rig: StereoRig,
    body_from_left: RigidTransform,
    settings: TrackSettings,
    device: str = "cpu",
    progress: Progress | None = None,
    depth_m: DepthRange | None = None,
) -> BodyScene:
    """Return what following a body needs: its subsets, its surface, and the noise of the images.

    `depth_m`: nearest and farthest depth in the left camera at which the body can be, where its pattern may repeat.
    Blocks have `BLOCK_FRAMES` frames, on a GPU `GPU_BLOCK_FRAMES`.
    """
    grid = lay_stereo_grid(*images, rig, settings, depth_m)
    left, right = (
        prepare_sequence(side, px, settings) for side, px in zip(images, (grid.left_px, grid.right_px), strict=True)
    )
    scene = BodyScene(
        images, rig, body_from_left, settings, grid, (left, right), np.empty((0, 3)), (), (), None, (), ()
    )
    rest_m = _place(scene, (identity(left), identity(right))).position_m[0]
    first = spline_of_image(images[0].read(0), settings.degree), spline_of_image(images[1].read(0), settings.degree)
    seen = tuple(see_points(camera, rest_m) for camera in _cameras(scene, rest_m))
    scene = replace(scene, rest_m=rest_m, seen=seen, views=_views(scene, first, seen))
    _tell(progress, 1)
    scene = _with_noise(scene, device, progress)
    rest = range(1 + len(scene.lead), len(images[0]))
    length = BLOCK_FRAMES if device == "cpu" else GPU_BLOCK_FRAMES
    return replace(scene, blocks=tuple(rest[start : start + length] for start in range(0, len(rest), length)))


def follow_block(
    scene: BodyScene, frames: range, device: str = "cpu", progress: Progress | None = None
) -> FollowedBlock:
    """Follow the body through a block of later frames; the first of them is found from the reference alone."""
    fitted: Iterator[tuple[Found, DirectFit | None]]
    if device == "cpu":
        fitted = ((found, _fit(scene, found, splines)) for found, splines in _found_in(scene, frames, device))
    else:
        fitted = _fitted_together(scene, frames, device)
    followed = []
    for number, one in zip(frames, fitted, strict=True):
        followed.append(one)
        _tell(progress, number + 1)
    return tuple(followed)


def _fitted_together(scene: BodyScene, frames: range, device: str) -> Iterator[tuple[Found, DirectFit | None]]:
    """Some frames in turn, fitted together as far as their splines lie together on the device."""
    from photogram.direct.fit_torch import fit_frames, torch_view
    from photogram.subsets.icgn_stream import PRECISION, OnDevice

    views = [torch_view(view, device, PRECISION) for view in scene.views]

    def together(pair: tuple[FollowedFrame, FollowedFrame]) -> tuple[int, ...]:
        return tuple(id(side.spline.frames) for side in pair if isinstance(side.spline, OnDevice))

    for _, group in groupby(_sides(scene, frames, device), together):
        pairs = list(group)
        starts = [motion_of_places(scene.seen, _places(scene, (left.found, right.found))) for left, right in pairs]
        known = [k for k, start in enumerate(starts) if start is not None]
        targets = []
        for side in zip(*pairs, strict=True):
            there = [frame.spline for frame in side if isinstance(frame.spline, OnDevice)]
            targets.append((there[0].frames, [there[k].number for k in known]))
        begun = [start for start in starts if start is not None]
        fits = dict(zip(known, fit_frames(views, targets, begun) if begun else [], strict=True))
        for k, (left, right) in enumerate(pairs):
            found, fit = (left.found, right.found), fits.get(k)
            if fit is None:  # one that is lost is tried again as the CPU would
                fit = _fit(scene, found, _splines(scene, (left, right)))
            yield found, fit


def body_motion(scene: BodyScene, blocks: Iterable[FollowedBlock]) -> BodyMotion:
    """Return the motion of the body from what was found in the scene's blocks, in their order.

    The blocks, a list or what reads them from a disk, are gone through twice, one at a time, and again whenever subsets
    or points are asked for.
    """
    tracked, fits = _tracked(scene, blocks)
    settings, images, references, noise = scene.settings, scene.images, scene.references, scene.noise
    quality, remarks = None, list[Notice]()
    if noise is not None:
        quality = (
            assess(references[0], images[0].read(0), noise[0], images[0].full_scale),
            assess(references[1], images[1].read(0), noise[1], images[1].full_scale),
        )
        remarks = [*quality[0].notices("left camera"), *quality[1].notices("right camera")]
    shared = None
    if settings.grid_step_px <= 2 * settings.radius_px:
        shared = overlap_correlation(scene.grid.left_px, settings.radius_px)
    sums = _Sums()
    for block, points in tracked.with_points():
        if sums.mean is None:
            seen = int(np.count_nonzero(np.isfinite(points.position_m[0]).all(axis=1)))  # in some later frame as well
            if seen < 3:
                text = f"at least 3 points that both cameras see in a later frame too, found {seen}"
                raise BodyNotFound(f"rig: expected {text}")
            sums.mean, sums.subsets_px = DeformationMean(points.position_m[0]), block.left.position_px[0]
        of_points = fit_motion(points, sums.mean.reference_m, np.zeros(3), shared)
        sums.add(block, points, of_points, fits.merged(of_points, sums.frames))
    assert sums.mean is not None
    motion, of_points = _joined(sums.motions), _joined(sums.of_points)
    notices = (*tracked.told.notices, *remarks, *_rigid_notices(sums, motion, of_points, fits))
    return BodyMotion(
        motion=motion,
        motion_of_points=of_points,
        reprojection_px=float(np.sqrt(sums.reprojection[0] / max(sums.reprojection[1], 1))),
        subsets_px=sums.subsets_px,
        sigma_px=float(np.sqrt(sums.variance_px2.median)),
        zncc=sums.zncc.median,
        noise=noise,
        quality=quality,
        notices=notices,
        tracked=tracked,
        surface=Surface(sums.mean, motion, tracked),
    )


# What was followed, gone through some frames at a time.


@dataclass(frozen=True, eq=False, repr=False)
class Tracked(Arrays):
    """Tracked subsets of a body, some frames at a time from the first one on, as often as they are asked for.

    noise_grey: image noise (N,) at the subsets of the left and the right camera, over all frames. `told`: what these
    say of both cameras. `held`: all of a short series with its points, once these have been gone through.
    """

    scene: BodyScene
    blocks: Iterable[FollowedBlock]
    noise_grey: tuple[FloatArray, FloatArray]
    course: StereoCourse
    told: Told
    held: list[tuple[StereoTracks, Points]] = field(default_factory=list)

    def __iter__(self) -> Iterator[StereoTracks]:
        return (tracks for tracks, _ in self.held) if self.held else self._computed()

    def with_points(self) -> Iterator[tuple[StereoTracks, Points]]:
        """Yield some frames at a time with the points of their subsets, in the body's frame."""
        if self.held:
            yield from self.held
            return
        short = len(self.scene.images[0]) * len(self.scene.grid.left_px) <= MOST_HELD
        seen = []
        for tracks in self._computed():
            both = tracks, self._points(tracks)
            if short:
                seen.append(both)
            yield both
        self.held.extend(seen)

    def _computed(self) -> Iterator[StereoTracks]:
        for found in _in_turn(self.scene, self.blocks):
            left, right = (
                tracks_of(
                    [both[side] for both, _ in found], self.scene.references[side], self.scene.settings.degree, noise
                )
                for side, noise in enumerate(self.noise_grey)
            )
            aside = self.course.aside((left.position_px, right.position_px))
            yield self.told.of(without_aside((left, right), aside))

    def _points(self, tracks: StereoTracks) -> Points:
        left, right = tracks.left, tracks.right
        pixels = left.position_px, right.position_px, left.covariance_px2, right.covariance_px2
        return triangulate(self.scene.rig, *pixels).transformed(self.scene.body_from_left)


@dataclass(frozen=True, eq=False, repr=False)
class Surface(Arrays):
    """What the points of a body do beside its motion, some frames at a time, as often as it is asked for."""

    mean: DeformationMean
    motion: RigidMotion
    tracked: Tracked

    def __iter__(self) -> Iterator[Deformation]:
        start = 0
        for block, points in self.tracked.with_points():
            stop = start + len(block.left.position_px)
            yield self.mean.of(points, _of_frames(self.motion, slice(start, stop)))
            start = stop


@dataclass(frozen=True, eq=False, repr=False)
class _Fits(Arrays, shapes="pose F 6; covariance F 6 6"):
    """The direct fits of all frames, NaN for none; the first frame has the covariance of a typical one."""

    pose: FloatArray
    covariance: FloatArray

    @property
    def missed(self) -> int:
        """How many later frames have none."""
        return int(np.count_nonzero(~np.isfinite(self.pose[1:, 0])))

    def merged(self, of_points: RigidMotion, start: int) -> RigidMotion:
        """The motion of points in some frames, from `start` on, replaced where there is a direct fit."""
        own = slice(start, start + len(of_points.pose))
        known = np.asarray(np.isfinite(self.pose[own]).all(axis=1))
        typical = np.asarray(np.isfinite(self.covariance[own]).all(axis=(1, 2)))
        return replace(
            of_points,
            pose=np.where(known[:, None], self.pose[own], of_points.pose),
            covariance=np.where(typical[:, None, None], self.covariance[own], of_points.covariance),
        )


class _Sums:
    """What is left of the subsets and points of a body when they have been gone through once."""

    def __init__(self) -> None:
        self.mean: DeformationMean | None = None
        self.subsets_px: FloatArray = np.empty((0, 2))
        self.frames, self.reprojection = 0, (0.0, 0)
        self.motions: list[RigidMotion] = []
        self.of_points: list[RigidMotion] = []
        self.variance_px2, self.variance_m2, self.zncc = Sample(), Sample(), Sample()

    def add(self, tracks: StereoTracks, points: Points, of_points: RigidMotion, motion: RigidMotion) -> None:
        """Take in further frames."""
        assert self.mean is not None
        self.mean.add(points, motion)
        squares = points.reprojection_px**2
        total, count = self.reprojection
        self.reprojection = total + float(np.nansum(squares)), count + int(np.count_nonzero(np.isfinite(squares)))
        sides = [np.diagonal(side.covariance_px2, axis1=2, axis2=3) for side in (tracks.left, tracks.right)]
        self.variance_px2.add(np.stack(sides, axis=1))
        self.zncc.add(tracks.left.zncc)
        variance = np.trace(points.covariance_m2, axis1=2, axis2=3) / 3.0
        first = 1 if self.frames == 0 else 0
        self.variance_m2.add(np.where(np.isfinite(of_points.residual_m)[:, None], variance, np.nan)[first:])
        self.frames += len(squares)
        self.of_points.append(of_points)
        self.motions.append(motion)


def _in_turn(scene: BodyScene, blocks: Iterable[FollowedBlock]) -> Iterator[FollowedBlock]:
    """The scene's frames from the reference on, no more than `BLOCK_FRAMES` at a time."""
    own = identity(scene.references[0]), identity(scene.references[1])
    for block in chain([((own, None), *scene.lead)], blocks):
        for start in range(0, len(block), BLOCK_FRAMES):
            yield block[start : start + BLOCK_FRAMES]


def _tracked(scene: BodyScene, blocks: Iterable[FollowedBlock]) -> tuple[Tracked, _Fits]:
    """Go through what was followed for what it takes all frames to know: noise, remarks, and the direct fits."""
    course, noise = StereoCourse(scene.rig), (RunningMean(), RunningMean())
    poses, covariances, levels = [], [], []
    nothing = np.full(6, np.nan), np.full((6, 6), np.nan)
    for found in _in_turn(scene, blocks):
        sides = [[both[side] for both, _ in found] for side in range(2)]
        left, right = (places_of(*both) for both in zip(sides, scene.references, strict=True))
        course.add((left[0], right[0]), (left[1], right[1]))
        for running, side, reference in zip(noise, sides, scene.references, strict=True):
            running.add(noise_of(side, reference, scene.settings.degree) ** 2)
        for _, fit in found:
            pose, covariance = nothing if fit is None else (fit.moved.pose, fit.covariance)
            poses.append(pose)
            covariances.append(covariance)
            levels += [] if fit is None else [fit.noise]
    if levels:
        covariances[0] = rest_covariance(scene.views, float(np.median(levels)))
    grey = np.sqrt(noise[0].mean), np.sqrt(noise[1].mean)
    firsts = scene.images[0].read(0), scene.images[1].read(0)
    told = course.told(firsts, scene.grid, scene.settings, grey)
    return Tracked(scene, blocks, grey, course, told), _Fits(np.array(poses), np.array(covariances))


def _of_frames(motion: RigidMotion, frames: slice) -> RigidMotion:
    """The motion in some frames."""
    return RigidMotion(
        motion.pose[frames],
        motion.covariance[frames],
        motion.residual_m[frames],
        motion.points[frames],
        motion.origin_m,
    )


def _joined(parts: Sequence[RigidMotion]) -> RigidMotion:
    """The motion of all frames."""
    pose, covariance, residual_m, points = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("pose", "covariance", "residual_m", "points")
    )
    return RigidMotion(pose, covariance, residual_m, points, parts[0].origin_m)


def _with_noise(scene: BodyScene, device: str, progress: Progress | None) -> BodyScene:
    """The scene with the noise models of the first frame that can be fitted, and what was found up to it."""
    for number in range(1, len(scene.images[0])):
        ((found, splines),) = _found_in(scene, range(number, number + 1), device)
        fit = _fit(scene, found, splines)
        if fit is not None:
            left, right = map(partial(image_noise, moved=fit.moved), scene.views, splines)
            weighed = zip(scene.views, (left, right), strict=True)
            views = tuple(reweighted_view(view, model, scene.settings.degree) for view, model in weighed)
            scene = replace(scene, noise=(left, right), views=views)
            fit = _fit(scene, found, splines)
        scene = replace(scene, lead=(*scene.lead, (found, fit)))
        _tell(progress, number + 1)
        if scene.noise is not None:
            break
    return scene


def _found_in(scene: BodyScene, frames: range, device: str) -> Iterator[tuple[Found, Splines]]:
    """Some frames in turn: where the subsets are in both cameras, and both splines in memory."""
    for pair in _sides(scene, frames, device):
        yield (pair[0].found, pair[1].found), _splines(scene, pair)


def _sides(scene: BodyScene, frames: range, device: str) -> Iterator[tuple[FollowedFrame, FollowedFrame]]:
    """Some frames of both cameras in turn."""
    left, right = (
        follow_sequence(images, reference, scene.settings, device, frames)
        for images, reference in zip(scene.images, scene.references, strict=True)
    )
    return zip(left, right, strict=True)


def _splines(scene: BodyScene, pair: tuple[FollowedFrame, FollowedFrame]) -> Splines:
    """The splines of a frame in memory."""
    left, right = (
        side.spline if isinstance(side.spline, Spline) else spline_of_image(side.image, scene.settings.degree)
        for side in pair
    )
    return left, right


def _tell(progress: Progress | None, frames: int) -> None:
    """Say that both images of so many frames are done."""
    if progress is not None:
        progress(2 * frames)


def _places(scene: BodyScene, found: Found) -> tuple[FloatArray, FloatArray]:
    """Where the subsets (N, 2) of one frame are in both cameras, NaN where they are not found."""
    left, right = (
        reference.centre_px + here.warp[:, [0, 3]] for reference, here in zip(scene.references, found, strict=True)
    )
    return left, right


def _place(scene: BodyScene, found: Found) -> Points:
    """Points (1, N) of one frame in the body's frame, all subsets equally trusted."""
    left, right = _places(scene, found)
    return triangulate(scene.rig, left[None], right[None]).transformed(scene.body_from_left)


def _cameras(scene: BodyScene, rest_m: FloatArray) -> tuple[PlacedCamera, PlacedCamera]:
    """Both cameras about the body; `BodyNotFound` where the calibration places no points of it."""
    placed = int(np.count_nonzero(np.isfinite(rest_m).all(axis=1)))
    if placed < 3:
        text = f"at least 3 points that both cameras see in one place, found {placed} of {len(rest_m)}"
        raise BodyNotFound(f"rig: expected {text}; the calibration does not belong to these images")
    left_from_body = scene.body_from_left.inverse()
    return (
        PlacedCamera(scene.rig.left, left_from_body),
        PlacedCamera(scene.rig.right, scene.rig.right_from_left @ left_from_body),
    )


def _views(scene: BodyScene, splines: Splines, seen: Sequence[SeenPoints]) -> tuple[BodyView, ...]:
    """The body at rest in both cameras, all pixels equally trusted."""
    side_px = 2 * scene.settings.radius_px + 1
    return tuple(
        view_body(one.camera, (spline, area, float(images.full_scale)), one.points_m, side_px, UNIFORM)
        for one, spline, area, images in zip(seen, splines, scene.grid.areas, scene.images, strict=True)
    )


def _fit(scene: BodyScene, found: Found, splines: Splines) -> DirectFit | None:
    """The direct fit of one frame, begun where its subsets are; None where it has none."""
    start = motion_of_places(scene.seen, _places(scene, found))
    fit = None if start is None else fit_direct(scene.views, splines, start)
    if fit is None:  # from all that the points tell, whatever it costs
        pose = fit_motion(_place(scene, found), scene.rest_m, np.zeros(3)).pose[0]
        fit = fit_direct(scene.views, splines, RigidTransform.from_pose(pose)) if np.isfinite(pose).all() else None
    return fit


def _rigid_notices(sums: _Sums, motion: RigidMotion, of_points: RigidMotion, fits: _Fits) -> list[Notice]:
    """Warnings about points that move unlike a rigid body, frames without a direct fit, and one against the points."""
    texts = []
    known = np.isfinite(of_points.residual_m[1:])
    if known.any():
        misfit, noise = np.median(of_points.residual_m[1:][known]), np.sqrt(sums.variance_m2.median)
        if misfit >= LARGEST_BENDING * noise:
            texts.append(
                f"the points depart from a rigid motion by {1e6 * misfit:.1f} µm rms, {misfit / noise:.0f} times their "
                "noise: the body bends, or parts of it move on their own"
            )
    if fits.missed:
        texts.append(
            f"in {fits.missed} of {len(fits.pose) - 1} frames the motion could not be fitted to the grey values; "
            "its points count"
        )
    difference = (motion.pose - of_points.pose)[1:]
    both = np.isfinite(difference).all(axis=1)
    squares = difference[both] ** 2 / np.diagonal(of_points.covariance[1:], axis1=1, axis2=2)[both]
    ratio = float(np.sqrt(np.mean(squares))) if both.any() else 0.0
    if ratio > LARGEST_DIFFERENCE:
        texts.append(
            f"the motion fitted to the grey values is {ratio:.1f} standard uncertainties off that of the tracked "
            "points: the body bends, something in front of it moves, or its texture is not resolved"
        )
    return [Notice("warning", text, "rigid motion") for text in texts]
