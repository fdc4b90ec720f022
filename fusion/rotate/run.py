"""The command `shakercal rotate`: recordings → masses, result folder."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from fusion.evaluated import default_folder, log_notices
from fusion.manifest import Manifest, find_recordings, for_kinds, load_manifest
from fusion.provenance import check_folder, hash_files
from fusion.rotate.evaluate import KIND, check_kind, evaluate_rotation
from fusion.rotate.page import PAGE_FILE
from fusion.rotate.results import H5_FILE, write_rotation
from fusion.rotate.tables import printed

log = logging.getLogger("shakercal")
DEFAULT_FOLDER = "rotate"


def run_rotate(paths: Sequence[Path], output: Path | None, *, force: bool = False, allow_outside: bool = False) -> None:
    """Evaluate the rotation recordings at some paths together, write the results and print the summary.

    Of a campaign folder those of kind rotation are taken. Results stand in its folder `rotate`, or in that of the only
    recording, or, of several paths, beside rig.toml; or in `output`.
    """
    manifests = [manifest for path in paths for manifest in _manifests(path, allow_outside)]
    distinct = {manifest.path.resolve(): manifest for manifest in manifests}.values()
    manifests = sorted(distinct, key=lambda manifest: bool(manifest.excitation.with_load))
    folder = default_folder(paths, manifests, DEFAULT_FOLDER) if output is None else output
    hashes = hash_files([file for manifest in manifests for file in manifest.files], manifests[0].root)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    name = manifests[0].name if len(manifests) == 1 else manifests[0].rig.name
    evaluation = evaluate_rotation(name, manifests, hashes)
    log_notices(evaluation, log)
    write_rotation(evaluation, folder, force=force)
    print(evaluation.name)
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")


def _manifests(path: Path, allow_outside: bool) -> list[Manifest]:
    """The rotation recordings at a path; of a campaign's others the user is told."""
    found = find_recordings(path)
    recordings = for_kinds(found, (KIND,))
    manifests = [load_manifest(recording, allow_outside=allow_outside) for recording in recordings]
    for manifest in manifests:
        check_kind(manifest)
    others = [recording.parent.name for recording in found if recording not in recordings]
    if others:
        log.info("%s: left out, since their kind is not %s: %s", path, KIND, ", ".join(others))
    return manifests
