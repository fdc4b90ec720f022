"""One camera as another program describes it, and the camera of this program that sees the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray, IntArray, check_shape
from photogram.camera import Camera

EVEN = (2, 4, 6)
"""Exponents of the radial polynomial 1 + k1·r² + k2·r⁴ + k3·r⁶, which is this program's."""
_LINEAR, _RADIAL = [0, 1, 2, 3, 9], [4, 5, 8]  # places of fx fy cx cy and the turn, of k1 k2 k3, among the parameters
_GRID = 21  # points along each side of the picture at which two cameras are compared
_STEPS = 200  # fixed-point steps of the inverse
_INVERTED_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole with skew, radial and tangential distortion: focal_px, centre_px (2,), radial (3,), tangential (2,).

    With x = X/Z, y = Y/Z, r² = x² + y² and the factor g = 1 + Σ radial·r^exponents:
    x_d = g·x + 2·p1·x·y + p2·(r² + 2x²), y_d = g·y + p1·(r² + 2y²) + 2·p2·x·y,
    u = fx·x_d + skew·y_d + cx, v = fy·y_d + cy.
    """

    focal_px: FloatArray
    centre_px: FloatArray
    radial: FloatArray
    tangential: FloatArray
    skew_px: float = 0.0
    exponents: tuple[int, int, int] = EVEN

    def __post_init__(self) -> None:
        check_shape("focal_px", self.focal_px, (2,))
        check_shape("centre_px", self.centre_px, (2,))
        check_shape("radial", self.radial, (3,))
        check_shape("tangential", self.tangential, (2,))

    @property
    def is_exact(self) -> bool:
        """Whether a `Camera` describes it without any difference."""
        return self.skew_px == 0.0 and (self.exponents == EVEN or not self.radial.any())

    def project(self, normalised: FloatArray) -> FloatArray:
        """Return the pixels (N, 2) of normalised coordinates (N, 2)."""
        x, y = normalised.T
        radius = np.hypot(x, y)
        factor = 1.0 + sum(k * radius**power for k, power in zip(self.radial, self.exponents, strict=True))
        p1, p2 = self.tangential
        x_d = factor * x + 2 * p1 * x * y + p2 * (radius**2 + 2 * x**2)
        y_d = factor * y + p1 * (radius**2 + 2 * y**2) + 2 * p2 * x * y
        pixel = np.stack([self.focal_px[0] * x_d + self.skew_px * y_d, self.focal_px[1] * y_d], axis=1)
        return np.asarray(pixel + self.centre_px)


@dataclass(frozen=True, eq=False)
class Nearest:
    """The camera nearest to a lens: `camera` sees in a frame turned by `turn_rad` about its axis what the lens sees.

    `largest_px`: the largest difference left over the picture.
    """

    camera: Camera
    turn_rad: float
    largest_px: float


def nearest_camera(lens: Lens, size_px: IntArray) -> Nearest:
    """Return the camera that sees, with least squares over the picture, what a lens sees.

    A lens of this program's form is taken over as it is. Another radial polynomial is fitted by this one's, with the
    matrix. Of a skew, u = … + s·y_d, about one half is a turn about the axis by −s/(fx + fy), which the camera's frame
    takes up; the other half, a stretch along the diagonals, is no part of this program's camera and remains.
    """
    start = np.concatenate([lens.focal_px, lens.centre_px, lens.radial[:2], lens.tangential, lens.radial[2:]])
    if lens.is_exact:
        return Nearest(Camera.from_parameters(start, size_px), 0.0, 0.0)
    if lens.exponents != EVEN:
        start[_RADIAL] = 0.0
    normalised = _seen(lens, size_px)
    pixel = lens.project(normalised)
    free = _LINEAR if lens.exponents == EVEN else [*_LINEAR, *_RADIAL]
    found = _fit(normalised, pixel, (np.append(start, 0.0), free), size_px)
    camera, turn = Camera.from_parameters(found[:9], size_px), float(found[9])
    left = np.linalg.norm(camera.project(_rays(normalised, turn)) - pixel, axis=1)
    return Nearest(camera, turn, float(left.max()))


def _fit(
    normalised: FloatArray, pixel: FloatArray, start: tuple[FloatArray, list[int]], size_px: IntArray
) -> FloatArray:
    """Return parameters and turn (10,) by least squares over the free ones, each scaled to about 1 px at the corner."""
    from scipy.optimize import least_squares

    first, free = start
    radius = float(np.linalg.norm(normalised, axis=1).max())
    reach = radius * float(first[:2].mean())
    steps = np.array([1 / radius, 1 / radius, 1, 1, *(1 / (reach * radius**n) for n in (2, 4, 1, 1, 6, 0))])

    def moved(scaled: FloatArray) -> FloatArray:
        values = first.copy()
        values[free] += scaled * steps[free]
        return values

    def difference(scaled: FloatArray) -> FloatArray:
        values = moved(scaled)
        camera = Camera.from_parameters(values[:9], size_px)
        return np.asarray((camera.project(_rays(normalised, values[9])) - pixel).ravel())

    solution = least_squares(difference, np.zeros(len(free)), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return moved(solution.x)


def _rays(normalised: FloatArray, turn_rad: float) -> FloatArray:
    """Return the directions (N, 3) in a frame turned by an angle about the optical axis."""
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    x, y = normalised.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, np.ones(len(x))], axis=1)


def _seen(lens: Lens, size_px: IntArray) -> FloatArray:
    """Return the normalised coordinates (N, 2) of a grid of pixels over the picture, by fixed-point steps."""
    width, height = (float(length) - 1.0 for length in size_px)
    columns, rows = np.meshgrid(np.linspace(0.0, width, _GRID), np.linspace(0.0, height, _GRID))
    pixel = np.stack([columns.ravel(), rows.ravel()], axis=1)
    normalised = (pixel - lens.centre_px) / lens.focal_px
    for _ in range(_STEPS):
        difference = pixel - lens.project(normalised)
        if np.abs(difference).max() < _INVERTED_PX:
            return np.asarray(normalised)
        if not np.isfinite(difference).all():
            break
        normalised = normalised + difference / lens.focal_px
    raise ValueError("distortion: expected coefficients with an inverse over the picture, found none")
