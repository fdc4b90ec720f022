"""Sine approximation against analytic truth, the Cramér-Rao bound and coverage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import f as f_distribution

from shaker.sine.fit import fit_sines
from shaker.sine.solve import SineFit, SineModel

CAMERA_HZ = 52.874


def _series(time: np.ndarray, frequency: np.ndarray, value: np.ndarray, offset: float = 0.0) -> np.ndarray:
    """Sum of Re{X exp(jωt)} written out with cosines: amplitude and phase, not the fit's own columns."""
    total = np.full((len(time), value.shape[1]), offset)
    for k, f in enumerate(frequency):
        for c in range(value.shape[1]):
            total[:, c] += np.abs(value[k, c]) * np.cos(2 * np.pi * f * time + np.angle(value[k, c]))
    return total


def _fit(time: np.ndarray, values: np.ndarray, frequency: np.ndarray, drift: bool = False) -> SineFit:
    names = [str(i) for i in range(values.shape[1])]
    return fit_sines(time, values, frequency, names, ["m"] * len(names), model=SineModel(drift=drift))


@pytest.mark.parametrize("rate", [5000.0, CAMERA_HZ])
def test_exact_data_come_back_exactly(rate: float) -> None:
    frequency = 106.25 * np.arange(1, 4)
    rng = np.random.default_rng(0)
    value = rng.normal(size=(3, 2)) + 1j * rng.normal(size=(3, 2))
    time = 0.3 + np.arange(400) / rate
    fit = _fit(time, _series(time, frequency, value, 5.0), frequency)
    np.testing.assert_allclose(fit.phasors.value, value, atol=1e-11)
    np.testing.assert_allclose(fit.offset, 5.0, atol=1e-11)
    residual = fit.residual_of(time, _series(time, frequency, value, 5.0))
    np.testing.assert_allclose(residual, 0.0, atol=1e-11)
    np.testing.assert_allclose(fit.residual_rms, 0.0, atol=1e-11)
    np.testing.assert_allclose(fit.model(time), _series(time, frequency, value, 5.0), atol=1e-11)


def test_sign_convention_is_that_of_the_phasor() -> None:
    time = np.arange(100) / 100.0
    values = (3.0 * np.cos(2 * np.pi * 5.0 * time) + 4.0 * np.sin(2 * np.pi * 5.0 * time))[:, None]
    assert _fit(time, values, np.array([5.0])).phasors.value[0, 0] == pytest.approx(3.0 - 4.0j)


def test_drift_is_separated_from_the_lines() -> None:
    time = np.arange(211) / CAMERA_HZ
    value = np.array([[1.0 + 1.0j]])
    values = _series(time, np.array([106.25]), value) + 0.7 * (time - time.mean())[:, None]
    fit = _fit(time, values, np.array([106.25]), drift=True)
    assert fit.drift_per_s[0] == pytest.approx(0.7)
    np.testing.assert_allclose(fit.phasors.value, value, atol=1e-11)
    np.testing.assert_allclose(fit.model(time), values, atol=1e-11)


def test_missing_samples_are_dropped_and_counted() -> None:
    time = np.arange(211) / CAMERA_HZ
    value = np.array([[1.0 + 1.0j, 2.0j]])
    values = _series(time, np.array([106.25]), value)
    values[7, 1] = np.nan
    fit = _fit(time, values, np.array([106.25]))
    np.testing.assert_allclose(fit.phasors.value, value, atol=1e-11)
    residual = fit.residual_of(time, values)
    assert np.isnan(residual[7]).all()
    assert np.isfinite(np.delete(residual, 7, axis=0)).all()
    assert fit.notices[0].text == "1 of 211 samples are missing"


