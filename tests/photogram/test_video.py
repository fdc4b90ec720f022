"""Video files of cameras: every bit, times and exposures come back; what other programs wrote; damage is refused."""

from __future__ import annotations

import re
import struct
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from cine_factory import cine_bytes, write_cine, write_film
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from photogram.images import video
from photogram.images.image_files import open_sequence
from photogram.images.image_notices import COMPRESSED_VIDEO, EXPOSURE_VARIES, FILM_DECODED, ORIENTATION_NOT_APPLIED
from photogram.images.video import linear_12_of_10

RNG = np.random.default_rng(4)
GREY12 = RNG.integers(0, 4096, (5, 16, 24), dtype=np.uint16)


@pytest.mark.parametrize(("bits", "packing"), [(8, 0), (12, 0), (16, 0), (12, 1024)])
def test_cine_frames_come_back_with_their_times_and_exposure(tmp_path, bits, packing):
    frames = GREY12 >> 4 if bits == 8 else GREY12
    sequence = open_sequence([write_cine(tmp_path / "a.cine", frames, bits=bits, packing=packing)])
    assert (len(sequence), sequence.size_px, sequence.full_scale) == (5, (24, 16), 2**bits - 1)
    np.testing.assert_array_equal([sequence.read(n) for n in range(5)], frames)
    np.testing.assert_allclose(sequence.time_s, 0.01 * np.arange(5), atol=1e-9)
    assert sequence.exposure_s == pytest.approx(40e-6, abs=1e-9)


def test_codes_of_ten_bits_are_made_linear(tmp_path):
    codes = RNG.integers(0, 1024, (2, 16, 24))
    path = write_cine(tmp_path / "a.cine", codes, packing=256, codes=codes)
    sequence = open_sequence([path])
    assert sequence.full_scale == 4095
    np.testing.assert_array_equal(sequence.read(1), linear_12_of_10()[codes[1]])
    # published pairs of code and grey value: Vision Research's table, as printed by another reader
    codes = np.array([424, 624, 625, 609, 623, 214, 149, 220, 155, 219])
    grey = np.array([694, 1481, 1486, 1410, 1476, 223, 144, 232, 150, 230])
    assert np.abs(linear_12_of_10()[codes].astype(int) - grey).max() <= 1
    assert np.all(np.diff(linear_12_of_10().astype(int)) >= 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colours": 3}, "colour"),
        ({"packing": 256, "codes": GREY12 >> 2, "cut": 40}, "truncated"),
        ({"cut": 40}, "truncated"),
        ({"cut": 4000}, "damaged"),
        ({"start": b"XX"}, "readable"),
    ],
)
def test_other_cine_files_are_refused(tmp_path, change, message):
    cut, start = change.pop("cut", 0), change.pop("start", b"")
    data = cine_bytes(GREY12, **change)
    path = tmp_path / "a.cine"
    path.write_bytes((start + data[len(start) :])[: len(data) - cut])
    refused(f"a.cine: .*{message}", open_sequence, [path])


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 1400), st.integers(0, 255)), min_size=1, max_size=6))
def test_damaged_cine_files_are_refused_or_read(tmp_path_factory, changes):
    data = bytearray(cine_bytes(GREY12))
    for place, value in changes:
        data[place % len(data)] = value
    path = tmp_path_factory.getbasetemp() / "damaged.cine"
    path.write_bytes(data)
    try:
        sequence = open_sequence([path])
        for frame in range(min(len(sequence), 6)):
            sequence.read(frame)
        told = str(path)
    except (ValueError, OSError) as error:
        told = str(error)
    assert told.startswith(str(path))


