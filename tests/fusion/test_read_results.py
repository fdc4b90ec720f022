"""Results read back: what a campaign evaluates from files is what the recordings were evaluated to, to the last bit."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from evaluation_factory import STATIC, Choice, make_evaluation

from fusion.base import InputError
from fusion.campaign.repeats import drives_of
from fusion.estimation.uncertainty import Influence, Uncertainty
from fusion.report.h5 import read_drives, read_recorded
from fusion.report.recording import recording as results
from fusion.report.recording import write_results
from fusion.sensitivity.analyse import Evaluation


@pytest.fixture
def write(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Return a function that writes an evaluation without figures and returns the folder."""
    monkeypatch.setattr(results, "render_report", lambda _: "<!doctype html>\n")

    def written(evaluation: Evaluation) -> Path:
        write_results(evaluation, tmp_path / "out")
        return tmp_path / "out"

    return written


def identical(first: Any, second: Any) -> bool:
    """Whether two trees of data classes hold the same types, texts and bits."""
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
    if dataclasses.is_dataclass(first):
        names = [field.name for field in dataclasses.fields(first)]
        return type(first) is type(second) and all(identical(getattr(first, n), getattr(second, n)) for n in names)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(identical, first, second))
    return type(first) is type(second) and first == second


def with_clock(item: Any, seed: int) -> Any:
    """Load or outputs with two unknowns, one of which both have."""
    lines, size = item.uncertainty.random[0].covariance.shape[:2]
    effect = np.random.default_rng(seed).standard_normal((2, lines, size))
    shared = Influence("clock bridge: time", "clock", 1e-7, "s", effect[0], "recording")
    own = Influence(f"scale {seed}", "scale", 2.5e-4, "1", effect[1], "rig")
    return dataclasses.replace(item, uncertainty=Uncertainty(item.uncertainty.random, (shared, own)))


def test_drives_are_read_back_to_the_last_bit(write: Any, tmp_path: Path) -> None:
    plain = make_evaluation(tmp_path, Choice(frames=24, images=False, mounting="second"))
    evaluation = dataclasses.replace(plain, load=with_clock(plain.load, 1), outputs=with_clock(plain.outputs, 2))
    drives = drives_of(evaluation)
    assert [drive.mounting for drive in drives] == ["second"]
    assert [influence.name for influence in drives[0].outputs_uncertainty.influences] == [
        "clock bridge: time",
        "scale 2",
    ]
    assert identical(drives, read_drives(write(evaluation)))


def test_sensor_excitation_and_notices_are_read_back(write: Any, tmp_path: Path) -> None:
    evaluation = make_evaluation(tmp_path, Choice(frames=24, images=False))
    found = read_recorded(write(evaluation))
    assert (found.folder, found.name, found.mounting, found.kind) == ("out", "Fz 106.25 Hz", "1", "sine")
    assert (found.direction, found.frequencies) == ((0.0, 0.0, 1.0), (106.25,))
    assert found.sensor is not None
    assert np.array_equal(np.asarray(found.sensor.static), STATIC)
    assert (found.sensor.serial, found.sensor.unit, found.sensor.u_static) == ("0815", "V/V", 1e-3)
    assert [notice.severity for notice in found.notices] == [notice.severity for notice in evaluation.notices]
    assert found.origin.input_hashes == evaluation.input_hashes


def test_a_recording_without_sensor_has_no_drives(write: Any, tmp_path: Path) -> None:
    found = read_recorded(write(make_evaluation(tmp_path, Choice(sensor=False, images=False))))
    assert found.sensor is None
    assert found.drives == ()


def test_a_recording_without_notices(write: Any, tmp_path: Path) -> None:
    bare = dataclasses.replace(make_evaluation(tmp_path, Choice(images=False)), notices=())
    assert read_recorded(write(bare)).notices == ()


def test_results_of_another_format_are_refused(write: Any, tmp_path: Path) -> None:
    folder = write(make_evaluation(tmp_path, Choice(sensor=False, images=False)))
    with h5py.File(folder / "result.h5", "r+") as file:
        file.attrs["format"] = 1
    with pytest.raises(InputError, match="--force evaluates the recording anew"):
        read_recorded(folder)
    with pytest.raises(InputError, match="no results"):
        read_recorded(tmp_path)
