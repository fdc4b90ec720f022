"""One recording: evaluate and write, unless its results are there."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

from fusion.crew import Crew
from fusion.errors import ComputeError, InputError
from fusion.evaluate import evaluate_recording
from fusion.execution.threads import one_blas_thread
from fusion.manifest import load_manifest
from fusion.output import remove_abandoned
from fusion.provenance import check_folder, hash_files, is_current
from fusion.results import write_results
from fusion.settings import ProgressCallback, Settings, no_progress

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


def run_job(job: Job, progress: ProgressCallback = no_progress, crew: Crew | None = None) -> Outcome:
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
