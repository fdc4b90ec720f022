"""Which point is which: matches along epipolar lines against rendered truth; patterns that repeat, also in time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from contracts import refused
from speckle import FOCAL, PIXEL_M, SENSOR, camera, face, sequence

from photogram.bspline import spline_of_image
from photogram.camera import RIG_PARAMETERS, Camera, StereoRig, epipolar_residual
from photogram.geometry import RigidTransform
from photogram.images.sequence import ImageSequence
from photogram.measure import body as measure
from photogram.measure import follow
from photogram.subsets.find import DepthRange, drop_disagreeing, identity_registration
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.reference import TrackStatus, prepare_reference
from photogram.subsets.search import agreeing_neighbours, template_shifts
from photogram.subsets.sweep import TOLERANCE_PX, fit_surfaces, line_starts, line_uncertainty_px
from photogram.subsets.texture import repeat_distance_px, repeat_steps_px
from photogram.subsets.track import StereoGrid, lay_stereo_grid, match_stereo, stereo_tracks, track_stereo
from photogram.synthetic.scene import Face, render, tile_texture, view_of

MIDDLE = (160, 128)
PERIOD_M = 0.032  # twice in the 64 mm that a camera sees
WRONG_PX = 0.5
BEYOND, ENDS_IN_VIEW = (0.06, 0.05), (0.024, 0.02)  # half sizes of the face


def turned(body: Face, degrees: tuple[float, float, float]) -> Face:
    """The face turned about x, y and z."""
    turn = RigidTransform.from_pose(np.array([0, 0, 0, *np.radians(degrees)])).rotation
    return replace(body, axis_u=turn @ body.axis_u, axis_v=turn @ body.axis_v)


def foil(half_m: tuple[float, float], turn_deg: float = 0.0, period_m: float = PERIOD_M) -> Face:
    """A face in the plane z = 0 with a foil printed from one tile."""
    return turned(replace(face(half_m, 5), texture=tile_texture(wide(5), period_m)), (0, 0, turn_deg))


@cache
def wide(seed: int):  # type: ignore[no-untyped-def]
    """Speckle over 120 mm."""
    from photogram.synthetic.scene import speckle_texture

    return speckle_texture((0.12, 0.12), 5 * PIXEL_M, PIXEL_M / 3, 1.2 * PIXEL_M, np.random.default_rng(seed))


class Pair:
    """Two cameras before a face."""

    def __init__(self, body: Face, angle_deg: float = 28.0) -> None:
        self.body, self.camera = body, camera(MIDDLE, (-0.1, 0.02, 0, 0, 0))
        away = RigidTransform(np.eye(3), np.array([0, 0, FOCAL * PIXEL_M]))
        half = np.radians(angle_deg) / 2
        self.places = [away @ RigidTransform.from_pose(np.array([0, 0, 0, 0, turn, 0])) for turn in (-half, half)]
        self.rig = StereoRig(self.camera, self.camera, self.places[1] @ self.places[0].inverse())

    def images(self, noise_seed: int, shifts_m: tuple[float, ...] = (0.0,)) -> tuple[ImageSequence, ImageSequence]:
        """Both cameras' pictures of the face moved along x."""
        rng = np.random.default_rng(noise_seed)
        poses = [np.array([[shift, 0, 0, 0, 0, 0.0]]) for shift in shifts_m]
        sides = [
            [SENSOR.digitise(render(view_of(self.camera, place), self.body, pose, np.ones(1)), rng) for pose in poses]
            for place in self.places
        ]
        return sequence(sides[0]), sequence(sides[1])

    def right(self, left_px: np.ndarray) -> np.ndarray:
        """Where the points of the face at left_px (N,2) truly are in the right picture."""
        rays = np.column_stack([self.camera.undistort(left_px), np.ones(len(left_px))])
        normal = self.places[0].rotation @ np.cross(self.body.axis_u, self.body.axis_v)
        depth = self.places[0].translation_m @ normal / (rays @ normal)
        return self.rig.project(rays * depth[:, None])[1]

    def matched(self, noise_seed: int, depth_m: DepthRange | None = None) -> StereoGrid:
        return lay_stereo_grid(*self.images(noise_seed), self.rig, TrackSettings(), depth_m)

    def wrong(self, grid: StereoGrid) -> int:
        return int(np.sum(np.hypot(*(grid.right_px - self.right(grid.left_px)).T) > WRONG_PX))


