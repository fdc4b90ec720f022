"""Registration by both engines against an analytic texture: bias, scatter, affine maps, invariances, edges."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from contracts import NEEDS_GPU, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import gaussian_filter
from speckle import spline_frames

from photogram.bspline import spline_of_image
from photogram.lanes import basis_polynomials
from photogram.subsets import icgn_torch as engine
from photogram.subsets.icgn import Registration, TrackSettings, noise_of_residual, position_covariance, register
from photogram.subsets.icgn_torch import TorchSplines, register_frames, torch_reference
from photogram.subsets.reference import (
    PARAMETERS,
    ReferenceSubsets,
    TrackStatus,
    prepare_reference,
    shape_values,
    subset_offsets,
)

SIZE = (150, 108)
CENTRES = np.array([(x, y) for y in range(20, 90, 22) for x in range(20, 132, 22)], dtype=float)
SETTINGS = TrackSettings()


def grey(texture_image: np.ndarray, full_scale: int = 4095) -> np.ndarray:
    """Contrast of a tenth of full scale about the middle."""
    return (0.5 + 0.1 * texture_image) * full_scale


@pytest.fixture(scope="module")
def texture(make_texture):
    return make_texture(seed=11, s=1.5)


@pytest.fixture(scope="module")
def image(texture) -> np.ndarray:
    return grey(texture.image(SIZE))


def find(reference_image, target_image, centres=CENTRES, radius=10, order=1, start=None, how=SETTINGS):
    reference = prepare_reference(spline_of_image(reference_image), centres, radius, order)
    start = np.zeros((len(centres), 6)) if start is None else start
    return reference, register(reference, spline_of_image(target_image), start, how)


def turn_by(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@pytest.mark.parametrize("offset", [0.0, 0.37])
def test_bias_of_sub_pixel_translations_is_below_0p3_mpx(texture, image, offset):
    for shift in (0.125, 0.25, 0.5, 0.8):
        moved = grey(texture.image(SIZE, lambda p, s=shift: p - [s, -s / 2]))
        _, found = find(image, moved, CENTRES + offset)
        assert np.all(found.status == TrackStatus.OK)
        error = found.warp[:, [0, 3]] - [shift, -shift / 2]
        assert np.abs(error.mean(axis=0)).max() < 3e-4
        assert np.abs(error).max() < 2e-3


def test_affine_maps_come_back(texture, image):
    matrix = turn_by(0.05) @ np.diag([0.96, 1.03])
    middle, shift = np.array([70.0, 50.0]), np.array([0.4, -0.3])
    moved = grey(texture.image(SIZE, lambda p: (p - middle - shift) @ np.linalg.inv(matrix).T + middle))
    centres = np.array([[60.0, 50.0], [80.0, 45.0], [70.0, 60.0]])
    truth = (centres - middle) @ matrix.T + middle + shift
    _, found = find(image, moved, centres)
    np.testing.assert_allclose(centres + found.warp[:, [0, 3]], truth, atol=2e-3)
    np.testing.assert_allclose(found.warp[:, [1, 2, 4, 5]], np.tile((matrix - np.eye(2)).ravel(), (3, 1)), atol=5e-4)


def test_scatter_is_stated_and_near_the_bound(texture, image):
    """Stated covariance against Monte Carlo; the bound of a subset of 31 px whose affine map and gain are known."""
    rng, noise, radius = np.random.default_rng(12), 6.0, 15
    centres = np.array([(x, y) for y in (20, 52, 84) for x in (20.4, 52.4, 84.4, 116.4)])
    moved = grey(texture.image(SIZE, lambda p: p - [0.3, 0.6]))
    exact = prepare_reference(spline_of_image(image), centres, radius)
    reference = prepare_reference(spline_of_image(image + rng.normal(0, noise, image.shape)), centres, radius)
    positions, covariances, noises = [], [], []
    for _ in range(120):
        target = spline_of_image(moved + rng.normal(0, noise, image.shape))
        found = register(reference, target, np.zeros((len(centres), 6)), SETTINGS)
        noises.append(noise_of_residual(reference, found, 5))
        covariances.append(position_covariance(reference, found, noises[-1]))
        positions.append(found.warp[:, [0, 3]])
    variance = np.var(positions, axis=0, ddof=1).mean(axis=0)
    stated = np.mean(covariances, axis=(0, 1))[[0, 1], [0, 1]]
    bound = np.mean(noise**2 / np.sum(exact.pixels[:, 1:] ** 2, axis=2), axis=0)
    np.testing.assert_allclose(np.sqrt(variance / stated), 1.0, atol=0.06)
    assert np.all(np.sqrt(variance / bound) < 1.2)
    assert np.mean(noises) == pytest.approx(noise, rel=0.03)


@pytest.mark.parametrize("radius", [10, 11, 12])
@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_the_noise_of_residuals_is_that_of_pixels_in_subsets_of_any_size(texture, image, radius, shift):
    rng, noise = np.random.default_rng(18), 6.0
    moved = grey(texture.image(SIZE, lambda p: p - shift))
    reference, found = find(image + rng.normal(0, noise, SIZE[::-1]), moved + rng.normal(0, noise, SIZE[::-1]),
                            radius=radius)  # fmt: skip
    level = np.sqrt(np.mean(noise_of_residual(reference, found, 5) ** 2))
    assert level == pytest.approx(noise, rel=4.0 / np.sqrt(2.0 * len(CENTRES) * (2 * radius + 1) ** 2))


@settings(max_examples=15, deadline=None)
@given(gain=st.floats(0.5, 1.8), offset=st.floats(-300, 300))
def test_gain_and_offset_have_no_effect(gain, offset):
    rng = np.random.default_rng(13)
    smooth = np.cumsum(np.cumsum(rng.normal(size=(64, 64)), axis=0), axis=1)
    first, second = smooth[:-1, :-1], smooth[1:, 1:]
    centres = np.array([[25.0, 25.0], [38.0, 31.0]])
    _, plain = find(first, second, centres)
    _, changed = find(first, gain * second + offset, centres)
    np.testing.assert_allclose(changed.warp, plain.warp, atol=1e-5)  # float32 rounds other grey values otherwise
    np.testing.assert_allclose(changed.zncc, plain.zncc, atol=1e-9)
    np.testing.assert_allclose(changed.gain, gain * plain.gain, rtol=1e-6)


@settings(max_examples=15, deadline=None)
@given(dx=st.integers(-2, 2), dy=st.integers(-2, 2), seed=st.integers(0, 100))
def test_whole_pixel_shifts_are_exact(dx, dy, seed):
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=(90, 90)), 1.8)
    shifted = np.roll(smooth, (dy, dx), axis=(0, 1))
    centres = np.array([[40.0, 40.0], [50.0, 45.0]])
    start = np.tile([0.8 * dx, 0, 0, 0.8 * dy, 0, 0], (2, 1))
    _, found = find(smooth, shifted, centres, start=start)
    assert np.all(found.status == TrackStatus.OK)
    np.testing.assert_allclose(found.warp[:, [0, 3]], [[dx, dy]] * 2, atol=1e-4)
    np.testing.assert_allclose(found.zncc, 1.0, atol=1e-6)


def test_an_edge_is_tracked_across_and_undetermined_along(texture):
    rng = np.random.default_rng(14)
    rows = np.arange(60.0)[:, None]
    edge = lambda shift: 1000 + 800 * np.tanh((rows - 30 - shift) / 2) + rng.normal(0, 5, (60, 80))  # noqa: E731
    reference, found = find(edge(0.0), edge(0.3), np.array([[40.0, 30.0]]))
    assert found.status[0] == TrackStatus.OK
    assert found.warp[0, 3] == pytest.approx(0.3, abs=5e-3)
    assert abs(found.warp[0, 0]) < 1e-3
    covariance = position_covariance(reference, found, noise_of_residual(reference, found, 5))[0]
    assert covariance[0, 0] > 100 * covariance[1, 1]


@pytest.mark.parametrize("noise", [50.0, 70.0])
def test_undetermined_deformation_holds_back_no_part_of_the_motion(texture, image, noise):
    """Noise near the texture's slopes: errors of both images' noise only, twice the variance stated for one."""
    rng, shift = np.random.default_rng(16), np.array([0.8, -0.6])
    moved = grey(texture.image(SIZE, lambda p: p - shift))
    reference, found = find(image + rng.normal(0, noise, image.shape), moved + rng.normal(0, noise, image.shape))
    assert np.mean(found.status == TrackStatus.OK) > 0.7
    covariance = position_covariance(reference, found, np.full(len(CENTRES), noise))
    error = (found.warp[:, [0, 3]] - shift)[found.status == TrackStatus.OK]
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance[found.status == TrackStatus.OK]), error)
    assert np.sum(chi2) < 2.0 * stats.chi2.ppf(0.999, 2 * len(chi2))


def test_every_failure_has_its_status(image):
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
FINE = TrackSettings(convergence_px=1e-5)
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
    return find(first, second, MIDDLE[None], RADIUS, order, start, FINE)[1]


def test_second_order_recovers_what_biases_the_affine_map(pair):
    """An affine fit takes the mean of u over the subset, u + (u_xx + u_yy)·r(r+1)/6 where texture is evenly spread."""
    affine = find_order(*pair, 1)
    curved = find_order(*pair, 2)
    assert affine.status[0] == curved.status[0] == TrackStatus.OK
    assert curved.warp.shape == (1, 12)
    np.testing.assert_allclose(curved.warp[0, [0, 3]], SHIFT, atol=1e-3)
    np.testing.assert_allclose(curved.warp[0, [1, 2, 4, 5]], 0.0, atol=2e-4)
    np.testing.assert_allclose(curved.warp[0, 6:], CURVATURE, atol=4e-5)
    bias = (CURVATURE[[0, 3]] + CURVATURE[[2, 5]]) * RADIUS * (RADIUS + 1) / 6
    np.testing.assert_allclose(affine.warp[0, [0, 3]] - SHIFT, bias, atol=0.4 * np.abs(bias).max())
    assert np.abs(affine.warp[0, 0] - SHIFT[0]) > 0.02
    again = find_order(*pair, 2, curved.warp)
    assert again.iterations[0] == 1
    np.testing.assert_allclose(again.warp, curved.warp, atol=1e-4)


def test_translation_keeps_the_gradients_of_its_start(make_texture):
    texture, matrix = make_texture(seed=62, s=1.5), turn_by(0.05)
    first = 2000 + 400 * texture.image(CURVED_SIZE)
    second = 2000 + 400 * texture.image(CURVED_SIZE, lambda p: (p - MIDDLE - SHIFT) @ matrix + MIDDLE)
    gradients = (matrix - np.eye(2)).ravel()
    start = np.array([[0.0, *gradients[:2], 0.0, *gradients[2:]]])
    found = find_order(first, second, 0, start)
    np.testing.assert_allclose(found.warp[0, [0, 3]], SHIFT, atol=1e-3)
    np.testing.assert_array_equal(found.warp[0, [1, 2, 4, 5]], gradients)


@pytest.mark.slow
def test_noise_grows_with_the_order_and_is_stated(make_texture):
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
        found = [register(reference, target, np.zeros((1, 6)), FINE) for target in targets]
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


def test_depth_of_twelve_bits_is_exact_and_resolves_below_a_grey_level(make_texture):
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
            found = register(reference, spline_of_image(grey[1]), np.zeros((len(centres), 6)), FINE)
            assert np.all(found.status == TrackStatus.OK)
            scatter[depth, noise] = float(np.sqrt(np.mean((found.warp[:, [0, 3]] - SHIFT) ** 2)))
    assert scatter[12, 1.0 / 255] <= scatter[8, 1.0 / 255]
    assert scatter[12, 0.1 / 255] < 0.5 * scatter[8, 0.1 / 255]
    assert scatter[16, 0.1 / 255] <= 1.02 * scatter[12, 0.1 / 255]


# The batched engine on torch's CPU device: against the compiled one, and against analytic truth.

OFF_PIXEL = CENTRES + 0.3
NOISE = 6.0
PIVOT = np.array([70.0, 50.0])


def moved(texture, shift, turn: float = 0.0, stretch: float = 1.0) -> np.ndarray:
    """Image of the texture moved by `shift`, turned and stretched about the middle."""
    matrix = stretch * turn_by(turn)
    return grey(texture.image(SIZE, lambda p: (p - PIVOT - shift) @ np.linalg.inv(matrix).T + PIVOT))


@pytest.fixture(scope="module")
def noisy_frames(texture) -> NDArray[np.uint16]:
    """The body at rest, shifted, turned, stretched: 12-bit images with noise."""
    rng = np.random.default_rng(22)
    ways = ([0.0, 0.0], 0.0, 1.0), ([0.4, -0.7], 0.0, 1.0), ([0.2, 0.3], 0.03, 1.0), ([-0.5, 0.1], -0.02, 1.02)
    exact = [moved(texture, *way) for way in ways]
    return np.rint(np.stack(exact) + rng.normal(0, NOISE, (4, *exact[0].shape))).astype(np.uint16)


def both_engines(
    reference: ReferenceSubsets,
    images,
    start,
    degree: int = 5,
    how: TrackSettings = SETTINGS,
    precision: str = "float64",
) -> list[tuple[Registration, Registration]]:
    """Results of the compiled and of the batched engine, frame by frame."""
    expected = [register(reference, spline_of_image(i, degree), s, how) for i, s in zip(images, start, strict=True)]
    frames = spline_frames(np.stack(images), degree, "cpu", precision)
    found = register_frames(torch_reference(reference, "cpu", precision), frames, start, how)
    return list(zip(expected, found, strict=True))


def assert_same(expected: Registration, found: Registration, atol_px: float = 1e-6) -> None:
    """Same statuses, iterations, numbers, and NaN in the same places; scores where there is any contrast.

    The compiled engine rounds grey values to float32, 10⁻³ of a grey level of 12 bit: nothing less is left over.
    """
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_array_equal(found.iterations, expected.iterations)
    np.testing.assert_allclose(found.warp, expected.warp, atol=atol_px)
    seen = ~(expected.residual_grey2 < 1e-5)
    np.testing.assert_allclose(found.zncc[seen], expected.zncc[seen], atol=atol_px)
    np.testing.assert_allclose(found.gain[seen], expected.gain[seen], rtol=1e-6, atol=atol_px)
    np.testing.assert_allclose(found.residual_grey2[seen], expected.residual_grey2[seen], rtol=1e-3)


@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("shape", [(8, 9), (41, 30), (64, 97)])
def test_prefilter_is_the_recursion(degree, shape):
    images = np.random.default_rng(1).uniform(0, 4095, (2, *shape))
    found = spline_frames(images, degree, "cpu").coefficients.numpy()
    for image, coefficients in zip(images, found, strict=True):
        expected = spline_of_image(image, degree).coefficients
        rounding = 2.0 * np.finfo(np.float32).eps * np.abs(expected).max()
        np.testing.assert_allclose(coefficients, expected, rtol=0.0, atol=rounding)


@pytest.mark.parametrize("kind", ["uint8", "uint16", ">u2", "float32", "float64"])
def test_prefilter_takes_every_kind_of_grey_value(kind):
    images = np.random.default_rng(2).integers(0, 255 if kind == "uint8" else 65535, (1, 9, 8))
    found, expected = (spline_frames(images.astype(k), 5, "cpu").coefficients.numpy() for k in (kind, "float64"))
    np.testing.assert_array_equal(found, expected)


def test_importing_the_package_does_not_import_torch():
    """Torch takes seconds to import, also for those who track on the CPU."""
    ask = "import sys, photogram.measure.body, photogram.measure.exposure_motion; print('torch' in sys.modules)"
    answer = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "False"


@pytest.fixture(scope="module")
def prepared(noisy_frames) -> ReferenceSubsets:
    return prepare_reference(spline_of_image(noisy_frames[0]), OFF_PIXEL, 10)


REST = np.zeros((4, len(OFF_PIXEL), 6))


@pytest.mark.parametrize(("degree", "order"), [(3, 1), (5, 0), (5, 1), (5, 2)])
def test_same_results_as_the_compiled_engine(noisy_frames, degree, order):
    reference = prepare_reference(spline_of_image(noisy_frames[0], degree), OFF_PIXEL, 10, order)
    start = REST.copy()
    start[2, :, 2], start[2, :, 4] = -0.02, 0.02
    for expected, found in both_engines(reference, noisy_frames, start, degree):
        assert np.sum(expected.status == TrackStatus.OK) > 0.9 * len(OFF_PIXEL)
        assert_same(expected, found)


def test_curved_starts_give_the_same_results(noisy_frames):
    """Starts of order 2 with curvature, of which some reach out of the image by it."""
    reference = prepare_reference(spline_of_image(noisy_frames[0]), OFF_PIXEL, 10, order=2)
    start = np.random.default_rng(23).normal(0, 2e-3, (4, len(OFF_PIXEL), 12))
    start[3, ::5, 6:] *= 30.0
    for expected, found in both_engines(reference, noisy_frames, start):
        assert_same(expected, found, atol_px=1e-5)


def test_float32_is_precise_to_1e_5_px(noisy_frames, prepared):
    for expected, found in both_engines(prepared, noisy_frames, REST, precision="float32"):
        np.testing.assert_array_equal(found.status, expected.status)
        np.testing.assert_allclose(found.warp[:, [0, 3]], expected.warp[:, [0, 3]], atol=1e-5)
        np.testing.assert_allclose(found.residual_grey2, expected.residual_grey2, rtol=1e-3, atol=0.01)


def test_failures_have_the_same_status(texture, noisy_frames):
    """Flat and leaving subsets, absent starts, starts that lead astray, too few iterations, too little correlation."""
    first = noisy_frames[0].astype(np.float64)
    first[70:, 100:] = 500.0
    centres = np.array([[60, 50], [12, 50], [3, 50], [125, 90], [60, 30], [80, 50], [100, 40]], dtype=float)
    reference = prepare_reference(spline_of_image(first), centres, 10)
    start = np.zeros((4, len(centres), 6))
    start[:, 1, 0] = -6.0
    start[0, 4, 2] = np.nan
    start[:, 5, 0] = 7.0
    start[1, 6] = [0.0, -0.9, 0.5, 0.0, 0.4, -1.2]
    unlike = np.random.default_rng(3).normal(2000, 400, first.shape)
    images = [first, noisy_frames[1], unlike, 4095.0 - first]
    seen = set[int]()
    for how in (SETTINGS, TrackSettings(max_iterations=2), TrackSettings(min_zncc=0.9999)):
        for expected, found in both_engines(reference, images, start, how=how):
            assert_same(expected, found, atol_px=1e-5)
            seen |= set(found.status.tolist())
    assert seen == set(TrackStatus) - {TrackStatus.SATURATED, TrackStatus.UNRESOLVED}


def test_portions_have_no_effect_and_starts_are_unchanged(noisy_frames, prepared, monkeypatch):
    reference, frames, start = torch_reference(prepared, "cpu"), spline_frames(noisy_frames, 5, "cpu"), REST.copy()
    whole = register_frames(reference, frames, start, SETTINGS)
    assert not start.any()
    for working_bytes in (1, 5_000_000):
        monkeypatch.setitem(engine.WORKING_BYTES, "cpu", working_bytes)
        parts = register_frames(reference, frames, start, SETTINGS)
        for expected, found in zip(whole, parts, strict=True):
            assert_same(expected, found, atol_px=1e-11)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_every_tensor_is_made_on_the_device(noisy_frames, order):
    """On torch's device without data, one step of the pairs fails where a tensor of the CPU is mixed in."""
    import torch

    reference = torch_reference(prepare_reference(spline_of_image(noisy_frames[0]), OFF_PIXEL, 10, order), "meta")
    frames = spline_frames(noisy_frames, 5, "meta")
    start = torch.zeros((9, reference.columns), dtype=torch.float64, device="meta")
    frame = subset = torch.zeros(9, dtype=torch.int64, device="meta")
    basis = torch.from_numpy(basis_polynomials(5)).to(reference.pixels)
    gone = engine._lost_status(reference, frames, subset, start, start[:, :6:3])
    sums = engine._portion_sums(reference, frames, (frame, subset, start), basis)
    step, scores, fate = engine._solve(reference, SETTINGS, (subset, gone), sums)
    for tensor in (fate, scores, engine._compose_inverse(start, step)):
        assert tensor.device.type == "meta"


