"""First guesses for subsets: matched features, template matching, good neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shakercal._common.arrays import FloatArray, IntArray, check_shape

Image = NDArray[Any]
FEATURES = 6000  # of an image: about one for every subset of a large one
NEIGHBOURS = 16  # matches of an affine map, with enough agreeing ones
MIN_INLIERS = 5  # three determine an affine map
RANSAC_PX = 1.5  # precision of SIFT features with a margin
ALONG_A_LINE = 1e-6  # determinant of normal equations over its bound, below which points lie on a line
RATIO = 0.8  # of distances, by Lowe 2004
SUPPORT = 8  # neighbours of a subset in a square grid
LIKE_PEAK, LESS_PEAK, PEAK_PX = 0.8, 0.15, 3  # correlation of a copy, its difference to the best, radius of a peak


def match_features(left_image: Image, right_image: Image, most: int = FEATURES) -> tuple[FloatArray, FloatArray]:
    """Return positions (M, 2), (M, 2) of the same SIFT features in both images.

    Mutually nearest, with the ratio test (Lowe 2004, Int. J. Comput. Vis. 60, 91). OpenCV's features, the `most`
    distinct of each image.
    """
    import cv2

    finder = cv2.SIFT.create(nfeatures=most, contrastThreshold=0.01)
    left_points, left_words = finder.detectAndCompute(_eight_bit(left_image), None)
    right_points, right_words = finder.detectAndCompute(_eight_bit(right_image), None)
    if min(len(left_points), len(right_points)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = [match.trainIdx for match in matcher.match(right_words, left_words)]
    pairs = [
        (first.queryIdx, first.trainIdx)
        for first, second in matcher.knnMatch(left_words, right_words, 2)
        if first.distance < RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    left = np.array([left_points[first].pt for first, _ in pairs], dtype=np.float64).reshape(-1, 2)
    right = np.array([right_points[second].pt for _, second in pairs], dtype=np.float64).reshape(-1, 2)
    return left, right


def affine_starts(points_px: FloatArray, source_px: FloatArray, target_px: FloatArray) -> FloatArray:
    """Return warps (N,6) at points_px (N,2) from matches (M,2) around each, NaN for too few.

    source_px, target_px: the matches. The affine map is that of the 16 nearest matches. Where not all agree, it is that
    of those that agree by RANSAC, at least 5 (Fischler, Bolles 1981, Commun. ACM 24, 381).
    """
    import cv2
    from scipy.spatial import cKDTree

    check_shape("points_px", points_px, (None, 2))
    starts = np.full((len(points_px), 6), np.nan)
    if len(source_px) < MIN_INLIERS:
        return starts
    _, nearest = cKDTree(source_px).query(points_px, k=min(NEIGHBOURS, len(source_px)))
    source, moved = (positions[nearest] - points_px[:, None] for positions in (source_px, target_px))
    design = np.pad(source, ((0, 0), (0, 0), (0, 1)), constant_values=1.0)
    transposed = np.swapaxes(design, 1, 2)
    normal = transposed @ design
    solvable = np.linalg.det(normal) > ALONG_A_LINE * np.prod(np.diagonal(normal, axis1=1, axis2=2), axis=1)
    affine = np.linalg.solve(np.where(solvable[:, None, None], normal, np.eye(3)), transposed @ moved)
    off = np.linalg.norm(moved - design @ affine, axis=-1).max(axis=1)
    for n, all_agree in enumerate(solvable & (off <= RANSAC_PX)):
        if all_agree:
            starts[n] = warp_of_affine(affine[n].T)
            continue
        found, inliers = cv2.estimateAffine2D(source[n], moved[n], ransacReprojThreshold=RANSAC_PX)
        if found is not None and int(inliers.sum()) >= MIN_INLIERS:
            starts[n] = warp_of_affine(np.asarray(found, dtype=np.float64))
    return starts


def neighbour_starts(points_px: FloatArray, warp: FloatArray) -> FloatArray:
    """Return warps (N,6) carried over from the nearest point with a finite warp (N,6).

    The affine map of that point carries them over, for warps (N, 12) of second order with its curvature.
    """
    from scipy.spatial import cKDTree

    finite = np.isfinite(warp).all(axis=1) & np.isfinite(points_px).all(axis=1)
    starts = np.full_like(warp, np.nan)
    targets = np.isfinite(points_px).all(axis=1)
    if not finite.any() or not targets.any():
        return starts
    _, nearest = cKDTree(points_px[finite]).query(points_px[targets])
    source = warp[finite][nearest]
    distance = points_px[targets] - points_px[finite][nearest]
    starts[targets] = source
    x, y = distance.T
    for u, curved in ((0, source[:, 6:9]), (3, source[:, 9:12])):
        starts[targets, u] += source[:, u + 1] * x + source[:, u + 2] * y
        if curved.shape[1]:
            xx, xy, yy = curved.T
            starts[targets, u] += xx * x * x / 2.0 + xy * x * y + yy * y * y / 2.0
            starts[targets, u + 1] += xx * x + xy * y
            starts[targets, u + 2] += xy * x + yy * y
    return starts


def agreeing_neighbours(points_px: FloatArray, warp: FloatArray) -> FloatArray:
    """Return the share (N,) of the eight nearest subsets that predict each one.

    Agreement is within 3 px and 5 % of the distance, by each neighbour's affine map (N, 6): a surface may bend and have
    several parts. NaN without neighbours.
    """
    from scipy.spatial import cKDTree

    finite = np.flatnonzero(np.isfinite(warp).all(axis=1))
    share = np.full(len(points_px), np.nan)
    if len(finite) < 2:
        return share
    points, found = points_px[finite], warp[finite]
    distance, near = cKDTree(points).query(points, k=min(1 + SUPPORT, len(finite)))
    x, y = np.moveaxis(points[:, None] - points[near[:, 1:]], -1, 0)
    off = [
        found[near[:, 1:], u] + found[near[:, 1:], u + 1] * x + found[near[:, 1:], u + 2] * y - found[:, None, u]
        for u in (0, 3)
    ]
    share[finite] = np.mean(np.hypot(*off) <= 3.0 + 0.05 * distance[:, 1:], axis=1)
    return share


def template_shifts(
    reference: Image, image: Image, points_px: FloatArray, radius_px: int, reach_px: int, guess_px: FloatArray
) -> FloatArray:
    """Return displacements (N, 2) in whole pixels at which subsets correlate best, NaN outside.

    Zero-normalised cross-correlation of `reference` with `image` by FFT (OpenCV) within `reach_px` around guess_px (N,
    2). Where the pattern repeats, there are several peaks above 0.8 within 0.15 of the highest: a copy half a pixel off
    loses as much. Of these the one next to the guess counts.
    """
    import cv2

    shifts = np.full((len(points_px), 2), np.nan)
    first, second = reference.astype(np.float32), image.astype(np.float32)
    for n, (point, guess) in enumerate(zip(points_px, guess_px, strict=True)):
        x, y = np.rint(point).astype(np.int64)
        template = _cut(first, x, y, radius_px)[0]
        centre = np.rint(point + guess).astype(np.int64)
        window, left, top = _cut(second, centre[0], centre[1], radius_px + reach_px)
        full = template.shape == (2 * radius_px + 1, 2 * radius_px + 1)
        if full and window.shape[0] >= template.shape[0] and window.shape[1] >= template.shape[1]:
            score = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
            corner = np.array([left + radius_px, top + radius_px])
            peaks = corner + score_peaks(score, max(LIKE_PEAK, float(score.max()) - LESS_PEAK)) - (x, y)
            shifts[n] = peaks[np.argmin(np.hypot(*(peaks - guess).T))]
    return shifts


def score_peaks(score: NDArray[Any], threshold: float) -> IntArray:
    """Return column and row (K,2) of the peaks of a correlation map (H,W), highest first.

    Peaks below `threshold` are ignored, except the highest one.
    """
    import cv2

    size = np.ones((2 * PEAK_PX + 1, 2 * PEAK_PX + 1), np.uint8)
    rows, columns = np.nonzero((score >= min(threshold, float(score.max()))) & (score == cv2.dilate(score, size)))
    order = np.argsort(-score[rows, columns], kind="stable")
    return np.stack([columns[order], rows[order]], axis=1)


def affine_field(points_px: FloatArray, displacement_px: FloatArray, targets_px: FloatArray) -> FloatArray:
    """Return warps (N, 6) at targets_px (N, 2) from one affine motion through displacements.

    Outliers are rejected. With fewer than four agreeing points it is the median displacement everywhere, NaN without
    any.
    """
    import cv2

    starts = np.full((len(targets_px), 6), np.nan)
    finite = np.isfinite(displacement_px).all(axis=1)
    source, moved = points_px[finite], points_px[finite] + displacement_px[finite]
    if len(source) == 0:
        return starts
    affine, agree = np.eye(2, 3), 0
    if len(source) > 3:
        found, inliers = cv2.estimateAffine2D(source, moved, ransacReprojThreshold=2.0)
        if found is not None and inliers is not None:
            affine, agree = np.asarray(found, dtype=np.float64), int(np.sum(inliers))
    if agree < 4:
        starts[:] = 0.0
        starts[:, [0, 3]] = np.median(displacement_px[finite], axis=0)
        return starts
    starts[:] = warp_of_affine(affine)
    starts[:, [0, 3]] = targets_px @ affine[:, :2].T + affine[:, 2] - targets_px
    return starts


def warp_of_affine(affine: FloatArray) -> FloatArray:
    """Return the warp [u,u_x,u_y,v,v_x,v_y] of the 2 x 3 affine map of coordinates."""
    (a, b, u), (c, d, v) = affine
    return np.array([u, a - 1.0, b, v, c, d - 1.0])


def _eight_bit(image: Image) -> NDArray[np.uint8]:
    """Return grey values between the 0.5 and 99.5 % quantiles scaled to 8 bits."""
    low, high = np.percentile(image, (0.5, 99.5))
    spread = (image.astype(np.float64) - low) * (255.0 / max(high - low, 1.0))
    return np.asarray(np.clip(spread, 0.0, 255.0).astype(np.uint8))


def _cut(image: NDArray[np.float32], x: int, y: int, radius: int) -> tuple[NDArray[np.float32], int, int]:
    """Return the part of a square within the image, its left and top."""
    left, top = max(0, x - radius), max(0, y - radius)
    return image[top : max(top, y + radius + 1), left : max(left, x + radius + 1)], left, top


LARGEST_COEFFICIENT = 3.0  # of c = 1 + 2cos(ωΔt)
HISTORY = 6  # frames that predict the next one


def predict_warp(history: Sequence[FloatArray]) -> FloatArray:
    """Return the next warps (N, p) after those in `history`, oldest first.

    The displacements of all subsets choose the rule (`predict_next`).
    """
    weights = np.zeros(history[-1].shape[-1])
    weights[[0, 3]] = 1.0
    return predict_next(history, weights)


def predict_next(history: Sequence[FloatArray], weights: FloatArray) -> FloatArray:
    """Return the next of a series by the rule that predicted the last best.

    Rules for the series, oldest first: constant; linear, 2x₋₁ − x₋₂; one sine about any mean, x₋₃ + c(x₋₁ − x₋₂) with c
    = 1 + 2cos(ωΔt) fitted to all rows. The last one also applies to a vibration sampled below its frequency. `weights`
    (p,): of the components of a row in the comparison; those of weight 0 are ignored.
    """
    before = _predictions(history[:-1], weights) if len(history) > 1 else []
    counted = np.flatnonzero(weights)
    errors = []
    for guess in before:
        distance = np.linalg.norm((guess - history[-1])[..., counted] * weights[counted], axis=-1).ravel()
        finite = distance[np.isfinite(distance)]
        errors.append(float(np.median(finite)) if len(finite) else np.inf)
    guess = _predictions(history, weights)[int(np.argmin(errors)) if errors else 0]
    return np.where(np.isfinite(guess), guess, history[-1])


def _predictions(history: Sequence[FloatArray], weights: FloatArray) -> list[FloatArray]:
    """Return the next array by each rule; the rules need 1, 2 and 4 frames."""
    guesses = [history[-1]]
    if len(history) > 1:
        guesses.append(2.0 * history[-1] - history[-2])
    if len(history) > 3:
        counted = np.flatnonzero(weights)
        before, third, second, last = (frame[..., counted] * weights[counted] for frame in history[-4:])
        slope, change = (second - third).ravel(), (last - before).ravel()
        finite = np.isfinite(slope) & np.isfinite(change)
        power = float(np.sum(slope[finite] ** 2))
        coefficient = float(np.sum(slope[finite] * change[finite])) / power if power > 0.0 else 0.0
        coefficient = min(max(coefficient, -LARGEST_COEFFICIENT), LARGEST_COEFFICIENT)
        guesses.append(history[-3] + coefficient * (history[-1] - history[-2]))
    return guesses
