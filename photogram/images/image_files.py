"""Image series from disk at full bit depth: single images, TIFF stacks, videos."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from photogram.images.image_notices import LOSSY_IMAGES
from photogram.images.sequence import (
    GreyImage,
    ImageHeader,
    ImageSequence,
    bytes_at,
    check_pixels,
    full_scale_of,
    numbers_of_names,
    wrap_read_errors,
)
from photogram.images.tiff import (
    GREY,
    PNG_SIGNATURE,
    TIFF_SUFFIXES,
    read_orientation,
    read_raw_tiff,
    read_tiff,
    tag_notices,
    tiff_header,
)
from photogram.images.video import VIDEO_READERS
from shakercal._common.notices import Notice

SUFFIXES = (*TIFF_SUFFIXES, ".png", ".bmp", *VIDEO_READERS)
BIT_DEPTHS = (8, 10, 12, 14, 16)  # of cameras
PNG_TAIL = 64  # last bytes in which the end mark is searched
PNG_COLOURS = {2: "colour", 3: "palette colour", 4: "grey with transparency", 6: "colour with transparency"}


def open_sequence(paths: Sequence[str | Path], bit_depth: int | None = None) -> ImageSequence:
    """Open grey images: TIFF, PNG or BMP files, one multi-page TIFF, or one video file.

    Headers are checked at once (format, colour, size, truncation), pixels when a frame is read. Pixels are those that
    the sensor stored. A tag that rotates them for display is reported and not applied; one that mirrors is refused.

    Parameters
    ----------
    paths
        Files in the order of the frames. Video: Phantom .cine, Photron .cih or .cihx next to its .mraw, or .avi .mp4
        .mov .mkv.
    bit_depth
        Bits of a grey value. None (default): the stored type, 8 bit → full scale 255, 16 bit → 65535; of a camera's
        video the bit depth in its header.

    Returns
    -------
    ImageSequence
        The frames, with the notices that their files give, such as lossy compression.

    Raises
    ------
    ValueError, OSError
        For a file that is damaged, missing or of another kind than the first; the text begins with its path.

    Examples
    --------
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
        with wrap_read_errors(files[0]):
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
        if header.inverted != first.inverted:
            raise ValueError(f"{path}: expected 0 to be {'white' if first.inverted else 'black'} as in {files[0]}")
    if first.inverted and full_scale < 2**first.bits - 1:
        found = f"values of {first.bits} bits that count down from white (MINISWHITE)"
        raise ValueError(f"{files[0]}: expected grey values up to {full_scale} that count up from black, found {found}")
    if first.pages > 1:
        names = tuple(f"{files[0]}[{page}]" for page in range(first.pages))
        reader, offsets = partial(read_tiff, files[0], first), [(files[0], *offset) for offset in first.pixels_at]
    else:
        names, reader = tuple(str(path) for path in files), partial(_read_file, files, first)
        offsets = [(path, *header.pixels_at[0]) for path, header in zip(files, headers, strict=True)]
    numbers = numbers_of_names([path.name for path in files])
    notices, glimpse = _header_notices(files, headers), partial(_glimpse, offsets)
    return ImageSequence(names, first.size_px, full_scale, reader, notices=notices, numbers=numbers, glimpse=glimpse)


def _glimpse(offsets: Sequence[tuple[Path, int, int]], index: int) -> bytes:
    return bytes_at(*offsets[index])


def _header_notices(files: Sequence[Path], headers: Sequence[ImageHeader]) -> tuple[Notice, ...]:
    """Return notices of lossy compression and of orientation tags that are not applied."""
    found = []
    count = headers[0].pages if headers[0].pages > 1 else len(files)
    lossy = next((path for path, header in zip(files, headers, strict=True) if header.lossy), None)
    if lossy is not None:
        found.append(Notice(LOSSY_IMAGES, str(lossy), images=count))
    tags = {path: header.orientation for path, header in zip(files, headers, strict=True)}
    return (*found, *tag_notices(tags))


def read_image(path: str | Path) -> tuple[GreyImage, int]:
    """Read one image of any common format as grey values.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    image : (H, W), uint8 or uint16. Colours become their luminance. Pixels are as stored, whatever the orientation tag.
    full_scale : of the fewest bits among 8, 10, 12, 14 and 16 that contain the brightest pixel, since files of 16 bit
        do not state the bits of the camera.

    Raises
    ------
    ValueError, OSError
        For a file that cannot be read, and for an orientation tag that mirrors.

    Examples
    --------
    >>> import cv2
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = cv2.imwrite(f"{folder}/grey.png", np.full((8, 16), 700, np.uint16))
    ...     image, full_scale = read_image(f"{folder}/grey.png")
    >>> image.shape, full_scale
    ((8, 16), 1023)
    """
    import cv2

    path = Path(path)
    with wrap_read_errors(path):
        data = np.fromfile(path, np.uint8)
        if data[: len(PNG_SIGNATURE)].tobytes() == PNG_SIGNATURE:  # whose library would write to the terminal
            _refuse_truncated_png(path, data[-PNG_TAIL:].tobytes())
        read_orientation(path)
        photometric = read_raw_tiff(data)
        if photometric is not None and photometric.name in GREY:  # OpenCV does not read every layout of these
            header = tiff_header(path)
            check_pixels(path, header.size_px)
            if header.pages > 1:
                raise ValueError(f"{path}: expected one image, found a stack of {header.pages}")
            image: GreyImage | None = read_tiff(path, header)
        else:
            flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
            image = cast(GreyImage, cv2.imdecode(data, flags)) if data.size else None
    if image is None:
        raise ValueError(f"{path}: expected a readable image, found another file")
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: expected 8 or 16 bits per pixel, found {image.dtype}")
    grey = cast(GreyImage, np.asarray(image))
    bits = next(b for b in BIT_DEPTHS if int(grey.max()) < 2**b)
    return grey, 2**bits - 1


def _read_header(path: Path) -> ImageHeader:
    """Return the header of a file that is one image, or of a TIFF file."""
    reader = {".tif": tiff_header, ".tiff": tiff_header, ".png": _png_header, ".bmp": _bmp_header}
    if path.suffix.lower() in VIDEO_READERS:
        raise ValueError(f"{path}: expected one video file for a camera, found several files")
    if path.suffix.lower() not in reader:
        raise ValueError(f"{path}: expected a file of type {' '.join(SUFFIXES)}, found {path.suffix or 'no suffix'}")
    with wrap_read_errors(path):
        header = reader[path.suffix.lower()](path)
        check_pixels(path, header.size_px)
        return header


def _read_file(paths: tuple[Path, ...], header: ImageHeader, index: int) -> GreyImage:
    path = paths[index]
    if path.suffix.lower() in TIFF_SUFFIXES:
        return read_tiff(path, header)
    import cv2

    with wrap_read_errors(path):
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        kind = path.suffix[1:].upper()
        raise ValueError(f"{path}: not a readable {kind} file (its pixels cannot be decoded)")
    return cast(GreyImage, np.asarray(image))


def _png_header(path: Path) -> ImageHeader:
    """Return size and bits of a PNG file that has its end mark."""
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
    return ImageHeader((width, height), bits, orientation=read_orientation(path))


def _refuse_truncated_png(path: Path, tail: bytes) -> None:
    """Raise `ValueError` for a PNG file whose last bytes lack the end mark."""
    if b"IEND" not in tail:
        raise ValueError(f"{path}: truncated, the PNG file has no end mark")


def _bmp_header(path: Path) -> ImageHeader:
    """Return the size of an uncompressed BMP file of 8 bits with a grey palette."""
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
    return ImageHeader((width, abs(height)), bits)
