"""TIFF files of cameras: one image, several pages, or a stack; orientation tags."""

from __future__ import annotations

import io
import math
import re
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from os import SEEK_CUR
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from photogram.images.image_notices import ORIENTATION_NOT_APPLIED
from photogram.images.sequence import GreyImage, ImageHeader, wrap_read_errors
from shakercal._common.notices import Notice

ORIENTATION = 274  # tag of TIFF and EXIF
ROTATIONS = {3: "rotated by 180°", 6: "rotated by 90°", 8: "rotated by 270°"}
TAG_OF_ANGLE = {180: 3, 90: 6, 270: 8}  # degrees, clockwise, of a film
MIRRORED = {
    2: "mirrored left to right",
    4: "mirrored top to bottom",
    5: "mirrored and rotated",
    7: "mirrored and rotated",
}
MAX_EXIF = 1 << 16  # bytes
MAX_CHUNKS = 1 << 16  # of a PNG file, segments of a JPEG file
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def tag_notices(tags: Mapping[Path, int]) -> tuple[Notice, ...]:
    """Return a notice of the image files whose orientation tags rotate them.

    `tags`: of all files; their pixels are used as stored.
    """
    rotated = {path: tag for path, tag in tags.items() if tag in ROTATIONS}
    if not rotated:
        return ()
    path, tag = next(iter(rotated.items()))
    return (
        Notice(
            ORIENTATION_NOT_APPLIED,
            str(path),
            tag=tag,
            rotation=ROTATIONS[tag],
            tagged=len(rotated),
            files=len(tags),
        ),
    )


def read_orientations(paths: Iterable[Path]) -> dict[Path, int]:
    """Return the orientation tags of image files, without unreadable and mirrored ones."""
    tags = {}
    for path in paths:
        with suppress(OSError, ValueError):
            tags[path] = read_orientation(path)
    return tags


def read_orientation(path: str | Path) -> int:
    """Return orientation tag 274 of a TIFF, PNG or JPEG file, 1 without one.

    The tag states how the pixels are to be rotated for display. Raises `ValueError` for one that mirrors.
    """
    path = Path(path)
    with wrap_read_errors(path), path.open("rb") as file:
        start = file.read(4)
        if start in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            import tifffile

            try:
                with tifffile.TiffFile(path) as tiff:
                    tag = int(tiff.pages[0].tags.valueof(ORIENTATION, 1))
            except (ValueError, TypeError, IndexError, KeyError, struct.error):
                tag = 1  # the decoder reports the damage
        elif start == PNG_SIGNATURE[:4]:
            file.seek(len(PNG_SIGNATURE))
            tag = _exif_orientation(_png_exif(file))
        elif start[:2] == b"\xff\xd8":
            file.seek(2)
            tag = _exif_orientation(_jpeg_exif(file))
        else:
            tag = 1
    return check_orientation(path, tag)


def check_orientation(path: Path, tag: int) -> int:
    """Return a tag that rotates, or 1; raise `ValueError` for one that mirrors.

    The camera's program may have mirrored either the pixels or the tag.
    """
    if tag in MIRRORED:
        found = f"orientation tag {tag} ({MIRRORED[tag]})"
        raise ValueError(f"{path}: expected pixels as the sensor stored them, found {found}; save without mirroring")
    return tag if tag in ROTATIONS else 1


def _png_exif(file: BinaryIO) -> bytes:
    """Return the EXIF block of a PNG file, empty without one."""
    for _ in range(MAX_CHUNKS):
        head = file.read(8)
        if len(head) < 8:
            return b""
        (size,) = struct.unpack(">I", head[:4])
        if head[4:] == b"eXIf":
            return file.read(min(size, MAX_EXIF))
        file.seek(size + 4, SEEK_CUR)
    return b""


def _jpeg_exif(file: BinaryIO) -> bytes:
    """Return the EXIF block of a JPEG file, empty without one."""
    for _ in range(MAX_CHUNKS):
        head = file.read(4)
        if len(head) < 4 or head[0] != 0xFF or head[1] == 0xDA:  # the pixels begin
            return b""
        size = struct.unpack(">H", head[2:])[0] - 2
        content = file.read(max(size, 0))
        if head[1] == 0xE1 and content.startswith(b"Exif\0\0"):
            return content[6:]
    return b""


def _exif_orientation(exif: bytes) -> int:
    """Return orientation tag 274 of an EXIF block, 1 without one.

    The block is laid out as a TIFF file.
    """
    order = {b"II": "<", b"MM": ">"}.get(exif[:2])
    with suppress(struct.error):
        if order is not None:
            (start,) = struct.unpack_from(f"{order}I", exif, 4)
            (count,) = struct.unpack_from(f"{order}H", exif, start)
            for entry in range(count):
                tag, _, _, value = struct.unpack_from(f"{order}HHIH", exif, start + 2 + 12 * entry)
                if tag == ORIENTATION:
                    return int(value)
    return 1


