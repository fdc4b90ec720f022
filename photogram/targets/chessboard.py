"""Chessboards, and the view of any lattice of squares: corners measured and checked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.targets.crossing import FAINT, GOOD, OUTSIDE, REASONS, CameraResponse, find_sharpening, refine_corners
from photogram.targets.target_view import (
    Target,
    TargetNotFound,
    TargetView,
    check_blur,
    check_exposure,
    estimate_image_noise,
    image_fault,
    outline,
    refuse_second,
)
from shakercal._common.arrays import FloatArray, IntArray

_LEAST_CONTRAST = 0.4  # of a corner, in units of the median over the target
_MARGIN = 0.75  # squares around the outermost corners that belong to the target's area
_FEWEST = 6  # corners of a view, for a homography with a check
_FEWEST_SIDE = 3  # corners along a side of a part of a board
_STRIP = 0.08  # of a square, along the edges of squares with markers, at first
_CLEAR, _NARROWEST, _WIDEST = 0.15, 0.05, 0.12  # the same later: the first less 2σ of the blur, between the others


def corner_view(
    image: NDArray[Any],
    target: Target,
    index: IntArray,
    start_px: FloatArray,
    axes_px: FloatArray,
    name: str,
    full_scale: float,
) -> TargetView:
    """Return the view of the corners `index` (N, 2) of `target` near start_px (N, 2).

    axes_px: the squares' sides. The corners are fitted twice: the second time with the edges' curvature from the first
    fit. A corner counts if it has the colours of its position in the lattice and at least 0.4 of the usual contrast.
    Where bright squares contain markers only a strip along the edges is used, the narrower the softer they are. Raises
    `TargetNotFound` for a bad exposure, a blur, or where fewer than 6 corners, or all on one line, remain.
    """
    assert target.size is not None
    markers, total = target.kind == "charuco", target.points or 0
    across = [a * axes_px[:, 0] + b * axes_px[:, 1] for a in (-1, 1) for b in (-1, 1)]
    area = outline(np.concatenate([start_px + _MARGIN * diagonal for diagonal in across]))
    check_exposure(image, area, full_scale)
    left, top = np.maximum(np.floor(area.min(axis=0)), 0).astype(int)
    right, bottom = np.ceil(area.max(axis=0)).astype(int) + 1
    strip = _STRIP if markers else np.inf
    response = CameraResponse(estimate_image_noise(image[top:bottom, left:right], full_scale), full_scale)
    response = find_sharpening(image, start_px, axes_px, response, strip)
    first = refine_corners(image, start_px, axes_px, response, strip=strip)
    good = first.status == GOOD
    if good.sum() < _FEWEST:
        raise TargetNotFound(_measured(first.status, total))
    start = np.where(good[:, None], first.position_px, start_px)
    bend = lattice_bend(index, first.position_px)
    side = float(np.median(np.sqrt(np.abs(np.linalg.det(axes_px)))))
    soft = float(np.nanmedian(first.blur_px)) / side
    strip = float(np.clip(_CLEAR - 2 * soft, _NARROWEST, _WIDEST)) if markers else strip
    corners = refine_corners(image, start, axes_px, response, bend, strip, first)
    status, good = corners.status.copy(), corners.status == GOOD
    if good.any():
        check_blur(float(np.median(corners.blur_px[good])), side)
        contrast = np.where(index.sum(axis=1) % 2 == 0, 1.0, -1.0) * corners.half_contrast
        status[good & ~(contrast / np.median(contrast[good]) > _LEAST_CONTRAST)] = FAINT
        good = status == GOOD
    if good.sum() < _FEWEST:
        raise TargetNotFound(_measured(status, total))
    if np.linalg.matrix_rank(index[good] - index[good].mean(axis=0)) < 2:
        raise TargetNotFound(f"{_measured(status, total)}, all on one line")
    lost = int((~good & (status != OUTSIDE)).sum())
    return TargetView(
        name,
        index[good],
        corners.position_px[good],
        corners.covariance_px2[good],
        0.0,
        float(np.median(corners.blur_px[good])),
        np.array(image.shape[::-1]),
        lost,
        _measured(status, total) if lost else "",
    )


def lattice_bend(index: IntArray, position_px: FloatArray) -> FloatArray:
    """Return the curvature (N,2), 1/px, of the edges through corners index (N,2) at position_px.

    First the edge along the second lattice direction, then that along the first, positive where it turns towards the
    other direction's negative side, as `refine_corners` defines it. Second differences of neighbours, smoothed by a
    polynomial of second degree over the lattice; NaN positions are ignored.
    """
    low = index.min(axis=0)
    position = index - low
    grid = np.full((*(position.max(axis=0) + 1), 2), np.nan)
    grid[position[:, 0], position[:, 1]] = position_px
    bend = np.zeros((len(index), 2))
    for k, lattice in ((0, grid), (1, grid.swapaxes(0, 1))):
        before, middle, after = lattice[:, :-2], lattice[:, 1:-1], lattice[:, 2:]
        along = after - before
        normal = np.stack([along[..., 1], -along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1)[..., None]
        steps = (lattice[1:] - lattice[:-1]).reshape(-1, 2)
        steps = steps[np.isfinite(steps).all(axis=1)]
        across = steps.mean(axis=0) if len(steps) else np.zeros(2)
        normal *= np.sign((normal * across).sum(axis=-1, keepdims=True))
        product = np.linalg.norm(middle - before, axis=-1) * np.linalg.norm(after - middle, axis=-1)
        turn = -((after + before - 2 * middle) * normal).sum(axis=-1) / product
        at = np.argwhere(np.isfinite(turn))
        if len(at) >= 3:
            terms = 6 if len(at) >= 18 else 3 if len(at) >= 9 else 1
            powers, targets = lattice_powers(at + np.array([0, 1])), position if k == 0 else position[:, ::-1]
            solution = np.linalg.lstsq(powers[:, :terms], turn[tuple(at.T)], rcond=None)[0]
            bend[:, k] = lattice_powers(targets)[:, :terms] @ solution
    return bend


def lattice_powers(index: FloatArray | IntArray) -> FloatArray:
    """Return the powers (N,10) up to third degree of lattice points (N,2), in tens."""
    x, y = index.T / 10.0
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)


def _measured(status: IntArray, total: int) -> str:
    """Return the number of measured corners, and the reasons of missing ones, as text."""
    value, count = np.unique(status[status != GOOD], return_counts=True)
    lost = ", ".join(f"{count[k]} {REASONS[int(value[k])]}" for k in np.argsort(-count))
    return f"{int((status == GOOD).sum())} of {total} corners can be measured" + (f" (lost: {lost})" if lost else "")


# A chessboard in an image: coarse search by OpenCV, numbers of the corners, sub-pixel positions.

SEARCHED_PX = 1400  # longest side of the reduced image in which the board is searched first


def find_chessboard(
    image: NDArray[Any], target: Target, name: str, full_scale: float, partial: bool = False
) -> TargetView:
    """Return the inner corners of a chessboard that lies wholly in the image.

    If `partial`, also of a part of it, numbered from its first corner.

    Index (i, j): first index to the right, second down, so that the third axis points away from the camera, and the
    square beyond corner (0, 0) is black. Where two orientations fulfil this (columns and rows both odd or both even),
    the one is used whose first axis points to the right of the image: keep such a board upright in all images. A
    chessboard's mirror image is a chessboard; a single image cannot show the difference. Raises `TargetNotFound` with
    the fault of the image.
    """
    assert target.size is not None
    grey = eight_bit(image)
    corners = _search(grey, target.size)
    if corners is None:
        small, factor = downscale(grey, SEARCHED_PX)
        boards = _boards(small, target.size)
        for board in boards:  # the target may be another one
            corners = _search(_covered(grey, (board + 0.5) * factor - 0.5), target.size)
            if corners is not None:
                break
        else:
            reason = _reason(image, small, boards, target.size, full_scale)
            part = next((board for board in boards if partial and _is_part(board, target.size)), None)
            if part is None:
                raise TargetNotFound(reason)
            lattice = _oriented(grey, (part.swapaxes(0, 1) + 0.5) * factor - 0.5)
            index, start, axes = _located(lattice)
            index[:, 0] += 0 if _begins_black(grey, lattice) else 1
            view = corner_view(image, target, index, start, axes, name, full_scale)
            return replace(view, is_partial=True, loss_reasons=reason)
    _refuse_larger(grey, corners)
    small, factor = downscale(grey, SEARCHED_PX)
    another = _search(_covered(small, (corners + 0.5) / factor - 0.5), target.size)
    if another is not None and _is_board(small, another):
        refuse_second(f"a chessboard of {target.size[0]} x {target.size[1]} inner corners")
    return corner_view(image, target, *_located(_oriented(grey, corners)), name, full_scale)


def _located(lattice: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return index, position (N, 2) and sides (N, 2, 2) of corners (I, J, 2)."""
    index = np.stack(np.meshgrid(*[np.arange(n) for n in lattice.shape[:2]], indexing="ij"), axis=-1)
    return index.reshape(-1, 2), lattice.reshape(-1, 2), _axes(lattice).reshape(-1, 2, 2)


