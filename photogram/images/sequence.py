"""A series of grey images of one camera, read one at a time, and what its files say of times and exposures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import FloatArray, Notice, check_shape

GreyImage = NDArray[np.uint8 | np.uint16]


@dataclass(frozen=True)
class ImageSequence:
    """Grey images of one size that are read one at a time: names (F), size_px (width, height), full_scale grey value.

    `reader` returns frame i as it stands in its file; `read` is the checked access to it. Where the files state them:
    `time_s` (F,) of the frames on the camera's own clock, from the first one on, and the `exposure_s`; `notices` tell
    what the files do to the grey values.

    >>> images = ImageSequence(("dark", "bright"), (640, 480), 255, lambda k: np.full((480, 640), 100 * k, np.uint8))
    >>> len(images), int(images.read(1).max())
    (2, 100)
    """

    names: tuple[str, ...]
    size_px: tuple[int, int]
    full_scale: int
    reader: Callable[[int], GreyImage]
    time_s: FloatArray | None = None
    exposure_s: float | None = None
    notices: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        if self.time_s is not None:
            check_shape("time_s", self.time_s, (len(self.names),))

    def __len__(self) -> int:
        return len(self.names)

    def read(self, index: int) -> GreyImage:
        """Frame `index` as (H,W) uint8 or uint16 with every bit that the file has."""
        image = self.reader(index)
        name, (width, height) = self.names[index], self.size_px
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"{name}: expected a grey image of 8 or 16 bit, found {image.dtype} {image.shape}")
        if image.shape != (height, width):
            raise ValueError(f"{name}: expected {width} x {height} px, found {image.shape[1]} x {image.shape[0]}")
        brightest = int(image.max())
        if brightest > self.full_scale:
            bits = self.full_scale.bit_length()
            raise ValueError(
                f"{name}: expected grey values up to {self.full_scale} (bit depth {bits}), found {brightest}"
            )
        return image


def full_scale_of(path: Path, stored_bits: int, bit_depth: int | None) -> int:
    """Return the largest grey value of `bit_depth` bits (None: all stored bits), which the stored ones must hold."""
    depth = stored_bits if bit_depth is None else bit_depth
    if not 1 <= depth <= stored_bits:
        raise ValueError(f"{path}: expected images of bit depth {bit_depth}, found {stored_bits} bits per pixel")
    return int(2**depth - 1)


def saturated_fraction(image: GreyImage, full_scale: int) -> float:
    """Fraction of the pixels of `image` (H,W) that are at full scale."""
    return float(np.mean(image >= full_scale))
