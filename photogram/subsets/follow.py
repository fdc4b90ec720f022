"""Subsets followed through a series, frame after frame, from a predicted start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import BoolArray, FloatArray, check_shape
from photogram.bspline import Spline
from photogram.images import GreyImage
from photogram.subsets.grid import saturated
from photogram.subsets.icgn import Registration, noise_of_residual, position_covariance, register
from photogram.subsets.reference import PARAMETERS, Reference, TrackStatus
from photogram.subsets.search import affine_field, affine_starts, match_features, neighbour_starts, template_shifts

# Where subsets will be in the next frame, from where they were in the last ones.


LARGEST_COEFFICIENT = 3.0


def predict_warp(history: Sequence[FloatArray]) -> FloatArray:
    """The next warps (N,6) after those in `history` (oldest first): by the rule that would have foretold the last best.

    Rules: stay; go on evenly, 2x₋₁ − x₋₂; one sine about any mean, x₋₃ + c(x₋₁ − x₋₂) with c = 1 + 2cos(ωΔt) fitted
    over all subsets, which holds for a vibration sampled below its frequency as well.
    """
    rules = (_stay, _go_on, _swing)
    errors = [_error(rule(history[:-1]), history[-1]) if len(history) > 1 else np.inf for rule in rules]
    best = rules[int(np.argmin(errors))]
    guess = best(history)
    return np.where(np.isfinite(guess), guess, history[-1])


def _stay(history: Sequence[FloatArray]) -> FloatArray:
    """The last warp."""
    return history[-1]


def _go_on(history: Sequence[FloatArray]) -> FloatArray:
    """The last step once more; NaN when there is none."""
    if len(history) < 2:
        return np.full_like(history[-1], np.nan)
    return 2.0 * history[-1] - history[-2]


def _swing(history: Sequence[FloatArray]) -> FloatArray:
    """The next value of one sine with offset; NaN with fewer than four frames."""
    if len(history) < 4:
        return np.full_like(history[-1], np.nan)
    before, third, second, last = (warp[:, [0, 3]] for warp in history[-4:])
    slope, change = (second - third).ravel(), (last - before).ravel()
    known = np.isfinite(slope) & np.isfinite(change)
    power = float(np.sum(slope[known] ** 2))
    coefficient = float(np.sum(slope[known] * change[known])) / power if power > 0.0 else 0.0
    coefficient = min(max(coefficient, -LARGEST_COEFFICIENT), LARGEST_COEFFICIENT)
    return history[-3] + coefficient * (history[-1] - history[-2])


def _error(guess: FloatArray, truth: FloatArray) -> float:
    """Median distance of the predicted from the found positions; infinite when nothing can be compared."""
    distance = np.hypot(guess[:, 0] - truth[:, 0], guess[:, 3] - truth[:, 3])
    finite = distance[np.isfinite(distance)]
    return float(np.median(finite)) if len(finite) else np.inf


# Subsets of one image found in another: by prediction, by search, from their neighbours; and the tracks they leave.


Image = NDArray[Any]
NEIGHBOUR_ROUNDS = 8
SEEDS = 12


@dataclass(frozen=True)
class TrackSettings:
    """How subsets are compared.

    radius_px: subsets have (2·radius+1)² pixels; step_px: distance in the grid, by default just without overlap, so
    that their noise is independent; degree: of the spline, 3 or 5; convergence_px: movement below which a subset stands
    still; min_zncc: correlation below which it is lost; reach_px: how far it is looked for when prediction fails,
    before it is looked for in the whole image; shape_order: of the shape function, 0 (translation), 1 (affine) or 2.
    """

    radius_px: int = 10
    step_px: int | None = None
    degree: int = 5
    max_iterations: int = 30
    convergence_px: float = 1e-4
    min_zncc: float = 0.75
    reach_px: int = 32
    shape_order: int = 1

    def __post_init__(self) -> None:
        if self.shape_order not in PARAMETERS:
            raise ValueError(f"shape_order: expected 0, 1 or 2, found {self.shape_order}")
        if self.radius_px < 3:
            raise ValueError(f"radius_px: expected at least 3, found {self.radius_px}")
        if self.step_px is not None and self.step_px < 1:
            raise ValueError(f"step_px: expected at least 1, found {self.step_px}")

    @property
    def grid_step_px(self) -> int:
        """Distance of neighbouring subsets."""
        return 2 * self.radius_px + 1 if self.step_px is None else self.step_px


@dataclass(frozen=True)
class Tracks:
    """Subset centres through time: position_px (F,N,2), covariance_px2 (F,N,2,2), zncc (F,N), status (F,N).

    The covariance is that of the frame's own image noise; the reference frame's noise is one constant offset of the
    whole series. Frame 0, whose positions are exact by definition, is given the covariance that it would have as any
    other frame. noise_grey (N,): image noise at each subset. Where status is not `TrackStatus.OK`, numbers are NaN.
    """

    position_px: FloatArray
    covariance_px2: FloatArray
    zncc: FloatArray
    status: NDArray[np.int8]
    noise_grey: FloatArray

    def __post_init__(self) -> None:
        check_shape("position_px", self.position_px, (None, None, 2))
        frames, points, _ = self.position_px.shape
        check_shape("covariance_px2", self.covariance_px2, (frames, points, 2, 2))
        check_shape("zncc", self.zncc, (frames, points))
        check_shape("status", self.status, (frames, points))
        check_shape("noise_grey", self.noise_grey, (points,))


def find_from(reference: Reference, target: Spline, start: FloatArray, settings: TrackSettings) -> Registration:
    """Registration with the settings' limits."""
    limits = (settings.max_iterations, settings.convergence_px, settings.min_zncc)
    return register(reference, target, start, *limits)


