"""Printed patterns of calibration targets for rendering: squares, tags and dots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram.targets.target_view import Target
from shakercal._common.arrays import FloatArray


@dataclass(frozen=True)
class Board:
    """A printed target for rendering: black on a white sheet.

    Lengths are in units of the target's spacing, in the frame of `Target`.

    Attributes
    ----------
    target : Kind, spacing and size.
    radius : Of dots; default 0.3.
    rings : Positions (x, y) of the ring markers at (x, 0) and (0, y), in addition to the one at (0, 0); None for dots
        without.
    hole : Radius of the white hole in a ring; default 0.15.
    lattice : First column, last column, first row, last row of the dots around ring markers.
    legacy : ChArUco pattern of OpenCV before 4.6; default False.
    marker_share : Side of a ChArUco marker; default 0.75.
    border : Width of the black border of an AprilGrid's tags, in bits; default 2, Kalibr's.
    turns : Quarter turns of these tags, anticlockwise; default 0.
    margin : Of the sheet beyond the outermost squares or dots' centres; default 1.
    bright, dark, background : Grey levels, fractions of full scale, of the sheet, the print, and around it.

    Examples
    --------
    >>> Board(Target("dots", 5e-3, (7, 5)), radius=0.25).points_m.shape
    (35, 3)
    """

    target: Target
    radius: float = 0.3
    rings: tuple[int, int] | None = None
    hole: float = 0.15
    lattice: tuple[int, int, int, int] = (-5, 10, -5, 8)
    legacy: bool = False
    marker_share: float = 0.75
    border: int = 2
    turns: int = 0
    margin: float = 1.0
    bright: float = 0.80
    dark: float = 0.08
    background: float = 0.25

    def __post_init__(self) -> None:
        if self.target.kind == "charuco" and self.target.dictionary is None:
            raise ValueError("target: expected the dictionary of a ChArUco board, found none")
        if self.target.kind == "dots" and (self.target.size is None) != (self.rings is not None):
            raise ValueError(f"rings: expected them where the target has no size, found {self.rings}")

    @property
    def index(self) -> FloatArray:
        """Lattice indices (N, 2), integers, of all corners or dots."""
        if self.target.size is None:
            return _lattice(*self.lattice)
        columns, rows = self.target.size
        if self.target.kind == "charuco":
            return _lattice(0, columns - 2, 0, rows - 2)
        if self.target.kind == "aprilgrid":
            return _lattice(0, 2 * columns - 1, 0, 2 * rows - 1)
        if self.target.kind == "asymmetric-dots":
            points = _lattice(0, columns - 1, 0, rows - 1)
            return np.column_stack([2 * points[:, 0] + points[:, 1] % 2, points[:, 1]])
        return _lattice(0, columns - 1, 0, rows - 1)

    @property
    def points_m(self) -> FloatArray:
        """Positions (N, 3) of `index` in the target's frame."""
        return self.target.points_m(self.index)

    @property
    def extent_m(self) -> FloatArray:
        """Limits of the sheet in the target's frame (4,): x and y."""
        beyond = {"chessboard": 1.0, "charuco": 1.0, "aprilgrid": self.target.tag_spacing or 0.0}
        edge, points = self.margin + beyond.get(self.target.kind, 0.0), self.target.lattice(self.index)
        (x0, y0), (x1, y1) = points.min(axis=0) - edge, points.max(axis=0) + edge
        return np.array([x0, x1, y0, y1]) * self.target.spacing_m


def _lattice(first_column: int, last_column: int, first_row: int, last_row: int) -> FloatArray:
    i, j = np.meshgrid(np.arange(first_column, last_column + 1.0), np.arange(first_row, last_row + 1.0))
    return np.column_stack([i.ravel(), j.ravel()])


