"""The camera model against OpenCV and kornia, its inverse, and the stereo pair."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photogram.camera import RIG_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform

SIZE = np.array([1920, 1200])
DISTORTIONS = [
    (0.0, 0.0, 0.0, 0.0, 0.0),
    (0.064598486, -4.531373978, 0.0, 0.0, 29.78838921),  # a published stereo DIC calibration
    (-0.2553784247069051, 2.4322276122705246, 0.0, 0.0, 0.0),  # another
    (-0.28, 0.09, 1.5e-3, -2e-3, -0.012),  # a wide lens with tangential parts
]


def camera(distortion: tuple[float, ...], focal: float = 6607.6) -> Camera:
    matrix = np.array([[focal, 0, 917.97], [0, 0.999 * focal, 531.64], [0, 0, 1]])
    return Camera(matrix, np.array(distortion), SIZE)


def stereo_rig(covariance: np.ndarray | None = None) -> StereoRig:
    pose = np.array([-0.15, 0.002, 0.02, 0.01, 0.34, -0.005])
    return StereoRig(camera(DISTORTIONS[3], 3200.0), camera(DISTORTIONS[2]), RigidTransform.from_pose(pose), covariance)


def in_view(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.05, 0.05, (count, 2)), rng.uniform(0.35, 0.45, count)])


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_projection_is_opencvs(distortion: tuple[float, ...]) -> None:
    points, one = in_view(500), camera(distortion)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), one.matrix, one.distortion)
    np.testing.assert_allclose(one.project(points), theirs.reshape(-1, 2), atol=1e-9)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_projection_is_kornias(distortion: tuple[float, ...]) -> None:
    torch = pytest.importorskip("torch")
    from kornia.geometry.calibration import distort_points

    points, one = in_view(500), camera(distortion)
    ideal = points[:, :2] / points[:, 2:] @ one.matrix[:2, :2].T + one.matrix[:2, 2]
    tensors = [torch.from_numpy(array) for array in (ideal, one.matrix, one.distortion)]
    np.testing.assert_allclose(one.project(points), distort_points(*tensors).numpy(), atol=1e-9)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_undistortion_agrees_with_opencv_iterated_to_the_end(distortion: tuple[float, ...]) -> None:
    one = camera(distortion)
    pixels = np.random.default_rng(1).uniform(0, 1, (500, 2)) * SIZE
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-15)
    theirs = cv2.undistortPoints(pixels[:, None], one.matrix, one.distortion, criteria=criteria).reshape(-1, 2)
    np.testing.assert_allclose(one.undistort(pixels), theirs, atol=1e-13)


@given(st.sampled_from(DISTORTIONS), st.floats(0, 1), st.floats(0, 1), st.sampled_from([1600.0, 6607.6]))
@settings(deadline=None)  # the first call compiles
def test_undistortion_is_the_exact_inverse(distortion: tuple[float, ...], u: float, v: float, focal: float) -> None:
    one = camera(distortion, focal)
    normalised = (np.array([u, v]) * SIZE - one.matrix[:2, 2]) / np.diag(one.matrix)[:2]
    if distortion == DISTORTIONS[1] and np.linalg.norm(normalised) > 0.17:
        return  # this polynomial was fitted to a field this wide
    back = one.undistort(one.project(np.append(normalised, 1.0)))
    np.testing.assert_allclose(back, normalised, rtol=0, atol=1e-14)


def test_pixels_that_no_ray_reaches_are_nan() -> None:
    barrel = camera((-1.0, 0.0, 0.0, 0.0, 0.0), focal=1000.0)
    largest = 2 / 3 / np.sqrt(3)  # of r − r³
    pixels = barrel.matrix[:2, 2] + 1000.0 * np.array([[largest - 1e-6, 0.0], [largest + 1e-6, 0.0], [np.nan, 0.0]])
    found = barrel.undistort(pixels)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1:]).all()


def test_points_behind_the_camera_have_no_image() -> None:
    found = camera(DISTORTIONS[0]).project(np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]]))
    assert np.isfinite(found[0, 0]).all()
    assert np.isnan(found[0, 1:]).all()


def test_any_leading_shape_is_kept() -> None:
    one = camera(DISTORTIONS[3])
    assert one.project(np.ones((4, 5, 3))).shape == (4, 5, 2)
    assert one.undistort(np.ones((4, 5, 2))).shape == (4, 5, 2)
    assert one.undistort(np.array([3, 4])).shape == (2,)


def test_matrix_with_skew_is_refused() -> None:
    matrix = camera(DISTORTIONS[0]).matrix
    matrix[0, 1] = 1.0
    with pytest.raises(ValueError, match="matrix: expected"):
        Camera(matrix, np.zeros(5), SIZE)


def test_parameters_make_the_same_camera() -> None:
    one = camera(DISTORTIONS[3])
    again = Camera.from_parameters(one.parameters, one.size_px)
    np.testing.assert_array_equal(again.matrix, one.matrix)
    np.testing.assert_array_equal(again.distortion, one.distortion)


def opencv_derivatives(one: Camera, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Derivatives (N, 2, 15) by rotation vector, translation, fx fy cx cy, k1 k2 p1 p2 k3."""
    _, jacobian = cv2.projectPoints(points, pose[3:], pose[:3], one.matrix, one.distortion)
    return jacobian.reshape(len(points), 2, -1)[..., :15]


