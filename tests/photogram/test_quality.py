"""What is said of subsets before tracking, against what tracking of rendered images then shows."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.bspline import spline_of_image
from photogram.camera import Camera
from photogram.geometry import RigidTransform
from photogram.images import NoiseModel
from photogram.subsets.icgn import register
from photogram.subsets.reference import TrackStatus, prepare_reference
from photogram.subsets.texture import aliasing_bias, aliasing_notice, assess, default_radius_px, lay_grid
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of

FOCAL_PX, PIXEL_M = 1500.0, 0.2e-3
SIZE = (220, 180)
SENSOR = ImageSensor()
NOISE = NoiseModel(36.0 + 1 / 12, 1 / 8)


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


def inner() -> np.ndarray:
    area = np.zeros(SIZE[::-1], bool)
    area[8:-8, 8:-8] = True
    return area


def test_predicted_sigma_is_the_scatter_of_tracking() -> None:
    rng, radius = np.random.default_rng(2), 10
    still, moved = images(5.0, 1.2, np.array([0.0, 0.4]))
    first = SENSOR.digitise(still, rng)
    reference = prepare_reference(spline_of_image(first), lay_grid(inner(), radius, 2 * radius + 1), radius)
    quality = assess(reference, first, NOISE, SENSOR.full_scale)
    assert quality.usable.all()
    assert quality.notices("left camera") == ()
    start = np.zeros((len(reference.centre_px), 6))
    start[:, 0] = 0.4
    found = [
        register(reference, spline_of_image(SENSOR.digitise(moved, rng)), start, 30, 1e-4, 0.75).warp[:, [0, 3]]
        for _ in range(150)
    ]
    scatter = np.std(found, axis=0, ddof=1)
    np.testing.assert_allclose(np.sqrt(np.mean((scatter / quality.predicted_sigma_px) ** 2, axis=0)), 1.0, atol=0.1)
    np.testing.assert_allclose(scatter / quality.predicted_sigma_px, 1.0, atol=0.3)


def test_unusable_subsets_are_told_apart_and_counted() -> None:
    image = SENSOR.digitise(images(5.0, 1.2, np.zeros(1))[0], np.random.default_rng(3))
    image[20:60, 20:60] = 4095
    image[100:150, 100:150] = np.random.default_rng(4).normal(1000, 12, (50, 50)).astype(np.uint16)
    centres = np.array([[90.0, 40.0], [40.0, 40.0], [125.0, 125.0], [4.0, 90.0], [np.nan, np.nan]])
    quality = assess(prepare_reference(spline_of_image(image), centres, 10), image, NOISE, 4095)
    expected = [TrackStatus.OK, TrackStatus.SATURATED, TrackStatus.FLAT, TrackStatus.LEFT_IMAGE, TrackStatus.NO_START]
    assert quality.status.tolist() == expected
    assert quality.saturated.tolist() == [False, True, False, False, False]
    assert quality.flat.tolist() == [False, False, True, False, False]
    assert np.isfinite(quality.predicted_sigma_px).all(axis=1).tolist() == quality.usable.tolist()
    (notice,) = quality.notices("left camera")
    assert notice.text == (
        "4 of 5 subsets are not used: 1 without texture, 1 saturated, 1 too close to the image's border, "
        "1 without a position"
    )


@pytest.mark.parametrize(("dot_px", "blur_px"), [(5.0, 0.6), (5.0, 0.4), (5.0, 0.0), (4.0, 0.8), (2.8, 0.0)])
def test_bias_of_unresolved_texture_is_foretold(dot_px: float, blur_px: float) -> None:
    """Amplitude over the pixel of the error of noise-free subsets, within a factor of 2; of their mean within 2.5."""
    shifts = np.arange(8) / 8
    frames = [4095 * frame for frame in images(dot_px, blur_px, shifts)]
    reference = prepare_reference(spline_of_image(frames[0]), lay_grid(inner(), 10, 21), 10)
    errors = []
    for frame, shift in zip(frames, shifts, strict=True):
        start = np.zeros((len(reference.centre_px), 6))
        start[:, 0] = shift
        errors.append(register(reference, spline_of_image(frame), start, 30, 1e-6, 0.5).warp[:, 0] - shift)
    wave = np.exp(-2j * np.pi * shifts) / 4
    single = np.sqrt(np.nanmean(np.abs(wave @ np.array(errors)) ** 2))
    mean = np.abs(wave @ np.nanmean(errors, axis=1))
    noisy = frames[0] + np.random.default_rng(5).normal(0, 12, frames[0].shape)
    bias = aliasing_bias(noisy, inner(), 12.0, 10)
    assert 0.5 < bias.subset_px / single < 2.0
    assert 0.4 < bias.mean_px / mean < 2.5
    notice = aliasing_notice(noisy, inner(), 12.0, aliasing_bias(noisy, inner(), 12.0, 10), "left camera")
    assert (notice is None) == (blur_px == 0.8)
    if notice is not None:
        assert f"{bias.mean_px:.2g} px in the mean" in notice.text
        assert "false harmonics" in notice.text


def test_soft_speckle_is_not_complained_of() -> None:
    image = SENSOR.digitise(images(5.0, 1.2, np.zeros(1))[0], np.random.default_rng(6))
    assert aliasing_bias(image, inner(), 18.0, 10).mean_px < 1.5e-4
    assert aliasing_notice(image, inner(), 18.0, aliasing_bias(image, inner(), 18.0, 10), "left camera") is None
    assert aliasing_bias(image, inner(), 18.0, 10, degree=3).mean_px > 3e-4  # cubic splines have a bias of their own


def test_no_room_means_no_answer(make_texture) -> None:  # type: ignore[no-untyped-def]
    image = make_texture(seed=5).image((30, 30))
    assert np.isnan(aliasing_bias(image, np.ones((30, 30), bool), 1.0, 10).mean_px)


@pytest.mark.parametrize(("speckle_px", "radius"), [(4.0, 10), (4.5, 10), (5.0, 10), (3.0, 7), (8.0, 17), (30.0, 25)])
def test_radius_follows_the_speckle(speckle_px: float, radius: int) -> None:
    assert default_radius_px(speckle_px) == radius
    assert default_radius_px(float("nan")) == 10
