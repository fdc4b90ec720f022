"""Tracks of analytic scenes, what must not change them, and real recordings."""

from __future__ import annotations

import gc
import tracemalloc
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from speckle import render_images, sequence

from photogram import device as device_module
from photogram.camera import Camera, StereoRig, triangulate
from photogram.device import resolve_device
from photogram.geometry import RigidTransform
from photogram.images.image_files import open_sequence
from photogram.images.image_notices import OFF_EPIPOLAR_LINES, UNRESOLVED_TEXTURE
from photogram.images.sequence import FRAMES_AHEAD, ImageSequence
from photogram.motion import RigidMotion, fit_motion
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.reference import TrackStatus
from photogram.subsets.search import predict_warp
from photogram.subsets.track import (
    Tracks,
    follow_sequence,
    lay_stereo_grid,
    match_stereo,
    prepare_sequence,
    track_sequence,
    track_stereo,
)
from photogram.synthetic.scene import ImageSensor

SIZE = (320, 256)
FOCAL, DISTANCE_M, PIXEL_M = 1500.0, 0.5, 0.5 / 1500.0
DISC_M = 0.034


def on_plane(camera_from_left: RigidTransform, pixels: np.ndarray) -> np.ndarray:
    """Points (M,2) in metres of the plane z = 0.5 m in the left frame, seen at the pixels (M,2) of a camera."""
    rays = np.column_stack([(pixels - [160, 128]) / FOCAL, np.ones(len(pixels))]) @ camera_from_left.rotation
    centre = -camera_from_left.rotation.T @ camera_from_left.translation_m
    return (centre + rays * ((DISTANCE_M - centre[2]) / rays[:, 2])[:, None])[:, :2]


def scene(texture, camera_from_left: RigidTransform, shift_m=(0.0, 0.0), seed=0, noise=6.0) -> np.ndarray:
    """A disc with speckle of about 4 px before a plain background, 12 bit."""
    pixels = np.indices(SIZE[::-1])[::-1].reshape(2, -1).T.astype(float)
    points = on_plane(camera_from_left, pixels) - np.asarray(shift_m)
    disc = 1.0 / (1.0 + np.exp((np.hypot(*points.T) - DISC_M) / (0.4 * PIXEL_M)))
    speckle = np.concatenate([texture(part) for part in np.array_split(points / PIXEL_M, 64)])
    clean = 300 + disc * (1500 + 400 * speckle)
    noisy = clean.reshape(SIZE[::-1]) + np.random.default_rng(seed).normal(0, noise, SIZE[::-1])
    return np.clip(np.round(noisy), 0, 4095).astype(np.uint16)


def shifted(texture, size: tuple[int, int], shifts: Sequence[Sequence[float]]) -> list[np.ndarray]:
    """The texture, moved by every shift."""
    images = (texture.image(size, lambda p, by=shift: p - by) for shift in shifts)
    return [np.round(2000 + 400 * image).astype(np.uint16) for image in images]


@pytest.fixture(scope="module")
def texture(make_texture):
    return make_texture(seed=21, s=1.3, waves=60)


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    """Two cameras, 30° apart, that look at the origin of the plane z = 0.5 m from both sides."""
    camera = Camera(np.array([[FOCAL, 0, 160], [0, FOCAL, 128], [0, 0, 1.0]]), np.zeros(5), np.array(SIZE))
    turn = RigidTransform.from_pose(np.array([0, 0, 0, 0, np.radians(30.0), 0]))
    pivot = np.array([0, 0, DISTANCE_M])
    return StereoRig(camera, camera, RigidTransform(turn.rotation, pivot - turn.rotation @ pivot))


@pytest.fixture(scope="module")
def pair(texture, rig: StereoRig) -> tuple[np.ndarray, np.ndarray]:
    return scene(texture, RigidTransform.identity(), seed=1), scene(texture, rig.right_from_left, seed=2)


def true_right(rig: StereoRig, left_px: np.ndarray, shift_m=(0.0, 0.0)) -> np.ndarray:
    plane = on_plane(RigidTransform.identity(), left_px) + np.asarray(shift_m)
    return rig.project(np.column_stack([plane, np.full(len(plane), DISTANCE_M)]))[1]


def test_the_path_of_a_stereo_pair(texture, pair, rig):
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
    first = tracks.right.position_px[0] - true_right(rig, points)  # without a start, 30 degrees apart
    assert np.sqrt(np.mean(first**2)) < 0.03
    assert np.all(tracks.right.zncc[0] > 0.95)
    for k, shift in enumerate(shifts):
        error = tracks.right.position_px[k] - true_right(rig, points, shift)
        assert np.abs(error - first).max() < 0.03


