"""Images of one camera for display, and the reason for each unreadable one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from photogram.images.image_files import open_sequence, read_image
from photogram.images.sequence import FrameNumbers, GreyImage, ImageSequence, numbers_of_names

READ_ERRORS = (OSError, ValueError, ArithmeticError, LookupError, MemoryError)


@dataclass(frozen=True)
class ShownImage:
    """An image as stored: grey values (H, W) and the largest possible one.

    `refusal`: why a run refuses it.
    """

    grey: GreyImage
    full_scale: int
    refusal: Exception | None = None


class CameraImages:
    """Images of one camera, read one at a time.

    `refusal`: why a run refuses them, None if their headers are in order.
    """

    def __init__(self, paths: Sequence[Path], bit_depth: int | None) -> None:
        self.paths, self._bit_depth = tuple(paths), bit_depth
        self.refusal: Exception | None = None
        self._whole: ImageSequence | None = None
        self._refused: dict[int, Exception] = {}
        try:
            self._whole = open_sequence(self.paths, bit_depth)
        except READ_ERRORS as error:
            self.refusal = error
            if len(self.paths) == 1:
                self._refused[0] = error

    def __len__(self) -> int:
        return len(self.paths) if self._whole is None else len(self._whole)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames."""
        return tuple(map(str, self.paths)) if self._whole is None else self._whole.names

    @property
    def numbers(self) -> FrameNumbers | None:
        """Numbers of the frames, by their files."""
        return numbers_of_names([path.name for path in self.paths]) if self._whole is None else self._whole.numbers

    @cached_property
    def sequence(self) -> ImageSequence | None:
        """The images as a run reads them, or the first readable one, or None."""
        if self._whole is not None:
            return self._whole
        for path in self.paths:
            try:
                return open_sequence([path], self._bit_depth)
            except READ_ERRORS:
                continue
        return None

    @cached_property
    def refused(self) -> dict[int, Exception]:
        """Reason of each frame whose header a run refuses, by its place."""
        if self._whole is None and not self._refused:
            first = None if self.sequence is None else Path(self.sequence.names[0])
            for frame, path in enumerate(self.paths):
                pair = (path,) if first is None or path == first else (first, path)
                try:
                    open_sequence(pair, self._bit_depth)
                except READ_ERRORS as error:
                    self._refused[frame] = error
        return self._refused

    def read(self, frame: int) -> ShownImage:
        """Return a frame; raise the error of a file that no reader can read."""
        if not 0 <= frame < len(self):
            raise ValueError(f"frame: expected 0 to {len(self) - 1}, found {frame}")
        refusal = self.refused.get(frame)
        if refusal is not None:
            return self._read_alone(frame, refusal)
        images, index = self._whole, frame
        if images is None:
            images, index = open_sequence([self.paths[frame]], self._bit_depth), 0
        grey = images.reader(index)
        try:
            replace(images, most_saturated=1.0).check(index, grey)
        except ValueError as error:
            refusal = error
        return ShownImage(grey, max(images.full_scale, int(grey.max())), refusal)

    def _read_alone(self, frame: int, refusal: Exception) -> ShownImage:
        """Return a refused image of another size or kind; colours become their luminance."""
        try:
            grey, full_scale = read_image(self.paths[frame])
        except READ_ERRORS:
            raise refusal from None
        usual = 0 if self.sequence is None else self.sequence.full_scale
        return ShownImage(grey, max(full_scale, usual), refusal)


def paired_frames(keys: Sequence[Sequence[int]]) -> list[list[int | None]]:
    """Return the frame of each camera, or None, for every key that a camera has.

    >>> paired_frames([[0, 1, 2], [1, 2, 3]])
    [[0, None], [1, 0], [2, 1], [None, 2]]
    """
    places = [{key: place for place, key in reversed(list(enumerate(of_camera)))} for of_camera in keys]
    return [[of_camera.get(key) for of_camera in places] for key in sorted(set().union(*places))]


def numbers_of_frames(cameras: Sequence[CameraImages]) -> list[list[int]]:
    """Return the numbers by which frames of cameras belong together.

    They are those of the files if the cameras have different numbers of them, else their order.
    """
    counts = [list(range(len(camera))) for camera in cameras]
    found = [camera.numbers for camera in cameras]
    if len({len(camera) for camera in cameras}) < 2 or not all(one is not None and one.exact for one in found):
        return counts
    return [(int(one.first) + one.step * np.asarray(one.frame_index)).tolist() for one in found if one is not None]
