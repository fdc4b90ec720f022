"""Parallel computation by processes of this machine or workers of a Dask cluster.

The order of sums in linear algebra depends on the number of threads, and with it the last digits of a result. Therefore
every task runs with one thread.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from queue import PriorityQueue
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import urlsplit

from fusion.base import PROGRAM, LocalResult, __version__, cleanup_on_signal, limit_threads
from fusion.campaign.campaign_notices import (
    CLUSTER_WORKERS_ENDED,
    NO_DASK,
    NO_SCHEDULER,
    OTHER_WORKER_VERSION,
    SCHEDULER_LOST,
    WORKER_ENDED,
)
from fusion.errors import ComputeError, InputError

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as ClusterFuture

log = logging.getLogger("shakercal")

# How many threads the libraries of one task use.


LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
ONE_THREAD = dict.fromkeys((*LIMITS, "OPENCV_FOR_THREADS_NUM"), "1")
"""Environment of a process whose libraries use one thread each."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit linear algebra to one thread."""
    import scipy.linalg  # noqa: F401  (loads its linear algebra, which is to be limited too)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield


def with_one_thread(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function while every library is limited to one thread."""
    import cv2
    from threadpoolctl import threadpool_limits

    threads = cv2.getNumThreads()
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        with one_blas_thread(), threadpool_limits(1), limit_threads(1):
            return function(*arguments)
    finally:
        cv2.setNumThreads(threads)


# A task of another process: returned value, exception and log records are one result.


_ALONE = threading.Lock()  # threads share the logger and the limits of the libraries


@dataclass(frozen=True, eq=False)
class LoggedResult(LocalResult):
    """Returned value or exception of a task, and its log records."""

    log_records: tuple[logging.LogRecord, ...] = ()

    def __reduce__(self) -> tuple[Callable[..., LoggedResult], tuple[bytes]]:
        """Pickle the result in one piece.

        A cluster transfers large arrays separately and reads them where they are in a message. They are then unaligned,
        and kernels and sums give other last digits than with arrays allocated by numpy.
        """
        return _arrived, (pickle.dumps((self.value, self.error, self.log_records)),)

    def log(self, name: str) -> None:
        """Log the records of the task after the name of its subject."""
        for record in self.log_records:
            if log.isEnabledFor(record.levelno):
                log.log(record.levelno, "%s: %s", name, record.getMessage())


def _arrived(packed: bytes) -> LoggedResult:
    return LoggedResult(*pickle.loads(packed))


def call(function: Callable[..., Any], *arguments: Any) -> LoggedResult:
    """Call a function, one at a time in a process, and return its result.

    Results among its arguments are unwrapped.

    Its log records are collected. An exception has its traceback as a note.
    """
    collector = _RecordCollector()
    with _ALONE:
        previous = log.handlers, log.propagate, log.level
        log.handlers, log.propagate = [collector], False
        log.setLevel(logging.DEBUG)
        try:
            values = [argument.unwrap() if isinstance(argument, LoggedResult) else argument for argument in arguments]
            return LoggedResult(function(*values), None, tuple(collector.records))
        except Exception as error:
            error.add_note(traceback.format_exc())
            return LoggedResult(None, error, tuple(collector.records))
        finally:
            log.handlers, log.propagate = previous[:2]
            log.setLevel(previous[2])


class _RecordCollector(logging.Handler):
    """Handler that collects records as plain text, which can be sent to another process."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        plain = logging.makeLogRecord({**vars(record), "msg": record.getMessage(), "args": None, "exc_info": None})
        self.records.append(plain)


# Processes of this machine that compute tasks, one at a time each, and are replaced when they die.


ATTEMPTS = 3
"""How often a task is started before the end of its workers counts as a failure of the task."""
SHUTDOWN_S = 5.0
"""Time that a worker has to start, or to end after a request."""
SIGNAL_DELAY_S = 0.5
"""Time by which the end of this process may be noticed later than that of a worker."""
STOP_RANK = 1 << 60


@dataclass(order=True)
class _Task:
    """One call that waits for a worker.

    The lowest rank is the next, then the first submitted.
    """

    rank: int
    number: int
    function: Callable[..., Any] = field(compare=False)
    arguments: tuple[Any, ...] = field(compare=False)
    future: Future[LoggedResult] = field(compare=False, default_factory=Future)


class Workers:
    """Processes that are each served by a thread of this one.

    All end at the end of `with`.
    """

    patience_s = 0.0  # a worker that died does not compute any more

    def __init__(self, size: int) -> None:
        self.size = size
        self._queue: PriorityQueue[_Task] = PriorityQueue()
        self._number = 0
        self._starting = threading.Lock()
        self._stop, self._stopper = multiprocessing.Pipe(duplex=False)
        self._living: set[_Worker] = set()
        self._ended_by_signals = cleanup_on_signal(self._kill)
        self._leaders = [threading.Thread(target=self._lead, daemon=True) for _ in range(size)]

    def __enter__(self) -> Workers:
        self._ended_by_signals.__enter__()
        for leader in self._leaders:
            leader.start()
        return self

    def __exit__(self, *reason: object) -> None:
        """End the workers at once; tasks without a result are cancelled."""
        self._stopper.close()
        for _ in self._leaders:
            self.submit(-STOP_RANK, call)
        for leader in self._leaders:
            leader.join()
        while not self._queue.empty():
            self._queue.get().future.cancel()
        self._ended_by_signals.__exit__(None, None, None)
        self._stop.close()

    def _kill(self) -> None:
        """End all workers at once, without waiting for locks of the main thread."""
        with suppress(OSError):
            self._stopper.close()
        self._starting.acquire(timeout=SHUTDOWN_S)  # a worker during its start would report a missing parent
        for worker in self._living.copy():
            worker.kill()

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[LoggedResult]:
        """Submit a function of a module to a worker.

        The task of the lowest rank is started first.

        Futures among the arguments must be done; the function receives their results.
        """
        self._number += 1
        values = tuple(argument.result() if isinstance(argument, Future) else argument for argument in arguments)
        task = _Task(rank, self._number, function, values)
        self._queue.put(task)
        return task.future

    def _lead(self) -> None:
        """Send tasks to a worker, and to a new one if it dies."""
        worker: _Worker | None = None
        while (task := self._queue.get()).rank > -STOP_RANK:
            try:
                worker = self._complete(task, worker)
            except Exception as error:  # raised where the result is awaited
                worker = None
                task.future.set_exception(error)
        if worker is not None:
            self._end(worker)

    def _end(self, worker: _Worker) -> int | None:
        """End a worker and return its exit status."""
        status = worker.end()
        self._living.discard(worker)
        return status

    def _complete(self, task: _Task, worker: _Worker | None) -> _Worker | None:
        """Complete a task and return the worker that still runs.

        A task that ends its workers fails.
        """
        for _ in range(ATTEMPTS):
            if self._stop.poll():
                break
            if worker is None:
                with self._starting:
                    worker = _Worker()
                    self._living.add(worker)
            answer = worker.ask((task.function, task.arguments), self._stop)
            if answer is not None:
                task.future.set_result(answer)
                return worker
            if self._stop.poll(SIGNAL_DELAY_S):  # a signal to all processes may reach a worker first
                break
            status, worker = self._end(worker), None
            log.warning("a worker process ended with status %s; another one repeats its task", status)
        if self._stop.poll():
            task.future.cancel()
        else:
            task.future.set_result(LoggedResult(None, ComputeError(WORKER_ENDED, attempts=ATTEMPTS), ()))
        return worker


class _Worker:
    """One process and the connection to it."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other,), daemon=True)
        # The environment it is given is that of this process meanwhile.
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        try:
            with _without_interruptions():
                self._process.start()
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value
        other.close()

    def ask(self, task: tuple[Callable[..., Any], tuple[Any, ...]], stop: Any) -> LoggedResult | None:
        """Compute a task in the process; return None if it died or `stop` was closed."""
        try:
            self._connection.send(task)
            if self._connection in wait([self._connection, self._process.sentinel, stop]):
                return cast(LoggedResult, pickle.loads(self._connection.recv_bytes()))
        except (EOFError, BrokenPipeError, ConnectionResetError):
            log.debug("the connection to a worker broke")
        return None

    def kill(self) -> None:
        """End the process at once and wait for its end."""
        with suppress(ValueError, OSError):  # that has been closed
            self._process.kill()
            self._process.join(SHUTDOWN_S)

    def end(self) -> int | None:
        """End the process and return its exit status; the caller removes its unfinished files."""
        self._connection.close()
        self._process.terminate()
        self._process.join(SHUTDOWN_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        status = self._process.exitcode
        self._process.close()
        return status


@contextmanager
def _without_interruptions() -> Iterator[None]:
    """Block interruptions in this thread, and in a process that it starts.

    A terminal interrupts all processes; the first one ends the others, also during their start.
    """
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # which else unblocks them as it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection) -> None:
    """Compute one task after another until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    logging.getLogger().addHandler(logging.NullHandler())
    logging.captureWarnings(True)
    while True:
        try:
            function, arguments = connection.recv()
        except (EOFError, OSError):
            return
        answer = call(function, *arguments)
        try:
            packed = pickle.dumps(answer)
        except Exception as error:  # one that cannot be pickled is reported as text
            what = error if answer.error is None else answer.error
            packed = pickle.dumps(
                LoggedResult(None, RuntimeError(f"{type(what).__name__}: {what}"), answer.log_records)
            )
        with suppress(OSError):
            connection.send_bytes(packed)


def _end_with_parent() -> None:
    """End this process as soon as its parent has ended, also if that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


# Workers of a Dask cluster (`pip install "shakercal[cluster]"`).


ANSWER_S, RETRY_S = 10.0, 0.2
"""Time that a scheduler has to answer, and pause between two attempts."""
SCHEDULER_PORT = 8786
"""Default port of Dask's schedulers."""
OPTION = "--scheduler"


SCHEDULER_TIMEOUT_S = 300.0
"""How long a run waits for a lost scheduler; to start it again may take some minutes."""
BUSY_TIMEOUT_S = 600.0
"""How long a worker waits for a recording that a disconnected worker may still compute."""


class Cluster:
    """Workers of a Dask scheduler, with access to the same files as this process.

    Tasks are submitted again if the scheduler is restarted at its address.
    """

    patience_s = BUSY_TIMEOUT_S

    def __init__(self, client: Client) -> None:
        self._client = client
        self._address = client.scheduler.address
        self._reconnecting = threading.Lock()
        self.ended = False

    @property
    def size(self) -> int:
        """Current number of workers."""
        return len(self._client.nthreads())

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> ClusterTask:
        """Submit a function of a module to a worker.

        The task of the lowest rank is started first.

        Tasks among the arguments must be done; the function receives their results. Dask repeats the tasks of a worker
        that dies.
        """
        return ClusterTask(self, rank, (function, *arguments))

    def client(self) -> Client:
        """Return the connection to the scheduler, renewed if it was lost.

        Raise `ComputeError` if none answers.
        """
        from distributed import Client

        with self._reconnecting:
            warned, end = False, time.monotonic() + SCHEDULER_TIMEOUT_S
            while self._client.status != "running":
                if self.ended or time.monotonic() > end:
                    raise ComputeError(SCHEDULER_LOST, timeout_s=SCHEDULER_TIMEOUT_S)
                if not warned:
                    log.warning("the Dask scheduler does not answer; waiting for %.0f s", SCHEDULER_TIMEOUT_S)
                    warned = True
                if self._client.status == "closed":
                    with suppress(OSError):
                        self._client = Client(self._address, timeout=ANSWER_S, set_as_default=False)
                time.sleep(RETRY_S)
            return self._client

    def end(self) -> None:
        """Close the connection; the scheduler and its workers keep running."""
        self.ended = True
        self._client.close()


class ClusterTask:
    """Task of a cluster, submitted again if the scheduler lost it or its workers died."""

    def __init__(self, cluster: Cluster, rank: int, task: tuple[Any, ...]) -> None:
        self._cluster, self._rank, self._task = cluster, rank, task
        self._answer: Future[LoggedResult] = Future()
        self._killed = 0
        self.future: ClusterFuture[LoggedResult]
        self._begin()

    def _begin(self) -> None:
        """Submit the task, after those among its arguments that the scheduler has lost."""
        client, arguments = self._cluster.client(), []
        for argument in self._task:
            if isinstance(argument, ClusterTask) and argument.future.cancelled():
                argument._begin()
            arguments.append(argument.future if isinstance(argument, ClusterTask) else argument)
        self.future = client.submit(call, with_one_thread, *arguments, priority=-self._rank, pure=False)
        self.future.add_done_callback(self._ended)

    def _ended(self, future: ClusterFuture[LoggedResult]) -> None:
        """Fetch the result; called in a separate thread when the task has ended."""
        from distributed import CancelledError
        from distributed.scheduler import KilledWorker

        if self._answer.done() or future is not self.future:
            return
        try:
            try:
                self._answer.set_result(future.result())
            except KilledWorker as error:
                self._killed += 1
                if self._killed == ATTEMPTS:
                    raise ComputeError(CLUSTER_WORKERS_ENDED, attempts=ATTEMPTS) from error
                self._begin()
            except (CancelledError, OSError):
                self._begin()
        except BaseException as error:  # raised where the result is awaited
            self._answer.set_exception(error)

    def add_done_callback(self, callback: Callable[[ClusterTask], object]) -> None:
        """Call a function when the task has ended."""
        self._answer.add_done_callback(lambda _: callback(self))

    def result(self) -> LoggedResult:
        """Return the result; raise `ComputeError` if the cluster has none."""
        return self._answer.result()


@contextmanager
def connect_cluster(address: str) -> Iterator[Cluster]:
    """Yield the cluster whose scheduler answers at an address such as tcp://10.0.0.1:8786."""
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(NO_DASK, OPTION, reason=str(error)) from error
    try:
        # Test the address first: a client without a scheduler does not fail cleanly.
        parts = urlsplit(address if "://" in address else f"tcp://{address}")
        if not parts.hostname:
            raise ValueError("no address")
        socket.create_connection((parts.hostname, parts.port or SCHEDULER_PORT), timeout=ANSWER_S).close()
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(NO_SCHEDULER, OPTION, found=address or "an empty address") from error
    cluster = Cluster(client)
    try:
        # Workers of another version are refused; later workers are not checked.
        versions = client.run(_version, on_error="return")
        log.info("%s has %d worker%s", client.scheduler.address, len(versions), "" if len(versions) == 1 else "s")
        for worker, version in versions.items():
            if version != __version__:
                what = f"{PROGRAM} {version}" if isinstance(version, str) else f"none ({version})"
                expected = f"{PROGRAM} {__version__}"
                raise InputError(OTHER_WORKER_VERSION, OPTION, found=what, worker=worker, expected=expected)
        yield cluster
    finally:
        cluster.end()


def _version() -> str:
    """Return the version of the program in this process."""
    return __version__
