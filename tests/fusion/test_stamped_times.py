"""A recording whose samples are not uniform: a sine of known amplitude and phase, found at the stamped times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion import TransferSettings, evaluate_recording, evaluate_transfer, load_manifest
from fusion.errors import InputError
from shaker.io import read_channels
from shaker.lines.frequencies import find_lines
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineModel
from tests.contracts import refused

RATE_HZ, LINE_HZ = 1000.0, 231.7
AMPLITUDE, RATIO, LAG_RAD, MASS = 50.0, 2e-6, -0.05, 2.0
RIG = """
format = 1
name = "bench"
sensor = { name = "s", channels = ["Fz"], unit = "V/V", sense = "on_load", internal_mass = 0.0 }
shaker = { transverse_motion = 0.001, rocking_motion = 0.001 }
[load]
mass = 2.0
mass_uncertainty = 1e-4
centre_of_mass = [0.0, 0.0, 0.0]
inertia = [[1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 1e-3]]
"""
RECORDING = """
format = 1
name = "run"
rig = "rig.toml"
excitation = {{ kind = "{kind}", direction = [0.0, 0.0, 1.0], {more} }}
[[daq]]
name = "daq"
file = "x.csv"
[[daq.channel]]
name = "acc"
quantity = "acceleration"
body = "load"
point = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
scale = 1.0
scale_uncertainty = 1e-3
[[daq.channel]]
name = "Fz"
quantity = "output"
channel = "Fz"
scale = 1.0
"""


def times(pattern: str, rng: np.random.Generator) -> np.ndarray:
    """Ten seconds of samples of a pattern."""
    time = np.arange(10_000) / RATE_HZ
    if pattern == "lost":
        return np.delete(time, rng.choice(np.arange(1, 9999), 300, replace=False))
    if pattern == "every tenth lost":
        return np.delete(time, np.arange(5, 10_000, 10))
    if pattern == "polled":
        return time + np.clip(0.2 * rng.standard_normal(len(time)), -0.45, 0.45) / RATE_HZ
    if pattern == "drifting":  # the clock of a computer, corrected now and then
        return time + 3e-3 * np.sin(2.0 * np.pi * time / 7.0)
    pauses = np.array([0.0, 0.70331, 1.4567, 5.00049])
    return time + pauses[np.arange(10_000) // 2500]


PATTERNS = ("lost", "every tenth lost", "polled", "drifting", "paused")


def write(folder: Path, time: np.ndarray, rng: np.random.Generator, kind: str = "sine", more: str = "") -> Path:
    """Write a recording whose samples were taken at these times."""
    acc = AMPLITUDE * np.cos(2.0 * np.pi * LINE_HZ * time + 0.4)
    output = RATIO * MASS * AMPLITUDE * np.cos(2.0 * np.pi * LINE_HZ * time + 0.4 + LAG_RAD)
    acc = acc + 0.02 * rng.standard_normal(len(time))
    output = output + 2e-7 * rng.standard_normal(len(time))
    rows = "".join(f"{t:.7f},{a:.7g},{f:.9g}\n" for t, a, f in zip(time, acc, output, strict=True))
    (folder / "x.csv").write_text("time,acc,Fz\ns,m/s^2,V/V\n" + rows)
    (folder / "rig.toml").write_text(RIG)
    (folder / "recording.toml").write_text(RECORDING.format(kind=kind, more=more or f"frequencies = [{LINE_HZ}]"))
    return folder / "recording.toml"


@pytest.mark.parametrize("pattern", PATTERNS)
def test_sensitivity_at_the_stamped_times(tmp_path, pattern):
    rng = np.random.default_rng(3)
    evaluation = evaluate_recording(load_manifest(write(tmp_path, times(pattern, rng), rng)))
    gap = read_channels(tmp_path / "x.csv")["acc"].gap
    assert any(gap in notice.text for notice in evaluation.notices)
    (acc, _) = evaluation.channels
    peak = int(np.argmax(acc.spectrum))
    assert acc.spectrum_hz[peak] == pytest.approx(LINE_HZ, abs=0.2 if pattern != "drifting" else 2.0)
    assert acc.spectrum[peak] == pytest.approx(AMPLITUDE, rel=0.7)  # what is left of it by the nearest places
    found = evaluation.sensitivity
    value, u = found.value[0, 0, 2], float(np.sqrt(np.trace(found.covariance[0, 0, 2]) / 2.0))
    assert 5e-4 < u / RATIO < 2e-3  # that of the accelerometer's scale
    assert abs(np.abs(value) - RATIO) < 2.0 * u
    assert abs(np.angle(value) - LAG_RAD) < 2e-3


@pytest.mark.parametrize("kind", ["chirp", "noise"])
def test_evaluations_of_uniform_samples_name_the_first_gap(tmp_path, kind):
    rng = np.random.default_rng(4)
    more = 'band = [50.0, 400.0], response = ["Fz"], reference = ["acc"]'
    path = write(tmp_path, times("paused", rng), rng, kind, more)
    refused(
        r"x\.csv: acc: .* 0\.7\d+ s .* 2499 and 2500.* 3 gaps",
        evaluate_transfer,
        load_manifest(path),
        TransferSettings(),
        {},
        error=InputError,
    )


@pytest.mark.slow
@pytest.mark.parametrize("pattern", PATTERNS)
def test_95_percent_regions_cover_at_stamped_times(pattern):
    """White noise, and noise that falls with frequency: 200 records, frequency free; accepted is what 95 % allows."""
    rng, inside = np.random.default_rng(5), 0
    for trial in range(200):
        time = times(pattern, rng)[:2000]
        noise = rng.standard_normal(len(time))
        if trial % 2:
            noise = np.cumsum(noise) * 0.05 + 0.3 * noise
        phase = rng.uniform(-np.pi, np.pi)
        values = AMPLITUDE * np.cos(2.0 * np.pi * LINE_HZ * time + phase) + 0.05 * noise
        lines = find_lines(time, values, [LINE_HZ], [1])
        assert abs(lines.frequency_hz[0] - LINE_HZ) < 5.0 * lines.u_frequency_hz[0]
        fit = fit_sines(time, values[:, None], np.array([LINE_HZ]), ["a"], ["1"], model=SineModel(robust=True))
        off = fit.phasors.value[0, 0] - AMPLITUDE * np.exp(1j * phase)
        inside += abs(off.real) < 1.96 * fit.phasors.u_re[0, 0]
        inside += abs(off.imag) < 1.96 * fit.phasors.u_im[0, 0]
    assert 400 * 0.95 - 3.0 * (400 * 0.05 * 0.95) ** 0.5 < inside <= 400 * 0.995
