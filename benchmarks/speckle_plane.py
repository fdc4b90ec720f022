"""A speckled plane whose images need no interpolation: isotropic Gaussian dots, integrated exactly over square pixels.

Turned and shifted, the dots stay isotropic Gaussians, so the image of the moved plane is as exact as the first. The
texture's power density falls as exp(−(2πfσ)²): for dots 4.5 px wide at half height (σ = 1.91 px) it is 10⁻¹⁰ of the
largest at 0.4 cycles per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, log, pi, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
CELL = 1.4
LARGEST_SHIFT = 0.3
REACH_SIGMA = 6.5
MIDDLE, DEPTH = 0.5, 0.27
DIFFERENCE_PX = 1e-3


@dataclass(frozen=True)
class Plane:
    """Dots of standard deviation sigma_px, before an image of size_px (width, height).

    centre_px (M,2): where they are at rest; depth (M,): what they add to the grey value there, in full scales.
    """

    centre_px: FloatArray
    depth: FloatArray
    sigma_px: float
    size_px: tuple[int, int]


@dataclass(frozen=True)
class Motion:
    """What the frames (F) see: points turn by angle_rad (F,) about pivot_px (2,), then move by shift_px (F,2)."""

    shift_px: FloatArray
    angle_rad: FloatArray
    pivot_px: FloatArray

    def __len__(self) -> int:
        return len(self.angle_rad)

    def positions(self, points_px: FloatArray, frame: int) -> FloatArray:
        """Positions (N,2) of the points (N,2) in one frame."""
        cosine, sine = np.cos(self.angle_rad[frame]), np.sin(self.angle_rad[frame])
        turn = np.array([[cosine, -sine], [sine, cosine]])
        moved: FloatArray = (points_px - self.pivot_px) @ turn.T + self.pivot_px + self.shift_px[frame]
        return moved


def speckled_plane(size_px: tuple[int, int], dot_px: float, margin_px: float, rng: np.random.Generator) -> Plane:
    """Bright and dark dots at random, `dot_px` wide at half height, one to each cell of 1.4 times that.

    A dot lies up to 0.3 cells off the middle of its cell in x and y; depths lie between 0.8 and 1 times the largest,
    which leaves no pixel at either end of the scale. The cells reach `margin_px` beyond the image, so that the plane
    may move by as much.
    """
    cell = CELL * dot_px
    x, y = np.meshgrid(*(np.arange(-margin_px, length + margin_px, cell) for length in size_px))
    grid = np.column_stack([x.ravel(), y.ravel()])
    centre = grid + cell * LARGEST_SHIFT * rng.uniform(-1.0, 1.0, grid.shape)
    depth = DEPTH * rng.uniform(0.8, 1.0, len(grid)) * rng.choice([-1.0, 1.0], len(grid))
    return Plane(centre, depth, dot_px / sqrt(8.0 * log(2.0)), size_px)


def render(plane: Plane, motion: Motion, frame: int) -> FloatArray:
    """Noise-free image (H,W) of one frame, in full scales."""
    width, height = plane.size_px
    image = np.full((height, width), MIDDLE)
    _paint(motion.positions(plane.centre_px, frame), plane.depth, plane.sigma_px, image)
    return image


def gradients(plane: Plane) -> FloatArray:
    """Slopes (2,H,W) along x and y of the resting image, in full scales per pixel, from images 0.002 px apart."""
    shift = DIFFERENCE_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    nudges = Motion(shift, np.zeros(4), np.zeros(2))
    images = [render(plane, nudges, k) for k in range(4)]
    return np.stack([images[1] - images[0], images[3] - images[2]]) / (2.0 * DIFFERENCE_PX)


@njit(cache=True)
def _profile(centre, first, sigma, mean):  # type: ignore[no-untyped-def]
    """Mean of one dot's profile exp(−t²/2σ²) over each pixel from `first` on."""
    scale = sqrt(2.0) * sigma
    for i in range(mean.size):
        left, right = (first + i - 0.5 - centre) / scale, (first + i + 0.5 - centre) / scale
        mean[i] = 0.5 * sqrt(pi) * scale * (erf(right) - erf(left))


@njit(cache=True)
def _paint(centres, depths, sigma, image):  # type: ignore[no-untyped-def]
    """Add every dot to the image."""
    height, width = image.shape
    reach = int(REACH_SIGMA * sigma) + 1
    across, down = np.empty(2 * reach + 1), np.empty(2 * reach + 1)
    for k in range(depths.size):
        column, row = round(centres[k, 0]) - reach, round(centres[k, 1]) - reach
        _profile(centres[k, 0], column, sigma, across)
        _profile(centres[k, 1], row, sigma, down)
        for i in range(max(0, -row), min(2 * reach + 1, height - row)):
            for j in range(max(0, -column), min(2 * reach + 1, width - column)):
                image[row + i, column + j] += depths[k] * down[i] * across[j]
