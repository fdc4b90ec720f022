"""The command `shakercal transfer`: recordings → curves, resonances, result folders."""

from __future__ import annotations

import logging
from pathlib import Path

from fusion.evaluated import log_notices
from fusion.manifest import Manifest, find_recordings, for_kinds, load_manifest
from fusion.provenance import check_folder, hash_files
from fusion.transfer.evaluate import KINDS, check_kind, evaluate_transfer
from fusion.transfer.page import PAGE_FILE
from fusion.transfer.result import TransferSettings
from fusion.transfer.results import H5_FILE, write_transfer
from fusion.transfer.tables import printed

log = logging.getLogger("shakercal")
DEFAULT_FOLDER = "transfer"


def run_transfer(
    path: Path, output: Path | None, settings: TransferSettings, *, force: bool = False, allow_outside: bool = False
) -> None:
    """Evaluate the recording, or every recording of a campaign folder, write the results and print the summary.

    Results stand in the recording's own folder `transfer`, or in `output` (of a campaign: in a folder each). Of a
    campaign, recordings of other kinds are left out.
    """
    recordings = for_kinds(find_recordings(path), KINDS)
    manifests = [load_manifest(recording, allow_outside=allow_outside) for recording in recordings]
    for manifest in manifests:
        check_kind(manifest)
    for manifest in manifests:
        folder = manifest.folder / DEFAULT_FOLDER if output is None else output
        if output is not None and len(manifests) > 1:
            folder = output / manifest.folder.name
        _run_one(manifest, folder, settings, force)


def _run_one(manifest: Manifest, folder: Path, settings: TransferSettings, force: bool) -> None:
    """Evaluate one recording; a place that cannot take the results is refused before anything is computed."""
    hashes = hash_files(manifest.files, manifest.root)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    evaluation = evaluate_transfer(manifest, settings, hashes)
    log_notices(evaluation, log)
    write_transfer(evaluation, folder, force=force)
    print(f"{manifest.name}")
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")
