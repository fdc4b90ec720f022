"""One body through a series of stereo images: tracked subsets, points, and its rigid motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from photogram.arrays import Arrays, FloatArray, Notice
from photogram.bspline import Spline, spline_of_image
from photogram.camera import Points, StereoRig, triangulate
from photogram.direct import BodyView, DirectFit, fit_direct, image_noise, rest_covariance, view_body
from photogram.geometry import RigidTransform
from photogram.images import ImageSequence, NoiseModel
from photogram.motion import PlacedCamera, RigidMotion, fit_motion, overlap_correlation
from photogram.subsets.icgn import Registration, TrackSettings
from photogram.subsets.reference import Reference
from photogram.subsets.texture import SubsetQuality, assess
from photogram.subsets.track import (
    FollowedFrame,
    StereoGrid,
    StereoTracks,
    follow_sequence,
    identity,
    lay_stereo_grid,
    prepare_sequence,
    stereo_tracks,
    tracks_of,
)

Progress = Callable[[int], None]
Splines = tuple[Spline, Spline]
Noise = tuple[NoiseModel, NoiseModel]
Views = tuple[BodyView, ...]
_Frame = tuple[tuple[Registration, Registration], Splines, FloatArray]
UNIFORM = NoiseModel(1.0, 0.0)
BLOCK_FRAMES = 32
"""A constant, so that results do not depend on who computes them; few enough to share, many enough to start seldom."""
LARGEST_BENDING = 4.0  # rms, in standard deviations of the points; the reference's noise makes it 1.4
LARGEST_DIFFERENCE = 2.0  # rms, in standard uncertainties of the motion of the points


@dataclass(frozen=True, eq=False, repr=False)
class BodyMotion(Arrays):
    """A body seen by a stereo pair: subsets, points in the body's frame, motion, and what the user should know.

    motion: fitted to the grey values of all pixels, `motion_of_points` to the points alone. Of the left and the right
    camera: noise models, and quality, what the subsets promised before they were tracked; None when no frame could be
    fitted to the grey values.
    """

    tracks: StereoTracks
    points: Points
    motion: RigidMotion
    motion_of_points: RigidMotion
    noise: Noise | None
    quality: tuple[SubsetQuality, SubsetQuality] | None
    notices: tuple[Notice, ...]


@dataclass(frozen=True, eq=False, repr=False)
class FollowedBlock(Arrays):
    """Successive frames: where the subsets are in the left and the right camera, and direct fits, None for none."""

    found: tuple[tuple[Registration, Registration], ...]
    fits: tuple[DirectFit | None, ...]


@dataclass(frozen=True, eq=False, repr=False)
class BodyScene(Arrays, shapes="rest_m N 3"):
    """What stays the same through a series, whoever follows which of its frames.

    views: the body at rest, whose points are rest_m (N, 3), weighted by the `noise` of the images. lead: the frames
    after the first, mostly one, that were followed to find that noise; None where no frame tells it. blocks: the other
    frames, each block of which is followed from the reference on, by itself.
    """

    images: tuple[ImageSequence, ImageSequence]
    rig: StereoRig
    body_from_left: RigidTransform
    settings: TrackSettings
    grid: StereoGrid
    references: tuple[Reference, Reference]
    rest_m: FloatArray
    views: Views
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
) -> BodyMotion:
    """Follow a body through the left and right `images` and fit its six components, about the origin of its frame.

    Subsets are tracked, triangulated and fitted by a rigid motion (`motion.fit_motion`); from that start the motion is
    fitted to the grey values (`direct.fit_direct`), weighted by the noise that the first frame so fitted shows. A frame
    in which this fails keeps the motion of its points. `progress` is called with the number of finished images, 1…2F.
    `prepare_body`, `follow_block` for each of the blocks and `body_motion` are the same in parts.

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
    scene = prepare_body(images, rig, body_from_left, settings, device, progress)
    return body_motion(scene, [follow_block(scene, block, device, progress) for block in scene.blocks])


