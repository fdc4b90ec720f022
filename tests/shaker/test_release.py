"""Readings of releases, ropes compared, spectra and noise: against records that scipy integrated and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from contracts import coverage_contract, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from release_factory import Truth
from scipy.stats import ttest_ind

from shaker.io.condition import cut_run
from shaker.model_notices import (
    FORCE_CONTRADICTS_AMPLITUDE,
    LEVEL_DRIFT,
    OTHER_CHANNEL_TIMES,
    OUTPUT_AT_LIMIT,
)
from shaker.release.reading import compare_releases, initial_release, read_release, read_releases
from shaker.release.record import (
    ReleaseReading,
    StepRecord,
    correlation_factor,
    response_spectrum,
    ringing_level,
    spectrum_peaks,
)

PLAIN, SLOW = Truth(), Truth(release_s=3e-3)
SMOOTH, NO_LAG = Truth(release_s=1.2e-3, smooth=True), Truth(lag_hz=None)
TWO_MODES = Truth(frequency_hz=(500.0, 1180.0), share=(0.8, 0.2), damping_ratio=0.008, lag_hz=None, length_s=0.1)
QUICK = Truth(frequency_hz=(1000.0,), damping_ratio=1e-3, lag_hz=None, release_s=1e-6)


def _deviations(truth: Truth, reading: ReleaseReading) -> np.ndarray:
    """Onset, length, gain, baseline and steady level off the truth, over their standard uncertainties."""
    steady = truth.baseline + truth.gain * truth.amplitude
    true = {"onset_s": truth.onset_s, "release_s": truth.release_s, "static_gain": truth.gain}
    true |= {"baseline": truth.baseline, "steady": steady}
    return np.array([(getattr(reading, name) - true[name]) / getattr(reading, f"u_{name}") for name in true])


@pytest.mark.parametrize(
    "truth", [PLAIN, SLOW, SMOOTH, NO_LAG, TWO_MODES], ids=["plain", "slow", "smooth", "no lag", "two"]
)
def test_a_release_is_read_within_its_uncertainty(truth):
    reading = read_release(truth.record(np.random.default_rng(1), 40.0, 3e-4), "Fz")
    assert np.all(np.abs(_deviations(truth, reading)) < 3.0)
    assert reading.shape == ("smooth" if truth.smooth else "ramp")
    assert reading.u_onset_s < 0.03 / min(truth.frequency_hz)
    assert reading.u_release_s < 0.05 / min(truth.frequency_hz)
    assert reading.u_static_gain < 1e-3 * truth.gain
    assert (reading.sign, reading.noise) == (-1, pytest.approx(0.01, rel=0.1))
    assert not reading.clipped
    assert not reading.notices


@pytest.mark.slow
@pytest.mark.parametrize(("truth", "ratio_db", "trials"), [(PLAIN, 40.0, 40), (SLOW, 40.0, 25), (PLAIN, 20.0, 40)])
def test_intervals_cover_the_truth(truth, ratio_db, trials):
    """What is read by a straight line, with a notice, is a rough guess, and rare."""
    rng = np.random.default_rng(7)
    readings = [read_release(truth.record(rng, ratio_db, 3e-4), "Fz") for _ in range(trials)]
    coverage_contract(
        lambda trial: (_deviations(truth, readings[trial]), np.full(5, 1.97)), np.zeros(5), trials, cautious=True
    )
    assert np.count_nonzero([not reading.notices for reading in readings]) >= 0.95 * trials


def test_the_rise_of_an_undamped_oscillator_is_the_closed_form():
    """1 - cos ωt passes 10 % and 90 % at arccos 0.9 and arccos 0.1."""
    reading = read_release(QUICK.record(np.random.default_rng(2), 60.0), "Fz")
    true = (np.arccos(0.1) - np.arccos(0.9)) / (2 * np.pi * 1000.0)
    assert reading.rise_s == pytest.approx(true, abs=3.0 * reading.u_rise_s + 1e-3 * true)
    assert reading.u_rise_s < 2e-3 * true
    assert reading.shape == "step"


@pytest.mark.slow
def test_rise_times_scatter_as_stated():
    rng = np.random.default_rng(3)
    readings = [read_release(PLAIN.record(rng, 40.0), "Fz") for _ in range(12)]
    rise, u = np.array([[r.rise_s, r.u_rise_s] for r in readings]).T
    assert 0.45 < np.std(rise, ddof=1) / u.mean() < 1.8  # 99.8 % of 11 degrees of freedom


@given(st.sampled_from([-1.0, 1.0]), st.floats(0.01, 1e4), st.floats(-5.0, 5.0), st.floats(-10.0, 10.0))
@settings(max_examples=3, deadline=None)
def test_units_offsets_and_clocks_do_not_matter(sign, size, offset, start_s):
    first = PLAIN.record(np.random.default_rng(4), 40.0)
    one = read_release(first, "Fz")
    moved = replace(first, samples=sign * size * (first.samples + offset), start_s=start_s)
    other = read_release(moved, "Fz")
    assert other.onset_s - start_s == pytest.approx(one.onset_s, abs=0.02 * one.u_onset_s)
    assert other.release_s == pytest.approx(one.release_s, abs=0.02 * one.u_release_s)
    assert other.static_gain == pytest.approx(sign * size * one.static_gain, rel=1e-6)
    assert (other.u_static_gain, other.sign) == (pytest.approx(size * one.u_static_gain, rel=1e-2), sign * one.sign)


def test_the_load_s_uncertainty_enters_the_gain():
    record = PLAIN.record(np.random.default_rng(5), 60.0)
    reading = read_release(replace(record, u_amplitude=1e-3), "Fz")
    assert reading.u_static_gain == pytest.approx(1e-3 * abs(reading.static_gain), rel=0.01)


def test_an_output_that_hardly_changes_is_read_at_the_times_of_another():
    rng = np.random.default_rng(6)
    strong = PLAIN.record(rng, 40.0).samples[0]
    weak = 0.2 + 0.02 * (PLAIN.clean() - 1.0) + 0.01 * rng.standard_normal(len(strong))
    record = PLAIN.of(np.stack([strong, weak]))
    first, second = read_releases(record)
    assert second.onset_s == first.onset_s
    assert second.static_gain == pytest.approx(0.02 * PLAIN.gain, abs=3.0 * second.u_static_gain)
    assert second.notices[0].code == OTHER_CHANNEL_TIMES.code
    assert second.notices[0].values["channel"] == "Fz"
    assert (read_release(record, "Mx"), read_release(record, "Fz")) == (second, first)


def test_a_measured_force_gives_onset_and_length():
    rng = np.random.default_rng(8)
    record = PLAIN.record(rng, 40.0)
    force = 25.0 + PLAIN.amplitude * PLAIN.load(record.time_s) + 0.05 * rng.standard_normal(len(record.time_s))
    reading = read_release(replace(record, force=force), "Fz")
    assert reading.shape == "measured"
    assert reading.u_onset_s < 1e-6
    assert np.all(np.abs(_deviations(PLAIN, reading)) < 3.0)
    assert not reading.notices
    notice = read_release(replace(record, force=1.1 * force), "Fz").notices[0]
    assert notice.code == FORCE_CONTRADICTS_AMPLITUDE.code
    assert (notice.values["measured"], notice.values["stated"]) == pytest.approx((-22.0, -20.0), abs=0.05)


@pytest.mark.parametrize("truth", [PLAIN, SLOW, SMOOTH, NO_LAG], ids=["plain", "slow", "smooth", "no lag"])
def test_a_release_without_a_lag_begins_a_fit_where_the_lag_has_it(truth):
    """To second order a lag τ is a release that is τ later, and whose second moment about its middle is τ² larger."""
    lag_s = 0.0 if truth.lag_hz is None else 1.0 / (2.0 * np.pi * truth.lag_hz)
    moment = 0.25 - 2.0 / np.pi**2 if truth.smooth else 1.0 / 12.0
    middle_s, length_s, shape = initial_release(truth.record(np.random.default_rng(9), 40.0))
    assert shape == ("smooth" if truth.smooth else "ramp")
    period_s = 1.0 / min(truth.frequency_hz)
    assert middle_s == pytest.approx(truth.onset_s + 0.5 * truth.release_s + lag_s, abs=0.01 * period_s)
    assert length_s == pytest.approx(np.sqrt(truth.release_s**2 + lag_s**2 / moment), abs=0.05 * period_s)
    record = truth.record(np.random.default_rng(9), 40.0)
    late = replace(
        record, samples=record.samples[:, : int((truth.onset_s - record.start_s) * record.sample_rate_hz) + 40]
    )
    refused("^record: ", initial_release, late)


def test_a_clipped_record_gives_a_notice_and_the_flat_top_of_a_slow_wave_does_not():
    samples = PLAIN.record(np.random.default_rng(9), 40.0, 3e-4).samples[0]
    assert samples.min() < -0.25
    reading = read_release(PLAIN.of(np.maximum(samples, -0.2)), "Fz")
    assert reading.clipped
    assert reading.notices[0].code == OUTPUT_AT_LIMIT.code
    assert read_release(PLAIN.of(-np.maximum(samples, -0.2)), "Fz").clipped
    truth = Truth(frequency_hz=(60.0,), lag_hz=None, release_s=1e-3, length_s=0.08)
    samples = np.round(truth.clean() / 2e-3) * 2e-3  # 16 equal samples at the top of every wave
    assert not read_release(truth.of(samples), "Fz").clipped


def test_hum_and_drift_give_notices_and_widen_the_levels():
    record = PLAIN.record(np.random.default_rng(10), 40.0)
    quiet = read_release(record, "Fz")
    hum = 0.02 * np.sin(2 * np.pi * 350.0 * record.time_s)
    loud = read_release(replace(record, samples=record.samples + hum), "Fz")
    assert loud.u_baseline > 3.0 * quiet.u_baseline
    assert abs(loud.baseline - PLAIN.baseline) < 3.0 * loud.u_baseline
    drifting = read_release(replace(record, samples=record.samples + 0.5 * record.time_s), "Fz")
    assert LEVEL_DRIFT.code in {notice.code for notice in drifting.notices}


def test_a_record_without_a_release_is_refused():
    noise = np.random.default_rng(11).standard_normal(5000)
    refused("^record: ", read_release, PLAIN.of(noise), "Fz")
    refused("^channel: .*'Q'", read_release, PLAIN.of(noise), "Q")
    refused("^samples: ", read_release, PLAIN.of(noise[:40]), "Fz")
    late = PLAIN.record(np.random.default_rng(0), 40.0).samples[:, :1060]
    refused("^record: ", read_release, PLAIN.of(late), "Fz")


def test_a_stated_onset_guides_the_reading():
    """A knock before the release is taken for it unless the onset is stated."""
    record = PLAIN.record(np.random.default_rng(12), 40.0)
    knock = 0.9 * np.exp(-(((record.time_s - 5e-3) / 0.05e-3) ** 2))
    knocked: StepRecord = replace(record, samples=record.samples - knock, onset_s=10e-3)
    assert read_release(knocked, "Fz").onset_s == pytest.approx(PLAIN.onset_s, abs=50e-6)


@pytest.fixture(scope="module")
def reading() -> ReleaseReading:
    """Some reading."""
    return read_release(Truth().record(np.random.default_rng(0), 40.0), "Fz")


def _kind(reading: ReleaseReading, name: str, rise_s: list[float]) -> list[ReleaseReading]:
    """Readings of one rope with given rise times, each known to 1 ns."""
    return [replace(reading, release=name, rise_s=value, u_rise_s=1e-9) for value in rise_s]


def test_the_order_is_that_of_the_rise_and_its_certainty_that_of_welch(reading):
    slow, quick = [2.9e-3, 3.2e-3, 3.0e-3], [2.6e-3, 2.9e-3, 2.7e-3, 2.8e-3]
    first, second = compare_releases(_kind(reading, "cotton", slow) + _kind(reading, "line", quick))
    assert [(kind.release, kind.rank, kind.count) for kind in (first, second)] == [("line", 1, 4), ("cotton", 2, 3)]
    one_sided = ttest_ind(quick, slow, equal_var=False, alternative="less").pvalue
    assert (first.faster, second.faster) == pytest.approx((1.0 - one_sided, np.nan), rel=1e-6, nan_ok=True)
    scatter = np.std(quick, ddof=1)
    assert (first.rise.mean, first.rise.repeatability) == pytest.approx((np.mean(quick), scatter))
    assert first.rise.u_repeatability == pytest.approx(scatter / np.sqrt(6))
    assert (first.rise.u_mean, first.rise.dof) == (pytest.approx(scatter / 2), 3)


def test_one_release_has_no_repeatability_and_only_equal_outputs_compare(reading):
    first, second = compare_releases(_kind(reading, "wire", [1e-4]) + _kind(reading, "line", [2e-4, 2.1e-4]))
    assert first.release == "wire"
    assert np.isnan([first.rise.repeatability, first.faster]).all()
    assert first.rise.u_mean == pytest.approx(1e-9)
    assert second.rise.dof == 1
    equal = [replace(reading, release="line", rise_s=1e-4, u_rise_s=3e-6)] * 4
    (kind,) = compare_releases(equal)
    assert (kind.rise.u_mean, kind.rise.dof) == (pytest.approx(1.5e-6), np.inf)
    two = [reading, replace(reading, component="Fx")]
    refused("^readings: .*Fx.*Fz", compare_releases, two)
    refused("^readings: ", compare_releases, [])


RATE = 50e3
TIME = np.arange(10000) / RATE


RINGING = np.exp(-30 * TIME) * np.cos(2 * np.pi * 450.0 * TIME + 0.3)
RINGING += 0.2 * np.exp(-60 * TIME) * np.cos(2 * np.pi * 1117.0 * TIME)


def test_peaks_are_where_a_fine_transform_has_them():
    window = np.cos(0.5 * np.pi * np.arange(len(TIME)) / len(TIME)) ** 2
    first, second = spectrum_peaks(RINGING, RATE, 1e-4)
    sizes = []
    for peak, near in ((first, 450.0), (second, 1117.0)):
        fine = near + np.linspace(-1.5, 1.5, 601)
        size = np.abs(np.exp(-2j * np.pi * np.outer(fine, TIME)) @ (window * RINGING))
        assert peak.frequency_hz == pytest.approx(fine[np.argmax(size)], abs=0.005)
        sizes.append(size.max())
    assert (first.share, first.u_share) == (1.0, 0.0)
    assert second.share == pytest.approx(sizes[1] / sizes[0], rel=1e-5)


def test_noise_scatters_peaks_as_stated_and_adds_none():
    clean, rng = spectrum_peaks(RINGING, RATE, 1e-6), np.random.default_rng(1)
    found = [spectrum_peaks(RINGING + 0.02 * rng.standard_normal(len(TIME)), RATE, 0.02) for _ in range(40)]
    assert all(len(peaks) == 2 for peaks in found)
    for index in (0, 1):
        moved = np.array([peaks[index].frequency_hz - clean[index].frequency_hz for peaks in found])
        stated = np.mean([peaks[index].u_frequency_hz for peaks in found])
        assert 0.65 < np.sqrt(np.mean(moved**2)) / stated < 1.37  # 99.9 % of 40 degrees of freedom
    shares = np.array([peaks[1].share for peaks in found])
    assert 0.65 < shares.std() / np.mean([peaks[1].u_share for peaks in found]) < 1.37
    rng = np.random.default_rng(2)
    assert not [peak for _ in range(20) for peak in spectrum_peaks(rng.standard_normal(4000), 1e5, 1.0)]


def test_the_spectrum_shows_the_amplitude_of_a_lasting_sine():
    spectrum = response_spectrum(0.7 * np.sin(2 * np.pi * 1000.0 * TIME), RATE)
    assert spectrum.amplitude.max() == pytest.approx(0.7, rel=1e-2)
    assert spectrum.frequency_hz[np.argmax(spectrum.amplitude)] == pytest.approx(1000.0, abs=3.0)


def test_correlated_noise_counts_less():
    """A first-order autoregression of coefficient a enlarges the variance of a mean by (1 + a)/(1 - a)."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(3)
    white = [correlation_factor(rng.standard_normal(2000)) for _ in range(40)]
    assert np.mean(white) < 1.1
    red = [correlation_factor(lfilter([1.0], [1.0, -0.8], rng.standard_normal(4000))[200:]) for _ in range(20)]
    assert np.mean(red) == pytest.approx(9.0, rel=0.25)


