"""The public face of fusion: what it names is there, shown by an example that runs, and costs nothing unused."""

from __future__ import annotations

import doctest
import subprocess
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import fusion
from fusion.cli import COMMANDS
from fusion.recording.excitation import KINDS, Excitation, Kind
from shaker.arrays import brief

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ("Acceleration", "Evaluation", "LoadResult", "Sensitivity")
"""What functions return: their example is the function's."""
NAMES = sorted(set(fusion.__all__) - {"__version__", *RESULTS})


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_has_an_example_that_runs(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    item = getattr(fusion, name)
    own = [test for test in doctest.DocTestFinder(recurse=False).find(item, name) if test.examples]
    assert own, f"{name} has no example"
    assert any(f"from fusion import {name}" in e.source or f", {name}" in e.source for e in own[0].examples)
    told: list[str] = []
    failed, _ = doctest.DocTestRunner(verbose=False).run(own[0], out=told.append)
    assert not failed, "".join(told)


def test_the_names_of_the_package_and_its_example(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert doctest.testmod(fusion).failed == 0
    assert dir(fusion) == fusion.__all__
    assert len(set(fusion.__all__)) == len(fusion.__all__)
    assert all(getattr(fusion, name).__doc__ for name in RESULTS)
    assert fusion.__version__[0].isdigit()
    with pytest.raises(AttributeError, match="No fusion attribute nothing"):
        _ = fusion.nothing


def test_importing_the_package_loads_nothing_else():
    code = "import fusion, sys; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "scipy", "importlib.metadata", "fusion.base"} & set(found)


def test_a_path_may_be_a_text(tmp_path):
    (recording,) = fusion.find_recordings(str(ROOT / "sample_images" / "demo"))
    assert fusion.load_manifest(str(recording)) == fusion.load_manifest(recording)
    with pytest.raises(fusion.InputError, match="nothing at this path"):
        fusion.find_recordings(str(tmp_path / "none"))
    with pytest.raises(fusion.InputError, match="nothing at this path"):
        fusion.run_path(str(tmp_path / "none"), str(tmp_path), fusion.Settings())


def test_results_print_on_one_line(demo_evaluation):
    for result in (demo_evaluation, demo_evaluation.sensitivity, demo_evaluation.stereo[0]):
        assert repr(result) == brief(result)
        assert len(repr(result)) < 1500
    assert "value=array (3, 6, 6)" in repr(demo_evaluation.sensitivity)
    assert repr(demo_evaluation.manifest).startswith("Manifest('Fz 80.0 Hz, simulated', sine, ")


@pytest.mark.slow
def test_the_example_of_the_readme():
    from fusion import evaluate_recording, find_recordings, load_manifest

    (recording,) = find_recordings(str(ROOT / "sample_images" / "demo"))
    evaluation = evaluate_recording(load_manifest(recording))
    assert np.isfinite(evaluation.sensitivity.value[:, 2, 2]).any()
    assert evaluation.input_hashes == {}


def test_every_kind_of_excitation_is_evaluated_by_commands_that_exist():
    assert set(KINDS) == set(get_args(Kind))
    commands = {command.name for command in COMMANDS}
    for kind in KINDS.values():
        assert kind.commands
        assert set(kind.commands) <= commands
        assert {*kind.required, *kind.allowed} <= set(Excitation.model_fields) - {"kind"}
