"""Files, page and printed lines of an identification, and the command."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, cast, get_args

import h5py
import numpy as np
from markupsafe import Markup

from fusion.campaign.executor import one_blas_thread
from fusion.estimation.coverage import coverage_factor
from fusion.report.folder import CommandReport
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    capitalise,
    columns_of,
    csv_text,
    page_column,
    table,
    text_column,
)
from fusion.sensor.identify.identification_evaluation import (
    LABELS,
    CurveReading,
    IdentifiedComponent,
    IdentifyEvaluation,
    evaluate_identification,
)
from fusion.sensor.identify.identification_figures import curve_figures, sensitivity_figures
from fusion.sensor.identify.identification_inputs import IdentifySettings, PreparedTransfer, mass_unit, read_campaign
from fusion.sensor.identify.model_choice import departure, verdict
from fusion.sensor.model_files import model_file_text, read_model_file
from shaker.identification.measured_curves import ParameterEstimate
from shaker.identification.rival_models import FittedRival, ModelChoice
from shaker.identification.sensitivity import CHAIN_WORDS, SensitivityFit
from shaker.identification.sensor import (
    CHAIN_PARAMETERS,
    SENSOR_PARAMETERS,
    ChainKind,
    ChainModel,
    SensorModel,
    UsableBand,
)
from shaker.labels import LOAD_COMPONENTS, mechanical_units
from shakercal._common.digits import DASH, number_text, quantity_text, round_to_uncertainty, small, times_ten, typeset

# Numbers in files, on the page and on the terminal.


K = coverage_factor(np.inf)
"""For 95 %; the degrees of freedom of a joint fit of many lines are many, and not counted."""
FoundNumber = tuple[str, ParameterEstimate, str]
"""Component, number, and the method that found it."""
NUMBERS: list[TableColumn[FoundNumber]] = [
    text_column("component", lambda row: row[0]),
    text_column("name", lambda row: row[1].name),
    TableColumn("value", lambda row: row[1].value),
    TableColumn("u", lambda row: None if np.isnan(row[1].u) else row[1].u),
    TableColumn("k", lambda _: K),
    TableColumn("U", lambda row: None if np.isnan(row[1].u) else K * row[1].u),
    text_column("unit", lambda row: row[1].unit),
    text_column("method", lambda row: row[2]),
]


def numbers(component: IdentifiedComponent) -> Iterator[FoundNumber]:
    """Yield every number of a component."""
    fit, axis = component.fit, component.name
    found, how = fit.reported, f"joint fit, {fit.choice.best.model}{REJECTED if fit.is_rejected else ''}"
    for estimate in found.estimates:
        stated = estimate.name == component.internal_mass.name and not fit.mass_is_free
        yield axis, estimate, f"{how}, stated beforehand" if stated else how
    for estimate in found.derived:
        yield axis, estimate, how
    curves = {reading.recording for reading in component.readings}
    for mode in (mode for mode in found.modes if mode.record in curves):
        name = f"{mode.record}, mode {mode.number + 1}"
        f0, zeta = (mode.frequency_hz, mode.u_frequency_hz, "Hz"), (mode.damping_ratio, mode.u_damping_ratio, "1")
        yield axis, ParameterEstimate(f"frequency: {name}", f"resonance f₀, {name}", *f0), how
        yield axis, ParameterEstimate(f"damping_ratio: {name}", f"damping ratio ζ, {name}", *zeta), how
    if component.sensitivity is not None:
        best = component.sensitivity.comparison.best
        for estimate in component.sensitivity_estimates:
            yield axis, estimate, f"sensitivity over frequency, {CHAIN_WORDS[best.chain.kind]}"
    for load, band in zip(component.loads, component.bands, strict=True):
        name, label = f"usable_band: load {load:g}", f"usable band, load {number_text(load, 6)}"
        yield axis, ParameterEstimate(name, label, band.upper_hz, band.u_upper_hz, "Hz"), "sensor model"


REJECTED = ", refuted by the data"
LIMITS = {"rise": "resonance", "drop": "fall of the output", "phase": "phase", "nothing": "none"}
_LARGEST_CAUSES = 12


def parameters_table(component: IdentifiedComponent) -> Table | None:
    """Return parameters, lags and modes of a component with U."""
    columns: list[TableColumn[FoundNumber]] = [
        page_column("parameter", lambda row: _label(row[1].label), "l"),
        page_column("value ± U", lambda row: _with_u(row[1])),
        page_column("U / %", lambda row: _relative(row[1].value, row[1].u)),
        page_column("method", lambda row: row[2], "l"),
    ]
    caption = f"Parameters of {component.name}, U = k·u with k = {K:.2f} (95 %)"
    return table(caption, columns, [row for row in numbers(component) if not row[1].name.startswith("usable_band")])


def rivals_table(component: IdentifiedComponent) -> Table | None:
    """Return the rival models of the joint fit."""
    choice, name = component.fit.choice, f"stiffness_{component.name}"
    columns: list[TableColumn[FittedRival]] = [
        page_column("model", lambda rival: str(rival.model), "l"),
        page_column("parameters", lambda rival: f"{rival.free}"),
        page_column("residuals / uncertainty", lambda rival: number_text(departure(rival.identification))),
        page_column("criterion, over the chosen one", lambda rival: number_text(choice.difference(rival))),
        page_column("k", lambda rival: quantity_text(rival.identification.value(name), np.nan)),
        page_column("verdict", lambda rival: verdict(choice, rival), "l"),
    ]
    return table("Rival models, by Akaike's criterion", columns, choice.tried)


def correlation_table(component: IdentifiedComponent) -> Table | None:
    """Return the correlation of the parameters, None of a refuted fit."""
    found = component.fit.identification
    if component.fit.is_rejected:
        return None
    labels = [_label(estimate.label) for estimate in found.estimates]
    cells = [[f"{value:+.3f}".replace("-", "\N{MINUS SIGN}") for value in row] for row in found.correlation.tolist()]
    rows = tuple((label, *row) for label, row in zip(labels, cells, strict=True))
    return Table("Correlation of the parameters", ("", *labels), "l" + "r" * len(labels), rows)


def budget_table(component: IdentifiedComponent) -> Table | None:
    """Return the contribution of every cause, the largest first; None of a refuted fit."""
    if component.fit.is_rejected:
        return None
    estimates = component.fit.identification.estimates
    size = np.abs([estimate.value for estimate in estimates])
    share = {cause: np.abs(change) / size for cause, change in component.fit.identification.budget.items()}
    ordered = sorted(share, key=lambda cause: -float(np.max(share[cause])))
    shown = [cause for cause in ordered if np.max(share[cause]) > 1e-3 * np.max(share[ordered[0]])][:_LARGEST_CAUSES]
    whole = np.array([estimate.u for estimate in estimates]) / size
    rows = tuple(
        (cause, *(number_text(100.0 * part, 2) if part >= 1e-7 else "< 10⁻⁵" for part in parts.tolist()))
        for cause, parts in [*((cause, share[cause]) for cause in shown), ("combined, k = 1", whole)]
    )
    head = ("contribution", *(Markup("u({}) / %").format(_label(estimate.label)) for estimate in estimates))
    return Table("Budget, relative to each parameter", head, "l" + "r" * len(estimates), rows)


def readings_tables(component: IdentifiedComponent) -> list[Table]:
    """Return the readings of every curve by every method."""
    units = mechanical_units(LOAD_COMPONENTS[component.fit.component])
    below, shown = Markup('{}<br><span class="below">{}</span>'), []
    for (recording, response), group in groupby(component.readings, attrgetter("recording", "response")):
        of_curve = list(group)
        exponent = round_to_uncertainty(max(reading.stiffness for reading in of_curve), 0.0).exponent
        rows = tuple(
            (
                below.format(LABELS[reading.method], reading.note) if reading.note else LABELS[reading.method],
                quantity_text(reading.frequency_hz, K * reading.u_frequency_hz),
                quantity_text(reading.width_hz, K * reading.u_width_hz),
                quantity_text(100.0 * reading.damping_ratio, 100.0 * K * reading.u_damping_ratio),
                f"{reading.stiffness / 10.0**exponent:.5f}",
                number_text(reading.damping, 5) if np.isfinite(reading.damping) else DASH,
            )
            for reading in of_curve
        )
        stiffness = Markup("k / ({})").format(times_ten(exponent, typeset(units.stiffness)))
        head = ("method", "f / Hz", "width / Hz", "ζ / %", stiffness, f"b / ({typeset(units.damping)})")
        shown.append(Table(f"{recording}: {response}", head, "lrrrrr", rows))
    return shown


def explanations_table(component: IdentifiedComponent) -> Table | None:
    """Return the explanations of the sensitivity."""
    if component.sensitivity is None:
        return None
    comparison = component.sensitivity.comparison

    def chain(fit: SensitivityFit) -> str:
        named = [e for e in fit.estimates if e.name in ("delay_s", "lag_s", "corner_hz")]
        return Markup("; ").join(Markup(f"{e.label} {_in_microseconds(e)}") for e in named) or DASH

    columns: list[TableColumn[tuple[SensitivityFit, float, str]]] = [
        page_column("explanation in addition to b/k", lambda row: CHAIN_WORDS[row[0].chain.kind], "l"),
        page_column("found", lambda row: chain(row[0]), "l"),
        page_column("χ² / dof", lambda row: f"{row[0].chi_squared:.1f} / {row[0].dof}"),
        page_column("probability", lambda row: small(row[0].probability)),
        page_column("Akaike weight", lambda row: small(row[1])),
        page_column("verdict", lambda row: row[2], "l"),
    ]
    rows = zip(comparison.fits, comparison.weight.tolist(), comparison.verdict, strict=True)
    return table("Explanations of the sensitivity over frequency", columns, rows)


def bands_table(component: IdentifiedComponent) -> Table | None:
    """Return the usable band without correction for each load mass, None without any."""

    def edge(band: UsableBand) -> str:
        return quantity_text(band.upper_hz, K * band.u_upper_hz, "Hz") if np.isfinite(band.upper_hz) else "no limit"

    columns: list[TableColumn[tuple[float, UsableBand]]] = [
        page_column(f"load / {mass_unit(component.fit.component)}", lambda row: number_text(row[0], 6)),
        page_column("up to", lambda row: edge(row[1])),
        page_column("U / %", lambda row: _relative(row[1].upper_hz, row[1].u_upper_hz)),
        page_column("ends by", lambda row: LIMITS[row[1].limit], "l"),
    ]
    permitted = 100.0 * component.bands[0].permitted if component.bands else 0.0
    caption = f"Frequencies up to which the uncorrected output stays within ±{permitted:.6g} % of its static value"
    return table(caption, columns, zip(component.loads, component.bands, strict=True))


def recordings_table(component: IdentifiedComponent) -> Table | None:
    """Return the recordings of the joint fit."""

    def band(item: PreparedTransfer) -> str:
        frequency = item.measured.ratio.frequency_hz
        return f"{number_text(frequency.min(), 6)} to {number_text(frequency.max(), 6)}"

    unit = mass_unit(component.fit.component)
    columns: list[TableColumn[PreparedTransfer]] = [
        page_column("recording", lambda item: item.measured.name, "l"),
        page_column("kind", lambda item: item.manifest.excitation.kind, "l"),
        page_column("load", lambda item: quantity_text(item.load_kg, K * item.u_load_kg, unit)),
        page_column("load over base", lambda item: ", ".join(item.measured.ratio.channels), "l"),
        page_column("lines", lambda item: f"{len(item.measured.ratio.frequency_hz)}"),
        page_column("band / Hz", band),
    ]
    return table("Recordings of the joint fit", columns, component.fit.prepared)


def headlines(evaluation: IdentifyEvaluation) -> list[Headline]:
    """Return stiffness, damping, internal mass, and delay or lag of each component."""
    shown = []
    for component in evaluation.components:
        main = (f"stiffness_{component.name}", f"damping_{component.name}", component.internal_mass.name)
        for estimate in component.fit.reported.estimates:
            if estimate.name.partition(": ")[0] in main:
                remark = f"U (k = {K:.2f}) = {_relative(estimate.value, estimate.u)} %"
                remark = "model refuted by the data" if component.fit.is_rejected else remark
                shown.append(Headline(_label(capitalise(estimate.label)), _with_u(estimate), remark))
        if component.sensitivity is not None:
            where = f"of {LOAD_COMPONENTS[component.fit.component]}"
            for estimate in component.sensitivity_estimates:
                if estimate.name in ("delay_s", "lag_s"):
                    label = capitalise(f"{estimate.label} {where}")
                    shown.append(Headline(label, _in_microseconds(estimate), "from S(f), with U"))
    return shown


def printed(evaluation: IdentifyEvaluation) -> Iterator[str]:
    """Yield the printed lines: parameters with U at 95 %, then bands."""
    for component in evaluation.components:
        fit = component.fit
        yield f"{component.name}: {fit.choice.best.model} ({fit.reason}), {len(fit.prepared)} recordings"
        if fit.is_rejected:
            yield "  model refuted by the data: values without U"
        estimates = [*fit.reported.estimates, *fit.reported.derived]
        for estimate in [*estimates, *(e for e in component.sensitivity_estimates if e.name != "spring_time_s")]:
            yield f"  {estimate.label}: {quantity_text(estimate.value, K * estimate.u, estimate.unit)}"
        for load, band in zip(component.loads, component.bands, strict=True):
            limit = quantity_text(band.upper_hz, K * band.u_upper_hz, "Hz")
            loaded = f"load {number_text(load, 6)} {mass_unit(component.fit.component)}"
            yield f"  usable up to (±{number_text(100.0 * band.permitted)} %, {loaded}): {limit}"


def _in_microseconds(estimate: ParameterEstimate) -> str:
    """Return a value with U and unit; times in µs."""
    scale, unit = (1e6, "µs") if estimate.unit == "s" else (1.0, estimate.unit)
    return quantity_text(scale * estimate.value, scale * K * estimate.u, unit)


def _with_u(estimate: ParameterEstimate) -> str:
    return quantity_text(estimate.value, K * estimate.u, "" if estimate.unit == "1" else typeset(estimate.unit))


def _relative(value: float, u: float) -> str:
    """Return the relative U in %, a dash if not determined."""
    share = K * u / abs(value) if value and np.isfinite(value) else np.nan
    return small(100.0 * share) if np.isfinite(share) else DASH


def _label(text: str) -> Markup:
    """Return a label with its index typeset."""
    return Markup("{}m<sub>i</sub>{}").format(*text.split("m_i", 1)) if "m_i" in text else Markup("{}").format(text)


def page_context(evaluation: IdentifyEvaluation) -> dict[str, Any]:
    """Return the content of the page."""
    sensor = evaluation.sensor
    subject = []
    if sensor is not None:
        subject.append(("Sensor", f"{sensor.name}, serial number {sensor.serial}" if sensor.serial else sensor.name))
    prepared = [item for component in evaluation.components for item in component.fit.prepared]
    subject.append(("Rigs", "; ".join(dict.fromkeys(item.manifest.rig.name for item in prepared))))
    subject.append(("Recordings", f"{len(prepared)} with load over base"))
    components = [_component_context(component) for component in evaluation.components]
    return {"subject": subject, "components": components}


def _component_context(component: IdentifiedComponent) -> dict[str, Any]:
    sentences = ["No sensitivity over frequency was evaluated: whether the chain has a lag is not determined."]
    if component.sensitivity is not None:
        comparison = component.sensitivity.comparison
        sentences = [comparison.text, *([] if comparison.damping is None else [comparison.damping.text])]
    return {
        "name": component.name,
        "reason": f"{component.fit.choice.best.model}: {component.fit.reason}",
        "refuted": component.fit.is_rejected,
        "rivals": rivals_table(component),
        "parameters": parameters_table(component),
        "correlation": correlation_table(component),
        "recordings": recordings_table(component),
        "curves": curve_figures(component),
        "readings": readings_tables(component),
        "sentences": sentences,
        "explanations": explanations_table(component),
        "sensitivity": sensitivity_figures(component),
        "bands": bands_table(component),
        "budget": budget_table(component),
    }


# model.json, the model for corrections: written and read.


MODEL_FILE = "model.json"


@dataclass(frozen=True)
class ComponentModel:
    """The model of one component: output `channel` for the load `component` (Fx … Mz).

    Attributes
    ----------
    structure : the model that explains the resonances.
    range_hz : frequency range of the data.
    sensitivity_measured : whether S(f) was evaluated. Without it the chain is not known, and the static sensitivity is
        that of the rig, or one.
    """

    component: str
    channel: str
    structure: str
    sensor: SensorModel
    range_hz: tuple[float, float]
    sensitivity_measured: bool


@dataclass(frozen=True)
class SensorFile:
    """The models of a sensor's components."""

    name: str
    serial: str
    campaign: str
    components: tuple[ComponentModel, ...]

    def __getitem__(self, component: str) -> ComponentModel:
        """Return the model of a load component, such as "Fz"."""
        for model in self.components:
            if model.component == component:
                return model
        names = ", ".join(model.component for model in self.components)
        raise ValueError(f"component: expected one of {names}, found {component}")


