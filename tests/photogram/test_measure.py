"""A body through a stereo series, and its six components from the grey values: rendered truth, Monte Carlo."""

from __future__ import annotations

import pickle
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from contracts import NEEDS_GPU, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from speckle import PIXEL_M, SENSOR, Stereo, camera, face, render_images, sequence, spline_frames, two_poses

from photogram import frame_statistics
from photogram.bspline import Spline, evaluate, spline_of_image
from photogram.camera import Camera, StereoRig
from photogram.direct import direct_fit, fit_torch
from photogram.direct.cells import MIN_FILLED_SHARE, compare_cells, lay_cells, pixel_residuals, prepare_cells
from photogram.direct.direct_fit import (
    BodyView,
    DirectFit,
    coarse_fit,
    fit_direct,
    image_noise,
    rest_covariance,
    view_body,
)
from photogram.direct.fit_torch import fit_frames, torch_project, torch_view
from photogram.direct.surface import PlacedCamera, body_patches, patch_rates, patch_warps
from photogram.geometry import RigidTransform
from photogram.images.image_notices import FRAMES_WITHOUT_GREY_FIT
from photogram.images.noise import NoiseModel
from photogram.images.sequence import ImageSequence
from photogram.measure import follow, follow_torch
from photogram.measure.body import BodyMotion, body_motion, follow_block, measure_body
from photogram.measure.epipolar import check_epipolar
from photogram.measure.exposure_motion import ExposureMotion, prepare_exposure_correction
from photogram.measure.follow import BodyPrior, BodyScene, BodyTracker, FollowedBlock, prepare_body, sine_terms
from photogram.measure.follow_torch import predict_poses
from photogram.motion import deformation
from photogram.subsets.find import drop_subsets
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.reference import TrackStatus
from photogram.subsets.texture import textured_area
from photogram.subsets.track import follow_sequence, prepare_sequence
from photogram.synthetic.scene import Face, ImageSensor, motion_bound, render, view_of

SEPTIC = TrackSettings(radius_px=8, degree=7)
POSES = np.array(
    [
        np.zeros(6),
        [1e-4, -8e-5, 2e-4, 1e-3, -2e-3, 3e-3],
        [-9e-5, 5e-5, -3e-4, -2e-3, 1e-3, 1e-3],
        [4e-5, 9e-5, 1e-4, 1e-3, 2e-3, -2e-3],
    ]
)


def chosen(images: ImageSequence, *frames: int | None) -> ImageSequence:
    """Some frames of a sequence, None for a dark one."""
    dark = np.full_like(images.read(0), 60)
    return sequence([dark if frame is None else images.read(frame) for frame in frames])


@pytest.mark.parametrize(("bits", "degree"), [(8, 5), (12, 7)])
def test_a_body_at_rest_without_noise_is_at_rest_within_the_rounding(bits, degree):
    """All frames are the reference to the last bit, which says no more than that nothing moves by its rounding.

    Rotations count as what they move at the rim; 10⁻³ of a grey level of 12 bit is what float32 keeps of one.
    """
    (left, right), *others = render_images(
        np.zeros((3, 6)), (0.015, 0.013), (100, 90), 31, ImageSensor(bits), noisy=False
    )
    body = measure_body((left, right), *others, TrackSettings(radius_px=8, degree=degree))
    assert body.notices == ()
    step_px = PIXEL_M / 2**bits
    for motion in (body.motion, body.motion_of_points):
        np.testing.assert_allclose(motion.pose * [1, 1, 1, 0.0075, 0.0075, 0.0075], 0.0, atol=1e-3 * step_px)
        u = np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
        assert np.all((u[:, :2] > 1e-3 * step_px) & (u[:, :2] < step_px))


@pytest.fixture(scope="module")
def scene() -> Stereo:
    return render_images(POSES, (0.019, 0.016), (120, 100), 31)


@pytest.fixture(scope="module")
def body(scene: Stereo) -> BodyMotion:
    return measure_body(*scene, SEPTIC)


def as_seen(body: BodyMotion) -> np.ndarray:
    """Poses without the correction for a fixed pattern, whose size four frames do not show."""
    assert body.pattern is not None
    return np.asarray(body.motion.pose - body.pattern.correction)


def test_both_motions_are_true_with_the_noise_of_the_images_and_no_residual(body):
    for motion, pose in ((body.motion, as_seen(body)), (body.motion_of_points, body.motion_of_points.pose)):
        u = np.sqrt(np.diagonal(motion.covariance, axis1=1, axis2=2))
        off = (pose - POSES) / (np.sqrt(2.0) * u)  # the reference has noise of its own
        assert np.max(np.abs(off[1:])) < 4.0
        np.testing.assert_allclose(motion.pose[0], 0.0, atol=1e-15)
    direct, points = (np.diagonal(motion.covariance[1]) for motion in (body.motion, body.motion_of_points))
    assert np.all(direct < points)
    assert np.all(direct > 0.4 * points)
    np.testing.assert_allclose(np.diagonal(body.motion.covariance[0]), direct, rtol=0.1)
    assert body.notices == ()
    for model in body.noise:
        np.testing.assert_allclose(model.variance(1500.0), SENSOR.variance(np.array(1500.0)), rtol=0.05)
    for side, tracks in zip(body.quality, (body.tracks.left, body.tracks.right), strict=True):
        found = np.sqrt(np.nanmedian(np.diagonal(tracks.covariance_px2, axis1=2, axis2=3)))
        assert np.median(side.predicted_sigma_px) == pytest.approx(found, rel=0.1)
    beside = deformation(body.points, replace(body.motion, pose=as_seen(body)))
    squares = np.einsum("fni,fnij,fnj->fn", beside.residual_m, np.linalg.inv(beside.covariance_m2), beside.residual_m)
    assert np.nanmean(squares[1:]) / 3 == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("dark", [1, 2])
