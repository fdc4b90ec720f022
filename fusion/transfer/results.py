"""The folder of a transfer recording's results: table, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from pathlib import Path

import h5py

from fusion.evaluated import ResultFolder
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
    return ResultFolder(H5_FILE, OWN_FILE, _texts, _fill).write(evaluation, folder, force=force)


def _texts(evaluation: TransferEvaluation) -> dict[str, str]:
    """Table and page."""
    return {
        TABLE_FILE: csv_text(COLUMNS, transfer_rows(evaluation)),
        PAGE_FILE: render_transfer_page(evaluation),
    }


def _fill(file: h5py.File, evaluation: TransferEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["recording"] = evaluation.manifest.name
    file.attrs["rig"] = evaluation.manifest.rig.name
    file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
    write_fields(file, evaluation)
