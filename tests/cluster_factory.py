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

from fusion.campaign.executor import LoggedResult, call

PATIENCE_S = 300.0
ROOT = Path(__file__).resolve().parents[1]


ENDING_S = 20.0


class Cluster:
    """A scheduler and two workers, or some, each a process of its own, as a laboratory starts them.

    `nannies`: each worker has one, which starts another when it dies.
    """

    def __init__(self, folder: Path, *, workers: int = 2, nannies: bool = False) -> None:
        self.folder = folder
        self._processes = [self._scheduler("0")]
        file = folder / "scheduler.json"
        wait_until(lambda: file.exists() and bool(file.read_text().strip()))
        self.address = json.loads(file.read_text())["address"]
        self.nanny = "--nanny" if nannies else "--no-nanny"
        self.workers = [self._worker(folder, self.nanny) for _ in range(workers)]
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(len(self.workers), PATIENCE_S)

    def _scheduler(self, port: str) -> subprocess.Popen[bytes]:
        options = ("--scheduler-file", str(self.folder / "scheduler.json"), "--host", "127.0.0.1", "--port", port)
        return _start("scheduler", *options, "--no-dashboard", folder=self.folder)

    def restart_scheduler(self, downtime_s: float) -> None:
        """Kill the scheduler, with which workers and nannies end, and start all again after a while, at its address."""
        for process in self._processes:
            process.kill() if process is self._processes[0] else process.terminate()
            try:
                process.wait(ENDING_S)
            except subprocess.TimeoutExpired:  # a nanny that is just losing its worker may never end by itself
                process.kill()
                process.wait()
        time.sleep(downtime_s)
        self._processes = [self._scheduler(self.address.rpartition(":")[2])]
        self.workers = [self._worker(self.folder, self.nanny) for _ in self.workers]

    def _worker(self, folder: Path, nanny: str) -> subprocess.Popen[bytes]:
        options = ("--nthreads", "1", nanny, "--no-dashboard", "--local-directory", str(folder))
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


class InlineExecutor:
    """An executor in this process that records its functions.

    `waits`: until it has as many tasks as its size, and then answers the last first.
    """

    patience_s = 0.0

    def __init__(self, size: int = 2, *, waits: bool = False) -> None:
        self.size, self.batch = size, size if waits else 1
        self.asked: list[Callable[..., Any]] = []
        self.waiting: list[tuple[Future[LoggedResult], Callable[..., Any], tuple[Any, ...]]] = []

    def __enter__(self) -> InlineExecutor:
        return self

    def __exit__(self, *_: object) -> None:
        assert not self.waiting

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[LoggedResult]:
        future: Future[LoggedResult] = Future()
        self.asked.append(function)
        self.waiting.append((future, function, arguments))
        if len(self.waiting) == self.batch:
            while self.waiting:
                late, work, given = self.waiting.pop()
                late.set_result(
                    call(work, *(argument.result() if isinstance(argument, Future) else argument for argument in given))
                )
        return future
