"""Spectra, and lines found and named in them, against formulas, SciPy and records whose lines are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.io import read_channels
from shaker.lines.detection import survey_lines
from shaker.lines.spectrum import (
    amplitude_spectrum,
    centred_spectrum,
    chance_height,
    find_peaks,
    fit_line,
    noise_level,
    window_samples,
)

NOTHING = np.empty(0)
RATE = 6400.0


def _tones(seconds: float, tones: dict[float, float], noise: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    values = noise * rng.normal(size=len(time))
    for frequency, amplitude in tones.items():
        values += amplitude * np.cos(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi))
    return values


def _pink(rng: np.random.Generator, samples: int, exponent: float) -> np.ndarray:
    """White noise below which noise of power 1/f^exponent rises under a fiftieth of the Nyquist frequency."""
    spectrum = np.fft.rfft(rng.normal(size=samples))
    bins = np.maximum(np.arange(len(spectrum)), 1.0)
    return np.asarray(np.fft.irfft(spectrum * np.sqrt(1.0 + (samples / 100.0 / bins) ** exponent), samples))


def _named(values: np.ndarray, nominal: tuple[float, ...] = ()) -> dict[float, str]:
    survey = survey_lines(values, RATE, nominal)
    return dict(zip(np.round(survey.frequency_hz, 1).tolist(), [o.text for o in survey.origin], strict=True))


def test_noise_level_is_the_power_of_the_noise_and_passes_over_lines() -> None:
    values = _tones(4.0, {800.0: 1.0, 801.0: 1.0}, 2.0)
    level, count = noise_level(np.abs(centred_spectrum(values)) ** 2)
    # A Hann bin of amplitude scaling holds 4 σ²/N · 1.5.
    assert np.median(level) == pytest.approx(6.0 * 4.0 / len(values), rel=0.1)
    assert count > 60


def test_chance_height_is_that_of_exponential_values() -> None:
    rng = np.random.default_rng(0)
    floor = np.median(rng.exponential(size=(200_000, 33)), axis=1) / np.log(2.0)
    values = rng.exponential(size=200_000)
    for chance in (0.1, 1e-2, 1e-3):
        share = np.mean(values > chance_height(chance, 33.0) * floor)
        assert share == pytest.approx(chance, abs=4 * np.sqrt(chance / 200_000))


def test_fitted_line_is_near_the_bound_and_covered() -> None:
    rng = np.random.default_rng(1)
    samples, amplitude, noise, place = 1000, 2.0, 0.5, 123.37
    half = np.arange(samples) - (samples - 1) / 2.0
    sine = amplitude * np.cos(2 * np.pi * place * half / samples + 0.7)
    lines = [
        fit_line(centred_spectrum(sine + noise * rng.normal(size=samples)), samples, 123.0, 6.0 * noise**2 / samples)
        for _ in range(800)
    ]
    error = np.array([line.place for line in lines]) - place
    # Rife and Boorstyn 1974, in bins.
    bound = np.sqrt(6.0 * noise**2 / (np.pi**2 * amplitude**2 * samples))
    assert 1.0 < np.std(error) / bound < 1.4
    assert np.mean([line.u_place for line in lines]) == pytest.approx(np.std(error), rel=0.08)
    assert np.mean([line.u_value for line in lines]) == pytest.approx(
        np.std([line.value.real for line in lines]), rel=0.08
    )


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("samples", [211, 2000])
def test_noise_alone_makes_no_more_lines_than_stated(samples: int, exponent: float) -> None:
    rng = np.random.default_rng(2)
    expected = np.array([17.3, 34.6, 51.9])
    trials, chance = 150, 0.2
    found = sum(
        len(find_peaks(_pink(rng, samples, exponent), chance, expected, NOTHING).place) > 0 for _ in range(trials)
    )
    assert found <= chance * trials + 3 * np.sqrt(chance * trials)


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_false_lines_over_many_spectra(exponent: float) -> None:
    rng = np.random.default_rng(3)
    found = sum(len(find_peaks(_pink(rng, 4000, exponent), 0.02, NOTHING, NOTHING).place) > 0 for _ in range(1500))
    # At most 30 expected: a right chance passes with 99.9 %.
    assert found <= 48


def test_noise_through_a_resonance_is_no_line() -> None:
    from scipy.signal import lfilter

    rng = np.random.default_rng(4)
    radius = np.exp(-np.pi * 1477.35 / 66.0 / RATE)
    poles = [1.0, -2.0 * radius * np.cos(2 * np.pi * 1477.35 / RATE), radius**2]
    records = (np.asarray(lfilter([1.0], poles, rng.normal(size=30_000)))[4400:] for _ in range(10))
    assert sum(len(survey_lines(record, RATE).frequency_hz) for record in records) == 0


def test_every_kind_of_line_is_named() -> None:
    f = 106.2493
    tones = {f: 100.0, 2 * f: 0.01, 4 * f: 0.96, f / 2: 0.1, 50.03: 0.5, 150.09: 0.03, 731.7: 0.2}
    tones |= {f - 3.3: 0.5, f + 3.3: 0.5}
    found = _named(_tones(8.0, tones, 0.1))
    assert found == {
        50.0: "mains hum (50 Hz)",
        53.1: "sub-harmonic, 1/2 of 106.249 Hz",
        102.9: "side band of 106.249 Hz at -3.3 Hz",
        106.2: "fundamental",
        109.5: "side band of 106.249 Hz at +3.3 Hz",
        150.1: "mains hum (harmonic 3 of 50 Hz)",
        212.5: "harmonic 2 of 106.249 Hz, 0.0001 of it",
        425.0: "harmonic 4 of 106.249 Hz, 0.0096 of it",
        731.7: "unexplained",
    }


def test_combinations_and_folded_harmonics() -> None:
    f, g = 311.7, 1104.3
    tones = {f: 1.0, g: 0.8, f + g: 0.05, 2 * g - f: 0.02, RATE - 11 * f: 0.03}
    found = _named(_tones(8.0, tones, 0.01))
    assert found[round(f + g, 1)] == "combination 311.7 + 1104.3 Hz"
    assert found[round(2 * g - f, 1)] == "combination 2·1104.3 - 311.7 Hz"
    assert found[round(RATE - 11 * f, 1)] == "harmonic 11 of 311.7 Hz, folded from 3428.7 Hz"


def test_the_largest_line_may_be_the_second_harmonic() -> None:
    found = _named(_tones(4.0, {80.1: 1.0, 160.2: 10.0, 240.3: 0.5}, 0.1))
    assert [text.partition(" of")[0] for text in found.values()] == ["fundamental", "harmonic 2", "harmonic 3"]


def test_a_sub_harmonic_alone_is_not_the_fundamental() -> None:
    found = _named(_tones(4.0, {80.1: 1.0, 160.2: 10.0, 320.4: 0.5}, 0.1))
    assert found[80.1] == "sub-harmonic, 1/2 of 160.2 Hz"
    assert found[160.2] == "fundamental"


def test_nominal_frequencies_decide() -> None:
    values = _tones(4.0, {80.1: 1.0, 160.2: 10.0, 240.3: 0.5}, 0.1)
    found = _named(values, (160.0,))
    assert found[160.2] == "fundamental"
    assert found[240.3] == "sub-harmonic, 3/2 of 160.2 Hz"
    survey = survey_lines(values, RATE, (160.0, 700.0))
    assert [n.where for n in survey.notices] == ["700 Hz"]


def test_strong_lines_leak_into_no_others() -> None:
    for seed, frequency in enumerate((106.2495, 1234.567, 3001.2, 12.3)):
        survey = survey_lines(_tones(4.0, {frequency: 1e6}, 1.0, seed), RATE)
        assert len(survey.frequency_hz) == 1
        assert abs(survey.frequency_hz[0] - frequency) < 5 * survey.u_frequency_hz[0] + 1e-12 * frequency
    assert len(survey_lines(_tones(4.0, {106.2495: 1.0}, 0.0), RATE).frequency_hz) == 1


def test_drifting_and_jittering_lines_have_no_skirts() -> None:
    rng = np.random.default_rng(5)
    time = np.arange(4 * 6400) / RATE
    noise = 1e-4 * rng.normal(size=len(time))
    drift = (1.0 + 1e-3 * time) * np.cos(2 * np.pi * 106.25 * time)
    walk = np.cos(2 * np.pi * 106.25 * time + np.cumsum(rng.normal(size=len(time))) * 1e-5)
    for values in (drift, walk):
        assert survey_lines(values + noise, RATE).frequency_hz == pytest.approx([106.25], abs=1e-3)


def test_a_ten_thousandth_is_found_where_it_is_expected() -> None:
    found = 0
    for seed in range(10):
        # 0.01 stands 15 dB over the floor of 4 s: 0.01² / (6 · 0.1² / 25600 / 14).
        survey = survey_lines(_tones(4.0, {106.25: 100.0, 637.5: 0.01}, 0.1, seed), RATE)
        found += any(o.multiple == 6 for o in survey.origin)
    assert found >= 9


@settings(max_examples=10, deadline=None)
@given(st.floats(1e-6, 1e6), st.integers(0, 3))
def test_scale_channels_and_direction_of_time_do_not_matter(scale: float, seed: int) -> None:
    first = _tones(1.0, {106.25: 10.0, 212.5: 0.5, 50.02: 1.0}, 0.1, seed)
    second = _tones(1.0, {106.25: 3.0, 318.75: 0.5}, 0.2, seed + 100)
    plain = survey_lines(np.stack([first, second], axis=1), RATE)
    other = survey_lines(scale * np.stack([second, first], axis=1)[::-1], RATE)
    np.testing.assert_allclose(other.frequency_hz, plain.frequency_hz, rtol=1e-7)
    np.testing.assert_allclose(other.amplitude[:, ::-1], scale * plain.amplitude, rtol=1e-5)
    assert [o.kind for o in other.origin] == [o.kind for o in plain.origin]


def test_wrong_calls_are_refused() -> None:
    with pytest.raises(ValueError, match="values: expected at least 32 samples, found 5"):
        survey_lines(np.zeros(5), RATE)
    with pytest.raises(ValueError, match="values: expected finite samples, found 1 that are not"):
        survey_lines(np.append(np.zeros(99), np.nan), RATE)
    with pytest.raises(ValueError, match="rate_hz: expected a positive number, found 0"):
        survey_lines(np.zeros(99), 0.0)


def test_a_constant_record_has_no_lines() -> None:
    survey = survey_lines(np.full((500, 2), 3.0), RATE)
    assert survey.amplitude.shape == (0, 2)


def _recorded(path: Path) -> tuple[np.ndarray, float]:
    channels = list(read_channels(path).values())
    return np.stack([channel.samples for channel in channels], axis=1), channels[0].sample_rate_hz


@pytest.mark.parametrize("factor", [16, 128])
def test_three_tones_of_a_shaker_are_its_fundamentals(data_dir: Path, factor: int) -> None:
    values, rate = _recorded(data_dir / "shaker_three_tone" / f"data_set_1_downsampled_by_{factor}.lvm")
    survey = survey_lines(values[:, :1], rate)
    strong = survey.select(survey.snr > 1e6)
    np.testing.assert_allclose(strong.frequency_hz, [99.9999, 119.9999, 149.9999], atol=2e-4)
    np.testing.assert_allclose(strong.amplitude[:, 0], 0.4994, atol=2e-4)
    assert [origin.kind for origin in strong.origin] == ["fundamental"] * 3


def test_folded_tones_and_harmonics_of_a_shaker(data_dir: Path) -> None:
    values, rate = _recorded(data_dir / "shaker_three_tone" / "data_set_1_downsampled_by_256.lvm")
    survey = survey_lines(values, rate, (100.0, 120.0, 150.0))
    told = dict(zip(np.round(survey.frequency_hz).tolist(), [o.text for o in survey.origin], strict=True))
    assert told[50.0] == "fundamental 150 Hz, read at 50.0001 Hz"
    assert told[80.0] == "fundamental 120 Hz, read at 80.0001 Hz"
    # The tone at 100 Hz lies on the Nyquist frequency.
    assert [n.where for n in survey.notices] == ["100 Hz"]
    values, rate = _recorded(data_dir / "shaker_three_tone" / "data_set_1_downsampled_by_128.lvm")
    survey = survey_lines(values, rate, (100.0, 120.0, 150.0))
    told = dict(zip(np.round(survey.frequency_hz).tolist(), [o.text for o in survey.origin], strict=True))
    # 480 Hz is there in the less decimated file with the same amplitude.
    assert told[80.0].endswith("(or harmonic 4 of 120 Hz, folded from 480 Hz)")
    assert told[20.0] == "combination 120 - 100 Hz"


def test_modes_of_a_beam_that_was_struck(data_dir: Path) -> None:
    for name in ("acceleration", "camera"):
        values, rate = _recorded(data_dir / "undersampled_video" / f"{name}.lvm")
        found = survey_lines(values[:, 0], rate).frequency_hz
        for mode, tolerance in ((18.0, 0.5), (695.6, 0.5), (1897.9, 0.5)):
            assert np.min(np.abs(found - mode)) < tolerance


@pytest.mark.parametrize("window", ["rectangular", "hann", "flattop"])
def test_sine_on_a_bin_shows_its_peak_amplitude(window: str) -> None:
    t = np.arange(4096) / 4096.0
    spectrum = amplitude_spectrum(3.0 * np.sin(2 * np.pi * 400.0 * t) + 7.0, 4096.0, window)  # type: ignore[arg-type]
    assert spectrum.frequency_hz[np.argmax(spectrum.amplitude)] == 400.0
    assert spectrum.amplitude.max() == pytest.approx(3.0, rel=1e-9)
    assert spectrum.amplitude[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("window", ["hann", "flattop"])
def test_windows_are_the_known_ones(window: str) -> None:
    known = scipy.signal.get_window(window, 64, fftbins=True)
    got = window_samples(window, 64)  # type: ignore[arg-type]
    np.testing.assert_allclose(got / got[32], known / known[32], atol=1e-8)


def test_flat_top_keeps_the_amplitude_between_bins() -> None:
    t = np.arange(4096) / 4096.0
    spectrum = amplitude_spectrum(np.sin(2 * np.pi * 400.5 * t), 4096.0, "flattop")
    assert spectrum.amplitude.max() == pytest.approx(1.0, rel=2e-3)


def test_channels_are_independent() -> None:
    data = np.random.default_rng(0).normal(size=(300, 2))
    both = amplitude_spectrum(data, 100.0)
    np.testing.assert_allclose(both.amplitude[:, 1], amplitude_spectrum(data[:, 1], 100.0).amplitude)
