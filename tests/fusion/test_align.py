"""The command `shakercal align`: alignment.toml to a block of rig.toml, on simulated cameras."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from alignment_factory import BODY_M, TARGET, World, between, displaced, face, make_world, target_pose
from pydantic import BaseModel
from support import DOCS, RefusedCommand, complex_of, documented_keys, examples, key_tables, truth_of

from fusion.cameras.align import _axis
from fusion.cameras.align_manifest import (
    AlignmentFile,
    AxisBlock,
    CalibratedPair,
    CommonView,
    FaceBlock,
    MotionBlock,
    OtherPair,
    PointBlock,
    PosePriorBlock,
    TargetBlock,
    TargetViewBlock,
    read_alignment,
)
from fusion.cameras.camera_notices import (
    ELLIPTICAL_MOTION,
    NEEDS_STEREO_PAIR,
    NO_POSE,
    PIXEL_TABLE,
    RIGHT_PIXEL_MISSING,
    SCALE_OF_SINGLE_CAMERA,
    UNLIKELY_SPACING,
    UNSTEADY_AXIS,
)
from fusion.cli import main
from fusion.recording.rig import Stereo
from fusion.recording.toml import to_toml
from photogram.alignment.alignment_evidence import calibration_steps
from photogram.alignment.pose_estimation import align
from photogram.calibration.calibration_file import write_calibration, write_camera
from photogram.camera import triangulate
from photogram.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from photogram.motion import fit_motion
from photogram.synthetic.board import render_board
from photogram.synthetic.patterns import Board
from photogram.targets.target_view import TargetView

DOC = (DOCS / "cameras.md").read_text(encoding="utf-8")
SECTION = DOC[DOC.index("## The camera frame in the sensor frame") :].split("\n## ")[0]
MODELS: dict[str, type[BaseModel]] = {
    "Top level": AlignmentFile,
    "`[pose]`": PosePriorBlock,
    "`[target]`": TargetBlock,
    "`[other]`": OtherPair,
    "`[[point]]`": PointBlock,
    "`[[face]]`": FaceBlock,
    "`[[target_view]]`": TargetViewBlock,
    "`[[common_view]]`": CommonView,
    "`[[motion]]`": MotionBlock,
    "`[[axis]]`": AxisBlock,
}
WRONG_RAD = np.array([3.2e-3, -3.0e-3, 2.4e-3])
U_BEFORE = [1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3]
TABLE = {"kind": TARGET.kind, "spacing": TARGET.spacing_m, "size": list(TARGET.size or ())}
Aligned = Callable[..., dict[str, Any]]


def fiducials(world: World, count: int = 8) -> list[dict[str, Any]]:
    """Blocks [[point]] of fiducials that the world's cameras see."""
    true = BODY_M + world.rng.uniform(-0.05, 0.05, (count, 3)) * np.array([1.0, 1.0, 0.4])
    left, right = world.see(true, 0.02)
    stated = true + 5e-6 * world.rng.normal(size=true.shape)
    keys = {"position_uncertainty": 5e-6, "pixel_uncertainty": 0.02}
    seen = zip(stated.tolist(), left.tolist(), right.tolist(), strict=True)
    return [{"name": f"P{n}", "position": x, "left": a, "right": b, **keys} for n, (x, a, b) in enumerate(seen)]


def write(folder: Path, world: World, **blocks: Any) -> Path:
    """Write calibration and alignment.toml into a folder."""
    write_calibration(folder / "top.json", world.rig)
    tables = {"format": 1, "stereo": "top", "calibration": "top.json", **blocks}
    path = folder / "alignment.toml"
    path.write_text(to_toml(tables), encoding="utf-8")
    return path


@pytest.fixture
def aligned(capsys: pytest.CaptureFixture[str]) -> Aligned:
    """Return a function that runs the command and returns the block that it prints, and the text as `text`."""

    def run(path: Path, *options: str) -> dict[str, Any]:
        assert main(["align", str(path), "-q", *options]) == 0
        text = capsys.readouterr().out
        ((_, pairs),) = tomllib.loads(text).items()
        ((_, block),) = pairs.items()
        return {**block, "text": text}

    return run


