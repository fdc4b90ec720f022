"""Motion in slow frames by fast references: Monte Carlo against known transfer functions."""

from __future__ import annotations

import numpy as np
import pytest

from shaker.frf.sampled_motion import ReferenceSignals, fit_sampled_motion

RATE_HZ, LENGTH_S, BAND_HZ, EXPOSURE_S = 2000.0, 9.0, (40.0, 300.0), 4e-4
LINES_HZ = np.geomspace(42.0, 290.0, 9)
NOISE = np.array([2e-8, 3e-8])


def transfer(frequency_hz: np.ndarray) -> np.ndarray:
    """Displacement of two components over that of the reference: a lag, and a rocking mode."""
    turn = 2j * np.pi * frequency_hz
    rocking = 1.0 / (1.0 - (frequency_hz / 180.0) ** 2 + 0.1j * frequency_hz / 180.0)
    return np.stack([0.7 * np.exp(-1e-4 * turn), 0.05 * rocking], axis=1)


def simulated(seed: int, noise: float = 1.0) -> tuple[ReferenceSignals, np.ndarray, np.ndarray, np.ndarray]:
    """References, exposure middles, motion, and the phasors (K, 2) of the references at the lines over the first."""
    rng = np.random.default_rng(seed)
    count = round(RATE_HZ * LENGTH_S)
    hertz = np.fft.rfftfreq(count, 1.0 / RATE_HZ)
    inside = (hertz > 30.0) & (hertz < 350.0)
    drive = np.where(inside, rng.standard_normal(len(hertz)) + 1j * rng.standard_normal(len(hertz)), 0.0)
    drive *= 5.0 / np.std(np.fft.irfft(drive, count))
    through, other = transfer(hertz), 1.0 + 2.0 * transfer(hertz)[:, 1]  # a second accelerometer sees the rocking
    values = np.stack([np.fft.irfft(drive, count), np.fft.irfft(drive * other, count)], axis=1)
    time_s = np.sort(0.3 + np.arange(430) / 51.7 + 2e-4 * rng.standard_normal(430))
    moved = -drive[inside] / (2.0 * np.pi * hertz[inside]) ** 2 * np.sinc(hertz[inside] * EXPOSURE_S) * 2.0 / count
    turns = np.exp(2j * np.pi * np.multiply.outer(time_s, hertz[inside]))
    motion = (turns @ (moved[:, None] * through[inside])).real
    motion += noise * NOISE * rng.standard_normal(motion.shape) + 1e-6 * np.sin(0.5 * time_s)[:, None]
    signals = ReferenceSignals(values, np.array([2, 2]), RATE_HZ, 0.0, BAND_HZ)
    at_lines = np.stack([np.ones(len(LINES_HZ)), 1.0 + 2.0 * transfer(LINES_HZ)[:, 1]], axis=1)
    return signals, time_s, motion, at_lines.astype(np.complex128)


def test_95_percent_intervals_cover_the_transfer_functions():
    expected = -transfer(LINES_HZ) / (2.0 * np.pi * LINES_HZ[:, None]) ** 2
    ratios = []
    for seed in range(8):
        signals, time_s, motion, at_lines = simulated(seed)
        found = fit_sampled_motion(signals, time_s, motion, EXPOSURE_S).phasors(LINES_HZ, at_lines)
        error = found.of(motion) - expected
        u = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        ratios.append(np.concatenate([error.real, error.imag], axis=1) / u)
    # 8 records, in each of which neighbouring lines share their error: about 100 independent values.
    assert np.mean(np.abs(ratios) < 1.96) == pytest.approx(0.95, abs=0.05)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.2)


def test_frames_without_noise_show_the_transfer_function_and_its_rate():
    signals, time_s, motion, at_lines = simulated(1, noise=0.0)
    found = fit_sampled_motion(signals, time_s, motion, EXPOSURE_S)
    expected = -transfer(LINES_HZ) / (2.0 * np.pi * LINES_HZ[:, None]) ** 2
    change = np.abs(found.phasors(LINES_HZ, at_lines).of(motion) / expected - 1.0)
    assert change[:, 0].max() < 5e-3
    assert change[:, 1].max() < 0.05  # seven splines per octave smooth the mode
    # Frames that are late by 1 µs turn the motion by -jω µs.
    late = found.phasors(LINES_HZ, at_lines).of(-1e-6 * found.rate)
    assert late[:, 0] == pytest.approx(-2e-6j * np.pi * LINES_HZ * expected[:, 0], rel=0.02)


def test_outlying_and_lost_frames_are_left_out():
    signals, time_s, motion, _ = simulated(2)
    motion[50] = np.nan
    motion[200, 1] += 1e-6
    found = fit_sampled_motion(signals, time_s, motion, EXPOSURE_S)
    assert not found.used[[50, 200]].any()
    assert np.count_nonzero(~found.used) < 8
    assert np.sqrt(np.diag(found.noise)) == pytest.approx(NOISE, rel=0.15)


def test_few_frames_and_foreign_lines_are_refused():
    signals, time_s, motion, at_lines = simulated(3)
    with pytest.raises(ValueError, match=r"^motion:"):
        fit_sampled_motion(signals, time_s[:40], motion[:40], EXPOSURE_S)
    found = fit_sampled_motion(signals, time_s, motion, EXPOSURE_S)
    with pytest.raises(ValueError, match=r"^frequency_hz:"):
        found.phasors(np.array([500.0]), at_lines[:1])
