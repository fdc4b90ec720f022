"""The batched engine on torch's CPU device: against the compiled one, and against analytic truth."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.ndimage import spline_filter

from photogram.bspline import PADDING_PX, spline_of_image
from photogram.subsets import icgn_torch as engine
from photogram.subsets import track as device_module
from photogram.subsets.icgn import Registration, register
from photogram.subsets.icgn_stream import follow_frames, forecast_warps
from photogram.subsets.icgn_torch import (
    TorchSplines,
    basis_polynomials,
    prefilter,
    register_frames,
    spline_frames,
    torch_reference,
)
from photogram.subsets.reference import Reference, TrackStatus, prepare_reference
from photogram.subsets.search import predict_warp
from photogram.subsets.track import TrackSettings, follow, identity, resolve_device

SIZE = (150, 108)
CENTRES = np.array([(x, y) for y in range(20, 90, 22) for x in range(20, 132, 22)], dtype=float) + 0.3
LIMITS = (30, 1e-4, 0.75)
NOISE = 6.0
MIDDLE = np.array([70.0, 50.0])


def grey(texture_image: np.ndarray) -> np.ndarray:
    """Contrast of a tenth of 12 bits about the middle."""
    return (0.5 + 0.1 * texture_image) * 4095


@pytest.fixture(scope="module")
def texture(make_texture):
    return make_texture(seed=21, s=1.5)


def moved(texture, shift, turn: float = 0.0, stretch: float = 1.0) -> np.ndarray:
    """Image of the texture moved by `shift`, turned and stretched about the middle."""
    matrix = stretch * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return grey(texture.image(SIZE, lambda p: (p - MIDDLE - shift) @ np.linalg.inv(matrix).T + MIDDLE))


@pytest.fixture(scope="module")
def noisy_frames(texture) -> NDArray[np.uint16]:
    """The body at rest, shifted, turned, stretched: 12-bit images with noise."""
    rng = np.random.default_rng(22)
    exact = [
        moved(texture, [0.0, 0.0]),
        moved(texture, [0.4, -0.7]),
        moved(texture, [0.2, 0.3], turn=0.03),
        moved(texture, [-0.5, 0.1], turn=-0.02, stretch=1.02),
    ]
    return np.rint(np.stack(exact) + rng.normal(0, NOISE, (4, *exact[0].shape))).astype(np.uint16)


def both_engines(
    reference: Reference, images, start, degree: int = 5, limits=LIMITS, precision: str = "float64", working_bytes=None
) -> list[tuple[Registration, Registration]]:
    """Results of the compiled and of the batched engine, frame by frame."""
    expected = [register(reference, spline_of_image(i, degree), s, *limits) for i, s in zip(images, start, strict=True)]
    frames = spline_frames(np.stack(images), degree, "cpu", precision)
    found = register_frames(torch_reference(reference, "cpu", precision), frames, start, *limits, working_bytes)
    return list(zip(expected, found, strict=True))


def assert_same(expected: Registration, found: Registration, atol_px: float = 1e-6) -> None:
    """Same statuses, iterations, numbers, and NaN in the same places; scores where there is any contrast."""
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_array_equal(found.iterations, expected.iterations)
    np.testing.assert_allclose(found.warp, expected.warp, atol=atol_px)
    seen = ~(expected.residual_grey2 < 1e-6)
    np.testing.assert_allclose(found.zncc[seen], expected.zncc[seen], atol=atol_px)
    np.testing.assert_allclose(found.gain[seen], expected.gain[seen], atol=atol_px)
    np.testing.assert_allclose(found.residual_grey2[seen], expected.residual_grey2[seen], rtol=1e-3)


@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("shape", [(8, 9), (41, 30), (64, 97)])
def test_prefilter_is_the_recursion(degree: int, shape: tuple[int, int]) -> None:
    images = np.random.default_rng(1).uniform(0, 4095, (2, *shape))
    found = prefilter(images, degree, "cpu").numpy()
    for image, coefficients in zip(images, found, strict=True):
        expected = spline_of_image(image, degree).coefficients
        np.testing.assert_allclose(coefficients, expected, atol=1e-10 * np.abs(expected).max())
        oracle = spline_filter(image, order=degree, mode="mirror")
        np.testing.assert_allclose(
            coefficients[PADDING_PX:-PADDING_PX, PADDING_PX:-PADDING_PX], oracle, atol=1e-9 * np.abs(expected).max()
        )


@pytest.mark.parametrize("kind", ["uint8", "uint16", ">u2", "float32", "float64"])
def test_prefilter_takes_every_kind_of_grey_value(kind: str) -> None:
    images = np.random.default_rng(2).integers(0, 255 if kind == "uint8" else 65535, (1, 9, 8))
    expected = prefilter(images.astype(np.float64), 5, "cpu").numpy()
    np.testing.assert_array_equal(prefilter(images.astype(kind), 5, "cpu").numpy(), expected)


def test_importing_the_package_does_not_import_torch() -> None:
    """Torch takes seconds to import, also for those who track on the CPU."""
    ask = "import sys, photogram.subsets.icgn_torch, photogram.subsets.track; print('torch' in sys.modules)"
    answer = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "False"


@pytest.mark.parametrize("degree", [3, 5])
def test_polynomials_are_b_splines(degree: int) -> None:
    """Oracle: SciPy's B-spline on whole knots."""
    spline = BSpline.basis_element(np.arange(degree + 2.0) - (degree + 1) / 2, extrapolate=False)
    t = np.linspace(0, 1, 11, endpoint=False)
    found = np.vander(t, degree + 1, increasing=True) @ basis_polynomials(degree)
    expected = np.nan_to_num(spline(t[:, None] + degree // 2 - np.arange(degree + 1)))
    np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.parametrize(("degree", "order"), [(3, 1), (5, 0), (5, 1), (5, 2)])
def test_same_results_as_the_compiled_engine(noisy_frames, degree: int, order: int) -> None:
    reference = prepare_reference(spline_of_image(noisy_frames[0], degree), CENTRES, 10, order)
    start = np.zeros((4, len(CENTRES), 6))
    start[2, :, 2], start[2, :, 4] = -0.02, 0.02
    for expected, found in both_engines(reference, noisy_frames, start, degree):
        assert np.sum(expected.status == TrackStatus.OK) > 0.9 * len(CENTRES)
        assert_same(expected, found)


def test_curved_starts_give_the_same_results(noisy_frames) -> None:
    """Starts of order 2 with curvature, of which some reach out of the image by it."""
    reference = prepare_reference(spline_of_image(noisy_frames[0]), CENTRES, 10, order=2)
    start = np.random.default_rng(23).normal(0, 2e-3, (4, len(CENTRES), 12))
    start[3, ::5, 6:] *= 30.0
    for expected, found in both_engines(reference, noisy_frames, start):
        assert_same(expected, found, atol_px=1e-5)


def test_float32_holds_1e_5_px(noisy_frames) -> None:
    reference = prepare_reference(spline_of_image(noisy_frames[0]), CENTRES, 10)
    start = np.zeros((4, len(CENTRES), 6))
    for expected, found in both_engines(reference, noisy_frames, start, precision="float32"):
        np.testing.assert_array_equal(found.status, expected.status)
        np.testing.assert_allclose(found.warp[:, [0, 3]], expected.warp[:, [0, 3]], atol=1e-5)
        np.testing.assert_allclose(found.residual_grey2, expected.residual_grey2, rtol=1e-3, atol=0.01)


def test_failures_have_the_same_status(texture, noisy_frames) -> None:
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
    for limits in (LIMITS, (2, 1e-4, 0.75), (30, 1e-4, 0.9999)):
        for expected, found in both_engines(reference, images, start, limits=limits):
            assert_same(expected, found, atol_px=1e-5)
            seen |= set(found.status.tolist())
    assert seen == set(TrackStatus) - {TrackStatus.SATURATED}


def test_portions_change_nothing(noisy_frames) -> None:
    reference = torch_reference(prepare_reference(spline_of_image(noisy_frames[0]), CENTRES, 10), "cpu")
    frames, start = spline_frames(noisy_frames, 5, "cpu"), np.zeros((4, len(CENTRES), 6))
    whole = register_frames(reference, frames, start, *LIMITS)
    for working_bytes in (1, 5_000_000):
        parts = register_frames(reference, frames, start, *LIMITS, working_bytes)
        for expected, found in zip(whole, parts, strict=True):
            assert_same(expected, found, atol_px=1e-11)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_every_tensor_is_made_on_the_device(noisy_frames, order: int) -> None:
    """On torch's device without data, one step of the pairs fails where a tensor of the CPU is mixed in."""
    import torch

    reference = torch_reference(prepare_reference(spline_of_image(noisy_frames[0]), CENTRES, 10, order), "meta")
    frames = spline_frames(noisy_frames, 5, "meta")
    start = torch.zeros((9, reference.columns), dtype=torch.float64, device="meta")
    frame = subset = torch.zeros(9, dtype=torch.int64, device="meta")
    basis = torch.from_numpy(basis_polynomials(5)).to(reference.pixels)
    gone = engine._gone(reference, frames, subset, start, start[:, :6:3])
    solved = engine._solve(
        reference, subset, *engine._correlate(reference, frames, (frame, subset, start, gone), basis)
    )
    fate, scores = engine._judge(reference.rim, engine._Limits(*LIMITS), gone, solved)
    compose = engine._compose_inverse_quadratic if order == 2 else engine._compose_inverse
    for tensor in (fate, scores, compose(start, solved[0])):
        assert tensor.device.type == "meta"


def test_starts_stay_as_they_were(noisy_frames) -> None:
    reference = torch_reference(prepare_reference(spline_of_image(noisy_frames[0]), CENTRES, 10), "cpu")
    start = np.zeros((4, len(CENTRES), 6))
    register_frames(reference, spline_frames(noisy_frames, 5, "cpu"), start, *LIMITS)
    assert not start.any()


def test_analytic_truth_comes_back(texture) -> None:
    """A sum of plane waves is moved exactly: no interpolation has made these images."""
    turn, shift = 0.02, np.array([0.4, -0.3])
    images = np.stack([moved(texture, shift, turn), moved(texture, 2 * shift)])
    reference = torch_reference(prepare_reference(spline_of_image(moved(texture, [0, 0])), CENTRES, 10), "cpu")
    turned, shifted = register_frames(
        reference, spline_frames(images, 5, "cpu"), np.zeros((2, len(CENTRES), 6)), *LIMITS
    )
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    truth = (CENTRES - MIDDLE) @ matrix.T + MIDDLE + shift - CENTRES
    error = turned.warp[:, [0, 3]] - truth
    assert np.abs(np.nanmean(error, axis=0)).max() < 3e-4
    assert np.nanmax(np.abs(error)) < 3e-3
    np.testing.assert_allclose(np.nanmean(shifted.warp[:, [0, 3]], axis=0), 2 * shift, atol=3e-4)


def swinging(texture, count: int, amplitude_px: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Noisy frames of a body that swings, beginning at rest in the middle; and its true shifts (count,2)."""
    rng = np.random.default_rng(24)
    shifts = amplitude_px * np.sin(0.9 * np.arange(count))[:, None] * [1.0, -0.5]
    return [image + rng.normal(0, NOISE, image.shape) for image in (moved(texture, s) for s in shifts)], shifts


def one_by_one(reference: Reference, images, settings: TrackSettings) -> Iterator[Registration]:
    """The frames after the first, followed by the compiled engine."""
    history = [identity(reference).warp]
    for image in images[1:]:
        target = spline_of_image(image, settings.degree)
        here = follow(reference, images[0], (image, target), predict_warp(history[-6:]), settings)
        history.append(here.warp)
        yield here


def test_series_is_followed_like_by_the_compiled_engine(texture) -> None:
    images, _ = swinging(texture, 12, 0.8)
    settings = TrackSettings()
    reference = prepare_reference(spline_of_image(images[0]), CENTRES, settings.radius_px)
    followed = list(follow_frames(reference, images[0], iter(images[1:]), settings, "cpu", batch_frames=4))
    assert [id(image) for image, _ in followed] == [id(image) for image in images[1:]]
    for (_, found), expected in zip(followed, one_by_one(reference, images, settings), strict=True):
        np.testing.assert_array_equal(found.status, expected.status)
        apart = (found.warp - expected.warp)[:, [0, 3]]
        assert np.nanmax(np.abs(apart)) < 2e-3  # the last step is a tenth of the standard uncertainty at most
        assert np.sqrt(np.nanmean(apart**2)) < 3e-4


def test_large_swing_is_found_wherever_the_compiled_engine_finds_it(texture) -> None:
    """Nine pixels are out of reach of the first starts: search, then the sine foretold over whole batches."""
    images, shifts = swinging(texture, 24, 9.0)
    settings = TrackSettings()
    reference = prepare_reference(spline_of_image(images[0]), CENTRES, settings.radius_px)
    found = [here for _, here in follow_frames(reference, images[0], images[1:], settings, "cpu", batch_frames=8)]
    expected = list(one_by_one(reference, images, settings))
    for here, want, shift in zip(found, expected, shifts[1:], strict=True):
        right = [np.abs(engine.warp[:, [0, 3]] - shift).max(axis=1) < 0.05 for engine in (here, want)]
        assert right[0].sum() >= right[1].sum() - 1
        assert np.sum(here.status == TrackStatus.OK) <= right[0].sum() + 1


def test_a_jump_within_a_batch_is_survived(texture) -> None:
    """Rest, then a jump that no prediction foretells: it is searched in each frame of that batch, later foretold."""
    rng, settings = np.random.default_rng(25), TrackSettings()
    rest, jumped = moved(texture, [0, 0]), moved(texture, [6.3, -5.2])
    images = [frame + rng.normal(0, NOISE, rest.shape) for frame in [rest] * 9 + [jumped] * 4]
    reference = prepare_reference(spline_of_image(images[0]), CENTRES, settings.radius_px)
    found = [here for _, here in follow_frames(reference, images[0], images[1:], settings, "cpu", batch_frames=8)]
    for here in found[8:]:
        np.testing.assert_allclose(np.nanmedian(here.warp[:, [0, 3]], axis=0), [6.3, -5.2], atol=2e-3)


@pytest.mark.parametrize("frequency", [0.17, 0.9, 3.0])
def test_a_sine_is_foretold_over_a_whole_batch(frequency: float) -> None:
    """Also one that is sampled about once a period; a subset that was lost once or always does not spoil the others."""
    rng = np.random.default_rng(26)
    amplitude, mean = rng.normal(0, 2, (2, 20, 6))
    frames = np.arange(80)[:, None, None]
    truth = mean + amplitude * np.sin(frequency * frames + rng.uniform(0, 6, 20)[:, None])
    seen = truth + rng.normal(0, 5e-3, truth.shape)
    seen[20, 3], seen[:, 4] = np.nan, np.nan
    found = forecast_warps(list(seen[:48]), 32)
    assert found.shape == (32, 20, 6)
    assert np.isnan(found[:, 4]).all()
    clean = np.setdiff1d(np.arange(20), [3, 4])
    assert np.sqrt(np.mean((found - truth[48:])[:, clean] ** 2)) < 5e-3
    assert np.nanmax(np.abs((found - truth[48:])[:, 3])) < 1.0


def test_rest_is_expected_to_stay() -> None:
    history = list(np.random.default_rng(27).normal(0, 1e-2, (20, 5, 6)))
    found = forecast_warps(history, 12)
    assert found.shape == (12, 5, 6)
    assert np.abs(found).max() < 0.1


def test_what_cannot_be_foretold_is_taken_frame_by_frame() -> None:
    """Random motion; too short a past; nothing found so far."""
    jumps = list(np.random.default_rng(28).normal(0, 3, (20, 5, 6)))
    for past in (jumps, [np.zeros((5, 6))] * 3, [np.full((5, 6), np.nan)] * 20):
        np.testing.assert_array_equal(forecast_warps(past, 12), predict_warp(past[-6:])[None])
    assert len(forecast_warps([np.zeros((5, 6))] * 14, 32)) == 14


def test_no_more_than_two_batches_are_read_ahead(texture) -> None:
    read = []

    def images() -> Iterator[np.ndarray]:
        for count in range(40):
            read.append(count)
            yield still

    still = moved(texture, [0, 0])
    reference = prepare_reference(spline_of_image(still), CENTRES[:4], 10)
    series = follow_frames(reference, still, images(), TrackSettings(), "cpu", batch_frames=4)
    for count, _ in enumerate(series):
        assert len(read) <= count + 1 + 2 * 4
    assert count == 39


def test_wrong_calls_are_refused(noisy_frames) -> None:
    reference = prepare_reference(spline_of_image(noisy_frames[0]), CENTRES, 10)
    frames = spline_frames(noisy_frames, 5, "cpu")
    assert frames.size_px == SIZE
    with pytest.raises(ValueError, match="start: expected an array of shape"):
        register_frames(torch_reference(reference, "cpu"), frames, np.zeros((3, len(CENTRES), 6)), *LIMITS)
    with pytest.raises(ValueError, match="images: expected an array of shape"):
        prefilter(noisy_frames[0], 5, "cpu")
    with pytest.raises(ValueError, match="images: expected at least 8 x 8 px"):
        prefilter(noisy_frames[:, :5], 5, "cpu")
    with pytest.raises(ValueError, match="degree: expected 3, 5 or 7, found 4"):
        prefilter(noisy_frames, 4, "cpu")
    with pytest.raises(ValueError, match="degree: expected 3, 5 or 7, found 4"):
        TorchSplines(frames.coefficients, 4)
    with pytest.raises(ValueError, match="coefficients: expected a contiguous tensor"):
        TorchSplines(frames.coefficients[0], 5)
    with pytest.raises(ValueError, match="precision: expected one of float64, float32, found 'half'"):
        torch_reference(reference, "cpu", "half")
    with pytest.raises(ValueError, match="batch_frames: expected at least 1, found 0"):
        next(follow_frames(reference, noisy_frames[0], noisy_frames[1:], TrackSettings(), "cpu", batch_frames=0))


@pytest.mark.parametrize(
    ("choice", "driver", "torch_finds", "expected"),
    [
        ("cpu", True, True, "cpu"),
        ("auto", True, True, "cuda"),
        ("auto", True, False, "cpu"),
        ("auto", False, True, "cpu"),
        ("cuda", True, True, "cuda"),
        ("cuda", False, True, "cuda"),
    ],
)
def test_device_is_chosen(monkeypatch, choice, driver, torch_finds, expected) -> None:
    monkeypatch.setattr(device_module, "_has_driver", lambda: driver)
    monkeypatch.setattr(device_module, "_torch_finds_cuda", lambda: torch_finds)
    assert resolve_device(choice) == expected


def test_an_absent_gpu_is_an_error_only_when_asked_for(monkeypatch) -> None:
    monkeypatch.setattr(device_module, "_torch_finds_cuda", lambda: False)
    with pytest.raises(ValueError, match="device: expected a GPU that torch can use for 'cuda', found none"):
        resolve_device("cuda")
    with pytest.raises(ValueError, match="device: expected one of auto, cpu, cuda, found 'gpu'"):
        resolve_device("gpu")


def test_a_machine_without_a_driver_is_not_asked_for_torch(monkeypatch) -> None:
    def refuse(name: str) -> None:
        raise OSError(f"{name}: no such library")

    def never() -> bool:
        raise AssertionError("torch was imported")

    monkeypatch.setattr(device_module.ctypes, "CDLL", refuse)
    monkeypatch.setattr(device_module, "_torch_finds_cuda", never)
    assert resolve_device("auto") == "cpu"
