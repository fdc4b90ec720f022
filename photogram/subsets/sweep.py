"""First matches of a calibrated pair: correlation along epipolar lines, and smooth surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.camera import StereoRig, epipolar_residual, triangulate
from photogram.subsets.search import score_peaks
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray
from shakercal._common.kernels import njit
from shakercal._common.propagation import derivatives

Image = NDArray[Any]
TOLERANCE_PX = 2.0  # of a match from its epipolar line, in addition to the calibration's uncertainty
COVERAGE = 3.0  # standard uncertainties
NEAREST, FARTHEST = 0.4, 1000.0  # depths in base lengths: axes 100° apart, and parallel
SAMPLES = 1000  # of an epipolar line before it is divided evenly
BLOCK_PX = 64  # points on a line that share the tilts of a plane
BLUR_PX = 0.9  # so that a subset still correlates half a step off
LINE_PX = 1.8  # distance of the parallel lines within the band
MOST_LINES = 4  # to either side
ACROSS = 9  # pixels of a subset in each row and column that are compared
STRAINS = np.array([-0.36, -0.24, -0.12, 0.0, 0.12, 0.24, 0.36])  # steps at which a subset of 21 px still correlates
STEEPEST = 1.43  # tan 55°: tilt of the surface against the plane that faces both cameras
LARGEST_STRETCH = 4.0  # of a subset, in the right image
MIN_ZNCC = 0.4  # of a candidate, before its tilt is refined
CLIMBED_PX = 0.05  # last step, well within the convergence of the registration
PEAKS = 8  # candidates of a subset, for patterns that repeat
SURFACE_PX = 6.0  # distance of a candidate from a plane, for curved bodies
TRIPLES = 500  # of RANSAC: enough with a fifth of correct candidates
FEWEST, BEYOND_CHANCE = 3, 6  # points of a surface; any three lie on one


@dataclass(frozen=True, eq=False, repr=False)
class _EpipolarLines(Arrays, shapes="right_px S K 2; affine S B T 2 2"):
    """Points on S epipolar lines, 1 px from each other, and T tilts.

    right_px (S, K, 2): NaN beyond the right image. affine (S, B, T, 2, 2): derivative of the right pixel by the left
    one on a tilted surface in the middle of every block of `BLOCK_PX`. NaN where the tilt, or the stretch of a subset,
    is too large.
    """

    right_px: FloatArray
    affine: FloatArray


def line_starts(
    images: tuple[Image, Image], rig: StereoRig, points_px: FloatArray, radius_px: int
) -> tuple[FloatArray, float]:
    """Return warps (C,S,6) at which subsets correlate best along epipolar lines, and the band.

    points_px (S, 2): the subsets of the left image. Zero-normalised cross-correlation is computed at points 1 px from
    each other on each line and on parallel lines within the band. The band has 2 px and three standard uncertainties of
    the calibration to either side, at most 8 px. A grid of 9 x 9 pixels of the subset is compared, warped as a tilted
    plane moves them. Strains are 0 to ±0.36 along and across the line. Their tilt is limited to 55° against the plane
    that faces both cameras. (Plane sweep: Collins 1996, Proc. CVPR, 358. Tilts: Gallup et al. 2007, Proc. CVPR.) The
    surroundings of a line are straightened first, so that neighbouring points access neighbouring pixels. Up to C = 8
    peaks, from the highest, are refined to within 0.05 px; NaN where there are fewer.
    """
    import cv2

    lines = _lines(rig, points_px)
    count = np.isfinite(lines.right_px[..., 0]).sum(axis=1)
    sigma = line_uncertainty_px(rig, points_px, lines.right_px[np.arange(len(points_px)), count // 2])
    band_px = min(TOLERANCE_PX + COVERAGE * sigma, LINE_PX * (MOST_LINES + 0.5))
    most = math.ceil(max(0.0, band_px - LINE_PX / 2.0) / LINE_PX)
    offsets_across = LINE_PX * np.arange(-most, most + 1.0)
    left, right = (np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX)) for image in images)
    steps = np.linspace(-radius_px, radius_px, ACROSS)
    offsets = np.stack([grid.ravel() for grid in np.meshgrid(steps, steps)], axis=1)
    grey = _grey_at(left, points_px[:, None] + offsets)
    grey -= grey.mean(axis=1, keepdims=True)
    length = np.linalg.norm(grey, axis=1, keepdims=True)
    grey /= np.where(length > 0.0, length, np.nan)
    starts, along = (np.full((PEAKS, len(points_px), parts), np.nan) for parts in (6, 2))
    for n in np.flatnonzero((count > 1) & np.isfinite(grey[:, 0])):
        line = lines.right_px[n, : count[n]]
        score, tilt, which, frames = _correlated(right, line, lines.affine[n], (grey[n], offsets), offsets_across)
        peaks = score_peaks(score[None], MIN_ZNCC)[:PEAKS, 0] if score.max() >= MIN_ZNCC else ()
        for c, k in enumerate(peaks):
            (a, b), (d, e) = lines.affine[n, k // BLOCK_PX, tilt[k]]
            u, v = line[k] + offsets_across[which[k]] * frames[k, 1] - points_px[n]
            starts[c, n], along[c, n] = (u, a - 1.0, b, v, d, e - 1.0), frames[k, 0]
    _climb(right, points_px, grey, offsets, starts, along)
    return starts, band_px


def _grey_at(image: Image, points_px: FloatArray) -> FloatArray:
    """Return grey values (M, N) at points (M, N, 2), NaN beyond the image.

    float64, for sums that nearly cancel.
    """
    import cv2

    x, y = np.moveaxis(points_px.astype(np.float32), -1, 0)
    outside = (np.nan, np.nan, np.nan, np.nan)
    grey = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
    return grey.astype(np.float64)


def _correlated(
    image: Image,
    line: FloatArray,
    affine: FloatArray,
    subset: tuple[FloatArray, FloatArray],
    offsets_across: FloatArray,
) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Return the best correlation (K,) along a line, over tilts and parallel lines.

    Also the indices (K,) of tilt and parallel line, and the unit vectors along the line and across it (K, 2, 2).
    """
    count, blocks = len(line), -(-len(line) // BLOCK_PX)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    middle = np.minimum(np.arange(blocks) * BLOCK_PX + BLOCK_PX // 2, count - 1)
    frames = np.stack([along, np.column_stack([-along[:, 1], along[:, 0]])], axis=1)
    maps = frames[middle, None] @ affine[:blocks]
    reach = float(np.nanmax(np.abs(maps).sum(axis=-1), initial=0.0)) * subset[1].max()
    margin, high = math.ceil(reach) + 1, math.ceil(reach + offsets_across[-1]) + 1
    # beyond its ends the line is continued symmetrically
    longer = np.pad(line, ((margin, margin), (0, 0)), mode="reflect", reflect_type="odd")
    across = np.pad(frames[:, 1], ((margin, margin), (0, 0)), mode="edge")
    across_px = np.arange(-high, high + 1.0)[:, None, None] * across
    strip = np.full((2 * high + 1, blocks * BLOCK_PX + 2 * margin), np.nan)
    strip[:, : len(longer)] = _grey_at(image, longer + across_px)
    score, tilt, which = np.full(count, -1.0), np.zeros(count, np.int64), np.zeros(count, np.int64)
    _sweep(strip, (margin, high), maps, *subset, offsets_across, (score, tilt, which))
    return score, tilt, which, frames


def line_uncertainty_px(rig: StereoRig, left_px: FloatArray, right_px: FloatArray) -> float:
    """Return the largest standard uncertainty in px of the epipolar residual of matches (N, 2).

    It results from the covariance of the calibration; 0 for a calibration without one.
    """
    if rig.covariance is None:
        return 0.0
    step = 1e-3 * np.sqrt(np.diagonal(rig.covariance))
    slope = derivatives(lambda delta: epipolar_residual(rig.perturbed(delta), left_px, right_px)[0], step)
    return float(np.sqrt(np.nanmax(np.einsum("ni,ij,nj->n", slope, rig.covariance, slope), initial=0.0)))


def fit_surfaces(rig: StereoRig, left_px: FloatArray, right_px: FloatArray) -> list[IntArray]:
    """Return smooth surfaces through the candidates right_px (C,S,2) of the points left_px (S,2).

    NaN is no candidate. Each surface is an array (S,) of the candidate on it, −1 for none; the one with most points
    first. On a plane, inverse depth is linear in the normalised pixels. Candidates within 6 px of it along their line
    belong to it, which a curved body does in parts. RANSAC (Fischler, Bolles 1981, Commun. ACM 24, 381), one plane
    after another among the remaining candidates.
    """
    point, depth = _inverse_depth(rig, left_px, right_px)
    fewest = FEWEST if len(point) < 2 * BEYOND_CHANCE else BEYOND_CHANCE
    left = np.asarray(np.isfinite(depth).all(axis=-1))
    found = []
    rng = np.random.default_rng(0)
    while np.count_nonzero(left.any(axis=0)) >= fewest:
        fit = _plane(point, depth, left, rng)
        if fit is None:
            break
        distance = np.where(left, np.abs(depth[..., 0] - point @ fit) * depth[..., 1], np.inf)
        chosen = np.where(distance.min(axis=0) <= SURFACE_PX, np.argmin(distance, axis=0), -1)
        if np.count_nonzero(chosen >= 0) < fewest:
            break
        found.append(chosen)
        left &= distance > SURFACE_PX
    return sorted(found, key=lambda one: -int(np.count_nonzero(one >= 0)))


def _inverse_depth(rig: StereoRig, left_px: FloatArray, right_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return normalised pixels (S,3) with a 1, and inverse depth and its change (C,S,2).

    The change is that in right pixels, of each candidate.
    """
    left = np.broadcast_to(left_px, right_px.shape)
    depth = triangulate(rig, left, right_px).position_m[..., 2]
    inverse = 1.0 / np.where(depth > 0.0, depth, np.nan)
    rays = _rays(rig, left_px)
    ends = [_right_pixels(rig, rays[None], inverse * factor) for factor in (1.0 - 1e-4, 1.0 + 1e-4)]
    change = np.linalg.norm(ends[1] - ends[0], axis=-1) / (2e-4 * inverse)
    return rays, np.stack([inverse, change], axis=-1)


def _plane(point: FloatArray, depth: FloatArray, left: BoolArray, rng: np.random.Generator) -> FloatArray | None:
    """Return the plane (3,) inverse depth = point·plane with most points among candidates (C, S)."""
    which, points = np.nonzero(left)
    value, scale = depth[which, points].T
    triples = rng.integers(0, len(points), (TRIPLES, 3))
    system = point[points[triples]]
    whole = np.abs(np.linalg.det(system)) > 1e-9
    if not whole.any():
        return None
    planes = np.linalg.solve(system[whole], value[triples[whole]][..., None])[..., 0]
    near = np.abs(planes @ point[points].T - value) * scale <= SURFACE_PX
    seen = np.zeros((len(planes), left.shape[1]), dtype=np.bool_)
    for k, n in enumerate(points):
        seen[:, n] |= near[:, k]
    best = near[np.argmax(seen.sum(axis=1))]
    weight = scale[best]
    plane, *_ = np.linalg.lstsq(point[points[best]] * weight[:, None], value[best] * weight, rcond=None)
    return np.asarray(plane)


def _rays(rig: StereoRig, left_px: FloatArray) -> FloatArray:
    """Return the directions (..., 3) of left pixels, z = 1."""
    normalised = rig.left.undistort(left_px)
    return np.concatenate([normalised, np.ones((*normalised.shape[:-1], 1))], axis=-1)


def _right_pixels(rig: StereoRig, rays: FloatArray, inverse_depth: FloatArray) -> FloatArray:
    """Return right pixels (..., 2) of points on left rays (..., 3).

    NaN behind the camera and where its distortion is not invertible.
    """
    points = rays @ rig.right_from_left.rotation.T + inverse_depth[..., None] * rig.right_from_left.translation_m
    pixel = rig.right.project(points)
    back = rig.right.undistort(pixel)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(back - points[..., :2] / points[..., 2:]).max(axis=-1)
    return np.where((error < 1e-6)[..., None], pixel, np.nan)


def _lines(rig: StereoRig, points_px: FloatArray) -> _EpipolarLines:
    """Return the epipolar lines of points (S, 2) within the right image."""
    base = float(np.linalg.norm(rig.right_from_left.translation_m))
    rays = _rays(rig, points_px)
    grid = np.linspace(1.0 / FARTHEST, 1.0 / NEAREST, SAMPLES) / base
    coarse = _right_pixels(rig, np.repeat(rays[:, None], SAMPLES, axis=1), np.broadcast_to(grid, (len(rays), SAMPLES)))
    inside = np.asarray(((coarse >= 0.0) & (coarse <= rig.right.size_px - 1.0)).all(axis=-1))
    divided = []
    for line, within in zip(coarse, inside, strict=True):
        run = np.flatnonzero(within)
        if len(run) < 2:
            divided.append(np.empty(0))
            continue
        run = run[: 1 + int(np.argmax(np.append(np.diff(run) > 1, True)))]  # the first connected part
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[run], axis=0).T))])
        divided.append(np.interp(np.arange(0.0, length[-1]), length, grid[run]))
    inverse = np.full((len(rays), max(1, *(len(one) for one in divided))), np.nan)
    middles = np.full((len(rays), -(-inverse.shape[1] // BLOCK_PX)), np.nan)
    for row, middle, one in zip(inverse, middles, divided, strict=True):
        row[: len(one)] = one
        centres = np.arange(BLOCK_PX // 2, len(one) + BLOCK_PX // 2, BLOCK_PX)
        middle[: len(centres)] = one[np.minimum(centres, len(one) - 1)]
    right_px, inverse = _right_pixels(rig, rays[:, None], inverse), middles
    sides = [_rays(rig, points_px + shift)[:, None] for shift in 0.5 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])]
    views = [_right_pixels(rig, side, inverse) for side in sides]
    affine = np.stack([views[0] - views[1], views[2] - views[3]], axis=-1)
    ends = [_right_pixels(rig, rays[:, None], inverse * factor) for factor in (1.0 - 1e-4, 1.0 + 1e-4)]
    along = (ends[1] - ends[0]) / 2e-4
    change = np.stack([sides[0] - sides[1], sides[2] - sides[3]], axis=-1)[:, 0]
    slope = _slopes(rig, rays, inverse, change)
    affine = affine[:, :, None] + along[:, :, None, :, None] * slope[..., None, :]
    affine[(np.abs(affine) > LARGEST_STRETCH).any(axis=(-2, -1))] = np.nan
    return _EpipolarLines(right_px, affine)


def _slopes(rig: StereoRig, rays: FloatArray, inverse: FloatArray, change: FloatArray) -> FloatArray:
    """Return changes (S,K,T,2) of the logarithm of inverse depth (S,K) per left pixel.

    On surfaces tilted by T steps. change (S, 3, 2): of the rays per pixel. With n the normal, inverse depth is
    n·ray/const.
    """
    points = rays[:, None] / inverse[..., None]
    to_right_camera = rig.right_from_left.inverse().translation_m - points
    to_left = -points / np.linalg.norm(points, axis=-1, keepdims=True)
    to_right = to_right_camera / np.linalg.norm(to_right_camera, axis=-1, keepdims=True)
    middle, difference = to_left + to_right, to_right - to_left
    half = np.linalg.norm(difference, axis=-1) / np.linalg.norm(middle, axis=-1)  # tangent of half the angle of sight
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    difference /= np.maximum(np.linalg.norm(difference, axis=-1, keepdims=True), 1e-12)
    normal_across = np.cross(middle, difference)
    u, v = (part.ravel() for part in np.meshgrid(STRAINS, STRAINS))
    order = np.argsort(np.hypot(u, v), kind="stable")
    u, v = u[order], v[order]
    reach = np.hypot(u, v) / np.maximum(half, 1e-9)[..., None]
    allowed = (reach <= STEEPEST) | (np.hypot(u, v) == 0.0)
    most = int(np.max(allowed.sum(axis=-1), initial=1))  # the flattest ones are first
    scale = 1.0 / np.maximum(half, 1e-9)[..., None, None]
    normal = middle[..., None, :] + scale * (
        u[:most, None] * difference[..., None, :] + v[:most, None] * normal_across[..., None, :]
    )
    slope = np.einsum("sktx,sxi->skti", normal, change) / np.einsum("sktx,sx->skt", normal, rays)[..., None]
    return np.where(allowed[..., :most, None], slope, np.nan)


@njit(error_model="numpy")
def _sweep(strip, origin, maps, grey, offsets, offsets_across, outcome):  # type: ignore[no-untyped-def]
    """Fill outcome (K,): the best correlation at each point, its tilt and line.

    strip: grey values about the line, which begins at `origin`; grey (P,): those of the subset at its offsets (P, 2),
    normalised, which maps (B, T, 2, 2) carry into the strip.
    """
    (score, tilt, line), count = outcome, grey.size
    total, square, product = np.empty((3, BLOCK_PX))
    for block in range(maps.shape[0]):
        first = block * BLOCK_PX
        for t in range(maps.shape[1]):
            if not np.isfinite(maps[block, t, 0, 0]):
                continue
            for j in range(offsets_across.size):
                total[:], square[:], product[:] = 0.0, 0.0, 0.0
                for p in range(grey.size):
                    dx, dy = offsets[p, 0], offsets[p, 1]
                    x = origin[0] + first + maps[block, t, 0, 0] * dx + maps[block, t, 0, 1] * dy
                    y = origin[1] + offsets_across[j] + maps[block, t, 1, 0] * dx + maps[block, t, 1, 1] * dy
                    column, row, subset_grey = int(x), int(y), grey[p]
                    right, below = x - column, y - row
                    left, above = 1.0 - right, 1.0 - below
                    a, b, c, d = above * left, above * right, below * left, below * right
                    upper = strip[row, column : column + BLOCK_PX + 1]
                    lower = strip[row + 1, column : column + BLOCK_PX + 1]
                    for k in range(BLOCK_PX):
                        value = a * upper[k] + b * upper[k + 1] + c * lower[k] + d * lower[k + 1]
                        total[k] += value
                        square[k] += value * value
                        product[k] += value * subset_grey
                for k in range(min(BLOCK_PX, score.size - first)):
                    spread = square[k] - total[k] * total[k] / count
                    if spread > 0.0 and product[k] > score[first + k] * math.sqrt(spread):
                        score[first + k] = product[k] / math.sqrt(spread)
                        tilt[first + k], line[first + k] = t, j


@njit(error_model="numpy")
def _climb(image, points, grey, offsets, starts, along):  # type: ignore[no-untyped-def]
    """Improve starts (C, S, 6) by ever shorter steps in position and in tilt.

    A tilt stretches along (C, S, 2) alone.
    """
    reach = -offsets[0, 0]
    for n in range(points.shape[0]):
        x, y, subset = points[n, 0], points[n, 1], (grey[n], offsets)
        for c in range(starts.shape[0]):
            if not np.isfinite(starts[c, n, 0]):
                continue
            current, (i, j) = starts[c, n].copy(), along[c, n]
            best = _zncc(image, x, y, current, subset)
            step = LINE_PX / 2.0
            while step > CLIMBED_PX:
                higher = False
                for part in (0, 3, 1, 2):
                    for sign in (-1.0, 1.0):
                        tried = current.copy()
                        if part % 3 == 0:
                            tried[part] += sign * step
                        else:
                            tried[part] += sign * step / reach * i
                            tried[part + 3] += sign * step / reach * j
                        found = _zncc(image, x, y, tried, subset)
                        if found > best:
                            best, current, higher = found, tried, True
                if not higher:
                    step *= 0.5
            starts[c, n] = current


@njit(error_model="numpy")
def _zncc(image, x, y, warp, subset):  # type: ignore[no-untyped-def]
    """Return the correlation of a normalised subset with its image by a warp (6,).

    −1 beyond the image.
    """
    (u, a, b, v, c, d), (grey, offsets) = warp, subset
    a, d, x, y = 1.0 + a, 1.0 + d, x + u, y + v
    reach = -offsets[0, 0]
    wide, high = reach * (abs(a) + abs(b)), reach * (abs(c) + abs(d))
    if not (wide <= x < image.shape[1] - 1 - wide and high <= y < image.shape[0] - 1 - high):
        return -1.0
    total, square, product = 0.0, 0.0, 0.0
    for p in range(grey.size):
        dx, dy, subset_grey = offsets[p, 0], offsets[p, 1], grey[p]
        value = _bilinear(image, x + a * dx + b * dy, y + c * dx + d * dy)
        total += value
        square += value * value
        product += value * subset_grey
    spread = square - total * total / grey.size
    return product / math.sqrt(spread) if spread > 0.0 else -1.0


@njit(error_model="numpy", inline="always")
def _bilinear(image, x, y):  # type: ignore[no-untyped-def]
    """Return the grey value between four pixels, inside the image."""
    i, j = int(y), int(x)
    s, t = y - i, x - j
    top = image[i, j] + t * (image[i, j + 1] - image[i, j])
    bottom = image[i + 1, j] + t * (image[i + 1, j + 1] - image[i + 1, j])
    return top + s * (bottom - top)
