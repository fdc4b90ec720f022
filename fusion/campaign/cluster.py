"""Recordings as tasks of a Dask cluster."""

from __future__ import annotations

import importlib.metadata
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import urlsplit

from fusion.base import ComputeError, Executor, InputError, ProgressCallback, Settings, no_progress, remove_abandoned
from fusion.campaign.workers import Answer, call, one_blas_thread, with_one_thread
from fusion.recording.load import load_manifest
from fusion.report.provenance import PROGRAM, check_folder, hash_files, is_current
from fusion.report.recording import write_results
from fusion.sensitivity.evaluate import evaluate_recording

if TYPE_CHECKING:
    from distributed import Client, Future


# One recording: evaluate and write, unless its results are there.


log = logging.getLogger("shakercal")


@dataclass(frozen=True)
class Job:
    """A recording.toml to evaluate, the folder of its results, and the user's choices."""

    recording: Path
    folder: Path
    settings: Settings
    force: bool = False
    allow_outside: bool = False

    def placed(self) -> Job:
        """Return the job with paths that hold for a process of any working folder."""
        return replace(self, recording=self.recording.absolute(), folder=self.folder.absolute())


@dataclass(frozen=True)
class Outcome:
    """What became of one recording: its results folder, or the reason why there is none.

    `resumed`: the results of the same inputs, settings and program version were there already.
    """

    recording: Path
    folder: Path
    resumed: bool = False
    error: InputError | ComputeError | None = None

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return self.recording.absolute().parent.name


def run_job(job: Job, progress: ProgressCallback = no_progress, crew: Executor | None = None) -> Outcome:
    """Evaluate one recording unless its results are there, and write them; a crew follows its images."""
    manifest = load_manifest(job.recording, allow_outside=job.allow_outside)
    hashes = hash_files(manifest.files, manifest.root)
    if not job.force and is_current(job.folder, hashes, job.settings.as_dict()):
        log.info("%s: results of the same input are there, nothing to compute", job.folder)
        return Outcome(job.recording, job.folder, resumed=True)
    check_folder(job.folder, hashes, force=job.force)
    remove_abandoned(job.folder.resolve().parent)
    with one_blas_thread():
        evaluation = evaluate_recording(manifest, job.settings, hashes, progress, crew)
        for notice in evaluation.notices:
            log.log(logging.WARNING if notice.severity == "warning" else logging.DEBUG, "%s", notice.text)
        write_results(evaluation, job.folder, force=job.force)
    return Outcome(job.recording, job.folder)


# Workers of a Dask cluster (`pip install "shakercal[cluster]"`).


ANSWER_S = 10.0
"""How long a scheduler may take to answer."""
SCHEDULER_PORT = 8786
"""Where Dask's schedulers listen unless told otherwise."""
OPTION = "--scheduler"


class Cluster:
    """The workers that a Dask scheduler has; they see the same files as this process, by the same paths."""

    def __init__(self, client: Client) -> None:
        self._client = client

    @property
    def size(self) -> int:
        """How many workers there are at present."""
        return len(self._client.nthreads())

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> ClusterAnswer:
        """Have a module's function called by a worker; of the tasks that wait, the lowest rank comes first.

        Answers among the arguments are there: the function receives what they hold, from wherever that is. A worker
        that dies is nobody's loss: Dask computes again, elsewhere, what it had.
        """
        held = [argument.future if isinstance(argument, ClusterAnswer) else argument for argument in arguments]
        return ClusterAnswer(self._client.submit(call, with_one_thread, function, *held, priority=-rank, pure=False))


class ClusterAnswer:
    """The answer of a task, which lies where it was computed until its `result` is asked for."""

    def __init__(self, future: Future[Answer]) -> None:
        self.future = future

    def add_done_callback(self, told: Callable[[ClusterAnswer], object]) -> None:
        """Have a function called as soon as there is an answer or none will be."""
        self.future.add_done_callback(lambda _: told(self))

    def result(self) -> Answer:
        """Fetch the answer; `ComputeError` where the cluster has none."""
        from distributed import CancelledError
        from distributed.scheduler import KilledWorker

        try:
            return cast(Answer, self.future.result())
        except KilledWorker as error:
            text = "several workers of the cluster ended while they computed it; does their memory suffice?"
            raise ComputeError(text) from error
        except (CancelledError, OSError) as error:
            raise ComputeError("the Dask scheduler is gone; start the run again where there is one") from error


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """Yield the cluster whose scheduler answers at an address such as tcp://10.0.0.1:8786; leave it as it is."""
    try:
        from distributed import Client
    except ImportError as error:
        expected = 'the packages that pip install "shakercal[cluster]" brings'
        raise InputError(OPTION, "", found=f"none ({error})", expected=expected) from error
    try:
        _knock(address)
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        expected = "the address of a Dask scheduler that answers, such as tcp://10.0.0.1:8786"
        raise InputError(OPTION, "", found=f"{address or 'nothing'}, where none does", expected=expected) from error
    with client:
        _check_versions(client)
        yield Cluster(client)


def _knock(address: str) -> None:
    """Raise `OSError` or `ValueError` where nobody listens: a client that waits in vain does not end in silence."""
    parts = urlsplit(address if "://" in address else f"tcp://{address}")
    if not parts.hostname:
        raise ValueError("no address")
    with socket.create_connection((parts.hostname, parts.port or SCHEDULER_PORT), timeout=ANSWER_S):
        pass


def _check_versions(client: Client) -> None:
    """Refuse a cluster whose workers would compute something else; workers that are still to come are not asked."""
    own = _version()
    found = client.run(_version, on_error="return")
    log.info("%s has %d worker%s", client.scheduler.address, len(found), "" if len(found) == 1 else "s")
    for worker, version in found.items():
        if version != own:
            what = f"{PROGRAM} {version}" if isinstance(version, str) else f"none ({version})"
            raise InputError(OPTION, "", found=f"{what} at {worker}", expected=f"workers with {PROGRAM} {own}")


def _version() -> str:
    """Return this program's version."""
    return importlib.metadata.version(PROGRAM)
