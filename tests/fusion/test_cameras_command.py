"""`shakercal cameras`: rendered pictures of a known pair in, calibration and page out; `import-calibration`."""

from __future__ import annotations

import re
import shutil
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterable
from itertools import cycle
from pathlib import Path

import cv2
import numpy as np
import pytest
from alignment_factory import rig_error
from support import RefusedCommand

from fusion.cameras.camera_notices import IMAGE_LISTS, TOO_FEW_IMAGES
from fusion.cli import main
from fusion.commands.options import EXIT_DONE, in_metres, length
from fusion.errors import LENGTH_UNIT_REQUIRED
from fusion.simulate.preset import read_preset
from fusion.simulate.statics import SessionPreset
from photogram.calibration.calibration_file import read_calibration, read_camera
from photogram.calibration.calibration_notices import (
    CAMERA_GEOMETRY,
    KNOWN_LENGTH_USED,
    SPACING_UNCERTAINTY_UNSTATED,
    UNCERTAINTIES_MISSING,
)
from photogram.geometry import RigidTransform
from photogram.synthetic.board import random_poses, random_rig, render_board

BOARD = read_preset(SessionPreset, "targets").board
SIZE = np.array([384, 307])
MATRIX = np.array([[3200.0, 0, 640], [0, 3200, 512], [0, 0, 1]])
TARGET = ["--target", "charuco", "--size", "11x8", "--spacing", "9e-3"]
VIEWS = 7
WIDTHS = {"left": 384, "right": 376}
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, object]:
    """Folder with left and right pictures of a ChArUco board, 8 bit with noise, and the true pair.

    Columns cut off at the right of the right ones leave the pixels of the others where they were.
    """
    folder = tmp_path_factory.mktemp("session")
    rng = np.random.default_rng(4)
    rig = random_rig(rng, SIZE, 0.16)
    relatives = (RigidTransform.identity(), rig.right_from_left)
    for number, pose in enumerate(random_poses(rng, rig, BOARD, VIEWS)):
        for side, camera, relative in zip(("left", "right"), (rig.left, rig.right), relatives, strict=True):
            (folder / side).mkdir(exist_ok=True)
            picture = 255 * render_board(camera, relative @ pose, BOARD) + rng.normal(0, 1.2, SIZE[::-1])
            picture = picture[:, : WIDTHS[side]]
            cv2.imwrite(str(folder / side / f"{number + 8}.png"), np.clip(np.rint(picture), 0, 255).astype(np.uint8))
    return folder, rig


@pytest.fixture
def pictures(session: tuple[Path, object], tmp_path: Path) -> Path:
    """A copy of the session whose pictures may be spoilt."""
    return Path(shutil.copytree(session[0], tmp_path, dirs_exist_ok=True))


def _command(folder: Path, *extra: str) -> list[str]:
    return ["cameras", str(folder / "left"), str(folder / "right"), *TARGET, "-o", str(folder / "top.json"), *extra]


def test_the_true_pair_of_two_sizes_comes_back(session: tuple[Path, object], pictures: Path, capsys: Capture) -> None:
    arguments = ["9mm" if text == "9e-3" else text for text in _command(pictures, "--scale-uncertainty", "1e-4", "-q")]
    assert main(arguments) == EXIT_DONE
    told = capsys.readouterr().out
    found = read_calibration(pictures / "top.json")
    assert [camera.size_px.tolist() for camera in (found.left, found.right)] == [[384, 307], [376, 307]]
    assert (np.abs(rig_error(found, session[1])) <= 4.5 * np.sqrt(np.diagonal(found.covariance))).all()
    assert re.search(rf"{VIEWS} pairs\b.* 0\.0\d+ px", told)
    assert "baseline " in told
    assert " of 70 " in told
    assert SPACING_UNCERTAINTY_UNSTATED.code not in told
    page = (pictures / "top.html").read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>")
    assert "(flat, polynomial)" in page


