"""Files, page and printed lines of step responses, and the command."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from markupsafe import Markup

from fusion.base import K2, MILLI, PERCENT
from fusion.campaign.executor import one_blas_thread
from fusion.estimation.coverage import NamedQuantity, RealQuantity, coverage_factor
from fusion.recording.load import load_for_command
from fusion.report.folder import CommandReport, subject_of
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    capitalise,
    columns_of,
    csv_text,
    degrees_of_freedom,
    factor_text,
    page_column,
    quantity_columns,
    table,
    text_column,
)
from fusion.sensor.model_files import MODELS_FILE, ModelsFile, models_text
from fusion.sensor.step.step_evaluation import evaluate_steps
from fusion.sensor.step.step_figures import component_figures, draw_releases
from fusion.sensor.step.step_records import StepSettings
from fusion.sensor.step.step_releases import (
    LABELS,
    MethodRow,
    ReleaseDevice,
    StaticGain,
    StepComponent,
    StepEvaluation,
    StepRelease,
)
from fusion.sensor.unmodelled_effects import CAUSE_LABELS, NOT_ASSESSED, budget_table
from shaker.release.reading import RepeatedMean
from shaker.release.record import ReleaseReading, SpectrumPeak
from shaker.release.step_fit import StepFit
from shakercal._common.digits import (
    DASH,
    number_text,
    power_text,
    quantity_text,
    round_to_uncertainty,
    signed_text,
    typeset,
)

# Tables in files


class OutputRow(NamedTuple):
    """An output of one release, with the model if it is the driven output."""

    component: StepComponent
    release: StepRelease
    reading: ReleaseReading

    @property
    def driven(self) -> bool:
        """Return whether the load was to act on this output."""
        return self.reading.channel == self.release.driven

    @property
    def used(self) -> bool:
        """Return whether the model of the component uses it."""
        return self.driven and self.release.name in self.component.used

    @property
    def fit(self) -> StepFit | None:
        """Return the model of the driven output."""
        return self.release.fit if self.driven else None

    def peak(self, index: int, name: str) -> float:
        """Return a number of a peak of the spectrum, NaN without one."""
        return float(getattr(self.reading.peaks[index], name)) if len(self.reading.peaks) > index else np.nan


def lowest_mode(fit: StepFit) -> tuple[float, float, float, float]:
    """Return frequency (Hz) and damping ratio of the lowest mode, each with u, or NaN."""
    model = fit.model
    if model is None or not len(model.frequency_hz):
        return (np.nan,) * 4
    lowest, count = int(np.argmin(model.frequency_hz)), len(model.frequency_hz)
    u = np.zeros(len(model.vector)) if model.covariance is None else np.sqrt(np.diag(model.covariance))
    return model.frequency_hz[lowest], u[lowest], model.damping_ratio[lowest], u[count + lowest]


def residual_rms(fit: StepFit) -> float:
    """Return the root mean square of the residual of a fit, in output units."""
    return float(np.sqrt(np.mean(fit.residual**2)))


def yes_or_no(is_so: object) -> str:
    """Return the word for a truth value."""
    return "yes" if is_so else "no"


def _of_reading(*names: str) -> list[TableColumn[OutputRow]]:
    return [TableColumn(name, attrgetter(f"reading.{name}")) for name in names]


def _of_peak(name: str, index: int, of_peak: str) -> TableColumn[OutputRow]:
    return TableColumn(name, lambda output: output.peak(index, of_peak))


def _of_fit(name: str, value: Callable[[StepFit], float]) -> TableColumn[OutputRow]:
    """Return a column of the model, empty without one."""
    return TableColumn(name, lambda output: None if output.fit is None else value(output.fit))


RELEASES: list[TableColumn[OutputRow]] = [
    text_column("recording", lambda output: output.release.name),
    text_column("component", lambda output: output.component.component),
    text_column("release", lambda output: output.release.record.release),
    text_column("mounting", lambda output: output.release.manifest.mounting),
    text_column("channel", lambda output: output.reading.channel),
    text_column("driven", lambda output: yes_or_no(output.driven)),
    text_column("used", lambda output: yes_or_no(output.used)),
    TableColumn("step_amplitude", lambda output: output.release.record.amplitude),
    *_of_reading("onset_s", "u_onset_s", "sign", "baseline", "u_baseline", "steady", "u_steady", "unit"),
    *_of_reading("rise_s", "u_rise_s", "shape", "release_s", "u_release_s", "static_gain", "u_static_gain", "noise"),
    _of_peak("peak_1_hz", 0, "frequency_hz"),
    _of_peak("u_peak_1_hz", 0, "u_frequency_hz"),
    _of_peak("peak_2_hz", 1, "frequency_hz"),
    _of_peak("u_peak_2_hz", 1, "u_frequency_hz"),
    _of_peak("peak_2_share", 1, "share"),
    *(_of_fit(f"fit_{name}", attrgetter(name)) for name in ("onset_s", "u_onset_s", "release_s", "u_release_s")),
    _of_fit("fit_frequency_hz", lambda fit: lowest_mode(fit)[0]),
    _of_fit("fit_damping_ratio", lambda fit: lowest_mode(fit)[2]),
    _of_fit("fit_residual", residual_rms),
    _of_fit("fit_variance_accounted", lambda fit: fit.variance_accounted),
]


class Number(NamedTuple):
    """A parameter, an index or a static gain of a component, with its recordings."""

    component: str
    channel: str
    name: str
    quantity: RealQuantity
    recordings: Sequence[str]


NUMBERS: list[TableColumn[Number]] = [
    *(text_column(name, attrgetter(name)) for name in ("component", "channel", "name")),
    *quantity_columns(lambda row: row.quantity),
    text_column("recordings", lambda row: ", ".join(row.recordings)),
    TableColumn("low", lambda row: getattr(row.quantity, "low", np.nan)),
    TableColumn("high", lambda row: getattr(row.quantity, "high", np.nan)),
]


class BudgetPart(NamedTuple):
    """A contribution to the u of an index; `u` is None if not assessed."""

    component: str
    channel: str
    name: str
    cause: str
    u: float | None
    unit: str
    status: str


def budget_parts(component: StepComponent) -> Iterator[BudgetPart]:
    """Yield the budget of every index by cause; squares add up to its u²."""
    for one in component.figures:
        head = component.component, component.channel, one.name
        for cause, parts in component.budget.items():
            if one.name in parts:
                yield BudgetPart(*head, cause, parts[one.name], one.unit, "in U")
        for cause in component.influences.missing:
            yield BudgetPart(*head, CAUSE_LABELS[cause], None, one.unit, NOT_ASSESSED)


class ByMethod(NamedTuple):
    """The result of one method for one release of a component."""

    component: StepComponent
    row: MethodRow

    def figure(self, name: str) -> float:
        """Return an index of the method's system, NaN where it has none."""
        value = None if self.row.indices is None else self.row.indices.figures()[name]
        return np.nan if value is None else float(value)


