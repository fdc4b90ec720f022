"""Orientation tags of image files: reported, not applied, refused if they mirror."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from contextlib import suppress
from os import SEEK_CUR
from pathlib import Path
from typing import BinaryIO

from photogram.images.image_notices import ORIENTATION_NOT_APPLIED
from photogram.images.sequence import wrap_read_errors
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
