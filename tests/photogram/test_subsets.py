"""Subsets before tracking - texture, grid, quality - and first guesses, against scenes whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from contracts import refused
from speckle import sequence

from photogram.bspline import spline_of_image
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images.image_notices import UNRESOLVED_TEXTURE, UNUSED_SUBSETS
from photogram.images.noise import NoiseModel
from photogram.subsets.icgn import TrackSettings, register
from photogram.subsets.reference import TrackStatus, prepare_reference
from photogram.subsets.search import (
    affine_field,
    affine_starts,
    match_features,
    neighbour_starts,
    template_shifts,
    warp_of_affine,
)
from photogram.subsets.texture import (
    ONE_DIRECTION,
    REASONS,
    aliasing_bias,
    aliasing_notice,
    assess_subsets,
    fine_texture_share,
    place_subsets,
    radius_from_speckle_px,
    speckle_size,
    subset_mean,
    textured_area,
)
from photogram.subsets.track import match_stereo, track_sequence
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of


def disc(shape: tuple[int, int], centre: tuple[float, float], radius: float) -> np.ndarray:
    rows, columns = np.indices(shape)
    return np.hypot(columns - centre[0], rows - centre[1]) < radius


@pytest.fixture(scope="module")
def speckle(make_texture) -> np.ndarray:
    return make_texture(seed=31, s=1.4, waves=80).image((260, 200))


def test_the_body_is_found_its_rim_and_dust_left_out_and_an_image_full_of_texture_is_all_body(speckle):
    rng = np.random.default_rng(31)
    body = disc(speckle.shape, (130, 100), 80)
    shading = np.linspace(200, 900, 260)[None, :]
    image = np.where(body, 1800 + 500 * speckle, shading) + rng.normal(0, 8, speckle.shape)
    area = textured_area(image)
    assert not np.any(area & ~body)
    assert area.sum() > 0.8 * body.sum()
    assert textured_area(2000 + 500 * speckle).all()
    assert textured_area(np.full((60, 60), 7.0)).all()
    body, dust = disc(speckle.shape, (90, 100), 70), disc(speckle.shape, (230, 30), 14)
    image = np.where(body | dust, 1800 + 500 * speckle, 300) + np.random.default_rng(32).normal(0, 8, speckle.shape)
    assert not np.any(textured_area(image) & dust)


def test_subsets_fill_a_rectangle_completely_and_a_small_area_has_none():
    area = np.zeros((80, 120), bool)
    area[5:75, 10:115] = True
    points = place_subsets(area, 10, 21)
    assert len(points) == 3 * 5
    assert np.all(subset_mean(area, points, 10) == 1.0)
    assert place_subsets(disc((50, 50), (25, 25), 12), 10, 21).shape == (0, 2)
    refused("^radius_px, step_px: .* 1", place_subsets, np.ones((9, 9), bool), 0, 1)


def test_subsets_neither_overlap_nor_leave_the_area():
    area = disc((300, 340), (170, 150), 140)
    area[100:130, 60:90] = False
    points = place_subsets(area, 10, 21)
    apart = np.abs(points[:, None] - points[None]).max(axis=2) + 99 * np.eye(len(points))
    assert apart.min() >= 21
    assert np.all(subset_mean(area, points, 10) == 1.0)
    assert len(points) * 21**2 > 0.8 * area.sum()
    regular = np.stack(np.meshgrid(np.arange(10, 340, 21), np.arange(10, 300, 21)), -1).reshape(-1, 2)
    assert len(points) > np.sum(subset_mean(area, regular, 10) == 1.0)


def test_subset_mean_is_the_mean():
    values = np.random.default_rng(33).normal(size=(40, 50))
    points = np.array([[20.0, 20.4], [30.2, 15.0], [np.nan, 3.0]])
    expected = [values[17:24, 17:24].mean(), values[12:19, 27:34].mean(), 0.0]
    np.testing.assert_allclose(subset_mean(values, points, 3), expected)


@pytest.mark.parametrize("s", [0.9, 1.4, 2.2])
def test_speckle_size_is_the_width_of_the_known_autocorrelation(make_texture, s):
    """exp(−l²/4s²) falls to one half at l = 2 s √ln 2."""
    image = 2000 + 500 * make_texture(seed=34, s=s).image((240, 200))
    image += np.random.default_rng(34).normal(0, 25, image.shape)
    area = disc(image.shape, (120, 100), 95)
    assert speckle_size(image, area) == pytest.approx(4 * s * np.sqrt(np.log(2)), rel=0.1)


def test_unresolved_texture_is_seen_through_the_noise(make_texture):
    rng, area = np.random.default_rng(35), np.ones((200, 240), bool)
    shares = {}
    for s in (0.55, 0.8, 1.4):
        image = 2000 + 400 * make_texture(seed=35, s=s).image((240, 200)) + rng.normal(0, 12, (200, 240))
        shares[s] = fine_texture_share(image, area, 12.0)
    assert shares[1.4] < 5e-4
    assert shares[0.55] > 2e-2
    assert shares[0.55] > shares[0.8] > shares[1.4]
    assert np.isnan(fine_texture_share(np.ones((20, 20)), np.ones((20, 20), bool), 0.0))


# What is said of subsets before tracking, against what tracking of rendered images then shows.

FOCAL_PX, PIXEL_M = 1500.0, 0.2e-3
SIZE = (220, 180)
SENSOR = ImageSensor()
NOISE = NoiseModel(36.0 + 1 / 12, 1 / 8)
INNER = np.pad(np.ones((SIZE[1] - 16, SIZE[0] - 16), bool), 8)


def images(dot_px: float, blur_px: float, shifts_px: np.ndarray, seed: int = 1) -> list[np.ndarray]:
    """Fractions of full scale of a face with dots behind a lens blur, shifted along x."""
    matrix = np.array([[FOCAL_PX, 0, (SIZE[0] - 1) / 2], [0, FOCAL_PX, (SIZE[1] - 1) / 2], [0, 0, 1.0]])
    down = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, FOCAL_PX * PIXEL_M]))
    view = view_of(Camera(matrix, np.zeros(5), np.array(SIZE)), down, 0.0)
    extent = (SIZE[0] * PIXEL_M * 1.1, SIZE[1] * PIXEL_M * 1.1)
    texture = speckle_texture(extent, dot_px * PIXEL_M, PIXEL_M / 5, blur_px * PIXEL_M, np.random.default_rng(seed))
    face = Face(np.zeros(3), np.eye(3)[0], np.eye(3)[1], np.array([0.2, 0.2]), False, texture, PIXEL_M)
    poses = np.zeros((len(shifts_px), 6))
    poses[:, 0] = shifts_px * PIXEL_M
    return [render(view, face, pose[None], np.ones(1), 4) for pose in poses]


def test_predicted_sigma_is_the_scatter_of_tracking():
    rng, radius = np.random.default_rng(2), 10
    still, moved = images(5.0, 1.2, np.array([0.0, 0.4]))
    first = SENSOR.digitise(still, rng)
    reference = prepare_reference(spline_of_image(first), place_subsets(INNER, radius, 2 * radius + 1), radius)
    quality = assess_subsets(reference, first, NOISE, SENSOR.full_scale)
    assert quality.usable.all()
    assert quality.notices("left camera") == ()
    start = np.zeros((len(reference.centre_px), 6))
    start[:, 0] = 0.4
    found = [
        register(reference, spline_of_image(SENSOR.digitise(moved, rng)), start, TrackSettings()).warp[:, [0, 3]]
        for _ in range(60)
    ]
    scatter = np.std(found, axis=0, ddof=1)
    np.testing.assert_allclose(np.sqrt(np.mean((scatter / quality.predicted_sigma_px) ** 2, axis=0)), 1.0, atol=0.1)
    np.testing.assert_allclose(scatter / quality.predicted_sigma_px, 1.0, atol=0.4)


def test_unusable_subsets_are_distinguished_and_counted():
    image = SENSOR.digitise(images(5.0, 1.2, np.zeros(1))[0], np.random.default_rng(3))
    image[20:60, 20:60] = 4095
    image[100:150, 100:150] = np.random.default_rng(4).normal(1000, 12, (50, 50)).astype(np.uint16)
    image[80:130, 20:70] = 1000 + 2000 * (np.arange(50) > 25) + np.random.default_rng(5).normal(0, 12, (50, 50))
    centres = np.array([[90.0, 40.0], [40.0, 40.0], [125.0, 125.0], [4.0, 90.0], [np.nan, np.nan], [45.0, 105.0]])
    quality = assess_subsets(prepare_reference(spline_of_image(image), centres, 10), image, NOISE, 4095)
    expected = [TrackStatus.OK, TrackStatus.SATURATED, TrackStatus.FLAT, TrackStatus.LEFT_IMAGE, TrackStatus.NO_START]
    expected.append(TrackStatus.OK)  # an edge, across which it is tracked
    assert quality.status.tolist() == expected
    assert np.isfinite(quality.predicted_sigma_px).all(axis=1).tolist() == quality.usable.tolist()
    (notice,) = quality.notices("left camera")
    assert notice.code == UNUSED_SUBSETS.code
    assert (notice.values["unused"], notice.values["subsets"]) == (5, 6)
    reasons = [REASONS[status] for status in REASONS if status in expected]
    assert notice.values["reasons"] == ", ".join(f"1 {reason}" for reason in [*reasons, ONE_DIRECTION])


@pytest.mark.parametrize(("dot_px", "blur_px"), [(5.0, 0.6), (5.0, 0.4), (5.0, 0.0), (4.0, 0.8), (2.8, 0.0)])
def test_bias_of_unresolved_texture_is_predicted(dot_px, blur_px):
    """Amplitude over the pixel of the error of noise-free subsets, within a factor of 2; of their mean within 2.5."""
    shifts = np.arange(8) / 8
    frames = [4095 * frame for frame in images(dot_px, blur_px, shifts)]
    reference = prepare_reference(spline_of_image(frames[0]), place_subsets(INNER, 10, 21), 10)
    errors, exact = [], TrackSettings(convergence_px=1e-6, min_zncc=0.5)
    for frame, shift in zip(frames, shifts, strict=True):
        start = np.zeros((len(reference.centre_px), 6))
        start[:, 0] = shift
        errors.append(register(reference, spline_of_image(frame), start, exact).warp[:, 0] - shift)
    wave = np.exp(-2j * np.pi * shifts) / 4
    single = np.sqrt(np.nanmean(np.abs(wave @ np.array(errors)) ** 2))
    mean = np.abs(wave @ np.nanmean(errors, axis=1))
    noisy = frames[0] + np.random.default_rng(5).normal(0, 12, frames[0].shape)
    bias = aliasing_bias(noisy, INNER, 12.0, 10)
    assert 0.5 < bias.subset_px / single < 2.0
    assert 0.4 < bias.mean_px / mean < 2.5
    notice = aliasing_notice(noisy, INNER, 12.0, speckle_size(noisy, INNER), bias, "left camera")
    assert (notice is None) == (blur_px == 0.8)
    if notice is not None:
        assert notice.code == UNRESOLVED_TEXTURE.code
        assert (notice.values["mean_bias_px"], notice.values["subset_bias_px"]) == (bias.mean_px, bias.subset_px)


def test_soft_speckle_is_not_complained_of(make_texture):
    image = SENSOR.digitise(images(5.0, 1.2, np.zeros(1))[0], np.random.default_rng(6))
    bias = aliasing_bias(image, INNER, 18.0, 10)
    assert bias.mean_px < 1.5e-4
    assert aliasing_notice(image, INNER, 18.0, speckle_size(image, INNER), bias, "left camera") is None
    assert aliasing_bias(image, INNER, 18.0, 10, degree=3).mean_px > 3e-4  # cubic splines have a bias of their own
    small = make_texture(seed=5).image((30, 30))
    assert np.isnan(aliasing_bias(small, np.ones((30, 30), bool), 1.0, 10).mean_px), "no room, no answer"


@pytest.mark.parametrize(("speckle_px", "radius"), [(4.0, 10), (4.5, 10), (5.0, 10), (3.0, 7), (8.0, 17), (30.0, 25)])
def test_radius_follows_the_speckle(speckle_px, radius):
    assert radius_from_speckle_px(speckle_px) == radius
    assert radius_from_speckle_px(float("nan")) == 10


# First guesses: features and affine starts, templates, fields through few points.

MATRIX = np.array([[0.87, 0.02], [-0.05, 1.01]])
SHIFT = np.array([14.0, -6.0])


def warp_at(points: np.ndarray) -> np.ndarray:
    """The warp of x → MATRIX x + SHIFT at each point."""
    warps = np.tile(warp_of_affine(np.column_stack([MATRIX, SHIFT])), (len(points), 1))
    warps[:, [0, 3]] = points @ MATRIX.T + SHIFT - points
    return warps


def test_features_of_speckle_give_affine_starts(make_texture):
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
    source, target = match_features(np.full((60, 60), 7.0), np.full((60, 60), 7.0))
    assert len(source) == len(target) == 0
    assert np.isnan(affine_starts(np.array([[30.0, 30.0]]), source, target)).all()


def test_neighbours_hand_on_their_affine_map():
    points = np.array([[10.0, 10.0], [31.0, 10.0], [52.0, 31.0], [np.nan, 3.0]])
    known = warp_at(points)
    known[[1, 2]] = np.nan
    starts = neighbour_starts(points, known)
    np.testing.assert_allclose(starts[:3], warp_at(points[:3]), atol=1e-9)
    assert np.isnan(starts[3]).all()
    assert np.isnan(neighbour_starts(points, np.full((4, 6), np.nan))).all()


def test_templates_are_found_around_the_guess():
    image = np.random.default_rng(42).normal(size=(120, 140))
    moved = np.roll(image, (7, -11), axis=(0, 1))
    points = np.array([[50.2, 60.0], [90.0, 40.4], [2.0, 2.0]])
    shifts = template_shifts(image, moved, points, 8, 15, np.zeros((3, 2)))
    np.testing.assert_array_equal(shifts[:2], [[-11, 7]] * 2)
    assert np.isnan(shifts[2]).all()


def test_one_affine_motion_passes_through_good_points_only():
    points = np.random.default_rng(43).uniform(0, 200, (12, 2))
    displacement = points @ MATRIX.T + SHIFT - points
    displacement[3] += 40.0
    displacement[5] = np.nan
    targets = np.array([[10.0, 20.0], [150.0, 170.0]])
    np.testing.assert_allclose(affine_field(points, displacement, targets), warp_at(targets), atol=1e-6)
    few = affine_field(points[:2], displacement[:2], targets)
    np.testing.assert_allclose(few[:, [0, 3]], np.tile(displacement[:2].mean(axis=0), (2, 1)))
    assert np.isnan(affine_field(points, np.full_like(displacement, np.nan), targets)).all()


# Large motion and wide stereo angles without a start set by hand, against rendered truth.

PICTURE_SIZE = (400, 320)
FOCAL, DISTANCE_M = 2000.0, 0.5
SCALE_M = DISTANCE_M / FOCAL
CAMERA = Camera(np.array([[FOCAL, 0, 199.5], [0, FOCAL, 159.5], [0, 0, 1.0]]), np.zeros(5), np.array(PICTURE_SIZE))
LEFT_FROM_WORLD = RigidTransform(np.eye(3), np.array([0.0, 0.0, DISTANCE_M]))


@pytest.fixture(scope="module")
def face() -> Face:
    """A round face of 200 px diameter in the world plane z = 0, dots of 4.5 px, blur of 0.7 px."""
    texture = speckle_texture((0.06, 0.06), 4.5 * SCALE_M, 0.25 * SCALE_M, 0.7 * SCALE_M, np.random.default_rng(71))
    axes = np.eye(3)
    return Face(np.zeros(3), axes[0], axes[1], np.full(2, 100 * SCALE_M), True, texture, 0.7 * SCALE_M)


def photo(face: Face, camera_from_world: RigidTransform, pose: np.ndarray, seed: int) -> np.ndarray:
    """A 12-bit image with noise of 8 grey levels of the face in `pose` (6,)."""
    image = 4095 * render(view_of(CAMERA, camera_from_world), face, pose[None], np.ones(1))
    noise = np.random.default_rng(seed).normal(0, 8, image.shape)
    return np.clip(np.rint(image + noise), 0, 4095).astype(np.uint16)


def seen(camera_from_world: RigidTransform, pose: np.ndarray, rest_px: np.ndarray) -> np.ndarray:
    """Where a camera sees the points of the moved face that the left camera sees at rest_px (N,2) at rest."""
    rest = np.column_stack([(rest_px - [199.5, 159.5]) * SCALE_M, np.zeros(len(rest_px))])
    moved = camera_from_world @ RigidTransform.from_pose(pose)
    points = rest @ moved.rotation.T + moved.translation_m
    return np.asarray(CAMERA.project(points))


def grid(middle: tuple[float, float], reach: float) -> np.ndarray:
    """Subset centres 25 px apart in a circle."""
    steps = np.arange(-reach, reach + 1, 25.0)
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return points[np.hypot(*points.T) <= reach] + middle


@pytest.mark.parametrize(
    ("shift_px", "angle_deg"),
    [((75.0, 0.0), 0.0), ((-60.3, 45.7), 0.0), ((70.2, -26.4), 1.0), ((20.6, -15.2), 20.0), ((-75.0, 10.0), -20.0)],
)
def test_jumps_of_75_px_and_turns_of_20_degrees(face, shift_px, angle_deg):
    rest = np.array([*(-0.5 * SCALE_M * np.asarray(shift_px)), 0, 0, 0, 0])
    moved = np.array([*(0.5 * SCALE_M * np.asarray(shift_px)), 0, 0, 0, np.radians(angle_deg)])
    points = grid((199.5, 159.5), 75.0)
    frames = [photo(face, LEFT_FROM_WORLD, rest, 1), photo(face, LEFT_FROM_WORLD, moved, 2)]
    tracks = track_sequence(sequence(frames), seen(LEFT_FROM_WORLD, rest, points), TrackSettings())
    assert np.mean(tracks.status[1] == TrackStatus.OK) == 1.0
    error = tracks.position_px[1] - seen(LEFT_FROM_WORLD, moved, points)
    assert np.sqrt(np.mean(error**2)) < 0.02


@pytest.mark.parametrize("order", [1, 2])
def test_cameras_at_30_degrees(face, order):
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
