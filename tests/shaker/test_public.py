"""The public face of shaker: what it names is there, shown by an example that runs, and costs nothing unused."""

import doctest
import subprocess
import sys

import numpy as np
import pytest

import shaker

NAMES = sorted(set(shaker.__all__) - {"__version__"})


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_has_an_example_that_runs(name):
    item = getattr(shaker, name)
    own = [test for test in doctest.DocTestFinder(recurse=False).find(item, name) if test.examples]
    assert own, f"{name} has no example"
    assert any(f"from shaker import {name}" in e.source or f", {name}" in e.source for e in own[0].examples)
    told: list[str] = []
    failed, _ = doctest.DocTestRunner(verbose=False).run(own[0], out=told.append)
    assert not failed, "".join(told)


def test_names_are_those_of_the_table():
    assert (dir(shaker), len(set(shaker.__all__))) == (shaker.__all__, len(shaker.__all__))
    assert shaker.__version__[0].isdigit()
    with pytest.raises(AttributeError, match="No shaker attribute nothing"):
        _ = shaker.nothing


def test_importing_the_package_loads_nothing_else():
    code = "import shaker, sys; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "scipy", "importlib.metadata", "shaker.arrays"} & set(found)


def test_a_path_may_be_a_text(tmp_path):
    file = tmp_path / "daq.csv"
    file.write_text("time,Fz\ns,N\n0.0,1.0\n0.5,2.0\n")
    np.testing.assert_array_equal(shaker.read_channels(str(file))["Fz"].samples, [1.0, 2.0])
    with pytest.raises(FileNotFoundError, match="expected a file, found none"):
        shaker.read_channels(str(tmp_path / "none.csv"))
