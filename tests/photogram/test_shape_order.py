"""Shape functions of order 0, 1 and 2: what each can follow, and what it costs in noise."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.bspline import spline_of_image
from photogram.subsets.icgn import noise_of_residual, position_covariance, register
from photogram.subsets.reference import PARAMETERS, TrackStatus, prepare_reference, shape_values, subset_offsets
from photogram.subsets.track import TrackSettings

SIZE, MIDDLE, RADIUS = (110, 100), np.array([55.0, 50.0]), 15
LIMITS = (30, 1e-5, 0.75)
CURVATURE = np.array([8e-4, -3e-4, 4e-4, -5e-4, 2e-4, 6e-4])
SHIFT = np.array([0.3, -0.4])


def displacement(points: np.ndarray) -> np.ndarray:
    """Displacement (M,2) of second order about the middle."""
    (x, y), c = (points - MIDDLE).T, CURVATURE
    curved = [c[k] * x * x / 2 + c[k + 1] * x * y + c[k + 2] * y * y / 2 for k in (0, 3)]
    return SHIFT + np.column_stack(curved)


def before(points: np.ndarray) -> np.ndarray:
    """Where the points (M,2) of the deformed image come from: fixed point of p = q + displacement(q)."""
    origin = points.copy()
    for _ in range(40):
        origin = points - displacement(origin)
    return origin


@pytest.fixture(scope="module")
def pair(make_texture) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    texture = make_texture(seed=61, s=1.5)
    return 2000 + 400 * texture.image(SIZE), 2000 + 400 * texture.image(SIZE, before)


def find(first: np.ndarray, second: np.ndarray, order: int, start: np.ndarray | None = None):  # type: ignore[no-untyped-def]
    reference = prepare_reference(spline_of_image(first), MIDDLE[None], RADIUS, order)
    return reference, register(
        reference, spline_of_image(second), np.zeros((1, 6)) if start is None else start, *LIMITS
    )


def test_second_order_recovers_what_biases_the_affine_map(pair) -> None:  # type: ignore[no-untyped-def]
    """An affine fit takes the mean of u over the subset, u + (u_xx + u_yy)·r(r+1)/6 where texture is evenly spread."""
    _, affine = find(*pair, 1)
    _, curved = find(*pair, 2)
    assert affine.status[0] == curved.status[0] == TrackStatus.OK
    assert curved.warp.shape == (1, 12)
    np.testing.assert_allclose(curved.warp[0, [0, 3]], SHIFT, atol=1e-3)
    np.testing.assert_allclose(curved.warp[0, [1, 2, 4, 5]], 0.0, atol=2e-4)
    np.testing.assert_allclose(curved.warp[0, 6:], CURVATURE, atol=4e-5)
    bias = (CURVATURE[[0, 3]] + CURVATURE[[2, 5]]) * RADIUS * (RADIUS + 1) / 6
    np.testing.assert_allclose(affine.warp[0, [0, 3]] - SHIFT, bias, atol=0.4 * np.abs(bias).max())
    assert np.abs(affine.warp[0, 0] - SHIFT[0]) > 0.02


def test_second_order_goes_on_from_its_own_warp(pair) -> None:  # type: ignore[no-untyped-def]
    _, curved = find(*pair, 2)
    _, again = find(*pair, 2, curved.warp)
    assert again.iterations[0] == 1
    np.testing.assert_allclose(again.warp, curved.warp, atol=1e-4)


def test_translation_keeps_the_gradients_of_its_start(make_texture) -> None:  # type: ignore[no-untyped-def]
    texture, turn = make_texture(seed=62, s=1.5), 0.05
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    first = 2000 + 400 * texture.image(SIZE)
    second = 2000 + 400 * texture.image(SIZE, lambda p: (p - MIDDLE - SHIFT) @ matrix + MIDDLE)
    gradients = (matrix - np.eye(2)).ravel()
    start = np.array([[0.0, *gradients[:2], 0.0, *gradients[2:]]])
    _, found = find(first, second, 0, start)
    np.testing.assert_allclose(found.warp[0, [0, 3]], SHIFT, atol=1e-3)
    np.testing.assert_array_equal(found.warp[0, [1, 2, 4, 5]], gradients)


def test_noise_grows_with_the_order_and_is_stated(make_texture) -> None:  # type: ignore[no-untyped-def]
    """Monte Carlo against the stated covariance, and the bound σ²(Σ JᵀJ)⁻¹ of each order made without the program."""
    texture, rng, noise = make_texture(seed=63, s=1.5), np.random.default_rng(63), 8.0
    first = 2000 + 400 * texture.image(SIZE)
    second = 2000 + 400 * texture.image(SIZE, lambda p: p - SHIFT)
    offsets = subset_offsets(RADIUS)
    step = 1e-4
    slopes = [(texture(MIDDLE + offsets + e) - texture(MIDDLE + offsets - e)) * 200 / step for e in step * np.eye(2)]
    spread, bounds = {}, {}
    noisy = first + rng.normal(0, noise, first.shape)
    targets = [spline_of_image(second + rng.normal(0, noise, second.shape)) for _ in range(250)]
    for order in (0, 1, 2):
        reference = prepare_reference(spline_of_image(noisy), MIDDLE[None], RADIUS, order)
        found = [register(reference, target, np.zeros((1, 6)), *LIMITS) for target in targets]
        spread[order] = np.var([here.warp[0, [0, 3]] for here in found], axis=0, ddof=1)
        stated = [position_covariance(reference, here, noise_of_residual(reference, here, 5))[0] for here in found]
        shapes = shape_values(offsets, order)
        grey = 400 * texture(MIDDLE + offsets)
        jacobian = np.stack([*(slopes[0] * shapes), *(slopes[1] * shapes), np.ones(len(grey)), grey], axis=1)
        bounds[order] = noise**2 * np.diag(np.linalg.inv(jacobian.T @ jacobian))[[0, len(shapes)]]
        np.testing.assert_allclose(np.sqrt(spread[order] / np.diag(np.mean(stated, axis=0))), 1.0, atol=0.15)
        np.testing.assert_allclose(np.sqrt(spread[order] / bounds[order]), 1.0, atol=0.15)
    assert np.all(bounds[0] <= bounds[1])
    assert np.all(spread[0] <= 1.05 * spread[1])
    assert np.all(spread[1] < 0.5 * spread[2])


def test_depth_of_twelve_bits_loses_nothing_and_gains_below_a_grey_level(make_texture) -> None:  # type: ignore[no-untyped-def]
    """The same scene in 8 and 12 bit: as good under noise of a grey level, twice as good where rounding rules."""
    texture, rng = make_texture(seed=64, s=1.5), np.random.default_rng(64)
    images = [0.5 + 0.1 * texture.image((150, 108), lambda p, s=s: p - s * SHIFT) for s in (0, 1)]
    centres = np.array([(x, y) for y in range(20, 90, 14) for x in range(20, 132, 14)], dtype=float)
    scatter: dict[tuple[int, float], float] = {}
    for noise in (1.0 / 255, 0.1 / 255):
        noisy = [image + rng.normal(0, noise, image.shape) for image in images]
        for depth in (8, 12, 16):
            grey = [np.rint(image * (2**depth - 1)).astype(np.uint16) for image in noisy]
            reference = prepare_reference(spline_of_image(grey[0]), centres, 10)
            found = register(reference, spline_of_image(grey[1]), np.zeros((len(centres), 6)), *LIMITS)
            assert np.all(found.status == TrackStatus.OK)
            scatter[depth, noise] = float(np.sqrt(np.mean((found.warp[:, [0, 3]] - SHIFT) ** 2)))
    assert scatter[12, 1.0 / 255] <= scatter[8, 1.0 / 255]
    assert scatter[12, 0.1 / 255] < 0.5 * scatter[8, 0.1 / 255]
    assert scatter[16, 0.1 / 255] <= 1.02 * scatter[12, 0.1 / 255]


def test_unknown_orders_are_named() -> None:
    assert PARAMETERS == {0: 2, 1: 6, 2: 12}
    with pytest.raises(ValueError, match="order: expected 0, 1 or 2, found 3"):
        prepare_reference(spline_of_image(np.eye(40)), MIDDLE[None], 5, 3)
    with pytest.raises(ValueError, match="shape_order: expected 0, 1 or 2, found -1"):
        TrackSettings(shape_order=-1)
