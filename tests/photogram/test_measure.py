"""A body through a stereo series: rendered truth, frames that fail, the frame that the result is given in."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from photogram import measure
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images import ImageSequence
from photogram.measure import BodyMotion, body_motion, follow_block, measure_body, prepare_body
from photogram.motion import deformation
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import TrackSettings, follow_sequence, prepare_sequence
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of

PIXEL_M, FOCAL = 2e-4, 1500.0
SENSOR = ImageSensor(12, 8.0, 6.0)
SEPTIC = TrackSettings(radius_px=8, degree=7)
POSES = np.array(
    [
        np.zeros(6),
        [1e-4, -8e-5, 2e-4, 1e-3, -2e-3, 3e-3],
        [-9e-5, 5e-5, -3e-4, -2e-3, 1e-3, 1e-3],
        [4e-5, 9e-5, 1e-4, 1e-3, 2e-3, -2e-3],
    ]
)


Stereo = tuple[tuple[ImageSequence, ImageSequence], StereoRig, RigidTransform]


def rendered(poses: np.ndarray, half_m: tuple[float, float], middle: tuple[int, int], seed: int) -> Stereo:
    """A speckled face before two cameras, 28° apart: both cameras' images, rig, body_from_left."""
    texture = speckle_texture((0.04, 0.04), 5 * PIXEL_M, PIXEL_M / 4, 1.2 * PIXEL_M, np.random.default_rng(seed))
    face = Face(np.zeros(3), np.eye(3)[0], np.eye(3)[1], np.array(half_m), False, texture, 0.6 * PIXEL_M)
    matrix = np.array([[FOCAL, 0, middle[0]], [0, FOCAL, middle[1]], [0, 0, 1.0]])
    camera, rng = Camera(matrix, np.zeros(5), 2 * np.array(middle)), np.random.default_rng(seed + 1)
    places = [
        RigidTransform(np.eye(3), np.array([0, 0, FOCAL * PIXEL_M]))
        @ RigidTransform.from_pose(np.array([0, 0, 0, 0, angle, 0]))
        for angle in np.radians([-14.0, 14.0])
    ]
    left, right = (
        sequence([SENSOR.digitise(render(view_of(camera, place), face, pose[None], np.ones(1)), rng) for pose in poses])
        for place in places
    )
    return (left, right), StereoRig(camera, camera, places[1] @ places[0].inverse()), places[0].inverse()


def sequence(images: list[np.ndarray]) -> ImageSequence:
    height, width = images[0].shape
    names = tuple(f"frame {index}" for index in range(len(images)))
    return ImageSequence(names, (width, height), SENSOR.full_scale, partial(_frame, images))


def _frame(images: list[np.ndarray], index: int) -> np.ndarray:
    return images[index]


def chosen(images: ImageSequence, *frames: int | None) -> ImageSequence:
    """Some frames of a sequence, None for a dark one."""
    dark = np.full_like(images.read(0), 60)
    return sequence([dark if frame is None else images.read(frame) for frame in frames])


@pytest.fixture(scope="module")
def scene() -> Stereo:
    return rendered(POSES, (0.019, 0.016), (120, 100), 31)


@pytest.fixture(scope="module")
def body(scene: Stereo) -> BodyMotion:
    return measure_body(*scene, SEPTIC)


def normalised(body: BodyMotion, which: str) -> np.ndarray:
    """Errors (F−1,6) over √2 standard uncertainties: the reference has noise of its own."""
    motion = getattr(body, which)
    u = np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
    return ((motion.pose - POSES) / (np.sqrt(2.0) * u))[1:]


def test_both_motions_are_the_true_one_within_their_uncertainty(body: BodyMotion) -> None:
    for which in ("motion", "motion_of_points"):
        assert np.max(np.abs(normalised(body, which))) < 4.0
        np.testing.assert_allclose(getattr(body, which).pose[0], 0.0, atol=1e-15)
    direct, points = (np.diagonal(getattr(body, w).covariance[1]) for w in ("motion", "motion_of_points"))
    assert np.all(direct < points)
    assert np.all(direct > 0.4 * points)
    np.testing.assert_allclose(np.diagonal(body.motion.covariance[0]), direct, rtol=0.1)
    assert body.notices == ()


