"""Images come back with every bit, and a wrong file is named in one sentence."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from contracts import refused

from photogram.images.image_files import open_sequence
from photogram.images.noise import NoiseModel, fit_noise_model
from photogram.images.sequence import FRAMES_AHEAD, ImageSequence
from photogram.point_tables import read_point_tables
from photogram.synthetic.scene import ImageSensor


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
        **{"Total Frame": frames, "Image Width": 64, "Image Height": 48, "Color Type": "Mono", "Color Bit": bits},
        **{"File Format": "MRaw", "EffectiveBit Depth": 12, "EffectiveBit Side": "Lower"},
        **{key.replace("_", " "): value for key, value in other.items()},
    }
    header = folder / "video.cih"
    header.write_text("#Camera Information Header\n" + "\n".join(f"{key} : {value}" for key, value in entries.items()))
    (folder / "video.mraw").write_bytes(data)
    return header


def test_twelve_bits_survive_every_container(tmp_path, grey12):
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


def frames_of(sequence: ImageSequence) -> np.ndarray:
    return np.stack([sequence.read(frame) for frame in range(len(sequence))])


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("options", [{"rowsperstrip": 7}, {"predictor": True}, {"tile": (16, 16)}])
def test_deflated_parts_of_every_kind_are_the_image(byteorder, kind, options, tmp_path):
    """Strips of which the last is shorter, differences instead of values, tiles, either order of bytes."""
    picture = np.random.default_rng(5).integers(0, np.iinfo(kind).max, (45, 64)).astype(kind)
    tifffile.imwrite(tmp_path / "image.tif", picture, byteorder=byteorder, compression="zlib", **options)
    read = open_sequence([tmp_path / "image.tif"]).read(0)
    np.testing.assert_array_equal(read, picture)
    assert (read.dtype, read.flags.writeable) == (np.dtype(kind), True)  # kernels are compiled for such arrays


def test_images_are_read_ahead_in_turn_until_the_reader_stops():
    asked = []

    def read(index):
        asked.append(index)
        if index == 6:
            raise ValueError("frame 6: damaged")
        return np.full((4, 5), index, np.uint8)

    images = ImageSequence(tuple(f"frame {k}" for k in range(50)), (5, 4), 255, read)
    ahead = images.read_ahead(range(2, 50))
    assert [int(next(ahead)[0, 0]) for _ in range(3)] == [2, 3, 4]
    ahead.close()
    assert asked == list(range(2, 2 + len(asked)))
    assert len(asked) <= 3 + FRAMES_AHEAD
    seen = []
    with pytest.raises(ValueError, match="frame 6"):
        seen.extend(int(image[0, 0]) for image in images.read_ahead(range(4, 50)))
    assert seen == [4, 5]
    assert [int(image[0, 0]) for image in images.read_ahead((9, 3, 30))] == [9, 3, 30]
    assert list(images.read_ahead(())) == []


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
def test_pages_of_one_file_are_frames(tmp_path, grey12, options):
    stack = np.stack([grey12, grey12[::-1], grey12[:, ::-1]])
    tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack", **options)
    np.testing.assert_array_equal(frames_of(open_sequence([tmp_path / "stack.tif"], bit_depth=12)), stack)


@pytest.mark.parametrize(("kind", "full_scale"), [(np.uint8, 255), (np.uint16, 65535)])
def test_files_are_frames_in_the_order_given_and_their_type_is_their_depth(tmp_path, kind, full_scale):
    paths, grey = [tmp_path / "b.png", tmp_path / "a.png"], np.full((48, 64), 200, kind)
    for shift, path in enumerate(paths):
        cv2.imwrite(str(path), grey + shift)
    sequence = open_sequence(paths)
    assert (sequence.names, sequence.full_scale) == (tuple(map(str, paths)), full_scale)
    np.testing.assert_array_equal(frames_of(sequence), [grey, grey + 1])


def test_high_speed_video_in_8_12_and_16_bits_and_its_xml_header(tmp_path, grey12):
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
        np.testing.assert_array_equal(frames_of(sequence), truth)
    write_cih(tmp_path, pack_12(grey12), 12, 1)
    (tmp_path / "video.cihx").write_text(
        "binary\n<cih><frameInfo><totalFrame>1</totalFrame></frameInfo><imageDataInfo><resolution><width>64</width>"
        "<height>48</height></resolution><effectiveBit><depth>12</depth><side>Lower</side></effectiveBit><colorInfo>"
        "<type>Mono</type><bit>12</bit></colorInfo></imageDataInfo><imageFileInfo><fileFormat>MRaw</fileFormat>"
        "</imageFileInfo></cih>\nmore"
    )
    np.testing.assert_array_equal(open_sequence([tmp_path / "video.cihx"]).read(0), grey12)


@pytest.mark.parametrize("suffix", ["tif", "png"])
@pytest.mark.parametrize("compression", ["none", "zlib"])
def test_truncated_files_are_refused(tmp_path, grey12, suffix, compression):
    path = tmp_path / f"cut.{suffix}"
    if suffix == "tif":
        tifffile.imwrite(path, grey12, compression=compression)
    else:
        cv2.imwrite(str(path), grey12)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refused(rf"cut.{suffix}: truncated", open_sequence, [path], error=(ValueError, OSError))


def test_damaged_pixels_are_named_when_read(tmp_path, grey12):
    path = tmp_path / "bad.tif"
    tifffile.imwrite(path, grey12, compression="zlib")
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        start = tiff.pages[0].dataoffsets[0]
    data[start : start + 40] = bytes(40)
    path.write_bytes(bytes(data))
    refused(r"bad.tif: .*TIFF", open_sequence([path]).read, 0)


def test_wrong_files_are_named(tmp_path, grey12):
    colour = np.zeros((48, 64, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "colour.png"), colour)
    tifffile.imwrite(tmp_path / "colour.tif", colour, photometric="rgb")
    stack = np.stack([grey12, grey12])
    pictures = {"float": grey12.astype(np.float32), "first": grey12, "small": grey12[:-1], "shifted": grey12 << 4}
    for name, pixels in {**pictures, "shallow": grey12.astype(np.uint8), "stack": stack}.items():
        tifffile.imwrite(tmp_path / f"{name}.tif", pixels, photometric="minisblack")
    for name in ("junk.tif", "junk.png", "film.avi", "film.gif"):
        (tmp_path / name).write_bytes(b"junk" * 50)
    write_cih(tmp_path, pack_12(grey12), 12, 2)
    for names, depth, message in (
        (["colour.png"], None, "colour.png: .*colour"),
        (["colour.tif"], None, "colour.tif: .*RGB"),
        (["float.tif"], None, "float.tif: .* 32 "),
        (["first.tif", "small.tif"], None, "small.tif: .* 64 x 48 .* 64 x 47"),
        (["first.tif", "shallow.tif"], None, "shallow.tif: .* 16 bits .* 8"),
        (["first.tif", "stack.tif"], None, "stack.tif: .* 2 pages"),
        (["junk.tif"], None, "junk.tif: .*TIFF"),
        (["junk.png"], None, "junk.png: .*PNG"),
        (["film.avi"], None, "film.avi: .*codec"),
        (["film.gif"], None, "film.gif: .* .tif"),
        (["absent.tif"], None, "absent.tif: "),
        (["shallow.tif"], 12, "shallow.tif: .* 12, .* 8 bits"),
        (["shifted.tif"], 12, r"shifted.tif: .* 4095 \(bit depth 12\)"),
        (["video.cih"], None, "video.mraw: truncated, .* 9216 bytes .* 2 frames, .* 4608"),
        ([], None, "^paths: "),
    ):
        with pytest.raises((ValueError, OSError), match=message) as caught:
            open_sequence([tmp_path / name for name in names], bit_depth=depth).read(0)
        assert "\n" not in str(caught.value)


def test_a_frame_with_more_than_a_share_of_its_pixels_at_full_scale_is_refused():
    image = np.zeros((10, 10), np.uint16)
    image[:2] = 4095
    frames = ImageSequence(("f",), (10, 10), 4095, lambda _: image)
    assert replace(frames, most_saturated=0.2).read(0) is image
    refused("f: .* 20.0 %", replace(frames, most_saturated=0.19).read, 0)


def test_real_video_has_75_frames(data_dir):
    sequence = open_sequence([data_dir / "undersampled_video" / "data_showcase.cih"])
    assert (len(sequence), sequence.size_px, sequence.full_scale) == (75, (640, 40), 255)
    assert sequence.read(74).std() > 10


# The noise model against the simulated sensor, whose noise is written down in its class.

SENSOR = ImageSensor(bit_depth=12, electrons_per_grey=8.0, read_noise_grey=6.0)


def residuals(seed: int, low: float = 0.03, high: float = 0.85, count: int = 200_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(low, high, count)
    stored = SENSOR.digitise(truth, rng).astype(float)
    return truth * SENSOR.full_scale, (stored - truth * SENSOR.full_scale) ** 2


def test_read_and_shot_noise_come_back_without_bias():
    model = fit_noise_model(*residuals(1))
    assert model.read_variance_grey2 == pytest.approx(36.0 + 1 / 12, rel=0.05)
    assert model.variance_per_grey == pytest.approx(1 / 8, rel=0.02)
    grey = np.array([[100.0, 1000.0], [2000.0, 3500.0]])
    np.testing.assert_allclose(model.variance(grey), SENSOR.variance(grey), rtol=0.02)
    grey = np.array([300.0, 3000.0])
    # Small samples: relative weights taken from the scattering bins would pull the mean down by 2·2/125.
    ratio = [fit_noise_model(*residuals(seed, count=4000)).variance(grey) / SENSOR.variance(grey) for seed in range(60)]
    np.testing.assert_allclose(np.mean(ratio, axis=0), 1.0, atol=0.02)


def test_outliers_are_not_noise():
    grey, squares = residuals(2)
    wrong = np.random.default_rng(3).random(len(squares)) < 0.02
    model = fit_noise_model(grey, np.where(wrong, 300.0**2, squares))
    levels = np.array([200.0, 3000.0])
    np.testing.assert_allclose(model.variance(levels), SENSOR.variance(levels), rtol=0.06)


def test_equal_brightness_gives_a_constant():
    model = fit_noise_model(*residuals(4, 0.50, 0.52))
    assert model.variance_per_grey == 0.0
    assert model.read_variance_grey2 == pytest.approx(float(SENSOR.variance(np.array(0.51 * 4095))), rel=0.02)
    refused("^residual_grey2: ", fit_noise_model, np.zeros(100), np.zeros(99))
    refused("^grey: .* 50 ", fit_noise_model, np.full(100, np.nan), np.zeros(100))
    refused("^variance_per_grey: ", NoiseModel, 1.0, -1.0)
    grey, _ = residuals(5)  # noise-free images keep their rounding
    np.testing.assert_array_equal(fit_noise_model(grey, np.zeros_like(grey)).variance(grey[:3]), 1 / 12)
    np.testing.assert_array_equal(NoiseModel(4.0, 0.0).variance(np.array([-5.0, 5.0])), 4.0)


# Tables of other programs: layout of the published PTB data set, csv with a column frame, and wrong files.

PTB = ["id_x", "id_y", "status", "status", "status", "x0", "y0", "z0", "x", "y", "z"]


def ptb_row(x: int, y: int, point: np.ndarray, moved: np.ndarray, status: str = "3 3 3") -> str:
    return f"{x} {y} {status} " + " ".join(f"{value:.6f}" for value in (*point, *moved))


def test_ptb_layout_with_millimetres_and_error_codes(tmp_path):
    rng = np.random.default_rng(2)
    points = rng.uniform(-50, 50, (3, 3))
    keys = [(4, 7), (4, 8), (5, 7)]
    files = []
    for frame in range(3):
        rows = [ptb_row(*key, point, point + frame) for key, point in zip(keys, points, strict=True)]
        if frame == 1:
            rows[1] = ptb_row(*keys[1], points[1], points[1] + 99, status="3 4 3")
        if frame == 2:
            rows = rows[::-1][:2]
        files.append(tmp_path / f"result_A{frame}.txt")
        files[-1].write_text("\n".join(rows) + "\n")
    table = read_point_tables(files, PTB, valid_status=3, scale=1e-3)
    assert table.position_m.shape == (3, 3, 3)
    np.testing.assert_allclose(table.reference_m, points * 1e-3, atol=1e-9)
    np.testing.assert_allclose(table.position_m[2, 1:], (points[1:] + 2) * 1e-3, atol=1e-9)
    assert np.argwhere(np.isnan(table.position_m).all(axis=2)).tolist() == [[1, 1], [2, 0]]
    assert table.frames[1].endswith("result_A1.txt")


@pytest.mark.parametrize("separator", [",", ";", "\t", "  "])
def test_one_table_with_a_column_frame(tmp_path, separator):
    rows = [["frame", "point", "x", "y", "z"]]
    rows += [
        [str(frame), str(n), f"{n}.5", str(frame), "nan" if n == 2 else "1e-1"] for n in range(3) for frame in (0, 1)
    ]
    decimal = (lambda text: text.replace(".", ",")) if separator == ";" else str
    path = tmp_path / "points.csv"
    path.write_text("\n".join(separator.join(decimal(field) for field in row) for row in rows))
    table = read_point_tables([path], ["frame", "id", "x", "y", "z"])
    assert table.reference_m is None
    assert table.frames == ("frame 0", "frame 1")
    np.testing.assert_allclose(table.position_m[1, :2], [[0.5, 1.0, 0.1], [1.5, 1.0, 0.1]])
    assert np.isnan(table.position_m[:, 2]).all()


def test_rows_are_points_where_there_is_no_identity(tmp_path):
    paths = [tmp_path / "a.txt", tmp_path / "b.txt"]
    paths[0].write_text("1 2 3 8\n4 5 6 8\n")
    paths[1].write_text("# comment\n1 2 4 8\n\n4 5 7 8\n")
    table = read_point_tables(paths, ["x", "y", "z", "_"])
    np.testing.assert_allclose(table.position_m[1] - table.position_m[0], [[0, 0, 1], [0, 0, 1]])


@pytest.mark.parametrize(
    ("text", "columns", "message"),
    [
        ("1 2 3\n4 5\n", ["x", "y", "z"], r"t.txt: line 2: .* 3 columns, .* 2"),
        ("1 2 3\n4 oops 6\n", ["x", "y", "z"], r"t.txt: line 2, column 2: .*'oops'"),
        ("x y z\n", ["x", "y", "z"], r"t.txt: .* 3 numbers"),
        ("1 1 2 3\n1 1 2 3\n", ["id", "x", "y", "z"], r"t.txt: .*identity"),
        ("1 2 3\n", ["x", "y", "_"], r"^columns: .*x y z, .*x y"),
        ("1 2 3\n", ["x", "y", "depth"], r"^columns: .*'depth'"),
        ("1 2 3 4\n", ["x", "y", "z", "x"], r"^columns: .* x .* 2 "),
        ("1 2 3 4\n", ["x", "y", "z", "x0"], r"^columns: .*x0 y0 z0, .*x0"),
    ],
)
def test_wrong_tables_are_named(tmp_path, text, columns, message):
    path = tmp_path / "t.txt"
    path.write_text(text)
    refused(message, read_point_tables, [path], columns)


def test_tables_of_unequal_length_are_named(tmp_path):
    for name, text in (("a.txt", "1 2 3\n"), ("b.txt", "1 2 3\n4 5 6\n")):
        (tmp_path / name).write_text(text)
    a, b, c = (tmp_path / f"{name}.txt" for name in "abc")
    refused(r"c.txt: ", read_point_tables, [c], ["x", "y", "z"], error=OSError)
    refused(r"b.txt: .* 1 rows .*a.txt, .* 2", read_point_tables, [a, b], ["x", "y", "z"])
    refused(r"^files: ", read_point_tables, [], ["x", "y", "z"])
