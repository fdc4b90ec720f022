"""Recordings for several tests, made once per test run."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

PATIENCE_S = 600.0
T = TypeVar("T")


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> T:
    """Return the pickled result of `make` for all processes of a test run.

    The first process calls it under a lock; the result file is written completely or not at all.
    """
    base = factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "once"
    shared.mkdir(exist_ok=True)
    file, lock = shared / f"{name}.pickle", shared / f"{name}.lock"
    end = time.monotonic() + PATIENCE_S
    while not file.exists():
        try:
            os.close(os.open(lock, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            assert time.monotonic() < end, f"{name}: the process that makes it does not end"
            time.sleep(0.05)
            continue
        try:
            if not file.exists():
                partial = file.with_suffix(".partial")
                partial.write_bytes(pickle.dumps(make(shared / name)))
                os.replace(partial, file)
        finally:
            lock.unlink()
    return pickle.loads(file.read_bytes())
