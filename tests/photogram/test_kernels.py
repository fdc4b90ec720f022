"""A cached kernel must not outlive a change in another file that it was compiled from."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import photogram.kernels

CALLED = """
from numba import njit

OFFSET = {offset}

@njit(inline="always")
def shifted(x):
    return x + OFFSET
"""
KERNEL = """
from small._kernel import njit
from small.called import shifted

@njit()
def kernel(x):
    return 10 * shifted(x)
"""
RUN = "from small.calls import kernel; print(kernel(1), sum(kernel.stats.cache_hits.values()))"


def run(folder: Path) -> list[str]:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder.parent / "kernels")}
    done = subprocess.run(
        [sys.executable, "-c", RUN], cwd=folder, check=True, capture_output=True, text=True, env=environment
    )
    return done.stdout.split()


def checkout(folder: Path) -> Path:
    package = folder / "small"
    package.mkdir(parents=True)
    source = Path(photogram.kernels.__file__).read_text(encoding="utf-8")
    called = CALLED.format(offset=1)
    for name, text in (("__init__", ""), ("_kernel", source), ("calls", KERNEL), ("called", called)):
        (package / f"{name}.py").write_text(text, encoding="utf-8")
    return package / "called.py"


def test_a_kernel_follows_the_functions_that_it_calls(tmp_path: Path) -> None:
    called = checkout(tmp_path / "one")
    assert run(tmp_path / "one") == ["20", "0"]
    assert run(tmp_path / "one") == ["20", "1"]
    called.write_text(CALLED.format(offset=2), encoding="utf-8")
    assert run(tmp_path / "one") == ["30", "0"]


def test_a_second_checkout_finds_the_kernels_of_the_first(tmp_path: Path) -> None:
    for name, hits in (("one", "0"), ("other", "1")):
        checkout(tmp_path / name)
        assert run(tmp_path / name) == ["20", hits]