def test_a_level_below_ringing_has_its_drift_and_its_last_digit():
    rng = np.random.default_rng(4)
    pole = np.array([(-30 + 2j * np.pi * 450.0) / RATE])
    samples = 0.3 + np.exp(-30 * TIME) * np.cos(2 * np.pi * 450.0 * TIME) + 0.01 * rng.standard_normal(len(TIME))
    level = ringing_level(samples, pole, 0.0)
    assert level.value == pytest.approx(0.3, abs=4 * level.u)
    assert level.u == pytest.approx(0.01 / np.sqrt(len(TIME)), rel=0.2)
    assert abs(level.drift_over_u) < 4
    drifting = ringing_level(samples + 0.02 * TIME / TIME[-1], pole, 0.0)
    assert drifting.drift == pytest.approx(0.02, rel=0.1)
    assert drifting.drift_over_u > 10
    level = ringing_level(np.full(100, 0.5), np.zeros(0, dtype=complex), 0.01)
    assert (level.u, level.noise) == pytest.approx((0.01 / np.sqrt(12), 0.01 / np.sqrt(12)))


@pytest.mark.parametrize("samples_per_wave", [12, 100, 4000])
@pytest.mark.parametrize("amplitude", [3.0, 40.0, 3000.0])
def test_waves_of_any_length_are_not_cut_and_cut_ones_are(samples_per_wave, amplitude):
    """Amplitudes in steps of the converter; a tenth of the wave is missing where it is cut."""
    wave = np.sin(2 * np.pi * np.arange(3 * samples_per_wave) / samples_per_wave + 0.1)
    assert not any(cut_run(np.round(side * amplitude * wave), 1.0, 0.3) for side in (1.0, -1.0))
    if amplitude > 1000.0 and samples_per_wave > 30:
        for side in (1.0, -1.0):
            assert cut_run(np.round(np.minimum(side * amplitude * wave, 0.9 * amplitude)), 1.0, 0.3) > 2
