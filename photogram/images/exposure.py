"""Exposure of one image: dark, overexposed, clipped, or without a pattern."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.images.image_notices import COLOUR_MOSAIC, SENSOR_CLIPS
from photogram.images.sequence import GreyImage, ImageSequence
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

TILE_PX = 32  # side of a tile: many speckles, and even lighting
MIN_TILE_PX = 8  # of small images
MIN_CORRELATION = 0.05
"""Of diagonal neighbours, measured: 0.25 for speckle of 2 px, 0 ± 0.005 for the noise of 200 x 200 px."""
DARK = 0.1  # brightest pixels over full scale, chosen
TAIL, PILE = 3, 1.5  # grey values below the largest one; its frequency over that of the most frequent of them
MIN_MOSAIC = 0.04  # difference of colours; amplifiers of even and odd columns differ by less
MIN_CLIPPED = 2e-4  # share of the pixels
BRIGHT = 0.5  # share of the pixels at the largest grey value


def missing_pattern_reason(image: NDArray[Any], full_scale: int) -> str:
    """Return why an image (H, W) shows only noise, "" for one with a pattern.

    The text begins with "dark", "overexposed" or "uniform". In tiles of 32 x 32 px without mean and slopes, diagonal
    neighbours of a pattern correlate. Those of noise do not, nor does noise that rows or columns have in common. Tiles
    count by their contrast, so that a small body in front of an even background is a pattern.

    >>> rng = np.random.default_rng(1)
    >>> missing_pattern_reason(rng.poisson(20.0, (240, 320)), 1023)
    'dark, 99 % of its grey values are at most 31 of 1023, only noise is visible'
    """
    side = max(MIN_TILE_PX, min(TILE_PX, *image.shape))
    rows, columns = (length // side for length in image.shape)
    if rows * columns == 0:
        return ""
    covariance, variance = 0.0, 0.0
    for row in range(rows):  # a row of tiles at a time, which fits into the processor's cache
        band = image[row * side : (row + 1) * side, : columns * side].astype(np.float64)
        tiles = _levelled(band.reshape(side, columns, side).swapaxes(0, 1))
        first, second = tiles[:, :-1, :-1], tiles[:, 1:, 1:]
        covariance += float(np.sum(first * second))
        variance += float(np.sum(first**2))
    if covariance > MIN_CORRELATION * variance:
        return ""
    low, high = (int(value) for value in np.quantile(image, (0.01, 0.99)))
    brightest = int(image.max())
    if high < DARK * full_scale:
        return f"dark, 99 % of its grey values are at most {high} of {full_scale}, only noise is visible"
    share = float(np.mean(image == brightest))
    if share > BRIGHT:
        return f"overexposed, {100.0 * share:.3g} % of its pixels have the largest grey value {brightest}"
    return f"uniform, 98 % of its grey values are {low} to {high} of {full_scale}, only noise is visible"


def clip_level(image: NDArray[Any]) -> int | None:
    """Return the grey value at which the sensor clips, None if it does not.

    The grey values of an image (H, W) thin out towards the largest one. Clipped ones pile up there.

    >>> rng = np.random.default_rng(1)
    >>> grey = rng.normal(400.0, 50.0, (240, 320)).astype(np.uint16)
    >>> clip_level(grey), clip_level(np.minimum(grey, 500))
    (None, 500)
    """
    counts = np.bincount(image.ravel())
    counts = counts[counts > 0]  # shifted values skip codes
    if len(counts) <= TAIL or counts[-1] < MIN_CLIPPED * image.size:
        return None
    return int(image.max()) if counts[-1] > PILE * counts[-1 - TAIL : -1].max() else None


def mosaic_contrast(image: NDArray[Any]) -> float:
    """Return the relative difference of the pixels of a colour mosaic, 0 without one.

    In every square of 2 x 2 px, two pixels of a diagonal are equal (green), and at least one of the others is not.
    Amplifiers of single rows or columns make both diagonals differ.

    >>> grey = np.random.default_rng(1).normal(200.0, 5.0, (64, 64))
    >>> mosaic = grey * np.tile([[1.0, 0.6], [0.5, 1.0]], (32, 32))
    >>> mosaic_contrast(grey), round(mosaic_contrast(mosaic), 1)
    (0.0, 0.6)
    """
    rows, columns = (length // 2 * 2 for length in image.shape)
    if min(rows, columns) < 2:
        return 0.0
    level = [[float(image[row:rows:2, column:columns:2].mean()) for column in (0, 1)] for row in (0, 1)]
    mean = float(np.mean(level))
    if mean <= 0.0:
        return 0.0
    diagonals = ((level[0][0], level[1][1]), (level[0][1], level[1][0]))
    for green, others in (diagonals, diagonals[::-1]):
        equality, difference = (
            abs(green[0] - green[1]) / mean,
            max(abs(np.mean(green) - other) for other in others) / mean,
        )
        if difference > MIN_MOSAIC and equality < 0.2 * difference:
            return float(difference)
    return 0.0


def inspect_first_image(images: ImageSequence, first: GreyImage) -> ImageSequence:
    """Return images with the clip level and the notices that their first image gives.

    Raises `ValueError` where more than `most_saturated` of the first image is saturated.
    """
    level = clip_level(first)
    if level is not None and level < images.full_scale:
        share = 100.0 * np.count_nonzero(first == level) / first.size
        notice = Notice(
            SENSOR_CLIPS,
            images.names[0],
            clip_level=level,
            full_scale=images.full_scale,
            saturated_percent=share,
        )
        images = replace(images, clips_at=level, notices=(*images.notices, notice))
    images.check(0, first)
    colours = mosaic_contrast(first)
    if colours:
        notice = Notice(COLOUR_MOSAIC, images.names[0], contrast_percent=100.0 * colours)
        images = replace(images, notices=(*images.notices, notice))
    return images


def _levelled(tiles: FloatArray) -> FloatArray:
    """Return tiles (N, S, S) without their mean and slopes."""
    ramp = np.arange(tiles.shape[1]) - 0.5 * (tiles.shape[1] - 1)
    left = tiles - tiles.mean(axis=(1, 2), keepdims=True)
    scale = 1.0 / (len(ramp) * np.sum(ramp**2))
    down, across = (scale * np.einsum(f"nij,{axis}->n", left, ramp) for axis in "ij")
    return np.asarray(left - down[:, None, None] * ramp[:, None] - across[:, None, None] * ramp)