def test_a_dark_frame_is_lost_alone(scene, body, dark):
    """The lamp fails in one frame, be it the one that would tell the noise: the others keep their motion, one hears."""
    images, *others = scene
    frames = [None if frame == dark else frame for frame in range(4)]
    seen = measure_body((chosen(images[0], *frames), chosen(images[1], *frames)), *others, SEPTIC)
    assert np.isnan(seen.motion.pose[dark]).all()
    assert seen.motion.points[dark] == 0
    assert seen.noise is not None
    u = np.sqrt(np.diagonal(body.motion.covariance[3]))
    assert np.all(np.abs(seen.motion.pose[3] - body.motion.pose[3]) < 0.2 * u)
    if dark == 2:  # all frames together show the fixed pattern of the sensors
        np.testing.assert_allclose(as_seen(seen)[1], as_seen(body)[1], atol=1e-12)
    (failed,) = (notice for notice in seen.notices if notice.code == FRAMES_WITHOUT_GREY_FIT.code)
    assert (failed.values["failed"], failed.values["frames"]) == (1, 3)


def test_motion_is_given_in_the_specified_frame(scene, body):
    """The same motion about the left camera's centre, in its axes: x' = M·T·M⁻¹ with M = left_from_body."""
    images, rig, body_from_left = scene
    there = measure_body(images, rig, RigidTransform.identity(), SEPTIC)
    left_from_body = body_from_left.inverse()
    for pose, expected in zip(as_seen(there)[1:], as_seen(body)[1:], strict=True):
        carried = left_from_body @ RigidTransform.from_pose(expected) @ body_from_left
        np.testing.assert_allclose(pose[:3], carried.pose[:3], atol=2e-8)
        np.testing.assert_allclose(pose[3:], carried.pose[3:], atol=2e-7)


def test_a_rig_that_triangulates_no_points_is_refused(scene):
    """The right camera turned round: no point lies before both cameras."""
    images, rig, body_from_left = scene
    turned = StereoRig(rig.left, rig.right, RigidTransform.from_pose(np.array([-0.1, 0, 0, 0, 3.0, 0])))
    with pytest.raises(ValueError, match=r"^rig: .* 3 points .*calibration"):
        measure_body(images, turned, body_from_left, TrackSettings(radius_px=8))


# A series in blocks: each found from the reference alone, the same motion whoever follows which of them.

BLOCK = 3
SETTINGS = TrackSettings(radius_px=8, degree=5)
SWING = np.array([6e-4, 9e-4, 2e-4, 2e-3, -2e-3, 3e-3])  # 3 to 5 px, about the speckle size
BLOCK_POSES = np.sin(2.1 * np.arange(8))[:, None] * SWING


@pytest.fixture(scope="module")
def series() -> tuple[object, ...]:
    """What `measure_body` takes: a body that swings."""
    return (*render_images(BLOCK_POSES, (0.015, 0.013), (100, 90), 41), SETTINGS)


@pytest.fixture(scope="module")
def followed(series) -> tuple[BodyScene, FollowedBlock]:
    """Its scene, and all frames after the lead in one block."""
    prepared = prepare_body(*series)
    return prepared, tuple(frame for frames in prepared.blocks for frame in follow_block(prepared, frames))


