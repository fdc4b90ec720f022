"""One recording or a folder of several: evaluate, write, resume, merge."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fusion.errors import ComputeError, InputError
from fusion.evaluate import evaluate_recording
from fusion.manifest import RECORDING_NAME, find_recordings, load_manifest
from fusion.provenance import check_folder, hash_files, is_current
from fusion.results import check_campaign_folder, merge_results, write_results
from fusion.settings import ProgressCallback, Settings, no_progress

log = logging.getLogger("shakercal")


@dataclass(frozen=True)
class Outcome:
    """What became of one recording: its results folder, or the reason why there is none.

    `resumed`: the results of the same inputs, settings and program version were there already.
    """

    recording: Path
    folder: Path
    resumed: bool = False
    error: InputError | ComputeError | None = None


def run_path(
    path: Path,
    output: Path | None,
    settings: Settings,
    *,
    force: bool = False,
    allow_outside: bool = False,
    progress: ProgressCallback = no_progress,
) -> tuple[Outcome, ...]:
    """Evaluate a recording, or every recording of a campaign folder, and write the result files.

    A recording writes to `output` (default RECORDING/results). A campaign writes one folder per recording below
    `output` (default CAMPAIGN/results) and the merged tables at its top; a recording that fails does not stop the
    others. A single recording's failure is raised.
    """
    recordings = find_recordings(path)
    if path.is_file() or (path / RECORDING_NAME).is_file():
        folder = recordings[0].parent / "results" if output is None else output
        return (_run(recordings[0], folder, settings, force, allow_outside, progress),)
    top = path / "results" if output is None else output
    check_campaign_folder(top, [recording.parent.name for recording in recordings], force=force)
    outcomes = [
        _run_guarded(recording, top / recording.parent.name, settings, force, allow_outside, progress)
        for recording in recordings
    ]
    finished = [outcome.folder for outcome in outcomes if outcome.error is None]
    if finished:
        merge_results(finished, top)
    return tuple(outcomes)


def _run_guarded(
    recording: Path, folder: Path, settings: Settings, force: bool, allow_outside: bool, progress: ProgressCallback
) -> Outcome:
    """Run one recording of a campaign; its failure is kept in the outcome."""
    try:
        return _run(recording, folder, settings, force, allow_outside, progress)
    except (InputError, ComputeError) as error:
        log.error("%s", error)
        return Outcome(recording, folder, error=error)


def _run(
    recording: Path, folder: Path, settings: Settings, force: bool, allow_outside: bool, progress: ProgressCallback
) -> Outcome:
    """Evaluate one recording unless its results are there, and write them."""
    manifest = load_manifest(recording, allow_outside=allow_outside)
    hashes = hash_files(manifest.files, manifest.root)
    if not force and is_current(folder, hashes, settings.as_dict()):
        log.info("%s: results of the same input are there, nothing to compute", folder)
        return Outcome(recording, folder, resumed=True)
    check_folder(folder, hashes, force=force)
    evaluation = evaluate_recording(manifest, settings, hashes, progress)
    for notice in evaluation.notices:
        log.log(logging.WARNING if notice.severity == "warning" else logging.DEBUG, "%s", notice.text)
    write_results(evaluation, folder, force=force)
    return Outcome(recording, folder)


def exit_status(outcomes: Sequence[Outcome]) -> int:
    """Return 0 when all recordings are done, 2 when the input of one is wrong, 1 when one could not be computed."""
    errors = [outcome.error for outcome in outcomes if outcome.error is not None]
    if any(isinstance(error, InputError) for error in errors):
        return 2
    return 1 if errors else 0
