"""ChArUco boards, whole or in part: markers identify the squares, inner corners are measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.targets.chessboard import SEARCHED_PX, corner_view, downscale, eight_bit, lattice_powers
from photogram.targets.target_view import Target, TargetNotFound, TargetView, image_fault, refuse_second
from shakercal._common.arrays import FloatArray, IntArray

_NEAR = 1.3  # squares between a corner and the nearest detected marker
_SECOND = 6  # markers that make a second board
_FIT_SHARE = 0.7  # of the detected markers that have to be at their positions


def find_charuco(image: NDArray[Any], target: Target, name: str, full_scale: float) -> TargetView:
    """Return the inner corners of a ChArUco board, at least partly in an image.

    `target.size` counts squares. The index (i, j), i = 0 … columns − 2, j = 0 … rows − 2, counts inner corners from the
    one nearest to the board's upper left square. Its first component is along the rows of markers. The target's origin
    is that corner, one square inside the printed pattern's. The pattern, new or legacy (OpenCV before 4.6), and an
    unnamed dictionary are found from the image (H, W). The size of the markers in their squares is irrelevant. Raises
    `TargetNotFound` with the fault of the image.
    """
    assert target.size is not None
    grey = eight_bit(image)
    dictionary = target.dictionary or _dictionary(grey, target.size)
    if dictionary is None:
        raise TargetNotFound(_reason(image, grey, target, None, full_scale))
    markers = _detect(grey, dictionary)
    board = _search(grey, markers, target.size, dictionary)
    if board is None:
        raise TargetNotFound(_reason(image, grey, target, dictionary, full_scale))
    expected = f"{target.size[0]} x {target.size[1]} squares"
    if len(board.lattice_position) < _FIT_SHARE * board.seen:
        fitting = f"{len(board.lattice_position)} of {board.seen} markers"
        raise TargetNotFound(f"another target: only {fitting} are at the positions of a ChArUco board of {expected}")
    another = _second_board(markers, board, target.size, grey.shape)
    if another is not None and len(another.lattice_position) >= max(_SECOND, _FIT_SHARE * another.seen):
        refuse_second(f"a ChArUco board of {expected}")
    index, start, axes = _expected(board, target.size)
    return corner_view(image, target, index, start, axes, name, full_scale)


def dictionary_of(image: NDArray[Any], size: tuple[int, int]) -> str | None:
    """Return the dictionary that fits the board in an image (H,W), None for none."""
    return _dictionary(eight_bit(image), size)


def _dictionary(grey: NDArray[np.uint8], size: tuple[int, int]) -> str | None:
    """Return the dictionary that fits the board in an 8-bit image."""
    small, factor = downscale(grey, SEARCHED_PX)
    name = find_dictionary(small, size)
    return name if name is not None or factor == 1 else find_dictionary(grey, size)


def _detect(grey: NDArray[np.uint8], dictionary: str) -> Markers:
    """Return the markers of a smaller image, in the pixels of the original one."""
    small, factor = downscale(grey, SEARCHED_PX)
    found = find_markers(small, dictionary)
    return Markers(found.number, (found.centre_px + 0.5) * factor - 0.5, found.upper_px * factor)


def _search(grey: NDArray[np.uint8], markers: Markers, size: tuple[int, int], dictionary: str) -> MarkerBoard | None:
    """Return the board of markers from `_detect`, or of the original image."""
    board = find_board(markers, size, grey.shape)
    if max(grey.shape) <= SEARCHED_PX or (
        board and len(board.lattice_position) == len(_square_centres(size, board.legacy))
    ):
        return board
    whole = find_board(find_markers(grey, dictionary), size, grey.shape)
    both = [one for one in (whole, board) if one is not None]
    return max(both, key=lambda one: len(one.lattice_position), default=None)


def _second_board(
    markers: Markers, board: MarkerBoard, size: tuple[int, int], shape: tuple[int, ...]
) -> MarkerBoard | None:
    """Return the board of markers beyond the outline of the one found, None for none."""
    centre = markers.centre_px
    square = apply(board.lattice_from_px, centre) + 1.0 if len(centre) else centre
    beyond = ((square < -0.5) | (square > np.array(size) + 0.5)).any(axis=1)
    return find_board(Markers(markers.number[beyond], centre[beyond], markers.upper_px[beyond]), size, shape)


def _expected(board: MarkerBoard, size: tuple[int, int]) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return index (N,2), position (N,2) and squares' sides (N,2,2) in px of corners near markers.

    By the homography of the markers' centres. If there are enough of them, a polynomial in the lattice adds the effect
    of the lens.
    """
    i, j = np.meshgrid(np.arange(size[0] - 1), np.arange(size[1] - 1), indexing="ij")
    index = np.column_stack([i.ravel(), j.ravel()])
    corner = index.astype(np.float64)
    px_from_lattice = np.asarray(np.linalg.inv(board.lattice_from_px), dtype=np.float64)
    bent = board.centre_px - apply(px_from_lattice, board.lattice_position)
    count = len(board.lattice_position)
    terms = 10 if count >= 20 else 6 if count >= 12 else 3 if count >= 6 else 0
    solution = np.linalg.lstsq(lattice_powers(board.lattice_position)[:, :terms], bent, rcond=None)[0]

    def expected(points: FloatArray) -> FloatArray:
        return np.asarray(apply(px_from_lattice, points) + lattice_powers(points)[:, :terms] @ solution)

    half = 0.5 * np.eye(2)
    sides = [expected(corner + half[k]) - expected(corner - half[k]) for k in range(2)]
    distance = np.linalg.norm(index[:, None] - board.lattice_position[None], axis=2).min(axis=1)
    near = distance < _NEAR
    return index[near], expected(corner)[near], np.stack(sides, axis=1)[near]


