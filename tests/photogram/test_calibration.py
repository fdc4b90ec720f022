"""Calibration of a stereo pair on points that OpenCV projected with known truth, and the file that keeps it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from alignment_factory import rig_error
from contracts import refused, slow
from hypothesis import given, settings
from hypothesis import strategies as st

from photogram.alignment.alignment_evidence import measure_target_pose
from photogram.calibration import calibration_notices as notices
from photogram.calibration.adjust import adjust, leave_views_out, predict_view
from photogram.calibration.bundle import FocalDrift, make_shape, model_pixels
from photogram.calibration.calibration_file import read_calibration, read_camera, write_calibration, write_camera
from photogram.calibration.calibration_result import Calibration, KnownLength, scale_to_length
from photogram.calibration.initial_bundle import estimate_target_pose, image_observations, lens_prior, start_bundle
from photogram.calibration.session import calibrate_pair
from photogram.camera import CAMERA_PARAMETERS, LEFT, RIG_PARAMETERS, RIGHT, Camera, StereoRig, triangulate
from photogram.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from photogram.synthetic.board import SessionFaults, random_poses, random_rig, simulate_session
from photogram.synthetic.patterns import Board
from photogram.targets.target_view import Target, TargetView

SIZE = np.array([1280, 1024])
SPACING = 0.012
TARGET = Target("chessboard", SPACING, (12, 9))
COLUMNS, ROWS = np.meshgrid(np.arange(12), np.arange(9))
INDEX = np.stack([COLUMNS.ravel(), ROWS.ravel()], axis=-1)
FLAT = np.column_stack([INDEX * SPACING, np.zeros(len(INDEX))])
NOISE_PX = 0.04


def _camera(side: int) -> Camera:
    parameters = np.array([3000 + 40 * side, 3006, 650 - 30 * side, 500, -0.08, 0.05, 3e-4, -2e-4, 0.02])
    return Camera.from_parameters(parameters, SIZE)


RIG = StereoRig(
    _camera(0),
    _camera(1),
    RigidTransform(rotation_from_vector(np.array([0.01, 0.32, -0.02])), np.array([-0.155, 0.002, 0.03])),
)


def _opencv_pixels(camera: Camera, transform: RigidTransform, points_m: np.ndarray) -> np.ndarray:
    turn = vector_from_rotation(transform.rotation)
    pixels, _ = cv2.projectPoints(points_m, turn, transform.translation_m, camera.matrix, camera.distortion)
    return np.asarray(pixels).reshape(-1, 2)


def _poses(rng: np.random.Generator, count: int, tilt: float = 0.5) -> list[RigidTransform]:
    poses = []
    for _ in range(count):
        vector = np.array([*rng.uniform(-tilt, tilt, 2), rng.uniform(-0.3, 0.3)])
        rotation = rotation_from_vector(vector)
        middle = np.array([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.43, 0.57)])
        poses.append(RigidTransform(rotation, middle - rotation @ FLAT.mean(axis=0)))
    return poses


def _views(
    rng: np.random.Generator,
    poses: list[RigidTransform],
    rig: StereoRig = RIG,
    points: np.ndarray = FLAT,
    index: np.ndarray = INDEX,
) -> list[tuple[TargetView, TargetView]]:
    """Views of the target with normal noise, points outside the picture left out."""
    pairs = []
    for number, pose in enumerate(poses):
        sides = []
        for side, camera, transform in (("L", rig.left, pose), ("R", rig.right, rig.right_from_left @ pose)):
            pixels = _opencv_pixels(camera, transform, points)
            inside = ((pixels > 0) & (pixels < SIZE - 1)).all(axis=1)
            seen = pixels[inside] + rng.normal(0, NOISE_PX, (inside.sum(), 2))
            covariance = np.tile(np.eye(2) * NOISE_PX**2, (len(seen), 1, 1))
            sides.append(TargetView(f"{side}{number}", index[inside], seen, covariance, 0.0, 0.7, SIZE))
        pairs.append((sides[0], sides[1]))
    return pairs


def _session(seed: int, count: int, **options: Any) -> list[tuple[TargetView, TargetView]]:
    """Views of the target at random poses."""
    rng = np.random.default_rng(seed)
    return _views(rng, _poses(rng, count), **options)


def _largest(calibration: Calibration, rig: StereoRig = RIG) -> float:
    """The largest error of a parameter, in standard uncertainties."""
    error, variance = rig_error(calibration.rig, rig), np.diagonal(calibration.rig.covariance)
    assert not error[variance == 0].any()
    return float(np.abs(error[variance > 0] / np.sqrt(variance[variance > 0])).max())


def _in_order(calibration: Calibration) -> np.ndarray:
    """The target's points as found, in the order of FLAT."""
    place = {tuple(index): point for index, point in zip(calibration.shape_index, calibration.shape_m, strict=True)}
    return np.array([place[tuple(index)] for index in INDEX])


