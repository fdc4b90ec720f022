"""Rows that were not exposed together, and rows that repeat their neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shakercal._common.arrays import FloatArray

SMALLEST_PX = 16  # side of a part that is compared
COPIED = 0.05
"""Variance of rows between their neighbours, of one parity over the other, below which they are copies: it is 1 for
rows of a sensor, and that of rounding for copies (chosen)."""


def rows_repeat(image: NDArray[Any]) -> bool:
    """Return whether every other row of an image (H, W) equals its neighbours.

    Or the mean of both. So do images of one field of an interlaced camera, stretched to full height. Noise makes rows
    of a sensor differ.

    >>> noise = np.random.default_rng(1).integers(100, 900, (64, 48))
    >>> rows_repeat(noise), rows_repeat(np.repeat(noise, 2, axis=0))
    (False, True)
    """
    grey = image[: len(image) // 2 * 2].astype(np.float64)
    if len(grey) < 8:
        return False
    steps = np.mean(np.diff(grey, axis=0) ** 2, axis=1)
    bends = np.mean((grey[1:-1] - 0.5 * (grey[:-2] + grey[2:])) ** 2, axis=1)
    for size in (steps, bends):
        of_parity = float(size[::2].mean()), float(size[1::2].mean())
        if min(of_parity) < COPIED * max(of_parity):
            return True
    return False


def parity_displacement(
    first: NDArray[Any], image: NDArray[Any], moved_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the displacement (2,) of odd from even rows, and of columns.

    Since the first image. The same part of both images (H, W) of a body is compared after its displacement `moved_px`
    (2,), rounded to whole pixels and an even number of rows and columns. The change is a sum of the gradients, once for
    all pixels and once with the sign of the row, or column, by least squares. Rows of a sensor with one shutter differ
    as columns do, by noise. In px along x and y, NaN for parts that are too small.
    """
    dx, dy = (2 * np.rint(moved_px / 2.0)).astype(int).tolist()
    height, width = first.shape
    top, left = max(0, -dy), max(0, -dx)
    bottom, right = min(height, height - dy), min(width, width - dx)
    if min(bottom - top, right - left) < SMALLEST_PX:
        return np.full(2, np.nan), np.full(2, np.nan)
    before = first[top:bottom, left:right].astype(np.float64)
    after = image[top + dy : bottom + dy, left + dx : right + dx].astype(np.float64)
    mean = 0.5 * (before + after)
    along_x, along_y = 0.5 * (mean[1:-1, 2:] - mean[1:-1, :-2]), 0.5 * (mean[2:, 1:-1] - mean[:-2, 1:-1])
    change = (before - after)[1:-1, 1:-1]
    rows, columns = np.indices(change.shape)
    common = [along_x, along_y, np.ones_like(change)]
    found = []
    for number in (rows + top + 1, columns + left + 1):
        sign = np.where(number % 2 == 1, 0.5, -0.5)
        design = np.stack([one.ravel() for one in (*common, *(sign * one for one in common))])
        found.append(np.linalg.lstsq(design @ design.T, design @ change.ravel(), rcond=None)[0][3:5])
    return np.asarray(found[0]), np.asarray(found[1])