def test_frames_written_by_phantom_cameras(data_dir):
    """Sums and first pixels as other programs read the same files (sources beside the files)."""
    folder = data_dir / "formats" / "cine"
    for name, frames, size, total, start, interval_s, exposure_s in (
        ("cine_781", 15, (256, 256), 176860542, [2921, 2921, 2949], 111.071e-6, 9.6965e-6),
        ("phantom_v12_raw_16bpp", 6, (256, 128), 35108484, [1217, 1190, 1126], 0.01, 9.9001e-3),
        ("phantom_v1610_16bpp", 6, (256, 128), 59171928, [1988, 1894, 1918], 0.01, 3e-3),
        ("phantom_v7_raw_16bpp", 6, (256, 128), 37746728, [1176, 1242, 1182], 0.0125, 11.999e-3),
        ("phantom_v1610", 6, (256, 128), 3682882, [124, 118, 119], 0.01, 3e-3),
        ("phantom_v9_raw_16bpp", 6, (256, 128), 1595766, [12, 10, 10], 3.3332e-3, 1e-3),
    ):
        sequence = open_sequence([folder / f"{name}.cine"])
        image = sequence.read(0)
        assert (len(sequence), sequence.size_px, int(image.sum(dtype=int))) == (frames, size, total)
        assert image[0, :3].tolist() == start
        assert np.median(np.diff(sequence.time_s)) == pytest.approx(interval_s, rel=1e-4)
        assert sequence.exposure_s == pytest.approx(exposure_s, rel=1e-4)
    packed = open_sequence([folder / "packed_12bpp.cine"]).read(0)
    # another program's stored result, 8-bit scale: first pixels and sum
    np.testing.assert_allclose(packed[0, :5].astype(float) * 255 / 4095, [43.216118] * 4 + [43.652016], atol=0.1)
    assert packed.sum(dtype=int) * 255 / 4095 == pytest.approx(1066350.0, rel=1e-3)
    broken = open_sequence([folder / "data_small_cine.cine"])
    assert np.diff(broken.time_s)[-1] > 1e7  # the last time stamp is wrong in the file
    (varies,) = (notice for notice in broken.notices if notice.code == EXPOSURE_VARIES.code)
    assert (varies.values["different"], varies.values["frames"]) == (1, 235)
    for name in ("invalid_color", "chart1"):
        refused("colour", open_sequence, [folder / f"{name}.cine"])


def test_frames_written_by_photron_cameras(data_dir):
    folder = data_dir / "formats" / "cihx"
    for name, frames, total, first, exposure_s, interval_s in (
        ("ball_12bit", 15, 7728115494, 515377976, 20e-6, 1 / 30000),
        ("beam", 4, 252377021, 62998095, 5e-6, 2500 / 50000),
    ):
        sequence = open_sequence([folder / f"{name}.cihx"])
        sums = [int(sequence.read(n).sum(dtype=int)) for n in range(len(sequence))]
        assert (len(sequence), sequence.full_scale, sum(sums), sums[0]) == (frames, 4095, total, first)
        assert (sequence.exposure_s, sequence.time_s[1]) == (exposure_s, pytest.approx(interval_s))


def test_pages_of_a_tiff_written_most_significant_byte_first(data_dir):
    sequence = open_sequence([data_dir / "formats" / "tiff" / "stuck.tif"])
    sums = [int(sequence.read(n).sum(dtype=int)) for n in range(len(sequence))]
    assert sums == [130733195, 131289601, 131357757, 131444718, 131612762]
    assert sequence.read(0)[0, :5].tolist() == [501, 502, 503, 509, 517]


def test_bitmaps_are_read_and_others_than_grey_refused(tmp_path):
    grey = (GREY12[0] >> 4).astype(np.uint8)
    for n in range(2):
        cv2.imwrite(str(tmp_path / f"{n}.bmp"), grey + np.uint8(n))
    sequence = open_sequence([tmp_path / f"{n}.bmp" for n in range(2)])
    np.testing.assert_array_equal(sequence.read(1), grey + np.uint8(1))
    cv2.imwrite(str(tmp_path / "colour.bmp"), np.zeros((16, 24, 3), np.uint8))
    refused("colour.bmp: .*24", open_sequence, [tmp_path / "colour.bmp"])
    (tmp_path / "cut.bmp").write_bytes((tmp_path / "0.bmp").read_bytes()[:-50])
    refused("cut.bmp: truncated", open_sequence, [tmp_path / "cut.bmp"])


@pytest.mark.parametrize(("suffix", "codec", "severity"), [(".avi", "MJPG", "warning"), (".avi", "FFV1", "note")])
def test_films_are_read_frame_by_frame_with_a_warning(tmp_path: Path, suffix: str, codec: str, severity: str):
    rng, path = np.random.default_rng(3), tmp_path / f"film{suffix}"
    smooth = [cv2.GaussianBlur(rng.uniform(0, 255, (64, 96)), (0, 0), 3) * 3 - 250 for _ in range(4)]
    frames = [np.clip(image, 0, 255).astype(np.uint8) for image in smooth]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 50.0, (96, 64), False)
    if not writer.isOpened():
        pytest.skip(f"OpenCV cannot write {codec} here")
    for image in frames:
        writer.write(image)
    writer.release()
    sequence = open_sequence([path])
    assert (len(sequence), sequence.size_px) == (4, (96, 64))
    for n in (2, 0, 3, 1):  # in any order
        worst = np.abs(sequence.read(n).astype(int) - frames[n]).mean()
        assert worst <= (3.0 if severity == "warning" else 0.5)
    expected = COMPRESSED_VIDEO if severity == "warning" else FILM_DECODED
    assert [(notice.code, notice.severity) for notice in sequence.notices] == [(expected.code, severity)]