@pytest.fixture(scope="module")
def parts(series) -> BodyMotion:
    """The motion by blocks of three frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(follow, "BLOCK_FRAMES", BLOCK)
        return measure_body(*series)


def test_where_blocks_begin_is_below_all_noise(followed, parts):
    whole = body_motion(followed[0], [followed[1]])
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


def test_blocks_can_be_tracked_by_other_processes_and_in_any_order(series, parts, monkeypatch):
    """What has been to another process gives the same bits."""
    monkeypatch.setattr(follow, "BLOCK_FRAMES", BLOCK)
    whole, prepared = parts, pickle.loads(pickle.dumps(prepare_body(*series)))
    assert prepared.blocks == (range(2, 5), range(5, 8))
    found = {frames: pickle.loads(pickle.dumps(follow_block(prepared, frames))) for frames in prepared.blocks[::-1]}
    again = body_motion(prepared, [found[frames] for frames in prepared.blocks])
    for name in ("pose", "covariance", "residual_m"):
        assert getattr(whole.motion, name).tobytes() == getattr(again.motion, name).tobytes()
    assert whole.tracks.left.position_px.tobytes() == again.tracks.left.position_px.tobytes()
    assert whole.notices == again.notices


def test_the_rows_of_a_cell_span_a_third_of_a_period(followed):
    """20 µs times 16 rows are 0.32 of a period of 1 kHz; cells of less than 9 px tell too little."""
    hertz, still = np.array([250.0, 1000.0]), np.zeros((2, 6), complex)
    for row_s, side_px in ((0.0, 17), (5e-6, 17), (20e-6, 16), (-20e-6, 16), (100e-6, 9)):
        swing = ExposureMotion(hertz, still, np.arange(8) / 50.0, 1e-4, (row_s, 0.0), False)
        corrected = prepare_exposure_correction(followed[0], swing).scene
        assert {view.cells.side_px for view in corrected.views} == {side_px}


def test_what_was_followed_gives_the_same_however_much_of_it_is_read_at_a_time(followed, monkeypatch):
    """Points, rigid motion, deformation, epipolar residuals: those of all frames at once, to rounding."""
    length, prepared, block = 3, followed[0], list(followed[1])
    lost = block[2][0][1]
    block[2] = (
        (block[2][0][0], drop_subsets(lost, np.arange(len(lost.status)) % 5 == 0, TrackStatus.LEFT_IMAGE)),
        None,
    )
    whole = body_motion(prepared, [tuple(block)])
    monkeypatch.setattr(follow, "BLOCK_FRAMES", length)
    parts = body_motion(prepared, [tuple(block)])
    assert max(len(tracks.left.zncc) for tracks in parts.tracked) == length

    def same(one: object, other: object, *names: str) -> None:
        for name in names:
            numbers = getattr(one, name)
            np.testing.assert_allclose(numbers, getattr(other, name), 1e-9, 1e-11 * np.nanmax(np.abs(numbers)))

    for name in ("motion", "motion_of_points"):
        same(getattr(whole, name), getattr(parts, name), "pose", "covariance", "residual_m", "points")
    same(whole.points, parts.points, "position_m", "covariance_m2", "reprojection_px")
    same(whole, parts, "reprojection_px", "sigma_px", "zncc")
    beside = deformation(whole.points, replace(whole.motion, pose=as_seen(whole)))
    for name in ("residual_m", "covariance_m2"):
        joined = np.concatenate([getattr(part, name) for part in parts.surface])
        np.testing.assert_allclose(joined, getattr(beside, name), 1e-6, 1e-9 * np.nanmax(np.abs(joined)))
    one, other = check_epipolar(whole.tracks, prepared.rig), check_epipolar(parts.tracked, prepared.rig)
    same(one, other, "residual_trend_px", "u_residual_trend_px", "pattern_px", "mean_px")
    assert parts.notices == whole.notices


@pytest.mark.parametrize("length", [1, 3])
def test_means_and_medians_of_all_frames_from_some_at_a_time(length, monkeypatch):
    """The mean to the last bit; the median of all values, or of those of every second, fourth, ... frame."""
    values = np.random.default_rng(1).normal(size=(40, 6))
    values[values > 1.5] = np.nan
    values[:, 5] = np.nan
    for most, every in ((1000, 1), (130, 2), (100, 4)):
        monkeypatch.setattr(frame_statistics, "SAMPLED", most)
        mean, sample = frame_statistics.RunningMean(), frame_statistics.Sample()
        for start in range(0, 40, length):
            mean.add(values[start : start + length])
            sample.add(values[start : start + length])
        known = np.isfinite(values).sum(axis=0)
        assert np.array_equal(mean.mean[:5], np.nansum(values, axis=0)[:5] / known[:5])
        assert np.isnan(mean.mean[5])
        assert sample.median == np.nanmedian(values[::every])


class Repeated:
    """A block of frames, again and again, as it is read from a disk: a new one each time."""

    def __init__(self, block: FollowedBlock, times: int) -> None:
        self.content, self.times = pickle.dumps(block), times

    def __iter__(self) -> Iterator[FollowedBlock]:
        return (pickle.loads(self.content) for _ in range(self.times))


def test_memory_hardly_grows_with_the_frames(followed, monkeypatch):
    """By the motion of each frame and its covariance, which no number of subsets makes larger."""
    monkeypatch.setattr(frame_statistics, "SAMPLED", 1 << 10)
    (prepared, block), peaks = followed, []
    for times in (2, 6):
        tracemalloc.start()
        body = body_motion(prepared, Repeated(block, times))
        check_epipolar(body.tracked, prepared.rig)
        assert sum(len(part.residual_m) for part in body.surface) == 2 + times * len(block)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    per_frame = (peaks[1] - peaks[0]) / (4 * len(block))
    places_and_covariances = 96 * len(prepared.rest_m)  # in bytes, of both cameras
    assert per_frame < 2000.0 < places_and_covariances


@pytest.mark.parametrize("frames", [2, 3])
def test_a_series_shorter_than_a_block(series, frames):
    (left, right), *others = series
    told: list[int] = []
    body = measure_body((chosen(left, *range(frames)), chosen(right, *range(frames))), *others, told.append)
    assert told == [2 * done for done in range(1, frames + 1)]
    assert len(body.motion.pose) == frames
    assert np.isfinite(body.motion.pose).all()


def test_a_body_that_has_moved_by_a_speckle_is_found_at_its_position(series):
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


# A long series: the body is followed by its grey values, its subsets in some of the frames.

LONG = np.sin(0.9 * np.arange(22))[:, None] * np.array([5e-4, -7e-4, 2e-4, 1e-3, -1e-3, 2e-3])
TOUCHED = 11  # a frame in which no subsets are looked for by the plan


@pytest.fixture(scope="module")
def large() -> tuple[object, ...]:
    """A body of some 230 cells, which swings by 4 px and is touched half way, and where it is in every frame."""
    poses = LONG.copy()
    poses[TOUCHED:, :2] += 2e-3  # 12 px
    return render_images(poses, (0.025, 0.022), (170, 150), 51), poses


def test_in_frames_without_subsets_the_motion_is_as_good_as_with_them(large, monkeypatch):
    """The same within what the iteration leaves, and true, also where the body is not where the frames foretold it."""
    monkeypatch.setattr(follow, "BLOCK_FRAMES", 20)
    (images, *others), poses = large
    every = measure_body(images, *others, SEPTIC)
    some = measure_body(images, *others, replace(SEPTIC, frames=8))
    assert every.subset_frames.all()
    assert not some.subset_frames[TOUCHED - 1]
    assert some.subset_frames[TOUCHED]  # subsets are looked for where nothing foretells the body
    assert some.subset_frames.sum() <= 12
    u = np.sqrt(np.diagonal(every.motion.covariance, axis1=1, axis2=2))
    assert np.max(np.abs(some.motion.pose - every.motion.pose) / u) < 0.3
    off = np.abs(some.motion.pose - poses)
    assert np.max(off[1:TOUCHED] / u[1:TOUCHED]) < 4.5 * np.sqrt(2.0)
    assert np.max(off[TOUCHED:, :3]) < 5e-4 * 2e-3  # of the way that the touch took it
    assert np.array_equal(some.motion.points > 0, some.subset_frames)
    assert len(some.tracks.left.zncc) == len(some.motion_of_points.pose) == some.subset_frames.sum()
    course = check_epipolar(some.tracked, others[0], some.subset_frames).residual_trend_px
    assert np.array_equal(np.isfinite(course).all(axis=1), some.subset_frames)


def test_stated_lines_predict_the_body_without_changing_the_result(large, monkeypatch):
    """From the sixth frame in a row on, without an approach by some cells; a line that is not there does no harm."""
    (images, rig, pose), _ = large
    before = tuple(chosen(side, *range(TOUCHED)) for side in images)
    approached, motions, numbers = list[int](), [], []

    def counted(*arguments):
        approached.append(1)
        return coarse_fit(*arguments)

    monkeypatch.setattr(follow, "coarse_fit", counted)
    for line in (None, 0.9, 0.37):
        terms = None if line is None else sine_terms(np.arange(TOUCHED) / (2.0 * np.pi), np.array([line]))
        approached.clear()
        scene = prepare_body(before, rig, pose, SEPTIC, prior=BodyPrior(terms=terms))
        motions.append(body_motion(scene, [follow_block(scene, block) for block in scene.blocks]).motion)
        numbers.append(len(approached))
    assert numbers == [5, 2, 5]
    u = np.sqrt(np.diagonal(motions[0].covariance, axis1=1, axis2=2))
    for motion in motions[1:]:
        assert np.max(np.abs(motion.pose - motions[0].pose) / u) < 0.1


@given(st.integers(3, 2000), st.integers(4, 400))
def test_subsets_are_searched_in_about_the_specified_number_of_frames_without_aliasing(count, wanted):
    sought = follow._choose_subset_frames(range(2, count), wanted)
    assert len(sought) == count
    assert sought[: 2 + follow.MIN_PREDICTION_FRAMES].all()
    if sought.all():
        return
    leads = 2 + follow.MIN_PREDICTION_FRAMES * -(-(count - 2) // follow.BLOCK_FRAMES)
    assert sought.sum() <= max(wanted, leads) + 0.1 * count + 3
    frames = np.flatnonzero(sought)
    if len(frames) < 24:
        return
    first, second = 0.11, np.linspace(0.02, 0.48, 24)  # cycles a frame: sines that all frames tell apart stay apart
    for other in second[np.abs(second - first) > 2.0 / count]:
        columns = [f(2 * np.pi * rate * frames) for rate in (first, other) for f in (np.cos, np.sin)]
        assert np.linalg.cond(np.column_stack(columns)) < 30.0


def test_a_coarse_fit_by_some_cells_is_near_the_fit_by_all(large):
    (images, *others), poses = large
    prepared = prepare_body(images, *others, SETTINGS)
    assert len(prepared.near) == 2
    assert all(
        len(near.rates) < 0.4 * len(view.rates) for near, view in zip(prepared.near, prepared.views, strict=True)
    )
    splines = [spline_of_image(side.read(3), SETTINGS.degree) for side in images]
    start = RigidTransform.from_pose(poses[3] + np.array([5e-5, -5e-5, 5e-5, 3e-4, 3e-4, -3e-4]))
    near, fit = coarse_fit(prepared.near, splines, start), fit_direct(prepared.views, splines, start)
    u = np.sqrt(np.diagonal(fit.covariance))
    assert np.max(np.abs(near.pose - fit.moved.pose) / u) < 8.0
    assert np.max(np.abs(fit_direct(prepared.views, splines, near).moved.pose - fit.moved.pose) / u) < 0.05


# Six components from the grey values: Monte Carlo against the stated covariance and the bound.

POSE = np.array([6e-5, -8e-5, 5e-5, 8e-4, -6e-4, 1.2e-3])
TRIALS = 120
MODEL = NoiseModel(SENSOR.read_noise_grey**2 + 1 / 12, 1 / SENSOR.electrons_per_grey)


@dataclass(frozen=True)
class Scene:
    """A round speckled face before two cameras: clean images at rest and moved, fractions of full scale."""

    places: tuple[PlacedCamera, PlacedCamera]
    face: Face
    rest: tuple[np.ndarray, np.ndarray]
    moved: tuple[np.ndarray, np.ndarray]

    def surface_m(self) -> np.ndarray:
        """Points of the surface, a few more than its rim."""
        u, v = np.meshgrid(np.linspace(-0.018, 0.018, 13), np.linspace(-0.018, 0.018, 13))
        return np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])


@pytest.fixture(scope="module")
def plate() -> Scene:
    shown, one = face((0.017, 0.017), 7, is_round=True), camera((110, 100), (-0.1, 0.1, 2e-4, -1e-4, 0.0))
    places = tuple(PlacedCamera(one, place) for place in two_poses(0.1))
    views = [view_of(place.camera, place.camera_from_body) for place in places]
    images = [[render(view, shown, pose[None], np.ones(1)) for view in views] for pose in (np.zeros(6), POSE)]
    return Scene((places[0], places[1]), shown, (images[0][0], images[0][1]), (images[1][0], images[1][1]))


def splines(images: tuple[np.ndarray, np.ndarray], rng: np.random.Generator | None) -> list[Spline]:
    """Both cameras' images with noise; without `rng` neither noise nor rounding."""
    if rng is None:
        return [spline_of_image(image * SENSOR.full_scale) for image in images]
    return [spline_of_image(SENSOR.digitise(image, rng)) for image in images]


