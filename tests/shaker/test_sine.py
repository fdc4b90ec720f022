"""Sine approximation: analytic truth, IEEE 1057, Fisher information, coverage; long records, weights, spikes."""

from fractions import Fraction

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import f as f_distribution

from shaker.signal_notices import MISSING_SAMPLES, SPIKES_REJECTED
from shaker.sine.normal_equations import LONG, SineSums
from shaker.sine.sine_fit import fit_sines, quantisation_error
from shaker.sine.solve import SineModel

CAMERA_HZ, RATE_HZ = 52.874, 51_200.0
LINES_HZ = np.array([106.2495, 212.499, 1020.3])
PLAIN, FREE, DRIFT = SineModel(), SineModel(free=(0,)), SineModel(drift=True)


def _fit(time, values, frequency, model=PLAIN, **options):
    names = [str(c) for c in range(values.shape[1])]
    return fit_sines(time, values, frequency, names, names, model=model, **options)  # type: ignore[arg-type]


def _series(time, frequency, value, offset=0.0, decay=0.0):
    """Sum of Re{X exp((jω - δ)t)} written out with cosines: amplitude and phase, not the fit's own columns."""
    total = np.full((len(time), value.shape[1]), offset)
    for x, f, d in zip(value, frequency, np.broadcast_to(decay, len(frequency)), strict=True):
        total += np.abs(x) * np.exp(-d * time)[:, None] * np.cos(2 * np.pi * f * time[:, None] + np.angle(x))
    return total


def _design(time, frequency, *more):
    """Cosines, sines, ones, and more columns, for a least squares of another library."""
    angle = 2.0 * np.pi * np.multiply.outer(time, frequency)
    return np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(time), *more])


@pytest.mark.parametrize("rate", [5000.0, CAMERA_HZ])
def test_exact_data_come_back_exactly(rate):
    frequency, rng = 106.25 * np.arange(1, 4), np.random.default_rng(0)
    value = rng.normal(size=(3, 2)) + 1j * rng.normal(size=(3, 2))
    time = 0.3 + np.arange(400) / rate
    values = _series(time, frequency, value, 5.0)
    fit = _fit(time, values, frequency)
    np.testing.assert_allclose(fit.phasors.value, value, atol=1e-11)
    np.testing.assert_allclose(fit.offset, 5.0, atol=1e-11)
    np.testing.assert_allclose(fit.residual_of(time, values), 0.0, atol=1e-11)
    np.testing.assert_allclose(fit.residual_rms, 0.0, atol=1e-11)
    np.testing.assert_allclose(fit.model(time), values, atol=1e-11)


def test_drift_is_separated_from_the_lines_and_missing_samples_are_dropped_and_counted():
    time, value = np.arange(211) / CAMERA_HZ, np.array([[1.0 + 1.0j, 2.0j]])
    values = _series(time, np.array([106.25]), value) + 0.7 * (time - time.mean())[:, None]
    values[7, 1] = np.nan
    fit = _fit(time, values, np.array([106.25]), DRIFT)
    np.testing.assert_allclose(fit.drift_per_s, 0.7)
    np.testing.assert_allclose(fit.phasors.value, value, atol=1e-11)
    np.testing.assert_allclose(fit.model(time)[8:], values[8:], atol=1e-11)
    residual = fit.residual_of(time, values)
    assert np.isnan(residual[7]).all()
    assert np.isfinite(np.delete(residual, 7, axis=0)).all()
    assert (fit.notices[0].code, fit.notices[0].values) == (MISSING_SAMPLES.code, {"missing": 1, "samples": 211})


