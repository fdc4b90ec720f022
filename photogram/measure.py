"""One body through a series of stereo images: tracked subsets, points, and its rigid motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from photogram.arrays import Arrays, FloatArray, Notice
from photogram.bspline import Spline, spline_of_image
from photogram.camera import Points, StereoRig, triangulate
from photogram.direct import BodyView, DirectFit, fit_direct, image_noise, rest_covariance, view_body
from photogram.geometry import RigidTransform
from photogram.images.noise import NoiseModel
from photogram.images.sequence import ImageSequence
from photogram.motion import PlacedCamera, RigidMotion, fit_motion, overlap_correlation
from photogram.subsets.find import BodyNotFound, DepthRange, identity
from photogram.subsets.icgn import Registration, TrackSettings
from photogram.subsets.reference import Reference
from photogram.subsets.texture import SubsetQuality, assess
from photogram.subsets.track import (
    StereoGrid,
    StereoTracks,
    follow_sequence,
    lay_stereo_grid,
    prepare_sequence,
    stereo_tracks,
    tracks_of,
)

Progress = Callable[[int], None]
Splines = tuple[Spline, Spline]
Noise = tuple[NoiseModel, NoiseModel]
Found = tuple[Registration, Registration]
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


FollowedBlock = tuple[tuple[Found, DirectFit | None], ...]
"""Successive frames: where the subsets are in the left and the right camera, and the direct fit, None for none."""


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
    views: tuple[BodyView, ...]
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
    Blocks have `BLOCK_FRAMES` frames; on a GPU, which follows frames in batches, the series is one block.
    """
    grid = lay_stereo_grid(*images, rig, settings, depth_m)
    left, right = (
        prepare_sequence(side, px, settings) for side, px in zip(images, (grid.left_px, grid.right_px), strict=True)
    )
    scene = BodyScene(images, rig, body_from_left, settings, grid, (left, right), np.empty((0, 3)), (), None, (), ())
    rest_m = _place(scene, (identity(left), identity(right))).position_m[0]
    first = spline_of_image(images[0].read(0), settings.degree), spline_of_image(images[1].read(0), settings.degree)
    scene = replace(scene, rest_m=rest_m, views=_views(scene, first, rest_m, (UNIFORM, UNIFORM)))
    _tell(progress, 1)
    scene = _with_noise(scene, first, device, progress)
    rest = range(1 + len(scene.lead), len(images[0]))
    length = BLOCK_FRAMES if device == "cpu" else max(1, len(rest))
    return replace(scene, blocks=tuple(rest[start : start + length] for start in range(0, len(rest), length)))


def follow_block(
    scene: BodyScene, frames: range, device: str = "cpu", progress: Progress | None = None
) -> FollowedBlock:
    """Follow the body through a block of later frames; the first of them is found from the reference alone."""
    followed = []
    for number, (found, splines, start) in zip(frames, _found_in(scene, frames, device), strict=True):
        followed.append((found, _fit(scene.views, splines, start)))
        _tell(progress, number + 1)
    return tuple(followed)


def body_motion(scene: BodyScene, blocks: Sequence[FollowedBlock]) -> BodyMotion:
    """Return the motion of the body from what was found in the scene's blocks, in their order."""
    followed = [*scene.lead, *(frame for block in blocks for frame in block)]
    fits = [fit for _, fit in followed]
    settings, images, references, noise = scene.settings, scene.images, scene.references, scene.noise
    left, right = (
        tracks_of([identity(reference), *(found[side] for found, _ in followed)], reference, settings.degree)
        for side, reference in enumerate(references)
    )
    firsts = images[0].read(0), images[1].read(0)
    stereo = stereo_tracks(firsts, scene.grid, (left, right), settings, scene.rig)
    left, right = stereo.left, stereo.right
    quality, remarks = None, list[Notice]()
    if noise is not None:
        quality = (
            assess(references[0], firsts[0], noise[0], images[0].full_scale),
            assess(references[1], firsts[1], noise[1], images[1].full_scale),
        )
        remarks = [*quality[0].notices("left camera"), *quality[1].notices("right camera")]
    pixels = left.position_px, right.position_px, left.covariance_px2, right.covariance_px2
    points = triangulate(scene.rig, *pixels).transformed(scene.body_from_left)
    seen = int(np.count_nonzero(np.isfinite(points.position_m[0]).all(axis=1)))  # in some later frame as well
    if seen < 3:
        raise BodyNotFound(f"rig: expected at least 3 points that both cameras see in a later frame too, found {seen}")
    shared = None
    if settings.grid_step_px <= 2 * settings.radius_px:
        shared = overlap_correlation(scene.grid.left_px, settings.radius_px)
    of_points = fit_motion(points, None, np.zeros(3), shared)
    pose, covariance = of_points.pose.copy(), of_points.covariance.copy()
    done = {frame: fit for frame, fit in enumerate(fits, start=1) if fit is not None}
    for frame, fit in done.items():
        pose[frame], covariance[frame] = fit.moved.pose, fit.covariance
    if done:  # the first frame has the covariance of a typical one
        covariance[0] = rest_covariance(scene.views, float(np.median([fit.noise for fit in done.values()])))
    motion = replace(of_points, pose=pose, covariance=covariance)
    notices = (*stereo.notices, *remarks, *_rigid_notices(points, motion, of_points, fits))
    return BodyMotion(stereo, points, motion, of_points, noise, quality, notices)


