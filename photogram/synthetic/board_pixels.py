"""Kernels that render a flat pattern pixel by pixel: rays through the lens, the pattern's soft edges, the aperture.

A pattern is softened in its own plane by a Gaussian, in closed form, so that a picture is as point-symmetric about
each corner and dot as the perspective lets it be; the mean over the pixel's square is taken by 3 x 3 Gauss points.
"""

from __future__ import annotations

import math

import numpy as np

from photogram._checks import FloatArray
from photogram._kernel import njit
from photogram._pinhole import distort, undistort

_FAR = 4.5  # σ of the softening beyond which an edge has no effect
_NODE = math.sqrt(0.6)  # Gauss-Legendre points of degree 5 on (−1, 1), weights 5/18, 8/18, 5/18 of the mean


@njit(error_model="numpy")
def _rays(row: int, camera: FloatArray, rays: FloatArray) -> None:
    """Fill rays (W, 6) of a row of pixels: normalised x, y and ∂x/∂u, ∂x/∂v, ∂y/∂u, ∂y/∂v.

    Newton steps from the neighbour's ray; a pixel that the distortion never reaches is NaN.
    """
    x, y = math.nan, math.nan
    for column in range(rays.shape[0]):
        if math.isnan(x):
            x, y = undistort(float(column), float(row), camera)
        target_x, target_y = (column - camera[2]) / camera[0], (row - camera[3]) / camera[1]
        for _ in range(2):
            xd, yd, dxx, dxy, dyy = distort(x, y, camera)
            determinant = dxx * dyy - dxy * dxy
            x += (dyy * (target_x - xd) - dxy * (target_y - yd)) / determinant
            y += (dxx * (target_y - yd) - dxy * (target_x - xd)) / determinant
        if not determinant > 0.0:
            x, y = math.nan, math.nan
        rays[column, 0], rays[column, 1] = x, y
        rays[column, 2], rays[column, 3] = dyy / (determinant * camera[0]), -dxy / (determinant * camera[1])
        rays[column, 4], rays[column, 5] = -dxy / (determinant * camera[0]), dxx / (determinant * camera[1])
        x, y = x + rays[column, 2], y + rays[column, 4]


