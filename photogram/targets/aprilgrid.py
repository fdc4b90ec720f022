"""AprilGrids, Kalibr's boards, whole or in part: tags with black squares at their corners.

Tags of the family 36h11 are numbered along the rows, beginning at the lower left one, as Kalibr prints them. A small
square touches every corner of a tag, so that each is the crossing of two edges, as on a chessboard.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.targets.charuco import marker_count, own_markers
from photogram.targets.chessboard import corner_view, eight_bit
from photogram.targets.markers import (
    MarkerBoard,
    Markers,
    apply,
    check_board,
    detect_enlarged,
    detect_scaled,
    expected_corners,
    find_markers,
    fit_markers,
    missing_reason,
)
from photogram.targets.target_view import APRILGRID_TAGS, Target, TargetNotFound, TargetView
from shakercal._common.arrays import FloatArray

_BORDERS = (2, 1)  # widths of the tags' black border in bits: Kalibr's default, and that of other printers
_DARKER = 20.0  # where a tag and a square touch, the grey level is the mean around: a larger margin separates them
_BITS = 6  # of a tag's code along a side
_CLEAR = 0.65  # half width of a corner's window, and a margin for blur, in its squares
_LARGEST_PX = 1600  # longest side of an image that is enlarged for small tags


def find_aprilgrid(image: NDArray[Any], target: Target, name: str, full_scale: float) -> TargetView:
    """Return the corners of the tags of an AprilGrid, at least partly in an image.

    `target.size` counts tags. The index (i, j), i = 0 … 2·columns − 1, j = 0 … 2·rows − 1, counts the tags' corners
    from the lower left one of the first tag; the first component is along the rows of tags. The target's frame has x
    to the right, y up, seen from the front, and z towards the viewer, as Kalibr's. A board whose tags are numbered from
    the upper left has y down and z away from the viewer. The width of the tags' border, one or two bits, and their
    rotation on the board are found from the image (H, W). With a stated `target.first_id`, tags of other numbers belong
    to other boards and are ignored. Raises `TargetNotFound` with the fault of the image.
    """
    assert target.size is not None
    assert target.tag_spacing is not None
    grey, expected = eight_bit(image), f"an AprilGrid of {target.size[0]} x {target.size[1]} tags"
    board, markers, border = _search(grey, target)
    if board is None:

        def found(seen: NDArray[np.uint8]) -> bool | int:
            board, markers, _ = _search(seen, target)
            return True if board is not None else len(markers.number)

        raise TargetNotFound(missing_reason(image, grey, full_scale, found, expected, f" in {APRILGRID_TAGS}"))
    check_board(markers, board, partial(find_grid, target=target), target.size, expected)
    i, j = np.meshgrid(np.arange(2 * target.size[0]), np.arange(2 * target.size[1]), indexing="ij")
    index = np.column_stack([i.ravel(), j.ravel()])
    square = min(target.tag_spacing, border / (_BITS + 2 * border) / _CLEAR)
    near, start, axes = expected_corners(
        board, _cells(target, index), square / _pitch(target), _tag_corners(target, board)
    )
    return corner_view(image, target, index[near], start, axes, name, full_scale)


def find_grid(markers: Markers, target: Target) -> MarkerBoard | None:
    """Return the board with which most tags agree, None where fewer than 4 do."""
    columns, rows = target.size or (0, 0)
    row, column = np.divmod(np.arange(rows * columns), max(columns, 1))
    centres = np.column_stack([column, row]) - 0.5
    return fit_markers(markers, centres, (columns, rows), target.first_id or 0, any_turn=True)


def _search(grey: NDArray[np.uint8], target: Target) -> tuple[MarkerBoard | None, Markers, int]:
    """Return the board, all tags, and the width of their border.

    Of a smaller image, the original or an enlarged one, whichever shows most tags. OpenCV finds tags whose bits measure
    3 px and more.
    """
    best: tuple[MarkerBoard | None, Markers, int] | None = None
    for scale in (detect_scaled, lambda grey, search: search(grey), detect_enlarged):
        if scale is detect_enlarged and max(grey.shape) > _LARGEST_PX:
            break
        for border in _BORDERS:
            markers = own_markers(
                scale(grey, partial(find_markers, dictionary=APRILGRID_TAGS, border=border, darker=_DARKER)), target
            )
            found = find_grid(markers, target), markers, border
            if best is None or _extent(found) > _extent(best):
                best = found
        assert best is not None
        if _extent(best)[0] == marker_count(target):
            break
    assert best is not None
    return best


def _extent(found: tuple[MarkerBoard | None, Markers, int]) -> tuple[int, int]:
    """Return the number of tags on the board, and of all."""
    return 0 if found[0] is None else len(found[0].position), len(found[1].number)


def _pitch(target: Target) -> float:
    """Return the distance of neighbouring tags, in tags."""
    return 1.0 + (target.tag_spacing or 0.0)


def _cells(target: Target, index: NDArray[Any]) -> FloatArray:
    """Return positions (N, 2) of corners in cells of one tag each.

    The centre of the first tag is at −½, as that of a ChArUco board's first square.
    """
    return (target.lattice(index) - 0.5) / _pitch(target) - 0.5


def _tag_corners(target: Target, board: MarkerBoard) -> tuple[FloatArray, FloatArray]:
    """Return positions (K, 2) in cells and pixels (K, 2) of tags' corners."""
    pixel = board.markers.corner_px
    at = apply(board.lattice_from_px, pixel.reshape(-1, 2)).reshape(-1, 4, 2)
    offset = np.sign(at - at.mean(axis=1, keepdims=True)) * 0.5 / _pitch(target)
    distinct = np.abs(offset.sum(axis=1)).max(axis=1) < 1e-9  # each corner in a quadrant of its own
    position = board.position[:, None] + offset
    return position[distinct].reshape(-1, 2), pixel[distinct].reshape(-1, 2)
