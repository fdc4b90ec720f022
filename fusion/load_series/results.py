"""The folder of load characteristics: tables, load.json, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from pathlib import Path

import h5py

from fusion.evaluated import ResultFolder
from fusion.load_series.model_file import MODEL_FILE, model_text
from fusion.load_series.page import PAGE_FILE, render_load_page
from fusion.load_series.result import ComponentLoads, LoadEvaluation
from fusion.load_series.rows import LOAD_COLUMNS, PARAMETER_COLUMNS, load_rows, parameter_rows
from fusion.results_csv import csv_text
from fusion.results_h5 import write_fields, write_value

FORMAT = 1
TABLE_FILE, PARAMETER_FILE, H5_FILE = "load.csv", "parameters.csv", "load.h5"
OWN_FILE = re.compile(r"load\.(csv|json|h5|html)|parameters\.csv")


def write_loads(evaluation: LoadEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file and return their paths; other folders are refused unless `force`."""
    return ResultFolder(H5_FILE, OWN_FILE, _texts, _fill).write(evaluation, folder, force=force)


def _texts(evaluation: LoadEvaluation) -> dict[str, str]:
    """Tables, models and page."""
    program = evaluation.versions.get("shakercal", "")
    return {
        TABLE_FILE: csv_text(LOAD_COLUMNS, load_rows(evaluation)),
        PARAMETER_FILE: csv_text(PARAMETER_COLUMNS, parameter_rows(evaluation)),
        MODEL_FILE: model_text(evaluation.models, evaluation.name, evaluation.sensor, program),
        PAGE_FILE: render_load_page(evaluation),
    }


def _fill(file: h5py.File, evaluation: LoadEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["name"] = evaluation.name
    components = file.create_group("components", track_order=True)
    for component in evaluation.components:
        _write_component(components.create_group(component.name, track_order=True), component)


def _write_component(group: h5py.Group, component: ComponentLoads) -> None:
    """What was measured, every fit, every solution and, of records, the decays that were fitted."""
    series, found = component.series, component.identification
    group.attrs["reason"] = found.reason
    group.attrs["from_records"] = found.from_records
    group.attrs["k"] = component.k
    write_value(group, "recordings", series.names)
    write_value(group, "formula_hz", component.formula_hz)
    write_fields(group.create_group("output"), series.output)
    write_fields(group.create_group("measured"), series.measured)
    write_fields(group.create_group("masses"), series.masses)
    write_fields(group.create_group("two_masses"), found.rigid)
    for number, fit in enumerate(found.elastic, 1):
        write_fields(group.create_group(f"three_masses_{number}"), fit)
    for solution in component.solutions:
        own = group.create_group(f"solution_{solution.model.solution}", track_order=True)
        write_fields(own.create_group("model"), solution.model)
        for name in ("recorded", "predicted", "drawn"):
            write_fields(own.create_group(name), getattr(solution, name))
        write_value(own, "bands_hz", solution.bands)
    decays = group.create_group("decays", track_order=True)
    for decay in series.decays:
        write_fields(decays.create_group(decay.name), decay)