@settings(max_examples=25, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(0.01, 100.0), st.permutations([0, 1, 2]), st.integers(0, 1000))
def test_time_shift_scale_and_channel_order(shift, scale, order, seed):
    rng, frequency = np.random.default_rng(seed), np.array([106.25, 212.5])
    time = np.arange(150) / CAMERA_HZ
    values = rng.normal(size=(150, 3))
    plain = _fit(time, values, frequency)
    moved = _fit(time + shift, scale * values[:, order], frequency)
    turn = np.exp(-2j * np.pi * frequency * shift)[:, None]
    np.testing.assert_allclose(moved.phasors.value, scale * turn * plain.phasors.value[:, order], atol=1e-8 * scale)
    both = np.concatenate([order, np.array(order) + 3])
    expected = plain.phasors.scaled(turn).covariance[:, both[:, None], both] * scale**2
    np.testing.assert_allclose(moved.phasors.covariance, expected, rtol=1e-5, atol=1e-6 * expected.max())
    mixed = rng.permutation(150)
    np.testing.assert_allclose(
        _fit(time[mixed], values[mixed], frequency).phasors.value, plain.phasors.value, atol=1e-12
    )


@pytest.mark.parametrize(
    ("rate", "samples", "lines"),
    [
        pytest.param(4250.0, 400, 1, marks=pytest.mark.slow),
        pytest.param(4250.0, 400, 5, marks=pytest.mark.slow),
        (CAMERA_HZ, 211, 2),
        pytest.param(0.05 * 106.25 * 1.0173, 240, 1, marks=pytest.mark.slow),
    ],
)
def test_variance_reaches_the_bound_and_regions_cover(rate, samples, lines):
    """Pooled variance over the Cramér-Rao bound, coverage of the 95 % region, and bias over its deviation."""
    trials = 1000 // lines
    rng = np.random.default_rng(3)
    frequency = 106.25 * np.arange(1, lines + 1)
    time, sigma = np.arange(samples) / rate, np.array([0.1, 2.0])
    error, covered = [], []
    for _ in range(trials):
        value = rng.normal(size=(lines, 2)) + 1j * rng.normal(size=(lines, 2))
        values = _series(time, frequency, value) + sigma * rng.normal(size=(samples, 2))
        phasors = _fit(time, values, frequency).phasors
        delta = phasors.value - value
        error.append(delta / sigma)
        for c in range(2):
            covariance = phasors.covariance[:, [[c], [c + 2]], [c, c + 2]]
            d = np.stack([delta[:, c].real, delta[:, c].imag], axis=1)
            covered += zip(np.einsum("ki,kij,kj->k", d, np.linalg.inv(covariance), d) / 2.0, phasors.dof, strict=True)
    quotient, dof = np.array(covered).T
    e = np.array(error)
    # The bound for one quadrature of a sine of known frequency in white noise: 2 σ²/N.
    ratio = np.mean(e.real**2 + e.imag**2) / 2.0 / (2.0 / samples)
    bias = e.mean(axis=0) / (e.std(axis=0) / np.sqrt(trials))
    # 2·2·lines·trials values: the ratio scatters by 0.02, the coverage by 0.5 %; near-zero aliases are overstated.
    assert 0.92 < ratio < 1.08
    assert 0.935 < np.mean(quotient < f_distribution.ppf(0.95, 2, dof)) < 0.985
    assert max(np.abs(bias.real).max(), np.abs(bias.imag).max()) < 4.5


def test_folded_lines_are_refused_with_the_remedy():
    time = np.arange(300) / 200.0
    refused("^frequency_hz: .*usable_lines", _fit, time, np.ones((300, 1)), np.array([100.0]))
    refused(r"^time_s: .* 3 .* 3$", _fit, time[:3], np.ones((3, 1)), np.array([30.0]))
    refused("^unit: .*1", fit_sines, time, np.ones((300, 1)), np.array([30.0]), ["a"], [])
    two, one = SineModel(free=(0, 1)), np.array([80.0])
    refused("^free: .*1 .*2$", _fit, time, np.ones((300, 1)), one, two)
    refused("^frequency_hz: ", _fit, time, np.zeros((300, 1)), one, FREE)


