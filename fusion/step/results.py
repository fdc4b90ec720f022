"""The folder of evaluated step responses: tables, models, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from pathlib import Path

import h5py

from fusion.evaluated import ResultFolder
from fusion.models_file import MODELS_FILE, ModelsFile, models_text
from fusion.results_csv import csv_text
from fusion.results_h5 import write_fields, write_value
from fusion.step.page import PAGE_FILE, render_step_page
from fusion.step.result import ComponentResult, Release, StepEvaluation
from fusion.step.rows import (
    METHOD_COLUMNS,
    NUMBER_COLUMNS,
    RELEASE_COLUMNS,
    index_rows,
    method_rows,
    model_rows,
    release_rows,
)
from shaker.models.step_fit.result import StepFit

FORMAT = 1
RELEASES_FILE, PARAMETERS_FILE, INDICES_FILE, METHODS_FILE = "releases.csv", "models.csv", "indices.csv", "methods.csv"
H5_FILE = "step.h5"
OWN_FILE = re.compile(r"(releases|models|indices|methods)\.csv|models\.json|step\.(h5|html)")
FIT_FIELDS = (
    "method",
    "model",
    "sample_rate_hz",
    "decimation",
    "order",
    "variance_accounted",
    "convergence",
    "duration_s",
    "onset_s",
    "u_onset_s",
    "release_s",
    "u_release_s",
    "time_s",
    "fitted",
    "residual",
)


def write_steps(evaluation: StepEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file and return their paths; other folders are refused unless `force`."""
    return ResultFolder(H5_FILE, OWN_FILE, _texts, _fill).write(evaluation, folder, force=force)


def models_of(evaluation: StepEvaluation) -> ModelsFile:
    """Return what models.json holds."""
    sensor = evaluation.sensor
    named = ("", "") if sensor is None else (sensor.name, sensor.serial)
    entries = tuple(c.entry for c in evaluation.components if c.entry is not None)
    return ModelsFile(evaluation.name, *named, entries)


def _texts(evaluation: StepEvaluation) -> dict[str, str]:
    """Tables, models and page."""
    return {
        RELEASES_FILE: csv_text(RELEASE_COLUMNS, release_rows(evaluation)),
        PARAMETERS_FILE: csv_text(NUMBER_COLUMNS, model_rows(evaluation)),
        INDICES_FILE: csv_text(NUMBER_COLUMNS, index_rows(evaluation)),
        METHODS_FILE: csv_text(METHOD_COLUMNS, method_rows(evaluation)),
        MODELS_FILE: models_text(models_of(evaluation)),
        PAGE_FILE: render_step_page(evaluation),
    }


def _fill(file: h5py.File, evaluation: StepEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["name"] = evaluation.name
    file.attrs["models"] = "H(s) = sum r/(s - p) + conj. + sum r/(s - p), p in rad/s, output over load; k = 1"
    write_value(file, "notices", evaluation.notices)
    for component in evaluation.components:
        _write_component(file.create_group(component.component, track_order=True), component)


def _write_component(group: h5py.Group, component: ComponentResult) -> None:
    """Write one component: its releases, the pooled model, its numbers, what is compared."""
    for name in ("channel", "unit", "used", "reason", "pooled", "parameters", "figures", "gains", "ropes"):
        write_value(group, name, getattr(component, name))
    releases = group.create_group("releases", track_order=True)
    for release in component.releases:
        _write_release(releases.create_group(release.name, track_order=True), release)
    if component.methods:
        methods = group.create_group("methods", track_order=True)
        for row in component.methods:
            own = methods.create_group(f"{row.recording} {row.fit.method}", track_order=True)
            _write_fit(own, row.fit)


def _write_release(group: h5py.Group, release: Release) -> None:
    """Write one release: what its outputs show, and the fit to the driven one."""
    record = release.input.record
    for name in ("component", "amplitude", "sample_rate_hz", "start_s", "release"):
        write_value(group, name, getattr(record, name))
    readings = group.create_group("readings", track_order=True)
    for reading in release.readings:
        write_fields(readings.create_group(reading.channel, track_order=True), reading)
    if release.fit is not None:
        _write_fit(group.create_group("fit", track_order=True), release.fit)


def _write_fit(group: h5py.Group, fit: StepFit) -> None:
    """Write a fit with its curves."""
    for name in FIT_FIELDS:
        write_value(group, name, getattr(fit, name))
    for name in ("zeros", "poles", "gain"):
        write_value(group, name, getattr(fit.system, name))
