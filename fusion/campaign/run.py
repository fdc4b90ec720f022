"""Evaluation of a recording or a campaign; only new or changed recordings are computed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue

from fusion.base import Executor, Pending, ProgressCallback, Settings, cleanup_on_signal, no_progress, versions
from fusion.campaign.executor import Workers, connect_cluster, one_blas_thread
from fusion.campaign.stored_campaign import SOURCE_FILE, StoredCampaign, StoredRecording
from fusion.errors import ComputeError, InputError, as_user_error, is_interruption
from fusion.recording.excitation import kinds_of
from fusion.recording.load import RECORDING_NAME, Manifest, find_recordings, load_manifest, select_kinds
from fusion.report.atomic_files import Checkpoint, file_lock, remove_abandoned, staging_dir
from fusion.report.folder import RESULT_FILE, Hashing, check_folder, hashing, is_current, origin_key
from fusion.report.h5 import open_results, read_notices
from fusion.report.recording_report import REPORT_FILE, check_campaign_folder, write_results
from fusion.sensitivity.recording_evaluation import evaluate_recording
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES
from shakercal._common.notices import Notice

RECORDINGS, JOIN = "recordings", "join recordings"
LISTEN_S = 0.5  # between looks for an interruption
SHARED_FRAMES = 2  # workers per recording from which on they share its frames instead of the recordings
log = logging.getLogger("shakercal")

# One recording: evaluate and write, unless its results are current.


@dataclass(frozen=True)
class Job:
    """A recording.toml to evaluate, the folder of its results, and the user's options.

    `patience_s`: how long to wait for another process that evaluates it. `stored`: where its files are, if they are to
    be fetched.
    """

    recording: Path
    folder: Path
    settings: Settings
    force: bool = False
    allow_outside: bool = False
    patience_s: float = 0.0
    stored: StoredRecording | None = None

    def with_absolute_paths(self, patience_s: float = 0.0) -> Job:
        """Return the job with absolute paths, which any process can use."""
        recording, folder = self.recording.absolute(), self.folder.absolute()
        return replace(self, recording=recording, folder=folder, patience_s=patience_s)


@dataclass(frozen=True)
class Outcome:
    """Outcome of one recording: its results folder, or the error.

    `resumed`: results of the same inputs, settings and program version existed already. `notices`: of the results; in a
    campaign those that remain true within it; None before they are read. `address`: of the uploaded results.
    """

    recording: Path
    folder: Path
    resumed: bool = False
    error: InputError | ComputeError | None = None
    notices: tuple[Notice, ...] | None = None
    address: str = ""

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return self.recording.absolute().parent.name

    @property
    def missing(self) -> str:
        """Driven lines without a result, with the reasons; empty if all have one."""
        return " ".join(notice.text for notice in self.notices or () if notice.code == NO_RESULT_AT_LINES.code)

    @property
    def summary(self) -> str:
        """Path of the report, or the error."""
        what = "unchanged since the last run" if self.resumed else "written"
        return f"failed, {self.error}" if self.error is not None else f"report ({what}): {self.place(REPORT_FILE)}"

    def place(self, name: str = "", *, above: bool = False) -> str:
        """Return path or address of a result file; `above`: of its campaign."""
        if self.address:
            return f"{self.address.rpartition('/')[0] if above else self.address}/{name}".rstrip("/")
        return str((self.folder.parent if above else self.folder) / name)


def run_job(job: Job, progress: ProgressCallback = no_progress, executor: Executor | None = None) -> Outcome:
    """Evaluate one recording unless its results are current, and write them.

    `executor`: processes that share the images of the recording.
    """
    if job.stored is not None:
        return _run_stored(job, job.stored, progress, executor)
    return _run_files(job, progress, executor)


def _run_stored(job: Job, stored: StoredRecording, progress: ProgressCallback, executor: Executor | None) -> Outcome:
    """Fetch and evaluate a recording of an object store, unless its results are current."""
    if not job.force and stored.is_current(job.folder, job.settings):
        return Outcome(job.recording, job.folder, resumed=True)
    with stored.fetched():
        (job.folder / SOURCE_FILE).unlink(missing_ok=True)
        outcome = _run_files(job, progress, executor)
        stored.finish(job.folder, job.settings)
    return outcome


def _run_files(job: Job, progress: ProgressCallback, executor: Executor | None) -> Outcome:
    """Evaluate a recording whose files are on this machine."""
    manifest = load_manifest(job.recording, allow_outside=job.allow_outside)
    if job.stored is not None:
        manifest = replace(manifest, address=job.stored.address)
    hashes = hashing(manifest.files, manifest.root, manifest.file_identities)
    try:
        return _evaluated(job, manifest, hashes, progress, executor)
    except Exception:
        hashes.all()  # an error of a file as a whole is reported first
        raise
    finally:
        hashes.end()


def _evaluated(
    job: Job, manifest: Manifest, hashes: Hashing, progress: ProgressCallback, executor: Executor | None
) -> Outcome:
    """Evaluate a recording while its files are being hashed, and write the results."""
    current = partial(is_current, job.folder, hashes, job.settings.as_dict())
    if not job.force and current():
        log.debug("%s: results of the same input exist", job.folder)
        return Outcome(job.recording, job.folder, resumed=True)
    check_folder(job.folder, hashes, force=job.force)
    with file_lock(job.folder, job.patience_s), one_blas_thread():
        if job.patience_s and not job.force and current():  # another process has finished it meanwhile
            return Outcome(job.recording, job.folder)
        if executor is not None:
            for _ in range(executor.size):  # workers start while this process opens the files
                executor.submit(0, _ready)
        checkpoint = Checkpoint(job.folder, partial(origin_key, hashes, job.settings.as_dict(), versions()))
        evaluation = evaluate_recording(manifest, job.settings, hashes, progress, executor, checkpoint)
        write_results(evaluation, job.folder, hashes.all(), force=job.force)
        checkpoint.remove()
    return Outcome(job.recording, job.folder, notices=evaluation.notices)


def _ready() -> None:  # its module imports all that a worker needs
    """Do no work; the import of this module prepares a worker."""


# One recording or a folder of several: evaluate by one or several processes or a cluster; resume, merge.


def run_path(
    path: str | Path | StoredCampaign,
    output: str | Path | None,
    settings: Settings,
    *,
    force: bool = False,
    allow_outside: bool = False,
    workers: int | str = 1,
    progress: ProgressCallback = no_progress,
) -> tuple[Outcome, ...]:
    """Evaluate a recording, or every recording of a campaign folder, and write the result files.

    A campaign writes one folder per recording, and joint results at its top. Recordings of other kinds, such as chirps,
    are ignored. A recording that fails does not stop the others; the failure of a single recording is raised.

    Parameters
    ----------
    path : str, Path or StoredCampaign
        Recording folder, recording.toml, or campaign folder; or a campaign in an object store (`fetched_campaign`).
    output : str, Path or None
        Folder of the results; None: RECORDING/results or CAMPAIGN/results, or as stated for the stored campaign.
    settings : Settings
        Settings of the evaluation.
    force : bool, default False
        Evaluate again and replace result files.
    allow_outside : bool, default False
        Allow files outside the folder of the rig.
    workers : int or str, default 1
        Number of processes, or address of a Dask scheduler. They share recordings or, if there are too few, stereo
        pairs and blocks of frames. The results have the same digits in all cases.
    progress : callable
        Called as (stage, done, total).

    Returns
    -------
    tuple of Outcome
        One for each recording, in order.

    Raises
    ------
    InputError, ComputeError
        A single recording could not be evaluated, or the output folder cannot be used.

    Examples
    --------
    >>> from fusion import Settings, run_path
    >>> outcomes = run_path("sample_images/demo", "results", Settings())  # doctest: +SKIP
    """
    stored = path if isinstance(path, StoredCampaign) else None
    output = output if stored is None else stored.output
    path = path.path if isinstance(path, StoredCampaign) else Path(path)
    recordings = find_recordings(path)
    alone = not is_campaign(path)
    if not alone:
        recordings = select_kinds(recordings, kinds_of("run"), images=True)
    top = (recordings[0].parent if alone else path) / "results" if output is None else Path(output)
    folders = [top] if alone else [top / recording.parent.name for recording in recordings]
    of_store = {} if stored is None else stored.recordings
    jobs = [
        Job(recording, folder, settings, force, allow_outside, stored=of_store.get(recording))
        for recording, folder in zip(recordings, folders, strict=True)
    ]
    if not alone:
        check_campaign_folder(top, [folder.name for folder in folders], force=force)
    above = staging_dir(top) if alone else top
    # Unfinished files of ended processes are removed from the parent folder, before and after.
    remove_abandoned(above)
    with nullcontext() if alone else file_lock(top), cleanup_on_signal(partial(remove_abandoned, above)):
        with _executor(workers) as executor:
            if alone:
                outcome = _with_notices(_run_one(jobs[0], executor, progress))
                return (outcome if stored is None else _addressed(outcome, stored),)
            if executor is None or SHARED_FRAMES * len(jobs) <= executor.size:
                outcomes = _run_local(jobs, executor, progress)
            else:
                outcomes = _run_distributed(jobs, executor, progress)
        return _joined(top, path.resolve().name, outcomes, stored, progress)


def _joined(
    top: Path, name: str, outcomes: Sequence[Outcome], stored: StoredCampaign | None, progress: ProgressCallback
) -> tuple[Outcome, ...]:
    """Write the joint files of a campaign and return the outcomes with their notices."""
    finished = [outcome.folder for outcome in outcomes if outcome.error is None]
    failed = {outcome.name: str(outcome.error) for outcome in outcomes if outcome.error is not None}
    if not finished:
        return tuple(outcomes)
    from fusion.campaign.joint_report import write_campaign  # a recording by itself needs no campaign's models

    progress(JOIN, 0, 1)
    with one_blas_thread():
        joint, written = write_campaign(top, name, finished, failed)
    if stored is not None:
        stored.upload(written)
    progress(JOIN, 1, 1)
    notices = {entry.folder: entry.joint_notices for entry in joint.recorded}
    found = (replace(outcome, notices=notices.get(outcome.folder.name)) for outcome in outcomes)
    return tuple(found if stored is None else (_addressed(outcome, stored) for outcome in found))


def _addressed(outcome: Outcome, stored: StoredCampaign) -> Outcome:
    """Return an outcome with the address of its results."""
    return replace(outcome, address=stored.address_of(outcome.folder))


def _with_notices(outcome: Outcome) -> Outcome:
    """Return an outcome with the notices of existing results."""
    if outcome.notices is not None or outcome.error is not None:
        return outcome
    with open_results(outcome.folder / RESULT_FILE, "notices") as file:
        return replace(outcome, notices=read_notices(file))


def is_campaign(path: Path) -> bool:
    """Return whether a path is a folder of recordings and not one of them."""
    return path.is_dir() and not (path / RECORDING_NAME).is_file()


def exit_status(outcomes: Sequence[Outcome]) -> int:
    """Return 0 if every driven line has a result, 2 for wrong input, else 1."""
    errors = [outcome.error for outcome in outcomes if outcome.error is not None]
    if any(isinstance(error, InputError) for error in errors):
        return 2
    return 1 if errors or any(outcome.missing for outcome in outcomes) else 0


def _executor(workers: int | str) -> AbstractContextManager[Executor | None]:
    """Return the executor; None means this process."""
    if isinstance(workers, str):
        return connect_cluster(workers)
    return Workers(workers) if workers > 1 else nullcontext()


def _run_one(job: Job, executor: Executor | None, progress: ProgressCallback) -> Outcome:
    """Evaluate a recording in this process; an executor shares its images."""
    if executor is None:
        return run_job(job, progress)
    return replace(run_job(job.with_absolute_paths(), progress, executor), recording=job.recording, folder=job.folder)


def _run_local(jobs: Sequence[Job], executor: Executor | None, progress: ProgressCallback) -> tuple[Outcome, ...]:
    """Evaluate one recording after another; an error is part of its outcome."""
    outcomes = []
    for done, job in enumerate(jobs):
        progress(RECORDINGS, done, len(jobs))
        outcomes.append(_outcome(job, partial(_run_one, job, executor, progress)))
    progress(RECORDINGS, len(jobs), len(jobs))
    return tuple(outcomes)


def _run_distributed(jobs: Sequence[Job], executor: Executor, progress: ProgressCallback) -> tuple[Outcome, ...]:
    """Evaluate all recordings by workers; outcomes are in the order of the recordings."""
    answered: SimpleQueue[int] = SimpleQueue()
    pending: list[Pending] = [
        executor.submit(rank, run_job, job.with_absolute_paths(executor.patience_s)) for rank, job in enumerate(jobs)
    ]
    for rank, answer in enumerate(pending):
        answer.add_done_callback(partial(_announce, answered, rank))
    outcomes: dict[int, Outcome] = {}
    while len(outcomes) < len(jobs):
        progress(RECORDINGS, len(outcomes), len(jobs))
        # A wait without an end cannot be interrupted on every system.
        done: int | None = None
        while done is None:
            with suppress(Empty):
                done = answered.get(timeout=LISTEN_S)
        outcomes[done] = _outcome(jobs[done], partial(_received, jobs[done], pending[done]))
    progress(RECORDINGS, len(jobs), len(jobs))
    return tuple(outcomes[rank] for rank in range(len(jobs)))


def _announce(answered: SimpleQueue[int], rank: int, _: object) -> None:
    answered.put(rank)


def _received(job: Job, pending: Pending) -> Outcome:
    """Return the outcome of a task with the user's paths, after its log records."""
    answer = pending.result()
    answer.log(job.recording.absolute().parent.name)
    outcome: Outcome = answer.unwrap()
    return replace(outcome, recording=job.recording, folder=job.folder)


def _outcome(job: Job, work: Callable[[], Outcome]) -> Outcome:
    """Call `work` for a recording of a campaign; an error becomes part of its outcome."""
    try:
        return work()
    except Exception as error:
        if is_interruption(error):
            raise
        failure = as_user_error(error)
        log.error("%s", failure)
        log.debug("traceback", exc_info=error)
        return Outcome(job.recording, job.folder, error=failure)
