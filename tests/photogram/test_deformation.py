"""Residuals beside a rigid motion, against points that move as they are told."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.camera import Points
from photogram.geometry import rotation_from_vector
from photogram.motion import Deformation, RigidMotion, deformation, fit_motion

ROOT = np.array([[0.3, 0.0, 0.0], [0.05, 0.25, 0.0], [0.1, -0.2, 0.9]]) * 1e-6
FRAMES = 60


def plate(columns: int = 9, rows: int = 7) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, columns), np.linspace(-0.04, 0.04, rows))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.02)])


def moving(rng: np.random.Generator, bent: np.ndarray | float = 0.0, uneven: float = 10.0) -> Points:
    """Points whose noise grows away from the middle; the reference frame has noise of its own."""
    rest = plate()
    pose = np.concatenate([rng.normal(0, 1e-4, (FRAMES, 3)), rng.normal(0, 0.02, (FRAMES, 3))], axis=1)
    pose[0] = 0.0
    moved = (rest + bent) @ np.swapaxes(rotation_from_vector(pose[:, 3:]), 1, 2) + pose[:, None, :3]
    grow = (1.0 + uneven * np.abs(rest[:, 0]))[:, None, None]
    noise = rng.normal(size=moved.shape)[..., None, :] @ np.swapaxes(grow * ROOT, 1, 2)
    covariance = np.broadcast_to(grow**2 * (ROOT @ ROOT.T), (*moved.shape, 3))
    return Points(moved + noise[..., 0, :], covariance, np.zeros(moved.shape[:2]))


def about(points: Points) -> tuple[RigidMotion, Deformation]:
    """Against the first frame, whose noise is that of the reference."""
    motion = fit_motion(points, None, np.array([0.01, 0.0, -0.03]))
    return motion, deformation(points, motion)


def squares(shape: Deformation) -> np.ndarray:
    return np.einsum("fni,fnij,fnj->fn", shape.residual_m, np.linalg.inv(shape.covariance_m2), shape.residual_m)


def test_a_rigid_body_leaves_noise_of_the_stated_covariance() -> None:
    """Chi-square of all points, and of each point, over 8 series."""
    found = np.array([squares(about(moving(np.random.default_rng(seed)))[1]) for seed in range(8)])
    assert found.mean() / 3 == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(found.mean(axis=(0, 1)) / 3, 1.0, atol=0.2)


def test_without_the_leverage_of_the_fit_few_points_would_look_too_still() -> None:
    points = moving(np.random.default_rng(9))
    few = np.array([0, 8, 30, 54, 62])
    part = Points(points.position_m[:, few], points.covariance_m2[:, few], points.reprojection_px[:, few])
    shape = about(part)[1]
    full = np.linalg.inv(part.covariance_m2)
    assert squares(shape).mean() / 3 == pytest.approx(1.0, abs=0.1)
    assert np.einsum("fni,fnij,fnj->fn", shape.residual_m, full, shape.residual_m).mean() / 3 < 0.7


def test_bending_comes_back_in_the_axes_of_the_body() -> None:
    """A saddle, orthogonal to all rigid motions, that turns with the body; constant parts are not seen."""
    rest = plate()
    saddle = rest[:, 0] ** 2 / np.mean(rest[:, 0] ** 2) - rest[:, 1] ** 2 / np.mean(rest[:, 1] ** 2)
    swing = np.sin(np.arange(FRAMES))
    bent = np.zeros((FRAMES, len(rest), 3))
    bent[..., 2] = 2e-6 * np.multiply.outer(swing, saddle)
    points = moving(np.random.default_rng(10), bent, 0.0)
    shape = deformation(points, fit_motion(points, rest, np.zeros(3)), rest)
    swing -= swing.mean()
    found = np.einsum("k,kni->ni", swing, shape.residual_m) / np.sum(swing**2)
    u = np.sqrt(np.diagonal(ROOT @ ROOT.T) / np.sum(swing**2))
    truth = np.zeros_like(found)
    truth[:, 2] = 2e-6 * saddle
    assert np.mean(((found - truth) / u) ** 2) == pytest.approx(1.0, abs=0.25)
    assert np.abs(truth).max() > 20 * u.max()


def test_missing_points_are_missing_and_harm_nobody() -> None:
    points = moving(np.random.default_rng(11))
    points.position_m[5, 3] = np.nan
    points.position_m[:, 7] = np.nan
    shape = about(points)[1]
    missing = np.zeros((FRAMES, len(plate())), bool)
    missing[5, 3], missing[:, 7] = True, True
    np.testing.assert_array_equal(np.isnan(shape.residual_m).all(axis=2), missing)
    np.testing.assert_array_equal(np.isnan(shape.covariance_m2).any(axis=(2, 3)), missing)
    np.testing.assert_allclose(np.nanmean(shape.residual_m[:, [0, 3]], axis=0), 0.0, atol=1e-18)


def test_wrong_calls_are_named() -> None:
    points = moving(np.random.default_rng(12))
    motion = fit_motion(points, None, np.zeros(3))
    with pytest.raises(ValueError, match="reference_m: expected an array of shape"):
        deformation(points, motion, np.zeros((4, 3)))
    part = Points(points.position_m[1:], points.covariance_m2[1:], points.reprojection_px[1:])
    with pytest.raises(ValueError, match=r"motion\.pose: expected an array of shape"):
        deformation(part, motion)
