"""A target in an image: image points with covariance, and checks of the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photogram.images.noise import NoiseModel, fit_noise_model
from shakercal._common.arrays import Arrays, FloatArray, IntArray, check_shape

SHORTEST_M, LONGEST_M = 1e-4, 2.0  # of plausible targets
TargetKind = Literal["chessboard", "charuco", "aprilgrid", "dots", "asymmetric-dots"]


MOST_POINTS, LONGEST_SIDE = 20_000, 1000
"""Of a target: fine ones have some thousand points, and the memory of an adjustment grows with their number."""
SMALLEST_GAP = 0.05  # between two tags, over the side of a tag: a corner needs some pixels of each gap
LARGEST_ID = 2319  # of the largest of OpenCV's dictionaries, that of AprilTags 36h10
APRILGRID_TAGS = "DICT_APRILTAG_36h11"  # Kalibr's only family


@dataclass(frozen=True)
class Target:
    """A flat target whose points lie on a square lattice, of an AprilGrid in pairs.

    Attributes
    ----------
    kind : "chessboard", "charuco", "aprilgrid", "dots" or "asymmetric-dots".
    spacing_m : distance of neighbouring lattice points. Chessboard and ChArUco: the side of a square; AprilGrid: the
        side of a tag; dots: centre to centre; asymmetric dots: distance of neighbouring rows, half that of dots in a
        row.
    size : columns and rows; of a chessboard its inner corners, of a ChArUco board its squares, of an AprilGrid its
        tags, of dots the dots (asymmetric: dots in a row, rows). None only for dots with three ring markers, which
        identify their neighbours.
    dictionary : name of the ArUco dictionary, None (default) to find it.
    tag_spacing : gap between two tags of an AprilGrid over the side of a tag, Kalibr's `tagSpacing`; None otherwise.
    first_id : number of the first marker of a ChArUco board or an AprilGrid. Stated, markers that are not the board's
        belong to others and are ignored; None (default): 0, and there are no others.

    Examples
    --------
    >>> Target("chessboard", spacing_m=9e-3, size=(10, 7)).size
    (10, 7)
    """

    kind: TargetKind
    spacing_m: float
    size: tuple[int, int] | None = None
    dictionary: str | None = None
    tag_spacing: float | None = None
    first_id: int | None = None

    def __post_init__(self) -> None:
        if not self.spacing_m > 0:
            raise ValueError(f"spacing_m: expected a length above 0, found {self.spacing_m}")
        if self.size is None and self.kind != "dots":
            raise ValueError(f"size: expected columns and rows of the {self.kind} target, found none")
        self._check_tags()
        fewest = 3 if self.kind == "chessboard" else 2
        if self.size is not None and min(self.size) < fewest:
            least = f"at least {fewest} columns and rows of a {self.kind} target"
            raise ValueError(f"size: expected {least}, found {self.size[0]} x {self.size[1]}")
        if self.size is not None and (max(self.size) > LONGEST_SIDE or (self.points or 0) > MOST_POINTS):
            most = f"at most {LONGEST_SIDE} columns, {LONGEST_SIDE} rows and {MOST_POINTS} points"
            raise ValueError(f"size: expected {most}, found {self.size[0]} x {self.size[1]}")

    def _check_tags(self) -> None:
        """Raise `ValueError` for wrong properties of boards with markers."""
        marked = self.kind in ("charuco", "aprilgrid")
        if self.first_id is not None and not (marked and 0 <= self.first_id <= LARGEST_ID):
            expected = f"a number from 0 to {LARGEST_ID}, of a target with markers"
            raise ValueError(f"first_id: expected {expected}, found {self.first_id} of the {self.kind} target")
        if self.kind != "aprilgrid":
            if self.tag_spacing is not None:
                raise ValueError(f"tag_spacing: expected none of the {self.kind} target, found {self.tag_spacing}")
        elif self.tag_spacing is None or not SMALLEST_GAP <= self.tag_spacing <= 1:
            found = "none" if self.tag_spacing is None else f"{self.tag_spacing:g}"
            expected = f"the gap between two tags over the side of a tag, {SMALLEST_GAP:g} to 1"
            raise ValueError(f"tag_spacing: expected {expected}, found {found}")
        if self.kind == "aprilgrid" and self.dictionary not in (None, APRILGRID_TAGS):
            raise ValueError(f"dictionary: expected {APRILGRID_TAGS} of an AprilGrid, found {self.dictionary}")

    def lattice(self, index: IntArray | FloatArray) -> FloatArray:
        """Return the positions (N, 2), in spacings, of points `index` (N, 2)."""
        if self.tag_spacing is None:
            return np.asarray(index, dtype=np.float64)
        tag, corner = np.divmod(np.asarray(index), 2)
        return np.asarray(tag * (1 + self.tag_spacing) + corner, dtype=np.float64)

    def points_m(self, index: IntArray | FloatArray) -> FloatArray:
        """Return positions (N, 3) in m, in the target's frame, of points `index` (N, 2)."""
        return np.column_stack([self.lattice(index) * self.spacing_m, np.zeros(len(index))])

    @property
    def cell_m(self) -> float:
        """Smallest distance of two neighbouring points."""
        return self.spacing_m * (1.0 if self.tag_spacing is None else min(self.tag_spacing, 1.0))

    @property
    def points(self) -> int | None:
        """Number of its points; None for dots with ring markers."""
        if self.size is None:
            return None
        columns, rows = self.size
        return {"charuco": (columns - 1) * (rows - 1), "aprilgrid": 4 * columns * rows}.get(self.kind, columns * rows)

    @property
    def length_m(self) -> float:
        """Approximate length of its longer side; of dots of unknown number that of ten."""
        return self.spacing_m * (10 if self.size is None else max(self.size))

    @property
    def is_likely(self) -> bool:
        """Whether a target of this length is plausible: 0.1 mm to 2 m.

        Otherwise its spacing may be in another unit.
        """
        return SHORTEST_M <= self.length_m <= LONGEST_M