def prepare_body(
    images: tuple[ImageSequence, ImageSequence],
    rig: StereoRig,
    body_from_left: RigidTransform,
    settings: TrackSettings,
    device: str = "cpu",
    progress: Progress | None = None,
) -> BodyScene:
    """Return what following a body needs: its subsets, its surface, and the noise of the images.

    Blocks have `BLOCK_FRAMES` frames; on a GPU, which follows frames in batches, the series is one block.
    """
    grid = lay_stereo_grid(*images, rig, settings)
    left, right = (
        prepare_sequence(side, px, settings) for side, px in zip(images, (grid.left_px, grid.right_px), strict=True)
    )
    nothing = FollowedBlock((), ())
    scene = BodyScene(
        images, rig, body_from_left, settings, grid, (left, right), np.empty((0, 3)), (), None, nothing, ()
    )
    rest_m = _place(scene, identity(left), identity(right)).position_m[0]
    first = spline_of_image(images[0].read(0), settings.degree), spline_of_image(images[1].read(0), settings.degree)
    scene = replace(scene, rest_m=rest_m, views=_views(scene, first, rest_m, (UNIFORM, UNIFORM)))
    _tell(progress, 1)
    scene = _with_noise(scene, first, device, progress)
    rest = range(1 + len(scene.lead.fits), len(images[0]))
    length = BLOCK_FRAMES if device == "cpu" else max(1, len(rest))
    return replace(scene, blocks=tuple(rest[start : start + length] for start in range(0, len(rest), length)))


def follow_block(
    scene: BodyScene, frames: range, device: str = "cpu", progress: Progress | None = None
) -> FollowedBlock:
    """Follow the body through a block of later frames; the first of them is found from the reference alone."""
    found: list[tuple[Registration, Registration]] = []
    fits: list[DirectFit | None] = []
    for number, (seen, splines, start) in zip(frames, _followed(scene, frames, device), strict=True):
        found.append(seen)
        fits.append(_fit(scene.views, splines, start))
        _tell(progress, number + 1)
    return FollowedBlock(tuple(found), tuple(fits))


def body_motion(scene: BodyScene, blocks: Sequence[FollowedBlock]) -> BodyMotion:
    """Return the motion of the body from what was found in the scene's blocks, in their order."""
    parts = [scene.lead, *blocks]
    fits = [fit for part in parts for fit in part.fits]
    settings, images, (left, right), noise = scene.settings, scene.images, scene.references, scene.noise
    found = [pair for part in parts for pair in part.found]
    tracks = (
        tracks_of([identity(left), *(pair[0] for pair in found)], left, settings.degree),
        tracks_of([identity(right), *(pair[1] for pair in found)], right, settings.degree),
    )
    firsts = images[0].read(0), images[1].read(0)
    stereo = stereo_tracks(firsts, scene.grid, tracks, settings)
    quality, remarks = None, list[Notice]()
    if noise is not None:
        quality = (
            assess(left, firsts[0], noise[0], images[0].full_scale),
            assess(right, firsts[1], noise[1], images[1].full_scale),
        )
        remarks = [*quality[0].notices("left camera"), *quality[1].notices("right camera")]
    points = triangulate(
        scene.rig, tracks[0].position_px, tracks[1].position_px, tracks[0].covariance_px2, tracks[1].covariance_px2
    ).transformed(scene.body_from_left)
    shared = None
    if settings.grid_step_px <= 2 * settings.radius_px:
        shared = overlap_correlation(scene.grid.left_px, settings.radius_px)
    of_points = fit_motion(points, None, np.zeros(3), shared)
    motion = _with_direct(of_points, fits, scene.views)
    notices = (*stereo.notices, *remarks, *_bending(points, of_points), *_direct_notices(motion, of_points, fits))
    return BodyMotion(stereo, points, motion, of_points, noise, quality, notices)


def _with_noise(scene: BodyScene, first: Splines, device: str, progress: Progress | None) -> BodyScene:
    """The scene with the noise models of the first frame that can be fitted, and what was found up to it."""
    found: list[tuple[Registration, Registration]] = []
    fits: list[DirectFit | None] = []
    noise: Noise | None = None
    while noise is None and len(fits) < len(scene.images[0]) - 1:
        number = 1 + len(fits)
        ((seen, splines, start),) = _followed(scene, range(number, number + 1), device)
        fit = _fit(scene.views, splines, start)
        if fit is not None:
            left, right = (
                image_noise(view, spline, fit.moved) for view, spline in zip(scene.views, splines, strict=True)
            )
            noise = left, right
            scene = replace(scene, noise=noise, views=_views(scene, first, scene.rest_m, noise))
            fit = _fit(scene.views, splines, start)
        found.append(seen)
        fits.append(fit)
        _tell(progress, number + 1)
    return replace(scene, lead=FollowedBlock(tuple(found), tuple(fits)))


def _followed(scene: BodyScene, frames: range, device: str) -> Iterator[_Frame]:
    """Some frames in turn: where the subsets are in both cameras, both splines, and the pose (6,) of the points."""
    sides = (
        follow_sequence(images, reference, scene.settings, device, frames)
        for images, reference in zip(scene.images, scene.references, strict=True)
    )
    for left, right in zip(*sides, strict=True):
        start = fit_motion(_place(scene, left.found, right.found), scene.rest_m, np.zeros(3)).pose[0]
        yield (left.found, right.found), (_spline(left, scene.settings), _spline(right, scene.settings)), start