def model_text(evaluation: IdentifyEvaluation) -> str:
    """Return the content of model.json."""
    sensor = evaluation.sensor
    content = {
        "campaign": evaluation.name,
        "program": evaluation.versions.get("shakercal", ""),
        "sensor": {"name": "" if sensor is None else sensor.name, "serial": "" if sensor is None else sensor.serial},
        "components": [_model_of(component) for component in evaluation.components],
    }
    return model_file_text(content, allow_nan=True)


def read_sensor_models(path: str | Path) -> SensorFile:
    """Read the models of a sensor from model.json.

    Parameters
    ----------
    path
        The file, or a folder of results that contains it.

    Returns
    -------
    SensorFile : the models by component, such as `["Fz"]`.

    Raises
    ------
    InputError : the file is missing, or damaged at the named entry.

    Examples
    --------
    >>> from fusion import read_sensor_models
    >>> sensor = read_sensor_models("my-masses/identify")["Fz"].sensor  # doctest: +SKIP
    """

    def parsed(content: dict[str, Any]) -> SensorFile:
        components, sensor = tuple(_read_component(item) for item in content["components"]), content["sensor"]
        return SensorFile(str(sensor["name"]), str(sensor["serial"]), str(content["campaign"]), components)

    return read_model_file(Path(path), MODEL_FILE, "identify", parsed)


