"""Cameras, stereo pairs and rigid transforms against OpenCV and SciPy."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from photogram.calibration.calibration_file import read_calibration
from photogram.camera import RIG_PARAMETERS, Camera, Points3D, StereoRig, triangulate
from photogram.geometry import (
    RigidTransform,
    fit_rigid,
    nearest_rotation,
    rotation_from_vector,
    rotation_vector_rate,
    skew,
    vector_from_rotation,
)

SIZE = np.array([1920, 1200])
DISTORTIONS = [
    (0.0, 0.0, 0.0, 0.0, 0.0),
    (0.064598486, -4.531373978, 0.0, 0.0, 29.78838921),  # a published stereo DIC calibration
    (-0.2553784247069051, 2.4322276122705246, 0.0, 0.0, 0.0),  # another
    (-0.28, 0.09, 1.5e-3, -2e-3, -0.012),  # a wide lens with tangential parts
    (0.9, -0.3, 1e-3, -5e-4, 0.02, 1.2, 0.1, 0.03),  # OpenCV's rational model, as of a wide lens
]
SKEW_PX = 6.0  # of 10 646 px focal length in a published calibration


def camera(distortion: tuple[float, ...], focal: float = 6607.6, skew_px: float = 0.0) -> Camera:
    matrix = np.array([[focal, skew_px, 917.97], [0, 0.999 * focal, 531.64], [0, 0, 1]])
    return Camera(matrix, np.array(distortion), SIZE)


def stereo_rig(covariance: np.ndarray | None = None) -> StereoRig:
    pose = np.array([-0.15, 0.002, 0.02, 0.01, 0.34, -0.005])
    return StereoRig(camera(DISTORTIONS[3], 3200.0), camera(DISTORTIONS[2]), RigidTransform.from_pose(pose), covariance)


def in_view(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.05, 0.05, (count, 2)), rng.uniform(0.35, 0.45, count)])


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_projection_is_opencvs_and_undistortion_too_iterated_to_the_end(distortion):
    points, one = in_view(500), camera(distortion)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), one.matrix, one.distortion)
    np.testing.assert_allclose(one.project(points), theirs.reshape(-1, 2), atol=1e-9)
    pixels = np.random.default_rng(1).uniform(0, 1, (500, 2)) * SIZE
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-15)
    theirs = cv2.undistortPoints(pixels[:, None], one.matrix, one.distortion, criteria=criteria).reshape(-1, 2)
    np.testing.assert_allclose(one.undistort(pixels), theirs, atol=1e-13)


@pytest.mark.parametrize("distortion", [DISTORTIONS[0], DISTORTIONS[-1]])
def test_skew_shears_the_image_that_opencv_projects_without_it(distortion):
    points, skewed = in_view(500), camera(distortion, 10646.0, SKEW_PX)
    ideal, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion))
    theirs = np.column_stack([ideal.reshape(-1, 2), np.ones(500)]) @ skewed.matrix[:2].T
    np.testing.assert_allclose(skewed.project(points), theirs, atol=1e-9)
    np.testing.assert_allclose(skewed.undistort(theirs), points[:, :2] / points[:, 2:], atol=1e-14)
    assert np.ptp(skewed.project(points) - camera(distortion, 10646.0).project(points)) > 1.0  # 6 px are no trifle


def test_the_rational_factor_ends_at_its_pole():
    one = camera((0.0, 0.0, 0.0, 0.0, 0.0, -4.0, 0.0, 0.0), 1000.0)  # 1/(1 − 4·r²)
    assert np.isfinite(one.project(np.array([0.49, 0.0, 1.0]))).all()
    assert np.isnan(one.project(np.array([[0.5, 0.0, 1.0], [0.6, 0.0, 1.0]]))).all()
    far = one.project(np.array([0.499, 0.0, 1.0]))
    np.testing.assert_allclose(one.undistort(far), [0.499, 0.0], atol=1e-13)


@given(st.sampled_from(DISTORTIONS), st.floats(0, 1), st.floats(0, 1), st.sampled_from([1600.0, 6607.6]))
@settings(deadline=None)  # the first call compiles
def test_undistortion_is_the_exact_inverse(distortion, u, v, focal):
    one = camera(distortion, focal)
    normalised = (np.array([u, v]) * SIZE - one.matrix[:2, 2]) / np.diag(one.matrix)[:2]
    if distortion == DISTORTIONS[1] and np.linalg.norm(normalised) > 0.17:
        return  # this polynomial was fitted to a field this wide
    back = one.undistort(one.project(np.append(normalised, 1.0)))
    np.testing.assert_allclose(back, normalised, rtol=0, atol=1e-14)


def test_pixels_without_a_ray_and_points_behind_are_nan_in_any_leading_shape():
    barrel = camera((-1.0, 0.0, 0.0, 0.0, 0.0), focal=1000.0)
    largest = 2 / 3 / np.sqrt(3)  # of r − r³
    pixels = barrel.matrix[:2, 2] + 1000.0 * np.array([[largest - 1e-6, 0.0], [largest + 1e-6, 0.0], [np.nan, 0.0]])
    found = barrel.undistort(pixels)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1:]).all()
    one = camera(DISTORTIONS[3])
    pixels = one.project(np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]]))
    assert np.isfinite(pixels[0, 0]).all()
    assert np.isnan(pixels[0, 1:]).all()
    assert one.project(np.ones((4, 5, 3))).shape == (4, 5, 2)
    assert one.undistort(np.ones((4, 5, 2))).shape == (4, 5, 2)
    assert one.undistort(np.array([3, 4])).shape == (2,)


def opencv_derivatives(one: Camera, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Derivatives (N, 2, 18) by rotation vector, translation, fx fy cx cy, k1 k2 p1 p2 k3 k4 k5 k6."""
    _, jacobian = cv2.projectPoints(points, pose[3:], pose[:3], one.matrix, one.distortion)
    return jacobian.reshape(len(points), 2, -1)[..., :18]


