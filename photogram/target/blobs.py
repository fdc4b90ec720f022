"""Connected patches of a picture that look like round dots, dark on bright and bright on dark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram._checks import BoolArray, FloatArray, check_shape

LEAST_AREA_PX = 20
EDGE_PX = 3
WINDOW_CELLS = 24
LEAST_CONTRAST = 0.15
FULL_ELLIPSE = (0.85, 1.12)
MOST_ELONGATED = 3.5
HOLE = (0.03, 0.6)
HOLE_OFF_CENTRE = 0.15


@dataclass(frozen=True, eq=False)
class Blobs:
    """N patches: `centre_px` (N, 2), `shape_px2` S (N, 2, 2) of the ellipse xᵀ S⁻¹ x = 1 that has the patch's second
    moments, `ring` (N,): has a round hole in its middle, which counts as filled.
    """  # fmt: skip

    centre_px: FloatArray
    shape_px2: FloatArray
    ring: BoolArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        check_shape("centre_px", self.centre_px, (None, 2))
        check_shape("shape_px2", self.shape_px2, (len(self.centre_px), 2, 2))
        check_shape("ring", self.ring, (len(self.centre_px),))

    @property
    def radius_px(self) -> FloatArray:
        """Radius (N,) of the circle of the same area."""
        return np.asarray(np.linalg.det(self.shape_px2) ** 0.25)


def find_blobs(image: NDArray[Any], window_px: float) -> tuple[Blobs, Blobs]:
    """Return the dark and the bright elliptic patches of an image (H, W) that lie wholly within it.

    The threshold is the mean of the grey closing and the grey opening over squares of `window_px`, which must be larger
    than the dots and than the gaps between them: it follows the lighting as long as that is smooth over such a square.
    """
    dark, bright = (_Patches.of(mask) for mask in _split(image, window_px))
    return _elliptic(dark, bright), _elliptic(bright, dark)


def _split(image: NDArray[Any], window_px: float) -> tuple[BoolArray, BoolArray]:
    """Pixels (H, W) darker and pixels brighter than the local threshold, none where there is no contrast."""
    import cv2

    height, width = image.shape
    factor = max(1, int(window_px // WINDOW_CELLS))
    grey = np.asarray(image, dtype=np.float32)
    coarse = cv2.resize(grey, (max(1, width // factor), max(1, height // factor)), interpolation=cv2.INTER_AREA)
    side = max(3, round(window_px / factor) | 1)
    square = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
    upper, lower = (cv2.morphologyEx(coarse, kind, square) for kind in (cv2.MORPH_CLOSE, cv2.MORPH_OPEN))
    contrast = upper - lower
    distinct = contrast > LEAST_CONTRAST * float(np.quantile(contrast, 0.9))
    level = cv2.resize((upper + lower) / 2, (width, height), interpolation=cv2.INTER_LINEAR)
    used = cv2.resize(distinct.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).view(np.bool_)
    smooth = cv2.blur(grey, (3, 3)) if factor > 1 else grey
    return (smooth < level) & used, (smooth > level) & used


@dataclass(frozen=True, eq=False)
class _Patches:
    """Patches that may be dots or holes: area, centre, second central moments, and boxes x0 y0 x1 y1."""

    area: FloatArray
    centre: FloatArray
    moments: FloatArray
    box: FloatArray

    @staticmethod
    def of(mask: BoolArray) -> _Patches:
        """Patches of a mask that do not touch the picture's edge and fill their box as an ellipse or a ring may."""
        import cv2

        _, found, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
        labels = np.asarray(found, dtype=np.int32)
        left, top, width, height, area = np.asarray(stats, dtype=np.float64).T
        right, bottom = left + width, top + height
        inside = (left >= EDGE_PX) & (top >= EDGE_PX)
        inside &= (right <= mask.shape[1] - EDGE_PX) & (bottom <= mask.shape[0] - EDGE_PX)
        longer, shorter = np.maximum(width, height), np.minimum(width, height)
        kept = inside & (area >= LEAST_AREA_PX / 4) & (area < mask.size / 20) & (longer <= MOST_ELONGATED * shorter + 1)
        kept &= area > 0.2 * width * height
        kept[0] = False
        centre, moments = _moments(labels, kept)
        return _Patches(area[kept], centre, moments, np.column_stack([left, top, right, bottom])[kept])


def _moments(labels: NDArray[np.int32], kept: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Centres (N, 2) and covariances (N, 2, 2) of the pixels' areas of the kept patches."""
    number = np.full(len(kept), -1, dtype=np.int32)
    number[kept] = np.arange(kept.sum(), dtype=np.int32)
    patch = number[labels.reshape(-1)]
    pixels = np.flatnonzero(patch >= 0)
    patch = patch[pixels]
    y, x = np.divmod(pixels, labels.shape[1])
    count = int(kept.sum())
    area = np.bincount(patch, minlength=count)
    centre = np.column_stack([np.bincount(patch, axis, minlength=count) / area for axis in (x, y)])
    dx, dy = x - centre[patch, 0], y - centre[patch, 1]
    xx, xy, yy = (np.bincount(patch, product, minlength=count) / area for product in (dx * dx, dx * dy, dy * dy))
    return centre, np.stack([xx + 1 / 12, xy, xy, yy + 1 / 12], axis=-1).reshape(-1, 2, 2)


def _elliptic(patches: _Patches, others: _Patches) -> Blobs:
    """The patches that fill an ellipse, a round hole in the middle included."""
    area, centre, moments, ring = _fill_holes(patches, others)
    fullness = area / np.maximum(4 * np.pi * np.sqrt(np.linalg.det(moments)), 1e-9)
    half_trace = np.trace(moments, axis1=1, axis2=2) / 2
    difference = np.sqrt(np.maximum(half_trace**2 - np.linalg.det(moments), 0.0))
    slim = half_trace + difference <= MOST_ELONGATED**2 * (half_trace - difference)
    good = slim & (fullness > FULL_ELLIPSE[0]) & (fullness < FULL_ELLIPSE[1]) & (area >= LEAST_AREA_PX)
    return Blobs(centre[good], 4 * moments[good], ring[good])


def _fill_holes(patches: _Patches, others: _Patches) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Area, centre and moments of the patches with their holes, and which have one in the middle."""
    from scipy.spatial import cKDTree

    area, centre, moments = patches.area.copy(), patches.centre.copy(), patches.moments.copy()
    ring = np.zeros(len(area), dtype=bool)
    if not len(area) or not len(others.area):
        return area, centre, moments, ring
    distance, hole = cKDTree(others.centre).query(patches.centre)
    whole = area + others.area[hole]
    share = others.area[hole] / whole
    ring = (share > HOLE[0]) & (share < HOLE[1]) & (distance < HOLE_OFF_CENTRE * np.sqrt(whole / np.pi))
    ring &= (others.box[hole][:, :2] > patches.box[:, :2]).all(1) & (others.box[hole][:, 2:] < patches.box[:, 2:]).all(
        1
    )
    own, part, from_hole = 1 - share[ring], share[ring], hole[ring]
    apart = others.centre[from_hole] - patches.centre[ring]
    centre[ring] = patches.centre[ring] + part[:, None] * apart
    spread = (own * part)[:, None, None] * apart[:, :, None] * apart[:, None, :]
    moments[ring] = own[:, None, None] * moments[ring] + part[:, None, None] * others.moments[from_hole] + spread
    area[ring] = whole[ring]
    return area, centre, moments, ring
