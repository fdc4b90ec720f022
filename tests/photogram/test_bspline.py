"""B-splines against SciPy, polynomials, differences and Monte Carlo; kernels that follow what they call."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from contracts import refused
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import ndimage

from photogram.bspline import (
    PADDING_PX,
    Spline,
    basis,
    evaluate,
    grey_values,
    noise_gain,
    sample_line,
    slope_noise_gain,
    spline_of_image,
)
from photogram.lanes import AFFINE_SUMS, RUN_SUMS, affine_sums, run_sums
from shakercal._common import kernels
from shakercal._common.kernels import njit


def rounding(spline: Spline) -> float:
    """Twice the step of float32 at the largest coefficient, which of white noise is many times the grey values."""
    return 2.0 * float(np.finfo(np.float32).eps) * float(np.abs(spline.coefficients).max())


@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("shape", [(8, 9), (37, 90), (130, 65)])
def test_coefficients_and_values_are_scipys(degree, shape):
    rng = np.random.default_rng(3)
    image = rng.normal(size=shape)
    spline = spline_of_image(image, degree)
    inside = spline.coefficients[PADDING_PX:-PADDING_PX, PADDING_PX:-PADDING_PX]
    filtered = ndimage.spline_filter(image, degree, mode="mirror")
    np.testing.assert_allclose(inside, filtered, rtol=0.0, atol=rounding(spline))
    points = rng.uniform(0, [shape[1] - 1, shape[0] - 1], (500, 2))
    expected = ndimage.map_coordinates(image, points[:, ::-1].T, order=degree, mode="mirror")
    np.testing.assert_allclose(evaluate(spline, points)[0], expected, rtol=0.0, atol=rounding(spline))


@pytest.mark.parametrize("degree", [3, 5, 7])
def test_the_spline_passes_through_the_pixels_and_polynomials_are_exact_far_from_the_border(degree):
    image = np.random.default_rng(4).integers(0, 4096, (20, 24), dtype=np.uint16)
    rows, columns = np.indices(image.shape)
    points = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    spline = spline_of_image(image, degree)
    np.testing.assert_allclose(evaluate(spline, points)[0], image.ravel(), rtol=0.0, atol=rounding(spline))
    np.testing.assert_allclose(grey_values(spline), image, rtol=0.0, atol=rounding(spline))
    x = np.arange(121.0) - 60.0
    image = np.add.outer((x / 10) ** degree, (x / 10) ** (degree - 1))
    points = np.random.default_rng(5).uniform(57, 63, (200, 2))
    u, v = (points - 60.0).T / 10
    values, gradients = evaluate(spline_of_image(image, degree), points)
    np.testing.assert_allclose(values, v**degree + u ** (degree - 1), rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(gradients[:, 0], (degree - 1) * u ** (degree - 2) / 10, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(gradients[:, 1], degree * v ** (degree - 1) / 10, rtol=0.0, atol=1e-6)


def test_black_around_a_bright_spot_rings_down_to_no_number_that_is_slow_to_compute_with():
    image = np.zeros((200, 210), np.uint16)
    image[20:30, 20:30] = 4095
    coefficients = np.abs(spline_of_image(image, 7).coefficients)
    assert coefficients.min() > 1e3 * np.finfo(np.float32).smallest_normal
    assert coefficients[100:, 100:].max() < 1e-10


def test_speckle_is_interpolated_to_the_known_accuracy(make_texture):
    texture = make_texture(seed=6, s=1.5)
    image = texture.image((64, 64))
    points = np.random.default_rng(6).uniform(12, 52, (2000, 2))
    error = {
        degree: np.std(evaluate(spline_of_image(image, degree), points)[0] - texture(points)) for degree in (3, 5, 7)
    }
    assert error[5] < 1e-3
    assert error[3] > 3 * error[5]
    assert error[5] > 2 * error[7]


def test_points_outside_the_image_are_nan_and_wrong_input_is_named():
    spline = spline_of_image(np.ones((10, 12)))
    values, gradients = evaluate(spline, np.array([[-0.01, 5], [11.01, 5], [5, 9.01], [np.nan, 5], [11, 9]]))
    assert np.isnan(np.column_stack([values, gradients])).tolist() == [[True] * 3] * 4 + [[False] * 3]
    refused("^degree: .*3, 5 or 7, .*4", spline_of_image, np.ones((10, 10)), 4)
    refused("^image: .*8 x 8 px", spline_of_image, np.ones((5, 10)))
    refused("^degree: .*3, 5 or 7", Spline, np.ones((16, 16)), 2)


@pytest.mark.parametrize("degree", [3, 5, 7])
def test_noise_gains_are_those_of_noise(degree):
    noise = np.random.default_rng(7).normal(size=(400, 400))
    spline = spline_of_image(noise, degree)
    places = np.stack(np.meshgrid(np.arange(10.0, 390), np.arange(10.0, 390)), axis=-1).reshape(-1, 2)
    for shift in (0.0, 0.25, 0.5):
        values, gradients = evaluate(spline, places + np.array([shift, 0.0]))
        assert np.var(values) == pytest.approx(float(noise_gain(np.array(shift), degree)), rel=0.02)
        if shift == 0.0:
            assert np.var(gradients[:, 0]) == pytest.approx(slope_noise_gain(degree), rel=0.02)


# Values along lines of points against the point-by-point evaluation, which goes by another formula for the weights.

IMAGE = np.random.default_rng(51).uniform(0, 4095, (64, 70))
SPLINES = {degree: spline_of_image(IMAGE, degree) for degree in (3, 5, 7)}


def check(degree: int, start: tuple[float, float], step: tuple[float, float], count: int) -> None:
    points = np.asarray(start) + np.arange(count)[:, None] * np.asarray(step)
    grey = np.full(count, np.nan, np.float32)
    sample_line(SPLINES[degree].coefficients, degree, start, step, grey, (0, count))
    np.testing.assert_allclose(grey, evaluate(SPLINES[degree], points)[0], rtol=0.0, atol=rounding(SPLINES[degree]))


@settings(max_examples=300, deadline=None)
@given(
    degree=st.sampled_from(list(SPLINES)),
    x=st.floats(0, 69),
    y=st.floats(0, 63),
    length=st.floats(0.5, 1.5),
    angle=st.one_of(st.floats(-0.1, 0.1), st.floats(-np.pi, np.pi)),
    count=st.integers(1, 44),
)
def test_lines_of_any_direction(degree, x, y, length, angle, count):
    step = (length * np.cos(angle), length * np.sin(angle))
    last_x, last_y = x + (count - 1) * step[0], y + (count - 1) * step[1]
    assume(0 <= last_x <= 69 and 0 <= last_y <= 63)
    check(degree, (x, y), step, count)


@pytest.mark.parametrize(
    ("start", "step", "count"),
    [
        ((0.0, 0.0), (1.0, 0.0), 70),
        ((0.0, 63.0), (1.0, 0.0), 70),
        ((69.0, 63.0), (-1.0, 0.0), 70),
        ((69.0, 0.0), (0.0, 1.0), 64),
        ((0.0, 62.9999999), (1.0, 1e-9), 70),
        ((38.0, 63.0), (1.0, 0.0), 32),
        ((5.3, 7.9999999), (1.0000001, 1e-8), 31),
        ((0.5, 20.0), (1.0 - 1e-14, -1e-14), 31),
    ],
)
def test_lines_along_pixels_and_edges(start, step, count):
    for degree in SPLINES:
        check(degree, start, step, count)


def test_only_the_line_is_written():
    grey = np.full(60, -1.0, np.float32)
    sample_line(SPLINES[5].coefficients, 5, (20.3, 30.1), (0.999, 0.2), grey, (4, 37))
    assert np.all(grey[:4] == -1.0)
    assert np.all(grey[37:] == -1.0)
    assert np.all(grey[4:37] != -1.0)


# Sums of eight pixels at a time against numpy, and kernels against what they may be compiled into.

FREE = {"contract", "reassoc", "nsz", "arcp"}


@njit()
def subset(grey, mean, pixels, offsets, affine):
    """Sums over a subset."""
    affine_sums(grey, mean, pixels, offsets, affine)


@njit()
def run(grey, mean, pixels, span, dx, sums):
    """Sums over a run."""
    run_sums(grey, mean, pixels, span, dx, sums)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 31, 441])
def test_sums_of_any_length(count):
    rng = np.random.default_rng(count)
    grey, mean, pixels = rng.uniform(0, 4095, count), 2000.0, rng.normal(0, 300, (3, count))
    (dx, dy), affine = rng.integers(-10, 11, (2, count)).astype(float), np.empty(AFFINE_SUMS)
    subset(grey, mean, pixels, np.stack([dx, dy]), affine)
    g, (f, fx, fy) = grey - mean, pixels
    expected = [g, g * g, f * g, fx * g, fx * dx * g, fx * dy * g, fy * g, fy * dx * g, fy * dy * g]
    for found, terms in zip(affine, expected, strict=True):
        assert abs(found - terms.sum()) <= 1e-14 * np.abs(terms).sum()


@pytest.mark.parametrize("count", [1, 8, 21])
def test_sums_of_a_run_within_a_row(count):
    rng = np.random.default_rng(count)
    grey, mean, pixels, sums = rng.uniform(0, 4095, count), 2000.0, rng.normal(0, 3, (4, 40)), np.empty(RUN_SUMS)
    run(grey, mean, pixels, (13, count), -7.5, sums)
    g, dx, (w, f, fx, fy) = grey - mean, np.arange(count) - 7.5, pixels[:, 13 : 13 + count]
    expected = [w * g, w * g * g, f * g, fx * g, fx * dx * g, fy * g, fy * dx * g]
    for found, terms in zip(sums, expected, strict=True):
        assert abs(found - terms.sum()) <= 1e-14 * np.abs(terms).sum()


def test_a_kernel_keeps_its_options_independent_of_the_first_caller():
    """Python rounds every operation by itself; so does a kernel that a function of other options is compiled with."""
    kernel = njit()(basis.py_func)

    @numba.njit(fastmath=FREE, error_model="numpy")
    def caller(places, degree, values, slopes):
        for k in range(len(places)):
            kernel(places[k], degree, values[k], slopes[k])

    places = np.random.default_rng(8).uniform(0.0, 1.0, 200)
    found, expected = np.zeros((2, 200, 8)), np.zeros((2, 200, 8))
    caller(places, 7, *found)
    for place, *rows in zip(places, *expected, strict=True):
        basis.py_func(float(place), 7, *rows)
    assert found.tobytes() == expected.tobytes()


def test_lanes_give_the_same_bits_in_any_function():
    rng = np.random.default_rng(9)
    coefficients, lines = rng.uniform(0, 4095, (40, 48)).astype(np.float32), rng.uniform(8, 12, (50, 2))

    @numba.njit(fastmath=FREE)
    def free(coefficients, lines, grey):
        for k in range(len(lines)):
            sample_line(coefficients, 7, (lines[k, 0], lines[k, 1]), (1.001, 0.01), grey[k], (0, 21))

    def alone(coefficients, lines, grey):
        for line, row in zip(lines, grey, strict=True):
            sample_line(coefficients, 7, (line[0], line[1]), (1.001, 0.01), row, (0, 21))

    one, other = np.full((2, 50, 21), np.nan, np.float32)
    free(coefficients, lines, one)
    alone(coefficients, lines, other)
    assert one.tobytes() == other.tobytes()
    refused("fastmath", njit, fastmath=True, error=TypeError)


# A cached kernel must not outlive a change in another file that it was compiled from.

CALLED = """
from shakercal._common.kernels import njit

