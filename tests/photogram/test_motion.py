"""Rigid motion: invariants, Monte Carlo of its covariance, outliers, missing points, change of reference."""

from __future__ import annotations

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from photogram.bspline import spline_of_image
from photogram.calibration.calibration_file import read_calibration
from photogram.camera import Points3D, triangulate
from photogram.geometry import RigidTransform, fit_rigid, rotation_from_vector
from photogram.motion import (
    Deformation,
    RigidMotion,
    deformation,
    fit_motion,
    overlap_correlation,
    points_with_estimated_noise,
    relative_to,
)
from photogram.subsets.icgn import TrackSettings, register
from photogram.subsets.reference import prepare_reference

ORIGIN = np.array([0.02, -0.01, 0.35])
NOISE = np.array([[1.0, 0.2, 0.5], [0.2, 1.5, -0.4], [0.5, -0.4, 9.0]]) * 1e-12  # depth is the weak direction
QUANTILE_95 = 12.591587243743977  # of χ² with six degrees of freedom
poses = arrays(np.float64, 6, elements=st.floats(-1.0, 1.0, allow_subnormal=False))


def body(count: int, seed: int = 0, depth: float = 2e-3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.05, 0.05, (count, 2)), 0.4 + depth * rng.normal(size=count)])


def moved(reference: np.ndarray, pose: np.ndarray, origin: np.ndarray = ORIGIN) -> np.ndarray:
    return RigidTransform.from_pose(pose).apply(reference - origin) + origin


def of(position: np.ndarray, covariance: np.ndarray = NOISE) -> Points3D:
    known = np.isfinite(position).all(axis=2)[..., None, None]
    return Points3D(position, np.where(known, covariance, np.nan), np.zeros(position.shape[:2]))


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


def sample(frames: int, count: int, pose: np.ndarray, seed: int) -> tuple[np.ndarray, Points3D]:
    reference, covariance = body(count), varying_noise(frames, count)
    error = (np.linalg.cholesky(covariance) @ np.random.default_rng(seed).normal(size=(frames, count, 3, 1)))[..., 0]
    return reference, of(np.stack([moved(reference, one) for one in pose]) + error, covariance)


def check_coverage(motion: RigidMotion, pose: np.ndarray) -> None:
    error = motion.pose - pose
    square = np.einsum("fi,fij,fj->f", error, np.linalg.inv(motion.covariance), error)
    assert abs(square.mean() - 6) < 4 * np.sqrt(12 / len(square))
    assert abs(np.mean(square < QUANTILE_95) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / len(square))


@given(poses, poses)
@settings(max_examples=10, deadline=None)  # the first call compiles
def test_exact_motion_comes_back(first, second):
    reference = body(20)
    found = fit_motion(of(np.stack([moved(reference, first), moved(reference, second)])), reference, ORIGIN)
    np.testing.assert_allclose(found.pose, [first, second], atol=1e-11)
    np.testing.assert_array_equal(found.points, 20)
    assert found.residual_m.max() < 1e-13


@given(poses)
@settings(max_examples=10, deadline=None)  # the first call compiles
def test_another_frame_of_coordinates_turns_the_motion_with_it(change):
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


def test_equal_isotropic_noise_gives_aruns_fit():
    reference = body(40)
    position = np.stack([moved(reference, one) for one in shaking(3, angle=0.5)])
    position += np.random.default_rng(2).normal(0, 1e-6, position.shape)
    found = fit_motion(of(position, 1e-12 * np.eye(3)), reference, ORIGIN)
    np.testing.assert_array_equal(found.points, 40)
    for pose, one in zip(found.pose, position, strict=True):
        np.testing.assert_allclose(pose, fit_rigid(reference - ORIGIN, one - ORIGIN).pose, atol=1e-12)


def test_stated_covariance_contains_the_truth_as_often_as_it_says():
    pose = shaking(1500, angle=0.5)
    reference, points = sample(1500, 12, pose, 3)
    check_coverage(fit_motion(points, reference, ORIGIN), pose)


def test_noise_of_the_reference_is_one_constant_and_not_in_the_covariance():
    pose = shaking(1000)
    _, points = sample(1000, 12, pose, 4)
    wrong = sample(1, 12, np.zeros((1, 6)), 5)[1].position_m[0]
    found = fit_motion(points, wrong, ORIGIN)
    error = found.pose - pose
    constant = error.mean(axis=0)
    assert constant @ np.linalg.inv(found.covariance[0]) @ constant > 1  # a constant of the size of one frame's noise
    ratio = np.cov(error.T).diagonal() / found.covariance.mean(axis=0).diagonal()
    np.testing.assert_allclose(ratio, 1, atol=4 * np.sqrt(2 / 1000) + 0.02)


