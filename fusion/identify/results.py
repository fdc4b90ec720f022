"""The folder of an identification: tables, model, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from pathlib import Path

import h5py

from fusion.evaluated import ResultFolder
from fusion.identify.model_file import MODEL_FILE, model_text
from fusion.identify.page import PAGE_FILE, render_identify_page
from fusion.identify.result import ComponentResult, IdentifyEvaluation
from fusion.identify.rows import PARAMETER_COLUMNS, READING_COLUMNS, parameter_rows, reading_rows
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
    return ResultFolder(H5_FILE, OWN_FILE, _texts, _fill).write(evaluation, folder, force=force)


def _texts(evaluation: IdentifyEvaluation) -> dict[str, str]:
    """Tables, model and page."""
    return {
        PARAMETERS_FILE: csv_text(PARAMETER_COLUMNS, parameter_rows(evaluation)),
        READINGS_FILE: csv_text(READING_COLUMNS, reading_rows(evaluation)),
        MODEL_FILE: model_text(evaluation),
        PAGE_FILE: render_identify_page(evaluation),
    }


def _fill(file: h5py.File, evaluation: IdentifyEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["campaign"] = evaluation.name
    file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
    write_value(file, "notices", evaluation.notices)
    for component in evaluation.components:
        _write_component(file.create_group(component.name, track_order=True), component)


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
