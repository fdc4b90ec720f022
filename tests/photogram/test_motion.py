"""Rigid motion: invariants, Monte Carlo of its covariance, outliers, missing points, change of reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from photogram.camera import Points
from photogram.geometry import RigidTransform, fit_rigid
from photogram.motion import RigidMotion, fit_motion, points_with_estimated_noise, relative_to

ORIGIN = np.array([0.02, -0.01, 0.35])
NOISE = np.array([[1.0, 0.2, 0.5], [0.2, 1.5, -0.4], [0.5, -0.4, 9.0]]) * 1e-12  # depth is the weak direction
QUANTILE_95 = 12.591587243743977  # of χ² with six degrees of freedom
poses = arrays(np.float64, 6, elements=st.floats(-1.0, 1.0, allow_subnormal=False))


def body(count: int, seed: int = 0, depth: float = 2e-3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.05, 0.05, (count, 2)), 0.4 + depth * rng.normal(size=count)])


def moved(reference: np.ndarray, pose: np.ndarray, origin: np.ndarray = ORIGIN) -> np.ndarray:
    return RigidTransform.from_pose(pose).apply(reference - origin) + origin


def of(position: np.ndarray, covariance: np.ndarray = NOISE) -> Points:
    known = np.isfinite(position).all(axis=2)[..., None, None]
    return Points(position, np.where(known, covariance, np.nan), np.zeros(position.shape[:2]))


def shaking(frames: int, seed: int = 1, angle: float = 2e-3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.normal(0, 4e-4, (frames, 3)), rng.normal(0, angle, (frames, 3))])


def varying_noise(frames: int, count: int) -> np.ndarray:
    """Covariances that differ from point to point, in size and direction."""
    rng = np.random.default_rng(8)
    turn = RigidTransform.from_pose(np.array([0, 0, 0, 0.3, -0.2, 0.1])).rotation
    each = rng.uniform(0.3, 3.0, count)[:, None, None] ** 2 * NOISE
    each[::2] = turn @ each[::2] @ turn.T
    return np.broadcast_to(each, (frames, count, 3, 3))


def sample(frames: int, count: int, pose: np.ndarray, seed: int) -> tuple[np.ndarray, Points]:
    reference, covariance = body(count), varying_noise(frames, count)
    error = (np.linalg.cholesky(covariance) @ np.random.default_rng(seed).normal(size=(frames, count, 3, 1)))[..., 0]
    return reference, of(np.stack([moved(reference, one) for one in pose]) + error, covariance)


def mahalanobis(motion: RigidMotion, pose: np.ndarray) -> np.ndarray:
    error = motion.pose - pose
    return np.einsum("fi,fij,fj->f", error, np.linalg.inv(motion.covariance), error)


def check_coverage(square: np.ndarray) -> None:
    assert abs(square.mean() - 6) < 4 * np.sqrt(12 / len(square))
    assert abs(np.mean(square < QUANTILE_95) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / len(square))


@given(poses, poses)
@settings(max_examples=30, deadline=None)  # the first call compiles
def test_exact_motion_comes_back(first: np.ndarray, second: np.ndarray) -> None:
    reference = body(20)
    found = fit_motion(of(np.stack([moved(reference, first), moved(reference, second)])), reference, ORIGIN)
    np.testing.assert_allclose(found.pose, [first, second], atol=1e-11)
    np.testing.assert_array_equal(found.points, 20)
    assert found.residual_m.max() < 1e-13


@given(poses)
@settings(max_examples=30, deadline=None)  # the first call compiles
def test_another_frame_of_coordinates_turns_the_motion_with_it(change: np.ndarray) -> None:
    reference, points = sample(3, 30, shaking(3, angle=0.3), 5)
    new_from_old = RigidTransform.from_pose(change)
    direct = fit_motion(points, reference, ORIGIN)
    turned = fit_motion(points.transformed(new_from_old), new_from_old.apply(reference), new_from_old.apply(ORIGIN))
    both = np.kron(np.eye(2), new_from_old.rotation)
    np.testing.assert_allclose(turned.pose, direct.pose @ both.T, atol=1e-10)
    sigma = np.sqrt(np.diagonal(turned.covariance, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(turned.covariance / scale, both @ direct.covariance @ both.T / scale, atol=1e-6)
    np.testing.assert_allclose(turned.residual_m, direct.residual_m, rtol=1e-6)


def test_equal_isotropic_noise_gives_aruns_fit() -> None:
    reference = body(40)
    position = np.stack([moved(reference, one) for one in shaking(3, angle=0.5)])
    position += np.random.default_rng(2).normal(0, 1e-6, position.shape)
    found = fit_motion(of(position, 1e-12 * np.eye(3)), reference, ORIGIN)
    np.testing.assert_array_equal(found.points, 40)
    for pose, one in zip(found.pose, position, strict=True):
        np.testing.assert_allclose(pose, fit_rigid(reference - ORIGIN, one - ORIGIN).pose, atol=1e-12)


@pytest.mark.parametrize("angle", [2e-3, 0.5])
def test_stated_covariance_contains_the_truth_as_often_as_it_says(angle: float) -> None:
    pose = shaking(4000, angle=angle)
    reference, points = sample(4000, 12, pose, 3)
    check_coverage(mahalanobis(fit_motion(points, reference, ORIGIN), pose))


def test_noise_of_the_reference_is_one_constant_and_not_in_the_covariance() -> None:
    pose = shaking(3000)
    _, points = sample(3000, 12, pose, 4)
    wrong = sample(1, 12, np.zeros((1, 6)), 5)[1].position_m[0]
    found = fit_motion(points, wrong, ORIGIN)
    error = found.pose - pose
    constant = error.mean(axis=0)
    assert constant @ np.linalg.inv(found.covariance[0]) @ constant > 1  # a constant of the size of one frame's noise
    ratio = np.cov(error.T).diagonal() / found.covariance.mean(axis=0).diagonal()
    np.testing.assert_allclose(ratio, 1, atol=4 * np.sqrt(2 / 3000) + 0.02)


def test_frame_zero_is_the_default_reference_with_zero_pose_and_its_own_noise() -> None:
    _, points = sample(5, 30, shaking(5), 6)
    found = fit_motion(points, None, ORIGIN)
    np.testing.assert_allclose(found.pose[0], 0, atol=1e-15)
    assert found.residual_m[0] < 1e-15
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma[0], sigma[1], rtol=0.02)
    assert found.points[0] == 30


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_outliers_are_found_and_do_not_count(share: float) -> None:
    pose = shaking(400, seed=9)
    reference, clean = sample(400, 60, pose, 7)
    rng = np.random.default_rng(10)
    outlying = rng.uniform(size=(400, 60)) < share
    position = clean.position_m + np.where(outlying[..., None], rng.normal(1e-3, 1e-3, (400, 60, 3)), 0.0)
    found = fit_motion(of(position, clean.covariance_m2), reference, ORIGIN)
    assert np.mean(found.points == (~outlying).sum(axis=1)) > 0.95
    check_coverage(mahalanobis(found, pose))
    assert found.residual_m.max() < 6e-6


def test_points_that_are_good_are_kept() -> None:
    reference, points = sample(200, 500, shaking(200), 11)
    found = fit_motion(points, reference, ORIGIN)
    rejected = 1 - found.points.sum() / (200 * 500)
    assert rejected < 1e-4


def test_an_outlier_is_judged_by_its_own_covariance() -> None:
    reference = body(30)
    position = np.stack([moved(reference, one) for one in shaking(2)])
    position += np.random.default_rng(0).normal(0, 1e-6, position.shape)
    position[:, 0, 2] += 50e-6
    position[:, 1, 0] += 50e-6
    covariance = np.broadcast_to(1e-12 * np.eye(3), (2, 30, 3, 3)).copy()
    covariance[:, 0, 2, 2] = covariance[:, 1, 2, 2] = 50e-6**2
    found = fit_motion(of(position, covariance), reference, ORIGIN)
    np.testing.assert_array_equal(found.points, 29)


def test_a_factor_in_the_stated_noise_passes_to_the_covariance_and_nowhere_else() -> None:
    reference, points = sample(5, 30, shaking(5), 6)
    found = fit_motion(points, reference, ORIGIN)
    tenfold = fit_motion(of(points.position_m, 100 * points.covariance_m2), reference, ORIGIN)
    np.testing.assert_allclose(tenfold.covariance, 100 * found.covariance, rtol=1e-9)
    np.testing.assert_allclose(tenfold.pose, found.pose, atol=1e-13)
    np.testing.assert_array_equal(tenfold.points, found.points)


def test_missing_points_are_passed_over() -> None:
    reference, points = sample(4, 30, shaking(4), 12)
    position = points.position_m.copy()
    position[1, 3:] = np.nan  # three points left
    position[2, 2:] = np.nan  # two
    position[3, ::2, 1] = np.nan
    found = fit_motion(of(position, points.covariance_m2), reference, ORIGIN)
    np.testing.assert_array_equal(found.points, [30, 3, 0, 15])
    for array in (found.pose, found.covariance, found.residual_m):
        assert np.isnan(array[2]).all()
        assert np.isfinite(array[[0, 1, 3]]).all()
    alone = fit_motion(of(position[3:, 1::2], points.covariance_m2[3:, 1::2]), reference[1::2], ORIGIN)
    np.testing.assert_allclose(found.pose[3], alone.pose[0], atol=1e-14)


def test_points_missing_in_the_reference_do_not_count() -> None:
    _, points = sample(3, 30, shaking(3), 13)
    position = points.position_m.copy()
    position[0, :5] = np.nan
    found = fit_motion(of(position, points.covariance_m2), None, ORIGIN)
    np.testing.assert_array_equal(found.points, 25)
    with pytest.raises(ValueError, match="reference_m: expected at least 3"):
        fit_motion(points, np.full((30, 3), np.nan), ORIGIN)


def test_points_on_one_line_give_no_motion() -> None:
    line = np.outer(np.linspace(0, 0.1, 9), [1.0, 2.0, 0.5])
    found = fit_motion(of(np.stack([line, moved(line, np.full(6, 1e-3))])), line, ORIGIN)
    assert np.isnan(found.pose).all()
    np.testing.assert_array_equal(found.points, 0)


def test_planar_points_give_all_six_components() -> None:
    reference, pose = body(25, depth=0.0), shaking(3)
    found = fit_motion(of(np.stack([moved(reference, one) for one in pose])), reference, ORIGIN)
    np.testing.assert_allclose(found.pose, pose, atol=1e-12)


def test_covariances_that_are_none_take_the_point_out() -> None:
    reference, points = sample(2, 30, shaking(2), 14)
    covariance = points.covariance_m2.copy()
    covariance[:, 0] = 0.0
    covariance[:, 1] = -NOISE
    covariance[:, 2] = np.nan
    found = fit_motion(of(points.position_m, covariance), reference, ORIGIN)
    np.testing.assert_array_equal(found.points, 27)


def test_another_reference_pose_is_a_composition() -> None:
    reference, points = sample(6, 30, shaking(6, angle=0.4), 15)
    position = points.position_m.copy()
    position[4] = np.nan
    found = fit_motion(of(position, points.covariance_m2), reference, ORIGIN)
    mean = np.array([1e-3, -2e-3, 5e-4, 0.3, -0.2, 0.1])
    again = relative_to(found, mean)
    for k in (0, 1, 2, 3, 5):
        expected = RigidTransform.from_pose(found.pose[k]) @ RigidTransform.from_pose(mean).inverse()
        np.testing.assert_allclose(again.pose[k], expected.pose, atol=1e-14)
    assert np.isnan(again.pose[4]).all()
    direct = fit_motion(of(position, points.covariance_m2), moved(reference, mean), ORIGIN)
    good = [0, 1, 2, 3, 5]
    np.testing.assert_allclose(again.pose[good], direct.pose[good], atol=1e-12)
    sigma = np.sqrt(np.diagonal(direct.covariance[good], axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(again.covariance[good] / scale, direct.covariance[good] / scale, atol=1e-8)
    with pytest.raises(ValueError, match="mean_pose"):
        relative_to(found, np.zeros(5))


@pytest.mark.parametrize("given_reference", [True, False])
def test_noise_of_points_without_covariance_is_found_from_the_rigid_fit(given_reference: bool) -> None:
    reference = body(60)
    error = np.random.default_rng(16).multivariate_normal(np.zeros(3), NOISE, (80, 60))
    position = np.stack([moved(reference, one) for one in shaking(80)]) + error
    position[3, 5] = np.nan
    position[10:12, 7] += 1e-3
    found = points_with_estimated_noise(position, reference if given_reference else None)
    scale = np.sqrt(np.outer(NOISE.diagonal(), NOISE.diagonal()))
    np.testing.assert_allclose(found.covariance_m2[0, 0] / scale, NOISE / scale, atol=0.07)
    assert np.isnan(found.covariance_m2[3, 5]).all()
    assert np.count_nonzero(np.isnan(found.covariance_m2)) == 9


def test_noise_cannot_be_found_from_one_frame() -> None:
    with pytest.raises(ValueError, match="position_m: expected at least 3 points in 2 frames"):
        points_with_estimated_noise(body(10)[None])


def test_arguments_that_do_not_fit_are_named() -> None:
    reference, points = sample(2, 30, shaking(2), 14)
    with pytest.raises(ValueError, match="reference_m"):
        fit_motion(points, reference[:5], ORIGIN)
    with pytest.raises(ValueError, match="origin_m"):
        fit_motion(points, reference, np.zeros(2))
    with pytest.raises(ValueError, match="covariance"):
        RigidMotion(np.zeros((2, 6)), np.zeros((2, 6)), np.zeros(2), np.zeros(2, int), np.zeros(3))


def test_a_body_that_bends_is_not_turned_to_where_it_is_known_worst() -> None:
    """A plate, known four times worse in depth, is stretched by 8 %: the rigid fit that is left is the plain one.

    Weighted by the noise, a tilt of some 20° would explain the stretch at the cost of depth.
    """
    rng = np.random.default_rng(77)
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.03, 0.03, 12), np.linspace(-0.02, 0.02, 10)))
    reference = np.column_stack([x, y, np.zeros_like(x)])
    covariance = np.diag([1e-6, 1e-6, 6e-6]) ** 2
    stretched = reference * [1.0, 0.92, 1.0] + rng.multivariate_normal(np.zeros(3), covariance, len(reference))
    shift = np.array([1e-4, 2e-4, -1e-4])
    position = np.stack([reference, stretched + shift])
    points = Points(position, np.broadcast_to(covariance, (*position.shape, 3)), np.zeros(position.shape[:2]))
    motion = fit_motion(points, None, np.zeros(3))
    np.testing.assert_allclose(motion.pose[1, :3], shift, atol=1e-5)
    assert np.max(np.abs(motion.pose[1, 3:])) < 1e-3
    assert np.sqrt(motion.covariance[1, 1, 1]) > 3e-5  # the misfit of a millimetre, not the noise of a micrometre
    np.testing.assert_allclose(motion.residual_m[1], 0.08 * np.std(y) / np.sqrt(3), rtol=0.05)
