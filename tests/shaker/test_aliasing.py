"""Aliases, exposure, lines that fold and the rates that cure it: formulas, the published case, exhaustive search."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.sine.aliasing import (
    CLEAR_BINS,
    alias_frequency,
    beat_phase,
    condition_number,
    exposure_gain,
    folded_harmonics,
    nearest_clear_rate,
    sampling_grid,
    separation_bins,
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


STEP_HZ = 0.01
LINES = st.lists(st.integers(2, 120), min_size=1, max_size=4, unique=True).map(
    lambda tenths: 8.0 * np.array(tenths, dtype=np.float64)
)


def _first_clear(lines: np.ndarray, rate: float, frames: int) -> float | None:
    """Look at every multiple of the step within a fifth of the rate, nearest first, written with complex phases."""
    steps = np.arange(np.ceil(0.8 * rate / STEP_HZ), np.floor(1.2 * rate / STEP_HZ) + 1) * STEP_HZ
    for candidate in sorted(steps, key=lambda r: abs(r - rate)):
        turns = np.concatenate([[0.0], lines, -lines]) / candidate
        angle = np.abs(np.angle(np.exp(2j * np.pi * np.subtract.outer(turns, turns))))[~np.eye(len(turns), dtype=bool)]
        if angle.min() >= 2.0 * np.pi * CLEAR_BINS / frames:
            return float(candidate)
    return None


@settings(max_examples=60, deadline=None)
@given(LINES, st.floats(20.0, 90.0), st.integers(20, 300))
def test_nearest_clear_rate_is_that_of_an_exhaustive_search(lines: np.ndarray, rate: float, frames: int) -> None:
    found = nearest_clear_rate(lines, rate, frames, step_hz=STEP_HZ)
    expected = _first_clear(lines, rate, frames)
    assert (found is None) == (expected is None)
    if found is not None and expected is not None:
        assert abs(found - rate) == pytest.approx(abs(expected - rate), abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(LINES, st.floats(20.0, 90.0), st.integers(40, 300), st.booleans())
def test_a_clear_rate_makes_every_line_usable(lines: np.ndarray, rate: float, frames: int, drift: bool) -> None:
    found = nearest_clear_rate(lines, rate, frames)
    if found is None:
        return
    mask, notices = usable_lines(np.arange(frames) / found, lines, drift=drift)
    assert mask.all()
    assert not notices
    assert np.linalg.cond(sine_columns(np.arange(frames) / found, lines)) < 3.3


@settings(max_examples=60, deadline=None)
@given(LINES, st.floats(20.0, 90.0), st.integers(20, 300), st.data())
def test_separation_is_that_of_the_aliases(lines: np.ndarray, rate: float, frames: int, data: st.DataObject) -> None:
    turns = data.draw(st.lists(st.integers(0, 9), min_size=len(lines), max_size=len(lines)))
    moved = lines + rate * np.array(turns)
    assert separation_bins(moved, rate, frames) == pytest.approx(
        separation_bins(lines, rate, frames), abs=1e-7 * frames
    )


def test_the_present_rate_is_kept_where_it_is_clear() -> None:
    with pytest.raises(ValueError, match="rate_hz, step_hz: expected numbers above 0, found -1"):
        nearest_clear_rate(np.array([100.0]), -1.0, 211)
    assert nearest_clear_rate(106.25 * np.arange(1, 6), 52.874, 211) == 52.874


def test_a_line_below_the_resolution_of_any_near_rate_has_no_cure() -> None:
    assert nearest_clear_rate(np.array([100.0, 100.01]), 53.0, 211) is None
    # Halving the rate doubles the record, but nobody would call it the same measurement.
    assert nearest_clear_rate(np.array([0.2]), 53.0, 211) is None
    assert nearest_clear_rate(np.array([0.2]), 53.0, 211, max_change=0.9) == pytest.approx(33.76)


def test_the_notice_of_a_dropped_line_names_the_cure() -> None:
    lines = 106.25 * np.arange(1, 6)
    mask, notices = usable_lines(np.arange(211) / 53.125, lines)
    assert not mask.any()
    assert "a camera rate of 52.968 Hz (-0.157 Hz) would separate all lines" in notices[0].text
    assert usable_lines(np.arange(211) / 52.968, lines)[0].all()


def test_where_not_all_lines_can_be_separated_the_notice_cures_the_one_it_names() -> None:
    time = np.arange(211) / 53.125
    _, notices = usable_lines(time, np.array([70.0, 106.25, 70.001]))
    cure = {notice.where: notice.text.rpartition("; ")[2] for notice in notices}
    assert cure["106.25 Hz"].endswith("would separate it")
    assert "camera rate of" not in cure["70.001 Hz"]
