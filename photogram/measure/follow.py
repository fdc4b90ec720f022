"""A body followed through series of stereo images: what stays the same, and where it is frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, groupby

import numpy as np

from photogram.arrays import Arrays, BoolArray, FloatArray, spread_choice
from photogram.bspline import Spline, spline_of_image
from photogram.camera import Points, StereoRig, triangulate
from photogram.direct.fit import (
    BodyView,
    DirectFit,
    approach,
    fit_direct,
    image_noise,
    reweighted_view,
    thinned,
    view_body,
)
from photogram.direct.shapes import PlainShapes, Shapes
from photogram.geometry import RigidTransform
from photogram.images.noise import NoiseModel
from photogram.images.sequence import GreyImage, ImageSequence
from photogram.motion import PlacedCamera, SeenPoints, fit_motion, motion_of_places, see_points
from photogram.subsets.find import BodyNotFound, DepthRange, Follower, identity
from photogram.subsets.icgn import Registration, TrackSettings
from photogram.subsets.reference import Reference
from photogram.subsets.search import HISTORY, foretold, predict_warp
from photogram.subsets.track import FollowedImage, StereoGrid, follow_sequence, lay_stereo_grid, prepare_sequence

Progress = Callable[[int], None]
Splines = tuple[Spline, Spline]
Noise = tuple[NoiseModel, NoiseModel]
Found = tuple[Registration, Registration]
UNIFORM = NoiseModel(1.0, 0.0)
BLOCK_FRAMES = 32
"""A constant, so that results do not depend on who computes them; few enough to share, many enough to start seldom."""
GPU_BLOCK_FRAMES = 1024
"""On a GPU, which follows frames in batches: more than most series have, few enough to hold."""
FORETELLING = 4
"""Frames in a row that foretell the next: as many as the rule of one sine about any mean takes."""
FEW_MORE = 1.25  # times the frames wanted, below which subsets are looked for in all
LOUDER = 4.0
"""Times the noise of the frames before, beyond which a foretold fit is not believed without subsets."""
ELSEWHERE_PX = 0.5
"""Median distance of subsets from where the motion takes them, beyond which one of both is wrong."""

FollowedFrame = tuple[Found | None, DirectFit | None]
FollowedBlock = tuple[FollowedFrame, ...]
"""Successive frames: where the subsets are in the left and the right camera, None where they were not looked for, and
the direct fit, None for none."""


@dataclass(frozen=True)
class KnownBody:
    """What is known of a body before it is seen.

    `depth_m`: nearest and farthest depth in the left camera at which it can be, where its pattern may repeat. `shapes`:
    in which it may deform, `PlainShapes` where none are known. `rolls`: rows of its pictures are exposed one after the
    other, so that they show no rigid body before its motion is known: subsets alone are followed.
    """

    depth_m: DepthRange | None = None
    shapes: Shapes | None = None
    rolls: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class BodyScene(Arrays, shapes="rest_m N 3; sought F"):
    """What stays the same through a series, whoever follows which of its frames.

    views: the body at rest, whose points are rest_m (N, 3), weighted by the `noise` of the images, which is None where
    no frame tells it; seen: those points in each camera. lead: the frames after the first, mostly one, that were
    followed to find that noise. blocks: the other frames, each block of which is followed from the reference on, by
    itself. first: the first images; near: the views with some of their cells, none of few. sought (F,): in which frames
    subsets are looked for, whatever the direct fit says.
    """

    images: tuple[ImageSequence, ImageSequence]
    first: tuple[GreyImage, GreyImage]
    rig: StereoRig
    body_from_left: RigidTransform
    settings: TrackSettings
    grid: StereoGrid
    references: tuple[Reference, Reference]
    body: KnownBody
    rest_m: FloatArray
    views: tuple[BodyView, ...]
    near: tuple[BodyView, ...]
    seen: tuple[SeenPoints, ...]
    noise: Noise | None
    lead: FollowedBlock
    blocks: tuple[range, ...]
    sought: BoolArray

    @property
    def shapes(self) -> Shapes:
        """In which the body may deform."""
        return self.body.shapes or PlainShapes.of(self.rest_m)


def prepare_body(
    images: tuple[ImageSequence, ImageSequence],
    rig: StereoRig,
    body_from_left: RigidTransform,
    settings: TrackSettings,
    device: str = "cpu",
    progress: Progress | None = None,
    known: KnownBody | None = None,
) -> BodyScene:
    """Return what following a body needs: its subsets, its surface, and the noise of the images.

    Blocks have `BLOCK_FRAMES` frames, on a GPU `GPU_BLOCK_FRAMES`.
    """
    known = known or KnownBody()
    grid = lay_stereo_grid(*images, rig, settings, known.depth_m)
    left, right = (
        prepare_sequence(side, px, settings) for side, px in zip(images, (grid.left_px, grid.right_px), strict=True)
    )
    first = images[0].read(0), images[1].read(0)
    fixed = images, first, rig, body_from_left, settings, grid, (left, right)
    every = np.ones(len(images[0]), dtype=np.bool_)
    scene = BodyScene(*fixed, known, np.empty((0, 3)), (), (), (), None, (), (), every)
    rest_m = _place(scene, (identity(left), identity(right))).position_m[0]
    splines = spline_of_image(first[0], settings.degree), spline_of_image(first[1], settings.degree)
    seen = tuple(see_points(camera, rest_m) for camera in cameras_about(scene, rest_m))
    scene = replace(scene, rest_m=rest_m, seen=seen)
    scene = replace(scene, views=body_views(scene, splines))
    _tell(progress, 1)
    scene = _with_noise(scene, device, progress)
    rest = range(1 + len(scene.lead), len(images[0]))
    length = BLOCK_FRAMES if device == "cpu" else GPU_BLOCK_FRAMES
    blocks = tuple(rest[start : start + length] for start in range(0, len(rest), length))
    sought = every if settings.frames is None else _sought(rest, settings.frames)
    return replace(scene, near=thinned(scene.views), blocks=blocks, sought=sought)


def _sought(rest: range, wanted: int) -> BoolArray:
    """In which frames subsets are looked for, about `wanted` of them, `rest` being the later ones; in all if few more.

    In the first ones, in those that foretell the others of a block, whoever follows how many at once, and in a part of
    the others that has no period, so that no two lines that all frames tell apart fold onto each other.
    """
    numbers = np.arange(rest.stop)
    sought = (numbers < rest.start) | ((numbers - rest.start) % BLOCK_FRAMES < FORETELLING)
    others = int(np.count_nonzero(~sought))
    if len(sought) < FEW_MORE * wanted or others == 0:
        return np.ones(len(sought), dtype=np.bool_)
    return np.asarray(sought | spread_choice(numbers, max(0.0, (wanted - len(sought) + others) / others)))


def follow_block(
    scene: BodyScene, frames: range, device: str = "cpu", progress: Progress | None = None
) -> FollowedBlock:
    """Follow the body through a block of later frames; the first of them is found from the reference alone."""
    alone = device == "cpu" or scene.body.rolls
    fitted = _fitted_in_turn(scene, frames) if alone else _fitted_together(scene, frames, device)
    followed = []
    for number, one in zip(frames, fitted, strict=True):
        followed.append(one)
        _tell(progress, number + 1)
    return tuple(followed)


def in_turn(scene: BodyScene, blocks: Iterable[FollowedBlock]) -> Iterator[FollowedBlock]:
    """The scene's frames from the reference on, no more than `BLOCK_FRAMES` at a time."""
    own = identity(scene.references[0]), identity(scene.references[1])
    for block in chain([((own, None), *scene.lead)], blocks):
        for start in range(0, len(block), BLOCK_FRAMES):
            yield block[start : start + BLOCK_FRAMES]


