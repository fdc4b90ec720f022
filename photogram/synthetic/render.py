"""Rendering by ray intersection: pixel aperture and exposure are integrated, lens blur is part of the face."""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray
from photogram.synthetic.scene import Face, View
from photogram.synthetic.texture import spline_value

_FAR = 4.0  # rim blur in σ beyond which a point is wholly inside or outside


def render(view: View, face: Face, poses: FloatArray, weights: FloatArray, nodes: int = 2) -> FloatArray:
    """Return the noise-free image (H, W), fractions of full scale, of the body in `poses` (E, 6), weighted (E,).

    Every pixel is the mean over its square by `nodes` x `nodes` Gauss-Legendre points, and over the poses by the
    weights (summing to 1). A ray meets the moved face at homography·(x, y, 1); the rim is an error function of the
    distance from it, the face's texture carries the lens blur already.
    """
    maps = np.stack([view.homography(face, pose) for pose in poses])
    offsets, shares = _gauss_legendre(nodes, 1.0)
    image = np.empty(view.ray.shape[:2])
    tone = np.array([face.dark, face.bright - face.dark, face.background, face.edge_blur_m])
    size = np.array([face.half_size_m[0], face.half_size_m[1], 1.0 if face.round else 0.0])
    grid = np.array([face.texture.origin_m[0], face.texture.origin_m[1], 1.0 / face.texture.step_m])
    _integrate(
        view.ray,
        view.ray_x,
        view.ray_y,
        maps,
        weights,
        offsets,
        shares,
        face.texture.coefficients,
        grid,
        size,
        tone,
        image,
    )
    return image * view.light


def render_exposure(
    view: View, face: Face, pose_at: Callable[[float], FloatArray], middle_s: float, exposure_s: float, nodes: int = 2
) -> FloatArray:
    """Return the image (H, W) of a body moving as `pose_at(time)` (6,) over a rectangular exposure.

    Two Gauss-Legendre times: for a line at f the error of the mean is (π·f·T)⁴/1080 of its amplitude, below 10⁻⁸
    at f·T = 0.02.
    """
    offsets, shares = _gauss_legendre(2, exposure_s)
    poses = np.stack([pose_at(middle_s + offset) for offset in offsets])
    return render(view, face, poses, shares, nodes)


def _gauss_legendre(nodes: int, length: float) -> tuple[FloatArray, FloatArray]:
    """Return the points and weights (nodes,) of the mean over an interval of `length` around zero."""
    points, weights = np.polynomial.legendre.leggauss(nodes)
    return points * length / 2, weights / 2


@numba.njit(cache=True, nogil=True)
def _integrate(
    ray: FloatArray,
    ray_x: FloatArray,
    ray_y: FloatArray,
    maps: FloatArray,
    weights: FloatArray,
    offsets: FloatArray,
    shares: FloatArray,
    coefficients: NDArray[np.float32],
    grid: FloatArray,
    size: FloatArray,
    tone: FloatArray,
    image: FloatArray,
) -> None:
    """Fill the image with the mean over aperture and exposure, in one pass over the pixels."""
    rows, columns = image.shape
    for i in range(rows):
        for j in range(columns):
            total = 0.0
            for a in range(offsets.size):
                for b in range(offsets.size):
                    x = ray[i, j, 0] + offsets[b] * ray_x[i, j, 0] + offsets[a] * ray_y[i, j, 0]
                    y = ray[i, j, 1] + offsets[b] * ray_x[i, j, 1] + offsets[a] * ray_y[i, j, 1]
                    share = shares[a] * shares[b]
                    for e in range(weights.size):
                        m = maps[e]
                        w = 1.0 / (m[2, 0] * x + m[2, 1] * y + m[2, 2])
                        u = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * w
                        v = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * w
                        total += share * weights[e] * _grey(coefficients, grid, size, tone, u, v)
            image[i, j] = total


@numba.njit(cache=True, inline="always")
def _grey(
    coefficients: NDArray[np.float32], grid: FloatArray, size: FloatArray, tone: FloatArray, u: float, v: float
) -> float:
    """Return the grey level at the point (u, v) of the face's plane: face, background, or the blurred rim."""
    inside = size[0] - math.hypot(u, v) if size[2] > 0.0 else min(size[0] - abs(u), size[1] - abs(v))
    cover = inside / tone[3]
    if cover < -_FAR:
        return float(tone[2])
    value = tone[0] + tone[1] * spline_value(coefficients, (u - grid[0]) * grid[2], (v - grid[1]) * grid[2])
    if cover > _FAR:
        return float(value)
    cover = 0.5 * (1.0 + math.erf(cover / math.sqrt(2.0)))
    return float(cover * value + (1.0 - cover) * tone[2])
