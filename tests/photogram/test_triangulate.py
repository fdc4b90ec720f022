"""Triangulation: exact input, OpenCV and SciPy as oracles, covariance against autograd and Monte Carlo."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from photogram.camera import Camera, Points, StereoRig, triangulate
from photogram.geometry import RigidTransform

LEFT_PX2 = np.array([[4e-4, 1e-4], [1e-4, 1e-4]])
RIGHT_PX2 = np.array([[1e-4, -5e-5], [-5e-5, 9e-4]])


def stereo_rig() -> StereoRig:
    size = np.array([1280, 1024])
    left = Camera(
        np.array([[3200, 0, 640.0], [0, 3190, 512], [0, 0, 1]]), np.array([-0.2, 0.4, 1e-3, -2e-3, 1.0]), size
    )
    right = Camera(np.array([[3250, 0, 650.0], [0, 3245, 500], [0, 0, 1]]), np.array([-0.1, 0.2, -1e-3, 1e-3, 0]), size)
    return StereoRig(left, right, RigidTransform.from_pose(np.array([-0.14, 0.002, 0.03, 0.01, 0.35, -0.005])))


def in_view(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.05, 0.05, (count, 2)), rng.uniform(0.37, 0.43, count)])


def noisy(points: np.ndarray, trials: int, seed: int, factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    pixels = stereo_rig().project(points)
    left, right = (
        px + factor * rng.normal(size=(trials, *px.shape)) @ np.linalg.cholesky(covariance).T
        for px, covariance in zip(pixels, (LEFT_PX2, RIGHT_PX2), strict=True)
    )
    return left, right


def test_exact_pixels_give_the_exact_points() -> None:
    points = in_view(1000)
    left, right = stereo_rig().project(points)
    found = triangulate(stereo_rig(), left[None], right[None])
    np.testing.assert_allclose(found.position_m[0], points, atol=1e-14)
    assert found.reprojection_px.max() < 1e-10


@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(0.3, 0.5))
@settings(deadline=None)  # the first call compiles
def test_projection_and_triangulation_are_inverse(x: float, y: float, z: float) -> None:
    left, right = stereo_rig().project(np.array([x, y, z]))
    found = triangulate(stereo_rig(), left[None, None], right[None, None])
    np.testing.assert_allclose(found.position_m[0, 0], [x, y, z], atol=1e-13)


def test_agrees_with_opencvs_linear_method_to_the_order_of_the_noise() -> None:
    rig = stereo_rig()
    left, right = noisy(in_view(200), 1, 1, factor=1e-4)
    found = triangulate(rig, left, right)
    transform = rig.right_from_left
    matrices = np.eye(3, 4), np.column_stack([transform.rotation, transform.translation_m])
    homogeneous = cv2.triangulatePoints(*matrices, rig.left.undistort(left[0]).T, rig.right.undistort(right[0]).T)
    np.testing.assert_allclose(found.position_m[0], (homogeneous[:3] / homogeneous[3]).T, atol=5e-9)


def test_is_the_optimum_that_a_general_optimiser_finds() -> None:
    rig, points = stereo_rig(), in_view(10)
    left, right = noisy(points, 1, 2, factor=20.0)
    found = triangulate(rig, left, right, LEFT_PX2, RIGHT_PX2)
    whiten = [np.linalg.inv(np.linalg.cholesky(covariance)) for covariance in (LEFT_PX2, RIGHT_PX2)]
    for i, start in enumerate(points):

        def residual(x: np.ndarray, i: int = i) -> np.ndarray:
            seen = rig.project(x)
            return np.concatenate([whiten[0] @ (left[0, i] - seen[0]), whiten[1] @ (right[0, i] - seen[1])])

        oracle = least_squares(residual, start, x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(found.position_m[0, i], oracle.x, atol=2e-10)
        seen = rig.project(found.position_m[0, i])
        squares = ((left[0, i] - seen[0]) ** 2).sum() + ((right[0, i] - seen[1]) ** 2).sum()
        assert found.reprojection_px[0, i] == pytest.approx(np.sqrt(squares / 4))


def test_covariance_is_that_of_the_jacobian_by_automatic_differentiation() -> None:
    torch = pytest.importorskip("torch")
    from kornia.geometry.calibration import distort_points

    rig, points = stereo_rig(), in_view(20)
    left, right = rig.project(points)
    found = triangulate(rig, left[None], right[None], LEFT_PX2, RIGHT_PX2)
    pose = rig.right_from_left

    def pixels(x: object) -> object:
        seen = []
        for camera, rotation, translation in (
            (rig.left, np.eye(3), np.zeros(3)),
            (rig.right, pose.rotation, pose.translation_m),
        ):
            matrix, distortion = torch.from_numpy(camera.matrix), torch.from_numpy(camera.distortion)
            inside = torch.from_numpy(rotation) @ x + torch.from_numpy(translation)
            ideal = (matrix @ (inside / inside[2]))[:2]
            seen.append(distort_points(ideal[None], matrix, distortion)[0])
        return torch.cat(seen)

    weight = np.zeros((4, 4))
    weight[:2, :2], weight[2:, 2:] = np.linalg.inv(LEFT_PX2), np.linalg.inv(RIGHT_PX2)
    for i, point in enumerate(points):
        jacobian = torch.autograd.functional.jacobian(pixels, torch.from_numpy(point)).numpy()
        expected = np.linalg.inv(jacobian.T @ weight @ jacobian)
        np.testing.assert_allclose(found.covariance_m2[0, i], expected, rtol=1e-8)


def test_stated_covariance_contains_the_truth_as_often_as_it_says() -> None:
    points, trials = in_view(10), 2000
    left, right = noisy(points, trials, 3)
    found = triangulate(stereo_rig(), left, right, LEFT_PX2, RIGHT_PX2)
    error = found.position_m - points
    square = np.einsum("fni,fnij,fnj->fn", error, np.linalg.inv(found.covariance_m2), error)
    count = trials * len(points)
    assert abs(square.mean() - 3) < 4 * np.sqrt(6 / count)
    inside = np.mean(square < 7.814727903251179)  # 95 % of χ² with three degrees of freedom
    assert abs(inside - 0.95) < 4 * np.sqrt(0.95 * 0.05 / count)
    bias = error.mean(axis=0) / np.sqrt(np.diagonal(found.covariance_m2[0], axis1=1, axis2=2) / trials)
    assert np.abs(bias).max() < 4.5


def test_without_covariances_it_is_that_of_one_pixel() -> None:
    left, right = stereo_rig().project(in_view(5))
    default = triangulate(stereo_rig(), left[None], right[None])
    stated = triangulate(stereo_rig(), left[None], right[None], np.eye(2), np.eye(2))
    np.testing.assert_array_equal(default.covariance_m2, stated.covariance_m2)


def test_a_missing_point_is_nan_and_touches_no_other() -> None:
    left, right = (px[None] for px in stereo_rig().project(in_view(6)))
    clean = triangulate(stereo_rig(), left, right, LEFT_PX2, RIGHT_PX2)
    left[0, 1, 0] = np.nan
    right[0, 2, 1] = np.nan
    covariance = np.broadcast_to(LEFT_PX2, (1, 6, 2, 2)).copy()
    covariance[0, 3] = 0.0
    covariance[0, 4, 0, 0] = np.nan
    found = triangulate(stereo_rig(), left, right, covariance, RIGHT_PX2)
    for array, untouched in (
        (found.position_m, clean.position_m),
        (found.covariance_m2, clean.covariance_m2),
        (found.reprojection_px, clean.reprojection_px),
    ):
        assert np.isnan(array[0, 1:5]).all()
        np.testing.assert_array_equal(array[0, [0, 5]], untouched[0, [0, 5]])


def test_rays_that_do_not_meet_in_front_of_the_cameras_give_nan() -> None:
    size = np.array([100, 100])
    plain = Camera(np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), np.zeros(5), size)
    rig = StereoRig(plain, plain, RigidTransform(np.eye(3), np.array([-0.1, 0, 0])))
    left = np.array([[[50.0, 50.0], [50.0, 50.0], [60.0, 50.0]]])
    right = np.array([[[50.0, 50.0], [70.0, 50.0], [50.0, 50.0]]])  # parallel, behind, in front
    found = triangulate(rig, left, right)
    assert np.isnan(found.position_m[0, :2]).all()
    np.testing.assert_allclose(found.position_m[0, 2], [0.1, 0.0, 1.0], atol=1e-12)


def test_arguments_that_do_not_fit_are_named() -> None:
    left, right = (px[None] for px in stereo_rig().project(in_view(6)))
    with pytest.raises(ValueError, match="right_px"):
        triangulate(stereo_rig(), left, right[:, :5])
    with pytest.raises(ValueError, match="left_px"):
        triangulate(stereo_rig(), left[0], right[0])
    with pytest.raises(ValueError, match="covariance_right_px2"):
        triangulate(stereo_rig(), left, right, None, np.zeros((5, 2, 2)))


def test_another_frame_turns_positions_and_covariances() -> None:
    left, right = (px[None] for px in stereo_rig().project(in_view(6)))
    found = triangulate(stereo_rig(), left, right)
    transform = RigidTransform.from_pose(np.array([0.1, 0.2, 0.3, 1.0, -0.5, 2.0]))
    moved = found.transformed(transform)
    np.testing.assert_allclose(moved.position_m[0, 3], transform.apply(found.position_m[0, 3]), atol=1e-15)
    expected = transform.rotation @ found.covariance_m2[0, 3] @ transform.rotation.T
    np.testing.assert_allclose(moved.covariance_m2[0, 3], expected, rtol=1e-12)
    np.testing.assert_array_equal(moved.reprojection_px, found.reprojection_px)
    with pytest.raises(ValueError, match="covariance_m2"):
        Points(np.zeros((1, 2, 3)), np.zeros((1, 2, 3)), np.zeros((1, 2)))