def test_noise_and_quality_are_those_of_the_images(body: BodyMotion) -> None:
    for model in body.noise:
        np.testing.assert_allclose(model.variance(1500.0), SENSOR.variance(np.array(1500.0)), rtol=0.05)
    for side, tracks in zip(body.quality, (body.tracks.left, body.tracks.right), strict=True):
        found = np.sqrt(np.nanmedian(np.diagonal(tracks.covariance_px2, axis1=2, axis2=3)))
        assert np.median(side.predicted_sigma_px) == pytest.approx(found, rel=0.1)


def test_nothing_remains_beside_the_rigid_motion(body: BodyMotion) -> None:
    beside = deformation(body.points, body.motion)
    squares = np.einsum("fni,fnij,fnj->fn", beside.residual_m, np.linalg.inv(beside.covariance_m2), beside.residual_m)
    assert np.nanmean(squares[1:]) / 3 == pytest.approx(1.0, abs=0.2)


def test_a_dark_frame_is_lost_alone(scene: Stereo, body: BodyMotion) -> None:
    """The lamp fails in one frame: no motion there, the others keep theirs, and the user hears of it."""
    (left, right), *others = scene
    found = measure_body((chosen(left, 0, 1, None, 3), chosen(right, 0, 1, None, 3)), *others, SEPTIC)
    assert np.isnan(found.motion.pose[2]).all()
    assert found.motion.points[2] == 0
    np.testing.assert_allclose(found.motion.pose[1], body.motion.pose[1], atol=1e-12)
    u = np.sqrt(np.diagonal(body.motion.covariance[3]))
    assert np.all(np.abs(found.motion.pose[3] - body.motion.pose[3]) < 0.2 * u)
    assert any("in 1 of 3 frames the motion could not be fitted" in notice.text for notice in found.notices)


def test_noise_is_found_in_the_first_frame_that_can_be_fitted(scene: Stereo) -> None:
    (left, right), *others = scene
    found = measure_body((chosen(left, 0, None, 1), chosen(right, 0, None, 1)), *others, SEPTIC)
    assert np.isfinite(found.motion.pose[2]).all()


def test_motion_is_given_in_the_frame_asked_for(scene: Stereo, body: BodyMotion) -> None:
    """The same motion about the left camera's centre, in its axes: x' = M·T·M⁻¹ with M = left_from_body."""
    images, rig, body_from_left = scene
    there = measure_body(images, rig, RigidTransform.identity(), SEPTIC)
    left_from_body = body_from_left.inverse()
    for pose, expected in zip(there.motion.pose[1:], body.motion.pose[1:], strict=True):
        carried = left_from_body @ RigidTransform.from_pose(expected) @ body_from_left
        np.testing.assert_allclose(pose[:3], carried.pose[:3], atol=2e-8)
        np.testing.assert_allclose(pose[3:], carried.pose[3:], atol=2e-7)


def test_a_rig_that_places_nothing_is_refused(scene: Stereo) -> None:
    """The right camera turned round: no point lies before both cameras."""
    images, rig, body_from_left = scene
    turned = StereoRig(rig.left, rig.right, RigidTransform.from_pose(np.array([-0.1, 0, 0, 0, 3.0, 0])))
    with pytest.raises(ValueError, match=r"rig: expected at least 3 points .* the calibration does not belong"):
        measure_body(images, turned, body_from_left, TrackSettings(radius_px=8))


# A series in blocks: each found from the reference alone, the same motion whoever follows which of them.

BLOCK = 3
SETTINGS = TrackSettings(radius_px=8, degree=5)
SWING = np.array([6e-4, 9e-4, 2e-4, 2e-3, -2e-3, 3e-3])  # 3 to 5 px, about the speckle size
BLOCK_POSES = np.sin(2.1 * np.arange(8))[:, None] * SWING


