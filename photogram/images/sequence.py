"""Series of grey images of one camera, with numbers, times and exposures."""

from __future__ import annotations

import hashlib
import math
import re
import stat
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from photogram.images.image_notices import COLUMNS_ALTERNATE, SENSOR_CLIPS
from photogram.images.rows import rows_repeat
from photogram.images.sensor_pattern import TYPICAL, SensorPattern
from shakercal._common.arrays import BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.notices import Notice

T = TypeVar("T")
MAX_DIGITS = 18  # of a number of 64 bits
NEAR = 0.25  # intervals by which time stamps may be wrong
SHOWN = 3  # missing numbers that are named
SEXAGESIMAL = (40, 4040)  # by which hhmmss grows from one minute, or hour, to the next beyond a second


@dataclass(frozen=True)
class FrameNumbers:
    """How the frames of a series are counted, from its first one on.

    Attributes
    ----------
    frame_index : (F,) 0, then how many frames later each one was, the missing ones counted.
    first, last : their numbers as written.
    step : increment of the numbers.
    missing : the missing numbers as text, "" for none.
    exact : whether a counter numbers the frames; False for times, which may stray.
    """

    frame_index: IntArray
    first: str
    last: str
    step: int = 1
    missing: str = ""
    exact: bool = True


def numbers_of_names(names: Sequence[str]) -> FrameNumbers | None:
    """Return how file names count their frames, None if no number in them does.

    The names differ in numbers alone. A counter ascends from file to file, in most cases by one step, in all cases by
    multiples of it. A number that ascends by nearly one step is a time. Of several counters the one with a gap is
    returned.

    >>> counted = numbers_of_names(["a0001.tif", "a0002.tif", "a0004.tif"])
    >>> counted.frame_index.tolist(), counted.missing
    ([0, 1, 3], '0003')
    """
    parts = [re.split(r"(\d+)", Path(name).name) for name in names]
    if len(names) < 3 or len({tuple(part[::2]) for part in parts}) != 1:
        return None
    columns = [column for column in zip(*(part[1::2] for part in parts), strict=True) if len(set(column)) > 1]
    found = [counted for column in columns if (counted := _counter(column)) is not None]
    if not found and len(columns) == 1:
        found = [counted for column in columns if (counted := _stamps(column)) is not None]
    return max(found, key=lambda counted: bool(counted.missing), default=None)


def _steps(texts: Sequence[str]) -> IntArray | None:
    """Return steps (F-1,) from number to number, None unless they ascend."""
    if max(map(len, texts)) > MAX_DIGITS:
        return None
    steps: IntArray = np.array([int(after) - int(before) for before, after in pairwise(texts)], dtype=np.int64)
    return steps if steps.min() > 0 else None


def _counter(texts: Sequence[str]) -> FrameNumbers | None:
    steps = _steps(texts)
    if steps is None:
        return None
    step = math.gcd(*steps.tolist())
    if 2 * np.count_nonzero(steps == step) < len(steps):
        return None
    missing = []
    for start, size in zip(texts[:-1], steps.tolist(), strict=True):
        between = range(int(start) + step, int(start) + size, step)
        if between:
            ends = dict.fromkeys(f"{number:0{len(start)}d}" for number in (between[0], between[-1]))
            missing.append(" to ".join(ends))
    frame_index = np.concatenate([[0], np.cumsum(steps // step)])
    return FrameNumbers(frame_index, texts[0], texts[-1], step, _listed(missing))


def _stamps(texts: Sequence[str]) -> FrameNumbers | None:
    """Count by a time in the name, also one written as hhmmss and decimals."""
    steps = _steps(texts)
    if steps is None:
        return None
    interval = float(np.median(steps))
    for jump in (base * 10**power for base in SEXAGESIMAL for power in range(MAX_DIGITS - 4)):
        steps = np.where(np.abs(steps - jump - interval) <= NEAR * interval, np.int64(interval), steps)
    return _counted_by_times(np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)]), 0.0, texts)


def numbers_of_times(time_s: FloatArray, resolution_s: float) -> FrameNumbers | None:
    """Return how frames at times (F,) are counted, None without a common interval.

    The times are rounded to a resolution.
    """
    if len(time_s) < 3 or np.diff(time_s).min() <= 0.0:
        return None
    return _counted_by_times(time_s, resolution_s, [f"{time:.6g} s" for time in time_s.tolist()])


