"""Grids of subsets: region of interest, image noise, predicted standard deviation, speckle size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import BoolArray, FloatArray, check_shape

# Image noise as a function of brightness: what the sensor reads with, and what the light itself brings.


QUANTISATION = 1.0 / 12.0  # variance of rounding to whole grey values
CUT = 9.0  # squared residuals beyond three standard deviations count as outliers
MEDIAN_CHI2 = 0.4549364231195724  # of χ² with one degree of freedom
BINS = 32
FEWEST_IN_BIN = 50
NARROW = 0.1  # brightness range, relative to the brightest, below which shot noise cannot be told from read noise
ROUNDS = 30


@dataclass(frozen=True)
class NoiseModel:
    """Noise variance of a pixel of grey value g: read_variance_grey2 + variance_per_grey·g, at least 1/12 (rounding).

    The photon transfer curve (Janesick 2007, Photon Transfer, SPIE, ch. 5; EMVA 1288 release 4.0, eq. 10): the first
    term is the noise of the dark sensor, quantisation included, the second is shot noise, 1/(electrons per grey value).
    """

    read_variance_grey2: float
    variance_per_grey: float

    def __post_init__(self) -> None:
        for name in ("read_variance_grey2", "variance_per_grey"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected a finite variance of 0 or more, found {getattr(self, name)}")

    def variance(self, grey: FloatArray | float) -> FloatArray:
        """Return the noise variance in grey² of pixels of any shape with grey values `grey`."""
        shot = self.variance_per_grey * np.maximum(grey, 0.0)
        return np.asarray(np.maximum(self.read_variance_grey2 + shot, QUANTISATION), dtype=np.float64)


def fit_noise_model(grey: FloatArray, residual_grey2: FloatArray) -> NoiseModel:
    """Noise model from pixels' brightness (M,) and squared residuals (M,), each χ² with one degree of freedom.

    Up to 32 bins of equal count along brightness. In a bin the variance s² is the mean of the residuals below 9·s²,
    enlarged by F₁(9)/F₃(9) = 1.027 (Fₙ: distribution of χ² with n degrees of freedom, since ∫₀ᵗ x·f₁ = F₃(t)): skewness
    costs nothing, outliers little. The line through the bins has no negative coefficient and relative weights, taken
    from the line itself, since bins that happen to be low would else pull it down. A brightness range of less than
    10 % of the brightest bin gives a constant. NaN pixels are left out.
    """
    check_shape("grey", grey, (None,))
    check_shape("residual_grey2", residual_grey2, (len(grey),))
    known = np.isfinite(grey) & np.isfinite(residual_grey2)
    if known.sum() < FEWEST_IN_BIN:
        raise ValueError(f"grey: expected at least {FEWEST_IN_BIN} finite pixels, found {known.sum()}")
    brightness, variance, count = _binned(grey[known], residual_grey2[known])
    if np.ptp(brightness) < NARROW * np.abs(brightness).max():
        return NoiseModel(max(float(np.average(variance, weights=count)), QUANTISATION), 0.0)
    return _line(np.maximum(brightness, 0.0), variance, count)


def noise_model_of_pair(first: NDArray[Any], second: NDArray[Any], full_scale: int) -> NoiseModel:
    """Noise model from two images (H,W) of the same scene at rest; pixels that are saturated or black are left out.

    Half the squared difference at the mean grey value (EMVA 1288 release 4.0, eq. 19), after the second image is scaled
    to the mean of the first, so that a flickering lamp does not count as noise; movement does.
    """
    check_shape("first", first, (None, None))
    check_shape("second", second, first.shape)
    inside = (np.minimum(first, second) > 0) & (np.maximum(first, second) < full_scale)
    if not inside.any():
        raise ValueError(f"first, second: expected grey values between 0 and {full_scale}, found none")
    left, right = first[inside].astype(np.float64), second[inside].astype(np.float64)
    right *= left.mean() / right.mean()
    return fit_noise_model(0.5 * (left + right), 0.5 * (left - right) ** 2)


def _binned(grey: FloatArray, squares: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean brightness, robust variance and count of bins of equal count."""
    order = np.argsort(grey, kind="stable")
    bins = max(1, min(BINS, len(grey) // FEWEST_IN_BIN))
    parts = np.array_split(order, bins)
    brightness = np.array([grey[part].mean() for part in parts])
    variance = np.array([_robust_variance(squares[part]) for part in parts])
    return brightness, variance, np.array([float(len(part)) for part in parts])


def _robust_variance(squares: FloatArray) -> float:
    """Mean of squares of normal deviates, those beyond three standard deviations left out and made up for."""
    from scipy.special import gammainc

    enlarged = float(gammainc(0.5, CUT / 2.0) / gammainc(1.5, CUT / 2.0))
    variance = float(np.median(squares)) / MEDIAN_CHI2
    for _ in range(ROUNDS):
        kept = squares[squares <= CUT * variance]
        before, variance = variance, enlarged * float(kept.mean())
        if abs(variance - before) <= 1e-6 * before:
            break
    return variance


def _line(brightness: FloatArray, variance: FloatArray, count: FloatArray) -> NoiseModel:
    """Line with coefficients of 0 or more through the bins' variances, weighted by the line's own values."""
    from scipy.optimize import nnls

    expected = np.full_like(variance, variance.mean())
    columns = np.column_stack([np.ones_like(brightness), brightness])
    solution = np.zeros(2)
    for _ in range(4):
        weight = np.sqrt(count) / np.maximum(expected, QUANTISATION)
        solution, _ = nnls(columns * weight[:, None], variance * weight)
        expected = columns @ solution
    return NoiseModel(float(solution[0]), float(solution[1]))


# Where subsets are laid, and what an image can tell: textured area, grid, speckle size, texture beyond the pixels.


Image = NDArray[Any]
COARSE_WINDOW_PX = 9
FINE_WINDOW_PX = 5
RIM_PX = 6
CLEAR_SEPARATION = 3.0
SMALLEST_SHARE = 0.2
TILE_PX = 32
FINE_TEXTURE = 0.4
SATURATED_SHARE = 0.01


def textured_area(image: Image) -> BoolArray:
    """Pixels (H,W) of the speckled body: background without texture and the body's rim are left out.

    The local standard deviation (9 x 9 px) is split by Otsu's threshold on its logarithm (Otsu 1979, IEEE Trans. Syst.
    Man Cybern. 9, 62) and holes are closed. The same with a window of 5 x 5 px, which large speckle would tear, draws
    the outline within the last 9 px; 6 px are taken off it: 2 for the window's reach, 4 for the blurred rim. An image
    whose two classes differ by less than a factor of 3 is textured everywhere.
    """
    check_shape("image", image, (None, None))
    coarse = _textured(image, COARSE_WINDOW_PX)
    if coarse is None:
        return np.ones(image.shape, dtype=np.bool_)
    body = _opened(_closed(coarse, COARSE_WINDOW_PX), COARSE_WINDOW_PX)
    fine = _textured(image, FINE_WINDOW_PX)
    if fine is not None:
        core = _shrunk(np.pad(body, 1), COARSE_WINDOW_PX)[1:-1, 1:-1]
        body = _opened(core | (body & _closed(fine, FINE_WINDOW_PX)), COARSE_WINDOW_PX)
    return _large_parts(_shrunk(body, RIM_PX))


def lay_grid(area: BoolArray, radius_px: int, step_px: int) -> FloatArray:
    """Centres (N,2) of square subsets that lie wholly in `area` (H,W), as many as rows of subsets can hold.

    In each row subsets are set from left to right at least `step_px` apart; the heights of the rows, as far apart, are
    those with the largest total (dynamic programming), so that round bodies are covered to their edge.
    """
    import cv2

    check_shape("area", area, (None, None))
    if radius_px < 1 or step_px < 1:
        raise ValueError(f"radius_px, step_px: expected at least 1, found {radius_px} and {step_px}")
    side = 2 * radius_px + 1
    square = np.ones((side, side), np.uint8)
    possible = cv2.erode(area.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,)) > 0
    columns = [_packed(np.flatnonzero(line), step_px) for line in possible]
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


def subsets_inside(area: BoolArray, points_px: FloatArray, radius_px: int, share: float) -> BoolArray:
    """Whether at least `share` of every subset's pixels around points_px (N,2) lie in `area` (H,W)."""
    return subset_mean(area, points_px, radius_px) >= share


def subset_mean(values: Image, points_px: FloatArray, radius_px: int) -> FloatArray:
    """Mean (N,) of values (H,W) over the subsets around points_px (N,2), rounded to pixels; beyond the image 0."""
    height, width = values.shape
    sums = np.zeros((height + 1, width + 1))
    sums[1:, 1:] = np.cumsum(np.cumsum(values, axis=0, dtype=np.float64), axis=1)
    centre = np.rint(np.nan_to_num(points_px, nan=-1e6)).astype(np.int64)
    left, right = np.clip(centre[:, 0] - radius_px, 0, width), np.clip(centre[:, 0] + radius_px + 1, 0, width)
    top, bottom = np.clip(centre[:, 1] - radius_px, 0, height), np.clip(centre[:, 1] + radius_px + 1, 0, height)
    total = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    mean: FloatArray = total / (2 * radius_px + 1) ** 2
    return mean


def saturated(image: Image, full_scale: int, points_px: FloatArray, radius_px: int) -> BoolArray:
    """Which subsets around points_px (N,2) have more than 1 % of their pixels at full scale."""
    if image.max() < full_scale:
        return np.zeros(len(points_px), dtype=np.bool_)
    return np.asarray(subset_mean(image >= full_scale, points_px, radius_px) > SATURATED_SHARE)


def speckle_size(image: Image, area: BoolArray) -> float:
    """Speckle size in px: full width at half maximum of the texture's autocorrelation inside `area` (H,W).

    The value at lag 0, raised by noise, is replaced by the Gaussian through lags 1 and 2 where that is lower; between
    lags, too, the logarithm is taken as linear in the squared lag.
    """
    check_shape("area", area, image.shape)
    lags = _autocorrelation(image.astype(np.float64), area)
    peak = lags[0]
    if lags[1] > 0.0 and lags[2] > 0.0:
        peak = min(peak, lags[1] * (lags[1] / lags[2]) ** (1.0 / 3.0))
    below = np.flatnonzero(lags[1:] < 0.5 * peak)
    if peak <= 0.0 or len(below) == 0:
        return float("nan")
    after = int(below[0]) + 1
    before = peak if after == 1 else lags[after - 1]
    if lags[after] <= 0.0:
        return float(2.0 * (after - 1 + (before - 0.5 * peak) / (before - lags[after])))
    part = np.log(2.0 * before / peak) / np.log(before / lags[after])
    return float(2.0 * np.sqrt((after - 1) ** 2 + part * (2 * after - 1)))


def fine_texture_share(image: Image, area: BoolArray, noise_grey: float) -> float:
    """Share of the texture's power beyond 0.4 cycles per pixel in x or y, noise taken off; 0 where all is resolved.

    Mean periodogram of Hann-windowed tiles of 32 x 32 px in `area`. Texture that still has power next to the Nyquist
    frequency has some beyond it too, folded back: it moves unlike the body and makes errors periodic in the pixel.
    """
    window = np.outer(np.hanning(TILE_PX + 1)[:-1], np.hanning(TILE_PX + 1)[:-1])
    centres = lay_grid(area, TILE_PX // 2, TILE_PX).astype(np.int64)
    if len(centres) == 0:
        return float("nan")
    half = TILE_PX // 2
    tiles = np.stack([image[y - half : y + half, x - half : x + half] for x, y in centres]).astype(np.float64)
    tiles -= np.mean(tiles * window, axis=(1, 2), keepdims=True) / window.mean()
    power = np.mean(np.abs(np.fft.fft2(tiles * window)) ** 2, axis=0) - noise_grey**2 * np.sum(window**2)
    frequency = np.abs(np.fft.fftfreq(TILE_PX))
    fine = np.maximum.outer(frequency, frequency) > FINE_TEXTURE
    return float(max(0.0, power[fine].sum()) / power.sum()) if power.sum() > 0.0 else float("nan")


def _textured(image: Image, window_px: int) -> BoolArray | None:
    """Pixels of high local contrast; None where contrast does not fall into two classes."""
    from skimage.filters import threshold_otsu

    contrast = np.log(_local_contrast(image.astype(np.float64), window_px) + 1e-3 * (1.0 + float(np.std(image))))
    textured: BoolArray = contrast > threshold_otsu(contrast)
    if textured.all() or not textured.any():
        return None
    if contrast[textured].mean() - contrast[~textured].mean() < np.log(CLEAR_SEPARATION):
        return None
    return textured


def _local_contrast(image: FloatArray, window_px: int) -> FloatArray:
    """Standard deviation in a window around every pixel."""
    from scipy import ndimage

    centred = image - image.mean()
    mean = ndimage.uniform_filter(centred, window_px, mode="reflect")
    square = ndimage.uniform_filter(centred**2, window_px, mode="reflect")
    contrast: FloatArray = np.sqrt(np.maximum(square - mean**2, 0.0))
    return contrast


def _closed(mask: BoolArray, radius_px: int) -> BoolArray:
    """The mask with gaps and holes filled; what lies beyond the image is empty, so that no wedge is filled there."""
    import cv2
    from scipy import ndimage

    framed = np.pad(mask, 2 * radius_px).astype(np.uint8)
    closed = ndimage.binary_fill_holes(cv2.morphologyEx(framed, cv2.MORPH_CLOSE, _ball(radius_px)))
    return np.asarray(closed[2 * radius_px : -2 * radius_px, 2 * radius_px : -2 * radius_px], dtype=np.bool_)


def _opened(mask: BoolArray, radius_px: int) -> BoolArray:
    """The mask without parts narrower than a disc."""
    import cv2

    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _ball(radius_px)) > 0)


