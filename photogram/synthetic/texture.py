"""Textures of a face: reflectance as a cubic B-spline on a grid much finer than the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photogram._checks import FloatArray, check_shape
from photogram._kernel import njit

_CELL = 1.15  # spacing of the speckle grid in speckle diameters: dots cover about half of the face
_SHIFT = 0.35  # largest random shift of a dot in cells


@dataclass(frozen=True, eq=False)
class Texture:
    """Reflectance over a face: cubic B-spline coefficients (rows, columns) at grid points `step_m` apart.

    `coefficients[i, j]` belongs to the face coordinates (u, v) = `origin_m` (2,) + `step_m`·(j, i), in m.
    """

    coefficients: NDArray[np.float32]
    origin_m: FloatArray
    step_m: float

    def __post_init__(self) -> None:
        """Refuse wrong shapes, and grids too small for a cubic spline."""
        check_shape("coefficients", self.coefficients, (None, None))
        check_shape("origin_m", self.origin_m, (2,))
        if min(self.coefficients.shape) < 4:
            raise ValueError(f"coefficients: expected at least 4 x 4, found {self.coefficients.shape}")


def texture_from_samples(samples: NDArray[np.floating], step_m: float, blur_m: float = 0.0) -> Texture:
    """Return the texture that passes through reflectance samples (rows, columns), centred on the face's origin.

    `blur_m` is the σ of a Gaussian taken over the samples first: what the lens does to a face at this distance.
    """
    smooth = np.asarray(samples, dtype=np.float64)
    if blur_m > 0:
        smooth = ndimage.gaussian_filter(smooth, blur_m / step_m, mode="nearest")
    coefficients = ndimage.spline_filter(smooth, order=3, output=np.float64, mode="mirror")
    rows, columns = smooth.shape
    origin = -0.5 * step_m * np.array([columns - 1, rows - 1], dtype=np.float64)
    return Texture(coefficients.astype(np.float32), origin, step_m)


def speckle_texture(
    size_m: tuple[float, float], diameter_m: float, step_m: float, blur_m: float, rng: np.random.Generator
) -> Texture:
    """Return dark dots on a bright ground over a face of `size_m` (width along u, height along v).

    Dots of diameter `diameter_m` ± 15 % on a grid 1.15 diameters wide, each shifted at random by up to 0.35 of it:
    about half of the face is dark, without order at long range. Reflectance runs from 0 to 1.
    """
    columns, rows = (int(np.ceil(length / step_m)) + 1 for length in size_m)
    cell = _CELL * diameter_m / step_m
    across, down = int(columns / cell) + 2, int(rows / cell) + 2
    shift = rng.uniform(-_SHIFT, _SHIFT, (2, down, across))
    radius = 0.5 * diameter_m / step_m * (1 + 0.15 * rng.uniform(-1, 1, (down, across)))
    x = (np.arange(across) + shift[0]) * cell
    y = (np.arange(down)[:, None] + shift[1]) * cell
    samples = np.ones((rows, columns))
    _paint_dots(samples, x.ravel(), y.ravel(), radius.ravel())
    return texture_from_samples(samples, step_m, blur_m)


@njit()
def _paint_dots(samples: FloatArray, x: FloatArray, y: FloatArray, radius: FloatArray) -> None:
    """Darken discs in place; their rims are one grid step soft."""
    rows, columns = samples.shape
    for k in range(x.size):
        reach = radius[k] + 1.0
        for i in range(max(0, int(y[k] - reach)), min(rows, int(y[k] + reach) + 2)):
            for j in range(max(0, int(x[k] - reach)), min(columns, int(x[k] + reach) + 2)):
                inside = radius[k] + 0.5 - np.hypot(j - x[k], i - y[k])
                samples[i, j] = min(samples[i, j], 1.0 - min(max(inside, 0.0), 1.0))


@njit()
def spline_value(coefficients: NDArray[np.float32], x: float, y: float) -> float:
    """Return the cubic B-spline at column x and row y of the grid; outside, the outermost cell is continued."""
    rows, columns = coefficients.shape
    x = min(max(x, 1.0), columns - 2.000001)
    y = min(max(y, 1.0), rows - 2.000001)
    j, i = int(x), int(y)
    tx, ty = x - j, y - i
    sx, sy = 1.0 - tx, 1.0 - ty
    a0, a3 = sx * sx * sx / 6.0, tx * tx * tx / 6.0
    a1, a2 = 2.0 / 3.0 - 0.5 * tx * tx * (2.0 - tx), 2.0 / 3.0 - 0.5 * sx * sx * (2.0 - sx)
    b0, b3 = sy * sy * sy / 6.0, ty * ty * ty / 6.0
    b1, b2 = 2.0 / 3.0 - 0.5 * ty * ty * (2.0 - ty), 2.0 / 3.0 - 0.5 * sy * sy * (2.0 - sy)
    c = coefficients
    value: float = (
        b0 * (a0 * c[i - 1, j - 1] + a1 * c[i - 1, j] + a2 * c[i - 1, j + 1] + a3 * c[i - 1, j + 2])
        + b1 * (a0 * c[i, j - 1] + a1 * c[i, j] + a2 * c[i, j + 1] + a3 * c[i, j + 2])
        + b2 * (a0 * c[i + 1, j - 1] + a1 * c[i + 1, j] + a2 * c[i + 1, j + 1] + a3 * c[i + 1, j + 2])
        + b3 * (a0 * c[i + 2, j - 1] + a1 * c[i + 2, j] + a2 * c[i + 2, j + 1] + a3 * c[i + 2, j + 2])
    )
    return value
