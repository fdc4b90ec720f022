"""A body followed on a GPU, batch by batch: as far as the frames before foretell the next, these are fitted at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice, pairwise, zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import FloatArray
from photogram.direct.direct_fit import DirectFit
from photogram.direct.fit_torch import fit_frames, load_solvers, torch_view
from photogram.images.sequence import GreyImage
from photogram.measure.follow import (
    MIN_PREDICTION_FRAMES,
    BodyTracker,
    FollowedFrame,
    has_excess_noise,
    predict_motion,
    subsets_displaced,
)
from photogram.subsets.find import MORE_LOST, grow_from_neighbours
from photogram.subsets.icgn import Registration
from photogram.subsets.icgn_torch import (
    PRECISION,
    TorchSplines,
    register_frames,
    splines_of,
    torch_reference,
    upload_images,
)
from photogram.subsets.reference import TrackStatus

if TYPE_CHECKING:
    from torch import Tensor

MOST_FRAMES, FIRST_FRAMES = 128, 12
"""Frames of a batch, and of the first one, which nothing foretells."""
MOST_PIXELS, BYTES_PER_PIXEL, SHARE_OF_MEMORY = 2**29, 32, 0.2
"""Pixels of a batch, what it holds on a device for each, and how much of the device's memory it may take."""


@dataclass(frozen=True)
class _Batch:
    """Successive frames, in memory and on the device."""

    numbers: range
    images: Sequence[tuple[GreyImage, ...]]
    raw: Sequence[Tensor]

    def part(self, first: int, count: int) -> _Batch:
        """Some of the frames."""
        own = slice(first, first + count)
        return _Batch(self.numbers[own], self.images[own], [one[own] for one in self.raw])


def find_in_batches(course: BodyTracker, frames: range, device: str) -> Iterator[FollowedFrame]:
    """Find the body and its subsets in some frames in turn.

    What is not foretold, not found where it is foretold, or has lost subsets there, is found as on a CPU.
    """
    engine = _Engine(course, device)
    for batch in _read_ahead(course, frames, device):
        done = 0
        while done < len(batch.numbers):
            starts = course.extrapolate(batch.numbers[done:])
            if len(starts) == 0:
                starts = predict_poses(course, len(batch.numbers) - done)
            here, lost = batch.part(done, max(1, len(starts))), False
            found = engine.find(here, starts) if len(starts) else [None]
            for number, images, one in zip(here.numbers, here.images, found, strict=True):
                if one is None and lost:  # two in a row: what was foretold is not so
                    break
                yield course.find(number, images) if one is None else course.add_frame(*one)
                done, lost = done + 1, one is None


def _read_ahead(course: BodyTracker, frames: range, device: str) -> Iterator[_Batch]:
    """Frames in batches; a thread for each camera reads and uploads the next one in advance."""
    sources = [images.read_ahead(frames) for images in course.scene.images]
    length = _most_frames(sum(images.size_px[0] * images.size_px[1] for images in course.scene.images), device)
    ends = [0, *range(min(FIRST_FRAMES, length), len(frames), length), len(frames)]

    def read(source: Iterator[GreyImage], count: int) -> tuple[NDArray[Any], Tensor]:
        return upload_images(list(islice(source, count)), device)

    with ThreadPoolExecutor(max_workers=len(sources)) as readers:
        parts = [frames[first:end] for first, end in pairwise(ends)]
        coming = [readers.submit(read, source, len(parts[0])) for source in sources]
        for numbers, following in zip_longest(parts, parts[1:]):
            images, raw = zip(*(one.result() for one in coming), strict=True)
            coming = [readers.submit(read, source, len(following)) for source in sources if following is not None]
            yield _Batch(numbers, list(zip(*images, strict=True)), raw)


