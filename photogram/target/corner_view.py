"""From where corners of a lattice of squares are expected to the view of a target: measured, checked, judged."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram._checks import BoolArray, FloatArray, IntArray
from photogram.target.corners import REASONS, Corners, refine_corners
from photogram.target.crossing import GOOD
from photogram.target.picture import check_blur, check_exposure, outline, picture_noise
from photogram.target.view import TargetNotFound, TargetView

_LEAST_CONTRAST = 0.4  # of a corner, in units of the median over the target
_ROOM = 0.75  # squares around the outermost corners that belong to the target's area
_FEWEST = 6
_STRIP = 0.08  # of a square, along the edges of squares with markers, at first
_CLEAR, _NARROWEST, _WIDEST = 0.15, 0.05, 0.12  # the same later: the first less 2σ of the blur, between the others


def corner_view(
    image: NDArray[Any],
    index: IntArray,
    start_px: FloatArray,
    axes_px: FloatArray,
    name: str,
    full_scale: float,
    markers: bool = False,
) -> TargetView:
    """Return the view of the corners `index` (N, 2) that are expected at start_px (N, 2), squares' sides axes_px.

    The corners are fitted twice: the second time with the curvature of the edges that the first found. A corner counts
    if it has the colours of its place in the lattice and at least 0.4 of the usual contrast.
    `markers`: the bright squares hold some, and only a strip along the edges is used, the narrower the softer they are.
    Raises `TargetNotFound` for a bad exposure, a blur, or where fewer than 6 corners, or all on one line, remain.
    """
    area = outline(np.concatenate([start_px + _ROOM * side for side in _diagonals(axes_px)]))
    check_exposure(image, area, full_scale)
    noise = picture_noise(_cut(image, area))
    first = refine_corners(image, start_px, axes_px, noise, full_scale, strip=_STRIP if markers else np.inf)
    good = first.status == GOOD
    if good.sum() < _FEWEST:
        raise TargetNotFound(_few(first.status, good))
    start = np.where(good[:, None], first.position_px, start_px)
    bend = lattice_bend(index, first.position_px)
    side = float(np.median(np.sqrt(np.abs(np.linalg.det(axes_px)))))
    soft = float(np.nanmedian(first.blur_px)) / side
    strip = float(np.clip(_CLEAR - 2 * soft, _NARROWEST, _WIDEST)) if markers else np.inf
    corners = refine_corners(image, start, axes_px, noise, full_scale, bend, strip)
    check_blur(float(np.nanmedian(corners.blur_px)), side)
    good = _belongs(index, corners)
    if good.sum() < _FEWEST or _on_a_line(index[good]):
        raise TargetNotFound(_few(corners.status, good))
    return TargetView(
        name,
        index[good],
        corners.position_px[good],
        corners.covariance_px2[good],
        0.0,
        float(np.median(corners.blur_px[good])),
        np.array(image.shape[::-1]),
    )


def lattice_bend(index: IntArray, position_px: FloatArray) -> FloatArray:
    """Return the curvature (N, 2), 1/px, of the edges through corners index (N, 2) at position_px (N, 2).

    First the edge along the second lattice direction, then that along the first, positive where it turns towards the
    other direction's negative side, as `refine_corners` takes it. Second differences of neighbours, smoothed by a
    polynomial of second degree over the lattice; NaN positions are left out.
    """
    low = index.min(axis=0)
    place = index - low
    grid = np.full((*(place.max(axis=0) + 1), 2), np.nan)
    grid[place[:, 0], place[:, 1]] = position_px
    bend = np.zeros((len(index), 2))
    for k, lattice in ((0, grid), (1, grid.swapaxes(0, 1))):
        before, middle, after = lattice[:, :-2], lattice[:, 1:-1], lattice[:, 2:]
        along = (after - before) / 2
        length = np.linalg.norm(along, axis=-1)
        normal = np.stack([along[..., 1], -along[..., 0]], axis=-1) / length[..., None]
        across = np.nanmean(lattice[1:] - lattice[:-1], axis=(0, 1))
        normal *= np.sign((normal * across).sum(axis=-1, keepdims=True))
        turn = -((after + before - 2 * middle) * normal).sum(axis=-1) / length**2
        at = np.argwhere(np.isfinite(turn))
        wanted = place if k == 0 else place[:, ::-1]
        bend[:, k] = _smooth(at + np.array([0, 1]), turn[tuple(at.T)], wanted)
    return bend


def _smooth(at: IntArray, value: FloatArray, wanted: IntArray) -> FloatArray:
    """Return a polynomial through values (M,) at lattice points (M, 2), evaluated at `wanted` (N, 2)."""
    if len(value) < 3:
        return np.zeros(len(wanted))
    terms = 6 if len(value) >= 18 else 3 if len(value) >= 9 else 1
    solution = np.linalg.lstsq(_powers(at)[:, :terms], value, rcond=None)[0]
    return np.asarray(_powers(wanted)[:, :terms] @ solution)


def _powers(at: IntArray) -> FloatArray:
    """Return 1, x, y, x², xy, y² (N, 6) of lattice points."""
    x, y = at.T / 10.0
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _diagonals(axes_px: FloatArray) -> list[FloatArray]:
    """Return the ways (N, 2) from each corner across the four squares around it."""
    return [a * axes_px[:, 0] + b * axes_px[:, 1] for a in (-1, 1) for b in (-1, 1)]


def _cut(image: NDArray[Any], area: FloatArray) -> NDArray[Any]:
    """Return the rectangle of the picture around a polygon."""
    left, top = np.maximum(np.floor(area.min(axis=0)), 0).astype(int)
    right, bottom = np.ceil(area.max(axis=0)).astype(int) + 1
    return image[top:bottom, left:right]


def _belongs(index: IntArray, corners: Corners) -> BoolArray:
    """Return which corners were found with the colours and the contrast that they ought to have."""
    good = corners.status == GOOD
    contrast = np.where((index.sum(axis=1) % 2 == 0), 1.0, -1.0) * corners.half_contrast
    usual = float(np.median(contrast[good]))
    return np.asarray(good & (contrast / usual > _LEAST_CONTRAST))


def _on_a_line(index: IntArray) -> bool:
    """Return whether lattice points (N, 2) lie on one line."""
    return bool(np.linalg.matrix_rank(index - index.mean(axis=0)) < 2)


def _few(status: IntArray, good: BoolArray) -> str:
    """Return why too few corners are left."""
    lost = status[status != GOOD]
    reason = f", most others are lost: {REASONS[int(np.bincount(lost).argmax())]}" if len(lost) else ""
    return f"only {int(good.sum())} of {len(status)} corners can be measured{reason}"
