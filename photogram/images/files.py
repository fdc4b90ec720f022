"""Image series from disk at full bit depth: pictures one file each, pages of one TIFF file, video files."""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from photogram.arrays import Notice
from photogram.images.sequence import (
    GreyImage,
    ImageSequence,
    check_pixels,
    full_scale_of,
    reading,
)
from photogram.images.video import VIDEO_READERS

try:
    from isal import isal_zlib  # inflates in half the time of zlib
except ImportError:  # a processor that it is not built for
    deflate: Any = zlib
else:
    deflate = isal_zlib

TIFF_SUFFIXES = (".tif", ".tiff")
SUFFIXES = (*TIFF_SUFFIXES, ".png", ".bmp", *VIDEO_READERS)
TIFF_CODES = ("NONE", "LZW", "ADOBE_DEFLATE", "DEFLATE", "PACKBITS", "JPEG", "OJPEG", "WEBP")
READ_AT_ONCE = 1 << 28  # bytes of a file
PICTURE_BITS = (8, 10, 12, 14, 16)
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_TAIL = 64  # last bytes among which the end mark is looked for
PNG_COLOURS = {2: "colour", 3: "palette colour", 4: "grey with transparency", 6: "colour with transparency"}


@dataclass(frozen=True)
class _Header:
    """What a file says about its images without decoding them: size, bits of a grey value, how many, how compressed."""

    size_px: tuple[int, int]
    bits: int
    pages: int = 1
    lossy: bool = False


