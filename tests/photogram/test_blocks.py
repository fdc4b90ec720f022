"""A series in blocks: each found from the reference alone, the same motion whoever follows which of them."""

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
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import TrackSettings, follow_sequence, prepare_sequence
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of

PIXEL_M, FOCAL, BLOCK = 2e-4, 1500.0, 3
SENSOR = ImageSensor(12, 8.0, 6.0)
SETTINGS = TrackSettings(radius_px=8, degree=5)
SWING = np.array([6e-4, 9e-4, 2e-4, 2e-3, -2e-3, 3e-3])  # 3 to 5 px, about the speckle size
POSES = np.sin(2.1 * np.arange(8))[:, None] * SWING


def _frame(images: list[np.ndarray], index: int) -> np.ndarray:
    return images[index]


def _sequence(images: list[np.ndarray]) -> ImageSequence:
    height, width = images[0].shape
    names = tuple(f"frame {index}" for index in range(len(images)))
    return ImageSequence(names, (width, height), SENSOR.full_scale, partial(_frame, images))


@pytest.fixture(scope="module")
def scene() -> tuple[tuple[ImageSequence, ImageSequence], StereoRig, RigidTransform, TrackSettings]:
    """What `measure_body` takes: a speckled face that swings before two cameras."""
    texture = speckle_texture((0.04, 0.04), 5 * PIXEL_M, PIXEL_M / 4, 1.2 * PIXEL_M, np.random.default_rng(41))
    axes, rng = np.eye(3), np.random.default_rng(42)
    face = Face(np.zeros(3), axes[0], axes[1], np.array([0.015, 0.013]), False, texture, 0.6 * PIXEL_M)
    camera = Camera(np.array([[FOCAL, 0, 100], [0, FOCAL, 90], [0, 0, 1.0]]), np.zeros(5), np.array([200, 180]))
    places = [
        RigidTransform(np.eye(3), np.array([0, 0, FOCAL * PIXEL_M]))
        @ RigidTransform.from_pose(np.array([0, 0, 0, 0, angle, 0]))
        for angle in np.radians([-14.0, 14.0])
    ]
    left, right = (
        _sequence([SENSOR.digitise(render(view_of(camera, p), face, pose[None], np.ones(1)), rng) for pose in POSES])
        for p in places
    )
    return (left, right), StereoRig(camera, camera, places[1] @ places[0].inverse()), places[0].inverse(), SETTINGS


@pytest.fixture
def measured(scene, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], BodyMotion]:  # type: ignore[no-untyped-def]
    """The motion by blocks of so many frames."""

    def measured(length: int) -> BodyMotion:
        monkeypatch.setattr(measure, "BLOCK_FRAMES", length)
        return measure_body(*scene)

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
    assert np.max(np.abs(whole.motion.pose - POSES)[1:] / u[1:]) < 6.0


def test_blocks_can_be_followed_elsewhere_and_in_any_order(  # type: ignore[no-untyped-def]
    scene, measured: Callable[[int], BodyMotion]
) -> None:
    """What has been to another process gives the same bits."""
    whole = measured(BLOCK)
    prepared = pickle.loads(pickle.dumps(prepare_body(*scene)))
    assert prepared.blocks == (range(2, 5), range(5, 8))
    followed = {frames: pickle.loads(pickle.dumps(follow_block(prepared, frames))) for frames in prepared.blocks[::-1]}
    again = body_motion(prepared, [followed[frames] for frames in prepared.blocks])
    for name in ("pose", "covariance", "residual_m"):
        assert getattr(whole.motion, name).tobytes() == getattr(again.motion, name).tobytes()
    assert whole.tracks.left.position_px.tobytes() == again.tracks.left.position_px.tobytes()
    assert whole.notices == again.notices


@pytest.mark.parametrize("frames", [2, 3])
def test_a_series_shorter_than_a_block(scene, frames: int) -> None:  # type: ignore[no-untyped-def]
    (left, right), *others = scene
    told: list[int] = []
    short = (_sequence([side.read(k) for k in range(frames)]) for side in (left, right))
    body = measure_body(tuple(short), *others, told.append)
    assert told == [2 * done for done in range(1, frames + 1)]
    assert len(body.motion.pose) == frames
    assert np.isfinite(body.motion.pose).all()


def test_a_body_that_has_moved_by_a_speckle_is_found_at_its_own_place(scene) -> None:  # type: ignore[no-untyped-def]
    """From a start at rest, subsets settle beside the place where they belong, and correlate well enough."""
    (left, _), *_ = scene
    points = np.stack(np.meshgrid(np.arange(40.0, 160, 20), np.arange(40.0, 140, 20)), axis=-1).reshape(-1, 2)
    reference = prepare_sequence(left, points, SETTINGS)
    (found,) = (frame.found for frame in follow_sequence(left, reference, SETTINGS, frames=range(3, 4)))
    through = [frame.found for frame in follow_sequence(left, reference, SETTINGS, frames=range(1, 4))][-1]
    seen = (found.status == TrackStatus.OK) & (through.status == TrackStatus.OK)
    assert np.sum(seen) > 10
    moved = found.warp[seen][:, [0, 3]]
    assert np.max(np.abs(moved - np.median(moved, axis=0))) < 0.5
    np.testing.assert_allclose(found.warp[seen], through.warp[seen], atol=2e-3)