@pytest.mark.parametrize("index", range(32), ids=RIG_PARAMETERS)
def test_a_perturbed_parameter_moves_the_images_by_opencvs_derivatives(index):
    rig, points = stereo_rig(), in_view(50)
    linear = RIG_PARAMETERS[index].startswith(("left", "right"))  # in most of a camera's own parameters
    step = 1e-3 if linear and not RIG_PARAMETERS[index].endswith(("k4", "k5", "k6")) else 1e-6
    delta = step * np.eye(32)[index]
    ahead, behind = rig.perturbed(delta).project(points), rig.perturbed(-delta).project(points)
    numeric = [(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)]
    turned = points @ rig.right_from_left.rotation.T  # exp(δ)·R·x + t: the derivative at rotation zero of turned points
    left = opencv_derivatives(rig.left, points, np.zeros(6))[..., 6:]
    right = opencv_derivatives(rig.right, turned, np.append(rig.right_from_left.translation_m, np.zeros(3)))
    expected = np.zeros((2, 32, 50, 2))
    expected[0, [*range(9), *range(24, 27)]] = np.moveaxis(left, 2, 0)
    expected[1, [*range(9, 18), *range(28, 31)]] = np.moveaxis(right[..., 6:], 2, 0)
    expected[1, 18:24] = np.moveaxis(right[..., :6], 2, 0)
    for side, (one, pixel) in enumerate(zip((rig.left, rig.right), rig.project(points), strict=True)):
        expected[side, 27 + 4 * side, :, 0] = (pixel[:, 1] - one.matrix[1, 2]) / one.matrix[1, 1]  # y_d, by the skew
    scale = np.abs(expected[:, index]).max()
    np.testing.assert_allclose(numeric, expected[:, index], atol=1e-6 * scale + 1e-13 / step * SIZE.max())


