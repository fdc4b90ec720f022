"""Checks of a few images: exposure, focus, speckle, and the calibration of a pair."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.planning.look.finding import Finding, Verdict
from fusion.planning.look.look_notices import (
    CALIBRATION_CONTRADICTED,
    CAMERA_OUT_OF_FOCUS,
    CAMERAS_EXCHANGED,
    DARK_FRAMES,
    DARK_IMAGES,
    EPIPOLAR_OFFSET,
    FEW_COMMON_FEATURES,
    LOW_CONTRAST,
    NO_SPECKLE,
    OVEREXPOSED,
    REPEATING_PATTERN,
    SPECKLE_SIZE,
)
from photogram.camera import StereoRig, epipolar_residual, triangulate
from photogram.images.sequence import GreyImage, ImageSequence, clip_level, missing_pattern_reason
from photogram.subsets.search import match_features
from photogram.subsets.texture import (
    place_subsets,
    radius_from_speckle_px,
    repeat_distance_px,
    speckle_size,
    textured_area,
)
from shakercal._common.arrays import BoolArray, FloatArray
from shakercal._common.notices import Notice

FRAMES = 8  # of each camera
EVERY = 4  # pixel in a direction, of frames beyond the first
LEVELS = 200  # grey values of a dark image with a pattern: the stated bit depth may be too large
DARK, BLACK = 0.1, 0.3  # brightest pixel over full scale; brightness over that of the first frame
SATURATED, MUCH_SATURATED = 0.002, 0.02  # share of the body's pixels
MIN_CONTRAST = 0.03  # standard deviation over full scale
FINE_PX, COARSE_PX, MAX_SPECKLE_RATIO = (
    2.5,
    7.5,
    1.5,
)  # limits of the speckle size (iDICs: 3 to 5 px); of its ratio between two cameras
SMALL_AREA = 0.02  # share of the image
LARGEST_PX = 400  # side of the images in which features are matched
FEATURES = 2000  # of each image
INLIER_PX, OFF_PX, FAR_OFF_PX = 3.0, 0.3, 1.0  # epipolar distance of a match; median for a warning; for an error
FEWEST_MATCHES, FEWEST_ON_LINES = 20, 0.2  # matches for a check; least share of them on their epipolar lines
DARK_CODES = (DARK_IMAGES.code, DARK_FRAMES.code)


@dataclass(frozen=True)
class CameraExamination:
    """First frame of a camera: textured area, speckle size, subsets, noise of their positions."""

    image: GreyImage
    area: BoolArray
    speckle_px: float
    points_px: FloatArray
    radius_px: int
    sigma_px: float


def examine_camera(where: str, images: ImageSequence) -> tuple[list[Finding], CameraExamination | None]:
    """Return the findings of some frames of a camera, and its examination.

    The latter is None if the first frame is unusable.
    """
    chosen = sorted({round(i * (len(images) - 1) / (FRAMES - 1)) for i in range(FRAMES)})
    first = images.read(chosen[0])
    others = {i: images.read(i)[::EVERY, ::EVERY] for i in chosen[1:]}
    found = [Finding("CHECK", notice.at(where)) for notice in images.notices if notice.severity == "warning"]
    blank = missing_pattern_reason(first, images.full_scale)
    if blank:
        return [*found, Finding("REPEAT", Notice(NO_SPECKLE, where, reason=blank))], None
    found += _brightness(where, first, others, images.full_scale)
    area = textured_area(first)
    if any(finding.verdict == "REPEAT" and finding.code in DARK_CODES for finding in found):
        return found, None
    inside = first[area]
    if area.mean() < SMALL_AREA or len(inside) < 1000:
        reason = f"only {np.count_nonzero(area)} pixels, {100 * area.mean():.2g} % of the image, have texture"
        found.append(Finding("REPEAT", Notice(NO_SPECKLE, where, reason=reason)))
        return found, None
    clipped = clip_level(first)
    limit = images.full_scale if clipped is None else clipped
    full = float(np.mean(inside >= limit))
    if full > SATURATED:
        verdict: Verdict = "REPEAT" if full > MUCH_SATURATED else "CHECK"
        levels = {"level": limit, "full_scale": images.full_scale}
        found.append(Finding(verdict, Notice(OVEREXPOSED, where, share_percent=100 * full, **levels)))
    if float(inside.std()) < MIN_CONTRAST * images.full_scale:
        share = 100 * float(inside.std()) / images.full_scale
        found.append(Finding("CHECK", Notice(LOW_CONTRAST, where, share_percent=share)))
    speckle = speckle_size(first, area)
    if not FINE_PX <= speckle <= COARSE_PX:
        found.append(Finding("CHECK", Notice(SPECKLE_SIZE, where, size_px=speckle)))
    radius = radius_from_speckle_px(speckle)
    points = place_subsets(area, radius, 2 * radius + 1)
    return found, CameraExamination(first, area, speckle, points, radius, _sigma_px(first, area, radius))


def _brightness(
    where: str, first: GreyImage, others: dict[int, NDArray[np.unsignedinteger]], full_scale: int
) -> Iterator[Finding]:
    """Yield dark frames."""
    if float(first.max()) < DARK * full_scale:
        verdict: Verdict = "REPEAT" if first.max() < LEVELS else "CHECK"
        yield Finding(verdict, Notice(DARK_IMAGES, where, brightest=int(first.max()), full_scale=full_scale))
        return
    level = float(np.mean(first[::EVERY, ::EVERY]))
    black = [i for i, image in others.items() if float(np.mean(image)) < BLACK * level]
    if black:
        counts = {"dark": len(black), "examined": len(others) + 1, "example": black[0]}
        yield Finding("REPEAT", Notice(DARK_FRAMES, where, **counts))


def _sigma_px(image: GreyImage, area: BoolArray, radius_px: int) -> float:
    """Return the position noise of a subset in px: √2·σ/√Σf_x², σ from second differences.

    The noise is by Immerkær's operator, which suppresses planes (Computer Vision and Image Understanding 64 (1996)
    300), in the tenth of the image with the smallest values.
    """
    grey = image.astype(np.float64)
    rough = np.abs(
        grey[:-2, :-2] + grey[2:, 2:] + grey[:-2, 2:] + grey[2:, :-2]
        - 2 * (grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]) + 4 * grey[1:-1, 1:-1]
    )  # fmt: skip
    tiles = rough[: rough.shape[0] // 16 * 16, : rough.shape[1] // 16 * 16]
    means = tiles.reshape(tiles.shape[0] // 16, 16, -1, 16).mean(axis=(1, 3))
    sigma = float(np.sqrt(np.pi / 2) / 6 * np.quantile(means, 0.1))
    slope = np.gradient(grey, axis=1)
    energy = float(np.mean(slope[area] ** 2)) * (2 * radius_px + 1) ** 2
    return float(np.sqrt(2.0) * sigma / np.sqrt(max(energy, 1e-300)))


@dataclass(frozen=True)
class PairPrecision:
    """Precision of a pair: covariance (3, 3) in m² of the body's mean displacement.

    It is that between two frames, in the camera frame.
    """

    covariance_m2: FloatArray


def examine_pair(
    where: str, rig: StereoRig, left: CameraExamination, right: CameraExamination
) -> tuple[list[Finding], PairPrecision | None]:
    """Return the findings of a pair's first frames: epipolar residuals and repetition."""
    found = []
    if max(left.speckle_px, right.speckle_px) > MAX_SPECKLE_RATIO * min(left.speckle_px, right.speckle_px):
        side = "left" if left.speckle_px > right.speckle_px else "right"
        sizes = {"left_px": left.speckle_px, "right_px": right.speckle_px}
        found.append(Finding("CHECK", Notice(CAMERA_OUT_OF_FOCUS, where, side=side, **sizes)))
    period = repeat_distance_px(left.image, left.points_px, left.radius_px)
    if np.isfinite(period):
        found.append(Finding("CHECK", Notice(REPEATING_PATTERN, where, period_px=period)))
    matches = _matches(left.image, right.image)
    if len(matches[0]) < FEWEST_MATCHES:
        found.append(Finding("CHECK", Notice(FEW_COMMON_FEATURES, where, count=len(matches[0]))))
        return found, None
    straight, swapped = (np.abs(epipolar_residual(rig, *order)[0]) for order in (matches, matches[::-1]))
    share, other = (float(np.mean(residual < INLIER_PX)) for residual in (straight, swapped))
    if other > 0.5 and np.median(swapped) < np.median(straight) / 3.0:
        found.append(Finding("FIX MANIFEST", Notice(CAMERAS_EXCHANGED, where)))
        return found, None
    if share < FEWEST_ON_LINES:
        notice = Notice(CALIBRATION_CONTRADICTED, where, share_percent=100 * share, count=len(matches[0]))
        found.append(Finding("FIX MANIFEST", notice))
        return found, None
    near = straight < INLIER_PX
    off = float(np.median(straight[near]))
    if off > OFF_PX:
        verdict: Verdict = "FIX MANIFEST" if off > FAR_OFF_PX else "CHECK"
        found.append(Finding(verdict, Notice(EPIPOLAR_OFFSET, where, offset_px=off)))
    sigma = [np.eye(2) * camera.sigma_px**2 for camera in (left, right)]
    points = triangulate(rig, matches[0][None, near], matches[1][None, near], *sigma)
    finite = np.isfinite(points.covariance_m2[0]).all(axis=(1, 2))
    if not finite.any() or not len(left.points_px):
        return found, None
    # Every displacement has the noise of two frames.
    return found, PairPrecision(2.0 * np.median(points.covariance_m2[0][finite], axis=0) / len(left.points_px))


def _matches(left: GreyImage, right: GreyImage) -> tuple[FloatArray, FloatArray]:
    """Return features (M, 2) in both images; large images are reduced first."""
    import cv2

    factor = max(1.0, max(left.shape) / LARGEST_PX)
    seen: list[NDArray[Any]] = [left, right]
    if factor > 1.0:
        size = (round(left.shape[1] / factor), round(left.shape[0] / factor))
        seen = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in seen]
    first, second = match_features(seen[0], seen[1], FEATURES)
    return (first + 0.5) * factor - 0.5, (second + 0.5) * factor - 0.5
