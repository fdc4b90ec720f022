"""Transfer functions of blows, periodic excitation and noise: exact without noise, covered with it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import coherence, csd, get_window, welch
from scipy.stats import chi2
from scipy.stats import f as fisher

from shaker.frf.impact import transfer_impact
from shaker.frf.periodic import transfer_periodic
from shaker.frf.random import transfer_random
from shaker.frf.result import TransferFunction, TransferRecord, pooled_scatter
from shaker.identification.measured_curves import MeasuredCurve
from shaker.identification.oscillator import fit_resonance
from shaker.io import read_channels
from shaker.signal_notices import (
    ESTIMATOR_H1,
    ESTIMATOR_H2,
    ESTIMATOR_HV,
    EXCITATION_AMPLITUDE_CHANGES,
    EXPONENTIAL_WINDOW,
    HIT_OVERLOADED,
    HIT_REPEATED,
    HIT_WITHOUT_WINDOW,
    NARROW_PEAKS,
    NONLINEAR_DISTORTIONS,
    NOT_SETTLED,
    RESPONSE_DRIFTS,
    SINGLE_HIT,
    SINGLE_HIT_WITHOUT_NOISE,
)
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

F0_HZ, Q = 1477.35, 66.0
ZETA = 0.5 / Q


def transmissibility(frequency_hz: FloatArray) -> ComplexArray:
    """Motion of the mass over that of its base."""
    r = np.asarray(frequency_hz) / F0_HZ
    return np.asarray((1.0 + 2j * ZETA * r) / (1.0 - r**2 + 2j * ZETA * r))


def accelerance(s: ComplexArray) -> ComplexArray:
    """Acceleration over force at s = a + jω, stiffness 1e8 N/m."""
    p = s / (2.0 * np.pi * F0_HZ)
    return np.asarray(1e-8 * s**2 / (1.0 + 2.0 * ZETA * p + p * p))


def periodic(harmonic: FloatArray, phasor: ComplexArray, period: float, samples: int) -> FloatArray:
    """Samples of Σ Re{X exp(2πjkn/P)}, X (K,) or (K, C), P any number of samples, by direct summation."""
    if period == round(period) < samples:
        once = periodic(harmonic, phasor, period, round(period))
        return np.resize(once, (samples, *phasor.shape[1:]))
    signal = np.zeros((samples, *phasor.shape[1:]))
    for start in range(0, samples, 2048):
        n = np.arange(start, min(samples, start + 2048))
        signal[n] = (np.exp(2j * np.pi / period * np.multiply.outer(n, harmonic)) @ phasor).real
    return signal


def record(
    reference: FloatArray, response: FloatArray, rate_hz: float, noise: float = 0.0, seed: int = 0
) -> TransferRecord:
    """Reference and one response, both with white noise of a share of their rms."""
    rng = np.random.default_rng(seed)
    noisy = [signal + noise * signal.std() * rng.standard_normal(len(signal)) for signal in (reference, response)]
    return TransferRecord(noisy[0], noisy[1][:, None], rate_hz, "base", "m/s^2", ("top",), ("m/s^2",))


def warned(found: TransferFunction) -> list[Notice]:
    """Return the warnings."""
    return [notice for notice in found.notices if notice.severity == "warning"]


def codes(found: TransferFunction) -> list[str]:
    """Return the codes of all notices."""
    return [notice.code for notice in found.notices]


def error(found: TransferFunction) -> ComplexArray:
    """What the ratio is off by: of accelerance for blows, else of transmissibility."""
    if found.reference == "hammer":
        return found.ratio.value[:, 0] - accelerance(found.added_decay_per_s + 2j * np.pi * found.ratio.frequency_hz)
    return found.ratio.value[:, 0] - transmissibility(found.ratio.frequency_hz)


def deviations(found: TransferFunction) -> FloatArray:
    """Half the squared Mahalanobis length of the errors (K,): distributed as F(2, dof)."""
    both = np.stack([error(found).real, error(found).imag], axis=1)
    return np.asarray(np.einsum("ki,kij,kj->k", both, np.linalg.inv(found.channel_covariance("top")), both) / 2.0)


def inside(found: TransferFunction) -> NDArray[np.bool_]:
    """Which lines the 95 % regions cover."""
    return np.asarray(deviations(found) < fisher.ppf(0.95, 2, found.ratio.dof))


def random_pair(samples: int, rate_hz: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Base and mass in noise from 50 Hz to a third of the rate: a piece of a periodic record three times as long."""
    rng = np.random.default_rng(seed)
    frequency = np.asarray(np.fft.rfftfreq(3 * samples, 1.0 / rate_hz), dtype=np.float64)
    spectrum = rng.standard_normal(len(frequency)) + 1j * rng.standard_normal(len(frequency))
    spectrum *= np.sqrt(samples) * ((frequency > 50.0) & (frequency < rate_hz / 3.0))
    pair = [
        np.fft.irfft(part, 3 * samples)[samples : 2 * samples]
        for part in (spectrum, spectrum * transmissibility(frequency))
    ]
    return pair[0], pair[1]


