"""Those who compute in tests: a Dask cluster, each of its processes started as a laboratory does, and this process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from distributed import Client

from fusion.campaign.executor import Answer, call

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


class Inline:
    """A crew that is this process, and tells what it was asked.

    `waits`: until it has as many tasks as its size, and then answers the last first.
    """

    def __init__(self, size: int = 2, *, waits: bool = False) -> None:
        self.size, self.batch = size, size if waits else 1
        self.asked: list[Callable[..., Any]] = []
        self.waiting: list[tuple[Future[Answer], Callable[..., Any], tuple[Any, ...]]] = []

    def __enter__(self) -> Inline:
        return self

    def __exit__(self, *_: object) -> None:
        assert not self.waiting

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[Answer]:
        future: Future[Answer] = Future()
        self.asked.append(function)
        self.waiting.append((future, function, arguments))
        if len(self.waiting) == self.batch:
            while self.waiting:
                late, work, given = self.waiting.pop()
                late.set_result(call(work, *(held.result() if isinstance(held, Future) else held for held in given)))
        return future
