"""`shakercal cameras` with AprilGrids and several ChArUco boards, and pairs whose images differ in size."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from alignment_factory import rig_error
from posed_files import colmap_text
from support import RefusedCommand

from fusion.cli import main
from fusion.commands.options import EXIT_DONE
from photogram.calibration.calibration_file import read_calibration
from photogram.calibration.calibration_notices import ARBITRARY_SCALE
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.synthetic.board import random_poses, random_rig, render_board
from photogram.synthetic.patterns import Board
from photogram.targets.target_view import Target

Capture = pytest.CaptureFixture[str]


def _rig(rng: np.random.Generator, field_m: float) -> StereoRig:
    """A pair with images of 400 x 320 px on the left and 360 x 330 px of smaller pixels on the right."""
    rig = random_rig(rng, np.array([400, 320]), field_m)
    parameters = rig.right.parameters
    parameters[:4] = [*(0.92 * parameters[:2]), 181.3, 160.2]
    return replace(rig, right=Camera.from_parameters(parameters, np.array([360, 330])))


def _write(folder: Path, rig: StereoRig, poses: list[RigidTransform], boards: list[tuple[Board, np.ndarray]]) -> None:
    """Images of boards on one plate, each at its shift in the plate's plane (m)."""
    rng = np.random.default_rng(8)
    for number, pose in enumerate(poses):
        sides = ("left", rig.left, RigidTransform.identity()), ("right", rig.right, rig.right_from_left)
        for side, camera, relative in sides:
            (folder / side).mkdir(exist_ok=True)
            whole = None
            for board, shift in boards:
                placed = relative @ pose @ RigidTransform(np.eye(3), np.append(shift, 0.0))
                image = render_board(camera, placed, board)
                x0, x1, y0, y1 = board.extent_m
                corners = camera.project(
                    placed.apply(np.array([[x, y, 0] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]))
                )
                sheet = cv2.fillConvexPoly(np.zeros(image.shape, np.uint8), corners.round().astype(np.int32), 1)
                whole = image if whole is None else np.where(sheet > 0, image, whole)
            noisy = 255 * whole + rng.normal(0, 1.0, whole.shape)
            cv2.imwrite(str(folder / side / f"{number:02d}.png"), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))


def _assert_true(path: Path, rig: StereoRig) -> None:
    found = read_calibration(path)
    assert [camera.size_px.tolist() for camera in (found.left, found.right)] == [[400, 320], [360, 330]]
    assert found.covariance is not None
    assert (np.abs(rig_error(found, rig)) <= 4.5 * np.sqrt(np.diagonal(found.covariance))).all()


def test_a_pair_of_two_image_sizes_is_calibrated_from_an_aprilgrid(
    tmp_path: Path, capsys: Capture, refused: RefusedCommand
) -> None:
    rng, board = np.random.default_rng(4), Board(Target("aprilgrid", 0.012, (5, 4), tag_spacing=0.3))
    rig = _rig(rng, 0.13)
    _write(tmp_path, rig, random_poses(rng, rig, board, 7), [(board, np.zeros(2))])
    command = ["cameras", str(tmp_path / "left"), str(tmp_path / "right"), "--target", "aprilgrid", "--size", "5x4"]
    command += ["--spacing", "12mm", "-o", str(tmp_path / "top.json"), "-q"]
    assert main([*command, "--tag-spacing", "0.3"]) == EXIT_DONE
    told = capsys.readouterr().out
    _assert_true(tmp_path / "top.json", rig)
    assert " of 80 " in told
    assert "AprilGrid" in (tmp_path / "top.html").read_text(encoding="utf-8")
    assert "--tag-spacing: " in refused(*command, "--force")
    assert "--tag-spacing: " in refused(*command, "--force", "--tag-spacing", "7")
    charuco = [text if text != "aprilgrid" else "charuco" for text in command]
    assert "--tag-spacing: " in refused(*charuco, "--force", "--tag-spacing", "0.3")


