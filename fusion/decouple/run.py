"""The command `shakercal decouple`: recordings of releases → model, filter, result folder."""

from __future__ import annotations

import logging
from pathlib import Path

from fusion.decouple.evaluate import evaluate_decoupling
from fusion.decouple.page import PAGE_FILE
from fusion.decouple.result import DecoupleSettings
from fusion.decouple.results import H5_FILE, write_decoupling
from fusion.decouple.tables import printed
from fusion.evaluated import log_notices
from fusion.execution.threads import one_blas_thread
from fusion.provenance import check_folder, hash_files
from fusion.step.run import step_manifests

log = logging.getLogger("shakercal")
DEFAULT_FOLDER = "decouple"


def run_decouple(
    path: Path, output: Path | None, settings: DecoupleSettings, *, force: bool = False, allow_outside: bool = False
) -> None:
    """Evaluate all releases of a campaign together, write the results and print the summary.

    Results stand in the campaign's folder `decouple` or in `output`. A place that cannot take them is refused before
    anything is computed.
    """
    manifests = step_manifests(path, allow_outside=allow_outside)
    folder = (path if path.is_dir() else path.parent) / DEFAULT_FOLDER if output is None else output
    hashes = hash_files([file for manifest in manifests for file in manifest.files], manifests[0].root)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    with one_blas_thread():
        evaluation = evaluate_decoupling(manifests[0].rig.name, manifests, settings, hashes)
    log_notices(evaluation, log)
    write_decoupling(evaluation, folder, force=force)
    print(evaluation.name)
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")
