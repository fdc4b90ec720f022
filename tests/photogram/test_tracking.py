"""Whole tracks of an analytic scene: a textured disc before a plain background, two cameras 30° apart."""

from __future__ import annotations

import gc
import tracemalloc
import weakref
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images import ImageSequence, open_sequence
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


def scene(texture, camera_from_left: RigidTransform, shift_m=(0.0, 0.0), seed=0, noise=6.0) -> np.ndarray:
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
def texture(make_texture):
    return make_texture(seed=21, s=1.3, waves=60)


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return stereo_rig(30.0)


@pytest.fixture(scope="module")
def pair(texture, rig: StereoRig) -> tuple[np.ndarray, np.ndarray]:
    return scene(texture, RigidTransform.identity(), seed=1), scene(texture, rig.right_from_left, seed=2)


def true_right(rig: StereoRig, left_px: np.ndarray, shift_m=(0.0, 0.0)) -> np.ndarray:
    plane = on_plane(RigidTransform.identity(), left_px) + np.asarray(shift_m)
    return rig.project(np.column_stack([plane, np.full(len(plane), DISTANCE_M)]))[1]


def test_two_views_thirty_degrees_apart_need_no_start(pair, rig: StereoRig) -> None:
    grid = np.stack(np.meshgrid(np.arange(100.0, 221, 24), np.arange(70.0, 190, 24)), axis=-1).reshape(-1, 2)
    tracks = match_stereo(*pair, grid, TrackSettings())
    assert np.mean(tracks.status == TrackStatus.OK) == 1.0
    error = tracks.position_px[0] - true_right(rig, grid)
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.all(tracks.zncc > 0.95)


def test_the_path_of_a_stereo_pair(texture, pair, rig: StereoRig) -> None:
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


def test_a_wrong_calibration_is_said(pair, rig: StereoRig) -> None:
    tilt = RigidTransform.from_pose(np.array([0, 0, 0, 0.004, 0, 0]))
    wrong = StereoRig(rig.left, rig.right, tilt @ rig.right_from_left)
    tracks = track_stereo(sequence([pair[0]] * 2), sequence([pair[1]] * 2), wrong, TrackSettings())
    assert any("epipolar" in notice.text and notice.where == "stereo calibration" for notice in tracks.notices)


def test_speckle_finer_than_the_pixels_is_said(make_texture) -> None:
    image = 2000 + 400 * make_texture(seed=25, s=0.55, waves=100).image((160, 120))
    frames = [np.round(image + np.random.default_rng(k).normal(0, 6, image.shape)).astype(np.uint16) for k in range(3)]
    tracks = track_stereo(sequence(frames), sequence(frames[::-1]), None, TrackSettings())
    warnings = [notice for notice in tracks.notices if "false harmonics" in notice.text]
    assert [notice.where for notice in warnings] == ["left camera", "right camera"]
    assert np.all(tracks.speckle_px < 3.0)


def test_jumps_of_many_pixels_are_found_again(make_texture) -> None:
    texture = make_texture(seed=22, s=1.3, waves=60)
    jumps = np.array([[0, 0], [9.3, -4.2], [-8.6, 9.7], [0.2, 0.1]])
    frames = [
        np.round(2000 + 400 * texture.image((140, 130), lambda p, s=jump: p - s)).astype(np.uint16) for jump in jumps
    ]
    points = np.array([[45.0, 45.0], [70.0, 60.0], [95.0, 80.0], [60.3, 85.7]])
    tracks = track_sequence(sequence(frames), points, TrackSettings())
    assert np.all(tracks.status == TrackStatus.OK)
    np.testing.assert_allclose(tracks.position_px - points, np.broadcast_to(jumps[:, None], (4, 4, 2)), atol=5e-3)


def test_saturated_absent_and_leaving_subsets_are_told_apart(make_texture) -> None:
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


def test_frames_in_batches_lead_to_the_same_tracks(make_texture) -> None:
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


def test_wrong_pairs_are_named(pair, rig: StereoRig) -> None:
    blank = np.full(SIZE[::-1], 100, np.uint16)
    blank += np.random.default_rng(3).integers(0, 5, blank.shape, dtype=np.uint16)
    run = partial(track_stereo, rig=rig, settings=TrackSettings())
    with pytest.raises(ValueError, match="right: expected 2 frames as in left, found 1"):
        run(sequence([pair[0]] * 2), sequence([pair[1]]))
    with pytest.raises(ValueError, match="right: expected the body of frame 0"):
        run(sequence([pair[0]]), sequence([blank]))
    with pytest.raises(ValueError, match="radius_px: expected at least 3"):
        TrackSettings(radius_px=2)


# Frames stream: what a series needs does not grow with its length, but for the numbers that it is after.

WANDERING = ((0, 0), (1, 0), (2, 1), (1, 2), (0, 1))
MOST_HELD = 4  # per camera: the first frame, the present one, and what a reader is about to hand out


class RollingReader:
    """Frames made when they are asked for: one image rolled by a few pixels. Counts how many are alive at once."""

    def __init__(self, image: np.ndarray) -> None:
        self.image = image
        self.alive = 0
        self.most_alive = 0

    def __call__(self, index: int) -> np.ndarray:
        right, down = WANDERING[index % len(WANDERING)]
        frame = np.roll(self.image, (down, right), axis=(0, 1))
        self.alive += 1
        weakref.finalize(frame, self._forget)
        self.most_alive = max(self.most_alive, self.alive)
        return frame

    def _forget(self) -> None:
        self.alive -= 1

    def sequence(self, frames: int) -> ImageSequence:
        height, width = self.image.shape
        return ImageSequence(tuple(f"frame {k}" for k in range(frames)), (width, height), 4095, self)


