"""Several images of one pose of the target: clusters, copies, what the images share; and the two starts of a camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from alignment_factory import rig_error
from contracts import refused

from photogram.calibration import calibration_notices as notices
from photogram.calibration import initial_bundle
from photogram.calibration.bundle import Bundle, ImageObservations, make_shape
from photogram.calibration.calibration_result import Calibration, session_notices
from photogram.calibration.initial_bundle import ViewPair, start_bundle
from photogram.calibration.session import calibrate_pair
from photogram.calibration.view_clusters import pose_clusters, reject_copies, repeated_variance
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from photogram.synthetic.board import Board, SessionFaults, random_poses, random_rig, simulate_session
from photogram.targets.target_view import Target, TargetView
from shakercal._common.notices import DeclaredNotice, Notice

SIZE = np.array([1280, 1024])
BOARD = Board(Target("chessboard", 9e-3, (10, 7)))
NOISE_PX = 0.03


def _session(
    seed: int, held: int, each: int, shared_px: float, tremor: float = 0.0
) -> tuple[StereoRig, list[tuple[TargetView, TargetView]]]:
    """Views of `held` poses, `each` images of each, which share an error; the target trembles by `tremor` (rad)."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng, SIZE, 0.15)
    poses = []
    for pose in random_poses(rng, rig, BOARD, held):
        middle = pose.apply(BOARD.points_m.mean(axis=0))
        for _ in range(each):
            turn = rotation_from_vector(tremor * rng.normal(size=3))
            shift = tremor * 0.1 * rng.normal(size=3)
            poses.append(RigidTransform(turn @ pose.rotation, turn @ (pose.translation_m - middle) + middle + shift))
    return rig, simulate_session(rng, rig, poses, BOARD, NOISE_PX, SessionFaults(smooth_px=shared_px, held=each))


def _ratios(calibration: Calibration, rig: StereoRig) -> np.ndarray:
    """The errors of all parameters in standard uncertainties."""
    covariance = calibration.rig.covariance
    assert covariance is not None
    return np.asarray(rig_error(calibration.rig, rig)[:24] / np.sqrt(np.diagonal(covariance))[:24])


def _u(calibration: Calibration) -> np.ndarray:
    assert calibration.rig.covariance is not None
    return np.sqrt(np.diagonal(calibration.rig.covariance))[:24]


def _found(calibration: Calibration, declared: DeclaredNotice) -> Notice | None:
    return next((item for item in calibration.notices if item.code == declared.code), None)


def _copy(view: TargetView, name: str, error_px: float = 0.0, seed: int = 0) -> TargetView:
    """The view of a copied image, whose points encoding moves by some px."""
    moved = view.position_px + error_px * np.random.default_rng(seed).normal(size=view.position_px.shape)
    return replace(view, name=name, position_px=moved)


@pytest.mark.parametrize("reached", [0, 1, 4])
def test_a_session_whose_points_reach_no_corner_is_named(reached):
    """Points of the left images within half of the width and height, and some at the corners of the image."""
    found = calibrate_pair(_session(4, 9, 1, 0.0)[1], BOARD.target, "flat", lens="polynomial")
    corners, middle = np.array([[1, 1], [1, -2], [-2, 1], [-2, -2]])[:reached] % SIZE, (SIZE - 1) / 2
    views = []
    for view in found.views:
        position = middle + 0.5 * (view.left.position_px - middle)
        position[:reached] = corners
        left = replace(view.left, position_px=position, used=np.ones(len(position), np.bool_))
        views.append(replace(view, left=left))
    changed = replace(found, views=tuple(views), image_coverage=(0.7, 0.9))
    of_left = [one for one in session_notices(changed) if (one.code, one.where) == (notices.LOW_COVERAGE.code, "left")]
    assert [one.values["corners"] for one in of_left] == ([] if reached else [0])


