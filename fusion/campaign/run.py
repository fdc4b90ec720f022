"""One recording or a campaign of several: evaluated where new or changed."""

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
from fusion.errors import ComputeError, InputError, as_user_error, is_interruption
from fusion.recording.excitation import kinds_of
from fusion.recording.load import RECORDING_NAME, Manifest, find_recordings, load_manifest, select_kinds
from fusion.report.atomic_files import Checkpoint, file_lock, remove_abandoned, staging_dir
from fusion.report.folder import RESULT_FILE, Hashing, check_folder, hashing, is_current, origin_key
from fusion.report.h5 import open_results, read_notices
from fusion.report.recording_report import REPORT_FILE, check_campaign_folder, write_results
from fusion.sensitivity.analyse import NO_RESULT
from fusion.sensitivity.recording_evaluation import evaluate_recording
from shakercal._common.notices import Notice

RECORDINGS, JOIN = "recordings", "join recordings"
LISTEN_S = 0.5  # between looks for an interruption
SHARED_FRAMES = 2  # workers per recording from which on they share its frames instead of the recordings
log = logging.getLogger("shakercal")

# One recording: evaluate and write, unless its results are there.


@dataclass(frozen=True)
class Job:
    """A recording.toml to evaluate, the folder of its results, and the user's choices.

    `patience_s`: how long another process may still be busy with it.
    """

    recording: Path
    folder: Path
    settings: Settings
    force: bool = False
    allow_outside: bool = False
    patience_s: float = 0.0

    def with_absolute_paths(self, patience_s: float = 0.0) -> Job:
        """Return the job with paths that hold for a process of any working folder."""
        recording, folder = self.recording.absolute(), self.folder.absolute()
        return replace(self, recording=recording, folder=folder, patience_s=patience_s)


@dataclass(frozen=True)
class Outcome:
    """What became of one recording: its results folder, or the reason why there is none.

    `resumed`: the results of the same inputs, settings and program version were there already. `notices`: of the
    results, in a campaign those that stay true within it; None before they are read.
    """

    recording: Path
    folder: Path
    resumed: bool = False
    error: InputError | ComputeError | None = None
    notices: tuple[Notice, ...] | None = None

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return self.recording.absolute().parent.name

    @property
    def missing(self) -> str:
        """Which driven lines have no result, and why; empty where all have one."""
        return "; ".join(notice.text for notice in self.notices or () if notice.where == NO_RESULT)

    @property
    def summary(self) -> str:
        """Where the report lies, or why there is none."""
        what = "unchanged since the last run" if self.resumed else "written"
        return f"failed, {self.error}" if self.error is not None else f"report ({what}): {self.folder / REPORT_FILE}"


def run_job(job: Job, progress: ProgressCallback = no_progress, executor: Executor | None = None) -> Outcome:
    """Evaluate one recording unless its results are there, and write them; an executor follows its images."""
    manifest = load_manifest(job.recording, allow_outside=job.allow_outside)
    hashes = hashing(manifest.files, manifest.root, manifest.file_identities)
    try:
        return _evaluated(job, manifest, hashes, progress, executor)
    except Exception:
        hashes.all()  # what is wrong with a file as a whole is told before what was found in it
        raise
    finally:
        hashes.end()


def _evaluated(
    job: Job, manifest: Manifest, hashes: Hashing, progress: ProgressCallback, executor: Executor | None
) -> Outcome:
    """Evaluate a recording whose files are being hashed, unless its results are there, and write them."""
    there = partial(is_current, job.folder, hashes, job.settings.as_dict())
    if not job.force and there():
        log.debug("%s: results of the same input are there, nothing to compute", job.folder)
        return Outcome(job.recording, job.folder, resumed=True)
    check_folder(job.folder, hashes, force=job.force)
    with file_lock(job.folder, job.patience_s), one_blas_thread():
        if job.patience_s and not job.force and there():  # whoever had it has finished it meanwhile
            return Outcome(job.recording, job.folder)
        if executor is not None:
            for _ in range(executor.size):  # workers begin while the files are opened here
                executor.submit(0, _ready)
        kept = Checkpoint(job.folder, partial(origin_key, hashes, job.settings.as_dict(), versions()))
        evaluation = evaluate_recording(manifest, job.settings, hashes, progress, executor, kept)
        write_results(evaluation, job.folder, hashes.all(), force=job.force)
        kept.remove()
    return Outcome(job.recording, job.folder, notices=evaluation.notices)


def _ready() -> None:  # a task, hence a function of this module, whose imports are what a worker needs
    """Do nothing."""


# One recording or a folder of several: evaluate here, by several processes or on a cluster; resume, merge.


