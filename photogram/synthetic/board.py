"""Pictures of calibration targets with known truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray
from photogram.camera import Camera
from photogram.rigid import RigidTransform
from photogram.synthetic.board_pixels import render_dots, render_tiles
from photogram.target.view import Target

_FINER = 2  # pixels are drawn as so many squares across
_SOFT_PX = 0.5  # softening of the drawn edges, in these


@dataclass(frozen=True)
class Board:
    """A printed target: black on a white sheet, in the frame of `Target`, lengths in units of its spacing.

    `radius` of dots. `rings`: places (x, y) of the ring markers beside the one at (0, 0), that is at (x, 0) and
    (0, y), None for dots without; `hole`: radius of the white hole in a ring. `lattice`: first column, last column,
    first row, last row of the dots around ring markers. `legacy`: ChArUco pattern of OpenCV before 4.6;
    `marker_share`: side of a marker. `margin`: of the sheet beyond the outermost squares or dots' centres.
    `bright`, `dark`, `background`: grey levels, fractions of full scale, of the sheet, the print, and around it.
    """

    target: Target
    radius: float = 0.3
    rings: tuple[int, int] | None = None
    hole: float = 0.15
    lattice: tuple[int, int, int, int] = (-5, 10, -5, 8)
    legacy: bool = False
    marker_share: float = 0.75
    margin: float = 1.0
    bright: float = 0.80
    dark: float = 0.08
    background: float = 0.25

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        if self.target.kind == "charuco" and self.target.dictionary is None:
            raise ValueError("target: expected the dictionary of a ChArUco board to draw, found none")
        if self.target.kind == "dots" and (self.target.size is None) != (self.rings is not None):
            raise ValueError(f"rings: expected them where the target has no size, found {self.rings}")

    @property
    def index(self) -> FloatArray:
        """Lattice indices (N, 2), whole numbers, of all corners or dots."""
        if self.target.size is None:
            first_column, last_column, first_row, last_row = self.lattice
            return _lattice(first_column, last_column, first_row, last_row)
        columns, rows = self.target.size
        if self.target.kind == "charuco":
            return _lattice(0, columns - 2, 0, rows - 2)
        if self.target.kind == "asymmetric-dots":
            points = _lattice(0, columns - 1, 0, rows - 1)
            return np.column_stack([2 * points[:, 0] + points[:, 1] % 2, points[:, 1]])
        return _lattice(0, columns - 1, 0, rows - 1)

    @property
    def points_m(self) -> FloatArray:
        """Positions (N, 3) of `index` in the target's frame."""
        return np.column_stack([self.index, np.zeros(len(self.index))]) * self.target.spacing_m

    @property
    def extent_m(self) -> FloatArray:
        """First and last x, first and last y (4,) of the sheet in the target's frame."""
        edge = self.margin + (1.0 if self.target.kind in {"chessboard", "charuco"} else 0.0)
        (x0, y0), (x1, y1) = self.index.min(axis=0) - edge, self.index.max(axis=0) + edge
        return np.array([x0, x1, y0, y1]) * self.target.spacing_m


def _lattice(first_column: int, last_column: int, first_row: int, last_row: int) -> FloatArray:
    """Return the index pairs of a rectangle of lattice points, row by row."""
    i, j = np.meshgrid(np.arange(first_column, last_column + 1.0), np.arange(first_row, last_row + 1.0))
    return np.column_stack([i.ravel(), j.ravel()])


def render_board(
    camera: Camera,
    camera_from_target: RigidTransform,
    board: Board,
    blur_px: float = 0.7,
    falloff: float = 0.12,
    slant: float = 0.0,
) -> FloatArray:
    """Return the noise-free picture (H, W), fractions of full scale, of a board.

    The lens blurs the picture by a Gaussian of σ `blur_px`, the same everywhere and in all directions: the pattern is
    drawn at half the pixel's width with edges softened just enough (0.5 of these pixels) to be sampled, convolved with
    the rest of the Gaussian, and averaged over each pixel's square. Light falls off by `falloff` to the corners of the
    picture and rises by `slant` from its left to its right edge.
    """
    from scipy.ndimage import gaussian_filter

    if _FINER * blur_px < _SOFT_PX:
        raise ValueError(f"blur_px: expected a blur of at least {_SOFT_PX / _FINER} px, found {blur_px}")
    fine = _with_finer_pixels(camera)
    sharp = _drawn(fine, camera_from_target, board, _SOFT_PX)
    rest = math.sqrt((_FINER * blur_px) ** 2 - _SOFT_PX**2)
    blurred = gaussian_filter(sharp, rest, mode="nearest", truncate=6.0)
    width, height = (int(n) for n in camera.size_px)
    picture = blurred.reshape(height, _FINER, width, _FINER).mean(axis=(1, 3))
    return np.asarray(picture * _light(width, height, falloff, slant))


