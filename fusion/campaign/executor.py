"""Who computes the tasks of a run, one at a time each: processes of this machine, or the workers of a Dask cluster.

Linear algebra adds in an order that depends on its threads, so that with another number of them the last digits of a
result change. Everything a run computes is therefore done with one of them, wherever it is computed.
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
from fusion.errors import ComputeError, InputError

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as ClusterFuture

log = logging.getLogger("shakercal")

# How many threads the libraries of one task use.


LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
ONE_THREAD = dict.fromkeys((*LIMITS, "OPENCV_FOR_THREADS_NUM"), "1")
"""What a process has to be started with for its libraries to use one thread each."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let linear algebra compute with one thread."""
    import scipy.linalg  # noqa: F401  (brings a linear algebra of its own, which is to be limited too)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield


def with_one_thread(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function while every library computes with one thread."""
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


# A task that another process computes: what it returns, raises and logs comes back as one answer.


_ALONE = threading.Lock()  # threads of one process share the logger and what the libraries are limited to


@dataclass(frozen=True, eq=False)
class LoggedResult(LocalResult):
    """What a task returned or raised, and what it logged."""

    log_records: tuple[logging.LogRecord, ...] = ()

    def __reduce__(self) -> tuple[Callable[..., LoggedResult], tuple[bytes]]:
        """Travel in one piece: a cluster hands over large arrays apart, read where they lie in a message.

        There they begin at any byte, and kernels and sums over such an array are others than over one that numpy made.
        """
        return _arrived, (pickle.dumps((self.value, self.error, self.log_records)),)

    def log(self, name: str) -> None:
        """Log what the task logged, behind the name of what it was about."""
        for record in self.log_records:
            if log.isEnabledFor(record.levelno):
                log.log(record.levelno, "%s: %s", name, record.getMessage())


def _arrived(packed: bytes) -> LoggedResult:
    """Return the answer that has travelled."""
    return LoggedResult(*pickle.loads(packed))


def call(function: Callable[..., Any], *arguments: Any) -> LoggedResult:
    """Call a function, one at a time in a process; answers among its arguments are opened.

    What it logs is kept instead of told here. An exception carries the place it came from as its note.
    """
    keeper = _Keeper()
    with _ALONE:
        before = log.handlers, log.propagate, log.level
        log.handlers, log.propagate = [keeper], False
        log.setLevel(logging.DEBUG)
        try:
            opened = [argument.unwrap() if isinstance(argument, LoggedResult) else argument for argument in arguments]
            return LoggedResult(function(*opened), None, tuple(keeper.kept))
        except Exception as error:
            error.add_note(traceback.format_exc())
            return LoggedResult(None, error, tuple(keeper.kept))
        finally:
            log.handlers, log.propagate = before[:2]
            log.setLevel(before[2])


class _Keeper(logging.Handler):
    """Keeps records as plain text, which can go to another process."""

    def __init__(self) -> None:
        super().__init__()
        self.kept: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        plain = logging.makeLogRecord({**vars(record), "msg": record.getMessage(), "args": None, "exc_info": None})
        self.kept.append(plain)


# Processes of this machine that compute tasks, one at a time each, and are replaced when they die.


ATTEMPTS = 3
"""How often a task is begun before the death of its workers counts as the task's own failure."""
SHUTDOWN_S = 5.0
"""How long a worker may take to end when it is told to, or to start."""
SIGNAL_DELAY_S = 0.5
"""How long the end of this process may take to be known after that of a worker."""
STOP_RANK = 1 << 60


@dataclass(order=True)
class _Task:
    """One call that waits for a worker; the lowest rank is the next, then the first come."""

    rank: int
    number: int
    function: Callable[..., Any] = field(compare=False)
    arguments: tuple[Any, ...] = field(compare=False)
    future: Future[LoggedResult] = field(compare=False, default_factory=Future)


class Workers:
    """A number of processes, each led by a thread of this one; at the end of `with` they all end."""

    patience_s = 0.0  # one that died computes nothing any more

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
        """End the workers, whatever they are doing; tasks without an answer are cancelled."""
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
        """End all workers at once; waits for none of the locks that the process's first thread may hold."""
        with suppress(OSError):
            self._stopper.close()
        self._starting.acquire(timeout=SHUTDOWN_S)  # one that is being started would tell that its parent is gone
        for worker in self._living.copy():
            worker.kill()

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[LoggedResult]:
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
        while (task := self._queue.get()).rank > -STOP_RANK:
            try:
                worker = self._complete(task, worker)
            except Exception as error:  # told where the answer is awaited
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
        """Have a task computed and return the worker that is still there; a task that ends its workers fails."""
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
            if self._stop.poll(SIGNAL_DELAY_S):  # what ends all processes may reach a worker first
                break
            status, worker = self._end(worker), None
            log.warning("a worker process ended with status %s; another one begins its work again", status)
        if self._stop.poll():
            task.future.cancel()
        else:
            text = f"{ATTEMPTS} worker processes ended while they computed it; does the memory suffice?"
            task.future.set_result(LoggedResult(None, ComputeError(text), ()))
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
        """Have the process compute a task; None when it died meanwhile or `stop` was closed."""
        try:
            self._connection.send(task)
            if self._connection in wait([self._connection, self._process.sentinel, stop]):
                return cast(LoggedResult, pickle.loads(self._connection.recv_bytes()))
        except (EOFError, BrokenPipeError, ConnectionResetError):
            log.debug("the connection to a worker broke")
        return None

    def kill(self) -> None:
        """End the process at once and wait until it is gone."""
        with suppress(ValueError, OSError):  # that has been closed
            self._process.kill()
            self._process.join(SHUTDOWN_S)

    def end(self) -> int | None:
        """End the process and return its exit status; what it was making is removed by whoever runs it."""
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
    """Block interruptions in this thread, and in a process that it starts meanwhile.

    A terminal interrupts all processes; the first one ends the others, also while they start.
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
    """Answer one task after another until the other side is gone."""
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
        except Exception as error:  # one that cannot travel is told in its own words
            what = error if answer.error is None else answer.error
            packed = pickle.dumps(
                LoggedResult(None, RuntimeError(f"{type(what).__name__}: {what}"), answer.log_records)
            )
        with suppress(OSError):
            connection.send_bytes(packed)


def _end_with_parent() -> None:
    """Wait for the end of the process that started this one, which cannot tell when it is killed, and end too."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


# Workers of a Dask cluster (`pip install "shakercal[cluster]"`).


ANSWER_S, RETRY_S = 10.0, 0.2
"""How long a scheduler may take to answer, and what passes between two attempts."""
SCHEDULER_PORT = 8786
"""Where Dask's schedulers listen unless told otherwise."""
OPTION = "--scheduler"


SCHEDULER_TIMEOUT_S = 300.0
"""How long a scheduler that is gone is waited for; whoever starts it again may need some minutes."""
BUSY_TIMEOUT_S = 600.0
"""How long a worker waits for a recording that another one, cut off from the scheduler, still computes."""


class Cluster:
    """The workers that a Dask scheduler has; they see the same files as this process, by the same paths.

    What they were to do is asked for again where the scheduler is started anew at its address.
    """

    patience_s = BUSY_TIMEOUT_S

    def __init__(self, client: Client) -> None:
        self._client = client
        self._address = client.scheduler.address
        self._reconnecting = threading.Lock()
        self.ended = False

    @property
    def size(self) -> int:
        """How many workers there are at present."""
        return len(self._client.nthreads())

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> ClusterTask:
        """Have a module's function called by a worker; of the tasks that wait, the lowest rank comes first.

        Answers among the arguments are there: the function receives what they hold, from wherever that is. A worker
        that dies is nobody's loss: Dask computes again, elsewhere, what it had.
        """
        return ClusterTask(self, rank, (function, *arguments))

    def client(self) -> Client:
        """Return the connection to the scheduler, a new one where it was lost; `ComputeError` where none answers."""
        from distributed import Client

        with self._reconnecting:
            told, end = False, time.monotonic() + SCHEDULER_TIMEOUT_S
            while self._client.status != "running":
                if self.ended or time.monotonic() > end:
                    raise ComputeError("the Dask scheduler is gone; start the run again where there is one")
                if not told:
                    log.warning("the Dask scheduler does not answer; it is waited for %.0f s", SCHEDULER_TIMEOUT_S)
                    told = True
                if self._client.status == "closed":
                    with suppress(OSError):
                        self._client = Client(self._address, timeout=ANSWER_S, set_as_default=False)
                time.sleep(RETRY_S)
            return self._client

    def end(self) -> None:
        """Give up the connection; the scheduler and its workers stay."""
        self.ended = True
        self._client.close()


class ClusterTask:
    """The answer of a task, asked for again where the scheduler lost it or its workers died."""

    def __init__(self, cluster: Cluster, rank: int, task: tuple[Any, ...]) -> None:
        self._cluster, self._rank, self._task = cluster, rank, task
        self._answer: Future[LoggedResult] = Future()
        self._killed = 0
        self.future: ClusterFuture[LoggedResult]
        self._begin()

    def _begin(self) -> None:
        """Have the task computed, after those among its arguments that the scheduler has lost."""
        client, held = self._cluster.client(), []
        for argument in self._task:
            if isinstance(argument, ClusterTask) and argument.future.cancelled():
                argument._begin()
            held.append(argument.future if isinstance(argument, ClusterTask) else argument)
        self.future = client.submit(call, with_one_thread, *held, priority=-self._rank, pure=False)
        self.future.add_done_callback(self._ended)

    def _ended(self, future: ClusterFuture[LoggedResult]) -> None:
        """Fetch the answer; called in a thread of its own as soon as there is one or none will be."""
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
                    text = "several workers of the cluster ended while they computed it; does their memory suffice?"
                    raise ComputeError(text) from error
                self._begin()
            except (CancelledError, OSError):
                self._begin()
        except BaseException as error:  # told where the answer is awaited
            self._answer.set_exception(error)

    def add_done_callback(self, told: Callable[[ClusterTask], object]) -> None:
        """Have a function called as soon as there is an answer or none will be."""
        self._answer.add_done_callback(lambda _: told(self))

    def result(self) -> LoggedResult:
        """Return the answer; `ComputeError` where the cluster has none."""
        return self._answer.result()


@contextmanager
def connect_cluster(address: str) -> Iterator[Cluster]:
    """Yield the cluster whose scheduler answers at an address such as tcp://10.0.0.1:8786; leave it as it is."""
    try:
        from distributed import Client
    except ImportError as error:
        expected = 'the packages that pip install "shakercal[cluster]" brings'
        raise InputError(OPTION, "", found=f"none ({error})", expected=expected) from error
    try:
        # Where nobody listens this is told: a client that waits in vain does not end in silence.
        parts = urlsplit(address if "://" in address else f"tcp://{address}")
        if not parts.hostname:
            raise ValueError("no address")
        socket.create_connection((parts.hostname, parts.port or SCHEDULER_PORT), timeout=ANSWER_S).close()
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        expected = "the address of a Dask scheduler that answers, such as tcp://10.0.0.1:8786"
        raise InputError(OPTION, "", found=f"{address or 'nothing'}, where none does", expected=expected) from error
    cluster = Cluster(client)
    try:
        # Workers that would compute something else are refused; those that are still to come are not asked.
        versions = client.run(_version, on_error="return")
        log.info("%s has %d worker%s", client.scheduler.address, len(versions), "" if len(versions) == 1 else "s")
        for worker, version in versions.items():
            if version != __version__:
                what = f"{PROGRAM} {version}" if isinstance(version, str) else f"none ({version})"
                raise InputError(
                    OPTION, "", found=f"{what} at {worker}", expected=f"workers with {PROGRAM} {__version__}"
                )
        yield cluster
    finally:
        cluster.end()


def _version() -> str:
    """Return the version of the program in the process that is asked."""
    return __version__