@pytest.mark.parametrize(("side", "radius"), [(0, 0.0), (1, 0.0), (1, 0.4 * SPACING)])
def test_derivatives_of_the_model(side, radius):
    (pose,) = _poses(np.random.default_rng(1), 1)
    camera, relative = ((RIG.left, RigidTransform.identity()), (RIG.right, RIG.right_from_left))[side]
    if radius:  # of a dot, whose derivatives omit the change of the distortion over its rim
        camera = replace(camera, distortion=np.zeros(5))

    def pixels(step: np.ndarray, shift: np.ndarray | float = 0.0) -> np.ndarray:
        there = RigidTransform(rotation_from_vector(step[3:]) @ pose.rotation, pose.translation_m + step[:3])
        return model_pixels(camera, relative, there, FLAT + shift, radius).pixel

    seen = model_pixels(camera, relative, pose, FLAT, radius)
    if not radius:
        assert np.abs(seen.pixel - _opencv_pixels(camera, relative @ pose, FLAT)).max() < 1e-9
    by_pose = np.moveaxis([(pixels(step) - pixels(-step)) / 2e-6 for step in 1e-6 * np.eye(6)], 0, -1)
    assert np.abs(by_pose - seen.by_pose).max() < 1e-4
    by_x = (pixels(np.zeros(6), np.array([1e-7, 0, 0])) - seen.pixel) / 1e-7
    assert np.abs(by_x - seen.by_point[:, :, 0]).max() < 0.5  # of some 6000 px/m


def test_ellipse_centre_is_that_of_a_fitted_ellipse():
    """Independent: OpenCV's direct ellipse fit to densely projected rim points, without and with lens distortion."""
    (pose,) = _poses(np.random.default_rng(3), 1, tilt=0.7)
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    radius = 0.4 * SPACING
    rim = FLAT[:, None] + radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    for camera, limit in ((replace(RIG.left, distortion=np.zeros(5)), 2e-3), (RIG.left, 4e-3)):
        found = model_pixels(camera, RigidTransform.identity(), pose, FLAT, radius).pixel
        for point in range(0, len(FLAT), 9):
            pixels = _opencv_pixels(camera, pose, rim[point]) - found[point]
            centre = np.array(cv2.fitEllipse((pixels * 64).astype(np.float32))[0]) / 64
            assert np.abs(centre).max() < limit
        bias = found - model_pixels(camera, RigidTransform.identity(), pose, FLAT, 0.0).pixel
        assert np.abs(bias).max() > 0.02, "the correction matters in this view"


def test_outlying_points_and_pictures_and_mirrored_ones_are_named_and_left_out():
    rng = np.random.default_rng(5)
    pairs = _views(rng, _poses(rng, 11))
    left, right = pairs[2]
    moved = left.position_px.copy()
    moved[[3, 30]] += [[2.0, 0.0], [0.0, -1.0]]
    pairs[2] = (replace(left, position_px=moved), right)
    still, shaken = pairs[7]
    off_px = rng.normal(0, 1.0, shaken.position_px.shape)
    pairs[7] = (still, replace(shaken, position_px=shaken.position_px + off_px))
    left, right = pairs[4]  # a mirrored chessboard looks like one from another place: only its partner tells
    mirrored = left.position_px * [-1, 1] + [SIZE[0] - 1, 0]
    pairs[4] = (replace(left, position_px=mirrored, index=left.index * [-1, 1] + [11, 0]), right)
    calibration = calibrate_pair(pairs, TARGET)
    assert {item.name: item.points for item in calibration.rejections} == {"L2": 2, "R7": 0, "L4 and R4": 0}
    assert _largest(calibration) < 4.5