def test_order_of_the_parameters_is_the_formats():
    one = camera(DISTORTIONS[3])
    again = Camera.from_parameters(one.parameters, one.size_px)
    np.testing.assert_array_equal(again.matrix, one.matrix)
    np.testing.assert_array_equal(again.distortion, one.distortion)
    assert RIG_PARAMETERS[:9] == tuple(f"left.{n}" for n in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"))
    assert RIG_PARAMETERS[9] == "right.fx"
    assert RIG_PARAMETERS[18:24] == (*(f"rotation.{a}" for a in "xyz"), *(f"translation.{a}" for a in "xyz"))
    assert RIG_PARAMETERS[24:] == tuple(f"{side}.{n}" for side in ("left", "right") for n in ("k4", "k5", "k6", "skew"))
    assert stereo_rig().parameters == RIG_PARAMETERS


def test_corresponding_ideal_pixels_satisfy_the_fundamental_matrix():
    rig = stereo_rig()
    ideal = StereoRig(
        Camera(rig.left.matrix, np.zeros(5), SIZE), Camera(rig.right.matrix, np.zeros(5), SIZE), rig.right_from_left
    )
    left, right = (np.column_stack([pixels, np.ones(200)]) for pixels in ideal.project(in_view(200)))
    lines = left @ ideal.fundamental().T
    distance_px = (right * lines).sum(axis=1) / np.hypot(lines[:, 0], lines[:, 1])
    assert np.abs(distance_px).max() < 1e-8


# Triangulation: exact input, OpenCV and SciPy as oracles, covariance against OpenCV's derivatives and Monte Carlo.

LEFT_PX2 = np.array([[4e-4, 1e-4], [1e-4, 1e-4]])
RIGHT_PX2 = np.array([[1e-4, -5e-5], [-5e-5, 9e-4]])


def noisy(points: np.ndarray, trials: int, seed: int, factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    pixels = stereo_rig().project(points)
    left, right = (
        px + factor * rng.normal(size=(trials, *px.shape)) @ np.linalg.cholesky(covariance).T
        for px, covariance in zip(pixels, (LEFT_PX2, RIGHT_PX2), strict=True)
    )
    return left, right


def test_triangulation_is_the_inverse_of_projection_and_opencvs_linear_method_to_the_order_of_the_noise():
    points = np.random.default_rng(5).uniform([-0.05, -0.05, 0.3], [0.05, 0.05, 0.5], (1000, 3))
    left, right = stereo_rig().project(points)
    found = triangulate(stereo_rig(), left[None], right[None])
    np.testing.assert_allclose(found.position_m[0], points, atol=1e-14)
    assert found.reprojection_px.max() < 1e-10
    rig = stereo_rig()
    left, right = noisy(in_view(200), 1, 1, factor=1e-4)
    found = triangulate(rig, left, right)
    transform = rig.right_from_left
    matrices = np.eye(3, 4), np.column_stack([transform.rotation, transform.translation_m])
    homogeneous = cv2.triangulatePoints(*matrices, rig.left.undistort(left[0]).T, rig.right.undistort(right[0]).T)
    np.testing.assert_allclose(found.position_m[0], (homogeneous[:3] / homogeneous[3]).T, atol=5e-9)


def test_is_the_optimum_that_a_general_optimiser_finds():
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


def test_covariance_is_that_of_opencvs_derivatives():
    rig, points = stereo_rig(), in_view(20)
    found = triangulate(rig, *(pixels[None] for pixels in rig.project(points)), LEFT_PX2, RIGHT_PX2)
    rotation, translation = rig.right_from_left.rotation, rig.right_from_left.translation_m
    left = opencv_derivatives(rig.left, points, np.zeros(6))[..., 3:6]
    right = opencv_derivatives(rig.right, points @ rotation.T, np.append(translation, np.zeros(3)))[..., 3:6] @ rotation
    information = [np.swapaxes(j, 1, 2) @ np.linalg.inv(c) @ j for j, c in ((left, LEFT_PX2), (right, RIGHT_PX2))]
    np.testing.assert_allclose(found.covariance_m2[0], np.linalg.inv(sum(information)), rtol=1e-8)


def test_stated_covariance_contains_the_truth_as_often_as_it_says():
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


def test_a_missing_point_is_nan_and_touches_no_other():
    left, right = (px[None] for px in stereo_rig().project(in_view(6)))
    default, stated = triangulate(stereo_rig(), left, right), triangulate(stereo_rig(), left, right, *[np.eye(2)] * 2)
    np.testing.assert_array_equal(default.covariance_m2, stated.covariance_m2)  # that of one pixel
    clean = triangulate(stereo_rig(), left, right, LEFT_PX2, RIGHT_PX2)
    left[0, 1, 0] = np.nan
    right[0, 2, 1] = np.nan
    covariance = np.broadcast_to(LEFT_PX2, (1, 6, 2, 2)).copy()
    covariance[0, 3] = 0.0
    covariance[0, 4, 0, 0] = np.nan
    found = triangulate(stereo_rig(), left, right, covariance, RIGHT_PX2)
    for name in ("position_m", "covariance_m2", "reprojection_px"):
        array, untouched = getattr(found, name), getattr(clean, name)
        assert np.isnan(array[0, 1:5]).all()
        np.testing.assert_array_equal(array[0, [0, 5]], untouched[0, [0, 5]])


def test_rays_that_do_not_meet_in_front_of_the_cameras_give_nan():
    plain = Camera.from_parameters(np.array([100.0, 100, 50, 50, 0, 0, 0, 0, 0]), np.array([100, 100]))
    rig = StereoRig(plain, plain, RigidTransform(np.eye(3), np.array([-0.1, 0, 0])))
    left = np.array([[[50.0, 50.0], [50.0, 50.0], [60.0, 50.0]]])
    right = np.array([[[50.0, 50.0], [70.0, 50.0], [50.0, 50.0]]])  # parallel, behind, in front
    found = triangulate(rig, left, right)
    assert np.isnan(found.position_m[0, :2]).all()
    np.testing.assert_allclose(found.position_m[0, 2], [0.1, 0.0, 1.0], atol=1e-12)


# Another program's stereo matches and the points it made of them: OpenCorr on the D-shaped specimen.

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


def test_triangulation_reproduces_the_peers_points(rig, state):
    left, right, peer = state
    found = triangulate(rig, left[None], right[None])
    distance = np.linalg.norm(found.position_m[0] - peer, axis=1)
    assert np.median(distance) < 0.1 * UM
    # The peer solves the four collinearity equations linearly; where a match is poor the two optima part.
    consistent = found.reprojection_px[0] < 0.25
    assert np.count_nonzero(~consistent) <= 5
    assert distance[consistent].max() < 0.5 * UM
    assert np.count_nonzero(distance > 0.5 * UM) <= 3


# Rigid transforms against SciPy's rotations, and their group laws.

numbers = st.floats(-2.0, 2.0, allow_subnormal=False)
poses = arrays(np.float64, 6, elements=numbers)
vectors = arrays(np.float64, 3, elements=numbers)


def vectors_of_angle(angle: float, count: int = 200) -> np.ndarray:
    axis = np.random.default_rng(3).normal(size=(count, 3))
    return angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.3, 2.0, np.pi - 1e-6, np.pi - 1e-12])