def test_a_picture_that_cannot_be_read_is_left_out_by_name_and_a_known_length_sets_the_scale(
    pictures: Path, capsys: Capture, refused: RefusedCommand
) -> None:
    for picture in (*pictures.glob("*/13.png"), *pictures.glob("*/14.png")):
        picture.unlink()
    (pictures / "left" / "9.png").write_bytes(b"no picture")
    known = ["--known-length", "0,0", "5,0"]
    assert main(_command(pictures, "-q", *known, "45.09mm", "5e-6")) == EXIT_DONE
    told = capsys.readouterr().out
    (line,) = (line for line in told.splitlines() if "9.png" in line)
    assert ": rejected: " in line
    (line,) = (line for line in told.splitlines() if KNOWN_LENGTH_USED.code in line)
    assert {"45.09", "0,0", "5,0", "45"} <= set(re.findall(r"\d(?:[\d.,]*\d)?", line))
    found = read_calibration(pictures / "top.json")
    assert main(_command(pictures, "-q", "--force")) == EXIT_DONE
    plain = read_calibration(pictures / "top.json").right_from_left.translation_m
    assert np.allclose(found.right_from_left.translation_m, 1.002 * plain, rtol=1e-9)
    assert "column,row" in refused(*_command(pictures, "-q", "--force", "--known-length", "0,0", "99,0", "0.1", "0"))
    told = refused(*_command(pictures, "-q", "--force", *known, "long", "0"))
    assert re.search("--known-length: .*'long' '0'", told)


@pytest.mark.parametrize(
    ("spacing", "told"),
    [
        ("9", ["9mm", "9m", "9 m", "99 m"]),
        ("0.9", ["9.9 m"]),
        ("9e-6", ["9.9e-05 m"]),
    ],
)
def test_a_spacing_that_no_target_has_needs_its_unit(
    pictures: Path, refused: RefusedCommand, spacing: str, told: list[str]
) -> None:
    line = refused(*[spacing if text == "9e-3" else text for text in _command(pictures, "-q")])
    assert line.startswith(f"shakercal: {LENGTH_UNIT_REQUIRED.code} shakercal cameras: --spacing: ")
    for words in told:
        assert re.search(rf"(?<![\w.]){re.escape(words)}\b", line), words
    assert not list(pictures.glob("top.*"))


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("7e-3", 7e-3),
        ("7mm", 7e-3),
        ("0.7 cm", 7e-3),
        ("7000um", 7e-3),
        ("7e3 µm", 7e-3),
        ("0.25in", 6.35e-3),
        ("3m", 3),
    ],
)
def test_lengths_with_and_without_units(text: str, metres: float) -> None:
    assert length(text).m == pytest.approx(metres, rel=1e-15)
    assert float(in_metres(text)) == length(text).m


@pytest.mark.parametrize("text", ["7km", "mm", "-7mm", "nan", "7 7mm", "7mm mm", "", "7M", "1e99"])
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(ArgumentTypeError, match="expected"):
        length(text)


def test_a_single_camera_comes_back(
    session: tuple[Path, object], pictures: Path, capsys: Capture, refused: RefusedCommand
) -> None:
    command = ["cameras", str(pictures / "left"), *TARGET, "--mono", "-o", str(pictures / "left.json"), "-q"]
    assert main(command) == EXIT_DONE
    told = capsys.readouterr().out
    assert re.search(rf"{VIEWS} views\b.* 0\.0\d+ px", told)
    camera, covariance = read_camera(pictures / "left.json")
    error = camera.parameters - session[1].left.parameters
    assert (np.abs(error) <= 4.5 * np.sqrt(np.diagonal(covariance))).all()
    assert "--force" in refused(*command)


@pytest.mark.slow
def test_pictures_in_the_order_of_their_numbers_and_by_pattern(pictures: Path) -> None:
    """8.png … 14.png: natural order; one picture given by name on either side is none too many."""
    arguments = [str(pictures / "left" / "*.png"), str(pictures / "right" / "*.png")]
    assert main(["cameras", *arguments, *TARGET, "-o", str(pictures / "a.json"), "-q"]) == EXIT_DONE
    every = [str(path) for side in ("left", "right") for path in sorted((pictures / side).iterdir())]
    assert main(["cameras", *every, *TARGET, "-o", str(pictures / "b.json"), "-q"]) == EXIT_DONE
    first, second = (read_calibration(pictures / name).right_from_left for name in ("a.json", "b.json"))
    assert np.allclose(first.translation_m, second.translation_m, rtol=1e-5)


