"""What step responses leave: tables, models, HDF5 file, page; the command."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fusion.campaign.workers import one_blas_thread
from fusion.recording.load import load_for_command
from fusion.report.folder import Command
from fusion.report.h5 import write_fields, write_value
from fusion.report.style import Picture
from fusion.report.table import Table, columns_of, csv_text
from fusion.sensor.models_file import MODELS_FILE, ModelsFile, models_text
from fusion.sensor.step import report as tables
from fusion.sensor.step.evaluate import evaluate_steps, measured_response
from fusion.sensor.step.plots import (
    BodeCurve,
    Convergence,
    RopeCurve,
    StepCurve,
    draw_bode,
    draw_convergence,
    draw_ropes,
    draw_step,
)
from fusion.sensor.step.records import Pooled, StepSettings
from fusion.sensor.step.releases import LABELS, ComponentResult, MethodRow, Release, StepEvaluation
from fusion.sensor.step.report import BY_METHOD, RELEASES, ByMethod, NumberRow, index_rows, number_rows, outputs
from shaker.arrays import FloatArray
from shaker.lti.modal import ModalModel
from shaker.release.sim import StepFit

POINTS = 500
HIGHEST = 6.0
"""Frequencies shown, over the highest mode."""
PERIODS = 12.0
SHOWN_RELEASES = 3
OVER_ORDER = ("sim", "sim_zoh")
OVER_GENERATION = ("evolution", "evolution_coefficients")


def component_pictures(component: ComponentResult) -> Iterator[Picture]:
    """Yield record and fit of the first release of the model, response over frequency, ropes, and convergence."""
    if component.pooled is not None:
        yield draw_step(f"step-{component.component}", _step_curve(component.chosen[0]))
        yield draw_bode(f"bode-{component.component}", _bode_curve(component, component.pooled))
    if len(component.ropes) > 1:
        yield draw_ropes(f"ropes-{component.component}", component.channel, list(_rope_curves(component)))
    curves = list(_convergence(component.methods))
    if curves:
        yield draw_convergence(f"convergence-{component.component}", curves)


def _step_curve(release: Release) -> StepCurve:
    """Record and fit of a release."""
    record, fit = release.input.record, release.fit
    if fit is None:
        raise ValueError("release: expected one with a model, found none")
    return StepCurve(
        recording=release.name,
        channel=release.driven,
        unit=record.unit,
        time_s=fit.time_s,
        measured=fit.fitted + fit.residual,
        fitted=fit.fitted,
        baseline=release.reading.baseline,
        steady=release.reading.steady,
        onset_s=fit.onset_s,
        release_s=fit.release_s,
        period_s=_period_s(fit.model),
    )


def _period_s(model: ModalModel | None) -> float:
    """Period of the lowest mode, of a model without one that of its slowest real pole."""
    if model is None:
        return 1e-3
    return 1.0 / float(np.min(model.frequency_hz if len(model.frequency_hz) else np.abs(model.real_hz)))


def _bode_curve(component: ComponentResult, pooled: Pooled) -> BodeCurve:
    """The pooled model and what its releases show by themselves."""
    model, static = pooled.model, pooled.model.static_gain
    found = [measured_response(release) for release in component.chosen[:SHOWN_RELEASES]]
    rate_hz = min(release.input.record.sample_rate_hz for release in component.chosen)
    highest_hz = float(np.max(model.frequency_hz if len(model.frequency_hz) else np.abs(model.real_hz)))
    top_hz = min(0.4 * rate_hz, HIGHEST * highest_hz)
    low_hz = min(float(one.frequency_hz.min()) for one in found)
    frequency = _around(model, np.geomspace(low_hz, top_hz, POINTS))

    def size(at: ModalModel) -> FloatArray:
        return np.asarray(np.log(np.abs(at.response(frequency) / at.static_gain)))

    u, _ = pooled.spread(model.jacobian(size)[1])
    kept = [one.frequency_hz <= top_hz for one in found]
    measured_hz = np.concatenate([one.frequency_hz[k] for one, k in zip(found, kept, strict=True)])
    ends = [component.figure(name) for name in ("band_5_hz", "band_10_hz")]
    return BodeCurve(
        channel=component.channel,
        component=component.component,
        frequency_hz=frequency,
        value=model.response(frequency) / static,
        u=u,
        measured_hz=measured_hz,
        measured=np.asarray(np.concatenate([one.value[k] for one, k in zip(found, kept, strict=True)]) / static),
        noise=np.concatenate([one.u[k] for one, k in zip(found, kept, strict=True)]) / abs(static),
        model_there=model.response(measured_hz) / static,
        bands_hz=tuple(np.nan if end is None else end.value for end in ends),
    )


def _around(model: ModalModel, frequency_hz: FloatArray) -> FloatArray:
    """Frequencies (K,) with more of them where a mode is narrow."""
    extra = [
        f * (1.0 + z * np.linspace(-8.0, 8.0, 81))
        for f, z in zip(model.frequency_hz, np.maximum(np.abs(model.damping_ratio), 1e-5), strict=True)
    ]
    every = np.unique(np.concatenate([frequency_hz, *extra]))
    return np.asarray(every[(every >= frequency_hz[0]) & (every <= frequency_hz[-1])])


def _rope_curves(component: ComponentResult) -> Iterator[RopeCurve]:
    """The first release by each rope, over the longest of the releases and some periods."""
    periods = [_period_s(r.fit.model) for r in component.releases if r.fit is not None]
    longest = max(rope.kind.length.mean for rope in component.ropes)
    span = 1.5 * longest + PERIODS * float(np.median(periods) if periods else longest)
    for rope in component.ropes:
        release = next(r for r in component.releases if r.name in rope.releases)
        record, reading = release.input.record, release.reading
        onset = reading.onset_s if release.fit is None else release.fit.onset_s
        time = record.time_s - onset
        shown = (time >= -0.1 * span) & (time <= span)
        level = record.samples[record.channels.index(release.driven)]
        share = (level - reading.baseline) / (reading.steady - reading.baseline)
        yield RopeCurve(rope.name, release.name, time[shown], share[shown], rope.kind.length.mean)


def _convergence(rows: Sequence[MethodRow]) -> Iterator[Convergence]:
    """SIM's loss over the order once, and the loss of differential evolution over the generations."""
    for row in rows:
        fit, method = row.fit, row.fit.method
        if method == OVER_ORDER[0] and len(fit.convergence) > 1:
            chosen = fit.order - 1 if 1 <= fit.order <= len(fit.convergence) else None
            yield Convergence(LABELS[method].partition(",")[0], "order", fit.convergence, chosen)
        elif method in OVER_GENERATION and len(fit.convergence) > 1:
            yield Convergence(LABELS[method], "generation", fit.convergence, None)


@dataclass(frozen=True)
class ComponentSection:
    """What the page shows of one load component."""

    name: str
    channel: str
    reason: str
    indices: Table | None
    parameters: Table | None
    releases: Table
    ropes: Table | None
    gains: Table
    methods: Table | None
    pictures: list[Picture]


def _context(evaluation: StepEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    compared = evaluation.settings["method"] == "all"
    return {
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "summary": tables.summary_table(evaluation),
        "components": [_section(component, compared) for component in evaluation.components],
        "compared": compared,
    }


def _section(component: ComponentResult, compared: bool) -> ComponentSection:
    """Everything of one component; methods where more than one was asked for."""
    return ComponentSection(
        name=component.component,
        channel=component.channel,
        reason=component.reason,
        indices=tables.indices_table(component),
        parameters=tables.parameters_table(component),
        releases=tables.releases_table(component),
        ropes=tables.ropes_table(component),
        gains=tables.gains_table(component),
        methods=tables.methods_table(component) if compared else None,
        pictures=list(component_pictures(component)),
    )


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