FEW, MANY = range(1), [pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 10)]


@pytest.mark.parametrize("seed", [*FEW, *MANY])
@pytest.mark.parametrize(
    ("half_m", "turn_deg"),
    [(BEYOND, 3.5), (ENDS_IN_VIEW, 0.0)],
    ids=["copies off the epipolar lines", "copies along them, ends of the foil in view"],
)
def test_a_foil_that_repeats_twice_in_view_is_matched_right_whatever_the_noise(half_m, turn_deg, seed):
    pair = Pair(foil(half_m, turn_deg))
    grid = pair.matched(seed)
    assert pair.wrong(grid) == 0
    assert len(grid.left_px) >= 60
    assert grid.notices == ()


@pytest.mark.parametrize("seed", [*FEW, *MANY])
def test_copies_along_the_epipolar_lines_are_refused_unless_the_depth_is_stated(seed):
    """Each camera sees nothing but copies of the tile: a second plane fits all that both would see of it."""
    pair = Pair(foil(BEYOND))
    refused(r"^right: .* 0\.\d+ m .* 0\.\d+ m ", pair.matched, seed)
    grid = pair.matched(seed, (0.25, 0.33))
    assert pair.wrong(grid) == 0
    assert len(grid.left_px) >= 100


def test_many_copies_in_view_are_neither_mixed_nor_taken_for_each_other():
    pair = Pair(foil(ENDS_IN_VIEW, period_m=0.009))
    grid = pair.matched(3)
    assert pair.wrong(grid) == 0
    assert len(grid.left_px) >= 60


@pytest.mark.parametrize(
    ("angle_deg", "tilt_deg", "share"), [(28.0, (0, 0, 0), 0.98), (45.0, (15, 15, 0), 0.9), (60.0, (-15, 20, 0), 0.85)]
)
def test_steep_pairs_and_tilted_faces(angle_deg, tilt_deg, share):
    pair = Pair(turned(face(ENDS_IN_VIEW, 6), tilt_deg), angle_deg)
    grid = pair.matched(1)
    points, error = grid.left_px, grid.right_px - pair.right(grid.left_px)
    assert np.sqrt(np.mean(error**2)) < 0.04
    free = lay_stereo_grid(*pair.images(1), None, TrackSettings())
    assert len(points) >= share * len(free.left_px)


def test_a_bent_body_and_one_of_two_parts_are_found_whole(make_texture):
    """A cylinder of 50 mm radius, and two plates 12 mm apart in depth; one plane does not hold either."""
    pair, texture = Pair(face(BEYOND, 1)), make_texture(seed=3, s=1.4, waves=80)
    pixels = np.indices((2 * MIDDLE[1], 2 * MIDDLE[0]))[::-1].reshape(2, -1).T.astype(float)
    for radius_m, step_m in ((0.05, 0.0), (np.inf, 0.012)):
        images, ends = [], []
        for place in pair.places:
            world = place.inverse()
            rays = np.column_stack([pair.camera.undistort(pixels), np.ones(len(pixels))]) @ world.rotation.T
            start, end = world.translation_m, np.full((len(rays), 3), np.nan)
            if np.isfinite(radius_m):  # a cylinder along y whose front line is the world's y axis, facing −z
                axis = start - np.array([0.0, 0.0, radius_m])
                a, b = np.sum(rays[:, [0, 2]] ** 2, axis=1), rays[:, [0, 2]] @ axis[[0, 2]]
                root = np.sqrt(np.maximum(b**2 - a * (np.sum(axis[[0, 2]] ** 2) - radius_m**2), 0.0))
                end = start + ((-b - root) / a)[:, None] * rays
                inside = (np.abs(end[:, 0]) < 0.026) & (np.abs(end[:, 1]) < 0.02)
                flat = np.column_stack([radius_m * np.arcsin(np.clip(end[:, 0] / radius_m, -1, 1)), end[:, 1]])
            else:
                inside = np.zeros(len(rays), dtype=np.bool_)
                for depth, sign in ((0.0, -1.0), (step_m, 1.0)):
                    hit = start + ((depth - start[2]) / rays[:, 2])[:, None] * rays
                    here = (np.abs(hit[:, 0]) < 0.024) & (sign * hit[:, 1] > 0.001) & (np.abs(hit[:, 1]) < 0.021)
                    end[here & ~inside] = hit[here & ~inside]
                    inside |= here
                flat = np.nan_to_num(end[:, :2])
            print_ = np.concatenate([texture(part) for part in np.array_split(flat / PIXEL_M, 64)])
            grey = 300 + inside * (1500 + 400 * print_)
            noise = np.random.default_rng(len(images)).normal(0, 6, len(grey))
            images.append(np.clip(np.rint(grey + noise), 0, 4095).reshape(2 * MIDDLE[1], -1).astype(np.uint16))
            ends.append(np.where(inside[:, None], end, np.nan).reshape(*images[0].shape, 3))
        grid = lay_stereo_grid(sequence([images[0]]), sequence([images[1]]), pair.rig, TrackSettings())
        column, row = grid.left_px.astype(int).T
        truth = pair.camera.project(pair.places[1].apply(ends[0][row, column]))
        free = lay_stereo_grid(sequence([images[0]]), sequence([images[1]]), None, TrackSettings())
        error = np.hypot(*(grid.right_px - truth).T)
        assert np.nanmax(error[np.abs(row - MIDDLE[1]) > 12]) < 0.2  # where the plates meet subsets see both
        assert len(grid.left_px) >= len(free.left_px) >= 50


