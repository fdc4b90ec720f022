"""What an identification leaves: parameters.csv, readings.csv, model.json, identify.h5, the page and printed lines."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import h5py
import numpy as np
from markupsafe import Markup

from fusion.base import DASH, InputError, rounded, typeset
from fusion.campaign.executor import one_blas_thread
from fusion.estimation.uncertainty import coverage_factor
from fusion.report.folder import Command
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import (
    Column,
    Headline,
    Table,
    capital,
    columns_of,
    csv_text,
    measured,
    on_page,
    small,
    table,
    times_ten,
    word,
)
from fusion.sensor.identify.evaluate import (
    LABELS,
    ComponentResult,
    IdentifyEvaluation,
    Reading,
    evaluate_identification,
    of_curve,
)
from fusion.sensor.identify.figures import curve_pictures, sensitivity_pictures
from fusion.sensor.identify.measured import IdentifySettings, Prepared, mass_unit, read_campaign
from shaker.identification.measured import ParameterEstimate
from shaker.identification.sensitivity import CHAIN_WORDS, SensitivityFit
from shaker.identification.sensor import CHAIN_PARAMETERS, SENSOR_PARAMETERS, Chain, ChainKind, SensorModel, UsableBand
from shaker.labels import LOAD_COMPONENTS

# The page, and the lines of the terminal.


K = coverage_factor(np.inf)


class NumberRow(NamedTuple):
    """One number of parameters.csv, and the method that found it."""

    component: str
    name: str
    value: float
    u: float
    k: float
    U: float
    unit: str
    method: str


def numbers(component: ComponentResult) -> Iterator[tuple[ParameterEstimate, str]]:
    """Every number found of a component, and the method that found it."""
    fit = component.fit
    how = f"joint fit, {fit.model}"
    for estimate in fit.identification.estimates:
        stated = estimate.name == component.internal_mass.name and not fit.mass_is_free
        yield estimate, f"{how}, stated beforehand" if stated else how
    for estimate in fit.identification.derived:
        yield estimate, how
    curves = {reading.recording for reading in component.readings}
    for mode in fit.identification.modes:
        if mode.record in curves:
            place = f"{mode.record}, mode {mode.number + 1}"
            f0, zeta = (mode.frequency_hz, mode.u_frequency_hz, "Hz"), (mode.damping_ratio, mode.u_damping_ratio, "1")
            yield ParameterEstimate(f"frequency: {place}", f"resonance f₀, {place}", *f0), how
            yield ParameterEstimate(f"damping_ratio: {place}", f"damping ratio ζ, {place}", *zeta), how
    if component.sensitivity is not None:
        best = component.sensitivity.comparison.best
        for estimate in best.estimates:
            yield estimate, f"sensitivity over frequency, {CHAIN_WORDS[best.chain.kind]}"
    for load, band in zip(component.loads, component.bands, strict=True):
        place = f"load {load:.6g}"
        name, label = f"usable_band: {place}", f"usable band, {place}"
        yield ParameterEstimate(name, label, band.upper_hz, band.u_upper_hz, "Hz"), "sensor model"


def parameter_rows(evaluation: IdentifyEvaluation) -> Iterator[NumberRow]:
    """One row per number."""
    for component in evaluation.components:
        for estimate, method in numbers(component):
            values = (estimate.value, estimate.u, K, K * estimate.u, ascii_unit(estimate.unit))
            yield NumberRow(component.name, estimate.name, *values, method)


def ascii_unit(unit: str) -> str:
    """ASCII form of a unit for files: `N·m/rad` becomes `N.m/rad`."""
    return unit.replace("·", ".").replace("²", "^2")


LIMITS = {"rise": "resonance", "drop": "fall of the output", "phase": "phase", "nothing": "nothing"}
_LARGEST_CAUSES = 12


def parameters_table(component: ComponentResult) -> Table | None:
    """Parameters, lags and modes of a component with U."""
    columns: list[Column[tuple[ParameterEstimate, str]]] = [
        on_page("parameter", lambda row: _label(row[0].label), "l"),
        on_page("value ± U", lambda row: _with_u(row[0])),
        on_page("U / %", lambda row: _relative(row[0].value, row[0].u)),
        on_page("method", lambda row: row[1], "l"),
    ]
    caption = f"Parameters of {component.name}, U = k·u with k = {K:.2f} (95 %)"
    return table(caption, columns, [row for row in numbers(component) if not row[0].name.startswith("usable_band")])


def correlation_table(component: ComponentResult) -> Table:
    """Correlation of the parameters of the joint fit."""
    found = component.fit.identification
    labels = [_label(estimate.label) for estimate in found.estimates]
    cells = [[f"{value:+.3f}".replace("-", "\N{MINUS SIGN}") for value in row] for row in found.correlation.tolist()]
    rows = tuple((label, *row) for label, row in zip(labels, cells, strict=True))
    return Table("Correlation of the parameters", ("", *labels), "l" + "r" * len(labels), rows)


def budget_table(component: ComponentResult) -> Table:
    """What every cause adds to the uncertainty of the parameters, largest first."""
    found = component.fit.identification
    value = np.array([estimate.value for estimate in found.estimates])
    share = {cause: np.abs(change) / np.abs(value) for cause, change in found.budget.items()}
    ordered = sorted(share.items(), key=lambda item: -float(np.max(item[1])))
    largest = float(np.max(ordered[0][1])) if ordered else 0.0
    kept = [item for item in ordered if float(np.max(item[1])) > 1e-3 * largest][:_LARGEST_CAUSES]
    rows = [(cause, *(_share(float(part)) for part in parts)) for cause, parts in kept]
    total = [_share(estimate.u / abs(estimate.value)) for estimate in found.estimates]
    rows.append(("combined, k = 1", *total))
    head = ("contribution", *(Markup("u({}) / %").format(_label(estimate.label)) for estimate in found.estimates))
    return Table("Budget, relative to each parameter", head, "l" + "r" * len(total), tuple(rows))


def readings_tables(component: ComponentResult) -> list[Table]:
    """What every method reads from every curve."""
    curves = dict.fromkeys((reading.recording, reading.response) for reading in component.readings)
    return [_readings_table(component, *curve) for curve in curves]


def _readings_table(component: ComponentResult, recording: str, response: str) -> Table:
    """All methods on one curve, stiffness in units of a power of ten."""
    turning = component.fit.component >= 3
    own = of_curve(component.readings, recording, response)
    exponent = rounded(max(reading.stiffness for reading in own), 0.0).exponent
    below = Markup('{}<br><span class="below">{}</span>')
    rows = tuple(
        (
            below.format(LABELS[reading.method], reading.note) if reading.note else LABELS[reading.method],
            measured(reading.frequency_hz, K * reading.u_frequency_hz),
            measured(reading.width_hz, K * reading.u_width_hz),
            measured(100.0 * reading.damping_ratio, 100.0 * K * reading.u_damping_ratio),
            f"{reading.stiffness / 10.0**exponent:.5f}",
            f"{reading.damping:.5g}" if np.isfinite(reading.damping) else DASH,
        )
        for reading in own
    )
    unit = times_ten(exponent, "N·m/rad" if turning else "N/m")
    damper = "b / (N·m·s/rad)" if turning else "b / (N·s/m)"
    head = ("method", "f / Hz", "width / Hz", "ζ / %", Markup("k / ({})").format(unit), damper)
    return Table(f"{recording}: {response}", head, "lrrrrr", rows)


def explanations_table(component: ComponentResult) -> Table | None:
    """The explanations of the sensitivity side by side."""
    if component.sensitivity is None:
        return None
    comparison = component.sensitivity.comparison

    def chain(fit: SensitivityFit) -> str:
        named = [e for e in fit.estimates if e.name in ("delay_s", "lag_s", "corner_hz")]
        return Markup("; ").join(Markup(f"{e.label} {measured(*_scaled(e))}") for e in named) if named else DASH

    columns: list[Column[tuple[SensitivityFit, float, str]]] = [
        on_page("explanation beside b/k of the resonance", lambda row: CHAIN_WORDS[row[0].chain.kind], "l"),
        on_page("found", lambda row: chain(row[0]), "l"),
        on_page("χ² / dof", lambda row: f"{row[0].chi_squared:.1f} / {row[0].dof}"),
        on_page("probability", lambda row: small(row[0].probability)),
        on_page("Akaike weight", lambda row: small(row[1])),
        on_page("verdict", lambda row: row[2], "l"),
    ]
    rows = zip(comparison.fits, comparison.weight.tolist(), comparison.verdict, strict=True)
    return table("What makes the sensitivity change with frequency", columns, rows)


def bands_table(component: ComponentResult) -> Table | None:
    """Usable band without correction for each load mass, None where there is none."""
    columns: list[Column[tuple[float, UsableBand]]] = [
        on_page(f"load / {mass_unit(component.fit.component)}", lambda row: f"{row[0]:.6g}"),
        on_page("up to", lambda row: _edge(row[1])),
        on_page("U / %", lambda row: _relative(row[1].upper_hz, row[1].u_upper_hz)),
        on_page("ends by", lambda row: LIMITS[row[1].limit], "l"),
    ]
    permitted = 100.0 * component.bands[0].permitted if component.bands else 0.0
    caption = f"Frequencies up to which the uncorrected output stays within ±{permitted:g} % of its static value"
    return table(caption, columns, zip(component.loads, component.bands, strict=True))


def recordings_table(component: ComponentResult) -> Table | None:
    """The recordings behind the joint fit."""

    def band(item: Prepared) -> str:
        frequency = item.measured.ratio.frequency_hz
        return f"{frequency.min():.6g} to {frequency.max():.6g}"

    unit = mass_unit(component.fit.component)
    columns: list[Column[Prepared]] = [
        on_page("recording", lambda item: item.measured.name, "l"),
        on_page("kind", lambda item: item.manifest.excitation.kind, "l"),
        on_page("load", lambda item: measured(item.load_kg, K * item.u_load_kg, unit)),
        on_page("load over base", lambda item: ", ".join(item.measured.ratio.channels), "l"),
        on_page("lines", lambda item: f"{len(item.measured.ratio.frequency_hz)}"),
        on_page("band / Hz", band),
    ]
    return table("Recordings of the joint fit", columns, component.fit.prepared)


def headlines(evaluation: IdentifyEvaluation) -> list[Headline]:
    """Stiffness, damping and internal mass along each component, and delay or lag of the chain where S(f) has one."""
    shown = []
    for component in evaluation.components:
        main = (f"stiffness_{component.name}", f"damping_{component.name}", component.internal_mass.name)
        for estimate in component.fit.identification.estimates:
            if estimate.name.partition(": ")[0] in main:
                remark = f"U (k = {K:.2f}) = {_relative(estimate.value, estimate.u)} %"
                shown.append(Headline(_label(capital(estimate.label)), _with_u(estimate), remark))
        if component.sensitivity is not None:
            where = f"of {LOAD_COMPONENTS[component.fit.component]}"
            for estimate in component.sensitivity.comparison.best.estimates:
                if estimate.name in ("delay_s", "lag_s"):
                    label = capital(f"{estimate.label} {where}")
                    shown.append(Headline(label, measured(*_scaled(estimate)), "from S(f), with U"))
    return shown


def printed(evaluation: IdentifyEvaluation) -> Iterator[str]:
    """Lines for the terminal: parameters with U at 95 %, then bands."""
    for component in evaluation.components:
        fit = component.fit
        yield f"{component.name}: {fit.model} ({fit.reason}), {len(fit.prepared)} recordings"
        estimates = [*fit.identification.estimates, *fit.identification.derived]
        if component.sensitivity is not None:
            estimates += [e for e in component.sensitivity.comparison.best.estimates if e.name != "spring_time_s"]
        for estimate in estimates:
            text = rounded(estimate.value, K * estimate.u)
            power = f"e{text.exponent}" if text.exponent else ""
            yield f"  {estimate.label}: ({text.value} ± {text.expanded}){power} {typeset(estimate.unit)}"
        for load, band in zip(component.loads, component.bands, strict=True):
            text = rounded(band.upper_hz, K * band.u_upper_hz, 0)
            yield f"  usable up to ({band.permitted:.2%}, load {load:.6g}): {text.value} ± {text.expanded} Hz"


def _edge(band: UsableBand) -> str:
    """Edge of a band with U."""
    return measured(band.upper_hz, K * band.u_upper_hz, "Hz") if np.isfinite(band.upper_hz) else "no limit"


def _scaled(estimate: ParameterEstimate) -> tuple[float, float, str]:
    """Value and U of a time in µs, of other numbers in their unit."""
    if estimate.unit == "s":
        return 1e6 * estimate.value, 1e6 * K * estimate.u, "µs"
    return estimate.value, K * estimate.u, estimate.unit


def _with_u(estimate: ParameterEstimate) -> str:
    """Value with U and unit."""
    return measured(estimate.value, K * estimate.u, "" if estimate.unit == "1" else typeset(estimate.unit))


def _relative(value: float, u: float) -> str:
    """Relative U in per cent, a dash where there is none."""
    share = K * u / abs(value) if value and np.isfinite(value) else np.nan
    return small(100.0 * share) if np.isfinite(share) else DASH


def _label(text: str) -> Markup:
    """A label with its index typeset."""
    return Markup("{}m<sub>i</sub>{}").format(*text.split("m_i", 1)) if "m_i" in text else Markup("{}").format(text)


def _share(share: float) -> str:
    """A relative contribution in per cent to two digits, far below the last place of interest only bounded."""
    return f"{100.0 * share:.2g}" if share >= 1e-7 else "< 10⁻⁵"


def page_context(evaluation: IdentifyEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    sensor = evaluation.sensor
    subject = []
    if sensor is not None:
        subject.append(("Sensor", f"{sensor.name}, serial number {sensor.serial}" if sensor.serial else sensor.name))
    prepared = [item for component in evaluation.components for item in component.fit.prepared]
    subject.append(("Rigs", "; ".join(dict.fromkeys(item.manifest.rig.name for item in prepared))))
    subject.append(("Recordings", f"{len(prepared)} with load over base"))
    components = [_component_context(component) for component in evaluation.components]
    return {"subject": subject, "headlines": headlines(evaluation), "components": components}


def _component_context(component: ComponentResult) -> dict[str, Any]:
    """Everything the template shows of one component."""
    sentences = ["No sensitivity over frequency was evaluated: whether the chain has a lag remains open."]
    if component.sensitivity is not None:
        comparison = component.sensitivity.comparison
        sentences = [comparison.text, *([] if comparison.damping is None else [comparison.damping.text])]
    return {
        "name": component.name,
        "reason": f"{component.fit.model}: {component.fit.reason}",
        "parameters": parameters_table(component),
        "correlation": correlation_table(component),
        "recordings": recordings_table(component),
        "curves": curve_pictures(component),
        "readings": readings_tables(component),
        "sentences": sentences,
        "explanations": explanations_table(component),
        "sensitivity": sensitivity_pictures(component),
        "bands": bands_table(component),
        "budget": budget_table(component),
    }


# model.json, what a correction needs: written and read.


FORMAT = 1
MODEL_FILE = "model.json"


@dataclass(frozen=True)
class ComponentModel:
    """The model of one component: output `channel` for the load `component` (Fx … Mz), from data in `range_hz`.

    `structure`: what the resonances were explained by. `sensitivity_measured`: whether S(f) was evaluated, without
    which the chain is unknown and the static sensitivity that of the rig, or one.
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
        "format": FORMAT,
        "campaign": evaluation.name,
        "program": evaluation.versions.get("shakercal", ""),
        "sensor": {"name": "" if sensor is None else sensor.name, "serial": "" if sensor is None else sensor.serial},
        "components": [_model_of(component) for component in evaluation.components],
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def read_sensor_models(path: str | Path) -> SensorFile:
    """Read model.json, or the one in a folder of results; `InputError` names what cannot be read.

    >>> from fusion import read_sensor_models
    >>> sensor = read_sensor_models("my-masses/identify")["Fz"].sensor  # doctest: +SKIP
    """
    file = Path(path) / MODEL_FILE if Path(path).is_dir() else Path(path)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            found = f"format {content['format']}"
            raise InputError(
                file, "format", found=found, expected=f"format {FORMAT}; shakercal identify writes it anew"
            )
        components = tuple(_read_component(item) for item in content["components"])
        sensor = content["sensor"]
        return SensorFile(str(sensor["name"]), str(sensor["serial"]), str(content["campaign"]), components)
    except OSError as error:
        raise InputError(file, "", found=error.strerror or str(error), expected="a file that can be read") from error
    except (KeyError, TypeError, ValueError) as error:
        found = f"no key {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(file, "", found=found, expected="a model as shakercal identify writes it") from error


