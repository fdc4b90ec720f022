"""Lines of a record found by their own noise floor: false ones, detected ones, names, leakage, time.

Usage: python benchmarks/signals_lines.py [--trials 2000]

Noise spectra: white, 1/f and 1/f² (below a fiftieth of the Nyquist frequency), and white noise through a resonance of
Q = 66. Detection: one sine of unknown frequency in white noise, by its power over the noise in a periodogram bin
(a²N/4σ²), at an unknown and at an expected place. Leakage: 53.7 Hz beside a hum of 2 % at 50.03 Hz, records of 1 s.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from shaker.lines.detection import survey_lines
from shaker.lines.frequencies import find_lines
from shaker.lines.peaks import FloorSpectrum, find_peaks
from shaker.sine.sine_fit import fit_sines

FloatArray = NDArray[np.float64]
NOTHING = np.empty(0)
STATED = 0.01  # probability of a false line in a record
RATE_HZ = 12_800.0


def main(trials: int = 2000) -> None:
    print("| noise | samples | records | with a false line | stated |\n|---|---|---|---|---|")
    for samples in (211, 4000, 20_000):
        for name, exponent in (("white", 0.0), ("white + 1/f", 1.0), ("white + 1/f²", 2.0)):
            rng = np.random.default_rng(samples)
            count = max(trials // 4, 1) if samples > 10_000 else trials
            false_alarms(name, [coloured(rng, samples, exponent) for _ in range(count)])
    rng = np.random.default_rng(9)
    false_alarms("resonance, Q = 66", [resonance(rng, 51_200) for _ in range(max(trials // 10, 1))])
    print("\n| a²N/4σ² / dB | found anywhere / % | found where expected / % |\n|---|---|---|")
    for height_db in (10.0, 12.0, 14.0, 16.0, 18.0):
        detection(height_db, max(trials // 10, 1))
    leakage(max(trials // 50, 1))
    duration()


def coloured(rng: np.random.Generator, samples: int, exponent: float) -> FloatArray:
    """Return white noise with noise of power 1/f^exponent that rises above it."""
    spectrum = np.fft.rfft(rng.normal(size=samples))
    bins = np.maximum(np.arange(len(spectrum)), 1.0)
    rise = np.sqrt(1.0 + (samples / 100.0 / bins) ** exponent) if exponent else 1.0
    return np.asarray(np.fft.irfft(spectrum * rise, samples))


def resonance(rng: np.random.Generator, samples: int) -> FloatArray:
    """Return white noise through a resonance at 1477.35 Hz."""
    radius = np.exp(-np.pi * 1477.35 / 66.0 / RATE_HZ)
    poles = [1.0, -2.0 * radius * np.cos(2 * np.pi * 1477.35 / RATE_HZ), radius**2]
    return np.asarray(lfilter([1.0], poles, rng.normal(size=samples + 5000)))[5000:]


def false_alarms(name: str, records: list[FloatArray]) -> None:
    """Print in how many records of noise a line is found."""
    found = sum(len(find_peaks(FloorSpectrum(record), STATED, NOTHING, NOTHING).bin_position) > 0 for record in records)
    share = found / len(records)
    print(f"| {name} | {len(records[0])} | {len(records)} | {100 * share:.2f} % | {100 * STATED:.0f} % |", flush=True)


def detection(height_db: float, trials: int) -> None:
    """Print how often a line of this height is found."""
    rng = np.random.default_rng(int(height_db))
    samples, hits = 51_200, np.zeros(2)
    amplitude = np.sqrt(4.0 * 10.0 ** (height_db / 10.0) / samples)
    for _ in range(trials):
        place = rng.uniform(500.0, 20_000.0)
        turns = place * np.arange(samples) / samples
        values = amplitude * np.cos(2 * np.pi * turns + rng.uniform(0, 2 * np.pi)) + rng.normal(size=samples)
        expected = np.append(place, rng.uniform(500.0, 20_000.0, size=40))
        for k, places in enumerate((NOTHING, expected)):
            hits[k] += np.any(np.abs(find_peaks(values, 1e-3, places, NOTHING).bin_position - place) < 1.0)
    anywhere, where_expected = 100.0 * hits / trials
    print(f"| {height_db:.0f} | {anywhere:.0f} | {where_expected:.0f} |", flush=True)


def leakage(trials: int) -> None:
    """Print what a hum beside the line does to it, fitted with it or not."""
    rng = np.random.default_rng(5)
    at = np.arange(12_800) / RATE_HZ
    errors: dict[str, list[float]] = {"the line alone": [], "with what leaks into it": []}
    for _ in range(trials):
        hum = 0.02 * np.cos(2 * np.pi * 50.03 * at + rng.uniform(0, 2 * np.pi))
        values = np.cos(2 * np.pi * 53.7 * at) + hum + 0.01 * rng.normal(size=len(at))
        lines = find_lines(at, values, [53.7])
        for (_, found), others in zip(errors.items(), (NOTHING, lines.nuisance_hz), strict=True):
            fit = fit_sines(at, values[:, None], np.append(53.7, others), ["a"], ["m/s^2"])
            found.append(abs(fit.phasors.value[0, 0] - 1.0))
    print("\n| fitted | error rms | noise alone |\n|---|---|---|")
    for name, found in errors.items():
        print(f"| {name} | {np.sqrt(np.mean(np.square(found))):.2e} | {0.01 * np.sqrt(4 / len(at)):.2e} |", flush=True)


def duration() -> None:
    """Print the time for a record of 60 s at 51.2 kHz."""
    rng = np.random.default_rng(0)
    rate_hz = 51_200.0
    at = np.arange(int(60 * rate_hz)) / rate_hz
    values = rng.normal(size=len(at))
    for frequency, amplitude in ((106.2495, 100.0), (424.998, 0.5), (50.02, 0.5)):
        values += amplitude * np.cos(2 * np.pi * frequency * at)
    started = time.perf_counter()
    survey = survey_lines(values, rate_hz)
    surveyed = time.perf_counter() - started
    started = time.perf_counter()
    lines = find_lines(at, values, [106.25])
    found = time.perf_counter() - started
    print("\n| 51.2 kHz × 60 s | lines | time / s |\n|---|---|---|")
    print(f"| survey_lines | {len(survey.frequency_hz)} | {surveyed:.1f} |")
    print(f"| find_lines | {len(lines.frequency_hz) + len(lines.others.frequency_hz)} | {found:.1f} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=2000)
    main(parser.parse_args().trials)
