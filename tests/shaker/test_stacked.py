"""Channels side by side without being held twice: the numbers of the array, and the memory of one channel."""

from __future__ import annotations

import tracemalloc

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from shaker import fit_sines
from shaker.io.channel import Stacked
from shaker.lines.frequencies import find_lines
from shaker.lines.spectrum import amplitude_spectrum
from shaker.sine.sine_fit import stationarity

RATE_HZ = 8000.0


@given(st.integers(1, 50), st.integers(1, 4), st.data())
def test_rows_channels_and_selections_are_those_of_the_array(samples, channels, data):
    rng = np.random.default_rng(samples)
    columns, factors = rng.normal(size=(channels, samples)), rng.normal(size=channels)
    array = (columns * factors[:, None]).T
    stacked = Stacked(tuple(columns), tuple(factors))
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=samples, max_size=samples)))
    rows = slice(*sorted(data.draw(st.tuples(st.integers(0, samples), st.integers(0, samples)))))
    for selection, expected in (
        (stacked, array),
        (stacked.select_rows(mask), array[mask]),
        (stacked.select_rows(None), array),
    ):
        assert selection.shape == expected.shape
        np.testing.assert_array_equal(selection[rows], expected[rows])
        np.testing.assert_array_equal(
            np.concatenate([np.empty((0, channels)), *selection.iterate_row_blocks()]), expected
        )
        np.testing.assert_array_equal(np.array(list(selection.iterate_channels())), expected.T)
    twice = stacked.select_rows(mask).select_rows(mask[mask])
    np.testing.assert_array_equal(twice[:], array[mask])
    np.testing.assert_array_equal(stacked.select([channels - 1])[:], array[:, -1:])


def driven(samples: int) -> tuple[np.ndarray, Stacked]:
    """Times, and 12 channels of a sine with a harmonic of 1 % and noise."""
    rng, time_s = np.random.default_rng(0), np.arange(samples) / RATE_HZ
    sine = np.sin(2 * np.pi * 80.0 * time_s) + 0.01 * np.sin(2 * np.pi * 160.0 * time_s)
    return time_s, Stacked(tuple(sine + 1e-3 * rng.normal(size=samples) for _ in range(12)), (2.0,) * 12)


NAMES = [f"c{c}" for c in range(12)]


def all_of(time_s, values):
    """What a run asks of channels sampled alike."""
    lines = find_lines(time_s, values, [80.0])
    fit = fit_sines(time_s, values, lines.frequency_hz, NAMES, ["V"] * 12)
    return lines, fit, stationarity(time_s, values, lines.frequency_hz, NAMES)


def test_lines_and_fits_of_many_channels_need_the_memory_of_few():
    """Beside the samples 5 bytes for each that a longer record has; copies of all channels would be 8 each."""
    peaks = []
    for samples in (1 << 17, 1 << 18):
        time_s, values = driven(samples)
        tracemalloc.start()
        all_of(time_s, values)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 5 * 12 * ((1 << 18) - (1 << 17))


def test_stacked_channels_give_the_results_of_an_array():
    time_s, values = driven(1 << 16)
    lines, fit, steady = all_of(time_s, values)
    same_lines, same_fit, same_steady = all_of(time_s, values[:])
    np.testing.assert_array_equal(lines.frequency_hz, same_lines.frequency_hz)
    np.testing.assert_allclose(fit.phasors.value, same_fit.phasors.value, rtol=1e-12)
    np.testing.assert_allclose(np.abs(fit.phasors.value[:, 0]), [2.0, 0.02], atol=6e-5)
    np.testing.assert_allclose(steady.value, same_steady.value, rtol=1e-12)
    spectrum = amplitude_spectrum(values.select([0]), RATE_HZ, 1 << 12)
    assert len(spectrum.frequency_hz) <= 1 << 12
    top = int(np.argmax(spectrum.amplitude))
    assert abs(spectrum.frequency_hz[top] - 80.0) < 2 * spectrum.frequency_hz[1]
    np.testing.assert_allclose(spectrum.amplitude[top, 0], 2.0, rtol=0.15)


def test_the_curve_of_a_fit_is_that_of_its_phasors_at_any_times():
    """Uniform times share their turns between parts, others do not; both are the sum of cosines."""
    rng = np.random.default_rng(1)
    time_s = np.arange(200_000) / RATE_HZ + 12.3
    values = 3.0 * np.cos(2 * np.pi * 333.3 * time_s + 0.4)[:, None] + 1e-6 * rng.normal(size=(200_000, 1))
    fit = fit_sines(time_s, values, np.array([333.3]), ["z"], ["m"])
    for times in (time_s, np.sort(rng.uniform(12.3, 37.0, 150_000)), time_s[:10]):
        phasor = fit.phasors.value[0, 0]
        expected = fit.offset[0] + np.abs(phasor) * np.cos(2 * np.pi * 333.3 * times + np.angle(phasor))
        np.testing.assert_allclose(fit.model(times)[:, 0], expected, atol=1e-8)
