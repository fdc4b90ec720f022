"""B-splines: SciPy's exact prefilter, polynomials, finite differences, Monte Carlo of the noise gains."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from photogram.bspline import PADDING_PX, Spline, evaluate, grey_values, noise_gain, slope_noise_gain, spline_of_image


@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("shape", [(8, 9), (37, 90), (130, 65)])
def test_coefficients_and_values_are_scipys(degree: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    image = rng.normal(size=shape)
    spline = spline_of_image(image, degree)
    inside = spline.coefficients[PADDING_PX:-PADDING_PX, PADDING_PX:-PADDING_PX]
    np.testing.assert_allclose(inside, ndimage.spline_filter(image, degree, mode="mirror"), atol=1e-11)
    points = rng.uniform(0, [shape[1] - 1, shape[0] - 1], (500, 2))
    expected = ndimage.map_coordinates(image, points[:, ::-1].T, order=degree, mode="mirror")
    np.testing.assert_allclose(evaluate(spline, points)[0], expected, atol=1e-11)


@pytest.mark.parametrize("degree", [3, 5, 7])
def test_the_spline_passes_through_the_pixels(degree: int) -> None:
    image = np.random.default_rng(4).integers(0, 4096, (20, 24), dtype=np.uint16)
    rows, columns = np.indices(image.shape)
    points = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    np.testing.assert_allclose(evaluate(spline_of_image(image, degree), points)[0], image.ravel(), atol=1e-9)
    np.testing.assert_allclose(grey_values(spline_of_image(image, degree)), image, atol=1e-9)


@pytest.mark.parametrize("degree", [3, 5, 7])
def test_polynomials_of_the_degree_are_exact_far_from_the_border(degree: int) -> None:
    x = np.arange(121.0) - 60.0
    image = np.add.outer((x / 10) ** degree, (x / 10) ** (degree - 1))
    points = np.random.default_rng(5).uniform(57, 63, (200, 2))
    u, v = (points - 60.0).T / 10
    values, gradients = evaluate(spline_of_image(image, degree), points)
    np.testing.assert_allclose(values, v**degree + u ** (degree - 1), atol=1e-9)
    np.testing.assert_allclose(gradients[:, 0], (degree - 1) * u ** (degree - 2) / 10, atol=1e-8)
    np.testing.assert_allclose(gradients[:, 1], degree * v ** (degree - 1) / 10, atol=1e-8)


def test_speckle_is_interpolated_to_the_known_accuracy(make_texture) -> None:  # type: ignore[no-untyped-def]
    texture = make_texture(seed=6, s=1.5)
    image = texture.image((64, 64))
    points = np.random.default_rng(6).uniform(12, 52, (2000, 2))
    error = {
        degree: np.std(evaluate(spline_of_image(image, degree), points)[0] - texture(points)) for degree in (3, 5, 7)
    }
    assert error[5] < 1e-3
    assert error[3] > 3 * error[5]
    assert error[5] > 2 * error[7]


def test_points_outside_the_image_are_nan() -> None:
    spline = spline_of_image(np.ones((10, 12)))
    values, gradients = evaluate(spline, np.array([[-0.01, 5], [11.01, 5], [5, 9.01], [np.nan, 5], [11, 9]]))
    assert np.isnan(values).tolist() == [True, True, True, True, False]
    assert np.isnan(gradients).all(axis=1).tolist() == [True, True, True, True, False]


@pytest.mark.parametrize("degree", [3, 5, 7])
def test_noise_gains_are_those_of_noise(degree: int) -> None:
    noise = np.random.default_rng(7).normal(size=(400, 400))
    spline = spline_of_image(noise, degree)
    places = np.stack(np.meshgrid(np.arange(10.0, 390), np.arange(10.0, 390)), axis=-1).reshape(-1, 2)
    for shift in (0.0, 0.25, 0.5):
        values, gradients = evaluate(spline, places + np.array([shift, 0.0]))
        assert np.var(values) == pytest.approx(float(noise_gain(np.array(shift), degree)), rel=0.02)
        if shift == 0.0:
            assert np.var(gradients[:, 0]) == pytest.approx(slope_noise_gain(degree), rel=0.02)


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="degree: expected 3, 5 or 7, found 4"):
        spline_of_image(np.ones((10, 10)), 4)
    with pytest.raises(ValueError, match="image: expected at least 8 x 8 px"):
        spline_of_image(np.ones((5, 10)))
    with pytest.raises(ValueError, match="degree: expected 3, 5 or 7"):
        Spline(np.ones((16, 16)), 2)
