"""A body followed on a GPU, batch by batch: as far as the frames before foretell the next, these are fitted at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from photogram.arrays import BoolArray, FloatArray
from photogram.direct.fit_torch import fit_frames, torch_view
from photogram.geometry import RigidTransform, vector_from_rotation
from photogram.images.sequence import GreyImage
from photogram.measure.follow import FORETELLING, Course, FollowedFrame, elsewhere, foretold_motion, too_loud
from photogram.subsets.find import MORE_LOST, NEIGHBOUR_ROUNDS, merged
from photogram.subsets.icgn import Registration, resolved
from photogram.subsets.icgn_torch import PRECISION, TorchSplines, register_frames, splines_of, torch_reference, uploaded
from photogram.subsets.reference import TrackStatus
from photogram.subsets.search import neighbour_starts

if TYPE_CHECKING:
    from torch import Tensor

MOST_FRAMES, BATCH_PIXELS = 64, 2**28
"""Frames of a batch, and pixels of both cameras' pictures in it, of which it holds some 20 bytes each."""
Pair = tuple[GreyImage, GreyImage]


@dataclass(frozen=True)
class _Batch:
    """Successive frames, in memory and on the device; full (n, 2): which pictures have pixels at full scale."""

    numbers: range
    images: Sequence[Pair]
    raw: tuple[Tensor, Tensor]
    full: BoolArray

    def part(self, first: int, count: int) -> _Batch:
        """Some of the frames."""
        own = slice(first, first + count)
        return _Batch(self.numbers[own], self.images[own], (self.raw[0][own], self.raw[1][own]), self.full[own])


def found_together(course: Course, frames: range, device: str) -> Iterator[FollowedFrame]:
    """Find the body and its subsets in some frames in turn.

    What is not foretold, not found where it is foretold, or has lost subsets there, is found as on a CPU.
    """
    engine, done = _Engine(course, device), 0
    for batch in _read_ahead(course, frames, device):
        done = 0
        while done < len(batch.numbers):
            starts = foretold_motions(course, len(batch.numbers) - done)
            here = batch.part(done, max(1, len(starts)))
            done += len(here.numbers)
            found = engine.find(here, starts) if starts else [None]
            for number, images, one in zip(here.numbers, here.images, found, strict=True):
                yield course.find(number, images) if one is None else course.took(*one)