@pytest.mark.parametrize(
    ("kind", "size", "turns", "rolls_deg"),
    [
        ("chessboard", (12, 10), (1, -1), (0, 180)),
        ("chessboard", (11, 9), (1, -1), (270, 0)),
        ("chessboard", (8, 8), (1, -1, 1j, -1j), (0, 135)),
        ("dots", (9, 8), (1, -1), (90, 270)),
        ("dots", (9, 9), (1, -1, 1j, -1j), (0, 270)),
    ],
)
def test_a_rolled_camera_before_a_target_that_looks_alike_after_a_turn(kind, size, turns, rolls_deg):
    """Pictures are numbered as the finders do: the first axis to the right, as far as the target leaves a choice.

    Two of them are numbered from another corner.
    """
    grid = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1).reshape(-1, 2)
    points, middle = np.column_stack([grid * SPACING, np.zeros(len(grid))]), complex(*size) / 2 - 0.5 - 0.5j
    left, right = (
        RigidTransform(rotation_from_vector(np.array([0.0, 0.0, np.radians(angle)])), np.zeros(3))
        for angle in rolls_deg
    )
    rig = replace(RIG, right_from_left=right @ RIG.right_from_left @ left.inverse())

    def numbered(view: TargetView, other: int = 0) -> TargetView:
        places = [((view.index @ [1, 1j]) - middle) * turn + middle for turn in turns]
        slopes = [np.polynomial.polynomial.polyfit(p.real, view.position_px, 1)[1] for p in places]
        best = places[int(np.argsort([-slope[0] / np.linalg.norm(slope) for slope in slopes])[other])]
        return replace(view, index=np.rint(np.stack([best.real, best.imag], -1)).astype(np.int64))

    rng = np.random.default_rng(15)
    poses = [left @ pose for pose in _poses(rng, 8)]
    views = _views(rng, poses, rig, points, grid)
    pairs = [(numbered(one), numbered(other, int(n in (2, 5)))) for n, (one, other) in enumerate(views)]
    calibration = calibrate_pair(pairs, Target(kind, SPACING, size), "flat")
    assert not [item for item in calibration.rejections if item.points == 0]
    assert _largest(calibration, rig) < 4.5


def test_mixed_up_too_few_and_too_similar_views_are_refused():
    pairs, rng = _session(7, 8), np.random.default_rng(8)
    mixed = [(pairs[n][0], pairs[(n + 3) % 8][1]) for n in range(8)]
    refused("correspond", calibrate_pair, mixed, TARGET)
    refused(" 3 ", calibrate_pair, _views(rng, _poses(rng, 2)), TARGET)
    refused("angle", calibrate_pair, _views(rng, _poses(rng, 6, tilt=0.01)), TARGET)


def test_views_turned_about_one_axis_only_are_flagged():
    rng = np.random.default_rng(9)
    poses = []
    for angle in np.linspace(-0.5, 0.5, 9):
        rotation = rotation_from_vector(np.array([0.0, angle, 0.0]))
        poses.append(RigidTransform(rotation, np.array([0, 0, 0.5]) - rotation @ FLAT.mean(axis=0)))
    calibration = calibrate_pair(_views(rng, poses), TARGET)
    (notice,) = (item for item in calibration.notices if item.code == notices.LITTLE_TILT.code)
    assert notice.values["axis"] == "horizontal"


def test_scale_uncertainty_lies_along_the_baseline_and_single_pictures_count():
    pairs = _session(10, 8)
    plain, scaled = calibrate_pair(pairs, TARGET), calibrate_pair(pairs, TARGET, scale_u=1e-3)
    added = scaled.rig.covariance - plain.rig.covariance
    baseline = scaled.rig.right_from_left.translation_m
    assert np.allclose(added[21:24, 21:24], 1e-6 * np.outer(baseline, baseline), rtol=1e-6, atol=1e-16)
    assert np.abs(added[:21]).max() < 1e-6 * np.abs(plain.rig.covariance).max()
    assert any(item.where == "scale" for item in plain.notices)
    assert not any(item.where == "scale" for item in scaled.notices)
    more = calibrate_pair([*pairs, *((left, None) for left, _ in _session(11, 6))], TARGET)
    u_more, u = (each.cross_validation.u_fit[:9] for each in (more, plain))
    assert (u_more < u).all()


SESSION_BOARD = Board(Target("chessboard", 9e-3, (10, 7)))


