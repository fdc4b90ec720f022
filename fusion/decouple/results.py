"""The folder of a decoupling's results: filter, tables, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from pathlib import Path

import h5py

from fusion.decouple.filter_file import filter_text
from fusion.decouple.page import PAGE_FILE, render_decouple_page
from fusion.decouple.result import DecoupleEvaluation
from fusion.decouple.tables import CROSSTALK_COLUMNS, MODEL_COLUMNS, crosstalk_rows, model_rows
from fusion.evaluated import ResultFolder
from fusion.results_csv import csv_text
from fusion.results_h5 import write_fields, write_value

FORMAT = 1
FILTER_FILE, MODEL_FILE, CROSSTALK_FILE, H5_FILE = "decoupling.json", "model.csv", "crosstalk.csv", "decouple.h5"
OWN_FILE = re.compile(r"decoupling\.json|(model|crosstalk)\.csv|decouple\.(h5|html)")
MODEL_FIELDS = ("channels", "components", "unit", "frequency_hz", "damping_ratio", "residue", "real_hz", "real_residue")


def write_decoupling(evaluation: DecoupleEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file and return their paths; other folders are refused unless `force`."""
    return ResultFolder(H5_FILE, OWN_FILE, _texts, _fill).write(evaluation, folder, force=force)


def _texts(evaluation: DecoupleEvaluation) -> dict[str, str]:
    """Filter, tables and page."""
    return {
        FILTER_FILE: filter_text(evaluation.decoupler, evaluation.fit.model),
        MODEL_FILE: csv_text(MODEL_COLUMNS, model_rows(evaluation)),
        CROSSTALK_FILE: csv_text(CROSSTALK_COLUMNS, crosstalk_rows(evaluation)),
        PAGE_FILE: render_decouple_page(evaluation),
    }


def _fill(file: h5py.File, evaluation: DecoupleEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["name"] = evaluation.name
    file.attrs["model"] = "H(s) = sum R/(s-p) + conj + sum R_q/(s-p_q); poles in rad/s; k = 1"
    fit = evaluation.fit
    model = file.create_group("model", track_order=True)
    for name in (*MODEL_FIELDS, "covariance"):
        write_value(model, name, getattr(fit.model, name))
    own = file.create_group("fit", track_order=True)
    for name in ("noise", "sample_rate_hz", "amplitude", "u_amplitude", "variance_accounted", "losses"):
        write_value(own, name, getattr(fit, name))
    releases = file.create_group("releases", track_order=True)
    for release in fit.releases:
        write_fields(releases.create_group(release.record, track_order=True), release)
    write_fields(file.create_group("filter", track_order=True), evaluation.decoupler)
    for name in ("noise", "noise_gain", "deviation"):
        write_value(file["filter"], f"{name}_of_loads" if name == "noise" else name, getattr(evaluation, name))
    stages = file.create_group("crosstalk", track_order=True)
    for stage in evaluation.stages:
        write_fields(stages.create_group(stage.stage, track_order=True), stage)
