"""Search for subsets in other images: prediction, correlation, features, neighbours, epipolar lines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.bspline import Spline
from photogram.camera import StereoRig, epipolar_residual, triangulate
from photogram.subsets.icgn import LINEAR_PX, Registration, TrackSettings, drop_unresolved, register
from photogram.subsets.reference import PARAMETERS, ReferenceSubsets, TrackStatus
from photogram.subsets.search import (
    affine_field,
    affine_starts,
    agreeing_neighbours,
    match_features,
    neighbour_starts,
    template_shifts,
)
from photogram.subsets.sweep import fit_surfaces, line_starts, line_uncertainty_px
from photogram.subsets.texture import find_saturated, repeat_steps_px
from shakercal._common.arrays import BoolArray, FloatArray

Image = NDArray[Any]


class BodyNotFound(ValueError):
    """The images do not show the body: no texture, no match, or a repeating pattern."""


NEIGHBOUR_ROUNDS = 8  # of growing from found subsets, chosen
SEEDS = 12  # subsets of a search, of which four have to agree on an affine map
LEADERS, MIN_LED = 24, 200  # subsets that show the common motion, in grids of at least so many
MORE_LOST = 0.05  # share of missing subsets that indicates a body displaced to a copy of its pattern
MAX_COPIES = 3  # periods by which a displaced body is searched
EDGE = 1.5  # subset radii from the edge of an image within which a subset may be missing
MIN_AGREEING = 0.2  # share of its neighbours that have to predict a subset


class Follower:
    """Finder of the subsets of a reference in the later images of its series.

    `first`: the image of the reference. Subsets with pixels at `full_scale` are lost.
    """

    def __init__(self, reference: ReferenceSubsets, first: Image, full_scale: int, settings: TrackSettings) -> None:
        self._reference, self._first = reference, first
        self._full_scale, self._settings = full_scale, settings
        self._steps: FloatArray | None = None  # periods of the pattern, once they are needed

    def find(
        self, frame: tuple[Image, Spline], start: FloatArray | None, last: FloatArray | None = None
    ) -> Registration:
        """Return the subsets in an image and its spline, from warps (N,p) or from rest.

        last: warps (N, p) in the previous image, if available: a few subsets then show how far all have moved since.
        """
        reference, settings = self._reference, self._settings
        if start is None:
            found = find_without_prediction(reference, self._first, frame, settings)
        else:
            start = start if last is None else predict_common_motion(reference, frame[1], start, last, settings)
            found = follow(reference, self._first, frame, start, settings)
        usable = reference.status == TrackStatus.OK
        if np.count_nonzero(found.status != TrackStatus.OK) > MORE_LOST * len(usable) + np.count_nonzero(~usable):
            if self._steps is None:
                self._steps = repeat_steps_px(self._first, reference.centre_px[usable], settings.radius_px)
            found = find_next_to_copies(reference, self._first, frame, found, self._steps, settings)
        return self.unsaturated(frame[0], found)

    def unsaturated(self, image: Image, found: Registration) -> Registration:
        """Return the registration in an image without the subsets with pixels at full scale."""
        centres = self._reference.centre_px + found.warp[:, [0, 3]]
        full = find_saturated(image, self._full_scale, centres, self._settings.radius_px)
        return drop_subsets(found, full, TrackStatus.SATURATED)


def find_without_prediction(
    reference: ReferenceSubsets, first: Image, frame: tuple[Image, Spline], settings: TrackSettings
) -> Registration:
    """Find the subsets in a frame from rest and by search, the better one.

    A start at rest finds some subsets of a body that moved by a speckle in a wrong position; a search slides along
    edges.
    """
    rest = identity_registration(reference).warp
    found = follow(reference, first, frame, rest, settings)
    searched = find_by_search(reference, first, frame, rest, settings)
    return drop_disagreeing(
        reference, find_from_neighbours(reference, frame[1], merge_registrations(found, searched), settings)
    )


def follow(
    reference: ReferenceSubsets, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """Find the subsets in a later image: from the prediction, else by search.

    Where the prediction loses most subsets, seeds are searched within `reach_px` of it, then in the whole image.
    Matched features follow, which also allow rotation. At last the lost subsets are found from their neighbours.
    """
    found = register(reference, frame[1], start, settings)
    for attempt in range(3):
        if np.sum(found.status == TrackStatus.OK) >= 0.5 * np.sum(reference.status == TrackStatus.OK):
            break
        if attempt < 2:
            reach = settings.reach_px if attempt == 0 else max(frame[0].shape)
            more = find_by_search(reference, first, frame, start, replace(settings, reach_px=reach))
        else:
            more = find_from_features(reference, first, frame, settings)
        found = merge_registrations(found, more)
    found = find_from_neighbours(reference, frame[1], found, settings)
    return drop_disagreeing(reference, found) if attempt > 0 else found


def predict_common_motion(
    reference: ReferenceSubsets, target: Spline, start: FloatArray, last: FloatArray, settings: TrackSettings
) -> FloatArray:
    """Return warps (N,p) from the last ones and one affine motion, or `start`.

    The motion is that of a few subsets, which are registered from their start. It counts if it leads next to all of
    them. The prediction of each individual subset has several times the noise of its last position. From that position
    one step is usually enough.
    """
    ready = np.flatnonzero(
        np.isfinite(start).all(axis=1) & np.isfinite(last).all(axis=1) & (reference.status == TrackStatus.OK)
    )
    if len(ready) < MIN_LED:
        return start
    few = np.random.default_rng(0).choice(ready, LEADERS, replace=False)  # every n-th of a grid may lie on a line
    starts = np.full_like(start, np.nan)
    starts[few] = start[few]
    found = register(reference, target, starts, settings)
    seen = few[found.status[few] == TrackStatus.OK]
    if 2 * len(seen) < LEADERS:
        return start
    position = found.warp[seen][:, [0, 3]]
    common = last.copy()
    common[:, :6] += affine_field(reference.centre_px[seen], position - last[seen][:, [0, 3]], reference.centre_px)
    off = [np.hypot(*(each[seen][:, [0, 3]] - position).T) for each in (common, start)]
    if off[0].max() > LINEAR_PX or np.median(off[0]) > np.median(off[1]):
        return start
    return np.where(np.isfinite(common), common, start)


def find_next_to_copies(
    reference: ReferenceSubsets,
    first: Image,
    frame: tuple[Image, Spline],
    found: Registration,
    steps_px: FloatArray,
    settings: TrackSettings,
) -> Registration:
    """Return `found`, or the body displaced by a period if that leaves fewer subsets missing.

    The pattern repeats by steps_px (K, 2). A body that is confused with a copy of itself lacks the subsets at one of
    its ends. Where no end is visible, the images cannot show it.
    """
    size = np.array(frame[0].shape[::-1])
    best, missing = found, _missing_share(reference, found, settings.radius_px, size)
    for _ in range(MAX_COPIES):
        tried = []
        for step in steps_px if missing > MORE_LOST else ():
            start = neighbour_starts(reference.centre_px, best.warp)
            start[:, [0, 3]] += step
            near = replace(settings, reach_px=max(3, int(np.hypot(*step) / 4.0)))
            shifted = find_by_search(reference, first, frame, start, near)
            shifted = drop_disagreeing(reference, find_from_neighbours(reference, frame[1], shifted, settings))
            tried.append((_missing_share(reference, shifted, settings.radius_px, size), shifted))
        least, shifted = min(tried, key=lambda each: each[0], default=(missing, best))
        if least > missing - MORE_LOST:
            break
        best, missing = shifted, least
    return best


def _missing_share(
    reference: ReferenceSubsets, found: Registration, radius_px: int, size_px: NDArray[np.int64]
) -> float:
    """Return the share of expected subsets that are not found in an image."""
    ok, expected = found.status == TrackStatus.OK, _expected(reference, found, radius_px, size_px)
    return float(np.mean(~ok[expected])) if ok.any() else 1.0


def _expected(
    reference: ReferenceSubsets, found: Registration, radius_px: int, size_px: NDArray[np.int64]
) -> BoolArray:
    """Return subsets (N,) that are found, or whose neighbours predict them well inside the image."""
    position = reference.centre_px + neighbour_starts(reference.centre_px, found.warp)[:, [0, 3]]
    inside = ((position >= EDGE * radius_px) & (position <= size_px - 1.0 - EDGE * radius_px)).all(axis=1)
    return np.asarray((inside & (reference.status == TrackStatus.OK)) | (found.status == TrackStatus.OK))


def drop_disagreeing(reference: ReferenceSubsets, found: Registration) -> Registration:
    """Return `found` without subsets whose position disagrees with their neighbours.

    Such a position arises after a jump to a copy.
    """
    if reference.order == 0:  # without an affine map neighbours predict no position
        return found
    agree = agreeing_neighbours(reference.centre_px, found.warp)
    return drop_subsets(found, agree < MIN_AGREEING, TrackStatus.NOT_CONVERGED)


def find_from_features(
    reference: ReferenceSubsets, first: Image, frame: tuple[Image, Spline], settings: TrackSettings
) -> Registration:
    """Find all subsets from the affine maps of matched features around them."""
    source, moved = match_features(first, frame[0])
    starts = np.full((len(reference.centre_px), 6), np.nan)
    usable = reference.status == TrackStatus.OK
    starts[usable] = affine_starts(reference.centre_px[usable], source, moved)
    return register(reference, frame[1], starts, settings)


def find_by_search(
    reference: ReferenceSubsets, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """Find all subsets from one affine motion of a few seeds, searched by correlation."""
    usable = np.flatnonzero(reference.status == TrackStatus.OK)
    spread = usable[np.linspace(0, len(usable) - 1, min(len(usable), 4 * SEEDS)).astype(np.int64)]
    seeds = spread[np.argsort(-reference.energy[spread])[:SEEDS]]
    points = reference.centre_px[seeds]
    guess = np.nan_to_num(start[seeds][:, [0, 3]])
    shifts = template_shifts(first, frame[0], points, settings.radius_px, settings.reach_px, guess)
    field = affine_field(points, shifts, reference.centre_px)
    return register(reference, frame[1], field, settings)


def find_from_neighbours(
    reference: ReferenceSubsets, target: Spline, found: Registration, settings: TrackSettings
) -> Registration:
    """Find lost subsets from the affine maps of their nearest neighbours, repeatedly."""
    return grow_from_neighbours(
        reference, {0: found}, lambda starts: {0: register(reference, target, starts[0], settings)}
    )[0]


def grow_from_neighbours(
    reference: ReferenceSubsets,
    found: Mapping[int, Registration],
    register_starts: Callable[[dict[int, FloatArray]], dict[int, Registration]],
) -> dict[int, Registration]:
    """Return what was found in frames, with the lost subsets that their neighbours lead to.

    It is repeated as long as that finds some. register_starts: registers the frames with these starts (N, 6), NaN for
    none.
    """
    whole, going_on = dict(found), list(found)
    for _ in range(NEIGHBOUR_ROUNDS):
        starts = dict[int, FloatArray]()
        for k in going_on:
            lost = (whole[k].status != TrackStatus.OK) & (reference.status == TrackStatus.OK)
            if lost.any() and not lost.all():
                starts[k] = np.where(lost[:, None], neighbour_starts(reference.centre_px, whole[k].warp), np.nan)
        if not starts:
            break
        more = register_starts(starts)
        going_on = [k for k in starts if np.any(more[k].status == TrackStatus.OK)]
        whole |= {k: merge_registrations(whole[k], more[k]) for k in going_on}
    return {k: drop_unresolved(reference, found_in_frame) for k, found_in_frame in whole.items()}


def merge_registrations(first: Registration, second: Registration) -> Registration:
    """Return `first`, with the subsets of `second` where they correlate better or alone are found."""
    worse = (first.status != TrackStatus.OK) | (first.zncc < second.zncc)
    better = worse & (second.status == TrackStatus.OK)
    return Registration(
        warp=np.where(better[:, None], second.warp, first.warp),
        zncc=np.where(better, second.zncc, first.zncc),
        gain=np.where(better, second.gain, first.gain),
        residual_grey2=np.where(better, second.residual_grey2, first.residual_grey2),
        status=np.where(better, second.status, first.status),
        iterations=first.iterations + second.iterations,
    )


def drop_subsets(found: Registration, which: BoolArray, status: TrackStatus) -> Registration:
    """Return `found` without the subsets `which`, which receive the status."""
    return replace(
        found, warp=np.where(which[:, None], np.nan, found.warp), status=np.where(which, np.int8(status), found.status)
    )


def identity_registration(reference: ReferenceSubsets) -> Registration:
    """Return the registration of the reference in itself, its noise NaN."""
    ones = np.where(reference.status == TrackStatus.OK, 1.0, np.nan)
    warp = np.outer(ones, np.zeros(max(6, PARAMETERS[reference.order])))
    missing, zero = np.full(len(ones), np.nan), np.zeros(len(ones), np.int64)
    return Registration(warp, ones, ones, missing, reference.status, zero)


# Subsets of a calibrated pair's left image found in the right one: on a surface along the epipolar lines.

DepthRange = tuple[float, float]
LINE_SEEDS = 24  # subsets that are searched along their lines, enough for several parts of a surface
PART_SHARE = 0.3  # of a surface's seeds that may also lie on another one if both are parts of one body
RIVAL_SHARE = 0.25  # of the subsets that have to fit another surface for a solution to be in doubt
MIN_SHARE = 0.1  # of the subsets, on a surface
LESS_ZNCC = 0.01  # of an equal correlation
MORE_MISSED = 0.1  # share of missing subsets by which a surface is worse than another
LINE_PX = (
    0.5  # permitted rms distance of a surface from the epipolar lines, in addition to the calibration's uncertainty
)


@dataclass(frozen=True)
class _Surface:
    """Subsets found on one surface.

    Attributes
    ----------
    found : their registration.
    expected : (N,) whether a subset should be in the right image.
    smooth : share of neighbours that predict each other; patches of several copies of a pattern have a smaller one.
    """

    found: Registration
    expected: BoolArray
    smooth: float

    @property
    def ok(self) -> BoolArray:
        return np.asarray(self.found.status == TrackStatus.OK)

    @property
    def missed(self) -> float:
        """Share of the expected subsets that are not found, plus that of disagreeing neighbours."""
        return float(np.mean(~self.ok[self.expected])) + 1.0 - self.smooth if self.expected.any() else 1.0


def find_on_lines(
    reference: ReferenceSubsets,
    first: Image,
    frame: tuple[Image, Spline],
    settings: TrackSettings,
    rig: StereoRig,
    depth_m: DepthRange | None = None,
) -> Registration | None:
    """Find all subsets on the surface that correlates along the epipolar lines, None for none.

    Some subsets are searched along their lines (`sweep.line_starts`), each with all its likely positions. Smooth
    surfaces through these (`sweep.fit_surfaces`) are followed from neighbour to neighbour. The surface with most
    subsets counts, unless another one fits equally. That one has at least a quarter of the same subsets, which
    correlate hardly less, are no further from the epipolar lines, and lack no more expected subsets in the right image.
    It is also within the stated depths `depth_m` (nearest, farthest, in the left camera). In that case `BodyNotFound`
    is raised.
    """
    usable = reference.status == TrackStatus.OK
    if usable.sum() < 3:
        return None
    clear = np.flatnonzero(usable & (reference.energy >= 0.25 * np.median(reference.energy[usable])))
    seeds = clear[np.linspace(0, len(clear) - 1, min(len(clear), LINE_SEEDS)).astype(np.int64)]
    starts, band = line_starts((first, frame[0]), rig, reference.centre_px[seeds], settings.radius_px)
    tried = []
    for start in starts[np.isfinite(starts).any(axis=(1, 2))]:
        spread = np.full((len(usable), 6), np.nan)
        spread[seeds] = start
        registered = register(reference, frame[1], spread, settings)
        off, _, _ = epipolar_residual(rig, reference.centre_px, reference.centre_px + registered.warp[:, [0, 3]])
        tried.append(drop_subsets(registered, ~(np.abs(off) <= 2.0 * band), TrackStatus.NO_START).warp)
    if not tried:
        return None
    warps = np.stack(tried)[:, seeds]
    centre = reference.centre_px[seeds]
    chosen = fit_surfaces(rig, centre, _without_repetitions(centre + warps[..., [0, 3]]))
    if not chosen:
        return None
    main_warps = np.full((len(usable), warps.shape[2]), np.nan)
    main, rivals = chosen[0] >= 0, []
    main_warps[seeds[main]] = warps[chosen[0][main], main.nonzero()[0]]
    for other in chosen[1:]:
        on_surface = other >= 0
        seeded = np.full_like(main_warps, np.nan)
        seeded[seeds[on_surface]] = warps[other[on_surface], on_surface.nonzero()[0]]
        if np.mean(main[on_surface]) <= PART_SHARE:  # another part of the body, or more of a curved one
            main_warps[seeds[on_surface & ~main]] = seeded[seeds[on_surface & ~main]]
            main |= on_surface
        elif on_surface.sum() >= RIVAL_SHARE * main.sum():
            rivals.append(seeded)
    found = [_grown_surface(reference, frame, settings, each) for each in (main_warps, *rivals)]
    best, *others = sorted(found, key=lambda surface: -surface.smooth * float(np.sum(surface.ok)))
    if best.ok.sum() < max(3, MIN_SHARE * usable.sum()):
        return None
    for rival in others:
        _refuse_rival(reference, rig, best, rival, depth_m)
    return _smoothed(reference, frame, settings, best.found)


def _smoothed(
    reference: ReferenceSubsets, frame: tuple[Image, Spline], settings: TrackSettings, found: Registration
) -> Registration:
    """Register all subsets from the affine map of those around, where they correlate equally.

    A start carried over from afar may end in a false minimum. Components that the texture does not determine keep their
    start.
    """
    usable, ok = reference.status == TrackStatus.OK, found.status == TrackStatus.OK
    centre, starts = reference.centre_px, np.full((len(usable), 6), np.nan)
    starts[usable] = affine_starts(centre[usable], centre[ok], (centre + found.warp[:, [0, 3]])[ok])
    renewed = register(reference, frame[1], starts, settings)
    as_good = (renewed.status == TrackStatus.OK) & ~(renewed.zncc < found.zncc - LESS_ZNCC)
    return drop_disagreeing(reference, merge_registrations(renewed, drop_subsets(found, as_good, TrackStatus.NO_START)))


def _without_repetitions(position_px: FloatArray) -> FloatArray:
    """Return positions (C,S,2), NaN where one is within a pixel of an earlier one."""
    unique = position_px.copy()
    for c in range(1, len(position_px)):
        same = (np.abs(position_px[:c] - position_px[c]).max(axis=-1) < 1.0).any(axis=0)
        unique[c, same] = np.nan
    return unique


def _grown_surface(
    reference: ReferenceSubsets, frame: tuple[Image, Spline], settings: TrackSettings, warp: FloatArray
) -> _Surface:
    """Return the surface through subsets with warps (N, p), without those that disagree."""
    start = neighbour_starts(reference.centre_px, warp)
    found = find_from_neighbours(reference, frame[1], register(reference, frame[1], start, settings), settings)
    agree = agreeing_neighbours(reference.centre_px, found.warp)
    found = drop_disagreeing(reference, found)
    expected = _expected(reference, found, settings.radius_px, np.array(frame[0].shape[::-1]))
    agree = agree[np.isfinite(agree)]
    return _Surface(found, expected, float(np.mean(agree)) if len(agree) else 1.0)


def _refuse_rival(
    reference: ReferenceSubsets, rig: StereoRig, best: _Surface, other: _Surface, depth_m: DepthRange | None
) -> None:
    """Raise `BodyNotFound` where the second surface fits as well as the first."""
    centre = reference.centre_px
    sides = [np.where(one.ok[:, None], centre + one.found.warp[:, [0, 3]], np.nan) for one in (best, other)]
    both = best.ok & other.ok & (np.abs(sides[0] - sides[1]).max(axis=1) > 1.0)
    if both.sum() < RIVAL_SHARE * best.ok.sum() or other.missed > best.missed + MORE_MISSED:
        return
    lack, more = (float(np.median(1.0 - one.found.zncc[both])) for one in (best, other))
    if more > 2.0 * lack + 0.05:
        return
    off = [np.sqrt(np.nanmean(epipolar_residual(rig, centre, side)[0] ** 2)) for side in sides]
    limit = LINE_PX + 3.0 * line_uncertainty_px(rig, centre[both], sides[0][both])
    if off[0] <= limit < off[1]:
        return
    depth = [float(np.nanmedian(triangulate(rig, centre[None], side[None]).position_m[..., 2])) for side in sides]
    if depth_m is not None and depth_m[0] <= depth[0] <= depth_m[1] and not depth_m[0] <= depth[1] <= depth_m[1]:
        return
    raise BodyNotFound(
        f"right: expected one position of the body, found two that fit equally, {depth[0]:.3f} m and {depth[1]:.3f} m "
        f"from the left camera ({best.ok.sum()} and {other.ok.sum()} subsets). Its pattern repeats: show the ends of "
        "the pattern in both images, rotate the foil by some degrees, or use one that does not repeat"
    )