def _model_of(component: IdentifiedComponent) -> dict[str, Any]:
    """Return one component as nested dictionaries in SI units."""
    model, seen, identified = component.model, component.sensitivity, component.fit.reported
    rejected = component.fit.is_rejected
    values = [model.sensitivity, model.stiffness, model.damping, model.internal_mass, *model.chain.parameters.tolist()]
    damper = next(e for e in identified.estimates if e.name.startswith(f"damping_{component.name}"))
    mechanical = (identified[f"stiffness_{component.name}"], damper, component.internal_mass)
    chain_units = ("s^2" if name == "square_s2" else "s" for name in model.chain.names)
    parameters = {
        "name": [*SENSOR_PARAMETERS, *model.chain.names],
        "value": values,
        "u": [None] * len(values) if rejected else np.sqrt(model.covariance.diagonal()).tolist(),
        "unit": [model.unit, *(estimate.unit for estimate in mechanical), *chain_units],
    }
    load = LOAD_COMPONENTS[component.fit.component]
    bands = [
        (
            mass,
            band.permitted,
            band.upper_hz if np.isfinite(band.upper_hz) else None,
            None if rejected else band.u_upper_hz,
        )
        for mass, band in zip(component.loads, component.bands, strict=True)
    ]
    return {
        "component": load,
        "channel": load if seen is None else seen.measured.channel,
        "structure": component.fit.model,
        "damping_law": "loss factor" if component.fit.choice.best.model.loss_factor else "viscous",
        "sensitivity_measured": seen is not None,
        "frequency_range_hz": list(component.range_hz),
        "chain": model.chain.kind,
        "parameters": [dict(zip(parameters, row, strict=True)) for row in zip(*parameters.values(), strict=True)],
        "covariance": None if rejected else model.covariance.tolist(),
        "usable_bands": [dict(zip(("load", "permitted", "upper_hz", "u"), band, strict=True)) for band in bands],
    }


