"""Pictures of the target as evidence: rendered chessboards at known poses, and common views of two pairs."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from alignment_factory import TARGET, World, make_world, target_pose

from fusion.cli import main
from fusion.simulate.write import to_toml
from photogram.calibration.file import write_calibration
from photogram.geometry import RigidTransform, vector_from_rotation
from photogram.synthetic.board import Board, render_board

TABLE = {"kind": TARGET.kind, "spacing": TARGET.spacing_m, "size": list(TARGET.size or ())}


def picture(folder: Path, name: str, world: World, left_from_target: RigidTransform) -> dict[str, str]:
    """Render both cameras' pictures of the target and return their names."""
    import cv2

    names = {}
    right = world.true.right_from_left @ left_from_target
    for side, camera, pose in (("left", world.true.left, left_from_target), ("right", world.true.right, right)):
        grey = render_board(camera, pose, Board(TARGET)) + 0.004 * world.rng.normal(size=camera.size_px[::-1])
        names[side] = f"{name}-{side}.png"
        cv2.imwrite(str(folder / names[side]), np.clip(255 * grey, 0, 255).round().astype(np.uint8))
    return names


def upright(world: World) -> RigidTransform:
    """A pose of the target in view."""
    return target_pose(world.rng, 0.15)


def departure(block: dict[str, object], true: RigidTransform) -> np.ndarray:
    """Displacement from the printed pose to the true one over its standard uncertainties."""
    found = RigidTransform(np.array(block["rotation"]), np.array(block["translation"]))
    turn = true.rotation @ found.rotation.T
    error = np.concatenate([true.translation_m - turn @ found.translation_m, vector_from_rotation(turn)])
    return np.asarray(error / np.array(block["pose_uncertainty"]))


def test_a_target_at_a_known_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = make_world(1)
    write_calibration(tmp_path / "top.json", world.rig)
    seen = upright(world)
    placed = world.sensor_from_camera @ seen
    view = {
        "name": "plate",
        **picture(tmp_path, "plate", world, seen),
        "rotation": placed.rotation.tolist(),
        "translation": placed.translation_m.tolist(),
        "pose_uncertainty": [1e-6] * 3 + [1e-5] * 3,
    }
    tables = {"format": 1, "stereo": "top", "calibration": "top.json", "target": TABLE, "target_view": [view]}
    path = tmp_path / "alignment.toml"
    path.write_text(to_toml(tables), encoding="utf-8")
    assert main(["align", str(path), "-q"]) == 0
    text = capsys.readouterr().out
    assert "from 1 target view." in text
    assert np.abs(departure(tomllib.loads(text)["stereo"]["top"], world.sensor_from_camera)).max() < 4.5
    (tmp_path / view["left"]).write_bytes((tmp_path / "top.json").read_bytes())
    assert main(["align", str(path), "-q"]) == 2
    assert "target_view.plate.left: " in capsys.readouterr().err


def test_common_views_give_the_relative_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own, other = make_world(2), make_world(3)
    write_calibration(tmp_path / "own.json", own.rig)
    write_calibration(tmp_path / "other.json", other.rig)
    held = upright(own)
    seen_by_other = upright(other)
    true = seen_by_other @ held.inverse()  # the other camera's frame from this one's
    theirs = picture(tmp_path, "theirs", other, seen_by_other)
    view = {"name": "a", **picture(tmp_path, "ours", own, held)}
    view |= {f"other_{side}": name for side, name in theirs.items()}
    tables = {
        "format": 1,
        "stereo": "base",
        "calibration": "own.json",
        "target": TABLE,
        "other": {"stereo": "top", "calibration": "other.json"},
        "common_view": [view],
    }
    path = tmp_path / "alignment.toml"
    path.write_text(to_toml(tables), encoding="utf-8")
    assert main(["align", str(path), "-q"]) == 0
    text = capsys.readouterr().out
    assert "in the left camera of top" in text
    assert np.abs(departure(tomllib.loads(text)["relative"]["base"], true)).max() < 4.5