def _of_method(name: str) -> TableColumn[ByMethod]:
    return TableColumn(name, lambda by: by.figure(name))


BY_METHOD: list[TableColumn[ByMethod]] = [
    text_column("component", lambda by: by.component.component),
    text_column("channel", lambda by: by.component.channel),
    text_column("recording", lambda by: by.row.recording),
    text_column("method", lambda by: by.row.fit.method),
    TableColumn("sample_rate_hz", lambda by: by.row.fit.sample_rate_hz),
    TableColumn("order", lambda by: by.row.fit.order),
    text_column("stable", lambda by: yes_or_no(by.row.fit.system.stable)),
    *map(_of_method, ("natural_hz", "damping_ratio", "static_gain")),
    text_column("unit", lambda by: by.component.unit),
    *map(_of_method, ("band_5_hz", "band_10_hz", "overshoot", "settling_2_s")),
    TableColumn("residual", lambda by: residual_rms(by.row.fit)),
    TableColumn("variance_accounted", lambda by: by.row.fit.variance_accounted),
    TableColumn("duration_s", lambda by: by.row.fit.duration_s),
]


def texts(evaluation: StepEvaluation) -> dict[str, str | bytes]:
    """Return tables and models; indices.csv has the static gains as read after the indices."""
    components = evaluation.components
    outputs = (
        OutputRow(c, release, reading) for c in components for release in c.releases for reading in release.readings
    )
    parameters, indices = list[Number](), list[Number]()
    for c in components:
        names = [release.name for release in c.releases]
        parameters += [Number(c.component, c.channel, one.name, one, c.used) for one in c.parameters]
        indices += [Number(c.component, c.channel, one.name, one, c.used) for one in c.figures]
        indices += [Number(c.component, gain.channel, "read_static_gain", gain, names) for gain in c.gains]
    sensor = evaluation.rig.sensor
    named = ("", "") if sensor is None else (sensor.name, sensor.serial)
    entries = tuple(component.entry for component in components if component.entry is not None)
    return {
        "releases.csv": csv_text(RELEASES, outputs),
        "models.csv": csv_text(NUMBERS, parameters),
        "indices.csv": csv_text(NUMBERS, indices),
        "budget.csv": csv_text(columns_of(BudgetPart), (part for c in components for part in budget_parts(c))),
        "methods.csv": csv_text(BY_METHOD, (ByMethod(c, row) for c in components for row in c.methods)),
        MODELS_FILE: models_text(ModelsFile(evaluation.name, *named, entries)),
    }


