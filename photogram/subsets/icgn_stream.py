"""A series of images followed on a device, batch by batch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import FloatArray
from photogram.bspline import spline_of_image
from photogram.subsets.follow import NEIGHBOUR_ROUNDS, TrackSettings, follow, identity, merged
from photogram.subsets.icgn import Registration
from photogram.subsets.icgn_torch import (
    TorchReference,
    TorchSplines,
    forecast_warps,
    register_frames,
    spline_frames,
    torch_reference,
)
from photogram.subsets.reference import Reference, TrackStatus
from photogram.subsets.search import neighbour_starts

Image = NDArray[Any]
HISTORY = 64
ENOUGH = 0.5


@dataclass(frozen=True)
class _Batch:
    """Frames on the device, and what is looked for in them."""

    reference: Reference
    prepared: TorchReference
    frames: TorchSplines
    settings: TrackSettings

    def find(self, start: FloatArray) -> tuple[Registration, ...]:
        """Registration of all frames from the warps `start` (B,N,6) with the settings' limits."""
        limits = (self.settings.max_iterations, self.settings.convergence_px, self.settings.min_zncc)
        return register_frames(self.prepared, self.frames, start, *limits)


def follow_frames(
    reference: Reference,
    first: Image,
    images: Iterable[Image],
    settings: TrackSettings,
    device: str,
    batch_frames: int = 32,
    precision: str = "float64",
) -> Iterator[tuple[Image, Registration]]:
    """Every image after the `first` in turn, with where the subsets of `reference` are in it.

    Images are read in batches, the next one by a thread meanwhile, so at most two are in memory. A batch is done at
    once as far as its starts can be foretold (`forecast_warps`). Frames of which half is not found start again from
    the nearest frame found, then single subsets from their neighbours as in `photogram.subsets.follow`; a frame still
    lost is searched on the CPU.
    """
    if batch_frames < 1:
        raise ValueError(f"batch_frames: expected at least 1, found {batch_frames}")
    prepared = torch_reference(reference, device, precision)
    history = [identity(reference).warp]
    for images_read in _read_ahead(images, batch_frames):
        left = images_read
        while left:
            start = forecast_warps(history, len(left))
            stack, left = left[: len(start)], left[len(start) :]
            frames = spline_frames(np.stack(stack), settings.degree, device, precision)
            found = _find(_Batch(reference, prepared, frames, settings), start, history[-1])
            for image, seen in zip(stack, found, strict=True):
                here = seen
                if not _is_found(reference.status, seen):
                    target = spline_of_image(image, settings.degree)
                    here = follow(reference, first, (image, target), history[-1], settings)
                history = [*history[1 - HISTORY :], here.warp]
                yield image, here


def _read_ahead(images: Iterable[Image], batch_frames: int) -> Iterator[list[Image]]:
    """Images in batches, of which a thread reads the next one in advance."""
    source = iter(images)

    def read() -> list[Image]:
        return list(islice(source, batch_frames))

    with ThreadPoolExecutor(max_workers=1) as reader:
        coming = reader.submit(read)
        while batch := coming.result():
            coming = reader.submit(read)
            yield batch


def _find(batch: _Batch, start: FloatArray, before: FloatArray) -> list[Registration]:
    """The subsets of every frame from `start` (B,N,6), else from the nearest frame found, else from neighbours."""
    return _from_neighbours(batch, _from_nearest_frames(batch, list(batch.find(start)), before))


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
    return found