def test_one_video_file_a_camera(tmp_path):
    paths = [write_cine(tmp_path / f"{n}.cine", GREY12) for n in range(2)]
    refused("0.cine: ", open_sequence, paths)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused("film.mp4: .*codec", open_sequence, [_junk(tmp_path / "film.mp4")])


def _junk(path: Path) -> Path:
    path.write_bytes(b"junk" * 100)
    return path


@pytest.mark.parametrize("suffix", ["mkv", "avi"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_films_keep_every_bit_that_is_stored(tmp_path, suffix, kind):
    frames = RNG.integers(0, np.iinfo(kind).max, (5, 48, 64), dtype=kind)
    sequence = open_sequence([write_film(tmp_path / f"a.{suffix}", frames)])
    assert sequence.full_scale == np.iinfo(kind).max
    for number in (3, 0, 4):
        np.testing.assert_array_equal(sequence.read(number), frames[number])


@pytest.mark.parametrize(
    ("tag", "bits"), [(b"Y1\0\x0c", 12), (b"Y3\x0b\x0a", 10), (b"\x10\x001Y", 16), (b"RGB\x30", 48), (b"RGB\x0f", 15)]
)
def test_depths_that_the_decoder_would_cut_to_8_bits_are_refused(tag, bits):
    """FFmpeg's tags of grey 12, YUV 4:2:0 10, grey 16 big-endian, RGB 48, and RGB 555."""
    refused(f"a.mkv: .* {bits} bits .*TIFF", video._pixel_bits, Path("a.mkv"), tag)
    assert [video._pixel_bits(Path("a.mkv"), tag) for tag in (b"Y800", b"I420", b"BGR\0", b"RGB\x18", b"Y1\0\x10")] == [
        8, 8, 8, 8, 16,
    ]  # fmt: skip


def test_missing_frames_of_a_film_are_found_by_its_time_stamps(tmp_path):
    """Matroska: a block's time is 2 bytes in ms after its track, here 40 ms later from frame 3."""
    path = write_film(tmp_path / "a.mkv", RNG.integers(0, 255, (6, 48, 64), dtype=np.uint8))
    assert open_sequence([path]).numbers.missing == ""
    data = path.read_bytes()
    for number in range(5, 2, -1):
        old, new = (b"\x81" + struct.pack(">h", 40 * n) for n in (number, number + 1))
        places = [found.start() for found in re.finditer(re.escape(old), data)]
        assert len(places) == 1
        data = data.replace(old, new)
    path.write_bytes(data)
    counted = open_sequence([path]).numbers
    assert (counted.frame_index.tolist(), counted.missing) == ([0, 1, 2, 4, 5, 6], "1 between 0.08 s and 0.16 s")


@pytest.mark.parametrize(("matrix", "tag"), [((0, 1, -1, 0), 6), ((-1, 0, 0, -1), 3), ((0, -1, 1, 0), 8)])
def test_a_film_is_not_rotated_for_display(tmp_path, matrix, tag):
    """ISO 14496-12: the matrix a b u c d v x y w of the track's header, of 16.16 numbers, rotates what is shown."""
    smooth = cv2.GaussianBlur(RNG.uniform(0, 255, (48, 64)), (0, 0), 4).astype(np.uint8)
    path = write_film(tmp_path / "a.mp4", np.stack([smooth] * 3), "mp4v")
    before = open_sequence([path])
    plain = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    head, _, tail = path.read_bytes().rpartition(plain)
    a, b, c, d = (value << 16 for value in matrix)
    path.write_bytes(head + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + tail)
    sequence = open_sequence([path])
    assert sequence.size_px == (64, 48)
    np.testing.assert_array_equal(sequence.read(1), before.read(1))
    assert [notice.values["tag"] for notice in sequence.notices if notice.code == ORIENTATION_NOT_APPLIED.code] == [tag]
