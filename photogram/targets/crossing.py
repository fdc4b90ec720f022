"""Sub-pixel positions of a chessboard's crossings of two blurred edges."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.images.noise import QUANTISATION, NoiseModel
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.kernels import njit

PARAMETERS = 10  # centre x, y, angles of both edges' normals, mean, half contrast, relative slope x, y, blur of both
GOOD, OUTSIDE, SATURATED, NO_CROSSING, FAINT, SMALL = 0, 1, 2, 3, 4, 5
FULL, STATUS, CHI2 = PARAMETERS, PARAMETERS + 1, PARAMETERS + 2  # columns after those of the parameters
SATURATION, AMOUNT, RADIUS = 3, 4, 5  # of the camera's response
REACH = 3  # px over which noise may be correlated
_RULES = 30, 1e-2, 1e-6, 1e6, True  # of `minimise`; usually fewer than ten steps are needed
_MAX_PIXELS = 20_000  # of a window
_CENTRED_PX, _CONVERGED_PX = 1e-3, 1e-4
"""Steps of the centre that end a fit: for the position of the window, and for the result, with a far smaller error."""
_SMALLEST_WINDOW_PX, _SHARPEST_PX = 4.0, 0.25  # half width of a window; smallest blur σ of the model
_FARTHEST = 0.35  # of a square's side, between a corner and its start


@njit(error_model="numpy")
def cholesky(matrix: FloatArray, damping: float, factor: FloatArray) -> bool:
    """Fill the lower factor of a matrix (P,P) with raised diagonal, if there is one."""
    size = matrix.shape[0]
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j] * (1.0 + damping) if i == j else matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 1e-14 * matrix[i, i]:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@njit(error_model="numpy")
def solve(factor: FloatArray, vector: FloatArray) -> None:
    """Replace a vector by the solution of factor·factorᵀ·x = vector."""
    size = vector.size
    for i in range(size):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@njit(error_model="numpy")
def assign(target: FloatArray, source: FloatArray) -> None:
    """Copy numbers (P,): numba takes seconds to compile an assignment of arrays."""
    for k in range(target.size):
        target[k] = source[k]


@njit(error_model="numpy", inline="always")
def minimise(evaluate, is_small, data, p, rules):  # type: ignore[no-untyped-def]
    """Improve parameters (P,) by Levenberg's method; return sum of squares and normal matrix.

    `evaluate(data, p, matrix, vector)` fills the normal equations and returns the sum of squares, infinite for
    impossible parameters; it may move them to their bounds. `is_small(step, damping)` ends the search. rules: number of
    steps, first damping, least one after a refused step, largest one, and whether the last step counts in any case.
    Without convergence the sum is NaN.
    """
    rounds, damping, least, most, counts = rules
    matrix, tried_matrix = np.empty((p.size, p.size)), np.empty((p.size, p.size))
    factor, vector, tried_vector = np.zeros((p.size, p.size)), np.empty(p.size), np.empty(p.size)
    step, tried, cost, damping, small = np.empty(p.size), p.copy(), math.inf, 10.0 * damping, False
    for k in range(rounds + 1):
        new_cost = evaluate(data, tried, tried_matrix, tried_vector)
        if new_cost <= cost or (small and counts) or k == 0:
            assign(p, tried)
            matrix, tried_matrix, vector, tried_vector = tried_matrix, matrix, tried_vector, vector
            cost, damping = new_cost, damping * 0.1
        elif not small or new_cost == math.inf:
            damping, small = max(damping * 10.0, least), False
        if small:
            return cost, matrix
        if damping > most or not cost < math.inf:
            break
        if cholesky(matrix, damping, factor):
            assign(step, vector)
            solve(factor, step)
            small = is_small(step, damping)
        else:
            step[:] = math.inf
        for i in range(p.size):
            tried[i] = p[i] + step[i]
    return math.nan, matrix


@njit(error_model="numpy")
def _edge(distance: float, sharpness: float) -> tuple[float, float]:
    """Return erf(d/(√2·σ)) and its derivative by d, at their limits beyond 7σ."""
    scaled = distance * sharpness
    if abs(scaled) > 7.0:
        return math.copysign(1.0, scaled), 0.0
    return math.erf(math.sqrt(0.5) * scaled), math.sqrt(2.0 / math.pi) * sharpness * math.exp(-0.5 * scaled * scaled)


@njit(error_model="numpy")
def _crossing(p, d_1, d_2, sharpness):  # type: ignore[no-untyped-def]
    """Return E(d₁/s₁)·E(d₂/s₂), derivatives by d₁, d₂, σ₁, σ₂; s² = σ² (+ τ²)."""
    sharp_1, sharp_2 = sharpness
    e_1, by_1 = _edge(d_1, sharp_1)
    e_2, by_2 = _edge(d_2, sharp_2)
    by_1, by_2 = by_1 * e_2, e_1 * by_2
    return e_1 * e_2, by_1, by_2, -by_1 * d_1 * p[8] * sharp_1 * sharp_1, -by_2 * d_2 * p[9] * sharp_2 * sharp_2


@njit(error_model="numpy")
def _edges(p, response):  # type: ignore[no-untyped-def]
    """Return cosine and sine of both edges' directions, and their sharpness.

    The sharpness as it is, and after a blur by the radius.
    """
    radius = response[RADIUS]
    soft_1, soft_2 = 1.0 / math.sqrt(p[8] * p[8] + radius * radius), 1.0 / math.sqrt(p[9] * p[9] + radius * radius)
    turn = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    return turn, (1.0 / p[8], 1.0 / p[9]), (soft_1, soft_2)


@njit(error_model="numpy")
def _model(p, edges, bend, response, x, y, slope):  # type: ignore[no-untyped-def]
    """Return the grey value at (x, y) and fill its derivatives (10,) by the parameters.

    edges: see `_edges`. (1 + g·r)·(a + b·Q), r from the centre, d_k = n_k·r + bend_k/2·(along the edge)². Q is
    E(d₁/σ₁)·E(d₂/σ₂). For an image sharpened by A at the radius τ, it is (1 + A)·Q less A times the same with √(σ² +
    τ²) for σ.
    """
    rx, ry = x - p[0], y - p[1]
    (cos_1, sin_1, cos_2, sin_2), sharpness, softer = edges
    along_1, along_2 = cos_1 * ry - sin_1 * rx, cos_2 * ry - sin_2 * rx
    across_1, across_2 = cos_1 * rx + sin_1 * ry, cos_2 * rx + sin_2 * ry
    d_1, d_2 = across_1 + 0.5 * bend[0] * along_1 * along_1, across_2 + 0.5 * bend[1] * along_2 * along_2
    q, q_1, q_2, q_3, q_4 = _crossing(p, d_1, d_2, sharpness)
    amount = response[AMOUNT]
    if amount > 0.0:
        soft, soft_1, soft_2, soft_3, soft_4 = _crossing(p, d_1, d_2, softer)
        q, q_1, q_2 = q + amount * (q - soft), q_1 + amount * (q_1 - soft_1), q_2 + amount * (q_2 - soft_2)
        q_3, q_4 = q_3 + amount * (q_3 - soft_3), q_4 + amount * (q_4 - soft_4)
    light, pattern = 1.0 + p[6] * rx + p[7] * ry, p[4] + p[5] * q
    by_1, by_2 = light * p[5] * q_1, light * p[5] * q_2
    slope[0] = -by_1 * cos_1 - by_2 * cos_2 - p[6] * pattern
    slope[1] = -by_1 * sin_1 - by_2 * sin_2 - p[7] * pattern
    slope[2], slope[3] = by_1 * along_1, by_2 * along_2
    slope[4], slope[5] = light, light * q
    slope[6], slope[7] = rx * pattern, ry * pattern
    slope[8], slope[9] = light * p[5] * q_3, light * p[5] * q_4
    return light * pattern


@njit(error_model="numpy")
def _clipped(value: float, expected: float, response: FloatArray) -> bool:
    """Return whether a clipped pixel is consistent with its expected value.

    The expected value is then at least as bright, or as dark.
    """
    return (value >= response[SATURATION] and expected >= value) or (value <= 0.0 and expected <= value)


@njit(error_model="numpy")
def _normal_equations(data, p, matrix, vector):  # type: ignore[no-untyped-def]
    """Fill the weighted normal equations over the pixels (M, 2); return Σ w·r²."""
    image, pixels, bend, response, weight = data
    p[8], p[9] = max(p[8], _SHARPEST_PX), max(p[9], _SHARPEST_PX)
    edges, slope = _edges(p, response), np.empty(PARAMETERS)
    matrix[:] = 0.0
    vector[:] = 0.0
    total = 0.0
    for k in range(pixels.shape[0]):
        value = image[pixels[k, 1], pixels[k, 0]]
        expected = _model(p, edges, bend, response, float(pixels[k, 0]), float(pixels[k, 1]), slope)
        if _clipped(value, expected, response):
            continue
        residual = value - expected
        total += weight[k] * residual * residual
        for i in range(PARAMETERS):
            weighted = weight[k] * slope[i]
            vector[i] += weighted * residual
            for j in range(PARAMETERS):  # all of them: their number is fixed for the compiler
                matrix[i, j] += weighted * slope[j]
    return total


@njit(error_model="numpy")
def _centred(step, damping):  # type: ignore[no-untyped-def]
    return damping < 1.0 and abs(step[0]) + abs(step[1]) < _CENTRED_PX


@njit(error_model="numpy")
def _converged(step, damping):  # type: ignore[no-untyped-def]
    return damping < 1.0 and abs(step[0]) + abs(step[1]) < _CONVERGED_PX


@njit(error_model="numpy")
def _weigh(pixels, taper, p, bend, response, weight):  # type: ignore[no-untyped-def]
    """Fill weights (M,), taper/variance of the noise at the modelled grey values."""
    edges, slope = _edges(p, response), np.empty(PARAMETERS)
    for k in range(pixels.shape[0]):
        expected = _model(p, edges, bend, response, float(pixels[k, 0]), float(pixels[k, 1]), slope)
        weight[k] = taper[k] / max(response[0] + response[1] * expected, response[2])


@njit(error_model="numpy")
def _window(image, centre, axes, size, pixels, taper):  # type: ignore[no-untyped-def]
    """Fill the pixels (M,2) of a corner's window; return their number, −1 outside.

    Along the lattice's axes the window reaches `size[0]` of a square to either side. In quadrants of the colour
    `size[2]`, 1 where both axes have the same sign, the weights `taper` (M,) fall to 0 within `size[1]` of a square
    from the nearer edge, as (1 − x²)². The smooth decrease avoids steps with the pixels' phase.
    """
    determinant = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    half_x = size[0] * (abs(axes[0, 0]) + abs(axes[1, 0]))
    half_y = size[0] * (abs(axes[0, 1]) + abs(axes[1, 1]))
    left, right = math.ceil(centre[0] - half_x), math.floor(centre[0] + half_x)
    top, bottom = math.ceil(centre[1] - half_y), math.floor(centre[1] + half_y)
    if left < 0 or top < 0 or right >= image.shape[1] or bottom >= image.shape[0]:
        return -1
    count = 0
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            rx, ry = column - centre[0], row - centre[1]
            s = (rx * axes[1, 1] - ry * axes[1, 0]) / determinant
            t = (ry * axes[0, 0] - rx * axes[0, 1]) / determinant
            far = min(abs(s), abs(t)) / size[1] if s * t * size[2] > 0.0 else 0.0
            if abs(s) <= size[0] and abs(t) <= size[0] and far < 1.0 and count < pixels.shape[0]:
                pixels[count, 0], pixels[count, 1] = column, row
                taper[count] = (1.0 - far * far) ** 2
                count += 1
    return count


@njit(error_model="numpy")
def _start(image, pixels, centre, axes, p):  # type: ignore[no-untyped-def]
    """Fill start values: edges along the axes, grey levels from the means of the quadrants."""
    sums, counts = np.zeros(2), np.full(2, 1e-9)
    determinant = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    for k in range(pixels.shape[0]):
        rx, ry = pixels[k, 0] - centre[0], pixels[k, 1] - centre[1]
        s, t = rx * axes[1, 1] - ry * axes[1, 0], ry * axes[0, 0] - rx * axes[0, 1]
        kind = 0 if s * t > 0.0 else 1
        sums[kind] += image[pixels[k, 1], pixels[k, 0]]
        counts[kind] += 1.0
    sign = 1.0 if determinant > 0.0 else -1.0
    p[0], p[1] = centre[0], centre[1]
    p[2] = math.atan2(-sign * axes[1, 0], sign * axes[1, 1])
    p[3] = math.atan2(sign * axes[0, 0], -sign * axes[0, 1])
    same, other = sums[0] / counts[0], sums[1] / counts[1]
    p[4], p[5], p[6], p[7] = 0.5 * (same + other), 0.5 * (same - other), 0.0, 0.0
    p[8], p[9] = 1.0, 1.0


@njit(error_model="numpy")
def _centre_rows(matrix, inverse):  # type: ignore[no-untyped-def]
    """Fill the centre's rows (2, 10) of a matrix's inverse; return whether there is one."""
    factor = np.zeros((PARAMETERS, PARAMETERS))
    if not cholesky(matrix, 0.0, factor):
        return False
    for i in range(2):
        inverse[i] = 0.0
        inverse[i, i] = 1.0
        solve(factor, inverse[i])
    return True


@njit(error_model="numpy")
def _box(pixels):  # type: ignore[no-untyped-def]
    """Return left, top, width and height of pixels: numba's minimum would import SciPy's algebra."""
    left, top = pixels[0]
    right, bottom = pixels[0]
    for k in range(pixels.shape[0]):
        left, right = min(left, pixels[k, 0]), max(right, pixels[k, 0])
        top, bottom = min(top, pixels[k, 1]), max(bottom, pixels[k, 1])
    return left, top, right - left + 1, bottom - top + 1


@njit(error_model="numpy")
def _spread(image, pixels, taper, weight, p, bend, response, inverse, patch):  # type: ignore[no-untyped-def]
    """Fill the patch (4,H,W) with taper, tapered residual, pull in x and y.

    The residual is in standard deviations. The pull is the shift of the centre by a residual of one standard deviation.
    All are 0 where no pixel counts.
    """
    edges, slope = _edges(p, response), np.empty(PARAMETERS)
    patch[:] = 0.0
    left, top, _, _ = _box(pixels)
    left -= REACH
    for k in range(pixels.shape[0]):
        column, row = pixels[k, 0], pixels[k, 1]
        expected = _model(p, edges, bend, response, float(column), float(row), slope)
        if taper[k] == 0.0 or _clipped(image[row, column], expected, response):
            continue
        x, y = 0.0, 0.0
        for i in range(PARAMETERS):
            x += inverse[0, i] * slope[i]
            y += inverse[1, i] * slope[i]
        share = math.sqrt(taper[k] * weight[k])
        i, j = row - top, column - left
        patch[0, i, j], patch[1, i, j] = taper[k], (image[row, column] - expected) * share
        patch[2, i, j], patch[3, i, j] = share * x, share * y


@njit(error_model="numpy")
def _correlate(patch, out):  # type: ignore[no-untyped-def]
    """Fill out (4,L) with products of residuals and of pulls, by lag.

    The mean of the residuals' products, weighted by the tapers; the sum of the pulls' products over pairs in both
    orders.
    """
    for lag in range(out.shape[1]):
        down, along = lag // (2 * REACH + 1), lag % (2 * REACH + 1) - REACH
        product, weight, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(patch.shape[1] - down):
            for j in range(REACH, patch.shape[2] - REACH):
                k, m = i + down, j + along
                weight += patch[0, i, j] * patch[0, k, m]
                product += patch[1, i, j] * patch[1, k, m]
                xx += patch[2, i, j] * patch[2, k, m]
                xy += patch[2, i, j] * patch[3, k, m] + patch[3, i, j] * patch[2, k, m]
                yy += patch[3, i, j] * patch[3, k, m]
        out[0, lag] = product / max(weight, 1.0)
        both = 1.0 if down == 0 else 2.0  # lags (0, ±k) are both present
        out[1, lag], out[2, lag], out[3, lag] = both * xx, both * 0.5 * xy, both * yy


@njit(error_model="numpy")
def fit_crossings(image, corners, response, fitted, lags):  # type: ignore[no-untyped-def]
    """Fill fitted (N,13) and lags (N,4,28) for corners expected at start (N,2).

    fitted: parameters (10), share of saturated pixels, status, χ² per pixel. Finite parameters are the start of the
    fit. Otherwise it starts from the lattice, and a preliminary fit places the window.

    lags: see `_correlate`, NaN without a corner.

    axes (N, 2, 2): a square's two sides in px. bend (N, 2): curvature of both edges, 1/px. window (N, 3): see
    `_window`.

    response (6,): variance of a black pixel, its rise per grey value, its least value; the grey value that counts as
    saturated; amount and radius of the sharpening.
    """
    start, axes, bend, window = corners
    buffer, weight, taper = np.empty((_MAX_PIXELS, 2), dtype=np.int32), np.empty(_MAX_PIXELS), np.empty(_MAX_PIXELS)
    inverse, p, size = np.empty((2, PARAMETERS)), np.empty(PARAMETERS), np.empty(3)
    for n in range(start.shape[0]):
        out = fitted[n]
        assign(p, out)
        has_start = not math.isnan(p[0])
        out[:], lags[n] = math.nan, math.nan
        out[STATUS] = OUTSIDE
        shorter = math.sqrt(min(axes[n, 0, 0] ** 2 + axes[n, 0, 1] ** 2, axes[n, 1, 0] ** 2 + axes[n, 1, 1] ** 2))
        assign(size, window[n])
        count = _window(image, start[n], axes[n], size, buffer, taper)
        while count < 0 and 0.8 * size[0] * shorter > _SMALLEST_WINDOW_PX:
            size[0] *= 0.8
            count = _window(image, start[n], axes[n], size, buffer, taper)
        if count < 2 * PARAMETERS:
            out[STATUS] = OUTSIDE if count < 0 else SMALL
            continue
        full = 0
        for k in range(count):
            full += image[buffer[k, 1], buffer[k, 0]] >= response[SATURATION]
        out[FULL], out[STATUS], cost = full / count, NO_CROSSING, 0.0
        if not has_start:
            _start(image, buffer[:count], start[n], axes[n], p)
            _weigh(buffer[:count], taper, p, bend[n], response, weight)
            data = image, buffer[:count], bend[n], response, weight
            cost, _ = minimise(_normal_equations, _centred, data, p, _RULES)
        if not (cost >= 0.0 and math.hypot(p[0] - start[n, 0], p[1] - start[n, 1]) < _FARTHEST * shorter):
            continue
        recount = _window(image, p[:2].copy(), axes[n], size, buffer, taper)
        count = recount if recount > 0 else _window(image, start[n], axes[n], size, buffer, taper)
        pixels = buffer[:count]
        _weigh(pixels, taper, p, bend[n], response, weight)
        cost, matrix = minimise(_normal_equations, _converged, (image, pixels, bend[n], response, weight), p, _RULES)
        if not (cost >= 0.0 and _centre_rows(matrix, inverse)):
            continue
        _, _, wide, high = _box(pixels)
        patch = np.empty((4, high, wide + 2 * REACH))
        _spread(image, pixels, taper, weight, p, bend[n], response, inverse, patch)
        _correlate(patch, lags[n])
        assign(out[:PARAMETERS], p)
        out[STATUS], out[CHI2] = GOOD, cost / count


# Sub-pixel positions of chessboard corners, by least squares to the crossing of two blurred edges.

REASONS = {
    GOOD: "found",
    OUTSIDE: "too close to the image's edge",
    SATURATED: "overexposed",
    NO_CROSSING: "no crossing of two edges",
    FAINT: "with less than 0.4 of the usual contrast, or exchanged colours",
    SMALL: "with too few pixels around them",
}
_WINDOW = 0.55  # of a square's side, to either side of the corner
_WIDEST_PX = 14.0  # the same, in px: beyond it the edges' curvature costs more than they add
_APERTURE = 1.0 / 12.0  # variance of a pixel's width, part of the fitted blur
_SATURATED = 0.995  # of full scale
_MOST_SATURATED = 0.3  # share of a window, above which it is the reason of a failure
_LEAST_SIGNAL = 4.0  # half contrast in standard deviations of the noise
_PROBES = 8  # corners from which the sharpening is found
_AMOUNTS = (0.5, 1.5, 3.0)  # tried first
_PRECISION = 0.03  # of amount and radius
_SHARPENINGS = ((0.0, 8.0), (0.4, 4.0))  # amount, radius in px
_FEWEST = 6  # corners that determine the noise
_COLOURED = 0.25  # autocovariance, relative to the assumed noise, above which that of the residuals is used
_LEAST_VARIANCE = 0.05  # of that for independent noise
_BETTER = 0.98  # χ² with sharpening over that without, for there to be any


@dataclass(frozen=True)
class CameraResponse:
    """Response of the camera: `noise` and `full_scale` in grey values, and its unsharp mask.

    `amount` A and `radius_px` τ of the mask: the image is (1 + A)·I − A·(I blurred by a Gaussian of σ = τ).
    """

    noise: NoiseModel
    full_scale: float
    amount: float = 0.0
    radius_px: float = 1.0

    def vector(self) -> FloatArray:
        """Return the numbers (6,) for `fit_crossings`."""
        noise = self.noise.read_variance_grey2, self.noise.variance_per_grey, QUANTISATION
        return np.array([*noise, _SATURATED * self.full_scale, self.amount, self.radius_px])


@dataclass(frozen=True, eq=False, repr=False)
class Corners(
    Arrays, shapes="position_px N 2; covariance_px2 N 2 2; blur_px N; half_contrast N; status N; parameters N P"
):
    """Fitted corners, NaN where `status` (N,) is not 0 (see `REASONS`).

    Attributes
    ----------
    position_px : (N, 2).
    covariance_px2 : (N, 2, 2).
    blur_px : (N,) σ of the edges without the pixels' width and the sharpening.
    half_contrast : (N,) half the difference of the quadrants in grey values, positive where those between axes of equal
        sign are bright.
    parameters : (N, 10) of the fit, from which another fit may start.
    """

    position_px: FloatArray
    covariance_px2: FloatArray
    blur_px: FloatArray
    half_contrast: FloatArray
    status: IntArray
    parameters: FloatArray


def refine_corners(
    image: NDArray[Any],
    start_px: FloatArray,
    axes_px: FloatArray,
    response: CameraResponse,
    bend_per_px: FloatArray | None = None,
    strip: float = np.inf,
    before: Corners | None = None,
) -> Corners:
    """Return the corners of squares near start_px (N, 2) in an image (H, W).

    axes_px (N, 2, 2): a square's sides from the corner, in px, along the first and the second lattice direction. The
    grey values around a corner are fitted by (1 + g·r)·(a + b·erf(d₁/√2σ₁)·erf(d₂/√2σ₂)), d₁ and d₂ the distances from
    two lines of free direction, sharpened as by the camera, weighted by the noise. For any blur the crossing of two
    straight edges is point-symmetric about the corner, except for the light's slope g. An imperfect edge profile
    therefore shifts it only with the pixels' phase. Pixels at full scale or 0 count only where the fit is within the
    range. Edges that the lens bends are not symmetric: bend_per_px (N, 2), the curvature of the edges along the second
    and the first direction, is fixed (`lattice_bend`). The window ends 0.55 squares or 14 px from the corner; `strip`:
    in bright squares only pixels within so many squares of an edge count, with decreasing weight (ChArUco: the markers
    lie beyond). Corners in `before` are the start of the fit, the others start at start_px.

    The covariance is that of the weighted fit for the noise of the residuals, the other parameters unknown. Where
    residuals are correlated over up to 3 px (sharpening, demosaicing, compression), it is that for correlated noise.
    """
    check_shape("start_px", start_px, (None, 2))
    fitted = np.full((len(start_px), PARAMETERS + 3), np.nan)
    if before is not None:
        fitted[:, :PARAMETERS] = before.parameters
    lags = _fit_all(image, (start_px, axes_px, bend_per_px), response, strip, fitted)
    status = fitted[:, STATUS].astype(np.int64)
    status[(status == NO_CROSSING) & (fitted[:, FULL] > _MOST_SATURATED)] = SATURATED
    sigma = np.sqrt(response.noise.variance(fitted[:, 4]))
    status[(status == GOOD) & ~(np.abs(fitted[:, 5]) > _LEAST_SIGNAL * sigma)] = NO_CROSSING
    good = status == GOOD
    blur = np.sqrt(np.maximum(0.5 * (fitted[:, 8] ** 2 + fitted[:, 9] ** 2) - _APERTURE, 0.0))
    return Corners(
        np.where(good[:, None], fitted[:, :2], np.nan),
        np.where(good[:, None, None], _covariance(lags, good, response.amount > 0), np.nan),
        np.where(good, blur, np.nan),
        np.where(good, fitted[:, 5], np.nan),
        status,
        np.where(good[:, None], fitted[:, :PARAMETERS], np.nan),
    )


def _fit_all(
    image: NDArray[Any],
    corners: tuple[FloatArray, FloatArray, FloatArray | None],
    response: CameraResponse,
    strip: float,
    fitted: FloatArray,
) -> FloatArray:
    """Fill `fitted` (N,13) and return the lags (N,4,28) of corners, as `fit_crossings`."""
    import cv2

    start_px, axes_px, bend_per_px = corners
    count = len(start_px)
    check_shape("axes_px", axes_px, (count, 2, 2))
    bend = np.zeros((count, 2)) if bend_per_px is None else bend_per_px
    check_shape("bend_per_px", bend, (count, 2))
    grey = np.ascontiguousarray(image, dtype=np.float32)
    side = np.linalg.norm(axes_px, axis=2).max(axis=1)
    window = np.zeros((count, 3))
    window[:, 0] = np.minimum(_WINDOW, _WIDEST_PX / side)
    window[:, 1] = strip
    if np.isfinite(strip):  # +1 where the quadrants between axes of equal sign are the brighter ones, else −1
        points = start_px[:, None, :] + 0.08 * np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]]) @ axes_px
        x, y = np.ascontiguousarray(np.moveaxis(points, -1, 0), dtype=np.float32)
        values = np.asarray(cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        window[:, 2] = np.where(values[:, :2].sum(axis=1) > values[:, 2:].sum(axis=1), 1.0, -1.0)
    lags = np.empty((count, 4, (REACH + 1) * (2 * REACH + 1)))
    fit_crossings(grey, (start_px, axes_px, bend, window), response.vector(), fitted, lags)
    return lags


def _covariance(lags: FloatArray, good: BoolArray, sharpened: bool) -> FloatArray:
    """Return the covariance (N, 2, 2) of the centres for the noise's autocovariance.

    The autocovariance is the median over the corners of the residuals' products (`fit_crossings`). It is used where it
    differs by more than three standard errors (√(π/2)/√N times their robust spread) from that of independent pixels.
    Unless `sharpened`, independent noise is assumed where no product differs by a quarter, and where the variance is
    larger by a quarter: an imperfect profile causes both.
    """
    white = np.zeros(lags.shape[2])
    white[REACH] = 1.0
    sums = np.asarray(np.moveaxis(lags[:, 1:], 1, -1))
    if good.sum() < _FEWEST:
        return np.asarray((white @ sums)[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    products = lags[good, 0]
    middle = np.median(products, axis=0)
    error = 1.25 * 1.4826 * np.median(np.abs(products - middle), axis=0) / math.sqrt(len(products))
    noise = np.where(np.abs(middle - white) > 3 * error, middle, white)
    coloured = np.abs(middle - white).max() > _COLOURED and middle[REACH] < 1.0 + _COLOURED
    noise = noise if sharpened or coloured else white
    spread = np.asarray((noise @ sums)[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    floor = _LEAST_VARIANCE * (white @ sums)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    valid = np.linalg.eigvalsh(np.nan_to_num(spread - floor))[:, 0] >= 0.0
    return np.where(valid[:, None, None], spread, floor)


def find_sharpening(
    image: NDArray[Any], start_px: FloatArray, axes_px: FloatArray, response: CameraResponse, strip: float = np.inf
) -> CameraResponse:
    """Return the camera's response with the unsharp mask under which some corners fit best.

    Unchanged if no mask improves the fit.
    """
    probes = np.unique(np.linspace(0, len(start_px) - 1, _PROBES).astype(int))

    def chi2(mask: FloatArray) -> float:
        """Return the corners' median χ² per pixel, infinite where most of them fail."""
        (low, high), (near, far) = _SHARPENINGS
        if not (low <= mask[0] <= high and near <= mask[1] <= far):
            return math.inf
        tried = replace(response, amount=float(mask[0]), radius_px=float(mask[1]))
        fitted = np.full((len(probes), PARAMETERS + 3), np.nan)
        _fit_all(image, (start_px[probes], axes_px[probes], None), tried, strip, fitted)
        return float(np.median(np.where(fitted[:, STATUS] == GOOD, fitted[:, CHI2], math.inf)))

    least, start = chi2(np.array([0.0, 1.0])), None
    for amount in _AMOUNTS:
        first = np.array([amount, 1.0])
        value = chi2(first)
        if value < _BETTER * least:
            least, start = value, first
        elif least < math.inf:
            break
    if start is None:
        return response
    from scipy.optimize import minimize

    simplex = start + np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.4]])
    options = {"initial_simplex": simplex, "xatol": _PRECISION, "fatol": 1e-3}
    best = minimize(chi2, start, method="Nelder-Mead", options=options)
    return replace(response, amount=float(best.x[0]), radius_px=float(best.x[1]))
