"""Grids of dots, with and without ring markers; any target by its name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import BoolArray, FloatArray, IntArray, check_shape
from photogram.images import GreyImage
from photogram.targets.ellipse import Blobs, Ellipses, find_blobs, fit_ellipses
from photogram.targets.lattice import Lattice, find_lattice, local_fit
from photogram.targets.view import (
    Target,
    TargetNotFound,
    TargetView,
    check_blur,
    check_exposure,
    outline,
    picture_fault,
)

# ArUco markers of a ChArUco board: which are seen where, from which dictionary, in which of the two patterns.


# Families of predefined dictionaries; the smaller dictionaries of a family are the beginning of the largest.
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
_TOLERANCE = 0.3  # squares between a marker's centre and where the board's other markers put it
_ALIGNED = 0.9  # least cosine between a marker's upper edge and the board's first direction
_FEWEST = 4


@dataclass(frozen=True, eq=False)
class Markers:
    """Markers seen: number (N,), centre_px (N, 2), upper_px (N, 2): the way along a marker's upper edge, to its right.

    The centre is where the diagonals cross, which is also the centre of the white square, however large the marker is.
    """

    number: IntArray
    centre_px: FloatArray
    upper_px: FloatArray


@dataclass(frozen=True, eq=False)
class Board:
    """Markers of a board: `place` (N, 2), the squares' centres in the lattice of inner corners, at centre_px (N, 2).

    lattice_from_px (3, 3): the homography that most of the `seen` markers agree with.
    """

    place: FloatArray
    centre_px: FloatArray
    lattice_from_px: FloatArray
    legacy: bool
    seen: int


def markers_on(size: tuple[int, int], legacy: bool) -> int:
    """Return how many markers a board of `size` squares (columns, rows) has."""
    return len(_places(size, legacy))


def _places(size: tuple[int, int], legacy: bool) -> FloatArray:
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
    """Return the markers of a predefined dictionary, or of its `first` ones, in a picture (H, W) of 8 bits.

    Numbers that occur twice are left out.
    """
    import cv2

    known = _dictionary(dictionary)
    if first is not None:
        known = cv2.aruco.Dictionary(known.bytesList[:first], known.markerSize, known.maxCorrectionBits)
    corners, numbers, _ = cv2.aruco.ArucoDetector(known).detectMarkers(grey)
    if numbers is None or len(corners) == 0:
        return Markers(np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty((0, 2)))
    number = np.asarray(numbers, dtype=np.int64).ravel()
    square = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
    value, count = np.unique(number, return_counts=True)
    once = np.isin(number, value[count == 1])
    number, square = number[once], square[once]
    upper = square[:, 1] - square[:, 0] + square[:, 2] - square[:, 3]
    return Markers(number, _crossing(square), upper)


def _dictionary(name: str) -> Any:
    """Return OpenCV's predefined dictionary of this name."""
    import cv2

    code = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if code is None:
        raise ValueError(f"dictionary: expected a name as DICT_4X4_50 of OpenCV's dictionaries, found {name!r}")
    return cv2.aruco.getPredefinedDictionary(code)


