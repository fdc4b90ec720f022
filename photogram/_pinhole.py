"""Kernels of the pinhole camera with radial and tangential distortion, one point at a time, compiled.

A camera is the vector [fx fy cx cy k1 k2 p1 p2 k3]; the model is OpenCV's (Brown 1971, Photogrammetric Engineering
37, 855): with r² = x² + y² and g = 1 + k1·r² + k2·r⁴ + k3·r⁶,
x_d = x·g + 2·p1·x·y + p2·(r² + 2·x²),  y_d = y·g + p1·(r² + 2·y²) + 2·p2·x·y,  u = fx·x_d + cx,  v = fy·y_d + cy.
"""

from __future__ import annotations

import math

import numpy as np

from photogram._checks import FloatArray
from photogram._kernel import njit

_STEPS = 60  # damped Newton steps of the inverse; a handful is the rule
_RESIDUAL = 1e-13  # largest residual, in normalised units, of a converged inverse


@njit()
def distort(x: float, y: float, camera: FloatArray) -> tuple[float, float, float, float, float]:
    """Return x_d, y_d and the derivatives ∂x_d/∂x, ∂x_d/∂y = ∂y_d/∂x, ∂y_d/∂y."""
    k1, k2, p1, p2, k3 = camera[4], camera[5], camera[6], camera[7], camera[8]
    r2 = x * x + y * y
    gain = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    xd = x * gain + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * gain + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    dxx = gain + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = gain + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, dxx, dxy, dyy


@njit()
def undistort(u: float, v: float, camera: FloatArray) -> tuple[float, float]:
    """Return the normalised x, y whose image is the pixel u, v; NaN where the distortion has no inverse.

    Newton's method from the distorted point, each step halved until the residual falls, to the last digit.
    """
    target_x, target_y = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
    x, y = target_x, target_y
    xd, yd, dxx, dxy, dyy = distort(x, y, camera)
    residual = math.hypot(target_x - xd, target_y - yd)
    for _ in range(_STEPS):
        determinant = dxx * dyy - dxy * dxy
        if not determinant > 0.0:
            return math.nan, math.nan
        step_x = (dyy * (target_x - xd) - dxy * (target_y - yd)) / determinant
        step_y = (dxx * (target_y - yd) - dxy * (target_x - xd)) / determinant
        scale, smaller = 1.0, False
        for _halving in range(12):
            xd, yd, dxx, dxy, dyy = distort(x + scale * step_x, y + scale * step_y, camera)
            tried = math.hypot(target_x - xd, target_y - yd)
            smaller = tried < residual and dxx * dyy - dxy * dxy > 0.0
            if smaller:
                break
            scale *= 0.5
        if not smaller:
            break
        x, y, residual = x + scale * step_x, y + scale * step_y, tried
    if not residual <= _RESIDUAL * (1.0 + math.hypot(target_x, target_y)):
        return math.nan, math.nan
    return x, y


@njit()
def project_all(points: FloatArray, camera: FloatArray) -> FloatArray:
    """Return the pixels (N, 2) of points (N, 3) in the camera frame; NaN behind the camera."""
    pixels = np.full((points.shape[0], 2), np.nan)
    for i in range(points.shape[0]):
        depth = points[i, 2]
        if depth > 0.0:
            xd, yd, _, _, _ = distort(points[i, 0] / depth, points[i, 1] / depth, camera)
            pixels[i, 0] = camera[0] * xd + camera[2]
            pixels[i, 1] = camera[1] * yd + camera[3]
    return pixels


@njit()
def undistort_all(pixels: FloatArray, camera: FloatArray) -> FloatArray:
    """Return the normalised coordinates (N, 2) of pixels (N, 2)."""
    normalised = np.empty((pixels.shape[0], 2))
    for i in range(pixels.shape[0]):
        normalised[i, 0], normalised[i, 1] = undistort(pixels[i, 0], pixels[i, 1], camera)
    return normalised
