"""Tracking of a body on a GPU: predictable frames are fitted in batches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice, pairwise, zip_longest
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photogram.direct.direct_fit import DirectFit, views_near
from photogram.direct.fit_torch import fit_frames, load_solvers, torch_view
from photogram.geometry import RigidTransform
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
from shakercal._common.arrays import FloatArray

MOST_FRAMES, FIRST_FRAMES = 128, 12
"""Frames of a batch, and of the first one, which has no prediction."""
MOST_PIXELS, BYTES_PER_PIXEL, SHARE_OF_MEMORY = 2**29, 32, 0.2
"""Pixels of a batch, memory for each on a device, and share of the device's memory."""


@dataclass(frozen=True)
class _Batch:
    """Successive frames, in memory and on the device."""

    numbers: range
    images: Sequence[tuple[GreyImage, ...]]
    raw: Sequence[Tensor]

    def part(self, first: int, count: int) -> _Batch:
        """Return some of the frames."""
        selected = slice(first, first + count)
        return _Batch(self.numbers[selected], self.images[selected], [one[selected] for one in self.raw])


def find_in_batches(tracker: BodyTracker, frames: range, device: str) -> Iterator[FollowedFrame]:
    """Find the body and its subsets in some frames in turn.

    Frames without a prediction, or in which the body or subsets are not found there, are processed as on a CPU.
    """
    engine = _Engine(tracker, device)
    for batch in _read_ahead(tracker, frames, device):
        done = 0
        while done < len(batch.numbers):
            starts = tracker.extrapolate(batch.numbers[done:])
            if len(starts) == 0:
                starts = predict_poses(tracker, len(batch.numbers) - done)
            part, lost = batch.part(done, max(1, len(starts))), False
            found = engine.find(part, starts) if len(starts) else [None]
            for number, images, one in zip(part.numbers, part.images, found, strict=True):
                if one is None and lost:  # two consecutive ones: the prediction is wrong
                    break
                yield tracker.find(number, images) if one is None else tracker.add_frame(*one)
                done, lost = done + 1, one is None


