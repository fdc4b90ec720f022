"""One recording or a campaign of several: evaluated where new or changed, told on the terminal."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

from fusion.base import (
    DASH,
    ComputeError,
    Executor,
    InputError,
    Pending,
    ProgressCallback,
    Settings,
    is_interruption,
    no_progress,
    rounded,
    stdout_console,
    told,
    undone,
    versions,
)
from fusion.campaign.executor import Workers, connected, one_blas_thread
from fusion.campaign.joint import best_kind
from fusion.campaign.joint_report import write_campaign
from fusion.estimation.coverage import Polar
from fusion.recording.excitation import kinds_of
from fusion.recording.load import RECORDING_NAME, find_recordings, for_kinds, load_manifest
from fusion.report.files import Kept, claimed, remove_abandoned, workshop
from fusion.report.folder import CURVE_FILE, SENSITIVITY_FILE, check_folder, hash_files, is_current, origin_key
from fusion.report.recording import REPORT_FILE, check_campaign_folder, row_element, write_results
from fusion.report.table import both, factor, has_phase, read_rows
from fusion.report.tables import result_name
from fusion.sensitivity.evaluate import evaluate_recording

if TYPE_CHECKING:
    from rich.table import Table

RECORDINGS = "recordings"
LISTEN_S = 0.5  # between looks for an interruption
SHARED_FRAMES = 2  # workers per recording from which on they share its frames instead of the recordings
MOST_LINES, MOST_ROWS = 100, 300  # that the terminal shows: recordings, rows of the sensitivity
NO_SENSITIVITY = "no sensitivity: see the report for what was observed"
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

    def placed(self, patience_s: float = 0.0) -> Job:
        """Return the job with paths that hold for a process of any working folder."""
        recording, folder = self.recording.absolute(), self.folder.absolute()
        return replace(self, recording=recording, folder=folder, patience_s=patience_s)


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

    @property
    def told(self) -> str:
        """Where the report lies, or why there is none."""
        what = "unchanged since the last run" if self.resumed else "written"
        return f"failed, {self.error}" if self.error is not None else f"report ({what}): {self.folder / REPORT_FILE}"


def run_job(job: Job, progress: ProgressCallback = no_progress, executor: Executor | None = None) -> Outcome:
    """Evaluate one recording unless its results are there, and write them; an executor follows its images."""
    manifest = load_manifest(job.recording, allow_outside=job.allow_outside)
    inputs = hash_files(manifest.files, manifest.root, manifest.read)
    there = partial(is_current, job.folder, inputs.hashes, job.settings.as_dict())
    if not job.force and there():
        log.info("%s: results of the same input are there, nothing to compute", job.folder)
        return Outcome(job.recording, job.folder, resumed=True)
    check_folder(job.folder, inputs.hashes, force=job.force)
    with claimed(job.folder, job.patience_s), one_blas_thread():
        if job.patience_s and not job.force and there():  # whoever had it has finished it meanwhile
            return Outcome(job.recording, job.folder)
        kept = Kept(job.folder, origin_key(inputs.hashes, job.settings.as_dict(), versions()))
        evaluation = evaluate_recording(manifest, job.settings, inputs.hashes, progress, executor, kept)
        for notice in evaluation.notices:
            log.log(logging.WARNING if notice.severity == "warning" else logging.DEBUG, "%s", notice.text)
        write_results(evaluation, job.folder, inputs, force=job.force)
        kept.remove()
    return Outcome(job.recording, job.folder)


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
        recordings = for_kinds(recordings, kinds_of("run"))
    top = (recordings[0].parent if alone else path) / "results" if output is None else Path(output)
    folders = [top] if alone else [top / recording.parent.name for recording in recordings]
    jobs = [
        Job(recording, folder, settings, force, allow_outside)
        for recording, folder in zip(recordings, folders, strict=True)
    ]
    if not alone:
        check_campaign_folder(top, [folder.name for folder in folders], force=force)
    above = workshop(top) if alone else top
    # What processes left that have ended is removed from the folder above the results, before and after.
    remove_abandoned(above)
    with nullcontext() if alone else claimed(top), undone(partial(remove_abandoned, above)):
        with _executor(workers) as executor:
            if alone:
                return (_run_one(jobs[0], executor, progress),)
            if executor is None or SHARED_FRAMES * len(jobs) <= executor.size:
                outcomes = _run_here(jobs, executor, progress)
            else:
                outcomes = _run_elsewhere(jobs, executor, progress)
        finished = [outcome.folder for outcome in outcomes if outcome.error is None]
        failed = {outcome.name: str(outcome.error) for outcome in outcomes if outcome.error is not None}
        if finished:
            with one_blas_thread():
                write_campaign(top, path.resolve().name, finished, failed)
    return outcomes


def is_campaign(path: Path) -> bool:
    """Whether a path is a folder of recordings instead of one of them."""
    return path.is_dir() and not (path / RECORDING_NAME).is_file()


def exit_status(outcomes: Sequence[Outcome]) -> int:
    """Return 0 when all recordings are done, 2 when the input of one is wrong, 1 when one could not be computed."""
    errors = [outcome.error for outcome in outcomes if outcome.error is not None]
    if any(isinstance(error, InputError) for error in errors):
        return 2
    return 1 if errors else 0


def _executor(workers: int | str) -> AbstractContextManager[Executor | None]:
    """Return those who compute; None is this process."""
    if isinstance(workers, str):
        return connected(workers)
    return Workers(workers) if workers > 1 else nullcontext()


def _run_one(job: Job, executor: Executor | None, progress: ProgressCallback) -> Outcome:
    """Run a recording here; an executor follows its images, by paths that hold for a process of any working folder."""
    if executor is None:
        return run_job(job, progress)
    return replace(run_job(job.placed(), progress, executor), recording=job.recording, folder=job.folder)


def _run_here(jobs: Sequence[Job], executor: Executor | None, progress: ProgressCallback) -> tuple[Outcome, ...]:
    """Run one recording after another; what fails is kept in its outcome."""
    outcomes = []
    for done, job in enumerate(jobs):
        progress(RECORDINGS, done, len(jobs))
        outcomes.append(_outcome(job, partial(_run_one, job, executor, progress)))
    return tuple(outcomes)


def _run_elsewhere(jobs: Sequence[Job], executor: Executor, progress: ProgressCallback) -> tuple[Outcome, ...]:
    """Have all recordings computed by others; the outcomes are in the recordings' order, whoever was first."""
    answered: SimpleQueue[int] = SimpleQueue()
    pending: list[Pending] = [
        executor.submit(rank, run_job, job.placed(executor.patience_s)) for rank, job in enumerate(jobs)
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
    return tuple(outcomes[rank] for rank in range(len(jobs)))


def _tell(answered: SimpleQueue[int], rank: int, _: object) -> None:
    answered.put(rank)


def _received(job: Job, pending: Pending) -> Outcome:
    """Return the outcome that a task brings, in the paths that the user knows, after what it logged."""
    answer = pending.result()
    answer.log(job.recording.absolute().parent.name)
    outcome: Outcome = answer.opened()
    return replace(outcome, recording=job.recording, folder=job.folder)


def _outcome(job: Job, work: Callable[[], Outcome]) -> Outcome:
    """Do the work for a recording of a campaign; its failure is kept in the outcome."""
    try:
        return work()
    except Exception as error:
        if is_interruption(error):
            raise
        failure = told(error)
        log.error("%s", failure)
        log.debug("traceback", exc_info=error)
        return Outcome(job.recording, job.folder, error=failure)


# What the command prints when it is done: what became of the recordings, the sensitivity, where the report lies.


def print_recording(outcome: Outcome) -> None:
    """Print the sensitivity of a recording with expanded uncertainty, and the path of its report."""
    console = stdout_console()
    rows = read_rows(outcome.folder / SENSITIVITY_FILE)
    console.print(sensitivity_table(rows) if rows else NO_SENSITIVITY)
    console.print(outcome.told, soft_wrap=True)


def sensitivity_table(rows: Sequence[dict[str, str]]) -> Table:
    """Return the rows of a recording's sensitivity.csv as a table with U = k·u for 95 %, two significant digits of it.

    Of a value that is not distinguishable from 0 the half-axes of its region stand in place of magnitude and phase.
    A ratio is left out where the recording gives the sensor's element.
    """

    def of(row: dict[str, str], *keys: str) -> tuple[str, ...]:
        return tuple(row[key] for key in ("frequency_hz", "component", *keys))

    own = {of(row, "channel") for row in rows if row["kind"] == "element"}
    shown = [row for row in rows if row["kind"] != "ratio" or of(row, "channel") not in own]
    mains = _main_channels(shown, of)
    head = "Sensitivity" if own else "Output over load"
    table = _table(f"{head}, {rows[0]['recording']} (U = k·u, 95 %)")
    for row in sorted(shown, key=lambda row: float(row["frequency_hz"])):
        table.add_row(*_row(row, main=mains[of(row)] == row["channel"]))
    return table


def curve_table(rows: Sequence[dict[str, str]]) -> Table:
    """Return from the rows of a curve.csv the best statement of every main element over frequency, with U as above.

    Of each element those of one kind (`best_kind`).
    """
    mains = _main_channels(rows, lambda row: (row["component"],))
    found: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        if mains[(row["component"],)] == row["channel"]:
            found.setdefault(row["component"], []).append(row)
    best = [row for of_one in found.values() for row in best_kind(of_one, lambda row: row["kind"])]
    known = any(row["kind"] != "ratio" for row in best)
    table = _table(f"{'Sensitivity' if known else 'Output over load'}, means of all recordings (U = k·u, 95 %)")
    table.add_column("recordings (mountings)", justify="right", max_width=12)
    for row in sorted(best, key=lambda row: (row["component"], float(row["frequency_hz"])))[:MOST_ROWS]:
        table.add_row(*_row(row, main=True), f"{row['recordings']} ({row['mountings']})")
    return table


def _main_channels(
    rows: Sequence[dict[str, str]], of: Callable[[dict[str, str]], tuple[str, ...]]
) -> dict[tuple[str, ...], str]:
    """Return for rows that are alike by `of` the output of the load's name, else the largest one."""
    mains: dict[tuple[str, ...], str] = {}
    for row in sorted(rows, key=lambda row: (row["channel"] != row["component"], -float(row["magnitude"]))):
        mains.setdefault(of(row), row["channel"])
    return mains


def _table(title: str) -> Table:
    """Return an empty table of sensitivities."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for head in ("frequency / Hz", "quantity", "magnitude ± U", "unit", "phase ± U / rad", "k", "kind"):
        left = head in ("quantity", "unit", "kind")
        table.add_column(head, justify="left" if left else "right", no_wrap=head == "quantity")
    return table


def _row(row: dict[str, str], *, main: bool) -> tuple[str, ...]:
    """Return the cells of a sensitivity."""
    name = result_name(row["kind"], row["channel"], row["component"], main=main)
    magnitude, phase, k_factor = _cells(row_element(row))
    return f"{float(row['frequency_hz']):.4f}", name, magnitude, row["unit"], phase, k_factor, row["kind"]


def _cells(element: Polar) -> tuple[str, str, str]:
    """Magnitude and phase with U, and k; both with the power of ten that value and U share."""

    def with_u(value: float, expanded: float) -> str:
        text = rounded(value, expanded)
        pair = f"{text.value} ± {text.expanded}"
        return f"({pair})e{text.exponent:d}" if text.exponent else pair

    if not element.region.holds_zero:
        magnitude = with_u(element.magnitude, element.expanded_magnitude)
        k_factors = both(factor(element.k), factor(element.k_phase))
        turned = with_u(element.phase_rad, element.expanded_phase_rad) if has_phase(element) else DASH
        return magnitude, turned, k_factors
    large, small = element.region.half_axes
    first = rounded(large, large)
    second = rounded(small, large, first.exponent)
    pair = f"(region ± {first.value}, ± {second.value})" + (f"e{first.exponent:d}" if first.exponent else "")
    return pair, "not distinguishable from 0", f"{element.region_factor:.2f}"


def print_campaign(outcomes: Sequence[Outcome]) -> None:
    """Print one line per recording, each failure with its reason, how many there are of each, and the joint report.

    Of many recordings the first ones and all failures. Of several the means, of one all that it tells.
    """
    console = stdout_console()
    shown = [outcome for place, outcome in enumerate(outcomes) if place < MOST_LINES or outcome.error is not None]
    for outcome in shown:
        console.print(f"{outcome.name}: {outcome.told}", soft_wrap=True)
    if len(shown) < len(outcomes):
        console.print(f"and {len(outcomes) - len(shown)} more, each in a folder of its own")
    console.print(tally(outcomes))
    done = [outcome for outcome in outcomes if outcome.error is None]
    if done:
        top = done[0].folder.parent
        several = len(done) > 1
        rows = read_rows(top / (CURVE_FILE if several else SENSITIVITY_FILE))
        of_rows = curve_table if several else sensitivity_table
        console.print(of_rows(rows) if rows else NO_SENSITIVITY)
        if rows and several:
            told = f"all elements: {top / CURVE_FILE}; of every recording: {top / SENSITIVITY_FILE}"
            console.print(told, soft_wrap=True)
        console.print(f"report of all: {top / REPORT_FILE}", soft_wrap=True)


def tally(outcomes: Sequence[Outcome]) -> str:
    """Return how many recordings were finished, were done before, and failed."""
    failed = sum(outcome.error is not None for outcome in outcomes)
    resumed = sum(outcome.resumed for outcome in outcomes)
    parts = [(len(outcomes) - failed - resumed, "evaluated"), (resumed, "unchanged since the last run")]
    told = ", ".join(f"{count} {what}" for count, what in (*parts, (failed, "failed")) if count)
    return f"{len(outcomes)} recording{'' if len(outcomes) == 1 else 's'}: {told}"