def normalised(block: dict[str, Any], true: RigidTransform) -> np.ndarray:
    """Displacement (6,) from the printed pose to the true one over its standard uncertainties."""
    found = RigidTransform(np.array(block["rotation"]), np.array(block["translation"]))
    return np.asarray(between(found, true) / np.array(block["pose_uncertainty"]))


def stated(pose: RigidTransform) -> dict[str, Any]:
    """The keys of a pose."""
    return {"rotation": pose.rotation.tolist(), "translation": pose.translation_m.tolist()}


def test_fiducials_give_a_block_of_the_rig(tmp_path: Path, aligned: Aligned) -> None:
    world = make_world(1)
    block = aligned(write(tmp_path, world, point=fiducials(world)), "-o", str(tmp_path / "pose.toml"))
    text = block.pop("text")
    assert (tmp_path / "pose.toml").read_text(encoding="utf-8") == text
    assert "[stereo.top]" in text
    assert " 8 points" in text
    assert "U (k = 2)" in text
    assert np.abs(normalised(block, world.sensor_from_camera)).max() < 4.5
    assert max(block["pose_uncertainty"][3:]) < 2e-4
    Stereo.model_validate({**block, "body": "load", "exposure": 1e-5})


def alone(folder: Path, world: World, **blocks: Any) -> Path:
    """Write the left camera's file and alignment.toml into a folder."""
    found: Any = SimpleNamespace(rig=world.rig, rms_px=0.02)
    write_camera(folder / "camera.json", found)
    return write(folder, world, **{"calibration": "camera.json", **blocks})


def test_a_single_camera_is_placed_by_fiducials_and_other_evidence_is_refused(
    tmp_path: Path, aligned: Aligned, refused: RefusedCommand
) -> None:
    world = make_world(1)
    seen = [{key: value for key, value in point.items() if key != "right"} for point in fiducials(world)]
    block = aligned(alone(tmp_path, world, point=seen))
    text = block.pop("text")
    assert "Pose of the camera" in text
    assert " 8 points" in text
    assert np.abs(normalised(block, world.sensor_from_camera)).max() < 4.5
    assert max(block["pose_uncertainty"][:3]) < 5e-4
    surface = {"point": [0, 0, 0.07], "normal": [0, 0, 1], "distance_uncertainty": 1e-4, "tilt_uncertainty": 1e-3}
    Stereo.model_validate({**block, "body": "load", "exposure": 1e-5, "surface": surface})
    for blocks, declared, key in (
        ({"point": fiducials(world)}, NEEDS_STEREO_PAIR, "point.P0.right"),
        ({"point": seen, "scale_uncertainty": 1e-4}, SCALE_OF_SINGLE_CAMERA, "scale_uncertainty"),
        (WRONG["face"][0], NEEDS_STEREO_PAIR, "face"),
    ):
        error = refused("align", alone(tmp_path, world, **blocks), "-q")
        assert f"{declared.code} " in error
        assert f": {key}: " in error
    error = refused("align", write(tmp_path, world, point=seen), "-q")
    assert f"{RIGHT_PIXEL_MISSING.code} " in error
    assert ": point.P0.right: " in error


def test_faces_come_from_tables_of_pixels(tmp_path: Path, aligned: Aligned) -> None:
    world, blocks = make_world(2), []
    for number in range(3):
        centre, normal, true = face(world, 0.4 + number * 2 * np.pi / 3, 40)
        table = np.concatenate(world.see(true, 0.02), axis=1)
        file = f"face-{number}.csv"
        np.savetxt(tmp_path / file, table, delimiter=",", header="left_x,left_y,right_x,right_y", comments="")
        keys = {"point": centre.tolist(), "normal": normal.tolist(), "pixel_uncertainty": 0.02}
        blocks.append({"name": f"{number}", "pixels": file, **keys})
    block = aligned(write(tmp_path, world, face=blocks))
    assert np.abs(normalised(block, world.sensor_from_camera)).max() < 4.5


