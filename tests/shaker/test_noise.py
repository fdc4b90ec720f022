"""Noise of a line, drifts over blocks, phasors, band-limited interpolation: against known densities and arithmetic."""

from dataclasses import replace

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import polygamma
from scipy.stats import f as fisher
from scipy.stats import kstest

from shaker.sine.noise import LineNoise, levels_at_lines, line_noise, neighbour_bins
from shaker.sine.phasor import Phasors, derivative_factor, stack_phasors
from shaker.sine.sine_fit import Stationarity, fit_sines, stationarity
from shaker.timebase.edges import PASS_BAND, kernel_reach, resample
from shakercal._common.arrays import FloatArray

CAMERA_HZ, FRAMES = 52.874, 211


def noise_of(residual: FloatArray, line_bin: list[float], *, blocks: bool = True) -> LineNoise:
    found = line_noise(residual, len(residual), np.array(line_bin), blocks=blocks)
    assert found is not None
    return found


def left_noise(time: FloatArray, series: FloatArray, lines: FloatArray, *, blocks: bool = True) -> LineNoise:
    """The noise of lines in Hz, which are bins of a record of 1 s, in what their fit leaves."""
    fit = fit_sines(time, series[:, None], lines, ["x"], ["m"])
    return noise_of(fit.residual_of(time, series[:, None]), list(lines), blocks=blocks)


