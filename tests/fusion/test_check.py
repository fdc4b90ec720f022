"""What `check` says of a recording: contents, components that can be observed, what is missing or wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.recording.check import check, geometric_row, observable
from fusion.recording.load import load_manifest
from fusion.recording.manifest import ChannelEntry

Campaign = Callable[..., Path]


def _rows(*instruments: tuple[tuple[float, ...], tuple[float, ...]]) -> np.ndarray:
    entries = [
        ChannelEntry(name="a", quantity="acceleration", body="load", point=point, direction=direction)
        for point, direction in instruments
    ]
    return np.array([geometric_row(entry) for entry in entries])


def test_one_axis_through_the_origin_sees_one_component() -> None:
    assert observable(_rows(((0, 0, 0.5), (0, 0, 1)))).tolist() == [False, False, True, False, False, False]


def test_one_axis_beside_the_origin_sees_none_alone() -> None:
    assert not observable(_rows(((0.03, 0, 0.04), (0, 0, 1)))).any()


def test_three_parallel_axes_see_one_translation_and_two_tilts() -> None:
    rows = _rows(((0.03, 0, 0), (0, 0, 1)), ((-0.03, 0, 0), (0, 0, 1)), ((0, 0.03, 0), (0, 0, 1)))
    assert observable(rows).tolist() == [False, False, True, True, True, False]


def test_gyroscopes_see_rotation() -> None:
    entry = ChannelEntry(name="g", quantity="angular_velocity", body="load", direction=(0, 2, 0))
    assert geometric_row(entry).tolist() == [0, 0, 0, 0, 1, 0]


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 7), scale=st.sampled_from([1e-3, 1.0, 1e3]))
def test_observable_means_that_no_unseen_motion_moves_it(seed: int, count: int, scale: float) -> None:
    """Independent definition: component i is determined if every motion that no instrument sees leaves it at zero."""
    rng = np.random.default_rng(seed)
    points, directions = rng.integers(-2, 3, (count, 3)) * scale, rng.integers(-1, 2, (count, 3))
    keep = directions.any(axis=1)
    rows = np.hstack([directions, np.cross(points, directions)])[keep].astype(float)
    if len(rows) == 0:
        return
    scaled = rows / np.repeat([1.0, scale], 3)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    unseen = vectors[:, values < 1e-9 * max(values.max(), 1.0)]
    assert observable(rows).tolist() == (np.abs(unseen).max(axis=1, initial=0.0) < 1e-6).tolist()


@pytest.fixture
def recording(make_campaign: Campaign) -> Path:
    """The campaign of the format's example with readable images and one readable DAQ file."""
    folder = make_campaign()
    image = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    for path in folder.glob("top-*/*.tif"):
        tifffile.imwrite(path, image)
    with h5py.File(folder / "vibrometer.h5", "w") as file:
        for name in ("velocity", "camera_trigger"):
            file[name] = np.zeros(1000)
            file[name].attrs["sample_rate"] = 51200.0
    return folder


def test_a_recording_is_described(recording: Path) -> None:
    report = check(load_manifest(recording))
    text = str(report)
    assert "3 frames of 64 x 48 px, grey values up to 4095" in text
    assert "1000 samples at 51200 Hz" in text
    assert "load: stereo top: x y z rx ry rz" in text
    assert "load: laser: no component by itself" in text
    assert "base: stereo base: x y z rx ry rz" in text
    assert "load mass: 6.9605 kg, adapter plate 0.412 kg on the load" in text


def test_what_cannot_be_read_is_wrong(recording: Path) -> None:
    (recording / "top-left" / "0001.tif").write_bytes(b"II*\0")
    problems = check(load_manifest(recording)).problems
    assert any("0001.tif" in problem for problem in problems)
    assert any("bridge.tdms" in problem for problem in problems)
    assert any("result_B1.txt is empty" in problem for problem in problems)


def test_values_that_are_no_numbers_are_wrong(recording: Path) -> None:
    with h5py.File(recording / "vibrometer.h5", "a") as file:
        file["velocity"][3] = np.nan
    assert (
        "daq vibrometer: channel velocity holds values that are no finite numbers"
        in check(load_manifest(recording)).problems
    )


LASER_ONLY = """
format = 1
name = "laser only"
rig = "../rig.toml"
[excitation]
kind = "sine"
direction = [0.0, 1.0, 0.0]
frequencies = [100.0]
[[daq]]
name = "vibrometer"
file = "vibrometer.h5"
  [[daq.channel]]
  name = "velocity"
  quantity = "velocity"
  body = "load"
  point = [0.0, 0.0, 0.0]
  direction = [0.0, 0.0, 1.0]
[[daq]]
name = "drive"
file = "bridge.tdms"
  [[daq.channel]]
  name = "amplifier"
  quantity = "voltage"
"""


def test_what_will_be_missing_is_remarked(make_campaign: Campaign) -> None:
    folder = make_campaign(rig='format = 1\nname = "bare"\n', recording=LASER_ONLY)
    remarks = check(load_manifest(folder)).remarks
    for text in (
        "load: nobody observes x y rx ry rz",
        "base has no instrument",
        "load: nobody observes the driven component Fy",
        "rig.toml has no [load]: no load and no sensitivity",
        "rig.toml has no [sensor]: no sensitivity",
        "rig.toml states no gravity: tilt is not corrected",
        "channel velocity states no uncertainty of its scale: compared with the others, not fused",
        "daq drive shares no trigger channel with another block: its clock cannot be tied",
    ):
        assert text in remarks