def blow(
    samples: int, rate_hz: float, before: int, height_n: float, width_s: float = 8e-5
) -> tuple[FloatArray, FloatArray]:
    """A Gaussian blow and the acceleration after it, the record long enough for it to die away."""
    time = (np.arange(samples) - before) / rate_hz
    force = height_n * np.exp(-0.5 * (time / width_s - 3.5) ** 2)
    s = np.asarray(2j * np.pi * np.fft.rfftfreq(samples, 1.0 / rate_hz), dtype=np.complex128)
    return force, np.fft.irfft(np.fft.rfft(force) * accelerance(s), samples)


RATE = 25600.0
BAND = (500.0, 2500.0)


def blows(count: int, noise: float = 0.0, seed: int = 0) -> TransferRecord:
    """Blows half a second apart, of different height and width, noise a share of the largest force and response."""
    rng = np.random.default_rng(seed)
    pairs = [blow(12800, RATE, 2560, 100 * rng.uniform(0.6, 1.2), 8e-5 * rng.uniform(0.9, 1.2)) for _ in range(count)]
    force, response = (np.concatenate(part) for part in zip(*pairs, strict=True))
    force += noise * 100.0 * rng.standard_normal(len(force))
    response += noise * np.abs(response).max() * rng.standard_normal(len(force))
    return TransferRecord(force, response[:, None], RATE, "hammer", "N", ("top",), ("m/s^2",))


@pytest.mark.parametrize(("window_s", "decay"), [(0.38, 0.0), (0.1, 120.0), (0.05, 300.0)])
def test_an_exponential_window_moves_the_transfer_function_to_another_s_and_no_more(window_s, decay):
    found = transfer_impact(blows(2), window_s, pretrigger_s=0.002, added_decay_per_s=decay, band_hz=BAND)
    assert np.max(np.abs(error(found))) < 2e-4 * np.max(np.abs(found.ratio.value))
    # Without the window taken off, damping would read a/ω₀ too high.
    fit = fit_resonance(MeasuredCurve.of(found, "top", BAND), "accelerance")
    assert (fit.frequency_hz, fit.damping_ratio) == (pytest.approx(F0_HZ, rel=1e-5), pytest.approx(ZETA, rel=1e-3))


def test_a_window_is_taken_only_where_the_response_outlasts_it():
    assert transfer_impact(blows(3, 1e-3), 0.38).added_decay_per_s == 0.0
    short = transfer_impact(blows(3, 1e-3), 0.05)
    # Decay of the oscillator: 70.3/s.
    assert 50.0 < short.added_decay_per_s < 250.0
    assert EXPONENTIAL_WINDOW.code in codes(short)


@pytest.mark.parametrize(("hits", "tolerance"), [(5, 0.025), (1, 0.03)])
def test_regions_of_95_percent_cover(hits, tolerance):
    """A single hit has the uncertainty of the noise before it."""
    covered = [inside(transfer_impact(blows(hits, 1e-3, seed), 0.3, band_hz=BAND)) for seed in range(5)]
    assert np.mean(covered) == pytest.approx(0.95, abs=tolerance)


