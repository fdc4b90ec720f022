"""Rendering by ray intersection: pixel aperture and exposure are integrated, lens blur is part of the face."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray
from photogram._kernel import njit
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
    tone = np.array([face.dark, face.bright - face.dark, face.background])
    size = np.array([face.half_size_m[0], face.half_size_m[1], float(face.round), face.edge_blur_m])
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


@njit(nogil=True, error_model="numpy")
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
    nodes, poses = offsets.size, weights.size
    for i in range(rows):
        for j in range(columns):
            centre_x, centre_y = ray[i, j, 0], ray[i, j, 1]
            total = 0.0
            for q in range(nodes * nodes):
                down, across = offsets[q // nodes], offsets[q % nodes]
                x = centre_x + across * ray_x[i, j, 0] + down * ray_y[i, j, 0]
                y = centre_y + across * ray_x[i, j, 1] + down * ray_y[i, j, 1]
                share = shares[q // nodes] * shares[q % nodes]
                for e in range(poses):
                    w = 1.0 / (maps[e, 2, 0] * x + maps[e, 2, 1] * y + maps[e, 2, 2])
                    u = (maps[e, 0, 0] * x + maps[e, 0, 1] * y + maps[e, 0, 2]) * w
                    v = (maps[e, 1, 0] * x + maps[e, 1, 1] * y + maps[e, 1, 2]) * w
                    cover = _cover(size, u, v)
                    value = tone[2]
                    if cover > 0.0:
                        column, row = (u - grid[0]) * grid[2], (v - grid[1]) * grid[2]
                        value += cover * (tone[0] + tone[1] * spline_value(coefficients, column, row) - tone[2])
                    total += share * weights[e] * value
            image[i, j] = total


@njit(error_model="numpy")
def _cover(size: FloatArray, u: float, v: float) -> float:
    """Return how much of the point (u, v) is the face's: 1 inside, 0 outside, an error function across the rim."""
    inside = size[0] - math.sqrt(u * u + v * v) if size[2] > 0.0 else min(size[0] - abs(u), size[1] - abs(v))
    cover = inside / size[3]
    if cover > _FAR:
        return 1.0
    return 0.0 if cover < -_FAR else 0.5 * (1.0 + math.erf(cover / math.sqrt(2.0)))