def ieee_1057(time: np.ndarray, y: np.ndarray, frequency: float, steps: int = 12) -> tuple[float, complex]:
    """The four-parameter algorithm as the standard's annex writes it: D = [cos, sin, 1, t·(b·cos - a·sin)]."""
    a = b = 0.0
    for step in range(steps):
        angle = 2 * np.pi * frequency * time
        columns = [np.cos(angle), np.sin(angle), np.ones_like(time)]
        if step:
            columns.append(time * (b * np.cos(angle) - a * np.sin(angle)))
        found = np.linalg.lstsq(np.column_stack(columns), y, rcond=None)[0]
        a, b = found[:2]
        frequency += found[3] / (2 * np.pi) if step else 0.0
    return frequency, complex(a, -b)


@pytest.mark.parametrize(("rate", "samples"), [(1000.0, 300), (CAMERA_HZ, 211)])
def test_four_parameters_are_those_of_ieee_1057(rate, samples):
    rng, time = np.random.default_rng(0), 0.4 + np.arange(samples) / rate
    y = 2.0 * np.cos(2 * np.pi * 106.25 * time + 0.7) + 0.2 * rng.normal(size=samples) + 3.0
    fit = _fit(time, y[:, None], np.array([106.25 + 0.1 * rate / samples]), FREE)
    frequency, value = ieee_1057(time, y, 106.25 + 0.1 * rate / samples)
    assert fit.phasors.frequency_hz[0] == pytest.approx(frequency, rel=1e-9)
    assert fit.phasors.value[0, 0] == pytest.approx(value, rel=1e-6)


def test_exact_frequencies_and_decays_come_back():
    time = np.arange(1500) / 1000.0
    frequency, decay = np.array([53.7, 106.25, 170.1]), np.array([0.5, 2.0, 0.0])
    value = np.array([[1.0 + 1.0j, 2.0], [0.3j, -1.0], [0.5, 0.1j]])
    model = SineModel(drift=True, free=(0, 1, 1), decay="each")
    data = _series(time, frequency, value, 4.0, decay) - 0.3 * time[:, None]
    fit = _fit(time, data, frequency * np.array([1.001, 0.9995, 0.9995]), model)
    np.testing.assert_allclose(fit.phasors.frequency_hz, frequency, rtol=1e-12)
    np.testing.assert_allclose(fit.decay_per_s, decay, atol=1e-11)
    np.testing.assert_allclose(fit.phasors.value, value, atol=1e-11)
    np.testing.assert_allclose(fit.drift_per_s, -0.3, atol=1e-11)
    np.testing.assert_allclose(fit.model(time), data, atol=1e-11)


def _fisher(time: np.ndarray, frequency: float, value: complex, sigma: float, decay: bool) -> np.ndarray:
    """Inverse Fisher matrix of (Re X, Im X, offset, f[, δ]) by central differences of the curve."""

    def curve(p: np.ndarray) -> np.ndarray:
        damping = p[4] if decay else 0.0
        wave = (p[0] + 1j * p[1]) * np.exp((2j * np.pi * p[3] - damping) * time)
        return np.asarray(wave.real + p[2])

    start = np.array([value.real, value.imag, 0.0, frequency, 0.0][: 5 if decay else 4])
    steps = np.diag([1e-4, 1e-4, 1e-4, 1e-5, 1e-5][: len(start)])
    jacobian = np.column_stack([(curve(start + s) - curve(start - s)) / (2 * s.sum()) for s in steps])
    return np.asarray(sigma**2 * np.linalg.inv(jacobian.T @ jacobian))


