"""The command `shakercal elastomer`: GEOMETRY.toml → models, result folder."""

from __future__ import annotations

import logging
from pathlib import Path

from fusion.elastomer.definition import read_definition
from fusion.elastomer.evaluate import evaluate_element
from fusion.elastomer.page import PAGE_FILE
from fusion.elastomer.results import H5_FILE, write_element
from fusion.elastomer.tables import printed
from fusion.evaluated import log_notices
from fusion.provenance import check_folder, hash_files
from fusion.settings import ProgressCallback, no_progress

log = logging.getLogger("shakercal")
DEFAULT_FOLDER, FILE_NAME = "elastomer", "elastomer.toml"


def run_elastomer(
    path: Path,
    output: Path | None,
    *,
    solid: bool = False,
    force: bool = False,
    progress: ProgressCallback = no_progress,
) -> None:
    """Model the element that a file (or elastomer.toml in a folder) states, write the results, print the comparison.

    Results stand in the folder `elastomer` beside the file, or in `output`.
    """
    file = path / FILE_NAME if path.is_dir() else path
    definition = read_definition(file)
    folder = file.parent / DEFAULT_FOLDER if output is None else output
    hashes = hash_files(definition.files, file.parent)
    check_folder(folder, hashes, force=force, marker=H5_FILE)
    evaluation = evaluate_element(definition, hashes, solid=solid, progress=progress)
    log_notices(evaluation, log)
    write_element(evaluation, folder, force=force)
    print(evaluation.name)
    for line in printed(evaluation):
        print(line)
    print(f"report: {folder / PAGE_FILE}")