def test_rotation_vectors_keep_full_precision_from_zero_to_pi(angle):
    v = vectors_of_angle(angle)
    rotation = rotation_from_vector(v)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(v).as_matrix(), atol=4e-16 * (1 + angle))
    np.testing.assert_allclose(vector_from_rotation(rotation), v, rtol=1e-12, atol=4e-15 * angle)


def test_half_turn_comes_back_as_one_of_its_two_vectors():
    v = vectors_of_angle(np.pi)
    back = vector_from_rotation(rotation_from_vector(v))
    np.testing.assert_allclose(np.abs((back * v).sum(axis=1)), np.pi**2, rtol=1e-12)


@given(vectors)
def test_rate_is_the_derivative_of_the_rotation_vector(v):
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


def test_rate_is_continuous_where_its_series_ends():
    just_below, just_above = vectors_of_angle(1e-2 * (1 - 1e-12)), vectors_of_angle(1e-2 * (1 + 1e-12))
    np.testing.assert_allclose(rotation_vector_rate(just_below), rotation_vector_rate(just_above), atol=1e-13)


@given(poses, poses, vectors)
def test_composition_and_inverse_are_those_of_a_group(first, second, x):
    b_from_a, c_from_b = RigidTransform.from_pose(first), RigidTransform.from_pose(second)
    np.testing.assert_allclose((c_from_b @ b_from_a).apply(x), c_from_b.apply(b_from_a.apply(x)), atol=1e-14)
    np.testing.assert_allclose(b_from_a.inverse().apply(b_from_a.apply(x)), x, atol=1e-14)
    np.testing.assert_allclose((b_from_a @ b_from_a.inverse()).rotation, np.eye(3), atol=1e-14)


@given(poses)
def test_pose_comes_back_and_skew_is_the_cross_product(pose):
    if np.linalg.norm(pose[3:]) < 3.1:
        np.testing.assert_allclose(RigidTransform.from_pose(pose).pose, pose, atol=1e-13)
    np.testing.assert_allclose(skew(pose[:3]) @ pose[3:], np.cross(pose[:3], pose[3:]), atol=1e-15)