def test_wrong_calls_are_refused(noisy_frames, prepared):
    assert PARAMETERS == {0: 2, 1: 6, 2: 12}
    refused("^order: .*0, 1 or 2, .*3", prepare_reference, spline_of_image(np.eye(40)), MIDDLE[None], 5, 3)
    refused("^shape_order: .*0, 1 or 2, .*-1", TrackSettings, shape_order=-1)
    frames = spline_frames(noisy_frames, 5, "cpu")
    assert frames.size_px == SIZE
    batched = torch_reference(prepared, "cpu")
    refused("^start: ", register_frames, batched, frames, REST[:3], SETTINGS)
    refused("^degree: .*3, 5 or 7, .*4", spline_frames, noisy_frames, 4, "cpu")
    refused("^degree: .*3, 5 or 7, .*4", TorchSplines, frames.coefficients, 4)
    refused("^coefficients: ", TorchSplines, frames.coefficients[0], 5)
    refused("^precision: .*float64, float32, .*'half'", torch_reference, prepared, "cpu", "half")


@NEEDS_GPU
@pytest.mark.parametrize(("degree", "order"), [(3, 1), (5, 0), (5, 2), (7, 1)])
def test_one_kernel_on_a_gpu_sums_what_torch_does(noisy_frames, degree, order):
    """Subsets in all frames at warps of their size, some of them left out."""
    import torch

    prepared = prepare_reference(spline_of_image(noisy_frames[0], degree), OFF_PIXEL, 10, order)
    reference = torch_reference(prepared, "cuda", "float32")
    frames = spline_frames(noisy_frames, degree, "cuda", "float32")
    own = torch.arange(len(OFF_PIXEL), device="cuda").repeat(4)
    frame = torch.arange(4, device="cuda").repeat_interleave(len(OFF_PIXEL))
    warp = torch.from_numpy(np.random.default_rng(32).normal(0, 0.01, (len(own), reference.columns))).to("cuda")
    warp[:, 6:] *= 0.1
    alive = torch.arange(len(own), device="cuda") % 7 > 0
    found = engine.square_sums(reference, frames, (frame, own, warp), alive)
    basis = torch.from_numpy(basis_polynomials(degree)).to(reference.pixels)
    expected = engine._portion_sums(reference, frames, (frame, own, warp), basis)
    assert found[~alive].isnan().all()
    scale = expected.abs().amax(dim=0)
    assert ((found - expected).abs() / scale)[alive].max() < 1e-5
