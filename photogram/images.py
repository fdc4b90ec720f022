"""Image sequences from disk at full bit depth: TIFF, PNG, Photron raw video."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import FloatArray, check_shape

GreyImage = NDArray[np.uint8 | np.uint16]
TIFF_SUFFIXES = (".tif", ".tiff")
VIDEO_SUFFIXES = (".cih", ".cihx")
PICTURE_BITS = (8, 10, 12, 14, 16)
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_COLOURS = {2: "colour", 3: "palette colour", 4: "grey with transparency", 6: "colour with transparency"}


@dataclass(frozen=True)
class ImageSequence:
    """Grey images of one size that are read one at a time: names (F), size_px (width, height), full_scale grey value.

    `reader` returns frame i as it stands in its file; `read` is the checked access to it.

    >>> images = ImageSequence(("dark", "bright"), (640, 480), 255, lambda k: np.full((480, 640), 100 * k, np.uint8))
    >>> len(images), int(images.read(1).max())
    (2, 100)
    """

    names: tuple[str, ...]
    size_px: tuple[int, int]
    full_scale: int
    reader: Callable[[int], GreyImage]

    def __len__(self) -> int:
        return len(self.names)

    def read(self, index: int) -> GreyImage:
        """Frame `index` as (H,W) uint8 or uint16 with every bit that the file has."""
        image = self.reader(index)
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
        return image


@dataclass(frozen=True)
class _Header:
    """What a file says about its images without decoding them: size, bits of a grey value, how many there are."""

    size_px: tuple[int, int]
    bits: int
    pages: int


def open_sequence(paths: Sequence[str | Path], bit_depth: int | None = None) -> ImageSequence:
    """Open grey images: TIFF or PNG files in the order given, one multi-page TIFF, or one .cih beside its .mraw.

    Headers are checked at once (format, colour, size, truncation), pixels when a frame is read. Without `bit_depth`
    the stored type counts: 8 bit → full scale 255, 16 bit → 65535, high-speed video → its header's bit depth.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     header = Path(folder, "run.cih")
    ...     _ = header.write_text(
    ...         "Total Frame : 2\\nImage Width : 16\\nImage Height : 8\\nColor Bit : 8\\nEffectiveBit Depth : 8\\n"
    ...     )
    ...     _ = header.with_suffix(".mraw").write_bytes(bytes(2 * 16 * 8))
    ...     len(open_sequence([str(header)]))
    2
    """
    if not paths:
        raise ValueError("paths: expected at least one image file, found none")
    files = tuple(Path(path) for path in paths)
    if len(files) == 1 and files[0].suffix.lower() in VIDEO_SUFFIXES:
        return _open_video(files[0], bit_depth)
    headers = [_read_header(path) for path in files]
    first = headers[0]
    full_scale = _full_scale(files[0], first.bits, bit_depth)
    for path, header in zip(files, headers, strict=True):
        if header.size_px != first.size_px:
            expected, actual = (f"{width} x {height}" for width, height in (first.size_px, header.size_px))
            raise ValueError(f"{path}: expected {expected} px, found {actual}")
        if header.bits != first.bits:
            raise ValueError(f"{path}: expected {first.bits} bits per pixel, found {header.bits}")
        if header.pages > 1 and len(files) > 1:
            raise ValueError(f"{path}: expected one image per file, found {header.pages} pages")
    if first.pages > 1:
        names = tuple(f"{files[0]}[{page}]" for page in range(first.pages))
        return ImageSequence(names, first.size_px, full_scale, partial(_read_tiff, files[0], first.bits))
    names = tuple(str(path) for path in files)
    return ImageSequence(names, first.size_px, full_scale, partial(_read_file, files, first.bits))


def read_picture(path: str | Path) -> tuple[GreyImage, int]:
    """Single picture (H,W) of any common format as grey values, and its full scale.

    Colours become their luminance. The full scale is that of the fewest bits among 8, 10, 12, 14, 16 that hold the
    brightest pixel, since files of 16 bit do not tell how many the camera has.

    >>> import cv2
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = cv2.imwrite(f"{folder}/grey.png", np.full((8, 16), 700, np.uint16))
    ...     image, full_scale = read_picture(f"{folder}/grey.png")
    >>> image.shape, full_scale
    ((8, 16), 1023)
    """
    import cv2

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE) if data.size else None
    if image is None:
        raise ValueError(f"{path}: not a readable picture")
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: expected 8 or 16 bits per pixel, found {image.dtype}")
    grey = cast(GreyImage, np.asarray(image))
    bits = next(b for b in PICTURE_BITS if int(grey.max()) < 2**b)
    return grey, 2**bits - 1


def saturated_fraction(image: GreyImage, full_scale: int) -> float:
    """Fraction of the pixels of `image` (H,W) that are at full scale."""
    return float(np.mean(image >= full_scale))


def _full_scale(path: Path, stored_bits: int, bit_depth: int | None) -> int:
    """Largest grey value of `bit_depth` bits (default: all stored bits)."""
    depth = stored_bits if bit_depth is None else bit_depth
    if not 1 <= depth <= stored_bits:
        raise ValueError(f"{path}: expected images of bit depth {bit_depth}, found {stored_bits} bits per pixel")
    return int(2**depth - 1)


def _read_header(path: Path) -> _Header:
    """Header of a TIFF or PNG file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if path.suffix.lower() in TIFF_SUFFIXES:
        return _tiff_header(path)
    if path.suffix.lower() == ".png":
        return _png_header(path)
    raise ValueError(f"{path}: expected a .tif, .tiff, .png, .cih or .cihx file, found {path.suffix or 'no suffix'}")


