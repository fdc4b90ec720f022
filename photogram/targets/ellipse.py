"""Dots: blobs, and the ellipses of their edges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import Arrays, BoolArray, FloatArray, check_shape
from photogram.kernels import njit
from photogram.targets.crossing import cholesky, solve

MIN_AREA_PX = 20  # of a dot with a measurable ellipse
EDGE_PX = 3  # margin of the image
WINDOW_CELLS = 24  # pixels of a window after reduction
MIN_CONTRAST = 0.15  # of the usual one
FULL_ELLIPSE = (0.85, 1.12)  # area over that of the ellipse of the same moments
MOST_ELONGATED = 3.5  # ratio of the semi-axes, a tilt of 73°
HOLE = (0.03, 0.6)  # area over that of the dot
HOLE_OFF_CENTRE = 0.15  # radii


@dataclass(frozen=True, eq=False, repr=False)
class Blobs(Arrays, shapes="centre_px N 2; shape_px2 N 2 2; ring N"):
    """N patches that may be dots.

    `shape_px2` S (N, 2, 2): of the ellipse xᵀ S⁻¹ x = 1 about centre_px (N, 2) with the patch's second moments. `ring`
    (N,): whether it has a round hole in its middle, which counts as filled.
    """

    centre_px: FloatArray
    shape_px2: FloatArray
    ring: BoolArray

    @property
    def radius_px(self) -> FloatArray:
        """Radius (N,) of the circle of the same area."""
        return np.asarray(np.linalg.det(self.shape_px2) ** 0.25)


def find_blobs(image: NDArray[Any], window_px: float) -> tuple[Blobs, Blobs]:
    """Return the dark and the bright elliptic patches that lie wholly within an image (H,W).

    The threshold is the mean of the grey closing and the grey opening over squares of `window_px`. These must be larger
    than the dots and than the gaps between them. The threshold follows lighting that is smooth over such a square.
    """
    import cv2

    height, width = image.shape
    factor = max(1, int(window_px // WINDOW_CELLS))
    grey = np.asarray(image, dtype=np.float32)
    coarse = cv2.resize(grey, (max(1, width // factor), max(1, height // factor)), interpolation=cv2.INTER_AREA)
    side = max(3, round(window_px / factor) | 1)
    square = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
    upper, lower = (cv2.morphologyEx(coarse, kind, square) for kind in (cv2.MORPH_CLOSE, cv2.MORPH_OPEN))
    contrast = upper - lower
    distinct = contrast > MIN_CONTRAST * float(np.quantile(contrast, 0.9))
    level = cv2.resize((upper + lower) / 2, (width, height), interpolation=cv2.INTER_LINEAR)
    used = cv2.resize(distinct.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).view(np.bool_)
    smooth = cv2.blur(grey, (3, 3)) if factor > 1 else grey
    dark, bright = _Patches.of((smooth < level) & used), _Patches.of((smooth > level) & used)
    return _elliptic(dark, bright), _elliptic(bright, dark)


@dataclass(frozen=True, eq=False)
class _Patches:
    """Candidates of dots or holes: area, centre, second central moments, and boxes."""

    area: FloatArray
    centre: FloatArray
    moments: FloatArray
    box: FloatArray

    @staticmethod
    def of(mask: BoolArray) -> _Patches:
        """Return patches of a mask that fill their box as ellipse or ring.

        Patches at the image's edge are excluded.
        """
        import cv2

        _, found, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
        labels = np.asarray(found, dtype=np.int32)
        left, top, width, height, area = np.asarray(stats, dtype=np.float64).T
        right, bottom = left + width, top + height
        inside = (left >= EDGE_PX) & (top >= EDGE_PX)
        inside &= (right <= mask.shape[1] - EDGE_PX) & (bottom <= mask.shape[0] - EDGE_PX)
        longer, shorter = np.maximum(width, height), np.minimum(width, height)
        accepted = (
            inside & (area >= MIN_AREA_PX / 4) & (area < mask.size / 20) & (longer <= MOST_ELONGATED * shorter + 1)
        )
        accepted &= area > 0.2 * width * height
        accepted[0] = False
        number, count = np.full(len(accepted), -1, dtype=np.int32), int(accepted.sum())
        number[accepted] = np.arange(count, dtype=np.int32)
        patch = number[labels.reshape(-1)]
        pixels = np.flatnonzero(patch >= 0)
        patch = patch[pixels]
        y, x = np.divmod(pixels, labels.shape[1])
        centre = np.column_stack([np.bincount(patch, axis, minlength=count) / area[accepted] for axis in (x, y)])
        dx, dy = x - centre[patch, 0], y - centre[patch, 1]
        products = (dx * dx, dx * dy, dy * dy)
        xx, xy, yy = (np.bincount(patch, product, minlength=count) / area[accepted] for product in products)
        moments = np.stack([xx + 1 / 12, xy, xy, yy + 1 / 12], axis=-1).reshape(-1, 2, 2)  # of the pixels' areas
        return _Patches(area[accepted], centre, moments, np.column_stack([left, top, right, bottom])[accepted])


def _elliptic(patches: _Patches, others: _Patches) -> Blobs:
    """Return the patches that fill an ellipse, a round hole in the middle included."""
    from scipy.spatial import cKDTree

    area, centre, moments = patches.area.copy(), patches.centre.copy(), patches.moments.copy()
    ring = np.zeros(len(area), dtype=bool)
    if len(area) and len(others.area):
        distance, hole = cKDTree(others.centre).query(patches.centre)
        whole = area + others.area[hole]
        share = others.area[hole] / whole
        ring = (share > HOLE[0]) & (share < HOLE[1]) & (distance < HOLE_OFF_CENTRE * np.sqrt(whole / np.pi))
        ring &= (others.box[hole][:, :2] > patches.box[:, :2]).all(axis=1)
        ring &= (others.box[hole][:, 2:] < patches.box[:, 2:]).all(axis=1)
        part, hole = share[ring, None], hole[ring]
        offset = others.centre[hole] - centre[ring]
        centre[ring] += part * offset
        mixed = (1 - part[..., None]) * (moments[ring] + part[..., None] * offset[:, :, None] * offset[:, None, :])
        moments[ring] = mixed + part[..., None] * others.moments[hole]
        area[ring] = whole[ring]
    determinant, half_trace = np.linalg.det(moments), np.trace(moments, axis1=1, axis2=2) / 2
    fullness = area / np.maximum(4 * np.pi * np.sqrt(determinant), 1e-9)
    difference = np.sqrt(np.maximum(half_trace**2 - determinant, 0.0))
    slim = half_trace + difference <= MOST_ELONGATED**2 * (half_trace - difference)
    good = slim & (fullness > FULL_ELLIPSE[0]) & (fullness < FULL_ELLIPSE[1]) & (area >= MIN_AREA_PX)
    return Blobs(centre[good], 4 * moments[good], ring[good])


# The blurred ellipse of a round dot: its centre to a few thousandths of a pixel, with covariance.

PARAMETERS = 10  # centre, shape (3), blur, background, contrast, slope of the lighting (2)
SECTORS = 16  # of the edge, for its roughness
FIRST_BLUR_PX = 1.5  # start of the fit
COARSE_RADIUS_PX = 12.0  # from which the first fit uses every second pixel
FIRST_STEP_PX, LAST_STEP_PX = 0.1, 0.003  # last steps of both fits; the error is far smaller
MAX_STEPS = 25  # usually fewer than ten are needed
FIRST_DAMPING = 1e-4  # of Levenberg-Marquardt
BAND_SIGMAS, MIN_BAND_PX = 3.0, 2.0  # half width of the band about the edge
RING_SHARE = 0.25  # of the radius, outside the hole


@dataclass(frozen=True, eq=False, repr=False)
class FittedEllipses(Arrays, shapes="centre_px N 2; covariance_px2 N 2 2; shape_px2 N 2 2; blur_px N; roughness_px N"):
    """N fitted ellipses (x−c)ᵀ·S⁻¹·(x−c) = 1; NaN where the fit failed.

    Attributes
    ----------
    centre_px : (N, 2) c.
    covariance_px2 : (N, 2, 2) of c.
    shape_px2 : (N, 2, 2) S, of determinant (product of the semi-axes)².
    blur_px : (N,) σ of the edge.
    roughness_px : (N,) rms over sixteen sectors of the distance of the edge from the ellipse.
    """

    centre_px: FloatArray
    covariance_px2: FloatArray
    shape_px2: FloatArray
    blur_px: FloatArray
    roughness_px: FloatArray

    @property
    def radius_px(self) -> FloatArray:
        """Radius (N,) of the circle of the same area, corrected for the blur.

        Blur moves the edge inwards by σ²/2r: the edge of a disc that diffuses for the time σ²/2 obeys u_t = u_rr +
        u_r/r and so drifts at the speed −1/r.
        """
        (xx, xy), (_, yy) = np.moveaxis(self.shape_px2, 0, -1)
        seen = (xx * yy - xy * xy) ** 0.25
        return np.asarray(seen + self.blur_px**2 / (2.0 * seen))


def fit_ellipses(
    image: NDArray[Any],
    start_px: FloatArray,
    start_shape_px2: FloatArray,
    reach_px: FloatArray,
    ring: NDArray[np.bool_],
) -> FittedEllipses:
    """Fit a blurred ellipse to each of N dots of an image (H, W).

    I(x) = (1 + γ·(x − x₀)) (B + C/2 erfc(s/(√2 σ))), s the distance of x from the ellipse, positive outside. Parameters
    are centre, shape, σ, background B, contrast C and the slope γ of the lighting. Levenberg–Marquardt uses the pixels
    in a band of ±(3 σ + 2 px) about the edge. The distance s is (ρ − 1)/|∇ρ| to first order with ρ² = (x − c)ᵀ S⁻¹ (x −
    c). It is exact for circles (Sampson 1982, Comput. Graph. Image Process. 18, 97). Blur and the pixels' area leave a
    dot symmetric about its centre, so a wrong profile of the edge does not move the centre.

    The covariance H⁻¹ (Σ r²/(1 − jᵀH⁻¹j) j jᵀ) H⁻¹, H = Σ j jᵀ, applies to noise that differs from pixel to pixel
    (White 1980, Econometrica 48, 817). The residuals' variances are those of MacKinnon and White 1985, J. Econometrics
    29, 305.

    `start_px` (N, 2), `start_shape_px2` (N, 2, 2): the start. `reach_px` (N,): the band ends there outside the edge,
    before the next dot. `ring` (N,): of these only the outer quarter of the radius is used.
    """
    count = len(start_px)
    check_shape("start_px", start_px, (count, 2))
    check_shape("start_shape_px2", start_shape_px2, (count, 2, 2))
    check_shape("reach_px", reach_px, (count,))
    fitted, spread = np.full((count, PARAMETERS), np.nan), np.full((count, 4), np.nan)
    grey, precisions = np.ascontiguousarray(image, dtype=np.float32), np.linalg.inv(start_shape_px2)
    _fit_all(grey, start_px, precisions, reach_px, ring, fitted, spread)
    a, b, c = fitted[:, 2:5].T
    shape = np.stack([c, -b, -b, a], axis=-1).reshape(-1, 2, 2) / (a * c - b * b)[:, None, None]
    return FittedEllipses(
        centre_px=fitted[:, :2],
        covariance_px2=spread[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        shape_px2=shape,
        blur_px=fitted[:, 5],
        roughness_px=spread[:, 3],
    )


@njit()
def _fit_all(image, starts, precisions, reach, ring, fitted, spread):  # type: ignore[no-untyped-def]
    """Fit every dot, first on every second row and column, then on all pixels.

    A failed dot stays NaN.
    """
    for n in range(len(starts)):
        parameters = np.zeros(PARAMETERS)
        parameters[0], parameters[1] = starts[n]
        parameters[2], parameters[3], parameters[4] = precisions[n, 0, 0], precisions[n, 0, 1], precisions[n, 1, 1]
        parameters[5] = FIRST_BLUR_PX
        determinant = parameters[2] * parameters[4] - parameters[3] ** 2
        coarse = 2 if determinant * COARSE_RADIUS_PX**4 < 1.0 else 1
        good = True
        for stride, small_step_px in ((coarse, FIRST_STEP_PX), (1, LAST_STEP_PX)):
            if good:
                pixels = _collect(image, starts[n], parameters, reach[n], ring[n], stride)
                if parameters[7] == 0.0:
                    _first_levels(pixels, parameters)
                good = parameters[7] != 0.0 and _descend(pixels, parameters, small_step_px)
        if good:
            _judge(pixels, parameters, spread[n])
            fitted[n] = parameters


@njit()
def _collect(image, origin, parameters, reach, ring, stride):  # type: ignore[no-untyped-def]
    """Return relative x, y and grey value (3,K) of the band, and the origin.

    x − x₀, y − y₀ in px; origin x₀, y₀.
    """
    a, b, c = parameters[2], parameters[3], parameters[4]
    determinant, half = a * c - b * b, (a + c) / 2.0
    minor = 1.0 / math.sqrt(half + math.sqrt(max(half * half - determinant, 0.0)))
    wide = BAND_SIGMAS * parameters[5] + MIN_BAND_PX
    inside, outside = min(wide, RING_SHARE * minor) if ring else wide, min(wide, max(reach, MIN_BAND_PX))
    half_x = math.sqrt(c / determinant) + outside + 1.0
    half_y = math.sqrt(a / determinant) + outside + 1.0
    top, bottom = max(0, math.ceil(parameters[1] - half_y)), min(image.shape[0], math.floor(parameters[1] + half_y) + 1)
    left, right = max(0, math.ceil(parameters[0] - half_x)), min(image.shape[1], math.floor(parameters[0] + half_x) + 1)
    pixels = np.empty((3, max(0, bottom - top) * max(0, right - left)))
    count = 0
    for y in range(top, bottom, stride):
        for x in range(left, right, stride):
            _, distance, _ = _distance(parameters, x - parameters[0], y - parameters[1])
            if -inside <= distance <= outside:
                pixels[0, count], pixels[1, count], pixels[2, count] = x - origin[0], y - origin[1], image[y, x]
                count += 1
    return pixels[:, :count].copy(), (origin[0], origin[1])


@njit()
def _distance(parameters, px, py):  # type: ignore[no-untyped-def]
    """Return ρ, the distance from the ellipse and |S⁻¹ p| at p from the centre."""
    gx = parameters[2] * px + parameters[3] * py
    gy = parameters[3] * px + parameters[4] * py
    rho = math.sqrt(max(px * gx + py * gy, 1e-12))
    length = max(math.sqrt(gx * gx + gy * gy), 1e-12)
    return rho, (rho - 1.0) * rho / length, length


@njit()
def _first_levels(pixels, parameters):  # type: ignore[no-untyped-def]
    """Set background and contrast from the means on both sides of the edge."""
    values, origin = pixels
    total, count = np.zeros(2), np.zeros(2)
    for k in range(values.shape[1]):
        px, py = values[0, k] + origin[0] - parameters[0], values[1, k] + origin[1] - parameters[1]
        side = 0 if _distance(parameters, px, py)[0] > 1.0 else 1
        total[side] += values[2, k]
        count[side] += 1.0
    parameters[6] = total[0] / max(count[0], 1.0)
    parameters[7] = total[1] / max(count[1], 1.0) - parameters[6]


@njit()
def _evaluate(pixels, parameters, residual, jacobian, by_distance):  # type: ignore[no-untyped-def]
    """Fill residuals (K,), derivatives by the parameters (10, K) and by the distance (K,)."""
    values, origin = pixels
    a, b, c = parameters[2], parameters[3], parameters[4]
    sigma, background, contrast = parameters[5], parameters[6], parameters[7]
    for k in range(values.shape[1]):
        x, y = values[0, k], values[1, k]
        px, py = x + origin[0] - parameters[0], y + origin[1] - parameters[1]
        rho, distance, length = _distance(parameters, px, py)
        u = distance / sigma
        covered = 0.5 * math.erfc(u / math.sqrt(2.0))
        light = 1.0 + parameters[8] * x + parameters[9] * y
        level = background + contrast * covered
        slope = -light * contrast * math.exp(-0.5 * u * u) / (math.sqrt(2.0 * math.pi) * sigma)
        gx, gy = a * px + b * py, b * px + c * py
        by_square = slope * (1.0 - 0.5 / rho) / length
        by_length = -slope * distance / (length * length)
        residual[k] = values[2, k] - light * level
        by_distance[k] = slope
        jacobian[0, k] = -2.0 * by_square * gx - by_length * (gx * a + gy * b)
        jacobian[1, k] = -2.0 * by_square * gy - by_length * (gx * b + gy * c)
        jacobian[2, k] = by_square * px * px + by_length * gx * px
        jacobian[3, k] = 2.0 * by_square * px * py + by_length * (gx * py + gy * px)
        jacobian[4, k] = by_square * py * py + by_length * gy * py
        jacobian[5, k] = -slope * u
        jacobian[6, k] = light
        jacobian[7, k] = light * covered
        jacobian[8, k] = level * x
        jacobian[9, k] = level * y


@njit()
def _dot(first, second):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(len(first)):
        total += first[k] * second[k]
    return total


@njit()
def _normal_equations(residual, jacobian, matrix, vector):  # type: ignore[no-untyped-def]
    """Fill scaled J·Jᵀ and J·r, with a unit diagonal; return the scale (10,)."""
    scale = np.empty(PARAMETERS)
    for i in range(PARAMETERS):
        scale[i] = math.sqrt(max(_dot(jacobian[i], jacobian[i]), 1e-300))
        vector[i] = _dot(jacobian[i], residual) / scale[i]
        for j in range(i + 1):
            matrix[i, j] = _dot(jacobian[i], jacobian[j]) / (scale[i] * scale[j])
            matrix[j, i] = matrix[i, j]
    return scale


@njit()
def _descend(pixels, parameters, small_step_px):  # type: ignore[no-untyped-def]
    """Iterate until centre and σ move less than a step; return whether they converged.

    Levenberg–Marquardt.
    """
    count = pixels[0].shape[1]
    if count <= PARAMETERS:
        return False
    residual, trial_residual, by_distance = np.empty(count), np.empty(count), np.empty(count)
    jacobian, trial_jacobian = np.empty((PARAMETERS, count)), np.empty((PARAMETERS, count))
    matrix, lower = np.empty((PARAMETERS, PARAMETERS)), np.zeros((PARAMETERS, PARAMETERS))
    vector = np.empty(PARAMETERS)
    _evaluate(pixels, parameters, residual, jacobian, by_distance)
    squares = _dot(residual, residual)
    scale = _normal_equations(residual, jacobian, matrix, vector)
    damping = FIRST_DAMPING
    for _ in range(MAX_STEPS):
        if not cholesky(matrix + damping * np.eye(PARAMETERS), lower):
            damping *= 10.0
            continue
        step = vector.copy()
        solve(lower, step)
        step /= scale
        trial = parameters + step
        small = max(abs(step[0]), abs(step[1]), abs(step[5])) < small_step_px
        a, c, determinant = trial[2], trial[4], trial[2] * trial[4] - trial[3] * trial[3]
        area = 1.0 / math.sqrt(determinant) if determinant > 0.0 and a > 0.0 and c > 0.0 else 0.0
        if not (1.0 < area < 1e7 and trial[5] > 0.05 and trial[5] ** 2 < area):  # no ellipse with a dot's blur
            damping *= 10.0
            continue
        _evaluate(pixels, trial, trial_residual, trial_jacobian, by_distance)
        trial_squares = _dot(trial_residual, trial_residual)
        if trial_squares <= squares:
            parameters[:] = trial
            if small:
                return True
            squares, damping = trial_squares, 0.1 * damping
            residual, trial_residual, jacobian, trial_jacobian = trial_residual, residual, trial_jacobian, jacobian
            scale = _normal_equations(residual, jacobian, matrix, vector)
        elif small:
            return True
        else:
            damping *= 10.0
    return False


@njit()
def _judge(pixels, parameters, spread):  # type: ignore[no-untyped-def]
    """Fill the centre's variances xx xy yy and the roughness of the edge."""
    values, origin = pixels
    count = values.shape[1]
    residual, by_distance, jacobian = np.empty(count), np.empty(count), np.empty((PARAMETERS, count))
    matrix, vector = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    _evaluate(pixels, parameters, residual, jacobian, by_distance)
    scale = _normal_equations(residual, jacobian, matrix, vector)
    lower, inverse = np.zeros((PARAMETERS, PARAMETERS)), np.eye(PARAMETERS)
    pull = np.zeros(PARAMETERS)
    if not cholesky(matrix + 1e-12 * np.eye(PARAMETERS), lower):
        spread[:] = math.nan
        return
    for i in range(PARAMETERS):
        solve(lower, inverse[i])
    moved, weight = np.zeros(SECTORS), np.zeros(SECTORS)
    spread[:3] = 0.0
    for k in range(count):
        for i in range(PARAMETERS):
            vector[i] = jacobian[i, k] / scale[i]
        for i in range(PARAMETERS):
            pull[i] = _dot(inverse[i], vector)
        variance = residual[k] ** 2 / max(1.0 - _dot(pull, vector), 1e-3)
        dx, dy = pull[0] / scale[0], pull[1] / scale[1]
        spread[0] += dx * dx * variance
        spread[1] += dx * dy * variance
        spread[2] += dy * dy * variance
        turn = math.atan2(values[1, k] + origin[1] - parameters[1], values[0, k] + origin[0] - parameters[0])
        sector = min(int((turn / (2.0 * math.pi) + 0.5) * SECTORS), SECTORS - 1)
        moved[sector] += by_distance[k] * residual[k]
        weight[sector] += by_distance[k] ** 2
    spread[3] = math.sqrt(np.mean((moved / np.maximum(weight, 1e-12)) ** 2))