# HDF5 file

FIT_FIELDS = (
    *("method", "model", "sample_rate_hz", "decimation", "order", "variance_accounted", "convergence", "duration_s"),
    *("onset_s", "u_onset_s", "release_s", "u_release_s", "time_s", "fitted", "residual"),
)


def fill(file: h5py.File, evaluation: StepEvaluation) -> None:
    """Fill the HDF5 file with releases, pooled model, numbers and methods of every component."""
    file.attrs["name"] = evaluation.name
    file.attrs["models"] = "H(s) = sum r/(s - p) + conj. + sum r/(s - p), p in rad/s, output over load; k = 1"
    write_value(file, "notices", evaluation.notices)
    for component in evaluation.components:
        group = file.create_group(component.component, track_order=True)
        group.attrs["scope"], group.attrs["outside"] = component.scope, component.influences.outside
        written = ("channel", "unit", "used", "reason", "pooled", "parameters", "figures", "budget", "gains", "ropes")
        for name in written:
            write_value(group, name, getattr(component, name))
        releases = group.create_group("releases", track_order=True)
        for release in component.releases:
            release_group = releases.create_group(releases.free_name(release.name), track_order=True)
            for name in ("component", "amplitude", "sample_rate_hz", "start_s", "release"):
                write_value(release_group, name, getattr(release.record, name))
            readings = release_group.create_group("readings", track_order=True)
            for reading in release.readings:
                name = readings.free_name(reading.channel)
                write_fields(readings.create_group(name, track_order=True), reading)
            if release.fit is not None:
                _write_fit(release_group.create_group("fit", track_order=True), release.fit)
        if component.methods:
            methods = group.create_group("methods", track_order=True)
            for row in component.methods:
                name = methods.free_name(f"{row.recording} {row.fit.method}")
                _write_fit(methods.create_group(name, track_order=True), row.fit)


def _write_fit(group: h5py.Group, fit: StepFit) -> None:
    """Write a fit with its curves."""
    for name in FIT_FIELDS:
        write_value(group, name, getattr(fit, name))
    for name in ("zeros", "poles", "gain"):
        write_value(group, name, getattr(fit.system, name))


# Page and terminal

SHARES = ("damping_ratio", "overshoot")  # ratios that are shown in %
BUDGETED = ("natural_hz", "damping_ratio", "static_gain", "band_10_hz")
MANY_HEADLINES = 6
NATURAL = Markup("f<sub>n</sub> / Hz")
SUMMARY = {
    "natural_hz": NATURAL,
    "damping_ratio": "ζ / %",
    "band_5_hz": "±5 % to / Hz",
    "band_10_hz": "±10 % to / Hz",
    "overshoot": "overshoot / %",
    "settling_2_s": "2 % settling / ms",
}
PRINTED = {
    "natural_hz": "f_n",
    "damping_ratio": "damping ratio",
    "band_5_hz": "±5 % up to",
    "settling_2_s": "2 % settling",
}


def page_context(evaluation: StepEvaluation) -> dict[str, Any]:
    """Return the content of the page, with the methods if several were compared."""
    compared, components = evaluation.settings["method"] == "all", evaluation.components
    count, names = sum(len(c.releases) for c in components), ", ".join(c.component for c in components)
    return {
        "subject": [*subject_of(evaluation.rig), ("Recordings", f"{count} of {names}")],
        "summary": summary_table(evaluation),
        "releases": draw_releases(components),
        "components": [
            {
                "name": component.component,
                "channel": component.channel,
                "reason": component.reason,
                "indices": quantities_table("index", "Indices", component.figures, component.scope),
                "parameters": quantities_table("parameter", "Parameters", component.parameters, component.scope),
                "budget": main_budget(component),
                "releases": releases_table(component),
                "ropes": ropes_table(component),
                "gains": gains_table(component),
                "methods": methods_table(component) if compared else None,
                "pictures": list(component_figures(component)),
            }
            for component in components
        ],
    }


