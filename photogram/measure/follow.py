"""A body tracked by a pair or by one camera: constant properties, and each frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from statistics import median

import numpy as np

from photogram.bspline import Spline, spline_of_image
from photogram.camera import Points3D, Rig, StereoRig, locate
from photogram.direct.direct_fit import (
    BodyView,
    DirectFit,
    coarse_fit,
    decimate,
    fit_direct,
    image_noise,
    reweight_view,
    view_body,
    views_near,
)
from photogram.direct.surface import (
    PlacedCamera,
    PlainShapes,
    SeenPoints,
    Shapes,
    motion_from_positions,
    project_body_points,
)
from photogram.frame_statistics import spread_choice
from photogram.geometry import RigidTransform
from photogram.images.noise import NoiseModel
from photogram.images.sequence import GreyImage, ImageSequence
from photogram.motion import fit_motion
from photogram.subsets.find import BodyNotFound, DepthRange, Follower, identity_registration
from photogram.subsets.icgn import Registration, TrackSettings
from photogram.subsets.reference import ReferenceSubsets
from photogram.subsets.search import HISTORY, predict_next, predict_warp
from photogram.subsets.track import StereoGrid, first_frame, lay_single_grid, lay_stereo_grid, prepare_sequence
from shakercal._common.arrays import Arrays, BoolArray, FloatArray
from shakercal._common.notices import Notice

Progress = Callable[[int], None]
Splines = tuple[Spline, ...]
Noise = tuple[NoiseModel, ...]
Registrations = tuple[Registration, ...]
"""Of each camera: left and right of a pair, or the only one."""
CAMERAS = ("left camera", "right camera")
UNIFORM = NoiseModel(1.0, 0.0)
BLOCK_FRAMES = 64
"""Constant, so that results do not depend on the number of processes: a compromise of sharing and restarts."""
GPU_BLOCK_FRAMES = 1024
"""On a GPU, which tracks frames in batches: more than most series have."""
MIN_PREDICTION_FRAMES = 4
"""Consecutive frames that predict the next: required for the rule of one sine about any mean."""
MIN_EXTRAPOLATION_FRAMES = 6
"""Consecutive frames for the fit of a mean and one line."""
MAX_PREDICTION_ERROR = 8.0
"""Standard uncertainties of a motion predicted by its terms: less than half of the last step that a fit permits."""
MIN_CELL_PX = 9  # in which gain and offset use up little of the information
MAX_FITS = 128  # frames to which predicting sines are fitted
FEW_MORE = 1.25  # times the desired frames, below which subsets are searched in all
MAX_NOISE_RATIO = 4.0
"""Times the noise of the frames before, beyond which a predicted fit is checked by subsets."""
MAX_DISPLACEMENT_PX = 0.5
"""Median distance of subsets from their predicted positions, beyond which one of both is wrong."""

FollowedFrame = tuple[Registrations | None, DirectFit | None]
FollowedBlock = tuple[FollowedFrame, ...]
"""Successive frames: the registrations in each camera, None where not searched, and the direct fit or None."""


@dataclass(frozen=True, eq=False, repr=False)
class BodyPrior(Arrays, shapes="terms F m; absent F"):
    """Information about a body before it is seen.

    Attributes
    ----------
    depth_m : nearest and farthest possible depth in the left camera, for repeating patterns.
    shapes : possible deformations; None (default) for `PlainShapes`.
    rolling_shutter : rows are exposed one after the other, so that images show no rigid body before its motion is
        estimated: only subsets are tracked.
    terms : (F, m) of which its motion is mainly a sum (`sine_terms`), the most important first; None if unknown. They
        predict its position, and do not enter the measurement.
    absent : (F,) frames that do not show their instant, which are skipped; None for none.
    displaced : further images of each camera, of the body displaced by some pixels, which show how large the fixed
        pattern of the sensors is.
    """

    depth_m: DepthRange | None = None
    shapes: Shapes | None = None
    rolling_shutter: bool = False
    terms: FloatArray | None = None
    absent: BoolArray | None = None
    displaced: tuple[ImageSequence, ...] = ()

    def is_absent(self, number: int) -> bool:
        """Return whether a frame is absent."""
        return self.absent is not None and bool(self.absent[number])


@dataclass(frozen=True, eq=False, repr=False)
class BodyScene(Arrays, shapes="rest_m N 3; subset_frames F"):
    """Constant properties of a series, independent of how its frames are divided.

    Attributes
    ----------
    images, first : image sequences, and their first images.
    rig, body_from_left, settings, grid, references : cameras, frame of the body, and its subsets.
    body : information about it.
    rest_m : (N, 3) its points at rest.
    views : the body at rest, weighted by `noise`.
    near : the views with some of their cells; empty if they have few.
    seen : the points in each camera.
    noise : noise models of the images, None where no frame determines them.
    lead : frames after the first, usually one, that were tracked to find that noise.
    blocks : the other frames, each block of which is tracked separately from the reference.
    subset_frames : (F,) in which subsets are searched, even if the direct fit succeeds.
    noise_notices : of noise that the models do not explain.
    """

    images: tuple[ImageSequence, ...]
    first: tuple[GreyImage, ...]
    rig: Rig
    body_from_left: RigidTransform
    settings: TrackSettings
    grid: StereoGrid
    references: tuple[ReferenceSubsets, ...]
    body: BodyPrior
    rest_m: FloatArray
    views: tuple[BodyView, ...]
    near: tuple[BodyView, ...]
    seen: tuple[SeenPoints, ...]
    noise: Noise | None
    lead: FollowedBlock
    blocks: tuple[range, ...]
    subset_frames: BoolArray
    noise_notices: tuple[Notice, ...] = ()

    @property
    def shapes(self) -> Shapes:
        """Possible deformations of the body."""
        return self.body.shapes or PlainShapes.of(self.rest_m)


def prepare_body(
    images: tuple[ImageSequence, ...],
    rig: Rig,
    body_from_left: RigidTransform,
    settings: TrackSettings,
    device: str = "cpu",
    progress: Progress | None = None,
    prior: BodyPrior | None = None,
) -> BodyScene:
    """Return the scene for tracking a body: its subsets, its surface, and the images' noise.

    A pair triangulates the surface; of a single camera it is the face that its rig states. Blocks have `BLOCK_FRAMES`
    frames, on a GPU `GPU_BLOCK_FRAMES`.
    """
    prior = prior or BodyPrior()
    frames = tuple(first_frame(side, settings) for side in images)
    first, splines = zip(*frames, strict=True)
    if isinstance(rig, StereoRig):
        left, right = images
        grid = lay_stereo_grid(left, right, rig, settings, prior.depth_m, frames)
    else:
        grid = lay_single_grid(images[0], settings, first[0])
    placed = zip(images, grid.centres_px, frames, strict=True)
    references = tuple(prepare_sequence(side, px, settings, frame) for side, px, frame in placed)
    fixed = images, first, rig, body_from_left, settings, grid, references
    every = np.ones(len(images[0]), dtype=np.bool_)
    scene = BodyScene(*fixed, prior, np.empty((0, 3)), (), (), (), None, (), (), every)
    at_rest = subset_centres(scene, tuple(map(identity_registration, references)))
    rest_m = locate_subsets(scene, at_rest).position_m[0]
    seen = tuple(project_body_points(camera, rest_m) for camera in cameras_about(scene, rest_m))
    scene = replace(scene, rest_m=rest_m, seen=seen)
    scene = replace(scene, views=body_views(scene, splines))
    report_progress(progress, 1)
    scene = _with_noise(scene, progress)
    rest = range(1 + len(scene.lead), len(images[0]))
    length = BLOCK_FRAMES if device == "cpu" else GPU_BLOCK_FRAMES
    blocks = tuple(rest[start : start + length] for start in range(0, len(rest), length))
    subset_frames = every if settings.frames is None else _choose_subset_frames(rest, settings.frames)
    return replace(scene, near=decimate(scene.views), blocks=blocks, subset_frames=subset_frames)


def _choose_subset_frames(rest: range, target: int) -> BoolArray:
    """Return in which frames subsets are searched, about `target` of them, or all.

    `rest`: the later frames. Chosen are the first frames, those that predict the others of a block, independently of
    how frames are divided, and an aperiodic part of the others. So no two lines that all frames resolve alias onto each
    other. All frames are chosen if they are few more.
    """
    numbers = np.arange(rest.stop)
    chosen = (numbers < rest.start) | ((numbers - rest.start) % BLOCK_FRAMES < MIN_PREDICTION_FRAMES)
    others = int(np.count_nonzero(~chosen))
    if len(chosen) < FEW_MORE * target or others == 0:
        return np.ones(len(chosen), dtype=np.bool_)
    return np.asarray(chosen | spread_choice(numbers, max(0.0, (target - len(chosen) + others) / others)))


def iterate_blocks(scene: BodyScene, blocks: Iterable[FollowedBlock]) -> Iterator[FollowedBlock]:
    """Yield the scene's frames from the reference on, at most `BLOCK_FRAMES` at a time."""
    at_rest = tuple(map(identity_registration, scene.references))
    for block in chain([((at_rest, None), *scene.lead)], blocks):
        for start in range(0, len(block), BLOCK_FRAMES):
            yield block[start : start + BLOCK_FRAMES]


