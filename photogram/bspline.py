"""B-spline interpolation of images: coefficients, values, gradients, and values along lines.

Lines are the inner loop of every registration. Neighbouring points of a line read neighbouring coefficients until it
passes into another row or drifts by a column. Such runs are computed with vectors of points (`kernels.lanes`):
compilers cannot prove that the grey values written are no coefficients.

Coefficients and grey values along lines are float32, whose rounding is 10⁻⁷ of full scale, compared with 10⁻⁵ for a
pixel of 16 bit. Positions are split into whole pixels and fraction before they are rounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.lanes import LINES, recurse, run_cubic, run_quintic, run_septic
from shakercal._common.arrays import Arrays, FloatArray, check_shape
from shakercal._common.kernels import njit

PADDING_PX = 4  # half the support of degree 7
POLES = {
    3: (sqrt(3.0) - 2.0,),
    5: (sqrt(67.5 - sqrt(4436.25)) + sqrt(26.25) - 6.5, sqrt(67.5 + sqrt(4436.25)) - sqrt(26.25) - 6.5),
    7: (-0.53528043079643816554, -0.12255461519232669052, -0.0091486948096082769286),
}
REACH = 32  # pixels after which the slowest of all poles leaves 2·10⁻⁹ of a start
DARK = np.float32(1e-20)  # far below rounding; avoids denormal numbers, which are slow, in black areas
TILE = 8  # pixels of a row that are transposed at once


@dataclass(frozen=True, eq=False, repr=False)
class Spline(Arrays, shapes="coefficients H W"):
    """An image as a B-spline of `degree` 3, 5 or 7.

    coefficients (H+8, W+8): mirrored by four pixels on every side.
    """

    coefficients: NDArray[np.float32]
    degree: int

    def __post_init__(self) -> None:
        super().__post_init__()
        poles_of(self.degree)


def poles_of(degree: int) -> tuple[float, ...]:
    """Return the poles inside the unit circle of the filter of a degree.

    Raises `ValueError` for degrees other than 3, 5 and 7.
    """
    if degree not in POLES:
        raise ValueError(f"degree: expected 3, 5 or 7, found {degree}")
    return POLES[degree]


def spline_of_image(image: NDArray[np.generic], degree: int = 5) -> Spline:
    """Return the spline through the grey values of image (H,W), mirrored at the outermost pixels.

    Recursive prefilter c = Π_z (1−z)² · causal and anticausal first-order filters with the poles z of the B-spline
    (Unser, Aldroubi, Eden 1993, IEEE Trans. Signal Process. 41, 834, eqs 2.4 and 2.5), in rows and columns. Both start
    at zero `REACH` pixels outside, in the mirror image.
    """
    check_shape("image", image, (None, None))
    if min(image.shape) < 2 * PADDING_PX:
        raise ValueError(f"image: expected at least {2 * PADDING_PX} x {2 * PADDING_PX} px, found {image.shape}")
    first, second, third = (*poles_of(degree), 0.0, 0.0)[:3]
    gain = ((1.0 - first) * (1.0 - second) * (1.0 - third)) ** 4
    usable = image.dtype in (np.uint8, np.uint16) and image.flags.c_contiguous and image.flags.writeable
    inside = image if usable else np.array(image, np.float64)  # a kernel is compiled for each kind of array
    return Spline(_prefilter(inside, (first, second, third), gain, PADDING_PX), degree)


def evaluate(spline: Spline, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return values (M,) and gradients (M, 2) of the spline at points_px (M, 2).

    Gradients are ∂/∂x, ∂/∂y; NaN outside the image.
    """
    check_shape("points_px", points_px, (None, 2))
    values, gradients = np.empty(len(points_px)), np.empty((len(points_px), 2))
    _evaluate(spline.coefficients, spline.degree, np.ascontiguousarray(points_px, dtype=np.float64), values, gradients)
    return values, gradients


