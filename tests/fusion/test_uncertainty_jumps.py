"""A recording whose U is several times that of its neighbours is named with its largest influence."""

from __future__ import annotations

import numpy as np
import pytest
from excited_line_factory import make_excited_line, uncertainty

from fusion.campaign.campaign_notices import UNCERTAINTY_JUMP
from fusion.campaign.recording_results import RecordingResults
from fusion.campaign.uncertainty_jumps import uncertainty_jumps
from fusion.report.folder import Provenance

LOAD = np.array([0.0, 0.0, 100.0, 0.0, 0.0, 0.0])
ALONG_Z = (0.0, 0.0, 1.0)


def recorded(folder: str, frequency_hz: float, noise: float, clock: float) -> RecordingResults:
    """A recording of a load of 100 N with relative noise and relative effect of a clock on its output."""
    of_load = uncertainty(np.full(6, 100.0 * noise))
    of_output = uncertainty(np.full(1, 1e-9), [("clock rate", "recording", np.array([2e-5 * clock]))])
    line = make_excited_line(
        LOAD, [2e-5], of_load, of_output, recording=folder, frequency_hz=frequency_hz, channels=("Fz",)
    )
    origin = Provenance({}, {}, {}, ())
    return RecordingResults(folder, folder, "1", "rig", "sine", ALONG_Z, (frequency_hz,), None, (line,), (), origin)


def sweep(clocks: dict[str, float], frequency_hz: tuple[float, ...]) -> list[RecordingResults]:
    return [recorded(name, f, 1e-3, clock) for (name, clock), f in zip(clocks.items(), frequency_hz, strict=True)]


def test_the_recording_is_named_with_its_folder_and_its_largest_influence() -> None:
    clocks = {"Fz-100": 1e-4, "Fz-200": 1e-4, "Fz-300": 7e-3, "Fz-400": 1e-4, "Fz-500": 1e-4}
    (notice,) = uncertainty_jumps(sweep(clocks, (100.0, 200.0, 300.0, 400.0, 500.0)), None, None)
    assert (notice.code, notice.where) == (UNCERTAINTY_JUMP.code, "Fz-300")
    assert notice.values["influence"] == "clock rate"
    usual, jumped = (float(np.linalg.norm([1e-3, 1e-9 / 2e-5, clock])) for clock in (1e-4, 7e-3))
    assert notice.values["factor"] == pytest.approx(jumped / usual, rel=1e-3)
    assert notice.values["U_percent"] == pytest.approx(200.0 * jumped, rel=1e-3)
    assert notice.values["share_percent"] == pytest.approx(100.0 * (7e-3 / jumped) ** 2, rel=1e-3)


@pytest.mark.parametrize(("clock", "named"), [(2.7e-3, False), (3.2e-3, True)])
def test_the_limit_is_three_times_the_median_of_the_neighbours(clock: float, named: bool) -> None:
    clocks = {"a": 0.0, "b": clock, "c": 0.0}
    found = list(uncertainty_jumps(sweep(clocks, (100.0, 200.0, 300.0)), None, None))
    assert bool(found) == named


def test_repeats_at_one_frequency_do_not_hide_each_other() -> None:
    clocks = {"a": 0.0, "b": 9e-3, "c": 9e-3, "d": 9e-3, "e": 0.0}
    found = uncertainty_jumps(sweep(clocks, (100.0, 200.0, 200.0, 200.0, 300.0)), None, None)
    assert [notice.where for notice in found] == ["b", "c", "d"]


def test_recordings_at_one_frequency_are_compared_with_each_other_and_two_are_not() -> None:
    three = sweep({"a": 0.0, "b": 9e-3, "c": 0.0}, (100.0, 100.0, 100.0))
    assert [notice.where for notice in uncertainty_jumps(three, None, None)] == ["b"]
    assert list(uncertainty_jumps(three[:2], None, None)) == []
