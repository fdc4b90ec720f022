"""Sub-pixel positions of chessboard corners, by least squares to the crossing of two blurred edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray, IntArray, check_shape
from photogram.noise import QUANTISATION, NoiseModel
from photogram.target.crossing import GOOD, NO_CROSSING, OUTSIDE, SATURATED, fit_crossings

REASONS = {
    GOOD: "found",
    OUTSIDE: "too close to the picture's edge",
    SATURATED: "overexposed",
    NO_CROSSING: "no crossing of two edges",
}
_WINDOW = 0.55  # of a square's side, to either side of the corner
_WIDEST_PX = 14.0  # the same, in px: beyond it edges hardly add what their curvature takes
_APERTURE = 1.0 / 12.0  # variance of a pixel's width, part of the fitted blur
_SATURATED = 0.995  # of full scale
_MOST_SATURATED = 0.02  # share of a window
_LEAST_SIGNAL = 4.0  # half contrast in standard deviations of the noise


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners found: position_px (N, 2), covariance_px2 (N, 2, 2), NaN where `status` (N,) is not 0 (see `REASONS`).

    `blur_px` (N,): σ of the edges without the pixels' own width. `half_contrast` (N,): half the difference of the
    quadrants in grey values, positive where those between axes of equal sign are bright. `misfit` (N,): reduced χ²
    of the grey values: 1 where the model holds to within the noise.
    """

    position_px: FloatArray
    covariance_px2: FloatArray
    blur_px: FloatArray
    half_contrast: FloatArray
    misfit: FloatArray
    status: IntArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        check_shape("position_px", self.position_px, (None, 2))
        count = len(self.position_px)
        check_shape("covariance_px2", self.covariance_px2, (count, 2, 2))
        for name in ("blur_px", "half_contrast", "misfit", "status"):
            check_shape(name, getattr(self, name), (count,))


def refine_corners(
    image: NDArray[Any],
    start_px: FloatArray,
    axes_px: FloatArray,
    noise: NoiseModel,
    full_scale: float,
    bend_per_px: FloatArray | None = None,
    strip: float = np.inf,
) -> Corners:
    """Return the corners of squares near start_px (N, 2) in a picture (H, W).

    axes_px (N, 2, 2): a square's sides from the corner, in px, along the first and the second lattice direction. The
    grey values around a corner are fitted by (1 + g·r)·(a + b·erf(d₁/√2σ₁)·erf(d₂/√2σ₂)), d₁ and d₂ the distances from
    two lines of free direction, weighted by the noise: whatever blurs the picture, the crossing of two straight edges
    is point-symmetric about the corner but for the light's slope g, so that an imperfect edge profile moves nothing.
    Edges that the lens bends are not: bend_per_px (N, 2), the curvature of the edges along the second and the first
    direction, is taken as known (`lattice_bend`). The window ends 0.55 squares or 14 px from the corner; `strip`: in
    bright squares only pixels within so many squares of an edge count, the less the farther (ChArUco: the markers lie
    beyond).

    The covariance is that of the weighted fit for the given noise, the other parameters unknown.
    """
    check_shape("start_px", start_px, (None, 2))
    count = len(start_px)
    check_shape("axes_px", axes_px, (count, 2, 2))
    bend = np.zeros((count, 2)) if bend_per_px is None else bend_per_px
    check_shape("bend_per_px", bend, (count, 2))
    grey = np.ascontiguousarray(image, dtype=np.float32)
    side = np.linalg.norm(axes_px, axis=2).max(axis=1)
    window = np.zeros((count, 3))
    window[:, 0] = np.minimum(_WINDOW, _WIDEST_PX / side)
    window[:, 1] = strip
    window[:, 2] = _bright_quadrants(grey, start_px, axes_px) if np.isfinite(strip) else 0.0
    variance = np.array([noise.read_variance_grey2, noise.variance_per_grey, QUANTISATION])
    fitted = np.empty((count, 16))
    fit_crossings(grey, start_px, axes_px, bend, window, variance, _SATURATED * full_scale, fitted)
    return _corners(fitted, noise)


def _bright_quadrants(grey: NDArray[np.float32], start_px: FloatArray, axes_px: FloatArray) -> FloatArray:
    """Return +1 (N,) where the quadrants between axes of equal sign are the brighter ones near the corner, else −1."""
    from scipy.ndimage import map_coordinates

    place = np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]]) * 0.08
    points = start_px[:, None, :] + place @ axes_px
    values = map_coordinates(grey, points.reshape(-1, 2).T[::-1], order=1, mode="nearest").reshape(-1, 4)
    return np.where(values[:, :2].sum(axis=1) > values[:, 2:].sum(axis=1), 1.0, -1.0)


def _corners(fitted: FloatArray, noise: NoiseModel) -> Corners:
    """Return the fits as `Corners`, failed ones as NaN."""
    status = fitted[:, 15].astype(np.int64)
    status[(status != OUTSIDE) & (fitted[:, 14] > _MOST_SATURATED)] = SATURATED
    sigma = np.sqrt(noise.variance(fitted[:, 4]))
    status[(status == GOOD) & ~(np.abs(fitted[:, 5]) > _LEAST_SIGNAL * sigma)] = NO_CROSSING
    good = status == GOOD
    blur = np.sqrt(np.maximum(0.5 * (fitted[:, 8] ** 2 + fitted[:, 9] ** 2) - _APERTURE, 0.0))
    covariance = fitted[:, [10, 11, 11, 12]].reshape(-1, 2, 2)
    return Corners(
        np.where(good[:, None], fitted[:, :2], np.nan),
        np.where(good[:, None, None], covariance, np.nan),
        np.where(good, blur, np.nan),
        np.where(good, fitted[:, 5], np.nan),
        np.where(good, fitted[:, 13], np.nan),
        status,
    )