def test_frame_zero_is_the_default_reference_with_zero_pose_and_its_noise():
    _, points = sample(5, 30, shaking(5), 6)
    found = fit_motion(points, None, ORIGIN)
    np.testing.assert_allclose(found.pose[0], 0, atol=1e-15)
    assert found.residual_m[0] < 1e-15
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma[0], sigma[1], rtol=0.02)
    assert found.points[0] == 30


def test_outliers_are_found_and_do_not_count():
    pose = shaking(400, seed=9)
    reference, clean = sample(400, 60, pose, 7)
    rng = np.random.default_rng(10)
    outlying = rng.uniform(size=(400, 60)) < 0.2
    position = clean.position_m + np.where(outlying[..., None], rng.normal(1e-3, 1e-3, (400, 60, 3)), 0.0)
    found = fit_motion(of(position, clean.covariance_m2), reference, ORIGIN)
    assert np.mean(found.points == (~outlying).sum(axis=1)) > 0.95
    check_coverage(found, pose)
    assert found.residual_m.max() < 6e-6


def test_good_points_are_used_and_a_factor_in_their_noise_affects_only_the_covariance():
    reference, points = sample(200, 500, shaking(200), 11)
    plain = fit_motion(points, reference, ORIGIN)
    assert 1 - plain.points.sum() / (200 * 500) < 1e-4
    tenfold = fit_motion(of(points.position_m, 100 * points.covariance_m2), reference, ORIGIN)
    np.testing.assert_allclose(tenfold.covariance, 100 * plain.covariance, rtol=1e-9)
    np.testing.assert_allclose(tenfold.pose, plain.pose, atol=1e-13)
    np.testing.assert_array_equal(tenfold.points, plain.points)


def test_an_outlier_is_judged_by_its_covariance():
    reference = body(30)
    position = np.stack([moved(reference, one) for one in shaking(2)])
    position += np.random.default_rng(0).normal(0, 1e-6, position.shape)
    position[:, 0, 2] += 50e-6
    position[:, 1, 0] += 50e-6
    covariance = np.broadcast_to(1e-12 * np.eye(3), (2, 30, 3, 3)).copy()
    covariance[:, 0, 2, 2] = covariance[:, 1, 2, 2] = 50e-6**2
    found = fit_motion(of(position, covariance), reference, ORIGIN)
    np.testing.assert_array_equal(found.points, 29)


def test_points_that_are_missing_anywhere_or_have_no_covariance_do_not_count():
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
    # points missing in the reference, or without a covariance
    reference, points = sample(3, 30, shaking(3), 13)
    position, covariance = points.position_m.copy(), points.covariance_m2.copy()
    position[0, :5] = np.nan
    np.testing.assert_array_equal(fit_motion(of(position, covariance), None, ORIGIN).points, 25)
    covariance[:, 0], covariance[:, 1], covariance[:, 2] = 0.0, -NOISE, np.nan
    np.testing.assert_array_equal(fit_motion(of(points.position_m, covariance), reference, ORIGIN).points, 27)


def test_planar_points_give_all_six_components_and_points_on_one_line_none():
    reference, pose = body(25, depth=0.0), shaking(3)
    found = fit_motion(of(np.stack([moved(reference, one) for one in pose])), reference, ORIGIN)
    np.testing.assert_allclose(found.pose, pose, atol=1e-12)
    line = np.outer(np.linspace(0, 0.1, 9), [1.0, 2.0, 0.5])
    found = fit_motion(of(np.stack([line, moved(line, np.full(6, 1e-3))])), line, ORIGIN)
    assert np.isnan(found.pose).all()
    np.testing.assert_array_equal(found.points, 0)