@pytest.fixture(scope="module")
def speckle() -> Callable[[int, int], np.ndarray]:
    def make(width: int, height: int) -> np.ndarray:
        from scipy import ndimage

        white = np.random.default_rng(30).normal(size=(height, width))
        smooth = ndimage.gaussian_filter(white, 1.6, mode="wrap")
        return np.round(2000 + 400 * smooth / smooth.std()).astype(np.uint16)

    return make


def peak_bytes(sequence: ImageSequence, points: np.ndarray) -> int:
    """Largest memory that Python and NumPy hold at any time while the sequence is tracked."""
    gc.collect()
    tracemalloc.start()
    try:
        tracks = track_sequence(sequence, points, TrackSettings())
        assert np.all(tracks.status == TrackStatus.OK)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_ten_times_the_frames_need_no_more_memory(speckle: Callable[[int, int], np.ndarray]) -> None:
    reader = RollingReader(speckle(320, 256))
    points = np.stack(np.meshgrid(np.arange(50.0, 300, 90), np.arange(50.0, 240, 70)), axis=-1).reshape(-1, 2)
    track_sequence(reader.sequence(2), points, TrackSettings())  # imports and kernels are not counted
    few, many = (peak_bytes(reader.sequence(frames), points) for frames in (6, 60))
    assert many - few < 2 * reader.image.nbytes  # results of 54 more frames; the frames themselves would be 54 images
    assert reader.most_alive <= MOST_HELD
    gc.collect()
    assert reader.alive == 0


def test_a_stereo_pair_holds_a_few_frames_of_each_camera(speckle: Callable[[int, int], np.ndarray]) -> None:
    image = speckle(200, 160)
    readers = RollingReader(image), RollingReader(np.roll(image, (0, 3), axis=(0, 1)))
    left, right = (reader.sequence(20) for reader in readers)
    tracks = track_stereo(left, right, None, TrackSettings())
    assert np.mean(tracks.left.status == TrackStatus.OK) > 0.9
    assert all(reader.most_alive <= MOST_HELD for reader in readers)
    del tracks
    gc.collect()
    assert all(reader.alive == 0 for reader in readers)


# A real scene at rest, three stereo pairs: whatever moves is noise.


def test_nothing_moves_by_more_than_its_noise(data_dir: Path) -> None:
    folder = data_dir / "static_stereo"
    left, right = (open_sequence([folder / f"img_000{k}_{side}.tif" for k in range(3)]) for side in (0, 1))
    stereo = track_stereo(left, right, None, TrackSettings(radius_px=13))
    for tracks in (stereo.left, stereo.right):
        assert tracks.position_px.shape[1] > 500
        assert np.mean(tracks.status == TrackStatus.OK) > 0.98
        moved = tracks.position_px[1:] - tracks.position_px[0]
        scatter = np.nanstd(moved, axis=1)
        stated = np.sqrt(2.0 * np.nanmean(tracks.covariance_px2[1:][..., [0, 1], [0, 1]], axis=1))
        assert scatter.max() <= 0.005
        assert np.abs(np.nanmean(moved, axis=1)).max() <= 0.020
        np.testing.assert_allclose(scatter / stated, 1.0, atol=0.25)


# A vibrating beam filmed far below its frequency: every hundredth sample of another program's 15 kHz series.

FIRST_X_PX, SPACING_PX, EDGES_Y_PX = 20.0, 40.0, 20.0
INNER_POINTS = range(1, 7)


def test_frames_follow_every_hundredth_sample(data_dir: Path) -> None:
    """The series has column 0 = vertical, in metres; its points lie 40 px apart (found by correlation, not published).

    Seven subsets around each of six points are averaged, which spans the beam like the points of the series do.
    """
    folder = data_dir / "undersampled_video"
    sequence = open_sequence([folder / "data_showcase.cih"])
    series = np.load(folder / "displacements_lk.npy")[INNER_POINTS.start : INNER_POINTS.stop, ::100, 0]
    middle = FIRST_X_PX + SPACING_PX * np.array(INNER_POINTS, dtype=float)
    x = (middle[:, None] + np.arange(-15.0, 16.0, 5.0)).ravel()
    tracks = track_sequence(sequence, np.column_stack([x, np.full_like(x, EDGES_Y_PX)]), TrackSettings(radius_px=10))
    assert tracks.position_px.shape == (75, len(x), 2)
    assert np.all(tracks.status == TrackStatus.OK)
    vertical = tracks.position_px[: series.shape[1], :, 1].mean(axis=1)
    assert np.corrcoef(vertical, series.mean(axis=0))[0, 1] >= 0.9999


# A large deformation of a real specimen: matches of another program (OpenCorr, second order, radius 16).

COUNT = 300


@pytest.mark.parametrize(
    ("image", "column", "bound_px"),
    [pytest.param("0000_1", "r2", 0.05, marks=pytest.mark.slow), ("0273_0", "t1", 0.02)],
)
def test_positions_are_those_of_the_peer(data_dir: Path, image: str, column: str, bound_px: float) -> None:
    folder = data_dir / "gt4_stereo"
    table = np.genfromtxt(folder / "GT4-0273_0_epipolar_sift_r16.csv", delimiter=",", names=True)
    table = table[np.linspace(0, len(table) - 1, COUNT).astype(int)]
    first, second = (open_sequence([folder / f"GT4-{name}.tif"]).read(0) for name in ("0000_0", image))
    points = np.column_stack([table["x"], table["y"]])
    tracks = match_stereo(first, second, points, TrackSettings(radius_px=16))
    assert np.mean(tracks.status == TrackStatus.OK) > 0.98
    peer = np.column_stack([table[f"{column}_x"], table[f"{column}_y"]])
    distance = np.hypot(*(tracks.position_px[0] - peer).T)
    assert np.nanmedian(distance) <= bound_px
