"""The results folder: tables, HDF5 file and report, whole or not at all."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from fusion.errors import InputError
from fusion.evaluation import Evaluation
from fusion.output import temporary_beside
from fusion.provenance import RESULT_FILE, check_folder, read_provenance
from fusion.report import REPORT_FILE, render_report
from fusion.results_csv import MERGED_FILES, result_tables
from fusion.results_h5 import write_h5

CURVE_FILE, CROSSTALK_FILE, CAMPAIGN_FILE = "curve.csv", "crosstalk.csv", "campaign.h5"
CAMPAIGN_FILES = (*MERGED_FILES, CURVE_FILE, CROSSTALK_FILE, REPORT_FILE, CAMPAIGN_FILE)
"""Files at the top of a campaign's results."""
OWN_FILE = re.compile(r"(sensitivity|acceleration|load|motion-.+)\.csv|result\.h5|report\.html")


def write_results(evaluation: Evaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file of one recording and return their paths, as `write_folder` does."""
    fill = partial(_fill, evaluation=evaluation)
    return write_folder(folder, evaluation.input_hashes, fill, force=force, marker=RESULT_FILE, own=OWN_FILE)


def write_folder(
    folder: Path,
    hashes: Mapping[str, str],
    fill: Callable[[Path], Sequence[str]],
    *,
    force: bool,
    marker: str,
    own: re.Pattern[str],
) -> list[Path]:
    """Write a folder of results of the inputs `hashes` and return the paths of its files.

    `fill` makes all files in a temporary folder beside `folder` and names them; then they are moved, so a failure
    leaves `folder` as it was. A folder that holds anything but results of the same inputs (its file `marker` says so)
    is refused unless `force`; even then only files of the program's `own` names are replaced, and nothing else is
    touched.
    """
    folder = folder.resolve()
    check_folder(folder, hashes, force=force, marker=marker)
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_beside(folder)
    temporary.mkdir()
    try:
        names = fill(temporary)
        _move(temporary, folder, names, marker, own)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return [folder / name for name in names]


def check_campaign_folder(top: Path, recordings: Sequence[str], *, force: bool) -> None:
    """Refuse a place for a campaign's results that holds something else, or joint files without their recordings.

    `recordings`: names of the recordings' folders, each of which is checked when its turn comes. Hidden files are
    none of the program's business.
    """
    check_folder(top, {}, force=True)
    names = {entry.name for entry in top.iterdir()} if top.exists() and not force else set()
    ours = {name for name in names if name in recordings or read_provenance(top / name) is not None}
    other = {name for name in names - ours if not name.startswith(".") and not (ours and name in CAMPAIGN_FILES)}
    if other:
        expected = "results of this campaign only (--force writes beside them and replaces only result files)"
        raise InputError(top, "", found=f"other files, for example {min(other)}", expected=expected)


def _fill(folder: Path, evaluation: Evaluation) -> list[str]:
    """Make all files in a folder; the HDF5 file, which says that the folder is complete, comes last."""
    tables = result_tables(evaluation)
    for name, text in tables.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    (folder / REPORT_FILE).write_text(render_report(evaluation), encoding="utf-8", newline="\n")
    names = [*tables, REPORT_FILE, RESULT_FILE]
    write_h5(folder / RESULT_FILE, evaluation, names)
    return names


def _move(temporary: Path, folder: Path, names: Sequence[str], marker: str, own: re.Pattern[str]) -> None:
    """Put the finished files in place: the folder as a whole, else, where it holds files of others, file by file."""
    if not folder.exists():
        os.replace(temporary, folder)
        return
    before = read_provenance(folder, marker)
    written = before.files if before is not None else ()
    if {entry.name for entry in folder.iterdir()} <= {marker, *written} and _swapped(temporary, folder):
        return
    (folder / marker).unlink(missing_ok=True)
    for name in written:
        if name not in names and own.fullmatch(name):
            (folder / name).unlink(missing_ok=True)
    for name in names:
        os.replace(temporary / name, folder / name)


def _swapped(temporary: Path, folder: Path) -> bool:
    """Put one folder in the place of another, so that whoever is killed meanwhile leaves no half of either.

    False where the system does not give the place free, such as a mounted folder.
    """
    old = temporary_beside(folder.with_name(f"{folder.name}.old"))
    try:
        os.replace(folder, old)
    except OSError:
        return False
    try:
        os.replace(temporary, folder)
    except OSError:
        os.replace(old, folder)
        raise
    shutil.rmtree(old, ignore_errors=True)
    return True