def body_views(plate: Scene, rng: np.random.Generator | None, noise: NoiseModel) -> list[BodyView]:
    rest = splines(plate.rest, rng)
    return [
        view_body(place, (spline, area(image), SENSOR.full_scale), plate.surface_m(), 21, noise)
        for place, spline, image in zip(plate.places, rest, plate.rest, strict=True)
    ]


def area(image: np.ndarray) -> np.ndarray:
    inside = np.zeros(image.shape, dtype=bool)
    inside[5:-5, 5:-5] = True
    return textured_area(image * SENSOR.full_scale) & inside


def sigma(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diagonal(covariance))


def test_a_motion_without_noise_is_found_from_a_pixel_off(plate):
    """What is left of the interpolation is a few ten-thousandths of a pixel."""
    views = body_views(plate, None, MODEL)
    fit = fit_direct(views, splines(plate.moved, None), RigidTransform.identity())
    error = fit.moved.pose - POSE
    assert np.max(np.abs(POSE[:3])) > 0.4 * PIXEL_M * 0.9
    assert np.max(np.abs(error[:2])) < 2e-4 * PIXEL_M
    assert abs(error[2]) < 1e-3 * PIXEL_M
    assert np.max(np.abs(error[3:])) < 1e-3 * PIXEL_M / 0.017