def grey_values(spline: Spline) -> FloatArray:
    """Return the image (H, W) through which the spline passes.

    These are the coefficients weighted by the B-spline at whole pixels.
    """
    values, _ = _at_pixels(spline.degree)
    return _weighted(spline, values, values)


def grey_gradients(spline: Spline) -> tuple[FloatArray, FloatArray]:
    """Return ∂/∂x and ∂/∂y (H, W) of the spline at whole pixels."""
    values, slopes = _at_pixels(spline.degree)
    return _weighted(spline, slopes, values), _weighted(spline, values, slopes)


def third_differences(spline: Spline) -> FloatArray:
    """Return third differences (H−3,W−3) in x of those in y.

    (−1 3 −3 1), of the image of the spline.
    """
    values = np.convolve(_at_pixels(spline.degree)[0], (-1.0, 3.0, -3.0, 1.0))
    return _weighted(spline, values, values)[2:-1, 2:-1]


def _at_pixels(degree: int) -> tuple[FloatArray, FloatArray]:
    """Return values and slopes of the B-splines at a whole pixel."""
    values, slopes = np.empty(8), np.empty(8)
    basis(0.0, degree, values, slopes)
    return values[:degree], slopes[:degree]


def _weighted(spline: Spline, along: FloatArray, down: FloatArray) -> FloatArray:
    """Return float64 sums of neighbouring coefficients with weights in x and y, without the frame."""
    import cv2

    inside = slice(PADDING_PX, -PADDING_PX)
    return np.asarray(cv2.sepFilter2D(spline.coefficients.astype(np.float64), -1, along, down)[inside, inside])


def noise_gain(fraction_px: FloatArray, degree: int = 5) -> FloatArray:
    """Return the variance of interpolated white noise of variance 1 at offsets from a pixel.

    Σ_k h(t−k)² of the cardinal spline h at one-dimensional offsets `fraction_px`; in two dimensions the gains of x and
    y multiply.
    """
    table = noise_gain_table(degree)
    position = np.mod(fraction_px, 1.0) * (len(table) - 1)
    return np.asarray(np.interp(position, np.arange(len(table)), table))


def mean_noise_gain(xp: Any, centre_px: Any, warp: Any, offset_px: Any, table: Any) -> Any:
    """Return the mean variance (..., N) of interpolated white noise of variance 1.

    It is the mean over offsets (P, 2). The points about centre_px (N, 2) are moved by the affine warps (..., N, 6) [u,
    u_x, u_y, v, v_x, v_y]. NaN for a warp that is not finite. The variance is linear in `table`, the `noise_gain_table`
    of the degree. Arrays of numpy or tensors of torch: `xp`.
    """
    deformation = xp.eye(2, dtype=warp.dtype, device=warp.device) + warp.reshape(*warp.shape[:-1], 2, 3)[..., 1:]
    position = offset_px @ deformation.mT + (centre_px + warp[..., ::3])[..., None, :]
    place = xp.nan_to_num(position - xp.floor(position)) * (len(table) - 1)
    low = xp.clip(xp.asarray(place, dtype=xp.int64), 0, len(table) - 2)
    gain = table[low] + (place - low) * (table[low + 1] - table[low])
    return xp.where(xp.isfinite(warp).all(-1), (gain[..., 0] * gain[..., 1]).mean(-1), xp.nan)


@cache
def noise_gain_table(degree: int) -> FloatArray:
    """Return `noise_gain` at 33 offsets from 0 to 1."""
    values, _ = _cardinal(np.add.outer(np.arange(-31.0, 31), np.linspace(0.0, 1.0, 33)).ravel(), degree)
    return np.asarray(np.sum(values.reshape(62, 33) ** 2, axis=0))


@cache
def slope_noise_gain(degree: int = 5) -> float:
    """Return the variance of the spline's slope for white noise of variance 1.

    Σ_k h′(k)² of the cardinal spline h.
    """
    return float(np.sum(_cardinal(np.arange(-32.0, 33), degree)[1] ** 2))


