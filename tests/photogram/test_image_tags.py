"""What image files state about their pixels: orientation, white or black at 0, how many images a directory has."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from cine_factory import write_cine, write_film
from contracts import refused

from photogram.images.image_files import open_sequence, read_image
from photogram.images.image_notices import ORIENTATION_NOT_APPLIED
from photogram.images.sequence import find_copied_frames
from photogram.images.tiff import read_orientations, tag_notices

RNG = np.random.default_rng(8)
GREY = RNG.integers(0, 1000, (12, 18), dtype=np.uint16)
STACK = RNG.integers(0, 60000, (5, 12, 18), dtype=np.uint16)


def exif(tag: int, order: str) -> bytes:
    """An EXIF block with one entry, tag 274, from the EXIF 2.3 specification."""
    head = {"<": b"II*\0", ">": b"MM\0*"}[order]
    return head + struct.pack(f"{order}IHHHIHHI", 8, 1, 274, 3, 1, tag, 0, 0)


def write_turned(path: Path, grey: np.ndarray, tag: int) -> Path:
    """A picture whose tag says how it is to be turned for display, its pixels as they are."""
    if path.suffix == ".tif":
        options = {"compression": "zlib"} if "zlib" in path.stem else {}
        big = "big" in path.stem
        kinds = {"photometric": "minisblack", "metadata": None, "bigtiff": big, "byteorder": ">" if big else "<"}
        tifffile.imwrite(path, grey, extratags=[(274, "H", 1, tag, True)], **kinds, **options)
    else:
        data = cv2.imencode(path.suffix, grey)[1].tobytes()
        block = exif(tag, "<" if tag % 2 else ">")
        if path.suffix == ".png":
            chunk = struct.pack(">I", len(block)) + b"eXIf" + block + struct.pack(">I", zlib.crc32(b"eXIf" + block))
            data = data[:33] + chunk + data[33:]
        else:
            data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 8) + b"Exif\0\0" + block + data[2:]
        path.write_bytes(data)
    return path


def write_lzw(path: Path, grey: np.ndarray, tag: int) -> Path:
    """A TIFF file with LZW, by OpenCV; its resolution unit (tag 296) is made the orientation."""
    cv2.imwrite(str(path), grey, [cv2.IMWRITE_TIFF_COMPRESSION, 5, cv2.IMWRITE_TIFF_RESUNIT, 2])
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        own = tiff.pages[0].tags[274] if 274 in tiff.pages[0].tags else tiff.pages[0].tags[296]
        struct.pack_into("<HHIH", data, own.offset, 274, 3, 1, tag)
    path.write_bytes(data)
    return path


TURNED = ["plain.tif", "zlib.tif", "big.tif", "grey.png", "grey.jpg"]


@pytest.mark.parametrize("tag", [3, 6, 8])
@pytest.mark.parametrize("name", TURNED)
def test_pixels_are_those_of_the_sensor_for_any_tag(tmp_path, name, tag):
    """Recordings and calibrations see the same pixels, and both say so."""
    grey = (GREY >> 4).astype(np.uint8) if name.endswith("jpg") else GREY
    path = write_turned(tmp_path / name, grey, tag)
    seen = read_image(path)[0]
    if name.endswith("jpg"):  # which no recording takes
        assert seen.shape == grey.shape
        np.testing.assert_array_equal(seen, cv2.imdecode(cv2.imencode(".jpg", grey)[1], cv2.IMREAD_UNCHANGED))
    else:
        np.testing.assert_array_equal(seen, grey)
        sequence = open_sequence([path])
        np.testing.assert_array_equal(sequence.read(0), grey)
        assert [(notice.code, notice.values["tag"]) for notice in sequence.notices] == [
            (ORIENTATION_NOT_APPLIED.code, tag)
        ]
    (notice,) = tag_notices(read_orientations([path, tmp_path / "absent.tif"]))
    assert (notice.code, notice.values["tag"]) == (ORIENTATION_NOT_APPLIED.code, tag)


@pytest.mark.parametrize("tag", [1, 3, 8])
def test_pixels_decoded_by_opencv_are_not_rotated(tmp_path, tag):
    path = write_lzw(tmp_path / "lzw.tif", GREY, tag)
    np.testing.assert_array_equal(open_sequence([path]).read(0), GREY)
    np.testing.assert_array_equal(read_image(path)[0], GREY)
    assert len(open_sequence([path]).notices) == (tag != 1)


@pytest.mark.parametrize("tag", [2, 4, 5, 7])
@pytest.mark.parametrize("name", TURNED)
def test_mirrored_pixels_are_refused(tmp_path, name, tag):
    path = write_turned(tmp_path / name, (GREY >> 4).astype(np.uint8), tag)
    refused(f"{name}: .* {tag} .mirrored", read_image, path)
    if not name.endswith("jpg"):
        refused(f"{name}: .* {tag} .mirrored", open_sequence, [path])


@pytest.mark.parametrize("tag", [0, 1, 9])
def test_a_tag_without_rotation_gives_no_notice(tmp_path, tag):
    for name in TURNED:
        path = write_turned(tmp_path / name, (GREY >> 4).astype(np.uint8), tag)
        assert not tag_notices(read_orientations([path]))
        read_image(path)


def frames_of(path: Path) -> np.ndarray:
    sequence = open_sequence([path])
    return np.stack([sequence.read(frame) for frame in range(len(sequence))])


def one_directory(path: Path, stack: np.ndarray, description: str, order: str = ">") -> Path:
    """The first directory of a file and the pixels of all images behind it, as ImageJ writes them beyond 4 GB."""
    text = description.encode() + b"\0"
    entries = [(256, stack.shape[2]), (257, stack.shape[1]), (258, 8 * stack.itemsize), (259, 1), (262, 1)]
    entries += [(270, len(text)), (273, 0), (277, 1), (278, stack.shape[1]), (279, stack[0].nbytes)]
    after = 8 + 2 + 12 * len(entries) + 4
    rows = []
    for tag, value in entries:
        kind, count = (2, len(text)) if tag == 270 else (4, 1)
        held = {270: after, 273: after + len(text)}.get(tag, value)
        if tag in (258, 259, 262, 277):
            rows.append(struct.pack(f"{order}HHIHH", tag, 3, 1, held, 0))
        else:
            rows.append(struct.pack(f"{order}HHII", tag, kind, count, held))
    magic = {">": b"MM\0*", "<": b"II*\0"}[order] + struct.pack(f"{order}IH", 8, len(entries))
    pixels = stack.astype(stack.dtype.newbyteorder(order)).tobytes()
    path.write_bytes(magic + b"".join(rows) + bytes(4) + text + pixels)
    return path


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("axes", ["slices=5", "channels=5\nhyperstack=true", "frames=5\nhyperstack=true", ""])
def test_all_images_of_a_stack_with_one_directory_are_frames(tmp_path, order, kind, axes):
    stack = (STACK if kind == np.uint16 else STACK >> 8).astype(kind)
    path = one_directory(tmp_path / "stack.tif", stack, f"ImageJ=1.53t\nimages=5\n{axes}\n", order)
    np.testing.assert_array_equal(frames_of(path), stack)
    refused("stack.tif: .*stack of 5", read_image, path)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("imagej.tif", {"imagej": True}),
        ("one.tif", {"truncate": True, "contiguous": True, "photometric": "minisblack"}),
        ("series.ome.tif", {"metadata": {"axes": "TYX"}, "photometric": "minisblack"}),
        ("big.tif", {"bigtiff": True, "photometric": "minisblack", "tile": (16, 16)}),
    ],
)
def test_stacks_of_every_program_are_frames(tmp_path, name, options):
    tifffile.imwrite(tmp_path / name, STACK, **options)
    np.testing.assert_array_equal(frames_of(tmp_path / name), STACK)


def test_stacks_that_are_no_series_of_images_are_named(tmp_path):
    six = np.stack([*STACK, STACK[0]])
    head = "ImageJ=1.53t\nimages=6\n"
    whole = one_directory(tmp_path / "cut.tif", six, head).read_bytes()
    (tmp_path / "cut.tif").write_bytes(whole[: -STACK[0].nbytes])
    one_directory(tmp_path / "colours.tif", six, head + "channels=2\nframes=3\nhyperstack=true\n")
    tifffile.imwrite(tmp_path / "both.ome.tif", six.reshape(3, 2, 12, 18), metadata={"axes": "TCYX"})
    tifffile.imwrite(tmp_path / "rgb.tif", np.zeros((3, 12, 18), np.uint8), photometric="rgb", planarconfig="separate")
    for name, message in (
        ("cut.tif", "truncated, .* 6 images"),
        ("colours.tif", "2 channels of 3 frames"),
        ("both.ome.tif", "2 C of 3 T|3 T of 2 C"),
        ("rgb.tif", "RGB"),
    ):
        refused(f"{name}: .*({message})", open_sequence, [tmp_path / name])


def test_one_ome_file_per_frame_is_one_frame(tmp_path):
    """Micro-Manager writes the description of the whole series into every file."""
    tifffile.imwrite(tmp_path / "all.ome.tif", STACK, metadata={"axes": "TYX"}, photometric="minisblack")
    with tifffile.TiffFile(tmp_path / "all.ome.tif") as tiff:
        text = tiff.pages[0].description
    paths = [tmp_path / f"{number}.ome.tif" for number in range(len(STACK))]
    for path, grey in zip(paths, STACK, strict=True):
        tifffile.imwrite(path, grey, description=text.encode(), metadata=None, photometric="minisblack")
    sequence = open_sequence(paths)
    np.testing.assert_array_equal([sequence.read(number) for number in range(5)], STACK)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"tile": (16, 16)}])
def test_files_in_which_0_is_white_are_read_as_grey_values(tmp_path, kind, options):
    """TIFF 6.0, PhotometricInterpretation 0: the imaged value is 2^bits - 1 - stored."""
    grey = (GREY if kind == np.uint16 else GREY >> 2).astype(kind)
    tifffile.imwrite(tmp_path / "white.tif", np.iinfo(kind).max - grey, photometric="miniswhite", **options)
    np.testing.assert_array_equal(open_sequence([tmp_path / "white.tif"]).read(0), grey)
    np.testing.assert_array_equal(read_image(tmp_path / "white.tif")[0], grey)
    tifffile.imwrite(tmp_path / "black.tif", grey, photometric="minisblack")
    refused("black.tif: .*white.tif", open_sequence, [tmp_path / "white.tif", tmp_path / "black.tif"])
    refused("white.tif: .*MINISWHITE", open_sequence, [tmp_path / "white.tif"], 7)


@pytest.mark.parametrize(
    "name", ["files.tif", "files.png", "files.bmp", "pages.tif", "stack.tif", "video.cine", "film.mkv"]
)
def test_a_copied_frame_is_found_in_every_container(tmp_path, name):
    """Frame 3 is frame 2 again, and frame 5 frame 0; the others have the same pixels for the most part."""
    frames = np.repeat(RNG.integers(0, 250, (1, 48, 64), dtype=np.uint8), 6, axis=0)
    frames[:, 40:44] = RNG.integers(0, 250, (6, 4, 64), dtype=np.uint8)
    frames[3], frames[5] = frames[2], frames[0]
    path = tmp_path / name
    paths = [path]
    if name.startswith("files"):
        paths = [path.with_stem(f"{number}") for number in range(6)]
        for one, grey in zip(paths, frames, strict=True):
            cv2.imwrite(str(one), grey)
    elif name == "pages.tif":
        tifffile.imwrite(path, frames, photometric="minisblack", compression="zlib")
    elif name == "stack.tif":
        one_directory(path, frames, "ImageJ=1.53t\nimages=6\n")
    elif name == "video.cine":
        write_cine(path, frames, bits=8)
    else:
        write_film(path, frames)
    assert np.flatnonzero(find_copied_frames(open_sequence(paths))).tolist() == [3, 5]