@pytest.fixture(scope="module")
def series() -> tuple[object, ...]:
    """What `measure_body` takes: a body that swings."""
    return (*rendered(BLOCK_POSES, (0.015, 0.013), (100, 90), 41), SETTINGS)


@pytest.fixture
def measured(series, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], BodyMotion]:
    """The motion by blocks of so many frames."""

    def measured(length: int) -> BodyMotion:
        monkeypatch.setattr(measure, "BLOCK_FRAMES", length)
        return measure_body(*series)

    return measured


def test_where_blocks_begin_is_below_all_noise(measured: Callable[[int], BodyMotion]) -> None:
    whole, parts = measured(32), measured(BLOCK)
    for side in ("left", "right"):
        one, other = getattr(whole.tracks, side), getattr(parts.tracks, side)
        assert np.array_equal(one.status, other.status)
        assert np.all(one.status == TrackStatus.OK)
        difference = one.position_px - other.position_px
        assert np.sqrt(np.mean(difference**2)) < 1e-4
        assert np.max(np.abs(difference)) < 2e-3  # a twentieth of a standard uncertainty may be left of a step
    u = np.sqrt(np.diagonal(whole.motion.covariance, axis1=1, axis2=2))
    assert np.max(np.abs(whole.motion.pose - parts.motion.pose)[1:] / u[1:]) < 0.05
    assert np.max(np.abs(whole.motion.pose - BLOCK_POSES)[1:] / u[1:]) < 6.0


def test_blocks_can_be_followed_elsewhere_and_in_any_order(series, measured: Callable[[int], BodyMotion]) -> None:
    """What has been to another process gives the same bits."""
    whole = measured(BLOCK)
    prepared = pickle.loads(pickle.dumps(prepare_body(*series)))
    assert prepared.blocks == (range(2, 5), range(5, 8))
    followed = {frames: pickle.loads(pickle.dumps(follow_block(prepared, frames))) for frames in prepared.blocks[::-1]}
    again = body_motion(prepared, [followed[frames] for frames in prepared.blocks])
    for name in ("pose", "covariance", "residual_m"):
        assert getattr(whole.motion, name).tobytes() == getattr(again.motion, name).tobytes()
    assert whole.tracks.left.position_px.tobytes() == again.tracks.left.position_px.tobytes()
    assert whole.notices == again.notices


@pytest.mark.parametrize("frames", [2, 3])
def test_a_series_shorter_than_a_block(series, frames: int) -> None:
    (left, right), *others = series
    told: list[int] = []
    body = measure_body((chosen(left, *range(frames)), chosen(right, *range(frames))), *others, told.append)
    assert told == [2 * done for done in range(1, frames + 1)]
    assert len(body.motion.pose) == frames
    assert np.isfinite(body.motion.pose).all()


def test_a_body_that_has_moved_by_a_speckle_is_found_at_its_own_place(series) -> None:
    """From a start at rest, subsets settle beside the place where they belong, and correlate well enough."""
    (left, _), *_ = series
    points = np.stack(np.meshgrid(np.arange(40.0, 160, 20), np.arange(40.0, 140, 20)), axis=-1).reshape(-1, 2)
    reference = prepare_sequence(left, points, SETTINGS)
    (found,) = (frame.found for frame in follow_sequence(left, reference, SETTINGS, frames=range(3, 4)))
    through = [frame.found for frame in follow_sequence(left, reference, SETTINGS, frames=range(1, 4))][-1]
    seen = (found.status == TrackStatus.OK) & (through.status == TrackStatus.OK)
    assert np.sum(seen) > 10
    moved = found.warp[seen][:, [0, 3]]
    assert np.max(np.abs(moved - np.median(moved, axis=0))) < 0.5
    np.testing.assert_allclose(found.warp[seen], through.warp[seen], atol=2e-3)
