"""Images come back with every bit, and a wrong file is named in one sentence."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from photogram.images import open_sequence, saturated_fraction


@pytest.fixture
def grey12() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 4096, (48, 64), dtype=np.uint16)


def pack_12(values: np.ndarray) -> bytes:
    """Big-endian bit stream, written with Python integers and therefore independent of the reader."""
    bits = "".join(f"{int(value):012b}" for value in values.ravel())
    return int(bits, 2).to_bytes(len(bits) // 8, "big")


def write_packed_tiff(path: Path, values: np.ndarray) -> None:
    """A minimal TIFF with 12 bits per sample, from the TIFF 6.0 specification."""
    data, (height, width) = pack_12(values), values.shape
    entries = [(256, width), (257, height), (258, 12), (259, 1), (262, 1), (273, 0), (277, 1), (278, height), (279, 0)]
    start = 8 + 2 + 12 * len(entries) + 4
    longs = {273: start, 279: len(data)}
    directory = b"".join(
        struct.pack("<HHII", tag, 4, 1, longs[tag]) if tag in longs else struct.pack("<HHIHH", tag, 3, 1, value, 0)
        for tag, value in entries
    )
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + b"\0\0\0\0" + data)


def write_cih(folder: Path, data: bytes, bits: int, frames: int, **other: object) -> Path:
    entries = {
        "Total Frame": frames,
        "Image Width": 64,
        "Image Height": 48,
        "Color Type": "Mono",
        "Color Bit": bits,
        "File Format": "MRaw",
        "EffectiveBit Depth": 12,
        "EffectiveBit Side": "Lower",
    }
    entries |= {key.replace("_", " "): value for key, value in other.items()}
    header = folder / "video.cih"
    header.write_text("#Camera Information Header\n" + "\n".join(f"{key} : {value}" for key, value in entries.items()))
    (folder / "video.mraw").write_bytes(data)
    return header


def test_twelve_bits_survive_every_container(tmp_path: Path, grey12: np.ndarray) -> None:
    cv2.imwrite(str(tmp_path / "lzw.tif"), grey12)
    tifffile.imwrite(tmp_path / "plain.tif", grey12)
    tifffile.imwrite(tmp_path / "zlib.tiff", grey12, compression="zlib", predictor=True)
    cv2.imwrite(str(tmp_path / "image.png"), grey12)
    write_packed_tiff(tmp_path / "packed.tif", grey12)
    for name in ("lzw.tif", "plain.tif", "zlib.tiff", "image.png", "packed.tif"):
        sequence = open_sequence([tmp_path / name], bit_depth=12)
        assert sequence.full_scale == 4095
        assert sequence.size_px == (64, 48)
        np.testing.assert_array_equal(sequence.read(0), grey12, err_msg=name)


def test_bit_depth_follows_the_stored_type(tmp_path: Path, grey12: np.ndarray) -> None:
    tifffile.imwrite(tmp_path / "a.tif", (grey12 >> 4).astype(np.uint8))
    tifffile.imwrite(tmp_path / "b.tif", grey12)
    assert open_sequence([tmp_path / "a.tif"]).full_scale == 255
    assert open_sequence([tmp_path / "b.tif"]).full_scale == 65535


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
def test_pages_of_one_file_are_frames(tmp_path: Path, grey12: np.ndarray, options: dict[str, str]) -> None:
    stack = np.stack([grey12, grey12[::-1], grey12[:, ::-1]])
    tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack", **options)
    sequence = open_sequence([tmp_path / "stack.tif"], bit_depth=12)
    assert len(sequence) == 3
    np.testing.assert_array_equal(np.stack([sequence.read(frame) for frame in range(3)]), stack)


def test_files_are_frames_in_the_order_given(tmp_path: Path, grey12: np.ndarray) -> None:
    paths = [tmp_path / "b.png", tmp_path / "a.png"]
    for shift, path in enumerate(paths):
        cv2.imwrite(str(path), grey12 + shift)
    sequence = open_sequence(paths)
    assert len(sequence) == 2
    assert [name.endswith(("b.png", "a.png")[index]) for index, name in enumerate(sequence.names)] == [True, True]
    np.testing.assert_array_equal(sequence.read(1), grey12 + 1)


def test_high_speed_video_in_8_12_and_16_bits(tmp_path: Path, grey12: np.ndarray) -> None:
    stack = np.stack([grey12, grey12[::-1]])
    low = (stack >> 4).astype(np.uint8)
    cases = [
        (low.tobytes(), 8, {}, low, 255),
        (pack_12(stack), 12, {}, stack, 4095),
        (stack.astype("<u2").tobytes(), 16, {}, stack, 4095),
        ((stack << 4).astype("<u2").tobytes(), 16, {"EffectiveBit_Side": "Higher"}, stack, 4095),
    ]
    for data, bits, other, truth, full_scale in cases:
        sequence = open_sequence([write_cih(tmp_path, data, bits, 2, **other)])
        assert (len(sequence), sequence.full_scale) == (2, full_scale)
        np.testing.assert_array_equal(np.stack([sequence.read(frame) for frame in range(2)]), truth)


def test_the_xml_header_says_the_same(tmp_path: Path, grey12: np.ndarray) -> None:
    write_cih(tmp_path, pack_12(grey12), 12, 1)
    (tmp_path / "video.cihx").write_text(
        "binary\n<cih><frameInfo><totalFrame>1</totalFrame></frameInfo><imageDataInfo><resolution><width>64</width>"
        "<height>48</height></resolution><effectiveBit><depth>12</depth><side>Lower</side></effectiveBit><colorInfo>"
        "<type>Mono</type><bit>12</bit></colorInfo></imageDataInfo><imageFileInfo><fileFormat>MRaw</fileFormat>"
        "</imageFileInfo></cih>\nmore"
    )
    np.testing.assert_array_equal(open_sequence([tmp_path / "video.cihx"]).read(0), grey12)


def test_grey_values_beyond_the_bit_depth_are_refused(tmp_path: Path, grey12: np.ndarray) -> None:
    tifffile.imwrite(tmp_path / "shifted.tif", grey12 << 4)
    with pytest.raises(ValueError, match=r"shifted.tif: expected grey values up to 4095 \(bit depth 12\)"):
        open_sequence([tmp_path / "shifted.tif"], bit_depth=12).read(0)


def test_eight_bit_files_are_no_twelve_bit_images(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "low.tif", np.zeros((8, 9), np.uint8))
    with pytest.raises(ValueError, match=r"low.tif: expected images of bit depth 12, found 8 bits"):
        open_sequence([tmp_path / "low.tif"], bit_depth=12)


@pytest.mark.parametrize("suffix", ["tif", "png"])
@pytest.mark.parametrize("compression", ["none", "zlib"])
def test_truncated_files_are_refused(tmp_path: Path, grey12: np.ndarray, suffix: str, compression: str) -> None:
    path = tmp_path / f"cut.{suffix}"
    if suffix == "tif":
        tifffile.imwrite(path, grey12, compression=compression)
    else:
        cv2.imwrite(str(path), grey12)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises((ValueError, OSError), match=rf"cut.{suffix}: truncated"):
        open_sequence([path])


def test_truncated_video_is_refused(tmp_path: Path, grey12: np.ndarray) -> None:
    header = write_cih(tmp_path, pack_12(grey12), 12, 2)
    with pytest.raises(ValueError, match=r"video.mraw: truncated, expected 9216 bytes for 2 frames, found 4608"):
        open_sequence([header])


def test_damaged_pixels_are_named_when_read(tmp_path: Path, grey12: np.ndarray) -> None:
    path = tmp_path / "bad.tif"
    tifffile.imwrite(path, grey12, compression="zlib")
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        start = tiff.pages[0].dataoffsets[0]
    data[start : start + 40] = bytes(40)
    path.write_bytes(bytes(data))
    with pytest.raises(ValueError, match=r"bad.tif: not a readable TIFF file"):
        open_sequence([path]).read(0)


def test_wrong_files_are_named(tmp_path: Path, grey12: np.ndarray) -> None:
    colour = np.zeros((48, 64, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "colour.png"), colour)
    tifffile.imwrite(tmp_path / "colour.tif", colour, photometric="rgb")
    tifffile.imwrite(tmp_path / "float.tif", grey12.astype(np.float32))
    tifffile.imwrite(tmp_path / "first.tif", grey12)
    tifffile.imwrite(tmp_path / "small.tif", grey12[:-1])
    tifffile.imwrite(tmp_path / "shallow.tif", grey12.astype(np.uint8))
    tifffile.imwrite(tmp_path / "stack.tif", np.stack([grey12, grey12]), photometric="minisblack")
    (tmp_path / "junk.tif").write_bytes(b"junk" * 50)
    (tmp_path / "junk.png").write_bytes(b"junk" * 50)
    (tmp_path / "film.avi").write_bytes(b"junk" * 50)
    cases = [
        (["colour.png"], "colour.png: expected a grey image, found colour"),
        (["colour.tif"], "colour.tif: expected a grey image"),
        (["float.tif"], "float.tif: expected 8, 12 or 16 bits per pixel"),
        (["first.tif", "small.tif"], "small.tif: expected 64 x 48 px, found 64 x 47"),
        (["first.tif", "shallow.tif"], "shallow.tif: expected 16 bits per pixel, found 8"),
        (["first.tif", "stack.tif"], "stack.tif: expected one image per file, found 2 pages"),
        (["junk.tif"], "junk.tif: not a readable TIFF file"),
        (["junk.png"], "junk.png: not a readable PNG file"),
        (["film.avi"], "film.avi: expected a .tif"),
        (["absent.tif"], "absent.tif: no such file"),
    ]
    for names, message in cases:
        with pytest.raises((ValueError, OSError), match=message) as caught:
            open_sequence([tmp_path / name for name in names])
        assert "\n" not in str(caught.value)


def test_an_empty_list_is_refused() -> None:
    with pytest.raises(ValueError, match="paths: expected at least one image file"):
        open_sequence([])


def test_saturated_fraction_counts_inside_the_area() -> None:
    image = np.zeros((10, 10), np.uint16)
    image[:2] = 4095
    left = np.zeros((10, 10), bool)
    left[:4, :5] = True
    assert saturated_fraction(image, 4095) == pytest.approx(0.2)
    assert saturated_fraction(image, 4095, left) == pytest.approx(0.5)


def test_real_video_has_75_frames(data_dir: Path) -> None:
    sequence = open_sequence([data_dir / "undersampled_video" / "data_showcase.cih"])
    assert (len(sequence), sequence.size_px, sequence.full_scale) == (75, (640, 40), 255)
    assert sequence.read(74).std() > 10