def _read_file(paths: tuple[Path, ...], bits: int, index: int) -> GreyImage:
    """The only image of TIFF or PNG file `index`."""
    import cv2

    path = paths[index]
    if path.suffix.lower() != ".png":
        return _read_tiff(path, bits, 0)
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path}: not a readable PNG file (its pixels cannot be decoded)")
    return cast(GreyImage, np.asarray(image))


def _tiff_header(path: Path) -> _Header:
    """Size, bits and pages of a TIFF file whose pixel data lie within the file."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            pages = [tiff.pages[0], *tiff.pages[1:]]
            length = tiff.filehandle.size
            ends = [int(end) for page in pages for end in np.add(page.dataoffsets, page.databytecounts)]
            shape, bits, colour = pages[0].shape, int(pages[0].bitspersample), pages[0].photometric
            same = all(page.shape == shape and page.bitspersample == bits for page in pages)
    except (ValueError, IndexError, KeyError, struct.error) as error:
        raise ValueError(f"{path}: not a readable TIFF file ({error})") from error
    if len(shape) != 2 or colour not in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.MINISWHITE):
        raise ValueError(f"{path}: expected a grey image, found {colour.name} of shape {shape}")
    if not same:
        raise ValueError(f"{path}: expected pages of one size and bit depth, found different ones")
    if bits not in (8, 12, 16) or pages[0].dtype.kind != "u":
        raise ValueError(f"{path}: expected 8, 12 or 16 bits per pixel, found {bits} ({pages[0].dtype})")
    if not ends or max(ends) > length:
        raise ValueError(f"{path}: truncated, expected {max(ends, default=0)} bytes, found {length}")
    return _Header((shape[1], shape[0]), bits, len(pages))


def _read_tiff(path: Path, bits: int, page: int) -> GreyImage:
    """One page of a TIFF file; OpenCV takes what tifffile cannot decode alone (LZW, packed 12 bit)."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            return np.asarray(tiff.pages[page].asarray())
    except (NotImplementedError, ImportError):
        return _read_tiff_opencv(path, bits, page)
    except (ValueError, zlib.error, IndexError) as error:
        if "imagecodecs" in str(error):
            return _read_tiff_opencv(path, bits, page)
        raise ValueError(f"{path}: not a readable TIFF file ({error})") from error