def _fitted_in_turn(scene: BodyScene, frames: range) -> Iterator[FollowedFrame]:
    """Some frames one by one: the body from where the last frames foretell it, and its subsets from there.

    Where nothing is foretold, or the subsets are elsewhere, the body is fitted from its subsets, which are looked for.
    """
    sides = _followers(scene)
    fits, history, last = list[DirectFit](), list[Found](), list[Found]()
    read = zip(*(images.read_ahead(frames) for images in scene.images), strict=True)
    for number, images in zip(frames, read, strict=True):
        left, right = (spline_of_image(image, scene.settings.degree) for image in images)
        fit = _foretold_fit(scene, fits, (left, right))
        here: Found | None = None
        if fit is None or scene.sought[number]:
            starts = _starts(scene, fit, history, last)
            here = sides[0].find((images[0], left), starts[0]), sides[1].find((images[1], right), starts[1])
            if fit is None or any(_elsewhere(one, start) for one, start in zip(here, starts, strict=True)):
                fit = _fit(scene, here, (left, right))
            last, history = [here], [*history[1 - HISTORY :], here]
        else:
            history = []
        fits = [] if fit is None else [*fits[1 - HISTORY :], fit]
        yield here, fit


def _starts(
    scene: BodyScene, fit: DirectFit | None, history: Sequence[Found], last: Sequence[Found]
) -> list[FloatArray | None]:
    """Where both cameras' subsets are to be looked for: where a fit takes those that were found `last`, else where the
    frames before, `history`, foretell them; None where nothing does."""
    starts: list[FloatArray | None] = []
    for side, seen in enumerate(scene.seen):
        start = None
        if fit is not None:
            start = last[0][side].warp.copy()
            start[:, [0, 3]] = carried_px(seen, fit.moved)
        elif history:
            start = predict_warp([both[side].warp for both in history])
        starts.append(start)
    return starts


