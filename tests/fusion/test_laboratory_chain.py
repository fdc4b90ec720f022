"""A laboratory's whole chain: target pictures → calibration → pose in the sensor frame → run, against the truth."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.base import Settings
from fusion.cli import main
from fusion.commands.options import EXIT_DONE
from fusion.recording.load import find_recordings, load_manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.evaluate import evaluate_recording
from fusion.simulate.channels import to_toml
from fusion.simulate.preset import PRESETS
from fusion.simulate.world import Draws, TrueStereo, make_world
from photogram.geometry import RigidTransform
from photogram.synthetic.board import Board, random_poses, render_board
from photogram.targets.view import Target

BOARD = Board(Target("chessboard", 5e-3, (9, 6)))
VIEWS = 10
SEED = 1  # that of sample_images/demo


def _photograph(folder: Path, name: str, stereo: TrueStereo, pose: RigidTransform, rng: np.random.Generator) -> None:
    """Render what the true cameras see of the target."""
    rig = stereo.rig
    for side, camera, relative in (
        ("left", rig.left, RigidTransform.identity()),
        ("right", rig.right, rig.right_from_left),
    ):
        grey = 255 * render_board(camera, relative @ pose, BOARD) + rng.normal(0, 0.7, camera.size_px[::-1])
        (folder / side).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / side / f"{name}.png"), np.clip(np.rint(grey), 0, 255).astype(np.uint8))


def _calibrated_block(folder: Path, stereo: TrueStereo, rng: np.random.Generator) -> dict[str, object]:
    """Calibrate a pair from target pictures, place it by one view at a known pose, and return its pose block."""
    name = stereo.setup.name
    poses = random_poses(rng, stereo.rig, BOARD, VIEWS + 1)
    for number, pose in enumerate(poses[:VIEWS]):
        _photograph(folder / name, f"{number:02d}", stereo, pose, rng)
    calibration = folder / f"{name}.json"
    sides = [str(folder / name / side) for side in ("left", "right")]
    target = ["--target", "chessboard", "--size", "9x6", "--spacing", "5e-3", "--scale-uncertainty", "1e-5"]
    assert main(["cameras", *sides, *target, "-o", str(calibration), "-q"]) == EXIT_DONE
    _photograph(folder / f"{name}-placed", "0", stereo, poses[VIEWS], rng)
    placed = stereo.left_from_sensor.inverse() @ poses[VIEWS]
    view = {"name": "plate", "left": f"{name}-placed/left/0.png", "right": f"{name}-placed/right/0.png"}
    known = {
        "rotation": placed.rotation.tolist(),
        "translation": placed.translation_m.tolist(),
        "pose_uncertainty": [2e-6] * 3 + [2e-5] * 3,
    }
    alignment = {
        "format": 1,
        "stereo": name,
        "calibration": calibration.name,
        "target": {"kind": "chessboard", "spacing": 5e-3, "size": [9, 6]},
        "target_view": [view | known],
    }
    (folder / f"{name}.toml").write_text(to_toml(alignment), encoding="utf-8")
    pose = folder / f"{name}-pose.toml"
    assert main(["align", str(folder / f"{name}.toml"), "-o", str(pose), "-q"]) == EXIT_DONE
    return dict(tomllib.loads(pose.read_text(encoding="utf-8"))["stereo"][name])


@pytest.mark.slow
def test_a_run_with_cameras_calibrated_and_placed_by_the_program(demo_recording: Path, tmp_path: Path) -> None:
    """The simulator's own calibration and pose are replaced; what was measured is covered by what is stated."""
    campaign = tmp_path / "campaign"
    shutil.copytree(demo_recording, campaign)
    world, rng = make_world(PRESETS["demo"], Draws(SEED, True), 0.0), np.random.default_rng(8)
    rig = tomllib.loads((campaign / "rig.toml").read_text(encoding="utf-8"))
    for stereo in world.stereo:
        block = _calibrated_block(tmp_path, stereo, rng)
        name = stereo.setup.name
        shutil.copy(tmp_path / f"{name}.json", campaign / "calibration" / f"{name}.json")
        rig["stereo"][name] |= block
        del rig["stereo"][name]["scale_uncertainty"]  # it is in the calibration
    (campaign / "rig.toml").write_text(to_toml(rig), encoding="utf-8")
    (recording,) = find_recordings(campaign)
    evaluation = evaluate_recording(load_manifest(recording), Settings(), {})
    truth = json.loads((recording.parent / "truth.json").read_text(encoding="utf-8"))["acceleration"]
    found = []
    for acceleration in evaluation.accelerations:
        if acceleration.source == "photogrammetry":
            exact = np.asarray(truth[acceleration.body]["re"]) + 1j * np.asarray(truth[acceleration.body]["im"])
            error = acceleration.phasors.value - exact
            u = np.sqrt(acceleration.phasors.covariance.diagonal(axis1=1, axis2=2))
            found.append(np.concatenate([error.real, error.imag], axis=1) / u)
    normalised = np.concatenate(found)
    normalised = normalised[np.isfinite(normalised)]
    assert len(normalised) >= 18
    assert np.abs(normalised).max() < 4.5
    assert 0.4 < np.sqrt(np.mean(normalised**2)) < 1.5
    assert not [notice for notice in evaluation.notices if "calibrate again" in notice.text]
    for pair in rig["stereo"].values():
        del pair["pose_by_calibration"]
    (campaign / "rig.toml").write_text(to_toml(rig), encoding="utf-8")
    twice = evaluate_recording(load_manifest(recording), Settings(), {})
    once_u, twice_u = _transverse_u(evaluation), _transverse_u(twice)
    assert (once_u < 0.98 * twice_u).all(), "errors of the calibration that the pose answers count once"


def _transverse_u(evaluation: Evaluation) -> np.ndarray:
    """Standard uncertainties of the load's x and y at the first line, real part, photogrammetry alone."""
    (found,) = (a for a in evaluation.accelerations if (a.source, a.body) == ("photogrammetry", "load"))
    return np.sqrt(np.diagonal(found.phasors.covariance[0])[:2])