def _with_noise(scene: BodyScene, first: Splines, device: str, progress: Progress | None) -> BodyScene:
    """The scene with the noise models of the first frame that can be fitted, and what was found up to it."""
    for number in range(1, len(scene.images[0])):
        ((found, splines, start),) = _found_in(scene, range(number, number + 1), device)
        fit = _fit(scene.views, splines, start)
        if fit is not None:
            left, right = map(partial(image_noise, moved=fit.moved), scene.views, splines)
            scene = replace(scene, noise=(left, right), views=_views(scene, first, scene.rest_m, (left, right)))
            fit = _fit(scene.views, splines, start)
        scene = replace(scene, lead=(*scene.lead, (found, fit)))
        _tell(progress, number + 1)
        if scene.noise is not None:
            break
    return scene


def _found_in(scene: BodyScene, frames: range, device: str) -> Iterator[tuple[Found, Splines, FloatArray]]:
    """Some frames in turn: where the subsets are in both cameras, both splines, and the pose (6,) of the points."""
    sides = (
        follow_sequence(images, reference, scene.settings, device, frames)
        for images, reference in zip(scene.images, scene.references, strict=True)
    )
    for left, right in zip(*sides, strict=True):
        found = left.found, right.found
        splines = tuple(side.spline or spline_of_image(side.image, scene.settings.degree) for side in (left, right))
        start = fit_motion(_place(scene, found), scene.rest_m, np.zeros(3)).pose[0]
        yield found, (splines[0], splines[1]), start


def _tell(progress: Progress | None, frames: int) -> None:
    """Say that both images of so many frames are done."""
    if progress is not None:
        progress(2 * frames)


def _place(scene: BodyScene, found: Found) -> Points:
    """Points (1, N) of one frame in the body's frame, all subsets equally trusted."""
    left, right = (
        (reference.centre_px + here.warp[:, [0, 3]])[None]
        for reference, here in zip(scene.references, found, strict=True)
    )
    return triangulate(scene.rig, left, right).transformed(scene.body_from_left)


def _views(scene: BodyScene, splines: Splines, rest_m: FloatArray, noise: Noise) -> tuple[BodyView, ...]:
    """The body at rest in both cameras; `BodyNotFound` where the calibration places no points of it."""
    placed = int(np.count_nonzero(np.isfinite(rest_m).all(axis=1)))
    if placed < 3:
        text = f"at least 3 points that both cameras see in one place, found {placed} of {len(rest_m)}"
        raise BodyNotFound(f"rig: expected {text}; the calibration does not belong to these images")
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


def _fit(views: tuple[BodyView, ...], splines: Splines, start: FloatArray) -> DirectFit | None:
    """The direct fit of one frame, None where its points have no motion to start from."""
    return fit_direct(views, splines, RigidTransform.from_pose(start)) if np.isfinite(start).all() else None


def _rigid_notices(
    points: Points, motion: RigidMotion, of_points: RigidMotion, fits: list[DirectFit | None]
) -> list[Notice]:
    """Warnings about points that move unlike a rigid body, frames without a direct fit, and one against the points."""
    texts = []
    known = np.isfinite(of_points.residual_m[1:])
    if known.any():
        variance = np.trace(points.covariance_m2[1:], axis1=2, axis2=3) / 3.0
        misfit, noise = np.median(of_points.residual_m[1:][known]), np.sqrt(np.nanmedian(variance[known]))
        if misfit >= LARGEST_BENDING * noise:
            texts.append(
                f"the points depart from a rigid motion by {1e6 * misfit:.1f} µm rms, {misfit / noise:.0f} times their "
                "noise: the body bends, or parts of it move on their own"
            )
    missed = sum(fit is None for fit in fits)
    if missed:
        texts.append(
            f"in {missed} of {len(fits)} frames the motion could not be fitted to the grey values; its points count"
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
