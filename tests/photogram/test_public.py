"""The public face: every name has a runnable example, importing is free, paths may be texts, results print briefly."""

from __future__ import annotations

import doctest
import subprocess
import sys

import numpy as np
import pytest
from contracts import refused

import photogram
from photogram import Camera, RigidTransform
from photogram.camera import Points

NAMES = [name for name in photogram.__all__ if name != "__version__"]


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_has_an_example_that_runs(name):
    public = {each: getattr(photogram, each) for each in NAMES}
    (example,) = doctest.DocTestFinder(recurse=False).find(public[name], name, globs={"np": np, **public})
    assert example.examples, f"{name} has no example"
    failures = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example)
    assert failures.failed == 0


def test_importing_costs_nothing():
    heavy = "[m for m in ('numpy', 'numba', 'torch', 'cv2', 'scipy') if m in sys.modules]"
    code = f"import sys, photogram; print({heavy}, photogram.__version__)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.startswith("[] ")
    assert out.split()[1][0].isdigit()


def test_an_unknown_name_is_refused_and_known_ones_are_listed():
    with pytest.raises(AttributeError, match="No photogram attribute nothing"):
        _ = photogram.nothing
    assert dir(photogram) == photogram.__all__


@pytest.mark.parametrize(
    "reader", ["open_sequence", "read_picture", "read_calibration", "import_calibration", "read_point_tables"]
)
def test_readers_take_texts_as_paths(reader, tmp_path):
    read, path = getattr(photogram, reader), str(tmp_path / "missing.png")
    arguments = {"open_sequence": ([path],), "read_point_tables": ([path], ("x", "y", "z"))}.get(reader, (path,))
    refused("missing", read, *arguments, error=FileNotFoundError)


def test_results_print_in_one_line_with_sizes():
    points = Points(np.zeros((3, 40, 3)), np.zeros((3, 40, 3, 3)), np.zeros((3, 40)))
    assert repr(points) == "Points(position_m (3, 40, 3), covariance_m2 (3, 40, 3, 3), reprojection_px (3, 40))"
    camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    rig = photogram.StereoRig(camera, camera, RigidTransform.identity())
    for item in (camera, rig, RigidTransform.identity()):
        assert "\n" not in repr(item)
        assert len(repr(item)) < 200