@pytest.mark.slow
def test_noise_of_the_force_common_to_all_lines_of_a_hit_counts_once():
    """On resonance the force's noise rules, of which five hits tell 2·(5 - 1) degrees of freedom and no more."""
    covered = []
    for seed in range(24):
        found = transfer_impact(blows(5, 1e-3, 40 + seed), 0.3, band_hz=BAND)
        near = np.abs(found.ratio.frequency_hz - F0_HZ) < 5.0
        assert np.max(found.ratio.dof[near]) < 0.6 * np.median(found.ratio.dof)
        covered.append(np.mean(inside(found)[near]))
    # Lines of one record share that noise: 24 independent trials, standard deviation of the share 4.5 %.
    assert np.mean(covered) > 0.95 - 3.0 * 0.045


def test_a_single_blow_needs_the_noise_before_it():
    assert SINGLE_HIT.code in codes(transfer_impact(blows(1, 1e-3), 0.3, band_hz=BAND))
    blind = transfer_impact(blows(1, 1e-3), 0.3, pretrigger_s=0.0, band_hz=BAND)
    assert np.isnan(blind.ratio.covariance).all()
    assert SINGLE_HIT_WITHOUT_NOISE.code in codes(blind)


def test_double_hits_overloads_and_cut_windows_do_not_count():
    data = blows(5, 1e-3)
    force = data.reference.copy()
    force[12800 + 2560 + 700 : 12800 + 2560 + 720] += 20.0
    found = transfer_impact(replace(data, reference=force), 0.39, band_hz=BAND)
    (notice,) = warned(found)
    assert (notice.code, notice.values["number"]) == (HIT_REPEATED.code, 2)
    assert found.averages[0] == 4.0
    clipped = replace(data, responses=np.minimum(data.responses, 0.7 * data.responses.max()))
    few = transfer_impact(clipped, 0.39, band_hz=BAND)
    assert HIT_OVERLOADED.code in codes(few)
    assert few.averages[0] < 5.0
    assert HIT_WITHOUT_WINDOW.code in codes(transfer_impact(data, 0.45, band_hz=BAND))


def test_records_without_hits_are_refused():
    noise = np.random.default_rng(2).standard_normal(20000)
    quiet = TransferRecord(noise, noise[:, None], RATE, "hammer", "N", ("top",), ("m/s^2",))
    refused("^reference: .*hammer", transfer_impact, quiet, 0.1)
    refused("^record: .*Hit 1 ", transfer_impact, blows(1), 0.45)
    refused("duration_s", transfer_impact, blows(1), 0.001)


def beam(data_dir: Path, name: str) -> TransferRecord:
    """Hammer and accelerometer of the tutorial's beam; labels of units are the files' own."""
    channels = read_channels(data_dir / "undersampled_video" / name)
    force, acceleration = channels["Force (Trigger)"], channels["Acceleration (Trigger)"]
    samples = acceleration.samples[:, None] * 9.80665
    return TransferRecord(force.samples, samples, force.sample_rate_hz, "force", "N", ("acceleration",), ("m/s^2",))


def test_the_modes_of_a_real_beam(data_dir):
    found = transfer_impact(beam(data_dir, "acceleration.lvm"), 0.999, pretrigger_s=5e-4)
    for low, high, literature, within in (
        (10.0, 30.0, 18.0, 0.5),
        (650.0, 740.0, 695.6, 0.3),
        (1800.0, 2000.0, 1897.9, 0.3),
    ):
        fit = fit_resonance(MeasuredCurve.of(found, "acceleration", (low, high)), "accelerance", residual_terms=True)
        assert fit.frequency_hz == pytest.approx(literature, abs=within)
    assert found.added_decay_per_s > 0.0
    refused("^record: .*overloaded", transfer_impact, beam(data_dir, "camera.lvm"), 0.999, pretrigger_s=5e-4)


