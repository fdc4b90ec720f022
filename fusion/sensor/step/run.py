"""What step responses leave: tables, models, HDF5 file, page; the command."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py

from fusion.campaign.executor import one_blas_thread
from fusion.recording.load import load_for_command
from fusion.report.folder import Command
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import columns_of, csv_text
from fusion.sensor.models_file import MODELS_FILE, ModelsFile, models_text
from fusion.sensor.step import report as tables
from fusion.sensor.step.evaluate import evaluate_steps
from fusion.sensor.step.figures import component_pictures
from fusion.sensor.step.records import StepSettings
from fusion.sensor.step.releases import ComponentResult, Release, StepEvaluation
from fusion.sensor.step.report import BY_METHOD, RELEASES, ByMethod, NumberRow, index_rows, number_rows, outputs
from shaker.release.sim import StepFit


def _context(evaluation: StepEvaluation) -> dict[str, Any]:
    """What the page shows; methods where more than one was asked for."""
    compared = evaluation.settings["method"] == "all"
    return {
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "summary": tables.summary_table(evaluation),
        "components": [
            {
                "name": component.component,
                "channel": component.channel,
                "reason": component.reason,
                "indices": tables.indices_table(component),
                "parameters": tables.parameters_table(component),
                "releases": tables.releases_table(component),
                "ropes": tables.ropes_table(component),
                "gains": tables.gains_table(component),
                "methods": tables.methods_table(component) if compared else None,
                "pictures": list(component_pictures(component)),
            }
            for component in evaluation.components
        ],
    }


def _subject(evaluation: StepEvaluation) -> list[tuple[str, str]]:
    """What was released: sensor, rig, recordings."""
    facts, sensor = [("Rig", evaluation.rig)], evaluation.sensor
    if sensor is not None:
        facts.append(("Sensor", f"{sensor.name} {sensor.serial}".strip()))
    count = sum(len(component.releases) for component in evaluation.components)
    names = ", ".join(component.component for component in evaluation.components)
    return [*facts, ("Recordings", f"{count} of {names}")]


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


def models_of(evaluation: StepEvaluation) -> ModelsFile:
    """Return what models.json holds."""
    sensor = evaluation.sensor
    named = ("", "") if sensor is None else (sensor.name, sensor.serial)
    entries = tuple(c.entry for c in evaluation.components if c.entry is not None)
    return ModelsFile(evaluation.name, *named, entries)


def _fill(file: h5py.File, evaluation: StepEvaluation) -> None:
    """Fill the HDF5 file."""
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


def _texts(evaluation: StepEvaluation) -> dict[str, str | bytes]:
    """Tables and models."""
    components, numbers = evaluation.components, columns_of(NumberRow)
    parameters = (row for component in components for row in number_rows(component, component.parameters))
    by_method = (ByMethod(component, row) for component in components for row in component.methods)
    return {
        "releases.csv": csv_text(RELEASES, outputs(evaluation)),
        "models.csv": csv_text(numbers, parameters),
        "indices.csv": csv_text(numbers, index_rows(evaluation)),
        "methods.csv": csv_text(BY_METHOD, by_method),
        MODELS_FILE: models_text(models_of(evaluation)),
    }


FILES = ("releases.csv", "models.csv", "indices.csv", "methods.csv", MODELS_FILE)
STEP = Command("step", "step", FILES, _texts, _fill, _context, tables.printed)


def run_step(
    paths: Sequence[Path],
    output: Path | None,
    settings: StepSettings,
    *,
    force: bool = False,
    allow_outside: bool = False,
) -> None:
    """Evaluate the step recordings at some paths together, write the results and print the summary.

    Of a campaign folder those of kind step are taken. Results stand in its folder `step`, or in that of the only
    recording, or, of several paths, beside rig.toml; or in `output`. A place that cannot take them is refused before
    anything is computed.
    """
    manifests = load_for_command(paths, STEP.name, allow_outside=allow_outside)
    name = manifests[0].name if len(manifests) == 1 else manifests[0].rig.name

    def evaluate(hashes: dict[str, str]) -> StepEvaluation:
        with one_blas_thread():
            return evaluate_steps(name, manifests, settings, hashes)

    STEP.run_recordings(paths, manifests, output, evaluate, force=force)
