"""What grey values show of an exposure, against images whose light and noise are written down here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from photogram.images.sequence import clip_level, missing_pattern_reason, mosaic_contrast

SHAPE = (300, 420)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]]
FULL = 1023


def seen(light: np.ndarray | float, seed: int = 1, noise: float = 2.0) -> np.ndarray:
    """What a sensor of 10 bits stores: shot noise of 8 electrons per grey value, noise of the dark sensor."""
    rng = np.random.default_rng(seed)
    light = np.broadcast_to(light, SHAPE)
    grey = (
        light + np.sqrt(np.maximum(light, 0.0) / 8.0) * rng.standard_normal(SHAPE) + noise * rng.standard_normal(SHAPE)
    )
    return np.clip(np.rint(grey), 0, FULL).astype(np.uint16)


def speckle(size_px: float, contrast: float, level: float = 300.0) -> np.ndarray:
    """A pattern whose autocorrelation is as wide (full width at half maximum) as `size_px`."""
    texture = np.random.default_rng(5).standard_normal(SHAPE)
    texture = cv2.GaussianBlur(texture, (0, 0), size_px / (2.0 * np.sqrt(2.0 * np.log(2.0)) * np.sqrt(2.0)))
    return np.asarray(level * (1.0 + contrast * texture / texture.std()))


RNG = np.random.default_rng(9)
LINES = 10.0 + 4.0 * RNG.standard_normal((1, SHAPE[1])) + 4.0 * RNG.standard_normal((SHAPE[0], 1))
BLANK = {
    "cap on": (seen(10.0), "dark"),
    "nothing at all": (np.zeros(SHAPE, np.uint16), "dark"),
    "rows and columns": (seen(LINES), "dark"),
    "hot pixels": (seen(10.0 + 900.0 * (RNG.random(SHAPE) < 1e-4)), "dark"),
    "overexposed": (seen(1060.0), "overexposed"),
    "clipped below full scale": (np.minimum(seen(700.0), 600), "overexposed"),
    "a sheet of paper": (seen(500.0), "uniform"),
    "a sheet, bright in the middle": (seen(600.0 * np.exp(-((X - 200.0) ** 2 + (Y - 150.0) ** 2) / 3e4)), "uniform"),
}
SHOWN = {
    "fine speckle": speckle(2.0, 0.3),
    "faint speckle": speckle(4.0, 0.03),
    "coarse speckle": speckle(15.0, 0.3),
    "underexposed speckle": speckle(4.0, 0.3, 30.0),
    "a small body": np.where((np.abs(X - 100) < 30) & (np.abs(Y - 80) < 30), speckle(4.0, 0.3), 10.0),
}


@pytest.mark.parametrize("name", BLANK)
def test_a_blank_image_is_reported_with_its_grey_values(name):
    image, why = BLANK[name]
    assert missing_pattern_reason(image, FULL).startswith(f"{why}, ")
    assert str(int(np.quantile(image, 0.99))) in missing_pattern_reason(image, FULL)


@pytest.mark.parametrize("name", SHOWN)
def test_a_pattern_is_seen_in_its_noise_and_without(name):
    assert missing_pattern_reason(seen(SHOWN[name]), FULL) == ""
    assert missing_pattern_reason(np.rint(np.clip(SHOWN[name], 0, FULL)).astype(np.uint16), FULL) == ""


def test_noise_alone_is_no_pattern_twenty_times_in_twenty():
    assert all(missing_pattern_reason(seen(level, seed), FULL) for seed in range(10) for level in (5.0, 400.0))


@pytest.mark.parametrize("name", SHOWN)
@pytest.mark.parametrize(("share", "codes"), [(0.4, 1), (0.02, 1), (0.02, 16)])
def test_grey_values_that_the_sensor_cuts_off_pile_up(name, share, codes):
    """Wherever below full scale, also where all grey values are multiples of 16 (12 bits in 16)."""
    grey = seen(SHOWN[name]) * np.uint16(codes)
    limit = int(np.quantile(grey[grey > grey.max() // 5], 1.0 - share))
    assert clip_level(grey) is None
    assert clip_level(np.minimum(grey, limit)) == limit


def test_images_with_few_grey_values_are_not_judged():
    assert clip_level(np.zeros(SHAPE, np.uint8)) is None
    assert clip_level((seen(SHOWN["faint speckle"]) > 300).astype(np.uint8)) is None


@pytest.mark.parametrize("name", SHOWN)
def test_a_raw_mosaic_of_colours_is_detected_by_its_diagonals(name):
    light = SHOWN[name]
    assert mosaic_contrast(seen(light)) == 0.0
    columns = 1.0 + 0.06 * (X % 2)  # two amplifiers, for even and odd columns
    assert mosaic_contrast(seen(light * columns)) == 0.0
    for turned in range(4):
        gains = np.rot90([[0.55, 1.0], [1.0, 0.7]], turned)
        assert mosaic_contrast(seen(light * np.tile(gains, (150, 210)))) > 0.2