def _tell(progress: Progress | None, frames: int) -> None:
    """Say that both images of so many frames are done."""
    if progress is not None:
        progress(2 * frames)


def _place(scene: BodyScene, left: Registration, right: Registration) -> Points:
    """Points (1, N) of one frame in the body's frame, all subsets equally trusted."""
    pixels = [
        (reference.centre_px + here.warp[:, [0, 3]])[None]
        for reference, here in zip(scene.references, (left, right), strict=True)
    ]
    return triangulate(scene.rig, pixels[0], pixels[1]).transformed(scene.body_from_left)


def _spline(frame: FollowedFrame, settings: TrackSettings) -> Spline:
    """The frame's spline, made here when tracking needed none."""
    return frame.spline if frame.spline is not None else spline_of_image(frame.image, settings.degree)


def _views(scene: BodyScene, splines: Splines, rest_m: FloatArray, noise: Noise) -> Views:
    """The body at rest in both cameras; `ValueError` where the calibration places no points of it."""
    placed = int(np.count_nonzero(np.isfinite(rest_m).all(axis=1)))
    if placed < 3:
        text = f"at least 3 points that both cameras see in one place, found {placed} of {len(rest_m)}"
        raise ValueError(f"rig: expected {text}; the calibration does not belong to these images")
    left_from_body = scene.body_from_left.inverse()
    cameras = (
        PlacedCamera(scene.rig.left, left_from_body),
        PlacedCamera(scene.rig.right, scene.rig.right_from_left @ left_from_body),
    )
    side_px = 2 * scene.settings.radius_px + 1
    return tuple(
        view_body(camera, (spline, area, float(images.full_scale)), rest_m, side_px, model)
        for camera, spline, area, images, model in zip(
            cameras, splines, scene.grid.areas, scene.images, noise, strict=True
        )
    )


def _fit(views: Views, splines: Splines, start: FloatArray) -> DirectFit | None:
    """The direct fit of one frame, None where its points have no motion to start from."""
    return fit_direct(views, splines, RigidTransform.from_pose(start)) if np.isfinite(start).all() else None


def _with_direct(of_points: RigidMotion, fits: list[DirectFit | None], views: Views) -> RigidMotion:
    """The motion with pose and covariance of the direct fits; the first frame has the covariance of a typical one."""
    pose, covariance = of_points.pose.copy(), of_points.covariance.copy()
    done = [fit for fit in fits if fit is not None]
    if done:
        covariance[0] = rest_covariance(views, float(np.median([fit.noise for fit in done])))
    for frame, fit in enumerate(fits, start=1):
        if fit is not None:
            pose[frame], covariance[frame] = fit.moved.pose, fit.covariance
    return replace(of_points, pose=pose, covariance=covariance)


def _bending(points: Points, motion: RigidMotion) -> list[Notice]:
    """A warning when the points depart from a rigid motion by much more than their noise."""
    variance = np.trace(points.covariance_m2[1:], axis1=2, axis2=3) / 3.0
    residual = motion.residual_m[1:]
    known = np.isfinite(residual)
    if not known.any():
        return []
    misfit, noise = float(np.median(residual[known])), float(np.sqrt(np.nanmedian(variance[known])))
    if misfit < LARGEST_BENDING * noise:
        return []
    text = (
        f"the points depart from a rigid motion by {1e6 * misfit:.1f} µm rms, {misfit / noise:.0f} times their noise: "
        "the body bends, or parts of it move on their own"
    )
    return [Notice("warning", text, "rigid motion")]


def _direct_notices(motion: RigidMotion, of_points: RigidMotion, fits: list[DirectFit | None]) -> list[Notice]:
    """Warnings about frames without a direct fit, and about one that contradicts the points."""
    notices = []
    missed = sum(fit is None for fit in fits)
    if missed:
        text = f"in {missed} of {len(fits)} frames the motion could not be fitted to the grey values; its points count"
        notices.append(Notice("warning", text, "rigid motion"))
    difference = (motion.pose - of_points.pose)[1:]
    known = np.isfinite(difference).all(axis=1)
    if not known.any():
        return notices
    squares = difference[known] ** 2 / np.diagonal(of_points.covariance[1:], axis1=1, axis2=2)[known]
    ratio = float(np.sqrt(np.mean(squares)))
    if ratio > LARGEST_DIFFERENCE:
        text = (
            f"the motion fitted to the grey values is {ratio:.1f} standard uncertainties off that of the tracked "
            "points: the body bends, something in front of it moves, or its texture is not resolved"
        )
        notices.append(Notice("warning", text, "rigid motion"))
    return notices