OFFSET = {offset}

@njit(inline="always")
def shifted(x):
    return x + OFFSET
"""
KERNEL = """
from shakercal._common.kernels import njit
from small.called import shifted

@njit()
def kernel(x):
    return 10 * shifted(x)
"""


@pytest.fixture
def call_anew(tmp_path, monkeypatch):
    """A function that writes a package, calls its kernel as a new process does, and returns value and cache hits."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))

    def call(checkout: str, offset: int) -> tuple[int, int]:
        folder = tmp_path / checkout / "small"
        folder.mkdir(parents=True, exist_ok=True)
        texts = {"__init__": "", "calls": KERNEL, "called": CALLED.format(offset=offset)}
        for name, text in texts.items():
            (folder / f"{name}.py").write_text(text, encoding="utf-8")
        for name in [name for name in sys.modules if name.partition(".")[0] == "small"]:
            monkeypatch.delitem(sys.modules, name)
        with monkeypatch.context() as local:
            local.syspath_prepend(str(tmp_path / checkout))
            kernel = importlib.import_module("small.calls").kernel
            for cached in (kernels._cache_folder, kernels._sources_digest):
                cached.cache_clear()
            value = kernel(1)
        return value, sum(kernel.stats.cache_hits.values())

    yield call
    for cached in (kernels._cache_folder, kernels._sources_digest):
        cached.cache_clear()