def headlines(evaluation: StepEvaluation) -> list[Headline]:
    """Return natural frequency and damping ratio of every driven output."""
    lines: list[Headline] = []
    for component in evaluation.components:
        frequency, damping = component.find("natural_hz"), component.find("damping_ratio")
        if frequency is not None and damping is not None:
            remark = f"ζ = {quantity_text(*_shown(damping))}; U {component.scope}"
            lines.append(Headline(f"{component.channel}: natural frequency", quantity_text(*_shown(frequency)), remark))
    return lines[:MANY_HEADLINES]


def summary_table(evaluation: StepEvaluation) -> Table | None:
    """Return the main indices of every component."""

    def load(component: StepComponent) -> str:
        return " → ".join(dict.fromkeys((component.component, component.channel)))

    def index(name: str, head: str) -> TableColumn[StepComponent]:
        def shown(component: StepComponent) -> str:
            quantity = component.find(name)
            return DASH if quantity is None else quantity_text(*_shown(quantity)[:2])

        return page_column(head, shown)

    columns = [page_column("load", load, "l"), *(index(name, head) for name, head in SUMMARY.items())]
    columns.append(page_column("U applies", lambda component: component.scope or DASH, "l"))
    return table("Models of the driven outputs, with U", columns, evaluation.components)


def quantities_table(head: str, what: str, quantities: Sequence[NamedQuantity], scope: str) -> Table | None:
    """Return the parameters or the indices of a model."""

    def if_finite(text: Callable[[NamedQuantity], str]) -> Callable[[NamedQuantity], str]:
        return lambda one: text(one) if np.isfinite(one.u) and one.u > 0.0 else DASH

    columns: list[TableColumn[NamedQuantity]] = [
        page_column(head, lambda one: capitalise(one.label), "l"),
        page_column("value", lambda one: quantity_text(*_shown(one))),
        page_column("interval of 95 %", _interval_text),
        page_column("k", if_finite(lambda one: factor_text(one.k))),
        page_column("dof", if_finite(lambda one: degrees_of_freedom(one.dof))),
    ]
    return table(f"{what} of the model, with U {scope}", columns, quantities)


def main_budget(component: StepComponent) -> Table | None:
    """Return the budget of the main indices, with influences that are not assessed."""
    shown = [one for name in BUDGETED if (one := component.find(name)) is not None and np.isfinite(one.u)]
    parts = {cause: np.array([u[one.name] for one in shown]) for cause, u in component.budget.items()}
    numbers = {one.label: one.value for one in shown}
    return budget_table("Budget of the main indices", numbers, parts, component.influences) if shown else None


def releases_table(component: StepComponent) -> Table | None:
    """Return readings and model of the driven output of every release."""

    def of_fit(head: str, shown: Callable[[StepFit], str]) -> TableColumn[StepRelease]:
        return page_column(head, lambda release: DASH if release.fit is None else shown(release.fit))

    def mode(fit: StepFit) -> tuple[str, str]:
        hz, u_hz, damping, u_damping = lowest_mode(fit)
        return quantity_text(hz, K2 * u_hz), quantity_text(PERCENT * damping, K2 * PERCENT * u_damping)

    def gain(release: StepRelease) -> str:
        return quantity_text(scale * release.reading.static_gain, K2 * scale * release.reading.u_static_gain)

    scale, unit = _gain_scale(component)
    columns: list[TableColumn[StepRelease]] = [
        page_column("recording", lambda release: release.name, "l"),
        page_column("released by", lambda release: release.record.release or DASH, "l"),
        page_column("rise / ms", lambda r: quantity_text(MILLI * r.reading.rise_s, K2 * MILLI * r.reading.u_rise_s)),
        of_fit("release / ms", lambda fit: quantity_text(MILLI * fit.release_s, K2 * MILLI * fit.u_release_s)),
        page_column(f"static gain / {unit}", gain),
        of_fit(NATURAL, lambda fit: mode(fit)[0]),
        of_fit("ζ / %", lambda fit: mode(fit)[1]),
        of_fit("fit / %", lambda fit: f"{PERCENT * fit.variance_accounted:.3f}"),
        page_column("in the model", lambda release: yes_or_no(release.name in component.used), "l"),
    ]
    return table(f"Releases: output {component.channel}, with U (k = 2)", columns, component.releases)