def _read_component(item: dict[str, Any]) -> ComponentModel:
    if item["chain"] not in get_args(ChainKind):
        raise ValueError(f"expected a chain of {', '.join(get_args(ChainKind))}, found {item['chain']}")
    kind = cast("ChainKind", item["chain"])
    named = {parameter["name"]: float(parameter["value"]) for parameter in item["parameters"]}
    chain = ChainModel(kind, np.array([named[name] for name in CHAIN_PARAMETERS[kind]], dtype=np.float64))
    unit, size = str(item["parameters"][0]["unit"]), len(item["parameters"])
    covariance = np.full((size, size), np.nan) if item["covariance"] is None else np.array(item["covariance"], float)
    sensitivity, stiffness, damping, mass = (named[name] for name in SENSOR_PARAMETERS)
    low, high = item["frequency_range_hz"]
    return ComponentModel(
        component=str(item["component"]),
        channel=str(item["channel"]),
        structure=str(item["structure"]),
        sensor=SensorModel(sensitivity, stiffness, damping, mass, chain, covariance, unit),
        range_hz=(float(low), float(high)),
        sensitivity_measured=bool(item["sensitivity_measured"]),
    )


# The folder.


def _fill(file: h5py.File, evaluation: IdentifyEvaluation) -> None:
    """Fill the HDF5 file with model, fit, curves and sensitivity of each component."""
    file.attrs["campaign"] = evaluation.name
    file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
    write_value(file, "notices", evaluation.notices)
    for component in evaluation.components:
        fit, group = component.fit, file.create_group(component.name, track_order=True)
        for name in ("model", "reason", "mass_is_free"):
            write_value(group, name, getattr(fit, name))
        write_value(group, "rivals", [_rival_row(fit.choice, rival) for rival in fit.choice.tried])
        identified = group.create_group("identification", track_order=True)
        found = ("estimates", "covariance", "correlation", "derived", "modes", "unknowns")
        for name in (*found, "chi_squared", "dof", "budget"):
            write_value(identified, name, getattr(fit.reported, name))
        curves = group.create_group("recordings", track_order=True)
        for index, item in enumerate(fit.prepared):
            recording_group = curves.create_group(f"{index:03d}", track_order=True)
            write_fields(recording_group, item.measured)
            write_value(recording_group, "model", fit.identification.model[index])
            write_value(recording_group, "residual", fit.identification.residual[index])
        for name in ("readings", "sensitivity", "model", "range_hz", "loads", "bands"):
            write_value(group, "sensor_model" if name == "model" else name, getattr(component, name))


