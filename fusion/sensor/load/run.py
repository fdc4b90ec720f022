"""Result folder of load characteristics."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import h5py

from fusion.report.csv_files import csv_text
from fusion.report.h5 import write_fields, write_value
from fusion.report.provenance import check_folder, hash_files
from fusion.report.recording import ResultFolder, default_folder, log_notices
from fusion.sensor.load.evaluate import (
    MODEL_FILE,
    ComponentLoads,
    LoadEvaluation,
    LoadSettings,
    evaluate_loads,
    model_text,
    read_series,
    read_table,
)
from fusion.sensor.load.report import (
    LOAD_COLUMNS,
    PAGE_FILE,
    PARAMETER_COLUMNS,
    load_rows,
    parameter_rows,
    printed,
    render_load_page,
)
from fusion.sensor.step.run import step_manifests

# The folder of load characteristics: tables, load.json, HDF5 file and page, whole or not at all.


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


# The command `shakercal load`: recordings with several loads, or a table of resonances → load characteristics.


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