@pytest.mark.slow
def test_scatter_is_the_stated_one_and_close_to_the_bound(plate):
    rng = np.random.default_rng(11)
    views = body_views(plate, rng, MODEL)
    start, found, stated, noise = RigidTransform.from_pose(POSE), [], [], []
    for _ in range(TRIALS):
        fit = fit_direct(views, splines(plate.moved, rng), start)
        found.append(fit.moved.pose)
        stated.append(np.diagonal(fit.covariance))
        noise.append(fit.noise_ratio)
    scatter = np.std(found, axis=0, ddof=1)
    bound = sigma(motion_bound([view_of(p.camera, p.camera_from_body) for p in plate.places], plate.face, SENSOR, POSE))
    spread = 1 / np.sqrt(2 * (TRIALS - 1))
    assert np.all(np.abs(scatter / np.sqrt(np.mean(stated, axis=0)) - 1) < 4 * spread)
    assert np.all(scatter / bound > 1 - 3 * spread)
    # The rim and a border of five pixels are left out of this small face, and gain and offset are free: 1.1 to 1.2.
    assert np.all(scatter / bound < 1.25 + 3 * spread)
    assert abs(np.mean(noise) - 1) < 0.02
    np.testing.assert_allclose(sigma(rest_covariance(views, 1.0)), scatter, rtol=5 * spread)


def test_the_camera_noise_is_found_and_the_order_of_the_cameras_does_not_matter(plate):
    rng = np.random.default_rng(12)
    views = body_views(plate, rng, NoiseModel(1.0, 0.0))
    targets = splines(plate.moved, rng)
    fit, swapped = (fit_direct(views[::k], targets[::k], RigidTransform.identity()) for k in (1, -1))
    np.testing.assert_allclose(swapped.moved.pose, fit.moved.pose, atol=1e-12)
    np.testing.assert_allclose(swapped.covariance, fit.covariance, rtol=1e-6, atol=1e-25)
    for view, target in zip(views, targets, strict=True):
        found, notices = image_noise(view, target, fit.moved, "left camera")
        assert notices == ()
        level = np.array([600.0, 1500.0, 3000.0])
        np.testing.assert_allclose(found.variance(level), SENSOR.variance(level), rtol=0.06)


def test_the_lamp_does_not_matter(plate):
    """Gain and offset of all cells are free: a lamp that dims and stray light change the pose by rounding only."""
    rng = np.random.default_rng(13)
    views = body_views(plate, rng, MODEL)
    plain = fit_direct(views, splines(plate.moved, None), RigidTransform.identity())
    dimmed = [spline_of_image(image * 0.8 * SENSOR.full_scale + 40) for image in plate.moved]
    lit = fit_direct(views, dimmed, RigidTransform.identity())
    assert np.all(np.abs(lit.moved.pose - plain.moved.pose) < 0.02 * sigma(rest_covariance(views, 1.0)))


def test_what_moves_in_front_of_the_body_is_left_out(plate):
    """A cable across the left image: its cells are dropped, and the motion stays within its noise."""
    rng = np.random.default_rng(14)
    views = body_views(plate, rng, MODEL)
    targets = splines(plate.moved, rng)
    clean = fit_direct(views, targets, RigidTransform.from_pose(POSE))
    covered = plate.moved[0].copy()
    covered[90:104] = 0.6
    hidden = [spline_of_image(SENSOR.digitise(covered, rng)), targets[1]]
    fit = fit_direct(views, hidden, RigidTransform.from_pose(POSE))
    assert fit.cells <= clean.cells - 8
    assert np.all(np.abs(fit.moved.pose - POSE) < 5 * sigma(fit.covariance))


def test_an_absent_body_has_no_motion(plate):
    views = body_views(plate, np.random.default_rng(15), MODEL)
    blank = [spline_of_image(np.full((200, 220), 700.0))] * 2
    assert fit_direct(views, blank, RigidTransform.identity()) is None
    far = RigidTransform.from_pose(np.array([0.2, 0, 0, 0, 0, 0]))
    assert fit_direct(views, splines(plate.moved, None), far) is None


# The same batched over frames by torch, here on its CPU device.


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_frames_fitted_together_on_a_device_are_those_fitted_one_by_one(plate, precision):
    """A clean frame, one behind a cable, one of a dark room, one whose start lies elsewhere, one with a dim lamp."""
    rng = np.random.default_rng(16)
    views = body_views(plate, rng, MODEL)
    cable, dim = plate.moved[0].copy(), [0.8 * image + 0.01 for image in plate.moved]
    cable[90:104] = 0.6
    dark = [np.full_like(image, 0.2) for image in plate.moved]
    shown = [plate.moved, (cable, plate.moved[1]), dark, plate.moved, dim]
    stored = [[SENSOR.digitise(image, rng) for image in pair] for pair in shown]
    near, far = RigidTransform.from_pose(0.9 * POSE), RigidTransform.from_pose(np.array([0.2, 0, 0, 0, 0, 0]))
    starts = [near, near, near, far, RigidTransform.identity()]
    alone = [
        fit_direct(views, [spline_of_image(image) for image in pair], start)
        for pair, start in zip(stored, starts, strict=True)
    ]
    targets = [(spline_frames(np.stack(side), 5, "cpu", precision), range(5)) for side in zip(*stored, strict=True)]
    begun = np.array([start.pose for start in starts])
    together = fit_frames([torch_view(view, "cpu", precision) for view in views], targets, begun)
    assert [fit is None for fit in together] == [False, False, True, True, False] == [fit is None for fit in alone]
    for one, other in zip(alone, together, strict=True):
        if one is not None:
            assert other.cells == one.cells
            assert np.max(np.abs(other.moved.pose - one.moved.pose) / sigma(one.covariance)) < 0.01
            np.testing.assert_allclose(sigma(other.covariance), sigma(one.covariance), rtol=1e-3)
            assert other.noise_ratio == pytest.approx(one.noise_ratio, rel=1e-3)
    assert alone[1].cells < alone[0].cells


