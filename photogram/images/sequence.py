"""Series of grey images of one camera, with times and exposures."""

from __future__ import annotations

import hashlib
import stat
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photogram.images.numbering import FrameNumbers
from shakercal._common.arrays import BoolArray, FloatArray, check_shape
from shakercal._common.notices import Notice

GreyImage = NDArray[np.uint8 | np.uint16]
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
        """Return frame `index` (H, W) as uint8 or uint16 with every bit of the file."""
        image = self.reader(index)
        self.check(index, image)
        return image

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