def _crossing(square: FloatArray) -> FloatArray:
    """Return where the diagonals (N, 2) of quadrilaterals (N, 4, 2) cross."""
    one, two = square[:, 2] - square[:, 0], square[:, 3] - square[:, 1]
    between = square[:, 1] - square[:, 0]
    share = (between[:, 0] * two[:, 1] - between[:, 1] * two[:, 0]) / (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    return np.asarray(square[:, 0] + share[:, None] * one)


def find_board(markers: Markers, size: tuple[int, int], shape: tuple[int, ...]) -> Board | None:
    """Return the board that most markers agree with, of the new or the legacy pattern, None where fewer than 4 do.

    Where the board has an odd number of columns the patterns differ by one column for all markers but those at the
    sides: among equals the one counts by which fewer markers ought to be seen in the picture of `shape` (H, W) that
    are not, and the new one if a part of the board is seen that belongs to both.
    """
    boards = [_board(markers, size, legacy) for legacy in ((False, True) if size[1] % 2 == 0 else (False,))]
    found = [board for board in boards if board is not None]
    return max(found, key=lambda board: (len(board.place), -_expected_in(board, size, shape)), default=None)


def _expected_in(board: Board, size: tuple[int, int], shape: tuple[int, ...]) -> int:
    """Return how many of a board's markers lie in the picture as a whole."""
    places = _places(size, board.legacy)
    square = places[:, None, :] + np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    corners = apply(np.asarray(np.linalg.inv(board.lattice_from_px)), square.reshape(-1, 2)).reshape(-1, 4, 2)
    return int(((corners > 0) & (corners < [shape[1] - 1, shape[0] - 1])).all(axis=(1, 2)).sum())


def _board(markers: Markers, size: tuple[int, int], legacy: bool) -> Board | None:
    """Return the board of one pattern: its markers' centres fit a homography, and their edges its directions."""
    import cv2

    places = _places(size, legacy)
    known = markers.number < len(places)
    if known.sum() < _FEWEST:
        return None
    place, centre, upper = places[markers.number[known]], markers.centre_px[known], markers.upper_px[known]
    found, _ = cv2.findHomography(centre, place, cv2.RANSAC, _TOLERANCE)
    if found is None:
        return None
    homography = np.asarray(found, dtype=np.float64)
    good = _agree(homography, place, centre, upper)
    if good.sum() < _FEWEST:
        return None
    return Board(place[good], centre[good], homography, legacy, len(markers.number))


def _agree(homography: FloatArray, place: FloatArray, centre: FloatArray, upper: FloatArray) -> BoolArray:
    """Return which markers (N,) lie where the homography puts them, turned as it has it."""
    at, beside = apply(homography, centre), apply(homography, centre + 0.25 * upper)
    way = beside - at
    aligned = way[:, 0] > _ALIGNED * np.linalg.norm(way, axis=1)
    return np.asarray((np.linalg.norm(at - place, axis=1) < _TOLERANCE) & aligned)


def apply(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 2) mapped by a homography (3, 3)."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def find_dictionary(grey: NDArray[np.uint8], size: tuple[int, int]) -> str | None:
    """Return the predefined dictionary with which most markers fit a board of `size` squares, None where none do.

    Of a family of dictionaries that begin alike the smallest with enough markers; the families are tried in the order
    of their use until one explains half of the board.
    """
    wanted = markers_on(size, False)
    best, most = None, 0
    for family in _FAMILIES:
        name = next((name for name in family if len(_dictionary(name).bytesList) >= wanted), None)
        if name is None:
            continue
        board = find_board(find_markers(grey, name, wanted + 1), size, grey.shape)
        if board is not None and len(board.place) > most:
            best, most = name, len(board.place)
        if 2 * most >= wanted:
            break
    return best


# Grids of round dots in a picture: their places in the lattice and the centres of the ellipses that are seen.


LEAST_DOTS = 12
WINDOWS = (1 / 6, 1 / 20, 2 / 5)
ROUGHNESS = (0.5, 0.06)
OFF_LATTICE = 0.1
QUARTER_TURN = np.array([[0, -1], [1, 0]])


class _Failure(NamedTuple):
    """Why an attempt failed, and how many dots it had found."""

    dots: int
    reason: str


@dataclass(frozen=True, eq=False)
class _Grid:
    """Dots with sub-pixel ellipses and places on a lattice that is turned and, if need be, mirrored to be right-handed
    in the picture (first index to the right, second down, if turned suitably).

    `ring` (N,): which are ring markers; `jacobian` (N, 2, 2): pixels per lattice step.
    """  # fmt: skip

    index: IntArray
    ellipses: Ellipses
    ring: BoolArray
    jacobian: FloatArray


def find_dots(image: NDArray[Any], target: Target, name: str, full_scale: int) -> TargetView:
    """Return the dots of a target of kind "dots" or "asymmetric-dots" in a picture (H, W).

    With three ring markers (dots with a hole) the places count from the ring at the corner of their L: the longer arm
    is x, the shorter one y, and y points up in the picture when x points to the right; the dots may run over the
    picture's edge. Arms of the same length are told apart by that handedness. Dots cut by the edge are left out.

    Without rings all `target.size` dots must be seen, and places count from a corner: first index to the right, second
    down, turned such that the first runs to the right as far as the grid's symmetry leaves a choice (half turns, of a
    square grid quarter turns). A plain grid cannot show whether the picture is mirrored. An asymmetric one has the
    places (2 i + j mod 2, j), i-th dot of row j, as in OpenCV; with an odd number of rows its half turns and mirroring
    are told apart or not as its symmetry allows.

    Dark dots on bright and bright dots on dark are both found. Raises `TargetNotFound` with what is wrong.
    """
    check_shape("image", image, (None, None))
    failures = [_Failure(0, "no dots")]
    for share in WINDOWS:
        for blobs in find_blobs(image, share * max(image.shape)):
            found = _attempt(image, blobs, target, name, full_scale)
            if isinstance(found, TargetView):
                return found
            failures.append(found)
    worth = max(failures, key=lambda failure: failure.dots)
    fault = picture_fault(image, full_scale) if worth.dots < LEAST_DOTS else None
    raise TargetNotFound(fault or worth.reason)


def _attempt(image: NDArray[Any], blobs: Blobs, target: Target, name: str, full_scale: int) -> TargetView | _Failure:
    """The view that these patches are, or why they are none."""
    lattice = find_lattice(blobs.centre_px, blobs.shape_px2)
    if len(lattice.member) < LEAST_DOTS:
        return _too_few(len(lattice.member))
    grid = _measure(image, blobs, lattice)
    dots = len(grid.index)
    if dots < LEAST_DOTS:
        return _Failure(
            dots, f"no round dots: {len(lattice.member)} patches on a lattice, but only {dots} are elliptic"
        )
    spacing_px = float(np.median(_spacing(grid.jacobian)))
    check_exposure(image, outline(grid.ellipses.centre_px), full_scale)
    check_blur(float(np.median(grid.ellipses.blur_px)), spacing_px)
    places = _dots_places(grid, target, image.shape)
    if isinstance(places, str):
        return _Failure(dots, places)
    return _view(grid, places, name, image.shape)


def _too_few(dots: int) -> _Failure:
    """What to say of a picture with hardly any dots."""
    return _Failure(
        dots, f"no grid of dots: {dots} on a lattice, at least {LEAST_DOTS} are needed" if dots else "no dots"
    )


def _measure(image: NDArray[Any], blobs: Blobs, lattice: Lattice) -> _Grid:
    """Fit the ellipses and keep the dots that are round and on the lattice."""
    member, index = lattice.member, lattice.index
    shape, ring = blobs.shape_px2[member], blobs.ring[member]
    _, jacobian = local_fit(index, blobs.centre_px[member])
    minor = np.sqrt(np.linalg.eigvalsh(shape)[:, 0])
    apart = _spacing(jacobian) / blobs.radius_px[member]
    reach = np.nan_to_num((apart / 2 - 1) * minor)
    ellipses = fit_ellipses(image, blobs.centre_px[member], shape, reach, ring)
    good = ellipses.roughness_px < np.maximum(ROUGHNESS[0], ROUGHNESS[1] * ellipses.radius_px)
    off, jacobian = local_fit(index[good], ellipses.centre_px[good])
    good[good] = off < OFF_LATTICE
    jacobian = jacobian[off < OFF_LATTICE]
    flip = np.array([1, -1 if len(jacobian) and np.median(np.linalg.det(jacobian)) < 0 else 1])
    return _Grid(index[good] * flip, _select(ellipses, good), ring[good], jacobian * flip)


def _spacing(jacobian: FloatArray) -> FloatArray:
    """Lattice step (N,) in px: the root of the area of a cell, NaN without a Jacobian."""
    return np.asarray(np.sqrt(np.abs(jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0])))