def test_images_of_held_poses_are_counted_by_pose_and_their_shared_error_is_in_u():
    rig, pairs = _session(4, 6, 5, 0.05)
    found = calibrate_pair(pairs, BOARD.target)
    assert [view.pose for view in found.views] == np.repeat(np.arange(6), 5).tolist()
    repeated, few = _found(found, notices.REPEATED_POSES), _found(found, notices.FEW_VIEWS)
    assert repeated is not None
    assert few is not None
    assert repeated.values == {"views": 30, "poses": 6}
    assert few.values["count"] == 6
    assert found.cross_validation.halves is None
    assert found.cross_validation.drift is None
    ratios = _ratios(found, rig)
    assert np.sqrt((ratios**2).mean()) < 1.6
    assert np.abs(ratios).max() < 4.5
    one = calibrate_pair(pairs[::5], BOARD.target)
    assert 0.6 < np.median(_u(found) / _u(one)) < 1.4  # five images of a pose tell hardly more than one


def test_images_that_share_nothing_tell_as_much_as_other_poses_would():
    rig, pairs = _session(5, 10, 4, 0.0)
    found, one = (calibrate_pair(some, BOARD.target, "flat", lens="polynomial") for some in (pairs, pairs[::4]))
    assert 0.4 < np.median(_u(found) / _u(one)) < 0.65
    assert np.abs(_ratios(found, rig)).max() < 4.5
    assert _found(one, notices.REPEATED_POSES) is None
    assert [view.pose for view in one.views] == list(range(10))


def test_bursts_of_unequal_length_and_a_hand_that_trembles():
    rig, pairs = _session(6, 7, 5, 0.05, tremor=0.004)
    lengths = [1, 2, 5, 1, 4, 1, 3]
    some = [pairs[5 * held + number] for held, length in enumerate(lengths) for number in range(length)]
    found = calibrate_pair(some, BOARD.target, "flat", lens="polynomial")
    assert [view.pose for view in found.views] == np.repeat(np.arange(7), lengths).tolist()
    ratios = _ratios(found, rig)
    assert np.sqrt((ratios**2).mean()) < 1.6
    assert np.abs(ratios).max() < 4.5


def test_copies_of_files_are_named_and_change_nothing():
    _, pairs = _session(7, 7, 1, 0.02)
    copied = [
        (_copy(left, f"{left.name}-{n}"), _copy(right, f"{right.name}-{n}")) for left, right in pairs for n in "ab"
    ]
    found, one = calibrate_pair(copied, BOARD.target), calibrate_pair(pairs, BOARD.target)
    # The adjustment stops at a step, not at a bit: what is left depends on how a machine adds.
    assert np.all(np.abs(found.rig.values - one.rig.values)[:24] <= 1e-4 * _u(one))
    assert np.allclose(_u(found), _u(one), rtol=1e-6, atol=0)
    copies = [item for item in found.rejections if item.copy]
    assert [item.name for item in copies[:2]] == ["L0-b", "R0-b"]
    assert copies[0].reason == "a copy of L0-a"
    warned = _found(found, notices.COPIED_IMAGES)
    assert warned is not None
    assert warned.values == {"count": 14, "first": "L0-b"}
    few = _found(found, notices.FEW_VIEWS)
    assert few is not None
    assert few.values["count"] == 7
    assert _found(one, notices.COPIED_IMAGES) is None


@pytest.mark.parametrize(("error_px", "copies"), [(0.004, True), (0.02, False)])
def test_an_image_encoded_a_second_time_adds_next_to_nothing(error_px, copies):
    """Either it is a copy, or its noise is mostly that of the first: what both share is estimated."""
    _, pairs = _session(8, 9, 1, 0.0)
    again = [
        (_copy(left, f"{left.name}-b", error_px, 2 * n), _copy(right, f"{right.name}-b", error_px, 2 * n + 1))
        for n, (left, right) in enumerate(pairs)
    ]
    both = [pair for two in zip(pairs, again, strict=True) for pair in two]
    found, one = (calibrate_pair(some, BOARD.target, "flat", lens="polynomial") for some in (both, pairs))
    assert (len(found.views) == 9) is copies
    assert found.pose_count() == 9
    assert 0.85 < np.median(_u(found) / _u(one)) < 1.15