def test_a_pair_is_calibrated_from_two_charuco_boards_in_every_image(
    tmp_path: Path, capsys: Capture, refused: RefusedCommand
) -> None:
    rng = np.random.default_rng(5)
    first, second = (
        Board(Target("charuco", 0.012, (6, 5), "DICT_4X4_100", first_id=number), margin=0.4) for number in (10, 50)
    )
    plate = Board(Target("charuco", 0.012, (13, 5), "DICT_4X4_100"), margin=0.4)
    rig = _rig(rng, 0.2)
    boards = [(first, np.zeros(2)), (second, np.array([7.2 * 0.012, 0.0]))]
    _write(tmp_path, rig, random_poses(rng, rig, plate, 7), boards)
    command = ["cameras", str(tmp_path / "left"), str(tmp_path / "right"), "--target", "charuco", "--size", "6x5"]
    command += ["--spacing", "12mm", "-o", str(tmp_path / "top.json"), "-q"]
    assert main([*command, "--first-id", "10,50"]) == EXIT_DONE
    told = capsys.readouterr().out
    _assert_true(tmp_path / "top.json", rig)
    pairs = int(re.findall(r"(\d+) pairs", told)[0])
    assert pairs >= 12
    one = read_calibration(tmp_path / "top.json").covariance
    assert main([*command, "--first-id", "50", "--force"]) == EXIT_DONE
    _assert_true(tmp_path / "top.json", rig)
    alone = read_calibration(tmp_path / "top.json").covariance
    assert np.median(np.diagonal(alone)[:9] / np.diagonal(one)[:9]) > 1.0, "two boards determine more than one"
    assert "--first-id: " in refused(*command, "--force", "--first-id", "10,20")
    assert "--first-id: " in refused(*command, "--force", "--first-id", "9999")
    assert "DICT_4X4_50" in refused(*command, "--force", "--first-id", "45", "--dictionary", "DICT_4X4_50")
    assert "--shape: " in refused(*command, "--force", "--first-id", "10,50", "--shape", "free")


def test_a_calibration_of_colmap_is_imported_by_the_names_of_two_images(
    tmp_path: Path, capsys: Capture, refused: RefusedCommand
) -> None:
    for name, text in zip(("cameras.txt", "images.txt"), colmap_text(), strict=True):
        (tmp_path / name).write_text(text, encoding="utf-8")
    command = ["import-calibration", str(tmp_path / "cameras.txt"), "-o", str(tmp_path / "top.json")]
    command += ["--extrinsics", str(tmp_path / "images.txt")]
    assert "--length-unit: " in refused(*command)
    assert "--cameras: " in refused(*command, "--length-unit", "m", "--cameras", "left 01.png", "other.png")
    names = ["--cameras", "left 01.png", "right/01.png"]
    assert main([*command, "--length-unit", "m", *names]) == EXIT_DONE
    told = capsys.readouterr()
    assert "COLMAP" in told.out
    assert ARBITRARY_SCALE.code in told.err
    assert read_calibration(tmp_path / "top.json").left.size_px.tolist() == [1280, 1024]


def _cut(folder: Path, side: str, number: int, columns: slice) -> None:
    """Cover a part of an image with grey noise, as if the board left the field of view there."""
    path = folder / side / f"{number:02d}.png"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    image[:, columns] = np.random.default_rng(number).normal(90, 2, image[:, columns].shape).round()
    cv2.imwrite(str(path), image)


@pytest.mark.parametrize("size", [(8, 6), pytest.param((9, 6), marks=pytest.mark.slow)])
def test_a_part_of_a_chessboard_counts_where_the_other_camera_sees_the_whole_board(
    tmp_path: Path, capsys: Capture, size: tuple[int, int]
) -> None:
    """Of boards with and without a symmetry; a part that both cameras see is refused by name."""
    rng, board = np.random.default_rng(6), Board(Target("chessboard", 0.012, size))
    rig = _rig(rng, 0.15)
    poses = random_poses(rng, rig, board, 9)
    _write(tmp_path, rig, poses, [(board, np.zeros(2))])
    for side, number in (("right", 1), ("left", 4), ("right", 6), ("left", 6)):
        camera, relative = (rig.left, RigidTransform.identity()) if side == "left" else (rig.right, rig.right_from_left)
        middle = camera.project((relative @ poses[number]).apply(board.points_m)).mean(axis=0)
        _cut(tmp_path, side, number, slice(int(middle[0]) + 25, None))
    command = ["cameras", str(tmp_path / "left"), str(tmp_path / "right"), "--target", "chessboard"]
    command += ["--size", f"{size[0]}x{size[1]}", "--spacing", "12mm", "-o", str(tmp_path / "top.json"), "-q"]
    assert main(command) == EXIT_DONE
    told = capsys.readouterr().out
    _assert_true(tmp_path / "top.json", rig)
    assert "8 pairs" in told
    refused_lines = [line for line in told.splitlines() if ": rejected: " in line]
    assert sorted(re.findall(r"(left|right)/(\d+)\.png", " ".join(refused_lines))) == [("left", "06"), ("right", "06")]
    points = int(re.findall(r"points found: (\d+) to", told)[0])
    assert 12 <= points < size[0] * size[1]


def test_a_board_of_another_size_is_named_with_its_size(tmp_path: Path, refused: RefusedCommand) -> None:
    rng, board = np.random.default_rng(6), Board(Target("chessboard", 0.012, (7, 5)))
    rig = _rig(rng, 0.13)
    _write(tmp_path, rig, random_poses(rng, rig, board, 3), [(board, np.zeros(2))])
    command = ["cameras", str(tmp_path / "left"), str(tmp_path / "right"), "--target", "chessboard"]
    told = refused(*command, "--size", "8x6", "--spacing", "12mm", "-o", str(tmp_path / "top.json"), "-q")
    assert "7 x 5 inner corners, expected 8 x 6" in told