def _reason(
    image: NDArray[Any], grey: NDArray[np.uint8], target: Target, dictionary: str | None, full_scale: float
) -> str:
    """Return the fault of an image in which the board was not found."""
    fault = image_fault(image, full_scale)
    if fault is not None:
        return fault
    size = target.size or (0, 0)
    flipped = np.ascontiguousarray(grey[:, ::-1])
    mirrored = dictionary or _dictionary(flipped, size)
    if mirrored is not None and _search(flipped, _detect(flipped, mirrored), size, mirrored) is not None:
        return "mirrored: the markers can be read in the image's mirror image"
    seen = 0 if dictionary is None else len(find_markers(grey, dictionary).number)
    expected = f"a ChArUco board of {size[0]} x {size[1]} squares"
    if seen == 0:
        return f"no markers of {expected}" + (f" in {target.dictionary}" if target.dictionary else "")
    return f"another target, or too little of it: {seen} markers are visible, not at the positions of {expected}"


# Detected markers, their dictionary, and which of the two patterns they form.

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
_TOLERANCE = 0.3  # squares between a marker's centre and its position by the board's other markers
_ON_LATTICE = 0.15  # the same, beyond the board
_ALIGNED = 0.9  # least cosine between a marker's upper edge and the board's first direction
_FEWEST = 4  # markers of a homography


@dataclass(frozen=True, eq=False)
class Markers:
    """Detected markers.

    number (N,), centre_px (N, 2), upper_px (N, 2): vector along a marker's upper edge, to its right. The centre is the
    intersection of the diagonals, which is also the centre of the white square for any size of marker.
    """

    number: IntArray
    centre_px: FloatArray
    upper_px: FloatArray


@dataclass(frozen=True, eq=False)
class MarkerBoard:
    """Markers of a board.

    Attributes
    ----------
    lattice_position : (N, 2) the squares' centres in the lattice of inner corners.
    centre_px : (N, 2) of these.
    lattice_from_px : (3, 3) the homography with which most markers agree.
    legacy : whether the pattern is that of OpenCV before 4.6.
    seen : number of markers within the board's outline, or beyond it on its lattice (of a larger board), without those
        of another board next to it.
    """

    lattice_position: FloatArray
    centre_px: FloatArray
    lattice_from_px: FloatArray
    legacy: bool
    seen: int


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


