"""Cameras as laboratories name their files: every layout becomes a pair, with what is a guess said to be one."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from fusion.planning.draft.camera_pairs import FoundCameras
from fusion.planning.draft.inventory import survey_folder

FRAMES = 12
LAYOUTS: dict[str, tuple[tuple[str, ...], bool]] = {
    # names of left and right with the number of the frame; whether the pair is a guess
    "a DIC program's": (("test-{n:04d}_0.tif", "test-{n:04d}_1.tif"), True),
    "another's": (("Stage{n:04d}_L.png", "Stage{n:04d}_R.png"), False),
    "folders": (("left/{n}.tif", "right/{n}.tif"), False),
    "one folder": (("left_{n:04d}.png", "right_{n:04d}.png"), False),
    "one word": (("camleft{n:04d}.png", "camright{n:04d}.png"), False),
    "capital letters": (("CamL/CamL_{n:04d}.png", "CamR/CamR_{n:04d}.png"), False),
    "letters": (("CamA/CamA_{n:04d}.png", "CamB/CamB_{n:04d}.png"), True),
    "German": (("links/{n:04d}.png", "rechts/{n:04d}.png"), False),
    "German in one folder": (("Kamera links {n:04d}.png", "Kamera rechts {n:04d}.png"), False),
    "French": (("gauche/im{n:05d}.bmp", "droite/im{n:05d}.bmp"), False),
    "numbers": (("cam01/{n:04d}.png", "cam02/{n:04d}.png"), True),
    "numbers from 0": (("cam0_{n:04d}.png", "cam1_{n:04d}.png"), True),
    "two levels of folders": (("cameras/L/{n:04d}.png", "cameras/R/{n:04d}.png"), False),
    "master and slave": (("Master/{n:06d}.tif", "Slave/{n:06d}.tif"), True),
    "serial numbers": (("22345678/{n:04d}.png", "22345681/{n:04d}.png"), True),
    "serial numbers and times": (
        (
            "Basler_acA2440-75um__22345678__20240514_1015{s:02d}{ms:03d}_{n:04d}.tiff",
            "Basler_acA2440-75um__22345681__20240514_1015{s:02d}{ms:03d}_{n:04d}.tiff",
        ),
        True,
    ),
    "times after the counter": (("cam1_{n:04d}_t{t1}.png", "cam2_{n:04d}_t{t2}.png"), True),
    "times alone": (("L_1015{s:02d}_{ms:03d}.png", "R_1015{s:02d}_{ms:03d}.png"), False),
    "running counters": (("cam1_{c1}.png", "cam2_{c2}.png"), True),
    "high-speed cameras in folders": (
        ("C001H001S0001/C001H001S0001{n:06d}.tif", "C002H001S0001/C002H001S0001{n:06d}.tif"),
        True,
    ),
    "high-speed cameras in one folder": (("C001H001S0001{n:06d}.tif", "C002H001S0001{n:06d}.tif"), True),
    "a time for each camera": (("10-15-{s:02d}.{ms:03d}_cam0.png", "10-15-{s:02d}.{ms2:03d}_cam1.png"), True),
    "four levels of folders": (("images/raw/run1/Left_Camera/{n}.png", "images/raw/run1/Right_Camera/{n}.png"), False),
    "brackets": (("img[{n:03d}] L.png", "img[{n:03d}] R.png"), False),
    "nothing in common": (("inner/{n:04d}.png", "Basler-2/frame{n:04d}.png"), True),
    "times of the folders": (("20240514-101502-cam0/{n:04d}.png", "20240514-101503-cam1/{n:04d}.png"), True),
}


def write_layout(folder: Path, names: tuple[str, ...]) -> list[set[Path]]:
    """Write the frames of every camera; return their files."""
    rng = np.random.default_rng(5)
    cameras = []
    for name in names:
        files = set()
        for n in range(1, FRAMES + 1):
            ms = 73 * n + 400  # 13.7 Hz
            numbers: dict[str, Any] = {"n": n, "s": 2 + ms // 1000, "ms": ms % 1000, "t1": 10 * n, "t2": 10 * n + 3}
            numbers["ms2"] = (ms + 3) % 1000
            numbers |= {"c1": 4500 + n, "c2": 1230 + n}
            path = folder / name.format(**numbers)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), rng.integers(0, 200, (48, 64)).astype(np.uint8))
            files.add(path)
        assert len(files) == FRAMES
        cameras.append(files)
    return cameras


def matched(folder: Path, found: FoundCameras) -> list[set[Path]]:
    """The files that the patterns of a drafted pair match."""
    return [set(folder.glob(camera.pattern)) for camera in found.cameras]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_one_pair(tmp_path, layout):
    names, guess = LAYOUTS[layout]
    cameras = write_layout(tmp_path, names)
    inventory = survey_folder(tmp_path)
    assert inventory.cameras == ()
    (pair,) = inventory.camera_systems
    if layout == "nothing in common":
        cameras.sort(key=lambda files: min(files) not in matched(tmp_path, pair)[0])
    assert matched(tmp_path, pair) == cameras
    assert bool(pair.why) == guess


def test_four_cameras_are_two_pairs_and_three_equal_ones_are_not_guessed(tmp_path):
    four = write_layout(tmp_path / "four", tuple(f"cam{k}/{{n:03d}}.png" for k in (1, 2, 3, 4)))
    found = survey_folder(tmp_path / "four").camera_systems
    assert [matched(tmp_path / "four", pair) for pair in found] == [four[:2], four[2:]]
    assert len({pair.name for pair in found}) == 2
    write_layout(tmp_path / "three", ("10217/{n:03d}.png", "11346/{n:03d}.png", "10991/{n:03d}.png"))
    assert [pair.right for pair in survey_folder(tmp_path / "three").camera_systems] == [None] * 3


def test_cameras_of_base_and_load_are_no_pair(tmp_path):
    write_layout(tmp_path, ("top/{n:03d}.png", "base/{n:03d}.png"))
    assert [(pair.name, pair.right) for pair in survey_folder(tmp_path).camera_systems] == [
        ("base", None),
        ("top", None),
    ]


def test_stacks_of_many_pages_are_one_camera_each(tmp_path):
    rng = np.random.default_rng(6)
    for name in ("cam1.tif", "cam2.tif"):
        tifffile.imwrite(tmp_path / name, rng.integers(0, 255, (FRAMES, 48, 64)).astype(np.uint8))
    (pair,) = survey_folder(tmp_path).camera_systems
    assert [camera.pattern for camera in pair.cameras] == ["cam1.tif", "cam2.tif"]


def test_pictures_of_a_target_in_the_folder_are_no_cameras(tmp_path):
    write_layout(tmp_path, ("L/{n:03d}.png", "R/{n:03d}.png", "calibration/L/{n:03d}.png", "Kalibrierung/{n:03d}.png"))
    assert len(survey_folder(tmp_path).camera_systems) == 1


def test_dark_images_thumbnails_and_files_without_a_reader_are_listed_and_no_pairs(tmp_path):
    names = ("L/{n:03d}.png", "R/{n:03d}.png", "L/thumbs/{n:03d}.png", "R/thumbs/{n:03d}.png")
    cameras = write_layout(tmp_path, names)
    for side in "LR":
        for n in range(3):
            shutil.copy(min(cameras[0]), tmp_path / side / f"dark_{n}.png")
            (tmp_path / f"{side}{n}.b16").write_bytes(b"PCO-")
    found = survey_folder(tmp_path)
    assert [matched(tmp_path, pair) for pair in found.camera_systems] == [cameras[:2]]
    assert {camera.pattern for camera in found.cameras} == {"L/dark_*.png", "R/dark_*.png", "*.b16"}


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("names", [("CamA", "CamB"), ("CamB", "CamA"), ("21990", "30417"), ("30417", "21990")])
def test_the_left_camera_is_that_of_the_calibration(tmp_path, demo_recording, names, calibrated):
    """The names may be the wrong way round; without a calibration the letters decide, else the first images."""
    place = tmp_path / "run"
    for name, side in zip(names, ("left", "right"), strict=True):
        shutil.copytree(demo_recording / "Fz-0080" / f"top-{side}", place / name)
    if calibrated:
        shutil.copytree(demo_recording / "calibration", tmp_path / "calibration")
    (pair,) = survey_folder(place).camera_systems
    left = pair.left.pattern.partition("/")[0]
    if calibrated:
        assert left == names[0]
        assert "as in " in pair.why
    elif names[0].startswith("Cam"):
        assert left == "CamA"
    else:
        assert "guessed" in pair.why