def _model_of(component: ComponentResult) -> dict[str, Any]:
    """One component as nested dictionaries; numbers are SI, the covariance in the order of its parameters."""
    model, measured, identified = component.model, component.sensitivity, component.fit.identification
    values = [model.sensitivity, model.stiffness, model.damping, model.internal_mass, *model.chain.parameters.tolist()]
    u = np.sqrt(model.covariance.diagonal()).tolist()
    names = [*SENSOR_PARAMETERS, *model.chain.names]
    damper = next(e for e in identified.estimates if e.name.startswith(f"damping_{component.name}"))
    mechanical = (identified[f"stiffness_{component.name}"], damper, component.internal_mass)
    chain_units = ("s^2" if name == "square_s2" else "s" for name in model.chain.names)
    units = [model.unit, *(ascii_unit(estimate.unit) for estimate in mechanical), *chain_units]
    load = LOAD_COMPONENTS[component.fit.component]
    bands = [
        (mass, band.permitted, band.upper_hz if np.isfinite(band.upper_hz) else None, band.u_upper_hz)
        for mass, band in zip(component.loads, component.bands, strict=True)
    ]
    return {
        "component": load,
        "channel": load if measured is None else measured.measured.channel,
        "structure": component.fit.model,
        "sensitivity_measured": measured is not None,
        "frequency_range_hz": list(component.range_hz),
        "chain": model.chain.kind,
        "parameters": [
            {"name": name, "value": value, "u": spread, "unit": unit}
            for name, value, spread, unit in zip(names, values, u, units, strict=True)
        ],
        "covariance": model.covariance.tolist(),
        "usable_bands": [dict(zip(("load", "permitted", "upper_hz", "u"), band, strict=True)) for band in bands],
    }


