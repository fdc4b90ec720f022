"""Fixed pattern of sensors: correlations by Monte Carlo, the motion of rendered bodies, dark and flat images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pattern_factory import AMPLITUDE_PX, COLUMNS, FRAMES, PHASE, PIXEL_M, clean_images, measured, relative_error
from speckle import sequence

from photogram.bspline import evaluate, pattern_overlap, spline_of_image
from photogram.images.flat_field import corrected_sequence, flat_field
from photogram.images.sensor_pattern import TYPICAL, SensorPattern, stated_pattern
from photogram.images.sequence import ImageSequence
from photogram.measure.body import BodyMotion
from photogram.measure.fixed_pattern import cell_phasors


@pytest.fixture(scope="module")
def clean() -> list[list[np.ndarray]]:
    return clean_images()


def unequal_gains(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(image * (1.0 + 0.01 * rng.standard_normal(image.shape)) + 1e-3 * rng.standard_normal(image.shape))


def u_of(body: BodyMotion) -> float:
    """The relative standard uncertainty of the amplitude by noise and by the size of the pattern."""
    inverse = np.linalg.pinv(COLUMNS)
    left = body.motion.pose[:, 0] - COLUMNS @ (inverse @ body.motion.pose[:, 0])
    noise = np.linalg.norm(left) / np.sqrt(FRAMES - 3) * np.linalg.norm(inverse[1])
    assert body.pattern is not None
    size = np.linalg.norm(np.einsum("f,fj->j", inverse[1], body.pattern.change[..., 0]))
    return float(np.hypot(noise, size)) / (AMPLITUDE_PX * PIXEL_M)


@pytest.mark.parametrize("degree", [3, 5, 7])
@pytest.mark.parametrize("shift", [0.2, 0.5, 1.3])
def test_overlap_of_a_pattern_is_that_of_white_noise(degree, shift):
    noise = np.random.default_rng(5).standard_normal((400, 400))
    grid = np.stack(np.meshgrid(np.arange(40.0, 360), np.arange(40.0, 360)), axis=-1).reshape(-1, 2)
    spline = spline_of_image(noise, degree)
    here, slope = evaluate(spline, grid)
    there, _ = evaluate(spline, grid + np.array([shift, 0.0]))
    value, slopes = pattern_overlap(np.array(shift), degree)
    chance = 4.0 * np.sqrt(2.0 / len(grid))
    assert abs(np.mean(here * there) - value) < chance
    assert abs(np.mean(slope[:, 0] * there) - slopes) < chance * 1.9


def test_a_pattern_shortens_the_motion_and_is_corrected(clean):
    body = measured(clean, 1, unequal_gains)
    assert body.pattern is not None
    as_seen, error, u = (
        relative_error(body.motion.pose - body.pattern.correction),
        relative_error(body.motion.pose),
        u_of(body),
    )
    assert as_seen < -0.01  # by (pattern/contrast)²
    assert abs(error) < 3.0 * u < 0.004
    prnu = TYPICAL.prnu * np.sqrt(body.pattern.variance[:, 0])
    np.testing.assert_allclose(prnu, 0.01, rtol=0.1)


def test_without_a_pattern_the_correction_is_within_its_uncertainty(clean):
    body = measured(clean, 3, lambda image, _: image)
    assert body.pattern is not None
    assert abs(relative_error(body.motion.pose)) < 3.0 * u_of(body) < 0.002
    sure = measured(clean, 3, lambda image, _: image, stated_pattern(0.0, 0.0))
    assert u_of(sure) < u_of(body)


def test_frames_show_a_pattern_that_was_stated_wrongly(clean):
    body = measured(clean, 1, unequal_gains, stated_pattern(0.002, 0.0))
    assert body.pattern is not None
    size, u = body.pattern.variance.T  # columns, rows and shadows, of which nothing was stated, share what is found
    assert np.all(size > 1.0 + 5.0 * u)
    assert abs(relative_error(body.motion.pose)) < 0.004


def test_images_of_the_displaced_body_show_the_pattern():
    """Where the body hardly moves, what is known of the sensor decides, unless it is displaced once."""
    still, elsewhere = clean_images(0.02 * np.cos(PHASE)), clean_images(np.array([1.5, -2.0, 2.5, -1.2]))
    alone, shown = (measured(still, 6, unequal_gains, displaced=further) for further in (None, elsewhere))
    assert alone.pattern is not None
    assert shown.pattern is not None
    assert alone.pattern.variance[0, 1] > 1.0
    assert np.all(shown.pattern.variance[:, 1] < 0.3)
    np.testing.assert_allclose(TYPICAL.prnu * np.sqrt(shown.pattern.variance[:, 0]), 0.01, rtol=0.1)


def test_cells_err_alike_in_every_period(clean):
    """Residual slopes of cells repeat with the motion by more than noise only where there is a pattern."""
    ratios = []
    for changed in (unequal_gains, lambda image, _: image):
        body = measured(clean, 4, changed)
        columns = COLUMNS[body.tracked.residual_frames]
        found, noise = cell_phasors(body.tracked.fits(), columns)
        expected = np.linalg.inv(columns.T @ columns)[1, 1] * noise[:, 0, 0].sum()
        ratios.append(float(np.sum(found[1, :, 0] ** 2)) / expected)
    assert ratios[0] > 2.0
    assert abs(ratios[1] - 1.0) < 0.5


# Dark and flat images.

SIZE = (48, 64)
RNG = np.random.default_rng(9)
GAIN, DARK = 1.0 + 0.01 * RNG.standard_normal(SIZE), 100.0 + 5.0 * RNG.standard_normal(SIZE)


def exposed(light: float | np.ndarray, count: int = 8, full_scale: int = 4095) -> ImageSequence:
    images = [np.rint(DARK + light * GAIN + RNG.standard_normal(SIZE)).clip(0, full_scale) for _ in range(count)]
    return sequence([image.astype(np.uint16) for image in images], full_scale)


def test_dark_and_flat_images_remove_the_pattern():
    images = exposed(1000.0)
    field = flat_field(images, exposed(0.0, 64), exposed(2000.0, 64))
    even = corrected_sequence(images, field)
    assert images.read(0).std() > 10.0
    assert even.read(0).std() < 1.5  # noise of 1, rounding, and that of the flat images
    assert abs(float(even.read(0).mean()) - float(images.read(0).mean())) < 1.0
    assert even.pattern == field.remaining
    assert field.remaining.prnu == pytest.approx(np.sqrt(2.0) / 8.0 / 2000.0, rel=0.1)
    assert field.remaining.dsnu == pytest.approx(1.0 / 8.0 / 4095.0, rel=0.15)


@pytest.mark.parametrize("saturation", [4095, 3000])
def test_the_same_pixels_are_saturated_after_a_correction(saturation):
    raw = (2999 + np.arange(12)).reshape(3, 4).astype(np.uint16)
    raw[0] = saturation
    gain = np.full((3, 4), 1.0, np.float32)
    gain[:, ::2] = 1.1
    gain[:, 1::2] = 0.7
    field = flat_field(exposed(1000.0), None, exposed(2000.0))
    even = replace(field, dark=np.zeros((3, 4), np.float32), gain=gain).correct(raw, saturation)
    np.testing.assert_array_equal(even >= saturation, raw >= saturation)


@pytest.mark.parametrize(
    ("dark", "flat", "said"),
    [
        (lambda: exposed(0.0, 1), None, "at least 2 images"),
        (lambda: exposed(1500.0), None, "dark images, with the lens covered"),
        (None, lambda: exposed(9000.0), "not saturated"),
        (lambda: exposed(0.0), lambda: exposed(-1.0), "brighter than the dark ones"),
        (None, lambda: exposed(np.tile([[500.0, 2000.0], [2000.0, 500.0]], (24, 32))), "even, unsharp surface"),
        (lambda: exposed(0.0, full_scale=1023), None, "bit depth of 12, found 10"),
        (lambda: sequence([np.zeros((8, 8), np.uint16)] * 4), None, "64 x 48 px, found 8 x 8"),
        (lambda: replace(exposed(0.0), exposure_s=2e-4), None, "an exposure of 100 µs"),
    ],
)
def test_dark_and_flat_images_of_another_kind_are_refused(dark, flat, said):
    images = replace(exposed(1000.0), exposure_s=1e-4)
    with pytest.raises(ValueError, match=said) as error:
        flat_field(images, dark and dark(), flat and flat())
    assert "frame" in str(error.value)  # the file


@pytest.mark.parametrize("field", ["prnu", "dsnu", "variance_uncertainty", "lines", "shadows"])
def test_a_pattern_is_finite(field):
    with pytest.raises(ValueError, match=field):
        SensorPattern(**{field: -1.0})