def _is_part(board: FloatArray, size: tuple[int, int]) -> bool:
    """Return whether a lattice (rows, columns, 2) may be a part of the board."""
    short, long = sorted(board.shape[:2])
    fits = _FEWEST_SIDE <= short <= min(size) and long <= max(size)
    return bool(fits and short * long < size[0] * size[1])


def eight_bit(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the image scaled to 8 bits, except the outer thousandths."""
    low, high = np.percentile(image[::4, ::4], [0.1, 99.9])
    spread = (np.arange(int(image.max()) + 1) - low) * (255 / max(high - low, 1e-6))
    return np.asarray(np.clip(np.rint(spread), 0, 255).astype(np.uint8)[image])


def downscale(grey: NDArray[np.uint8], longest_px: int) -> tuple[NDArray[np.uint8], int]:
    """Return an image reduced by an integer factor to at most `longest_px`, and the factor."""
    import cv2

    factor = -(-max(grey.shape) // longest_px)
    if factor == 1:
        return grey, 1
    height, width = (n // factor for n in grey.shape)
    part = grey[: height * factor, : width * factor]
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8), factor


def _search(grey: NDArray[np.uint8], size: tuple[int, int]) -> FloatArray | None:
    """Return the corners (columns, rows, 2) that OpenCV finds, in a smaller image first."""
    import cv2

    small, factor = downscale(grey, SEARCHED_PX)
    for searched, scale in ((small, factor), (grey, 1)) if factor > 1 else ((grey, 1),):
        found, corners = cv2.findChessboardCornersSB(searched, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if found:
            position = (np.asarray(corners, dtype=np.float64).reshape(size[1], size[0], 2) + 0.5) * scale - 0.5
            return position.swapaxes(0, 1)
    return None


def _axes(lattice: FloatArray) -> FloatArray:
    """Return the sides (I,J,2,2) of the squares of a lattice of corners (I,J,2)."""
    return np.stack([np.gradient(lattice, axis=0), np.gradient(lattice, axis=1)], axis=2)


def _quadrants(grey: NDArray[np.uint8], corners: FloatArray, axes: FloatArray, share: float = 0.3) -> FloatArray:
    """Return the grey values (...,4) of squares −−, ++, +−, −+ around corners (...,2).

    NaN outside the image. `share`: of a square's sides, between the corner and the point that is read.
    """
    offsets = np.array([[-1, -1], [1, 1], [1, -1], [-1, 1]]) * share
    points = corners[..., None, :] + offsets @ axes
    column, row = np.rint(points[..., 0]).astype(int), np.rint(points[..., 1]).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < grey.shape[1]) & (row < grey.shape[0])
    value = grey[np.clip(row, 0, grey.shape[0] - 1), np.clip(column, 0, grey.shape[1] - 1)]
    return np.where(inside, value, np.nan)


def _saddle(quadrants: FloatArray) -> FloatArray:
    """Return the brightness gap between two pairs of opposite squares.

    Darker square of the brighter pair minus brighter square of the other.
    """
    equal, unequal = quadrants[..., :2], quadrants[..., 2:]
    return np.asarray(np.maximum(equal.min(-1) - unequal.max(-1), unequal.min(-1) - equal.max(-1)))


def _refuse_larger(grey: NDArray[np.uint8], corners: FloatArray) -> None:
    """Raise `TargetNotFound` where the lattice of corners continues beyond one of its sides."""
    axes = _axes(corners)
    saddles = _saddle(_quadrants(grey, corners, axes))
    usual = float(np.median(saddles[np.isfinite(saddles)])) if np.isfinite(saddles).any() else 0.0
    for side in range(4):
        rotated, rotated_axes = np.rot90(corners, side), np.rot90(axes, side)
        beyond = 3 * rotated[0] - 3 * rotated[1] + rotated[2] if len(rotated) > 2 else 2 * rotated[0] - rotated[1]
        strength = _saddle(_quadrants(grey, beyond, rotated_axes[0]))
        if float(np.median(np.nan_to_num(strength))) > 0.5 * usual:
            columns, rows = corners.shape[:2]
            raise TargetNotFound(f"another target: a chessboard of more than {columns} x {rows} inner corners")


def _oriented(grey: NDArray[np.uint8], corners: FloatArray) -> FloatArray:
    """Return the lattice (columns,rows,2) rotated to be right-handed and begin at a black square."""
    columns, rows = corners.shape[:2]
    along, down = corners[-1, 0] - corners[0, 0], corners[0, -1] - corners[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        corners = corners[::-1]
    turns = range(4) if columns == rows else (0, 2)
    candidates = [np.rot90(corners, turn) for turn in turns]

    def rightward(lattice: FloatArray) -> float:
        along = lattice[-1].mean(axis=0) - lattice[0].mean(axis=0)
        return float(along[0] / np.linalg.norm(along))

    black = [lattice for lattice in candidates if _begins_black(grey, lattice)]
    return max(black or candidates, key=rightward)


def _begins_black(grey: NDArray[np.uint8], lattice: FloatArray) -> bool:
    """Return whether the square beyond corner (0, 0) and those of its colour are dark."""
    quadrants = _quadrants(grey, lattice, _axes(lattice))
    brighter = np.nan_to_num(quadrants[..., :2].sum(-1) - quadrants[..., 2:].sum(-1))
    parity = np.indices(lattice.shape[:2]).sum(axis=0) % 2
    return bool((brighter * np.where(parity == 0, 1, -1)).sum() < 0)


def _boards(small: NDArray[np.uint8], size: tuple[int, int]) -> list[FloatArray]:
    """Return the corners (rows, columns, 2) of chessboards of any size, the largest first."""
    import cv2

    lattices = []
    for less in (1, 2, 4, max(size)):  # smaller lattices, which OpenCV extends
        seed = (max(size[0] - less, 3), max(size[1] - less, 3))
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(small, seed, flags=flags)
        if found:
            lattices.append(np.asarray(corners, dtype=np.float64).reshape(*np.asarray(meta).shape[:2], 2))
    return sorted((one for one in lattices if _is_board(small, one)), key=lambda lattice: -lattice.size)


def _covered(grey: NDArray[np.uint8], board: FloatArray) -> NDArray[np.uint8]:
    """Return the image with the squares around a board's corners (I, J, 2) painted over."""
    import cv2

    axes, covered = _axes(board), grey.copy()
    around = [board + a * axes[..., 0, :] + b * axes[..., 1, :] for a in (-1, 1) for b in (-1, 1)]
    hull = outline(np.concatenate(around).reshape(-1, 2))
    cv2.fillPoly(covered, [np.rint(hull).astype(np.int32)], float(np.median(grey)))
    return covered


def _reason(
    image: NDArray[Any],
    small: NDArray[np.uint8],
    boards: list[FloatArray],
    size: tuple[int, int],
    full_scale: float,
) -> str:
    """Return the fault of an image in which only `boards` of other sizes were found."""
    fault = image_fault(image, full_scale)
    if fault is not None:
        return fault
    expected = f"{size[0]} x {size[1]}"
    if not boards:
        return f"no chessboard of {expected} inner corners"
    lattice = boards[0]
    rows, columns = lattice.shape[:2]
    seen = f"{max(rows, columns)} x {min(rows, columns)}"
    sides = [np.rot90(lattice, turn) for turn in range(4)]
    beyond = np.concatenate([side[0] + 1.5 * (side[0] - side[1]) for side in sides])
    if ((beyond < 0) | (beyond > [small.shape[1] - 1, small.shape[0] - 1])).any():
        return (
            f"extends beyond the edge of the image: {seen} of {expected} inner corners are visible, whose numbers are "
            "certain only if the other camera sees the whole board, or with markers (charuco, aprilgrid)"
        )
    return f"another target, or one partly covered: a chessboard of {seen} inner corners, expected {expected}"


def _is_board(grey: NDArray[np.uint8], lattice: FloatArray) -> bool:
    """Return whether the squares around corners are evenly dark and bright, unlike speckles and dots."""
    axes = _axes(lattice)
    saddles = [_saddle(_quadrants(grey, lattice, axes, share)).ravel() for share in (0.15, 0.3, 0.45)]
    seen = [saddle[np.isfinite(saddle)] for saddle in saddles]
    if min(map(len, seen)) == 0:
        return False
    usual = max(float(np.median(saddle)) for saddle in seen)
    return usual > 0 and all(float(np.quantile(saddle, 0.2)) > 0.3 * usual for saddle in seen)
