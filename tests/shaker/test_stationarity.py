"""Blocks of whole periods: drifts found with their size, noise alone called noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import kstest

from shaker.sine.fit import Stationarity, stationarity

FloatArray = NDArray[np.float64]
CAMERA_HZ, FRAMES = 52.874, 211


def found(time: FloatArray, values: FloatArray, frequency: list[float]) -> Stationarity:
    names = [str(c) for c in range(values.shape[1])]
    result = stationarity(time, values, np.array(frequency), names)
    assert result is not None
    return result


def test_drifts_of_amplitude_and_phase_are_read_exactly_without_noise() -> None:
    time = np.arange(8000) / 2000.0
    middle = time - time.mean()
    grows = (3.0 + 0.01 * middle) * np.cos(2 * np.pi * 106.25 * time + 0.3)
    turns = 3.0 * np.cos(2 * np.pi * 106.25 * time + 0.3 + 1e-3 * middle)
    result = found(time, np.column_stack([grows, turns]), [106.25])
    assert (result.periods, result.whole, len(result.time_s)) == (42.0, True, 10)
    np.testing.assert_allclose(result.amplitude_per_s[0], [0.01, 0.0], atol=1e-6)
    np.testing.assert_allclose(result.phase_rad_per_s[0], [0.0, 1e-3], atol=1e-6)
    np.testing.assert_allclose(np.abs(result.value[:, 0, 0]), 3.0 + 0.01 * (result.time_s - time.mean()), rtol=1e-5)
    assert result.u.max() < 1e-6  # the drift is no noise
    assert result.p_value.max() < 1e-6


@pytest.mark.parametrize(("frequency", "blocks", "periods"), [(106.25, 2, 1.0), (115.748, 10, 4.0)])
def test_blocks_of_an_undersampled_line_hold_whole_beats(frequency: float, blocks: int, periods: float) -> None:
    # 106.25 - 2·52.874 = 0.502 Hz: two beats in 3.99 s; 115.748 - 2·52.874 = 10 Hz: forty.
    rng = np.random.default_rng(2)
    time = np.arange(FRAMES) / CAMERA_HZ
    values = 300.0 * np.cos(2 * np.pi * frequency * time)[:, None] + rng.normal(size=(FRAMES, 1))
    result = found(time, values, [frequency])
    assert (len(result.time_s), result.periods, result.whole) == (blocks, periods, True)
    assert result.block_s == pytest.approx(periods / abs(frequency - 2 * CAMERA_HZ), rel=0.01)
    assert np.abs(result.value - 300.0).max() < 5.0 * result.u.max()


def test_noise_alone_has_even_chances() -> None:
    rng = np.random.default_rng(3)
    time = np.sort(rng.uniform(0.0, 4.0, 240))  # on no grid
    line = 40.0 * np.cos(2 * np.pi * 20.0 * time)[:, None]
    results = [found(time, line + rng.normal(size=(240, 2)), [20.0]) for _ in range(150)]
    chances = np.concatenate([result.p_value.ravel() for result in results])
    assert kstest(chances, "uniform").pvalue > 1e-3
    slopes = np.concatenate([(result.amplitude_per_s / result.u_amplitude_per_s).ravel() for result in results])
    assert np.std(slopes) == pytest.approx(1.0, abs=0.15)


def test_slow_noise_is_no_drift() -> None:
    rng = np.random.default_rng(4)
    time, length = np.arange(FRAMES) / CAMERA_HZ, 8 * FRAMES
    frequency = np.fft.rfftfreq(length, 1.0 / CAMERA_HZ)
    shape = np.sqrt(1.0 + 5.0 / np.maximum(frequency, frequency[1]))
    noise = np.fft.irfft(np.fft.rfft(rng.normal(size=(200, length))) * shape)[:, :FRAMES]
    line = 500.0 * np.cos(2 * np.pi * 106.25 * time)
    alarms = [found(time, (line + series)[:, None], [106.25]).p_value[0, 0] < 0.01 for series in noise]
    assert np.mean(alarms) < 0.03


def test_a_drift_is_told_from_noise() -> None:
    rng = np.random.default_rng(5)
    time = np.arange(FRAMES) / CAMERA_HZ
    drifting = 500.0 * (1.0 + 2e-3 * (time - time.mean())) * np.cos(2 * np.pi * 115.748 * time)
    results = [found(time, (drifting + rng.normal(size=FRAMES))[:, None], [115.748]) for _ in range(50)]
    slope = np.array([result.amplitude_per_s[0, 0] for result in results])
    u = np.array([result.u_amplitude_per_s[0, 0] for result in results])
    assert abs(slope.mean() - 1.0) < 4.0 * slope.std() / np.sqrt(50)
    assert slope.std() == pytest.approx(np.median(u), rel=0.4)
    assert np.mean([result.p_value[0, 0] < 1e-3 for result in results]) > 0.95


def test_halves_where_there_are_no_two_beats_and_nothing_where_they_are_too_short() -> None:
    time = np.arange(150) / CAMERA_HZ  # 1.4 beats
    values = np.cos(2 * np.pi * 106.25 * time)[:, None]
    result = found(time, values, [106.25])
    assert (len(result.time_s), result.whole) == (2, False)
    assert result.periods == pytest.approx(0.71, abs=0.01)
    assert stationarity(time[:40], values[:40], np.array([106.25]), ["x"]) is None


def test_missing_rows_are_left_out() -> None:
    time = np.arange(1000) / 1000.0
    values = np.cos(2 * np.pi * 50.0 * time)[:, None]
    values[100:150] = np.nan
    np.testing.assert_allclose(found(time, values, [50.0]).value, 1.0, atol=1e-9)
