"""A series of images followed on a device, batch by batch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import FloatArray
from photogram.bspline import spline_of_image
from photogram.subsets.find import NEIGHBOUR_ROUNDS, follow, identity, merged
from photogram.subsets.icgn import Registration, TrackSettings, resolved
from photogram.subsets.icgn_torch import (
    TorchReference,
    TorchSplines,
    register_frames,
    splines_of,
    torch_reference,
    uploaded,
)
from photogram.subsets.reference import Reference, TrackStatus
from photogram.subsets.search import neighbour_starts, predict_warp

if TYPE_CHECKING:
    from torch import Tensor

Image = NDArray[Any]
HISTORY = 64
ENOUGH = 0.5
PRECISION = "float32"
"""Of pixels and coefficients; sums over them are float64."""


@dataclass(frozen=True)
class OnDevice:
    """The spline of an image on a device: one of a batch of `frames`."""

    frames: TorchSplines
    number: int


@dataclass(frozen=True)
class _Batch:
    """Frames on the device, and what is looked for in them."""

    reference: Reference
    prepared: TorchReference
    frames: TorchSplines
    settings: TrackSettings

    def find(self, start: FloatArray) -> tuple[Registration, ...]:
        """Registration of all frames from the warps `start` (B,N,6)."""
        return register_frames(self.prepared, self.frames, start, self.settings)


def follow_frames(
    reference: Reference,
    first: Image,
    images: Iterable[Image],
    settings: TrackSettings,
    device: str,
    batch_frames: int = 32,
    precision: str = PRECISION,
) -> Iterator[tuple[Image, Registration, OnDevice]]:
    """Every image after the `first` in turn, with where the subsets of `reference` are in it, and its spline.

    Images are read and uploaded in batches, the next one by a thread meanwhile, so at most two are held. A batch is
    done at once as far as its starts can be foretold. Frames of which half is not found start again from the nearest
    frame found, then single subsets from their neighbours; a frame still lost is searched on the CPU.
    """
    if batch_frames < 1:
        raise ValueError(f"batch_frames: expected at least 1, found {batch_frames}")
    prepared = torch_reference(reference, device, precision)
    history = [identity(reference).warp]
    for images_read, raw in _read_ahead(images, batch_frames, device):
        done = 0
        while done < len(images_read):
            start = forecast_warps(history, len(images_read) - done)
            own = slice(done, done + len(start))
            stack, frames, done = images_read[own], splines_of(raw[own], settings.degree, precision), own.stop
            batch = _Batch(reference, prepared, frames, settings)
            found = _from_nearest_frames(batch, list(batch.find(start)), history[-1])
            found = _from_neighbours(batch, found)
            for number, (image, seen) in enumerate(zip(stack, found, strict=True)):
                here = seen
                if not _is_found(reference.status, seen):
                    target = spline_of_image(image, settings.degree)
                    here = follow(reference, first, (image, target), history[-1], settings)
                history = [*history[1 - HISTORY :], here.warp]
                yield image, here, OnDevice(frames, number)


def _read_ahead(images: Iterable[Image], batch_frames: int, device: str) -> Iterator[tuple[list[Image], Tensor]]:
    """Images in batches, in memory and on the device; a thread reads and uploads the next one in advance."""
    source = iter(images)

    def read() -> tuple[list[Image], Tensor] | None:
        batch = list(islice(source, batch_frames))
        return (batch, uploaded(np.stack(batch), device)) if batch else None

    with ThreadPoolExecutor(max_workers=1) as reader:
        coming = reader.submit(read)
        while (batch := coming.result()) is not None:
            coming = reader.submit(read)
            yield batch


def _is_found(status: NDArray[np.int8], found: Registration) -> bool:
    """Whether half of the usable subsets (status (N,) of the reference) were found."""
    usable = status == TrackStatus.OK
    return bool(np.sum(found.status[usable] == TrackStatus.OK) >= ENOUGH * usable.sum())


def _again(batch: _Batch, found: Sequence[Registration], start: FloatArray) -> list[Registration]:
    """`found` with the subsets that only the warps `start` (B,N,6) lead to."""
    return [merged(here, more) for here, more in zip(found, batch.find(start), strict=True)]


def _from_nearest_frames(batch: _Batch, found: list[Registration], before: FloatArray) -> list[Registration]:
    """Lost frames once more from the warps of the nearest frame that was found; `before` (N,6) precedes them all."""
    places, tried = np.arange(1, len(found) + 1), np.full(len(found), -1)
    while True:
        seen = np.array([True, *(_is_found(batch.reference.status, here) for here in found)])
        options = np.flatnonzero(seen)
        nearest = options[np.argmin(np.abs(options[:, None] - places), axis=0)]
        again = ~seen[1:] & (nearest != tried)
        if not again.any():
            return found
        tried[again] = nearest[again]
        warps = np.stack([before, *(here.warp for here in found)])
        found = _again(batch, found, np.where(again[:, None, None], warps[nearest], np.nan))


def _from_neighbours(batch: _Batch, found: list[Registration]) -> list[Registration]:
    """Single lost subsets once more from their nearest neighbours, as `find_from_neighbours` does frame by frame."""
    usable, centres = batch.reference.status == TrackStatus.OK, batch.reference.centre_px
    going_on = [_is_found(batch.reference.status, here) for here in found]
    for _ in range(NEIGHBOUR_ROUNDS):
        start = np.full((len(found), *found[0].warp.shape), np.nan)
        for b, here in enumerate(found):
            lost = usable & (here.status != TrackStatus.OK)
            if going_on[b] and lost.any():
                start[b, lost] = neighbour_starts(centres, here.warp)[lost]
        if np.isnan(start).all():
            break
        before, found = found, _again(batch, found, start)
        going_on = [bool(np.any(old.status != new.status)) for old, new in zip(before, found, strict=True)]
    return [resolved(batch.reference, here) for here in found]


FEWEST = 8
TRUSTED_PX = 0.5
FINER = 33
REFINEMENTS = 4


def forecast_warps(history: Sequence[FloatArray], most: int) -> FloatArray:
    """Warps (K,N,6) of the next 1 ≤ K ≤ `most` frames after those in `history` (oldest first, N,6 each).

    Frames stay where the last one was, or follow a sine with a mean and a drift, of one frequency for all subsets,
    fitted to all frames: whichever would have foretold the last quarter of them better. Not more frames are foretold
    than there were, and only the next one, by `predict_warp`, when that last quarter would have been missed by half a
    pixel. In a frame in which it was lost, a subset counts as in the one before.
    """
    seen = np.stack(history)
    series = seen.copy()
    for before, here in pairwise(series):
        np.copyto(here, before, where=np.isnan(here))
    kept = np.isfinite(seen if np.isfinite(seen).all(axis=(0, 2)).any() else series).all(axis=(0, 2))
    shifts = series[:, kept][..., [0, 3]].reshape(len(series), -1)
    count, tested = min(most, len(series)), len(series) // 4
    if count == 1 or len(series) - tested < FEWEST or shifts.size == 0:
        return predict_warp(history[-6:])[None]
    known, truth = np.split(shifts, [len(series) - tested])
    stayed = float(np.median(np.abs(known[-1] - truth)))
    swung = float(np.median(np.abs(_continued(known, _frequency(known), tested) - truth)))
    if min(stayed, swung) > TRUSTED_PX:
        return predict_warp(history[-6:])[None]
    if stayed < swung:
        return np.repeat(series[-1:], count, axis=0)
    return _continued(series.reshape(len(series), -1), _frequency(shifts), count).reshape(count, *series.shape[1:])


def _continued(series: FloatArray, frequency: float, count: int) -> FloatArray:
    """The next values (count,K) of a series (M,K) by least squares."""
    past, coming = np.split(np.arange(len(series) + count, dtype=np.float64), [len(series)])
    return np.asarray(_design(frequency, coming) @ (np.linalg.pinv(_design(frequency, past)) @ series))


def _design(frequency: FloatArray | float, frames: FloatArray) -> FloatArray:
    """Columns (...,M,4) of a mean, a drift, a cosine and a sine of `frequency` (...) in radians per frame."""
    phase = np.multiply.outer(frequency, frames)
    drift = np.broadcast_to(frames, phase.shape)
    return np.asarray(np.stack([np.ones_like(phase), drift, np.cos(phase), np.sin(phase)], axis=-1))


def _frequency(shifts: FloatArray) -> float:
    """Frequency in radians per frame of the sine that fits the leading component of the shifts (M,K) best.

    At least half a period lies within the M frames. A grid of a quarter of the resolution is made finer four times.
    """
    frames = np.arange(len(shifts), dtype=np.float64)
    line = np.stack([np.ones_like(frames), frames], axis=1)
    left = shifts - line @ (np.linalg.pinv(line) @ shifts)
    _, vectors = np.linalg.eigh(left @ left.T)
    course, lowest = vectors[:, -1], np.pi / len(shifts)
    grid = np.linspace(lowest, np.pi, 4 * len(shifts))
    for _ in range(REFINEMENTS):
        basis, _ = np.linalg.qr(_design(grid, frames))
        best = grid[np.argmax(np.sum((course @ basis) ** 2, axis=-1))]
        reach = grid[1] - grid[0]
        grid = np.linspace(max(best - reach, lowest), min(best + reach, np.pi), FINER)
    return float(best)
