"""Checks of a few images: exposure, focus, speckle, and the calibration of a pair."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.planning.look.finding import Finding, Verdict
from photogram.arrays import BoolArray, FloatArray
from photogram.camera import StereoRig, epipolar_residual, triangulate
from photogram.images.exposure import clip_level, missing_pattern_reason
from photogram.images.sequence import GreyImage, ImageSequence
from photogram.subsets.search import match_features
from photogram.subsets.texture import default_radius_px, lay_grid, repeat_px, speckle_size, textured_area

FRAMES = 8  # of each camera
EVERY = 4  # pixel in a direction, of frames beyond the first
LEVELS = 200  # grey values of a dark picture that show a pattern: its bit depth may be stated too large
DARK, BLACK = 0.1, 0.3  # brightest pixel over full scale; brightness over that of the first frame
SATURATED, MUCH_SATURATED = 0.002, 0.02  # share of the body's pixels
LOW_CONTRAST = 0.03  # standard deviation over full scale
FINE_PX, COARSE_PX, MAX_SPECKLE_RATIO = 2.5, 7.5, 1.5
SMALL_AREA = 0.02  # share of the picture
LARGEST_PX = 400  # side of the pictures in which features are matched
FEATURES = 2000  # of each picture
INLIER_PX, OFF_PX, FAR_OFF_PX = 3.0, 0.3, 1.0
FEWEST_MATCHES, FEWEST_ON_LINES = 20, 0.2


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
    found = [Finding("CHECK", where, notice.text) for notice in images.notices if notice.severity == "warning"]
    blank = missing_pattern_reason(first, images.full_scale)
    if blank:
        return [*found, Finding("REPEAT", where, f"no speckled body is seen: {blank}")], None
    found += _brightness(where, first, others, images.full_scale)
    area = textured_area(first)
    if any(finding.verdict == "REPEAT" and "dark" in finding.text for finding in found):
        return found, None
    inside = first[area]
    if area.mean() < SMALL_AREA or len(inside) < 1000:
        found.append(Finding("REPEAT", where, "no speckled body is seen"))
        return found, None
    clipped = clip_level(first)
    limit = images.full_scale if clipped is None else clipped
    full, where_cut = float(np.mean(inside >= limit)), "" if clipped is None else f" at {limit} of {images.full_scale}"
    if full > SATURATED:
        verdict: Verdict = "REPEAT" if full > MUCH_SATURATED else "CHECK"
        text = f"overexposed: {100 * full:.2g} % of the body's pixels are saturated{where_cut}"
        found.append(Finding(verdict, where, text))
    if float(inside.std()) < LOW_CONTRAST * images.full_scale:
        share = 100 * float(inside.std()) / images.full_scale
        found.append(Finding("CHECK", where, f"low contrast: speckle is {share:.2g} % of full scale (rms)"))
    speckle = speckle_size(first, area)
    if speckle < FINE_PX:
        found.append(Finding("CHECK", where, f"speckle too fine: {speckle:.2g} px, 3 to 6 px are best"))
    if speckle > COARSE_PX:
        text = f"out of focus, or speckle too coarse: {speckle:.2g} px, 3 to 6 px are best"
        found.append(Finding("CHECK", where, text))
    radius = default_radius_px(speckle)
    points = lay_grid(area, radius, 2 * radius + 1)
    return found, CameraExamination(first, area, speckle, points, radius, _sigma_px(first, area, radius))


def _brightness(
    where: str, first: GreyImage, others: dict[int, NDArray[np.unsignedinteger]], full_scale: int
) -> Iterator[Finding]:
    """Yield dark frames."""
    if float(first.max()) < DARK * full_scale:
        verdict: Verdict = "REPEAT" if first.max() < LEVELS else "CHECK"
        yield Finding(verdict, where, f"dark: the brightest pixel is {int(first.max())} of {full_scale}")
        return
    level = float(np.mean(first[::EVERY, ::EVERY]))
    black = [i for i, image in others.items() if float(np.mean(image)) < BLACK * level]
    if black:
        yield Finding("REPEAT", where, f"dark frames: {len(black)} of {len(others) + 1} looked at, such as {black[0]}")


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
        sizes = f"{left.speckle_px:.2g} px left, {right.speckle_px:.2g} px right"
        found.append(Finding("CHECK", where, f"the {side} camera is out of focus: speckle of {sizes}"))
    period = repeat_px(left.image, left.points_px, left.radius_px)
    if np.isfinite(period):
        found.append(
            Finding("CHECK", where, f"the speckle foil repeats every {period:.3g} px: matches may be ambiguous")
        )
    matches = _matches(left.image, right.image)
    if len(matches[0]) < FEWEST_MATCHES:
        found.append(Finding("CHECK", where, f"only {len(matches[0])} features are alike left and right"))
        return found, None
    straight, swapped = (np.abs(epipolar_residual(rig, *order)[0]) for order in (matches, matches[::-1]))
    share, other = (float(np.mean(residual < INLIER_PX)) for residual in (straight, swapped))
    if other > 0.5 and np.median(swapped) < np.median(straight) / 3.0:
        text = "left and right are exchanged: features lie on the epipolar lines of the other order"
        found.append(Finding("FIX MANIFEST", where, text))
        return found, None
    if share < FEWEST_ON_LINES:
        text = f"{100 * share:.2g} % of {len(matches[0])} features lie on their epipolar lines"
        found.append(Finding("FIX MANIFEST", where, f"is not what was calibrated, or sees two things: {text}"))
        return found, None
    near = straight < INLIER_PX
    off = float(np.median(straight[near]))
    if off > OFF_PX:
        verdict: Verdict = "FIX MANIFEST" if off > FAR_OFF_PX else "CHECK"
        found.append(
            Finding(verdict, where, f"features lie {off:.2g} px off their epipolar lines: was a camera touched?")
        )
    sigma = [np.eye(2) * camera.sigma_px**2 for camera in (left, right)]
    points = triangulate(rig, matches[0][None, near], matches[1][None, near], *sigma)
    finite = np.isfinite(points.covariance_m2[0]).all(axis=(1, 2))
    if not finite.any() or not len(left.points_px):
        return found, None
    # Two frames, the reference and the one that moved, in every displacement.
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
