"""First guesses: features and affine starts, templates, fields through few points, epipolar distances."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images import ImageSequence
from photogram.subsets.reference import TrackStatus
from photogram.subsets.search import (
    affine_field,
    affine_starts,
    agreeing,
    epipolar_distance,
    match_features,
    neighbour_starts,
    template_shifts,
    warp_of_affine,
)
from photogram.subsets.track import TrackSettings, match_stereo, track_sequence
from photogram.synthetic.scene import Face, render, speckle_texture, view_of

MATRIX = np.array([[0.87, 0.02], [-0.05, 1.01]])
SHIFT = np.array([14.0, -6.0])


def warp_at(points: np.ndarray) -> np.ndarray:
    """The warp of x → MATRIX x + SHIFT at each point."""
    warps = np.tile(warp_of_affine(np.column_stack([MATRIX, SHIFT])), (len(points), 1))
    warps[:, [0, 3]] = points @ MATRIX.T + SHIFT - points
    return warps


def test_features_of_speckle_give_affine_starts(make_texture) -> None:
    texture = make_texture(seed=41, s=1.4, waves=80)
    inverse = np.linalg.inv(MATRIX)
    left = 2000 + 400 * texture.image((240, 200))
    right = 900 + 250 * texture.image((240, 200), lambda p: (p - SHIFT) @ inverse.T)
    noise = np.random.default_rng(41).normal(0, 10, (2, 200, 240))
    source, target = match_features(left + noise[0], right + noise[1])
    assert len(source) > 50
    points = np.array([[100.0, 100.0], [60.0, 120.0], [150.0, 80.0]])
    starts = affine_starts(points, source, target)
    np.testing.assert_allclose(starts[:, [0, 3]], warp_at(points)[:, [0, 3]], atol=0.5)
    np.testing.assert_allclose(starts[:, [1, 2, 4, 5]], warp_at(points)[:, [1, 2, 4, 5]], atol=0.06)


def test_without_features_there_is_no_start() -> None:
    source, target = match_features(np.full((60, 60), 7.0), np.full((60, 60), 7.0))
    assert len(source) == len(target) == 0
    assert np.isnan(affine_starts(np.array([[30.0, 30.0]]), source, target)).all()


def test_neighbours_hand_on_their_affine_map() -> None:
    points = np.array([[10.0, 10.0], [31.0, 10.0], [52.0, 31.0], [np.nan, 3.0]])
    known = warp_at(points)
    known[[1, 2]] = np.nan
    starts = neighbour_starts(points, known)
    np.testing.assert_allclose(starts[:3], warp_at(points[:3]), atol=1e-9)
    assert np.isnan(starts[3]).all()
    assert np.isnan(neighbour_starts(points, np.full((4, 6), np.nan))).all()


def test_templates_are_found_around_the_guess() -> None:
    image = np.random.default_rng(42).normal(size=(120, 140))
    moved = np.roll(image, (7, -11), axis=(0, 1))
    points = np.array([[50.2, 60.0], [90.0, 40.4], [2.0, 2.0]])
    shifts = template_shifts(image, moved, points, 8, 15, np.zeros((3, 2)))
    np.testing.assert_array_equal(shifts[:2], [[-11, 7]] * 2)
    assert np.isnan(shifts[2]).all()


def test_one_affine_motion_passes_through_good_points_only() -> None:
    points = np.random.default_rng(43).uniform(0, 200, (12, 2))
    displacement = points @ MATRIX.T + SHIFT - points
    displacement[3] += 40.0
    displacement[5] = np.nan
    targets = np.array([[10.0, 20.0], [150.0, 170.0]])
    np.testing.assert_allclose(affine_field(points, displacement, targets), warp_at(targets), atol=1e-6)
    few = affine_field(points[:2], displacement[:2], targets)
    np.testing.assert_allclose(few[:, [0, 3]], np.tile(displacement[:2].mean(axis=0), (2, 1)))
    assert np.isnan(affine_field(points, np.full_like(displacement, np.nan), targets)).all()


def test_epipolar_distances_of_shifted_cameras_are_row_differences() -> None:
    """Parallel cameras side by side: F = [t]× with t along x, epipolar lines are rows."""
    fundamental = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    left = np.array([[10.0, 20.0], [30.0, 40.0]])
    distance = epipolar_distance(fundamental, left, left + np.array([5.0, 2.0]))
    np.testing.assert_allclose(np.abs(distance), 2.0)
    assert agreeing(np.array([1.0, 1.5, 9.0, np.nan]), 2.0).tolist() == [True, True, False, False]
    assert not agreeing(np.array([np.nan]), 2.0).any()
    with pytest.raises(ValueError, match="fundamental: expected an array of shape"):
        epipolar_distance(np.eye(2), left, left)


# Large motion and wide stereo angles without a start set by hand, against rendered truth.

SIZE = (400, 320)
FOCAL, DISTANCE_M = 2000.0, 0.5
PIXEL_M = DISTANCE_M / FOCAL
CAMERA = Camera(np.array([[FOCAL, 0, 199.5], [0, FOCAL, 159.5], [0, 0, 1.0]]), np.zeros(5), np.array(SIZE))
LEFT_FROM_WORLD = RigidTransform(np.eye(3), np.array([0.0, 0.0, DISTANCE_M]))


@pytest.fixture(scope="module")
def face() -> Face:
    """A round face of 200 px diameter in the world plane z = 0, dots of 4.5 px, blur of 0.7 px."""
    texture = speckle_texture((0.06, 0.06), 4.5 * PIXEL_M, 0.25 * PIXEL_M, 0.7 * PIXEL_M, np.random.default_rng(71))
    axes = np.eye(3)
    return Face(np.zeros(3), axes[0], axes[1], np.full(2, 100 * PIXEL_M), True, texture, 0.7 * PIXEL_M)


def photo(face: Face, camera_from_world: RigidTransform, pose: np.ndarray, seed: int) -> np.ndarray:
    """A 12-bit image with noise of 8 grey levels of the face in `pose` (6,)."""
    image = 4095 * render(view_of(CAMERA, camera_from_world), face, pose[None], np.ones(1))
    noise = np.random.default_rng(seed).normal(0, 8, image.shape)
    return np.clip(np.rint(image + noise), 0, 4095).astype(np.uint16)


def seen(camera_from_world: RigidTransform, pose: np.ndarray, rest_px: np.ndarray) -> np.ndarray:
    """Where a camera sees the points of the moved face that the left camera sees at rest_px (N,2) at rest."""
    rest = np.column_stack([(rest_px - [199.5, 159.5]) * PIXEL_M, np.zeros(len(rest_px))])
    moved = camera_from_world @ RigidTransform.from_pose(pose)
    points = rest @ moved.rotation.T + moved.translation_m
    return np.asarray(CAMERA.project(points))


def grid(middle: tuple[float, float], reach: float) -> np.ndarray:
    """Subset centres 25 px apart in a circle."""
    steps = np.arange(-reach, reach + 1, 25.0)
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return points[np.hypot(*points.T) <= reach] + middle


def followed(frames: list[np.ndarray], points: np.ndarray):
    names = tuple(str(k) for k in range(len(frames)))
    return track_sequence(ImageSequence(names, SIZE, 4095, frames.__getitem__), points, TrackSettings())


@pytest.mark.parametrize(
    ("shift_px", "angle_deg"),
    [((75.0, 0.0), 0.0), ((-60.3, 45.7), 0.0), ((70.2, -26.4), 1.0), ((20.6, -15.2), 20.0), ((-75.0, 10.0), -20.0)],
)
def test_jumps_of_75_px_and_turns_of_20_degrees(face: Face, shift_px: tuple[float, float], angle_deg: float) -> None:
    rest = np.array([*(-0.5 * PIXEL_M * np.asarray(shift_px)), 0, 0, 0, 0])
    moved = np.array([*(0.5 * PIXEL_M * np.asarray(shift_px)), 0, 0, 0, np.radians(angle_deg)])
    points = grid((199.5, 159.5), 75.0)
    tracks = followed(
        [photo(face, LEFT_FROM_WORLD, rest, 1), photo(face, LEFT_FROM_WORLD, moved, 2)],
        seen(LEFT_FROM_WORLD, rest, points),
    )
    assert np.mean(tracks.status[1] == TrackStatus.OK) == 1.0
    error = tracks.position_px[1] - seen(LEFT_FROM_WORLD, moved, points)
    assert np.sqrt(np.mean(error**2)) < 0.02


@pytest.mark.parametrize("order", [1, 2])
def test_cameras_30_degrees_apart(face: Face, order: int) -> None:
    """Both cameras stand 15 degrees off the face's normal; positions against the projected truth."""
    views = []
    for side in (-1.0, 1.0):
        turn = RigidTransform.from_pose(np.array([0, 0, 0, 0, side * np.radians(15), 0]))
        views.append(RigidTransform(turn.rotation, np.array([0.0, 0.0, DISTANCE_M])))
    images = [photo(face, view, np.zeros(6), seed) for seed, view in enumerate(views)]
    points = grid((199.5, 159.5), 75.0)
    left, right = (seen(view, np.zeros(6), points) for view in views)
    rig = StereoRig(CAMERA, CAMERA, views[1] @ views[0].inverse())
    assert np.degrees(np.linalg.norm(rig.right_from_left.pose[3:])) == pytest.approx(30.0)
    tracks = match_stereo(images[0], images[1], left, TrackSettings(shape_order=order))
    found = tracks.status[0] == TrackStatus.OK
    assert found.mean() > 0.95
    assert np.sqrt(np.mean((tracks.position_px[0] - right)[found] ** 2)) < 0.05
