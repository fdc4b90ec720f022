"""A speckled body on a translation stage: 15 states of a published stereo DIC experiment."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photogram.calibration.file import read_calibration
from photogram.camera import Points, triangulate
from photogram.geometry import fit_rigid
from photogram.motion import RigidMotion, fit_motion

UM = 1e-6


@pytest.fixture(scope="module")
def stage_m(data_dir: Path) -> np.ndarray:
    with np.load(data_dir / "duodic_rigid" / "matched_points.npz") as file:
        return np.asarray(file["stage_translation_m"])


@pytest.fixture(scope="module")
def points(data_dir: Path) -> Points:
    rig = read_calibration(data_dir / "duodic_rigid" / "calibration.json")
    with np.load(data_dir / "duodic_rigid" / "matched_points.npz") as file:
        return triangulate(rig, file["left"], file["right"])


@pytest.fixture(scope="module")
def motion(points: Points) -> RigidMotion:
    return fit_motion(points, None, np.nanmean(points.position_m[0], axis=0))


def test_missing_matches_are_missing_points(points: Points) -> None:
    assert np.count_nonzero(np.isnan(points.reprojection_px)) == 1
    assert np.nanmedian(points.reprojection_px) < 0.06


def test_translation_agrees_with_the_stage(motion: RigidMotion, stage_m: np.ndarray) -> None:
    error = np.linalg.norm(motion.pose[:, :3], axis=1) - stage_m
    assert np.abs(error[1:]).mean() <= 1.8 * UM  # published for these images: 1.3 um; an independent evaluation: 1.69
    assert np.abs(error).max() < 4 * UM


def test_motion_is_one_straight_line(motion: RigidMotion) -> None:
    shift = motion.pose[:, :3]
    direction = shift[-1] / np.linalg.norm(shift[-1])
    across = shift - np.outer(shift @ direction, direction)
    assert np.linalg.norm(across, axis=1).max() < 10 * UM
    assert np.degrees(np.linalg.norm(motion.pose[:, 3:], axis=1)).max() * 3600 < 51  # arc seconds, published


def test_body_stays_rigid(points: Points) -> None:
    """Residual of Arun's fit: the stated bar. It grows with the travel: 0.88 um of the last state lie along it."""
    for position in points.position_m[1:]:
        known = np.isfinite(position).all(axis=1) & np.isfinite(points.position_m[0]).all(axis=1)
        first, now = points.position_m[0][known], position[known]
        residual = now - fit_rigid(first, now).apply(first)
        assert np.sqrt((residual**2).mean()) <= 1.0 * UM


def test_few_points_are_rejected(motion: RigidMotion) -> None:
    assert motion.points.min() > 0.99 * 3475
    assert motion.residual_m.max() < 1.4 * UM  # the likely fit weighs depth less and so leaves more of it