def test_matches_off_their_epipolar_lines_are_dropped_and_a_wrong_calibration_is_reported(pair, rig):
    shifted = pair[1].copy()
    shifted[110:150, 140:190] = np.roll(pair[1], 4, axis=0)[110:150, 140:190]  # a part that the calibration excludes
    grids = [lay_stereo_grid(sequence([pair[0]]), sequence([shifted]), one, TrackSettings()) for one in (rig, None)]
    off = [np.abs(grid.right_px - true_right(rig, grid.left_px)).max(axis=1) > 2.0 for grid in grids]
    assert not off[0].any()
    assert off[1].any()
    assert len(grids[0].left_px) > 20
    assert grids[0].notices == ()
    tilt = RigidTransform.from_pose(np.array([0, 0, 0, 0.004, 0, 0]))
    wrong = StereoRig(rig.left, rig.right, tilt @ rig.right_from_left)
    tracks = track_stereo(sequence([pair[0]] * 2), sequence([pair[1]] * 2), wrong, TrackSettings())
    assert (OFF_EPIPOLAR_LINES.code, "stereo calibration") in {(notice.code, notice.where) for notice in tracks.notices}


def test_speckle_finer_than_the_pixels_is_reported(make_texture):
    image = 2000 + 400 * make_texture(seed=25, s=0.55, waves=100).image((160, 120))
    frames = [np.round(image + np.random.default_rng(k).normal(0, 6, image.shape)).astype(np.uint16) for k in range(3)]
    tracks = track_stereo(sequence(frames), sequence(frames[::-1]), None, TrackSettings())
    warnings = [notice for notice in tracks.notices if notice.code == UNRESOLVED_TEXTURE.code]
    assert [notice.where for notice in warnings] == ["left camera", "right camera"]
    assert np.all(tracks.speckle_px < 3.0)


def test_jumps_of_many_pixels_are_found(make_texture):
    jumps = np.array([[0, 0], [9.3, -4.2], [-8.6, 9.7], [0.2, 0.1]])
    frames = shifted(make_texture(seed=22, s=1.3, waves=60), (140, 130), jumps)
    points = np.array([[45.0, 45.0], [70.0, 60.0], [95.0, 80.0], [60.3, 85.7]])
    tracks = track_sequence(sequence(frames), points, TrackSettings())
    assert np.all(tracks.status == TrackStatus.OK)
    np.testing.assert_allclose(tracks.position_px - points, np.broadcast_to(jumps[:, None], (4, 4, 2)), atol=5e-3)


def test_saturated_absent_and_leaving_subsets_are_distinguished(make_texture):
    frames = shifted(make_texture(seed=23, s=1.3, waves=60), (120, 90), [(0, 0), (2, 0), (4, 0)])
    for frame in frames:
        frame[55:70, 60:80] = 4095
    points = np.array([[40.0, 30.0], [68.0, 62.0], [np.nan, np.nan], [106.0, 30.0]])
    tracks = track_sequence(sequence(frames), points, TrackSettings())
    first = [TrackStatus.OK, TrackStatus.SATURATED, TrackStatus.NO_START, TrackStatus.OK]
    assert tracks.status.tolist() == [first, first, [*first[:3], TrackStatus.LEFT_IMAGE]]
    for found in (tracks.position_px, tracks.covariance_px2, tracks.zncc):
        assert np.isnan(found[tracks.status != TrackStatus.OK]).all()


@pytest.mark.parametrize("step", [0.1, 1.2, 2.9])
def test_a_vibration_sampled_too_slowly_is_predicted(step):
    """Sines of any phase step from frame to frame, about any mean, obey the recursion exactly."""
    frames = np.arange(8)
    warps = np.zeros((8, 5, 6))
    warps[:, :, 0] = 3.0 + np.outer(np.sin(step * frames + 0.3), np.arange(1.0, 6.0))
    warps[:, :, 3] = np.outer(np.cos(step * frames), np.arange(5.0))
    np.testing.assert_allclose(predict_warp(list(warps[:7])), warps[7], atol=1e-9)


