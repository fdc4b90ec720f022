"""Texture of an image for subsets: area, grid, speckle size, expected σ, bias."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, floor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.images.image_notices import UNRESOLVED_TEXTURE, UNUSED_SUBSETS
from photogram.images.noise import NoiseModel
from photogram.subsets.reference import ReferenceSubsets, TrackStatus
from photogram.subsets.search import score_peaks
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, check_shape
from shakercal._common.notices import Notice

Image = NDArray[Any]
COARSE_WINDOW_PX = 9  # two usual speckles
FINE_WINDOW_PX = 5  # one usual speckle
RIM_PX = 6  # 2 px reach of the fine window, 4 px blurred rim
MIN_CONTRAST_RATIO = 3.0  # factor between the contrasts of body and background
MIN_PART_SHARE = 0.2  # of the largest part's pixels, for a part of the body
TILE_PX = 32  # of spectra: several speckles, many tiles
FINE_CYCLES = 0.4  # cycles per pixel, next to the Nyquist frequency
SATURATED_SHARE = 0.01  # of a subset's pixels, which biases it by less than noise
REPEAT_TEMPLATES, REPEAT_ZNCC = 12, 0.75  # subsets whose copies are searched for; least correlation of a copy
MAX_REPEAT_STEPS = 8  # displacements to the nearest copies of a pattern


def textured_area(image: Image) -> BoolArray:
    """Return the pixels (H, W) of the speckled body, without background and rim.

    The local standard deviation (9 x 9 px) is split by Otsu's threshold on its logarithm (Otsu 1979, IEEE Trans. Syst.
    Man Cybern. 9, 62) and holes are closed. A window of 5 x 5 px refines the outline within the last 9 px; 6 px are
    removed from it: 2 for the window's reach, 4 for the blurred rim. An image whose classes differ by less than a
    factor of 3 is textured everywhere.
    """
    import cv2

    check_shape("image", image, (None, None))
    coarse, fine = (_textured(image, window) for window in (COARSE_WINDOW_PX, FINE_WINDOW_PX))
    if coarse is None:
        return np.ones(image.shape, dtype=np.bool_)
    body = _apply_morphology(_fill_holes(coarse, COARSE_WINDOW_PX), "OPEN", COARSE_WINDOW_PX)
    if fine is not None:
        core = _apply_morphology(np.pad(body, 1), "ERODE", COARSE_WINDOW_PX)[1:-1, 1:-1]
        body = _apply_morphology(core | (body & _fill_holes(fine, FINE_WINDOW_PX)), "OPEN", COARSE_WINDOW_PX)
    mask = _apply_morphology(body, "ERODE", RIM_PX)
    # connected parts that have at least a fifth of the largest one's pixels
    _, labels, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    sizes = parts[:, cv2.CC_STAT_AREA]
    return np.asarray((sizes >= MIN_PART_SHARE * sizes[1:].max(initial=0))[labels] & mask)


def place_subsets(area: BoolArray, radius_px: int, step_px: int) -> FloatArray:
    """Place as many square subsets as possible wholly inside `area` (H, W).

    Returned are their centres (N, 2). In each row subsets are placed from left to right at least `step_px` from each
    other. The heights of the rows, with the same distance, are those with the largest total (dynamic programming), so
    that round bodies are covered to their edge.
    """
    import cv2

    check_shape("area", area, (None, None))
    if radius_px < 1 or step_px < 1:
        raise ValueError(f"radius_px, step_px: expected at least 1, found {radius_px} and {step_px}")
    side = 2 * radius_px + 1
    square = np.ones((side, side), np.uint8)
    possible = cv2.erode(area.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,)) > 0
    edges = np.diff(np.pad(possible, ((0, 0), (1, 1))).astype(np.int8))
    (rows, starts), stops = np.nonzero(edges > 0), np.nonzero(edges < 0)[1]
    columns: list[list[int]] = [[] for _ in possible]
    for row, start, stop in zip(rows.tolist(), starts.tolist(), stops.tolist(), strict=True):  # runs, each centred
        first = max(start, columns[row][-1] + step_px) if columns[row] else start
        columns[row].extend(range(first + max(0, stop - 1 - first) % step_px // 2, stop, step_px))
    best = np.zeros(len(columns) + 1, dtype=np.int64)
    for row, line in enumerate(columns):
        best[row + 1] = max(best[row], len(line) + best[max(0, row + 1 - step_px)])
    centres: list[tuple[float, float]] = []
    row = len(columns)
    while row > 0:
        if best[row] == best[row - 1]:
            row -= 1
        else:
            centres.extend((float(column), float(row - 1)) for column in columns[row - 1])
            row = max(0, row - step_px)
    return np.array(sorted(centres, key=lambda point: (point[1], point[0])), dtype=np.float64).reshape(-1, 2)


def subset_mean(values: Image, points_px: FloatArray, radius_px: int) -> FloatArray:
    """Return the mean (N,) of values (H, W) over subsets around points_px (N, 2).

    Points are rounded to pixels. Beyond the image values are 0.
    """
    height, width = values.shape
    sums = np.zeros((height + 1, width + 1))
    sums[1:, 1:] = np.cumsum(np.cumsum(values, axis=0, dtype=np.float64), axis=1)
    centre = np.rint(np.nan_to_num(points_px, nan=-1e6)).astype(np.int64)
    left, right = np.clip(centre[:, 0] - radius_px, 0, width), np.clip(centre[:, 0] + radius_px + 1, 0, width)
    top, bottom = np.clip(centre[:, 1] - radius_px, 0, height), np.clip(centre[:, 1] + radius_px + 1, 0, height)
    total = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return np.asarray(total / (2 * radius_px + 1) ** 2)


def find_saturated(image: Image, full_scale: int, points_px: FloatArray, radius_px: int) -> BoolArray:
    """Return which subsets have more than 1 % of pixels at full scale.

    The subsets are around points_px (N, 2).
    """
    if image.max() < full_scale:
        return np.zeros(len(points_px), dtype=np.bool_)
    return np.asarray(subset_mean(image >= full_scale, points_px, radius_px) > SATURATED_SHARE)


def mark_unusable(reference: ReferenceSubsets, image: Image, full_scale: int) -> ReferenceSubsets:
    """Set the status of saturated subsets and of subsets without a centre."""
    absent = ~np.isfinite(reference.centre_px).all(axis=1)
    full = find_saturated(image, full_scale, reference.centre_px, reference.radius_px)
    status = np.where(full, np.int8(TrackStatus.SATURATED), reference.status)
    return replace(reference, status=np.where(absent, np.int8(TrackStatus.NO_START), status))


def speckle_size(image: Image, area: BoolArray) -> float:
    """Return the full width at half maximum of the autocorrelation in `area`.

    `area` (H, W) is the mask of the texture; the width is in px. The value at lag 0, raised by noise, is
    replaced by the Gaussian through lags 1 and 2 where that is lower. Between lags the logarithm is linear in the
    squared lag.
    """
    check_shape("area", area, image.shape)
    grey, inside = image.astype(np.float64), area.astype(np.float64)
    background, weight = _blurred(np.where(area, grey, 0.0)), _blurred(inside)
    texture = np.where(area, grey - background / np.maximum(weight, 1e-9), 0.0)
    count = min(TILE_PX, min(image.shape) // 2)

    def covariance(lag: int) -> float:
        return _lagged_products(texture, lag) / max(1.0, _lagged_products(inside, lag))

    lags = [covariance(lag) for lag in range(3)]
    peak = lags[0]
    if lags[1] > 0.0 and lags[2] > 0.0:
        peak = min(peak, lags[1] * (lags[1] / lags[2]) ** (1.0 / 3.0))
    for after in range(1, count):
        lags += [covariance(after)] if after == len(lags) else []
        if lags[after] < 0.5 * peak:
            break
    else:
        return float("nan")
    before = peak if after == 1 else lags[after - 1]
    if lags[after] <= 0.0:
        return float(2.0 * (after - 1 + (before - 0.5 * peak) / (before - lags[after])))
    part = np.log(2.0 * before / peak) / np.log(before / lags[after])
    return float(2.0 * np.sqrt((after - 1) ** 2 + part * (2 * after - 1)))


def repeat_distance_px(image: Image, points_px: FloatArray, radius_px: int) -> float:
    """Return the distance in px at which the pattern repeats, NaN if it does not.

    It is the median distance to the nearest copy of some of the subsets at points_px (N, 2). A third of them must have
    a copy at the same distance.
    """
    copies = _copies_px(image, points_px, radius_px)
    nearest = [float(np.hypot(*each.T).min()) if len(each) else np.inf for each in copies]
    finite = np.array([distance for distance in nearest if np.isfinite(distance)])
    if len(finite) < max(2, len(nearest) / 3):
        return float("nan")
    middle = float(np.median(finite))
    similar = np.count_nonzero(np.abs(finite - middle) <= 0.1 * middle)
    return middle if similar >= len(nearest) / 3 else float("nan")


def repeat_steps_px(image: Image, points_px: FloatArray, radius_px: int) -> FloatArray:
    """Return displacements (K,2) in px, shortest first, at which a third of the subsets repeat."""
    copies = _copies_px(image, points_px, radius_px)
    steps: list[FloatArray] = []
    for step in sorted(np.concatenate([*copies, np.empty((0, 2))]), key=lambda each: float(np.hypot(*each))):
        tolerance = 0.1 * np.hypot(*step)
        if any(np.hypot(*(step - earlier)) <= 2.0 * tolerance for earlier in steps):
            continue
        near = [np.hypot(*(sign * each - step).T) <= tolerance for each in copies for sign in (1.0, -1.0)]
        if (
            sum(first.any() or second.any() for first, second in zip(near[::2], near[1::2], strict=True))
            >= len(copies) / 3
        ):
            steps += [step, -step]
        if len(steps) >= MAX_REPEAT_STEPS:
            break
    return np.array(steps).reshape(-1, 2)


def _copies_px(image: Image, points_px: FloatArray, radius_px: int) -> list[FloatArray]:
    """Return displacements (K,2) in px to the copies of some of the subsets.

    Copies are other positions in image (H, W) with a zero-normalised correlation above 0.75.
    """
    import cv2

    grey = image.astype(np.float32)
    side, copies = 2 * radius_px + 1, []
    inside = points_px[((points_px >= radius_px) & (points_px < np.array(grey.shape[::-1]) - radius_px)).all(axis=1)]
    chosen = inside[:: max(1, len(inside) // REPEAT_TEMPLATES)][:REPEAT_TEMPLATES]
    for x, y in np.rint(chosen).astype(np.int64) - radius_px:
        score = cv2.matchTemplate(grey, grey[y : y + side, x : x + side], cv2.TM_CCOEFF_NORMED)
        displacement = score_peaks(score, REPEAT_ZNCC) - np.array([x, y], dtype=np.float64)
        copies.append(displacement[np.hypot(*displacement.T) > radius_px])
    return copies


def fine_texture_share(image: Image, area: BoolArray, noise_grey: float) -> float:
    """Return the share of the texture's power beyond 0.4 cycles per pixel, noise subtracted.

    Mean periodogram of adjacent tiles of 32 x 32 px in `area`; 0 where all texture is resolved. Texture that still has
    power next to the Nyquist frequency also has some beyond it, aliased. The aliased part moves differently from the
    body and makes errors periodic in the pixel.
    """
    density = _periodogram(image, area, TILE_PX)
    if density is None:
        return float("nan")
    power = density - noise_grey**2
    frequency = np.abs(np.fft.fftfreq(TILE_PX))
    fine = np.maximum.outer(frequency, frequency) > FINE_CYCLES
    return float(max(0.0, power[fine].sum()) / power.sum()) if power.sum() > 0.0 else float("nan")


def _textured(image: Image, window_px: int) -> BoolArray | None:
    """Return pixels of high local contrast, None where contrast has no two classes."""
    import cv2
    from skimage.filters import threshold_otsu

    centred = image - image.mean()
    size = (window_px, window_px)
    mean, square = (cv2.blur(part, size, borderType=cv2.BORDER_REFLECT) for part in (centred, centred**2))
    variance = np.maximum(square - mean**2, 0.0).astype(np.float32)
    contrast = np.log(np.sqrt(variance) + 1e-3 * (1.0 + float(np.std(centred))))
    textured: BoolArray = contrast > threshold_otsu(contrast)
    if textured.all() or not textured.any():
        return None
    if contrast[textured].mean() - contrast[~textured].mean() < np.log(MIN_CONTRAST_RATIO):
        return None
    return textured


def _fill_holes(mask: BoolArray, radius_px: int) -> BoolArray:
    """Return the mask with gaps and holes filled; beyond the image it is empty."""
    import cv2

    closed = _apply_morphology(np.pad(mask, 2 * radius_px), "CLOSE", radius_px).astype(np.uint8)
    cv2.floodFill(closed, None, (0, 0), 2)  # all that is connected with the outside
    return closed[2 * radius_px : -2 * radius_px, 2 * radius_px : -2 * radius_px] < 2


def _apply_morphology(mask: BoolArray, operation: str, radius_px: int) -> BoolArray:
    """Return the mask after OpenCV's `operation` with a disc; the image's border is no outline."""
    import cv2

    size = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), getattr(cv2, f"MORPH_{operation}"), disc) > 0)


def _lagged_products(values: FloatArray, lag: int) -> float:
    """Return Σ v(x)·v(x+lag) over rows and columns."""
    both = (values, values.T)
    return float(sum(np.einsum("ij,ij->", part[lag:], part[: len(part) - lag]) for part in both))


def _blurred(values: FloatArray) -> FloatArray:
    """Blur by three box means, approximately a Gaussian of σ = 32 px.

    Wells 1986, IEEE Trans. PAMI 8, 234.
    """
    import cv2

    for _ in range(3):
        values = np.asarray(cv2.blur(values, (2 * TILE_PX + 1, 2 * TILE_PX + 1), borderType=cv2.BORDER_REFLECT))
    return values


# Expected precision of subsets before they are tracked.

USUAL_RADIUS_PX = 10  # for speckle of 4 to 5 px
SMALLEST_RADIUS_PX, LARGEST_RADIUS_PX = 7, 25  # for noise and aliasing, and for the rim of the body
FEWEST_SPECKLES, MOST_SPECKLES = 4.2, 5.25  # across a subset, measured: see `radius_from_speckle_px`
SMALLEST_SPECKLE_PX = 3.0  # iDICs Good Practices Guide: 3 to 5 px
MAX_MEAN_BIAS_PX = 5e-4  # of the mean of all subsets, of the order of its noise
TAIL_START_CYCLES = 0.25  # cycles per pixel, from which on the decay of the spectrum is fitted
NOISE_CORNER_CYCLES = 0.4  # cycles per pixel in x and y, beyond which the spectrum is mainly noise
EDGE_POWER_EXPONENT = 2.0  # of the frequency in the power spectrum of sharp rims
PERIODOGRAM_REL_STD = 0.2  # relative standard deviation of a periodogram's bins, for weights
BLUR_DECAYS = np.concatenate([[0.0], np.geomspace(0.5, 400.0, 120)])  # trial values of c in exp(−cν²)
UNDETERMINED_PX = 1.0  # standard deviation of a position along an edge, far above that of any usable texture
ONE_DIRECTION = "with texture in one direction only, as edges have"
REASONS = {
    TrackStatus.FLAT: "without texture",
    TrackStatus.SATURATED: "saturated",
    TrackStatus.LEFT_IMAGE: "too close to the image's border",
    TrackStatus.NO_START: "without a position",
    TrackStatus.UNRESOLVED: "with too little texture for the shape function",
}


@dataclass(frozen=True, eq=False, repr=False)
class SubsetQuality(Arrays, shapes="predicted_sigma_px N 2; noise_grey N; status N"):
    """Expected standard deviation of the positions of N subsets in one frame.

    Attributes
    ----------
    predicted_sigma_px : (N, 2) of x and y, NaN where the subset is unusable.
    noise_grey : (N,) rms noise of the pixels that determine the position.
    status : (N,) of `TrackStatus`: `OK`, `FLAT`, `SATURATED`, `LEFT_IMAGE`, `NO_START` or `UNRESOLVED`.
    """

    predicted_sigma_px: FloatArray
    noise_grey: FloatArray
    status: NDArray[np.int8]

    @property
    def usable(self) -> BoolArray:
        """Which subsets can be tracked."""
        return np.asarray(self.status == TrackStatus.OK)

    def notices(self, where: str) -> tuple[Notice, ...]:
        """Return a notice of `where` that counts unused subsets and edges by reason."""
        edges = self.usable & np.any(self.predicted_sigma_px > UNDETERMINED_PX, axis=1)
        lost = [(int(np.sum(self.status == status)), reason) for status, reason in REASONS.items()]
        parts = [f"{count} {reason}" for count, reason in [*lost, (int(np.sum(edges)), ONE_DIRECTION)] if count > 0]
        if not parts:
            return ()
        unused, reasons = int(np.sum(~self.usable | edges)), ", ".join(parts)
        return (Notice(UNUSED_SUBSETS, where, unused=unused, subsets=len(self.status), reasons=reasons),)


def assess_subsets(reference: ReferenceSubsets, image: Image, noise: NoiseModel, full_scale: int) -> SubsetQuality:
    """Predict the precision of the subsets of `reference`, prepared from `image` (H, W).

    σᵢ² = Vᵢᵢ · Σ fᵢ²·s²(f) / Σ fᵢ²: noise counts where the gradients are. V is the `position_variance` per unit noise
    (affine map, gain and offset free), fᵢ the gradient along x or y, and s² the camera's noise model.
    """
    check_shape("image", image, (None, None))
    grey = image.astype(np.float64)
    level = noise.variance(grey)
    status = mark_unusable(reference, image, full_scale).status
    variance = np.empty((len(status), 2))
    for i, slope in enumerate(np.gradient(grey)[::-1]):
        weight = subset_mean(slope**2, reference.centre_px, reference.radius_px)
        noisy = subset_mean(slope**2 * level, reference.centre_px, reference.radius_px)
        variance[:, i] = np.divide(noisy, weight, out=np.full(len(status), np.nan), where=weight > 0.0)
    predicted = np.sqrt(variance * reference.position_variance[:, [0, 1], [0, 1]])
    predicted[status != TrackStatus.OK] = np.nan
    return SubsetQuality(predicted, np.sqrt(variance.mean(axis=1)), status)


def radius_from_speckle_px(speckle_px: float) -> int:
    """Return the radius of a subset 4.2 to 5.25 speckles wide, in px.

    It is at least 7 and at most 25 px. It is as near to 10 px as possible. Fewer speckles do not determine affine map,
    gain and offset. With more speckles a rigid body gains no precision over smaller subsets together, and more of its
    rim stays uncovered. An unknown size (NaN) gives 10.
    """
    if not np.isfinite(speckle_px):
        return USUAL_RADIUS_PX
    smallest = ceil((FEWEST_SPECKLES * speckle_px - 1.0) / 2.0)
    largest = max(smallest, floor((MOST_SPECKLES * speckle_px - 1.0) / 2.0))
    radius = min(max(USUAL_RADIUS_PX, smallest), largest)
    return min(max(radius, SMALLEST_RADIUS_PX), LARGEST_RADIUS_PX)


def radius_from_image_px(image: Image) -> int:
    """Return the radius for the speckle size in the textured area of image (H, W)."""
    return radius_from_speckle_px(speckle_size(image, textured_area(image)))


@dataclass(frozen=True)
class AliasingBias:
    """Amplitude in px of the position error that is periodic in the pixel.

    The larger one of x and y. mean_px: of the mean of all subsets while their displacements are equal; subset_px: of
    one subset, rms.
    """

    mean_px: float
    subset_px: float


def aliasing_bias(image: Image, area: BoolArray, noise_grey: float, radius_px: int, degree: int = 5) -> AliasingBias:
    """Predict the periodic position error due to sampling and spline interpolation.

    It is that of subsets in `area` (H, W), NaN if `area` of `image` (H, W) is too small.

    Texture of frequency ν along x, shifted by u, is found by a spline at a pixel shifted by u as F(ν)·[1 + W·(e^{∓2πju}
    − 1)]: W(ν) = H(ν−1), H the frequency response of the cardinal spline (Unser 1999, IEEE Signal Process. Mag. 16(6),
    22), goes from 0 below Nyquist (images left by the spline) to 1 above it (aliases). The error e moves a subset by δ
    = Σ fₓe/Σ fₓ². With the spline's derivative D(ν) and the spectrum P, the mean over subsets is B·sin 2πu, B =
    ∫P·W·D/∫P·D² over 0 < ν < 1. Its parts below and above Nyquist have opposite signs; the larger one is used. A subset
    of n pixels adds the rms amplitude √(2∫∫P·D²·P·W²/n)/∫∫P·D².

    P beyond Nyquist is the aliased part of the periodogram under the law A·ν⁻²·sinc²ν·exp(−cν²): rims of dots, pixel
    aperture, lens blur, fitted from 0.25 cycles per pixel on. Noise is subtracted, at most the level at the corners of
    the two-dimensional spectrum.
    """
    check_shape("area", area, image.shape)
    power = _periodogram(image, area, TILE_PX // 2)
    if power is None:
        return AliasingBias(float("nan"), float("nan"))
    fine = np.abs(np.fft.fftfreq(TILE_PX)) > NOISE_CORNER_CYCLES
    floor_power = float(power[np.ix_(fine, fine)].mean())
    floor_power = min(floor_power, noise_grey**2) if np.isfinite(noise_grey) else floor_power
    pixels = ((2 * radius_px + 1) ** 2, degree)
    both = [_axis_bias(spectrum, floor_power, *pixels) for spectrum in (power, power.T)]
    return AliasingBias(max(mean for mean, _ in both), max(single for _, single in both))


def aliasing_notice(
    image: Image, area: BoolArray, noise_grey: float, speckle_px: float, bias: AliasingBias, where: str
) -> Notice | None:
    """Return a warning about speckle that the camera cannot resolve, None if it can.

    The limits are a speckle size of 3 px and a mean bias of 0.5 mpx. `speckle_px`, `bias`: the `speckle_size` and the
    `aliasing_bias` of image (H, W) in `area` (H, W).
    """
    if not (speckle_px < SMALLEST_SPECKLE_PX or bias.mean_px > MAX_MEAN_BIAS_PX):
        return None
    share = fine_texture_share(image, area, float(np.nan_to_num(noise_grey)))
    return Notice(
        UNRESOLVED_TEXTURE,
        where,
        speckle_px=speckle_px,
        share_percent=100 * share,
        subset_bias_px=bias.subset_px,
        mean_bias_px=bias.mean_px,
    )


def _periodogram(image: Image, area: BoolArray, step_px: int) -> FloatArray | None:
    """Return the mean power density (32, 32), in grey², of Hann-windowed tiles `step_px` apart.

    That of white noise is its variance.
    """
    half = TILE_PX // 2
    window = np.outer(np.hanning(TILE_PX + 1)[:-1], np.hanning(TILE_PX + 1)[:-1])
    centres = place_subsets(area, half, step_px).astype(np.int64)
    if len(centres) == 0:
        return None
    tiles = np.stack([image[y - half : y + half, x - half : x + half] for x, y in centres]).astype(np.float64)
    tiles -= np.mean(tiles * window, axis=(1, 2), keepdims=True) / window.mean()
    power = np.mean(np.abs(np.fft.rfft2(tiles * window)) ** 2, axis=0) / np.sum(window**2)
    other = np.roll(power[::-1], 1, axis=0)[:, half - 1 : 0 : -1]  # at frequencies of the other sign
    return np.concatenate([power, other], axis=1)


def _axis_bias(power: FloatArray, noise_power: float, pixels: int, degree: int) -> tuple[float, float]:
    """Return amplitudes of mean and single subset for a shift along the second axis."""
    clean = np.maximum(power - noise_power, 0.0)
    along = np.mean(power, axis=0)[: TILE_PX // 2 + 1] - noise_power
    frequency = np.arange(TILE_PX // 2 + 1) / TILE_PX
    aliased = _aliased_share(frequency, along, noise_power)
    replica, alias = _spline_response(frequency - 1.0, degree), _spline_response(-frequency, degree)
    # Slope of the spline through cos 2πνn at the pixels, relative to −sin 2πνn: Σ_k 2π(ν+k)·H(ν+k)
    terms = [2.0 * np.pi * (frequency + k) * _spline_response(frequency + k, degree) for k in range(-8, 9)]
    slope = np.asarray(np.sum(terms, axis=0))
    along = np.maximum(along, 0.0)
    count = np.where((frequency == 0.0) | (frequency == 0.5), 0.5, 1.0)  # of the bins that share a frequency
    total = np.sum(count * along * slope**2)
    if total <= 0.0:
        return float("nan"), float("nan")
    parts = np.array([np.sum(count * along * slope * w) for w in ((1.0 - aliased) * replica, aliased * alias)])
    mean = float(np.max(parts) / total)
    every = np.abs(np.rint(np.fft.fftfreq(TILE_PX) * TILE_PX)).astype(np.int64)
    error = ((1.0 - aliased) * replica**2 + aliased * alias**2)[every]
    steep = clean * slope[every] ** 2
    scattered = float(np.sqrt(2.0 * np.mean(steep * clean * error) / pixels) / np.mean(steep))
    return mean, float(np.hypot(mean, scattered))


def _aliased_share(frequency: FloatArray, along: FloatArray, noise_power: float) -> FloatArray:
    """Return the share of the power at each frequency that is aliased.

    Frequencies go up to 0.5. The share is zero below 0.25.
    """
    tail = frequency >= TAIL_START_CYCLES
    nu = frequency[tail]
    inside = np.exp(-np.multiply.outer(BLUR_DECAYS, nu**2)) * nu**-EDGE_POWER_EXPONENT * np.sinc(nu) ** 2
    beyond = (
        np.exp(-np.multiply.outer(BLUR_DECAYS, (1 - nu) ** 2)) * (1 - nu) ** -EDGE_POWER_EXPONENT * np.sinc(1 - nu) ** 2
    )
    weight = 1.0 / (PERIODOGRAM_REL_STD * np.maximum(along[tail], 0.0) + 0.05 * noise_power + 1e-9 * along.max()) ** 2
    model = inside + beyond
    height = np.maximum((model * weight) @ along[tail], 0.0) / np.sum(model**2 * weight, axis=1)
    misfit = np.sum(weight * (along[tail] - height[:, None] * model) ** 2, axis=1)
    best = int(np.argmin(misfit))
    share = np.zeros_like(frequency)
    share[tail] = beyond[best] / model[best]
    return share


def _spline_response(frequency: FloatArray, degree: int) -> FloatArray:
    """Return the frequency response sinc^(n+1)(ν)/Σ_k sinc^(n+1)(ν+k) of the spline of degree n."""
    power = degree + 1
    period: FloatArray = np.sum([np.sinc(frequency + k) ** power for k in range(-8, 9)], axis=0)
    return np.asarray(np.sinc(frequency) ** power / period)
