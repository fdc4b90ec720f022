"""Errors against stated uncertainties with every systematic error drawn, from tracks and from rendered recordings."""

from __future__ import annotations

from pathlib import Path

import coverage_rendered
import coverage_tracks
import numpy as np
import pytest
from scipy.stats import binom

TRIALS = 12


@pytest.mark.slow
@pytest.mark.parametrize("case", coverage_tracks.CASES, ids=lambda case: case.name)
def test_regions_hold_the_truth_from_tracks_and_channels(case: coverage_tracks.Case) -> None:
    counts = coverage_tracks.run_case(case, range(1, TRIALS + 1))
    for quantity in (counts.acceleration, counts.load, counts.sensitivity):
        for tally in quantity:
            # 95 % regions of a dozen independent recordings: fewer hits happen once in 100 000 components
            assert not tally.errors or np.sum(tally.covered) >= binom.ppf(1e-5, len(tally.errors), 0.95)
    driven = counts.sensitivity[case.driven]
    assert np.max(np.abs(driven.normalised)) < 4.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_rendered_recordings_err_as_they_state(seed: int, tmp_path: Path) -> None:
    found = coverage_rendered.evaluate_seed(seed, tmp_path / "campaign")
    assert len(found.all) == 36
    assert np.max(np.abs(found.all)) < 4.5
    # all 36 share the recording's few systematic errors, so that the benchmark's 90 % holds for many recordings only
    assert np.mean(np.abs(found.all) < 2.0) > 0.7