def test_wrong_pairs_are_named(pair, rig):
    blank = np.full(SIZE[::-1], 100, np.uint16)
    blank += np.random.default_rng(3).integers(0, 5, blank.shape, dtype=np.uint16)
    run = partial(track_stereo, rig=rig, settings=TrackSettings())
    refused("^right: .* 2 frames .* 1$", run, sequence([pair[0]] * 2), sequence([pair[1]]))
    refused("^right: .* frame 0: dark", run, sequence([pair[0]]), sequence([blank]))
    refused("^radius_px: .* 3", TrackSettings, radius_px=2)


# Frames stream: what a series needs does not grow with its length, but for the numbers that it is after.

WANDERING = ((0, 0), (1, 0), (2, 1), (1, 2), (0, 1))
MOST_HELD = 4 + FRAMES_AHEAD
"""Per camera: the first frame, the present one, those read in advance and the next one."""


@dataclass
class RollingReader:
    """Frames made when they are asked for: one image rolled by a few pixels. Counts how many are alive at once."""

    image: np.ndarray
    alive: int = 0
    most_alive: int = 0

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


def speckle(width: int, height: int) -> np.ndarray:
    white = np.random.default_rng(30).normal(size=(height, width))
    smooth = ndimage.gaussian_filter(white, 1.6, mode="wrap")
    return np.round(2000 + 400 * smooth / smooth.std()).astype(np.uint16)


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


def test_six_times_the_frames_need_no_more_memory():
    reader = RollingReader(speckle(320, 256))
    points = np.stack(np.meshgrid(np.arange(50.0, 300, 90), np.arange(50.0, 240, 70)), axis=-1).reshape(-1, 2)
    track_sequence(reader.sequence(2), points, TrackSettings())  # imports and kernels are not counted
    few, many = (peak_bytes(reader.sequence(frames), points) for frames in (6, 36))
    assert many - few < 2 * reader.image.nbytes  # results of 30 more frames; the frames themselves would be 30 images
    assert reader.most_alive <= MOST_HELD
    gc.collect()
    assert reader.alive == 0


# A real scene at rest, three stereo pairs: whatever moves is noise.


def test_motion_is_within_its_noise(data_dir):
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


def test_frames_follow_every_hundredth_sample(data_dir):
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("image", "column", "bound_px"),
    [("0000_1", "r2", 0.05), ("0273_0", "t1", 0.02)],
)
def test_positions_are_those_of_the_peer(data_dir, image, column, bound_px):
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


# What must not change a track: where the image's corner lies, light, the order of frames and subsets, a mirror.

FULL_SCALE = 65535
PLANE_SIZE = (132, 120)
POINTS = np.stack(np.meshgrid([46.0, 65.0, 86.0], [44.0, 60.0, 75.0]), axis=-1).reshape(-1, 2)
SHIFTS = np.array([[0.0, 0.0], [0.62, -0.35], [1.31, -0.9], [0.84, -0.48], [-0.77, 0.52]])
TURNS = 4e-3 * np.array([0.0, 1.0, 1.7, 1.2, -1.1])
NOISE_GREY = 6.0
SAME_PX = 1e-5  # the same arithmetic on the same pixels but for rounding and the image's rim
FEW = settings(max_examples=4, deadline=None)
Images = Sequence[np.ndarray]


@pytest.fixture(scope="module")
def frames(make_texture) -> list[np.ndarray]:
    """A plane that shifts and turns, 12 bit with noise."""
    texture = make_texture(seed=41, s=1.5, waves=60)
    middle, images = np.array(PLANE_SIZE) / 2, []
    for k, (shift, turn) in enumerate(zip(SHIFTS, TURNS, strict=True)):
        back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        clean = 2000 + 400 * texture.image(PLANE_SIZE, lambda p, s=shift, b=back: (p - middle - s) @ b + middle)
        noise = np.random.default_rng(50 + k).normal(0.0, NOISE_GREY, clean.shape)
        images.append(np.round(clean + noise).astype(np.uint16))
    return images


@pytest.fixture(scope="module")
def tracks(frames: Images) -> Tracks:
    return follow(frames)


def follow(images: Images, points: np.ndarray = POINTS, degree: int = 5) -> Tracks:
    images = [np.ascontiguousarray(image) for image in images]
    tracks = track_sequence(sequence(images, FULL_SCALE), points, TrackSettings(degree=degree))
    assert np.all(tracks.status == TrackStatus.OK)
    return tracks


def test_the_frames_move_as_they_should(tracks):
    """The truth that the invariants start from."""
    for k, (shift, turn) in enumerate(zip(SHIFTS, TURNS, strict=True)):
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        truth = (POINTS - np.array(PLANE_SIZE) / 2) @ rotation.T + np.array(PLANE_SIZE) / 2 + shift
        np.testing.assert_allclose(tracks.position_px[k], truth, atol=0.01)


