"""Correction of a camera's images by dark and flat images (EMVA 1288)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photogram.images.sensor_pattern import TYPICAL, SensorPattern
from photogram.images.sequence import GreyImage, ImageSequence
from shakercal._common.arrays import Arrays, FloatArray, check_shape

SMOOTH_SHARE = 1 / 16  # of the image width, the σ beyond which differences of a flat image are lighting, not pattern
FEWEST_IMAGES = 2  # whose differences show the noise of their mean
MOST_SATURATED = 1e-3  # share of the pixels of a flat image
LARGEST_CONTRAST = 0.1  # rms of a flat image's pattern; dust and the worst sensors have less
SAME_EXPOSURE = 0.01  # relative difference of dark images' exposures, chosen


@dataclass(frozen=True, eq=False, repr=False)
class FlatField(Arrays, shapes="dark H W; gain H W"):
    """Correction of a camera's images by the dark values and gains of its pixels.

    Attributes
    ----------
    dark : (H, W) dark grey values.
    gain : (H, W) relative to the pixels around; lighting and vignetting remain in the images.
    remaining : the pattern that the noise of the dark and flat images leaves.

    Examples
    --------
    >>> field = FlatField(np.full((2, 2), 10.0, np.float32), np.array([[1, 1], [1, 2]], np.float32), TYPICAL)
    >>> field.correct(np.array([[30, 30], [30, 50]], np.uint8), 255).tolist()
    [[30.0, 30.0], [30.0, 30.0]]
    """

    dark: NDArray[np.float32]
    gain: NDArray[np.float32]
    remaining: SensorPattern

    def correct(self, image: GreyImage, saturation: int) -> NDArray[np.float32]:
        """Return an image (H, W) without the pattern, the same pixels of it saturated."""
        level = np.float32(self.dark.mean(dtype=np.float64))
        even = (image - self.dark) / self.gain + level
        full = image >= saturation
        bounded = np.where(full, np.maximum(even, saturation), np.minimum(even, saturation - 1))
        return np.asarray(bounded, dtype=np.float32)


def flat_field(images: ImageSequence, dark: ImageSequence | None, flat: ImageSequence | None) -> FlatField:
    """Return the correction of `images` by dark and flat images.

    Dark are those with the lens covered, flat those of an even, unsharp surface. The mean of each series is used. Their
    scatter gives the noise that remains in it.

    Raises
    ------
    ValueError
        Dark or flat images that do not belong to these images: another size, bit depth or exposure, saturated,
        not even, or dark images that are as bright as the others.
    """
    first, (width, height) = images.read(0).astype(np.float64), images.size_px
    level, noise2 = np.zeros((height, width)), 0.0
    if dark is not None:
        level, noise2 = _mean_image(dark, images)
        _check_exposure(dark, images)
        if level.mean() >= first.mean():
            found = f"a mean grey value of {level.mean():.4g} beside {first.mean():.4g} in {images.names[0]}"
            raise ValueError(f"{dark.names[0]}: expected dark images, with the lens covered, found {found}")
    gain, gain_noise2 = np.ones((height, width)), 0.0
    if flat is not None:
        bright, flat_noise2 = _mean_image(flat, images)
        lit = bright - level
        smooth = ndimage.gaussian_filter(lit, SMOOTH_SHARE * width, mode="nearest")
        if smooth.min() <= 0.0:
            raise ValueError(f"{flat.names[0]}: expected flat images brighter than the dark ones, found none")
        gain = lit / smooth
        contrast = float(gain.std())
        if contrast > LARGEST_CONTRAST:
            found = f"grey values that scatter by {100.0 * contrast:.2g} % within small areas"
            raise ValueError(f"{flat.names[0]}: expected images of an even, unsharp surface, found {found}")
        gain = np.maximum(gain, LARGEST_CONTRAST)
        gain_noise2 = (flat_noise2 + noise2) / float(np.mean(smooth)) ** 2
    remaining = _remaining(images.full_scale, dark is not None, flat is not None, noise2, gain_noise2)
    return FlatField(level.astype(np.float32), gain.astype(np.float32), remaining)


def _remaining(full_scale: int, dark: bool, flat: bool, noise2: float, gain_noise2: float) -> SensorPattern:
    """Return the pattern that remains after a correction by dark or flat images or both."""
    share = float(np.sqrt(gain_noise2))
    left = TYPICAL if not flat else replace(TYPICAL, prnu=share, lines=share, shadows=share, variance_uncertainty=1.0)
    return replace(left, dsnu=float(np.sqrt(noise2)) / full_scale if dark else TYPICAL.dsnu, known=True)


def corrected_sequence(images: ImageSequence, field: FlatField) -> ImageSequence:
    """Return images that are read without their fixed pattern."""
    check_shape("dark", field.dark, images.size_px[::-1])
    return replace(images, flat_field=field.correct, pattern=field.remaining)


def _mean_image(series: ImageSequence, images: ImageSequence) -> tuple[FloatArray, float]:
    """Return the mean (H, W) of dark or flat images, and its noise variance."""
    if series.size_px != images.size_px:
        found = f"{series.size_px[0]} x {series.size_px[1]} px"
        raise ValueError(f"{series.names[0]}: expected {images.size_px[0]} x {images.size_px[1]} px, found {found}")
    if series.full_scale != images.full_scale:
        depth = images.full_scale.bit_length()
        raise ValueError(f"{series.names[0]}: expected a bit depth of {depth}, found {series.full_scale.bit_length()}")
    if len(series) < FEWEST_IMAGES:
        expected = f"at least {FEWEST_IMAGES} images, whose differences show their noise"
        raise ValueError(f"{series.names[0]}: expected {expected}, found {len(series)}")
    total, square = np.zeros(images.size_px[::-1]), 0.0
    for number in range(len(series)):
        image = series.read(number)
        saturated = float(np.mean(image >= series.full_scale))
        if saturated > MOST_SATURATED:
            found = f"{100.0 * saturated:.1f} % of its pixels at full scale"
            raise ValueError(f"{series.names[number]}: expected an image that is not saturated, found {found}")
        total += image
        square += float(np.mean(image.astype(np.float64) ** 2))
    mean = total / len(series)
    scatter2 = (square - len(series) * float(np.mean(mean**2))) / (len(series) - 1)
    return mean, max(scatter2, 0.0) / len(series)


def _check_exposure(dark: ImageSequence, images: ImageSequence) -> None:
    """Refuse dark images of another exposure, as far as the files state them."""
    of_dark, of_images = dark.exposure_s, images.exposure_s
    if of_dark is None or of_images is None or abs(of_dark - of_images) <= SAME_EXPOSURE * of_images:
        return
    expected, found = f"an exposure of {1e6 * of_images:g} µs", f"{1e6 * of_dark:g} µs"
    raise ValueError(f"{dark.names[0]}: expected {expected} as of {images.names[0]}, found {found}")
