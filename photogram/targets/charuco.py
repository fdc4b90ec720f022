"""ChArUco boards, whole or in part: markers identify the squares, inner corners are measured."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.targets.chessboard import SEARCHED_PX, corner_view, downscale, eight_bit
from photogram.targets.markers import (
    MarkerBoard,
    Markers,
    apply,
    check_board,
    detect_scaled,
    expected_corners,
    find_markers,
    fit_markers,
    missing_reason,
    predefined_dictionary,
)
from photogram.targets.target_view import Target, TargetNotFound, TargetView
from shakercal._common.arrays import FloatArray

# Families of predefined dictionaries, whose smaller ones are the first markers of the largest.
_FAMILIES = (
    ("DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_4X4_1000"),
    ("DICT_5X5_50", "DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000"),
    ("DICT_6X6_50", "DICT_6X6_100", "DICT_6X6_250", "DICT_6X6_1000"),
    ("DICT_7X7_50", "DICT_7X7_100", "DICT_7X7_250", "DICT_7X7_1000"),
    ("DICT_ARUCO_ORIGINAL",),
    ("DICT_ARUCO_MIP_36h12",),
    ("DICT_APRILTAG_36h11",),
    ("DICT_APRILTAG_36h10",),
    ("DICT_APRILTAG_25h9",),
    ("DICT_APRILTAG_16h5",),
)


def find_charuco(image: NDArray[Any], target: Target, name: str, full_scale: float) -> TargetView:
    """Return the inner corners of a ChArUco board, at least partly in an image.

    `target.size` counts squares. The index (i, j), i = 0 … columns − 2, j = 0 … rows − 2, counts inner corners from the
    one nearest to the board's upper left square. Its first component is along the rows of markers. The target's origin
    is that corner, one square inside the printed pattern's. The pattern, new or legacy (OpenCV before 4.6), and an
    unnamed dictionary are found from the image (H, W). The size of the markers in their squares is irrelevant. With a
    stated `target.first_id`, markers of other numbers belong to other boards and are ignored. Raises `TargetNotFound`
    with the fault of the image.
    """
    assert target.size is not None
    grey, expected = eight_bit(image), f"a ChArUco board of {target.size[0]} x {target.size[1]} squares"
    dictionary = target.dictionary or _dictionary(grey, target)
    last = (target.first_id or 0) + marker_count(target) - 1
    if target.first_id is not None and dictionary and len(predefined_dictionary(dictionary).bytesList) <= last:
        raise ValueError(
            f"first_id: expected a board whose last marker {last} is in its dictionary, found {dictionary}"
        )
    board, markers = _search(grey, target, dictionary)
    if board is None:

        def found(seen: NDArray[np.uint8]) -> bool | int:
            known = dictionary or _dictionary(seen, target)
            board, markers = _search(seen, target, known)
            return True if board is not None else len(markers.number)

        of = f" in {target.dictionary}" if target.dictionary else ""
        raise TargetNotFound(missing_reason(image, grey, full_scale, found, expected, of))
    fit = partial(find_board, target=target, shape=grey.shape)
    check_board(markers, board, fit, target.size, expected)
    i, j = np.meshgrid(np.arange(target.size[0] - 1), np.arange(target.size[1] - 1), indexing="ij")
    index = np.column_stack([i.ravel(), j.ravel()])
    known = board.position, board.markers.centre_px
    near, start, axes = expected_corners(board, index.astype(np.float64), 1.0, known)
    return corner_view(image, target, index[near], start, axes, name, full_scale)


def dictionary_of(image: NDArray[Any], target: Target) -> str | None:
    """Return the dictionary that fits the board in an image (H,W), None for none."""
    return _dictionary(eight_bit(image), target)


def _dictionary(grey: NDArray[np.uint8], target: Target) -> str | None:
    """Return the dictionary that fits the board in an 8-bit image."""
    small, factor = downscale(grey, SEARCHED_PX)
    name = find_dictionary(small, target)
    return name if name is not None or factor == 1 else find_dictionary(grey, target)


def _search(grey: NDArray[np.uint8], target: Target, dictionary: str | None) -> tuple[MarkerBoard | None, Markers]:
    """Return the board and all markers, of a smaller image or the original one."""
    if dictionary is None:
        return None, Markers(np.empty(0, dtype=np.int64), np.empty((0, 4, 2)), np.empty((0, 2)))
    search = partial(find_markers, dictionary=dictionary)
    markers = own_markers(detect_scaled(grey, search), target)
    board = find_board(markers, target, grey.shape)
    if max(grey.shape) <= SEARCHED_PX or (
        board and len(board.position) == len(_square_centres(target.size or (0, 0), board.legacy))
    ):
        return board, markers
    whole = own_markers(search(grey), target)
    both = [(one, found) for one, found in ((find_board(whole, target, grey.shape), whole), (board, markers)) if one]
    return max(both, key=lambda one: len(one[0].position), default=(None, whole))


def own_markers(markers: Markers, target: Target) -> Markers:
    """Return the markers of the target's numbers, all if its first one is not stated."""
    if target.first_id is None or target.size is None:
        return markers
    last = target.first_id + marker_count(target)
    return markers.part((markers.number >= target.first_id) & (markers.number < last))


