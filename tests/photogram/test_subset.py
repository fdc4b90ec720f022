"""Textured area, grid, speckle size and unresolved texture, each against a scene whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.subsets.texture import (
    fine_texture_share,
    lay_grid,
    speckle_size,
    subset_mean,
    subsets_inside,
    textured_area,
)


def disc(shape: tuple[int, int], centre: tuple[float, float], radius: float) -> np.ndarray:
    rows, columns = np.indices(shape)
    return np.hypot(columns - centre[0], rows - centre[1]) < radius


@pytest.fixture(scope="module")
def speckle(make_texture) -> np.ndarray:  # type: ignore[no-untyped-def]
    return make_texture(seed=31, s=1.4, waves=80).image((260, 200))


def test_the_body_is_found_and_its_rim_left_out(speckle: np.ndarray) -> None:
    rng = np.random.default_rng(31)
    body = disc(speckle.shape, (130, 100), 80)
    shading = np.linspace(200, 900, 260)[None, :]
    image = np.where(body, 1800 + 500 * speckle, shading) + rng.normal(0, 8, speckle.shape)
    area = textured_area(image)
    assert not np.any(area & ~body)
    assert area.sum() > 0.8 * body.sum()


def test_an_image_full_of_texture_is_textured_everywhere(speckle: np.ndarray) -> None:
    assert textured_area(2000 + 500 * speckle).all()
    assert textured_area(np.full((60, 60), 7.0)).all()


def test_dust_is_no_body(speckle: np.ndarray) -> None:
    body = disc(speckle.shape, (90, 100), 70)
    dust = disc(speckle.shape, (230, 30), 14)
    image = np.where(body | dust, 1800 + 500 * speckle, 300) + np.random.default_rng(32).normal(0, 8, speckle.shape)
    assert not np.any(textured_area(image) & dust)


def test_subsets_fill_a_rectangle_completely() -> None:
    area = np.zeros((80, 120), bool)
    area[5:75, 10:115] = True
    points = lay_grid(area, 10, 21)
    assert len(points) == 3 * 5
    assert subsets_inside(area, points, 10, 1.0).all()


def test_subsets_neither_overlap_nor_leave_the_area() -> None:
    area = disc((300, 340), (170, 150), 140)
    area[100:130, 60:90] = False
    points = lay_grid(area, 10, 21)
    apart = np.abs(points[:, None] - points[None]).max(axis=2) + 99 * np.eye(len(points))
    assert apart.min() >= 21
    assert subsets_inside(area, points, 10, 1.0).all()
    assert len(points) * 21**2 > 0.8 * area.sum()
    plain = subsets_inside(
        area, np.stack(np.meshgrid(np.arange(10, 340, 21), np.arange(10, 300, 21)), -1).reshape(-1, 2), 10, 1.0
    )
    assert len(points) > plain.sum()


def test_a_small_area_holds_no_subset() -> None:
    assert lay_grid(disc((50, 50), (25, 25), 12), 10, 21).shape == (0, 2)
    with pytest.raises(ValueError, match="radius_px, step_px: expected at least 1"):
        lay_grid(np.ones((9, 9), bool), 0, 1)


def test_subset_mean_is_the_mean() -> None:
    values = np.random.default_rng(33).normal(size=(40, 50))
    points = np.array([[20.0, 20.4], [30.2, 15.0], [np.nan, 3.0]])
    expected = [values[17:24, 17:24].mean(), values[12:19, 27:34].mean(), 0.0]
    np.testing.assert_allclose(subset_mean(values, points, 3), expected)


@pytest.mark.parametrize("s", [0.9, 1.4, 2.2])
def test_speckle_size_is_the_width_of_the_known_autocorrelation(make_texture, s: float) -> None:  # type: ignore[no-untyped-def]
    """exp(−l²/4s²) falls to one half at l = 2 s √ln 2."""
    image = 2000 + 500 * make_texture(seed=34, s=s).image((240, 200))
    image += np.random.default_rng(34).normal(0, 25, image.shape)
    area = disc(image.shape, (120, 100), 95)
    assert speckle_size(image, area) == pytest.approx(4 * s * np.sqrt(np.log(2)), rel=0.1)


def test_unresolved_texture_is_seen_through_the_noise(make_texture) -> None:  # type: ignore[no-untyped-def]
    rng, area = np.random.default_rng(35), np.ones((200, 240), bool)
    shares = {}
    for s in (0.55, 0.8, 1.4):
        image = 2000 + 400 * make_texture(seed=35, s=s).image((240, 200)) + rng.normal(0, 12, (200, 240))
        shares[s] = fine_texture_share(image, area, 12.0)
    assert shares[1.4] < 5e-4
    assert shares[0.55] > 2e-2
    assert shares[0.55] > shares[0.8] > shares[1.4]
    assert np.isnan(fine_texture_share(np.ones((20, 20)), np.ones((20, 20), bool), 0.0))