def ropes_table(component: StepComponent) -> Table | None:
    """Return rise, duration and repeatability of every release device; None of a single release."""

    def mean(of: Callable[[ReleaseDevice], RepeatedMean]) -> Callable[[ReleaseDevice], str]:
        return lambda device: quantity_text(*_mean_ms(of(device)))

    def scatter(of: Callable[[ReleaseDevice], RepeatedMean]) -> Callable[[ReleaseDevice], str]:
        return lambda device: number_text(MILLI * of(device).repeatability, 2)

    columns: list[TableColumn[ReleaseDevice]] = [
        page_column("released by", lambda device: device.name, "l"),
        page_column("releases", lambda device: f"{device.kind.count}"),
        page_column("rise / ms", mean(lambda device: device.kind.rise)),
        page_column("s / ms", scatter(lambda device: device.kind.rise)),
        page_column("release / ms", mean(lambda device: device.kind.length)),
        page_column("s / ms", scatter(lambda device: device.kind.length)),
        page_column("faster than the next / %", lambda device: signed_text(PERCENT * device.kind.faster, ".1f")),
        page_column("in the model", lambda device: yes_or_no(device.used), "l"),
    ]
    caption = "Release devices: rise of the output and duration of the release, means with U, scatter s of one release"
    return table(caption, columns, component.ropes) if len(component.releases) > 1 else None


def gains_table(component: StepComponent) -> Table | None:
    """Return static gain and spectral peaks of every output for the load."""
    driven, (scale, unit) = component.gains[0], _gain_scale(component)

    def stated(gain: StaticGain) -> str:
        return DASH if gain.stated is None else quantity_text(scale * gain.stated, K2 * scale * gain.u_stated)

    def share(gain: StaticGain) -> str:
        return DASH if gain is driven else signed_text(PERCENT * gain.value / driven.value, ".3f")

    def normalised(gain: StaticGain) -> str:
        return DASH if gain.normalised is None else signed_text(gain.normalised)

    def peak(head: str, index: int) -> TableColumn[StaticGain]:
        return page_column(head, lambda gain: _peaks(component, gain.channel)[index])

    columns: list[TableColumn[StaticGain]] = [
        page_column("output", lambda gain: gain.channel, "l"),
        page_column(f"static gain / {unit}", lambda gain: quantity_text(scale * gain.value, scale * gain.expanded)),
        page_column("k", lambda gain: factor_text(gain.k)),
        page_column(f"of {driven.channel} / %", share),
        page_column(f"stated / {unit}", stated),
        page_column("difference over its U", normalised),
        peak("first peak / Hz", 0),
        peak("second peak / Hz", 1),
        peak("its share / %", 2),
    ]
    mean = "one release" if driven.releases == 1 else f"mean of {driven.releases} releases"
    return table(f"Every output for the load {component.component}: {mean}, with U", columns, component.gains)


def methods_table(component: StepComponent) -> Table | None:
    """Return the result of every method for a release."""

    def index(head: str, name: str, form: str, scale: float = 1.0) -> TableColumn[ByMethod]:
        return page_column(head, lambda by: signed_text(scale * by.figure(name), form))

    unit = typeset(component.releases[0].record.unit)
    columns: list[TableColumn[ByMethod]] = [
        page_column("method", lambda by: LABELS[by.row.fit.method], "l"),
        page_column("recording", lambda by: by.row.recording, "l"),
        page_column("poles", lambda by: f"{by.row.fit.order}"),
        index(NATURAL, "natural_hz", ".2f"),
        index("ζ / %", "damping_ratio", ".4f", PERCENT),
        index("±5 % to / Hz", "band_5_hz", ".1f"),
        page_column("stable", lambda by: yes_or_no(by.row.fit.system.stable), "l"),
        page_column("fit / %", lambda by: signed_text(PERCENT * by.row.fit.variance_accounted, ".3f")),
        page_column(f"residual, r.m.s. / ({unit})", lambda by: number_text(residual_rms(by.row.fit), 2)),
        page_column("time / s", lambda by: number_text(by.row.fit.duration_s)),
    ]
    return table("Methods", columns, (ByMethod(component, row) for row in component.methods))


