"""Registration against an analytic texture: bias, scatter against the bound, affine maps, invariances, edges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photogram.bspline import spline_of_image
from photogram.subsets.icgn import noise_of_residual, position_covariance, register
from photogram.subsets.reference import PARAMETERS, TrackStatus, prepare_reference, shape_values, subset_offsets
from photogram.subsets.track import TrackSettings

SIZE = (150, 108)
CENTRES = np.array([(x, y) for y in range(20, 90, 22) for x in range(20, 132, 22)], dtype=float)
LIMITS = (30, 1e-4, 0.75)


def grey(texture_image: np.ndarray, full_scale: int = 4095) -> np.ndarray:
    """Contrast of a tenth of full scale about the middle."""
    return (0.5 + 0.1 * texture_image) * full_scale


@pytest.fixture(scope="module")
def texture(make_texture):
    return make_texture(seed=11, s=1.5)


@pytest.fixture(scope="module")
def image(texture) -> np.ndarray:
    return grey(texture.image(SIZE))


def find(reference_image, target_image, centres=CENTRES, radius=10, degree=5, start=None):
    reference = prepare_reference(spline_of_image(reference_image, degree), centres, radius)
    start = np.zeros((len(centres), 6)) if start is None else start
    return reference, register(reference, spline_of_image(target_image, degree), start, *LIMITS)


@pytest.mark.parametrize("offset", [0.0, 0.37])
def test_bias_of_sub_pixel_translations_is_below_0p3_mpx(texture, image, offset: float) -> None:
    for shift in (0.125, 0.25, 0.5, 0.8):
        moved = grey(texture.image(SIZE, lambda p, s=shift: p - [s, -s / 2]))
        _, found = find(image, moved, CENTRES + offset)
        assert np.all(found.status == TrackStatus.OK)
        error = found.warp[:, [0, 3]] - [shift, -shift / 2]
        assert np.abs(error.mean(axis=0)).max() < 3e-4
        assert np.abs(error).max() < 2e-3


def test_affine_maps_come_back(texture, image) -> None:
    turn = 0.05
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ np.diag([0.96, 1.03])
    middle, shift = np.array([70.0, 50.0]), np.array([0.4, -0.3])
    moved = grey(texture.image(SIZE, lambda p: (p - middle - shift) @ np.linalg.inv(matrix).T + middle))
    centres = np.array([[60.0, 50.0], [80.0, 45.0], [70.0, 60.0]])
    truth = (centres - middle) @ matrix.T + middle + shift
    _, found = find(image, moved, centres)
    np.testing.assert_allclose(centres + found.warp[:, [0, 3]], truth, atol=2e-3)
    np.testing.assert_allclose(found.warp[:, [1, 2, 4, 5]], np.tile((matrix - np.eye(2)).ravel(), (3, 1)), atol=5e-4)


def test_scatter_is_stated_and_near_the_bound(texture, image) -> None:
    """Stated covariance against Monte Carlo; the bound of a subset of 31 px whose affine map and gain are known."""
    rng, noise, radius = np.random.default_rng(12), 6.0, 15
    centres = np.array([(x, y) for y in (20, 52, 84) for x in (20.4, 52.4, 84.4, 116.4)])
    moved = grey(texture.image(SIZE, lambda p: p - [0.3, 0.6]))
    exact = prepare_reference(spline_of_image(image), centres, radius)
    reference = prepare_reference(spline_of_image(image + rng.normal(0, noise, image.shape)), centres, radius)
    positions, covariances, noises = [], [], []
    for _ in range(120):
        target = spline_of_image(moved + rng.normal(0, noise, image.shape))
        found = register(reference, target, np.zeros((len(centres), 6)), *LIMITS)
        noises.append(noise_of_residual(reference, found, 5))
        covariances.append(position_covariance(reference, found, noises[-1]))
        positions.append(found.warp[:, [0, 3]])
    variance = np.var(positions, axis=0, ddof=1).mean(axis=0)
    stated = np.mean(covariances, axis=(0, 1))[[0, 1], [0, 1]]
    bound = np.mean(noise**2 / np.sum(exact.pixels[:, 1:] ** 2, axis=2), axis=0)
    np.testing.assert_allclose(np.sqrt(variance / stated), 1.0, atol=0.06)
    assert np.all(np.sqrt(variance / bound) < 1.2)
    assert np.mean(noises) == pytest.approx(noise, rel=0.03)


def test_noise_is_not_lost_between_twelve_and_eight_bits(texture, image) -> None:
    """Quantisation steps of 8 bits move positions by several times what the steps of 12 bits do."""
    moved = grey(texture.image(SIZE, lambda p: p - [0.3, 0.6]))
    scatter = {}
    for bits in (8, 12):
        step = 2.0 ** (12 - bits)
        _, found = find(np.round(image / step), np.round(moved / step))
        scatter[bits] = np.std(found.warp[:, 0])
    assert scatter[8] > 4 * scatter[12]


@settings(max_examples=15, deadline=None)
@given(gain=st.floats(0.5, 1.8), offset=st.floats(-300, 300))
def test_gain_and_offset_change_nothing(gain: float, offset: float) -> None:
    rng = np.random.default_rng(13)
    smooth = np.cumsum(np.cumsum(rng.normal(size=(64, 64)), axis=0), axis=1)
    first, second = smooth[:-1, :-1], smooth[1:, 1:]
    centres = np.array([[25.0, 25.0], [38.0, 31.0]])
    _, plain = find(first, second, centres)
    _, changed = find(first, gain * second + offset, centres)
    np.testing.assert_allclose(changed.warp, plain.warp, atol=1e-6)
    np.testing.assert_allclose(changed.zncc, plain.zncc, atol=1e-9)
    np.testing.assert_allclose(changed.gain, gain * plain.gain, rtol=1e-6)


@settings(max_examples=15, deadline=None)
@given(dx=st.integers(-2, 2), dy=st.integers(-2, 2), seed=st.integers(0, 100))
def test_whole_pixel_shifts_are_exact(dx: int, dy: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    kernel = np.exp(-(np.arange(-6, 7) ** 2) / 2 / 1.8**2)
    rough = rng.normal(size=(90, 90))
    smooth = np.apply_along_axis(
        np.convolve, 0, np.apply_along_axis(np.convolve, 1, rough, kernel, "same"), kernel, "same"
    )
    shifted = np.roll(smooth, (dy, dx), axis=(0, 1))
    centres = np.array([[40.0, 40.0], [50.0, 45.0]])
    start = np.tile([0.8 * dx, 0, 0, 0.8 * dy, 0, 0], (2, 1))
    _, found = find(smooth, shifted, centres, start=start)
    assert np.all(found.status == TrackStatus.OK)
    np.testing.assert_allclose(found.warp[:, [0, 3]], [[dx, dy]] * 2, atol=1e-4)
    np.testing.assert_allclose(found.zncc, 1.0, atol=1e-6)


def test_an_edge_is_followed_across_and_said_to_be_blind_along(texture) -> None:
    rng = np.random.default_rng(14)
    rows = np.arange(60.0)[:, None]
    edge = lambda shift: 1000 + 800 * np.tanh((rows - 30 - shift) / 2) + rng.normal(0, 5, (60, 80))  # noqa: E731
    reference, found = find(edge(0.0), edge(0.3), np.array([[40.0, 30.0]]))
    assert found.status[0] == TrackStatus.OK
    assert found.warp[0, 3] == pytest.approx(0.3, abs=5e-3)
    assert abs(found.warp[0, 0]) < 1e-3
    covariance = position_covariance(reference, found, noise_of_residual(reference, found, 5))[0]
    assert covariance[0, 0] > 100 * covariance[1, 1]


def test_every_failure_has_its_status(image) -> None:
    noise = np.random.default_rng(15).normal(100, 5, image.shape)
    centres = np.array([[60.0, 50.0], [12.0, 50.0], [3.0, 50.0]])
    start = np.zeros((3, 6))
    start[1, 0] = -6.0
    _, found = find(image, image, centres, start=start)
    assert found.status.tolist() == [TrackStatus.OK, TrackStatus.LEFT_IMAGE, TrackStatus.LEFT_IMAGE]
    assert np.isnan(found.warp[1:]).all()
    assert find(np.full_like(image, 100.0), image, centres[:1])[1].status[0] == TrackStatus.FLAT
    assert find(noise, image, centres[:1])[1].status[0] == TrackStatus.FLAT
    assert find(image, image, centres[:1], start=np.full((1, 6), np.nan))[1].status[0] == TrackStatus.NO_START
    lost = find(image, noise, centres[:1])[1].status[0]
    assert lost in (TrackStatus.LOW_CORRELATION, TrackStatus.NOT_CONVERGED)


# Shape functions of order 0, 1 and 2: what each can follow, and what it costs in noise.

CURVED_SIZE, MIDDLE, RADIUS = (110, 100), np.array([55.0, 50.0]), 15
FINE_LIMITS = (30, 1e-5, 0.75)
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
def pair(make_texture) -> tuple[np.ndarray, np.ndarray]:
    texture = make_texture(seed=61, s=1.5)
    return 2000 + 400 * texture.image(CURVED_SIZE), 2000 + 400 * texture.image(CURVED_SIZE, before)


def find_order(first: np.ndarray, second: np.ndarray, order: int, start: np.ndarray | None = None):
    reference = prepare_reference(spline_of_image(first), MIDDLE[None], RADIUS, order)
    return reference, register(
        reference, spline_of_image(second), np.zeros((1, 6)) if start is None else start, *FINE_LIMITS
    )


def test_second_order_recovers_what_biases_the_affine_map(pair) -> None:
    """An affine fit takes the mean of u over the subset, u + (u_xx + u_yy)·r(r+1)/6 where texture is evenly spread."""
    _, affine = find_order(*pair, 1)
    _, curved = find_order(*pair, 2)
    assert affine.status[0] == curved.status[0] == TrackStatus.OK
    assert curved.warp.shape == (1, 12)
    np.testing.assert_allclose(curved.warp[0, [0, 3]], SHIFT, atol=1e-3)
    np.testing.assert_allclose(curved.warp[0, [1, 2, 4, 5]], 0.0, atol=2e-4)
    np.testing.assert_allclose(curved.warp[0, 6:], CURVATURE, atol=4e-5)
    bias = (CURVATURE[[0, 3]] + CURVATURE[[2, 5]]) * RADIUS * (RADIUS + 1) / 6
    np.testing.assert_allclose(affine.warp[0, [0, 3]] - SHIFT, bias, atol=0.4 * np.abs(bias).max())
    assert np.abs(affine.warp[0, 0] - SHIFT[0]) > 0.02


def test_second_order_goes_on_from_its_own_warp(pair) -> None:
    _, curved = find_order(*pair, 2)
    _, again = find_order(*pair, 2, curved.warp)
    assert again.iterations[0] == 1
    np.testing.assert_allclose(again.warp, curved.warp, atol=1e-4)


def test_translation_keeps_the_gradients_of_its_start(make_texture) -> None:
    texture, turn = make_texture(seed=62, s=1.5), 0.05
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    first = 2000 + 400 * texture.image(CURVED_SIZE)
    second = 2000 + 400 * texture.image(CURVED_SIZE, lambda p: (p - MIDDLE - SHIFT) @ matrix + MIDDLE)
    gradients = (matrix - np.eye(2)).ravel()
    start = np.array([[0.0, *gradients[:2], 0.0, *gradients[2:]]])
    _, found = find_order(first, second, 0, start)
    np.testing.assert_allclose(found.warp[0, [0, 3]], SHIFT, atol=1e-3)
    np.testing.assert_array_equal(found.warp[0, [1, 2, 4, 5]], gradients)


@pytest.mark.slow
def test_noise_grows_with_the_order_and_is_stated(make_texture) -> None:
    """Monte Carlo against the stated covariance, and the bound σ²(Σ JᵀJ)⁻¹ of each order made without the program."""
    texture, rng, noise = make_texture(seed=63, s=1.5), np.random.default_rng(63), 8.0
    first = 2000 + 400 * texture.image(CURVED_SIZE)
    second = 2000 + 400 * texture.image(CURVED_SIZE, lambda p: p - SHIFT)
    offsets = subset_offsets(RADIUS)
    step = 1e-4
    slopes = [(texture(MIDDLE + offsets + e) - texture(MIDDLE + offsets - e)) * 200 / step for e in step * np.eye(2)]
    spread, bounds = {}, {}
    noisy = first + rng.normal(0, noise, first.shape)
    targets = [spline_of_image(second + rng.normal(0, noise, second.shape)) for _ in range(250)]
    for order in (0, 1, 2):
        reference = prepare_reference(spline_of_image(noisy), MIDDLE[None], RADIUS, order)
        found = [register(reference, target, np.zeros((1, 6)), *FINE_LIMITS) for target in targets]
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


def test_depth_of_twelve_bits_loses_nothing_and_gains_below_a_grey_level(make_texture) -> None:
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
            found = register(reference, spline_of_image(grey[1]), np.zeros((len(centres), 6)), *FINE_LIMITS)
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