def cloud(seed: int, count: int = 12, depth: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * [1.0, 1.0, depth]


@given(poses, poses, poses, st.integers(0, 2**31), st.sampled_from([1.0, 0.0]))
def test_fit_follows_rigid_changes_of_both_frames(motion, before, after, seed, depth):
    source = cloud(seed, depth=depth)
    target = RigidTransform.from_pose(motion).apply(source) + 0.05 * cloud(seed + 1)
    a, b = RigidTransform.from_pose(before), RigidTransform.from_pose(after)
    direct = b @ fit_rigid(source, target) @ a.inverse()
    moved = fit_rigid(a.apply(source), b.apply(target))
    np.testing.assert_allclose(moved.rotation, direct.rotation, atol=1e-10)
    np.testing.assert_allclose(moved.translation_m, direct.translation_m, atol=1e-10)


def test_fit_is_scipys_optimum():
    source = cloud(1)
    target = RigidTransform.from_pose(np.array([1.0, 2.0, 3.0, 0.4, -0.5, 2.0])).apply(source) + 0.1 * cloud(3)
    found = fit_rigid(source, target)
    middle = [points.mean(axis=0) for points in (source, target)]
    oracle, _ = Rotation.align_vectors(target - middle[1], source - middle[0])
    np.testing.assert_allclose(found.rotation, oracle.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.apply(middle[0]), middle[1], atol=1e-12)


def test_wrong_values_are_named():
    turned, asymmetric = camera(DISTORTIONS[0]).matrix, np.eye(24)
    turned[1, 0], asymmetric[0, 1] = 1.0, 0.5
    refused("^matrix: ", Camera, turned, np.zeros(5), SIZE)
    refused("^distortion: ", Camera, camera(DISTORTIONS[0]).matrix, np.zeros(4), SIZE)
    refused("shape", stereo_rig, np.eye(6))
    refused("symmetric", stereo_rig, asymmetric)
    refused("^covariance: .*negative", stereo_rig, np.eye(24) - 0.1)
    assert stereo_rig(np.zeros((24, 24))).covariance is not None
    left, right = (px[None] for px in stereo_rig().project(in_view(6)))
    refused("right_px", triangulate, stereo_rig(), left, right[:, :5])
    refused("left_px", triangulate, stereo_rig(), left[0], right[0])
    refused("covariance_right_px2", triangulate, stereo_rig(), left, right, None, np.zeros((5, 2, 2)))
    refused("covariance_m2", Points3D, np.zeros((1, 2, 3)), np.zeros((1, 2, 3)), np.zeros((1, 2)))
    refused("^rotation: .*orthonormal", RigidTransform, 1.00001 * np.eye(3), np.zeros(3))
    refused("reflection", RigidTransform, np.diag([1.0, 1.0, -1.0]), np.zeros(3))
    refused(r"^translation_m: .*\(3\)", RigidTransform, np.eye(3), np.zeros(2))
    refused("rotation", RigidTransform, np.full((3, 3), np.nan), np.zeros(3))


def test_mirrored_and_planar_points_give_a_rotation_and_those_that_fix_none_are_refused():
    source = cloud(5)
    found = fit_rigid(source, source * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert np.linalg.det(nearest_rotation(np.diag([3.0, 2.0, -1.0]))) == pytest.approx(1.0)
    source = cloud(4, depth=0.0) * 1e-2 + [3.0, 5.0, 7.0]
    truth = RigidTransform.from_pose(np.array([1e-6, -2e-6, 3e-6, 1e-5, 2e-5, -3e-5]))
    np.testing.assert_allclose(fit_rigid(source, truth.apply(source)).rotation, truth.rotation, atol=1e-12)
    refused("^source_m: .*rotation", fit_rigid, *[np.outer(np.arange(6.0), [1.0, 2.0, 3.0]) + 4.0] * 2)
    refused("^source_m: .*rotation", fit_rigid, *[np.ones((6, 3))] * 2)
    refused("^source_m: .* 3 ", fit_rigid, *[cloud(1, 2)] * 2)
    refused("finite", fit_rigid, *[np.full((6, 3), np.nan)] * 2)
    refused("source_m", fit_rigid, *[np.zeros((6, 2))] * 2)
