"""Result folder of load characteristics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import h5py

from fusion.recording.load import load_for_command
from fusion.report.folder import Command
from fusion.report.h5 import write_fields, write_value
from fusion.report.provenance import hash_files
from fusion.report.table import columns_of, csv_text
from fusion.sensor.load.evaluate import (
    ComponentLoads,
    LoadEvaluation,
    LoadSettings,
    evaluate_loads,
    read_series,
    read_table,
)
from fusion.sensor.load.report import LOADS, ParameterRow, load_rows, page_context, parameter_rows, printed
from fusion.sensor.models_file import LOAD_MODEL_FILE, model_text


def _fill(file: h5py.File, evaluation: LoadEvaluation) -> None:
    """Fill the HDF5 file."""
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


def _texts(evaluation: LoadEvaluation) -> dict[str, str | bytes]:
    """Tables and models."""
    program = evaluation.versions.get("shakercal", "")
    return {
        "load.csv": csv_text(LOADS, load_rows(evaluation)),
        "parameters.csv": csv_text(columns_of(ParameterRow), parameter_rows(evaluation)),
        LOAD_MODEL_FILE: model_text(evaluation.models, evaluation.name, evaluation.sensor, program),
    }


LOAD = Command("load", "load", ("load.csv", "parameters.csv", LOAD_MODEL_FILE), _texts, _fill, page_context, printed)


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
    manifests = load_for_command(paths, LOAD.name, allow_outside=allow_outside)

    def evaluate(hashes: dict[str, str]) -> LoadEvaluation:
        series, notices = read_series(manifests)
        campaign = paths[0] if len(paths) == 1 else manifests[0].root
        name = manifests[0].name if len(manifests) == 1 else f"loads of {campaign.absolute().name}"
        return evaluate_loads(name, series, notices, settings, hashes, manifests[0])

    LOAD.run_recordings(paths, manifests, output, evaluate, force=force)


def run_table(table: Path, output: Path | None, settings: LoadSettings, *, force: bool = False) -> None:
    """Evaluate a table of resonances, for which the settings hold the moving mass; write and print as `run_loads`.

    Results stand in `output`, or in folder `load` beside the table.
    """
    if settings.moving_mass is None:
        raise ValueError("settings: expected the moving mass that the table's resonances belong to, found none")
    series = read_table(table, *settings.moving_mass)
    folder = table.parent / LOAD.name if output is None else output

    def evaluate(hashes: dict[str, str]) -> LoadEvaluation:
        return evaluate_loads(table.stem, (series,), (), settings, hashes)

    LOAD.run(hash_files([table], table.absolute().parent), folder, evaluate, force=force)