SPOILT: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "blurred": lambda image: cv2.GaussianBlur(image, (0, 0), 9.0),
    "overexposed": lambda image: np.clip(40.0 * image, 0, 255).astype(np.uint8),
    "mirrored": lambda image: image[:, ::-1].copy(),
    "underexposed": lambda image: np.full_like(image, 90),
}


def _spoil(folder: Path, numbers: Iterable[int]) -> dict[int, str]:
    """Spoil left pictures, each in another way, and return the reasons by number."""
    reasons = dict(zip(numbers, cycle(SPOILT), strict=False))
    for number, reason in reasons.items():
        path = str(folder / "left" / f"{number}.png")
        cv2.imwrite(path, SPOILT[reason](cv2.imread(path, cv2.IMREAD_GRAYSCALE)))
    return reasons


@pytest.mark.slow
def test_spoilt_pictures_are_named_with_the_reason_and_left_out(pictures: Path, capsys: Capture) -> None:
    reasons = _spoil(pictures, range(8, 12))
    assert main(_command(pictures, "-q")) == EXIT_DONE
    told = capsys.readouterr().out
    for number, reason in reasons.items():
        (line,) = (line for line in told.splitlines() if f"{number}.png" in line)
        assert reason in line


def test_no_calibration_from_spoilt_pictures_and_an_earlier_one_is_kept(
    pictures: Path, refused: RefusedCommand
) -> None:
    reasons = _spoil(pictures, range(8, 8 + VIEWS))
    told = refused(*_command(pictures, "-q"))
    assert TOO_FEW_IMAGES.code in told
    assert re.search(rf" 0 .* {VIEWS} left ", told)
    for number, reason in reasons.items():
        assert f"{number}.png: {reason}" in told
    assert not list(pictures.glob("top.*"))
    (pictures / "top.json").write_text("kept", encoding="utf-8")
    assert "--force" in refused(*_command(pictures, "-q"))
    assert (pictures / "top.json").read_text(encoding="utf-8") == "kept"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["left", "right", "--target", "charuco", "--spacing", "9e-3"], "--size"),
        (["left/8.png", "left/9.png", "right/8.png", *TARGET], "1 and 2"),
        (["left", "left", *TARGET], IMAGE_LISTS.code),
        (["left", "nowhere/*.png", *TARGET], IMAGE_LISTS.code),
        (["left/8.png", "right/8.png", *TARGET], TOO_FEW_IMAGES.code),
        (["left", "right", *TARGET, "--dictionary", "DICT_OWN"], "DICT_OWN"),
        (["left/8.png", "left/8.json", "right/8.png", "right/9.png", *TARGET], "8.json"),
    ],
)
def test_wrong_arguments_get_one_sentence(
    pictures: Path, refused: RefusedCommand, monkeypatch: pytest.MonkeyPatch, arguments: list[str], told: str
) -> None:
    monkeypatch.chdir(pictures)
    assert told in refused("cameras", *arguments, "-o", "top.json", "-q")


@pytest.mark.slow
def test_the_real_dot_grid_is_calibrated_from_all_pairs(data_dir: Path, tmp_path: Path) -> None:
    """Baseline and angle of the peer's calibration of the same pictures, plain OpenCV's rms 0.59 px."""
    folder = data_dir / "dotgrid_stereo"
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} does not exist")
    every = [str(path) for side in (0, 1) for path in sorted(folder.glob(f"*_{side}.jpeg"))]
    output = tmp_path / "top.json"
    assert main(["cameras", *every, "--target", "dots", "--spacing", "3.5e-3", "-o", str(output), "-q"]) == EXIT_DONE
    found = read_calibration(output)
    peer_baseline = np.linalg.norm([-86.494e-3, 0.582e-3, 23.53e-3])
    assert np.linalg.norm(found.right_from_left.translation_m) == pytest.approx(peer_baseline, rel=0.03)
    assert np.degrees(np.arccos(found.right_from_left.rotation[2, 2])) == pytest.approx(27.62, rel=0.03)
    assert np.allclose(found.left.parameters[:2], [12577.41, 12575.82], rtol=0.03)