@dataclass(frozen=True, eq=False, repr=False)
class TargetView(Arrays, shapes="index N 2; position_px N 2; covariance_px2 N 2 2; size_px 2"):
    """The points of a target in one image.

    Attributes
    ----------
    name : of the image.
    index : (N, 2) column and row of each point in the target's lattice, each pair once; `Target.points_m` gives its
        position in the target's frame, spacing·(column, row, 0) unless the target is an AprilGrid.
    position_px : (N, 2) sub-pixel positions: for corners the crossing itself, for dots the centre of the visible
        ellipse (`radius` > 0), which perspective displaces from the image of the dot's centre.
    covariance_px2 : (N, 2, 2) from the image's noise.
    radius : of the dots in units of the lattice spacing, 0 for corners.
    blur_px : σ of the edges' blur, median over the points.
    size_px : (2,) width and height of the image.
    lost : number of points within the image that could not be measured.
    loss_reasons : of these as text, "" for none; of a part of a target what is missing.
    is_partial : Whether only a part of a target without markers is visible, so that `index` counts from an unknown
        point of it; default False.
    """

    name: str
    index: IntArray
    position_px: FloatArray
    covariance_px2: FloatArray
    radius: float
    blur_px: float
    size_px: IntArray
    lost: int = 0
    loss_reasons: str = ""
    is_partial: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(np.unique(self.index, axis=0)) < len(self.index):
            raise ValueError("index: expected each point once, found one twice")


class TargetNotFound(ValueError):
    """An image shows no usable target; the text is its fault."""


# Quality of an image of a target: exposure, contrast, blur, and its noise.

SATURATED = 0.995  # of full scale: what counts as saturated
MOST_SATURATED = 0.6  # permitted share of the target's pixels, which the fit excludes
_LEAST_CONTRAST = 0.02  # between bright and dark, of full scale
_BLUR_PX, _BLUR_CELL = 2.6, 0.12  # blur σ that always passes, in px, and in units of the target's cells
_FEWEST_PIXELS = 1000  # that determine the noise
_FLAT = 0.02  # gradient per px, relative to the image's contrast, of a flat pixel


def check_exposure(image: NDArray[Any], area: FloatArray, full_scale: float, most: float = MOST_SATURATED) -> None:
    """Raise `TargetNotFound` for a target too bright or without contrast.

    Within the polygon `area` (P, 2) px. Overexposed: more than the share `most` of its pixels reach full scale.
    Underexposed: the range between the 5th and the 95th percentile is below 2 % of full scale.
    """
    import cv2

    check_shape("area", area, (None, 2))
    filled = np.zeros(image.shape, dtype=np.uint8)
    cv2.fillPoly(filled, [np.rint(area).astype(np.int32)], 1)
    grey = image[filled > 0]
    if grey.size == 0:
        raise ValueError("area: expected a part of the image, found no pixel")
    fault = _exposure_fault(grey, full_scale, most, (5, 95), "target's")
    if fault is not None:
        raise TargetNotFound(fault)


