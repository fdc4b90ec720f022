"""Ropes compared, spectra of responses, and where levels and noise come from: against scipy and Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from release_factory import Truth
from scipy.stats import ttest_ind

from shaker.release.reading import compare_releases, read_release
from shaker.release.record import Reading, clipped, correlation_factor, response_spectrum, ringing_level, spectrum_peaks


@pytest.fixture(scope="module")
def reading() -> Reading:
    """Some reading."""
    return read_release(Truth().record(np.random.default_rng(0), 40.0), "Fz")


def _kind(reading: Reading, name: str, rise_s: list[float]) -> list[Reading]:
    """Readings of one rope with given rise times, each known to 1 ns."""
    return [replace(reading, release=name, rise_s=value, u_rise_s=1e-9) for value in rise_s]


def test_the_order_is_that_of_the_rise_and_its_certainty_that_of_welch(reading: Reading) -> None:
    slow, quick = [2.9e-3, 3.2e-3, 3.0e-3], [2.6e-3, 2.9e-3, 2.7e-3, 2.8e-3]
    first, second = compare_releases(_kind(reading, "cotton", slow) + _kind(reading, "line", quick))
    assert (first.release, first.rank, first.count) == ("line", 1, 4)
    assert (second.release, second.rank, second.count) == ("cotton", 2, 3)
    one_sided = ttest_ind(quick, slow, equal_var=False, alternative="less").pvalue
    assert first.faster == pytest.approx(1.0 - one_sided, rel=1e-6)
    assert np.isnan(second.faster)
    assert first.rise.mean == pytest.approx(np.mean(quick))
    assert first.rise.repeatability == pytest.approx(np.std(quick, ddof=1))
    assert first.rise.u_repeatability == pytest.approx(np.std(quick, ddof=1) / np.sqrt(6))
    assert first.rise.u_mean == pytest.approx(np.std(quick, ddof=1) / 2)
    assert first.rise.dof == 3


def test_one_release_tells_nothing_of_repeatability(reading: Reading) -> None:
    single, pair = _kind(reading, "wire", [1e-4]), _kind(reading, "line", [2e-4, 2.1e-4])
    first, second = compare_releases(single + pair)
    assert first.release == "wire"
    assert np.isnan(first.rise.repeatability)
    assert np.isnan(first.faster)
    assert first.rise.u_mean == pytest.approx(1e-9)
    assert second.rise.dof == 1


def test_means_are_no_better_known_than_the_readings(reading: Reading) -> None:
    alike = [replace(reading, release="line", rise_s=1e-4, u_rise_s=3e-6)] * 4
    (kind,) = compare_releases(alike)
    assert kind.rise.u_mean == pytest.approx(1.5e-6)
    assert kind.rise.dof == np.inf


def test_only_alike_readings_are_compared(reading: Reading) -> None:
    with pytest.raises(ValueError, match="one output under one component, found Fz under Fx, Fz under Fz"):
        compare_releases([reading, replace(reading, component="Fx")])
    with pytest.raises(ValueError, match="found none"):
        compare_releases([])


RATE = 50e3
TIME = np.arange(10000) / RATE


def _ringing() -> np.ndarray:
    """Two decaying cosines, 1 at 450 Hz and 0.2 at 1117 Hz."""
    return np.exp(-30 * TIME) * np.cos(2 * np.pi * 450.0 * TIME + 0.3) + 0.2 * np.exp(-60 * TIME) * np.cos(
        2 * np.pi * 1117.0 * TIME
    )


def test_peaks_are_where_a_fine_transform_has_them() -> None:
    ringing = _ringing()
    window = np.cos(0.5 * np.pi * np.arange(len(ringing)) / len(ringing)) ** 2
    first, second = spectrum_peaks(ringing, RATE, 1e-4)
    sizes = []
    for peak, near in ((first, 450.0), (second, 1117.0)):
        fine = near + np.linspace(-3.0, 3.0, 1201)
        size = np.abs(np.exp(-2j * np.pi * np.outer(fine, TIME)) @ (window * ringing))
        assert peak.frequency_hz == pytest.approx(fine[np.argmax(size)], abs=0.005)
        sizes.append(size.max())
    assert (first.share, first.u_share) == (1.0, 0.0)
    assert second.share == pytest.approx(sizes[1] / sizes[0], rel=1e-5)


def test_noise_scatters_peaks_as_stated() -> None:
    ringing, noise = _ringing(), 0.02
    clean = spectrum_peaks(ringing, RATE, 1e-6)
    rng = np.random.default_rng(1)
    found = [spectrum_peaks(ringing + noise * rng.standard_normal(len(ringing)), RATE, noise) for _ in range(80)]
    assert all(len(peaks) == 2 for peaks in found)
    for place in (0, 1):
        moved = np.array([peaks[place].frequency_hz - clean[place].frequency_hz for peaks in found])
        stated = np.mean([peaks[place].u_frequency_hz for peaks in found])
        assert 0.75 < np.sqrt(np.mean(moved**2)) / stated < 1.25  # 99.9 % of 80 degrees of freedom
    shares = np.array([peaks[1].share for peaks in found])
    assert 0.75 < shares.std() / np.mean([peaks[1].u_share for peaks in found]) < 1.25


def test_noise_has_no_peaks() -> None:
    rng = np.random.default_rng(2)
    assert not [peak for _ in range(20) for peak in spectrum_peaks(rng.standard_normal(4000), 1e5, 1.0)]


def test_the_spectrum_shows_the_amplitude_of_a_lasting_sine() -> None:
    spectrum = response_spectrum(0.7 * np.sin(2 * np.pi * 1000.0 * TIME), RATE)
    assert spectrum.amplitude.max() == pytest.approx(0.7, rel=1e-2)
    assert spectrum.frequency_hz[np.argmax(spectrum.amplitude)] == pytest.approx(1000.0, abs=3.0)


def test_correlated_noise_counts_less() -> None:
    """A first-order autoregression of coefficient a enlarges the variance of a mean by (1 + a)/(1 - a)."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(3)
    white = [correlation_factor(rng.standard_normal(2000)) for _ in range(40)]
    assert np.mean(white) < 1.1
    red = [correlation_factor(lfilter([1.0], [1.0, -0.8], rng.standard_normal(4000))[200:]) for _ in range(20)]
    assert np.mean(red) == pytest.approx(9.0, rel=0.25)


def test_a_level_is_found_under_what_rings_and_its_drift_is_told() -> None:
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


def test_samples_without_noise_are_known_to_their_last_digit() -> None:
    level = ringing_level(np.full(100, 0.5), np.zeros(0, dtype=complex), 0.01)
    assert level.u == pytest.approx(0.01 / np.sqrt(12))
    assert level.noise == pytest.approx(0.01 / np.sqrt(12))


@pytest.mark.parametrize("samples_per_wave", [12, 100, 4000])
@pytest.mark.parametrize("amplitude", [3.0, 40.0, 3000.0])
def test_waves_of_any_length_are_not_cut_and_cut_ones_are(samples_per_wave: int, amplitude: float) -> None:
    """Amplitudes in steps of the converter; a tenth of the wave is missing where it is cut."""
    wave = np.sin(2 * np.pi * np.arange(3 * samples_per_wave) / samples_per_wave + 0.1)
    assert not clipped(np.round(amplitude * wave), 1.0, 0.3)
    if amplitude > 1000.0 and samples_per_wave > 30:
        assert clipped(np.round(np.minimum(amplitude * wave, 0.9 * amplitude)), 1.0, 0.3)
        assert clipped(np.round(np.maximum(amplitude * wave, -0.9 * amplitude)), 1.0, 0.3)
