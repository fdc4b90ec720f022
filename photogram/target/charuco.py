"""A ChArUco board in a picture, whole or in part: its markers name the squares, its inner corners are measured."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray, IntArray
from photogram.target.chessboard import eight_bit, reduced
from photogram.target.corner_view import corner_view
from photogram.target.markers import Board, apply, find_board, find_dictionary, find_markers, markers_on
from photogram.target.picture import picture_fault
from photogram.target.view import Target, TargetNotFound, TargetView

_SEARCHED_PX = 1400  # longest side of the picture in which markers are searched first
_NEAR = 1.3  # squares between a corner and the nearest marker that was seen
_FIT_SHARE = 0.7  # of the markers seen that have to be in their places


def find_charuco(image: NDArray[Any], target: Target, name: str, full_scale: float) -> TargetView:
    """Return the inner corners of a ChArUco board in a picture (H, W) that shows at least a part of it.

    `target.size` counts squares; index (i, j), i = 0 … columns − 2, j = 0 … rows − 2, counts inner corners from the
    one nearest to the board's upper left square, the first index along the rows of markers. The target's origin is
    that corner, one square inside the printed pattern's. The pattern, new or legacy (OpenCV before 4.6), and a
    dictionary that is not named are found from the picture; the size of the markers in their squares plays no part.
    Raises `TargetNotFound` with what is wrong with the picture.
    """
    if target.size is None:
        raise ValueError("target: expected the number of squares, found no size")
    grey = eight_bit(image)
    dictionary = target.dictionary or _dictionary(grey, target.size)
    board = None if dictionary is None else _search(grey, target.size, dictionary)
    if board is None or dictionary is None:
        raise TargetNotFound(_reason(image, grey, target, dictionary, full_scale))
    _refuse_another(board, target.size)
    index, start, axes = _expected(board, target.size)
    return corner_view(image, index, start, axes, name, full_scale, markers=True)


def _dictionary(grey: NDArray[np.uint8], size: tuple[int, int]) -> str | None:
    """Return the dictionary that fits the board in the picture, None for none."""
    small, factor = reduced(grey, _SEARCHED_PX)
    found = find_dictionary(small, size)
    return found if found is not None or factor == 1 else find_dictionary(grey, size)


def _search(grey: NDArray[np.uint8], size: tuple[int, int], dictionary: str) -> Board | None:
    """Return the board seen, in a smaller picture or, if some markers are missing there, in the picture itself."""
    small, factor = reduced(grey, _SEARCHED_PX)
    board = _enlarged(find_board(find_markers(small, dictionary), size, small.shape), factor)
    if factor == 1 or (board is not None and len(board.place) == markers_on(size, board.legacy)):
        return board
    whole = find_board(find_markers(grey, dictionary), size, grey.shape)
    both = [found for found in (whole, board) if found is not None]
    return max(both, key=lambda found: len(found.place), default=None)


def _enlarged(board: Board | None, factor: int) -> Board | None:
    """Return a board found in a picture smaller by `factor` in the pixels of the picture itself."""
    if board is None:
        return None
    small_from_px = np.array([[1, 0, 0.5 - factor / 2], [0, 1, 0.5 - factor / 2], [0, 0, factor]]) / factor
    centre = (board.centre_px + 0.5) * factor - 0.5
    return Board(board.place, centre, board.lattice_from_px @ small_from_px, board.legacy, board.seen)


def _refuse_another(board: Board, size: tuple[int, int]) -> None:
    """Raise `TargetNotFound` where many markers are not in the places of this board, or all are seen in a mirror."""
    wanted = f"{size[0]} x {size[1]} squares"
    if len(board.place) < _FIT_SHARE * board.seen:
        fitting = f"{len(board.place)} of {board.seen} markers"
        raise TargetNotFound(f"another target: only {fitting} are where a ChArUco board of {wanted} has them")


def _expected(board: Board, size: tuple[int, int]) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return index (N, 2), position (N, 2) and squares' sides (N, 2, 2) in px of the corners near the markers seen.

    The homography of the markers' centres and, where there are enough of them, a polynomial in the lattice for what
    the lens adds to it.
    """
    i, j = np.meshgrid(np.arange(size[0] - 1), np.arange(size[1] - 1), indexing="ij")
    index = np.column_stack([i.ravel(), j.ravel()])
    corner = index.astype(np.float64)
    px_from_lattice = np.asarray(np.linalg.inv(board.lattice_from_px), dtype=np.float64)
    bent = board.centre_px - apply(px_from_lattice, board.place)
    count = len(board.place)
    terms = 10 if count >= 20 else 6 if count >= 12 else 3 if count >= 6 else 0
    solution = np.linalg.lstsq(_powers(board.place)[:, :terms], bent, rcond=None)[0]

    def expected(place: FloatArray) -> FloatArray:
        return np.asarray(apply(px_from_lattice, place) + _powers(place)[:, :terms] @ solution)

    half = 0.5 * np.eye(2)
    sides = [expected(corner + half[k]) - expected(corner - half[k]) for k in range(2)]
    distance = np.linalg.norm(index[:, None] - board.place[None], axis=2).min(axis=1)
    near = distance < _NEAR
    return index[near], expected(corner)[near], np.stack(sides, axis=1)[near]


def _powers(place: FloatArray) -> FloatArray:
    """Return the powers (N, 10) of lattice points up to the third degree."""
    x, y = place.T / 10.0
    one = np.ones_like(x)
    return np.stack([one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)


def _reason(
    image: NDArray[Any], grey: NDArray[np.uint8], target: Target, dictionary: str | None, full_scale: float
) -> str:
    """Return what is wrong with a picture in which the board was not found."""
    fault = picture_fault(image, full_scale)
    if fault is not None:
        return fault
    size = target.size or (0, 0)
    flipped = np.ascontiguousarray(grey[:, ::-1])
    mirrored = dictionary or _dictionary(flipped, size)
    if mirrored is not None and _search(flipped, size, mirrored) is not None:
        return "mirrored: the markers can be read in the picture's mirror image"
    seen = 0 if dictionary is None else len(find_markers(grey, dictionary).number)
    wanted = f"a ChArUco board of {size[0]} x {size[1]} squares"
    if seen == 0:
        return f"no markers of {wanted}" + (f" in {target.dictionary}" if target.dictionary else "")
    return f"another target, or too little of it: {seen} markers are seen, not in the places of {wanted}"