def slow_noise(rng: np.random.Generator, samples: int, corner: float) -> FloatArray:
    """Return noise of density 1 + corner/j at bin j, cut from a record 16 times as long."""
    length = 16 * samples
    shape = np.sqrt(1.0 + corner / np.maximum(np.arange(length // 2 + 1) / 16.0, 1.0 / 16.0))
    shape[0] = 0.0
    return np.asarray(np.fft.irfft(np.fft.rfft(rng.normal(size=length)) * shape, n=length)[:samples])


def test_level_and_degrees_of_freedom_are_honest_for_white_noise():
    rng = np.random.default_rng(1)
    bins, line = np.delete(np.arange(150.0, 247.0), 48)[None], np.array([198.0])
    found = [levels_at_lines(rng.exponential(size=(1, 96, 1)), bins, line)[:2] for _ in range(500)]
    levels, dof = np.array(found).reshape(500, 2).T
    dof = np.median(dof)
    assert np.mean(levels) == pytest.approx(1.0, abs=0.02)
    # A scaled inverse chi-squared variable has the variance ψ'(ν/2) of its logarithm.
    assert np.std(np.log(levels)) == pytest.approx(np.sqrt(polygamma(1, dof / 2)), rel=0.15)


def test_close_lines_do_not_reduce_the_level():
    rng, time = np.random.default_rng(2), np.arange(400) / 400.0
    lines = 20.4 + 3.3 * np.arange(8)
    levels = [left_noise(time, 2.0 * rng.normal(size=400), lines).variance for _ in range(25)]
    assert np.mean(levels) == pytest.approx(4.0, rel=0.06)


def test_slow_noise_is_seen_where_it_lies():
    rng = np.random.default_rng(3)
    levels = np.array([noise_of(slow_noise(rng, 212, 20.0)[:, None], [2.0, 60.0]).variance[:, 0] for _ in range(100)])
    np.testing.assert_allclose(np.mean(levels, axis=0), 1.0 + 20.0 / np.array([2.0, 60.0]), rtol=0.3)


def test_a_mains_line_is_no_noise():
    rng = np.random.default_rng(4)
    mains = 10.0 * np.cos(2 * np.pi * 40.3 * np.arange(FRAMES) / FRAMES)
    noise = rng.normal(size=(50, FRAMES))
    quiet = [noise_of(series[:, None], [12.0]).variance[0, 0] for series in noise]
    loud = [noise_of((series + mains)[:, None], [12.0]).variance[0, 0] for series in noise]
    # What it leaves in the line is an error of the line.
    leaked = abs(np.sum(mains * np.exp(-2j * np.pi * 12.0 * np.arange(FRAMES) / FRAMES))) ** 2 / FRAMES
    assert np.median(loud) == pytest.approx(np.median(quiet) + leaked, rel=0.05)


def test_noise_is_no_smaller_than_the_scatter_between_blocks():
    rng, time = np.random.default_rng(5), np.arange(4000) / 4000.0
    wander = np.cumsum(rng.normal(size=4000)) / np.sqrt(4000)
    series = 300.0 * (1.0 + 0.05 * wander) * np.cos(2 * np.pi * 100.0 * time) + rng.normal(size=4000)
    raised, plain = (left_noise(time, series, np.array([100.0]), blocks=blocks) for blocks in (True, False))
    blocks = 300.0 * 0.05 * wander.reshape(8, 500).mean(axis=1)
    blocks -= np.polyval(np.polyfit(np.arange(8), blocks, 1), np.arange(8))
    # One of two quadratures scatters, about a straight line; u² = s²/B = 2·variance/N.
    scatter = np.sum(blocks**2) / 6.0 / 8.0 / 2.0
    assert 0.5 < 2.0 * raised.variance[0, 0] / 4000 / scatter < 4.0
    assert raised.dof[0] == 8.0
    assert plain.variance[0, 0] < 0.5 * raised.variance[0, 0]


def test_a_steady_growth_is_no_noise():
    rng, time = np.random.default_rng(8), np.arange(4000) / 4000.0
    growing = 300.0 * np.exp(0.02j * (time - 0.5)) * (1.0 + 0.03 * (time - 0.5))
    wave = (growing * np.exp(2j * np.pi * 100.0 * time)).real
    levels = [left_noise(time, wave + rng.normal(size=4000), np.array([100.0])).variance for _ in range(10)]
    assert np.mean(levels) == pytest.approx(1.0, abs=0.2)


def test_few_bins_give_no_level_and_zero_residual_gives_no_noise():
    assert np.all(noise_of(np.zeros((300, 2)), [20.0]).variance < 1e-60)
    assert line_noise(np.ones((16, 1)), 16, np.array([3.0])) is None
    bins = neighbour_bins(211, np.array([2.0, 0.5]))
    assert bins is not None
    assert bins[0, 0] == 1  # the place of the offset empties no bin
    assert 2 not in bins


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(1e-9, 1e9), seed=st.integers(0, 1000))
def test_the_level_scales_and_follows_its_channel(scale, seed):
    residual = np.random.default_rng(seed).normal(size=(211, 3)) * [1.0, 5.0, 0.2]
    noise, scaled = noise_of(residual, [2.0, 30.5]), noise_of(scale * residual[:, ::-1], [2.0, 30.5])
    np.testing.assert_allclose(scaled.variance, scale**2 * noise.variance[:, ::-1], rtol=1e-6)
    np.testing.assert_allclose(scaled.dof, noise.dof, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("corner_hz", [5.0, 1.0, 0.0])
def test_regions_of_a_slow_beat_cover(corner_hz):
    """A beat of 0.502 Hz by the stated region and by that of the white-noise formula.

    With a corner there are a drive that drifts by 0.05 % and a mains line as strong as the noise, too.
    """
    rng, trials = np.random.default_rng(7), 900
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
    stated, white = inside / trials
    assert 0.92 < stated < 0.986
    assert white < 0.6 or corner_hz < 5.0


def found(time: FloatArray, values: FloatArray, frequency: list[float]) -> Stationarity:
    names = [str(c) for c in range(values.shape[1])]
    result = stationarity(time, values, np.array(frequency), names)
    assert result is not None
    return result


def test_drifts_of_amplitude_and_phase_are_read_exactly_without_noise():
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
def test_blocks_of_an_undersampled_line_have_whole_beats(frequency, blocks, periods):
    # 106.25 - 2·52.874 = 0.502 Hz: two beats in 3.99 s; 115.748 - 2·52.874 = 10 Hz: forty.
    rng, time = np.random.default_rng(2), np.arange(FRAMES) / CAMERA_HZ
    values = 300.0 * np.cos(2 * np.pi * frequency * time)[:, None] + rng.normal(size=(FRAMES, 1))
    result = found(time, values, [frequency])
    assert (len(result.time_s), result.periods, result.whole) == (blocks, periods, True)
    assert result.block_s == pytest.approx(periods / abs(frequency - 2 * CAMERA_HZ), rel=0.01)
    assert np.abs(result.value - 300.0).max() < 5.0 * result.u.max()


def test_noise_alone_has_even_chances():
    rng = np.random.default_rng(3)
    time = np.sort(rng.uniform(0.0, 4.0, 240))  # on no grid
    line = 40.0 * np.cos(2 * np.pi * 20.0 * time)[:, None]
    results = [found(time, line + rng.normal(size=(240, 2)), [20.0]) for _ in range(60)]
    chances = np.concatenate([result.p_value.ravel() for result in results])
    assert kstest(chances, "uniform").pvalue > 1e-3
    slopes = np.concatenate([(result.amplitude_per_s / result.u_amplitude_per_s).ravel() for result in results])
    assert np.std(slopes) == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_slow_noise_is_no_drift():
    rng, time = np.random.default_rng(4), np.arange(FRAMES) / CAMERA_HZ
    noise = (slow_noise(rng, FRAMES, 5.0 * FRAMES / CAMERA_HZ) for _ in range(200))
    line = 500.0 * np.cos(2 * np.pi * 106.25 * time)
    alarms = [found(time, (line + series)[:, None], [106.25]).p_value[0, 0] < 0.01 for series in noise]
    assert np.mean(alarms) < 0.03


def test_a_drift_is_distinguished_from_noise():
    rng, time = np.random.default_rng(5), np.arange(FRAMES) / CAMERA_HZ
    drifting = 500.0 * (1.0 + 2e-3 * (time - time.mean())) * np.cos(2 * np.pi * 115.748 * time)
    results = [found(time, (drifting + rng.normal(size=FRAMES))[:, None], [115.748]) for _ in range(25)]
    slope = np.array([result.amplitude_per_s[0, 0] for result in results])
    u = np.array([result.u_amplitude_per_s[0, 0] for result in results])
    assert abs(slope.mean() - 1.0) < 4.0 * slope.std() / np.sqrt(25)
    assert slope.std() == pytest.approx(np.median(u), rel=0.4)
    assert np.mean([result.p_value[0, 0] < 1e-3 for result in results]) > 0.95


@pytest.mark.slow
def test_a_rate_as_uncertain_as_stated_makes_no_more_alarms_than_noise():
    # Times that run fast by 2e-6, drawn as stated: 5 mrad over four seconds, far above the noise.
    rng, time, rate = np.random.default_rng(6), np.arange(FRAMES) / CAMERA_HZ, 2e-6
    turn = 2 * np.pi * 115.748
    plain, with_rate, drifting = [], [], []
    for _ in range(300):
        fast = turn * (1.0 + rate * rng.standard_normal())
        noise = rng.normal(size=FRAMES)
        result = found(time, (2000.0 * np.cos(fast * time) + noise)[:, None], [115.748])
        plain.append(result.p_value[0, 0])
        with_rate.append(result.p_value_with_rate(turn * rate)[0, 0])
        bent = 2000.0 * np.cos(fast * time + 6e-3 * np.cos(2 * np.pi * time / time[-1])) + noise
        drifting.append(found(time, bent[:, None], [115.748]).p_value_with_rate(turn * rate)[0, 0])
    assert np.mean(np.array(plain) < 0.01) > 0.3
    assert kstest(with_rate, "uniform").pvalue > 1e-3
    assert np.mean(np.array(with_rate) < 0.01) < 0.04
    assert np.mean(np.array(drifting) < 0.01) > 0.95
    np.testing.assert_allclose(result.p_value_with_rate(0.0), result.p_value)


def test_halves_without_two_beats_and_none_for_short_records():
    time = np.arange(150) / CAMERA_HZ  # 1.4 beats
    values = np.cos(2 * np.pi * 106.25 * time)[:, None]
    result = found(time, values, [106.25])
    assert (len(result.time_s), result.whole) == (2, False)
    assert result.periods == pytest.approx(0.71, abs=0.01)
    assert stationarity(time[:40], values[:40], np.array([106.25]), ["x"]) is None
    time = np.arange(1000) / 1000.0
    values = np.cos(2 * np.pi * 50.0 * time)[:, None]
    values[100:150] = np.nan  # missing rows are left out
    np.testing.assert_allclose(found(time, values, [50.0]).value, 1.0, atol=1e-9)


def _random_phasors(rng: np.random.Generator, lines: int = 2, channels: int = 3) -> Phasors:
    root = rng.normal(size=(lines, 2 * channels, 2 * channels))
    return Phasors(
        frequency_hz=np.array([106.25, 425.0])[:lines],
        value=rng.normal(size=(lines, channels)) + 1j * rng.normal(size=(lines, channels)),
        covariance=root @ root.swapaxes(1, 2),
        channels=tuple("abc"[:channels]),
        unit=("m",) * channels,
        dof=np.full(lines, 10.0),
    )


def test_second_derivative_of_a_displacement_is_its_acceleration():
    # The published load mass: 0.4277 mm at 106.2495 Hz is 190.6131 m/s^2.
    factor = derivative_factor(np.array([106.2495]), 2)
    assert (factor[0] * 0.4277e-3, factor[0].imag) == (pytest.approx(-190.6131, rel=1e-6), 0.0)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.1, 5e4), st.integers(-3, 3), st.integers(-3, 3))
def test_derivatives_add_up(frequency, first, second):
    f = np.array([frequency])
    both = derivative_factor(f, first) * derivative_factor(f, second)
    np.testing.assert_allclose(both, derivative_factor(f, first + second), rtol=1e-12)


def test_selection_keeps_values_and_covariances_together():
    phasors = _random_phasors(np.random.default_rng(1))
    picked = phasors.select(["c", "a"])
    np.testing.assert_array_equal(picked.value, phasors.value[:, [2, 0]])
    np.testing.assert_array_equal(picked.covariance[:, 1, 2], phasors.covariance[:, 0, 5])
    np.testing.assert_array_equal(picked.u_im[:, 0] ** 2, phasors.covariance[:, 5, 5])
    refused("^channels: .*a, b, c.* d$", phasors.select, ["d"])
    line = phasors.at_lines(np.array([False, True]))
    assert line.frequency_hz.tolist() == [425.0]
    np.testing.assert_array_equal(line.value[0], phasors.value[1])
    # Stacking undoes selection for independent channels.
    joined = stack_phasors([phasors.select(["a", "b"]), phasors.select(["c"])])
    assert joined.channels == phasors.channels
    np.testing.assert_array_equal(joined.value, phasors.value)
    np.testing.assert_array_equal(joined.select(["a", "b"]).covariance, phasors.select(["a", "b"]).covariance)
    np.testing.assert_array_equal(joined.covariance[:, 0, 2], 0.0)
    wrong = r"^covariance: .*\(2, 6, 6\).*\(1, 6, 6\)"
    refused(wrong, replace, phasors, covariance=phasors.covariance[:1])
    refused("^unit: .*3", replace, phasors, unit=("m",))


@settings(max_examples=25, deadline=None)
@given(
    share=st.floats(0.2, 1.0),
    frequency=st.floats(0.0, PASS_BAND),
    phase=st.floats(0.0, 6.3),
    stretch=st.floats(-1e-3, 1e-3),
)
def test_a_line_in_the_pass_band_keeps_amplitude_and_phase(share, frequency, phase, stretch):
    time, reach = np.arange(3000.0), kernel_reach(share)
    position = np.arange(reach + 0.3, 3000 - reach, (1.0 + stretch) / share)
    found = resample(np.cos(2.0 * np.pi * frequency * share * time + phase), position, share)
    np.testing.assert_allclose(found, np.cos(2.0 * np.pi * frequency * share * position + phase), atol=3e-5)


def test_resampling_removes_aliases_keeps_samples_and_refuses_outside_positions():
    time, reach = np.arange(3000.0), kernel_reach(0.5)
    for frequency in (0.6, 0.75, 0.95):
        folding = resample(np.cos(np.pi * frequency * time), np.arange(reach + 0.3, 3000 - reach, 2.0), 0.5)
        assert np.abs(folding).max() < 2e-5
    samples = np.random.default_rng(1).standard_normal(200)
    reach = kernel_reach(1.0)
    positions = np.arange(reach, 200 - reach).astype(float)
    np.testing.assert_allclose(resample(samples, positions), samples[reach : 200 - reach], atol=1e-12)
    refused("^position: ", resample, samples, np.array([199.0]))
    refused("^share: .*1.5", resample, samples, positions, 1.5)