def _counted_by_times(time: FloatArray, resolution: float, written: Sequence[str]) -> FrameNumbers | None:
    steps = np.diff(time)
    interval = float(np.median(steps))
    count = np.maximum(np.rint(steps / interval), 1.0)
    if interval <= resolution or np.any(np.abs(steps - count * interval) > NEAR * interval + resolution):
        return None
    missing = [
        f"{int(count[k]) - 1} between {written[k]} and {written[k + 1]}" for k in np.flatnonzero(count > 1.0).tolist()
    ]
    frame_index = np.concatenate([[0], np.cumsum(count.astype(np.int64))])
    return FrameNumbers(frame_index, written[0], written[-1], 1, _listed(missing), exact=False)


def _listed(missing: Sequence[str]) -> str:
    """Return the first missing numbers as text."""
    more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
    return ", ".join(missing[:SHOWN]) + more


GreyImage = NDArray[np.uint8 | np.uint16 | np.float32]
"""Grey values as stored, or as float32 without the fixed pattern of the sensor."""
MAX_PIXELS = 1 << 28  # of an image
GLIMPSE = 4096  # bytes of a frame as stored, enough to distinguish frames by their noise
FRAMES_AHEAD = 2  # that are read in advance


def check_file(path: Path) -> None:
    """Raise `FileNotFoundError` for a path that is no regular file.

    It is checked before the file is opened: a pipe would wait, and a device has no end.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:  # ValueError: a NUL in its name
        cause = "no such file" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", None) or error
        raise FileNotFoundError(f"{path}: {cause}".replace("\0", "\\0")) from error
    if not stat.S_ISREG(mode):
        found = "a folder" if stat.S_ISDIR(mode) else "a device or pipe"
        raise FileNotFoundError(f"{path}: no such file, found {found}")


@contextmanager
def wrap_read_errors(path: Path) -> Iterator[None]:
    """Turn every error of reading a file into `OSError` or `ValueError` with its path."""
    check_file(path)
    try:
        yield
    except MemoryError as error:
        raise ValueError(f"{path}: expected a file that fits into memory, found a larger one") from error
    except Exception as error:
        # The libraries raise errors of every kind for damaged files
        text = " ".join(str(error).split())
        if isinstance(error, OSError | ValueError) and text.startswith(str(path)) and type(error) is not OSError:
            raise
        cause = "its pixels cannot be decoded" if "OpenCV" in text else f"{type(error).__name__}: {text[:200]}"
        raise ValueError(f"{path}: not a readable {path.suffix[1:].upper()} file ({cause})") from error


def check_pixels(path: Path, size_px: tuple[int, int]) -> None:
    """Raise `ValueError` for an image without pixels or with more than any camera has."""
    if not (min(size_px) > 0 and size_px[0] * size_px[1] <= MAX_PIXELS):
        raise ValueError(f"{path}: expected at most {MAX_PIXELS} pixels, found {size_px[0]} x {size_px[1]}")


@dataclass(frozen=True)
class ImageHeader:
    """Properties of an image file that need no decoding.

    Attributes
    ----------
    size_px : width and height.
    bits : of a grey value.
    pages : number of images.
    lossy : whether compression changes grey values.
    orientation : TIFF or EXIF tag 274.
    inverted : whether 0 is white.
    stack_at : first byte of the images of a stack with one directory.
    pixels_at : first byte and number of bytes of some pixels of each image, from the end of the file if negative.
    """

    size_px: tuple[int, int]
    bits: int
    pages: int = 1
    lossy: bool = False
    orientation: int = 1
    inverted: bool = False
    stack_at: int | None = None
    pixels_at: tuple[tuple[int, int], ...] = ((-GLIMPSE, GLIMPSE),)


@dataclass(frozen=True)
class ImageSequence:
    """Grey images of one size that are read one at a time.

    Attributes
    ----------
    names : of the F frames.
    size_px : width and height.
    full_scale : largest possible grey value.
    reader : returns frame i as stored in its file; `read` is the checked access to it.
    time_s : (F,) times of the frames by the camera's clock, from the first one on; None if the files state none.
    exposure_s : exposure time; None if the files state none.
    notices : what the files do to the grey values.
    most_saturated : share of saturated pixels above which a frame is refused.
    numbers : the frames' numbers, which show where some are missing.
    glimpse : returns some bytes of a frame as stored.
    clips_at : grey value at which the sensor clips below full scale.
    pattern : the sensor's fixed pattern, or what a correction by `flat_field` leaves of it.
    flat_field : returns an image without the pattern, for its saturation; None for images as stored.

    Examples
    --------
    >>> images = ImageSequence(("dark", "bright"), (640, 480), 255, lambda k: np.full((480, 640), 100 * k, np.uint8))
    >>> len(images), int(images.read(1).max())
    (2, 100)
    """

    names: tuple[str, ...]
    size_px: tuple[int, int]
    full_scale: int
    reader: Callable[[int], GreyImage]
    time_s: FloatArray | None = None
    exposure_s: float | None = None
    notices: tuple[Notice, ...] = ()
    most_saturated: float = 1.0
    numbers: FrameNumbers | None = None
    glimpse: Callable[[int], bytes] | None = None
    clips_at: int | None = None
    pattern: SensorPattern = TYPICAL
    flat_field: Callable[[GreyImage, int], GreyImage] | None = None

    def __post_init__(self) -> None:
        if self.time_s is not None:
            check_shape("time_s", self.time_s, (len(self.names),))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def saturation(self) -> int:
        """Grey value above which pixels are saturated, itself included."""
        return self.full_scale if self.clips_at is None else self.clips_at

    def read(self, index: int) -> GreyImage:
        """Return frame `index` (H, W) with every bit, float32 after a correction."""
        image = self.reader(index)
        self.check(index, image)
        return self.without_pattern(image)

    def without_pattern(self, image: GreyImage) -> GreyImage:
        """Return an image as read from its file, corrected by `flat_field`."""
        return image if self.flat_field is None else self.flat_field(image, self.saturation)

    def check(self, index: int, image: GreyImage) -> None:
        """Raise `ValueError` for an image that frame `index` cannot be, or that is saturated."""
        name, (width, height) = self.names[index], self.size_px
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"{name}: expected a grey image of 8 or 16 bit, found {image.dtype} {image.shape}")
        if image.shape != (height, width):
            raise ValueError(f"{name}: expected {width} x {height} px, found {image.shape[1]} x {image.shape[0]}")
        brightest = int(image.max())
        if brightest > self.full_scale:
            bits = self.full_scale.bit_length()
            raise ValueError(
                f"{name}: expected grey values up to {self.full_scale} (bit depth {bits}), found {brightest}"
            )
        if brightest >= self.saturation and self.most_saturated < 1.0:
            share = np.count_nonzero(image >= self.saturation) / image.size
            if share > self.most_saturated:
                where = f"full scale {brightest}"
                if self.clips_at is not None:
                    where = f"{self.clips_at}, where the sensor clips (full scale is {self.full_scale})"
                found = f"{100 * share:.1f} % of its pixels at {where}"
                raise ValueError(f"{name}: expected an image that is not saturated, found {found}")

    def select(self, frames: IntArray) -> ImageSequence:
        """Return the frames of these numbers (F,), without their numbering.

        >>> images = ImageSequence(("a", "b", "c"), (4, 4), 255, lambda k: np.full((4, 4), k, np.uint8))
        >>> chosen = images.select(np.array([0, 2]))
        >>> chosen.names, int(chosen.read(1).max())
        (('a', 'c'), 2)
        """
        return replace(
            self,
            names=tuple(self.names[k] for k in frames.tolist()),
            reader=partial(_read_selected, self.reader, frames),
            time_s=None if self.time_s is None else self.time_s[frames],
            numbers=None,
            glimpse=None if self.glimpse is None else partial(_read_selected, self.glimpse, frames),
        )

    def read_ahead(self, frames: Iterable[int]) -> Iterator[GreyImage]:
        """Yield frames in turn; a thread reads the next ones in advance."""
        waiting: deque[Future[GreyImage]] = deque()
        with ThreadPoolExecutor(1) as reader:
            try:
                for number in frames:
                    waiting.append(reader.submit(self.read, number))
                    if len(waiting) > FRAMES_AHEAD:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                reader.shutdown(cancel_futures=True)


def _read_selected(read: Callable[[int], T], frames: IntArray, index: int) -> T:  # of this module, for pickles
    return read(int(frames[index]))


def find_copied_frames(images: ImageSequence) -> BoolArray:
    """Return which frames (F,) repeat every grey value of an earlier one.

    A frame grabber copied these, since noise never repeats. Only frames that share some bytes are read.

    >>> grey = [np.full((4, 4), level, np.uint8) for level in (1, 2, 2)]
    >>> images = ImageSequence(("a", "b", "c"), (4, 4), 255, lambda k: grey[k], glimpse=lambda k: b"")
    >>> find_copied_frames(images).tolist()
    [False, False, True]
    """
    copied, seen = np.zeros(len(images), dtype=np.bool_), set[bytes]()
    glimpses = [images.glimpse(number) for number in range(len(images))] if images.glimpse is not None else []
    often = {glimpse for glimpse, count in Counter(glimpses).items() if count > 1}
    for number in (number for number, glimpse in enumerate(glimpses) if glimpse in often):
        content = hashlib.sha256(images.read(number).tobytes()).digest()
        copied[number] = content in seen
        seen.add(content)
    return copied


def bytes_at(path: Path, start: int, size: int) -> bytes:
    """Return at most `GLIMPSE` bytes of a file from an offset.

    A negative offset counts from its end.
    """
    with wrap_read_errors(path), path.open("rb") as file:
        file.seek(start if start >= 0 else max(0, path.stat().st_size + start))
        return file.read(min(size, GLIMPSE))


def full_scale_of(path: Path, stored_bits: int, bit_depth: int | None) -> int:
    """Return the largest grey value of `bit_depth` bits, of all stored bits for None.

    Raises `ValueError` where more bits are given than stored.
    """
    depth = stored_bits if bit_depth is None else bit_depth
    if not 1 <= depth <= stored_bits:
        raise ValueError(f"{path}: expected images of bit depth {bit_depth}, found {stored_bits} bits per pixel")
    return int(2**depth - 1)


# Exposure of one image: dark, overexposed, clipped, or without a pattern.

TILE_PX = 32  # side of a tile: many speckles, and even lighting
MIN_TILE_PX = 8  # of small images
MIN_CORRELATION = 0.05
"""Of diagonal neighbours, measured: 0.25 for speckle of 2 px, 0 ± 0.005 for the noise of 200 x 200 px."""
DARK = 0.1  # brightest pixels over full scale, chosen
TAIL, PILE = 3, 1.5  # grey values below the largest one; its frequency over that of the most frequent of them
MIN_MOSAIC = 0.04  # difference of colours; amplifiers of even and odd columns differ by less
MAX_EXAMINED = 1 << 20  # pixels, for a difference of gain
MIN_ALTERNATION, SURE_SIGMA = 0.004, 5.0  # difference of gain; standard deviations of it
SHORTENED = 49.0
"""Shortening of small motions over the square of half the relative difference of gain of even and odd columns, at most.
Columns modulate the texture, which then has gradients near half a cycle per pixel. A spline of degree 7 has there 7
times the slope per frequency that it has near zero. In renderings: 11 for speckle of 3 px, 16 for 5 px, 28 for 8 px."""
MIN_CLIPPED = 2e-4  # share of the pixels
BRIGHT = 0.5  # share of the pixels at the largest grey value


def missing_pattern_reason(image: NDArray[Any], full_scale: int) -> str:
    """Return why an image (H, W) shows no body, "" if it does.

    The text begins with "dark", "overexposed", "uniform" or "a raw mosaic". In tiles of 32 x 32 px without mean and
    slopes, diagonal neighbours of a pattern correlate. Those of noise do not, nor does noise that rows or columns have
    in common. Tiles count by their contrast, so that a small body in front of an even background is a pattern.

    >>> rng = np.random.default_rng(1)
    >>> missing_pattern_reason(rng.poisson(20.0, (240, 320)), 1023)
    'dark, 99 % of its grey values are at most 31 of 1023, only noise is visible'
    """
    colours = mosaic_contrast(image)
    if colours:
        return f"a raw mosaic of a colour camera, whose pixels differ by {100.0 * colours:.2g} % in squares of 2 x 2"
    side = max(MIN_TILE_PX, min(TILE_PX, *image.shape))
    rows, columns = (length // side for length in image.shape)
    if rows * columns == 0:
        return ""
    covariance, variance = 0.0, 0.0
    for row in range(rows):  # a row of tiles at a time, which fits into the processor's cache
        band = image[row * side : (row + 1) * side, : columns * side].astype(np.float64)
        tiles = _levelled(band.reshape(side, columns, side).swapaxes(0, 1))
        first, second = tiles[:, :-1, :-1], tiles[:, 1:, 1:]
        covariance += float(np.sum(first * second))
        variance += float(np.sum(first**2))
    if covariance > MIN_CORRELATION * variance:
        return ""
    low, high = (int(value) for value in np.quantile(image, (0.01, 0.99)))
    brightest = int(image.max())
    if high < DARK * full_scale:
        return f"dark, 99 % of its grey values are at most {high} of {full_scale}, only noise is visible"
    share = float(np.mean(image == brightest))
    if share > BRIGHT:
        return f"overexposed, {100.0 * share:.3g} % of its pixels have the largest grey value {brightest}"
    return f"uniform, 98 % of its grey values are {low} to {high} of {full_scale}, only noise is visible"


def clip_level(image: NDArray[Any]) -> int | None:
    """Return the grey value at which the sensor clips, None if it does not.

    The grey values of an image (H, W) thin out towards the largest one. Clipped ones pile up there.

    >>> rng = np.random.default_rng(1)
    >>> grey = rng.normal(400.0, 50.0, (240, 320)).astype(np.uint16)
    >>> clip_level(grey), clip_level(np.minimum(grey, 500))
    (None, 500)
    """
    counts = np.bincount(image.ravel())
    counts = counts[counts > 0]  # shifted values skip codes
    if len(counts) <= TAIL or counts[-1] < MIN_CLIPPED * image.size:
        return None
    return int(image.max()) if counts[-1] > PILE * counts[-1 - TAIL : -1].max() else None


def mosaic_contrast(image: NDArray[Any]) -> float:
    """Return the relative difference of the pixels of a colour mosaic, 0 without one.

    In every square of 2 x 2 px, two pixels of a diagonal are equal (green), and at least one of the others is not.
    Amplifiers of single rows or columns make both diagonals differ.

    >>> grey = np.random.default_rng(1).normal(200.0, 5.0, (64, 64))
    >>> mosaic = grey * np.tile([[1.0, 0.6], [0.5, 1.0]], (32, 32))
    >>> mosaic_contrast(grey), round(mosaic_contrast(mosaic), 1)
    (0.0, 0.6)
    """
    rows, columns = (length // 2 * 2 for length in image.shape)
    if min(rows, columns) < 2:
        return 0.0
    level = [[float(image[row:rows:2, column:columns:2].mean()) for column in (0, 1)] for row in (0, 1)]
    mean = float(np.mean(level))
    if mean <= 0.0:
        return 0.0
    diagonals = ((level[0][0], level[1][1]), (level[0][1], level[1][0]))
    for green, others in (diagonals, diagonals[::-1]):
        equality, difference = (
            abs(green[0] - green[1]) / mean,
            max(abs(np.mean(green) - other) for other in others) / mean,
        )
        if difference > MIN_MOSAIC and equality < 0.2 * difference:
            return float(difference)
    return 0.0


def alternating_gain(image: NDArray[Any], axis: int) -> float:
    """Return the relative excess of gain of odd columns over even ones, 0 without one.

    Axis 1 is that of columns, 0 that of rows. Along the axis, a pixel g and its neighbours give ±(2g − g₋ − g₊)/4, half
    of the difference between even and odd ones, at the brightness (2g + g₋ + g₊)/4. The regression on brightness gives
    the difference of gain. A difference of offsets is constant. It does not change a motion, as a spline has no slope
    at the pixels there.

    >>> columns, rows = np.meshgrid(np.arange(128), np.arange(128))
    >>> grey = 400.0 + 200.0 * np.sin(0.5 * columns + 0.3 * rows)
    >>> alternating_gain(grey, 1), round(alternating_gain(grey * (1.0 + 0.02 * (columns % 2)), 1), 3)
    (0.0, 0.02)
    """
    lines = np.moveaxis(np.asarray(image), axis, 0)
    if len(lines) < 3 or lines.size < MIN_TILE_PX**2:
        return 0.0
    grey = lines[:, :: 1 + lines.size // MAX_EXAMINED].astype(np.float64)
    middle, around = 2.0 * grey[1:-1], grey[:-2] + grey[2:]
    sign = np.where(np.arange(1, len(grey) - 1) % 2 == 1, 1.0, -1.0)[:, None]
    half, level = 0.25 * sign * (middle - around), 0.25 * (middle + around)
    offset, level = float(half.mean()), level - level.mean()
    energy = float(np.sum(level**2))
    if energy <= 0.0:
        return 0.0
    slope = float(np.sum(half * level)) / energy
    left = half - offset - slope * level
    # Neighbouring values share pixels, which doubles the variance of the slope
    uncertainty = math.sqrt(2.0 * float(np.sum(left**2 * level**2))) / energy
    return 2.0 * slope if 2.0 * abs(slope) > max(MIN_ALTERNATION, 2.0 * SURE_SIGMA * uncertainty) else 0.0


@dataclass(frozen=True)
class AlternatingGains:
    """Correction of odd columns and rows by the relative excess of their gain."""

    columns: float
    rows: float

    def __call__(self, image: GreyImage, saturation: int) -> GreyImage:
        """Return an image (H, W) with equal gains, the same pixels of it saturated."""
        gain = [
            np.float32(1.0) + np.float32(excess) * (np.arange(2) - np.float32(0.5))
            for excess in (self.rows, self.columns)
        ]
        even = image / np.float32(1.0)
        for row in (0, 1):
            for column in (0, 1):
                even[row::2, column::2] /= gain[0][row] * gain[1][column]
        return keep_saturated(even, image, saturation)


def keep_saturated(even: NDArray[np.float32], image: GreyImage, saturation: int) -> NDArray[np.float32]:
    """Return corrected grey values of which the same are saturated as in the image."""
    bounded = np.where(image >= saturation, np.maximum(even, saturation), np.minimum(even, saturation - 1))
    return np.asarray(bounded, dtype=np.float32)


def inspect_first_image(images: ImageSequence, first: GreyImage) -> ImageSequence:
    """Return images with the clip level and the notices that their first image gives.

    Raises `ValueError` where more than `most_saturated` of the first image is saturated, or every other row repeats its
    neighbours.
    """
    level = clip_level(first)
    if level is not None and level < images.full_scale:
        share = 100.0 * np.count_nonzero(first == level) / first.size
        notice = Notice(
            SENSOR_CLIPS,
            images.names[0],
            clip_level=level,
            full_scale=images.full_scale,
            saturated_percent=share,
        )
        images = replace(images, clips_at=level, notices=(*images.notices, notice))
    images.check(0, first)
    if rows_repeat(first):
        found = "every other row equal to its neighbours or their mean, as of half the rows of an interlaced camera"
        raise ValueError(f"{images.names[0]}: expected rows that differ by noise, found {found}")
    gains = {lines: alternating_gain(first, axis) for lines, axis in (("columns", 1), ("rows", 0))}
    for lines, gain in gains.items():
        if gain:
            percent = {"gain_percent": 100.0 * abs(gain), "shortening_percent": 100.0 * SHORTENED * (0.5 * gain) ** 2}
            notice = Notice(COLUMNS_ALTERNATE, images.names[0], lines=lines, **percent)
            images = replace(images, notices=(*images.notices, notice), flat_field=AlternatingGains(**gains))
    return images


def _levelled(tiles: FloatArray) -> FloatArray:
    """Return tiles (N, S, S) without their mean and slopes."""
    ramp = np.arange(tiles.shape[1]) - 0.5 * (tiles.shape[1] - 1)
    left = tiles - tiles.mean(axis=(1, 2), keepdims=True)
    scale = 1.0 / (len(ramp) * np.sum(ramp**2))
    down, across = (scale * np.einsum(f"nij,{axis}->n", left, ramp) for axis in "ij")
    return np.asarray(left - down[:, None, None] * ramp[:, None] - across[:, None, None] * ramp)
