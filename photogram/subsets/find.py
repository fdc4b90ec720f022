"""Subsets of one image found in another: by prediction, by search, by features, from their neighbours."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import BoolArray, FloatArray
from photogram.bspline import Spline
from photogram.subsets.icgn import Registration, TrackSettings, register, resolved
from photogram.subsets.reference import PARAMETERS, Reference, TrackStatus
from photogram.subsets.search import (
    affine_field,
    affine_starts,
    agreeing_neighbours,
    match_features,
    neighbour_starts,
    template_shifts,
)

Image = NDArray[Any]
NEIGHBOUR_ROUNDS = 8
SEEDS = 12
LEAST_AGREEING = 0.2  # share of its neighbours that have to foretell a subset


def find_anew(reference: Reference, first: Image, frame: tuple[Image, Spline], settings: TrackSettings) -> Registration:
    """Subsets of the first image in a frame of which nothing is foretold: from rest and by search, the better one.

    A start at rest finds some subsets of a body that moved by a speckle in a wrong place; a search slides along edges.
    """
    rest = identity(reference).warp
    found = follow(reference, first, frame, rest, settings)
    searched = find_by_search(reference, first, frame, rest, settings)
    return held_together(reference, find_from_neighbours(reference, frame[1], merged(found, searched), settings))


def follow(
    reference: Reference, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """Subsets of the first image in a later one: from the prediction; where that loses most, by search.

    Searched seeds within `reach_px` of the prediction, then in the whole image, then matched features, which stand
    rotation as well; at last the lost ones from their neighbours.
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
        found = merged(found, more)
    found = find_from_neighbours(reference, frame[1], found, settings)
    return held_together(reference, found) if attempt > 0 else found


def held_together(reference: Reference, found: Registration) -> Registration:
    """`found` without the subsets that lie elsewhere than their neighbours say, as after a jump to a copy of theirs."""
    if reference.order == 0:  # without an affine map no neighbour says where another one is
        return found
    agree = agreeing_neighbours(reference.centre_px, found.warp)
    return dropped(found, agree < LEAST_AGREEING, TrackStatus.NOT_CONVERGED)


def find_from_features(
    reference: Reference, first: Image, frame: tuple[Image, Spline], settings: TrackSettings
) -> Registration:
    """All subsets from the affine maps of matched features around them."""
    source, moved = match_features(first, frame[0])
    starts = np.full((len(reference.centre_px), 6), np.nan)
    usable = reference.status == TrackStatus.OK
    starts[usable] = affine_starts(reference.centre_px[usable], source, moved)
    return register(reference, frame[1], starts, settings)


def find_by_search(
    reference: Reference, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """All subsets from one affine motion through a few well-textured seeds, which are searched by correlation."""
    usable = np.flatnonzero(reference.status == TrackStatus.OK)
    spread = usable[np.linspace(0, len(usable) - 1, min(len(usable), 4 * SEEDS)).astype(np.int64)]
    seeds = spread[np.argsort(-reference.energy[spread])[:SEEDS]]
    points = reference.centre_px[seeds]
    guess = np.nan_to_num(start[seeds][:, [0, 3]])
    shifts = template_shifts(first, frame[0], points, settings.radius_px, settings.reach_px, guess)
    field = affine_field(points, shifts, reference.centre_px)
    return register(reference, frame[1], field, settings)


def find_from_neighbours(
    reference: Reference, target: Spline, found: Registration, settings: TrackSettings
) -> Registration:
    """Lost subsets once more from the affine maps of their nearest neighbours, as long as that finds some."""
    for _ in range(NEIGHBOUR_ROUNDS):
        lost = (found.status != TrackStatus.OK) & (reference.status == TrackStatus.OK)
        if not lost.any() or lost.all():
            break
        start = neighbour_starts(reference.centre_px, found.warp)
        start[~lost] = np.nan
        more = register(reference, target, start, settings)
        if not np.any(more.status[lost] == TrackStatus.OK):
            break
        found = merged(found, more)
    return resolved(reference, found)


def merged(first: Registration, second: Registration) -> Registration:
    """`first`, with the subsets that only `second` found, or that it found where they correlate better."""
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


def dropped(found: Registration, which: BoolArray, status: TrackStatus) -> Registration:
    """`found` without the subsets `which`, which receive the status."""
    return replace(
        found, warp=np.where(which[:, None], np.nan, found.warp), status=np.where(which, np.int8(status), found.status)
    )


def identity(reference: Reference) -> Registration:
    """The reference found in itself; its noise is filled in from the other frames."""
    ones = np.where(reference.status == TrackStatus.OK, 1.0, np.nan)
    warp = np.outer(ones, np.zeros(max(6, PARAMETERS[reference.order])))
    nothing, none = np.full(len(ones), np.nan), np.zeros(len(ones), np.int64)
    return Registration(warp, ones, ones, nothing, reference.status, none)
