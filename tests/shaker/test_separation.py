"""The nearest clear rate against a search through all rates, and against the design matrices themselves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.lines.aliasing import CLEAR_BINS, nearest_clear_rate, separation_bins, sine_columns, usable_lines

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
    assert nearest_clear_rate(106.25 * np.arange(1, 6), 52.874, 211) == 52.874


def test_a_line_below_the_resolution_of_any_near_rate_has_no_cure() -> None:
    assert nearest_clear_rate(np.array([100.0, 100.01]), 53.0, 211) is None
    # Halving the rate doubles the record, but nobody would call it the same measurement.
    assert nearest_clear_rate(np.array([0.2]), 53.0, 211) is None
    assert nearest_clear_rate(np.array([0.2]), 53.0, 211, max_change=0.9) == pytest.approx(33.76)


def test_rates_and_steps_must_be_positive() -> None:
    with pytest.raises(ValueError, match="rate_hz, step_hz: expected numbers above 0, found -1"):
        nearest_clear_rate(np.array([100.0]), -1.0, 211)


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