try:
    from isal import isal_zlib  # inflates in half the time of zlib
except ImportError:  # a processor that it is not built for
    deflate: Any = zlib
else:
    deflate = isal_zlib

TIFF_SUFFIXES = (".tif", ".tiff")
TIFF_CODES = ("NONE", "LZW", "ADOBE_DEFLATE", "DEFLATE", "PACKBITS", "JPEG", "OJPEG", "WEBP")
READ_AT_ONCE = 1 << 28  # bytes of a file
GREY = ("MINISBLACK", "MINISWHITE")
OME_SIZES = re.compile(r'\bSize([CZT])="(\d+)"')


def tiff_header(path: Path) -> ImageHeader:
    """Return size, bits and pages of a TIFF file with complete pixel data."""
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
            count, stack_at = _stacked(path, tiff, pages)
            orientation = check_orientation(path, int(pages[0].tags.valueof(ORIENTATION, 1)))
    except (ValueError, TypeError, IndexError, KeyError, struct.error) as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: not a readable TIFF file ({error})") from error
    if len(shape) != 2 or colour.name not in GREY:
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
    inverted = colour == tifffile.PHOTOMETRIC.MINISWHITE
    if stack_at is not None and (bits == 12 or pages[0].compression.name != "NONE" or needed - stack_at != least):
        raise ValueError(f"{path}: expected a stack with a directory for each of its {count} images, found only one")
    if stack_at is not None and stack_at + count * least > length:
        raise ValueError(f"{path}: truncated, expected {count} images by its description, found fewer")
    middle = [len(page.dataoffsets) // 2 for page in pages]
    pixels_at = [(page.dataoffsets[at], page.databytecounts[at]) for page, at in zip(pages, middle, strict=True)]
    if stack_at is not None:
        pixels_at = [(stack_at + least // 2 + least * page, least // 2) for page in range(count)]
    return ImageHeader((shape[1], shape[0]), bits, count, lossy, orientation, inverted, stack_at, tuple(pixels_at))


def _stacked(path: Path, tiff: Any, pages: Sequence[Any]) -> tuple[int, int | None]:
    """Return the number of images of a TIFF file, and where a stack begins.

    The position is None without a stack with one directory. ImageJ (beyond 4 GB), tifffile and MetaMorph write such
    stacks. Only one series of images is allowed: no channels, slices and times together.
    """
    first, size = pages[0], tiff.filehandle.size
    axes = {axis: int(n) for axis, n in OME_SIZES.findall(first.description)} if first.is_ome and len(pages) > 1 else {}
    count, stack_at = len(pages), None
    if first.is_imagej:
        stated = tiff.imagej_metadata or {}
        axes = {axis: int(stated.get(axis, 1)) for axis in ("channels", "slices", "frames")}
        count = int(stated.get("images", count))
    elif len(pages) == 1 and not first.is_ome and size >= first.dataoffsets[0] + 2 * first.nbytes:
        count = sum(math.prod(series.shape) for series in tiff.series) // math.prod(first.shape)
    several = [f"{n} {axis}" for axis, n in axes.items() if n > 1]
    if len(several) > 1:
        raise ValueError(f"{path}: expected one image after the other, found {' of '.join(several)}")
    if count > 1 and len(pages) == 1:
        stack_at = int(first.dataoffsets[0])
    elif count != len(pages):
        raise ValueError(f"{path}: expected {count} images by its description, found {len(pages)}")
    return count, stack_at


def _stored(page: Any) -> tuple[int, int]:
    """Return end and number of the bytes of a TIFF page's pixels."""
    ends = np.add(page.dataoffsets, page.databytecounts)
    return max((int(end) for end in ends), default=1 << 62), sum(int(count) for count in page.databytecounts)


def read_tiff(path: Path, header: ImageHeader, page: int | None = None) -> GreyImage:
    """Return one image of a TIFF file, with grey values that count up from black."""
    if header.stack_at is None or page is None:
        image = _read_page(path, header.bits, page)
    else:
        image = _read_stacked(path, header, header.stack_at, page)
    return cast(GreyImage, image.dtype.type(2**header.bits - 1) - image) if header.inverted else image


def _read_stacked(path: Path, header: ImageHeader, stack_at: int, page: int) -> GreyImage:
    """Return one of the images that follow each other after one directory."""
    (width, height), count = header.size_px, math.prod(header.size_px)
    with wrap_read_errors(path), path.open("rb") as file:
        kind = np.dtype(f"{'>' if file.read(2) == b'MM' else '<'}u{header.bits // 8}")
        file.seek(stack_at + page * count * kind.itemsize)
        stored = np.frombuffer(file.read(count * kind.itemsize), kind)
        if len(stored) < count:
            raise ValueError(f"{path}: truncated, image {page} is not complete")
        return cast(GreyImage, stored.astype(kind.newbyteorder("=")).reshape(height, width))


def _read_page(path: Path, bits: int, page: int | None = None) -> GreyImage:
    """Return the only image or one page of a TIFF file.

    OpenCV reads what tifffile cannot decode (LZW, packed 12 bit). A single image is read from the disk at once: a dozen
    reads of small parts are as many switches between threads.
    """
    import tifffile

    with wrap_read_errors(path):
        try:
            at_once = page is None and path.stat().st_size <= READ_AT_ONCE
            # Closed explicitly: circular references of tifffile would keep the file's bytes in memory.
            content: BinaryIO = io.BytesIO(path.read_bytes()) if at_once else path.open("rb")
            with content, tifffile.TiffFile(content) as tiff:
                directory = tiff.pages[page or 0]
                inflated = _inflated(path, tiff, directory) if "DEFLATE" in directory.compression.name else None
                image = inflated if inflated is not None else np.asarray(directory.asarray())
                return cast(GreyImage, image.astype(image.dtype.newbyteorder("="), copy=False))
        except (NotImplementedError, ImportError):
            return _read_tiff_opencv(path, bits, page or 0)
        except (ValueError, zlib.error, deflate.error, IndexError) as error:
            if "imagecodecs" in str(error):
                return _read_tiff_opencv(path, bits, page or 0)
            if str(error).startswith(str(path)):
                raise
            raise ValueError(f"{path}: not a readable TIFF file ({error})") from error


def _inflated(path: Path, tiff: Any, page: Any) -> GreyImage | None:
    """Return a page whose strips are deflated, None where tifffile has more to decode.

    Parts that are longer or shorter than their pixels are refused before they fill the memory.
    """
    each, parts = math.prod(page.chunks) * page.dtype.itemsize, []
    plain = page.predictor == 1 and not page.is_tiled and page.bitspersample in (8, 16) and page.fillorder == 1
    for start, size in zip(page.dataoffsets, page.databytecounts, strict=True):
        tiff.filehandle.seek(start)
        part = deflate.decompressobj().decompress(tiff.filehandle.read(size), each + 1)
        # The last strip of a page may be shorter than the others, or padded
        if len(part) > each or (len(part) < each and (page.is_tiled or start != page.dataoffsets[-1])):
            raise ValueError(f"{path}: expected {each} bytes of pixels in every part, found others")
        if plain:
            parts.append(part)
    pixels = math.prod(page.shape)
    if not plain or sum(map(len, parts)) < pixels * page.dtype.itemsize:
        return None
    stored = np.frombuffer(bytearray().join(parts), page.dtype.newbyteorder(tiff.byteorder), pixels)
    return cast(GreyImage, stored.astype(page.dtype, copy=False).reshape(page.shape))


def _read_tiff_opencv(path: Path, bits: int, page: int) -> GreyImage:
    """Return one page of a TIFF file by OpenCV, its packed 12-bit values scaled back."""
    import cv2
    import tifffile

    data = np.fromfile(path, np.uint8)
    inverted = read_raw_tiff(data, page) == tifffile.PHOTOMETRIC.MINISWHITE
    _, pages = cv2.imdecodemulti(data, cv2.IMREAD_UNCHANGED, range=(page, page + 1))
    if len(pages) != 1:
        raise ValueError(f"{path}: not a readable TIFF file (page {page} cannot be decoded)")
    image = cast(NDArray[np.uint8 | np.uint16], np.asarray(pages[0]))
    if inverted and image.dtype == np.uint8:  # which OpenCV inverts automatically
        image = ~image
    return image >> np.uint16(4) if bits == 12 else image


def read_raw_tiff(data: NDArray[np.uint8], page: int = 0) -> Any:
    """Reset the orientation tag of a TIFF page in memory; return its photometric.

    OpenCV obeys the tag whatever its flags are. None for other files.
    """
    import tifffile

    if data[:2].tobytes() not in (b"II", b"MM"):
        return None
    try:
        with tifffile.TiffFile(io.BytesIO(data.tobytes())) as tiff:
            directory = tiff.pages[page]
            tag = directory.tags.get(ORIENTATION)
            if tag is not None:
                data[tag.valueoffset : tag.valueoffset + 2] = np.array([1], f"{tiff.byteorder}u2").view(np.uint8)
            return directory.photometric
    except (ValueError, TypeError, IndexError, KeyError, struct.error):
        return None  # the decoder reports the damage
