"""Whole tracks of an analytic scene: a textured disc before a plain background, two cameras 30° apart."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images import ImageSequence
from photogram.subsets.reference import TrackStatus
from photogram.subsets.search import predict_warp
from photogram.subsets.track import (
    TrackSettings,
    follow_sequence,
    match_stereo,
    prepare_sequence,
    track_sequence,
    track_stereo,
)

SIZE = (320, 256)
FOCAL, DISTANCE_M, PIXEL_M = 1500.0, 0.5, 0.5 / 1500.0
DISC_M = 0.034


def sequence(images: list[np.ndarray], full_scale: int = 4095) -> ImageSequence:
    names = tuple(f"frame {index}" for index in range(len(images)))
    height, width = images[0].shape
    return ImageSequence(names, (width, height), full_scale, images.__getitem__)


def stereo_rig(angle_deg: float) -> StereoRig:
    """Two cameras that look at the origin of the plane z = 0.5 m from both sides."""
    camera = Camera(np.array([[FOCAL, 0, 160], [0, FOCAL, 128], [0, 0, 1.0]]), np.zeros(5), np.array(SIZE))
    turn = RigidTransform.from_pose(np.array([0, 0, 0, 0, np.radians(angle_deg), 0]))
    pivot = np.array([0, 0, DISTANCE_M])
    return StereoRig(camera, camera, RigidTransform(turn.rotation, pivot - turn.rotation @ pivot))


def on_plane(camera_from_left: RigidTransform, pixels: np.ndarray) -> np.ndarray:
    """Points (M,2) in metres of the plane z = 0.5 m in the left frame, seen at the pixels (M,2) of a camera."""
    rays = np.column_stack([(pixels - [160, 128]) / FOCAL, np.ones(len(pixels))]) @ camera_from_left.rotation
    centre = -camera_from_left.rotation.T @ camera_from_left.translation_m
    return (centre + rays * ((DISTANCE_M - centre[2]) / rays[:, 2])[:, None])[:, :2]


def scene(texture, camera_from_left: RigidTransform, shift_m=(0.0, 0.0), seed=0, noise=6.0) -> np.ndarray:  # type: ignore[no-untyped-def]
    """A disc with speckle of about 4 px before a plain background, 12 bit."""
    points = on_plane(camera_from_left, np.indices(SIZE[::-1])[::-1].reshape(2, -1).T.astype(float)) - np.asarray(
        shift_m
    )
    disc = 1.0 / (1.0 + np.exp((np.hypot(*points.T) - DISC_M) / (0.4 * PIXEL_M)))
    speckle = np.concatenate([texture(part) for part in np.array_split(points / PIXEL_M, 64)])
    clean = 300 + disc * (1500 + 400 * speckle)
    noisy = clean.reshape(SIZE[::-1]) + np.random.default_rng(seed).normal(0, noise, SIZE[::-1])
    return np.clip(np.round(noisy), 0, 4095).astype(np.uint16)


@pytest.fixture(scope="module")
def texture(make_texture):  # type: ignore[no-untyped-def]
    return make_texture(seed=21, s=1.3, waves=60)


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return stereo_rig(30.0)


@pytest.fixture(scope="module")
def pair(texture, rig: StereoRig) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    return scene(texture, RigidTransform.identity(), seed=1), scene(texture, rig.right_from_left, seed=2)


def true_right(rig: StereoRig, left_px: np.ndarray, shift_m=(0.0, 0.0)) -> np.ndarray:  # type: ignore[no-untyped-def]
    plane = on_plane(RigidTransform.identity(), left_px) + np.asarray(shift_m)
    return rig.project(np.column_stack([plane, np.full(len(plane), DISTANCE_M)]))[1]


def test_two_views_thirty_degrees_apart_need_no_start(pair, rig: StereoRig) -> None:  # type: ignore[no-untyped-def]
    grid = np.stack(np.meshgrid(np.arange(100.0, 221, 24), np.arange(70.0, 190, 24)), axis=-1).reshape(-1, 2)
    tracks = match_stereo(*pair, grid, TrackSettings())
    assert np.mean(tracks.status == TrackStatus.OK) == 1.0
    error = tracks.position_px[0] - true_right(rig, grid)
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.all(tracks.zncc > 0.95)


def test_the_path_of_a_stereo_pair(texture, pair, rig: StereoRig) -> None:  # type: ignore[no-untyped-def]
    shifts = PIXEL_M * 1.5 * np.column_stack([np.sin(np.arange(6.0)), np.cos(np.arange(6.0)) - 1])
    frames = [
        [scene(texture, view, shift, seed=10 * k + side) for k, shift in enumerate(shifts)]
        for side, view in enumerate((RigidTransform.identity(), rig.right_from_left), start=1)
    ]
    calls: list[int] = []
    tracks = track_stereo(sequence(frames[0]), sequence(frames[1]), rig, TrackSettings(), calls.append)
    assert calls == list(range(1, 13))
    assert tracks.notices == ()
    points = tracks.left.position_px[0]
    radius = np.hypot(*(points - [160, 128]).T)
    assert np.all(radius < DISC_M / PIXEL_M)
    covered = len(points) * 21**2 / (np.pi * (DISC_M / PIXEL_M) ** 2)
    assert covered > 0.6
    assert np.all(tracks.left.status == TrackStatus.OK)
    assert np.all(tracks.right.status == TrackStatus.OK)
    moved = (tracks.left.position_px - points)[1:] - shifts[1:, None] / PIXEL_M
    stated = np.sqrt(tracks.left.covariance_px2[1:, :, [0, 1], [0, 1]])
    assert np.abs(moved.mean(axis=1)).max() < 2e-3
    assert np.sqrt(np.mean((moved / stated) ** 2)) < 1.8
    np.testing.assert_allclose(tracks.noise_grey, 6.0, rtol=0.05)
    for k, shift in enumerate(shifts):
        error = tracks.right.position_px[k] - true_right(rig, points, shift)
        assert np.abs(error - (tracks.right.position_px[0] - true_right(rig, points))).max() < 0.03


def test_a_wrong_calibration_is_said(pair, rig: StereoRig) -> None:  # type: ignore[no-untyped-def]
    tilt = RigidTransform.from_pose(np.array([0, 0, 0, 0.004, 0, 0]))
    wrong = StereoRig(rig.left, rig.right, tilt @ rig.right_from_left)
    tracks = track_stereo(sequence([pair[0]] * 2), sequence([pair[1]] * 2), wrong, TrackSettings())
    assert any("epipolar" in notice.text and notice.where == "stereo calibration" for notice in tracks.notices)


def test_speckle_finer_than_the_pixels_is_said(make_texture) -> None:  # type: ignore[no-untyped-def]
    image = 2000 + 400 * make_texture(seed=25, s=0.55, waves=100).image((160, 120))
    frames = [np.round(image + np.random.default_rng(k).normal(0, 6, image.shape)).astype(np.uint16) for k in range(3)]
    tracks = track_stereo(sequence(frames), sequence(frames[::-1]), None, TrackSettings())
    warnings = [notice for notice in tracks.notices if "false harmonics" in notice.text]
    assert [notice.where for notice in warnings] == ["left camera", "right camera"]
    assert np.all(tracks.speckle_px < 3.0)


def test_jumps_of_many_pixels_are_found_again(make_texture) -> None:  # type: ignore[no-untyped-def]
    texture = make_texture(seed=22, s=1.3, waves=60)
    jumps = np.array([[0, 0], [9.3, -4.2], [-8.6, 9.7], [0.2, 0.1]])
    frames = [
        np.round(2000 + 400 * texture.image((140, 130), lambda p, s=jump: p - s)).astype(np.uint16) for jump in jumps
    ]
    points = np.array([[45.0, 45.0], [70.0, 60.0], [95.0, 80.0], [60.3, 85.7]])
    tracks = track_sequence(sequence(frames), points, TrackSettings())
    assert np.all(tracks.status == TrackStatus.OK)
    np.testing.assert_allclose(tracks.position_px - points, np.broadcast_to(jumps[:, None], (4, 4, 2)), atol=5e-3)


def test_saturated_absent_and_leaving_subsets_are_told_apart(make_texture) -> None:  # type: ignore[no-untyped-def]
    texture = make_texture(seed=23, s=1.3, waves=60)
    frames = [
        np.round(2000 + 400 * texture.image((120, 90), lambda p, s=shift: p - [s, 0])).astype(np.uint16)
        for shift in (0, 2, 4)
    ]
    for frame in frames:
        frame[55:70, 60:80] = 4095
    points = np.array([[40.0, 30.0], [68.0, 62.0], [np.nan, np.nan], [106.0, 30.0]])
    tracks = track_sequence(sequence(frames), points, TrackSettings())
    assert tracks.status[:, 0].tolist() == [TrackStatus.OK] * 3
    assert tracks.status[:, 1].tolist() == [TrackStatus.SATURATED] * 3
    assert tracks.status[:, 2].tolist() == [TrackStatus.NO_START] * 3
    assert tracks.status[:, 3].tolist() == [TrackStatus.OK, TrackStatus.OK, TrackStatus.LEFT_IMAGE]
    lost = tracks.status != TrackStatus.OK
    assert np.isnan(tracks.position_px[lost]).all()
    assert np.isnan(tracks.covariance_px2[lost]).all()
    assert np.isnan(tracks.zncc[lost]).all()


def test_frames_are_read_one_by_one(make_texture) -> None:  # type: ignore[no-untyped-def]
    frame = np.round(2000 + 400 * make_texture(seed=24).image((60, 60))).astype(np.uint16)
    order: list[int] = []

    def read(index: int) -> np.ndarray:
        order.append(index)
        return frame

    track_sequence(ImageSequence(("a",) * 4, (60, 60), 4095, read), np.array([[30.0, 30.0]]), TrackSettings())
    assert order == [0, 0, 1, 2, 3]  # the first once for the reference


def test_frames_in_batches_lead_to_the_same_tracks(make_texture) -> None:  # type: ignore[no-untyped-def]
    """The engine for a GPU, here on torch's CPU device, in place of the compiled one; one frame is blank."""
    texture, rng = make_texture(seed=25), np.random.default_rng(25)
    images = [
        np.round(2000 + 400 * texture.image((70, 60), lambda p, k=k: p - [0.3 * k, -0.2 * k])).astype(np.int64)
        for k in range(5)
    ]
    images = [(image + np.round(rng.normal(0, 5, image.shape)).astype(np.int64)).astype(np.uint16) for image in images]
    images[3][:] = 4095
    frames, settings = sequence(images), TrackSettings(radius_px=8)
    reference = prepare_sequence(frames, np.array([[25.0, 30.0], [42.0, 30.0]]), settings)
    here = [frame.found for frame in follow_sequence(frames, reference, settings)]
    batched = [frame.found for frame in follow_sequence(frames, reference, settings, device="cpu:0")]
    assert len(here) == len(batched) == 5
    for one, other in zip(here, batched, strict=True):
        assert np.array_equal(one.status == TrackStatus.OK, other.status == TrackStatus.OK)
        np.testing.assert_allclose(one.warp, other.warp, atol=1e-4)


