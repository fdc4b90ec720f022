"""Lenses that no pinhole is: telecentric ones are refused by name, tilted sensors are calibrated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from contracts import refused, slow

from photogram.calibration.session import calibrate_pair
from photogram.camera import locate
from photogram.geometry import RigidTransform
from photogram.synthetic.board import Board, random_poses, random_rig
from photogram.targets.target_view import Target, TargetView

SIZE_PX, NOISE_PX = np.array([1280, 1024]), 0.03
FOCAL_PX, DEPTH_M = 2133.0, 0.2
BOARD = Board(Target("chessboard", 9e-3, (9, 7)))
Lens = Callable[[np.ndarray], np.ndarray]
Pairs = list[tuple[TargetView, TargetView]]


def telecentric(points_m: np.ndarray) -> np.ndarray:
    """Pixels of a lens whose magnification does not depend on distance, with a distortion of 1 % at the corners."""
    x = points_m[:, :2] / DEPTH_M
    return np.asarray(FOCAL_PX * x * (1.0 - 0.1 * np.sum(x**2, axis=1, keepdims=True)) + (SIZE_PX - 1) / 2)


def tilted(angle_rad: float) -> Lens:
    """A pinhole with distortion whose sensor is turned about its horizontal axis, by intersection of rays and plane."""
    along, down, normal = RigidTransform.from_pose(np.array([0, 0, 0, angle_rad, 0, 0])).rotation.T

    def lens(points_m: np.ndarray) -> np.ndarray:
        x = points_m[:, :2] / points_m[:, 2:]
        x = x * (1.0 - 0.1 * np.sum(x**2, axis=1, keepdims=True))
        ray = np.column_stack([x, np.ones(len(x))])
        met = ray * (normal[2] / (ray @ normal))[:, None] - np.array([0.0, 0.0, 1.0])
        return np.asarray(FOCAL_PX * np.column_stack([met @ along, met @ down]) + (SIZE_PX - 1) / 2)

    return lens


def session(lens: Lens, seed: int = 1, views: int = 12) -> tuple[Pairs, RigidTransform]:
    """Views of a chessboard by two such cameras, without images, and the pose of the right one."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng, SIZE_PX, field_m=0.12)
    covariance = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(BOARD.points_m), 2, 2))
    pairs = []
    for number, pose in enumerate(random_poses(rng, rig, BOARD, views)):
        left = pose.apply(BOARD.points_m)
        seen = [lens(points) for points in (left, rig.right_from_left.apply(left))]
        seen = [pixels + NOISE_PX * rng.standard_normal(pixels.shape) for pixels in seen]
        index = BOARD.index.astype(np.int64)
        one, other = (
            TargetView(f"{side}{number}", index, pixels, covariance, 0.0, 0.7, SIZE_PX)
            for side, pixels in zip("LR", seen, strict=True)
        )
        pairs.append((one, other))
    return pairs, rig.right_from_left


@pytest.mark.parametrize("seed", [1, *slow(2, 3)])
def test_a_telecentric_lens_is_refused_by_name(seed):
    words = r"^left camera: expected a lens with perspective, .* tilted by up to [3-6]\d° .*telecentric lens$"
    refused(words, calibrate_pair, session(telecentric, seed)[0], BOARD.target)


@pytest.mark.parametrize(
    ("angle_deg", "seed", "limit"),
    [(10.0, 3, 1e-3), *slow((0.0, 1, 1e-4), (2.0, 1, 1e-4), (5.0, 1, 1e-4), (5.0, 2, 1e-4), (10.0, 1, 1e-4))],
)
def test_a_tilted_sensor_is_a_pinhole_with_another_axis(angle_deg, seed, limit):
    """Scheimpflug: the residuals are the noise; lengths in the field, rms, suffer at 10° only, by the distortion."""
    lens = tilted(np.radians(angle_deg))
    pairs, right_from_left = session(lens, seed)
    found = calibrate_pair(pairs, BOARD.target)
    assert found.rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.05)
    assert {notice.code for notice in found.notices} <= {"SC-252", "SC-254", "SC-257", "SC-258", "SC-261"}
    middle = np.mean([view.left_from_target.apply(BOARD.points_m.mean(axis=0)) for view in found.views], axis=0)
    points = middle + np.random.default_rng(2).uniform(-0.02, 0.02, (200, 3))
    pixels = [lens(one)[None] for one in (points, right_from_left.apply(points))]
    seen = locate(found.rig, pixels).position_m[0]
    true_m, seen_m = (np.linalg.norm(one[:100] - one[100:], axis=1) for one in (points, seen))
    assert np.sqrt(np.mean((seen_m - true_m) ** 2)) < limit * np.sqrt(np.mean(true_m**2))