def _faulty(seed: int, faults: SessionFaults, views: int = 15) -> tuple[StereoRig, list[tuple[TargetView, TargetView]]]:
    """A random pair and a session of it, noise 0.03 px, with faults that its points do not state."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng, SIZE, 0.15)
    return rig, simulate_session(rng, rig, random_poses(rng, rig, SESSION_BOARD, views), SESSION_BOARD, 0.03, faults)


@pytest.mark.parametrize("drifts", [False, True])
def test_one_step_without_a_view_is_the_fit_without_it(drifts):
    _, pairs = _faulty(0, SessionFaults(focus=5e-4 * drifts, smooth_px=0.05), 8)
    bundle, pairs, _ = start_bundle(pairs, SESSION_BOARD.target, "free")
    bundle = replace(bundle, drift=FocalDrift.initial(8) if drifts else None)
    pictures = [
        image_observations(view, number, side, bundle.shape.index, SESSION_BOARD.target.spacing_m)
        for number, pair in enumerate(pairs)
        for side, view in enumerate(pair)
    ]
    prior = lens_prior(bundle.rig)
    whole = adjust(bundle, pictures, prior)
    left_out = leave_views_out(whole, pictures)
    u = np.sqrt(np.diagonal(whole.covariance))
    for view in (0, 5):
        kept = [replace(p, view=p.view - (p.view > view)) for p in pictures if p.view != view]
        again = adjust(whole.bundle.of_views([n for n in range(8) if n != view]), kept, prior)
        change, step = (
            a[u > 0] / u[u > 0] for a in (rig_error(again.bundle.rig, whole.bundle.rig), left_out.steps[view])
        )
        assert np.abs(change).max() > 0.2  # one of eight views matters
        assert np.abs(change - step).max() < 0.15 * np.abs(change).max()
        if drifts:
            np.testing.assert_allclose(
                left_out.drift_steps[view], again.bundle.drift.value - whole.bundle.drift.value, rtol=0.1, atol=1e-6
            )
        own = [n for n, picture in enumerate(pictures) if picture.view == view]
        pose = replace(whole.bundle.of_views([view]), rig=again.bundle.rig, shape=again.bundle.shape)
        if drifts:
            pose = replace(pose, drift=replace(pose.drift, value=again.bundle.drift.value))
        there = predict_view(pose, [replace(pictures[n], view=0) for n in own])
        for n, away in zip(own, there, strict=True):
            assert np.abs(away - left_out.prediction_residuals[n]).max() < 0.02 * np.abs(away).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    "faults",
    [
        SessionFaults(),
        SessionFaults(focus=5e-4),
        SessionFaults(focus=5e-4, focus_profile="warming"),
        SessionFaults(focus=5e-4, focus_profile="jump"),
        SessionFaults(smooth_px=0.05),
        SessionFaults(2e-4, 5e-4, 0.05, 0.03),
    ],
    ids=["none", "focus", "warming", "jump", "smooth", "all"],
)
def test_u_holds_what_real_sessions_do_to_a_calibration(faults):
    """By the residuals alone shared errors are 2 to 3 u (rms); benchmarks/cameras.py has the statistics."""
    ratios, alone = [], []
    for seed in range(5):
        rig, pairs = _faulty(seed, faults)
        found = calibrate_pair(pairs, SESSION_BOARD.target)
        error, u = rig_error(found.rig, rig)[:24], np.sqrt(np.diagonal(found.rig.covariance))[:24]
        ratios.append(error / u)
        alone.append(error / found.cross_validation.u_fit[:24])
        assert found.cross_validation.shape == ("free" if faults.warp_m else "flat")
    pooled = np.sqrt(np.mean(np.square(ratios)))
    assert 0.6 < pooled < 1.3
    assert np.abs(ratios).max() < 5
    if faults.smooth_px:
        assert np.sqrt(np.mean(np.square(alone))) > 1.4 * pooled


def test_focal_lengths_that_change_during_the_session_are_found_and_others_are_not():
    rig, pairs = _faulty(0, SessionFaults(focus=5e-4))
    found = calibrate_pair(pairs, SESSION_BOARD.target)
    value, u = found.cross_validation.drift.T
    assert (np.abs(value - 5e-4) < 3.5 * u).all()
    assert (u < 1e-4).all()
    drifts = [item.values for item in found.notices if item.code == notices.FOCAL_DRIFT.code]
    assert [item["side"] for item in drifts] == ["left", "right"]
    assert [item["change_percent"] for item in drifts] == pytest.approx(100 * value)
    assert [item["expanded_percent"] for item in drifts] == pytest.approx(200 * u)
    steady = calibrate_pair(_faulty(0, SessionFaults())[1], SESSION_BOARD.target)
    assert steady.cross_validation.drift is None
    focal = [*LEFT[:2], *RIGHT[:2]]  # at any time of the session, ±0.025 % around its middle
    spread = 5e-4 * rig.values[focal] / np.sqrt(12)
    u_drifting, u_steady = (np.sqrt(np.diagonal(one.rig.covariance))[focal] for one in (found, steady))
    assert (u_drifting > 0.8 * spread).all()
    assert (u_drifting < 1.6 * np.hypot(spread, u_steady)).all()


def test_a_wide_lens_gets_the_rational_model():
    rng = np.random.default_rng(0)
    wide = [0.35, 0.05, 2e-4, -1e-4, 0.002, 0.65, 0.18, 0.02]
    cameras = [
        Camera(np.array([[f, 0, 645], [0, f, 509], [0, 0, 1.0]]), wide * (1 + 0.02 * rng.normal(size=8)), SIZE)
        for f in (560.0, 571.0)
    ]
    turn, crossing = rotation_from_vector(np.array([0.0, 0.3, 0.01])), np.array([0.0, 0.0, 0.1])
    rig = StereoRig(*cameras, RigidTransform(turn, crossing - turn @ crossing + np.array([1e-3, 0, 0])))
    pairs = simulate_session(rng, rig, random_poses(rng, rig, SESSION_BOARD, 20), SESSION_BOARD, 0.03)
    found = calibrate_pair(pairs, SESSION_BOARD.target, "flat")
    assert found.cross_validation.lens == "rational"
    (other,) = found.cross_validation.alternatives
    assert other.predicted_px > 2 * found.cross_validation.predicted_px
    (difference,) = (item for item in found.notices if item.code == notices.MODEL_DIFFERENCE.code)
    assert (difference.values["lens"], difference.values["used_lens"]) == ("polynomial", "rational")
    rays = np.column_stack([rng.uniform(-0.7, 0.7, (500, 2)), np.ones(500)])
    off = found.rig.left.project(rays) - rig.left.project(rays)
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.3  # principal point and turn trade a little


def test_a_stretched_print_is_told_by_the_focal_lengths():
    square = [
        Camera.from_parameters(c.parameters * [1, c.matrix[0, 0] / c.matrix[1, 1], *[1] * 11], SIZE)
        for c in (RIG.left, RIG.right)
    ]
    pairs = _session(3, 10, rig=replace(RIG, left=square[0], right=square[1]))
    wide = [tuple(replace(view, position_px=view.position_px * [1.0075, 1.0]) for view in pair) for pair in pairs]
    ratios = [item for item in calibrate_pair(wide, TARGET, "flat").notices if item.code == notices.ASPECT_RATIO.code]
    assert [item.where for item in ratios] == ["left", "right"]
    assert notices.ASPECT_RATIO.code not in {item.code for item in calibrate_pair(pairs, TARGET).notices}


def test_a_known_length_is_weighed_against_the_spacing_and_a_contradiction_is_told():
    found = calibrate_pair(_session(10, 8), TARGET, scale_u=1e-3)
    size, spacing = np.linalg.norm(found.rig.right_from_left.translation_m), TARGET.spacing_m
    both = scale_to_length(found, KnownLength("0,0", "0,5", 5.005 * spacing, 5e-3 * spacing))  # 0.1 % longer, u 0.1 %
    assert np.linalg.norm(both.rig.right_from_left.translation_m) == pytest.approx(1.0005 * size, rel=1e-9)
    assert both.scale_u == pytest.approx(1e-3 / np.sqrt(2), rel=1e-3)
    names = [view.left.name for view in found.views[:2]]
    places = [view.left_from_target.apply(found.shape_m.mean(axis=0)) for view in found.views[:2]]
    apart = float(np.linalg.norm(places[1] - places[0]))
    moved = scale_to_length(found, KnownLength(*names, 1.02 * apart, 1e-5 * apart))
    (notice,) = (item for item in moved.notices if item.where == "scale")
    assert notice.code == notices.KNOWN_LENGTH_CONTRADICTED.code
    assert notice.values["difference_percent"] == pytest.approx(2.0)
    assert moved.scale_u > 5e-3
    refused("column,row", scale_to_length, found, KnownLength("L0", "nowhere", 0.1, 0.0))
    refused("^known length: .*0,0", scale_to_length, found, KnownLength("0,0", "0,0", 0.1, 0.0))
    refused("^known length: .* 0 m", KnownLength, "0,0", "1,0", 0.0, 0.0)
    refused("^known length: .* 0.009 and 5", KnownLength, "0,0", "1,0", 0.009, 5.0)  # in um
    words = f"^known length: .* {spacing:g} m, .* 9 m"
    refused(words, scale_to_length, found, KnownLength("0,0", "1,0", 9.0, 0.01))


def test_a_single_camera_is_calibrated_with_the_same_care(tmp_path):
    ratios, alone = [], []
    for seed in range(2):
        rig, pairs = _faulty(seed, SessionFaults(smooth_px=0.05))
        found = calibrate_pair([(left, None) for left, _ in pairs], SESSION_BOARD.target, "flat")
        assert found.single
        assert [item.name for item in found.parameters] == [f"left.{name}" for name in CAMERA_PARAMETERS[:9]]
        error = (found.rig.left.parameters - rig.left.parameters)[:9]
        ratios.append(error / [item.u for item in found.parameters])
        alone.append(error / found.cross_validation.u_fit[:9])
    assert np.abs(ratios).max() < 4.5
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.4 < np.sqrt(np.mean(np.square(alone)))
    write_camera(tmp_path / "camera.json", found)
    camera, covariance = read_camera(tmp_path / "camera.json")
    np.testing.assert_array_equal(camera.parameters, found.rig.left.parameters)
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)[:9]), [item.u for item in found.parameters])
    (tmp_path / "lens.json").write_text('{"format": 1, "lens": []}', encoding="utf-8")
    refused("lens: ", read_camera, tmp_path / "lens.json")


def test_a_bowed_target_is_found_where_it_is_asked_for():
    rng = np.random.default_rng(12)
    place = (FLAT - FLAT.mean(axis=0))[:, :2]
    height = 2e-4 * (place[:, 0] / place[:, 0].max()) ** 2
    pairs = _views(rng, _poses(rng, 12), points=FLAT + np.column_stack([np.zeros((len(FLAT), 2)), height]))
    for kind in ("flat", "bowed", "free"):
        assert np.array_equal(make_shape(kind, INDEX, TARGET).points_m, FLAT), "shapes start flat"
    flat, bowed = (calibrate_pair(pairs, TARGET, shape) for shape in ("flat", "bowed"))
    assert flat.rms_px > 1.5 * bowed.rms_px
    assert bowed.sigma_factor == pytest.approx(1.0, abs=0.05)
    found = _in_order(bowed)[:, 2] - np.mean(bowed.shape_m[:, 2])
    assert np.abs(found - (height - height.mean())).max() < 1.5e-5


@pytest.mark.slow
def test_points_off_the_lattice_are_found_where_asked_for():
    rng = np.random.default_rng(13)
    print_error = rng.normal(0, 3e-5, FLAT.shape) * [1, 1, 0.5]
    pairs = _views(rng, _poses(rng, 14), points=FLAT + print_error)
    flat, free = calibrate_pair(pairs, TARGET, "flat"), calibrate_pair(pairs, TARGET)
    assert flat.rms_px > 2 * free.rms_px
    assert free.sigma_factor == pytest.approx(1.0, abs=0.06)
    left_over = (_in_order(free) - FLAT - print_error)[:, :2]
    similar = np.column_stack([FLAT[:, :2], np.ones(len(FLAT))])  # place, turn and scale of the whole are a convention
    left_over -= similar @ np.linalg.lstsq(similar, left_over, rcond=None)[0]
    assert left_over.std() < 0.2 * 3e-5
    assert _largest(free) < 4.5


@pytest.mark.parametrize("seed", [2, *slow(4, 5)])
def test_offsets_that_points_do_not_have_cost_no_uncertainty(seed):
    pairs = _session(seed, 10)
    flat, free = (calibrate_pair(pairs, TARGET, shape, lens="polynomial") for shape in ("flat", "free"))
    free_u, flat_u = free.cross_validation.u_fit, flat.cross_validation.u_fit
    assert (free_u <= 1.12 * flat_u).all(), "the spread of points that lie on their lattice goes to the end of its fit"
    assert (free_u[flat_u > 0] > 0.97 * flat_u[flat_u > 0]).all()
    assert 0 < np.abs(free.shape_m - flat.shape_m).max() < 3e-6
    (deviation,) = (notice.values for notice in free.notices if notice.code == notices.TARGET_DEVIATION.code)
    assert all(0 < deviation[name] < 1 for name in ("x_um", "y_um", "z_um"))


@settings(max_examples=6, deadline=None)
@given(st.tuples(*[st.floats(-0.5, 0.5)] * 2), st.floats(-3, 3), st.floats(0.4, 0.6))
def test_target_pose_comes_back(tilt, turn, depth):
    rotation = rotation_from_vector(np.array([*tilt, 0.0])) @ rotation_from_vector(np.array([0.0, 0.0, turn]))
    pose = RigidTransform(rotation, np.array([0, 0, depth]) - rotation @ FLAT.mean(axis=0))
    (pair,) = _views(np.random.default_rng(0), [pose])
    for left, right in (pair, (pair[0], None), (None, pair[1])):
        found, covariance = estimate_target_pose(RIG, TARGET, left, right)
        turned = vector_from_rotation(found.rotation @ rotation.T)
        error = np.concatenate([found.translation_m - pose.translation_m, turned])
        assert error @ np.linalg.solve(covariance, error) < 40  # χ² of six: 40 is exceeded once in 2 million


def test_a_target_that_looks_alike_is_numbered_as_the_left_picture_and_one_of_another_spacing_has_no_pose():
    grid = np.stack(np.meshgrid(np.arange(12), np.arange(10), indexing="ij"), axis=-1).reshape(-1, 2)
    target, points = replace(TARGET, size=(12, 10)), np.column_stack([grid * SPACING, np.zeros(len(grid))])
    rng = np.random.default_rng(17)
    (pose,) = _poses(rng, 1)
    ((left, right),) = _views(rng, [pose], RIG, points, grid)
    plain = measure_target_pose(RIG, np.eye(32), target, left, right)
    half_turn = replace(right, index=[11, 9] - right.index)
    turned = measure_target_pose(RIG, np.eye(32), target, left, half_turn)
    np.testing.assert_allclose(turned[0].pose, plain[0].pose, rtol=1e-12)
    for expected, found in zip(plain[1:], turned[1:], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)
    words = "L0 and R0: expected one pose of a target with spacing 12 m, found none"
    refused(words, measure_target_pose, RIG, np.eye(32), replace(target, spacing_m=12.0), left, right)


# The calibration file: what is written comes back, and every wrong file is refused by file and key.

EXAMPLE = """{"format": 1, "image_size": [1280, 1024],
 "left":  {"matrix": [[3200, 0, 640], [0, 3200, 512], [0, 0, 1]], "distortion": [-0.08, 0.05, 0, 0, 0]},
 "right": {"matrix": [[3200, 0, 640], [0, 3200, 512], [0, 0, 1]], "distortion": [-0.08, 0.05, 0, 0, 0]},
 "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [-0.15, 0, 0],
 "reprojection_rms": 0.05, "covariance": null}"""


def full_covariance() -> np.ndarray:
    root = np.random.default_rng(0).normal(size=(24, 24)) * np.logspace(-6, 0, 24)[:, None]
    covariance = root @ root.T
    return (covariance + covariance.T) / 2


def changed(tmp_path: Path, **changes: Any) -> Path:
    path = tmp_path / "top.json"
    path.write_text(json.dumps(json.loads(EXAMPLE) | changes))
    return path


@pytest.mark.parametrize("covariance", [None, full_covariance()], ids=["without", "with"])
def test_what_is_written_comes_back(tmp_path, covariance):
    path, expected = tmp_path / "top.json", replace(RIG, covariance=covariance)
    write_calibration(path, expected, 0.0421)
    found = read_calibration(path)
    for side in ("left", "right"):
        np.testing.assert_array_equal(getattr(found, side).parameters, getattr(expected, side).parameters)
    np.testing.assert_allclose(found.right_from_left.rotation, expected.right_from_left.rotation, atol=1e-15)
    np.testing.assert_array_equal(found.right_from_left.translation_m, expected.right_from_left.translation_m)
    if covariance is None:
        assert found.covariance is None
    else:
        np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert json.loads(path.read_text())["reprojection_rms"] == 0.0421
    assert [entry.name for entry in tmp_path.iterdir()] == ["top.json"]


def test_rational_lenses_with_skew_come_back_whole_and_others_as_files_always_had_them(tmp_path):
    left = Camera.from_parameters(np.append(RIG.left.parameters[:9], [0.2, -0.1, 0.05, 6.0]), SIZE)
    covariance = np.zeros((32, 32))
    covariance[:24, :24], covariance[24, 24], covariance[27, 27] = full_covariance(), 1e-4, 0.25
    rig, path = replace(RIG, left=left, covariance=covariance), tmp_path / "top.json"
    write_calibration(path, rig)
    found, text = read_calibration(path), json.loads(path.read_text())
    np.testing.assert_array_equal(found.left.parameters, left.parameters)
    np.testing.assert_array_equal(found.covariance, rig.covariance)
    assert (len(text["left"]["distortion"]), len(text["right"]["distortion"])) == (8, 5)
    assert text["covariance"]["parameters"][24:] == ["left.k4", "left.skew"]
    points = np.random.default_rng(0).uniform([-0.02, -0.02, 0.48], [0.02, 0.02, 0.52], (1, 20, 3))
    back = triangulate(found, *found.project(points))
    np.testing.assert_allclose(back.position_m, points, atol=1e-12)
    assert back.reprojection_px.max() < 1e-9


def test_parameters_left_out_of_the_covariance_have_none_and_a_rotation_of_few_digits_is_made_exact(tmp_path):
    names = ["translation.x", "left.fx"]
    block = {"parameters": names, "matrix": [[4e-10, 1e-6], [1e-6, 0.25]]}
    covariance = read_calibration(changed(tmp_path, covariance=block)).covariance
    x, fx = (RIG_PARAMETERS.index(name) for name in names)
    expected = np.zeros((32, 32))
    expected[x, x], expected[fx, fx], expected[x, fx], expected[fx, x] = 4e-10, 0.25, 1e-6, 1e-6
    np.testing.assert_array_equal(covariance, expected)
    angle = 0.3
    rotation = np.round([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], 7)
    found = read_calibration(changed(tmp_path, rotation=rotation.tolist())).right_from_left.rotation
    np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(found, rotation, atol=1e-7)


CAMERA = json.loads(EXAMPLE)["left"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 1e-5, 1]]}, "rotation: "),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation: .*reflection"),
        ({"rotation": [[1, 0], [0, 1]]}, r"rotation: .*\(3, 3\)"),
        ({"rotation": [[1, 0, 0], [0, 1], [0, 0, 1]]}, "rotation: "),
        ({"translation": [0.1, 0.2]}, "translation: "),
        ({"translation": [0.1, "0.2", 0]}, "translation: .*'0.2'"),
        ({"translation": [0.1, True, 0]}, "translation: .*True"),
        ({"translation": [0.1, float("nan"), 0]}, "translation: .*nan"),
        ({"translation": [0.1, 10**400, 0]}, "translation: "),
        ({"translation": [0.0, 0.0, 0.0]}, "translation: .*1e-06 .*10000 m"),
        ({"translation": [-151.5e3, 0.0, 0.0]}, "translation: .*151500 m"),
        ({"format": 2}, "format: .*1.*2"),
        ({"image_size": [10**9, 1024]}, r"image_size: .*100000 px.*\[1000000000, 1024\]"),
        ({"left": CAMERA | {"matrix": [[1e-3, 0, 9], [0, 1e-3, 9], [0, 0, 1]]}}, "left.matrix: "),
        ({"right": CAMERA | {"distortion": [-1e9, 0, 0, 0, 0]}}, "right: "),
        ({"right": CAMERA | {"distortion": [1e300, 0, 0, 0, 0]}}, r"right.distortion: .*1e\+12"),
        ({"image_size": [1280.5, 1024]}, "image_size: "),
        ({"image_size": [0, 1024]}, "image_size: "),
        ({"units": "mm"}, "units: "),
        ({"left": CAMERA | {"skew": 0}}, "left.skew: "),
        ({"left": {"matrix": CAMERA["matrix"]}}, "left.distortion: "),
        ({"right": CAMERA | {"distortion": [0, 0, 0, 0]}}, "right.distortion: "),
        ({"right": CAMERA | {"matrix": [[1, 0, 0], [0.5, 1, 0], [0, 0, 1]]}}, "right.matrix: "),
        ({"right": 3}, "right: "),
        ({"reprojection_rms": "good"}, "reprojection_rms: "),
        ({"covariance": [1]}, "covariance: "),
        ({"covariance": {"parameters": [], "matrix": []}}, "covariance.parameters: "),
        ({"covariance": {"parameters": ["left.f"], "matrix": [[1]]}}, "covariance.parameters: .*'left.f'"),
        ({"covariance": {"parameters": ["left.fx"] * 2, "matrix": [[1, 0], [0, 1]]}}, r"covariance\.parameters: "),
        ({"covariance": {"parameters": ["left.fx"], "matrix": [[1, 0]]}}, "covariance.matrix: "),
        ({"covariance": {"parameters": ["left.fx"], "matrix": [[-1]]}}, "covariance: "),
        ({"covariance": {"parameters": ["left.fx", "left.fy"], "matrix": [[1, 2], [2, 1]]}}, "covariance: "),
    ],
)
def test_wrong_content_is_refused_by_file_and_key(tmp_path, changes, message):
    path = changed(tmp_path, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_every_key_is_required_and_an_absent_file_is_not_read(tmp_path):
    content = json.loads(EXAMPLE)
    for key in content:
        (tmp_path / "top.json").write_text(json.dumps({name: value for name, value in content.items() if name != key}))
        refused(f"top.json: {key}: ", read_calibration, tmp_path / "top.json")
    refused(r"absent\.json", read_calibration, tmp_path / "absent.json", error=OSError)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '{"format": 1, "format": 1}', "\x80"])
def test_what_is_no_calibration_text_is_refused_by_file(tmp_path, text):
    (tmp_path / "top.json").write_bytes(text.encode("latin-1"))
    refused(r"top\.json: ", read_calibration, tmp_path / "top.json")


def test_cameras_of_two_sizes_come_back(tmp_path):
    other = replace(RIG, right=replace(RIG.right, size_px=np.array([1200, 900])))
    write_calibration(tmp_path / "top.json", other)
    again = read_calibration(tmp_path / "top.json")
    assert [camera.size_px.tolist() for camera in (again.left, again.right)] == [[1280, 1024], [1200, 900]]
    assert read_camera(tmp_path / "top.json")[0].size_px.tolist() == [1280, 1024]


def _resized(view: TargetView, size: tuple[int, int]) -> TargetView:
    return replace(view, size_px=np.array(size))


def test_pictures_of_two_sizes_belong_to_two_cameras_and_not_to_one():
    """A picture cut at its right and lower edges has the pixels of the whole one."""
    pairs = _session(16, 8)
    whole = calibrate_pair(pairs, TARGET, "flat", lens="polynomial")
    cut = calibrate_pair([(left, _resized(right, (1270, 1020))) for left, right in pairs], TARGET, "flat")
    assert cut.rig.right.size_px.tolist() == [1270, 1020]
    assert np.abs(rig_error(cut.rig, whole.rig)).max() < 0.2 * np.sqrt(np.diagonal(whole.rig.covariance).max())
    left, right = pairs[3]
    odd = calibrate_pair([*pairs[:3], (_resized(left, (1024, 1280)), right), *pairs[4:]], TARGET, "flat")
    assert [(item.name, "1024 x 1280" in item.reason) for item in odd.rejections if not item.points] == [("L3", True)]
    mixed = [(_resized(a, (1270, 1020)), b) if n % 2 else (a, b) for n, (a, b) in enumerate(pairs)]
    refused("L0 .*1280 x 1024 .*L1 .*1270 x 1020 ", calibrate_pair, mixed, TARGET)
