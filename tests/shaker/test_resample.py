"""Band-limited interpolation against sines that are known everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaker.timebase.edges import PASS_BAND, kernel_reach, resampled


@settings(max_examples=25, deadline=None)
@given(
    share=st.floats(0.2, 1.0),
    place=st.floats(0.0, PASS_BAND),
    phase=st.floats(0.0, 6.3),
    stretch=st.floats(-1e-3, 1e-3),
)
def test_a_line_in_the_pass_band_keeps_amplitude_and_phase(
    share: float, place: float, phase: float, stretch: float
) -> None:
    time, reach = np.arange(3000.0), kernel_reach(share)
    position = np.arange(reach + 0.3, 3000 - reach, (1.0 + stretch) / share)
    found = resampled(np.cos(2.0 * np.pi * place * share * time + phase), position, share)
    np.testing.assert_allclose(found, np.cos(2.0 * np.pi * place * share * position + phase), atol=3e-5)


@pytest.mark.parametrize("place", [0.6, 0.75, 0.95])
def test_what_would_fold_into_the_pass_band_is_taken_out(place: float) -> None:
    time, reach = np.arange(3000.0), kernel_reach(0.5)
    found = resampled(np.cos(np.pi * place * time), np.arange(reach + 0.3, 3000 - reach, 2.0), 0.5)
    assert np.abs(found).max() < 2e-5


def test_samples_are_met_and_positions_beyond_the_record_refused() -> None:
    samples = np.random.default_rng(1).standard_normal(200)
    reach = kernel_reach(1.0)
    place = np.arange(reach, 200 - reach).astype(float)
    np.testing.assert_allclose(resampled(samples, place), samples[reach : 200 - reach], atol=1e-12)
    with pytest.raises(ValueError, match="position: expected"):
        resampled(samples, np.array([199.0]))
    with pytest.raises(ValueError, match="share: expected a number above 0"):
        resampled(samples, place, 1.5)