def test_a_datum_adds_to_the_uncertainty(tmp_path: Path, aligned: Aligned) -> None:
    world, datum = make_world(3), np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 1e-3])
    points = fiducials(world)
    without, within = (
        np.array(aligned(write(tmp_path, world, point=points, datum_uncertainty=u))["pose_uncertainty"])
        for u in ([0.0] * 6, datum.tolist())
    )
    np.testing.assert_allclose(within**2 - without**2, datum**2, rtol=2e-2, atol=3e-11)


def test_undetermined_components_are_named_in_one_sentence(tmp_path: Path, refused: RefusedCommand) -> None:
    world = make_world(4)
    points = fiducials(world, 2)
    pose = displaced(world.sensor_from_camera, np.full(6, 1e-3))
    assert NO_POSE.code in refused("align", write(tmp_path, world, point=points), status=1)
    path = write(tmp_path, world, point=points, pose={**stated(pose), "pose_uncertainty": [0.2] * 6})
    output = tmp_path / "pose.toml"
    error = refused("align", path, "-o", output, status=1)
    assert NO_POSE.code in error
    assert "rotation" in error
    assert not output.exists()


def test_an_output_that_is_there_is_refused_without_force(
    tmp_path: Path, aligned: Aligned, refused: RefusedCommand
) -> None:
    world, output = make_world(5), tmp_path / "pose.toml"
    path = write(tmp_path, world, point=fiducials(world))
    output.write_text("mine", encoding="utf-8")
    assert "--force" in refused("align", path, "-o", output, "-q")
    assert output.read_text(encoding="utf-8") == "mine"
    text = aligned(path, "-o", str(output), "--force")["text"]
    assert output.read_text(encoding="utf-8") == text
    refused("align", path, "-o", tmp_path / "none" / "pose.toml", "-q")


AT_ORIGIN = {"rotation": np.eye(3).tolist(), "translation": [0.0] * 3}
WRONG = {
    "calibration": ({"calibration": "none.json"}, "alignment.toml: calibration: "),
    "no evidence": ({"point": []}, "[[point]]"),
    "unknown key": ({"points": []}, ' "point"'),
    "a certain pose": (
        {"pose": {**AT_ORIGIN, "pose_uncertainty": [0.0] * 6}},
        "pose.pose_uncertainty: ",
    ),
    "target in mm": (
        {
            "target": {**TABLE, "spacing": 8.0},
            "target_view": [{"name": "a", "left": "top.json", **AT_ORIGIN}],
        },
        UNLIKELY_SPACING.code,
    ),
    "target view": (
        {"target_view": [{"name": "a", "left": "top.json", **AT_ORIGIN}]},
        "target: ",
    ),
    "no picture": (
        {"target": TABLE, "target_view": [{"name": "plate", "left": "top.json", **AT_ORIGIN}]},
        "target_view.plate.left: ",
    ),
    "motion": (
        {"motion": [{"name": "z", "recordings": "*/recording.toml", "direction_uncertainty": 1e-3}]},
        "motion.z.recordings: ",
    ),
    "face": (
        {"face": [{"name": "t", "point": [0] * 3, "normal": [0, 0, 1], "pixels": "top.json", "pixel_uncertainty": 1}]},
        PIXEL_TABLE.code,
    ),
    "names": ({"point": "twice"}, '"P0"'),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_wrong_input_is_told_in_one_sentence(name: str, tmp_path: Path, refused: RefusedCommand) -> None:
    blocks, expected = WRONG[name]
    world = make_world(6)
    points = fiducials(world, 3)
    given = {"point": [*points, points[0]]} if name == "names" else {"point": points, **blocks}
    assert expected in refused("align", write(tmp_path, world, **given))


def test_every_key_stands_in_the_document() -> None:
    assert key_tables(SECTION[SECTION.index("### Every key") :], "####") == documented_keys(MODELS)


@pytest.mark.parametrize("number", range(3))
def test_every_example_of_the_document_loads(number: int, tmp_path: Path) -> None:
    shown = examples(SECTION)
    assert len(shown) == 3
    for name in re.findall(r'"([\w*/-]+\.(?:toml|json|csv|png))"', shown[number]):
        file = tmp_path / name.replace("*", "1")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({}), encoding="utf-8")
    path = tmp_path / "alignment.toml"
    path.write_text(shown[number], encoding="utf-8")
    given = tomllib.loads(shown[number])
    loaded = read_alignment(path).model_dump(mode="json", exclude_unset=True)
    assert loaded.keys() == given.keys()