@pytest.mark.parametrize("decay", [False, True])
@pytest.mark.parametrize("start", [0.0, -1.0, 5.0])
def test_stated_covariance_is_the_inverse_fisher_information(start, decay):
    # Far from time zero nearly all of the phase's uncertainty is the frequency's.
    rng = np.random.default_rng(1)
    time, value, sigma = start + np.arange(4000) / 2000.0, 1.5 - 0.5j, 0.05
    y = (value * np.exp(2j * np.pi * 106.25 * time)).real + sigma * rng.normal(size=4000)
    fit = _fit(time, y[:, None], np.array([106.25]), SineModel(free=(0,), decay="common" if decay else "none"))
    bound = _fisher(time, 106.25, value, sigma, decay)
    scale = np.trace(fit.phasors.covariance[0]) / np.trace(bound[:2, :2])
    assert scale == pytest.approx(1.0, abs=0.5)  # the noise is read from 48 ordinates
    np.testing.assert_allclose(
        fit.phasors.covariance[0] / scale, bound[:2, :2], rtol=0.1, atol=0.05 * bound[:2, :2].max()
    )
    assert fit.u_frequency_hz[0] ** 2 / scale == pytest.approx(bound[3, 3], rel=0.1)
    if decay:
        assert fit.u_decay_per_s[0] ** 2 / scale == pytest.approx(bound[4, 4], rel=0.1)


def test_fixed_lines_stay_and_lines_of_a_label_move_together():
    time, true = np.arange(2000) / 1000.0, np.array([50.0, 100.1, 200.2])
    data = _series(time, true, np.ones((3, 1), dtype=complex))
    fit = _fit(time, data, np.array([50.0, 100.0, 200.0]), SineModel(free=(-1, 4, 4)))
    np.testing.assert_allclose(fit.phasors.frequency_hz, true, rtol=1e-9)
    assert (fit.u_frequency_hz[0], fit.phasors.frequency_hz[0]) == (0.0, 50.0)


def test_channels_weigh_by_their_noise():
    # A channel of the same amplitude and a hundred times the noise must not spoil the frequency of the quiet one.
    rng, time = np.random.default_rng(4), np.arange(500) / 1000.0
    wave = np.cos(2 * np.pi * 80.0 * time)
    data = np.stack([wave + 1e-3 * rng.normal(size=500), wave + 0.1 * rng.normal(size=500)], axis=1)
    alone, both = (_fit(time, part, np.array([80.02]), FREE) for part in (data[:, :1], data))
    shift = abs(both.phasors.frequency_hz[0] - alone.phasors.frequency_hz[0])
    assert shift < 0.1 * alone.u_frequency_hz[0]
    assert both.u_frequency_hz[0] == pytest.approx(alone.u_frequency_hz[0], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [1000.0, CAMERA_HZ])
def test_common_frequency_covers_with_correlated_channels(rate):
    rng = np.random.default_rng(5)
    time, frequency, mix = np.arange(300) / rate, 106.25, np.array([[1.0, 0.0], [0.9, 0.5]])
    value = np.array([[1.0 + 0.5j, 0.4j]])
    clean = _series(time, np.array([frequency]), value)
    inside, deviation = [], []
    for _ in range(300):
        fit = _fit(time, clean + 0.1 * rng.normal(size=(300, 2)) @ mix.T, np.array([frequency]), FREE)
        error = np.concatenate([(fit.phasors.value - value)[0].real, (fit.phasors.value - value)[0].imag])
        squares = error @ np.linalg.solve(fit.phasors.covariance[0], error) / 4.0
        inside.append(squares < f_distribution.ppf(0.95, 4, fit.phasors.dof[0]))
        deviation.append((fit.phasors.frequency_hz[0] - frequency) / fit.u_frequency_hz[0])
    assert 0.90 < np.mean(inside) < 0.99
    assert np.std(deviation) == pytest.approx(1.0, abs=0.15)


