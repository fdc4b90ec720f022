"""Multisines: lines that a slow camera resolves, their products, and small peaks."""

from itertools import product

import numpy as np
import pytest
from contracts import refused

from shaker.lines.multisine import (
    LineGrid,
    crest_factor,
    place_lines,
    products_on_lines,
    small_crest_phases,
    waveform,
)
from shaker.sine.aliasing import alias_frequency, condition_number, separation_bins, sine_columns
from shaker.sine.sine_fit import fit_sines

RATE_HZ = 52.874
TARGET_HZ = np.geomspace(50.0, 1000.0, 40)


@pytest.fixture(scope="module")
def grid() -> LineGrid:
    return place_lines(TARGET_HZ, RATE_HZ, 640)


def test_lines_stay_near_their_targets_and_their_aliases_apart(grid: LineGrid) -> None:
    frequency = grid.frequency_hz
    assert (len(frequency), grid.frames, grid.periods, grid.odd) == (40, 640, 2, True)
    gaps = np.minimum(np.append(np.diff(TARGET_HZ), np.inf), np.append(np.inf, np.diff(TARGET_HZ)))
    assert np.all(np.abs(frequency - TARGET_HZ) <= 0.5 * gaps + 2.0 * grid.spacing_hz)
    assert separation_bins(frequency, RATE_HZ, grid.frames) > 3.99


def test_sums_and_differences_of_lines_are_off_every_line_at_the_camera(grid: LineGrid) -> None:
    frequency = grid.frequency_hz
    products = np.abs([a + sign * b for a, b in product(frequency, repeat=2) for sign in (1, -1)])
    distance = np.abs(np.subtract.outer(alias_frequency(products, RATE_HZ), alias_frequency(frequency, RATE_HZ)))
    assert distance.min() * grid.frames / RATE_HZ > 1.99  # bins


@pytest.mark.parametrize(("frames", "lines"), [(98, 40), (98, 48), (128, 40), (200, 40)])
def test_few_frames_resolve_nearly_half_as_many_lines(frames: int, lines: int) -> None:
    found = place_lines(np.geomspace(60.0, 1200.0, lines), RATE_HZ, frames)
    columns = sine_columns(np.arange(found.frames) / RATE_HZ, found.frequency_hz)
    assert condition_number(columns.T @ columns) == pytest.approx(1.0, abs=1e-6)


def test_a_fast_camera_sees_lines_directly() -> None:
    target = np.linspace(20.0, 400.0, 30)
    found = place_lines(target, 1000.0, 1000)
    assert found.frequency_hz == pytest.approx(target, abs=7.0)  # half the distance of two targets
    assert found.alias_numbers == pytest.approx(found.numbers)


def test_too_many_lines_are_refused() -> None:
    refused("frames: .*more than 99.* 98", place_lines, np.geomspace(60.0, 1200.0, 49), RATE_HZ, 98)


@pytest.mark.parametrize("period", [0, 34])
def test_products_are_those_of_all_combinations(period: int) -> None:
    numbers = np.array([3, 8, 13, 29])

    def place(number: int) -> int:
        rest = abs(number) % period if period else abs(number)
        return min(rest, period - rest) if period else rest

    signed = [*numbers.tolist(), *(-numbers).tolist()]
    second = {place(a + b) for a, b in product(signed, repeat=2)}
    third = {
        place(a + b + c) for a, b, c in product(signed, repeat=3) if not {a, b, c} & {-a, -b, -c}
    }  # without f + g - g
    lines = [place(number) for number in numbers.tolist()]
    assert products_on_lines(numbers, 2, period) == sum(line in second for line in lines)
    assert products_on_lines(numbers, 3, period) == sum(line in third for line in lines)


def test_the_peak_is_that_of_the_waveform_and_small(grid: LineGrid) -> None:
    amplitude = np.linspace(1.0, 2.0, 40)
    phase = small_crest_phases(grid.numbers, amplitude)
    peak = crest_factor(grid.numbers, amplitude, phase) * np.sqrt(np.sum(amplitude**2) / 2.0)
    turns = np.random.default_rng(3).uniform(size=40_000)
    values = np.cos(2.0 * np.pi * np.multiply.outer(turns, grid.numbers) + phase) @ amplitude
    assert 0.9 * peak < np.abs(values).max() <= 1.01 * peak
    random = np.random.default_rng(4).uniform(0.0, 2.0 * np.pi, (20, 40))
    assert crest_factor(grid.numbers, amplitude, phase) < 0.85 * min(
        crest_factor(grid.numbers, amplitude, other) for other in random
    )


def test_all_lines_of_a_band_reach_the_crest_factor_of_the_literature() -> None:
    """31 equal lines 1 to 31: Guillaume 1991 gives 1.4; Schroeder's phases 1.7."""
    numbers, amplitude = np.arange(1, 32), np.ones(31)
    assert crest_factor(numbers, amplitude, small_crest_phases(numbers, amplitude)) < 1.5


def test_one_line_is_a_sine() -> None:
    numbers, amplitude = np.array([5]), np.array([2.0])
    phase = small_crest_phases(numbers, amplitude)
    assert crest_factor(numbers, amplitude, phase) == pytest.approx(np.sqrt(2.0), rel=1e-2)
    assert np.abs(waveform(numbers, amplitude, phase)).max() == pytest.approx(2.0, rel=1e-2)


def test_u_grows_with_the_scatter_where_two_aliases_are_closer_than_the_resolution() -> None:
    """0.4 bins apart: a half larger than alone, and so are the errors."""
    rng, frames, noise, draws = np.random.default_rng(6), 300, 1e-3, 300
    found = place_lines(np.geomspace(60.0, 900.0, 12), RATE_HZ, frames)
    frequency = found.frequency_hz.copy()
    near_hz = found.spacing_hz * found.alias_numbers[0] + 0.4 * RATE_HZ / frames
    frequency[7] = RATE_HZ * np.floor(frequency[7] / RATE_HZ) + near_hz
    time_s, true = np.arange(frames) / RATE_HZ, np.exp(1j * np.arange(12.0))
    exact = (np.exp(2j * np.pi * np.multiply.outer(time_s, frequency)) @ true).real
    values = exact[:, None] + noise * rng.standard_normal((frames, draws))
    names = [str(c) for c in range(draws)]
    phasors = fit_sines(time_s, values, frequency, names, names).phasors
    u = np.sqrt(np.mean(phasors.u_re**2 + phasors.u_im**2, axis=1) / 2.0)
    scatter = np.sqrt(np.mean(np.abs(phasors.value - true[:, None]) ** 2, axis=1) / 2.0)
    alone = noise * np.sqrt(2.0 / frames)
    assert u == pytest.approx(scatter, rel=0.1)
    assert (u / alone)[[0, 7]] == pytest.approx(1.5, abs=0.15)
    assert np.delete(u, [0, 7]) == pytest.approx(alone, rel=0.1)