def test_most_subsets_take_one_step_from_where_a_few_have_moved(frames):
    """A motion that no rule foretells, from the third frame on."""
    points = np.stack(np.meshgrid(np.arange(16.0, 117.0, 5.0), np.arange(16.0, 105.0, 5.0)), axis=-1).reshape(-1, 2)
    images = sequence(frames, FULL_SCALE)
    reference = prepare_sequence(images, points, TrackSettings())
    found = [frame.found for frame in follow_sequence(images, reference, TrackSettings())]
    assert all(np.all(here.status == TrackStatus.OK) for here in found)
    assert np.mean([here.iterations for here in found[2:]]) < 1.1


@FEW
@given(right=st.integers(0, 12), down=st.integers(0, 12))
def test_whole_pixels_shift_the_tracks(frames, tracks, right, down):
    corner = np.array([right, down])
    cut = follow([image[down:, right:] for image in frames], POINTS - corner)
    np.testing.assert_allclose(cut.position_px + corner, tracks.position_px, atol=SAME_PX)


@FEW
@given(data=st.data())
def test_light_and_contrast_of_a_frame_leave_the_positions(frames, tracks, data):
    """Whole gains and offsets, so that no grey value is rounded again; the reference keeps its own."""
    lit = [frames[0]]
    for image in frames[1:]:
        gain, offset = data.draw(st.integers(1, 12)), data.draw(st.integers(-500, 8000))
        lit.append((gain * image.astype(np.int64) + offset).astype(np.uint16))
    changed = follow(lit)
    np.testing.assert_allclose(changed.position_px, tracks.position_px, atol=SAME_PX)
    np.testing.assert_allclose(changed.zncc, tracks.zncc, atol=1e-9)


@FEW
@given(power=st.integers(1, 4), degree=st.sampled_from([3, 5]))
def test_a_power_of_two_of_the_grey_values_changes_no_bit(frames, power, degree):
    plain, scaled = (follow([image << bits for image in frames], degree=degree) for bits in (0, power))
    np.testing.assert_array_equal(scaled.position_px, plain.position_px)
    np.testing.assert_array_equal(scaled.covariance_px2, plain.covariance_px2)
    np.testing.assert_array_equal(scaled.noise_grey, 2**power * plain.noise_grey)


@pytest.mark.parametrize("degree", [3, 5])
def test_a_transposed_or_mirrored_scene_gives_transposed_or_mirrored_tracks(frames, degree):
    plain = follow(frames, degree=degree)
    width, height = PLANE_SIZE
    turned = follow([image.T for image in frames], POINTS[:, ::-1], degree)
    np.testing.assert_allclose(turned.position_px[..., ::-1], plain.position_px, atol=SAME_PX)
    np.testing.assert_allclose(turned.covariance_px2[..., ::-1, ::-1], plain.covariance_px2, rtol=1e-3)
    across = follow([image[:, ::-1] for image in frames], POINTS * [-1, 1] + [width - 1, 0], degree)
    np.testing.assert_allclose(across.position_px * [-1, 1] + [width - 1, 0], plain.position_px, atol=SAME_PX)
    upside = follow([image[::-1] for image in frames], POINTS * [1, -1] + [0, height - 1], degree)
    np.testing.assert_allclose(upside.position_px * [1, -1] + [0, height - 1], plain.position_px, atol=SAME_PX)


@FEW
@given(order=st.permutations(range(1, len(SHIFTS))))
def test_the_order_of_the_frames_moves_a_subset_by_less_than_a_tenth_of_its_uncertainty(frames, tracks, order):
    """Time reversed among the orders: another order is another start, and the end must not know it."""
    order = [0, *order]
    shuffled = follow([frames[k] for k in order])
    moved = shuffled.position_px - tracks.position_px[order]
    assert np.all(np.abs(moved) < 0.1 * sigma_px(tracks)[order])


def test_time_reversed_leads_back(frames, tracks):
    """With the last frame as the reference the subsets return to where they came from, within the noise of a pair."""
    back = follow(frames[::-1], tracks.position_px[-1])
    missed = (back.position_px[-1] - POINTS) / (np.sqrt(2.0) * sigma_px(tracks)[-1])
    assert np.sqrt(np.mean(missed**2)) < 1.0
    assert np.abs(missed).max() < 3.0


