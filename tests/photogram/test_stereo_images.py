"""Stereo pictures that pyvale's package carries: a rendered rigid plate, and the head of the Stereo-DIC Challenge."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from photogram.calibration.exchange.lens import rotation_from_cardan
from photogram.camera import Camera, StereoRig, epipolar_residual, triangulate
from photogram.geometry import RigidTransform
from photogram.images.image_files import open_sequence
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import lay_stereo_grid, match_stereo, track_sequence


@pytest.fixture(scope="module")
def package() -> Path:
    """The folder `data` of pyvale, found without importing it, or named by PYVALE_DATA."""
    found = find_spec("pyvale")
    places = list(found.submodule_search_locations or ()) if found is not None else []
    folder = Path(os.environ.get("PYVALE_DATA", Path(places[0]) / "data" if places else "none"))
    if not (folder / "dic").is_dir():
        pytest.skip("no pictures of pyvale: neither the package nor a folder named by PYVALE_DATA")
    return folder


def rig_of(path: Path, size: tuple[int, int], middle: bool) -> StereoRig:
    """The rig of a text of pyvale, x_1 = R·x_0 − t; with `middle`, principal points in the middle of the pictures."""
    value = {name: float(number) for name, number in (line.split(",") for line in path.read_text().split())}
    cameras = []
    for cam in ("cam0", "cam1"):
        fx, fy, skew, cx, cy = (value[f"{cam}_{name}_px"] for name in ("fx", "fy", "fs", "cx", "cy"))
        cx, cy = ((size[0] - 1) / 2, (size[1] - 1) / 2) if middle else (cx, cy)
        bent = np.array([value[f"{cam}_{name}"] for name in ("k1", "k2", "p1", "p2", "k3")])
        cameras.append(Camera(np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), bent, np.array(size)))
    rotation = rotation_from_cardan(np.array([value[name] for name in ("theta_deg", "phi_deg", "psi_deg")]))
    translation = -1e-3 * np.array([value[name] for name in ("tx_mm", "ty_mm", "tz_mm")])
    return StereoRig(*cameras, RigidTransform(rotation, translation))


def test_a_plate_moved_by_4_to_500_um_is_measured_within_10_nm(package):
    """The frames' numbers are tenths of 10 µm along x, and as much against y; pictures are cut out about the axis."""
    frames = (0, 4, 8, 10, 25, 50)
    left, right = (
        open_sequence([package / "dic" / "plate_rigid" / f"rigid_cam{cam}_frame{number:02d}.tiff" for number in frames])
        for cam in (0, 1)
    )
    rig = rig_of(package / "dic_ex08_stereo_calibration.txt", (250, 400), middle=True)
    settings = TrackSettings(radius_px=15, degree=7)
    grid = lay_stereo_grid(left, right, rig, settings)
    tracks = [track_sequence(*each, settings).position_px for each in ((left, grid.left_px), (right, grid.right_px))]
    points = triangulate(rig, *tracks).position_m
    moved_um = 1e6 * np.nanmean((points - points[0])[1:], axis=1)
    true_um = np.array([4.0, 8.0, 10.0, 250.0, 500.0])[:, None] * [1.0, -1.0, 0.0]
    np.testing.assert_allclose(moved_um[:, :2], true_um[:, :2], atol=0.01)
    np.testing.assert_allclose(moved_um[:, 2], 0.0, atol=0.03)


@pytest.mark.slow
def test_the_challenge_head_is_matched_all_over_its_widest_face(package):
    """Squares of 27 px side by side over the whole specimen, whose grooves and steps some of them straddle."""
    folder = package / "dic" / "stereo_challenge"
    left, right = (open_sequence([folder / f"Step01_00,00-sys1-0000_{cam}.tif"]).read(0) for cam in (0, 1))
    points = np.stack(np.meshgrid(np.arange(520.0, 1960.0, 27.0), np.arange(240.0, 1720.0, 27.0)), -1).reshape(-1, 2)
    matched = match_stereo(left, right, points, TrackSettings(radius_px=13))
    found, (x, y) = matched.status[0] == TrackStatus.OK, points.T
    assert found.mean() > 0.94
    plain = (x > 690) & (y > 1070) & (y < 1380)
    assert plain.sum() == 564
    assert found[plain].all()
    rig = rig_of(package / "dic_ex10_dic_chal_calibration.txt", left.shape[::-1], middle=False)
    off, _, _ = epipolar_residual(rig, points, matched.position_px[0])
    assert np.nanmedian(np.abs(off)) < 0.03
    assert np.std(off[plain]) < 0.1
