"""A body through a stereo series: rendered truth, frames that fail, the frame that the result is given in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images import ImageSequence
from photogram.measure import BodyMotion, measure_body
from photogram.motion import deformation
from photogram.subsets.track import TrackSettings
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of

PIXEL_M, FOCAL = 2e-4, 1500.0
SENSOR = ImageSensor(12, 8.0, 6.0)
POSES = np.array(
    [
        np.zeros(6),
        [1e-4, -8e-5, 2e-4, 1e-3, -2e-3, 3e-3],
        [-9e-5, 5e-5, -3e-4, -2e-3, 1e-3, 1e-3],
        [4e-5, 9e-5, 1e-4, 1e-3, 2e-3, -2e-3],
    ]
)


@dataclass(frozen=True)
class Scene:
    """A round speckled face before two cameras, 28° apart: rig, body_from_left, and both cameras' images."""

    rig: StereoRig
    body_from_left: RigidTransform
    images: tuple[list[np.ndarray], list[np.ndarray]]

    def sequences(self, frames: tuple[int, ...] = (0, 1, 2, 3)) -> tuple[ImageSequence, ImageSequence]:
        left, right = (sequence([side[k] for k in frames]) for side in self.images)
        return left, right


def sequence(images: list[np.ndarray]) -> ImageSequence:
    height, width = images[0].shape
    names = tuple(f"frame {index}" for index in range(len(images)))
    return ImageSequence(names, (width, height), SENSOR.full_scale, images.__getitem__)


@pytest.fixture(scope="module")
def scene() -> Scene:
    texture = speckle_texture((0.04, 0.04), 5 * PIXEL_M, PIXEL_M / 4, 1.2 * PIXEL_M, np.random.default_rng(31))
    axes = np.eye(3)
    face = Face(np.zeros(3), axes[0], axes[1], np.array([0.019, 0.016]), False, texture, 0.6 * PIXEL_M)
    camera = Camera(np.array([[FOCAL, 0, 120], [0, FOCAL, 100], [0, 0, 1.0]]), np.zeros(5), np.array([240, 200]))
    places = [
        RigidTransform(np.eye(3), np.array([0, 0, FOCAL * PIXEL_M]))
        @ RigidTransform.from_pose(np.array([0, 0, 0, 0, angle, 0]))
        for angle in np.radians([-14.0, 14.0])
    ]
    rng = np.random.default_rng(32)
    images = []
    for place in places:
        view = view_of(camera, place)
        images.append([SENSOR.digitise(render(view, face, pose[None], np.ones(1)), rng) for pose in POSES])
    rig = StereoRig(camera, camera, places[1] @ places[0].inverse())
    return Scene(rig, places[0].inverse(), (images[0], images[1]))


@pytest.fixture(scope="module")
def body(scene: Scene) -> BodyMotion:
    return measure_body(scene.sequences(), scene.rig, scene.body_from_left, TrackSettings(radius_px=8, degree=7))


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
    assert body.noise is not None
    assert body.quality is not None
    for model in body.noise:
        np.testing.assert_allclose(model.variance(1500.0), SENSOR.variance(np.array(1500.0)), rtol=0.05)
    for side, tracks in zip(body.quality, (body.tracks.left, body.tracks.right), strict=True):
        found = np.sqrt(np.nanmedian(np.diagonal(tracks.covariance_px2, axis1=2, axis2=3)))
        assert np.median(side.predicted_sigma_px) == pytest.approx(found, rel=0.1)


def test_nothing_remains_beside_the_rigid_motion(body: BodyMotion) -> None:
    beside = deformation(body.points, body.motion)
    squares = np.einsum("fni,fnij,fnj->fn", beside.residual_m, np.linalg.inv(beside.covariance_m2), beside.residual_m)
    assert np.nanmean(squares[1:]) / 3 == pytest.approx(1.0, abs=0.2)


def test_a_dark_frame_is_lost_alone(scene: Scene, body: BodyMotion) -> None:
    """The lamp fails in one frame: no motion there, the others keep theirs, and the user hears of it."""
    dark = [np.full_like(scene.images[0][0], 60), np.full_like(scene.images[0][0], 60)]
    left, right = ([side[0], side[1], black, side[3]] for side, black in zip(scene.images, dark, strict=True))
    found = measure_body(
        (sequence(left), sequence(right)), scene.rig, scene.body_from_left, TrackSettings(radius_px=8, degree=7)
    )
    assert np.isnan(found.motion.pose[2]).all()
    assert found.motion.points[2] == 0
    np.testing.assert_allclose(found.motion.pose[1], body.motion.pose[1], atol=1e-12)
    u = np.sqrt(np.diagonal(body.motion.covariance[3]))
    assert np.all(np.abs(found.motion.pose[3] - body.motion.pose[3]) < 0.2 * u)
    assert any("in 1 of 3 frames the motion could not be fitted" in notice.text for notice in found.notices)


def test_noise_is_found_in_the_first_frame_that_can_be_fitted(scene: Scene) -> None:
    dark = np.full_like(scene.images[0][0], 60)
    left, right = ([side[0], dark, side[1]] for side in scene.images)
    found = measure_body(
        (sequence(left), sequence(right)), scene.rig, scene.body_from_left, TrackSettings(radius_px=8, degree=7)
    )
    assert found.noise is not None
    assert np.isfinite(found.motion.pose[2]).all()


def test_motion_is_given_in_the_frame_asked_for(scene: Scene, body: BodyMotion) -> None:
    """The same motion about the left camera's centre, in its axes: x' = M·T·M⁻¹ with M = left_from_body."""
    settings = TrackSettings(radius_px=8, degree=7)
    there = measure_body(scene.sequences(), scene.rig, RigidTransform.identity(), settings)
    left_from_body = scene.body_from_left.inverse()
    for pose, expected in zip(there.motion.pose[1:], body.motion.pose[1:], strict=True):
        carried = left_from_body @ RigidTransform.from_pose(expected) @ scene.body_from_left
        np.testing.assert_allclose(pose[:3], carried.pose[:3], atol=2e-8)
        np.testing.assert_allclose(pose[3:], carried.pose[3:], atol=2e-7)


def test_a_rig_that_places_nothing_is_refused(scene: Scene) -> None:
    """The right camera turned round: no point lies before both cameras."""
    turned = StereoRig(scene.rig.left, scene.rig.right, RigidTransform.from_pose(np.array([-0.1, 0, 0, 0, 3.0, 0])))
    with pytest.raises(ValueError, match=r"rig: expected at least 3 points .* the calibration does not belong"):
        measure_body(scene.sequences(), turned, scene.body_from_left, TrackSettings(radius_px=8))