PERIODIC_HZ, LENGTH = 12800.0, 4096
PERIOD_S = LENGTH / PERIODIC_HZ


@cache
def clean_pair(period: float, periods: float) -> tuple[FloatArray, FloatArray]:
    """Harmonics of one size between 200 and 3000 Hz, quadratic phases (Schroeder 1970): of the base, of the top."""
    first, last = (int(edge * period / PERIODIC_HZ) for edge in (200.0, 3000.0))
    harmonic, count = np.arange(first + 1.0, last + 1.0), last - first
    phasor = np.sqrt(2.0 / count) * np.exp(-1j * np.pi * (harmonic - harmonic[0]) ** 2 / count)
    samples = int(periods * LENGTH)
    both = np.column_stack([phasor, phasor * transmissibility(harmonic * PERIODIC_HZ / period)])
    base, top = periodic(harmonic, both, period, samples).T
    return base, top


def chirp_record(period: float, periods: float = 4.0, noise: float = 0.0, seed: int = 0) -> TransferRecord:
    return record(*clean_pair(period, periods), PERIODIC_HZ, noise, seed)


@pytest.mark.parametrize(("period", "exact"), [(4096.0, 1e-9), (4096.0 * (1 + 20e-6), 1e-5), (4093.2, 1e-5)])
def test_a_chirp_without_noise_gives_the_transfer_function_whatever_its_period(period, exact):
    found = transfer_periodic(chirp_record(period, 4.1), PERIOD_S)
    truth = transmissibility(found.ratio.frequency_hz)
    assert (found.ratio.frequency_hz[0], found.ratio.frequency_hz[-1]) == pytest.approx((200.0, 3000.0), abs=4.0)
    assert found.line_spacing_hz == pytest.approx(PERIODIC_HZ / period, rel=1e-9)
    assert np.max(np.abs(found.ratio.value[:, 0] / truth - 1.0)) < exact


@pytest.mark.parametrize("period", [4096.0, 4096.0 * (1 + 20e-6)])
def test_regions_of_95_percent_cover_every_line_as_often(period):
    records = [chirp_record(period, 4.0, 1e-2, seed) for seed in range(4)]
    found = [transfer_periodic(data, PERIOD_S) for data in records]
    # Some 900 lines a record, noise pooled over nine: the share's standard deviation is about 0.4 %.
    assert np.mean([inside(one) for one in found]) == pytest.approx(0.95, abs=0.015)
    assert np.mean([deviations(one) for one in found]) == pytest.approx(1.04, abs=0.08)


def test_noise_on_the_reference_does_not_bias_the_ratio():
    close = []
    for seed in range(10):
        found = transfer_periodic(chirp_record(4096.0, 4.0, 0.1, seed), PERIOD_S)
        near = np.abs(found.ratio.frequency_hz - F0_HZ) < 12.0
        relative = error(found)[near] / transmissibility(found.ratio.frequency_hz[near])
        close.append(np.mean(relative) / np.sqrt(np.mean(found.ratio.u_re[near] ** 2) / np.count_nonzero(near)))
    # H1 would read low by N_x/S_xx, here half a per cent.
    assert abs(np.mean(close)) < 3.0


def test_a_line_with_mains_keeps_its_uncertainty():
    clean = chirp_record(4096.0, 6.0, 1e-3)
    time = np.arange(len(clean.reference)) / PERIODIC_HZ
    hum = clean.responses + 0.3 * np.cos(2 * np.pi * 650.7 * time)[:, None]
    found = transfer_periodic(replace(clean, responses=hum), PERIOD_S)
    near = np.argmin(np.abs(found.ratio.frequency_hz - 650.7))
    far = np.abs(found.ratio.frequency_hz - 650.7) > 100.0
    assert found.ratio.u_re[near, 0] > 30.0 * np.median(found.ratio.u_re[far, 0])
    assert deviations(found)[near] < 20.0