REACH_PX, PER_PX = 12, 64
"""Pixels over which a spline of degree 7 still interpolates noise, and points of a table for each."""


def pattern_overlap(shift_px: FloatArray, degree: int = 5) -> tuple[FloatArray, FloatArray]:
    """Return two correlations of a white pattern with its interpolation at shifts u.

    The shifts, of any shape, are along one axis. The first correlation is that of the pattern's values, h(u). The
    second is that of its slopes, Σ_k h′(−k)·h(u−k), with the cardinal spline h. They are 1 and 0 for u = 0, and vanish
    beyond two pixels.

    >>> [np.round(part, 2).tolist() for part in pattern_overlap(np.array([0.0, 0.5, 3.0]))]
    [[1.0, 0.62, 0.0], [0.0, 0.78, 0.0]]
    """
    positions, values, slopes = _overlap_table(degree)
    return np.interp(shift_px, positions, values), np.interp(shift_px, positions, slopes)


@cache
def _overlap_table(degree: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return shifts, and both correlations of `pattern_overlap` there."""
    positions = np.linspace(-REACH_PX, REACH_PX, 2 * REACH_PX * PER_PX + 1)
    pixels = np.arange(-REACH_PX, REACH_PX + 1.0)
    values, slopes = _cardinal(positions, degree)[0], _cardinal(-pixels, degree)[1]
    shifted = _cardinal(np.subtract.outer(positions, pixels).ravel(), degree)[0].reshape(len(positions), -1)
    return positions, values, shifted @ slopes


def _cardinal(x: FloatArray, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return values and slopes (M,) of the cardinal spline at x (M,), |x| ≤ 32.

    It is the response to one bright column.
    """
    values, gradients = evaluate(_spline_of_column(degree), np.column_stack([x + 32.0, np.full_like(x, 4.0)]))
    return values, gradients[:, 0]


@cache
def _spline_of_column(degree: int) -> Spline:
    """Return the spline of an image with one bright column."""
    impulse = np.zeros((2 * PADDING_PX, 65))
    impulse[:, 32] = 1.0
    return spline_of_image(impulse, degree)


@njit()
def _prefilter(image, poles, gain, padding):  # type: ignore[no-untyped-def]
    """Return the spline coefficients of an image with a mirrored frame of `padding` pixels.

    `gain`: of all poles. Several rows, placed side by side, or columns make each step of the recursion at once.
    """
    height, width = image.shape
    out = np.empty((height + 2 * padding, width + 2 * padding), np.float32)
    inside = out[padding : padding + height, padding : padding + width]
    rows = np.zeros((width + 2 * REACH, LINES), np.float32)
    columns = np.zeros((height + 2 * REACH, LINES), np.float32)
    for first in range(0, height, LINES):
        transposed = rows[REACH : REACH + width].T[: min(LINES, height - first)]
        _copy(image[first : first + LINES], transposed, np.float32(gain))
        _mirror(rows, width)
        recurse(rows, poles)
        _copy(transposed, inside[first : first + LINES], np.float32(1.0))
    for first in range(0, width, LINES):
        block = inside[:, first : first + LINES]
        columns[REACH : REACH + height, : block.shape[1]] = block
        _mirror(columns, height)
        recurse(columns, poles)
        block[:] = columns[REACH : REACH + height, : block.shape[1]]
    for k in range(1, padding + 1):
        out[padding - k, padding:-padding] = out[padding + k, padding:-padding]
        out[-1 - padding + k, padding:-padding] = out[-1 - padding - k, padding:-padding]
    for row in range(out.shape[0]):
        for k in range(1, padding + 1):
            out[row, padding - k] = out[row, padding + k]
            out[row, width + padding - 1 + k] = out[row, width + padding - 1 - k]
    return out


@njit()
def _copy(source, target, gain):  # type: ignore[no-untyped-def]
    """Copy rows (n, W) times a gain, plus `DARK`, tile by tile.

    In tiles, neighbouring pixels of either array stay in the cache.
    """
    whole = source.shape[1] - source.shape[1] % TILE
    for begin in range(0, whole, TILE):
        for i in range(source.shape[0]):
            for k in range(TILE):
                target[i, begin + k] = gain * np.float32(source[i, begin + k]) + DARK
    for i in range(source.shape[0]):
        for k in range(whole, source.shape[1]):
            target[i, k] = gain * np.float32(source[i, k]) + DARK


@njit()
def _mirror(lines, count):  # type: ignore[no-untyped-def]
    """Fill the first and last `REACH` rows with mirror images of those between."""
    period = 2 * count - 2
    for k in range(1, REACH + 1):
        before, behind = k % period, (count - 1 + k) % period
        lines[REACH - k] = lines[REACH + min(before, period - before)]
        lines[REACH + count - 1 + k] = lines[REACH + min(behind, period - behind)]


@njit()
def basis(t, degree, values, slopes):  # type: ignore[no-untyped-def]
    """Fill values and slopes of the degree+1 B-splines at t in [0, 1).

    By the recursion of de Boor and Cox: β_n(x) = ((x + (n+1)/2) β_{n−1}(x+½) + ((n+1)/2 − x) β_{n−1}(x−½)) / n and
    β_n′(x) = β_{n−1}(x+½) − β_{n−1}(x−½).
    """
    values[:] = 0.0
    values[0] = 1.0
    for n in range(1, degree + 1):
        if n == degree:
            for j in range(degree + 1):
                slopes[j] = (values[j - 1] if j > 0 else 0.0) - (values[j] if j < degree else 0.0)
        for j in range(n, -1, -1):
            left = (t + n - j) * values[j - 1] if j > 0 else 0.0
            right = (j + 1.0 - t) * values[j] if j < n else 0.0
            values[j] = (left + right) / n


@njit()
def _evaluate(coefficients, degree, points, values, gradients):  # type: ignore[no-untyped-def]
    """Fill value and gradient at every point."""
    width, height = coefficients.shape[1] - 2 * PADDING_PX, coefficients.shape[0] - 2 * PADDING_PX
    first = PADDING_PX - degree // 2
    for m in range(points.shape[0]):
        x, y = points[m, 0], points[m, 1]
        values[m] = np.nan
        gradients[m] = np.nan
        if not (x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0):
            continue
        column, row = int(np.floor(x)), int(np.floor(y))
        wx, sx, wy, sy = np.empty(8), np.empty(8), np.empty(8), np.empty(8)
        basis(x - column, degree, wx, sx)
        basis(y - row, degree, wy, sy)
        value, along, down = 0.0, 0.0, 0.0
        for k in range(degree + 1):
            for j in range(degree + 1):
                c = coefficients[row + first + k, column + first + j]
                value += wy[k] * wx[j] * c
                along += wy[k] * sx[j] * c
                down += sy[k] * wx[j] * c
        values[m] = value
        gradients[m, 0] = along
        gradients[m, 1] = down


# Spline values along straight lines of points, a vector of them at a time: the inner loop of every registration.

SMALLEST_DRIFT = 1e-30  # of a line that never leaves its row or column


def sample_squares(spline: Spline, centre_px: FloatArray, radius_px: int) -> FloatArray:
    """Return values and gradients (N,3,P) [f,f_x,f_y] on squares around centre_px (N,2).

    P = (2·radius+1)² points, a pixel from each other, row by row. NaN for squares that are not wholly in the image.
    """
    check_shape("centre_px", centre_px, (None, 2))
    line = np.arange(-radius_px, radius_px + 1.0)
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    value, gradient = evaluate(spline, (centre_px[:, None] + offsets).reshape(-1, 2))
    squares = np.concatenate([value[:, None], gradient], axis=1).reshape(len(centre_px), -1, 3)
    squares[np.isnan(squares).any(axis=(1, 2))] = np.nan
    return np.ascontiguousarray(np.swapaxes(squares, 1, 2))


@njit()
def sample_line(c, degree, first, step, grey, span):  # type: ignore[no-untyped-def]
    """Fill grey[begin:end], float32, with spline values at equally spaced points of a line.

    The points are (x, y) + i·(step_x, step_y), i = 0, 1 …, all in the image. c (H+8, W+8): `Spline.coefficients` of
    degree 3, 5 or 7; pairs first: x, y, and span: begin, end. Runs with constant int(x)−i and int(y) are computed a
    vector of points at a time. The polynomials of two runs agree where they meet, so that a point may belong to either.
    A span, not a slice: numba counts references to a slice, which delays the processor's next line.
    """
    begin, end = span
    start = begin
    while start < end:
        at_x, at_y = first[0] + (start - begin) * step[0], first[1] + (start - begin) * step[1]
        stop = _end_of_run(start, end, at_x - int(at_x), at_y - int(at_y), step[0] - 1.0, step[1])
        _run(c, degree, (at_x, at_y), (step[0] - 1.0, step[1]), grey, (start, stop))
        start = stop


@njit()
def sample_points(c, degree, positions, grey, span):  # type: ignore[no-untyped-def]
    """Fill grey[begin:end], float32, with spline values at positions (2, n) within the image.

    [x, y].
    """
    for i in range(positions.shape[1]):
        _run(c, degree, (positions[0, i], positions[1, i]), (0.0, 0.0), grey, (span[0] + i, span[0] + i + 1))


@njit(inline="always")
def warp_inside(coefficients, x, y, radius, warp):  # type: ignore[no-untyped-def]
    """Return whether a square, warped by (6,) or (12,), lies in the image.

    The square is about (x, y). False for NaN.
    """
    x, y = x + warp[0], y + warp[3]
    reach_x = radius * (abs(1.0 + warp[1]) + abs(warp[2]))
    reach_y = radius * (abs(warp[4]) + abs(1.0 + warp[5]))
    if warp.size == 12:
        reach_x += radius**2 * (0.5 * abs(warp[6]) + abs(warp[7]) + 0.5 * abs(warp[8]))
        reach_y += radius**2 * (0.5 * abs(warp[9]) + abs(warp[10]) + 0.5 * abs(warp[11]))
    right, bottom = coefficients.shape[1] - 2.0 * PADDING_PX - 1.0, coefficients.shape[0] - 2.0 * PADDING_PX - 1.0
    return x - reach_x >= 0.0 and x + reach_x <= right and y - reach_y >= 0.0 and y + reach_y <= bottom


@njit(inline="always")
def _end_of_run(start, count, s, t, drift_x, drift_y):  # type: ignore[no-untyped-def]
    """Return the first point at which s + i·drift_x or t + i·drift_y leaves [0,1)."""
    steps = float(count - start)
    if drift_x > SMALLEST_DRIFT:
        steps = min(steps, (1.0 - s) / drift_x)
    elif drift_x < -SMALLEST_DRIFT:
        steps = min(steps, -s / drift_x)
    if drift_y > SMALLEST_DRIFT:
        steps = min(steps, (1.0 - t) / drift_y)
    elif drift_y < -SMALLEST_DRIFT:
        steps = min(steps, -t / drift_y)
    return min(count, start + 1 + int(steps))


@njit(inline="always")
def _run(c, degree, first, drift, grey, span):  # type: ignore[no-untyped-def]
    """Fill points start … stop of one run, the first of them at (x, y)."""
    x, y = first
    column, row = int(x), int(y)
    offset, corner = (x - column, y - row), (row + PADDING_PX - degree // 2, column + PADDING_PX - degree // 2)
    if degree == 7:
        run_septic(c, corner, offset, drift, grey, span)
    elif degree == 5:
        run_quintic(c, corner, offset, drift, grey, span)
    else:
        run_cubic(c, corner, offset, drift, grey, span)
