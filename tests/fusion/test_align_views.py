"""Pictures of the target as evidence: a target at a known pose, and common views of two pairs."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from alignment_factory import TARGET, World, make_world, target_pose

from fusion.cli import main
from fusion.simulate.write import to_toml
from photogram.calibration.file import write_calibration
from photogram.geometry import RigidTransform, vector_from_rotation
from photogram.synthetic.board import Board, render_board
from photogram.targets.view import TargetView

TABLE = {"kind": TARGET.kind, "spacing": TARGET.spacing_m, "size": list(TARGET.size or ())}


class Pictures:
    """Pictures of a target in a folder: rendered ones, or empty files for which a detector answers what is seen."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch, rendered: bool) -> None:
        self.folder, self.rendered, self.views = folder, rendered, dict[str, TargetView]()
        if not rendered:
            patch.setattr("fusion.cameras.align_manifest.read_picture", lambda path: (path.read_text(), 1.0))
            patch.setattr("fusion.cameras.align_manifest.find_target", lambda name, *_: self.views[name])

    def take(self, name: str, world: World, left_from_target: RigidTransform) -> dict[str, str]:
        """Let both cameras take the target, and return the names of their pictures."""
        names = {side: f"{name}-{side}.png" for side in ("left", "right")}
        views = world.view(world.sensor_from_camera @ left_from_target, 0.02)
        right = world.true.right_from_left @ left_from_target
        cameras = ((world.true.left, left_from_target), (world.true.right, right))
        for file, view, (camera, pose) in zip(names.values(), views, cameras, strict=True):
            self.views[file] = view
            (self.folder / file).write_text(file)
            if self.rendered:
                grey = render_board(camera, pose, Board(TARGET)) + 0.004 * world.rng.normal(size=camera.size_px[::-1])
                cv2.imwrite(str(self.folder / file), np.clip(255 * grey, 0, 255).round().astype(np.uint8))
        return names


@pytest.fixture(params=[False, pytest.param(True, marks=pytest.mark.slow)], ids=["detected", "rendered"])
def pictures(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pictures:
    return Pictures(tmp_path, monkeypatch, request.param)


def _write(folder: Path, **blocks: Any) -> Path:
    path = folder / "alignment.toml"
    path.write_text(to_toml({"format": 1, "target": TABLE, **blocks}), encoding="utf-8")
    return path


def _departure(block: dict[str, Any], true: RigidTransform) -> np.ndarray:
    """Displacement from the printed pose to the true one over its standard uncertainties."""
    found = RigidTransform(np.array(block["rotation"]), np.array(block["translation"]))
    turn = true.rotation @ found.rotation.T
    error = np.concatenate([true.translation_m - turn @ found.translation_m, vector_from_rotation(turn)])
    return np.asarray(error / np.array(block["pose_uncertainty"]))


def test_a_target_at_a_known_pose(pictures: Pictures, capsys: pytest.CaptureFixture[str]) -> None:
    world, folder = make_world(1), pictures.folder
    write_calibration(folder / "top.json", world.rig)
    seen = target_pose(world.rng, 0.15)
    placed = world.sensor_from_camera @ seen
    view: dict[str, Any] = {"name": "plate", **pictures.take("plate", world, seen)}
    view |= {"rotation": placed.rotation.tolist(), "translation": placed.translation_m.tolist()}
    view["pose_uncertainty"] = [1e-6] * 3 + [1e-5] * 3
    path = _write(folder, stereo="top", calibration="top.json", target_view=[view])
    assert main(["align", str(path), "-q"]) == 0
    text = capsys.readouterr().out
    assert "from 1 target view." in text
    assert np.abs(_departure(tomllib.loads(text)["stereo"]["top"], world.sensor_from_camera)).max() < 4.5


def test_common_views_give_the_relative_pose(pictures: Pictures, capsys: pytest.CaptureFixture[str]) -> None:
    (own, other), folder = (make_world(2), make_world(3)), pictures.folder
    write_calibration(folder / "own.json", own.rig)
    write_calibration(folder / "other.json", other.rig)
    held, seen_by_other = target_pose(own.rng, 0.15), target_pose(other.rng, 0.15)
    true = seen_by_other @ held.inverse()  # the other camera's frame from this one's
    view = {"name": "a", **pictures.take("ours", own, held)}
    view |= {f"other_{side}": name for side, name in pictures.take("theirs", other, seen_by_other).items()}
    pair = {"stereo": "top", "calibration": "other.json"}
    path = _write(folder, stereo="base", calibration="own.json", other=pair, common_view=[view])
    assert main(["align", str(path), "-q"]) == 0
    text = capsys.readouterr().out
    assert "in the left camera of top" in text
    assert np.abs(_departure(tomllib.loads(text)["relative"]["base"], true)).max() < 4.5


def test_a_picture_that_is_none_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_calibration(tmp_path / "top.json", make_world(1).rig)
    (tmp_path / "a.png").write_text("no picture")
    view = {"name": "plate", "left": "a.png", "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]}
    path = _write(tmp_path, stereo="top", calibration="top.json", target_view=[view])
    assert main(["align", str(path), "-q"]) == 2
    assert "target_view.plate.left: " in capsys.readouterr().err
