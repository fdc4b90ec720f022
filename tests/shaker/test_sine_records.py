"""Long records, weights and spikes: the same fit, whichever way the samples come."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import f as f_distribution

from shaker.sine.fit import fit_sines
from shaker.sine.noise import neighbour_bins
from shaker.sine.normal_equations import LONG, Demodulator, UniformTimes, timeline
from shaker.sine.solve import SineFit, SineModel

RATE_HZ = 51_200.0
LINES_HZ = np.array([106.2495, 212.499, 1020.3])


def _fit(time: np.ndarray | UniformTimes, values: np.ndarray, frequency: np.ndarray, **options: object) -> SineFit:
    names = [str(c) for c in range(values.shape[1])]
    return fit_sines(time, values, frequency, names, names, **options)  # type: ignore[arg-type]


def _record(samples: int, channels: int, seed: int, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    time = np.arange(samples) / RATE_HZ
    value = rng.normal(size=(3, channels)) + 1j * rng.normal(size=(3, channels))
    clean = (np.exp(2j * np.pi * np.multiply.outer(time, LINES_HZ)) @ value).real
    return time, clean + noise * rng.normal(size=clean.shape)


def test_long_record_keeps_twelve_digits() -> None:
    samples, step = 51_200 * 60, 1 << 12
    value = np.array([1.0 - 2.0j, 0.3j, 1e-3])
    data = np.empty((samples, 1))
    for first in range(0, samples, step):
        # Phases in whole fractions: exact where each block begins.
        begin = [float(Fraction(float(f)) / Fraction(RATE_HZ) * first % 1) for f in LINES_HZ]
        turns = np.array(begin) + np.multiply.outer(np.arange(step), LINES_HZ / RATE_HZ)
        data[first : first + step, 0] = (np.exp(2j * np.pi * np.mod(turns, 1.0)) @ value).real
    for time in (UniformTimes(0.0, RATE_HZ, samples), np.arange(samples) / RATE_HZ):
        fit = _fit(time, data, LINES_HZ)
        np.testing.assert_allclose(fit.phasors.value[:, 0], value, rtol=1e-12)
        assert fit.residual_rms[0] < 1e-12
    started = LINES_HZ * (1.0 + 1e-6)
    free = _fit(UniformTimes(0.0, RATE_HZ, samples), data, started, model=SineModel(free=(0, 0, 0)))
    np.testing.assert_allclose(free.phasors.frequency_hz, LINES_HZ, rtol=1e-15)
    # The last digit of a frequency turns a line by 2·10⁻¹¹ rad from the middle of the record to its start.
    np.testing.assert_allclose(free.phasors.value[:, 0], value, rtol=1e-10)


def test_blocks_give_what_a_design_matrix_gives() -> None:
    time, data = _record(LONG + 1234, 2, 1)
    data[777, 0] = np.nan
    fit = _fit(time, data, LINES_HZ, model=SineModel(drift=True))
    kept = np.isfinite(data).all(axis=1)
    angle = 2.0 * np.pi * np.multiply.outer(time, LINES_HZ)
    columns = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(time), time - fit.middle_s])
    found = np.linalg.lstsq(columns[kept], data[kept], rcond=None)[0]
    np.testing.assert_allclose(fit.phasors.value, found[:3] - 1j * found[3:6], rtol=1e-9)
    np.testing.assert_allclose(fit.offset, found[6], atol=1e-10)
    np.testing.assert_allclose(fit.drift_per_s, found[7], atol=1e-9)
    residual = data[kept] - columns[kept] @ found
    np.testing.assert_allclose(fit.residual_rms, np.sqrt(np.mean(residual**2, axis=0)), rtol=1e-10)
    np.testing.assert_allclose(fit.residual_of(time, data)[kept], residual, atol=1e-9)
    assert fit.notices[0].text == f"1 of {len(time)} samples are missing"


def test_long_and_short_ways_agree() -> None:
    # A gap of one sample leaves the grid but not the fit; without it the record passes in uniform blocks.
    time, data = _record(LONG + 4000, 2, 2)
    whole, gapped = _fit(time, data, LINES_HZ), _fit(np.delete(time, 5), np.delete(data, 5, axis=0), LINES_HZ)
    np.testing.assert_allclose(gapped.phasors.value, whole.phasors.value, atol=1e-4)
    np.testing.assert_allclose(gapped.phasors.u_re, whole.phasors.u_re, rtol=0.02)


def test_ordinates_of_blocks_are_those_of_the_transform_even_beside_mains() -> None:
    samples = 2 * LONG + 77
    data = np.random.default_rng(3).normal(size=(samples, 2))
    data[:, 0] += 1e4 * np.cos(2.0 * np.pi * 50.0123 * np.arange(samples) / RATE_HZ)
    bins = neighbour_bins(samples, LINES_HZ * samples / RATE_HZ)
    assert bins is not None
    times = timeline(UniformTimes(0.0, RATE_HZ, samples), None)
    demodulator = Demodulator(times, bins)
    columns = demodulator.columns()
    blocks = [data[times.rows(b)] for b in range(len(times.centre_s))]
    found = demodulator.transform(np.stack([columns[: len(block)].T @ block for block in blocks]))
    expected = np.fft.rfft(data, axis=0)[bins]
    # The noise is 1 in these units; what is left of 10⁴ times as much must not show.
    np.testing.assert_allclose(found / np.sqrt(samples), expected / np.sqrt(samples), atol=1e-3)


def test_uniform_times_written_out_are_the_same() -> None:
    uniform = UniformTimes(-0.25, 1000.0, 700)
    data = np.random.default_rng(4).normal(size=(700, 2))
    first, second = _fit(uniform, data, LINES_HZ[:2]), _fit(uniform.array(), data, LINES_HZ[:2])
    np.testing.assert_allclose(first.phasors.value, second.phasors.value, atol=1e-12)
    np.testing.assert_allclose(first.phasors.covariance, second.phasors.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("each", [False, True])
def test_weights_make_the_best_of_samples_of_unequal_noise(each: bool) -> None:
    rng = np.random.default_rng(5)
    time, frequency = np.arange(240) / 52.874, np.array([106.25, 212.5])
    sigma = 0.1 * np.where(np.arange(240) % 3, 1.0, 5.0)
    variance = np.stack([sigma**2, sigma[::-1] ** 2], axis=1) if each else sigma**2
    spread = np.sqrt(variance if each else np.stack([variance] * 2, axis=1))
    data = spread * rng.normal(size=(240, 2))
    fit = _fit(time, data, frequency, variance=variance)
    angle = 2.0 * np.pi * np.multiply.outer(time, frequency)
    columns = np.column_stack([np.cos(angle), np.sin(angle), np.ones(240)])
    for c in range(2):
        rows = 1.0 / spread[:, c]
        found = np.linalg.lstsq(columns * rows[:, None], data[:, c] * rows, rcond=None)[0]
        np.testing.assert_allclose(fit.phasors.value[:, c], found[:2] - 1j * found[2:4], atol=1e-12)
        exact = np.linalg.inv((columns * rows[:, None]).T @ (columns * rows[:, None]))
        stated = np.sqrt(fit.phasors.covariance[:, c, c] / exact.diagonal()[:2])
        np.testing.assert_allclose(stated, 1.0, atol=0.5)
    with pytest.raises(ValueError, match=r"variance: expected an array of shape \(240,\) or \(240, 2\)"):
        _fit(time, data, frequency, variance=np.ones(3))
    with pytest.raises(ValueError, match="variance: expected positive numbers"):
        _fit(time, data, frequency, variance=np.zeros(240))


@settings(max_examples=15, deadline=None)
@given(st.integers(60, 200), st.floats(0.2, 5.0), st.integers(0, 1000))
def test_two_records_joined_are_their_weighted_mean(cut: int, ratio: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time, frequency = np.arange(260) / 52.874, np.array([106.25])
    variance = np.where(np.arange(260) < cut, 1.0, ratio**2)
    data = np.sqrt(variance)[:, None] * rng.normal(size=(260, 1))
    joint = _fit(time, data, frequency, variance=variance)
    total, right = np.zeros((3, 3)), np.zeros(3)
    for part in (slice(0, cut), slice(cut, 260)):
        angle = 2.0 * np.pi * frequency[0] * time[part]
        columns = np.column_stack([np.cos(angle), -np.sin(angle), np.ones(len(angle))])
        alone = _fit(time[part], data[part], frequency)
        own = np.array([alone.phasors.value[0, 0].real, alone.phasors.value[0, 0].imag, alone.offset[0]])
        information = columns.T @ columns / variance[part][0]
        total, right = total + information, right + information @ own
    expected = np.linalg.solve(total, right)
    assert joint.phasors.value[0, 0] == pytest.approx(expected[0] + 1j * expected[1], abs=1e-9)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.floats(0.1, 10.0))
def test_weights_count_relative_to_each_other_and_in_any_order(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    time, frequency = np.arange(150) / 52.874, np.array([106.25, 212.5])
    data, variance = rng.normal(size=(150, 2)), rng.uniform(0.5, 2.0, size=(150, 2))
    plain = _fit(time, data, frequency, variance=variance)
    other = _fit(time, data[:, ::-1], frequency, variance=scale * variance[:, ::-1])
    np.testing.assert_allclose(other.phasors.value[:, ::-1], plain.phasors.value, atol=1e-12)
    np.testing.assert_allclose(other.phasors.u_re[:, ::-1], plain.phasors.u_re, rtol=1e-6)
    mixed = rng.permutation(150)
    free = SineModel(free=(0, 0))
    first = _fit(time, data + np.cos(2 * np.pi * 106.25 * time)[:, None], frequency, model=free)
    second = _fit(time[mixed], (data + np.cos(2 * np.pi * 106.25 * time)[:, None])[mixed], frequency, model=free)
    np.testing.assert_allclose(second.phasors.frequency_hz, first.phasors.frequency_hz, rtol=1e-6)


def test_spikes_are_left_out_and_named() -> None:
    rng = np.random.default_rng(6)
    time, frequency = np.arange(400) / 1000.0, np.array([80.0])
    data = np.cos(2 * np.pi * 80.0 * time)[:, None] + 0.01 * rng.normal(size=(400, 2))
    rows = np.array([3, 50, 51, 399])
    spoiled = data.copy()
    spoiled[rows, [0, 1, 0, 1]] += np.array([40.0, -3.0, 0.2, 1000.0])
    fit = _fit(time, spoiled, frequency, robust=True)
    assert fit.spikes.tolist() == rows.tolist()
    expected = _fit(np.delete(time, rows), np.delete(data, rows, axis=0), frequency)
    np.testing.assert_allclose(fit.phasors.value, expected.phasors.value, atol=1e-12)
    np.testing.assert_allclose(fit.phasors.covariance, expected.phasors.covariance, rtol=1e-4, atol=1e-12)
    assert fit.notices[0].severity == "warning"
    assert fit.notices[0].text.startswith("4 of 400 samples stand out of the noise by more than 4.")
    assert fit.notices[0].text.endswith("left out, the first at 0.003 s")


def test_spikes_of_a_long_record() -> None:
    time, data = _record(LONG + 999, 1, 7)
    rows = np.arange(5, len(time), 997)
    data[rows] += 50.0
    fit = _fit(time, data, LINES_HZ, robust=True)
    assert fit.spikes.tolist() == rows.tolist()
    assert fit.residual_rms[0] == pytest.approx(0.1, rel=0.01)


def test_what_is_no_spike_stays() -> None:
    time, frequency = np.arange(600) / 1000.0, np.array([80.0])
    exact = np.cos(2 * np.pi * 80.0 * time)[:, None] * np.array([1.0, 0.0])
    assert len(_fit(time, exact, frequency, robust=True).spikes) == 0
    late = np.where(time[:, None] < 0.18, 0.0, exact)  # a drive that starts late is no spike either
    assert (
        len(_fit(time, late + 1e-3 * np.random.default_rng(10).normal(size=(600, 2)), frequency, robust=True).spikes)
        == 0
    )


def test_clean_records_lose_nothing() -> None:
    rng = np.random.default_rng(8)
    time, frequency, lost = np.arange(60) / 1000.0, np.array([80.0]), 0
    for _ in range(100):
        lost += len(_fit(time, rng.normal(size=(60, 2)), frequency, robust=True).spikes)
    assert lost <= 5


@pytest.mark.slow
@pytest.mark.parametrize("spikes", [0.0, 0.02])
def test_robust_fit_is_as_good_as_its_good_samples(spikes: float) -> None:
    rng = np.random.default_rng(9)
    time, frequency = np.arange(300) / 1000.0, np.array([80.0])
    squares, inside = [], []
    for _ in range(300):
        data = rng.normal(size=(300, 2))
        data[rng.random(300) < spikes] += 40.0
        phasors = _fit(time, data, frequency, robust=True).phasors
        parts = np.concatenate([phasors.value[0].real, phasors.value[0].imag])
        squares.append(parts**2)
        quotient = parts @ np.linalg.solve(phasors.covariance[0], parts) / 4.0
        inside.append(quotient < f_distribution.ppf(0.95, 4, phasors.dof[0]))
    # 1200 squares scatter by 4 %.
    assert np.mean(squares) * 300.0 * (1.0 - spikes) / 2.0 == pytest.approx(1.0, abs=0.13)
    assert 0.91 < np.mean(inside) < 0.985
