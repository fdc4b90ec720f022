"""Aliases, folded lines and exposure against formulas and the published case."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.lines.aliasing import (
    alias_frequency,
    beat_phase,
    condition_number,
    exposure_gain,
    folded_harmonics,
    sampling_grid,
    sine_columns,
    usable_lines,
)

CAMERA_HZ = 52.874


def test_published_beats() -> None:
    # 106.25 Hz and its harmonics at 52.874 Hz: 0.502, 1.004, 1.506, 2.008 Hz.
    beats = alias_frequency(106.25 * np.arange(1, 5), CAMERA_HZ)
    np.testing.assert_allclose(beats, [0.502, 1.004, 1.506, 2.008], atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.0, 5000.0), st.floats(10.0, 1000.0), st.integers(0, 30))
def test_alias_is_periodic_even_and_below_nyquist(frequency: float, rate: float, turns: int) -> None:
    alias = float(alias_frequency(frequency, rate))
    assert 0.0 <= alias <= rate / 2.0 * (1.0 + 1e-12)
    assert float(alias_frequency(turns * rate + frequency, rate)) == pytest.approx(alias, abs=1e-8)
    assert float(alias_frequency(-frequency, rate)) == pytest.approx(alias, abs=1e-8)


def test_samples_of_a_line_and_its_alias_agree() -> None:
    n = np.arange(50)
    alias = float(alias_frequency(106.25, CAMERA_HZ))
    np.testing.assert_allclose(
        np.cos(2 * np.pi * 106.25 * n / CAMERA_HZ), np.cos(2 * np.pi * alias * n / CAMERA_HZ), atol=1e-9
    )


def test_exposure_gain_is_the_mean_over_the_exposure() -> None:
    exposure, frequency = 100e-6, 500.0
    t = np.linspace(-exposure / 2, exposure / 2, 200_001)
    mean = np.trapezoid(np.cos(2 * np.pi * frequency * t), t) / exposure
    assert float(exposure_gain(np.array([frequency]), exposure)[0]) == pytest.approx(mean, rel=1e-9)
    assert 1.0 - mean == pytest.approx(0.0041, abs=1e-4)


def test_record_folds_on_one_period() -> None:
    time = np.arange(211) / CAMERA_HZ
    phase = beat_phase(time, 106.25)
    assert phase.min() >= 0.0
    assert phase.max() < 2.0 * np.pi
    np.testing.assert_allclose(np.cos(phase), np.cos(2 * np.pi * 106.25 * time), atol=1e-9)


def test_ideal_sampling_has_condition_one() -> None:
    time = np.arange(1000) / 1000.0
    columns = sine_columns(time, np.array([100.0, 200.0, 300.0]))
    assert condition_number(columns.T @ columns) == pytest.approx(1.0, abs=1e-9)


def test_all_published_lines_are_usable() -> None:
    time = np.arange(211) / CAMERA_HZ
    mask, notices = usable_lines(time, 106.25 * np.arange(1, 5))
    assert mask.all()
    assert not notices


@pytest.mark.parametrize(
    ("lines", "rate", "dropped", "reason"),
    [
        ([100.0, 150.0], 50.0, 100.0, "onto zero"),
        ([100.0, 130.0], 200.0, 100.0, "onto the Nyquist frequency"),
        ([70.0, 130.0], 200.0, 130.0, r"onto the line 70 Hz \(at 70 Hz\)"),
        ([30.0, 230.05], 200.0, 230.05, r"within 0.05 Hz of the line 30 Hz"),
    ],
)
def test_folded_line_is_dropped_by_name(lines: list[float], rate: float, dropped: float, reason: str) -> None:
    mask, notices = usable_lines(np.arange(400) / rate, np.array(lines))
    assert not mask[lines.index(dropped)]
    import re

    assert any(n.where == f"{dropped:.6g} Hz" and re.search(reason, n.text) for n in notices), notices


def test_times_off_any_grid_tell_folded_lines_apart() -> None:
    rng = np.random.default_rng(0)
    time = np.sort(rng.uniform(0.0, 4.0, 200))
    mask, _ = usable_lines(time, np.array([70.0, 130.0]))
    assert mask.all()


def test_harmonics_that_fold_onto_a_line_are_named() -> None:
    # The real record at 200 Hz: the fourth and sixth harmonic of 120 Hz come back at 80 Hz, like 120 Hz itself.
    folds = folded_harmonics(120.0, [100.0, 120.0, 150.0], 200.0, 0.05, max_multiple=6)
    assert [(fold.frequency_hz, fold.multiple, fold.fundamental_hz) for fold in folds] == [
        (480.0, 4, 120.0),
        (720.0, 6, 120.0),
    ]
    assert all(fold.alias_hz == pytest.approx(80.0) for fold in folds)
    assert not folded_harmonics(106.25, [106.25], CAMERA_HZ, 0.25, max_multiple=20)


def test_grid_with_gaps_is_recognised() -> None:
    index = np.array([0, 1, 2, 5, 6, 9, 10])
    grid = sampling_grid(3.0 + index / 50.0)
    assert grid is not None
    np.testing.assert_array_equal(grid.index, index)
    assert grid.rate_hz == pytest.approx(50.0)
    assert grid.start_s == pytest.approx(3.0)
    assert sampling_grid(np.array([0.0, 1.0, 2.3, 3.0])) is None
    assert sampling_grid(np.array([0.0, 1.0, 0.5])) is None