def test_a_device_projects_as_the_camera_does():
    """All eight coefficients of the lens and a skew; what lies behind the camera is nowhere."""
    lens = Camera.from_parameters(
        np.array([900.0, 950, 310, 250, -0.2, 0.1, 1e-3, -2e-3, 0.03, 0.02, -0.01, 0.004, 1.5]), np.array([640, 480])
    )
    place = PlacedCamera(lens, RigidTransform.from_pose(np.array([0.01, -0.02, 0.5, 0.1, -0.2, 0.3])))
    points = np.column_stack([np.random.default_rng(17).uniform(-0.1, 0.1, (40, 2)), np.zeros(40)])
    points[0, 2] = -2.0
    moved = RigidTransform.from_pose(10 * POSE)
    seen = torch_project(lens, torch.from_numpy(place.camera_from_body.apply(moved.apply(points)))).numpy()
    np.testing.assert_allclose(seen, place.project(moved.apply(points)), rtol=1e-12)
    assert np.isnan(seen[0]).all()
    assert np.isfinite(seen[1:]).all()


@pytest.mark.parametrize("device", ["cpu:0", pytest.param("cuda", marks=NEEDS_GPU)])
def test_a_body_followed_on_a_device_moves_as_on_the_cpu(series, device, monkeypatch):
    """Batches of both cameras, one frame dark, then a jump by 12 px: the same motion, the same frames lost."""
    monkeypatch.setattr(direct_fit, "MAX_REMAINING_STEP", 1e-4)
    (left, right), *others = series
    pairs = tuple(chosen(side, 0, 1, 2, None, 3, 4) for side in (left, right))
    here, there = (measure_body(pairs, *others, device=where) for where in ("cpu", device))
    assert np.array_equal(np.isfinite(there.motion.pose), np.isfinite(here.motion.pose))
    assert not np.isfinite(here.motion.pose[3]).any()
    u = np.sqrt(np.diagonal(here.motion.covariance, axis1=1, axis2=2))
    assert np.nanmax(np.abs(there.motion.pose - here.motion.pose) / u) < 0.01
    np.testing.assert_allclose(there.motion.covariance, here.motion.covariance, rtol=0.01, atol=1e-25)
    assert np.array_equal(there.tracks.left.status, here.tracks.left.status)


SWINGS = (0.17, 0.6, 1.3, 2.2, 2.9)  # rad per frame, more than are looked for in the motion


def test_stated_lines_predict_the_rest_of_a_batch_on_a_device_with_one_comparison(monkeypatch):
    """Counted: steps and comparisons of a frame. The motion is as the CPU's within what both leave."""
    count = np.arange(40)
    poses = sum(np.sin(line * count + k)[:, None] * np.roll(0.06 * SWING, k) for k, line in enumerate(SWINGS))
    images, *others = render_images(poses - poses[0], (0.015, 0.013), (100, 90), 43)
    compared, batches = list[int](), list[tuple[int, float]]()
    compare, fit_all = fit_torch._compared, follow_torch.fit_frames

    def comparing(view, frames, number, *motion):
        compared.append(len(number))
        return compare(view, frames, number, *motion)

    def fitted(views, targets, starts):
        compared.clear()
        found = fit_all(views, targets, starts)
        batches.append((len(starts), sum(compared) / len(views) / len(starts)))
        return found

    monkeypatch.setattr(fit_torch, "_compared", comparing)
    monkeypatch.setattr(follow_torch, "fit_frames", fitted)
    known = BodyPrior(terms=sine_terms(count.astype(np.float64), np.array(SWINGS) / (2.0 * np.pi)))
    scene = prepare_body(images, *others, SEPTIC, device="cpu:0", prior=known)
    (block,) = scene.blocks
    here, there = ([fit for _, fit in follow_block(scene, block, where)] for where in ("cpu", "cpu:0"))
    assert [frames for frames, _ in batches] == [12, 12, 14]
    assert batches[-1][1] <= 1.1
    for one, other in zip(here, there, strict=True):
        assert np.max(np.abs(other.moved.pose - one.moved.pose) / sigma(one.covariance)) < 0.1


def course_of(poses: np.ndarray, terms: np.ndarray | None = None) -> BodyTracker:
    """A body whose frames so far gave these poses, and of which 20 points are seen at 1 px by 0.1 mm or 2 mrad."""
    rng = np.random.default_rng(29)
    rates = rng.normal(0.0, [1e4, 1e4, 1e4, 500, 500, 500], (20, 2, 6))
    covariance = np.diag([1e-8, 1e-8, 1e-8, 1e-7, 1e-7, 1e-7]) ** 2
    none = np.zeros(0), np.zeros((0, 0))
    fits = [
        DirectFit(
            RigidTransform.from_pose(pose), covariance, 1.0, 99, *none, np.ones((2, 2)), np.zeros((0, 6), np.float32)
        )
        for pose in poses
    ]
    lead, known = ((None, fits[0]),) if fits else (), BodyPrior(terms=terms)
    scene = SimpleNamespace(seen=[SimpleNamespace(rates=rates)], lead=lead, body=known)
    return cast("BodyTracker", SimpleNamespace(fits=fits, scene=scene))


AMPLITUDE = np.array([5e-4, -3e-4, 2e-4, 1e-3, -2e-3, 2e-3])