def test_a_copy_on_one_side_leaves_the_other_and_the_same_images_of_both_cameras_are_refused():
    _, pairs = _session(9, 6, 1, 0.0)
    stuck: list[ViewPair] = [*pairs[:3], (_copy(pairs[2][0], "L3"), pairs[3][1]), *pairs[4:]]
    remaining, copies = reject_copies(stuck)
    assert remaining[3] == (None, pairs[3][1])
    assert [(item.name, item.reason) for item in copies] == [("L3", "a copy of L2")]
    twice = [(left, _copy(left, f"right/{left.name}")) for left, _ in pairs]
    refused("L0 and right/L0", calibrate_pair, twice, BOARD.target)
    mono, copies = reject_copies([(left, None) for left, _ in pairs] + [(_copy(pairs[0][0], "again"), None)])
    assert (len(mono), [item.name for item in copies]) == (6, ["again"])
    assert reject_copies([(None, right) for _, right in pairs])[1] == ()


def test_two_poses_are_too_few_whatever_the_number_of_images():
    _, pairs = _session(10, 2, 6, 0.0)
    refused("12 views show 2 different poses", calibrate_pair, pairs, BOARD.target)


def test_one_camera_counts_poses_as_well():
    _, pairs = _session(11, 7, 3, 0.05)
    found = calibrate_pair([(left, None) for left, _ in pairs], BOARD.target)
    assert found.pose_count() == 7
    few = _found(found, notices.FEW_VIEWS)
    assert few is not None
    assert (few.values["count"], few.values["kind"]) == (7, "views of different poses")


def test_a_slow_path_is_cut_into_poses_and_a_pose_taken_again_is_the_same():
    camera = Camera.from_parameters(np.array([2000.0, 2000, 640, 512, 0, 0, 0, 0, 0]), SIZE)
    rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0, 0])))

    def at(x_m: float, turn_rad: float = 0.0) -> RigidTransform:
        return RigidTransform(rotation_from_vector(np.array([0.0, turn_rad, 0.0])), np.array([x_m, 0.0, 0.5]))

    shape = make_shape("flat", np.array([[0, 0], [1, 0], [0, 1]]), Target("chessboard", 1e-9, (3, 3)))
    path = [at(x) for x in np.linspace(0.0, 0.2, 101)]  # 800 px, half of the image's diagonal
    cluster = pose_clusters(Bundle(rig, tuple(path), shape))
    assert (np.diff(cluster) >= 0).all()
    assert 12 <= cluster.max() + 1 <= 28  # the path is 25 times as long as a pose may differ
    again = (at(0.0), at(0.05), at(0.001), at(0.0, 0.05), at(0.05, 0.01))
    assert pose_clusters(Bundle(rig, again, shape)).tolist() == [0, 1, 0, 2, 1]


@pytest.mark.parametrize(("alone", "shared"), [(0.03, 0.0), (0.03, 0.05), (0.0, 0.04)])
def test_what_images_of_a_pose_share_is_found_in_their_residuals(alone, shared):
    rng = np.random.default_rng(1)
    poses, images, points = 40, 4, 100
    observed, residuals, used, cluster = [], [], [], np.repeat(np.arange(poses), images)
    for pose in range(poses):
        common = shared * rng.normal(size=(points, 2))
        for number in range(images):
            view = pose * images + number
            kept = rng.random(points) < 0.95
            empty = np.zeros((points, 2))
            observed.append(
                ImageObservations(view, 0, np.arange(points), empty, empty[:, None] * empty[..., None], 0.0)
            )
            residuals.append(common + alone * rng.normal(size=(points, 2)))
            used.append(kept)
    found = repeated_variance(cluster, observed, residuals, used, parameters=0.0)
    # of 4 images, three times what they share; six degrees of freedom of 190 of each are not taken from these residuals
    expected = 3 * shared**2 / (1 - 6 / 190)
    assert found.mean() == pytest.approx(expected, rel=0.04, abs=3 * 0.1 * alone**2)
    assert not repeated_variance(np.arange(len(cluster)), observed, residuals, used, 0.0).any()


