"""Public names: running examples, fast import, paths as texts, short representations."""

from __future__ import annotations

import doctest
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import get_args

import numpy as np
import pytest
from contracts import refused

import fusion
import photogram
import shaker
from fusion.cli import commands
from fusion.recording.excitation import KINDS, ExcitationEntry, Kind
from fusion.recording.recording_notices import NO_RECORDING
from photogram.camera import Points3D

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ("Acceleration", "Evaluation", "LoadResult", "Sensitivity")
"""Results of fusion's functions, with the examples of these."""
PACKAGES = (photogram, shaker, fusion)
SHOWN = [(package, name) for package in PACKAGES for name in package.__all__ if name not in ("__version__", *RESULTS)]
PLAIN = {"np": np, **{name: getattr(photogram, name) for package, name in SHOWN if package is photogram}}
"""Names that examples of photogram do not import."""


@pytest.mark.parametrize(("package", "name"), SHOWN, ids=[f"{package.__name__}.{name}" for package, name in SHOWN])
def test_every_public_name_has_an_example_that_runs(package, name, monkeypatch):
    monkeypatch.chdir(ROOT)
    plain = package is photogram
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(getattr(package, name), name, globs=PLAIN if plain else None)
    assert example.examples, f"{name} has no example"
    imported = (f"from {package.__name__} import {name}", f", {name}")
    assert plain or any(words in line.source for line in example.examples for words in imported)
    printed: list[str] = []
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.NORMALIZE_WHITESPACE if plain else 0)
    assert not runner.run(example, out=printed.append).failed, "".join(printed)


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_has_the_names_of_its_table_and_a_fast_import(package: ModuleType) -> None:
    assert (dir(package), len(set(package.__all__))) == (package.__all__, len(package.__all__))
    assert package.__version__ == version("shakercal")
    with pytest.raises(AttributeError, match=f"No {package.__name__} attribute absent"):
        _ = package.absent
    code = f"import {package.__name__}, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    heavy = {"numpy", "numba", "torch", "cv2", "scipy", "importlib.metadata", "fusion.base", "shakercal._common.arrays"}
    assert not heavy & set(loaded)


def test_the_example_of_fusion_runs_and_its_results_are_described(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert doctest.testmod(fusion).failed == 0
    assert all(getattr(fusion, name).__doc__ for name in RESULTS)


@pytest.mark.parametrize(
    "reader", ["open_sequence", "read_image", "read_calibration", "import_calibration", "read_point_tables"]
)
def test_readers_of_images_and_cameras_take_texts_as_paths(reader, tmp_path):
    path = str(tmp_path / "missing.png")
    arguments = {"open_sequence": ([path],), "read_point_tables": ([path], ("x", "y", "z"))}.get(reader, (path,))
    refused("missing", getattr(photogram, reader), *arguments, error=FileNotFoundError)


def test_readers_of_signals_and_campaigns_take_texts_as_paths(tmp_path):
    file, none = tmp_path / "daq.csv", str(tmp_path / "none.csv")
    file.write_text("time,Fz\ns,N\n0.0,1.0\n0.5,2.0\n")
    np.testing.assert_array_equal(shaker.read_channels(str(file))["Fz"].samples, [1.0, 2.0])
    refused(r"none\.csv", shaker.read_channels, none, error=FileNotFoundError)
    (recording,) = fusion.find_recordings(str(ROOT / "sample_images" / "demo"))
    assert fusion.load_manifest(str(recording)) == fusion.load_manifest(recording)
    for call, *others in ((fusion.find_recordings,), (fusion.run_path, str(tmp_path), fusion.Settings())):
        refused(NO_RECORDING.code, call, none, *others, error=fusion.InputError)


def test_a_command_that_evaluates_no_recordings_is_refused():
    refused(
        "^command: .*run, transfer",
        fusion.load_for_command,
        [str(ROOT / "sample_images" / "demo")],
        "plan",
        error=ValueError,
    )


def test_results_of_photogram_print_on_one_line_with_sizes():
    points = Points3D(np.zeros((3, 40, 3)), np.zeros((3, 40, 3, 3)), np.zeros((3, 40)))
    assert repr(points) == "Points3D(position_m (3, 40, 3), covariance_m2 (3, 40, 3, 3), reprojection_px (3, 40))"
    camera = photogram.Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    pose = photogram.RigidTransform.identity()
    for item in (camera, photogram.StereoRig(camera, camera, pose), pose):
        assert "\n" not in repr(item)
        assert len(repr(item)) < 200


@pytest.mark.slow
def test_the_example_of_the_readme():
    from fusion import evaluate_recording, find_recordings, load_manifest

    (recording,) = find_recordings(str(ROOT / "sample_images" / "demo"))
    evaluation = evaluate_recording(load_manifest(recording))
    assert np.isfinite(evaluation.sensitivity.value[:, 2, 2]).any()
    assert evaluation.input_hashes == {}


def test_every_kind_of_excitation_is_evaluated_by_commands_that_exist():
    assert set(KINDS) == set(get_args(Kind))
    names = {command.name for command in commands()}
    for kind in KINDS.values():
        assert kind.commands
        assert set(kind.commands) <= names
        assert {*kind.required, *kind.allowed} <= set(ExcitationEntry.model_fields) - {"kind"}