def _read_ahead(tracker: BodyTracker, frames: range, device: str) -> Iterator[_Batch]:
    """Yield frames in batches, read and uploaded in advance by threads."""
    sources = [images.read_ahead(frames) for images in tracker.scene.images]
    length = _most_frames(sum(images.size_px[0] * images.size_px[1] for images in tracker.scene.images), device)
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
    """Return the number of frames in a batch; pixels: of one frame in all cameras."""
    most = MOST_PIXELS
    if torch.device(device).type == "cuda":
        _, memory = torch.cuda.mem_get_info(device)
        most = min(most, int(SHARE_OF_MEMORY * memory / BYTES_PER_PIXEL))
    return max(1, min(MOST_FRAMES, most // pixels))


class _Engine:
    """Data on the device while a body is tracked."""

    def __init__(self, tracker: BodyTracker, device: str) -> None:
        load_solvers(device)
        self._tracker, self._device, scene = tracker, device, tracker.scene
        self._views = [torch_view(view, device, PRECISION) for view in scene.views]
        self._references = [torch_reference(reference, device, PRECISION) for reference in scene.references]

    def find(self, batch: _Batch, starts: FloatArray) -> list[FollowedFrame | None]:
        """Return the body in frames from predicted poses (n, 6), None where lost.

        Subsets are found in the frames in which they are searched.
        """
        scene, before = self._tracker.scene, previous_fits(self._tracker)
        splines = [splines_of(raw, scene.settings.degree, PRECISION) for raw in batch.raw]
        everywhere, first = range(len(starts)), RigidTransform.from_pose(starts[0])
        if not all(view.source.is_near(first) for view in self._views):
            near = views_near([view.source for view in self._views], first)
            self._views = [torch_view(view, self._device, PRECISION) for view in near]
        fits = fit_frames(self._views, [(one, everywhere) for one in splines], starts)
        accepted = [None if fit is None or has_excess_noise(fit, before) else fit for fit in fits]
        with_subsets = [
            k for k, fit in enumerate(accepted) if fit is not None and scene.subset_frames[batch.numbers[k]]
        ]
        begun = {k: self._tracker.subset_starts(accepted[k]) for k in with_subsets}
        sides = [self._subsets(side, one, batch, begun) for side, one in enumerate(splines)]
        found: list[FollowedFrame | None] = []
        for k, fit in enumerate(accepted):
            registered = tuple(side[k] for side in sides if k in side)
            lost = fit is None or (k in begun and len(registered) < len(sides))
            found.append(None if lost else (registered if k in begun else None, fit))
        return found

    def _subsets(
        self, side: int, splines: TorchSplines, batch: _Batch, begun: dict[int, list[FloatArray | None]]
    ) -> dict[int, Registration]:
        """Return a camera's subsets in the frames that have starts.

        Frames in which subsets have to be searched are omitted.
        """
        if not begun:
            return {}
        scene, reference, prepared = self._tracker.scene, self._tracker.scene.references[side], self._references[side]
        starts = {k: start for k, both in begun.items() if (start := both[side]) is not None}

        def register_starts(starts: dict[int, FloatArray]) -> dict[int, Registration]:
            whole = np.full((len(batch.numbers), *next(iter(starts.values())).shape), np.nan)
            whole[list(starts)] = list(starts.values())
            found = register_frames(prepared, splines, whole, scene.settings)
            return {k: found[k] for k in starts}

        found = grow_from_neighbours(reference, register_starts(starts), register_starts)
        follower, brightest = self._tracker.sides[side], batch.raw[side].float().amax(dim=(1, 2)).cpu().numpy()
        for k, registration in found.items():
            if brightest[k] >= scene.images[side].saturation:
                found[k] = follower.unsaturated(batch.images[k][side], registration)
        warps, begun_at = (
            np.stack(arrays) for arrays in zip(*((found[k].warp, starts[k]) for k in found), strict=True)
        )
        usable = reference.status == TrackStatus.OK
        lost = usable & np.array([registration.status != TrackStatus.OK for registration in found.values()])
        near_start = ~subsets_displaced(warps, begun_at) & (lost.sum(axis=1) <= MORE_LOST * lost.shape[1])
        return {
            k: registration
            for (k, registration), found_near in zip(found.items(), near_start, strict=True)
            if found_near
        }


# Prediction of many frames by those before.

FEWEST = 8  # frames to which sines are fitted
LINES = 4  # of a periodic motion
TRUSTED_PX, CLOSE_PX = 0.5, 0.05  # error of a prediction from which a fit converges, and that of one that suffices
NEAR_PX = 3.0  # rms displacement from which a fit usually converges
POINTS = 16  # of the body, at which predictions are compared
FINER, REFINEMENTS = 33, 4  # frequencies of a refined grid, and how often it is refined


def previous_fits(tracker: BodyTracker) -> list[DirectFit]:
    """Return the fits of the consecutive frames before the next, or that of the noise."""
    return tracker.fits or [fit for _, fit in tracker.scene.lead[-1:] if fit is not None]


def predict_poses(tracker: BodyTracker, most: int) -> FloatArray:
    """Return the poses (n,6) of the next frames by the fits so far.

    At most `most`. None without fits. The body stays, or moves by up to `LINES` sines about a drifting mean, from the
    strongest on: by the rule that would have predicted the last quarter of the frames best. At most as many frames are
    predicted as there were. If the last quarter would have been missed by half a pixel, frames start from the mean
    pose, provided that no frame was far from it. Otherwise only the next one is predicted, by `predict_motion`. After
    fewer than `MIN_PREDICTION_FRAMES` frames, `FIRST_FRAMES` start from the mean pose, the first ones from half way
    between rest and the lead.
    """
    fits = previous_fits(tracker)
    if not fits:
        return np.empty((0, 6))
    poses = np.array([fit.moved.pose for fit in fits])
    if len(fits) < MIN_PREDICTION_FRAMES:
        middle = np.mean(poses if tracker.fits else [np.zeros(6), *poses], axis=0)
        return np.tile(middle, (min(most, FIRST_FRAMES), 1))
    tested = len(fits) // 4
    count, number = min(most, len(fits)), len(fits) - tested
    rates = np.concatenate([seen.rates[np.isfinite(seen.rates).all(axis=(1, 2))] for seen in tracker.scene.seen])
    moved_px = poses @ rates[:: max(1, len(rates) // POINTS)].reshape(-1, 6).T
    lines, miss = _lines_of(moved_px[:number], moved_px[number:]) if count > 1 and number >= FEWEST else (0, np.inf)
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


def _lines_of(series: FloatArray, truth: FloatArray) -> tuple[int, float]:
    """Return how many sines predict `truth` best from `series`, and their median error.

    0: the last value.
    """
    best, frequencies = (0, float(np.median(np.abs(series[-1] - truth)))), np.zeros(0)
    for number in range(1, LINES + 1):
        if best[1] < CLOSE_PX or len(series) < 2 * (number + 1) + MIN_PREDICTION_FRAMES:
            break
        frequencies = _next_line(series, frequencies)
        miss = float(np.median(np.abs(_continued(series, frequencies, len(truth)) - truth)))
        best = min(best, (number, miss), key=lambda each: each[1])
    return best


def _continued(series: FloatArray, frequencies: FloatArray, count: int) -> FloatArray:
    """Return the next values (count, K) of a series (M, K) by least squares."""
    past, coming = np.split(np.arange(len(series) + count, dtype=np.float64), [len(series)])
    return np.asarray(_design(frequencies, coming) @ (np.linalg.pinv(_design(frequencies, past)) @ series))


def _design(frequencies: FloatArray, frames: FloatArray) -> FloatArray:
    """Return columns (M, 2 + 2L) of mean, drift, cosines and sines of frequencies (L,).

    In radians per frame.
    """
    phase = np.outer(frames, frequencies)
    return np.concatenate([np.ones((len(frames), 1)), frames[:, None], np.cos(phase), np.sin(phase)], axis=1)


def _next_line(series: FloatArray, frequencies: FloatArray) -> FloatArray:
    """Return the frequencies (L,) of a series (M,K), and that of the next best sine.

    It fits the leading component of the residuals, with at least half a period within the M frames. A grid of a quarter
    of the resolution is refined four times.
    """
    frames = np.arange(len(series), dtype=np.float64)
    design = _design(frequencies, frames)
    left = series - design @ (np.linalg.pinv(design) @ series)
    _, vectors = np.linalg.eigh(left @ left.T)
    component, lowest = vectors[:, -1], np.pi / len(series)
    ordered, _ = np.linalg.qr(design)
    grid = np.linspace(lowest, np.pi, 4 * len(series))
    for _ in range(REFINEMENTS):
        waves = np.exp(1j * np.outer(grid, frames))
        pairs = np.stack([waves.real, waves.imag], axis=-1)
        basis, _ = np.linalg.qr(pairs - ordered @ (ordered.T @ pairs))
        best = grid[np.argmax(np.sum((component @ basis) ** 2, axis=-1))]
        reach = grid[1] - grid[0]
        grid = np.linspace(max(best - reach, lowest), min(best + reach, np.pi), FINER)
    return np.append(frequencies, best)
