"""A body that lies elsewhere from some frame on, against motion that is only sines, noise and drift."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import evaluated

from fusion.errors import ComputeError
from fusion.phasors.phasor_notices import BODY_DISPLACED, BODY_LOST, PAIR_REJECTED, TOO_FEW_FRAMES_FOR_STEP
from fusion.phasors.stereo_phasors import _step
from fusion.simulate import simulate

FREQUENCY_HZ = np.array([106.25, 212.5])


def motion(seed: int, frames: int = 60, noise_m: float = 1e-7, drift_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Times (F,) and positions (F, 3) of a body that is driven with 20 um along z, and creeps."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(frames) / 52.874
    position = noise_m * rng.normal(size=(frames, 3))
    for frequency, amplitude in zip(FREQUENCY_HZ, (2e-5, 1e-6), strict=True):
        position[:, 2] += amplitude * np.sin(2 * np.pi * frequency * time_s + rng.uniform(0, 6))
    position[:, 0] += drift_m * (1 - np.exp(-2 * time_s / time_s[-1]))
    return time_s, position


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), frames=st.integers(11, 200), drift_m=st.sampled_from([0.0, 1e-6, 1e-5]))
def test_sines_noise_and_drift_are_no_step(seed, frames, drift_m):
    assert _step("top", *motion(seed, frames, drift_m=drift_m), FREQUENCY_HZ) == []


@pytest.mark.parametrize("at", [2, 5, 30, 58])
@pytest.mark.parametrize("axis", [0, 2])
def test_a_step_beyond_all_motion_is_refused_with_its_frames(at, axis):
    time_s, position = motion(1)
    position[at:, axis] += 8e-3
    with pytest.raises(ComputeError) as error:
        _step("top", time_s, position, FREQUENCY_HZ)
    assert error.value.code == BODY_LOST.code
    assert error.value.values == {"distance_mm": pytest.approx(8.0, rel=1e-4), "before": at - 1, "after": at}


def test_a_small_step_is_told():
    time_s, position = motion(2)
    position[25:, 0] += 1e-5
    (notice,) = _step("top", time_s, position, FREQUENCY_HZ)
    assert (notice.code, notice.severity) == (BODY_DISPLACED.code, "warning")
    assert notice.values == {"distance_mm": pytest.approx(0.00996, abs=5e-6), "before": 24, "after": 25}


def test_frames_too_few_to_tell_are_told():
    (notice,) = _step("top", *motion(1, 8), FREQUENCY_HZ)
    needed = 2 * len(FREQUENCY_HZ) + 7
    assert (notice.code, notice.severity) == (TOO_FEW_FRAMES_FOR_STEP.code, "note")
    assert notice.values == {"frames": 8, "needed": needed}
    assert _step("top", *motion(1, needed), FREQUENCY_HZ) == []


def test_lost_frames_keep_their_numbers():
    time_s, position = motion(3)
    position[[4, 20]] = np.nan
    position[21:, 1] -= 5e-3
    with pytest.raises(ComputeError) as error:
        _step("top", time_s, position, FREQUENCY_HZ)
    assert error.value.code == BODY_LOST.code
    assert (error.value.values["before"], error.value.values["after"]) == (19, 21)


@pytest.mark.slow
def test_a_displaced_pair_is_left_out_by_name(tmp_path):
    recording = simulate(tmp_path / "sweep", "sweep", 1, recordings=1)
    table = recording / "points-top.csv"
    head, *rows = table.read_text().splitlines()
    # One period of a foil of 8 mm, from frame 20 on.
    cells = [row.split(",") for row in rows]
    moved = [[*c[:2], f"{float(c[2]) + 8.0 * (int(c[0]) >= 20):.6f}", *c[3:]] for c in cells]
    table.write_text("\n".join([head, *(",".join(row) for row in moved)]) + "\n")
    evaluation = evaluated(recording)
    assert [result.name for result in evaluation.stereo] == ["base"]
    (rejected,) = [notice for notice in evaluation.notices if notice.code == PAIR_REJECTED.code]
    assert "top" in rejected.where.split()
    assert {"8", "19", "20"} <= set(re.findall(r"\d+", rejected.values["reason"]))
