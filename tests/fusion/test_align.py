"""The command `shakercal align`: alignment.toml to a block of rig.toml, on simulated cameras."""

from __future__ import annotations

import csv
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alignment_factory import BODY_M, World, displaced, make_world
from pydantic import BaseModel

from fusion.cameras.align_manifest import (
    AlignmentFile,
    AxisBlock,
    CommonView,
    Face,
    KnownPose,
    Motion,
    OtherPair,
    Point,
    TargetBlock,
    TargetViewBlock,
    read_alignment,
)
from fusion.cli import main
from fusion.recording.manifest import Stereo
from fusion.simulate.write import to_toml
from photogram.calibration.file import write_calibration
from photogram.geometry import RigidTransform, vector_from_rotation

ROOT = Path(__file__).resolve().parents[2]
DOC = (ROOT / "docs" / "cameras.md").read_text(encoding="utf-8")
SECTION = DOC[DOC.index("## The camera frame in the sensor frame") :].split("\n## ")[0]
MODELS: dict[str, type[BaseModel]] = {
    "Top level": AlignmentFile,
    "`[pose]`": KnownPose,
    "`[target]`": TargetBlock,
    "`[other]`": OtherPair,
    "`[[point]]`": Point,
    "`[[face]]`": Face,
    "`[[target_view]]`": TargetViewBlock,
    "`[[common_view]]`": CommonView,
    "`[[motion]]`": Motion,
    "`[[axis]]`": AxisBlock,
}


def fiducials(world: World, count: int = 8) -> list[dict[str, Any]]:
    """Blocks [[point]] of fiducials that the world's cameras see."""
    true = BODY_M + world.rng.uniform(-0.05, 0.05, (count, 3)) * np.array([1.0, 1.0, 0.4])
    left, right = world.see(true, 0.02)
    stated = true + 5e-6 * world.rng.normal(size=true.shape)
    return [
        {
            "name": f"P{number}",
            "position": stated[number].tolist(),
            "position_uncertainty": 5e-6,
            "left": left[number].tolist(),
            "right": right[number].tolist(),
            "pixel_uncertainty": 0.02,
        }
        for number in range(count)
    ]


def write(folder: Path, world: World, **blocks: Any) -> Path:
    """Write calibration and alignment.toml into a folder."""
    write_calibration(folder / "top.json", world.rig)
    tables = {"format": 1, "stereo": "top", "calibration": "top.json", **blocks}
    path = folder / "alignment.toml"
    path.write_text(to_toml(tables), encoding="utf-8")
    return path


def found_in(text: str) -> tuple[RigidTransform, np.ndarray]:
    """Pose and its uncertainties in the printed block."""
    (block,) = tomllib.loads(text)["stereo"].values()
    return RigidTransform(np.array(block["rotation"]), np.array(block["translation"])), np.array(
        block["pose_uncertainty"]
    )


def departure(found: RigidTransform, true: RigidTransform) -> np.ndarray:
    """Displacement (6,) from a pose to the true one."""
    turn = true.rotation @ found.rotation.T
    return np.concatenate([true.translation_m - turn @ found.translation_m, vector_from_rotation(turn)])


def test_fiducials_give_a_block_of_the_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = make_world(1)
    path = write(tmp_path, world, point=fiducials(world))
    assert main(["align", str(path), "-o", str(tmp_path / "pose.toml"), "-q"]) == 0
    text = capsys.readouterr().out
    assert (tmp_path / "pose.toml").read_text(encoding="utf-8") == text
    assert "from 8 points" in text
    assert "U (k = 2)" in text
    pose, u = found_in(text)
    assert (np.abs(departure(pose, world.sensor_from_camera)) < 4.5 * u).all()
    assert u[3:].max() < 2e-4
    block = {**tomllib.loads(text)["stereo"]["top"], "body": "load", "exposure": 1e-5}
    Stereo.model_validate(block)


def test_faces_come_from_tables_of_pixels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = make_world(2)
    towards = -world.sensor_from_camera.rotation[:, 2]
    blocks = []
    for number in range(3):
        side = np.linalg.svd(towards[None])[2][1:]
        angle = 0.4 + number * 2 * np.pi / 3
        normal = towards + 0.8 * np.array([np.cos(angle), np.sin(angle)]) @ side
        normal /= np.linalg.norm(normal)
        centre = BODY_M + 0.02 * normal
        true = centre + world.rng.uniform(-0.03, 0.03, (40, 2)) @ np.linalg.svd(normal[None])[2][1:]
        pixels = np.concatenate(world.see(true, 0.02), axis=1)
        with (tmp_path / f"face-{number}.csv").open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["left_x", "left_y", "right_x", "right_y"])
            writer.writerows(pixels.tolist())
        block = {"name": f"{number}", "point": centre.tolist(), "normal": normal.tolist(), "pixel_uncertainty": 0.02}
        blocks.append({**block, "pixels": f"face-{number}.csv"})
    assert main(["align", str(write(tmp_path, world, face=blocks)), "-q"]) == 0
    pose, u = found_in(capsys.readouterr().out)
    assert (np.abs(departure(pose, world.sensor_from_camera)) < 4.5 * u).all()