@settings(max_examples=25, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(0.01, 100.0), st.permutations([0, 1, 2]), st.integers(0, 1000))
def test_time_shift_scale_and_channel_order(shift: float, scale: float, order: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    frequency = np.array([106.25, 212.5])
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


def _trials(rate: float, samples: int, lines: int, trials: int, seed: int) -> tuple[float, float, np.ndarray]:
    """Return pooled variance over the Cramér-Rao bound, coverage of the 95 % region, and bias over its deviation."""
    rng = np.random.default_rng(seed)
    frequency = 106.25 * np.arange(1, lines + 1)
    time = np.arange(samples) / rate
    sigma = np.array([0.1, 2.0])
    error, covered = [], []
    for _ in range(trials):
        value = rng.normal(size=(lines, 2)) + 1j * rng.normal(size=(lines, 2))
        values = _series(time, frequency, value) + sigma * rng.normal(size=(samples, 2))
        phasors = _fit(time, values, frequency).phasors
        delta = phasors.value - value
        error.append(delta / sigma)
        for k in range(lines):
            for c in range(2):
                pick = np.ix_([c, c + 2], [c, c + 2])
                d = np.array([delta[k, c].real, delta[k, c].imag])
                q = d @ np.linalg.solve(phasors.covariance[k][pick], d) / 2.0
                covered.append((q, phasors.dof[k]))
    quotient, dof = np.array(covered).T
    e = np.array(error)
    # The bound for one quadrature of a sine of known frequency in white noise: 2 σ²/N.
    ratio = float(np.mean(e.real**2 + e.imag**2) / 2.0 / (2.0 / samples))
    bias = e.mean(axis=0) / (e.std(axis=0) / np.sqrt(trials))
    return (
        ratio,
        float(np.mean(quotient < f_distribution.ppf(0.95, 2, dof))),
        np.abs(np.concatenate([bias.real, bias.imag])),
    )


@pytest.mark.parametrize(
    ("rate", "samples", "lines"),
    [
        pytest.param(4250.0, 400, 1, marks=pytest.mark.slow),
        (4250.0, 400, 5),
        (CAMERA_HZ, 211, 2),
        pytest.param(0.05 * 106.25 * 1.0173, 240, 1, marks=pytest.mark.slow),
    ],
)
def test_variance_reaches_the_bound_and_regions_cover(rate: float, samples: int, lines: int) -> None:
    trials = 1000 // lines
    ratio, coverage, bias = _trials(rate, samples, lines, trials, seed=3)
    # 2·2·lines·trials values: the ratio scatters by 0.02, the coverage by 0.5 %; near-zero aliases are overstated.
    assert 0.92 < ratio < 1.08
    assert 0.935 < coverage < 0.985
    assert bias.max() < 4.5


def test_stated_covariance_crosses_channels() -> None:
    rng = np.random.default_rng(9)
    time, frequency = np.arange(500) / 1000.0, np.array([106.0])
    mix = np.array([[1.0, 0.0], [0.8, 0.6]])
    values, stated = [], []
    for _ in range(400):
        fit = _fit(time, rng.normal(size=(500, 2)) @ mix.T, frequency)
        values.append(fit.phasors.value[0])
        stated.append(fit.phasors.covariance[0])
    v = np.array(values)
    measured = np.cov(np.concatenate([v.real, v.imag], axis=1).T)
    np.testing.assert_allclose(np.mean(stated, axis=0), measured, atol=0.15 * measured.max())


def test_twelve_channels_of_a_long_record() -> None:
    rng = np.random.default_rng(12)
    time, frequency = np.arange(200_000) / 51_200.0, 106.25 * np.arange(1, 7)
    values = rng.normal(size=(200_000, 12))
    fit = _fit(time, values, frequency)
    np.testing.assert_allclose(fit.phasors.u_re, np.sqrt(2.0 / 200_000), rtol=0.5)
    assert fit.condition < 1.01


def test_folded_lines_are_refused_with_the_remedy() -> None:
    time = np.arange(300) / 200.0
    with pytest.raises(ValueError, match=r"frequency_hz: .*drop those that usable_lines names"):
        _fit(time, np.ones((300, 1)), np.array([100.0]))
    with pytest.raises(ValueError, match="time_s: expected more than 3 complete samples, found 3"):
        _fit(time[:3], np.ones((3, 1)), np.array([30.0]))
    with pytest.raises(ValueError, match="unit: expected 1 units"):
        fit_sines(time, np.ones((300, 1)), np.array([30.0]), ["a"], [])