def test_an_unsettled_structure_is_reported_and_skipping_the_period_cures_it():
    settled = chirp_record(4096.0, 5.0, 1e-3)
    time = np.arange(len(settled.reference)) / PERIODIC_HZ
    decaying = 5.0 * np.exp(-np.pi * F0_HZ / 66.0 * time) * np.cos(2 * np.pi * F0_HZ * time)
    unsettled = replace(settled, responses=settled.responses + decaying[:, None])
    (notice,) = warned(transfer_periodic(unsettled, PERIOD_S))
    assert (notice.code, notice.where) == (NOT_SETTLED.code, "top")
    cured = transfer_periodic(unsettled, PERIOD_S, settle_periods=1)
    assert not warned(cured)
    assert cured.averages[0] == 4.0


def test_a_response_that_drifts_over_the_periods_is_reported():
    steady = chirp_record(4096.0, 6.0, 1e-3)
    grows = 1.0 + 1e-2 * np.arange(len(steady.reference)) / len(steady.reference)
    both = replace(steady, reference=steady.reference * grows, responses=steady.responses * grows[:, None])
    assert EXCITATION_AMPLITUDE_CHANGES.code in codes(transfer_periodic(both, PERIOD_S))
    one = replace(steady, responses=steady.responses * grows[:, None])
    assert RESPONSE_DRIFTS.code in codes(transfer_periodic(one, PERIOD_S))


def test_distortions_of_a_multisine_are_reported_at_unexcited_lines():
    harmonic = np.setdiff1d(np.arange(81.0, 700.0, 2.0), np.arange(81.0, 700.0, 2.0)[3::4])
    rng = np.random.default_rng(5)
    phasor = np.exp(2j * np.pi * rng.random(len(harmonic))) / np.sqrt(len(harmonic))
    base = periodic(harmonic, phasor, 4096.0, 4 * LENGTH)
    straight = record(base, 2.0 * base, PERIODIC_HZ, 1e-4)
    bent = record(base, 2.0 * base + 0.02 * base**2, PERIODIC_HZ, 1e-4)
    found = transfer_periodic(straight, PERIOD_S)
    np.testing.assert_allclose(found.ratio.frequency_hz, harmonic / PERIOD_S, rtol=1e-12)
    assert not warned(found)
    (notice,) = warned(transfer_periodic(bent, PERIOD_S))
    assert notice.code == NONLINEAR_DISTORTIONS.code
    assert "even" in notice.values["levels"]
    assert "odd" not in notice.values["levels"]


