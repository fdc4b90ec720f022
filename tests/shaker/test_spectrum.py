"""Spectra and noise levels against formulas, SciPy and drawn noise."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from shaker.lines.spectrum import amplitude_spectrum, window_samples
from shaker.sine.noise import line_noise


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


def test_white_noise_is_measured_as_white() -> None:
    rng = np.random.default_rng(6)
    levels = []
    for _ in range(60):
        noise = line_noise(2.0 * rng.normal(size=(4000, 2)), 4000, np.array([500.0, 900.3]))
        assert noise is not None
        levels.append(noise.variance)
    np.testing.assert_allclose(np.mean(levels, axis=0), 4.0, rtol=0.08)


def test_low_noise_is_seen_where_it_lies() -> None:
    rng = np.random.default_rng(7)
    n, corner = 212, 20.0  # corner in bins
    shape = np.sqrt(1.0 + corner * 8 / np.maximum(np.arange(n * 4 + 1), 1.0))
    levels = []
    for _ in range(200):
        series = np.fft.irfft(np.fft.rfft(rng.normal(size=8 * n)) * shape)[:n]
        noise = line_noise((series - series.mean())[:, None], n, np.array([2.0, 60.0]))
        assert noise is not None
        levels.append(noise.variance[:, 0])
    expected = 1.0 + corner / np.array([2.0, 60.0])
    np.testing.assert_allclose(np.mean(levels, axis=0), expected, rtol=0.25)


def test_too_short_a_record_gives_no_local_noise() -> None:
    assert line_noise(np.ones((16, 1)), 16, np.array([3.0])) is None
