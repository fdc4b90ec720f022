"""Frames stream: what a series needs does not grow with its length, but for the numbers that it is after."""

from __future__ import annotations

import gc
import tracemalloc
import weakref
from collections.abc import Callable

import numpy as np
import pytest

from photogram.images import ImageSequence
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import TrackSettings, track_sequence, track_stereo

WANDERING = ((0, 0), (1, 0), (2, 1), (1, 2), (0, 1))
MOST_HELD = 4  # per camera: the first frame, the present one, and what a reader is about to hand out


class RollingReader:
    """Frames made when they are asked for: one image rolled by a few pixels. Counts how many are alive at once."""

    def __init__(self, image: np.ndarray) -> None:
        self.image = image
        self.alive = 0
        self.most_alive = 0

    def __call__(self, index: int) -> np.ndarray:
        right, down = WANDERING[index % len(WANDERING)]
        frame = np.roll(self.image, (down, right), axis=(0, 1))
        self.alive += 1
        weakref.finalize(frame, self._forget)
        self.most_alive = max(self.most_alive, self.alive)
        return frame

    def _forget(self) -> None:
        self.alive -= 1

    def sequence(self, frames: int) -> ImageSequence:
        height, width = self.image.shape
        return ImageSequence(tuple(f"frame {k}" for k in range(frames)), (width, height), 4095, self)


@pytest.fixture(scope="module")
def speckle() -> Callable[[int, int], np.ndarray]:
    def make(width: int, height: int) -> np.ndarray:
        from scipy import ndimage

        white = np.random.default_rng(30).normal(size=(height, width))
        smooth = ndimage.gaussian_filter(white, 1.6, mode="wrap")
        return np.round(2000 + 400 * smooth / smooth.std()).astype(np.uint16)

    return make


def peak_bytes(sequence: ImageSequence, points: np.ndarray) -> int:
    """Largest memory that Python and NumPy hold at any time while the sequence is tracked."""
    gc.collect()
    tracemalloc.start()
    try:
        tracks = track_sequence(sequence, points, TrackSettings())
        assert np.all(tracks.status == TrackStatus.OK)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_ten_times_the_frames_need_no_more_memory(speckle: Callable[[int, int], np.ndarray]) -> None:
    reader = RollingReader(speckle(320, 256))
    points = np.stack(np.meshgrid(np.arange(50.0, 300, 90), np.arange(50.0, 240, 70)), axis=-1).reshape(-1, 2)
    track_sequence(reader.sequence(2), points, TrackSettings())  # imports and kernels are not counted
    few, many = (peak_bytes(reader.sequence(frames), points) for frames in (6, 60))
    assert many - few < 2 * reader.image.nbytes  # results of 54 more frames; the frames themselves would be 54 images
    assert reader.most_alive <= MOST_HELD
    gc.collect()
    assert reader.alive == 0


def test_a_stereo_pair_holds_a_few_frames_of_each_camera(speckle: Callable[[int, int], np.ndarray]) -> None:
    image = speckle(200, 160)
    readers = RollingReader(image), RollingReader(np.roll(image, (0, 3), axis=(0, 1)))
    left, right = (reader.sequence(20) for reader in readers)
    tracks = track_stereo(left, right, None, TrackSettings())
    assert np.mean(tracks.left.status == TrackStatus.OK) > 0.9
    assert all(reader.most_alive <= MOST_HELD for reader in readers)
    del tracks
    gc.collect()
    assert all(reader.alive == 0 for reader in readers)
