"""Self-check of a run: figure, data, and simulated recordings whose cameras stood otherwise than calibrated."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from evaluation_factory import make_evaluation

from fusion.base import Settings, no_progress
from fusion.phasors.stereo_motion import StereoMotion, measure_images, open_images
from fusion.phasors.timing import tie_daqs
from fusion.recording.files import read_daqs
from fusion.recording.load import find_recordings, load_manifest
from fusion.report.recorded import write_h5
from fusion.report.signal_figures import draw_epipolar
from fusion.sensitivity.analyse import Evaluation
from photogram.calibration.file import read_calibration, write_calibration
from photogram.geometry import RigidTransform, rotation_from_vector

PAIR = "base"


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    """A synthetic evaluation."""
    return make_evaluation(tmp_path_factory.mktemp("Fz"))


@pytest.mark.parametrize("with_covariance", [True, False])
def test_the_figure_says_what_the_calibration_explains(evaluation, with_covariance):
    check = evaluation.stereo[0].epipolar
    if not with_covariance:
        check = replace(check, pattern_covariance=None)
    picture = draw_epipolar(check, evaluation.stereo[0].time_s, "top")
    assert ("what calibration and matching explain" in picture.caption) == with_covariance
    assert picture.svg == draw_epipolar(check, evaluation.stereo[0].time_s, "top").svg


def test_the_figure_of_a_recording_without_points(evaluation):
    check = evaluation.stereo[0].epipolar
    nothing = replace(check, course_px=np.full_like(check.course_px, np.nan), residual_px=check.residual_px * np.nan)
    assert draw_epipolar(nothing, evaluation.stereo[0].time_s, "top").svg


def test_result_file_holds_the_check(evaluation, tmp_path):
    write_h5(tmp_path / "result.h5", evaluation, ())
    with h5py.File(tmp_path / "result.h5") as file:
        group = file[f"stereo/{evaluation.stereo[0].name}/epipolar"]
        assert group["course_px"].shape == (len(evaluation.stereo[0].time_s), 3)
        assert group["pattern_covariance"].shape == (3, 3)


def _measured(campaign: Path) -> StereoMotion:
    """The motion seen by one pair of the campaign's first recording."""
    manifest = load_manifest(find_recordings(campaign)[0])
    base = tie_daqs(manifest, read_daqs(manifest))
    (entry,) = (entry for entry in manifest.images if entry.stereo == PAIR)
    return measure_images(manifest, open_images(manifest, base, entry), Settings(), no_progress)


@pytest.mark.slow
@pytest.mark.parametrize("turn_mrad", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -0.5)])
def test_a_calibration_of_cameras_that_stood_otherwise_is_told(demo_recording, tmp_path, turn_mrad):
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