class BodyTracker:
    """Tracker of a body from frame to frame of a block, with prediction.

    fits: of the last consecutive frames that have one, at most `MAX_FITS`. views, near: those of the scene, with rates
    that apply to the last prediction.
    """

    def __init__(self, scene: BodyScene) -> None:
        self.scene, self.fits = scene, list[DirectFit]()
        self.views, self.near = scene.views, scene.near
        self.sides = followers(scene)
        self._history, self._last = list[Registrations](), scene.lead[-1][0] if scene.lead else None

    def find(self, number: int, images: tuple[GreyImage, ...]) -> FollowedFrame:
        """Fit the body from the predicted motion, and find its subsets from there.

        Without a prediction, or where the subsets are displaced, it is fitted from its subsets, which are searched.
        """
        splines = tuple(spline_of_image(image, self.scene.settings.degree) for image in images)
        fit = self._predicted_fit(number, splines)
        registered: Registrations | None = None
        if fit is None or self.scene.subset_frames[number]:
            starts = self.subset_starts(fit)
            seen = zip(self.sides, images, splines, starts, strict=True)
            registered = tuple(side.find((image, spline), start) for side, image, spline, start in seen)
            if fit is None or any(
                subsets_displaced(one.warp, start) for one, start in zip(registered, starts, strict=True)
            ):
                fit = _fit(self.scene, registered, splines)
        return self.add_frame(registered, fit)

    def _predicted_fit(self, number: int, splines: Splines) -> DirectFit | None:
        """Return the direct fit of a frame from the predicted motion.

        None if it differs from those before. Some of the cells first improve the prediction, unless earlier frames show
        that it is precise enough.
        """
        if len(self.fits) < MIN_PREDICTION_FRAMES:
            return None
        along, start = self.extrapolate(range(number, number + 1)), None
        if len(along):
            start = RigidTransform.from_pose(along[0])
        else:
            start = predict_motion(self.fits)
            self.near = views_near(self.near, start)
            start = coarse_fit(self.near, splines, start) if self.near else start
        if start is None:
            return None
        self.views = views_near(self.views, start)
        fit = fit_direct(self.views, splines, start)
        return None if fit is None or has_excess_noise(fit, self.fits) else fit

    def extrapolate(self, numbers: range) -> FloatArray:
        """Return poses (n, 6) of the next frames `numbers` by the terms of the motion.

        n is the number of frames that are predictable. Half as many terms as there are frames before are fitted by
        least squares. A frame is predictable if s·√(1 + |w|²) is less than `MAX_PREDICTION_ERROR`: w the weights of the
        earlier poses, s the rms residual of the last of them.
        """
        terms, count = self.scene.body.terms, len(self.fits)
        if terms is None or count < MIN_EXTRAPOLATION_FRAMES:
            return np.empty((0, 6))
        used = terms[numbers.start - count : numbers.stop, : (count // 2 - 1) | 1]
        earlier, coming = used[:count], used[count:]
        inverse = np.linalg.pinv(earlier, rcond=np.finfo(np.float64).eps * count)
        poses = np.array([fit.moved.pose for fit in self.fits])
        parts, weight = inverse @ poses, coming @ inverse
        left = (poses - earlier @ parts)[-MIN_PREDICTION_FRAMES:] / np.sqrt(np.diagonal(self.fits[-1].covariance))
        off = np.sqrt(np.mean(np.sum(left**2, axis=1)) * (1.0 + np.sum(weight**2, axis=1)))
        return np.asarray((coming @ parts)[np.logical_and.accumulate(off < MAX_PREDICTION_ERROR)])

    def subset_starts(self, fit: DirectFit | None) -> list[FloatArray | None]:
        """Return start warps of each camera's subsets, None without a prediction.

        Subsets found last are moved by the fit; without a fit their earlier positions predict them.
        """
        starts: list[FloatArray | None] = []
        for side, seen in enumerate(self.scene.seen):
            start = None
            if fit is not None and self._last is not None:
                start = self._last[side].warp.copy()
                start[:, [0, 3]] = image_motion_px(seen, fit.moved)
            elif self._history:
                start = predict_warp([both[side].warp for both in self._history])
            starts.append(start)
        return starts

    def add_frame(self, found: Registrations | None, fit: DirectFit | None) -> FollowedFrame:
        """Add the next frame, and return it, with cell residuals only beside subsets."""
        if found is None:
            self._history = []
            fit = None if fit is None else replace(fit, scores=fit.scores[:0])
        else:
            self._last, self._history = found, [*self._history[1 - HISTORY :], found]
        self.fits = [] if fit is None else [*self.fits[1 - MAX_FITS :], fit]
        return found, fit


def sine_terms(time_s: FloatArray, frequency_hz: FloatArray) -> FloatArray:
    """Return (F,1+2K): a constant, and cosine and sine of each line at times (F,)."""
    phase = 2.0 * np.pi * np.outer(time_s, frequency_hz)
    both = np.stack([np.cos(phase), np.sin(phase)], axis=2).reshape(len(phase), -1)
    return np.hstack([np.ones((len(phase), 1)), both])


def image_motion_px(seen: SeenPoints, moved: RigidTransform) -> FloatArray:
    """Return the displacement of a body's points (N, 2) in a camera by its motion."""
    return np.asarray(seen.camera.project(moved.apply(seen.points_m)) - seen.rest_px)


def central_point(seen: SeenPoints) -> SeenPoints:
    """Return the finite point of a body nearest to the middle of its image."""
    off_px = np.linalg.norm(seen.rest_px - np.nanmedian(seen.rest_px, axis=0), axis=1)
    only = slice(nearest := int(np.nanargmin(off_px)), nearest + 1)
    return replace(seen, points_m=seen.points_m[only], rates=seen.rates[only])


def predict_motion(fits: Sequence[DirectFit]) -> RigidTransform:
    """Return the motion of the next frame as predicted by the last ones."""
    last = fits[-HISTORY:]
    weights = 1.0 / np.sqrt(np.diagonal(last[-1].covariance))
    return RigidTransform.from_pose(predict_next([fit.moved.pose for fit in last], weights))


def has_excess_noise(fit: DirectFit, before: Sequence[DirectFit]) -> bool:
    """Return whether a fit leaves far more noise than those before."""
    return fit.noise_ratio > MAX_NOISE_RATIO * median(one.noise_ratio for one in before[-HISTORY:])


def subsets_displaced(warp: FloatArray, start: FloatArray | None) -> BoolArray:
    """Return whether at most half of the subsets (...,N,p) are at their start.

    Also true without a start.
    """
    if start is None:
        return np.asarray(True)
    near = np.hypot(*np.moveaxis((warp - start)[..., [0, 3]], -1, 0)) < MAX_DISPLACEMENT_PX
    looked_for = np.isfinite(start).all(axis=-1)
    return np.asarray(2 * near.sum(axis=-1) <= looked_for.sum(axis=-1))


def followers(scene: BodyScene) -> tuple[Follower, ...]:
    """Return the finders of the subsets of each camera."""
    return tuple(
        Follower(reference, first, images.saturation, scene.settings)
        for reference, first, images in zip(scene.references, scene.first, scene.images, strict=True)
    )


def _with_noise(scene: BodyScene, progress: Progress | None) -> BodyScene:
    """Return the scene with the noise models of the first frame that can be fitted.

    Its lead contains the frames up to that one.
    """
    sides = followers(scene)
    for number in range(1, 1 if scene.body.rolling_shutter else len(scene.images[0])):
        if scene.body.is_absent(number):
            scene = replace(scene, lead=(*scene.lead, (None, None)))
            continue
        images = [one.read(number) for one in scene.images]
        splines = tuple(spline_of_image(image, scene.settings.degree) for image in images)
        seen = zip(sides, images, splines, strict=True)
        found = tuple(side.find((image, spline), None) for side, image, spline in seen)
        fit = _fit(scene, found, splines)
        if fit is not None:
            scene = reweight_scene(scene, scene.views, splines, fit.moved)
            fit = _fit(scene, found, splines)
        scene = replace(scene, lead=(*scene.lead, (found, fit)))
        report_progress(progress, number + 1)
        if scene.noise is not None:
            break
    return scene


def reweight_scene(
    scene: BodyScene, views: Sequence[BodyView], targets: Sequence[Spline], moved: RigidTransform
) -> BodyScene:
    """Return the scene weighted by the noise of one frame's images.

    `views`: as compared with the images `targets` after the motion `moved`.
    """
    found = (
        image_noise(view, target, moved, name) for view, target, name in zip(views, targets, CAMERAS, strict=False)
    )
    noise, notices = zip(*found, strict=True)
    weighed = zip(scene.views, noise, strict=True)
    renewed = tuple(reweight_view(view, model, scene.settings.degree) for view, model in weighed)
    return replace(scene, noise=noise, views=renewed, noise_notices=tuple(chain.from_iterable(notices)))


def report_progress(progress: Progress | None, frames: int) -> None:
    """Report the images of so many frames as done, two of each."""
    if progress is not None:
        progress(2 * frames)


def subset_centres(scene: BodyScene, found: Registrations) -> tuple[FloatArray, ...]:
    """Return positions (N,2) of the subsets in each camera, NaN if not found."""
    both = zip(scene.references, found, strict=True)
    return tuple(reference.centre_px + registration.warp[:, [0, 3]] for reference, registration in both)


def locate_subsets(scene: BodyScene, positions_px: Sequence[FloatArray]) -> Points3D:
    """Return points (1, N) in the body's frame from positions (N, 2) in each camera."""
    return locate(scene.rig, [pixels[None] for pixels in positions_px]).transformed(scene.body_from_left)


def cameras_about(scene: BodyScene, rest_m: FloatArray) -> tuple[PlacedCamera, ...]:
    """Return the cameras relative to the body.

    Raises `BodyNotFound` where the calibration triangulates fewer than three points of it.
    """
    placed = int(np.count_nonzero(np.isfinite(rest_m).all(axis=1)))
    if placed < 3:
        text = f"at least 3 points on which both cameras agree, found {placed} of {len(rest_m)}"
        raise BodyNotFound(f"rig: expected {text}; the calibration does not belong to these images")
    left_from_body = scene.body_from_left.inverse()
    return tuple(PlacedCamera(camera, from_left @ left_from_body) for camera, from_left in scene.rig.camera_poses)


def body_views(scene: BodyScene, splines: Splines, most_px: float = np.inf) -> tuple[BodyView, ...]:
    """Return the body at rest in each camera, all pixels weighted equally.

    most_px: largest side of a cell.
    """
    side_px, shapes = int(min(2 * scene.settings.radius_px + 1, max(MIN_CELL_PX, most_px))), scene.shapes
    return tuple(
        view_body(one.camera, (spline, area, float(images.saturation)), one.points_m, side_px, UNIFORM, shapes)
        for one, spline, area, images in zip(scene.seen, splines, scene.grid.areas, scene.images, strict=True)
    )


def _fit(scene: BodyScene, found: Registrations, splines: Splines) -> DirectFit | None:
    """Return the direct fit of one frame from the positions of its subsets."""
    if scene.body.rolling_shutter:
        return None
    start = motion_from_positions(scene.seen, subset_centres(scene, found))
    fit = None if start is None else fit_direct(scene.views, splines, start)
    if fit is None:  # from a fit of the points, which takes longer
        pose = fit_motion(locate_subsets(scene, subset_centres(scene, found)), scene.rest_m, np.zeros(3)).pose[0]
        fit = fit_direct(scene.views, splines, RigidTransform.from_pose(pose)) if np.isfinite(pose).all() else None
    return fit