@settings(max_examples=15, deadline=None)
@given(st.floats(-2.0, 2.0), st.floats(0.01, 100.0), st.floats(0.5, 2.0), st.integers(0, 1000))
def test_time_shift_scale_and_clock(shift, scale, clock, seed):
    rng, time = np.random.default_rng(seed), np.arange(300) / 1000.0
    data = np.cos(2 * np.pi * 80.0 * time)[:, None] * np.array([1.0, 0.3]) + 0.05 * rng.normal(size=(300, 2))
    model = SineModel(free=(0,), decay="common")
    plain = _fit(time, data, np.array([80.1]), model)
    moved = _fit((time + shift) * clock, scale * data[:, ::-1], np.array([80.1]) / clock, model)
    frequency, decay = plain.phasors.frequency_hz, plain.decay_per_s
    np.testing.assert_allclose(moved.phasors.frequency_hz * clock, frequency, rtol=1e-7)
    np.testing.assert_allclose(moved.decay_per_s * clock, decay, atol=1e-4)
    shifted = scale * plain.phasors.value[:, ::-1] * np.exp((decay - 2j * np.pi * frequency) * shift)[:, None]
    np.testing.assert_allclose(moved.phasors.value, shifted, rtol=1e-3)
    np.testing.assert_allclose(moved.u_frequency_hz * clock, plain.u_frequency_hz, rtol=1e-3)


def _record(samples: int, channels: int, seed: int, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    rng, time = np.random.default_rng(seed), np.arange(samples) / RATE_HZ
    value = rng.normal(size=(3, channels)) + 1j * rng.normal(size=(3, channels))
    clean = (np.exp(2j * np.pi * np.multiply.outer(time, LINES_HZ)) @ value).real
    return time, clean + noise * rng.normal(size=clean.shape)


def test_long_record_keeps_twelve_digits():
    samples, step = 51_200 * 60, 1 << 12
    value, data = np.array([1.0 - 2.0j, 0.3j, 1e-3]), np.empty((samples, 1))
    for first in range(0, samples, step):
        # Phases in whole fractions: exact where each block begins.
        begin = [float(Fraction(float(f)) / Fraction(RATE_HZ) * first % 1) for f in LINES_HZ]
        turns = np.array(begin) + np.multiply.outer(np.arange(step), LINES_HZ / RATE_HZ)
        data[first : first + step, 0] = (np.exp(2j * np.pi * np.mod(turns, 1.0)) @ value).real
    time = np.arange(samples) / RATE_HZ
    fit = _fit(time, data, LINES_HZ)
    np.testing.assert_allclose(fit.phasors.value[:, 0], value, rtol=1e-12)
    assert fit.residual_rms[0] < 1e-12
    started = LINES_HZ * (1.0 + 1e-6)
    free = _fit(time, data, started, model=SineModel(free=(0, 0, 0)))
    np.testing.assert_allclose(free.phasors.frequency_hz, LINES_HZ, rtol=1e-15)
    # The last digit of a frequency turns a line by 2·10⁻¹¹ rad from the middle of the record to its start.
    np.testing.assert_allclose(free.phasors.value[:, 0], value, rtol=1e-10)


def test_blocks_agree_with_a_design_matrix():
    time, data = _record(LONG + 1234, 2, 1)
    data[777, 0] = np.nan
    fit, complete = _fit(time, data, LINES_HZ, DRIFT), np.isfinite(data).all(axis=1)
    columns = _design(time, LINES_HZ, time - fit.middle_s)
    found = np.linalg.lstsq(columns[complete], data[complete], rcond=None)[0]
    np.testing.assert_allclose(fit.phasors.value, found[:3] - 1j * found[3:6], rtol=1e-9)
    np.testing.assert_allclose(fit.offset, found[6], atol=1e-10)
    np.testing.assert_allclose(fit.drift_per_s, found[7], atol=1e-9)
    residual = data[complete] - columns[complete] @ found
    np.testing.assert_allclose(fit.residual_rms, np.sqrt(np.mean(residual**2, axis=0)), rtol=1e-10)
    np.testing.assert_allclose(fit.residual_of(time, data)[complete], residual, atol=1e-9)
    assert fit.notices[0].values == {"missing": 1, "samples": len(time)}


def test_long_and_short_records_agree_and_many_channels_have_correct_uncertainty():
    twelve = np.random.default_rng(12).normal(size=(200_000, 12))
    fit = _fit(np.arange(200_000) / RATE_HZ, twelve, 106.25 * np.arange(1, 7))
    np.testing.assert_allclose(fit.phasors.u_re, np.sqrt(2.0 / 200_000), rtol=0.5)
    assert fit.condition < 1.01
    # A gap of one sample leaves the grid but not the fit; without it the record passes in uniform blocks.
    time, data = _record(LONG + 4000, 2, 2)
    whole, gapped = _fit(time, data, LINES_HZ), _fit(np.delete(time, 5), np.delete(data, 5, axis=0), LINES_HZ)
    np.testing.assert_allclose(gapped.phasors.value, whole.phasors.value, atol=1e-4)
    np.testing.assert_allclose(gapped.phasors.u_re, whole.phasors.u_re, rtol=0.02)


@pytest.mark.parametrize("each", [False, True])
def test_weights_make_the_best_of_samples_of_unequal_noise(each):
    rng = np.random.default_rng(5)
    time, frequency = np.arange(240) / 52.874, np.array([106.25, 212.5])
    sigma = 0.1 * np.where(np.arange(240) % 3, 1.0, 5.0)
    variance = np.stack([sigma**2, sigma[::-1] ** 2], axis=1) if each else sigma**2
    spread = np.sqrt(variance if each else np.stack([variance] * 2, axis=1))
    data = spread * rng.normal(size=(240, 2))
    fit = _fit(time, data, frequency, variance=variance)
    columns = _design(time, frequency)
    for c in range(2):
        weighted = columns / spread[:, c, None]
        found = np.linalg.lstsq(weighted, data[:, c] / spread[:, c], rcond=None)[0]
        np.testing.assert_allclose(fit.phasors.value[:, c], found[:2] - 1j * found[2:4], atol=1e-12)
        exact = np.linalg.inv(weighted.T @ weighted)
        stated = np.sqrt(fit.phasors.covariance[:, c, c] / exact.diagonal()[:2])
        np.testing.assert_allclose(stated, 1.0, atol=0.5)
    with pytest.raises(ValueError, match=r"^variance: .*\(240,\).*\(240, 2\)"):
        _fit(time, data, frequency, variance=np.ones(3))
    refused("^variance: ", _fit, time, data, frequency, variance=np.zeros(240))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.floats(0.1, 10.0))
