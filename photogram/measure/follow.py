"""A body followed by a pair or by one camera: what stays the same through a series, and where it is frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby
from statistics import median

import numpy as np

from photogram.arrays import Arrays, BoolArray, FloatArray, spread_choice
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
)
from photogram.direct.shapes import PlainShapes, Shapes
from photogram.direct.surface import PlacedCamera, SeenPoints, motion_from_positions, project_body_points
from photogram.geometry import RigidTransform
from photogram.images.noise import NoiseModel
from photogram.images.sequence import GreyImage, ImageSequence
from photogram.motion import fit_motion
from photogram.subsets.find import BodyNotFound, DepthRange, Follower, identity_registration
from photogram.subsets.icgn import Registration, TrackSettings
from photogram.subsets.reference import ReferenceSubsets
from photogram.subsets.search import HISTORY, predict_next, predict_warp
from photogram.subsets.track import StereoGrid, first_frame, lay_single_grid, lay_stereo_grid, prepare_sequence

Progress = Callable[[int], None]
Splines = tuple[Spline, ...]
Noise = tuple[NoiseModel, ...]
Registrations = tuple[Registration, ...]
"""Of each camera: the left and the right one of a pair, or the only one."""
UNIFORM = NoiseModel(1.0, 0.0)
BLOCK_FRAMES = 64
"""A constant, so that results do not depend on who computes them; few enough to share, many enough to start seldom."""
GPU_BLOCK_FRAMES = 1024
"""On a GPU, which follows frames in batches: more than most series have, few enough to hold."""
MIN_PREDICTION_FRAMES = 4
"""Frames in a row that foretell the next: as many as the rule of one sine about any mean takes."""
FEWEST_CONTINUED = 6
"""Frames in a row that a mean and one line are fitted to, to foretell the next."""
LARGEST_LEFT = 8.0
"""Standard uncertainties by which a motion that its terms foretell may be off: less than half of the step that may be
the last one of a fit."""
LEAST_CELL_PX = 9  # of which gain and offset leave most of what its pixels tell
FITS_KEPT = 128  # as far back as sines are fitted that foretell many frames
FEW_MORE = 1.25  # times the frames wanted, below which subsets are looked for in all
LOUDER = 4.0
"""Times the noise of the frames before, beyond which a foretold fit is not believed without subsets."""
ELSEWHERE_PX = 0.5
"""Median distance of subsets from where the motion takes them, beyond which one of both is wrong."""

FollowedFrame = tuple[Registrations | None, DirectFit | None]
FollowedBlock = tuple[FollowedFrame, ...]
"""Successive frames: where the subsets are in each camera, None where they were not looked for, and
the direct fit, None for none."""


@dataclass(frozen=True, eq=False, repr=False)
class BodyPrior(Arrays, shapes="terms F m; absent F"):
    """What is known of a body before it is seen.

    `depth_m`: nearest and farthest depth in the left camera at which it can be, where its pattern may repeat. `shapes`:
    in which it may deform, `PlainShapes` where none are known. `rolls`: rows of its pictures are exposed one after the
    other, so that they show no rigid body before its motion is known: subsets alone are followed. `terms` (F, m): of
    which its motion over the frames is mostly a sum (`sine_terms`), those that matter most first; None if unknown. They
    foretell where it is, and take no part in what is measured. `absent` (F,): frames that show nothing of their own
    instant, which are not looked at; None for none.
    """

    depth_m: DepthRange | None = None
    shapes: Shapes | None = None
    rolling_shutter: bool = False
    terms: FloatArray | None = None
    absent: BoolArray | None = None

    def is_absent(self, number: int) -> bool:
        """Whether a frame is absent."""
        return self.absent is not None and bool(self.absent[number])


@dataclass(frozen=True, eq=False, repr=False)
class BodyScene(Arrays, shapes="rest_m N 3; subset_frames F"):
    """What stays the same through a series, whoever follows which of its frames.

    views: the body at rest, whose points are rest_m (N, 3), weighted by the `noise` of the images, which is None where
    no frame tells it; seen: those points in each camera. lead: the frames after the first, mostly one, that were
    followed to find that noise. blocks: the other frames, each block of which is followed from the reference on, by
    itself. first: the first images; near: the views with some of their cells, none of few. sought (F,): in which frames
    subsets are looked for, whatever the direct fit says.
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

    @property
    def shapes(self) -> Shapes:
        """In which the body may deform."""
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
    """Return what following a body needs: its subsets, its surface, and the noise of the images.

    The surface is triangulated by a pair; of a camera alone it is the face that its rig states. Blocks have
    `BLOCK_FRAMES` frames, on a GPU `GPU_BLOCK_FRAMES`.
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
    rest_m = _place(scene, tuple(map(identity_registration, references))).position_m[0]
    seen = tuple(project_body_points(camera, rest_m) for camera in cameras_about(scene, rest_m))
    scene = replace(scene, rest_m=rest_m, seen=seen)
    scene = replace(scene, views=body_views(scene, splines))
    _tell(progress, 1)
    scene = _with_noise(scene, progress)
    rest = range(1 + len(scene.lead), len(images[0]))
    length = BLOCK_FRAMES if device == "cpu" else GPU_BLOCK_FRAMES
    blocks = tuple(rest[start : start + length] for start in range(0, len(rest), length))
    sought = every if settings.frames is None else _sought(rest, settings.frames)
    return replace(scene, near=decimate(scene.views), blocks=blocks, subset_frames=sought)


def _sought(rest: range, wanted: int) -> BoolArray:
    """In which frames subsets are looked for, about `wanted` of them, `rest` being the later ones; in all if few more.

    In the first ones, in those that foretell the others of a block, whoever follows how many at once, and in a part of
    the others that has no period, so that no two lines that all frames tell apart fold onto each other.
    """
    numbers = np.arange(rest.stop)
    sought = (numbers < rest.start) | ((numbers - rest.start) % BLOCK_FRAMES < MIN_PREDICTION_FRAMES)
    others = int(np.count_nonzero(~sought))
    if len(sought) < FEW_MORE * wanted or others == 0:
        return np.ones(len(sought), dtype=np.bool_)
    return np.asarray(sought | spread_choice(numbers, max(0.0, (wanted - len(sought) + others) / others)))


def follow_block(
    scene: BodyScene, frames: range, device: str = "cpu", progress: Progress | None = None
) -> FollowedBlock:
    """Follow the body through a block of later frames; the first of them is found from the reference alone."""
    followed = []
    for number, one in zip(frames, _found(BodyTracker(scene), frames, device), strict=True):
        followed.append(one)
        _tell(progress, number + 1)
    return tuple(followed)


def iterate_blocks(scene: BodyScene, blocks: Iterable[FollowedBlock]) -> Iterator[FollowedBlock]:
    """The scene's frames from the reference on, no more than `BLOCK_FRAMES` at a time."""
    own = tuple(map(identity_registration, scene.references))
    for block in chain([((own, None), *scene.lead)], blocks):
        for start in range(0, len(block), BLOCK_FRAMES):
            yield block[start : start + BLOCK_FRAMES]