def test_a_kernel_follows_the_functions_that_it_calls_and_serves_all_checkouts(call_anew):
    assert [call_anew("one", 1), call_anew("one", 1), call_anew("other", 1)] == [(20, 0), (20, 1), (20, 1)]
    assert call_anew("one", 20) == (210, 0)


def test_a_folder_that_cannot_be_damaged_files_and_a_full_disk_cost_no_more_than_time(call_anew, tmp_path, monkeypatch):
    """A file stands where the folder would, in which even an administrator makes nothing."""
    folder = tmp_path / "kernels"
    folder.write_text("")
    assert call_anew("one", 1) == (20, 0)
    assert kernels._cache_folder("small")[1].count(":") == 1
    folder.unlink()
    with monkeypatch.context() as full:
        full.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        assert call_anew("one", 1) == (20, 0)
    assert call_anew("one", 1) == (20, 0)
    assert kernels._cache_folder("small")[1] == ""
    for pattern in ("*.nbi", "*.nbc"):
        for change in (lambda content: content[:-1], lambda _: b""):
            for file in folder.rglob(pattern):
                file.write_bytes(change(file.read_bytes()))
            assert [call_anew("one", 1), call_anew("one", 1)] == [(20, 0), (20, 1)]


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is asked of Linux")
def test_too_few_addresses_for_the_compiler_end_in_a_sentence(monkeypatch):
    monkeypatch.setattr("resource.getrlimit", lambda _: (700_000_000,) * 2)
    assert {"600", "700"} <= set(str(refused("expected", kernels.check_memory.__wrapped__, error=MemoryError)).split())


FIRST_CALLS = """
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from photogram.camera import undistort, undistort_all
import numpy as np
assert "numba" not in sys.modules
lens, start = np.array([900.0, 910, 320, 240, -0.2, 0.1, 1e-3, -1e-3, 0, 0, 0, 0, 0.5]), Barrier(4)
plain = undistort.plain(20.0, 30.0, lens.tolist())
assert "numba" not in sys.modules

def call(_):
    start.wait()
    return undistort_all(np.array([[20.0, 30.0]]), lens)[0]

with ThreadPoolExecutor(4) as threads:
    found = list(threads.map(call, range(4)))
assert "numba" in sys.modules and len({one.tobytes() for one in found}) == 1
assert np.allclose(found[0], plain, rtol=1e-14, atol=0.0)
assert len(undistort_all.signatures) == len(undistort_all.nopython_signatures) == 1
"""


def test_kernels_are_compiled_when_threads_first_call_them_and_python_computes_the_same():
    subprocess.run([sys.executable, "-c", FIRST_CALLS], check=True, cwd=Path(kernels.__file__).parents[2])