def test_weights_count_relative_to_each_other_and_in_any_order(seed, scale):
    rng = np.random.default_rng(seed)
    time, frequency = np.arange(150) / 52.874, np.array([106.25, 212.5])
    data, variance = rng.normal(size=(150, 2)), rng.uniform(0.5, 2.0, size=(150, 2))
    plain = _fit(time, data, frequency, variance=variance)
    other = _fit(time, data[:, ::-1], frequency, variance=scale * variance[:, ::-1])
    np.testing.assert_allclose(other.phasors.value[:, ::-1], plain.phasors.value, atol=1e-12)
    np.testing.assert_allclose(other.phasors.u_re[:, ::-1], plain.phasors.u_re, rtol=1e-6)


def test_spikes_are_left_out_and_named_in_long_records_too():
    rng = np.random.default_rng(6)
    time, frequency = np.arange(400) / 1000.0, np.array([80.0])
    data = np.cos(2 * np.pi * 80.0 * time)[:, None] + 0.01 * rng.normal(size=(400, 2))
    rows, spoiled = np.array([3, 50, 51, 399]), data.copy()
    spoiled[rows, [0, 1, 0, 1]] += np.array([40.0, -3.0, 0.2, 1000.0])
    fit = _fit(time, spoiled, frequency, SineModel(robust=True))
    assert fit.spikes.tolist() == rows.tolist()
    expected = _fit(np.delete(time, rows), np.delete(data, rows, axis=0), frequency)
    np.testing.assert_allclose(fit.phasors.value, expected.phasors.value, atol=1e-12)
    np.testing.assert_allclose(fit.phasors.covariance, expected.phasors.covariance, rtol=1e-4, atol=1e-12)
    assert fit.notices[0].severity == "warning"
    assert fit.notices[0].code == SPIKES_REJECTED.code
    assert (fit.notices[0].values["spikes"], fit.notices[0].values["samples"]) == (4, 400)
    assert 4.0 < fit.notices[0].values["limit_sigmas"] < 5.0
    assert fit.notices[0].values["first_s"] == pytest.approx(0.003)
    time, data = _record(LONG + 999, 1, 7)
    rows = np.arange(5, len(time), 997)
    data[rows] += 50.0
    fit = _fit(time, data, LINES_HZ, SineModel(robust=True))
    assert (fit.spikes.tolist(), fit.residual_rms[0]) == (rows.tolist(), pytest.approx(0.1, rel=0.01))


