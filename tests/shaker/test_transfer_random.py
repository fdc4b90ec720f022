"""Transfer functions of noise: scipy's averages, the uncertainty's coverage, the right estimator for the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oscillator_factory import F0_HZ, ZETA, deviations, random_pair, record, transmissibility
from scipy.signal import coherence, csd, get_window, welch
from scipy.stats import chi2
from scipy.stats import f as fisher

from shaker.frf.random import transfer_random
from shaker.frf.result import Estimator, TransferFunction
from shaker.identification.measured import MeasuredCurve
from shaker.identification.oscillator import fit_resonance

RATE = 6400.0
SAMPLES = 20 * 6400
BAND = (1000.0, 2000.0)
PAIR = random_pair(SAMPLES, RATE, 1)


def relative(found: TransferFunction) -> float:
    """Mean error of H over H between the half-power points, real part."""
    near = np.abs(found.ratio.frequency_hz - F0_HZ) < 11.0
    truth = transmissibility(found.ratio.frequency_hz[near])
    return float(np.mean((found.ratio.value[near, 0] / truth - 1.0).real))


@pytest.mark.parametrize("estimator", ["H1", "H2"])
def test_the_averages_are_those_of_scipy(estimator: Estimator) -> None:
    data = record(*PAIR, RATE, 0.1)
    found = transfer_random(data, 2.0, estimator="H1" if estimator == "H1" else "H2", band_hz=BAND)
    length = 3200
    x, y = data.reference - data.reference.mean(), data.responses[:, 0] - data.responses[:, 0].mean()
    how = {"fs": RATE, "window": "hann", "nperseg": length, "noverlap": length - length // 3, "detrend": False}
    frequency, cross = csd(x, y, **how)
    kept = (frequency >= BAND[0]) & (frequency <= BAND[1])
    expected = cross / welch(x, **how)[1] if estimator == "H1" else welch(y, **how)[1] / cross.conj()
    np.testing.assert_allclose(found.ratio.frequency_hz, frequency[kept], rtol=1e-12)
    np.testing.assert_allclose(found.ratio.value[:, 0], expected[kept], rtol=1e-9)
    np.testing.assert_allclose(found.coherence[:, 0], coherence(x, y, **how)[1][kept], rtol=1e-9)
    assert found.estimator == estimator


def test_local_polynomials_are_free_of_leakage() -> None:
    # 22.4 Hz between the half-power points; a Hann segment lowers the peak by H''/6 of a line's square.
    truth = transmissibility(np.arange(1400.0, 1556.0, 2.0))
    local, hann = (
        transfer_random(record(*PAIR, RATE), 2.0, estimator=e, band_hz=(1399.0, 1555.0)) for e in ("local", "H1")
    )
    errors = [np.max(np.abs(found.ratio.value[:, 0] - truth)) / np.abs(truth).max() for found in (local, hann)]
    assert errors[0] < 1e-3
    assert errors[0] < 0.1 * errors[1]


def test_local_polynomials_have_a_resonance_within_its_uncertainty() -> None:
    """Damping and frequency of 12 records at 20 dB, by the spread of (estimate - truth)/u."""
    quotient = []
    for seed in range(12):
        data = record(*random_pair(SAMPLES, RATE, 60 + seed), RATE, 0.1, seed)
        fit = fit_resonance(MeasuredCurve.of(transfer_random(data, 4.0, band_hz=BAND), "top", BAND), "transmissibility")
        quotient.append((fit.frequency_hz - F0_HZ) / fit.u("frequency_hz"))
        quotient.append((fit.damping_ratio - ZETA) / fit.u("damping_ratio"))
    assert float(np.mean(np.square(quotient))) < chi2.ppf(0.999, 24) / 24.0
    assert float(np.mean(np.square(quotient))) > chi2.ppf(0.001, 24) / 24.0


def test_errors_of_local_lines_correlate_as_stated() -> None:
    rng = np.random.default_rng(12)
    x, noise = rng.standard_normal(SAMPLES), rng.standard_normal(SAMPLES)
    found = transfer_random(record(x, x + 0.1 * noise, RATE), 2.0, estimator="local", band_hz=(200.0, 3000.0))
    error = found.ratio.value[:, 0] - found.ratio.value.mean()
    power = np.mean(np.abs(error) ** 2)
    assert power == pytest.approx(2.0 * np.mean(found.ratio.u_re**2), rel=0.1)
    for apart, stated in enumerate(found.line_correlation[1:4], start=1):
        assert np.mean(error[apart:] * error[:-apart].conj()).real / power == pytest.approx(stated.real, abs=0.08)


def test_a_record_too_short_for_polynomials_is_cut_into_segments() -> None:
    data = record(*PAIR, RATE)
    assert transfer_random(data, 0.25, band_hz=BAND).estimator == "H1"
    with pytest.raises(ValueError, match="local polynomials"):
        transfer_random(data, 0.25, estimator="local", band_hz=BAND)


def test_overlapping_segments_are_worth_what_welch_says() -> None:
    # Welch 1967: 1 + 2 Σ (1 - d/n) ρ_d², ρ_d = Σ w(n)·w(n + d·hop) / Σ w².
    window, hop = get_window("hann", 3200), 3200 // 3
    found = transfer_random(record(*PAIR, RATE), 2.0, estimator="H1", band_hz=BAND)
    segments = (SAMPLES - 3200) // hop + 1
    rho = [float(window[d * hop :] @ window[: 3200 - d * hop] / (window @ window)) for d in (1, 2, 3)]
    worth = 1.0 + 2.0 * sum((1.0 - d / segments) * r**2 for d, r in enumerate(rho, start=1))
    assert found.averages[0] == pytest.approx(segments / worth, rel=1e-9)
    # Neighbouring lines of one Hann segment correlate by 2/3 and 1/6; squared in a cross spectrum.
    np.testing.assert_allclose(found.line_correlation[:3].real, [1.0, 4 / 9, 1 / 36], atol=0.06)


def test_regions_of_95_percent_cover() -> None:
    inside = []
    for seed in range(8):
        pair = random_pair(SAMPLES, RATE, 10 + seed)
        found = transfer_random(record(*pair, RATE, 0.05, seed), 2.0, band_hz=BAND)
        error = found.ratio.value[:, 0] - transmissibility(found.ratio.frequency_hz)
        inside.append(deviations(error, found.channel_covariance("top")) < fisher.ppf(0.95, 2, found.ratio.dof))
    # 8 × 501 lines, neighbours correlated: standard deviation of the share about 0.5 %.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_scatter_of_an_average_is_that_of_its_covariance() -> None:
    """The covariance of the mean of many lines needs their correlation: 1 + 2·(4/9 + 1/36) in variance."""
    quotient = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x, noise = rng.standard_normal(SAMPLES), rng.standard_normal(SAMPLES)
        found = transfer_random(record(x, x + 0.5 * noise, RATE), 8.0, estimator="H1", band_hz=BAND)
        inflation = 2.0 * np.sum(found.line_correlation.real) - 1.0
        u = np.sqrt(np.mean(found.ratio.u_re**2) * inflation / len(found.ratio.value))
        quotient.append((found.ratio.value.real.mean() - 1.0) / u)
    assert np.std(quotient) == pytest.approx(1.0, abs=0.45)


@pytest.mark.parametrize(("on_base", "on_top", "expected"), [(0.0, 0.05, "H1"), (0.2, 0.0, "H2"), (0.2, 0.1, "Hv")])
def test_the_estimator_follows_the_noise(on_base: float, on_top: float, expected: str) -> None:
    rng = np.random.default_rng(4)
    base = PAIR[0] + on_base * PAIR[0].std() * rng.standard_normal(SAMPLES)
    top = PAIR[1] + on_top * PAIR[1].std() * rng.standard_normal(SAMPLES)
    found = transfer_random(record(base, top, RATE), 2.0, band_hz=(200.0, 2000.0))
    assert found.estimator == "local"
    assert found.notices[0].text.startswith(f"{expected} of local polynomials")
    # H1 reads N_x/S_xx low.
    assert abs(relative(found)) < 0.01
    everywhere = transfer_random(record(base, top, RATE), 2.0)
    assert everywhere.notices[0].text.startswith(expected)
    biased = transfer_random(record(base, top, RATE), 2.0, estimator="H1", band_hz=(200.0, 2000.0))
    assert on_base == 0.0 or relative(biased) < -0.01


def test_hv_with_the_ratio_known_lies_between_h1_and_h2() -> None:
    data = record(*PAIR, RATE, 0.2)
    ratio = (PAIR[1].std() / PAIR[0].std()) ** 2
    low, middle, high = (
        np.abs(transfer_random(data, 2.0, estimator=e, noise_ratio=ratio, band_hz=BAND).ratio.value)
        for e in ("H1", "Hv", "H2")
    )
    assert np.all((low < middle) & (middle < high))


def test_a_peak_too_narrow_for_the_lines_is_told() -> None:
    # 22.4 Hz between the half-power points.
    fine = transfer_random(record(*PAIR, RATE), 2.0, estimator="H1", band_hz=BAND)
    coarse = transfer_random(record(*PAIR, RATE), 8.0, estimator="H1", band_hz=BAND)
    assert not [n for n in fine.notices if n.severity == "warning"]
    told = [n.text for n in coarse.notices if n.severity == "warning"]
    assert len(told) == 1
    assert "leakage" in told[0]
    peaks = [np.abs(found.ratio.value).max() for found in (fine, coarse)]
    assert peaks[1] < 0.99 * peaks[0]


def test_the_bias_of_coherence_is_that_of_unrelated_channels() -> None:
    rng = np.random.default_rng(8)
    data = record(rng.standard_normal(SAMPLES), rng.standard_normal(SAMPLES), RATE)
    found = transfer_random(data, 16.0, estimator="H1")
    assert np.mean(found.coherence) == pytest.approx(1.0 / found.averages[0], rel=0.15)
    assert np.mean(found.coherence_bias) == pytest.approx(np.mean(found.coherence), rel=0.15)


@settings(max_examples=8, deadline=None)
@given(gain=st.floats(0.01, 100.0), other=st.floats(-50.0, -0.1), estimator=st.sampled_from(["auto", "H1", "H2"]))
def test_scales_move_the_ratio(gain: float, other: float, estimator: str) -> None:
    data = record(*PAIR, RATE, 0.05)
    scaled = replace(data, reference=data.reference * gain, responses=data.responses * other)
    one, two = (transfer_random(d, 8.0, estimator=estimator, band_hz=BAND) for d in (data, scaled))  # type: ignore[arg-type]
    np.testing.assert_allclose(two.ratio.value, one.ratio.value * (other / gain), rtol=1e-6)
    np.testing.assert_allclose(two.ratio.u_re, one.ratio.u_re * abs(other / gain), rtol=1e-5)
    np.testing.assert_allclose(two.coherence, one.coherence, rtol=1e-9)


def test_what_cannot_be_estimated_is_refused_with_a_reason() -> None:
    data = record(*PAIR, RATE)
    with pytest.raises(ValueError, match="two segments or more"):
        transfer_random(data, 0.06)
    with pytest.raises(ValueError, match="resolution_hz"):
        transfer_random(data, 0.0)
    with pytest.raises(ValueError, match="band_hz"):
        transfer_random(data, 10.0, band_hz=(5000.0, 6000.0))
    with pytest.raises(ValueError, match="noise_ratio"):
        transfer_random(data, 10.0, noise_ratio=-1.0)