def test_either_start_alone_leads_to_the_same_pair(monkeypatch):
    """OpenCV's start and that in closed form: 40 further sessions in `benchmarks/cameras.py`."""
    _, pairs = _session(12, 8, 1, 0.02)
    both = calibrate_pair(pairs, BOARD.target, "flat")
    camera, poses = initial_bundle._closed_form_start([left for left, _ in pairs], BOARD.target)
    assert camera.parameters[0] == pytest.approx(both.rig.left.parameters[0], rel=0.1)
    assert len(poses) == len(pairs)

    def fails(*_: object) -> None:
        raise ValueError("no start")

    for name in ("_opencv_start", "_closed_form_start"):
        with monkeypatch.context() as patch:
            patch.setattr(initial_bundle, name, fails)
            one = calibrate_pair(pairs, BOARD.target, "flat")
        assert np.abs((one.rig.values - both.rig.values)[:24] / _u(both)).max() < 0.1
    with monkeypatch.context() as patch:
        for name in ("_opencv_start", "_closed_form_start"):
            patch.setattr(initial_bundle, name, fails)
        refused("do not determine a camera", start_bundle, pairs, BOARD.target, "flat")


def test_closed_form_start_of_an_ideal_camera_is_exact():
    camera = Camera.from_parameters(np.array([1900.0, 1900, 639.5, 511.5, 0, 0, 0, 0, 0]), SIZE)
    turn, crossing = rotation_from_vector(np.array([0.0, 0.3, 0.0])), np.array([0.0, 0.0, 0.25])
    rig = StereoRig(camera, camera, RigidTransform(turn, crossing - turn @ crossing))
    poses = random_poses(np.random.default_rng(0), rig, BOARD, 4)
    pairs = simulate_session(np.random.default_rng(1), rig, poses, BOARD, 1e-9)
    found, starts = initial_bundle._closed_form_start([left for left, _ in pairs], BOARD.target)
    assert found.parameters[:2] == pytest.approx(1900.0, rel=1e-6)
    for pose, start in zip(poses, starts, strict=True):
        assert np.abs(start.translation_m - pose.translation_m).max() < 1e-5


@pytest.mark.slow
def test_a_wide_lens_of_few_views_is_compared_by_finite_predictions():
    """Without a view at the edge the rational lens may have no image there: its prediction was NaN."""
    rng = np.random.default_rng(4)
    wide = np.array([0.35, 0.05, 2e-4, -1e-4, 0.002, 0.65, 0.18, 0.02])
    cameras = [
        Camera(np.array([[f, 0, 645], [0, f, 509], [0, 0, 1.0]]), wide * (1 + 0.02 * rng.normal(size=8)), SIZE)
        for f in (560.0, 571.0)
    ]
    turn, crossing = rotation_from_vector(np.array([0.0, 0.3, 0.01])), np.array([0.0, 0.0, 0.1])
    rig = StereoRig(*cameras, RigidTransform(turn, crossing - turn @ crossing + np.array([1e-3, 0, 0])))
    pairs = simulate_session(rng, rig, random_poses(rng, rig, BOARD, 14), BOARD, NOISE_PX)
    judged = calibrate_pair(pairs, BOARD.target, "flat").cross_validation
    assert judged is not None
    assert judged.lens == "rational"
    assert np.isfinite([judged.predicted_px, *(other.predicted_px for other in judged.alternatives)]).all()


@pytest.mark.slow
@pytest.mark.parametrize("each", [2, 8])
def test_errors_over_u_of_sessions_with_several_images_of_a_pose(each):
    """Bars: 0.85 to 1.15 rms, none beyond 4.5, by `benchmarks/cameras.py`; six sessions scatter by some 0.1."""
    ratios = []
    for seed in range(100, 106):
        rig, pairs = _session(seed, 8, each, 0.05)
        ratios.append(_ratios(calibrate_pair(pairs, BOARD.target), rig))
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.3
    assert np.abs(ratios).max() < 4.5