def test_samples_without_spikes_are_used():
    time, frequency, robust = np.arange(600) / 1000.0, np.array([80.0]), SineModel(robust=True)
    exact = np.cos(2 * np.pi * 80.0 * time)[:, None] * np.array([1.0, 0.0])
    assert len(_fit(time, exact, frequency, robust).spikes) == 0
    late = np.where(time[:, None] < 0.18, 0.0, exact)  # a drive that starts late is no spike either
    late += 1e-3 * np.random.default_rng(10).normal(size=(600, 2))
    assert len(_fit(time, late, frequency, robust).spikes) == 0
    rng = np.random.default_rng(8)
    clean = (rng.normal(size=(60, 2)) for _ in range(100))
    assert sum(len(_fit(time[:60], noise, frequency, robust).spikes) for noise in clean) <= 5


@pytest.mark.slow
@pytest.mark.parametrize("spikes", [0.0, 0.02])
def test_robust_fit_is_as_good_as_its_good_samples(spikes):
    rng = np.random.default_rng(9)
    time, frequency = np.arange(300) / 1000.0, np.array([80.0])
    squares, inside = [], []
    for _ in range(300):
        data = rng.normal(size=(300, 2))
        data[rng.random(300) < spikes] += 40.0
        phasors = _fit(time, data, frequency, SineModel(robust=True)).phasors
        parts = np.concatenate([phasors.value[0].real, phasors.value[0].imag])
        squares.append(parts**2)
        quotient = parts @ np.linalg.solve(phasors.covariance[0], parts) / 4.0
        inside.append(quotient < f_distribution.ppf(0.95, 4, phasors.dof[0]))
    # 1200 squares scatter by 4 %.
    assert np.mean(squares) * 300.0 * (1.0 - spikes) / 2.0 == pytest.approx(1.0, abs=0.13)
    assert 0.91 < np.mean(inside) < 0.985


@pytest.mark.parametrize("length", [1, 7, 200])
def test_sums_of_some_samples_at_a_time_give_the_least_squares_of_all(length):
    """By orthogonal decomposition, series by series; one too short and one that cannot tell the lines apart are NaN."""
    rng = np.random.default_rng(1)
    time_s, lines_hz = np.arange(200) / 53.0, np.array([8.01, 13.3])
    angle = 2.0 * np.pi * np.outer(time_s, lines_hz)
    amplitude = rng.normal(size=(2, 5, 3)) + 1j * rng.normal(size=(2, 5, 3))
    offset = 1e3 + rng.normal(size=(5, 3))
    values = offset + np.einsum("sk,knc->snc", np.exp(1j * angle), amplitude).real + 0.01 * rng.normal(size=(200, 5, 3))
    values[rng.random((200, 5)) < 0.2] = np.nan
    values[7:, 3, 1] = np.nan  # of three channels one is missing: so is the sample
    values[np.arange(200) % 53 != 0, 4] = np.nan
    sums = SineSums(time_s, lines_hz, offset + 0.1)
    for start in range(0, 200, length):
        sums.add(values[start : start + length])
    found, phasors, u = sums.solve(3)
    design = np.column_stack([np.cos(angle), -np.sin(angle), np.ones(200)])
    for series in range(3):
        complete = np.isfinite(values[:, series]).all(axis=1)
        expected, squares, *_ = np.linalg.lstsq(design[complete], values[complete, series], rcond=None)
        np.testing.assert_allclose(found[series], expected[4], rtol=1e-13)
        np.testing.assert_allclose(phasors[:, series], expected[:2] + 1j * expected[2:4], rtol=1e-10)
        spread = np.diag(np.linalg.inv(design[complete].T @ design[complete]))
        mean = np.sqrt((spread[:2] + spread[2:4])[:, None] / 2.0 * squares / (complete.sum() - 5))
        np.testing.assert_allclose(u[:, series], mean, rtol=1e-6)
        assert np.all(np.abs(phasors[:, series] - amplitude[:, series]) < 5.0 * u[:, series])
    assert np.isnan(phasors[:, 3:]).all()
    assert np.isnan(found[3:]).all()