def find_anew(reference: Reference, first: Image, frame: tuple[Image, Spline], settings: TrackSettings) -> Registration:
    """Subsets of the first image in a frame of which nothing is foretold.

    From rest, and from one affine motion through searched seeds, each where it correlates better: a start at rest finds
    some subsets of a body that has moved by a speckle in a wrong place, and a search slides along edges.
    """
    rest = identity(reference).warp
    found = follow(reference, first, frame, rest, settings)
    searched = find_by_search(reference, first, frame, rest, settings)
    return find_from_neighbours(reference, frame[1], merged(found, searched), settings)


def follow(
    reference: Reference, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """Subsets of the first image in a later one: from the prediction; where that loses most, by search.

    Searched seeds within `reach_px` of the prediction, then in the whole image, then matched features, which stand
    rotation as well; at last the lost ones from their neighbours.
    """
    found = find_from(reference, frame[1], start, settings)
    for attempt in range(3):
        if np.sum(found.status == TrackStatus.OK) >= 0.5 * np.sum(reference.status == TrackStatus.OK):
            break
        if attempt < 2:
            reach = settings.reach_px if attempt == 0 else max(frame[0].shape)
            more = find_by_search(reference, first, frame, start, replace(settings, reach_px=reach))
        else:
            more = find_from_features(reference, first, frame, settings)
        found = merged(found, more)
    return find_from_neighbours(reference, frame[1], found, settings)


def find_from_features(
    reference: Reference, first: Image, frame: tuple[Image, Spline], settings: TrackSettings
) -> Registration:
    """All subsets from the affine maps of matched features around them."""
    source, moved = match_features(first, frame[0])
    starts = np.full((len(reference.centre_px), 6), np.nan)
    usable = reference.status == TrackStatus.OK
    starts[usable] = affine_starts(reference.centre_px[usable], source, moved)
    return find_from(reference, frame[1], starts, settings)


def find_by_search(
    reference: Reference, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """All subsets from one affine motion through a few well-textured seeds, which are searched by correlation."""
    image, target = frame
    usable = np.flatnonzero(reference.status == TrackStatus.OK)
    spread = usable[np.linspace(0, len(usable) - 1, min(len(usable), 4 * SEEDS)).astype(np.int64)]
    seeds = spread[np.argsort(-reference.energy[spread])[:SEEDS]]
    points = reference.centre_px[seeds]
    guess = np.nan_to_num(start[seeds][:, [0, 3]])
    shifts = template_shifts(first, image, points, settings.radius_px, settings.reach_px, guess)
    field = affine_field(points, shifts, reference.centre_px)
    return find_from(reference, target, field, settings)


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
        more = find_from(reference, target, start, settings)
        if not np.any(more.status[lost] == TrackStatus.OK):
            break
        found = merged(found, more)
    return found


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
        found,
        warp=np.where(which[:, None], np.nan, found.warp),
        status=np.where(which, np.int8(status), found.status),
    )


def identity(reference: Reference) -> Registration:
    """The reference found in itself; its noise is filled in from the other frames."""
    count = len(reference.centre_px)
    usable = reference.status == TrackStatus.OK
    ones = np.where(usable, 1.0, np.nan)
    return Registration(
        np.where(usable[:, None], 0.0, np.nan) * np.ones(max(6, PARAMETERS[reference.order])),
        ones,
        ones,
        np.full(count, np.nan),
        reference.status,
        np.zeros(count, np.int64),
    )


def without_saturated(reference: Reference, image: GreyImage, full_scale: int) -> Reference:
    """`reference` without NaN centres and without subsets that are saturated in it."""
    absent = ~np.isfinite(reference.centre_px).all(axis=1)
    full = saturated(image, full_scale, reference.centre_px, reference.radius_px)
    status = np.where(full, np.int8(TrackStatus.SATURATED), reference.status)
    return replace(reference, status=np.where(absent, np.int8(TrackStatus.NO_START), status))


def tracks_of(found: Sequence[Registration], reference: Reference, degree: int) -> Tracks:
    """Positions and covariances of all frames; the first of several is the reference itself."""
    status = np.stack([here.status for here in found])
    ok = status == TrackStatus.OK
    noise = np.stack([noise_of_residual(reference, here, degree) for here in found])
    noise[~ok] = np.nan
    seen = np.isfinite(noise)
    pooled = np.sqrt(np.sum(np.where(seen, noise, 0.0) ** 2, axis=0) / np.maximum(seen.sum(axis=0), 1))
    pooled = np.where(seen.any(axis=0), pooled, np.nan)
    noise[0] = np.where(np.isfinite(noise[0]) | ~ok[0], noise[0], pooled)
    position = np.stack([reference.centre_px + here.warp[:, [0, 3]] for here in found])
    covariance = np.stack(
        [position_covariance(reference, here, level) for here, level in zip(found, noise, strict=True)]
    )
    position[~ok], covariance[~ok] = np.nan, np.nan
    zncc = np.where(ok, np.stack([here.zncc for here in found]), np.nan)
    return Tracks(position, covariance, zncc, status, pooled)