@FEW
@given(order=st.permutations(range(len(POINTS))), last=st.integers(1, len(SHIFTS) - 1))
def test_neither_the_order_of_subsets_nor_the_future_matters(frames, tracks, order, last):
    shuffled = follow(frames[: last + 1], POINTS[order])
    np.testing.assert_allclose(shuffled.position_px, tracks.position_px[: last + 1, order], atol=1e-9)


def sigma_px(tracks: Tracks) -> np.ndarray:
    """Stated standard uncertainties (F,N,2)."""
    return np.sqrt(np.diagonal(tracks.covariance_px2, axis1=2, axis2=3))


def motion_of(rig: StereoRig, images: Sequence[ImageSequence], origin_m: np.ndarray) -> RigidMotion:
    """Motion of what both cameras see, in the left camera's frame."""
    seen = track_stereo(*images, rig, TrackSettings())
    positions = seen.left.position_px, seen.right.position_px
    points = triangulate(rig, *positions, seen.left.covariance_px2, seen.right.covariance_px2)
    return fit_motion(points, None, origin_m)


def test_swapped_cameras_see_the_same_motion():
    """The left camera lays the grid, so other subsets are followed: the same motion within its uncertainty."""
    poses = np.array([np.zeros(6), [1e-4, -8e-5, 2e-4, 1e-3, -2e-3, 3e-3], [-9e-5, 5e-5, -3e-4, -2e-3, 1e-3, 1e-3]])
    images, rig, _ = render_images(poses, (0.017, 0.017), (110, 100), 42, ImageSensor(12, 16.0, 3.0))
    swap = StereoRig(rig.right, rig.left, rig.right_from_left.inverse())
    origin = np.array([0.0, 0.0, 0.3])
    plain, swapped = motion_of(rig, images, origin), motion_of(swap, images[::-1], rig.right_from_left.apply(origin))
    turn = np.kron(np.eye(2), rig.right_from_left.rotation.T)
    difference = swapped.pose @ turn.T - plain.pose
    covariance = plain.covariance + turn @ swapped.covariance @ turn.T
    assert np.all(np.abs(plain.pose[1:]) > 10 * np.sqrt(np.diagonal(covariance[1:], axis1=1, axis2=2)))
    for k in (1, 2):
        # the mean of χ² with six degrees of freedom: both share most of their noise
        assert difference[k] @ np.linalg.solve(covariance[k], difference[k]) < 6.0


# The device that registers.


@pytest.mark.parametrize(
    ("choice", "driver", "torch_finds", "expected"),
    [
        ("cpu", True, True, "cpu"),
        ("auto", True, True, "cuda"),
        ("auto", True, False, "cpu"),
        ("auto", False, True, "cpu"),
        ("cuda", True, True, "cuda"),
        ("cuda", False, True, "cuda"),
    ],
)
def test_device_is_chosen(monkeypatch, choice, driver, torch_finds, expected):
    monkeypatch.setattr(device_module, "_has_driver", lambda: driver)
    monkeypatch.setattr(device_module, "_torch_finds_cuda", lambda: torch_finds)
    assert resolve_device(choice) == expected


def test_an_absent_gpu_is_an_error_only_if_specified_and_torch_is_not_imported_without_a_driver(monkeypatch):
    def refuse(name: str) -> None:
        raise OSError(f"{name}: no such library")

    def never() -> bool:
        raise AssertionError("torch was imported")

    monkeypatch.setattr(device_module, "_torch_finds_cuda", lambda: False)
    refused("^device: .*'cuda'", resolve_device, "cuda")
    refused("^device: .*auto, cpu, cuda, .*'gpu'", resolve_device, "gpu")
    monkeypatch.setattr(device_module.ctypes, "CDLL", refuse)
    monkeypatch.setattr(device_module, "_torch_finds_cuda", never)
    assert resolve_device("auto") == "cpu"


@pytest.mark.parametrize(
    ("missing", "driver", "remedy"),
    [
        (("torch", "kornia"), True, r"shakercal\[gpu\]"),
        (("kornia",), True, "kornia"),
        ((), False, "driver"),
        ((), True, "CUDA"),
    ],
)
def test_a_refused_gpu_says_what_to_install(monkeypatch, missing, driver, remedy):
    monkeypatch.setattr(device_module, "find_spec", lambda package: None if package in missing else package)
    monkeypatch.setattr(device_module, "_has_driver", lambda: driver)
    if not missing:
        monkeypatch.setattr(device_module, "_torch_finds_cuda", lambda: False)
    refused(f"^device: .*{remedy}", resolve_device, "cuda")