def run_path(
    path: str | Path,
    output: str | Path | None,
    settings: Settings,
    *,
    force: bool = False,
    allow_outside: bool = False,
    workers: int | str = 1,
    progress: ProgressCallback = no_progress,
) -> tuple[Outcome, ...]:
    """Evaluate a recording, or every recording of a campaign folder, and write the result files.

    A recording writes to `output` (default RECORDING/results). A campaign writes one folder per recording below
    `output` (default CAMPAIGN/results) and what they tell together at its top; recordings of kinds that are not
    evaluated here, such as chirps, are left out, and one that fails does not stop the others. A single recording's
    failure is raised. `workers`: a number of processes of this machine, or the address of the scheduler of a Dask
    cluster. Recordings are shared among them, or, where there are too few recordings for that, stereo pairs and
    blocks of frames. Where it is computed changes no digit of a result.

    >>> from fusion import Settings, run_path
    >>> outcomes = run_path("sample_images/demo", "results", Settings())  # doctest: +SKIP
    """
    path = Path(path)
    recordings = find_recordings(path)
    alone = not is_campaign(path)
    if not alone:
        recordings = select_kinds(recordings, kinds_of("run"))
    top = (recordings[0].parent if alone else path) / "results" if output is None else Path(output)
    folders = [top] if alone else [top / recording.parent.name for recording in recordings]
    jobs = [
        Job(recording, folder, settings, force, allow_outside)
        for recording, folder in zip(recordings, folders, strict=True)
    ]
    if not alone:
        check_campaign_folder(top, [folder.name for folder in folders], force=force)
    above = staging_dir(top) if alone else top
    # What processes left that have ended is removed from the folder above the results, before and after.
    remove_abandoned(above)
    with nullcontext() if alone else file_lock(top), cleanup_on_signal(partial(remove_abandoned, above)):
        with _executor(workers) as executor:
            if alone:
                return (_with_notices(_run_one(jobs[0], executor, progress)),)
            if executor is None or SHARED_FRAMES * len(jobs) <= executor.size:
                outcomes = _run_here(jobs, executor, progress)
            else:
                outcomes = _run_elsewhere(jobs, executor, progress)
        finished = [outcome.folder for outcome in outcomes if outcome.error is None]
        failed = {outcome.name: str(outcome.error) for outcome in outcomes if outcome.error is not None}
        if finished:
            from fusion.campaign.joint_report import join_campaign  # a recording by itself needs no campaign's models

            progress(JOIN, 0, 1)
            with one_blas_thread():
                joint, _ = join_campaign(top, path.resolve().name, finished, failed)
            progress(JOIN, 1, 1)
            notices = {entry.folder: entry.joint_notices for entry in joint.recorded}
            outcomes = tuple(replace(outcome, notices=notices.get(outcome.folder.name)) for outcome in outcomes)
    return outcomes


def _with_notices(outcome: Outcome) -> Outcome:
    """Return an outcome with the notices of results that were there already."""
    if outcome.notices is not None or outcome.error is not None:
        return outcome
    with open_results(outcome.folder / RESULT_FILE, "notices") as file:
        return replace(outcome, notices=read_notices(file))


def is_campaign(path: Path) -> bool:
    """Whether a path is a folder of recordings instead of one of them."""
    return path.is_dir() and not (path / RECORDING_NAME).is_file()


def exit_status(outcomes: Sequence[Outcome]) -> int:
    """Return 0 when every driven line has a result, 2 when the input of a recording is wrong, else 1."""
    errors = [outcome.error for outcome in outcomes if outcome.error is not None]
    if any(isinstance(error, InputError) for error in errors):
        return 2
    return 1 if errors or any(outcome.missing for outcome in outcomes) else 0


def _executor(workers: int | str) -> AbstractContextManager[Executor | None]:
    """Return those who compute; None is this process."""
    if isinstance(workers, str):
        return connect_cluster(workers)
    return Workers(workers) if workers > 1 else nullcontext()


def _run_one(job: Job, executor: Executor | None, progress: ProgressCallback) -> Outcome:
    """Run a recording here; an executor follows its images, by paths that hold for a process of any working folder."""
    if executor is None:
        return run_job(job, progress)
    return replace(run_job(job.with_absolute_paths(), progress, executor), recording=job.recording, folder=job.folder)


def _run_here(jobs: Sequence[Job], executor: Executor | None, progress: ProgressCallback) -> tuple[Outcome, ...]:
    """Run one recording after another; what fails is kept in its outcome."""
    outcomes = []
    for done, job in enumerate(jobs):
        progress(RECORDINGS, done, len(jobs))
        outcomes.append(_outcome(job, partial(_run_one, job, executor, progress)))
    progress(RECORDINGS, len(jobs), len(jobs))
    return tuple(outcomes)


def _run_elsewhere(jobs: Sequence[Job], executor: Executor, progress: ProgressCallback) -> tuple[Outcome, ...]:
    """Have all recordings computed by others; the outcomes are in the recordings' order, whoever was first."""
    answered: SimpleQueue[int] = SimpleQueue()
    pending: list[Pending] = [
        executor.submit(rank, run_job, job.with_absolute_paths(executor.patience_s)) for rank, job in enumerate(jobs)
    ]
    for rank, answer in enumerate(pending):
        answer.add_done_callback(partial(_tell, answered, rank))
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


def _tell(answered: SimpleQueue[int], rank: int, _: object) -> None:
    answered.put(rank)


def _received(job: Job, pending: Pending) -> Outcome:
    """Return the outcome that a task brings, in the paths that the user knows, after what it logged."""
    answer = pending.result()
    answer.log(job.recording.absolute().parent.name)
    outcome: Outcome = answer.unwrap()
    return replace(outcome, recording=job.recording, folder=job.folder)


def _outcome(job: Job, work: Callable[[], Outcome]) -> Outcome:
    """Do the work for a recording of a campaign; its failure is kept in the outcome."""
    try:
        return work()
    except Exception as error:
        if is_interruption(error):
            raise
        failure = as_user_error(error)
        log.error("%s", failure)
        log.debug("traceback", exc_info=error)
        return Outcome(job.recording, job.folder, error=failure)
