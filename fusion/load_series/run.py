"""The command `shakercal load`: recordings with several loads, or a table of resonances → load characteristics."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from fusion.evaluated import default_folder, log_notices
from fusion.load_series.evaluate import evaluate_loads
from fusion.load_series.page import PAGE_FILE
from fusion.load_series.result import LoadEvaluation
from fusion.load_series.results import H5_FILE, write_loads
from fusion.load_series.series import read_series
from fusion.load_series.settings import LoadSettings
from fusion.load_series.table import read_table
from fusion.load_series.tables import printed
from fusion.provenance import check_folder, hash_files
from fusion.step.run import step_manifests

log = logging.getLogger("shakercal")
DEFAULT_FOLDER = "load"


def run_loads(
    paths: Sequence[Path],
    output: Path | None,
    settings: LoadSettings,
    *,
    force: bool = False,
    allow_outside: bool = False,
) -> None:
    """Evaluate the step recordings at some paths together, write the results and print the summary.

    Results stand in folder `load` of the campaign or of the only recording, or, of several paths, beside the first
    recording's rig; or in `output`.
    """
    found = [manifest for path in paths for manifest in step_manifests(path, allow_outside=allow_outside)]
    manifests = list({manifest.path.resolve(): manifest for manifest in found}.values())
    folder = default_folder(paths, manifests, DEFAULT_FOLDER) if output is None else output
    hashes = hash_files([file for manifest in manifests for file in manifest.files], manifests[0].root)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    series, notices = read_series(manifests)
    name = manifests[0].name if len(manifests) == 1 else f"loads of {folder.absolute().parent.name}"
    evaluation = evaluate_loads(name, series, notices, settings, hashes, manifests[0])
    _finish(evaluation, folder, force=force)


def run_table(table: Path, output: Path | None, settings: LoadSettings, *, force: bool = False) -> None:
    """Evaluate a table of resonances, for which the settings hold the moving mass; write and print as `run_loads`.

    Results stand in `output`, or in folder `load` beside the table.
    """
    if settings.moving_mass is None:
        raise ValueError("settings: expected the moving mass that the table's resonances belong to, found none")
    series = read_table(table, *settings.moving_mass)
    folder = table.parent / DEFAULT_FOLDER if output is None else output
    hashes = hash_files([table], table.absolute().parent)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    evaluation = evaluate_loads(table.stem, (series,), (), settings, hashes)
    _finish(evaluation, folder, force=force)


def _finish(evaluation: LoadEvaluation, folder: Path, *, force: bool) -> None:
    """Tell, write, print."""
    log_notices(evaluation, log)
    write_loads(evaluation, folder, force=force)
    print(evaluation.name)
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")
