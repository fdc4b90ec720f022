"""Video files of cameras: Photron raw video, Phantom cine, and compressed video."""

from __future__ import annotations

import builtins
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from photogram.images.image_notices import (
    COMPANDED_CODES,
    COMPRESSED_VIDEO,
    EXPOSURE_VARIES,
    FILM_DECODED,
    RAW_PHOTRON_FRAMES,
)
from photogram.images.sequence import (
    GLIMPSE,
    GreyImage,
    ImageSequence,
    bytes_at,
    check_pixels,
    full_scale_of,
    numbers_of_times,
    wrap_read_errors,
)
from photogram.images.tiff import TAG_OF_ANGLE, tag_notices
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

MAX_HEADER = 4 << 20  # bytes of a .cih or .cihx, which usually have about ten thousand
MAX_FRAMES = 1 << 21  # more than any camera's memory


def _names(path: Path, frames: int) -> tuple[str, ...]:
    return tuple(f"{path}[{frame}]" for frame in range(frames))


def _unpacked_12(raw: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return values of 12 bits, packed in pairs in three bytes, high bits first."""
    first, middle, last = raw.reshape(-1, 3).astype(np.uint16).T
    return np.column_stack(((first << 4) | (middle >> 4), ((middle & 15) << 8) | last)).ravel()


def _unpacked_10(raw: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return values of 10 bits, packed by four in five bytes, high bits first."""
    a, b, c, d, e = raw.reshape(-1, 5).astype(np.uint16).T
    values = (a << 2 | b >> 6, (b & 63) << 4 | c >> 4, (c & 15) << 6 | d >> 2, (d & 3) << 8 | e)
    return np.column_stack(values).ravel()


# Photron cameras: a header .cih or .cihx, and the frames in the .mraw next to it.

PHOTRON_KEYS = {
    "Total Frame": "frameInfo/totalFrame",
    "Image Width": "imageDataInfo/resolution/width",
    "Image Height": "imageDataInfo/resolution/height",
    "Color Type": "imageDataInfo/colorInfo/type",
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
    "EffectiveBit Side": "imageDataInfo/effectiveBit/side",
    "File Format": "imageFileInfo/fileFormat",
    "Record Rate(fps)": "recordInfo/recordRate",
    "Shutter Speed(s)": "recordInfo/shutterSpeed",
    "Save Step": "frameInfo/skipFrame",
}


def open_photron(header: Path, bit_depth: int | None) -> ImageSequence:
    """Return the frames of a header .cih or .cihx, from the .mraw next to it."""
    entries = _photron_entries(header)
    path = next((path for path in map(header.with_suffix, (".mraw", ".MRAW")) if path.is_file()), None)
    if path is None:
        raise FileNotFoundError(f"{header.with_suffix('.mraw')}: no such file next to {header.name}")

    def whole(key: str) -> int:
        text = entries.get(key, "nothing")
        if not text.isdecimal() or len(text) > 9 or int(text) < 1:
            raise ValueError(f"{header}: {key}: expected a positive whole number, found {text[:40]}")
        return int(text)

    stored_bits = whole("Color Bit")
    colour, layout = entries.get("Color Type", "Mono"), entries.get("File Format", "MRaw")
    if colour.lower() not in ("mono", "raw") or layout.lower() != "mraw":
        raise ValueError(f"{header}: expected monochrome MRaw frames, found {colour!r} and {layout!r}")
    if stored_bits not in (8, 12, 16):
        raise ValueError(f"{header}: Color Bit: expected 8, 12 or 16, found {stored_bits}")
    side = entries.get("EffectiveBit Side", "Lower").lower()
    if side not in ("lower", "higher"):
        raise ValueError(f"{header}: EffectiveBit Side: expected Lower or Higher, found {side!r}")
    frames, size_px = whole("Total Frame"), (whole("Image Width"), whole("Image Height"))
    check_pixels(header, size_px)
    if frames > MAX_FRAMES:
        raise ValueError(f"{header}: Total Frame: expected at most {MAX_FRAMES}, found {frames}")
    bits = min(16, whole("EffectiveBit Depth")) if stored_bits == 16 else stored_bits
    expected, actual = frames * size_px[0] * size_px[1] * stored_bits // 8, path.stat().st_size
    if actual < expected:
        raise ValueError(f"{path}: truncated, expected {expected} bytes for {frames} frames, found {actual}")
    shift = 16 - bits if side == "higher" else 0
    rate_hz, exposure_s = (_stated(entries, key) for key in ("Record Rate(fps)", "Shutter Speed(s)"))
    step = _stated(entries, "Save Step") or 1.0
    notices = (Notice(RAW_PHOTRON_FRAMES, str(header)),) if colour.lower() == "raw" else ()
    return ImageSequence(
        _names(path, frames),
        size_px,
        full_scale_of(header, bits, bit_depth),
        partial(_read_mraw, path, size_px, stored_bits, shift),
        None if rate_hz is None else np.asarray(np.arange(frames) * step / rate_hz, dtype=np.float64),
        # the XML gives the shutter as 1/s alone, the older header as "1/5000"
        exposure_s if exposure_s is None or exposure_s < 1.0 else 1.0 / exposure_s,
        notices,
        glimpse=partial(_mraw_glimpse, path, size_px[0] * size_px[1] * stored_bits // 8),
    )


def _mraw_glimpse(path: Path, size: int, index: int) -> bytes:
    return bytes_at(path, index * size + size // 2, size // 2)


def _stated(entries: dict[str, str], key: str) -> float | None:
    """Return a positive number or fraction of a header, None if it cannot be read."""
    above, _, below = entries.get(key, "").partition("/")
    try:
        value = float(above) / float(below or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return value if 0.0 < value < np.inf else None


def _photron_entries(header: Path) -> dict[str, str]:
    """Return the entries of a header by their .cih names.

    A .cih has lines `key : value`, a .cihx XML between other bytes.
    """
    from xml.etree import ElementTree

    with header.open("rb") as file:
        text = file.read(MAX_HEADER).decode("utf-8", "replace")
    if header.suffix.lower() == ".cih":
        pairs = (line.partition(":") for line in text.splitlines() if ":" in line)
        return {key.strip(): value.strip() for key, _, value in pairs}
    start, end = text.find("<cih>"), text.rfind("</cih>")
    try:
        root = ElementTree.fromstring(text[start : end + len("</cih>")] if start >= 0 else "")
    except ElementTree.ParseError as error:
        raise ValueError(f"{header}: expected a <cih> element ({error})") from error
    entries = {key: root.findtext(element) for key, element in PHOTRON_KEYS.items()}
    return {key: entry.strip() for key, entry in entries.items() if entry is not None}


def _read_mraw(path: Path, size_px: tuple[int, int], stored_bits: int, shift: int, index: int) -> GreyImage:
    """Return frame `index` of 8, 12 or 16 stored bits per pixel.

    In 16 bits the grey value may be shifted up by `shift` bits.
    """
    width, height = size_px
    count = width * height * stored_bits // 8
    with wrap_read_errors(path):
        raw = np.fromfile(path, np.uint8, count=count, offset=index * count)
    if len(raw) < count:
        raise ValueError(f"{path}: frame {index} is cut off, expected {count} bytes, found {len(raw)}")
    if stored_bits == 8:
        return raw.reshape(height, width)
    if stored_bits == 16:
        return raw.view("<u2").astype(np.uint16).reshape(height, width) >> np.uint16(shift)
    return _unpacked_12(raw).reshape(height, width)


# Phantom cameras: Vision Research, "Cine file format", 2018. All numbers are little-endian.

PACKED_10, PACKED_12 = 256, 1024  # of biCompression
MAX_BLOCKS = 10_000  # tagged ones of a cine file
FRAME_TIMES, EXPOSURES = 1002, 1003  # types of tagged blocks


@dataclass(frozen=True)
class _Cine:
    """Storage of the frames of a cine file.

    Attributes
    ----------
    offsets : (F,) first bytes of the frames.
    bottom_up : whether the bottom row is first.
    """

    path: Path
    offsets: NDArray[np.int64]
    size_px: tuple[int, int]
    packing: int
    stored_bits: int
    bottom_up: bool

    @property
    def bytes(self) -> int:
        """Bytes of one frame."""
        pixels, bits = self.size_px[0] * self.size_px[1], {PACKED_10: 10, PACKED_12: 12}.get(self.packing)
        return pixels * (self.stored_bits if bits is None else bits) // 8

    def glimpse(self, index: int) -> builtins.bytes:
        """Return some bytes of the pixels of frame `index`."""
        return bytes_at(self.path, int(self.offsets[index]) + self.bytes // 2, self.bytes // 2)

    def read(self, index: int) -> GreyImage:
        """Return frame `index`; codes of 10 bits as grey values of 12 bits."""
        width, height = self.size_px
        with wrap_read_errors(self.path), self.path.open("rb") as file:
            file.seek(int(self.offsets[index]))
            (annotation,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
            file.seek(int(self.offsets[index]) + annotation)
            raw = np.frombuffer(file.read(self.bytes), np.uint8)
        if len(raw) < self.bytes:
            raise ValueError(f"{self.path}: frame {index} is cut off, expected {self.bytes} bytes, found {len(raw)}")
        if self.packing == PACKED_10:
            grey: GreyImage = linear_12_of_10()[_unpacked_10(raw)]
        elif self.packing == PACKED_12:
            grey = _unpacked_12(raw)
        else:
            grey = raw if self.stored_bits == 8 else raw.view("<u2").astype(np.uint16)
        image = grey.reshape(height, width)
        return np.ascontiguousarray(image[::-1]) if self.bottom_up else image


def linear_12_of_10() -> NDArray[np.uint16]:
    """Return the linear 12-bit grey values (1024,) of a Phantom camera's packed 10-bit codes.

    The codes follow the opto-electronic transfer of ITU-R BT.709 with black at 64 of either scale and white at 1014,
    4065. They agree within one grey value with the table that Vision Research publishes, except the first two codes
    (three off).
    """
    level = (np.arange(1024) - 63.5) / 953.0
    light = np.where(level < 0.081, level / 4.5, ((np.maximum(level, 0.0) + 0.099) / 1.099) ** (1.0 / 0.45))
    grey = np.rint(64.0 + 4001.0 * light / light[1014])
    return np.where(np.arange(1024) > 1014, 4095.0, grey).astype(np.uint16)


def open_cine(path: Path, bit_depth: int | None) -> ImageSequence:
    """Return the frames of a monochrome .cine with times and exposure from its tagged blocks."""
    length = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(44)
        if len(head) < 44 or head[:2] != b"CI":
            raise ValueError(f"{path}: not a readable Phantom cine file")
        fields = struct.unpack("<2sHHHiIiIIII", head[:36])
        compression, frames, header_at, setup_at, offsets_at = fields[2], *fields[7:]
        file.seek(header_at)
        _, width, height, _, stored, packing = struct.unpack("<IiiHHI", file.read(20).ljust(20, b"\0"))
        file.seek(setup_at)
        setup = file.read(1024).ljust(1024, b"\0")
        (setup_length,) = struct.unpack_from("<H", setup, 142)
        ends = setup_at + setup_length, offsets_at + 8 * frames
        check_pixels(path, (width, abs(height)))
        if setup[140:142] != b"ST" or not 0 < frames <= MAX_FRAMES or ends[1] > length:
            raise ValueError(f"{path}: not a readable Phantom cine file (damaged header)")
        file.seek(offsets_at)
        offsets = np.frombuffer(file.read(8 * frames), "<i8")
        blocks = _tagged_blocks(file, ends[0], offsets_at)
    (microseconds,), (colours,), (real_bits,) = (struct.unpack_from("<I", setup, at) for at in (772, 808, 896))
    if compression == 1 or stored not in (8, 16) or (colours & 255 if setup_length > 808 else compression == 2):
        what = "JPEG frames" if compression == 1 else "colour"
        raise ValueError(f"{path}: expected uncompressed grey images, found {what} (save it as raw monochrome)")
    if packing not in (0, PACKED_10, PACKED_12):
        raise ValueError(f"{path}: expected packing of 0, 256 or 1024, found {packing}")
    packed = packing != 0
    cine = _Cine(path, offsets, (width, abs(height)), packing, stored, height > 0 and not packed)
    if offsets.min() < 0 or int(offsets.max()) + cine.bytes > length:
        needed = int(offsets.max()) + cine.bytes
        raise ValueError(f"{path}: truncated, expected at least {needed} bytes for {frames} frames, found {length}")
    bits = 12 if packed else min(stored, real_bits) if setup_length > 896 and real_bits else stored
    time_s = _seconds(blocks.get(FRAME_TIMES), frames)
    exposures = blocks.get(EXPOSURES)
    exposure_s, notices = microseconds * 1e-6 if setup_length > 772 and microseconds else None, []
    if exposures is not None and len(exposures) >= 4 * frames:
        each = np.frombuffer(exposures, "<u4", frames) / 2.0**32
        exposure_s = float(np.median(each))
        other = int(np.count_nonzero(np.abs(each - exposure_s) > 0.01 * exposure_s))
        if other:
            exposure_us = 1e6 * exposure_s
            notices.append(Notice(EXPOSURE_VARIES, str(path), exposure_us=exposure_us, different=other, frames=frames))
    if packing == PACKED_10:
        notices.append(Notice(COMPANDED_CODES, str(path)))
    scale = full_scale_of(path, bits, bit_depth)
    names, remarks = _names(path, frames), tuple(notices)
    return ImageSequence(names, cine.size_px, scale, cine.read, time_s, exposure_s, remarks, glimpse=cine.glimpse)


def _tagged_blocks(file: Any, start: int, end: int) -> dict[int, bytes]:
    """Return the tagged blocks between two offsets of a cine file, by their type."""
    blocks: dict[int, bytes] = {}
    for _ in range(MAX_BLOCKS):
        if start + 8 > end:
            break
        file.seek(start)
        size, kind, _ = struct.unpack("<IHH", file.read(8).ljust(8, b"\0"))
        if not 8 <= size <= end - start:
            break
        if kind in (FRAME_TIMES, EXPOSURES):
            blocks[kind] = file.read(size - 8)
        start += size
    return blocks


def _seconds(block: bytes | None, frames: int) -> FloatArray | None:
    """Return times (F,) from the first frame on, None where the block has too few.

    Each time is stored as multiples of 2⁻³² s, then seconds.
    """
    if block is None or len(block) < 8 * frames:
        return None
    words = np.frombuffer(block, "<u4", 2 * frames).reshape(-1, 2).astype(np.int64)
    return np.asarray((words[:, 1] - words[0, 1]) + (words[:, 0] - words[0, 0]) / 2.0**32)


# Films, by OpenCV: grey values as stored for 8 and 16 bits, otherwise the luminance of the decoded colours.

LOSSLESS = ("", "DIB", "Y800", "Y8", "GREY", "FFV1", "HFYU", "FFVH", "RAW")
GREY_8, GREY_16 = b"Y800", b"Y1\0\x10"  # FFmpeg's tags of pixels that OpenCV returns unchanged
MIN_DEEP = 9  # bits, of which OpenCV keeps 8
STAMP_S = 1e-3  # rounding of times in some containers


@dataclass
class _Film:
    """Frames of a film, read sequentially; `raw`: grey values as stored."""

    path: Path
    raw: bool
    capture: Any = field(default=None, repr=False)
    following: int = 0

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "raw": self.raw, "capture": None, "following": 0}

    def read(self, index: int) -> GreyImage:
        """Return frame `index` as grey values, of a coloured one its luminance."""
        with wrap_read_errors(self.path):
            return self._decoded(index)

    def _decoded(self, index: int) -> GreyImage:
        import cv2

        if self.capture is None or index < self.following:
            self.capture, self.following = _as_stored(cv2.VideoCapture(str(self.path)), self.raw), 0
        while self.following < index and self.capture.grab():
            self.following += 1
        decoded, image = self.capture.read()
        self.following += 1
        if not decoded:
            raise ValueError(f"{self.path}: frame {index} cannot be decoded")
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return cast(GreyImage, np.asarray(grey))


def _as_stored(capture: Any, raw: bool) -> Any:
    """Switch off the rotation for display, and for raw frames the conversion to colours."""
    import cv2

    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    if raw:
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return capture


def _pixel_bits(path: Path, tag: bytes) -> int:
    """Return the bits of a grey value by FFmpeg's pixel tag.

    Such a tag has the bits of a pixel or of a colour at its end, or at its beginning with the most significant byte
    first. Raises `ValueError` for pixels of which OpenCV keeps only 8 bits.
    """
    coloured = any(name in tag for name in (b"RGB", b"BGR"))
    sizes = [size for size in (tag[0], tag[3]) if size < ord("0") or size == 64 or (coloured and size == 48)]
    stated = max(sizes, default=0)
    if tag == GREY_16:
        return 16
    if coloured and stated in (24, 32):
        return 8
    if stated >= MIN_DEEP:
        name = "".join(chr(byte) for byte in tag if byte != stated).strip("\0")
        found = f"{stated} bits ({name}), of which its decoder keeps 8"
        raise ValueError(
            f"{path}: expected a film of 8 bits a pixel, or of 16 bits grey, found {found}; save TIFF files"
        )
    return 8


def open_film(path: Path, bit_depth: int | None) -> ImageSequence:
    """Return the frames of an AVI, MP4, MOV or MKV film.

    The film is decoded once to count them.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its library would write to the terminal
    import cv2

    capture = _as_stored(cv2.VideoCapture(str(path)), raw=False)
    if not capture.isOpened():
        raise ValueError(f"{path}: not a readable film, or of an unsupported codec; save the frames as TIFF")
    size_px = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    check_pixels(path, size_px)
    codec, tag = (
        struct.pack("<I", int(capture.get(key)) & 0xFFFFFFFF)
        for key in (cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_CODEC_PIXEL_FORMAT)
    )
    bits, rotation = _pixel_bits(path, tag), int(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
    stamps, rows = list[float](), list[bytes]()
    while capture.grab():
        stamps.append(1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC))
        decoded, image = capture.retrieve()
        rows.append(np.asarray(image)[size_px[1] // 2].tobytes()[:GLIMPSE] if decoded else b"")
    capture.release()
    if not stamps:
        raise ValueError(f"{path}: expected frames, found none that can be decoded")
    name = codec.decode("latin-1").strip(" \0").upper()
    if name in LOSSLESS:
        codec_notice = Notice(FILM_DECODED, str(path), bits=bits)
    else:
        codec_notice = Notice(COMPRESSED_VIDEO, str(path), codec=name)
    notices = (codec_notice, *tag_notices({path: TAG_OF_ANGLE.get(rotation, 1)}))
    scale, film = full_scale_of(path, bits, bit_depth), _Film(path, tag in (GREY_8, GREY_16))
    time_s = np.array(stamps) - stamps[0]
    numbers = numbers_of_times(time_s, STAMP_S)
    irregular = numbers is None and len(time_s) > 2 and np.ptp(np.diff(time_s)) > 2.0 * STAMP_S
    stated_s = time_s if irregular else None
    frames = _names(path, len(stamps))
    return ImageSequence(
        frames, size_px, scale, film.read, stated_s, notices=notices, numbers=numbers, glimpse=rows.__getitem__
    )


VIDEO_READERS: dict[str, Callable[[Path, int | None], ImageSequence]] = {
    ".cih": open_photron,
    ".cihx": open_photron,
    ".cine": open_cine,
    **dict.fromkeys((".avi", ".mp4", ".mov", ".mkv"), open_film),
}
