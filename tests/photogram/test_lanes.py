"""Sums by eight pixels at a time against numpy, and kernels against what they may be compiled into."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import pytest

from photogram.bspline import basis, sample_line
from photogram.kernels import njit
from photogram.subsets.reference import AFFINE_SUMS, CURVED_SUMS, RUN_SUMS, affine_sums, curved_sums, run_sums

FREE = {"contract", "reassoc", "nsz", "arcp"}


@njit()
def subset(grey, mean, pixels, offsets, affine, curved):  # type: ignore[no-untyped-def]
    """Sums over a subset."""
    affine_sums(grey, mean, pixels, offsets, affine)
    curved_sums(grey, mean, pixels, offsets, curved)


@njit()
def run(grey, mean, pixels, start, dx, sums):  # type: ignore[no-untyped-def]
    """Sums over a run."""
    run_sums(grey, mean, pixels, start, dx, sums)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 31, 441])
def test_sums_of_any_length(count: int) -> None:
    rng = np.random.default_rng(count)
    grey, mean, pixels = rng.uniform(0, 4095, count), 2000.0, rng.normal(0, 300, (3, count))
    (dx, dy), (affine, curved) = rng.integers(-10, 11, (2, count)).astype(float), (np.empty(9), np.empty(6))
    subset(grey, mean, pixels, np.stack([dx, dy]), affine, curved)
    g, (f, fx, fy) = grey - mean, pixels
    expected = [g, g * g, f * g, fx * g, fx * dx * g, fx * dy * g, fy * g, fy * dx * g, fy * dy * g]
    expected += [slope * bend * g for slope in (fx, fy) for bend in (dx * dx / 2, dx * dy, dy * dy / 2)]
    assert (len(affine), len(curved)) == (AFFINE_SUMS, CURVED_SUMS)
    for found, terms in zip([*affine, *curved], expected, strict=True):
        assert abs(found - terms.sum()) <= 1e-14 * np.abs(terms).sum()


@pytest.mark.parametrize("count", [1, 8, 21])
def test_sums_of_a_run_within_a_row(count: int) -> None:
    rng = np.random.default_rng(count)
    grey, mean, pixels, sums = rng.uniform(0, 4095, count), 2000.0, rng.normal(0, 3, (4, 40)), np.empty(RUN_SUMS)
    run(grey, mean, pixels, 13, -7.5, sums)
    g, dx, (w, f, fx, fy) = grey - mean, np.arange(count) - 7.5, pixels[:, 13 : 13 + count]
    expected = [w * g, w * g * g, f * g, fx * g, fx * dx * g, fy * g, fy * dx * g]
    for found, terms in zip(sums, expected, strict=True):
        assert abs(found - terms.sum()) <= 1e-14 * np.abs(terms).sum()


def test_a_kernel_keeps_its_own_options_whoever_calls_it_first() -> None:
    """Python rounds every operation by itself; so does a kernel that a function of other options is compiled with."""
    kernel = njit()(basis.py_func)

    @numba.njit(fastmath=FREE, error_model="numpy")  # type: ignore[untyped-decorator]
    def caller(places, degree, values, slopes):  # type: ignore[no-untyped-def]
        for k in range(len(places)):
            kernel(places[k], degree, values[k], slopes[k])

    places = np.random.default_rng(8).uniform(0.0, 1.0, 200)
    found, expected = np.zeros((2, 200, 8)), np.zeros((2, 200, 8))
    caller(places, 7, *found)
    for place, *rows in zip(places, *expected, strict=True):
        basis.py_func(float(place), 7, *rows)
    assert found.tobytes() == expected.tobytes()


def test_lanes_give_the_same_bits_in_any_function() -> None:
    rng = np.random.default_rng(9)
    coefficients, lines = rng.uniform(0, 4095, (40, 48)), rng.uniform(8, 12, (50, 2))

    @numba.njit(fastmath=FREE)  # type: ignore[untyped-decorator]
    def free(coefficients, lines, grey):  # type: ignore[no-untyped-def]
        for k in range(len(lines)):
            sample_line(coefficients, 7, lines[k, 0], lines[k, 1], 1.001, 0.01, grey[k])

    def alone(coefficients, lines, grey):  # type: ignore[no-untyped-def]
        for line, row in zip(lines, grey, strict=True):
            sample_line(coefficients, 7, line[0], line[1], 1.001, 0.01, row)

    results = []
    sampled: tuple[Callable[..., None], ...] = (free, alone)
    for function in sampled:
        results.append(np.full((50, 21), np.nan))
        function(coefficients, lines, results[-1])
    assert results[0].tobytes() == results[1].tobytes()


def test_options_by_which_copies_of_a_kernel_differ_are_none() -> None:
    with pytest.raises(TypeError, match="fastmath"):
        njit(fastmath=True)  # type: ignore[call-arg]
