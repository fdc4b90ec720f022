"""Rigid transforms against SciPy's and kornia's rotations, and their group laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from photogram.geometry import (
    RigidTransform,
    fit_rigid,
    nearest_rotation,
    rotation_from_vector,
    rotation_vector_rate,
    skew,
    vector_from_rotation,
)

numbers = st.floats(-2.0, 2.0, allow_subnormal=False)
poses = arrays(np.float64, 6, elements=numbers)
vectors = arrays(np.float64, 3, elements=numbers)


def vectors_of_angle(angle: float, count: int = 200) -> np.ndarray:
    axis = np.random.default_rng(3).normal(size=(count, 3))
    return angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.3, 2.0, np.pi - 1e-6, np.pi - 1e-12])
def test_rotation_vectors_keep_full_precision_from_zero_to_pi(angle: float) -> None:
    v = vectors_of_angle(angle)
    rotation = rotation_from_vector(v)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(v).as_matrix(), atol=4e-16 * (1 + angle))
    np.testing.assert_allclose(vector_from_rotation(rotation), v, rtol=1e-12, atol=4e-15 * angle)


def test_half_turn_comes_back_as_one_of_its_two_vectors() -> None:
    v = vectors_of_angle(np.pi)
    back = vector_from_rotation(rotation_from_vector(v))
    np.testing.assert_allclose(np.abs((back * v).sum(axis=1)), np.pi**2, rtol=1e-12)


def test_exponential_agrees_with_kornia() -> None:
    torch = pytest.importorskip("torch")
    from kornia.geometry.liegroup import So3

    v = np.random.default_rng(0).normal(size=(100, 3))
    theirs = So3.exp(torch.from_numpy(v)).matrix().numpy()
    np.testing.assert_allclose(rotation_from_vector(v), theirs, atol=2e-15)


@given(vectors)
def test_rate_is_the_derivative_of_the_rotation_vector(v: np.ndarray) -> None:
    if np.linalg.norm(v) > 3.0:
        v = v / 2
    step = 1e-6
    numeric = np.empty((3, 3))
    for axis in range(3):
        small = step * np.eye(3)[axis]
        ahead = Rotation.from_rotvec(small) * Rotation.from_rotvec(v)
        behind = Rotation.from_rotvec(-small) * Rotation.from_rotvec(v)
        numeric[:, axis] = (ahead.as_rotvec() - behind.as_rotvec()) / (2 * step)
    np.testing.assert_allclose(rotation_vector_rate(v), numeric, atol=1e-8)


def test_rate_is_continuous_where_its_series_ends() -> None:
    just_below, just_above = vectors_of_angle(1e-2 * (1 - 1e-12)), vectors_of_angle(1e-2 * (1 + 1e-12))
    np.testing.assert_allclose(rotation_vector_rate(just_below), rotation_vector_rate(just_above), atol=1e-13)


@given(poses, poses, vectors)
def test_composition_and_inverse_are_those_of_a_group(first: np.ndarray, second: np.ndarray, x: np.ndarray) -> None:
    b_from_a, c_from_b = RigidTransform.from_pose(first), RigidTransform.from_pose(second)
    np.testing.assert_allclose((c_from_b @ b_from_a).apply(x), c_from_b.apply(b_from_a.apply(x)), atol=1e-14)
    np.testing.assert_allclose(b_from_a.inverse().apply(b_from_a.apply(x)), x, atol=1e-14)
    np.testing.assert_allclose((b_from_a @ b_from_a.inverse()).rotation, np.eye(3), atol=1e-14)


@given(poses)
def test_pose_comes_back(pose: np.ndarray) -> None:
    if np.linalg.norm(pose[3:]) < 3.1:
        np.testing.assert_allclose(RigidTransform.from_pose(pose).pose, pose, atol=1e-13)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-15)


def test_what_is_no_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="rotation: expected an orthonormal"):
        RigidTransform(1.00001 * np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="reflection"):
        RigidTransform(np.diag([1.0, 1.0, -1.0]), np.zeros(3))
    with pytest.raises(ValueError, match=r"translation_m: expected an array of shape \(3\)"):
        RigidTransform(np.eye(3), np.zeros(2))
    with pytest.raises(ValueError, match="rotation"):
        RigidTransform(np.full((3, 3), np.nan), np.zeros(3))


def cloud(seed: int, count: int = 12, depth: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * [1.0, 1.0, depth]


@given(poses, poses, poses, st.integers(0, 2**31), st.sampled_from([1.0, 0.0]))
def test_fit_follows_rigid_changes_of_both_frames(
    motion: np.ndarray, before: np.ndarray, after: np.ndarray, seed: int, depth: float
) -> None:
    source = cloud(seed, depth=depth)
    target = RigidTransform.from_pose(motion).apply(source) + 0.05 * cloud(seed + 1)
    a, b = RigidTransform.from_pose(before), RigidTransform.from_pose(after)
    direct = b @ fit_rigid(source, target) @ a.inverse()
    moved = fit_rigid(a.apply(source), b.apply(target))
    np.testing.assert_allclose(moved.rotation, direct.rotation, atol=1e-10)
    np.testing.assert_allclose(moved.translation_m, direct.translation_m, atol=1e-10)


def test_fit_is_scipys_weighted_optimum() -> None:
    source, weight = cloud(1), np.random.default_rng(2).uniform(0.1, 3.0, 12)
    target = RigidTransform.from_pose(np.array([1.0, 2.0, 3.0, 0.4, -0.5, 2.0])).apply(source) + 0.1 * cloud(3)
    found = fit_rigid(source, target, weight)
    middle = [np.average(points, axis=0, weights=weight) for points in (source, target)]
    oracle, _ = Rotation.align_vectors(target - middle[1], source - middle[0], weights=weight)
    np.testing.assert_allclose(found.rotation, oracle.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.apply(middle[0]), middle[1], atol=1e-12)


def test_points_of_weight_zero_do_not_count() -> None:
    source, weight = cloud(1), np.ones(12)
    target, weight[3] = source + 1.0, 0.0
    target[3] += 100.0
    np.testing.assert_allclose(fit_rigid(source, target, weight).pose, [1, 1, 1, 0, 0, 0], atol=1e-13)


def test_mirrored_points_give_a_rotation_all_the_same() -> None:
    source = cloud(5)
    found = fit_rigid(source, source * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert np.linalg.det(nearest_rotation(np.diag([3.0, 2.0, -1.0]))) == pytest.approx(1.0)


def test_planar_points_far_from_the_origin_are_fitted() -> None:
    source = cloud(4, depth=0.0) * 1e-2 + [3.0, 5.0, 7.0]
    truth = RigidTransform.from_pose(np.array([1e-6, -2e-6, 3e-6, 1e-5, 2e-5, -3e-5]))
    np.testing.assert_allclose(fit_rigid(source, truth.apply(source)).rotation, truth.rotation, atol=1e-12)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (np.outer(np.arange(6.0), [1.0, 2.0, 3.0]) + 4.0, "one line"),
        (np.ones((6, 3)), "one line"),
        (cloud(1, 2), "at least 3"),
        (np.full((6, 3), np.nan), "finite"),
        (np.zeros((6, 2)), "source_m"),
    ],
)
def test_point_sets_that_fix_no_rotation_are_refused(source: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit_rigid(source, source)


def test_negative_weight_is_refused() -> None:
    with pytest.raises(ValueError, match="weight"):
        fit_rigid(cloud(1), cloud(1), -np.ones(12))
