"""Readings of releases against records that scipy integrated, and against published closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contracts import coverage_contract
from hypothesis import given, settings
from hypothesis import strategies as st
from release_factory import Truth

from shaker.release.reading import read_release, read_releases
from shaker.release.record import Reading, StepRecord

PLAIN = Truth()
SLOW = Truth(release_s=3e-3)
SMOOTH = Truth(release_s=1.2e-3, smooth=True)
NO_LAG = Truth(lag_hz=None)
TWO_MODES = Truth(frequency_hz=(500.0, 1180.0), share=(0.8, 0.2), damping_ratio=0.008, lag_hz=None, length_s=0.1)
QUICK = Truth(frequency_hz=(1000.0,), damping_ratio=1e-3, lag_hz=None, release_s=1e-6)


def _deviations(truth: Truth, reading: Reading) -> np.ndarray:
    """Onset, length, gain, baseline and steady level off the truth, over their standard uncertainties."""
    steady = truth.baseline + truth.gain * truth.amplitude
    return np.array(
        [
            (reading.onset_s - truth.onset_s) / reading.u_onset_s,
            (reading.release_s - truth.release_s) / reading.u_release_s,
            (reading.static_gain - truth.gain) / reading.u_static_gain,
            (reading.baseline - truth.baseline) / reading.u_baseline,
            (reading.steady - steady) / reading.u_steady,
        ]
    )


@pytest.mark.parametrize(
    "truth", [PLAIN, SLOW, SMOOTH, NO_LAG, TWO_MODES], ids=["plain", "slow", "smooth", "no lag", "two"]
)
def test_a_release_is_read_within_its_uncertainty(truth: Truth) -> None:
    reading = read_release(truth.record(np.random.default_rng(1), 40.0, 3e-4), "Fz")
    assert np.all(np.abs(_deviations(truth, reading)) < 3.0)
    assert reading.shape == ("smooth" if truth.smooth else "ramp")
    assert reading.u_onset_s < 0.03 / min(truth.frequency_hz)
    assert reading.u_release_s < 0.05 / min(truth.frequency_hz)
    assert reading.u_static_gain < 1e-3 * truth.gain
    assert reading.sign == -1
    assert reading.noise == pytest.approx(0.01, rel=0.1)
    assert not reading.clipped
    assert not reading.notices


@pytest.mark.slow
@pytest.mark.parametrize(("truth", "ratio_db", "trials"), [(PLAIN, 40.0, 40), (SLOW, 40.0, 25), (PLAIN, 20.0, 40)])
def test_intervals_hold_the_truth(truth: Truth, ratio_db: float, trials: int) -> None:
    """What is read by a straight line, with a notice, is a rough guess, and rare."""
    rng = np.random.default_rng(7)
    readings = [read_release(truth.record(rng, ratio_db, 3e-4), "Fz") for _ in range(trials)]
    coverage_contract(
        lambda trial: (_deviations(truth, readings[trial]), np.full(5, 1.97)), np.zeros(5), trials, cautious=True
    )
    assert np.count_nonzero([not reading.notices for reading in readings]) >= 0.95 * trials


def test_the_rise_of_an_undamped_oscillator_is_the_closed_form() -> None:
    """1 - cos ωt passes 10 % and 90 % at arccos 0.9 and arccos 0.1."""
    reading = read_release(QUICK.record(np.random.default_rng(2), 60.0), "Fz")
    true = (np.arccos(0.1) - np.arccos(0.9)) / (2 * np.pi * 1000.0)
    assert reading.rise_s == pytest.approx(true, abs=3.0 * reading.u_rise_s + 1e-3 * true)
    assert reading.u_rise_s < 2e-3 * true
    assert reading.shape == "step"


def test_rise_times_scatter_as_stated() -> None:
    rng = np.random.default_rng(3)
    found = [read_release(PLAIN.record(rng, 40.0), "Fz") for _ in range(12)]
    rise, u = np.array([[r.rise_s, r.u_rise_s] for r in found]).T
    assert 0.45 < np.std(rise, ddof=1) / u.mean() < 1.8  # 99.8 % of 11 degrees of freedom


@given(st.sampled_from([-1.0, 1.0]), st.floats(0.01, 1e4), st.floats(-5.0, 5.0), st.floats(-10.0, 10.0))
@settings(max_examples=5, deadline=None)
def test_units_offsets_and_clocks_do_not_matter(sign: float, size: float, offset: float, start_s: float) -> None:
    first = PLAIN.record(np.random.default_rng(4), 40.0)
    one = read_release(first, "Fz")
    moved = replace(first, samples=sign * size * (first.samples + offset), start_s=start_s)
    other = read_release(moved, "Fz")
    assert other.onset_s - start_s == pytest.approx(one.onset_s, abs=0.02 * one.u_onset_s)
    assert other.release_s == pytest.approx(one.release_s, abs=0.02 * one.u_release_s)
    assert other.static_gain == pytest.approx(sign * size * one.static_gain, rel=1e-6)
    assert other.u_static_gain == pytest.approx(size * one.u_static_gain, rel=1e-2)
    assert other.sign == sign * one.sign


def test_the_load_s_uncertainty_enters_the_gain() -> None:
    record = PLAIN.record(np.random.default_rng(5), 60.0)
    reading = read_release(replace(record, u_amplitude=1e-3), "Fz")
    assert reading.u_static_gain == pytest.approx(1e-3 * abs(reading.static_gain), rel=0.01)


def test_an_output_that_hardly_changes_is_read_at_the_times_of_another() -> None:
    rng = np.random.default_rng(6)
    strong = PLAIN.record(rng, 40.0).samples[0]
    weak = 0.2 + 0.02 * (PLAIN.clean() - 1.0) + 0.01 * rng.standard_normal(len(strong))
    record = PLAIN.of(np.stack([strong, weak]))
    first, second = read_releases(record)
    assert second.onset_s == first.onset_s
    assert second.static_gain == pytest.approx(0.02 * PLAIN.gain, abs=3.0 * second.u_static_gain)
    assert "read at the times of Fz" in second.notices[0].text
    assert read_release(record, "Mx") == second
    assert read_release(record, "Fz") == first


def test_a_measured_force_tells_onset_and_length() -> None:
    rng = np.random.default_rng(8)
    record = PLAIN.record(rng, 40.0)
    force = 25.0 + PLAIN.amplitude * PLAIN.load(record.time_s) + 0.05 * rng.standard_normal(len(record.time_s))
    reading = read_release(replace(record, force=force), "Fz")
    assert reading.shape == "measured"
    assert reading.u_onset_s < 1e-6
    assert np.all(np.abs(_deviations(PLAIN, reading)) < 3.0)
    assert not reading.notices
    told = read_release(replace(record, force=1.1 * force), "Fz").notices
    assert "the force changes by -22.0" in told[0].text


def test_a_cut_record_is_told() -> None:
    samples = PLAIN.record(np.random.default_rng(9), 40.0, 3e-4).samples[0]
    assert samples.min() < -0.25
    reading = read_release(PLAIN.of(np.maximum(samples, -0.2)), "Fz")
    assert reading.clipped
    assert "stands at its limit" in reading.notices[0].text
    upper = read_release(PLAIN.of(-np.maximum(samples, -0.2)), "Fz")
    assert upper.clipped


def test_the_flat_top_of_a_slow_wave_is_not_cut() -> None:
    truth = Truth(frequency_hz=(60.0,), lag_hz=None, release_s=1e-3, length_s=0.15)
    samples = np.round(truth.clean() / 2e-3) * 2e-3  # 16 equal samples at the top of every wave
    assert not read_release(truth.of(samples), "Fz").clipped


def test_hum_and_drift_are_told_and_widen_the_levels() -> None:
    rng = np.random.default_rng(10)
    record = PLAIN.record(rng, 40.0)
    quiet = read_release(record, "Fz")
    hum = 0.02 * np.sin(2 * np.pi * 350.0 * record.time_s)
    loud = read_release(replace(record, samples=record.samples + hum), "Fz")
    assert loud.u_baseline > 3.0 * quiet.u_baseline
    assert abs(loud.baseline - PLAIN.baseline) < 3.0 * loud.u_baseline
    drifting = read_release(replace(record, samples=record.samples + 0.5 * record.time_s), "Fz")
    assert any("drifts by" in notice.text for notice in drifting.notices)


def test_a_record_without_a_release_is_refused() -> None:
    noise = np.random.default_rng(11).standard_normal(5000)
    with pytest.raises(ValueError, match="record: expected an output that changes by 5 standard deviations"):
        read_release(PLAIN.of(noise), "Fz")
    with pytest.raises(ValueError, match="channel: expected one of Fz, found 'Q'"):
        read_release(PLAIN.of(noise), "Q")
    with pytest.raises(ValueError, match="samples: expected at least 64"):
        read_release(PLAIN.of(noise[:40]), "Fz")
    late = replace(PLAIN, onset_s=59.9e-3, _made={})
    with pytest.raises(ValueError, match="record: expected"):
        read_release(late.record(np.random.default_rng(0), 40.0), "Fz")


def test_a_stated_onset_guides_the_reading() -> None:
    """A knock before the release is taken for it unless the onset is stated."""
    record = PLAIN.record(np.random.default_rng(12), 40.0)
    knock = 0.9 * np.exp(-(((record.time_s - 5e-3) / 0.05e-3) ** 2))
    knocked: StepRecord = replace(record, samples=record.samples - knock, onset_s=10e-3)
    reading = read_release(knocked, "Fz")
    assert reading.onset_s == pytest.approx(PLAIN.onset_s, abs=50e-6)
