"""Image sequences from disk with their full bit depth: the only image reading of the package."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

GreyImage = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class ImageSequence:
    """Grey images of one size that are read one at a time: names (F), size_px (width, height), full_scale grey value."""

    names: tuple[str, ...]
    size_px: tuple[int, int]
    full_scale: int
    reader: Callable[[int], GreyImage]

    def __len__(self) -> int:
        return len(self.names)

    def read(self, index: int) -> GreyImage:
        """Frame `index` as (H,W) uint8 or uint16 with every bit that the file has."""
        raise NotImplementedError


def open_sequence(paths: Sequence[Path], bit_depth: int | None = None) -> ImageSequence:
    """Open grey images: several TIFF or PNG files, one multi-page TIFF, or one .cih beside its .mraw."""
    raise NotImplementedError


def saturated_fraction(image: GreyImage, area: NDArray[np.bool_] | None, full_scale: int) -> float:
    """Fraction of the pixels inside `area` (H,W) that are at full scale."""
    raise NotImplementedError
