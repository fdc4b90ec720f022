"""The command `shakercal step`: recordings of releases → models, result folder."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from fusion.evaluated import default_folder, log_notices
from fusion.execution.threads import one_blas_thread
from fusion.manifest import Manifest, find_recordings, for_kinds, load_manifest
from fusion.provenance import check_folder, hash_files
from fusion.step.evaluate import evaluate_steps
from fusion.step.page import PAGE_FILE
from fusion.step.records import KIND, check_kind
from fusion.step.results import H5_FILE, write_steps
from fusion.step.settings import StepSettings
from fusion.step.tables import printed

log = logging.getLogger("shakercal")
DEFAULT_FOLDER = "step"


def run_step(
    paths: Sequence[Path],
    output: Path | None,
    settings: StepSettings,
    *,
    force: bool = False,
    allow_outside: bool = False,
) -> None:
    """Evaluate the step recordings at some paths together, write the results and print the summary.

    Of a campaign folder those of kind step are taken. Results stand in its folder `step`, or in that of the only
    recording, or, of several paths, beside rig.toml; or in `output`. A place that cannot take them is refused before
    anything is computed.
    """
    found = [manifest for path in paths for manifest in step_manifests(path, allow_outside=allow_outside)]
    manifests = list({manifest.path.resolve(): manifest for manifest in found}.values())
    folder = default_folder(paths, manifests, DEFAULT_FOLDER) if output is None else output
    hashes = hash_files([file for manifest in manifests for file in manifest.files], manifests[0].root)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    name = manifests[0].name if len(manifests) == 1 else manifests[0].rig.name
    with one_blas_thread():
        evaluation = evaluate_steps(name, manifests, settings, hashes)
    log_notices(evaluation, log)
    write_steps(evaluation, folder, force=force)
    print(evaluation.name)
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")


def step_manifests(path: Path, *, allow_outside: bool = False) -> list[Manifest]:
    """Return the step recordings at a path; of a campaign's others the user is told. Raises `InputError`."""
    found = find_recordings(path)
    recordings = for_kinds(found, (KIND,))
    manifests = [load_manifest(recording, allow_outside=allow_outside) for recording in recordings]
    for manifest in manifests:
        check_kind(manifest)
    others = [recording.parent.name for recording in found if recording not in recordings]
    if others:
        log.info("%s: left out, since their kind is not %s: %s", path, KIND, ", ".join(others))
    return manifests