def _select(ellipses: Ellipses, kept: BoolArray) -> Ellipses:
    """The ellipses that are kept."""
    return Ellipses(**{name: value[kept] for name, value in vars(ellipses).items()})


def _dots_places(grid: _Grid, target: Target, shape: tuple[int, ...]) -> IntArray | str:
    """Places (N, 2) in the target's lattice, or why there are none."""
    rings = int(grid.ring.sum())
    if target.kind == "dots" and rings == 3:
        return _places_from_rings(grid)
    if target.kind == "dots" and rings:
        edge = "runs over the edge of the picture, " if rings < 3 and _leaves(grid, shape) else ""
        return f"{edge}{rings} of {len(grid.index)} dots are ring markers, expected three"
    if target.size is None:
        return f"no ring markers among {len(grid.index)} dots: give the number of dots, columns x rows"
    return _places_from_size(grid, target, target.size, shape)


def _places_from_rings(grid: _Grid) -> IntArray | str:
    """Places from the ring at the corner of the L, x along the longer arm, y the shorter."""
    rings = grid.index[grid.ring]
    for corner in range(3):
        arms = np.delete(rings, corner, axis=0) - rings[corner]
        lengths = np.abs(arms).sum(axis=1)
        if (np.abs(arms).max(axis=1) < lengths).any() or arms[0] @ arms[1] != 0:
            continue
        axes = arms // lengths[:, None]
        up = np.linalg.det(axes) < 0
        if (lengths[0] < lengths[1]) or (lengths[0] == lengths[1] and not up):
            axes, up = axes[::-1], not up
        if not up:
            return "mirrored: the ring markers run the wrong way round"
        return np.asarray((grid.index - rings[corner]) @ axes.T)
    return "the three ring markers do not form an L"


