"""A simulated recording with its own calibration, and with one in which the right camera stood otherwise."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion.manifest import find_recordings, load_manifest
from fusion.records import read_daqs
from fusion.settings import Settings, no_progress
from fusion.stereo_motion import StereoMotion, measure_images, open_images
from fusion.timing import tie_daqs
from photogram.calibration_file import read_calibration, write_calibration
from photogram.rigid import RigidTransform, rotation_from_vector

PAIR = "base"


def _measured(campaign: Path) -> StereoMotion:
    """The motion seen by one pair of the campaign's first recording."""
    manifest = load_manifest(find_recordings(campaign)[0])
    base = tie_daqs(manifest, read_daqs(manifest))
    (entry,) = (entry for entry in manifest.images if entry.stereo == PAIR)
    return measure_images(manifest, open_images(manifest, base, entry), Settings(), no_progress)


@pytest.mark.slow
@pytest.mark.parametrize("turn_mrad", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -0.5)])
def test_a_calibration_of_cameras_that_stood_otherwise_is_told(
    demo_recording: Path, tmp_path: Path, turn_mrad: tuple[float, float, float]
) -> None:
    campaign = tmp_path / "demo"
    shutil.copytree(demo_recording, campaign)
    path = campaign / "calibration" / f"{PAIR}.json"
    rig = read_calibration(path)
    turn = RigidTransform(rotation_from_vector(1e-3 * np.array(turn_mrad)), np.zeros(3))
    write_calibration(path, replace(rig, right_from_left=turn @ rig.right_from_left))
    measured = _measured(campaign)
    told = [notice for notice in measured.notices if notice.where == "epipolar residual"]
    if not any(turn_mrad):
        assert told == []
        return
    (notice,) = told
    assert notice.severity == "warning"
    about_x, about_z = (
        float(notice.text.split(f" mrad about its {name}")[0].rpartition(" ")[2]) for name in ("x axis", "optical axis")
    )
    assert about_x == pytest.approx(-turn_mrad[0], abs=0.05)  # the file's camera is turned, the real one turns back
    assert about_z == pytest.approx(-turn_mrad[2], abs=0.05)
