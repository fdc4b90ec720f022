"""The folder of a transfer recording's results: table, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import h5py

from fusion.provenance import Provenance, write_provenance
from fusion.results import write_folder
from fusion.results_csv import csv_text
from fusion.results_h5 import write_fields
from fusion.transfer.page import PAGE_FILE, render_transfer_page
from fusion.transfer.result import TransferEvaluation
from fusion.transfer.tables import COLUMNS, transfer_rows

FORMAT = 1
TABLE_FILE, H5_FILE = "transfer.csv", "transfer.h5"
OWN_FILE = re.compile(r"transfer\.(csv|h5|html)")


def write_transfer(evaluation: TransferEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file of one recording and return their paths; other folders are refused unless `force`."""
    fill = partial(_fill, evaluation=evaluation)
    return write_folder(folder, evaluation.input_hashes, fill, force=force, marker=H5_FILE, own=OWN_FILE)


def _fill(folder: Path, evaluation: TransferEvaluation) -> list[str]:
    """Make all files in a folder; the HDF5 file, which says that the folder is complete, comes last."""
    texts = {
        TABLE_FILE: csv_text(COLUMNS, transfer_rows(evaluation)),
        PAGE_FILE: render_transfer_page(evaluation),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    names = [*texts, H5_FILE]
    origin = Provenance(evaluation.input_hashes, evaluation.settings, evaluation.versions, tuple(names))
    with h5py.File(folder / H5_FILE, "w", track_order=True) as file:
        file.attrs["format"] = FORMAT
        file.attrs["recording"] = evaluation.manifest.name
        file.attrs["rig"] = evaluation.manifest.rig.name
        file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
        write_provenance(file, origin)
        write_fields(file, evaluation)
    return names
