"""Whether a picture of a target is good enough to measure in: exposure, contrast, blur, and its noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram._checks import BoolArray, FloatArray, check_shape
from photogram.noise import NoiseModel, fit_noise_model
from photogram.target.view import TargetNotFound

_SATURATED = 0.995  # of full scale: what counts as saturated
_MOST_SATURATED = 0.1  # share of the target's pixels that may be saturated
_LEAST_CONTRAST = 0.02  # between bright and dark, of full scale
_LEAST_SIGNAL = 8.0  # the same, in standard deviations of the noise
_BLUR_PX, _BLUR_CELL = 2.6, 0.12  # blur σ that always passes, in px, and in units of the target's cells
_FLAT = 0.02  # gradient per px, of the picture's contrast, below which a pixel counts as flat


def check_exposure(image: NDArray[Any], area: NDArray[Any], full_scale: float) -> None:
    """Raise `TargetNotFound` for a target too bright or without contrast; `area`: polygon (P, 2) px or mask (H, W).

    Overexposed: more than a tenth of its pixels reach full scale. Underexposed: the range between the 5th and the
    95th percentile is below 2 % of full scale.
    """
    grey = image[_mask(image, area)]
    if grey.size == 0:
        raise ValueError("area: expected a part of the picture, found none of its pixels")
    saturated = float((grey >= _SATURATED * full_scale).mean())
    if saturated > _MOST_SATURATED:
        raise TargetNotFound(f"overexposed: {100 * saturated:.0f} % of the target's pixels reach full scale")
    low, high = np.percentile(grey, [5, 95])
    if high - low < _LEAST_CONTRAST * full_scale:
        share = 100 * (high - low) / full_scale
        raise TargetNotFound(f"underexposed: bright and dark differ by {share:.1f} % of full scale")


def check_blur(blur_px: float, cell_px: float) -> None:
    """Raise `TargetNotFound` for edges blurred by σ = `blur_px` beyond both 2.6 px and 0.12 of a cell `cell_px`.

    A cell is a square's side, or the dots' distance.
    """
    if not blur_px <= max(_BLUR_PX, _BLUR_CELL * cell_px):
        raise TargetNotFound(f"blurred: edges are soft by σ = {blur_px:.1f} px where cells measure {cell_px:.0f} px")


def picture_fault(image: NDArray[Any], full_scale: float) -> str | None:
    """Return what is wrong with a picture as a whole, as the beginning of a sentence, None for nothing obvious.

    For pictures in which no target was found: too bright, without contrast, or nowhere a sharp edge: the steepest
    gradient (99.9th percentile, at a scale of 1 px) against the range of grey levels gives the edges' σ.
    """
    from scipy.ndimage import gaussian_gradient_magnitude

    saturated = float((image >= _SATURATED * full_scale).mean())
    if saturated > 0.5:
        return f"overexposed: {100 * saturated:.0f} % of the picture's pixels reach full scale"
    low, high = np.percentile(image, [1, 99])
    if high - low < _LEAST_CONTRAST * full_scale:
        return f"underexposed: bright and dark differ by {100 * (high - low) / full_scale:.1f} % of full scale"
    steepest = float(np.percentile(gaussian_gradient_magnitude(image.astype(np.float32), 1.0), 99.9))
    sigma = float(high - low) / (np.sqrt(2 * np.pi) * max(steepest, 1e-9))
    if sigma > 1.5 * _BLUR_PX:
        return f"blurred: no edge is sharper than σ = {sigma:.1f} px"
    return None


def picture_noise(image: NDArray[Any]) -> NoiseModel:
    """Return the noise against brightness (grey²) of a picture (H, W) with flat areas, such as a target's.

    Squares of the difference operator [1 −2 1]ᵀ·[1 −2 1]/6, which sees no linear change of brightness and has the
    noise's own variance (Immerkær 1996, Computer Vision and Image Understanding 64, 300), at pixels where the gradient
    at a scale of 2 px is small.
    """
    import cv2

    check_shape("image", image, (None, None))
    grey = image.astype(np.float32)
    step = np.array([1.0, -2.0, 1.0], dtype=np.float32)
    fine = cv2.sepFilter2D(grey, cv2.CV_32F, step, step / 6)
    smooth = cv2.GaussianBlur(grey, (0, 0), 2.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125))
    low, high = np.percentile(smooth[::4, ::4], [2, 98])
    flat = slope < _FLAT * (high - low)
    flat[[0, -1]], flat[:, [0, -1]] = False, False
    if flat.sum() < 1000:
        flat = np.ones_like(flat)
    stride = max(1, int(flat.sum()) // 100_000)
    return fit_noise_model(smooth[flat][::stride].astype(np.float64), fine[flat][::stride].astype(np.float64) ** 2)


def _mask(image: NDArray[Any], area: NDArray[Any]) -> BoolArray:
    """Return the pixels (H, W) of a polygon (P, 2), or of a mask as it is."""
    if area.dtype == np.bool_:
        check_shape("area", area, image.shape)
        return area
    import cv2

    check_shape("area", area, (None, 2))
    filled = np.zeros(image.shape, dtype=np.uint8)
    cv2.fillPoly(filled, [np.rint(area).astype(np.int32)], 1)
    return np.asarray(filled > 0)


def outline(position_px: FloatArray) -> FloatArray:
    """Return the convex hull (P, 2) of points (N, 2): the area that a target's points enclose."""
    import cv2

    return np.asarray(cv2.convexHull(position_px.astype(np.float32)), dtype=np.float64).reshape(-1, 2)