@pytest.mark.parametrize("lines", [(0.17,), (0.9,), (3.0,), (0.9, 2.1), (0.4, 1.3, 2.2)])
def test_sines_are_predicted_over_a_whole_batch(lines):
    """Also one that is sampled about once a period, and several at once, about a mean that is not rest."""
    frames = np.arange(110)[:, None]
    swings = [np.sin(line * frames + k) * np.roll(AMPLITUDE, k) / (1 + k) for k, line in enumerate(lines)]
    truth = 2 * AMPLITUDE + np.sum(swings, axis=0)
    noisy = truth + np.random.default_rng(30).normal(0, 1e-3, truth.shape) * np.abs(AMPLITUDE)
    found = predict_poses(course_of(noisy[:60]), 50)
    assert found.shape == (50, 6)
    assert np.sqrt(np.mean(((found - truth[60:]) / AMPLITUDE) ** 2)) < 0.02


def test_a_body_at_rest_is_predicted_and_unpredictable_motion_is_tracked_frame_by_frame():
    """Rest, random motion, too few frames for sines, random motion near its mean, too few for any rule, none."""
    rng = np.random.default_rng(31)
    rest, jumps = rng.normal(0, 1e-6, (20, 6)), rng.normal(0, 1e-3, (20, 6))
    np.testing.assert_allclose(predict_poses(course_of(rest), 12), np.tile(rest[-1], (12, 1)), atol=1e-12)
    for past in (jumps, jumps[:8]):
        assert predict_poses(course_of(past), 12).shape == (1, 6)
    mean = np.tile(0.05 * jumps.mean(axis=0), (12, 1))
    np.testing.assert_allclose(predict_poses(course_of(0.05 * jumps), 12), mean, atol=1e-12)
    mean = np.tile(jumps[:3].mean(axis=0), (9, 1))
    np.testing.assert_allclose(predict_poses(course_of(jumps[:3]), 9), mean, atol=1e-12)
    assert predict_poses(course_of(jumps[:0]), 9).shape == (0, 6)


def test_stated_lines_predict_as_far_as_their_fit_is_certain():
    """Monte Carlo: all frames, by lines that the first ones tell apart; by others the next few; none of a motion with
    another line as well. What is foretold is within the step that may be the last one of a fit."""
    rng, frames, u = np.random.default_rng(32), np.arange(120.0), np.array([1e-8, 1e-8, 1e-8, 1e-7, 1e-7, 1e-7])

    def foretold(first: int, lines: tuple[float, ...], more: tuple[float, ...] = ()) -> tuple[int, float]:
        """How many frames after the first ones, and how far off the worst of them is, in u."""
        terms, moving = (sine_terms(frames / (2.0 * np.pi), np.array(own)) for own in (lines, lines + more))
        truth = moving @ rng.normal(0.0, 1.0, (moving.shape[1], 6)) * AMPLITUDE
        course = course_of(truth[:first] + rng.normal(0.0, 1.0, (first, 6)) * u, terms)
        found = BodyTracker.extrapolate(course, range(first, len(frames)))
        off = np.linalg.norm((found - truth[first : first + len(found)]) / u, axis=1)
        return len(found), float(np.max(off, initial=0.0))

    for _ in range(20):
        apart, close = foretold(12, (0.9, 2.1)), foretold(12, (0.9, 0.92))
        assert apart[0] == 108
        assert apart[1] < 5.0
        assert 12 < close[0] < 60
        assert close[1] < direct_fit.MAX_FINAL_STEP
        assert foretold(60, (0.9, 0.92))[0] == 60
        assert foretold(12, (0.9,), (2.1,))[0] == 0


# Cells of an area: every pixel once, sums against plain numpy, and the surface they lie on.

NOISE = NoiseModel(4.0, 0.01)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), side=st.integers(3, 12), filled=st.floats(0.05, 0.95))
def test_every_pixel_of_a_well_filled_square_appears_once(seed, side, filled):
    area = np.random.default_rng(seed).random((37, 41)) < filled
    centres, runs, first = lay_cells(area, side)
    seen = np.zeros(area.shape, dtype=int)
    for row, column, length, _ in runs:
        seen[row, column : column + length] += 1
    assert np.array_equal(runs[:, 3], np.cumsum(runs[:, 2]) - runs[:, 2])
    assert seen.max() <= 1
    assert not np.any(seen[~area])
    assert first[-1] == len(runs)
    for index, centre in enumerate(centres):
        mine = runs[first[index] : first[index + 1]]
        assert mine[:, 2].sum() >= MIN_FILLED_SHARE * side**2
        half = (side - 1) / 2
        assert np.all(np.abs(mine[:, 0] - centre[1]) <= half)
        assert np.all(mine[:, 1] >= centre[0] - half)
        assert np.all(mine[:, 1] + mine[:, 2] - 1 <= centre[0] + half)