def marker_count(target: Target) -> int:
    """Return the number of a board's markers, the larger one of a ChArUco board's patterns."""
    columns, rows = target.size or (0, 0)
    return columns * rows if target.kind == "aprilgrid" else (columns * rows + 1) // 2


def _square_centres(size: tuple[int, int], legacy: bool) -> FloatArray:
    """Return the centres (M, 2) of the white squares in the order of the markers.

    The first inner corner is the origin. The upper left square is black, in the `legacy` pattern (OpenCV before 4.6)
    white where the number of rows is even.
    """
    columns, rows = size
    odd = 1 if legacy and rows % 2 == 0 else 0
    row, column = np.divmod(np.arange(rows * columns), columns)
    white = (row + column) % 2 != odd
    return np.column_stack([column[white], row[white]]) - 0.5


def find_board(markers: Markers, target: Target, shape: tuple[int, ...]) -> MarkerBoard | None:
    """Return the board with which most markers agree, None where fewer than 4 do.

    Of the new or the legacy pattern. Where the board has an odd number of columns the patterns differ by one column for
    all markers but those at the sides. Between equal ones, the pattern with fewer missing markers counts, of those
    expected in the image of `shape` (H, W). The new one counts if a visible part of the board belongs to both.
    """
    size, first = target.size or (0, 0), target.first_id or 0
    boards = []
    for legacy in (False, True) if size[1] % 2 == 0 else (False,):
        board = fit_markers(markers, _square_centres(size, legacy), size, first, any_turn=False)
        boards += [] if board is None else [replace(board, legacy=legacy)]

    def whole_markers(board: MarkerBoard) -> int:
        """Return how many of a board's markers lie wholly in the image."""
        corner = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        corners = (_square_centres(size, board.legacy)[:, None, :] + corner).reshape(-1, 2)
        pixels = apply(np.asarray(np.linalg.inv(board.lattice_from_px)), corners).reshape(-1, 4, 2)
        return int(((pixels > 0) & (pixels < [shape[1] - 1, shape[0] - 1])).all(axis=(1, 2)).sum())

    return max(boards, key=lambda board: (len(board.position), -whole_markers(board)), default=None)


def find_dictionary(grey: NDArray[np.uint8], target: Target) -> str | None:
    """Return the predefined dictionary with which most markers fit a board, None for none.

    Dictionaries of a family share their first markers; the smallest with enough markers is used. The families are tried
    in the order of their use until one explains half of the board.
    """
    squares = marker_count(target)
    last = squares + (target.first_id or 0)
    best, most = None, 0
    for family in _FAMILIES:
        name = next((name for name in family if len(predefined_dictionary(name).bytesList) >= last), None)
        if name is None:
            continue
        board = find_board(own_markers(find_markers(grey, name, last + 1), target), target, grey.shape)
        if board is not None and len(board.position) > most:
            best, most = name, len(board.position)
        if 2 * most >= squares:
            break
    return best
