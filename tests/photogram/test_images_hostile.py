"""Pictures, videos and tables that lie about their size, inflate without end, or are no files at all."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cine_factory
import numpy as np
import pytest
import scipy.io
import tifffile
from contracts import refused

from photogram import point_tables
from photogram.images.image_files import open_sequence, read_image
from photogram.point_tables import read_point_tables

WIDE = 60_000


def _png(path: Path, width: int, height: int) -> Path:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b""))
    return path


def _tiff(path: Path, width: int, height: int, compression: int, content: bytes) -> Path:
    """One strip, field by field from the TIFF 6.0 specification."""
    fields = {
        256: width,
        257: height,
        258: 16,
        259: compression,
        262: 1,
        273: 0,
        277: 1,
        278: height,
        279: len(content),
    }
    start = 8 + 2 + 12 * len(fields) + 4
    entries = [struct.pack("<HHII", tag, 4, 1, start if tag == 273 else value) for tag, value in fields.items()]
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(fields)) + b"".join(entries) + b"\0\0\0\0" + content)
    return path


def test_images_larger_than_any_camera_are_refused(tmp_path):
    pictures = [_png(tmp_path / "a.png", WIDE, WIDE)]
    pictures += [_tiff(tmp_path / f"{kind}.tif", WIDE, WIDE, kind, zlib.compress(b"1")) for kind in (5, 8)]
    palette = b"".join(bytes([grey] * 3 + [0]) for grey in range(256))
    head = struct.pack("<IHHIIiiHHIIIIII", 0, 0, 0, 1078, 40, WIDE, WIDE, 1, 8, 0, 0, 0, 0, 0, 0)
    (tmp_path / "a.bmp").write_bytes(b"BM" + head + palette)
    for path in (*pictures, tmp_path / "a.bmp"):
        refused(f"{path.name}: .* 268435456 .* {WIDE} x {WIDE}", open_sequence, [path])
        refused(f"{path.name}: (.*readable|.* 268435456 )", read_image, path)
    cine = bytearray(cine_factory.cine_bytes(np.zeros((2, 16, 24), np.uint16)))
    struct.pack_into("<ii", cine, 48, WIDE, WIDE)
    (tmp_path / "a.cine").write_bytes(cine)
    refused("a.cine: .* 268435456 ", open_sequence, [tmp_path / "a.cine"])


def test_a_truncated_image_is_refused_without_other_output(tmp_path, capfd):
    whole = _png(tmp_path / "whole.png", 64, 64).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[:-12])
    for read in (read_image, lambda path: open_sequence([path])):
        refused("cut.png: truncated", read, tmp_path / "cut.png")
    assert capfd.readouterr() == ("", ""), "what decodes PNG files has a terminal of its own"


def test_parts_of_a_tiff_have_to_be_as_long_as_their_pixels(tmp_path):
    """A deflated strip of 100 kB that inflates to 100 MB is not inflated; what is missing is not made up."""
    grey = np.random.default_rng(1).integers(0, 4096, (16, 16), dtype=np.uint16)
    sound = _tiff(tmp_path / "sound.tif", 16, 16, 8, zlib.compress(grey.tobytes()))
    np.testing.assert_array_equal(open_sequence([sound]).read(0), grey)
    tifffile.imwrite(tmp_path / "strips.tif", np.tile(grey, (5, 4)), compression="zlib", rowsperstrip=32)
    np.testing.assert_array_equal(open_sequence([tmp_path / "strips.tif"]).read(0), np.tile(grey, (5, 4)))
    bomb = _tiff(tmp_path / "bomb.tif", 16, 16, 8, zlib.compress(bytes(10**8)))
    refused("bomb.tif: .* 512 bytes", open_sequence([bomb]).read, 0)
    short = _tiff(tmp_path / "short.tif", 16, 16, 8, zlib.compress(bytes(100)))
    refused("short.tif: .*TIFF", open_sequence([short]).read, 0)
    plain = _tiff(tmp_path / "plain.tif", 64, 64, 1, bytes(100))
    refused("plain.tif: .* 8192 bytes .* 64 x 64 .* 100", open_sequence, [plain])
    other = _tiff(tmp_path / "other.tif", 16, 16, 34925, bytes(100))
    refused("other.tif: .* LZMA", open_sequence, [other])


@pytest.mark.parametrize("frames", ["99999999", "9" * 5000, "²"])
def test_numbers_of_frames_that_no_camera_has_are_refused(tmp_path, frames):
    text = f"Total Frame : {frames}\nImage Width : 1\nImage Height : 1\nColor Bit : 8\nEffectiveBit Depth : 8\n"
    (tmp_path / "a.cih").write_text(text, encoding="utf-8")
    with (tmp_path / "a.mraw").open("wb") as file:
        file.truncate(100_000_000)
    refused("a.cih: Total Frame: ", open_sequence, [tmp_path / "a.cih"])


def test_tables_of_points_that_inflate_or_nest_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(point_tables, "MOST_BYTES", 1 << 20)
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {name: np.zeros((1000, 1000)) for name in "XYZUVW"}, do_compression=True)
    refused(r"a\.mat: .* 1 MB", read_point_tables, [path], scale=1.0)
    cell = b"".join(
        struct.pack("<II", kind, len(content)) + content
        for kind, content in ((6, struct.pack("<II", 1, 0)), (5, struct.pack("<ii", 1, 1)), (1, b""))
    )
    nested = b"".join(struct.pack("<II", 14, 48 * (8_000 - n) - 8) + cell for n in range(8_000))
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + nested)
    refused(r"a\.mat: .* 64 cells", read_point_tables, [path], scale=1.0)
    (tmp_path / "a.csv").write_bytes(b"1" * (2 << 20))
    refused(r"a\.csv: .* 1 MiB", read_point_tables, [tmp_path / "a.csv"])


def test_devices_and_folders_are_refused_before_opening(tmp_path):
    for name in ("pipe.png", "pipe.cine", "pipe.csv"):
        os.mkfifo(tmp_path / name)
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    (tmp_path / "self.png").symlink_to("self.png")
    (tmp_path / "folder.tif").mkdir()
    for name, found in (
        ("pipe.png", "pipe"),
        ("pipe.cine", "pipe"),
        ("zero.png", "device"),
        ("self.png", "symbolic"),  # the system's sentence
        ("folder.tif", "folder"),
        ("nul\0.png", "null"),
    ):
        refused(f": .*{found}", open_sequence, [tmp_path / name], error=FileNotFoundError)
    refused("pipe.png: .* pipe", read_image, tmp_path / "pipe.png", error=FileNotFoundError)
    refused("pipe.csv: .* pipe", read_point_tables, [tmp_path / "pipe.csv"], error=FileNotFoundError)
