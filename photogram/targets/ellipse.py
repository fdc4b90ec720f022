"""Detection of round dots in an image, and fits of ellipses to their blurred edges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.targets.crossing import assign, cholesky, minimise, solve
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, check_shape
from shakercal._common.kernels import njit

MIN_AREA_PX = 20  # pixels of a dot with a measurable ellipse
BORDER_PX = 3  # margin of the image without dots
REDUCED_WINDOW_PX = 24  # smallest side of the threshold window after downsampling
MIN_RELATIVE_CONTRAST = 0.15  # local contrast over its 0.9 quantile in the image
FILL_RATIO = (0.85, 1.12)  # range of the area over that of the ellipse with the same second moments
MAX_AXIS_RATIO = 3.5  # of the semi-axes; a circle tilted by 73°
HOLE_AREA_RATIO = (0.03, 0.6)  # range of the area of a ring marker's hole over that of the whole dot
MAX_HOLE_OFFSET = 0.15  # from the centre of the dot, in its radii


@dataclass(frozen=True, eq=False, repr=False)
class Blobs(Arrays, shapes="centre_px N 2; shape_px2 N 2 2; ring N"):
    """Candidate dots: N patches that fill an ellipse.

    `shape_px2` S (N, 2, 2): xᵀ S⁻¹ x = 1 is the ellipse about centre_px (N, 2) with the patch's second moments. `ring`
    (N,): whether it is a ring marker, a dot with a round central hole. The hole counts as filled.
    """

    centre_px: FloatArray
    shape_px2: FloatArray
    ring: BoolArray

    @property
    def radius_px(self) -> FloatArray:
        """Radius (N,) of the circle of the same area."""
        return np.asarray(np.linalg.det(self.shape_px2) ** 0.25)


def find_blobs(image: NDArray[Any], window_px: float) -> tuple[Blobs, Blobs]:
    """Return the dark and the bright elliptic patches inside an image (H, W).

    The threshold is the mean of the grey closing and the grey opening over squares of `window_px`. The squares must be
    larger than the dots and larger than the gaps between them. The threshold follows lighting that varies little
    within a square.
    """
    import cv2

    height, width = image.shape
    factor = max(1, int(window_px // REDUCED_WINDOW_PX))
    grey = np.asarray(image, dtype=np.float32)
    coarse = cv2.resize(grey, (max(1, width // factor), max(1, height // factor)), interpolation=cv2.INTER_AREA)
    side = max(3, round(window_px / factor) | 1)
    square = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
    upper, lower = (cv2.morphologyEx(coarse, kind, square) for kind in (cv2.MORPH_CLOSE, cv2.MORPH_OPEN))
    contrast = upper - lower
    distinct = contrast > MIN_RELATIVE_CONTRAST * float(np.quantile(contrast, 0.9))
    threshold = cv2.resize((upper + lower) / 2, (width, height), interpolation=cv2.INTER_LINEAR)
    used = cv2.resize(distinct.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).view(np.bool_)
    smooth = cv2.blur(grey, (3, 3)) if factor > 1 else grey
    dark, bright = _Patches.from_mask((smooth < threshold) & used), _Patches.from_mask((smooth > threshold) & used)
    return _select_ellipses(dark, bright), _select_ellipses(bright, dark)


@dataclass(frozen=True, eq=False)
class _Patches:
    """Connected pixels, dots or holes: area, centre, second central moments, bounding box."""

    area: FloatArray
    centre: FloatArray
    moments: FloatArray
    box: FloatArray

    @staticmethod
    def from_mask(mask: BoolArray) -> _Patches:
        """Return the connected patches of a mask that may be ellipses or rings.

        Patches at the border of the image are excluded. A hole may have a quarter of the area of the smallest dot.
        """
        import cv2

        _, found, stats, centroids = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
        labels = np.asarray(found, dtype=np.int32)
        left, top, width, height, area = np.asarray(stats, dtype=np.float64).T
        right, bottom = left + width, top + height
        inside = (left >= BORDER_PX) & (top >= BORDER_PX)
        inside &= (right <= mask.shape[1] - BORDER_PX) & (bottom <= mask.shape[0] - BORDER_PX)
        longer, shorter = np.maximum(width, height), np.minimum(width, height)
        accepted = (
            inside & (area >= MIN_AREA_PX / 4) & (area < mask.size / 20) & (longer <= MAX_AXIS_RATIO * shorter + 1)
        )
        accepted &= area > 0.2 * width * height
        accepted[0] = False
        number, count = np.full(len(accepted), -1, dtype=np.int32), int(accepted.sum())
        number[accepted] = np.arange(count, dtype=np.int32)
        patch = number[labels.reshape(-1)]
        pixels = np.flatnonzero(patch >= 0)
        patch = patch[pixels]
        y, x = np.divmod(pixels, labels.shape[1])
        centre = np.asarray(centroids, dtype=np.float64)[accepted]
        dx, dy = x - centre[patch, 0], y - centre[patch, 1]
        products = (dx * dx, dx * dy, dy * dy)
        xx, xy, yy = (np.bincount(patch, product, minlength=count) / area[accepted] for product in products)
        moments = np.stack([xx + 1 / 12, xy, xy, yy + 1 / 12], axis=-1).reshape(-1, 2, 2)  # of the pixels' areas
        return _Patches(area[accepted], centre, moments, np.column_stack([left, top, right, bottom])[accepted])


def _select_ellipses(patches: _Patches, opposite: _Patches) -> Blobs:
    """Return the patches that fill an ellipse; a round central hole counts as filled.

    `opposite`: the patches of the opposite contrast, which include the holes.
    """
    from scipy.spatial import cKDTree

    area, centre, moments = patches.area.copy(), patches.centre.copy(), patches.moments.copy()
    ring = np.zeros(len(area), dtype=bool)
    if len(area) and len(opposite.area):
        distance, hole = cKDTree(opposite.centre).query(patches.centre)
        filled_area = area + opposite.area[hole]
        hole_ratio = opposite.area[hole] / filled_area
        ring = (hole_ratio > HOLE_AREA_RATIO[0]) & (hole_ratio < HOLE_AREA_RATIO[1])
        ring &= distance < MAX_HOLE_OFFSET * np.sqrt(filled_area / np.pi)
        ring &= (opposite.box[hole][:, :2] > patches.box[:, :2]).all(axis=1)
        ring &= (opposite.box[hole][:, 2:] < patches.box[:, 2:]).all(axis=1)
        weight, hole = hole_ratio[ring, None], hole[ring]
        offset = opposite.centre[hole] - centre[ring]
        centre[ring] += weight * offset
        outer = (1 - weight[..., None]) * (moments[ring] + weight[..., None] * offset[:, :, None] * offset[:, None, :])
        moments[ring] = outer + weight[..., None] * opposite.moments[hole]
        area[ring] = filled_area[ring]
    determinant, half_trace = np.linalg.det(moments), np.trace(moments, axis1=1, axis2=2) / 2
    fill_ratio = area / np.maximum(4 * np.pi * np.sqrt(determinant), 1e-9)
    difference = np.sqrt(np.maximum(half_trace**2 - determinant, 0.0))
    compact = half_trace + difference <= MAX_AXIS_RATIO**2 * (half_trace - difference)
    accepted = compact & (fill_ratio > FILL_RATIO[0]) & (fill_ratio < FILL_RATIO[1]) & (area >= MIN_AREA_PX)
    return Blobs(centre[accepted], 4 * moments[accepted], ring[accepted])


# The blurred ellipse of a round dot: its centre to a few thousandths of a pixel, with covariance.

PARAMETER_COUNT = 10  # centre (2), inverse shape (3), blur, background, contrast, slope of the lighting (2)
SECTOR_COUNT = 16  # parts of the edge, each with one mean distance for the roughness
START_BLUR_PX = 1.5  # σ of the edge at the start of the fit
COARSE_RADIUS_PX = 12.0  # a larger dot is first fitted on every second row and column
FIRST_TOLERANCE_PX, FINAL_TOLERANCE_PX = 0.1, 0.003  # last steps of the two fits; the remaining error is far smaller
RULES = 25, 1e-4, 0.0, math.inf, False  # of `minimise`; usually fewer than ten steps are needed
BAND_SIGMAS, BAND_PX = 3.0, 2.0  # half width of the band of fitted pixels about the edge: 3 σ + 2 px
MAX_RING_BAND = 0.25  # inner half of that band in a ring marker, in semi-minor axes: excludes the hole


@dataclass(frozen=True, eq=False, repr=False)
class FittedEllipses(Arrays, shapes="centre_px N 2; covariance_px2 N 2 2; shape_px2 N 2 2; blur_px N; roughness_px N"):
    """N fitted ellipses (x−c)ᵀ·S⁻¹·(x−c) = 1; NaN where the fit failed.

    Attributes
    ----------
    centre_px : (N, 2) c.
    covariance_px2 : (N, 2, 2) covariance of c.
    shape_px2 : (N, 2, 2) S; its determinant is the square of the product of the semi-axes.
    blur_px : (N,) σ of the Gaussian blur of the edge.
    roughness_px : (N,) rms of the distance between edge and ellipse in sixteen sectors.
    """

    centre_px: FloatArray
    covariance_px2: FloatArray
    shape_px2: FloatArray
    blur_px: FloatArray
    roughness_px: FloatArray

    @property
    def radius_px(self) -> FloatArray:
        """Radius (N,) of the circle of the same area, corrected for the blur.

        Blur moves the edge inwards by σ²/2r. A blurred disc is one that diffuses for the time σ²/2 by u_t = u_rr +
        u_r/r. Its edge therefore drifts at the speed −1/r.
        """
        (xx, xy), (_, yy) = np.moveaxis(self.shape_px2, 0, -1)
        apparent = (xx * yy - xy * xy) ** 0.25
        return np.asarray(apparent + self.blur_px**2 / (2.0 * apparent))


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
    c). It is exact for circles (Sampson 1982, Comput. Graph. Image Process. 18, 97). A dot stays symmetric about its
    centre under blur and the integration over a pixel. A wrong profile of the edge therefore does not move the centre.

    The covariance is H⁻¹ (Σ r²/(1 − jᵀH⁻¹j) j jᵀ) H⁻¹ with H = Σ j jᵀ, the residual r of a pixel and the derivative j
    of the model there. It applies to noise whose variance differs from pixel to pixel (White 1980, Econometrica 48,
    817). The residuals' variances are those of MacKinnon and White 1985, J. Econometrics 29, 305.

    `start_px` (N, 2), `start_shape_px2` (N, 2, 2): start of centre and shape. `reach_px` (N,): largest distance outside
    the edge that is fitted, at least 2 px; it excludes the next dot. `ring` (N,): ring markers, fitted only within a
    quarter of the semi-minor axis inside the edge, which excludes the hole.
    """
    count = len(start_px)
    check_shape("start_px", start_px, (count, 2))
    check_shape("start_shape_px2", start_shape_px2, (count, 2, 2))
    check_shape("reach_px", reach_px, (count,))
    fitted, quality = np.full((count, PARAMETER_COUNT), np.nan), np.full((count, 4), np.nan)
    grey, inverse_shapes = np.ascontiguousarray(image, dtype=np.float32), np.linalg.inv(start_shape_px2)
    _fit_all(grey, start_px, inverse_shapes, reach_px, ring, fitted, quality)
    a, b, c = fitted[:, 2:5].T
    shape = np.stack([c, -b, -b, a], axis=-1).reshape(-1, 2, 2) / (a * c - b * b)[:, None, None]
    return FittedEllipses(
        centre_px=fitted[:, :2],
        covariance_px2=quality[:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        shape_px2=shape,
        blur_px=fitted[:, 5],
        roughness_px=quality[:, 3],
    )


@njit()
def _fit_all(image, starts, inverse_shapes, reach, ring, fitted, quality):  # type: ignore[no-untyped-def]
    """Fill parameters (N, 10) and quality (N, 4) of every dot.

    They are NaN where the fit fails. The first fit of a large dot uses every second row and column, the final fit all
    pixels.
    """
    for n in range(len(starts)):
        parameters = np.zeros(PARAMETER_COUNT)
        parameters[0], parameters[1] = starts[n]
        parameters[2], parameters[3] = inverse_shapes[n, 0]
        parameters[4] = inverse_shapes[n, 1, 1]
        parameters[5] = START_BLUR_PX
        determinant = parameters[2] * parameters[4] - parameters[3] ** 2
        coarse = 2 if determinant * COARSE_RADIUS_PX**4 < 1.0 else 1
        data = _band(image, starts[n], parameters, reach[n], ring[n], coarse)
        _start_levels(data[0], parameters)
        if data[1].size > PARAMETER_COUNT and parameters[7] != 0.0:
            squares, _ = minimise(_normal_equations, _near, data, parameters, RULES)
            data = _band(image, starts[n], parameters, reach[n], ring[n], 1)
            if squares >= 0.0 and data[1].size > PARAMETER_COUNT and parameters[7] != 0.0:
                squares, _ = minimise(_normal_equations, _converged, data, parameters, RULES)
                if squares >= 0.0:
                    _assess_fit(data, parameters, quality[n])
                    assign(fitted[n], parameters)


@njit()
def _band(image, origin, parameters, reach, ring, stride):  # type: ignore[no-untyped-def]
    """Return the pixels of the band with room for residuals and derivatives."""
    pixels = _collect_band(image, origin, parameters, reach, ring, stride)
    count = pixels[0].shape[1]
    return pixels, np.empty(count), np.empty((PARAMETER_COUNT, count)), np.empty(count)


@njit()
def _collect_band(image, origin, parameters, reach, ring, stride):  # type: ignore[no-untyped-def]
    """Return position and grey value (3, K) of the pixels in the band.

    The positions are x − x₀, y − y₀. Also returns x₀, y₀.
    """
    a, b, c = parameters[2], parameters[3], parameters[4]
    determinant, half = a * c - b * b, (a + c) / 2.0
    minor = 1.0 / math.sqrt(half + math.sqrt(max(half * half - determinant, 0.0)))
    half_width = BAND_SIGMAS * parameters[5] + BAND_PX
    inside = min(half_width, MAX_RING_BAND * minor) if ring else half_width
    outside = min(half_width, max(reach, BAND_PX))
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
    """Return ρ, the signed distance from the ellipse, and |S⁻¹ p|, p from the centre."""
    gx = parameters[2] * px + parameters[3] * py
    gy = parameters[3] * px + parameters[4] * py
    rho = math.sqrt(max(px * gx + py * gy, 1e-12))
    length = max(math.sqrt(gx * gx + gy * gy), 1e-12)
    return rho, (rho - 1.0) * rho / length, length


@njit()
def _start_levels(pixels, parameters):  # type: ignore[no-untyped-def]
    """Start background and contrast at the mean grey values on both sides of the edge."""
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
def _linearise(pixels, parameters, residual, jacobian, edge_slope):  # type: ignore[no-untyped-def]
    """Fill residuals (K,) and the model's derivatives by parameters (10, K) and distance (K,)."""
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
        edge_slope[k] = slope
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
def _inner_product(first, second):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(len(first)):
        total += first[k] * second[k]
    return total


@njit()
def _normal_equations(data, parameters, matrix, vector):  # type: ignore[no-untyped-def]
    """Fill J·Jᵀ and J·r; return Σ r², infinite for an impossible ellipse or blur."""
    pixels, residual, jacobian, edge_slope = data
    a, c, determinant = parameters[2], parameters[4], parameters[2] * parameters[4] - parameters[3] * parameters[3]
    area = 1.0 / math.sqrt(determinant) if determinant > 0.0 and a > 0.0 and c > 0.0 else 0.0
    if not (1.0 < area < 1e7 and parameters[5] > 0.05 and parameters[5] ** 2 < area):
        return math.inf
    _linearise(pixels, parameters, residual, jacobian, edge_slope)
    for i in range(PARAMETER_COUNT):
        vector[i] = _inner_product(jacobian[i], residual)
        for j in range(i + 1):
            matrix[i, j] = _inner_product(jacobian[i], jacobian[j])
            matrix[j, i] = matrix[i, j]
    return _inner_product(residual, residual)


@njit()
def _near(step, damping):  # type: ignore[no-untyped-def]
    return max(abs(step[0]), abs(step[1]), abs(step[5])) < FIRST_TOLERANCE_PX


@njit()
def _converged(step, damping):  # type: ignore[no-untyped-def]
    return max(abs(step[0]), abs(step[1]), abs(step[5])) < FINAL_TOLERANCE_PX


@njit()
def _assess_fit(data, parameters, quality):  # type: ignore[no-untyped-def]
    """Fill `quality`: the centre's covariances xx, xy, yy and the roughness of the edge."""
    (values, origin), residual, jacobian, edge_slope = data
    matrix, vector = np.empty((PARAMETER_COUNT, PARAMETER_COUNT)), np.empty(PARAMETER_COUNT)
    _normal_equations(data, parameters, matrix, vector)
    lower, inverse = np.zeros((PARAMETER_COUNT, PARAMETER_COUNT)), np.eye(PARAMETER_COUNT)
    pull = np.empty(PARAMETER_COUNT)
    if not cholesky(matrix, 1e-12, lower):
        quality[:] = math.nan
        return
    for i in range(PARAMETER_COUNT):
        solve(lower, inverse[i])
    offset, weight = np.zeros(SECTOR_COUNT), np.zeros(SECTOR_COUNT)
    quality[:3] = 0.0
    for k in range(values.shape[1]):
        for i in range(PARAMETER_COUNT):
            vector[i] = jacobian[i, k]
        for i in range(PARAMETER_COUNT):
            pull[i] = _inner_product(inverse[i], vector)
        variance = residual[k] ** 2 / max(1.0 - _inner_product(pull, vector), 1e-3)
        dx, dy = pull[0], pull[1]
        quality[0] += dx * dx * variance
        quality[1] += dx * dy * variance
        quality[2] += dy * dy * variance
        angle = math.atan2(values[1, k] + origin[1] - parameters[1], values[0, k] + origin[0] - parameters[0])
        sector = min(int((angle / (2.0 * math.pi) + 0.5) * SECTOR_COUNT), SECTOR_COUNT - 1)
        offset[sector] += edge_slope[k] * residual[k]
        weight[sector] += edge_slope[k] ** 2
    quality[3] = 0.0
    for sector in range(SECTOR_COUNT):
        quality[3] += (offset[sector] / max(weight[sector], 1e-12)) ** 2 / SECTOR_COUNT
    quality[3] = math.sqrt(quality[3])
