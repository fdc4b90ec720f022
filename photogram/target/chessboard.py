"""A chessboard in a picture: coarse search by OpenCV, which corner is which, sub-pixel positions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray
from photogram.target.corner_view import corner_view
from photogram.target.picture import picture_fault
from photogram.target.view import Target, TargetNotFound, TargetView

_SEARCHED_PX = 1400  # longest side of the picture in which the board is searched first


def find_chessboard(image: NDArray[Any], target: Target, name: str, full_scale: float) -> TargetView:
    """Return the inner corners of a chessboard that lies in the picture (H, W) as a whole.

    Index (i, j): first index to the right, second down, so that the third axis points away from the camera, and the
    square beyond corner (0, 0) is black. Where two orientations fulfil this (columns and rows both odd or both even)
    the one whose first axis points to the right of the picture is taken: hold such a board upright in all pictures.
    A chessboard's mirror image is a chessboard; no single picture tells it.
    Raises `TargetNotFound` with what is wrong with the picture.
    """
    if target.size is None:
        raise ValueError("target: expected the number of inner corners, found no size")
    grey = eight_bit(image)
    corners = _search(grey, target.size)
    if corners is None:
        raise TargetNotFound(_reason(image, grey, target.size, full_scale))
    _refuse_larger(grey, corners)
    lattice = _oriented(grey, corners)
    axes = np.stack([np.gradient(lattice, axis=0), np.gradient(lattice, axis=1)], axis=2)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in lattice.shape[:2]], indexing="ij"), axis=-1)
    return corner_view(image, index.reshape(-1, 2), lattice.reshape(-1, 2), axes.reshape(-1, 2, 2), name, full_scale)


def eight_bit(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the picture with its range of grey values, but for the outer thousandths, spread over 8 bits."""
    low, high = np.percentile(image[::4, ::4], [0.1, 99.9])
    spread = (image.astype(np.float32) - low) * (255 / max(high - low, 1e-6))
    return np.asarray(np.clip(np.rint(spread), 0, 255), dtype=np.uint8)


