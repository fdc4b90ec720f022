"""Noise of a line against its known density, and coverage of the regions made of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import polygamma
from scipy.stats import f as fisher

from shaker.sine.fit import fit_sines
from shaker.sine.noise import LineNoise, level_at_lines, line_noise, neighbour_bins

FloatArray = NDArray[np.float64]
CAMERA_HZ, FRAMES = 52.874, 211


def noise_of(residual: FloatArray, line_bin: list[float], *, blocks: bool = True) -> LineNoise:
    found = line_noise(residual, len(residual), np.array(line_bin), blocks=blocks)
    assert found is not None
    return found


def slow_noise(rng: np.random.Generator, samples: int, corner: float) -> FloatArray:
    """Return noise of density 1 + corner/j at bin j, cut from a record 16 times as long."""
    length = 16 * samples
    bins = np.maximum(np.arange(length // 2 + 1) / 16.0, 1.0 / 16.0)
    shape = np.sqrt(1.0 + corner / bins)
    shape[0] = 0.0
    return np.asarray(np.fft.irfft(np.fft.rfft(rng.normal(size=length)) * shape, n=length)[:samples])


def test_level_and_degrees_of_freedom_are_honest_for_white_noise() -> None:
    rng = np.random.default_rng(1)
    bins, line = np.delete(np.arange(150.0, 247.0), 48)[None], np.array([198.0])
    found = [level_at_lines(rng.exponential(size=(1, 96, 1)), bins, line) for _ in range(500)]
    levels = np.array([noise.variance[0, 0] for noise in found])
    dof = np.median([noise.dof[0] for noise in found])
    assert np.mean(levels) == pytest.approx(1.0, abs=0.02)
    # A scaled inverse chi-squared variable has the variance ψ'(ν/2) of its logarithm.
    assert np.std(np.log(levels)) == pytest.approx(np.sqrt(polygamma(1, dof / 2)), rel=0.15)


def test_lines_close_together_take_none_of_the_level_away() -> None:
    rng = np.random.default_rng(2)
    time = np.arange(400) / 400.0
    lines = 20.4 + 3.3 * np.arange(8)
    levels = []
    for _ in range(100):
        series = 2.0 * rng.normal(size=(400, 1))
        fit = fit_sines(time, series, lines, ["x"], ["m"])
        levels.append(noise_of(fit.residual_of(time, series), list(lines)).variance)
    assert np.mean(levels) == pytest.approx(4.0, rel=0.03)


def test_slow_noise_is_seen_where_it_lies() -> None:
    rng = np.random.default_rng(3)
    levels = np.array([noise_of(slow_noise(rng, 212, 20.0)[:, None], [2.0, 60.0]).variance[:, 0] for _ in range(300)])
    np.testing.assert_allclose(np.mean(levels, axis=0), 1.0 + 20.0 / np.array([2.0, 60.0]), rtol=0.2)


def test_a_mains_line_is_no_noise() -> None:
    rng = np.random.default_rng(4)
    mains = 10.0 * np.cos(2 * np.pi * 40.3 * np.arange(FRAMES) / FRAMES)
    noise = rng.normal(size=(200, FRAMES))
    quiet = [noise_of(series[:, None], [12.0]).variance[0, 0] for series in noise]
    loud = [noise_of((series + mains)[:, None], [12.0]).variance[0, 0] for series in noise]
    # What it leaves in the line is an error of the line.
    leaked = abs(np.sum(mains * np.exp(-2j * np.pi * 12.0 * np.arange(FRAMES) / FRAMES))) ** 2 / FRAMES
    assert np.median(loud) == pytest.approx(np.median(quiet) + leaked, rel=0.05)


def test_noise_is_no_smaller_than_the_scatter_between_blocks() -> None:
    rng = np.random.default_rng(5)
    time = np.arange(4000) / 4000.0
    wander = np.cumsum(rng.normal(size=4000)) / np.sqrt(4000)
    series = (300.0 * (1.0 + 0.05 * wander) * np.cos(2 * np.pi * 100.0 * time) + rng.normal(size=4000))[:, None]
    fit = fit_sines(time, series, np.array([100.0]), ["x"], ["m"])
    residual = fit.residual_of(time, series)
    raised, plain = noise_of(residual, [100.0]), noise_of(residual, [100.0], blocks=False)
    blocks = 300.0 * 0.05 * wander.reshape(8, 500).mean(axis=1)
    blocks -= np.polyval(np.polyfit(np.arange(8), blocks, 1), np.arange(8))
    # One of two quadratures scatters, about a straight line; u² = s²/B = 2·variance/N.
    scatter = np.sum(blocks**2) / 6.0 / 8.0 / 2.0
    assert 0.5 < 2.0 * raised.variance[0, 0] / 4000 / scatter < 4.0
    assert raised.dof[0] == 8.0
    assert plain.variance[0, 0] < 0.5 * raised.variance[0, 0]


def test_a_steady_growth_is_no_noise() -> None:
    rng = np.random.default_rng(8)
    time = np.arange(4000) / 4000.0
    growing = 300.0 * np.exp(0.02j * (time - 0.5)) * (1.0 + 0.03 * (time - 0.5))
    wave = (growing * np.exp(2j * np.pi * 100.0 * time)).real
    levels = []
    for _ in range(30):
        series = (wave + rng.normal(size=4000))[:, None]
        fit = fit_sines(time, series, np.array([100.0]), ["x"], ["m"])
        levels.append(noise_of(fit.residual_of(time, series), [100.0]).variance)
    assert np.mean(levels) == pytest.approx(1.0, abs=0.1)


def test_few_bins_give_no_level() -> None:
    assert line_noise(np.ones((16, 1)), 16, np.array([3.0])) is None
    bins = neighbour_bins(211, np.array([2.0, 0.5]))
    assert bins is not None
    assert bins[0, 0] == 1  # the place of the offset empties no bin
    assert 2 not in bins


def test_nothing_left_is_no_noise() -> None:
    assert np.all(noise_of(np.zeros((300, 2)), [20.0]).variance < 1e-60)


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(1e-9, 1e9), seed=st.integers(0, 1000))
def test_the_level_scales_and_follows_its_channel(scale: float, seed: int) -> None:
    residual = np.random.default_rng(seed).normal(size=(211, 3)) * [1.0, 5.0, 0.2]
    noise, scaled = noise_of(residual, [2.0, 30.5]), noise_of(scale * residual[:, ::-1], [2.0, 30.5])
    np.testing.assert_allclose(scaled.variance, scale**2 * noise.variance[:, ::-1], rtol=1e-6)
    np.testing.assert_allclose(scaled.dof, noise.dof, rtol=1e-6)


def coverage(trials: int, seed: int, corner_hz: float) -> tuple[float, float]:
    """Return coverage of a beat of 0.502 Hz by the stated region and by that of the white-noise formula.

    With a corner there are a drive that drifts by 0.05 % and a mains line as strong as the noise, too.
    """
    rng = np.random.default_rng(seed)
    time, lines = np.arange(FRAMES) / CAMERA_HZ, 106.25 * np.arange(1, 5)
    inside = np.zeros(2)
    for _ in range(trials):
        series = slow_noise(rng, FRAMES, corner_hz * FRAMES / CAMERA_HZ)
        phasors = 500.0 * np.array([1.0, 0.02, 0.02, 0.02]) * np.exp(2j * np.pi * rng.random(4))
        drift = 5e-4 * (corner_hz > 0.0) * (time - time.mean()) / time[-1]
        waves = (phasors * np.exp(2j * np.pi * np.multiply.outer(time, lines))).real.sum(axis=1)
        mains = (corner_hz > 0.0) * np.cos(2 * np.pi * (50.0 * time + rng.random()))
        series = series + (1.0 + drift) * waves + mains
        fit = fit_sines(time, series[:, None], lines, ["x"], ["m"])
        error = fit.phasors.value[0, 0] - phasors[0]
        pair = np.array([error.real, error.imag])
        stated = pair @ np.linalg.solve(fit.phasors.covariance[0], pair) / 2.0
        free = FRAMES - 9
        white = abs(error) ** 2 / 2.0 / (2.0 * fit.residual_rms[0] ** 2 / free)
        inside += [stated < fisher.ppf(0.95, 2, fit.phasors.dof[0]), white < fisher.ppf(0.95, 2, free)]
    return float(inside[0] / trials), float(inside[1] / trials)


@pytest.mark.parametrize(
    ("corner_hz", "trials"),
    [(5.0, 300), *(pytest.param(corner, 900, marks=pytest.mark.slow) for corner in (5.0, 1.0, 0.0))],
)
def test_regions_of_a_slow_beat_cover(corner_hz: float, trials: int) -> None:
    stated, white = coverage(trials, 6 if trials == 300 else 7, corner_hz)
    assert 0.92 < stated < (0.985 if trials == 300 else 0.986)  # 97 % scatter by 1 % in 300 trials
    assert white < 0.6 or corner_hz < 5.0
