"""Unknown frequencies and decay rates: IEEE 1057, Fisher information, closed forms, invariants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import curve_fit
from scipy.stats import f as f_distribution

from shaker.sine.fit import fit_sines
from shaker.sine.solve import SineFit, SineModel

CAMERA_HZ = 52.874
FREE = SineModel(free=(0,))


def _fit(time: np.ndarray, values: np.ndarray, frequency: np.ndarray, model: SineModel, **options: object) -> SineFit:
    names = [str(c) for c in range(values.shape[1])]
    return fit_sines(time, values, frequency, names, names, model=model, **options)  # type: ignore[arg-type]


def _damped(time: np.ndarray, frequency: np.ndarray, value: np.ndarray, decay: np.ndarray) -> np.ndarray:
    total = np.zeros((len(time), value.shape[1]))
    for k, f in enumerate(frequency):
        angle = 2 * np.pi * f * time[:, None] + np.angle(value[k])
        total += np.abs(value[k]) * np.exp(-decay[k] * time)[:, None] * np.cos(angle)
    return total


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
def test_four_parameters_are_those_of_ieee_1057(rate: float, samples: int) -> None:
    rng = np.random.default_rng(0)
    time = 0.4 + np.arange(samples) / rate
    y = 2.0 * np.cos(2 * np.pi * 106.25 * time + 0.7) + 0.2 * rng.normal(size=samples) + 3.0
    fit = _fit(time, y[:, None], np.array([106.25 + 0.1 * rate / samples]), FREE)
    frequency, value = ieee_1057(time, y, 106.25 + 0.1 * rate / samples)
    assert fit.phasors.frequency_hz[0] == pytest.approx(frequency, rel=1e-9)
    assert fit.phasors.value[0, 0] == pytest.approx(value, rel=1e-6)


def test_exact_frequencies_and_decays_come_back() -> None:
    time = np.arange(1500) / 1000.0
    frequency, decay = np.array([53.7, 106.25, 170.1]), np.array([0.5, 2.0, 0.0])
    value = np.array([[1.0 + 1.0j, 2.0], [0.3j, -1.0], [0.5, 0.1j]])
    model = SineModel(drift=True, free=(0, 1, 1), decay="each")
    data = _damped(time, frequency, value, decay) + 4.0 - 0.3 * time[:, None]
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
def test_stated_covariance_is_the_inverse_fisher_information(start: float, decay: bool) -> None:
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


def test_frequency_bound_in_closed_form() -> None:
    # Rife and Boorstyn 1974: var f = 6 σ² / (π² a² T² S); phase in the middle of the record 2 σ² / (a² S).
    samples, rate, sigma = 20_000, 5000.0, 0.3
    time = (np.arange(samples) - (samples - 1) / 2) / rate
    y = 2.0 * np.cos(2 * np.pi * 106.25 * time) + sigma * np.random.default_rng(2).normal(size=samples)
    known = _fit(time, y[:, None], np.array([106.25]), SineModel())
    free = _fit(time, y[:, None], np.array([106.25]), FREE)
    # Time zero is the middle here: not knowing the frequency costs nothing.
    np.testing.assert_allclose(free.phasors.covariance, known.phasors.covariance, rtol=0.01, atol=1e-9)
    expected = np.sqrt(6.0 / (np.pi**2 * 4.0 * samples)) * rate / samples
    noise = np.sqrt(known.phasors.covariance[0, 0, 0] * samples / 2.0)
    assert free.u_frequency_hz[0] == pytest.approx(expected * noise, rel=1e-2)


def test_agrees_with_curve_fit() -> None:
    rng = np.random.default_rng(3)
    time = np.arange(800) / 1000.0

    def curve(t: np.ndarray, a: float, b: float, f: float, d: float, c: float) -> np.ndarray:
        return np.asarray(np.exp(-d * t) * (a * np.cos(2 * np.pi * f * t) + b * np.sin(2 * np.pi * f * t)) + c)

    y = curve(time, 1.0, 0.5, 60.2, 1.5, 0.1) + 0.02 * rng.normal(size=800)
    found, _ = curve_fit(curve, time, y, [1.0, 0.4, 60.2, 1.0, 0.0], xtol=1e-14, ftol=1e-14)
    fit = _fit(time, y[:, None], np.array([60.1]), SineModel(free=(0,), decay="common"))
    np.testing.assert_allclose(fit.phasors.value[0, 0], found[0] - 1j * found[1], rtol=1e-6)
    assert fit.phasors.frequency_hz[0] == pytest.approx(found[2], rel=1e-9)
    assert fit.decay_per_s[0] == pytest.approx(found[3], rel=1e-6)
    assert fit.offset[0] == pytest.approx(found[4], abs=1e-8)


def test_known_lines_stay_and_lines_of_a_label_move_together() -> None:
    time = np.arange(2000) / 1000.0
    true = np.array([50.0, 100.1, 200.2])
    data = _damped(time, true, np.ones((3, 1), dtype=complex), np.zeros(3))
    fit = _fit(time, data, np.array([50.0, 100.0, 200.0]), SineModel(free=(-1, 4, 4)))
    np.testing.assert_allclose(fit.phasors.frequency_hz, true, rtol=1e-9)
    assert fit.u_frequency_hz[0] == 0.0
    assert fit.phasors.frequency_hz[0] == 50.0


def test_channels_weigh_by_their_noise() -> None:
    # A channel of the same amplitude and a hundred times the noise must not spoil the frequency of the quiet one.
    rng = np.random.default_rng(4)
    time = np.arange(500) / 1000.0
    wave = np.cos(2 * np.pi * 80.0 * time)
    data = np.stack([wave + 1e-3 * rng.normal(size=500), wave + 0.1 * rng.normal(size=500)], axis=1)
    alone, both = (_fit(time, part, np.array([80.02]), FREE) for part in (data[:, :1], data))
    shift = abs(both.phasors.frequency_hz[0] - alone.phasors.frequency_hz[0])
    assert shift < 0.1 * alone.u_frequency_hz[0]
    assert both.u_frequency_hz[0] == pytest.approx(alone.u_frequency_hz[0], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [1000.0, CAMERA_HZ])
def test_common_frequency_covers_with_correlated_channels(rate: float) -> None:
    rng = np.random.default_rng(5)
    time, frequency, mix = np.arange(300) / rate, 106.25, np.array([[1.0, 0.0], [0.9, 0.5]])
    value = np.array([[1.0 + 0.5j, 0.4j]])
    clean = _damped(time, np.array([frequency]), value, np.zeros(1))
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
def test_time_shift_scale_and_clock(shift: float, scale: float, clock: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.arange(300) / 1000.0
    data = np.cos(2 * np.pi * 80.0 * time)[:, None] * np.array([1.0, 0.3]) + 0.05 * rng.normal(size=(300, 2))
    model = SineModel(free=(0,), decay="common")
    plain = _fit(time, data, np.array([80.1]), model)
    moved = _fit((time + shift) * clock, scale * data[:, ::-1], np.array([80.1]) / clock, model)
    frequency, decay = plain.phasors.frequency_hz, plain.decay_per_s
    np.testing.assert_allclose(moved.phasors.frequency_hz * clock, frequency, rtol=1e-7)
    np.testing.assert_allclose(moved.decay_per_s * clock, decay, atol=1e-4)
    turned = scale * plain.phasors.value[:, ::-1] * np.exp((decay - 2j * np.pi * frequency) * shift)[:, None]
    np.testing.assert_allclose(moved.phasors.value, turned, rtol=1e-3)
    np.testing.assert_allclose(moved.u_frequency_hz * clock, plain.u_frequency_hz, rtol=1e-3)


def test_frequency_far_off_is_refused() -> None:
    time = np.arange(300) / 1000.0
    with pytest.raises(ValueError, match="free: expected 1 labels, one per line, found 2"):
        _fit(time, np.ones((300, 1)), np.array([80.0]), SineModel(free=(0, 1)))
    with pytest.raises(ValueError, match="frequency_hz: expected lines whose frequencies and decays the record tells"):
        _fit(time, np.zeros((300, 1)), np.array([80.0]), FREE)
