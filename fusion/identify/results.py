"""The folder of an identification: tables, model, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import h5py

from fusion.identify.model_file import MODEL_FILE, model_text
from fusion.identify.page import PAGE_FILE, render_identify_page
from fusion.identify.result import ComponentResult, IdentifyEvaluation
from fusion.identify.rows import PARAMETER_COLUMNS, READING_COLUMNS, parameter_rows, reading_rows
from fusion.provenance import Provenance, write_provenance
from fusion.results import write_folder
from fusion.results_csv import csv_text
from fusion.results_h5 import write_fields, write_value

FORMAT = 1
PARAMETERS_FILE, READINGS_FILE, H5_FILE = "parameters.csv", "readings.csv", "identify.h5"
IDENTIFICATION_FIELDS = (
    "estimates",
    "covariance",
    "correlation",
    "derived",
    "modes",
    "unknowns",
    "factors",
    "chi_squared",
    "dof",
    "budget",
)
OWN_FILE = re.compile(r"(parameters|readings)\.csv|model\.json|identify\.(h5|html)")


def write_identification(evaluation: IdentifyEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file and return their paths; other folders are refused unless `force`."""
    fill = partial(_fill, evaluation=evaluation)
    return write_folder(folder, evaluation.input_hashes, fill, force=force, marker=H5_FILE, own=OWN_FILE)


def _fill(folder: Path, evaluation: IdentifyEvaluation) -> list[str]:
    """Make all files in a folder; the HDF5 file, which says that the folder is complete, comes last."""
    texts = {
        PARAMETERS_FILE: csv_text(PARAMETER_COLUMNS, parameter_rows(evaluation)),
        READINGS_FILE: csv_text(READING_COLUMNS, reading_rows(evaluation)),
        MODEL_FILE: model_text(evaluation),
        PAGE_FILE: render_identify_page(evaluation),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    names = [*texts, H5_FILE]
    origin = Provenance(evaluation.input_hashes, evaluation.settings, evaluation.versions, tuple(names))
    with h5py.File(folder / H5_FILE, "w", track_order=True) as file:
        file.attrs["format"] = FORMAT
        file.attrs["campaign"] = evaluation.name
        file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
        write_provenance(file, origin)
        write_value(file, "notices", evaluation.notices)
        for component in evaluation.components:
            _write_component(file.create_group(component.name, track_order=True), component)
    return names


def _write_component(group: h5py.Group, component: ComponentResult) -> None:
    """Write one component: why which model, what was fitted, the curves with model and residual, the sensitivity."""
    fit = component.fit
    for name in ("model", "reason", "mass_is_free"):
        write_value(group, name, getattr(fit, name))
    found = group.create_group("identification", track_order=True)
    for name in IDENTIFICATION_FIELDS:
        write_value(found, name, getattr(fit.identification, name))
    curves = group.create_group("recordings", track_order=True)
    for place, item in enumerate(fit.prepared):
        own = curves.create_group(f"{place:03d}", track_order=True)
        write_fields(own, item.measured)
        write_value(own, "model", fit.identification.model[place])
        write_value(own, "residual", fit.identification.residual[place])
    for name in ("readings", "sensitivity", "model", "range_hz", "loads", "bands"):
        write_value(group, "sensor_model" if name == "model" else name, getattr(component, name))