class Pictures:
    """Pictures of a target in a folder: rendered ones, or empty files for which a detector answers what is seen."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch, rendered: bool) -> None:
        self.folder, self.rendered, self.views = folder, rendered, dict[str, TargetView]()
        if not rendered:
            patch.setattr("fusion.cameras.align_manifest.read_image", lambda path: (path.read_text(), 1.0))
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


def test_a_target_at_a_known_pose(pictures: Pictures, aligned: Aligned) -> None:
    world, folder = make_world(1), pictures.folder
    seen = target_pose(world.rng, 0.15)
    keys = {**stated(world.sensor_from_camera @ seen), "pose_uncertainty": [1e-6] * 3 + [1e-5] * 3}
    view = {"name": "plate", **pictures.take("plate", world, seen), **keys}
    block = aligned(write(folder, world, target=TABLE, target_view=[view]))
    assert " 1 target view." in block["text"]
    assert np.abs(normalised(block, world.sensor_from_camera)).max() < 4.5
    del view["right"]
    one = aligned(alone(folder, world, target=TABLE, target_view=[view]))
    assert "Pose of the camera" in one["text"]
    assert np.abs(normalised(one, world.sensor_from_camera)).max() < 4.5


def test_common_views_give_the_relative_pose(pictures: Pictures, aligned: Aligned) -> None:
    (own, other), folder = (make_world(2), make_world(3)), pictures.folder
    write_calibration(folder / "other.json", other.rig)
    held, seen_by_other = target_pose(own.rng, 0.15), target_pose(other.rng, 0.15)
    true = seen_by_other @ held.inverse()  # the other camera's frame from this one's
    view = {"name": "a", **pictures.take("ours", own, held)}
    view |= {f"other_{side}": name for side, name in pictures.take("theirs", other, seen_by_other).items()}
    pair = {"stereo": "side", "calibration": "other.json"}
    block = aligned(write(folder, own, target=TABLE, other=pair, common_view=[view]))
    assert "[relative.top]" in block["text"]
    assert " side, from" in block["text"]
    assert np.abs(normalised(block, true)).max() < 4.5


@pytest.mark.slow
def test_one_direction_puts_two_angles_right(
    demo_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign = tmp_path / "demo"
    shutil.copytree(demo_recording, campaign)
    rig = tomllib.loads((campaign / "rig.toml").read_text(encoding="utf-8"))
    truth = truth_of(campaign / "Fz-0080")
    known = rig["stereo"]["top"]
    turn = rotation_from_vector(np.array(truth["drawn"]["top.pose"][3:]))
    true = turn @ np.array(known["rotation"])
    wrong = rotation_from_vector(WRONG_RAD) @ true
    known["rotation"] = wrong.tolist()
    (campaign / "rig.toml").write_text(to_toml(rig), encoding="utf-8")
    before = {"rotation": wrong.tolist(), "translation": known["translation"], "pose_uncertainty": U_BEFORE}
    phasor = complex_of(truth["acceleration"]["load"])[0, :3]
    major = (phasor * np.exp(-0.5j * np.angle((phasor**2).sum()))).real  # axis of the load's translation
    motion = {"name": "along z", "recordings": "Fz-*/recording.toml", "direction_uncertainty": 1e-5}
    motion["direction"] = (major / np.linalg.norm(major)).tolist()
    head = {"format": 1, "stereo": "top", "calibration": "calibration/top.json", "scale_uncertainty": 2e-4}
    path = campaign / "alignment.toml"
    path.write_text(to_toml({**head, "motion": [motion]}), encoding="utf-8")
    assert main(["align", str(path), "-q"]) == 1
    error = capsys.readouterr().err
    assert NO_POSE.code in error
    assert re.search("rotation.* z .*position.* x, y.* z ", error)
    path.write_text(to_toml({**head, "pose": before, "motion": [motion]}), encoding="utf-8")
    assert main(["align", str(path), "-q"]) == 0
    printed = capsys.readouterr()
    assert ELLIPTICAL_MOTION.code in printed.err
    block = tomllib.loads(printed.out)["stereo"]["top"]
    error = vector_from_rotation(true @ np.array(block["rotation"]).T)
    u = np.array(block["pose_uncertainty"])[3:]
    assert (np.abs(error) < 4.5 * u).all()
    assert np.abs(error[:2]).max() < 1e-3 < np.abs(WRONG_RAD[:2]).min()
    assert u[:2].max() < 8e-4
    assert u[2] == pytest.approx(5e-3, rel=0.05)


def seen_turning(world: World, point_m: np.ndarray, direction: np.ndarray) -> SimpleNamespace:
    """A recording of a body that turns about an axis, as far as the evidence of an axis looks at it."""
    rng, provisional = world.rng, displaced(world.sensor_from_camera, np.full(6, 2e-3))
    body = BODY_M + rng.uniform(-0.04, 0.04, (40, 3)) * np.array([1.0, 1.0, 0.3])
    turns = rotation_from_vector(np.concatenate([[0.0], rng.uniform(-0.05, 0.05, 29)])[:, None] * direction)
    to_camera = world.sensor_from_camera.inverse()
    moved = (body - point_m) @ np.swapaxes(turns, 1, 2) + point_m
    left, right = (px + 0.01 * rng.normal(size=px.shape) for px in world.true.project(to_camera.apply(moved)))
    noise = 0.01**2 * np.eye(2)
    points = triangulate(world.rig, left, right, noise, noise).transformed(provisional)
    tracks = [
        SimpleNamespace(left=SimpleNamespace(position_px=left[some]), right=SimpleNamespace(position_px=right[some]))
        for some in (slice(0, 12), slice(12, 24), slice(24, None))
    ]
    measured = SimpleNamespace(motion=fit_motion(points, None, np.zeros(3)), view=SimpleNamespace(tracks=tracks))
    manifest = SimpleNamespace(name="turned", path="turned/recording.toml")
    return SimpleNamespace(manifest=manifest, measured=measured, sensor_from_camera=provisional)


def axis(name: str, point_m: np.ndarray, direction: np.ndarray) -> AxisBlock:
    known = {"point": tuple(point_m), "direction": tuple(direction), "direction_uncertainty": 2e-5}
    return AxisBlock(name=name, recordings=(), **known)


def test_two_axes_place_the_camera() -> None:
    normalised = []
    for seed in range(2):
        world = make_world(seed)
        pair = CalibratedPair(world.rig, calibration_steps(world.rig))
        evidence = []
        for name, direction in zip("xy", np.eye(3), strict=False):
            place = np.array([0.0, 0.01, 0.02])
            known, notices = _axis(axis(name, place, direction), seen_turning(world, place, direction), pair)
            assert notices == []
            evidence.append(known)
        start = displaced(world.sensor_from_camera, np.full(6, 2e-3))
        result = align(evidence, start)
        normalised.append(world.error(result)[0] / result.u)
        assert result.u.max() < 2e-4
    assert np.abs(normalised).max() < 4.5


def test_an_unsteady_axis_gives_a_warning() -> None:
    world = make_world(1)
    seen = seen_turning(world, np.zeros(3), np.eye(3)[0])
    motion = seen.measured.motion
    seen.measured.motion = replace(motion, pose=motion.pose + 1e-4 * world.rng.normal(size=motion.pose.shape))
    _, (notice,) = _axis(axis("x", np.zeros(3), np.eye(3)[0]), seen, None)
    assert notice.code == UNSTEADY_AXIS.code
    assert notice.values["ratio"] > 2