def test_a_datum_adds_to_the_uncertainty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = make_world(3)
    points = fiducials(world)
    spread = []
    for datum in ([0.0] * 6, [1e-4, 0.0, 0.0, 0.0, 0.0, 1e-3]):
        assert main(["align", str(write(tmp_path, world, point=points, datum_uncertainty=datum)), "-q"]) == 0
        spread.append(found_in(capsys.readouterr().out)[1])
    np.testing.assert_allclose(
        spread[1] ** 2 - spread[0] ** 2, np.array([1e-4, 0, 0, 0, 0, 1e-3]) ** 2, rtol=2e-2, atol=3e-11
    )


def test_what_is_open_is_told_in_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = make_world(4)
    points = fiducials(world, 2)
    pose = displaced(world.sensor_from_camera, np.full(6, 1e-3))
    assert main(["align", str(write(tmp_path, world, point=points))]) == 1
    assert "expected a first pose" in capsys.readouterr().err
    known = {"rotation": pose.rotation.tolist(), "translation": pose.translation_m.tolist()}
    path = write(tmp_path, world, point=points, pose={**known, "pose_uncertainty": [0.2] * 6})
    output = tmp_path / "pose.toml"
    assert main(["align", str(path), "-o", str(output)]) == 1
    told = capsys.readouterr().err
    assert "rotation about" in told
    assert "open: add" in told
    assert told.count("\n") == 1
    assert not output.exists()


def test_an_output_that_is_there_is_refused_without_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = make_world(5)
    path = write(tmp_path, world, point=fiducials(world))
    output = tmp_path / "pose.toml"
    output.write_text("mine", encoding="utf-8")
    assert main(["align", str(path), "-o", str(output), "-q"]) == 2
    assert output.read_text(encoding="utf-8") == "mine"
    assert "--force" in capsys.readouterr().err
    assert main(["align", str(path), "-o", str(output), "-q", "--force"]) == 0
    assert "[stereo.top]" in output.read_text(encoding="utf-8")
    assert main(["align", str(path), "-o", str(tmp_path / "none" / "pose.toml"), "-q"]) == 2


WRONG = {
    "calibration": ({"calibration": "none.json"}, "alignment.toml: calibration: expected an existing file"),
    "no evidence": ({"point": []}, "at least one block of evidence"),
    "unknown key": ({"points": []}, 'probably "point"'),
    "a certain pose": (
        {"pose": {"rotation": np.eye(3).tolist(), "translation": [0.0] * 3, "pose_uncertainty": [0.0] * 6}},
        "pose.pose_uncertainty: expected 6 numbers above 0",
    ),
    "target view": (
        {"target_view": [{"name": "a", "left": "top.json", "rotation": np.eye(3).tolist(), "translation": [0.0] * 3}]},
        "target: expected the [target] that is seen in the views",
    ),
    "motion": (
        {"motion": [{"name": "z", "recordings": "*/recording.toml", "direction_uncertainty": 1e-3}]},
        "motion.z.recordings: expected at least one file",
    ),
    "face": (
        {
            "face": [
                {"name": "t", "point": [0.0] * 3, "normal": [0.0, 0, 1], "pixels": "top.json", "pixel_uncertainty": 1}
            ]
        },
        "expected the columns left_x, left_y, right_x, right_y",
    ),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_wrong_input_is_told_in_one_sentence(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blocks, expected = WRONG[name]
    world = make_world(6)
    path = write(tmp_path, world, **{"point": fiducials(world, 3), **blocks})
    assert main(["align", str(path)]) == 2
    told = capsys.readouterr().err
    assert expected in told
    assert told.count("\n") == 1


def test_a_point_twice_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = make_world(7)
    points = fiducials(world, 3)
    assert main(["align", str(write(tmp_path, world, point=[*points, points[0]]))]) == 2
    assert 'point: expected different names, found "P0" twice' in capsys.readouterr().err


def _told(model: type[BaseModel], key: str) -> str:
    """What the document's second column has to say about a key of a model."""
    field = model.model_fields[key]
    if field.is_required():
        return "required"
    default: Any = field.get_default(call_default_factory=True)
    if default is None:
        return "optional"
    if isinstance(default, int | float):
        return f"{default:g}"
    if len(default) == 0:
        return "none"
    assert not np.any(default)
    return "0" if len(default) == 3 else "zeros"


def _tables() -> dict[str, dict[str, str]]:
    """Title -> key -> second column of every table on keys."""
    parts = re.split(r"^#### (.*)$", SECTION[SECTION.index("### Every key") :], flags=re.MULTILINE)[1:]
    rows = re.compile(r"^\| `(\w+)` \| (.*?) \|", re.MULTILINE)
    return {title: dict(rows.findall(text)) for title, text in zip(parts[::2], parts[1::2], strict=True)}


def test_every_key_stands_in_the_document() -> None:
    told = {title: {key: _told(model, key) for key in model.model_fields} for title, model in MODELS.items()}
    assert _tables() == told


@pytest.mark.parametrize("number", range(3))
def test_every_example_of_the_document_loads(number: int, tmp_path: Path) -> None:
    examples = re.findall(r"^```toml\n(.*?)^```", SECTION, re.DOTALL | re.MULTILINE)
    assert len(examples) == 3
    for name in re.findall(r'"([\w*/-]+\.(?:toml|json|csv|png))"', examples[number]):
        file = tmp_path / name.replace("*", "1")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({}), encoding="utf-8")
    path = tmp_path / "alignment.toml"
    path.write_text(examples[number], encoding="utf-8")
    given = tomllib.loads(examples[number])
    loaded = read_alignment(path).model_dump(mode="json", exclude_unset=True)
    assert loaded.keys() == given.keys()