def test_several_responses_share_the_noise_of_the_reference():
    # Noise of the reference alone: two equal responses have the same error.
    clean = chirp_record(4096.0, 5.0)
    noisy = clean.reference + 1e-2 * np.random.default_rng(3).standard_normal(len(clean.reference))
    twice = TransferRecord(
        noisy, np.repeat(clean.responses, 2, axis=1), PERIODIC_HZ, "base", "N", ("a", "b"), ("m/s^2", "m/s^2")
    )
    found = transfer_periodic(twice, PERIOD_S).ratio
    assert found.unit == ("(m/s^2)/N", "(m/s^2)/N")
    np.testing.assert_allclose(found.covariance[:, 0, 1], found.covariance[:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(found.covariance[:, 0, 3], 0.0, atol=1e-6 * found.covariance[:, 0, 0].max())


CHIRP = chirp_record(4096.0, 4.0, 1e-3)


@settings(max_examples=3, deadline=None)
@given(gain=st.floats(0.01, 100.0), other=st.floats(-50.0, -0.1), negative=st.booleans())
def test_scales_and_polarity_move_the_ratio(gain, other, negative):
    gain = -gain if negative else gain
    short = record(*(part[:25_600] for part in PAIR), NOISE_HZ, 0.05)
    for data, transfer in (
        (blows(2, 1e-3), lambda d: transfer_impact(d, 0.3, band_hz=BAND)),
        (CHIRP, lambda d: transfer_periodic(d, PERIOD_S)),
        (short, lambda d: transfer_random(d, 8.0, band_hz=NOISE_BAND)),
        (short, lambda d: transfer_random(d, 8.0, estimator="H2", band_hz=NOISE_BAND)),
    ):
        scaled = replace(data, reference=data.reference * gain, responses=data.responses * other)
        one, two = transfer(data), transfer(scaled)
        np.testing.assert_allclose(two.ratio.value, one.ratio.value * (other / gain), rtol=1e-6)
        np.testing.assert_allclose(two.ratio.u_re, one.ratio.u_re * abs(other / gain), rtol=1e-5)
        np.testing.assert_allclose(two.coherence, one.coherence, rtol=1e-9)


def test_a_common_shift_does_not_move_the_ratio():
    found = transfer_periodic(CHIRP, PERIOD_S).ratio
    rolled = replace(CHIRP, reference=np.roll(CHIRP.reference, 777), responses=np.roll(CHIRP.responses, 777, axis=0))
    moved = transfer_periodic(rolled, PERIOD_S).ratio
    np.testing.assert_allclose(moved.value, found.value, atol=5e-2 * np.abs(found.value).max())
    assert np.median(np.abs(moved.value - found.value) / found.u_re) < 2.0


def test_a_loud_line_of_two_periods_and_two_channels_has_an_invertible_covariance():
    rng = np.random.default_rng(3)
    error = rng.standard_normal((200, 2)) + 1j * rng.standard_normal((200, 2))
    error[100] *= 30.0
    scatter = error[:, :, None] * error[:, None, :].conj()
    pooled, number = pooled_scatter(scatter, np.ones((200, 2), dtype=np.complex128), 2.0)
    assert number[100] == 1.0
    assert np.linalg.eigvalsh(pooled)[:, 0].min() > 0.0
    assert pooled[100, 0, 0].real > 100.0 * pooled[99, 0, 0].real


def test_unsuitable_records_are_refused_with_a_reason():
    refused("^period_s: .* 2 .* 3 ", transfer_periodic, CHIRP, PERIOD_S, settle_periods=3)
    refused("period_s", transfer_periodic, CHIRP, 1e-4)
    noise = replace(CHIRP, reference=np.random.default_rng(1).standard_normal(len(CHIRP.reference)))
    refused("^(period_s|record): ", transfer_periodic, noise, PERIOD_S)
    with pytest.raises(ValueError, match=r"^responses: .*top"):
        replace(CHIRP, responses=np.where(np.arange(len(CHIRP.reference))[:, None] == 7, np.nan, CHIRP.responses))
    refused("^channels: .*base", replace, CHIRP, channels=("base",))


NOISE_HZ, SAMPLES = 6400.0, 20 * 6400
NOISE_BAND = (1000.0, 2000.0)
PAIR = random_pair(SAMPLES, NOISE_HZ, 1)


def relative(found: TransferFunction) -> float:
    """Mean error of H over H between the half-power points, real part."""
    near = np.abs(found.ratio.frequency_hz - F0_HZ) < 11.0
    truth = transmissibility(found.ratio.frequency_hz[near])
    return float(np.mean((found.ratio.value[near, 0] / truth - 1.0).real))


@pytest.mark.parametrize("estimator", ["H1", "H2"])
def test_the_averages_are_those_of_scipy(estimator):
    data = record(*PAIR, NOISE_HZ, 0.1)
    found = transfer_random(data, 2.0, estimator="H1" if estimator == "H1" else "H2", band_hz=NOISE_BAND)
    length = 3200
    x, y = data.reference - data.reference.mean(), data.responses[:, 0] - data.responses[:, 0].mean()
    how = {"fs": NOISE_HZ, "window": "hann", "nperseg": length, "noverlap": length - length // 3, "detrend": False}
    frequency, cross = csd(x, y, **how)
    in_band = (frequency >= NOISE_BAND[0]) & (frequency <= NOISE_BAND[1])
    expected = cross / welch(x, **how)[1] if estimator == "H1" else welch(y, **how)[1] / cross.conj()
    np.testing.assert_allclose(found.ratio.frequency_hz, frequency[in_band], rtol=1e-12)
    np.testing.assert_allclose(found.ratio.value[:, 0], expected[in_band], rtol=1e-9)
    np.testing.assert_allclose(found.coherence[:, 0], coherence(x, y, **how)[1][in_band], rtol=1e-9)
    assert found.estimator == estimator


def test_local_polynomials_are_free_of_leakage():
    # 22.4 Hz between the half-power points; a Hann segment lowers the peak by H''/6 of a line's square.
    truth = transmissibility(np.arange(1400.0, 1556.0, 2.0))
    local, hann = (
        transfer_random(record(*PAIR, NOISE_HZ), 2.0, estimator=e, band_hz=(1399.0, 1555.0)) for e in ("local", "H1")
    )
    errors = [np.max(np.abs(found.ratio.value[:, 0] - truth)) / np.abs(truth).max() for found in (local, hann)]
    assert errors[0] < 1e-3
    assert errors[0] < 0.1 * errors[1]


@pytest.mark.slow
def test_local_polynomials_have_a_resonance_within_its_uncertainty():
    """Damping and frequency of 12 records at 20 dB, by the spread of (estimate - truth)/u."""
    quotient = []
    for seed in range(12):
        data = record(*random_pair(SAMPLES, NOISE_HZ, 60 + seed), NOISE_HZ, 0.1, seed)
        fit = fit_resonance(
            MeasuredCurve.of(transfer_random(data, 4.0, band_hz=NOISE_BAND), "top", NOISE_BAND), "transmissibility"
        )
        quotient.append((fit.frequency_hz - F0_HZ) / fit.u("frequency_hz"))
        quotient.append((fit.damping_ratio - ZETA) / fit.u("damping_ratio"))
    assert float(np.mean(np.square(quotient))) < chi2.ppf(0.999, 24) / 24.0
    assert float(np.mean(np.square(quotient))) > chi2.ppf(0.001, 24) / 24.0


def test_errors_of_local_lines_correlate_as_stated():
    rng = np.random.default_rng(12)
    x, noise = rng.standard_normal(SAMPLES), rng.standard_normal(SAMPLES)
    found = transfer_random(record(x, x + 0.1 * noise, NOISE_HZ), 2.0, estimator="local", band_hz=(200.0, 3000.0))
    off = found.ratio.value[:, 0] - found.ratio.value.mean()
    power = np.mean(np.abs(off) ** 2)
    assert power == pytest.approx(2.0 * np.mean(found.ratio.u_re**2), rel=0.1)
    for lag, stated in enumerate(found.line_correlation[1:4], start=1):
        assert np.mean(off[lag:] * off[:-lag].conj()).real / power == pytest.approx(stated.real, abs=0.08)


def test_overlapping_segments_count_as_welch_states():
    # Welch 1967: 1 + 2 Σ (1 - d/n) ρ_d², ρ_d = Σ w(n)·w(n + d·hop) / Σ w².
    window, hop = get_window("hann", 3200), 3200 // 3
    found = transfer_random(record(*PAIR, NOISE_HZ), 2.0, estimator="H1", band_hz=NOISE_BAND)
    segments = (SAMPLES - 3200) // hop + 1
    rho = [float(window[d * hop :] @ window[: 3200 - d * hop] / (window @ window)) for d in (1, 2, 3)]
    worth = 1.0 + 2.0 * sum((1.0 - d / segments) * r**2 for d, r in enumerate(rho, start=1))
    assert found.averages[0] == pytest.approx(segments / worth, rel=1e-9)
    # Neighbouring lines of one Hann segment correlate by 2/3 and 1/6; squared in a cross spectrum.
    np.testing.assert_allclose(found.line_correlation[:3].real, [1.0, 4 / 9, 1 / 36], atol=0.06)


def test_regions_of_averages_cover():
    pairs = [record(*random_pair(SAMPLES, NOISE_HZ, 10 + seed), NOISE_HZ, 0.05, seed) for seed in range(3)]
    covered = [inside(transfer_random(data, 2.0, band_hz=NOISE_BAND)) for data in pairs]
    # 3 × 501 lines, neighbours correlated: standard deviation of the share about 0.8 %.
    assert np.mean(covered) == pytest.approx(0.95, abs=0.03)


@pytest.mark.slow
def test_scatter_of_an_average_is_that_of_its_covariance():
    """The covariance of the mean of many lines needs their correlation: 1 + 2·(4/9 + 1/36) in variance."""
    quotient = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x, noise = rng.standard_normal(SAMPLES), rng.standard_normal(SAMPLES)
        found = transfer_random(record(x, x + 0.5 * noise, NOISE_HZ), 8.0, estimator="H1", band_hz=NOISE_BAND)
        inflation = 2.0 * np.sum(found.line_correlation.real) - 1.0
        u = np.sqrt(np.mean(found.ratio.u_re**2) * inflation / len(found.ratio.value))
        quotient.append((found.ratio.value.real.mean() - 1.0) / u)
    assert np.std(quotient) == pytest.approx(1.0, abs=0.45)


@pytest.mark.parametrize(("on_base", "on_top", "expected"), [(0.0, 0.05, "H1"), (0.2, 0.0, "H2"), (0.2, 0.1, "Hv")])
def test_the_estimator_follows_the_noise(on_base, on_top, expected):
    rng = np.random.default_rng(4)
    base = PAIR[0] + on_base * PAIR[0].std() * rng.standard_normal(SAMPLES)
    top = PAIR[1] + on_top * PAIR[1].std() * rng.standard_normal(SAMPLES)
    found = transfer_random(record(base, top, NOISE_HZ), 2.0, band_hz=(200.0, 2000.0))
    assert found.estimator == "local"
    assert found.notices[0].code == {"H1": ESTIMATOR_H1, "H2": ESTIMATOR_H2, "Hv": ESTIMATOR_HV}[expected].code
    # H1 reads N_x/S_xx low.
    assert abs(relative(found)) < 0.01
    assert found.notices[0].values["estimator"] == expected
    biased = transfer_random(record(base, top, NOISE_HZ), 2.0, estimator="H1", band_hz=(200.0, 2000.0))
    assert on_base == 0.0 or relative(biased) < -0.01


def test_hv_with_a_given_ratio_lies_between_h1_and_h2():
    data = record(*PAIR, NOISE_HZ, 0.2)
    ratio = (PAIR[1].std() / PAIR[0].std()) ** 2
    low, middle, high = (
        np.abs(transfer_random(data, 2.0, estimator=e, noise_ratio=ratio, band_hz=NOISE_BAND).ratio.value)
        for e in ("H1", "Hv", "H2")
    )
    assert np.all((low < middle) & (middle < high))


def test_a_peak_too_narrow_for_the_lines_is_reported():
    # 22.4 Hz between the half-power points.
    fine = transfer_random(record(*PAIR, NOISE_HZ), 2.0, estimator="H1", band_hz=NOISE_BAND)
    coarse = transfer_random(record(*PAIR, NOISE_HZ), 8.0, estimator="H1", band_hz=NOISE_BAND)
    assert not warned(fine)
    (notice,) = warned(coarse)
    assert (notice.code, notice.values["cause"]) == (NARROW_PEAKS.code, "Leakage")
    peaks = [np.abs(found.ratio.value).max() for found in (fine, coarse)]
    assert peaks[1] < 0.99 * peaks[0]


def test_short_records_are_cut_into_segments_and_useless_ones_refused():
    data = record(*PAIR, NOISE_HZ)
    assert transfer_random(data, 0.25, band_hz=NOISE_BAND).estimator == "H1"
    refused("^resolution_hz: ", transfer_random, data, 0.25, estimator="local", band_hz=NOISE_BAND)
    refused("^resolution_hz: .*0.06", transfer_random, data, 0.06)
    refused("resolution_hz", transfer_random, data, 0.0)
    refused("band_hz", transfer_random, data, 10.0, band_hz=(5000.0, 6000.0))
    refused("noise_ratio", transfer_random, data, 10.0, noise_ratio=-1.0)