def _read_tiff_opencv(path: Path, bits: int, page: int) -> GreyImage:
    """One page of a TIFF file by OpenCV, which scales packed 12-bit values up to 16 bit: scaled back here."""
    import cv2

    data = np.fromfile(path, np.uint8)
    _, pages = cv2.imdecodemulti(data, cv2.IMREAD_UNCHANGED, range=(page, page + 1))
    if len(pages) != 1:
        raise ValueError(f"{path}: not a readable TIFF file (page {page} cannot be decoded)")
    image = cast(GreyImage, np.asarray(pages[0]))
    return image >> np.uint16(4) if bits == 12 else image


def _png_header(path: Path) -> _Header:
    """Size and bits of a PNG file that has its end mark."""
    with path.open("rb") as file:
        head = file.read(26)
        file.seek(max(0, path.stat().st_size - 64))
        tail = file.read()
    if len(head) < 26 or not head.startswith(PNG_SIGNATURE) or head[12:16] != b"IHDR":
        raise ValueError(f"{path}: not a readable PNG file")
    if b"IEND" not in tail:
        raise ValueError(f"{path}: truncated, the end mark of the PNG file is missing")
    width, height, bits, colour = struct.unpack(">IIBB", head[16:26])
    if colour != 0:
        raise ValueError(f"{path}: expected a grey image, found {PNG_COLOURS.get(colour, 'unknown colours')}")
    if bits not in (8, 16):
        raise ValueError(f"{path}: expected 8 or 16 bits per pixel, found {bits}")
    return _Header((width, height), bits, 1)


# High-speed video of Photron cameras: a header .cih or .cihx, and the frames in the .mraw beside it.

VIDEO_KEYS = {
    "Total Frame": "frameInfo/totalFrame",
    "Image Width": "imageDataInfo/resolution/width",
    "Image Height": "imageDataInfo/resolution/height",
    "Color Type": "imageDataInfo/colorInfo/type",
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
    "EffectiveBit Side": "imageDataInfo/effectiveBit/side",
    "File Format": "imageFileInfo/fileFormat",
}


def _open_video(header: Path, bit_depth: int | None) -> ImageSequence:
    """The frames that a header announces, all of which the .mraw beside it holds."""
    if not header.is_file():
        raise FileNotFoundError(f"{header}: no such file")
    entries = _video_entries(header)
    path = next((path for path in map(header.with_suffix, (".mraw", ".MRAW")) if path.is_file()), None)
    if path is None:
        raise FileNotFoundError(f"{header.with_suffix('.mraw')}: no such file beside {header.name}")

    def whole(key: str) -> int:
        text = entries.get(key, "nothing")
        if not text.isdigit() or int(text) < 1:
            raise ValueError(f"{header}: {key}: expected a positive whole number, found {text}")
        return int(text)

    stored_bits = whole("Color Bit")
    colour, layout = entries.get("Color Type", "Mono"), entries.get("File Format", "MRaw")
    if colour.lower() != "mono" or layout.lower() != "mraw":
        raise ValueError(f"{header}: expected monochrome MRaw frames, found {colour!r} and {layout!r}")
    if stored_bits not in (8, 12, 16):
        raise ValueError(f"{header}: Color Bit: expected 8, 12 or 16, found {stored_bits}")
    side = entries.get("EffectiveBit Side", "Lower").lower()
    if side not in ("lower", "higher"):
        raise ValueError(f"{header}: EffectiveBit Side: expected Lower or Higher, found {side!r}")
    frames, size_px = whole("Total Frame"), (whole("Image Width"), whole("Image Height"))
    bits = min(16, whole("EffectiveBit Depth")) if stored_bits == 16 else stored_bits
    expected, actual = frames * size_px[0] * size_px[1] * stored_bits // 8, path.stat().st_size
    if actual < expected:
        raise ValueError(f"{path}: truncated, expected {expected} bytes for {frames} frames, found {actual}")
    shift = 16 - bits if side == "higher" else 0
    names = tuple(f"{path}[{frame}]" for frame in range(frames))
    reader = partial(_read_mraw, path, size_px, stored_bits, shift)
    return ImageSequence(names, size_px, _full_scale(header, bits, bit_depth), reader)


