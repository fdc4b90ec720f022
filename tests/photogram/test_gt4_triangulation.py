"""Another program's stereo matches and the points it made of them: OpenCorr on the D-shaped specimen."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from photogram.calibration.file import read_calibration
from photogram.camera import StereoRig, triangulate

UM = 1e-6
STATES = {"reference": (("x", "y"), ("r2_x", "r2_y"), "ref"), "loaded": (("t1_x", "t1_y"), ("t2_x", "t2_y"), "tar")}


@pytest.fixture(scope="module")
def rig(data_dir: Path) -> StereoRig:
    return read_calibration(data_dir / "gt4_stereo" / "calibration.json")


@pytest.fixture(scope="module", params=list(STATES))
def state(request: pytest.FixtureRequest, data_dir: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left px (N, 2), right px (N, 2), the peer's points (N, 3) in m."""
    path = data_dir / "gt4_stereo" / "GT4-0273_0_epipolar_sift_r16.csv"
    table = np.genfromtxt(path, delimiter=",", names=True)
    left, right, name = STATES[request.param]
    position = np.column_stack([table[f"{name}_{axis}"] for axis in "xyz"]) * 1e-3
    return np.column_stack([table[n] for n in left]), np.column_stack([table[n] for n in right]), position


def test_triangulation_reproduces_the_peers_points(rig: StereoRig, state: tuple[np.ndarray, ...]) -> None:
    left, right, peer = state
    found = triangulate(rig, left[None], right[None])
    distance = np.linalg.norm(found.position_m[0] - peer, axis=1)
    assert np.median(distance) < 0.1 * UM
    # The peer solves the four collinearity equations linearly; where a match is poor the two optima part.
    consistent = found.reprojection_px[0] < 0.25
    assert np.count_nonzero(~consistent) <= 5
    assert distance[consistent].max() < 0.5 * UM
    assert np.count_nonzero(distance > 0.5 * UM) <= 3


def test_peers_points_are_those_of_the_linear_method(rig: StereoRig, state: tuple[np.ndarray, ...]) -> None:
    """With our undistorted pixels OpenCV's linear triangulation gives the peer's points: the cameras agree."""
    left, right, peer = state
    transform = rig.right_from_left
    sides = (
        (rig.left, np.eye(3, 4), left),
        (rig.right, np.column_stack([transform.rotation, transform.translation_m]), right),
    )
    matrices = [camera.matrix @ pose for camera, pose, _ in sides]
    ideal = [camera.undistort(px) @ camera.matrix[:2, :2].T + camera.matrix[:2, 2] for camera, _, px in sides]
    homogeneous = cv2.triangulatePoints(*matrices, ideal[0].T, ideal[1].T)
    distance = np.linalg.norm((homogeneous[:3] / homogeneous[3]).T - peer, axis=1)
    assert np.median(distance) < 0.06 * UM
    assert distance.max() < 0.4 * UM
