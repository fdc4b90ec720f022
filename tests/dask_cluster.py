"""A Dask cluster for tests, each of its processes started as a laboratory does."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from distributed import Client

PATIENCE_S = 300.0
ROOT = Path(__file__).resolve().parents[1]


class Cluster:
    """A scheduler and two workers, each a process of its own, as a laboratory starts them."""

    def __init__(self, folder: Path) -> None:
        file = folder / "scheduler.json"
        arguments = ["--scheduler-file", str(file), "--no-dashboard"]
        self._processes = [_start("scheduler", *arguments, "--host", "127.0.0.1", "--port", "0", folder=folder)]
        wait_until(lambda: file.exists() and bool(file.read_text().strip()))
        self.address = json.loads(file.read_text())["address"]
        self.workers = [self._worker(folder) for _ in range(2)]
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(len(self.workers), PATIENCE_S)

    def _worker(self, folder: Path) -> subprocess.Popen[bytes]:
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder))
        self._processes.append(_start("worker", self.address, *options, folder=folder))
        return self._processes[-1]

    def end(self) -> None:
        """End all processes."""
        for process in reversed(self._processes):
            process.kill()
            process.wait()


def environment() -> dict[str, str]:
    """That of a process that finds the program and what tests have it do."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}


def _start(what: str, *arguments: str, folder: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "dask", what, *arguments]
    with (folder / f"{what}.log").open("ab") as log:
        return subprocess.Popen(command, env=environment(), stdout=log, stderr=log, cwd=folder)


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait for a condition, but not for ever."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
