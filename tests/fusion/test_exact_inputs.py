"""Inputs without a stated uncertainty: named by the list, the notice, `check` and the draft."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from support import edit

from fusion.planning.check import check
from fusion.recording.load import load_manifest
from fusion.sensitivity.exact_inputs import exact_inputs, exact_inputs_notice


@pytest.fixture
def demo(demo_recording: Path, tmp_path: Path) -> Path:
    """A copy of the demo, which states every uncertainty."""
    return Path(shutil.copytree(demo_recording, tmp_path / "demo"))


def _without(path: Path, key: str, count: int = 0) -> None:
    """Remove lines of a key from a file; all of them without a count."""
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(rf"^{key} = .*\n", "", text, count=count, flags=re.MULTILINE), encoding="utf-8")


def _exact(demo: Path) -> str:
    manifest = load_manifest(demo / "Fz-0080")
    return exact_inputs(manifest, [entry for daq in manifest.daq for entry in daq.channel])


def test_a_recording_that_states_everything_has_no_exact_input(demo: Path) -> None:
    assert _exact(demo) == ""
    manifest = load_manifest(demo / "Fz-0080")
    assert not list(exact_inputs_notice(manifest, [entry for daq in manifest.daq for entry in daq.channel]))


def test_inputs_without_uncertainty_are_named_by_quantity(demo: Path) -> None:
    recording, rig = demo / "Fz-0080" / "recording.toml", demo / "rig.toml"
    for key in ("response", "scale_uncertainty", "individual_uncertainty", "point_uncertainty"):
        _without(recording, key)
    for key in ("pose_uncertainty", "pose_by_calibration", "inertia_uncertainty"):
        _without(rig, key)
    lasers, outputs = "velocity_1, velocity_2, velocity_3", "Fx, Fy, Fz, Mx, My"
    assert _exact(demo) == (
        f"scale of {lasers}, {outputs} and 1 more; pose of top; point of {lasers}; inertia of load, adapter plate"
    )
    remarks = check(load_manifest(demo / "Fz-0080")).remarks
    assert f"counted as exact, no uncertainty stated: {_exact(demo)}" in remarks


def test_a_zero_is_no_uncertainty(demo: Path) -> None:
    edit(demo / "rig.toml", "internal_mass_uncertainty = 0.0005", "internal_mass_uncertainty = 0.0")
    assert _exact(demo) == "mass of internal mass"