def _places_from_size(grid: _Grid, target: Target, size: tuple[int, int], shape: tuple[int, ...]) -> IntArray | str:
    """Places from the corner of a full grid."""
    asymmetric = target.kind == "asymmetric-dots"
    columns, rows = size
    wanted = {(2 * i + j % 2 if asymmetric else i, j) for i in range(columns) for j in range(rows)}
    basis = np.array([[1, -1], [1, 1]]) if asymmetric else np.eye(2, dtype=np.int64)
    mean = grid.jacobian.mean(axis=0) @ np.linalg.inv(basis)
    turns = [np.asarray(np.linalg.matrix_power(QUARTER_TURN, turn), dtype=np.int64) for turn in range(4)]
    turned = [(axes, _from_corner(grid.index @ basis.T @ axes.T)) for axes in turns]
    fitting = [(_rightward(mean @ axes.T), places) for axes, places in turned if _same(places, wanted)]
    if fitting:
        return max(fitting, key=lambda fit: fit[0])[1]
    if any(_same(_from_corner(places * np.array([-1, 1])), wanted) for _, places in turned):
        return "mirrored: the rows of the dots are shifted the wrong way"
    edge = "runs over the edge of the picture: " if _leaves(grid, shape) else ""
    if edge or len(grid.index) < len(wanted):
        return f"{edge}{len(grid.index)} dots on a lattice, expected all {columns} x {rows}"
    extent = np.ptp(grid.index, axis=0) + 1
    return f"another grid: {len(grid.index)} dots within {extent[0]} x {extent[1]} places, expected {columns} x {rows}"


def _rightward(jacobian: FloatArray) -> float:
    """Cosine between the first index's direction and the picture's x."""
    return float(jacobian[0, 0] / np.linalg.norm(jacobian[:, 0]))


def _from_corner(index: IntArray) -> IntArray:
    """Places counted from the least of both indices."""
    return np.asarray(index - index.min(axis=0))


def _same(places: IntArray, wanted: set[tuple[int, int]]) -> bool:
    """Whether the places are exactly those wanted."""
    return len(places) == len(wanted) and set(map(tuple, places.tolist())) == wanted


def _leaves(grid: _Grid, shape: tuple[int, ...]) -> bool:
    """Whether the next dots beyond the lattice would not be wholly in the picture."""
    steps = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    beyond = grid.ellipses.centre_px[:, None] + np.einsum("nab,kb->nka", grid.jacobian, steps)
    empty = ~(grid.index[:, None, None] + steps[:, None] == grid.index).all(axis=3).any(axis=2)
    margin = grid.ellipses.radius_px[:, None, None]
    outside = ((beyond < margin) | (beyond > np.array(shape[::-1]) - 1 - margin)).any(axis=2)
    return bool((empty & outside).any())


def _view(grid: _Grid, places: IntArray, name: str, shape: tuple[int, ...]) -> TargetView:
    """The view with the dots in the order of their places."""
    ellipses = grid.ellipses
    _, jacobian = local_fit(places, ellipses.centre_px)
    radius = ellipses.radius_px / _spacing(jacobian)
    order = np.lexsort(places.T)
    return TargetView(
        name=name,
        index=places[order],
        position_px=ellipses.centre_px[order],
        covariance_px2=ellipses.covariance_px2[order],
        radius=float(np.nanmedian(radius[~grid.ring])),
        blur_px=float(np.median(ellipses.blur_px)),
        size_px=np.array(shape[::-1], dtype=np.int64),
    )


# One door to all targets.


def find_target(image: GreyImage, target: Target, name: str, full_scale: int) -> TargetView:
    """Return the points of `target` in a picture (H, W) called `name`; `full_scale` is its largest grey value.

    Raises `TargetNotFound` with what is wrong with the picture.
    """
    if target.kind == "chessboard":
        from photogram.targets.chessboard import find_chessboard

        return find_chessboard(image, target, name, full_scale)
    if target.kind == "charuco":
        from photogram.targets.chessboard import find_charuco

        return find_charuco(image, target, name, full_scale)

    return find_dots(image, target, name, full_scale)