def test_another_reference_pose_is_a_composition():
    reference, points = sample(6, 30, shaking(6, angle=0.4), 15)
    position = points.position_m.copy()
    position[4] = np.nan
    found = fit_motion(of(position, points.covariance_m2), reference, ORIGIN)
    mean = np.array([1e-3, -2e-3, 5e-4, 0.3, -0.2, 0.1])
    again = relative_to(found, mean)
    good, back = [0, 1, 2, 3, 5], RigidTransform.from_pose(mean).inverse()
    expected = [(RigidTransform.from_pose(pose) @ back).pose for pose in found.pose[good]]
    np.testing.assert_allclose(again.pose[good], expected, atol=1e-14)
    assert np.isnan(again.pose[4]).all()
    direct = fit_motion(of(position, points.covariance_m2), moved(reference, mean), ORIGIN)
    np.testing.assert_allclose(again.pose[good], direct.pose[good], atol=1e-12)
    sigma = np.sqrt(np.diagonal(direct.covariance[good], axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(again.covariance[good] / scale, direct.covariance[good] / scale, atol=1e-8)


def test_another_origin_is_that_of_a_fit_about_it():
    reference, points = sample(6, 30, shaking(6, angle=0.4), 16)
    position = points.position_m.copy()
    position[4] = np.nan
    found, centre = fit_motion(of(position, points.covariance_m2), reference, ORIGIN), reference.mean(axis=0)
    direct = fit_motion(of(position, points.covariance_m2), reference, centre)
    good, about = [0, 1, 2, 3, 5], found.about(centre)
    np.testing.assert_array_equal(about.origin_m, centre)
    np.testing.assert_allclose(about.pose[good], direct.pose[good], atol=1e-12)
    assert np.isnan(about.pose[4]).all()
    sigma = np.sqrt(np.diagonal(direct.covariance[good], axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(about.covariance[good] / scale, direct.covariance[good] / scale, atol=1e-8)


@pytest.mark.parametrize("given_reference", [True, False])
def test_noise_of_points_without_covariance_is_found_from_the_rigid_fit(given_reference):
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


def test_a_body_that_bends_is_not_rotated_to_its_least_certain_points():
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
    points = Points3D(position, np.broadcast_to(covariance, (*position.shape, 3)), np.zeros(position.shape[:2]))
    motion = fit_motion(points, None, np.zeros(3))
    np.testing.assert_allclose(motion.pose[1, :3], shift, atol=1e-5)
    assert np.max(np.abs(motion.pose[1, 3:])) < 1e-3
    assert np.sqrt(motion.covariance[1, 1, 1]) > 3e-5  # the misfit of a millimetre, not the noise of a micrometre
    np.testing.assert_allclose(motion.residual_m[1], 0.08 * np.std(y) / np.sqrt(3), rtol=0.05)


# Residuals beside a rigid motion, against points that move as they are told.

ROOT = np.array([[0.3, 0.0, 0.0], [0.05, 0.25, 0.0], [0.1, -0.2, 0.9]]) * 1e-6
FRAMES = 60


PLATE = np.array([(x, y, 0.02) for y in np.linspace(-0.04, 0.04, 7) for x in np.linspace(-0.05, 0.05, 9)])


def moving(rng: np.random.Generator, bent: np.ndarray | float = 0.0, uneven: float = 10.0) -> Points3D:
    """Points whose noise grows away from the middle; the reference frame has noise of its own."""
    pose = np.concatenate([rng.normal(0, 1e-4, (FRAMES, 3)), rng.normal(0, 0.02, (FRAMES, 3))], axis=1)
    pose[0] = 0.0
    moved = (PLATE + bent) @ np.swapaxes(rotation_from_vector(pose[:, 3:]), 1, 2) + pose[:, None, :3]
    grow = (1.0 + uneven * np.abs(PLATE[:, 0]))[:, None, None]
    noise = rng.normal(size=moved.shape)[..., None, :] @ np.swapaxes(grow * ROOT, 1, 2)
    covariance = np.broadcast_to(grow**2 * (ROOT @ ROOT.T), (*moved.shape, 3))
    return Points3D(moved + noise[..., 0, :], covariance, np.zeros(moved.shape[:2]))


def beside(points: Points3D) -> Deformation:
    """Against the first frame, whose noise is that of the reference."""
    return deformation(points, fit_motion(points, None, np.array([0.01, 0.0, -0.03])))


def squares(shape: Deformation) -> np.ndarray:
    return np.einsum("fni,fnij,fnj->fn", shape.residual_m, np.linalg.inv(shape.covariance_m2), shape.residual_m)


def test_a_rigid_body_leaves_noise_of_the_stated_covariance_which_counts_the_leverage_of_the_fit():
    """Chi-square of all points, and of each point, over 4 series."""
    found = np.array([squares(beside(moving(np.random.default_rng(seed)))) for seed in range(4)])
    assert found.mean() / 3 == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(found.mean(axis=(0, 1)) / 3, 1.0, atol=0.28)
    points = moving(np.random.default_rng(9))
    few = np.array([0, 8, 30, 54, 62])
    part = Points3D(points.position_m[:, few], points.covariance_m2[:, few], points.reprojection_px[:, few])
    shape = beside(part)
    full = np.linalg.inv(part.covariance_m2)
    assert squares(shape).mean() / 3 == pytest.approx(1.0, abs=0.1)
    assert np.einsum("fni,fnij,fnj->fn", shape.residual_m, full, shape.residual_m).mean() / 3 < 0.7


def test_bending_comes_back_in_the_axes_of_the_body():
    """A saddle, orthogonal to all rigid motions, that turns with the body; constant parts are not seen."""
    rest = PLATE
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


def test_missing_points_do_not_affect_others():
    points = moving(np.random.default_rng(11))
    points.position_m[5, 3] = np.nan
    points.position_m[:, 7] = np.nan
    shape = beside(points)
    missing = np.zeros((FRAMES, len(PLATE)), bool)
    missing[5, 3], missing[:, 7] = True, True
    np.testing.assert_array_equal(np.isnan(shape.residual_m).all(axis=2), missing)
    np.testing.assert_array_equal(np.isnan(shape.covariance_m2).any(axis=(2, 3)), missing)
    np.testing.assert_allclose(np.nanmean(shape.residual_m[:, [0, 3]], axis=0), 0.0, atol=1e-18)


def test_wrong_calls_are_named():
    reference, few = sample(2, 30, shaking(2), 14)
    refused("reference_m", fit_motion, few, reference[:5], ORIGIN)
    refused("^reference_m: .* 3 ", fit_motion, few, np.full((30, 3), np.nan), ORIGIN)
    refused("origin_m", fit_motion, few, reference, np.zeros(2))
    refused("^correlation: .* 30 ", fit_motion, few, None, ORIGIN, overlap_correlation(np.eye(2), 3))
    refused("covariance", RigidMotion, np.zeros((2, 6)), np.zeros((2, 6)), np.zeros(2), np.zeros(2, int), np.zeros(3))
    refused("mean_pose", relative_to, fit_motion(few, reference, ORIGIN), np.zeros(5))
    refused("^position_m: .* 3 points .* 2 frames", points_with_estimated_noise, body(10)[None])
    refused("^radius_px: .* 1, .* 0", overlap_correlation, np.zeros((3, 2)), 0)
    points = moving(np.random.default_rng(12))
    motion = fit_motion(points, None, np.zeros(3))
    refused("^reference_m: ", deformation, points, motion, np.zeros((4, 3)))
    part = Points3D(points.position_m[1:], points.covariance_m2[1:], points.reprojection_px[1:])
    refused(r"^motion\.pose: ", deformation, part, motion)


# Noise that overlapping subsets share, by registration of noisy images and by Monte Carlo of the rigid fit.


@pytest.mark.slow
def test_correlation_of_registered_subsets_is_their_shared_area(make_texture):
    """Subsets 7 px apart, 21 px wide: pairs by displacement, pooled over places and 120 noisy images."""
    rng, radius, step = np.random.default_rng(1), 10, 7
    image = 2000 + 500 * make_texture(seed=1, s=1.3, waves=80).image((110, 96))
    centres = np.array([(x, y) for y in range(14, 83, step) for x in range(14, 97, step)], dtype=float)
    reference = prepare_reference(spline_of_image(image), centres, radius)
    still, fine = np.zeros((len(centres), 6)), TrackSettings(convergence_px=1e-5)
    noisy = (spline_of_image(image + rng.normal(0, 12, image.shape)) for _ in range(120))
    moved = np.array([register(reference, target, still, fine).warp[:, [0, 3]] for target in noisy])
    expected = overlap_correlation(centres, radius).toarray()
    apart = np.abs(centres[:, None] - centres[None])
    correlation = np.mean([np.corrcoef(moved[:, :, i].T) for i in range(2)], axis=0)
    for across, down in ((step, 0), (0, step), (step, step), (2 * step, 0), (2 * step, step), (3 * step, 0)):
        pairs = (apart[..., 0] == across) & (apart[..., 1] == down)
        assert correlation[pairs].mean() == pytest.approx(expected[pairs].mean(), abs=0.06)
        assert np.ptp(expected[pairs]) < 1e-12


@pytest.mark.slow
def test_scatter_of_a_rigid_fit_is_stated_with_the_correlation_and_not_without():
    """White noise of the pixels averaged over the subsets moves the points; three times overlap in both directions."""
    rng, radius, step, pixel = np.random.default_rng(2), 10, 7, 1e-4
    side = 2 * radius + 1
    rows, columns = np.mgrid[10:100:step, 10:120:step]
    centres = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    reference = np.column_stack([centres * pixel, 1e-3 * np.sin(centres[:, 0])])
    root = np.array([[1.0, 0, 0], [0.2, 0.9, 0], [0.3, -0.4, 3.0]]) * 1e-7
    frames = 300
    noise = np.empty((frames, len(centres), 3))
    for k in range(frames):
        field = [ndimage.uniform_filter(rng.normal(size=(110, 130)), side) * side for _ in range(3)]
        noise[k] = np.stack([part[rows, columns].ravel() for part in field], axis=1) @ root.T
    covariance = np.broadcast_to(root @ root.T, (frames, len(centres), 3, 3))
    points = Points3D(reference + noise, covariance, np.zeros((frames, len(centres))))
    origin = reference.mean(axis=0)
    plain = fit_motion(points, reference, origin)
    aware = fit_motion(points, reference, origin, overlap_correlation(centres, radius))
    np.testing.assert_array_equal(plain.pose, aware.pose)
    scatter = np.std(plain.pose, axis=0)
    stated = [np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2).mean(axis=0)) for motion in (plain, aware)]
    np.testing.assert_allclose(scatter / stated[1], 1.0, atol=0.1)
    assert np.all(scatter / stated[0] > 2.4)


def test_correlation_is_one_of_noise_and_that_of_independent_points_the_identity():
    """Symmetric, unit diagonal, positive semidefinite, blind to missing subsets, and nothing side by side."""
    apart = np.array([(x, y) for y in range(10, 80, 21) for x in range(10, 90, 21)], dtype=float)
    np.testing.assert_array_equal(overlap_correlation(apart, 10).toarray(), np.eye(len(apart)))
    centres = np.random.default_rng(3).uniform(20, 90, (60, 2))
    centres[7] = np.nan
    matrix = overlap_correlation(centres, 8).toarray()
    np.testing.assert_array_equal(matrix, matrix.T)
    np.testing.assert_array_equal(np.diag(matrix), 1.0)
    assert np.linalg.eigvalsh(matrix).min() > -1e-12
    assert np.count_nonzero(matrix[7]) == 1
    reference, points = sample(3, 12, shaking(3), 4)
    points.position_m[1, 4] = np.nan
    plain = fit_motion(points, reference, ORIGIN)
    apart = fit_motion(points, reference, ORIGIN, overlap_correlation(1e5 * reference[:, :2], 1))
    np.testing.assert_allclose(apart.covariance, plain.covariance, rtol=1e-9)


# A speckled body on a translation stage: 15 states of a published stereo DIC experiment.

UM = 1e-6


def test_a_stage_and_a_rigid_body_on_it(data_dir):
    """Published for these images: 1.3 µm of translation, 51 arc seconds; an independent evaluation found 1.69 µm."""
    folder = data_dir / "duodic_rigid"
    with np.load(folder / "matched_points.npz") as file:
        left, right, stage_m = (file[name] for name in ("left", "right", "stage_translation_m"))
    points = triangulate(read_calibration(folder / "calibration.json"), left, right)
    motion = fit_motion(points, None, np.nanmean(points.position_m[0], axis=0))
    shift = motion.pose[:, :3]
    error = np.linalg.norm(shift, axis=1) - stage_m
    assert np.abs(error[1:]).mean() <= 1.8 * UM
    assert np.abs(error).max() < 4 * UM
    # one straight line
    direction = shift[-1] / np.linalg.norm(shift[-1])
    across = shift - np.outer(shift @ direction, direction)
    assert np.linalg.norm(across, axis=1).max() < 10 * UM
    assert np.degrees(np.linalg.norm(motion.pose[:, 3:], axis=1)).max() * 3600 < 51
    # Residual of Arun's fit: the stated bar. It grows with the travel: 0.88 um of the last state lie along it.
    assert np.count_nonzero(np.isnan(points.reprojection_px)) == 1
    assert np.nanmedian(points.reprojection_px) < 0.06
    for position in points.position_m[1:]:
        known = np.isfinite(position).all(axis=1) & np.isfinite(points.position_m[0]).all(axis=1)
        first, now = points.position_m[0][known], position[known]
        residual = now - fit_rigid(first, now).apply(first)
        assert np.sqrt((residual**2).mean()) <= 1.0 * UM
    assert motion.points.min() > 0.99 * 3475
    assert motion.residual_m.max() < 1.4 * UM  # the likely fit weighs depth less and so leaves more of it