def find_markers(grey: NDArray[np.uint8], dictionary: str, first: int | None = None) -> Markers:
    """Return the markers of a predefined dictionary in an image of 8 bits.

    If several boards are visible, numbers occur more than once.
    """
    import cv2

    predefined = _predefined(dictionary)
    if first is not None:
        predefined = cv2.aruco.Dictionary(
            predefined.bytesList[:first], predefined.markerSize, predefined.maxCorrectionBits
        )
    corners, numbers, _ = cv2.aruco.ArucoDetector(predefined).detectMarkers(grey)
    if numbers is None or len(corners) == 0:
        return Markers(np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty((0, 2)))
    number = np.asarray(numbers, dtype=np.int64).ravel()
    square = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
    upper = square[:, 1] - square[:, 0] + square[:, 2] - square[:, 3]
    one, two = square[:, 2] - square[:, 0], square[:, 3] - square[:, 1]
    between = square[:, 1] - square[:, 0]
    share = (between[:, 0] * two[:, 1] - between[:, 1] * two[:, 0]) / (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    return Markers(number, np.asarray(square[:, 0] + share[:, None] * one), upper)


def _predefined(name: str) -> Any:
    import cv2

    code = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if code is None:
        raise ValueError(f"dictionary: expected a name as DICT_4X4_50 of OpenCV's dictionaries, found {name!r}")
    return cv2.aruco.getPredefinedDictionary(code)


def find_board(markers: Markers, size: tuple[int, int], shape: tuple[int, ...]) -> MarkerBoard | None:
    """Return the board with which most markers agree, None where fewer than 4 do.

    Of the new or the legacy pattern. Where the board has an odd number of columns the patterns differ by one column for
    all markers but those at the sides. Between equal ones, the pattern with fewer missing markers counts, of those
    expected in the image of `shape` (H, W). The new one counts if a visible part of the board belongs to both.
    """
    boards = [_board(markers, size, legacy) for legacy in ((False, True) if size[1] % 2 == 0 else (False,))]

    def whole_markers(board: MarkerBoard) -> int:
        """Return how many of a board's markers lie wholly in the image."""
        corner = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        corners = (_square_centres(size, board.legacy)[:, None, :] + corner).reshape(-1, 2)
        pixels = apply(np.asarray(np.linalg.inv(board.lattice_from_px)), corners).reshape(-1, 4, 2)
        return int(((pixels > 0) & (pixels < [shape[1] - 1, shape[0] - 1])).all(axis=(1, 2)).sum())

    candidates = [board for board in boards if board is not None]
    return max(candidates, key=lambda board: (len(board.lattice_position), -whole_markers(board)), default=None)


def _board(markers: Markers, size: tuple[int, int], legacy: bool) -> MarkerBoard | None:
    """Return the board of one pattern: centres fit a homography, edges have its directions."""
    import cv2

    centres = _square_centres(size, legacy)
    in_range = markers.number < len(centres)
    if in_range.sum() < _FEWEST:
        return None
    position, centre, upper = centres[markers.number[in_range]], markers.centre_px[in_range], markers.upper_px[in_range]
    found, _ = cv2.findHomography(centre, position, cv2.RANSAC, _TOLERANCE)
    if found is None:
        return None
    homography = np.asarray(found, dtype=np.float64)
    at, along_edge = apply(homography, centre), apply(homography, centre + 0.25 * upper)
    edge = along_edge - at
    aligned = edge[:, 0] > _ALIGNED * np.linalg.norm(edge, axis=1)
    good = np.asarray((np.linalg.norm(at - position, axis=1) < _TOLERANCE) & aligned)
    if good.sum() < _FEWEST:
        return None
    _, first = np.unique(position[good], axis=0, return_index=True)
    on_board = apply(homography, markers.centre_px) + 0.5
    beyond = np.linalg.norm(on_board - np.rint(on_board), axis=1) < _ON_LATTICE
    inside = ((on_board > -0.5) & (on_board < np.array(size) - 0.5)).all(axis=1)
    return MarkerBoard(position[good][first], centre[good][first], homography, legacy, int((inside | beyond).sum()))


def apply(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 2) mapped by a homography (3, 3)."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def find_dictionary(grey: NDArray[np.uint8], size: tuple[int, int]) -> str | None:
    """Return the predefined dictionary with which most markers fit a board, None for none.

    `size`: its squares. Dictionaries of a family share their first markers; the smallest with enough markers is used.
    The families are tried in the order of their use until one explains half of the board.
    """
    squares = len(_square_centres(size, False))
    best, most = None, 0
    for family in _FAMILIES:
        name = next((name for name in family if len(_predefined(name).bytesList) >= squares), None)
        if name is None:
            continue
        board = find_board(find_markers(grey, name, squares + 1), size, grey.shape)
        if board is not None and len(board.lattice_position) > most:
            best, most = name, len(board.lattice_position)
        if 2 * most >= squares:
            break
    return best
