"""Where channels measure: uncertain places and directions by the names that a run gives them, for each mounting."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fusion.estimation.measurement_model import ChainUncertainty, Reading, observe_channels
from fusion.recording.manifest import ChannelEntry
from fusion.sensor.identify.measured import sight, placement_errors
from shaker.identification.measured import AT_THE_BASE, Placement, PlacementError
from shaker.sine.phasor import Phasors

UNSURE: dict[str, Any] = {
    "point_uncertainty": [1e-3, 2e-3, 3e-3],
    "direction_uncertainty": 5e-3,
    "transverse_sensitivity": 0.02,
}


def _entry(name: str, body: str, **keys: Any) -> ChannelEntry:
    """A channel that looks somewhere between the axes."""
    stated = {"name": name, "quantity": "acceleration", "body": body, "point": [0.1, -0.02, 0.05]}
    return ChannelEntry.model_validate({**stated, "direction": [0.6, 0.0, 0.8], **UNSURE, **keys})


def _by_name(errors: tuple[PlacementError, ...]) -> dict[str, PlacementError]:
    found = {error.name: error for error in errors}
    assert len(found) == len(errors)
    return found


def test_rows_change_as_the_place_and_the_direction_do() -> None:
    entry = _entry("top", "load")
    seen = sight(entry)
    found = _by_name(placement_errors(_entry("base", "base"), [entry], "1"))
    for axis, u in enumerate(UNSURE["point_uncertainty"]):
        moved = Placement(seen.point_m + u * np.eye(3)[axis], seen.direction)
        change = found[f"top: point top at (0.1, -0.02, 0.05) {'xyz'[axis]} [1]"].change
        np.testing.assert_allclose(change, moved.row - seen.row, atol=1e-15)
    tilts = [error.change for name, error in found.items() if name.startswith("top: direction")]
    assert [float(np.linalg.norm(tilt[:3])) for tilt in tilts] == pytest.approx([5e-3] * 2)
    for tilt in tilts:
        turned = (seen.direction + tilt[:3]) / np.linalg.norm(seen.direction + tilt[:3])
        np.testing.assert_allclose(tilt, Placement(seen.point_m, turned).row - seen.row, atol=3e-5)
    leaks = [error.change for name, error in found.items() if name.startswith("top: transverse")]
    assert [float(np.linalg.norm(leak[:3])) for leak in leaks] == pytest.approx([0.02 / np.sqrt(2.0)] * 2)


def test_unknowns_have_the_names_and_signs_of_a_run() -> None:
    entry = _entry("top", "load", common="crystal")
    frequency = np.array([1000.0])
    phasors = Phasors(frequency, np.ones((1, 1), complex), np.eye(2)[None], ("top",), ("m/s2",), np.full(1, np.inf))
    (observed,) = observe_channels([Reading(entry, phasors, ChainUncertainty())])
    placed = {f"{error.name} [B]": error.slope[0, 0] for error in observed.common if error.scope == "mounting"}
    found = {
        name: error.change for name, error in _by_name(placement_errors(entry, [], "B")).items() if np.any(error.change)
    }
    assert set(found) == set(placed)
    for name, change in found.items():
        np.testing.assert_allclose(change, placed[name].real, atol=1e-15)


def test_another_mounting_is_another_unknown_and_what_is_exact_is_none() -> None:
    base, top = _entry("base", "base"), _entry("top", "load")
    first, again, anew = (placement_errors(base, [top], mounting) for mounting in ("1", "1", "2"))
    assert [error.name for error in first] == [error.name for error in again]
    assert not {error.name for error in first} & {error.name for error in anew}
    assert {error.place for error in first} == {AT_THE_BASE, 0}
    exact = {"point_uncertainty": 0.0, "direction_uncertainty": 0.0, "transverse_sensitivity": 0.0}
    assert placement_errors(_entry("base", "base", **exact), [_entry("top", "load", **exact)], "1") == ()


def test_a_gyroscope_reads_how_the_body_turns_wherever_it_is() -> None:
    keys = {"name": "gyro", "quantity": "angular_velocity", "body": "load", "direction": [0.0, 1.0, 0.0]}
    entry = ChannelEntry.model_validate({**keys, "direction_uncertainty": 5e-3})
    assert sight(entry).row.tolist() == [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    errors = placement_errors(entry, [], "1")
    assert [error.name for error in errors] == [f"gyro: direction gyro along (0, 1, 0) {axis} [1]" for axis in (0, 1)]
    for error in errors:
        assert not np.any(error.change[:3])
        assert float(np.linalg.norm(error.change[3:])) == pytest.approx(5e-3)
        assert error.change[4] == pytest.approx(0.0, abs=1e-15)
