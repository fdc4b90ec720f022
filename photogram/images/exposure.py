"""What the grey values of one image show of its exposure: dark, overexposed, or without any pattern."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import FloatArray

TILE_PX = 32
FEWEST_TILE_PX = 8
LEAST_CORRELATION = 0.05
"""Of diagonal neighbours: 0.25 for speckle of 2 px, 0 ± 0.005 for the noise of 200 x 200 px."""
DARK = 0.1  # brightest pixels over full scale
BRIGHT = 0.5  # share of the pixels at the largest grey value


def without_pattern(image: NDArray[Any], full_scale: int) -> str:
    """Why an image (H,W) shows nothing but noise: "dark, …", "overexposed, …", "uniform, …"; "" for one with a pattern.

    In tiles of 32 x 32 px without their mean and slopes, diagonal neighbours of a pattern are alike, those of noise are
    not, nor those of noise that rows or columns have in common. Tiles count by their contrast, so that a small body
    before an even background is a pattern.

    >>> rng = np.random.default_rng(1)
    >>> without_pattern(rng.poisson(20.0, (240, 320)), 1023)
    'dark, 99 % of its grey values are at most 31 of 1023, nothing but noise is seen'
    """
    side = max(FEWEST_TILE_PX, min(TILE_PX, *image.shape))
    rows, columns = (length // side for length in image.shape)
    if rows * columns == 0:
        return ""
    covariance, variance = 0.0, 0.0
    for row in range(rows):  # a row of tiles at a time, which the processor's cache holds
        band = image[row * side : (row + 1) * side, : columns * side].astype(np.float64)
        tiles = _levelled(band.reshape(side, columns, side).swapaxes(0, 1))
        first, second = tiles[:, :-1, :-1], tiles[:, 1:, 1:]
        covariance += float(np.sum(first * second))
        variance += float(np.sum(first**2))
    if covariance > LEAST_CORRELATION * variance:
        return ""
    low, high = (int(value) for value in np.quantile(image, (0.01, 0.99)))
    brightest = int(image.max())
    if high < DARK * full_scale:
        return f"dark, 99 % of its grey values are at most {high} of {full_scale}, nothing but noise is seen"
    share = float(np.mean(image == brightest))
    if share > BRIGHT:
        return (
            f"overexposed, {100.0 * share:.3g} % of its pixels have the largest grey value {brightest}, nothing is seen"
        )
    return f"uniform, 98 % of its grey values are {low} to {high} of {full_scale}, nothing but noise is seen"


def _levelled(tiles: FloatArray) -> FloatArray:
    """Tiles (N,S,S) without their mean and slopes."""
    ramp = np.arange(tiles.shape[1]) - 0.5 * (tiles.shape[1] - 1)
    left = tiles - tiles.mean(axis=(1, 2), keepdims=True)
    scale = 1.0 / (len(ramp) * np.sum(ramp**2))
    down, across = (scale * np.einsum(f"nij,{axis}->n", left, ramp) for axis in "ij")
    return np.asarray(left - down[:, None, None] * ramp[:, None] - across[:, None, None] * ramp)