def carried_px(seen: SeenPoints, moved: RigidTransform) -> FloatArray:
    """By how much a body's motion moves its points (N, 2) in a camera."""
    return seen.camera.project(moved.apply(seen.points_m)) - seen.camera.project(seen.points_m)


def _foretold_fit(scene: BodyScene, fits: Sequence[DirectFit], splines: Splines) -> DirectFit | None:
    """The direct fit of a frame from where those before it foretell the body; None where it has none like theirs."""
    if len(fits) < FORETELLING:
        return None
    pose = foretold([fit.moved.pose for fit in fits], 1.0 / np.sqrt(np.diagonal(fits[-1].covariance)))
    start = RigidTransform.from_pose(pose)
    near = approach(scene.near, splines, start) if scene.near else start
    fit = None if near is None else fit_direct(scene.views, splines, near)
    return None if fit is None or fit.noise > LOUDER * np.median([before.noise for before in fits]) else fit


def _elsewhere(found: Registration, start: FloatArray | None) -> bool:
    """Whether most of the subsets are not where they were looked for."""
    if start is None:
        return True
    looked_for = np.isfinite(start).all(axis=1)
    away = np.hypot(*(found.warp - start)[looked_for][:, [0, 3]].T)
    return not (len(away) and np.median(np.where(np.isnan(away), np.inf, away)) < ELSEWHERE_PX)


def _followers(scene: BodyScene) -> tuple[Follower, Follower]:
    """What finds the subsets of the left and of the right camera."""
    left, right = (
        Follower(reference, first, images.full_scale, scene.settings)
        for reference, first, images in zip(scene.references, scene.first, scene.images, strict=True)
    )
    return left, right


def _fitted_together(scene: BodyScene, frames: range, device: str) -> Iterator[FollowedFrame]:
    """Some frames in turn, fitted together as far as their splines lie together on the device.

    Subsets, which are looked for in all of them, count where `_fitted_in_turn` would have looked for them.
    """
    from photogram.direct.fit_torch import fit_frames, torch_view
    from photogram.subsets.icgn_stream import PRECISION, OnDevice

    views = [torch_view(view, device, PRECISION) for view in scene.views]

    def together(pair: tuple[FollowedImage, FollowedImage]) -> tuple[int, ...]:
        return tuple(id(side.spline.frames) for side in pair if isinstance(side.spline, OnDevice))

    sought = iter(scene.sought[frames.start : frames.stop].tolist())
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
            wanted = next(sought)
            yield found if wanted or fit is None else None, fit


def _with_noise(scene: BodyScene, device: str, progress: Progress | None) -> BodyScene:
    """The scene with the noise models of the first frame that can be fitted, and what was found up to it."""
    for number in range(1, 1 if scene.body.rolls else len(scene.images[0])):
        (pair,) = _sides(scene, range(number, number + 1), device)
        found, splines = (pair[0].found, pair[1].found), _splines(scene, pair)
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


def _sides(scene: BodyScene, frames: range, device: str) -> Iterator[tuple[FollowedImage, FollowedImage]]:
    """Some frames of both cameras in turn."""
    left, right = (
        follow_sequence(images, reference, scene.settings, device, frames)
        for images, reference in zip(scene.images, scene.references, strict=True)
    )
    return zip(left, right, strict=True)


def _splines(scene: BodyScene, pair: tuple[FollowedImage, FollowedImage]) -> Splines:
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


def cameras_about(scene: BodyScene, rest_m: FloatArray) -> tuple[PlacedCamera, PlacedCamera]:
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


def body_views(scene: BodyScene, splines: Splines) -> tuple[BodyView, ...]:
    """The body at rest in both cameras, all pixels equally trusted."""
    side_px, shapes = 2 * scene.settings.radius_px + 1, scene.shapes
    return tuple(
        view_body(one.camera, (spline, area, float(images.full_scale)), one.points_m, side_px, UNIFORM, shapes)
        for one, spline, area, images in zip(scene.seen, splines, scene.grid.areas, scene.images, strict=True)
    )


def _fit(scene: BodyScene, found: Found, splines: Splines) -> DirectFit | None:
    """The direct fit of one frame, begun where its subsets are; None where it has none."""
    if scene.body.rolls:
        return None
    start = motion_of_places(scene.seen, _places(scene, found))
    fit = None if start is None else fit_direct(scene.views, splines, start)
    if fit is None:  # from all that the points tell, whatever it costs
        pose = fit_motion(_place(scene, found), scene.rest_m, np.zeros(3)).pose[0]
        fit = fit_direct(scene.views, splines, RigidTransform.from_pose(pose)) if np.isfinite(pose).all() else None
    return fit