def open_sequence(paths: Sequence[str | Path], bit_depth: int | None = None) -> ImageSequence:
    """Open grey images: TIFF, PNG or BMP files in the order given, one multi-page TIFF, or one video file.

    Video: Phantom .cine, Photron .cih or .cihx beside its .mraw, and .avi .mp4 .mov .mkv with a warning of what
    compression does. Headers are checked at once (format, colour, size, truncation), pixels when a frame is read.
    Without `bit_depth` the stored type counts: 8 bit → full scale 255, 16 bit → 65535, cameras' video → its header's
    bit depth.

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
    opener = VIDEO_READERS.get(files[0].suffix.lower())
    if opener is not None and len(files) == 1:
        with reading(files[0]):
            return opener(files[0], bit_depth)
    headers = [_read_header(path) for path in files]
    first = headers[0]
    full_scale = full_scale_of(files[0], first.bits, bit_depth)
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
        reader = partial(_read_tiff, files[0], first.bits)
    else:
        names, reader = tuple(str(path) for path in files), partial(_read_file, files, first.bits)
    lossy = next((path for path, header in zip(files, headers, strict=True) if header.lossy), None)
    told = (
        f"{first.pages if first.pages > 1 else len(files)} pictures with lossy compression, which changes grey values"
    )
    notices = () if lossy is None else (Notice("warning", f"{told}; such errors are in no uncertainty", str(lossy)),)
    return ImageSequence(names, first.size_px, full_scale, reader, notices=notices)


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
    with reading(path):
        data = np.fromfile(path, np.uint8)
        if data[: len(PNG_SIGNATURE)].tobytes() == PNG_SIGNATURE:  # whose library writes to the terminal of its own
            _refuse_truncated_png(path, data[-PNG_TAIL:].tobytes())
        image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE) if data.size else None
    if image is None:
        raise ValueError(f"{path}: not a readable picture")
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: expected 8 or 16 bits per pixel, found {image.dtype}")
    grey = cast(GreyImage, np.asarray(image))
    bits = next(b for b in PICTURE_BITS if int(grey.max()) < 2**b)
    return grey, 2**bits - 1


def _read_header(path: Path) -> _Header:
    """Header of a file that is one picture, or of a TIFF file."""
    reader = {".tif": _tiff_header, ".tiff": _tiff_header, ".png": _png_header, ".bmp": _bmp_header}
    if path.suffix.lower() in VIDEO_READERS:
        raise ValueError(f"{path}: expected one video file for a camera, found several files")
    if path.suffix.lower() not in reader:
        raise ValueError(f"{path}: expected a file of type {' '.join(SUFFIXES)}, found {path.suffix or 'no suffix'}")
    with reading(path):
        header = reader[path.suffix.lower()](path)
        check_pixels(path, header.size_px)
        return header


def _read_file(paths: tuple[Path, ...], bits: int, index: int) -> GreyImage:
    """The only image of file `index`."""
    path = paths[index]
    if path.suffix.lower() in TIFF_SUFFIXES:
        return _read_tiff(path, bits)
    import cv2

    with reading(path):
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        kind = path.suffix[1:].upper()
        raise ValueError(f"{path}: not a readable {kind} file (its pixels cannot be decoded)")
    return cast(GreyImage, np.asarray(image))


def _tiff_header(path: Path) -> _Header:
    """Size, bits and pages of a TIFF file whose pixel data lie within the file."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            pages = [tiff.pages[0], *tiff.pages[1:]]
            length = tiff.filehandle.size
            stored = [_stored(page) for page in pages]
            shape, bits, colour = pages[0].shape, int(pages[0].bitspersample), pages[0].photometric
            same = all(page.shape == shape and page.bitspersample == bits for page in pages)
            lossy = any("JPEG" in page.compression.name or page.compression.name == "WEBP" for page in pages)
            wrong = next((page.compression.name for page in pages if page.compression.name not in TIFF_CODES), None)
    except (ValueError, IndexError, KeyError, struct.error) as error:
        raise ValueError(f"{path}: not a readable TIFF file ({error})") from error
    if len(shape) != 2 or colour not in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.MINISWHITE):
        raise ValueError(f"{path}: expected a grey image, found {colour.name} of shape {shape}")
    if not same:
        raise ValueError(f"{path}: expected pages of one size and bit depth, found different ones")
    if bits not in (8, 12, 16) or pages[0].dtype.kind != "u":
        raise ValueError(f"{path}: expected 8, 12 or 16 bits per pixel, found {bits} ({pages[0].dtype})")
    if wrong is not None:
        raise ValueError(f"{path}: expected no compression, LZW, deflate or JPEG, found {wrong}")
    needed = max(end for end, _ in stored)
    if needed > length:
        raise ValueError(f"{path}: truncated, expected {needed} bytes, found {length}")
    least = shape[0] * (shape[1] * bits // 8)
    if pages[0].compression.name == "NONE" and min(size for _, size in stored) < least:
        found = min(size for _, size in stored)
        raise ValueError(f"{path}: expected {least} bytes of {shape[1]} x {shape[0]} pixels, found {found}")
    return _Header((shape[1], shape[0]), bits, len(pages), lossy)


def _stored(page: Any) -> tuple[int, int]:
    """Return where the pixels of a page of a TIFF file end, and their number of bytes."""
    ends = np.add(page.dataoffsets, page.databytecounts)
    return max((int(end) for end in ends), default=1 << 62), sum(int(count) for count in page.databytecounts)


def _inflated(path: Path, tiff: Any, page: Any) -> GreyImage | None:
    """Return a page whose strips are deflated as they are, None where tifffile has more to undo than that.

    Parts that are not as long as their pixels need are refused, before they fill the memory.
    """
    each, parts = math.prod(page.chunks) * page.dtype.itemsize, []
    plain = page.predictor == 1 and not page.is_tiled and page.bitspersample in (8, 16) and page.fillorder == 1
    for start, size in zip(page.dataoffsets, page.databytecounts, strict=True):
        tiff.filehandle.seek(start)
        part = deflate.decompressobj().decompress(tiff.filehandle.read(size), each + 1)
        # The last strip of a page may be shorter than the others, or filled up.
        if len(part) > each or (len(part) < each and (page.is_tiled or start != page.dataoffsets[-1])):
            raise ValueError(f"{path}: expected {each} bytes of pixels in every part, found others")
        if plain:
            parts.append(part)
    pixels = math.prod(page.shape)
    if not plain or sum(map(len, parts)) < pixels * page.dtype.itemsize:
        return None
    stored = np.frombuffer(bytearray().join(parts), page.dtype.newbyteorder(tiff.byteorder), pixels)
    return cast(GreyImage, stored.astype(page.dtype, copy=False).reshape(page.shape))


def _read_tiff(path: Path, bits: int, page: int | None = None) -> GreyImage:
    """The only picture of a TIFF file, or a page of it; OpenCV takes what tifffile cannot decode (LZW, packed 12 bit).

    The only one is read from the disk at once: a dozen reads in small parts are as many turns with other threads.
    """
    import tifffile

    with reading(path):
        try:
            at_once = page is None and path.stat().st_size <= READ_AT_ONCE
            # Closed here: what tifffile keeps of it in circles of references would keep the file's bytes as well.
            content: BinaryIO = io.BytesIO(path.read_bytes()) if at_once else path.open("rb")
            with content, tifffile.TiffFile(content) as tiff:
                own = tiff.pages[page or 0]
                inflated = _inflated(path, tiff, own) if "DEFLATE" in own.compression.name else None
                image = inflated if inflated is not None else np.asarray(own.asarray())
                return cast(GreyImage, image.astype(image.dtype.newbyteorder("="), copy=False))
        except (NotImplementedError, ImportError):
            return _read_tiff_opencv(path, bits, page or 0)
        except (ValueError, zlib.error, deflate.error, IndexError) as error:
            if "imagecodecs" in str(error):
                return _read_tiff_opencv(path, bits, page or 0)
            if str(error).startswith(str(path)):
                raise
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
        file.seek(max(0, path.stat().st_size - PNG_TAIL))
        tail = file.read()
    if len(head) < 26 or not head.startswith(PNG_SIGNATURE) or head[12:16] != b"IHDR":
        raise ValueError(f"{path}: not a readable PNG file")
    _refuse_truncated_png(path, tail)
    width, height, bits, colour = struct.unpack(">IIBB", head[16:26])
    if colour != 0:
        raise ValueError(f"{path}: expected a grey image, found {PNG_COLOURS.get(colour, 'unknown colours')}")
    if bits not in (8, 16):
        raise ValueError(f"{path}: expected 8 or 16 bits per pixel, found {bits}")
    return _Header((width, height), bits)


def _refuse_truncated_png(path: Path, tail: bytes) -> None:
    """Refuse a PNG file whose last bytes lack the end mark."""
    if b"IEND" not in tail:
        raise ValueError(f"{path}: truncated, the end mark of the PNG file is missing")


def _bmp_header(path: Path) -> _Header:
    """Size of an uncompressed BMP file of 8 bits with a grey palette."""
    with path.open("rb") as file:
        head = file.read(54)
        if len(head) < 54 or head[:2] != b"BM":
            raise ValueError(f"{path}: not a readable BMP file")
        start, size, width, height, _, bits, compression = struct.unpack_from("<IIiiHHI", head, 10)
        file.seek(14 + size)
        palette = np.frombuffer(file.read(1024), np.uint8)
    check_pixels(path, (width, abs(height)))
    if bits != 8 or compression != 0:
        raise ValueError(f"{path}: expected 8 uncompressed bits per pixel, found {bits} (compression {compression})")
    grey = np.repeat(np.arange(len(palette) // 4), 3).reshape(-1, 3)
    if len(palette) % 4 or not np.array_equal(palette.reshape(-1, 4)[:, :3], grey):
        raise ValueError(f"{path}: expected a palette of 256 grey values in order, found another one")
    expected, actual = start + (width + 3) // 4 * 4 * abs(height), path.stat().st_size
    if actual < expected:
        raise ValueError(f"{path}: truncated, expected {expected} bytes, found {actual}")
    return _Header((width, abs(height)), bits)
