"""One body through a series of stereo images: tracked subsets, points, and its rigid motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from photogram._checks import FloatArray
from photogram.camera import StereoRig
from photogram.direct import BodyView, DirectFit, fit_direct, image_noise, rest_covariance, view_body
from photogram.follow import tracks_of
from photogram.icgn import Registration
from photogram.images import ImageSequence
from photogram.interpolate import Spline, spline_of_image
from photogram.motion import RigidMotion, fit_motion
from photogram.noise import NoiseModel
from photogram.notice import Notice
from photogram.overlap import overlap_correlation
from photogram.quality import SubsetQuality, assess
from photogram.reference import Reference
from photogram.rigid import RigidTransform
from photogram.surface import PlacedCamera
from photogram.track import (
    FollowedFrame,
    StereoGrid,
    StereoTracks,
    TrackSettings,
    follow_sequence,
    lay_stereo_grid,
    prepare_sequence,
    stereo_tracks,
)
from photogram.triangulate import Points, triangulate

Progress = Callable[[int], None]
Splines = tuple[Spline, Spline]
Noise = tuple[NoiseModel, NoiseModel]
Views = tuple[BodyView, ...]
UNIFORM = NoiseModel(1.0, 0.0)
LARGEST_BENDING = 4.0  # rms, in standard deviations of the points; the reference's noise makes it 1.4
LARGEST_DIFFERENCE = 2.0  # rms, in standard uncertainties of the motion of the points


@dataclass(frozen=True, eq=False)
class BodyMotion:
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


@dataclass(frozen=True, eq=False)
class _Scene:
    """What stays the same through the series."""

    images: tuple[ImageSequence, ImageSequence]
    rig: StereoRig
    body_from_left: RigidTransform
    settings: TrackSettings
    grid: StereoGrid
    references: tuple[Reference, Reference]


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
    """
    grid = lay_stereo_grid(*images, rig, settings)
    left, right = (
        prepare_sequence(side, px, settings) for side, px in zip(images, (grid.left_px, grid.right_px), strict=True)
    )
    scene = _Scene(images, rig, body_from_left, settings, grid, (left, right))
    found, fits, views, noise = _follow(scene, progress, device)
    tracks = [tracks_of(side, reference, settings.degree) for side, reference in zip(found, (left, right), strict=True)]
    firsts = images[0].read(0), images[1].read(0)
    stereo = stereo_tracks(firsts, grid, (tracks[0], tracks[1]), settings)
    quality, remarks = None, list[Notice]()
    if noise is not None:
        quality = (
            assess(left, firsts[0], noise[0], images[0].full_scale),
            assess(right, firsts[1], noise[1], images[1].full_scale),
        )
        remarks = [*quality[0].notices("left camera"), *quality[1].notices("right camera")]
    points = triangulate(
        rig, tracks[0].position_px, tracks[1].position_px, tracks[0].covariance_px2, tracks[1].covariance_px2
    ).transformed(body_from_left)
    shared = None
    if settings.grid_step_px <= 2 * settings.radius_px:
        shared = overlap_correlation(grid.left_px, settings.radius_px)
    of_points = fit_motion(points, None, np.zeros(3), shared)
    motion = _with_direct(of_points, fits, views)
    notices = (*stereo.notices, *remarks, *_bending(points, of_points), *_direct_notices(motion, of_points, fits))
    return BodyMotion(stereo, points, motion, of_points, noise, quality, notices)


def _follow(
    scene: _Scene, progress: Progress | None, device: str
) -> tuple[tuple[list[Registration], list[Registration]], list[DirectFit | None], Views, Noise | None]:
    """Registrations of both cameras, direct fits of all frames but the first, the body's views and noise models."""
    found: tuple[list[Registration], list[Registration]] = ([], [])
    fits: list[DirectFit | None] = []
    sides = (
        follow_sequence(*side, scene.settings, device) for side in zip(scene.images, scene.references, strict=True)
    )
    first: Splines | None = None
    rest, views = np.empty((0, 3)), tuple[BodyView, ...]()
    noise: Noise | None = None
    for left, right in zip(*sides, strict=True):
        found[0].append(left.found)
        found[1].append(right.found)
        points = _place(scene, left.found, right.found)
        splines = _spline(left, scene.settings), _spline(right, scene.settings)
        if first is None:
            first, rest = splines, points.position_m[0]
            views = _views(scene, first, rest, (UNIFORM, UNIFORM))
        else:
            start = fit_motion(points, rest, np.zeros(3)).pose[0]
            fit = _fit(views, splines, start)
            if noise is None and fit is not None:
                noise = _noise(views, splines, fit)
                views = _views(scene, first, rest, noise)
                fit = _fit(views, splines, start)
            fits.append(fit)
        if progress is not None:
            progress(2 * len(found[0]))
    return found, fits, views, noise


def _place(scene: _Scene, left: Registration, right: Registration) -> Points:
    """Points (1, N) of one frame in the body's frame, all subsets equally trusted."""
    pixels = [
        (reference.centre_px + here.warp[:, [0, 3]])[None]
        for reference, here in zip(scene.references, (left, right), strict=True)
    ]
    return triangulate(scene.rig, pixels[0], pixels[1]).transformed(scene.body_from_left)


def _spline(frame: FollowedFrame, settings: TrackSettings) -> Spline:
    """The frame's spline, made here when tracking needed none."""
    return frame.spline if frame.spline is not None else spline_of_image(frame.image, settings.degree)


def _views(scene: _Scene, splines: Splines, rest_m: FloatArray, noise: Noise) -> Views:
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


def _noise(views: Views, splines: Splines, fit: DirectFit) -> Noise:
    """Noise models of both cameras from what a fit with equal weights leaves over in one frame."""
    left, right = (image_noise(view, spline, fit.moved) for view, spline in zip(views, splines, strict=True))
    return left, right


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
