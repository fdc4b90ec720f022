"""Calibrations of other programs against what those programs, and the recordings they belong to, say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photogram.calibration.foreign_formats import import_calibration
from photogram.camera import StereoRig
from photogram.geometry import skew

GT4_CAMERAS = (
    (  # VIC-3D's calibration of the recording GT4, as DICe's regression test of it holds it
        "955.0537385 645.2301624 6636.033383 6636.440175 -0.0005693077075",
        (-0.0001957515272, 0.8739544595, -26.91426143),
        "179.933221 9.415993919 -0.05775865407 -58.20738494 0.1641145944 20.16820788",
    ),
    (
        "971.3275619 615.7965508 6609.847619 6609.16693 0.7051020868",
        (-0.00522596687, 1.077694686, -30.05404073),
        "-179.9418875 -9.416050875 0.04747312256 59.84373321 0.2184759676 21.04719884",
    ),
)


def _gt4(folder: Path, sign: float) -> StereoRig:
    """The rig of GT4 with the distortion coefficients multiplied by a factor."""
    cameras = "".join(
        f'<camera id="{index}">{inner} {" ".join(str(sign * k) for k in radial)}'
        f"<orientation>{outer}</orientation></camera>"
        for index, (inner, radial, outer) in enumerate(GT4_CAMERAS)
    )
    path = folder / "cal.xml"
    path.write_text(f"<project><calibration>{cameras}</calibration></project>", encoding="utf-8")
    return import_calibration(path, (1920, 1200)).rig


def _epipolar_px(rig: StereoRig, left_px: np.ndarray, right_px: np.ndarray) -> np.ndarray:
    """Sampson's distance of matches from the epipolar lines of the undistorted pictures, px."""
    left, right = (
        np.column_stack([camera.undistort(pixel), np.ones(len(pixel))])
        for camera, pixel in ((rig.left, left_px), (rig.right, right_px))
    )
    essential = skew(rig.right_from_left.translation_m) @ rig.right_from_left.rotation
    lines, back = left @ essential.T, right @ essential
    gradient = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    return np.asarray((right * lines).sum(axis=1) / gradient * rig.left.matrix[0, 0])


def test_vic3d_calibration_fits_the_matches_of_its_recording(data_dir: Path, tmp_path: Path) -> None:
    table = np.genfromtxt(
        data_dir / "gt4_stereo" / "GT4-0273_0_epipolar_sift_r16.csv", delimiter=",", names=True, dtype=np.float64
    )
    left = np.column_stack([table["x"], table["y"]])
    right = np.column_stack([table["r2_x"], table["r2_y"]])
    residuals = {sign: _epipolar_px(_gt4(tmp_path, sign), left, right) for sign in (1.0, 0.0, -1.0)}
    spread = {sign: 1.4826 * np.median(np.abs(e - np.median(e))) for sign, e in residuals.items()}
    assert abs(np.median(residuals[1.0])) < 0.1
    assert spread[1.0] < 0.02
    assert spread[1.0] < 0.95 * spread[0.0] < 0.95 * spread[-1.0]
    median = {sign: abs(np.median(e)) for sign, e in residuals.items()}
    assert median[1.0] < median[0.0] < median[-1.0]


def test_vic3d_project(data_dir: Path) -> None:
    imported = import_calibration(data_dir / "static_stereo" / "cal.xml")
    rig = imported.rig
    assert imported.format == "VIC-3D"
    assert rig.left.size_px.tolist() == [1280, 800]
    assert rig.right_from_left.translation_m[0] == pytest.approx(0.1308, abs=1e-4)
    angle = np.rad2deg(np.arccos((np.trace(rig.right_from_left.rotation) - 1) / 2))
    assert angle == pytest.approx(2 * 9.015, abs=0.01)
    assert all(notice.severity == "info" for notice in imported.notices)


def test_dice_text_of_a_peer(data_dir: Path) -> None:
    path = data_dir / "dotgrid_stereo" / "peer_cal.txt"
    with pytest.raises(ValueError, match="image_size"):
        import_calibration(path)
    imported = import_calibration(path, (2448, 2048))
    rig = imported.rig
    np.testing.assert_allclose(rig.left.parameters[:4], [12577.41, 12575.82, 1202.508, 1056.028], atol=0.2)
    assert rig.right.parameters[4] == 0.07
    translation = [-0.086494, 0.000582, 0.02353]
    np.testing.assert_allclose(rig.right_from_left.translation_m, translation, atol=2e-5)
    warned = [notice.text for notice in imported.notices if notice.severity == "warning"]
    assert len(warned) == 2
    assert "a skew of -2.85 px" in warned[0]