def _read_ahead(course: Course, frames: range, device: str) -> Iterator[_Batch]:
    """Frames in batches; a thread reads and uploads the next one in advance."""
    width, height = course.scene.images[0].size_px
    scales = [images.full_scale for images in course.scene.images]
    length = max(1, min(MOST_FRAMES, BATCH_PIXELS // (2 * width * height)))
    source = zip(*(images.read_ahead(frames) for images in course.scene.images), strict=True)

    def read(numbers: range) -> _Batch:
        images = [(left, right) for left, right in islice(source, len(numbers))]
        left, right = (uploaded(side, device) for side in zip(*images, strict=True))
        full = np.array([[one.max() >= most for one, most in zip(pair, scales, strict=True)] for pair in images])
        return _Batch(numbers, images, (left, right), full)

    with ThreadPoolExecutor(max_workers=1) as reader:
        parts = [frames[first : first + length] for first in range(0, len(frames), length)]
        coming = reader.submit(read, parts[0])
        for following in (*parts[1:], None):
            batch = coming.result()
            if following is not None:
                coming = reader.submit(read, following)
            yield batch


class _Engine:
    """What stays on the device while a body is followed."""

    def __init__(self, course: Course, device: str) -> None:
        self._course, scene = course, course.scene
        self._views = [torch_view(view, device, PRECISION) for view in scene.views]
        self._references = [torch_reference(reference, device, PRECISION) for reference in scene.references]

    def find(self, batch: _Batch, starts: Sequence[RigidTransform]) -> list[FollowedFrame | None]:
        """The body in frames from the motions foretold of them, its subsets where they are sought; None where lost."""
        scene, before = self._course.scene, self._course.fits
        splines = [splines_of(raw, scene.settings.degree, PRECISION) for raw in batch.raw]
        everywhere = range(len(starts))
        fits = fit_frames(self._views, [(one, everywhere) for one in splines], starts)
        kept = [None if fit is None or too_loud(fit, before) else fit for fit in fits]
        sought = [k for k, fit in enumerate(kept) if fit is not None and scene.sought[batch.numbers[k]]]
        begun = {k: self._course.starts(kept[k]) for k in sought}
        left, right = (self._subsets(side, splines[side], batch, begun) for side in (0, 1))
        found: list[FollowedFrame | None] = []
        for k, fit in enumerate(kept):
            one, other = left.get(k), right.get(k)
            if fit is None or (k in begun and (one is None or other is None)):
                found.append(None)
            else:
                found.append((None if one is None or other is None else (one, other), fit))
        return found

    def _subsets(
        self, side: int, splines: TorchSplines, batch: _Batch, begun: dict[int, list[FloatArray | None]]
    ) -> dict[int, Registration]:
        """A camera's subsets in the frames that have starts; without those frames in which they have to be searched."""
        if not begun:
            return {}
        scene, reference, prepared = self._course.scene, self._course.scene.references[side], self._references[side]
        starts = {k: start for k, both in begun.items() if (start := both[side]) is not None}
        usable = reference.status == TrackStatus.OK

        def registered(starts: dict[int, FloatArray]) -> dict[int, Registration]:
            whole = np.full((len(batch.numbers), *next(iter(starts.values())).shape), np.nan)
            whole[list(starts)] = list(starts.values())
            found = register_frames(prepared, splines, whole, scene.settings)
            return {k: found[k] for k in starts}

        found = registered(starts)
        going_on = list(found)
        for _ in range(NEIGHBOUR_ROUNDS):  # as `find_from_neighbours` does frame by frame
            again = dict[int, FloatArray]()
            for k in going_on:
                lost = usable & (found[k].status != TrackStatus.OK)
                if lost.any():
                    again[k] = np.where(lost[:, None], neighbour_starts(reference.centre_px, found[k].warp), np.nan)
            if not again:
                break
            better = {k: merged(found[k], more) for k, more in registered(again).items()}
            going_on = [k for k, one in better.items() if not np.array_equal(one.status, found[k].status)]
            found |= better
        follower = self._course.sides[side]
        for k, here in found.items():
            whole = resolved(reference, here)
            found[k] = follower.unsaturated(batch.images[k][side], whole) if batch.full[k, side] else whole
        warps, begun_at = (
            np.stack(arrays) for arrays in zip(*((found[k].warp, starts[k]) for k in found), strict=True)
        )
        lost = np.array([np.count_nonzero(usable & (here.status != TrackStatus.OK)) for here in found.values()])
        there = ~elsewhere(warps, begun_at) & (lost <= MORE_LOST * len(usable))
        return {k: here for (k, here), kept in zip(found.items(), there, strict=True) if kept}


# What the frames before foretell of many.

FEWEST = 8  # frames to which sines are fitted
LINES = 4
TRUSTED_PX, CLOSE_PX = 0.5, 0.05
POINTS = 16
FINER, REFINEMENTS = 33, 4


def foretold_motions(course: Course, most: int) -> list[RigidTransform]:
    """Return the motions that the fits so far foretell of the next frames, at most so many; none where they do not.

    The body stays where it was, or moves by up to `LINES` sines about a drifting mean, taken from the strongest on:
    whatever would have foretold the last quarter of the frames best. No more frames are foretold than there were, and
    only the next one, by `foretold_motion`, where that last quarter would have been missed by half a pixel.
    """
    fits = course.fits
    if len(fits) < FORETELLING:
        return []
    tested = len(fits) // 4
    count, known = min(most, len(fits)), len(fits) - tested
    if count == 1 or known < FEWEST:
        return [foretold_motion(fits)]
    turned = vector_from_rotation(np.array([fit.moved.rotation for fit in fits]))
    poses = np.hstack([np.array([fit.moved.translation_m for fit in fits]), turned])
    moved_px = poses @ _some_rates(course).T
    lines, miss = _lines_of(moved_px[:known], moved_px[known:])
    if miss > TRUSTED_PX:
        return [foretold_motion(fits)]
    if lines == 0:
        return [fits[-1].moved] * count
    frequencies = np.zeros(0)
    for _ in range(lines):
        frequencies = _next_line(moved_px, frequencies)
    return [RigidTransform.from_pose(pose) for pose in _continued(poses, frequencies, count)]


def _some_rates(course: Course) -> FloatArray:
    """How the pixels of some points answer to the six components, (K, 6)."""
    rates = np.concatenate([seen.rates[np.isfinite(seen.rates).all(axis=(1, 2))] for seen in course.scene.seen])
    return rates[:: max(1, len(rates) // POINTS)].reshape(-1, 6)


def _lines_of(known: FloatArray, truth: FloatArray) -> tuple[int, float]:
    """How many sines foretell best the places that follow those known, and how far off they are; 0: the last place."""
    best, frequencies = (0, float(np.median(np.abs(known[-1] - truth)))), np.zeros(0)
    for number in range(1, LINES + 1):
        if best[1] < CLOSE_PX or len(known) < 2 * (number + 1) + FORETELLING:
            break
        frequencies = _next_line(known, frequencies)
        miss = float(np.median(np.abs(_continued(known, frequencies, len(truth)) - truth)))
        best = min(best, (number, miss), key=lambda each: each[1])
    return best


def _continued(series: FloatArray, frequencies: FloatArray, count: int) -> FloatArray:
    """The next values (count, K) of a series (M, K) by least squares."""
    past, coming = np.split(np.arange(len(series) + count, dtype=np.float64), [len(series)])
    return np.asarray(_design(frequencies, coming) @ (np.linalg.pinv(_design(frequencies, past)) @ series))


def _design(frequencies: FloatArray, frames: FloatArray) -> FloatArray:
    """Columns (M, 2 + 2L) of a mean, a drift, cosines and sines of frequencies (L,) in radians per frame."""
    phase = np.outer(frames, frequencies)
    return np.concatenate([np.ones((len(frames), 1)), frames[:, None], np.cos(phase), np.sin(phase)], axis=1)


def _next_line(series: FloatArray, frequencies: FloatArray) -> FloatArray:
    """The frequencies (L,) of a series (M, K), and that of the sine that fits the leading component of the rest best.

    At least half a period lies within the M frames. A grid of a quarter of the resolution is made finer four times.
    """
    frames = np.arange(len(series), dtype=np.float64)
    known = _design(frequencies, frames)
    left = series - known @ (np.linalg.pinv(known) @ series)
    _, vectors = np.linalg.eigh(left @ left.T)
    course, lowest = vectors[:, -1], np.pi / len(series)
    ordered, _ = np.linalg.qr(known)
    grid = np.linspace(lowest, np.pi, 4 * len(series))
    for _ in range(REFINEMENTS):
        waves = np.exp(1j * np.outer(grid, frames))
        pairs = np.stack([waves.real, waves.imag], axis=-1)
        basis, _ = np.linalg.qr(pairs - ordered @ (ordered.T @ pairs))
        best = grid[np.argmax(np.sum((course @ basis) ** 2, axis=-1))]
        reach = grid[1] - grid[0]
        grid = np.linspace(max(best - reach, lowest), min(best + reach, np.pi), FINER)
    return np.append(frequencies, best)