def _exposure_fault(
    grey: NDArray[Any], full_scale: float, most: float, ends: tuple[int, int], whose: str
) -> str | None:
    """Return the fault of grey values: saturated, or without contrast; None for none.

    Saturated: more than the share `most`. Contrast: between the percentiles `ends`.
    """
    saturated = float((grey >= SATURATED * full_scale).mean())
    if saturated > most:
        return f"overexposed: {100 * saturated:.0f} % of the {whose} pixels reach full scale"
    low, high = np.percentile(grey, ends)
    if high - low < _LEAST_CONTRAST * full_scale:
        return f"underexposed: bright and dark differ by {100 * (high - low) / full_scale:.1f} % of full scale"
    return None


def refuse_second(target: str) -> None:
    """Raise `TargetNotFound` for an image with a second target equal to the one found."""
    raise TargetNotFound(
        f"two targets: {target} is visible twice; cover one, since other images may show either of them"
    )


def check_blur(blur_px: float, cell_px: float) -> None:
    """Raise `TargetNotFound` for edges blurred by more than 2.6 px and 0.12 cells.

    blur_px: σ. A cell, `cell_px`, is a square's side, or the dots' distance.
    """
    if not blur_px <= max(_BLUR_PX, _BLUR_CELL * cell_px):
        raise TargetNotFound(f"blurred: edges are soft by σ = {blur_px:.1f} px where cells measure {cell_px:.0f} px")


def image_fault(image: NDArray[Any], full_scale: float) -> str | None:
    """Return the fault of an image without a target, None for none obvious.

    The text begins a sentence: too bright, without contrast, or without a sharp edge. The steepest gradient (99.9th
    percentile, at a scale of 1 px) and the range of grey levels give the edges' σ.
    """
    from scipy.ndimage import gaussian_gradient_magnitude

    fault = _exposure_fault(image, full_scale, 0.5, (1, 99), "image's")
    if fault is not None:
        return fault
    low, high = np.percentile(image, [1, 99])
    steepest = float(np.percentile(gaussian_gradient_magnitude(image.astype(np.float32), 1.0), 99.9))
    sigma = float(high - low) / (np.sqrt(2 * np.pi) * max(steepest, 1e-9))
    if sigma > 1.5 * _BLUR_PX:
        return f"blurred: no edge is sharper than σ = {sigma:.1f} px"
    return None


def estimate_image_noise(image: NDArray[Any], full_scale: float = np.inf) -> NoiseModel:
    """Estimate the noise against brightness (grey²) of an image with flat areas.

    Squares of the difference operator [1 −2 1]ᵀ·[1 −2 1]/6, which is zero for a linear change of brightness and has the
    variance of the noise (Immerkær 1996, Computer Vision and Image Understanding 64, 300). Used are pixels where the
    gradient at a scale of 2 px is small, not next to pixels at 0 or full scale, which have no noise.
    """
    import cv2

    check_shape("image", image, (None, None))
    grey = image.astype(np.float32)
    step = np.array([1.0, -2.0, 1.0], dtype=np.float32)
    fine = cv2.sepFilter2D(grey, cv2.CV_32F, step, step / 6)
    smooth = cv2.GaussianBlur(grey, (0, 0), 2.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125))
    low, high = np.percentile(smooth[::4, ::4], [2, 98])
    flat = slope < _FLAT * (high - low)
    flat[[0, -1]], flat[:, [0, -1]] = False, False
    clipped = ((grey <= 0) | (grey >= SATURATED * full_scale)).astype(np.uint8)
    within = cv2.dilate(clipped, np.ones((5, 5), dtype=np.uint8)) == 0
    if (flat & within).sum() >= _FEWEST_PIXELS:
        flat &= within
    elif flat.sum() < _FEWEST_PIXELS:
        flat = np.ones_like(flat)
    stride = max(1, int(flat.sum()) // 100_000)
    return fit_noise_model(smooth[flat][::stride].astype(np.float64), fine[flat][::stride].astype(np.float64) ** 2)


def outline(position_px: FloatArray) -> FloatArray:
    """Return the convex hull (P, 2) of points (N, 2), the area of a target."""
    import cv2

    return np.asarray(cv2.convexHull(position_px.astype(np.float32)), dtype=np.float64).reshape(-1, 2)
