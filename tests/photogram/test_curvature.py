"""Subsets of order 2 in a wave whose period grows along the image: what they find is true as stated, or refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import savgol_coeffs
from speckle import spline_frames

from photogram.bspline import spline_of_image
from photogram.subsets.find import find_without_prediction
from photogram.subsets.icgn import Registration, TrackSettings, noise_of_residual, position_covariance, register
from photogram.subsets.icgn_torch import register_frames, torch_reference
from photogram.subsets.reference import ReferenceSubsets, TrackStatus, prepare_reference

SIZE, MIDDLE, AMPLITUDE_PX = (640, 121), 60.0, 0.5
CONTRAST, NOISE, FRAMES = 36.0, 2.1, 3
CENTRES = np.stack(np.meshgrid(np.arange(20.0, 621.0, 7.0), np.arange(25.0, 96.0, 7.0)), axis=-1).reshape(-1, 2)
SETTINGS = TrackSettings(radius_px=9, shape_order=2)
RESOLVED_PX = 40.0


def period(points: np.ndarray) -> np.ndarray:
    """Of the wave in px, at points (..., 2)."""
    return 14.0 + 0.16 * points[..., 0]


def wave(points: np.ndarray) -> np.ndarray:
    """Displacement (..., 2) that brings a point of the first image to `points` of the second."""
    phase = 2.0 * np.pi * (points[..., 1] - MIDDLE) / period(points)
    return np.stack([np.zeros_like(phase), AMPLITUDE_PX * np.cos(phase)], axis=-1)


def moved(points: np.ndarray) -> np.ndarray:
    """Where the points (N,2) of the first image are in the second: fixed point of q = p + wave(q)."""
    there = points.copy()
    for _ in range(60):
        there = points + wave(there)
    return there


@dataclass(frozen=True)
class Star:
    """Noisy 8-bit images: the first, those moved by the wave, and what order 2 finds of them."""

    first: np.ndarray
    later: list[np.ndarray]
    reference: ReferenceSubsets
    found: list[Registration]

    @property
    def error_px(self) -> np.ndarray:
        """Errors (F,N,2), NaN where refused."""
        return np.stack([here.warp[:, [0, 3]] for here in self.found]) - (moved(CENTRES) - CENTRES)

    @property
    def u_px(self) -> np.ndarray:
        """Stated standard uncertainties (F,N,2) of one frame's noise."""
        levels = [noise_of_residual(self.reference, here, 5) for here in self.found]
        covariances = [
            position_covariance(self.reference, here, level) for here, level in zip(self.found, levels, strict=True)
        ]
        return np.sqrt(np.stack(covariances)[:, :, [0, 1], [0, 1]])


@pytest.fixture(scope="module")
def star(make_texture) -> Star:
    texture, rng = make_texture(seed=71, s=1.5), np.random.default_rng(71)
    plain = 127.0 + CONTRAST * texture.image(SIZE)
    waved = 127.0 + CONTRAST * texture.image(SIZE, lambda points: points - wave(points))

    def stored(image: np.ndarray) -> np.ndarray:
        return np.rint(image + rng.normal(0.0, NOISE, image.shape)).clip(0, 255).astype(np.uint8)

    first, later = stored(plain), [stored(waved) for _ in range(FRAMES)]
    reference = prepare_reference(spline_of_image(first), CENTRES, SETTINGS.radius_px, 2)
    found = [find_without_prediction(reference, first, (image, spline_of_image(image)), SETTINGS) for image in later]
    return Star(first, later, reference, found)


def test_errors_of_found_subsets_are_within_the_stated_uncertainty(star):
    """Both images' noise counts in a pair, so u is √2 times that of a frame of a series."""
    far = (np.abs(star.error_px) > 0.1) & (np.abs(star.error_px) > 5.0 * np.sqrt(2.0) * star.u_px)
    assert not far.any()
    status, resolved = np.stack([here.status for here in star.found]), period(CENTRES) > RESOLVED_PX
    assert np.mean(status[:, resolved] == TrackStatus.OK) > 0.85
    assert np.mean(np.abs(star.error_px[:, resolved]) > 0.1) < 1e-3
    assert np.mean(status[:, period(CENTRES) < 19.0] == TrackStatus.UNRESOLVED) > 0.3


def test_scatter_is_stated(star):
    """Deviations from each subset's mean over the frames, which the reference's noise has moved."""
    deviation = star.error_px - star.error_px.mean(axis=0)
    relative = np.abs(deviation / star.u_px)[:, period(CENTRES) > RESOLVED_PX] * np.sqrt(FRAMES / (FRAMES - 1))
    scatter = 1.4826 * np.nanmedian(relative, axis=(0, 1))
    assert np.all((scatter > 0.85) & (scatter < 1.2))


def test_the_resolution_is_that_of_a_parabola(star):
    """A quadratic fit to evenly spread points is a Savitzky–Golay filter: its answer to a cosine is known."""
    side = 2 * SETTINGS.radius_px + 1
    weights, places = savgol_coeffs(side, 2), np.arange(side) - SETTINGS.radius_px
    truth = (moved(CENTRES) - CENTRES)[:, 1]
    shift = np.mean([here.warp[:, 3] for here in star.found], axis=0)
    for low, high in ((24.0, 30.0), (30.0, 40.0), (40.0, 60.0)):
        band = (period(CENTRES) > low) & (period(CENTRES) < high) & np.isfinite(shift)
        expected = np.cos(2.0 * np.pi / period(CENTRES[band])[:, None] * places) @ weights
        found = np.sum(shift[band] * truth[band]) / np.sum(truth[band] ** 2)
        assert found == pytest.approx(np.average(expected, weights=truth[band] ** 2), rel=0.05)


def test_the_batched_engine_finds_and_refuses_the_same(star):
    """Of every fifth subset."""
    reference = prepare_reference(spline_of_image(star.first), CENTRES[::5], SETTINGS.radius_px, 2)
    image, start = star.later[0], np.zeros((len(reference.centre_px), 6))
    frames = spline_frames(image[None], 5, "cpu")
    (found,) = register_frames(torch_reference(reference, "cpu"), frames, start[None], SETTINGS)
    expected = register(reference, spline_of_image(image), start, SETTINGS)
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_allclose(found.warp, expected.warp, atol=1e-6)
    assert {TrackStatus.OK, TrackStatus.UNRESOLVED} <= set(found.status.tolist())


def test_texture_that_does_not_carry_curvature_is_refused(make_texture):
    """Under noise of a third of the contrast, 49 pixels determine some affine maps but no twelve parameters."""
    image = 127.0 + CONTRAST * make_texture(seed=72, s=1.5).image((100, 100))
    noisy = spline_of_image(image + np.random.default_rng(72).normal(0.0, CONTRAST / 3, image.shape))
    centres = CENTRES[(CENTRES < 80.0).all(axis=1)]
    affine, curved = (prepare_reference(noisy, centres, 3, order) for order in (1, 2))
    usable = affine.status == TrackStatus.OK
    assert usable.sum() > 8
    assert np.mean(curved.status[usable] == TrackStatus.UNRESOLVED) > 0.9
    found = register(curved, noisy, np.zeros((len(centres), 6)), TrackSettings(radius_px=3, shape_order=2))
    assert np.isnan(found.warp[curved.status == TrackStatus.UNRESOLVED]).all()