@pytest.mark.parametrize("degree", [3, 5])
def test_sums_of_a_cell_against_numpy(make_texture, degree):
    """One ragged cell at an affine warp: gain, misfit, projected gradients and Hessian from their definitions."""
    texture = make_texture(seed=3, s=1.6, waves=60)
    first = spline_of_image(1000 + 200 * texture.image((60, 50)), degree)
    second = spline_of_image(1100 + 180 * texture.image((60, 50), lambda p: p - [0.4, -0.3]), degree)
    area = np.zeros((50, 60), dtype=bool)
    area[18:31, 20:33] = True
    area[18:22, 20:25] = False
    cells = prepare_cells(first, area, 13, NOISE, 4095)
    assert cells.count.tolist() == [13 * 13 - 20]
    warp = np.array([[0.37, 2e-3, -1e-3, -0.28, 3e-3, 1e-3]])
    found = compare_cells(cells, second, warp)

    rows, columns = np.nonzero(area)
    d = np.column_stack([columns, rows]) - cells.centre_px[0]
    f, slope = evaluate(first, np.column_stack([columns, rows]).astype(float))
    w = 1 / NOISE.variance(f)
    u, ux, uy, v, vx, vy = warp[0]
    moved = d + cells.centre_px[0] + np.column_stack([u + d @ [ux, uy], v + d @ [vx, vy]])
    g, _ = evaluate(second, moved)
    shape = np.column_stack([np.ones(len(d)), d])
    steepest = np.concatenate([slope[:, :1] * shape, slope[:, 1:] * shape], axis=1)
    base = np.column_stack([np.ones(len(f)), f - np.average(f, weights=w)])
    normal = base.T @ (w[:, None] * base)
    offset, gain = np.linalg.solve(normal, base.T @ (w * g))
    residual = g - offset - gain * base[:, 1]
    projected = steepest - base @ np.linalg.solve(normal, base.T @ (w[:, None] * steepest))
    np.testing.assert_allclose(found.gain, gain, rtol=1e-7)  # here and below: of grey values in float32
    np.testing.assert_allclose(found.misfit, np.sum(w * residual**2), rtol=2e-5)
    hessian = projected.T @ (w[:, None] * projected)
    slope_off = (found.slope[0, 0] - projected.T @ (w * g)) / np.sqrt(np.diagonal(hessian))  # in standard uncertainties
    np.testing.assert_allclose(slope_off, 0.0, atol=1e-4)
    np.testing.assert_allclose(cells.hessian[0], hessian, rtol=1e-8, atol=1e-6)
    grey, normalised = pixel_residuals(cells, second, warp)
    np.testing.assert_allclose(grey, f, rtol=1e-10)
    rms = [np.sqrt(np.mean(one**2)) for one in (normalised, residual)]
    np.testing.assert_allclose(normalised / rms[0], residual / rms[1], rtol=0.0, atol=1e-3)


@pytest.mark.parametrize("side_px", [13, 14, 15, 16, 17, 18])
@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_the_expected_misfit_is_that_of_noise_in_cells_of_any_size(make_texture, side_px, shift):
    texture, rng = make_texture(seed=6, waves=60), np.random.default_rng(17)
    exact = [1000 + 200 * texture.image((200, 200), lambda p, u=u: p - [u, u]) for u in (0.0, shift)]
    first, second = (grey + np.sqrt(NOISE.variance(grey)) * rng.normal(size=grey.shape) for grey in exact)
    area = np.pad(np.ones((160, 160), dtype=bool), 20)
    cells = prepare_cells(spline_of_image(first), area, side_px, NOISE, 4095)
    found = compare_cells(cells, spline_of_image(second), np.tile([shift, 0, 0, shift, 0, 0], (len(cells.count), 1)))
    assert found.misfit.sum() / found.misfit_noise.sum() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 160**2))


def test_cells_that_leave_the_image_and_saturated_pixels_do_not_count(make_texture):
    image = 1000 + 200 * make_texture(seed=4, waves=60).image((60, 50))
    image[20:24, 20:30] = 4095
    area = np.ones((50, 60), dtype=bool)
    cells = prepare_cells(spline_of_image(image), area, 10, NOISE, 4095)
    assert cells.count.sum() == 50 * 60 - 40
    target = spline_of_image(np.roll(image, 4, axis=1))
    found = compare_cells(cells, target, np.tile([4.0, 0, 0, 0, 0, 0], (len(cells.count), 1)))
    last = cells.centre_px[:, 0] > 50
    assert np.all(np.isnan(found.gain[0, last]))
    assert np.all(np.isfinite(found.slope[0, ~last]))
    inner = cells.centre_px[~last, 0] > 10
    np.testing.assert_allclose(found.gain[0, ~last][inner], 1.0, atol=1e-3)


def test_patches_of_a_plane_move_as_projected_points_do():
    """Rates and warps of a tilted plane against differences of exact projections, lens distortion included."""
    one = camera((320, 256), (-0.1, 0.2, 1e-3, -1e-3, 0.0))
    placed = PlacedCamera(one, RigidTransform.from_pose(np.array([0.01, -0.02, 0.4, 0.2, -0.3, 0.1])))
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.06, 0.06, 25), np.linspace(-0.05, 0.05, 21)))
    known = np.column_stack([u, v, 0.1 * u - 0.05 * v])
    known[::17, 2] += 5e-3  # wrong points, which the local planes must leave out
    centre = placed.project(np.array([[0.01, 0.02, 0.0], [-0.03, 0.01, -0.0035], [0.0, 0.0, 0.0]]))
    patches = body_patches(placed, known, centre, 6.0, 40.0)
    plane = patches.points_m[..., 2] - 0.1 * patches.points_m[..., 0] + 0.05 * patches.points_m[..., 1]
    assert np.max(np.abs(plane)) < 1e-8
    np.testing.assert_allclose(placed.project(patches.points_m[:, 0]), centre, atol=1e-8)
    pose = np.array([1e-4, -2e-4, 3e-4, 1e-3, -2e-3, 3e-3])
    moved = RigidTransform.from_pose(pose)
    warp, rates = patch_warps(placed, patches, moved), patch_rates(placed, patches)
    shift = placed.project(moved.apply(patches.points_m)) - placed.project(patches.points_m)
    for arm, step in enumerate(6.0 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])):
        along = warp[:, [0, 3]] + warp[:, [1, 4]] * step[0] + warp[:, [2, 5]] * step[1]
        np.testing.assert_allclose(along, shift[:, arm], atol=2e-4)
    np.testing.assert_allclose(rates @ pose, warp, atol=0.02 * np.abs(warp).max())


def test_unknown_surface_is_nan():
    placed = PlacedCamera(camera((100, 100)), RigidTransform(np.eye(3), np.array([0, 0, 0.75])))
    known = np.column_stack([np.random.default_rng(1).uniform(-0.01, 0.01, (30, 2)), np.zeros(30)])
    patches = body_patches(placed, known, np.array([[100.0, 100.0], [190.0, 190.0]]), 5.0, 20.0)
    assert np.isfinite(patches.points_m[0]).all()
    assert np.isnan(patches.points_m[1]).all()
    refused("^surface_m: .* 3 ", body_patches, placed, known[:2], np.array([[100.0, 100.0]]), 5.0, 20.0)