@pytest.fixture
def opencv_file(tmp_path: Path) -> Path:
    """A calibration as OpenCV writes it."""
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("M1", MATRIX), ("D1", np.zeros((1, 5))), ("M2", MATRIX), ("D2", np.zeros((1, 5)))):
        storage.write(name, value)
    storage.write("R", np.eye(3))
    storage.write("T", np.array([[-150.0], [0.0], [0.0]]))
    storage.release()
    return path


def test_a_calibration_is_written_and_explained(
    opencv_file: Path, tmp_path: Path, capsys: Capture, refused: RefusedCommand
) -> None:
    output = tmp_path / "top.json"
    command = ["import-calibration", str(opencv_file), "-o", str(output), "--image-size", "1280x1024"]
    assert main([*command, "--length-unit", "mm"]) == EXIT_DONE
    told = capsys.readouterr()
    assert "OpenCV" in told.out
    assert told.out.endswith(f": {output}\n")
    assert re.search(rf"{CAMERA_GEOMETRY.code} .*\b150\.00\b", told.err)
    assert {CAMERA_GEOMETRY.code, UNCERTAINTIES_MISSING.code} <= set(re.findall(r"SC-\d+", told.err))
    rig = read_calibration(output)
    np.testing.assert_allclose(rig.right_from_left.translation_m, [-0.15, 0, 0])
    assert rig.left.size_px.tolist() == [1280, 1024]

    written = output.read_bytes()
    assert "--force" in refused(*command, "--length-unit", "m")
    assert output.read_bytes() == written
    assert main([*command, "--length-unit", "m", "--force"]) == EXIT_DONE
    assert read_calibration(output).right_from_left.translation_m[0] == -150.0


@pytest.mark.parametrize(
    ("file", "options", "told"),
    [
        ("stereo.yml", ["--image-size", "1280x1024"], "stereo.yml: --length-unit: "),
        ("stereo.yml", ["--length-unit", "mm"], "stereo.yml: --image-size: "),
        ("none.xml", [], "none.xml"),
    ],
)
def test_what_is_missing_is_said_in_one_sentence(
    opencv_file: Path, tmp_path: Path, refused: RefusedCommand, file: str, options: list[str], told: str
) -> None:
    assert told in refused("import-calibration", tmp_path / file, "-o", tmp_path / "top.json", *options)
    assert not (tmp_path / "top.json").exists()


def test_a_calibration_goes_out_and_comes_back(
    opencv_file: Path, tmp_path: Path, capsys: Capture, refused: RefusedCommand
):
    ours, theirs, again = (tmp_path / name for name in ("top.json", "vic3d.xml", "again.json"))
    command = ["import-calibration", str(opencv_file), "-o", str(ours), "--image-size", "1280x1024"]
    assert main([*command, "--length-unit", "mm"]) == EXIT_DONE
    assert main(["export-calibration", str(ours), "-o", str(theirs)]) == EXIT_DONE
    printed = capsys.readouterr().out.splitlines()[-1]
    assert "VIC-3D" in printed
    assert printed.endswith(f": {theirs}")
    assert main(["import-calibration", str(theirs), "-o", str(again)]) == EXIT_DONE
    np.testing.assert_allclose(read_calibration(again).values, read_calibration(ours).values, rtol=1e-12)
    assert "--force" in refused("export-calibration", ours, "-o", theirs)
    assert ".yml" in refused("export-calibration", ours, "-o", tmp_path / "top.txt")
    assert "stereo.yml" in refused("export-calibration", opencv_file, "-o", tmp_path / "new.xml")