@njit(error_model="numpy")
def _plane(homography: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Return the point in the target's plane that the ray (x, y, 1) meets."""
    w = 1.0 / (homography[2, 0] * x + homography[2, 1] * y + homography[2, 2])
    u = (homography[0, 0] * x + homography[0, 1] * y + homography[0, 2]) * w
    return u, (homography[1, 0] * x + homography[1, 1] * y + homography[1, 2]) * w


@njit(error_model="numpy")
def _reach(homography: FloatArray, ray: FloatArray, sigma: float) -> float:
    """Return how far from the pixel's centre, in the target's plane, an edge has an effect on the pixel."""
    u, v = _plane(homography, ray[0], ray[1])
    right_u, right_v = _plane(homography, ray[0] + ray[2], ray[1] + ray[4])
    below_u, below_v = _plane(homography, ray[0] + ray[3], ray[1] + ray[5])
    size = math.hypot(right_u - u, right_v - v) + math.hypot(below_u - u, below_v - v)
    return 0.5 * size + _FAR * sigma


@njit(error_model="numpy")
def _step(distance: float, sigma: float) -> float:
    """Return the softened unit step at a signed distance from its edge."""
    return 0.5 * (1.0 + math.erf(distance / (sigma * math.sqrt(2.0))))


@njit(error_model="numpy")
def _interval(edges: FloatArray, value: float, guess: int) -> int:
    """Return k with edges[k] <= value < edges[k + 1], walking from a guess; −1 before the first edge."""
    k = guess
    while k >= 0 and edges[k] > value:
        k -= 1
    while k + 1 < edges.size and edges[k + 1] <= value:
        k += 1
    return k


@njit(error_model="numpy")
def _shares(edges: FloatArray, value: float, sigma: float, first: int, last: int, shares: FloatArray) -> None:
    """Fill shares[first : last + 1] with what tiles `first` … `last` have at a place; tile k lies before edge k."""
    lower = 0.0
    for k in range(first, last + 1):
        upper = _step(edges[k] - value, sigma) if k < last else 1.0
        shares[k] = upper - lower
        lower = upper


@njit(nogil=True, error_model="numpy")
def render_tiles(
    camera: FloatArray,
    homography: FloatArray,
    edges_x: FloatArray,
    edges_y: FloatArray,
    tiles: FloatArray,
    sigma: float,
    image: FloatArray,
) -> None:
    """Fill image (H, W) with a pattern that is constant on the tiles (Y + 1, X + 1) between edges (X,) and (Y,)."""
    rays = np.empty((image.shape[1], 6))
    share_x, share_y = np.empty(edges_x.size + 1), np.empty(edges_y.size + 1)
    for row in range(image.shape[0]):
        _rays(row, camera, rays)
        i0 = j0 = 0
        for column in range(image.shape[1]):
            ray = rays[column]
            u, v = _plane(homography, ray[0], ray[1])
            reach = _reach(homography, ray, sigma)
            if not reach > 0.0:
                image[row, column] = tiles[0, 0]
                continue
            i0, j0 = (
                _interval(edges_x, u - reach, max(i0 - 1, 0)) + 1,
                _interval(edges_y, v - reach, max(j0 - 1, 0)) + 1,
            )
            i1, j1 = _interval(edges_x, u + reach, i0 - 1) + 1, _interval(edges_y, v + reach, j0 - 1) + 1
            if i0 == i1 and j0 == j1:
                image[row, column] = tiles[j0, i0]
                continue
            total = 0.0
            for q in range(9):
                down, across = 0.5 * _NODE * (q // 3 - 1), 0.5 * _NODE * (q % 3 - 1)
                x, y = ray[0] + across * ray[2] + down * ray[3], ray[1] + across * ray[4] + down * ray[5]
                u, v = _plane(homography, x, y)
                _shares(edges_x, u, sigma, i0, i1, share_x)
                _shares(edges_y, v, sigma, j0, j1, share_y)
                weight = (8.0 if q // 3 == 1 else 5.0) * (8.0 if q % 3 == 1 else 5.0) / 324.0
                for j in range(j0, j1 + 1):
                    for i in range(i0, i1 + 1):
                        total += weight * share_y[j] * share_x[i] * tiles[j, i]
            image[row, column] = total


@njit(error_model="numpy")
def _dots_value(spots: FloatArray, first: FloatArray, u: float, v: float, sigma: float) -> float:
    """Return the share of black at (u, v), in spacings, of the four dots around it."""
    white = 1.0
    for k in range(4):
        i, j = math.floor(u) + k % 2, math.floor(v) + k // 2
        column, row = int(i - first[0]), int(j - first[1])
        if 0 <= row < spots.shape[0] and 0 <= column < spots.shape[1] and spots[row, column, 0] > 0.0:
            distance = math.hypot(u - i, v - j)
            black = _step(spots[row, column, 0] - distance, sigma)
            if spots[row, column, 1] > 0.0:
                black *= _step(distance - spots[row, column, 1], sigma)
            white *= 1.0 - black
    return 1.0 - white


@njit(error_model="numpy")
def _plain(spots: FloatArray, first: FloatArray, sheet: FloatArray, u: float, v: float, reach: float) -> bool:
    """Return whether no edge of a dot, a hole or the sheet lies within `reach` of (u, v)."""
    if abs(min(u - sheet[0], sheet[1] - u, v - sheet[2], sheet[3] - v)) < reach or not reach < 0.5:
        return False
    for k in range(4):
        i, j = math.floor(u) + k % 2, math.floor(v) + k // 2
        column, row = int(i - first[0]), int(j - first[1])
        if 0 <= row < spots.shape[0] and 0 <= column < spots.shape[1]:
            distance = math.hypot(u - i, v - j)
            if abs(distance - spots[row, column, 0]) < reach or abs(distance - spots[row, column, 1]) < reach:
                return False
    return True


@njit(nogil=True, error_model="numpy")
def render_dots(
    camera: FloatArray,
    homography: FloatArray,
    spots: FloatArray,
    first: FloatArray,
    sheet: FloatArray,
    sigma: float,
    image: FloatArray,
) -> None:
    """Fill image (H, W, 2) with the shares of black and of sheet in every pixel; lengths in lattice spacings.

    spots (rows, columns, 2): radius of the dot and of the hole in it, 0 for none, at lattice points from `first` (2,).
    sheet (4,): first and last x, first and last y of the white sheet.
    """
    rays = np.empty((image.shape[1], 6))
    for row in range(image.shape[0]):
        _rays(row, camera, rays)
        for column in range(image.shape[1]):
            ray = rays[column]
            black, cover = 0.0, 0.0
            u, v = _plane(homography, ray[0], ray[1])
            plain = _plain(spots, first, sheet, u, v, _reach(homography, ray, sigma))
            for q in range(4, 5) if plain else range(9):
                down, across = 0.5 * _NODE * (q // 3 - 1), 0.5 * _NODE * (q % 3 - 1)
                x, y = ray[0] + across * ray[2] + down * ray[3], ray[1] + across * ray[4] + down * ray[5]
                u, v = _plane(homography, x, y)
                share = 1.0 if plain else (8.0 if q // 3 == 1 else 5.0) * (8.0 if q % 3 == 1 else 5.0) / 324.0
                inside = min(u - sheet[0], sheet[1] - u, v - sheet[2], sheet[3] - v)
                if inside > -_FAR * sigma:
                    black += share * _dots_value(spots, first, u, v, sigma)
                    cover += share * _step(inside, sigma)
            image[row, column, 0], image[row, column, 1] = black, cover
