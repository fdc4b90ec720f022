"""Result folder of an identification, and model.json."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import h5py
import numpy as np

from fusion.base import InputError
from fusion.campaign.executor import one_blas_thread
from fusion.report.folder import Command
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import Column, columns_of, csv_text, word
from fusion.sensor.identify.evaluate import ComponentResult, IdentifyEvaluation, Reading, evaluate_identification
from fusion.sensor.identify.measured import IdentifySettings, read_campaign
from fusion.sensor.identify.report import NumberRow, page_context, parameter_rows, plain, printed
from shaker.identification.sensor import CHAIN_PARAMETERS, SENSOR_PARAMETERS, Chain, ChainKind, SensorModel
from shaker.labels import LOAD_COMPONENTS

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
        "components": [_component(component) for component in evaluation.components],
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def read_model(path: Path) -> SensorFile:
    """Read model.json, or the one in a folder of results; `InputError` names what cannot be read."""
    file = path / MODEL_FILE if path.is_dir() else path
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


def _component(component: ComponentResult) -> dict[str, Any]:
    """One component as nested dictionaries; numbers are SI, the covariance in the order of its parameters."""
    model, measured = component.model, component.sensitivity
    values = [model.sensitivity, model.stiffness, model.damping, model.internal_mass, *model.chain.parameters.tolist()]
    u = np.sqrt(model.covariance.diagonal()).tolist()
    names = [*SENSOR_PARAMETERS, *model.chain.names]
    units = [model.unit, *_units(component), *("s^2" if name == "square_s2" else "s" for name in model.chain.names)]
    load = LOAD_COMPONENTS[component.fit.component]
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
        "usable_bands": [
            {"load": mass, "permitted": band.permitted, "upper_hz": _finite(band.upper_hz), "u": band.u_upper_hz}
            for mass, band in zip(component.loads, component.bands, strict=True)
        ],
    }


def _units(component: ComponentResult) -> list[str]:
    """Units of stiffness, damping and internal mass."""
    axis, found = component.name, component.fit.identification
    damper = next(estimate for estimate in found.estimates if estimate.name.startswith(f"damping_{axis}"))
    return [plain(unit) for unit in (found[f"stiffness_{axis}"].unit, damper.unit, component.internal_mass.unit)]


def _finite(value: float) -> float | None:
    """A number that JSON has, none where there is no limit."""
    return value if np.isfinite(value) else None


def _read_component(item: dict[str, Any]) -> ComponentModel:
    """One component from its dictionary."""
    kind = item["chain"]
    if kind not in get_args(ChainKind):
        raise ValueError(f"expected a chain of {', '.join(get_args(ChainKind))}, found {kind}")
    named = {parameter["name"]: float(parameter["value"]) for parameter in item["parameters"]}
    shape = cast("ChainKind", kind)
    sensitivity, stiffness, damping, internal_mass = (named[name] for name in SENSOR_PARAMETERS)
    sensor = SensorModel(
        sensitivity=sensitivity,
        stiffness=stiffness,
        damping=damping,
        internal_mass=internal_mass,
        chain=Chain(shape, np.array([named[name] for name in CHAIN_PARAMETERS[shape]], dtype=np.float64)),
        covariance=np.array(item["covariance"], dtype=np.float64),
        unit=str(item["parameters"][0]["unit"]),
    )
    low, high = item["frequency_range_hz"]
    return ComponentModel(
        component=str(item["component"]),
        channel=str(item["channel"]),
        structure=str(item["structure"]),
        sensor=sensor,
        range_hz=(float(low), float(high)),
        sensitivity_measured=bool(item["sensitivity_measured"]),
    )


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


def _fill(file: h5py.File, evaluation: IdentifyEvaluation) -> None:
    """Fill the HDF5 file."""
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


class ReadingRow(NamedTuple):
    """One reading of a resonance in a component."""

    component: str
    reading: Reading


def _of_reading(name: str) -> Column[ReadingRow]:
    """Column of a reading."""
    return Column(name, lambda row: getattr(row.reading, name))


READINGS: list[Column[ReadingRow]] = [
    word("component", lambda row: row.component),
    *map(_of_reading, ("recording", "response", "method", "frequency_hz", "u_frequency_hz", "width_hz", "u_width_hz")),
    *map(_of_reading, ("damping_ratio", "u_damping_ratio", "stiffness", "damping", "note")),
]


def _texts(evaluation: IdentifyEvaluation) -> dict[str, str | bytes]:
    """Tables and model."""
    readings = (
        ReadingRow(component.name, entry) for component in evaluation.components for entry in component.readings
    )
    return {
        "parameters.csv": csv_text(columns_of(NumberRow), parameter_rows(evaluation)),
        "readings.csv": csv_text(READINGS, readings),
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
