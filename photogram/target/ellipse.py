"""The blurred ellipse that a round dot shows: its centre to a few thousandths of a pixel, with covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray, check_shape
from photogram._kernel import njit

PARAMETERS = 10
SECTORS = 16
PASSES = ((0.02, 8), (1e-5, 20))
LEAST_BAND_PX = 2.0
BAND_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class Ellipses:
    """N fitted ellipses (x − c)ᵀ S⁻¹ (x − c) = 1; all NaN where the fit failed.

    `centre_px` c (N, 2) and its `covariance_px2` (N, 2, 2); `shape_px2` S (N, 2, 2), of determinant (product of the
    semi-axes)²; `blur_px` (N,): σ of the edge; `contrast` (N,): dot less background, grey values; `noise` (N,): rms of what is
    left, grey values; `roughness_px` (N,): rms over sixteen sectors of how far the edge lies off the ellipse.
    """

    centre_px: FloatArray
    covariance_px2: FloatArray
    shape_px2: FloatArray
    blur_px: FloatArray
    contrast: FloatArray
    noise: FloatArray
    roughness_px: FloatArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        count = len(self.centre_px)
        check_shape("centre_px", self.centre_px, (count, 2))
        for name in ("covariance_px2", "shape_px2"):
            check_shape(name, getattr(self, name), (count, 2, 2))
        for name in ("blur_px", "contrast", "noise", "roughness_px"):
            check_shape(name, getattr(self, name), (count,))

    @property
    def radius_px(self) -> FloatArray:
        """Radius (N,) of the circle of the same area, free of the blur, which moves the edge inwards by σ²/2r.

        The edge of a disc that diffuses for the time σ²/2 obeys u_t = u_rr + u_r/r and so drifts at the speed −1/r.
        """
        seen = np.sqrt(np.sqrt(np.linalg.det(self.shape_px2)))
        return np.asarray(seen + self.blur_px**2 / (2.0 * seen))


def fit_ellipses(
    image: NDArray[Any],
    start_px: FloatArray,
    start_shape_px2: FloatArray,
    reach_px: FloatArray,
    ring: NDArray[np.bool_],
) -> Ellipses:
    """Fit a blurred ellipse to each of N dots of an image (H, W).

    I(x) = (1 + γ·(x − x₀)) (B + C/2 erfc(s/(√2 σ))), s the distance of x from the ellipse, positive outside: centre,
    shape, σ, background B, contrast C and the slope γ of the lighting, by Levenberg–Marquardt over the pixels in a band
    of ±(4 σ + 2 px) about the edge. s is the distance to first order (ρ − 1)/|∇ρ| with ρ² = (x − c)ᵀ S⁻¹ (x − c), exact
    for circles (Sampson 1982, Comput. Graph. Image Process. 18, 97). Blur and the pixels' area leave a dot symmetric
    about its centre, so a wrong profile of the edge does not move the centre. The covariance
    H⁻¹ (Σ r²/(1 − jᵀH⁻¹j) j jᵀ) H⁻¹, H = Σ j jᵀ, holds for noise that differs from pixel to pixel (White 1980,
    Econometrica 48, 817, with the residuals' variances as in MacKinnon and White 1985, J. Econometrics 29, 305).

    `start_px` (N, 2), `start_shape_px2` (N, 2, 2): where to begin. `reach_px` (N,): the band ends there outside the
    edge, before the next dot. `ring` (N,): of these only the outer quarter of the radius is used.
    """
    count = len(start_px)
    check_shape("start_px", start_px, (count, 2))
    check_shape("start_shape_px2", start_shape_px2, (count, 2, 2))
    check_shape("reach_px", reach_px, (count,))
    found = np.full((count, PARAMETERS), np.nan)
    spread = np.full((count, 5), np.nan)
    _fit_all(
        np.ascontiguousarray(image, dtype=np.float32), start_px, np.linalg.inv(start_shape_px2), reach_px, ring, found,
        spread,
    )  # fmt: skip
    precision = found[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return Ellipses(
        centre_px=found[:, :2],
        covariance_px2=spread[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        shape_px2=np.linalg.inv(precision),
        blur_px=found[:, 5],
        contrast=found[:, 7],
        noise=spread[:, 3],
        roughness_px=spread[:, 4],
    )


@njit()
def _fit_all(image, starts, precisions, reach, ring, found, spread):  # type: ignore[no-untyped-def]
    """Every dot on its own; a failed one stays NaN."""
    for n in range(len(starts)):
        origin = (starts[n, 0], starts[n, 1])
        parameters = _first_guess(image, origin, precisions[n])
        good = True
        for small_step, most_steps in PASSES:
            band = _band(parameters, reach[n], ring[n])
            good = good and _descend(image, origin, band, parameters, (small_step, most_steps))
        if good:
            _judge(image, origin, band, parameters, spread[n])
            found[n] = parameters


@njit()
def _first_guess(image, origin, precision):  # type: ignore[no-untyped-def]
    """Parameters (10,) cx cy, S⁻¹ as xx xy yy, σ, B, C, γx γy, with B and C from the means on both sides of the edge."""
    parameters = np.zeros(PARAMETERS)
    parameters[0], parameters[1] = origin
    parameters[2], parameters[3], parameters[4] = precision[0, 0], precision[0, 1], precision[1, 1]
    parameters[5] = 1.0
    sums = np.zeros(4)
    rows, columns = _box(image, parameters, 3.0)
    for y in range(rows[0], rows[1]):
        for x in range(columns[0], columns[1]):
            _, distance, _ = _distance(parameters, x, y)
            if -4.0 < distance < 4.0:
                side = 0 if distance > 0.0 else 2
                sums[side] += image[y, x]
                sums[side + 1] += 1.0
    if sums[1] > 0.0 and sums[3] > 0.0:
        parameters[6] = sums[0] / sums[1]
        parameters[7] = sums[2] / sums[3] - parameters[6]
    return parameters


@njit()
def _box(image, parameters, margin):  # type: ignore[no-untyped-def]
    """Rows and columns, each (first, after last), that hold the ellipse and a margin, within the image."""
    a, b, c = parameters[2], parameters[3], parameters[4]
    determinant = a * c - b * b
    half_x = math.sqrt(c / determinant) + margin
    half_y = math.sqrt(a / determinant) + margin
    rows = max(0, math.ceil(parameters[1] - half_y)), min(image.shape[0], math.floor(parameters[1] + half_y) + 1)
    columns = max(0, math.ceil(parameters[0] - half_x)), min(image.shape[1], math.floor(parameters[0] + half_x) + 1)
    return rows, columns


@njit()
def _distance(parameters, x, y):  # type: ignore[no-untyped-def]
    """Return ρ, the distance from the ellipse and |S⁻¹ p| of a pixel at p from the centre."""
    px, py = x - parameters[0], y - parameters[1]
    gx = parameters[2] * px + parameters[3] * py
    gy = parameters[3] * px + parameters[4] * py
    rho = math.sqrt(max(px * gx + py * gy, 1e-12))
    length = max(math.sqrt(gx * gx + gy * gy), 1e-12)
    return rho, (rho - 1.0) * rho / length, length


@njit()
def _band(parameters, reach, ring):  # type: ignore[no-untyped-def]
    """Ellipse (5,) as it is now and how far inside and outside of its edge pixels are used: the same through a pass."""
    a, b, c = parameters[2], parameters[3], parameters[4]
    half = (a + c) / 2.0
    minor = 1.0 / math.sqrt(half + math.sqrt(max(half * half - (a * c - b * b), 0.0)))
    wide = BAND_SIGMAS * parameters[5] + LEAST_BAND_PX
    inside = min(wide, 0.25 * minor) if ring else wide
    return parameters[:5].copy(), inside, min(wide, max(reach, LEAST_BAND_PX))


@njit()
def _model(parameters, origin, x, y, slope):  # type: ignore[no-untyped-def]
    """Return the model's grey value at a pixel and write its derivatives to slope (10,)."""
    rho, distance, length = _distance(parameters, x, y)
    sigma, background, contrast = parameters[5], parameters[6], parameters[7]
    u = distance / sigma
    covered = 0.5 * math.erfc(u / math.sqrt(2.0))
    light = 1.0 + parameters[8] * (x - origin[0]) + parameters[9] * (y - origin[1])
    by_distance = -light * contrast * math.exp(-0.5 * u * u) / (math.sqrt(2.0 * math.pi) * sigma)
    px, py = x - parameters[0], y - parameters[1]
    a, b, c = parameters[2], parameters[3], parameters[4]
    gx, gy = a * px + b * py, b * px + c * py
    by_square = by_distance * (1.0 - 0.5 / rho) / length
    by_length = -by_distance * distance / (length * length)
    slope[0] = -2.0 * by_square * gx - by_length * (gx * a + gy * b)
    slope[1] = -2.0 * by_square * gy - by_length * (gx * b + gy * c)
    slope[2] = by_square * px * px + by_length * gx * px
    slope[3] = 2.0 * by_square * px * py + by_length * (gx * py + gy * px)
    slope[4] = by_square * py * py + by_length * gy * py
    slope[5] = -by_distance * u
    slope[6] = light
    slope[7] = light * covered
    level = background + contrast * covered
    slope[8] = level * (x - origin[0])
    slope[9] = level * (y - origin[1])
    return light * level, by_distance


@njit()
def _normal_equations(image, origin, band, parameters, matrix, vector):  # type: ignore[no-untyped-def]
    """Sum Jᵀ J and Jᵀ r over the band; return the sum of squares and the number of pixels."""
    ellipse, inside, outside = band
    matrix[:] = 0.0
    vector[:] = 0.0
    slope = np.empty(PARAMETERS)
    squares, pixels = 0.0, 0
    rows, columns = _box(image, ellipse, outside + 1.0)
    for y in range(rows[0], rows[1]):
        for x in range(columns[0], columns[1]):
            _, distance, _ = _distance(ellipse, x, y)
            if distance < -inside or distance > outside:
                continue
            value, _ = _model(parameters, origin, x, y, slope)
            residual = image[y, x] - value
            squares += residual * residual
            pixels += 1
            for i in range(PARAMETERS):
                vector[i] += slope[i] * residual
                for j in range(i + 1):
                    matrix[i, j] += slope[i] * slope[j]
    for i in range(PARAMETERS):
        for j in range(i):
            matrix[j, i] = matrix[i, j]
    return squares, pixels


@njit()
def _descend(image, origin, band, parameters, until):  # type: ignore[no-untyped-def]
    """Levenberg–Marquardt until centre and σ move less than a step; return whether it got there."""
    small_step, most_steps = until
    matrix, trial_matrix = np.empty((PARAMETERS, PARAMETERS)), np.empty((PARAMETERS, PARAMETERS))
    vector, trial_vector = np.empty(PARAMETERS), np.empty(PARAMETERS)
    squares, pixels = _normal_equations(image, origin, band, parameters, matrix, vector)
    damping = 1e-3
    for _ in range(most_steps):
        scale = np.sqrt(np.diag(matrix))
        if pixels <= PARAMETERS or not scale.min() > 0.0:
            return False
        step = np.linalg.solve(matrix / np.outer(scale, scale) + damping * np.eye(PARAMETERS), vector / scale) / scale
        trial = parameters + step
        moved = max(abs(step[0]), abs(step[1]), abs(step[5]))
        if _possible(trial):
            trial_squares, _ = _normal_equations(image, origin, band, trial, trial_matrix, trial_vector)
            if trial_squares <= squares:
                parameters[:] = trial
                squares, damping = trial_squares, max(0.1 * damping, 1e-12)
                matrix[:], vector[:] = trial_matrix, trial_vector
                if moved < small_step:
                    return True
                continue
            if moved < small_step:
                return True
        damping *= 10.0
    return small_step > 1e-3


@njit()
def _possible(parameters):  # type: ignore[no-untyped-def]
    """Whether the parameters are an ellipse with a blur that a dot can have."""
    a, b, c = parameters[2], parameters[3], parameters[4]
    determinant = a * c - b * b
    if not (determinant > 0.0 and a > 0.0 and parameters[5] > 0.05):
        return False
    area = 1.0 / math.sqrt(determinant)
    return 1.0 < area < 1e7 and parameters[5] ** 2 < area


@njit()
def _judge(image, origin, band, parameters, spread):  # type: ignore[no-untyped-def]
    """Write the centre's variances xx xy yy, the noise and the roughness of the edge."""
    ellipse, inside, outside = band
    matrix, covariance = np.zeros((PARAMETERS, PARAMETERS)), np.zeros((2, 2))
    slope, vector = np.empty(PARAMETERS), np.empty(PARAMETERS)
    moved, weight = np.zeros(SECTORS), np.zeros(SECTORS)
    squares, pixels = _normal_equations(image, origin, band, parameters, matrix, vector)
    scale = np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix / np.outer(scale, scale) + 1e-12 * np.eye(PARAMETERS)) / np.outer(scale, scale)
    rows, columns = _box(image, ellipse, outside + 1.0)
    for y in range(rows[0], rows[1]):
        for x in range(columns[0], columns[1]):
            _, distance, _ = _distance(ellipse, x, y)
            if distance < -inside or distance > outside:
                continue
            value, by_distance = _model(parameters, origin, x, y, slope)
            residual = image[y, x] - value
            turn = math.atan2(y - parameters[1], x - parameters[0]) / (2.0 * math.pi) + 0.5
            sector = min(int(turn * SECTORS), SECTORS - 1)
            moved[sector] += by_distance * residual
            weight[sector] += by_distance * by_distance
            pull = inverse @ slope
            variance = residual * residual / (1.0 - slope @ pull)
            for i in range(2):
                for j in range(2):
                    covariance[i, j] += pull[i] * pull[j] * variance
    spread[0], spread[1], spread[2] = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    spread[3] = math.sqrt(squares / (pixels - PARAMETERS))
    spread[4] = math.sqrt(np.mean((moved / np.maximum(weight, 1e-12)) ** 2))
