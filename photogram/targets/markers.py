"""Boards with markers: detected markers, the lattice they form, and where its corners are expected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.targets.chessboard import SEARCHED_PX, downscale, lattice_powers
from photogram.targets.target_view import TargetNotFound, image_fault, refuse_second
from shakercal._common.arrays import FloatArray, IntArray

FEWEST_MARKERS = 4  # of a homography
_TOLERANCE = 0.3  # cells between a marker's centre and its position by the board's other markers
_ON_LATTICE = 0.15  # the same, beyond the board
_ALIGNED = 0.9  # least cosine between a marker's upper edge and the board's direction
_NEAR = 1.3  # cells between a corner and the nearest detected marker
_SECOND = 6  # markers that make a second board
_FIT_SHARE = 0.7  # of the detected markers that have to be at their positions


@dataclass(frozen=True, eq=False)
class Markers:
    """Detected markers.

    number (N,), corner_px (N, 4, 2) clockwise from the upper left one of the marker, centre_px (N, 2): the intersection
    of the diagonals, which is also the centre of the cell for any size of marker.
    """

    number: IntArray
    corner_px: FloatArray
    centre_px: FloatArray

    @property
    def upper_px(self) -> FloatArray:
        """Vectors (N, 2) along the markers' upper edges, to their right."""
        square = self.corner_px
        return np.asarray(square[:, 1] - square[:, 0] + square[:, 2] - square[:, 3])

    def part(self, chosen: NDArray[Any]) -> Markers:
        """Return some of the markers."""
        return Markers(self.number[chosen], self.corner_px[chosen], self.centre_px[chosen])


@dataclass(frozen=True, eq=False)
class MarkerBoard:
    """Markers of a board.

    Attributes
    ----------
    markers : its markers.
    position : (N, 2) of their centres in the board's lattice, in cells.
    lattice_from_px : (3, 3) the homography with which most markers agree.
    seen : number of markers within the board's outline, or beyond it on its lattice (of a larger board), without those
        of another board next to it.
    legacy : whether the pattern is that of OpenCV before 4.6.
    """

    markers: Markers
    position: FloatArray
    lattice_from_px: FloatArray
    seen: int
    legacy: bool = False


Search = Callable[[NDArray[np.uint8]], Markers]
"""Finds the markers in an image of 8 bits."""


