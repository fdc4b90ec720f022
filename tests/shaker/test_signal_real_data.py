"""Lines and sine approximation on files that other laboratories recorded."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from shaker.io import read_channels
from shaker.io.channel import RawChannel
from shaker.lines.frequencies import find_lines
from shaker.sine.aliasing import folded_harmonics
from shaker.sine.fit import fit_sines

TONES_HZ = [100.0, 120.0, 150.0]


def _three_tones(data_dir: Path, factor: int) -> dict[str, RawChannel]:
    return read_channels(data_dir / "shaker_three_tone" / f"data_set_1_downsampled_by_{factor}.lvm")


def _stacked(channels: dict[str, RawChannel]) -> tuple[np.ndarray, np.ndarray]:
    values = np.stack([channel.samples for channel in channels.values()], axis=1)
    return np.arange(len(values)) / next(iter(channels.values())).sample_rate_hz, values


def _ratios(data_dir: Path, factor: int) -> dict[float, float]:
    """Return the ratio of acceleration to force (g/lb) by nominal frequency."""
    time, values = _stacked(_three_tones(data_dir, factor))
    lines = find_lines(time, values, TONES_HZ, [1])
    fit = fit_sines(time, values, lines.frequency_hz, ["U", "F", "a"], ["V", "lb", "g"])
    amplitude = np.abs(fit.phasors.value)
    return dict(zip(lines.nominal_hz.tolist(), (amplitude[:, 2] / amplitude[:, 1]).tolist(), strict=True))


def test_three_tones_of_the_drive(data_dir: Path) -> None:
    time, values = _stacked(_three_tones(data_dir, 16))
    lines = find_lines(time, values, TONES_HZ, [1])
    np.testing.assert_allclose(lines.frequency_hz, [99.9999, 119.9999, 149.9999], atol=5e-5)
    fit = fit_sines(time, values, lines.frequency_hz, ["U", "F", "a"], ["V", "lb", "g"])
    np.testing.assert_allclose(np.abs(fit.phasors.value[:, 0]), 0.4994, atol=5e-5)
    assert np.all(fit.phasors.u_re[:, 0] < 5e-6)


def test_harmonics_of_the_shaker_are_listed(data_dir: Path) -> None:
    time, values = _stacked(_three_tones(data_dir, 16))
    lines = find_lines(time, values, TONES_HZ)
    found = set(zip(lines.nominal_hz.tolist(), lines.multiple.tolist(), strict=True))
    assert {(100.0, 2), (120.0, 2), (150.0, 2), (120.0, 4), (120.0, 6)} <= found
    assert any("2·99.9999 + 120 Hz" in n.text for n in lines.notices)


def test_undersampled_tones_are_found_at_their_aliases(data_dir: Path) -> None:
    time, values = _stacked(_three_tones(data_dir, 256))
    lines = find_lines(time, values, TONES_HZ, [1])
    np.testing.assert_allclose(lines.frequency_hz, [119.9999, 149.9999], atol=5e-5)
    named = next(n.text for n in lines.notices if n.where == "120 Hz")
    assert re.search(r"read at 80 Hz, .*: 480 Hz \(4 × 120 Hz\), 720 Hz \(6 × 120 Hz\)", named)
    refused = [n for n in lines.notices if n.where == "100 Hz"]
    assert len(refused) == 1
    assert "onto the Nyquist frequency" in refused[0].text
    fit = fit_sines(time, values, lines.frequency_hz, ["U", "F", "a"], ["V", "lb", "g"])
    np.testing.assert_allclose(np.abs(fit.phasors.value[:, 0]), 0.4994, atol=2e-4)
    with pytest.raises(ValueError, match=r"100 Hz is dropped: sampled at 200 Hz it folds to 100 Hz"):
        find_lines(time, values, [100.0], [1])


def test_ratio_at_the_alias_agrees_unless_harmonics_fold_onto_it(data_dir: Path) -> None:
    full, folded = _ratios(data_dir, 16), _ratios(data_dir, 256)
    assert full[150.0] == pytest.approx(0.0920, abs=5e-4)
    assert folded[150.0] == pytest.approx(full[150.0], rel=0.05)
    # The 4th and 6th harmonic of 120 Hz are strong in this record, and nothing kept them out of the decimated file.
    assert 0.12 < 1.0 - folded[120.0] / full[120.0] < 0.22
    names = {fold.frequency_hz for fold in folded_harmonics(120.0, TONES_HZ, 200.0, 1.0 / 19.7)}
    assert {480.0, 720.0} <= names
