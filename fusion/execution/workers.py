"""Processes of this machine that compute tasks, one at a time each, and are replaced when they die."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from queue import PriorityQueue
from typing import Any, cast

from fusion.errors import ComputeError
from fusion.execution.task import Answer, call
from fusion.execution.threads import ONE_THREAD

ATTEMPTS = 3
"""How often a task is begun before the death of its workers counts as the task's own failure."""
FAREWELL_S = 5.0
"""How long a worker may take to clean up when it is told to end."""
NOTHING_MORE = 1 << 60
log = logging.getLogger("shakercal")


@dataclass(order=True)
class _Task:
    """One call that waits for a worker; the lowest rank is the next, then the first come."""

    rank: int
    number: int
    function: Callable[..., Any] = field(compare=False)
    arguments: tuple[Any, ...] = field(compare=False)
    future: Future[Answer] = field(compare=False, default_factory=Future)


class Workers:
    """A number of processes, each led by a thread of this one; at the end of `with` they all end."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._queue: PriorityQueue[_Task] = PriorityQueue()
        self._number = 0
        self._starting = threading.Lock()
        self._stop, self._stopper = multiprocessing.Pipe(duplex=False)
        self._leaders = [threading.Thread(target=self._lead, daemon=True) for _ in range(size)]

    def __enter__(self) -> Workers:
        for leader in self._leaders:
            leader.start()
        return self

    def __exit__(self, *reason: object) -> None:
        """End the workers, whatever they are doing; tasks without an answer are cancelled."""
        self._stopper.close()
        for _ in self._leaders:
            self.submit(-NOTHING_MORE, call)
        for leader in self._leaders:
            leader.join()
        while not self._queue.empty():
            self._queue.get().future.cancel()
        self._stop.close()

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[Answer]:
        """Have a module's function called by a worker; of the tasks that wait, the lowest rank comes first.

        Futures among the arguments are done: the function receives what they hold.
        """
        self._number += 1
        held = tuple(argument.result() if isinstance(argument, Future) else argument for argument in arguments)
        task = _Task(rank, self._number, function, held)
        self._queue.put(task)
        return task.future

    def _lead(self) -> None:
        """Hand tasks to a worker, and to another when it dies, until the workers are to end."""
        worker: _Worker | None = None
        while (task := self._queue.get()).rank > -NOTHING_MORE:
            try:
                worker = self._complete(task, worker)
            except Exception as error:  # told where the answer is awaited
                worker = None
                task.future.set_exception(error)
        if worker is not None:
            worker.end()

    def _complete(self, task: _Task, worker: _Worker | None) -> _Worker | None:
        """Have a task computed and return the worker that is still there; a task that ends its workers fails."""
        for _ in range(ATTEMPTS):
            if self._stop.poll():
                break
            worker = worker or self._new_worker()
            answer = worker.ask((task.function, task.arguments), self._stop)
            if answer is not None:
                task.future.set_result(answer)
                return worker
            if self._stop.poll():
                break
            status, worker = worker.end(), None
            log.warning("a worker process ended with status %s; another one begins its work again", status)
        if self._stop.poll():
            task.future.cancel()
        else:
            text = f"{ATTEMPTS} worker processes ended while they computed it; does the memory suffice?"
            task.future.set_result(Answer(None, ComputeError(text), ()))
        return worker

    def _new_worker(self) -> _Worker:
        """Start a process; the environment it is given is that of this one meanwhile."""
        with self._starting, _environment(ONE_THREAD):
            return _Worker()


class _Worker:
    """One process and the connection to it."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other,), daemon=True)
        self._process.start()
        other.close()

    def ask(self, task: tuple[Callable[..., Any], tuple[Any, ...]], stop: Connection) -> Answer | None:
        """Have the process compute a task; None when it died meanwhile or `stop` was closed."""
        try:
            self._connection.send(task)
            if self._connection in wait([self._connection, self._process.sentinel, stop]):
                return cast(Answer, pickle.loads(self._connection.recv_bytes()))
        except (EOFError, BrokenPipeError, ConnectionResetError):
            log.debug("the connection to a worker broke")
        return None

    def end(self) -> int | None:
        """End the process, kindly at first, and return its exit status."""
        self._connection.close()
        self._process.terminate()
        self._process.join(FAREWELL_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        status = self._process.exitcode
        self._process.close()
        return status


def _serve(connection: Connection) -> None:
    """Answer one task after another until the other side is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal interrupts all processes; the first one tells the others
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    logging.getLogger().addHandler(logging.NullHandler())
    logging.captureWarnings(True)
    while True:
        try:
            function, arguments = connection.recv()
        except EOFError:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # what is left is clean-up
            return
        connection.send_bytes(_packed(call(function, *arguments)))


def _leave(*_: object) -> None:
    """End through all clean-up, which nobody interrupts."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(1)


def _packed(answer: Answer) -> bytes:
    """Return an answer as bytes; an error that cannot travel is told in its own words."""
    try:
        return pickle.dumps(answer)
    except Exception as error:
        what = error if answer.error is None else answer.error
        return pickle.dumps(Answer(None, RuntimeError(f"{type(what).__name__}: {what}"), answer.told))


def _end_with_parent() -> None:
    """Wait for the end of the process that started this one, which cannot tell when it is killed, and end too."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