def _with_finer_pixels(camera: Camera) -> Camera:
    """Return the camera with each pixel divided into squares."""
    matrix = camera.matrix * _FINER
    matrix[:2, 2] += (_FINER - 1) / 2
    matrix[2, 2] = 1.0
    return Camera(matrix, camera.distortion, camera.size_px * _FINER)


def _drawn(camera: Camera, camera_from_target: RigidTransform, board: Board, soft_px: float) -> FloatArray:
    """Return the pattern (H, W) with edges softened in its plane, `soft_px` at the magnification of its middle."""
    spacing = board.target.spacing_m
    plane_to_ray = camera_from_target.rotation * [spacing, spacing, 1.0]
    plane_to_ray[:, 2] = camera_from_target.translation_m
    homography = np.linalg.inv(plane_to_ray)
    sigma = soft_px / _magnification(camera, camera_from_target, board)
    width, height = (int(n) for n in camera.size_px)
    if board.target.kind in {"chessboard", "charuco"}:
        picture = np.empty((height, width))
        edges_x, edges_y, tiles = _tiles(board)
        render_tiles(camera.parameters, homography, edges_x, edges_y, tiles, sigma, picture)
        return picture
    shares = np.empty((height, width, 2))
    spots, first = _spots(board)
    render_dots(camera.parameters, homography, spots, first, board.extent_m / spacing, sigma, shares)
    sheet = board.bright - (board.bright - board.dark) * shares[..., 0]
    return np.asarray(board.background + (sheet - board.background) * shares[..., 1])


def _magnification(camera: Camera, camera_from_target: RigidTransform, board: Board) -> float:
    """Return pixels per spacing at the middle of the board."""
    x0, x1, y0, y1 = board.extent_m
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
    step = 1e-3 * board.target.spacing_m
    around = middle + step * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    pixels = camera.project(camera_from_target.apply(around))
    slope = np.stack([pixels[0] - pixels[1], pixels[2] - pixels[3]]) / 2e-3
    return float(np.sqrt(np.abs(np.linalg.det(slope))))


def _light(width: int, height: int, falloff: float, slant: float) -> FloatArray:
    """Return the brightness (H, W): 1 in the middle, less towards the corners, rising from left to right."""
    x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
    return np.asarray(1 + slant / 2 * x - falloff * (x**2 + y**2) / 2)


def _tiles(board: Board) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return edges x (X,), y (Y,), in spacings, and the grey levels (Y + 1, X + 1) between and beyond them.

    One rectangular grid holds squares and markers: the markers of a column of squares share their edges.
    """
    columns, rows = board.target.size or (0, 0)
    if board.target.kind == "chessboard":
        columns, rows = columns + 1, rows + 1
        cells = np.add.outer(np.arange(rows), np.arange(columns))[:, :, None, None] % 2
        inner = np.array([0.0])
    else:
        cells, inner = _charuco_cells(board, columns, rows)
    size = cells.shape[2]
    black_white = cells.transpose(0, 2, 1, 3).reshape(rows * size, columns * size)
    grey = board.dark + (board.bright - board.dark) * np.pad(black_white, 1, constant_values=1)
    tiles = np.pad(grey, 1, constant_values=board.background)
    edges = [
        np.concatenate(
            [[-1 - board.margin], (np.arange(n)[:, None] - 1 + inner).ravel(), [n - 1, n - 1 + board.margin]]
        )
        for n in (columns, rows)
    ]
    return edges[0], edges[1], tiles.astype(np.float64)


def _charuco_cells(board: Board, columns: int, rows: int) -> tuple[FloatArray, FloatArray]:
    """Return the squares (rows, columns, B + 4, B + 4), 0 black and 1 white, with markers, and a square's edges."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(board.target.dictionary)))
    bits = dictionary.markerSize + 2
    odd = 1 if board.legacy and rows % 2 == 0 else 0
    cells = np.zeros((rows, columns, bits + 2, bits + 2))
    marker = 0
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


def _spots(board: Board) -> tuple[FloatArray, FloatArray]:
    """Return radius and hole (rows, columns, 2) of the dots on the lattice, and its first point (2,)."""
    index = board.index.astype(np.int64)
    first = index.min(axis=0)
    columns, rows = index.max(axis=0) - first + 1
    spots = np.zeros((rows, columns, 2))
    column, row = (index - first).T
    spots[row, column, 0] = board.radius
    if board.rings is not None:
        x, y = board.rings
        for i, j in ((0, 0), (x, 0), (0, y)):
            spots[j - first[1], i - first[0], 1] = board.hole
    return spots, first.astype(np.float64)