@pytest.mark.parametrize("index", range(24), ids=RIG_PARAMETERS)
def test_a_perturbed_parameter_moves_the_images_as_opencvs_derivatives_say(index: int) -> None:
    rig, points = stereo_rig(), in_view(50)
    step = 1e-3 if index < 18 else 1e-6  # pixels are linear in a camera's own parameters
    delta = step * np.eye(24)[index]
    ahead, behind = rig.perturbed(delta).project(points), rig.perturbed(-delta).project(points)
    numeric = [(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)]
    turned = points @ rig.right_from_left.rotation.T  # exp(δ)·R·x + t: the derivative at rotation zero of turned points
    left = opencv_derivatives(rig.left, points, np.zeros(6))[..., 6:]
    right = opencv_derivatives(rig.right, turned, np.append(rig.right_from_left.translation_m, np.zeros(3)))
    expected = np.zeros((2, 24, 50, 2))
    expected[0, :9] = np.moveaxis(left, 2, 0)
    expected[1, 9:] = np.moveaxis(right[..., [*range(6, 15), *range(6)]], 2, 0)
    scale = np.abs(expected[:, index]).max()
    np.testing.assert_allclose(numeric, expected[:, index], atol=1e-6 * scale)


def test_order_of_the_parameters_is_the_formats() -> None:
    assert RIG_PARAMETERS[:9] == tuple(f"left.{n}" for n in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"))
    assert RIG_PARAMETERS[9] == "right.fx"
    assert RIG_PARAMETERS[18:] == (*(f"rotation.{a}" for a in "xyz"), *(f"translation.{a}" for a in "xyz"))
    assert stereo_rig().parameters == RIG_PARAMETERS


def test_corresponding_ideal_pixels_satisfy_the_fundamental_matrix() -> None:
    rig = stereo_rig()
    ideal = StereoRig(
        Camera(rig.left.matrix, np.zeros(5), SIZE), Camera(rig.right.matrix, np.zeros(5), SIZE), rig.right_from_left
    )
    left, right = (np.column_stack([pixels, np.ones(200)]) for pixels in ideal.project(in_view(200)))
    lines = left @ ideal.fundamental().T
    distance_px = (right * lines).sum(axis=1) / np.hypot(lines[:, 0], lines[:, 1])
    assert np.abs(distance_px).max() < 1e-8


def test_covariances_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        stereo_rig(np.eye(6))
    asymmetric = np.eye(24)
    asymmetric[0, 1] = 0.5
    with pytest.raises(ValueError, match="symmetric"):
        stereo_rig(asymmetric)
    with pytest.raises(ValueError, match="no negative variance"):
        stereo_rig(np.eye(24) - 0.1)
    assert stereo_rig(np.zeros((24, 24))).covariance is not None