ORDERS = np.arange(1, 200)


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("steps", [2.5, 10.0, 60.0])
def test_the_largest_change_is_that_of_the_bessel_series(steps: float, noise: float) -> None:
    """ΔA = Σ (-1)^m 2q/(πm)·J1(2πmA/q)·cos(2πm·offset/q)·exp(-2π²m²σ²/q²), the largest over offsets and a step of A."""
    from scipy.special import jv

    rng, step, time = np.random.default_rng(1), 0.3, np.arange(8000) / 2000.3
    moved, errors = [], []
    for size in steps + np.linspace(-0.5, 0.5, 17):
        series = (-1.0) ** ORDERS * 2.0 / (np.pi * ORDERS) * jv(1, 2.0 * np.pi * ORDERS * size)
        series *= np.exp(-2.0 * (np.pi * ORDERS * noise) ** 2)
        moved.append(max(abs(float(series @ np.cos(2.0 * np.pi * ORDERS * o))) for o in np.linspace(0.0, 1.0, 65)))
    for offset, phase in rng.uniform(size=(2, 2)):
        true = step * steps * np.exp(1j * phase)
        signal = (true * np.exp(2j * np.pi * 106.25 * time)).real + step * (offset + noise * rng.standard_normal(8000))
        read = step * np.rint(signal / step)
        fit = fit_sines(time, read[:, None], np.array([106.25]), ["a"], ["V"])
        (bound,) = quantisation_error(fit, 0, time, step)
        if max(moved) > 1e-3:  # of the noise, what rounding may explain counts as none
            assert 0.6 * max(moved) / steps < bound.real < (1.3 if noise == 0.0 else 4.0) * max(moved) / steps
        else:
            assert bound.real < 2e-3 / steps
        noise_u = float(fit.phasors.u_re[0, 0]) / abs(true)
        errors.append((fit.phasors.value[0, 0] / true - 1.0).real / (bound.real + 3.0 * noise_u))
    assert max(map(abs, errors)) < 1.0


@pytest.mark.parametrize("samples_per_period", [10.0, 20.0, 320.0 / 17.0])
def test_synchronous_samples_do_not_determine_the_phase(samples_per_period: float) -> None:
    """A step is taken anywhere between two samples, in every period alike."""
    rng, time = np.random.default_rng(2), np.arange(20_000) / samples_per_period
    for size, offset, phase in rng.uniform((2.0, 0.0, -3.0), (3.0, 1.0, 3.0), size=(3, 3)):
        read = np.rint(size * np.cos(2.0 * np.pi * time + phase) + offset)
        fit = fit_sines(time, read[:, None], np.array([1.0]), ["a"], ["V"])
        (bound,) = quantisation_error(fit, 0, time, 1.0)
        error = fit.phasors.value[0, 0] / (size * np.exp(1j * phase)) - 1.0
        assert abs(error.real) < 1.2 * bound.real
        assert abs(error.imag) < 1.2 * bound.imag + 1e-4