@dataclass(frozen=True)
class RivalRow:
    """A rival model as files describe it."""

    model: str
    parameters: int
    chi_squared: float
    dof: float
    criterion: float
    verdict: str


def _rival_row(choice: ModelChoice, rival: FittedRival) -> RivalRow:
    found = rival.identification
    numbers = rival.free, found.chi_squared, found.dof, choice.difference(rival)
    return RivalRow(str(rival.model), *numbers, verdict(choice, rival))


def _texts(evaluation: IdentifyEvaluation) -> dict[str, str | bytes]:
    readings = [(component.name, reading) for component in evaluation.components for reading in component.readings]

    def of_reading(column: TableColumn[CurveReading]) -> TableColumn[tuple[str, CurveReading]]:
        return TableColumn(column.name, lambda row: column.value(row[1]))

    component: TableColumn[tuple[str, CurveReading]] = text_column("component", lambda row: row[0])
    return {
        "parameters.csv": csv_text(NUMBERS, [row for component in evaluation.components for row in numbers(component)]),
        "readings.csv": csv_text([component, *map(of_reading, columns_of(CurveReading))], readings),
        MODEL_FILE: model_text(evaluation),
    }


IDENTIFY = CommandReport(
    "identify",
    "identify",
    ("parameters.csv", "readings.csv", MODEL_FILE),
    _texts,
    _fill,
    page_context,
    printed,
    headlines,
)


def run_identify(
    path: Path, output: Path | None, settings: IdentifySettings, *, force: bool = False, allow_outside: bool = False
) -> None:
    """Identify the sensor of a campaign, write the results and print the summary."""
    campaign = read_campaign(path, allow_outside=allow_outside)

    def evaluate(hashes: dict[str, str]) -> IdentifyEvaluation:
        with one_blas_thread():
            return evaluate_identification(campaign, settings)

    folder = campaign.folder / IDENTIFY.name if output is None else output
    IDENTIFY.run(campaign.inputs, folder, evaluate, force=force)