@pytest.mark.parametrize("step", [0.1, 1.2, 2.9])
def test_a_vibration_sampled_too_slowly_is_foretold(step: float) -> None:
    """Sines of any phase step from frame to frame, about any mean, obey the recursion exactly."""
    frames = np.arange(8)
    warps = np.zeros((8, 5, 6))
    warps[:, :, 0] = 3.0 + np.outer(np.sin(step * frames + 0.3), np.arange(1.0, 6.0))
    warps[:, :, 3] = np.outer(np.cos(step * frames), np.arange(5.0))
    np.testing.assert_allclose(predict_warp(list(warps[:7])), warps[7], atol=1e-9)


def test_wrong_pairs_are_named(pair, rig: StereoRig) -> None:  # type: ignore[no-untyped-def]
    blank = np.full(SIZE[::-1], 100, np.uint16)
    blank += np.random.default_rng(3).integers(0, 5, blank.shape, dtype=np.uint16)
    run = partial(track_stereo, rig=rig, settings=TrackSettings())
    with pytest.raises(ValueError, match="right: expected 2 frames as in left, found 1"):
        run(sequence([pair[0]] * 2), sequence([pair[1]]))
    with pytest.raises(ValueError, match="right: expected the body of frame 0"):
        run(sequence([pair[0]]), sequence([blank]))
    with pytest.raises(ValueError, match="radius_px: expected at least 3"):
        TrackSettings(radius_px=2)


def test_readers_and_tracks_meet(tmp_path: Path, pair) -> None:  # type: ignore[no-untyped-def]
    import tifffile

    from photogram.images import open_sequence

    paths = [tmp_path / f"{k}.tif" for k in range(2)]
    for path in paths:
        tifffile.imwrite(path, pair[0])
    tracks = track_sequence(open_sequence(paths, 12), np.array([[160.0, 128.0]]), TrackSettings())
    np.testing.assert_allclose(tracks.position_px[1], [[160, 128]], atol=1e-9)
