"""A simulated calibration session: pictures of a target from both cameras of a stereo pair, and the true pair."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from fusion.settings import ProgressCallback
from photogram.calibration_file import write_calibration
from photogram.rigid import RigidTransform
from photogram.synthetic.board import Board, render_board
from photogram.synthetic.board_session import random_poses, random_rig
from photogram.synthetic.noise import ImageSensor
from photogram.target.view import Target

TRUTH_FILE = "truth.json"
SIDES = ("left", "right")
BOARD = Board(Target("charuco", 9e-3, (11, 8), "DICT_4X4_100"))
_SIZE_PX = np.array([800, 640])
_FIELD_M = 0.15
_VIEWS = 10
_SENSOR = ImageSensor(bit_depth=8, electrons_per_grey=40.0, read_noise_grey=0.6)
_BLUR_PX = 0.8


def write_session(folder: Path, seed: int, progress: ProgressCallback) -> None:
    """Write `left/00.png` …, `right/00.png` … and the true calibration `truth.json` of a random pair into a folder."""
    import cv2

    rng = np.random.default_rng(seed)
    rig = random_rig(rng, _SIZE_PX, _FIELD_M)
    poses = random_poses(rng, rig, BOARD, _VIEWS)
    relatives = (RigidTransform.identity(), rig.right_from_left)
    for side, camera, relative in zip(SIDES, (rig.left, rig.right), relatives, strict=True):
        (folder / side).mkdir()
        for number, pose in enumerate(poses):
            picture = _SENSOR.digitise(render_board(camera, relative @ pose, BOARD, _BLUR_PX, slant=0.1), rng)
            _, text = cv2.imencode(".png", picture.astype(np.uint8))
            (folder / side / picture_name(number)).write_bytes(text.tobytes())
            progress("render", SIDES.index(side) * _VIEWS + number + 1, 2 * _VIEWS)
    write_calibration(folder / TRUTH_FILE, rig)


def picture_name(number: int) -> str:
    """Return the name of a picture within its camera's folder."""
    return f"{number:02d}.png"


def written_files(folder: Path) -> set[Path]:
    """Return the files that a simulated session in this folder consists of, none where there is no such session."""
    truth = folder / TRUTH_FILE
    if not truth.is_file() or "left" not in json.loads(truth.read_text(encoding="utf-8")):
        return set()
    pictures = {folder / side / picture_name(number) for side in SIDES for number in range(_VIEWS)}
    return {path.resolve() for path in (truth, *pictures)}