def _read_component(item: dict[str, Any]) -> ComponentModel:
    """One component from its dictionary."""
    kind = item["chain"]
    if kind not in get_args(ChainKind):
        raise ValueError(f"expected a chain of {', '.join(get_args(ChainKind))}, found {kind}")
    named = {parameter["name"]: float(parameter["value"]) for parameter in item["parameters"]}
    shape = cast("ChainKind", kind)
    sensitivity, stiffness, damping, internal_mass = (named[name] for name in SENSOR_PARAMETERS)
    low, high = item["frequency_range_hz"]
    return ComponentModel(
        component=str(item["component"]),
        channel=str(item["channel"]),
        structure=str(item["structure"]),
        sensor=SensorModel(
            sensitivity,
            stiffness,
            damping,
            internal_mass,
            Chain(shape, np.array([named[name] for name in CHAIN_PARAMETERS[shape]], dtype=np.float64)),
            np.array(item["covariance"], dtype=np.float64),
            str(item["parameters"][0]["unit"]),
        ),
        range_hz=(float(low), float(high)),
        sensitivity_measured=bool(item["sensitivity_measured"]),
    )


# The folder.


def _fill(file: h5py.File, evaluation: IdentifyEvaluation) -> None:
    """Fill the HDF5 file: of each component why which model, what was fitted, curves with model and residual, S(f)."""
    file.attrs["campaign"] = evaluation.name
    file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
    write_value(file, "notices", evaluation.notices)
    for component in evaluation.components:
        fit, group = component.fit, file.create_group(component.name, track_order=True)
        for name in ("model", "reason", "mass_is_free"):
            write_value(group, name, getattr(fit, name))
        identified = group.create_group("identification", track_order=True)
        for name in ("estimates", "covariance", "correlation", "derived", "modes", "unknowns", "factors"):
            write_value(identified, name, getattr(fit.identification, name))
        for name in ("chi_squared", "dof", "budget"):
            write_value(identified, name, getattr(fit.identification, name))
        curves = group.create_group("recordings", track_order=True)
        for place, item in enumerate(fit.prepared):
            own = curves.create_group(f"{place:03d}", track_order=True)
            write_fields(own, item.measured)
            write_value(own, "model", fit.identification.model[place])
            write_value(own, "residual", fit.identification.residual[place])
        for name in ("readings", "sensitivity", "model", "range_hz", "loads", "bands"):
            write_value(group, "sensor_model" if name == "model" else name, getattr(component, name))