def _shrunk(mask: BoolArray, radius_px: int) -> BoolArray:
    """Pixels at least `radius_px` from the mask's outline; the image's border is no outline."""
    import cv2

    return np.asarray(cv2.erode(mask.astype(np.uint8), _ball(radius_px)) > 0)


def _ball(radius_px: int) -> NDArray[np.uint8]:
    """A disc as structuring element."""
    import cv2

    size = 2 * radius_px + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def _large_parts(mask: BoolArray) -> BoolArray:
    """The connected parts that have at least a fifth of the largest one's pixels."""
    from scipy import ndimage

    labels, count = ndimage.label(mask)
    if count == 0:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    kept: BoolArray = (sizes >= SMALLEST_SHARE * sizes.max())[labels] & mask
    return kept


def _packed(columns: NDArray[np.int64], step: int) -> list[int]:
    """As many of the possible columns as fit, at least `step` apart, from left to right; runs are centred."""
    chosen: list[int] = []
    for run in np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1):
        if len(run) == 0:
            continue
        first = max(int(run[0]), chosen[-1] + step) if chosen else int(run[0])
        if first > run[-1]:
            continue
        spare = (int(run[-1]) - first) % step
        chosen.extend(range(first + spare // 2, int(run[-1]) + 1, step))
    return chosen


def _autocorrelation(image: FloatArray, area: BoolArray) -> FloatArray:
    """Mean autocovariance along x and y of the grey values in the area at lags 0, 1, 2 … 31."""
    background, weight = _spread(np.where(area, image, 0.0)), _spread(area.astype(np.float64))
    texture = np.where(area, image - background / np.maximum(weight, 1e-9), 0.0)
    count = min(TILE_PX, min(image.shape) // 2)
    products, pairs = _lagged_products(texture, count), _lagged_products(area.astype(np.float64), count)
    lags: FloatArray = products / np.maximum(1.0, np.rint(pairs))
    return lags


def _lagged_products(values: FloatArray, count: int) -> FloatArray:
    """Σ v(x)·v(x+lag) over rows and columns for lags 0 … count − 1, from the power spectra of zero-padded lines."""
    from scipy import fft

    total = np.zeros(count)
    for axis, length in enumerate(values.shape):
        padded = fft.next_fast_len(length + count, real=True)
        power = np.abs(fft.rfft(values, padded, axis=axis)) ** 2
        total += fft.irfft(power.sum(axis=1 - axis), padded)[:count]
    return total


def _spread(values: FloatArray) -> FloatArray:
    """Values blurred as by a Gaussian of σ = 32 px: three box means (Wells 1986, IEEE Trans. PAMI 8, 234)."""
    from scipy import ndimage

    for _ in range(3):
        values = ndimage.uniform_filter(values, 2 * TILE_PX + 1, mode="reflect")
    return values