# The parts.


def test_lines_pass_through_the_truth_within_a_step():
    pair = Pair(turned(face(ENDS_IN_VIEW, 6), (10, 15, 0)), 40.0)
    left, right = (side.read(0) for side in pair.images(2))
    points = np.stack(np.meshgrid([110.0, 150.0, 200.0], [80.0, 120.0, 170.0]), axis=-1).reshape(-1, 2)
    starts, band_px = line_starts((left, right), pair.rig, points, 10)
    assert band_px == TOLERANCE_PX
    off = np.hypot(*np.moveaxis(points + starts[0][:, [0, 3]] - pair.right(points), -1, 0))
    assert off.max() < 1.2  # half a step along, the line beside it across
    step = 1e-3  # affine part: differences of the projected truth
    for axis, columns in enumerate(([1, 4], [2, 5])):
        shift = step * np.eye(2)[axis]
        true = (pair.right(points + shift) - pair.right(points - shift)) / (2 * step) - np.eye(2)[axis]
        assert np.abs(starts[0][:, columns] - true).max() < 0.2


def test_an_uncertain_calibration_widens_the_band():
    """Of a turn about the right camera's x axis, against the residual that such a turn makes."""
    spread = np.zeros(len(RIG_PARAMETERS))
    turn = RIG_PARAMETERS.index("rotation.x")
    spread[turn] = 1.5e-3
    pair, middle = Pair(face(ENDS_IN_VIEW, 6)), np.array([[160.0, 128.0]])
    rig = replace(pair.rig, covariance=np.diag(spread**2))
    images = tuple(side.read(0) for side in pair.images(2))
    wrong = rig.perturbed(3.3 * spread)  # beyond the usual band
    off = float(np.abs(epipolar_residual(wrong, middle, pair.right(middle))[0][0]))
    assert 3.3 * line_uncertainty_px(rig, middle, pair.right(middle)) == pytest.approx(off, rel=0.02)
    assert line_uncertainty_px(pair.rig, middle, pair.right(middle)) == 0.0
    starts, band_px = line_starts(images, wrong, middle, 10)
    assert band_px > 0.9 * off > 2.5 * TOLERANCE_PX
    away = np.hypot(*(middle + starts[:, 0, [0, 3]] - pair.right(middle)).T)
    assert np.nanmin(away) < 1.5


