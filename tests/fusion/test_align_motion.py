"""Recordings as evidence: the demo puts a rig.toml right that is wrong by 5 mrad; axes place the camera."""

from __future__ import annotations

import json
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from alignment_factory import BODY_M, World, displaced, make_world

from fusion.cameras.align import _axis
from fusion.cameras.align_manifest import AxisBlock, Pair
from fusion.cli import main
from fusion.simulate.write import to_toml
from photogram.alignment.seen import calibration_steps
from photogram.alignment.solve import align
from photogram.camera import triangulate
from photogram.geometry import rotation_from_vector, vector_from_rotation
from photogram.motion import fit_motion
from photogram.subsets.reference import TrackStatus

WRONG_RAD = np.array([3.2e-3, -3.0e-3, 2.4e-3])
U_BEFORE = [1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3]


def true_direction(truth: dict[str, dict[str, dict[str, list[list[float]]]]]) -> np.ndarray:
    """Major axis of the load's translation at the fundamental."""
    load = truth["acceleration"]["load"]
    phasor = (np.array(load["re"]) + 1j * np.array(load["im"]))[0, :3]
    axis = (phasor * np.exp(-0.5j * np.angle((phasor**2).sum()))).real
    return np.asarray(axis / np.linalg.norm(axis))


@pytest.mark.slow
def test_one_direction_puts_two_angles_right(
    demo_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign = tmp_path / "demo"
    shutil.copytree(demo_recording, campaign)
    rig = tomllib.loads((campaign / "rig.toml").read_text(encoding="utf-8"))
    truth = json.loads((campaign / "Fz-0080" / "truth.json").read_text(encoding="utf-8"))
    stated = rig["stereo"]["top"]
    turn = rotation_from_vector(np.array(truth["drawn"]["top.pose"][3:]))
    true = turn @ np.array(stated["rotation"])
    wrong = rotation_from_vector(WRONG_RAD) @ true
    stated["rotation"] = wrong.tolist()
    (campaign / "rig.toml").write_text(to_toml(rig), encoding="utf-8")
    known = {"rotation": wrong.tolist(), "translation": stated["translation"], "pose_uncertainty": U_BEFORE}
    direction = true_direction(truth)
    motion = {
        "name": "along z",
        "recordings": "Fz-*/recording.toml",
        "direction": direction.tolist(),
        "direction_uncertainty": 1e-5,
    }
    head = {"format": 1, "stereo": "top", "calibration": "calibration/top.json", "scale_uncertainty": 2e-4}
    path = campaign / "alignment.toml"
    path.write_text(to_toml({**head, "motion": [motion]}), encoding="utf-8")
    assert main(["align", str(path), "-q"]) == 1
    assert "rotation about z and position along x, y and z are open" in capsys.readouterr().err
    path.write_text(to_toml({**head, "pose": known, "motion": [motion]}), encoding="utf-8")
    assert main(["align", str(path), "-q"]) == 0
    printed = capsys.readouterr()
    assert "moves on an ellipse" in printed.err
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
    status = np.full(left.shape[:2], TrackStatus.OK)
    sides = [SimpleNamespace(status=status, position_px=px) for px in (left, right)]
    tracks = SimpleNamespace(left=sides[0], right=sides[1])
    measured = SimpleNamespace(motion=fit_motion(points, None, np.zeros(3)), view=SimpleNamespace(tracks=tracks))
    manifest = SimpleNamespace(name="turned", path="turned/recording.toml")
    return SimpleNamespace(manifest=manifest, measured=measured, sensor_from_camera=provisional)


def test_two_axes_place_the_camera() -> None:
    normalised = []
    for seed in range(2):
        world = make_world(seed)
        pair = Pair(world.rig, calibration_steps(world.rig))
        evidence = []
        for name, direction in zip("xy", np.eye(3), strict=False):
            place = np.array([0.0, 0.01, 0.02])
            block = AxisBlock(
                name=name, recordings=(), point=tuple(place), direction=tuple(direction), direction_uncertainty=2e-5
            )
            found, notices = _axis(block, [seen_turning(world, place, direction)], pair)
            assert notices == []
            evidence.append(found)
        start = displaced(world.sensor_from_camera, np.full(6, 2e-3))
        result = align(evidence, start)
        normalised.append(world.error(result)[0] / result.u)
        assert result.u.max() < 2e-4
    assert np.abs(normalised).max() < 4.5


def test_an_unsteady_axis_is_told() -> None:
    world = make_world(1)
    seen = seen_turning(world, np.zeros(3), np.eye(3)[0])
    motion = seen.measured.motion
    seen.measured.motion = replace(motion, pose=motion.pose + 1e-4 * world.rng.normal(size=motion.pose.shape))
    block = AxisBlock(
        name="x", recordings=(), point=(0.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0), direction_uncertainty=2e-5
    )
    _, (notice,) = _axis(block, [seen], None)
    assert "turns about no fixed axis" in notice.text