def tiles(board: Board) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return edges (X,), (Y,) in spacings, and grey levels (Y + 1, X + 1)."""
    columns, rows = board.target.size or (0, 0)
    if board.target.kind == "aprilgrid":
        return _aprilgrid_tiles(board, columns, rows)
    if board.target.kind == "chessboard":
        columns, rows = columns + 1, rows + 1
        cells = np.add.outer(np.arange(rows), np.arange(columns))[:, :, None, None] % 2
        inner = np.array([0.0])
    else:
        cells, inner = _charuco_cells(board, columns, rows)
    size = cells.shape[2]
    black_white = cells.transpose(0, 2, 1, 3).reshape(rows * size, columns * size)
    grey = board.dark + (board.bright - board.dark) * np.pad(black_white, 1, constant_values=1)
    levels = np.pad(grey, 1, constant_values=board.background)
    edges = [
        np.concatenate(
            [[-1 - board.margin], (np.arange(n)[:, None] - 1 + inner).ravel(), [n - 1, n - 1 + board.margin]]
        )
        for n in (columns, rows)
    ]
    return edges[0], edges[1], levels.astype(np.float64)


def _aprilgrid_tiles(board: Board, columns: int, rows: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return edges and grey levels of an AprilGrid.

    Tags from the lower left, y up, squares at their corners.
    """
    import cv2

    gap, bits = board.target.tag_spacing or 0.0, 6 + 2 * board.border
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    edges = []
    for count in (columns, rows):
        inner = (np.arange(count)[:, None] * (1 + gap) + np.linspace(0, 1, bits + 1)).ravel()
        last = inner[-1] + gap
        edges.append(np.concatenate([[-gap - board.margin, -gap], inner, [last, last + board.margin]]))
    black = np.zeros((len(edges[1]) + 1, len(edges[0]) + 1))
    starts = [3 + np.arange(count) * (bits + 1) for count in (columns, rows)]
    for number in range(columns * rows):
        row, column = divmod(number, columns)
        tag = cv2.aruco.generateImageMarker(dictionary, number + (board.target.first_id or 0), bits, None, board.border)
        at = starts[1][row], starts[0][column]
        black[at[0] : at[0] + bits, at[1] : at[1] + bits] = np.rot90(tag == 0, board.turns)[::-1]
        for down in (at[0] - 1, at[0] + bits):
            black[down, [at[1] - 1, at[1] + bits]] = 1.0
    levels = board.bright + (board.dark - board.bright) * black
    levels[[0, -1]], levels[:, [0, -1]] = board.background, board.background
    return edges[0], edges[1], levels


def _charuco_cells(board: Board, columns: int, rows: int) -> tuple[FloatArray, FloatArray]:
    """Return the squares with markers, 0 black and 1 white, and a square's edges."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(board.target.dictionary)))
    bits = dictionary.markerSize + 2
    odd = 1 if board.legacy and rows % 2 == 0 else 0
    cells = np.zeros((rows, columns, bits + 2, bits + 2))
    marker = board.target.first_id or 0
    for row in range(rows):
        for column in range(columns):
            if (row + column) % 2 != odd:
                cells[row, column] = 1.0
                image = cv2.aruco.generateImageMarker(dictionary, marker, bits)
                cells[row, column, 1:-1, 1:-1] = image > 0
                marker += 1
    start = (1 - board.marker_share) / 2
    inner = np.concatenate([[0.0], np.linspace(start, 1 - start, bits + 1)])
    return cells, inner


def spots(board: Board) -> tuple[FloatArray, FloatArray]:
    """Return radius and hole (rows, columns, 2) of the dots, and the first point."""
    index = board.index.astype(np.int64)
    first = index.min(axis=0)
    columns, rows = index.max(axis=0) - first + 1
    dots = np.zeros((rows, columns, 2))
    column, row = (index - first).T
    dots[row, column, 0] = board.radius
    if board.rings is not None:
        x, y = board.rings
        for i, j in ((0, 0), (x, 0), (0, y)):
            dots[j - first[1], i - first[0], 1] = board.hole
    return dots, first.astype(np.float64)