def _texts(evaluation: IdentifyEvaluation) -> dict[str, str | bytes]:
    """Tables and model."""
    readings = [(component.name, reading) for component in evaluation.components for reading in component.readings]

    def of_reading(column: Column[Reading]) -> Column[tuple[str, Reading]]:
        return Column(column.name, lambda row: column.value(row[1]))

    component: Column[tuple[str, Reading]] = word("component", lambda row: row[0])
    return {
        "parameters.csv": csv_text(columns_of(NumberRow), parameter_rows(evaluation)),
        "readings.csv": csv_text([component, *map(of_reading, columns_of(Reading))], readings),
        MODEL_FILE: model_text(evaluation),
    }


FILES = ("parameters.csv", "readings.csv", MODEL_FILE)
IDENTIFY = Command("identify", "identify", FILES, _texts, _fill, page_context, printed)


def run_identify(
    path: Path, output: Path | None, settings: IdentifySettings, *, force: bool = False, allow_outside: bool = False
) -> None:
    """Identify the sensor of a campaign folder, write the results to `output` (default CAMPAIGN/identify), and print.

    A place that cannot take the results is refused before anything is computed.
    """
    campaign = read_campaign(path, allow_outside=allow_outside)

    def evaluate(hashes: dict[str, str]) -> IdentifyEvaluation:
        with one_blas_thread():
            return evaluate_identification(campaign, settings)

    folder = campaign.folder / IDENTIFY.name if output is None else output
    IDENTIFY.run(campaign.input_hashes, folder, evaluate, force=force)