def _found(course: BodyTracker, frames: range, device: str) -> Iterator[FollowedFrame]:
    """The body and its subsets in some frames in turn, nothing in those that are absent."""
    for absent, group in groupby(frames, course.scene.body.is_absent):
        numbers = list(group)
        if absent:
            yield from (course.add_frame(None, None) for _ in numbers)
        else:
            yield from _found_in(course, range(numbers[0], numbers[-1] + 1), device)


def _found_in(course: BodyTracker, frames: range, device: str) -> Iterator[FollowedFrame]:
    """The body and its subsets in some frames in turn; on a GPU together as far as they are foretold."""
    if device != "cpu" and not course.scene.body.rolling_shutter:
        from photogram.measure.follow_torch import find_in_batches

        yield from find_in_batches(course, frames, device)
        return
    read = zip(*(images.read_ahead(frames) for images in course.scene.images), strict=True)
    for number, images in zip(frames, read, strict=True):
        yield course.find(number, images)


class BodyTracker:
    """A body followed from frame to frame of a block: what those so far foretell of the next.

    fits: of the last frames in a row that have one, at most `FITS_KEPT`.
    """

    def __init__(self, scene: BodyScene) -> None:
        self.scene, self.fits = scene, list[DirectFit]()
        self.sides = followers(scene)
        self._history, self._last = list[Registrations](), scene.lead[-1][0] if scene.lead else None

    def find(self, number: int, images: tuple[GreyImage, ...]) -> FollowedFrame:
        """Fit the body from where the last frames foretell it, and look for its subsets from there.

        Where nothing is foretold, or the subsets are elsewhere, it is fitted from its subsets, which are looked for.
        """
        splines = tuple(spline_of_image(image, self.scene.settings.degree) for image in images)
        fit = self._foretold_fit(number, splines)
        here: Registrations | None = None
        if fit is None or self.scene.subset_frames[number]:
            starts = self.subset_starts(fit)
            seen = zip(self.sides, images, splines, starts, strict=True)
            here = tuple(side.find((image, spline), start) for side, image, spline, start in seen)
            if fit is None or any(subsets_displaced(one.warp, start) for one, start in zip(here, starts, strict=True)):
                fit = _fit(self.scene, here, splines)
        return self.add_frame(here, fit)

    def _foretold_fit(self, number: int, splines: Splines) -> DirectFit | None:
        """The direct fit of a frame from where those before it foretell the body; None where it has none like theirs.

        Some of the cells first lead nearer where the frames before it do not show that this is spared.
        """
        if len(self.fits) < MIN_PREDICTION_FRAMES:
            return None
        scene, along = self.scene, self.extrapolate(range(number, number + 1))
        start: RigidTransform | None
        if len(along):
            start = RigidTransform.from_pose(along[0])
        else:
            start = predict_motion(self.fits)
            start = coarse_fit(scene.near, splines, start) if scene.near else start
        fit = None if start is None else fit_direct(scene.views, splines, start)
        return None if fit is None or has_excess_noise(fit, self.fits) else fit

    def extrapolate(self, numbers: range) -> FloatArray:
        """Where the terms of the motion take the body in the next frames, `numbers`: poses (n, 6) of as many of them
        as are foretold.

        Half as many terms as there are frames before them, by least squares. A frame is foretold if s·√(1 + |w|²) is
        less than `LARGEST_LEFT`: w what each pose so far weighs in the frame's, s the rms that the terms leave of the
        last of them.
        """
        terms, count = self.scene.body.terms, len(self.fits)
        if terms is None or count < FEWEST_CONTINUED:
            return np.empty((0, 6))
        used = terms[numbers.start - count : numbers.stop, : (count // 2 - 1) | 1]
        known, coming = used[:count], used[count:]
        inverse = np.linalg.pinv(known, rcond=np.finfo(np.float64).eps * count)
        poses = np.array([fit.moved.pose for fit in self.fits])
        parts, weight = inverse @ poses, coming @ inverse
        left = (poses - known @ parts)[-MIN_PREDICTION_FRAMES:] / np.sqrt(np.diagonal(self.fits[-1].covariance))
        off = np.sqrt(np.mean(np.sum(left**2, axis=1)) * (1.0 + np.sum(weight**2, axis=1)))
        return np.asarray((coming @ parts)[np.logical_and.accumulate(off < LARGEST_LEFT)])

    def subset_starts(self, fit: DirectFit | None) -> list[FloatArray | None]:
        """Where each camera's subsets are to be looked for: where a fit takes those that were found last, else where
        the frames before foretell them; None where nothing does."""
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

    def add_frame(self, here: Registrations | None, fit: DirectFit | None) -> FollowedFrame:
        """Take in what was found in the next frame."""
        if here is None:
            self._history = []
        else:
            self._last, self._history = here, [*self._history[1 - HISTORY :], here]
        self.fits = [] if fit is None else [*self.fits[1 - FITS_KEPT :], fit]
        return here, fit


def sine_terms(time_s: FloatArray, frequency_hz: FloatArray) -> FloatArray:
    """Return a constant, and cosine and sine of each line (K,), at the times of the frames (F,): (F, 1 + 2K)."""
    phase = 2.0 * np.pi * np.outer(time_s, frequency_hz)
    both = np.stack([np.cos(phase), np.sin(phase)], axis=2).reshape(len(phase), -1)
    return np.hstack([np.ones((len(phase), 1)), both])


def image_motion_px(seen: SeenPoints, moved: RigidTransform) -> FloatArray:
    """By how much a body's motion moves its points (N, 2) in a camera."""
    return np.asarray(seen.camera.project(moved.apply(seen.points_m)) - seen.rest_px)


def central_point(seen: SeenPoints) -> SeenPoints:
    """The known one of a body's points that a camera shows nearest to their middle, at rest."""
    off_px = np.linalg.norm(seen.rest_px - np.nanmedian(seen.rest_px, axis=0), axis=1)
    only = slice(nearest := int(np.nanargmin(off_px)), nearest + 1)
    return replace(seen, points_m=seen.points_m[only], rates=seen.rates[only])


def predict_motion(fits: Sequence[DirectFit]) -> RigidTransform:
    """Return the motion that the last frames foretell of the next."""
    last = fits[-HISTORY:]
    weights = 1.0 / np.sqrt(np.diagonal(last[-1].covariance))
    return RigidTransform.from_pose(predict_next([fit.moved.pose for fit in last], weights))


def has_excess_noise(fit: DirectFit, before: Sequence[DirectFit]) -> bool:
    """Whether a fit leaves far more noise than those before it, as in a place that is not the body's."""
    return fit.noise > LOUDER * median(one.noise for one in before[-HISTORY:])


def subsets_displaced(warp: FloatArray, start: FloatArray | None) -> BoolArray:
    """Whether not even half of the subsets (..., N, p) are where they were looked for, or nothing foretold them."""
    if start is None:
        return np.asarray(True)
    near = np.hypot(*np.moveaxis((warp - start)[..., [0, 3]], -1, 0)) < ELSEWHERE_PX
    looked_for = np.isfinite(start).all(axis=-1)
    return np.asarray(2 * near.sum(axis=-1) <= looked_for.sum(axis=-1))


def followers(scene: BodyScene) -> tuple[Follower, ...]:
    """Return what finds the subsets of each camera."""
    return tuple(
        Follower(reference, first, images.saturation, scene.settings)
        for reference, first, images in zip(scene.references, scene.first, scene.images, strict=True)
    )


def _with_noise(scene: BodyScene, progress: Progress | None) -> BodyScene:
    """The scene with the noise models of the first frame that can be fitted, and what was found up to it."""
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
            noise = tuple(image_noise(*one, moved=fit.moved) for one in zip(scene.views, splines, strict=True))
            weighed = zip(scene.views, noise, strict=True)
            views = tuple(reweight_view(view, model, scene.settings.degree) for view, model in weighed)
            scene = replace(scene, noise=noise, views=views)
            fit = _fit(scene, found, splines)
        scene = replace(scene, lead=(*scene.lead, (found, fit)))
        _tell(progress, number + 1)
        if scene.noise is not None:
            break
    return scene


def _tell(progress: Progress | None, frames: int) -> None:
    """Say that all images of so many frames are done, two of each, as of a pair."""
    if progress is not None:
        progress(2 * frames)


def _places(scene: BodyScene, found: Registrations) -> tuple[FloatArray, ...]:
    """Where the subsets (N, 2) of one frame are in each camera, NaN where they are not found."""
    both = zip(scene.references, found, strict=True)
    return tuple(reference.centre_px + here.warp[:, [0, 3]] for reference, here in both)


def _place(scene: BodyScene, found: Registrations) -> Points3D:
    """Points (1, N) of one frame in the body's frame, all subsets equally trusted."""
    return locate(scene.rig, [place[None] for place in _places(scene, found)]).transformed(scene.body_from_left)


def cameras_about(scene: BodyScene, rest_m: FloatArray) -> tuple[PlacedCamera, ...]:
    """The cameras about the body; `BodyNotFound` where the calibration places no points of it."""
    placed = int(np.count_nonzero(np.isfinite(rest_m).all(axis=1)))
    if placed < 3:
        text = f"at least 3 points that both cameras see in one place, found {placed} of {len(rest_m)}"
        raise BodyNotFound(f"rig: expected {text}; the calibration does not belong to these images")
    left_from_body = scene.body_from_left.inverse()
    return tuple(PlacedCamera(camera, from_left @ left_from_body) for camera, from_left in scene.rig.camera_poses)


def body_views(scene: BodyScene, splines: Splines, most_px: float = np.inf) -> tuple[BodyView, ...]:
    """The body at rest in each camera, all pixels equally trusted, in cells as large as subsets or as they may be."""
    side_px, shapes = int(min(2 * scene.settings.radius_px + 1, max(LEAST_CELL_PX, most_px))), scene.shapes
    return tuple(
        view_body(one.camera, (spline, area, float(images.saturation)), one.points_m, side_px, UNIFORM, shapes)
        for one, spline, area, images in zip(scene.seen, splines, scene.grid.areas, scene.images, strict=True)
    )


def _fit(scene: BodyScene, found: Registrations, splines: Splines) -> DirectFit | None:
    """The direct fit of one frame, begun where its subsets are; None where it has none."""
    if scene.body.rolling_shutter:
        return None
    start = motion_from_positions(scene.seen, _places(scene, found))
    fit = None if start is None else fit_direct(scene.views, splines, start)
    if fit is None:  # from all that the points tell, whatever it costs
        pose = fit_motion(_place(scene, found), scene.rest_m, np.zeros(3)).pose[0]
        fit = fit_direct(scene.views, splines, RigidTransform.from_pose(pose)) if np.isfinite(pose).all() else None
    return fit
