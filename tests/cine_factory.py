"""Phantom cine files, field by field from the maker's description and independent of the reader; films by OpenCV."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest


def cine_bytes(
    frames: np.ndarray,
    bits: int = 12,
    packing: int = 0,
    codes: np.ndarray | None = None,
    interval_s: float = 0.01,
    exposure_s: float = 40e-6,
    lost: int | None = None,
    colours: int = 0,
) -> bytes:
    """Frames (F,H,W) as the bytes of a file, with times and exposures in tagged blocks.

    `codes`: the packed values (10 bit), `lost`: the frame before which one is missing by the times.
    """
    count, height, width = frames.shape
    if packing:
        size = {256: 10, 1024: 12}[packing]
        values = frames if codes is None else codes
        pictures = [
            int("".join(f"{int(v):0{size}b}" for v in image.ravel()), 2).to_bytes(image.size * size // 8, "big")
            for image in values
        ]
    else:
        pictures = [image[::-1].astype("<u1" if bits == 8 else "<u2").tobytes() for image in frames]
    bitmap = struct.pack(
        "<IiiHHIIiiII", 40, width, height, 1, 8 if bits == 8 else 16, packing, len(pictures[0]), 0, 0, 0, 0
    )
    setup = bytearray(1000)
    setup[140:142] = b"ST"
    struct.pack_into("<H", setup, 142, len(setup))
    struct.pack_into("<I", setup, 772, round(exposure_s * 1e6))
    struct.pack_into("<I", setup, 808, colours)
    struct.pack_into("<I", setup, 896, bits)
    times = [interval_s * (n + (lost is not None and n >= lost)) for n in range(count)]
    stamps = b"".join(struct.pack("<II", int(t % 1.0 * 2**32), 1_700_000_000 + int(t)) for t in times)
    exposures = struct.pack("<I", round(exposure_s * 2**32)) * count
    blocks = b"".join(
        struct.pack("<IHH", len(data) + 8, kind, 0) + data
        for kind, data in ((1000, b"other"), (1002, stamps), (1003, exposures))
    )
    setup_at = 44 + len(bitmap)
    offsets_at = setup_at + len(setup) + len(blocks)
    first = offsets_at + 8 * count
    images = [struct.pack("<II", 8, len(picture)) + picture for picture in pictures]
    starts = first + np.cumsum([0, *(len(image) for image in images[:-1])])
    header = struct.pack(
        "<2sHHHiIiIIIIII", b"CI", 44, 0, 1, -count, count, -count, count, 44, setup_at, offsets_at, 0, 1_700_000_000
    )
    return b"".join([header, bitmap, setup, blocks, starts.astype("<i8").tobytes(), *images])


def write_cine(path: Path, frames: np.ndarray, **options: object) -> Path:
    """Write a file and return its path."""
    path.write_bytes(cine_bytes(frames, **options))  # type: ignore[arg-type]
    return path


def write_film(path: Path, frames: np.ndarray, codec: str = "FFV1", rate_hz: float = 25.0) -> Path:
    """A grey film by OpenCV, of 16 bits where the frames have them."""
    deep = frames.dtype == np.uint16
    stated = [cv2.VIDEOWRITER_PROP_IS_COLOR, 0, cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U if deep else cv2.CV_8U]
    code = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, rate_hz, frames.shape[:0:-1], stated)
    if not writer.isOpened():
        pytest.skip(f"OpenCV cannot write {codec} here")
    for image in frames:
        writer.write(image)
    writer.release()
    return path