def printed(evaluation: StepEvaluation) -> Iterator[str]:
    """Yield the lines that the command prints."""
    for component in evaluation.components:
        head = f"{component.component}: {len(component.used)} of {len(component.releases)} releases in the model"
        head += f", U {component.scope}" if component.scope else ""
        indices = [(label, component.find(name)) for name, label in PRINTED.items()]
        parts = [f"{label} {quantity_text(*_shown(index))}" for label, index in indices if index is not None]
        yield f"{head}; {', '.join(parts) or 'no model'}"
        for device in component.ropes if len(component.ropes) > 1 else ():
            duration = quantity_text(*_mean_ms(device.kind.length), "ms")
            yield f"  {device.name}: {len(device.releases)} releases of {duration}"


def _shown(quantity: NamedQuantity) -> tuple[float, float, str]:
    """Return value, U and unit as shown: times in ms, shares in %."""
    unit = quantity.unit
    if quantity.name.startswith(SHARES):
        scale, unit = PERCENT, "%"
    else:
        scale, unit = (MILLI, "ms") if unit == "s" else (1.0, "" if unit == "1" else unit)
    return scale * quantity.value, scale * quantity.expanded, unit


def _interval_text(quantity: NamedQuantity) -> str:
    """Return the ends of an interval that is not symmetric, as shown."""
    if not np.isfinite(quantity.low + quantity.high):
        return DASH
    value, _, unit = _shown(quantity)
    scale = value / quantity.value if quantity.value else 1.0
    return f"{number_text(scale * quantity.low, 4)} … {number_text(scale * quantity.high, 4)} {unit}"


def _mean_ms(spread: RepeatedMean) -> tuple[float, float]:
    return MILLI * spread.mean, MILLI * coverage_factor(spread.dof) * spread.u_mean


def _peaks(component: StepComponent, channel: str) -> tuple[str, str, str]:
    """Return the peaks of an output's spectrum, means over the chosen or all releases."""
    releases = component.chosen or component.releases
    peaks = [reading.peaks for r in releases for reading in r.readings if reading.channel == channel]
    first = _mean_peak([found[0] for found in peaks if found])
    seconds = [found[1] for found in peaks if len(found) > 1]
    if 2 * len(seconds) < len(peaks) or not seconds:
        return first, DASH, DASH
    return first, _mean_peak(seconds), number_text(PERCENT * float(np.mean([peak.share for peak in seconds])))


def _mean_peak(peaks: Sequence[SpectrumPeak]) -> str:
    """Return the mean frequency of peaks, U by readings or the larger scatter."""
    if not peaks:
        return DASH
    value = np.array([peak.frequency_hz for peak in peaks])
    u_reading = float(np.sqrt(np.mean([peak.u_frequency_hz**2 for peak in peaks])))
    spread = float(np.std(value, ddof=1)) if len(peaks) > 1 else 0.0
    k = coverage_factor(len(peaks) - 1.0) if spread > u_reading else K2
    return quantity_text(float(value.mean()), k * max(u_reading, spread) / len(peaks) ** 0.5)


def _gain_scale(component: StepComponent) -> tuple[float, str]:
    """Return factor and unit of a component's gains, by the power of the largest."""
    power = round_to_uncertainty(max(abs(gain.value) for gain in component.gains), 0.0).exponent
    unit = typeset(component.unit)
    return 10.0**-power, f"({power_text(power)} {unit})" if power else f"({unit})"


# The command

FILES = ("releases.csv", "models.csv", "indices.csv", "budget.csv", "methods.csv", MODELS_FILE)
STEP = CommandReport("step", "step", FILES, texts, fill, page_context, printed, headlines)


def run_step(
    paths: Sequence[Path],
    output: Path | None,
    settings: StepSettings,
    *,
    force: bool = False,
    allow_outside: bool = False,
) -> None:
    """Evaluate step recordings together, write the results and print the summary."""
    manifests = load_for_command(paths, STEP.name, allow_outside=allow_outside)
    name = manifests[0].name if len(manifests) == 1 else manifests[0].rig.name

    def evaluate(hashes: dict[str, str]) -> StepEvaluation:
        with one_blas_thread():
            return evaluate_steps(name, manifests, settings, hashes)

    STEP.run_recordings(paths, manifests, output, evaluate, force=force)