def test_surfaces_are_separated_and_strays_rejected():
    """Points of two planes as two candidates each; a fifth of them stray."""
    rng = np.random.default_rng(4)
    one = Camera.from_parameters(np.array([1500.0, 1500, 160, 128, 0, 0, 0, 0, 0]), np.array([320, 256]))
    rig = StereoRig(one, one, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    left = rng.uniform(20, 236, (40, 2))
    rays = np.column_stack([one.undistort(left), np.ones(40)])
    planes = np.array([[0.3, -0.2, 3.3], [0.1, 0.4, 2.6]])
    right = np.stack([rig.project(rays / (rays @ plane)[:, None])[1] for plane in planes])
    right[1, 25:] = np.nan
    right[0, :8, 0] += rng.uniform(20, 60, 8)
    first, second, *_ = fit_surfaces(rig, left, right)
    assert (first == [-1] * 8 + [0] * 32).all()
    assert (second == [1] * 25 + [-1] * 15).all()
    assert fit_surfaces(rig, left, np.full_like(right, np.nan)) == []


def test_the_distance_of_copies_is_found_if_there_are_any():
    pair, single = Pair(foil(BEYOND, period_m=0.01)), Pair(face(ENDS_IN_VIEW, 6))
    points = np.stack(np.meshgrid(np.arange(60.0, 260, 25), np.arange(60.0, 200, 25)), axis=-1).reshape(-1, 2)
    found = repeat_distance_px(pair.images(1)[0].read(0), points, 10)
    assert found == pytest.approx(50.0 * np.cos(np.radians(14)), abs=2.0)  # 10 mm, seen 14° off its normal
    assert np.isnan(repeat_distance_px(single.images(1)[0].read(0), points, 10))
    steps = repeat_steps_px(pair.images(1)[0].read(0), points, 10)
    for true in ((found, 0.0), (-found, 0.0), (0.0, 50.0), (0.0, -50.0)):
        assert np.hypot(*(steps - true).T).min() < 2.0
    assert repeat_steps_px(single.images(1)[0].read(0), points, 10).shape == (0, 2)


def test_of_several_copies_the_one_next_to_the_guess_is_taken(make_texture):
    """The tile repeats after 40 px; noise made either copy the highest peak, by chance."""
    tile = make_texture(seed=9, s=1.4, waves=60)
    image = 2000 + 400 * tile.image((240, 120), lambda p: np.column_stack([np.mod(p[:, 0], 40.0), p[:, 1]]))
    points = np.array([[60.0, 60.0], [70.0, 62.0], [120.0, 55.0]])
    for seed in range(8):
        first, second = (image + np.random.default_rng((seed, k)).normal(0, 20, image.shape) for k in range(2))
        moved = np.roll(second, (0, 14), axis=(0, 1))
        shifts = template_shifts(first, moved, points, 10, 60, np.full((3, 2), [2.0, 0.0]))
        np.testing.assert_array_equal(shifts, np.full((3, 2), [14.0, 0.0]))


def test_a_subset_on_a_copy_while_its_neighbours_are_not_is_lost(make_texture):
    image = 2000 + 400 * make_texture(seed=9, s=1.4, waves=60).image((160, 160))
    points = np.stack(np.meshgrid(np.arange(30.0, 140, 21), np.arange(30.0, 140, 21)), axis=-1).reshape(-1, 2)
    reference = prepare_reference(spline_of_image(image), points, 10)
    found = identity_registration(reference)
    turn = np.radians(8.0)  # all turn together, one is a copy of 40 px beside that
    turned_px = (points - 80) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + 80
    found.warp[:, [0, 3]] = turned_px - points
    found.warp[:, [1, 2, 4, 5]] = np.cos(turn) - 1, -np.sin(turn), np.sin(turn), np.cos(turn) - 1
    assert (agreeing_neighbours(points, found.warp) == 1.0).all()
    found.warp[14, 0] += 40.0
    held = drop_disagreeing(reference, found)
    assert np.flatnonzero(held.status != TrackStatus.OK).tolist() == [14]
    assert np.isnan(held.warp[14]).all()


STEPS = [(-1.2, 0.0), (-0.9, 0.02), (0.85, 0.1), (1.0, 0.0), (1.25, -0.1)]


def test_a_jump_by_a_period_is_refused_where_no_end_of_the_foil_is_visible(monkeypatch):
    """Copies 49 px apart in the left picture: a block that begins at 29 px finds the copy at −20 px, next to rest."""
    monkeypatch.setattr(follow, "BLOCK_FRAMES", 3)
    for half_m, depth_m in ((ENDS_IN_VIEW, None), (BEYOND, (0.25, 0.33))):
        pair = Pair(foil(half_m, 3.5, 0.01))
        shifts = PIXEL_M * 40.0 * np.sin(0.4 * np.arange(4))
        images = pair.images(2, tuple(shifts))
        if half_m is ENDS_IN_VIEW:
            body = measure.measure_body(images, pair.rig, pair.places[0].inverse(), TrackSettings())
            np.testing.assert_allclose(body.motion.pose[:, 0], shifts, atol=0.02 * PIXEL_M)
        else:
            words = r"^left: .* \d\d\.\d px in frame 2 .* 4\d\.\d px"
            place, settings = pair.places[0].inverse(), TrackSettings()
            refused(words, measure.measure_body, images, pair.rig, place, settings, None, "cpu", depth_m)


@pytest.mark.parametrize(
    "steps",
    [(-1.1, 0.1), *(pytest.param(step, marks=pytest.mark.slow) for step in STEPS)],
)
def test_a_body_that_moved_by_about_a_period_is_not_confused_with_its_copy(steps):
    """The end of the foil is in view: the copy, nearer than the body, lacks its subsets. From the second frame on."""
    pair, period_m = Pair(foil(ENDS_IN_VIEW, 3.5, 0.01)), 0.01
    images = pair.images(4, (0.0, period_m * steps[0], period_m * (steps[0] + steps[1])))
    words = r"^left: .* \d+\.\d px in frame \d"
    refused(words, measure.measure_body, images, pair.rig, pair.places[0].inverse(), TrackSettings())


def test_a_copy_in_one_camera_alone_is_lost_and_the_whole_body_on_copies_refused():
    """In frame 1 by a period in y, across the epipolar lines: some subsets, and all of them."""
    pair = Pair(foil(ENDS_IN_VIEW, 3.5, 0.01))
    images = pair.images(2, (0.0, 0.5 * PIXEL_M, PIXEL_M))
    good = track_stereo(*images, pair.rig, TrackSettings())
    firsts, grid = (images[0].read(0), images[1].read(0)), lay_stereo_grid(*images, pair.rig, TrackSettings())
    assert (good.left.status == TrackStatus.OK).mean() > 0.97
    for which in ([3, 17], range(len(grid.left_px))):
        moved = good.right.position_px.copy()
        moved[1, which, 1] += 50.0
        both = (good.left, replace(good.right, position_px=moved))
        if len(which) > 2:
            refused(
                r"^right: .* 50\.\d px .* frame 1 ",
                stereo_tracks,
                firsts,
                grid,
                both,
                TrackSettings(),
                pair.rig,
            )
            continue
        found = stereo_tracks(firsts, grid, both, TrackSettings(), pair.rig)
        for side, before in ((found.left, good.left), (found.right, good.right)):
            lost = np.argwhere((side.status != TrackStatus.OK) & (before.status == TrackStatus.OK))
            assert lost.tolist() == [[1, 3], [1, 17]]
            assert np.isnan(side.position_px[1, which]).all()


def test_copies_off_the_lines_are_refused_where_the_calibration_finds_no_surface():
    """Without a surface on the lines features match copies 16 px beside them: never to be fused."""
    pair = Pair(foil(ENDS_IN_VIEW, 0.0))
    left, right = pair.images(1)
    tilt = RigidTransform.from_pose(np.array([0, 0, 0, 0.011, 0, 0]))
    wrong = replace(pair.rig, right_from_left=tilt @ pair.rig.right_from_left)
    assert np.abs(epipolar_residual(wrong, np.array([[160.0, 128]]), pair.right(np.array([[160.0, 128]])))[0]) > 10
    refused(r"^right: .* \d+\.\d px .* \d+\.\d px", lay_stereo_grid, left, right, wrong, TrackSettings())


def test_without_a_calibration_matching_is_by_features():
    pair = Pair(face(ENDS_IN_VIEW, 6))
    left, right = pair.images(1)
    points = np.array([[150.0, 120.0], [180.0, 140.0], [120.0, 100.0]])
    settings = TrackSettings()
    both = [match_stereo(left.read(0), right.read(0), points, settings, rig) for rig in (None, pair.rig)]
    np.testing.assert_allclose(both[0].position_px, both[1].position_px, atol=5e-3)
    assert track_stereo(left, right, pair.rig, settings).notices == track_stereo(left, right, None, settings).notices