def _video_entries(header: Path) -> dict[str, str]:
    """Entries by their .cih names: lines `key : value`, or in a .cihx the XML that stands between other lines."""
    text = header.read_text(encoding="utf-8", errors="replace")
    if header.suffix.lower() == ".cih":
        pairs = (line.partition(":") for line in text.splitlines() if ":" in line)
        return {key.strip(): value.strip() for key, _, value in pairs}
    start, end = text.find("<cih>"), text.rfind("</cih>")
    try:
        root = ElementTree.fromstring(text[start : end + len("</cih>")] if start >= 0 else "")
    except ElementTree.ParseError as error:
        raise ValueError(f"{header}: expected a <cih> element ({error})") from error
    entries = {key: root.findtext(place) for key, place in VIDEO_KEYS.items()}
    return {key: entry.strip() for key, entry in entries.items() if entry is not None}


def _read_mraw(path: Path, size_px: tuple[int, int], stored_bits: int, shift: int, index: int) -> GreyImage:
    """Frame `index` of 8, 12 or 16 stored bits per pixel; of 16 the grey value may stand `shift` bits higher."""
    width, height = size_px
    count = width * height * stored_bits // 8
    raw = np.fromfile(path, np.uint8, count=count, offset=index * count)
    if len(raw) < count:
        raise ValueError(f"{path}: frame {index} is cut off, expected {count} bytes, found {len(raw)}")
    if stored_bits == 8:
        return raw.reshape(height, width)
    if stored_bits == 16:
        return raw.view("<u2").astype(np.uint16).reshape(height, width) >> np.uint16(shift)
    # pairs of pixels are packed into three bytes, the most significant bits first
    first, middle, last = raw.reshape(-1, 3).astype(np.uint16).T
    return np.column_stack(((first << 4) | (middle >> 4), ((middle & 15) << 8) | last)).reshape(height, width)


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
    enlarged by F₁(9)/F₃(9) = 1.027 (Fₙ: distribution of χ² with n degrees of freedom, since ∫₀ᵗ x·f₁ = F₃(t)). The line
    through the bins has no negative coefficient and relative weights, taken from the line itself. A brightness range of
    less than 10 % of the brightest bin gives a constant. NaN pixels are left out.
    """
    from scipy.optimize import nnls

    check_shape("grey", grey, (None,))
    check_shape("residual_grey2", residual_grey2, (len(grey),))
    known = np.isfinite(grey) & np.isfinite(residual_grey2)
    if known.sum() < FEWEST_IN_BIN:
        raise ValueError(f"grey: expected at least {FEWEST_IN_BIN} finite pixels, found {known.sum()}")
    order = np.argsort(grey[known], kind="stable")
    parts = np.array_split(order, max(1, min(BINS, len(order) // FEWEST_IN_BIN)))
    brightness = np.array([grey[known][part].mean() for part in parts])
    variance = np.array([_robust_variance(residual_grey2[known][part]) for part in parts])
    count = np.array([float(len(part)) for part in parts])
    if np.ptp(brightness) < NARROW * np.abs(brightness).max():
        return NoiseModel(max(float(np.average(variance, weights=count)), QUANTISATION), 0.0)
    columns = np.column_stack([np.ones_like(brightness), np.maximum(brightness, 0.0)])
    solution, expected = np.zeros(2), np.full_like(variance, variance.mean())
    for _ in range(4):
        weight = np.sqrt(count) / np.maximum(expected, QUANTISATION)
        solution, _ = nnls(columns * weight[:, None], variance * weight)
        expected = columns @ solution
    return NoiseModel(float(solution[0]), float(solution[1]))


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
