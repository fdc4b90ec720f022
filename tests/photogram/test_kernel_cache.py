"""A cached kernel must not outlive a change in another file that it was compiled from."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import photogram._kernel

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
    done = subprocess.run([sys.executable, "-c", RUN], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.split()


def test_a_kernel_follows_the_functions_that_it_calls(tmp_path: Path) -> None:
    package = tmp_path / "small"
    package.mkdir()
    source = Path(photogram._kernel.__file__).read_text(encoding="utf-8")
    for name, text in (("__init__", ""), ("_kernel", source), ("calls", KERNEL)):
        (package / f"{name}.py").write_text(text, encoding="utf-8")
    called = package / "called.py"
    called.write_text(CALLED.format(offset=1), encoding="utf-8")
    assert run(tmp_path) == ["20", "0"]
    assert run(tmp_path) == ["20", "1"]
    before = called.stat()
    called.write_text(CALLED.format(offset=2), encoding="utf-8")
    os.utime(called, ns=(before.st_atime_ns, before.st_mtime_ns + 1_000_000_000))
    assert run(tmp_path) == ["30", "0"]
