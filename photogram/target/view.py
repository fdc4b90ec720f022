"""A calibration target, and what one picture shows of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from photogram._checks import FloatArray, IntArray, check_shape

TargetKind = Literal["chessboard", "charuco", "dots", "asymmetric-dots"]


@dataclass(frozen=True)
class Target:
    """A flat target whose points lie on a square lattice.

    `spacing_m`: distance of neighbouring lattice points. Chessboard and ChArUco: the side of a square; dots: centre to
    centre; asymmetric dots: distance of neighbouring rows, half that of dots in a row.
    `size`: columns and rows; of a chessboard its inner corners, of a ChArUco board its squares, of dots the dots
    (asymmetric: dots in a row, rows). None only for dots with three ring markers, which name their neighbours.
    `dictionary`: name of the ArUco dictionary, None to find it.
    """

    kind: TargetKind
    spacing_m: float
    size: tuple[int, int] | None = None
    dictionary: str | None = None

    def __post_init__(self) -> None:
        """Refuse a target without extent."""
        if not self.spacing_m > 0:
            raise ValueError(f"spacing_m: expected a length above 0, found {self.spacing_m}")
        if self.size is None and self.kind != "dots":
            raise ValueError(f"size: expected columns and rows of the {self.kind} target, found none")
        if self.size is not None and min(self.size) < 2:
            raise ValueError(f"size: expected at least 2 columns and rows, found {self.size[0]} x {self.size[1]}")


@dataclass(frozen=True, eq=False)
class TargetView:
    """The points of a target in one picture.

    `name`: of the picture. `index` (N, 2): column and row of each point in the target's lattice, each pair once, so
    that it lies at spacing·(column, row, 0) in the target's frame. `position_px` (N, 2): sub-pixel positions: for
    corners the crossing itself, for dots the centre of the ellipse that is seen (`radius` > 0), which perspective moves
    off the image of the dot's centre. `covariance_px2` (N, 2, 2): from the picture's noise. `radius`: of the dots in
    units of the lattice spacing, 0 for corners. `blur_px`: σ of the edges' blur, median over the points. `size_px`
    (2,): width and height of the picture.
    """

    name: str
    index: IntArray
    position_px: FloatArray
    covariance_px2: FloatArray
    radius: float
    blur_px: float
    size_px: IntArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together and points named twice."""
        check_shape("index", self.index, (None, 2))
        check_shape("position_px", self.position_px, (len(self.index), 2))
        check_shape("covariance_px2", self.covariance_px2, (len(self.index), 2, 2))
        check_shape("size_px", self.size_px, (2,))
        if len(np.unique(self.index, axis=0)) < len(self.index):
            raise ValueError("index: expected each point once, found one twice")


class TargetNotFound(ValueError):
    """No target, or none that may be used, in a picture; the text says what is wrong with the picture."""
