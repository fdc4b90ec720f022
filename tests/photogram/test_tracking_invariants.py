"""What must not change a track: where the image's corner lies, light, the order of frames and subsets, a mirror."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photogram.camera import Camera, StereoRig, triangulate
from photogram.geometry import RigidTransform
from photogram.images import ImageSequence
from photogram.motion import RigidMotion, fit_motion
from photogram.subsets.reference import TrackStatus
from photogram.subsets.track import Tracks, TrackSettings, track_sequence, track_stereo
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of

FULL_SCALE = 65535
SIZE = (132, 120)
POINTS = np.stack(np.meshgrid([46.0, 65.0, 86.0], [44.0, 60.0, 75.0]), axis=-1).reshape(-1, 2)
SHIFTS = np.array([[0.0, 0.0], [0.62, -0.35], [1.31, -0.9], [0.84, -0.48], [-0.77, 0.52]])
TURNS = 4e-3 * np.array([0.0, 1.0, 1.7, 1.2, -1.1])
NOISE_GREY = 6.0
SAME_PX = 1e-5  # the same arithmetic on the same pixels but for rounding and the image's rim
FEW = settings(max_examples=8, deadline=None)
Images = Sequence[np.ndarray]


@pytest.fixture(scope="module")
def frames(make_texture) -> list[np.ndarray]:
    """A plane that shifts and turns, 12 bit with noise."""
    texture = make_texture(seed=41, s=1.5, waves=60)
    middle, images = np.array(SIZE) / 2, []
    for k, (shift, turn) in enumerate(zip(SHIFTS, TURNS, strict=True)):
        back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        clean = 2000 + 400 * texture.image(SIZE, lambda p, s=shift, b=back: (p - middle - s) @ b + middle)
        noise = np.random.default_rng(50 + k).normal(0.0, NOISE_GREY, clean.shape)
        images.append(np.round(clean + noise).astype(np.uint16))
    return images


@pytest.fixture(scope="module")
def tracks(frames: Images) -> Tracks:
    return follow(frames)


def follow(images: Images, points: np.ndarray = POINTS, degree: int = 5) -> Tracks:
    images = [np.ascontiguousarray(image) for image in images]
    height, width = images[0].shape
    names = tuple(f"frame {k}" for k in range(len(images)))
    sequence = ImageSequence(names, (width, height), FULL_SCALE, images.__getitem__)
    tracks = track_sequence(sequence, points, TrackSettings(degree=degree))
    assert np.all(tracks.status == TrackStatus.OK)
    return tracks


def test_the_frames_move_as_they_should(tracks: Tracks) -> None:
    """The truth that the invariants start from."""
    for k, (shift, turn) in enumerate(zip(SHIFTS, TURNS, strict=True)):
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        truth = (POINTS - np.array(SIZE) / 2) @ rotation.T + np.array(SIZE) / 2 + shift
        np.testing.assert_allclose(tracks.position_px[k], truth, atol=0.01)


@FEW
@given(right=st.integers(0, 12), down=st.integers(0, 12))
def test_whole_pixels_shift_the_tracks(frames: Images, tracks: Tracks, right: int, down: int) -> None:
    corner = np.array([right, down])
    cut = follow([image[down:, right:] for image in frames], POINTS - corner)
    np.testing.assert_allclose(cut.position_px + corner, tracks.position_px, atol=SAME_PX)


@FEW
@given(data=st.data())
def test_light_and_contrast_of_a_frame_leave_the_positions(frames: Images, tracks: Tracks, data: st.DataObject) -> None:
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
def test_a_power_of_two_of_the_grey_values_changes_no_bit(frames: Images, power: int, degree: int) -> None:
    plain, scaled = (follow([image << bits for image in frames], degree=degree) for bits in (0, power))
    np.testing.assert_array_equal(scaled.position_px, plain.position_px)
    np.testing.assert_array_equal(scaled.covariance_px2, plain.covariance_px2)
    np.testing.assert_array_equal(scaled.noise_grey, 2**power * plain.noise_grey)


@pytest.mark.parametrize("degree", [3, 5])
def test_a_transposed_or_mirrored_scene_gives_transposed_or_mirrored_tracks(frames: Images, degree: int) -> None:
    plain = follow(frames, degree=degree)
    width, height = SIZE
    turned = follow([image.T for image in frames], POINTS[:, ::-1], degree)
    np.testing.assert_allclose(turned.position_px[..., ::-1], plain.position_px, atol=SAME_PX)
    np.testing.assert_allclose(turned.covariance_px2[..., ::-1, ::-1], plain.covariance_px2, rtol=1e-3)
    across = follow([image[:, ::-1] for image in frames], POINTS * [-1, 1] + [width - 1, 0], degree)
    np.testing.assert_allclose(across.position_px * [-1, 1] + [width - 1, 0], plain.position_px, atol=SAME_PX)
    upside = follow([image[::-1] for image in frames], POINTS * [1, -1] + [0, height - 1], degree)
    np.testing.assert_allclose(upside.position_px * [1, -1] + [0, height - 1], plain.position_px, atol=SAME_PX)


@FEW
@given(order=st.permutations(range(1, len(SHIFTS))))
def test_the_order_of_the_frames_moves_a_subset_by_less_than_a_tenth_of_its_uncertainty(
    frames: Images, tracks: Tracks, order: list[int]
) -> None:
    """Time reversed among the orders: another order is another start, and the end must not know it."""
    order = [0, *order]
    shuffled = follow([frames[k] for k in order])
    moved = shuffled.position_px - tracks.position_px[order]
    assert np.all(np.abs(moved) < 0.1 * sigma_px(tracks)[order])


def test_time_reversed_leads_back(frames: Images, tracks: Tracks) -> None:
    """With the last frame as the reference the subsets return to where they came from, within the noise of a pair."""
    back = follow(frames[::-1], tracks.position_px[-1])
    missed = (back.position_px[-1] - POINTS) / (np.sqrt(2.0) * sigma_px(tracks)[-1])
    assert np.sqrt(np.mean(missed**2)) < 1.0
    assert np.abs(missed).max() < 3.0


@FEW
@given(order=st.permutations(range(len(POINTS))), last=st.integers(1, len(SHIFTS) - 1))
def test_neither_the_order_of_subsets_nor_the_future_matters(
    frames: Images, tracks: Tracks, order: list[int], last: int
) -> None:
    shuffled = follow(frames[: last + 1], POINTS[order])
    np.testing.assert_allclose(shuffled.position_px, tracks.position_px[: last + 1, order], atol=1e-9)


def sigma_px(tracks: Tracks) -> np.ndarray:
    """Stated standard uncertainties (F,N,2)."""
    return np.sqrt(np.diagonal(tracks.covariance_px2, axis1=2, axis2=3))


@pytest.fixture(scope="module")
def stereo() -> tuple[StereoRig, list[list[np.ndarray]]]:
    """A round speckled face before two cameras, 24° apart, at rest and in two other poses."""
    pixel_m, focal = 2e-4, 1500.0
    texture = speckle_texture((0.04, 0.04), 5 * pixel_m, pixel_m / 4, 1.2 * pixel_m, np.random.default_rng(42))
    axes = np.eye(3)
    face = Face(np.zeros(3), axes[0], axes[1], np.array([0.017, 0.017]), True, texture, 0.6 * pixel_m)
    camera = Camera(np.array([[focal, 0, 110], [0, focal, 100], [0, 0, 1.0]]), np.zeros(5), np.array([220, 200]))
    places = [
        RigidTransform(np.eye(3), np.array([0, 0, focal * pixel_m]))
        @ RigidTransform.from_pose(np.array([0, 0, 0, 0, angle, 0]))
        for angle in np.radians([-12.0, 12.0])
    ]
    poses = np.array([np.zeros(6), [1e-4, -8e-5, 2e-4, 1e-3, -2e-3, 3e-3], [-9e-5, 5e-5, -3e-4, -2e-3, 1e-3, 1e-3]])
    sensor, rng = ImageSensor(12, 16.0, 3.0), np.random.default_rng(43)
    images = []
    for place in places:
        view = view_of(camera, place)
        images.append([sensor.digitise(render(view, face, pose[None], np.ones(1)), rng) for pose in poses])
    return StereoRig(camera, camera, places[1] @ places[0].inverse()), images


def motion_of(rig: StereoRig, left: Images, right: Images, origin_m: np.ndarray) -> RigidMotion:
    """Motion of what both cameras see, in the left camera's frame."""
    sequences = [ImageSequence(("a", "b", "c"), (220, 200), 4095, images.__getitem__) for images in (left, right)]
    seen = track_stereo(sequences[0], sequences[1], rig, TrackSettings())
    points = triangulate(
        rig, seen.left.position_px, seen.right.position_px, seen.left.covariance_px2, seen.right.covariance_px2
    )
    return fit_motion(points, None, origin_m)


def test_swapped_cameras_see_the_same_motion(stereo) -> None:
    """The left camera lays the grid, so other subsets are followed: the same motion within its uncertainty."""
    rig, (left, right) = stereo
    swap = StereoRig(rig.right, rig.left, rig.right_from_left.inverse())
    origin = np.array([0.0, 0.0, 0.3])
    plain = motion_of(rig, left, right, origin)
    swapped = motion_of(swap, right, left, rig.right_from_left.apply(origin))
    turn = np.kron(np.eye(2), rig.right_from_left.rotation.T)
    difference = swapped.pose @ turn.T - plain.pose
    covariance = plain.covariance + turn @ swapped.covariance @ turn.T
    assert np.all(np.abs(plain.pose[1:]) > 10 * np.sqrt(np.diagonal(covariance[1:], axis1=1, axis2=2)))
    for k in (1, 2):
        assert (
            difference[k] @ np.linalg.solve(covariance[k], difference[k]) < 6.0
        )  # the mean of χ² with six degrees of freedom: both share most of their noise