def _most_frames(pixels: int, device: str) -> int:
    """How many frames of so many pixels, of all cameras, a batch has."""
    import torch

    most = MOST_PIXELS
    if torch.device(device).type == "cuda":
        _, memory = torch.cuda.mem_get_info(device)
        most = min(most, int(SHARE_OF_MEMORY * memory / BYTES_PER_PIXEL))
    return max(1, min(MOST_FRAMES, most // pixels))


class _Engine:
    """What stays on the device while a body is followed."""

    def __init__(self, course: BodyTracker, device: str) -> None:
        load_solvers(device)
        self._course, scene = course, course.scene
        self._views = [torch_view(view, device, PRECISION) for view in scene.views]
        self._references = [torch_reference(reference, device, PRECISION) for reference in scene.references]

    def find(self, batch: _Batch, starts: FloatArray) -> list[FollowedFrame | None]:
        """The body in frames from poses (n, 6) foretold of them, its subsets where they are sought; None where lost."""
        scene, before = self._course.scene, previous_fits(self._course)
        splines = [splines_of(raw, scene.settings.degree, PRECISION) for raw in batch.raw]
        everywhere = range(len(starts))
        fits = fit_frames(self._views, [(one, everywhere) for one in splines], starts)
        kept = [None if fit is None or has_excess_noise(fit, before) else fit for fit in fits]
        sought = [k for k, fit in enumerate(kept) if fit is not None and scene.subset_frames[batch.numbers[k]]]
        begun = {k: self._course.subset_starts(kept[k]) for k in sought}
        sides = [self._subsets(side, one, batch, begun) for side, one in enumerate(splines)]
        found: list[FollowedFrame | None] = []
        for k, fit in enumerate(kept):
            here = tuple(side[k] for side in sides if k in side)
            lost = fit is None or (k in begun and len(here) < len(sides))
            found.append(None if lost else (here if k in begun else None, fit))
        return found

    def _subsets(
        self, side: int, splines: TorchSplines, batch: _Batch, begun: dict[int, list[FloatArray | None]]
    ) -> dict[int, Registration]:
        """A camera's subsets in the frames that have starts; without those frames in which they have to be searched."""
        if not begun:
            return {}
        scene, reference, prepared = self._course.scene, self._course.scene.references[side], self._references[side]
        starts = {k: start for k, both in begun.items() if (start := both[side]) is not None}

        def registered(starts: dict[int, FloatArray]) -> dict[int, Registration]:
            whole = np.full((len(batch.numbers), *next(iter(starts.values())).shape), np.nan)
            whole[list(starts)] = list(starts.values())
            found = register_frames(prepared, splines, whole, scene.settings)
            return {k: found[k] for k in starts}

        found = grow_from_neighbours(reference, registered(starts), registered)
        follower, brightest = self._course.sides[side], batch.raw[side].float().amax(dim=(1, 2)).cpu().numpy()
        for k, here in found.items():
            if brightest[k] >= scene.images[side].saturation:
                found[k] = follower.unsaturated(batch.images[k][side], here)
        warps, begun_at = (
            np.stack(arrays) for arrays in zip(*((found[k].warp, starts[k]) for k in found), strict=True)
        )
        usable = reference.status == TrackStatus.OK
        lost = usable & np.array([here.status != TrackStatus.OK for here in found.values()])
        there = ~subsets_displaced(warps, begun_at) & (lost.sum(axis=1) <= MORE_LOST * lost.shape[1])
        return {k: here for (k, here), kept in zip(found.items(), there, strict=True) if kept}


# What the frames before foretell of many.

FEWEST = 8  # frames to which sines are fitted
LINES = 4
TRUSTED_PX, CLOSE_PX = 0.5, 0.05
NEAR_PX = 3.0  # rms, from which a body is found, mostly
POINTS = 16
FINER, REFINEMENTS = 33, 4


def previous_fits(course: BodyTracker) -> list[DirectFit]:
    """Return the fits of the frames in a row before the next, or those that gave the noise of the images."""
    return course.fits or [fit for _, fit in course.scene.lead[-1:] if fit is not None]


def predict_poses(course: BodyTracker, most: int) -> FloatArray:
    """Return the poses (n, 6) that the fits so far foretell of the next frames, at most so many; none from no fits.

    The body stays where it was, or moves by up to `LINES` sines about a drifting mean, taken from the strongest on:
    whatever would have foretold the last quarter of the frames best. No more frames are foretold than there were. Where
    that last quarter would have been missed by half a pixel, they are looked for from the mean place, if none was far
    from it; else only the next one is foretold, by `foretold_motion`. After fewer than `FORETELLING` frames
    `FIRST_FRAMES` are looked for from the mean place, the first ones from half way between rest and the lead.
    """
    fits = previous_fits(course)
    if not fits:
        return np.empty((0, 6))
    poses = np.array([fit.moved.pose for fit in fits])
    if len(fits) < MIN_PREDICTION_FRAMES:
        middle = np.mean(poses if course.fits else [np.zeros(6), *poses], axis=0)
        return np.tile(middle, (min(most, FIRST_FRAMES), 1))
    tested = len(fits) // 4
    count, known = min(most, len(fits)), len(fits) - tested
    rates = np.concatenate([seen.rates[np.isfinite(seen.rates).all(axis=(1, 2))] for seen in course.scene.seen])
    moved_px = poses @ rates[:: max(1, len(rates) // POINTS)].reshape(-1, 6).T
    lines, miss = _lines_of(moved_px[:known], moved_px[known:]) if count > 1 and known >= FEWEST else (0, np.inf)
    if miss > TRUSTED_PX:
        off_px = np.sqrt(np.mean((moved_px - moved_px.mean(axis=0)) ** 2, axis=1))
        near = np.max(off_px) < NEAR_PX
        return np.tile(poses.mean(axis=0), (count, 1)) if near else predict_motion(fits).pose[None]
    if lines == 0:
        return np.tile(poses[-1], (count, 1))
    frequencies = np.zeros(0)
    for _ in range(lines):
        frequencies = _next_line(moved_px, frequencies)
    return _continued(poses, frequencies, count)


def _lines_of(known: FloatArray, truth: FloatArray) -> tuple[int, float]:
    """How many sines foretell best the places that follow those known, and how far off they are; 0: the last place."""
    best, frequencies = (0, float(np.median(np.abs(known[-1] - truth)))), np.zeros(0)
    for number in range(1, LINES + 1):
        if best[1] < CLOSE_PX or len(known) < 2 * (number + 1) + MIN_PREDICTION_FRAMES:
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
