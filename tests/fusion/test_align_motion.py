"""The demo recording as evidence: a rig.toml that is wrong by 5 mrad is put right by the direction of motion."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from fusion.cli import main
from fusion.simulate.toml_text import to_toml
from photogram.rigid import rotation_from_vector, vector_from_rotation

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