def find_markers(
    grey: NDArray[np.uint8], dictionary: str, first: int | None = None, border: int = 1, darker: float = 7.0
) -> Markers:
    """Return the markers of a predefined dictionary in an image of 8 bits.

    `first`: only the first ones of the dictionary. `border`: width of their black border, in bits. `darker`: grey
    levels by which black is below the mean around it. If several boards are visible, numbers may occur more than once.
    """
    import cv2

    predefined = predefined_dictionary(dictionary)
    if first is not None:
        predefined = cv2.aruco.Dictionary(
            predefined.bytesList[:first], predefined.markerSize, predefined.maxCorrectionBits
        )
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits, parameters.adaptiveThreshConstant = border, darker
    corners, numbers, _ = cv2.aruco.ArucoDetector(predefined, parameters).detectMarkers(grey)
    if numbers is None or len(corners) == 0:
        return Markers(np.empty(0, dtype=np.int64), np.empty((0, 4, 2)), np.empty((0, 2)))
    number = np.asarray(numbers, dtype=np.int64).ravel()
    square = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
    one, two = square[:, 2] - square[:, 0], square[:, 3] - square[:, 1]
    between = square[:, 1] - square[:, 0]
    share = (between[:, 0] * two[:, 1] - between[:, 1] * two[:, 0]) / (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    return Markers(number, square, np.asarray(square[:, 0] + share[:, None] * one))


def predefined_dictionary(name: str) -> Any:
    """Return OpenCV's predefined dictionary of a name such as DICT_4X4_50."""
    import cv2

    code = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if code is None:
        raise ValueError(f"dictionary: expected a name as DICT_4X4_50 of OpenCV's dictionaries, found {name!r}")
    return cv2.aruco.getPredefinedDictionary(code)


def fit_markers(
    markers: Markers, centres: FloatArray, size: tuple[int, int], first: int, any_turn: bool
) -> MarkerBoard | None:
    """Return the board of markers at `centres` (M, 2), in cells; None without one.

    Their numbers begin with `first`. The centres fit a homography and the upper edges have one direction of the
    lattice: its first one, or any of the four if `any_turn`.
    """
    import cv2

    number = markers.number - first
    in_range = (number >= 0) & (number < len(centres))
    if in_range.sum() < FEWEST_MARKERS:
        return None
    own = markers.part(in_range)
    position = centres[number[in_range]]
    found, _ = cv2.findHomography(own.centre_px, position, cv2.RANSAC, _TOLERANCE)
    if found is None:
        return None
    homography = np.asarray(found, dtype=np.float64)
    at, along_edge = apply(homography, own.centre_px), apply(homography, own.centre_px + 0.25 * own.upper_px)
    edge = along_edge - at
    edge /= np.linalg.norm(edge, axis=1, keepdims=True)
    directions = np.stack([edge[:, 0], edge[:, 1], -edge[:, 0], -edge[:, 1]] if any_turn else [edge[:, 0]]) > _ALIGNED
    aligned = directions[int(directions.sum(axis=1).argmax())]
    good = np.flatnonzero((np.linalg.norm(at - position, axis=1) < _TOLERANCE) & aligned)
    _, once = np.unique(position[good], axis=0, return_index=True)
    good = good[once]
    if len(good) < FEWEST_MARKERS or np.linalg.matrix_rank(position[good] - position[good].mean(axis=0)) < 2:
        return None
    on_board = apply(homography, markers.centre_px) + 0.5
    beyond = np.linalg.norm(on_board - np.rint(on_board), axis=1) < _ON_LATTICE
    inside = ((on_board > -0.5) & (on_board < np.array(size) - 0.5)).all(axis=1)
    return MarkerBoard(own.part(good), position[good], homography, int((inside | beyond).sum()))


def detect_scaled(grey: NDArray[np.uint8], search: Search, longest_px: int = SEARCHED_PX) -> Markers:
    """Return the markers found in a smaller image, in the pixels of the original one."""
    small, factor = downscale(grey, longest_px)
    return _rescaled(search(small), factor)


def detect_enlarged(grey: NDArray[np.uint8], search: Search) -> Markers:
    """Return the markers of an image of twice the size, in the original's pixels."""
    import cv2

    large = cv2.resize(grey, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
    return _rescaled(search(np.asarray(large, dtype=np.uint8)), 0.5)


def _rescaled(found: Markers, factor: float) -> Markers:
    corner, centre = ((pixel + 0.5) * factor - 0.5 for pixel in (found.corner_px, found.centre_px))
    return Markers(found.number, corner, centre)


def check_board(
    markers: Markers, board: MarkerBoard, fit: Callable[[Markers], MarkerBoard | None], size: tuple[int, int], name: str
) -> None:
    """Raise `TargetNotFound` for a board of another size, or a second equal one.

    `size`: its cells. `name`: "a ChArUco board of 9 x 6 squares".
    """
    own = len(board.position)
    if own < _FIT_SHARE * board.seen:
        fitting = f"{own} of {board.seen} markers"
        raise TargetNotFound(f"another target: only {fitting} are at the positions of {name}")
    cell = apply(board.lattice_from_px, markers.centre_px) + 1.0
    beyond = np.asarray(((cell < -0.5) | (cell > np.array(size) + 0.5)).any(axis=1))
    another = fit(markers.part(beyond))
    if another is not None and len(another.position) >= max(_SECOND, _FIT_SHARE * another.seen):
        refuse_second(name)


def expected_corners(
    board: MarkerBoard, corner: FloatArray, cell: float, known: tuple[FloatArray, FloatArray]
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
    """Return which corners (N, 2) are near markers, their pixels, and the sides there.

    Corners are in cells. `known`: positions (K, 2) in cells and pixels (K, 2) of points of the board. Sides (N, 2, 2)
    are those of a square of `cell` cells. Places are those of the homography. If there are enough markers, a polynomial
    in the lattice adds the effect of the lens.
    """
    position, pixel = known
    px_from_lattice = np.asarray(np.linalg.inv(board.lattice_from_px), dtype=np.float64)
    bent = pixel - apply(px_from_lattice, position)
    count = len(board.position)
    terms = 10 if count >= 20 else 6 if count >= 12 else 3 if count >= 6 else 0
    solution = np.linalg.lstsq(lattice_powers(position)[:, :terms], bent, rcond=None)[0]

    def expected(points: FloatArray) -> FloatArray:
        return np.asarray(apply(px_from_lattice, points) + lattice_powers(points)[:, :terms] @ solution)

    half = 0.5 * np.eye(2)
    sides = [expected(corner + cell * half[k]) - expected(corner - cell * half[k]) for k in range(2)]
    near = np.asarray(np.linalg.norm(corner[:, None] - board.position[None], axis=2).min(axis=1) < _NEAR)
    return near, expected(corner)[near], np.stack(sides, axis=1)[near]


def missing_reason(
    image: NDArray[Any],
    grey: NDArray[np.uint8],
    full_scale: float,
    found: Callable[[NDArray[np.uint8]], bool | int],
    expected: str,
    of: str = "",
) -> str:
    """Return the fault of an image in which a board was not found.

    `found` returns whether the board is in an image of 8 bits, or else how many of its markers are. `expected` names
    the board, `of` the family of markers.
    """
    fault = image_fault(image, full_scale)
    if fault is not None:
        return fault
    if found(np.ascontiguousarray(grey[:, ::-1])) is True:
        return "mirrored: the markers can be read in the image's mirror image"
    seen = int(found(grey))
    if seen == 0:
        return f"no markers of {expected}{of}"
    return f"another target, or too little of it: {seen} markers are visible, not at the positions of {expected}"


def apply(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 2) mapped by a homography (3, 3)."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