def reduced(grey: NDArray[np.uint8], longest_px: int) -> tuple[NDArray[np.uint8], int]:
    """Return a picture made smaller by a whole factor to at most `longest_px`, and the factor."""
    import cv2

    factor = -(-max(grey.shape) // longest_px)
    if factor == 1:
        return grey, 1
    height, width = (n // factor for n in grey.shape)
    part = grey[: height * factor, : width * factor]
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8), factor


def _search(grey: NDArray[np.uint8], size: tuple[int, int]) -> FloatArray | None:
    """Return the corners (columns, rows, 2) in px that OpenCV finds, first in a smaller picture, None for none."""
    import cv2

    small, factor = reduced(grey, _SEARCHED_PX)
    for picture, scale in ((small, factor), (grey, 1)) if factor > 1 else ((grey, 1),):
        found, corners = cv2.findChessboardCornersSB(picture, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if found:
            position = (np.asarray(corners, dtype=np.float64).reshape(size[1], size[0], 2) + 0.5) * scale - 0.5
            return position.swapaxes(0, 1)
    return None


def _quadrants(grey: NDArray[np.uint8], corners: FloatArray, axes: FloatArray) -> FloatArray:
    """Return the grey values (..., 4) of squares −−, ++, +−, −+ around corners (..., 2), NaN outside the picture."""
    place = np.array([[-1, -1], [1, 1], [1, -1], [-1, 1]]) * 0.3
    points = corners[..., None, :] + place @ axes
    column, row = np.rint(points[..., 0]).astype(int), np.rint(points[..., 1]).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < grey.shape[1]) & (row < grey.shape[0])
    value = grey[np.clip(row, 0, grey.shape[0] - 1), np.clip(column, 0, grey.shape[1] - 1)]
    return np.where(inside, value, np.nan)


def _saddle(quadrants: FloatArray) -> FloatArray:
    """Return by how much the darker of one pair of opposite squares is brighter than the brighter of the other."""
    equal, unequal = quadrants[..., :2], quadrants[..., 2:]
    return np.asarray(np.maximum(equal.min(-1) - unequal.max(-1), unequal.min(-1) - equal.max(-1)))


def _refuse_larger(grey: NDArray[np.uint8], corners: FloatArray) -> None:
    """Raise `TargetNotFound` where the lattice of corners goes on beyond one of its sides."""
    axes = np.stack([np.gradient(corners, axis=0), np.gradient(corners, axis=1)], axis=2)
    usual = float(np.nanmedian(_saddle(_quadrants(grey, corners, axes))))
    for side in range(4):
        turned, turned_axes = np.rot90(corners, side), np.rot90(axes, side)
        beyond = 3 * turned[0] - 3 * turned[1] + turned[2] if len(turned) > 2 else 2 * turned[0] - turned[1]
        strength = _saddle(_quadrants(grey, beyond, turned_axes[0]))
        if float(np.median(np.nan_to_num(strength))) > 0.5 * usual:
            columns, rows = corners.shape[:2]
            raise TargetNotFound(f"another target: a chessboard of more than {columns} x {rows} inner corners")


def _oriented(grey: NDArray[np.uint8], corners: FloatArray) -> FloatArray:
    """Return the lattice (columns, rows, 2) turned so that it is right-handed and begins at a black square."""
    columns, rows = corners.shape[:2]
    along, down = corners[-1, 0] - corners[0, 0], corners[0, -1] - corners[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        corners = corners[::-1]
    turns = range(4) if columns == rows else (0, 2)
    candidates = [np.rot90(corners, turn) for turn in turns]
    black = [lattice for lattice in candidates if _begins_black(grey, lattice)]
    return max(black or candidates, key=_rightward)


def _begins_black(grey: NDArray[np.uint8], lattice: FloatArray) -> bool:
    """Return whether the square beyond corner (0, 0) and those of its colour are the dark ones."""
    axes = np.stack([np.gradient(lattice, axis=0), np.gradient(lattice, axis=1)], axis=2)
    quadrants = _quadrants(grey, lattice, axes)
    brighter = np.nan_to_num(quadrants[..., :2].sum(-1) - quadrants[..., 2:].sum(-1))
    parity = np.add.outer(np.arange(lattice.shape[0]), np.arange(lattice.shape[1])) % 2
    return bool((brighter * np.where(parity == 0, 1, -1)).sum() < 0)


def _rightward(lattice: FloatArray) -> float:
    """Return the cosine between the first lattice direction and the picture's x axis."""
    along = lattice[-1].mean(axis=0) - lattice[0].mean(axis=0)
    return float(along[0] / np.linalg.norm(along))


def _reason(image: NDArray[Any], grey: NDArray[np.uint8], size: tuple[int, int], full_scale: float) -> str:
    """Return what is wrong with a picture in which the board was not found."""
    fault = picture_fault(image, full_scale)
    if fault is not None:
        return fault
    small, _ = reduced(grey, _SEARCHED_PX)
    wanted = f"{size[0]} x {size[1]}"
    lattice = _largest(small, size)
    if lattice is None:
        return f"no chessboard of {wanted} inner corners"
    rows, columns = lattice.shape[:2]
    seen = f"{max(rows, columns)} x {min(rows, columns)}"
    if _near_edge(lattice, small.shape[1], small.shape[0]):
        return f"runs over the edge of the picture: {seen} of {wanted} inner corners are seen"
    return f"another target, or one partly covered: a chessboard of {seen} inner corners, expected {wanted}"


def _largest(grey: NDArray[np.uint8], size: tuple[int, int]) -> FloatArray | None:
    """Return the largest lattice (rows, columns, 2) of corners that OpenCV grows from smaller ones, None for none."""
    import cv2

    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
    lattices = []
    for less in (1, 2, 4, max(size)):
        seed = (max(size[0] - less, 3), max(size[1] - less, 3))
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, seed, flags=flags)
        if found:
            lattices.append(np.asarray(corners, dtype=np.float64).reshape(*np.asarray(meta).shape[:2], 2))
    return max(lattices, key=lambda lattice: lattice.size, default=None)


def _near_edge(lattice: FloatArray, width: int, height: int) -> bool:
    """Return whether the next corner but one beyond a side of the lattice would lie outside the picture."""
    sides = [np.rot90(lattice, turn) for turn in range(4)]
    beyond = np.concatenate([side[0] + 1.5 * (side[0] - side[1]) for side in sides])
    return bool(((beyond < 0) | (beyond > [width - 1, height - 1])).any())
